"""Pictures over the whole field of a real lens: time and memory by their size, beside the ways in which others do it.

    python -m benchmarks.field                                all parts, both cameras: half an hour or more
    python -m benchmarks.field --only methods --sizes 0.2,1   a part of it; other rows stay as they were measured
    python -m benchmarks.field --quick                        toy sizes

A picture is that of `Camera.preset("slr")` and of `Camera.preset("phone_lens")` behind their colour filter: a scene of
three planes with a spectrum each. Every size covers the whole sensor: smaller pictures have larger pixels.

Parts:
  pictures   the first picture of a camera (traced, fitted, PSFs made) and the second; memory
  methods    the same picture with one PSF everywhere, with 7 x 7 patches of one PSF each, and with five eigen-PSFs of
             5 x 5 places, made of the same PSFs, after the same distortion and relative illumination; PSNR of each
  growth     time against the number of places whose PSFs are made, for one size
  gradient   a picture with the gradient to all curvatures

PSNR is in linear light, to the brightest of the truth. The truth is a picture with PSFs `FINE` pixels apart, at crops
of the picture; at the smallest size it is itself compared with one PSF for each pixel.
"""

from __future__ import annotations

import argparse
import functools
import itertools
import json
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor, nn

from benchmarks.common import ROOT, environment, write_json
from kcam import Camera, Scene, measure, optics
from kcam.optics.rendering.borders import extend
from kcam.optics.rendering.renderer import Renderer
from kcam.optics.rendering.resampling import resampling
from kcam.optics.source import FieldPSFs

RESULTS = ROOT / "benchmarks" / "results" / "field.json"
CAMERAS = {"slr": (2912, 4368), "phone_lens": (3000, 4000)}
"""Preset -> rows and columns of its sensor, at the preset's pixel pitch."""
PARTS = ("pictures", "methods", "growth", "gradient")
PATCHES, PLACES, EIGEN = 7, 5, 5
FINE = 16  # pixels between PSFs of the truth
CROPS = ((0.5, 0.5), (0.3, 0.68), (0.12, 0.45), (0.0, 0.0))  # shares of height and width: the last is a corner
DENSEST = 40  # pixels across, that each get a PSF: what reaches the crop


@dataclass(frozen=True)
class Sizes:
    """How large the work is. megapixels: of the parts. spacings: of `growth` [pixels]. crop: side of what is compared
    with the truth [pixels]; dense: of what is compared with one PSF for each pixel, 0 for none. cropped: the middle of
    the sensor, of its own pixels, instead of the whole of it.
    """

    megapixels: tuple[float, ...] = (0.2, 1, 3, 12)
    gradient: tuple[float, ...] = (1, 12)
    grown: float = 1
    spacings: tuple[int, ...] = (512, 256, 128, 64, 32)
    crop: int = 96
    dense: int = 8
    cropped: bool = False


QUICK = Sizes((0.005,), (0.005,), 0.005, (64, 32), 24, 0, cropped=True)


@dataclass(frozen=True)
class Setup:
    """One picture: what takes it, and of what."""

    camera: str
    scene_name: str
    pitch: float
    imaging: optics.Imaging
    colour_filter: Any
    scene: Scene

    @classmethod
    def of(cls, camera: str, megapixels: float, sizes: Sizes, *, scene_name: str = "photograph") -> Setup:
        """The whole sensor on about so many pixels, on its own where that is what it has; or the middle of it."""
        preset, sensor = Camera.preset(camera), CAMERAS[camera]
        shrunk = max(1.0, math.sqrt(math.prod(sensor) / (megapixels * 1e6)))
        shrunk = 1.0 if shrunk < 1.05 else shrunk
        height, width = (2 * round(n / shrunk / 2) for n in sensor)
        pitch = preset[0].pixel_pitch * (1 if sizes.cropped else sensor[1] / width)
        scene = SCENES[scene_name]((height, width)).with_depth(preset[0].lens.focus_distance)
        return cls(camera, scene_name, pitch, preset[0].changed(pixel_pitch=pitch), preset[1], scene)

    @property
    def shape(self) -> tuple[int, int]:
        return self.scene.shape[1:]

    def picture(self, imaging: optics.Imaging | None = None) -> Tensor:
        """(1, 3, H, W), what the colour filter lets through."""
        with torch.no_grad():
            return (imaging or self.imaging)(self.scene, colour_filter=self.colour_filter)

    def anew(self, **changes: Any) -> optics.Imaging:
        """A stage that has kept nothing."""
        return optics.Imaging(**(self.imaging.configuration() | changes))

    @property
    def vergences(self) -> Tensor:
        return torch.tensor([1 / float(self.imaging.lens.focus_distance)], dtype=torch.float64)

    @functools.cached_property
    def window(self) -> tuple[int, int]:
        return self.imaging.psf_window(self.scene.wavelengths, vergences=self.vergences, picture=self.shape)

    def described(self) -> dict[str, Any]:
        """What all rows of it say."""
        height, width = self.shape
        return {
            "camera": self.camera,
            "scene": self.scene_name,
            "megapixels": height * width / 1e6,
            "size": [height, width],
            "pixel_pitch": self.pitch,
        }


def photograph(shape: tuple[int, int]) -> Scene:
    """The motorcycle at its own resolution, and its mirror images beside it, so that there is detail everywhere."""
    picture = Scene.builtin("motorcycle").to_srgb()
    for dim, n in zip((-2, -1), shape, strict=True):
        own = picture.shape[dim]
        at = torch.arange(n) % (2 * own)
        picture = picture.index_select(dim, torch.where(at < own, at, 2 * own - 1 - at))
    return Scene.from_rgb(picture, depth=1.0)


def stars(shape: tuple[int, int]) -> Scene:
    """Points of one pixel on a dim sky, one in 200 of all pixels, of random colours."""
    generator = torch.Generator().manual_seed(0)
    light = torch.rand(1, 3, *shape, generator=generator)
    lit = torch.rand(1, 1, *shape, generator=generator) < 1 / 200
    return Scene.from_rgb(torch.where(lit, light, 0.02), depth=1.0)


SCENES: dict[str, Callable[[tuple[int, int]], Scene]] = {"photograph": photograph, "stars": stars}


# ---- as others do it -------------------------------------------------------------------------------------------------


@dataclass
class Baseline:
    """A picture of PSFs that a lens has at some places. All of it from the lens's own PSFs over the field, and after
    its distortion and relative illumination, so that nothing differs but how the blur varies.
    """

    setup: Setup
    psfs: FieldPSFs | None = None
    known: list[Tensor] = field(default_factory=list)

    def first(self) -> Tensor:
        """With all that is made once."""
        own = self.setup
        corner = own.pitch * math.hypot(*own.shape) / 2
        with torch.no_grad():
            self.psfs = own.imaging.lens.over_field(corner, own.vergences, own.scene.wavelengths)
            self.known = self.kernels()
            return self.second()

    def second(self) -> Tensor:
        """With the PSFs known."""
        with torch.no_grad():
            return self.convolved(self.moved())

    def moved(self) -> Tensor:
        """Planes of the scene where distortion brings them, times the relative illumination."""
        own, psfs = self.setup, self.over_field
        planes = own.scene.coefficients
        height, width = own.shape
        moves = resampling(lambda at: -psfs.undistorted(-at * own.pitch) / own.pitch, (height, width), "reflect")
        planes = planes if moves is None else moves(planes)
        y, x = (torch.arange(n, dtype=torch.float64) - (n - 1) / 2 for n in (height, width))
        rows = [psfs.illumination(own.pitch * torch.stack(torch.broadcast_tensors(x, at), -1)) for at in y[:, None]]
        return planes * torch.stack(rows).to(planes)

    @property
    def over_field(self) -> FieldPSFs:
        assert self.psfs is not None
        return self.psfs

    def bank(self, places: Tensor) -> Tensor:
        """PSFs (N, L, h, w) of places (N, 2) of the upright picture [pixels from its middle], without illumination."""
        own = self.setup
        on_sensor = -places.to(torch.float64) * own.pitch
        pixels = own.imaging.pixels(own.window, own.scene.coefficients)
        light = self.over_field.illumination(on_sensor)
        psfs = self.over_field.bank(on_sensor, pixels, whole=True)[:, 0]
        return psfs / light.to(psfs)[:, None, None, None]

    @property
    def mixing(self) -> Tensor:
        """What each channel takes of each plane at each wavelength, (3, K, L)."""
        scene = self.setup.scene
        weights = self.setup.colour_filter.contraction(scene.wavelengths).detach()
        return weights[:, None] * scene.spectra.to(weights)

    def kernels(self) -> list[Tensor]:
        """What is made once."""
        raise NotImplementedError

    def convolved(self, planes: Tensor) -> Tensor:
        """The picture of what was moved."""
        raise NotImplementedError

    def blurred(self, planes: Tensor, psfs: Tensor) -> Tensor:
        """(1, 3, H, W) of planes by PSFs (L, h, w), by kcam's own Fourier transforms."""
        scene = self.setup.scene
        renderer = Renderer(
            psfs[None],
            spectra=scene.spectra.to(planes),
            weights=self.setup.colour_filter.contraction(scene.wavelengths).detach().to(planes),
            picture=self.setup.shape,
        )
        return renderer.blur(planes, layer=0)


class OnePSF(Baseline):
    """That of the axis, everywhere."""

    def kernels(self) -> list[Tensor]:
        return [self.bank(torch.zeros(1, 2))[0]]

    def convolved(self, planes: Tensor) -> Tensor:
        return self.blurred(planes, self.known[0])


class Patches(Baseline):
    """7 x 7 patches, each convolved directly with the PSF of its middle, with what lies around it: as DeepLens."""

    def kernels(self) -> list[Tensor]:
        middles = [[(bounds[0] + bounds[1] - n) / 2 for bounds in _cut(n, PATCHES)] for n in self.setup.shape]
        places = torch.cartesian_prod(*(torch.tensor(own) for own in middles)).flip(1)
        psfs = self.bank(places)
        return [torch.einsum("ckl,lhw->ckhw", self.mixing.to(own), own) for own in psfs]

    def convolved(self, planes: Tensor) -> Tensor:
        height, width = self.setup.window
        around = extend(planes, (height, width), "reflect")
        kernels = iter(self.known)
        rows = [
            torch.cat(
                [
                    torch.nn.functional.conv2d(
                        around[..., top : bottom + height - 1, left : right + width - 1].contiguous(), next(kernels)
                    )
                    for left, right in _cut(self.setup.shape[1], PATCHES)
                ],
                dim=-1,
            )
            for top, bottom in _cut(self.setup.shape[0], PATCHES)
        ]
        return torch.cat(rows, dim=-2)


class EigenPSFs(Baseline):
    """Five eigen-PSFs of those at 5 x 5 places, their coefficients by bicubic interpolation: as Optiland and others."""

    def kernels(self) -> list[Tensor]:
        axes = [torch.linspace(-(n - 1) / 2, (n - 1) / 2, PLACES) for n in self.setup.shape]
        psfs = self.bank(torch.cartesian_prod(*axes).flip(1))
        u, values, v = torch.linalg.svd(psfs.flatten(1), full_matrices=False)
        coefficients = (u * values)[:, :EIGEN].T.reshape(EIGEN, PLACES, PLACES)
        return [coefficients, v[:EIGEN].view(EIGEN, *psfs.shape[1:])]

    def convolved(self, planes: Tensor) -> Tensor:
        picture = planes.new_zeros(())
        for coefficients, psfs in zip(*self.known, strict=True):
            share = torch.nn.functional.interpolate(
                coefficients[None, None], self.setup.shape, mode="bicubic", align_corners=True
            )
            picture = picture + self.blurred(planes * share, psfs)
        return picture


def _cut(n: int, parts: int) -> list[tuple[int, int]]:
    """Where parts of n pixels begin and end."""
    edges = [round(k * n / parts) for k in range(parts + 1)]
    return list(itertools.pairwise(edges))


BASELINES: dict[str, type[Baseline]] = {
    "one PSF": OnePSF,
    f"{PATCHES} x {PATCHES} patches, direct": Patches,
    f"{EIGEN} eigen-PSFs of {PLACES} x {PLACES}": EigenPSFs,
}

# ---- the truth -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Crop:
    """What is compared: a square at a place of the picture, and what the truth has there."""

    top: int
    left: int
    light: Tensor

    def of(self, picture: Tensor) -> Tensor:
        height, width = self.light.shape[-2:]
        return picture[..., self.top : self.top + height, self.left : self.left + width]


def truth(setup: Setup, *, side: int, at: tuple[float, float], spacing: int = FINE) -> Crop:
    """By PSFs `spacing` pixels apart, of as much of the scene as reaches the square."""
    whole = setup.shape
    first = [min(n - side, max(0, round(share * n - side / 2))) for share, n in zip(at, whole, strict=True)]
    window = setup.window
    margin = margin_of(setup)
    low = [max(0, start - margin) for start in first]
    high = [min(n, start + side + margin) for start, n in zip(first, whole, strict=True)]
    # as light falls: the picture is upright, and what is right of the middle falls to its left
    centre = tuple(-(low[k] + high[k] - whole[k]) / 2 * setup.pitch for k in (1, 0))
    imaging = setup.anew(centre=centre, psf_shape=window, renormalise=True, spacing=spacing)
    part = setup.scene.crop(top=low[0], left=low[1], height=high[0] - low[0], width=high[1] - low[1])
    light = replace(setup, imaging=imaging, scene=part).picture()
    top, left = (start - edge for start, edge in zip(first, low, strict=True))
    return Crop(first[0], first[1], light[..., top : top + side, left : left + side].clone())


def margin_of(setup: Setup) -> int:
    """Pixels from which light reaches a crop: by its PSF, and by what distortion moves it at most."""
    reach = setup.pitch * math.hypot(*setup.shape) / 2
    with torch.no_grad():
        psfs = setup.imaging.lens.over_field(reach, setup.vergences, setup.scene.wavelengths[:1])
        at = torch.stack([torch.zeros(33), torch.linspace(0, reach, 33)], -1).double()
        moved = math.ceil(float((psfs.undistorted(at) - at).abs().max()) / setup.pitch)
    return max(setup.window) // 2 + moved + 4


def fidelity(picture: Tensor, crops: list[Crop], *, beside: list[Crop] | None = None) -> dict[str, float]:
    """PSNR over all crops, and in the worst [dB], by the brightest of them, or of those beside which they stand."""
    brightest = max(float(crop.light.max()) for crop in [*crops, *(beside or [])])
    squares = [float((crop.of(picture) - crop.light).double().square().mean()) for crop in crops]

    def decibels(square: float) -> float:
        return 10 * math.log10(brightest**2 / max(square, 1e-300))

    return {"psnr": decibels(sum(squares) / len(squares)), "psnr_worst": decibels(max(squares))}


# ---- the parts -------------------------------------------------------------------------------------------------------

Rows = Iterator[dict[str, Any]]


def twice(first: Callable[[], Tensor], second: Callable[[], Tensor]) -> tuple[Tensor, dict[str, Any]]:
    """The picture, and what the first and the second one take."""
    _, seconds, memory = measure.watched(first)
    picture, again, later = measure.watched(second)
    return picture, {"first": seconds, "second": again, "peak_memory": memory, "second_memory": later}


def taken(setup: Setup, **changes: Any) -> tuple[Tensor, dict[str, Any]]:
    """By kcam, with a new stage."""
    imaging = setup.anew(**changes)
    picture, times = twice(lambda: setup.picture(imaging), lambda: setup.picture(imaging))
    return picture, times | {"window": list(setup.window)}


def estimated(setup: Setup, **changes: Any) -> dict[str, Any]:
    """How many PSFs kcam makes, and what it expects to be off by."""
    estimate = setup.imaging.changed(**changes).explain(setup.scene, colour_filter=setup.colour_filter)
    return {"places": list(estimate.places), "apart": estimate.apart, "estimate": estimate.total}


def pictures(camera: str, sizes: Sizes, chosen: tuple[float, ...]) -> Rows:
    for megapixels in chosen:
        setup = Setup.of(camera, megapixels, sizes)
        _, times = taken(setup)
        yield setup.described() | {"who": "kcam"} | times | estimated(setup)


def methods(camera: str, sizes: Sizes, chosen: tuple[float, ...]) -> Rows:
    smallest = min(sizes.megapixels)
    for megapixels in chosen:
        for scene_name in SCENES if megapixels <= 1 else ("photograph",):
            setup = Setup.of(camera, megapixels, sizes, scene_name=scene_name)
            crops = [truth(setup, side=sizes.crop, at=at) for at in CROPS]
            said = setup.described()
            if megapixels == smallest and sizes.dense and sizes.dense + 2 * margin_of(setup) <= DENSEST:
                dense = truth(setup, side=sizes.dense, at=CROPS[1], spacing=1)
                own = truth(setup, side=sizes.dense, at=CROPS[1])
                picture = setup.picture(setup.anew())
                near = {"psnr": fidelity(own.light, [replace(dense, top=0, left=0)], beside=crops)["psnr"]}
                yield said | {"who": f"truth, PSFs {FINE} pixels apart, against one for each pixel"} | near
                yield said | {"who": "kcam, against one PSF for each pixel"} | fidelity(picture, [dense], beside=crops)
            picture, times = taken(setup)
            yield said | {"who": "kcam"} | times | fidelity(picture, crops) | estimated(setup)
            for who, kind in BASELINES.items():
                baseline = kind(setup)
                picture, times = twice(baseline.first, baseline.second)
                yield said | {"who": who} | times | fidelity(picture, crops)
            picture, times = taken(setup, field=False)
            yield said | {"who": "one PSF, nothing moved or darkened"} | times | fidelity(picture, crops)


def growth(camera: str, sizes: Sizes, chosen: tuple[float, ...]) -> Rows:
    setup = Setup.of(camera, sizes.grown, sizes)
    for spacing in sizes.spacings:
        _, times = taken(setup, spacing=spacing)
        yield setup.described() | {"who": "kcam", "spacing": spacing} | times | estimated(setup, spacing=spacing)


def gradient(camera: str, sizes: Sizes, chosen: tuple[float, ...]) -> Rows:
    """All curvatures that are none of a plane; the loss is the picture's mean square."""
    for megapixels in sizes.gradient:
        if megapixels not in chosen:
            continue
        setup = Setup.of(camera, megapixels, sizes)
        row = setup.described() | {"who": "kcam, gradient to all curvatures"}
        for surface in setup.imaging.lens.surfaces:
            if math.isfinite(float(surface.radius)):
                surface.radius = nn.Parameter(torch.tensor(float(surface.radius), dtype=torch.float64))
        imaging = setup.anew()

        def call(imaging: optics.Imaging = imaging, setup: Setup = setup) -> Tensor:
            loss = imaging(setup.scene, colour_filter=setup.colour_filter).square().mean()
            loss.backward()
            return loss.detach()

        _, seconds, memory = measure.watched(call)
        gradients = [p.grad for p in imaging.lens.parameters() if p.grad is not None]
        finite = all(bool(own.isfinite().all()) for own in gradients)
        yield row | {"first": seconds, "peak_memory": memory, "curvatures": len(gradients), "finite": finite}


MEASURED: dict[str, Callable[[str, Sizes, tuple[float, ...]], Rows]] = {
    "pictures": pictures,
    "methods": methods,
    "growth": growth,
    "gradient": gradient,
}

# ---- what is written ---------------------------------------------------------------------------------------------


def key(row: dict[str, Any]) -> tuple[Any, ...]:
    """What a row is about: one that is measured again takes its place."""
    return tuple(str(row.get(name)) for name in ("part", "camera", "scene", "size", "who", "spacing"))


def merged(rows: list[dict[str, Any]], new: dict[str, Any]) -> list[dict[str, Any]]:
    """Rows with a new one, in the order of parts, cameras and sizes."""
    kept = [*(row for row in rows if key(row) != key(new)), new]
    order = list(PARTS), list(CAMERAS)
    return sorted(
        kept,
        key=lambda row: (order[0].index(row["part"]), order[1].index(row["camera"]), math.prod(row["size"])),
    )


def print_rows(console: Console, rows: list[dict[str, Any]]) -> None:
    for part in dict.fromkeys(row["part"] for row in rows):
        table = Table(title=part, box=None, title_justify="left")
        for name in ("camera", "megapixels", "", "places", "first s", "second s", "MB", "dB", "worst"):
            table.add_column(name, justify="left" if name in ("camera", "") else "right")
        for row in (row for row in rows if row["part"] == part):
            numbers = [f"{row[name]:.3g}" if row.get(name) is not None else "" for name in ("first", "second")]
            memory = row.get("peak_memory")
            table.add_row(
                row["camera"],
                f"{row['megapixels']:.2g}",
                row["who"] + (", stars" if row["scene"] == "stars" else ""),
                " x ".join(map(str, row.get("places", []))),
                *numbers,
                "" if memory is None else f"{memory / 1e6:.0f}",
                *(f"{row[name]:.1f}" if name in row else "" for name in ("psnr", "psnr_worst")),
            )
        console.print(table, "")


def main(arguments: list[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.field", description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="toy sizes; written only where --out says")
    parser.add_argument("--only", default=",".join(PARTS), help=f"some of {', '.join(PARTS)}")
    parser.add_argument("--cameras", default=",".join(CAMERAS), help=f"some of {', '.join(CAMERAS)}")
    parser.add_argument("--sizes", help="some of the megapixels: 0.2,1,3,12")
    parser.add_argument("--out", type=Path, help=f"JSON (default: {RESULTS.relative_to(ROOT)}; quick: nowhere)")
    options = parser.parse_args(arguments)
    sizes = QUICK if options.quick else Sizes()
    chosen = sizes.megapixels
    if options.sizes:
        chosen = tuple(float(size) for size in options.sizes.split(","))
    out = options.out or (None if options.quick else RESULTS)
    rows = json.loads(out.read_text())["rows"] if out is not None and out.exists() else []
    console, threads = Console(), torch.get_num_threads()
    console.width = max(console.width, 130)
    torch.set_num_threads(1)
    try:
        for part in options.only.split(","):
            for camera in options.cameras.split(","):
                for row in MEASURED[part](camera, sizes, chosen):
                    where = environment()
                    rows = merged(rows, {"part": part} | row | {"date": where["date"], "commit": where["commit"]})
                    console.print(f"{part}: {camera}, {row['megapixels']:.2g} MP, {row['who']}")
                    if out is not None:  # after each, so that what was measured is kept
                        write_json(out, {"environment": where, "rows": rows})
    finally:
        torch.set_num_threads(threads)
    print_rows(console, rows)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
