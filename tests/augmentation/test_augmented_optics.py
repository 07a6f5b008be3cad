"""The optical augmentations are `optics.Imaging` of the lens that was drawn, and follow the laws of optics."""

from __future__ import annotations

import math

import numpy as np
import oracles
import pytest
import torch
from drawing import (
    BANDS,
    PRIMARIES,
    agree_row_by_row,
    alone,
    augmented,
    imaged,
    in_light,
    picture,
    relative,
    round_lens,
    row,
    wavelengths_for,
)
from torch import Tensor
from torch.nn import functional as F

import kcam.augmentation as KC
from kcam import Scene, optics
from kcam.augmentation.base import wavelengths_of
from kcam.srgb import to_light
from kcam.units import mm, nm, um, wavelength_grid

CHANNELS = pytest.mark.parametrize("channels", [1, 3, 28])
SAMPLINGS = 1e-4  # two samplings of the same pupil, each good to 5e-5: see tests/optics/test_batch.py


def test_the_wavelengths_of_a_picture_are_those_of_its_primaries(colour) -> None:
    space = colour.RGB_COLOURSPACES["sRGB"]
    found = [float(colour.dominant_wavelength(xy, space.whitepoint)[0]) for xy in space.primaries]
    # half a nanometre: colour-science intersects a locus of 1 nm steps
    assert [w / nm for w in KC.RGB_WAVELENGTHS] == pytest.approx(found, abs=0.5)


class TestDefocus:
    @staticmethod
    def by_hand(augmentation: KC.RandomDefocus, depths: Tensor | None = None):
        def render(light: Tensor, index: int, drawn: dict[str, Tensor]) -> Tensor:
            values = row(drawn, index)
            lens = round_lens(values["focal_length"], values["f_number"], focus_distance=values["focus"])
            grid = wavelengths_for(light.shape[1])
            depth, options = values["distance"], {}
            if depths is not None:
                depth = depths[index : index + 1]
                between = 1 / float(depth.max()), 1 / float(depth.min())
                half = augmentation.half_width(alone(drawn, index), grid, between)
                window = augmentation.window((light.shape[-2], light.shape[-1]), half)
                options = {"layers": augmentation.layers, "psf_shape": window}
            own = alone(drawn, index)
            return imaged(
                lens, light, augmentation=augmentation, wavelengths=grid, depth=depth, drawn=own, **options
            )

        return render

    @CHANNELS
    def test_is_imaging(self, channels: int) -> None:
        augmentation = KC.RandomDefocus(p=1.0, focal_length=(6 * mm, 9 * mm))
        agree_row_by_row(augmentation, picture(3, channels, 40, 37), self.by_hand(augmentation), bound=SAMPLINGS)

    @pytest.mark.parametrize("channels", [3, 28])
    @pytest.mark.parametrize("layers", [1, 8])
    def test_with_a_depth_map_is_imaging_in_layers(self, channels: int, layers: int) -> None:
        augmentation = KC.RandomDefocus(p=1.0, layers=layers)
        inverse = torch.linspace(0, 2, 24, dtype=torch.float64).expand(2, 1, 21, 24).clone()  # from infinity to 0.5 m
        inverse[1, :, 5:12, 8:15] = 1.7  # an edge in depth
        depths = 1 / inverse  # 1 / 0 is infinity
        agree_row_by_row(
            augmentation,
            picture(2, channels, 21, 24),
            self.by_hand(augmentation, depths),
            bound=SAMPLINGS,
            inverse_depth=inverse,
        )

    def test_a_map_of_one_value_is_a_plane(self) -> None:
        signal = picture(2, 3, 20, 23)
        augmentation = KC.RandomDefocus(p=1.0, distance=0.8)
        plane, drawn = augmented(augmentation, signal)
        mapped = augmentation.simulate(in_light(signal), drawn | {"inverse_depth": torch.full((2, 1, 20, 23), 1 / 0.8)})
        # 1 / 0.8 is rounded to float32 in the map: 6e-8 of a defocus of at most some ten waves
        assert relative(mapped, augmentation.simulate(in_light(signal), drawn)) < 1e-5
        assert plane.shape == signal.shape

    def test_depth_maps_that_can_be_none(self) -> None:
        augmentation = KC.RandomDefocus(p=1.0)
        signal = picture(1, 3, 8, 8)
        for value in (math.nan, math.inf, -0.1):
            inverse = torch.ones(1, 1, 8, 8)
            inverse[..., 3, 4] = value
            with pytest.raises(ValueError, match="expected finite ones >= 0"):
                augmentation(signal, inverse_depth=inverse)
        with pytest.raises(ValueError, match=r"inverse_depth has shape .* expected .* or \(1, 1, 8, 8\)"):
            augmentation(signal, inverse_depth=torch.ones(1, 1, 4, 4))

    @pytest.mark.parametrize("distance", [0.25, 0.125])
    def test_a_map_nearer_than_the_range_is_blurred_as_widely(self, distance: float) -> None:
        """The window follows the map: not what the range of `distance` needs, which no map has to keep to."""
        near = KC.RandomDefocus(p=1.0, focus=2.0, f_number=2.0, distance=distance)
        ranged = KC.RandomDefocus(p=1.0, focus=2.0, f_number=2.0, distance=(0.5, 5.0))
        point = torch.zeros(1, 1, 121, 121, dtype=torch.float64)
        point[..., 60, 60] = 1.0
        _, drawn = augmented(near, point)
        expected = near.simulate(point, drawn)
        found = ranged.simulate(point, drawn | {"inverse_depth": torch.full_like(point, 1 / distance)})
        # the light that the two windows leave out, which is spread over them: 1 % each at most
        assert (found - expected).abs().sum() < 0.02

    @pytest.mark.parametrize("distance", [0.5, 0.25])
    @pytest.mark.parametrize("focus", [2.0, math.inf])
    def test_blur_of_a_point_is_the_geometric_disc(self, distance: float, focus: float) -> None:
        """Radius a |1/z - 1/s| d; half of its light lies within 1 / sqrt 2 of it."""
        f, number, pitch = 16 * mm, 4.0, 4 * um
        augmentation = KC.RandomDefocus(
            p=1.0, focus=focus, distance=distance, f_number=number, focal_length=f, pixel_pitch=pitch
        )
        radius = f / (2 * number) * abs(1 / distance - 1 / focus) / (1 / f - 1 / focus) / pitch
        assert radius > 10  # some ten waves of defocus, so that rays say it
        size = 2 * math.ceil(1.6 * radius) + 1
        point = torch.zeros(1, 1, size, size, dtype=torch.float64)
        point[..., size // 2, size // 2] = 1.0
        _, drawn = augmented(augmentation, point)
        psf = augmentation.simulate(point, drawn)[0, 0]
        assert float(psf.sum()) == pytest.approx(1, abs=0.02)
        side = torch.arange(size, dtype=torch.float64) - size // 2
        away = (side[:, None] ** 2 + side**2).sqrt()
        order = away.flatten().argsort()
        share = psf.flatten()[order].cumsum(0) / psf.sum()
        half = away.flatten()[order][int((share < 0.5).sum())]
        # a pixel's half width, and the fringes of some ten waves: 3 % of a disc of 10 pixels and more
        assert float(half) == pytest.approx(radius / math.sqrt(2), rel=0.03, abs=0.5)

    @pytest.mark.parametrize("focus", [0.7, math.inf])
    def test_in_focus_a_point_is_an_airy_disc(self, focus: float) -> None:
        """Each pixel against the closed form, integrated over it."""
        f, number, pitch, size = 8 * mm, 16.0, 4 * um, 101
        augmentation = KC.RandomDefocus(
            p=1.0, focus=focus, distance=focus, f_number=number, focal_length=f, pixel_pitch=pitch, outside=1e-3
        )
        point = torch.zeros(1, 1, size, size, dtype=torch.float64)
        point[..., size // 2, size // 2] = 1.0
        _, drawn = augmented(augmentation, point)
        psf = augmentation.simulate(point, drawn)[0, 0].numpy()
        node, weight = np.polynomial.legendre.leggauss(8)
        at = (np.arange(-6, 7)[:, None] + node / 2).ravel() * pitch
        lens = {
            "wavelength": KC.RGB_WAVELENGTHS[1],
            "aperture_radius": f / (2 * number),
            "sensor_distance": 1 / (1 / f - 1 / focus),
        }
        fine = oracles.airy(at[None, :], at[:, None], **lens) * np.outer(np.tile(weight, 13), np.tile(weight, 13)) / 4
        expected = fine.reshape(13, 8, 13, 8).sum((1, 3)) * pitch**2
        middle = psf[size // 2 - 6 : size // 2 + 7, size // 2 - 6 : size // 2 + 7]
        # of the peak; the 101 pixels leave out lambda d / (pi^2 a s) = 0.9 % of the light, which is spread over them
        assert np.abs(middle - expected).max() < 0.012 * expected.max()
        # in focus the first dark ring, 1.22 lambda N away, has less than 5 % of the peak in its pixel
        ring = 1.22 * lens["wavelength"] * lens["sensor_distance"] / (2 * lens["aperture_radius"]) / pitch
        assert middle[6, 6 + round(ring)] < 0.05 * middle[6, 6]

    def test_focus_exactly_at_the_distance_is_diffraction_alone(self) -> None:
        signal = picture(1, 3, 24, 25)
        focused = KC.RandomDefocus(p=1.0, focus=math.inf, distance=math.inf, f_number=11.0)
        found, _ = augmented(focused, signal)
        expected, _ = augmented(KC.RandomDiffraction(p=1.0, f_number=11.0), signal)
        assert relative(found, expected) < 1e-9

    @pytest.mark.parametrize("mapped", [False, True])
    def test_a_sample_does_not_depend_on_the_others(self, mapped: bool) -> None:
        augmentation = KC.RandomDefocus(p=1.0)
        signal = picture(4, 3, 40, 37)
        _, drawn = augmented(augmentation, signal)
        if mapped:
            far = torch.tensor([0.1, 0.4, 1.0, 2.0])[:, None, None, None]
            drawn |= {"inverse_depth": far * torch.linspace(0, 1, 37).expand(4, 1, 40, 37)}
        together = augmentation.simulate(signal, drawn)
        for index in range(4):
            own = {name: value[index : index + 1] for name, value in drawn.items()}
            alone = augmentation.simulate(signal[index : index + 1], own)
            # the window is the same; the tables of a batch are as fine as its worst needs, each good to 5e-5
            assert relative(together[index : index + 1], alone) < SAMPLINGS

    def test_rows_that_were_not_drawn_keep_their_maps_to_themselves(self) -> None:
        signal = picture(6, 3, 12, 13)
        inverse = picture(6, 1, 12, 13, seed=1)
        half, full = KC.RandomDefocus(p=0.5), KC.RandomDefocus(p=1.0)
        with torch.random.fork_rng():
            torch.manual_seed(0)
            result = half(signal, inverse_depth=inverse)
        gate = half._params["batch_prob"] > 0.5
        assert 0 < gate.sum() < 6
        everywhere = full(signal, inverse_depth=inverse, params=half._params)
        assert torch.equal(result[~gate], signal[~gate])
        assert (result[gate] - everywhere[gate]).abs().max() < 1e-12


@CHANNELS
def test_diffraction_is_imaging_with_a_stopped_down_lens(channels: int) -> None:
    augmentation = KC.RandomDiffraction(p=1.0)

    def by_hand(light: Tensor, index: int, drawn: dict[str, Tensor]) -> Tensor:
        lens = round_lens(augmentation.focal_length, row(drawn, index)["f_number"])
        grid = wavelengths_for(channels)
        return imaged(lens, light, augmentation=augmentation, wavelengths=grid, drawn=alone(drawn, index))

    agree_row_by_row(augmentation, picture(3, channels, 31, 40), by_hand, bound=SAMPLINGS)


class TestAberration:
    @pytest.mark.parametrize("channels", [3, 28])
    def test_is_imaging_with_the_drawn_coefficients(self, channels: int) -> None:
        augmentation = KC.RandomAberration(p=1.0)

        def by_hand(light: Tensor, index: int, drawn: dict[str, Tensor]) -> Tensor:
            direction = drawn["direction"][index].double()
            noll = torch.zeros(15, dtype=torch.float64)
            noll[3:] = direction / direction.norm() * drawn["rms"][index] * 550 * nm
            lens = round_lens(augmentation.focal_length, row(drawn, index)["f_number"], optics.ZernikeAberration(noll))
            grid = wavelengths_for(channels)
            return imaged(lens, light, augmentation=augmentation, wavelengths=grid, drawn=alone(drawn, index))

        agree_row_by_row(augmentation, picture(2, channels, 30, 33), by_hand, bound=SAMPLINGS)

    def test_the_wavefront_has_the_drawn_rms(self) -> None:
        augmentation = KC.RandomAberration(p=1.0, rms=(0.1, 2.0))
        _, drawn = augmented(augmentation, picture(4, 3, 5, 5))
        u, v, weight = oracles.polar_nodes(aperture_radius=1.0, radial=12, angular=24)
        for index, coefficients in enumerate(augmentation.coefficients(drawn).tolist()):
            noll = {j: c for j, c in enumerate(coefficients, start=1) if c}
            assert min(noll) == 4  # neither piston nor tilt, which moves the picture
            opd = oracles.zernike_opd(noll, aperture_radius=1.0)(u, v)
            rms = math.sqrt(np.average(opd**2, weights=weight) - np.average(opd, weights=weight) ** 2)
            assert rms == pytest.approx(float(drawn["rms"][index]) * 550 * nm, rel=1e-9)

    def test_the_window_holds_the_rays(self) -> None:
        """Its slope, 20 RMS / a, is that of the worst direction at 0.8 a, beyond which most draws send nothing far."""
        augmentation = KC.RandomAberration(p=1.0, rms=1.0)
        theta, step = np.linspace(0, 2 * math.pi, 181), 1e-6
        u, v = 0.8 * np.cos(theta), 0.8 * np.sin(theta)
        opds = [oracles.zernike_opd({j: 550 * nm}, aperture_radius=1.0) for j in range(4, 16)]
        slopes = np.array(
            [[(f(u + x, v + y) - f(u - x, v - y)) / (2 * step) for x, y in ((step, 0), (0, step))] for f in opds]
        )
        worst = np.linalg.svd(slopes.transpose(2, 0, 1), compute_uv=False)[:, 0].max()  # over all unit vectors
        assert worst == pytest.approx(augmentation.slope(PRIMARIES, radius=1.0), rel=0.05)

    @pytest.mark.parametrize("rms", [0.5, pytest.param(2.0, marks=pytest.mark.slow)])
    def test_the_window_leaves_out_little_light(self, rms: float) -> None:
        augmentation = KC.RandomAberration(p=1.0, rms=rms, f_number=4.0, wavelengths=[550 * nm])
        _, drawn = augmented(augmentation, picture(20, 1, 3, 3))
        grid = wavelength_grid([550 * nm])
        psfs = optics.batch_psf(
            torch.zeros(20),
            radii=torch.full((20,), 1 * mm),
            coefficients=augmentation.coefficients(drawn),
            wavelengths=grid,
            sensor_distance=augmentation.focal_length,
            pixel_pitch=augmentation.pixel_pitch,
            shape=augmentation.psf_shape((999, 999), grid),
        )
        outside = 1 - psfs.sum((-2, -1)).flatten()
        # nine of ten: at most a tenth above the 1 % asked for; nothing bounds a draw whose modes are steep at one place
        assert float(outside.sort().values[17]) < 1.1 * augmentation.outside


class TestChromaticAberration:
    @CHANNELS
    def test_axial_is_a_defocus_of_each_wavelength(self, channels: int) -> None:
        augmentation = KC.RandomChromaticAberration(p=1.0, lateral=0.0, axial=(0.2, 1.0))
        grid = wavelengths_for(channels)
        lines = wavelength_grid([550 * nm])
        power = (optics.refractive_index("N-BK7", wavelengths=grid) - 1) / (
            optics.refractive_index("N-BK7", wavelengths=lines) - 1
        )

        def by_hand(light: Tensor, index: int, drawn: dict[str, Tensor]) -> Tensor:
            values, f = row(drawn, index), augmentation.focal_length
            bands = []
            for channel in range(channels):
                residual = optics.Defocus(-values["axial"] * (float(power[channel]) - 1) / f)
                lens = round_lens(f, values["f_number"], residual)
                shape = augmentation.psf_shape((light.shape[-2], light.shape[-1]), grid, alone(drawn, index))
                one = optics.Imaging(
                    lens,
                    pixel_pitch=augmentation.pixel_pitch,
                    propagator="fresnel",
                    psf_shape=shape,
                    renormalise=True,
                    distance=math.inf,
                )
                own = grid[channel : channel + 1]
                bands.append(one(_scene(light[:, channel : channel + 1], own)))
            return torch.cat(bands, dim=1)

        agree_row_by_row(augmentation, picture(2, channels, 30, 33), by_hand, bound=SAMPLINGS)

    @pytest.mark.parametrize("glass", ["N-BK7", "fused silica"])
    def test_axial_1_is_a_lens_of_that_glass(self, glass: str) -> None:
        """At f/22 of 50 mm the sphere of a plano-convex lens is 0.01 waves, beside 0.4 of chromatic defocus."""
        f, number = 50 * mm, 22.0
        augmentation = KC.RandomChromaticAberration(
            p=1.0, lateral=0.0, axial=1.0, f_number=number, focal_length=f, glass=glass
        )
        centre = optics.refractive_index(glass, wavelengths=wavelength_grid([550 * nm]))
        radius = f * (float(centre) - 1)
        lens = optics.Lens(
            optics.CircularAperture(f / number), optics.PlanoConvexLens(radius, glass=glass), focus_distance=math.inf
        )
        power = lens.elements[1].vergence(BANDS) - lens.elements[1].vergence(wavelength_grid([550 * nm]))
        vergences = augmentation.vergences({"axial": torch.ones(1)}, BANDS)[0, 0]
        assert torch.allclose(vergences, power, rtol=1e-9, atol=1e-12)
        signal = picture(1, 28, 40, 40)
        found, _ = augmented(augmentation, signal)
        expected = imaged(lens, signal, augmentation=augmentation, wavelengths=BANDS)
        achromatic, _ = augmented(
            KC.RandomChromaticAberration(p=1.0, lateral=0.0, axial=0.0, f_number=number, focal_length=f), signal
        )
        assert relative(found, expected) < 0.015  # the sphere
        assert relative(achromatic, expected) > 0.1

    @pytest.mark.parametrize("lateral", [0.02, -0.03])
    @pytest.mark.parametrize("channels", [3, 28])
    def test_lateral_magnifies_each_channel_about_the_centre(self, lateral: float, channels: int) -> None:
        height, width = 90, 121
        middle = torch.tensor([(width - 1) / 2, (height - 1) / 2], dtype=torch.float64)
        centre = middle + torch.tensor([37.3, -24.6], dtype=torch.float64)
        y, x = torch.arange(height, dtype=torch.float64)[:, None], torch.arange(width, dtype=torch.float64)
        blob = torch.exp(-((x - centre[0]) ** 2 + (y - centre[1]) ** 2) / (2 * 2.5**2))
        augmentation = KC.RandomChromaticAberration(p=1.0, axial=0.0, lateral=lateral, f_number=1.8)
        signal = blob.expand(1, channels, height, width)
        _, drawn = augmented(augmentation, signal)
        light = augmentation.simulate(signal, drawn)[0]
        mass = light.sum((1, 2))
        found = torch.stack([(light * x).sum((1, 2)), (light * y).sum((1, 2))], dim=1) / mass[:, None]
        grid = wavelengths_for(channels)
        lines = wavelength_grid([550 * nm, 486.1 * nm, 656.3 * nm])
        zero, f_line, c_line = optics.refractive_index("N-BK7", wavelengths=lines)
        index = optics.refractive_index("N-BK7", wavelengths=grid)
        scale = 1 + lateral * (index - zero) / (f_line - c_line)
        expected = middle + (centre - middle) * scale[:, None]
        # bilinear weights smooth by t (1 - t) / 2, and t drifts across the blob with the strain: up to so many pixels
        assert (found - expected).abs().max() < (scale - 1).abs().max()
        assert (found - found[0]).abs().max() > 0.5  # and the channels do part
        if channels == 3:
            assert (found[1] - centre).abs().max() < 0.01  # green, 549.1 nm, does not move


def _scene(light: Tensor, wavelengths: Tensor):
    return Scene.from_bands(light, wavelengths=wavelengths, depth=math.inf)


class TestVignetting:
    @pytest.mark.parametrize("shape", [(30, 41), (1, 7), (25, 25)])
    def test_corners_follow_the_cos4_law(self, shape: tuple[int, int]) -> None:
        augmentation = KC.RandomVignetting(p=1.0, shade=(0.1, 0.4))
        signal = torch.ones(3, 5, *shape, dtype=torch.float64)
        result, drawn = augmented(augmentation, signal)
        for index in range(3):
            theta = math.radians(float(drawn["field"][index])) / 2
            corner = math.cos(theta) ** 4 * (1 - float(drawn["shade"][index]))
            for x in (0, -1):
                for y in (0, -1):
                    assert float(result[index, 0, y, x]) == pytest.approx(corner, rel=1e-12)
        assert torch.equal(result[:, :1].expand(-1, 5, -1, -1), result)  # all channels alike
        if shape[0] % 2 and shape[1] % 2:
            assert torch.equal(result[..., shape[0] // 2, shape[1] // 2], torch.ones(3, 5, dtype=torch.float64))

    def test_along_the_diagonal_it_is_cos4_of_the_field_angle(self) -> None:
        augmentation = KC.RandomVignetting(p=1.0, field=70.0, shade=0.0)
        result, _ = augmented(augmentation, torch.ones(1, 5, 41, 41, dtype=torch.float64))
        tangent = torch.linspace(-1, 1, 41, dtype=torch.float64) * math.tan(math.radians(35))
        assert torch.allclose(result[0, 0].diagonal(), torch.cos(torch.atan(tangent)) ** 4, atol=1e-12)

    def test_a_picture_darkens_in_linear_light(self) -> None:
        augmentation = KC.RandomVignetting(p=1.0, field=90.0, shade=0.0)
        result, _ = augmented(augmentation, torch.ones(1, 3, 9, 9, dtype=torch.float64))
        assert float(in_light(result)[0, 0, 0, 0]) == pytest.approx(math.cos(math.pi / 4) ** 4, rel=1e-6)


OPTICAL = {
    "defocus": KC.RandomDefocus,
    "diffraction": KC.RandomDiffraction,
    "aberration": KC.RandomAberration,
    "chromatic": KC.RandomChromaticAberration,
    "vignetting": KC.RandomVignetting,
}
optical = pytest.mark.parametrize("name", sorted(OPTICAL))


@optical
@pytest.mark.parametrize("shape", [(1, 1), (2, 3), (1, 9)])
def test_tiny_pictures(name: str, shape: tuple[int, int]) -> None:
    result, _ = augmented(OPTICAL[name](p=1.0), picture(2, 3, *shape))
    assert result.shape == (2, 3, *shape)
    assert result.isfinite().all()


@optical
@pytest.mark.parametrize("level", [0.0, 1.0])
def test_black_stays_black_and_an_optical_blur_leaves_white_white(name: str, level: float) -> None:
    signal = torch.full((2, 3, 17, 20), level)
    result, _ = augmented(OPTICAL[name](p=1.0), signal)
    if name != "vignetting" or level == 0:
        assert (result - level).abs().max() < 1e-5  # of an FFT in float32
    else:
        assert (result <= 1).all()
        assert result.min() < 0.9


@optical
@pytest.mark.parametrize("channels", [3, 28])
def test_float32_is_close_to_float64(name: str, channels: int) -> None:
    augmentation = OPTICAL[name](p=1.0)
    signal = picture(2, channels, 32, 33)
    exact, drawn = augmented(augmentation, signal)
    single = augmentation.simulate(in_light(signal).float(), drawn)
    assert single.dtype == torch.float32
    # 1e-5: rounding of an FFT and of the PSF; the coordinates of a magnified picture are good to 33 * 6e-8
    assert relative(single.double(), augmentation.simulate(in_light(signal), drawn)) < 1e-5
    assert exact.dtype == torch.float64


@pytest.mark.parametrize(
    "extreme",
    [
        KC.RandomDefocus(f_number=64.0, p=1.0),
        KC.RandomDefocus(focus=math.inf, distance=math.inf, p=1.0),
        KC.RandomDefocus(focus=(1.0, math.inf), distance=(0.5, math.inf), p=1.0),
        KC.RandomDefocus(10.0, 1.4, distance=(1.0, 10.0), focal_length=50 * mm, pixel_pitch=6 * um, p=1.0),
        KC.RandomDefocus(0.3, 1.8, distance=math.inf, focal_length=4.3 * mm, pixel_pitch=1.4 * um, p=1.0),
        KC.RandomDiffraction(f_number=200.0, p=1.0),
        KC.RandomDiffraction(f_number=0.5, p=1.0),
        KC.RandomAberration(rms=2.0, f_number=16.0, p=1.0),
        KC.RandomChromaticAberration(axial=10.0, lateral=0.2, p=1.0),
        KC.RandomVignetting(field=160.0, shade=1.0, p=1.0),
    ],
    ids=lambda augmentation: type(augmentation).__name__,
)
def test_the_ends_of_what_may_be_asked_for(extreme: KC.CameraAugmentation) -> None:
    signal = picture(1, 3, 40, 48, dtype=torch.float32)
    result, drawn = augmented(extreme, signal)
    assert result.isfinite().all()
    assert result.min() >= 0
    assert result.max() <= 1
    light = extreme.simulate(in_light(signal), drawn)
    if not isinstance(extreme, KC.RandomVignetting):
        # light is reflected at the border, not lost: the mean of a picture of noise stays within its spread
        assert torch.allclose(light.mean((2, 3)), in_light(signal).mean((2, 3)), rtol=0.1)


def test_a_full_frame_lens_wide_open() -> None:
    """50 mm with 6 um pixels, focused on 0.5 m and looking at 5 m: a blur of 520 pixels in a picture of 96."""
    augmentation = KC.RandomDefocus(0.5, 1.4, distance=5.0, focal_length=50 * mm, pixel_pitch=6 * um, p=1.0)
    light = torch.full((1, 3, 96, 96), 0.5)
    light[..., 48:] = 0
    result, _ = augmented(augmentation, light)
    # the window holds the middle of the disc, which is even but for fringes far finer than a pixel
    mean = F.avg_pool2d(F.pad(to_light(light), (48, 48, 48, 48), mode="reflect"), 97, stride=1)
    assert (to_light(result) - mean).abs().max() < 0.01


def gradcheck_simulate(augmentation: KC.CameraAugmentation, signal: Tensor, drawn: dict[str, Tensor], **bounds) -> None:
    """Of a weighted mean, with respect to the light and to every drawn number that is not a whole one."""
    smooth = {name: value for name, value in drawn.items() if value.is_floating_point()}
    fixed = {name: value for name, value in drawn.items() if name not in smooth}
    weight = torch.linspace(1, 2, signal.numel(), dtype=torch.float64).view_as(signal)

    def total(light: Tensor, *numbers: Tensor) -> Tensor:
        return (augmentation.simulate(light, dict(zip(smooth, numbers, strict=True)) | fixed) * weight).sum()

    numbers = [value.double().clone().requires_grad_() for value in smooth.values()]
    inputs = [signal.clone().requires_grad_(), *numbers]
    assert torch.autograd.gradcheck(total, inputs, eps=1e-6, fast_mode=True, **bounds)


@optical
@pytest.mark.parametrize("channels", [3, 5])
def test_gradients_to_the_light_and_to_every_drawn_number(name: str, channels: int) -> None:
    settings = {"focal_length": 8 * mm, "pixel_pitch": 8 * um}
    augmentation = {
        "defocus": lambda: KC.RandomDefocus(p=1.0, focus=(1.0, 2.0), distance=(0.6, 0.9), **settings),
        "diffraction": lambda: KC.RandomDiffraction(p=1.0, **settings),
        "aberration": lambda: KC.RandomAberration(p=1.0, rms=(0.1, 0.3), f_number=(4.0, 8.0), **settings),
        "chromatic": lambda: KC.RandomChromaticAberration(p=1.0, axial=(0.1, 0.3), lateral=(0.01, 0.02), **settings),
        "vignetting": lambda: KC.RandomVignetting(p=1.0),
    }[name]()
    signal = picture(1, channels, 4, 5)
    _, drawn = augmented(augmentation, signal)
    # the profile is interpolated between tabulated arguments, so that its slope is good to 1e-4, not to rounding
    loose = name in ("defocus", "diffraction", "chromatic")
    bounds = {"atol": 1e-4, "rtol": 3e-4} if loose else {"atol": 1e-6, "rtol": 1e-5}
    gradcheck_simulate(augmentation, signal, drawn, **bounds)


def test_gradients_reach_a_depth_map() -> None:
    augmentation = KC.RandomDefocus(p=1.0, focus=2.0, layers=3, focal_length=8 * mm, pixel_pitch=8 * um)
    signal = picture(1, 3, 4, 5)
    _, drawn = augmented(augmentation, signal)
    inverse = 0.2 + picture(1, 1, 4, 5, seed=3)
    weight = torch.linspace(1, 2, signal.numel(), dtype=torch.float64).view_as(signal)

    def total(light: Tensor, inverse: Tensor) -> Tensor:
        return (augmentation.simulate(light, drawn | {"inverse_depth": inverse}) * weight).sum()

    inputs = [signal.requires_grad_(), inverse.requires_grad_()]
    assert torch.autograd.gradcheck(total, inputs, eps=1e-7, atol=3e-4, rtol=1e-3)


def test_wavelengths_must_fit_the_channels() -> None:
    with pytest.raises(ValueError, match="2 wavelengths do not fit 3 channels"):
        wavelengths_of(picture(1, 3, 2, 2), wavelength_grid([450 * nm, 550 * nm]))
    given = KC.RandomDiffraction(p=1.0, f_number=16.0, wavelengths=[450 * nm, 550 * nm])
    signal = picture(1, 2, 20, 20)
    found, _ = augmented(given, signal)
    lens = round_lens(8 * mm, 16.0)
    grid = wavelength_grid([450 * nm, 550 * nm])
    assert relative(found, imaged(lens, signal, augmentation=given, wavelengths=grid)) < SAMPLINGS


@pytest.mark.parametrize("field", [1.2, (0.3, 1.4), (0.0, 3.14), torch.tensor([0.5, 0.9])])
def test_a_field_in_radians_is_warned_of(field) -> None:
    text = r"degrees darkens the corners by 0.\d\d%. Angles are in degrees; did you mean"
    with pytest.warns(UserWarning, match=text):
        KC.RandomVignetting(field=field)


@pytest.mark.parametrize("field", [0.0, 5.0, (0.0, 47.0), (20.0, 80.0)])
def test_a_field_in_degrees_is_not(field) -> None:
    KC.RandomVignetting(field=field)
