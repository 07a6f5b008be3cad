"""Sequential Zemax text (.zmx): surfaces as blocks of four-letter words, each with its numbers."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from decimal import Decimal
from typing import NoReturn, cast

from kcam.optics.compound import layout
from kcam.optics.compound.layout import Aperture, Found, SurfaceArguments
from kcam.optics.compound.prescription import Prescription
from kcam.optics.compound.surface import Surface
from kcam.optics.elements.materials import GLASSES, Glass
from kcam.optics.numerics import Scalar
from kcam.units import wavelength_grid

_UNITS = {"MM": Decimal("1e-3"), "CM": Decimal("1e-2"), "IN": Decimal("0.0254"), "METER": Decimal(1)}
_POWERS = {"STANDARD": {}, "EVENASPH": {k: 2 * k for k in range(1, 9)}, "ODDASPHE": {k: k for k in range(1, 9)}}
"""Power of r that each parameter of a type of surface is the coefficient of."""
_READ = {"TYPE", "CURV", "DISZ", "GLAS", "CONI", "PARM", "STOP", "DIAM", "CLAP"}
_WITHOUT_EFFECT = {"COMM", "FIMP", "HIDE", "MIRR", "SLAB", "MEMA", "POPS", "COAT", "MAZH", "PZUP", "PPAR", "VDSZ"}
_WITHOUT_EFFECT |= {"FLAP", "SCOL", "SOPA"}
"""Of a surface: how it is drawn, named, coated and solved for; FLAP is the aperture that DIAM says."""
_NAMES = {name: {"fused silica": "SILICA", "polycarbonate": "POLYCARB"}.get(name, name.upper()) for name in GLASSES}
_GLASSES = {theirs: ours for ours, theirs in _NAMES.items()} | {"F_SILICA": "fused silica", "BK7": "N-BK7"}
"""Zemax's name -> ours; BK7 has the coefficients of N-BK7, which no other glass shares with the one without the N."""


@dataclass(frozen=True)
class _Line:
    number: int
    word: str
    values: list[str]


@dataclass
class _Block:
    """The lines of one surface, or of what is said of the whole lens."""

    line: _Line
    words: dict[str, _Line] = field(default_factory=dict)
    many: list[_Line] = field(default_factory=list)


def text(held: bytes) -> str:
    """What bytes of a .zmx file say, in UTF-16 with or without a byte order mark, UTF-8 or Latin-1.

    Raises: ValueError for bytes that are no text.
    """
    wide = held[:2] in (b"\xff\xfe", b"\xfe\xff")
    encoding = "utf-16" if wide else "utf-16-le" if held[1:2] == b"\0" else "utf-16-be" if held[:1] == b"\0" else None
    try:
        found = held.decode(encoding or "utf-8-sig")
    except UnicodeDecodeError:
        if encoding is not None:
            raise ValueError("it is no text in UTF-16") from None
        found = held.decode("latin-1")
    if "\0" in found:
        raise ValueError("it holds bytes that are no text")
    return found


def read(held: bytes, *, name: str) -> Prescription:
    """The lens in the bytes of a .zmx file. Raises: ValueError that names file, line and word for what kcam has not."""
    try:
        found = text(held)
    except ValueError as error:
        raise ValueError(f"{name} is no Zemax file, or damaged: {error}.") from None
    return _Reader(name).layout(found)


class _Reader:
    def __init__(self, name: str) -> None:
        self.name = name
        self.unit = Decimal(0)

    def wrong(self, line: _Line | None, reason: str) -> NoReturn:
        raise self.error("" if line is None else f"line {line.number}, {line.word}", reason)

    def error(self, place: str, reason: str) -> ValueError:
        return layout.refusal(self.name, place, reason)

    def layout(self, found: str) -> Prescription:
        whole, blocks = self.blocks(found)
        self.whole(whole)
        if len(blocks) < 3:
            self.wrong(None, f"it has {len(blocks)} surfaces, expected an object, a lens and an image: is it whole?")
        self.object(blocks[0])
        items = [self.surface(block) for block in blocks[1:-1]]
        last, image = items[-1], blocks[-1]
        self.image(image)
        if last.arguments["glass"] is not None:
            self.wrong(blocks[-2].words["GLAS"], "glass stands in front of the image, but the sensor stands in air")
        stops = [index for index, block in enumerate(blocks[1:-1]) if "STOP" in block.words]
        if len(stops) != 1:
            self.wrong(
                blocks[stops[1] + 1].words["STOP"] if stops else None, f"{len(stops)} surfaces say STOP, expected one"
            )
        return layout.build(
            items,
            stop=stops[0],
            aperture=self.aperture(whole),
            focus_wavelength=self.wavelength(whole),
            error=self.error,
        )

    # ---- words -----------------------------------------------------------------------------------------------------

    def blocks(self, found: str) -> tuple[_Block, list[_Block]]:
        """What is said of the lens, and of each of its surfaces."""
        whole, blocks, inside = _Block(_Line(0, "", [])), list[_Block](), False
        for index, raw in enumerate(re.split(r"\r\n|\r|\n", found), start=1):
            parts = raw.split()
            if not parts:
                continue
            line = _Line(index, parts[0], parts[1:])
            if line.word == "SURF":
                number = self.count(line)
                if number != len(blocks):
                    self.wrong(line, f"this is surface {number}, expected {len(blocks)}: lines are missing or double")
                blocks.append(_Block(line))
                inside = True
            elif inside and (line.word in _READ | _WITHOUT_EFFECT or raw[0].isspace()):
                self.add(blocks[-1], line)
            elif line.word in _READ or raw[0].isspace():
                self.wrong(line, f"{line.word!r} stands in no surface")
            else:
                inside = False
                whole.words.setdefault(line.word, line)
                whole.many.append(line)
        return whole, blocks

    def add(self, block: _Block, line: _Line) -> None:
        if line.word == "PARM":
            block.many.append(line)
        elif line.word in _WITHOUT_EFFECT:
            return
        elif line.word not in _READ:
            reason = " (a decentre or tilt)" if line.word in ("SCBD", "OBDC") else ""
            self.wrong(line, f"{line.word!r}{reason} is no word of a surface that kcam knows")
        elif line.word in block.words:
            self.wrong(line, f"{line.word} occurs twice in surface {block.line.values[0]}")
        else:
            block.words[line.word] = line

    def need(self, block: _Block, word: str) -> _Line:
        if word not in block.words:
            self.wrong(block.line, f"the surface has no {word}: the file is damaged")
        return block.words[word]

    def value(self, line: _Line, place: int = 0) -> Decimal:
        if len(line.values) <= place:
            self.wrong(line, f"number {place + 1} is missing")
        try:
            return layout.number(line.values[place])
        except ValueError as error:
            self.wrong(line, str(error))

    def metres(self, line: _Line, value: Decimal, power: int = 1) -> float:
        """A value in the file's unit to this power, in metres."""
        try:
            return layout.finite(value * self.unit**power)
        except ValueError as error:
            self.wrong(line, str(error))

    def count(self, line: _Line) -> int:
        value = self.value(line)
        if value != value.to_integral_value() or not 0 <= value < 10_000:
            self.wrong(line, f"{line.values[0]} is no whole number of 0 to 9999")
        return int(value)

    # ---- of the whole lens -----------------------------------------------------------------------------------------

    def whole(self, block: _Block) -> None:
        for word, expected in (("MODE", {"SEQ"}), ("UNIT", set(_UNITS))):
            line = block.words.get(word)
            if line is None:
                self.wrong(None, f"it has no {word}: it is no Zemax lens, or damaged")
            if not line.values or line.values[0] not in expected:
                self.wrong(line, f"{' '.join(line.values[:1])!r}, expected {' or '.join(sorted(expected))}")
        self.unit = _UNITS[block.words["UNIT"].values[0]]
        if "MNUM" in block.words and self.count(block.words["MNUM"]) > 1:
            self.wrong(block.words["MNUM"], "it has several configurations. Save one of them as a lens")

    def wavelength(self, block: _Block) -> float:
        """The primary one [m]."""
        found: dict[int, tuple[_Line, Decimal]] = {}
        for line in block.many:
            if line.word == "WAVM":
                found[self.count(line)] = (line, self.value(line, 1))
            elif line.word == "WAVL":
                found = {place + 1: (line, self.value(line, place)) for place in range(len(line.values))}
        if not found:
            return layout.DEFAULT_WAVELENGTH
        primary = block.words.get("PWAV")
        which = 1 if primary is None else self.count(primary)
        if which not in found:
            self.wrong(primary, f"wavelength {which} is the primary one, but there is none of that number")
        line, micrometres = found[which]
        try:
            return float(wavelength_grid([layout.finite(micrometres.scaleb(-6))]))
        except ValueError as error:
            self.wrong(line, str(error))

    def aperture(self, block: _Block) -> Aperture | None:
        line = next((block.words[word] for word in ("FLOA", "ENPD", "FNUM", "OBNA") if word in block.words), None)
        if line is None or line.word == "FLOA":
            return None
        value = self.value(line)
        if line.word == "OBNA" or (line.word == "FNUM" and len(line.values) > 1 and self.value(line, 1) != 0):
            self.wrong(line, "an aperture for an object nearby. Use the diameter of the entrance pupil, ENPD")
        if value <= 0:
            self.wrong(line, f"the aperture is {value}, expected more than 0")
        if line.word == "ENPD":
            return Aperture("entrance pupil", self.metres(line, value))
        return Aperture("f-number", self.metres(line, value, 0))

    # ---- surfaces --------------------------------------------------------------------------------------------------

    def object(self, block: _Block) -> None:
        self.plane(block, "object")
        line = self.need(block, "DISZ")
        if line.values[:1] != ["INFINITY"] and self.value(line) <= 0:
            self.wrong(line, "the object stands behind the lens")

    def image(self, block: _Block) -> None:
        self.plane(block, "image")
        if self.value(self.need(block, "DISZ")) != 0:
            self.wrong(
                block.words["DISZ"], "the last surface is no image, for something follows it: is the file whole?"
            )

    def plane(self, block: _Block, what: str) -> None:
        if self.kind(block) != "STANDARD" or self.value(self.need(block, "CURV")) != 0:
            self.wrong(block.line, f"the {what} is not plane")
        for word in ("GLAS", "STOP"):
            if word in block.words:
                self.wrong(block.words[word], f"the {what} has {word}, which only a surface of the lens can have")

    def kind(self, block: _Block) -> str:
        line = self.need(block, "TYPE")
        kind = line.values[0] if line.values else ""
        if kind not in _POWERS:
            reason = " (a coordinate break)" if kind == "COORDBRK" else ""
            self.wrong(line, f"surfaces of type {kind!r}{reason} are not read; known: {', '.join(sorted(_POWERS))}")
        return kind

    def surface(self, block: _Block) -> Found:
        kind = self.kind(block)
        curvature, distance = self.need(block, "CURV"), self.need(block, "DISZ")
        radius = layout.inverse(self.value(curvature))
        arguments: SurfaceArguments = {
            "radius": math.inf if radius.is_infinite() else self.metres(curvature, radius),
            "thickness": self.metres(distance, self.value(distance)),
            "glass": self.glass(block.words.get("GLAS")),
            "semi_diameter": self.semi_diameter(block),
        }
        if "CONI" in block.words:
            arguments["conic"] = self.metres(block.words["CONI"], self.value(block.words["CONI"]), 0)
        aspheric = layout.asphere_arguments(self.coefficients(block, _POWERS[kind]))
        found = cast("SurfaceArguments", arguments | aspheric)
        return Found(found, f"line {block.line.number}, SURF {block.line.values[0]}")

    def coefficients(self, block: _Block, powers: dict[int, int]) -> dict[int, float]:
        found: dict[int, float] = {}
        for line in block.many:
            which, value = self.count(line), self.value(line, 1)
            if which in powers:
                if powers[which] in found:
                    self.wrong(line, f"PARM {which} occurs twice in surface {block.line.values[0]}")
                found[powers[which]] = self.metres(line, value, 1 - powers[which])
            elif value != 0:
                self.wrong(line, f"a surface of type {self.kind(block)} has no parameter {which}")
        return {power: value for power, value in found.items() if value}

    def semi_diameter(self, block: _Block) -> float | None:
        found = []
        for word, place in (("DIAM", 0), ("CLAP", 1)):
            line = block.words.get(word)
            if line is None:
                continue
            value = self.value(line, place)
            if word == "CLAP" and self.value(line) != 0:
                self.wrong(line, "an aperture with an obstructed middle")
            if value < 0:
                self.wrong(line, f"a semi-diameter of {value}")
            if value:
                found.append(self.metres(line, value))
        return min(found, default=None)

    def glass(self, line: _Line | None) -> str | float | Glass | None:
        if line is None:
            return None
        name = line.values[0].upper() if line.values else ""
        if name == "MIRROR":
            self.wrong(line, "a mirror: kcam's lenses refract")
        if line.values[1:2] == ["1"] or name == "___BLANK":  # a model glass, whatever its name
            index, abbe = (self.metres(line, self.value(line, place), 0) for place in (3, 4))
            try:
                return index if abbe == 0 else Glass(index, abbe)  # without an Abbe number Zemax has no dispersion
            except ValueError as error:
                self.wrong(line, str(error))
        if name not in _GLASSES:
            known = ", ".join(sorted(_GLASSES))
            self.wrong(
                line, f"unknown glass {line.values[0] if line.values else ''!r}; known: {known}; or ___BLANK 1 0 nd vd"
            )
        return _GLASSES[name]


# ---- writing -------------------------------------------------------------------------------------------------------


def written(lens: Prescription) -> bytes:
    """A lens as a .zmx file. Raises: ValueError for what the format has no place for."""
    lines = [
        "MODE SEQ",
        "UNIT MM X W X CM MR CPMM",
        "FLOA",
        "FTYP 0 0 1 1 0 0 0",
        "XFLN 0",
        "YFLN 0",
        f"WAVM 1 {layout.decimal(lens.focus_wavelength).scaleb(6)} 1",
        "PWAV 1",
        *_plane(0, "INFINITY"),
    ]
    for index, surface in enumerate(lens.surfaces, start=1):
        thickness = lens.sensor_distance if index == len(lens.surfaces) else surface.thickness
        lines += [f"SURF {index}", *(f"  {line}" for line in _surface(surface, thickness, index))]
    lines += [*_plane(len(lens.surfaces) + 1, "0"), "MNUM 1 1"]
    return ("\n".join(lines) + "\n").encode()


def _plane(index: int, distance: str) -> list[str]:
    return [f"SURF {index}", "  TYPE STANDARD", "  CURV 0 0 0 0 0", f"  DISZ {distance}", "  DIAM 0 0 0 0 1"]


def _surface(surface: Surface, thickness: Scalar, index: int) -> list[str]:
    terms = layout.terms(surface)
    kind = next((kind for kind, powers in _POWERS.items() if set(terms) <= set(powers.values())), None)
    if kind is None:
        raise ValueError(
            f"surface {index} has asphere terms of r^{', r^'.join(map(str, terms))}; a .zmx file holds even ones up to "
            "r^16, or all up to r^8. Save it as .json."
        )
    semi = Decimal(0) if surface.semi_diameter is None else layout.decimal(surface.semi_diameter).scaleb(3)
    lines = ["STOP"] if surface.stop else []
    curvature = layout.inverse(layout.decimal(surface.radius).scaleb(3))
    lines += [f"TYPE {kind}", f"CURV {curvature} 0 0 0 0"]
    for parameter, power in _POWERS[kind].items():
        lines.append(f"PARM {parameter} {terms.get(power, Decimal(0)).scaleb(3 * (1 - power))}")
    lines.append(f"DISZ {layout.decimal(thickness).scaleb(3)}")
    if surface.glass is not None:
        lines.append(f"GLAS {_glass(surface.glass)} 0 0 0 0 0 0")
    lines.append(f"CONI {layout.decimal(surface.conic)}")
    lines.append(f"DIAM {semi} {int(bool(semi))} 0 0 1")
    return [*lines, f"FLAP 0 {semi} 0"] if semi else lines


def _glass(glass: str | float | Glass) -> str:
    if isinstance(glass, str):
        return f"{_NAMES[glass]} 0 0 0 0"
    index, abbe = (glass.nd, glass.vd) if isinstance(glass, Glass) else (glass, 0.0)
    return f"___BLANK 1 0 {layout.decimal(index)} {layout.decimal(abbe)}"
