"""The command ``hyperpaint detect``: paints of a library looked for in a store."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from .console import EXISTING, EXISTING_FILE, PLACE, beside, is_watched, refuse_in_store
from .options import command, takes

if TYPE_CHECKING:
    import xarray as xr

    from hyperpaint.regions import Regions

_RATE = click.FloatRange(0.0, 1.0, min_open=True)


@command(
    "detect",
    renamed={"--rate": "--false-alarm-rate"},
    epilog="""\b
Examples:
  hyperpaint detect lot.zarr --library wanted.zarr --out found.zarr
  hyperpaint detect lot.zarr --library wanted.zarr --false-alarm-rate 1e-2 --others fleet.zarr
  hyperpaint detect lot.zarr --library wanted.zarr --regions cars.geojson     which of the cars?
  hyperpaint detect lot.zarr --library wanted.zarr --background no_cars.geojson
  hyperpaint detect lot.zarr --library wanted.zarr --method matched_filter --unknown-rate 1

\b
Thresholds hold --false-alarm-rate over the background: all pixels that no paint explains. The share of
explained pixels is printed; if it is far above the rate, outline pixels without paints in --background.

\b
At most a share --unknown-rate of the spectra of --others is accepted as a paint. A distance limit of 0 means
that a paint is too similar to others for this rate (most white, silver and grey paints): raise the rate.""",
)
@click.argument("store", metavar="STORE.zarr", type=EXISTING)
@takes(
    "paints.detection.detecting:detect",
    only=["library", "others", "method", "false_alarm_rate", "background", "unknown_rate", "shrinkage"],
    library={"type": EXISTING, "help": "Paints to look for: a store of signatures, or a file of spectra."},
    others={
        "metavar": "LIBRARY",
        "type": EXISTING,
        "help": "Paints that may occur and are not looked for.  [default: the starter library]",
    },
    method={
        "type": click.Choice(["ace", "matched_filter", "spectral_angle"]),
        "help": "Detection statistic.",
    },
    false_alarm_rate={"type": _RATE, "metavar": "SHARE", "help": "Maximum share of the background detected."},
    background={
        "metavar": "R.geojson",
        "type": EXISTING_FILE,
        "help": "Outlines without any of the paints.  [default: all pixels that no paint explains]",
    },
    unknown_rate={
        "type": _RATE,
        "metavar": "SHARE",
        "help": "Share of other paints accepted; 1 rejects none.  [default: as --false-alarm-rate]",
    },
    shrinkage={"type": click.FloatRange(0.0, 1.0), "help": "Weight of the diagonal in the covariance."},
)
@click.option("--line", metavar="ID", help="The flight line, where the store has several.")
@click.option("--flags", is_flag=True, help="Flag glint, shadow and mixed pixels first; they are left out.")
@click.option("--keep", multiple=True, metavar="FLAG", help="Search pixels with this flag, such as shadow.")
@click.option("--regions", metavar="R.geojson", type=EXISTING_FILE, help="Cars to list, with their paints.")
@click.option("--out", metavar="FOUND.zarr", type=PLACE, help="[default: detections.zarr beside STORE.zarr]")
@click.option("--overwrite", is_flag=True, help="Replace an existing store.")
def detect_paints(
    store: Path,
    library: Path,
    out: Path | None,
    overwrite: bool,
    background: Path | None,
    **options: Any,
) -> None:
    """Find the paints of a library in a flight line of a store, or in a map."""
    from hyperpaint.base.schema import flags_named
    from hyperpaint.io.library import open_library
    from hyperpaint.io.store import open_store, to_store
    from hyperpaint.paints.detection import detect, detected_regions
    from hyperpaint.paints.signatures import EXCLUDED
    from hyperpaint.radiometry import reflectance
    from hyperpaint.regions import region_mask
    from hyperpaint.surroundings import flag
    from hyperpaint.workflows.maps import line_of_store

    others, regions, line = (options.pop(name) for name in ("others", "regions", "line"))
    out = out or beside(store, "detections.zarr")
    refuse_in_store(store, out)
    exclude = EXCLUDED
    for each in flags_named(options.pop("keep")):
        exclude &= ~each
    searched = reflectance(line_of_store(store, line))
    if options.pop("flags"):
        searched = flag(searched)
    detections = detect(
        searched,
        open_library(library),
        exclude=exclude,
        others=None if others is None else open_library(others),
        background=None if background is None else region_mask(_of_line(background, searched), searched) >= 0,
        **options,
    )
    to_store(detections, out, overwrite=overwrite, progress=is_watched())
    detections = open_store(out, "")
    detected = detections["detected"]
    click.echo(f"{out}: {int(detected.sum())} of {detected.size} pixels\n{_table(detections)}")
    if regions is not None and (cars := _of_line(regions, searched)):
        table = detected_regions(detections, cars).to_dataframe().reset_index()
        click.echo(table.to_string(index=False, float_format=lambda value: f"{value:.3g}"))


def _of_line(path: Path, line: xr.Dataset) -> Regions:
    """Return the regions of a file on this flight line; print how many are on others."""
    from hyperpaint.regions import Regions, read_regions

    regions = read_regions(path)
    name = str(line.attrs.get("name", ""))
    own = tuple(region for region in regions if not name or region.flightline in ("", name))
    if len(own) < len(regions):
        click.echo(f"{path}: {len(regions) - len(own)} of {len(regions)} regions are of other flight lines")
    return Regions(own, regions.coordinates, regions.crs)


def _table(detections: xr.Dataset) -> str:
    """Return a line of text for every paint, and one on the false-alarm rate."""
    import numpy as np

    from hyperpaint.validation.validation_result import aligned

    numbers = detections["best_paint"].values[detections["detected"].values]
    counts = np.bincount(numbers, minlength=detections.sizes["signature"])
    rows = [
        (str(name), f"{count} pixels", f"threshold {threshold:.4g}", f"distance {limit:.3g} at the most")
        for name, count, threshold, limit in zip(
            detections["signature"].values,
            counts,
            detections["score_threshold"].values,
            detections["distance_limit"].values,
            strict=True,
        )
    ]
    checked, half = detections["checked_rate"].item(), detections["checked_rate_u"].item()
    rate = f"above thresholds from other parts of the line: {checked:.2g} +- {half:.1g} of the background"
    share = detections["explained_share"].item()
    explained = f"left out of the background, as a paint explains them: {share:.2g} of the pixels"
    return "\n".join([*(f"  {row}" for row in aligned(rows, names=4)), f"  {rate}", f"  {explained}"])
