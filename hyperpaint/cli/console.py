"""What all commands share: how they end, warn and show their progress."""

from __future__ import annotations

import contextlib
import sys
import warnings
from collections.abc import Iterator
from typing import Any

import click

from hyperpaint.base.errors import PaintError, PaintWarning

__all__ = ["FAILED_CHECK", "WRONG_INPUT", "Program", "is_watched", "listed", "progress_bar"]

FAILED_CHECK, WRONG_INPUT = 1, 2
"""Exit status of a command: the data fail a check, or the call or an input is wrong."""


class Program(click.Group):
    """A group of commands whose errors are one readable message, and whose warnings are one line each."""

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command that the context names."""
        with _short_warnings():
            try:
                return super().invoke(ctx)
            except (PaintError, OSError) as error:
                texts = (
                    [error.text(on_command_line=True), *error.notes(on_command_line=True)]
                    if isinstance(error, PaintError)
                    else [str(error)]
                )
                click.echo("error: " + "\n".join(texts), err=True)
                ctx.exit(WRONG_INPUT)


@contextlib.contextmanager
def _short_warnings() -> Iterator[None]:
    """Print each of hyperpaint's own warnings once, without Python's file and line."""
    seen: set[str] = set()
    with warnings.catch_warnings():
        otherwise = warnings.showwarning

        def show(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> None:
            if not issubclass(category, PaintWarning):
                otherwise(message, category, *where, **more)
            elif str(message) not in seen:
                seen.add(str(message))
                click.echo(f"warning: {message}", err=True)

        warnings.showwarning = show
        warnings.simplefilter("always", PaintWarning)
        yield


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
