"""Independent reference computations for the tests, in float64, written from the physics and never importing kcam.

Closed forms (Airy, Lommel), quadratures of the diffraction integrals that converge spectrally (Fresnel and
Rayleigh-Sommerfeld), Zernike polynomials, and published refractive indices. Everything takes and gives numpy arrays.

**Conventions.** SI units; exp(-i omega t), so light along +z gains exp(+ikz) and a delay is a positive OPD; an OPD that
rises towards +x moves the light towards +x. Pupil coordinates (u, v), sensor coordinates (x, y), y down the rows.
Every intensity is |U|^2 per metre^2 of the sensor divided by the energy that passes the aperture: its integral over
the sensor plane is 1, and times the pixel area it is the share of the light that a (small) pixel gets.

**Two kinds of OPD.** A *residual* OPD is what is left of source + elements + propagation in the paraxial model, 0 in
focus (`fresnel_opd`). An *element* OPD is the whole path that the thin elements add (`plano_convex_opd`,
`thin_lens_opd`): the Rayleigh-Sommerfeld functions add the exact source and propagation paths themselves.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from scipy import interpolate, special

Array = NDArray[np.float64]
OPD = Callable[[Array, Array], Array]  # (u, v) [m] -> optical path [m]
Nodes = tuple[Array, Array, Array]  # quadrature nodes u, v [m] and weights [m^2]

NM = 1e-9
CHUNK = 2_000_000  # complex exponentials formed at a time: 16 MB per array


# --------------------------------------------------------------------------------------------------------- closed forms
def jinc(v: ArrayLike) -> Array:
    """2 J1(v) / v, with its limit 1 at v = 0."""
    v = np.asarray(v, dtype=np.float64)
    return np.where(v == 0, 1.0, 2 * special.j1(v) / np.where(v == 0, 1.0, v))


def airy(
    x: ArrayLike, y: ArrayLike, *, wavelength: float, aperture_radius: float, sensor_distance: float,
    obscuration: float = 0.0,
) -> Array:  # fmt: skip
    """Intensity in focus of an ideal circular pupil, or of an annulus with `obscuration` = inner / outer radius.

    I = A / (lambda d)^2 [ (jinc(v) - e^2 jinc(e v)) / (1 - e^2) ]^2, v = k a r / d, A the open area.
    Returns:   [1/m^2], integral over the plane 1.
    Source:    Airy; Born & Wolf, Principles of Optics, 8.5.2 (14) and 8.6.2 (the annulus).
    """
    v = 2 * math.pi * aperture_radius / (wavelength * sensor_distance) * np.hypot(x, y)
    area = math.pi * aperture_radius**2 * (1 - obscuration**2)
    amplitude = (jinc(v) - obscuration**2 * jinc(obscuration * v)) / (1 - obscuration**2)
    return area / (wavelength * sensor_distance) ** 2 * amplitude**2


def airy_encircled_energy(
    radius: ArrayLike, *, wavelength: float, aperture_radius: float, sensor_distance: float
) -> Array:
    """Share of an Airy pattern's light within `radius`: 1 - J0(v)^2 - J1(v)^2 (Rayleigh; Born & Wolf 8.5.2 (18))."""
    v = 2 * math.pi * aperture_radius / (wavelength * sensor_distance) * np.asarray(radius, dtype=np.float64)
    return 1 - special.j0(v) ** 2 - special.j1(v) ** 2


def airy_square_energy(
    half_width: float, *, wavelength: float, aperture_radius: float, sensor_distance: float, order: int = 200
) -> float:
    """Share of an Airy pattern's light in the centred square |x|, |y| < half_width.

    E = (4 / pi) INT_0^{pi/4} EE(half_width / cos phi) dphi: the encircled energy along the square's edge, by symmetry.
    """
    node, weight = np.polynomial.legendre.leggauss(order)
    phi = math.pi / 8 * (node + 1)
    edge = airy_encircled_energy(
        half_width / np.cos(phi),
        wavelength=wavelength, aperture_radius=aperture_radius, sensor_distance=sensor_distance,
    )  # fmt: skip
    return float(0.5 * np.sum(weight * edge))


def square_pupil(x: ArrayLike, y: ArrayLike, *, wavelength: float, half_width: float, sensor_distance: float) -> Array:
    """Intensity in focus of a square pupil of side 2 * half_width: A / (lambda d)^2 sinc^2 sinc^2 [1/m^2]."""
    side = 2 * half_width
    scale = side / (wavelength * sensor_distance)
    return scale**2 * np.sinc(scale * np.asarray(x)) ** 2 * np.sinc(scale * np.asarray(y)) ** 2


def circular_mtf(frequency: ArrayLike, *, wavelength: float, aperture_radius: float, sensor_distance: float) -> Array:
    """Diffraction-limited MTF of a circular pupil, (2/pi)(acos s - s sqrt(1 - s^2)), s = frequency * lambda d / 2a."""
    s = np.abs(np.asarray(frequency, dtype=np.float64)) * wavelength * sensor_distance / (2 * aperture_radius)
    s = np.minimum(s, 1.0)
    return 2 / math.pi * (np.arccos(s) - s * np.sqrt(1 - s**2))


def lommel(r: ArrayLike, *, defocus: float, wavelength: float, aperture_radius: float, sensor_distance: float) -> Array:
    """Intensity of a defocused ideal circular pupil by the Lommel series, in its two regions and at focus.

    Residual OPD defocus * rho^2, rho = r / a; u = 2 k defocus, v = k a r / d.
    I = I0 (2/u)^2 (U1^2 + U2^2), and inside the geometric shadow's edge (v < |u|)
    I = I0 (2/u)^2 [ 1 + V0^2 + V1^2 - 2 V0 cos((u + v^2/u)/2) - 2 V1 sin((u + v^2/u)/2) ].
    Args:      defocus: W20, the OPD at the aperture's edge, either sign [m].
    Returns:   [1/m^2], integral over the plane 1.
    Source:    Lommel 1885; Born & Wolf, Principles of Optics, 8.8.1 (17)-(26).
    """
    k = 2 * math.pi / wavelength
    v = np.atleast_1d(np.abs(np.asarray(r, dtype=np.float64))) * k * aperture_radius / sensor_distance
    u = abs(2 * k * defocus)  # |U|^2 is even in the defocus
    peak = math.pi * aperture_radius**2 / (wavelength * sensor_distance) ** 2
    if u < 1:
        # (u/v)^n J_n(v) = (u/2)^n 0F1(n+1; -v^2/4) / n!, so that neither u = 0 nor v = 0 is a division
        terms = [(u / 2) ** (n - 1) / math.factorial(n) * special.hyp0f1(n + 1, -(v**2) / 4) for n in range(1, 19)]
        first, second = (sum((-1) ** s * term for s, term in enumerate(terms[start::2])) for start in (0, 1))
        return (peak * (first**2 + second**2)).reshape(np.shape(r))

    def series(ratio: Array, at: Array, n: int) -> Array:
        # a term is below 1e-18 once its power of the ratio is, or once the order has passed the argument
        with np.errstate(divide="ignore"):
            needed = np.minimum(-42 / np.log(ratio), at + 12 * np.cbrt(at) + 40)
        last = int(needed.max()) if at.size else 0
        return sum(
            ((-1) ** s * ratio ** (n + 2 * s) * special.jv(n + 2 * s, at) for s in range(last // 2 + 1)),
            np.zeros_like(at),
        )

    intensity = np.empty_like(v)
    outside = v >= u
    at = v[outside]
    intensity[outside] = series(u / at, at, 1) ** 2 + series(u / at, at, 2) ** 2
    at = v[~outside]
    v0, v1 = series(at / u, at, 0), series(at / u, at, 1)
    angle = (u + at**2 / u) / 2
    intensity[~outside] = 1 + v0**2 + v1**2 - 2 * v0 * np.cos(angle) - 2 * v1 * np.sin(angle)
    return (peak * (2 / u) ** 2 * intensity).reshape(np.shape(r))


# ---------------------------------------------------------------------------------------------------------------- paths
def fresnel_opd(
    *, index: float, radius_of_curvature: float, distance: float, sensor_distance: float, extra: OPD | None = None
) -> OPD:
    """Residual OPD of a plano-convex lens in the paraxial model: exact spherical sag, parabolic source and propagation.

    W = V r^2 / 2 - (n-1) r^4 / (2 R (R + sqrt(R^2 - r^2))^2), V = 1/z + 1/d - (n-1)/R.
    Args:      distance: object distance z, inf allowed [m]. extra: another element's OPD, added [m].
    """
    vergence = 1 / distance + 1 / sensor_distance - (index - 1) / radius_of_curvature

    def opd(u: Array, v: Array) -> Array:
        r2 = u**2 + v**2
        sag = np.sqrt(radius_of_curvature**2 - r2)
        sphere = (index - 1) * r2**2 / (2 * radius_of_curvature * (radius_of_curvature + sag) ** 2)
        return vergence * r2 / 2 - sphere + (0 if extra is None else extra(u, v))

    return opd


def defocus_opd(*, vergence: float, extra: OPD | None = None) -> OPD:
    """Residual OPD of an ideal (paraxial) lens: vergence * r^2 / 2, vergence = 1/z + 1/d - 1/f."""
    return lambda u, v: vergence * (u**2 + v**2) / 2 + (0 if extra is None else extra(u, v))


def plano_convex_opd(*, index: float, radius_of_curvature: float, extra: OPD | None = None) -> OPD:
    """Element OPD of a thin plano-convex lens, (n-1)(sqrt(R^2 - r^2) - R), in the form that does not cancel."""

    def opd(u: Array, v: Array) -> Array:
        r2 = u**2 + v**2
        lens = -(index - 1) * r2 / (radius_of_curvature + np.sqrt(radius_of_curvature**2 - r2))
        return lens + (0 if extra is None else extra(u, v))

    return opd


def thin_lens_opd(*, focal_length: float, extra: OPD | None = None) -> OPD:
    """Element OPD of the parabolic thin lens, -r^2 / 2f."""
    return lambda u, v: -(u**2 + v**2) / (2 * focal_length) + (0 if extra is None else extra(u, v))


def noll_indices(j: int) -> tuple[int, int]:
    """(n, m) of Noll's Zernike number j >= 1; m > 0 is the cosine, m < 0 the sine (R. J. Noll, JOSA 66, 207, 1976)."""
    if j < 1:
        raise ValueError(f"Noll's numbers start at 1 (piston), got {j}.")
    n = 0
    while (n + 1) * (n + 2) // 2 < j:
        n += 1
    # within degree n the orders |m| rise in steps of 2, each pair ordered so that even j is the cosine
    k = j - n * (n + 1) // 2
    m = 2 * ((k + n % 2) // 2) - n % 2 if n % 2 == 0 else 2 * ((k - 1) // 2) + 1
    return n, m if j % 2 == 0 else -m


def noll_zernike(j: int, rho: ArrayLike, theta: ArrayLike) -> Array:
    """Noll's Zernike polynomial j: RMS 1 over the unit disc, mean 0 but for j = 1; theta from +x towards +y.

    Z = sqrt(n+1) R_n^|m|(rho) * (1 | sqrt(2) cos(m theta) | sqrt(2) sin(|m| theta)).
    Source:    R. J. Noll, JOSA 66, 207 (1976); R by Jacobi polynomials (Born & Wolf 9.2.1).
    """
    n, m = noll_indices(j)
    rho, theta = np.asarray(rho, dtype=np.float64), np.asarray(theta, dtype=np.float64)
    order = abs(m)
    half = (n - order) // 2
    radial = (-1) ** half * rho**order * special.eval_jacobi(half, order, 0, 1 - 2 * rho**2)
    angular = 1.0 if m == 0 else math.sqrt(2) * (np.cos(order * theta) if m > 0 else np.sin(order * theta))
    return math.sqrt(n + 1) * radial * angular


def zernike_opd(coefficients: dict[int, float], *, aperture_radius: float) -> OPD:
    """OPD sum_j c_j Z_j over the aperture, from {Noll number: RMS OPD [m]}."""

    def opd(u: Array, v: Array) -> Array:
        rho, theta = np.hypot(u, v) / aperture_radius, np.arctan2(v, u)
        return sum((c * noll_zernike(j, rho, theta) for j, c in coefficients.items()), np.zeros_like(rho))

    return opd


# ----------------------------------------------------------------------------------------------------------- quadrature
def polar_nodes(*, aperture_radius: float, radial: int, angular: int, inner_radius: float = 0.0) -> Nodes:
    """Gauss-Legendre in r by the trapezium in angle, for a disc or annulus: spectrally accurate if smooth."""
    node, weight = np.polynomial.legendre.leggauss(radial)
    r = inner_radius + (aperture_radius - inner_radius) * (node + 1) / 2
    ring = weight * (aperture_radius - inner_radius) / 2 * r * 2 * math.pi / angular
    theta = 2 * math.pi * np.arange(angular) / angular
    u, v = np.outer(r, np.cos(theta)), np.outer(r, np.sin(theta))
    return u.ravel(), v.ravel(), np.repeat(ring, angular)


def rectangle_nodes(*, half_width: float, half_height: float, order: int) -> Nodes:
    """Gauss-Legendre product nodes of a centred rectangular aperture."""
    node, weight = np.polynomial.legendre.leggauss(order)
    u, v = np.meshgrid(half_width * node, half_height * node)
    return u.ravel(), v.ravel(), (half_width * half_height * np.outer(weight, weight)).ravel()


def pixel_map_nodes(
    shape: tuple[int, int], *, pitch: float, aperture_radius: float | None, order: int, edge_order: int = 8
) -> tuple[Nodes, NDArray[np.int64]]:
    """Nodes that integrate exactly (to high order) over each flat pixel of a centred map, cut by the circular aperture.

    Whole pixels take order x order Gauss-Legendre nodes. A pixel that the circle cuts is split in x where the circle
    meets its sides, and each part integrated over x and over the open part of y: no staircase, no supersampling error.
    Args:      shape: (rows, columns); the map spans +-shape * pitch / 2. aperture_radius: None for the whole map [m].
    Returns:   the nodes, and for each the flat index of its pixel.
    """
    rows, columns = shape
    x0 = (np.arange(columns) - columns / 2) * pitch
    y0 = (np.arange(rows) - rows / 2) * pitch
    x0, y0 = (grid.ravel() for grid in np.meshgrid(x0, y0))
    index = np.arange(rows * columns)
    if aperture_radius is None:
        aperture_radius = math.inf
    elif 2 * aperture_radius > pitch * min(rows, columns) * (1 + 1e-12):
        raise ValueError(f"the aperture of radius {aperture_radius} m is larger than the map of {shape} x {pitch} m.")
    near = np.hypot(np.maximum(np.maximum(x0, -x0 - pitch), 0), np.maximum(np.maximum(y0, -y0 - pitch), 0))
    far = np.hypot(np.maximum(np.abs(x0), np.abs(x0 + pitch)), np.maximum(np.abs(y0), np.abs(y0 + pitch)))
    whole, cut = far <= aperture_radius, (near < aperture_radius) & (far > aperture_radius)

    node, weight = np.polynomial.legendre.leggauss(order)
    du, dv = (grid.ravel() for grid in np.meshgrid(pitch * (node + 1) / 2, pitch * (node + 1) / 2))
    dw = (pitch**2 / 4 * np.outer(weight, weight)).ravel()
    parts = [
        (x0[whole, None] + du, y0[whole, None] + dv, np.broadcast_to(dw, (whole.sum(), dw.size)), index[whole, None])
    ]
    if cut.any():
        left, bottom, which = x0[cut, None], y0[cut, None], index[cut, None]
        crossings = [np.sqrt(np.maximum(aperture_radius**2 - side**2, 0)) for side in (bottom, bottom + pitch)]
        rim = np.full_like(left, aperture_radius)
        breaks = np.concatenate([left, left + pitch, *crossings, *(-c for c in crossings), rim, -rim], axis=1)
        breaks = np.sort(np.clip(breaks, left, left + pitch), axis=1)
        start, width = breaks[:, :-1, None], np.diff(breaks, axis=1)[:, :, None]
        node, weight = np.polynomial.legendre.leggauss(edge_order)
        u = start + width * (node + 1) / 2
        chord = np.sqrt(np.maximum(aperture_radius**2 - u**2, 0))
        low = np.maximum(bottom[:, :, None], -chord)
        height = np.maximum(np.minimum(bottom[:, :, None] + pitch, chord) - low, 0)
        v = low[..., None] + height[..., None] * (node + 1) / 2
        w = (width * weight / 2 * height)[..., None] * weight / 2
        used = w > 0
        u, which = np.broadcast_to(u[..., None], w.shape), np.broadcast_to(which[:, :, None, None], w.shape)
        parts.append((u[used], v[used], w[used], which[used]))
    u, v, w, index = (np.concatenate([np.broadcast_to(p[i], p[0].shape).ravel() for p in parts]) for i in range(4))
    return (u, v, w), index


def _sum_over_nodes(points: Array, nodes: Nodes, kernel: Callable[..., tuple[torch.Tensor, torch.Tensor]]) -> Array:
    """|sum_j w_j amplitude_pj exp(i phase_pj)|^2 for each point, a chunk of nodes and points at a time."""
    real, imaginary = np.zeros(len(points)), np.zeros(len(points))
    count = nodes[0].size
    step = max(1, min(count, CHUNK))
    rows = max(1, CHUNK // step)
    for first in range(0, count, step):
        part = slice(first, first + step)
        for row in range(0, len(points), rows):
            here = slice(row, row + rows)
            x, y = (torch.from_numpy(points[here, i].copy())[:, None] for i in range(2))
            weight, phase = kernel(x, y, part)
            real[here] += torch.sum(weight * torch.cos(phase), dim=1).numpy()
            imaginary[here] += torch.sum(weight * torch.sin(phase), dim=1).numpy()
    return real**2 + imaginary**2


def _as_points(points: ArrayLike) -> Array:
    points = np.ascontiguousarray(np.asarray(points, dtype=np.float64))
    if points.ndim != 2 or points.shape[1] != 2:
        raise ValueError(f"points must be (P, 2) sensor coordinates [m], got shape {points.shape}.")
    return points


def fresnel_sum(points: ArrayLike, *, nodes: Nodes, opd: Array, sensor_distance: float, wavelength: float) -> Array:
    """Fresnel intensity at the points from quadrature nodes over the open aperture and their residual OPD [1/m^2].

    U = 1 / (lambda d sqrt(A)) SUM_j w_j exp(ik W_j) exp(-ik (x u_j + y v_j) / d), A = SUM_j w_j the open area.
    """
    k = 2 * math.pi / wavelength
    u, v, w, phase = (torch.from_numpy(np.ascontiguousarray(a)) for a in (*nodes, k * opd))
    u, v = u * (k / sensor_distance), v * (k / sensor_distance)

    def kernel(x: torch.Tensor, y: torch.Tensor, part: slice) -> tuple[torch.Tensor, torch.Tensor]:
        return w[part], phase[part] - x * u[part] - y * v[part]

    scale = 1 / ((wavelength * sensor_distance) ** 2 * float(w.sum()))
    return scale * _sum_over_nodes(_as_points(points), nodes, kernel)


def rayleigh_sommerfeld_sum(
    points: ArrayLike, *, nodes: Nodes, element_opd: Array, sensor_distance: float, wavelength: float,
    source_distance: float = math.inf,
) -> Array:  # fmt: skip
    """Rayleigh-Sommerfeld I intensity at the points from an on-axis point source through thin elements [1/m^2].

    U(x) = 1/(i lambda) INT U0 exp(ikR)/R (d/R)(1 + i/(kR)) du, U0 = z/R0 exp(ik (R0 - z + element OPD)),
    R0 and R the exact distances to the source and to the point; divided by the energy INT |U0|^2 du. Phases are formed
    relative to the axis by difference formulas, R - d = |x-u|^2 / (R + d), so nothing cancels.
    Source:    Goodman, Introduction to Fourier Optics, 3.4 (RS-I); the i/(kR) term is kept.
    """
    k, d = 2 * math.pi / wavelength, sensor_distance
    vergence = 1 / source_distance
    u, v, w = nodes
    r2 = u**2 + v**2
    slant = np.sqrt(1 + vergence**2 * r2)  # R0 / z
    phase = torch.from_numpy(k * (vergence * r2 / (1 + slant) + element_opd))
    weight = torch.from_numpy(w / slant)
    energy = float(np.sum(w / slant**2))
    u, v = torch.from_numpy(np.ascontiguousarray(u)), torch.from_numpy(np.ascontiguousarray(v))

    def kernel(x: torch.Tensor, y: torch.Tensor, part: slice) -> tuple[torch.Tensor, torch.Tensor]:
        squared = (x - u[part]) ** 2 + (y - v[part]) ** 2
        distance = torch.sqrt(squared + d * d)
        # 1 + i/(kR) = its modulus times the phase atan(1/(kR)), which is 1e-6 rad at 50 mm: two terms give all digits
        near = 1 / (k * distance)
        amplitude = weight[part] * d / distance**2 * torch.sqrt(1 + near**2)
        return amplitude, phase[part] + k * squared / (distance + d) + near - near**3 / 3

    return _sum_over_nodes(_as_points(points), nodes, kernel) / (wavelength**2 * energy)


def debye_sum(
    points: ArrayLike, *, nodes: Nodes, element_opd: Array, sensor_distance: float, wavelength: float,
    source_distance: float = math.inf,
) -> Array:  # fmt: skip
    """`rayleigh_sommerfeld_sum` in the Debye approximation: R0 - x u / R0 for R, d / R0^2 for the amplitude."""
    k, d = 2 * math.pi / wavelength, sensor_distance
    vergence = 1 / source_distance
    u, v, w = nodes
    r2 = u**2 + v**2
    slant, far = np.sqrt(1 + vergence**2 * r2), np.sqrt(d**2 + r2)
    phase = torch.from_numpy(k * (vergence * r2 / (1 + slant) + element_opd + r2 / (far + d)))
    weight = torch.from_numpy(w / slant * d / far**2)
    energy = float(np.sum(w / slant**2))
    u, v = torch.from_numpy(k * u / far), torch.from_numpy(k * v / far)

    def kernel(x: torch.Tensor, y: torch.Tensor, part: slice) -> tuple[torch.Tensor, torch.Tensor]:
        return weight[part] + 0 * x, phase[part] - x * u[part] - y * v[part]

    return _sum_over_nodes(_as_points(points), nodes, kernel) / (wavelength**2 * energy)


def _node_counts(opd_waves: Array, fringe_waves: float) -> tuple[int, int]:
    """Radial and angular nodes for a residual sampled on (radius, angle) [waves] and k a x / d / 2pi = fringe_waves.

    Over the radius Gauss-Legendre needs pi / 2 nodes per wave of path in the limit; over the angle the trapezium needs
    one per harmonic, up to 2 pi times the largest path change per radian. Both with a margin of a quarter and some.
    """
    along = float(np.abs(np.diff(opd_waves, axis=0)).sum(axis=0).max())
    around = float(np.abs(np.diff(opd_waves, axis=1)).max()) * opd_waves.shape[1]  # waves per turn, at the worst angle
    radial = math.pi / 2 * 1.25 * (along + fringe_waves) + 40
    angular = 1.25 * (around + 2 * math.pi * fringe_waves) + 48
    return 8 * math.ceil(radial / 8), 8 * math.ceil(angular / 8)


def _probe(opd: OPD, *, aperture_radius: float, inner_radius: float) -> Array:
    r = np.linspace(inner_radius, aperture_radius, 257)[:, None]
    theta = np.linspace(0, 2 * math.pi, 721)[None]
    return opd(r * np.cos(theta), r * np.sin(theta))


def fresnel_polar(
    points: ArrayLike, *, aperture_radius: float, sensor_distance: float, wavelength: float, opd: OPD,
    inner_radius: float = 0.0, radial_nodes: int | None = None, angular_nodes: int | None = None,
) -> Array:  # fmt: skip
    """Fresnel intensity of a circular (or annular) aperture with any smooth residual OPD, at points (P, 2) [1/m^2].

    Args:      opd: residual OPD (u, v) -> [m]. radial_nodes, angular_nodes: None takes them from the OPD's slope.
    """
    points = _as_points(points)
    fringe = aperture_radius * float(np.hypot(*points.T).max()) / (wavelength * sensor_distance)
    probe = _probe(opd, aperture_radius=aperture_radius, inner_radius=inner_radius) / wavelength
    radial, angular = _node_counts(probe, fringe)
    nodes = polar_nodes(
        aperture_radius=aperture_radius, inner_radius=inner_radius,
        radial=radial_nodes or radial, angular=angular_nodes or angular,
    )  # fmt: skip
    path = np.broadcast_to(opd(nodes[0], nodes[1]), nodes[0].shape)
    return fresnel_sum(points, nodes=nodes, opd=path, sensor_distance=sensor_distance, wavelength=wavelength)


def fresnel_image(
    x: ArrayLike, y: ArrayLike, *, aperture_radius: float, sensor_distance: float, wavelength: float, opd: OPD,
    inner_radius: float = 0.0, radial_nodes: int | None = None, angular_nodes: int | None = None,
) -> Array:  # fmt: skip
    """`fresnel_polar` on the grid y (M,) by x (N,): the kernel separates, so 297 x 297 points take 2 s."""
    x, y = (np.atleast_1d(np.asarray(a, dtype=np.float64)) for a in (x, y))
    fringe = aperture_radius * math.hypot(np.abs(x).max(), np.abs(y).max()) / (wavelength * sensor_distance)
    probe = _probe(opd, aperture_radius=aperture_radius, inner_radius=inner_radius) / wavelength
    radial, angular = _node_counts(probe, fringe)
    u, v, w = polar_nodes(
        aperture_radius=aperture_radius, inner_radius=inner_radius,
        radial=radial_nodes or radial, angular=angular_nodes or angular,
    )  # fmt: skip
    k = 2 * math.pi / wavelength
    phase = torch.from_numpy(k * np.broadcast_to(opd(u, v), u.shape))
    u, v, w = (torch.from_numpy(a) for a in (u, v, w))
    field = torch.zeros(y.size, x.size, dtype=torch.complex128)
    step = max(1, CHUNK // max(x.size, y.size))
    for first in range(0, u.numel(), step):
        part = slice(first, first + step)
        down = -k / sensor_distance * torch.outer(torch.from_numpy(y), v[part])
        across = phase[part] - k / sensor_distance * torch.outer(torch.from_numpy(x), u[part])
        column = torch.complex(torch.cos(down), torch.sin(down))  # 5 times faster than torch.exp of a complex
        row = torch.complex(w[part] * torch.cos(across), w[part] * torch.sin(across))
        field += column @ row.T
    intensity = field.real**2 + field.imag**2
    return (intensity / ((wavelength * sensor_distance) ** 2 * float(w.sum()))).numpy()


def fresnel_radial(
    r: ArrayLike, *, aperture_radius: float, sensor_distance: float, wavelength: float, opd: OPD,
    inner_radius: float = 0.0, radial_nodes: int | None = None,
) -> Array:  # fmt: skip
    """Fresnel intensity at radii r of a rotationally symmetric residual OPD: a Hankel quadrature [1/m^2]."""
    radius = np.atleast_1d(np.asarray(r, dtype=np.float64))
    probe = _probe(opd, aperture_radius=aperture_radius, inner_radius=inner_radius)[:, :2] / wavelength
    count, _ = _node_counts(probe, aperture_radius * float(np.abs(radius).max()) / (wavelength * sensor_distance))
    node, weight = np.polynomial.legendre.leggauss(radial_nodes or count)
    rho = inner_radius + (aperture_radius - inner_radius) * (node + 1) / 2
    w = 2 * math.pi * rho * weight * (aperture_radius - inner_radius) / 2
    k = 2 * math.pi / wavelength
    pupil = w * np.exp(1j * k * opd(rho, np.zeros_like(rho)))
    field = special.j0(k / sensor_distance * np.multiply.outer(radius, rho)) @ pupil
    area = math.pi * (aperture_radius**2 - inner_radius**2)
    return (np.abs(field) ** 2 / ((wavelength * sensor_distance) ** 2 * area)).reshape(np.shape(r))


def rayleigh_sommerfeld(
    points: ArrayLike, *, aperture_radius: float, sensor_distance: float, wavelength: float, element_opd: OPD,
    source_distance: float = math.inf, inner_radius: float = 0.0, symmetric: bool = False,
    radial_nodes: int | None = None, angular_nodes: int | None = None,
) -> Array:  # fmt: skip
    """Rayleigh-Sommerfeld I intensity of a circular aperture at points (P, 2); see `rayleigh_sommerfeld_sum` [1/m^2].

    Args:      element_opd: the whole path of the thin elements, not the residual [m].
               symmetric: the elements are rotationally symmetric: points turn onto +x and half the angles suffice.
    """
    points = _as_points(points)
    distance = np.hypot(*points.T)
    fringe = aperture_radius * float(distance.max()) / (wavelength * sensor_distance)
    residual = _residual(element_opd, sensor_distance=sensor_distance, source_distance=source_distance)
    probe = _probe(residual, aperture_radius=aperture_radius, inner_radius=inner_radius) / wavelength
    radial, angular = _node_counts(probe, fringe)
    radial, angular = radial_nodes or radial, angular_nodes or angular
    if symmetric:
        points = np.stack([distance, np.zeros_like(distance)], axis=1)
        angular += angular % 2
    u, v, w = polar_nodes(aperture_radius=aperture_radius, inner_radius=inner_radius, radial=radial, angular=angular)
    if symmetric:  # the integrand is even in the angle: keep 0..pi, doubling all but the two ends
        half = angular // 2
        keep = np.arange(half + 1)
        factor = np.where((keep == 0) | (keep == half), 1.0, 2.0)
        u, v = (a.reshape(radial, angular)[:, keep].ravel() for a in (u, v))
        w = (w.reshape(radial, angular)[:, keep] * factor).ravel()
    path = np.broadcast_to(element_opd(u, v), u.shape)
    return rayleigh_sommerfeld_sum(
        points, nodes=(u, v, w), element_opd=path, sensor_distance=sensor_distance, wavelength=wavelength,
        source_distance=source_distance,
    )  # fmt: skip


def _residual(element_opd: OPD, *, sensor_distance: float, source_distance: float) -> OPD:
    """What oscillates over the pupil in the exact model, seen from the axis: for the choice of nodes only."""
    vergence = 1 / source_distance

    def opd(u: Array, v: Array) -> Array:
        r2 = u**2 + v**2
        source = vergence * r2 / (1 + np.sqrt(1 + vergence**2 * r2))
        return source + element_opd(u, v) + r2 / (sensor_distance + np.sqrt(sensor_distance**2 + r2))

    return opd


def catmull_rom(profile: ArrayLike) -> interpolate.CubicHermiteSpline:
    """A profile at equally spaced radii 0..1: cubics with central slopes, flat on the axis, one-sided at the rim."""
    profile = np.asarray(profile, dtype=np.float64)
    slopes = np.gradient(profile, axis=0)
    slopes[0] = 0
    return interpolate.CubicHermiteSpline(np.arange(len(profile)), profile, slopes, axis=0)


class RadialPupil:
    """A round pupil with any profile of phase along its radius, in the Debye map: the truth for Hankel transforms.

    U(r) = 2 pi / (lambda d) INT A exp(i (k W + phase)) J0(k r r' / d) r' dr',  r' = r / sqrt(1 + r^2 / d^2),

    by 14 Gauss-Legendre nodes in each of the intervals between `edges`, and I = |U|^2 / E. W is the path from a point
    at `distance` relative to that from `focus`, which the lens images onto the sensor without aberration.
    """

    def __init__(
        self, edges: ArrayLike, phase: Callable[[Array], Array], *, aperture_radius: float, sensor_distance: float,
        wavelength: float, distance: float, focus: float, inner: float = 0.0,
    ) -> None:  # fmt: skip
        edges = np.unique(np.concatenate([[inner], np.linspace(inner, 1, 65), np.asarray(edges)]))
        edges = edges[(edges >= inner) & (edges <= 1)]
        node, weight = np.polynomial.legendre.leggauss(14)
        half, centre = np.diff(edges) / 2, (edges[1:] + edges[:-1]) / 2
        self.rho = (centre[:, None] + half[:, None] * node).ravel()
        r = self.rho * aperture_radius
        slope2 = 1 + (r / sensor_distance) ** 2
        self.image_side = r / np.sqrt(slope2)
        measure = (half[:, None] * weight).ravel() * aperture_radius * slope2**-1.5  # d r'
        amplitude = slope2 / np.sqrt(1 + (r / distance) ** 2)
        self.scale = 2 * math.pi / (wavelength * sensor_distance)
        path = sum(s * r**2 / z / (1 + np.sqrt(1 + (r / z) ** 2)) for s, z in ((1, distance), (-1, focus)))
        angle = 2 * math.pi / wavelength * path + phase(self.rho)
        ring = self.image_side * measure
        self.field = self.scale * amplitude * np.exp(1j * angle) * ring / math.sqrt(
            2 * math.pi * float(np.sum(amplitude**2 * ring))
        )  # fmt: skip

    def amplitude(self, r: ArrayLike) -> Array:
        """U at radii on the sensor, |U|^2 [1/m^2]."""
        return np.concatenate([self._kernel(some) @ self.field for some in self._parts(r)])

    def gradient(self, r: ArrayLike, weights: ArrayLike, profile_size: int) -> Array:
        """d / d profile of SUM weights |U(r)|^2, for a phase that is `catmull_rom` of a profile."""
        basis = catmull_rom(np.eye(profile_size))(self.rho * (profile_size - 1))
        total = np.zeros(len(self.rho), dtype=complex)
        weights = np.asarray(weights, dtype=np.float64)
        at = 0
        for some in self._parts(r):
            kernel = self._kernel(some)
            total += (weights[at : at + len(some)] * np.conj(kernel @ self.field)) @ kernel
            at += len(some)
        return 2 * (1j * total * self.field).real @ basis

    def outside(self, radius: float) -> float:
        """Share of the light beyond a radius on the sensor."""
        turns = self.scale * self.image_side.max() * radius
        node, weight = np.polynomial.legendre.leggauss(10)
        panels = math.ceil(turns / 3) + 4
        r = ((np.arange(panels)[:, None] + (node + 1) / 2) * radius / panels).ravel()
        ring = 2 * math.pi * r * np.tile(weight / 2 * radius / panels, panels)
        return 1 - float(np.sum(np.abs(self.amplitude(r)) ** 2 * ring))

    def _parts(self, r: ArrayLike) -> list[Array]:
        r = np.atleast_1d(np.asarray(r, dtype=np.float64))
        return np.array_split(r, max(1, r.size * self.rho.size // CHUNK))

    def _kernel(self, r: Array) -> Array:
        return special.j0(self.scale * np.outer(r, self.image_side))


def _pixel_order(half_phase: float) -> int:
    """Gauss-Legendre nodes that integrate exp(i half_phase t) over [-1, 1] to 1e-8, by the rule's error formula."""

    def error(n: int) -> float:
        scale = math.factorial(n) ** 4 / ((2 * n + 1) * math.factorial(2 * n) ** 3)
        return scale * (2 * half_phase) ** (2 * n)

    return next(n for n in itertools.count(2) if error(n) < 1e-8)


def direct_sum_psf(
    phase_map: ArrayLike, points: ArrayLike, *, pitch: float, aperture_radius: float | None, sensor_distance: float,
    wavelength: float, opd: OPD, source_distance: float | None = None, order: int | None = None,
) -> Array:  # fmt: skip
    """Intensity at points (P, 2) behind a map of flat square pixels: a brute-force sum, each pixel integrated [1/m^2].

    Args:      phase_map: (rows, columns) phase at this wavelength, delay positive [rad]; centred, spans shape * pitch.
               aperture_radius: circular aperture, cut exactly; None for the whole map [m].
               opd: without source_distance the *residual* OPD of the rest, and the model is Fresnel; with it (inf
               allowed) the *element* OPD of the rest, and the model is Rayleigh-Sommerfeld.
               order: Gauss-Legendre nodes per pixel and axis; None: what the steepest phase in a pixel needs (1e-8).
    Cost:      rows * columns * order^2 complex exponentials a point, 20 ns each: 891^2 at order 3 is 0.1 s a point.
    """
    phase_map, points = np.asarray(phase_map, dtype=np.float64), _as_points(points)
    if order is None:
        rest = opd
        if source_distance is not None:
            rest = _residual(opd, sensor_distance=sensor_distance, source_distance=source_distance)
        half = [aperture_radius or pitch * n / 2 for n in phase_map.shape]
        v, u = np.linspace(-half[0], half[0], 129), np.linspace(-half[1], half[1], 129)
        inside = np.ones((129, 129), dtype=bool)
        if aperture_radius is not None:
            inside = np.hypot(u[None], v[:, None]) <= aperture_radius
        slopes = np.gradient(rest(*np.meshgrid(u, v)), v, u)
        steepest = max(np.abs(slope[inside]).max() for slope in slopes) + np.abs(points).max() / sensor_distance
        order = _pixel_order(math.pi / wavelength * steepest * pitch)
    nodes, index = pixel_map_nodes(
        phase_map.shape, pitch=pitch, aperture_radius=aperture_radius, order=order, edge_order=max(8, order)
    )
    path = opd(nodes[0], nodes[1]) + phase_map.ravel()[index] * wavelength / (2 * math.pi)
    if source_distance is None:
        return fresnel_sum(points, nodes=nodes, opd=path, sensor_distance=sensor_distance, wavelength=wavelength)
    return rayleigh_sommerfeld_sum(
        points, nodes=nodes, element_opd=path, sensor_distance=sensor_distance, wavelength=wavelength,
        source_distance=source_distance,
    )  # fmt: skip


# ------------------------------------------------------------------------------------------------ from points to pixels
def pixel_centres(count: int, pitch: float) -> Array:
    """Coordinates of a row of pixels whose index count // 2 is the origin."""
    return (np.arange(count) - count // 2) * pitch


def pixel_integrate(function: Callable[[Array], Array], centres: ArrayLike, *, pitch: float, order: int = 8) -> Array:
    """Share of light that the square pixels at centres (P, 2) collect, from an intensity function of points (Q, 2).

    order x order Gauss-Legendre nodes a pixel: at order 8, relative to the pixel's own value, 1e-14 at the intensity's
    Nyquist pitch lambda d / 4a, 2e-10 at twice, 2e-6 at four times that.
    """
    centres = _as_points(centres)
    node, weight = np.polynomial.legendre.leggauss(order)
    dx, dy = (grid.ravel() for grid in np.meshgrid(pitch / 2 * node, pitch / 2 * node))
    inside = np.stack([centres[:, :1] + dx, centres[:, 1:] + dy], axis=-1).reshape(-1, 2)
    values = function(inside).reshape(len(centres), -1)
    return values @ (pitch**2 / 4 * np.outer(weight, weight)).ravel()


def radial_function(
    intensity: Callable[[Array], Array], *, largest: float, spacing: float
) -> Callable[[ArrayLike], Array]:
    """A function of points (P, 2) from an intensity of the radius alone, evaluated once per `spacing` and splined.

    Quintic spline through the even continuation: with spacing <= lambda d / (16 a), a quarter of the intensity's
    Nyquist pitch, good to 1e-6 of the peak. Makes whole pictures of an expensive symmetric PSF affordable.
    """
    r = np.arange(0, math.ceil(largest / spacing) + 8) * spacing
    values = intensity(r)
    mirrored = np.concatenate([values[8:0:-1], values]), np.concatenate([-r[8:0:-1], r])
    spline = interpolate.make_interp_spline(mirrored[1], mirrored[0], k=5)
    return lambda points: spline(np.hypot(*np.moveaxis(np.asarray(points, dtype=np.float64), -1, 0)))


# --------------------------------------------------------------------------------------------------- refractive indices
LINES = {  # Fraunhofer and laser lines [m]
    "h": 404.6561 * NM, "g": 435.8343 * NM, "F'": 479.9914 * NM, "F": 486.1327 * NM, "e": 546.0740 * NM,
    "d": 587.5618 * NM, "D": 589.2938 * NM, "HeNe": 632.8 * NM, "C'": 643.8469 * NM, "C": 656.2725 * NM,
    "r": 706.5188 * NM, "Nd:YAG": 1064.0 * NM,
}  # fmt: skip


def sellmeier_published() -> dict[str, tuple[dict[float, float], float]]:
    """Published refractive indices: {material: ({wavelength [m]: index}, what the source's own precision is)}.

    Schott (five decimals, 20 C, in air): n_d and V_d as read in the Zemax catalogue of 2017-01-20; the other lines are
    quoted from the data sheets without having them at hand, and n_F - n_C agrees with (n_d - 1) / V_d by a test.
    Fused silica: Malitson, J. Opt. Soc. Am. 55, 1205 (1965), table 1. CaF2: Malitson, Appl. Opt. 2, 1103 (1963).
    MgF2 (ordinary): Dodge, Appl. Opt. 23, 1980 (1984). BaF2: Malitson, J. Opt. Soc. Am. 54, 628 (1964), quoted to 1e-4.
    Sapphire (ordinary): Malitson, J. Opt. Soc. Am. 52, 1377 (1962) as tabulated by Valley Design; it scatters by 8e-5
    about the Dodge 1986 formula. ZnSe: II-VI / Raytheon CVD table (Connolly et al., Proc. SPIE 181, 141, 1979).
    PMMA, polycarbonate: Sultanova et al., Acta Phys. Pol. A 116, 585 (2009), three decimals, +-0.001.
    """
    schott = {
        "N-BK7": {"h": 1.53024, "g": 1.52668, "F'": 1.52283, "F": 1.52238, "e": 1.51872, "d": 1.51680, "D": 1.51673,
                  "HeNe": 1.51509, "C'": 1.51472, "C": 1.51432, "r": 1.51289},
        "F2": {"h": 1.65064, "g": 1.64202, "F'": 1.63310, "F": 1.63208, "e": 1.62408, "d": 1.62004, "HeNe": 1.61656,
               "C'": 1.61582, "C": 1.61503, "r": 1.61227},
        "N-F2": {"d": 1.62005},
        "N-K5": {"F": 1.52860, "e": 1.52458, "d": 1.52249, "C": 1.51982},
        "N-BAK4": {"g": 1.58149, "F": 1.57591, "e": 1.57125, "d": 1.56883, "C": 1.56575},
        "N-SK16": {"F": 1.62756, "e": 1.62286, "d": 1.62041, "C": 1.61727},
        "N-LAK22": {"F": 1.65925, "d": 1.65113, "C": 1.64760},
        "N-FK51A": {"g": 1.49364, "F": 1.49056, "e": 1.48794, "d": 1.48656, "C": 1.48480},
        "N-SF5": {"F": 1.68750, "d": 1.67271, "C": 1.66664},
        "N-SF6": {"g": 1.84738, "F": 1.82783, "e": 1.81266, "d": 1.80518, "C": 1.79608},
        "N-SF11": {"g": 1.82533, "F": 1.80651, "d": 1.78472, "C": 1.77596},
        "N-LASF9": {"F": 1.86898, "e": 1.85650, "d": 1.85025, "C": 1.84255},
    }  # fmt: skip
    crystals = {
        "fused silica": ({"F": 1.46313, "e": 1.46008, "d": 1.45846, "C": 1.45637}, 1e-5),
        "CaF2": ({"d": 1.43385, "C": 1.43246}, 1e-5),
        "MgF2": ({"d": 1.37774}, 2e-5),
        "BaF2": ({"d": 1.4745}, 1e-4),
    }
    published = {name: ({LINES[line]: n for line, n in lines.items()}, 1e-5) for name, lines in schott.items()}
    published |= {name: ({LINES[line]: n for line, n in ns.items()}, unit) for name, (ns, unit) in crystals.items()}
    published["sapphire"] = (
        {435.83 * NM: 1.7812, 532 * NM: 1.7717, 579.06 * NM: 1.76871, 633 * NM: 1.7659, 694 * NM: 1.76341,
         852.12 * NM: 1.75885, LINES["Nd:YAG"]: 1.75449},
        1e-4,
    )  # fmt: skip
    published["ZnSe"] = (
        {540 * NM: 2.6754, 580 * NM: 2.6312, 620 * NM: 2.5994, 660 * NM: 2.5755, 700 * NM: 2.5568, 1000 * NM: 2.4892},
        1e-4,
    )
    polymer_lines = [436.8 * NM, 486.1 * NM, 587.6 * NM, 632.8 * NM, 703 * NM]
    published["PMMA"] = (dict(zip(polymer_lines, [1.502, 1.497, 1.491, 1.489, 1.486], strict=True)), 1e-3)
    published["polycarbonate"] = (dict(zip(polymer_lines, [1.612, 1.599, 1.585, 1.580, 1.575], strict=True)), 1e-3)
    return published


ABBE_NUMBERS = {  # V_d of the Schott Zemax catalogue 2017-01-20b, through refractiveindex.info (CC0)
    "N-BK7": 64.17, "F2": 36.37, "N-F2": 36.43, "N-K5": 59.48, "N-BAK4": 55.98, "N-SK16": 60.32, "N-LAK22": 55.89,
    "N-FK51A": 84.47, "N-SF5": 32.25, "N-SF6": 25.36, "N-SF11": 25.68, "N-LASF9": 32.17,
}  # fmt: skip
