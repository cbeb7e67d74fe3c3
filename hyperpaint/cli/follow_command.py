"""The command ``hyperpaint follow``: a flight to a store, while it is recorded."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from hyperpaint.base.constants import ALIGNMENTS

from .console import EXISTING_FILE, FOLDER, PLACE, given_of, is_watched, say_outcome

if TYPE_CHECKING:
    from hyperpaint.workflows.following import FlightState


@click.command(
    short_help="Process a flight while it is being recorded.",
    epilog="""\b
Examples:
  hyperpaint follow flight                              collect.toml in flight, or in the folder above
  hyperpaint follow flight --collect lot.toml --out lot.zarr
  hyperpaint follow flight --idle 60                    spectra come once a minute""",
)
@click.argument("flight", metavar="FLIGHT_FOLDER", type=FOLDER)
@click.option(
    "--collect", metavar="COLLECT.toml", type=EXISTING_FILE,
    help="What the flight is made of; its files may still be to come.  [default: collect.toml in the folder, "
    "else in the folder above]",
)  # fmt: skip
@click.option(
    "--out", metavar="STORE.zarr", type=PLACE,
    help="The store.  [default: products/lot.zarr beside COLLECT.toml]",
)  # fmt: skip
@click.option(
    "--idle", type=click.FloatRange(min=0.5), metavar="SECONDS",
    help="The flight has ended when nothing has grown for so long.  [default: 10]",
)  # fmt: skip
@click.option(
    "--reflectance", type=click.Choice(["none", "stored"]),
    help="'none' leaves reflectance to be computed from counts.  [default: stored]",
)  # fmt: skip
@click.option(
    "--alignment", type=click.Choice(ALIGNMENTS),
    help="As of process. Where it corrects a line, which only the whole line can tell, its reflectance is "
    "computed when the flight has ended.",
)  # fmt: skip
@click.option(
    "--codec", type=click.Choice(["compact", "fast"]),
    help="As of process: 'fast' compresses in half the time and takes more room.  [default: compact]",
)  # fmt: skip
@click.option(
    "--accept", multiple=True, metavar="FINDING",
    help="Go on with this finding of `hyperpaint check`; may be given several times.",
)  # fmt: skip
@click.option("--overwrite", is_flag=True, help="Replace groups made from other inputs or parameters.")
@click.option("--quiet", is_flag=True, help="No line that says rate, lag and flags.")
def follow(flight: Path, quiet: bool, **options: Any) -> None:
    """Process a flight while it is being recorded: complete lines only, at the pace of the camera.

    One line says how many lines are processed, at which rate they come, how far processing is behind, and
    which flags were set. The flight has ended when its lines are those that the header promises, when nothing
    has grown for --idle seconds, or at Ctrl-C; then the store is finished, and is that of `hyperpaint
    process`. Killed, the same command goes on.
    """
    from hyperpaint.workflows import following

    is_shown = is_watched(quiet)

    def say(state: FlightState) -> None:
        width = shutil.get_terminal_size().columns - 1
        click.echo(f"\r{str(state)[:width]:{width}}", nl=False, err=True)

    outcome = following.follow(
        flight, options.pop("out"), watch=say if is_shown else None, progress=is_shown, **given_of(options)
    )
    if is_shown:
        sys.stderr.write("\n")
    say_outcome(outcome)
