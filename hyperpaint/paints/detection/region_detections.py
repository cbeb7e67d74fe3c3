"""Regions, such as cars, that show a detected paint."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base import schema
from hyperpaint.base.arrays import Array, Bools, Floats, Ints
from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.schema import SIGNATURE
from hyperpaint.paints.signatures.line_sources import lines_of
from hyperpaint.regions import pixels_of
from hyperpaint.regions.geojson import regions_from

_COLUMNS = ("pixels", "detected_share", "signature", "p_value", "placements")


def detected_regions(detections: xr.Dataset, regions: Any) -> xr.Dataset:
    """Return the paint that each region, such as a car, shows, and its significance.

    Eager. Pixels of one object are correlated and cannot be counted as independent. The detected share is
    therefore compared with the shares inside copies of the region's outline, laid side by side on the rest of
    the line.

    Parameters
    ----------
    detections
        From `detect`.
    regions
        Regions, or a file of them, see `hyperpaint.read_regions`; pixels of the sensor.

    Returns
    -------
    Dataset
        (region): ``pixels`` in it; ``detected_share`` [1] of its most frequent paint, which is ``signature``,
        empty where none is detected; ``p_value``, the probability that an outline without paint has as large
        a share of any paint, from ``placements`` outlines, at least 1 / (placements + 1).

    Raises
    ------
    FormatError, SchemaError
        The regions cannot be read, hold no pixel or are of another flight line, or these are no detections.

    Examples
    --------
    >>> import xarray as xr
    >>> from hyperpaint.regions import Region
    >>> shown = np.zeros((24, 24), bool)
    >>> shown[4:8, 4:10] = True  # as `detect` returns it
    >>> pixels = ("along_track", "cross_track")
    >>> detections = xr.Dataset(
    ...     {"detected": (pixels, shown), "best_paint": (pixels, np.zeros((24, 24), np.int16))},
    ...     {"signature": ["red"]})
    >>> car = Region("car", [(3.5, 3.5), (9.5, 3.5), (9.5, 7.5), (3.5, 7.5)])
    >>> cars = detected_regions(detections, [car])
    >>> cars["signature"].item(), cars.detected_share.item(), round(cars.p_value.item(), 2)
    ('red', 1.0, 0.04)
    """
    detections = schema.rename_to_roles(detections)
    variables = schema.require(detections, ["detected", "best_paint"], "detected regions")
    detected, best = variables["detected"].values, variables["best_paint"].values
    region_list = regions_from(regions)
    if region_list.coordinates == "sensor":
        lines_of(detections, region_list)  # raises for regions of other flight lines
    places = pixels_of(region_list, detections)
    problems = Problems("these regions cannot be searched", SchemaError)
    for name, (along, _) in zip(region_list.names, places, strict=True):
        if not along.size:
            problems.add(f"region {name!r} holds no pixel of the line", code="region-empty")
    problems.raise_if_any()
    taken = np.zeros(detected.shape, bool)
    for place in places:
        taken[place] = True
    names = [str(name) for name in detections[SIGNATURE].values]
    shown = np.where(detected, best, -1)
    rows = []
    for along, across in places:
        counts = _counts(shown[along, across], len(names))
        paint = int(counts.argmax())
        share = counts[paint] / along.size
        # the paint was chosen by its share: every copy is compared by its best paint
        elsewhere = _shares_elsewhere(shown, len(names), taken, along, across)
        p = (1 + int((elsewhere >= share).sum())) / (1 + elsewhere.size)
        rows.append((along.size, share, names[paint] if counts[paint] else "", p, elsewhere.size))
    columns = dict(zip(_COLUMNS, zip(*rows, strict=True), strict=True))
    return xr.Dataset(
        {
            name: ("region", np.array(values), {} if name == "signature" else {"units": "1"})
            for name, values in columns.items()
        },
        {"region": ("region", list(region_list.names))},
        detections.attrs,
    )


def _counts(shown: Array, paints: int) -> Ints:
    # Number of pixels of each paint (paint,); pixels of -1 show none
    return np.bincount(shown[shown >= 0], minlength=paints)


def _shares_elsewhere(shown: Array, paints: int, taken: Bools, along: Ints, across: Ints) -> Floats:
    # Largest share of a paint in copies of an outline, tiled outside all regions (copy,)
    along, across = along - along.min(), across - across.min()
    high, wide = along.max() + 1, across.max() + 1
    shares = [
        _counts(shown[along + top, across + left], paints).max() / along.size
        for top in range(0, shown.shape[0] - high + 1, high)
        for left in range(0, shown.shape[1] - wide + 1, wide)
        if not taken[along + top, across + left].any()
    ]
    return np.array(shares, np.float64)
