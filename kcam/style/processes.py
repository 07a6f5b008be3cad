"""The processes that train together, as torchrun starts them; or one alone."""

from __future__ import annotations

import importlib
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor


@contextmanager
def joined(device: str) -> Iterator[tuple[bool, torch.device]]:
    """Whether this process leads, and its device; under torchrun with the others, until the end of the context."""
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        yield True, torch.device(device)
        return
    own = torch.device(device, int(os.environ["LOCAL_RANK"])) if device == "cuda" else torch.device(device)
    if device == "cuda":
        torch.cuda.set_device(own)  # else every process's flags and objects would go by the first one
    # Imported later, as Adam does, its defaults hold the group and its threads for ever (torch 2.13), and a thread that
    # lets go of a tensor while Python ends aborts the process.
    importlib.import_module("torch.distributed.nn.functional")
    torch.distributed.init_process_group("nccl" if device == "cuda" else "gloo")
    try:
        yield torch.distributed.get_rank() == 0, own
    finally:
        torch.distributed.destroy_process_group()


def place() -> tuple[int, int]:
    """This process and how many there are, as torchrun set them up."""
    if torch.distributed.is_available() and torch.distributed.is_initialized():
        return torch.distributed.get_rank(), torch.distributed.get_world_size()
    return 0, 1


def gathered(rows: Tensor, world: int) -> Tensor:
    """(R,...) of each process to the batch (B,...), the same in all: process k has the rows k, k + world, ..."""
    if world == 1:
        return rows
    parts = [torch.empty_like(rows) for _ in range(world)]
    torch.distributed.all_gather(parts, rows.contiguous())
    return torch.stack(parts, dim=1).flatten(0, 1)


def of_the_first(values: Tensor, world: int) -> Tensor:
    """The first process's, in all: what each has computed alike stays alike where a sum's order is not fixed (CUDA)."""
    if world > 1:
        values = values.contiguous()
        torch.distributed.broadcast(values, src=0)
    return values


def told_by_the_first(value: Any, world: int) -> Any:
    """The first process's value, in all of them."""
    told = [value]
    if world > 1:
        torch.distributed.broadcast_object_list(told)
    return told[0]


def start_alike(values: Iterable[Tensor], world: int) -> None:
    """Parameters and buffers of all processes become the first one's."""
    for value in values:
        if world > 1:
            value.detach().copy_(of_the_first(value.detach().clone(), world))


def anywhere(said: bool, world: int) -> bool:
    """Whether one of the processes says so: they stop together."""
    if world == 1:
        return said
    flag = torch.tensor(float(said))
    if torch.distributed.get_backend() == "nccl":
        flag = flag.cuda()
    torch.distributed.all_reduce(flag)
    return bool(flag > 0)
