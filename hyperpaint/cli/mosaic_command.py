"""The command ``hyperpaint mosaic``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from .console import EXISTING, FILE, PLACE, beside, is_watched, progress_bar, refuse_in_store, without_none
from .options import command, settable, takes


@command(
    "mosaic",
    epilog="""\b
Examples:
  hyperpaint mosaic lot.zarr --out mosaic.zarr                       all lines, the steepest view on top
  hyperpaint mosaic lot.zarr --rule unflagged --gsd 0.05 --out mosaic.tif --seamlines seams.geojson
  hyperpaint mosaic lot.zarr --line raw_0 --line raw_3 --ground 152.4 --out two.tif

\b
Options of the place default to the table [geometry] of collect.toml. Nothing is averaged; the map stores
the line of every cell. --levelling changes spectra; its factors are stored.""",
)
@click.argument("store", metavar="STORE.zarr", type=EXISTING)
@click.option(
    "--out",
    metavar="MAP",
    type=PLACE,
    help="mosaic.tif, all bands in a GeoTIFF; or mosaic.zarr, with line, flags and angles of every cell.  "
    "[default: mosaic.tif beside STORE.zarr]",
)
@click.option("--line", "lines", multiple=True, metavar="ID", help="Only this line; repeatable.")
@takes(
    "geometry.mosaicking.composing:mosaic",
    only=["rule", "levelling", "gsd"],
    rule={"help": "Line shown in overlaps: the steepest view, unflagged pixels first, or the last flown."},
    levelling={"help": "Multiply each line by one factor a band, so that overlaps agree."},
    gsd={"metavar": "M"},
)
@takes("workflows.maps:location_of", only=["ground", "dem"])
@settable({"workflows.maps:location_of": []}, without=["flightline", "ground", "dem"])
@takes(
    "workflows.maps:write_map",
    only=["seams", "overwrite"],
    seams={"spelling": "--seamlines", "metavar": "FILE", "type": FILE},
)
def make_mosaic(
    store: Path,
    out: Path | None,
    lines: tuple[str, ...],
    seams: Path | None,
    overwrite: bool,
    settings: dict[str, Any],
    **options: Any,
) -> None:
    """Combine flight lines of a store on one map with north up; every cell shows one pixel of one line."""
    from hyperpaint.workflows.maps import mosaic_of_store, write_map

    out = out or beside(store, "mosaic.tif")
    if out.suffix.lower() not in (".tif", ".tiff", ".zarr"):
        raise click.UsageError(f"--out {out}, expected a name that ends in .tif or .zarr [suffix-unknown]")
    refuse_in_store(store, out, seams)
    for path in (out, seams):
        if path is not None and path.exists() and not overwrite:
            raise click.UsageError(f"{path} exists; choose another path, or --overwrite [output-exists]")
    with progress_bar("looking") as shown:
        mosaic = mosaic_of_store(store, lines, progress=shown, **settings, **without_none(options))
    write_map(mosaic, out, seams=seams, overwrite=overwrite, progress=is_watched())
    rows, cols = mosaic.sizes["y"], mosaic.sizes["x"]
    names = ", ".join(mosaic.attrs["flightlines"])
    click.echo(f"{out}: {rows} x {cols} cells of {mosaic.attrs['gsd']:.4g} m, of the lines {names}")
