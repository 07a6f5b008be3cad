"""What a user waits for: an import, a picture of 12 megapixels, a photograph from the command to the file."""

from __future__ import annotations

import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from skimage import data
from torch.nn.functional import interpolate

from kcam import Camera, Scene, plots, threads

SLACK, PICTURE, COMMAND = 0.3, 8.0, 12.0
"""Aims in seconds: of an import beyond torch and kornia, of 12 megapixels on one thread, of `kcam shoot`."""


def _child(*arguments: str) -> tuple[float, float]:
    """Seconds on the wall, and of CPU, of a Python process."""
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run([sys.executable, *arguments], check=True, capture_output=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return time.perf_counter() - start, cpu


def imports(rounds: int = 7) -> dict[str, Any]:
    """`import kcam` beside `import torch, kornia`, by turns, in CPU seconds."""
    taken: dict[str, list[float]] = {"import torch, kornia": [], "import kcam": []}
    for _ in range(rounds):
        for code, own in taken.items():
            own.append(_child("-c", code)[1])
    base, ours = (statistics.median(own) for own in taken.values())
    return {"what": "import kcam", "seconds": ours, "beside": "import torch, kornia", "beside_seconds": base,
            "aim": f"at most {SLACK:g} s more", "met": ours - base <= SLACK}  # fmt: skip


def megapixels(*, side: int = 4000, rounds: int = 3) -> dict[str, Any]:
    """12 megapixels through the preset phone, stage by stage, in CPU seconds of one thread: the median of rounds."""
    picture = torch.from_numpy(data.astronaut()).movedim(-1, 0).float()[None, :, :384] / 255
    scene = Scene.from_rgb(interpolate(picture, (3 * side // 4, side), mode="bilinear").clamp(0, 1), depth=2.0)
    camera = Camera.phone()
    totals: list[float] = []
    stages: dict[str, list[float]] = {}
    with torch.no_grad(), threads.fixed(1):
        for _ in range(rounds):
            start = before = time.process_time()
            for step in plots.steps(camera, scene, generator=torch.Generator().manual_seed(0)):
                stages.setdefault(step.name, []).append(time.process_time() - before)
                before = time.process_time()
            totals.append(before - start)
    return {"what": f"{3 * side // 4} x {side} through phone", "seconds": statistics.median(totals),
            "first": totals[0], "stages": {name: statistics.median(own) for name, own in stages.items()},
            "aim": f"at most {PICTURE:g} s", "met": statistics.median(totals) <= PICTURE}  # fmt: skip


def shoot(*, side: int = 3456, rounds: int = 3) -> dict[str, Any]:
    """A photograph of 8 megapixels by `kcam shoot`, from the command to the file, on the wall."""
    taken = []
    with tempfile.TemporaryDirectory() as folder:
        photo = Path(folder) / "photo.jpg"
        Image.fromarray(np.ascontiguousarray(data.astronaut()[:342])).resize((side, 2 * side // 3)).save(photo)
        for _ in range(rounds):
            taken.append(_child("-m", "kcam", "shoot", str(photo), "--out", str(Path(folder) / "shot.png"))[0])
    return {"what": f"kcam shoot of {2 * side // 3} x {side}", "seconds": statistics.median(taken),
            "aim": f"at most {COMMAND:g} s", "met": statistics.median(taken) <= COMMAND}  # fmt: skip
