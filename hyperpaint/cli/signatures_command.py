"""The command ``hyperpaint signatures``: regions of a store to a paint library."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from .console import EXISTING, PLACE, beside, progress_bar, without_none
from .options import command, settable, takes


@command(
    "signatures",
    epilog="""\b
Examples:
  hyperpaint signatures lot.zarr --regions cars.geojson --out paints.zarr
  hyperpaint signatures lot.zarr --out paints.zarr                     roofs of cars, proposed by rule
  hyperpaint signatures lot.zarr --regions cars.geojson --out paints.zarr --keep shadow
  hyperpaint signatures lot.zarr --regions cars.geojson --out paints.zarr --no-flags
  hyperpaint signatures lot.zarr --regions cars.geojson --out paints.zarr --smooth box --window 5
  hyperpaint signatures lot.zarr --regions qgis.geojson --out paints.zarr --ground 152.4
  hyperpaint signatures map.zarr --regions qgis.geojson --out paints.zarr
""",
)
@click.argument("store", metavar="STORE.zarr", type=EXISTING)
@click.option("--regions", metavar="R.geojson", type=EXISTING, help="Regions.  [default: proposed by rule]")
@click.option(
    "--out",
    metavar="LIBRARY.zarr",
    type=PLACE,
    help="The paint library.  [default: paints.zarr beside STORE.zarr]",
)
@click.option(
    "--keep",
    multiple=True,
    metavar="FLAG",
    help="Use pixels with this flag, such as shadow, which are otherwise left out; repeatable.",
)
@click.option("--smooth", type=click.Choice(["savitzky-golay", "box"]), help="Smooth spectra.")
@click.option("--window", type=int, default=11, help="Window of --smooth [bands], an odd number.")
@takes(
    "paints.signatures.extraction:extract_signatures",
    only=["centre", "specular_sky", "coat", "sun_zenith", "members", "min_pixels", "drop_small"],
    centre={
        "type": click.Choice(["trimmed_mean", "geometric_median", "median"]),
        "help": "Estimator of the centre.",
    },
    specular_sky={"help": "Subtract the sky that a clear coat mirrors."},
    coat={"help": "Correct the transmission of the clear coat.  [default: with --specular-sky]"},
    sun_zenith={
        "type": click.FloatRange(0.0, 90.0),
        "metavar": "DEGREE",
        "help": "Zenith angle of the sun.  [default: from time and position of the line]",
    },
    members={"type": click.IntRange(min=0), "help": "Maximum number of pixels of a region to store."},
    min_pixels={"type": click.IntRange(min=1), "help": "Minimum number of pixels of a region."},
    drop_small={"help": "Leave out regions with fewer pixels, instead of an error."},
)
@click.option("--flags/--no-flags", default=True, help="Flag unflagged lines first.")
@takes("workflows.maps:location_of", only=["ground", "dem"])
@settable(
    {
        "workflows.maps:location_of": [],
        "surroundings.flags:flag": ["glint", "shadow", "adjacency"],
        "paints.signatures.extraction:extract_signatures": ["diffuse", "coat_index"],
    },
    without=["flightline", "ground", "dem"],
)
@click.option("--overwrite", is_flag=True, help="Replace an existing library of other inputs.")
def make_signatures(
    store: Path,
    regions: Path | None,
    out: Path | None,
    smooth: str | None,
    window: int,
    flags: bool,
    ground: float | None,
    dem: Path | None,
    settings: dict[str, Any],
    **options: Any,
) -> None:
    """Extract a library of paint signatures from regions of a processed store.

    STORE is the output of process or orthorectify. Regions are polygons in GeoJSON: x the column and y the
    line of the cube, or map coordinates where the file names a crs; each has a property name (and flightline,
    where the store has several). A paint has centre, spread, quantiles, pixels, uncertainty, flags and the
    properties of its region. Pixels with saturation, glint, shadow or a neighbour's light are left out.
    --ground, --dem and --set place the lines for regions in map coordinates.
    """
    from hyperpaint.workflows.library_files import NOT_LOOKED_FOR, table_of, write_signatures

    smoothing = None if smooth is None else {"method": smooth, "window": window}
    limits = {
        name: settings.pop(name) for name in ("diffuse", "glint", "shadow", "adjacency") if name in settings
    }
    options |= {name: settings.pop(name) for name in ("coat_index",) if name in settings}
    location = without_none({"ground": ground, "dem": dem, **settings})
    if limits and not flags:
        named = ", ".join(f"--set {name}" for name in limits)
        raise click.UsageError(f"--no-flags excludes {named}; leave out one of them [option-conflict]")
    out = out or beside(store, "paints.zarr")
    with progress_bar("flags and signatures" if flags else "extracting") as shown:
        library = write_signatures(
            store,
            regions,
            out,
            smooth=smoothing,
            flags=limits or flags,
            location=location,
            progress=shown,
            **options,
        )
    if flags and library.attrs["flags"] == NOT_LOOKED_FOR:
        click.echo(
            "glint, shadow and light of neighbours are not flagged on a map; signatures of the flight line's "
            "own store leave them out",
            err=True,
        )
    for text in library.attrs.get("left_out", ()):
        click.echo(f"left out {text}", err=True)
    click.echo(
        f"{out}: {library.sizes['signature']} paints, {library.sizes['band']} bands\n{table_of(library)}"
    )
