"""Imaging: the light of a scene through a lens onto the sensor, equation (3.1) before the noise.

    I_c = sum_z,l kappa_cl (I_zl * h_zl)

How the picture is convolved stands in `rendering`; here is which PSFs, for which layers of depth.
"""

from __future__ import annotations

import functools
import inspect
import math
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import fields
from numbers import Integral
from typing import Any, Protocol

import torch
from torch import Tensor

from kcam.cache import ValueCache, differentiated
from kcam.context import Context, Curves, Stage
from kcam.effects import Work
from kcam.inputs import check_bands, describe
from kcam.optics.lens import Lens, Recipe
from kcam.optics.propagation.row import Propagator
from kcam.optics.propagation.sampling import KAPPA
from kcam.optics.propagation.table import PHYSICS
from kcam.optics.regions import field_shares, pixel_positions
from kcam.optics.rendering.borders import BORDERS
from kcam.optics.rendering.depth import LAYER_WAVES, Layers, alike, few_values, layer_shares
from kcam.optics.rendering.renderer import Renderer
from kcam.optics.source import Defocus, PixelGrid, Points, PSFSource
from kcam.precision import full_precision
from kcam.scene import Scene
from kcam.units import check_distances, check_pixel_pitch, wavelength_grid

COVERAGES = ("channel", "band")
_RANGE = 4000.0  # of light in one picture that float32's transforms hold to 1e-3; a picture of 8 bits has 3300
_FEW_BRIGHT, _MUCH_DARK = 0.05, 0.01  # shares of the pixels


class Absorber(Curves, Protocol):
    """What `Imaging` lets absorb its bands inside the transform: a `sensor.ColourFilter`."""

    def finish(self, light: Tensor) -> Tensor:
        """What the filter makes of the channels' light (B, C, H, W)."""


class Imaging(Stage):
    """The light of a scene through a lens onto the pixels.

    Args:
        lens: the optics: a `Lens`, a `MeasuredPSF`, or anything that follows `source.PSFSource`.
        pixel_pitch: [m]. fill_factor: light-sensitive share of a pixel; the irradiance is its mean over that square,
            and an even scene gives the same whatever the share.
        propagator, method, samples: as in `Lens.psf`. A number of samples freezes the pupil grid, which otherwise
            follows the parameters in steps: give it together with psf_shape where a camera is differenced. A propagator
            may also be a row of one's own, an `optics.propagation.Propagator`; such a camera cannot be saved.
        integrate: the light over each pixel; False takes point samples at the pixels' centres instead.
        bands: number of wavelengths that have a PSF of their own; None: all. Fewer: neighbouring bands share the PSF of
            their group's mean wavelength, whatever their number.
        psf_shape: (H, W) of the PSF's window in pixels; None: see `psf_window`.
        layers: number of depth layers over the range of a depth map, at equal steps of 1/z, or their distances [m];
            None: see `depth_layers`. Of given ones a warning says where pixels lie too far from all.
        interpolate: between the layers, linearly in vergence; False puts each pixel into its nearest layer.
        coverage: where layers hide each other, count it per "channel" of the filter that is absorbed, or per "band":
            the colours at an edge are then exact, at the cost of the bands.
        border: what lies beyond the picture: reflect, replicate, periodic or zero.
        distance: of a plain tensor [m]; None: where the lens is focused.
        max_memory: bytes that the transforms may take; bands are split to stay below, with the same result.
        tile: side of the squares that are convolved one by one [pixels], or None; in less memory, with the same result.
        direct: convolve in the picture, without a Fourier transform: faster for small windows, with the same result.
    What follows are shortcuts, with errors that a `Plan` weighs:
        blur: False lets each point light its own pixel only.
        kappa: pupil samples per fringe, see `optics.propagation.sampling.pupil_samples`; None for its default.
        renormalise: give a PSF that psf_shape cuts its whole light again.
        occlusion: False adds the layers up, also where a nearer one hides a farther one.
        rank: of the scene's spectra, at most, see `Scene.low_rank`; None for its own.
        precision: "float32" computes so whatever the scene's type; None for the scene's, or float64 where its light
            spans more than float32's transforms hold, see `wide_range`.
    Raises: ValueError for an unknown propagator, border, coverage or precision, a pitch or distance not in metres, a
        shape or count that is not positive, a kappa of 1 or less.
    """

    def __init__(
        self,
        lens: PSFSource,
        *,
        pixel_pitch: float = 4e-6,
        propagator: str | Propagator = "nonparaxial",
        method: str | None = None,
        samples: int | None = None,
        integrate: bool = True,
        bands: int | None = None,
        psf_shape: tuple[int, int] | None = None,
        layers: int | Sequence[float] | Tensor | None = None,
        interpolate: bool = True,
        coverage: str = "channel",
        border: str = "reflect",
        fill_factor: float = 1.0,
        distance: float | None = None,
        max_memory: float = 2e9,
        tile: int | None = None,
        direct: bool = False,
        blur: bool = True,
        kappa: float | None = None,
        renormalise: bool = False,
        occlusion: bool = True,
        rank: int | None = None,
        precision: str | None = None,
    ) -> None:
        super().__init__()
        if not isinstance(lens, PSFSource):
            raise TypeError(f"Imaging takes an optics.Lens or another source of PSFs, got {type(lens).__name__}.")
        if not isinstance(propagator, Propagator) and propagator not in PHYSICS:
            raise ValueError(f"unknown propagator {propagator!r}; known: {', '.join(PHYSICS)}.")
        if border not in BORDERS:
            raise ValueError(f"unknown border {border!r}; known: {', '.join(BORDERS)}.")
        if coverage not in COVERAGES:
            raise ValueError(f"unknown coverage {coverage!r}; known: {', '.join(COVERAGES)}.")
        if layers is not None:
            layers = _count_or_distances(layers)
        for name, value, of in (
            ("bands", bands, "wavelengths"),
            ("tile", tile, "pixels"),
            ("rank", rank, "factors"),
        ):
            if value is not None and value < 1:
                raise ValueError(f"{name} must be a positive number of {of}, or None, got {value}.")
        if kappa is not None and not kappa > 1:
            raise ValueError(f"kappa must be above 1 sample per fringe, got {kappa:g}. Its default is {KAPPA:g}.")
        if precision not in (None, "float32", "float64"):
            raise ValueError(f'precision must be "float32", "float64" or None for the scene\'s, got {precision!r}.')
        if distance is not None:
            if check_distances(distance).numel() != 1:
                raise TypeError(
                    f"distance must be one number of metres, got {describe(distance)}. Use "
                    "Scene.from_bands(bands, depth=distance) for one per sample or a map."
                )
            distance = float(distance)
        if not max_memory > 0:
            raise ValueError(f"max_memory must be a positive number of bytes, got {max_memory:g}.")
        self.lens = lens
        self.pixel_pitch = check_pixel_pitch(pixel_pitch)
        self.propagator, self.method, self.samples = propagator, method, samples
        self.psf_shape = None if psf_shape is None else (int(psf_shape[0]), int(psf_shape[1]))
        self.integrate, self.bands = integrate, bands
        self.layers, self.interpolate, self.coverage = layers, interpolate, coverage
        self.border, self.fill_factor = border, fill_factor
        self.distance, self.max_memory = distance, float(max_memory)
        self.tile, self.direct, self.blur, self.kappa, self.renormalise = tile, direct, blur, kappa, renormalise
        self.occlusion, self.rank, self.precision = occlusion, rank, precision
        self._warns = True  # of too few layers
        self._bank_cache, self._transfer_cache = ValueCache(), ValueCache()
        self._check_recipe()

    def changed(self, **arguments: Any) -> Imaging:
        """The same stage with some of its constructor's arguments changed; it shares the lens and has kept nothing.

        Of layers that are changed here no warning says that they are few: a plan has weighed what they cost.
        """
        own = {name: getattr(self, name) for name in inspect.signature(Imaging).parameters}
        changed = Imaging(**(own | arguments))
        changed._warns = self._warns and "layers" not in arguments
        return changed

    def _check_recipe(self) -> None:
        """What asks for a method that does not exist, or for one where nothing is computed, is refused at once."""
        if isinstance(self.lens, Lens):
            pixels = self.pixels(self.psf_shape or (1, 1), torch.empty(0))
            query = self.lens.question(Points(torch.zeros(1)), wavelength_grid([550e-9]), pixels, self.recipe)
            if self.method is not None:
                self.recipe.row(query)
            return
        given = ", ".join(f"{field.name}=" for field in fields(Recipe) if getattr(self, field.name) != field.default)
        if given:
            raise ValueError(
                f"{given} says how a Lens computes its PSFs; a {type(self.lens).__name__} has them. Leave it out."
            )

    def provides(self) -> dict[str, Any]:
        """The optics, for exposure in physical units."""
        return {"lens": self.lens, "pixel_pitch": self.pixel_pitch, "fill_factor": self.fill_factor}

    def forward(
        self, scene: Scene | Tensor, context: Context | None = None, *, colour_filter: Absorber | None = None
    ) -> Tensor:
        """Mean irradiance over each pixel.

        Args:
            scene: a `Scene`, or bands (B, L, H, W) of `context`'s wavelengths (28 from 420 to 720 nm unless told).
            colour_filter: absorbed if given: the result is then the filter's, at the cost of its channels, not its
                bands.
        Returns:   (B, L, H, W), or what the filter gives; dtype and device of the scene.
        Raises:    ValueError for a tensor of the wrong rank or number of bands.
        """
        if not isinstance(scene, Scene):
            scene = self._as_scene(scene, context or Context())
        if self.rank is not None and self.rank < scene.coefficients.shape[1]:
            scene = scene.low_rank(self.rank)
        planes = scene.coefficients
        working = self.working(scene)
        contraction = None if colour_filter is None else colour_filter.contraction(scene.wavelengths)
        with full_precision(working.device):
            result = self._render(scene, working, contraction).to(planes.dtype)
        return result if colour_filter is None else colour_filter.finish(result)

    def psf_window(self, wavelengths: Tensor, *, vergences: Tensor, picture: tuple[int, int]) -> tuple[int, int]:
        """Window of the PSF in pixels: at most 0.1 % of the light outside, or the window is the picture."""
        if not self.blur:
            return 1, 1
        if self.psf_shape is not None:
            return self.psf_shape
        window = self.lens.window(Points(vergences), wavelengths, self.pixels((1, 1), torch.empty(0)))
        height, width = (min(side, n + (n + 1) % 2) for side, n in zip(window, picture, strict=True))
        return height, width

    def depth_layers(self, depth: Tensor, wavelengths: Tensor, *, waves: float = LAYER_WAVES) -> Tensor:
        """Vergences of the layers that a depth map is cut into, ascending (Z,) [1/m].

        Equal steps of at most `waves` of defocus, or the map's own distances where it has no more of them. A step dV in
        vergence is a^2 dV / (2 lambda) waves at the rim. A map that requires grad is cut into equal steps always: their
        ends carry the gradient of its nearest and farthest point. Their number follows the map in steps. Numbers of one
        per sample (B,) are layers of their own, those that differ: no pixel lies between two of them.
        """
        vergence = 1 / depth.to(torch.float64)
        if not self.blur:
            return vergence.flatten()[:1]
        if vergence.ndim == 1 and len(vergence) > 1:
            return vergence.unique()
        low, high = vergence.min(), vergence.max()
        span = float((high - low).detach())
        if span == 0:
            return vergence.mean()[None] if differentiated(vergence) else low[None]
        if isinstance(self.layers, tuple):
            return 1 / torch.tensor(self.layers, dtype=torch.float64, device=vergence.device)
        nodes = getattr(self.lens, "vergences", None)
        if nodes is not None and self.layers is None:  # between them PSFs are linear, as shares of layers are
            nodes = nodes.to(vergence.device)
            return torch.cat([low[None], nodes[(nodes > low.detach()) & (nodes < high.detach())], high[None]])
        count = self.layers
        if count is None:
            count = 1 + math.ceil(span * self.lens.defocus_waves(wavelengths) / waves)
            own = None if differentiated(vergence) else few_values(vergence, at_most=count)
            if own is not None:
                return own
        if count == 1:
            return (low + high)[None] / 2
        share = torch.linspace(0, 1, count, dtype=torch.float64, device=vergence.device)
        return low + (high - low) * share

    def _check_layers(self, vergence: Tensor, layers: Tensor, wavelengths: Tensor) -> None:
        """Warn where a pixel's distance is farther from all given layers than from the next of the rule's."""
        if self.layers is None or not self._warns or not self.blur:
            return
        nodes, vergence = layers.detach(), vergence.detach().contiguous()
        after = torch.searchsorted(nodes, vergence).clamp(max=len(nodes) - 1)
        away = torch.minimum((nodes[after] - vergence).abs(), (vergence - nodes[(after - 1).clamp(min=0)]).abs())
        worst = float(away.max()) * self.lens.defocus_waves(wavelengths)
        if worst > LAYER_WAVES / 2 * (1 + 1e-6):
            distance = float(1 / vergence.flatten()[away.argmax()])
            warnings.warn(
                f"layers={self.layers} lie up to {worst:.3g} waves of defocus from the map's distances (at "
                f"{distance:.4g} m), and {LAYER_WAVES / 2:g} keep its blur. Take layers=None, or give the distances "
                f"that count, such as layers=({distance:.4g}, ...).",
                stacklevel=2,
            )

    # ---- scene and optics ------------------------------------------------------------------------------------------

    def _as_scene(self, bands: Tensor, context: Context) -> Scene:
        check_bands(bands, name="bands", count=context.wavelengths.numel(), ndims=(4,), sure=False)
        distance = self.distance if self.distance is not None else self.lens.focus_distance
        if distance is None or not distance > 0:
            place = "nobody knows where" if distance is None else f"{distance:g} m, behind itself"
            raise ValueError(f"the lens is focused on {place}; say where the bands are: Imaging(distance=2.0).")
        light = {} if context.illuminant is None else {"illuminant": context.illuminant}
        return Scene.from_bands(
            bands, wavelengths=context.wavelengths, depth=distance, luminance=context.luminance, **light
        )

    def pixels(self, shape: tuple[int, int], like: Tensor) -> PixelGrid:
        """The pixels of a window of PSFs, in the dtype and on the device of `like`."""
        return PixelGrid(self.pixel_pitch, shape, self.fill_factor, self.integrate, like.dtype, like.device)

    @property
    def recipe(self) -> Recipe:
        """How a `Lens` computes its PSFs; other sources have them."""
        return Recipe(self.propagator, self.method, self.samples, self.kappa)

    def bank(self, points: Points, wavelengths: Tensor, pixels: PixelGrid) -> Tensor:
        """PSFs (N, L, h, w) of source points by this stage's recipe, computed anew."""
        if isinstance(self.lens, Lens):
            return self.lens.bank(points, wavelengths, pixels, self.recipe)
        return self.lens.bank(points, wavelengths, pixels)

    def computed_lens(self, *, by: str) -> Lens:
        """The lens, for what asks it more than PSFs. Raises: ValueError, which says `by` whom, where there is none."""
        if not isinstance(self.lens, Lens):
            raise ValueError(
                f"{by} takes a camera with an optics.Lens, which computes its PSFs; this one has a "
                f"{type(self.lens).__name__}."
            )
        return self.lens

    def defocus(self, wavelengths: Tensor) -> Defocus:
        """How far light that is out of focus goes."""
        return self.lens.defocus(wavelengths, self.pixel_pitch) if self.blur else Defocus()

    def psf_bank(self, wavelengths: Tensor, *, vergences: Tensor, shape: tuple[int, int], like: Tensor) -> Tensor:
        """PSFs of the bands of a scene, (Z, L, h, w) in the dtype and on the device of `like`; kept while nothing
        changes. The caller's own: it may be changed in place.
        """
        psfs = self._grouped_bank(wavelengths, points=Points(vergences), shape=shape, like=like)
        owner = self._groups(wavelengths)
        return psfs.clone() if owner is None else psfs[:, owner.to(psfs.device)]

    def _groups(self, wavelengths: Tensor) -> Tensor | None:
        """Which PSF each band takes, (L,), where several take one; None where each has its own."""
        count = len(wavelengths)
        if self.blur and (self.bands is None or self.bands >= count):
            return None
        owner = torch.empty(count, dtype=torch.long)
        for index, group in enumerate(wavelengths.argsort().tensor_split((self.bands or count) if self.blur else 1)):
            owner[group] = index
        return owner

    def _psf_wavelengths(self, wavelengths: Tensor) -> Tensor:
        """At which the PSFs are computed: the bands', or the means of their groups'."""
        owner = self._groups(wavelengths)
        if owner is None:
            return wavelengths
        sums = wavelengths.new_zeros(int(owner.max()) + 1).index_add_(0, owner, wavelengths)
        return sums / owner.bincount()

    def _grouped_bank(self, wavelengths: Tensor, *, points: Points, shape: tuple[int, int], like: Tensor) -> Tensor:
        """PSFs of the groups of bands that share one, (Z, G, h, w)."""
        if not self.blur:
            return like.new_ones(len(points.vergences), 1, 1, 1)

        def build() -> Tensor:
            pixels = self.pixels(shape, like)
            psfs = self.bank(points, self._psf_wavelengths(wavelengths), pixels)
            return psfs / psfs.sum((-2, -1), keepdim=True) if self.renormalise else psfs

        # the whole stage, lens and all: what the PSFs depend on is not listed by hand
        where = (points.vergences, points.positions)
        return self._bank_cache.get((self, wavelengths, where, shape, like.dtype, like.device), build)

    def working(self, scene: Scene) -> Tensor:
        """The scene's planes in the type that is computed in: at least float32."""
        planes = scene.coefficients
        if self.precision is not None:
            return planes.to(getattr(torch, self.precision))
        if planes.dtype == torch.float64 or wide_range(scene):
            return planes.double()
        return planes.float()

    def vergences(self, scene: Scene, depth: Tensor) -> Tensor:
        """Of the layers that a scene is cut into, (Z,): half as far apart where a few lights stand out, whose own blur
        is seen, not its mean.
        """
        fine = depth.numel() > 1 and wide_range(scene)
        return self.depth_layers(depth, scene.wavelengths, waves=LAYER_WAVES / 2 if fine else LAYER_WAVES)

    def layers_of(self, scene: Scene, planes: Tensor) -> tuple[Tensor, Tensor | None]:
        """Vergences of the layers in which there is anything, and the share of each pixel in them; None for one."""
        depth = torch.as_tensor(scene.depth, dtype=torch.float64, device=planes.device)
        vergences = self.vergences(scene, depth)
        if depth.ndim == 1 and len(depth) > 1:
            return vergences, None
        self._check_layers(1 / depth, vergences, scene.wavelengths)
        if vergences.numel() == 1:
            return vergences, None
        shares = layer_shares(1 / depth, vergences, interpolate=self.interpolate).to(planes)
        present = (shares.flatten(2).amax(dim=(0, 2)) > 0).cpu()
        return vergences[present], shares[:, present.to(shares.device)]

    def _layers_at_once(self, bands: int, window: tuple[int, int], planes: Tensor) -> int:
        """Layers whose PSFs are computed together: as many as fit into a quarter of the memory."""
        return max(1, int(self.max_memory / 4 // (bands * window[0] * window[1] * planes.element_size())))

    def work(self, scene: Scene, *, channels: int | None = None) -> Work:
        """What a picture of a scene takes, with new optics: for a filter of so many channels, or for all bands."""
        if len(apart := alike(scene)) > 1:
            works = [self.work(scene.samples(rows), channels=channels) for rows in apart]
            return sum(works[1:], works[0])
        planes = self.working(scene)
        batch, count, height, width = planes.shape
        bands, factored = scene.wavelengths.numel(), scene.spectra is not None
        low_rank = self.rank is not None and self.rank < count
        first = Work()
        if low_rank and self.rank is not None:
            touched = float(batch * height * width * count * (count / 8 + self.rank))
            first, count, factored = Work({"touch": touched}, planes.element_size() * touched / count), self.rank, True
        vergences, _ = self.layers_of(scene, planes)
        window = self.psf_window(scene.wavelengths, vergences=vergences, picture=(height, width))
        layers, itemsize = vergences.numel(), planes.element_size()
        channels = None if layers > 1 and self._per_band else channels
        grouped = self._psf_wavelengths(scene.wavelengths)
        groups = len(grouped)
        shaped = functools.partial(planes.new_empty, device="meta")
        renderer = Renderer(
            shaped(1, groups, *window),
            spectra=shaped(count, bands) if factored else None,
            weights=None if channels is None else shaped(channels, bands),
            **self._rendering(scene),
        )
        rendering = renderer.work(coverage=layers > 1 and self.occlusion)
        scale = itemsize / 4  # twice as many bytes take twice as long
        operations = {kind: number * layers * batch * scale for kind, number in rendering.operations.items()}
        operations["layer"] = float(layers)
        bank = 0.0
        if self.blur:
            at_once = min(layers, self._layers_at_once(bands, window, planes))
            operations |= {"bank": float(math.ceil(layers / at_once)), "psf": float(layers * groups)}
            if isinstance(self.lens, Lens):
                pixels = self.pixels(window, planes)
                operations |= self.lens.operations(Points(vergences), grouped, pixels, self.recipe)
            bank = float(2 * at_once * groups * window[0] * window[1] * itemsize)
        shares = float(layers * height * width * batch * 16) if layers > 1 else 0.0
        zones = 1 if self._positions is None else len(self._positions)
        operations = {kind: count * zones for kind, count in operations.items()}
        return first + Work(operations, rendering.memory * batch + bank + shares)

    # ---- rendering -------------------------------------------------------------------------------------------------

    def _render(self, scene: Scene, planes: Tensor, contraction: Tensor | None) -> Tensor:
        batch, _, height, width = planes.shape
        bands = scene.wavelengths.numel()
        channels = bands if contraction is None else contraction.shape[0]
        if planes.numel() == 0:
            return planes.new_zeros(batch, channels, height, width) + planes.sum()
        if len(groups := alike(scene)) > 1:
            parts = [self._render(scene.samples(rows), planes[rows], contraction) for rows in groups]
            return torch.cat(parts)[torch.cat(groups).argsort().to(planes.device)]
        spectra = None if scene.spectra is None else scene.spectra.to(planes)
        weights = None if contraction is None else contraction.to(planes)
        vergences, shares = self.layers_of(scene, planes)
        afterwards = None
        if shares is not None and self._per_band:
            weights, afterwards = None, weights
        window = self.psf_window(scene.wavelengths, vergences=vergences, picture=(height, width))
        length = self._layers_at_once(bands, window, planes)
        light = planes.new_zeros(())
        for position, own in self._zones(planes):
            layers = Layers(own, shares, occlusion=self.occlusion)
            for start in range(0, vergences.numel(), length):
                points = Points(vergences[start : start + length], position)
                psfs = self._grouped_bank(scene.wavelengths, points=points, shape=window, like=planes)
                renderer = Renderer(psfs, spectra=spectra, weights=weights, **self._rendering(scene))
                layers.add(renderer, first=start)
            light = layers.light if position is None else light + layers.light
        if afterwards is not None:
            light, weights = torch.einsum("cl,blyx->bcyx", afterwards, light), afterwards
        return _not_negative(light, weights)

    def _zones(self, planes: Tensor) -> Iterator[tuple[Tensor | None, Tensor]]:
        """Positions on the sensor (1, 2) [m] at which the optics know their PSFs, and what of the light falls there."""
        if self._positions is None:
            yield None, planes
            return
        picture = (planes.shape[-2], planes.shape[-1])
        shares = field_shares(self._positions, pixel_positions(picture, self.pixel_pitch)).to(planes)
        for position, share in zip(self._positions, shares.unbind(-1), strict=True):
            if bool(share.any()):
                yield position[None], planes * share

    @property
    def _positions(self) -> Tensor | None:
        return getattr(self.lens, "positions", None)

    def _rendering(self, scene: Scene) -> dict[str, Any]:
        """What a `Renderer` is told beside its tensors."""
        own = {name: getattr(self, name) for name in ("border", "direct", "tile", "max_memory")}
        owner, cache = self._groups(scene.wavelengths), self._transfer_cache
        return own | {"picture": tuple(scene.shape[-2:]), "owner": owner, "cache": cache}

    @property
    def _per_band(self) -> bool:
        return self.occlusion and self.coverage == "band"


def wide_range(scene: Scene) -> bool:
    """Whether the light of a picture spans more than float32's transforms hold: 4000 : 1 between what matters.

    They err by about 1e-7 of the brightest, everywhere. That is 1e-3 of what is 4000 times darker, so the transforms
    are float64 where a few lights stand out of the rest (fewer than 5 % of the pixels within 4000 of the brightest),
    or where much is so dark (more than 1 % of what is not black). Black beside large bright areas is left to float32:
    what comes there is off by up to 1e-6 of these. Pictures of 8 bits end at 3300 : 1. All bands count together: beside
    a patch of one band in 28 that band may be off by 5e-3.
    """
    planes = scene.coefficients.detach()
    if not planes.numel():
        return False
    planes = planes if planes.dtype == torch.float64 else planes.float()
    if scene.spectra is None:
        light = planes.sum(1)
    else:
        light = torch.einsum("bkyx,k->byx", planes, scene.spectra.detach().to(planes).sum(1))
    light = light.flatten(1)
    bright = (light >= light.amax(1, keepdim=True) / _RANGE).count_nonzero(1)
    lit = (light > 0).count_nonzero(1)
    return bool(((bright < _FEW_BRIGHT * light.shape[1]) | (lit - bright > _MUCH_DARK * lit)).any())


def _not_negative(light: Tensor, weights: Tensor | None) -> Tensor:
    """Irradiance (B, C, H, W) in which rounding took no pixel below 0, as none can be where the filter has no negative
    weights; the gradient is that of what was computed.
    """
    floor = light.new_zeros(1)
    if weights is not None:
        floor = floor.where((weights.detach() >= 0).all(1), -math.inf)[:, None, None]
    if not differentiated(light):
        return torch.maximum(light, floor, out=light)
    return torch.where(light < floor, light - light.detach(), light)


def _count_or_distances(layers: int | Sequence[float] | Tensor) -> int | tuple[float, ...]:
    """A number of layers, or their distances [m] from far to near, each once."""
    if isinstance(layers, Integral) and not isinstance(layers, bool):
        if layers < 1:
            raise ValueError(f"layers must be a positive number of depth layers, or None, got {layers}.")
        return int(layers)
    try:
        if isinstance(layers, bool):
            raise TypeError("a truth value is no number")
        found = torch.as_tensor(layers, dtype=torch.float64).detach().flatten()
    except (TypeError, ValueError, RuntimeError) as error:
        raise TypeError(
            f"layers must be a number, distances in metres such as (0.5, 2.0), or None, got {layers!r}."
        ) from error
    if not found.numel():
        raise ValueError("layers holds no distance; give some, such as layers=(0.5, 2.0) in metres, a number, or None.")
    for distance in found.tolist():
        check_distances(distance)
    return tuple(sorted(set(found.tolist()), reverse=True))
