"""The command ``hyperpaint orthorectify``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from .console import (
    EXISTING,
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
    "orthorectify",
    short_help="Straighten a flight line into a map.",
    epilog="""\b
Examples:
  hyperpaint orthorectify lot.zarr --line raw_0 --ground 152.4 --field-of-view 18.9 \\
      --column-order left_to_right --out map.tif
  hyperpaint orthorectify lot.zarr --line raw_0 --dem dsm.tif --dem-heights ellipsoid \\
      --focal-length-mm 12 --pixel-pitch-um 7.4 --column-order left_to_right \\
      --boresight 0.34 -0.95 -0.13 --gsd 0.01 --out map.zarr
  hyperpaint orthorectify lot.zarr --line raw_0 --out map.tif           a line that is located already

\b
Heights are above the ellipsoid, as GPS gives them, and not above the sea: a car park may well lie
at -30 m. Where the map is shifted or torn, look first at --boresight, --ground, --clock-offset and
--column-order. What the signs of angles mean is declared in the table [navigation] of collect.toml.""",
)
@click.argument("store", metavar="STORE.zarr", type=EXISTING)
@click.option("--line", metavar="ID", help="Flight line of the store.  [default: the only one]")
@click.option(
    "--out", metavar="MAP", type=PLACE,
    help="map.tif, all bands in a GeoTIFF with overviews; or map.zarr, with flags, times and the place "
    "of every cell.  [default: ID.tif, or map.tif, beside STORE.zarr]",
)  # fmt: skip
@click.option("--gsd", type=float, metavar="M", help="Edge of a cell.  [default: spacing of the pixels]")
@click.option(
    "--grid", type=click.Choice(["north", "flight"]), default="north",
    help="North up, or along the flight: smaller, and turned on the map.",
)  # fmt: skip
@click.option(
    "--method", type=click.Choice(["nearest", "bilinear"]), default="nearest",
    help="Spectra as they are, or interpolated.",
)  # fmt: skip
@takes_location
@click.option("--stac", is_flag=True, help="Write a STAC item beside it, map.json.")
@click.option("--geozarr", is_flag=True, help="Say where map.zarr lies in the attributes of GeoZarr too.")
@takes_memory_limit
@click.option("--overwrite", is_flag=True, help="Replace a map that is there.")
@click.option("--quiet", is_flag=True, help="No progress bar.")
def make_map(store: Path, line: str | None, out: Path | None, quiet: bool, **options: Any) -> None:
    """Straighten a flight line into a map of square cells, from GPS and attitude of its lines.

    Reflectance comes along, computed from counts where the store has no other; into a store also flags, line
    times, view angles, and which line and column every cell shows. Nothing is averaged.
    """
    from hyperpaint.geometry.orthorectification.plausibility import describe_swath
    from hyperpaint.workflows.maps import map_of_store, write_map

    out = out or beside(store, f"{line or 'map'}.tif")
    writing = {name: options.pop(name) for name in ("stac", "geozarr", "overwrite")}
    if writing["geozarr"] and out.suffix.lower() != ".zarr":
        raise click.UsageError(f"--geozarr is of Zarr stores, and --out is {out}")
    if out.suffix.lower() not in (".tif", ".tiff", ".zarr"):
        raise click.UsageError(f"--out {out}: expected a name that ends in .tif or .zarr")
    refuse_in_store(store, out)
    given = given_of(options)
    with progress_bar("looking", is_watched(quiet)) as shown:
        orthomap = map_of_store(store, line, progress=shown, **given)
    notes = write_map(orthomap, out, progress=is_watched(quiet), **writing)
    rows, cols = orthomap.sizes["y"], orthomap.sizes["x"]
    facts = [f"{rows} x {cols} cells of {orthomap.attrs['gsd']:.4g} m", describe_swath(orthomap.attrs), notes]
    click.echo(f"{out}: {', '.join(fact for fact in facts if fact)}")
