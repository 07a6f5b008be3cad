"""What holds for every file of the library, read from its source."""

from __future__ import annotations

import ast
import functools
import json
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "kcam"
FILES = sorted(PACKAGE.rglob("*.py"))
IDS = [str(path.relative_to(PACKAGE)) for path in FILES]

# Data flows down this list, and imports point up: a module imports only from rows above its own, or from its own
# package. What stands in one row does not know of its neighbours.
LAYERS = [
    {"kcam.threads", "kcam.memory"},
    {"kcam.units", "kcam.ste", "kcam.cache", "kcam.precision", "kcam.measure"}
    | {"kcam.plain", "kcam.layers", "kcam.compiled"},
    {"kcam.context", "kcam.inputs", "kcam.srgb"},
    {"kcam.spectral", "kcam.files", "kcam.effects"},
    {"kcam.scene"},
    {"kcam.optics"},
    {"kcam.sensor"},
    {"kcam.texture"},
    {"kcam.isp"},
    {"kcam.camera"},
    {"kcam.planner", "kcam.linear", "kcam.burst"},
    {"kcam.augmentation", "kcam.data"},
    {"kcam.style"},
    {"kcam.tradeoff"},
    {"kcam.plots"},
    {"kcam.report", "kcam.card"},
    {"kcam.calibration", "kcam.analysis"},
    {"kcam.demo", "kcam.shoot", "kcam.train"},
    {"kcam.cli"},
    {"kcam.__main__"},
]
LAYER = {module: index for index, row in enumerate(LAYERS) for module in row}
DATA = [
    {"cube"},
    {"bands", "workers"},
    {"readers", "patches"},
    {"convert", "inspection", "dataset", "export", "photos"},
]
"""The same inside kcam.data: readers do not know of the store, nor the store of readers."""
METHODS = {
    ("kcam.camera", "kcam.planner"),
    ("kcam.camera", "kcam.linear"),
    ("kcam.camera", "kcam.burst"),
    ("kcam.optics", "kcam.plots"),
    ("kcam.scene", "kcam.data"),
}
"""camera.plan(...) is a method for the user's sake, but a planner is made of cameras: imported when it is called; so
are the operator of camera.linear(...), the figure of lens.draw(), and the files of Scene.from_folder(...).
"""
FORBIDDEN = {"colour", "colour_demosaicing", "cv2", "h5py", "mpmath", "zarr"}
"""Not among the core dependencies: the library needs none of them at import, nor at run time."""
LAZY = {"kcam.data": {"h5py", "cv2", "zarr"}, "kcam.optics": {"h5py"}}


@functools.cache
def nodes(path: Path) -> tuple[ast.AST, ...]:
    """All of a file, parsed once: every test below asks for it."""
    return tuple(ast.walk(ast.parse(path.read_text())))


def part(path: Path) -> str:
    """kcam/optics/psf.py -> kcam.optics; kcam/camera.py -> kcam.camera."""
    return f"kcam.{path.relative_to(PACKAGE).parts[0].removesuffix('.py')}"


def imports(path: Path, *, members: bool = False) -> list[tuple[str, bool]]:
    """(module, whether only for the type checker) for each import in a file, `from kcam import x` as kcam.x.

    members: every `from a import b` as a.b, which may be a module too.
    """
    typing_only = {
        id(node)
        for block in nodes(path)
        if isinstance(block, ast.If) and ast.unparse(block.test) == "TYPE_CHECKING"
        for node in ast.walk(block)
    }
    found = []
    for node in nodes(path):
        if isinstance(node, ast.Import):
            found += [(alias.name, id(node) in typing_only) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: write imports in full, from kcam.x import y"
            whole = members or node.module == "kcam"
            names = [f"{node.module}.{alias.name}" for alias in node.names] if whole else [node.module]
            found += [(name, id(node) in typing_only) for name in names if name]
    return found


@pytest.mark.parametrize("path", FILES, ids=IDS)
def test_imports_point_upstream(path: Path) -> None:
    here = part(path)
    if here == "kcam.__init__":
        return
    assert here in LAYER, f"{path.name} is new: give it a row in LAYERS"
    for module, typing_only in imports(path):
        parts = module.split(".")
        if parts[0] != "kcam" or module == "kcam.__version__" or typing_only:
            continue
        there = ".".join(parts[:2])
        if (here, there) in METHODS:
            continue
        assert there == here or LAYER[there] < LAYER[here], f"{here} imports {there}, which is downstream of it"


# The house of optics: a room imports from rooms below it and from its own, and no module from one that needs it, even
# if only for the type checker.
FLOORS = ["autograd", "numerics", "wavelengths", "source", "regions", "banks", "pupil", "elements", "propagation"]
FLOORS += ["compound", "accuracy", "lens", "measured", "glare", "rendering", "field", "work", "imaging", "linear"]
FLOORS += ["__init__"]


def test_optics_is_a_house_with_floors() -> None:
    optics = PACKAGE / "optics"
    modules = {}
    for path in optics.rglob("*.py"):
        name = ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts)
        modules[name.removesuffix(".__init__") if path.parent != optics else name] = path
    needs: dict[str, set[str]] = {}
    for name, path in modules.items():
        here = name.split(".")[2]
        assert here in FLOORS, f"{name} is new: give it a floor"
        found = {module for module, _ in imports(path, members=True) if module.startswith("kcam.optics.")}
        needs[name] = {module if module in modules else module.rpartition(".")[0] for module in found} - {name}
        for module in found:
            there = module.split(".")[2]
            assert FLOORS.index(there) <= FLOORS.index(here), f"{name} imports {module}, which is above it"
    order = TopologicalSorter(needs)
    order.prepare()  # raises CycleError, which names the modules


@pytest.mark.parametrize("path", sorted((PACKAGE / "data").rglob("*.py")), ids=lambda path: path.stem)
def test_imports_inside_data_point_upstream(path: Path) -> None:
    row = {room: index for index, rooms in enumerate(DATA) for room in rooms}
    here = path.relative_to(PACKAGE / "data").parts[0].removesuffix(".py")
    for module, _ in imports(path):
        if module.startswith("kcam.data.") and here != "__init__":
            there = module.split(".")[2]
            assert there == here or row[there] < row[here], f"data.{here} imports data.{there}, which is downstream"


def test_nothing_outside_calls_a_private_name_of_optics() -> None:
    inside = {path for path in FILES if path.is_relative_to(PACKAGE / "optics")}
    ours = [node for path in inside for node in nodes(path)]
    private = {node.name for node in ours if isinstance(node, (ast.FunctionDef, ast.ClassDef))}
    private |= {node.attr for node in ours if isinstance(node, ast.Attribute)}
    private = {name for name in private if name.startswith("_") and not name.startswith("__")}
    assert len(private) > 100
    for path in set(FILES) - inside:
        for node in nodes(path):
            if isinstance(node, ast.Attribute) and node.attr in private:
                assert ast.unparse(node.value) in ("self", "cls"), f"{path.name}:{node.lineno}: {ast.unparse(node)}"
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("kcam.optics"):
                assert not any(alias.name.startswith("_") for alias in node.names), f"{path.name}:{node.lineno}"


@pytest.mark.parametrize("path", FILES, ids=IDS)
def test_only_core_dependencies(path: Path) -> None:
    packages = {module.split(".")[0] for module, _ in imports(path)}
    assert not packages & (FORBIDDEN - LAZY.get(part(path), set()))


@pytest.mark.parametrize("path", FILES, ids=IDS)
def test_no_print_no_assert_no_bare_raise(path: Path) -> None:
    for node in nodes(path):
        where = f"{path.name}:{getattr(node, 'lineno', 0)}"
        assert not isinstance(node, ast.Assert), f"{where}: raise an error that says what was expected"
        if isinstance(node, ast.Call):
            assert ast.unparse(node.func) != "print", f"{where}: the library does not print"
        if isinstance(node, ast.Raise) and node.exc is not None:
            name = ast.unparse(node.exc.func) if isinstance(node.exc, ast.Call) else ast.unparse(node.exc)
            bare = not isinstance(node.exc, ast.Call) or not (node.exc.args or node.exc.keywords)
            abstract = name == "NotImplementedError"  # a method that a subclass must write
            assert abstract or not (bare and name[:1].isupper()), f"{where}: {name} without a message"


COMPILER = ("torch._dynamo", "torch._inductor", "sympy", "matplotlib", "cv2", "h5py", "colour")
SCIPY = ("interpolate", "optimize", "spatial", "ndimage", "sparse", "special")
STEPS = {
    "kcam": ("import kcam", [f"scipy.{name}" for name in SCIPY]),
    "command": ("import kcam.cli", ["kcam.data", "kcam.style", "matplotlib", "tifffile"]),
    "import": ("import kcam, kcam.augmentation, kcam.data, kcam.style", COMPILER),
    "picture": ("kcam.Camera.phone()(kcam.Scene.builtin('star', 32))", COMPILER),
    "picture over the field": ("kcam.Camera.preset('slr')[0](kcam.Scene.builtin('star', 32))", COMPILER),
    "augmentation": (
        "import kcam.augmentation as KC, torch; KC.RandomDefocus(p=1.0)(torch.rand(1, 3, 24, 24))",
        COMPILER,
    ),
}
"""What is done, and what it leaves for later."""


@pytest.fixture(scope="module")
def loaded() -> dict[str, list[str]]:
    """After each step, of what it should leave for later, what is there. What is loaded stays so: one process, which
    takes seconds to begin, does all of them.
    """
    code = ["import json, sys", "found = {}"]
    for name, (line, late) in STEPS.items():
        code += [line, f"found[{name!r}] = [name for name in {list(late)} if name in sys.modules]"]
    code.append("print(json.dumps(found))")
    done = subprocess.run([sys.executable, "-c", "\n".join(code)], capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


@pytest.mark.parametrize("step", [name for name, (_, late) in STEPS.items() if late is COMPILER])
def test_nothing_that_is_not_compiled_waits_for_the_compiler(step: str, loaded: dict[str, list[str]]) -> None:
    """torch._dynamo takes 2 s to import, and torch.compiler's own decorators do so."""
    assert loaded[step] == []


def test_an_import_leaves_scipy_s_parts_for_later(loaded: dict[str, list[str]]) -> None:
    """They come as `scipy.part` when they are used: together they take half a second."""
    assert loaded["kcam"] == []


def test_the_command_loads_no_more_than_it_must(loaded: dict[str, list[str]]) -> None:
    assert loaded["command"] == []


def test_typed_package_has_one_version() -> None:
    import kcam

    assert (PACKAGE / "py.typed").exists()
    found = [path.name for path in FILES if "__version__ =" in path.read_text()]
    assert found == ["__init__.py"]
    assert kcam.__version__.count(".") == 2
