from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from kcam import files
from kcam.context import Context, Stage

inf = float("inf")


class Gain(Stage):
    def __init__(self, gain: Tensor | float, *, unit: str = "none", shape: tuple[int, int] | None = None) -> None:
        super().__init__()
        if isinstance(gain, Tensor) and not isinstance(gain, nn.Parameter):
            self.register_buffer("gain", gain)
        else:
            self.gain = gain
        self.unit = unit
        self.shape = shape

    def forward(self, signal: Tensor, context: Context | None = None) -> Tensor:
        return signal * self.gain


class Stack(nn.Module):
    def __init__(self, *stages: nn.Module, distance: float = inf, context: Context | None = None) -> None:
        super().__init__()
        self.stages = nn.ModuleList(stages)
        self.distance = distance
        self.context = context

    def forward(self, signal: Tensor) -> Tensor:
        for stage in self.stages:
            signal = stage(signal)
        return signal


class Small(nn.Module):
    """A module with weights that no argument gives."""

    def __init__(self) -> None:
        super().__init__()
        self.conv = nn.Conv2d(1, 3, 3)

    def forward(self, signal: Tensor) -> Tensor:
        return self.conv(signal)


class Renamed(nn.Module):
    """A module whose argument cannot be an attribute, because a method has its name."""

    def __init__(self, gain: Tensor) -> None:
        super().__init__()
        self.weight = gain

    def configuration(self) -> dict[str, Any]:
        return {"gain": self.weight}

    def gain(self) -> Tensor:
        return self.weight


class Forgetful(nn.Module):
    def __init__(self, gain: float) -> None:
        super().__init__()


class Anything(nn.Module):
    def __init__(self, **settings: float) -> None:
        super().__init__()


CLASSES: dict[str, type] = {"Gain": Gain, "Stack": Stack, "Small": Small, "Renamed": Renamed}
CLASSES |= {"Context": Context, "ReLU": nn.ReLU}


def store(module: nn.Module, path: Path) -> Path:
    files.save(module, path, classes=CLASSES, version="1.2.3")
    return path


def restore(path: Path) -> Any:
    return files.load(path, classes=CLASSES)


def rewrite(path: Path, change: Any) -> None:
    """Change a saved file's configuration."""
    with safe_open(path, framework="pt") as file:
        document = json.loads(file.metadata()["kcam"])
        tensors = {key: file.get_tensor(key).clone() for key in file.keys()}  # noqa: SIM118
    change(document, tensors)
    save_file(tensors, path, metadata={"kcam": json.dumps(document)})


def test_round_trip(tmp_path: Path) -> None:
    trained = nn.Parameter(torch.rand(3, 1, 1, dtype=torch.float64))
    frozen = nn.Parameter(torch.rand(()), requires_grad=False)
    module = Stack(Gain(trained, shape=(3, 4)), Gain(frozen), Gain(torch.rand(5)), Gain(0.1, unit="e-"), Small())
    before = torch.random.get_rng_state()
    copy = restore(store(module, tmp_path / "x.safetensors"))
    assert torch.equal(before, torch.random.get_rng_state())
    assert [type(stage) for stage in copy.stages] == [type(stage) for stage in module.stages]
    for (name, a), (other, b) in zip(module.state_dict().items(), copy.state_dict().items(), strict=True):
        assert name == other
        assert a.dtype == b.dtype
        assert torch.equal(a, b)
    assert [p.requires_grad for p in copy.parameters()] == [p.requires_grad for p in module.parameters()]
    assert copy.distance == inf
    assert copy.stages[0].shape == (3, 4)
    assert copy.stages[1].shape is None
    assert copy.stages[3].gain == 0.1
    assert not isinstance(copy.stages[2].gain, nn.Parameter)


def test_configuration_by_method(tmp_path: Path) -> None:
    module = Stack(Renamed(nn.Parameter(torch.rand(3))))
    copy = restore(store(module, tmp_path / "x.safetensors"))
    assert torch.equal(copy.stages[0].weight, module.stages[0].weight)
    assert isinstance(copy.stages[0].weight, nn.Parameter)


def test_what_was_shared_stays_shared(tmp_path: Path) -> None:
    gain = nn.Parameter(torch.ones(2))
    twice = Gain(gain)
    module = Stack(twice, Gain(gain), twice, context=Context(colour_filter=twice, full_well=5.0))  # type: ignore[arg-type]
    copy = restore(store(module, tmp_path / "x.safetensors"))
    assert copy.stages[0] is copy.stages[2]
    assert copy.stages[0].gain is copy.stages[1].gain
    assert copy.context.colour_filter is copy.stages[0]
    assert copy.context.full_well == 5.0
    assert torch.equal(copy.context.wavelengths, Context().wavelengths)
    assert len(list(copy.parameters())) == 1


def test_readable(tmp_path: Path) -> None:
    path = store(Stack(Gain(2.0, unit="e-"), Gain(nn.Parameter(torch.zeros(3))), nn.ReLU()), tmp_path / "x.safetensors")
    document = files.describe(path)
    assert document["kcam"] == "1.2.3"
    assert document["format"] == files.FORMAT
    assert document["configuration"] == {
        "class": "Stack",
        "arguments": {
            "stages": [
                {"class": "Gain", "arguments": {"gain": 2.0, "unit": "e-", "shape": None}},
                {
                    "class": "Gain",
                    "arguments": {
                        "gain": {"parameter": "stages.1.gain", "shape": [3], "trainable": True},
                        "unit": "none",
                        "shape": None,
                    },
                },
                {"class": "ReLU", "arguments": {"inplace": False}},
            ],
            "distance": {"float": "inf"},
            "context": None,
        },
    }


def test_file_is_replaced_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = store(Gain(1.0), tmp_path / "x.safetensors")
    store(Gain(2.0), path)
    assert restore(path).gain == 2.0

    def fail(descriptor: int) -> None:
        raise OSError("disk full")

    monkeypatch.setattr("os.fsync", fail)
    with pytest.raises(OSError, match="disk full"):
        store(Gain(3.0), path)
    assert restore(path).gain == 2.0
    assert [item.name for item in tmp_path.iterdir()] == ["x.safetensors"]


def test_loaded_tensors_do_not_hang_on_the_file(tmp_path: Path) -> None:
    path = store(Gain(nn.Parameter(torch.ones(1000))), tmp_path / "x.safetensors")
    module = restore(path)
    path.write_bytes(b"\0" * path.stat().st_size)
    assert (module.gain == 1).all()


@pytest.mark.parametrize(
    ("module", "message"),
    [
        (Forgetful(2.0), r"cannot save Forgetful\(gain=\).*self.gain = gain"),
        (Anything(), r"Anything: its constructor takes \*\*kwargs"),
        (Gain(torch.float32), r"cannot save Gain\(gain=\): a dtype is none of"),  # type: ignore[arg-type]
    ],
)
def test_cannot_save(module: nn.Module, message: str, tmp_path: Path) -> None:
    with pytest.raises(TypeError, match=message):
        store(module, tmp_path / "x.safetensors")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["x", "x.pt", "x.safetensors.bak"])
def test_name_must_say_what_it_is(name: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=f"cannot save {name}: its name must end in .safetensors. Use x.safetensors.$"):
        store(Gain(1.0), tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_a_folder_is_no_file(tmp_path: Path) -> None:
    (tmp_path / "x.safetensors").mkdir()
    with pytest.raises(ValueError, match="cannot save x.safetensors: there is a folder of that name"):
        store(Gain(1.0), tmp_path / "x.safetensors")
    with pytest.raises(FileNotFoundError, match="x.safetensors is a folder. Name the file in it"):
        restore(tmp_path / "x.safetensors")


def test_no_folder(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="cannot save x.safetensors: there is no folder .*nowhere"):
        store(Gain(1.0), tmp_path / "nowhere" / "x.safetensors")


def test_no_file(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="there is no file .*x.safetensors"):
        restore(tmp_path / "x.safetensors")


@pytest.mark.parametrize("content", [b"", b"hello", b"\x89PNG\r\n\x1a\n" + bytes(100)])
def test_not_safetensors(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "x.safetensors"
    path.write_bytes(content)
    with pytest.raises(ValueError, match="is not a whole safetensors file"):
        restore(path)


def test_truncated(tmp_path: Path) -> None:
    path = store(Gain(nn.Parameter(torch.ones(1000))), tmp_path / "x.safetensors")
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(ValueError, match="is not a whole safetensors file"):
        restore(path)


def test_only_weights(tmp_path: Path) -> None:
    save_file({"weight": torch.ones(2)}, tmp_path / "x.safetensors")
    with pytest.raises(ValueError, match="holds weights but no camera"):
        restore(tmp_path / "x.safetensors")


def test_unknown_class(tmp_path: Path) -> None:
    path = store(Stack(Gain(1.0)), tmp_path / "x.safetensors")
    with pytest.raises(ValueError, match=r"needs the class 'Gain'.*custom=\[Gain\]"):
        files.load(path, classes={"Stack": Stack})


def test_newer_format(tmp_path: Path) -> None:
    path = store(Gain(1.0), tmp_path / "x.safetensors")
    rewrite(path, lambda document, tensors: document.update(format=99))
    with pytest.raises(ValueError, match=r"in format 99; this kcam reads up to format 1. Update kcam"):
        restore(path)


def test_missing_tensor(tmp_path: Path) -> None:
    path = store(Gain(nn.Parameter(torch.ones(2))), tmp_path / "x.safetensors")
    rewrite(path, lambda document, tensors: tensors.clear())
    with pytest.raises(ValueError, match="lacks the tensor 'gain'"):
        restore(path)


def test_tensor_of_another_shape(tmp_path: Path) -> None:
    path = store(Gain(nn.Parameter(torch.ones(2))), tmp_path / "x.safetensors")
    rewrite(path, lambda document, tensors: tensors.update(gain=torch.ones(3)))
    with pytest.raises(ValueError, match=r"'gain' has shape \(3,\), but the configuration says \(2,\)"):
        restore(path)
    path = store(Small(), path)
    rewrite(path, lambda document, tensors: tensors.update({"conv.bias": torch.ones(4)}))
    with pytest.raises(ValueError, match=r"the weights do not fit the configuration.*conv.bias"):
        restore(path)


def test_argument_that_is_gone(tmp_path: Path) -> None:
    path = store(Gain(1.0), tmp_path / "x.safetensors")
    rewrite(path, lambda document, tensors: document["configuration"]["arguments"].update(colour=3))
    with pytest.raises(ValueError, match="Gain no longer takes the saved arguments: .*colour"):
        restore(path)
