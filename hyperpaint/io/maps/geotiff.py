"""Writing of maps as GeoTIFF and in other formats of GDAL: all bands, or a picture in true colours.

Windows are written one row of tiles at a time; GDAL then streams the plain file into the final format.
"""

import os
import threading
import uuid
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from hyperpaint.base.errors import FormatError, SchemaError, needs_extra
from hyperpaint.base.facts import documented, takes_quantities
from hyperpaint.base.input_files import open_input
from hyperpaint.base.schema import BAND
from hyperpaint.io.files.publishing import published_files, unwritable
from hyperpaint.io.store.computing import in_stages

from .map_grids import (
    RASTER_FORMATS,
    RGB_WAVELENGTHS,
    TILE,
    Grid,
    nearest_bands,
    product_of,
    required_grid,
    storable,
)
from .rasters import TIFF, open_raster

# Number of rows from which the brightness range of a picture is computed.
_SAMPLED_ROWS = 64
_BLOCK_BYTES = 64 * 2**20
_RGB = ("red", "green", "blue")
# GDAL's default, 5 % of the machine's memory, would fill with bands that are written once. Rasterio takes
# bytes, where GDAL itself takes small numbers as megabytes.
CACHE_BYTES = 256 * 2**20


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
    path = Path(path)
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

    def save_picture(linear: xr.DataArray, plain: Path, bands: list[tuple[str, dict[str, str]]]) -> None:
        _write(plain, _picture(linear, stretch), grid, [*_RGB, "alpha"], [*bands, ("alpha", {})], progress)

    try:
        with rasterio.Env(GDAL_CACHEMAX=CACHE_BYTES):
            if is_picture:
                save_picture(array, uncompressed, described)
            else:
                _write(uncompressed, storable(array), grid, colours, described, progress)
            if picture is not None and nearest is not None:
                plain = picture.with_name(f"plain-{picture.name}")
                save_picture(_bands_in(uncompressed, nearest), plain, [described[band] for band in nearest])
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
        grid = Grid(raster.transform.to_gdal(), wkt) if is_placed else None
        return GeotiffHeader(
            raster.shape,
            raster.count,
            raster.dtypes[0],
            grid,
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
        nearest = nearest_bands(map["wavelength"].values, RGB_WAVELENGTHS) if has_axis else None
        if nearest is None:
            raise SchemaError(
                "a picture needs bands within 50 nm of 640, 550 and 460 nm",
                mend="choose bands by their indices",
                code="band-missing",
            )
        return nearest
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
    chunks = (rows, (width,), (len(bands),))
    return xr.DataArray(
        da.map_blocks(read, chunks=chunks, dtype=dtype, name=f"read-{uuid.uuid4().hex}"),
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
        "crs": None if grid.wkt is None else rasterio.crs.CRS.from_wkt(grid.wkt),
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
            raster.write(
                np.ascontiguousarray(np.moveaxis(block, -1, 0)),
                indexes=list(range(first + 1, last + 1)),
                window=window,
            )
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
