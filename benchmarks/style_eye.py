"""Pictures to show a fresh eye, shuffled and without names: which of these are painted, and which filtered?

python -m benchmarks.style_eye FOLDER   # after `python -m benchmarks.style`, whose shots it shows

FOLDER/00.png to 25.png are what is shown, FOLDER.json what they are. Besides pieces there are OpenCV's
filters, a photograph in twelve colours, paintings themselves, and what the camera alone and a network make.
"""

from __future__ import annotations

import json
import random
import sys
from pathlib import Path

import cv2
import numpy as np
from torch import Tensor

from benchmarks import style, style_measures
from kcam.plots import as_image
from kcam.style import STYLES

SHOWN = 768  # pixels of a side


def levels(picture: Tensor) -> np.ndarray:
    """(3,H,W) as OpenCV has it."""
    return (as_image(picture)[..., ::-1] * 255).round().astype(np.uint8)


def filtered(photo: np.ndarray) -> dict[str, np.ndarray]:
    """What filters make of a photograph."""
    _, labels, colours = cv2.kmeans(photo.reshape(-1, 3).astype(np.float32), 12, None, (3, 20, 1.0), 1, 2)
    return {
        "cv-oil": cv2.xphoto.oilPainting(photo, 4, 1),
        "cv-pencil": cv2.pencilSketch(photo, sigma_s=60, sigma_r=0.07, shade_factor=0.05)[1],
        "cv-stylization": cv2.stylization(photo, sigma_s=60, sigma_r=0.45),
        "twelve-colours": colours[labels[:, 0]].reshape(photo.shape).astype(np.uint8),
    }


def pictures() -> dict[str, np.ndarray]:
    """By name, the shots from where the benchmark has put them."""

    def shot(own: str, arm: str, name: str) -> np.ndarray:
        return levels(style.shot_of(own, arm, name, style.WORK))

    found = {}
    for name, photo in style_measures.photographs(style.SIZE).items():
        if name in ("hopper", "rocket"):
            found |= {f"{kind}-{name}": made for kind, made in filtered(levels(photo)).items()}
            found |= {f"{own}-pieces-{name}": shot(own, "pieces", name) for own in STYLES}
    for own in ("strokes", "watercolour"):
        found[f"style-itself-{own}"] = levels(style.halves(own)[0][:, : style.SIZE])
        found[f"{own}-camera-hopper"] = shot(own, "convolution", "hopper")
        found[f"{own}-network-hopper"] = shot(own, "stage", "hopper")
    return found


def main() -> None:
    """Write them."""
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True)
    found = pictures()
    names = sorted(found)
    random.Random().shuffle(names)
    for index, name in enumerate(names):
        large = cv2.resize(found[name], (SHOWN, SHOWN), interpolation=cv2.INTER_CUBIC)
        cv2.imwrite(str(folder / f"{index:02d}.png"), large)
    folder.with_suffix(".json").write_text(json.dumps(dict(enumerate(names)), indent=1))


if __name__ == "__main__":
    main()
