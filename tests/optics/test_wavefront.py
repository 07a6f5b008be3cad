"""Wavefronts from elsewhere: a map of a lens's own aberrations is that lens, whatever wrote it."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from draws import Draw
from torch import Tensor, nn

from kcam import Camera, Scene, isp, optics, sensor
from kcam.optics.elements import zernike_sum
from kcam.optics.pupil.coordinates import Pupil
from kcam.units import mm, nm, um, wavelength_grid

DOUBLE = torch.float64
BANDS = [450e-9, 550e-9, 650e-9]
WHERE = {"distances": [1.9], "pixel_pitch": 2 * um, "shape": (33, 33), "dtype": DOUBLE}


def map_of(coefficients: Tensor, side: Tensor) -> Tensor:
    """Zernikes on a square grid of normalised coordinates (n,), (n, n) [m]."""
    one = torch.ones((), dtype=DOUBLE)
    return zernike_sum(coefficients, Pupil(side[None, :], side[:, None], one, one, paraxial=True))


def centres(count: int) -> Tensor:
    return (torch.arange(count, dtype=DOUBLE) - (count - 1) / 2) * (2 / count)


def ideal(*elements: optics.Element, diameter: float = 5 * mm) -> optics.Lens:
    return optics.Lens(optics.CircularAperture(diameter), optics.ThinLens(50 * mm), *elements, focus_distance=2.0)


def apart(one: Tensor, other: Tensor) -> float:
    """L1 of the worst PSF, of its light."""
    return float(((one - other).abs().sum((-2, -1)) / other.sum((-2, -1))).max())


def random_aberrations(draw: Draw, terms: int = 11) -> Tensor:
    return 40 * nm * (2 * draw.noise(terms) - 1)


@pytest.mark.parametrize(
    ("propagator", "count", "allowed"),
    [
        ("nonparaxial", 64, 1e-4),
        ("fresnel", 33, 1e-4),
        pytest.param("angular_spectrum", 64, 1e-5, marks=pytest.mark.slow),
        ("geometric", 128, 1e-4),
        pytest.param("reference", 64, 1e-5, marks=pytest.mark.slow),
        pytest.param("reference", 256, 1e-7, marks=pytest.mark.slow),
    ],
)
@pytest.mark.parametrize("seed", range(2))
def test_a_map_of_zernikes_is_the_zernikes(propagator: str, count: int, allowed: float, seed: int) -> None:
    draw = Draw(seed)
    coefficients, width = random_aberrations(draw), draw.number(5, 7) * mm
    opd = map_of(coefficients, centres(count) * width / (5 * mm))
    radius = centres(count).square()[:, None] + centres(count).square()
    opd[radius.sqrt() * width > 5 * mm] = math.nan  # an interferometer sees nothing beyond the rim
    found = ideal(optics.MeasuredPupil(opd, width=width)).psf(BANDS, propagator=propagator, **WHERE)
    exact = ideal(optics.ZernikeAberration(coefficients)).psf(BANDS, propagator=propagator, **WHERE)
    assert apart(found, exact) < allowed * (10 if width > 5.5 * mm else 1)


SLOW = pytest.param("angular_spectrum", marks=pytest.mark.slow)


@pytest.mark.parametrize("aperture", [optics.SquareAperture(4 * mm), optics.CircularAperture(4 * mm)])
@pytest.mark.parametrize("propagator", ["nonparaxial", "fresnel", SLOW, "geometric"])
def test_an_amplitude_dims_as_a_map_of_the_aperture_does(aperture: optics.Element, propagator: str) -> None:
    transmission = Draw(3).noise(8, 8)
    flat = torch.zeros(8, 8, dtype=DOUBLE)
    where = WHERE | {"propagator": propagator, "distances": [2.4]}
    glass = optics.ThinLens(40 * mm)
    pupil = optics.MeasuredPupil(flat, amplitude=transmission, width=4 * mm)
    lens = optics.Lens(aperture, glass, pupil, focus_distance=2.0)
    if isinstance(aperture, optics.CircularAperture):  # a disc of many pixels is nearly that
        fine = 256 if propagator == "angular_spectrum" else 128
        side = centres(fine)
        disc = (side.square()[:, None] + side.square() <= 1).double()
        whole = transmission.repeat_interleave(fine // 8, 0).repeat_interleave(fine // 8, 1) * disc
        other, allowed = optics.ApertureMap(whole, width=4 * mm), 2e-2
    else:
        other, allowed = optics.ApertureMap(transmission, width=4 * mm), 1e-6
    exact = optics.Lens(other, glass, focus_distance=2.0)
    assert apart(lens.psf(BANDS, **where), exact.psf(BANDS, **where)) < allowed
    assert lens.aperture_area() == pytest.approx(exact.aperture_area(), rel=1e-3 + allowed / 2)


def test_between_wavelengths_the_path_is_linear_and_outside_an_error() -> None:
    maps = torch.stack([map_of(random_aberrations(Draw(seed)), centres(48)) for seed in (1, 2)])
    pupil = optics.MeasuredPupil(maps.flip(0), width=5 * mm, wavelengths=[650e-9, 450e-9])
    mean = optics.MeasuredPupil(0.25 * maps[0] + 0.75 * maps[1], width=5 * mm)
    found, exact = (ideal(one).psf([600e-9], **WHERE) for one in (pupil, mean))
    assert apart(found, exact) < 1e-10
    for wavelength in (440e-9, 660e-9):
        with pytest.raises(ValueError, match=r"measured from 450 to 650 nm"):
            ideal(pupil).psf([wavelength], **WHERE)
    one = optics.MeasuredPupil(maps[:1], width=5 * mm, wavelengths=[550e-9])
    assert torch.isfinite(ideal(one).psf([550e-9], **WHERE)).all()
    with pytest.raises(ValueError, match=r"measured from 550 to 550 nm"):
        ideal(one).psf([500e-9], **WHERE)


def test_maps_train() -> None:
    opd = nn.Parameter(map_of(random_aberrations(Draw(5)), centres(6)))
    amplitude = nn.Parameter(0.2 + 0.6 * Draw(6).noise(5, 5))
    lens = ideal(optics.MeasuredPupil(opd, amplitude=amplitude, width=5 * mm))
    where = WHERE | {"shape": (5, 4), "samples": 64}
    weights = Draw(7).noise(1, 1, 5, 4)

    def loss() -> Tensor:
        return (lens.psf([550e-9], **where) * weights).sum()

    gradients = torch.autograd.grad(loss(), (opd, amplitude))
    for parameter, gradient, step in zip((opd, amplitude), gradients, (1e-11, 1e-4), strict=True):
        direction = Draw(8).noise(*parameter.shape) - 0.5
        with torch.no_grad():
            ends = []
            for sign in (1, -1):
                parameter += sign * step * direction
                ends.append(float(loss()))
                parameter -= sign * step * direction
        assert float((gradient * direction).sum()) == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-5)


def test_a_camera_with_one_is_saved(tmp_path: Path) -> None:
    pupil = optics.MeasuredPupil(
        torch.stack([map_of(random_aberrations(Draw(seed)), centres(16)) for seed in (1, 2)]),
        amplitude=Draw(3).noise(4, 4),
        width=5 * mm,
        wavelengths=[400e-9, 730e-9],
    )
    scene = Scene.from_bands(Draw(4).noise(1, 5, 12, 12).float(), wavelengths=wavelength_grid(count=5), depth=1.7)
    camera = Camera(optics.Imaging(ideal(pupil)), sensor.ColourFilter.kodak(), isp.ToneCurve())
    camera.save(tmp_path / "camera.safetensors")
    assert torch.equal(Camera.load(tmp_path / "camera.safetensors")(scene), camera(scene))


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"opd": torch.zeros(5, 6)}, ValueError, r"opd must be \(n, n\), n >= 4, got \(5, 6\)"),
        ({"opd": torch.zeros(2, 6, 6)}, ValueError, r"opd must be \(n, n\)"),
        ({"opd": torch.zeros(3, 3)}, ValueError, "n >= 4"),
        ({"opd": torch.zeros(6, 6, dtype=torch.int64)}, TypeError, "floating-point"),
        ({"opd": torch.full((6, 6), math.nan)}, ValueError, "NaN everywhere"),
        ({"opd": torch.full((6, 6), math.inf)}, ValueError, "infinite somewhere"),
        ({"opd": torch.full((6, 6), 20.0)}, ValueError, r"20 m, and is in metres: nanometres \* nm"),
        ({"opd": nn.Parameter(torch.full((6, 6), math.nan))}, ValueError, "Parameter with NaN"),
        ({"opd": torch.zeros(2, 6, 6), "wavelengths": BANDS}, ValueError, r"\(3, n, n\), one for each wavelength"),
        ({"opd": torch.zeros(2, 6, 6), "wavelengths": [5e-7, 5e-7]}, ValueError, "holds a wavelength twice"),
        ({"opd": torch.zeros(1, 6, 6), "wavelengths": [550.0]}, ValueError, "metres"),
        ({"width": 5.0 * 1e3}, ValueError, r"width 5000 is outside"),
        ({"amplitude": torch.full((4, 4), 2.0)}, ValueError, r"amplitude must be in \[0, 1\]"),
        ({"amplitude": torch.zeros(4, 4)}, ValueError, "let light pass"),
        ({"amplitude": torch.full((4, 4), math.nan)}, ValueError, "NaN"),
    ],
)
def test_bad_maps_are_refused(arguments: dict, error: type[Exception], message: str) -> None:
    given = {"opd": torch.zeros(6, 6), "width": 5 * mm} | arguments
    with pytest.raises(error, match=message):
        optics.MeasuredPupil(given.pop("opd"), **given)


# ---- Zemax -----------------------------------------------------------------------------------------------------------


def zemax(
    waves: np.ndarray, *, encoding: str = "utf-16", newline: str = "\r\n", centre: str = "Col {0}, Row {1}"
) -> bytes:
    n = len(waves)
    lines = [
        "Listing of Wavefront Map Data", "", "File : C:\\lens.zmx", "Title: ", "Date : 11/23/2026", "",
        "Wavefront Function", "0.5500 \xb5m at 0.00, 0.00 (deg)", "Peak to valley = 0.2500 waves, RMS = 0.0500 waves.",
        "Surface: Image", "Exit Pupil Diameter: 5.0000E+000 Millimeters", "",
        f"Pupil grid size: {n} by {n}", "Center point is: " + centre.format(n // 2 + 1, n // 2 + 1), "",
        *("\t".join(f"{value:.15E}" for value in row) for row in waves),
    ]  # fmt: skip
    return "\r\n".join(lines).encode(encoding)


def zemax_waves(coefficients: Tensor, count: int, *, steps: int) -> np.ndarray:
    """As Zemax samples a pupil: `steps` samples from the centre, which is sample count // 2, to the rim."""
    side = (torch.arange(count, dtype=DOUBLE) - count // 2) / steps
    waves = map_of(coefficients, side) / 550e-9
    return torch.where(side.square()[:, None] + side.square() <= 1, waves, 0).numpy()


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "latin-1"])
@pytest.mark.parametrize(("count", "steps"), [(64, 31), (64, 32), (33, 16), (32, 15)])
def test_a_zemax_map_is_the_lens_that_it_was_written_of(count: int, steps: int, encoding: str, tmp_path: Path) -> None:
    coefficients = random_aberrations(Draw(count))
    waves = zemax_waves(coefficients, count, steps=steps)
    upside = encoding == "latin-1" and steps == 31  # from +y down: the empty row comes last
    path = tmp_path / "map.txt"
    centre = "{0}, {1}" if upside else "Col {0}, Row {1}"
    path.write_bytes(zemax(waves[::-1] if upside else waves, encoding=encoding, centre=centre))
    pupil = optics.MeasuredPupil.from_zemax(path)
    assert pupil.width == pytest.approx(5 * mm)
    assert pupil.amplitude is None
    exact = ideal(optics.ZernikeAberration(coefficients)).psf(BANDS, **WHERE)
    assert apart(ideal(pupil).psf(BANDS, **WHERE), exact) < 2e-3


def test_a_perfect_wavefront_is_flat(tmp_path: Path) -> None:
    (tmp_path / "map.txt").write_bytes(zemax(np.zeros((32, 32))))
    pupil = optics.MeasuredPupil.from_zemax(tmp_path / "map.txt")
    assert pupil.amplitude is None
    assert not bool(pupil.opd.any())


def test_what_zemax_found_dark_is_dark(tmp_path: Path) -> None:
    waves = zemax_waves(random_aberrations(Draw(1)), 64, steps=31)
    side = np.arange(64) - 32
    obscured = np.hypot(side[:, None], side) < 9
    waves[obscured] = 0
    (tmp_path / "map.txt").write_bytes(zemax(waves))
    pupil = optics.MeasuredPupil.from_zemax(tmp_path / "map.txt")
    lens = ideal(pupil)
    assert lens.aperture_area() == pytest.approx(math.pi * (2.5 * mm) ** 2 * (1 - (9 / 31) ** 2), rel=0.02)
    assert not bool(torch.isnan(pupil.opd).any())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda held: b"no map", "is no Zemax"),
        (lambda held: held[: len(held) // 2], "expected 32 x 32"),
        (lambda held: held.replace(b"Exit Pupil", b"Enter Pupil"), "has no 'Exit Pupil Diameter'"),
        (lambda held: held.replace(b"m at", b"n at"), "has no wavelength"),
        (lambda held: held.replace(b"Center", b"Middle"), "has no 'Center point is"),
        (lambda held: held.replace(b"Millimeters", b"Furlongs"), "in Furlongs; known: millimeters"),
        (lambda held: held.replace(b"E+000\t", b"E+000\tx ", 1) if b"E+000\t" in held else held + b" x", "could not"),
        (lambda held: held.replace(b"32 by 32", b"33 by 32"), "expected 32 x 33"),
        (lambda held: b"", "is no Zemax"),
    ],
)
def test_damaged_files_are_refused(change, message: str, tmp_path: Path) -> None:
    path = tmp_path / "map.txt"
    path.write_bytes(change(zemax(zemax_waves(random_aberrations(Draw(1)), 32, steps=15), encoding="latin-1")))
    with pytest.raises(ValueError, match=message):
        optics.MeasuredPupil.from_zemax(path)
    with pytest.raises(FileNotFoundError, match="there is no file"):
        optics.MeasuredPupil.from_zemax(tmp_path / "other.txt")


@pytest.mark.parametrize("width", [50.0, 500.0])
def test_a_width_in_millimetres_is_told_as_such(width: float) -> None:
    with pytest.raises(ValueError, match=rf"did you mean {width:g} \* mm\?"):
        optics.MeasuredPupil(torch.zeros(8, 8), width=width)
