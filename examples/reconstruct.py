"""Sharpen a photograph that is out of focus, by the camera's own operator: Wiener's filter, and total variation.

    python examples/reconstruct.py [--size 256] [--steps 150] [--out reconstructed.png]

Both know the camera and see nothing but its raw signal, with all its noise. Wiener's filter is closed and takes
milliseconds, but one PSF for all of a demosaiced picture; total variation takes the mosaic as it is, and would take
depth or a lens whose PSF varies over the field.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from time import perf_counter

import torch
from torch import Tensor
from torch.nn.functional import pad

from kcam import Camera, Scene, isp, optics, plots, sensor
from kcam.linear import LinearCamera
from kcam.units import mm, nm, um

FULL_WELL, READ_NOISE = 10_000, 3.0  # electrons
DEMOSAICED = 3.0  # what a demosaic is off by, with the noise that it spreads, in sigmas of the noise
WEIGHT, RATIO = 30.0, 10.0  # of total variation, in variances of the noise; of its steps in light and in raw
DETAIL = (0.12, 0.3, 0.3)  # of the details: top and left, and their side (shares of the picture)


def camera() -> Camera:
    """50 mm f/10, focused at 1.7 m: what stands at 2 m is blurred over six pixels."""
    lens = optics.Lens(
        optics.CircularAperture(5 * mm), optics.PlanoConvexLens(25.8 * mm, glass="N-BK7"), focus_distance=1.7
    )
    return Camera(
        optics.Imaging(lens, pixel_pitch=4 * um),
        sensor.ColourFilter.kodak(infrared_cut=680 * nm),
        sensor.Mosaic("RGGB"),
        sensor.Exposure(),
        sensor.ShotNoise(full_well=FULL_WELL),
        sensor.ReadNoise(READ_NOISE),
        sensor.ADC(bits=12),
        isp.Demosaic(),
        isp.WhiteBalance(),
        isp.ColourMatrix(),
        isp.ToneCurve(),
    )


def sigma(raw: Tensor) -> float:
    """Of the noise of a raw signal, in its mean: photons and read-out."""
    return math.sqrt(float(raw.mean().clamp(min=0)) / FULL_WELL + (READ_NOISE / FULL_WELL) ** 2)


def wiener(channels: Tensor, A: LinearCamera, *, noise: float) -> Tensor:
    """X = (H^T H + N / S)^-1 H^T Y at each frequency, H what three channels see of three planes of light.

    channels: (1, 3, H, W) of a sensor without a mosaic, as is A. N is white and S falls as 1 / f^2, as pictures' do. A
    border that reflects is that of a picture with a period of 2 n - 2.
    """
    height, width = channels.shape[-2:]
    around = (0, width - 2, 0, height - 2)
    point = torch.zeros(3, 3, height, width)
    point[range(3), range(3), height // 2, width // 2] = 1  # one in each plane
    psfs = pad(A(point), around).roll((-(height // 2), -(width // 2)), (-2, -1))
    H = torch.fft.rfft2(psfs).permute(2, 3, 1, 0)
    Y = torch.fft.rfft2(pad(channels, around, mode="reflect")).permute(2, 3, 1, 0)
    squares = torch.fft.fftfreq(psfs.shape[-2])[:, None] ** 2 + torch.fft.rfftfreq(psfs.shape[-1]) ** 2
    signal = channels.var() / (squares + 1e-4) / (1 / (squares + 1e-4)).mean()
    normal = H.mH @ H + (noise**2 / signal)[..., None, None] * torch.eye(3)
    X = torch.linalg.solve(normal, H.mH @ Y).permute(3, 2, 0, 1)
    return torch.fft.irfft2(X, s=psfs.shape[-2:])[..., :height, :width]


def gradient(x: Tensor) -> Tensor:
    """Differences to the next pixel below and to the right, (2, *x.shape)."""
    return torch.stack([pad(x.diff(dim=-2), (0, 0, 0, 1)), pad(x.diff(dim=-1), (0, 1))])


def divergence(g: Tensor) -> Tensor:
    """The transpose of `gradient`, less its sign."""
    down, across = g[0, ..., :-1, :], g[1, ..., :-1]
    return pad(down, (0, 0, 0, 1)) - pad(down, (0, 0, 1, 0)) + pad(across, (0, 1)) - pad(across, (1, 0))


def total_variation(y: Tensor, A: LinearCamera, *, weight: float, steps: int) -> Tensor:
    """min over x >= 0 of |A x - y|^2 / 2 + weight |grad x|, planes together: Chambolle and Pock 2011, algorithm 1."""
    x = ahead = A.adjoint(y) / A.norm() ** 2
    p, q = torch.zeros_like(y), torch.zeros_like(gradient(x))
    length = math.sqrt(1.02 * A.norm() ** 2 + 8)  # |grad|^2 <= 8
    rise, fall = 1 / (RATIO * length), RATIO / length  # light is that much larger than what is left of the raw
    for _ in range(steps):
        p = (p + rise * (A(ahead) - y)) / (1 + rise)
        q = q + rise * gradient(ahead)
        q = q / (q.square().sum((0, 2), keepdim=True).sqrt() / weight).clamp(min=1)
        before, x = x, (x - fall * (A.adjoint(p) - divergence(q))).clamp(min=0)
        ahead = 2 * x - before
    return x


def psnr(picture: Tensor, true: Tensor) -> float:
    """Of sRGB in [0, 1] [dB]."""
    return float(-10 * (picture - true).square().mean().log10())


def pictures(size: int, steps: int) -> tuple[dict[str, Tensor], dict[str, float]]:
    """sRGB pictures (1, 3, H, W) by name, and the seconds that reconstructions took."""
    scene, shooter = Scene.builtin("astronaut", size=size), camera()
    generator = torch.Generator().manual_seed(0)
    A = shooter.linear(scene)
    raw = shooter.raw(scene, generator=generator) - A.offset
    found, seconds = {"True": scene.to_srgb(), "The camera's": shooter[7:](raw)}, {}

    start = perf_counter()
    whole = Camera(*(stage for stage in shooter if not isinstance(stage, sensor.Mosaic))).linear(scene)
    channels = isp.demosaic(raw, pattern="RGGB")
    found["Wiener"] = A.scene(wiener(channels, whole, noise=DEMOSAICED * sigma(raw))).to_srgb()
    seconds["Wiener"] = perf_counter() - start

    start = perf_counter()
    x = total_variation(raw, A, weight=WEIGHT * sigma(raw) ** 2, steps=steps)
    found["Total variation"] = A.scene(x).to_srgb()
    seconds["Total variation"] = perf_counter() - start
    return found, seconds


def main(arguments: list[str] | None = None) -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=int, default=256, help="longer side of the scene [pixels]")
    parser.add_argument("--steps", type=int, default=150, help="of total variation")
    parser.add_argument("--out", type=Path, help="a figure of the pictures, such as reconstructed.png")
    options = parser.parse_args(arguments)
    with torch.no_grad():
        found, seconds = pictures(options.size, options.steps)
    true = found["True"]
    for name, picture in found.items():
        if name != "True":
            took = f"   {seconds[name]:6.2f} s" if name in seconds else ""
            print(f"{name:<16} {psnr(picture, true):5.2f} dB{took}")
    if options.out is not None:
        top, left, side = (round(share * options.size) for share in DETAIL)
        details = [picture[0, :, top : top + side, left : left + side] for picture in found.values()]
        sheet = plots.contact_sheet(
            [[picture[0] for picture in found.values()], details], titles=list(found), labels=["", ""]
        )
        plots.save_figure(sheet, options.out)
        print(f"written to {options.out}")


if __name__ == "__main__":
    main()
