"""Formats of map files, and metadata of maps for other programs: attributes of GeoZarr, a STAC item."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from hyperpaint.base.errors import SchemaError, needs_extra
from hyperpaint.base.schema import BAND

from .map_grids import SPATIAL_REF, Grid, grid_of, required_grid

# Name, repository, identifier and description of the conventions of GeoZarr that maps follow.
_CONVENTIONS = (
    ("proj", "geo-proj", "f17cb550-5864-4468-aeb7-f3180cfb622f", "Coordinate reference system information"),
    ("spatial", "spatial", "689b58e2-cf7b-45e0-9fff-9cfc0883d6b4", "Spatial coordinate information"),
)

_STAC_EXTENSIONS = ("projection/v2.0.0", "eo/v2.0.0")

TILE = 256  # [cell]


class RasterFormat(NamedTuple):
    # Format of a map file, which GDAL copies from a plain GeoTIFF
    driver: str  # of GDAL
    media_type: str
    options: dict[str, Any]  # of GDAL's driver, for all bands
    picture_options: dict[str, Any]  # for a picture of 8 bits


_COG = {"compress": "deflate", "blocksize": TILE, "bigtiff": "if_safer", "predictor": "yes"}
_GEOTIFF = RasterFormat(
    "COG",
    "image/tiff; application=geotiff; profile=cloud-optimized",
    {**_COG, "overview_resampling": "nearest"},  # spectra must not be mixed
    {**_COG, "overview_resampling": "average"},
)
#: Formats of map files by suffix.
RASTER_FORMATS = {".tif": _GEOTIFF, ".tiff": _GEOTIFF}
_MEDIA_TYPES = {
    ".zarr": "application/vnd.zarr; version=3",
    **{suffix: form.media_type for suffix, form in RASTER_FORMATS.items()},
}


def with_own_transform(dataset: xr.Dataset) -> xr.Dataset:
    # Return a map whose ``GeoTransform`` matches its cells; a selection has the transform of the whole map.
    # Raises `SchemaError`: as `grid_of`.
    grid = grid_of(dataset)
    if grid is None or SPATIAL_REF not in dataset.variables:
        return dataset
    text = " ".join(repr(float(number)) for number in grid.transform)
    return dataset.assign_coords({SPATIAL_REF: dataset[SPATIAL_REF].assign_attrs(GeoTransform=text)})


def geozarr_attrs(dataset: xr.Dataset) -> dict[str, Any]:
    # Return the GeoZarr attributes of a Zarr group for the position of a map (y, x).
    # They follow the conventions ``proj:`` and ``spatial:``, version 1. netCDF cannot hold the list of them.
    # Raises `SchemaError`: its position is unknown; `MissingExtraError`: pyproj is not installed.
    grid = required_grid(dataset)
    url = "https://{}github{}.com/zarr-conventions/{}"
    conventions = [
        {
            "schema_url": f"{url.format('raw.', 'usercontent', repository)}/refs/tags/v1/schema.json",
            "spec_url": f"{url.format('', '', repository)}/blob/v1/README.md",
            "uuid": identifier,
            "name": f"{name}:",
            "description": description,
        }
        for name, repository, identifier, description in _CONVENTIONS
    ]
    shape = [dataset.sizes["y"], dataset.sizes["x"]]
    x, y = _corners(grid, shape)
    return {
        "zarr_conventions": conventions,
        **_reference_system(grid),
        "spatial:dimensions": ["y", "x"],
        "spatial:transform": _affine(grid),
        "spatial:shape": shape,
        "spatial:bbox": [min(x), min(y), max(x), max(y)],
        "spatial:registration": "pixel",
    }


def stac_item(dataset: xr.Dataset, path: Path) -> dict[str, Any]:
    # Return the STAC item (version 1.1) of a map exported to a file or store; computes ``line_time``.
    # It has the fields of the extensions projection and eo; ``line_time`` gives the time of recording.
    # Raises `SchemaError`: position or time of the map is unknown; `MissingExtraError`: pyproj is not
    # installed.
    grid = required_grid(dataset)
    if grid.wkt is None or "line_time" not in dataset.variables:
        missing = "reference system" if grid.wkt is None else "line_time"
        raise SchemaError(
            f"a STAC item needs position and time, and this map has no {missing}",
            mend="orthorectify a line that has both, with line_time among the variables",
            code="variable-missing",
        )
    with needs_extra("pyproj", "geo", "a STAC item"):
        import pyproj
    shape = [dataset.sizes["y"], dataset.sizes["x"]]
    x, y = _corners(grid, shape)
    to_degrees = pyproj.Transformer.from_crs(grid.wkt, "EPSG:4326", always_xy=True)
    longitude, latitude = (np.round(part, 9).tolist() for part in to_degrees.transform(x, y))
    times = dataset["line_time"].values.astype("datetime64[ns]").ravel()
    times = times[~np.isnat(times)]
    if not times.size:
        raise SchemaError("no cell of this map has a time in line_time", code="time-missing")
    first, last = times.min(), times.max()
    moments = {"datetime": first + (last - first) // 2, "start_datetime": first, "end_datetime": last}
    ring = [list(corner) for corner in zip(longitude, latitude, strict=True)]
    return {
        "type": "Feature",
        "stac_version": "1.1.0",
        "stac_extensions": [
            f"https://stac-extensions.github.io/{name}/schema.json" for name in _STAC_EXTENSIONS
        ],
        "id": path.stem,
        "geometry": {"type": "Polygon", "coordinates": [[*ring, ring[0]]]},
        "bbox": [min(longitude), min(latitude), max(longitude), max(latitude)],
        "properties": {
            **{key: f"{np.datetime_as_string(time, unit='ms')}Z" for key, time in moments.items()},
            "gsd": float(np.hypot(grid.transform[1], grid.transform[4])),
            **_reference_system(grid),
            "proj:shape": shape,
            "proj:transform": _affine(grid),
            "proj:bbox": [min(x), min(y), max(x), max(y)],
        },
        "links": [],
        "assets": {
            "data": {
                "href": f"./{path.name}",
                "type": _MEDIA_TYPES.get(path.suffix.lower(), "application/octet-stream"),
                "roles": ["data"],
                "bands": _bands(dataset),
            }
        },
    }


def _reference_system(grid: Grid) -> dict[str, Any]:
    # Return code or WKT of the reference system, under the names that STAC and GeoZarr share.
    if grid.wkt is None:
        return {}
    with needs_extra("pyproj", "geo", "the reference system of a map"):
        import pyproj
    crs = pyproj.CRS.from_user_input(grid.wkt)
    code = crs.to_authority(min_confidence=100)
    return {"proj:code": ":".join(code)} if code else {"proj:wkt2": crs.to_wkt()}


def _affine(grid: Grid) -> list[float]:
    # Return the transform in the order of the package affine: x by column, row and offset, then y.
    a, b, c, d, e, f = map(float, grid.transform)
    return [b, c, a, e, f, d]


def _corners(grid: Grid, shape: list[int]) -> tuple[list[float], list[float]]:
    # Return x and y of the outer corners, counterclockwise from the first cell.
    a, b, c, d, e, f = map(float, grid.transform)
    rows, cols = shape
    corners = ((0, 0), (rows, 0), (rows, cols), (0, cols))
    return [a + b * j + c * i for i, j in corners], [d + e * j + f * i for i, j in corners]


def _bands(dataset: xr.Dataset) -> list[dict[str, Any]]:
    # Return name, wavelength and width [um] of the bands.
    axis = dataset.variables.get("wavelength")
    if axis is None or axis.dims != (BAND,):
        return []
    width = dataset.variables.get("fwhm")
    widths = axis.values * np.nan if width is None or width.dims != (BAND,) else width.values
    return [
        {
            "name": f"{nm:.6g} nm",
            "eo:center_wavelength": round(float(nm) / 1e3, 9),
            **({"eo:full_width_half_max": round(float(fwhm) / 1e3, 9)} if fwhm > 0.0 else {}),
        }
        for nm, fwhm in zip(axis.values, widths, strict=True)
    ]
