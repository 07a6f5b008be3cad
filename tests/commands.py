"""The command `kcam`, called in this process."""

from __future__ import annotations

import math

import pytest
import typer
from click.testing import Result
from typer.testing import CliRunner

from kcam import cli
from kcam.cli import console


def invoke(app: typer.Typer, *arguments: object) -> Result:
    """What a command did, without the lines of progress that a slow machine sees between those it asserts."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(console, "OFTEN", math.inf)
        patch.setattr(console, "SELDOM", math.inf)
        return CliRunner().invoke(app, [str(argument) for argument in arguments])


def run(*arguments: object, status: int = 0) -> str:
    """What the command printed."""
    result = invoke(cli.app, *arguments)
    assert result.exit_code == status, result.output
    return result.output


def fails(*arguments: object) -> str:
    """The one line that a bad input gets."""
    output = run(*arguments, status=2)
    assert output.startswith("kcam: ")
    assert output.count("\n") == 1, output
    assert "Traceback" not in output
    return output
