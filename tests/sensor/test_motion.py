"""What moves while the shutter is open, against closed forms and dense averages in numpy."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from draws import Draw
from scipy import special
from torch import Tensor, nn

from kcam import Camera, Scene, isp, optics, sensor
from kcam.context import Context
from kcam.planner import evaluation, noiseless_raw, relative_rms
from kcam.sensor import Motion
from kcam.units import mm, um

SIDE = 48


class Blob:
    """A Gaussian blob on an even ground: where it stands is known between pixels too."""

    def __init__(self, draw: Draw, *, sigma: float = 2.0) -> None:
        self.x, self.y = draw.number(18, 30), draw.number(18, 30)
        self.sigma = sigma

    def at(self, dx: np.ndarray | float = 0.0, dy: np.ndarray | float = 0.0) -> np.ndarray:
        """The picture when all has moved so far, (48, 48); dx and dy may be maps."""
        y, x = np.mgrid[:SIDE, :SIDE].astype(float)
        return 0.2 + np.exp(-((x - dx - self.x) ** 2 + (y - dy - self.y) ** 2) / (2 * self.sigma**2))

    @property
    def picture(self) -> Tensor:
        return torch.tensor(self.at())[None, None]


def mean(function, time: float, *, count: int = 400) -> np.ndarray:
    """Over the exposure, by the midpoint rule of many moments."""
    return np.mean([function((k + 0.5) / count * time) for k in range(count)], axis=0)


@pytest.mark.parametrize("seed", range(5))
def test_constant_motion_is_exact(seed: int) -> None:
    draw = Draw(seed)
    blob, time = Blob(draw), draw.number(0.01, 0.2)
    vx, vy = (draw.number(-8, 8) / time for _ in range(2))
    found = Motion((vx, vy), time=time)(blob.picture)[0, 0].numpy()
    expected = mean(lambda t: blob.at(vx * t, vy * t), time)
    assert np.abs(found - expected).max() < 2e-5  # of the midpoint rule, and of what the borders mirror


def test_a_blob_along_a_row_is_a_difference_of_error_functions() -> None:
    blob, vx = Blob(Draw(1)), 60.0
    found = Motion((vx, 0.0), time=0.1)(blob.picture)[0, 0].numpy()
    y, x = np.mgrid[:SIDE, :SIDE].astype(float)
    root = blob.sigma * math.sqrt(2)
    smear = (special.erf((x - blob.x) / root) - special.erf((x - blob.x - 6.0) / root)) * root * math.sqrt(math.pi) / 12
    assert np.abs(found - 0.2 - smear * np.exp(-((y - blob.y) ** 2) / root**2)).max() < 1e-6


def test_an_edge_becomes_a_ramp_as_wide_as_it_moves() -> None:
    wall = torch.zeros(1, 1, 16, 128)
    wall[..., 64:] = 1
    row = Motion((160.0, 0.0), time=0.1)(wall)[0, 0, 8]
    ramp = ((torch.arange(128) - 63.5) / 16).clamp(0, 1)
    assert (row - ramp).abs().max() < 0.08  # rings of an edge that is not band-limited
    assert row[60:84].diff().min() > -0.02


@pytest.mark.parametrize("seed", range(3))
def test_a_path_is_the_mean_over_its_pieces(seed: int) -> None:
    draw = Draw(seed)
    blob, path = Blob(draw), 6 * (draw.noise(5, 2) - 0.5)
    found = Motion(path=path, time=0.1)(blob.picture)[0, 0].numpy()

    def at(t: float) -> np.ndarray:
        place = [np.interp(t / 0.1 * 4, np.arange(5), path[:, axis].numpy()) for axis in range(2)]
        return blob.at(*place)

    assert np.abs(found - mean(at, 0.1)).max() < 2e-5


@pytest.mark.parametrize("way", ["velocity", "path"])
@pytest.mark.parametrize("seed", range(2))
def test_rows_see_later_moments(seed: int, way: str) -> None:
    draw = Draw(seed)
    blob, time, readout = Blob(draw), 0.05, 0.1
    vx, vy = draw.number(-60, 60), draw.number(-30, 30)
    line = torch.tensor([[0.0, 0.0], [vx / 2, vy / 2], [vx, vy]]).double() * (time + readout)
    arguments = {"velocity": (vx, vy)} if way == "velocity" else {"path": line}
    found = Motion(**arguments, time=time, readout=readout)(blob.picture)[0, 0].numpy()
    starts = readout * np.arange(SIDE)[:, None] / SIDE
    expected = mean(lambda t: blob.at(vx * (starts + t), vy * (starts + t)), time)
    assert np.abs(found - expected).max() < (5e-4 if way == "velocity" else 2e-3)


def test_a_later_start_is_a_picture_that_has_moved() -> None:
    blob = Blob(Draw(6))
    for readout in (0.0, 0.05):
        found = Motion((40.0, -20.0), time=0.02, start=0.1, readout=readout)(blob.picture)[0, 0].numpy()
        starts = 0.1 + readout * np.arange(SIDE)[:, None] / SIDE
        expected = mean(lambda t, at=starts: blob.at(40.0 * (at + t), -20.0 * (at + t)), 0.02)
        assert np.abs(found - expected).max() < 5e-4


def test_a_vertical_line_leans_by_velocity_times_readout() -> None:
    line = torch.exp(-0.5 * ((torch.arange(64.0) - 20) / 1.5) ** 2).expand(1, 1, 64, 64)
    found = Motion((200.0, 0.0), time=1e-6, readout=0.1, border="replicate")(line)[0, 0]
    centres = (found * torch.arange(64.0)).sum(-1) / found.sum(-1)
    torch.testing.assert_close(centres, 20 + 20 * torch.arange(64.0) / 64, atol=2e-3, rtol=0)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("readout", [0.0, 0.05])
def test_a_flow_of_each_pixel(seed: int, readout: float) -> None:
    draw = Draw(seed)
    blob, time = Blob(draw, sigma=3.0), 0.1
    y, x = np.mgrid[:SIDE, :SIDE] / SIDE - 0.5
    flow = np.stack([30 + 60 * x * draw.number(-1, 1), -20 + 60 * y * draw.number(-1, 1)])
    found = Motion(flow=torch.tensor(flow), time=time, readout=readout)(blob.picture)[0, 0].numpy()
    starts = readout * np.arange(SIDE)[:, None] / SIDE
    expected = mean(lambda t: blob.at(flow[0] * (starts + t), flow[1] * (starts + t)), time)
    assert np.abs(found - expected).max() < 4e-3


def test_error_of_few_moments_falls_with_their_number_and_is_what_is_said() -> None:
    blob = Blob(Draw(4), sigma=1.2)
    stage = Motion(flow=torch.full((2, SIDE, SIDE), 90.0).double(), time=0.1)
    forms = stage.cheaper(blob.picture, Context())
    errors = [error for _, _, error in forms]
    assert [name for name, _, _ in forms][:2] == ["1 sample", "2 samples"]
    assert errors == sorted(errors, reverse=True)
    whole = stage(blob.picture)
    for _, arguments, error in forms:
        assert relative_rms(stage.changed(**arguments)(blob.picture), whole) == pytest.approx(error)
    exact = Motion((90.0, 90.0), time=0.1)(blob.picture)
    assert relative_rms(whole, exact) < 2e-3


def test_light_is_kept_and_what_stands_still_stays() -> None:
    picture = torch.rand(2, 3, 32, 40, generator=torch.Generator().manual_seed(0))
    assert (Motion((0.0, 0.0), time=0.1)(picture) - picture).abs().max() < 1e-6
    moved = Motion((123.0, -77.0), time=0.05, border="periodic")(picture)
    torch.testing.assert_close(moved.sum((-2, -1)), picture.sum((-2, -1)))
    for border in ("reflect", "replicate", "periodic"):
        even = torch.full((1, 3, 20, 24), 0.5)
        for stage in (
            Motion((40.0, 20.0), time=0.1, border=border),
            Motion((40.0, 20.0), time=0.1, readout=0.1, border=border),
            Motion(flow=torch.full((2, 20, 24), 30.0), time=0.1, border=border),
        ):
            assert (stage(even) - 0.5).abs().max() < 1e-5


class TestTranslation:
    @staticmethod
    def context(depth: Tensor | float) -> Context:
        lens = optics.Lens(optics.CircularAperture(2 * mm), optics.ThinLens(10 * mm), focus_distance=2.0)
        return Context(lens=lens, pixel_pitch=4 * um, depth=depth)

    def test_at_one_depth_it_is_a_velocity(self) -> None:
        blob, context = Blob(Draw(2)), self.context(2.0)
        found = Motion(translation=(0.01, -0.004), time=0.2)(blob.picture, context)
        scale = -float(context.lens.sensor_distance) / (2.0 * 4 * um)
        expected = Motion((0.01 * scale, -0.004 * scale), time=0.2)(blob.picture)
        torch.testing.assert_close(found, expected, atol=1e-6, rtol=0)

    def test_the_nearer_the_faster_and_nothing_at_infinity(self) -> None:
        """A near half and a far one: each moves as if alone, away from where they meet."""
        picture = torch.rand(1, 1, 64, 96, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
        picture = isp.Convolution(torch.full((1, 1, 5, 5), 0.04).double())(picture)
        depth = torch.full((1, 1, 64, 96), math.inf).double()
        depth[..., :48] = 1.0
        context = self.context(depth)
        found = Motion(translation=(0.0, 0.01), time=0.1)(picture, context)
        speed = -0.01 * float(context.lens.sensor_distance) / (4 * um)
        near = Motion((0.0, speed), time=0.1)(picture)
        assert (found - near)[..., 8:-8, :40].abs().max() < 0.03
        assert (found - picture)[..., 8:-8, 56:].abs().max() < 1e-3

    def test_a_camera_tells_the_depth(self) -> None:
        scene = Scene.builtin("motorcycle", (24, 32))
        still = list(Camera.phone())
        moving = Camera(*still[:2], Motion(translation=(0.002, 0.0), time=0.05), *still[2:])
        assert not torch.equal(moving.noiseless()(scene), Camera(*still).noiseless()(scene))
        with pytest.raises(ValueError, match="needs the depth of a Scene and a lens"):
            Motion(translation=(0.1, 0.0), time=0.1)(torch.ones(1, 3, 4, 4))


@pytest.mark.slow
def test_gradients() -> None:
    draw = Draw(0)
    signal = draw.noise(1, 1, 5, 6).requires_grad_()
    velocity = torch.tensor([12.3, -7.1]).double().requires_grad_()
    path = (3 * draw.noise(3, 2)).requires_grad_()
    flow = (10 * draw.noise(2, 5, 6) + 3).requires_grad_()
    time = torch.tensor(0.11).double().requires_grad_()
    for make in (
        lambda s, v, p, f, t: Motion(v, time=t)(s),
        lambda s, v, p, f, t: Motion(v, time=t, readout=0.07)(s),
        lambda s, v, p, f, t: Motion(path=p, time=t)(s),
        lambda s, v, p, f, t: Motion(path=p, time=t, readout=0.07, samples=2)(s),
        lambda s, v, p, f, t: Motion(flow=f, time=t, samples=3)(s),
    ):
        assert torch.autograd.gradcheck(make, (signal, velocity, path, flow, time), atol=1e-4)
    still = torch.zeros(2).double().requires_grad_()
    assert torch.autograd.gradcheck(lambda v: Motion(v, time=0.1)(signal.detach()), (still,))


def test_velocity_is_found_from_a_picture() -> None:
    """A camera with motion is differentiable: the motion of a blurred picture is recovered."""
    blob, truth = Blob(Draw(3)), Motion((70.0, 25.0), time=0.1)
    seen = truth(blob.picture)
    velocity = nn.Parameter(torch.tensor([40.0, 0.0]).double())
    optimiser = torch.optim.LBFGS([velocity], max_iter=40, line_search_fn="strong_wolfe")

    def loss() -> Tensor:
        optimiser.zero_grad()
        value = 1e3 * (Motion(velocity, time=0.1)(blob.picture) - seen).square().mean()
        value.backward()
        return value

    optimiser.step(loss)
    torch.testing.assert_close(velocity.detach(), torch.tensor([70.0, 25.0]).double(), atol=0.1, rtol=0)


class TestInACamera:
    @staticmethod
    def camera(motion: Motion, *, time: float | None = None) -> Camera:
        stages = list(Camera.phone())
        stages[3] = sensor.Exposure(time=time)
        return Camera(*stages[:2], motion, *stages[2:])

    def test_the_exposure_tells_its_time(self) -> None:
        scene = Scene.builtin("coffee", (16, 24))
        told = self.camera(Motion((500.0, 0.0)), time=0.01).noiseless()(scene)
        given = self.camera(Motion((500.0, 0.0), time=0.01), time=0.01).noiseless()(scene)
        assert torch.equal(told, given)
        with pytest.raises(ValueError, match="knows no exposure time"):
            self.camera(Motion((500.0, 0.0)))(scene)

    @pytest.mark.parametrize(
        "motion",
        [
            pytest.param(Motion((300.0, 100.0), time=0.01, readout=0.01), id="velocity"),
            pytest.param(
                Motion(path=sensor.tremor(0.02, amplitude=30.0, seed=3), time=0.01, readout=0.01),
                id="path",
                marks=pytest.mark.slow,
            ),
            pytest.param(Motion(flow=torch.full((2, 24, 32), 400.0), time=0.01), id="flow"),
            pytest.param(Motion(translation=(0.01, 0.0), time=0.01), id="translation", marks=pytest.mark.slow),
        ],
    )
    def test_plans_keep_their_word_and_files_their_motion(self, motion: Motion, tmp_path: Path) -> None:
        camera, scene = self.camera(motion), Scene.builtin("motorcycle", (24, 32))
        camera.save(tmp_path / "moving.safetensors")
        assert torch.equal(Camera.load(tmp_path / "moving.safetensors").noiseless()(scene), camera.noiseless()(scene))
        operator = camera.linear(scene)
        x, y = torch.rand_like(operator.light), torch.rand(operator.raw_shape)
        assert float((operator(x) * y).sum()) == pytest.approx(float((x * operator.adjoint(y)).sum()), rel=1e-4)
        with torch.no_grad():
            for tolerance in (0.1, 0.003):
                plan = camera.plan(scene, tolerance=tolerance)
                raw = noiseless_raw(plan.apply(camera))(scene)
                assert relative_rms(raw, noiseless_raw(camera)(scene)) <= tolerance
                row = next(row for row in plan.decisions if row.effect == "Motion")
                assert "1 sample would cost" in row.why
                again = type(plan).from_json(plan.to_json())
                assert torch.equal(noiseless_raw(again.apply(camera))(scene), raw)

    def test_a_plan_takes_fewer_moments(self) -> None:
        flow = torch.full((2, 24, 32), 900.0)
        camera, scene = self.camera(Motion(flow=flow, time=0.01)), Scene.builtin("coffee", (24, 32))
        with torch.no_grad():
            plan = camera.plan(scene, tolerance=0.03)
        assert plan.replaced == {"2": {"samples": plan.replaced["2"]["samples"]}}
        assert 1 <= plan.replaced["2"]["samples"] < 26
        assert "samples" in str(plan)

    def test_far_motion_is_never_judged_by_crops(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """What moves in from beyond a crop is not what stands beside it."""
        monkeypatch.setattr(evaluation, "LARGEST", 64**2)
        monkeypatch.setattr(evaluation, "CROP", 32)
        monkeypatch.setattr(evaluation, "WITNESSED", 100**2)
        light = Scene.from_rgb(torch.linspace(0.2, 1, 600).expand(1, 3, 150, 600), depth=2.0)
        stages = [sensor.Mosaic("RGGB"), sensor.Exposure(), sensor.ADC(bits=10)]
        camera = Camera(sensor.ColourFilter.kodak(), Motion((2500.0, 0.0), time=0.1), *stages)
        with torch.no_grad():
            plan = camera.plan(light, tolerance=0.2)
            assert plan.measure(camera, light) <= 0.2

    def test_a_motion_for_each_picture_is_planned(self) -> None:
        light = Scene.from_rgb(torch.rand(2, 3, 24, 32, generator=torch.Generator().manual_seed(0)), depth=2.0)
        for motion in (
            Motion(torch.tensor([[1.0, 0.0], [30.0, 0.0]]), time=0.1),
            Motion(path=6 * Draw(0).noise(2, 4, 2).float(), time=0.1, readout=0.1),
            Motion(flow=30 * Draw(1).noise(2, 2, 24, 32).float(), time=0.1),
        ):
            camera = self.camera(motion)
            with torch.no_grad():
                plan = camera.plan(light, tolerance=0.02)
                assert plan.measure(camera, light) <= 0.02

    def test_order(self) -> None:
        with pytest.raises(ValueError, match="Motion stands before Imaging"):
            Camera(Motion((1.0, 0.0), time=1.0), *Camera.phone())
        motion = Motion((1.0, 0.0), time=1.0)
        for before in (sensor.Mosaic("RGGB"), sensor.ColourFilter.learned(4)):
            with pytest.raises(ValueError, match="Motion stands after .*one colour each. Move it before"):
                Camera(before, motion)


class TestBurst:
    def test_frames_are_those_of_the_camera(self) -> None:
        """The same pictures as the camera takes with each picture's seed: optics once, noise of each its own."""
        camera, scene = Camera.phone(), Scene.builtin("coffee", (16, 24))
        seeds = torch.randint(2**63 - 1, (3,), generator=torch.Generator().manual_seed(5)).tolist()
        found = camera.burst(scene, exposures=[1.0, 1.0, 0.25], generator=torch.Generator().manual_seed(5))
        assert found.shape == (3, 1, 3, 16, 24)
        for index in (0, 1):
            alone = camera(scene, generator=torch.Generator().manual_seed(seeds[index]))
            torch.testing.assert_close(found[index], alone)
        assert not torch.equal(found[0], found[1])
        other = camera.burst(scene, exposures=[4.0, 1.0], generator=torch.Generator().manual_seed(5))
        assert torch.equal(other[1], found[1])

    def test_a_bracket_scales_light(self) -> None:
        camera, scene = Camera.phone().noiseless(), Scene.builtin("coffee", (16, 24))
        linear = Camera(*list(camera)[:4])
        found = linear.burst(scene, exposures=[0.5, 1.0, 2.0])
        torch.testing.assert_close(found[2], 2 * found[1])
        torch.testing.assert_close(found[0], found[1] / 2)
        timed = [*[*camera][:3], sensor.Exposure(time=0.01)]
        seconds = Camera(*timed).burst(scene, exposures=[0.01, 0.04])
        torch.testing.assert_close(seconds[0], Camera(*timed)(scene))
        torch.testing.assert_close(seconds[1], 4 * seconds[0])

    def test_motion_goes_on_from_picture_to_picture(self) -> None:
        camera, scene = Camera(*list(Camera.phone().noiseless())[:4]), Scene.builtin("point_grid", (32, 48))
        motion = Motion((500.0, 0.0), time=0.01, readout=0.002)
        found = camera.burst(scene, exposures=[1.0, 1.0], motion=motion, interval=0.004)
        for picture, start in zip(found, (0.0, 0.016), strict=True):
            stages = list(camera)
            alone = Camera(*stages[:2], motion.changed(start=start), *stages[2:])(scene)
            torch.testing.assert_close(picture, alone)

    def test_compensation_start_and_an_early_exposure_stay_the_camera_s(self) -> None:
        scene = Scene.builtin("coffee", (12, 16))
        bright = Camera(sensor.ColourFilter.kodak(), sensor.Exposure(compensation=2.0))
        torch.testing.assert_close(bright.burst(scene, exposures=[1.0])[0], bright(scene))
        late = Motion((10.0, 0.0), time=0.1, start=1.0)
        still = [sensor.ColourFilter.kodak(), sensor.Mosaic("RGGB"), sensor.Exposure()]
        found = Camera(*still).burst(scene, exposures=[1.0], motion=late)[0]
        torch.testing.assert_close(found, Camera(still[0], late, *still[1:])(scene))
        early = Camera(sensor.Exposure(), sensor.ColourFilter.kodak(), isp.WhiteBalance(), isp.ToneCurve())
        torch.testing.assert_close(early.burst(scene, exposures=[1.0])[0], early(scene))

    def test_errors(self) -> None:
        camera, scene = Camera.phone(), Scene.builtin("coffee", (8, 12))
        still = Camera(sensor.ColourFilter.kodak(), isp.ToneCurve())
        moving = Motion((1.0, 0.0), time=0.1)
        for shot, arguments, text in (
            (camera, {"exposures": []}, "there are no exposures"),
            (camera, {"exposures": [1.0, 0.0]}, "exposures must be finite and > 0"),
            (camera, {"exposures": [math.nan]}, "exposures must be finite"),
            (still, {"exposures": [1.0]}, "needs a stage that exposes"),
            (camera, {"exposures": [1.0], "interval": -1.0}, "interval must be finite and >= 0"),
            (camera, {"exposures": [1.0], "motion": Motion((1.0, 0.0))}, "knows no exposure time"),
            (
                camera,
                {"exposures": [1.0], "motion": Motion(path=[(0, 0), (1, 1)], time=1.0)},
                "a path ends with its exposure",
            ),
            (TestInACamera.camera(moving), {"exposures": [1.0], "motion": moving}, "has a Motion of its own"),
        ):
            with pytest.raises(ValueError, match=text):
                shot.burst(scene, **arguments)
        for given in (0.01, None, ["a"], "12", [[1.0, 2.0]], [True]):
            with pytest.raises(TypeError, match=r"exposures must be a list of numbers such as \[0.25, 1, 4\].*Got "):
                camera.burst(scene, exposures=given)
        with pytest.raises(TypeError, match=r"motion must be a sensor.Motion"):
            camera.burst(scene, exposures=[1.0], motion=(1.0, 0.0))


def test_sharp_content_rings_as_the_docstring_says() -> None:
    motion = Motion((0.5, 0.0), time=1.0)
    step, pixel = torch.zeros(2, 1, 1, 16, 64)
    step[..., 32:], pixel[..., 8, 32] = 1, 1
    assert float(motion(step).min()) == pytest.approx(-0.10, abs=0.005)
    assert float(motion(pixel).min()) == pytest.approx(-0.15, abs=0.006)
    lens = optics.Lens(optics.CircularAperture(8 * mm / 3), optics.ThinLens(8 * mm), focus_distance=2.0)
    light = Scene.from_rgb(pixel[0].expand(3, -1, -1), depth=2.0)
    star = Camera(optics.Imaging(lens, pixel_pitch=1.4 * um), sensor.ColourFilter.kodak())(light)[:, 1:2]
    assert float(motion(star).min() / star.max()) == pytest.approx(-0.03, abs=0.005)


class TestTremor:
    def test_it_is_the_same_for_a_seed_and_as_large_as_asked_for(self) -> None:
        assert torch.equal(sensor.tremor(0.1, seed=3), sensor.tremor(0.1, seed=3))
        assert torch.equal(sensor.tremor(0.1, amplitude=4.0), 4 * sensor.tremor(0.1))
        walks = torch.stack([sensor.tremor(0.25, share=0.0, seed=seed)[-1] for seed in range(500)])
        assert walks.square().mean(0).sqrt().tolist() == pytest.approx([0.5, 0.5], rel=0.1)

    def test_the_tremor_beats_at_its_peak(self) -> None:
        path = torch.stack([sensor.tremor(8.0, share=1.0, seed=seed, count=2049)[:-1, 0] for seed in range(8)])
        power = torch.fft.rfft(path - path.mean(1, keepdim=True)).abs().square().mean(0)
        rate = torch.fft.rfftfreq(2048, d=8.0 / 2048)
        assert 7.2 <= float(rate[power[8:].argmax() + 8]) <= 10.8

    def test_errors(self) -> None:
        for arguments, text in (
            ({"time": 0.0}, "time must be finite and > 0 s"),
            ({"time": 1.0, "amplitude": -1.0}, "amplitude must be"),
            ({"time": 1.0, "share": 2.0}, "share must be at most 1"),
            ({"time": 1.0, "count": 1}, "two points or more"),
            ({"time": 1.0, "peak": math.nan}, "peak must be"),
        ):
            with pytest.raises(ValueError, match=text):
                sensor.tremor(**arguments)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({}, "takes one of velocity, path, flow and translation, got none"),
        ({"velocity": (1.0, 0.0), "path": [(0, 0), (1, 1)]}, "got velocity, path"),
        ({"velocity": (1.0, math.nan)}, "velocity has values that are NaN"),
        ({"velocity": (1.0, 0.0, 0.0)}, r"velocity must be \(2,\)"),
        ({"path": [(0.0, 0.0)]}, r"path must be \(N, 2\)"),
        ({"flow": torch.ones(3, 4, 4)}, r"flow must be a tensor \(2, H, W\)"),
        ({"flow": torch.full((2, 4, 4), math.inf)}, "flow has values that are NaN"),
        ({"translation": (1.0,)}, r"translation must be \(2,\)"),
        ({"velocity": (1.0, 0.0), "time": 0.0}, "time must be finite and > 0 s"),
        ({"velocity": (1.0, 0.0), "readout": -0.1}, "readout must be finite and >= 0 s"),
        ({"velocity": (1.0, 0.0), "start": math.nan}, "start must be finite and >= 0 s"),
        ({"path": [(0, 0), (1, 1)], "start": 1.0}, "a path begins where the exposure does"),
        ({"velocity": (1.0, 0.0), "border": "mirror"}, "unknown border"),
        ({"velocity": (1.0, 0.0), "samples": 0}, "samples must be a whole number"),
    ],
)
def test_motions_that_are_none(arguments: dict, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        Motion(**arguments)


def test_far_shifts_of_rows_are_those_of_a_convolution() -> None:
    picture = torch.rand(1, 1, 3, 16, generator=torch.Generator().manual_seed(0)).double()
    path = torch.tensor([[160.0, 0.0]] * 3)
    for border in ("periodic", "reflect", "replicate"):
        rows, whole = (Motion(path=path, time=1e-6, readout=r, border=border)(picture) for r in (1e-12, 0.0))
        assert (rows - whole).abs().max() < 1e-6, border


def test_darkness_moves_in_over_all_depths() -> None:
    motion = Motion(translation=(0.01, 0.0), time=0.5, border="zero")
    depth = torch.ones(1, 1, 8, 32)
    even = motion(torch.ones(1, 1, 8, 32), TestTranslation.context(depth))
    depth[..., 16:] = 1.01
    uneven = motion(torch.ones(1, 1, 8, 32), TestTranslation.context(depth))
    assert (even - uneven).abs()[..., 20:].max() < 0.1
    half = motion(torch.ones(1, 1, 8, 32).half(), TestTranslation.context(depth))
    assert (half - uneven).abs().max() < 2e-3


def test_motions_that_do_not_fit_the_picture() -> None:
    picture = torch.ones(1, 3, 8, 8)
    with pytest.raises(ValueError, match="there are 3 motions for 1 pictures"):
        Motion(torch.ones(3, 2), time=1.0)(picture)
    with pytest.raises(ValueError, match=r"time must be one number of seconds, got shape \(2,\)"):
        Motion((1.0, 0.0), time=torch.tensor([0.1, 0.2]))
    lost = Motion(nn.Parameter(torch.tensor([1.0, 0.0])), time=nn.Parameter(torch.tensor(0.1)))
    lost.time.data.fill_(-1.0)
    with pytest.raises(ValueError, match="exposure time became -1 s in training"):
        lost(picture)
    lost.time.data.fill_(0.1)
    lost.velocity.data.fill_(math.nan)
    with pytest.raises(ValueError, match="NaN or infinite"):
        lost(picture)
    with pytest.raises(ValueError, match=r"flow is \(1, 2, 4, 4\) for a picture"):
        Motion(flow=torch.ones(2, 4, 4), time=0.1)(picture)
    with pytest.raises(ValueError, match="goes over 1e\\+05 pixels, more than 4096"):
        Motion((1e6, 0.0), time=0.1)(picture)
    assert Motion((1.0, 0.0), time=0.1)(torch.ones(0, 3, 4, 4)).shape == (0, 3, 4, 4)
    assert (Motion((300.0, 0.0), time=0.1)(torch.ones(1, 3, 1, 1)) - 1).abs().max() < 1e-5
    assert Motion((3.0, 0.0), time=0.1)(picture.half()).dtype == torch.float16


def moving(*, time: float | None = None, exposure: float | None = None) -> Camera:
    lens = optics.Lens(optics.CircularAperture(4 * mm), optics.ThinLens(12 * mm), focus_distance=2.0)
    shaken = Motion(path=sensor.tremor(0.1, amplitude=4.0, seed=3), time=time, readout=0.02)
    return Camera(
        optics.Imaging(lens, pixel_pitch=4 * um), sensor.ColourFilter.kodak(), shaken, sensor.Mosaic("RGGB"),
        sensor.Exposure(time=exposure), sensor.ShotNoise(10_000), sensor.ADC(12),
    )  # fmt: skip


def test_the_time_of_a_plan_holds_that_of_the_stages() -> None:
    camera, scene = moving(time=0.1), Scene.builtin("coffee", size=48)
    still = Camera(*(stage for stage in camera if not isinstance(stage, Motion)))
    with torch.no_grad():
        plan, without = camera.plan(scene, tolerance=0.02), still.plan(scene, tolerance=0.02)
    row = next(row for row in plan.decisions if row.effect == "Motion")
    assert "sample" in row.chosen
    samples = int(row.chosen.split()[0])
    costs = [stage.cost(torch.zeros(1), camera.resolve()) for stage in (camera[2], camera[2].changed(samples=samples))]
    assert costs[1] < costs[0]
    apart = (plan.reference_seconds - without.reference_seconds, plan.seconds - without.seconds)
    assert apart[0] / apart[1] == pytest.approx(costs[0] / costs[1], rel=0.1)  # noise may be left out of one alone


def test_an_exposure_of_another_time_is_a_contradiction() -> None:
    scene = Scene.builtin("coffee", size=16)
    with pytest.raises(ValueError, match=r"Motion \(stage 2\) has exposure_time = 0.1, Exposure \(stage 4\) .* 0.005"):
        moving(time=0.1, exposure=0.005)(scene)
    one, other = moving(time=0.1, exposure=0.1), moving(exposure=0.1)
    pictures = [camera.noiseless()(scene) for camera in (one, other)]
    assert torch.equal(*pictures)
