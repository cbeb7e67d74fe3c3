"""Rasters of heights, read by GDAL: few drivers, one file, no network, only the needed window.

GDAL decides by content: text inside a ``.tif`` may be a virtual raster that names other files and URLs, files
beside it are opened with it, and a tag may name a file of overviews. Only the ``.prj`` of an ASCII grid,
which holds its crs, is read besides.
"""

from __future__ import annotations

import contextlib
import os
import warnings
from collections.abc import Iterator
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base.errors import FormatError, SchemaError, needs_extra
from hyperpaint.base.input_files import head_of, open_input
from hyperpaint.io.files.reading import number

TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
#: First bytes of files, and the driver that opens them; all are single-file formats.
_DRIVERS = ((TIFF, "GTiff"), ((b"UHL1", b"HDR1", b"VOL1"), "DTED"))
#: First words of the header of an ASCII grid, in either case.
_GRID = (
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

MAX_RASTER_BYTES = 2**40
MAX_PRJ_BYTES = 2**16
MAX_AUX_BYTES = 2**20

# Most cells of a raster that is read completely; of a larger one a window is read.
MAX_WHOLE_CELLS = 2**24

# Most cells of a window: half a gigabyte with all derived arrays.
MAX_WINDOW_CELLS = 2**25

# Largest block, tile or strip, which GDAL decodes completely even for one cell [byte].
MAX_BLOCK_BYTES = 2**27

#: No files beside the raster are searched, and no URLs are fetched.
_ENVIRONMENT = {
    "GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR",
    "GDAL_PAM_ENABLED": "NO",
    "CPL_VSIL_CURL_ALLOWED_EXTENSIONS": ".none",
    "GDAL_HTTP_MAX_RETRY": "0",
    "VRT_VIRTUAL_OVERVIEWS": "NO",
    "GDAL_CACHEMAX": 64,  # megabytes, not a share of the memory
}


@contextlib.contextmanager
def open_raster(path: str | os.PathLike[str], purpose: str) -> Iterator[Any]:
    """Yield a raster opened by rasterio; ``purpose`` names the operation that needs rasterio.

    Of files beside it only the ``.prj`` of an ASCII grid is read.

    Raises `FormatError`: It is no plain file, no raster of these kinds, damaged, or names other files; or its
    ``.prj`` is no plain file, or of over 64 KiB.
    Raises `MissingExtraError`: rasterio is not installed.
    """
    with open_input(path, "a raster", MAX_RASTER_BYTES) as file:
        head, place = file.read(64).lstrip(), os.path.abspath(path)
    driver = next((name for heads, name in _DRIVERS if head.startswith(heads)), "")
    driver = driver or ("AAIGrid" if head.lower().startswith(_GRID) else "")
    driver = driver or ("SRTMHGT" if place.lower().endswith(".hgt") else "")
    if not driver:
        raise FormatError(
            f"{path}: no TIFF, ASCII grid, SRTM .hgt or DTED, whatever its name says",
            mend="convert other rasters to GeoTIFF with gdal_translate",
            code="format-unknown",
        )
    for prj in (os.path.splitext(place)[0] + suffix for suffix in (".prj", ".PRJ")):
        if driver == "AAIGrid" and os.path.lexists(prj):
            open_input(prj, "the crs of an ASCII grid", MAX_PRJ_BYTES).close()
    with needs_extra("rasterio", "geo", purpose):
        import rasterio
        from rasterio._err import CPLE_BaseError
        from rasterio.errors import CRSError
    try:
        with warnings.catch_warnings(), rasterio.Env(**_ENVIRONMENT):
            warnings.simplefilter("ignore")  # about a file without position
            with rasterio.open(place, driver=driver, sharing=False) as raster:
                if raster.tags(ns="OVERVIEWS"):
                    raise FormatError(
                        f"{path} names another file for its overviews",
                        mend="translate it anew with gdal_translate",
                        code="file-not-alone",
                    )
                yield raster
    except (rasterio.errors.RasterioError, CRSError, CPLE_BaseError, UnicodeDecodeError) as error:
        raise FormatError(
            f"{path}: GDAL cannot read it as {driver} ({error!s:.200})",
            mend="copy it again",
            code="raster-damaged",
        ) from error


def read_heights(path: str | os.PathLike[str], around: tuple[Any, Any, Any] | None = None) -> xr.DataArray:
    """Return a raster of heights (y, x), of a large one the window around a flight.

    path: A GeoTIFF, a grid of text (``.asc``), SRTM (``.hgt``) or DTED.
    around: Longitudes, latitudes [degree] and heights [m] of the flight, (time,) each: a raster of more
        than `MAX_WHOLE_CELLS` cells is read only within four times the flight height above ground.

    Returns float32, or float64 where float32 is too narrow: NaN in holes, scale and offset of the file
    applied, with coordinates of the cells' centres and `spatial_ref`.
    Raises FormatError: As `open_raster`; it has several bands, is rotated, lacks crs, transform or
        metadata in a file beside it, has blocks over `MAX_BLOCK_BYTES`, or needs a window of too many cells.
    Raises SchemaError: It is large, and the position of the flight is unknown.
    """
    with open_raster(path, "opening a DEM") as raster:
        if raster.count != 1:
            raise FormatError(
                f"{path}: {raster.count} bands",
                expected="one of heights",
                mend="extract that band with gdal_translate -b",
                code="band-count",
            )
        a, b, c, d, e, f = tuple(raster.transform)[:6]
        if b or d or not a or not e:
            raise FormatError(
                f"{path}: its rows do not run east, by its transform {(a, b, c, d, e, f)}",
                expected="north up",
                mend="gdalwarp in.tif out.tif",
                code="grid-rotated",
            )
        _check_alone(raster, path)
        high, wide = raster.block_shapes[0]
        block = high * wide * np.dtype(raster.dtypes[0]).itemsize
        if block > MAX_BLOCK_BYTES:
            raise FormatError(
                f"{path}: blocks of {high} x {wide} cells, {block} bytes, read whole for one cell",
                expected=f"at most {MAX_BLOCK_BYTES}",
                mend="gdal_translate -co TILED=YES in.tif out.tif",
                code="file-too-large",
            )
        rows, columns = (0, raster.height), (0, raster.width)
        if raster.height * raster.width > MAX_WHOLE_CELLS:
            rows, columns = _window(raster, path, around)
        values = _cells(raster, rows, columns)
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
    coords = {
        # half a cell is added to the corner first, like in rioxarray: the same bits
        "x": ("x", np.arange(*columns) * a + (a * 0.5 + b * 0.5 + c)),
        "y": ("y", np.arange(*rows) * e + (d * 0.5 + e * 0.5 + f)),
        "spatial_ref": ((), 0, attrs),
    }
    return xr.DataArray(values, coords, ("y", "x"), attrs=declared)


#: Elements of an ``.aux.xml`` that change heights or their positions.
_POSITION_ELEMENTS = {b"<NoDataValue": "a nodata", b"<GeoTransform": "a transform", b"<SRS": "a crs"}


def _check_alone(raster: Any, path: str | os.PathLike[str]) -> None:
    # Refuse a raster without a position, or with metadata in files beside it, which are not read.
    from rasterio.enums import MaskFlags

    place = os.path.abspath(path)
    stem = os.path.splitext(place)[0]
    is_masked = MaskFlags.per_dataset in raster.mask_flag_enums[0]
    lacks = {
        "a nodata": raster.nodata is None and not is_masked,
        "a transform": raster.transform.is_identity,
        "a crs": raster.crs is None,
    }
    aux = head_of(f"{place}.aux.xml", MAX_AUX_BYTES)
    beside = {
        item: f"{place}.aux.xml"
        for element, item in _POSITION_ELEMENTS.items()
        if lacks[item] and element in aux
    }
    for item, name in (
        ("a nodata", f"{place}.msk"),
        *(("a transform", stem + suffix) for suffix in (".tfw", ".TFW", ".tifw", ".tiffw", ".wld")),
        ("a transform", f"{place}w"),
        ("a crs", f"{stem}.prj"),
    ):
        if lacks[item] and os.path.exists(name):
            beside.setdefault(item, name)
    if beside:
        named = ", ".join(f"{item} in {os.path.basename(name)}" for item, name in beside.items())
        srs = f" -a_srs {os.path.basename(stem)}.prj" if beside.get("a crs", "").endswith(".prj") else ""
        raise FormatError(
            f"{path} is read alone, but other files hold part of it: {named}",
            mend=f"merge them: gdal_translate{srs} in.tif out.tif",
            code="file-not-alone",
        )
    missing = [item for item in ("a transform", "a crs") if lacks[item]]
    if missing:
        raise FormatError(
            f"{path} has no place without {' and '.join(missing)}",
            mend="set it with gdal_translate -a_srs EPSG:<code> -a_ullr <west north east south>",
            code="place-unknown",
        )
    if not np.isfinite(tuple(raster.transform)).all():
        raise FormatError(
            f"{path}: its transform is {tuple(raster.transform)[:6]}",
            expected="finite numbers",
            mend="set it with gdal_translate -a_ullr <west north east south>",
            code="not-finite",
        )


def _cells(raster: Any, rows: tuple[int, int], columns: tuple[int, int]) -> np.ndarray[Any, Any]:
    from rasterio.enums import MaskFlags
    from rasterio.windows import Window

    window = Window.from_slices(rows, columns)
    stored: np.ndarray[Any, Any] = raster.read(1, window=window)
    narrow = stored.dtype.itemsize <= 2 or stored.dtype == np.float32
    values = stored.astype(np.float32 if narrow else np.float64)
    if raster.nodata is not None:
        values[stored == raster.nodata] = np.nan
    # a mask inside the file; masks beside it are not opened
    if MaskFlags.per_dataset in raster.mask_flag_enums[0]:
        values[raster.read_masks(1, window=window) == 0] = np.nan
    # infinities, and signalling NaNs of a damaged file, which would warn in every sum
    values[~np.isfinite(values)] = np.nan
    scale, offset = raster.scales[0], raster.offsets[0]
    if not (np.isfinite(scale) and np.isfinite(offset) and scale != 0.0):
        raise FormatError(
            f"{raster.name}: scale {scale:g} and offset {offset:g}",
            expected="finite ones, no scale of 0",
            mend="set them with gdal_edit -a_scale 1 -a_offset 0",
            code="scale-wrong",
        )
    return values if (scale, offset) == (1.0, 0.0) else values * scale + offset


# Cells are read up to this distance from the flight, in heights above ground: 76 degrees off nadir.
_REACH = 4.0
# Additional border on each side [cell].
_BORDER = 64
_TRACK_POINTS = 257


def _window(
    raster: Any, path: str | os.PathLike[str], around: tuple[Any, Any, Any] | None
) -> tuple[tuple[int, int], tuple[int, int]]:
    # The rows and columns of a raster around a flight.
    from rasterio._err import CPLE_BaseError
    from rasterio.errors import CRSError, RasterioError
    from rasterio.warp import transform

    large = f"{path} has {raster.height} x {raster.width} cells"
    points = None if around is None else np.stack([np.asarray(values, np.float64) for values in around])
    points = None if points is None else points[:, np.isfinite(points).all(axis=0)]
    if points is None or not points.size:
        raise SchemaError(
            f"{large}, and the line has no positions to select a window by",
            mend="cut out the area of the flight",
            code="positions-missing",
        )
    if raster.crs is None:
        raise FormatError(
            f"{large}, and no crs to find the flight in it",
            mend="declare it with gdal_edit -a_srs",
            code="crs-missing",
        )
    longitude, latitude, _ = points[:, :: max(1, points.shape[1] // _TRACK_POINTS)]
    try:
        x, y = (np.asarray(each) for each in transform("EPSG:4326", raster.crs, longitude, latitude))
    except (CPLE_BaseError, CRSError, RasterioError) as error:
        raise FormatError(
            f"{large}, and positions cannot be converted to its crs ({error!s:.200})",
            mend="declare the right one with gdal_edit -a_srs",
            code="crs-unknown",
        ) from error
    column, row = ~raster.transform * (x, y)
    column, row = (each[np.isfinite(column) & np.isfinite(row)] for each in (column, row))
    inside = (row >= 0) & (row < raster.height) & (column >= 0) & (column < raster.width)
    if not inside.any():
        raise FormatError(
            f"{large}, and the flight is outside of it",
            mend="give the DEM of this place",
            code="flight-outside",
        )
    below = [
        float(_cells(raster, (int(r), int(r) + 1), (int(k), int(k) + 1))[0, 0])
        for r, k in zip(row[inside], column[inside], strict=True)
    ]
    heights = np.array(below)
    lowest = float(heights[np.isfinite(heights)].min(initial=np.inf))
    above = max(float(points[2].max()) - min(lowest, float(points[2].max())), 0.0)
    metre = 1.0 if raster.crs.is_projected else 1.0 / 111_000.0
    reach = _REACH * above * metre
    widen = 1.0 if raster.crs.is_projected else 1.0 / max(float(np.cos(np.radians(latitude)).min()), 0.01)
    sides = []
    for values, size, cells in (
        (row, raster.height, reach / abs(raster.transform.e)),
        (column, raster.width, reach * widen / abs(raster.transform.a)),
    ):
        first = max(int(values.min() - cells) - _BORDER, 0)
        sides.append((first, min(int(values.max() + cells) + _BORDER + 1, size)))
    (top, bottom), (left, right) = sides
    if (bottom - top) * (right - left) > MAX_WINDOW_CELLS:
        raise FormatError(
            f"{large}, {bottom - top} x {right - left} of them around this flight",
            expected=f"at most {MAX_WINDOW_CELLS} in all",
            mend="resample it with gdalwarp -tr",
            code="file-too-large",
        )
    return sides[0], sides[1]
