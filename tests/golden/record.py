"""Record the answers of this version: ``PYTHONPATH=tests python -m golden.record`` in the root of the repository.

Without arguments it answers what has no recorded answer, and forgets what is asked no more: what was recorded stays the
answer of the version before. ``--all`` records everything anew, ``--files`` writes the saved cameras and plans first.
``--spread`` records nothing and lists what is more than a quarter of its tolerance off.
"""

from __future__ import annotations

import argparse
import json
import subprocess
from pathlib import Path
from typing import Any

import torch
from golden.cameras import CAMERAS, FILES
from golden.digest import differences, digest
from golden.plans import DEFAULT_RATES, SAVED
from golden.question import Question
from golden.questions import QUESTIONS
from golden.rounding import factor

import kcam
from kcam import files

VALUES = Path(__file__).parent / "values.json"


def write_files() -> None:
    """Cameras and plans as this version saves them."""
    FILES.mkdir(exist_ok=True)
    with DEFAULT_RATES:
        for name, make in CAMERAS.items():
            make().save(FILES / f"{name}.safetensors")
        for name, (make, scenes, tolerance) in SAVED.items():
            make().plan(scenes(), tolerance=tolerance).save(FILES / f"{name}.json")


def write_values(answers: dict[str, object]) -> None:
    """A line for each answer, so that a change shows what it changes."""
    lines = []
    for question, answer in sorted(answers.items()):
        parts = ",\n".join(f"  {json.dumps(name)}: {json.dumps(value)}" for name, value in answer.items())
        lines.append(f" {json.dumps(question)}: {{\n{parts}\n }}")
    files.replace(VALUES, ("{\n" + ",\n".join(lines) + "\n}\n").encode())


def answered(question: Question) -> Any:
    """The digest of an answer, as it comes back from the file."""
    return json.loads(json.dumps(digest(question.ask())))


def spread(known: dict[str, Any]) -> None:
    """Print what is off by how many times its tolerance."""
    for name, question in QUESTIONS.items():
        found = answered(question)
        for answer, kept in known[name].items():
            allowed = factor(name, answer)
            for times, text in differences(kept, found[answer], answer):
                if times > allowed / 4:
                    print(f"{times:9.3g} of {allowed:g} | {name} | {text}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--all", action="store_true", help="record everything anew")
    parser.add_argument("--files", action="store_true", help="write the saved cameras and plans anew")
    parser.add_argument("--spread", action="store_true", help="list what comes near its tolerance")
    asked = parser.parse_args()
    torch.set_num_threads(1)
    commit = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, check=True).stdout.strip()
    print(f"{kcam.__file__} at {commit[:10]}, torch {torch.__version__}")
    if asked.files:
        write_files()
    known = {} if asked.all or not VALUES.exists() else json.loads(VALUES.read_text())
    if asked.spread:
        spread(known)
        return
    answers = {}
    for name, question in QUESTIONS.items():
        answers[name] = known[name] if name in known else answered(question)
    write_values(answers)
    print(f"{len(answers)} questions, {VALUES.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
