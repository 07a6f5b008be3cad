"""What the README and the pages of the site show and nobody should type: tables, what code prints, and pictures.

    python docs/generate.py               writes the tables, and what the code blocks print
    python docs/generate.py --pictures    renders the pictures too: a quarter of an hour, most of it images/lenses.jpg
    python docs/generate.py --traps       runs the traps of tests/stability first: ten seconds
    python docs/generate.py --check       changes nothing; says what is out of step

A table stands between ``<!-- generated: name -->`` and ``<!-- end -->``; what a ```python block prints stands in the
```text block that follows it. `tests/test_pages.py` fails where a page and this script disagree.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import hashlib
import io
import json
import math
import os
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import numpy as np  # noqa: E402
import torch  # noqa: E402
from PIL import Image  # noqa: E402

import kcam.augmentation as KC  # noqa: E402
from benchmarks.common import save_jpeg  # noqa: E402
from kcam import Camera, Plan, Scene, demo, isp, optics, plots, sensor  # noqa: E402
from kcam.data import FORMATS  # noqa: E402
from kcam.optics.compound.presets import PRESETS  # noqa: E402
from kcam.optics.propagation.question import Query  # noqa: E402
from kcam.optics.propagation.table import choose  # noqa: E402
from kcam.tradeoff import Row, Sweep  # noqa: E402
from kcam.units import mm, nm, um  # noqa: E402

README = ROOT / "README.md"
IMAGES = ROOT / "docs" / "images"
RESULTS = ROOT / "benchmarks" / "results"


def pages() -> list[Path]:
    """The README and what is written by hand for the site."""
    folders = ("start", "do", "understand", "reference")
    return [README, ROOT / "docs" / "index.md", *(p for f in folders for p in sorted((ROOT / "docs" / f).glob("*.md")))]


def results_link(path: Path) -> str:
    """A link from a page of the site to a file of results."""
    return f"[`{path.name}`](../../{path.relative_to(ROOT)})"


# ---- the propagators -------------------------------------------------------------------------------------------------


def cases() -> dict[str, Query]:
    """What the table states errors for: a window of 297 x 297 pixels, light of 550 nm, an object at 2 m."""
    sphere = optics.PlanoConvexLens(25.8 * mm, glass="N-BK7")
    doe = optics.DOE(torch.zeros(891, 891))
    small, large = (optics.CircularAperture(width) for width in (5 * mm, 10 * mm))
    lenses = {
        "singlet f/10": (optics.Lens(small, sphere, focus_distance=2.0), 3 * um),
        "singlet f/5": (optics.Lens(large, sphere, focus_distance=2.0), 3 * um),
        "phone f/1.8": (Camera.phone()[0].lens, 1.4 * um),
        "f/10 and a DOE": (optics.Lens(small, sphere, doe, focus_distance=2.0), 3 * um),
    }
    return {
        name: lens.query([550 * nm], distances=2.0, pixel_pitch=pitch, shape=(297, 297))
        for name, (lens, pitch) in lenses.items()
    }


def propagators_table() -> str:
    """`optics.PROPAGATORS` as a table: errors and costs are what the rows themselves state."""
    queries = cases()
    default = {name: choose(query) for name, query in queries.items()}
    first = next(iter(queries.values()))
    cheapest = min(row.cost(first) for row in optics.PROPAGATORS.values() if row.exact)
    lines = [
        f"| `propagator=` | `method=` | {' | '.join(queries)} | cost |",
        "|---|---|" + "---:|" * (len(queries) + 1),
    ]
    shown = {""}
    for row in optics.PROPAGATORS.values():
        cells = []
        for name, query in queries.items():
            error = "refuses" if row.valid_for(query) is not None else scientific(row.error(query))
            cells.append(f"**{error}**" if default[name] is row else error)
        physics = "" if row.physics in shown else f"`{row.physics}`"
        method = f"`{row.method}`" + ("" if row.about in shown else f": {row.about}")
        shown |= {row.physics, row.about}
        lines.append(f"| {physics} | {method} | {' | '.join(cells)} | {row.cost(first) / cheapest:.0f} |")
    model = " | ".join(scientific(default[name].model_error(query)) for name, query in queries.items())
    lines.append(f"| *the reference itself, against Rayleigh-Sommerfeld* | | {model} | |")
    return "\n".join(lines)


def scientific(value: float) -> str:
    """Two figures, as 3e-05 is easier to read: 0.0031, 3.1e-5."""
    if value >= 1e-3 or value == 0:
        return f"{value:.2g}"
    mantissa, exponent = f"{value:.1e}".split("e")
    return f"{mantissa}e{int(exponent)}"


# ---- the traps -------------------------------------------------------------------------------------------------------

TRAPS = RESULTS / "traps.json"
PEERS = {"torchoptics": "TorchOptics", "prysm": "prysm", "hcipy": "hcipy"}
AT_PEERS = {
    "a piston": "k z = 1e7",
    "object at infinity": "point source at infinity",
    "pupil sampled too coarsely": "object at 5 cm",
    "PSF smaller than a pixel": "PSF under one pixel",
}
"""Our trap -> the hard case of peers.json that shows it."""


def measure_traps() -> None:
    """Run every trap of tests/stability/traps.py and write what came out."""
    sys.path[:0] = [str(ROOT / "tests"), str(ROOT / "tests" / "stability")]
    import traps

    rows = [dataclasses.asdict(row) for row in traps.rows()]
    for row in rows:
        row["naive"] = None if math.isnan(row["naive"]) else float(f"{row['naive']:.2g}")
        row["kcam"] = row["kcam"] if isinstance(row["kcam"], str) else float(f"{row['kcam']:.2g}")
    TRAPS.write_text(json.dumps({"torch": torch.__version__, "traps": rows}, indent=1) + "\n")


def traps_table() -> str:
    """Each trap as it is usually written and through kcam, in float32, and what other libraries do on the same case."""
    cases = json.loads((RESULTS / "peers.json").read_text())["hard_cases"]
    lines = [
        "| case | usually written as | measured | usual float32 | kcam float32 | others |",
        "|---|---|---|---:|---:|---|",
    ]
    for row in json.loads(TRAPS.read_text())["traps"]:
        naive = "**NaN**" if row["naive"] is None else scientific(row["naive"])
        ours = "a clear error" if isinstance(row["kcam"], str) else scientific(row["kcam"])
        usual = row["usual"].replace("|", "\\|")
        lines.append(
            f"| {row['case']} | `{usual}` | {row['measure']} | {naive} | {ours} | {at_peers(row['case'], cases)} |"
        )
    return "\n".join(lines)


def at_peers(trap: str, cases: list[dict[str, Any]]) -> str:
    """What TorchOptics, prysm and hcipy gave, in float32 where they have it; empty where the case was not run there."""
    found = []
    for library, name in PEERS.items():
        own = [c for c in cases if c["case"] == AT_PEERS.get(trap) and c["library"] == library]
        single = [c for c in own if c["dtype"] == "float32"] or own
        for case in single[:1]:
            if case["outcome"] == "finite":
                energy = f", energy {figures(case['energy'])}" if case["energy"] else ""
                found.append(f"{name} L1 {scientific(case['l1'])}{energy}")
            else:
                found.append(f"{name} {'**NaN**' if case['outcome'] == 'NaN' else 'an error'}")
    return "; ".join(found)


# ---- what accuracy costs ---------------------------------------------------------------------------------------------

SWEEPS = {"singlet": RESULTS / "tradeoff-singlet.json", "thesis": RESULTS / "tradeoff-thesis.json"}
TRADEOFF_ROWS = 10


def tradeoff_table() -> str:
    """Ten lines for each camera: the front of raw error and time, the camera as it is, the best baseline."""
    parts = []
    for path in SWEEPS.values():
        sweep = Sweep.load(path)
        front = sweep.pareto()
        textbook = [row for row in sweep.rows if row.baseline and row.raw_rms is not None]
        must = [sweep.default, *sorted(textbook, key=lambda row: row.raw_rms)[:1]]
        spread = front[:: max(1, math.ceil(len(front) / (TRADEOFF_ROWS - len(must))))]
        others = sorted((row for row in sweep.rows if row.raw_rms is not None), key=lambda row: row.raw_rms)
        chosen: list[Row] = []
        for row in [*must, *spread, *front, *others]:
            if len(chosen) < TRADEOFF_ROWS and row not in chosen and row.seconds is not None:
                chosen.append(row)
        lines = [
            f"**{sweep.title}**, {sweep.scene}. {sweep.sentence()}",
            "",
            "| setting | raw error | PSF error | delta E | time | memory |",
            "|---|---:|---:|---:|---:|---:|",
        ]
        for row in sorted(chosen, key=lambda row: row.seconds or 0):
            name = f"**{row.name}**" if row in front else row.name
            note = ", as it is" if row.default else ", baseline" if row.baseline else ""
            numbers = ["" if v is None else scientific(v) for v in (row.raw_rms, row.psf_l1)]
            colour = "" if row.delta_e is None else f"{row.delta_e:.2g}"
            time = f"{figures(row.seconds * 1e3)} ms" if row.seconds < 1 else f"{figures(row.seconds)} s"
            memory = "" if row.peak_memory is None else f"{figures(row.peak_memory / 1e6)} MB"
            lines.append(
                f"| {name}{note} | {' | '.join(numbers)} | {colour} | {'~' if row.share < 1 else ''}{time} | {memory} |"
            )
        parts.append("\n".join(lines))
    return "\n\n".join(parts)


def tradeoff_picture(path: Path) -> None:
    """The figure of a committed sweep: tradeoff-NAME.png."""
    source = SWEEPS[path.stem.removeprefix("tradeoff-")]
    save_plot(plots.tradeoff_figure(Sweep.load(source)), path, source=source)


def save_plot(figure: Any, path: Path, *, source: Path) -> None:
    """A figure as a PNG that carries the digest of the results it shows, so that a test can tell an old one."""
    figure.savefig(path, dpi=140, facecolor="white", metadata={"Source": digest(source)})


def digest(source: Path) -> str:
    """Name and SHA-256 of a file of results."""
    return f"{source.name} {hashlib.sha256(source.read_bytes()).hexdigest()}"


LIBRARY_COLOURS = {
    "kcam": "#3f6fd8",
    "textbook": "#75757f",
    "hcipy": "#2a9d5f",
    "prysm": "#c98a00",
    "torchoptics": "#c8553d",
}


def peers_picture(path: Path) -> None:
    """Error against time of one PSF, each library at several samplings, joined where only the sampling differs."""
    source = RESULTS / "peers.json"
    rows = json.loads(source.read_text())["accuracy"]
    sheet = plots.Sheet(9.0, 5.2)
    sheet.text(0.8, 0.2, "One PSF: error against time", size=plots.TITLE, weight="bold")
    sheet.text(0.8, 0.52, "297 x 297 pixels of 1 um, f/10, 0.5 waves of defocus, one thread", colour=plots.MUTED)
    axes = sheet.axes(0.8, 0.85, 6.6, 3.75)
    axes.set(xscale="log", yscale="log", xlabel="CPU seconds", ylabel="L1 error of the PSF")
    axes.grid(color=plots.FAINT, lw=0.7)
    axes.spines[["top", "right"]].set_visible(False)
    groups: dict[tuple[str, str, str], list[tuple[float, float]]] = {}
    for row in rows:
        kind = re.sub(r"[\d.]+( um| x \d+)?", "", row["who"]).strip(" ,")
        groups.setdefault((row["library"], kind, row["dtype"]), []).append((row["seconds"], row["error"]["l1"]))
    for (library, _, dtype), points in groups.items():
        colour = LIBRARY_COLOURS.get(library, plots.INK)
        x, y = zip(*sorted(points), strict=True)
        axes.plot(x, y, color=colour, lw=1, marker="o" if dtype == "float32" else "s", ms=5, mec="white", mew=0.5)
    for index, (library, colour) in enumerate(LIBRARY_COLOURS.items()):
        sheet.text(7.65, 1.1 + 0.28 * index, "\u25cf", colour=colour, size=plots.LABEL)
        sheet.text(7.85, 1.11 + 0.28 * index, {**PEERS, "kcam": "kcam"}.get(library, library), size=plots.LABEL)
    sheet.text(7.65, 2.7, "round: float32", size=plots.SMALL, colour=plots.MUTED)
    sheet.text(7.65, 2.92, "square: float64", size=plots.SMALL, colour=plots.MUTED)
    save_plot(sheet.figure, path, source=source)


# ---- pictures over the field -----------------------------------------------------------------------------------------

FIELD = RESULTS / "field.json"
GPU = RESULTS / "gpu.json"
FIELD_COLOURS = {"slr": "#3f6fd8", "phone_lens": "#c98a00"}


def field_table() -> str:
    """Pictures of both cameras by kcam and as others make them: time, memory, PSNR; one table for each camera."""
    content = json.loads(FIELD.read_text())
    rows = [row for row in content["rows"] if row["part"] in ("methods", "gradient", "pictures")]
    compared = {(row["camera"], row["megapixels"]) for row in rows if row["part"] == "methods"}
    lines = [
        "| camera, megapixels | | places | first | second | memory | PSNR, worst crop |",
        "|---|---|---:|---:|---:|---:|---:|",
    ]
    shown = set()
    for row in sorted(rows, key=lambda row: (row["camera"] != "slr", row["megapixels"])):
        if row["part"] == "pictures" and (row["camera"], row["megapixels"]) in compared:  # measured there again
            continue
        first = f"`{row['camera']}`, {figures(row['megapixels'])}"
        title, shown = ("" if first in shown else first), shown | {first}
        who = row["who"] + (", a star field" if row["scene"] == "stars" else "")
        times = [seconds_text(row[name]) if name in row else "" for name in ("first", "second")]
        memory = f"{figures(row['peak_memory'] / 1e6)} MB" if row.get("peak_memory") is not None else ""
        quality = f"{row['psnr']:.0f} dB" if "psnr" in row else ""
        quality += f", {row['psnr_worst']:.0f}" if "psnr_worst" in row else ""
        places = " x ".join(map(str, row.get("places", ())))
        lines.append(f"| {title} | {who} | {places} | {' | '.join(times)} | {memory} | {quality} |")
    environment = content["environment"]
    lines += [
        "",
        f"<sub>{results_link(FIELD)}: {environment['machine']}, {environment['threads']} thread, "
        f"torch {environment['versions']['torch']}, {environment['date'][:10]}; CPU seconds of one thread, once each. "
        "Memory is the peak beyond what was in use before.</sub>",
    ]
    return "\n".join(lines)


def seconds_text(seconds: float) -> str:
    """A time in a table."""
    return f"{figures(seconds * 1e3)} ms" if seconds < 1 else f"{figures(seconds)} s"


def field_picture(path: Path) -> None:
    """How the time of a picture grows with its pixels, and with the places whose PSFs are made."""
    rows = json.loads(FIELD.read_text())["rows"]
    sheet = plots.Sheet(9.6, 4.75)
    sheet.text(0.8, 0.2, "Pictures over the field: how their time grows", size=plots.TITLE, weight="bold")
    sheet.text(
        0.8, 0.52, "one thread; the whole sensor on so many pixels, or PSFs at so many places", colour=plots.MUTED
    )
    for column, (part, what) in enumerate((("pictures", "megapixels"), ("growth", "places"))):
        axes = sheet.axes(0.8 + 4.5 * column, 0.95, 3.6, 2.8)
        axes.set(xscale="log", yscale="log", xlabel=what, ylabel="CPU seconds")
        axes.grid(color=plots.FAINT, lw=0.7)
        axes.spines[["top", "right"]].set_visible(False)
        for camera, colour in FIELD_COLOURS.items():
            own = [row for row in rows if row["part"] == part and row["camera"] == camera]
            if not own:
                continue
            x = [row["megapixels"] if part == "pictures" else math.prod(row["places"]) for row in own]
            for which, style in (("first", "-"), ("second", "--")):
                y = [row[which] for row in own]
                axes.plot(*zip(*sorted(zip(x, y, strict=True)), strict=True), style, color=colour, marker="o", ms=5)
            if camera == "slr":  # what is linear has this slope
                start, end = max(zip(x, (row["first"] for row in own), strict=True)), min(x)
                axes.plot([end, start[0]], [start[1] * end / start[0], start[1]], ":", color=plots.MUTED, lw=1)
    for index, (camera, colour) in enumerate(FIELD_COLOURS.items()):
        sheet.text(0.8 + 1.5 * index, 4.4, "\u25cf", colour=colour, size=plots.LABEL)
        sheet.text(0.98 + 1.5 * index, 4.4, camera, size=plots.LABEL)
    sheet.text(3.9, 4.42, "solid: first picture; dashed: second; dotted: linear", size=plots.SMALL, colour=plots.MUTED)
    save_plot(sheet.figure, path, source=FIELD)


# ---- plans -----------------------------------------------------------------------------------------------------------

PLANS = RESULTS / "plans"
HONESTY, TRAINING = RESULTS / "planner.json", RESULTS / "planner_training.json"
EFFECTS_HONESTY, UNSEEN = RESULTS / "planner_effects.json", RESULTS / "planner_unseen.json"
FAMILIES = ("random", "hard", "adversarial", "assorted", "strange")


def plans_table() -> str:
    """What examples/plan_scenes.py printed of its plans, and what changes between bright and dim light."""
    plans = {path.stem: Plan.load(path) for path in sorted(PLANS.glob("*.json"))}
    parts = [f"{title}\n\n```text\n{plans[name]}\n```" for name, title in PLAN_TITLES.items()]
    effects = list(dict.fromkeys(row.effect for name in ("bright", "dim") for row in plans[name].decisions))
    chosen = [{row.effect: row.chosen for row in plans[name].decisions} for name in ("bright", "dim")]
    lines = ['| `tolerance="sensor"` | bright, 1200 cd/m² | dim, 10 cd/m² |', "|---|---|---|"]
    lines.append(f"| allowed error | {' | '.join(scientific(plans[name].allowed) for name in ('bright', 'dim'))} |")
    for effect in effects:
        if effect not in ("memory", "saturation"):
            lines.append(f"| {effect} | {' | '.join(choices.get(effect, '') for choices in chosen)} |")
    measured = [plans[name].measured for name in ("bright", "dim")]
    lines.append(f"| true error | {' | '.join(scientific(found['error']) for found in measured)} |")
    gains = [found["reference_seconds"] / found["seconds"] for found in measured]
    lines.append(f"| times as fast | {' | '.join(figures(gain) for gain in gains)} |")
    return "\n\n".join([*parts, "\n".join(lines)])


PLAN_TITLES = {
    "wall": "**A flat wall at 5 m**, the distance of focus:",
    "night": "**A street at night**, houses from 2.5 m and lamps far away, through the same camera:",
}


def promise_tolerance() -> str:
    """The README's sentence of what plans keep and gain."""
    content = json.loads(HONESTY.read_text())
    rows = [row for kind in FAMILIES for row in content[kind]["summary"]]
    inside, plans = (sum(row[name] for row in rows) for name in ("inside", "pairs"))
    counts = ", ".join(f"{content[kind]['summary'][0]['pairs']} {kind}" for kind in FAMILIES)
    gains = [figures(row["speed_up"]) for row in content["random"]["summary"]]
    low, high = (content["random"]["summary"][index]["tolerance"] for index in (-1, 0))
    others = json.loads(UNSEEN.read_text())
    unseen = sum(len(pair["tolerances"]) for kind in FAMILIES for pair in others[kind]["all"])
    outside = sum(others[kind]["outside"] for kind in FAMILIES)
    return (
        f"Of pairs of camera and scene, {counts}, at five tolerances from {high:g} to {low:g}, **{inside} of {plans}** "
        f"stayed inside; over the random ones a picture is {', '.join(gains)} times as fast in the median. Of pairs by "
        f"which no number in the code was chosen {unseen - outside} of {unseen} plans did."
    )


def plan_unseen() -> str:
    """Whether plans keep their word of pairs by which no number in the code was chosen."""
    content = json.loads(UNSEEN.read_text())
    found = {kind: content[kind] for kind in FAMILIES}
    counts = ", ".join(f"{one['pairs']} {kind}" for kind, one in found.items())
    rows = [row | {"pair": pair["pair"]} for one in found.values() for pair in one["all"] for row in pair["tolerances"]]
    outside = [row for row in rows if row["error"] > row["tolerance"]]
    too_low = sum(one["bounds_too_low"] for one in found.values())
    named = "; ".join(
        f"{row['pair']}: {scientific(row['error'])} at {row['tolerance']:g}"
        for row in sorted(outside, key=lambda row: row["error"] / row["tolerance"], reverse=True)
    )
    text = (
        f"All of these were looked at when the numbers in the code were chosen. Of pairs that were not ({counts}, "
        f"{results_link(UNSEEN)}), **{len(rows) - len(outside)} of {len(rows)}** plans are inside, and {too_low} of "
        "their bounds are below 0.8 of the truth."
    )
    return f"{text} Outside: {named}." if outside else text


def plan_effects() -> str:
    """Whether plans keep their word of cameras with effects of light and sensor, and how near they come."""
    content = json.loads(EFFECTS_HONESTY.read_text())
    found = {kind: content[kind] for kind in FAMILIES}
    counts = ", ".join(f"{one['pairs']} {kind}" for kind, one in found.items())
    outside, low = (sum(one[name] for one in found.values()) for name in ("outside", "bounds_too_low"))
    worst = max(one["worst"] for one in found.values())
    return (
        "With one to four of glass, glare, motion, micro-lens shading, crosstalk, defects, banding and a bent response "
        f"drawn into the camera ({counts} pairs, at the same five tolerances), plans outside: {outside}; the worst "
        f"came to {worst:.2f} of its tolerance, and bounds below 0.8 of the error: {low} "
        f"({results_link(EFFECTS_HONESTY)})."
    )


def promise_effects() -> str:
    """The README's sentence of what a wall needs and what a street."""
    wall, night = (Plan.load(PLANS / f"{name}.json") for name in ("wall", "night"))
    chosen = {row.effect: row.chosen for row in night.decisions}
    gains = [plan.measured["reference_seconds"] / plan.measured["seconds"] for plan in (wall, night)]
    return (
        f"At a tolerance of {wall.tolerance:g} a flat wall in focus needs no diffraction, and its raw takes "
        f"**{figures(gains[0])} times** less time, with an error of {scientific(wall.measured['error'])}; a street at "
        f"night needs {chosen['wavelengths']}, {chosen['depth']} and what hides what: {figures(gains[1])} times, with "
        f"{scientific(night.measured['error'])}."
    )


def honesty_table() -> str:
    """Random pairs of camera and scene: inside the tolerance or not, the estimate, and how much faster."""
    content = json.loads(HONESTY.read_text())
    lines = [
        "| tolerance | inside | largest error | estimate / truth | times as fast, quartiles | predicted / measured |",
        "|---:|---:|---:|---:|---:|---:|",
    ]
    pairs, hard, adversarial, assorted, strange = (content[kind] for kind in FAMILIES)
    for row in pairs["summary"]:
        low, high = row["speed_up_quartiles"]
        lines.append(
            f"| {row['tolerance']:g} | {_inside(row)} | {row['worst']:.2f} of it | "
            f"{figures(row['estimate_over_truth'])} | **{figures(row['speed_up'])}**, {figures(low)} to "
            f"{figures(high)} | {figures(row['predicted_over_measured'])} |"
        )
    rows = [row for kind in FAMILIES for row in content[kind]["summary"]]
    hundredth = pairs["summary"][2]
    low, plans = (sum(row[name] for row in rows) for name in ("bounds_too_low", "pairs"))
    outside = "; ".join(f"{f['pair']}: {scientific(f['error'])} at {f['tolerance']:g}" for f in content["failures"])
    lines += [
        "",
        f"{len(pairs['pairs'])} pairs, {pairs['drawn_again']} drawn again because their reference would have taken "
        f"over {content['longest_seconds']:g} s. Outside, of these and of all below: {outside or 'none'}. The bound "
        f"that a plan states is below 0.8 of the truth, where that is above 1e-6, in {low} of {plans} plans. Predicted "
        f"times are off by a factor of {figures(hundredth['mispredicted'])} in the median at 0.01, and of "
        f"{figures(hundredth['mispredicted_calibrated'])} by the rates of `kcam calibrate`.",
    ]
    for found, of in ((pairs, "pairs"), (hard, "hard pairs")):
        for row in found["first_pictures"]:
            lines += [
                "",
                f"One picture, planning included, of the {row['pairs']} {of} whose reference takes over 0.3 s, at "
                f"{row['tolerance']:g}: **{figures(row['speed_up'])} times** as fast in the median, "
                f"{figures(row['later_speed_up'])} times without planning, which takes "
                f"{row['planning_share']:.0%} of the reference's time; {figures(row['speed_up_least'])} times at "
                "worst, of those over 0.1 s.",
            ]
    for found, of in (
        (
            hard,
            "Hard pairs (lamps out of focus, batches to 16, saturation, depth edges in colour, hot pixels, wrapped "
            "radial profiles, up to 768 pixels)",
        ),
        (
            adversarial,
            "Adversarial pairs (such scenes, a third of them in light of a few nanometres, through wrapped and noisy "
            "maps of pixels and rings, real lenses over the field, and measured PSFs)",
        ),
        (
            assorted,
            "Assorted pairs (apertures of every shape up to f/1.9, rings and maps, 3 to 45 wavelengths from 380 to 950 "
            "nm, every border and option of `Imaging`, noise, lines and single pixels)",
        ),
        (
            strange,
            "Strange pairs (parts that know nothing of each other, as a reader with a generator of their own put them "
            "together: 16 to 160 pixels through blur of none of them or all, f/1.8 to f/40, pixels with gaps or that "
            "are points, bands with a texture of their own)",
        ),
    ):
        inside = ", ".join(f"{_inside(row)} at {row['tolerance']:g}" for row in found["summary"])
        lines += ["", f"{of}, each item of a batch by itself: inside are {inside}."]
    return "\n".join(lines)


def _inside(row: dict[str, Any]) -> str:
    text = f"{row['inside']} of {row['pairs']}"
    return text if row["inside"] == row["pairs"] else f"**{text}**"


def training_table() -> str:
    """The same DOE trained with a plan and without."""
    content = json.loads(TRAINING.read_text())
    lines = ["| 100 steps of Adam | time | loss, first to last |", "|---|---:|---:|"]
    for name, key in (("through the plan", "with_plan"), ("everything simulated", "without")):
        run = content[key]
        losses = f"{scientific(run['first_loss'])} to {scientific(run['final_loss'])}"
        lines.append(f"| {name} | {figures(run['seconds'])} s | {losses} |")
    lines += [
        "",
        "| after steps | raw error of the plan | gradient: cosine | norm | relative error |",
        "|---:|---:|---:|---:|---:|",
    ]
    for check in content["with_plan"]["checks"]:
        lines.append(
            f"| {check['step']} | {scientific(check['raw_error'])} | {check['gradient_cosine']:.4f} | "
            f"{check['gradient_norm_ratio']:.3f} | {scientific(check['gradient_error'])} |"
        )
    return "\n".join(lines)


def plans_picture(path: Path) -> None:
    """One scene at three tolerances: what examples/plan_scenes.py draws; its plans become the results."""
    sys.path.insert(0, str(ROOT / "examples"))
    import plan_scenes

    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        plan_scenes.main(["--out", folder])
        PLANS.mkdir(exist_ok=True)
        for source in sorted(Path(folder).glob("*.json")):
            shutil.copy(source, PLANS / source.name)
        for name, target in (("tolerances", path), ("scenes", path.with_name("plans-scenes.jpg"))):
            picture = Image.open(Path(folder) / f"{name}.png").convert("RGB")
            picture.thumbnail((2000, 2000), Image.Resampling.LANCZOS)
            picture.save(target, quality=88, optimize=True)


# ---- camera augmentations -----------------------------------------------------------------------------------------

AUGMENTED, SEGMENTED = RESULTS / "augmentation.json", RESULTS / "augmentation_training.json"


def augmentations() -> list[type]:
    """Every augmentation, from the scene to the picture."""
    order = ("optics", "geometry", "motion", "lens", "sensor", "isp", "camera")
    found = [
        value
        for value in vars(KC).values()
        if isinstance(value, type) and value.__name__.startswith("Random") and value.__module__.startswith("kcam.")
    ]
    return sorted(found, key=lambda cls: order.index(cls.__module__.split(".")[2]))


def augmentations_table() -> str:
    """One line each: the first sentence of its docstring, and what it draws by default."""
    lines = ["| `KC.` | what it does | draws, by default |", "|---|---|---|"]
    for augmentation in augmentations():
        sentence = " ".join((augmentation.__doc__ or "").split("\n\n")[0].split()).rstrip(".")
        draws = repr(augmentation()._param_generator)
        lines.append(f"| `{augmentation.__name__}` | {sentence} | {draws} |")
    return "\n".join(lines)


def augmentation_speed_table() -> str:
    """Ours beside Kornia's nearest and the straightforward way; what is faster than ours is bold."""
    content = json.loads(AUGMENTED.read_text())
    taken = {(line["augmentation"], line["channels"]): line for line in content["lines"]}
    sizes = {line["channels"]: line["size"].replace("^2", "²") for line in content["lines"]}
    head = " | ".join(f"{size}: ours | Kornia | plain | we add at p = 1, 0.5" for size in sizes.values())
    lines = [f"| ms | {head} |", "|---|" + "---:|---:|---:|---|" * len(sizes)]
    for name in dict.fromkeys(line["augmentation"] for line in content["lines"]):
        cells = [cell for channels in sizes for cell in speed_cells(taken.get((name, channels)))]
        lines.append(f"| `{name}` | {' | '.join(cells)} |")
    every = [found for line in content["lines"] for found in line["added"].values()]
    worst = max(line["difference"] for line in content["lines"] if line["difference"] is not None)
    relatives = dict.fromkeys(who for line in content["lines"] for who in line["relatives"])
    environment = content["environment"]
    lines += [
        "",
        f"<sub>{results_link(AUGMENTED)}: {environment['machine']}, {environment['threads']} "
        f"thread, torch {environment['versions']['torch']}, {environment['date'][:10]}; CPU milliseconds of a forward "
        f"pass at p = 1, medians of turns in one process. Bold is faster than ours. Kornia: the fastest of its nearest "
        f"({', '.join(f'`{who}`' for who in relatives)}). Plain: a loop over samples (noise: the whole batch at "
        f"once), on the same drawn numbers; it differs from ours by {scientific(worst)} at most where nothing random "
        "follows. Its camera was timed on one sample of eight.</sub>",
        "",
        "What we add above an identity augmentation of Kornia's with the same p, as a share of the maths (the effect "
        "alone on drawn numbers, with the way into linear light and back where it needs that), was to be below 1: met "
        f"in {sum(found['met'] for found in every)} of {len(every)} cases; in "
        f"{sum(found['met_without_light'] for found in every)} if the way into light and back is not counted as maths.",
    ]
    return "\n".join(lines)


def augmentation_aims_table() -> str:
    """How much longer than something near each may take, and does: what is missed is bold."""
    content = json.loads(AUGMENTED.read_text())
    lines = ["| pictures, p = 1 | beside | times as long | without AVX-512 | aim |", "|---|---|---:|---:|---:|"]
    for aim, plain in zip(content["aims"], content["aims_avx2"], strict=True):
        ratio, other = (figures(a["ratio"]) if a["met"] else f"**{figures(a['ratio'])}**" for a in (aim, plain))
        beside = "the bare powers of the way into light and back" if " " in aim["beside"] else f"`{aim['beside']}`"
        beside = "Kornia's mosaic and demosaic" if "raw" in aim["beside"] else beside
        lines.append(f"| `{aim['what']}` | {beside} | {ratio} | {other} | {aim['most']:g} |")
    cubes = [line for line in content["lines"] if line["channels"] > 3 and "0.5" in line["added"]]
    shares = [line["added"]["0.5"]["share_of_maths"] for line in cubes]
    run, pipeline = content["run"], content["pipeline"]
    ours, theirs = (1e3 * pipeline["seconds_per_batch"][who] for who in ("kcam", "Kornia"))
    steps = ", ".join(f"{figures(1e3 * own)} ({figures(1e3 * other)})" for own, other in (line["more"] for line in run))
    names = ", ".join(f"`{line['last']}`" for line in run)
    lines += [
        "",
        f"In a `CameraSequential` a picture goes into light once: {names} take {steps} ms one after the other, in "
        f"brackets Kornia's nearest in its own container. On cubes with p = 0.5 we add {max(0.0, min(shares)):.2f} to "
        f"{max(shares):.2f} of the maths; the aim was 1. Eight stages ("
        + ", ".join(f"`{name}`" for name in pipeline["stages"])
        + f") at p = {pipeline['p']:g} on {pipeline['size'].replace('^2', '²')} in {pipeline['workers']} workers: "
        f"{figures(ours)} ms a batch on the wall, Kornia's nearest eight {figures(theirs)}.",
    ]
    return "\n".join(lines)


def waits_table() -> str:
    """What a user waits for, from benchmarks/results/bench.json; what is missed is bold."""
    lines = ["| | seconds | beside | aim |", "|---|---:|---|---|"]
    for row in json.loads((RESULTS / "bench.json").read_text())["commands"]:
        seconds = figures(row["seconds"]) if row["met"] else f"**{figures(row['seconds'])}**"
        beside = f"`{row['beside']}` {figures(row['beside_seconds'])}" if "beside" in row else ""
        if "stages" in row:
            beside = ", ".join(f"{name} {value:.2f}" for name, value in row["stages"].items())
        lines.append(f"| {row['what']} | {seconds} | {beside} | {row['aim']} |")
    return "\n".join(lines)


def gpu_table() -> str:
    """Pictures, augmentations and styles on a GPU, from benchmarks/results/gpu.json; what gains little is bold."""
    content = json.loads(GPU.read_text())

    def ms(row: dict[str, Any], where: str) -> str:
        return "" if where not in row else ("~" if row[f"{where}_calls"] == 1 else "") + figures(1e3 * row[where])

    lines = [
        "| camera, picture | plan | error | GPU ms | CPU ms | GPU ms with gradient |",
        "|---|---|---:|---:|---:|---:|",
    ]
    for row in content["pictures"]["rows"]:
        height, width = row["pixels"]
        where = f"{row['camera']}, {height} x {width}" if row["plan"] == "reference" else ""
        times = " | ".join(ms(row, name) for name in ("gpu", "cpu", "gradient"))
        lines.append(f"| {where} | {row['plan']} | {row['error']:.1e} | {times} |")
    lines += ["", "| 64 pictures of 224 x 224 | GPU ms | CPU ms |", "|---|---:|---:|"]
    for row in content["augmentations"]["rows"]:
        gpu = f"**{ms(row, 'gpu')}**" if row["gpu"] > 0.5 * row["cpu"] else ms(row, "gpu")
        lines.append(f"| `{row['augmentation']}` | {gpu} | {ms(row, 'cpu')} |")
    lines += ["", "| styles | GPU ms |", "|---|---:|"]
    lines += [f"| {row['what']} | {ms(row, 'gpu')} |" for row in content["styles"]["rows"]]
    told = content["pictures"]["environment"]
    lines += [
        "",
        f"<sub>{results_link(GPU)}: {told['gpu']}, the CPU is one thread of the {told['machine'].split(', ')[1]} "
        f"beside it, torch {told['versions']['torch']}, {told['date'][:10]}; {told['clock']}, the median of five calls "
        "after a warm-up, after ~ of one. Errors: relative RMS of the raw picture, of the reference from the CPU's, of "
        "plans from the reference there.</sub>",
    ]
    return "\n".join(lines)


def speed_cells(line: dict[str, Any] | None) -> list[str]:
    """Ours, Kornia's, the plain way, and what we add, met or missed."""
    if line is None:
        return ["", "", "", ""]
    ours = line["seconds"]["kcam 1"]
    kornia = min((line["seconds"][who] for who in line["relatives"]), default=None)
    cells = [figures(1e3 * ours)]
    for other in (kornia, line["seconds"]["straightforward"]):
        text = "" if other is None else figures(1e3 * other)
        cells.append(f"**{text}**" if other is not None and other < ours else text)
    shares = [
        f"{max(0.0, found['share_of_maths']):.2f} met" if found["met"] else f"**{found['share_of_maths']:.2f} missed**"
        for found in line["added"].values()
    ]
    return [*cells, ", ".join(shares)]


def segmentation_table() -> str:
    """Intersection over union of the nets that were trained with each kind of augmentation: mean and spread."""
    content = json.loads(SEGMENTED.read_text())
    tests = list(content["regimes"][0]["iou"])
    lines = [f"| trained with | {' | '.join(tests)} |", "|---|" + "---:|" * len(tests)]
    best = {test: max(statistics.mean(row["iou"][test]) for row in content["regimes"]) for test in tests}
    for row in content["regimes"]:
        cells = []
        for test in tests:
            scores = row["iou"][test]
            mean = f"{statistics.mean(scores):.3f}"
            mean = f"**{mean}**" if statistics.mean(scores) == best[test] else mean
            cells.append(f"{mean} ± {statistics.pstdev(scores):.3f}")
        lines.append(f"| {row['augmentations']} | {' | '.join(cells)} |")
    seconds = sum(row["seconds"] for row in content["regimes"])
    lines += [
        "",
        f"<sub>{results_link(SEGMENTED)}: intersection over union, mean ± standard deviation "
        f"of {content['seeds']} seeds, {content['steps']} steps each, {content['test_pictures']} test pictures; "
        f"{figures(seconds)} CPU seconds in all.</sub>",
    ]
    return "\n".join(lines)


# ---- the benchmarks --------------------------------------------------------------------------------------------------


def benchmarks_table() -> str:
    """Every default of kcam against the baseline of its race, from benchmarks/results/*.json: losses are bold."""
    files = [path for path in sorted(RESULTS.glob("*.json")) if path not in (TRAPS, *SWEEPS.values())]
    parts = [benchmark_part(json.loads(path.read_text()), path) for path in files]
    return "\n\n".join(part for part in parts if part) or "*Not measured yet: `make bench` writes the results.*"


def benchmark_part(content: dict[str, Any], path: Path) -> str:
    """The table of one file of results; nothing for a file without rows."""
    rows = content.get("rows", [])
    if not rows or "baseline" not in rows[0]:  # of another kind
        return ""
    lines = [
        "| task | | textbook: time, error, memory | kcam: time, error, memory | faster | closer |",
        "|---|---|---:|---:|---:|---:|",
    ]
    shown = set()
    tasks = list(dict.fromkeys(row["op"] for row in rows))
    for row in sorted(rows, key=lambda row: tasks.index(row["op"])):
        if row["baseline"] or not row["default"]:
            continue
        base = next(other for other in rows if _race(other) == _race(row) and other["baseline"])
        task = "" if row["op"] in shown else f"{row['op']}<br><sub>{row['size']}</sub>"
        shown.add(row["op"])
        direction = "with gradient" if "backward" in row["direction"] else "forward"
        ratio, closer = figures(row["ratio"]), row["error_ratio"]
        lines.append(
            f"| {task} | `{row['who'].removeprefix('kcam ')}`, {direction} | {measured(base)} | {measured(row)} "
            f"| {f'**{ratio}**' if row['ratio'] < 1 else ratio} | {'' if closer is None else figures(closer)} |"
        )
    environment = content["environment"]
    lines += [
        "",
        f"<sub>{results_link(path)}: {environment['machine']}, {environment['threads']} thread, "
        f"torch {environment['versions']['torch']}, {environment['date'][:10]}; {environment['clock']}. A time after ~ "
        "was measured on a sample of the wavelengths and scaled up, and its memory is the sample's. Memory is the "
        "peak beyond what was in use before.</sub>",
    ]
    verdicts = content.get("targets", [])
    if verdicts:
        lines += ["", "Against the targets that we had set:", ""]
    for target in dict.fromkeys(verdict["target"] for verdict in verdicts):
        own = [verdict for verdict in verdicts if verdict["target"] == target]
        met, ratios = sum(verdict["met"] for verdict in own), [verdict["ratio"] for verdict in own]
        outcome = "met" if met == len(own) else "**missed**, met" if not met else "**missed in part**, met"
        lines.append(
            f"- {target}: {outcome} in {met} of {len(own)} races; {figures(min(ratios))} to "
            f"{figures(max(ratios))} times as fast."
        )
    return "\n".join(lines)


def _race(row: dict[str, Any]) -> tuple[str, str]:
    return row["op"], row["direction"]


def measured(row: dict[str, Any]) -> str:
    """Time, error and memory of a row in one cell."""
    seconds = row["seconds"]
    time = f"{figures(seconds * 1e3)} ms" if seconds < 1 else f"{figures(seconds)} s"
    kinds = ("l1_median", "relative_max", "loss")
    error = next((row["error"][kind] for kind in kinds if kind in row["error"]), None)
    memory = row.get("peak_memory")
    cells = [
        ("~" if row.get("share_timed", 1.0) < 1 else "") + time,
        "" if error is None else scientific(error),
        "" if memory is None else f"{figures(memory / 1e6)} MB",
    ]
    return ", ".join(cell for cell in cells if cell)


def figures(value: float) -> str:
    """Two figures, as one says them: 0.56, 4.4, 61, 180, 54 000."""
    if value >= 100:
        step = 10 ** (math.floor(math.log10(value)) - 1)
        return f"{round(value / step) * step:,}".replace(",", " ")
    return f"{value:.2g}" if value < 10 else f"{value:.0f}"


# ---- data sets and patches -------------------------------------------------------------------------------------------

PATCHES = RESULTS / "patches.json"


def formats_table() -> str:
    """`kcam.data.FORMATS`."""
    lines = ["| `--format` | what is read | cite |", "|---|---|---|"]
    lines += [f"| `{row.name}` | {row.what} | {row.facts.get('citation', '')} |" for row in FORMATS.values()]
    return "\n".join(lines)


def throughput_table() -> str:
    """Random patches per second from each store, and extraction against copying."""
    content = json.loads(PATCHES.read_text())
    rows = {(row["store"], row["state"]): row for row in content["reading"]}
    lines = [
        "| random patches per second | warm | kcam is faster by | cold | kcam is faster by |",
        "|---|---:|---:|---:|---:|",
    ]
    for store in dict.fromkeys(store for store, state in rows if state != "skipped"):
        cells = []
        for state in ("warm", "cold"):
            row = rows.get((store, state))
            cells += ["", ""] if row is None else [figures(row["patches_per_second"]), times(row["kcam_is_faster"])]
        lines.append(f"| {store} | {' | '.join(cells)} |")
    made, copied = content["extraction"]
    environment, shape = content["environment"], " x ".join(map(str, content["patch"]))
    share = made["MB_per_second"] / copied["MB_per_second"]
    lines += [
        "",
        f"Extraction with one worker wrote {figures(made['MB_per_second'])} MB of patches per second; copying the same "
        f"files, and syncing them as extraction does, {figures(copied['MB_per_second'])} MB/s: {share:.0%} of it.",
        "",
        f"<sub>{results_link(PATCHES)}: {content['patches']} patches of {shape}, "
        f"{environment['machine']}, one process, {environment['date'][:10]}; {environment['clock']}, medians of "
        f"{made['rounds']} to {rows['kcam store', 'warm']['rounds']} rounds by turns. Cold: dropped from the page "
        "cache, not from the disk's own.</sub>",
    ]
    return "\n".join(lines)


def times(value: float) -> str:
    """How many times faster; losses are bold."""
    return figures(value) if value >= 1 else f"**{figures(value)}**"


def contact_sheet(path: Path) -> None:
    """What `make demo-data` draws of its cubes."""
    tools = ROOT / "data_tools"
    with tempfile.TemporaryDirectory() as folder:
        for tool, *arguments in (
            ("demo_cubes.py", "--out", f"{folder}/cubes"),
            ("inspect_cubes.py", f"{folder}/cubes", "--out", f"{folder}/report"),
        ):
            command = [sys.executable, str(tools / tool), *arguments]
            subprocess.run(command, check=True, capture_output=True, env=os.environ | {"PYTHONPATH": str(ROOT)})
        picture = Image.open(f"{folder}/report/contact_sheet.png").convert("RGB")
        picture.save(path, quality=88, optimize=True)


# ---- styles ----------------------------------------------------------------------------------------------------------

STYLE_MEASURES = {
    "training_loss": "training loss",
    "patch_swd": "patch SWD",
    "oriented_texture": "oriented texture",
    "luminance_correlation": "luminance",
    "detail_correlation": "detail",
}


def style_rows(which: str) -> list[dict[str, Any]]:
    """The runs of "ours", of the "thesis"'s arrangement, on the "whole" painting, or of arms with several "seeds"."""
    rows = json.loads((RESULTS / "style.json").read_text())["rows"]
    if which == "seeds":
        again = {(row["style"], row["arm"]) for row in rows if row["seed"]}
        return [row for row in rows if (row["style"], row["arm"]) in again]

    def kind(row: dict[str, Any]) -> str:
        return next((kind for kind in ("thesis", "whole") if row["arm"].startswith(kind)), "ours")

    return [row for row in rows if kind(row) == which and not row["seed"]]


def style_table(which: str, **columns: str) -> str:
    """The measures of runs, behind what columns (a row's key: its title) say of them."""
    lines = [" | ".join((*columns.values(), *STYLE_MEASURES.values(), "wallpaper", "time"))]
    for row in style_rows(which):
        mean = row["mean"]
        told = (str(row[key]) for key in columns)
        gaps = (f"{100 * mean[key]:.0f} %" for key in list(STYLE_MEASURES)[:3])
        correlations = (f"{mean[key]:.2f}" for key in list(STYLE_MEASURES)[3:])
        lines.append(" | ".join((*told, *gaps, *correlations, f"{row['wallpaper']:.2f}", f"{row['seconds']:.0f} s")))
    head, *runs = (f"| {line} |" for line in lines)
    return "\n".join((head, "|---" * (len(columns) + len(STYLE_MEASURES) + 2) + "|", *runs))


SEEN = {
    "stroke_length": "stroke length",
    "along_across": "along / across",
    "pixel_noise": "pixel noise",
    "coherence": "coherence",
    "halo": "halo",
    "face": "face",
}


PAINTERS = {"stage": "network", "laid": "pieces as laid", "pieces": "pieces"}


def seen_table() -> str:
    """What the eye sees of shots, by what paints."""
    lines = ["| style | what paints | " + " | ".join(SEEN.values()) + " |", "|---" * (len(SEEN) + 2) + "|"]
    for row in json.loads((RESULTS / "style.json").read_text())["rows"]:
        if row["arm"] in PAINTERS and not row["seed"]:
            values = " | ".join(f"{row['seen'][key]:.2f}" for key in SEEN)
            lines.append(f"| {row['style']} | {PAINTERS[row['arm']]} | {values} |")
    return "\n".join(lines)


# ---- the reference ---------------------------------------------------------------------------------------------------


FRAUNHOFER = torch.tensor([486.13, 587.56, 656.27], dtype=torch.float64) * nm


def glasses_table() -> str:
    """`optics.GLASSES`: the index at the d line, the Abbe number, the range and where they are from."""
    lines = ["| glass | n_d | v_d | from, to [um] | source |", "|---|---:|---:|---|---|"]
    for name, glass in optics.GLASSES.items():
        low, high = glass.valid
        known = [low * um <= line <= high * um for line in FRAUNHOFER.tolist()]
        index = [optics.refractive_index(name, wavelengths=FRAUNHOFER[i : i + 1]).item() if k else None
                 for i, k in enumerate(known)]  # fmt: skip
        nd = "" if index[1] is None else f"{index[1]:.5f}"
        abbe = f"{(index[1] - 1) / (index[0] - index[2]):.1f}" if all(known) else ""
        lines.append(f"| `{name}` | {nd} | {abbe} | {low:g}, {high:g} | {glass.source} |")
    return "\n".join(lines)


def lenses_table() -> str:
    """`CompoundLens.preset`: what each is, and whose."""
    lines = ["| `CompoundLens.preset(...)` | f [mm] | f-number | field, Y / D | from |", "|---|---:|---:|---:|---|"]
    for name, prescription in sorted(PRESETS.items()):
        lens = optics.CompoundLens.preset(name)
        lines.append(
            f"| `{name}` | {float(lens.focal_length()) / mm:.3g} | {float(lens.f_number):.2g} | "
            f"{prescription.field:g} | {prescription.source} |"
        )
    return "\n".join(lines)


def mosaics_table() -> str:
    """`sensor.PATTERNS`."""
    lines = ["| `sensor.Mosaic(...)` | tile | rows |", "|---|---|---|"]
    for name, rows in sensor.PATTERNS.items():
        shown = " / ".join("".join("RGBW"[channel] for channel in row) for row in rows)
        lines.append(f'| `"{name}"` | {len(rows)} x {len(rows[0])} | `{shown}` |')
    return "\n".join(lines)


def demosaics_table() -> str:
    """`isp.DEMOSAICS`."""
    lines = ["| `isp.Demosaic(...)` | patterns | PSNR on RGGB [dB] | time | |", "|---|---|---:|---:|---|"]
    for name, row in isp.DEMOSAICS.items():
        patterns = "Bayer" if row.bayer_only else "all"
        lines.append(f'| `"{name}"` | {patterns} | {row.psnr:g} | {row.cost:g} | {row.note} |')
    return "\n".join(lines)


def command_line() -> str:
    """The help of every command."""
    import typer.testing

    from kcam import cli

    runner = typer.testing.CliRunner()
    root: Any = typer.main.get_command(cli.app)
    parts = []

    def tell(words: list[str], command: Any) -> None:
        shown = runner.invoke(cli.app, [*words, "--help"], env={"COLUMNS": "100", "TERM": "dumb"}, prog_name="kcam")
        text = "\n".join(line.rstrip() for line in shown.output.strip().splitlines())
        parts.append(f"## `{' '.join(['kcam', *words])}`\n\n```text\n{text}\n```")
        for name, sub in getattr(command, "commands", {}).items():
            tell([*words, name], sub)

    tell([], root)
    return "\n\n".join(parts)


TABLES: dict[str, Callable[[], str]] = {
    "style": lambda: style_table("ours", style="style", note="what trains"),
    "seeds": lambda: style_table("seeds", style="style", note="what trains", seed="seed"),
    "whole": lambda: style_table("whole", style="style"),
    "seen": seen_table,
    "thesis": lambda: style_table("thesis", note="arrangement", style="style"),
    "propagators": propagators_table,
    "tradeoff": tradeoff_table,
    "traps": traps_table,
    "plans": plans_table,
    "honesty": honesty_table,
    "promise_tolerance": promise_tolerance,
    "plan_effects": plan_effects,
    "plan_unseen": plan_unseen,
    "promise_effects": promise_effects,
    "training": training_table,
    "field": field_table,
    "benchmarks": benchmarks_table,
    "augmentations": augmentations_table,
    "augmentation_speed": augmentation_speed_table,
    "augmentation_aims": augmentation_aims_table,
    "waits": waits_table,
    "gpu": gpu_table,
    "segmentation": segmentation_table,
    "formats": formats_table,
    "glasses": glasses_table,
    "lenses": lenses_table,
    "mosaics": mosaics_table,
    "demosaics": demosaics_table,
    "commands": command_line,
    "throughput": throughput_table,
}

# ---- the pages -------------------------------------------------------------------------------------------------------

TABLE = re.compile(r"(<!-- generated: (\w+) -->\n)(?:(?!<!--).)*(<!-- end -->)", re.DOTALL)
CODE = re.compile(r"(```python\n(?P<code>.*?)```\n)(?:\n?```text\n(?P<output>.*?)```\n)?", re.DOTALL)


def with_tables(text: str) -> str:
    """A page with its tables made anew."""
    return TABLE.sub(lambda match: f"{match[1]}{TABLES[match[2]]()}\n{match[3]}", text)


@contextlib.contextmanager
def inside(folder: str | os.PathLike[str]) -> Iterator[None]:
    """Work in a folder for a while."""
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


def run_code(text: str, *, name: str = "README.md") -> Iterator[tuple[re.Match[str], str]]:
    """Run a page's code in order, in one namespace; gives each block and what it printed."""
    namespace: dict[str, Any] = {}
    for match in CODE.finditer(text):
        printed = io.StringIO()
        line = text.count("\n", 0, match.start("code"))
        code = compile("\n" * line + match["code"], name, "exec")  # errors name the page's own lines
        with contextlib.redirect_stdout(printed):
            exec(code, namespace)
        yield match, printed.getvalue()


def with_output(text: str, *, name: str) -> str:
    """A page with what its code prints printed anew."""
    result, end = [], 0
    for match, printed in run_code(text, name=name):
        shown = f"\n```text\n{printed}```\n" if printed else ""
        result += [text[end : match.start()], match[1], shown]
        end = match.end()
    return "".join(result) + text[end:]


# ---- the pictures ----------------------------------------------------------------------------------------------------

DISTANCES = (2.1, 2.3, 3.0, 5.0)
COLOURS = (450 * nm, 550 * nm, 650 * nm)


def overview(path: Path) -> None:
    """A scene, the lens's PSFs, the raw mosaic and the picture, each with a detail."""
    camera, scene = demo.singlet(), Scene.builtin("motorcycle")
    with torch.no_grad():
        generator = torch.Generator().manual_seed(0)
        raw = camera.raw(scene, generator=generator)
        picture = camera(scene, generator=generator.manual_seed(0))
        psf = camera[0].lens.psf(COLOURS, distances=DISTANCES, pixel_pitch=4 * um, shape=(41, 41)).double()
    _, height, width = scene.shape
    side, gap, edge, head = 2.12, 0.08, 0.02, 0.26
    tall, detail = side * height / width, side * 0.66
    row, column = 166, 536  # of the detail's centre: the headlight
    columns = 56
    rows = round(columns * detail / side)
    sheet = plots.Sheet(4 * side + 3 * gap + 2 * edge, head + tall + gap + detail + edge)
    coloured = plots.false_colour(raw[0], plots.mosaic_tile(camera))
    # twice, for the pixels of one colour are dark between the others: the mean over four is what an eye would see
    cells = coloured[: height // 2 * 2, : width // 2 * 2].reshape(height // 2, 2, width // 2, 2, 3).mean((1, 3))
    panels = {
        0: ("Scene: 28 bands, with depth", plots.as_image(scene.to_srgb()[0]), plots.as_image(scene.to_srgb()[0])),
        2: ("Raw: mosaic, noise, 12 bits", np.clip(1.8 * cells, 0, 1), np.clip(1.2 * coloured, 0, 1)),
        3: ("Picture", plots.as_image(picture[0]), plots.as_image(picture[0])),
    }
    top = max(0, row - rows // 2)
    left = max(0, column - columns // 2)
    for index, (title, whole, pixels) in panels.items():
        x = edge + index * (side + gap)
        sheet.text(x, head - 0.06, title, weight="bold", va="bottom", size=9.5)
        axes = sheet.picture(whole, x, head, side, tall)
        scale = whole.shape[1] / width
        for line, colour in ((2.2, "black"), (1.0, "white")):
            axes.plot(
                np.array([0, 1, 1, 0, 0]) * columns * scale + left * scale,
                np.array([0, 0, 1, 1, 0]) * rows * scale + top * scale,
                lw=line,
                color=colour,
            )
        axes.set(xlim=(-0.5, whole.shape[1] - 0.5), ylim=(whole.shape[0] - 0.5, -0.5))
        crop = pixels[top : top + rows, left : left + columns]
        sheet.picture(crop, x, head + tall + gap, side, detail, smooth=False)
    _psf_panel(sheet, psf, left=edge + side + gap, top=head, side=side, tall=tall + gap + detail)
    save_jpeg(sheet.figure, path)


def _psf_panel(sheet: plots.Sheet, psf: torch.Tensor, *, left: float, top: float, side: float, tall: float) -> None:
    """PSFs in the colour of their light, distance by wavelength."""
    sheet.text(left, top - 0.06, "Lens: its PSFs", weight="bold", va="bottom", size=9.5)
    gap = 0.03
    cell_w = (side - gap * (len(COLOURS) - 1)) / len(COLOURS)
    cell_h = (tall - gap * (len(DISTANCES) - 1)) / len(DISTANCES)
    half = psf.shape[-1] // 2
    reach = min(half, math.floor(half * cell_w / cell_h)) if cell_w < cell_h else half
    lit = plots.light_colours(torch.tensor(COLOURS, dtype=torch.float64))
    for d, distance in enumerate(DISTANCES):
        for c, wavelength in enumerate(COLOURS):
            image = psf[d, c, :, half - reach : half + reach + 1][..., None].numpy() * lit[c] ** 2.2
            image = np.sqrt(image / image.max()) ** (1 / 1.1)
            x, y = left + c * (cell_w + gap), top + d * (cell_h + gap)
            sheet.picture(image, x, y, cell_w, cell_h, smooth=False)
            if d == 0:
                name = f"{wavelength / nm:.0f} nm"
                sheet.text(x + cell_w - 0.05, y + 0.05, name, size=7.5, colour="white", ha="right")
            if c == 0:
                name = plots.metres(distance)
                sheet.text(x + 0.05, y + cell_h - 0.05, name, size=7.5, colour="white", va="bottom")


def gallery(path: Path) -> None:
    """What examples/psf_gallery.py draws."""
    sys.path.insert(0, str(ROOT / "examples"))
    import psf_gallery

    save_jpeg(psf_gallery.figure(psf_gallery.gallery()), path)


def lens_gallery(path: Path) -> None:
    """What examples/lens_gallery.py draws."""
    sys.path.insert(0, str(ROOT / "examples"))
    import lens_gallery as example

    save_jpeg(
        example.figure({name: example.pictures_of(name) for name in example.PRESETS}),
        path,
        resolutions=(150, 140, 130, 120),
    )


def augmentation_gallery(path: Path) -> None:
    """What examples/augmentation_gallery.py draws."""
    sys.path.insert(0, str(ROOT / "examples"))
    import augmentation_gallery as example

    figure = example.figure(example.gallery(), example.original()[0])
    save_jpeg(figure, path, resolutions=(165, 140, 120))  # noise is bulky


PLOTS = {"peers.png": RESULTS / "peers.json", "field-growth.png": FIELD} | {
    f"tradeoff-{name}.png": path for name, path in SWEEPS.items()
}
"""Plot -> the results that it shows."""

PICTURES: dict[str, Callable[[Path], None]] = {
    "overview.jpg": overview,
    "psf_gallery.jpg": gallery,
    "augmentations.jpg": augmentation_gallery,
    "tradeoff-singlet.png": tradeoff_picture,
    "tradeoff-thesis.png": tradeoff_picture,
    "peers.png": peers_picture,
    "field-growth.png": field_picture,
    "lenses.jpg": lens_gallery,
    "plans.jpg": plans_picture,
    "contact_sheet.jpg": contact_sheet,
}


def main(arguments: list[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pictures", action="store_true", help="render the pictures too")
    parser.add_argument("--traps", action="store_true", help="measure the traps again")
    parser.add_argument("--check", action="store_true", help="change nothing; exit with 1 if something is out of step")
    options = parser.parse_args(arguments)
    if options.traps:
        measure_traps()
    for name, draw in PICTURES.items() if options.pictures and not options.check else ():
        draw(IMAGES / name)  # before the tables: some show what was measured for a picture
    made = {}
    for path in pages():
        with tempfile.TemporaryDirectory() as folder, inside(folder):
            made[path] = with_output(with_tables(path.read_text()), name=str(path))
    old = [str(path.relative_to(ROOT)) for path, text in made.items() if path.read_text() != text]
    if options.check:
        sys.stdout.write(f"out of step: {', '.join(old)}; run python docs/generate.py\n" if old else "in step\n")
        return int(bool(old))
    for path, text in made.items():
        path.write_text(text)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
