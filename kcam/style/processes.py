"""The processes that train together, as torchrun starts them; or one alone."""

from __future__ import annotations

import torch
from torch import Tensor


def place() -> tuple[int, int]:
    """This process and how many there are, as torchrun set them up."""
    if torch.distributed.is_available() and torch.distributed.is_initialized():
        return torch.distributed.get_rank(), torch.distributed.get_world_size()
    return 0, 1


def mean_over_processes(values: Tensor, world: int) -> Tensor:
    """The same in each of them."""
    if world > 1:
        torch.distributed.all_reduce(values)
    return values / world


def anywhere(said: bool, world: int) -> bool:
    """Whether one of the processes says so: they stop together."""
    if world == 1:
        return said
    flag = torch.tensor(float(said))
    if torch.distributed.get_backend() == "nccl":
        flag = flag.cuda()
    torch.distributed.all_reduce(flag)
    return bool(flag > 0)
