"""What `kcam train` does: a run with its folder, its pictures and its report."""

from __future__ import annotations

import hashlib
import importlib
import json
import os
import signal
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, TypedDict

import torch
from torch import Tensor

from kcam import __version__, card, files, isp, plots, report, style
from kcam.camera import PAINTING, Camera
from kcam.inputs import named
from kcam.plain import from_json
from kcam.scene import Scene, read_picture
from kcam.style.processes import joined, place, told_by_the_first
from kcam.threads import fixed, free_cores

fcntl: Any = importlib.import_module("fcntl") if os.name == "posix" else None

SHOWN = ("astronaut", "coffee", "chelsea")
SHOWN_SIZE = 256
WHAT_BRINGS = (
    "A camera alone can bring the colours of a style, not its strokes: its optics only take detail away, its filter "
    "and matrix act on each pixel. What brings strokes stands behind it: pieces of the style itself, or a network."
)
FEATURES = ("steerable", "vgg16")


@dataclass(frozen=True)
class Options:
    """What a user chooses; `None` leaves it to the preset.

    style: a picture's path, or the name of one of `kcam.style.STYLES`. out: the camera to write, .safetensors; beside
    it stands a folder of its name with checkpoints, pictures and the report. patches: a patch store; photos: a folder
    of photographs; neither: the built-in scenes. camera: a saved one to start from. features: "steerable" or "vgg16",
    with vgg_weights. stage: False takes off what paints, network or pieces. style_size: longer side that the style is
    shrunk to; None: as it is.
    """

    style: str
    out: str = "styled.safetensors"
    preset: str = "pieces"
    patches: str | None = None
    photos: str | None = None
    camera: str | None = None
    features: str = "steerable"
    vgg_weights: str | None = None
    stage: bool = True
    style_size: int | None = None
    steps: int | None = None
    batch: int | None = None
    size: int | None = None
    content: float | None = None
    tolerance: float | None = None
    seed: int = 0
    device: str = "cpu"


def style_picture(name: str, *, size: int | None = None) -> Tensor:
    """A style, (3,H,W): a picture file, or one of the paintings that kcam makes itself.

    Raises:    FileNotFoundError, ValueError for what is neither, or a size that would enlarge it.
    """
    if name in style.STYLES:
        picture = style.painting(name)
    elif Path(name).suffix or Path(name).exists():
        picture = read_picture(name).expand(3, -1, -1)
    else:
        raise ValueError(f'unknown style "{name}": expected a picture file, or one of {", ".join(style.STYLES)}.')
    longest = max(picture.shape[-2:])
    if size is not None and not 1 <= size <= longest:
        raise ValueError(f"style size {size} is not within 1..{longest}, what the style has: strokes are not enlarged.")
    return picture.contiguous() if size is None else shrunk(picture, size)


def shrunk(picture: Tensor, size: int) -> Tensor:
    """A picture (3,H,W) whose longer side has at most `size` pixels; colours are filtered in linear light."""
    if max(picture.shape[-2:]) <= size:
        return picture.contiguous()
    return Scene.from_rgb(picture).resized(size).to_srgb()[0].clamp(0, 1)


def run(
    options: Options,
    *,
    resume: bool = False,
    threads: int | None = None,
    advance: Callable[[style.Progress, int], None] | None = None,
    say: Callable[[str], None] = lambda text: None,
    folder_of_card: str | os.PathLike[str] | None = None,
    licence: str | None = None,
) -> style.Trained:
    """Train a camera: sheet and loss curve at every checkpoint; at the end the camera, its card and a report.

    Killed at any moment, a run with the same options and `resume` ends in the same camera, bit for bit. Ctrl-C and
    SIGTERM end it after the step, with a checkpoint. Under torchrun the processes share the batch.

    Args:      threads: None for the cores that are free, or with `resume` as many as the run began with.
               advance: called after each step with the number of all steps.
               say: called with lines that a user should read.
               folder_of_card: where to put the camera with its card, ready for a hub.
               licence: of the style; with `resume` None for that which the run began with.
    Raises:    as `kcam.style.fit`; ValueError for options that do not fit together or another run's folder.
    """
    out = Path(options.out)
    plots.check_writable(out, suffixes=(".safetensors",))
    files.check_other(out, options.camera)
    card.check_own(out.with_suffix(".md"))
    if folder_of_card is not None:
        card.check_folder(folder_of_card, run=out.with_suffix(""))
    if options.device not in ("cpu", "cuda") or (options.device == "cuda" and not torch.cuda.is_available()):
        raise ValueError(f'cannot train on "{options.device}": expected cpu, or cuda where torch finds a GPU.')
    folder = out.with_suffix("")
    if options.preset not in style.PRESETS:
        raise ValueError(f'unknown preset "{options.preset}"; there are: {", ".join(style.PRESETS)}.')
    picture = style_picture(options.style, size=options.style_size)
    features = style_features(options.features, options.vgg_weights)
    preset = style.PRESETS[options.preset]
    source = _source(options, preset)
    document: dict[str, Any] = {"options": asdict(options), "style": _hash(picture)}
    if isinstance(source, style.PhotoScenes):
        document["photos"] = source.mark
        for line in named("skipped", source.skipped):
            say(line)
    with ExitStack() as stack:
        leads, device = stack.enter_context(joined(options.device))
        licence = licence or _begun_licence(folder, resume)
        if licence:
            document["licence"] = licence
        document["threads"] = told_by_the_first(_threads(folder, resume, threads), place()[1])
        stack.enter_context(fixed(document["threads"]))
        if leads:  # the others would meet what this one has begun to write
            stack.enter_context(_alone(folder))
            _check_folder(folder, document, resume=resume)
        camera = _camera(options, preset).to(device)
        changes = {name: getattr(options, name) for name in ("steps", "batch", "size", "tolerance")}
        settings = preset.for_scenes(
            len(source), seed=options.seed, **{name: value for name, value in changes.items() if value is not None}
        )
        if min(picture.shape[-2:]) < settings.size:
            say(
                f"the style has {picture.shape[-1]} x {picture.shape[-2]} pixels, less than the {settings.size} x "
                f"{settings.size} that are trained on: what is wider is not learned, and pieces repeat. A larger "
                "picture paints better, not an enlarged one."
            )
        weights = {} if options.content is None else {"content": options.content}
        loss = preset.style_loss(picture.to(device), features=features.to(device), crop=settings.size, **weights).to(
            device
        )
        paints = isp.TextureTransfer(picture).to(device) if preset.pieces and options.stage else None
        start = _camera(options, preset)
        scenes = [Scene.builtin(name, SHOWN_SIZE).with_depth(2.0).to(device=device) for name in SHOWN]
        if leads:
            settled = document | {"settings": asdict(settings), "kcam": __version__, "torch": torch.__version__}
            files.replace(folder / "config.json", (json.dumps(settled, indent=1) + "\n").encode())

        figures: dict[str, Any] = {}  # of the last checkpoint

        def show(camera: Camera, step: int, history: Tensor) -> None:
            whole = _with(camera, paints)
            figures.update(
                _show(whole, step, history, folder=folder, picture=picture, scenes=scenes, start=start, loss=loss)
            )

        with warnings.catch_warnings(), _stopping() as stopped:
            warnings.showwarning = lambda message, *_: say(str(message))  # type: ignore[assignment]
            trained = style.fit(
                camera,
                loss,
                source=source,
                settings=settings,
                folder=folder / "checkpoints",
                resume=resume,
                advance=None if advance is None else lambda progress: advance(progress, settings.steps),
                on_checkpoint=show,
                stop=stopped,
            )
        if leads and trained.finished:
            if not figures:  # nothing was left to train
                show(trained.camera, len(trained.history), trained.history)
            trained = replace(trained, camera=_with(trained.camera, paints))
            trained.camera.cpu().save(out)
            _write_report(folder / "report.html", options, settings, trained, figures)
            told = _card(options, settings, trained, figures["pictures"], loss, licence)
            card.write(told, out, folder)
            if folder_of_card is not None:
                card.write_folder(told, out, folder, Path(folder_of_card))
        elif leads:
            say(f"stopped after {len(trained.history)} of {settings.steps} steps; go on with --resume")
    return trained


def _show(
    camera: Camera,
    step: int,
    history: Tensor,
    *,
    folder: Path,
    picture: Tensor,
    scenes: Sequence[Scene],
    start: Camera,
    loss: style.StyleLoss,
) -> dict[str, Any]:
    """Draw the contact sheet and the loss curve of a checkpoint into the folder."""
    names = ("total", *(name for name, weight in loss.weights.items() if weight))
    pictures = [report.photographed(camera, scene) for scene in scenes]
    figures = {
        "sheet": report.style_sheet(camera, style=picture, scenes=scenes, step=step, start=start, pictures=pictures),
        "loss": report.loss_figure(history, names),
    }
    for name, figure in figures.items():
        plots.save_figure(figure, folder / f"{name}.png")
    return figures | {"pictures": pictures}


def _camera(options: Options, preset: style.Preset) -> Camera:
    """What is to be trained."""
    camera = preset.camera() if options.camera is None else Camera.load(options.camera)
    off = PAINTING if preset.pieces or not options.stage else (isp.TextureTransfer,)
    return Camera(*(stage for stage in camera if not isinstance(stage, off)), context=camera.context)


def _with(camera: Camera, paints: isp.TextureTransfer | None) -> Camera:
    return camera if paints is None else Camera(*camera, paints, context=camera.context)


def _source(options: Options, preset: style.Preset) -> style.Source:
    size = options.size or preset.settings.size
    if options.patches is not None and options.photos is not None:
        raise ValueError("patches and photos both say what to train on. Leave one of them out.")
    if options.patches is not None:
        return style.PatchScenes(options.patches, size=size)
    return style.BuiltinScenes(size) if options.photos is None else style.PhotoScenes(options.photos, size)


def style_features(name: str, weights: str | None = None) -> Any:
    """Features by name. Raises: ValueError for an unknown one, or weights that are missing or too many."""
    if name not in FEATURES:
        raise ValueError(f'unknown features "{name}"; there are: {", ".join(FEATURES)}.')
    if name == "steerable":
        if weights is not None:
            raise ValueError("--vgg-weights are for --features vgg16; the steerable features have none.")
        return style.SteerableFeatures()
    if weights is None:
        raise ValueError(
            "--features vgg16 needs --vgg-weights: the path of torchvision's vgg16-397923af.pth. Nothing is "
            "downloaded; --features steerable works without weights."
        )
    return style.VGG16Features(weights)


def _hash(picture: Tensor) -> str:
    return hashlib.sha256(picture.contiguous().numpy().tobytes()).hexdigest()[:16]


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Hold a run's folder, which is made if need be, so that no other process writes there."""
    folder.mkdir(exist_ok=True)
    if fcntl is None:
        yield
        return
    held = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            message = f"another process is training in {folder}. Wait for it, or choose another --out."
            raise ValueError(message) from None
        yield  # outside of the clause: what goes wrong in training is not the lock
    finally:
        os.close(held)


def _check_folder(folder: Path, document: dict[str, Any], *, resume: bool) -> None:
    """A folder holds one run: it goes on with the options that it began with, under whatever name."""
    if not _has_begun(folder):
        return
    there = _config(folder / "config.json")
    if not resume:
        raise ValueError(f"{folder} holds a run. Go on with --resume, choose another --out, or remove the folder.")
    for name, value in document["options"].items():
        begun = there["options"].get(name)
        if name != "out" and begun != value:
            told = f"without --{name.replace('_', '-')}" if begun is None else f"with {name} = {begun!r}"
            raise ValueError(f"{folder} was begun {told}, not {value!r}. Use the same options.")
    if there["style"] != document["style"]:
        raise ValueError(f"{document['options']['style']} is not the picture that {folder} was begun with.")
    if there.get("photos") != document.get("photos"):
        raise ValueError(
            f"the photographs in {document['options']['photos']} are not those that {folder} was begun with. Put them "
            "back, or choose another --out."
        )


class _Always(TypedDict):
    options: dict[str, Any]
    style: str
    threads: int


class _Config(_Always, total=False):
    photos: str
    licence: str


def _config(path: Path) -> _Config:
    return from_json(path.read_bytes(), _Config, wrong=f"{path} is damaged", fix="Start the run anew.", hook=None)


def _has_begun(folder: Path) -> bool:
    """Whether there is a run with a checkpoint: one that failed before its first has not begun."""
    return (folder / "config.json").exists() and any((folder / "checkpoints").glob("step-*"))


def _begun_licence(folder: Path, resume: bool) -> str | None:
    """What a run that goes on was told of its style."""
    return _config(folder / "config.json").get("licence") if resume and _has_begun(folder) else None


def _threads(folder: Path, resume: bool, threads: int | None) -> int:
    """How many a run computes with: as it began, for the last bit depends on it; else the cores that are free."""
    found = folder / "config.json"
    if threads is None and resume and found.exists():
        return max(1, _config(found)["threads"])
    if threads is not None:
        if threads < 1:
            raise ValueError(f"threads must be at least 1, got {threads}.")
        return threads
    return max(1, free_cores() // int(os.environ.get("LOCAL_WORLD_SIZE", "1")))


@contextmanager
def _stopping() -> Iterator[Callable[[], bool]]:
    """Asks whether Ctrl-C or SIGTERM came; a second one ends at once."""
    came: list[int] = []

    def note(number: int, frame: Any) -> None:
        if came:
            raise KeyboardInterrupt("stopped twice")
        came.append(number)

    before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(came)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _card(
    options: Options,
    settings: Any,
    trained: style.Trained,
    pictures: Sequence[Sequence[Tensor]],
    loss: style.StyleLoss,
    licence: str | None,
) -> card.Card:
    own = options.style in style.STYLES
    name = Path(options.style).name
    return card.Card(
        f"A camera for {Path(options.style).stem}",
        style=f"{name}, drawn by kcam's own code" if own else name,
        licence=licence or ("MIT" if own else None),
        facts=[(k, Path(v).name if k in ("style", "scenes") else v) for k, v in _facts(options, settings, trained)],
        measures=_measures(loss, pictures),
        holds=any(isinstance(stage, isp.TextureTransfer) for stage in trained.camera),
        notes=[
            f"Means over {len(pictures)} built-in photographs ({', '.join(SHOWN)}) on which cameras are trained unless "
            "others are given; smaller is nearer. Style and colour are distances from the style, content is what is "
            "lost of the scene.",
            WHAT_BRINGS,
        ],
    )


def _measures(loss: style.StyleLoss, pictures: Sequence[Sequence[Tensor]]) -> list[tuple[str, ...]]:
    """Each weighted term of the loss, the means over scenes; of as much of a picture as the features take."""
    multiple, least = loss.features.multiple, loss.features.least
    if not pictures or min(pictures[0][0].shape[-2:]) < least:
        return []
    terms = []
    for row in pictures:
        scene, *shots = (
            x[..., : x.shape[-2] // multiple * multiple, : x.shape[-1] // multiple * multiple] for x in row
        )
        with torch.no_grad():
            terms.append([loss.terms(picture.clamp(0, 1), scene) for picture in (scene, *shots)])
    names = [name for name in terms[0][0] if name != "l2"]
    means = [[sum(float(row[k][name]) for row in terms) / len(terms) for k in range(len(terms[0]))] for name in names]
    heads = ("what it shows", "the scene itself", "camera alone", "and what paints")[: len(terms[0]) + 1]
    return [heads, *((f"loss: {name}", *(f"{x:.3f}" for x in row)) for name, row in zip(names, means, strict=True))]


def _write_report(path: Path, options: Options, settings: Any, trained: style.Trained, figures: dict[str, Any]) -> None:
    report.write_report(
        path,
        title=f"A camera for {Path(options.style).stem}",
        summary=_facts(options, settings, trained),
        figures=[("Contact sheet", figures["sheet"]), ("Loss", figures["loss"])],
        advice=trained.advice,
        notes=[WHAT_BRINGS],
    )


def _facts(options: Options, settings: Any, trained: style.Trained) -> list[tuple[str, str]]:
    """Settings and results, for a page."""
    seconds = sum(trained.profile.values())
    last = dict(zip(trained.names, trained.history[-20:].mean(0).tolist(), strict=True))
    return [
        ("style", options.style),
        ("preset", options.preset),
        ("steps", f"{settings.steps} of {settings.batch} scenes of {settings.size} x {settings.size} pixels"),
        ("scenes", options.patches or options.photos or "built-in photographs"),
        *((("began with", Path(options.camera).name),) if options.camera else ()),
        ("features", options.features),
        ("time", f"{plots.duration(seconds)}, {plots.duration(seconds / max(1, trained.steps_timed))} a step"),
        *((f"loss: {name}", f"{value:.4f}") for name, value in last.items()),
        ("versions", f"kcam {__version__}, torch {torch.__version__}, {torch.get_num_threads()} threads"),
    ]
