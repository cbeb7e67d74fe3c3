"""Height rasters, read by GDAL: few drivers, a single file, no network, only the needed window.

GDAL decides by content: text inside a ``.tif`` may be a virtual raster that names other files and URLs, files
beside it are opened with it, and a tag may name a file of overviews. Only the ``.prj`` of an ASCII grid,
which holds its crs, is read besides.
"""

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

MAX_RASTER_BYTES = 2**40
MAX_PRJ_BYTES = 2**16
MAX_AUX_BYTES = 2**20

# Maximum number of cells of a raster that is read completely; from a larger raster, a window is read.
MAX_WHOLE_CELLS = 2**24

# Maximum number of cells of a window: half a gigabyte with all derived arrays.
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
    with open_input(path, "a raster", MAX_RASTER_BYTES) as file:
        first_bytes, full_path = file.read(64).lstrip(), os.path.abspath(path)
    driver = next((name for magic, name in _DRIVERS if first_bytes.startswith(magic)), "")
    driver = driver or ("AAIGrid" if first_bytes.lower().startswith(_GRID_KEYWORDS) else "")
    driver = driver or ("SRTMHGT" if full_path.lower().endswith(".hgt") else "")
    FormatError.raise_if(
        not driver,
        f"{path}: not a TIFF, ASCII grid, SRTM .hgt or DTED, in spite of its name",
        mend="convert other rasters to GeoTIFF with gdal_translate",
        code="format-unknown",
    )
    for prj in (os.path.splitext(full_path)[0] + suffix for suffix in (".prj", ".PRJ")):
        if driver == "AAIGrid" and os.path.lexists(prj):
            open_input(prj, "the crs of an ASCII grid", MAX_PRJ_BYTES).close()
    with needs_extra("rasterio", "geo", purpose):
        import rasterio
        from rasterio._err import CPLE_BaseError
        from rasterio.errors import CRSError
    try:
        with warnings.catch_warnings(), rasterio.Env(**_ENVIRONMENT):
            warnings.simplefilter("ignore")  # rasterio warns of files without position
            with rasterio.open(full_path, driver=driver, sharing=False) as raster:
                FormatError.raise_if(
                    raster.tags(ns="OVERVIEWS"),
                    f"{path} names another file for its overviews",
                    mend="convert it with gdal_translate",
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
    # Return a height raster (y, x); from a large raster, the window around a flight.
    # path: A GeoTIFF, a grid of text (``.asc``), SRTM (``.hgt``) or DTED. around: Longitudes, latitudes
    # [degree] and heights [m] of the flight, (time,) each: a raster of more than `MAX_WHOLE_CELLS` cells is
    # read only within four times the flight height above ground.
    # Returns float32, or float64 where float32 is too narrow: NaN in holes, scale and offset of the file
    # applied, with coordinates of the cells' centres and `spatial_ref`. Raises FormatError: As `open_raster`;
    # it has several bands, is rotated, lacks crs, transform or metadata in a file beside it, has blocks over
    # `MAX_BLOCK_BYTES`, or needs a window of too many cells. Raises SchemaError: It is large, and the
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
        aux = head_of(f"{full_path}.aux.xml", MAX_AUX_BYTES)
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
                block_bytes > MAX_BLOCK_BYTES,
                f": blocks of {block_rows} x {block_columns} cells, {block_bytes} bytes, read completely for "
                "each cell",
                f"at most {MAX_BLOCK_BYTES}",
                "gdal_translate -co TILED=YES in.tif out.tif",
                "file-too-large",
            ),
        ):
            FormatError.raise_if(is_wrong, f"{path}{found}", expected=expected, mend=mend, code=code)
        is_large = raster.height * raster.width > MAX_WHOLE_CELLS
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
    coords = {
        # half a cell is added to the corner first, like in rioxarray: the same bits
        "x": ("x", np.arange(*columns) * a + (a * 0.5 + b * 0.5 + c)),
        "y": ("y", np.arange(*rows) * e + (d * 0.5 + e * 0.5 + f)),
        "spatial_ref": ((), 0, attrs),
    }
    return xr.DataArray(values, coords, ("y", "x"), attrs=declared)


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


# Cells are read up to this distance from the flight [heights above ground]: 76 degrees off nadir.
_WINDOW_HEIGHTS = 4.0
# Additional border on each side [cell].
_BORDER_CELLS = 64
_TRACK_POINTS = 257


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
    if raster.crs is None:
        raise FormatError(
            f"{subject}, and no crs to find the flight in it",
            mend="declare it with gdal_edit -a_srs",
            code="crs-missing",
        )
    longitude, latitude, _ = points[:, :: max(1, points.shape[1] // _TRACK_POINTS)]
    try:
        x, y = (
            np.asarray(coordinate) for coordinate in transform("EPSG:4326", raster.crs, longitude, latitude)
        )
    except (CPLE_BaseError, CRSError, RasterioError) as error:
        raise FormatError(
            f"{subject}, and positions cannot be converted to its crs ({error!s:.200})",
            mend="declare the right one with gdal_edit -a_srs",
            code="crs-unknown",
        ) from error
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
    reach = _WINDOW_HEIGHTS * height_above_ground * units_per_metre
    longitude_factor = (
        1.0 if raster.crs.is_projected else 1.0 / max(float(np.cos(np.radians(latitude)).min()), 0.01)
    )
    ranges = []
    for values, size, cells in (
        (row, raster.height, reach / abs(raster.transform.e)),
        (column, raster.width, reach * longitude_factor / abs(raster.transform.a)),
    ):
        first = max(int(values.min() - cells) - _BORDER_CELLS, 0)
        ranges.append((first, min(int(values.max() + cells) + _BORDER_CELLS + 1, size)))
    (top, bottom), (left, right) = ranges
    FormatError.raise_if(
        (bottom - top) * (right - left) > MAX_WINDOW_CELLS,
        f"{subject}, {bottom - top} x {right - left} of them around this flight",
        expected=f"at most {MAX_WINDOW_CELLS} in all",
        mend="resample it with gdalwarp -tr",
        code="file-too-large",
    )
    return ranges[0], ranges[1]
