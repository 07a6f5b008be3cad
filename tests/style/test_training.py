"""Training: what it learns, that it goes on bit for bit, and what it does when something goes wrong."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
import warnings
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import pytest
import tiny
import torch
from torch import Tensor, nn

from kcam import isp, optics, sensor
from kcam.camera import Camera
from kcam.scene import Scene
from kcam.style import Settings, StyleLoss, StyleWarning, TrainingError, fit
from kcam.style import step as steps
from kcam.style.settings import trained_parameters
from kcam.style.step import gradients, photograph

PROGRAM = Path(__file__).with_name("training_process.py")


@pytest.fixture(scope="module")
def straight(tmp_path_factory) -> tuple[dict[str, Tensor], Tensor]:
    """Weights and loss curve of an uninterrupted run."""
    trained = train(tmp_path_factory.mktemp("straight"))
    return trained.camera.state_dict(), trained.history


def train(folder: Path | None, *, resume: bool = False, stop_after: int | None = None, loss=None, **changes):
    camera = tiny.camera()
    taken: list[int] = []

    def stop() -> bool:
        taken.append(1)
        return stop_after is not None and len(taken) >= stop_after

    return fit(
        camera,
        loss or tiny.loss(),
        source=tiny.source(),
        settings=tiny.settings(**changes),
        folder=folder,
        resume=resume,
        stop=stop,
    )


def same(trained, straight) -> bool:
    weights, history = straight
    state = trained.camera.state_dict()
    return torch.equal(trained.history, history) and all(torch.equal(state[name], weights[name]) for name in weights)


@pytest.mark.filterwarnings("ignore::kcam.style.StyleWarning")  # it may well look like a negative for a while
@pytest.mark.slow
def test_the_loss_falls_and_every_part_learns() -> None:
    camera = tiny.camera()
    before = {name: value.clone() for name, value in camera.state_dict().items()}
    trained = fit(camera, tiny.loss(), source=tiny.source(), settings=tiny.settings(steps=24))
    curve = trained.history[:, 0]
    assert curve[-6:].mean() < 0.9 * curve[:5].mean()
    for part, named in trained_parameters(camera, tiny.settings()).items():
        moved = [float((camera.state_dict()[name] - before[name]).abs().max()) for name, _ in named]
        assert max(moved) > 1e-4, part
    assert trained.finished
    assert trained.steps_timed == 24
    assert set(trained.profile) == {"scenes", "camera", "loss", "gradient", "update"}
    assert trained.names == ("total", "style", "colour", "content")
    assert torch.allclose(trained.history[:, 0], trained.history[:, 1:].sum(1), rtol=1e-5)


def test_only_parts_with_a_rate_train() -> None:
    camera = tiny.camera()
    before = {name: value.clone() for name, value in camera.state_dict().items()}
    fit(camera, tiny.loss(), source=tiny.source(), settings=tiny.settings(steps=3, rates={"filter": 0.05}))
    changed = {name for name, value in camera.state_dict().items() if not torch.equal(value, before[name])}
    assert changed == {"stages.1.coefficients"}


@pytest.mark.parametrize("stop_after", [3, *(pytest.param(n, marks=pytest.mark.slow) for n in (1, 5))])
def test_resumed_equals_uninterrupted(tmp_path: Path, straight, stop_after: int) -> None:
    first = train(tmp_path, stop_after=stop_after)
    assert not first.finished
    assert len(first.history) == stop_after
    assert same(train(tmp_path, resume=True), straight)


def test_a_damaged_checkpoint_is_set_aside(tmp_path: Path, straight) -> None:
    train(tmp_path, stop_after=7)
    newest = sorted(tmp_path.glob("step-*"))[-1]
    file = newest / "tensors.safetensors"
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)
    with pytest.warns(UserWarning, match="is damaged"):
        assert same(train(tmp_path, resume=True), straight)
    assert list(tmp_path.glob(".corrupt-*"))


def test_resume_refuses_another_run(tmp_path: Path) -> None:
    train(tmp_path, stop_after=3)
    with pytest.raises(ValueError, match=r"settings.steps is 8, this one's 9"):
        train(tmp_path, resume=True, steps=9)
    with pytest.raises(ValueError, match=r"loss.weights.content"):
        train(tmp_path, resume=True, loss=tiny.loss(content=0.7))
    with pytest.raises(ValueError, match=r"its source is \['BuiltinScenes'"):
        fit(
            tiny.camera(),
            tiny.loss(),
            source=tiny.BuiltinScenes(tiny.SIZE, names=["chelsea", "coffee"]),
            settings=tiny.settings(),
            folder=tmp_path,
            resume=True,
        )
    with pytest.raises(ValueError, match=r"holds the checkpoints of a run. Go on with resume=True"):
        train(tmp_path)


def test_resume_without_a_checkpoint_begins(tmp_path: Path, straight) -> None:
    assert same(train(tmp_path, resume=True), straight)


class Spoiled(StyleLoss):
    """Not a number at some steps."""

    def __init__(self, *args, at: set[int], once: bool, **kwargs) -> None:
        super().__init__(*args, **kwargs)
        self.at, self.once = at, once

    def terms(self, picture, scene=None, *, recorded=None, turn=None):
        terms = super().terms(picture, scene, recorded=recorded, turn=turn)
        if turn in self.at:
            if self.once:
                self.at.discard(turn)
            terms["colour"] = terms["colour"] * float("nan")
        return terms


def spoiled(at: set[int], *, once: bool) -> Spoiled:
    return Spoiled(tiny.painting("woodcut", size=128)[:, : tiny.SIZE, : tiny.SIZE], at=at, once=once)


def test_a_loss_that_is_no_number_goes_back_to_the_last_good_state() -> None:
    with pytest.warns(StyleWarning, match=r"step 4: the colour term is nan, on chelsea.*Back to step 3"):
        trained = train(None, loss=spoiled({4}, once=True))
    assert trained.finished
    assert len(trained.history) == 8
    assert trained.history.isfinite().all()
    assert all(value.isfinite().all() for value in trained.camera.state_dict().values())


def test_it_stops_where_that_does_not_help() -> None:
    with pytest.warns(StyleWarning), pytest.raises(TrainingError, match=r"stopped at step 4: the colour term is nan"):
        train(None, loss=spoiled({4}, once=False))


@pytest.mark.slow
def test_going_back_survives_a_resume(tmp_path: Path) -> None:
    with pytest.warns(StyleWarning):
        whole = train(None, loss=spoiled({4}, once=True))
    with pytest.warns(StyleWarning):
        train(tmp_path, loss=spoiled({4}, once=True), stop_after=7)
    again = train(tmp_path, loss=spoiled(set(), once=True), resume=True)
    assert torch.equal(again.history, whole.history)
    assert again.advice == whole.advice


class Wild(StyleLoss):
    def terms(self, picture, scene=None, *, recorded=None, turn=None):
        scale = 1e4 if turn == 8 and not self.__dict__.setdefault("seen", []) else 1.0
        if scale > 1:
            self.seen.append(turn)
        return {"style": scale * (picture.mean() + 1)}


def test_a_diverging_loss_goes_back(monkeypatch) -> None:
    monkeypatch.setattr("kcam.style.run.MEMORY", 6)
    loss = Wild(tiny.painting("woodcut", size=128)[:, : tiny.SIZE, : tiny.SIZE])
    with pytest.warns(StyleWarning, match=r"step 8: the loss is .* times its recent median"):
        trained = train(None, loss=loss, steps=10, every=5, rates={"demosaic": 1e-4})
    assert trained.finished


@pytest.mark.slow
def test_the_content_weight_follows_its_aim(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("kcam.style.run.SETTLED", 2)

    def content(aim: float | None, **how) -> Tensor:
        return train(how.pop("folder", None), content_aim=aim, **how).history[:, 3]

    plain, strict, loose = content(None), content(1e-4), content(1.9)
    assert torch.equal(plain[:3], strict[:3])
    assert strict[-1] > 1.1 * plain[-1]  # weighted: the factor grows where more is lost than aimed at
    assert loose[-1] < 0.95 * plain[-1]
    content(1e-4, folder=tmp_path, stop_after=5)
    assert torch.equal(content(1e-4, folder=tmp_path, resume=True), strict)
    with pytest.raises(ValueError, match=r"content_aim must be within 0..2, got 3"):
        Settings(content_aim=3.0)


def test_weights_are_averaged() -> None:
    camera = tiny.camera(stage=False)
    how = {"source": tiny.source(), "settings": tiny.settings(steps=6, average=0.0)}
    last = fit(camera, tiny.loss(), **how).camera.state_dict()["stages.7.weight"].clone()
    how["settings"] = tiny.settings(steps=6, average=0.99)
    mean = fit(tiny.camera(stage=False), tiny.loss(), **how).camera.state_dict()["stages.7.weight"]
    start = isp.Convolution().weight
    assert 0 < (mean - start).norm() < (last - start).norm()


def test_rows_do_not_depend_on_their_neighbours() -> None:
    """What lets any number of processes share a batch."""
    scene, _ = tiny.source().draw([0, 1], seed=0, step=0)
    single, _ = tiny.source().draw([1], seed=0, step=0)

    def generator(first: int):
        return lambda row, stage: torch.Generator().manual_seed(10 * (first + row) + stage)

    both, _ = photograph(tiny.camera(), scene, generator(0))
    alone, _ = photograph(tiny.camera(), single, generator(1))
    assert (both[1] - alone[0]).abs().max() < 1e-5  # the transforms of a batch round otherwise


def take(camera: Camera, loss: StyleLoss) -> dict[str, torch.Tensor]:
    """A step's gradients, and the values of its terms."""
    scene, _ = tiny.source().draw(range(4), seed=0, step=0)
    named = dict(camera.named_parameters())
    taken = gradients(
        camera, loss, scene, draws, parameters=list(named.values()), turn=0, emphasis=1.5, mark=lambda part: None
    )
    assert list(taken.values) == ["total", *(name for name, weight in loss.weights.items() if weight)]
    return {name: p.grad for name, p in named.items() if p.grad is not None} | {
        name: torch.tensor(value) for name, value in taken.values.items()
    }


def draws(row: int, stage: int) -> torch.Generator:
    return torch.Generator().manual_seed(10 * row + stage)


def whose_stages_ask_their_neighbours() -> Camera:
    """The matrix follows the filter, which trains: it acts behind the noise too. Gains in float64, as they are made."""
    stages = [stage for stage in tiny.camera(stage=False) if not isinstance(stage, isp.ToneCurve)]
    gains = isp.WhiteBalance(nn.Parameter(torch.tensor([2.0, 1.0, 1.5], dtype=torch.float64)))
    return Camera(*stages, gains, isp.ColourMatrix(), isp.ToneCurve())


@pytest.mark.parametrize("make", [tiny.camera, whose_stages_ask_their_neighbours], ids=["own", "neighbours"])
@pytest.mark.parametrize("weights", [{}, {"l2": 0.5, "tv": 0.1}], ids=["plain", "l2"])
def test_gradients_by_rows_are_those_of_the_batch(make: Callable[[], Camera], weights: dict[str, float]) -> None:
    camera, loss = make(), tiny.loss(**weights)
    found = take(camera, loss)
    camera.zero_grad()
    scene, _ = tiny.source().draw(range(4), seed=0, step=0)
    picture, recorded = photograph(camera, scene, draws, recorded="l2" in weights)
    terms = loss.terms(picture, scene.to_srgb(), recorded=recorded, turn=0)
    terms["content"] = 1.5 * terms["content"]
    total = torch.stack(list(terms.values())).sum()
    total.backward()
    assert found["total"].item() == pytest.approx(total.item(), rel=1e-5)
    for name, parameter in camera.named_parameters():
        if parameter.grad is None:
            assert name not in found or not found[name].any()
            continue
        assert found[name].dtype == parameter.dtype
        scale = float(parameter.grad.abs().max()) + 1e-6
        # 3e-4 measured for the filter, whose exposure cancels most of it; else 2e-6
        torch.testing.assert_close(found[name], parameter.grad, rtol=0, atol=2e-3 * scale, msg=name)


def test_a_row_is_the_same_in_any_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """In process: what two would gather, against what one has."""
    handed: list[torch.Tensor] = []

    def gathered(rows: torch.Tensor, world: int) -> torch.Tensor:
        handed.append(rows.clone())
        return rows.repeat_interleave(world, 0)

    monkeypatch.setattr(steps, "gathered", gathered)
    monkeypatch.setattr(steps, "of_the_first", lambda values, world: values)
    take(tiny.camera(), tiny.loss())
    alone = [rows.clone() for rows in handed]
    for rank in (0, 1):
        handed.clear()
        monkeypatch.setattr(steps, "place", lambda rank=rank: (rank, 2))
        take(tiny.camera(), tiny.loss())
        for own, rows in zip(handed, alone, strict=True):
            assert torch.equal(own, rows[rank::2])


def test_a_camera_without_noise_and_mosaic_sees_the_depth() -> None:
    scene, _ = tiny.source().draw([0], seed=0, step=0)
    scene = scene.with_depth(0.9)
    kinds = isp.Demosaic, isp.Convolution, sensor.Mosaic, sensor.ShotNoise, sensor.ADC
    camera = Camera(*(stage for stage in tiny.camera(stage=False) if not isinstance(stage, kinds)))
    picture, _ = photograph(camera, scene, lambda row, stage: torch.Generator())
    torch.testing.assert_close(picture, camera(scene))
    assert (picture - camera(scene.with_depth(2.0))).abs().max() > 0.05


def test_recorded_is_what_the_sensor_sees_with_and_without_optics() -> None:
    """The two sides of the thesis's content loss: for a camera without blur they are one."""
    scene, _ = tiny.source().draw([0], seed=0, step=0)
    camera = tiny.camera()
    camera = Camera(camera[0].changed(blur=False), *camera.stages[1:])
    _, pair = photograph(camera, scene, lambda row, stage: torch.Generator(), recorded=True)
    assert pair is not None
    assert torch.allclose(*pair, atol=1e-5)
    assert pair[0].requires_grad
    assert not pair[1].requires_grad  # the target
    _, pair = photograph(tiny.camera(), scene, lambda row, stage: torch.Generator(), recorded=True)
    assert (pair[0] - pair[1]).abs().max() > 1e-3


@pytest.mark.slow
def test_a_plan_is_frozen_and_kept(tmp_path: Path) -> None:
    trained = train(None, tolerance=0.02)
    assert trained.plan is not None
    assert trained.plan.gradients
    reference = train(None)
    assert not torch.equal(trained.history, reference.history)
    assert torch.allclose(trained.history[0], reference.history[0], rtol=0.05)
    train(tmp_path, tolerance=0.02, stop_after=5)
    assert torch.equal(train(tmp_path, tolerance=0.02, resume=True).history, trained.history)


@pytest.fixture
def looking_early(monkeypatch: pytest.MonkeyPatch) -> None:
    """At the pictures, after two steps already."""
    monkeypatch.setattr("kcam.style.run.LOOK", 2)
    monkeypatch.setattr("kcam.style.run.SETTLED", 0)


@pytest.mark.usefixtures("looking_early")
def test_warnings_of_negative_and_clipped() -> None:
    inverted = nn.Parameter(-torch.eye(3)[:, :, None, None].repeat(1, 1, 3, 3) / 9)
    still = tiny.settings(steps=2, rates={"demosaic": 1e-6})
    stages = list(tiny.camera(stage=False))
    stages[7] = isp.Convolution(inverted, nn.Parameter(torch.full((3,), 0.3)))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        fit(Camera(*stages), tiny.loss(), source=tiny.source(), settings=still)
    assert any("look like negatives" in str(w.message) for w in caught)
    bright = nn.Parameter(torch.eye(3)[:, :, None, None] * 50)
    stages[7] = isp.Convolution(bright, nn.Parameter(torch.zeros(3)))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        fit(Camera(*stages), tiny.loss(), source=tiny.source(), settings=still)
    assert any("they clip" in str(w.message) for w in caught)


@pytest.mark.usefixtures("looking_early")
def test_a_stage_that_paints_all_white_is_told() -> None:
    camera = tiny.camera()
    with torch.no_grad():
        camera[-1].leave.bias.fill_(100.0)
    with pytest.warns(StyleWarning, match="100% of the pictures is black or white"):
        fit(camera, tiny.loss(), source=tiny.source(), settings=tiny.settings(steps=2, rates={"filter": 1e-6}))


def test_an_aim_is_for_the_correlation_alone(monkeypatch) -> None:
    """A loss by features has another unit for each network: its weight stays."""
    monkeypatch.setattr("kcam.style.run.SETTLED", 0)
    by_features = tiny.loss(content_by="features", content_layer="scale 1")
    aimed, plain = (train(None, loss=by_features, content_aim=aim, steps=3).history for aim in (0.01, None))
    assert torch.equal(aimed, plain)


@pytest.mark.usefixtures("looking_early")
def test_a_channel_that_goes_blind_is_told() -> None:
    camera = tiny.camera(stage=False)

    class Darkening(tiny.BuiltinScenes):
        def draw(self, rows, *, seed, step):
            with torch.no_grad():
                camera[1].coefficients[0] = -2.0
            return super().draw(rows, seed=seed, step=step)

    source = Darkening(tiny.SIZE, names=["chelsea"])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        fit(camera, tiny.loss(), source=source, settings=tiny.settings(steps=2))
    assert any("channel [0] of the colour filter has gone blind" in str(w.message) for w in caught)


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"rates": {"lens": 1.0}}, r"unknown part 'lens' of a camera; what trains: optics, filter"),
        ({"steps": 0}, r"steps must be a whole number of at least 1, got 0"),
        ({"steps": 1.5}, r"steps must be a whole number of at least 1, got 1.5"),
        ({"warm_up": -5}, r"warm_up must be a whole number of at least 0, got -5"),
        ({"final": -1.0}, r"final must be a finite number >= 0, got -1.0"),
        ({"weight_decay": float("nan")}, r"weight_decay must be a finite number >= 0, got nan"),
        ({"tolerance": -1.0}, r"tolerance must be a finite number >= 0, got -1.0"),
        ({"rates": {"filter": 0.0}}, r"one of them above"),
        ({"rates": {"filter": float("nan")}}, r"learning rates must be finite"),
        ({"clip": 0.0}, r"expected clip > 0"),
        ({"average": 1.0}, r"0 <= average < 1"),
    ],
)
def test_settings_errors(changes: dict, match: str) -> None:
    with pytest.raises(ValueError, match=match):
        Settings(**changes)


def test_nothing_to_train() -> None:
    with pytest.raises(ValueError, match=r"nothing of this camera trains"):
        fit(Camera.phone(), tiny.loss(), source=tiny.source(), settings=tiny.settings())


def test_rates_grow_and_fall() -> None:
    settings = Settings(steps=100, warm_up=10, final=0.05)
    shares = [settings.rate(step) for step in range(100)]
    assert shares[0] == pytest.approx(0.1, rel=1e-3)
    assert max(shares) <= 1
    assert shares[-1] == pytest.approx(0.05, abs=1e-3)
    assert all(b <= a for a, b in pairwise(shares[10:]))
    assert Settings(steps=10, warm_up=0, final=1.0).rate(7) == 1.0


# ---- processes ----------------------------------------------------------------------------------------------------


def run_process(folder: Path, *extra: str, wait: bool = True, launcher: tuple[str, ...] = ()) -> subprocess.Popen:
    environment = os.environ | {
        "OMP_NUM_THREADS": "1",
        "PYTHONPATH": os.pathsep.join([str(Path(__file__).parents[2]), str(Path(__file__).parent)]),
    }
    command = [sys.executable, *launcher, str(PROGRAM), str(folder), *extra]
    process = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    if wait:
        output, _ = process.communicate(timeout=300)
        assert process.returncode == 0, output
    return process


def newest_step(folder: Path) -> int:
    return max((int(path.name[5:]) for path in folder.glob("checkpoints/step-*")), default=0)


@pytest.mark.slow
def test_killed_five_times_it_ends_in_the_same_camera(tmp_path: Path) -> None:
    """SIGKILL at five moments, the last of them inside a save; the rest is resumed."""
    run_process(tmp_path / "straight")
    folder = tmp_path / "killed"
    for kill in range(5):
        process = run_process(folder, "--resume", wait=False)
        deadline = time.monotonic() + 120
        newest = newest_step(folder)
        while time.monotonic() < deadline and process.poll() is None:
            saving = list(folder.glob("checkpoints/.tmp-*"))
            if (kill == 4 and saving) or (kill < 4 and newest_step(folder) > newest):
                break
            time.sleep(0.0005)
        process.send_signal(signal.SIGKILL)
        process.communicate()
    run_process(folder, "--resume")
    straight, killed = (torch.load(tmp_path / name / "result.pt", weights_only=True) for name in ("straight", "killed"))
    assert straight.keys() == killed.keys()
    assert all(torch.equal(straight[name], killed[name]) for name in straight)


@pytest.mark.slow
@pytest.mark.parametrize("batch", ["--two", "--four"])
def test_two_processes_train_the_camera_of_one(tmp_path: Path, batch: str) -> None:
    """Bit for bit, photons, ADC and all: rounding alone would be 10 % of the loss within ten steps."""
    run_process(tmp_path / "one", batch)
    launcher = ("-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2")
    run_process(tmp_path / "two", batch, launcher=launcher)
    names = "one/result.pt", "two/result.pt", "two/result1.pt"
    one, *both = (torch.load(tmp_path / name, weights_only=True) for name in names)
    assert len(one["history"]) == 30
    for two in both:
        assert one.keys() == two.keys()
        for name, value in one.items():
            assert torch.equal(value, two[name]), name


def test_a_batch_that_the_processes_cannot_share(monkeypatch) -> None:
    monkeypatch.setattr("kcam.style.run.place", lambda: (0, 3))
    with pytest.raises(ValueError, match=r"a batch of 2 cannot be shared by 3 processes"):
        fit(tiny.camera(), tiny.loss(), source=tiny.source(), settings=tiny.settings())


def test_scene_is_untouched_by_training() -> None:
    source = tiny.source()
    before = source.draw([0], seed=0, step=0)[0]
    fit(tiny.camera(), tiny.loss(), source=source, settings=tiny.settings(steps=2))
    after: Scene = source.draw([0], seed=0, step=0)[0]
    assert torch.equal(before.coefficients, after.coefficients)


def test_a_dead_filter_cannot_go_negative() -> None:
    """Softplus: whatever is learnt, light is absorbed."""
    camera = tiny.camera(stage=False)
    fit(camera, tiny.loss(content=0), source=tiny.source(), settings=tiny.settings(steps=5, rates={"filter": 2.0}))
    assert isinstance(camera[1], sensor.ColourFilter)
    assert (camera[1].alpha() >= 0).all()
    assert isinstance(camera[0], optics.Imaging)
