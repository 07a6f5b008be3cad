"""The command `kcam`: demo, shoot, psf, lens, explain, calibrate, calibrate-sensor, tradeoff, train, paint, data.

Only here are quantities strings with units.
"""

from __future__ import annotations

import math
import os
import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from kcam import __version__, memory
from kcam.cli.calibration import calibrate_sensor
from kcam.cli.console import CAMERAS, complain, err, losses, one_line_errors, progress
from kcam.cli.data import app as data_app
from kcam.cli.report import report

if TYPE_CHECKING:
    from kcam.camera import Camera
    from kcam.optics import CompoundLens
    from kcam.scene import Scene
    from kcam.style import Progress

UNITS = {"nm": 1e-9, "um": 1e-6, "µm": 1e-6, "mm": 1e-3, "cm": 1e-2, "m": 1.0, "km": 1e3}
app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # "rich" would take [pixels] for a style, and drop it
)
app.add_typer(data_app, name="data")
app.command()(report)

TOLERANCE = 'simulate only what is needed for this error of the raw: 0.01, or "sensor"; 0: the reference physics'
FeaturesOption = Annotated[str, typer.Option("--features", help="steerable, or vgg16 with --vgg-weights")]
WeightsOption = Annotated[str, typer.Option("--vgg-weights", help="torchvision's vgg16-397923af.pth")]
StyleSizeOption = Annotated[
    int, typer.Option("--style-size", min=0, help="shrink the style to this longer side [pixels]; 0: as it is")
]
SeedOption = Annotated[int, typer.Option("--seed", min=0, max=2**63 - 1, help="of the noise")]
CameraOption = Annotated[str, typer.Option("--camera", help=CAMERAS)]


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


def open_lens(name: str, *, focus: str) -> CompoundLens:
    """A preset by its name, or a prescription by its path, focused at a distance; of a file "" is its own."""
    from kcam.optics import CompoundLens
    from kcam.optics.compound.files import SUFFIXES
    from kcam.optics.compound.presets import PRESETS

    if Path(name).suffix.lower() in SUFFIXES:
        return CompoundLens.from_file(name, focus_distance=length(focus, name="focus") if focus else None)
    if name in PRESETS:
        return CompoundLens.preset(name, focus_distance=length(focus or "inf", name="focus"))
    raise ValueError(
        f'unknown lens "{name}": expected a preset ({", ".join(sorted(PRESETS))}) or a file that ends in '
        f"{' or '.join(SUFFIXES)}."
    )


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

        with progress("demo", module.STEPS) as advance:
            paths = module.run(out, seed=seed, advance=advance)
        for path in paths:
            typer.echo(path)


@app.command()
def shoot(
    photos: Annotated[
        list[Path], typer.Argument(help="pictures: PNG, JPEG, TIFF, ... of 8 or 16 bits; folders for all in them")
    ],
    camera: CameraOption = "phone",
    distance: Annotated[str, typer.Option("--distance", help='of the scene, in metres: 2, "50 cm", inf')] = "2 m",
    out: Annotated[
        Path, typer.Option("--out", help="the picture to write; of several photos, or of a folder, the folder")
    ] = Path("shot.png"),
    seed: SeedOption = 0,
    size: Annotated[
        int, typer.Option("--size", min=0, help="longer side [pixels]: strokes do not shrink with it; 0: as it is")
    ] = 0,
    tolerance: Annotated[str, typer.Option("--tolerance", help=TOLERANCE)] = "0.01",
) -> None:
    """Photograph photographs: what this camera would have seen at that distance. A picture keeps its size.

    Of each it names the file, and in a line below what was left out.
    """
    with one_line_errors():
        from kcam import shoot as module

        stages = open_camera(camera)
        how: dict[str, Any] = {
            "distance": length(distance),
            "seed": seed,
            "size": size or None,
            "tolerance": as_tolerance(tolerance),
        }
        pairs = module.outputs(photos, out)
        failed = []
        with progress("shoot", len(pairs)) as advance:
            for photo, target in pairs:
                try:
                    plan = module.shoot(stages, photo, target, **how)
                except (ValueError, OSError) as error:
                    if len(pairs) == 1:
                        raise
                    failed.append(str(error) if photo.name in str(error) else f"{photo.name}: {error}")
                else:
                    typer.echo(f"{target}\n  {plan.summary()}")
                advance(photo.name)
        for reason in failed:
            complain(reason)
        if failed:
            complain(f"{len(failed)} of {len(pairs)} photos could not be taken.")
            raise typer.Exit(2)


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
def lens(
    name: Annotated[str, typer.Argument(help="a preset such as cooke_triplet or ef50, or a .zmx or .json file")],
    focus: Annotated[
        str, typer.Option("--focus", help='what is in focus, in metres: 2, "50 cm"; else inf, or as the file says')
    ] = "",
    distance: Annotated[str, typer.Option("--distance", help="of the points; else that of --focus, or inf")] = "",
    field: Annotated[
        float, typer.Option("--field", help="largest Y / D; else a preset's own, or where a fifth of the light is left")
    ] = 0.0,
    wavelengths: Annotated[str, typer.Option("--wavelengths", help='in nanometres: "486, 546, 656"')] = "",
    frequency: Annotated[float, typer.Option("--frequency", help="of the MTF [line pairs per mm]")] = 30.0,
    refocus: Annotated[
        bool, typer.Option("--refocus", help="move the sensor to the least rms spot on the axis")
    ] = False,
    out: Annotated[Path, typer.Option("--out", help="the figure to write: .png, .pdf or .svg")] = Path("lens.png"),
) -> None:
    """Say and draw what a real lens does: its section, and spots, wavefronts, illumination and MTF over its field."""
    with one_line_errors():
        import torch

        from kcam import plots
        from kcam.optics.compound.presets import PRESETS
        from kcam.units import WAVELENGTH_RANGE, mm

        plots.check_writable(out, suffixes=plots.FIGURE_SUFFIXES)
        least, most = WAVELENGTH_RANGE
        if not 0 <= field < math.inf:
            raise ValueError(f"field {field:g} is no height Y / D: expected e.g. 0.36, which is 19.8 degrees.")
        if not 0 < frequency < math.inf:
            raise ValueError(f"frequency {frequency:g} is none: expected line pairs per mm > 0, such as 30.")
        colours = None
        if wavelengths:
            colours = lengths(wavelengths, unit="nm", name="wavelengths", expected="486, 656", least=least, most=most)
        shown = open_lens(name, focus=focus)
        away = length(distance or focus or "inf")
        with torch.no_grad(), progress("lens"):
            if refocus:
                before = float(shown.sensor_distance)
                shown = shown.refocus("rms", distance=away, wavelengths=colours)
                typer.echo(f"sensor moved by {(float(shown.sensor_distance) - before) / mm:+.4f} mm")
            meant = PRESETS[name].field if name in PRESETS else math.inf  # beyond it a phone's blur has no MTF left
            edge = field or min(meant, shown.field_limit(distance=away))
            curves = shown.field_curves(
                torch.linspace(0, edge, 11, dtype=torch.float64),
                wavelengths=colours,
                distance=away,
                frequencies=[frequency / 3 / mm, frequency / mm],
            )
            figure = plots.lens_figure(shown, curves, distance=away, title=Path(name).stem)
        typer.echo(f"{plots.lens_text(shown)}\n\n{curves}\n")
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

        from kcam import files, planner
        from kcam.scene import BUILTIN, Scene

        if out is not None:
            files.check_place(out)
            files.check_other(out, photo)
        stages = open_camera(camera)
        if photo in BUILTIN:
            scene = Scene.builtin(photo, size or None)
        else:
            scene = replace(Scene.from_file(photo), depth=length(distance))
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


app.command("calibrate-sensor", context_settings={"allow_extra_args": True})(calibrate_sensor)


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


@app.command()
def train(
    style: Annotated[
        str,
        typer.Argument(help="a picture, or strokes, mosaic, woodcut, watercolour, pointillism, hatching: kcam's own"),
    ],
    out: Annotated[Path, typer.Option("--out", help="the camera to write; its run's folder stands beside it")] = Path(
        "styled.safetensors"
    ),
    preset: Annotated[str, typer.Option("--preset", help="pieces, quick, standard or thesis")] = "pieces",
    photos: Annotated[
        str,
        typer.Option("--photos", help="a folder of your own photographs to train on; else kcam's few built-in ones"),
    ] = "",
    patches: Annotated[
        str, typer.Option("--patches", help="a patch store of spectral cubes to train on, in place of photographs")
    ] = "",
    camera: Annotated[str, typer.Option("--camera", help="a saved camera to start from")] = "",
    stage: Annotated[
        bool, typer.Option("--stage/--no-stage", help="with what paints behind it, or the camera alone")
    ] = True,
    features: FeaturesOption = "steerable",
    vgg_weights: WeightsOption = "",
    style_size: StyleSizeOption = 0,
    steps: Annotated[int, typer.Option("--steps", min=0, help="0: the preset's")] = 0,
    batch: Annotated[int, typer.Option("--batch", min=0, help="scenes per step; 0: the preset's")] = 0,
    size: Annotated[int, typer.Option("--size", min=0, help="of the crops [pixels]; 0: the preset's")] = 0,
    content: Annotated[float, typer.Option("--content", help="weight of the scene; -1: the preset's")] = -1.0,
    tolerance: Annotated[
        float, typer.Option("--tolerance", min=0.0, help="train through a plan within this error; 0: the reference")
    ] = 0.0,
    seed: Annotated[int, typer.Option("--seed", min=0, max=2**63 - 1, help="of scenes, crops and noise")] = 0,
    device: Annotated[str, typer.Option("--device", help="cpu or cuda")] = "cpu",
    threads: Annotated[int, typer.Option("--threads", min=0, help="0: the cores that are free")] = 0,
    resume: Annotated[bool, typer.Option("--resume", help="go on from the last checkpoint")] = False,
    profile: Annotated[bool, typer.Option("--profile", help="print where a step's time goes")] = False,
    card: Annotated[
        str, typer.Option("--card", help="a folder to write, ready for a hub: the camera, README.md, pictures")
    ] = "",
    licence: Annotated[str, typer.Option("--licence", help="of the style, for the camera's card")] = "",
) -> None:
    """Train a camera to take its pictures in the manner of a painting."""
    with one_line_errors():
        from kcam import train as module
        from kcam.style import TrainingError

        options = module.Options(
            style=style,
            out=str(out),
            preset=preset,
            patches=patches or None,
            photos=photos or None,
            camera=camera or None,
            features=features,
            vgg_weights=vgg_weights or None,
            stage=stage,
            style_size=style_size or None,
            steps=steps or None,
            batch=batch or None,
            size=size or None,
            content=None if content < 0 else content,
            tolerance=tolerance or None,
            seed=seed,
            device=device,
        )
        leads = os.environ.get("RANK", "0") == "0"  # of the processes that torchrun starts, one speaks
        with progress("step") as advance:

            def one(step: Progress, steps: int) -> None:
                advance(losses(step.terms), steps, done=step.step)

            try:
                trained = module.run(
                    options,
                    resume=resume,
                    threads=threads or None,
                    folder_of_card=card or None,
                    licence=licence or None,
                    advance=one if leads else None,
                    say=lambda text: err.print(text, markup=False) if leads else None,
                )
            except TrainingError as error:
                raise ValueError(str(error)) from error
        if profile and leads:
            done = sum(trained.profile.values())
            for part, seconds in trained.profile.items():
                typer.echo(f"{part:10} {seconds / max(1, trained.steps_timed):8.3f} s a step  {seconds / done:4.0%}")
        if trained.finished and leads:
            typer.echo(f"{out}\n{out.with_suffix('.md')}\n{out.with_suffix('')}/report.html")
        if not trained.finished:
            raise typer.Exit(3)


@app.command()
def paint(
    photo: Annotated[str, typer.Argument(help="what the picture shows; without one, a texture of the style")] = "",
    style: Annotated[
        str,
        typer.Option("--style", help="a picture, or strokes, mosaic, woodcut, watercolour, pointillism, hatching"),
    ] = "strokes",
    out: Annotated[Path, typer.Option("--out", help="the picture to write")] = Path("painted.png"),
    by: Annotated[
        str,
        typer.Option("--by", help="pieces of the style, in seconds; or loss: the picture itself is optimised"),
    ] = "",
    start: Annotated[str, typer.Option("--start", help="by loss: photo, or noise: from what to paint")] = "",
    features: FeaturesOption = "steerable",
    vgg_weights: WeightsOption = "",
    style_size: StyleSizeOption = 0,
    size: Annotated[int, typer.Option("--size", min=64, help="longer side of the painting, at most [pixels]")] = 512,
    steps: Annotated[int, typer.Option("--steps", min=0, help="by loss: of the optimiser; 0: 200")] = 0,
    content: Annotated[
        float, typer.Option("--content", help="by loss: weight of what the photo shows; -1: 0.3")
    ] = -1.0,
    seed: SeedOption = 0,
) -> None:
    """Paint a photograph in the manner of a style: with pieces of it, or by a loss, as a texture of the style alone is.

    Any option that is of the loss, or no photograph, means --by loss.
    """
    with one_line_errors():
        import torch

        from kcam import files, isp, plots, train
        from kcam.scene import read_picture
        from kcam.style import StyleLoss
        from kcam.style import paint as optimise

        of_loss = [
            name
            for name, given in (
                ("--start", start), ("--features", features != "steerable"), ("--vgg-weights", vgg_weights),
                ("--steps", steps), ("--content", content >= 0),
            )
            if given
        ]  # fmt: skip
        by = by or ("loss" if of_loss or not photo else "pieces")
        if by not in ("pieces", "loss"):
            raise ValueError(f'unknown way to paint "{by}": expected pieces or loss.')
        if by == "pieces" and (of_loss or not photo):
            raise ValueError(
                f"--by pieces takes no {of_loss[0]}." if of_loss else "--by pieces needs a photograph to paint."
            )
        plots.check_writable(out)
        for given in (photo, style):
            files.check_other(out, given)
        picture = train.style_picture(style, size=style_size or None)
        shown = train.shrunk(read_picture(photo).expand(3, -1, -1), size) if photo else None
        if by == "pieces" and shown is not None:
            with torch.no_grad():
                generator = torch.Generator().manual_seed(seed)
                painted = isp.texture_transfer(shown[None], exemplar=picture, generator=generator)[0]
        else:
            layers = train.style_features(features, vgg_weights or None)
            weight = 0.3 if content < 0 else content
            loss = StyleLoss(picture, features=layers, content=weight if photo else 0.0, colour=1.0)
            with progress("step", steps or 200) as advance:
                painted = optimise(
                    loss,
                    photo=shown,
                    shape=(size, size),
                    start=start or None,
                    steps=steps or 200,
                    seed=seed,
                    advance=lambda _, terms: advance(losses(terms)),
                )
        plots.write_picture(painted, out)
        typer.echo(out)


def main() -> None:
    """Entry point of the command `kcam`."""
    memory.keep()
    app()
