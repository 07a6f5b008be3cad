"""Light that goes astray on the sensor: crosstalk, banding, defects, micro-lenses, black clamp, bent response."""

from __future__ import annotations

import copy
import inspect
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import scipy
import torch
from draws import Draw
from torch import Tensor, nn

from kcam import Camera, Context, Scene, isp, optics, sensor
from kcam.effects import Skippable
from kcam.planner import relative_rms
from kcam.sensor.mosaic import PATTERNS, at_pixels, channel_masks
from kcam.units import mm, um

STAGES: dict[str, Callable[[], Any]] = {
    "Crosstalk": lambda: sensor.Crosstalk(0.03, electrical=0.05),
    "RowColumnNoise": lambda: sensor.RowColumnNoise(20.0, column=10.0, fixed_row=5.0, fixed_column=8.0, seed=2),
    "DefectPixels": lambda: sensor.DefectPixels(hot=0.1, dead=0.05, stuck=0.02, electrons=700.0, seed=5),
    "MicrolensShading": lambda: sensor.MicrolensShading(0.4, pupil_distance=0.1 * mm),
    "Nonlinearity": lambda: sensor.Nonlinearity((0.05, 0.02)),
}
FIXED = [name for name in STAGES if name != "RowColumnNoise"]
"""Those that draw nothing."""


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


# ---- what all keep to ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", STAGES)
@pytest.mark.parametrize("shape", [(0, 1, 4, 4), (1, 1, 1, 1), (2, 1, 5, 3), (2, 3, 1, 4), (1, 1, 0, 4)])
@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
def test_any_shape_and_dtype(name: str, shape: tuple[int, ...], dtype: torch.dtype) -> None:
    signal = torch.full(shape, 0.5, dtype=dtype).requires_grad_()
    out = STAGES[name]()(signal)
    assert out.shape == shape
    assert out.dtype == dtype
    out.sum().backward()
    assert signal.grad is not None
    assert signal.grad.isfinite().all()


@pytest.mark.parametrize("name", STAGES)
@pytest.mark.parametrize("level", [0.0, -0.01, 1e-30, 1e6, 1e30])
def test_no_light_and_any_light_stay_finite(name: str, level: float) -> None:
    signal = torch.full((1, 1, 6, 6), level, requires_grad=True)
    out = STAGES[name]()(signal)
    out.sum().backward()
    assert out.isfinite().all()
    assert signal.grad is not None
    assert signal.grad.isfinite().all()


@pytest.mark.parametrize("name", STAGES)
def test_the_input_is_left_alone_and_arguments_rebuild_the_stage(name: str) -> None:
    stage, signal = STAGES[name](), torch.full((1, 1, 6, 5), 0.5)
    before = signal.clone()
    torch.manual_seed(1)
    expected = copy.deepcopy(stage)(signal)
    assert torch.equal(signal, before)
    twin = type(stage)(**{key: getattr(stage, key) for key in inspect.signature(type(stage)).parameters})
    torch.manual_seed(1)
    assert torch.equal(twin(signal), expected)


@pytest.mark.parametrize("name", STAGES)
def test_integers_are_refused(name: str) -> None:
    with pytest.raises(TypeError, match=r"in which 1.0 is the full well .* of torch.uint8. Use signal.float"):
        STAGES[name]()(torch.zeros(1, 1, 2, 2, dtype=torch.uint8))


@pytest.mark.parametrize("name", STAGES)
def test_a_saved_camera_takes_the_same_picture(name: str, tmp_path: Path) -> None:
    camera, scene = Camera(sensor.ColourFilter.kodak(), STAGES[name]()), Scene.builtin("coffee", size=16)
    camera.save(tmp_path / "camera.safetensors")
    again = Camera.load(tmp_path / "camera.safetensors")
    assert torch.equal(again(scene, generator=seeded()), camera(scene, generator=seeded()))


@pytest.mark.parametrize("name", FIXED)
@pytest.mark.parametrize("seed", range(3))
def test_the_error_if_skipped_is_the_change_of_the_signal(name: str, seed: int) -> None:
    stage, signal, context = STAGES[name](), 0.9 * Draw(seed).noise(2, 1, 12, 15), Context()
    assert isinstance(stage, Skippable)
    truth = float((stage(signal, context) - signal).norm() / signal.norm())
    error = stage.error_if_skipped(signal, context)
    assert error == pytest.approx(truth, rel=1e-9)
    assert f"{error:.1e}" in stage.reason(signal, context)
    assert stage.cost(signal, context) > 0
    assert stage.error_if_skipped(signal[:0], context) == 0


def test_the_error_of_stripes_is_their_sigma() -> None:
    stage, signal = STAGES["RowColumnNoise"](), torch.full((1, 1, 700, 700), 0.3, dtype=torch.float64)
    truth = relative_rms(stage(signal, generator=seeded()), signal)
    assert stage.error_if_skipped(signal, Context()) == pytest.approx(truth, rel=0.1)
    assert stage.reason(signal, Context()) == "sigma 24.3 of 3000 electrons"
    assert stage.mean()(signal) is signal


@pytest.mark.parametrize("name", FIXED)
def test_gradients_to_the_light_are_those_of_finite_differences(name: str) -> None:
    signal = (0.1 + 0.8 * Draw(3).noise(2, 1, 4, 5)).requires_grad_()
    assert torch.autograd.gradcheck(STAGES[name](), signal)


LINEAR = ("Crosstalk", "DefectPixels", "MicrolensShading", "RowColumnNoise")


@pytest.mark.parametrize("name", LINEAR)
def test_the_operator_of_a_camera_has_it_and_its_transpose(name: str) -> None:
    scene = Scene.from_rgb(Draw(0).noise(1, 3, 8, 9) * 0.5)
    sharp = [sensor.ColourFilter.kodak(), sensor.Mosaic("GRBG"), sensor.Exposure()]
    camera = Camera(*sharp, STAGES[name](), sensor.ADC(bits=12, rounding=False, black_level=300))
    a, draw = camera.linear(scene), Draw(1)
    x, y = draw.noise(*a.scene_shape) - 0.5, draw.noise(*a.raw_shape) - 0.5
    assert float((a(x) * y).sum()) == pytest.approx(float((x * a.adjoint(y)).sum()), rel=1e-9)
    if name != "RowColumnNoise":
        whole = (a(a.light) + a.offset).clamp(0, 1)  # stuck pixels are beyond the black level's range
        torch.testing.assert_close(whole, camera(scene), rtol=0, atol=1e-12)
    else:
        torch.testing.assert_close(a(a.light) + a.offset, camera.noiseless()(scene), rtol=0, atol=1e-12)
        recorded = a.record(a(a.light), generator=seeded())
        torch.testing.assert_close(recorded, camera(scene, generator=seeded()) - a.offset, rtol=0, atol=1e-12)


def test_a_bent_response_is_no_part_of_the_operator() -> None:
    camera = Camera(sensor.ColourFilter.kodak(), sensor.Mosaic(), sensor.Nonlinearity(0.05), sensor.ADC())
    with pytest.raises(ValueError, match=r"Nonlinearity \(stage 2\) is not linear in the light"):
        camera.linear(Scene.from_rgb(torch.rand(3, 8, 8)))


# ---- crosstalk -----------------------------------------------------------------------------------------------------


def shares_by_hand(optical: float, electrical: float) -> Tensor:
    q = (1 - math.sqrt(1 - electrical)) / 2
    diffusion = torch.tensor([q, 1 - 2 * q, q], dtype=torch.float64)
    kernel = diffusion[:, None] * diffusion
    kernel[1, 1] -= optical
    for y, x in ((0, 1), (1, 0), (1, 2), (2, 1)):
        kernel[y, x] += optical / 4
    return kernel


@pytest.mark.parametrize("seed", range(5))
def test_a_kernel_keeps_all_light_and_what_its_shares_say(seed: int) -> None:
    draw = Draw(seed)
    optical, electrical = draw.number(0, 0.4), draw.number(0, 0.6)
    kernel = sensor.crosstalk_kernel(optical, electrical)
    torch.testing.assert_close(kernel, shares_by_hand(optical, electrical), rtol=1e-12, atol=1e-14)
    assert float(kernel.sum()) == pytest.approx(1.0, abs=1e-12)
    assert float(kernel[1, 1]) == pytest.approx(1 - optical - electrical, abs=1e-12)
    assert torch.equal(sensor.crosstalk_kernel(0.0, 0.0), shares_by_hand(0.0, 0.0))


@pytest.mark.parametrize("pattern", PATTERNS)
def test_every_pixel_gives_by_the_channel_that_it_is_of(pattern: str) -> None:
    """One bright pixel after the other, by hand: the channel of the source decides, not that of the neighbour."""
    masks = channel_masks(pattern, 8, 9)
    count = len(masks)
    optical, electrical = torch.linspace(0.02, 0.08, count).double(), torch.linspace(0.3, 0.05, count).double()
    stage = sensor.Crosstalk(optical, electrical=electrical)
    for y, x in ((2, 2), (3, 4), (4, 5), (5, 3)):
        signal = torch.zeros(1, 1, 8, 9, dtype=torch.float64)
        signal[..., y, x] = 0.5
        channel = int(masks[:, y, x].nonzero())
        expected = torch.zeros_like(signal)
        expected[0, 0, y - 1 : y + 2, x - 1 : x + 2] = 0.5 * shares_by_hand(
            float(optical[channel]), float(electrical[channel])
        )
        torch.testing.assert_close(stage(signal, Context(pattern=pattern)), expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_crosstalk_conserves_light_up_to_the_edges(seed: int) -> None:
    draw = Draw(seed)
    signal = draw.noise(2, 1, *draw.one_of((7, 6), (1, 8), (1, 1), (12, 3)))
    shares = [[draw.number(0, 0.4) for _ in range(3)] for _ in range(2)]
    mixed = sensor.Crosstalk(shares[0], electrical=shares[1])(signal)
    torch.testing.assert_close(mixed.sum((-2, -1)), signal.sum((-2, -1)), rtol=1e-12, atol=0)
    assert (mixed >= 0).all()


def test_full_planes_are_blurred_each_by_its_own() -> None:
    signal = Draw(0).noise(1, 3, 6, 7)
    optical = torch.tensor([0.1, 0.05, 0.0], dtype=torch.float64)
    mixed = sensor.crosstalk(signal, optical=optical, electrical=0.0)
    assert torch.equal(mixed[:, 2], signal[:, 2])
    alone = sensor.crosstalk(signal[:, :1], optical=0.1, electrical=0.0)
    torch.testing.assert_close(mixed[:, :1], alone)


def test_crosstalk_takes_colour_away() -> None:
    """Behind a mosaic it mixes: an even red loses saturation in every pixel of the demosaiced picture."""
    red = torch.tensor([0.8, 0.1, 0.1]).view(1, 3, 1, 1).expand(1, 3, 12, 12)
    raw = sensor.mosaic(red, pattern="RGGB")
    mixed = sensor.Crosstalk(0.08, electrical=(0.12, 0.08, 0.05))(raw)
    assert float(mixed[0, 0, 4, 4]) < 0.7
    assert float(mixed[0, 0, 4, 5]) > 0.1 + 2 * (0.08 / 4) * 0.7  # a green beside two reds


def test_crosstalk_of_the_numbers_trains() -> None:
    signal = Draw(2).noise(1, 1, 4, 4)
    optical = torch.tensor([0.1, 0.05, 0.02], dtype=torch.float64, requires_grad=True)
    electrical = torch.tensor([0.2, 0.0, 0.1], dtype=torch.float64, requires_grad=True)

    def mixed(optical: Tensor, electrical: Tensor) -> Tensor:
        return sensor.crosstalk(signal, optical=optical, electrical=electrical, pattern="BGGR")

    assert torch.autograd.gradcheck(mixed, (optical, electrical.detach().add(0.05).requires_grad_()))
    mixed(optical, electrical).square().sum().backward()  # at no diffusion at all the slope is finite too
    assert electrical.grad is not None
    assert electrical.grad.isfinite().all()
    assert list(sensor.Crosstalk(nn.Parameter(torch.tensor(0.1))).parameters())


def test_values_at_pixels() -> None:
    signal = torch.zeros(2, 1, 5, 7)
    found = at_pixels(torch.arange(3.0), signal, pattern="x_trans", name="shares")
    expected = (channel_masks("x_trans", 5, 7) * torch.arange(3.0)[:, None, None]).sum(0, keepdim=True)
    assert torch.equal(found, expected)
    with pytest.raises(ValueError, match=r"shares has 4 values for 1 channels. .*, or 1, or 3 of the pattern 'RGGB'"):
        at_pixels(torch.arange(4.0), signal, pattern="RGGB", name="shares")
    with pytest.raises(ValueError, match=r"shares has 2 values for 3 channels. Give one number for all, or 3."):
        at_pixels(torch.arange(2.0), torch.zeros(3, 5, 7), pattern="RGGB", name="shares")


# ---- banding -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
def test_the_variances_of_rows_columns_and_pixels_are_emva_s(seed: int) -> None:
    """sigma^2 = sigma_row^2 + sigma_column^2 + sigma_pixel^2, by the variances of means: release 4.0."""
    draw, size, well = Draw(seed), 900, 5000.0
    row, column, pixel = (draw.number(1, 6) for _ in range(3))
    stages = [sensor.RowColumnNoise(row, column=column, fixed_column=0.0), sensor.ReadNoise(pixel, full_well=well)]
    frame = torch.zeros(1, 1, size, size, dtype=torch.float64)
    for stage in stages:
        frame = well * stage(frame / well, Context(full_well=well), generator=seeded(seed + 7 * len(frame)))
    rows, columns = frame[0, 0].mean(1), frame[0, 0].mean(0)
    total, of_rows, of_columns = float(frame.var()), float(rows.var()), float(columns.var())
    # variances of means hold the others' too, over the number that they are means of
    found_row, found_column = of_rows - pixel**2 / size, of_columns - pixel**2 / size
    spread = 4 * math.sqrt(2 / size)
    assert found_row == pytest.approx(row**2, rel=spread)
    assert found_column == pytest.approx(column**2, rel=spread)
    assert total - found_row - found_column == pytest.approx(
        pixel**2, rel=0.05 + spread * (row**2 + column**2) / pixel**2
    )
    residue = frame[0, 0] - rows[:, None] - columns + frame.mean()
    assert float(residue.var()) == pytest.approx(pixel**2, rel=0.02)


def test_stripes_of_a_frame_and_of_a_sensor() -> None:
    dark = torch.zeros(3, 3, 9, 11)
    fixed = sensor.RowColumnNoise(0.0, fixed_row=3.0, fixed_column=2.0, seed=4)
    one, two = fixed(dark, generator=seeded(1)), fixed(dark, generator=seeded(2))
    assert torch.equal(one, two)
    assert torch.equal(one[0, 0], one[2, 1])
    assert not torch.equal(one, sensor.RowColumnNoise(0.0, fixed_row=3.0, fixed_column=2.0, seed=5)(dark))
    moving = sensor.RowColumnNoise(3.0, column=2.0, fixed_column=0.0)
    one, two = moving(dark, generator=seeded(1)), moving(dark, generator=seeded(2))
    assert not torch.equal(one, two)
    assert torch.equal(one, moving(dark, Context(generator=seeded(1))))
    assert torch.equal(one[:, 0], one[:, 2])  # the channels of a pixel are read together
    assert not torch.equal(one[0], one[1])
    # rank one each: rows and columns add
    assert float((one[0, 0] - one[0, 0, :, :1] - one[0, 0, :1] + one[0, 0, 0, 0]).abs().max()) < 1e-9


def test_stripes_are_reparameterised() -> None:
    sigmas = [torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in (2.0, 3.0)]
    signal = Draw(0).noise(2, 1, 3, 4).requires_grad_()

    def striped(signal: Tensor, row: Tensor, column: Tensor) -> Tensor:
        own = {"row": row, "column": column, "full_well": 100.0}
        moving = sensor.row_column_noise(signal, generator=seeded(3), **own)
        return sensor.fixed_stripes(moving, seed=1, **own)

    assert torch.autograd.gradcheck(striped, (signal, *sigmas))
    each = sensor.RowColumnNoise(torch.tensor([0.0, 50.0]).view(2, 1, 1, 1), fixed_column=0.0)(torch.zeros(2, 1, 40, 4))
    assert each[0].abs().max() == 0
    assert each[1].std() > 0.002


# ---- defects -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
def test_there_are_as_many_defects_as_their_shares_say(seed: int) -> None:
    draw, size = Draw(seed), 300
    hot, dead, stuck = (10 ** draw.number(-3, -1) for _ in range(3))
    stage = sensor.DefectPixels(hot, dead=dead, stuck=stuck, electrons=2000.0, seed=seed)
    light = torch.full((1, 1, size, size), 0.25, dtype=torch.float64)
    shot = stage(light)
    kinds = {"hot": (hot, (shot > 0.25) & (shot != 1)), "dead": (dead, shot == 0), "stuck": (stuck, shot == 1)}
    for share, found in kinds.values():
        count = size**2 * share
        assert float(found.sum()) == pytest.approx(count, abs=5 * math.sqrt(count * (1 - share)))
    tail = (shot - light)[kinds["hot"][1]] * 10_000
    assert float(tail.mean()) == pytest.approx(2000, abs=5 * 2000 / math.sqrt(len(tail)))
    assert scipy.stats.kstest(tail.numpy(), scipy.stats.expon(scale=2000).cdf).pvalue > 1e-3
    assert torch.equal(shot[~(kinds["hot"][1] | kinds["dead"][1] | kinds["stuck"][1])].unique(), torch.tensor([0.25]))


def test_the_same_pixels_in_every_frame_and_more_of_a_larger_share() -> None:
    frames = torch.full((2, 1, 80, 80), 0.3)
    few, many = (sensor.DefectPixels(hot, dead=0.01, seed=1)(frames) for hot in (0.01, 0.05))
    assert torch.equal(few[0], few[1])
    hot_few, hot_many = few[0] > 0.3, many[0] > 0.3
    assert (hot_few <= hot_many).all()
    assert torch.equal(few[0] == 0, many[0] == 0)
    assert not torch.equal(few, sensor.DefectPixels(0.01, dead=0.01, seed=2)(frames))
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    sensor.DefectPixels()(frames)
    assert torch.equal(torch.rand(3), expected)


def test_hot_electrons_are_counted_one_by_one() -> None:
    """Before ShotNoise a hot pixel is as noisy as light of as many electrons."""
    stages = [sensor.DefectPixels(1.0, dead=0.0, electrons=400.0, seed=3), sensor.ShotNoise(20_000.0)]
    dark = torch.zeros(2000, 1, 1, 3, dtype=torch.float64)
    rate = 20_000 * stages[0](dark[:1], Context(full_well=20_000.0))
    counts = 20_000 * Camera(*stages)(dark, generator=seeded())
    torch.testing.assert_close(counts.mean(0), rate[0], rtol=0.02, atol=0.5)
    torch.testing.assert_close(counts.var(0), rate[0], rtol=0.15, atol=0.5)


def test_electrons_of_hot_pixels_train() -> None:
    electrons = torch.tensor(300.0, dtype=torch.float64, requires_grad=True)
    signal = Draw(0).noise(1, 1, 5, 5).requires_grad_()

    def shot(signal: Tensor, electrons: Tensor) -> Tensor:
        return sensor.defect_pixels(signal, hot=0.4, dead=0.2, electrons=electrons, full_well=1000.0, stuck=0.1, seed=2)

    assert torch.autograd.gradcheck(shot, (signal, electrons))
    assert sensor.DefectPixels(full_well=500.0).provides() == {"full_well": 500.0}
    assert sensor.DefectPixels().provides() == {}


def test_infinite_light_on_a_dead_pixel_is_none() -> None:
    shot = sensor.DefectPixels(0.0, dead=1.0)(torch.full((1, 1, 2, 2), math.inf))
    assert (shot == 0).all()


# ---- micro-lenses --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(5))
def test_the_corner_has_its_chief_ray_s_response(seed: int) -> None:
    draw = Draw(seed)
    height, width = (2 * int(draw.number(4, 20)) + 1 for _ in "hw")
    pitch, distance = draw.number(5, 50) * um, draw.number(0.5, 3) * mm
    acceptance, design = draw.number(0.1, 0.6), draw.one_of(None, draw.number(0.5, 3) * mm)
    stage = sensor.MicrolensShading(acceptance, pupil_distance=distance, design_distance=design)
    seen = stage(torch.ones(1, 1, height, width, dtype=torch.float64), Context(pixel_pitch=pitch))[0, 0]
    radius = pitch * math.hypot((height - 1) / 2, (width - 1) / 2)
    angle = math.atan2(radius, distance) - (0 if design is None else math.atan2(radius, design))
    assert float(seen[0, 0]) == pytest.approx(0.5 ** ((angle / acceptance) ** 2), rel=1e-9)
    assert float(seen[height // 2, width // 2]) == 1.0
    assert torch.allclose(seen, seen.flip(0, 1), atol=1e-12)


def test_micro_lenses_made_for_the_pupil_shade_nothing() -> None:
    signal = Draw(0).noise(1, 1, 9, 9)
    stage = sensor.MicrolensShading(0.2, pupil_distance=1 * mm, design_distance=1 * mm)
    torch.testing.assert_close(stage(signal), signal, rtol=0, atol=1e-15)


def test_each_colour_has_its_acceptance_and_the_mosaic_s_are_those_of_full_planes() -> None:
    stage = sensor.MicrolensShading((0.5, 0.4, 0.3), pupil_distance=0.1 * mm)
    white = torch.ones(1, 3, 13, 14, dtype=torch.float64)
    full = stage(white)
    assert (full[0, 0, 0, 0] > full[0, 1, 0, 0]) & (full[0, 1, 0, 0] > full[0, 2, 0, 0])
    raw = stage(sensor.mosaic(white, pattern="GBRG"), Context(pattern="GBRG"))
    torch.testing.assert_close(raw, sensor.mosaic(full, pattern="GBRG"))


def test_the_pupil_is_the_lens_s() -> None:
    white, stage = torch.ones(1, 1, 5, 201, dtype=torch.float64), sensor.MicrolensShading(0.3)
    thin = optics.Lens(optics.CircularAperture(1 * mm), optics.ThinLens(2 * mm), sensor_distance=2.5 * mm)
    given = sensor.MicrolensShading(0.3, pupil_distance=2.5 * mm)
    torch.testing.assert_close(stage(white, Context(lens=thin)), given(white))
    phone = optics.CompoundLens.preset("phone")
    pupil = float(phone.sensor_distance) - float(phone.first_order().exit_pupil)
    assert float(sensor.exit_pupil_distance(phone)) == pytest.approx(pupil)
    given = sensor.MicrolensShading(0.3, pupil_distance=pupil)
    torch.testing.assert_close(stage(white, Context(lens=phone)).detach(), given(white))
    aside = sensor.MicrolensShading(0.3, pupil_distance=2.5 * mm, centre=(0.1 * mm, 0.0))
    seen = aside(white)[0, 0, 2]
    assert int(seen.argmax()) == 100 + 25  # pictures are upright: what lies at +x on the sensor is on their left
    assert float(seen.max()) == pytest.approx(1.0)


def test_angles_train() -> None:
    numbers = [torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in (0.3, 1.0, 2.0)]
    radius = torch.linspace(0, 1, 7, dtype=torch.float64)

    def response(acceptance: Tensor, pupil: Tensor, design: Tensor) -> Tensor:
        return sensor.microlens_response(radius, acceptance=acceptance, pupil_distance=pupil, design_distance=design)

    assert torch.autograd.gradcheck(response, numbers)
    stage = sensor.MicrolensShading(nn.Parameter(torch.tensor([0.4, 0.4, 0.4])), pupil_distance=0.1 * mm)
    stage(torch.ones(1, 1, 5, 5)).sum().backward()
    assert stage.acceptance.grad is not None
    assert (stage.acceptance.grad > 0).all()


def test_exposure_does_not_make_up_for_the_shading() -> None:
    white = Scene.from_rgb(torch.ones(3, 31, 31))
    shading = sensor.MicrolensShading(0.3, pupil_distance=0.2 * mm)
    stages = [sensor.ColourFilter.kodak(), sensor.Exposure()]
    even = Camera(*stages)(white)
    shaded = Camera(stages[0], shading, stages[1])(white)
    torch.testing.assert_close(shaded[..., 15, 15], even[..., 15, 15])
    assert float((shaded / even)[..., 0, 0].max()) < 0.95


# ---- the black clamp -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sigma", [0.002, 0.01])
def test_a_clamp_at_black_lifts_the_dark_by_its_noise(sigma: float) -> None:
    noise = sigma * torch.randn(400_000, generator=seeded(), dtype=torch.float64).view(1, 1, 400, 1000)
    arguments = {"bits": 16, "black_level": 4096.0}
    level = 4096 / 65535
    kept, clamped = (sensor.quantise(noise, clamp_black=clamp, **arguments) - level for clamp in (False, True))
    step = sigma / math.sqrt(noise.numel())
    assert float(kept.mean()) == pytest.approx(0, abs=5 * step)
    assert float(clamped.mean()) == pytest.approx(sigma / math.sqrt(2 * math.pi), abs=5 * step)
    assert float(clamped.square().mean()) == pytest.approx(sigma**2 / 2, rel=0.02)
    assert float(clamped.min()) == pytest.approx(0, abs=1e-12)
    torch.testing.assert_close(clamped, kept.clamp(min=0), rtol=0, atol=1e-12)


def test_a_clamp_is_an_argument_that_stays_in_a_plan() -> None:
    adc = sensor.ADC(bits=10, black_level=64, clamp_black=True)
    assert adc.bypass().clamp_black
    assert adc.reason(torch.ones(1), Context()).endswith("black clamped")
    below = torch.tensor([-0.01], requires_grad=True)
    adc(below).sum().backward()  # clip_ste: descending would push it further out
    assert below.grad == 0
    (below_again := below.detach().requires_grad_())
    (-adc(below_again).sum()).backward()
    assert below_again.grad == -1
    black = Scene.from_rgb(torch.zeros(3, 64, 64))
    means = []
    for clamp in (False, True):
        stages = [sensor.ReadNoise(5.0, full_well=5000), sensor.ADC(bits=14, black_level=500, clamp_black=clamp)]
        camera = Camera(sensor.ColourFilter.kodak(), sensor.Mosaic(), *stages, isp.Demosaic(method="bilinear"))
        means.append(5000 * float(camera(black, generator=seeded()).mean()))
    assert means[1] - means[0] == pytest.approx(5 / math.sqrt(2 * math.pi), rel=0.1)


# ---- the response --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(5))
def test_a_response_keeps_its_ends_and_rises(seed: int) -> None:
    draw = Draw(seed)
    a = torch.tensor([draw.number(-0.2, 0.2), draw.number(-0.1, 0.1), draw.number(-0.05, 0.05)], dtype=torch.float64)
    x = torch.linspace(-0.5, 1.5, 401, dtype=torch.float64)
    y = sensor.Nonlinearity(a)(x)
    assert float(y[100]) == pytest.approx(0, abs=1e-12)
    assert float(y[300]) == pytest.approx(1, abs=1e-12)
    assert (y.diff() > 0).all()
    inside = x[100:301]
    by_hand = inside + sum(c * (inside - inside**k) for k, c in enumerate(a.tolist(), start=2))
    torch.testing.assert_close(y[100:301], by_hand, rtol=1e-12, atol=1e-14)
    for part in (y[:101], y[300:]):  # tangents
        assert float(part.diff().diff().abs().max()) < 1e-12
    slope = (y[301] - y[299]) / (x[301] - x[299])
    assert float(slope) == pytest.approx(1 - float(a @ torch.tensor([1.0, 2.0, 3.0]).double()), abs=2e-2)


def test_gradients_of_the_response() -> None:
    a = torch.tensor([0.1, -0.05], dtype=torch.float64, requires_grad=True)
    x = torch.tensor([-0.3, 0.2, 0.7, 1.4], dtype=torch.float64, requires_grad=True)

    def bent(x: Tensor, a: Tensor) -> Tensor:
        return sensor.nonlinear_response(x, coefficients=a)

    assert torch.autograd.gradcheck(bent, (x, a))
    ends = torch.tensor([0.0, 1.0], dtype=torch.float64, requires_grad=True)
    (slopes,) = torch.autograd.grad(bent(ends, a.detach()).sum(), ends)
    torch.testing.assert_close(slopes, torch.tensor([1.05, 1.0], dtype=torch.float64))


def test_the_linearity_error_is_that_of_the_best_line() -> None:
    x = torch.linspace(0.05, 0.95, 40, dtype=torch.float64)
    y = 700 * sensor.Nonlinearity((0.06, 0.02))(x) + 3

    def distance(line) -> float:
        return float(((y - line[0] - line[1] * x) / y).square().sum())

    best = scipy.optimize.minimize(distance, [0, 700], method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-16})
    expected = float((y / (best.x[0] + best.x[1] * x) - 1).abs().mean())
    full = torch.cat([x, torch.ones(1).double()]), torch.cat([y, torch.tensor([703.0]).double()])
    assert sensor.linearity_error(*full) == pytest.approx(expected, rel=1e-4)
    assert sensor.Nonlinearity(0.0).linearity_error() < 1e-12


def test_a_measured_curve_becomes_a_stage() -> None:
    truth = sensor.Nonlinearity((0.04, 0.03))
    x = torch.linspace(0, 1, 25, dtype=torch.float64)
    found = sensor.Nonlinearity.from_curve(x, truth(x), degree=3)
    torch.testing.assert_close(found.coefficients.double(), truth.coefficients.double(), rtol=1e-4, atol=1e-6)
    with pytest.raises(ValueError, match="shares of the full well, 0..1. Divide by what a full well gives"):
        sensor.Nonlinearity.from_curve(x, 4095 * x)
    with pytest.raises(ValueError, match="as many values, at least 2, got 25 and 3"):
        sensor.Nonlinearity.from_curve(x, x[:3])
    with pytest.raises(ValueError, match="degree must be 2 to 6, got 9"):
        sensor.Nonlinearity.from_curve(x, x, degree=9)


@pytest.mark.parametrize(
    ("build", "error", "text"),
    [
        (lambda: sensor.Crosstalk(1.2), ValueError, "optical must be a share from 0 to 1, .* got 1.2"),
        (lambda: sensor.Crosstalk(electrical=-0.1), ValueError, "electrical must be a share from 0 to 1, .* got -0.1"),
        (lambda: sensor.Crosstalk("much"), TypeError, "optical must be a share"),
        (lambda: sensor.Crosstalk(0.6, electrical=0.6), ValueError, "together are 1.2, more than all light. .* 0.02"),
        (lambda: sensor.Crosstalk((0.1, 0.1), electrical=(0.1,) * 3), ValueError, "are for 3 and 2 channels"),
        (lambda: sensor.Crosstalk(torch.ones(2, 2) / 9), ValueError, r"got shape \(2, 2\)"),
        (
            lambda: sensor.Crosstalk((0.1, 0.1))(torch.ones(1, 1, 4, 4)),
            ValueError,
            "2 values for 1 channels. Give one number for all, or 1, or 3 of the pattern 'RGGB'",
        ),
        (lambda: sensor.RowColumnNoise(-1.0), ValueError, "row must be finite and >= 0 electrons, got -1"),
        (lambda: sensor.RowColumnNoise(fixed_column=-2.0), ValueError, "fixed_column must be finite"),
        (lambda: sensor.RowColumnNoise(seed=0.5), TypeError, "seed must be an integer such as 0, got 0.5"),
        (lambda: sensor.RowColumnNoise(full_well=0.0), ValueError, "full_well must be finite and > 0"),
        (lambda: sensor.RowColumnNoise()(torch.rand(3, 4)), ValueError, r"got shape \(3, 4\). Use signal\[None\]"),
        (lambda: sensor.DefectPixels(2.0), ValueError, "hot must be a share of the pixels from 0 to 1, .* got 2"),
        (lambda: sensor.DefectPixels(0.6, dead=0.6), ValueError, "are 1.2 of the pixels together, more than all"),
        (lambda: sensor.DefectPixels(dead=math.nan), ValueError, "dead must be a share .* got nan"),
        (lambda: sensor.DefectPixels(electrons=-1.0), ValueError, "electrons must be finite and >= 0"),
        (lambda: sensor.DefectPixels(seed=True), TypeError, "seed must be an integer"),
        (lambda: sensor.MicrolensShading(25.0), ValueError, r"got 25; did you mean math.radians\(25\)\?"),
        (lambda: sensor.MicrolensShading(0.0), ValueError, r"acceptance must be 0.01 to pi / 2 rad, .* got 0\."),
        (lambda: sensor.MicrolensShading(pupil_distance=0.0), ValueError, "pupil_distance 0 is outside"),
        (lambda: sensor.MicrolensShading(pupil_distance=10), ValueError, r"pupil_distance 10 .*did you mean 10 \* mm"),
        (lambda: sensor.MicrolensShading(design_distance=10), ValueError, r"design_distance 10 .*mean 10 \* mm"),
        (lambda: sensor.Crosstalk(30), ValueError, r"optical must be a share .*got 30.* did you mean 0.3\?"),
        (lambda: sensor.Crosstalk(0.0, electrical=(3, 2, 2)), ValueError, r"electrical .*got 3.* did you mean 0.03\?"),
        (lambda: sensor.DefectPixels(2), ValueError, r"got 2. It is a share, not percent; did you mean 0.02\?"),
        (lambda: sensor.DefectPixels(True), TypeError, "hot must be a share of the pixels such as 1e-4, got True"),
        (lambda: sensor.RowColumnNoise(True), TypeError, "row must be a number >= 0 electrons, got True"),
        (lambda: sensor.ADC(12, clamp_black="yes"), TypeError, "clamp_black must be True or False, got 'yes'"),
        (lambda: sensor.ADC(12, clamp_black=None), TypeError, "clamp_black must be True or False, got None"),
        (lambda: sensor.ADC(12, rounding=1), TypeError, "rounding must be True or False, got 1"),
        (lambda: sensor.MicrolensShading(centre=(3.0, 0.0)), ValueError, "centre must be x and y on the sensor"),
        (
            lambda: sensor.MicrolensShading()(torch.ones(1, 1, 4, 4)),
            ValueError,
            r"no lens that knows it: .* give pupil_distance=5 \* mm",
        ),
        (lambda: sensor.Nonlinearity(1.5), ValueError, "falls at 1 of the full well, by a slope of -0.5"),
        (lambda: sensor.Nonlinearity(math.inf), ValueError, "coefficients must be finite numbers"),
        (lambda: sensor.Nonlinearity("bent"), TypeError, "coefficients must be a number such as 0.02, or several"),
        (lambda: sensor.linearity_error(torch.ones(2), torch.ones(2)), ValueError, "at least 3 responses above 0"),
        (lambda: sensor.linearity_error(torch.ones(2), torch.ones(3)), ValueError, "as many values, got 2 and 3"),
    ],
)
def test_errors(build, error: type[Exception], text: str) -> None:
    with pytest.raises(error, match=text):
        build()


def test_a_clamp_is_saved_where_there_is_one(tmp_path: Path) -> None:
    scene = Scene.from_rgb(torch.zeros(3, 8, 8))
    for clamp in (False, True):
        stages = [sensor.ReadNoise(50.0), sensor.ADC(bits=10, black_level=64, clamp_black=clamp)]
        camera = Camera(sensor.ColourFilter.kodak(), sensor.Mosaic(), *stages)
        camera.save(tmp_path / "camera.safetensors")
        assert b"clamp_black" in (tmp_path / "camera.safetensors").read_bytes() or not clamp
        again = Camera.load(tmp_path / "camera.safetensors")
        assert again[-1].clamp_black is clamp
        assert torch.equal(again(scene, generator=seeded()), camera(scene, generator=seeded()))
        assert ("clamp_black=True" in str(again)) is clamp
