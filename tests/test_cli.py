from __future__ import annotations

import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from typer.testing import CliRunner

import kcam
from kcam import Camera, cli, demo, plots
from kcam.units import nm

runner = CliRunner()


def run(*arguments: object, status: int = 0) -> str:
    """What the command printed."""
    result = runner.invoke(cli.app, [str(argument) for argument in arguments])
    assert result.exit_code == status, result.output
    return result.output


def fails(*arguments: object) -> str:
    """The one line that a bad input gets."""
    output = run(*arguments, status=2)
    assert output.startswith("kcam: ")
    assert output.count("\n") == 1, output
    assert "Traceback" not in output
    return output


@pytest.fixture
def photo(tmp_path: Path) -> Path:
    path = tmp_path / "photo.jpg"
    ramp = np.linspace(0, 255, 40 * 56 * 3).astype(np.uint8).reshape(40, 56, 3)
    Image.fromarray(ramp).save(path)
    return path


@pytest.mark.parametrize(
    ("text", "metres"),
    [("2", 2.0), ("2m", 2.0), ("2.5 m", 2.5), ("50 cm", 0.5), ("1e3 mm", 1.0), ("INF", math.inf), (" 550 nm", 5.5e-7)],
)
def test_length(text: str, metres: float) -> None:
    assert cli.length(text) == pytest.approx(metres)


@pytest.mark.parametrize("text", ["", "two", "2 furlongs", "nan", "2,5", "1 2"])
def test_no_length(text: str) -> None:
    with pytest.raises(ValueError, match="is not a length: expected e.g. 2"):
        cli.length(text)


def test_lengths() -> None:
    assert cli.lengths("1, 50 cm, inf", unit="m", name="x") == [1.0, 0.5, math.inf]
    assert cli.lengths("450,550,650 nm", unit="nm", name="x") == pytest.approx([4.5e-7, 5.5e-7, 6.5e-7])
    assert cli.lengths("450,550", unit="nm", name="x") == pytest.approx([4.5e-7, 5.5e-7])
    with pytest.raises(ValueError, match="is empty"):
        cli.lengths(" ,", unit="m", name="distances")


def test_version() -> None:
    assert run("--version") == f"kcam {kcam.__version__}\n"
    output = subprocess.run([sys.executable, "-m", "kcam", "--version"], capture_output=True, text=True, check=True)
    assert output.stdout == f"kcam {kcam.__version__}\n"


@pytest.mark.parametrize("camera", ["phone", "ideal"])
def test_shoot(camera: str, photo: Path, tmp_path: Path) -> None:
    out = tmp_path / "shot.png"
    assert run("shoot", photo, "--camera", camera, "--out", out).strip() == str(out)
    with Image.open(out) as shot:
        assert (shot.size, shot.mode) == ((56, 40), "RGB")
        first = np.asarray(shot)
    run("shoot", photo, "--camera", camera, "--out", out, "--seed", 0, "--distance", "200 cm")
    with Image.open(out) as shot:
        assert np.array_equal(first, np.asarray(shot))


def test_shoot_with_a_saved_camera(photo: Path, tmp_path: Path) -> None:
    saved, one, two = tmp_path / "mine.safetensors", tmp_path / "1.png", tmp_path / "2.png"
    Camera.phone().save(saved)
    run("shoot", photo, "--camera", saved, "--out", one, "--seed", 5)
    run("shoot", photo, "--camera", "phone", "--out", two, "--seed", 5)
    assert one.read_bytes() == two.read_bytes()


def test_seed_decides_the_noise(photo: Path, tmp_path: Path) -> None:
    one, two = tmp_path / "1.png", tmp_path / "2.png"
    run("shoot", photo, "--out", one, "--seed", 1)
    run("shoot", photo, "--out", two, "--seed", 2)
    assert one.read_bytes() != two.read_bytes()


def test_shoot_bad_input(photo: Path, tmp_path: Path) -> None:
    out = tmp_path / "shot.png"
    text = tmp_path / "text.jpg"
    text.write_text("no picture")
    assert "nothing.jpg" in fails("shoot", tmp_path / "nothing.jpg", "--out", out)
    assert "text.jpg" in fails("shoot", text, "--out", out)
    assert "distance" in fails("shoot", photo, "--distance", "0", "--out", out)
    assert "is not a length" in fails("shoot", photo, "--distance", "far", "--out", out)
    assert "thesis, ideal, phone" in fails("shoot", photo, "--camera", "pinhole", "--out", out)
    assert "there is no file" in fails("shoot", photo, "--camera", tmp_path / "no.safetensors", "--out", out)
    assert "not a whole safetensors file" in fails("shoot", photo, "--camera", text, "--out", out)
    assert "must end in one of" in fails("shoot", photo, "--out", tmp_path / "shot.xyz")
    assert "there is no folder" in fails("shoot", photo, "--out", tmp_path / "no" / "shot.png")
    assert not out.exists()


def test_shoot_with_a_camera_that_gives_no_picture(photo: Path, tmp_path: Path) -> None:
    Camera.phone()[:4].save(tmp_path / "raw.safetensors")
    line = fails("shoot", photo, "--camera", tmp_path / "raw.safetensors", "--out", tmp_path / "shot.png")
    assert "gives 1 channels, not a picture" in line


def test_psf(tmp_path: Path) -> None:
    out = tmp_path / "psf.png"
    run("psf", "--camera", "phone", "--out", out, "--distances", "1, inf", "--wavelengths", "450, 650 nm")
    with Image.open(out) as figure:
        assert figure.width > 800


def test_psf_bad_input(tmp_path: Path) -> None:
    assert "has no lens" in fails("psf", "--camera", "ideal", "--out", tmp_path / "psf.png")
    assert "must end in one of" in fails("psf", "--out", tmp_path / "psf.txt")
    assert "wavelength" in fails("psf", "--out", tmp_path / "psf.png", "--wavelengths", "5 m")


def test_pictures_on_disk(tmp_path: Path) -> None:
    picture = torch.tensor([0.0, 0.5, 2.0, -1.0, float("nan"), 1.0]).view(1, 2, 3)
    plots.write_picture(picture, tmp_path / "x.png")
    with Image.open(tmp_path / "x.png") as image:
        assert np.asarray(image)[..., 1].tolist() == [[0, 128, 255], [0, 0, 255]]


def test_light_has_its_colour() -> None:
    blue, green, red = plots.light_colours(torch.tensor([450.0, 530.0, 650.0]) * nm)
    assert blue.argmax() == 2
    assert green.argmax() == 1
    assert red.argmax() == 0


def test_durations() -> None:
    assert [plots.duration(s) for s in (0.0012, 0.0123, 0.9999, 12.34, 123.4)] == [
        "1.2 ms",
        "12 ms",
        "1 s",
        "12.3 s",
        "123 s",
    ]


def test_demo_small(tmp_path: Path) -> None:
    steps: list[str] = []
    paths = demo.run(tmp_path / "demo", size=48, advance=steps.append)
    assert len(steps) == demo.STEPS
    assert len(paths) == 1 + 2 * len(demo.SCENES) * len(demo.CAMERAS) + len(demo.CAMERAS)
    assert all(path.stat().st_size > 500 for path in paths)


@pytest.mark.slow
def test_demo_command(tmp_path: Path) -> None:
    output = run("demo", "--out", tmp_path / "demo")
    assert "overview.png" in output
