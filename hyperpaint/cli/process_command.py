"""The command ``hyperpaint process``: a collect to a store."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from hyperpaint.base.constants import ALIGNMENTS

from .console import EXISTING_FILE, PLACE, is_watched, say_outcome


@click.command(
    short_help="Process a collect into one Zarr store.",
    epilog="""\b
Examples:
  hyperpaint process collect.toml
  hyperpaint process collect.toml --out lot.zarr --reflectance none     a third of the disk
  hyperpaint process collect.toml --out lot.zarr --scheduler tcp://node0:8786""",
)
@click.argument("collect", metavar="COLLECT.toml", type=EXISTING_FILE)
@click.option(
    "--out", metavar="STORE.zarr", type=PLACE,
    help="The store.  [default: products/lot.zarr beside COLLECT.toml, as run makes it]",
)  # fmt: skip
@click.option(
    "--to", type=click.Choice(["radiance", "reflectance"]), default="reflectance",
    help="Radiance needs no irradiance.",
)  # fmt: skip
@click.option(
    "--reflectance", type=click.Choice(["none", "stored"]), default="stored",
    help="'stored' also writes the computed cube, which other programs read as it is; 'none' leaves it to be "
    "computed from counts (.paint.reflectance(), a little slower than reading it): less than half the time, "
    "a third of the disk.",
)  # fmt: skip
@click.option(
    "--alignment", type=click.Choice(ALIGNMENTS),
    help="Correct what separates camera and irradiance record in wavelength and width. 'auto': where "
    "significant; 'never': report only; 'always': whenever it can be found.  [default: as [alignment] apply "
    "of COLLECT.toml, else auto]",
)  # fmt: skip
@click.option("--scheduler", metavar="ADDRESS", help="Compute on this dask.distributed cluster.")
@click.option(
    "--memory-limit", metavar="SIZE",
    help="Most memory of the process, or of each worker, such as '2 GiB'.  [default: 80% of the available]",
)  # fmt: skip
@click.option(
    "--accept", metavar="NAME", multiple=True,
    help="Go on with this finding of `hyperpaint check`; may be given several times.",
)  # fmt: skip
@click.option(
    "--codec", type=click.Choice(["compact", "fast"]), default="compact",
    help="'fast' compresses in half the time, and takes a seventh (counts) to two fifths (reflectance) more "
    "room; every reader reads both.",
)  # fmt: skip
@click.option(
    "--layout", type=click.Choice(["cube", "explore"]), default="cube",
    help="'explore' cuts cubes into eight groups of bands as well, for pictures of single bands; it has "
    "eight times the files.",
)  # fmt: skip
@click.option("--overwrite", is_flag=True, help="Replace groups made from other inputs or parameters.")
@click.option("--quiet", is_flag=True, help="No progress bar.")
def process(collect: Path, out: Path | None, quiet: bool, **options: Any) -> None:
    """Process a collect into one Zarr store of calibrated flight lines.

    Everything is checked before anything is written. An interrupted run is resumed by running it again; a
    store that is already complete is left as it is.
    """
    from hyperpaint.workflows.field_day import store_of
    from hyperpaint.workflows.pipeline import run

    out = out or store_of(collect)
    say_outcome(run(collect, out, progress=is_watched(quiet), **options))
