import pytest
import torch
from torch import nn

from kcam.context import Context
from kcam.sensor import ADC, quantise


def test_values_are_whole_numbers_and_errors_half_a_step():
    signal = torch.linspace(0, 1, 10_001, dtype=torch.float64)
    for bits in (1, 2, 8, 12, 16):
        out = ADC(bits)(signal)
        number = out * (2**bits - 1)
        assert (number - number.round()).abs().max() < 1e-9
        assert (out - signal).abs().max() <= 0.5 / (2**bits - 1) + 1e-12
    assert quantise(signal, bits=1).unique().tolist() == [0.0, 1.0]


def test_every_step_of_24_bits_survives_float32():
    top = 2**24 - 1
    number = torch.cat([torch.arange(2000), torch.randint(0, top, (5000,)), top - torch.arange(2000)])
    out = quantise((number.double() / top).float(), bits=24)
    assert torch.equal((out.double() * top).round().long(), number)


def test_gain_then_black_level_then_clip():
    adc = ADC(8, black_level=16.0, gain=2.0)
    dn = adc(torch.tensor([0.0, 0.1, 0.5, 5.0, -0.02, -5.0], dtype=torch.float64)) * 255
    assert dn.round(decimals=9).tolist() == [16.0, 67.0, 255.0, 255.0, 6.0, 0.0]
    assert adc.provides() == {"black_level": 16 / 255, "gain": 2.0}


def test_gain_comes_from_the_context_where_open():
    signal = torch.full((1, 1, 1, 1), 0.25)
    assert ADC(16)(signal, Context(gain=2.0)).item() == pytest.approx(0.5, abs=1e-5)
    assert ADC(16, gain=1.0)(signal, Context(gain=2.0)).item() == pytest.approx(0.25, abs=1e-5)
    assert ADC(16).provides() == {"black_level": 0.0}


def test_gradient_is_the_gain_inside_and_that_of_the_clip_outside():
    signal = torch.tensor([0.2, 0.3, 0.7, -0.1], dtype=torch.float64, requires_grad=True)
    out = ADC(4, gain=2.0)(signal)
    (slope,) = torch.autograd.grad(out.sum(), signal, retain_graph=True)
    assert slope.tolist() == [2.0, 2.0, 2.0, 0.0]
    (slope,) = torch.autograd.grad(-out.sum(), signal)
    assert slope.tolist() == [-2.0, -2.0, 0.0, -2.0]


def test_black_level_and_gain_train():
    adc = ADC(8, black_level=nn.Parameter(torch.tensor(4.0)), gain=nn.Parameter(torch.tensor(1.5)))
    signal = torch.full((1, 1, 2, 2), 0.25, dtype=torch.float64)
    adc(signal).sum().backward()
    assert adc.black_level.grad.item() == pytest.approx(4 / 255)
    assert adc.gain.grad.item() == pytest.approx(4 * 0.25)
    assert adc.provides()["black_level"].item() == pytest.approx(4 / 255)


def test_dtype_shape_and_empty_batch():
    for dtype in (torch.float16, torch.bfloat16, torch.float32, torch.float64):
        assert ADC()(torch.rand(2, 1, 3, 5, dtype=dtype)).dtype == dtype
    assert ADC()(torch.rand(0, 1, 3, 5)).shape == (0, 1, 3, 5)
    assert ADC()(torch.tensor([torch.inf, -torch.inf])).tolist() == [1.0, 0.0]


@pytest.mark.parametrize(
    ("arguments", "error", "text"),
    [
        ({"bits": 0}, ValueError, r"bits 0 is outside 1\.\.24"),
        ({"bits": 25}, ValueError, r"bits 25 is outside 1\.\.24"),
        ({"bits": 12.0}, TypeError, "bits must be an integer such as 12, got 12.0"),
        ({"bits": True}, TypeError, "bits must be an integer"),
        ({"black_level": -1.0}, ValueError, "black_level must be finite and >= 0 DN, got -1"),
        ({"bits": 8, "black_level": 300.0}, ValueError, r"300 DN leaves no range.*255 DN at 8 bits"),
        ({"gain": 0.0}, ValueError, "gain must be finite and > 0"),
    ],
)
def test_errors(arguments, error, text):
    with pytest.raises(error, match=text):
        ADC(**arguments)


def test_an_integer_signal_is_refused():
    with pytest.raises(TypeError, match=r"in which 1.0 is the full well .* of torch.uint8. Use signal.float"):
        ADC()(torch.zeros(1, 1, 2, 2, dtype=torch.uint8))


def test_bits_broadcast_against_the_signal() -> None:
    signal = torch.rand(5, 6, generator=torch.Generator().manual_seed(0))
    found = quantise(signal, bits=torch.tensor([2, 8], dtype=torch.uint8)[:, None, None])  # 2^8 is no uint8
    assert torch.equal(found, torch.stack([quantise(signal, bits=2), quantise(signal, bits=8)]))
