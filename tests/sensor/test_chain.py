import pytest
import torch

from kcam import sensor
from kcam.context import Context


def a_sensor(colour_filter):
    stages = [] if colour_filter.is_tile else [sensor.Mosaic("RGGB")]
    return [
        colour_filter,
        *stages,
        sensor.Exposure(),
        sensor.ShotNoise(2000),
        sensor.DarkCurrent(50.0, time=0.1),
        sensor.ReadNoise(3.0),
        sensor.FixedPattern(),
        sensor.ADC(10, black_level=32.0),
    ]


@pytest.mark.parametrize("preset", ["kodak", "learned"])
def test_gradients_pass_through_the_whole_sensor(preset):
    stages = a_sensor(getattr(sensor.ColourFilter, preset)())
    context = Context(colour_filter=stages[0], full_well=2000.0)
    bands = (torch.rand(1, 28, 30, 33) * 2).requires_grad_()  # some of it overexposed
    signal = bands
    for stage in stages:
        signal = stage(signal, context)
    assert signal.shape == (1, 1, 30, 33)
    assert 0 <= signal.min() < signal.max() <= 1
    (signal - 0.3).square().mean().backward()
    assert bands.grad.isfinite().all()
    assert (bands.grad != 0).float().mean() > 0.9
    for parameter in stages[0].parameters():
        assert parameter.grad.isfinite().all()
        assert (parameter.grad != 0).float().mean() > 0.9


def test_every_stage_stands_in_nn_sequential():
    camera = torch.nn.Sequential(*a_sensor(sensor.ColourFilter.kodak()))
    assert camera(torch.rand(2, 28, 5, 7, dtype=torch.float64)).shape == (2, 1, 5, 7)


def test_every_public_name_exists():
    assert all(hasattr(sensor, name) for name in sensor.__all__)
    assert sensor.__all__ == sorted(sensor.__all__, key=lambda name: (not name.isupper(), name[0].islower(), name))
