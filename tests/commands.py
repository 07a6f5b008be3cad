"""The command `kcam`, called in this process."""

from __future__ import annotations

from typer.testing import CliRunner

from kcam import cli


def run(*arguments: object, status: int = 0) -> str:
    """What the command printed."""
    result = CliRunner().invoke(cli.app, [str(argument) for argument in arguments])
    assert result.exit_code == status, result.output
    return result.output


def fails(*arguments: object) -> str:
    """The one line that a bad input gets."""
    output = run(*arguments, status=2)
    assert output.startswith("kcam: ")
    assert output.count("\n") == 1, output
    assert "Traceback" not in output
    return output
