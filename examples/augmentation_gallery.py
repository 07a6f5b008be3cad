"""Every camera augmentation on one picture, at three strengths.

python examples/augmentation_gallery.py [--out augmentations.png]
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

import kornia.augmentation as K
import torch
from skimage import data
from torch import Tensor

import kcam.augmentation as KC
from kcam import plots
from kcam.units import mm, um

SIDE = 180
PHONE: dict[str, Any] = {"focal_length": 4.3 * mm, "pixel_pitch": 1.4 * um, "p": 1.0}
FULL_FRAME: dict[str, Any] = {"focal_length": 50 * mm, "pixel_pitch": 6 * um, "p": 1.0}


def through_depth(focus: float) -> Callable[[Tensor], Tensor]:
    """A picture whose left side is near."""
    stage = KC.RandomDefocus(focus=focus, f_number=2.8, **FULL_FRAME)

    def photograph(picture: Tensor) -> Tensor:
        vergence = torch.linspace(1 / 1.8, 1 / 2.5, picture.shape[-1]).expand(1, 1, *picture.shape[-2:])
        return stage(picture, inverse_depth=vergence)

    return photograph


def drawn_pipeline(seed: int) -> Callable[[Tensor], Tensor]:
    """Lens, sensor and processor as they draw by default, each for every picture."""
    torch.manual_seed(seed)
    lens = [KC.RandomLensDistortion(p=1.0), KC.RandomChromaticAberration(p=1.0), KC.RandomVignetting(p=1.0)]
    sensor = [KC.RandomBayer(), KC.RandomShotReadNoise(p=1.0), KC.RandomQuantisation(p=1.0)]
    processor = [KC.RandomWhiteBalance(p=1.0), KC.RandomColourMatrix(p=1.0), KC.RandomToneCurve(p=1.0)]
    return K.ImageSequential(*lens, *sensor, *processor)


Strengths = dict[str, Callable[[], Any]]
HOT = (0.001, 0.005, 0.02)
GALLERY: dict[str, tuple[str, Strengths]] = {
    "RandomDefocus": (
        "50 mm f/2.8, focus 2 m; the picture at",
        {
            f"{at:g} m": lambda at=at: KC.RandomDefocus(focus=2.0, distance=at, f_number=2.8, **FULL_FRAME)
            for at in (1.95, 1.9, 1.8)
        },
    ),
    "RandomDefocus, a depth map": (
        "1.8 m (left) to 2.5 m; 50 mm f/2.8, focus",
        {f"{focus:g} m": lambda focus=focus: through_depth(focus) for focus in (1.8, 2.1, 2.5)},
    ),
    "RandomDiffraction": (
        "phone, 1.4 um pixels, at",
        {f"f/{n:g}": lambda n=n: KC.RandomDiffraction(f_number=n, **PHONE) for n in (4.0, 8.0, 16.0)},
    ),
    "RandomAberration": (
        "8 mm f/2.8, Zernikes, waves RMS",
        {f"{r:g}": lambda r=r: KC.RandomAberration(rms=r, f_number=2.8, p=1.0) for r in (0.2, 0.5, 1.0)},
    ),
    "RandomChromaticAberration": (
        "half a singlet's axial, and lateral of",
        {
            f"{v:.1%}": lambda v=v: KC.RandomChromaticAberration(axial=0.5, lateral=v, f_number=4.0, p=1.0)
            for v in (0.005, 0.015, 0.03)
        },
    ),
    "RandomVignetting": (
        "field of view from corner to corner",
        {f"{a} degrees": lambda a=a: KC.RandomVignetting(field=float(a), shade=0.2, p=1.0) for a in (45, 70, 95)},
    ),
    "RandomVeilingGlare": (
        "light that the lens scatters, a share of",
        {f"{v:.0%}": lambda v=v: KC.RandomVeilingGlare(share=v, slope=2.0, p=1.0) for v in (0.02, 0.1, 0.3)},
    ),
    "RandomLensDistortion": (
        "barrel to pincushion, k1 =",
        {f"{k:g}": lambda k=k: KC.RandomLensDistortion(k1=k, p=1.0) for k in (-0.2, -0.1, 0.3)},
    ),
    "RandomLens": (
        "real lenses, the picture to 95 % of their field",
        {
            name.replace("_", " "): lambda name=name: KC.RandomLens(name, 0.95, distance=2.0, stops=0.0, p=1.0)
            for name in ("cooke_triplet", "phone", "double_gauss")
        },
    ),
    "RandomBayer": (
        "mosaic and demosaic",
        {
            "RGGB": lambda: KC.RandomBayer("RGGB"),
            "X-Trans": lambda: KC.RandomBayer("x_trans"),
            "quad, bilinear": lambda: KC.RandomBayer("quad_bayer", method="bilinear"),
        },
    ),
    "RandomShotReadNoise": (
        "full well of 10 000 electrons",
        {f"ISO {i}": lambda i=i: KC.RandomShotReadNoise(iso=float(i), p=1.0) for i in (800, 3200, 12800)},
    ),
    "RandomFixedPattern": (
        "spread of the pixels' gains, PRNU",
        {f"{v:.0%}": lambda v=v: KC.RandomFixedPattern(prnu=v, dsnu=20.0, p=1.0) for v in (0.03, 0.08, 0.15)},
    ),
    "RandomMotion": (
        "pixels, at 30 degrees",
        {f"{v}": lambda v=v: KC.RandomMotion(length=float(v), angle=30.0, p=1.0) for v in (4, 10, 24)},
    ),
    "RandomRollingShutter": (
        "lean, of the height",
        {f"{v:g}": lambda v=v: KC.RandomRollingShutter(v, 0.0, 0.01, phase=0.0, p=1.0) for v in (0.05, 0.15, 0.3)},
    ),
    "RandomBanding": (
        "rows and columns, a well of 10 000, electrons",
        {f"{v}": lambda v=v: KC.RandomBanding(row=float(v), column=float(v), p=1.0) for v in (20, 80, 300)},
    ),
    "RandomHotPixels": (
        "5000 electrons each, a share of the pixels of",
        {f"{v:.1%}": lambda v=v: KC.RandomHotPixels(hot=v, dead=v / 2, electrons=5000.0, p=1.0) for v in HOT},
    ),
    "RandomExposure": (
        "stops; saturates at the full well",
        {f"{s:+g}": lambda s=s: KC.RandomExposure(stops=s, p=1.0) for s in (-2.0, 1.0, 2.0)},
    ),
    "RandomQuantisation": (
        "an ADC in linear light",
        {f"{b} bits": lambda b=b: KC.RandomQuantisation(bits=b, p=1.0) for b in (6, 4, 3)},
    ),
    "RandomWhiteBalance": (
        "balanced for daylight, lit at",
        {
            f"{t} K": lambda t=t: KC.RandomWhiteBalance(temperature=float(t), tint=0.0, p=1.0)
            for t in (10000, 4500, 3200)
        },
    ),
    "RandomColourMatrix": (
        "its elements off by (RMS)",
        {f"{s:g}": lambda s=s: KC.RandomColourMatrix(strength=s, p=1.0) for s in (0.05, 0.15, 0.3)},
    ),
    "RandomToneCurve": (
        "gamma, contrast",
        {
            f"{g:g}, {c:+g}": lambda g=g, c=c: KC.RandomToneCurve(gamma=g, contrast=c, p=1.0)
            for g, c in ((0.7, -0.2), (1.0, 0.4), (1.6, 0.2))
        },
    ),
    "RandomCamera": (
        "a phone focused at 2 m; the picture at",
        {f"{d:g} m": lambda d=d: KC.RandomCamera(["phone"], distance=d) for d in (2.0, 1.0, 0.6)},
    ),
    "All in a row": (
        "as a pipeline draws them",
        {f"draw {seed}": lambda seed=seed: drawn_pipeline(seed) for seed in (1, 2, 3)},
    ),
}
"""Augmentation -> what is shown of it, and its three strengths."""


def original(side: int = SIDE) -> Tensor:
    """A piece of scikit-image's astronaut at its own resolution, (1,3,side,side): hair, skin, cloth and metal."""
    top, left = 75, 160
    crop = data.astronaut()[top : top + side, left : left + side]
    return torch.from_numpy(crop).permute(2, 0, 1)[None].float() / 255


def gallery(side: int = SIDE) -> dict[str, list[Tensor]]:
    """The three pictures (3,H,W) of each augmentation."""
    picture, found = original(side), {}
    with torch.no_grad(), torch.random.fork_rng():
        for name, (_, strengths) in GALLERY.items():
            torch.manual_seed(2)
            state = torch.get_rng_state()
            rows = []
            for build in strengths.values():
                torch.set_rng_state(state)  # what is drawn is the same, so that only the strength differs
                stage = build()
                rows.append(stage(picture)[0])
            found[name] = rows
    return found


def figure(pictures: dict[str, list[Tensor]], picture: Tensor) -> Any:
    """Groups of three, three groups side by side."""
    side, gap, edge, head = 0.96, 0.03, 0.06, 0.36
    across, label = 3, 0.15
    group, tall = 3 * (side + gap) + 0.12, side + head + label + 0.1
    groups = [*pictures]
    count = -(-(len(groups) + 1) // across)
    sheet = plots.Sheet(2 * edge + across * group - 0.15, edge + count * tall)
    for index, name in enumerate(["The picture", *groups]):
        left, top = edge + index % across * group, edge + index // across * tall
        sheet.text(left, top, name, size=8.5, weight="bold")
        if index == 0:
            sheet.text(left, top + 0.17, "before any augmentation, 180 x 180", size=7, colour=plots.MUTED)
            sheet.picture(plots.as_image(picture), left, top + head, side, side, smooth=False)
            continue
        what, strengths = GALLERY[name]
        sheet.text(left, top + 0.17, what, size=7, colour=plots.MUTED)
        for column, (strength, own) in enumerate(zip(strengths, pictures[name], strict=True)):
            x = left + column * (side + gap)
            sheet.picture(plots.as_image(own), x, top + head, side, side, smooth=False)
            sheet.text(x, top + head + side + 0.03, strength, size=7.5)
    return sheet.figure


def main(arguments: list[str] | None = None) -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--side", type=int, default=SIDE, help="of the picture [pixels]")
    parser.add_argument("--out", type=Path, default=Path("augmentations.png"))
    options = parser.parse_args(arguments)
    plots.save_figure(figure(gallery(options.side), original(options.side)[0]), options.out, resolution=200)
    print(f"written to {options.out}")


if __name__ == "__main__":
    main()
