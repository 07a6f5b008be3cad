"""Optiland's lenses in JSON (.json): what its `save_optiland_file` writes and its `load_optiland_file` reads, in mm."""

from __future__ import annotations

import json
import math
from decimal import Decimal
from typing import Any, NoReturn, TypedDict, cast

from kcam.optics.compound import layout
from kcam.optics.compound.layout import Aperture, Found, SurfaceArguments
from kcam.optics.compound.prescription import Prescription
from kcam.optics.compound.surface import Surface
from kcam.optics.elements.materials import D_F_C, GLASSES, Glass, Sellmeier
from kcam.optics.numerics import Scalar
from kcam.plain import fitting, from_json
from kcam.units import wavelength_grid

_POWERS = {"Plane": (0, 0), "StandardGeometry": (0, 0), "EvenAsphere": (2, 2), "OddAsphere": (1, 1)}
"""Power of r that a geometry's first coefficient belongs to, and how much more the next one's is."""
_SAME = 1e-9  # mm; relative, of a glass's coefficients
_NAMES = {name.upper(): name for name in GLASSES}


class _Group(TypedDict):
    surfaces: list[dict[str, Any]]


class _Waves(TypedDict):
    wavelengths: list[dict[str, Any]]


class _Lens(TypedDict):
    surface_group: _Group
    aperture: dict[str, Any] | None
    wavelengths: _Waves


def read(held: bytes, *, name: str) -> Prescription:
    """The lens in the bytes of a file. Raises: ValueError that names file and surface for what kcam has not."""
    lens: _Lens = from_json(held, _Lens, wrong=f"{name} is no lens of Optiland's, or damaged", hook=None)
    return _Reader(name).layout(lens)


class _Reader:
    def __init__(self, name: str) -> None:
        self.name = name
        self.place = ""

    def wrong(self, reason: str) -> NoReturn:
        raise self.error(self.place, reason)

    def error(self, place: str, reason: str) -> ValueError:
        return layout.refusal(self.name, place, reason)

    def value(self, held: dict[str, Any], key: str, default: float | None = None) -> float:
        try:
            found = float(fitting(held.get(key, default), float, repr(key)))
        except ValueError as error:
            self.wrong(str(error))
        if math.isnan(found):
            self.wrong(f"{key!r} is NaN, expected a number")
        return found

    def finite(self, held: dict[str, Any], key: str, default: float | None = None) -> float:
        found = self.value(held, key, default)
        if math.isinf(found):
            self.wrong(f"{key!r} is {found}, expected a finite number")
        return found

    def word(self, held: dict[str, Any], key: str, default: str | None = None) -> str:
        found = held.get(key, default)
        if not isinstance(found, str):
            self.wrong(f"{key!r} is {str(found)[:40]!r}, expected a word")
        return found[:40]

    def part(self, held: dict[str, Any], key: str) -> dict[str, Any]:
        found = held.get(key)
        if not isinstance(found, dict):
            self.wrong(f"{key!r} is {str(found)[:40]!r}, expected names and values")
        return found

    def layout(self, lens: _Lens) -> Prescription:
        found = lens["surface_group"]["surfaces"]
        if len(found) < 3:
            self.wrong(f"it has {len(found)} surfaces, expected an object, a lens and an image")
        wavelength = self.wavelength(lens["wavelengths"]["wavelengths"])
        aperture = None if lens["aperture"] is None else self.aperture(lens["aperture"])
        heights = [self.height(surface, index) for index, surface in enumerate(found)]
        self.object(found[0], heights)
        items, stops = [], []
        for index, surface in enumerate(found[1:-1], start=1):
            self.place = f"surface {index}"
            items.append(self.surface(surface, heights[index], heights[index + 1]))
            if surface.get("is_stop") is True:
                stops.append(index - 1)
        self.place = ""
        if len(stops) != 1:
            self.wrong(f"{len(stops)} surfaces are the stop, expected one")
        if items[-1].arguments["glass"] is not None:
            self.place = f"surface {len(items)}"
            self.wrong("glass stands in front of the image, but the sensor stands in air")
        self.place = f"surface {len(found) - 1}"
        if self.part(found[-1], "geometry").get("type") not in ["Plane", "StandardGeometry"]:
            self.wrong("the image is not plane")
        if math.isfinite(self.value(self.part(found[-1], "geometry"), "radius", math.inf)):
            self.wrong("the image is not plane")
        return layout.build(items, stop=stops[0], aperture=aperture, focus_wavelength=wavelength, error=self.error)

    # ---- of the whole lens -----------------------------------------------------------------------------------------

    def wavelength(self, found: list[dict[str, Any]]) -> float:
        primary = [wave for wave in found if wave.get("is_primary") is True] or found[:1]
        if not primary:
            return layout.DEFAULT_WAVELENGTH
        unit = self.word(primary[0], "unit", "um")
        scale = {"nm": -9, "um": -6, "mm": -3, "cm": -2, "m": 0}.get(unit)
        if scale is None:
            self.wrong(f"a wavelength is in {unit!r}, expected nm, um, mm, cm or m")
        try:
            return float(wavelength_grid([_scaled(self.finite(primary[0], "value"), scale)]))
        except ValueError as error:
            self.wrong(str(error))

    def aperture(self, held: dict[str, Any]) -> Aperture:
        kind = self.word(held, "type")
        if kind not in ("EPD", "imageFNO", "float_by_stop_size"):
            self.wrong(f"an aperture of type {kind!r} is not read; known: EPD, imageFNO, float_by_stop_size")
        value = self.finite(held, "value")
        if value <= 0:
            self.wrong(f"the aperture is {value:g}, expected more than 0")
        if kind == "imageFNO":
            return Aperture("f-number", value)
        return Aperture("entrance pupil" if kind == "EPD" else "stop", _scaled(value, -3))

    # ---- surfaces --------------------------------------------------------------------------------------------------

    def height(self, surface: dict[str, Any], index: int) -> float:
        """Where a surface stands on the axis [mm]."""
        self.place = f"surface {index}"
        frame = self.part(self.part(surface, "geometry"), "cs")
        moved = [key for key in ("x", "y", "rx", "ry", "rz") if self.value(frame, key, 0.0) != 0]
        if moved or frame.get("reference_cs") is not None:
            self.wrong(
                f"it is decentred or tilted ({', '.join(moved) or 'reference_cs'}): kcam's lenses share one axis"
            )
        return self.value(frame, "z")

    def object(self, surface: dict[str, Any], heights: list[float]) -> None:
        self.place = "surface 0"
        if surface.get("type") != "ObjectSurface" or self.glass(self.part(surface, "material_post")) is not None:
            self.wrong("the first surface is not the object, in air")
        if not heights[0] < heights[1]:
            self.wrong("the object stands behind the lens")

    def surface(self, held: dict[str, Any], here: float, behind: float) -> Found:
        if self.word(held, "type") != "Surface":
            self.wrong(f"a surface of type {self.word(held, 'type')!r} is not read; known: Surface")
        model = held.get("interaction_model") or {}
        if held.get("is_reflective") or not isinstance(model, dict) or model.get("is_reflective"):
            self.wrong("it is a mirror: kcam's lenses refract")
        interaction = self.word(model, "type", "RefractiveReflectiveModel")
        if interaction != "RefractiveReflectiveModel":
            self.wrong(f"its interaction is {interaction!r}, expected RefractiveReflectiveModel")
        thickness, spacing = self.finite(held, "thickness", behind - here), behind - here
        if not abs(thickness - spacing) <= _SAME * max(1.0, abs(here), abs(behind)):
            self.wrong(f"its thickness is {thickness:g} mm, but the next surface stands {spacing:g} mm behind it")
        geometry = self.part(held, "geometry")
        arguments: SurfaceArguments = {
            "radius": _scaled(self.value(geometry, "radius", math.inf), -3),
            "thickness": _scaled(thickness, -3),
            "glass": self.glass(self.part(held, "material_post")),
            "semi_diameter": self.semi_diameter(held.get("aperture")),
            "conic": self.finite(geometry, "conic", 0.0),
        }
        aspheric = layout.asphere_arguments(self.coefficients(geometry))
        return Found(cast("SurfaceArguments", arguments | aspheric), self.place)

    def coefficients(self, geometry: dict[str, Any]) -> dict[int, float]:
        kind = self.word(geometry, "type")
        if kind not in _POWERS:
            self.wrong(f"a geometry of type {kind!r} is not read; known: {', '.join(_POWERS)}")
        first, step = _POWERS[kind]
        held = geometry.get("coefficients", []) if first else []
        if not isinstance(held, list):
            self.wrong(f"'coefficients' is {str(held)[:40]!r}, expected a list")
        found = {}
        for index, item in enumerate(held):
            power = first + step * index
            value = self.finite({"coefficient": item}, "coefficient")
            if value:
                found[power] = _scaled(value, -3 * (1 - power))
        if any(math.isinf(value) for value in found.values()):
            self.wrong("a coefficient is too large")
        return found

    def semi_diameter(self, held: Any) -> float | None:
        if held is None:
            return None
        if not isinstance(held, dict) or held.get("type") != "RadialAperture" or self.value(held, "r_min", 0.0) != 0:
            self.wrong("its aperture is no full circle (RadialAperture without r_min)")
        reach = self.value(held, "r_max")
        return None if math.isinf(reach) else _scaled(reach, -3)

    def glass(self, held: dict[str, Any]) -> str | float | Glass | None:
        kind = self.word(held, "type")
        if kind == "IdealMaterial":
            index = self.finite(held, "index")
            if self.value(held, "absorp", 0.0) != 0:
                self.wrong("its material absorbs light: kcam's glasses are clear")
            return None if index == 1 else index
        try:
            if kind == "AbbeMaterial":
                return Glass(self.finite(held, "index"), self.finite(held, "abbe"))
            if kind == "DataMaterial":
                return _of_formula(self.part(self.part(held, "definition"), "dispersion"))
        except ValueError as error:
            self.wrong(str(error))
        name = self.word(held, "name") if kind == "Material" else ""
        if name.upper() in _NAMES:
            return _NAMES[name.upper()]
        what = f"glass {name!r}" if name else f"material of type {kind!r}"
        self.wrong(f"unknown {what}; known: {', '.join(sorted(GLASSES))}, or an index and an Abbe number")


def _scaled(value: float, power: int) -> float:
    """value * 10^power, as the decimals that are meant."""
    return float(Decimal(repr(value)).scaleb(power)) if math.isfinite(value) else value


# ---- dispersion ----------------------------------------------------------------------------------------------------


def _lines(nd: float, vd: float) -> tuple[float, float]:
    """A and B of n = A + B / lambda^2, lambda in um, as of `Glass`."""
    d, f, c = D_F_C
    b = (nd - 1) / vd / (1 / f**2 - 1 / c**2)
    return nd - b / d**2, b


def _of_formula(dispersion: dict[str, Any]) -> str | float | Glass:
    """The glass of coefficients as of refractiveindex.info. Raises: ValueError for one that is none of ours."""
    kind, held = dispersion.get("formula"), dispersion.get("coefficients")
    values: list[float] = fitting(held, list[float], "'coefficients'")
    if kind == "formula 5" and len(values) == 3 and values[2] == -2:  # n = A + B / lambda^2
        d, f, c = D_F_C
        nd, spread = values[0] + values[1] / d**2, values[1] * (1 / f**2 - 1 / c**2)
        return Glass(nd, (nd - 1) / spread) if spread else nd
    for name, glass in GLASSES.items():
        ours = _sellmeier(glass)
        if kind == "formula 2" and len(values) == len(ours) and max(map(_apart, values, ours)) < _SAME:
            return name
    raise ValueError(f"a material of {str(kind)[:40]!r} with coefficients {str(values)[:60]} is none of kcam's glasses")


def _apart(one: float, other: float) -> float:
    return abs(one - other) / max(abs(other), 1e-9)


def _sellmeier(glass: Sellmeier) -> list[float]:
    return [0.0, *(value for pair in zip(glass.b, glass.c, strict=True) for value in pair)]


# ---- writing -------------------------------------------------------------------------------------------------------


def written(lens: Prescription) -> bytes:
    """A lens as JSON that Optiland loads, with the same refractive indices."""
    spaces = [surface.thickness for surface in lens.surfaces[:-1]] + [lens.sensor_distance]
    millimetres = [layout.decimal(space).scaleb(3) for space in spaces]
    air = {"type": "IdealMaterial", "index": 1.0, "absorp": 0.0}
    far = {"type": "ObjectSurface", "geometry": _plane(-math.inf), "material_post": air}
    held: list[dict[str, Any]] = [far]
    for index, (surface, space) in enumerate(zip(lens.surfaces, millimetres, strict=True)):
        held.append(
            {
                "type": "Surface",
                "thickness": float(space),
                "geometry": _geometry(surface, float(sum(millimetres[:index]))),
                "material_post": _material(surface.glass),
                "is_stop": surface.stop,
                "aperture": None
                if surface.semi_diameter is None
                else {"type": "RadialAperture", "r_max": _mm(surface.semi_diameter), "r_min": 0.0},
            }
        )
    image = {"type": "Surface", "thickness": 0.0, "geometry": _plane(float(sum(millimetres))), "material_post": air}
    held.append(image | {"is_stop": False, "aperture": None})
    microns = float(layout.decimal(lens.focus_wavelength).scaleb(6))
    wave = {"value": microns, "is_primary": True, "unit": "um", "weight": 1.0}
    document: dict[str, Any] = {
        "version": 1.0,
        "name": None,
        "aperture": {"type": "float_by_stop_size", "value": 2 * _mm(lens.stop_semi_diameter)},
        "fields": {
            "fields": [{"x": 0.0, "y": 0.0, "vx": 0.0, "vy": 0.0, "weight": 1.0}],
            "telecentric": False,
            "field_definition": {"field_type": "AngleField"},
        },
        "wavelengths": {"wavelengths": [wave], "polarization": "ignore"},
        "apodization": None,
        "pickups": [],
        "solves": {"solves": []},
        "surface_group": {"surfaces": held},
    }
    return (json.dumps(document, indent=1) + "\n").encode()


def _mm(value: Scalar) -> float:
    return float(layout.decimal(value).scaleb(3))


def _plane(z: float) -> dict[str, Any]:
    return {"type": "Plane", "cs": _frame(z), "radius": math.inf}


def _frame(z: float) -> dict[str, Any]:
    return {"x": 0.0, "y": 0.0, "z": z, "rx": 0.0, "ry": 0.0, "rz": 0.0, "reference_cs": None}


def _geometry(surface: Surface, z: float) -> dict[str, Any]:
    terms = layout.terms(surface)
    radius = _mm(surface.radius)
    if not terms and math.isinf(radius) and layout.decimal(surface.conic) == 0:
        return _plane(z)
    if not terms:
        return {"type": "StandardGeometry", "cs": _frame(z), "radius": radius} | _conic(surface)
    kind = "OddAsphere" if any(power % 2 for power in terms) else "EvenAsphere"
    first, step = _POWERS[kind]
    powers = range(first, max(terms) + 1, step)
    values = [float(terms[power].scaleb(3 * (1 - power))) if power in terms else 0.0 for power in powers]
    shape = {"type": kind, "cs": _frame(z), "radius": radius, "tol": 1e-10, "max_iter": 100, "coefficients": values}
    return shape | _conic(surface)


def _conic(surface: Surface) -> dict[str, float]:
    return {"conic": float(layout.decimal(surface.conic))}


def _material(glass: str | float | Glass | None) -> dict[str, Any]:
    if isinstance(glass, (str, Glass)):
        if isinstance(glass, Glass):
            formula, coefficients = "formula 5", [*_lines(glass.nd, glass.vd), -2.0]
        else:
            formula, coefficients = "formula 2", _sellmeier(GLASSES[glass])
        dispersion = {"kind": "formula", "formula": formula, "coefficients": coefficients}
        return {
            "type": "DataMaterial",
            "name": glass if isinstance(glass, str) else f"{glass.nd:g}/{glass.vd:g}",
            "definition": {"dispersion": dispersion},
            "bounds": "raise",
        }
    return {"type": "IdealMaterial", "index": 1.0 if glass is None else float(layout.decimal(glass)), "absorp": 0.0}
