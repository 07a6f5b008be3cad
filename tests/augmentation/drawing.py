"""What the tests of physics share: pictures, what an augmentation drew, and a lens built from it by hand."""

from __future__ import annotations

import math
from collections.abc import Callable

import kornia.augmentation as K
import torch
from torch import Tensor

import kcam.augmentation as KC
from kcam import Scene, optics
from kcam.augmentation.base import is_picture
from kcam.isp import tone_curve
from kcam.srgb import to_light
from kcam.units import wavelength_grid

PRIMARIES = wavelength_grid(list(KC.RGB_WAVELENGTHS))
BANDS = wavelength_grid()


def picture(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> Tensor:
    """Noise: detail of all sizes in every channel."""
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)


def wavelengths_for(channels: int) -> Tensor:
    return {1: PRIMARIES[1:2], 3: PRIMARIES, 28: BANDS}[channels]


def augmented(augmentation: K.base._AugmentationBase, signal: Tensor, *, seed: int = 0) -> tuple[Tensor, dict]:
    """The result of a call, and the numbers that it drew."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        result = augmentation(signal)
    params = augmentation._params
    return result, {name: params[name] for name in augmentation._param_generator.draws}


def row(drawn: dict[str, Tensor], index: int) -> dict[str, float]:
    return {name: float(value[index]) for name, value in drawn.items() if value.ndim == 1}


def alone(drawn: dict[str, Tensor], index: int) -> dict[str, Tensor]:
    """The numbers of one row, (1, ...) each."""
    return {name: value[index : index + 1] for name, value in drawn.items()}


def in_light(signal: Tensor) -> Tensor:
    """What `simulate` is given: a picture in linear light, a cube as it is."""
    return to_light(signal) if is_picture(signal) else signal


def coded(light: Tensor, *, like: Tensor) -> Tensor:
    """Linear light as the call gives it back: a picture as sRGB, a cube as it is."""
    return tone_curve(light) if is_picture(like) else light


def imaged(
    lens: optics.Lens,
    light: Tensor,
    *,
    augmentation: KC.CameraAugmentation,
    wavelengths: Tensor,
    depth: float | Tensor = math.inf,
    drawn: dict[str, Tensor] | None = None,
    **options,
) -> Tensor:
    """Linear light (1,C,H,W) through a lens, with the pixels of an augmentation, and its window for these numbers."""
    shape = light.shape[-2], light.shape[-1]
    window = {"psf_shape": augmentation.psf_shape(shape, wavelengths, drawn)} | options
    stage = optics.Imaging(lens, pixel_pitch=augmentation.pixel_pitch, propagator="fresnel", renormalise=True, **window)
    return stage(Scene.from_bands(light, wavelengths=wavelengths, depth=depth))


def round_lens(focal_length: float, f_number: float, *elements: optics.Element, **focus) -> optics.Lens:
    aperture = optics.CircularAperture(focal_length / f_number)
    return optics.Lens(aperture, optics.ThinLens(focal_length), *elements, **(focus or {"focus_distance": math.inf}))


def relative(found: Tensor, expected: Tensor) -> float:
    """Largest difference, of the largest value."""
    return float((found - expected).abs().max() / expected.abs().max())


def agree_row_by_row(
    augmentation: KC.CameraAugmentation,
    signal: Tensor,
    by_hand: Callable[[Tensor, int, dict[str, Tensor]], Tensor],
    *,
    bound: float,
    seed: int = 0,
    inverse_depth: Tensor | None = None,
) -> None:
    """The call draws, and in linear light gives for each row what `by_hand(light, row, drawn)` gives."""
    mapped = {} if inverse_depth is None else {"inverse_depth": inverse_depth}
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        result = augmentation(signal, **mapped)
    drawn = {name: augmentation._params[name] for name in augmentation._param_generator.draws}
    light = in_light(signal)
    found = augmentation.simulate(light, drawn | mapped)
    expected = torch.cat([by_hand(light[i : i + 1], i, drawn) for i in range(len(signal))])
    assert relative(found, expected) < bound
    assert relative(found, light) > 0.01  # it did something
    # the call adds nothing but the coding, whose slope is at most 13
    assert (result - coded(expected, like=signal)).abs().max() < 13 * bound * expected.abs().max()
