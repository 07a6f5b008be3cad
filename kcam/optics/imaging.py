"""Imaging: the light of a scene through a lens onto the sensor, equation (3.1) before the noise.

    I_c = sum_z,l kappa_cl (I_zl * h_zl)

How the picture is convolved stands in `rendering`; here is which PSFs, for which layers of depth.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any, Protocol, TypeVar, Unpack

import torch
from torch import Tensor

from kcam.cache import ValueCache, differentiated, has_derivative
from kcam.context import Context, Curves, Stage, arguments_text
from kcam.effects import Work
from kcam.inputs import as_values, check_bands, describe
from kcam.optics.accuracy import OVER_THE_FIELD, Accuracy, Recipe, Shortcuts
from kcam.optics.banks import KnownPSFs
from kcam.optics.field import FieldBank, FieldEstimate, FieldPicture
from kcam.optics.lens import Lens
from kcam.optics.propagation.row import Propagator
from kcam.optics.regions import zones
from kcam.optics.rendering.borders import BORDERS
from kcam.optics.rendering.depth import LAYER_WAVES, Layers, alike, layer_shares, layer_vergences, places, warn_of_few
from kcam.optics.rendering.place import Place
from kcam.optics.rendering.renderer import Renderer
from kcam.optics.rendering.rounding import not_negative, wide_range
from kcam.optics.source import Defocus, FieldPSFs, PixelGrid, Points, PSFSource, is_field_source, is_source
from kcam.optics.wavelengths import few_wavelengths
from kcam.optics.work import PictureWork
from kcam.precision import full_precision
from kcam.scene import Scene
from kcam.threads import no_more_than_free
from kcam.units import check_distances, check_pixel_pitch, wavelength_grid

_DEFAULT = Accuracy()
_SETTINGS = _DEFAULT.settings().keys()
_RECIPE = {field.name for field in fields(Recipe)}
_FEW_TRACED = 4  # wavelengths that a lens's pupils are traced at; of more they are polynomials
_TRACED, _WINDOWS = 4, 16  # lenses, at some vergences and wavelengths, whose pupils are kept, and whose windows are

T = TypeVar("T")


class Absorber(Curves, Protocol):
    """What `Imaging` lets absorb its bands inside the transform: a `sensor.ColourFilter`."""

    def finish(self, light: Tensor) -> Tensor:
        """What the filter makes of the channels' light (B, C, H, W)."""


def is_deep(scene: Scene) -> bool:
    """Whether a scene has a map of depth, of which one part may hide another."""
    return torch.as_tensor(scene.depth).ndim > 1


def _checked_centre(centre: tuple[float, float]) -> tuple[float, float]:
    numbers = as_values(centre, name="centre", unit="m").reshape(-1)
    if numbers.shape != (2,) or not bool((numbers.abs() < 1).all()):
        raise ValueError(f"centre must be x and y of the picture on the sensor, less than 1 m, got {centre!r}. * mm?")
    return float(numbers[0]), float(numbers[1])


def _within(window: tuple[int, int], picture: tuple[int, int]) -> tuple[int, int]:
    """A window no larger than the picture, or one pixel so that it has a middle."""
    height, width = (min(side, n + (n + 1) % 2) for side, n in zip(window, picture, strict=True))
    return height, width


class Imaging(Stage):
    """The light of a scene through a lens onto the pixels.

    Args:
        lens: the optics: a `Lens`, a `MeasuredPSF`, or anything that follows `source.PSFSource`.
        pixel_pitch: [m]. fill_factor: light-sensitive share of a pixel; the irradiance is its mean over that square,
            and an even scene gives the same whatever the share.
        integrate: the light over each pixel; False takes point samples at the pixels' centres instead.
        border: what lies beyond the picture: reflect, replicate, periodic or zero.
        distance: of a plain tensor [m]; None: where the lens is focused.
        field: whether the PSF varies over the picture, with distortion, lateral colour and vignetting; None: with a
            `CompoundLens`, but not with a `Lens`. False: every pixel sees the PSF of the axis.
        centre: of the picture, x and y on the sensor from the axis [m], as light falls: a sensor that is cropped or
            shifted; None: on the axis.
        accuracy: what is computed and what is left out, an `Accuracy`; shortcuts: its arguments one by one, over those.
            Each is an attribute of the stage too, and may be set.
    Raises: ValueError for an unknown border, a pitch or distance not in metres, and what `Accuracy` refuses.

    Example:
    >>> lens = optics.Lens(optics.CircularAperture(5 * mm), optics.ThinLens(50 * mm), focus_distance=2.0)
    >>> picture = optics.Imaging(lens, pixel_pitch=4 * um)(torch.ones(1, 28, 64, 64))
    >>> picture.shape, bool((picture - 1).abs().max() < 0.02)  # an even wall stays even
    (torch.Size([1, 28, 64, 64]), True)
    """

    def __init__(
        self,
        lens: PSFSource,
        *,
        pixel_pitch: float = 4e-6,
        fill_factor: float = 1.0,
        integrate: bool = True,
        border: str = "reflect",
        distance: float | None = None,
        field: bool | None = None,
        centre: tuple[float, float] | None = None,
        accuracy: Accuracy = _DEFAULT,
        **shortcuts: Unpack[Shortcuts],
    ) -> None:
        super().__init__()
        if not is_source(lens):
            raise TypeError(f"Imaging takes an optics.Lens or another source of PSFs, got {type(lens).__name__}.")
        if border not in BORDERS:
            raise ValueError(f"unknown border {border!r}; known: {', '.join(BORDERS)}.")
        if distance is not None:
            if check_distances(distance).numel() != 1:
                raise TypeError(
                    f"distance must be one number of metres, got {describe(distance)}. Use "
                    "Scene.from_bands(bands, depth=distance) for one per sample or a map."
                )
            distance = float(distance)
        self.lens = lens
        self.pixel_pitch, self.fill_factor = check_pixel_pitch(pixel_pitch), fill_factor
        self.integrate, self.border, self.distance = integrate, border, distance
        if field and not is_field_source(lens):
            raise ValueError(f"a {type(lens).__name__} has one PSF, that on the axis: leave out field=True.")
        self.field, self.centre = field, None if centre is None else _checked_centre(centre)
        if not isinstance(accuracy, Accuracy):
            raise TypeError(f"accuracy must be an optics.Accuracy, got {describe(accuracy)}. Use Accuracy(bands=12).")
        self.accuracy = replace(accuracy, **shortcuts)
        self._warns = True  # of too few layers
        self._bank_cache, self._transfer_cache = ValueCache(), ValueCache()
        self._traced_cache, self._field_cache = ValueCache(_TRACED), ValueCache()
        self._window_cache = ValueCache(_WINDOWS)
        self._reach: float | None = None  # from the axis, of the picture of which this is a part [m]
        self.known: KnownPSFs | None = None  # while the lens stays as it is, see `knowing`
        self._known_cache = ValueCache()
        self._check_recipe()

    def __setattr__(self, name: str, value: Any) -> None:
        if name in _SETTINGS:
            name, value = "accuracy", replace(self.accuracy, **{name: value})
        if name == "accuracy":
            row = value.propagator
            self.own_propagator = row if isinstance(row, Propagator) else None  # its parameters are the stage's
        super().__setattr__(name, value)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.accuracy, name) if name in _SETTINGS else super().__getattr__(name)

    def configuration(self) -> dict[str, Any]:
        """Constructor arguments, for saving: those of the accuracy one by one."""
        names = ("lens", "pixel_pitch", "fill_factor", "integrate", "border", "distance", "field", "centre")
        return {name: getattr(self, name) for name in names} | self.accuracy.settings()

    def extra_repr(self) -> str:
        """The arguments, but for those of optics that vary over the picture where these do not, and what is off."""
        off = () if self.accuracy.interpolate_bands else ("interpolate_bands",)
        return arguments_text(self, but=off + (() if self.varies else OVER_THE_FIELD))

    def changed(self, **arguments: Any) -> Imaging:
        """The same stage with some of its constructor's arguments changed; it shares the lens and what is known of its
        field, by value, and has kept nothing else.

        Of layers that are changed here no warning says that they are few: a plan has weighed what they cost.
        """
        if arguments.keys() <= _SETTINGS:
            changed = self._with(replace(self.accuracy, **arguments))
            if arguments.keys() & _RECIPE:
                changed._check_recipe(known=True)
        else:
            changed = type(self)(**(self.configuration() | arguments))
        shared = ["_traced_cache", "_window_cache", "_reach", "known"]
        ours, theirs = self.accuracy, changed.accuracy
        if (ours.bands, ours.lateral_colour, ours.blur) == (theirs.bands, theirs.lateral_colour, theirs.blur):
            shared.append("_field_cache")
        vars(changed).update({name: vars(self)[name] for name in shared})  # past torch's checks, at each step of a plan
        changed._warns = self._warns and "layers" not in arguments
        return changed

    def _with(self, accuracy: Accuracy) -> Imaging:
        """The same stage, hooks and all, with another accuracy, which has kept nothing."""
        changed = type(self).__new__(type(self))
        own = {name: value.copy() if isinstance(value, (dict, set)) else value for name, value in vars(self).items()}
        own |= {name: ValueCache() for name in ("_bank_cache", "_transfer_cache", "_field_cache", "_known_cache")}
        vars(changed).update(own, accuracy=accuracy)
        if accuracy.propagator is not self.accuracy.propagator:
            changed.accuracy = accuracy
        return changed

    def fresh(self) -> Imaging:
        """The same stage that has kept nothing, but for the pupils that were traced."""
        own = self.changed()
        own._field_cache, own._window_cache, own.known = ValueCache(), ValueCache(_WINDOWS), None
        return own

    def knowing(self, wavelengths: Tensor) -> Imaging:
        """The same stage, which keeps each PSF that it and those changed from it compute without gradients, for scenes
        of these wavelengths, as `known`: by what it is now. What does not depend on what was asked before is kept for
        the next that is asked for, by value.
        """
        own = self.changed()
        if not self.varies and self._positions is None:
            ends = torch.stack(wavelengths.aminmax()) if getattr(self.lens, "symmetric", False) else wavelengths[:0]
            own.known = replace(
                self._known_cache.get((self, wavelengths), lambda: KnownPSFs(ends)), psfs={}, windows={}, seen={}
            )
        return own

    def knowing_enough(self) -> Imaging:
        """The same stage with what it knows, for a picture: PSFs that it does not know are computed alone."""
        own = self.changed()
        own.known = None if self.known is None else replace(self.known, ends=self.known.ends[:0])
        return own

    def _check_recipe(self, *, known: bool = False) -> None:
        """What asks for a method that does not exist, or for one where nothing is computed, is refused at once.

        known: the lens with another recipe was asked already, and a propagator and kappa alone tell what they are.
        """
        if isinstance(self.lens, Lens) and not self.field:
            if known and self.accuracy.method is None and self.accuracy.samples is None:
                return
            pixels = self.pixels(self.accuracy.psf_shape or (1, 1), torch.empty(0))
            query = self.lens.question(Points(torch.zeros(1)), wavelength_grid([550e-9]), pixels, self.accuracy)
            if self.accuracy.method is not None:
                self.accuracy.row(query)
            return
        own = ((field.name, getattr(self.accuracy, field.name) != field.default) for field in fields(Recipe))
        given = ", ".join(f"{name}=" for name, changed in own if changed)
        if given and self.field:
            raise ValueError(
                f"{given} says how PSFs of the axis are computed; over the field there is one way. Leave it out."
            )
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
        if self.accuracy.rank is not None and self.accuracy.rank < scene.coefficients.shape[1]:
            scene = scene.low_rank(self.accuracy.rank)
        planes = scene.coefficients
        working = self.working(scene)
        contraction = None if colour_filter is None else colour_filter.contraction(scene.wavelengths)
        with full_precision(working.device):
            result = self._render(scene, working, contraction).to(planes.dtype)
        return result if colour_filter is None else colour_filter.finish(result)

    def psf_window(
        self, wavelengths: Tensor, *, vergences: Tensor, picture: tuple[int, int], among: Tensor | None = None
    ) -> tuple[int, int]:
        """Window (H, W) of the PSF [pixels]: at most 0.1 % of the light outside, or the window is the picture.

        Args: wavelengths: (L,) [m]. vergences: of the layers, (Z,) [1/m]. picture: (H, W) [pixels]. among: others
            (N,) [1/m] with the same ends or farther ones, for which a real lens is traced instead.
        """
        if not self.accuracy.blur:
            return 1, 1
        if self.accuracy.psf_shape is not None:
            return self.accuracy.psf_shape
        pixels = self.pixels((1, 1), torch.empty(0))
        if self.varies:
            among = vergences if among is None else among
            find = self._traced(picture, among, wavelengths).at_vergences(vergences).window
            key = self.lens, self._corner(picture), among, vergences, wavelengths, self.psf_wavelengths(wavelengths)
            return _within(self._window_cache.get((*key, pixels), lambda: find(pixels)), picture)
        find = functools.partial(self.lens.window, Points(vergences), wavelengths, pixels)
        if self.known is not None:
            return _within(self.known.window(vergences, wavelengths, pixels, find), picture)
        return _within(self._window_cache.get((self.lens, vergences, wavelengths, pixels), find), picture)

    def depth_layers(self, depth: Tensor, wavelengths: Tensor, *, waves: float = LAYER_WAVES) -> Tensor:
        """Vergences of the layers that a depth map is cut into, ascending (Z,) [1/m].

        Equal steps of at most `waves` of defocus, or the map's own distances where it has no more of them. A step dV in
        vergence is a^2 dV / (2 lambda) waves at the rim. A map that requires grad is cut into equal steps always: their
        ends carry the gradient of its nearest and farthest point. Their number follows the map in steps. Numbers of one
        per sample (B,) are layers of their own, those that differ: no pixel lies between two of them.
        """
        vergence = 1 / depth.to(torch.float64)
        if not self.accuracy.blur:
            return vergence.flatten()[:1]
        return layer_vergences(
            vergence,
            self.accuracy.layers,
            known=getattr(self.lens, "vergences", None),
            steps=lambda span: span * self.lens.defocus_waves(wavelengths) / waves,
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

    def bank(self, points: Points, wavelengths: Tensor, pixels: PixelGrid) -> Tensor:
        """PSFs (N, L, h, w) of source points by this stage's accuracy, computed anew unless it is `knowing`."""

        def compute(vergences: Tensor, wavelengths: Tensor, pixels: PixelGrid) -> Tensor:
            own = replace(points, vergences=vergences)
            if isinstance(self.lens, Lens):
                return self.lens.bank(own, wavelengths, pixels, self.accuracy)
            return self.lens.bank(own, wavelengths, pixels)

        if self.known is None or torch.is_grad_enabled():
            return compute(points.vergences, wavelengths, pixels)
        return self.known.bank(self.accuracy.recipe, points.vergences, wavelengths, pixels, compute)

    def computed_lens(self, *, by: str) -> Lens:
        """The lens, for what asks it more than PSFs. Raises: ValueError, which says `by` whom, where there is none."""
        if not isinstance(self.lens, Lens):
            raise ValueError(
                f"{by} takes a camera with an optics.Lens, which computes its PSFs; this one has a "
                f"{type(self.lens).__name__}."
            )
        return self.lens

    def defocus(self, wavelengths: Tensor) -> Defocus:
        """How far light that is out of focus goes: see `source.Defocus`; wavelengths (L,) [m]."""
        if not self.accuracy.blur:
            return Defocus()
        find = functools.partial(self.lens.defocus, wavelengths, self.pixel_pitch)
        return self._once((self.lens,), ("defocus", self.pixel_pitch, *wavelengths.tolist()), find)

    def psf_bank(self, wavelengths: Tensor, *, vergences: Tensor, shape: tuple[int, int], like: Tensor) -> Tensor:
        """PSFs of the bands of a scene at one distance, (Z, L, h, w) in the dtype and on the device of `like`; kept
        while nothing changes. The caller's own: it may be changed in place.
        """
        nodes, shares = self._few(wavelengths, deep=False)
        psfs = self._grouped_bank(nodes, points=Points(vergences), shape=shape, like=like)
        with full_precision(psfs.device):
            return psfs.clone() if shares is None else torch.einsum("lg,zghw->zlhw", shares.to(psfs), psfs)

    def _few(self, wavelengths: Tensor, *, deep: bool) -> tuple[Tensor, Tensor | None]:
        count, accuracy = len(wavelengths), self.accuracy
        if accuracy.blur and (accuracy.bands is None or accuracy.bands >= count):
            return wavelengths, None
        few, between = (accuracy.bands or count) if accuracy.blur else 1, accuracy.interpolate_bands
        return few_wavelengths(wavelengths, few, interpolate=between and not (deep or self.varies))

    def psf_wavelengths(self, wavelengths: Tensor, *, deep: bool = False) -> Tensor:
        """At which the PSFs are computed, (G,) [m]: the bands', or fewer; deep: of a scene with a map of depth."""
        return self._few(wavelengths, deep=deep)[0]

    def shares(self, wavelengths: Tensor, *, deep: bool = False) -> Tensor | None:
        """What each of these PSFs gives to each band, (L, G); None where each band has its own."""
        return self._few(wavelengths, deep=deep)[1]

    def _colours(self, scene: Scene) -> tuple[Tensor, Tensor | None]:
        return self._few(scene.wavelengths, deep=is_deep(scene))

    def _grouped_bank(self, nodes: Tensor, *, points: Points, shape: tuple[int, int], like: Tensor) -> Tensor:
        """PSFs at wavelengths (G,), from which the bands take theirs, (Z, G, h, w)."""
        if not self.accuracy.blur:
            return like.new_ones(len(points.vergences), 1, 1, 1)

        def build() -> Tensor:
            pixels = self.pixels(shape, like)
            psfs = self.bank(points, nodes, pixels)
            return psfs / psfs.sum((-2, -1), keepdim=True) if self.accuracy.renormalise else psfs

        # the whole stage, lens and all: what the PSFs depend on is not listed by hand
        where = (points.vergences, points.positions)
        return self._bank_cache.get((self, nodes, where, shape, like.dtype, like.device), build)

    def working(self, scene: Scene) -> Tensor:
        """The scene's planes (B, K, H, W) in the type that is computed in: at least float32."""
        planes = scene.coefficients
        if self.accuracy.precision is not None:
            return planes.to(getattr(torch, self.accuracy.precision))
        return planes.double() if planes.dtype == torch.float64 or self._wide(scene) else planes.float()

    def _wide(self, scene: Scene) -> bool:
        return self._once((scene.coefficients, scene.spectra), "range", functools.partial(wide_range, scene))

    def _once(self, parts: tuple[object, ...], how: object, look: Callable[[], T]) -> T:
        """What a look tells, which is kept while the stage is `knowing`: see `KnownPSFs.once`."""
        return look() if self.known is None else self.known.once(parts, how, look)

    def vergences(self, scene: Scene, depth: Tensor, *, wavelengths: Tensor | None = None) -> Tensor:
        """Of the layers that a scene is cut into, (Z,) [1/m]: half as far apart where a few lights stand out, whose own
        blur is seen, not its mean. wavelengths: (L,) [m] that ask for them; None for the scene's.
        """
        light = scene.wavelengths if wavelengths is None else wavelengths

        def cut() -> Tensor:
            fine = depth.numel() > 1 and self._wide(scene)
            return self.depth_layers(depth, light, waves=LAYER_WAVES / 2 if fine else LAYER_WAVES)

        if differentiated(depth):
            return cut()
        how = self.accuracy.layers, self.accuracy.blur, depth.device, tuple(light.tolist())
        return self._once((scene.coefficients, scene.depth), how, cut)

    def layers_of(self, scene: Scene, planes: Tensor) -> tuple[Tensor, Tensor | None]:
        """Vergences of the layers in which there is anything, (Z,) [1/m], and the share of each pixel in them,
        (B, Z, H, W); None for one.
        """
        depth = torch.as_tensor(scene.depth, dtype=torch.float64, device=planes.device)
        vergences = self.vergences(scene, depth)
        if depth.ndim == 1 and len(depth) > 1:
            return vergences, None
        if self.accuracy.layers is not None and self.accuracy.blur and self._warns:
            waves = self.lens.defocus_waves(scene.wavelengths)
            warn_of_few(self.accuracy.layers, vergences, vergence=1 / depth, defocus_waves=waves)
        if vergences.numel() == 1:
            return vergences, None
        shares = layer_shares(1 / depth, vergences, interpolate=self.accuracy.interpolate, dtype=planes.dtype)
        filled = shares.detach().amax((0, 2, 3)) > 0
        return vergences[filled.to(vergences.device)], shares[:, filled]

    def filled(self, scene: Scene) -> tuple[Tensor, list[Place]]:
        """Vergences of the layers in which there is anything, (Z,) [1/m], and where each is; [] where it is rendered
        everywhere: one layer, and maps with a derivative.
        """
        depth = torch.as_tensor(scene.depth, dtype=torch.float64, device=scene.coefficients.device)
        vergences = self.vergences(scene, depth)
        if depth.ndim < 2 or vergences.numel() == 1:
            return vergences, []
        found = places(1 / depth, vergences, interpolate=self.accuracy.interpolate)
        filled = [layer for layer, place in enumerate(found) if place is not None]
        return vergences[filled], [] if differentiated(depth) else [place for place in found if place is not None]

    def work(
        self,
        scene: Scene,
        *,
        channels: int | None = None,
        apart: int | None = None,
        known: tuple[Tensor, Tensor, list[Place]] | None = None,
    ) -> Work:
        """What a picture of a scene takes, with new optics: for a filter of so many channels, or for all bands. A lens
        has been traced over its field; apart: pixels between places where `spacing` leaves that to the scene, if known.
        known: planes of the scene as `working` gives them, and what `filled` tells of its layers.
        """
        if len(groups_of := alike(scene)) > 1:
            works = [self.work(scene.samples(rows), channels=channels, apart=apart) for rows in groups_of]
            return sum(works[1:], works[0])
        planes, vergences, where = (self.working(scene), *self.filled(scene)) if known is None else known
        picture, wavelengths, layers = scene.shape[1:], scene.wavelengths, len(vergences)
        among = self.spanning(scene) if self.varies else None
        window = self.psf_window(wavelengths, vergences=vergences, picture=picture, among=among)
        shapes = planes.new_empty(0, device="meta")
        channels = None if layers > 1 and self.accuracy.per_band else channels
        weights = None if channels is None else shapes.new_empty(channels, len(wavelengths))
        renderer = self._renderer(scene, window, weights=weights, like=shapes)
        own, pixels = PictureWork(planes, renderer, layers, self.accuracy, where), self.pixels(window, planes)
        if among is not None:
            points = self._traced(picture, among, wavelengths).at_vergences(vergences).points(pixels)
            return own.over_field(points, apart=apart, mirrored=self.centre is None)
        psfs = {}
        if isinstance(self.lens, Lens) and self.accuracy.blur:
            psfs = self.lens.operations(Points(vergences), self.psf_wavelengths(wavelengths), pixels, self.accuracy)
        return own.on_axis(psfs, zones=1 if self._positions is None else len(self._positions))

    # ---- rendering -------------------------------------------------------------------------------------------------

    def _render(self, scene: Scene, planes: Tensor, contraction: Tensor | None) -> Tensor:
        batch, _, height, width = planes.shape
        if planes.numel() == 0:
            channels = scene.wavelengths.numel() if contraction is None else contraction.shape[0]
            return planes.new_zeros(batch, channels, height, width) + planes.sum()
        if len(groups := alike(scene)) > 1:
            parts = [self._render(scene.samples(rows), planes[rows], contraction) for rows in groups]
            return torch.cat(parts)[torch.cat(groups).argsort().to(planes.device)]
        weights = None if contraction is None else contraction.to(planes)
        vergences, shares = self.layers_of(scene, planes)
        late = shares is not None and self.accuracy.per_band
        weights, afterwards = (None, weights) if late else (weights, None)
        if self.varies:
            learns = has_derivative((self.lens, planes, shares, scene.spectra, vergences, weights))
            with torch.set_grad_enabled(learns and torch.is_grad_enabled()):  # else nothing is to be kept for it
                field = self._field_picture(scene, vergences=vergences, weights=weights, like=planes)
                light = field.light(planes, shares)
            return self._finished(light, weights, afterwards)
        window = self.psf_window(scene.wavelengths, vergences=vergences, picture=(height, width))
        renderer = self._renderer(scene, window, weights=weights, like=planes)
        light, nodes, length = planes.new_zeros(()), self._colours(scene)[0], renderer.at_once
        for position, own in zones(planes, self._positions, pixel_pitch=self.pixel_pitch):
            layers = Layers(own, shares, occlusion=self.accuracy.occlusion)
            for start in range(0, len(vergences), length):
                points = Points(vergences[start : start + length], position)
                psfs = self._grouped_bank(nodes, points=points, shape=window, like=planes)
                layers.add(replace(renderer, psfs=psfs), first=start)
            light = layers.light if position is None else light + layers.light
        return self._finished(light, weights, afterwards)

    def _finished(self, light: Tensor, weights: Tensor | None, afterwards: Tensor | None) -> Tensor:
        if afterwards is not None:
            light, weights = torch.einsum("cl,blyx->bcyx", afterwards, light), afterwards
        return not_negative(light, weights)

    def _renderer(self, scene: Scene, window: tuple[int, int], *, weights: Tensor | None, like: Tensor) -> Renderer:
        """How a picture is convolved, with PSFs of which there are the sizes alone."""
        nodes, shares = self._colours(scene)
        psfs, spectra = like.new_empty(1).expand(1, len(nodes), *window), scene.spectra
        own = {name: getattr(self.accuracy, name) for name in ("direct", "tile", "max_memory")}
        own |= {"border": self.border, "picture": scene.shape[1:], "shares": shares, "cache": self._transfer_cache}
        return Renderer(psfs, spectra=None if spectra is None else spectra.to(like), weights=weights, **own)

    # ---- over the field --------------------------------------------------------------------------------------------

    @property
    def varies(self) -> bool:
        """Whether the PSF varies over the picture."""
        if not is_field_source(self.lens) or not self.accuracy.blur:
            return False
        return self.lens.varies if self.field is None else self.field

    @property
    def _middle(self) -> tuple[float, float]:
        return self.centre or (0.0, 0.0)

    def reach(self, picture: tuple[int, int]) -> float:
        """How far a picture (H, W) goes from the axis [m]."""
        half = (self.pixel_pitch * n / 2 for n in picture[::-1])
        return math.hypot(*(abs(c) + side for c, side in zip(self._middle, half, strict=True)))

    def _corner(self, picture: tuple[int, int]) -> float:
        """How far the whole of which this is the picture, or a part, goes from the axis [m]."""
        return self.reach(picture) if self._reach is None else self._reach

    def part(self, place: tuple[float, float], *, reach: float) -> Imaging:
        """The same stage for a part of its picture, whose middle lies at `place`, x and y from that of the picture,
        upright [pixels]; reach: of the whole picture [m].
        """
        x, y = (c - at * self.pixel_pitch for c, at in zip(self._middle, place, strict=True))
        own = self.changed(centre=(x, y))
        own._reach = reach
        return own

    def _over_field(
        self, picture: tuple[int, int], vergences: Tensor, wavelengths: Tensor, *, traced: FieldPSFs | None = None
    ) -> FieldPSFs:
        """PSFs of all places of a picture, traced once for all ways to group the wavelengths."""
        grouped, lateral = self.psf_wavelengths(wavelengths), self.accuracy.lateral_colour

        def build() -> FieldPSFs:
            found = self._traced(picture, vergences, wavelengths) if traced is None else traced
            return found.at_wavelengths(grouped, lateral_colour=lateral)

        return self._field_cache.get(
            (self.lens, self._corner(picture), vergences, wavelengths, grouped, lateral), build
        )

    def _traced(self, picture: tuple[int, int], vergences: Tensor, wavelengths: Tensor) -> FieldPSFs:
        """Those of all wavelengths, which the groups of any number take theirs from."""
        lens: Any = self.lens  # which `varies` has made sure of
        corner = self._corner(picture)
        own = wavelengths if len(wavelengths) > _FEW_TRACED else self.psf_wavelengths(wavelengths)
        return self._traced_cache.get(
            (self.lens, corner, vergences, own), lambda: lens.over_field(corner, vergences, own)
        )

    def _field_picture(self, scene: Scene, *, vergences: Tensor, weights: Tensor | None, like: Tensor) -> FieldPicture:
        picture, wavelengths = scene.shape[1:], scene.wavelengths
        traced = self._traced(picture, vergences, wavelengths)
        window = self.psf_window(wavelengths, vergences=vergences, picture=picture)
        psfs = self._over_field(picture, vergences, wavelengths, traced=traced)
        renderer, mixing = self._renderer(scene, (1, 1), weights=weights, like=like), None
        fewer = renderer.channels * renderer.planes < renderer.groups
        if fewer and len(vergences) == 1:  # of layers the PSFs themselves tell what they hide
            renderer, mixing = renderer.of_sums(), renderer.mixing().flatten(0, 1)
        return FieldPicture(psfs, self.pixels(window, like), self._middle, self.accuracy, mixing, renderer)

    def spanning(self, scene: Scene) -> Tensor:
        """Vergences of the layers of a scene, (Z,) [1/m], as many as the rule says, and at distances that were given:
        those for which a real lens is traced that is asked for others, too.
        """
        depth = torch.as_tensor(scene.depth, dtype=torch.float64, device=scene.coefficients.device)
        layers = self.accuracy.layers
        if layers is None or not is_deep(scene):
            return self.vergences(scene, depth)
        found = self.changed(layers=None).vergences(scene, depth)
        return found if isinstance(layers, int) else torch.cat([found, self.vergences(scene, depth)]).unique()

    def field_psfs(
        self, picture: tuple[int, int], traced: tuple[Tensor, Tensor], *, vergences: Tensor, wavelengths: Tensor
    ) -> FieldPSFs:
        """PSFs of places of a picture (H, W), of layers (Z,) [1/m] and wavelengths (G,) [m]: in the ranges of the
        vergences and wavelengths for which the lens is `traced`.
        """
        found = self._traced(picture, *traced).at_vergences(vergences)
        return found.at_wavelengths(wavelengths, lateral_colour=self.accuracy.lateral_colour)

    def field_bank(self, psfs: FieldPSFs, pixels: PixelGrid) -> FieldBank:
        """These as this stage takes them."""
        return FieldBank(psfs, pixels, self._middle, self.accuracy, None)

    def moved(self, scene: Scene, planes: Tensor, *, vergences: Tensor) -> Tensor:
        """Planes (B, J, H, W) over a scene, as distortion and relative illumination bring them to the picture;
        vergences: (Z,) [1/m], for which the lens is traced.
        """
        field = self._field_picture(scene, vergences=vergences, weights=None, like=planes)
        return field.moved(planes, None)[0]

    @no_more_than_free()
    def explain(self, scene: Scene, *, colour_filter: Absorber | None = None) -> FieldEstimate:
        """What a picture over the field will be off by; as it is with `forward`'s arguments. Raises: ValueError for
        optics whose PSF does not vary.
        """
        if not self.varies:
            raise ValueError("every pixel of this picture sees one PSF: ask lens.explain() what that is off by.")
        field, planes, shares = self._asked(scene, colour_filter)
        return field.explain(planes, shares)

    @no_more_than_free()
    @torch.no_grad()
    def apart(self, scene: Scene, *, colour_filter: Absorber | None = None) -> int:
        """How many pixels lie between the places of a picture over the field, at least; its longer side where it has
        one on purpose. Arguments and errors as of `explain`.
        """
        if not self.varies:
            raise ValueError("every pixel of this picture sees one PSF: there is one place.")
        if self.accuracy.spacing is not None:
            return self.accuracy.spacing
        found = []
        for rows in alike(scene):
            field, planes, shares = self._asked(scene.samples(rows), colour_filter)
            found.append(int(min(field.how(*field.moved(planes, shares)).apart, max(scene.shape[1:]))))
        return min(found)

    def distorted(self, scene: Scene) -> float:
        """How far distortion moves light of a picture, at most [pixels]: in its corners and the middle of its sides."""
        places, psfs = self._outermost(scene)
        return float((psfs.undistorted(places) - places).norm(dim=-1).max()) / self.pixel_pitch

    def illuminated(self, scene: Scene) -> float:
        """Relative illumination of an even scene where it is least, 0 to 1: in corners and the middle of sides."""
        places, psfs = self._outermost(scene)
        return float(psfs.illumination(places).min())

    @torch.no_grad()
    def _outermost(self, scene: Scene) -> tuple[Tensor, FieldPSFs]:
        _, height, width = scene.shape
        sides = torch.tensor([-0.5, 0.0, 0.5], dtype=torch.float64) * self.pixel_pitch
        places = torch.cartesian_prod(sides * width, sides * height) + torch.tensor(self._middle, dtype=torch.float64)
        return places, self._traced((height, width), self.spanning(scene), scene.wavelengths)

    def _asked(self, scene: Scene, colour_filter: Absorber | None) -> tuple[FieldPicture, Tensor, Tensor | None]:
        planes = self.working(scene)
        weights = None if colour_filter is None else colour_filter.contraction(scene.wavelengths).to(planes)
        vergences, shares = self.layers_of(scene, planes)
        return self._field_picture(scene, vergences=vergences, weights=weights, like=planes), planes, shares

    @property
    def _positions(self) -> Tensor | None:
        return getattr(self.lens, "positions", None)
