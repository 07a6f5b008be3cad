"""Transfer functions along x and y, or the diagonals, straight from the pupil, for estimates: no PSF is computed.

    LSF(x) = INT |U(x, y)|^2 dy ~ INT |F_u P(u, v)|^2 dv        (Parseval along v)

So the line spread along x takes one transform along each of a few rows of the pupil, and that along y of a few columns.
Where a pupil is smooth the rows are a quadrature; of a map of pixels they are a sample. What falls above or below the
window is left out of each row: rays of a smooth pupil that land there; of a map, what a low-pass along v stops.

Beyond the paraxial model the pixels of a map are curved in the plane of these rows, v' ~ v'_0 (1 - tau u^2 / 2) where
v'_0 is at u = 0: the light lies, as u^2, between that of two maps whose pixels are straight.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from kcam.optics.numerics import fast_length, lagrange, lagrange_weights, sines
from kcam.optics.propagation import sampling
from kcam.optics.propagation.cells import cell_edges, looked_up, sizes
from kcam.optics.propagation.question import Query, residual_amplitude, residual_path
from kcam.optics.pupil.coordinates import Pupil, from_image_side, grid_nodes, grid_spacing, to_image_side
from kcam.optics.pupil.maps import pixel_weights
from kcam.optics.pupil.rim import edge_profile
from kcam.optics.source import Points
from kcam.precision import full_precision

_KAPPA = 1.5  # samples along a row for each fringe that reaches the window
_ROWS = 32  # of a smooth pupil at least, and one for so many samples along it: errors are 0.99 to 1.2 times what three
_PER_ROW = 8  # times as many rows tell (5 to 95 % of 414 choices before 69 pupils)
_SAMPLED = 32  # rows of a map of pixels at least, fewer than twice as many
_FAR = 2 / 3  # of the semi-aperture, squared: there pixels are displaced most
_PASSED = 24  # half width of the low-pass along v, in samples at its Nyquist
_PER_CYCLE = 4  # parts of a pixel for each cycle of the low-pass in it, and places for each cycle of the phase
_SOFT = 2.0  # pixels over which rays fade at the window's edge
_TOGETHER, _NODES, _MOST = 8, 32, 0.7  # rows, and nodes, whose parts of the cells are taken at once, where these parts
# are less than so much of all
_TAPS = range(-1, 3)
_SPHERES = 3  # between which others lie: they rise with the third power of the vergence
_AT_ONCE = 2**17  # samples of rows, of wavelengths that are transformed together: a processor's cache holds no more
_MORE = 1.3  # times the samples that are needed, up to which those of other distances do

Parts = list[tuple[slice, slice]]
"""Rows of a matrix, and the columns in which they are not 0."""


def lines(query: Query, like: LineTransfer | None = None) -> LineTransfer | None:
    """About the transfer functions of a query; None off the axis.

    like: those of the same question about other distances, from which it takes what is the same.
    """
    if query.points.positions is not None:
        return None
    with torch.no_grad():
        return LineTransfer(query, like)


class LineTransfer:
    """Transfer functions of a query's window, and about those of smaller ones, as `row.Transfer`.

    Differences between wavelengths, and between distances, are right to a tenth in the median, a third at worst; of
    maps of pixels they are up to a third too large, because rows are sampled.
    """

    def __init__(self, query: Query, like: LineTransfer | None = None) -> None:
        self.query = query = replace(query, grid=replace(query.grid, dtype=torch.float32))
        # under maps as many as in the paraxial model: what these sample is not to differ between the models
        sampled = query.modelled(paraxial=True) if query.has_pixels else query
        finest, (a, d) = float(query.wavelengths.min()), query.scale
        count = sampling.pupil_samples(
            semi_aperture=sampled.scale[0],
            sensor_distance=d,
            wavelength=finest,
            half_window=query.half_window,
            displacement=float(sampled.displacement.max()),
            kappa=_KAPPA,
        )
        fits = like is not None and count <= like.spreads.count <= _MORE * count
        self.spreads: _Spreads = like.spreads if like is not None and fits else _Spreads(query, count)
        self._cutoff = 2 * a * query.pixel_pitch / (d * finest)
        self._folds: tuple[Tensor, tuple[Tensor, Tensor, Tensor]] | None = None  # of the frequencies asked for last

    def __call__(self, frequencies: Tensor, shape: tuple[int, int], bands: Sequence[int]) -> Tensor:
        """As `row.Transfer`, (Z, L, 2, F) complex128; of a smaller window than the query's own roughly: as if the light
        that misses it in one direction were spread in the other as the rest is.
        """
        query = self.query
        if shape[0] > query.shape[0] or shape[1] > query.shape[1]:
            raise ValueError(f"line spreads are of the window {query.shape} that was asked for, not of {shape}.")
        with torch.no_grad(), full_precision(query.device):
            light = self.spreads.of(query, bands).double()  # (L, 2, Z, length)
            (a, d), length = query.scale, self.spreads.length
            step = query.wavelengths[list(bands)].to(light) * d / (a * query.pixel_pitch)
            step /= self.spreads.spacing * length
            x = torch.fft.fftfreq(length, 1 / length, dtype=light.dtype, device=light.device)
            cut = self._inside(shape, step, x)
            if tuple(shape) != tuple(query.shape):
                whole = (light * self._inside(query.shape, step, x)).sum(-1).clamp(min=1e-30)
                shares = (light * cut).sum(-1) / whole
                light *= shares.flip(1)[..., None]
            light *= cut
            near, far = light.tensor_split([(length + 1) // 2], dim=-1)
            table = torch.fft.rfft(torch.cat([near, near.new_zeros(light.shape), far], dim=-1))  # twice as fine
            into, asked, weights = self._folded(frequencies)
            found = _between(table, asked * (2 * length * step)[:, None]) * weights
            total = found.new_zeros(*found.shape[:-1], len(frequencies)).index_add_(-1, into, found)
            if query.has_gaps:
                total = sampling.of_whole_pixels(total, found[..., (into == 0) & (asked == 0)])
            return total.permute(2, 0, 1, 3)

    def _folded(self, frequencies: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        if self._folds is None or self._folds[0] is not frequencies:
            grid, turned = self.query.grid, self.query.turned
            active, own = grid.active if grid.integrate else 0.0, frequencies.to(grid.device, torch.float64)
            found = sampling.folded(own, self._cutoff, active, turned=turned)
            self._folds = frequencies, found
        return self._folds[1]

    @staticmethod
    def _inside(shape: tuple[int, int], step: Tensor, x: Tensor) -> Tensor:
        """What of the light at so many steps (N,), of (L,) pixels, falls into a window along x and y, (L, 2, 1, N): of
        light that is linear between its steps, for an edge that moves with the wavelength.
        """
        edges = step.new_tensor([shape[1], shape[0]])[:, None] / 2 / step[:, None, None]
        within = torch.stack([edges - x, edges + x]).clamp(-1, 1)  # of either edge
        return (within - within * within.abs() / 2).sum(0)[:, :, None]


class _Spreads:
    """The light along x and y of a lens, of each wavelength and distance when it is first asked for."""

    def __init__(self, query: Query, count: int) -> None:
        self.count = count
        self.spacing, self.length = grid_spacing(count), fast_length(2 * count)  # |U|^2 has twice the frequencies of U
        nodes, self.rows = grid_nodes(count).to(query.device), [_rows(query, axis, count) for axis in range(2)]
        self.maps = _Maps.of(query, nodes) if query.has_pixels else None
        self.pupils = [_Rows(query, own, nodes, axis, self.maps) for axis, own in enumerate(self.rows)]
        self.known: dict[tuple[int, str], Tensor] = {}  # by wavelength and distance
        self.lit: dict[tuple[str, ...], tuple[list[_Lit], list[_OntoRows]]] = {}  # by distances

    def of(self, query: Query, bands: Sequence[int]) -> Tensor:
        """At each step along x and y from the middle on, then of those before it: (L, 2, Z, length)."""
        names = [f"{vergence:.12g}" for vergence in query.vergences.tolist()]
        missing: dict[tuple[int, ...], list[int]] = {}  # wavelengths, by which of the distances they lack
        for band in bands:
            if places := tuple(place for place, name in enumerate(names) if (band, name) not in self.known):
                missing.setdefault(places, []).append(band)
        for places, lacking in missing.items():
            some = tuple(names[place] for place in places)
            if some not in self.lit:
                own = replace(query, points=Points(query.vergences[list(places)]))
                edges = None if self.maps is None else self.maps.edges
                onto = [] if edges is None else [_OntoRows.of(own, *axis, edges) for axis in enumerate(self.rows)]
                self.lit[some] = [rows.at(own) for rows in self.pupils], onto
            each = len(some) * self.length * max(map(len, self.rows))
            step = max(1, _AT_ONCE // max(each, 0 if self.maps is None else self.maps.amplitude.numel()))
            for part in (lacking[start : start + step] for start in range(0, len(lacking), step)):
                found = self._spread(query.wavelengths[part], part, *self.lit[some])
                self.known.update(
                    ((band, name), light)
                    for band, lights in zip(part, found, strict=True)
                    for name, light in zip(some, lights.unbind(1), strict=True)
                )
        return torch.stack([torch.stack([self.known[band, name] for name in names], dim=1) for band in bands])

    def _spread(self, wavelengths: Tensor, bands: list[int], lit: list[_Lit], onto: list[_OntoRows]) -> Tensor:
        wavenumbers = (2 * math.pi / wavelengths).to(lit[0].maps.device)[:, None, None]
        fields = (None, None) if self.maps is None else self.maps.fields(bands, self.rows, onto)
        spreads = []
        for rows, field in zip(lit, fields, strict=True):
            phase = (wavenumbers * rows.coefficients[bands]).to(rows.maps) @ rows.maps.flatten(1)
            cosine, sine = sines(phase.unflatten(-1, rows.maps.shape[1:]))
            amplitude = rows.amplitude_inside(bands)
            pupil = torch.complex(cosine * amplitude, sine * amplitude)
            transformed = torch.fft.fft(pupil if field is None else pupil * field, n=self.length)
            power = torch.view_as_real(transformed).square_()
            light = power.sum(-3).sum(-1)  # of both at once, or in float64, it takes ten times as long
            spreads.append(light / (self.length * rows.energy[:, None]))
        return torch.stack(spreads, dim=1)


def _rows(query: Query, axis: int, samples: int) -> Tensor:
    """Where rows along x (axis 0), or columns along y (axis 1), cross the pupil, (R,) in semi-apertures."""
    count, every = max(_ROWS, 2 * math.ceil(samples / (2 * _PER_ROW))), 1
    if query.has_pixels:  # as many as tell what falls into the window, and of these some
        fringes = _fringes(query.modelled(paraxial=True), axis)
        count = max(_SAMPLED, math.ceil(2 * fringes / float(query.wavelengths.min())))
        every = count // _SAMPLED
    rows = (torch.arange(count, dtype=torch.float64, device=query.device) + 0.5) * (2 / count) - 1
    return rows[count // 2 :] if query.even and not query.has_pixels else rows[every // 2 :: every]


def _fringes(query: Query, axis: int) -> float:
    """Over half the pupil, of two points at opposite edges of the window, times the wavelength."""
    a, d = query.scale
    return a * query.shape[axis] * query.pixel_pitch / d


@dataclass(frozen=True)
class _Maps:
    """All pixel maps of a lens on common cells; see `cells.Cells`, which cuts them by the rim too.

    phases: (E, C, C), their factors (E, L). amplitude: (C, C). edges: of the cells in the image-side plane, (1, C + 1),
    and onto_nodes: (1, N, C), with `parts` that are not 0; where cells are curved, those on the axis and at `_FAR` from
    it, of which others take shares (2, C).
    """

    phases: Tensor
    factors: Tensor
    amplitude: Tensor
    edges: Tensor
    onto_nodes: Tensor
    shares: Tensor | None
    parts: Parts

    @staticmethod
    def of(query: Query, nodes: Tensor) -> _Maps:
        found = query.lens.pixel_maps(query.wavelengths.to(query.device))
        cells, _ = cell_edges(maps := sizes(query, found), math.inf)
        amplitude = torch.ones(len(cells) - 1, len(cells) - 1, dtype=query.dtype, device=query.device)
        phases: list[Tensor] = []
        factors: list[Tensor] = []
        for pixels, (size, width) in zip(found, maps, strict=True):
            values = looked_up(pixels.values.detach().to(amplitude), cells, size=size, half_width=width)
            if pixels.factors is None:
                amplitude = amplitude * values
            else:
                phases.append(values)
                factors.append(pixels.factors.detach().to(amplitude))
        if not phases:
            phases, factors = [torch.zeros_like(amplitude)], [torch.zeros(len(query.wavelengths)).to(amplitude)]
        true, tau, spacing = torch.as_tensor(cells), float(query.tau), float(nodes[1] - nodes[0])
        curved = [to_image_side(true, tau, aside=far) for far in ((0.0, _FAR) if tau else (0.0,))]
        onto_nodes = torch.stack([pixel_weights(own, nodes.cpu(), spacing=spacing) for own in curved]).to(amplitude)
        shares, edges = _shares((true[1:] + true[:-1]) / 2).to(amplitude) if tau else None, torch.stack(curved)
        parts, edges = _parts((onto_nodes != 0).any(0), _NODES), edges.to(query.device)
        return _Maps(torch.stack(phases), torch.stack(factors), amplitude, edges, onto_nodes, shares, parts)

    def fields(self, bands: list[int], rows: Sequence[Tensor], onto: Sequence[_OntoRows]) -> list[Tensor]:
        """What the maps do to the light of wavelengths in rows along x, and in columns along y, (L, Z, R, N)."""
        phase = torch.einsum("el,eyx->lyx", self.factors[:, bands], self.phases)
        field = torch.stack(sines(phase)).mul_(self.amplitude)
        return [
            self._in_rows(own, across(bands), across.parts, places)
            for places, across, own in zip(rows, onto, (field, field.mT), strict=True)
        ]

    def _in_rows(self, field: Tensor, taken: Tensor, parts: Parts, places: Tensor) -> Tensor:
        """In rows at places, of a field's real and imaginary part (2, L, C, C), of which they take (L, K, Z, R, C)."""
        nodes, cells = self.onto_nodes.shape[1:]
        shape, reached, spread = taken.shape[2:4], _area(parts) / len(places), _area(self.parts)
        # what is taken goes onto nodes, or the field: the fewer multiplications, two of complex numbers for one of real
        late = shape.numel() * (2 * reached * (cells - nodes) + spread) < cells * spread or self.shares is not None
        field = torch.complex(*field) if late else self._onto_nodes(field)
        found = []
        for own, some in parts:
            light = taken[..., own, some].flatten(2, 3)
            if self.shares is None:
                seen = light[:, 0] @ field[:, some]
            else:
                seen = (light @ (field[:, None, some] * self.shares[:, None])).sum(1)
            found.append(seen.unflatten(1, (shape[0], -1)))
        light = torch.cat(found, dim=2).flatten(1, 2)
        if self.shares is not None:
            shares = _shares(places).to(self.amplitude).repeat(1, shape[0])[..., None]
            light = self._onto_nodes(_apart(light[:, None] * shares)).sum(1)
        elif late:
            light = self._onto_nodes(_apart(light))
        return light.unflatten(1, shape)

    def _onto_nodes(self, light: Tensor) -> Tensor:
        """Of the real and the imaginary part of light in cells, (2, ..., C): (..., N)."""
        weights = self.onto_nodes if self.shares is not None else self.onto_nodes[0]
        parts = [light[..., cells] @ weights[..., nodes, cells].mT for nodes, cells in self.parts]
        return torch.complex(*torch.cat(parts, dim=-1))

    def power(self, rows: Tensor, nodes: Tensor, axis: int) -> Tensor:
        """What passes of the power in the rows along x, or the columns along y, (R, N)."""
        places = (torch.bucketize(x.contiguous(), self.edges[0]) - 1 for x in (rows, nodes))
        row, node = (place.clamp(0, len(self.amplitude) - 1) for place in places)
        passed = (self.amplitude.T if axis else self.amplitude).square()[row][:, node]
        return passed * (nodes.abs() <= 1)  # beyond the maps there is no light


def _shares(place: Tensor) -> Tensor:
    """What light at places gives to what is straight on the axis, and at `_FAR` from it, (2, N)."""
    far = place.square() / _FAR
    return torch.stack([1 - far, far])


class _Path:
    """The residual path at places in the pupil, of which little depends on the distance."""

    def __init__(self, query: Query, pupil: Pupil) -> None:
        self.pupil = pupil
        self.coefficients, self.maps = residual_path(replace(query, points=Points(query.vergences.new_zeros(1))), pupil)

    def at(self, query: Query) -> tuple[Tensor, Tensor]:
        """As `residual_path`; what spheres from many distances have beyond their parabolas lies between three."""
        vergences = query.vergences
        own = self.coefficients.repeat(1, len(vergences), 1)
        own[..., 0] += vergences * query.semi_aperture**2 / 2
        near = vergences[vergences != 0].unique()
        if query.paraxial or not len(near):
            return own, self.maps
        if len(near) > _SPHERES:
            near = torch.arange(1, _SPHERES + 1).to(near) / _SPHERES * near.max()
        weights = lagrange_weights(torch.cat([near.new_zeros(1), near]), vergences)[:, 1:]
        spheres = self.pupil.beyond_paraxial(near[(..., *[None] * self.pupil.rho2.ndim)])
        coefficients = torch.cat([own, weights.expand(len(own), -1, -1)], dim=-1)
        return coefficients, torch.cat([self.maps, spheres.expand(-1, *self.maps.shape[1:])])


class _Rows:
    """The rows along x, or the columns along y: what is the same from all distances."""

    def __init__(self, query: Query, rows: Tensor, nodes: Tensor, axis: int, pixels: _Maps | None) -> None:
        self.axis, self.smooth, self.spacing = axis, pixels is None, float(rows[1] - rows[0])
        self.path = _Path(query, _pupil(query, nodes[None, :], rows[:, None], axis))
        self.passed = torch.ones_like(self.path.pupil.rho2) if pixels is None else pixels.power(rows, nodes, axis)
        self.rim = _rim(query, rows, nodes)

    def at(self, query: Query) -> _Lit:
        """From some distances."""
        half, slopes = query.shape[self.axis] / 2, None
        coefficients, maps = self.path.at(query)
        own = residual_amplitude(query, self.path.pupil)
        energy = self.rim * own**2 * self.passed
        if self.smooth and float(query.displacement.max()) > (half - _SOFT) * query.pixel_pitch:
            slopes = torch.gradient(maps, spacing=self.spacing, dim=1, edge_order=2)[0].to(query.dtype)
        energy = energy.expand(-1, *self.passed.shape).sum((-2, -1))
        dtype, amplitude = query.dtype, self.rim * own
        return _Lit(query, half, maps.to(dtype), coefficients, amplitude.to(dtype), energy.to(dtype), slopes)


@dataclass(frozen=True)
class _Lit:
    """What is the same at all wavelengths of the light from some distances in the rows along x, or the columns along y.

    half: pixels from the middle of the window to its edge, across the rows. maps: (T, R, N), of coefficients (L, Z, T),
    see `residual_path`. amplitude: (1 or Z, R, N); energy: of what passes, (1 or Z,). slopes: of the maps across the
    rows, where rays of a smooth pupil may miss the window.
    """

    query: Query
    half: float
    maps: Tensor
    coefficients: Tensor
    amplitude: Tensor
    energy: Tensor
    slopes: Tensor | None

    def amplitude_inside(self, bands: list[int]) -> Tensor:
        """Of the light whose rays fall into the window, (L, Z, R, N), or of all, (1 or Z, R, N)."""
        if self.slopes is None:
            return self.amplitude
        a, d = self.query.scale
        fall = (d / (a * self.query.pixel_pitch) * self.coefficients[bands]).to(self.slopes) @ self.slopes.flatten(1)
        inside = (self.half - fall.abs()) / _SOFT + 0.5
        return self.amplitude * inside.clamp(0, 1).unflatten(-1, self.slopes.shape[1:])


@dataclass(frozen=True)
class _OntoRows:
    """What each row takes of each cell across the rows, of what the smooth phase on its way sends into the window: a
    low-pass of cells that turn as that phase does in the middle of the pupil, and, where cells are curved, at `_FAR`.

    fringes: see `_fringes`. offset: from each row to the middles of P parts of each cell (K, R, P, C), and how wide
    these are (K, C), in semi-apertures. coefficients, maps: see `residual_path`; at places in each part
    (T, K, P, Q, C), and in the rows, (T, K, R). parts: rows, and the cells of which they take something.
    """

    query: Query
    fringes: float
    offset: Tensor
    widths: Tensor
    coefficients: Tensor
    maps: Tensor
    in_rows: Tensor
    parts: Parts

    @staticmethod
    def of(query: Query, axis: int, rows: Tensor, edges: Tensor) -> _OntoRows:
        (a, d), fringes = query.scale, _fringes(query, axis)
        cell = _PER_CYCLE * float(edges.diff().max()) / float(query.wavelengths.min())
        parts = math.ceil(cell * fringes / 2)  # the low-pass is even in each of them, and the phase at more places
        places = math.ceil(cell * (fringes / 2 + a * float(query.displacement.max()) / d) / parts)
        finer = torch.cat([_middles(edges, parts * places).flatten(1), rows.expand(len(edges), -1)], dim=1)
        coefficients, found = _across(query, axis, finer)
        maps, in_rows = found.tensor_split([found.shape[-1] - len(rows)], dim=-1)
        offset, widths = _middles(edges, parts)[:, None] - rows[:, None, None], edges.diff() / parts
        maps, dtype = maps.unflatten(-1, (parts, places, -1)), query.dtype
        near = (offset.abs() * fringes < _PASSED * float(query.wavelengths.max())).any(0).any(1)
        few = _parts(near, _TOGETHER)
        return _OntoRows(query, fringes, offset.to(dtype), widths.to(dtype), coefficients, maps, in_rows, few)

    def __call__(self, bands: list[int]) -> Tensor:
        """Of wavelengths, (L, K, Z, R, C): but for a phase of each row, which no power has."""
        numbers = 1 / self.query.wavelengths[bands].to(self.offset.device)[:, None, None]
        density = (self.fringes * numbers).to(self.offset)[..., None, None]
        offset = self.offset * density  # in samples at the Nyquist frequency of the window's edge
        turned = (offset.abs() * math.pi).clamp_(min=1e-4)  # torch.sinc takes five times as long
        weights = turned.sin() / turned
        weights *= (offset.clamp(-_PASSED, _PASSED) * (math.pi / (2 * _PASSED))).cos_().square_()
        weights *= density * self.widths[:, None, None]
        phase = 2 * math.pi * numbers * self.coefficients[bands]
        parts = (part.mean(-2).to(weights) for part in sines(_at(phase, self.maps)))
        taken = torch.complex(*((weights[:, :, None] * part[:, :, :, None]).sum(-2) for part in parts))
        if len(self.widths) == 1:
            return taken
        back = torch.complex(*(part.to(weights) for part in sines(_at(-phase, self.in_rows))))
        return taken * back[..., None]


def _parts(taken: Tensor, count: int) -> Parts:
    """So many of the rows (R, C) at once, and the columns of which they take something; all where that is most."""
    rows, columns = taken.shape
    found = []
    for start in range(0, rows, count):
        some = taken[start : start + count].any(0).nonzero()[:, 0].tolist() or [0]
        found.append((slice(start, min(rows, start + count)), slice(some[0], some[-1] + 1)))
    return found if _area(found) < _MOST * rows * columns else [(slice(0, rows), slice(0, columns))]


def _area(parts: Parts) -> int:
    """Entries of a matrix, (R, C), in its parts."""
    return sum((rows.stop - rows.start) * (columns.stop - columns.start) for rows, columns in parts)


def _apart(light: Tensor) -> Tensor:
    """Real and imaginary part."""
    return torch.stack([light.real, light.imag])


def _at(phase: Tensor, maps: Tensor) -> Tensor:
    """Sums (L, K, Z, ...) of maps (T, K, ...) with factors (L, Z, T)."""
    return (phase @ maps.flatten(1)).unflatten(-1, maps.shape[1:]).transpose(1, 2)


def _across(query: Query, axis: int, places: Tensor) -> tuple[Tensor, Tensor]:
    """As `residual_path`, at places across the rows (K, N): that of the paraxial model in the middle of the pupil, and
    what the exact one has beyond it there, and at `_FAR`.
    """
    flat, along = query.modelled(paraxial=True), places.new_tensor([[0.0], [math.sqrt(_FAR)]])[: len(places)]
    middle, maps = residual_path(flat, _pupil(flat, 0 * along, places, axis))
    if query.paraxial:
        return middle, maps
    exact, paraxial = (residual_path(model, _pupil(model, along, places, axis)) for model in (query, flat))
    return torch.cat([middle, exact[0], -paraxial[0]], dim=-1), torch.cat([maps, exact[1], paraxial[1]])


def _middles(edges: Tensor, parts: int) -> Tensor:
    """Of parts of each cell (K, P, C)."""
    shares = (torch.arange(parts, dtype=edges.dtype, device=edges.device) + 0.5) / parts
    return edges[:, None, :-1] + edges.diff()[:, None] * shares[:, None]


def _pupil(query: Query, along: Tensor, across: Tensor, axis: int) -> Pupil:
    """Of rows along x (axis 0), or columns along y (axis 1), or along the diagonals."""
    x, y = (across, along) if axis else (along, across)
    if query.turned:
        x, y = (x - y) * math.sqrt(0.5), (x + y) * math.sqrt(0.5)
    return query.pupil(*from_image_side(x, y, query.tau))


def _rim(query: Query, rows: Tensor, nodes: Tensor) -> Tensor:
    """Quadrature weights along each row of an aperture made of discs, (R, N)."""
    spacing, weights = float(nodes[1] - nodes[0]), []
    for radius, weight in query.lens.aperture.discs():
        chord = (to_image_side(radius, query.tau) ** 2 - rows**2).clamp(min=0).sqrt()[:, None]
        weights.append(weight * edge_profile((chord - nodes.abs()) / spacing) * (chord > 0))
    return torch.stack(weights).sum(0) if weights else torch.ones(len(rows), len(nodes)).to(rows)


def _between(table: Tensor, place: Tensor) -> Tensor:
    """What is known at 0, 1, ..., (L, 2, Z, N), conjugate below 0, at places (L, F), by cubics; beyond it is 0."""
    far = place.abs().clamp(max=table.shape[-1] + 1)
    low = far.floor()
    known = torch.cat([table[..., 1:2].conj(), table, table.new_zeros(*table.shape[:-1], len(_TAPS))], dim=-1)
    index = low.long()[:, None, None, :, None].expand(*table.shape[:-1], -1, len(_TAPS))
    around = known.unfold(-1, len(_TAPS), 1).gather(-2, index)  # (L, 2, Z, F, 4)
    weights = torch.stack(lagrange(far - low, taps=_TAPS), dim=-1).to(table.dtype)
    found = (around * weights[:, None, None]).sum(-1)
    return torch.where((place < 0)[:, None, None], found.conj(), found)
