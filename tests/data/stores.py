"""What the tests of the patch store share: small cubes, stores, and the tools called as a user calls them."""

from __future__ import annotations

import hashlib
import importlib.util
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import ModuleType

import numpy as np
import tifffile
import torch
import typer
from commands import invoke

from kcam.data import Cube, Settings, extract, make_plan, write_cube
from kcam.units import nm

ROOT = Path(__file__).parents[2]
TOOLS = ROOT / "data_tools"
BANDS, HEIGHT, WIDTH = 4, 40, 56
SETTINGS = Settings(size=16, stride=8, split=(("train", 0.6), ("val", 0.4)))
NAMES = ("apple", "boat", "cat", "gate", "house", "ink")
"""By the hash of their names: three in train, three in val."""


def tool(name: str) -> ModuleType:
    """A script of data_tools/ as a module."""
    if str(TOOLS) not in sys.path:
        sys.path.append(str(TOOLS))
    spec = importlib.util.spec_from_file_location(name, TOOLS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def call(name: str, *arguments: object, status: int = 0) -> str:
    """What a tool printed, in this process."""
    app = typer.Typer()
    app.command()(tool(name).main)
    result = invoke(app, *arguments)
    assert result.exit_code == status, (result.output, result.exception)
    assert "Traceback" not in result.output
    return result.output


def quiet(text: str) -> str:
    """The standard error without lines of progress, of which a slow machine sees some."""
    return re.sub(r"^(convert|inspect|extract|verify|export) \d+( of \d+)?, .*\n", "", text, flags=re.MULTILINE)


def start(name: str, *arguments: object) -> subprocess.Popen[str]:
    """A tool in a process, and a process group, of its own.

    A shell starts what runs in its background deaf to Ctrl-C, and children inherit that: theirs is the usual one.
    """
    return subprocess.Popen(
        [sys.executable, str(TOOLS / f"{name}.py"), *(str(argument) for argument in arguments)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
        env=os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip


def values(seed: int, *, bands: int = BANDS, height: int = HEIGHT, width: int = WIDTH) -> torch.Tensor:
    """A textured picture in each band, 0.1 to 1: no patch of it is empty, flat or saturated."""
    found = torch.rand(bands, height, width, generator=torch.Generator().manual_seed(seed)) * 0.9 + 0.1
    found[:, height // 2, width // 2] = 1.0
    return found


def cube(content: torch.Tensor, name: str = "", **facts: str) -> Cube:
    grid = torch.linspace(420, 720, len(content), dtype=torch.float64) * nm
    return Cube(content, grid, "reflectance", name=name, source={"format": "test", **facts})


def make_cubes(folder: Path, names: tuple[str, ...] = NAMES, **shape: int) -> Path:
    """A folder of cubes; the content of each follows from its name."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        seed = int.from_bytes(hashlib.sha256(name.encode()).digest()[:4], "big")
        write_cube(folder / f"{name}.tif", cube(values(seed, **shape), name))
    return folder


def make_store(cubes: Path, out: Path, settings: Settings = SETTINGS, **how) -> Path:
    """A finished store."""
    outcome = extract(make_plan(cubes, settings), out, **how)
    assert outcome.finished
    assert not outcome.failed
    return out


def content(store: Path) -> dict[str, str]:
    """Every file of a store and the hash of its bytes: hidden and temporary ones too."""
    return {
        str(path.relative_to(store)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(store.rglob("*"))
        if path.is_file()
    }


def pixels(path: Path) -> np.ndarray:
    """The values of a cube file, by the reader of another library."""
    with tifffile.TiffFile(path) as file:
        return np.stack([page.asarray() for page in file.pages[:BANDS]])


def left(group: int) -> list[str]:
    """Processes of a process group that are still there after ten seconds."""
    deadline = time.monotonic() + 10
    while (found := running(group)) and time.monotonic() < deadline:
        time.sleep(0.05)
    return found


def running(group: int) -> list[str]:
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, own = path.read_text().rsplit(")", 1)[1].split()[:3]
            if int(own) == group and state != "Z":
                found.append((path.parent / "cmdline").read_bytes().replace(b"\0", b" ").decode())
        except OSError:
            continue
    return found
