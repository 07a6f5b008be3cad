"""Camera augmentations beside Kornia's nearest ones, the straightforward way, and their own bare maths.

    python -m benchmarks.augmentation [--quick] [--only NAME] [--out benchmarks/results/augmentation.json]

All contestants of a race run by turns in one process. *Ours* is the augmentation as it is called, *simulate* its
effect alone on drawn numbers, *light* the way of a whole picture into linear light and back, *two powers* what that
way would take at least, x^2.4 and x^(1/2.4), *identity* a Kornia augmentation that returns its input. The maths is
simulate, and light where the effect wants it; the straightforward way needs both too. What we add is ours - identity -
maths: drawing, picking rows, checks, copies. The claim: it costs less than the maths; what comes out where light does
not count as maths is written down too. `AIMS` says how much longer than Kornia's each may take. Then four of them in a
row, and a pipeline of eight stages behind a DataLoader.
"""

from __future__ import annotations

import argparse
import functools
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import kornia.augmentation as K
import torch
from kornia.color import CFA, raw_to_rgb, rgb_to_raw
from kornia.geometry.calibration import undistort_points
from kornia.geometry.transform import remap
from rich.console import Console
from torch import Tensor, nn

import kcam.augmentation as KC
from benchmarks.common import Contestant, environment, race, write_json
from kcam import Camera, Scene, isp, measure, optics, sensor, threads
from kcam.augmentation.base import is_picture, wavelengths_of
from kcam.augmentation.isp import planck_ratio
from kcam.context import Context
from kcam.isp import tone_curve
from kcam.srgb import to_light
from kcam.units import wavelength_grid

RESULTS = Path(__file__).parent / "results" / "augmentation.json"
SEED = 3  # draws four of eight rows at p = 0.5
BATCH, SIDE, CHANNELS = 8, 256, (3, 28)

Plain = Callable[[Any, Tensor, dict[str, Tensor]], Tensor]
Make = Callable[[float], Any]


class Identity(K.IntensityAugmentationBase2D):
    """What Kornia's machinery costs by itself."""

    def apply_transform(self, input: Tensor, params: Any, flags: Any, transform: Tensor | None = None) -> Tensor:
        """The input."""
        return input


class KorniaBayer(K.IntensityAugmentationBase2D):
    """Kornia's mosaic and its bilinear demosaic."""

    def apply_transform(self, input: Tensor, params: Any, flags: Any, transform: Tensor | None = None) -> Tensor:
        """Of the coded picture."""
        return raw_to_rgb(rgb_to_raw(input, CFA.BG), CFA.BG)


# ---- the straightforward ways --------------------------------------------------------------------------------------


class Dispersion(optics.Element):
    """A vergence of its own at each wavelength."""

    symmetric, focuses = True, False

    def __init__(self, vergences: Tensor, wavelengths: Tensor) -> None:
        super().__init__()
        self.vergences, self.wavelengths = vergences, wavelengths

    def vergence(self, wavelengths: Tensor) -> Tensor:
        """That of the nearest wavelength."""
        return self.vergences[(wavelengths[:, None] - self.wavelengths).abs().argmin(1)]


def lens_per_sample(augmentation: Any, signal: Tensor, drawn: dict[str, Tensor]) -> Tensor:
    """A Lens and an Imaging for each sample."""
    wavelengths = wavelengths_of(signal, augmentation.wavelengths)
    rows = []
    for index in range(len(signal)):
        own = {name: value[index : index + 1] for name, value in drawn.items()}
        window = augmentation.psf_shape((signal.shape[-2], signal.shape[-1]), wavelengths, own)
        row = signal[index : index + 1]
        focal = float(own.get("focal_length", getattr(augmentation, "focal_length", torch.nan)))
        elements = [optics.CircularAperture(focal / float(own["f_number"])), optics.ThinLens(focal)]
        if "rms" in own:
            elements.append(optics.ZernikeAberration(augmentation.coefficients(own)[0]))
        if "axial" in own:
            elements.append(Dispersion(augmentation.vergences(own, wavelengths)[0, 0], wavelengths))
            row = magnified(row, 1 + float(own["lateral"]) * augmentation.dispersion(wavelengths)[1])
        imaging = optics.Imaging(
            optics.Lens(*elements, focus_distance=float(own.get("focus", torch.inf))),
            pixel_pitch=augmentation.pixel_pitch,
            propagator="fresnel",
            psf_shape=window,
            renormalise=True,
            distance=float(own.get("distance", torch.inf)),
        )
        rows.append(imaging(row, Context(wavelengths=wavelengths)))
    return torch.cat(rows)


def magnified(row: Tensor, scales: Tensor) -> Tensor:
    """Channel by channel."""
    channels = []
    for channel, scale in zip(row.split(1, dim=1), scales.tolist(), strict=True):
        matrix = torch.tensor([[[1 / scale, 0.0, 0.0], [0.0, 1 / scale, 0.0]]], dtype=row.dtype)
        grid = nn.functional.affine_grid(matrix, list(channel.shape), align_corners=False)
        channels.append(nn.functional.grid_sample(channel, grid, padding_mode="reflection", align_corners=False))
    return torch.cat(channels, dim=1)


def vignette_per_sample(augmentation: Any, signal: Tensor, drawn: dict[str, Tensor]) -> Tensor:
    """A map for each sample."""
    height, width = signal.shape[-2:]
    y, x = torch.meshgrid(*(torch.arange(n) - (n - 1) / 2 for n in (height, width)), indexing="ij")
    u = torch.hypot(x, y) / torch.hypot(x, y).max()
    rows = []
    for row, field, shade in zip(signal, drawn["field"].tolist(), drawn["shade"].tolist(), strict=True):
        theta = torch.atan(u * torch.tan(torch.deg2rad(torch.tensor(field)) / 2))
        rows.append(row * torch.cos(theta) ** 4 * (1 - shade * u**2))
    return torch.stack(rows)


def distort_per_sample(augmentation: Any, signal: Tensor, drawn: dict[str, Tensor]) -> Tensor:
    """Kornia's inverse of the distortion in 40 steps, and its remap."""
    height, width = signal.shape[-2:]
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    points = torch.stack([x, y], dim=-1).reshape(1, -1, 2).to(signal)
    focal = float(max(height, width))
    camera = torch.tensor([[[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]]]).to(signal)
    rows = []
    for index in range(len(signal)):
        coefficients = torch.stack([drawn[name][index : index + 1] for name in ("k1", "k2", "p1", "p2")], dim=1)
        source = undistort_points(points, camera, coefficients.to(signal), num_iters=40).view(1, height, width, 2)
        rows.append(remap(signal[index : index + 1], source[..., 0], source[..., 1], align_corners=True))
    return torch.cat(rows)


def move_per_sample(augmentation: Any, signal: Tensor, drawn: dict[str, Tensor]) -> Tensor:
    """The transfer function of a straight line, of each mirrored sample."""
    height, width = signal.shape[-2:]
    fy, fx = torch.fft.fftfreq(2 * height)[:, None], torch.fft.rfftfreq(2 * width)
    rows = []
    for row, length, angle in zip(signal, drawn["length"], torch.deg2rad(drawn["angle"]), strict=True):
        mirrored = torch.cat([row, row.flip(-1)], -1)
        mirrored = torch.cat([mirrored, mirrored.flip(-2)], -2)
        transfer = torch.sinc(length * (fx * angle.cos() + fy * angle.sin()))
        rows.append(torch.fft.irfft2(torch.fft.rfft2(mirrored) * transfer, s=mirrored.shape[-2:]))
    return torch.stack(rows)[..., :height, :width]


def roll_per_sample(augmentation: Any, signal: Tensor, drawn: dict[str, Tensor]) -> Tensor:
    """Each row from where it was, by Kornia's remap."""
    height, width = signal.shape[-2:]
    y, x = torch.meshgrid(torch.arange(height).double(), torch.arange(width).double(), indexing="ij")
    away, rows = y - (height - 1) / 2, []
    for index in range(len(signal)):
        own = {name: float(values[index]) for name, values in drawn.items()}
        wave = torch.sin(2 * torch.pi * (own["cycles"] * y / height + own["phase"]))
        across = x - own["lean"] * away - own["wobble"] * height * wave
        maps = (across[None].to(signal), (y - own["stretch"] * away)[None].to(signal))
        rows.append(remap(signal[index : index + 1], *maps, align_corners=True))
    return torch.cat(rows)


def bayer_per_sample(augmentation: Any, signal: Tensor, drawn: dict[str, Tensor]) -> Tensor:
    """A mosaic and a demosaic for each sample; for a cube a camera."""
    rows = []
    for index, choice in enumerate(drawn["pattern"].tolist()):
        row, pattern = signal[index : index + 1], augmentation.patterns[choice]
        if is_picture(signal):
            rows.append(isp.demosaic(sensor.mosaic(row, pattern=pattern), pattern=pattern))
        else:
            camera = Camera(
                sensor.ColourFilter.kodak(), sensor.Mosaic(pattern), sensor.Exposure(), isp.Demosaic(),
                isp.WhiteBalance(), isp.ColourMatrix(), isp.ToneCurve(),
                context=Context(wavelengths=wavelength_grid(count=signal.shape[1])),
            )  # fmt: skip
            rows.append(camera(row))
    return torch.cat(rows)


def noise_of_the_batch(augmentation: Any, signal: Tensor, drawn: dict[str, Tensor]) -> Tensor:
    """torch.poisson and torch.randn of all samples at once, from the global generator: no replay."""
    gain, well, sigma = (drawn[name].to(signal)[:, None, None, None] for name in ("iso", "full_well", "read_noise"))
    scale = well / (gain / 100)
    counts = torch.poisson(signal.clamp(min=0) * scale)
    return ((counts + sigma * torch.randn_like(signal)) / scale).clamp(max=1)


def normal_noise_of_the_batch(augmentation: Any, signal: Tensor, drawn: dict[str, Tensor]) -> Tensor:
    """torch.randn of all samples at once, with the variance of photons and read-out."""
    gain, well, sigma = (drawn[name].to(signal)[:, None, None, None] for name in ("iso", "full_well", "read_noise"))
    electron = gain / 100 / well
    return (signal + (signal * electron + (electron * sigma) ** 2).sqrt() * torch.randn_like(signal)).clamp(max=1)


def pattern_of_the_batch(augmentation: Any, signal: Tensor, drawn: dict[str, Tensor]) -> Tensor:
    """torch.randn twice, of all samples at once."""
    prnu, dsnu = (drawn[name].to(signal)[:, None, None, None] for name in ("prnu", "dsnu"))
    gain = 1 + prnu * torch.randn_like(signal)
    return signal * gain + dsnu / augmentation.full_well * torch.randn_like(signal)


def stripes_of_the_batch(augmentation: Any, signal: Tensor, drawn: dict[str, Tensor]) -> Tensor:
    """torch.randn twice, of all samples at once."""
    row, column = (drawn[name].to(signal)[:, None, None, None] / augmentation.full_well for name in ("row", "column"))
    batch, _, height, width = signal.shape
    own = {"dtype": signal.dtype, "device": signal.device}
    return signal + row * torch.randn(batch, 1, height, 1, **own) + column * torch.randn(batch, 1, 1, width, **own)


def defects_of_the_batch(augmentation: Any, signal: Tensor, drawn: dict[str, Tensor]) -> Tensor:
    """torch.rand and an exponential of all samples at once."""
    hot, dead, electrons = (drawn[name].to(signal)[:, None, None, None] for name in ("hot", "dead", "electrons"))
    kind, tail = torch.rand_like(signal), electrons / augmentation.full_well * torch.empty_like(signal).exponential_()
    return torch.where(kind < dead, 0, signal + tail * (kind >= 1 - hot)).clamp(max=1)


def glare_per_sample(augmentation: Any, signal: Tensor, drawn: dict[str, Tensor]) -> Tensor:
    """The mirrored picture and the tail at its pixels' centres, by FFT, for each channel of each sample."""
    wavelengths, (height, width) = wavelengths_of(signal, augmentation.wavelengths) / 550e-9, signal.shape[-2:]
    reach = augmentation.focal_length / augmentation.pixel_pitch
    y, x = (torch.fft.fftfreq(2 * n, 1 / (2 * n), dtype=torch.float64) for n in (height, width))
    square = y[:, None] ** 2 + x**2
    rows = []
    for row, share, core, slope in zip(signal, drawn["share"], drawn["core"], drawn["slope"], strict=True):
        channels = []
        for plane, wavelength in zip(row.double(), wavelengths.tolist(), strict=True):
            tail = (1 + square / (core * reach * wavelength) ** 2) ** (-slope / 2)
            own = 1 - (1 - share) ** (wavelength**-2)
            mirrored = torch.cat([plane, plane.flip(-1)], -1)
            mirrored = torch.cat([mirrored, mirrored.flip(-2)], -2)
            spread = torch.fft.irfft2(torch.fft.rfft2(mirrored) * torch.fft.rfft2(tail / tail.sum()))
            channels.append((1 - own) * plane + own * spread[:height, :width])
        rows.append(torch.stack(channels))
    return torch.stack(rows).to(signal.dtype)


def exposure_per_sample(augmentation: Any, signal: Tensor, drawn: dict[str, Tensor]) -> Tensor:
    """A gain and a clamp for each sample."""
    return torch.stack([(row * 2**stop).clamp(0, 1) for row, stop in zip(signal, drawn["stops"].tolist(), strict=True)])


def quantise_per_sample(augmentation: Any, signal: Tensor, drawn: dict[str, Tensor]) -> Tensor:
    """Rounded to each sample's steps."""
    steps = (2 ** (augmentation.fewest + drawn["bits"]) - 1).tolist()
    return torch.stack([(row * step).round() / step for row, step in zip(signal.clamp(0, 1), steps, strict=True)])


def balance_per_sample(augmentation: Any, signal: Tensor, drawn: dict[str, Tensor]) -> Tensor:
    """A gain for each channel of each sample."""
    wavelengths, rows = wavelengths_of(signal, augmentation.wavelengths), []
    for index, row in enumerate(signal):
        gains = planck_ratio(wavelengths, temperature=drawn["temperature"][index : index + 1])[0]
        if len(row) == 3:
            gains[1] *= 2 ** drawn["tint"][index]
        rows.append(row * gains.to(row)[:, None, None])
    return torch.stack(rows)


def matrix_of_the_batch(augmentation: Any, signal: Tensor, drawn: dict[str, Tensor]) -> Tensor:
    """One einsum."""
    return torch.einsum("bij,bjhw->bihw", augmentation.matrix(drawn).to(signal), signal)


def tone_per_sample(augmentation: Any, signal: Tensor, drawn: dict[str, Tensor]) -> Tensor:
    """The two curves for each sample."""
    rows = []
    for row, gamma, contrast in zip(signal, drawn["gamma"].tolist(), drawn["contrast"].tolist(), strict=True):
        u = ((row.clamp(0, 1) + 0.01) ** gamma - 0.01**gamma) / (1.01**gamma - 0.01**gamma)
        rows.append(u + 2 * contrast * u * (1 - u) * (2 * u - 1))
    return torch.stack(rows)


def camera_per_sample(augmentation: Any, signal: Tensor, drawn: dict[str, Tensor]) -> Tensor:
    """The preset phone without a plan, built for each sample."""
    rows = []
    for index, distance in enumerate(drawn["distance"].tolist()):
        row = signal[index : index + 1]
        if is_picture(row):
            scene = Scene.from_rgb(row, depth=distance)
        else:
            scene = Scene.from_bands(row, wavelengths=wavelength_grid(count=row.shape[1]), depth=distance)
        rows.append(Camera.phone()(scene))
    return torch.cat(rows)


def real_lens_per_sample(augmentation: Any, signal: Tensor, drawn: dict[str, Tensor]) -> Tensor:
    """A lens traced, and its PSFs computed, for each sample."""
    rows = []
    wavelengths, shape = wavelengths_of(signal, augmentation.wavelengths), (signal.shape[-2], signal.shape[-1])
    for index, row in enumerate(signal.split(1)):
        which, reach, distance = (drawn[name][index].item() for name in ("lens", "reach", "distance"))
        pitch = augmentation.pixel_pitch(which, shape=shape, reach=reach)
        imaging = optics.Imaging(
            augmentation.lenses[which], pixel_pitch=pitch, distance=distance, spacing=max(shape) // 4
        )
        rows.append(imaging(row, Context(wavelengths=wavelengths)))
    return torch.cat(rows)


# ---- what is compared ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Case:
    """One augmentation, the straightforward way to write it, and its nearest relatives in Kornia.

    exact: plain computes the same from the same drawn numbers. share: of the batch that plain is run on. only: the
    channels that it takes.
    """

    augmentation: Callable[..., Any]
    plain: Plain
    relatives: dict[str, Make]
    exact: bool = True
    share: float = 1.0
    only: tuple[int, ...] = CHANNELS
    relative_only: tuple[int, ...] = CHANNELS


def blur(p: float) -> nn.Module:
    """In the window that RandomDefocus takes for its PSFs on pictures, 57 x 57; its time does not depend on sigma."""
    return K.RandomGaussianBlur((57, 57), (1.0, 9.0), p=p)


def bayer(p: float) -> nn.Module:
    """Kornia's mosaic and bilinear demosaic as an augmentation."""
    return KorniaBayer(p=p)


def fisheye(p: float) -> nn.Module:
    """Of about the same displacement."""
    return K.RandomFisheye(torch.tensor([-0.1, 0.1]), torch.tensor([-0.1, 0.1]), torch.tensor([0.9, 1.1]), p=p)


NORMAL_NOISE = functools.partial(KC.RandomShotReadNoise, photons="normal")
GAUSSIAN: dict[str, Make] = {"RandomGaussianBlur": blur}
MOTION: dict[str, Make] = {"RandomMotionBlur": lambda p: K.RandomMotionBlur((21, 35), 35.0, 0.5, p=p)}
NOISE: dict[str, Make] = {"RandomGaussianNoise": lambda p: K.RandomGaussianNoise(p=p)}
CASES: dict[str, Case] = {
    "RandomDefocus": Case(KC.RandomDefocus, lens_per_sample, GAUSSIAN | MOTION),
    "RandomDiffraction": Case(KC.RandomDiffraction, lens_per_sample, GAUSSIAN),
    "RandomAberration": Case(KC.RandomAberration, lens_per_sample, GAUSSIAN | MOTION),
    "RandomChromaticAberration": Case(KC.RandomChromaticAberration, lens_per_sample, GAUSSIAN),
    "RandomVignetting": Case(
        KC.RandomVignetting,
        vignette_per_sample,
        {"RandomLinearIllumination": lambda p: K.RandomLinearIllumination(p=p)},
    ),
    "RandomVeilingGlare": Case(KC.RandomVeilingGlare, glare_per_sample, GAUSSIAN, exact=False),
    "RandomMotion": Case(KC.RandomMotion, move_per_sample, MOTION, exact=False),
    "RandomRollingShutter": Case(
        KC.RandomRollingShutter, roll_per_sample, {"RandomThinPlateSpline": lambda p: K.RandomThinPlateSpline(p=p)}
    ),
    "RandomLensDistortion": Case(KC.RandomLensDistortion, distort_per_sample, {"RandomFisheye": fisheye}),
    "RandomLens": Case(KC.RandomLens, real_lens_per_sample, {}, share=1 / BATCH, only=(3,)),
    "RandomBayer": Case(KC.RandomBayer, bayer_per_sample, {"rgb_to_raw, raw_to_rgb": bayer}, relative_only=(3,)),
    "RandomShotReadNoise": Case(KC.RandomShotReadNoise, noise_of_the_batch, NOISE, exact=False),
    "RandomShotReadNoise, normal": Case(NORMAL_NOISE, normal_noise_of_the_batch, NOISE, exact=False),
    "RandomFixedPattern": Case(KC.RandomFixedPattern, pattern_of_the_batch, NOISE, exact=False),
    "RandomBanding": Case(KC.RandomBanding, stripes_of_the_batch, NOISE, exact=False),
    "RandomHotPixels": Case(
        KC.RandomHotPixels,
        defects_of_the_batch,
        {"RandomSaltAndPepperNoise": lambda p: K.RandomSaltAndPepperNoise((0.001, 0.01), p=p)},
        exact=False,
        relative_only=(3,),
    ),
    "RandomExposure": Case(
        KC.RandomExposure, exposure_per_sample, {"RandomBrightness": lambda p: K.RandomBrightness((0.5, 1.5), p=p)}
    ),
    "RandomQuantisation": Case(
        KC.RandomQuantisation, quantise_per_sample, {"RandomPosterize": lambda p: K.RandomPosterize((3.0, 8.0), p=p)}
    ),
    "RandomWhiteBalance": Case(
        KC.RandomWhiteBalance,
        balance_per_sample,
        {"RandomPlanckianJitter": lambda p: K.RandomPlanckianJitter(p=p)},
        relative_only=(3,),
    ),
    "RandomColourMatrix": Case(
        KC.RandomColourMatrix,
        matrix_of_the_batch,
        {"ColorJiggle": lambda p: K.ColorJiggle(0.2, 0.2, 0.2, 0.05, p=p)},
        only=(3,),
    ),
    "RandomToneCurve": Case(
        KC.RandomToneCurve, tone_per_sample, {"RandomGamma": lambda p: K.RandomGamma((0.7, 1.4), p=p)}
    ),
    "RandomCamera": Case(KC.RandomCamera, camera_per_sample, {}, exact=False, share=1 / BATCH),
}


@dataclass(frozen=True)
class Aim:
    """So many times as long as another contestant an augmentation may take, on pictures at p = 1."""

    name: str
    beside: str
    most: float

    def verdict(self, lines: list[dict[str, Any]]) -> dict[str, Any]:
        """What was measured, beside the aim."""
        seconds = next(line["seconds"] for line in lines if line["augmentation"] == self.name and line["channels"] == 3)
        ratio = seconds["kcam 1"] / seconds[self.beside]
        return {"what": self.name, "beside": self.beside, "most": self.most, "ratio": ratio, "met": ratio <= self.most}


POWERS = "two powers"
AIMS = (
    *(Aim(f"Random{name}", POWERS, 1.2) for name in ("Exposure", "WhiteBalance", "Vignetting", "Quantisation")),
    Aim("RandomToneCurve", "RandomGamma", 1.2),
    Aim("RandomShotReadNoise", "RandomGaussianNoise", 5.0),
    Aim("RandomShotReadNoise, normal", "RandomGaussianNoise", 3.0),
    Aim("RandomLensDistortion", "RandomFisheye", 2.0),
    Aim("RandomDefocus", "RandomGaussianBlur", 1.5),
    Aim("RandomDiffraction", "RandomGaussianBlur", 2.0),
    Aim("RandomAberration", "RandomGaussianBlur", 3.0),
    Aim("RandomBayer", "rgb_to_raw, raw_to_rgb", 1.2),
)
RUN = (
    (KC.RandomExposure, "RandomExposure"), (KC.RandomWhiteBalance, "RandomWhiteBalance"),
    (KC.RandomVignetting, "RandomVignetting"), (KC.RandomQuantisation, "RandomQuantisation"),
)  # fmt: skip
"""In a row, which takes a picture into light once; the first relative of each stands beside it."""
PIPELINE = (
    KC.RandomLensDistortion, KC.RandomDefocus, KC.RandomVignetting, KC.RandomBayer, KC.RandomShotReadNoise,
    KC.RandomExposure, KC.RandomWhiteBalance, KC.RandomToneCurve,
)  # fmt: skip


def relative_of(name: str, p: float) -> nn.Module:
    """The first of Kornia's nearest."""
    return next(iter(CASES[name].relatives.values()))(p)


def run(*, batch: int, side: int, seconds: float) -> list[dict[str, Any]]:
    """Times of the first one to four of `RUN`, ours in a CameraSequential and Kornia's in its container."""
    picture = torch.rand(batch, 3, side, side, generator=torch.Generator().manual_seed(1))
    contestants = []
    for count in range(1, len(RUN) + 1):
        theirs = K.AugmentationSequential(*(relative_of(name, 1.0) for _, name in RUN[:count]))
        ours = KC.CameraSequential(*(augmentation(p=1.0) for augmentation, _ in RUN[:count]))
        contestants += [
            Contestant(f"Kornia {count}", functools.partial(theirs, picture), no_error),
            Contestant(f"kcam {count}", functools.partial(ours, picture), no_error),
        ]
    with torch.no_grad():
        rows = race("run", size="", direction="forward", contestants=contestants, seconds=seconds)
    taken = {row["who"]: row["seconds"] for row in rows}
    lines = []
    for count, (_, name) in enumerate(RUN, start=1):
        more = {who: taken[f"{who} {count}"] - taken.get(f"{who} {count - 1}", 0.0) for who in ("kcam", "Kornia")}
        lines.append({"count": count, "last": name, "seconds": [taken[f"kcam {count}"], taken[f"Kornia {count}"]],
                      "more": [more["kcam"], more["Kornia"]]})  # fmt: skip
    return lines


class Pictures(torch.utils.data.Dataset):
    """Random ones, the same each time."""

    def __init__(self, count: int, side: int) -> None:
        self.pictures = torch.rand(count, 3, side, side, generator=torch.Generator().manual_seed(1))

    def __len__(self) -> int:
        return len(self.pictures)

    def __getitem__(self, index: int) -> Tensor:
        return self.pictures[index]


def pipeline(*, batch: int, side: int, batches: int, rounds: int) -> dict[str, Any]:
    """Seconds on the wall of eight stages at p = 0.5 in two workers of one thread, by turns with Kornia's nearest."""
    theirs = K.AugmentationSequential(*(relative_of(augmentation.__name__, 0.5) for augmentation in PIPELINE))
    ours = KC.CameraSequential(*(augmentation(p=0.5) for augmentation in PIPELINE))
    taken: dict[str, list[float]] = {"kcam": [], "Kornia": []}
    for _ in range(rounds):
        for who, augment in (("Kornia", theirs), ("kcam", ours)):
            loader = torch.utils.data.DataLoader(
                Pictures(batch * batches, side), batch_size=batch, num_workers=2, persistent_workers=True,
                collate_fn=lambda rows, augment=augment: augment(torch.stack(rows)),
                worker_init_fn=lambda _: torch.set_num_threads(1),
            )  # fmt: skip
            list(loader)  # workers start, tables are built
            before = time.perf_counter()
            list(loader)
            taken[who].append((time.perf_counter() - before) / batches)
    seconds = {who: statistics.median(each) for who, each in taken.items()}
    names = [augmentation.__name__ for augmentation in PIPELINE]
    return {"size": f"{batch} x 3 x {side}^2", "stages": names, "p": 0.5, "workers": 2, "seconds_per_batch": seconds}


def aims_without_avx512() -> list[dict[str, Any]]:
    """The aims in a process whose torch takes no AVX-512, as on other processors."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "aims.json"
        command = [sys.executable, "-m", "benchmarks.augmentation", "--aims", "--out", str(out)]
        subprocess.run(command, check=True, env=os.environ | {"ATEN_CPU_CAPABILITY": "avx2"}, capture_output=True)
        return json.loads(out.read_text())["aims"]


def half_of_the_rows(batch: int) -> int:
    """A seed of the global generator for which half of the rows are drawn at p = 0.5: Kornia's gate comes first."""
    for seed in range(1000):
        torch.manual_seed(seed)
        if int(Identity(p=0.5).forward_parameters(torch.Size((batch, 3, 4, 4)))["batch_prob"].sum()) == batch // 2:
            return seed
    raise RuntimeError("no seed in 1000 draws half of the rows.")


def simulate(augmentation: Any, signal: Tensor, drawn: dict[str, Tensor]) -> Tensor:
    """The effect alone."""
    if isinstance(augmentation, (KC.RandomLensDistortion, KC.RandomRollingShutter)):
        return augmentation._remapped(signal, drawn, augmentation.flags, inverse=False)
    return augmentation.simulate(signal, drawn)


def compare(name: str, case: Case, *, channels: int, batch: int, side: int, seconds: float) -> dict[str, Any]:
    """One line of the table: seconds of each contestant, and what we add at p = 1 and p = 0.5."""
    picture = torch.rand(batch, channels, side, side, generator=torch.Generator().manual_seed(1))
    seed = half_of_the_rows(batch)

    def seeded(call: Callable[[Tensor], Any]) -> Callable[[], Any]:
        def run() -> Any:
            torch.manual_seed(seed)
            return call(picture)

        return run

    contestants: list[Contestant] = []
    for p in (1.0, 0.5):
        own = case.augmentation(p=p)
        if p < 1 and changes_channels(own, channels):
            continue
        torch.manual_seed(seed)
        params = own.forward_parameters(picture.shape)
        rows = (params["batch_prob"] > 0.5).nonzero().flatten()
        drawn = {key: params[key][rows] for key in own._param_generator.draws}
        coded = getattr(own, "in_light", False) and is_picture(picture)
        light = (to_light(picture) if coded else picture)[rows]
        if p == 1:
            contestants.append(
                straightforward(case, own, picture, drawn, coded=coded, truth=own(picture, params=params))
            )
            if channels in case.relative_only:
                contestants += [Contestant(who, seeded(make(p)), no_error) for who, make in case.relatives.items()]
            if coded:
                contestants.append(Contestant("light", lambda: tone_curve(to_light(picture)), no_error))
                contestants.append(Contestant(POWERS, lambda: (picture**2.4, picture ** (1 / 2.4)), no_error))
        contestants += [
            Contestant(f"kcam {p:g}", seeded(own), no_error, default=p == 1),
            Contestant(f"kcam simulate {p:g}", lambda a=own, s=light, d=drawn: simulate(a, s, d), no_error),
            Contestant(f"identity {p:g}", seeded(Identity(p=p)), no_error),
        ]
    size = f"{batch} x {channels} x {side}^2"
    with torch.no_grad():
        slow = measure.cpu_time(next(c.call for c in contestants if c.default)) > 3
        results = race(name, size=size, direction="forward", contestants=contestants, seconds=0 if slow else seconds)
    taken = {result["who"]: result for result in results}
    return {
        "augmentation": name,
        "size": size,
        "channels": channels,
        "relatives": [who for who in case.relatives if who in taken],
        "straightforward": case.plain.__doc__,
        "seconds": {who: result["seconds"] for who, result in taken.items()},
        "seconds_iqr": {who: result["seconds_iqr"] for who, result in taken.items()},
        "share_timed": {who: result["share_timed"] for who, result in taken.items() if result["share_timed"] < 1},
        "peak_memory": taken["kcam 1"]["peak_memory"],
        "first_call": taken["kcam 1"]["first_call"],
        "rounds": taken["kcam 1"]["rounds"],
        "difference": taken["straightforward"]["error"].get("largest difference"),
        "added": {f"{p:g}": added(taken, p) for p in (1.0, 0.5) if f"kcam {p:g}" in taken},
    }


def straightforward(
    case: Case, own: Any, picture: Tensor, drawn: dict[str, Tensor], *, coded: bool, truth: Tensor
) -> Contestant:
    """The plain way on the rows that it is run on, with its largest difference from our result."""
    few = max(1, round(case.share * len(picture)))

    def call() -> Tensor:
        light = to_light(picture[:few]) if coded else picture[:few]
        result = case.plain(own, light, {key: value[:few] for key, value in drawn.items()})
        return tone_curve(result) if coded else result

    def difference(result: Tensor) -> dict[str, float]:
        return {"largest difference": float((result - truth[: len(result)]).abs().max())} if case.exact else {}

    return Contestant("straightforward", call, difference, share=few / len(picture))


def no_error(result: Tensor) -> dict[str, float]:
    """Kornia's relatives compute something else, and our own parts are checked in the tests."""
    return {}


def changes_channels(augmentation: Any, channels: int) -> bool:
    """Whether it must have p = 1."""
    known = getattr(augmentation, "output_channels", None)
    return known is not None and known(channels) != channels


def added(taken: dict[str, dict[str, Any]], p: float) -> dict[str, Any]:
    """What stands between our augmentation and an identity of Kornia's plus the maths, beside the maths."""
    whole, effect, nothing = (taken[f"{who} {p:g}"]["seconds"] for who in ("kcam", "kcam simulate", "identity"))
    light = p * taken["light"]["seconds"] if "light" in taken else 0.0  # at p = 0.5 half of the rows are drawn
    extra = whole - nothing - effect - light
    return {
        "seconds": extra,
        "maths": effect + light,
        "share_of_maths": extra / (effect + light),
        "met": extra < effect + light,
        "met_without_light": extra + light < effect,
    }


def main(arguments: list[str] | None = None) -> int:
    """Run the races, print them, and write them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="tiny pictures, for the tests")
    parser.add_argument("--only", help="augmentations whose name contains this; nothing is written")
    parser.add_argument("--aims", action="store_true", help="what the aims are about alone")
    parser.add_argument("--out", type=Path, default=RESULTS)
    options = parser.parse_args(arguments)
    sizes: dict[str, Any] = {"batch": BATCH, "side": SIDE, "seconds": 4.0}
    if options.quick:
        sizes = {"batch": 2, "side": 32, "seconds": 0.0}
    console, lines = Console(), []
    with threads.fixed(1), torch.random.fork_rng():
        for channels in CHANNELS:
            for name, case in CASES.items():
                if channels not in case.only or (options.only and options.only not in name):
                    continue
                if options.aims and (channels != 3 or name not in {aim.name for aim in AIMS}):
                    continue
                line = compare(name, case, channels=channels, **sizes)
                lines.append(line)
                times = ", ".join(f"{who} {1e3 * t:.1f}" for who, t in line["seconds"].items())
                shares = ", ".join(f"p={p}: {found['share_of_maths']:.2f}" for p, found in line["added"].items())
                console.print(f"[bold]{line['augmentation']}[/] {line['size']}: ms: {times}; we add {shares}")
    if options.aims:
        write_json(options.out, {"environment": environment(), "aims": [aim.verdict(lines) for aim in AIMS]})
    elif not options.only:
        few = {"batch": sizes["batch"], "side": sizes["side"]}
        with threads.fixed(1), torch.random.fork_rng():
            found = {
                "aims": [aim.verdict(lines) for aim in AIMS],
                "aims_avx2": [] if options.quick else aims_without_avx512(),
                "run": run(**few, seconds=4 * sizes["seconds"]),
                "pipeline": pipeline(
                    batch=2 * sizes["batch"], side=sizes["side"], batches=2 if options.quick else 8,
                    rounds=1 if options.quick else 5,
                ),
            }  # fmt: skip
        console.print(found)
        write_json(options.out, {"environment": environment(), "lines": lines, **found})
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
