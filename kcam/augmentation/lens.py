"""Real lenses: a picture photographed through one drawn from a list, with all that its lens does over the field."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from kornia.constants import Resample
from kornia.geometry.transform import remap
from torch import Tensor, nn

from kcam.augmentation.base import check_probability, on_drawn_rows, simulated, wavelengths_of
from kcam.augmentation.distributions import Bounds, Choice, Draw, Draws, Uniform
from kcam.augmentation.geometry import MovedPixels
from kcam.cache import Settings, ValueCache
from kcam.compiled import uncompiled
from kcam.inputs import describe
from kcam.optics import CompoundLens, Imaging
from kcam.optics.compound.distortion import ImageHeights
from kcam.optics.compound.files import SUFFIXES
from kcam.optics.compound.presets import PRESETS
from kcam.optics.rendering.borders import BORDERS, border_index
from kcam.scene import Scene
from kcam.ste import clip_ste
from kcam.units import PIXEL_PITCH_RANGE, check_distances, wavelength_grid

_VIEWS = 64  # kept
_MOST_REACH = 0.99
_WIDEST_PIXEL = 200  # wavelengths times f-number: the time of a PSF rises as its square
_NODES = 4  # cells of PSFs along the longer side
_CLOSEST = 8  # pixels between nodes, at least
_FIXED_POINT, _CLOSE = 200, 1e-9  # steps of the inverse at most, and of the reach
LENSES = ("cooke_triplet", "ef50", "wide_angle", "phone")


@dataclass(frozen=True)
class _Circle:
    """radius: of the image circle [m]. widest: a pixel [m]. heights: where images lie."""

    radius: float
    widest: float
    heights: ImageHeights

    def magnified(self, radii: Tensor) -> Tensor:
        """Distance from the axis without distortion over the lens's own, at the lens's own (...) [m]; beyond the circle
        as at its edge.
        """
        at = radii.clamp(max=_MOST_REACH * self.radius)
        return self.heights.scale.detach().to(radii.device) * self.heights.over_radius.at(at**2)

    def imaged(self, ideal: Tensor) -> Tensor:
        """Where the lens brings what one without distortion brings to distances (...) [m] from the axis."""
        radii = ideal
        for _ in range(_FIXED_POINT):
            last, radii = radii, ideal / self.magnified(radii)
            if float((radii - last).abs().max()) < _CLOSE * self.radius:
                break
        return radii


class RandomLens(MovedPixels):
    """Photograph each sample through a real lens drawn from a list: blur, distortion, lateral colour and vignetting.

    `optics.Imaging` of an `optics.CompoundLens`, in linear light: PSFs of exact rays that vary over the field. The
    picture is what the sensor sees: its corners lie at the share `reach` of the lens's image circle, so that pixels are
    as wide as the picture's size makes them, up to 200 wavelengths times the f-number; smaller pictures, of less than
    some 100 x 100 with a 50 mm lens, see less of the field. On the small pictures of a data set pixels are wide, and a
    good lens in focus blurs by less than one: what is seen of it is distortion, vignetting and lateral colour.

    Masks are taken from the nearest pixel, keypoints move by the lens's chief rays, a box becomes the box around its
    moved edges. What lies beyond the picture is its `border`, of masks too.

    A lens is traced, and its PSFs computed, once for each size of picture, reach and distance: 2 to 10 s of one core.
    Both are drawn from `steps` values, not any, so that this ends:
    after it a sample of 3 x 256 x 256 takes 0.1 s of one core. At most 64 of them are kept, with their PSFs; nothing
    of a lens that trains, which is computed anew for every sample.

    Args:      lens: presets by name (`optics.compound.presets.PRESETS`), files (.zmx, .json), or CompoundLens objects.
                   Presets and files are focused at `focus`, stopped down, and not trained; a lens of one's own is taken
                   as it is, and gradients reach its parameters.
               reach: half diagonal of the picture over the radius of the image circle: that of a preset's field, or
                   else where `CompoundLens.field_limit` ends.
               distance: of the picture [m], uniform in 1/m. steps: values that reach and distance each are drawn from.
               focus: [m]. stops: how far the aperture is closed, in photographic stops; 0 is wide open.
               border: what lies beyond the picture: reflect, replicate, periodic or zero. wavelengths: of the channels
                   [m]; None: see `base`.
    Raises:    ValueError, TypeError for no lens, an unknown one, numbers out of range or trained ones, an unknown
        border; FileNotFoundError, ValueError as `CompoundLens.from_file`.

    Example:
    >>> augment = KC.RandomLens("phone", reach=0.5, steps=1, p=1.0)  # one of four lenses by default
    >>> augment(torch.rand(1, 1, 24, 24)).shape
    torch.Size([1, 1, 24, 24])
    """

    in_light = True

    def __init__(
        self,
        lens: str | os.PathLike[str] | CompoundLens | Sequence[str | os.PathLike[str] | CompoundLens] = LENSES,
        reach: Bounds = (0.6, 0.95),
        *,
        distance: Bounds = (1.5, 3.0),
        steps: int = 3,
        focus: float = 2.0,
        stops: float = 1.0,
        border: str = "reflect",
        wavelengths: Tensor | list[float] | None = None,
        same_on_batch: bool = False,
        p: float = 0.5,
        keepdim: bool = False,
    ) -> None:
        check_probability(p)
        given = [lens] if isinstance(lens, (str, os.PathLike, CompoundLens)) else list(lens)
        if not given:
            raise ValueError('lens is empty: give at least one, such as lens=["ef50"].')
        if isinstance(steps, bool) or not isinstance(steps, int) or steps < 1:
            raise ValueError(f"steps must be a whole number of 1 or more, got {steps!r}.")
        if not isinstance(stops, (int, float)) or not 0 <= stops <= 10:
            raise ValueError(f"stops must be a number from 0, wide open, to 10, got {stops!r}.")
        if border not in BORDERS:
            raise ValueError(f"unknown border {border!r}; known: {', '.join(BORDERS)}.")
        for name, bounds in (("reach", reach), ("distance", distance)):
            if isinstance(bounds, nn.Parameter):
                raise ValueError(f"{name} cannot be trained: its values are steps. Use {name}=(low, high).")
        check_distances(focus, name="focus")
        super().__init__(p=p, same_on_batch=same_on_batch, p_batch=1.0, keepdim=keepdim)
        draws: dict[str, Draw] = {
            "lens": Choice(len(given)),
            "reach": Uniform(reach, least=0.01, most=_MOST_REACH, unit="of the image circle", steps=steps),
            "distance": Uniform(distance, "vergence", least=1e-2, unit="[m]", steps=steps),
        }
        self._param_generator: Draws = Draws(draws)
        self.lenses = nn.ModuleList(_opened(one, focus=float(focus), stops=float(stops)) for one in given)
        self._fields = [PRESETS[str(one)].field if _is_preset(one) else None for one in given]
        names = (type(one).__name__ if isinstance(one, CompoundLens) else str(one) for one in given)
        self.flags = {"lenses": "/".join(names), "steps": steps, "stops": stops, "border": border}
        self.flags["resample"] = Resample.BILINEAR  # of the inverse; a mask's is the nearest
        self.border = border
        self.wavelengths = None if wavelengths is None else wavelength_grid(wavelengths)
        self._circles = [ValueCache() for _ in given]
        self._views: dict[tuple[Any, ...], tuple[Settings, Imaging]] = {}

    def __getstate__(self) -> dict[str, Any]:
        """What was computed stays behind: it refers to the lenses of the original."""
        return {**super().__getstate__(), "_views": {}}

    # ---- the picture -----------------------------------------------------------------------------------------------

    def imaging(self, index: int, *, shape: tuple[int, int], reach: float, distance: float, bands: Tensor) -> Imaging:
        """What photographs pictures of such a shape (H, W) through a lens, made when it is first asked for, or its lens
        was changed since; bands: their wavelengths (L,) [m].
        """
        lens: Any = self.lenses[index]
        pitch = self.pixel_pitch(index, shape=shape, reach=reach)
        settings = Settings(lens)
        key = (index, shape, pitch, distance, tuple(bands.tolist()), torch.is_inference_mode_enabled())
        if key not in self._views or self._views[key][0] != settings:
            apart = max(_CLOSEST, math.ceil(max(shape) / _NODES))
            imaging = Imaging(lens, pixel_pitch=pitch, border=self.border, field=True, spacing=apart)
            if not any(parameter.requires_grad for parameter in lens.parameters()):  # its window stays
                vergence = torch.tensor([1 / distance], dtype=torch.float64)
                imaging.psf_shape = imaging.psf_window(bands, vergences=vergence, picture=shape)
                imaging.renormalise = True  # as without psf_shape: what leaves the window is put back
            self._views[key] = settings, imaging
        if len(self._views) > _VIEWS:  # the oldest goes
            del self._views[next(iter(self._views))]
        return self._views[key][1]

    def pixel_pitch(self, index: int, *, shape: tuple[int, int], reach: float) -> float:
        """Of a picture (H, W) whose corners lie at a share of a lens's image circle [m]."""
        circle = self._circle(index)
        return min(reach * circle.radius / (math.hypot(*shape) / 2), circle.widest)

    def _circle(self, index: int) -> _Circle:
        lens: Any = self.lenses[index]

        def build() -> _Circle:
            with torch.no_grad():
                distance = lens.focus_distance
                field = self._fields[index]
                highest = lens.field_limit(distance=distance) if field is None else field
                at = torch.tensor([[0.0, highest]], dtype=torch.float64)
                landed = lens.image_point([lens.focus_wavelength], distances=distance, field=at)
                radius = float(landed.norm())
                widest = min(_WIDEST_PIXEL * lens.focus_wavelength * lens.f_number, PIXEL_PITCH_RANGE[1])
                return _Circle(radius, widest, lens.image_heights(_MOST_REACH * radius))

        found: _Circle = self._circles[index].get(lens, build)
        return found

    @uncompiled  # of lenses, whose sizes follow from numbers
    def simulate(self, signal: Tensor, drawn: dict[str, Tensor]) -> Tensor:
        """Row by row in linear light, each through its own lens."""
        bands, shape = wavelengths_of(signal, self.wavelengths), (signal.shape[-2], signal.shape[-1])
        views = zip(*(drawn[name].tolist() for name in ("lens", "reach", "distance")), strict=True)
        rows = []
        for row, (index, reach, distance) in zip(signal.split(1), views, strict=True):
            imaging = self.imaging(index, shape=shape, reach=reach, distance=distance, bands=bands)
            scene = Scene.from_bands(clip_ste(row, 0.0, None), wavelengths=bands)
            rows.append(imaging(replace(scene, depth=distance)))  # nobody asks whether it was drawn in millimetres
        return torch.cat(rows)

    def apply_transform(
        self, input: Tensor, params: dict[str, Tensor], flags: dict[str, Any], transform: Tensor | None = None
    ) -> Tensor:
        """The rows that were drawn through `simulate`."""
        if input.numel() == 0:
            return input.new_zeros(input.shape) + input.sum()
        drawn = {name: params[name] for name in self._param_generator.draws}

        def effect(rows: Tensor, own: dict[str, Tensor]) -> Tensor:
            return simulated(rows, lambda light: self.simulate(light, own), told=params)

        return on_drawn_rows(input, params, drawn, effect, p=self.p)

    # ---- what goes with it -----------------------------------------------------------------------------------------

    def apply_transform_mask(
        self, input: Tensor, params: dict[str, Tensor], flags: dict[str, Any], transform: Tensor | None = None
    ) -> Tensor:
        """Each pixel from the nearest one to where the ideal lens has it."""
        return self._remapped(input, params, flags, inverse=False)

    def _moved(self, points: Tensor, params: dict[str, Tensor], *, inverse: bool) -> Tensor:
        if points.numel() == 0:
            return points
        height, width = params["forward_input_shape"][-2:].tolist()
        middle = torch.tensor([(width - 1) / 2, (height - 1) / 2], dtype=torch.float64, device=points.device)
        away = points.double() - middle
        found = []
        for row, index, reach in zip(away, params["lens"].tolist(), params["reach"].tolist(), strict=True):
            circle, pitch = self._circle(index), self.pixel_pitch(index, shape=(height, width), reach=reach)
            radii = row.norm(dim=-1) * pitch
            scale = circle.magnified(radii) if inverse else 1 / circle.magnified(circle.imaged(radii))
            found.append(row * scale[..., None])
        return torch.stack(found) + middle

    def _remapped(self, input: Tensor, params: dict[str, Tensor], flags: dict[str, Any], *, inverse: bool) -> Tensor:
        if input.numel() == 0:
            return input
        batch, channels, height, width = input.shape
        y, x = (torch.arange(n, dtype=torch.float64, device=input.device) for n in (height, width))
        grid = torch.stack(torch.broadcast_tensors(x[None, :], y[:, None]), dim=-1)
        source = self._moved(grid.expand(batch, -1, -1, -1), params, inverse=not inverse)
        if Resample.get(flags["resample"]) is Resample.BILINEAR:
            working = input if input.dtype in (torch.float32, torch.float64) else input.float()
            across, down = source.to(working).unbind(-1)
            return remap(working, across, down, mode="bilinear", align_corners=True).to(input.dtype)
        nearest = source.round().long()
        inside = torch.ones_like(nearest[..., 0], dtype=torch.bool)
        if self.border == "zero":
            inside = ((nearest >= 0) & (nearest < nearest.new_tensor([width, height]))).all(-1)
        border = "replicate" if self.border == "zero" else self.border
        column, row = (border_index(nearest[..., k], n, border) for k, n in ((0, width), (1, height)))
        index = (row * width + column).view(batch, 1, -1).expand(-1, channels, -1)
        return input.flatten(2).gather(2, index).view(input.shape) * inside[:, None].to(input.dtype)


def _is_preset(lens: object) -> bool:
    return isinstance(lens, (str, os.PathLike)) and str(lens) in PRESETS


def _opened(lens: object, *, focus: float, stops: float) -> CompoundLens:
    if isinstance(lens, CompoundLens):
        return lens
    if not isinstance(lens, (str, os.PathLike)):
        raise TypeError(f"lens must be names, files or an optics.CompoundLens, got {describe(lens)}.")
    if _is_preset(lens):
        opened = CompoundLens.preset(str(lens), focus_distance=focus)
    elif Path(lens).suffix.lower() in SUFFIXES:
        opened = CompoundLens.from_file(lens, focus_distance=focus)
    else:
        raise ValueError(f"unknown lens {str(lens)!r}. There are: {', '.join(PRESETS)}; or give a .zmx or .json file.")
    stop = opened.surfaces[opened.stop]
    stop.semi_diameter = float(stop.semi_diameter) * 2 ** (-stops / 2)  # type: ignore[arg-type]
    return opened.requires_grad_(False)
