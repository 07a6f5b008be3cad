"""PSFs from elsewhere: a camera with them is the camera with the lens that they were taken from."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from draws import Draw
from torch import Tensor

from kcam import Camera, Scene, isp, optics, sensor
from kcam.context import Context
from kcam.optics.regions import field_shares, pixel_positions
from kcam.optics.source import Defocus, PixelGrid, Points, PSFSource
from kcam.units import mm, nm, um, wavelength_grid

BANDS = wavelength_grid(count=5)
DISTANCES = [1.5, 2.5, math.inf]
PITCH = 4 * um


def random_lens(draw: Draw) -> optics.Lens:
    aperture = draw.one_of(
        optics.CircularAperture(draw.number(2, 5) * mm), optics.SquareAperture(draw.number(2, 4) * mm)
    )
    glass = draw.one_of(optics.ThinLens(50 * mm), optics.PlanoConvexLens(25.8 * mm, glass="N-BK7"))
    return optics.Lens(aperture, glass, focus_distance=draw.number(1, 5))


def measured(lens: optics.Lens, side: int = 25, *, pitch: float = PITCH, **arguments) -> optics.MeasuredPSF:
    psfs = torch.cat([lens.psf(BANDS, distances=z, pixel_pitch=pitch, shape=(side, side)) for z in DISTANCES])
    return optics.MeasuredPSF(psfs, wavelengths=BANDS, distances=DISTANCES, pixel_pitch=pitch, **arguments)


def some(**changes) -> optics.MeasuredPSF:
    arguments = {"psfs": torch.ones(1, 2, 3, 3) / 9, "wavelengths": [450 * nm, 650 * nm], "distances": [2.0]}
    return optics.MeasuredPSF(**(arguments | {"pixel_pitch": PITCH} | changes))


def scene_of(draw: Draw, depth: float | Tensor = 2.5, *, size: tuple[int, int] = (24, 31)) -> Scene:
    return Scene.from_bands(draw.noise(1, len(BANDS), *size).float(), wavelengths=BANDS, depth=depth)


def camera_of(lens: PSFSource, *, time: float | None = None) -> Camera:
    imaging = optics.Imaging(lens, pixel_pitch=PITCH, psf_shape=(25, 25))
    return Camera(
        imaging, sensor.ColourFilter.kodak(), sensor.Mosaic("RGGB"), sensor.Exposure(time=time),
        isp.Demosaic(), isp.WhiteBalance(), isp.ColourMatrix(), isp.ToneCurve(),
    )  # fmt: skip


@pytest.mark.parametrize("seed", range(6))
def test_at_what_was_measured_it_is_the_lens(seed: int) -> None:
    draw = Draw(seed)
    lens = random_lens(draw)
    scene = scene_of(draw, draw.one_of(*DISTANCES))
    how = {"border": draw.one_of("reflect", "zero"), "psf_shape": (25, 25), "pixel_pitch": PITCH}
    how |= draw.one_of({}, {"direct": True}, {"tile": 16})
    filters = draw.one_of(None, sensor.ColourFilter.kodak())
    truth = optics.Imaging(lens, **how)(scene, colour_filter=filters)
    found = optics.Imaging(measured(lens), **how)(scene, colour_filter=filters)
    assert float((found - truth).norm() / truth.norm()) < 1e-6


def test_a_camera_and_its_file(tmp_path: Path) -> None:
    """Exposure in seconds needs the area and the sensor's distance; a saved camera has the PSFs inside."""
    draw = Draw(0)
    lens = random_lens(draw)
    known = {"aperture_area": lens.aperture_area(), "sensor_distance": float(lens.sensor_distance)}
    scene = scene_of(draw)
    truth = camera_of(lens, time=0.01)(scene)
    camera = camera_of(measured(lens, **known, focus_distance=2.0), time=0.01)
    assert torch.allclose(camera(scene), truth, atol=1e-5)
    camera.save(tmp_path / "camera.safetensors")
    assert torch.equal(Camera.load(tmp_path / "camera.safetensors")(scene), camera(scene))
    assert torch.allclose(camera_of(measured(lens))(scene), camera_of(lens)(scene), atol=1e-5)  # automatic exposure
    with pytest.raises(ValueError, match="aperture_area"):
        camera_of(measured(lens), time=0.01)(scene)
    with pytest.raises(ValueError, match=r"nobody knows where; say where the bands are: Imaging\(distance=2.0\)"):
        optics.Imaging(measured(lens))(torch.rand(1, 5, 8, 8), Context(wavelengths=BANDS))


def test_between_distances_the_stated_error_holds() -> None:
    """Layers lie where PSFs were measured, so a map of depth costs no more of them."""
    lens = optics.Lens(optics.CircularAperture(3 * mm), optics.ThinLens(50 * mm), focus_distance=2.0)
    distances = [1 / v for v in np.linspace(0.35, 0.65, 7)]
    psfs = lens.psf(BANDS, distances=torch.tensor(distances), pixel_pitch=PITCH, shape=(25, 25))
    known = optics.MeasuredPSF(psfs, wavelengths=BANDS, distances=distances, pixel_pitch=PITCH)
    stated = known.deviation().between_distances
    between = torch.tensor([1 / v for v in np.linspace(0.375, 0.625, 6)])
    truth = lens.psf(BANDS, distances=between, pixel_pitch=PITCH, shape=(25, 25))
    found = known.bank(Points(1 / between.double()), BANDS, PixelGrid(PITCH, (25, 25)))
    worst = float(((found - truth).abs().sum((-2, -1)) / truth.sum((-2, -1))).max())
    assert stated / 3 < worst < 3 * stated
    depth = 1 / torch.linspace(0.36, 0.64, 24 * 31).view(24, 31)
    imaging = optics.Imaging(known, pixel_pitch=PITCH)
    assert imaging.depth_layers(depth, BANDS).numel() == 7  # the two ends of the map, and five distances between
    assert torch.isfinite(imaging(scene_of(Draw(1), depth))).all()


@pytest.mark.parametrize("pitch", [2.5 * um, 3 * um, 5 * um, 8 * um])
def test_another_pitch_loses_no_light_and_states_its_cost(pitch: float) -> None:
    lens = optics.Lens(optics.CircularAperture(3 * mm), optics.ThinLens(50 * mm), focus_distance=2.0)
    known = measured(lens, 41)
    points = Points(torch.tensor([1 / 1.5], dtype=torch.float64))
    pixels = PixelGrid(pitch, (1, 1), dtype=torch.float64)
    window = known.window(points, BANDS, pixels)
    found = known.bank(points, BANDS, PixelGrid(pitch, window, dtype=torch.float64))
    assert torch.allclose(found.sum((-2, -1)), known.psfs[:1].double().sum((-2, -1)), rtol=1e-12)
    truth = lens.psf(BANDS, distances=1.5, pixel_pitch=pitch, shape=window, dtype=torch.float64)
    worst = float(((found - truth).abs().sum((-2, -1)) / truth.sum((-2, -1))).max())
    assert worst < 3 * known.deviation(pixel_pitch=pitch).resampling
    assert known.deviation(pixel_pitch=PITCH).resampling == 0
    part = known.bank(points, BANDS, PixelGrid(pitch, window, fill_factor=0.5, dtype=torch.float64))
    assert torch.allclose(part.sum((-2, -1)), found.sum((-2, -1)), rtol=1e-9)


def positions_of(kind: str) -> Tensor:
    corners = torch.tensor([[-1.0, -1], [1, -1], [-1, 1], [1, 1]])
    return (
        {
            "one": torch.zeros(1, 2),
            "line": torch.tensor([[-1.0, -1], [0, 0], [1, 1]]),
            "grid": corners,
            "scattered": torch.cat([corners * 0.8, torch.tensor([[0.1, 0.2]])]),
        }[kind].double()
        * 0.05
        * mm
    )


@pytest.mark.parametrize("kind", ["one", "line", "grid", "scattered"])
def test_zones_are_a_partition_of_the_picture(kind: str) -> None:
    nodes, draw = positions_of(kind), Draw(2)
    shares = field_shares(nodes, pixel_positions((24, 31), PITCH))
    assert float(shares.min()) >= 0
    assert torch.allclose(shares.sum(-1), torch.ones(24, 31, dtype=torch.float64))
    assert torch.allclose(field_shares(nodes, nodes), torch.eye(len(nodes), dtype=torch.float64), atol=1e-9)
    steps = [shares.diff(dim=dim).abs().max() for dim in (0, 1)]
    assert len(nodes) == 1 or max(steps) < 0.15  # continuous, also beyond the outermost
    inside = nodes.mean(0) + 0.1 * (nodes[:1] - nodes.mean(0))
    assert torch.allclose(field_shares(nodes, inside) @ nodes, inside, atol=1e-9)
    one = measured(random_lens(draw))
    many = optics.MeasuredPSF(
        one.psfs.expand(len(nodes), -1, -1, -1, -1), wavelengths=BANDS, distances=DISTANCES, pixel_pitch=PITCH,
        positions=nodes,
    )  # fmt: skip
    scene = scene_of(draw)
    pictures = [optics.Imaging(source, pixel_pitch=PITCH)(scene) for source in (one, many)]
    assert torch.allclose(*pictures, atol=1e-5)


def test_a_place_of_the_picture_has_its_own_psf() -> None:
    """+x of the sensor is where the light of the left of the picture falls, for pictures are upright."""
    psfs = torch.zeros(2, 1, len(BANDS), 5, 5)
    psfs[0, ..., 2, 2] = 1  # sharp at -x
    psfs[1] = 1 / 25  # blurred at +x
    source = optics.MeasuredPSF(
        psfs,
        wavelengths=BANDS,
        distances=[2.0],
        pixel_pitch=PITCH,
        positions=torch.tensor([[-0.04, 0], [0.04, 0]]) * mm,
    )
    light = torch.zeros(1, len(BANDS), 9, 31)
    light[..., 4, 3] = light[..., 4, 27] = 1
    picture = optics.Imaging(source, pixel_pitch=PITCH)(Scene.from_bands(light, wavelengths=BANDS, depth=2.0))
    assert float(picture[0, 0, 4, 27]) > 0.9
    assert float(picture[0, 0, 4, 3]) < 0.1


def test_gradients_to_psfs_and_distance() -> None:
    psfs = torch.nn.Parameter(Draw(0).noise(2, 2, 3, 3) + 0.1)
    vergence = torch.tensor([0.45], dtype=torch.float64, requires_grad=True)

    def bank(psfs: Tensor, vergence: Tensor) -> Tensor:
        source = optics.MeasuredPSF(psfs, wavelengths=[450 * nm, 650 * nm], distances=[2.0, 3.0], pixel_pitch=PITCH)
        grid = torch.tensor([500, 600], dtype=torch.float64) * nm
        return source.bank(Points(vergence), grid, PixelGrid(3 * um, (5, 5), dtype=torch.float64))

    assert torch.autograd.gradcheck(bank, (psfs, vergence))
    assert [name for name, _ in some(psfs=psfs, distances=[2.0, 3.0]).named_parameters()] == ["psfs"]


@pytest.mark.parametrize("distance", [2.0, 2.4, 3.0])
def test_a_measured_distance_has_a_gradient_too(distance: float) -> None:
    """The slope towards the node beside it, which is that of all values between."""
    psfs = torch.zeros(2, 1, 1, 1, dtype=torch.float64)
    psfs[:, 0, 0, 0] = torch.tensor([0.2, 0.8])
    source = optics.MeasuredPSF(psfs, wavelengths=[550 * nm], distances=[2.0, 3.0], pixel_pitch=PITCH)
    vergence = torch.tensor([1 / distance], dtype=torch.float64, requires_grad=True)
    pixels = PixelGrid(PITCH, (1, 1), dtype=torch.float64)
    source.bank(Points(vergence), torch.tensor([550 * nm], dtype=torch.float64), pixels).sum().backward()
    assert float(vergence.grad) == pytest.approx(0.6 / (1 / 3 - 1 / 2))


@pytest.mark.parametrize("suffix", [".npz", ".h5", ".fits"])
def test_files(suffix: str, tmp_path: Path) -> None:
    known = measured(random_lens(Draw(3)), aperture_area=1e-5, sensor_distance=0.05)
    path = tmp_path / f"psf{suffix}"
    arrays = {name: np.asarray(value) for name, value in known.configuration().items() if value is not None}
    if suffix == ".npz":
        np.savez(path, **arrays)
    elif suffix == ".h5":
        h5py = pytest.importorskip("h5py")
        with h5py.File(path, "w") as file:
            for name, values in arrays.items():
                file[name] = values
    else:
        fits = pytest.importorskip("astropy.io.fits")
        units = [fits.ImageHDU(np.atleast_1d(values), name=name) for name, values in arrays.items()]
        fits.HDUList([fits.PrimaryHDU(), *units]).writeto(path)
    read = optics.MeasuredPSF.from_file(path)
    for name, value in known.configuration().items():
        again = read.configuration()[name]
        assert torch.equal(again, value) if isinstance(value, Tensor) else again == value, name
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(ValueError, match="cannot read"):
        optics.MeasuredPSF.from_file(path)


def test_files_that_are_none(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="there is no file"):
        optics.MeasuredPSF.from_file(tmp_path / "psf.npz")
    (tmp_path / "psf.txt").write_text("1 2 3")
    with pytest.raises(ValueError, match="none of .npz, .h5, .hdf5, .fits"):
        optics.MeasuredPSF.from_file(tmp_path / "psf.txt")
    np.savez(tmp_path / "few.npz", psfs=np.ones((1, 1, 3, 3)))
    with pytest.raises(ValueError, match="has no wavelengths, distances, pixel_pitch; it holds psfs"):
        optics.MeasuredPSF.from_file(tmp_path / "few.npz")
    np.savez(tmp_path / "words.npz", psfs=np.ones((1, 1, 3, 3)), wavelengths="a", distances=1.0, pixel_pitch=1e-6)
    with pytest.raises(ValueError, match="wavelengths must hold numbers"):
        optics.MeasuredPSF.from_file(tmp_path / "words.npz")


WRONG = [
    ({"psfs": np.ones((1, 2, 3, 3))}, TypeError, "must be a floating-point tensor"),
    ({"psfs": torch.ones(2, 3, 3)}, ValueError, r"must be \(Z, L, H, W\)"),
    ({"psfs": torch.ones(2, 2, 3, 3)}, ValueError, "of 2 distances and 2 wavelengths, but 1 and 2 are given"),
    ({"psfs": torch.full((1, 2, 3, 3), math.nan)}, ValueError, "NaN or infinite"),
    ({"psfs": torch.ones(1, 2, 3, 3) - 1.5}, ValueError, "background subtraction"),
    ({"psfs": torch.zeros(1, 2, 3, 3)}, ValueError, "dark everywhere"),
    ({"wavelengths": [450.0, 650.0]}, ValueError, "nm"),
    ({"wavelengths": [450 * nm, 450 * nm]}, ValueError, "twice"),
    ({"distances": [0.0]}, ValueError, "distance"),
    ({"pixel_pitch": 4.0}, ValueError, "pitch"),
    ({"positions": torch.zeros(1, 2)}, ValueError, "do not go together"),
    ({"psfs": torch.ones(1, 1, 2, 3, 3)}, ValueError, "do not go together"),
    ({"psfs": torch.ones(1, 1, 2, 3, 3), "positions": torch.zeros(2, 2)}, ValueError, r"\(1, 2\)"),
    ({"psfs": torch.ones(2, 1, 2, 3, 3), "positions": torch.zeros(2, 2)}, ValueError, "a place twice"),
    ({"psfs": torch.ones(1, 1, 2, 3, 3), "positions": torch.tensor([[2.0, 0]])}, ValueError, "in metres"),
    ({"aperture_area": -1.0}, ValueError, "aperture_area"),
    ({"focus_distance": -1.0}, ValueError, "focus_distance"),
]  # fmt: skip


@pytest.mark.parametrize(("changes", "error", "message"), WRONG)
def test_what_cannot_be_is_refused(changes: dict, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        some(**changes)


def test_a_scene_of_wavelengths_that_were_not_measured() -> None:
    with pytest.raises(ValueError, match=r"measured from 450 to 650 nm, and the scene has 420 nm"):
        optics.Imaging(some(), pixel_pitch=PITCH)(scene_of(Draw(0)))


@pytest.mark.parametrize("name", ["propagator", "method", "samples", "kappa"])
def test_what_is_measured_is_not_propagated(name: str) -> None:
    value = {"propagator": "fresnel", "method": "matrix", "samples": 64, "kappa": 3.0}[name]
    with pytest.raises(ValueError, match=f"{name}= says how a Lens computes its PSFs; a MeasuredPSF has them"):
        optics.Imaging(some(), **{name: value})


class Pinhole:
    """A source of one's own: one pixel of light, everywhere."""

    focus_distance, sensor_distance = 2.0, None

    def bank(self, points: Points, wavelengths: Tensor, pixels: PixelGrid) -> Tensor:
        psfs = torch.zeros(len(points.vergences), len(wavelengths), *pixels.shape, dtype=pixels.dtype)
        psfs[..., pixels.shape[0] // 2, pixels.shape[1] // 2] = 1
        return psfs

    def window(self, points: Points, wavelengths: Tensor, pixels: PixelGrid) -> tuple[int, int]:
        return 3, 3

    def defocus_waves(self, wavelengths: Tensor) -> float:
        return 0.0

    def defocus(self, wavelengths: Tensor, pixel_pitch: float) -> Defocus:
        return Defocus()

    def aperture_area(self) -> None:
        return None


def test_a_source_of_ones_own() -> None:
    light = torch.rand(1, len(BANDS), 12, 9)
    scene = Scene.from_bands(light, wavelengths=BANDS, depth=2.0)
    assert torch.allclose(optics.Imaging(Pinhole())(scene), light, atol=1e-6)
    with pytest.raises(TypeError, match=r"takes an optics.Lens or another source of PSFs, got str"):
        optics.Imaging("lens")
