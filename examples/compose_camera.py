"""Compose cameras from stages, look at what each stage hands on, save one and load it again.

    python examples/compose_camera.py [--size 240] [--out cameras.png]
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import torch

from kcam import Camera, Scene, isp, optics, plots, sensor
from kcam.units import mm, um


def make_camera(
    *, colour_filter: sensor.ColourFilter, pattern: str, iso: float = 100.0, white_share: float | None = None
) -> Camera:
    """A small camera, 8 mm at f/2.8, around a colour filter and a mosaic."""
    lens = optics.Lens(
        optics.CircularAperture(diameter=8 * mm / 2.8), optics.ThinLens(focal_length=8 * mm), focus_distance=2.4
    )
    return Camera(
        optics.Imaging(lens, pixel_pitch=2 * um),
        colour_filter,
        sensor.Mosaic(pattern),
        sensor.Exposure(white_share, iso=iso),
        sensor.ShotNoise(full_well=8_000),
        sensor.ReadNoise(2.5),
        sensor.ADC(bits=12, black_level=256),
        isp.Demosaic(),
        isp.WhiteBalance(),
        isp.ColourMatrix(),
        isp.ToneCurve(),
    )


def cameras() -> dict[str, Camera]:
    """The same lens before four sensors."""
    return {
        "Bayer, Nikon curves": make_camera(colour_filter=sensor.ColourFilter.nikon(), pattern="RGGB"),
        "X-Trans, ISO 3200": make_camera(colour_filter=sensor.ColourFilter.nikon(), pattern="x_trans", iso=3200.0),
        "Sigma curves": make_camera(colour_filter=sensor.ColourFilter.sigma(), pattern="GRBG"),
        "RGBW": make_camera(colour_filter=sensor.ColourFilter.rgbw(), pattern="rgbw", white_share=0.27),
    }


def main(arguments: list[str] | None = None) -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=int, default=240, help="longer side of the scene [pixels]")
    parser.add_argument("--out", type=Path, help="a figure of the pictures, such as cameras.png")
    options = parser.parse_args(arguments)
    scene = Scene.builtin("motorcycle", size=options.size)
    print(scene, "\n")

    pictures = []
    with torch.no_grad():
        for name, camera in cameras().items():
            print(name)
            for stage, signal in camera.steps(scene, generator=torch.Generator().manual_seed(0)):
                low, high = signal.aminmax()
                print(f"    {stage:22s} {tuple(signal.shape)!s:20s} {low:7.3f} to {high:6.3f}")
            pictures.append(signal[0])

        # what was saved takes the same picture, bit for bit; a slice of a camera is a camera
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "camera.safetensors"
            camera.save(path)
            loaded = Camera.load(path)
            print(f"\nsaved and loaded: {path.stat().st_size / 1e3:.1f} kB")
        again = loaded(scene, generator=torch.Generator().manual_seed(0))
        print("the same picture:", torch.equal(again[0], pictures[-1]))
        developed = camera[7:](camera.raw(scene, generator=torch.Generator().manual_seed(0)))
        print("raw, then the rest:", torch.equal(developed[0], pictures[-1]))

    if options.out is not None:
        sheet = plots.contact_sheet([pictures], titles=list(cameras()), labels=["8 mm at f/2.8, focused at 2.4 m"])
        plots.save_figure(sheet, options.out)
        print(f"written to {options.out}")


if __name__ == "__main__":
    main()
