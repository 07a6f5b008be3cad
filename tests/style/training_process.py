"""A small training run as a process of its own, to be killed, or to share its batch with another one."""

from __future__ import annotations

import sys
from pathlib import Path

import tiny
import torch

from kcam.style import fit
from kcam.style.processes import joined


def main() -> None:
    torch.set_num_threads(1)
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    with joined("cpu") as (leads, _):
        camera = tiny.camera()
        if not leads:  # an initialisation of its own: the first one's counts
            for parameter in camera.parameters():
                parameter.data.mul_(1.01)
        trained = fit(
            camera,
            tiny.loss(),
            source=tiny.source(),
            settings=tiny.settings(
                steps=30,
                every=2,
                batch=4 if "--four" in sys.argv else 2,
                tolerance=0.02 if "--four" in sys.argv else None,
            ),
            folder=folder / "checkpoints",
            resume="--resume" in sys.argv,
        )
    names = [task.read_text().strip() for task in Path("/proc/self/task").glob("*/comm")]
    left = [name for name in names if "gloo" in name]  # one that lets go of a tensor while Python ends aborts it
    if left:
        raise RuntimeError(f"{len(left)} threads outlive their group: {left}.")
    torch.save({"history": trained.history} | trained.camera.state_dict(), folder / f"result{'' if leads else 1}.pt")


if __name__ == "__main__":
    main()
