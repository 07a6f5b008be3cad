"""Checkpoints: exact, whole or not there whenever the process dies, and never believed when they are damaged."""

from __future__ import annotations

import contextlib
import json
import math
import random
import re
import signal
import subprocess
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from deaths import Death, Killed, PowerCut
from torch import Tensor, nn

from kcam.style import checkpoints
from kcam.style.checkpoints import Checkpoint, Checkpoints
from kcam.style.generators import philox
from kcam.style.optimiser import load_optimiser_state, optimiser_state


def content(step: int, run: int = 0) -> dict:
    """What is saved at a step, so that it can be told from every other."""
    generator = torch.Generator().manual_seed(1000 * run + step)
    tensors = {"weight": torch.rand(40, 5, generator=generator), "seen": torch.tensor(step)}
    return {"tensors": tensors, "document": {"step": step, "run": run, "loss": 1 / (step + 3)}}


def same(found: Checkpoint | None, step: int, run: int = 0) -> bool:
    expected = content(step, run)
    return (
        found is not None
        and found.step == step
        and found.document == expected["document"]
        and found.tensors.keys() == expected["tensors"].keys()
        and all(torch.equal(found.tensors[name], tensor) for name, tensor in expected["tensors"].items())
    )


def filled(folder: Path, *steps: int, keep: int = 3) -> Checkpoints:
    store = Checkpoints(folder, keep=keep)
    for step in steps:
        store.save(step, **content(step))
    return store


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def aside(folder: Path) -> list[Path]:
    return list(folder.glob(".corrupt-*"))


# ---- what goes in comes out ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", sorted(checkpoints.DTYPES, key=str), ids=str)
def test_every_dtype_comes_back_bit_by_bit(tmp_path: Path, dtype: torch.dtype):
    tensors = {
        "plain": torch.arange(-6, 6).reshape(3, 4).to(dtype),
        "scalar": torch.tensor(1).to(dtype),
        "empty": torch.zeros(0, 3).to(dtype),
        "turned": torch.arange(12).reshape(3, 4).to(dtype).T,
        "spread": torch.ones(1, 3).to(dtype).expand(4, 3),
    }
    if dtype.is_floating_point:
        tensors["odd"] = torch.tensor([math.nan, math.inf, -math.inf, -0.0, torch.finfo(dtype).tiny / 2], dtype=dtype)
    store = Checkpoints(tmp_path)
    store.save(0, tensors=tensors, document={})
    found = store.latest().tensors
    assert found.keys() == tensors.keys()
    for name, tensor in tensors.items():
        assert found[name].dtype == dtype
        assert found[name].shape == tensor.shape
        assert torch.equal(found[name].flatten().view(torch.uint8), tensor.flatten().view(torch.uint8)), name


def test_shared_tensors_and_parameters(tmp_path: Path):
    layer = nn.Linear(3, 3)
    whole = torch.rand(6)
    tensors = {"a": layer.weight, "b": layer.weight, "view": whole[2:4], "whole": whole}
    tensors["negated"] = torch.complex(whole, whole).conj().imag  # a view whose bytes are not its values
    store = Checkpoints(tmp_path)
    store.save(0, tensors=tensors, document={})
    found = store.latest().tensors
    assert all(torch.equal(found[name], tensor) for name, tensor in tensors.items())
    assert not any(tensor.requires_grad for tensor in found.values())
    found["a"] += 1  # writable, and its own
    assert torch.equal(found["b"], layer.weight)


def test_saved_from_a_device(tmp_path: Path, device: torch.device):
    tensor = torch.rand(4, 4, device=device)
    store = Checkpoints(tmp_path)
    store.save(0, tensors={"x": tensor}, document={})
    found = store.latest().tensors["x"]
    assert found.device.type == "cpu"
    assert torch.equal(found, tensor.cpu())


def test_tensors_stand_under_their_names(tmp_path: Path):
    """safetensors sorts by dtype and name: who zips values to parameters mixes them up."""
    tensors = {name: torch.full((2,), float(index)) for index, name in enumerate(["z", "a.b", "m/n", "ü"])}
    tensors["first"] = torch.zeros(3, dtype=torch.float64)
    store = Checkpoints(tmp_path)
    store.save(0, tensors=tensors, document={})
    found = store.latest().tensors
    assert all(torch.equal(found[name], tensor) for name, tensor in tensors.items())


def test_document_comes_back_exactly(tmp_path: Path):
    floats = [0.1, 1 / 3, 1e-323, 1.7976931348623157e308, -0.0, math.inf, -math.inf]
    document = {"floats": floats, "odd": {"text": 'ü"\n\ud800', "none": None, "yes": True, "big": 2**70}, "empty": {}}
    store = Checkpoints(tmp_path)
    path = store.save(0, tensors={}, document=document | {"nan": math.nan, "pair": (0.5, 0.999)})
    found = store.latest().document
    assert math.isnan(found.pop("nan"))
    assert found.pop("pair") == [0.5, 0.999]
    assert found == document
    assert math.copysign(1, found["floats"][4]) == -1

    def refuse(text: str) -> None:
        raise AssertionError(f"{text} is not JSON")

    json.loads((path / "state.json").read_text(), parse_constant=refuse)


@pytest.mark.parametrize(
    ("document", "message"),
    [
        ({"a": [torch.ones(1)]}, "cannot save document['a'][0]: tensor([1.]) is a Tensor, and must be None, bool"),
        ({"a": {1: 2}}, "cannot save document['a']: {1: 2} is a dict, and must be None, bool"),
        ({"a": {"float": "nan"}}, '(and not the one key "float")'),
        ({"a": {1, 2}}, "is a set"),
    ],
)
def test_documents_that_would_change(tmp_path: Path, document: dict, message: str):
    store = Checkpoints(tmp_path)
    with pytest.raises(TypeError, match=re.escape(message)):
        store.save(0, tensors={}, document=document)
    assert names(tmp_path) == []


@pytest.mark.parametrize(
    ("name", "tensor", "error", "message"),
    [
        ("x", [1.0], TypeError, "cannot save 'x': it is a list, and must be a dense tensor of real numbers or bool."),
        ("x", torch.eye(2).to_sparse(), TypeError, "it is torch.sparse_coo of torch.float32, and must be a dense"),
        ("x", torch.zeros(1, dtype=torch.complex128), TypeError, "it is torch.strided of torch.complex128"),
        ("__metadata__", torch.ones(1), ValueError, "its name must be a str, not __metadata__. Rename it."),
        (3, torch.ones(1), ValueError, "cannot save the tensor 3: its name must be a str"),
    ],
)
def test_tensors_that_cannot_be_saved(tmp_path: Path, name, tensor, error: type[Exception], message: str):
    store = Checkpoints(tmp_path)
    with pytest.raises(error, match=re.escape(message)):
        store.save(0, tensors={name: tensor}, document={})
    assert names(tmp_path) == []


@pytest.mark.parametrize("step", [-1, 1.0, "1", True, None])
def test_steps_that_are_none(tmp_path: Path, step: object):
    with pytest.raises(ValueError, match=re.escape(f"step must be a whole number of at least 0, got {step!r}. Use")):
        Checkpoints(tmp_path).save(step, tensors={}, document={})


@pytest.mark.parametrize("keep", [0, -1, 1.5, True])
def test_keep_at_least_one(tmp_path: Path, keep: object):
    with pytest.raises(ValueError, match=f"keep must be a whole number of at least 1, got {keep}. Use keep=3"):
        Checkpoints(tmp_path, keep=keep)


def test_a_file_is_no_folder(tmp_path: Path):
    (tmp_path / "run").write_text("")
    with pytest.raises(ValueError, match="run is a file, and checkpoints need a folder. Choose another name."):
        Checkpoints(tmp_path / "run")


# ---- which there are -----------------------------------------------------------------------------------------------


def test_newest_and_the_ones_before(tmp_path: Path):
    store = filled(tmp_path / "a" / "b", 0, 5, 1_000_000)
    assert names(store.folder) == ["step-000000", "step-000005", "step-1000000"]
    assert store.steps() == [0, 5, 1_000_000]
    assert same(store.latest(), 1_000_000)
    assert store.latest().path == store.folder / "step-1000000"
    assert same(store.latest(before=1_000_000), 5)
    assert same(store.latest(before=5), 0)
    assert store.latest(before=0) is None
    assert Checkpoints(tmp_path / "new").latest() is None


def test_last_ones_and_the_best_stay(tmp_path: Path):
    store = Checkpoints(tmp_path, keep=2)
    for step in range(8):
        store.save(step, **content(step), best=step in (1, 3))
        assert store.best() is None if step < 1 else same(store.best(), 1 if step < 3 else 3)
    assert names(tmp_path) == ["step-000003", "step-000006", "step-000007"]
    assert same(Checkpoints(tmp_path).best(), 3)  # it is on the disk, not in the object
    assert Checkpoints(tmp_path).best().best
    assert not store.latest().best


def test_best_among_the_last_takes_no_place_of_its_own(tmp_path: Path):
    store = Checkpoints(tmp_path, keep=2)
    for step in range(4):
        store.save(step, **content(step), best=True)
    assert store.steps() == [2, 3]


def test_a_damaged_best_is_none(tmp_path: Path):
    store = Checkpoints(tmp_path, keep=1)
    store.save(0, **content(0), best=True)
    store.save(1, **content(1))
    (tmp_path / "step-000000" / "state.json").write_text("{}")
    with pytest.warns(UserWarning, match="step-000000 is damaged"):
        assert store.best() is None
    assert same(store.latest(), 1)


def test_the_same_step_again(tmp_path: Path):
    store = filled(tmp_path, 1)
    store.save(2, **content(2), best=True)
    store.save(2, **content(2, run=1))
    assert same(store.latest(), 2, run=1)
    assert store.latest().best  # as after a resume, which cannot know
    assert names(tmp_path) == ["step-000001", "step-000002"]


def test_going_back(tmp_path: Path):
    store = filled(tmp_path, 1, 2, 3)
    message = "already holds step 3. If the run went back, call discard(after=2) first; if it is another run, give it"
    with pytest.raises(ValueError, match=re.escape(message)):
        store.save(2, **content(2, run=1))
    store.discard(after=1)
    assert names(tmp_path) == ["step-000001"]
    store.save(2, **content(2, run=1))
    assert same(store.latest(), 2, run=1)


# ---- damage --------------------------------------------------------------------------------------------------------

FILES = ["tensors.safetensors", "state.json", "MANIFEST.json"]


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-2])  # the last is the line's end, and says nothing


def lengthen(path: Path) -> None:
    path.write_bytes(path.read_bytes() + b" ")


def empty(path: Path) -> None:
    path.write_bytes(b"")


def nothing_but_zeros(path: Path) -> None:
    path.write_bytes(bytes(path.stat().st_size))


DAMAGES = [truncate, lengthen, empty, nothing_but_zeros, Path.unlink]


@pytest.mark.parametrize("damage", DAMAGES, ids=lambda damage: damage.__name__)
@pytest.mark.parametrize("file", FILES)
def test_a_damaged_one_is_set_aside(tmp_path: Path, file: str, damage: Callable[[Path], None]):
    store = filled(tmp_path, 1, 2, 3)
    damage(store.latest().path / file)
    if (file, damage) == ("MANIFEST.json", lengthen):
        assert same(store.latest(), 3)  # a blank more changes nothing that it says
        return
    with pytest.warns(UserWarning, match=rf"checkpoint .*step-000003 is damaged: .*{file}.* It is now \.corrupt-step-"):
        assert same(store.latest(), 2)
    assert len(aside(tmp_path)) == 1
    store.save(3, **content(3, run=1))
    assert same(Checkpoints(tmp_path).latest(), 3, run=1)


def test_any_flipped_byte_is_found(tmp_path: Path):
    store = filled(tmp_path, 1, 2)
    draw = random.Random(0)
    for file in FILES:
        path = tmp_path / "step-000002" / file
        whole = path.read_bytes()
        places = range(len(whole)) if file == "MANIFEST.json" else sorted(draw.sample(range(len(whole)), 20))
        for place in places:
            flipped = bytearray(whole)
            flipped[place] ^= 1 << draw.randrange(8)
            path.write_bytes(flipped)
            with pytest.warns(UserWarning, match="step-000002 is damaged"):
                assert same(store.latest(), 1), (file, place)
            aside(tmp_path)[0].rename(tmp_path / "step-000002")
        path.write_bytes(whole)
    assert same(store.latest(), 2)


@pytest.mark.parametrize("text", ["", "[]", "3", "null", "{}", '{"sha256": 1}', "\xff", "{"])
def test_manifests_that_are_none(tmp_path: Path, text: str):
    store = filled(tmp_path, 1, 2)
    (tmp_path / "step-000002" / "MANIFEST.json").write_text(text, encoding="latin-1")
    with pytest.warns(UserWarning, match=re.escape("is damaged: its MANIFEST.json")):
        assert same(store.latest(), 1)


def test_what_stands_where_a_checkpoint_should(tmp_path: Path):
    store = filled(tmp_path, 1, keep=4)
    (tmp_path / "step-000002").mkdir()
    (tmp_path / "step-000003").write_text("a file")
    (tmp_path / "step-000001").rename(tmp_path / "step-000004")  # a copy under another name is not that step
    store.save(5, **content(5))
    for other in ("step-7", "step-0000008", "notes", "step-00000x"):
        (tmp_path / other).mkdir()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert store.latest(before=5) is None
    reasons = ["it is the checkpoint of step 1", "it has no MANIFEST.json", "it has no MANIFEST.json"]
    assert [str(warning.message).split(": ")[1].split(". It is now")[0] for warning in caught] == reasons
    assert {warning.filename for warning in caught} == {__file__}
    assert len(aside(tmp_path)) == 3
    assert same(store.latest(), 5)


def test_all_damaged(tmp_path: Path):
    store = filled(tmp_path, 1, 2)
    for path in tmp_path.glob("step-*/MANIFEST.json"):
        path.unlink()
    with pytest.warns(UserWarning, match=r"step-00000[12] is damaged: it has no MANIFEST.json"):
        assert store.latest() is None
    assert len(aside(tmp_path)) == 2


def test_saving_to_a_damaged_step(tmp_path: Path):
    """Left by a run that was not asked for its latest: a folder in the way would make the rename fail."""
    store = filled(tmp_path, 1, 2)
    truncate(tmp_path / "step-000002" / "tensors.safetensors")
    with pytest.warns(UserWarning, match="step-000002 is damaged: its tensors.safetensors has"):
        store.save(2, **content(2, run=1))
    assert same(store.latest(), 2, run=1)
    assert len(aside(tmp_path)) == 1


def test_a_newer_format_is_not_damage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    with monkeypatch.context() as newer:
        newer.setattr(checkpoints, "FORMAT", 9)
        filled(tmp_path, 1)
    with pytest.raises(ValueError, match="step-000001 has format 9; this kcam reads up to format 1. Update kcam."):
        Checkpoints(tmp_path).latest()
    assert names(tmp_path) == ["step-000001"]


def test_leftovers_are_cleared_up(tmp_path: Path):
    filled(tmp_path, 1, 2)
    (tmp_path / ".tmp-step-000003-0123abcd").mkdir()
    (tmp_path / ".tmp-step-000003-0123abcd" / "state.json").write_text("{")
    (tmp_path / ".corrupt-step-000001-0123abcd").mkdir()  # for a person to look at
    (tmp_path / ".hidden").mkdir()
    assert same(Checkpoints(tmp_path).latest(), 2)
    assert names(tmp_path) == [".corrupt-step-000001-0123abcd", ".hidden", "step-000001", "step-000002"]


# ---- death ---------------------------------------------------------------------------------------------------------

SITUATIONS = {
    "the first": ([], 1, 3),
    "one more": ([1, 2], 3, 3),
    "one more, three go": ([1, 2, 3], 4, 1),  # keep=1, yet 1 to 3 are there: saved with more
    "the same step": ([1, 2], 2, 3),
    "the same step, the only one": ([2], 2, 1),
}


HOW = ("before", "after", "power cut before", "power cut after")


@pytest.mark.parametrize(
    ("situation", "how"),
    [  # of each way two or three situations, and of each situation two ways are among the quick tests
        pytest.param(situation, how, marks=[pytest.mark.slow] if (row + column) % 2 else [])
        for row, situation in enumerate(SITUATIONS)
        for column, how in enumerate(HOW)
    ],
)
def test_death_at_every_change_of_the_disk(tmp_path: Path, situation: str, how: str):
    """After each of them the newest is the one before or the new one, never less, and nothing is left over."""
    before, step, keep = SITUATIONS[situation]
    deaths, outcomes = 0, []
    while True:
        folder = tmp_path / str(deaths)
        filled(folder, *before)
        store = Checkpoints(folder, keep=keep)
        with pytest.MonkeyPatch.context() as patch:
            after = "after" in how
            if "power" in how:
                death = PowerCut(patch, deaths, after=after, folder=folder)
            else:
                death = Death(patch, deaths, after=after)
            with contextlib.suppress(Killed):
                store.save(step, **content(step, run=1))
        again = Checkpoints(folder, keep=keep)
        found = again.latest()
        outcomes.append(same(found, step, run=1))
        assert outcomes[-1] or (found is None and not before) or same(found, before[-1]), deaths
        assert all(name.startswith("step-") for name in names(folder)), deaths
        for number in again.steps():
            assert again.latest(before=number + 1).step == number  # whole, all of them: a warning would be an error
        again.save(step, **content(step, run=1))
        assert same(again.latest(), step, run=1)
        if not death.dead:
            break
        deaths += 1
    # a folder, three files and it on the disk, a rename, the folder above on the disk: 7 at least
    assert deaths >= 7
    assert outcomes == sorted(outcomes)  # old, old, ..., new, new
    assert not outcomes[0]
    assert outcomes[-1]


@pytest.mark.parametrize("after", [False, True])
def test_death_while_going_back_or_clearing_up(tmp_path: Path, after: bool):
    """The later ones go first, so what is left is a run that ended there."""
    deaths = 0
    while True:
        folder = tmp_path / str(deaths)
        filled(folder, 1, 2, 3)
        with pytest.MonkeyPatch.context() as patch:
            death = Death(patch, deaths, after=after)
            with contextlib.suppress(Killed):
                Checkpoints(folder).discard(after=1)
        with pytest.MonkeyPatch.context() as patch, contextlib.suppress(Killed):  # and while that is cleared up
            Death(patch, 1, after=after)
            Checkpoints(folder)
        again = Checkpoints(folder)
        assert again.steps() in ([1], [1, 2], [1, 2, 3])
        assert same(again.latest(), again.steps()[-1])
        if not death.dead:
            break
        deaths += 1
    assert again.steps() == [1]
    assert deaths >= 8  # two folders of three files: renamed, emptied, removed


@pytest.mark.parametrize("number", range(5))
def test_a_full_disk_leaves_all_as_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int):
    """An error, not a death: the process lives on, and the room that the half checkpoint took is free again."""
    store, left, whole = filled(tmp_path, 1, 2), [number], checkpoints._write

    def write(path: Path, held: bytes) -> None:
        left[0] -= 1
        if left[0] < 0:
            path.write_bytes(held[: len(held) // 2])
            raise OSError(28, "No space left on device")
        whole(path, held)

    monkeypatch.setattr(checkpoints, "_write", write)
    for step in (2, 3):
        if left[0] >= 0 and left[0] >= len(FILES):
            store.save(step, **content(step))
            continue
        with pytest.raises(OSError, match="No space left"):
            store.save(step, **content(step, run=1))
        assert same(store.latest(), step if step == 2 else 2)
        assert names(tmp_path) == ["step-000001", "step-000002"]
    monkeypatch.undo()
    store.save(3, **content(3))
    assert same(store.latest(), 3)


WRITER = """
import os, sys, time
from pathlib import Path
sys.path += sys.argv[2:]
from test_checkpoints import content
from kcam.style.checkpoints import Checkpoints
fsync = os.fsync
os.fsync = lambda opened: (time.sleep(0.01), fsync(opened))  # a slow disk: most of the time passes within a save
store = Checkpoints(sys.argv[1], keep=2)
found = store.latest()
step = 0 if found is None else found.step
print(step, flush=True)
while True:
    store.save(step, **content(step), best=step % 5 == 0)  # the same again first, as a resumed run may
    step += 1
"""


def wait_for_step(folder: Path, step: int, process: subprocess.Popen) -> None:
    late = time.monotonic() + 60
    while process.poll() is None and time.monotonic() < late:
        if any(int(name[5:]) >= step for name in names(folder) if name.startswith("step-")):
            return
        time.sleep(0.002)


@pytest.mark.slow  # 5 processes that import torch
def test_sigkill_at_random_moments(tmp_path: Path):
    draw, met, began = random.Random(0), set(), []
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    tests = Path(__file__).parents[1]
    for _ in range(5):
        command = [sys.executable, "-c", WRITER, tmp_path / "run", tests, tests / "style"]
        with subprocess.Popen(command, **pipes) as process:
            line = process.stdout.readline()
            wait_for_step(tmp_path / "run", int(line or 0) + 2, process)
            time.sleep(0.2 * draw.random())
            process.send_signal(signal.SIGKILL)
            _, errors = process.communicate(timeout=300)
        began.append(int(line or -1))
        assert process.returncode == -signal.SIGKILL, errors
        met.update(re.sub("[0-9a-f]{8}$", "", name) for name in names(tmp_path / "run") if name.startswith("."))
        store = Checkpoints(tmp_path / "run", keep=2)
        found = store.latest()
        assert found is not None
        assert same(found, found.step)
        assert same(store.best(), found.step - found.step % 5)
        assert len(store.steps()) <= 4  # two, the best, and the new one if the kill came before the pruning
        assert aside(tmp_path / "run") == []
    assert began == sorted(began)
    assert began[-1] > began[1] > 0, "the runs got nowhere"
    assert met, "no kill met a save: write more"


# ---- the optimiser -------------------------------------------------------------------------------------------------


def model(width: int = 4) -> nn.Sequential:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return nn.Sequential(nn.Linear(3, width), nn.Tanh(), nn.Linear(width, 2), nn.PReLU())


def named(module: nn.Module) -> dict[Tensor, str]:
    return {parameter: name for name, parameter in module.named_parameters()}


def adam(module: nn.Module, **options) -> torch.optim.Optimizer:
    first, *rest = module.children()
    others = [parameter for part in rest for parameter in part.parameters()]
    groups = [{"params": list(first.parameters()), "lr": 1 / 300}, {"params": others, "weight_decay": 1e-4}]
    return torch.optim.Adam(groups, lr=1e-3, betas=(0.5, 0.999), **options)


def train(module: nn.Module, optimiser: torch.optim.Optimizer, steps: range) -> list[float]:
    losses = []
    for step in steps:
        optimiser.param_groups[0]["lr"] = 1e-2 / (step + 1)
        batch = torch.from_numpy(philox(3, step).standard_normal((5, 3))).float()
        loss = (module(batch) - batch[:, :2]).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    return losses


def adamw(module: nn.Module) -> torch.optim.Optimizer:
    return torch.optim.AdamW(module.named_parameters(), lr=1e-2, amsgrad=True, foreach=False)


def sgd(module: nn.Module) -> torch.optim.Optimizer:
    return torch.optim.SGD(module.parameters(), lr=1e-2, momentum=0.9)


@pytest.mark.parametrize("make", [adam, adamw, sgd], ids=lambda make: make.__name__)
def test_resumed_is_bit_by_bit_the_same_run(tmp_path: Path, make: Callable[[nn.Module], torch.optim.Optimizer]):
    straight = model()
    losses = train(straight, make(straight), range(12))

    begun = model()
    optimiser = make(begun)
    first = train(begun, optimiser, range(7))
    tensors, document = optimiser_state(optimiser, named(begun))
    Checkpoints(tmp_path).save(7, tensors=begun.state_dict() | tensors, document={"optimiser": document})

    resumed = model()
    optimiser = make(resumed)
    train(resumed, optimiser, range(50, 53))  # a state that must all go
    found = Checkpoints(tmp_path).latest()
    resumed.load_state_dict({name: found.tensors[name] for name in resumed.state_dict()})
    load_optimiser_state(optimiser, named(resumed), found.tensors, found.document["optimiser"])
    kept = {name: tensor.clone() for name, tensor in found.tensors.items()}
    assert first + train(resumed, optimiser, range(7, 12)) == losses
    for name, tensor in straight.state_dict().items():
        assert torch.equal(tensor, resumed.state_dict()[name]), name
    # the checkpoint is still what was read: a run may go back to it twice
    assert all(torch.equal(found.tensors[name], tensor) for name, tensor in kept.items())


def test_state_is_found_by_name(tmp_path: Path):
    """Groups and parameters in another order: zipped, exp_avg of two tensors of one shape would change places."""
    saved = model(width=3)
    optimiser = adam(saved)
    train(saved, optimiser, range(3))
    tensors, document = optimiser_state(optimiser, named(saved))
    assert {"optimiser/0.weight/exp_avg", "optimiser/3.weight/step"} < tensors.keys()

    other = model(width=3)
    reverse = [{"params": group["params"][::-1]} for group in adam(other).param_groups[::-1]]
    turned = torch.optim.Adam(reverse, lr=7.0)
    backwards = {name: tensors[name] for name in sorted(tensors, reverse=True)}
    load_optimiser_state(turned, named(other), backwards, document)
    there = {name: parameter for parameter, name in named(saved).items()}
    for parameter, name in named(other).items():
        expected = optimiser.state[there[name]]
        assert turned.state[parameter].keys() == expected.keys() == {"step", "exp_avg", "exp_avg_sq"}
        assert all(torch.equal(turned.state[parameter][key], value) for key, value in expected.items())
    for old, new in zip(optimiser.param_groups, turned.param_groups[::-1], strict=True):
        assert {key: old[key] for key in old if key != "params"} == {key: new[key] for key in new if key != "params"}
        assert isinstance(new["betas"], tuple)


def test_parameters_that_never_had_a_gradient():
    module = model()
    optimiser = adam(module)
    module[3].requires_grad_(False)
    train(module, optimiser, range(2))
    tensors, document = optimiser_state(optimiser, named(module))
    assert document["state"]["3.weight"] == {}
    other = model()
    loaded = adam(other)
    load_optimiser_state(loaded, named(other), tensors, document)
    assert other[3].weight not in loaded.state
    assert len(loaded.state) == 4


def loaded_into(optimiser: torch.optim.Optimizer, names: dict[Tensor, str], *, lose: str = "") -> None:
    saved = model()
    own = adam(saved)
    train(saved, own, range(2))
    tensors, document = optimiser_state(own, named(saved))
    tensors.pop(lose, None)
    load_optimiser_state(optimiser, names, tensors, document)


def test_states_that_do_not_fit():
    module, wide, double = model(), model(width=5), model().double()
    optimiser = adam(module)
    for misfit, names, lose, message in [
        (adamw(module), named(module), "", "the state is of Adam, and the optimiser is AdamW. Use Adam."),
        (torch.optim.Adam(module.parameters()), named(module), "", "no saved group has the parameters ['0.bias', '0.w"),
        (adam(wide), named(wide), "", "exp_avg' is (4, 3) of torch.float32, and its parameter (5, 3) of torch.float32"),
        (adam(double), named(double), "", "its parameter (4, 3) of torch.float64: it is of another model. Build the"),
        (optimiser, named(module), "optimiser/2.bias/step", "the checkpoint lacks the tensor 'optimiser/2.bias/step'."),
        (optimiser, {}, "", "a parameter of shape (4, 3) has no name. Use names={p: name for name, p in"),
        (optimiser, dict.fromkeys(named(module), "x"), "", "a parameter of shape (4,) has the name 'x', which another"),
    ]:
        with pytest.raises(ValueError, match=re.escape(message)):
            loaded_into(misfit, names, lose=lose)
        assert not misfit.state, "half loaded"
    with pytest.raises(TypeError, match="cannot save the optimiser's lr: it is a tensor. Use a number, lr=1e-3."):
        optimiser_state(torch.optim.Adam(module.parameters(), lr=torch.tensor(1e-3), foreach=False), named(module))
