"""Motion as a stage of a camera: which of the ways, how closely, and at what cost."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

from kcam.context import Context, Stage
from kcam.effects import relative_rms
from kcam.inputs import check_signal
from kcam.optics.rendering.borders import BORDERS
from kcam.sensor.arguments import check_not_negative, hold, like
from kcam.sensor.motion.resampling import LONGEST, move_rows, path_blur, warp
from kcam.units import as_numbers, check_positive, check_trained

STEP = 0.5
"""Between two moments that are averaged, what moves most moves so far [pixels]: off by 1 % of S'' at most."""
MOST_SAMPLES = 512
_NEAR = 16.0  # pixels that content moves, up to which a crop of a picture tells about the whole


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
