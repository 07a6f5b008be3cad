"""An optimiser's state under the names of its parameters, for a checkpoint: never by position, which may change."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor


def optimiser_state(
    optimiser: torch.optim.Optimizer, names: Mapping[Tensor, str]
) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """An optimiser's state as tensors "optimiser/parameter/key" and a document, all under the parameters' names.

    Args:      optimiser: Adam, AdamW, or another whose state is tensors and numbers per parameter.
               names: parameter -> name, {p: name for name, p in model.named_parameters()}.
    Raises:    ValueError for a parameter without a name of its own; TypeError for a learning rate that is a tensor.
    """
    tensors: dict[str, Tensor] = {}
    state: dict[str, Any] = {}
    for name, parameter in _named(optimiser, names).items():
        state[name] = {}
        for key, value in optimiser.state.get(parameter, {}).items():
            at = f"optimiser/{name}/{key}"
            if isinstance(value, Tensor):
                tensors[at] = value.detach().clone()
            state[name][key] = {"tensor": at} if isinstance(value, Tensor) else value
    groups = []
    for group in optimiser.param_groups:
        options = {key: value for key, value in group.items() if key not in ("params", "param_names")}
        for key, value in options.items():
            if isinstance(value, Tensor):
                raise TypeError(f"cannot save the optimiser's {key}: it is a tensor. Use a number, {key}=1e-3.")
        groups.append({"parameters": [names[parameter] for parameter in group["params"]], **options})
    return tensors, {"class": type(optimiser).__name__, "groups": groups, "state": state}


def load_optimiser_state(
    optimiser: torch.optim.Optimizer,
    names: Mapping[Tensor, str],
    tensors: Mapping[str, Tensor],
    document: Mapping[str, Any],
) -> None:
    """Put back what `optimiser_state` gave, by name: parameters and groups may stand in another order.

    Args:      optimiser, names: as there.
               tensors: those that it gave, among others if need be.
               document: the one that it gave.
    Raises:    ValueError for another class, other groups, a tensor that is missing or has another shape: the optimiser
               is then as it was.
    """
    parameters = _named(optimiser, names)
    if document["class"] != type(optimiser).__name__:
        kind = type(optimiser).__name__
        raise ValueError(f"the state is of {document['class']}, and the optimiser is {kind}. Use {document['class']}.")
    saved = {frozenset(group["parameters"]): group for group in document["groups"]}
    groups, index = [], {name: number for number, name in enumerate(parameters)}
    for group in optimiser.param_groups:
        own = [names[parameter] for parameter in group["params"]]
        if frozenset(own) not in saved or len(saved) != len(optimiser.param_groups):
            raise ValueError(f"no saved group has the parameters {sorted(own)}; they are {[*map(sorted, saved)]}.")
        options = {key: value for key, value in saved[frozenset(own)].items() if key != "parameters"}
        options = {key: tuple(value) if isinstance(value, list) else value for key, value in options.items()}
        groups.append(options | {"params": [index[name] for name in own]})
    state: dict[int, dict[str, Any]] = {}
    for name, entries in document["state"].items():
        for key, value in entries.items():
            if isinstance(value, dict) and "tensor" in value:
                value = _entry(tensors, value["tensor"], None if key == "step" else parameters[name])
            state.setdefault(index[name], {})[key] = value
    optimiser.load_state_dict({"state": state, "param_groups": groups})


def _named(optimiser: torch.optim.Optimizer, names: Mapping[Tensor, str]) -> dict[str, Tensor]:
    named: dict[str, Tensor] = {}
    for group in optimiser.param_groups:
        for parameter in group["params"]:
            name = names.get(parameter)
            if name is None or name in named:
                what = "no name" if name is None else f"the name {name!r}, which another has too"
                raise ValueError(
                    f"a parameter of shape {tuple(parameter.shape)} has {what}. Use names={{p: name for name, p in "
                    "model.named_parameters()}."
                )
            named[name] = parameter
    return named


def _entry(tensors: Mapping[str, Tensor], at: str, like: Tensor | None) -> Tensor:
    if at not in tensors:
        raise ValueError(f"the checkpoint lacks the tensor {at!r}. Hand in all tensors that optimiser_state gave.")
    found = tensors[at]
    if like is not None and (found.shape, found.dtype) != (like.shape, like.dtype):
        raise ValueError(
            f"{at!r} is {tuple(found.shape)} of {found.dtype}, and its parameter {tuple(like.shape)} of {like.dtype}: "
            "it is of another model. Build the model as it was when it was saved."
        )
    return found.clone()
