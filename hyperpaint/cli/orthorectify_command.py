"""The command ``hyperpaint orthorectify``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from .console import EXISTING, PLACE, beside, is_watched, progress_bar, refuse_in_store, without_none
from .options import command, settable, takes


@command(
    "orthorectify",
    epilog="""\b
Examples:
  hyperpaint orthorectify lot.zarr --line raw_0 --ground 152.4 --out map.tif \\
      --set field_of_view=18.9 --set column_order=left_to_right
  hyperpaint orthorectify lot.zarr --line raw_0 --dem dsm.tif --out map.zarr --gsd 0.01 \\
      --set dem_heights=ellipsoid --set focal_length_mm=12 --set pixel_pitch_um=7.4 \\
      --set column_order=left_to_right --set boresight=0.34,-0.95,-0.13
  hyperpaint orthorectify lot.zarr --line raw_0 --out map.tif           a line that is located already

\b
Heights are above the ellipsoid, as GPS gives them, not above the sea. If the map is shifted or torn, check
boresight, ground, clock_offset and column_order first. The signs of angles are declared in the table
[navigation] of collect.toml.""",
)
@click.argument("store", metavar="STORE.zarr", type=EXISTING)
@click.option("--line", metavar="ID", help="Flight line of the store.  [default: the only one]")
@click.option(
    "--out",
    metavar="MAP",
    type=PLACE,
    help="map.tif, a GeoTIFF with overviews, or map.zarr.  [default: ID.tif, or map.tif, beside STORE.zarr]",
)
@takes(
    "geometry.orthorectification.mapping:orthorectify",
    only=["gsd", "grid", "method"],
    gsd={"metavar": "M"},
    grid={"help": "North up, or rows across the flight: a smaller file."},
    method={"help": "Unchanged spectra, or interpolated ones."},
)
@takes("workflows.maps:location_of", only=["ground", "dem"])
@settable({"workflows.maps:location_of": []}, without=["flightline", "ground", "dem"])
@takes("workflows.maps:write_map", only=["stac", "geozarr", "overwrite"])
def make_map(
    store: Path, line: str | None, out: Path | None, settings: dict[str, Any], **options: Any
) -> None:
    """Resample a flight line to a map of square cells, by the position and attitude of its lines.

    A GeoTIFF holds reflectance; a store also holds flags, line times, view angles, and the line and column of
    every cell. Nothing is averaged.
    """
    from hyperpaint.geometry.orthorectification.plausibility import describe_swath
    from hyperpaint.workflows.maps import map_of_store, write_map

    out = out or beside(store, f"{line or 'map'}.tif")
    writing = {name: options.pop(name) for name in ("stac", "geozarr", "overwrite")}
    if writing["geozarr"] and out.suffix.lower() != ".zarr":
        raise click.UsageError(f"--geozarr needs an --out that ends in .zarr, not {out} [option-conflict]")
    if out.suffix.lower() not in (".tif", ".tiff", ".zarr"):
        raise click.UsageError(f"--out {out}, expected a name that ends in .tif or .zarr [suffix-unknown]")
    refuse_in_store(store, out)
    given = {**settings, **without_none(options)}
    with progress_bar("looking") as shown:
        orthomap = map_of_store(store, line, progress=shown, **given)
    notes = write_map(orthomap, out, progress=is_watched(), **writing)
    rows, cols = orthomap.sizes["y"], orthomap.sizes["x"]
    facts = [f"{rows} x {cols} cells of {orthomap.attrs['gsd']:.4g} m", describe_swath(orthomap.attrs), notes]
    click.echo(f"{out}: {', '.join(fact for fact in facts if fact)}")
