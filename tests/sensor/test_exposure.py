import inspect
import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch import nn

from kcam import spectral
from kcam.context import Context
from kcam.sensor import ADC, ColourFilter, Exposure, Mosaic
from kcam.sensor.exposure import LUMINOUS_BANDWIDTH, PLANCK_TIMES_LIGHT
from kcam.units import nm, um, wavelength_grid


def a_lens(f_number=2.0, distance=0.05):
    radius = distance / f_number / 2
    return SimpleNamespace(aperture_area=lambda: math.pi * radius**2, sensor_distance=distance)


def a_white(context, colour_filter):
    light = context.illuminant
    if light is None:
        light = spectral.illuminant("D65", wavelengths=context.wavelengths)
    return colour_filter(light[None, :, None, None].expand(1, -1, 6, 6), context)


@pytest.mark.parametrize("illuminant", ["D65", "A"])
@pytest.mark.parametrize("preset", ["kodak", "nikon", "sigma", "rgbw"])
def test_a_perfect_white_fills_its_share_in_green(preset, illuminant):
    colour_filter, grid = getattr(ColourFilter, preset)(), wavelength_grid()
    light = spectral.illuminant(illuminant, wavelengths=grid)
    context = Context(colour_filter=colour_filter, illuminant=light)
    signal = a_white(context, colour_filter)
    assert Exposure()(signal, context)[0, 1, 0, 0].item() == pytest.approx(0.8, rel=1e-9)
    assert Exposure(0.5)(signal, context)[0, 1, 0, 0].item() == pytest.approx(0.5, rel=1e-9)
    assert Exposure()(signal, Context(colour_filter=colour_filter, illuminant=light, white_share=0.6))[
        0, 1, 0, 0
    ].item() == pytest.approx(0.6)


def test_alone_it_assumes_kodak_and_daylight():
    white = a_white(Context(), ColourFilter.kodak())
    assert Exposure()(white)[0, 1, 0, 0].item() == pytest.approx(0.8)


def test_a_learned_tile_is_exposed_by_its_mean():
    tile = ColourFilter.learned(2)
    context = Context(colour_filter=tile)
    assert Exposure()(a_white(context, tile), context).mean().item() == pytest.approx(0.8, rel=1e-6)


def test_iso_takes_light_and_the_adc_gives_it_back():
    exposure = Exposure(iso=400)  # without a time: a fourth of the electrons, and the ADC's gain makes up for it
    assert exposure.provides() == {"gain": 4.0}
    white = a_white(Context(), ColourFilter.kodak())
    signal = exposure(white)
    assert signal[0, 1, 0, 0].item() == pytest.approx(0.2)
    assert ADC(16)(signal, Context(gain=4.0))[0, 1, 0, 0].item() == pytest.approx(0.8, abs=1e-4)
    torch.testing.assert_close(Exposure()(white, Context(gain=4.0)), signal)


def test_it_works_before_and_after_the_mosaic():
    signal = torch.rand(2, 3, 5, 7)
    assert torch.equal(Mosaic()(Exposure()(signal)), Exposure()(Mosaic()(signal)))


def test_photometry_agrees_with_a_hand_calculation():
    # 100 cd/m^2 of equal-energy light, f/2, 1/60 s, 4 um pixels filled to 60 %, 40 % of the photons at green's peak
    grid = torch.arange(420, 721, dtype=torch.float64) * nm
    kodak = ColourFilter.kodak()
    context = Context(
        wavelengths=grid,
        illuminant=spectral.illuminant("E", wavelengths=grid),
        luminance=100.0,
        lens=a_lens(2.0),
        pixel_pitch=4 * um,
        fill_factor=0.6,
        colour_filter=kodak,
        full_well=1.0,
    )
    electrons = Exposure(time=1 / 60, quantum_efficiency=0.4)(a_white(context, kodak), context)[0, :, 0, 0].numpy()

    wavelength = np.arange(420, 721) * 1e-9
    spectral_radiance = 100 / (683.002 * 106.856895e-9)  # W / (m^2 sr m), the same at every wavelength
    energy = spectral_radiance * math.pi / (4 * 2.0**2) * 0.6 * (4e-6) ** 2 / 60  # J / m on one pixel
    photons = energy * wavelength / (6.62607015e-34 * 299792458)  # per m of wavelength
    response = kodak.response(grid).numpy() / wavelength
    efficiency = 0.4 * response / response[1].max()
    by_hand = np.sum(photons * efficiency, 1) * 1e-9
    np.testing.assert_allclose(electrons, by_hand, rtol=3e-3)
    assert 2000 < electrons[1] < 8000


def test_photons_of_monochromatic_light_by_the_definition_of_the_candela():
    # Illuminance pi L / (4 N^2) = 19.63 lx; at 555 nm 683 lm are 1 W, a photon has 3.579e-19 J, so 1 lx is 4.1e15
    # photons / (m^2 s): 16 um^2 and 1/60 s make 21.4 thousand, half of which are counted.
    grid = torch.arange(554, 557, dtype=torch.float64) * nm
    flat = ColourFilter(torch.ones(1, 12), width=30 * nm)
    line = torch.tensor([0.0, 106.856895, 0.0], dtype=torch.float64)  # all light in 1 nm, luminance as before
    context = Context(
        wavelengths=grid,
        illuminant=line,
        luminance=100.0,
        lens=a_lens(2.0),
        colour_filter=flat,
        full_well=1.0,
    )
    electrons = Exposure(time=1 / 60, quantum_efficiency=0.5)(a_white(context, flat), context)[0, 0, 0, 0].item()
    fine = torch.arange(400, 741, dtype=torch.float64) * nm
    per_photon = flat.response(fine)[0] / fine  # the flat curve counts most photons at its blue end
    share = (per_photon[155] / per_photon.max()).item()
    illuminance = math.pi * 100 / 16
    photons = illuminance / 683.002 * 16e-12 / 60 / (1.98644586e-25 / 555e-9)
    assert photons == pytest.approx(21_400, rel=0.01)
    assert electrons == pytest.approx(photons * 0.5 * share, rel=0.01)


def test_stopping_down_costs_photons_and_iso_does_not_change_them():
    signal = torch.ones(1, 3, 1, 1, dtype=torch.float64)

    def fill(f_number=4.0, **arguments):
        fields = {name: arguments.pop(name) for name in ("luminance", "pixel_pitch", "full_well") if name in arguments}
        stage = Exposure(**{"time": 0.01, **arguments})
        return stage(signal, Context(lens=a_lens(f_number), **fields))[0, 1, 0, 0].item()

    one = fill()
    assert fill(8.0) == pytest.approx(one / 4)
    assert fill(time=0.02) == pytest.approx(2 * one)
    assert fill(iso=800) == pytest.approx(one)
    assert fill(quantum_efficiency=0.25) == pytest.approx(one / 2)
    assert fill(luminance=2000.0) == pytest.approx(2 * one)
    assert fill(pixel_pitch=2 * um) == pytest.approx(one / 4)
    assert fill(full_well=20_000.0) == pytest.approx(one / 2)
    assert Exposure(time=0.01, iso=800).provides() == {"gain": 8.0, "exposure_time": 0.01}


def test_the_constants_are_those_of_the_tables():
    grid = torch.arange(360, 831, dtype=torch.float64) * nm
    assert spectral.observer(grid)[:, 1].sum().item() * nm == pytest.approx(LUMINOUS_BANDWIDTH, rel=1e-5)
    assert pytest.approx(6.62607015e-34 * 299792458, rel=1e-9) == PLANCK_TIMES_LIGHT


def test_scalars_train():
    lens = SimpleNamespace(aperture_area=lambda: torch.tensor(1e-5), sensor_distance=nn.Parameter(torch.tensor(0.05)))
    exposure = Exposure(time=nn.Parameter(torch.tensor(0.01)))
    exposure(torch.ones(1, 3, 2, 2), Context(lens=lens)).sum().backward()
    assert exposure.time.grad > 0
    assert lens.sensor_distance.grad < 0
    exposure = Exposure(nn.Parameter(torch.tensor(0.8)))
    exposure(torch.ones(1, 3, 2, 2)).sum().backward()
    assert exposure.white_share.grad > 0


@pytest.mark.parametrize("time", [None, 0.01])
def test_gradcheck_to_signal_and_filter(time):
    signal = torch.rand(1, 3, 2, 2, dtype=torch.float64, requires_grad=True)
    raw = nn.Parameter(torch.rand(3, 12, dtype=torch.float64))

    def run(x, raw):
        return Exposure(time=time)(x, Context(colour_filter=ColourFilter(raw), lens=a_lens(), full_well=100.0))

    assert torch.autograd.gradcheck(run, (signal, raw))


def test_a_filter_that_sees_nothing_gives_finite_values():
    raw = nn.Parameter(torch.zeros(3, 12))
    for time in (None, 0.01):
        context = Context(colour_filter=ColourFilter(raw), lens=a_lens())
        out = Exposure(time=time)(context.colour_filter(torch.rand(1, 28, 2, 2), context), context)
        assert (out == 0).all()
        (slope,) = torch.autograd.grad(out.sum(), raw)
        assert slope.isfinite().all()


def test_arguments_are_attributes_and_dtype_is_kept():
    one = Exposure(0.7, time=0.01, iso=200, quantum_efficiency=0.6)
    arguments = {key: getattr(one, key) for key in inspect.signature(Exposure).parameters}
    told = {"white_share": 0.7, "time": 0.01, "iso": 200, "quantum_efficiency": 0.6, "compensation": None}
    assert arguments == told
    assert one.provides() == {"gain": 2.0, "exposure_time": 0.01, "white_share": 0.7}
    assert Exposure().provides() == {}
    for dtype in (torch.float16, torch.float32, torch.float64):
        assert Exposure()(torch.rand(1, 1, 3, 5, dtype=dtype)).dtype == dtype
    assert Exposure()(torch.rand(0, 3, 3, 5)).shape == (0, 3, 3, 5)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"white_share": 1.5}, "white_share must be a share, above 0 and at most 1, such as 0.8; got 1.5"),
        ({"white_share": 0.0}, "white_share must be a share"),
        ({"quantum_efficiency": 50.0}, "quantum_efficiency must be a share.*got 50"),
        ({"time": 0.0}, "time must be finite and > 0 s, got 0"),
        ({"iso": -100}, "iso must be finite and > 0"),
    ],
)
def test_errors(arguments, text):
    with pytest.raises(ValueError, match=text):
        Exposure(**arguments)


def test_what_is_no_number_is_named():
    with pytest.raises(TypeError, match="time must be a number > 0 s, got '1/50'. Write a number, not text"):
        Exposure(time="1/50")
    with pytest.raises(TypeError, match="white_share must be a share, above 0 and at most 1, .*, got 'bright'"):
        Exposure(white_share="bright")


def test_time_needs_a_lens():
    with pytest.raises(ValueError, match=r"Exposure\(time=\.\.\.\) needs the lens.*put optics.Imaging"):
        Exposure(time=0.01)(torch.rand(1, 3, 2, 2))
