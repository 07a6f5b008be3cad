"""Exposure in time: what moves while the shutter is open, and rows that see later moments.

E(x) = 1/T INT_0^T S(x - u(x, t_r + t)) dt,     t_r = readout r / H

S is the still image on the sensor, u how far its content has moved since the exposure of the first row began
[pixels, +x right, +y down], T the exposure time, r the row. At t = 0 the picture stands where the scene has it.

Where all pixels move alike and at once (`velocity`, `path`, a global shutter) this is a convolution, and exact for
light that the pixels sample without aliasing: a straight piece of the path from a to b that takes a share s of the time
has the transfer function s exp(-i pi f.(a + b)) sinc(f.(b - a)). Where rows see later moments, a convolution for the
time of one row is followed by a shift of each row; where each pixel has its own velocity (`flow`), some moments are
averaged.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

from kcam.context import Context, Stage
from kcam.effects import relative_rms
from kcam.inputs import check_signal
from kcam.optics.numerics import fast_length
from kcam.optics.rendering.borders import BORDERS, part
from kcam.sensor.arguments import check_not_negative, hold, in_float32, like
from kcam.units import as_numbers, check_positive, check_trained

STEP = 0.5
"""Between two moments that are averaged, what moves most moves so far [pixels]: off by 1 % of S'' at most."""
MOST_SAMPLES = 512
LONGEST = 4096.0
"""Pixels that anything may move."""
_NEAR = 16.0  # pixels that content moves, up to which a crop of a picture tells about the whole
_TAPS, _BEYOND = 8, 16  # of the interpolation of rows, and pixels of border beside what moves in


def tremor(
    time: float, *, amplitude: float = 1.0, seed: int = 0, count: int = 65, peak: float = 9.0, share: float = 0.3
) -> Tensor:
    """The path of a camera in hands that tremble: a random walk, and a physiological tremor about 9 Hz.

    u(t) = amplitude [ sqrt(1 - share^2) W(t) + share sum_k a_k (sin(2 pi f_k t + phi_k) - sin phi_k) ]

    with a Brownian motion W of unit variance after a second in each direction, and eight tremors a_k = 1 / sqrt(8) with
    f_k from 0.8 to 1.2 times the peak.

    Args:      time: exposure, with the readout of a rolling shutter [s].
               amplitude: RMS distance in x, and in y, after a second [pixels]: angle times focal length / pixel pitch.
               seed: names the path.  count: of its points.  peak [Hz].  share: of the tremor, 0..1.
    Returns:   (count, 2) float64 [pixels], from (0, 0) on: a `path` for `Motion`.
    Raises:    ValueError for a time, a peak or an amplitude out of range, or fewer than two points.
    Source:    Gavant et al., A physiological camera shake model for image stabilization systems, IEEE Sensors (2011):
               drift and a tremor of 8 to 12 Hz; Xiao et al., Camera-motion and effective spatial resolution, ICIS
               (2006): hand-held cameras drift like a random walk.

    Example:
    >>> ends = torch.stack([sensor.tremor(1.0, amplitude=3.0, seed=seed)[-1] for seed in range(400)])
    >>> [round(float(value)) for value in ends.square().mean(0).sqrt()]  # pixels, in x and y
    [3, 3]
    """
    check_positive(time, name="time", unit="s")
    check_positive(peak, name="peak", unit="Hz")
    check_not_negative(amplitude, name="amplitude", unit="pixels", most=LONGEST)
    check_not_negative(share, name="share", unit="(of the tremor)", most=1.0)
    if count < 2:
        raise ValueError(f"a path has two points or more, got count={count}.")
    generator = torch.Generator().manual_seed(seed)
    steps = torch.randn(count - 1, 2, generator=generator, dtype=torch.float64) * math.sqrt(time / (count - 1))
    walk = torch.cat([torch.zeros(1, 2, dtype=torch.float64), steps.cumsum(0)])
    rates = 2 * math.pi * peak * (0.8 + 0.4 * torch.rand(8, generator=generator, dtype=torch.float64))
    phases = 2 * math.pi * torch.rand(8, 2, generator=generator, dtype=torch.float64)
    moments = torch.linspace(0, time, count, dtype=torch.float64)[:, None, None]
    waves = torch.sin(rates[:, None] * moments + phases) - torch.sin(phases)
    return amplitude * (math.sqrt(1 - share**2) * walk + share * waves.sum(1) / math.sqrt(8))


@in_float32
def path_blur(signal: Tensor, *, path: Tensor, border: str = "reflect") -> Tensor:
    """The mean of a picture that moves along a path of straight pieces, each of equal time: exact.

    Args:      signal: (B,C,H,W).  path: (N,2) or (B,N,2), N >= 2, x and y [pixels].  border: what lies beyond the
               picture and moves in: reflect, replicate, periodic or zero.
    Returns:   (B,C,H,W).

    Example:
    >>> line = torch.zeros(1, 1, 1, 32)
    >>> line[..., 10] = 1
    >>> moved = sensor.path_blur(line, path=torch.tensor([[3.0, 0.0], [3.0, 0.0]]), border="periodic")
    >>> int(moved.argmax()), round(float(moved.max()), 4)
    (13, 1.0)
    """
    most = min(float(path.detach().abs().max()) if path.numel() else 0.0, LONGEST)
    reach = 8 * (1 + math.floor(most / 8))  # in steps, so that a derivative sees the same border
    height, width = signal.shape[-2:]
    planes = _periodic(_periodic(signal, reach, border, dim=-2), reach, border, dim=-1)
    size = planes.shape[-2:]
    path = path.to(signal)
    path = path if path.ndim == 3 else path[None]
    fy = torch.fft.fftfreq(size[0], dtype=signal.dtype, device=signal.device)[:, None]
    fx = torch.fft.rfftfreq(size[1], dtype=signal.dtype, device=signal.device)
    transfer: Any = 0.0
    pieces = path.shape[1] - 1
    for start, stop in zip(path[:, :-1].unbind(1), path[:, 1:].unbind(1), strict=True):
        middle, span = ((start + stop) / 2)[..., None, None], (stop - start)[..., None, None]
        phase = -2 * math.pi * (fx * middle[:, 0] + fy * middle[:, 1])
        size_of = torch.sinc(fx * span[:, 0] + fy * span[:, 1]) / pieces
        transfer = transfer + torch.complex(size_of * phase.cos(), size_of * phase.sin())
    moved = torch.fft.irfft2(torch.fft.rfft2(planes) * transfer[:, None], s=size)
    return moved[..., :height, :width]


def _periodic(planes: Tensor, reach: int, border: str, *, dim: int) -> Tensor:
    """Planes with what moves in from beyond both ends, that before the first at the end, where the two fade into each
    other: a jump would ring.
    """
    n = planes.shape[dim]
    if border == "periodic":
        return planes
    length = fast_length(n + 2 * (reach + _BEYOND) + _BEYOND)
    fade = length - n - 2 * (reach + _BEYOND)
    own = part(planes, 0, n + reach + _BEYOND + fade, border, dim=dim)
    before = part(planes, -reach - _BEYOND - fade, 0, border, dim=dim)
    kept, going = own.split([n + reach + _BEYOND, fade], dim=dim)
    coming, last = before.split([fade, reach + _BEYOND], dim=dim)
    weight = torch.linspace(0, math.pi, fade, dtype=planes.dtype, device=planes.device).cos() / 2 + 0.5
    mixed = torch.lerp(coming, going, weight if dim == -1 else weight[:, None])
    return torch.cat([kept, mixed, last], dim=dim)


@in_float32
def move_rows(signal: Tensor, *, shifts: Tensor, border: str = "reflect") -> Tensor:
    """Each row of the picture as it is when the content has moved so far: result[r] = S(x - shifts[r]).

    By the polynomial through the eight nearest pixels, in x and in y: flat where light is smooth, to 1e-5 of what has
    ten pixels a period, 2e-3 of five, 0.05 of three.

    Source:    Laakso et al., Splitting the unit delay, IEEE Signal Processing Magazine 13 (1), 30 (1996): Lagrange.

    Args:      signal: (B,C,H,W).  shifts: (H,2) or (B,H,2), x and y [pixels].  border: as of `path_blur`.
    Returns:   (B,C,H,W).

    Example:
    >>> column = torch.zeros(1, 1, 3, 9)
    >>> column[..., 4] = 1
    >>> leaning = sensor.move_rows(column, shifts=torch.tensor([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]]))
    >>> leaning.argmax(-1).flatten().tolist()
    [4, 5, 6]
    """
    batch, _, height, width = signal.shape
    shifts = shifts.to(signal).expand(batch, -1, -1) if shifts.ndim == 3 else shifts.to(signal)[None]
    rows = torch.arange(height, device=signal.device, dtype=signal.dtype)
    index, weights = _taps(rows - shifts[..., 1])  # (B or 1, H) -> (B or 1, 8, H)
    found: Any = 0.0
    planes, first = _reaching(signal, index, border, dim=-2)
    for tap in range(_TAPS):
        at = (index[:, tap] - first).clamp(0, planes.shape[-2] - 1)[:, None, :, None]
        taken = planes.gather(-2, at.expand(*signal.shape))
        found = found + weights[:, tap, :][:, None, :, None] * taken
    index, weights = _taps(-shifts[..., 0])
    columns = torch.arange(width, device=signal.device)
    planes, first = _reaching(found, index + columns[-1:], border, dim=-1, least=index)
    moved: Any = 0.0
    for tap in range(_TAPS):
        at = (index[:, tap, :, None] + columns - first).clamp(0, planes.shape[-1] - 1)[:, None]
        moved = moved + weights[:, tap, :, None][:, None] * planes.gather(-1, at.expand(*signal.shape))
    return moved


def _taps(places: Tensor) -> tuple[Tensor, Tensor]:
    """Which eight pixels, and with what weights, make the value at each place: (..., N) to (..., 8, N)."""
    before = places.detach().floor()
    steps = torch.arange(1 - _TAPS // 2, 1 + _TAPS // 2, device=places.device, dtype=places.dtype)[:, None]
    share = (places - before)[..., None, :] - steps
    weights = [
        math.prod(share[..., other, :] / (other - tap) for other in range(_TAPS) if other != tap) * (-1) ** (_TAPS - 1)
        for tap in range(_TAPS)
    ]
    return (before[..., None, :] + steps).long(), torch.stack(weights, dim=-2)


def _reaching(
    planes: Tensor, index: Tensor, border: str, *, dim: int, least: Tensor | None = None
) -> tuple[Tensor, int]:
    """Planes with as much of their border as the indices reach, and the place of their first pixel."""
    n = planes.shape[dim]
    low = int((index if least is None else least).min()) if index.numel() else 0
    high = int(index.max()) + 1 if index.numel() else n
    most = int(LONGEST) + _BEYOND  # nothing moves farther
    low, high = max(low, -most), min(high, n + most)
    return part(planes, min(low, 0), max(high, n), border, dim=dim), min(low, 0)


@in_float32
def warp(signal: Tensor, *, shifts: Tensor, border: str = "reflect") -> Tensor:
    """The picture as it is when the content at each pixel has moved so far: result(x) = S(x - shifts(x)).

    By cubic convolution of 4 x 4 pixels. Args: signal (B,C,H,W); shifts (B or 1,2,H,W), x and y [pixels].

    Source:    Keys, Cubic convolution interpolation for digital image processing, IEEE Trans. ASSP 29, 1153 (1981).

    Example:
    >>> sensor.warp(torch.arange(5.0).view(1, 1, 1, 5), shifts=torch.full((1, 2, 1, 5), 0.5))[0, 0, 0, 2:4].tolist()
    [1.5, 2.5]
    """
    batch, channels, height, width = signal.shape
    x, y = shifts.to(signal).unbind(1)
    x = torch.arange(width, device=signal.device, dtype=signal.dtype) - x
    y = torch.arange(height, device=signal.device, dtype=signal.dtype)[:, None] - y
    left, top = (place.detach().floor().clamp(-LONGEST, LONGEST + size) for place, size in ((x, width), (y, height)))
    ends = [(int(one.min()) - 1, int(one.max()) + 3) for one in (top, left)]
    (up, down), (before, after) = ((min(a, 0), max(b, n)) for (a, b), n in zip(ends, (height, width), strict=True))
    planes = part(part(signal, up, down, border, dim=-2), before, after, border, dim=-1)
    across, along = _cubic(x - left), _cubic(y - top)
    flat, result = planes.flatten(-2), signal.new_zeros(())
    for row in range(4):
        for column in range(4):
            at = ((top.long() + row - 1 - up) * planes.shape[-1] + left.long() + column - 1 - before)[:, None].flatten(
                -2
            )
            taken = flat.gather(-1, at.expand(batch, channels, -1)).unflatten(-1, (height, width))
            result = result + (along[row] * across[column])[:, None] * taken
    return result


def _cubic(share: Tensor) -> list[Tensor]:
    """Keys' weights of the pixels at -1, 0, 1, 2 for a place so far from 0 to 1."""
    t, square, cube = share, share.square(), share**3
    return [
        (-cube + 2 * square - t) / 2,
        (3 * cube - 5 * square + 2) / 2,
        (-3 * cube + 4 * square + t) / 2,
        (cube - square) / 2,
    ]


class Motion(Stage):
    """Motion while the shutter is open: (B,C,H,W) to the same shape, behind the colour filter and before the mosaic.

    One of:
        velocity: of all content, (2,) or (B,2), x and y on the sensor [pixels per second]. Exact.
        path: (N,2) or (B,N,2) places [pixels], at equal times from the start to the end of the exposure, with the
            readout; straight between: `tremor` makes one. Exact with a global shutter.
        flow: a velocity for each pixel, (2,H,W) or (B,2,H,W) [pixels per second]. What a moving thing uncovers shows
            the content before it, at its own velocity.
        translation: of the camera, x and y [m/s]; the nearer, the faster: content moves by -translation d / (depth
            pitch). In layers of depth, of which near ones hide those behind, each half a pixel of motion from the next.

    Args:      time: exposure time [s]; None for that of ``Exposure(time=...)``. In a camera the two must agree.
               readout: from the start of the first row to that of one after the last [s]: 0 for a global shutter.
               start: how long all has moved when the first row's exposure begins [s], such as of a later picture.
               border: what moves in from beyond the picture: reflect, replicate, periodic or zero.
               samples: moments that are averaged where that is needed (a flow; a path with a rolling shutter); None: as
               many as the motion asks for, `STEP` apart.
    Raises:    ValueError for none or several of the first four, shapes or values that are none, a time <= 0, a negative
               readout; at the call for a flow of another size than the picture, no exposure time, or no depth.
    Valid for light that the pixels sample without aliasing. What is sharper rings, to negative light: by half a pixel
    of motion a step from 0 to 1 goes down to -0.10, a single pixel of 1 to -0.15; a star behind an f/3 lens on pixels
    of 1.4 um to -3 % of its peak. A flow of one velocity is off by 1 % of the picture's second derivative, in pixels,
    at most.

    Example:
    >>> wall = torch.zeros(1, 3, 8, 64)
    >>> wall[..., 32:] = 1  # an edge that moves 8 pixels to the right, while it is seen
    >>> row = sensor.Motion(velocity=(80.0, 0.0), time=0.1)(wall)[0, 0, 4]
    >>> [round(float(row[32 + pixel]), 1) for pixel in (-4, 0, 4, 12)]  # a ramp from 32 to 40
    [0.0, 0.1, 0.6, 1.0]
    """

    velocity: Any
    path: Any
    flow: Any
    translation: Any
    time: Any
    readout: Any
    start: Any

    def __init__(
        self,
        velocity: Any = None,
        *,
        path: Any = None,
        flow: Tensor | None = None,
        translation: Any = None,
        time: Tensor | float | None = None,
        readout: Tensor | float = 0.0,
        start: Tensor | float = 0.0,
        border: str = "reflect",
        samples: int | None = None,
    ):
        super().__init__()
        ways = {"velocity": velocity, "path": path, "flow": flow, "translation": translation}
        given = [name for name, value in ways.items() if value is not None]
        if len(given) != 1:
            raise ValueError(
                f"Motion takes one of velocity, path, flow and translation, got {', '.join(given) or 'none'}. Use "
                "Motion(velocity=(100.0, 0.0), time=0.01): 1 pixel to the right."
            )
        for name, shapes in (("velocity", "(2,) or (B, 2)"), ("path", "(N, 2) or (B, N, 2)"), ("translation", "(2,)")):
            if ways[name] is not None:
                ways[name] = _as_places(ways[name], name=name, shapes=shapes)
        if flow is not None:
            if (
                not isinstance(flow, Tensor)
                or flow.ndim not in (3, 4)
                or flow.shape[-3] != 2
                or not flow.is_floating_point()
            ):
                got = tuple(flow.shape) if isinstance(flow, Tensor) else type(flow).__name__
                raise ValueError(f"flow must be a tensor (2, H, W) or (B, 2, H, W) [pixels per second], got {got}.")
            _check_finite(flow, name="flow")
        if time is not None:
            check_positive(time, name="time", unit="s")
        check_not_negative(readout, name="readout", unit="s")
        check_not_negative(start, name="start", unit="s")
        for name, value in (("time", time), ("readout", readout), ("start", start)):
            if isinstance(value, Tensor) and value.ndim:
                raise ValueError(f"{name} must be one number of seconds, got shape {tuple(value.shape)}.")
        if path is not None and _some(start):
            raise ValueError("a path begins where the exposure does: leave out start=, or put it into the path.")
        if border not in BORDERS:
            raise ValueError(f"unknown border {border!r}; known: {', '.join(BORDERS)}.")
        if samples is not None and (isinstance(samples, bool) or not isinstance(samples, int) or samples < 1):
            raise ValueError(f"samples must be a whole number of moments >= 1, such as 16, got {samples!r}.")
        hold(self, **ways, time=time, readout=readout, start=start)
        self.border, self.samples = border, samples

    def forward(self, signal: Tensor, context: Context | None = None) -> Tensor:
        """(B,C,H,W) of full planes to the same shape.

        Raises:    see the class; ValueError for a motion of more than 4096 pixels.
        """
        check_signal(signal)
        context = context or Context()
        time = self._time(context)
        if not signal.numel():
            return signal
        if signal.dtype in (torch.float16, torch.bfloat16):  # which have no places to a hundredth of a pixel
            return self(signal.float(), context).to(signal.dtype)
        if self.flow is not None:
            return self._flowing(signal, self.flow.to(signal), time)
        if self.translation is not None:
            return self._in_layers(signal, context, time)
        path = self._line(self.velocity, time) if self.path is None else self.path
        if path.ndim == 3 and len(path) not in (1, len(signal)):
            raise ValueError(
                f"there are {len(path)} motions for {len(signal)} pictures: expected one for each, or one for all."
            )
        return self._together(signal, path, time, border=self.border)

    # ---- ways ----

    def _line(self, velocity: Tensor, time: Any) -> Tensor:
        """The path at a velocity, (..., 2, 2), over the exposure and the readout."""
        ends = (velocity * self.start, velocity * (self.start + time + self.readout))
        return torch.stack(ends, dim=-2)

    def _together(self, signal: Tensor, path: Tensor, time: Any, *, border: str) -> Tensor:
        """All pixels move alike, at once or row by row."""
        path = path.to(signal.device)
        _check_reach(path)
        if not _some(self.readout):
            return path_blur(signal, path=path, border=border)
        starts = (
            torch.arange(signal.shape[-2], dtype=torch.float64, device=signal.device) / signal.shape[-2] * self.readout
        )
        whole = time + self.readout
        if path.shape[-2] == 2:  # at one velocity every row sees the same blur, from another place on
            own = _at(path, torch.as_tensor(time / whole)[None])[..., 0, :]
            blurred = path_blur(signal, path=torch.stack([path[..., 0, :], own], dim=-2), border=border)
            return move_rows(blurred, shifts=_at(path, starts / whole) - path[..., :1, :], border=border)
        count = self._moments(time)
        moments = (torch.arange(count, dtype=torch.float64, device=signal.device) + 0.5) / count * time
        total: Any = 0.0
        for moment in moments:
            total = total + move_rows(signal, shifts=_at(path, (starts + moment) / whole), border=border)
        return total / count

    def _flowing(self, signal: Tensor, flow: Tensor, time: Any) -> Tensor:
        flow = flow if flow.ndim == 4 else flow[None]
        if flow.shape[-2:] != signal.shape[-2:] or len(flow) not in (1, len(signal)):
            raise ValueError(
                f"flow is {tuple(flow.shape)} for a picture {tuple(signal.shape)}: expected a velocity for each pixel, "
                f"(2, {signal.shape[-2]}, {signal.shape[-1]})."
            )
        height = signal.shape[-2]
        starts = torch.arange(height, dtype=torch.float64, device=signal.device) / height * self.readout
        _check_reach(flow.detach() * _value(self.start + time + self.readout))
        count = self._moments(time)
        total: Any = 0.0
        for index in range(count):
            moments = self.start + starts + (index + 0.5) / count * time
            total = total + warp(signal, shifts=flow * torch.as_tensor(moments).to(signal)[:, None], border=self.border)
        return total / count

    def _in_layers(self, signal: Tensor, context: Context, time: Any) -> Tensor:
        if context.depth is None or context.lens is None or context.lens.sensor_distance is None:
            raise ValueError(
                "Motion(translation=) needs the depth of a Scene and a lens with its sensor_distance: use it in "
                "Camera(optics.Imaging(lens), ..., Motion(...)), or a velocity."
            )
        distance: Any = like(context.lens.sensor_distance, signal)
        per_vergence = -self.translation.to(signal) * distance / context.pixel_pitch
        vergence = 1 / torch.as_tensor(context.depth).to(signal)
        if vergence.ndim == 1:
            vergence = vergence.view(-1, 1, 1, 1)
        vergence = vergence.expand(len(signal), 1, *signal.shape[-2:])
        low, high = (float(end) for end in vergence.detach().aminmax())
        apart = float(per_vergence.detach().norm()) * (high - low) * _value(self.start + time + self.readout)
        count = min(1 + math.ceil(apart / STEP), MOST_SAMPLES)
        label = ((vergence - low) / max(high - low, 1e-30) * count).long().clamp(max=count - 1)
        taps = signal.new_tensor([1, 4, 6, 4, 1]) / 16  # a jump between layers would ring
        soft = (taps[:, None] * taps)[None, None]
        light: Any = 0.0
        covered: Any = 0.0
        for index in range(count):  # from far to near
            here = (label == index).to(signal)
            if not bool(here.any()):
                continue
            node = (vergence * here).sum() / here.sum()
            here = F.conv2d(F.pad(here, (2, 2, 2, 2), mode="replicate"), soft)
            path = self._line(per_vergence * node, time)
            own = self._together(signal * here, path, time, border=self.border)
            around = "replicate" if self.border == "zero" else self.border  # darkness covers too
            cover = self._together(here, path, time, border=around).clamp(0, 1)
            light, covered = own + (1 - cover) * light, cover + (1 - cover) * covered
        return light / covered.clamp(min=1e-3) if count > 1 else light

    # ---- how closely ----

    @property
    def whole_picture(self) -> bool:
        """Whether the motion depends on the place in the picture, or brings content from far away."""
        if self.flow is not None or self.translation is not None or _some(self.readout):
            return True
        if self.path is not None:
            return float(self.path.detach().abs().max()) > _NEAR
        seconds = math.inf if self.time is None else _value(self.start) + _value(self.time)
        return float(self.velocity.detach().abs().max()) * seconds > _NEAR

    @property
    def only_whole(self) -> bool:
        """Whether it is for pictures of one size, or for as many as it has motions."""
        return self.flow is not None or self.each_sample

    @property
    def each_sample(self) -> bool:
        """Whether each picture of a batch has its own motion."""
        ways = ((self.velocity, 1), (self.path, 2), (self.flow, 3))
        return any(way is not None and way.ndim > plain and len(way) > 1 for way, plain in ways)

    def _moments(self, time: Any) -> int:
        """How many are averaged, of a flow or along a path: the longest way in an exposure goes by `STEP`."""
        if self.flow is not None:
            pixels = self.flow.detach().norm(dim=-3).max() * _value(time)
        else:
            way = self.path.detach().diff(dim=-2).norm(dim=-1).sum(-1).max()
            pixels = way * _value(time / (time + self.readout))
        asked = min(max(1, math.ceil(float(pixels) / STEP)), MOST_SAMPLES)
        return asked if self.samples is None else min(self.samples, asked)

    def provides(self) -> dict[str, Any]:
        """The exposure time, where it was given: one that an Exposure contradicts is an error."""
        return {} if self.time is None else {"exposure_time": self.time}

    def _time(self, context: Context) -> Any:
        time = context.exposure_time if self.time is None else self.time
        if time is not None and not 0 < _value(time) < math.inf:
            raise ValueError(f"the exposure time became {_value(time):g} s in training: expected > 0, such as 0.01.")
        if time is None:
            raise ValueError("Motion knows no exposure time: give time= [s], or the camera an Exposure(time=...).")
        return time

    @property
    def _sampled(self) -> bool:
        """Whether moments are averaged."""
        return self.flow is not None or (self.path is not None and self.path.shape[-2] > 2 and _some(self.readout))

    def changed(self, **arguments: Any) -> Motion:
        """The same motion with other arguments; it shares all else."""
        names = ("velocity", "path", "flow", "translation", "time", "readout", "start", "border", "samples")
        return Motion(**{name: getattr(self, name) for name in names} | arguments)

    def cheaper(self, signal: Tensor, context: Context) -> list[tuple[str, dict[str, Any], float]]:
        """Fewer moments, where moments are averaged: (name, arguments of `changed`, relative RMS change)."""
        if not self._sampled or not signal.numel():
            return []
        whole, counts = self(signal, context), [1]
        asked = self.samples or MOST_SAMPLES
        while counts[-1] * 2 < asked and len(counts) < 8:
            counts.append(counts[-1] * 2)
        found = []
        for count in counts:
            error = relative_rms(self.changed(samples=count)(signal, context), whole)
            if error == 0:  # no more are needed
                break
            found.append((f"{count} sample{'s' * (count > 1)}", {"samples": count}, error))
        return found

    def error_if_skipped(self, signal: Tensor, context: Context) -> float:
        """What the signal changes when nothing moves, relative to its RMS; see `kcam.effects.Skippable`."""
        with torch.no_grad():
            return relative_rms(signal, self(signal, context))

    def cost(self, signal: Tensor, context: Context) -> float:
        """Passes over the signal: transforms, of all rows at once, or sums over neighbours at each moment; measured."""
        if self._sampled:
            return (300.0 if self.flow is not None else 130.0) * self._moments(self._time(context))
        return 300.0 if self.translation is None else 1000.0

    def reason(self, signal: Tensor, context: Context) -> str:
        """What a picture of one moment would cost."""
        return f"1 sample would cost {self.error_if_skipped(signal, context):.2g}"


def _as_places(given: Any, *, name: str, shapes: str) -> Tensor:
    value = given if isinstance(given, Tensor) else as_numbers(given, name=name, expected=f"{shapes}, x and y").float()
    ndims = {"velocity": (1, 2), "path": (2, 3), "translation": (1,)}[name]
    if value.ndim not in ndims or value.shape[-1] != 2 or (name == "path" and value.shape[-2] < 2):
        raise ValueError(f"{name} must be {shapes}, x and y, got shape {tuple(value.shape)}.")
    _check_finite(value, name=name)
    return value


def _check_finite(value: Tensor, *, name: str) -> None:
    if not value.detach().isfinite().all():
        raise ValueError(f"{name} has values that are NaN or infinite: expected finite numbers, such as (100.0, 0.0).")


def _check_reach(places: Tensor) -> None:
    check_trained(places, name="velocity, path or flow of the Motion")
    most = float(places.detach().abs().max()) if places.numel() else 0.0
    if not most <= LONGEST:
        raise ValueError(
            f"the motion goes over {most:.3g} pixels, more than {LONGEST:.0f}: is the velocity in pixels per second, "
            "and the time in seconds?"
        )


def _value(number: Any) -> float:
    return float(torch.as_tensor(number).detach())


def _some(value: Any) -> bool:
    """Whether a number may be other than 0: one that trains may."""
    return isinstance(value, Tensor) or value != 0


def _at(path: Tensor, shares: Tensor) -> Tensor:
    """Places (..., H, 2) of a path at shares (H,) of its time."""
    position = (torch.as_tensor(shares) * (path.shape[-2] - 1)).to(path)
    before = position.detach().floor().clamp(0, path.shape[-2] - 2)
    start, stop = (path.index_select(-2, (before + step).long()) for step in (0, 1))
    return start + (position - before)[:, None] * (stop - start)
