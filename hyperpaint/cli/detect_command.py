"""The command ``hyperpaint detect``: paints of a library looked for in a store."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from .console import EXISTING, EXISTING_FILE, PLACE, beside, is_watched, refuse_in_store, takes_memory_limit

if TYPE_CHECKING:
    import xarray as xr

    from hyperpaint.regions import Regions

_RATE = click.FloatRange(0.0, 1.0, min_open=True)


@click.command(
    "detect",
    short_help="Look for the paints of a library in a store.",
    epilog="""\b
Examples:
  hyperpaint detect lot.zarr --library wanted.zarr --out found.zarr
  hyperpaint detect lot.zarr --library wanted.zarr --rate 1e-2 --others fleet.zarr --out found.zarr
  hyperpaint detect lot.zarr --library wanted.zarr --regions cars.geojson     which of the cars?
  hyperpaint detect lot.zarr --library wanted.zarr --background no_cars.geojson
  hyperpaint detect lot.zarr --library wanted.zarr --method matched_filter --unknown-rate 1

\b
Of the image's background, a share of --rate at the most are false alarms: thresholds come from it. Pixels
that a paint explains are left out of it, be they that paint or only much like it, and the rate says
nothing of them; their share is printed. Where it is far above the rate and they cannot all be the
paints, outline pixels that show none in --background: the rate then holds for pixels like these.

\b
Of paints that are not looked for, no more than --unknown-rate are taken for one that is, where they are
like those of --others. A paint with the limit 0 is too like others for that rate, as most white, silver
and grey ones are; a higher rate may do.""",
)
@click.argument("store", metavar="STORE.zarr", type=EXISTING)
@click.option(
    "--library", required=True, metavar="LIB", type=EXISTING,
    help="The paints to look for: a store of signatures, or a file of spectra.",
)  # fmt: skip
@click.option("--others", metavar="LIB", type=EXISTING, help="Paints that may be there and are not looked "
              "for.  [default: the starter library]")  # fmt: skip
@click.option("--line", metavar="ID", help="The flight line, where the store has several.")
@click.option(
    "--method", type=click.Choice(["ace", "matched_filter", "spectral_angle"]), default="ace",
    help="What is compared with a threshold.",
)  # fmt: skip
@click.option("--rate", type=_RATE, default=1e-3, help="False alarms, as a share of the background.")
@click.option("--background", metavar="R.geojson", type=EXISTING_FILE,
              help="Outlines without any of the paints.  [default: all that no paint explains]")  # fmt: skip
@click.option("--unknown-rate", type=_RATE, metavar="RATE",
              help="Other paints taken for one; 1 rejects none.  [default: as --rate]")  # fmt: skip
@click.option(
    "--flags", is_flag=True, help="Look for glint, shadow and mixed pixels first; they are left out."
)
@click.option("--keep", multiple=True, metavar="FLAG", help="Search pixels with this flag, such as shadow.")
@click.option("--shrinkage", type=click.FloatRange(0.0, 1.0), default=0.0,
              help="Weight of the diagonal in the covariance.")  # fmt: skip
@click.option("--regions", metavar="R.geojson", type=EXISTING_FILE, help="Cars, of which each is answered.")
@click.option("--out", metavar="FOUND.zarr", type=PLACE, help="[default: detections.zarr beside STORE.zarr]")
@takes_memory_limit
@click.option("--overwrite", is_flag=True, help="Replace what is there.")
@click.option("--quiet", is_flag=True, help="No progress bar.")
def detect_paints(
    store: Path, library: Path, out: Path | None, overwrite: bool, quiet: bool, background: Path | None,
    **options: Any,
) -> None:  # fmt: skip
    """Look for the paints of a library in a flight line of a store, or in a map."""
    from hyperpaint.base.schema import flags_named
    from hyperpaint.io.library import open_library
    from hyperpaint.io.store import open_store, to_store
    from hyperpaint.paints.detection import detect, detected_regions
    from hyperpaint.paints.signatures import EXCLUDED
    from hyperpaint.radiometry import reflectance
    from hyperpaint.regions import region_mask
    from hyperpaint.surroundings import flag
    from hyperpaint.workflows.maps import line_of_store

    others, regions, line, rate = (options.pop(name) for name in ("others", "regions", "line", "rate"))
    out = out or beside(store, "detections.zarr")
    refuse_in_store(store, out)
    exclude = EXCLUDED
    for each in flags_named(options.pop("keep")):
        exclude &= ~each
    searched = reflectance(line_of_store(store, line))
    if options.pop("flags"):
        searched = flag(searched)
    detections = detect(
        searched, open_library(library), false_alarm_rate=rate, exclude=exclude,
        others=None if others is None else open_library(others),
        background=None if background is None else region_mask(_of_line(background, searched), searched) >= 0,
        **options,
    )  # fmt: skip
    to_store(detections, out, overwrite=overwrite, progress=is_watched(quiet))
    detections = open_store(out, "")
    detected = detections["detected"]
    click.echo(f"{out}: {int(detected.sum())} of {detected.size} pixels\n{_table(detections)}")
    if regions is not None and (cars := _of_line(regions, searched)):
        table = detected_regions(detections, cars).to_dataframe().reset_index()
        click.echo(table.to_string(index=False, float_format=lambda value: f"{value:.3g}"))


def _of_line(path: Path, line: xr.Dataset) -> Regions:
    """Return the regions of a file that are of this flight line, and say how many are of others."""
    from hyperpaint.regions import Regions, read_regions

    regions = read_regions(path)
    name = str(line.attrs.get("name", ""))
    own = tuple(region for region in regions if not name or region.flightline in ("", name))
    if len(own) < len(regions):
        click.echo(f"{path}: {len(regions) - len(own)} of {len(regions)} regions are of other flight lines")
    return Regions(own, regions.coordinates, regions.crs)


def _table(detections: xr.Dataset) -> str:
    """Return a line of text for every paint, and one on the rate."""
    import numpy as np

    from hyperpaint.validation.validation_result import aligned

    numbers = detections["best_paint"].values[detections["detected"].values]
    counts = np.bincount(numbers, minlength=detections.sizes["signature"])
    rows = [
        (str(name), f"{count} pixels", f"threshold {threshold:.4g}", f"distance {limit:.3g} at the most")
        for name, count, threshold, limit in zip(
            detections["signature"].values, counts, detections["score_threshold"].values,
            detections["distance_limit"].values, strict=True,
        )
    ]  # fmt: skip
    checked, half = detections["checked_rate"].item(), detections["checked_rate_u"].item()
    rate = f"above thresholds from other parts of the line: {checked:.2g} +- {half:.1g} of the background"
    share = detections["explained_share"].item()
    explained = f"left out of the background, as a paint explains them: {share:.2g} of the pixels"
    return "\n".join([*(f"  {row}" for row in aligned(rows, names=4)), f"  {rate}", f"  {explained}"])
