"""What each part of a camera brings to a style, and why the thesis's arrangement fails: trained and measured.

    python -m benchmarks.style [--styles strokes,..] [--arms optics,..] [--work .style-bench]     train and measure
    python -m benchmarks.style --styles strokes --arms stage --seeds 1,2                        again, by other seeds
    python -m benchmarks.style --collect                                                        write what is committed
    python -m benchmarks.style --paint                                                          docs/images/painted.jpg
    python -m benchmarks.style --film                                                           results/style_film.json

Every arm is trained on crops of kcam's built-in photographs and of the left half of a painting, or of all of it, as
`kcam train` does; it is measured on three other photographs of 256 pixels, against the ordinary camera's picture and a
crop of the painting's right half (`style_measures`, which no arm is trained on, and the training loss). Runs are kept
in the work folder one by one, so that two processes can share them.
"""

from __future__ import annotations

import argparse
import itertools
import json
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from benchmarks import style_measures as measures
from benchmarks.common import ROOT, environment, save_jpeg, write_json
from kcam import isp, optics, plots, sensor
from kcam.camera import Camera
from kcam.context import Context
from kcam.scene import Scene, read_picture
from kcam.style import PRESETS, STYLES, Settings, StyleLoss, fit, paint, painting, style_camera
from kcam.units import mm, nm, um

WORK = ROOT / ".style-bench"
RESULT = ROOT / "benchmarks" / "results" / "style.json"
HALF = 256
SIZE = 256
CAMERA_STEPS = 150
THESIS_STEPS = 300
PAINT_STEPS = 120
SEED = 5  # of the shots
FILM_RESULT = RESULT.with_name("style_film.json")
FRAMES, FILM_SIZE, PAN = 5, 192, 5  # pixels from each frame to the next
BULKY: dict[str, Any] = {"resolutions": (110, 90, 75, 60), "largest": 600_000}  # strokes and noise


class HardClip(nn.Module):
    """The thesis's clip: no gradient where it acts."""

    def forward(self, x: Tensor) -> Tensor:
        return x.clamp(0, 1)


def thesis_camera(*, ordinary: bool = False, straight_through: bool = False) -> Camera:
    """The thesis's network (its figure 4.1) at the size of the quick preset: PSFs of 41 pixels from a phase of 64.

    A flat DOE, a tile of 28 x 28 with signed coefficients, a clip, one 3 x 3 convolution of the mosaic from a random
    start, a clip. `ordinary` starts the convolution as ours, behind a bilinear demosaic; `straight_through` takes
    kcam's clip.
    """
    lens = optics.Lens(
        optics.CircularAperture(diameter=5 * mm),
        optics.PlanoConvexLens(radius_of_curvature=25.8 * mm, glass="N-BK7"),
        optics.DOE(nn.Parameter(torch.zeros(64, 64)), design_wavelength=550 * nm, glass="fused silica"),
        focus_distance=2.0,
    )
    imaging = optics.Imaging(lens, pixel_pitch=4 * um, propagator="fresnel", psf_shape=(41, 41), bands=12)
    if ordinary:
        camera = list(style_camera(stage=False))
        return Camera(imaging, *camera[1:])
    learned = sensor.ColourFilter.learned(28)
    signed = sensor.ColourFilter(nn.Parameter(learned.alpha().detach()), width=learned.width)
    seeded = torch.Generator().manual_seed(0)
    weight = nn.Parameter((2 * torch.rand(3, 1, 3, 3, generator=seeded) - 1) / 3)  # as networks start: 1 / sqrt(9)
    clip: Callable[[], nn.Module] = isp.Clip if straight_through else HardClip
    return Camera(imaging, signed, sensor.Exposure(), clip(), isp.LearnedDemosaic(weight), clip())


@dataclass(frozen=True)
class Arm:
    """What is trained and how: camera, the loss's arguments, settings. note: for tables. whole: on all of a style.

    pieces: how the trained camera paints with pieces of what it was trained on, if it does.
    """

    note: str
    camera: Callable[[], Camera]
    loss: dict[str, Any]
    settings: Settings
    styles: tuple[str, ...] = field(default=tuple(STYLES))
    whole: bool = False
    pieces: dict[str, Any] | None = None


SHOWN = {
    "convolution": "The camera alone",
    "stage": "+ a network",
    "laid": "+ pieces as laid",
    "pieces": "+ pieces",
}
QUICK = PRESETS["quick"]
RATES = QUICK.settings.rates
CAMERA = replace(QUICK.settings, steps=CAMERA_STEPS, content_aim=None)
THESIS_LOSS = PRESETS["thesis"].loss
THESIS = replace(
    PRESETS["thesis"].settings,
    steps=THESIS_STEPS,
    size=128,
    rates={"optics": 1e-3, "filter": 1e-3, "demosaic": 1e-3},
)


def only(*parts: str) -> Settings:
    return replace(CAMERA, rates={part: RATES[part] for part in parts})


def pieces_arm(note: str, **how: Any) -> Arm:
    preset = PRESETS["pieces"]
    return Arm(note, preset.camera, preset.loss, preset.settings, pieces=how)


ARMS: dict[str, Arm] = {
    "optics": Arm("DOE alone", lambda: style_camera(stage=False), QUICK.loss, only("optics")),
    "filter": Arm("+ colour filter", lambda: style_camera(stage=False), QUICK.loss, only("optics", "filter")),
    "convolution": Arm(
        "+ 3x3 convolution: the thesis's parts",
        lambda: style_camera(stage=False),
        QUICK.loss,
        only("optics", "filter", "demosaic", "tone"),
    ),
    "stage": Arm("+ a network: kcam train --preset quick", style_camera, QUICK.loss, QUICK.settings),
    "laid": pieces_arm("+ pieces of the painting, as they are laid", steps=0),
    "pieces": pieces_arm("+ pieces, and down on the loss: kcam train"),
    "whole": Arm("the network, on all of the painting", style_camera, QUICK.loss, QUICK.settings, whole=True),
    "thesis": Arm("the thesis's arrangement", thesis_camera, THESIS_LOSS, THESIS),
    "thesis, our start": Arm(
        "ordinary start, non-negative filter", lambda: thesis_camera(ordinary=True), THESIS_LOSS, THESIS, ("strokes",)
    ),
    "thesis, our clip": Arm(
        "straight-through clip", lambda: thesis_camera(straight_through=True), THESIS_LOSS, THESIS, ("strokes",)
    ),
    "thesis, our content": Arm(
        "correlation in place of L2", thesis_camera, THESIS_LOSS | {"l2": 0.0, "content": 0.5}, THESIS, ("strokes",)
    ),
    "thesis, our style loss": Arm(
        "relative moments and colours in place of Gram",
        thesis_camera,
        {"l2": THESIS_LOSS["l2"], "content": 0.0, "colour": 0.7},
        THESIS,
        ("strokes",),
    ),
    "thesis, our rates": Arm(
        "a rate per part, warm-up, cosine, averaging",
        thesis_camera,
        THESIS_LOSS,
        replace(CAMERA, steps=THESIS_STEPS, rates={k: RATES[k] for k in ("optics", "filter", "demosaic")}),
        ("strokes",),
    ),
}


def halves(style: str) -> tuple[Tensor, Tensor]:
    """What is trained on, 512 x 256, and the other crop of the style, 256 x 256."""
    whole = painting(style, size=2 * HALF)
    return whole[:, :, :HALF], whole[:, :HALF, HALF:]


def shots(camera: Camera) -> dict[str, Tensor]:
    """The photographs that no camera is trained on, taken by it."""
    with torch.no_grad():
        return {
            name: camera(Scene.from_rgb(photo), generator=torch.Generator().manual_seed(SEED))[0].clamp(0, 1)
            for name, photo in measures.photographs(SIZE).items()
        }


def gaps(pictures: dict[str, Tensor], *, style: str) -> dict[str, Any]:
    """All measures of an arm's pictures: for each photograph, their means, and the wallpaper of all."""
    own, other = halves(style)
    loss = StyleLoss(own, content=0.0, colour=QUICK.loss.get("colour", 0.5))
    ordinary = shots(style_camera(stage=False))
    photographs = measures.photographs(SIZE)
    rows = {}
    with torch.no_grad():
        least = float(loss(other[None]))
        for name, picture in pictures.items():
            row = measures.measure(
                picture, scene=photographs[name], ordinary=ordinary[name], style=own, other_style=other
            )
            most = float(loss(ordinary[name][None]))
            row["training_loss"] = measures.gap_closed(float(loss(picture[None])), ordinary=most, other=least)
            rows[name] = row
    keys = next(iter(rows.values()))
    mean = {key: sum(row[key] for row in rows.values()) / len(rows) for key in keys}
    return {"photographs": rows, "mean": mean, "wallpaper": measures.wallpaper(list(pictures.values()))}


def seen_of(pictures: dict[str, Tensor], *, style: str) -> dict[str, float]:
    """What the eye sees of an arm's pictures, the means of the photographs."""
    own, _ = halves(style)
    scenes = measures.photographs(SIZE)
    rows = [
        measures.seen(picture, scene=scenes[name], style=own, face=measures.FACES.get(name))
        for name, picture in pictures.items()
    ]
    known = {key: [row[key] for row in rows if key in row] for row in rows for key in row}
    return {key: sum(values) / len(values) for key, values in known.items()}


def run(style: str, name: str, work: Path, *, seed: int = 0) -> dict[str, Any]:
    """Train an arm, write its pictures, and measure."""
    arm = ARMS[name]
    settings = replace(arm.settings, seed=seed)
    shown = painting(style) if arm.whole else halves(style)[0]
    camera = arm.camera()
    loss = StyleLoss(shown, crop=settings.size, **arm.loss)
    began = time.perf_counter()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        trained = fit(camera, loss, settings=settings)
    if arm.pieces is not None:
        camera = Camera(*camera, isp.TextureTransfer(shown, **arm.pieces), context=camera.context)
    seconds = time.perf_counter() - began
    pictures = shots(camera)
    folder = folder_of(style, name, work, seed=seed)
    folder.mkdir(parents=True, exist_ok=True)
    for title, picture in pictures.items():
        plots.write_picture(picture, folder / f"{title}.png")
    row = {
        "style": style,
        "arm": name,
        "note": arm.note,
        "seed": seed,
        "steps": settings.steps,
        "seconds": seconds,
        "threads": torch.get_num_threads(),
        "loss_at_end": float(trained.history[-20:, 0].mean()),
        "warnings": [str(w.message) for w in caught],
    } | gaps(pictures, style=style)
    (folder / "result.json").write_text(json.dumps(row))
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--styles", default=",".join(STYLES))
    parser.add_argument("--arms", default=";".join(ARMS), help="separated by semicolons")
    parser.add_argument("--seeds", default="0", help="of the training; 0 is what the tables and pictures show")
    parser.add_argument("--work", type=Path, default=WORK)
    parser.add_argument("--collect", action="store_true")
    parser.add_argument("--paint", action="store_true")
    parser.add_argument("--film", action="store_true")
    arguments = parser.parse_args()
    if arguments.collect:
        collect(arguments.work)
        return
    if arguments.paint:
        paint_pictures()
        return
    if arguments.film:
        write_json(
            FILM_RESULT, {"environment": environment(), "rows": [film(style) for style in arguments.styles.split(",")]}
        )
        return
    seeds = [int(seed) for seed in arguments.seeds.split(",")]
    for style, name, seed in itertools.product(arguments.styles.split(","), arguments.arms.split(";"), seeds):
        if style in ARMS[name].styles:
            row = run(style, name, arguments.work, seed=seed)
            mean = {key: round(value, 2) for key, value in row["mean"].items()}
            print(style, name, seed, f"{row['seconds']:.0f} s", mean, flush=True)


def folder_of(style: str, name: str, work: Path, *, seed: int = 0) -> Path:
    again = f"-seed{seed}" if seed else ""
    return work / (f"{style}-{name}".replace(", ", "-").replace(" ", "-") + again)


def shot_of(style: str, name: str, photograph: str, work: Path) -> Tensor:
    """As an arm took it."""
    return read_picture(folder_of(style, name, work) / f"{photograph}.png")


def collect(work: Path) -> None:
    """Runs in the work folder to the committed results and pictures; what was not run again stays as it is."""
    own = [json.loads(path.read_text()) for path in sorted(work.glob("*/result.json"))]
    known = {(row["style"], row["arm"], row["seed"]): row for row in json.loads(RESULT.read_text())["rows"]}
    rows = list((known | {(row["style"], row["arm"], row["seed"]): row for row in own}).values())
    for row in rows:
        row["note"] = ARMS[row["arm"]].note
        folder = folder_of(row["style"], row["arm"], work, seed=row["seed"])
        if folder.is_dir():
            pictures = {name: read_picture(folder / f"{name}.png") for name in measures.photographs(SIZE)}
            row["seen"] = seen_of(pictures, style=row["style"])
    order = {name: index for index, name in enumerate(ARMS)}
    rows.sort(key=lambda row: (list(STYLES).index(row["style"]), order[row["arm"]], row["seed"]))
    write_json(RESULT, {"environment": environment(), "rows": rows})

    shot = partial(shot_of, work=work)
    photographs = measures.photographs(SIZE)
    ordinary = shots(style_camera(stage=False))
    hopper = next(iter(photographs))
    sheets: dict[str, Callable[[], Any]] = {
        "style": lambda: plots.contact_sheet(
            [[halves(style)[0][:, :SIZE], *(shot(style, "pieces", name) for name in photographs)] for style in STYLES],
            titles=["Style", *(f"A shot: {name}" for name in photographs)],
            labels=[f"kcam train {style}" for style in STYLES],
        ),
        "style-parts": lambda: plots.contact_sheet(
            [[ordinary[hopper], *(shot(style, part, hopper) for part in SHOWN)] for style in STYLES],
            titles=["Ordinary camera", *SHOWN.values()],
            labels=list(STYLES),
        ),
        "style-thesis": lambda: plots.contact_sheet(
            [
                [photographs[name], *(shot("strokes", arm, name) for arm in ARMS if arm.startswith("thesis"))]
                for name in photographs
            ],
            titles=["Photograph", *(arm.replace("thesis, ", "+ ") for arm in ARMS if arm.startswith("thesis"))],
            labels=["The thesis's arrangement", "", ""],
        ),
    }
    for name, sheet in sheets.items():
        try:
            figure = sheet()
        except FileNotFoundError as error:
            print(f"{name} stays as it is: {error}")
            continue
        save_jpeg(figure, ROOT / "docs" / "images" / f"{name}.jpg", **BULKY)
        print(name)


def film(style: str) -> dict[str, Any]:
    """How much frames of a pan differ where they show the same, RMS: painted by themselves, and as a film.

    Each frame is taken by an ordinary camera, with photons of its own.
    """
    photo, camera, own = Scene.builtin("astronaut").to_srgb()[0], style_camera(stage=False), halves(style)[0]
    crops = [photo[:, 60 : 60 + FILM_SIZE, 100 - PAN * t : 100 - PAN * t + FILM_SIZE] for t in range(FRAMES)]
    with torch.no_grad():
        taken = [
            camera(Scene.from_rgb(crop), generator=torch.Generator().manual_seed(t)) for t, crop in enumerate(crops)
        ]
        frames = torch.cat(taken).clamp(0, 1)
        stage, seeded = isp.TextureTransfer(own), isp.TextureTransfer(own, seed=SEED)
        films = {
            "frames": frames,
            "by_themselves": torch.cat(
                [
                    stage(frame[None], Context(generator=torch.Generator().manual_seed(t)))
                    for t, frame in enumerate(frames)
                ]
            ),
            "same_seed": torch.cat([seeded(frame[None]) for frame in frames]),
            "film": seeded.film(frames, (PAN, 0)),
        }
    row: dict[str, Any] = {"style": style, "frames_taken": FRAMES, "pan": PAN}
    for name, shown in films.items():
        row[name] = float((shown[1:, ..., PAN:] - shown[:-1, ..., :-PAN]).square().mean().sqrt())
    scene = torch.stack(crops)
    row["detail"] = {
        name: sum(measures.detail_correlation(a, b) for a, b in zip(films[name], scene, strict=True)) / FRAMES
        for name in ("by_themselves", "film")
    }
    print(row, flush=True)
    return row


def paint_pictures() -> None:
    """What `kcam paint` makes: textures from white noise, and a photograph painted by the loss and with pieces."""
    photograph = measures.photographs(SIZE)["hopper"]
    rows = []
    for style in STYLES:
        own, _ = halves(style)
        texture = paint(StyleLoss(own, content=0.0, colour=1.0), shape=(SIZE, SIZE), steps=PAINT_STEPS)
        painted = paint(StyleLoss(own, content=0.3, colour=1.0), photo=photograph, steps=PAINT_STEPS)
        seeded = torch.Generator().manual_seed(SEED)
        pieces = isp.texture_transfer(photograph[None], exemplar=own, generator=seeded)[0]
        rows.append([own[:, :SIZE], texture, painted, pieces])
    sheet = plots.contact_sheet(
        rows,
        titles=["Style", "Texture, from white noise", "Painted by the loss", "Painted with pieces"],
        labels=list(STYLES),
    )
    save_jpeg(sheet, ROOT / "docs" / "images" / "painted.jpg", **BULKY)


if __name__ == "__main__":
    main()
