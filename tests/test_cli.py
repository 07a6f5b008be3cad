from __future__ import annotations

import io
import itertools
import math
import re
import runpy
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import typer
from commands import fails, run
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.text import Text
from PIL import Image
from rich.console import Console
from typer.testing import CliRunner

import kcam
from kcam import Camera, cli, demo, memory, optics, plots, train
from kcam.cli import console
from kcam.optics.compound import presets
from kcam.scene import read_picture
from kcam.style import STYLES, painting
from kcam.units import mm, nm


def unboxed(text: str) -> str:
    """What typer prints in a box, as one line."""
    return " ".join(text.replace("\u2502", " ").split())


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


@pytest.mark.parametrize("text", ["1;2", "1 2", "1, two"])
def test_lengths_are_separated_by_commas(text: str) -> None:
    with pytest.raises(ValueError, match='is not a length: expected e.g. "1, 2, inf" with commas'):
        cli.lengths(text, unit="m", name="distances")


@pytest.mark.parametrize(
    ("text", "bare"), [("5.5e-7", " A number without a unit is in nm."), ("5 m", ""), ("50", " A num"), ("21 um", "")]
)
def test_no_wavelength(text: str, bare: str) -> None:
    with pytest.raises(ValueError, match=f'wavelengths "{text}" is outside 1e-07 m to 2e-05 m.{bare}.* "450, 550"'):
        cli.lengths(text, unit="nm", name="wavelengths", expected="450, 550", least=1e-7, most=2e-5)


def test_lengths() -> None:
    assert cli.lengths("1, 50 cm, inf", unit="m", name="x") == [1.0, 0.5, math.inf]
    assert cli.lengths("450,550,650 nm", unit="nm", name="x") == pytest.approx([4.5e-7, 5.5e-7, 6.5e-7])
    assert cli.lengths("450,550", unit="nm", name="x") == pytest.approx([4.5e-7, 5.5e-7])
    with pytest.raises(ValueError, match="is empty"):
        cli.lengths(" ,", unit="m", name="distances")


def test_version(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("--version") == f"kcam {kcam.__version__}\n"
    kept: list[bool] = []
    monkeypatch.setattr(memory, "keep", lambda: kept.append(True))  # would hold for this process, and other tests
    monkeypatch.setattr(sys, "argv", ["kcam", "--version"])
    with pytest.raises(SystemExit, match="^0$"):
        runpy.run_module("kcam", run_name="__main__")  # python -m kcam, in this process
    assert capsys.readouterr().out == f"kcam {kcam.__version__}\n"
    assert kept == [True]


@pytest.mark.parametrize("camera", ["phone", "ideal"])
def test_shoot(camera: str, photo: Path, tmp_path: Path) -> None:
    out = tmp_path / "shot.png"
    said, left_out = run("shoot", photo, "--camera", camera, "--out", out).splitlines()
    assert said == str(out)
    assert left_out == "  nothing left out"
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


def test_shoot_within_a_tolerance(photo: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Planned and whole picture differ, but by less than one sees, and a line says in what; one that takes less time
    than a plan is whole.
    """
    whole, planned = tmp_path / "1.png", tmp_path / "2.png"
    run("shoot", photo, "--camera", "thesis", "--tolerance", "0", "--out", whole)
    monkeypatch.setattr("kcam.planner.planner.WORTH", math.inf)
    run("shoot", photo, "--camera", "thesis", "--out", planned)
    assert whole.read_bytes() == planned.read_bytes()
    monkeypatch.setattr("kcam.planner.planner.WORTH", 0.0)
    _, left_out = run("shoot", photo, "--camera", "thesis", "--out", planned).splitlines()
    coarser = r"pupil samples kappa [\d.]+ \(of kappa 2\.7\)"
    assert re.match(rf"  within 0.01: {coarser}, wavelengths \d+ PSFs \(of 28 PSFs\)", left_out)
    one, two = (np.asarray(Image.open(path)).astype(float) for path in (whole, planned))
    assert 0 < np.abs(one - two).max() < 12
    assert "is no relative error: expected e.g. 0.01, or sensor" in fails("shoot", photo, "--tolerance", "fine")
    assert "must be a relative error >= 0" in fails("shoot", photo, "--tolerance", "-1")


def test_explain(photo: Path, tmp_path: Path) -> None:
    out = tmp_path / "plan.json"
    text = run("explain", photo, "--camera", "phone", "--tolerance", "0.05", "--measure", "--out", out)
    assert text.startswith("Plan for 40 x 56 pixels, 28 bands, 2 m; tolerance 0.05")
    assert "Measured: error" in text
    plan = kcam.Plan.load(out)
    assert plan.measured["error"] <= 0.05
    assert "2.1" in run("explain", "motorcycle", "--size", 32, "--tolerance", "sensor").splitlines()[0]
    assert "there is no file" in fails("explain", tmp_path / "nothing.png")
    assert "unknown camera" in fails("explain", photo, "--camera", "pinhole")
    assert "there is no folder" in fails("explain", photo, "--out", tmp_path / "no" / "plan.json")
    assert "there is a folder of that name" in fails("explain", photo, "--out", tmp_path)
    assert "is what is read" in fails("explain", photo, "--out", photo)


@pytest.mark.slow
def test_calibrate(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rates are positive, kept, and used; a damaged file counts as none."""
    from kcam.planner import costs

    monkeypatch.setenv("KCAM_CACHE", str(tmp_path))
    assert costs.current_rates() == costs.RATES
    text = run("calibrate")
    assert str(tmp_path / "rates.json") in text
    found = re.search(r"factor of ([\d.]+)", text)
    assert found is not None
    assert float(found[1]) >= 1
    rates = costs.current_rates()
    assert rates != costs.RATES
    assert all(rate > 0 for rate in rates.values())
    (tmp_path / "rates.json").write_text("damaged")
    assert costs.current_rates() == costs.RATES


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
    folder = tmp_path / "folder.jpg"
    folder.mkdir()
    assert "there is no picture in the folder" in fails("shoot", folder, "--out", out)
    assert "is a folder. Name the file in it" in fails("shoot", photo, "--camera", tmp_path, "--out", out)
    for seed in (10**22, -1):
        assert "Invalid value for '--seed'" in run("shoot", photo, "--out", out, "--seed", seed, status=2)
    assert not out.exists()


def test_shoot_never_writes_over_the_photo(photo: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = photo.read_bytes()
    monkeypatch.chdir(tmp_path)  # the same file by another name
    assert "photo.jpg is what is read" in fails("shoot", photo, "--camera", "ideal", "--out", "photo.jpg")
    assert photo.read_bytes() == before


def test_shoot_too_near(photo: Path, tmp_path: Path) -> None:
    """Where the blur is wider than the picture its light is lost; the distance that the error names is far enough."""
    out = tmp_path / "shot.png"
    for distance in ("4 mm", "0.001"):
        line = fails("shoot", photo, "--distance", distance, "--out", out)
        assert "it is inside the focal length of 4.3 mm, where nothing has an image" in line
    line = fails("shoot", photo, "--distance", "0.1", "--out", out)
    # D d (1/z - 1/2) / pitch = 4.3 / 1.8 mm 4.309 mm 9.5 / 1.4 um
    assert "0.1 m is too near: a point there blurs over 70 pixels, of which there are 40" in line
    assert not out.exists()
    named = re.search(r'--distance "(\d+ cm)"', line)
    assert named is not None
    run("shoot", photo, "--camera", "phone", "--distance", named[1], "--out", out)
    with Image.open(photo) as before, Image.open(out) as after:
        # the mean of linear light is kept to 10 %: the tails of the blur, 38 of 40 pixels wide, leave the picture
        linear = [((np.asarray(picture) / 255.0) ** 2.2).mean() for picture in (before, after)]
    assert linear[1] == pytest.approx(linear[0], rel=0.1)


def test_shoot_with_a_linear_camera(photo: Path, tmp_path: Path) -> None:
    """Without a tone curve colours leave [0,1]; they are clipped, not refused after the work."""
    (camera := Camera.ideal()[:-1]).save(tmp_path / "linear.safetensors")
    assert len(camera) == 4
    run("shoot", photo, "--camera", tmp_path / "linear.safetensors", "--out", tmp_path / "shot.png")


def test_shoot_with_a_camera_that_gives_no_picture(photo: Path, tmp_path: Path) -> None:
    Camera.phone()[:4].save(tmp_path / "raw.safetensors")
    line = fails("shoot", photo, "--camera", tmp_path / "raw.safetensors", "--out", tmp_path / "shot.png")
    assert "gives 1 channels, not a picture" in line


def test_psf(tmp_path: Path) -> None:
    out = tmp_path / "psf.png"
    run("psf", "--camera", "phone", "--out", out, "--distances", "1, inf", "--wavelengths", "450, 650 nm")
    with Image.open(out) as figure:
        assert figure.width > 800
    for suffix, start in ((".pdf", b"%PDF"), (".svg", b"<?xml")):
        run("psf", "--camera", "phone", "--out", out.with_suffix(suffix), "--distances", 2, "--wavelengths", 550)
        assert out.with_suffix(suffix).read_bytes().startswith(start)


def test_psf_bad_input(tmp_path: Path) -> None:
    assert "has no lens" in fails("psf", "--camera", "ideal", "--out", tmp_path / "psf.png")
    assert "must end in one of" in fails("psf", "--out", tmp_path / "psf.txt")
    line = fails("psf", "--out", tmp_path / "psf.png", "--wavelengths", "5.5e-7")
    assert 'wavelengths "5.5e-7" is outside 1e-07 m to 2e-05 m. A number without a unit is in nm.' in line
    assert "with commas" in fails("psf", "--out", tmp_path / "psf.png", "--distances", "1;2")


@pytest.mark.slow
def test_lens(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file is read with what was asked to be in focus; the table says what the lens does."""
    asked = []

    def from_file(path: str, *, focus_distance: float | None = None) -> optics.CompoundLens:
        asked.append((path, focus_distance))
        return optics.CompoundLens(
            optics.Surface(thickness=3 * mm, glass=1.5, semi_diameter=2 * mm, stop=True),
            optics.Surface(radius=-25 * mm),
            sensor_distance=49 * mm,
        )

    monkeypatch.setattr(optics.CompoundLens, "from_file", staticmethod(from_file), raising=False)
    out = tmp_path / "lens.png"
    options = ("--out", out, "--field", 0.1, "--wavelengths", "500, 600", "--frequency", 20)
    text = run("lens", "mine.ZMX", "--refocus", *options)
    assert text.splitlines()[0].startswith("sensor moved by +0.")
    assert "focal length    50 mm at 550 nm" in text
    assert "600 - 500 nm [um]" in text
    assert "MTF at 20 / mm" in text
    rows = [line.split() for line in text.splitlines() if re.match(r" *\d\.\d{3} ", line)]
    assert len(rows) == 11
    assert rows[-1][0] == "0.100"
    assert float(rows[-1][1]) == pytest.approx(5, rel=0.03)
    assert text.splitlines()[-1] == str(out)
    with Image.open(out) as figure:
        assert figure.width > 1200
    run("lens", "mine.json", "--focus", "50 cm", *options)
    assert asked == [("mine.ZMX", None), ("mine.json", 0.5)]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cooke_triplet", "ef50", "phone"])
def test_lens_of_a_preset(name: str, tmp_path: Path) -> None:
    text = run("lens", name, "--focus", 2, "--out", tmp_path / "lens.pdf")
    assert re.search(r"focal length    \d+(\.\d+)? mm", text)
    rows = [[float(word) for word in line.split()[:3]] for line in text.splitlines() if re.match(r" *\d\.\d{3} ", line)]
    assert rows[0][2] == 100
    assert rows[-1][0] == pytest.approx(presets.PRESETS[name].field, abs=6e-4), "its field ends where the patent's does"
    assert rows[-1][2] >= 19


def test_lens_bad_input(tmp_path: Path) -> None:
    out = ("--out", tmp_path / "lens.png")
    line = fails("lens", "zoom", *out)
    assert 'unknown lens "zoom": expected a preset (cooke_triplet, double_gauss, ' in line
    assert "ends in .zmx or .json" in line
    assert "must end in one of" in fails("lens", "ef50", "--out", tmp_path / "lens.txt")
    assert "field -1 is no height Y / D" in fails("lens", "ef50", "--field", -1, *out)
    assert "frequency 0 is none" in fails("lens", "ef50", "--frequency", 0, *out)
    assert 'focus "near" is not a length' in fails("lens", "ef50", "--focus", "near", *out)
    assert "has no real image" in fails("lens", "ef50", "--focus", "1 cm", *out)
    assert "chief ray of a point at 3 " in fails("lens", "ef50", "--field", 3, *out)


def shown(distances: list[float]) -> tuple[int, int, str]:
    """(side of the panels, least share in percent, the whole caption) of the phone's figure at 550 nm."""
    figure = plots.psf_figure(Camera.phone()[0], distances=distances, wavelengths=[550 * nm], title="phone")
    caption = next(text.get_text() for text in figure.texts if "Panels" in text.get_text())
    found = re.search(r"the middle (\d+) of 255 pixels, with (?:(\d+)% or more|less than 1%) of their light", caption)
    assert found, caption
    return int(found[1]), int(found[2] or 0), caption


@pytest.mark.slow
def test_a_psf_figure_states_the_share_of_light_that_it_shows() -> None:
    near = [0.01, 0.1]
    side, percent, _ = shown(near)
    phone = Camera.phone()[0]
    energy = phone.lens.psf(
        [550 * nm], distances=near, pixel_pitch=phone.pixel_pitch, shape=(side, side), fill_factor=phone.fill_factor
    ).sum((-2, -1))
    # at 1 cm the blur is a disc far wider than the panel: 12 % of it, where the caption said 97 %
    assert 0.05 < energy.min() < 0.2
    # daylight has less within at its long wavelengths, by 3 % of the light here at most
    assert energy.min() - 0.04 < percent / 100 <= energy.min()
    assert shown([2.0])[1] >= 90


def test_a_share_is_never_rounded_up() -> None:
    assert plots.percent_or_more(0.979) == "97% or more"
    assert plots.percent_or_more(1.0000001) == "100% or more"
    assert plots.percent_or_more(0.004) == "less than 1%"


def test_help_prints_what_was_written() -> None:
    """[pixels] is no markup, in no command and no option."""
    app: Any = typer.main.get_command(cli.app)
    bracketed = 0
    for name, command in app.commands.items():
        printed = "".join(unboxed(run(name, "--help")).split())
        for sentence in (command.help, *(getattr(parameter, "help", None) for parameter in command.params)):
            assert "".join((sentence or "").split()) in printed, f"{name}: {sentence}"
            bracketed += "[" in (sentence or "")
    assert bracketed >= 5


def test_help_names_the_styles() -> None:
    for name in ("train", "paint"):
        assert ", ".join(STYLES) in " ".join(unboxed(run(name, "--help")).split())


def test_help_names_the_units() -> None:
    text = unboxed(run("psf", "--help"))
    assert "in metres" in text
    assert "in nanometres" in text
    assert "in metres" in unboxed(run("shoot", "--help"))


@pytest.mark.parametrize("planes", [1, 3])
@pytest.mark.parametrize("suffix", plots.PICTURE_SUFFIXES)
def test_pictures_on_disk(suffix: str, planes: int, tmp_path: Path) -> None:
    """One plane stays one, and in a TIFF a raw keeps its bits."""
    picture = torch.tensor([0.0, 0.5, 2.0, -1.0, 0.2, 1.0]).view(1, 2, 3).expand(planes, -1, -1)
    plots.write_picture(picture, tmp_path / f"x{suffix}")
    deep = planes == 1 and suffix.startswith(".tif")
    with Image.open(tmp_path / f"x{suffix}") as image:
        values = np.asarray(image)
        assert image.mode == (("I;16" if deep else "L") if planes == 1 and suffix != ".webp" else "RGB")
    expected = np.array([[0, 0.5, 1], [0, 0.2, 1]]) * (65535 if deep else 255)
    lossy = suffix in (".jpg", ".jpeg", ".webp")
    assert np.abs(values[..., 1] - expected if values.ndim == 3 else values - expected).max() <= (25 if lossy else 0.5)
    back = read_picture(tmp_path / f"x{suffix}")
    assert back.shape[1:] == (2, 3)
    assert lossy or (back - picture.clamp(0, 1)).abs().max() <= (0.5 / 65535 if deep else 0.5 / 255) * 1.01


def test_a_raw_of_twelve_bits_comes_back_from_a_tiff(tmp_path: Path) -> None:
    raw = torch.randint(0, 4096, (1, 40, 50)) / 4095
    plots.write_picture(raw, tmp_path / "raw.tif")
    assert torch.equal((read_picture(tmp_path / "raw.tif") * 4095).round(), raw * 4095)


def test_a_psf_figure_of_a_lens() -> None:
    lens = optics.Lens(optics.CircularAperture(5 * mm), optics.ThinLens(50 * mm), focus_distance=2.0)
    figure = plots.psf_figure(lens, distances=[2.0], wavelengths=[550 * nm])
    assert any("pixels of 4" in text.get_text() for text in figure.findobj(Text))
    with pytest.raises(TypeError, match=r"of an optics.Imaging or a Lens, got Camera. Use camera\[0\]"):
        plots.psf_figure(Camera.phone())
    with pytest.raises(TypeError, match="got str"):
        plots.psf_figure("thesis")


@pytest.mark.parametrize("suffix", plots.PICTURE_SUFFIXES)
def test_every_suffix_is_its_format(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"x{suffix}"
    plots.write_picture(torch.full((3, 4, 5), 0.5), path)
    with Image.open(path) as image:
        assert image.size == (5, 4)
        assert suffix in {s for s, name in Image.registered_extensions().items() if name == image.format}


@pytest.mark.parametrize(
    ("picture", "error", "text"),
    [
        (torch.zeros(1, 3, 4, 5), ValueError, r"\(1, 3, 4, 5\), .* use picture\[0\]\."),
        (torch.zeros(4, 5, 3), ValueError, r"\(4, 5, 3\), .* use picture.permute\(2, 0, 1\)\."),
        (torch.zeros(4, 5), ValueError, r"\(4, 5\), .* Use picture\[None\]"),
        (torch.zeros(2, 4, 5), ValueError, r"\(2, 4, 5\), expected 1 or 3 channels: \(C,H,W\)\.$"),
        (np.zeros((4, 5, 3)), TypeError, r"tensor \(3,H,W\) in \[0,1\], got an array \(4, 5, 3\)"),
        (torch.full((3, 4, 5), 300.0), ValueError, r"from 300 to 300, expected sRGB in \[0,1\]. Use picture / 255"),
        (torch.full((3, 4, 5), math.nan), ValueError, r"from nan to nan, expected sRGB in \[0,1\]. Remove NaN"),
        (torch.full((3, 4, 5), -math.inf), ValueError, r"from -inf to -inf, expected sRGB in \[0,1\]"),
    ],
)
def test_no_picture_to_write(picture: Any, error: type[Exception], text: str, tmp_path: Path) -> None:
    with pytest.raises(error, match=text):
        plots.write_picture(picture, tmp_path / "x.png")
    assert not list(tmp_path.iterdir())


def test_an_interrupted_write_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    picture, drawing = tmp_path / "x.png", tmp_path / "y.png"
    plots.write_picture(torch.zeros(3, 4, 5), picture)
    plots.save_figure(Figure(figsize=(1, 1)), drawing)
    before = [path.read_bytes() for path in (picture, drawing)]

    def interrupt(descriptor: int) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("os.fsync", interrupt)
    with pytest.raises(KeyboardInterrupt):
        plots.write_picture(torch.ones(3, 4, 5), picture)
    with pytest.raises(KeyboardInterrupt):
        plots.save_figure(Figure(figsize=(2, 2)), drawing)
    assert [path.read_bytes() for path in (picture, drawing)] == before
    assert len(list(tmp_path.iterdir())) == 2


def test_light_has_its_colour() -> None:
    blue, green, red = plots.light_colours(torch.tensor([450.0, 530.0, 650.0]) * nm)
    assert blue.argmax() == 2
    assert green.argmax() == 1
    assert red.argmax() == 0


def test_light_that_nobody_sees_is_white() -> None:
    assert plots.light_colours(torch.tensor([5500.0]) * nm).tolist() == [[1, 1, 1]]


@pytest.mark.parametrize(
    ("distances", "wavelengths"),
    [
        ([0.5, 2.0, math.inf], [450 * nm, 650 * nm, 1500 * nm]),
        pytest.param([0.5, 2.0, math.inf], [450 * nm, 650 * nm, 5500 * nm], marks=pytest.mark.slow),
        pytest.param([1.0], [550 * nm], marks=pytest.mark.slow),
        pytest.param([1.0], [450 * nm, 650 * nm, 5500 * nm], marks=pytest.mark.slow),
        pytest.param([0.5, 2.0, math.inf], [550 * nm], marks=pytest.mark.slow),
    ],
)
def test_all_text_of_a_psf_figure_is_inside_it(distances: list[float], wavelengths: list[float]) -> None:
    imaging = Camera.phone()[0]
    with torch.no_grad():
        figure = plots.psf_figure(imaging, distances=distances, wavelengths=wavelengths, title="phone camera")
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    boxes = [text.get_window_extent(canvas.get_renderer()) for text in figure.texts]
    boxes += [axes.get_tightbbox(canvas.get_renderer()) for axes in figure.axes]
    for box in boxes:
        assert min(box.x0, box.y0) >= 0
        assert box.x1 <= figure.bbox.x1
        assert box.y1 <= figure.bbox.y1
    # the light within a radius is a smooth curve: no corner of more than 10 degrees as drawn, 4.2 by 1.8 inches
    line = figure.axes[-1].lines[0]
    steps = np.diff(figure.axes[-1].transData.transform(line.get_xydata()), axis=0)
    assert np.degrees(np.abs(np.diff(np.arctan2(steps[:, 1], steps[:, 0])))).max() < 10


@pytest.mark.parametrize("count", [1, 6, 7, 10, 20])
def test_no_two_curves_are_alike(count: int) -> None:
    colours = np.array([to_rgb(colour) for colour in plots.distance_colours(count)])
    apart = np.abs(colours[:, None] - colours).max(-1) + np.eye(count)
    assert apart.min() > 0.05


def test_durations() -> None:
    times = {0.0012: "1.2 ms", 0.0123: "12 ms", 0.9999: "1 s", 12.34: "12.3 s", 119: "119 s", 123.4: "2.06 min"}
    times |= {8000: "2.22 h", 500_000: "5.79 days"}
    assert {seconds: plots.duration(seconds) for seconds in times} == times


@pytest.mark.slow
def test_demo_small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the scenes one with depth and a flat one, which stand for the others."""
    scenes = dict(demo.SCENES)
    monkeypatch.setattr(demo, "SCENES", {name: scenes[name] for name in ("motorcycle", "coffee")})
    steps: list[str] = []
    paths = demo.run(tmp_path / "demo", size=48, advance=steps.append)
    assert len(steps) == demo.STEPS - len(demo.CAMERAS) * (len(scenes) - 2)
    assert len(paths) == 1 + 2 * len(demo.SCENES) * len(demo.CAMERAS) + len(demo.CAMERAS)
    assert all(path.stat().st_size > 500 for path in paths)


@pytest.mark.parametrize("inside", ["", "demo"])
def test_demo_into_a_file(inside: str, photo: Path) -> None:
    assert "there is a file in its place. Choose a folder" in fails("demo", "--out", photo / inside)


@pytest.mark.slow
def test_demo_command(tmp_path: Path) -> None:
    output = run("demo", "--out", tmp_path / "demo")
    assert "overview.png" in output


# ---- progress ------------------------------------------------------------------------------------------------------


class Clock:
    """Wall time that passes when it is told to."""

    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


def told(
    seconds: list[float], total: int | None, *, what: str = "step", first: int | None = None
) -> list[tuple[float, str]]:
    """When each line was printed, and the line, where steps take so long."""
    clock, lines = Clock(), []
    advance = console.Lines(what, total, clock=clock, write=lambda line: lines.append((clock.now - 1000, line)))
    for index, taken in enumerate(seconds):
        clock.now += taken
        advance("loss 0.123", done=None if first is None else first + index)
    return lines


def test_a_line_of_progress_says_what_is_left() -> None:
    lines = told([0.3] * 600, 600)
    assert lines[0][1] == "step 30 of 600, loss 0.123, 9 s, 3 min left"
    assert lines[3][1] == "step 120 of 600, loss 0.123, 36 s, 2 min left"
    assert [line.split(",")[0] for _, line in lines] == [f"step {step} of 600" for step in range(30, 601, 30)]
    assert told([0.3] * 3000, None)[0] == (pytest.approx(10.2), "step 34, loss 0.123, 10 s")


@pytest.mark.parametrize("seed", range(20))
def test_lines_come_neither_too_often_nor_too_seldom(seed: int) -> None:
    """One a second at most; after 10 s, or 5 % of the steps, at the next step."""
    random = np.random.default_rng(seed)
    steps = int(random.integers(3, 800))
    seconds = list(random.lognormal(math.log(random.choice([0.001, 0.05, 1, 12])), 1, steps))
    when = np.cumsum(seconds)
    moments = np.array([0, *(moment for moment, _ in told(seconds, steps)), when[-1]])
    assert (np.diff(moments[:-1]) >= 1 - 1e-9).all()
    for before, after in itertools.pairwise(moments):
        silent = np.flatnonzero((when > before + 1e-9) & (when < after - 1e-9))  # steps without a line between two
        assert not len(silent) or when[silent[-1]] - before < 10
        assert not len(silent) or when[silent[-1]] - before < 1 or len(silent) < 0.05 * steps
    assert when[-1] >= 1 or len(moments) == 2


@pytest.mark.parametrize("first", [30.0, 600.0])
def test_a_slow_first_step_does_not_count(first: float) -> None:
    left = [
        console.time_left([(0, 0), (first, 1), *((first + 0.5 * k, 1 + k) for k in range(1, n))], 101)
        for n in (2, 3, 9)
    ]
    assert left == pytest.approx([49.5, 49.0, 46.0])
    lines = told([first] + [0.5] * 100, 101)
    assert lines[0][1] == f"step 1 of 101, loss 0.123, {console.rounded(first)}"  # of one step nothing is known yet
    assert lines[1][1].endswith("47 s left")


def test_steps_that_were_found_done_do_not_count() -> None:
    """A store that is gone on with: a hundred scenes at once, then some that take their time."""
    marks = [(0.0, 0), *((0.001 * k, k) for k in range(1, 101)), *((0.1 + 2.0 * k, 100 + k) for k in range(1, 11))]
    assert console.time_left(marks, 120) == pytest.approx(20, rel=0.01)
    lines = told([2.0] * 20, 1000, first=901)  # a run that goes on from a checkpoint
    assert lines[0] == (10, "step 905 of 1000, loss 0.123, 10 s, 3 min left")


def test_nothing_is_left_or_known() -> None:
    assert console.time_left([(0, 0), (1, 1), (2, 2)], 2) == 0
    assert console.time_left([(0, 0), (1, 1), (2, 2)], None) is None
    assert console.time_left([(0, 0), (1, 5), (2, 5)], 9) is None  # stands still
    assert console.time_left([(0, 5), (1, 6), (2, 3)], 9) is None  # went back
    assert [console.rounded(s) for s in (0.2, 34.4, 99, 120, 5000, 7000)] == [
        "0 s",
        "34 s",
        "99 s",
        "2 min",
        "83 min",
        "1.9 h",
    ]


def test_where_there_is_no_terminal_lines_go_to_the_standard_error(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(console, "OFTEN", 0.0)
    monkeypatch.setattr(train, "SHOWN", ("coffee",))  # on the sheet of a report, which is not asked for here
    monkeypatch.setattr(train, "SHOWN_SIZE", 48)
    style, painted = tmp_path / "style.png", tmp_path / "a.png"
    plots.write_picture(painting("woodcut", size=128), style)
    result = CliRunner().invoke(cli.app, f"paint --style {style} --steps 4 --size 64 --out {painted}".split())
    assert result.stdout == f"{painted}\n"
    lines = result.stderr.splitlines()
    assert len(lines) == 4
    assert re.fullmatch(r"step 4 of 4, loss \d\.\d+ \((\w+ \d\.\d+(, )?)+\), \d+ s", lines[-1])
    assert "\x1b" not in result.output
    options = f"--steps 3 --size 64 --batch 1 --no-stage --out {tmp_path / 'a.safetensors'}"
    result = CliRunner().invoke(cli.app, f"train {style} {options}".split())
    assert result.exit_code == 0, result.output
    lines = [line for line in result.stderr.splitlines() if line.startswith("step")]
    assert [line.split(",")[0] for line in lines] == ["step 1 of 3", "step 2 of 3", "step 3 of 3"]


def test_on_a_terminal_there_is_a_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    for terminal in ("xterm", "dumb"):
        shown = io.StringIO()
        monkeypatch.setenv("TERM", terminal)
        terminal_err = Console(file=shown, force_terminal=True, width=100)
        monkeypatch.setattr(console, "err", terminal_err)
        with console.progress("convert", 2) as advance:
            advance("[/b] is no markup")
            advance("last", 2)
        assert ("convert 2 of 2: last" in shown.getvalue()) == (terminal == "xterm")
        assert ("\x1b" in shown.getvalue()) == (terminal == "xterm")


def test_the_help_of_data_and_a_wrong_command() -> None:
    text = unboxed(run("data", "--help"))
    assert re.search(r"convert .*cube files\. inspect .* extract .* verify .* export ", text)
    assert "..." not in text.split("Commands")[1]
    for name in ("convert", "inspect", "extract", "verify", "export"):
        assert "--json" in run("data", name, "--help")
    assert "No such command" in run("data", "mend", status=2)


def test_paint_with_pieces(tmp_path: Path, photo: Path) -> None:
    out = tmp_path / "painted.png"
    assert run("paint", photo, "--style", "woodcut", "--size", 64, "--seed", 3, "--out", out).strip() == str(out)
    with Image.open(out) as painted:
        assert max(painted.size) <= 64


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("--by", "pieces", "--steps", 3), "--by pieces takes no --steps"),
        (("--by", "magic"), 'unknown way to paint "magic": expected pieces or loss'),
    ],
)
def test_ways_to_paint_that_are_none(tmp_path: Path, photo: Path, arguments: tuple, text: str) -> None:
    assert text in fails("paint", photo, *arguments, "--out", tmp_path / "a.png")
    assert not (tmp_path / "a.png").exists()
    assert "--by pieces needs a photograph to paint" in fails("paint", "--by", "pieces", "--out", tmp_path / "a.png")
