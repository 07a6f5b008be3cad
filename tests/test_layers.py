"""Layers of torch's own as stages of a camera: each class of the table, with random arguments, saved and loaded."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn

from kcam import Camera, files, layers, sensor

Drawn = tuple[dict[str, Any], tuple[int, ...]]


def _dimensions(name: str) -> int:
    return int(name[-2]) if name[-1] == "d" and name[-2].isdigit() else 2


def _shape(name: str, channels: int, side: int = 12) -> tuple[int, ...]:
    return (2, channels, *[side] * _dimensions(name))


def _each(rng: random.Random, name: str, choices: list[int]) -> int | tuple[int, ...]:
    """A number for all axes, or one for each."""
    return rng.choice([rng.choice(choices), tuple(rng.choice(choices) for _ in range(_dimensions(name)))])


def _convolution(rng: random.Random, name: str) -> Drawn:
    given = {
        "in_channels": 4,
        "out_channels": 6,
        "kernel_size": _each(rng, name, [1, 2, 3]),
        "stride": _each(rng, name, [1, 2]),
        "dilation": _each(rng, name, [1, 2]),
        "groups": rng.choice([1, 2]),
        "bias": rng.random() < 0.5,
        "padding": _each(rng, name, [0, 1, 2]),
    }
    if "Transpose" not in name:
        given["padding_mode"] = rng.choice(["zeros", "reflect", "replicate", "circular"])
        if rng.random() < 0.2:
            given |= {"stride": 1, "padding": rng.choice(["same", "valid"])}
    return given, _shape(name, 4)


def _norm(rng: random.Random, name: str) -> Drawn:
    flags = {"affine": rng.random() < 0.7, "eps": rng.choice([1e-5, 1e-3])}
    if name == "GroupNorm":
        return {"num_groups": rng.choice([1, 2, 4]), "num_channels": 4, **flags}, _shape(name, 4)
    running = {"track_running_stats": rng.random() < 0.5, "momentum": rng.choice([0.1, 0.3])}
    return {"num_features": 4, **flags, **running}, _shape(name, 4)


def _over_the_last(rng: random.Random, name: str) -> Drawn:
    flags = {"elementwise_affine": rng.random() < 0.7, "eps": 1e-4}
    if name == "LayerNorm":
        flags["bias"] = rng.random() < 0.5
    return {"normalized_shape": rng.choice([12, (12,), [12, 12], (4, 12, 12)]), **flags}, (2, 4, 12, 12)


def _pool(rng: random.Random, name: str) -> Drawn:
    if "Adaptive" in name:
        return {"output_size": _each(rng, name, [1, 3, 5])}, _shape(name, 4)
    size = rng.choice([2, 3])
    given: dict[str, Any] = {"kernel_size": size, "ceil_mode": rng.random() < 0.5}
    given |= rng.choice([{}, {"stride": rng.choice([1, 2, 3])}])
    if name.startswith("LP"):
        return {"norm_type": rng.choice([2, 1.5]), **given}, _shape(name, 4)
    given["padding"] = rng.choice([0, 1])
    if name.startswith("Max"):
        given["dilation"] = rng.choice([1, 2])
    else:
        given["count_include_pad"] = rng.random() < 0.5
    return given, _shape(name, 4)


def _upsampling(rng: random.Random, name: str) -> Drawn:
    by = rng.choice([{"size": (7, 20)}, {"size": 30}, {"scale_factor": 1.5}, {"scale_factor": (2.0, 3.0)}])
    if name != "Upsample":
        return by, (1, 3, 12, 12)
    mode = rng.choice(["nearest", "bilinear", "bicubic", "area", "nearest-exact"])
    return by | {"mode": mode} | ({"align_corners": True} if mode[:2] == "bi" else {}), (1, 3, 12, 12)


def _pad(rng: random.Random, name: str) -> Drawn:
    sides = tuple(rng.choice([0, 1, 3]) for _ in range(2 * _dimensions(name)))
    value = {"value": rng.uniform(-1, 1)} if "Constant" in name else {}
    return {"padding": rng.choice([2, sides]), **value}, _shape(name, 4)


def _activation(rng: random.Random, name: str) -> Drawn:
    own = {
        "LeakyReLU": {"negative_slope": rng.random()},
        "PReLU": {"num_parameters": rng.choice([1, 4]), "init": rng.random()},
        "RReLU": {"lower": 0.1, "upper": rng.uniform(0.2, 0.5)},
        "ELU": {"alpha": rng.random()},
        "CELU": {"alpha": 0.1 + rng.random()},
        "GELU": {"approximate": rng.choice(["none", "tanh"])},
        "GLU": {"dim": rng.choice([1, 2, -1])},
        "Hardtanh": {"min_val": -rng.random(), "max_val": rng.random()},
        "Hardshrink": {"lambd": rng.random()},
        "Softshrink": {"lambd": rng.random()},
        "Softplus": {"beta": rng.choice([1, 2.5]), "threshold": 15},
        "Threshold": {"threshold": rng.random(), "value": -rng.random()},
    }.get(name, {})
    if name in ("Softmax", "Softmin", "LogSoftmax"):
        own = {"dim": rng.choice([1, 2, -1])}
    return own, (2, 4, 12, 12)


FAMILIES: list[tuple[str, Callable[[random.Random, str], Drawn]]] = [
    ("Conv", _convolution),
    ("BatchNorm", _norm),
    ("InstanceNorm", _norm),
    ("GroupNorm", _norm),
    ("LayerNorm", _over_the_last),
    ("RMSNorm", _over_the_last),
    ("LocalResponseNorm", lambda rng, name: ({"size": 3, "alpha": rng.random(), "k": 1 + rng.random()}, (2, 4, 9, 9))),
    ("MaxPool", _pool),
    ("AvgPool", _pool),
    ("LPPool", _pool),
    ("Adaptive", _pool),
    ("Upsampl", _upsampling),
    ("Zero", _pad),
    ("Constant", _pad),
    ("Reflection", _pad),
    ("Replication", _pad),
    ("Circular", _pad),
    ("Dropout", lambda rng, name: ({"p": rng.random()}, _shape(name, 4))),
    ("AlphaDropout", lambda rng, name: ({"p": rng.random()}, (2, 4, 12, 12))),
    ("FeatureAlpha", lambda rng, name: ({"p": rng.random()}, (2, 4, 12, 12))),
    ("PixelShuffle", lambda rng, name: ({"upscale_factor": 2}, (2, 4, 12, 12))),
    ("PixelUnshuffle", lambda rng, name: ({"downscale_factor": rng.choice([2, 3])}, (2, 4, 12, 12))),
    ("ChannelShuffle", lambda rng, name: ({"groups": 2}, (2, 4, 12, 12))),
    ("Linear", lambda rng, name: ({"in_features": 12, "out_features": 5, "bias": rng.random() < 0.5}, (2, 4, 12, 12))),
    ("Flatten", lambda rng, name: ({"start_dim": 2, "end_dim": -1}, (2, 4, 12, 12))),
    ("Unflatten", lambda rng, name: ({"dim": 1, "unflattened_size": (2, 2)}, (2, 4, 12, 12))),
    ("", _activation),
]


def drawn(name: str, seed: int) -> tuple[nn.Module, torch.Tensor]:
    """A layer with random arguments, weights, statistics and type, and what it takes."""
    rng = random.Random(f"{name} {seed}")
    torch.manual_seed(seed)
    draw = next(draw for prefix, draw in FAMILIES if name.startswith(prefix))
    arguments, shape = draw(rng, name)
    dtype = rng.choice([torch.float32, torch.float64])
    layer = getattr(nn, name)(**arguments).to(dtype)
    signal = torch.rand(shape, dtype=dtype)
    layer(signal)  # running statistics are no longer what they began as
    for parameter in layer.parameters():
        parameter.data.normal_()
        parameter.requires_grad_(rng.random() < 0.7)
    return layer.train(rng.random() < 0.5), signal


def round_trip(camera: Camera, path: Path) -> Camera:
    camera.save(path)
    copy = Camera.load(path)
    again = path.with_name("again.safetensors")
    copy.save(again)
    assert files.describe(again) == files.describe(path)
    assert repr(copy) == repr(camera)
    ours, theirs = camera.state_dict(), copy.state_dict()
    assert ours.keys() == theirs.keys()
    for key, value in ours.items():
        assert value.dtype == theirs[key].dtype
        assert torch.equal(value, theirs[key])
    assert [p.requires_grad for p in camera.parameters()] == [p.requires_grad for p in copy.parameters()]
    assert [m.training for m in camera.stages.modules()][1:] == [m.training for m in copy.stages.modules()][1:]
    return copy


def same_picture(one: nn.Module, other: nn.Module, signal: torch.Tensor) -> None:
    results = []
    for module in (one, other):
        torch.manual_seed(1)  # of dropout
        results.append(module(signal))
    assert torch.equal(*results)


@pytest.mark.filterwarnings("ignore:Using padding='same' with even kernel lengths")  # torch says so once
@pytest.mark.parametrize("name", [name for name in layers.NAMES if name != "Sequential"])
def test_every_layer_comes_back_as_it_was(name: str, tmp_path: Path) -> None:
    for seed in range(2):
        layer, signal = drawn(name, seed)
        copy = round_trip(Camera(layer), tmp_path / "x.safetensors")
        assert type(copy[0]) is type(layer)
        same_picture(layer, copy[0], signal)


@pytest.mark.filterwarnings("ignore:Using padding='same' with even kernel lengths")  # torch says so once
@pytest.mark.slow
def test_every_layer_comes_back_over_many_arguments(tmp_path: Path) -> None:
    for name in layers.NAMES:
        for seed in range(2, 40) if name != "Sequential" else ():
            layer, signal = drawn(name, seed)
            same_picture(layer, round_trip(Camera(layer), tmp_path / "x.safetensors")[0], signal)


def network() -> nn.Sequential:
    shared = nn.Conv2d(4, 4, 3, padding=1, padding_mode="replicate")
    body = nn.Sequential()
    body.add_module("convolution", shared)
    body.add_module("norm", nn.BatchNorm2d(4))
    body.add_module("same again", shared)
    return nn.Sequential(nn.Conv2d(3, 4, 5, padding=2), nn.SiLU(), body, nn.Conv2d(4, 12, 1), nn.PixelShuffle(2))


def test_nested_layers_that_share_stand_among_the_stages_of_a_camera(tmp_path: Path) -> None:
    camera = Camera(sensor.ColourFilter.kodak(), network(), nn.AvgPool2d(2))
    camera[1][2][2].weight = camera[1][2][0].weight
    camera(torch.rand(1, 28, 8, 8))
    copy = round_trip(camera, tmp_path / "x.safetensors")
    same_picture(camera.eval(), copy.eval(), torch.rand(1, 28, 8, 8))
    assert copy[1][2][0] is copy[1][2][2]
    loss = copy(torch.rand(1, 28, 8, 8)).square().mean()
    loss.backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in copy[1][0].parameters())


def test_two_layers_of_one_weight_still_have_one(tmp_path: Path) -> None:
    one, other = nn.Conv2d(3, 3, 1), nn.Conv2d(3, 3, 1)
    other.weight = one.weight
    copy = round_trip(Camera(one, other), tmp_path / "x.safetensors")
    assert copy[0].weight is copy[1].weight
    assert copy[0].bias is not copy[1].bias


class Doubled(nn.Conv2d):
    def forward(self, input: torch.Tensor) -> torch.Tensor:
        return 2 * super().forward(input)


def _hooked() -> nn.Module:
    layer = nn.ReLU()
    layer.register_forward_hook(lambda module, given, result: 2 * result)
    return layer


def _replaced() -> nn.Module:
    layer = nn.ReLU()
    layer.forward = lambda x: 2 * x  # type: ignore[method-assign, assignment]
    return layer


def _grown(layer: nn.Module) -> nn.Module:
    layer.register_buffer("more", torch.ones(3))
    return layer


def _parent() -> nn.Module:
    layer = nn.Conv2d(3, 3, 1)
    layer.child = nn.Linear(2, 2)
    return layer


def _set(name: str, value: Any) -> nn.Module:
    layer = nn.Conv2d(3, 3, 3, padding=1, padding_mode="circular")
    setattr(layer, name, value)
    return layer


@pytest.mark.parametrize(
    ("layer", "text"),
    [
        (nn.LSTM(3, 3), "cannot save a torch.nn.LSTM: it is none of torch's layers"),
        (nn.Bilinear(3, 3, 3), "cannot save a torch.nn.Bilinear"),
        (nn.ModuleList(), "cannot save a torch.nn.ModuleList"),
        (nn.Sequential(nn.ReLU(), nn.Fold(3, 1)), "cannot save a torch.nn.Fold"),
        (nn.LazyConv2d(3, 1), "cannot save a torch.nn.LazyConv2d"),
        (nn.utils.parametrizations.weight_norm(nn.Conv2d(3, 3, 1)), "ParametrizedConv2d: it is none of torch's layers"),
        (nn.utils.spectral_norm(nn.Conv2d(3, 3, 1)), "cannot save a torch.nn.Conv2d to which something was done"),
        (_hooked(), "cannot save a torch.nn.ReLU to which something was done"),
        (_replaced(), "cannot save a torch.nn.ReLU to which something was done"),
        (_grown(nn.Conv2d(3, 3, 1)), "cannot save a torch.nn.Conv2d to which something was done"),
        (_grown(nn.Sequential(nn.ReLU())), "cannot save a torch.nn.Sequential to which something was done"),
        (_parent(), "cannot save a torch.nn.Conv2d to which something was done"),
        (_set("padding", (2, 2)), "cannot save a torch.nn.Conv2d to which something was done"),
        (_set("transposed", True), "cannot save a torch.nn.Conv2d to which something was done"),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, nn.Module) else "",
)
def test_what_would_not_come_back_is_refused_by_name(layer: nn.Module, text: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=text):
        Camera(layer).save(tmp_path / "x.safetensors")
    assert not list(tmp_path.iterdir())


class Chain(nn.Sequential):
    pass


@pytest.mark.parametrize("layer", [Doubled(3, 3, 1), Chain(nn.ReLU())], ids=["Doubled", "Chain"])
def test_a_class_of_ones_own_is_not_taken_for_torchs(layer: nn.Module, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=f"cannot save a {type(layer).__name__}: it inherits the constructor of"):
        Camera(layer).save(tmp_path / "x.safetensors")
