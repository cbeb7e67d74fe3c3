"""Calls of the command line in this process."""

from typing import Any

from click.testing import CliRunner, Result

from hyperpaint.cli.program import main


def hyperpaint(*words: object, status: int | None = None, **options: Any) -> Result:
    """Return the result of a command; ``status``: its expected exit status, any by default."""
    result = CliRunner().invoke(main, [str(word) for word in words], **options)
    assert status is None or result.exit_code == status, result.output
    return result
