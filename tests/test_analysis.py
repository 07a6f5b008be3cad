"""What a camera is worth, against closed forms, colour-science and scikit-image."""

from __future__ import annotations

import json
import math
import random
from pathlib import Path

import numpy as np
import pytest
import torch
from commands import fails, run

from kcam import Camera, isp, optics, sensor, spectral
from kcam import analysis as A
from kcam.camera import PRESETS
from kcam.units import mm, um


def edge(size: int, *, blur: float, angle: float, contrast: float = 0.6, shift: float = 0.0) -> torch.Tensor:
    y, x = torch.meshgrid(*[torch.arange(size, dtype=torch.float64) - size / 2] * 2, indexing="ij")
    slant = math.radians(angle)
    across = (x - shift) * math.cos(slant) - y * math.sin(slant)
    return 0.5 + 0.5 * contrast * torch.erf(across / blur / math.sqrt(2))


@pytest.mark.parametrize("seed", range(20))
def test_mtf50_of_a_gaussian_blur_is_its_closed_form(seed: int) -> None:
    draw = random.Random(seed)
    blur, angle = draw.uniform(0.4, 2.0), draw.uniform(2, 10) * draw.choice([1, -1])
    picture = edge(draw.choice([64, 80, 100]), blur=blur, angle=angle, contrast=draw.uniform(0.1, 0.9),
                   shift=draw.uniform(-3, 3))  # fmt: skip
    picture = picture.flip(draw.choice([0, 1])).T if draw.random() < 0.5 else 1 - picture
    found = A.slanted_edge_mtf(picture, pixel_pitch=2 * um)
    wanted = math.sqrt(math.log(2) / 2) / (math.pi * blur)
    assert found.mtf50 == pytest.approx(wanted, rel=0.01)
    assert found.mtf50_per_metre == pytest.approx(wanted / (2 * um), rel=0.01)
    assert found.angle == pytest.approx(abs(angle), abs=0.05)


def test_noise_moves_mtf50_little() -> None:
    noise = 0.01 * torch.randn(100, 100, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    found = A.slanted_edge_mtf(edge(100, blur=1.0, angle=5) + noise)
    assert found.mtf50 == pytest.approx(0.1874, rel=0.04)


@pytest.mark.parametrize(
    ("picture", "text"),
    [
        (torch.full((32, 32), 0.5), "no edge"),
        (edge(64, blur=1, angle=0.5), "slanted by 0.5"),
        (edge(64, blur=1, angle=43), "slanted by 4"),
        (edge(8, blur=1, angle=5), "16 x 16"),
        (edge(64, blur=1, angle=5).where(torch.rand(64, 64) < 0.9, math.nan), "not finite"),
        (edge(96, blur=1, angle=5, shift=-18) - edge(96, blur=1, angle=5, shift=18), "edge"),
        (edge(96, blur=1, angle=5, shift=-18) + edge(96, blur=1, angle=5, shift=18), "edge"),
        (torch.rand(64, 64, generator=torch.Generator().manual_seed(0)), "edge"),
        (torch.rand(3, 64, 64), "one plane"),
    ],
)
def test_what_is_no_slanted_edge_is_refused(picture: torch.Tensor, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        A.slanted_edge_mtf(picture)


def test_a_clipped_edge_is_refused() -> None:
    with pytest.raises(ValueError, match="clipped"):
        A.slanted_edge_mtf(edge(64, blur=1, angle=5, contrast=1.6).clamp(0, 1), limits=(0.0, 1.0))


@pytest.mark.parametrize("fill_factor", [1.0, 0.5])
@pytest.mark.parametrize("f_number", [pytest.param(2.8, marks=pytest.mark.slow), 5.6])
def test_a_thin_lens_has_the_mtf_of_diffraction_and_pixel(f_number: float, fill_factor: float) -> None:
    lens = optics.Lens(
        optics.CircularAperture(10 * mm / f_number), optics.ThinLens(focal_length=10 * mm), focus_distance=2.0
    )
    pitch = 1.5 * um
    camera = Camera(optics.Imaging(lens, pixel_pitch=pitch, fill_factor=fill_factor), sensor.ColourFilter.nikon())
    found, grid = A.edge_response(camera), camera.resolve().wavelengths
    weights = spectral.xyz_weights(grid, "D65")[:, 1].numpy()
    f, slant = found.frequencies.numpy(), math.radians(5)
    half = 10 * mm / f_number / 2
    sine = half / math.hypot(half, float(lens.sensor_distance))
    part = np.clip(f[:, None] / pitch * grid.numpy() / (2 * sine), 0, 1)
    mtf = 2 / np.pi * (np.arccos(part) - part * np.sqrt(1 - part**2)) @ weights / weights.sum()
    width = math.sqrt(fill_factor)
    mtf *= np.sinc(f * width * math.cos(slant)) * np.sinc(f * width * math.sin(slant))
    assert found.mtf50 == pytest.approx(np.interp(-0.5, -mtf, f), rel=0.01)
    assert np.abs(found.mtf.numpy() - mtf)[f < 0.5].max() < 0.01


def test_without_a_lens_the_mtf_is_that_of_the_pixel() -> None:
    assert A.edge_response(Camera.ideal()).mtf50 == pytest.approx(0.6034 / math.cos(math.radians(5)), rel=0.01)
    assert A.edge_response(Camera.ideal(), whole=True).mtf50 == pytest.approx(0.6057, rel=0.01)


def noisy(full_well: float, read: float, bits: int | None = None) -> Camera:
    adc = [] if bits is None else [sensor.ADC(bits=bits, black_level=64)]
    return Camera(sensor.ColourFilter.nikon(), sensor.Mosaic(), sensor.Exposure(),
                  sensor.ShotNoise(full_well=full_well), sensor.ReadNoise(read), *adc, isp.Demosaic(),
                  isp.WhiteBalance(), isp.ColourMatrix(), isp.ToneCurve())  # fmt: skip


@pytest.mark.parametrize("seed", range(4))
def test_snr_and_dynamic_range_are_their_closed_forms(seed: int) -> None:
    draw = random.Random(seed)
    well, read = draw.uniform(2e3, 5e4), draw.uniform(2, 8)
    camera = noisy(well, read, bits=None if seed % 2 else 12)
    found = A.signal_to_noise(camera, [0.01, 0.1, 0.5], seed=seed)
    step = 0.0 if seed % 2 else well / (2**12 - 1)
    full = well - 64 * step  # what the converter holds above black
    for share, electrons, snr in zip(found.exposures, found.electrons, found.snr, strict=True):
        mean = float(share) * full
        assert float(electrons) == pytest.approx(mean, rel=0.01)
        assert float(snr) == pytest.approx(mean / math.sqrt(mean + read**2 + step**2 / 12), rel=0.03)
    if step:
        assert A.dynamic_range(camera).ratio == pytest.approx(full / math.hypot(read, step / math.sqrt(12)), rel=0.03)


def test_delta_e_is_that_of_colour_science() -> None:
    colour = pytest.importorskip("colour")
    for found in A.colour_error(Camera.phone()):
        labs = [
            colour.XYZ_to_Lab(colour.RGB_to_XYZ(rgb.numpy(), "sRGB"), colour.CCS_ILLUMINANTS["cie_2_1931"]["D65"])
            for rgb in (found.wanted, found.got)
        ]
        theirs = colour.delta_E(*labs, method="CIE 2000")
        assert found.mean == pytest.approx(theirs.mean(), rel=0.01)


def test_the_wanted_colours_are_the_chart_adapted_by_colour_science() -> None:
    colour = pytest.importorskip("colour")
    grid = Camera.ideal().resolve().wavelengths
    weights = spectral.xyz_weights(grid, "A")
    xyz = (spectral.reflectances(grid) @ weights).numpy()
    daylight = spectral.xyz_weights(grid, "D65").sum(0).numpy()
    adapted = colour.adaptation.chromatic_adaptation_VonKries(xyz, weights.sum(0).numpy(), daylight, "Bradford")
    wanted = A.colour_error(Camera.ideal(), ["A"])[0].wanted.numpy()
    np.testing.assert_allclose(wanted, adapted @ spectral.xyz_to_srgb_matrix().numpy().T, atol=2e-4)


@pytest.mark.parametrize("shape", [(33, 48), (64, 64)])
def test_noise_power_keeps_the_variance_and_knows_white_from_blurred(shape: tuple[int, int]) -> None:
    noise = 0.3 * torch.randn(16, *shape, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    found = A.noise_power_spectrum(noise, pixel_pitch=2 * um)
    assert found.variance == pytest.approx(float(noise.var((1, 2), correction=0).mean()), rel=1e-9)
    assert float(found.radial.mean()) == pytest.approx(0.09 * (2 * um) ** 2, rel=0.03)
    blurred = A.noise_power_spectrum((noise + noise.roll(1, 2)) / 2, pixel_pitch=2 * um)
    wanted = found.power * torch.cos(math.pi * found.fx * 2 * um) ** 2
    assert torch.allclose(blurred.power, wanted, atol=1e-3 * float(found.power.max()))


def test_a_report_says_what_is_missing_and_why(tmp_path: Path) -> None:
    found = A.report(Camera.ideal(), name="ideal")
    assert {"dynamic range", "noise power", "shading", "distortion", "PSFs"} == found.missing.keys()
    found.save(tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    assert "not measured" in page
    assert "<script" not in page
    assert "http" not in page
    values = json.loads(found.to_json(tmp_path / "report.json"))
    assert values["colour"][0]["mean"] == pytest.approx(found.colour[0].mean)  # type: ignore[index]


@pytest.mark.parametrize("stages", [[], [sensor.ADC(bits=8)], [sensor.Mosaic("RGGB")]])
def test_any_camera_gets_a_report(stages: list) -> None:
    assert A.report(Camera(*stages)).table()


def test_the_command_writes_the_page(tmp_path: Path) -> None:
    said = run("report", "ideal", "--out", tmp_path / "a.html", "--json", tmp_path / "a.json")
    assert "MTF50" in said
    assert "Shading: not measured, " in said  # and why
    helped = " ".join(run("report", "--help").split())
    assert all(name in helped for name in (*PRESETS, "singlet"))
    assert (tmp_path / "a.html").stat().st_size > 10_000
    assert json.loads((tmp_path / "a.json").read_text())["name"] == "ideal"
    assert "expected e.g. --size 3000x4000" in fails("report", "ideal", "--size", "big", "--out", tmp_path / "b.html")
    assert "unknown camera" in fails("report", "nocam", "--out", tmp_path / "b.html")
