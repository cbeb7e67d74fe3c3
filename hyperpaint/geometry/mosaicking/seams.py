"""Boundaries between the lines of a mosaic."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base.errors import SchemaError, needs_extra


def seamlines(mosaic: xr.Dataset) -> dict[str, Any]:
    """Return the area that each line of a mosaic shows, as GeoJSON (eager in ``flightline`` alone).

    Parameters
    ----------
    mosaic
        Result of `hyperpaint.geometry.mosaic`.

    Returns
    -------
    dict
        A FeatureCollection in map coordinates, with the ``crs`` of the map: a MultiPolygon per line, with
        the property ``flightline`` and the area in cells, ``cells``. Outlines follow the edges of cells.

    Raises
    ------
    SchemaError
        There is no ``flightline`` with its names, or no ``spatial_ref`` with a ``GeoTransform``.
    MissingExtraError
        rasterio is not installed (extra ``geo``).

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> names = {"flag_values": [0, 1], "flag_meanings": "left right"}
    >>> both = xr.Dataset({"flightline": (("y", "x"), np.int16([[0, 0, 1], [0, 1, 1]]), names)})
    >>> both = both.assign_coords(spatial_ref=((), 0, {"GeoTransform": "0 2 0 10 0 -2"}))
    >>> for area in seamlines(both)["features"]:
    ...     print(area["properties"], area["geometry"]["coordinates"][0][0][0])
    {'flightline': 'left', 'cells': 3} (0.0, 10.0)
    {'flightline': 'right', 'cells': 3} (4.0, 10.0)
    """
    attrs = mosaic["flightline"].attrs if "flightline" in mosaic.variables else {}
    transform = mosaic["spatial_ref"].attrs.get("GeoTransform") if "spatial_ref" in mosaic.variables else None
    if "flag_meanings" not in attrs or transform is None:
        raise SchemaError(
            "not a mosaic: flightline with flag_meanings, or spatial_ref with GeoTransform, is missing",
            mend="compose one with hyperpaint.geometry.mosaic",
            code="variable-missing",
        )
    with needs_extra("rasterio", "geo", "outlining the lines of a mosaic"):
        from rasterio import Affine
        from rasterio.features import shapes
    east, a, b, north, c, d = (float(number) for number in str(transform).split())
    numbers = mosaic["flightline"].values
    names = dict(
        zip(np.atleast_1d(attrs["flag_values"]).tolist(), attrs["flag_meanings"].split(), strict=True)
    )
    outlines: dict[int, list[Any]] = {number: [] for number in names}
    for outline, number in shapes(numbers, numbers >= 0, transform=Affine(a, b, east, c, d, north)):
        outlines[int(number)].append(outline["coordinates"])
    features = [
        {
            "type": "Feature",
            "properties": {"flightline": names[number], "cells": int((numbers == number).sum())},
            "geometry": {"type": "MultiPolygon", "coordinates": polygons},
        }
        for number, polygons in outlines.items()
        if polygons
    ]
    collection: dict[str, Any] = {"type": "FeatureCollection", "coordinates": "map", "features": features}
    crs = mosaic["x"].attrs.get("crs") if "x" in mosaic.coords else None
    if crs is not None:
        collection["crs"] = {"type": "name", "properties": {"name": str(crs)}}
    return collection
