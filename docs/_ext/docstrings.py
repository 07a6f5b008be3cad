"""Turn kcam's docstrings into reStructuredText: their layout is that of style.md, for readers of the source.

Args:      name: what it is [unit]. other: ...     becomes a field for each parameter of the signature
Returns:   ...                                     a field
Raises:    ValueError for ...; TypeError for ...   a field for each class
Source:    ...                                     a paragraph with a bold head
indented lines between blank ones                  an equation as it is written
`name`                                             a link where the site knows the name, else code
"""

from __future__ import annotations

import ast
import functools
import importlib
import inspect
import re
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import kcam

MODULES = (
    "kcam", "kcam.optics", "kcam.sensor", "kcam.isp", "kcam.augmentation", "kcam.data", "kcam.style", "kcam.planner",
    "kcam.tradeoff", "kcam.plots", "kcam.calibration", "kcam.analysis", "kcam.spectral", "kcam.files", "kcam.units",
    "kcam.effects", "kcam.measure",
)  # fmt: skip
"""Those of the reference."""

HEAD = re.compile(r"(Args|Arguments|Returns|Yields|Raises|Warns|Source|Gradient|Example|Equation):\s*(.*)")
CODE = re.compile(r"(?<![`:\w])`([^`\n]+)`(?!`)")
RAISED = re.compile(r"\b(\w+(?:Error|Warning|OutOfRange|Stopped))(?=,? (?:for|if|where|when|naming|that))")
LITERAL = re.compile(r"``.*?``", re.DOTALL)


def public_names() -> dict[str, str]:
    """Short name -> full name of what the reference documents."""
    found: dict[str, str] = {}
    for module_name in MODULES:
        module = importlib.import_module(module_name)
        for name in members(module_name):
            found.setdefault(name, f"{module_name}.{name}")
            found.setdefault(f"{module_name.rsplit('.', 1)[-1]}.{name}", f"{module_name}.{name}")
            value = getattr(module, name)
            if inspect.isclass(value):
                for member in vars(value):
                    if not member.startswith("_"):
                        found.setdefault(f"{name}.{member}", f"{module_name}.{name}.{member}")
    return found


def members(module_name: str) -> list[str]:
    """Public names of a module: its `__all__`, or what it defines and documents; each in the first that has it."""
    module = importlib.import_module(module_name)
    if hasattr(module, "__all__"):
        named = [name for name in module.__all__ if name != "__version__"]
        named = [name for name in named if not inspect.ismodule(getattr(module, name))]
        return [name for name in named if module_name == "kcam" or name not in kcam.__all__]
    own = [name for name, value in vars(module).items() if getattr(value, "__module__", "") == module_name]
    values = [name for name, said in constants(module_name).items() if said]
    return [name for name in (*own, *values) if not name.startswith("_")]


def constants(module_name: str) -> dict[str, str]:
    """Constants that a module sets, and the string that follows each."""
    found: dict[str, str] = {}
    body = _tree(module_name).body
    for node, after in pairwise([*body, ast.Pass()]):
        target = node.targets[0] if isinstance(node, ast.Assign) else getattr(node, "target", None)
        if isinstance(target, ast.Name):
            told = after.value.value if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant) else ""
            found[target.id] = inspect.cleandoc(told) if isinstance(told, str) else ""
    return found


def told(module_name: str, name: str) -> str:
    """What is said of a constant where it is set."""
    own = constants(module_name)
    if name in own:
        return own[name]
    for node in _tree(module_name).body:
        if isinstance(node, ast.ImportFrom) and node.module and any((a.asname or a.name) == name for a in node.names):
            return told(node.module, next(a.name for a in node.names if (a.asname or a.name) == name))
    return ""


@functools.cache
def _tree(module_name: str) -> ast.Module:
    return ast.parse(inspect.getsource(importlib.import_module(module_name)))


class Converter:
    """Docstrings to reStructuredText, with links to what is public."""

    def __init__(self) -> None:
        self.names = public_names()
        self.full = set(self.names.values()) | {f"{module}.{name}" for module in MODULES for name in members(module)}

    def find(self, word: str, place: str) -> str | None:
        """The full name of a word, as one means it there: first what belongs to the same class or module."""
        word = word.removesuffix("()")
        while place:
            if f"{place}.{word}" in self.full:
                return f"{place}.{word}"
            place = place.rpartition(".")[0]
        return self.names.get(word.removeprefix("kcam."))

    def code(self, text: str, place: str = "") -> str:
        """Single backticks: a link to a public name, or code."""

        def one(match: re.Match[str]) -> str:
            full = self.find(match[1], place)
            return f":py:obj:`{match[1]} <{full}>`" if full else f"``{match[1]}``"

        parts, end = [], 0
        for literal in LITERAL.finditer(text):
            parts += [CODE.sub(one, _escaped(text[end : literal.start()])), literal[0]]
            end = literal.end()
        return "".join(parts) + CODE.sub(one, _escaped(text[end:]))

    def convert(self, lines: list[str], parameters: list[str], place: str = "") -> list[str]:
        """The lines of one docstring of what has that full name."""
        result: list[str] = []
        fields: list[str] = []
        index = 0
        while index < len(lines):
            line = lines[index]
            head = HEAD.fullmatch(line)
            if head and head[1] == "Example":
                result += ["", ".. rubric:: Example", "", *(text.removeprefix("    ") for text in lines[index + 1 :])]
                break
            if head:
                body = [head[2]]
                while index + 1 < len(lines) and lines[index + 1].startswith(" "):
                    index += 1
                    body.append(lines[index])
                fields += list(self._field(head[1], body, parameters, place))
            elif line.startswith("    ") and (not result or not result[-1].strip()):
                block = [line]
                while index + 1 < len(lines) and (lines[index + 1].startswith("    ") or not lines[index + 1].strip()):
                    index += 1
                    block.append(lines[index])
                result += ["", ".. code-block:: text", "", *block, ""]
            else:
                while line.strip() and index + 1 < len(lines) and lines[index + 1].startswith("  "):
                    index += 1  # a head of its own: "Fields: ..." goes on indented
                    line = f"{line} {lines[index].strip()}"
                result.append(self.code(line, place))
            index += 1
        if fields:
            at = next((i for i, line in enumerate(result) if line == ".. rubric:: Example"), len(result))
            result[at:at] = ["", *fields, ""]
        return result

    def _field(self, head: str, body: list[str], parameters: list[str], place: str) -> Iterator[str]:
        text = self.code(" ".join(line.strip() for line in body if line.strip()), place)
        if head in ("Args", "Arguments"):
            yield from _parameters(text, parameters)
        elif head in ("Returns", "Yields"):
            yield f":returns: {text}"
        elif head == "Raises":
            marks = [*RAISED.finditer(text)]
            if not marks or marks[0].start() > 0:
                yield f":raises: {text}"
                return
            ends = [*(mark.start() for mark in marks[1:]), len(text)]
            for mark, end in zip(marks, ends, strict=True):
                yield f":raises {mark[1]}: {text[mark.end() : end].strip(' ;,')}"
        else:
            yield f":{head}: {text}"


def _escaped(text: str) -> str:
    """Bars of absolute values and stars of file names are no markup."""
    return re.sub(r"(?<![`\w\\])\*(?=\.)", r"\*", text.replace("|", r"\|"))


def _parameters(text: str, parameters: list[str]) -> Iterator[str]:
    """A field for each parameter that is told of; what stands before the first is a field of its own."""
    names = "|".join(sorted(map(re.escape, parameters), key=len, reverse=True)) or "(?!)"
    mark = re.compile(rf"(?:^|(?<=[.;,)\]] )|(?<=  ))((?:{names})(?:(?:, | and )(?:{names}))*): ")
    found = [*mark.finditer(text)]
    if not found:
        yield f":Arguments: {text}"
        return
    if found[0].start() > 0:
        yield f":Arguments: {text[: found[0].start()].strip()}"
    ends = [*(match.start() for match in found[1:]), len(text)]
    for match, end in zip(found, ends, strict=True):
        for name in re.split(r", | and ", match[1]):
            yield f":param {name}: {text[match.end() : end].strip()}"


def write_reference(folder: Path) -> None:
    """A page for each module, which lists what is public in it; pages of the names themselves come of that."""
    converter = Converter()
    folder.mkdir(exist_ok=True)
    for module_name in MODULES:
        module = importlib.import_module(module_name)
        names = members(module_name)
        values = [name for name in names if not callable(getattr(module, name))]
        lines = [module_name, "=" * len(module_name), "", converter.code((module.__doc__ or "").split("\n\n")[0]), ""]
        lines += [f".. currentmodule:: {module_name}", ""]
        if len(values) < len(names):
            lines += [".. autosummary::", f"   :toctree: {module_name}", "   :nosignatures:", ""]
            lines += [f"   {name}" for name in names if name not in values] + [""]
        for name in values:
            about = converter.code(" ".join(told(module_name, name).split()))
            lines += [f".. py:data:: {name}", "", f"   {about or type(getattr(module, name)).__name__}", ""]
        path, text = folder / f"{module_name}.rst", "\n".join(lines)
        if not path.exists() or path.read_text() != text:  # else all would be read anew
            path.write_text(text)


def setup(app: Any) -> dict[str, bool]:
    """Sphinx's hook."""
    converter = Converter()

    def process(app: Any, what: str, name: str, value: Any, options: Any, lines: list[str]) -> None:
        try:
            parameters = list(inspect.signature(value).parameters)
        except (TypeError, ValueError):
            parameters = []
        lines[:] = converter.convert(lines, parameters, name)

    app.connect("autodoc-process-docstring", process)
    return {"parallel_read_safe": True}
