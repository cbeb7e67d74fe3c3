"""The command ``hyperpaint signatures``: regions of a store to a paint library."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from .console import EXISTING, PLACE, beside, given_of, is_watched, progress_bar, takes_memory_limit
from .location_options import takes_location


@click.command(
    "signatures",
    short_help="Turn regions of a store into paint signatures.",
    epilog="""\b
Examples:
  hyperpaint signatures lot.zarr --regions cars.geojson --out paints.zarr
  hyperpaint signatures lot.zarr --out paints.zarr                     roofs of cars, proposed by rule
  hyperpaint signatures lot.zarr --regions cars.geojson --out paints.zarr --keep shadow
  hyperpaint signatures lot.zarr --regions cars.geojson --out paints.zarr --no-flags
  hyperpaint signatures lot.zarr --regions cars.geojson --out paints.zarr --smooth box --window 5
  hyperpaint signatures lot.zarr --regions qgis.geojson --out paints.zarr --ground 152.4
  hyperpaint signatures map.zarr --regions qgis.geojson --out paints.zarr

\b
Options from --ground on place the lines for regions of a map; by default the store says it.""",
)
@click.argument("store", metavar="STORE.zarr", type=EXISTING)
@click.option(
    "--regions", metavar="R.geojson", type=EXISTING,
    help="The regions.  [default: some are proposed by rule]",
)  # fmt: skip
@click.option(
    "--out",
    metavar="LIB.zarr",
    type=PLACE,
    help="The paint library.  [default: paints.zarr beside STORE.zarr]",
)
@click.option(
    "--keep", multiple=True, metavar="FLAG",
    help="Use pixels with this flag, which are left out otherwise, such as shadow.",
)  # fmt: skip
@click.option(
    "--centre", type=click.Choice(["trimmed_mean", "geometric_median", "median"]), default="trimmed_mean",
    help="What stands for a region's pixels.",
)  # fmt: skip
@click.option(
    "--smooth", type=click.Choice(["savitzky-golay", "box"]), help="Smooth spectra.  [default: not at all]"
)
@click.option("--window", type=int, default=11, help="Bands that are smoothed over, an odd number.")
@click.option("--specular-sky", is_flag=True, help="Subtract the sky that a clear coat mirrors.")
@click.option(
    "--coat/--no-coat", default=None,
    help="Divide by what a clear coat lets through of a low sun.  [default: with --specular-sky]",
)  # fmt: skip
@click.option(
    "--coat-index", type=click.FloatRange(1.0, 3.0), default=1.5, help="Refractive index of the coat."
)
@click.option(
    "--flags/--no-flags", default=True,
    help="Look for glint, shadow and light of neighbours first, on lines without such flags.",
)  # fmt: skip
@click.option(
    "--sun-zenith", type=click.FloatRange(0.0, 90.0), metavar="DEGREE",
    help="Zenith angle of the sun.  [default: from time and position of the line]",
)  # fmt: skip
@click.option(
    "--diffuse", type=click.Choice(["model", "pvlib", "shadow"]),
    help="Where the part of the sky in the light is known from; model is a clear sky.  "
    "[default: the lines' record of irradiance]",
)  # fmt: skip
@click.option(
    "--glint", type=click.FloatRange(0.0), metavar="SHARE", help="Limit of mirrored sun.  [default: 0.04]"
)
@click.option(
    "--shadow", type=click.FloatRange(0.0), metavar="SHARE", help="Limit of missing beam.  [default: 0.2]"
)
@click.option(
    "--adjacency", type=click.FloatRange(0.0), metavar="SHARE",
    help="Limit of a coloured neighbour's light.  [default: 0.01]",
)  # fmt: skip
@click.option(
    "--members", type=click.IntRange(min=0), default=256,
    help="Pixels of a region that are kept as they are.",
)  # fmt: skip
@click.option(
    "--min-pixels", type=click.IntRange(min=1), default=5,
    help="Pixels that a region must have left.",
)  # fmt: skip
@click.option(
    "--drop-small", is_flag=True,
    help="Leave regions with fewer out and name them, in place of an error.",
)  # fmt: skip
@takes_location
@takes_memory_limit
@click.option("--overwrite", is_flag=True, help="Replace a library made from something else.")
@click.option("--quiet", is_flag=True, help="No progress bar.")
def make_signatures(
    store: Path, regions: Path | None, out: Path | None, smooth: str | None, window: int, flags: bool,
    quiet: bool, **options: Any,
) -> None:  # fmt: skip
    """Turn regions of a processed store into a library of paint signatures.

    STORE is what process writes, or a map of orthorectify. Regions are polygons in GeoJSON, x the column and
    y the line of the cube, or in coordinates of a map where the file names a crs, each with a property name
    (and flightline, where the store has several). A paint has centre, spread, quantiles, single pixels,
    uncertainty, flags and all that its region says. Left out are saturated pixels, and those in glint, in
    shadow or in a neighbour's light. Lines of which the store does not say where these are, as process leaves
    them, are looked at as a whole first; --no-flags does without.
    """
    from hyperpaint.workflows.library_files import NOT_LOOKED_FOR, table_of, write_signatures
    from hyperpaint.workflows.maps import LOCATION

    smoothing = None if smooth is None else {"method": smooth, "window": window}
    limits = {name: options.pop(name) for name in ("diffuse", "glint", "shadow", "adjacency")}
    given = given_of(limits)
    location = given_of({name: options.pop(name) for name in LOCATION})
    if given and not flags:
        named = ", ".join(f"--{name}" for name in given)
        raise click.UsageError(f"--no-flags looks for nothing; leave out {named}")
    out = out or beside(store, "paints.zarr")
    with progress_bar("flags and signatures" if flags else "extracting", is_watched(quiet)) as shown:
        library = write_signatures(
            store, regions, out, smooth=smoothing, flags=given or flags, location=location, progress=shown,
            **options,
        )  # fmt: skip
    if flags and library.attrs["flags"] == NOT_LOOKED_FOR:
        click.echo(
            "glint, shadow and light of neighbours were not looked for: a map is not searched; signatures of "
            "the flight line's own store leave them out",
            err=True,
        )
    for text in library.attrs.get("left_out", ()):
        click.echo(f"left out {text}", err=True)
    click.echo(
        f"{out}: {library.sizes['signature']} paints, {library.sizes['band']} bands\n{table_of(library)}"
    )
