import copy
import inspect
import math
import random
from collections import Counter
from collections.abc import Callable

import pytest
import torch
from torch import Tensor, nn

from kcam.context import Context
from kcam.sensor import ADC, DarkCurrent, FixedPattern, Mean, ReadNoise, ShotNoise, poisson, shot_noise
from kcam.sensor.noise import RandomStage

STAGES = {
    "ShotNoise": lambda: ShotNoise(5000.0),
    "ReadNoise": lambda: ReadNoise(3.0),
    "DarkCurrent": lambda: DarkCurrent(20.0, time=0.5),
    "FixedPattern": lambda: FixedPattern(0.02, dsnu=4.0, seed=3),
}
DRAWING = ["ShotNoise", "ReadNoise", "DarkCurrent"]


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def test_variance_against_mean_follows_the_photon_transfer_line():
    # EMVA 1288: sigma_y^2 = K^2 sigma_d^2 + 1/12 + K mu_y with K = gain (2^bits - 1) / full_well
    full_well, sigma, g = 10_000.0, 5.0, seeded(1)
    gain = 2.0
    k = gain * 4095 / full_well
    means, variances = [], []
    for level in torch.linspace(0.01, 0.45, 8).tolist():
        signal = torch.full((1, 1, 200, 200), level, dtype=torch.float64)
        y = ShotNoise(full_well)(signal, generator=g)
        y = ReadNoise(sigma, full_well=full_well)(y, generator=g)
        y = ADC(12, black_level=64.0, gain=gain)(y) * 4095 - 64
        means.append(y.mean())
        variances.append(y.var())
        assert y.mean().item() == pytest.approx(gain * 4095 * level, rel=2e-3)
    mean, variance = torch.stack(means), torch.stack(variances)
    slope = ((mean - mean.mean()) * (variance - variance.mean())).sum() / (mean - mean.mean()).square().sum()
    assert slope.item() == pytest.approx(k, rel=0.015)
    expected = k**2 * sigma**2 + 1 / 12 + k * mean
    assert ((variance / expected - 1).abs() < 0.035).all()  # 5 standard errors of a variance from 40 000 pixels


def test_dark_frame_shows_the_read_noise():
    frame = ReadNoise(4.0)(torch.zeros(1, 1, 300, 300, dtype=torch.float64), generator=seeded()) * 10_000
    assert frame.mean().item() == pytest.approx(0, abs=0.06)
    assert frame.std().item() == pytest.approx(4.0, rel=0.01)


@pytest.mark.parametrize("rate", [0.0, 0.05, 0.7, 1.0, 3.0, 40.0, 1e4])
def test_the_poisson_gradient_is_its_formula_and_unbiased(rate):
    electrons = torch.full((200_000,), rate, dtype=torch.float64, requires_grad=True)
    count = poisson(electrons, generator=seeded(2))
    count.sum().backward()
    formula = 1 + (count - rate) / (2 * max(rate, 1.0))
    torch.testing.assert_close(electrons.grad, formula.detach(), rtol=0, atol=0)
    error = electrons.grad.std() / 200_000**0.5
    assert abs(electrons.grad.mean() - 1) <= 5 * error
    assert count.mean().item() == pytest.approx(rate, abs=5 * (max(rate, 1e-9) / 200_000) ** 0.5)


def test_the_poisson_gradient_of_a_curved_loss_is_nearly_right():
    # d/d lambda E[N^2] = 2 lambda + 1; the surrogate's mean is 2 lambda + lambda / max(lambda, 1)
    for rate in (2.0, 50.0):
        electrons = torch.full((400_000,), rate, dtype=torch.float64, requires_grad=True)
        poisson(electrons, generator=seeded(3)).square().sum().backward()
        assert electrons.grad.mean().item() == pytest.approx(2 * rate + 1, rel=0.01)


def test_shot_noise_at_the_edges_is_finite():
    signal = torch.tensor([-0.5, 0.0, 1e-9, 0.5, 1.0, 3.0, 1e9, torch.inf], requires_grad=True)
    out = ShotNoise(1000.0)(signal, generator=seeded())
    assert out[:2].tolist() == [0.0, 0.0]
    assert out[-3:].tolist() == [1.0, 1.0, 1.0]
    assert (out <= 1).all()
    (out * torch.linspace(-1, 1, 8)).sum().backward()
    assert signal.grad.isfinite().all()
    assert signal.grad[0] != 0  # pushed up, towards the range


def test_saturation_lets_light_be_taken_away_but_not_added():
    for slope, expected in ((1.0, True), (-1.0, False)):
        signal = torch.full((1, 1, 1, 1), 2.0, requires_grad=True)
        (ShotNoise(100.0)(signal, generator=seeded()) * slope).sum().backward()
        assert bool(signal.grad.item() != 0) is expected


def test_small_full_wells_and_trainable_ones():
    assert ShotNoise(1.0)(torch.full((100,), 50.0), generator=seeded()).min() == 1.0
    full_well = nn.Parameter(torch.tensor(200.0))
    stage = ShotNoise(full_well)
    stage(torch.full((1, 1, 50, 50), 0.5, dtype=torch.float64), generator=seeded()).sum().backward()
    assert full_well.grad.isfinite()
    assert stage.provides()["full_well"] is full_well


def test_read_noise_is_reparameterised():
    sigma = nn.Parameter(torch.tensor(3.0, dtype=torch.float64))
    signal = torch.rand(2, 1, 3, 4, dtype=torch.float64, requires_grad=True)

    def run(x, s):
        return ReadNoise(s, full_well=100.0)(x, generator=seeded(4))

    assert torch.autograd.gradcheck(run, (signal, sigma))
    noise = (run(signal, sigma) - signal).detach() * 100 / 3
    (slope,) = torch.autograd.grad(run(signal, sigma).sum(), sigma)
    torch.testing.assert_close(slope, noise.sum() / 100)
    assert torch.equal(ReadNoise(0.0)(signal), signal)


def test_dark_current_has_its_mean_and_variance_and_doubles():
    stage = DarkCurrent(40.0, time=2.0, temperature=41.0)
    assert stage.electrons() == pytest.approx(40 * 2 * 4)
    frame = stage(torch.full((1, 1, 200, 200), 0.1, dtype=torch.float64), generator=seeded()) * 10_000 - 1000
    assert frame.mean().item() == pytest.approx(320, rel=2e-3)
    assert frame.var().item() == pytest.approx(320, rel=0.03)
    assert DarkCurrent(40.0, time=2.0).electrons() == 80
    assert DarkCurrent(1e7, time=1.0)(torch.zeros(1, 1, 2, 2)).max() == 1.0
    temperature = nn.Parameter(torch.tensor(25.0))
    stage = DarkCurrent(nn.Parameter(torch.tensor(9.0)), time=1.0, temperature=temperature)
    stage(torch.zeros(1, 1, 3, 3), generator=seeded()).sum().backward()
    assert stage.electrons_per_second.grad.isfinite()
    assert temperature.grad.isfinite()


def test_fixed_pattern_is_the_same_in_every_frame_of_one_sensor():
    stage = FixedPattern(0.01, dsnu=2.0, seed=7)
    flat = torch.full((2, 1, 150, 151), 0.5, dtype=torch.float64)
    first, dark = stage(flat), stage(torch.zeros_like(flat))
    assert torch.equal(first[0], first[1])
    assert torch.equal(first, stage(flat))
    torch.manual_seed(99)
    assert torch.equal(first, FixedPattern(0.01, dsnu=2.0, seed=7)(flat))
    assert not torch.equal(first, FixedPattern(0.01, dsnu=2.0, seed=8)(flat))
    # EMVA 1288: DSNU from the dark frame, PRNU from the difference of the bright and the dark one
    assert dark[0].std().item() * 10_000 == pytest.approx(2.0, rel=0.03)
    assert (first - dark)[0].std().item() / 0.5 == pytest.approx(0.01, rel=0.03)


def test_fixed_pattern_does_not_draw_from_the_global_generator():
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    FixedPattern()(torch.rand(1, 1, 3, 3, generator=seeded()))
    assert torch.equal(torch.rand(3), expected)


def test_fixed_pattern_gradcheck():
    signal = torch.rand(2, 1, 3, 5, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(FixedPattern(0.1, dsnu=100.0), signal)
    stage = FixedPattern(nn.Parameter(torch.tensor(0.1)), dsnu=nn.Parameter(torch.tensor(2.0)))
    stage(signal).sum().backward()
    assert stage.prnu.grad.isfinite()
    assert stage.dsnu.grad.isfinite()


@pytest.mark.parametrize("name", DRAWING)
def test_the_generator_decides(name):
    stage, signal = STAGES[name](), torch.full((2, 1, 9, 7), 0.3)
    one = stage(signal, generator=seeded(1))
    assert torch.equal(one, stage(signal, generator=seeded(1)))
    assert torch.equal(one, stage(signal, Context(generator=seeded(1))))
    assert torch.equal(one, stage(signal, Context(generator=seeded(2)), generator=seeded(1)))
    assert not torch.equal(one, stage(signal, generator=seeded(2)))
    torch.manual_seed(0)
    default = stage(signal)
    torch.manual_seed(0)
    assert torch.equal(default, stage(signal))
    assert not torch.equal(one[0], one[1])


@pytest.mark.parametrize("name", STAGES)
@pytest.mark.parametrize("shape", [(0, 1, 4, 4), (1, 1, 1, 1), (2, 1, 5, 3), (2, 3, 5, 3), (1, 1, 0, 4)])
def test_any_shape_and_dtype(name, shape):
    stage = STAGES[name]()
    for dtype in (torch.float16, torch.bfloat16, torch.float32, torch.float64):
        signal = torch.full(shape, 0.5, dtype=dtype)
        out = stage(signal)
        assert out.shape == signal.shape
        assert out.dtype == stage.mean()(signal).dtype == dtype


@pytest.mark.parametrize("name", STAGES)
def test_the_input_is_left_alone(name):
    signal = torch.full((1, 1, 4, 4), 0.5)
    STAGES[name]()(signal)
    assert (signal == 0.5).all()


def test_half_precision_is_computed_in_float32():
    signal = torch.full((1, 1, 100, 100), 0.5)
    full = shot_noise(signal, full_well=10_000, generator=seeded())
    half = shot_noise(signal.half(), full_well=10_000, generator=seeded())
    assert torch.equal(half, full.half())


@pytest.mark.parametrize("name", STAGES)
def test_the_mean_stage_is_the_mean_and_shares_parameters(name):
    stage = STAGES[name]()
    mean = stage.mean()
    assert isinstance(mean, Mean)
    assert mean.stage is stage
    assert mean.provides() == stage.provides()
    signal = torch.full((1, 1, 250, 250), 0.4, dtype=torch.float64)
    difference = stage(signal) - mean(signal)
    assert abs(difference.mean().item()) <= 5 * difference.std().item() / 250
    assert torch.equal(mean(signal), mean(signal))


def test_means_clip_at_the_full_well():
    signal = torch.tensor([[-0.1, 0.5, 1.7]])
    assert ShotNoise().mean()(signal).tolist() == [[0.0, 0.5, 1.0]]
    assert ReadNoise().mean()(signal) is signal
    assert FixedPattern().mean()(signal) is signal
    torch.testing.assert_close(
        DarkCurrent(100.0, time=10.0).mean()(signal, Context(full_well=2000.0)), torch.tensor([[0.4, 1.0, 1.0]])
    )


def test_full_well_comes_from_the_context_where_open():
    signal = torch.full((1, 1, 200, 200), 0.5, dtype=torch.float64)
    small = ShotNoise()(signal, Context(full_well=100.0), generator=seeded())
    assert torch.equal(small, ShotNoise(100.0)(signal, generator=seeded()))
    assert ShotNoise().provides() == {}
    assert ReadNoise(2.0, full_well=50.0).provides() == {"full_well": 50.0, "read_noise": 2.0}


def test_one_strength_per_picture():
    stage = ReadNoise(torch.tensor([0.0, 50.0]).reshape(2, 1, 1, 1))
    out = stage(torch.zeros(2, 1, 64, 64), generator=seeded())
    assert out[0].abs().max() == 0
    assert out[1].std().item() == pytest.approx(0.005, rel=0.05)
    assert "sigma_electrons" in dict(stage.named_buffers())
    assert list(ReadNoise(nn.Parameter(torch.tensor(1.0))).parameters())


@pytest.mark.parametrize("name", STAGES)
def test_arguments_are_attributes_that_rebuild_the_stage(name):
    stage = STAGES[name]()
    arguments = {key: getattr(stage, key) for key in inspect.signature(type(stage)).parameters}
    twin = type(stage)(**arguments)
    signal = torch.full((1, 1, 4, 4), 0.5)
    torch.manual_seed(1)
    expected = copy.deepcopy(stage)(signal)
    torch.manual_seed(1)
    assert torch.equal(twin(signal), expected)


@pytest.mark.parametrize(
    ("build", "error", "text"),
    [
        (lambda: ShotNoise(0.0), ValueError, "full_well must be finite and > 0 electrons, got 0"),
        (lambda: ShotNoise(float("nan")), ValueError, "full_well must be finite"),
        (lambda: ReadNoise(-1.0), ValueError, "sigma_electrons must be finite and >= 0 electrons, got -1"),
        (lambda: ReadNoise(1.0, full_well=-5.0), ValueError, "full_well must be finite and > 0"),
        (lambda: DarkCurrent(-1.0, time=1.0), ValueError, "electrons_per_second must be finite and >= 0 electrons / s"),
        (lambda: DarkCurrent(1.0, time=-1.0), ValueError, "time must be finite and >= 0 s"),
        (lambda: DarkCurrent(1.0, time=1.0, doubling_temperature=0.0), ValueError, "doubling_temperature must be"),
        (lambda: DarkCurrent(1.0, time=1.0, full_well=0.0), ValueError, "full_well must be"),
        (lambda: FixedPattern(-0.1), ValueError, "prnu must be finite and >= 0"),
        (lambda: FixedPattern(dsnu=-0.1), ValueError, "dsnu must be finite and >= 0 electrons"),
        (lambda: FixedPattern(6), ValueError, r"prnu must be at most 0.5 \(relative gain\), got 6. .*mean 6 / 100\?"),
        (lambda: FixedPattern(torch.tensor(1.0)), ValueError, "prnu must be at most 0.5.*It is a share"),
        (lambda: DarkCurrent(1.0, time=1.0, temperature=300.0), ValueError, "300 is outside .* From kelvin subtract"),
        (lambda: DarkCurrent(10**400, time=1.0), TypeError, "electrons_per_second must be a number"),
        (lambda: ReadNoise(1e31), ValueError, r"sigma_electrons must be at most 1e\+30 electrons"),
        (lambda: ShotNoise(1e31), ValueError, r"full_well 1e\+31 is outside 0.001..1e\+30 electrons"),
        (lambda: FixedPattern(seed=1.5), TypeError, "seed must be an integer such as 0, got 1.5"),
        (lambda: FixedPattern(full_well=0.0), ValueError, "full_well must be"),
    ],
)
def test_errors(build, error, text):
    with pytest.raises(error, match=text):
        build()


@pytest.mark.parametrize("name", STAGES)
def test_an_integer_signal_is_refused(name):
    with pytest.raises(TypeError, match=r"in which 1.0 is the full well .* of torch.uint8. Use signal.float"):
        STAGES[name]()(torch.zeros(1, 1, 2, 2, dtype=torch.uint8))


def magnitude(rng: random.Random, low: float = -6, high: float = 38) -> float:
    return 10 ** rng.uniform(low, high)


def hostile_stage(rng: random.Random) -> tuple[Callable[[], RandomStage], Callable[[Tensor], Tensor]]:
    """A stage with arguments of any size, and the mean of what it gives, in full wells, before one is full."""
    well = magnitude(rng, -3, 30)
    rate, time, spread = magnitude(rng), magnitude(rng), magnitude(rng)
    held = (lambda value: torch.tensor(value)) if rng.random() < 0.3 else (lambda value: value)
    kind = rng.choice(["shot", "dark", "read", "fixed"])
    if kind == "shot":
        return lambda: ShotNoise(held(well)), lambda signal: signal
    if kind == "dark":
        wells = rate / well * time
        return lambda: DarkCurrent(held(rate), time=time, full_well=well), lambda signal: signal + wells
    if kind == "read":
        return lambda: ReadNoise(held(spread), full_well=well), lambda signal: signal
    return lambda: FixedPattern(0.4 * rng.random(), dsnu=held(spread), full_well=well), lambda signal: signal


def check_magnitudes(seed: int) -> str:
    rng = random.Random(seed)
    build, mean = hostile_stage(rng)
    dtype = rng.choice([torch.float32, torch.float64])
    signal = torch.full((1, 1, 24, 24), rng.choice([0.0, 0.3, 1.0, magnitude(rng, -20, 30)]), dtype=dtype)
    try:
        stage = build()
    except ValueError as error:
        return f"refused: {str(error).split()[0]}"
    torch.manual_seed(seed)
    result, expected = stage(signal), stage.expected(signal)
    assert result.isfinite().all(), stage
    assert expected.isfinite().all()
    if isinstance(stage, (ShotNoise, DarkCurrent)):
        assert (result >= 0).all()
        assert (result <= 1).all()
    true = mean(signal.double())
    if isinstance(stage, (ShotNoise, DarkCurrent)):
        true = true.clamp(max=1)
    sigma = torch.as_tensor(stage.sigma(signal.double())).double().max()
    slack = 6 * float(sigma) / 24 + 1e-5 * float(true.abs().max())
    if isinstance(stage, (ShotNoise, DarkCurrent)) and float(true.max()) > 0.5:  # the well takes what goes beyond it
        slack += 3 * float(sigma)
    assert abs(float(result.double().mean() - true.mean())) <= slack, (stage, float(result.mean()), float(true.mean()))
    return "computed"


def test_any_magnitude_is_computed_or_refused():
    outcomes = Counter(check_magnitudes(seed) for seed in range(150))
    assert outcomes["computed"] > 80
    assert outcomes["refused: sigma_electrons"] + outcomes["refused: dsnu"] > 5
    assert len(outcomes) == 3


@pytest.mark.slow
def test_any_of_many_magnitudes_is_computed_or_refused():
    assert Counter(check_magnitudes(seed) for seed in range(150, 6000))["computed"] > 3000


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("rate", [1e11, 1.2e12, 1e15, 1e17, 9.3e18, 1e19, 1e25, 1e30])
def test_counts_beyond_64_bits_have_their_mean_and_variance(rate, dtype):
    for rates in (torch.full((40_000,), rate, dtype=dtype), torch.tensor([3.0, rate], dtype=dtype).repeat(40_000)):
        count = poisson(rates, generator=seeded(2))[rates > 5].double()
        assert (count >= 0).all()
        sigma = math.sqrt(rate)
        rounding = rate * torch.finfo(dtype).eps
        assert abs(float((count - rate).mean())) <= 5 * sigma / 200 + rounding
        if sigma > 10 * rounding:
            assert float((count - rate).std()) == pytest.approx(sigma, rel=0.02)
    small = poisson(torch.tensor([3.0, rate], dtype=dtype).repeat(40_000), generator=seeded(2))[::2]
    assert float(small.mean()) == pytest.approx(3.0, abs=0.05)


def test_gradients_stay_finite_where_the_dark_floods_the_well():
    rate = nn.Parameter(torch.tensor(1e38))
    signal = torch.full((1, 1, 4, 4), 0.1, requires_grad=True)
    DarkCurrent(rate, time=1e38)(signal, generator=seeded()).sum().backward()
    assert rate.grad.isfinite()
    assert signal.grad.isfinite().all()
