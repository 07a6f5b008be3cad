"""Files of every kind that kcam reads, and damage to what they say: keys dropped, retyped, nested, bytes lost."""

from __future__ import annotations

import copy
import json
import math
import random
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
import torch
from safetensors import safe_open
from safetensors.torch import save_file
from torch import nn

from kcam import Camera, Plan, Scene, files, isp, optics, sensor
from kcam.data import Cube, PatchDataset, Settings, extract, make_plan, read_cube, write_cube
from kcam.data.patches import manifest, verify
from kcam.plain import to_json
from kcam.style.checkpoints import Checkpoints, _sha256
from kcam.tradeoff import Sweep
from kcam.train import _config
from kcam.units import mm, nm, um

DEEP = "[" * 20_000 + "]" * 20_000
ODD: tuple[Any, ...] = (
    None, True, False, 0, 1, -1, 3, 2**31, 2**63, 10**400, 0.5, -2.5, 1e308, float("inf"), float("nan"), "", "abc", "1",
    "\ud83d\ude00", "x" * 5000, [], [1, 2], ["a"], [[]], [None] * 3, {}, {"a": 1}, {"float": "abc"}, {"float": "inf"},
    {"same": "stages.0"}, {"same": ""}, {"class": "Camera"}, {"class": "Camera", "arguments": {}}, {"tensor": "x"},
    {"class": "torch.nn.Linear", "arguments": {"in_features": 10**9, "out_features": 10**9}}, {"parameter": 1},
    {"class": "os.system", "arguments": {"command": "false"}}, {"class": ["Camera"], "arguments": []},
)  # fmt: skip


@dataclass(frozen=True)
class Kind:
    """A kind of file: how one is made, its document taken out and put back, and how kcam reads it.

    make: writes it into a folder. take: its JSON document. put: writes another text in its place. read: all that kcam
    does with it before it is used. named: what an error must name, where that is not the file.
    """

    make: Callable[[Path], Path]
    take: Callable[[Path], Any]
    put: Callable[[Path, str], None]
    read: Callable[[Path], Any]
    named: Callable[[Path], str] = lambda path: path.name


def places(value: Any, where: tuple = ()) -> Iterator[tuple]:
    """Paths of all values inside of one, itself included."""
    yield where
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, item in items:
        yield from places(item, (*where, key))


def damaged(document: Any, rng: random.Random) -> str:
    """The document's text after one to three changes of its structure."""
    changed = copy.deepcopy(document)
    for _ in range(rng.choice([1, 1, 1, 2, 3])):
        where = rng.choice(list(places(changed)))
        if not where:
            changed = rng.choice([*ODD, [changed], {"document": changed}]) if rng.random() < 0.3 else changed
            continue
        holder = changed
        for key in where[:-1]:
            holder = holder[key]
        key, action = where[-1], rng.choice(["drop", "odd", "odd", "odd", "nest", "swap", "rename", "deep"])
        if action == "drop":
            del holder[key]
        elif action == "odd":
            holder[key] = copy.deepcopy(rng.choice(ODD))
        elif action == "nest":
            holder[key] = rng.choice([[holder[key]], {"a": holder[key]}, [[[holder[key]]]]])
        elif action == "swap":
            other = rng.choice(list(holder) if isinstance(holder, dict) else range(len(holder)))
            holder[key], holder[other] = holder[other], holder[key]
        elif action == "rename" and isinstance(holder, dict):
            holder[rng.choice(["", "a", f"{key}s"])] = holder.pop(key)
        else:
            holder[key] = "DEEP"
    return json.dumps(changed).replace('"DEEP"', DEEP)


def torn(text: str, rng: random.Random) -> str:
    """The text with characters lost, changed or added, or no JSON at all."""
    place = rng.randrange(len(text) + 1)
    return rng.choice([
        text[:place],
        text[:place] + chr(rng.randrange(32, 0x3000)) + text[place + 1 :],
        text[:place] + text[place + rng.randrange(1, 20) :],
        text[:place] + text[rng.randrange(len(text)) :],
        text + "}",
        DEEP,
        "{" * 5000,
        "",
        "null",
    ])  # fmt: skip


# ---- the kinds -------------------------------------------------------------------------------------------------------


def _cameras() -> list[Camera]:
    lens = optics.Lens(
        optics.CircularAperture(diameter=5 * mm),
        optics.PlanoConvexLens(radius_of_curvature=25.8 * mm, glass="N-BK7"),
        optics.DOE(nn.Parameter(torch.zeros(5, 5)), design_wavelength=550 * nm, glass="fused silica"),
        focus_distance=float("inf"),
    )
    layers = nn.Sequential(nn.Conv2d(3, 4, 3, padding=1), nn.BatchNorm2d(4), nn.PReLU(), nn.Conv2d(4, 3, 1))
    imaging = optics.Imaging(lens, pixel_pitch=4 * um, psf_shape=(9, 9))
    return [
        Camera.phone(),
        Camera.ideal(),
        Camera(imaging, sensor.ColourFilter.learned(tile=4), sensor.Exposure(), isp.Clip(), isp.LearnedDemosaic()),
        Camera(
            sensor.ColourFilter.kodak(infrared_cut=650 * nm),
            layers,
            nn.Upsample(scale_factor=2.0),
            sensor.DarkCurrent(10.0, time=0.1, temperature=40.0),
            sensor.FixedPattern(0.01, seed=4),
            sensor.ReadNoise(torch.ones(1, 1, 1)),
            isp.ColourMatrix(torch.eye(3)),
            isp.StyleStage(width=2, dilations=(1,)),
        ),
    ]


def _camera(index: int, folder: Path) -> Path:
    path = folder / "camera.safetensors"
    _cameras()[index].save(path)
    return path


def _metadata(path: Path) -> dict[str, Any]:
    with safe_open(path, framework="pt") as file:
        return json.loads(file.metadata()["kcam"])


def _put_metadata(path: Path, text: str) -> None:
    with safe_open(path, framework="pt") as file:
        tensors = {key: file.get_tensor(key).clone() for key in file.keys()}  # noqa: SIM118
    save_file(tensors, path, metadata={"kcam": text})


def _read_camera(path: Path) -> None:
    """A camera that was built is the one that the file describes; what the file does not say is as by default."""
    camera = Camera.load(path)
    assert repr(camera)
    again = path.with_name("again.safetensors")
    camera.save(again)
    assert _says(files.describe(again)["configuration"], files.describe(path)["configuration"])


def _says(whole: Any, part: Any) -> bool:
    """Whether all that a part of a configuration says is so in the whole."""
    if isinstance(part, dict) and isinstance(whole, dict):
        if isinstance(layers := part.get("layers"), list):  # distances are kept from far to near, each once
            part = part | {"layers": sorted(set(layers), reverse=True)}
        return all(key in whole and _says(whole[key], value) for key, value in part.items())
    if isinstance(part, list) and isinstance(whole, list):
        return len(part) == len(whole) and all(map(_says, whole, part))
    if isinstance(part, float) and not math.isfinite(part):
        return whole == {"float": str(part)}
    return whole == part or whole == [part] * 2  # a number for both axes of a layer


def _plan(folder: Path) -> Path:
    path = folder / "plan.json"
    with torch.no_grad():
        Camera.phone().plan(Scene.builtin("star", 24), tolerance=0.05).save(path)
    return path


def _read_plan(path: Path) -> None:
    plan = Plan.load(path)
    assert str(plan)
    assert Plan.from_json(plan.to_json()).to_json() == plan.to_json()


def _store(folder: Path) -> Path:
    cubes = folder / "cubes"
    cubes.mkdir()
    values = torch.rand(3, 20, 24, generator=torch.Generator().manual_seed(0))
    for name in ("one", "two"):
        write_cube(cubes / f"{name}.tif", Cube(values, torch.tensor([450, 550, 650]) * nm, name=name))
    extract(make_plan(cubes, SETTINGS), folder / "store")
    return folder / "store" / "train" / "manifest.json"


SETTINGS = Settings(size=8, stride=8, split=(("train", 1.0),))


def _put_manifest(path: Path, text: str) -> None:
    """With a digest that fits, so that it is what the manifest says that is judged."""
    try:
        document = json.loads(text)
        document["sha256"] = manifest.digest(document)
        text = json.dumps(document)
    except (ValueError, TypeError, RecursionError, AttributeError):
        pass
    path.write_text(text)


def _read_store(path: Path) -> None:
    patches = PatchDataset(path.parent)
    assert len(patches.mean) == len(patches.deviation) == len(patches.wavelengths)
    if len(patches):
        assert patches[0].values.ndim == 3
        assert len(patches.position(0)) == 3
    assert isinstance(verify(path.parent), list)


def _begun(folder: Path) -> Path:
    _store(folder)
    plan = make_plan(folder / "cubes", SETTINGS)
    extract(plan, folder / "begun", shard=(1, 2))
    return folder / "begun" / ".work" / "plan.json"


def _go_on(path: Path) -> None:
    extract(make_plan(path.parents[2] / "cubes", SETTINGS), path.parents[1], resume=True)


def _done(folder: Path) -> Path:
    return next((_begun(folder).parent / "done").glob("*.json"))


def _go_on_from(path: Path) -> None:
    """A record that is damaged counts as none: its scene is cut again."""
    begun = path.parents[2]
    assert extract(make_plan(begun.parent / "cubes", SETTINGS), begun, resume=True).finished
    assert verify(begun) == []


def _cube(folder: Path) -> Path:
    path = folder / "cube.tif"
    write_cube(path, Cube(torch.rand(3, 6, 5), torch.tensor([450, 550, 650]) * nm, name="x", source={"group": "g"}))
    return path


def _description(path: Path) -> Any:
    with tifffile.TiffFile(path) as file:
        return json.loads(file.pages[0].description)


def _put_description(path: Path, text: str) -> None:
    with tifffile.TiffFile(path) as file:
        pages = [page.asarray() for page in file.pages]
    with tifffile.TiffWriter(path, byteorder="<") as file:
        how: dict[str, Any] = {"photometric": "minisblack", "metadata": None, "software": "kcam"}
        file.write(np.stack(pages), description=text.encode("ascii", "backslashreplace") or b" ", **how)


def _checkpoint(folder: Path) -> Path:
    Checkpoints(folder / "run").save(3, tensors={"x": torch.ones(2)}, document={"a": [1.5, float("inf")], "b": {}})
    return folder / "run" / "step-000003" / "MANIFEST.json"


def _put_vouched(path: Path, text: str) -> None:
    """A manifest that vouches for itself."""
    try:
        document = json.loads(text)
        document.pop("sha256", None)
        document["sha256"] = _sha256(to_json(document))
        text = json.dumps(document)
    except (ValueError, TypeError, RecursionError, AttributeError):
        pass
    path.write_text(text)


def _state(folder: Path) -> Path:
    return _checkpoint(folder).with_name("state.json")


def _put_state(path: Path, text: str) -> None:
    path.write_text(text)
    manifest = json.loads(path.with_name("MANIFEST.json").read_text())
    held = path.read_bytes()
    manifest["files"]["state.json"] = {"size": len(held), "sha256": _sha256(held)}
    _put_vouched(path.with_name("MANIFEST.json"), json.dumps(manifest))


def _read_checkpoint(path: Path) -> None:
    """A damaged one is set aside with a warning that names it: the one before it is used."""
    import warnings

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = Checkpoints(path.parents[1]).latest()
    if found is None:
        raise ValueError(str(caught[0].message))
    assert found.step == 3
    assert torch.equal(found.tensors["x"], torch.ones(2))


def _sweep(folder: Path) -> Path:
    from kcam.tradeoff import Row

    rows = (
        Row("lens", "as it is", raw_rms=1e-3, seconds=0.1, seconds_iqr=(0.1, 0.2), calls=3, default=True),
        Row("samples", "more", raw_rms=1e-4, seconds=0.3, pareto=True, peak_memory=1000),
        Row("depth", "no", refused="a reason"),
    )
    Sweep("a title", "a scene", rows, {"limit": 1e-6}, {"machine": "x, y"}).save(folder / "tradeoff.json")
    return folder / "tradeoff.json"


def _read_sweep(path: Path) -> None:
    sweep = Sweep.load(path)
    assert sweep.table().row_count == len(sweep.rows)
    assert sweep.sentence()


def _run(folder: Path) -> Path:
    path = folder / "config.json"
    path.write_text(json.dumps({"options": {"style": "strokes"}, "style": "0123", "threads": 1}))
    return path


def _lens(folder: Path) -> Path:
    path = folder / "lens.json"
    optics.CompoundLens.preset("phone_odd").save(path)
    return path


def _read_lens(path: Path) -> None:
    """A lens that was read is one that can be written, and is read again."""
    lens = optics.CompoundLens.from_file(path)
    again = path.with_name("again.json")
    lens.save(again)
    assert len(optics.CompoundLens.from_file(again).surfaces) == len(lens.surfaces)


def _put(path: Path, text: str) -> None:
    path.write_text(text, errors="surrogatepass")


def _take(path: Path) -> Any:
    return json.loads(path.read_text())


KINDS: dict[str, Kind] = {
    **{f"camera {index}": Kind(partial(_camera, index), _metadata, _put_metadata, _read_camera) for index in range(4)},
    "plan": Kind(_plan, _take, _put, _read_plan),
    "store": Kind(_store, _take, _put_manifest, _read_store),
    "store begun": Kind(_begun, _take, _put, _go_on, lambda path: path.parents[1].name),
    "scene done": Kind(_done, _take, _put, _go_on_from),
    "cube": Kind(_cube, _description, _put_description, read_cube),
    "checkpoint": Kind(_checkpoint, _take, _put_vouched, _read_checkpoint, lambda path: path.parent.name),
    "state": Kind(_state, _take, _put_state, _read_checkpoint, lambda path: path.parent.name),
    "sweep": Kind(_sweep, _take, _put, _read_sweep),
    "run": Kind(_run, _take, _put, _config),
    "lens": Kind(_lens, _take, _put, _read_lens),
}
