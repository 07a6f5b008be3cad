"""What even maps and parities save must change nothing."""

from __future__ import annotations

import math

import pytest
import torch
from torch import nn

from kcam import optics
from kcam.optics import PROPAGATORS
from kcam.optics.elements.zernike import zernike_sum
from kcam.optics.propagation import pixels, sampling
from kcam.optics.propagation.cells import Cells
from kcam.optics.propagation.pixels import Pixels, _Parities
from kcam.optics.propagation.transforms import MatrixTransform
from kcam.optics.pupil.coordinates import Pupil, from_image_side, grid_nodes
from kcam.optics.pupil.quadrants import by_x, join, join_adjoint, parities, split, unfold
from kcam.units import mm, nm, um

DOUBLE = torch.float64


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


# ---- quadrants -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [6, 7, 1, 2])
def test_quadrants_join_to_the_grid_that_they_were_split_from(size: int, generator: torch.Generator) -> None:
    grid = torch.randn(2, 3, size, size, generator=generator)
    assert torch.equal(join(split(grid), odd=size % 2 == 1), grid)


def test_quadrants_are_ordered_away_from_the_axis() -> None:
    grid = torch.arange(9.0).view(3, 3)  # x to the right, y downwards
    pp, pm, mp, mm = split(grid)
    assert pp.tolist() == [[4, 5], [7, 8]]
    assert pm.tolist() == [[4, 3], [7, 6]]
    assert mp.tolist() == [[4, 5], [1, 2]]
    assert mm.tolist() == [[4, 3], [1, 0]]


def test_an_unfolded_quadrant_is_even(generator: torch.Generator) -> None:
    quadrant = torch.randn(2, 4, 4, generator=generator)
    whole = unfold(quadrant)
    assert torch.equal(whole, whole.flip(-1))
    assert torch.equal(whole, whole.flip(-2))
    assert torch.equal(whole[:, 4:, 4:], quadrant)


@pytest.mark.parametrize("terms", [1, 4, 11, 28])
@pytest.mark.parametrize("paraxial", [True, False])
def test_zernikes_of_a_mirrored_pupil_are_those_of_the_whole(
    terms: int, paraxial: bool, generator: torch.Generator
) -> None:
    """Which are found in one quadrant, by what is odd in x and in y."""
    nodes, one = grid_nodes(12), torch.ones((), dtype=DOUBLE)
    coefficients = torch.randn(terms, generator=generator, dtype=DOUBLE, requires_grad=True)
    weights = torch.randn(12, 12, generator=generator, dtype=DOUBLE)
    found = []
    for along, mirror in ((nodes, False), (nodes[6:], True)):
        x, y = from_image_side(along[None, :], along[:, None], one * (not paraxial))
        pupil = Pupil(x, y, one, one, paraxial)
        value = zernike_sum(coefficients, pupil.mirrored() if mirror else pupil)
        whole = join(value if value.ndim == 3 else value.expand(4, -1, -1), odd=False) if mirror else value
        found.append((whole, torch.autograd.grad((whole * weights).sum(), coefficients)[0]))
    for part, other in zip(*found, strict=True):
        torch.testing.assert_close(part, other)


def test_an_element_sees_the_pupil_s_points_wherever_they_are(generator: torch.Generator) -> None:
    """A grid comes as its quadrants: what is odd, even, or the same for all, is found at each point."""
    nodes, one = grid_nodes(10), torch.ones((), dtype=DOUBLE)
    whole = Pupil(nodes[None, :], nodes[:, None], one, one, paraxial=False)
    mirrored = Pupil(nodes[5:][None, :], nodes[5:][:, None], one, one, paraxial=False).mirrored()
    shape = torch.randn(3, generator=generator, dtype=DOUBLE)
    for term in (
        lambda pupil: shape[0] * pupil.x + shape[1] * pupil.y * pupil.rho2,
        lambda pupil: shape[2] * pupil.x * pupil.y,
        lambda pupil: pupil.beyond_paraxial(shape[0]),
        lambda pupil: pupil.x.expand_as(pupil.rho2),
        lambda pupil: torch.where(pupil.y > 0.2, pupil.rho2, pupil.measure),
    ):
        found = term(mirrored)
        quadrants = found if found.ndim == 3 else found.expand(4, -1, -1)
        torch.testing.assert_close(join(quadrants, odd=False), term(whole).expand(10, 10))


@pytest.mark.parametrize(("rows", "columns"), [(5, 5), (7, 3), (1, 5)])
def test_joining_has_its_transpose(rows: int, columns: int, generator: torch.Generator) -> None:
    grid = torch.randn(2, rows, columns, generator=generator, dtype=DOUBLE)
    quadrants = torch.randn(2, 4, rows // 2 + 1, columns // 2 + 1, generator=generator, dtype=DOUBLE)
    assert torch.allclose((join(quadrants, odd=True) * grid).sum(), (quadrants * join_adjoint(grid)).sum())


def test_parities_are_their_own_inverse_and_stand_by_x_first(generator: torch.Generator) -> None:
    grid = torch.randn(1, 6, 6, generator=generator, dtype=DOUBLE)
    even_y, odd_x = grid + grid.flip(-2), grid - grid.flip(-1)
    quadrants = split(grid)
    parts = torch.empty(4, 1, 3, 3, dtype=DOUBLE)
    parities(by_x(quadrants), out=parts.unbind())
    assert torch.allclose(parts[0], (even_y + even_y.flip(-1))[:, 3:, 3:])
    assert torch.allclose(parts[2], (odd_x + odd_x.flip(-2))[:, 3:, 3:])  # odd in x, even in y
    again = torch.empty_like(quadrants)
    parities(parts.unbind(), out=by_x(again))
    assert torch.allclose(again, 4 * quadrants)


# ---- pixels --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("few", [0, 2**17])
@pytest.mark.parametrize("shape", [(9, 9), (8, 8), (7, 10), (1, 1), (2, 1)])
@pytest.mark.parametrize(("per_pixel", "active"), [(1.0, 1.0), (1.75, 1.0), (2.0, 0.7)])
def test_pixels_are_the_box_on_both_axes(
    shape: tuple[int, int],
    per_pixel: float,
    active: float,
    few: int,
    generator: torch.Generator,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(pixels, "_FEW", few)
    reach = math.ceil(per_pixel * (max(shape) // 2 + 3))
    image = torch.randn(2, 3, 2 * reach + 1, 2 * reach + 1, generator=generator, dtype=DOUBLE)
    rows, columns = (sampling.pixel_box(n, per_pixel=per_pixel, reach=reach, active=active) for n in shape)
    asked = Pixels(shape, per_pixel, active=active)
    assert torch.allclose(asked.of_image(image), rows @ image @ columns.mT, atol=1e-13)
    assert torch.allclose(asked.of_quadrants(split(image)), rows @ image @ columns.mT, atol=1e-13)
    even = image + image.flip(-1) + image.flip(-2) + image.flip(-2, -1)
    found = asked.of_quadrant(even[..., reach:, reach:])
    assert torch.allclose(found, rows @ even @ columns.mT, atol=1e-13)


@pytest.mark.parametrize("shape", [(5, 5), (4, 4), (3, 6)])
def test_points_are_the_values_at_the_pixels_centres(shape: tuple[int, int]) -> None:
    reach = max(shape) // 2
    image = torch.arange((2 * reach + 1) ** 2, dtype=DOUBLE).view(2 * reach + 1, -1)
    rows, columns = (slice(reach - n // 2, reach - n // 2 + n) for n in shape)
    asked = Pixels(shape, integrate=False)
    assert torch.equal(asked.of_image(image), image[rows, columns])
    assert torch.equal(asked.of_quadrants(split(image)), image[rows, columns])
    even = image + image.flip(0) + image.flip(1) + image.flip(0, 1)
    assert torch.equal(asked.of_quadrant(even[reach:, reach:]), even[rows, columns])


@pytest.mark.filterwarnings("ignore:.torch.jit.script:DeprecationWarning")  # torch's own forward mode loads it
def test_pixels_have_first_and_second_derivatives(generator: torch.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pixels, "_FEW", 0)
    quadrants = torch.randn(2, 4, 5, 5, generator=generator, dtype=DOUBLE, requires_grad=True)

    def squares(values: torch.Tensor) -> torch.Tensor:
        return Pixels((4, 3), 1.25).of_quadrants(values).square()

    assert torch.autograd.gradcheck(squares, quadrants, check_forward_ad=True)
    assert torch.autograd.gradgradcheck(squares, quadrants)
    total = torch.func.grad(lambda values: squares(values).sum())(quadrants)
    assert torch.allclose(total, torch.autograd.grad(squares(quadrants).sum(), quadrants)[0])


def test_sums_of_pixels_and_their_transpose(generator: torch.Generator) -> None:
    rows, columns = (torch.randn(2, n, 6, generator=generator, dtype=DOUBLE) for n in (4, 3))
    sums = _Parities(rows, columns, (6, 5))
    quadrants = torch.randn(2, 4, 6, 6, generator=generator, dtype=DOUBLE)
    image = torch.randn(2, 6, 5, generator=generator, dtype=DOUBLE)
    assert torch.allclose((sums.forward(quadrants) * image).sum(), (quadrants * sums.adjoint(image)).sum())


# ---- the matrix transform ------------------------------------------------------------------------------------------


def test_the_matrix_transform_is_the_sum_that_it_stands_for(generator: torch.Generator) -> None:
    nodes = (torch.arange(8, dtype=DOUBLE) - 3.5) / 4
    transform = MatrixTransform.build(nodes, scale=2e6, step=1e-6, reach=3, like=nodes)
    re, im, u_re, u_im = (torch.randn(2, n, n, generator=generator, dtype=DOUBLE) for n in (8, 8, 7, 7))
    points = torch.arange(-3, 4) * 1e-6
    angle = -2e6 * points[:, None] * nodes
    kernel = torch.complex(angle.cos(), angle.sin())
    truth = kernel @ torch.complex(re, im) @ kernel.T
    found = transform.forward((split(re), split(im)))
    assert torch.allclose(join(torch.complex(*found), odd=True), truth)
    truth = kernel.conj().T @ torch.complex(u_re, u_im) @ kernel.conj()
    found = transform.adjoint((join_adjoint(u_re), join_adjoint(u_im)))
    assert torch.allclose(join(torch.complex(*found), odd=False), truth)


# ---- lenses --------------------------------------------------------------------------------------------------------


def lens(*, aperture: optics.Aperture, doe: bool, distance: float | nn.Parameter | None = None) -> optics.Lens:
    elements = [aperture, optics.PlanoConvexLens(nn.Parameter(torch.tensor(25 * mm, dtype=DOUBLE)))]
    if doe:
        generator = torch.Generator().manual_seed(1)
        elements.append(optics.DOE(nn.Parameter(torch.randn(16, 16, generator=generator, dtype=DOUBLE))))
    focus = {"focus_distance": 2.0} if distance is None else {"sensor_distance": distance}
    return optics.Lens(*elements, **focus)


LENSES = {
    "round": lambda: lens(aperture=optics.CircularAperture(2 * mm), doe=False),
    "annular": lambda: lens(aperture=optics.AnnularAperture(2 * mm, obscuration=0.4), doe=False),
    "round and DOE": lambda: lens(aperture=optics.CircularAperture(2 * mm), doe=True),
    "square and DOE": lambda: lens(aperture=optics.SquareAperture(2 * mm), doe=True),
    "trained distance": lambda: lens(
        aperture=optics.CircularAperture(2 * mm), doe=True, distance=nn.Parameter(torch.tensor(48.5 * mm, dtype=DOUBLE))
    ),
}
ROWS = [("fresnel", "matrix"), ("nonparaxial", "matrix"), ("nonparaxial", "chirp_z"), ("nonparaxial", "fft")]


def psf_and_gradients(of: optics.Lens, row: tuple[str, str]) -> list[torch.Tensor]:
    asked = of.query(
        [480 * nm, 620 * nm],
        distances=torch.tensor([1.0, 2.0], dtype=DOUBLE),
        pixel_pitch=4 * um,
        shape=(13, 12),
        dtype=DOUBLE,
    )
    found = PROPAGATORS[row](asked)
    weights = torch.randn(found.shape, generator=torch.Generator().manual_seed(2), dtype=DOUBLE)
    return [found, *torch.autograd.grad((found * weights).sum(), list(of.parameters()))]


@pytest.mark.parametrize("row", ROWS, ids="-".join)
@pytest.mark.parametrize("which", LENSES)
def test_an_even_path_on_one_quadrant_is_the_same_as_on_the_whole_grid(
    which: str, row: tuple[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    of = LENSES[which]()
    assert of.even
    quarter = psf_and_gradients(of, row)
    monkeypatch.setattr(optics.Lens, "even", False)
    for a, b in zip(quarter, psf_and_gradients(of, row), strict=True):
        assert (a - b).abs().max() < 1e-10 * b.abs().max()


class Coma(optics.ThinLens):
    """Says nothing of its symmetry."""

    def terms(self, pupil, wavelengths):
        return [*super().terms(pupil, wavelengths), (torch.ones_like(wavelengths), 2e-7 * pupil.x * pupil.rho2)]


def test_what_tells_the_sides_apart_is_not_even() -> None:
    tilted = optics.ZernikeAberration(torch.zeros(3, dtype=DOUBLE))  # by its type: its gradient is not even
    patched = optics.DOE(torch.zeros(8, 8))
    patched.terms = lambda pupil, wavelengths: [(torch.ones_like(wavelengths), 2e-7 * pupil.x)]
    for element in (tilted, Coma(10.0), patched):
        of = optics.Lens(optics.CircularAperture(2 * mm), optics.ThinLens(50 * mm), element, focus_distance=2.0)
        assert not of.even
        assert not of.symmetric


def test_terms_of_its_own_are_symmetric_only_where_the_subclass_says_so() -> None:
    class Spherical(Coma):
        symmetric = True

    class Plain(optics.ThinLens):
        pass

    assert not Coma.symmetric
    assert Spherical.symmetric
    assert Plain.symmetric


@pytest.mark.parametrize("vergence", [0.0, -0.5, -10.0, -500.0, -1300.0, -20_000.0, math.nan])
def test_the_energy_that_passes_pixel_maps(vergence: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Against the sum over all cells, from infinity to a twentieth of the semi-aperture."""
    of, kept = lens(aperture=optics.SquareAperture(2 * mm), doe=True), []
    build = Cells.of
    monkeypatch.setattr(Cells, "of", lambda *a, **k: kept.append(build(*a, **k)) or kept[-1])
    of.psf([550 * nm], distances=2.0, pixel_pitch=4 * um, shape=(5, 5))
    cells, semi = kept[0], torch.tensor(1 * mm, dtype=DOUBLE)
    edges = cells.edges * semi
    x, area = (edges[1:] + edges[:-1]) / 2, edges.diff()[:, None] * edges.diff()
    for other in (0.0, -0.5):  # beside one that is far
        found = cells.energy(semi, torch.tensor([other, vergence], dtype=DOUBLE))
        for v, own in zip((other, vergence), found, strict=True):
            truth = (cells.power.double() * area / (1 + v**2 * (x[:, None] ** 2 + x**2))).sum()
            torch.testing.assert_close(own, truth, rtol=1e-6, atol=0.0, equal_nan=True)
