"""VGG16 from a file in torchvision's layout: the right values from the right file, a clear error from any other.

No pretrained weights are at hand: they are random here, in the names and shapes of torchvision's.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor, nn

from kcam.scene import PHOTOGRAPHS
from kcam.style import StyleLoss, VGG16Features, painting

# Written out, not taken from the module: torchvision's models.vgg16().features, up to relu4_3.
SHAPES = {
    0: (64, 3), 2: (64, 64), 5: (128, 64), 7: (128, 128), 10: (256, 128), 12: (256, 256), 14: (256, 256),
    17: (512, 256), 19: (512, 512), 21: (512, 512),
}  # fmt: skip
POOLED_BEFORE = (5, 10, 17)
LAYERS = {2: "relu1_2", 7: "relu2_2", 14: "relu3_3", 21: "relu4_3"}  # by the convolution before the ReLU


@pytest.fixture(scope="module")
def state() -> dict[str, Tensor]:
    """He's initialisation: activations as large at the last layer as at the first."""
    generator = torch.Generator().manual_seed(0)
    state = {}
    for index, (after, before) in SHAPES.items():
        scale = math.sqrt(2 / (9 * before))
        state[f"features.{index}.weight"] = scale * torch.randn(after, before, 3, 3, generator=generator)
        state[f"features.{index}.bias"] = 0.1 * torch.randn(after, generator=generator)
    # What is ignored, in shapes that would be refused if it were read.
    return state | {"features.24.weight": torch.ones(3), "classifier.0.weight": torch.ones(2, 2)}


@pytest.fixture(scope="module")
def file(state: dict[str, Tensor], tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("vgg") / "weights.pth"
    torch.save(state, path)
    return path


@pytest.fixture(scope="module")
def features(file: Path) -> VGG16Features:
    return VGG16Features(file, precision="float32")


def pictures(*shape: int, seed: int = 1) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed))


def by_numpy(picture: Tensor, state: dict[str, Tensor], *, pool: str = "max") -> dict[str, np.ndarray]:
    """The network in float64, from the definition: sums over shifted copies of the picture (3,H,W)."""
    mean, deviation = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])
    x = (picture.double().numpy() - mean[:, None, None]) / deviation[:, None, None]
    layers = {}
    for index in SHAPES:
        if index in POOLED_BEFORE:
            blocks = x.reshape(len(x), x.shape[1] // 2, 2, x.shape[2] // 2, 2)
            x = blocks.max((2, 4)) if pool == "max" else blocks.mean((2, 4))
        height, width = x.shape[1:]
        weight = state[f"features.{index}.weight"].double().numpy()
        around = np.pad(x, ((0, 0), (1, 1), (1, 1)))
        total = state[f"features.{index}.bias"].double().numpy()[:, None, None]
        for i in range(3):
            for j in range(3):
                total = total + np.tensordot(weight[:, :, i, j], around[:, i : i + height, j : j + width], 1)
        x = np.maximum(total, 0)
        if index in LAYERS:
            layers[LAYERS[index]] = x
    return layers


def agree(found: dict[str, Tensor], expected: dict[str, np.ndarray]) -> None:
    assert list(found) == list(expected)
    for name, layer in found.items():
        assert layer.shape[1:] == expected[name].shape
        # float32 sums of up to 4608 products, ten layers deep: 5e-7 measured, and 1 for a kernel that is turned.
        assert np.abs(layer[0].numpy() - expected[name]).max() < 1e-5 * expected[name].max(), name


# ---- the values ----------------------------------------------------------------------------------------------------


def test_values_of_each_layer(features: VGG16Features, state: dict[str, Tensor]):
    picture = pictures(2, 3, 32, 40)
    found = features(picture)
    assert {name: tuple(layer.shape) for name, layer in found.items()} == {
        "relu1_2": (2, 64, 32, 40), "relu2_2": (2, 128, 16, 20), "relu3_3": (2, 256, 8, 10), "relu4_3": (2, 512, 4, 5),
    }  # fmt: skip
    for index in range(2):
        agree({name: layer[index : index + 1] for name, layer in found.items()}, by_numpy(picture[index], state))


def test_average_pooling(file: Path, features: VGG16Features, state: dict[str, Tensor]):
    picture = pictures(1, 3, 32, 32)
    average = VGG16Features(file, pool="avg", precision="float32")
    agree(average(picture), by_numpy(picture[0], state, pool="avg"))
    assert average.name == features.name + "-avg"  # a run is not resumed with the other


def test_all_files_of_the_same_weights_agree(features: VGG16Features, state: dict[str, Tensor], tmp_path: Path):
    picture = pictures(1, 3, 32, 32)
    expected = features(picture)
    torch.save(state, tmp_path / "old.pt", _use_new_zipfile_serialization=False)  # as torchvision's own is
    save_file(state, tmp_path / "weights.safetensors")
    for name in ("old.pt", "weights.safetensors"):
        found = VGG16Features(str(tmp_path / name), precision="float32")(picture)
        assert all(torch.equal(found[layer], expected[layer]) for layer in expected)


def test_files_in_half_precision_are_read(state: dict[str, Tensor], tmp_path: Path):
    short = {name: tensor.half() for name, tensor in state.items()}
    torch.save(short, tmp_path / "half.pth")
    found = VGG16Features(tmp_path / "half.pth", precision="float32")
    assert {parameter.dtype for parameter in found.parameters()} == {torch.float32}
    picture = pictures(1, 3, 32, 32)
    agree(found(picture), by_numpy(picture[0], short))


def test_reading_draws_nothing(file: Path):
    torch.manual_seed(3)
    before = torch.get_rng_state()
    VGG16Features(file)
    assert torch.equal(torch.get_rng_state(), before)


def test_it_is_frozen_and_stands_under_torchvisions_names(features: VGG16Features, state: dict[str, Tensor]):
    own = features.state_dict()
    assert list(own) == [name for name in state if name in own]
    assert len(own) == 2 * len(SHAPES)  # nothing behind relu4_3, and no buffer that a checkpoint would carry
    assert all(torch.equal(own[name], state[name]) for name in own)
    assert not any(parameter.requires_grad for parameter in features.parameters())


def test_fingerprint_is_the_files(file: Path, features: VGG16Features):
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    assert features.fingerprint == digest[:16]
    assert features.name == f"vgg16-{digest[:8]}"


def test_mixed_precision(file: Path, features: VGG16Features, hardware: torch.device):
    picture = pictures(1, 3, 64, 64)
    exact = features(picture)
    for precision in (None, "bfloat16"):
        found = VGG16Features(file, precision=precision).to(hardware)(picture.to(hardware))
        for name, layer in found.items():
            error = (layer.cpu() - exact[name]).abs().max() / exact[name].max()
            assert layer.dtype == torch.float32
            if precision is None and hardware.type == "cpu":
                assert error == 0
            else:
                # bfloat16 has 8 bits: half a step is 2e-3, ten layers deep 4e-3 to 8e-3 measured
                assert 1e-3 < error < 3e-2


def test_float32_means_it_inside_autocast_too(features: VGG16Features):
    picture = pictures(1, 3, 32, 32)
    expected = features(picture)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = features(picture)
    assert all(torch.equal(found[name], expected[name]) for name in expected)


def test_gradient_to_the_picture(file: Path):
    """In float64 on a random direction, through convolutions, ReLUs and poolings: few kinks within 1e-6."""
    features = VGG16Features(file, precision="float32").double()
    picture = pictures(1, 3, 32, 32).double().requires_grad_()

    def means(x: Tensor) -> tuple[Tensor, ...]:
        layers = features(x)
        assert {layer.dtype for layer in layers.values()} == {torch.float64}
        return tuple(layer.square().mean() for layer in layers.values())

    assert torch.autograd.gradcheck(means, picture, eps=1e-7, atol=1e-6, rtol=1e-4, fast_mode=True)


# ---- in the loss ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("statistic", ["moments", "gram"])
def test_in_the_loss(features: VGG16Features, statistic: str):
    style = painting("strokes", size=64)
    loss = StyleLoss(style, features=features, statistic=statistic, content_by="features", content=0.5)
    own = loss.terms(style[None], style[None])
    assert own["content"] == 0
    # 0 measured; another painting's loss is .6 to .9 of that of noise, these weights being random.
    noise = pictures(1, 3, 64, 64).requires_grad_()
    other = loss.terms(noise, style[None])
    assert own["style"] < 1e-9 * other["style"]
    assert loss.terms(painting("mosaic", size=64)[None], style[None])["style"] > 0.1 * other["style"]
    expected = 0.5 * (features(noise)["relu3_3"] - features(style[None])["relu3_3"]).square().mean()
    assert other["content"].item() == pytest.approx(expected.item(), rel=1e-6)
    sum(other.values()).backward()
    assert noise.grad.isfinite().all()
    assert noise.grad.abs().max() > 0


def test_natural_is_the_variance_on_the_builtin_photographs(features: VGG16Features, state: dict[str, Tensor]):
    variances = []
    for read in PHOTOGRAPHS.values():
        photograph = np.asarray(read()[0])
        top, left = ((size - 128) // 2 for size in photograph.shape[:2])
        crop = torch.tensor(photograph[top : top + 128, left : left + 128] / 255).permute(2, 0, 1)
        variances.append(by_numpy(crop, state))
    for name, natural in features.natural.items():
        pooled = np.concatenate([layers[name].reshape(len(layers[name]), -1) for layers in variances], axis=1)
        assert natural == pytest.approx(pooled.var(1).mean(), rel=0.05)  # it is rounded to two digits


@pytest.mark.parametrize("level", [0.0, 0.5, 1.0])
def test_flat_styles_stay_finite(features: VGG16Features, level: float):
    loss = StyleLoss(torch.full((3, 64, 64), level), features=features, content=0)
    for picture in (torch.full((1, 3, 64, 64), 0.3), pictures(1, 3, 64, 64)):
        picture.requires_grad_()
        value = loss(picture)
        value.backward()
        # Noise on gray 1900, all others under 50: its variance is divided by a tenth of a photograph's, not by 0.
        assert value < 1e4
        assert picture.grad.isfinite().all()


# ---- wrong calls and wrong files -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("picture", "error", "message"),
    [
        (torch.rand(1, 3, 36, 32), ValueError, "36 x 32 has no features: both sides must be multiples of 8"),
        (torch.rand(1, 3, 24, 24), ValueError, "at least 32 pixels. Crop or resize it, to 32 x 32"),
        (torch.rand(3, 32, 32), ValueError, "shape (3, 32, 32), expected 3 channels: (B,C,H,W). Use picture[None]."),
        (torch.zeros(1, 3, 32, 32, dtype=torch.uint8), TypeError, "tensor (1, 3, 32, 32) of torch.uint8. Use picture"),
    ],
)
def test_wrong_pictures(features: VGG16Features, picture: Tensor, error: type[Exception], message: str):
    with pytest.raises(error, match=re.escape(message)):
        features(picture)


def test_wrong_options(file: Path):
    with pytest.raises(ValueError, match="unknown pool 'mean'; known: max, avg"):
        VGG16Features(file, pool="mean")
    with pytest.raises(ValueError, match="unknown precision 'half'; known: None, float32, bfloat16"):
        VGG16Features(file, precision="half")


def test_no_file(tmp_path: Path):
    message = "vgg.pth. The weights of VGG16 are torchvision's vgg16-397923af.pth: see"
    with pytest.raises(FileNotFoundError, match=f"there is no file .*{re.escape(message)}") as caught:
        VGG16Features(tmp_path / "vgg.pth")
    assert "SteerableFeatures, the default, needs none" in str(caught.value)
    with pytest.raises(FileNotFoundError, match=f"{tmp_path.name} is a folder"):
        VGG16Features(tmp_path)


def without(name: str) -> Callable[[dict[str, Any]], object]:
    return lambda state: {key: value for key, value in state.items() if key != name}


def holding(name: str, value: object) -> Callable[[dict[str, Any]], object]:
    return lambda state: state | {name: value}


def poisoned(value: float) -> Callable[[dict[str, Any]], object]:
    def change(state: dict[str, Any]) -> object:
        weight = state["features.12.weight"].clone()
        weight[3, 4, 1, 1] = value
        return state | {"features.12.weight": weight}

    return change


KEY = "features.12.weight"
WRONG_CONTENTS = {
    "missing": (without(KEY), "has no features.12.weight, expected (256, 256, 3, 3); it has features.0.weight, "),
    "missing bias": (without("features.21.bias"), "has no features.21.bias, expected (512,)"),
    "shape": (holding(KEY, torch.ones(256, 128, 3, 3)), f"{KEY} has shape (256, 128, 3, 3), expected (256, 256, 3, 3)"),
    "integers": (holding(KEY, torch.ones(256, 256, 3, 3, dtype=torch.int8)), f"{KEY} is a torch.strided torch.int8, "),
    "sparse": (holding("features.0.bias", torch.ones(64).to_sparse()), "features.0.bias is a torch.sparse_coo torch"),
    "text": (holding(KEY, "weights"), f"{KEY} is a str, expected a dense tensor of floating-point numbers"),
    "nan": (poisoned(math.nan), f"{KEY} has 1 of 589824 values that are not finite in float32, expected none"),
    "infinite": (poisoned(math.inf), f"{KEY} has 1 of 589824 values that are not finite"),
    "a tensor": (lambda state: state[KEY], "holds a Tensor, expected names and tensors"),
    "a list": (lambda state: list(state.values()), "holds a list, expected names and tensors"),
    "empty": (lambda state: {}, "has no features.0.weight, expected (64, 3, 3, 3); it has nothing"),
    "wrapped": (lambda state: {"state_dict": state, "epoch": 3}, "has no features.0.weight, expected (64, 3, 3, 3); it "
                "has state_dict, epoch .. Use the state dict of torchvision's vgg16, such as vgg16-397923af.pth"),
    "batch norm": (
        lambda state: {"features.0.weight": state["features.0.weight"], "features.0.bias": state["features.0.bias"],
                       "features.1.weight": torch.ones(64), "features.3.weight": torch.ones(64, 64, 3, 3)},
        "has no features.2.weight, expected (64, 64, 3, 3)",
    ),
    "all zero": (
        lambda state: {key: torch.zeros_like(value) for key, value in state.items()},
        "on photographs its layer relu1_2 has a variance of 0, expected a finite one above 0: these are no trained",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG_CONTENTS)
def test_wrong_contents(state: dict[str, Tensor], tmp_path: Path, case: str):
    change, message = WRONG_CONTENTS[case]
    path = tmp_path / "wrong.pth"
    torch.save(change(state), path)
    with pytest.raises(ValueError, match=re.escape(message)) as caught:
        VGG16Features(path)
    text = str(caught.value)
    assert str(path) in text
    assert "vgg16-397923af.pth" in text
    assert "\n" not in text


def test_wrong_safetensors(state: dict[str, Tensor], tmp_path: Path):
    save_file({key: value for key, value in state.items() if key != KEY}, tmp_path / "less.safetensors")
    with pytest.raises(ValueError, match=re.escape(f"less.safetensors has no {KEY}, expected")):
        VGG16Features(tmp_path / "less.safetensors")
    whole = (tmp_path / "less.safetensors").read_bytes()
    (tmp_path / "cut.safetensors").write_bytes(whole[:-100])
    with pytest.raises(ValueError, match=r"cut.safetensors is not a whole safetensors file \(.*\). Get it again"):
        VGG16Features(tmp_path / "cut.safetensors")


class Writes:
    """Unpickled, it writes a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple:
        return Path.write_text, (self.path, "run")


@pytest.mark.parametrize("kind", ["code", "module"])
def test_code_in_a_file_is_not_run(tmp_path: Path, kind: str):
    path = tmp_path / "code.pth"
    torch.save({"features.0.weight": Writes(tmp_path / "ran")} if kind == "code" else nn.Linear(2, 2), path)
    with pytest.raises(ValueError, match="code.pth is damaged, or holds more than tensors: pickled objects"):
        VGG16Features(path)
    assert not (tmp_path / "ran").exists()


DAMAGES = {
    "half": lambda whole: whole[: len(whole) // 2],
    "less one": lambda whole: whole[:-1],
    "empty": lambda whole: b"",
    "zeros": lambda whole: bytes(1000),
    "text": lambda whole: b"hello, this is text",
    "page": lambda whole: b"<!DOCTYPE html><html><body>404</body></html>" * 20,
}


@pytest.mark.parametrize("zipped", [True, False], ids=["zip", "tar"])
@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_files(state: dict[str, Tensor], tmp_path: Path, damage: str, zipped: bool):
    path = tmp_path / "weights.pth"
    torch.save(state, path, _use_new_zipfile_serialization=zipped)
    path.write_bytes(DAMAGES[damage](path.read_bytes()))
    with pytest.raises(ValueError, match="weights.pth is damaged, or ") as caught:
        VGG16Features(path)
    assert "\n" not in str(caught.value)


def test_the_hash_in_a_name_is_checked(file: Path, tmp_path: Path):
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    right = tmp_path / f"vgg16-{digest[:8]}.pth"
    right.symlink_to(file)
    assert VGG16Features(right).fingerprint == digest[:16]
    wrong = tmp_path / "vgg16-397923af.pth"
    wrong.symlink_to(file)
    message = f"its name says that its sha256 begins with 397923af, and it begins with {digest[:8]}: it is damaged, or"
    with pytest.raises(ValueError, match=re.escape(message)):
        VGG16Features(wrong)
