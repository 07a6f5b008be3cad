"""From demosaiced camera signals to sRGB: white balance, colour matrix, tone curve."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from kcam import spectral, srgb
from kcam.cache import is_plain
from kcam.context import Context, Curves, Stage
from kcam.inputs import ALPHA, channels_last, check_signal, remedy
from kcam.sensor.arguments import hold, in_float32, like
from kcam.sensor.colour_filter import ColourFilter
from kcam.ste import clip_ste
from kcam.units import as_numbers

LEAST_WHITE = 1e-6
NOISE = 0.003


@functools.cache
def _default_filter(channels: int) -> ColourFilter:
    kodak = ColourFilter.kodak()
    if channels == 1:
        return ColourFilter(kodak.coefficients[1:2], width=kodak.width)
    return ColourFilter.rgbw() if channels == 4 else kodak


def _filter_of(context: Context, channels: int) -> Curves:
    """The context's filter, or the default one; ValueError unless it has one curve per channel of the signal."""
    colour_filter = context.colour_filter or _default_filter(channels)
    curves = len(colour_filter.response(context.wavelengths))
    if curves != channels:
        raise ValueError(
            f"the signal has {channels} channels and the colour filter {curves} curves, so neither white balance gains "
            f"nor a colour matrix follow from the filter. Give gains=torch.ones({channels}) to Demosaic and "
            f"WhiteBalance, and matrix=torch.eye(3, {channels}) to ColourMatrix. A mosaic needs a Demosaic first."
        )
    return colour_filter


def _channels(signal: Tensor) -> int:
    check_signal(signal)
    if signal.ndim < 3:
        fix = remedy(signal, name="signal", scaled=False)
        raise ValueError(f"expected a picture (..., C, H, W), got shape {tuple(signal.shape)}.{fix}")
    return signal.shape[-3]


def _channels_first(signal: Tensor) -> int:
    """ValueError with the code where channels come last: no colour filter has as many curves as rows."""
    channels = _channels(signal)
    if channels_last(signal.shape) and channels != ALPHA:
        fix = remedy(signal, name="signal", channels=None, scaled=False)
        raise ValueError(f"expected a picture (..., C, H, W), got shape {tuple(signal.shape)}.{fix}")
    return channels


def as_shot_gains(context: Context, *, channels: int = 3) -> Tensor:
    """White balance gains of the light that the picture was taken in: what makes a perfect white gray.

    g_c = white_green / white_c,   white_c = sum_l kappa_c(lambda_l) E(lambda_l) width_l

    Args:      context: its colour_filter, wavelengths and illuminant; by default the Kodak curves (with white for 4
               channels, green alone for 1) and D65.  channels: C of the signal.
    Returns:   (C,) float64, 1 in green (channel 1, or the only one); differentiable in the filter.
    Raises:    ValueError if the filter has not one curve per channel.

    Example:
    >>> red, green, blue = isp.as_shot_gains(kcam.Context(colour_filter=sensor.ColourFilter.nikon()))
    >>> round(float(red), 2), round(float(green), 2), round(float(blue), 2)  # in daylight
    (1.65, 1.0, 1.18)
    """
    colour_filter = _filter_of(context, channels)
    white = colour_filter.white(context.wavelengths, illuminant=context.illuminant).clamp(min=LEAST_WHITE)
    return white[min(1, channels - 1)] / white


@in_float32
def white_balance(signal: Tensor, *, gains: Tensor) -> Tensor:
    """Multiply each channel of (..., C, H, W) by its gain, (C,).

    Example:
    >>> isp.white_balance(torch.ones(3, 1, 1), gains=torch.tensor([2.0, 1.0, 1.5])).flatten().tolist()
    [2.0, 1.0, 1.5]
    """
    channels = _channels(signal)
    if gains.shape != (channels,):
        raise ValueError(
            f"gains of shape {tuple(gains.shape)} do not fit a signal of {channels} channels: expected ({channels},), "
            "one gain per channel."
        )
    return signal * gains.to(signal)[:, None, None]


def gains_of(gains: Tensor | Sequence[float] | None) -> Tensor | None:
    """White balance gains as a tensor (C,), a Parameter as it is; TypeError, ValueError for what can be none."""
    if gains is None:
        return None
    expected = "one number per channel such as [1.6, 1.0, 1.2]"
    values = gains if isinstance(gains, Tensor) else as_numbers(gains, name="gains", expected=expected)
    if values.ndim != 1 or values.numel() == 0:
        raise ValueError(f"gains must be {expected}, (C,), got shape {tuple(values.shape)}.")
    return values


class WhiteBalance(Stage):
    """White balance: one gain per channel, `white_balance`.

    Args:      gains: (C,), a tensor or a sequence; an nn.Parameter trains. None for `as_shot_gains`: the light of the
               scene, as the colour filter sees it.
    Raises:    TypeError, ValueError for gains that are not one number per channel.

    Example:
    >>> isp.WhiteBalance([2.0, 1.0, 1.5])(torch.full((1, 3, 1, 1), 0.5)).flatten().tolist()
    [1.0, 0.5, 0.75]
    """

    gains: Tensor | None

    def __init__(self, gains: Tensor | Sequence[float] | None = None):
        super().__init__()
        hold(self, gains=gains_of(gains))

    def forward(self, signal: Tensor, context: Context | None = None) -> Tensor:
        """(B,C,H,W) to the same shape."""
        gains = self.gains
        if gains is None:
            gains = as_shot_gains(context or Context(), channels=_channels_first(signal))
        return white_balance(signal, gains=gains)


@functools.cache
def _chart_in_linear_srgb() -> list[list[float]]:
    """The 24 patches of the colour chart under D65, as the observer sees them: (24,3), not clipped."""
    _, wavelengths, reflectances = spectral.colour_chart()
    colours = reflectances @ spectral.xyz_weights(wavelengths, "D65") @ spectral.xyz_to_srgb_matrix().T
    return colours.tolist()


def fit_colour_matrix(signals: Tensor, *, colours: Tensor, noise: float = NOISE) -> Tensor:
    """The matrix that takes camera signals closest to colours and leaves white white.

    minimise over M:   sum_k |M s_k - t_k|^2 / K + noise^2 |M|^2    with   M (1,..,1)^T = (1,1,1)^T

    The second term is the noise that the matrix would pass on; it also decides where the signals leave M open.

    Args:      signals: (K,C), white balanced, a perfect white = 1.  colours: (K,3) linear sRGB.
               noise: RMS noise of the signals to guard against, > 0.
    Returns:   (3,C) in the dtype of the signals; differentiable.

    Example:
    >>> colours = torch.rand(24, 3, generator=torch.Generator().manual_seed(0)).double()
    >>> matrix = isp.fit_colour_matrix(colours, colours=colours)
    >>> torch.allclose(matrix, torch.eye(3).double(), atol=1e-3), torch.allclose(matrix.sum(1), torch.ones(3).double())
    (True, True)
    """
    count, channels = signals.shape
    identity = torch.eye(channels, dtype=signals.dtype, device=signals.device)
    inverse = torch.linalg.inv(signals.T @ signals / count + noise**2 * identity)
    free = colours.T @ signals / count @ inverse
    to_white = inverse.sum(0) / inverse.sum()
    return free + (1 - free.sum(1, keepdim=True)) * to_white


def as_shot_colour_matrix(context: Context, *, channels: int = 3) -> Tensor:
    """The colour matrix of this filter in this light, fitted to the 24 patches of the colour chart.

    The patches are taken by the filter under the scene's light, white balanced, and fitted to their colours under D65
    (the colour of a surface is what it is in daylight, so no model of chromatic adaptation is needed).

    Args:      context: as for `as_shot_gains`, and white_share and gain.  channels: C of the signal.
    Returns:   (3,C) float64: an exposed (`Context.exposed_white`), balanced signal to linear sRGB, a perfect white to
               (1,1,1); differentiable in the filter.
    Raises:    ValueError if the filter has not one curve per channel.

    Example:
    >>> matrix = isp.as_shot_colour_matrix(kcam.Context())
    >>> [round(float(row.sum()), 3) for row in matrix]  # an exposed white, 0.8, becomes 1
    [1.25, 1.25, 1.25]
    """
    wavelengths = context.wavelengths
    weights = _filter_of(context, channels).contraction(wavelengths)
    light = context.illuminant
    if light is None:
        light = spectral.illuminant("D65", wavelengths=wavelengths)
    light = light.to(weights)
    patches = spectral.reflectances(wavelengths).to(weights) * light
    white = (weights @ light).clamp(min=LEAST_WHITE)
    signals = (patches @ weights.T) / white
    colours = torch.tensor(_chart_in_linear_srgb(), dtype=weights.dtype, device=weights.device)
    return fit_colour_matrix(signals, colours=colours) / like(context.exposed_white, signals)


@in_float32
def apply_colour_matrix(signal: Tensor, *, matrix: Tensor) -> Tensor:
    """(..., C, H, W) to (..., N, H, W) by a matrix (N,C) on the channels of each pixel.

    Example:
    >>> luminance = torch.tensor([[0.2126, 0.7152, 0.0722]])  # of linear sRGB
    >>> round(float(isp.apply_colour_matrix(torch.ones(3, 1, 1), matrix=luminance)), 4)  # of white
    1.0
    """
    channels = _channels(signal)
    if matrix.ndim != 2 or matrix.shape[1] != channels:
        raise ValueError(
            f"a matrix of shape {tuple(matrix.shape)} does not fit a signal of {channels} channels: expected "
            f"(3, {channels}), rows for red, green, blue."
        )
    return torch.einsum("nc,...chw->...nhw", matrix.to(signal), signal)


class ColourMatrix(Stage):
    """Camera colours to linear sRGB, a perfect white to 1.0: `apply_colour_matrix`.

    Args:      matrix: (3,C), a tensor or rows; an nn.Parameter trains. None for `as_shot_colour_matrix`, fitted for the
               context's filter and light. It counts on a white balanced signal, in which white is the exposure's share
               of the well, 0.8: divide one from `fit_colour_matrix` by that. A signal of one channel becomes gray.
    Raises:    TypeError, ValueError for a matrix that has not three rows.

    Example:
    >>> white = torch.full((1, 3, 1, 1), 0.8)  # balanced and exposed: 0.8 of full scale
    >>> torch.allclose(isp.ColourMatrix()(white), torch.ones(1, 3, 1, 1), atol=1e-5)
    True
    """

    matrix: Tensor | None

    def __init__(self, matrix: Tensor | Sequence[Sequence[float]] | None = None):
        super().__init__()
        if matrix is not None:
            expected = "three rows of one number per channel such as torch.eye(3)"
            matrix = matrix if isinstance(matrix, Tensor) else as_numbers(matrix, name="matrix", expected=expected)
            if matrix.ndim != 2 or matrix.shape[0] != 3 or matrix.shape[1] == 0:
                raise ValueError(f"matrix must be {expected}, (3, C), got shape {tuple(matrix.shape)}.")
        hold(self, matrix=matrix)

    def forward(self, signal: Tensor, context: Context | None = None) -> Tensor:
        """(B,C,H,W) to (B,3,H,W)."""
        matrix = self.matrix
        if matrix is None:
            matrix = as_shot_colour_matrix(context or Context(), channels=_channels_first(signal))
        return apply_colour_matrix(signal, matrix=matrix)

    def output_channels(self, channels: int, context: Context | None = None) -> int:
        """Red, green and blue."""
        return 3


GAMMAS, CONTRASTS = (0.1, 10.0), (-0.49, 0.49)


def tone_curve(signal: Tensor, *, gamma: Tensor | None = None, contrast: Tensor | None = None) -> Tensor:
    """Linear sRGB to coded sRGB: clipped to 0..1, then the sRGB transfer function of IEC 61966-2-1.

    v = 12.92 x                  x <= 0.0031308
    v = 1.055 x^(1/2.4) - 0.055  above

    With a gamma or a contrast another rendering of these tones follows: `render_tones`.

    Args:      signal: (..., 3, H, W), or one channel of gray.  gamma, contrast: 0-d, or one for each channel; taken as
               0.1 to 10 and -0.49 to 0.49, with the gradients of `clip_ste` beyond.
    Returns:   same shape, in [0,1]. The gradient is finite everywhere; beyond the clip it is that of `clip_ste`.
    Raises:    ValueError for another number of channels.

    Example:
    >>> [round(float(isp.tone_curve(torch.full((1, 1, 1), value))), 3) for value in (0.0, 0.214, 1.0)]
    [0.0, 0.5, 1.0]
    """
    check_signal(signal, channels=(1, 3))
    channels = _channels(signal)
    if channels not in (1, 3):
        raise ValueError(
            f"the sRGB curve takes 3 channels, or 1 of gray, got {channels}. Put a ColourMatrix before it."
            f"{remedy(signal, name='signal', scaled=False)}"
        )
    coded = srgb.to_code(signal)
    if gamma is None and contrast is None:
        return coded
    held = [coded.new_tensor(1.0) if gamma is None else gamma, coded.new_tensor(0.0) if contrast is None else contrast]
    if any(value.numel() not in (1, channels) for value in held):
        raise ValueError(f"gamma and contrast of three channels do not fit one of gray, {tuple(signal.shape)}.")
    gamma, contrast = (value.to(coded)[..., None, None] for value in held)
    return render_tones(coded, gamma=clip_ste(gamma, *GAMMAS), contrast=clip_ste(contrast, *CONTRASTS))


def render_tones(signal: Tensor, *, gamma: Tensor, contrast: Tensor) -> Tensor:
    """Another rendering of tones in 0..1, outside of which they are clipped: a gamma, then an S-curve.

    u = ((v + e)^gamma - e^gamma) / ((1 + e)^gamma - e^gamma),  e = 0.01;   y = u + 2 c u (1 - u) (2 u - 1)

    Both keep black at 0 and white at 1 and rise everywhere; e keeps the slope at black finite.

    Args:      signal: any shape.  gamma: 0.1 to 10, above 1 darkens.  contrast: c, -0.49 to 0.49. Both broadcast
               against the signal, and are not checked.

    Example:
    >>> tones = torch.tensor([0.0, 0.25, 0.5, 0.75, 1.0])
    >>> curve = isp.render_tones(tones, gamma=torch.tensor(1.0), contrast=torch.tensor(0.4))
    >>> [round(float(tone), 3) for tone in curve]  # an S: darker below the middle, lighter above it
    [0.0, 0.175, 0.5, 0.825, 1.0]
    """
    offset = 0.01
    low = offset**gamma
    high = (1 + offset) ** gamma
    if signal.dtype == torch.float32 and all(map(is_plain, (signal, gamma, contrast))):  # the same, in place
        tone = (signal.clamp(0, 1).add_(offset).log2_() * gamma).exp2_().sub_(low).div_(high - low)
        bend = (tone.mul(-2).add_(3).mul_(tone).sub_(1) * (2 * contrast)).add_(1)
        return bend.mul_(tone)
    tone = ((signal.clamp(0, 1) + offset) ** gamma - low) / (high - low)
    return tone + 2 * contrast * tone * (1 - tone) * (2 * tone - 1)


class ToneCurve(Stage):
    """The sRGB curve, and if asked for a gamma and a contrast after it: `tone_curve`.

    Args:      gamma, contrast: numbers or tensors, 0-d or (3,) for red, green and blue; an nn.Parameter trains, such
               as nn.Parameter(torch.ones(3)) and nn.Parameter(torch.zeros(3)), which change nothing. None: 1 and 0.
    Raises:    TypeError, ValueError for other shapes, a gamma outside 0.1..10, or a contrast outside -0.49..0.49, but
               for an nn.Parameter, which is taken as the bound that it was trained beyond.

    Example:
    >>> gray = torch.full((1, 3, 1, 1), 0.2140)  # linear
    >>> round(float(isp.ToneCurve()(gray)[0, 0]), 3), round(float(isp.ToneCurve(gamma=2.0)(gray)[0, 0]), 3)
    (0.5, 0.255)
    """

    gamma: Tensor | None
    contrast: Tensor | None

    def __init__(self, gamma: Tensor | float | None = None, contrast: Tensor | float | None = None) -> None:
        super().__init__()
        bounds = {"gamma": (gamma, *GAMMAS), "contrast": (contrast, *CONTRASTS)}
        held = {name: _within(value, name, low, high) for name, (value, low, high) in bounds.items()}
        hold(self, **held)

    def forward(self, signal: Tensor, context: Context | None = None) -> Tensor:
        """(B,C,H,W) linear sRGB to coded sRGB in [0,1]."""
        return tone_curve(signal, gamma=self.gamma, contrast=self.contrast)


def _within(value: Tensor | float | None, name: str, low: float, high: float) -> Tensor | None:
    """One number, or one for each of three channels, as a tensor."""
    if value is None:
        return None
    expected = f"a number from {low:g} to {high:g}, or three of them, such as torch.full((3,), {(low + high) / 2:g})"
    value = value if isinstance(value, Tensor) else as_numbers(value, name=name, expected=expected)
    inside = bool(((value >= low) & (value <= high)).all()) or isinstance(value, nn.Parameter)  # training may leave it
    if value.shape not in ((), (3,)) or not inside:
        raise ValueError(f"{name} must be {expected}, got {value.tolist()}.")
    return value


class Clip(Stage):
    """Clip to 0..1 with the gradient of `clip_ste`, as between the layers of the thesis's network.

    Example:
    >>> isp.Clip()(torch.tensor([-0.5, 0.5, 1.5])).tolist()
    [0.0, 0.5, 1.0]
    """

    def forward(self, signal: Tensor, context: Context | None = None) -> Tensor:
        """Any shape."""
        check_signal(signal)
        return clip_ste(signal, 0.0, 1.0)
