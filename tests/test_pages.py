"""README and site say what is so: code prints what they show, tables are generated, claims have tests, scripts run."""

from __future__ import annotations

import ast
import functools
import importlib.util
import json
import os
import random
import re
import shlex
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
import typer
from PIL import Image

import kcam
import kcam.style
from kcam import augmentation as KC
from kcam import cli, demo, isp, optics, sensor
from kcam.camera import PRESETS
from kcam.scene import BUILTIN
from kcam.sensor.colour_filter import fitted
from kcam.units import mm, nm, um

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
NUMBER = re.compile(r"[-+]?\d+\.?\d*(?:e[-+]?\d+)?")
EXAMPLES = {
    "train_doe": ["--steps", "4", "--out", "doe.png"],
    "train_lens": ["--steps", "2", "--out", "lens.png"],
    "compose_camera": ["--size", "40", "--out", "cameras.png"],
    "psf_gallery": ["--pixels", "21", "--out", "gallery.png"],
    "lens_gallery": ["--lenses", "tessar", "--across", "1000", "--out", "lenses.png"],
    "augmentation_gallery": ["--side", "40", "--out", "augmentations.png"],
    "train_segmentation": ["--quick", "--out", "training.json"],
    "plan_scenes": ["--size", "40", "--out", "plans"],
    "reconstruct": ["--size", "40", "--steps", "10", "--out", "reconstructed.png"],
}
SAMPLED = random.Random(25)
"""Of pages and scripts a sample is run among the quick tests, all among the slow ones."""
SLOW = ("plan_scenes", "train_lens", "lens_gallery", "augmentation_gallery")


def load(path: Path) -> ModuleType:
    """A script as a module."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module
    spec.loader.exec_module(module)
    return module


generate = load(DOCS / "generate.py")
PAGES = {str(path.relative_to(ROOT)): path.read_text() for path in generate.pages()}
README = PAGES["README.md"]


def page(name: str) -> str:
    """A page of the site."""
    return PAGES[f"docs/{name}.md"]


def code_blocks(text: str, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)


def sampled(names: Iterable[str], count: int) -> list[Any]:
    """All of them, of which those that are not in the sample are slow."""
    names = sorted(names)
    quick = set(SAMPLED.sample(names, count))
    return [name if name in quick else pytest.param(name, marks=pytest.mark.slow) for name in names]


def code_lines(block: str) -> int:
    return sum(bool(line.strip()) for line in block.splitlines())


# ---- code --------------------------------------------------------------------------------------------------------


def same_but_for_rounding(printed: str, shown: str) -> bool:
    """Words alike, numbers within 2 %: rounding differs between machines, and with it a photon here and there."""
    if NUMBER.sub("#", printed) != NUMBER.sub("#", shown):
        return False
    pairs = zip(NUMBER.findall(printed), NUMBER.findall(shown), strict=True)
    return all(float(a) == pytest.approx(float(b), rel=0.02, abs=1e-3) for a, b in pairs)


def test_comparison_sees_what_differs() -> None:
    assert same_but_for_rounding("f = 49.8 mm", "f = 49.9 mm")
    assert not same_but_for_rounding("f = 49.8 mm", "f = 59.8 mm")
    assert not same_but_for_rounding("f = 49.8 mm", "f = 49.8 um")
    assert not same_but_for_rounding("1 2", "1")


WITH_CODE = [name for name, text in PAGES.items() if "```python" in text]


@pytest.mark.parametrize("name", sampled(WITH_CODE, 5))
def test_code_prints_what_a_page_shows(name: str, tmp_path: Path) -> None:
    with generate.inside(tmp_path):
        blocks = list(generate.run_code(PAGES[name], name=name))
    assert len(blocks) == len(code_blocks(PAGES[name], "python")) >= 1
    for match, printed in blocks:
        assert same_but_for_rounding(printed, match["output"] or ""), f"{match['code']}\nprints\n{printed}"


SCRIPTS = [str(path.relative_to(DOCS)) for folder in ("lessons", "recipes", "pictures") for path in
           sorted((DOCS / folder).glob("plot_*.py"))]  # fmt: skip


@pytest.mark.parametrize("name", sampled(SCRIPTS, 1))
def test_script_runs(name: str, tmp_path: Path) -> None:
    """As a user would, in a process of its own: warnings are errors."""
    environment = os.environ | {"MPLBACKEND": "Agg", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-W", "error", str(DOCS / name)]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert not list(tmp_path.iterdir()), "a script leaves nothing behind"


@pytest.mark.parametrize("path", sorted((DOCS / "recipes" / "long").glob("plot_*.py")), ids=lambda path: path.stem)
def test_the_page_of_a_long_script_is_of_this_script(path: Path) -> None:
    long_scripts = load(DOCS / "_ext" / "long_scripts.py")
    kept = DOCS / long_scripts.PAGES / f"{path.name}.md5"
    assert kept.read_text().strip() == long_scripts.digest(path), "run make docs-all"


def test_there_are_eight_lessons_and_thirty_pictures() -> None:
    assert sum(name.startswith("lessons/") for name in SCRIPTS) == 8
    assert sum(name.startswith("pictures/") for name in SCRIPTS) >= 30


def test_the_readme_is_short() -> None:
    assert len(README.splitlines()) <= 180


def test_the_first_code_is_the_camera_of_the_picture() -> None:
    code = code_blocks(README, "python")[0]
    assert "size=180" in code
    namespace: dict[str, object] = {}
    exec(code.replace("size=180", "size=40").split("print(")[0], namespace)
    scene = kcam.Scene.builtin("motorcycle", size=40)
    with torch.no_grad():
        one, two = (c(scene, generator=torch.Generator().manual_seed(0)) for c in (namespace["camera"], demo.singlet()))
    torch.testing.assert_close(one, two, rtol=0, atol=0.02)  # an electron more or less where rounding decides


def test_the_first_code_has_fifteen_lines_and_the_training_twelve() -> None:
    assert code_lines(code_blocks(README, "python")[0]) <= 15
    _imports, training = code_blocks(page("start/training"), "python")[0].split("\n\n", 1)
    assert code_lines(training) <= 12


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name in SLOW else name for name in EXAMPLES]
)
def test_example_runs(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    module = load(ROOT / "examples" / f"{name}.py")
    with generate.inside(tmp_path):
        module.main(EXAMPLES[name])
        assert Path(EXAMPLES[name][-1]).stat().st_size > 1000
    printed = capsys.readouterr().out
    assert EXAMPLES[name][-1] in printed
    assert "False" not in printed
    lines = [line for line in printed.splitlines() if line.startswith("step")]
    assert len(lines) == len(set(lines))


def test_all_examples_are_run() -> None:
    assert {path.stem for path in (ROOT / "examples").glob("*.py")} == set(EXAMPLES)


@pytest.mark.slow
def test_training_brings_depth_of_field() -> None:
    module = load(ROOT / "examples" / "train_doe.py")
    before, after, losses = module.train()
    assert losses[-1] < 0.85 * losses[0]
    # measured: 29 to 46 % of the light in the central 3 x 3 pixels at the worst of five distances
    worst = [float(module.light_in_the_middle(psf).min()) for psf in (before, after)]
    assert worst[0] < 0.3
    assert worst[1] > 0.4


@pytest.mark.slow
def test_training_a_lens_brings_sharpness_with_the_focal_length_held() -> None:
    module = load(ROOT / "examples" / "train_lens.py")
    training = module.train(12)
    assert training.losses[-1] < 0.3 * training.losses[0]
    assert training.lens.focal_length() == pytest.approx(5 * mm, rel=1e-9)
    # measured: 27 to 31 um from the middle to the corner, 3 to 6 after 12 steps, 2 in the patent
    assert float(module.spots(module.triplet(bent=module.BENT)).min()) > 25 * um
    assert float(module.spots(training.lens).max()) < 10 * um


# ---- the shell ---------------------------------------------------------------------------------------------------


def shell_commands() -> list[str]:
    text = "\n".join(PAGES.values())
    blocks = (re.sub(r"\\\\\n\s*", " ", block) for block in code_blocks(text, "sh"))
    lines = [line.split("#")[0].strip() for block in blocks for line in block.splitlines()]
    inline = re.findall(r"`(kcam [a-z-].*?)`", text)
    return list(dict.fromkeys(line for line in lines + inline if line))


@pytest.mark.parametrize("line", shell_commands())
def test_shell_command_exists(line: str) -> None:
    program, *arguments = shlex.split(line.removeprefix(".venv/bin/"))
    makefile = (ROOT / "Makefile").read_text()
    if program == "make":
        assert all(re.search(rf"^{target}:", makefile, re.MULTILINE) for target in arguments)
    elif program == "kcam":
        main = typer.main.get_command(cli.app)
        if arguments[0].startswith("--"):
            assert arguments[0] in {"--help"} | {option for p in main.params for option in p.opts}
            return
        command: Any = main
        while arguments and not arguments[0].startswith("-") and hasattr(command, "commands"):
            command = command.commands[arguments.pop(0)]
        known = {option: parameter for parameter in command.params for option in parameter.opts}
        for option, value in zip(arguments, [*arguments[1:], ""], strict=False):
            if option.startswith("--"):
                assert option in known or option == "--help"
                assert option != "--camera" or value in PRESETS or value.endswith(".safetensors")
    elif program == "pip":
        assert (ROOT / arguments[arguments.index("--constraint") + 1]).is_file()
        pins = (ROOT / "constraints.txt").read_text().splitlines()
        assert all(argument in pins for argument in arguments if "==" in argument)
    elif program == ".":
        assert arguments == [".venv/bin/activate"]
    elif program == "python":
        script, *options = arguments
        app = typer.Typer()
        app.command()(load(ROOT / script).main)
        known = {option for parameter in typer.main.get_command(app).params for option in parameter.opts}
        assert {option for option in options if option.startswith("--")} <= known
    else:
        assert (program, arguments) == ("python3", ["-m", "venv", ".venv"]), "a command that no test knows"


def test_make_targets_in_the_text_exist() -> None:
    makefile = (ROOT / "Makefile").read_text()
    prose = re.sub(r"```.*?```", "", "\n".join(PAGES.values()), flags=re.DOTALL)
    targets = set(re.findall(r"`make ([a-z-]+)`", prose))
    assert targets
    assert all(re.search(rf"^{target}:", makefile, re.MULTILINE) for target in targets), targets


# ---- tables and pictures -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", generate.TABLES)
def test_generated_table_is_in_step(name: str) -> None:
    text = "\n".join(PAGES.values())
    found = re.search(rf"<!-- generated: {name} -->\n(.*?)\n<!-- end -->", text, re.DOTALL)
    assert found is not None, f"no page has a block {name}"
    assert found[1] == generate.TABLES[name](), "run python docs/generate.py"


@pytest.mark.parametrize("name", generate.PLOTS)
def test_plot_shows_the_committed_results(name: str) -> None:
    with Image.open(generate.IMAGES / name) as plot:
        assert plot.info["Source"] == generate.digest(generate.PLOTS[name]), "run python docs/generate.py --pictures"


def test_the_tradeoff_has_ten_lines_for_two_cameras() -> None:
    lines = [line for line in generate.tradeoff_table().splitlines() if line.startswith("| ")]
    assert len(lines) == 2 * (1 + 10)


def test_every_propagator_is_in_the_table() -> None:
    table = generate.propagators_table()
    assert len(table.splitlines()) == 2 + len(optics.PROPAGATORS) + 1, "and the model's own error"
    assert all(f"`{physics}`" in table and f"`{method}`" in table for physics, method in optics.PROPAGATORS)


def race(who: str, ratio: float, error: float, **rest: object) -> dict[str, object]:
    row = {"op": "task", "who": who, "direction": "forward", "size": "1", "baseline": False, "default": True}
    return row | {"error": {"l1_median": error}, "seconds": 0.1, "ratio": ratio, "error_ratio": 3.0} | rest


def test_benchmark_table_shows_losses_and_missed_targets() -> None:
    content = {
        "environment": {"machine": "m", "threads": 1, "versions": {"torch": "2"}, "date": "2026-01-01T0", "clock": "c"},
        "targets": [
            {"target": "twice as fast", "op": "task", "direction": "forward", "who": "kcam a", "met": False,
             "ratio": 0.5, "error_ratio": None},
            {"target": "easy", "op": "task", "direction": "forward", "who": "kcam a", "met": True, "ratio": 2.0,
             "error_ratio": None},
        ],
        "rows": [
            race("textbook", 1.0, 0.1, baseline=True, default=False, share_timed=0.1, peak_memory=53_600_000),
            race("kcam a", 0.5, 2e-5),
            race("kcam b", 0.4, 1e-5, default=False),
        ],
    }  # fmt: skip
    table = generate.benchmark_part(content, generate.RESULTS / "x.json")
    assert "| task<br><sub>1</sub> | `a`, forward | ~100 ms, 0.1, 54 MB | 100 ms, 2.0e-5 | **0.5** | 3 |" in table
    assert "`b`" not in table
    assert "- twice as fast: **missed**, met in 0 of 1 races; 0.5 to 0.5 times as fast." in table
    assert "- easy: met in 1 of 1 races; 2 to 2 times as fast." in table
    assert generate.benchmark_part({"other": 1}, generate.RESULTS / "x.json") == ""


def test_augmentation_cells_show_what_is_faster_and_what_is_missed() -> None:
    line = {
        "seconds": {"kcam 1": 0.02, "straightforward": 0.015, "a": 0.03, "b": 0.04},
        "relatives": ["a", "b"],
        "added": {"1": {"share_of_maths": 0.25, "met": True}, "0.5": {"share_of_maths": 1.5, "met": False}},
    }
    assert generate.speed_cells(line) == ["20", "30", "**15**", "0.25 met, **1.50 missed**"]
    assert generate.speed_cells(None) == ["", "", "", ""]


def test_every_augmentation_is_in_its_tables_and_in_the_gallery() -> None:
    names = {name for name in KC.__all__ if name.startswith("Random")}
    assert {cls.__name__ for cls in generate.augmentations()} == names
    speed = generate.augmentation_speed_table()
    assert all(f"`{name}`" in speed for name in names)
    assert names <= load(ROOT / "examples" / "augmentation_gallery.py").GALLERY.keys()


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.5597, "0.56"), (4.395, "4.4"), (60.75, "61"), (99.7, "100"), (176.0, "180"), (54_250.0, "54 000")],
)
def test_figures(value: float, text: str) -> None:
    assert generate.figures(value) == text


MADE = ("gallery/", "learn/", "do/recipes/", "reference/api/")
"""Folders of docs/ whose pages are made."""


@pytest.mark.parametrize("name", PAGES)
def test_links_and_pictures_exist(name: str) -> None:
    prose = re.sub(r"```.*?```", "", PAGES[name], flags=re.DOTALL)
    for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", prose):
        path = Path(os.path.normpath((ROOT / name).parent / target))
        made = path.is_relative_to(DOCS) and str(path.relative_to(DOCS)).startswith(MADE)
        assert "://" in target or made or path.exists(), target


@pytest.mark.parametrize("name", generate.PICTURES)
def test_pictures_are_small_and_sharp_enough(name: str) -> None:
    path = generate.IMAGES / name
    assert any(f"images/{name}" in text for text in PAGES.values())
    assert path.stat().st_size < 400_000
    with Image.open(path) as picture:
        assert 1200 <= picture.width <= 2000


def test_paths_in_the_layout_exist() -> None:
    lines = page("reference/layout").split("```")[1].splitlines()[1:]
    assert len(lines) > 10
    for line in lines:
        path, what = line.split(maxsplit=1)
        assert (ROOT / path).exists(), path
        if path == "examples/":
            assert all((ROOT / path / name.strip()).exists() for name in what.split(","))
    parts = list((ROOT / "kcam").iterdir())
    modules = {path.name for path in parts if path.suffix == ".py" or (path / "__init__.py").exists()}
    shown = {Path(line.split()[0]).name for line in lines if line.startswith("kcam/")}
    unimportant = {"__init__.py", "__main__.py", "cache.py", "context.py", "demo.py", "precision.py", "ste.py"}
    assert modules - unimportant <= shown, "the layout leaves out a module"


# ---- claims ------------------------------------------------------------------------------------------------------


def quoted_tests() -> list[tuple[str, str]]:
    text = "\n".join(PAGES.values())
    links = re.findall(r"\[`(test_\w+)`\]\((?:\.\./\.\./)?(tests/[\w/]+\.py)\)", text)
    comments = [(name, path) for path, name in re.findall(r"(tests/[\w/]+\.py)::(test_\w+)", text)]
    return sorted(set(links + comments))


@functools.cache
def functions(path: str) -> dict[str, ast.FunctionDef]:
    """Of a file that many lines quote, parsed once."""
    nodes = ast.walk(ast.parse((ROOT / path).read_text()))
    return {node.name: node for node in nodes if isinstance(node, ast.FunctionDef)}


def test_every_quoted_test_exists() -> None:
    assert len(quoted_tests()) > 20
    for name, path in quoted_tests():
        assert name in functions(path), f"{path} has no {name}"


def test_every_claim_in_the_two_tables_names_its_test() -> None:
    for line in page("understand/exact").splitlines():
        if line.startswith("| ") and not line.startswith("| what"):
            assert "[`test_" in line or "| [below]" in line, line


def source_of(name: str, path: str) -> str:
    """A test with its decorators."""
    text = (ROOT / path).read_text()
    node = functions(path)[name]
    first = min([node.lineno, *(decorator.lineno for decorator in node.decorator_list)])
    return "\n".join(text.splitlines()[first - 1 : node.end_lineno])


def test_bounds_in_the_two_tables_are_those_of_the_tests() -> None:
    checked = 0
    for line in page("understand/exact").splitlines():
        link = re.search(r"\[`(test_\w+)`\]\(\.\./\.\./(tests/[\w/]+\.py)\)", line)
        if link is None or not line.startswith("| ") or "glasses" in line:  # the glasses' are in the oracles
            continue
        source = source_of(link[1], link[2])
        for bound in re.findall(r"\d+e-\d+|0\.\d{2,}", line.split("|")[2]):
            assert bound in source, f"{link[1]} says nothing of {bound}"
            checked += 1
    assert checked > 15


def test_stages_in_the_table_are_stages() -> None:
    lens = optics.Lens(optics.CircularAperture(1e-3), optics.ThinLens(1e-2), focus_distance=1.0)
    rows = re.findall(r"^\| `((?:optics|sensor|isp)\..*?)` \|", page("understand/camera"), re.MULTILINE)
    names = {"optics": optics, "sensor": sensor, "isp": isp, "lens": lens, "um": um, "nm": nm, "torch": torch}
    names["painting"] = kcam.style.painting("strokes", size=64)
    stages = [eval(row, names) for row in rows]
    assert all(isinstance(stage, kcam.Stage) for stage in stages)
    public = {
        name for module in (optics, sensor, isp) for name, value in vars(module).items()
        if isinstance(value, type) and issubclass(value, kcam.Stage) and name in module.__all__
    }  # fmt: skip
    assert public - {"Mean", "Clip"} == {type(stage).__name__ for stage in stages}, "a stage is missing"


def test_names_in_the_text_are_all_there_are() -> None:
    composed = page("understand/camera")
    elements = set(re.findall(r"`(\w+)`", composed.split("Elements of a lens", 1)[1].split("\n\n", 1)[0]))
    public = {
        name for name, value in vars(optics).items()
        if isinstance(value, type) and issubclass(value, optics.Element) and value is not optics.Element
    }  # fmt: skip
    assert public <= elements
    assert f"({len(optics.GLASSES)} glasses" in composed
    assert all(f"`{name}`" in composed for name in isp.DEMOSAICS)
    assert all(f"`{name}`" in composed for name in sensor.PATTERNS if len(name) > 4 or name == "rgbw")
    scenes = page("do/scenes").split("The built-in scenes", 1)[1]
    assert set(re.findall(r"`(\w+)`", scenes)) == set(BUILTIN)
    assert set(re.findall(r"^\| `Camera\.(\w+)\(\)`", page("start/photograph"), re.MULTILINE)) == set(PRESETS)


def test_filter_errors_are_those_of_the_fits() -> None:
    text = " ".join(page("understand/limits").split())
    for name, label in (("nikon_5100", "Nikon"), ("sigma_sd_merrill", "Sigma"), ("kodak", "Kodak")):
        errors = ", ".join(f"{100 * error:.1f}" for error in fitted(name).errors)
        assert f"{errors} % ({label})" in text


def test_numbers_of_the_benchmarks_stand_on_their_page() -> None:
    table = page("understand/benchmarks")
    for path in generate.RESULTS.glob("*.json"):
        rows = json.loads(path.read_text()).get("rows", [])
        ours = [row for row in rows if row.get("default") and "ratio" in row]
        if not ours:  # peers and sweeps have tables of their own
            continue
        for row in ours:
            assert generate.figures(row["ratio"]) in table
            assert row["op"] in table
        assert table.count("**0.") == sum(row["ratio"] < 1 for row in ours), "losses are bold"


def test_colour_errors_are_those_that_the_test_asserts() -> None:
    source = (ROOT / "tests" / "isp" / "test_isp_colour.py").read_text()
    for name, label in (("nikon", "Nikon"), ("sigma", "Sigma"), ("kodak", "Kodak")):
        found = re.search(rf'\("{name}", "D65", ([\d.]+), ([\d.]+)\)', source)
        assert found is not None
        assert f"{label} {float(found[1]):.1f} / {float(found[2]):.1f}" in page("understand/exact")


# ---- the changelog -----------------------------------------------------------------------------------------------


def test_the_changelog_knows_this_version() -> None:
    changelog = (ROOT / "CHANGELOG.md").read_text()
    assert re.search(rf"^## {re.escape(kcam.__version__)}\b", changelog, re.MULTILINE)
    assert "Lines of code" in changelog


def test_the_random_state_is_left_alone_by_the_table() -> None:
    state = torch.random.get_rng_state()
    generate.propagators_table()
    assert torch.equal(state, torch.random.get_rng_state())
