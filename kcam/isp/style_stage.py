"""The style stage: a small feed-forward network after the camera, which paints."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from kcam.context import Context, Stage
from kcam.inputs import check_signal, remedy
from kcam.isp.film import anchored, motions
from kcam.optics.numerics import fast_length
from kcam.precision import full_precision
from kcam.ste import clip_ste

SEEN_AT_ONCE = 2**20
"""Pixels; a larger picture is painted in tiles."""
TILE = 512
LEAST_VARIANCE = 1e-5
"""Added to what a normalisation divides by."""
LENGTH, WIDTH = 7.0, 2.2
"""Standard deviations of drawn-out noise along its direction and across [pixels]."""
LONGEST = 14
DIRECTIONS = 8
CELL, SMOOTHED = 8, 1.5
"""Pixels between the random vectors that make directions flow, and the Gaussian that smooths these [cells]."""
WINDOWS = 4
"""Across and down: where the statistics of a picture in tiles are taken."""
DARKEST = 0.03
"""What black is taken for, and 1 - 0.03 for white, so that strokes can lie on them: the logit has no bound."""
FURTHEST = 4.0
"""Bound of the result's logit: beyond it the sigmoid has no gradient that would bring it back."""
LEAST_SHOWN = 1 / (1 + math.exp(FURTHEST))
"""0.018, the darkest that a stage paints; 0.982 is the brightest."""


class _Conv(nn.Conv2d):
    """A convolution that continues the picture by its border.

    Before a normalisation it has no bias, which would cancel: its gradient is rounding, of which Adam makes full steps.
    """

    def __init__(
        self, channels: int, out: int, side: int, *, stride: int = 1, dilation: int = 1, bias: bool = False
    ) -> None:
        border = {"padding": dilation * (side // 2), "padding_mode": "replicate"}
        super().__init__(channels, out, side, stride=stride, dilation=dilation, bias=bias, **border)  # type: ignore[arg-type]

    def reset_parameters(self) -> None:
        """Nothing: torch's would draw from the global generator, and the stage sets them."""


class _Norm(nn.Module):
    """Instance normalisation with gain and offset, whose statistics can be taken elsewhere than where they are used."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(channels))
        self.bias = nn.Parameter(torch.zeros(channels))

    def forward(self, x: Tensor, given: Iterator[tuple[Tensor, Tensor]] | None, seen: list | None) -> Tensor:
        if given is not None:
            mean, variance = next(given)
        elif seen is not None:
            variance, mean = torch.var_mean(x, (0, 2, 3), correction=0, keepdim=True)
            seen.append((mean, variance))
        else:  # a tenth of the time of its formula; unlike torch.nn's, it also takes a single pixel
            return torch.group_norm(x, x.shape[1], self.weight, self.bias, LEAST_VARIANCE)
        gain = self.weight[:, None, None] * torch.rsqrt(variance + LEAST_VARIANCE)
        return x * gain + (self.bias[:, None, None] - mean * gain)


class _Residual(nn.Module):
    def __init__(self, channels: int, dilation: int) -> None:
        super().__init__()
        self.first, self.first_norm = _Conv(channels, channels, 3, dilation=dilation), _Norm(channels)
        self.second, self.second_norm = _Conv(channels, channels, 3, dilation=dilation), _Norm(channels)

    def forward(self, x: Tensor, given: Iterator | None, seen: list | None) -> Tensor:
        inner = F.relu(self.first_norm(self.first(x), given, seen))
        return x + self.second_norm(self.second(inner), given, seen)


class StyleStage(Stage):
    """A feed-forward network that repaints a picture, in the manner of Johnson et al. (2016), with noise.

    y = sigmoid( clip( M logit(x) + network(x, noise), -4, 4) )

    Down to a quarter of the size in two strided convolutions, dilated residual blocks, and back up, where the last
    convolution also sees what the first one made: the detail of the picture and of the noise. Without noise a network
    that sees only the picture must leave an even area even; planes of Gaussian noise, beside the picture and at a
    quarter of its size, let strokes grow there (as in texture networks). Those beside the picture are drawn out along
    and across directions that flow over the picture, by Gaussians 7 pixels long and 2.2 wide and by twice as large
    ones: from white noise a small network learns grain before it learns strokes. As it is built it changes nothing but
    values below 0.03 and above 0.97: the last convolution starts at 0, M at the identity.

    The noise comes from the context's generator: the same generator state, picture and weights give the same bytes. A
    picture of more than a megapixel is painted tile by tile; the statistics that its instance normalisation divides by
    are then those of 4 x 4 windows spread over it.

    Args:      width: channels at full size; twice and four times as many at half and a quarter.
               dilations: of the residual blocks.
               noise: planes of white noise at full size, of drawn-out noise of each of its two sizes, and of white
               noise at a quarter of the size.
               level: of the noise, 1.0 as trained; 0 for none.
    Raises:    ValueError for a width or a dilation below 1, anything but three numbers of planes >= 0, a level that is
               negative or not finite, and at the call for another number of channels than 3; TypeError at the call for
               pictures of whole numbers.
    Source:    Johnson, Alahi and Fei-Fei, Perceptual losses for real-time style transfer and super-resolution (2016);
               Ulyanov et al., Texture networks (2016), the noise; instance normalisation (2016); Cabral and Leedom,
               Imaging vector fields using line integral convolution (1993), noise drawn out along a flow.

    Example:
    >>> picture = 0.1 + 0.8 * torch.rand(1, 3, 32, 32)
    >>> torch.allclose(isp.StyleStage(width=4)(picture), picture, atol=1e-5)  # before it is trained
    True
    """

    def __init__(
        self,
        *,
        width: int = 16,
        dilations: Sequence[int] = (1, 2, 4, 8),
        noise: tuple[int, int, int] = (0, 2, 8),
        level: float = 1.0,
    ) -> None:
        super().__init__()
        for name, values in (("width", (width,)), ("dilations", tuple(dilations))):
            if not values or not all(isinstance(value, int) and value >= 1 for value in values):
                raise ValueError(f"{name} must be positive whole numbers, got {values!r}.")
        if len(noise) != 3 or not all(isinstance(value, int) and value >= 0 for value in noise):
            raise ValueError(f"noise must be three whole numbers >= 0, such as (0, 2, 8), got {noise!r}.")
        if not 0 <= level < math.inf:
            raise ValueError(f"level must be a finite number >= 0, got {level!r}. 1.0 is what a stage is trained with.")
        self.width, self.dilations, self.level = width, tuple(dilations), level
        self.noise = (noise[0], noise[1], noise[2])
        half, quarter = 2 * width, 4 * width
        self.enter, self.enter_norm = _Conv(3 + noise[0] + 2 * noise[1], width, 5), _Norm(width)
        self.down1, self.down1_norm = _Conv(width, half, 3, stride=2), _Norm(half)
        self.down2, self.down2_norm = _Conv(half, quarter, 3, stride=2), _Norm(quarter)
        self.mix = _Conv(quarter + noise[2], quarter, 1, bias=True)
        self.blocks = nn.ModuleList(_Residual(quarter, dilation) for dilation in self.dilations)
        self.up1, self.up1_norm = _Conv(quarter, half, 3), _Norm(half)
        self.up2, self.up2_norm = _Conv(half, width, 3), _Norm(width)
        self.leave = _Conv(2 * width, 3, 5, bias=True)
        self.colour = nn.Parameter(torch.eye(3))
        self._start()

    def _start(self) -> None:
        """The same start every time, whatever torch's own generator has given to others."""
        seeded = torch.Generator("cpu").manual_seed(0)
        for layer in self.modules():
            if isinstance(layer, _Conv):
                start = torch.empty(layer.weight.shape, dtype=layer.weight.dtype, device="cpu")
                nn.init.kaiming_uniform_(start, a=math.sqrt(5), generator=seeded)
                with torch.no_grad():
                    layer.weight.copy_(start)
                    if layer.bias is not None:
                        layer.bias.zero_()
        nn.init.zeros_(self.leave.weight)

    @property
    def reach(self) -> int:
        """How far from a pixel its result can depend on the picture, but for the statistics, a multiple of 4."""
        return 4 * (2 * sum(self.dilations) + 4)

    def mean(self) -> StyleStage:
        """The stage without its noise: one picture of those that it paints, not their mean. Shares the weights."""
        quiet = copy.copy(self)
        quiet.level = 0.0
        return quiet

    def film(self, frames: Tensor, motion: Any, *, generator: torch.Generator | None = None) -> Tensor:
        """Paint the frames (T,3,H,W) of a film with noise that moves with what they show, so that strokes do.

        Args:      motion: from each frame to the next, pixels (x, y): (2,), (T-1,2), or (T-1,2,H,W) of each pixel of
                   the later one.
        Raises:    TypeError, ValueError for a motion of another shape, or one that is not finite.
        """
        return self._painted(frames, generator, motion)

    def forward(self, signal: Tensor, context: Context | None = None) -> Tensor:
        """(B,3,H,W) sRGB in [0,1] to the same shape, in 0.018..0.982."""
        return self._painted(signal, (context or Context()).generator, None)

    def _painted(self, signal: Tensor, generator: torch.Generator | None, motion: Any) -> Tensor:
        check_signal(signal, channels=(3,))
        if signal.ndim != 4 or signal.shape[1] != 3:
            raise ValueError(
                f"StyleStage repaints pictures (B,3,H,W), got shape {tuple(signal.shape)}. Put it behind the ToneCurve."
                f"{remedy(signal, name='signal', channels=(3,), ndims=(4,), scaled=False)}"
            )
        if signal.numel() == 0:
            return signal
        height, width = signal.shape[-2:]
        border = (0, -width % 4, 0, -height % 4)
        whole = F.pad(signal.to(self.colour.dtype), border, mode="replicate")
        noise = self._noise(whole, generator)
        if motion is not None:
            moved = motions(motion, signal)
            if len(moved):
                moved = F.pad(moved, border, mode="replicate")
                noise = (anchored(noise[0], moved), anchored(noise[1], moved))
        painted = self._paint(whole, noise) if height * width <= SEEN_AT_ONCE else self._in_tiles(whole, noise)
        return painted[..., :height, :width].to(signal.dtype)

    def _noise(self, picture: Tensor, generator: torch.Generator | None) -> tuple[Tensor, Tensor]:
        """Planes at full size and at a quarter, for the whole picture."""
        batch, _, height, width = picture.shape
        where: dict[str, Any] = {"dtype": picture.dtype, "device": picture.device}
        white, drawn_out, at_quarter = self.noise
        if self.level == 0:
            fine = picture.new_zeros(batch, white + 2 * drawn_out, height, width)
            return fine, picture.new_zeros(batch, at_quarter, height // 4, width // 4)
        if generator is not None and generator.device != picture.device:
            where["device"] = generator.device

        def draw(planes: int, rows: int, columns: int) -> Tensor:
            return torch.randn(batch, planes, rows, columns, generator=generator, **where).to(picture)

        fine, coarse = draw(white, height, width), draw(at_quarter, height // 4, width // 4)
        if drawn_out:
            thin, wide = (_flowing(draw, drawn_out, height // size, width // size) for size in (1, 2))
            fine = torch.cat([fine, thin, _doubled(wide)], dim=1)
        return self.level * fine, self.level * coarse

    def _paint(
        self, picture: Tensor, noise: tuple[Tensor, Tensor], *, given: list | None = None, seen: list | None = None
    ) -> Tensor:
        """The network on a picture whose sides are multiples of 4, with its own statistics or the given ones."""
        how = (None if given is None else iter(given), seen)
        coded = torch.logit(picture.clamp(DARKEST, 1 - DARKEST))
        fine = F.relu(self.enter_norm(self.enter(torch.cat([2 * picture - 1, noise[0]], dim=1)), *how))
        x = F.relu(self.down1_norm(self.down1(fine), *how))
        x = F.relu(self.down2_norm(self.down2(x), *how))
        x = self.mix(torch.cat([x, noise[1]], dim=1))
        for block in self.blocks:
            x = block(x, *how)
        x = F.relu(self.up1_norm(self.up1(_doubled(x)), *how))
        x = F.relu(self.up2_norm(self.up2(_doubled(x)), *how))
        strokes = self.leave(torch.cat([x, fine], dim=1)).to(coded)
        with full_precision(coded.device):  # autocast may round what is painted, not what is kept
            painted = torch.einsum("nc,bchw->bnhw", self.colour, coded) + strokes
            return torch.sigmoid(clip_ste(painted, -FURTHEST, FURTHEST))

    def _in_tiles(self, picture: Tensor, noise: tuple[Tensor, Tensor]) -> Tensor:
        """A large picture, tile by tile with a border as wide as the reach: bounded memory, no seams."""
        result = torch.empty_like(picture)
        for index in range(len(picture)):
            own, planes = picture[index : index + 1], tuple(plane[index : index + 1] for plane in noise)
            statistics: list = []
            self._paint(*_windows(own, planes), seen=statistics)
            for top in range(0, own.shape[-2], TILE):
                for left in range(0, own.shape[-1], TILE):
                    inner = (top, left, min(top + TILE, own.shape[-2]), min(left + TILE, own.shape[-1]))
                    outer = tuple(edge - self.reach for edge in inner[:2]) + tuple(e + self.reach for e in inner[2:])
                    y0, x0, y1, x1 = max(outer[0], 0), max(outer[1], 0), *outer[2:]
                    part, parts = own[..., y0:y1, x0:x1], _cut(planes, y0, x0, y1, x1)
                    painted = self._paint(part, parts, given=statistics)
                    y, x = inner[0] - y0, inner[1] - x0
                    height, width = inner[2] - inner[0], inner[3] - inner[1]
                    result[index, :, top : inner[2], left : inner[3]] = painted[0, :, y : y + height, x : x + width]
        return result


def _flowing(draw: Callable[[int, int, int], Tensor], planes: int, height: int, width: int) -> Tensor:
    """Noise (B,planes,height,width) of mean 0 and variance 1, drawn out along directions that flow over it.

    The direction is half the angle of a smooth random vector; white noise is convolved with a stroke along each of
    `DIRECTIONS`, and between the two nearest ones interpolated. Every second plane is drawn out across the flow of the
    one before: together they make tiles.
    """
    white = draw(planes, height + 2 * LONGEST, width + 2 * LONGEST)
    reach = math.ceil(3 * SMOOTHED)
    around = 2 * (reach + 2)  # two cells on each side for the cubic interpolation
    flows = -(-planes // 2)
    vectors = draw(2 * flows, *(-(-size // CELL) + around for size in (height, width))).flatten(0, 1)[:, None]
    bell = torch.exp(-(torch.arange(-reach, reach + 1).to(vectors) ** 2) / (2 * SMOOTHED**2))
    vectors = F.conv2d(vectors, (bell[:, None] * bell)[None, None])
    vectors = vectors.view(-1, 2, *vectors.shape[-2:])
    across = (torch.arange(planes, device=white.device) % 2 * (DIRECTIONS // 2))[:, None, None]
    kernels = stroke_kernels().to(white)
    overlap = float((kernels[0] * kernels[1]).sum())
    strips = []
    for top in range(0, height, TILE):  # of 12 megapixels, all directions would take 0.4 GB a plane
        rows = min(TILE, height - top)
        drawn = _drawn_out(white[..., top : top + rows + 2 * LONGEST, :], kernels)
        cells = vectors[..., top // CELL : -(-(top + rows) // CELL) + 4, :]
        flow = F.interpolate(cells, scale_factor=CELL, mode="bicubic", align_corners=False)
        flow = flow[..., 2 * CELL : 2 * CELL + rows, 2 * CELL : 2 * CELL + width].unflatten(0, (-1, flows))
        turns = torch.atan2(flow[:, :, 1], flow[:, :, 0]) * (DIRECTIONS / (2 * math.pi))
        place = turns.repeat_interleave(2, dim=1)[:, :planes] + across
        below = place.floor()
        share = place - below
        first, second = (drawn.gather(2, (below.long() + step)[:, :, None] % DIRECTIONS).squeeze(2) for step in (0, 1))
        variance = (1 - share) ** 2 + share**2 + 2 * overlap * share * (1 - share)
        strips.append((first * (1 - share) + second * share) * variance.rsqrt())
    return torch.cat(strips, dim=2)


def _drawn_out(white: Tensor, kernels: Tensor) -> Tensor:
    """White noise (B,planes,h,w) convolved with each kernel where these lie inside: (B,planes,8,h-28,w-28).

    By FFT, a third of the time of the sums; one at a time, so that each stays in the processor's cache.
    """
    height, width = white.shape[-2:]
    exact = torch.promote_types(white.dtype, torch.float32)  # there are no FFTs of 16 bits on a CPU
    size = (fast_length(height), fast_length(width))
    inside = (..., slice(2 * LONGEST, height), slice(2 * LONGEST, width))
    transfers = torch.fft.rfft2(kernels.to(exact), s=size)
    spectra = (torch.fft.rfft2(plane, s=size) for plane in white.to(exact).flatten(0, 1))
    drawn = [torch.fft.irfft2(spectrum * own, s=size)[inside] for spectrum in spectra for own in transfers]
    return torch.stack(drawn).unflatten(0, (*white.shape[:2], DIRECTIONS)).to(white)


def stroke_kernels() -> Tensor:
    """Gaussians of sigma 7 by 2.2 pixels along 8 directions, (8,29,29), that keep the variance of noise."""
    place = torch.arange(-LONGEST, LONGEST + 1, dtype=torch.float64)
    y, x = torch.meshgrid(place, place, indexing="ij")
    angle = torch.arange(DIRECTIONS, dtype=torch.float64)[:, None, None] * (math.pi / DIRECTIONS)
    along, across = x * torch.cos(angle) + y * torch.sin(angle), y * torch.cos(angle) - x * torch.sin(angle)
    kernels = torch.exp(-(along**2) / (2 * LENGTH**2) - across**2 / (2 * WIDTH**2))
    return kernels / kernels.square().sum((-2, -1), keepdim=True).sqrt()


def _doubled(x: Tensor) -> Tensor:
    return F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)


def _cut(planes: tuple[Tensor, ...], top: int, left: int, bottom: int, right: int) -> tuple[Tensor, Tensor]:
    fine, coarse = planes
    return fine[..., top:bottom, left:right], coarse[..., top // 4 : bottom // 4, left // 4 : right // 4]


def _windows(picture: Tensor, planes: tuple[Tensor, ...]) -> tuple[Tensor, tuple[Tensor, Tensor]]:
    """Windows spread over a large picture, as a batch."""
    side = TILE // 2
    tops, lefts = (
        (torch.linspace(0, max(size - side, 0), WINDOWS) / 4).int().mul(4).tolist() for size in picture.shape[-2:]
    )
    places = [(top, left) for top in tops for left in lefts]
    parts = [_cut(planes, top, left, top + side, left + side) for top, left in places]
    cut = torch.cat([picture[..., top : top + side, left : left + side] for top, left in places])
    return cut, (torch.cat([fine for fine, _ in parts]), torch.cat([coarse for _, coarse in parts]))
