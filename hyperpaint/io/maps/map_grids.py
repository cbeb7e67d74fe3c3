"""Variable and affine grid of an exported line or map, formats of map files, GeoZarr and STAC metadata.

Height rasters, read by GDAL: few drivers, a single file, no network, only the needed window.

GDAL decides by content: text inside a ``.tif`` may be a virtual raster that names other files and URLs, files
beside it are opened with it, and a tag may name a file of overviews. Only the ``.prj`` of an ASCII grid,
which holds its crs, is read besides.

Writing of maps as GeoTIFF and in other formats of GDAL: all bands, or a picture in true colours.

Windows are written one row of tiles at a time; GDAL then streams the plain file into the final format.
"""

import contextlib
import json
import math
import os
import re
import threading
import uuid
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from hyperpaint.base import (
    ALONG_TRACK,
    BAND,
    CROSS_TRACK,
    VARIABLES,
    FormatError,
    Problem,
    Problems,
    SchemaError,
    as_path,
    documented,
    head_of,
    input_path,
    needs_extra,
    open_input,
    takes_quantities,
)
from hyperpaint.io.files.publishing import published_files, unwritable
from hyperpaint.io.files.reading import number
from hyperpaint.io.store import in_stages

TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
#: First bytes of files, and the driver that opens them; all are single-file formats.
_DRIVERS = ((TIFF, "GTiff"), ((b"UHL1", b"HDR1", b"VOL1"), "DTED"))
#: First words of the header of an ASCII grid, in either case.
_GRID_KEYWORDS = (
    b"ncols",
    b"nrows",
    b"xllcorner",
    b"xllcenter",
    b"yllcorner",
    b"yllcenter",
    b"cellsize",
    b"dx",
    b"dy",
)

_SIZES = SimpleNamespace(
    max_raster_bytes=2**40,
    max_prj_bytes=2**16,
    max_aux_bytes=2**20,
    # Maximum number of cells of a raster that is read completely; from a larger raster, a window is read.
    max_whole_cells=2**24,
    # Maximum number of cells of a window: half a gigabyte with all derived arrays.
    max_window_cells=2**25,
    # Largest block, tile or strip, which GDAL decodes completely even for one cell [byte].
    max_block_bytes=2**27,
)


#: No files beside the raster are searched, and no URLs are fetched.
_ENVIRONMENT = {
    "GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR",
    "GDAL_PAM_ENABLED": "NO",
    "CPL_VSIL_CURL_ALLOWED_EXTENSIONS": ".none",
    "GDAL_HTTP_MAX_RETRY": "0",
    "VRT_VIRTUAL_OVERVIEWS": "NO",
    "GDAL_CACHEMAX": 64 * 2**20,  # bytes, not a share of the memory
}

#: Elements of an ``.aux.xml`` that change heights or their positions.
_POSITION_ELEMENTS = {b"<NoDataValue": "a nodata", b"<GeoTransform": "a transform", b"<SRS": "a crs"}


@contextlib.contextmanager
def open_raster(path: str | os.PathLike[str], purpose: str) -> Iterator[Any]:
    # Yield a raster opened by rasterio; ``purpose`` names the operation that needs rasterio.
    # From files beside it, only the ``.prj`` of an ASCII grid is read.
    # Raises `FormatError`: It is not a plain file, not a raster of these kinds, damaged, or names other
    # files; or its ``.prj`` is not a plain file, or larger than 64 KiB. Raises `MissingExtraError`: rasterio
    # is not installed.
    path = input_path(path, "a raster")
    with open_input(path, "a raster", _SIZES.max_raster_bytes) as file:
        first_bytes, full_path = file.read(64).lstrip(), os.path.abspath(path)
    forms = (
        *((first_bytes.startswith(magic), name) for magic, name in _DRIVERS),
        (first_bytes.lower().startswith(_GRID_KEYWORDS), "AAIGrid"),
        (full_path.lower().endswith(".hgt"), "SRTMHGT"),
    )
    driver = next((name for is_form, name in forms if is_form), "")
    FormatError.raise_if(
        not driver,
        f"{path}: not a TIFF, ASCII grid, SRTM .hgt or DTED, in spite of its name",
        mend="convert other rasters to GeoTIFF with gdal_translate",
        code="format-unknown",
    )
    for prj in (os.path.splitext(full_path)[0] + suffix for suffix in (".prj", ".PRJ")):
        if driver == "AAIGrid" and os.path.lexists(prj):
            open_input(prj, "the crs of an ASCII grid", _SIZES.max_prj_bytes).close()
    with needs_extra("rasterio", "geo", purpose):
        import rasterio
        from rasterio._err import CPLE_BaseError
        from rasterio.errors import CRSError
    with (
        FormatError.instead_of(
            (rasterio.errors.RasterioError, CRSError, CPLE_BaseError, UnicodeDecodeError),
            f"{path}: GDAL cannot read it as {driver} ($error)",
            mend="copy it again",
            code="raster-damaged",
        ),
        warnings.catch_warnings(action="ignore"),  # rasterio warns of files without position
        rasterio.Env(**_ENVIRONMENT),
        rasterio.open(full_path, driver=driver, sharing=False) as raster,
    ):
        FormatError.raise_if(
            raster.tags(ns="OVERVIEWS"),
            f"{path} names another file for its overviews",
            mend="convert it with gdal_translate",
            code="file-not-alone",
        )
        yield raster


def read_heights(path: str | os.PathLike[str], around: tuple[Any, Any, Any] | None = None) -> xr.DataArray:
    # Return a height raster (y, x); from a large raster, the window around a flight.
    # path: A GeoTIFF, a grid of text (``.asc``), SRTM (``.hgt``) or DTED. around: Longitudes, latitudes
    # [degree] and heights [m] of the flight, (time,) each: a raster of more than `_SIZES.max_whole_cells`
    # cells is read only within four times the flight height above ground.
    # Returns float32, or float64 where float32 is too narrow: NaN in holes, scale and offset of the file
    # applied, with coordinates of the cells' centres and `spatial_ref`. Raises FormatError: As `open_raster`;
    # it has several bands, is rotated, lacks crs, transform or metadata in a file beside it, has blocks over
    # `_SIZES.max_block_bytes`, or needs a window of too many cells. Raises SchemaError: It is large, and the
    # position of the flight is unknown.
    with open_raster(path, "opening a DEM") as raster:
        from rasterio.enums import MaskFlags

        a, b, c, d, e, f = tuple(raster.transform)[:6]
        # metadata that the raster lacks, and files beside it, which are not read, with that metadata
        full_path = os.path.abspath(path)
        stem = os.path.splitext(full_path)[0]
        is_masked = MaskFlags.per_dataset in raster.mask_flag_enums[0]
        is_missing = {
            "a nodata": raster.nodata is None and not is_masked,
            "a transform": raster.transform.is_identity,
            "a crs": raster.crs is None,
        }
        aux = head_of(f"{full_path}.aux.xml", _SIZES.max_aux_bytes)
        files_by_item = {
            item: f"{full_path}.aux.xml"
            for element, item in _POSITION_ELEMENTS.items()
            if is_missing[item] and element in aux
        }
        for item, name in (
            ("a nodata", f"{full_path}.msk"),
            *(("a transform", stem + suffix) for suffix in (".tfw", ".TFW", ".tifw", ".tiffw", ".wld")),
            ("a transform", f"{full_path}w"),
            ("a crs", f"{stem}.prj"),
        ):
            if is_missing[item] and os.path.exists(name):
                files_by_item.setdefault(item, name)
        listed = ", ".join(f"{item} in {os.path.basename(name)}" for item, name in files_by_item.items())
        has_prj = files_by_item.get("a crs", "").endswith(".prj")
        srs = f" -a_srs {os.path.basename(stem)}.prj" if has_prj else ""
        missing = [item for item in ("a transform", "a crs") if is_missing[item]]
        block_rows, block_columns = raster.block_shapes[0]
        is_complex = raster.dtypes[0].startswith("complex")  # numpy lacks some of these types
        itemsize = 0 if is_complex else np.dtype(raster.dtypes[0]).itemsize
        block_bytes = block_rows * block_columns * itemsize
        for is_wrong, found, expected, mend, code in (
            (
                raster.count != 1,
                f": {raster.count} bands",
                "one of heights",
                "extract that band with gdal_translate -b",
                "band-count",
            ),
            (is_complex, f": cells of {raster.dtypes[0]}", "heights", "", "type-wrong"),
            (
                b or d or not a or not e,
                f": its rows do not run east, by its transform {(a, b, c, d, e, f)}",
                "north up",
                "gdalwarp in.tif out.tif",
                "grid-rotated",
            ),
            (
                bool(files_by_item),
                f" is read without other files, which hold part of its metadata: {listed}",
                "",
                f"merge them: gdal_translate{srs} in.tif out.tif",
                "file-not-alone",
            ),
            (
                bool(missing),
                f" has no position without {' and '.join(missing)}",
                "",
                "set it with gdal_translate -a_srs EPSG:<code> -a_ullr <west north east south>",
                "place-unknown",
            ),
            (
                not np.isfinite(tuple(raster.transform)).all(),
                f": its transform is {tuple(raster.transform)[:6]}",
                "finite numbers",
                "set it with gdal_translate -a_ullr <west north east south>",
                "not-finite",
            ),
            (
                block_bytes > _SIZES.max_block_bytes,
                f": blocks of {block_rows} x {block_columns} cells, {block_bytes} bytes, read completely for "
                "each cell",
                f"at most {_SIZES.max_block_bytes}",
                "gdal_translate -co TILED=YES in.tif out.tif",
                "file-too-large",
            ),
        ):
            FormatError.raise_if(is_wrong, f"{path}{found}", expected=expected, mend=mend, code=code)
        is_large = raster.height * raster.width > _SIZES.max_whole_cells
        whole = (0, raster.height), (0, raster.width)
        rows, columns = _window(raster, path, around) if is_large else whole
        values = _read_cells(raster, rows, columns)
        crs = None if raster.crs is None else raster.crs.to_wkt()
        # the declared unit of the heights, and their reference surface
        tags = raster.tags()
        declared: dict[str, Any] = {"units": raster.units[0]} if raster.units[0] else {}
        if "height_reference" in tags:
            declared["height_reference"] = tags["height_reference"]
        undulation = number(tags.get("geoid_undulation", ""))
        if undulation is not None and np.isfinite(undulation):
            declared["geoid_undulation"] = undulation
    attrs = {"GeoTransform": f"{c} {a} {b} {f} {d} {e}"} | ({} if crs is None else {"crs_wkt": crs})
    return xr.DataArray(
        values,
        {
            # half a cell is added to the corner first, like in rioxarray: the same bits
            "x": ("x", np.arange(*columns) * a + (a * 0.5 + b * 0.5 + c)),
            "y": ("y", np.arange(*rows) * e + (d * 0.5 + e * 0.5 + f)),
            "spatial_ref": ((), 0, attrs),
        },
        ("y", "x"),
        attrs=declared,
    )


def _read_cells(raster: Any, rows: tuple[int, int], columns: tuple[int, int]) -> np.ndarray[Any, Any]:
    from rasterio.enums import MaskFlags
    from rasterio.windows import Window

    window = Window.from_slices(rows, columns)
    stored: np.ndarray[Any, Any] = raster.read(1, window=window)
    fits_float32 = stored.dtype.itemsize <= 2 or stored.dtype == np.float32
    values = stored.astype(np.float32 if fits_float32 else np.float64)
    if raster.nodata is not None:
        values[stored == raster.nodata] = np.nan
    # a mask inside the file; masks beside it are not opened
    if MaskFlags.per_dataset in raster.mask_flag_enums[0]:
        values[raster.read_masks(1, window=window) == 0] = np.nan
    # replace infinities, and signalling NaNs of a damaged file, which would warn in every sum
    values[~np.isfinite(values)] = np.nan
    scale, offset = raster.scales[0], raster.offsets[0]
    FormatError.raise_if(
        not (np.isfinite(scale) and np.isfinite(offset) and scale != 0.0),
        f"{raster.name}: scale {scale:g} and offset {offset:g}",
        expected="finite ones, no scale of 0",
        mend="set them with gdal_edit -a_scale 1 -a_offset 0",
        code="scale-wrong",
    )
    return values if (scale, offset) == (1.0, 0.0) else values * scale + offset


_WINDOW = SimpleNamespace(
    # Cells are read up to this distance from the flight [heights above ground]: 76 degrees off nadir.
    heights=4.0,
    # Additional border on each side [cell].
    border_cells=64,
    track_points=257,
)


def _window(
    raster: Any, path: str | os.PathLike[str], around: tuple[Any, Any, Any] | None
) -> tuple[tuple[int, int], tuple[int, int]]:
    # Return the rows and columns of a raster around a flight.
    from rasterio._err import CPLE_BaseError
    from rasterio.errors import CRSError, RasterioError
    from rasterio.warp import transform

    subject = f"{path} has {raster.height} x {raster.width} cells"
    points = None if around is None else np.stack([np.asarray(values, np.float64) for values in around])
    points = None if points is None else points[:, np.isfinite(points).all(axis=0)]
    if points is None or not points.size:
        raise SchemaError(
            f"{subject}, and the line has no positions to select a window by",
            mend="cut out the area of the flight",
            code="positions-missing",
        )
    FormatError.raise_if(
        raster.crs is None,
        f"{subject}, and no crs to find the flight in it",
        mend="declare it with gdal_edit -a_srs",
        code="crs-missing",
    )
    longitude, latitude, _ = points[:, :: max(1, points.shape[1] // _WINDOW.track_points)]
    with FormatError.instead_of(
        (CPLE_BaseError, CRSError, RasterioError),
        f"{subject}, and positions cannot be converted to its crs ($error)",
        mend="declare the right one with gdal_edit -a_srs",
        code="crs-unknown",
    ):
        x, y = (
            np.asarray(coordinate) for coordinate in transform("EPSG:4326", raster.crs, longitude, latitude)
        )
    column, row = ~raster.transform * (x, y)
    column, row = (coordinate[np.isfinite(column) & np.isfinite(row)] for coordinate in (column, row))
    is_inside = (row >= 0) & (row < raster.height) & (column >= 0) & (column < raster.width)
    FormatError.raise_if(
        not is_inside.any(),
        f"{subject}, and the flight is outside of it",
        mend="give the DEM of this place",
        code="flight-outside",
    )
    heights = np.array(
        [
            float(_read_cells(raster, (int(r), int(r) + 1), (int(k), int(k) + 1))[0, 0])
            for r, k in zip(row[is_inside], column[is_inside], strict=True)
        ]
    )
    lowest = float(heights[np.isfinite(heights)].min(initial=np.inf))
    height_above_ground = max(float(points[2].max()) - min(lowest, float(points[2].max())), 0.0)
    units_per_metre = 1.0 if raster.crs.is_projected else 1.0 / 111_000.0
    reach = _WINDOW.heights * height_above_ground * units_per_metre
    longitude_factor = (
        1.0 if raster.crs.is_projected else 1.0 / max(float(np.cos(np.radians(latitude)).min()), 0.01)
    )
    (top, bottom), (left, right) = (
        (
            max(int(values.min() - cells) - _WINDOW.border_cells, 0),
            min(int(values.max() + cells) + _WINDOW.border_cells + 1, size),
        )
        for values, size, cells in (
            (row, raster.height, reach / abs(raster.transform.e)),
            (column, raster.width, reach * longitude_factor / abs(raster.transform.a)),
        )
    )
    FormatError.raise_if(
        (bottom - top) * (right - left) > _SIZES.max_window_cells,
        f"{subject}, {bottom - top} x {right - left} of them around this flight",
        expected=f"at most {_SIZES.max_window_cells} in all",
        mend="resample it with gdalwarp -tr",
        code="file-too-large",
    )
    return (top, bottom), (left, right)


# --- rasters -----------------------------------------------------------------------------------------------

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


def grid_of(dataset: xr.Dataset) -> Grid | None:
    # Return the grid of a map; None where its position is unknown.
    # ``x`` and ``y`` at pixel centres take precedence, since they follow every selection of cells, whereas
    # ``GeoTransform`` of ``spatial_ref`` does not. ``GeoTransform`` is used where they are missing, and for
    # the step of a single row or column. A grid along the flight has ``east`` and ``north`` (y, x) instead.
    # Raises `SchemaError`: ``GeoTransform`` is not six finite numbers; ``x`` and ``y``, or ``east`` and
    # ``north``, are not evenly spaced; or the grid is rotated and ``x`` and ``y`` are not distances along it.
    attrs = dataset[SPATIAL_REF].attrs if SPATIAL_REF in dataset.variables else {}
    axes = [dataset.variables.get(name) for name in ("x", "y")]
    # maps of ENVI name their reference system at the axes alone
    stated = {} if axes[0] is None else axes[0].attrs
    reference_system = attrs.get("crs_wkt") or attrs.get("spatial_ref") or stated.get("crs")
    wkt = None if reference_system is None else str(reference_system)
    text = attrs.get("GeoTransform")
    transform = None if text is None else _numbers(text)
    if any(axis is None or axis.dims != (name,) for name, axis in zip("xy", axes, strict=True)):
        planes = [dataset.variables.get(name) for name in ("east", "north")]
        has_positions = all(plane is not None and set(plane.dims) == {"y", "x"} for plane in planes)
        if transform is None or not has_positions:
            return None if transform is None else Grid(transform, wkt)
        # the grid through ``east`` and ``north`` of the first row and column; a single row or column gets the
        # step of ``transform``
        a, b, c, d, e, f = transform
        tolerance = _TOLERANCE * max(math.hypot(b, e), math.hypot(c, f)) + _ROUNDING
        corners_and_steps: list[float] = []
        for name, by_column, by_row in (("east", b, c), ("north", e, f)):
            plane = dataset[name].transpose("y", "x")
            along_row = _step_and_deviation(plane[0].values, by_column)
            steps, deviations = zip(along_row, _step_and_deviation(plane[:, 0].values, by_row), strict=True)
            SchemaError.raise_if(
                not all(deviation <= tolerance for deviation in deviations),
                f"the position of this map is unknown: {name!r} is not evenly spaced",
                mend="choose cells at even steps",
                code="spacing-uneven",
            )
            corners_and_steps += [float(plane[0, 0]) - sum(steps) / 2.0, *steps]
        a, b, c, d, e, f = corners_and_steps
        computed = a, b, c, d, e, f
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
    # a rotated map of ENVI has no x and y, only the text of its header
    is_rotated = bool(re.search(r"rotation *= *[-+.0]*[1-9]", str(dataset.attrs.get("map_info"))))
    return SchemaError.raise_if_none(
        grid_of(dataset),
        f"the position of this map is unknown{': map info of its header is rotated' * is_rotated}",
        expected="spatial_ref with a GeoTransform, or x and y",
        mend="turn it north up first, for instance with gdalwarp" * is_rotated,
        code="place-unknown",
    )


def _edges_and_steps(dataset: xr.Dataset, steps: tuple[float, float]) -> list[tuple[float, float]]:
    # Return outer edge of the first pixel and step, of x and y; ``steps`` are used for single pixels.
    with Problems("the position of this map is unknown", SchemaError) as problems:
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
    with Problems("ENVI cannot describe this grid", SchemaError) as problems:
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
    with SchemaError.instead_of(
        pyproj.exceptions.CRSError,
        f"{SPATIAL_REF} holds a reference system that PROJ does not know: {wkt[:60]!r}",
        code="crs-unknown",
    ):
        crs = pyproj.CRS.from_user_input(wkt).to_2d()
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
    missing = "reference system" if grid.wkt is None else "line_time"
    SchemaError.raise_if(
        grid.wkt is None or "line_time" not in dataset.variables,
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
    return json.loads(shapely.to_geojson(cut)), [
        float(longitude.min()),
        south,
        float(longitude.max()) - 360.0,
        north,
    ]


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


# --- GeoTIFF -----------------------------------------------------------------------------------------------

# Number of rows from which the brightness range of a picture is computed.
_SAMPLED_ROWS = 64
_BLOCK_BYTES = 64 * 2**20
_BANDS_AT_ONCE = 16
_RGB = ("red", "green", "blue")
# GDAL's default, 5 % of the machine's memory, would fill with bands that are written once. Rasterio takes
# bytes, where GDAL itself takes small numbers as megabytes.
CACHE_BYTES = 64 * 2**20


@takes_quantities()
@documented()
def write_geotiff(
    map: xr.Dataset,
    path: str | os.PathLike[str],
    *,
    variable: str | None = None,
    bands: Literal["all", "rgb"] | Sequence[int] = "all",
    cog: bool = True,
    stretch: tuple[float, float] = (2.0, 98.0),
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Write a map as GeoTIFF.

    Parameters
    ----------
    map
        With a variable on (y, x, band) or (y, x) in any order, and a position: ``spatial_ref`` with
        ``GeoTransform`` (any affine, rotated or not), or ``x`` and ``y``.
    path
    variable
    bands
        ``"all"``; indices; or ``"rgb"``: an 8-bit picture of the bands nearest to 640, 550 and 460 nm,
        brightness between the percentiles of ``stretch``, sRGB curve, transparent (alpha) where a band is
        unknown.
    cog
        Write a cloud-optimised GeoTIFF: tiled, with overviews, deflated.
    stretch
        Percentiles of brightness that become black and white, computed from at most 64 rows.
    overwrite
    progress

    Returns
    -------
    pathlib.Path
        The file.

    Raises
    ------
    SchemaError
        The variable or a band is missing, its dims are wrong, the position is unknown, or ``"rgb"`` has no
        bands near those wavelengths.
    StoreError
        A file exists, or cannot be written. An existing file stays.
    MissingExtraError
        rasterio is not installed.

    Notes
    -----
    Floats are float32 (positions such as ``east`` and ``glt_line`` float64), unknown samples NaN;
    integers keep their type. The wavelength is the description of a band, and a tag. The bands nearest to
    640, 550 and 460 nm are interpreted as red, green and blue, so that a GIS opens the map in true colour.

    Examples
    --------
    >>> import tempfile, xarray as xr
    >>> from hyperpaint.geometry import orthorectify
    >>> north, east = np.meshgrid([0.0, 2.0, 4.0], [10.0, 12.0, 14.0], indexing="ij")
    >>> dims, metres = ("along_track", "cross_track"), {"units": "m", "crs": "EPSG:32618"}
    >>> line = xr.Dataset({"red": (dims, np.arange(9.0).reshape(3, 3))})
    >>> line = line.assign_coords(east=(dims, east, metres), north=(dims, north, metres))
    >>> map = orthorectify(line, 2.0, variables="red")
    >>> write_geotiff(map, Path(tempfile.mkdtemp(), "red.tif"), variable="red").name
    'red.tif'
    """
    path = as_path(path)
    with published_files([path], overwrite=overwrite) as (target,):
        draw_geotiff(map, target, path, variable, bands, cog, stretch, progress)
    return path


def draw_geotiff(
    map: xr.Dataset,
    target: Path,
    final_path: Path,
    variable: str | None = None,
    bands: Literal["all", "rgb"] | Sequence[int] = "all",
    cog: bool = True,
    stretch: tuple[float, float] = (2.0, 98.0),
    progress: Callable[[int, int], None] | None = None,
    *,
    picture: Path | None = None,
) -> list[int]:
    # Write a map as GeoTIFF to ``target``, later moved to ``final_path``; errors as of `write_geotiff`.
    # ``picture``: also write the map's picture here, as ``bands="rgb"`` does.
    # Return the reduction factors of its overviews.
    with needs_extra("rasterio", "geo", "writing a GeoTIFF"):
        import rasterio
        from rasterio.shutil import copy
    array = product_of(map, variable)
    SchemaError.raise_if(
        "y" not in array.dims,
        f"{array.name!r} is {dict(array.sizes)}",
        expected="a map (y, x, band)",
        mend="orthorectify the line first",
        code="dim-missing",
    )
    grid = required_grid(map)
    band_numbers = _band_indices(map, array, bands)
    array = array.isel({BAND: band_numbers})
    is_picture = isinstance(bands, str) and bands == "rgb"
    # descriptions and tags of the bands
    axis = map.variables.get("wavelength")
    names = [str(array.name)] if len(band_numbers) == 1 else [f"band {band + 1}" for band in band_numbers]
    tags: list[dict[str, str]] = [{} for _ in band_numbers]
    if axis is not None and axis.dims == (BAND,) and BAND in map[array.name].dims:
        nm = axis.values.astype(np.float64)[band_numbers].tolist()
        names = [f"{value:.6g} nm" for value in nm]
        tags = [{"wavelength": repr(value), "wavelength_units": "Nanometers"} for value in nm]
    described = list(zip(names, tags, strict=True))
    nearest = (
        nearest_bands(axis.values[band_numbers], RGB_WAVELENGTHS) if axis is not None and tags[0] else None
    )
    # how a GIS shows the bands
    by_band = {} if nearest is None else dict(zip(nearest, _RGB, strict=True))
    colours = [by_band.get(band, "undefined" if band or by_band else "gray") for band in range(len(names))]
    form = RASTER_FORMATS.get(final_path.suffix.lower(), RASTER_FORMATS[".tif"])
    uncompressed = target.with_name(f"plain-{target.name}") if cog else target

    rgba, alpha = [*_RGB, "alpha"], ("alpha", dict[str, str]())
    try:
        with rasterio.Env(GDAL_CACHEMAX=CACHE_BYTES):
            if is_picture:
                _write(uncompressed, _picture(array, stretch), grid, rgba, [*described, alpha], progress)
            else:
                _write(uncompressed, storable(array), grid, colours, described, progress)
            if picture is not None and nearest is not None:
                plain = picture.with_name(f"plain-{picture.name}")
                shown = [*(described[band] for band in nearest), alpha]
                linear = _bands_in(uncompressed, nearest)
                _write(plain, _picture(linear, stretch), grid, rgba, shown, progress)
                copy(plain, picture, driver=form.driver, **form.picture_options)
            if cog:
                options = form.picture_options if is_picture else form.options
                copy(uncompressed, target, driver=form.driver, **options)
            with rasterio.open(target) as written:
                return list(written.overviews(1))
    except rasterio.errors.RasterioError as error:
        raise unwritable(final_path, error) from error


class GeotiffHeader(NamedTuple):
    # Metadata of a GeoTIFF; ``overviews`` are the reduction factors of its smaller copies.
    shape: tuple[int, int]
    bands: int
    dtype: str
    grid: Grid | None
    descriptions: tuple[str, ...]
    overviews: tuple[int, ...]


def read_geotiff_header(path: str | os.PathLike[str]) -> GeotiffHeader:
    # Return the metadata of a GeoTIFF; no cell is read.
    # Raises `FormatError`: it is not a TIFF, or damaged; `MissingExtraError`: rasterio is not installed.
    with open_input(path, "a GeoTIFF") as file:
        FormatError.raise_if(
            not file.read(4).startswith(TIFF),
            f"{path}: not a TIFF, in spite of its name",
            mend="check what the file is",
            code="format-unknown",
        )
    with open_raster(path, "reading a GeoTIFF") as raster:
        is_placed = raster.crs is not None or not raster.transform.is_identity
        wkt = None if raster.crs is None else raster.crs.to_wkt()
        return GeotiffHeader(
            raster.shape,
            raster.count,
            raster.dtypes[0],
            Grid(raster.transform.to_gdal(), wkt) if is_placed else None,
            tuple(text or "" for text in raster.descriptions),
            tuple(raster.overviews(1)),
        )


# --- values ------------------------------------------------------------------------------------------------


def _band_indices(map: xr.Dataset, array: xr.DataArray, bands: Any) -> list[int]:
    count = array.sizes[BAND]
    if isinstance(bands, str):
        if bands == "all":
            return list(range(count))
        SchemaError.raise_if(
            bands != "rgb", f"bands {bands!r:.40}", expected="'all', 'rgb' or indices", code="choice-unknown"
        )
        axis = map.variables.get("wavelength")
        has_axis = axis is not None and axis.dims == (BAND,) and axis.size == count
        return SchemaError.raise_if_none(
            nearest_bands(map["wavelength"].values, RGB_WAVELENGTHS) if has_axis else None,
            "a picture needs bands within 50 nm of 640, 550 and 460 nm",
            mend="choose bands by their indices",
            code="band-missing",
        )
    chosen = [int(band) for band in bands]
    SchemaError.raise_if(
        not chosen or not all(-count <= band < count for band in chosen),
        f"bands {chosen[:20]}",
        expected=f"one or more of 0 to {count - 1}",
        code="value-out-of-range",
    )
    return [band % count for band in chosen]


def _bands_in(path: Path, bands: list[int]) -> xr.DataArray:
    # Return bands of a plain GeoTIFF (y, x, band), read lazily row of tiles by row of tiles.
    import dask.array as da
    import rasterio
    from rasterio.windows import Window

    def read(block_info: Any = None) -> NDArray[Any]:
        (first, last), (_, width), _ = block_info[None]["array-location"]
        with rasterio.open(path) as raster:
            return np.moveaxis(
                raster.read([band + 1 for band in bands], window=Window(0, first, width, last - first)), 0, -1
            )

    with rasterio.open(path) as raster:
        (height, width), dtype = raster.shape, raster.dtypes[0]
    rows = tuple(min(TILE, height - start) for start in range(0, height, TILE))
    return xr.DataArray(
        da.map_blocks(
            read, chunks=(rows, (width,), (len(bands),)), dtype=dtype, name=f"read-{uuid.uuid4().hex}"
        ),
        dims=("y", "x", BAND),
    )


def _picture(array: xr.DataArray, stretch: tuple[float, float]) -> xr.DataArray:
    # Return 8-bit sRGB and alpha (y, x, band); 0 where a band is unknown.
    SchemaError.raise_if(
        not 0.0 <= stretch[0] < stretch[1] <= 100.0,
        f"stretch {stretch}",
        expected="two rising percentiles within 0 and 100",
        code="value-out-of-range",
    )
    step = -(-array.sizes["y"] // _SAMPLED_ROWS)
    sample = array.isel(y=slice(step // 2, None, step)).values.astype(np.float64)
    complete = sample[np.isfinite(sample).all(axis=-1)]
    # one range for all bands keeps the colours
    low, high = map(float, np.percentile(complete, stretch) if complete.size else (0.0, 1.0))
    high = max(high, low + 1e-12)

    def encode(linear: NDArray[Any]) -> NDArray[np.uint8]:
        is_complete = np.isfinite(linear).all(axis=-1, keepdims=True)
        share = np.clip((np.where(is_complete, linear, low) - low) / (high - low), 0.0, 1.0)
        # IEC 61966-2-1
        encoded = np.where(share <= 0.0031308, 12.92 * share, 1.055 * share ** (1.0 / 2.4) - 0.055)
        return np.where(
            is_complete,
            np.concatenate([np.round(1.0 + 254.0 * encoded), np.full_like(encoded[..., :1], 255.0)], -1),
            0.0,
        ).astype(np.uint8)

    picture: xr.DataArray = xr.apply_ufunc(
        encode,
        array,
        input_core_dims=[[BAND]],
        output_core_dims=[[BAND]],
        dask="parallelized",
        output_dtypes=[np.uint8],
        exclude_dims={BAND},
        dask_gufunc_kwargs={"allow_rechunk": True, "output_sizes": {BAND: 4}},
    )
    return picture


# --- the file ----------------------------------------------------------------------------------------------


def _write(
    path: Path,
    stored: xr.DataArray,
    grid: Grid,
    colours: list[str],
    bands: list[tuple[str, dict[str, str]]],
    progress: Callable[[int, int], None] | None,
) -> None:
    import dask.threaded
    import rasterio
    from rasterio.windows import Window

    # ``colours``: interpretation of every band; ``bands``: description and tags of every band.
    height, width, count = stored.shape
    is_picture = colours[-1] == "alpha"
    a, b, c, d, e, f = grid.transform
    profile = {
        "driver": "GTiff",
        "height": height,
        "width": width,
        "count": count,
        "dtype": stored.dtype.name,
        "transform": rasterio.Affine(b, c, a, e, f, d),
        "crs": None if grid.wkt is None else rasterio.crs.CRS.from_user_input(grid.wkt),
        "tiled": True,
        "blockxsize": TILE,
        "blockysize": TILE,
        "bigtiff": "if_safer",
        "interleave": "pixel" if is_picture else "band",
        "nodata": np.nan if stored.dtype.kind == "f" else None,
        **({"photometric": "rgb", "alpha": "yes"} if is_picture else {}),
    }
    # the blocks of a lazy map (y, x, band), one row of tiles after another, in this process
    rows = max(TILE, _BLOCK_BYTES // max(1, width * count * stored.dtype.itemsize) // TILE * TILE)
    array = (stored if stored.chunks is not None else stored.chunk(y=rows)).data
    lock = threading.Lock()  # rasterio datasets are not thread-safe
    done = 0

    def write(block: NDArray[Any], block_info: Any = None) -> NDArray[Any]:
        nonlocal done
        (row, _), (column, _), (first, last) = block_info[0]["array-location"]
        window = Window(column, row, block.shape[1], block.shape[0])
        with lock:
            for start in range(first, last, _BANDS_AT_ONCE):  # GDAL copies what it gets
                end = min(start + _BANDS_AT_ONCE, last)
                values = np.ascontiguousarray(np.moveaxis(block[..., start - first : end - first], -1, 0))
                raster.write(values, indexes=list(range(start + 1, end + 1)), window=window)
            done += block.size
            if progress is not None:
                progress(done, stored.size)
        return np.zeros((1,) * block.ndim, np.uint8)

    writes = array.map_blocks(
        write,
        dtype=np.uint8,
        chunks=tuple((1,) * count for count in array.numblocks),
        meta=np.empty((0,) * array.ndim, np.uint8),
        name=f"write-{uuid.uuid4().hex}",
    )
    axis = 0 if array.numblocks[0] >= array.numblocks[1] else 1
    stages = {(writes.name, *index): index[axis] for index in np.ndindex(writes.numblocks)}
    graph = dict(writes.__dask_optimize__(writes.__dask_graph__(), list(stages)))
    with rasterio.open(path, "w", **profile) as raster:
        raster.colorinterp = [rasterio.enums.ColorInterp[colour] for colour in colours]
        for number, (name, band_tags) in enumerate(bands, start=1):
            raster.set_band_description(number, name)
            raster.update_tags(number, **band_tags)
        for _ in in_stages(dask.threaded.get, graph, stages):
            pass
