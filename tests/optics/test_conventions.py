"""Signs, axes and centring: the page of conventions in `kcam/units.py`, pinned."""

from __future__ import annotations

import math

import pytest
import torch

from kcam import optics
from kcam.optics import PROPAGATORS
from kcam.scene import Scene
from kcam.units import mm, nm, um

WAVELENGTH = 550 * nm
PITCH = 4 * um
TILT = 12.0  # pixels that the tilted elements move the PSF by
DIAMETER, FOCAL = 2 * mm, 40 * mm
SLOPE = TILT * PITCH / FOCAL  # OPD per metre of pupil


def lens(*others: optics.Element) -> optics.Lens:
    return optics.Lens(optics.CircularAperture(DIAMETER), optics.ThinLens(FOCAL), *others, sensor_distance=FOCAL)


def ramp(n: int, axis: str) -> torch.Tensor:
    """Phase map of `n` pixels over the aperture whose OPD rises by SLOPE towards +x (columns) or +y (rows)."""
    centres = (torch.arange(n, dtype=torch.float64) - (n - 1) / 2) * (DIAMETER / n)
    phase = 2 * math.pi / WAVELENGTH * SLOPE * centres
    return phase.expand(n, n) if axis == "x" else phase[:, None].expand(n, n)


def tilted(kind: str, axis: str) -> optics.Lens:
    if kind == "DOE":
        return lens(optics.DOE(ramp(400, axis), design_wavelength=WAVELENGTH, glass=1.5))
    if kind == "wrapped DOE":
        return lens(optics.DOE(torch.remainder(ramp(400, axis), 2 * math.pi), design_wavelength=WAVELENGTH, glass=1.5))
    # Noll's Z2 = 2 x / a and Z3 = 2 y / a, with an RMS of 1
    coefficients = torch.zeros(3, dtype=torch.float64)
    coefficients[1 if axis == "x" else 2] = SLOPE * DIAMETER / 4
    if kind == "aberration":
        return lens(optics.ZernikeAberration(coefficients))
    return lens(optics.ZernikeDOE(coefficients * 2 * math.pi / WAVELENGTH, design_wavelength=WAVELENGTH, glass=1.5))


def centroid(psf: torch.Tensor) -> tuple[float, float]:
    """(row, column) relative to index n // 2, of the light above a tenth of the peak."""
    psf = torch.where(psf > 0.1 * psf.max(), psf, 0.0).double()
    rows, columns = (torch.arange(n, dtype=torch.float64) - n // 2 for n in psf.shape)
    return float((psf.sum(1) * rows).sum() / psf.sum()), float((psf.sum(0) * columns).sum() / psf.sum())


def image(
    lens: optics.Lens, shape: tuple[int, int] = (65, 65), distance: float = math.inf, **arguments
) -> torch.Tensor:
    return lens.psf([WAVELENGTH], distances=distance, pixel_pitch=PITCH, shape=shape, **arguments)[0, 0].detach()


@pytest.mark.parametrize("axis", ["x", "y"])
@pytest.mark.parametrize("kind", ["DOE", "wrapped DOE", "ZernikeDOE", "aberration"])
@pytest.mark.parametrize("propagator", ["nonparaxial", "fresnel", "angular_spectrum", "reference"])
def test_an_opd_that_rises_to_x_moves_the_psf_to_x(kind: str, axis: str, propagator: str) -> None:
    row, column = centroid(image(tilted(kind, axis), propagator=propagator))
    along, across = (column, row) if axis == "x" else (row, column)
    # the angular spectrum looks flat pixels up where its own samples fall: half a sample in 400 tilts it by 0.05
    assert along == pytest.approx(TILT, abs=0.1 if propagator == "angular_spectrum" else 0.02)
    assert across == pytest.approx(0, abs=0.02)


@pytest.mark.parametrize("axis", ["x", "y"])
@pytest.mark.parametrize("kind", ["ZernikeDOE", "aberration"])
def test_rays_go_the_same_way(kind: str, axis: str) -> None:
    row, column = centroid(image(tilted(kind, axis), propagator="geometric"))
    assert (column, row) == pytest.approx((TILT, 0) if axis == "x" else (0, TILT), abs=1e-6)


@pytest.mark.parametrize("method", ["matrix", "chirp_z", "fft"])
def test_every_transform_goes_the_same_way(method: str) -> None:
    row, column = centroid(image(tilted("ZernikeDOE", "x"), method=method))
    assert (row, column) == pytest.approx((0, TILT), abs=0.02)


@pytest.mark.parametrize("shape", [(33, 33), (32, 32), (32, 33), (1, 33), (33, 2)])
@pytest.mark.parametrize("propagator", list(PROPAGATORS), ids="-".join)
def test_the_origin_is_at_n_over_2(propagator: tuple[str, str], shape: tuple[int, int]) -> None:
    physics, method = propagator
    psf = image(lens(), shape, propagator=physics, method=method, dtype=torch.float64)
    peak = divmod(int(psf.argmax()), shape[1])
    assert peak == (shape[0] // 2, shape[1] // 2)
    big = image(lens(), (35, 35), propagator=physics, method=method, dtype=torch.float64)
    rows, columns = (slice(17 - n // 2, 17 - n // 2 + n) for n in shape)
    # an even window is the crop of an odd one, to what the sampling for another window changes
    assert (psf - big[rows, columns]).abs().max() < 1e-4 * big.max()
    if min(shape) > 30:
        assert centroid(psf) == pytest.approx((0, 0), abs=1e-3)  # a registration by half a pixel would be 0.5


def test_an_aperture_map_has_x_along_columns_and_y_down_rows() -> None:
    # far out of focus on the near side, the image of the pupil is upright: 1/z > 0 pushes +x rays further to +x
    mask = torch.zeros(4, 4, dtype=torch.float64)
    mask[0, 3] = 1  # top right: -y, +x
    aperture = optics.ApertureMap(mask, width=4 * mm)
    near = optics.Lens(aperture, optics.ThinLens(FOCAL), focus_distance=math.inf)
    for propagator in ("nonparaxial", "fresnel", "angular_spectrum", "geometric"):
        row, column = centroid(image(near, (129, 129), distance=1.0, propagator=propagator))
        # the open square's centre is at (1.5, -1.5) mm: x = d / z * 1.5 mm = 60 um = 15 pixels
        assert column == pytest.approx(15, abs=0.3)
        assert row == pytest.approx(-15, abs=0.3)


def test_a_positive_vergence_is_a_nearer_object_and_a_delay_at_the_rim() -> None:
    near = image(lens(), distance=0.8, dtype=torch.float64, propagator="fresnel")
    assert torch.allclose(
        image(lens(optics.Defocus(1.25)), dtype=torch.float64, propagator="fresnel"), near, atol=1e-12
    )
    # Noll's Z4 = sqrt(3) (2 rho^2 - 1): OPD = V r^2 / 2 = V a^2 / 2 rho^2
    coefficients = torch.zeros(4, dtype=torch.float64)
    coefficients[3] = 1.25 * (DIAMETER / 2) ** 2 / (4 * math.sqrt(3))
    same = image(lens(optics.ZernikeAberration(coefficients)), dtype=torch.float64, propagator="fresnel")
    assert (same - near).abs().sum() < 2e-4 * near.sum()  # another transform: this lens is not symmetric by its type


def test_a_coma_flare_has_a_side() -> None:
    # Noll's Z8 = sqrt(8) (3 rho^3 - 2 rho) cos(theta): its rim, where most of the light is, throws rays to +x
    coefficients = torch.zeros(8, dtype=torch.float64)
    coefficients[7] = 200 * nm
    psf = image(lens(optics.ZernikeAberration(coefficients)), dtype=torch.float64)
    geometric = image(lens(optics.ZernikeAberration(coefficients)), propagator="geometric", dtype=torch.float64)
    columns = torch.arange(65, dtype=torch.float64) - 32
    skewness = [float((image.sum(0) * columns**3).sum()) for image in (psf, geometric)]
    assert skewness[0] > 0
    assert skewness[1] > 0
    assert torch.allclose(psf, psf.flip(0), atol=1e-9)  # about y = 0 nothing is preferred


def test_pixel_maps_are_not_transposed_nor_mirrored() -> None:
    # four glass wedges in the quadrants: each throws its quarter of the light its own way
    n = 200
    x = ((torch.arange(n, dtype=torch.float64) - (n - 1) / 2) * DIAMETER / n).expand(n, n)
    y = x.T
    wave = 2 * math.pi / WAVELENGTH
    upper_right = (x > 0) & (y < 0)
    phase = torch.where(upper_right, wave * PITCH / FOCAL * (20 * x + 5 * y), 0.0)
    psf = image(lens(optics.DOE(phase, design_wavelength=WAVELENGTH, glass=1.5)), (65, 65), dtype=torch.float64)
    moved = psf.clone()
    moved[22:43, 22:43] = 0  # the three plain quadrants stay in the middle
    row, column = centroid(moved)
    assert (row, column) == pytest.approx((5, 20), abs=1)


# ---- the picture -------------------------------------------------------------------------------------------------


def point(at: tuple[int, int], shape: tuple[int, int] = (48, 40)) -> Scene:
    bands = torch.zeros(1, 1, *shape, dtype=torch.float64)
    bands[0, 0, at[0], at[1]] = 1
    return Scene.from_bands(bands, wavelengths=torch.tensor([WAVELENGTH]), depth=math.inf)


@pytest.mark.parametrize("axis", ["x", "y"])
@pytest.mark.parametrize("kind", ["DOE", "ZernikeDOE"])
@pytest.mark.parametrize("at", [(24, 20), (30, 15)])
def test_in_the_upright_picture_the_psf_is_turned_by_180_degrees(kind: str, axis: str, at: tuple[int, int]) -> None:
    imaging = optics.Imaging(tilted(kind, axis), pixel_pitch=PITCH, border="zero")
    picture = imaging(point(at))[0, 0]
    row, column = (c + n // 2 for c, n in zip(centroid(picture), picture.shape, strict=True))
    shift = (0, -TILT) if axis == "x" else (-TILT, 0)
    assert (row - at[0], column - at[1]) == pytest.approx(shift, abs=0.03)


@pytest.mark.parametrize("psf_shape", [(9, 9), (8, 8), (9, 8), (51, 51)])
def test_a_point_shows_the_psf_turned_by_180_degrees(psf_shape: tuple[int, int]) -> None:
    doe = optics.DOE(torch.rand(30, 30, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 4)
    imaging = optics.Imaging(lens(doe), pixel_pitch=PITCH, psf_shape=psf_shape, border="zero")
    psf = image(lens(doe), psf_shape, dtype=torch.float64)
    picture = imaging(point((25, 19)))[0, 0]
    expected = torch.zeros(48 + 200, 40 + 200, dtype=torch.float64)
    h, w = psf_shape
    # the origin h // 2 turns to h - 1 - h // 2
    top, left = 25 - (h - 1 - h // 2) + 100, 19 - (w - 1 - w // 2) + 100
    expected[top : top + h, left : left + w] = psf.flip(0, 1)
    assert torch.allclose(picture, expected[100:148, 100:140], atol=1e-12)


def test_a_symmetric_lens_does_not_move_the_picture() -> None:
    for at in ((0, 0), (47, 39), (20, 11)):
        picture = optics.Imaging(lens(), pixel_pitch=PITCH, border="zero")(point(at))[0, 0]
        assert divmod(int(picture.argmax()), 40) == at
