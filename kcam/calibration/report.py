"""The report of a calibrated sensor: photon transfer, signal to noise, linearity, and the standard's spatial plots."""

from __future__ import annotations

import math
import os
import textwrap
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from kcam import plots
from kcam.calibration.results import MONO, UNITS, ChannelCalibration, SensorCalibration, Spatial
from kcam.plots import INK, LABEL, MUTED, SMALL, TITLE, Sheet
from kcam.report import write_report

COLOURS = {"R": "#c8553d", "G": "#2a9d5f", "B": "#3f6fd8", "W": MUTED, MONO: INK}
_EDGE, _HEAD, _WIDTH, _HEIGHT, _GAP = 0.75, 0.95, 4.9, 3.3, 0.95  # inches


def _panel(sheet: Sheet, column: int, row: int, title: str, *, x: str, y: str) -> Any:
    left, top = _EDGE + column * (_WIDTH + _GAP), _HEAD + row * (_HEIGHT + _GAP)
    axes = sheet.axes(left, top, _WIDTH, _HEIGHT)
    axes.set_title(title, size=LABEL, weight="bold", loc="left", color=INK)
    axes.set_xlabel(x)
    axes.set_ylabel(y, size=SMALL, color=MUTED)
    plots.quiet(axes)
    return axes


def _sheet(title: str, rows: int, caption: str) -> Sheet:
    sheet = Sheet(2 * _EDGE + 2 * _WIDTH + _GAP - 0.4, _HEAD + rows * (_HEIGHT + _GAP) - 0.3)
    sheet.text(_EDGE, 0.18, title, size=TITLE, weight="bold")
    sheet.text(_EDGE, 0.48, caption, size=SMALL, colour=MUTED)
    return sheet


def _key(axes: Any, **where: Any) -> None:
    axes.legend(frameon=False, fontsize=SMALL, labelcolor=INK, **where)


def transfer_figure(found: SensorCalibration) -> Figure:
    """The photon transfer curve, the signal to noise ratio, and what the means and the darks do over time.

    Full marks were fitted, open ones lie outside the linear range.

    Args:      found: the calibration.

    Example:
    >>> from kcam.calibration.report import transfer_figure
    >>> electrons = [torch.full((2, 64, 64), n) for n in (0.0, 500.0, 1000.0, 2000.0)]
    >>> frames = [(64 + 0.5 * torch.poisson(n) + torch.randn(n.shape)).round() for n in electrons]
    >>> len(transfer_figure(kcam.calibration.photon_transfer(frames[1:], frames[:1], bits=12)).axes)
    4
    """
    sheet = _sheet("Photon transfer", 2, "full marks: fitted; open: outside the linear range; squares: darks")
    transfer = _panel(sheet, 0, 0, "Temporal variance over the mean", x="mean above black [DN]", y="variance [DN²]")
    ratio = _panel(sheet, 1, 0, "Signal to noise ratio", x="signal [electrons]", y="")
    line = _panel(sheet, 0, 1, "Deviation from a line over the exposure time", x="exposure time [s]", y="%")
    darks = _panel(sheet, 1, 1, "Dark signal over the exposure time", x="exposure time [s]", y="mean [DN]")
    for name, channel in found.channels.items():
        colour = COLOURS.get(name, INK)
        _draw_transfer(transfer, channel, name, colour)
        _draw_ratio(ratio, channel, name, colour)
        _draw_line(line, channel, colour)
        timed = sorted((level.time, level.mean) for level in channel.darks if level.time is not None)
        if timed:
            darks.plot(*zip(*timed, strict=True), color=colour, marker="s", ms=4, lw=1.2)
    transfer.set(xscale="log", yscale="log")
    ratio.set(xscale="log", yscale="log")
    for axes in (transfer, ratio):
        _key(axes, loc="upper left")
    for axes, reason in ((line, "linearity_error"), (darks, "dark_current")):
        if not axes.lines:
            told = next(iter(found.channels.values())).quantities()[reason].reason
            place = {"transform": axes.transAxes, "ha": "center", "va": "center", "size": SMALL, "color": MUTED}
            axes.text(0.5, 0.5, "\n".join(textwrap.wrap(told or "unknown", 52)), **place)
            axes.set(xticks=[], yticks=[])
    return sheet.figure


def _draw_transfer(axes: Any, channel: ChannelCalibration, name: str, colour: str) -> None:
    gain, black = channel.gain.value or 0.0, channel.black_level
    label = f"{name}: {channel.gain}"
    for linear in (True, False):
        shown = [(f.mean - black, f.variance) for f in channel.flats if f.linear == linear and f.mean > black]
        if shown:
            axes.plot(
                *zip(*shown, strict=True), ls="", marker="o", ms=4.5, mec=colour, mfc=colour if linear else "white"
            )
    below = [(level.mean - black, level.variance) for level in channel.darks if level.mean - black > 0]
    if below:
        axes.plot(*zip(*below, strict=True), ls="", marker="s", ms=4.5, mec=colour, mfc=colour)
    top = max(level.mean for level in channel.flats) - black
    signal = np.geomspace(min(min((x for x, _ in below), default=top), 1e-3 * top), top, 200)
    axes.plot(signal, channel.dark_variance + 1 / 12 + gain * signal, color=colour, lw=1.2, label=label)
    if channel.saturation is not None:
        axes.axvline(channel.saturation - black, color=colour, lw=0.8, ls=(0, (3, 2)), alpha=0.6)


def _draw_ratio(axes: Any, channel: ChannelCalibration, name: str, colour: str) -> None:
    """As measured, as the model has it with the fixed pattern (whole line) and without (dashed)."""
    gain, black = channel.gain.value or 1.0, channel.black_level
    full = black + 0.95 * ((channel.saturation or math.inf) - black)
    shown = [(f.mean - black, f.variance) for f in channel.flats if black < f.mean < full and f.variance > 0]
    electrons = np.array([mean / gain for mean, _ in shown])
    axes.plot(electrons, [m / math.sqrt(v) for m, v in shown], ls="", marker="o", ms=4.5, mec=colour, mfc="white")
    signal = np.geomspace(max(electrons.min() / 30, 1.0), channel.full_well.value or electrons.max(), 100)
    temporal = (channel.dark_variance + 1 / 12) / gain**2 + signal
    spatial = (channel.dsnu.value or 0.0) ** 2 + ((channel.prnu.value or 0.0) * signal) ** 2
    axes.plot(signal, signal / np.sqrt(temporal), color=colour, lw=1.2, ls=(0, (3, 2)), label=f"{name}: temporal noise")
    axes.plot(signal, signal / np.sqrt(temporal + spatial), color=colour, lw=1.4, label=f"{name}: with fixed pattern")


def _draw_line(axes: Any, channel: ChannelCalibration, colour: str) -> None:
    shown = [(level.time, 100 * level.deviation) for level in channel.flats if level.deviation is not None]
    if not shown:
        return
    axes.plot(*zip(*sorted(shown), strict=True), color=colour, marker="o", ms=4, lw=1.0)
    axes.axhline(0, color=MUTED, lw=0.8)


def spatial_figure(pattern: Spatial, *, title: str, unit: str, scale: float = 1.0) -> Figure:
    """The standard's plots of a fixed pattern: map, profiles, spectrograms, and a logarithmic histogram.

    Args:      pattern: of one channel.  unit: of what is shown.  scale: from the map's numbers to that unit.

    Example:
    >>> import numpy as np
    >>> from kcam.calibration import Spatial
    >>> from kcam.calibration.report import spatial_figure
    >>> white = Spatial(np.random.default_rng(0).normal(size=(64, 64)), 0.0, 0.0, 1.0)
    >>> len(spatial_figure(white, title="PRNU", unit="%").axes)
    4
    """
    image = pattern.map * scale
    parts = (f"{part} {scale * getattr(pattern, part):.3g}" for part in ("column", "row", "pixel"))
    sheet = _sheet(title, 2, f"standard deviation over columns, rows and pixels: {', '.join(parts)} {unit}")
    axes = _panel(sheet, 0, 0, "Map, ±3 standard deviations", x="column", y="row")
    spread = max(float(image.std()), 1e-12)
    axes.imshow(image, cmap="gray", vmin=-3 * spread, vmax=3 * spread, interpolation="nearest", aspect="auto")
    axes.grid(visible=False)
    axes = _panel(sheet, 1, 0, "Profiles: mean of all columns and of all rows", x="share of the frame", y=unit)
    for axis, name, colour in ((0, "horizontal", COLOURS["B"]), (1, "vertical", COLOURS["R"])):
        profile = image.mean(axis)
        axes.plot(np.linspace(0, 1, len(profile)), profile, color=colour, lw=1.0, label=name)
    _key(axes, loc="upper right", ncols=2)
    axes = _panel(sheet, 0, 1, "Spectrograms", x="cycles per pixel", y=f"spectrum [{unit}]")
    for axis, name, colour in ((1, "horizontal", COLOURS["B"]), (0, "vertical", COLOURS["R"])):
        count = image.shape[axis]
        power = (np.abs(np.fft.rfft(image, axis=axis)) ** 2).mean(1 - axis) / count
        axes.plot(
            np.arange(1, len(power)) / count, np.sqrt(np.maximum(power[1:], 1e-24)), color=colour, lw=1.0, label=name
        )
    low, high = axes.get_ylim()
    axes.set(yscale="log", xlim=(0, 0.5), ylim=(min(low, high / 30), 1.5 * high))
    _key(axes, loc="upper right", ncols=2)
    axes = _panel(sheet, 1, 1, "Histogram, and the normal one of the same spread", x=unit, y="pixels")
    counts, edges = np.histogram(image, bins=_bins(image))
    middles, step = (edges[:-1] + edges[1:]) / 2, edges[1] - edges[0]
    normal = image.size * step / (spread * math.sqrt(2 * math.pi)) * np.exp(-0.5 * (middles / spread) ** 2)
    axes.stairs(counts, edges, color=INK, lw=1.0, label="pixels")
    axes.plot(middles, normal, color=COLOURS["R"], lw=1.2, ls=(0, (3, 2)), label="normal")
    axes.set(yscale="log", ylim=(0.5, 2 * max(counts.max(), 1)))
    _key(axes, loc="upper right")
    return sheet.figure


def _bins(image: np.ndarray) -> np.ndarray:
    """Edges of a histogram, whole steps of the rounded values apart, so that none is empty between others."""
    low, high = float(image.min()), float(image.max())
    width = max(high - low, 1e-12) / min(128, max(16, int(math.sqrt(image.size))))
    steps = np.diff(np.unique(np.round((image - low) / max(high - low, 1e-12), 9))) * (high - low)
    if 0 < len(steps) < 1000:
        width = math.ceil(width / steps.min()) * float(steps.min())
    return low - width / 2 + width * np.arange(math.ceil((high - low) / width) + 2)


def save_report(found: SensorCalibration, path: str | os.PathLike[str]) -> None:
    """Write the report of a calibration: one HTML file that holds its figures.

    Args:      found: as `photon_transfer` gives it: of one that was saved, the maps are gone.  path: ends in .html.
    Raises:    ValueError as `plots.check_writable`.

    Example:
    >>> from pathlib import Path
    >>> from kcam import calibration
    >>> electrons = [torch.full((2, 64, 64), n) for n in (0.0, 500.0, 1000.0, 2000.0)]
    >>> frames = [(64 + 0.5 * torch.poisson(n) + torch.randn(n.shape)).round() for n in electrons]
    >>> calibration.save_report(calibration.photon_transfer(frames[1:], frames[:1], bits=12), "sensor.html")
    """
    summary = [("converter", f"{found.bits} bits"), ("black level", f"{found.black_level:.1f} DN")]
    figures = [("Photon transfer, signal to noise, linearity", transfer_figure(found))]
    reasons = []
    for name, channel in found.channels.items():
        for title, quantity in channel.quantities().items():
            words = title.replace("_", " ")
            summary.append((f"{name} {words}", "unknown" if quantity.value is None else str(quantity)))
            if quantity.reason:
                reasons.append(f"{name}, {words}: {quantity.reason}.")
        if channel.dark_pattern is not None and channel.gain.value:
            scale = 1 / channel.gain.value
            dark = spatial_figure(channel.dark_pattern, title=f"DSNU, {name}", unit="electrons", scale=scale)
            figures.append((f"Dark signal nonuniformity, {name}", dark))
        if channel.light_pattern is not None:
            light = spatial_figure(channel.light_pattern, title=f"PRNU, {name}", unit="%", scale=100)
            figures.append((f"Photo response nonuniformity, {name}", light))
    notes = [
        "Gain, noises and nonuniformities as in EMVA Standard 1288, release 4.0 Linear; a value is followed by its "
        "standard error. The fixed pattern is that of all dark frames, and of all frames of light within the linear "
        "range; uneven light up to the 4th order was taken off the latter. Its maps keep what temporal noise is left.",
        f"Units: {', '.join(f'{name} [{unit}]' for name, unit in UNITS.items())}.",
    ]
    write_report(
        path, title="Sensor calibration", summary=summary, figures=figures, advice=found.notes, notes=reasons + notes
    )
