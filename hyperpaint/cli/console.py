"""Exit statuses, progress bars and messages that commands share."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from hyperpaint.workflows.pipeline import Outcome

PLACE = click.Path(path_type=Path)
FILE = click.Path(dir_okay=False, path_type=Path)
FOLDER = click.Path(file_okay=False, path_type=Path)
EXISTING = click.Path(exists=True, path_type=Path)
EXISTING_FILE = click.Path(exists=True, dir_okay=False, path_type=Path)

#: Exit statuses of a command: data fail a check; the call or an input is wrong.
FAILED_CHECK, WRONG_INPUT = 1, 2

#: Exit status of a command stopped by a signal, minus the number of the signal: 130 for Ctrl-C, 143 for
#: SIGTERM.
SIGNALLED = 128


def program_option(name: str) -> Any:
    """Return the value of an option of the program, such as ``--memory-limit``."""
    context = click.get_current_context(silent=True)
    return None if context is None else context.find_root().params.get(name)


def is_watched() -> bool:
    """Return whether progress is shown: on a terminal, without ``--quiet``."""
    return sys.stderr.isatty() and not program_option("quiet")


@contextlib.contextmanager
def progress_bar(label: str) -> Iterator[Any]:
    """Yield a function of (done, total) that draws a bar on stderr; None if progress is not shown."""
    if not is_watched():
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


def beside(source: Path, name: str) -> Path:
    """Return the default path of a product: ``name`` in the folder of its source."""
    return source.absolute().parent / name if source.name in ("", ".", "..") else source.with_name(name)


def refuse_in_store(store: Path, *products: Path | None) -> None:
    """Refuse a product inside the store from which it is made (`click.UsageError`)."""
    for path in products:
        if path is not None and store.resolve() in (path.resolve(), *path.resolve().parents):
            raise click.UsageError(f"{path} is in the store itself; choose another path [output-in-store]")


def without_none(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options that are not None; the function has defaults for other options."""
    return {name: value for name, value in options.items() if value is not None}


def say_outcome(outcome: Outcome) -> None:
    """Print which groups of a store were written, and which were complete."""
    written, unchanged = (
        ", ".join(f"/{group}" for group in groups) for groups in (outcome.written, outcome.unchanged)
    )
    if not written:
        click.echo(f"{outcome.path} is already complete: same inputs, same parameters; nothing was done")
        return
    click.echo(f"{outcome.path}: wrote {written}")
    for group, text in outcome.corrected.items():
        click.echo(f"/{group}: {text}")
    if unchanged:
        click.echo(f"{outcome.path}: {unchanged} there already, from the same inputs")
