"""Outline of a located flight line, and the spacing of its pixels on the ground."""

from __future__ import annotations

import json
from typing import Any

import dask
import numpy as np
import xarray as xr

from hyperpaint.base.errors import SchemaError, needs_extra
from hyperpaint.base.facts import documented
from hyperpaint.base.schema import Floats, require
from hyperpaint.io.maps.map_grids import cut_at_dateline

from .geodesy import between_maps, crs_of

_LONGITUDE_LATITUDE = "OGC:CRS84"
_PERCENTILES = (5.0, 95.0)


@documented()
def footprint(located: xr.Dataset, *, crs: Any = None) -> dict[str, Any]:
    """Return the outline of the ground that a located line covers, as a GeoJSON Feature (eager).

    Parameters
    ----------
    located
    crs
        Reference system of the outline; by default longitude and latitude, as GeoJSON wants it.

    Returns
    -------
    dict
        Feature with a Polygon through the centres of
        the outermost pixels; a MultiPolygon where lines without a pose, or the longitude of 180 degrees,
        divide it. Properties: ``area`` on the
        map of the line [m2]; ``lines``, the number of located lines; ``crs``.

    Raises
    ------
    SchemaError
        The line is not located, or no two successive lines are.
    MissingExtraError
        shapely or pyproj is not installed (extra ``geo``).

    Notes
    -----
    The outline is the union of the quadrilaterals between the ends of neighbouring lines: ground that a
    wobble shows twice is counted once. Bends of less than half the spacing of the pixels are left out.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> from hyperpaint.base.attitude_conventions import Convention
    >>> from hyperpaint.geometry import PinholeCamera, locate
    >>> pose = dict(longitude=-81.0, altitude=150.0, roll=0.0, pitch=0.0, heading=0.0)
    >>> line = xr.Dataset({name: ("along_track", np.full(2, value)) for name, value in pose.items()})
    >>> line = line.assign(latitude=("along_track", [34.0, 34.0001]), cross_track=[0, 1, 2])
    >>> camera = PinholeCamera(3, field_of_view=90.0, edges="centres")
    >>> convention = Convention(column_order="left_to_right")
    >>> located = locate(line, ground=50.0, camera=camera, convention=convention)
    >>> outline = footprint(located)
    >>> outline["geometry"]["type"], round(outline["properties"]["area"], -1)  # [m2]
    ('Polygon', 1110.0)
    """
    with needs_extra("shapely", "geo", "the outline of a line"):
        import shapely
    east, north, source = _positions(located)
    # the outermost located pixels of every line (line, end, 2)
    is_located = np.isfinite(east) & np.isfinite(north)
    outermost = is_located.argmax(axis=1), is_located.shape[1] - 1 - is_located[:, ::-1].argmax(axis=1)
    rows = np.arange(len(east))
    ends = np.stack(
        [np.stack([east[rows, columns], north[rows, columns]], axis=-1) for columns in outermost], axis=1
    )
    is_placed = np.all(np.isfinite(ends), axis=(1, 2))
    pairs = np.flatnonzero(is_placed[1:] & is_placed[:-1])
    SchemaError.raise_if(
        not pairs.size,
        "no two neighbouring lines have ground positions",
        mend="look at poses and at the quality's off_swath",
        code="ground-not-seen",
    )
    quads = shapely.convex_hull(shapely.multipoints(np.concatenate([ends[pairs], ends[pairs + 1]], axis=1)))
    bend = 0.5 * float(np.nanmedian(np.concatenate([steps.ravel() for steps in _steps(east, north)])))
    covered = shapely.simplify(shapely.union_all(quads), bend)
    target = _LONGITUDE_LATITUDE if crs is None else crs_of(crs)
    outline = shapely.transform(covered, lambda xy: between_maps(xy, source, target))
    geometry = json.loads(shapely.to_geojson(outline))
    if crs is None:
        geometry, _ = cut_at_dateline(geometry)
    return {
        "type": "Feature",
        "geometry": geometry,
        "properties": {"area": float(covered.area), "lines": int(is_placed.sum()), "crs": target},
    }


@documented()
def spacing(located: xr.Dataset) -> dict[str, float]:
    """Return the spacing of the pixels of a located line on the ground (eager).

    Parameters
    ----------
    located

    Returns
    -------
    dict
        ``across`` and ``along``: median distance of neighbouring columns and lines [m]; with ``_p05`` and
        ``_p95`` their 5th and 95th percentiles. ``gsd``: the larger of the medians, the default of maps.
        ``reversed``: share of the steps from line to line that go back against the flight [1]. ``off_swath``:
        share of the pixels without a ground position [1].

    Raises
    ------
    SchemaError
        The line is not located, or no two neighbouring pixels are.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> from hyperpaint.base.attitude_conventions import Convention
    >>> from hyperpaint.geometry import PinholeCamera, locate
    >>> pose = dict(longitude=-81.0, altitude=150.0, roll=0.0, pitch=0.0, heading=0.0)
    >>> line = xr.Dataset({name: ("along_track", np.full(2, value)) for name, value in pose.items()})
    >>> line = line.assign(latitude=("along_track", [34.0, 34.0001]), cross_track=[0, 1, 2])
    >>> camera = PinholeCamera(3, field_of_view=90.0, edges="centres")
    >>> convention = Convention(column_order="left_to_right")
    >>> located = locate(line, ground=50.0, camera=camera, convention=convention)
    >>> distances = spacing(located)
    >>> round(distances["across"]), round(distances["along"], 1)  # [m]
    (100, 11.1)
    """
    east, north, _ = _positions(located)
    distances: dict[str, float] = {}
    for name, steps in zip(("across", "along"), _steps(east, north), strict=True):
        finite = steps[np.isfinite(steps)]
        # a single column or line has no neighbour
        distances[name] = float(np.median(finite)) if finite.size else np.nan
        for percent in _PERCENTILES:
            distances[f"{name}_p{percent:02.0f}"] = (
                float(np.percentile(finite, percent)) if finite.size else np.nan
            )
    SchemaError.raise_if(
        np.isnan([distances["across"], distances["along"]]).all(),
        "no two neighbouring pixels have ground positions",
        mend="look at poses and at the quality's off_swath",
        code="ground-not-seen",
    )
    distances["gsd"] = float(np.nanmax([distances["across"], distances["along"]]))
    # steps from line to line at the middle column, against the mean direction of flight
    middle_column = east.shape[1] // 2
    steps = np.stack([np.diff(east[:, middle_column]), np.diff(north[:, middle_column])], axis=-1)
    steps = steps[np.isfinite(steps).all(axis=1)]
    distances["reversed"] = float((steps @ steps.mean(axis=0) < 0.0).mean()) if steps.size else np.nan
    distances["off_swath"] = float(np.isnan(east).mean())
    return distances


def _positions(located: xr.Dataset) -> tuple[Floats, Floats, str]:
    coordinates = require(located, ["east", "north"], "the outline of a line")
    crs: Any = coordinates["east"].attrs.get("crs")
    SchemaError.raise_if(
        not isinstance(crs, str),
        "'east' does not declare its map",
        mend="locate the line with hyperpaint.geometry.locate",
        code="crs-missing",
    )
    east, north = dask.compute(coordinates["east"].data, coordinates["north"].data)
    return np.asarray(east), np.asarray(north), crs


def _steps(east: Floats, north: Floats) -> tuple[Floats, Floats]:
    across = np.hypot(np.diff(east, axis=1), np.diff(north, axis=1))
    return across, np.hypot(np.diff(east, axis=0), np.diff(north, axis=0))
