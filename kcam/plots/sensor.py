"""What a sensor's calibration shows: photon transfer, SNR, linearity, and what is fixed over the frame."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from kcam.plots.sheet import INK, LABEL, MUTED, SMALL, TITLE, Sheet, quiet

if TYPE_CHECKING:
    from kcam.calibration import SensorCalibration

CHANNEL_COLOURS = {"R": "#c8553d", "G": "#2a9d5f", "B": "#3f6fd8", "W": MUTED, "mono": INK}
EDGE, HEAD, WIDTH, HEIGHT, GAP = 0.85, 0.75, 4.6, 3.3, 1.1


def transfer_figure(found: SensorCalibration) -> Figure:
    """The photon transfer curve, and the SNR over the signal with its ideal, channel by channel.

    Points that the line was fitted to are filled, those beyond 70 % of saturation are open; of the SNR none are shown
    beyond saturation, where nothing is left of the noise.

    Example:
    >>> from kcam.calibration import Curve, Measured, SensorCalibration
    >>> line = {"gain": Measured(0.5, 0.01, "DN / electron"), "read_noise": Measured(4.0, 0.1, "electrons")}
    >>> curve = Curve((100.0, 1000.0), (54.0, 504.0), (1.0, 100.0), (True, True), (), 4.0)
    >>> len(plots.transfer_figure(SensorCalibration({"mono": line}, 12, 64.0, None, {"mono": curve})).axes)
    2
    """
    sheet = Sheet(EDGE + 2 * WIDTH + GAP + 0.3, HEAD + HEIGHT + 0.75)
    left = _titled(sheet, 0, "Photon transfer", "temporal variance over signal;  line: the fit")
    right = _titled(sheet, 1, "Signal to noise", "of one pixel in one frame;  dashed: photons alone")
    for name, curve in found.curves.items():
        colour, gain = CHANNEL_COLOURS.get(name, INK), found.channels[name]["gain"].value or 1.0
        signal, variance, fitted = map(np.asarray, (curve.signal, curve.variance, curve.fitted))
        for axes, values in ((left, variance), (right, signal / np.sqrt(np.maximum(variance, 1e-12)))):
            others = ~fitted if axes is left else ~fitted & (np.arange(len(variance)) <= variance.argmax())
            axes.plot(signal[fitted], values[fitted], "o", color=colour, ms=4, label=name)
            axes.plot(signal[others], values[others], "o", color=colour, ms=4, mfc="none")
        line = np.geomspace(max(signal[signal > 0].min(initial=1.0) / 2, 0.1), signal.max(), 100)
        left.plot(line, curve.dark_variance + gain * line, color=colour, lw=1)
        right.plot(line, line / np.sqrt(curve.dark_variance + gain * line), color=colour, lw=1)
        right.plot(line, np.sqrt(line / gain), color=colour, lw=0.8, ls=(0, (3, 2)))
    for axes, label in ((left, "DN\u00b2"), (right, "signal / noise")):
        axes.set(xscale="log", yscale="log", xlabel="signal above black [DN]", ylabel=label)
        quiet(axes)
        if len(found.curves) > 1:
            axes.legend(frameon=False, fontsize=SMALL)
    return sheet.figure


def linearity_figure(found: SensorCalibration) -> Figure | None:
    """Signal over exposure time, and how far each is off the line, channel by channel; None where no times are known.

    Example:
    >>> from kcam.calibration import Curve, Measured, SensorCalibration
    >>> line = {"gain": Measured(0.5, 0.01, "DN / electron")}
    >>> curve = Curve((100.0, 201.0), (54.0, 104.0), (1.0, 2.0), (True, True), (0.01, 0.02), 4.0)
    >>> len(plots.linearity_figure(SensorCalibration({"mono": line}, 12, 64.0, None, {"mono": curve})).axes)
    2
    """
    if not all(curve.exposure_times for curve in found.curves.values()):
        return None
    sheet = Sheet(EDGE + 2 * WIDTH + GAP + 0.3, HEAD + HEIGHT + 0.75)
    left = _titled(sheet, 0, "Linearity", "signal over exposure time")
    right = _titled(sheet, 1, "Deviation", "from the line of least relative deviations")
    for name, curve in found.curves.items():
        colour, use = CHANNEL_COLOURS.get(name, INK), np.asarray(curve.fitted)
        times, signal = np.asarray(curve.exposure_times), np.asarray(curve.signal)
        left.plot(times, signal, "o", color=colour, ms=4)
        if use.sum() < 2:
            continue
        weights = 1 / np.maximum(signal[use], 1e-9)
        slope, first = np.polyfit(times[use], signal[use], 1, w=weights)
        left.plot(times, first + slope * times, color=colour, lw=1)
        right.plot(times[use], 100 * (signal[use] / (first + slope * times[use]) - 1), "o-", color=colour, ms=4, lw=0.8)
    left.set(xlabel="exposure time [s]", ylabel="signal above black [DN]")
    right.set(xlabel="exposure time [s]", ylabel="deviation [%]")
    right.axhline(0, color=MUTED, lw=0.8)
    for axes in (left, right):
        quiet(axes)
    return sheet.figure


def uniformity_figure(pair: Sequence[np.ndarray], *, title: str) -> Figure:
    """What is fixed over a frame: the spectrum of rows and of columns, profiles, and the histogram of deviations.

    Of the mean of two frames (a, b) (H, W) [DN]: EMVA 1288 release 4.0, its spatial plots. Spectra are amplitudes along
    the rows and along the columns, in the mean over the others; a peak is a period, a high one alone is banding. The
    histogram stands on a log scale beside a normal one of the same spread: what lies outside of it are defects.

    Example:
    >>> import numpy as np
    >>> draw = np.random.default_rng(0)
    >>> len(plots.uniformity_figure([draw.normal(100, 3, (32, 32)) for _ in range(2)], title="Dark frames").axes)
    3
    """
    mean = np.mean([np.asarray(frame, dtype=np.float64) for frame in pair], axis=0)
    apart = mean - mean.mean()
    width = (2 * WIDTH + GAP - 2 * GAP) / 3
    sheet = Sheet(EDGE + 2 * WIDTH + GAP + 0.3, HEAD + HEIGHT + 0.75)
    sheet.text(EDGE, 0.12, title, size=TITLE - 2, weight="bold")
    places = [EDGE + index * (width + GAP) for index in range(3)]
    spectra, profiles, histogram = (sheet.axes(left, HEAD, width, HEIGHT) for left in places)
    for axis, name, colour in ((1, "along rows", "#3f6fd8"), (0, "along columns", "#c8553d")):
        count = mean.shape[axis]
        amplitude = np.sqrt(np.mean(np.abs(np.fft.rfft(apart, axis=axis)) ** 2 / count, axis=1 - axis))
        spectra.plot(np.fft.rfftfreq(count)[1:], amplitude[1:], color=colour, lw=0.9, label=name)
        line = mean.mean(axis=1 - axis)
        profiles.plot(np.linspace(0, 1, len(line)), line, color=colour, lw=0.9)
    spectra.set(xlabel="cycles per pixel", ylabel="amplitude [DN]", ylim=(0, None))
    spectra.legend(frameon=False, fontsize=SMALL)
    profiles.set(xlabel="place, of the frame's side", ylabel="mean of columns and rows [DN]")
    spread = float(apart.std()) or 1.0
    edges = np.linspace(min(apart.min(), -5 * spread), max(apart.max(), 5 * spread), 101)
    counts, _ = np.histogram(apart, edges)
    centres = (edges[1:] + edges[:-1]) / 2
    histogram.step(centres, np.maximum(counts, 0.5), where="mid", color=INK, lw=0.9)
    normal = apart.size * (edges[1] - edges[0]) * np.exp(-0.5 * (centres / spread) ** 2) / (spread * np.sqrt(2 * np.pi))
    histogram.plot(centres, np.maximum(normal, 0.5), color=MUTED, lw=0.9, ls=(0, (3, 2)))
    histogram.set(yscale="log", xlabel="deviation [DN]", ylabel="pixels", ylim=(0.5, None))
    for axes in (spectra, profiles, histogram):
        quiet(axes)
    return sheet.figure


def _titled(sheet: Sheet, column: int, title: str, caption: str) -> Any:
    left = EDGE + column * (WIDTH + GAP)
    sheet.text(left, 0.12, title, size=TITLE - 2, weight="bold")
    sheet.text(left, 0.44, caption, size=LABEL - 1, colour=MUTED)
    return sheet.axes(left, HEAD, WIDTH, HEIGHT)
