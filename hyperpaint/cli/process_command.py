"""The command ``hyperpaint process``: a collect to a store."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from .console import EXISTING_FILE, PLACE, is_watched, program_option, say_outcome
from .options import command, takes


@command(
    epilog="""\b
Examples:
  hyperpaint process collect.toml
  hyperpaint process collect.toml --out lot.zarr --reflectance none     a third of the disk
  hyperpaint process collect.toml --out lot.zarr --scheduler tcp://node0:8786""",
)
@click.argument("collect", metavar="COLLECT.toml", type=EXISTING_FILE)
@takes(
    "workflows.pipeline:process",
    without=["memory_limit"],
    out={
        "metavar": "STORE.zarr",
        "type": PLACE,
        "required": False,
        "help": "The store.  [default: products/lot.zarr beside COLLECT.toml, as run makes it]",
    },
    to={"help": "Radiance needs no irradiance."},
    reflectance={
        "help": "'none' leaves reflectance to be computed from counts: half the time, a third of the disk."
    },
    alignment={"help": "Correct wavelengths between camera and record.  [default: as COLLECT.toml]"},
    scheduler={"metavar": "ADDRESS", "help": "Compute on this dask.distributed cluster."},
    codec={"help": "'fast' compresses in half the time and takes 15 to 40 % more disk."},
    layout={"help": "'explore' splits cubes into eight band groups, for pictures of single bands."},
)
def process(collect: Path, out: Path | None, **options: Any) -> None:
    """Process a collect into one Zarr store of calibrated flight lines.

    Everything is checked before anything is written. Run again, the command resumes an interrupted run and
    leaves a complete store unchanged.
    """
    from hyperpaint.workflows.field_day import store_of
    from hyperpaint.workflows.pipeline import run

    limit = program_option("memory_limit")
    say_outcome(run(collect, out or store_of(collect), memory_limit=limit, progress=is_watched(), **options))
