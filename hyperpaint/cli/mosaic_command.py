"""The command ``hyperpaint mosaic``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from .console import (
    EXISTING,
    FILE,
    PLACE,
    beside,
    given_of,
    is_watched,
    progress_bar,
    refuse_in_store,
    takes_memory_limit,
)
from .location_options import takes_location


@click.command(
    "mosaic",
    short_help="Put the flight lines of a store on one map.",
    epilog="""\b
Examples:
  hyperpaint mosaic lot.zarr --out mosaic.zarr                       all lines, the steepest view on top
  hyperpaint mosaic lot.zarr --rule unflagged --gsd 0.05 --out mosaic.tif --seamlines seams.geojson
  hyperpaint mosaic lot.zarr --line raw_0 --line raw_3 --ground 152.4 --out two.tif

\b
Where lines are placed is read from the table [geometry] of collect.toml, unless it is given here.
Nothing is averaged: every cell has the spectrum of one pixel, and the store says of which line.
--levelling changes spectra; its factors are stored.""",
)
@click.argument("store", metavar="STORE.zarr", type=EXISTING)
@click.option(
    "--out", metavar="MAP", type=PLACE,
    help="mosaic.tif, all bands in a GeoTIFF; or mosaic.zarr, with line, flags and angles of every cell.  "
    "[default: mosaic.tif beside STORE.zarr]",
)  # fmt: skip
@click.option("--line", "lines", multiple=True, metavar="ID", help="Lines to take.  [default: all]")
@click.option(
    "--rule", type=click.Choice(["nadir", "unflagged", "newest"]), default="nadir",
    help="Which line counts: the steepest view; the same, pixels without flags first; or the last flown.",
)  # fmt: skip
@click.option(
    "--levelling", type=click.Choice(["overlap"]),
    help="Multiply each line by one factor a band, so that lines agree where they overlap.  [default: no]",
)  # fmt: skip
@click.option("--gsd", type=float, metavar="M", help="Edge of a cell.  [default: spacing of the pixels]")
@takes_location
@click.option("--seamlines", type=FILE, metavar="FILE", help="GeoJSON of the area that each line shows.")
@takes_memory_limit
@click.option("--overwrite", is_flag=True, help="Replace what is there.")
@click.option("--quiet", is_flag=True, help="No progress bar.")
def make_mosaic(
    store: Path, out: Path | None, lines: tuple[str, ...], seamlines: Path | None, overwrite: bool,
    quiet: bool, **options: Any,
) -> None:  # fmt: skip
    """Put several flight lines of a store on one map with north up; every cell is of one line."""
    from hyperpaint.workflows.maps import mosaic_of_store, write_map

    out = out or beside(store, "mosaic.tif")
    if out.suffix.lower() not in (".tif", ".tiff", ".zarr"):
        raise click.UsageError(f"--out {out}: expected a name that ends in .tif or .zarr")
    refuse_in_store(store, out, seamlines)
    for path in (out, seamlines):
        if path is not None and path.exists() and not overwrite:
            raise click.UsageError(f"{path} exists; give another place, or --overwrite")
    with progress_bar("looking", is_watched(quiet)) as shown:
        mosaic = mosaic_of_store(store, lines, progress=shown, **given_of(options))
    write_map(mosaic, out, seams=seamlines, overwrite=overwrite, progress=is_watched(quiet))
    rows, cols = mosaic.sizes["y"], mosaic.sizes["x"]
    names = ", ".join(mosaic.attrs["flightlines"])
    click.echo(f"{out}: {rows} x {cols} cells of {mosaic.attrs['gsd']:.4g} m, of the lines {names}")
