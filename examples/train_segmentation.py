"""Train a small net with camera augmentations and without, and test it through a camera that it has never seen.

    python examples/train_segmentation.py [--steps 400] [--seeds 3] [--out training.json]

The task: find the striped shapes in pieces of photographs, pixel by pixel. All nets start from the same weights and see
the same clean pictures in the same order; only the augmentations differ. One photograph is kept for the tests. The test
camera is a phone, in focus and not, at low and high ISO: another lens, pixel pitch, spectral filter, noise and colour
processing than those that the augmentations draw. Four minutes on one core.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from pathlib import Path
from statistics import mean, pstdev
from time import process_time
from typing import Any

import kornia.augmentation as K
import torch
from skimage import data
from torch import Tensor, nn
from torch.nn import functional as F

import kcam.augmentation as KC
from kcam import Camera, Scene, isp, measure, optics, sensor, threads
from kcam.units import mm, um

SIDE, BATCH = 48, 16
SEEN, UNSEEN = ("coffee", "chelsea"), ("astronaut",)
CAMERA_TESTS = {"in focus, ISO 100": (2.0, 100.0), "1.2 m, ISO 100": (1.2, 100.0), "1.2 m, ISO 3200": (1.2, 3200.0)}
"""Distance of the picture [m], and ISO."""
REGIMES: dict[str, Callable[[], nn.Module]] = {
    "none": nn.Identity,
    "Kornia's generic ones": lambda: K.ImageSequential(
        K.RandomGaussianBlur((7, 7), (0.3, 2.0), p=0.5),
        K.RandomGaussianNoise(std=0.05, p=0.5),
        K.ColorJiggle(0.3, 0.3, 0.3, 0.02, p=0.5),
    ),
    "camera augmentations": lambda: K.ImageSequential(
        KC.RandomDefocus(focus=(0.5, 4.0), distance=(0.5, 4.0), f_number=(2.0, 8.0), focal_length=6 * mm, p=0.5),
        KC.RandomExposure((-0.5, 0.5), p=0.5),
        KC.RandomShotReadNoise(iso=(100, 6400), p=0.5),
        KC.RandomBayer(p=1.0),
        KC.RandomWhiteBalance(p=0.5),
    ),
}


def test_camera(iso: float) -> Camera:
    """A phone at f/2.4, focused at 2 m."""
    lens = optics.Lens(optics.CircularAperture(4.3 * mm / 2.4), optics.ThinLens(4.3 * mm), focus_distance=2.0)
    return Camera(
        optics.Imaging(lens, pixel_pitch=1.4 * um),
        sensor.ColourFilter.nikon(),
        sensor.Mosaic("GBRG"),
        sensor.Exposure(iso=iso),
        sensor.ShotNoise(full_well=6_000),
        sensor.ReadNoise(4.0),
        sensor.ADC(bits=10, black_level=64),
        isp.Demosaic(),
        isp.WhiteBalance(),
        isp.ColourMatrix(),
        isp.ToneCurve(),
    )


def photographs(names: tuple[str, ...]) -> list[Tensor]:
    """(3,H,W) each, half as large as in scikit-image."""
    pictures = [torch.from_numpy(getattr(data, name)()).permute(2, 0, 1).float() / 255 for name in names]
    return [F.avg_pool2d(picture, 2) for picture in pictures]


def draw_batch(sources: list[Tensor], count: int, *, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Pieces of photographs (B,3,SIDE,SIDE) with three striped shapes each, and where these are (B,1,SIDE,SIDE)."""

    def uniform(low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand((), generator=generator))

    y, x = torch.meshgrid(*(torch.arange(SIDE, dtype=torch.float32),) * 2, indexing="ij")
    pictures, masks = [], []
    for _ in range(count):
        source = sources[int(uniform(0, len(sources) - 1e-6))]
        top, left = (int(uniform(0, n - SIDE)) for n in source.shape[1:])
        picture = source[:, top : top + SIDE, left : left + SIDE].clone()
        mask = torch.zeros(SIDE, SIDE, dtype=torch.bool)
        for _ in range(3):
            centre_x, centre_y, size, turn = uniform(6, SIDE - 6), uniform(6, SIDE - 6), uniform(5, 10), uniform(0, 3.2)
            u = (x - centre_x) * math.cos(turn) + (y - centre_y) * math.sin(turn)
            v = (y - centre_y) * math.cos(turn) - (x - centre_x) * math.sin(turn)
            disc = uniform(0, 1) < 0.5
            inside = u**2 + v**2 < size**2 if disc else torch.maximum(u.abs(), v.abs()) < 0.9 * size
            stripes = torch.sin(2 * math.pi * u / uniform(4.0, 8.0) + uniform(0, 6.3))
            # stripes on what was there, so that neither colour nor brightness tells a shape
            picture = torch.where(inside, picture + uniform(0.08, 0.25) * stripes, picture)
            mask |= inside
        pictures.append(picture.clamp(0, 1))
        masks.append(mask[None].float())
    return torch.stack(pictures), torch.stack(masks)


def small_net() -> nn.Module:
    """Five convolutions that see 19 pixels far."""
    layers: list[nn.Module] = [nn.Conv2d(3, 16, 3, padding=1), nn.ReLU()]
    for dilation in (1, 2, 4):
        layers += [nn.Conv2d(16, 16, 3, padding=dilation, dilation=dilation), nn.BatchNorm2d(16), nn.ReLU()]
    return nn.Sequential(*layers, nn.Conv2d(16, 1, 3, padding=1))


def train(augment: nn.Module, *, seed: int, steps: int) -> nn.Module:
    """The net after so many steps of Adam."""
    torch.manual_seed(seed)
    net, generator = small_net(), torch.Generator().manual_seed(1000 + seed)
    optimiser = torch.optim.Adam(net.parameters(), lr=3e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 6e-3, total_steps=max(2, steps))
    sources = photographs(SEEN)
    for _ in range(steps):
        picture, mask = draw_batch(sources, BATCH, generator=generator)
        loss = F.binary_cross_entropy_with_logits(net(augment(picture)), mask)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    return net.eval()


@torch.no_grad()
def tests(count: int) -> dict[str, tuple[Tensor, Tensor]]:
    """Pictures of the photograph that was kept: clean, and through the camera."""
    clean, mask = draw_batch(photographs(UNSEEN), count, generator=torch.Generator().manual_seed(7))
    found = {"clean": (clean, mask)}
    for name, (distance, iso) in CAMERA_TESTS.items():
        camera, generator = test_camera(iso), torch.Generator().manual_seed(8)
        shots = [camera(Scene.from_rgb(row[None], depth=distance), generator=generator) for row in clean]
        found[name] = (torch.cat(shots), mask)
    return found


@torch.no_grad()
def intersection_over_union(net: nn.Module, picture: Tensor, mask: Tensor) -> float:
    """Of all pixels together."""
    found, true = net(picture) > 0, mask > 0.5
    return float((found & true).sum() / (found | true).sum().clamp(min=1))


def main(arguments: list[str] | None = None) -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--pictures", type=int, default=64, help="for the tests")
    parser.add_argument("--quick", action="store_true", help="a few steps on a few pictures: seconds")
    parser.add_argument("--out", type=Path, help="the scores as JSON, such as training.json")
    options = parser.parse_args(arguments)
    if options.quick:
        options.steps, options.seeds, options.pictures = 4, 2, 4
    rows: list[dict[str, Any]] = []
    with threads.fixed(1), torch.random.fork_rng():
        environment = measure.environment()
        pictures = tests(options.pictures)
        for name, regime in REGIMES.items():
            begin = process_time()
            nets = [train(regime(), seed=seed, steps=options.steps) for seed in range(options.seeds)]
            seconds = process_time() - begin
            scores = {test: [intersection_over_union(net, *pair) for net in nets] for test, pair in pictures.items()}
            rows.append({"augmentations": name, "seconds": seconds, "iou": scores})
            shown = "   ".join(f"{test}: {mean(own):.3f} +- {pstdev(own):.3f}" for test, own in scores.items())
            print(f"{name:24s} {seconds:4.0f} s   {shown}", flush=True)
    if options.out is not None:
        settings = {"steps": options.steps, "seeds": options.seeds, "batch": BATCH, "side": SIDE}
        content = {"environment": environment, **settings, "test_pictures": options.pictures, "regimes": rows}
        measure.write_json(options.out, content)
        print(f"written to {options.out}")


if __name__ == "__main__":
    main()
