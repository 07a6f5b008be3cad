"""The command `kcam`: demo, shoot, psf, explain, calibrate, tradeoff. Only here are quantities strings with units."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from kcam import __version__

if TYPE_CHECKING:
    from kcam import optics
    from kcam.camera import Camera
    from kcam.scene import Scene

UNITS = {"nm": 1e-9, "um": 1e-6, "µm": 1e-6, "mm": 1e-3, "cm": 1e-2, "m": 1.0, "km": 1e3}
app = typer.Typer(add_completion=False, no_args_is_help=True, pretty_exceptions_enable=False)
err = Console(stderr=True, highlight=False, soft_wrap=True)

TOLERANCE = 'simulate only what is needed for this error of the raw: 0.01, or "sensor"; without it, everything'
SeedOption = Annotated[int, typer.Option("--seed", min=0, max=2**63 - 1, help="of the noise")]
CameraOption = Annotated[
    str, typer.Option("--camera", help="thesis, ideal, phone, singlet, or a file that Camera.save wrote")
]


def length(
    text: str,
    *,
    unit: str = "m",
    name: str = "distance",
    expected: str = '2, "50 cm" or inf',
    least: float = 0.0,
    most: float = math.inf,
) -> float:
    """A length in metres from text such as "2", "2 m", "50cm", "550 nm" or "inf".

    Args:      unit: what a bare number is in.
               name: what to call it in an error.  expected: an example for the error.
               least, most: the range that makes sense [m].
    Raises:    ValueError for anything else.
    """
    match = re.fullmatch(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?|inf)\s*([a-zµ]*)\s*", text.lower())
    if not match or match[2] not in {"", *UNITS}:
        raise ValueError(f'{name} "{text}" is not a length: expected e.g. {expected} ({", ".join(UNITS)}).')
    metres = float(match[1]) * UNITS[match[2] or unit]
    if not least <= metres <= most:
        bare = "" if match[2] else f" A number without a unit is in {unit}."
        raise ValueError(f'{name} "{text}" is outside {least:g} m to {most:g} m.{bare} Expected e.g. {expected}.')
    return metres


def lengths(
    text: str, *, unit: str, name: str, expected: str = "1, 2, inf", least: float = 0.0, most: float = math.inf
) -> list[float]:
    """Lengths in metres from text such as "1, 2, inf" or "450,550,650 nm": a unit at the end holds for all."""
    expected = f'"{expected}" with commas'
    items = [item for item in text.split(",") if item.strip()]
    last = re.search(r"[a-zµ]+\s*$", items[-1].lower()) if items else None
    shared = last[0].strip() if last and last[0].strip() in UNITS else unit
    if not items:
        raise ValueError(f'{name} "{text}" is empty: expected e.g. {expected}.')
    return [length(item, unit=shared, name=name, expected=expected, least=least, most=most) for item in items]


def open_camera(name: str) -> Camera:
    """A preset by its name, the demo's singlet, or a saved camera by its path."""
    from kcam.camera import PRESETS, Camera

    if name in PRESETS:
        return Camera.preset(name)
    if name == "singlet":
        from kcam import demo

        return demo.singlet()
    if Path(name).suffix or Path(name).exists():
        return Camera.load(name)
    raise ValueError(
        f'unknown camera "{name}": expected a preset ({", ".join(PRESETS)}, singlet) or a saved .safetensors file.'
    )


def open_scene(name: str, *, size: int) -> Scene:
    """A built-in scene by its name, or a picture by its path, at most `size` pixels long."""
    from kcam.scene import BUILTIN, Scene

    if name in BUILTIN:
        return Scene.builtin(name, size)
    if Path(name).suffix or Path(name).exists():
        return Scene.from_file(name).resized(size)
    raise ValueError(f'unknown scene "{name}": expected one of {", ".join(BUILTIN)}, or a picture file.')


def check_not_too_near(imaging: optics.Imaging, distance: float, *, shape: tuple[int, int]) -> None:
    """ValueError for a distance at which a point's blur is wider than the picture: its light would be lost.

    The blur is the shadow of the aperture, D d (1 / z - 1 / z_focus) wide; inside the focal length no image is real.
    """
    lens = imaging.lens
    width = 2 * float(lens.aperture.semi_aperture().detach())
    per_vergence = width * float(lens.sensor_distance) / imaging.pixel_pitch  # pixels per 1/m
    side = min(*shape, *(imaging.psf_shape or ()))
    focus = 1 / lens.focus_distance
    focal_length = float(lens.focal_length())
    nearest = max(1 / (focus + side / per_vergence), focal_length)
    if distance <= nearest:
        blur = per_vergence * (1 / distance - focus)
        reason = f"a point there blurs over {blur:.0f} pixels, of which there are {side}"
        if distance <= focal_length:
            reason = f"it is inside the focal length of {focal_length * 1e3:.3g} mm, where nothing has an image"
        raise ValueError(
            f'distance {distance:g} m is too near: {reason}. Use --distance "{math.ceil(nearest * 101)} cm" or more.'
        )


@contextmanager
def one_line_errors() -> Iterator[None]:
    """What the user got wrong is one clear line and exit status 2; what we got wrong stays a traceback."""
    try:
        yield
    except (ValueError, TypeError, OSError) as error:
        err.print("[bold red]kcam:[/] ", end="")
        err.print(" ".join(str(error).split()), markup=False)
        raise typer.Exit(2) from error


@contextmanager
def progress(description: str, *, total: int | None = None) -> Iterator[Callable[[str], None]]:
    """A bar on the terminal's standard error; gives a function that says what is being done and moves the bar on."""
    columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=err, transient=True, disable=not err.is_terminal) as bar:
        task = bar.add_task(description, total=total)

        def advance(what: str) -> None:
            bar.update(task, advance=1, description=f"{description}: {what}")

        yield advance


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"kcam {__version__}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="print the version and leave")
    ] = False,
) -> None:
    """A differentiable camera, from the light of a scene to the finished picture."""


@app.command()
def demo(
    out: Annotated[Path, typer.Option("--out", help="folder for the pictures")] = Path("demo"),
    seed: SeedOption = 0,
) -> None:
    """Photograph the built-in scenes with two cameras; write the pictures, the raws and the PSFs as figures."""
    with one_line_errors():
        from kcam import demo as module

        with progress("demo", total=module.STEPS) as advance:
            paths = module.run(out, seed=seed, advance=advance)
        for path in paths:
            typer.echo(path)


@app.command()
def shoot(
    photo: Annotated[Path, typer.Argument(help="a picture: PNG, JPEG, TIFF, ... of 8 or 16 bits")],
    camera: CameraOption = "phone",
    distance: Annotated[str, typer.Option("--distance", help='of the scene, in metres: 2, "50 cm", inf')] = "2 m",
    out: Annotated[Path, typer.Option("--out", help="the picture to write")] = Path("shot.png"),
    seed: SeedOption = 0,
    tolerance: Annotated[str, typer.Option("--tolerance", help=TOLERANCE)] = "",
) -> None:
    """Photograph a photograph: what this camera would have seen at that distance. The picture keeps its size."""
    with one_line_errors():
        import torch

        from kcam import optics, plots
        from kcam.scene import Scene

        plots.check_writable(out)
        if out.exists() and photo.exists() and out.samefile(photo):
            raise ValueError(f"{out} is the photo itself, which would be lost. Choose another name for --out.")
        stages = open_camera(camera)
        scene = Scene.from_file(photo, depth=length(distance))
        for stage in stages:
            if isinstance(stage, optics.Imaging):
                check_not_too_near(stage, length(distance), shape=scene.shape[1:])
        generator = torch.Generator().manual_seed(seed)
        if tolerance:
            with torch.no_grad(), progress("plan"):
                stages = stages.plan(scene, tolerance=as_tolerance(tolerance)).apply(stages)
        with torch.no_grad(), progress("shoot", total=len(stages)) as advance:
            for name, picture in stages.steps(scene, generator=generator):  # noqa: B007 (the last one stays)
                advance(name)
        if picture.shape[1] != 3:
            raise ValueError(f"camera {camera} gives {picture.shape[1]} channels, not a picture. Let it demosaic.")
        plots.write_picture(picture[0].clamp(0, 1), out)
        typer.echo(out)


@app.command()
def psf(
    camera: CameraOption = "thesis",
    out: Annotated[Path, typer.Option("--out", help="the figure to write: .png, .pdf or .svg")] = Path("psf.png"),
    distances: Annotated[str, typer.Option("--distances", help='of the point, in metres: "0.5, 2, inf"')] = "",
    wavelengths: Annotated[
        str, typer.Option("--wavelengths", help='of its light, in nanometres: "450, 550, 650"')
    ] = "",
) -> None:
    """Draw a camera's PSFs over wavelength and distance, its MTF, and its encircled energy."""
    with one_line_errors():
        import torch

        from kcam import optics, plots
        from kcam.units import WAVELENGTH_RANGE

        plots.check_writable(out, suffixes=plots.FIGURE_SUFFIXES)
        least, most = WAVELENGTH_RANGE
        imaging = next((stage for stage in open_camera(camera) if isinstance(stage, optics.Imaging)), None)
        if imaging is None:
            raise ValueError(f"camera {camera} has no lens, so it has no PSF. Try --camera thesis or phone.")
        with torch.no_grad(), progress("psf"):
            figure = plots.psf_figure(
                imaging,
                distances=lengths(distances, unit="m", name="distances") if distances else None,
                wavelengths=lengths(
                    wavelengths, unit="nm", name="wavelengths", expected="450, 550, 650", least=least, most=most
                )
                if wavelengths
                else None,
                title=f"{Path(camera).stem} camera",
            )
        plots.save_figure(figure, out)
        typer.echo(out)


@app.command()
def explain(
    photo: Annotated[str, typer.Argument(help="a picture, or a built-in scene such as motorcycle, which has depth")],
    camera: CameraOption = "phone",
    tolerance: Annotated[str, typer.Option("--tolerance", help='of the raw: 0.01, or "sensor"')] = "0.01",
    distance: Annotated[str, typer.Option("--distance", help='of a picture: 2, "50 cm", inf')] = "2 m",
    size: Annotated[int, typer.Option("--size", min=0, help="of the longer side [pixels]; 0: as it is")] = 0,
    measure: Annotated[bool, typer.Option("--measure", help="also the true error and times")] = False,
    out: Annotated[Path | None, typer.Option("--out", help="save the plan, as JSON")] = None,
) -> None:
    """Say which effects a camera must simulate for a scene, within a tolerance, and what the others would cost."""
    with one_line_errors():
        import torch

        from kcam import planner
        from kcam.scene import BUILTIN, Scene

        stages = open_camera(camera)
        if photo in BUILTIN:
            scene = Scene.builtin(photo, size or None)
        else:
            scene = Scene.from_file(photo, depth=length(distance))
            scene = scene.resized(size) if size else scene
        with torch.no_grad(), progress("explain"):
            plan = planner.explain(stages, scene, tolerance=as_tolerance(tolerance), measure=measure)
        typer.echo(plan)
        if out is not None:
            plan.save(out)
            typer.echo(out)


def as_tolerance(text: str) -> float | str:
    """A number, or "sensor". Raises: ValueError for anything else."""
    if text == "sensor":
        return text
    try:
        return float(text)
    except ValueError:
        raise ValueError(f'tolerance "{text}" is no relative error: expected e.g. 0.01, or sensor.') from None


@app.command()
def calibrate() -> None:
    """Measure how fast this machine computes, half a minute, so that plans predict its times; kept in a file."""
    with one_line_errors():
        from kcam.planner import costs

        with progress("calibrate") as advance:
            rates, off = costs.calibrate(advance=advance)
        path = costs.save_rates(rates)
        typer.echo(f"predictions of single pictures are off by a factor of {off:.2f} in the median")
        typer.echo(path)


@app.command()
def tradeoff(
    camera: CameraOption = "singlet",
    scene: Annotated[
        str,
        typer.Option(
            "--scene", help="a built-in scene or a picture; motorcycle, with depth, unless the lens has a DOE"
        ),
    ] = "",
    size: Annotated[int, typer.Option("--size", help="of the scene's longer side [pixels]")] = 128,
    out: Annotated[Path, typer.Option("--out", help="folder for tradeoff.json and tradeoff.png")] = Path("tradeoff"),
    thorough: Annotated[bool, typer.Option("--thorough", help="more settings; 15 minutes rather than 3")] = False,
) -> None:
    """Measure what accuracy costs in time: turn every knob of a camera, and compare with the reference."""
    with one_line_errors():
        from kcam import plots
        from kcam import tradeoff as module

        stages = open_camera(camera)
        name = scene or ("coffee" if any(_is_doe(part) for part in stages.modules()) else "motorcycle")
        light = open_scene(name, size=size)
        out.mkdir(parents=True, exist_ok=True)
        with progress("tradeoff") as advance:
            measured = module.sweep(
                stages, light, thorough=thorough, advance=advance, title=f"{Path(camera).stem} on {Path(name).stem}"
            )
        measured.save(out / "tradeoff.json")
        result = module.Sweep.load(out / "tradeoff.json")  # the file rounds: what is shown is what stands there
        plots.save_figure(plots.tradeoff_figure(result), out / "tradeoff.png")
        Console(width=max(116, err.width)).print(result.table())
        typer.echo(f"\n{result.sentence()}\n\n{out / 'tradeoff.json'}\n{out / 'tradeoff.png'}")


def _is_doe(part: object) -> bool:
    """Flat pixels make a PSF some ten times as slow; with a PSF for every depth a sweep would take half an hour."""
    from kcam import optics

    return isinstance(part, optics.DOE)


def main() -> None:
    """Entry point of the command `kcam`."""
    app()
