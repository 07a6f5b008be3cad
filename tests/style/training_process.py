"""A small training run as a process of its own, to be killed, or to share its batch with another one."""

from __future__ import annotations

import sys
from pathlib import Path

import tiny
import torch

from kcam.style import fit


def main() -> None:
    torch.set_num_threads(1)
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    distributed = torch.distributed.is_torchelastic_launched()
    if distributed:
        torch.distributed.init_process_group("gloo")
    trained = fit(
        tiny.camera(),
        tiny.loss(),
        source=tiny.source(),
        settings=tiny.settings(steps=30, every=2, batch=4 if "--four" in sys.argv else 2),
        folder=folder / "checkpoints",
        resume="--resume" in sys.argv,
    )
    if not distributed or torch.distributed.get_rank() == 0:
        torch.save({"history": trained.history} | trained.camera.state_dict(), folder / "result.pt")
    if distributed:
        torch.distributed.destroy_process_group()


if __name__ == "__main__":
    main()
