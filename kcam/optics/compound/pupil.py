"""The pupil of a real lens, seen from one point of the image: wavefront and clearances over direction cosines.

    W(dx, dy) = sum_ij w_ij T_2i(u) T_j(v),   q_s(dx, dy) likewise,   u = dx / a, v = (dy - c) / b

fitted to exact rays. In the direction cosines towards the sensor the Fourier kernel is straight at every field angle,
and a uniform radiance is uniform, so that illumination is an area. Light passes where every clearance q is above 0.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from kcam.optics.compound.aiming import Asked, nodes
from kcam.optics.compound.prescription import Prescription
from kcam.optics.numerics import chebyshev, chebyshev_points

DEGREES = (12, 16, 20)
"""Of the polynomials, even in dx: 49, 81 or 121 terms. The first whose residual is small enough is taken."""
ENOUGH = 2e-4  # of a wavelength: what a fit of a wavefront may leave (rms)
_FEWEST = 12  # rays that pass
_FEW_NODES = 4
_LESS = 12.0  # exponent of the weight for a clearance below 0
_FAR = -0.3  # clearance of rays that are left out: they may come from anywhere
_GRAZING = 0.1  # margin of rays that pass: beyond them others may end, which no clearance tells
_SOFT = 0.2  # of clearance, over which the edge of what is open is spread where its extent is taken
_EXTENT = 2.0  # times the standard deviation of what is open: the rim of an ellipse
_KNOWN = 1.15  # extents: rays are fitted, and pupils may be open, up to there
OVERFILL = 1.12  # of the stop's radius, to which rays are sent: seen from off the axis the stop is no ellipse
_RINGS, _SPOKES = 17, 41
_AIMING_EACH = 60  # steps at most, of a ray to its point of the stop: a phone's, on a steep stop, takes some 40


@dataclass(frozen=True)
class PupilFit:
    """Pupils of N nodes as polynomials.

    degree: of the polynomials. centre (N,): c; half_width (N, 2): a and b, about those of what is open. wavefront:
    coefficients (N, T) [m]. clearances: (N, S, T). chief: where the chief ray lands, (N,) [m]. residual: rms of the fit
    of the wavefront within the open part, (N,) [m].
    """

    degree: int
    centre: Tensor
    half_width: Tensor
    wavefront: Tensor
    clearances: Tensor
    chief: Tensor
    residual: Tensor

    @property
    def radius(self) -> Tensor:
        """The larger half width, (N,)."""
        return self.half_width.amax(1)

    def one(self, node: int) -> PupilFit:
        """One of the nodes, by itself."""
        parts = {name: value[node : node + 1] for name, value in vars(self).items() if name != "degree"}
        return PupilFit(self.degree, **parts)

    def at(self, node: int | Tensor, dx: Tensor, dy: Tensor) -> tuple[Tensor, Tensor]:
        """Wavefront (...) [m] and clearances (S + 1, ...) at direction cosines of one node's meridional plane; of nodes
        (n,) at dx, dy (n, ...): (n, ...) and (n, S + 1, ...).
        """
        if isinstance(node, int):
            wavefront, clearances = self.at(torch.tensor([node]), dx[None], dy[None])
            return wavefront[0], clearances[0]
        shape = (-1, *[1] * (dx.ndim - 1))
        a, b = (part.view(shape) for part in self.half_width[node].unbind(1))
        u, v = dx / a, (dy - self.centre[node].view(shape)) / b
        across, along = chebyshev(u, self.degree)[::2], chebyshev(v, self.degree)
        table = torch.cat([self.wavefront[node][:, None], self.clearances[node]], dim=1)
        full = table.new_zeros(*table.shape[:2], self.degree + 1, self.degree // 2 + 1)
        rows, columns = _orders(self.degree)
        full[:, :, rows, columns] = table
        values = torch.einsum("nsji,jn...,in...->ns...", full, along, across)
        # beyond the rays nothing is known, and nothing open
        inside = 1 - (u**2 + v**2) / _KNOWN**2
        return values[:, 0], torch.cat([values[:, 1:], inside[:, None]], dim=1)


def pupils(lens: Prescription, wavelengths: Tensor, vergences: Tensor, heights: Tensor) -> PupilFit:
    """Pupils of F x Z x L nodes: see `CompoundLens.pupils`."""
    found = nodes(lens, wavelengths, vergences, heights)
    x, y, area = _rays_over_stop(heights.device)
    rays, chief = found.beam.at_sensor(*found.towards(x, y)), found.chief
    wavefront = rays.path - rays.dx * rays.x - rays.dy * (rays.y - chief.y) - chief.path
    clearances = torch.stack([*rays.clearance, rays.margin], dim=-2)  # type: ignore[list-item]
    flat = [part.flatten(0, 2) for part in (rays.dx, rays.dy, wavefront, clearances, rays.alive, chief.y[..., 0])]
    return _fit(*flat, area=area, enough=ENOUGH * float(wavelengths.min()))


def opd(lens: Prescription, asked: Asked, samples: int) -> tuple[Tensor, Tensor]:
    """Wavefront over the stop in waves, and where light passes, (F, Z, L, S, S): see `CompoundLens.opd`."""
    found = nodes(lens, asked.wavelengths, asked.vergences, asked.heights)
    beam, chief, semi = found.beam, found.chief, lens.stop_semi_diameter
    side = torch.linspace(-1, 1, samples, dtype=torch.float64)
    x, y = (part.flatten() for part in torch.meshgrid(side, side, indexing="xy"))
    # the stop's own axes turn with the field
    cx, cy = (part[:, None, None, None] for part in asked.directions.unbind(1))
    to_x, to_y = semi * (x * cy - y * cx), semi * (x * cx + y * cy)
    with torch.no_grad():
        px, py = to_x / found.across, found.aim + to_y / found.along
        for _ in range(_AIMING_EACH):
            at = beam.at(lens.stop, px, py)
            off = torch.maximum((at.x - to_x).abs(), (at.y - to_y).abs()).masked_fill(~at.alive, 0.0)
            if float(off.max()) < 1e-13:
                break
            px, py = px - (at.x - to_x) / found.across, py - (at.y - to_y) / found.along
    rays = beam.at_sensor(px, py)
    away = lens.sensor_away - beam.first.exit_pupil
    radius = away.sign() * torch.sqrt(away**2 + chief.y**2)
    ox, oy = rays.x - chief.x, rays.y - chief.y
    onto = ox * rays.dx + oy * rays.dy
    back = onto + radius.sign() * torch.sqrt((onto**2 - ox**2 - oy**2 + radius**2).clamp(min=0))
    waves = (rays.path - back - chief.path + radius) / asked.wavelengths[:, None]
    clearances = torch.stack(rays.clearance, dim=-2)
    passes = rays.alive & (clearances > -1e-9).all(-2) & (x**2 + y**2 <= 1 + 1e-9)
    waves, passes = (part.expand(waves.shape).unflatten(-1, (samples, samples)) for part in (waves, passes))
    return waves, passes


def _rays_over_stop(device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """Coordinates x >= 0, y in a disc a little larger than 1, and the area that each stands for, up to a factor, (R,)
    each: rings at Chebyshev radii, all spokes.
    """
    share = chebyshev_points(2 * _RINGS)[:_RINGS].to(device)
    angle = torch.linspace(0, math.pi, _SPOKES, dtype=torch.float64, device=device)
    x, y = OVERFILL * share[:, None] * angle.sin(), OVERFILL * share[:, None] * angle.cos()
    area = (share * torch.sqrt(1 - share**2))[:, None].expand_as(x)
    return x.flatten().clamp(min=0), y.flatten(), area.flatten()


@functools.cache
def _orders(degree: int) -> tuple[Tensor, Tensor]:
    """Order in v, and half the order in u, of each term."""
    pairs = [(j, i) for i in range(degree // 2 + 1) for j in range(degree + 1 - 2 * i)]
    rows, columns = zip(*pairs, strict=True)
    return torch.tensor(rows), torch.tensor(columns)


def odd_terms(degree: int) -> Tensor:
    """Which terms change their sign with dy, (T,): they are odd in the height of the point too."""
    return _orders(degree)[0] % 2 == 1


def _fit(
    dx: Tensor,
    dy: Tensor,
    wavefront: Tensor,
    clearances: Tensor,
    alive: Tensor,
    chief: Tensor,
    *,
    area: Tensor,
    enough: float,
) -> PupilFit:
    """Least squares over rays (N, R); clearances (N, S, R), the last of them what falls to 0 where rays end. enough:
    residual of the wavefront [m].

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
        shares = torch.sigmoid(least / _SOFT) * area * alive
        shares = shares / shares.sum(1, keepdim=True)
        centre = (shares * dy).sum(1)
        square = torch.stack([dx**2, (dy - centre[:, None]) ** 2], dim=1)
        half = _EXTENT * (shares[:, None] * square).sum(2).sqrt().clamp(min=1e-9)
        others = least[:, None].expand_as(clearances)  # surfaces that clip nothing that the rest lets pass are left out
        clips = ((clearances <= others + 1e-12) & (others < 0.02) & (others > _FAR)).any(0).any(1)
        clips[-1] |= bool(((least > 0) & (clearances[:, -1] < _GRAZING)).any())
    u, v = dx / half[:, :1], (dy - centre[:, None]) / half[:, 1:]
    with torch.no_grad():
        weights = torch.exp(_LESS * least.clamp(max=0)) * (1 - least / _FAR).clamp(0, 1)
        weights = weights * (alive & (u**2 + v**2 < _KNOWN**2))
    data = torch.cat([wavefront[:, None], clearances[:, clips]], dim=1).mT

    def fitted(degree: int, own: Tensor | slice) -> tuple[Tensor, Tensor]:
        rows, columns = _orders(degree)
        terms = (chebyshev(v[own], degree)[rows] * chebyshev(u[own], degree)[::2][columns]).movedim(0, -1)
        q, r = torch.linalg.qr(terms * weights[own][..., None])
        found = torch.linalg.solve_triangular(r, q.mT @ (data[own] * weights[own][..., None]), upper=True)
        with torch.no_grad():
            off = (terms @ found[..., :1])[..., 0] - data[own][..., 0]
            return found, ((off**2 * (least[own] > 0)).sum(1) / passed[own]).sqrt()

    few = torch.linspace(0, len(dx) - 1, min(len(dx), _FEW_NODES)).long()  # tell of most degrees that they are too low
    for degree in DEGREES:
        last = degree == DEGREES[-1]
        if not last:
            with torch.no_grad():
                if float(fitted(degree, few)[1].max()) > enough:
                    continue
        found, residual = fitted(degree, slice(None))
        if last or float(residual.max()) <= enough:
            break
    return PupilFit(degree, centre, half, found[..., 0], found[..., 1:].mT, chief, residual)
