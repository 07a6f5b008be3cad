"""Veiling glare: light that surfaces, edges and dust of a lens scatter over the whole picture.

The PSF keeps all but a share s of its light, and that share goes into a wide tail by Harvey's law of scattering:

    h' = (1 - s) h + s h * tail,   tail(r) ~ [1 + (r / core)^2]^(-slope / 2)   up to an angle of 1

with r the angle (direction cosine) from where the light was aimed at. Surfaces that are smooth to a wavelength scatter
1 - exp(-(4 pi sigma / lambda)^2) of it, and their spectrum of roughness lies at angles that grow with the wavelength.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import torch
from torch import Tensor

from kcam import spectral
from kcam.cache import ValueCache
from kcam.context import Context, Stage
from kcam.effects import relative_change
from kcam.inputs import check_signal
from kcam.optics.elements.element import set_scalar
from kcam.optics.numerics import Scalar, float64, legendre
from kcam.units import IMAGE_SIDE_RANGE, as_numbers, check_length, nm, percent_hint, wavelength_grid

GLARE_BORDERS = ("mirror", "zero")
_NEAR, _INSIDE, _TURN = 24, 5, 48  # pixels that are integrated, nodes in each, and in half a right angle
_KEPT = 2**25  # numbers of transfer functions that a stage keeps


def _power(x: Tensor, exponent: Tensor) -> Tensor:
    """((1 + x^2)^exponent - 1) / exponent, and its limit log(1 + x^2) at 0: Harvey's law integrated over a disc."""
    log = torch.log1p(x**2)
    product = exponent * log
    near = product.abs() < 1e-5
    ratio = torch.expm1(torch.where(near, 1.0, product)) / torch.where(near, 1.0, product)
    return log * torch.where(near, 1 + product / 2 + product**2 / 6, ratio)


def scattered_within(angle: Scalar, *, core: Scalar, slope: Scalar, reach: Scalar = 1.0) -> Tensor:
    """Share of the scattered light within an angle of where it was aimed at, by Harvey's law.

    E(r) = [(1 + (r / core)^2)^(1 - slope / 2) - 1] / [(1 + (reach / core)^2)^(1 - slope / 2) - 1],
    log(1 + (r / core)^2) / log(1 + (reach / core)^2) at a slope of 2

    A black spot of this radius in an even white field has the veiling glare index s (1 - E) in its middle.

    Args:      angle: r, >= 0 [direction cosine, about rad], or any unit that core and reach are in too.
               core: the shoulder of Harvey's law, > 0.  slope: of its tail, > 0.  reach: where scattering ends.
    Returns:   0..1, float64.
    Source:    J. E. Harvey, Understanding Surface Scatter (SPIE Press, 2019), the Harvey-Shack BSDF and its integral;
               ISO 9358:1994 for the veiling glare index of a black spot.

    Example:
    >>> [round(float(optics.scattered_within(angle, core=0.01, slope=2.0)), 2) for angle in (0.01, 0.1, 1.0)]
    [0.08, 0.5, 1.0]
    """
    exponent = 1 - float64(slope) / 2
    inside = torch.minimum(float64(angle), float64(reach)) / float64(core)
    return _power(inside, exponent) / _power(float64(reach) / float64(core), exponent)


def scattered_share(share: Scalar, wavelengths: Tensor, *, reference: float = 550 * nm, power: Scalar = 2.0) -> Tensor:
    """Share of the light that a lens scatters at each wavelength, from that at one.

    s(lambda) = 1 - (1 - s)^((reference / lambda)^power),   which is 1 - exp(-(4 pi sigma / lambda)^2) for a power of 2

    Args:      share: s at the reference, 0 <= s < 1.  wavelengths: (L,) [m].  reference: [m].
               power: 2 of polished surfaces, 0 of dust and edges, which scatter all colours alike.
    Returns:   (L,) float64.
    Source:    H. E. Bennett and J. O. Porteus, J. Opt. Soc. Am. 51, 123 (1961), total integrated scatter.

    Example:
    >>> [round(float(s), 4) for s in optics.scattered_share(0.02, torch.tensor([450.0, 550.0, 650.0]) * nm)]
    [0.0297, 0.02, 0.0144]
    """
    return -torch.expm1(torch.log1p(-float64(share)) * (reference / wavelengths.double()) ** float64(power))


def _in_rectangle(height: float, width: float, core: Tensor, slope: Tensor, reach: Tensor) -> Tensor:
    """Share of the scattered light in a rectangle of these half sides around the middle."""
    nodes, weights = (torch.as_tensor(part) for part in legendre(_TURN))
    corner = math.atan2(height, width)
    found = core.new_zeros(())
    for side, turn in ((width, corner), (height, math.pi / 2 - corner)):
        radius = side / torch.cos((nodes + 1) * turn / 2)
        shares = scattered_within(radius.to(core.device), core=core, slope=slope, reach=reach)
        found = found + (shares * weights.to(core.device)).sum() * turn / 2
    return found / (math.pi / 2)


def glare_transfer(shape: tuple[int, int], *, core: Scalar, slope: Scalar, reach: Scalar, border: str) -> Tensor:
    """Transfer function of Harvey's tail on the picture that is doubled along both axes: (2 H, W + 1) float64, real.

    The tail is integrated over the pixels: those near its middle by quadrature, the first of them exactly. Beyond the
    doubled picture it is taken as even where the world is mirrored, and is lost where that is dark.

    Args:      shape: (H, W) of the picture.  core, slope, reach: as of `scattered_within` [pixels].
               border: "mirror" or "zero".
    """
    core, slope, reach = float64(core), float64(slope), float64(reach).to(float64(core).device)
    height, width = shape
    side = [torch.arange(n + 1, dtype=torch.float64, device=core.device) for n in shape]

    def law(squared: Tensor) -> Tensor:
        inside = (1 + squared / core**2) ** (-slope / 2)
        return torch.where(squared <= reach**2, inside, torch.zeros_like(inside))

    tail = law(side[0][:, None] ** 2 + side[1] ** 2)
    near = [min(_NEAR, n) + 1 for n in shape]
    nodes, weights = (torch.as_tensor(part, device=core.device) for part in legendre(_INSIDE))
    fine = [side[axis][: near[axis], None] + nodes / 2 for axis in (0, 1)]
    values = law(fine[0][:, :, None, None] ** 2 + fine[1] ** 2)
    mean = torch.einsum("yixj,i,j->yx", values, weights / 2, weights / 2)
    tail = torch.cat([torch.cat([mean, tail[: near[0], near[1] :]], 1), tail[near[0] :]])
    # the pixel in the middle, and all in the doubled picture, are known exactly; the others share what is between
    counts = [torch.full_like(one, 2.0) for one in side]
    for one in counts:
        one[0] = one[-1] = 1.0
    middle = _in_rectangle(0.5, 0.5, core, slope, reach)
    inside = _in_rectangle(float(height), float(width), core, slope, reach)
    first = torch.zeros_like(tail)
    first[0, 0] = 1.0
    around = tail * (1 - first)
    total = (around * counts[0][:, None] * counts[1]).sum().clamp(min=1e-300)
    kernel = middle * first + around * ((inside - middle).clamp(min=0) / total)
    if border == "mirror":
        kernel = kernel + (1 - inside).clamp(min=0) / (4 * height * width)
    for axis, n in enumerate(shape):
        kernel = torch.cat([kernel, kernel.narrow(axis, 1, n - 1).flip(axis)], axis)
    return torch.fft.rfft2(kernel).real


def _scattered(signal: Tensor, shares: Sequence[Tensor], transfers: Iterable[Tensor], *, border: str) -> Tensor:
    """(1 - s) signal + s (tail * signal) of each channel, in float64: beside a lamp of 1e6 a black of 0 stays one."""
    height, width = signal.shape[-2:]
    planes = []
    for plane, share, transfer in zip(signal.unbind(-3), shares, transfers, strict=True):
        light = plane.double()
        around = light
        if border == "mirror":
            for axis in (-2, -1):
                around = torch.cat([around, around.flip(axis)], axis)
        spectrum = torch.fft.rfft2(around, s=(2 * height, 2 * width)) * transfer
        tail = torch.fft.irfft2(spectrum, s=(2 * height, 2 * width))[..., :height, :width]
        planes.append(light + share * (tail - light))
    return torch.stack(planes, -3).to(signal.dtype)


def veiling_glare(
    signal: Tensor, *, share: Scalar, core: Scalar, slope: Scalar, reach: Scalar, border: str = "mirror"
) -> Tensor:
    """Spread a share of the light by Harvey's law of scattering.

    result = (1 - s) signal + s (tail * signal),   tail(r) ~ [1 + (r / core)^2]^(-slope / 2) for r <= reach, of sum 1

    Args:      signal: (..., C, H, W), linear in the light.  share: s, a number or one for each channel (C,), 0 to < 1.
               core: shoulder of the law, a number or one for each channel, > 0 [pixels].  slope: of its tail, > 0.
               reach: where scattering ends, an angle of 90 degrees: the focal length [pixels].
               border: what lies beyond the picture: "mirror", so that light is conserved, or "zero", so that what
               leaves is lost and nothing comes in.
    Returns:   same shape and dtype, computed in float64.
    Raises:    TypeError for integers; ValueError for another number of shares, or an unknown border.
    Valid when angles are small: 1 % at 8 degrees from where light was aimed at, where sin and tan differ by that.
    Source:    Harvey (2019), as `scattered_within`.

    Example:
    >>> spot = torch.zeros(1, 1, 65, 65, dtype=torch.float64)
    >>> spot[..., 32, 32] = 1.0
    >>> spread = optics.veiling_glare(spot, share=0.02, core=2.0, slope=2.0, reach=2000.0)
    >>> round(float(spread.sum()), 9), bool(spread[..., 32, 32] > 0.98)
    (1.0, True)
    """
    check_signal(signal)
    if signal.ndim < 3:
        raise ValueError(f"expected (..., C, H, W), got shape {tuple(signal.shape)}. Use signal[None] for one channel.")
    if border not in GLARE_BORDERS:
        raise ValueError(f"unknown border {border!r}; known: {', '.join(GLARE_BORDERS)}.")
    if not signal.numel():
        return signal * 1.0
    shares, cores = (
        _each(value, signal.shape[-3], name=name).to(signal.device).unbind()
        for value, name in ((share, "share"), (core, "core"))
    )
    shape = (signal.shape[-2], signal.shape[-1])
    transfers = (glare_transfer(shape, core=one, slope=slope, reach=reach, border=border) for one in cores)
    return _scattered(signal, shares, transfers, border=border)


def _each(value: Scalar, channels: int, *, name: str) -> Tensor:
    values = float64(value).flatten()
    if len(values) not in (1, channels):
        raise ValueError(f"{name} has {len(values)} values for {channels} channels; give one number, or one for each.")
    return values.expand(channels)


class VeilingGlare(Stage):
    """Light that the lens scatters over the picture: `veiling_glare`, at each wavelength its own.

    Between Imaging and ColourFilter it is exact, at the price of all bands; behind the filter, before a Mosaic, each
    channel scatters the mean share of what it records of a white, at the mean wavelength of what is scattered: of
    white light off by 2e-4 of the glare, of coloured pictures by 1 to 7 % of it, by 10 % behind the broad curves of
    `ColourFilter.sigma`; 3 % of glare are then off by 0.2 % of the signal. As many bands as the filter has curves are
    taken for its channels.

    Its error if skipped is the change of the signal; `scattered_within` foretells the veiling glare of a black spot.

    Args:      share: of the light that is scattered, at `wavelength`, 0 to < 1: about the veiling glare index of ISO
               9358, 0.01 to 0.03 of good lenses, up to 0.1 of a phone's with a fingerprint.
               core: shoulder of Harvey's law at `wavelength` [direction cosine, about rad].
               slope: of its tail, 0.1 to 6; 1.5 to 2.5 of polished glass.
               wavelength: [m].  power: how the share falls with the wavelength, its core growing by half of that: see
               `scattered_share`.
               focal_length: metres on the sensor for each radian; None to take it from the context's lens.
               border: as of `veiling_glare`.
    Raises:    ValueError for a value out of range, at the call for no focal length, or for a mosaiced plane.
    Source:    Harvey (2019), chapter on the Harvey-Shack theory: the tail's core and share against the wavelength.

    Example:
    >>> white = torch.ones(1, 1, 64, 64)
    >>> white[..., 24:40, 24:40] = 0.0  # a black spot of 16 pixels
    >>> glare = optics.VeilingGlare(0.03, core=0.002, focal_length=8 * mm)(white)
    >>> round(float(glare[0, 0, 32, 32]), 3)  # most of 3 %
    0.025
    """

    whole_picture = True
    """Light comes from anywhere in the picture: what a crop of it changes by tells little of the whole."""

    share: Scalar
    core: Scalar
    slope: Scalar
    power: Scalar
    focal_length: Scalar | None

    def __init__(
        self,
        share: Scalar = 0.02,
        *,
        core: Scalar = 0.01,
        slope: Scalar = 2.0,
        wavelength: float = 550 * nm,
        power: Scalar = 2.0,
        focal_length: Scalar | None = None,
        border: str = "mirror",
    ):
        super().__init__()
        bounds = {"share": (share, 0.0, 0.999), "core": (core, 1e-6, 1.0), "slope": (slope, 0.1, 6.0)}
        for name, (value, least, most) in (bounds | {"power": (power, 0.0, 4.0)}).items():
            number = as_numbers(value, name=name, expected=f"a number from {least:g} to {most:g}").detach()
            if number.numel() != 1 or not least <= float(number) <= most:
                hint = percent_hint(float(number)) if name == "share" and number.numel() == 1 else ""
                raise ValueError(f"{name} must be a number from {least:g} to {most:g}, got {_shown(number)}.{hint}")
            set_scalar(self, name, value)
        self.wavelength = float(wavelength_grid([wavelength])[0])
        if border not in GLARE_BORDERS:
            raise ValueError(f"unknown border {border!r}; known: {', '.join(GLARE_BORDERS)}.")
        self.border = border
        if focal_length is None:
            self.focal_length = None
        else:
            check_length(focal_length, name="focal_length", within=IMAGE_SIDE_RANGE, example="8 * mm")
            set_scalar(self, "focal_length", focal_length)
        self._cache = ValueCache()

    def forward(self, signal: Tensor, context: Context | None = None) -> Tensor:
        """Bands or channels (B,C,H,W) of light to the same shape: see `veiling_glare`."""
        check_signal(signal)
        context = context or Context()
        if signal.ndim < 3 or not signal.numel():
            return veiling_glare(signal, share=self.share, core=self.core, slope=self.slope, reach=1.0)
        shares, cores = (part.to(signal.device) for part in self.scattering(signal.shape[-3], context))
        reach = self._focal_length(context) / context.pixel_pitch
        height, width = signal.shape[-2:]

        def transfers() -> Iterable[Tensor]:
            for core in (cores * reach).unbind():
                yield glare_transfer((height, width), core=core, slope=self.slope, reach=reach, border=self.border)

        kept: Iterable[Tensor] = transfers()
        if 2 * height * (width + 1) * len(cores) <= _KEPT:
            key = (cores, float64(self.slope), reach, height, width, self.border)
            kept = self._cache.get(key, lambda: torch.stack(list(transfers())))
        return _scattered(signal, shares.unbind(), kept, border=self.border)

    def scattering(self, channels: int, context: Context | None = None) -> tuple[Tensor, Tensor]:
        """Share of the light that each channel scatters, and the core of its tail [direction cosine], (C,) float64.

        Bands where the context has as many wavelengths; else channels of its colour filter, under its light; else all
        at the stage's own wavelength.

        Raises:    ValueError for one plane of a filter of several channels: a mosaic.
        """
        context = context or Context()
        known: int | None = None
        if context.colour_filter is not None:
            curves = context.colour_filter.contraction(context.wavelengths).double()
            known = len(curves)
        grid = context.wavelengths.to(float64(self.share).device)
        shares = scattered_share(self.share, grid, reference=self.wavelength, power=self.power)
        cores = float64(self.core) * (grid / self.wavelength) ** (float64(self.power) / 2)
        if channels == known:
            light = context.illuminant
            light = spectral.illuminant("D65", wavelengths=context.wavelengths) if light is None else light
            weights = curves.to(grid) * light.to(grid)
            weights = weights / weights.sum(1, keepdim=True).clamp(min=1e-300)
            scattered, seen = weights * shares, weights @ cores
            total = scattered.sum(1)
            # where nothing is scattered the mean is that of the light, and of no light one that a slope needs
            mean = torch.where(total > 0, (scattered @ cores) / torch.where(total > 0, total, 1.0), seen)
            return total, torch.where(mean > 0, mean, float64(self.core))
        if channels == len(grid):
            return shares, cores
        if channels == 1 and known is not None:
            raise ValueError(
                f"VeilingGlare was given one plane behind a filter of {known} curves, a mosaic: light is scattered "
                "before it is filtered. Put it before the Mosaic, or before a ColourFilter that is a tile."
            )
        one = scattered_share(self.share, grid.new_full((1,), self.wavelength), reference=self.wavelength)
        return one.expand(channels), float64(self.core).expand(channels)

    def _focal_length(self, context: Context) -> Tensor:
        if self.focal_length is not None:
            return float64(self.focal_length)
        lens = context.lens
        found = None if lens is None else getattr(lens, "image_scale", lens.sensor_distance)
        if found is None:
            raise ValueError(
                "VeilingGlare needs to know how large an angle is on the sensor, and there is no lens that says so: "
                "put optics.Imaging(lens, ...) before it, or give focal_length=50 * mm."
            )
        return float64(found)

    def error_if_skipped(self, signal: Tensor, context: Context | None = None) -> float:
        """The change of this signal; see `kcam.effects.Skippable`."""
        return relative_change(self, signal, context)

    def cost(self, signal: Tensor, context: Context | None = None) -> float:
        """Two transforms of four times as many numbers, in float64: measured."""
        return 150.0

    def reason(self, signal: Tensor, context: Context | None = None) -> str:
        """What is scattered."""
        share = float(torch.as_tensor(self.share).detach())
        return f"{share:.2%} scattered, {self.error_if_skipped(signal, context):.1e} of the signal's RMS"


def _shown(number: Tensor) -> str:
    return f"{float(number):g}" if number.numel() == 1 else f"{number.numel()} of them"
