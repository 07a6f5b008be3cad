from __future__ import annotations

import dataclasses
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile
import torch
from kornia.io import write_image
from PIL import Image

from kcam import spectral
from kcam.scene import BUILTIN, Scene, read_picture
from kcam.units import nm, wavelength_grid

GRID = wavelength_grid()
inf, nan = float("inf"), float("nan")


def picture(*shape: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
    return torch.rand(*shape, dtype=dtype, generator=torch.Generator().manual_seed(0))


class TestFromRgb:
    @pytest.mark.parametrize("shape", [(3, 4, 5), (1, 4, 5), (2, 3, 4, 5), (2, 1, 4, 5), (3, 1, 1), (0, 3, 4, 5)])
    def test_colours_come_back(self, shape: tuple[int, ...], dtype: torch.dtype) -> None:
        image = picture(*shape, dtype=dtype)
        scene = Scene.from_rgb(image)
        batch = shape[0] if len(shape) == 4 else 1
        assert scene.shape == (batch, *shape[-2:])
        assert scene.dtype == scene.coefficients.dtype == scene.spectra.dtype == scene.bands().dtype == dtype
        assert scene.bands().shape == (batch, 28, *shape[-2:])
        tolerance = 3e-6 if dtype == torch.float32 else 1e-13
        expected = image.expand(batch, 3, *shape[-2:]) if shape[-3] == 1 else image.reshape(batch, 3, *shape[-2:])
        torch.testing.assert_close(scene.to_srgb(), expected, rtol=0, atol=tolerance)

    def test_rank_is_three_and_one_if_grey(self) -> None:
        assert Scene.from_rgb(picture(3, 4, 5)).spectra.shape == (3, 28)
        grey = Scene.from_rgb(picture(1, 4, 5, dtype=torch.float64))
        assert grey.spectra.shape == (1, 28)
        colour = Scene.from_rgb(picture(1, 4, 5, dtype=torch.float64).expand(3, 4, 5))
        torch.testing.assert_close(grey.bands(), colour.bands(), rtol=0, atol=1e-12)

    @pytest.mark.parametrize("light", ["D65", "A", "FL11"])
    def test_white_is_the_light(self, light: str) -> None:
        scene = Scene.from_rgb(torch.ones(3, 2, 2, dtype=torch.float64), illuminant=light)
        expected = spectral.illuminant(light, wavelengths=GRID)
        torch.testing.assert_close(scene.illuminant, expected)
        torch.testing.assert_close(scene.bands()[0, :, 0, 0], expected, rtol=0, atol=1e-12)
        assert scene.xyz()[0, 1, 0, 0].item() == pytest.approx(1, abs=1e-12)

    def test_another_light_changes_the_colours(self) -> None:
        grey = torch.full((3, 2, 2), 0.5)
        red, _, blue = Scene.from_rgb(grey, illuminant="A").to_srgb()[0, :, 0, 0].tolist()
        assert red > 0.6 > 0.35 > blue

    def test_other_wavelengths(self) -> None:
        grid = torch.linspace(700, 400, 31, dtype=torch.float64) * nm
        scene = Scene.from_rgb(picture(3, 4, 5), wavelengths=grid, luminance=50.0)
        torch.testing.assert_close(scene.wavelengths, grid)
        torch.testing.assert_close(scene.to_srgb()[0], picture(3, 4, 5), rtol=0, atol=3e-6)
        assert scene.luminance == 50.0
        assert Scene.from_rgb(picture(3, 4, 5), wavelengths=[550 * nm]).bands().shape == (1, 1, 4, 5)

    @pytest.mark.parametrize("count", [1, 3, 6, 10])
    def test_bands_that_cannot_carry_the_colours_are_warned_of_with_the_error(self, count: int) -> None:
        grid = wavelength_grid(count=count)
        text = rf"these {count} bands do not carry all colours of sRGB: some come back off by \d.\d\d"
        with pytest.warns(UserWarning, match=text) as seen:
            scene = Scene.from_rgb(torch.rand(3, 30, 40), wavelengths=grid)
        stated = float(str(seen[0].message).split("off by ")[1][:4])
        assert stated == pytest.approx(spectral.rgb_error(grid), abs=0.006)
        assert scene.shape == (1, 30, 40)

    @pytest.mark.parametrize("build", ["rgb", "bands", "with_depth", "file"])
    def test_depths_in_millimetres_are_warned_of_and_landscapes_are_not(self, build: str, tmp_path: Path) -> None:
        image = torch.rand(3, 4, 6)
        Image.fromarray(np.zeros((4, 6, 3), np.uint8)).save(tmp_path / "x.png")

        def make(depth: float | torch.Tensor) -> Scene:
            match build:
                case "rgb":
                    return Scene.from_rgb(image, depth=depth)
                case "bands":
                    return Scene.from_bands(torch.rand(28, 4, 6), depth=depth)
                case "file":
                    return Scene.from_file(tmp_path / "x.png", depth=depth)
            return Scene.from_rgb(image).with_depth(depth)

        ramp = torch.linspace(0, 1, 24).view(4, 6)
        inf = float("inf")
        for depth in (2000, 500.0, 300, 400 + 5000 * ramp, torch.where(ramp > 0.5, inf, 700.0), torch.tensor(1e5)):
            with pytest.warns(UserWarning, match=r"depth \d+(e\+05)? m: depths are in metres; did you mean .* \* mm\?"):
                made = make(depth)
        made.crop(top=0, left=0, height=2, width=2)  # said once: not again of what is made of it
        for depth in (2.0, 299, inf, 2 + 5000 * ramp, torch.where(ramp > 0.5, inf, 20.0), torch.full((4, 6), inf)):
            make(depth)

    def test_bands_that_carry_them_and_grey_pictures_are_not(self) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            Scene.from_rgb(torch.rand(3, 4, 5), wavelengths=wavelength_grid(count=12))
            Scene.from_rgb(torch.rand(1, 4, 5), wavelengths=wavelength_grid(count=3))

    def test_gradient_reaches_the_picture(self) -> None:
        image = torch.zeros(3, 2, 2, dtype=torch.float64)
        image[:, 0] = picture(3, 2, dtype=torch.float64)  # 0 and 1 included: the curve's slopes are finite there
        image[0, 0, 0] = 1
        image.requires_grad_()
        Scene.from_rgb(image).bands().square().sum().backward()
        assert image.grad.isfinite().all()
        inside = (0.2 + 0.6 * picture(3, 2, 2, dtype=torch.float64)).requires_grad_()
        assert torch.autograd.gradcheck(lambda x: Scene.from_rgb(x).to_srgb(), inside)

    def test_wrong_type(self) -> None:
        array = np.zeros((4, 5, 3), np.uint8)
        with pytest.raises(
            TypeError, match=r"got an array \(4, 5, 3\) of uint8. .* use torch.from_numpy\(image\).permute"
        ):
            Scene.from_rgb(array)
        with pytest.raises(
            TypeError, match=r"in \[0,1\], got a tensor \(3, 4, 5\) of torch.uint8. Use image.float\(\)"
        ):
            Scene.from_rgb(torch.zeros(3, 4, 5, dtype=torch.uint8))
        with pytest.raises(TypeError, match=r"of torch.uint16. Use image.float\(\) / 65535"):
            Scene.from_rgb(torch.zeros(3, 4, 5, dtype=torch.uint16))
        with pytest.raises(TypeError, match=r"of torch.int64. Use image.float\(\)"):
            Scene.from_rgb(torch.zeros(3, 4, 5, dtype=torch.int64))
        with pytest.raises(TypeError, match="got str"):
            Scene.from_rgb("photo.jpg")

    def test_wrong_shape(self) -> None:
        with pytest.raises(
            ValueError, match=r"shape \(4, 5, 3\), expected 1 or 3 channels.*channels last: use image.per"
        ):
            Scene.from_rgb(torch.zeros(4, 5, 3))
        with pytest.raises(ValueError, match=r"shape \(4, 5\), expected 1 or 3 channels.*Use image\[None\]"):
            Scene.from_rgb(torch.zeros(4, 5))
        with pytest.raises(
            ValueError, match=r"shape \(2, 4, 5, 6\), expected 1 or 3 channels: \(C,H,W\) or \(B,C,H,W\)"
        ):
            Scene.from_rgb(torch.zeros(2, 4, 5, 6))
        with pytest.raises(ValueError, match=r"shape \(2, 4, 5, 3\).*channels last: use image.permute\(0, 3, 1, 2\)"):
            Scene.from_rgb(torch.zeros(2, 4, 5, 3))
        with pytest.raises(ValueError, match=r"shape \(\), expected 1 or 3 channels"):
            Scene.from_rgb(torch.tensor(1.0))
        with pytest.raises(ValueError, match=r"image has shape \(3, 0, 5\), expected 1 or 3 channels"):
            Scene.from_rgb(torch.zeros(3, 0, 5))

    @pytest.mark.parametrize(
        ("value", "text"),
        [
            (200.0, r"values from 0 to 200, expected sRGB in \[0,1\]. Use image / 255"),
            (1.2, r"values from 0 to 1.2, expected sRGB in \[0,1\]. Use image.clamp\(0, 1\)"),
            (-0.1, r"values from -0.1 to 0, expected.*clamp"),
            (nan, "values from nan to nan, expected.*Remove NaN"),
            (inf, "values from 0 to inf, expected"),
        ],
    )
    def test_values_outside(self, value: float, text: str) -> None:
        image = torch.zeros(3, 4, 5)
        image[1, 2, 3] = value
        with pytest.raises(ValueError, match=text):
            Scene.from_rgb(image)


class TestFromBands:
    def test_bands_are_the_scene(self, dtype: torch.dtype) -> None:
        cube = picture(28, 4, 5, dtype=dtype)
        scene = Scene.from_bands(cube, depth=inf)
        assert scene.spectra is None
        assert scene.bands() is scene.coefficients
        torch.testing.assert_close(scene.bands()[0], cube)
        assert Scene.from_bands(cube[None].expand(2, -1, -1, -1)).shape == (2, 4, 5)
        assert scene.depth == inf

    def test_scale_follows_the_white(self) -> None:
        cube, white = picture(28, 4, 5, dtype=torch.float64), torch.linspace(300, 500, 28)
        scene = Scene.from_bands(cube * white[:, None, None], illuminant=white)
        other = Scene.from_bands(cube * 7 * white[:, None, None], illuminant=7 * white)
        torch.testing.assert_close(scene.bands(), other.bands())
        torch.testing.assert_close(scene.bands()[0], cube * scene.illuminant[:, None, None])
        assert (scene.illuminant @ spectral.xyz_weights(GRID))[1].item() == pytest.approx(1)

    def test_reflectance_as_the_docstring_says(self) -> None:
        patches = spectral.reflectances(GRID)[:, :, None].permute(1, 0, 2)
        scene = Scene.from_bands(patches * spectral.illuminant("D65", wavelengths=GRID)[:, None, None])
        expected = spectral.reflectances(GRID) @ spectral.xyz_weights(GRID, "D65")
        torch.testing.assert_close(scene.xyz()[0, :, :, 0].T, expected)

    def test_errors(self) -> None:
        with pytest.raises(
            ValueError, match=r"shape \(31, 4, 5\), expected .* 28 bands, .* Scene.from_bands\(bands, wavelengths="
        ):
            Scene.from_bands(torch.zeros(31, 4, 5))
        with pytest.raises(ValueError, match=r"bands have shape \(4, 5\), expected \(L,H,W\) or \(B,L,H,W\)"):
            Scene.from_bands(torch.zeros(4, 5))
        with pytest.raises(
            TypeError, match=r"bands must be a floating-point tensor.*got an array \(28, 4, 5\) of uint16"
        ):
            Scene.from_bands(np.zeros((28, 4, 5), np.uint16))
        with pytest.raises(TypeError, match=r"got a tensor \(28, 4, 5\) of torch.uint8"):
            Scene.from_bands(torch.zeros(28, 4, 5, dtype=torch.uint8))
        for bad, text in (
            (-1.0, r"goes down to -1, .* not negative. .* std .* use .clamp\(min=0\)"),
            (nan, "finite"),
        ):
            cube = torch.zeros(28, 4, 5)
            cube[3, 2, 1] = bad
            with pytest.raises(ValueError, match=text):
                Scene.from_bands(cube)
        with pytest.raises(ValueError, match="expected finite values"):
            Scene.from_bands(torch.full((28, 4, 5), inf))


class TestScene:
    def test_factored_and_stored_scenes_agree(self) -> None:
        scene = Scene.builtin("colour_chart", 60)
        stored = Scene.from_bands(scene.bands(), illuminant=scene.illuminant)
        torch.testing.assert_close(stored.bands(), scene.bands())
        torch.testing.assert_close(stored.xyz(), scene.xyz(), rtol=0, atol=1e-6)
        torch.testing.assert_close(scene.xyz(), spectral.spectrum_to_xyz(scene.bands(), wavelengths=GRID))

    def test_signed_factors_of_a_measured_cube(self) -> None:
        cube = Scene.builtin("colour_chart", 60).bands()[0].double()
        spectra = torch.linalg.svd(cube.flatten(1), full_matrices=False)[0].T
        planes = torch.einsum("kl,lhw->khw", spectra, cube)
        scene = Scene(planes[None], spectra)
        assert (scene.coefficients < 0).any()
        torch.testing.assert_close(scene.bands()[0], cube)
        with pytest.raises(ValueError, match="light is not negative"):
            Scene(planes[None] - 0.1, spectra)
        with pytest.raises(ValueError, match="finite"):
            Scene(planes[None], spectra * nan)

    def test_gradients_reach_factors_and_depth(self) -> None:
        planes, spectra = (
            picture(1, 2, 3, 4, dtype=torch.float64).requires_grad_(),
            picture(2, 28, dtype=torch.float64).requires_grad_(),
        )
        depth = torch.tensor(2.0, dtype=torch.float64, requires_grad=True)
        scene = Scene(planes, spectra, depth=depth)
        assert scene.depth.shape == (1, 1, 3, 4)
        assert torch.autograd.gradcheck(
            lambda a, b, c: (Scene(a, b, depth=c).bands(), Scene(a, b, depth=c).depth), (planes, spectra, depth)
        )

    def test_to_moves_all_but_the_tables(self, device: torch.device) -> None:
        scene = Scene.from_rgb(picture(3, 4, 5), depth=torch.full((4, 5), 2.5)).to(device=device, dtype=torch.float64)
        for value in (scene.coefficients, scene.spectra, scene.depth):
            assert value.dtype == torch.float64
            assert value.device.type == device.type
        for value in (scene.wavelengths, scene.illuminant):
            assert value.dtype == torch.float64
            assert value.device.type == "cpu"
        assert scene.device.type == device.type
        assert scene.to(dtype=torch.float32).xyz().dtype == torch.float32
        assert scene.to_srgb().device.type == device.type

    def test_frozen_and_replaceable(self) -> None:
        scene = Scene.from_rgb(picture(3, 4, 5))
        with pytest.raises(dataclasses.FrozenInstanceError):
            scene.depth = 3.0
        brighter = dataclasses.replace(scene, luminance=2000.0)
        assert (brighter.luminance, scene.luminance) == (2000.0, 1000.0)
        torch.testing.assert_close(brighter.illuminant, scene.illuminant, rtol=0, atol=1e-14)
        assert scene.with_depth(0.5).depth == 0.5

    def test_empty_batch(self) -> None:
        scene = Scene.from_bands(torch.zeros(0, 28, 4, 5), depth=torch.ones(4, 5))
        assert scene.depth.shape == (0, 1, 4, 5)
        assert scene.to_srgb().shape == (0, 3, 4, 5)
        assert "depth map" in repr(scene)

    @pytest.mark.parametrize("seed", range(4))
    def test_parts_of_factors_that_dip_below_zero(self, seed: int, generator) -> None:
        """As far as the whole lets pass, which may be more than all the light of a part."""
        spectra = torch.ones(2, 5)
        spectra[1, torch.randperm(5, generator=generator.manual_seed(seed))[:2]] = -1
        planes = torch.rand(3, 2, 7, 8, generator=generator)
        planes[:, 0] += planes[:, 1]
        planes[1] *= 1e-4
        planes[1, 0, 2, 3] = planes[1, 1, 2, 3] / 2
        scene = Scene(
            planes, wavelengths=wavelength_grid(count=5), depth=torch.tensor([1.0, 2.0, 3.0]), spectra=spectra
        )
        assert scene.bands().min() < 0
        assert torch.equal(scene.samples([1]).bands(), scene.bands()[1:2])
        assert scene.samples([2, 1]).depth.tolist() == [3.0, 2.0]
        part = scene.crop(top=2, left=3, height=1, width=1)
        assert torch.equal(part.bands(), scene.bands()[..., 2:3, 3:4])
        with pytest.raises(TypeError, match=r"named in a list, such as \[1\], got 1"):
            scene.samples(1)

    def test_crop(self) -> None:
        image, depth = picture(3, 6, 7), torch.arange(1.0, 43).reshape(6, 7)
        window = Scene.from_rgb(image, depth=depth).crop(top=1, left=2, height=3, width=4)
        torch.testing.assert_close(window.to_srgb()[0], image[:, 1:4, 2:6], rtol=0, atol=3e-6)
        torch.testing.assert_close(window.depth[0, 0], depth[1:4, 2:6])
        assert Scene.from_rgb(image, depth=3.0).crop(top=0, left=0, height=1, width=1).depth == 3.0
        with pytest.raises(
            ValueError, match="window of 4 x 4 at row 3, column 0 is not inside the scene's 6 x 7 pixels"
        ):
            Scene.from_rgb(image).crop(top=3, left=0, height=4, width=4)

    def test_repr_is_one_line(self) -> None:
        text = repr(Scene.builtin("motorcycle", 100))
        assert text == (
            "Scene(1 x 67 x 100, 3 factors x 28 bands 420..720 nm, depth 2.11..5.02 m, 1000 cd/m^2, torch.float32, cpu)"
        )
        assert "28 bands 420..720 nm, depth inf m" in repr(Scene.from_bands(picture(28, 2, 2), depth=inf))

    def test_errors(self) -> None:
        planes, spectra = torch.ones(1, 3, 4, 5), torch.ones(3, 28)
        with pytest.raises(TypeError, match=r"coefficients must be a .* \(B,K,H,W\), got a list of 1"):
            Scene([1.0])
        with pytest.raises(ValueError, match=r"coefficients have shape \(3, 4, 5\), expected \(B,K,H,W\)"):
            Scene(planes[0], spectra)
        with pytest.raises(
            ValueError, match=r"spectra have shape \(28, 3\), expected \(3, 28\): a row for each of the 3"
        ):
            Scene(planes, spectra.T)
        with pytest.raises(
            TypeError, match=r"spectra must be a tensor \(K,L\) or None, got an array \(3, 28\) of float32"
        ):
            Scene(planes, spectra.numpy())
        with pytest.raises(ValueError, match="3 bands, but 28 wavelengths"):
            Scene(planes)
        with pytest.raises(ValueError, match=r"did you mean 420 \* nm"):
            Scene(planes, torch.ones(3, 2), torch.tensor([420.0, 720.0]))
        with pytest.raises(ValueError, match="luminance must be finite and > 0 cd/m\\^2, got 0"):
            Scene(planes, spectra, luminance=0.0)
        with pytest.raises(TypeError, match="luminance must be a number > 0 cd/m\\^2, got 'bright'. Write a number"):
            Scene(planes, spectra, luminance="bright")
        with pytest.raises(ValueError, match="unknown illuminant 'sun'"):
            Scene(planes, spectra, illuminant="sun")


class TestLowRank:
    @staticmethod
    def error(scene: Scene, truth: Scene) -> float:
        return float((scene.bands() - truth.bands()).norm() / truth.bands().norm())

    @pytest.mark.parametrize("as_bands", [True, False])
    def test_it_is_the_truncated_svd(self, as_bands: bool) -> None:
        scene = Scene.from_rgb(0.4 + 0.2 * picture(2, 3, 9, 11, dtype=torch.float64))  # pale: no truncation is negative
        cube = scene.bands().transpose(0, 1).flatten(1)
        u, s, v = torch.linalg.svd(cube, full_matrices=False)
        scene = replace(scene, coefficients=scene.bands(), spectra=None) if as_bands else scene
        for rank in (1, 2, 3):
            low = scene.low_rank(rank)
            assert low.coefficients.shape[1] == rank
            best = (u[:, :rank] * s[:rank]) @ v[:rank]
            assert torch.allclose(low.bands().transpose(0, 1).flatten(1), best, atol=1e-10)
        assert self.error(scene.low_rank(3), scene) < 1e-12  # pictures have three factors

    def test_light_stays_light(self) -> None:
        scene = Scene.builtin("colour_chart", 48)  # 24 reflectances, saturated ones among them
        errors = [self.error(scene.low_rank(rank), scene) for rank in (1, 2, 3, 6, 24)]
        assert errors == sorted(errors, reverse=True)
        assert errors[-1] < 1e-6  # all that there are
        assert all(scene.low_rank(rank).bands().min() > -1e-6 for rank in (1, 2, 3, 6))
        cube = scene.bands().double()[0].flatten(1)
        u, s, v = torch.linalg.svd(cube, full_matrices=False)
        assert ((u[:, :2] * s[:2]) @ v[:2]).min() < -0.01, "the plain truncation is negative here"

    @pytest.mark.parametrize("seed", range(8))
    def test_factors_that_dip_below_zero(self, seed: int, generator) -> None:
        """As far as a scene lets pass: what is left of them is light, and close."""
        signs = torch.where(torch.rand(4, 1, generator=generator.manual_seed(seed)) > 0.3, 1.0, -1.0)
        spectra = torch.rand(4, 28, generator=generator) * signs
        planes = torch.rand(1, 4, 12, 13, generator=generator)
        planes[..., :4, :4] *= 1e-3  # dark, where a dip is all there is
        spectra[0], planes[:, 0] = 1, 0
        planes[:, 0] = (-torch.einsum("bkhw,kl->blhw", planes, spectra).amin(1)).clamp(min=0)
        brightest = torch.einsum("bkhw,kl->blhw", planes, spectra).max()
        planes[:, 0] -= 9e-4 * brightest * (torch.rand(1, 12, 13, generator=generator) < 0.3)
        scene = Scene(planes, wavelengths=wavelength_grid(), depth=1.0, spectra=spectra)
        assert scene.bands().min() < 0
        errors = []
        for rank in (1, 2, 3, 4):
            low = scene.low_rank(rank)
            assert low.bands().min() > -1e-6 * brightest
            errors.append(self.error(low, scene))
        assert errors == sorted(errors, reverse=True)
        assert errors[-1] < 0.05

    def test_gradients_and_bad_input(self) -> None:
        image = picture(3, 6, 7, dtype=torch.float64).requires_grad_()
        Scene.from_rgb(image).low_rank(2).bands().square().sum().backward()
        assert image.grad.isfinite().all()
        assert Scene.from_rgb(torch.zeros(3, 4, 5)).low_rank(2).bands().abs().max() == 0
        with pytest.raises(ValueError, match="rank must be at least 1, got 0"):
            Scene.from_rgb(image).low_rank(0)


class TestDepth:
    @pytest.mark.parametrize(
        ("depth", "kept"), [(2, 2.0), (2.1, 2.1), (inf, inf), (torch.tensor(2.5), 2.5), (np.float32(0.5), 0.5)]
    )
    def test_a_number_is_kept_as_a_float(self, depth: object, kept: float) -> None:
        scene = Scene.from_rgb(picture(3, 4, 5), depth=depth)
        assert isinstance(scene.depth, float)
        assert scene.depth == kept

    @pytest.mark.parametrize("shape", [(4, 5), (1, 1, 4, 5), (2, 1, 4, 5)])
    def test_a_map_becomes_one_per_picture(self, shape: tuple[int, ...]) -> None:
        depth = 1 + picture(*shape, dtype=torch.float64)
        depth[..., 0, 0] = inf
        scene = Scene.from_rgb(picture(2, 3, 4, 5), depth=depth)
        assert scene.depth.shape == (2, 1, 4, 5)
        assert scene.depth.dtype == torch.float32
        torch.testing.assert_close(scene.depth, depth.float().expand(2, 1, 4, 5))

    def test_errors(self) -> None:
        image = picture(2, 3, 4, 5)
        for bad in (0.0, -1.0, nan):
            for depth in (bad, torch.tensor([[bad]]).expand(4, 5)):
                with pytest.raises(ValueError, match=rf"depth {bad:g} is not a distance in front of the lens"):
                    Scene.from_rgb(image, depth=depth)
        for shape in ((5, 4), (3, 1, 4, 5), (2, 3, 4, 5), (3,)):
            with pytest.raises(ValueError, match=r"depth has shape .* a map \(4, 5\) or \(2, 1, 4, 5\)"):
                Scene.from_rgb(image, depth=torch.ones(shape))
        with pytest.raises(TypeError, match=r"depth must be a number \[m\], one per sample \(B,\), .* got str '2 m'"):
            Scene.from_rgb(image, depth="2 m")


class TestBuiltin:
    @pytest.mark.parametrize(
        ("name", "shape", "factors"),
        [
            ("motorcycle", (500, 741), 3),
            ("astronaut", (512, 512), 3),
            ("coffee", (400, 600), 3),
            ("chelsea", (300, 451), 3),
            ("colour_chart", (400, 600), 24),
            ("star", (512, 512), 1),
            ("point_grid", (512, 512), 1),
        ],
    )
    def test_scene(self, name: str, shape: tuple[int, int], factors: int) -> None:
        scene = Scene.builtin(name)
        assert scene.shape == (1, *shape)
        assert scene.spectra.shape == (factors, 28)
        assert scene.dtype == torch.float32
        assert Scene.builtin(name, 40).shape == (1, *(max(1, round(40 * side / max(shape))) for side in shape))
        assert Scene.builtin(name, (24, 60)).shape == (1, 24, 60)
        assert Scene.builtin(name, 1).to_srgb().isfinite().all()

    def test_all_are_tested(self) -> None:
        assert len(BUILTIN) == 7

    def test_motorcycle_has_the_distances_of_the_data_set(self) -> None:
        from skimage import data

        picture, _, disparity = data.stereo_motorcycle()
        scene = Scene.builtin("motorcycle")
        depth = scene.depth[0, 0].numpy()
        assert depth.min() == pytest.approx(2.11, abs=0.01)
        assert depth.max() == pytest.approx(5.02, abs=0.01)
        valid = np.isfinite(disparity)
        np.testing.assert_allclose(depth[valid], 994.978 * 0.193001 / (disparity[valid] + 31.086), rtol=1e-6)
        rows, columns = np.nonzero(~valid)  # filled with a valid distance of the same row, the farther one of two
        for row, column in list(zip(rows, columns, strict=True))[::997]:
            left = [x for x in range(column) if valid[row, x]][-1:]
            right = [x for x in range(column, 741) if valid[row, x]][:1]
            assert depth[row, column] == max(depth[row, x] for x in left + right)
        np.testing.assert_allclose(scene.to_srgb()[0].permute(1, 2, 0), picture / 255, atol=1e-5)

    def test_resizing_keeps_light_and_picks_distances(self) -> None:
        full, small = Scene.builtin("motorcycle"), Scene.builtin("motorcycle", (125, 185))
        assert small.coefficients.mean().item() == pytest.approx(full.coefficients.mean().item(), rel=5e-3)
        assert set(small.depth.flatten().tolist()) <= set(full.depth.flatten().tolist())

    def test_chart_is_measured_and_more_than_rank_three(self) -> None:
        scene = Scene.builtin("colour_chart", illuminant="FL11")
        patches = scene.bands()[0, :, 50::100, 50::100].flatten(1).T.double()
        expected = spectral.reflectances(GRID) * spectral.illuminant("FL11", wavelengths=GRID)
        torch.testing.assert_close(patches, expected, rtol=1e-5, atol=1e-6)
        assert torch.linalg.matrix_rank(patches, rtol=1e-3) > 8
        assert scene.bands()[0, :, 0, 0].sum() < 0.4 * patches[23].sum()  # the frame

    def test_star_and_points(self) -> None:
        star = Scene.builtin("star").coefficients[0, 0]
        assert star[256, 300].item() == pytest.approx(1 - star[255, 300].item(), abs=1e-6)
        assert star[192:320, 192:320].mean().item() == pytest.approx(0.5, abs=0.01)
        assert (star[0].min().item(), star.min().item(), star.max().item()) == (1, 0, 1)
        points = Scene.builtin("point_grid").coefficients[0, 0]
        assert points.nonzero()[:2].tolist() == [[32, 32], [32, 96]]
        assert (points.count_nonzero().item(), points.max().item()) == (64, 30)

    def test_errors(self) -> None:
        with pytest.raises(
            ValueError, match=r"unknown scene 'lena'. There are: motorcycle, astronaut.*Scene.from_file"
        ):
            Scene.builtin("lena")
        for size in (0, (0, 5), (5,), "big", (2.0, 3)):
            with pytest.raises(ValueError, match=r"size must be a number of pixels >= 1, or \(height, width\), got"):
                Scene.builtin("coffee", size)
            with pytest.raises(ValueError, match="size must be"):
                Scene.builtin("star", size)


# An F on white, so that all eight orientations differ.
F = np.full((7, 5), 255, np.uint8)
F[1:6, 1] = F[1, 1:4] = F[3, 1:3] = 0
F = np.kron(F, np.ones((8, 8), np.uint8))


class TestReadPicture:
    @pytest.mark.parametrize("suffix", ["jpg", "png", "tif", "webp"])
    @pytest.mark.parametrize("orientation", range(1, 9))
    def test_exif_orientation(self, tmp_path: Path, suffix: str, orientation: int) -> None:
        stored = {
            1: lambda x: x,
            2: np.fliplr,
            3: lambda x: np.rot90(x, 2),
            4: np.flipud,
            5: np.transpose,
            6: lambda x: np.rot90(x, 1),  # the viewer turns it clockwise
            7: lambda x: np.rot90(x, 2).T,
            8: lambda x: np.rot90(x, -1),
        }[orientation](F)
        exif = Image.Exif()
        exif[0x0112] = orientation
        path = tmp_path / f"photo.{suffix}"
        Image.fromarray(np.ascontiguousarray(stored)).convert("RGB").save(path, exif=exif, quality=100)
        image = read_picture(path)
        assert image.shape == (3, *F.shape)
        assert np.abs(image[0].numpy() - F / 255).max() < 0.15

    def test_16_bits_are_kept_and_turned(self, tmp_path: Path) -> None:
        values = torch.randint(0, 65536, (3, 4, 5), generator=torch.Generator().manual_seed(0))
        write_image(tmp_path / "deep.png", values.to(torch.uint16))
        torch.testing.assert_close(read_picture(tmp_path / "deep.png"), values.float() / 65535, rtol=0, atol=0)
        tifffile.imwrite(
            tmp_path / "deep.tif",
            values.permute(1, 2, 0).numpy().astype(np.uint16),
            photometric="rgb",
            extratags=[(274, "H", 1, 6, True)],
        )
        expected = torch.rot90(values.float() / 65535, -1, dims=(1, 2))
        torch.testing.assert_close(read_picture(tmp_path / "deep.tif"), expected, rtol=0, atol=0)
        Image.fromarray(values[0].numpy().astype(np.uint16)).save(tmp_path / "grey.png")
        torch.testing.assert_close(read_picture(tmp_path / "grey.png"), values[:1].float() / 65535, rtol=0, atol=0)

    def test_transparent_is_laid_on_white(self, tmp_path: Path) -> None:
        rgba = np.zeros((2, 3, 4), np.uint8)
        rgba[0] = (255, 0, 0, 255)
        rgba[1] = (255, 0, 0, 51)
        for suffix in ("png", "webp", "tif"):
            path = tmp_path / f"cut.{suffix}"
            Image.fromarray(rgba).save(path, lossless=True)
            colours = read_picture(path)[:, :, 0].T
            torch.testing.assert_close(colours, torch.tensor([[1, 0, 0], [1, 0.8, 0.8]]), rtol=0, atol=1e-6)
        deep = torch.tensor(rgba.astype(np.int64) * 257).permute(2, 0, 1).to(torch.uint16)
        write_image(tmp_path / "deep.png", deep)
        torch.testing.assert_close(read_picture(tmp_path / "deep.png")[:, 1, 0], torch.tensor([1, 0.8, 0.8]))
        Image.fromarray(rgba).convert("LA").save(tmp_path / "grey.png")
        assert read_picture(tmp_path / "grey.png").shape == (1, 2, 3)
        palette = Image.fromarray(rgba[..., :3]).convert("P")
        palette.save(tmp_path / "palette.png", transparency=int(np.asarray(palette)[0, 0]))
        torch.testing.assert_close(read_picture(tmp_path / "palette.png"), torch.ones(3, 2, 3))

    @pytest.mark.parametrize(
        ("mode", "suffix", "channels"),
        [
            ("L", "png", 1),
            ("1", "png", 1),
            ("L", "jpg", 1),
            ("P", "png", 3),
            ("P", "gif", 3),
            ("CMYK", "jpg", 3),
            ("RGB", "bmp", 3),
            ("RGB", "jpg", 3),
            ("RGB", "ppm", 3),
        ],
    )
    def test_kinds_of_files(self, tmp_path: Path, mode: str, suffix: str, channels: int) -> None:
        path = tmp_path / f"photo.{suffix}"
        Image.fromarray(F).convert("RGB").convert(mode).save(path)
        image = read_picture(str(path))
        assert image.shape == (channels, *F.shape)
        assert image.dtype == torch.float32
        assert np.abs(image[0].numpy() - F / 255).max() < 0.15
        assert Scene.from_file(path, depth=3.0).shape == (1, *F.shape)

    def test_from_file_is_from_rgb(self, tmp_path: Path) -> None:
        image = torch.randint(0, 256, (3, 4, 5), generator=torch.Generator().manual_seed(0))
        write_image(tmp_path / "photo.png", image.to(torch.uint8))
        scene = Scene.from_file(tmp_path / "photo.png", depth=3.0, luminance=80.0)
        assert (scene.depth, scene.luminance) == (3.0, 80.0)
        torch.testing.assert_close(scene.to_srgb()[0], image / 255, rtol=0, atol=3e-6)

    def test_missing(self, tmp_path: Path) -> None:
        for path, what in ((tmp_path / "none.jpg", "there is no file .*none.jpg"), (tmp_path, "is a folder")):
            with pytest.raises(FileNotFoundError, match=f"{what}. Expected a picture: PNG, JPEG"):
                read_picture(path)

    def test_too_large(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        write_image(tmp_path / "photo.png", torch.zeros(3, 4, 5, dtype=torch.uint8))
        monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 9)  # Pillow refuses twice as many: 20 > 18
        with pytest.raises(ValueError, match=r"photo.png has more than 0 million pixels.* Make it smaller first\.$"):
            read_picture(tmp_path / "photo.png")

    @pytest.mark.parametrize("suffix", ["jpg", "png", "tif", "webp", "bmp"])
    def test_cut_short(self, tmp_path: Path, suffix: str) -> None:
        path = tmp_path / f"photo.{suffix}"
        Image.fromarray(np.kron(F, np.ones((8, 8), np.uint8))).convert("RGB").save(path, quality=95)
        whole = path.read_bytes()
        for share in (0.02, 0.5, 0.95):
            path.write_bytes(whole[: int(len(whole) * share)])
            with pytest.raises(ValueError, match=rf"cannot read .*photo.{suffix} as a picture of 8 or 16 bits: "):
                read_picture(path)

    def test_no_picture(self, tmp_path: Path) -> None:
        path = tmp_path / "photo.jpg"
        for content in (b"", b"this is no picture"):
            path.write_bytes(content)
            with pytest.raises(ValueError, match=r"cannot read .* as a picture of 8 or 16 bits: cannot identify"):
                read_picture(path)
        tifffile.imwrite(tmp_path / "float.tif", np.ones((4, 5), np.float32))
        with pytest.raises(ValueError, match="it holds 32-bit values. For linear radiance use Scene.from_bands"):
            read_picture(tmp_path / "float.tif")
        write_image(tmp_path / "deep.png", torch.zeros(3, 64, 64, dtype=torch.uint16))
        content = (tmp_path / "deep.png").read_bytes()
        (tmp_path / "deep.png").write_bytes(content[: len(content) // 2])
        with pytest.raises(ValueError, match="cannot read .*deep.png"):
            read_picture(tmp_path / "deep.png")


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif", ".webp", ".bmp", ".gif"])
def test_a_damaged_picture_is_refused_by_its_name_or_read(suffix: str, tmp_path: Path) -> None:
    """Cut at any place, and with bytes changed: Pillow raises whatever it likes."""
    generator = np.random.default_rng(0)
    Image.fromarray(generator.integers(0, 256, (9, 12, 3), dtype=np.uint8)).save(tmp_path / f"whole{suffix}")
    whole, path = (tmp_path / f"whole{suffix}").read_bytes(), tmp_path / f"x{suffix}"
    for trial in range(40):
        held = bytearray(whole[: generator.integers(0, len(whole))] if trial % 2 else whole)
        for _ in range(trial % 4 * (len(held) > 0)):
            held[int(generator.random() ** 3 * len(held))] = generator.integers(0, 256)
        path.write_bytes(held)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Pillow's own, of what it could read
            try:
                assert read_picture(path).isfinite().all()
            except ValueError as error:
                if path.name not in str(error):
                    raise AssertionError(str(error)) from error
