"""Every public name says what it is, and shows it: its docstring ends in an example, which prints what it shows."""

from __future__ import annotations

import doctest
import importlib
import inspect
import math
import random
import sys
import warnings
from pathlib import Path
from typing import Any

import pytest
import torch

import kcam
from kcam import Camera, Plan, Scene, data, isp, optics, plots, sensor, spectral
from kcam import augmentation as KC
from kcam.units import mm, nm, um

sys.path.insert(0, str(Path(__file__).parents[1] / "docs" / "_ext"))
import docstrings

METHODS = (Camera, Scene, Plan, optics.Lens, optics.CompoundLens, optics.Imaging, optics.MeasuredPSF)
NAMESPACE = {
    "Camera": Camera, "KC": KC, "Plan": Plan, "Scene": Scene, "data": data, "isp": isp, "kcam": kcam, "math": math,
    "mm": mm, "nm": nm, "optics": optics, "plots": plots, "sensor": sensor, "spectral": spectral, "torch": torch,
    "um": um,
}  # fmt: skip
"""What an example has without importing it."""
FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
QUICK, MOST_LINES = 30, 5


NAMES = {
    f"{module}.{name}": getattr(importlib.import_module(module), name)
    for module in docstrings.MODULES
    for name in docstrings.members(module)
}
CODE = {name: value for name, value in NAMES.items() if callable(value)}
IN_THE_QUICK_TESTS = set(random.Random(0).sample(sorted(CODE), QUICK))


def example(value: Any) -> doctest.DocTest:
    """The example of a docstring, in the namespace that it counts on."""
    document = inspect.getdoc(value) or ""
    return doctest.DocTestParser().get_doctest(document, dict(NAMESPACE), value.__name__, None, 0)


def missing(value: Any) -> str | None:
    """What an example lacks."""
    document = vars(value).get("__doc__") if inspect.isclass(value) else value.__doc__  # not an inherited one
    if ">>>" not in (document or ""):
        return "has no example"
    head, _, shown = inspect.cleandoc(document).partition("\nExample:\n")
    if not shown.startswith(">>> ") or ">>>" in head or "\n\n" in shown:
        return "does not end in its example, below a line 'Example:'"
    lines = sum(part.source.count("\n") for part in example(value).examples)
    return None if lines <= MOST_LINES else f"has an example of {lines} lines, more than {MOST_LINES}"


def test_every_class_and_function_has_an_example() -> None:
    lacking = {name: missing(value) for name, value in CODE.items()}
    assert {name: what for name, what in lacking.items() if what} == {}


def test_every_constant_says_what_it_holds() -> None:
    assert [name for name in NAMES.keys() - CODE.keys() if not docstrings.told(*name.rsplit(".", 1))] == []


@pytest.mark.parametrize("cls", METHODS, ids=lambda cls: cls.__name__)
def test_every_public_method_has_a_docstring(cls: type) -> None:
    ours = [base for base in cls.__mro__ if base.__module__.startswith("kcam")]
    held = {name: value for base in reversed(ours) for name, value in vars(base).items() if name[0] != "_"}
    called = {name: value for name, value in held.items() if isinstance(value, property | classmethod | staticmethod)
              or inspect.isfunction(value)}  # fmt: skip
    assert [name for name, value in called.items() if not value.__doc__] == []


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=() if n in IN_THE_QUICK_TESTS else pytest.mark.slow) for n in sorted(CODE)]
)
def test_the_example_prints_what_it_shows(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    said: list[str] = []
    threads, dtype = torch.get_num_threads(), torch.get_default_dtype()
    with torch.random.fork_rng(devices=[]), warnings.catch_warnings():
        warnings.simplefilter("error")
        torch.manual_seed(0)
        result = doctest.DocTestRunner(optionflags=FLAGS).run(example(CODE[name]), out=said.append)
    if "matplotlib.pyplot" in sys.modules:
        assert sys.modules["matplotlib.pyplot"].get_fignums() == []
    assert not result.failed, "".join(said)
    assert (torch.get_num_threads(), torch.get_default_dtype()) == (threads, dtype)
