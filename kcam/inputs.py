"""What goes in by mistake: what an input that cannot be right probably is, and the code that makes it right.

Every door that takes a picture, a cube or distances asks here, so that each mistake meets the same answer everywhere.
What can be accepted without a guess is not a mistake. Code is only looked for once something is wrong: a right input
pays for the look at its type and shape, and for one pass over its values where a door promises a range.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

ALPHA = 4
"""Channels of a picture with its transparency."""
_STRIP = 8
"""Pixels: where a tensor is as large in two ways and 3 or 4 in its last, this last axis holds channels."""
_OVERSHOOT = 0.25  # of a picture in [0,1], by interpolation and noise
_NOT_FINITE = "Remove NaN and inf where they come from, or replace them"
_STANDARD = 10.0  # deviations: no picture that is normalised by mean and deviation reaches farther
Channels = tuple[int, ...] | None
Code = tuple[str, str]
"""What an input probably is (or nothing), and the code that makes of it what a door takes (or nothing)."""
MOST_NAMED = 10


def named(word: str, reasons: Mapping[str, str], *, rest: str = "") -> list[str]:
    """Lines that name files and the reason, "skipped: a.jpg: it is no picture": the first ten, and how many more.

    Args:      rest: where the others are named, such as "--json".
    """
    lines = [f"{word}: {name}: {reason}" for name, reason in sorted(reasons.items())[:MOST_NAMED]]
    more = len(reasons) - len(lines)
    return lines + [f"{word}: and {more} more{rest and f', which {rest} names'}"] * (more > 0)


# ---- pictures and cubes -------------------------------------------------------------------------------------------


def check_floats(
    value: Any, *, name: str, takes: str, channels: Sequence[int] | None = (1, 3), ndims: Sequence[int] = (3, 4)
) -> None:
    """TypeError with the code that converts it, unless it is a floating-point tensor. `takes`: for the error."""
    if isinstance(value, Tensor) and value.layout is not torch.strided:
        raise TypeError(f"{name} must be a dense tensor {takes}, got {describe(value)}. Use {name}.to_dense().")
    if not isinstance(value, Tensor) or not value.is_floating_point():
        fix = remedy(value, name=name, channels=channels, ndims=ndims)
        raise TypeError(f"{name} must be a floating-point tensor {takes}, got {describe(value)}.{fix}")


def check_picture(
    image: Any,
    *,
    name: str,
    takes: str = "(3,H,W) in [0,1]",
    channels: Sequence[int] = (1, 3),
    ndims: Sequence[int] = (3, 4),
    within: tuple[float, float] | None = (0.0, 1.0),
) -> None:
    """TypeError, ValueError with the code that makes it right, unless it is a picture, or a batch of them.

    Args:      image: what was given. name: of the argument. takes: for the error.
               channels, ndims: which are taken.  within: the values that are; None to ask for none.
    """
    check_floats(image, name=name, takes=takes, channels=channels, ndims=ndims)
    size = tuple(image.shape)
    if image.ndim not in ndims or size[-3] not in channels or 0 in size[-3:]:
        fix = remedy(image, name=name, channels=channels, ndims=ndims)
        counts = " or ".join(map(str, channels))
        shapes = " or ".join("(C,H,W)" if ndim == 3 else "(B,C,H,W)" for ndim in ndims)
        raise ValueError(f"{name} has shape {size}, expected {counts} channels: {shapes}.{fix}")
    if image.numel() and within is not None:
        low, high = (value.item() for value in image.detach().aminmax())
        if not (low >= within[0] and high <= within[1]):
            fix = scale_remedy(low, high, name=name)
            raise ValueError(f"{name} has values from {low:g} to {high:g}, expected sRGB in [0,1].{fix}")


def check_bands(bands: Any, *, name: str, count: int, ndims: Sequence[int], sure: bool = True) -> None:
    """TypeError, ValueError unless it is a floating-point cube of `count` bands, with the code that makes it one.

    Where it can only be a picture, the code is `Scene.from_rgb`.

    Args:      sure: False where nobody said that it is a cube: 28 rows of a picture with channels last are no 28 bands.
    """
    takes = " or ".join("(L,H,W)" if ndim == 3 else "(B,L,H,W)" for ndim in ndims)
    if not isinstance(bands, Tensor) or not bands.is_floating_point():
        fix = band_remedy(bands, name=name, bands=count, ndims=ndims)
        raise TypeError(f"{name} must be a floating-point tensor {takes}, got {describe(bands)}.{fix}")
    size = tuple(bands.shape)
    if bands.ndim not in ndims or size[-3] != count or 0 in size[-3:] or not (sure or not channels_last(size)):
        fix = band_remedy(bands, name=name, bands=count, ndims=ndims)
        if not fix and bands.ndim in ndims:
            fix = f" Give the wavelengths of these {size[-3]} in metres: Scene.from_bands({name}, wavelengths=...)."
        verb = "have" if name.endswith("s") else "has"
        raise ValueError(
            f"{name} {verb} shape {size}, expected {takes} with {count} bands, for {count} wavelengths.{fix}"
        )


def check_signal(signal: Any, *, channels: Sequence[int] | None = None, bands: int | None = None) -> None:
    """TypeError unless it is a floating-point tensor, as stages take it: noise below 0 and light above 1 are right.

    Args:      channels: that the stage takes; None for any number. bands: that it takes, where it takes a cube.
    """
    if isinstance(signal, Tensor) and signal.is_floating_point():
        return
    if bands is not None:
        fix = band_remedy(signal, name="signal", bands=bands, ndims=(3, 4))
    else:
        fix = remedy(signal, name="signal", channels=channels, scaled=False)
    raise TypeError(
        "expected a floating-point signal (B,C,H,W) in which 1.0 is the full well or full scale, got "
        f"{describe(signal)}.{fix}"
    )


def check_array(image: Any, *, name: str, bands: int | None = None) -> None:
    """TypeError, ValueError unless an image is an array or a PIL image that Kornia's containers read as it is meant.

    They take the last axis for the channels, 8 and 16 bits for [0,1], and alpha for a channel like the others.

    Args:      bands: of a cube, where they are known.
    """
    array = np.asarray(image) if isinstance(image, np.ndarray) or _is_image(image) else None
    if array is None or array.dtype.kind not in "fub" or (array.dtype.kind == "u" and array.dtype.itemsize > 2):
        raise TypeError(
            f"{name} must be a tensor, an array or a PIL image, got {describe(image)}.{remedy(image, name=name)}"
        )
    size = array.shape
    first = len(size) in (3, 4) and size[-3] in (1, 3, ALPHA) and size[-1] not in (1, 3, ALPHA, bands)
    alpha = len(size) in (3, 4) and size[-1] == ALPHA != bands
    if len(size) not in (2, 3, 4) or first or alpha or min((0, *array.strides)) < 0:
        fix = remedy(image, name=name)
        raise ValueError(f"{name} is {describe(image)}, expected (H,W,3), (B,H,W,3), or (H,W) in gray.{fix}")


def remedy(
    value: Any,
    *,
    name: str,
    channels: Sequence[int] | None = (1, 3),
    ndims: Sequence[int] = (3, 4),
    scaled: bool = True,
) -> str:
    """What a value probably is and the code that makes a picture of it, " It is ... Use ...", or nothing.

    Args:      channels: that are taken; None for any number.  scaled: whether floats are to be in [0,1].
    """
    what, code = _code(value, name, None if channels is None else tuple(channels), tuple(ndims), scaled)
    return _sentence(what, code) if code != name else ""


def band_remedy(value: Any, *, name: str, bands: int, ndims: Sequence[int] = (4,)) -> str:
    """What was given in the place of a cube of so many bands: the cube in another order, or a picture; or nothing."""
    shape = _shape(value)
    if (
        shape is not None
        and not channels_last(shape)
        and 3 <= len(shape) <= 4
        and bands not in (1, 3)
        and bands in (shape[-1], shape[-3])
    ):
        return remedy(value, name=name, channels=(bands,), ndims=ndims)
    what, code = _code(value, name, (1, 3), (3, 4), True)
    if not code:
        return ""
    also = f", {what}" if what and what != _NOT_FINITE else ""
    return f" Probably a picture{also}: use Scene.from_rgb({code}, depth=2.0)."


def scale_remedy(low: float, high: float, *, name: str) -> str:
    """Of a picture with such values: what they are, and the code that brings them to [0,1]."""
    return _sentence(*_scale(low, high, name))


def table_remedy(values: Tensor, *, name: str, most: float) -> str:
    """What was got in the place of a table's values from 0 to `most`, and what to do about it."""
    bad = int((~values.isfinite()).sum())
    if bad:
        keep = f"keep = {name}.isfinite(){'.all(0)' if values.ndim > 1 else ''}"
        fix = f"Leave their wavelengths out: {keep}, then wavelengths[keep] and {name}[..., keep]."
        return f"got {bad} that are NaN or infinite. {fix}"
    low, high = (float(bound) for bound in values.aminmax())
    if high > 1.1 * most:  # more than noise
        fix = f"Percent? Then divide by 100: {name} / 100, or percent=True for a file."
    else:
        fix = f"Measured noise is no light: clamp it, {name}.clamp(0, {most:g})."
    return f"got {low:g} to {high:g}. {fix}"


def channels_last(shape: Sequence[int]) -> bool:
    """Whether (..., H, W, C) is the likelier reading of a shape that is given as (..., C, H, W)."""
    sides = tuple(shape[-3:-1])
    return len(shape) in (3, 4) and shape[-1] in (3, ALPHA) and shape[-3] not in (1, 3) and min(sides) >= _STRIP


def describe(value: Any) -> str:
    """What was given, in a few words."""
    if isinstance(value, Tensor):
        sparse = "" if value.layout is torch.strided else "sparse "
        return f"a {sparse}tensor {tuple(value.shape)} of {value.dtype}"
    if isinstance(value, np.ndarray):
        return f"an array {value.shape} of {value.dtype}"
    if isinstance(value, (list, tuple)):
        kinds = sorted({type(one).__name__ for one in value})
        return (
            f"a {type(value).__name__} of {len(value)} ({', '.join(kinds)})"
            if kinds
            else f"an empty {type(value).__name__}"
        )
    if _is_image(value):
        return f"a PIL image of {value.size[0]} x {value.size[1]} pixels in mode {value.mode!r}"
    if isinstance(value, (str, bytes, os.PathLike, bool, int, float, type(None))):
        return f"{type(value).__name__} {value!r}"
    return type(value).__name__


def _sentence(what: str, code: str) -> str:
    if not what:
        return f" Use {code}." if code else ""
    what = what if what == _NOT_FINITE else f"Probably {what}"
    return f" {what}: use {code}." if code else f" {what}."


def _code(value: Any, name: str, channels: Channels, ndims: tuple[int, ...], scaled: bool) -> Code:
    """Step by step: a tensor, channels first, without alpha, with or without a batch, floats, in [0,1]."""
    if isinstance(value, (list, tuple)):
        return _of_a_list(value, name, channels, ndims, scaled)
    if isinstance(value, (str, os.PathLike)):
        is_picture = channels is None or 3 in channels
        return "the name of a file", f"kcam.scene.read_picture({name}){'' if 3 in ndims else '[None]'}" * is_picture
    tensor, code = _as_tensor(value, name)
    if tensor is None:
        return "", ""
    what, laid_out, shape = _laid_out(tuple(tensor.shape), code, channels, ndims)
    fits = len(shape) in ndims and (channels is None or shape[-3] in channels) and 0 not in shape[-3:]
    if laid_out and fits:
        code = laid_out
    elif channels is not None or code == name:
        return "", ""
    if tensor.is_complex():
        tensor, code = tensor.real, f"{code}.real"
    if not tensor.is_floating_point():
        divisor = {torch.uint8: 255, torch.uint16: 65535}.get(tensor.dtype)
        highest = float(tensor.double().max()) if tensor.numel() else 1.0
        divisor = divisor or (None if highest <= 1 else 255 if highest <= 255 else 65535)
        return what, f"{code}.float() / {divisor}" if divisor else f"{code}.float()"
    if scaled and tensor.numel() and (channels is None or {1, 3} & {*channels}):  # a cube's light has no upper end
        low, high = (bound.item() for bound in tensor.detach().aminmax())
        if not (low >= 0 and high <= 1):
            why, code = _scale(low, high, code)
            what = why if why == _NOT_FINITE else ", ".join(filter(None, (what, why)))
    return what, code


def _of_a_list(values: Sequence[Any], name: str, channels: Channels, ndims: tuple[int, ...], scaled: bool) -> Code:
    if not values:
        return "", ""
    if all(isinstance(one, (int, float, list, tuple)) for one in values):
        try:
            return _code(torch.tensor(values), f"torch.tensor({name})", channels, ndims, scaled)
        except (TypeError, ValueError, RuntimeError):
            return "", ""
    if 4 not in ndims:
        return _code(values[0], f"{name}[0]", channels, ndims, scaled)
    found = {_code(one, "each", channels, (3,), scaled) for one in values}
    shapes = {_shape(one) for one in values}
    if len(found) > 1 or len(shapes) > 1:
        return "pictures of different sizes or kinds, to be given one at a time", ""
    [(what, code)] = found
    if not code:
        return "", ""
    return what, f"torch.stack({name})" if code == "each" else f"torch.stack([{code} for each in {name}])"


def _as_tensor(value: Any, name: str) -> tuple[Tensor | None, str]:
    """A tensor that shows the shape and the values of what was given, and the code for it."""
    if isinstance(value, Tensor):
        return value, name
    if _is_image(value):
        if value.mode not in ("L", "RGB", "RGBA", "F", "I", "I;16"):
            value, name = value.convert("RGB"), f'{name}.convert("RGB")'
        array, code = np.array(value), f"torch.from_numpy(np.array({name}))"
    elif isinstance(value, np.ndarray):
        plain = value.dtype.isnative and all(stride >= 0 for stride in value.strides)
        array, code = (value, name) if plain else (value.astype(value.dtype.newbyteorder("=")).copy(), f"{name}.copy()")
        if not value.dtype.isnative:
            code = f'{name}.astype("{value.dtype.newbyteorder("=")}")'
        code = f"torch.from_numpy({code})"
    elif hasattr(value, "__array__"):
        array, code = np.array(value), f"torch.from_numpy(np.array({name}))"
    else:
        return None, ""
    try:
        return torch.from_numpy(np.array(array)), code
    except (TypeError, ValueError):
        return None, ""


def _laid_out(
    shape: tuple[int, ...], code: str, channels: Channels, ndims: tuple[int, ...]
) -> tuple[str, str, tuple[int, ...]]:
    """What order the axes are in, and the code that brings them into ours; no code where nothing fits."""
    what = []
    taken = (1, 3) if channels is None else channels
    if len(shape) == 2 and (1 in taken or 3 in taken):
        shape, code = (1, *shape), f"{code}[None]"
    elif len(shape) == 5:
        what.append("a batch of clips")
        shape, code = (shape[0] * shape[1], *shape[2:]), f"{code}.flatten(0, 1)"
    if len(shape) not in (3, 4):
        return "", "", shape
    if channels is None:
        turned = channels_last(shape)
    elif shape[-3] in taken or shape[-1] in taken:
        turned = shape[-3] not in taken
    else:  # alpha first or last
        turned = 3 in taken and shape[-1] == ALPHA and (shape[-3] != ALPHA or channels_last(shape))
    if turned:
        what.append("channels last")
        order = (0, 3, 1, 2) if len(shape) == 4 else (2, 0, 1)
        shape, code = tuple(shape[axis] for axis in order), f"{code}.permute{order}"
    if shape[-3] == ALPHA and channels is not None and 3 in channels and ALPHA not in channels:
        what.append("red, green, blue and alpha, which to drop")
        shape, code = (*shape[:-3], 3, *shape[-2:]), f"{code}[..., :3, :, :]"
    elif shape[-3] == 1 and 1 not in taken and 3 in taken:
        what.append("gray")
        shape, code = (*shape[:-3], 3, *shape[-2:]), f"{code}.expand({'-1, ' if len(shape) == 4 else ''}3, -1, -1)"
    if len(shape) == 3 and 3 not in ndims:
        shape, code = (1, *shape), f"{code}[None]"
    elif len(shape) == 4 and 4 not in ndims:
        what.append(f"a batch of {shape[0]}")
        shape, code = shape[1:], f"{code}[0]"
    return ", ".join(what), code, shape


def _scale(low: float, high: float, code: str) -> Code:
    if not (math.isfinite(low) and math.isfinite(high)):
        return _NOT_FINITE, f"{code}.nan_to_num(0, 1, 0)"
    if low >= -_OVERSHOOT:
        if high <= 2:
            return "", f"{code}.clamp(0, 1)"
        return "", f"{code} / {255 if high <= 2 * 255 else 65535}"
    if low >= -1 - _OVERSHOOT / 10 and high <= 1 + _OVERSHOOT / 10:
        return f"scaled to [-1,1] (if normalised by mean and deviation: {code} * std + mean)", f"({code} + 1) / 2"
    if low > -_STANDARD and high < _STANDARD:
        return "normalised by mean and deviation", f"{code} * std + mean"
    return "on another scale, its mean subtracted", ""


def _shape(value: Any) -> tuple[int, ...] | None:
    shape = np.shape(np.array(value)) if _is_image(value) else getattr(value, "shape", None)
    return tuple(shape) if isinstance(shape, (tuple, torch.Size)) else None


def _is_image(value: Any) -> bool:
    """Whether it is a PIL image, without importing PIL."""
    return type(value).__module__.startswith("PIL.") and hasattr(value, "mode") and hasattr(value, "size")


# ---- distances ----------------------------------------------------------------------------------------------------


def as_values(value: Any, *, name: str, unit: str) -> Tensor:
    """Real numbers as a tensor: a tensor as it is, numbers in a list or an array as float64.

    Raises:    TypeError for what holds none.
    """
    values = value if isinstance(value, Tensor) else None
    if values is None and not isinstance(value, (str, bool, type(None))):
        try:
            values = torch.tensor(np.asarray(value, np.float64))
        except (TypeError, ValueError, RuntimeError):
            values = None
    if values is None or values.is_complex() or values.dtype == torch.bool:
        held = isinstance(value, (list, tuple)) and any(isinstance(one, Tensor) for one in value)
        fix = f"torch.stack({name})" if held else f"{name}=2.0, or a tensor of numbers"
        raise TypeError(
            f"{name} must be a number [{unit}], one per sample (B,), or a map (B,1,H,W), got {describe(value)}. Use "
            f"{fix}."
        )
    return values


def as_map(values: Tensor, *, shape: tuple[int, int, int], name: str, unit: str = "") -> Tensor:
    """Numbers for the pixels of a batch: one for all (), one for each sample (B,), or one for each pixel (B,1,H,W).

    Args:      values: (), (B,) or (B,1), (H,W), (1,H,W), (B,H,W), (1,1,H,W) or (B,1,H,W); what fits as numbers per
               sample and has one axis is those.  shape: (B, H, W).
    Raises:    ValueError for another shape.
    """
    batch, height, width = shape
    size = tuple(values.shape)
    if size in ((), (batch,)):
        return values
    if size[-2:] == (height, width) and size[:-2] in ((), (1,), (batch,), (1, 1), (batch, 1)):
        lead = size[0] if len(size) > 2 else 1
        return values.reshape(lead, 1, height, width).expand(batch, 1, height, width)
    if values.numel() == 1:
        return values.reshape(())
    if set(size[1:]) == {1} and size[0] == batch:
        return values.reshape(batch)
    hint = ""
    if len(size) == 1:
        hint = f" {size[0]} numbers stand for {size[0]} pictures, not for {batch}."
    elif size[-2:] == (width, height):
        hint = f" Rows come first: use {name}.mT."
    elif len(size) in (3, 4) and size[-3:-1] == (height, width):
        hint = f" Use {name}[..., 0]."
    elif len(size) >= 2:
        hint = (
            f" For a map of another size use torch.nn.functional.interpolate({name}.reshape(-1, 1, {size[-2]}, "
            f'{size[-1]}), ({height}, {width}), mode="nearest-exact").'
        )
    raise ValueError(
        f"{name} has shape {size}, expected a number, ({batch},) for one per sample, or a map ({height}, {width}) or "
        f"({batch}, 1, {height}, {width}), as the picture{unit and ','}{unit}.{hint}"
    )
