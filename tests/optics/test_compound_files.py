"""Lenses in .zmx and .json files: what is read is what was written, in every encoding, and damage is a clear error."""

from __future__ import annotations

import json
import math
import random
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from draws import Draw
from torch import Tensor, nn

from kcam import Camera, optics
from kcam.optics.elements.materials import GLASSES
from kcam.units import mm, nm, um

DOUBLE = torch.float64
SINGLES = ("radius", "thickness", "conic", "asphere2", "semi_diameter")
SERIES = ("asphere", "odd_asphere")


def numbers(lens: optics.CompoundLens) -> list[tuple]:
    """All that describes a lens, in float64; the last thickness is not used, and zeros end no series."""
    found: list[tuple] = [(float(lens.sensor_distance), lens.focus_wavelength)]
    for surface in lens.surfaces:
        single = [getattr(surface, name) for name in SINGLES if surface is not lens.surfaces[-1] or name != "thickness"]
        series = [torch.as_tensor(getattr(surface, name), dtype=DOUBLE).detach().tolist() for name in SERIES]
        for values in series:
            while values and values[-1] == 0:
                values.pop()
        glass = surface.glass
        parts = (glass.nd, glass.vd) if isinstance(glass, optics.Glass) else (glass,)
        found.append(
            (
                surface.stop,
                *(None if v is None else float(torch.as_tensor(v).detach()) for v in single),
                *map(tuple, series),
                *parts,
            )
        )
    return found


def assert_close(lens: optics.CompoundLens, other: optics.CompoundLens, *, rel: float) -> None:
    for row, expected in zip(numbers(lens), numbers(other), strict=True):
        for value, wanted in zip(row, expected, strict=True):
            exact = wanted is None or isinstance(wanted, str)
            assert value == (wanted if exact else pytest.approx(wanted, rel=rel, abs=1e-300))


def random_lens(seed: int, *, odd: bool) -> optics.CompoundLens:
    """Surfaces of every kind, none of which need make sense as a lens; odd: with terms that only .json holds."""
    draw = Draw(seed)
    count = draw.one_of(2, 3, 5)
    surfaces = []
    for index in range(count):
        last = index == count - 1
        radius = draw.one_of(math.inf, draw.number(20, 200) * mm, -draw.number(20, 200) * mm)
        glass = draw.one_of(
            None, draw.one_of(*GLASSES), draw.number(1.4, 1.9), optics.Glass(draw.number(1.4, 1.9), 41.3)
        )
        shape = draw.one_of({}, {"conic": draw.number(-2, 1)}, {"asphere": [draw.number(-9, 9) for _ in range(3)]})
        if draw.one_of(True, False):
            shape = shape | draw.one_of(
                {"asphere2": draw.number(-1, 1)},
                {"odd_asphere": [draw.number(-1e-3, 1e-3) for _ in range(7 if odd else 2)], "asphere": [1.5]},
            )
        surfaces.append(
            optics.Surface(
                radius=radius,
                thickness=draw.number(0.5, 9) * mm,
                glass=None if last else glass,
                semi_diameter=draw.number(1, 9) * mm if index == 0 or draw.one_of(True, False) else None,
                stop=index == 0,
                **shape,
            )
        )
    return optics.CompoundLens(
        *surfaces, sensor_distance=draw.number(5, 90) * mm, focus_wavelength=draw.number(450, 650) * nm
    )


# ---- there and back ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(12))
def test_zemax_text_gives_every_number_back_to_the_last_bit(seed: int, tmp_path: Path) -> None:
    lens = random_lens(seed, odd=False)
    lens.save(tmp_path / "x.zmx")
    assert numbers(optics.CompoundLens.from_file(tmp_path / "x.zmx")) == numbers(lens)
    assert [path.name for path in tmp_path.iterdir()] == ["x.zmx"]


@pytest.mark.parametrize("seed", range(12))
def test_json_gives_every_number_back_to_its_rounding(seed: int, tmp_path: Path) -> None:
    lens = random_lens(seed, odd=True)
    lens.save(tmp_path / "x.json")
    assert_close(optics.CompoundLens.from_file(tmp_path / "x.json"), lens, rel=1e-14)


@pytest.mark.parametrize(
    ("name", "suffix"), [("cooke_triplet", "zmx"), ("cooke_triplet", "json"), ("phone", "zmx"), ("phone_odd", "json")]
)
def test_a_lens_from_its_file_has_the_same_psfs(name: str, suffix: str, tmp_path: Path) -> None:
    lens = optics.CompoundLens.preset(name, focus_distance=2.0)
    lens.save(tmp_path / f"x.{suffix}")
    again = optics.CompoundLens.from_file(tmp_path / f"x.{suffix}")
    where = {
        "distances": 2.0,
        "pixel_pitch": 2 * um,
        "shape": (9, 9),
        "field": torch.tensor([[0.0, 0.2]]),
        "dtype": DOUBLE,
    }
    expected, found = (each.psf([500 * nm], **where) for each in (lens, again))
    assert torch.equal(expected, found) or (suffix == "json" and float((expected - found).abs().sum()) < 1e-9)


def test_parameters_are_written_by_their_values(tmp_path: Path) -> None:
    lens = optics.CompoundLens(
        optics.Surface(
            radius=nn.Parameter(torch.tensor(20 * mm)), thickness=3 * mm, glass="N-BK7", semi_diameter=3 * mm
        ),
        optics.Surface(
            radius=-30 * mm,
            semi_diameter=2 * mm,
            asphere=nn.Parameter(torch.tensor([7.0, 2e5], dtype=DOUBLE)),
            stop=True,
        ),
        sensor_distance=torch.tensor(24 * mm),
    )
    for suffix in ("zmx", "json"):
        lens.save(tmp_path / f"x.{suffix}")
        again = optics.CompoundLens.from_file(tmp_path / f"x.{suffix}")
        assert_close(again, lens, rel=1e-15)


def test_the_sensor_stands_where_the_file_has_the_image_or_in_focus(tmp_path: Path) -> None:
    path = tmp_path / "x.zmx"
    optics.CompoundLens.preset("cooke_triplet", focus_distance=1.0).save(path)
    own, far = optics.CompoundLens.from_file(path), optics.CompoundLens.from_file(path, focus_distance=math.inf)
    assert float(own.sensor_distance) == float(
        optics.CompoundLens.preset("cooke_triplet", focus_distance=1.0).sensor_distance
    )
    assert float(far.sensor_distance) == float(optics.CompoundLens.preset("cooke_triplet").sensor_distance)


class Held(nn.Module):
    """A stage of one's own that holds a lens."""

    def __init__(self, lens: optics.CompoundLens) -> None:
        super().__init__()
        self.lens = lens

    def forward(self, signal: Tensor) -> Tensor:
        return signal


@pytest.mark.parametrize("name", ["ef50", "phone_odd"])
def test_a_lens_survives_in_the_file_of_a_camera(name: str, tmp_path: Path) -> None:
    lens = optics.CompoundLens.preset(name, focus_distance=3.0)
    surface = lens.surfaces[1]
    conic = surface.conic
    del surface.conic
    surface.conic = nn.Parameter(torch.tensor(conic, dtype=DOUBLE))
    Camera(Held(lens)).save(tmp_path / "x.safetensors")
    again = Camera.load(tmp_path / "x.safetensors", custom=[Held])[0].lens
    assert isinstance(again.surfaces[1].conic, nn.Parameter)
    assert numbers(again) == numbers(lens)


# ---- what others write ---------------------------------------------------------------------------------------------

TEXT = """VERS 160608 48 100027
MODE SEQ
NAME ZOOM
NOTE 0 SURF GLAS CURV
PFIL 0 0 0
UNIT MM X W X CM MR CPMM
ENPD 4.0E+0
ENVD 2.00E+01 1 0
GCAT SCHOTT MISC
FTYP 0 0 1 3 0 0 0
WAVM 1 4.8613270E-01 1
WAVM 2 5.8756180E-01 1
WAVM 3 6.5627250E-01 1
PWAV 2
SURF 0
  TYPE STANDARD
  FIMP

  CURV 0.0 0 0 0 0 ""
  DISZ INFINITY
  DIAM 0 0 0 0 1 ""
SURF 1
  COMM the front
  TYPE STANDARD
  CURV 5.0000000000000000E-002 0 0 0 0 ""
  HIDE 0 0 0 0 0 0 0 0 0 0
  MIRR 2 0
  SLAB 1
  DISZ 2.5
  GLAS n-bk7 0 0 1.50E+00 4.00E+01 0 0 0 0 0 0
  COAT AR
  DIAM 4.5 1 0 0 1 ""
  MEMA 4.5 0 0 0 1 ""
  POPS 0 0 0 0 0 0 0 0 1 1 1 1 0 0 0 0
  FLAP 0 4.5 0
SURF 2
  TYPE EVENASPH
  CURV -1.0D-2
  PARM 1 0
  PARM 2 1.5E-5
  PARM 3 -2.0E-8
  PARM 4 0
  DISZ 1
  GLAS ___BLANK 1 0 1.62004 36.37 0 0 0 0 0 0
  CONI -0.5
  DIAM 4.2 0 0 0 1 ""
SURF 3
  STOP
  TYPE STANDARD
  CURV 0.0
  DISZ 20
  DIAM 0 0 0 0 1 ""
SURF 4
  TYPE STANDARD
  CURV 0
  DISZ 1
  GLAS BK7 0 0
  CLAP 0 6 0
SURF 5
  TYPE STANDARD
  CURV 0
  DISZ 9.75
SURF 6
  TYPE STANDARD
  CURV 0.0 0 0 0 0 ""
  DISZ 0
  DIAM 7.2 0 0 0 1 ""
BLNK
EFLY 0 2 0 0 0 0 50 1 0 0
TOL TOFF   0   0              0              0   0 0 0 0
MNUM 1 1
"""


def read(text: str | bytes, folder: Path, **focus: float) -> optics.CompoundLens:
    path = folder / "lens.zmx"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return optics.CompoundLens.from_file(path, **focus)


def test_zemax_text_is_read_word_by_word(tmp_path: Path) -> None:
    lens = read(TEXT, tmp_path)
    front, back, stop, window, last = lens.surfaces
    assert lens.focus_wavelength == 587.5618e-9
    assert float(lens.sensor_distance) == 0.00975
    assert (front.radius, front.thickness, front.glass, front.semi_diameter) == (0.02, 0.0025, "N-BK7", 0.0045)
    assert (back.radius, back.conic, back.glass, back.asphere) == (
        -0.1,
        -0.5,
        optics.Glass(1.62004, 36.37),
        (15000.0, -2e7),
    )
    assert (window.glass, window.semi_diameter, last.semi_diameter) == ("N-BK7", 0.006, None)
    assert stop.stop
    assert 2 * float(lens.first_order().entrance_semi_diameter) == pytest.approx(4 * mm, rel=1e-3)  # ENPD, at 587.6 nm


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "latin-1", "utf-16", "utf-16-le", "utf-16-be"])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_zemax_text_in_every_encoding(encoding: str, end: str, tmp_path: Path) -> None:
    text = TEXT.replace("NAME ZOOM", "NAME Objektiv für µm").replace("\n", end)
    assert numbers(read(text.encode(encoding), tmp_path)) == numbers(read(TEXT, tmp_path))


@pytest.mark.parametrize(("unit", "metres"), [("MM", 1e-3), ("CM", 1e-2), ("IN", 0.0254), ("METER", 1.0)])
def test_units_of_length(unit: str, metres: float, tmp_path: Path) -> None:
    scaled = TEXT.replace("UNIT MM", f"UNIT {unit}")
    for word, power in (
        ("DISZ", 1),
        ("DIAM", 1),
        ("CLAP 0", 1),
        ("ENPD", 1),
        ("CURV", -1),
        ("PARM 2", -3),
        ("PARM 3", -5),
    ):
        lines = scaled.split("\n")
        for index, line in enumerate(lines):
            head = (line.strip().removeprefix(word).split() or [""])[0]
            if line.strip().startswith(f"{word} ") and head != "INFINITY":
                value = float(head.replace("D", "E")) * (1e-3 / metres) ** power
                lines[index] = f"  {word} {value!r}" if word != "ENPD" else f"ENPD {value!r}"
        scaled = "\n".join(lines)
    assert_close(read(scaled, tmp_path), read(TEXT, tmp_path), rel=1e-12)


@pytest.mark.parametrize(
    ("was", "becomes", "diameter"),
    [
        ("ENPD 4.0E+0", "FNUM 8 0", None),
        ("ENPD 4.0E+0", "FLOA", "DIAM 1.5 1 0 0 1"),
        ("ENPD 4.0E+0", "ENPD 400", "DIAM 1.5 1 0 0 1"),
    ],
)
def test_the_stop_has_the_smaller_one_of_its_own_size_and_the_aperture(
    was: str, becomes: str, diameter: str | None, tmp_path: Path
) -> None:
    text = TEXT.replace(was, becomes)
    if diameter is not None:
        text = text.replace('DISZ 20\n  DIAM 0 0 0 0 1 ""', f"DISZ 20\n  {diameter}")
        assert read(text, tmp_path).surfaces[2].semi_diameter == 0.0015
    else:
        lens = read(text, tmp_path)
        width = 2 * float(lens.first_order().entrance_semi_diameter)
        assert lens.focal_length() / width == pytest.approx(8, rel=1e-9)


def test_a_model_glass_is_one_whatever_its_name(tmp_path: Path) -> None:
    named = read(TEXT.replace("GLAS ___BLANK 1 0", "GLAS MODEL 1 0"), tmp_path)
    assert numbers(named) == numbers(read(TEXT, tmp_path))
    constant = read(TEXT.replace("1.62004 36.37", "1.62004 0"), tmp_path)
    assert constant.surfaces[1].glass == 1.62004


def test_an_object_nearby_leaves_the_sensor_at_the_last_distance(tmp_path: Path) -> None:
    near = read(TEXT.replace("DISZ INFINITY", "DISZ 300"), tmp_path)
    assert numbers(near) == numbers(read(TEXT, tmp_path))
    focused = read(TEXT, tmp_path, focus_distance=0.3)
    assert float(focused.sensor_distance) != 0.00975


BROKEN = [
    ("MODE SEQ", "MODE NSC", r"lens.zmx, line 2, MODE: 'NSC', expected SEQ"),
    ("MODE SEQ\n", "", r"lens.zmx: it has no MODE"),
    ("UNIT MM", "UNIT FURLONG", r"line 6, UNIT: 'FURLONG', expected CM or IN or METER or MM"),
    ("UNIT MM X W X CM MR CPMM\n", "", r"it has no UNIT: it is no Zemax lens, or damaged"),
    ("MNUM 1 1", "MNUM 3 1", r"MNUM: it has several configurations"),
    ("MNUM 1 1", "MNUM 1.5 1", r"MNUM: 1.5 is no whole number"),
    ("TYPE EVENASPH", "TYPE BICONICX", r"line 37, TYPE: surfaces of type 'BICONICX' are not read; known: EVENASPH"),
    ("TYPE EVENASPH", "TYPE COORDBRK", r"type 'COORDBRK' \(a coordinate break\) are not read"),
    ("TYPE EVENASPH", "TYPE", r"surfaces of type '' are not read"),
    ("n-bk7 0 0", "N-ZK7 0 0", r"line 30, GLAS: unknown glass 'N-ZK7'; known: .*N-BK7.*___BLANK 1 0 nd vd"),
    ("n-bk7 0 0", "MIRROR 0 0", r"line 30, GLAS: a mirror"),
    ("GLAS ___BLANK 1 0 1.62004", "GLAS ___BLANK 1 0 0.62004", r"GLAS: a glass has nd above 1"),
    ("GLAS ___BLANK 1 0 1.62004 36.37 0 0 0 0 0 0", "GLAS ___BLANK 1 0", r"line 44, GLAS: number 4 is missing"),
    ("DISZ 9.75", "DISZ 9.75\n  GLAS F2", r"GLAS: glass stands in front of the image"),
    ("DISZ 2.5", "DISZ nan", r"line 29, DISZ: 'nan' is no number"),
    ("DISZ 2.5", "DISZ 2.5.1", r"DISZ: '2.5.1' is no number"),
    ("DISZ 2.5", "DISZ INFINITY", r"DISZ: 'INFINITY' is no number"),
    ("DISZ 2.5", "DISZ 2500", r"line 22, SURF 1: thickness 2.5 m is outside"),
    ("  DISZ 2.5\n", "", r"line 22, SURF: the surface has no DISZ"),
    ("DISZ 2.5", "DISZ 2.5\n  DISZ 2.5", r"line 30, DISZ: DISZ occurs twice in surface 1"),
    ("CURV -1.0D-2", "CURV -1.0D-6", r"line 36, SURF 2: radius -1000 m is outside"),
    ("CURV -1.0D-2", "CURV -1.0E-400", r"line 38, CURV: .* is too large"),
    ("DIAM 4.5", "DIAM 25", r"SURF 1: semi_diameter 0.025 m is beyond where"),
    ("DIAM 4.5", "DIAM -4.5", r"DIAM: a semi-diameter of -4.5"),
    ("CLAP 0 6 0", "CLAP 2 6 0", r"CLAP: an aperture with an obstructed middle"),
    ("PARM 4 0", "PARM 4 zero", r"line 42, PARM: 'zero' is no number"),
    ("PARM 4 0", "PARM 4 1e300", r"PARM: .* is too large"),
    ("PARM 4 0", "PARM 2 0", r"PARM: PARM 2 occurs twice in surface 2"),
    ("PARM 4 0", "PARM 13 1", r"PARM: a surface of type EVENASPH has no parameter 13"),
    ("  STOP\n", "", r"0 surfaces say STOP, expected one"),
    ("  CLAP 0 6 0", "  STOP", r"line 58, STOP: 2 surfaces say STOP"),
    ("ENPD 4.0E+0\n", "", r"line 46, SURF 3: the stop has no semi-diameter, and the file no aperture"),
    ("ENPD 4.0E+0", "ENPD 0", r"line 7, ENPD: the aperture is 0"),
    ("ENPD 4.0E+0", "OBNA 0.1 0", r"OBNA: an aperture for an object nearby"),
    ("ENPD 4.0E+0", "FNUM 8 1", r"FNUM: an aperture for an object nearby"),
    ("ENPD 4.0E+0", "FNUM 1e-9 0", r"SURF 3: semi_diameter .* m is outside"),
    ("PWAV 2", "PWAV 9", r"line 14, PWAV: wavelength 9 is the primary one, but there is none"),
    ("5.8756180E-01", "587", r"line 12, WAVM: wavelength 0.000587 is outside"),
    ("SURF 3", "SURF 4", r"line 47, SURF: this is surface 4, expected 3"),
    ("SURF 3", "SURX 3", r"line 48, STOP: 'STOP' stands in no surface"),
    (
        "  COAT AR",
        "  OBDC 1 0",
        r"line 31, OBDC: 'OBDC' \(a decentre or tilt\) is no word of a surface that kcam knows",
    ),
    ("  COAT AR", "  OBSC 0 2", r"line 31, OBSC: 'OBSC' is no word of a surface that kcam knows"),
    ("DISZ INFINITY", "DISZ -3", r"line 20, DISZ: the object stands behind the lens"),
    ('CURV 0.0 0 0 0 0 ""\n  DISZ INF', "CURV 0.1\n  DISZ INF", r"line 15, SURF: the object is not plane"),
    ("DISZ INFINITY", "DISZ INFINITY\n  STOP", r"STOP: the object has STOP"),
    ("  DISZ 0\n", "  DISZ 3\n", r"the last surface is no image, for something follows it"),
    ('CURV 0.0 0 0 0 0 ""\n  DISZ 0', "CURV 0.1\n  DISZ 0", r"the image is not plane"),
    ("DISZ 9.75", "DISZ 0", r"lens.zmx has the image 0 m behind the last surface.*focus_distance="),
]


@pytest.mark.parametrize(("was", "becomes", "message"), BROKEN, ids=[becomes or was for was, becomes, _ in BROKEN])
def test_what_kcam_cannot_be_is_named_by_line_and_word(was: str, becomes: str, message: str, tmp_path: Path) -> None:
    assert was in TEXT
    with pytest.raises(ValueError, match=message):
        read(TEXT.replace(was, becomes, 1), tmp_path)


@pytest.mark.parametrize(
    ("held", "message"),
    [
        (b"", "it has no MODE"),
        (b"\xff\xfe\x00", "lens.zmx is no Zemax file, or damaged: it is no text in UTF-16"),
        (b"MODE SEQ\n\x89PNG\0\0\0", "it holds bytes that are no text"),
        (b"MODE SEQ\nUNIT MM\nSURF 0\n TYPE STANDARD\n", "it has 1 surfaces, expected an object, a lens and an image"),
    ],
)
def test_what_is_no_zemax_file(held: bytes, message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message):
        read(held, tmp_path)


def outcome(held: bytes, folder: Path) -> optics.CompoundLens | None:
    """The lens, or None where it was refused by a ValueError; any other exception passes."""
    try:
        return read(held, folder)
    except ValueError:
        return None


def test_a_truncated_file_is_refused_or_still_whole(tmp_path: Path) -> None:
    whole = TEXT.encode()
    expected = numbers(read(whole, tmp_path))
    ends = [len(whole) - cut for cut in range(0, len(whole), 5)]
    found = [outcome(whole[:end], tmp_path) for end in ends]
    assert all(lens is None or numbers(lens) == expected for lens in found)
    assert sum(lens is None for lens in found) > 0.7 * len(found)


def damage(rng: random.Random) -> bytes:
    """The text with bytes or words changed, swapped, lost or doubled."""
    held, words = bytearray(TEXT.encode()), TEXT.split(" ")
    action, place = rng.randrange(5), rng.randrange(len(TEXT))
    if action == 0:
        held[place] = rng.randrange(256)
    elif action == 1:
        del held[place : place + rng.randrange(1, 40)]
    elif action == 2:
        held[place:place] = rng.randbytes(rng.randrange(1, 6))
    else:
        one, other = rng.randrange(len(words)), rng.randrange(len(words))
        words[one], words[other] = words[other], words[one] if action == 3 else words[other]
        return " ".join(words).encode()
    return bytes(held)


def test_damage_is_refused_or_gives_a_lens(tmp_path: Path) -> None:
    found = [outcome(damage(random.Random(seed)), tmp_path) for seed in range(300)]
    assert 60 < sum(lens is None for lens in found) < 290


@pytest.mark.slow
def test_much_damage_is_refused_or_gives_a_lens(tmp_path: Path) -> None:
    for seed in range(300, 6000):
        outcome(damage(random.Random(seed)), tmp_path)


# ---- Optiland's JSON -----------------------------------------------------------------------------------------------


def document(folder: Path) -> dict:
    path = folder / "whole.json"
    optics.CompoundLens.preset("cooke_triplet").save(path)
    return json.loads(path.read_text())


def change(place: str, value: object) -> Callable[[dict], None]:
    """Sets what stands at a place such as 'surface_group.surfaces.1.thickness'."""

    def done(whole: dict) -> None:
        *path, last = place.split(".")
        held = whole
        for key in path:
            held = held[int(key)] if isinstance(held, list) else held.setdefault(key, {})
        held[int(last) if isinstance(held, list) else last] = value

    return done


S = "surface_group.surfaces"
FORMULA = {"dispersion": {"kind": "formula", "formula": "formula 2", "coefficients": [0.0, 1.0, 0.01]}}
JSON = [
    (change("aperture.type", "objectNA"), r"lens.json: an aperture of type 'objectNA' is not read"),
    (change("aperture.value", -1), r"lens.json: the aperture is -1"),
    (change("wavelengths.wavelengths.0.unit", "parsec"), r"a wavelength is in 'parsec'"),
    (change("wavelengths.wavelengths.0.value", 550), r"wavelength 0.00055 is outside"),
    (change(f"{S}.0.type", "Surface"), r"surface 0: the first surface is not the object, in air"),
    (change(f"{S}.0.geometry.cs.z", 3.0), r"surface 0: the object stands behind the lens"),
    (change(f"{S}.2.type", "ParaxialSurface"), r"surface 2: a surface of type 'ParaxialSurface' is not read"),
    (change(f"{S}.2.interaction_model", {"is_reflective": True}), r"surface 2: it is a mirror"),
    (change(f"{S}.2.interaction_model", {"type": "ThinLens"}), r"surface 2: its interaction is 'ThinLens'"),
    (
        change(f"{S}.2.thickness", 1.0),
        r"surface 2: its thickness is 1 mm, but the next surface stands 6.0\d* mm behind",
    ),
    (change(f"{S}.2.geometry.type", "Toroidal"), r"surface 2: a geometry of type 'Toroidal' is not read"),
    (change(f"{S}.2.geometry.cs.rx", 0.1), r"surface 2: it is decentred or tilted \(rx\)"),
    (change(f"{S}.2.geometry.cs.z", None), r"surface 2: 'z' is None, expected float"),
    (change(f"{S}.2.geometry.radius", math.nan), r"surface 2: 'radius' is NaN"),
    (change(f"{S}.2.geometry.radius", 1e9), r"surface 2: radius 1e\+06 m is outside"),
    (change(f"{S}.2.geometry", {"type": "EvenAsphere", "cs": {"z": 3.25896}, "coefficients": 3}), r"expected a list"),
    (change(f"{S}.2.geometry", {"type": "EvenAsphere", "cs": {"z": 3.25896}, "coefficients": [math.inf]}), "finite"),
    (
        change(f"{S}.2.geometry", {"type": "OddAsphere", "cs": {"z": 3.25896}, "coefficients": [0] * 9 + [1e299]}),
        "too large",
    ),
    (change(f"{S}.2.geometry", 7), r"surface 2: 'geometry' is '7', expected names and values"),
    (change(f"{S}.2.aperture", {"type": "RectangularAperture"}), r"surface 2: its aperture is no full circle"),
    (change(f"{S}.1.material_post", {"type": "Mirror"}), r"surface 1: unknown material of type 'Mirror'"),
    (
        change(f"{S}.1.material_post", {"type": "Material", "name": "SK16"}),
        r"surface 1: unknown glass 'SK16'; known: BaF2",
    ),
    (change(f"{S}.1.material_post", {"type": "AbbeMaterial", "index": 0.5, "abbe": 50}), r"a glass has nd above 1"),
    (change(f"{S}.1.material_post", {"type": "IdealMaterial", "index": 1.5, "absorp": 0.1}), r"absorbs light"),
    (change(f"{S}.1.material_post", {"type": "DataMaterial", "definition": FORMULA}), r"none of kcam's glasses"),
    (change(f"{S}.6.material_post", {"type": "IdealMaterial", "index": 1.5}), r"surface 6: glass stands in front of"),
    (change(f"{S}.7.geometry.radius", 100.0), r"surface 7: the image is not plane"),
    (change(f"{S}.7.geometry.type", "EvenAsphere"), r"surface 7: the image is not plane"),
    (change(f"{S}.4.is_stop", False), r"0 surfaces are the stop, expected one"),
    (change(S, []), r"it has 0 surfaces, expected an object, a lens and an image"),
    (change("surface_group", None), r"lens.json is no lens of Optiland's, or damaged: surface_group is None"),
]


@pytest.mark.parametrize(("broken", "message"), JSON, ids=[message for _, message in JSON])
def test_what_kcam_cannot_be_is_named_by_surface(broken: Callable[[dict], None], message: str, tmp_path: Path) -> None:
    whole = document(tmp_path)
    broken(whole)
    (tmp_path / "lens.json").write_text(json.dumps(whole))
    with pytest.raises(ValueError, match=message):
        optics.CompoundLens.from_file(tmp_path / "lens.json")


def test_materials_and_apertures_as_optiland_writes_them(tmp_path: Path) -> None:
    whole = document(tmp_path)
    surfaces = whole["surface_group"]["surfaces"]
    surfaces[1]["material_post"] = {"type": "Material", "name": "n-sf11", "catalog": None}
    surfaces[3]["material_post"] = {"type": "AbbeMaterial", "index": 1.62, "abbe": 36.4, "model": "buchdahl"}
    surfaces[5]["material_post"] = {"type": "IdealMaterial", "index": 1.5, "absorp": 0.0}
    surfaces[4]["aperture"] = None
    whole["aperture"] = {"type": "EPD", "value": 10}
    whole["wavelengths"]["wavelengths"] = [
        {"value": 480, "unit": "nm"},
        {"value": 0.6, "unit": "um", "is_primary": True},
    ]
    (tmp_path / "x.json").write_text(json.dumps(whole))
    lens = optics.CompoundLens.from_file(tmp_path / "x.json")
    assert [surface.glass for surface in lens.surfaces][::2] == ["N-SF11", optics.Glass(1.62, 36.4), 1.5]
    assert 2 * float(lens.first_order().entrance_semi_diameter) == pytest.approx(10 * mm, rel=1e-12)
    assert lens.focus_wavelength == 600e-9
    whole["aperture"] = {"type": "imageFNO", "value": 5.6}
    (tmp_path / "x.json").write_text(json.dumps(whole))
    lens = optics.CompoundLens.from_file(tmp_path / "x.json", focus_distance=math.inf)
    assert lens.f_number == pytest.approx(5.6, rel=1e-9)


# ---- names of files ------------------------------------------------------------------------------------------------


def test_what_cannot_be_written_is_a_clear_error(tmp_path: Path) -> None:
    phone = optics.CompoundLens.preset("phone_odd")
    with pytest.raises(
        ValueError, match=r"surface 2 has asphere terms of r\^3, .*r\^10; a .zmx file holds .*Save it as .json"
    ):
        phone.save(tmp_path / "x.zmx")
    with pytest.raises(
        ValueError, match=r"x.seq is no lens file: its name must end in .zmx \(Zemax\) or .json \(Optiland\)"
    ):
        phone.save(tmp_path / "x.seq")
    with pytest.raises(ValueError, match="x is no lens file"):
        optics.CompoundLens.from_file(tmp_path / "x")
    with pytest.raises(ValueError, match="there is no folder"):
        phone.save(tmp_path / "nowhere" / "x.json")
    with pytest.raises(FileNotFoundError, match=r"there is no file .*x.zmx"):
        optics.CompoundLens.from_file(tmp_path / "x.zmx")
    phone.surfaces[1].conic = math.nan
    with pytest.raises(ValueError, match="conic of a surface is NaN"):
        phone.save(tmp_path / "x.json")
    assert not list(tmp_path.iterdir())
