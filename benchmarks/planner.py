"""Whether plans keep their word: random pairs of camera and scene, planned at five tolerances and measured.

    python -m benchmarks.planner [--random 300] [--hard 100] [--adversarial 200] [--assorted 100] [--strange 200]
                                 [--start 0] [--out FILE] [--effects] [--unseen]

With --effects the same pairs have one to four effects of a sensor's light drawn into them (glare, motion, crosstalk,
defects, ...), and only whether plans keep their word is measured. With --unseen that is all, too, of pairs without
them; their seeds begin where those end by which numbers in the code were chosen (`UNSEEN_FROM`).

It goes on where it stopped: pairs that are in the file of partial results are not measured again. What is drawn:
`pairs`. An error is the worst of the whole batch and of each item in it.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.pairs import FAMILIES, LONGEST, with_effects
from kcam import Camera, Scene, measure
from kcam.planner import Planner, costs, make_plan, noiseless_raw, relative_rms, timed
from kcam.planner.planner import fresh

TOLERANCES = (0.1, 0.03, 0.01, 0.003, 0.001)
SLOW = 5.0  # seconds of a reference picture above which one of each must do
FIRST = (0.03, 0.01)  # tolerances at which the first picture is timed too: a plan of its own, and the picture
SEEN, FELT = 0.1, 0.3  # seconds of a reference picture from which on the worst, and the median, of first pictures count
RESULTS = Path(__file__).parent / "results" / "planner.json"
EFFECTS, UNSEEN = RESULTS.with_name("planner_effects.json"), RESULTS.with_name("planner_unseen.json")
UNSEEN_FROM = 20000  # seeds below it were looked at
TOO_LOW = 0.8  # of an error, that a bound says at least
COUNTS = {"random": 300, "hard": 100, "adversarial": 200, "assorted": 100, "strange": 200}
TIMED = ("random", "hard")  # of which a first picture is taken, too


def measure_pair(
    kind: str, seed: int, rates: Mapping[str, float], *, tolerances: tuple[float, ...] = TOLERANCES, rounds: int = 3
) -> dict[str, Any]:
    """One pair: for each tolerance the estimate, the truth, and the times of the raw, by turns with the reference's.

    rates: of this machine, as `costs.calibrate` found them. Of some first pictures are taken, too, by turns as well.
    """
    camera, scene, text, again = FAMILIES[kind](seed)
    wholes: list[float] = []
    alone, first = ({tolerance: list[float]() for tolerance in FIRST} for _ in range(2))
    with torch.no_grad():
        planner = Planner(camera, scene)
        plans = [planner.plan(tolerance) for tolerance in tolerances]
        reference, truth = timed(camera, scene)
        turns = rounds if reference < SLOW else 1
        for _ in range(turns if kind in TIMED else 0):
            wholes.append(_whole(camera, scene))
            for tolerance in FIRST:
                alone[tolerance].append(make_plan(camera, scene, tolerance=tolerance).planning_seconds)
                first[tolerance].append(_whole(camera, scene, tolerance=tolerance))
        shots: list[list[tuple[float, Tensor]]] = [[] for _ in plans]
        references = [reference]
        for turn in range(turns):
            for shot, plan in zip(shots, plans, strict=True):
                shot.append(timed(plan.apply(camera), scene))
            if turn:
                references.append(timed(camera, scene)[0])
    rows = []
    for tolerance, plan, shot in zip(tolerances, plans, shots, strict=True):
        rows.append(
            {
                "tolerance": tolerance,
                "bound": plan.bound,
                "expected": plan.expected,
                "error": worst(shot[0][1], truth),
                "checked": plan.checked,
                "seconds": statistics.median(seconds for seconds, _ in shot),
                "reference_seconds": statistics.median(references),
                "predicted_seconds": plan.seconds,
                "calibrated_seconds": costs.seconds(planner.prices.work(plan.changes), rates),
                "predicted_reference_seconds": plan.reference_seconds,
                "planning_seconds": plan.planning_seconds,
                "first_planning_seconds": _median(alone.get(tolerance)),
                "first_seconds": _median(first.get(tolerance)),
                "first_reference_seconds": _median(wholes),
                "changes": plan.changes,
            }
        )
    return {"seed": f"{kind} {seed}", "pair": text, "drawn_again": again, "tolerances": rows}


def honest_pair(kind: str, seed: int, *, effects: bool) -> dict[str, Any]:
    """One pair: for each tolerance the estimate and the truth, the worst of the batch and of its items."""
    camera, scene, text, _ = FAMILIES[kind](seed)
    if effects:
        camera, drawn = with_effects(camera, scene, f"{kind}/{seed}")
        text = f"{drawn}; {text}"
    rows = []
    with torch.no_grad():
        planner, truth = Planner(camera, scene), noiseless_raw(camera)(scene)
        for tolerance in TOLERANCES:
            plan = planner.plan(tolerance)
            raw = noiseless_raw(plan.apply(camera))(scene)
            error = worst(raw, truth)
            left_out = [row.effect for row in plan.decisions if row.chosen == "left out"]
            rows.append({"tolerance": tolerance, "bound": plan.bound, "error": error, "left_out": left_out})
    return {"seed": f"{kind} {seed}", "pair": text, "tolerances": rows}


def measure_honesty(seeds: Mapping[str, range], out: Path, *, effects: bool) -> None:
    """Whether plans keep their word, of all pairs; goes on where it stopped."""
    partial = out.with_suffix(".partial.jsonl")
    known = [json.loads(line) for line in partial.read_text().splitlines()] if partial.exists() else []
    done = {pair["seed"]: pair for pair in known}
    for kind, seed in [(kind, seed) for kind, own in seeds.items() for seed in own]:
        if f"{kind} {seed}" not in done:
            found = done[f"{kind} {seed}"] = honest_pair(kind, seed, effects=effects)
            with partial.open("a") as file:
                file.write(json.dumps(found) + "\n")
            most = max(row["error"] / row["tolerance"] for row in found["tolerances"])
            print(f"{found['seed']}: {found['pair']}: worst {most:.2f} of the tolerance", flush=True)
    content: dict[str, Any] = {"environment": measure.environment()}
    for kind, own in seeds.items():
        if not own:
            continue
        rows = [row for seed in own for row in done[f"{kind} {seed}"]["tolerances"]]
        content[kind] = {
            "pairs": len(own),
            "outside": sum(row["error"] > row["tolerance"] for row in rows),
            "bounds_too_low": sum(row["bound"] < TOO_LOW * row["error"] for row in rows if row["error"] > 1e-6),
            "worst": max((row["error"] / row["tolerance"] for row in rows), default=0.0),
            "all": [done[f"{kind} {seed}"] for seed in own],
        }
        print(kind, {name: value for name, value in content[kind].items() if name != "all"})
    measure.write_json(out, content)


def worst(raw: Tensor, truth: Tensor) -> float:
    """Relative RMS of a batch, or of that item in it which is worst."""
    return max(relative_rms(a, b) for a, b in [(raw, truth), *zip(raw, truth, strict=True)])


def _median(seconds: Sequence[float] | None) -> float | None:
    return statistics.median(seconds) if seconds else None


def _whole(camera: Camera, scene: Scene, **how: Any) -> float:
    """Seconds of a whole picture with new optics, planning included where there is a tolerance."""
    new = Camera(*(fresh(stage) for stage in camera), context=camera.context)
    start = time.perf_counter()
    new(scene, **how)
    return time.perf_counter() - start


def summary(pairs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """For each tolerance: how many are inside, how good the estimates are, and how much faster the plans."""
    rows: list[dict[str, Any]] = []
    for index, tolerance in enumerate(TOLERANCES if pairs else ()):
        found = [pair["tolerances"][index] for pair in pairs]
        ratios = [row["expected"] / row["error"] for row in found if row["error"] > 0 and row["expected"] > 0]
        gains = sorted(row["reference_seconds"] / row["seconds"] for row in found)
        predicted, calibrated = (
            [row[f"{by}_seconds"] / row["seconds"] for row in found] for by in ("predicted", "calibrated")
        )
        rows.append(
            {
                "tolerance": tolerance,
                "pairs": len(found),
                "inside": sum(row["error"] <= tolerance for row in found),
                "worst": max(row["error"] / tolerance for row in found),
                "estimate_over_truth": statistics.median(ratios) if ratios else None,
                "speed_up": statistics.median(gains),
                "speed_up_quartiles": [gains[len(gains) // 4], gains[3 * len(gains) // 4]],
                "speed_up_least": gains[0],
                "predicted_over_measured": statistics.median(predicted),
                "mispredicted": statistics.median(max(ratio, 1 / ratio) for ratio in predicted),
                "mispredicted_calibrated": statistics.median(max(ratio, 1 / ratio) for ratio in calibrated),
                "bounds_too_low": sum(row["bound"] < TOO_LOW * row["error"] for row in found if row["error"] > 1e-6),
                "planning_share": statistics.median(
                    row["planning_seconds"] / row["reference_seconds"] for row in found
                ),
            }
        )
    return rows


def first_pictures(pairs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """What a tolerance is worth for one picture, planning included, where the reference takes long enough to be felt;
    the share that an explicit plan takes, and the gain of a picture under it.
    """
    rows = []
    for tolerance in FIRST:
        found = [row for pair in pairs for row in pair["tolerances"] if row["tolerance"] == tolerance]
        found = [row for row in found if row["first_seconds"] is not None and row["reference_seconds"] > SEEN]
        gains = [row["first_reference_seconds"] / row["first_seconds"] for row in found]
        felt = [row for row in found if row["reference_seconds"] > FELT]
        if felt:
            own = [gain for gain, row in zip(gains, found, strict=True) if row["reference_seconds"] > FELT]
            shares = [row["first_planning_seconds"] / row["reference_seconds"] for row in felt]
            rows.append(
                {
                    "tolerance": tolerance,
                    "pairs": len(felt),
                    "planning_share": statistics.median(shares),
                    "speed_up": statistics.median(own),
                    "later_speed_up": statistics.median(row["reference_seconds"] / row["seconds"] for row in felt),
                    "speed_up_least": min(gains),
                }
            )
    return rows


def main() -> None:
    """Measure what is missing, and write the results."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for kind, count in COUNTS.items():
        parser.add_argument(f"--{kind}", type=int, default=count)
    parser.add_argument("--start", type=int, default=None)
    parser.add_argument("--out", type=Path, default=None)
    parser.add_argument("--effects", action="store_true")
    parser.add_argument("--unseen", action="store_true")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    start = arguments.start if arguments.start is not None else UNSEEN_FROM if arguments.unseen else 0
    seeds = {kind: range(start, start + getattr(arguments, kind)) for kind in COUNTS}
    if arguments.effects or arguments.unseen:
        measure_honesty(seeds, arguments.out or (EFFECTS if arguments.effects else UNSEEN), effects=arguments.effects)
        return
    arguments.out = arguments.out or RESULTS
    partial = arguments.out.with_suffix(".partial.jsonl")
    known = [json.loads(line) for line in partial.read_text().splitlines()] if partial.exists() else []
    done = {pair["seed"]: pair for pair in known}
    rates, _ = costs.calibrate()
    for kind, seed in [(kind, seed) for kind, own in seeds.items() for seed in own]:
        key = f"{kind} {seed}"
        if key not in done:
            done[key] = measure_pair(kind, seed, rates)
            with partial.open("a") as file:
                file.write(json.dumps(done[key]) + "\n")
            most = max(row["error"] / row["tolerance"] for row in done[key]["tolerances"])
            third = done[key]["tolerances"][2]
            gain = third["reference_seconds"] / third["seconds"]
            text = f"worst {most:.2f} of the tolerance; {gain:.1f} times as fast at 0.01"
            print(f"{key}: {done[key]['pair']}: {text}", flush=True)
    found = {kind: [done[f"{kind} {seed}"] for seed in own] for kind, own in seeds.items()}
    failures = [
        {"seed": pair["seed"], "pair": pair["pair"], **row}
        for own in found.values()
        for pair in own
        for row in pair["tolerances"]
        if row["error"] > row["tolerance"]
    ]
    content: dict[str, Any] = {"environment": measure.environment(), "longest_seconds": LONGEST, "failures": failures}
    for kind, own in found.items():
        again = sum(pair["drawn_again"] for pair in own)
        own_summary = {"summary": summary(own), "first_pictures": first_pictures(own), "drawn_again": again}
        content[kind] = own_summary | {"pairs": own}
    measure.write_json(arguments.out, content)
    for kind in found:
        for row in [*content[kind]["summary"], *content[kind]["first_pictures"]]:
            print(kind, row)
    print(f"{len(failures)} failures")


if __name__ == "__main__":
    main()
