"""Variable and affine grid of an exported line or map, formats of map files, GeoZarr and STAC metadata."""

from __future__ import annotations

import json
import math
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from hyperpaint.base.errors import Problem, Problems, SchemaError, needs_extra
from hyperpaint.base.schema import ALONG_TRACK, BAND, CROSS_TRACK, VARIABLES

# Wavelengths of the bands shown as red, green and blue [nm].
RGB_WAVELENGTHS = (640.0, 550.0, 460.0)
MAX_BAND_DISTANCE_NM = 50.0
_PRODUCTS = ("reflectance", "radiance", "counts", "values")
_GEOMETRIES = ({ALONG_TRACK, CROSS_TRACK}, {"y", "x"})


def product_of(dataset: xr.Dataset, variable: str | None) -> xr.DataArray:
    # Return the variable to be written, bands last: the requested one, else the first product present.
    # Raises `SchemaError`: It is missing, or its dims are not those of a cube or of a plane.
    name = variable or next((name for name in _PRODUCTS if name in dataset.data_vars), None)
    if name is None or name not in dataset.variables:
        names = ", ".join(map(str, dataset.data_vars)) or "nothing"
        expected = "one of " + ", ".join(_PRODUCTS) if name is None else repr(name)
        raise SchemaError(
            f"there is no {expected} to write; the dataset holds {names}",
            mend="name one with variable=",
            code="variable-missing",
        )
    array = dataset[name]
    SchemaError.raise_if(
        set(array.dims) - {BAND} not in _GEOMETRIES or not array.size,
        f"{name!r} is {dict(array.sizes)}",
        expected=f"({ALONG_TRACK}, {BAND}, {CROSS_TRACK}) or (y, x, {BAND}), with or without {BAND}, and "
        "no dim of size 0",
        code="dim-missing",
    )
    array = array.reset_coords(drop=True)
    array = array if BAND in array.dims else array.expand_dims(BAND, axis=-1)
    return array.transpose(*(("y", "x") if "y" in array.dims else (ALONG_TRACK, CROSS_TRACK)), BAND)


def storable(array: xr.DataArray) -> xr.DataArray:
    # Return an array in the dtype in which it is written.
    # Floats become float32, except for map coordinates, which float32 would round to decimetres; booleans
    # become uint8. Raises `SchemaError`: It has another type.
    if array.dtype.kind == "f":
        spec = VARIABLES.get(str(array.name))
        is_float64 = spec is not None and spec.dtype == "float64" and array.dtype.itemsize >= 8
        return array.astype(np.float64 if is_float64 else np.float32, copy=False)
    if array.dtype == bool:
        return array.astype(np.uint8)
    SchemaError.raise_if(
        array.dtype.name not in ("uint8", "uint16", "int16", "uint32", "int32"),
        f"{array.name!r} is {array.dtype}",
        expected="floats or integers of at most 32 bits",
        code="type-wrong",
    )
    return array


def nearest_bands(wavelength: ArrayLike, wanted: tuple[float, ...]) -> list[int] | None:
    """Return the indices of the bands nearest to wavelengths [nm]; None where one is over 50 nm away.

    Examples
    --------
    >>> nearest_bands([450.0, 551.0, 645.0, 850.0], RGB_WAVELENGTHS)
    [2, 1, 0]
    """
    wavelengths = np.asarray(wavelength, np.float64)
    distance = np.abs(wavelengths[None, :] - np.array(wanted)[:, None])
    is_known = wavelengths.size and np.isfinite(wavelengths).all()
    is_near = is_known and (distance.min(axis=1) <= MAX_BAND_DISTANCE_NM).all()
    return distance.argmin(axis=1).tolist() if is_near else None


Transform = tuple[float, float, float, float, float, float]

SPATIAL_REF = "spatial_ref"
# Largest deviation from even spacing over the whole grid [pixel].
_TOLERANCE = 1e-6
# Rounding of map coordinates [map units].
_ROUNDING = 1e-9


@dataclass(frozen=True)
class Grid:
    # An affine grid: x = a + b column + c row, y = d + e column + f row, at the outer corners of pixels.
    transform: Transform  # a, b, c, d, e, f: GDAL's order [map units]
    wkt: str | None  # The reference system; None where it is not known

    @property
    def mirrored(self) -> bool:
        # Whether rows and columns form a mirror image of the ground as seen from above.
        _, b, c, _, e, f = self.transform
        return b * f - c * e > 0.0

    def flipped(self, rows: int) -> Grid:
        # Return the grid with the order of its rows reversed.
        a, b, c, d, e, f = self.transform
        return replace(self, transform=(a + rows * c, b, -c, d + rows * f, e, -f))


def grid_of(dataset: xr.Dataset) -> Grid | None:
    # Return the grid of a map; None where its position is unknown.
    # ``x`` and ``y`` at pixel centres take precedence, since they follow every selection of cells, whereas
    # ``GeoTransform`` of ``spatial_ref`` does not. ``GeoTransform`` is used where they are missing, and for
    # the step of a single row or column. A grid along the flight has ``east`` and ``north`` (y, x) instead.
    # Raises `SchemaError`: ``GeoTransform`` is not six finite numbers; ``x`` and ``y``, or ``east`` and
    # ``north``, are not evenly spaced; or the grid is rotated and ``x`` and ``y`` are not distances along it.
    attrs = dataset[SPATIAL_REF].attrs if SPATIAL_REF in dataset.variables else {}
    reference_system = attrs.get("crs_wkt") or attrs.get("spatial_ref")
    wkt = None if reference_system is None else str(reference_system)
    text = attrs.get("GeoTransform")
    transform = None if text is None else _numbers(text)
    axes = [dataset.variables.get(name) for name in ("x", "y")]
    if any(axis is None or axis.dims != (name,) for name, axis in zip("xy", axes, strict=True)):
        planes = [dataset.variables.get(name) for name in ("east", "north")]
        has_positions = all(plane is not None and set(plane.dims) == {"y", "x"} for plane in planes)
        if transform is None or not has_positions:
            return None if transform is None else Grid(transform, wkt)
        computed = _grid_through_positions(dataset, transform)
        return Grid(transform if _agree(computed, transform, dataset) else computed, wkt)
    if transform is None:
        if any(dataset.sizes[name] < 2 for name in ("x", "y")):
            return None
        (x, width), (y, height) = _edges_and_steps(dataset, (math.nan, math.nan))
        return Grid((x, width, 0.0, y, 0.0, height), wkt)
    a, b, c, d, e, f = transform
    if c != 0.0 or e != 0.0:
        # the cells lie at the distances ``x`` and ``y`` from the corner of the transform
        sizes = math.hypot(b, e), math.hypot(c, f)
        (x, width), (y, height) = _edges_and_steps(dataset, sizes)
        col, row, cols, rows = x / sizes[0], y / sizes[1], width / sizes[0], height / sizes[1]
        computed = a + col * b + row * c, cols * b, rows * c, d + col * e + row * f, cols * e, rows * f
        SchemaError.raise_if(
            not _agree(computed, transform, dataset),
            f"GeoTransform of {SPATIAL_REF} is rotated, and 'x' and 'y' are not the distances of all "
            "cells from its corner, so the position of these cells is ambiguous",
            mend="drop 'x' and 'y' if this is the whole grid",
            code="place-ambiguous",
        )
    else:
        (x, width), (y, height) = _edges_and_steps(dataset, (b, f))
        computed = x, width, 0.0, y, 0.0, height
    # a transform that agrees is returned unchanged, bit for bit
    return Grid(transform if _agree(computed, transform, dataset) else computed, wkt)


def required_grid(dataset: xr.Dataset) -> Grid:
    # Return the grid of a map; SchemaError where its position is unknown.
    grid = grid_of(dataset)
    if grid is None:
        raise SchemaError(
            "the position of this map is unknown",
            expected="spatial_ref with a GeoTransform, or x and y",
            code="place-unknown",
        )
    return grid


def _grid_through_positions(dataset: xr.Dataset, transform: Transform) -> Transform:
    # Return the grid through ``east`` and ``north`` of the first row and column.
    # A single row or column gets the step of ``transform``.
    _, b, c, _, e, f = transform
    tolerance = _TOLERANCE * max(math.hypot(b, e), math.hypot(c, f)) + _ROUNDING
    computed: list[float] = []
    for name, by_column, by_row in (("east", b, c), ("north", e, f)):
        plane = dataset[name].transpose("y", "x")
        steps = []
        for values, single in ((plane[0].values, by_column), (plane[:, 0].values, by_row)):
            step, deviation = _step_and_deviation(values, single)
            SchemaError.raise_if(
                not deviation <= tolerance,
                f"the position of this map is unknown: {name!r} is not evenly spaced",
                mend="choose cells at even steps",
                code="spacing-uneven",
            )
            steps.append(step)
        computed += [float(plane[0, 0]) - sum(steps) / 2.0, *steps]
    a, b, c, d, e, f = computed
    return a, b, c, d, e, f


def _edges_and_steps(dataset: xr.Dataset, steps: tuple[float, float]) -> list[tuple[float, float]]:
    # Return outer edge of the first pixel and step, of x and y; ``steps`` are used for single pixels.
    problems = Problems("the position of this map is unknown", SchemaError)
    edges_and_steps = []
    for name, single in zip("xy", steps, strict=True):
        centres = np.asarray(dataset[name].values, np.float64)
        step, deviation = _step_and_deviation(centres, single)
        problems.add_if(
            step == 0.0 or not deviation <= _TOLERANCE * abs(step) + _ROUNDING,
            f"{name!r} is not evenly spaced",
            mend="choose cells at even steps",
            code="spacing-uneven",
        )
        edges_and_steps.append((float(centres[0] - step / 2.0), step))
    problems.raise_if_any()
    return edges_and_steps


def _step_and_deviation(values: NDArray[Any], single: float) -> tuple[float, float]:
    # Mean step of values, ``single`` for one value, and their largest deviation from even steps
    step = float(values[-1] - values[0]) / (values.size - 1) if values.size > 1 else float(single)
    return step, float(np.abs(values - (values[0] + step * np.arange(values.size))).max())


def _agree(grid: Transform, reference: Transform, dataset: xr.Dataset) -> bool:
    # Return whether two grids agree over a map, except for rounding.
    (a, b, c), (d, e, f) = (
        [value - other for value, other in zip(grid[k : k + 3], reference[k : k + 3], strict=True)]
        for k in (0, 3)
    )
    tolerance = _TOLERANCE * max(map(abs, (*reference[1:3], *reference[4:]))) + _ROUNDING
    return all(
        abs(a + b * col + c * row) <= tolerance and abs(d + e * col + f * row) <= tolerance
        for col, row in [(col, row) for col in (0, dataset.sizes["x"]) for row in (0, dataset.sizes["y"])]
    )


def _numbers(text: Any) -> Transform:
    try:
        items = text.replace(",", " ").split() if isinstance(text, str) else text
        a, b, c, d, e, f = (float(item) for item in items)
    except (TypeError, ValueError):
        a = b = c = d = e = f = math.nan
    SchemaError.raise_if(
        not all(map(math.isfinite, (a, b, c, d, e, f))) or b * f - c * e == 0.0,
        f"GeoTransform of {SPATIAL_REF} is {text!r:.80}",
        expected="six numbers in GDAL's order: x of the outer corner, its steps a column and a row, then y",
        code="transform-wrong",
    )
    return a, b, c, d, e, f


# --- in ENVI's terms ---------------------------------------------------------------------------------------


def envi_map_info(grid: Grid) -> dict[str, str]:
    # Return the ENVI header entries for the position of a grid, without braces.
    # ENVI writes an angle: a column steps along (cos r, sin r), a row along (sin r, -cos r), r = ``rotation``
    # as GDAL reads it.
    # Raises `SchemaError`: The grid is sheared, mirrored, or rotated with pixels that are not square. Raises
    # `MissingExtraError`: There is a reference system, and pyproj is not installed.
    a, b, c, d, e, f = grid.transform
    width, height = math.hypot(b, e), math.hypot(c, f)
    problems = Problems("ENVI cannot describe this grid", SchemaError)
    is_rotated = e != 0.0 or c != 0.0
    problems.extend(
        Problem(found, mend=mend, code=code)
        for is_wrong, found, mend, code in (
            (grid.mirrored, "it is mirrored", "reverse its rows", "grid-mirrored"),
            (
                abs(b * c + e * f) > 1e-9 * width * height,
                "its rows and columns do not cross at right angles",
                "",
                "grid-sheared",
            ),
            (
                is_rotated and abs(width - height) > 1e-9 * width,
                f"it is rotated, and its pixels are not square: {width:g} x {height:g}",
                "",
                "pixels-not-square",
            ),
        )
        if is_wrong
    )
    problems.raise_if_any()
    projection, zone, units, entries = _reference_system(grid.wkt)
    entries_of_map = [projection, "1", "1", *map(repr, (a, d, width, height)), *zone, f"units={units}"]
    if is_rotated or b < 0.0:
        angle = math.degrees(math.atan2(e, b))
        # GDAL reads 180 as rows that count upwards, and the next larger float as a half turn
        entries_of_map.append(f"rotation={math.nextafter(180.0, 360.0) if abs(angle) == 180.0 else angle!r}")
    return {"map info": ", ".join(entries_of_map), **entries}


def _reference_system(wkt: str | None) -> tuple[str, list[str], str, dict[str, str]]:
    # Return projection, entries after the pixel size, map units, and the reference system as text.
    if wkt is None:
        return "Arbitrary", [], "Meters", {}
    with needs_extra("pyproj", "geo", "a map with its reference system"):
        import pyproj
    try:
        crs = pyproj.CRS.from_user_input(wkt).to_2d()
    except pyproj.exceptions.CRSError as error:
        raise SchemaError(
            f"{SPATIAL_REF} holds a reference system that PROJ does not know: {wkt[:60]!r}",
            code="crs-unknown",
        ) from error
    text = {"coordinate system string": crs.to_wkt("WKT1_ESRI")}
    geodetic = crs.geodetic_crs
    datum = geodetic.name if geodetic is not None else "WGS 84"
    datum = {"WGS 84": "WGS-84"}.get(datum, datum)
    if crs.is_geographic:
        return "Geographic Lat/Lon", [_plain(datum)], "Degrees", text
    unit = "Meters" if crs.axis_info[0].unit_conversion_factor == 1.0 else _plain(crs.axis_info[0].unit_name)
    if crs.utm_zone is not None:
        zone, south = crs.utm_zone[:-1], crs.utm_zone.endswith("S")
        return "UTM", [zone, "South" if south else "North", _plain(datum)], unit, text
    return _plain(crs.name), [_plain(datum)], unit, text


def _plain(text: str) -> str:
    return re.sub(r"[,{}=\s]+", " ", text).strip() or "unknown"


# --- formats of map files, and metadata of maps for other programs ----------------------------------------


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
    _, place = _corners_and_place(dataset, grid)
    return {
        "zarr_conventions": conventions,
        **_crs_fields(grid),
        "spatial:dimensions": ["y", "x"],
        **{f"spatial:{key}": place[key] for key in ("transform", "shape", "bbox")},
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
    (x, y), place = _corners_and_place(dataset, grid)
    longitude, latitude = (
        np.round(part, 9).tolist()
        for part in pyproj.Transformer.from_crs(grid.wkt, "EPSG:4326", always_xy=True).transform(x, y)
    )
    times = dataset["line_time"].values.astype("datetime64[ns]").ravel()
    times = times[~np.isnat(times)]
    SchemaError.raise_if(not times.size, "no cell of this map has a time in line_time", code="time-missing")
    first, last = times.min(), times.max()
    moments = {"datetime": first + (last - first) // 2, "start_datetime": first, "end_datetime": last}
    ring = [list(corner) for corner in zip(longitude, latitude, strict=True)]
    geometry, box = cut_at_dateline({"type": "Polygon", "coordinates": [[*ring, ring[0]]]})
    return {
        "type": "Feature",
        "stac_version": "1.1.0",
        "stac_extensions": [
            f"https://stac-extensions.github.io/{name}/schema.json" for name in _STAC_EXTENSIONS
        ],
        "id": path.stem,
        "geometry": geometry,
        "bbox": box,
        "properties": {
            **{key: f"{np.datetime_as_string(time, unit='ms')}Z" for key, time in moments.items()},
            "gsd": float(np.hypot(grid.transform[1], grid.transform[4])),
            **_crs_fields(grid),
            **{f"proj:{key}": place[key] for key in ("shape", "transform", "bbox")},
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


def cut_at_dateline(geometry: dict[str, Any]) -> tuple[dict[str, Any], list[float]]:
    """Return a GeoJSON geometry in longitude and latitude, and its bounding box.

    Polygons that cross the longitude of 180 degrees are cut there, and the box begins in the west at the
    larger longitude (RFC 7946, 3.1.9 and 5.2).

    Examples
    --------
    >>> ring = [[179.0, 1.0], [-179.0, 1.0], [-179.0, 2.0], [179.0, 2.0], [179.0, 1.0]]
    >>> geometry, box = cut_at_dateline({"type": "Polygon", "coordinates": [ring]})
    >>> geometry["type"], box
    ('MultiPolygon', [179.0, 1.0, -179.0, 2.0])
    """
    polygons = geometry["coordinates"] if geometry["type"] == "MultiPolygon" else [geometry["coordinates"]]
    corners = np.array([corner for polygon in polygons for ring in polygon for corner in ring], np.float64)
    (west, south), (east, north) = corners.min(axis=0).tolist(), corners.max(axis=0).tolist()
    if east - west <= 180.0 and -180.0 <= west <= east <= 180.0:
        return geometry, [west, south, east, north]
    with needs_extra("shapely", "geo", "an outline across the longitude of 180 degrees"):
        import shapely
    shape = shapely.from_geojson(json.dumps(geometry))
    shape = shapely.transform(shape, lambda xy: np.column_stack([xy[:, 0] % 360.0, xy[:, 1]]))
    parts = [
        shapely.transform(part, lambda xy, turn=turn: xy - [turn, 0.0])
        for first, turn in ((0.0, 0.0), (180.0, 360.0))
        for part in shapely.get_parts(shapely.intersection(shape, shapely.box(first, -90, first + 180, 90)))
        if part.geom_type == "Polygon"
    ]
    cut = shapely.orient_polygons(shapely.multipolygons(parts))
    longitude = corners[:, 0] % 360.0
    box = [float(longitude.min()), south, float(longitude.max()) - 360.0, north]
    return json.loads(shapely.to_geojson(cut)), box


def _crs_fields(grid: Grid) -> dict[str, Any]:
    # Return code or WKT of the reference system, under the names that STAC and GeoZarr share.
    if grid.wkt is None:
        return {}
    with needs_extra("pyproj", "geo", "the reference system of a map"):
        import pyproj
    crs = pyproj.CRS.from_user_input(grid.wkt)
    code = crs.to_authority(min_confidence=100)
    return {"proj:code": ":".join(code)} if code else {"proj:wkt2": crs.to_wkt()}


def _corners_and_place(
    dataset: xr.Dataset, grid: Grid
) -> tuple[tuple[list[float], list[float]], dict[str, list[Any]]]:
    # Return x and y of the outer corners, counterclockwise from the first cell; and shape, transform (in the
    # order of the package affine: x by column, row and offset, then y) and bounding box of a map.
    a, b, c, d, e, f = map(float, grid.transform)
    rows, cols = dataset.sizes["y"], dataset.sizes["x"]
    corners = ((0, 0), (rows, 0), (rows, cols), (0, cols))
    x, y = [a + b * j + c * i for i, j in corners], [d + e * j + f * i for i, j in corners]
    return (x, y), {
        "shape": [rows, cols],
        "transform": [b, c, a, e, f, d],
        "bbox": [min(x), min(y), max(x), max(y)],
    }


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
