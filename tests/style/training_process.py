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
    camera = tiny.camera()
    if distributed and torch.distributed.get_rank() > 0:  # an initialisation of its own: the first one's counts
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
    rank = torch.distributed.get_rank() if distributed else 0
    torch.save({"history": trained.history} | trained.camera.state_dict(), folder / f"result{rank or ''}.pt")
    if distributed:
        torch.distributed.destroy_process_group()


if __name__ == "__main__":
    main()
