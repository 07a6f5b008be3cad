"""A small training run as a process of its own, to be killed, or to share its batch with another one."""

from __future__ import annotations

import sys
from pathlib import Path

import tiny
import torch

from kcam.style import Settings, fit

# at a tenth of the rates, a ReLU that rounding turns over still makes one run in two another one within 30 steps
SLOW = {part: rate / 100 for part, rate in Settings().rates.items()}


def main() -> None:
    torch.set_num_threads(1)
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    distributed = torch.distributed.is_torchelastic_launched()
    if distributed:
        torch.distributed.init_process_group("gloo")
    trained = fit(
        tiny.camera(photons="--smooth" not in sys.argv),
        tiny.loss(),
        source=tiny.source(),
        settings=tiny.settings(steps=30, every=2, rates=SLOW if "--smooth" in sys.argv else Settings().rates),
        folder=folder / "checkpoints",
        resume="--resume" in sys.argv,
    )
    if not distributed or torch.distributed.get_rank() == 0:
        torch.save({"history": trained.history} | trained.camera.state_dict(), folder / "result.pt")
    if distributed:
        torch.distributed.destroy_process_group()


if __name__ == "__main__":
    main()
