"""All that is measured of a camera, as one value, and the page that shows it."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from kcam import files, optics, plots
from kcam.analysis.camera import (
    LIGHTS,
    ColourError,
    DynamicRange,
    NotMeasured,
    SignalToNoise,
    colour_error,
    distortion,
    dynamic_range,
    edge_response,
    half_diagonal,
    imaging_of,
    noise_power,
    shading,
    signal_to_noise,
)
from kcam.analysis.edge import EdgeResponse
from kcam.analysis.noise import NoisePower
from kcam.camera import Camera
from kcam.report import write_report
from kcam.srgb import to_code
from kcam.units import mm

SHARES = (0.0, 0.5, 0.8)
"""Of the half diagonal: where MTF50 is measured."""
STEPS = 9
"""Quantities of a report."""
LINE_COLOURS = ("#1c1c22", "#c8553d", "#2a9d8f", "#3f6fd8")


@dataclass(frozen=True)
class Report:
    """What was measured of a camera; None where it was not, and then `missing` says why.

    optics, picture: by place, (radius [m], direction) -> the contrast of lens and pixels, and of the whole camera.
    shading, distortion: radii [m] and shares, see the functions of these names.  psf: the figure of the lens's PSFs.

    Example:
    >>> found = kcam.analysis.report(Camera.ideal())
    >>> found.missing["dynamic range"]
    'no noise and no ADC: nothing limits the dynamic range.'
    """

    name: str
    optics: dict[tuple[float, str], EdgeResponse] | None = None
    picture: dict[tuple[float, str], EdgeResponse] | None = None
    signal_to_noise: SignalToNoise | None = None
    dynamic_range: DynamicRange | None = None
    colour: list[ColourError] | None = None
    shading: tuple[Tensor, Tensor] | None = None
    distortion: tuple[Tensor, Tensor] | None = None
    noise_power: NoisePower | None = None
    psf: Figure | None = None
    missing: dict[str, str] = field(default_factory=dict)

    def table(self) -> list[tuple[str, str, str]]:
        """Heads, and a row for each number: quantity, value with its unit, method with its standard."""
        rows = [("Quantity", "Value", "Method")]
        for what, found in (("optics and pixel", self.optics), ("finished picture", self.picture)):
            for (radius, way), response in (found or {}).items():
                where = "on the axis" if radius == 0 else f"{radius / mm:.3g} mm off the axis"
                value = f"{response.mtf50:.3f} cycles/pixel" if math.isfinite(response.mtf50) else "above 1 cycle/pixel"
                if response.pixel_pitch is not None and math.isfinite(response.mtf50):
                    value += f", {response.mtf50_per_metre * mm:.0f} line pairs/mm"
                rows.append((f"MTF50, {what}, {where}, {way}", value, "slanted edge of 5\u00b0, ISO 12233 e-SFR"))
        if self.signal_to_noise is not None:
            best, method = float(self.signal_to_noise.snr[-1]), "temporal, of pairs of even pictures, EMVA 1288"
            value = f"{20 * math.log10(best):.1f} dB ({best:.0f})" if math.isfinite(best) else "no noise"
            rows.append((f"SNR at {float(self.signal_to_noise.exposures[-1]):.0%} of saturation", value, method))
        if self.dynamic_range is not None:
            known = self.dynamic_range
            rows.append(
                (
                    "Dynamic range",
                    f"{known.decibels:.1f} dB, {known.stops:.1f} stops",
                    f"{known.saturation:.0f} over {known.dark_noise:.2f} electrons in the dark, EMVA 1288",
                )
            )
        for one in self.colour or ():
            value = f"{one.mean:.2f} in the mean, {one.largest:.2f} at most"
            rows.append((f"\u0394E under {one.light}", value, "24 patches, adapted by Bradford, CIEDE2000"))
        if self.distortion is not None:
            value = f"{float(self.distortion[1][-1]):+.2%} at {float(self.distortion[0][-1]) / mm:.3g} mm"
            rows.append(("Distortion", value, "chief rays, against a small field, ISO 17850"))
        if self.shading is not None:
            value = f"{float(self.shading[1].mean(0)[-1]):.0%} of the axis at {float(self.shading[0][-1]) / mm:.3g} mm"
            rows.append(("Shading", value, "even scene, mean of the channels, ISO 17957"))
        if self.noise_power is not None:
            value = f"{math.sqrt(self.noise_power.variance):.2e} of white, RMS"
            rows.append(("Noise at 18 % grey", value, "of linear luminance, IEC 62220-1"))
        return rows + [(what[0].upper() + what[1:], "not measured", why) for what, why in self.missing.items()]

    def figures(self) -> list[tuple[str, Figure]]:
        """(what it shows in words, the figure), of what was measured."""
        shown = []
        if self.optics:
            curves = [(f"optics, {_place(key)}", one, "-") for key, one in self.optics.items()]
            curves += [(f"picture, {_place(key)}", one, "--") for key, one in (self.picture or {}).items()]
            axes, figure = _axes("frequency [cycles/pixel]", "contrast")
            for index, (label, one, style) in enumerate(curves):
                hue = LINE_COLOURS[index % len(self.optics) % len(LINE_COLOURS)]
                axes.plot(one.frequencies, one.mtf, style, color=hue, lw=1.5, label=label)
            axes.axhline(0.5, color=plots.MUTED, lw=0.8, ls=":")
            axes.axvline(0.5, color=plots.MUTED, lw=0.8, ls=":")
            axes.set(xlim=(0, 0.8), ylim=(0, 1.25))
            axes.legend(frameon=False, fontsize=plots.SMALL - 1)
            shown.append(
                ("MTF: contrast over frequency; the dots mark half the contrast and the pixels' limit", figure)
            )
        if self.signal_to_noise is not None and bool(self.signal_to_noise.snr.isfinite().all()):
            axes, figure = _axes("electrons", "SNR")
            axes.loglog(self.signal_to_noise.electrons, self.signal_to_noise.snr, "o-", color=plots.INK, ms=3.5)
            grid = self.signal_to_noise.electrons.clamp(min=1e-3)
            axes.loglog(grid, grid.sqrt(), color=LINE_COLOURS[1], lw=1, ls="--", label="shot noise alone")
            axes.legend(frameon=False, fontsize=plots.SMALL)
            shown.append(("SNR over exposure, beside the root of the electrons", figure))
        if self.colour:
            shown.append(("The chart: outside as it should be, inside as the camera has it", _chart(self.colour)))
        for title, pair, unit in (
            ("Shading: light over the field, of the axis", self.shading, "share"),
            ("Distortion over the field", self.distortion, "share"),
        ):
            if pair is not None:
                axes, figure = _axes("from the axis [mm]", unit)
                many = np.atleast_2d(pair[1].numpy())
                for index, row in enumerate(many):
                    colour: Any = plots.INK if len(many) != 3 else plots.CHANNEL_COLOURS[index]
                    axes.plot(pair[0] / mm, row, "o-", color=colour, ms=3.5)
                shown.append((title, figure))
        if self.noise_power is not None:
            axes, figure = _axes("frequency, share of the pixels' limit", "power, of white noise's")
            known = self.noise_power
            limit = float(known.fx.abs().max())
            white = known.variance / (4 * limit**2)
            axes.plot(known.frequencies / limit, known.radial / white, color=plots.INK, lw=1.5)
            axes.set_ylim(bottom=0)
            shown.append(("Noise power over frequency; 1 is noise without correlation", figure))
        return shown + (
            [("Point spread functions, or spots over the field of a traced lens", self.psf)]
            if self.psf is not None
            else []
        )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the page: one HTML file that holds all it shows. Raises: ValueError as `kcam.report.write_report`."""
        write_report(
            path,
            title=f"What the camera {self.name} is worth",
            summary=(),
            table=self.table(),
            figures=self.figures(),
            notes=["Measured by photographing charts with the camera's own stages. Resolution is without noise."],
        )

    def to_json(self, path: str | os.PathLike[str] | None = None) -> str:
        """All numbers as JSON, also written to `path` if given; what is infinite is null."""
        text = json.dumps(_plain(self), indent=1)
        if path is not None:
            files.replace(path, text.encode())
        return text


def report(
    camera: Camera,
    *,
    name: str = "camera",
    size: tuple[int, int] | None = None,
    seed: int = 0,
    advance: Callable[[str], Any] = lambda what: None,
) -> Report:
    """Measure all that can be of a camera; what cannot is stated with its reason.

    Args:      size: of the sensor, height and width [pixels], for what varies over the field; None: as far as the lens
               reaches.  seed: of the noise.  advance: called after each of `STEPS` quantities.
    Returns:   a `Report`: ``report(camera).save("report.html")``.
    Raises:    TypeError for no Camera.

    Example:
    >>> found = kcam.analysis.report(Camera.phone())
    >>> found.save("report.html")
    >>> round(found.dynamic_range.decibels), sorted(found.missing)
    (67, ['distortion', 'shading'])
    """
    if not isinstance(camera, Camera):
        raise TypeError(f"a report is of a Camera, got {type(camera).__name__}. Use Camera(*stages).")
    missing: dict[str, str] = {}

    def tried(what: str, measure: Callable[[], Any]) -> Any:
        try:
            return measure()
        except (ValueError, TypeError, RuntimeError, NotImplementedError) as reason:
            missing[what] = str(reason).splitlines()[0]
            return None
        finally:
            advance(what)

    def edges(whole: bool) -> dict[tuple[float, str], EdgeResponse]:
        imaging, places = imaging_of(camera), [(0.0, "horizontally")]
        if imaging is not None and imaging.varies:
            reach = half_diagonal(camera, size)
            ways = ("radially",) if whole else ("radially", "tangentially")
            places += [(share * reach, way) for share in SHARES[1:] for way in ways]
        found = {}
        for radius, way in places:
            try:
                found[radius, way] = edge_response(
                    camera, place=(radius, 0.0), horizontal=way == "tangentially", whole=whole
                )
            except ValueError as reason:
                if radius == 0:
                    raise
                kind = "finished picture" if whole else "optics and pixel"
                missing[f"MTF50, {kind}, {radius / mm:.3g} mm off the axis, {way}"] = str(reason)
        return found

    def psf() -> Figure:
        imaging = imaging_of(camera)
        if imaging is None:
            raise NotMeasured("this camera has no lens: no optics.Imaging among its stages.")
        if not isinstance(imaging.lens, optics.CompoundLens):
            return plots.psf_figure(imaging)
        lens = imaging.lens
        height = 0.8 * lens.field_limit(distance=lens.focus_distance, least=0.4)
        heights = torch.linspace(0, height, 6, dtype=torch.float64)
        curves = lens.field_curves(heights, distance=lens.focus_distance, frequencies=[10 / mm, 30 / mm])
        return plots.lens_figure(lens, curves, distance=lens.focus_distance, title="The lens over its field")

    with torch.no_grad():
        return Report(
            name,
            optics=tried("MTF50 of optics and pixel", lambda: edges(False)),
            picture=tried("MTF50 of the finished picture", lambda: edges(True)),
            signal_to_noise=tried("SNR", lambda: signal_to_noise(camera, seed=seed)),
            dynamic_range=tried("dynamic range", lambda: dynamic_range(camera, seed=seed)),
            colour=tried("\u0394E", lambda: colour_error(camera, LIGHTS)),
            shading=tried("shading", lambda: shading(camera, size=size)),
            distortion=tried("distortion", lambda: distortion(camera, size=size)),
            noise_power=tried("noise power", lambda: noise_power(camera, seed=seed)),
            psf=tried("PSFs", psf),
            missing=missing,
        )


def _place(key: tuple[float, str]) -> str:
    return "axis" if key[0] == 0 else f"{key[0] / mm:.3g} mm, {key[1]}"


def _axes(x: str, y: str) -> tuple[Any, Figure]:
    sheet = plots.Sheet(5.6, 3.6)
    axes = sheet.axes(0.75, 0.2, 4.6, 2.75)
    axes.set(xlabel=x, ylabel=y)
    plots.quiet(axes)
    return axes, sheet.figure


def _chart(colour: list[ColourError]) -> Figure:
    """Charts of 4 x 6 patches, two beside each other."""
    rows = math.ceil(len(colour) / 2)
    sheet = plots.Sheet(5.6, 0.15 + rows * 2.1)
    for index, one in enumerate(colour):
        wanted, got = (to_code(values.clamp(0, 1)).view(4, 6, 3).numpy() for values in (one.wanted, one.got))
        picture = np.kron(wanted, np.ones((20, 20, 1)))
        inside = np.kron(np.ones((4, 6)), np.pad(np.ones((10, 10)), 5))[..., None] > 0
        picture = np.where(inside, np.kron(got, np.ones((20, 20, 1))), picture)
        left, top = 0.15 + index % 2 * 2.7, 0.4 + index // 2 * 2.1
        sheet.text(left, top - 0.25, f"{one.light}: \u0394E {one.mean:.1f}, at most {one.largest:.1f}")
        sheet.picture(picture, left, top, 2.55, 1.7, smooth=False)
    return sheet.figure


def _plain(value: Any) -> Any:
    if isinstance(value, Tensor):
        return _plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {_place(key) if isinstance(key, tuple) else key: _plain(one) for key, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(one) for one in value]
    if isinstance(value, Figure):
        return None
    if hasattr(value, "__dataclass_fields__"):
        found = {name: _plain(getattr(value, name)) for name in value.__dataclass_fields__ if name != "power"}
        extra = {n: _plain(getattr(value, n)) for n in ("mtf50", "decibels", "stops", "mean") if hasattr(value, n)}
        return found | extra
    return value
