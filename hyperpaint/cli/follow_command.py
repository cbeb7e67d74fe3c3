"""The command ``hyperpaint follow``: a flight to a store, while it is recorded."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from .console import EXISTING_FILE, FOLDER, PLACE, is_watched, say_outcome, without_none
from .options import command, takes

if TYPE_CHECKING:
    from hyperpaint.workflows.following import FlightState


@command(
    epilog="""\b
Examples:
  hyperpaint follow flight                              collect.toml in flight, or in the folder above
  hyperpaint follow flight --collect lot.toml --out lot.zarr
  hyperpaint follow flight --idle 60                    spectra come once a minute""",
)
@click.argument("flight", metavar="FLIGHT_FOLDER", type=FOLDER)
@takes(
    "workflows.following:follow",
    without=["watch"],
    out={"metavar": "STORE.zarr", "type": PLACE},
    collect={"metavar": "COLLECT.toml", "type": EXISTING_FILE},
    idle={"type": click.FloatRange(min=0.5), "metavar": "SECONDS"},
)
@takes(
    "workflows.pipeline:process",
    only=["reflectance", "alignment", "codec", "accept", "overwrite"],
    reflectance={"help": "'none' leaves reflectance to be computed from counts."},
    alignment={"help": "See process; a line is corrected when the flight has ended."},
    codec={"help": "See process."},
)
def follow(flight: Path, **options: Any) -> None:
    """Process a flight while it is being recorded: complete lines only, at the pace of the camera.

    One line says how many lines are processed, at which rate they come, how far processing is behind, and
    which flags were set. The flight has ended when its lines are those that the header promises, when nothing
    has grown for --idle seconds, or at Ctrl-C; then the store is finished, and is that of `hyperpaint
    process`. Killed, the same command goes on.
    """
    from hyperpaint.workflows import following

    is_shown = is_watched()

    def say(state: FlightState) -> None:
        width = shutil.get_terminal_size().columns - 1
        click.echo(f"\r{str(state)[:width]:{width}}", nl=False, err=True)

    outcome = following.follow(
        flight,
        options.pop("out"),
        watch=say if is_shown else None,
        progress=is_shown,
        **without_none(options),
    )
    if is_shown:
        sys.stderr.write("\n")
    say_outcome(outcome)
