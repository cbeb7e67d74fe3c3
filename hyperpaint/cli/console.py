"""What all commands share: how they end and show their progress."""

from __future__ import annotations

import contextlib
import functools
import sys
from collections.abc import Callable, Iterator, Mapping
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

FAILED_CHECK, WRONG_INPUT = 1, 2
"""Exit status of a command: the data fail a check, or the call or an input is wrong."""

SIGNALLED = 128
"""Added to the number of a signal that stopped a command, as shells do: 130 for Ctrl-C, 143 for SIGTERM."""


def takes_memory_limit(command: Callable[..., Any]) -> Callable[..., Any]:
    """Return a command with the option of that name, which then plans with no more than it says."""

    @functools.wraps(command)
    def limited(*args: Any, memory_limit: str | None, **options: Any) -> Any:
        from hyperpaint.io.store import budget

        with budget.memory_limit(memory_limit):
            return command(*args, **options)

    return click.option(
        "--memory-limit", metavar="SIZE",
        help="Most memory of the process, such as '2 GiB': fewer threads are taken where more would be "
        "needed.  [default: 80% of the available]",
    )(limited)  # fmt: skip


def is_watched(quiet: bool) -> bool:
    """Return whether progress is wanted: not in a log file."""
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


def beside(source: Path, name: str) -> Path:
    """Return where a product goes that nobody gave a place: to its source, under a name of its own."""
    return source.absolute().parent / name if source.name in ("", ".", "..") else source.with_name(name)


def refuse_in_store(store: Path, *products: Path | None) -> None:
    """Refuse to write a product into the store that it is made from, whatever may be overwritten."""
    for path in products:
        if path is not None and store.resolve() in (path.resolve(), *path.resolve().parents):
            raise click.UsageError(f"{path} is in the store itself; choose another path")


def given_of(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options that the call names; the others have the defaults of the function."""
    return {name: value for name, value in options.items() if value is not None}


def say_outcome(outcome: Outcome) -> None:
    """Say which groups of a store were written, and which were there already."""
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
