"""The pupil of a real lens, seen from one point of the image: wavefront and clearances over direction cosines.

    W(dx, dy) = sum_ij w_ij T_2i(u) T_j(v),   q_s(dx, dy) likewise,   u = dx / a, v = (dy - m_0) / b

fitted to exact rays. In the direction cosines towards the sensor the Fourier kernel is straight at every field angle,
and a uniform radiance is uniform, so that illumination is an area. Light passes where every clearance q is above 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from kcam.optics.pupil.rim import edge_profile

DEGREES = (12, 16, 20)
"""Of the polynomials, even in dx: 49, 81 or 121 terms. The first whose residual is small enough is taken."""
ENOUGH = 2e-4  # of a wavelength: what a fit of a wavefront may leave (rms)
_FEWEST = 12  # rays that pass
_LESS = 12.0  # exponent of the weight for a clearance below 0
_BEYOND = 1.12  # of the stop's radius, to which rays are sent
_RINGS, _SPOKES = 21, 49


@dataclass(frozen=True)
class PupilFit:
    """Pupils of N nodes as polynomials.

    degree: of the polynomials. centre (N,), half_width (N, 2): of the direction cosine dy, of dx and dy, in which they
    are. middle, reach (N,): dy of the middle of what is open, and half the square around that. wavefront: coefficients
    (N, T) [m]. clearances: (N, S, T). chief: where the chief ray lands, (N,) [m]. residual: rms of the fit of the
    wavefront within the open part, (N,) [m].
    """

    degree: int
    centre: Tensor
    half_width: Tensor
    middle: Tensor
    reach: Tensor
    wavefront: Tensor
    clearances: Tensor
    chief: Tensor
    residual: Tensor

    def at(self, node: int, dx: Tensor, dy: Tensor) -> tuple[Tensor, Tensor]:
        """Wavefront (...) [m] and clearances (S, ...) at direction cosines of one node's meridional plane."""
        a, b = self.half_width[node]
        along, across = _chebyshev(dx / a, self.degree)[::2], _chebyshev((dy - self.centre[node]) / b, self.degree)
        table = torch.cat([self.wavefront[node][None], self.clearances[node]])
        full = table.new_zeros(len(table), self.degree + 1, self.degree // 2 + 1)
        rows, columns = _orders(self.degree)
        full[:, rows, columns] = table
        values = torch.einsum("sji,j...,i...->s...", full, across, along)
        # beyond the rays nothing is known, and nothing open
        inside = 1 - (dx / a) ** 2 - ((dy - self.centre[node]) / b) ** 2
        return values[0], torch.cat([values[1:], inside[None]])


def rays_over_stop(device: torch.device) -> tuple[Tensor, Tensor]:
    """Coordinates x >= 0, y in a disc a little larger than 1, (R,) each: rings at Chebyshev radii, all spokes."""
    k = torch.arange(_RINGS, dtype=torch.float64, device=device)
    radius = _BEYOND * torch.cos((2 * k + 1) / (4 * _RINGS) * math.pi)
    angle = torch.linspace(0, math.pi, _SPOKES, dtype=torch.float64, device=device)
    x, y = radius[:, None] * angle.sin(), radius[:, None] * angle.cos()
    return x.flatten().clamp(min=0), y.flatten()


def _orders(degree: int) -> tuple[Tensor, Tensor]:
    """Order in v, and half the order in u, of each term."""
    pairs = [(j, i) for i in range(degree // 2 + 1) for j in range(degree + 1 - 2 * i)]
    rows, columns = zip(*pairs, strict=True)
    return torch.tensor(rows), torch.tensor(columns)


def _chebyshev(v: Tensor, degree: int) -> Tensor:
    """T_0 .. T_degree of values, (degree + 1, ...)."""
    terms = [torch.ones_like(v), v]
    while len(terms) <= degree:
        terms.append(2 * v * terms[-1] - terms[-2])
    return torch.stack(terms)


def fit(
    dx: Tensor, dy: Tensor, wavefront: Tensor, clearances: Tensor, alive: Tensor, chief: Tensor, *, enough: float
) -> PupilFit:
    """Least squares over rays (N, R); clearances (N, S, R). enough: residual of the wavefront [m].

    Rays that no light follows count less the farther outside they are, but they do: beyond its data a polynomial may
    be anything, a clearance above 0 too.
    Raises: ValueError for a node that too few rays pass.
    """
    with torch.no_grad():
        least = torch.where(alive, clearances.amin(1), -1.0)
        passed = (least > 0).sum(1)
        if int(passed.min()) < _FEWEST:
            raise ValueError(
                f"only {int(passed.min())} of {dx.shape[1]} rays of a point pass this lens, too few to know its pupil. "
                "Is the field too wide, or a semi_diameter too small?"
            )
        weights = torch.exp(_LESS * least.clamp(max=0)).clamp(min=1e-3) * alive
        limits = [_extent(part, where) for where in (alive, least > -0.03) for part in (dx.abs(), dy)]
        half = torch.stack([limits[0][1], (limits[1][1] - limits[1][0]) / 2], dim=1).clamp(min=1e-9)
        centre = (limits[1][1] + limits[1][0]) / 2
        middle = (limits[3][1] + limits[3][0]) / 2
        reach = torch.maximum(limits[2][1], (limits[3][1] - limits[3][0]) / 2)
        others = least[:, None].expand_as(clearances)  # surfaces that clip nothing that the rest lets pass are left out
        clips = ((clearances <= others + 1e-12) & (others < 0.02) & (others > -0.3)).any(0).any(1)
    clearances = clearances[:, clips]
    for degree in DEGREES:
        rows, columns = _orders(degree)
        u, v = dx / half[:, :1], (dy - centre[:, None]) / half[:, 1:]
        terms = (_chebyshev(v, degree)[rows] * _chebyshev(u, degree)[::2][columns]).movedim(0, -1)
        data = torch.cat([wavefront[:, None], clearances], dim=1).mT
        q, r = torch.linalg.qr(terms * weights[..., None])
        found = torch.linalg.solve_triangular(r, q.mT @ (data * weights[..., None]), upper=True)  # (N, T, 1 + S)
        with torch.no_grad():
            off = (terms @ found[..., :1])[..., 0] - data[..., 0]
            residual = ((off**2 * (least > 0)).sum(1) / passed).sqrt()
        fitted = PupilFit(degree, centre, half, middle, reach, found[..., 0], found[..., 1:].mT, chief, residual)
        if float(residual.max()) <= enough:
            break
    return fitted


def _extent(values: Tensor, where: Tensor) -> tuple[Tensor, Tensor]:
    """Least and largest of some values in each row."""
    return torch.where(where, values, math.inf).amin(1), torch.where(where, values, -math.inf).amax(1)


def opening(clearances: Tensor, *, spacing: float) -> Tensor:
    """Quadrature weights of what passes at the points of a grid, (A, B): 1 inside, 0 outside, and low-passed between.

    An edge is straight as far as the low-pass reaches, some samples; 1 - sqrt(1 - q) is nearly the distance from it.
    """
    passed = torch.ones_like(clearances[0])
    for q in clearances:
        depth = q / (1 + torch.sqrt((1 - q).clamp(min=0)))
        slope = torch.stack(torch.gradient(depth, spacing=spacing)).square().sum(0).clamp(min=1e-18).sqrt()
        passed = passed * edge_profile(depth / (spacing * slope))
    return passed
