"""Writing of ENVI cubes: a flight line, or a georeferenced map.

The data file is filled block by block as dask computes them, so that a cube of any length needs the memory of
a few blocks. Header and data are published together, the header last.
"""

import errno
import os
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from hyperpaint.base import BAND, SchemaError, documented, one_of, takes_quantities
from hyperpaint.io.files.publishing import published_files
from hyperpaint.io.maps.map_grids import (
    RGB_WAVELENGTHS,
    Grid,
    envi_map_info,
    grid_of,
    nearest_bands,
    product_of,
    storable,
)

from .envi_cubes import DTYPES, FILE_AXES, braced

Interleave = Literal["bil", "bip", "bsq"]

_DATA_SUFFIXES = (".img", ".dat", ".raw", ".bil", ".bip", ".bsq")
_CODES = {np.dtype(name).name: code for code, name in DTYPES.items()}
_SCALE = 10_000
_IGNORE = 65_535
# Size of the pieces in which an array in memory is written [byte].
_BLOCK_BYTES = 64 * 2**20


@takes_quantities()
@documented()
def write_envi(
    dataset: xr.Dataset,
    path: str | os.PathLike[str],
    *,
    variable: str | None = None,
    interleave: Interleave | None = None,
    dtype: Literal["float32", "uint16"] | None = None,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Write a cube of a flight line or of a map as ENVI.

    Parameters
    ----------
    dataset
        A flight line, (along_track, band, cross_track), or a map, (y, x, band), in any order of dims; or a
        plane, (along_track, cross_track) or (y, x). The position of a map comes from ``spatial_ref`` with
        ``GeoTransform`` (which may be rotated), or from ``x`` and ``y``.
    path
        The data file or the header; without a known suffix, ``.img`` is added.
    variable
    interleave
        By default ``"bil"`` for flight lines and ``"bip"`` for maps, the order of computation.
    dtype
        ``"float32"``; or ``"uint16"``, for reflectance times 10,000 (clipped to 0 to 6.5534), unknown
        samples 65535. By default floats are float32 (positions such as ``east`` and ``glt_line`` float64),
        and integers keep their type.
    overwrite
    progress

    Returns
    -------
    pathlib.Path
        The header.

    Raises
    ------
    SchemaError
        The variable is missing, its dims or type are wrong, or ENVI cannot describe its grid; all are
        listed.
    StoreError
        A file exists, or cannot be written. An existing file stays.
    MissingExtraError
        The map has a reference system, and pyproj is not installed.

    Notes
    -----
    ENVI describes rotated grids of square pixels. A grid whose rows count in the other direction (a
    mirrored one) is written from its last row on. `open_envi` reads float32 and integers back bit for bit.

    Examples
    --------
    >>> import tempfile, xarray as xr
    >>> from hyperpaint.io.envi.envi_cubes import open_envi
    >>> scratch = tempfile.TemporaryDirectory()
    >>> cube = xr.DataArray(np.ones((2, 3, 4), "f4"), dims=("along_track", "band", "cross_track"))
    >>> line = cube.assign_attrs(units="1").to_dataset(name="reflectance")
    >>> header = write_envi(line, Path(scratch.name) / "line")
    >>> header.name, dict(open_envi(header).sizes)
    ('line.hdr', {'along_track': 2, 'band': 3, 'cross_track': 4})
    >>> scratch.cleanup()
    """
    cube = _stored_cube(dataset, variable, dtype)
    grid = grid_of(dataset) if "y" in cube.dims else None
    if grid is not None and grid.mirrored:
        cube, grid = cube.isel(y=slice(None, None, -1)), grid.flipped(cube.sizes["y"])
    order = interleave or ("bil" if grid is None and "y" not in cube.dims else "bip")
    one_of(order, FILE_AXES, "interleave")
    stored = cube.transpose(*[dict(zip("lsb", cube.dims, strict=True))[axis] for axis in FILE_AXES[order]])
    header = _header(dataset, cube, order, grid)
    # names of data file and header
    data_path = header_path = Path(path)
    if data_path.suffix.lower() == ".hdr":
        data_path = header_path.with_suffix(".img")
    elif data_path.suffix.lower() in _DATA_SUFFIXES:
        header_path = data_path.with_suffix(".hdr")
    else:
        data_path, header_path = (data_path.with_name(data_path.name + suffix) for suffix in (".img", ".hdr"))
    with published_files([data_path, header_path], overwrite=overwrite) as (data_file, header_file):
        _fill_file(data_file, stored, progress)
        header_file.write_bytes(header.encode())
    return header_path


# --- array and header --------------------------------------------------------------------------------------


def _stored_cube(dataset: xr.Dataset, variable: str | None, dtype: str | None) -> xr.DataArray:
    # Return the array (line, sample, band) in its stored dtype, still lazy.
    cube = product_of(dataset, variable)
    name = str(cube.name)
    if dtype is not None:
        one_of(str(dtype), ("float32", "uint16"), "dtype")
    if dtype == "uint16" and cube.dtype.kind == "f":
        SchemaError.raise_if(
            name != "reflectance",
            f"{name!r} is {cube.dtype}",
            expected="reflectance, the only variable of floats that is written as uint16",
            mend="pass dtype='float32'",
            code="type-wrong",
        )
        scaled = (cube * np.float32(_SCALE)).round().clip(0, _IGNORE - 1).fillna(_IGNORE)
        return scaled.astype(np.uint16).assign_attrs(cube.attrs)
    return cube.astype(np.float32, copy=False) if dtype == "float32" else storable(cube)


def _header(dataset: xr.Dataset, cube: xr.DataArray, interleave: str, grid: Grid | None) -> str:
    lines, samples, bands = cube.shape
    name = str(cube.name)
    is_scaled = name == "reflectance" and cube.dtype.kind == "u"
    title = _printable(str(dataset.attrs.get("title") or dataset.attrs.get("source") or "hyperpaint"))
    # readers take the last processing level in a description as the quantity
    quantity_text = f", {name.upper()}" if name in ("radiance", "reflectance") else f", {name}"
    units = cube.attrs.get("units")
    ignore = "nan" if cube.dtype.kind == "f" else cube.attrs.get("data_ignore_value")
    # keys and values in the order of the header; those of None are left out
    fields: dict[str, Any] = {
        "description": f"{{{title}{quantity_text}}}",
        "samples": samples,
        "lines": lines,
        "bands": bands,
        "header offset": 0,
        "file type": "ENVI Standard",
        "data type": _CODES[cube.dtype.name],
        "interleave": interleave,
        "byte order": 0,
        ";Units": _printable(str(units)) if units else None,
        "reflectance scale factor": _SCALE if is_scaled else None,
        "data ignore value": _IGNORE if is_scaled else ignore,
    }
    axis = dataset.variables.get("wavelength")
    if BAND not in dataset[name].dims:
        fields["band names"] = f"{{{_printable(name)}}}"
    elif axis is not None and axis.dims == (BAND,):
        # lists of the bands, where all of their values are finite
        for key, variable_name, kind in (
            ("wavelength", "wavelength", np.float64),
            ("fwhm", "fwhm", np.float64),
            ("bbl", "good", int),
        ):
            variable = dataset.variables.get(variable_name)
            if variable is None or variable.dims != (BAND,) or not np.isfinite(variable.values).all():
                continue
            values = variable.values.astype(np.float64)
            if key == "wavelength":
                fields["wavelength units"] = "Nanometers"
            fields[key] = braced(list(map(repr, variable.values.astype(kind).tolist())))
            if key == "wavelength" and (rgb_bands := nearest_bands(values, RGB_WAVELENGTHS)) is not None:
                fields["default bands"] = f"{{{', '.join(str(band + 1) for band in rgb_bands)}}}"
    if grid is not None:
        fields |= {key: f"{{{value}}}" for key, value in envi_map_info(grid).items()}
    return "\n".join(
        ["ENVI", *(f"{key} = {value}" for key, value in fields.items() if value is not None), ""]
    )


def _printable(text: str) -> str:
    # Return text without braces and line ends.
    return "".join(mark if mark.isprintable() and mark not in "{}" else " " for mark in text)[:500]


# --- the data file -----------------------------------------------------------------------------------------


@dataclass(eq=False)
class _Target:
    # File to which blocks of an array are written at their positions, by any thread, in any order.
    # Blocks go through `os.pwrite`: a memory map would hold written pages in memory.
    path: str
    shape: tuple[int, int, int]
    dtype: np.dtype[Any]
    progress: Callable[[int, int], None] | None = None
    done: int = 0
    lock: Any = field(default_factory=threading.Lock)

    def __getstate__(self) -> dict[str, Any]:
        # progress is not reported from another machine
        return {**self.__dict__, "progress": None, "lock": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, lock=threading.Lock())

    def __setitem__(self, region: tuple[slice, slice, slice], block: NDArray[Any]) -> None:
        block = np.ascontiguousarray(block, self.dtype.newbyteorder("<"))
        starts = [part.indices(size)[0] for part, size in zip(region, self.shape, strict=True)]
        _, rows, columns = self.shape
        has_full_rows = block.shape[2] == columns
        descriptor = os.open(self.path, os.O_WRONLY)
        try:
            for plane in range(block.shape[0]):
                first = ((starts[0] + plane) * rows + starts[1]) * columns + starts[2]
                for row, piece in enumerate([block[plane]] if has_full_rows else block[plane]):
                    view = piece.reshape(-1).view(np.uint8).data
                    offset = (first + row * columns) * self.dtype.itemsize
                    while len(view):
                        count = os.pwrite(descriptor, view, offset)
                        view, offset = view[count:], offset + count
            if block.shape[1:] == self.shape[1:] and hasattr(os, "posix_fadvise"):
                # Linux starts to write these pages, so that the final flush is short
                first_byte, size = starts[0] * rows * columns * self.dtype.itemsize, block.nbytes
                os.posix_fadvise(descriptor, first_byte, size, os.POSIX_FADV_DONTNEED)
        finally:
            os.close(descriptor)
        with self.lock:
            self.done += block.size
            if self.progress is not None:
                self.progress(self.done, int(np.prod(self.shape)))


def _fill_file(path: Path, stored: xr.DataArray, progress: Callable[[int, int], None] | None) -> None:
    # Write an array in the order of its dims.
    shape = (stored.shape[0], stored.shape[1], stored.shape[2])
    with open(path, "wb") as file:
        size = stored.size * stored.dtype.itemsize
        file.truncate(size)
        if size and hasattr(os, "posix_fallocate"):
            try:
                os.posix_fallocate(file.fileno(), 0, size)
            except OSError as error:
                # a full disk is reported before anything is computed; some file systems do not support this
                if error.errno == errno.ENOSPC:
                    raise
    target = _Target(os.path.abspath(path), shape, stored.dtype, progress)
    if stored.chunks is not None:
        import dask.array as da

        da.store(stored.data, target, lock=False)
        return
    step = max(1, _BLOCK_BYTES // max(1, int(np.prod(shape[1:])) * stored.dtype.itemsize))
    for first in range(0, shape[0], step):
        part = slice(first, min(first + step, shape[0]))
        target[part, slice(None), slice(None)] = stored[part].values
