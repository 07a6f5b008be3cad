"""Filters, glasses and lamps from tables: what a data sheet says is what the camera does."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from commands import run
from draws import Draw
from PIL import Image
from torch import Tensor, nn

from kcam import Camera, Scene, isp, optics, plots, sensor, spectral
from kcam.context import Context
from kcam.sensor import ColourFilter, Transmission
from kcam.units import mm, nm, um


def random_table(draw: Draw, *, low: float = 380, high: float = 1000) -> tuple[Tensor, Tensor]:
    """Wavelengths [m] at unequal distances, and 1 to 6 channels."""
    count = 5 + int(draw.number(0, 60))
    wavelengths = torch.sort(low + (high - low) * draw.noise(count)).values
    wavelengths[0], wavelengths[-1] = low, high
    return wavelengths * nm, draw.noise(1 + int(draw.number(0, 6)), count)


def random_scene(draw: Draw, *, bands: Tensor, side: int = 12) -> Scene:
    return Scene.from_bands(draw.noise(1, len(bands), side, side), wavelengths=bands, depth=2.0)


def thin(**arguments) -> optics.Imaging:
    lens = optics.Lens(optics.CircularAperture(2 * mm), optics.ThinLens(8 * mm), focus_distance=2.0)
    return optics.Imaging(lens, pixel_pitch=4 * um, **arguments)


def write(folder: Path, text: str, name: str = "table.csv") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def as_csv(wavelengths: Tensor, columns: Tensor) -> str:
    rows = zip((wavelengths / nm).tolist(), columns.T.tolist(), strict=True)
    head = ",".join(["nm", *(f"channel {index}" for index in range(len(columns)))])
    return "\n".join([head, *(",".join(map(repr, [nm_, *values])) for nm_, values in rows)])


class TestCurves:
    @pytest.mark.parametrize("seed", range(6))
    def test_a_camera_sums_what_numpy_sums(self, seed: int, tmp_path: Path) -> None:
        draw = Draw(seed)
        wavelengths, curves = random_table(draw)
        bands = torch.linspace(400, 1000, 25, dtype=torch.float64) * nm
        scene, colours = random_scene(draw, bands=bands), ColourFilter.from_curves(wavelengths, curves.float())
        width = 25 * nm
        at = np.stack([np.interp(bands.numpy(), wavelengths.numpy(), curve) for curve in curves.float().numpy()])
        expected = np.einsum("cl,lhw->chw", at, scene.bands()[0].numpy()) * width / (100 * nm)
        found = Camera(colours)(scene)[0]
        assert np.abs(found.numpy() - expected).max() < 1e-6 * expected.max()
        from_file = ColourFilter.from_csv(write(tmp_path, as_csv(wavelengths, curves)))
        torch.testing.assert_close(from_file.response(bands), colours.response(bands), rtol=1e-6, atol=1e-7)

    def test_falling_wavelengths_are_turned(self) -> None:
        wavelengths, curves = torch.tensor([700.0, 500.0, 400.0]) * nm, torch.tensor([[0.1, 0.5, 0.3]])
        found = ColourFilter.from_curves(wavelengths, curves).response(torch.tensor([400.0, 600.0]) * nm)
        torch.testing.assert_close(found, torch.tensor([[0.3, 0.3]]).double())

    @pytest.mark.parametrize("seed", range(3))
    def test_an_imaging_absorbs_it_and_glass_before_it(self, seed: int) -> None:
        draw = Draw(seed)
        colours = ColourFilter.from_curves(*random_table(draw))
        nodes, values = random_table(draw, low=450, high=700)
        glass = Transmission(nodes, values[0])
        bands = torch.linspace(400, 1000, 12, dtype=torch.float64) * nm
        scene, imaging = random_scene(draw, bands=bands, side=24), thin()
        camera = Camera(imaging, glass, colours)
        staged = camera(scene)
        for stage in camera:
            staged = stage(staged if stage is not imaging else scene, camera.resolve(scene))
        torch.testing.assert_close(camera(scene), staged, rtol=1e-5, atol=1e-6)
        assert [name for name, _ in camera.steps(scene)] == ["Imaging + Transmission + ColourFilter"]

    def test_electrons_per_photon_are_counted_as_they_are(self) -> None:
        """Photons of an equal-energy cube by hand: E(lambda) area angle time lambda / h c QE."""
        bands = torch.arange(400, 1001, 5).double() * nm
        qe = torch.stack([torch.linspace(0.6, 0.05, 13)])
        table = torch.linspace(400, 1000, 13).double() * nm
        scene = Scene.from_bands(
            torch.ones(1, len(bands), 8, 8), wavelengths=bands, illuminant="E", depth=2.0, luminance=500.0
        )
        camera = Camera(
            thin(renormalise=True),
            ColourFilter.from_curves(table, qe, quantum_efficiency=True),
            sensor.Exposure(time=0.01),
            context=Context(full_well=1e4),
        )
        lens, found = camera[0].lens, camera(scene)[0, 0, 4, 4].item() * 1e4
        per_band = scene.bands()[0, :, 0, 0].double().numpy() * 500.0 / (683.002 * 106.856895e-9)  # W / (m^2 sr m)
        energy = per_band * np.pi * (1 * mm) ** 2 / float(lens.sensor_distance) ** 2 * (4 * um) ** 2 * 0.01
        photons = energy * bands.numpy() / 1.986445857e-25 * 5 * nm
        expected = (photons * np.interp(bands.numpy(), table.numpy(), qe[0].double().numpy())).sum()
        assert found == pytest.approx(expected, rel=2e-3)

    def test_white_is_grey_and_colours_are_near_behind_any_of_them(self) -> None:
        """The Nikon's curves as a table, behind an infrared cut and blue glass: white balance and matrix know them."""
        grid = torch.arange(400, 701, 5).double() * nm
        colours = ColourFilter.from_curves(grid, spectral.sensitivity("nikon_5100", wavelengths=grid))
        glass = Transmission(torch.tensor([400.0, 700.0]) * nm, torch.tensor([0.9, 0.4]))
        develop = (sensor.Exposure(), isp.WhiteBalance(), isp.ColourMatrix(), isp.ToneCurve())
        scene = Scene.builtin("colour_chart", (40, 60))
        for camera in (
            Camera(colours, *develop),
            Camera(glass, colours, *develop),
            Camera(thin(), glass, colours, *develop),
        ):
            white = camera(Scene.from_rgb(torch.ones(3, 12, 12), depth=2.0))
            assert (white[..., 6, 6] - 1).abs().max() < 0.01
            if camera[0] is not glass and not isinstance(camera[0], ColourFilter):
                continue
            assert (camera(scene) - scene.to_srgb()).abs().mean() < 0.03

    def test_a_part_of_a_camera_still_knows_of_the_glass(self) -> None:
        glass = Transmission(torch.tensor([400.0, 700.0]) * nm, torch.tensor([1.0, 0.1]))
        camera = Camera(thin(), glass, *list(Camera.phone().noiseless())[1:])
        scene = Scene.builtin("coffee", (16, 24))
        for cut in (3, 5):
            torch.testing.assert_close(camera[cut:](camera[:cut](scene)), camera(scene))
        staged = camera[2:](camera[:2](scene))  # 28 bands pass between them
        torch.testing.assert_close(staged, camera(scene), rtol=1e-4, atol=1e-4)

    def test_glass_takes_electrons_and_parts_between_glasses_know_of_both(self) -> None:
        scene = Scene.builtin("coffee", (12, 16))
        for colours in (ColourFilter.kodak(), ColourFilter.kodak().behind()):
            shots = []
            for share in (1.0, 0.1):
                grey = Transmission(torch.tensor([400.0, 700.0]) * nm, torch.tensor([share, share]))
                shots.append(Camera(thin(), grey, colours, sensor.Exposure(time=0.01))(scene))
            torch.testing.assert_close(shots[1], 0.1 * shots[0])
        blue, red = (Transmission(torch.tensor([400.0, 700.0]) * nm, torch.tensor(v)) for v in ([1.0, 0.2], [0.1, 1.0]))
        camera = Camera(thin(), red, blue, ColourFilter.kodak(), sensor.Exposure(), isp.WhiteBalance())
        for cut in range(1, 6):
            torch.testing.assert_close(camera[cut:](camera[:cut](scene)), camera(scene), rtol=1e-4, atol=1e-4)

    @pytest.mark.parametrize("photons", [False, True])
    def test_saved_cameras_take_the_same_pictures(self, photons: bool, tmp_path: Path) -> None:
        draw = Draw(3)
        nodes, values = random_table(draw)
        colours = ColourFilter.from_curves(nodes, values, quantum_efficiency=photons, trainable=True)
        camera = Camera(thin(), colours)
        camera.save(tmp_path / "camera.safetensors")
        scene = random_scene(draw, bands=torch.linspace(400, 900, 6).double() * nm, side=16)
        assert torch.equal(Camera.load(tmp_path / "camera.safetensors")(scene), camera(scene))

    def test_glass_is_saved_with_the_camera_and_with_a_filter(self, tmp_path: Path) -> None:
        glass = Transmission(torch.tensor([400.0, 700.0]) * nm, nn.Parameter(torch.tensor([1.0, 0.1])))
        scene = Scene.builtin("coffee", (8, 12))
        for stages in ((glass, ColourFilter.kodak()), (ColourFilter.kodak().behind(glass),)):
            camera = Camera(*stages, sensor.Exposure())
            camera.save(tmp_path / "camera.safetensors")
            assert torch.equal(Camera.load(tmp_path / "camera.safetensors")(scene), camera(scene))

    def test_gradients(self) -> None:
        draw = Draw(1)
        nodes, values = random_table(draw, high=700)
        context = Context(wavelengths=torch.linspace(420, 680, 5).double() * nm)
        signal = draw.noise(1, 5, 2, 2).requires_grad_()
        glass = Transmission(nodes, nn.Parameter(0.1 + 0.8 * values[0]))
        colours = ColourFilter(nn.Parameter(values), nodes=nodes)
        learned = ColourFilter.from_curves(nodes, values, trainable=True).double()

        def through(x: Tensor, *_: Tensor) -> Tensor:
            return colours(glass(x, context), context) + learned(x, context)[:, : len(values)]

        assert torch.autograd.gradcheck(through, (signal, glass.values, colours.coefficients, learned.coefficients))
        assert (learned.alpha() > 0).all()

    def test_an_optimiser_reaches_glass_that_an_imaging_absorbs(self) -> None:
        glass = Transmission(torch.tensor([400.0, 700.0]) * nm, nn.Parameter(torch.tensor([1.0, 0.5])))
        Camera(thin(), glass, ColourFilter.kodak())(Scene.builtin("coffee", (8, 12))).sum().backward()
        assert (glass.values.grad > 0).all()

    def test_linear_operator_and_plan_know_of_glass(self) -> None:
        glass = Transmission(torch.tensor([400.0, 700.0]) * nm, torch.tensor([1.0, 0.1]))
        camera, scene = Camera(thin(), glass, *list(Camera.phone())[1:]), Scene.builtin("coffee", (24, 32))
        operator = camera.linear(scene)
        raw = camera.noiseless().raw(scene)
        assert (operator(operator.light) + operator.offset - raw)[raw < 0.9].abs().max() < 1 / 1023
        x, y = torch.rand_like(operator.light), torch.rand(operator.raw_shape)
        assert float((operator(x) * y).sum()) == pytest.approx(float((x * operator.adjoint(y)).sum()), rel=1e-4)
        with torch.no_grad():
            plan = camera.plan(scene, tolerance=0.02)
            assert plan.measure(camera, scene) <= 0.02


class TestMonochrome:
    @staticmethod
    def camera() -> Camera:
        qe = ColourFilter.from_curves(
            torch.tensor([400.0, 600.0, 1000.0]) * nm, torch.tensor([[0.4, 0.7, 0.1]]), quantum_efficiency=True
        )
        stages = (sensor.Exposure(), sensor.ShotNoise(1e4), sensor.ReadNoise(3.0), sensor.ADC(bits=12, black_level=64))
        return Camera(thin(), qe, *stages)

    def test_it_is_a_camera(self, tmp_path: Path) -> None:
        camera, scene = self.camera(), Scene.builtin("coffee", (24, 32))
        raw = camera.raw(scene, generator=torch.Generator().manual_seed(0))
        assert raw.shape == (1, 1, 24, 32)
        assert torch.equal((raw * 4095).round(), raw * 4095) or (raw * 4095 - (raw * 4095).round()).abs().max() < 1e-3
        toned = Camera(*camera, isp.ToneCurve())
        assert torch.equal(toned.raw(scene, generator=torch.Generator().manual_seed(0)), raw)
        assert toned(scene).shape == (1, 1, 24, 32)
        with torch.no_grad():
            plan = toned.plan(scene, tolerance=0.02)
            assert plan.measure(toned, scene) <= 0.02
        operator = camera.linear(scene)
        assert operator.raw_shape == (1, 1, 24, 32)
        toned.save(tmp_path / "mono.safetensors")
        seeded = (torch.Generator().manual_seed(1) for _ in range(2))
        assert torch.equal(
            Camera.load(tmp_path / "mono.safetensors")(scene, generator=next(seeded)),
            toned(scene, generator=next(seeded)),
        )

    def test_the_command_takes_grey_pictures_with_it(self, tmp_path: Path) -> None:
        Camera(*self.camera(), isp.ToneCurve()).save(tmp_path / "mono.safetensors")
        plots.write_picture(torch.rand(3, 40, 60), tmp_path / "photo.png")
        run("shoot", tmp_path / "photo.png", "--camera", tmp_path / "mono.safetensors", "--out", tmp_path / "grey.png")
        with Image.open(tmp_path / "grey.png") as picture:
            assert (picture.mode, picture.size) == ("L", (60, 40))

    def test_near_infrared_counts(self) -> None:
        bands = torch.linspace(400, 1000, 13).double() * nm
        light = torch.zeros(1, 13, 12, 12)
        light[:, bands > 800 * nm] = 1.0
        scene = Scene.from_bands(light, wavelengths=bands, depth=2.0)
        assert float(self.camera()[:3](scene).mean()) > 0.05
        assert float(Camera(thin(), ColourFilter.kodak(infrared_cut=650 * nm), sensor.Exposure())(scene).mean()) < 1e-3


@pytest.mark.parametrize(
    ("wavelengths", "curves", "text"),
    [
        ([400.0, 500.0], [[0.1, 0.2]], "Wavelengths are in metres; did you mean 400"),
        ([4e-7, 4e-7], [[0.1, 0.2]], "two or more wavelengths that rise"),
        ([4e-7], [[0.1]], "two or more wavelengths that rise"),
        ([4e-7, 5e-7], [[0.1, 0.2, 0.3]], r"curves must be a tensor \(C, 2\)"),
        ([4e-7, 5e-7], [0.1, 0.2], r"curves must be a tensor \(C, 2\)"),
        ([4e-7, 5e-7], [[10.0, 45.0]], "got 10 to 45. Percent"),
        ([4e-7, 5e-7], [[0.1, -0.2]], "clamp it"),
        ([4e-7, 5e-7], [[0.1, 2.004]], r"got 0.1 to 2.004. Measured noise.* curves.clamp\(0, 2\)"),
        ([4e-7, 5e-7], [[0.1, float("nan")]], r"curves must be finite.*got 1 that are NaN.*keep = curves.isfinite\(\)"),
        ([4e-7, 5e-7], [[0.0, 0.0]], "sees nothing"),
    ],
)
def test_curves_that_are_none(wavelengths: list[float], curves: list, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        ColourFilter.from_curves(torch.tensor(wavelengths), torch.tensor(curves))


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (float("nan"), r"values must be shares, 0..1, got 1 that are NaN or infinite. Leave .*values\[..., keep\]"),
        (1.004, r"got 0.1 to 1.004. Measured noise is no light: clamp it, values.clamp\(0, 1\)"),
        (-0.01, r"got -0.01 to 0.1. Measured noise"),
        (45.0, "got 0.1 to 45. Percent"),
    ],
)
def test_transmissions_that_are_none(value: float, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        Transmission(torch.tensor([4e-7, 5e-7]), torch.tensor([0.1, value]))


def test_what_an_error_about_nan_says_works() -> None:
    wavelengths, curves = torch.tensor([4e-7, 5e-7, 6e-7]), torch.tensor([[0.1, float("nan"), 0.2], [0.1, 0.3, 0.4]])
    keep = curves.isfinite().all(0)
    assert ColourFilter.from_curves(wavelengths[keep], curves[..., keep]).coefficients.shape == (2, 2)
    with pytest.raises(ValueError, match="1 are NaN or infinite: give what was measured"):
        ColourFilter(curves, nodes=wavelengths)


def test_more_than_an_electron_per_photon_is_none() -> None:
    table = torch.tensor([4e-7, 5e-7]), torch.tensor([[0.2, 1.2]])
    ColourFilter.from_curves(*table)
    with pytest.raises(ValueError, match="at most 1 electrons per photon, got 0.2 to 1.2. Percent"):
        ColourFilter.from_curves(*table, quantum_efficiency=True)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "0 rows"),
        ("nm,a\n400,1\n", "1 rows behind its header"),
        ("400,1\n500,1\n600,1\n", "line 1: expected a header"),
        ("nm,a,b\n400,1\n500,1,2\n", "line 2: 2 columns, and the header has 3"),
        ("nm,a\n400,1\n500,one\n", "line 3: a 'one' is no number"),
        ("nm;a\n400;0,5\n500;0,6\n", "line 2: a '0,5' is no number. Write 0.5"),
        ("nm,a\n400,1\n\n# noise\n500,nan\n", "line 5: a must be finite and >= 0, got nan"),
        ("nm,a\n400,1\n500,-0.1\n", "line 3: a must be finite and >= 0, got -0.1.*write 0"),
        ("um,a\n0.4,1\n0.5,1\n", "line 2: um 0.4 is outside.*look like micrometres: multiply by 1000"),
        ("m,a\n4e-7,1\n5e-7,1\n", "line 2.*look like metres: multiply by 1e9"),
        ("A,a\n4000,1\n7000,1\n", "line 2.*angstroms: divide by 10"),
        ("nm,a\n400,1\n400,1\n", "line 3: nm 400 nm does not follow 400 nm"),
        ("nm,a\n400,1\n600,1\n500,1\n", "line 4: nm 500 nm does not follow 600 nm"),
        ("nm,QE [%]\n400,50\n600,60\n", "line 1: column 'QE \\[%\\]' is in percent. Say so: percent=True"),
    ],
)
def test_tables_that_are_none(text: str, said: str, tmp_path: Path) -> None:
    path = write(tmp_path, text)
    for read in (spectral.read_csv, ColourFilter.from_csv, Transmission.from_csv):
        with pytest.raises(ValueError, match=said):
            read(path)


def test_a_table_in_percent_that_does_not_say_so(tmp_path: Path) -> None:
    path = write(tmp_path, "nm,a\n400,50\n600,60\n")
    for read in (ColourFilter.from_csv, Transmission.from_csv):
        with pytest.raises(ValueError, match=r"table.csv: .*got 50 to 60. Percent\? Then.*percent=True"):
            read(path)
        read(path, percent=True)


def test_a_table_of_shares_is_not_in_percent(tmp_path: Path) -> None:
    path = write(tmp_path, "nm,a\n400,0.5\n600,0.6\n")
    for read in (ColourFilter.from_csv, Transmission.from_csv):
        with pytest.warns(UserWarning, match=r"table.csv: the highest value is 0.6.*leave percent=True off"):
            read(path, percent=True)
        read(path)
    dark = write(tmp_path, "nm,a [%]\n400,0.5\n600,0.6\n")  # glass that lets little through, and says so
    assert float(Transmission.from_csv(dark, percent=True).values.max()) == pytest.approx(0.006)


def test_tables_as_spreadsheets_write_them(tmp_path: Path) -> None:
    path = write(tmp_path, '\ufeff"nm";"a";"b"\r\n# measured\r\n700; 0.1; 0.2\r\n\r\n400;0.3;0.4\r\n;;\r\n')
    table = spectral.read_csv(path)
    assert table.names == ("a", "b")
    assert table.values.tolist() == [[0.3, 0.1], [0.4, 0.2]]
    with pytest.raises(FileNotFoundError, match=r"no file .*no.csv"):
        spectral.read_csv(tmp_path / "no.csv")
    (tmp_path / "binary.csv").write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(ValueError, match="is no text"):
        spectral.read_csv(tmp_path / "binary.csv")
    for make in (Transmission.from_csv, lambda path: Transmission(spectral.read_csv(path))):
        with pytest.raises(ValueError, match=r"has 2 columns \(a, b\): expected one transmission"):
            make(path)
    one = write(tmp_path, "nm,T\n400,0.5\n700,0.9\n", "one.csv")
    assert torch.equal(Transmission(spectral.read_csv(one)).values, Transmission.from_csv(one).values)


class TestGlass:
    def test_errors(self) -> None:
        nodes = torch.tensor([400.0, 700.0]) * nm
        for values, text in (
            ([0.1, 92.0], r"got 0.1 to 92. Percent\?"),
            ([0.1, float("nan")], "shares, 0..1"),
            ([1.0], r"\(2,\)"),
        ):
            with pytest.raises(ValueError, match=text):
                Transmission(nodes, torch.tensor(values))
        glass = Transmission(nodes, torch.tensor([0.1, 0.9]))
        with pytest.raises(ValueError, match="Put it before the ColourFilter"):
            glass(torch.ones(1, 3, 4, 4))
        with pytest.raises(ValueError, match="stands after ColourFilter.*Move it before"):
            Camera(ColourFilter.kodak(), glass)
        with pytest.raises(ValueError, match="stands before Imaging.*Move it behind"):
            Camera(glass, thin())

    def test_light_before_a_camera_without_a_filter(self) -> None:
        scene = Scene.builtin("coffee", (8, 12))
        glass = Transmission(torch.tensor([400.0, 800.0]) * nm, torch.tensor([0.0, 1.0]))
        found = Camera(glass)(scene)
        share = (scene.wavelengths / nm - 400) / 400
        torch.testing.assert_close(found, scene.bands() * share[:, None, None].float())


class TestLamps:
    def test_a_measured_lamp_is_that_of_its_name(self) -> None:
        grid = torch.arange(300, 831, 1).double() * nm
        _, lamp = grid, torch.exp(-0.5 * ((grid / nm - 560) / 60) ** 2)
        bands = torch.linspace(420, 720, 28).double() * nm
        found = spectral.illuminant(spectral.SpectralTable(grid, lamp[None], ("led",)), wavelengths=bands)
        direct = torch.exp(-0.5 * ((bands / nm - 560) / 60) ** 2)
        torch.testing.assert_close(found / found.max(), direct / direct.max(), atol=0.01, rtol=0)

    def test_lines_between_bands_are_kept(self, tmp_path: Path) -> None:
        """A line of 4 nm that no band hits: its light is on the bands beside it, and white has its colour."""
        path = write(tmp_path, "nm,power\n524,0\n526,1\n528,0\n600,0\n602,1\n604,0\n")
        lamp = spectral.read_csv(path)
        bands = torch.linspace(420, 720, 28).double() * nm
        found = spectral.illuminant(lamp, wavelengths=bands)
        observer = spectral.observer(torch.tensor([526.0, 602.0]) * nm).sum(0)
        white = found @ spectral.xyz_weights(bands)
        torch.testing.assert_close(white, observer / observer[1], atol=2e-3, rtol=0)
        assert Scene.from_rgb(torch.ones(3, 4, 4), depth=2.0, illuminant=lamp).illuminant.shape == (28,)

    def test_light_beyond_the_eye(self) -> None:
        bands = torch.arange(400, 1001, 20).double() * nm
        lamp = spectral.SpectralTable(
            torch.tensor([400.0, 700, 701, 840, 860, 900, 920]) * nm, torch.tensor([[1.0, 1, 0, 0, 2, 2, 0]]), ("l",)
        )
        found = spectral.illuminant(lamp, wavelengths=bands)
        assert float(found[bands > 930 * nm].abs().max()) == 0
        assert float(found[24] / found[5]) == pytest.approx(2, rel=0.05)  # 880 and 500 nm

    def test_errors(self) -> None:
        nodes = torch.tensor([400.0, 700.0]) * nm
        bands = torch.linspace(420, 720, 5).double() * nm
        narrow = torch.tensor([300.0, 320.0, 340.0]) * nm
        uv = spectral.SpectralTable(narrow, torch.tensor([[0.0, 1.0, 0.0]]), ("a",))
        for table, text in (
            (spectral.SpectralTable(nodes, torch.ones(2, 2), ("a", "b")), r"one column, and this table 2 \(a, b\)"),
            (spectral.SpectralTable(nodes, torch.zeros(1, 2), ("a",)), "not all zero"),
            (spectral.SpectralTable(nodes + 500 * nm, torch.ones(1, 2), ("a",)), "no light that the eye sees"),
            (spectral.SpectralTable(nodes - 30 * nm, torch.tensor([[1.0, 0.0]]), ("a",)), None),
            (spectral.SpectralTable(nodes.flip(0), torch.ones(1, 2), ("a",)), "two or more wavelengths that rise"),
            (uv, "none on these bands"),
        ):
            if text is None:
                assert spectral.illuminant(table, wavelengths=bands).isfinite().all()
                continue
            with pytest.raises(ValueError, match=text):
                spectral.illuminant(table, wavelengths=bands)
