"""Where light is computed nothing is shortened, however torch was told to, and afterwards all is as it was."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from kcam import Camera, Scene, precision
from kcam.precision import full_precision

BACKENDS = torch.backends
NEW = hasattr(BACKENDS.cudnn, "conv")


def set_to(switch: Any, name: str, value: Any) -> Callable[[], None]:
    return lambda: setattr(switch, name, value)


WAYS: dict[str, Callable[[], None]] = {
    "as it is": lambda: None,
    "older, high": lambda: torch.set_float32_matmul_precision("high"),
    "older, medium": lambda: torch.set_float32_matmul_precision("medium"),
    "older, convolutions exact": set_to(BACKENDS.cudnn, "allow_tf32", False),
}
if NEW:
    WAYS |= {
        "convolutions": set_to(BACKENDS.cudnn.conv, "fp32_precision", "ieee"),
        "products on a GPU": set_to(BACKENDS.cuda.matmul, "fp32_precision", "tf32"),
        "products here": set_to(BACKENDS.mkldnn.matmul, "fp32_precision", "bf16"),
        "everything": set_to(BACKENDS, "fp32_precision", "ieee"),
    }


def state() -> list[Any]:
    if NEW:
        own = (BACKENDS.cuda.matmul, BACKENDS.cudnn.conv, BACKENDS.mkldnn.matmul, BACKENDS.mkldnn.conv, BACKENDS)
        return [switch.fp32_precision for switch in own]
    return [torch.get_float32_matmul_precision(), BACKENDS.cudnn.allow_tf32]


@pytest.fixture(autouse=True)
def _restored() -> Any:
    yield
    if NEW:
        BACKENDS.fp32_precision = "none"
        BACKENDS.cudnn.rnn.fp32_precision = BACKENDS.cudnn.conv.fp32_precision = "tf32"
        BACKENDS.mkldnn.matmul.fp32_precision = BACKENDS.cuda.matmul.fp32_precision = "none"
    torch.set_float32_matmul_precision("highest")
    BACKENDS.cudnn.allow_tf32 = True


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("kind", ["cpu", "cuda"])
def test_inside_it_is_exact_and_outside_as_before(way: str, kind: str) -> None:
    WAYS[way]()
    before, where = state(), torch.device(kind)
    with full_precision(where):
        assert all(getattr(switch, name) == exact for switch, name, exact in precision._switches(where))
    assert state() == before


@pytest.mark.parametrize("way", WAYS)
def test_pictures_are_the_same(way: str) -> None:
    camera, scene = Camera.phone().noiseless(), Scene.builtin("coffee", 24).with_depth(2.0)
    expected = camera(scene)
    WAYS[way]()
    assert torch.allclose(camera(scene), expected, atol=1e-6)


def test_torch_before_the_newer_switches(monkeypatch: pytest.MonkeyPatch) -> None:
    older = SimpleNamespace(cudnn=SimpleNamespace(allow_tf32=True))
    monkeypatch.setattr(torch, "backends", older)
    torch.set_float32_matmul_precision("high")
    with full_precision(torch.device("cuda")):
        assert (torch.get_float32_matmul_precision(), older.cudnn.allow_tf32) == ("highest", False)
    assert (torch.get_float32_matmul_precision(), older.cudnn.allow_tf32) == ("high", True)
