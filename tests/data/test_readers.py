"""Each reader against small files that an independent writer made in exactly the data set's layout."""

from __future__ import annotations

import importlib
import pkgutil
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
import writers
from scipy.io import savemat
from writers import Written

from kcam.data import CubeError, read_cube
from kcam.data import readers as module
from kcam.units import nm

CAVE31 = np.asarray(writers.GRID_400) * nm


def same(written: Written, **how: object) -> None:
    """Values, wavelengths, unit, mask and orientation are what was written."""
    cube = read_cube(written.path, **how)
    assert cube.shape == written.values.shape
    np.testing.assert_allclose(cube.wavelengths.numpy() / nm, written.nm, rtol=0, atol=1e-6)  # 1e-6 nm: the header's
    mask = np.ones(written.values.shape[1:], bool) if written.mask is None else written.mask
    if written.mask is None:
        assert cube.mask is None
    else:
        assert (cube.mask.numpy() == mask).all()
    np.testing.assert_allclose(cube.values.numpy()[:, mask], written.values[:, mask], rtol=0, atol=written.quantum)
    assert (cube.values.numpy()[:, ~mask] == 0).all()
    assert cube.unit == written.unit
    assert cube.source["format"] == written.format
    if written.format != "kcam":
        assert cube.source["scaling"]
        assert cube.source["orientation"]


@pytest.mark.parametrize("name", writers.ALL)
def test_reads_what_was_written_without_being_told_the_format(name: str, tmp_path: Path) -> None:
    same(writers.ALL[name](tmp_path))


@pytest.mark.parametrize("name", writers.TIFFS)
def test_tiff(name: str, tmp_path: Path) -> None:
    written = writers.TIFFS[name](tmp_path)
    with pytest.raises(CubeError, match="31 bands and no wavelengths"):
        read_cube(written.path)
    same(written, wavelengths=CAVE31)
    with pytest.raises(CubeError, match="31 bands, but 28 wavelengths"):
        read_cube(written.path, wavelengths=CAVE31[:28])


@pytest.mark.parametrize(
    "name", ["kaist", "cave", "icvl", "arad1k", "harvard", "cassi HSI", "envi bil u2 little", "npz"]
)
def test_the_format_may_be_named(name: str, tmp_path: Path) -> None:
    written = writers.ALL[name](tmp_path)
    same(written, format=written.format)


@pytest.mark.parametrize("name", [*writers.ALL, *writers.TIFFS])
def test_strips_are_the_whole(name: str, tmp_path: Path) -> None:
    written = (writers.ALL | writers.TIFFS)[name](tmp_path)
    source = module.open_source(written.path, options=module.Options(wavelengths=CAVE31 if "tiff" in name else None))
    whole, valid = source.checked_rows(0, source.shape[1])
    for first, last in ((0, 1), (3, 7), (7, 12), (11, 12)):
        part, inside = source.checked_rows(first, last)
        assert (part == whole[:, first:last]).all()
        expected = None if valid is None else valid[first:last]
        assert inside is None if expected is None or expected.all() else (inside == expected).all()


def test_the_sets_that_are_copies_of_one_another_fall_in_one_group(tmp_path: Path) -> None:
    for key, group in (("img_expand", "cave_1024_28"), ("img16", "cave_1024_28"), ("img", None), ("HSI", None)):
        assert read_cube(writers.cassi(tmp_path, key).path).source.get("group") == group


# ---- bands are known by wavelength, never by place


def test_exr_channels_are_sorted_by_number_not_by_name(tmp_path: Path) -> None:
    # An EXR keeps its channels by name, and w1000nm comes before w420nm there.
    written = writers.kaist(tmp_path, writers.cube(4), (420, 700.5, 1000, 1100))
    same(written)


def test_descending_wavelengths_stay_with_their_bands(tmp_path: Path) -> None:
    same(writers.envi(tmp_path, nm=tuple(reversed(writers.GRID_400))))
    same(writers.envi(tmp_path, nm=(650, 450, 550), name="mixed"))


def test_exr_with_a_channel_of_another_name_is_refused(tmp_path: Path) -> None:
    written = writers.kaist(tmp_path)
    path = written.path
    path.write_bytes(path.read_bytes().replace(b"w500nm", b"w5o0nm"))
    with pytest.raises(CubeError, match="no wavelengths such as w420nm: w5o0nm"):
        read_cube(path)


def test_exr_without_bands(tmp_path: Path) -> None:
    import OpenEXR

    path = tmp_path / "photo.exr"
    planes = {colour: np.zeros((4, 5), np.float32) for colour in "RGB"}
    OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, planes).write(str(path))
    with pytest.raises(CubeError, match="no wavelengths such as w420nm: B, G, R"):
        read_cube(path)


# ---- wavelengths that are missing or wrong


def test_cassi_without_28_bands_needs_wavelengths(tmp_path: Path) -> None:
    values = writers.cube(24)
    savemat(tmp_path / "a.mat", {"HSI": values.transpose(1, 2, 0)})
    with pytest.raises(CubeError, match="24 bands and no wavelengths"):
        read_cube(tmp_path / "a.mat")
    cube = read_cube(tmp_path / "a.mat", wavelengths=np.linspace(450, 680, 24) * nm)
    np.testing.assert_allclose(cube.values.numpy(), values, atol=1e-7)  # float32 rounding


def test_the_cassi_grid_is_the_published_one() -> None:
    assert module.CASSI_NM == writers.CASSI
    assert len(module.CASSI_NM) == 28


def test_envi_without_wavelengths_and_with_wave_numbers(tmp_path: Path) -> None:
    path = writers.envi(tmp_path).path
    text = path.read_text()
    path.write_text(text.replace("wavelength = {", "wavenumber = {"))
    with pytest.raises(CubeError, match="31 bands and no wavelengths"):
        read_cube(path)
    path.write_text(text.replace("units = Nanometers", "units = Wavenumber"))
    with pytest.raises(CubeError, match="'wavenumber', not in nm or um"):
        read_cube(path)
    path.write_text(text.replace("410.000000, ", "", 1))
    with pytest.raises(CubeError, match="31 bands, but 30 wavelengths"):
        read_cube(path)
    path.write_text(text.replace("410.000000", "400.000000"))
    with pytest.raises(CubeError, match="same wavelength"):
        read_cube(path)
    path.write_text(text.replace("410.000000", "4.1"))
    with pytest.raises(CubeError, match=r"4\.1 nm, outside 100\.\.20000 nm"):
        read_cube(path)


def test_npz_without_wavelengths(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", cube=np.ones((5, 4, 4), np.float32))
    with pytest.raises(CubeError, match="its 'cube' is 5 x 4 x 4, and it has no wavelengths. Say which: --wavelengths"):
        read_cube(tmp_path / "a.npz")
    np.savez(tmp_path / "b.npz", other=np.ones((5, 4), np.float32))
    with pytest.raises(CubeError, match=r"no array of numbers with three axes, as a cube has, only other \(5 x 4\)"):
        read_cube(tmp_path / "b.npz")
    assert read_cube(tmp_path / "a.npz", key="cube", wavelengths=[i * 50 * nm for i in range(8, 13)]).shape == (5, 4, 4)


# ---- CAVE's traps


def test_cave_with_a_colour_picture_is_refused(tmp_path: Path) -> None:
    written = writers.cave(tmp_path, colour=True)
    pixels = cv2.imread(str(written.target), cv2.IMREAD_UNCHANGED)
    pixels[0, 0, 2] += 1
    cv2.imwrite(str(written.target), pixels)
    with pytest.raises(CubeError, match=r"toy_ms_07\.png is a colour picture"):
        read_cube(written.path)


def test_cave_with_8_bits_another_size_or_missing_bands_is_refused(tmp_path: Path) -> None:
    written = writers.cave(tmp_path)
    keep = written.target.read_bytes()
    cv2.imwrite(str(written.target), np.zeros((12, 17), np.uint8))
    with pytest.raises(CubeError, match="has 8 bits, expected 16"):
        read_cube(written.path)
    cv2.imwrite(str(written.target), np.zeros((12, 16), np.uint16))
    with pytest.raises(CubeError, match="different sizes"):
        read_cube(written.path)
    written.target.unlink()
    with pytest.raises(CubeError, match="bands missing: 7"):
        read_cube(written.path)
    written.target.write_bytes(keep)
    last = written.target.with_name("toy_ms_31.png")
    last.rename(tmp_path / "kept.png")  # the last one too: its number says nothing about the others
    with pytest.raises(CubeError, match="bands missing: 31"):
        read_cube(written.path)
    shutil.copy(written.target, written.target.with_name("other_ms_08.png"))
    (tmp_path / "kept.png").rename(last)
    with pytest.raises(CubeError, match="32 PNGs for 31 bands"):
        read_cube(written.path)


def test_folders_of_scenes(tmp_path: Path) -> None:
    writers.cave(tmp_path, name="one_ms")
    writers.cave(tmp_path, name="two_ms", nested=False)
    writers.envi(tmp_path)
    writers.kaist(tmp_path)
    (tmp_path / ".hidden.npz").write_bytes(b"")
    (tmp_path / "loop").symlink_to(tmp_path, target_is_directory=True)
    found = [path.name for path in module.scenes_in(tmp_path)]
    assert found == ["envi_scene.hdr", "one_ms", "scene_kaist.exr", "two_ms"]
    assert [path.name for path in module.scenes_in(tmp_path / "one_ms")] == ["one_ms"]
    with pytest.raises(FileNotFoundError, match="no file or folder"):
        list(module.scenes_in(tmp_path / "nothing"))


def test_scene_names_hold_no_path_and_no_odd_letters() -> None:
    assert module.scene_name(Path("a/b c*d.mat")) == "b_c_d"
    assert module.scene_name(Path("..../.mat")) == "mat"
    assert module.scene_name(Path("***.exr")) == "scene"


# ---- sizes, types and companions


@pytest.mark.parametrize("name", ["harvard", "cassi HSI", "icvl", "arad1k", "npz"])
def test_a_key_that_is_not_there_is_said_with_those_that_are(name: str, tmp_path: Path) -> None:
    written = writers.ALL[name](tmp_path)
    with pytest.raises(CubeError, match=rf"{written.path.name}: it has no array 'nothing', only \w+") as found:
        read_cube(written.path, key="nothing", format=name.split()[0].replace("cassi", "cassi28"))
    own = {"harvard": "ref", "cassi HSI": "HSI", "icvl": "rad", "arad1k": "cube", "npz": "wavelengths"}[name]
    assert own in str(found.value)


def test_harvard_needs_its_calibration_and_its_mask_to_fit(tmp_path: Path) -> None:
    written = writers.harvard(tmp_path)
    (tmp_path / "calib.txt").write_text("1\n" * 30)
    with pytest.raises(CubeError, match="30 factors for 31 bands"):
        read_cube(written.path)
    (tmp_path / "calib.txt").write_text("1\n" * 30 + "0\n")
    with pytest.raises(CubeError, match="not above 0"):
        read_cube(written.path)
    (tmp_path / "calib.txt").unlink()
    with pytest.raises(CubeError, match=r"no calib\.txt beside it"):
        read_cube(written.path)
    savemat(written.path, {"ref": np.ones((4, 5, 31)), "lbl": np.ones((4, 4))})
    (tmp_path / "calib.txt").write_text("1\n" * 31)
    with pytest.raises(CubeError, match=r"mask 'lbl' is \(4, 4\)"):
        read_cube(written.path)


@pytest.mark.parametrize("extra", [-1, 1])
def test_envi_whose_values_are_not_as_long_as_its_header_says(extra: int, tmp_path: Path) -> None:
    written = writers.envi(tmp_path)
    content = written.target.read_bytes()
    written.target.write_bytes(content[:extra] if extra < 0 else content + b"\0")
    with pytest.raises(CubeError, match="its header says 12648: 31 x 12 x 17"):
        read_cube(written.path)


def test_envi_named_by_its_values_and_without_them(tmp_path: Path) -> None:
    written = writers.envi(tmp_path, suffix=".raw")
    cube = read_cube(written.target, format="envi")
    np.testing.assert_allclose(cube.values.numpy(), written.values, atol=written.quantum)
    written.target.unlink()
    with pytest.raises(CubeError, match=r"no values beside envi_scene\.hdr"):
        read_cube(written.path)


def test_icvl_of_another_layout(tmp_path: Path) -> None:
    path = tmp_path / "a.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        file["rad"] = np.ones((4, 5))
        file["bands"] = np.ones(4)
    writers._user_block(path)
    with pytest.raises(CubeError, match="no array of numbers with three axes"):
        read_cube(path)


def test_a_file_of_no_known_format(tmp_path: Path) -> None:
    (tmp_path / "a.xyz").write_bytes(b"hello")
    with pytest.raises(CubeError, match="not recognised"):
        read_cube(tmp_path / "a.xyz")
    with pytest.raises(ValueError, match="unknown format 'x'; known: kcam, kaist"):
        read_cube(tmp_path / "a.xyz", format="x")
    with pytest.raises(FileNotFoundError, match="no file or folder"):
        read_cube(tmp_path / "b.xyz")
    with pytest.raises(ValueError, match="unknown profile 'x'; known: cassi28"):
        module.profile("x")


@pytest.mark.parametrize("reader", ["OpenEXR", "h5py"])
def test_a_missing_extra_is_named(reader: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    written = {"OpenEXR": writers.kaist, "h5py": writers.icvl}[reader](tmp_path)
    monkeypatch.setitem(sys.modules, reader, None)
    with pytest.raises(ImportError, match=r"pip install 'kcam\[(exr|data)\]'"):
        read_cube(written.path)


def test_every_row_is_in_the_table() -> None:
    names = [f"kcam.data.readers.{found.name}" for found in pkgutil.iter_modules(module.__path__)]
    members = [member for name in names for member in vars(importlib.import_module(name)).values()]
    rows = {member.name for member in members if isinstance(member, module.Format)}
    assert rows == module.FORMATS.keys() - {"kcam"}


def test_the_table_documents_itself() -> None:
    for name, row in module.FORMATS.items():
        assert row.name == name
        assert row.what


# ---- what no file of numbers should hold


@pytest.mark.parametrize("what", [np.nan, np.inf, -np.inf])
def test_values_that_are_not_finite_are_masked(what: float, tmp_path: Path) -> None:
    values = writers.cube(31).astype(np.float32)
    values[5, 2, 3] = what
    path = writers.kaist(tmp_path, values).path
    cube = read_cube(path)
    assert (~cube.mask).sum() == 31  # one pixel, in all its bands
    assert not cube.mask[:, 2, 3].any()
    assert (cube.values[:, 2, 3] == 0).all()
    writers.kaist(tmp_path, np.full((31, 4, 5), what))
    with pytest.raises(CubeError, match="no valid pixel"):
        read_cube(path)


def test_doubles_beyond_float32_are_masked(tmp_path: Path) -> None:
    values = writers.cube(31)
    values[0, 1, 1] = 1e300
    np.savez(tmp_path / "a.npz", cube=values, wavelengths=np.asarray(writers.GRID_400))
    assert (~read_cube(tmp_path / "a.npz").mask).sum() == 31


def fill(path: Path, make: Callable[[h5py.File], None]) -> Path:
    """An HDF5 file that calls itself ICVL."""
    with h5py.File(path, "w", userblock_size=512) as file:
        file["bands"] = np.asarray([writers.GRID_400], dtype=np.float64).T
        make(file)
    writers._user_block(path)
    return path


def test_hdf5_never_leaves_its_own_file(tmp_path: Path) -> None:
    secret = tmp_path / "secret.bin"
    secret.write_bytes(bytes(range(256)) * 200)
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["rad"] = np.ones((31, 4, 5))
    layout = h5py.VirtualLayout((31, 4, 5), "f8")
    layout[:] = h5py.VirtualSource(tmp_path / "other.h5", "rad", (31, 4, 5))
    shape = (31, 4, 5)

    def external(file: h5py.File) -> None:
        file.create_dataset("rad", shape, "u1", external=[(str(secret), 0, 620)])

    def link(file: h5py.File) -> None:
        file["rad"] = h5py.ExternalLink(str(tmp_path / "other.h5"), "rad")

    def soft(file: h5py.File) -> None:
        file["kept"] = np.ones(shape)
        file["rad"] = h5py.SoftLink("/kept")

    for make, text in (
        (external, "lies in other files"),
        (lambda file: file.create_virtual_dataset("rad", layout), "lies in other files"),
        (link, "link to elsewhere"),
        (soft, "link to elsewhere"),
        (lambda file: file.create_dataset("rad", shape, "f4", chunks=True), "not in the file: 0 bytes"),
        (lambda file: file.create_dataset("rad", shape, h5py.string_dtype()), "no array of numbers"),
        (lambda file: file.create_group("rad"), "no array of numbers"),
        (
            lambda file: file.create_dataset("rad", (31, 10**5, 10**5), "f4", chunks=(1, 10, 10)),
            "no cube has that size",
        ),
    ):
        with pytest.raises(CubeError, match=text):
            read_cube(fill(tmp_path / "a.mat", make))


# ---- photographs


def test_a_photograph_becomes_reflectances_with_its_colours(tmp_path: Path) -> None:
    import torch

    from kcam import Scene, spectral
    from kcam.isp import tone_curve

    pixels = np.random.default_rng(0).integers(0, 256, (9, 14, 3), np.uint8)
    path = tmp_path / "photo.png"
    cv2.imwrite(str(path), pixels[..., ::-1])
    with pytest.raises(CubeError, match="not recognised"):
        read_cube(path)
    depth = np.full((9, 14), 3.0, np.float32)
    cube = read_cube(path, format="rgb", depth=depth)
    assert cube.shape == (28, 9, 14)
    assert cube.unit == "reflectance"
    assert cube.values.min() >= 0
    assert cube.values.max() <= 1 + 1e-6
    assert (cube.depth == 3).all()
    light = spectral.illuminant("D65", wavelengths=cube.wavelengths).float()[:, None, None]
    scene = Scene.from_bands(cube.values * light, wavelengths=cube.wavelengths, depth=cube.depth)
    xyz = spectral.spectrum_to_xyz(scene.bands()[0].double(), wavelengths=cube.wavelengths)
    colours = tone_curve(spectral.xyz_to_linear_srgb(xyz).clamp(0, 1)[None])[0]
    # the way back through rgb_basis is exact with 28 bands; half of an 8-bit step is the bound that a person can see
    torch.testing.assert_close(
        colours.permute(1, 2, 0).float(), torch.from_numpy(pixels / 255).float(), atol=0.5 / 255, rtol=0
    )
    with pytest.raises(CubeError, match=r"depth map is \(3, 3\)"):
        read_cube(path, format="rgb", depth=np.ones((3, 3)))


def test_a_grey_photograph_is_flat_over_wavelength(tmp_path: Path) -> None:
    path = tmp_path / "grey.png"
    cv2.imwrite(str(path), np.full((4, 5), 128, np.uint8))
    cube = read_cube(path, format="rgb", bands=[450 * nm, 550 * nm, 650 * nm])
    expected = ((128 / 255 + 0.055) / 1.055) ** 2.4  # sRGB's own curve
    np.testing.assert_allclose(cube.values.numpy(), expected, rtol=1e-5)


def test_a_cut_exr_ends_in_one_error_and_no_chatter(tmp_path, capfd):
    """OpenEXR writes a line for each block that it misses, to the process's own standard error."""
    OpenEXR = pytest.importorskip("OpenEXR")
    planes = {f"w{nm_}nm": np.random.default_rng(0).random((90, 60)).astype(np.float32) for nm_ in range(420, 721, 10)}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, dict(planes)) as file:
        file.write(str(tmp_path / "whole.exr"))
    cut = tmp_path / "cut.exr"
    cut.write_bytes((tmp_path / "whole.exr").read_bytes()[:3000])
    assert read_cube(tmp_path / "whole.exr").shape == (31, 90, 60)
    with pytest.raises(CubeError):
        read_cube(cut)
    assert capfd.readouterr().err == ""
