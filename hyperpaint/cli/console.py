"""What all commands share: how they end and show their progress."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from typing import Any

import click

__all__ = ["FAILED_CHECK", "WRONG_INPUT", "is_watched", "listed", "progress_bar"]

FAILED_CHECK, WRONG_INPUT = 1, 2
"""Exit status of a command: the data fail a check, or the call or an input is wrong."""


def is_watched(quiet: bool) -> bool:
    """Tell whether progress is wanted: a log file is no place for a bar."""
    return not quiet and sys.stderr.isatty()


@contextlib.contextmanager
def progress_bar(label: str, shown: bool) -> Iterator[Any]:
    """Yield what a function calls with (done, to do), to draw a bar on stderr; None where not shown."""
    if not shown:
        yield None
        return
    bars: list[Any] = []
    with contextlib.ExitStack() as stack:

        def update(done: int, total: int) -> None:
            if not bars:
                bar = click.progressbar(length=total, label=label, file=sys.stderr)
                bars.append(stack.enter_context(bar))
            bars[0].update(done - bars[0].pos)
            if done >= total:
                stack.close()

        yield update


def listed(groups: tuple[str, ...]) -> str:
    """Return groups of a store for reading."""
    return ", ".join(f"/{group}" for group in groups)
