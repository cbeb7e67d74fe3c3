"""The command ``hyperpaint orthorectify``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from .console import EXISTING, PLACE, given_of, is_watched, progress_bar

__all__ = ["make_map"]

_ANGLES = click.Tuple([float, float, float])


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
    "--out", required=True, metavar="MAP", type=PLACE,
    help="map.tif, all bands in a GeoTIFF; or map.zarr, with flags, times and the place of every cell.",
)  # fmt: skip
@click.option("--gsd", type=float, metavar="M", help="Edge of a cell.  [default: spacing of the pixels]")
@click.option(
    "--grid", type=click.Choice(["flight", "north"]), help="Cells along the flight, or north up.  "
    "[default: north for .tif, flight for .zarr]",
)  # fmt: skip
@click.option(
    "--method", type=click.Choice(["nearest", "bilinear"]), default="nearest",
    help="Spectra as they are, or interpolated.",
)  # fmt: skip
@click.option("--ground", type=float, metavar="M", help="Height of level ground.")
@click.option("--dem", type=EXISTING, metavar="FILE", help="Heights, instead of --ground.")
@click.option(
    "--dem-heights", type=click.Choice(["ellipsoid", "geoid"]), help="What the heights of --dem are above."
)
@click.option("--geoid", type=float, metavar="M", help="Height of the geoid above the ellipsoid there.")
@click.option("--field-of-view", type=float, metavar="DEGREE", help="Between the outer edges of the columns.")
@click.option("--focal-length-mm", type=float, metavar="MM", help="With --pixel-pitch-um, instead.")
@click.option("--pixel-pitch-um", type=float, metavar="UM", help="Distance of columns on the detector.")
@click.option(
    "--column-order", type=click.Choice(["left_to_right", "right_to_left"]), help="Which way the columns go."
)
@click.option("--boresight", type=_ANGLES, metavar="R P H", help="Turn of the camera in the body [degree].")
@click.option("--lever-arm", type=_ANGLES, metavar="F R D", help="Camera from the antenna [m].")
@click.option("--clock-offset", type=float, metavar="S", help="Added to line times.")
@click.option("--crs", metavar="EPSG:N", help="Map.  [default: UTM zone of the line]")
@click.option("--overwrite", is_flag=True, help="Replace a map that is there.")
@click.option("--quiet", is_flag=True, help="No progress bar.")
def make_map(
    store: Path, line: str | None, out: Path, gsd: float | None, grid: Any, method: Any, overwrite: bool,
    quiet: bool, **options: Any,
) -> None:  # fmt: skip
    """Straighten a flight line into a map of square cells, from GPS and attitude of its lines.

    Reflectance comes along, computed from counts where the store has no other; into a store also flags, line
    times, view angles, and which line and column every cell shows. Nothing is averaged.
    """
    from hyperpaint.workflows.maps import map_of_store, write_map

    if out.suffix.lower() not in (".tif", ".tiff", ".zarr"):
        raise click.UsageError(f"--out {out}: expected a name that ends in .tif or .zarr")
    chosen = grid or ("flight" if out.suffix.lower() == ".zarr" else "north")
    given = given_of(options)
    with progress_bar("looking", is_watched(quiet)) as shown:
        orthomap = map_of_store(store, line, gsd=gsd, grid=chosen, method=method, progress=shown, **given)
    write_map(orthomap, out, overwrite=overwrite, progress=is_watched(quiet))
    rows, cols = orthomap.sizes["y"], orthomap.sizes["x"]
    click.echo(f"{out}: {rows} x {cols} cells of {orthomap.attrs['gsd']:.4g} m")
