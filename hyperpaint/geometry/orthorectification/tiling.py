"""The dask graph of a map: one task per tile for positions in the line, and one per variable.

A task reads only the slabs of lines that cover its tile.
"""

from __future__ import annotations

import uuid
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import dask.array as da
import numpy as np
import xarray as xr
from dask.base import tokenize

from hyperpaint.base.arrays import Array
from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.schema import ALONG_TRACK, BAND, CROSS_TRACK, CUBE, Quality, label
from hyperpaint.radiometry.counts_to_reflectance import reflectance
from hyperpaint.radiometry.spectral_axis import to_nominal

from .grids import MapGrid, Place, tile_array
from .indexing import (
    Plan,
    Window,
    gaps_of,
    index_tile,
    map_spectra,
    nearest_values,
    plane_values,
    reading_of,
)


def tile_windows(shape: tuple[int, int], tile: int) -> list[list[Window]]:
    rows, cols = ([slice(k, min(k + tile, size)) for k in range(0, size, tile)] for size in shape)
    return [[(row, col) for col in cols] for row in rows]


@dataclass(frozen=True)
class Tiles:
    """The tiles of a map, and the slabs that each of them reads."""

    grid: MapGrid
    windows: list[list[Window]]  #: Cells of the tiles, by row and column
    slabs: dict[Place, list[int]]  #: Slabs of lines that each tile reads
    starts: tuple[int, ...]  #: First line of every slab
    #: The `TileIndex` of every tile, lazy, as an array with one object per tile, and its gaps (row, col)
    index: da.Array
    gap: da.Array
    #: The `Reading` of every tile: of the nearest pixels, and of the pixels before positions
    nearest: da.Array
    before: da.Array
    bilinear: bool  #: Whether values are interpolated

    @classmethod
    def of(
        cls,
        plan: Plan,
        windows: list[list[Window]],
        slabs: dict[Place, list[int]],
        places: Sequence[da.Array],
        *,
        bilinear: bool,
    ) -> Tiles:
        """Return tiles whose index follows from the places of pixels: see `index_tile`."""
        starts = tuple(np.cumsum((0, *places[0].chunks[0][:-1])).tolist())
        shared = {f"orthorectification-plan-{tokenize(plan)}": plan}
        key = next(iter(shared))
        tasks: dict[Place, Any] = {}
        for place, (rows, cols) in _tiles_of(windows):
            first = [starts[slab] for slab in slabs[place]]
            read = [[(of.name, slab, 0) for slab in slabs[place]] for of in places]
            tasks[place] = (index_tile, key, rows, cols, first, *read)
        single = ((1,) * len(windows), (1,) * len(windows[0]))
        index = tile_array("map-index", tasks, single, object, places, plan, shared)
        gaps = {p: (gaps_of, key, *window, (index.name, *p)) for p, window in _tiles_of(windows)}
        gap = tile_array("map-gap", gaps, _chunks(windows), np.bool_, [index], plan, shared)
        nearest, before = (
            tile_array(
                "map-reading",
                {place: (reading_of, (index.name, *place), between) for place, _ in _tiles_of(windows)},
                single,
                object,
                [index],
                between,
            )
            for between in (False, True)
        )
        return cls(plan.grid, windows, slabs, starts, index, gap, nearest, before, bilinear)

    def part(self, name: str, dtype: Any) -> da.Array:
        tasks = {place: (getattr, (self.index.name, *place), name) for place, _ in _tiles_of(self.windows)}
        return tile_array(f"map-{name}", tasks, _chunks(self.windows), dtype, [self.index])

    def cube(self, cube: da.Array, empty: Any) -> da.Array:
        """Return spectra (row, col, band) of a cube (line, band, column) in chunks of the slabs.

        They have the type of ``empty``.
        """
        reading = self.before if self.bilinear else self.nearest
        return self._tile_array("map-cube", map_spectra, reading, cube, (empty,), cube.shape[1:2])

    def plane(self, plane: da.Array, kind: str, empty: Any) -> da.Array:
        """Return values (row, col) of a plane (line, column) in chunks of the slabs.

        Where spectra are interpolated, ``kind`` is ``"bilinear"``, ``"nearest"``, or ``"flags"``, which
        joins the bits of all pixels.
        """
        reading = self.nearest if kind == "nearest" or not self.bilinear else self.before
        return self._tile_array("map-plane", plane_values, reading, plane, (kind == "flags", empty))

    def row_or_column(self, values: da.Array, of_lines: bool, empty: Any) -> da.Array:
        """Return values (row, col) from one value per line, or per column, in one chunk."""
        return self._tile_array("map-nearest", nearest_values, self.index, values, (of_lines, empty))

    def centres(self) -> tuple[da.Array, da.Array]:
        east, north = (
            tile_array(
                f"map-{name}",
                {place: (_centres, self.grid, *window, part) for place, window in _tiles_of(self.windows)},
                _chunks(self.windows),
                np.float64,
                [],
                (self.grid,),
            )
            for part, name in enumerate(("east", "north"))
        )
        return east, north

    def _tile_array(
        self,
        label: str,
        function: Callable[..., Array],
        index_array: da.Array,
        source: da.Array,
        options: tuple[Any, ...],
        bands: tuple[int, ...] = (),
    ) -> da.Array:
        # ``function`` computes the tiles from positions, source blocks and options
        tasks: dict[tuple[int, ...], Any] = {}
        dtype = np.asarray(options[-1]).dtype
        for place, (rows, cols) in _tiles_of(self.windows):
            needed = self.slabs[place]
            key = (*place, *(0 for _ in bands))
            if not needed:
                shape = [rows.stop - rows.start, cols.stop - cols.start, *bands]
                tasks[key] = (np.full, shape, options[-1], dtype)
                continue
            inputs: list[Any] = [(source.name, 0)]
            if source.ndim > 1:
                blocks = [(source.name, slab, *(0,) * (source.ndim - 1)) for slab in needed]
                inputs = [[self.starts[slab] for slab in needed], blocks]
            tasks[key] = (function, (index_array.name, *place), *inputs, *options)
        chunks = (*_chunks(self.windows), *((size,) for size in bands))
        return tile_array(label, tasks, chunks, dtype, [index_array, source], options)


def _chunks(windows: list[list[Window]]) -> tuple[tuple[int, ...], ...]:
    rows = tuple(row[0][0].stop - row[0][0].start for row in windows)
    return rows, tuple(window[1].stop - window[1].start for window in windows[0])


def _tiles_of(windows: list[list[Window]]) -> Iterator[tuple[Place, Window]]:
    return (((row, col), window) for row, part in enumerate(windows) for col, window in enumerate(part))


def _centres(grid: MapGrid, rows: slice, cols: slice, part: int) -> Array:
    return grid.centres(rows, cols)[part]


# --- variables of the map, and values of empty cells ---------------------------------------------------


_PRODUCTS = ("reflectance", "radiance")
_BY_DEFAULT = ("quality", "time", "irradiance_age", "view_zenith", "view_azimuth", "ground_height")
_RENAMED = {"time": "line_time"}
# angles that wrap at 360 or 180 degrees and cannot be interpolated
_WRAPPING = ("view_azimuth", "sun_azimuth", "heading", "longitude")
_PIXEL = (ALONG_TRACK, CROSS_TRACK)


def prepared(line: xr.Dataset, variables: Iterable[str] | None) -> tuple[xr.Dataset, list[str]]:
    """Return a line with spectra at nominal wavelengths, and the names of the variables to map.

    By default reflectance, else radiance; from counts alone reflectance is computed.

    Raises
    ------
    SchemaError
        Variables that are missing, of dims that a map lacks, or of types other than numbers,
        flags and times; all are listed. Or reflectance is missing and cannot be computed.
    UnitsError
        As `hyperpaint.reflectance`.
    """
    if isinstance(variables, str):
        variables = (variables,)
    if variables is None:
        product = [name for name in _PRODUCTS if name in line.variables][:1]
        if not product and "counts" in line.variables:
            line, product = reflectance(line), ["reflectance"]
        names = [*product, *(name for name in _BY_DEFAULT if name in line.variables)]
    else:
        names = list(dict.fromkeys(variables))
    problems = Problems("these variables cannot be mapped", SchemaError)
    for name in names:
        if name not in line.variables:
            names_of_line = ", ".join(sorted(map(str, line.variables)))
            problems.add(f"{name!r} is missing", expected=f"{names_of_line:.400}", code="variable-missing")
        elif set(line[name].dims) not in ({*CUBE}, {*_PIXEL}, {ALONG_TRACK}, {CROSS_TRACK}):
            dims = ", ".join(map(str, line[name].dims)) or "a scalar"
            problems.add(
                f"{name!r} ({dims}) cannot be mapped",
                expected="along_track or cross_track",
                code="dim-missing",
            )
        elif _native(line[name].dtype) is None or (BAND in line[name].dims and line[name].dtype.kind == "M"):
            expected = "numbers" if BAND in line[name].dims else "numbers, flags or times"
            problems.add(f"{name!r} is {line[name].dtype}", expected=f"{expected}", code="type-wrong")
    problems.raise_if_any()
    # compare .str: numpy treats types of either byte order as equal
    native = {name: _native(line[name].dtype) for name in names}
    converted = {
        name: line[name].astype(dtype)
        for name, dtype in native.items()
        if dtype is not None and dtype.str != line[name].dtype.str
    }
    coords = {name: converted.pop(name) for name in native if name in line.coords and name in converted}
    line = line.assign(converted).assign_coords(coords)
    spectra = [name for name in names if name in _PRODUCTS]
    if spectra and "wavelength_shift" in line.variables:
        line = line.assign({name: to_nominal(line)[name] for name in spectra})
    return line, names


def _native(dtype: np.dtype[Any]) -> np.dtype[Any] | None:
    # Return the dtype in native byte order, with half floats as float32; None for unsupported types.
    if dtype.kind == "f":
        return np.dtype(np.float64 if dtype.itemsize > 4 else np.float32)
    return dtype.newbyteorder("=") if dtype.kind in "biuM" else None


def empty_value(name: str, dtype: np.dtype[Any]) -> Any:
    """Return the value of an uncovered cell.

    NaN or NaT; ``off_swath`` for ``quality``; for integers -1, or the largest of an unsigned type.
    """
    if name == "quality":
        return np.uint16(Quality.OFF_SWATH)
    if dtype.kind == "M":
        return np.datetime64("NaT", "ns")
    if dtype.kind == "f":
        return dtype.type(np.nan)
    if dtype.kind == "b":
        return np.bool_(False)
    return dtype.type(-1) if dtype.kind == "i" else dtype.type(np.iinfo(dtype).max)


def mapped(line: xr.Dataset, names: Sequence[str], tiles: Tiles, lines: tuple[int, ...]) -> dict[str, Any]:
    """Return the variables of a `prepared` line on a map, by new name; ``lines`` is the number per slab."""
    variables = {}
    for name in names:
        source = line[name]
        if BAND in source.dims:
            is_mixed = tiles.bilinear and source.dtype.kind != "f"
            empty = empty_value(name, np.dtype(np.float32) if is_mixed else source.dtype)
            values = tiles.cube(in_slabs(source.transpose(*CUBE), lines), empty)
        else:
            source = source.astype("datetime64[ns]") if source.dtype.kind == "M" else source
            empty = empty_value(name, source.dtype)
            kind = "bilinear" if source.dtype.kind == "f" and name not in _WRAPPING else "nearest"
            if "flag_masks" in source.attrs or name == "quality":
                kind = "flags"
            values = (
                tiles.plane(in_slabs(source.transpose(*_PIXEL), lines), kind, empty)
                if source.ndim == 2
                else tiles.row_or_column(
                    source.chunk({source.dims[0]: -1}).data, source.dims == (ALONG_TRACK,), empty
                )
            )
        attrs = {key: value for key, value in line[name].attrs.items() if key != "grid_mapping"}
        attrs["grid_mapping"] = "spatial_ref"
        array = xr.DataArray(values, dims=("y", "x", BAND)[: values.ndim], attrs=attrs)
        if name == "quality":
            array = label(array, name, **attrs)
        elif values.dtype.kind in "iu":
            array.attrs["empty_value"] = empty_value(name, values.dtype)
        variables[_RENAMED.get(name, name)] = array
    return variables


class _InMemory:
    # Wrapper of an array that dask neither copies nor hashes.
    def __init__(self, array: Array) -> None:
        self._array = array
        self.shape, self.dtype, self.ndim = array.shape, array.dtype, array.ndim

    def __getitem__(self, key: Any) -> Any:
        return self._array[key]


def in_slabs(array: xr.DataArray, lines: tuple[int, ...]) -> da.Array:
    chunks: dict[Any, Any] = {dim: lines if dim == ALONG_TRACK else -1 for dim in array.dims}
    values = array.variable._data
    if not isinstance(values, np.ndarray):
        lazy: da.Array = array.chunk(chunks).data
        return lazy
    return in_memory(values, f"in-memory-{uuid.uuid4().hex}", tuple(chunks.values()))


def in_memory(values: Array, name: str, chunks: tuple[Any, ...]) -> da.Array:
    """Return an array in memory as a dask array, whose chunks are views of it."""
    meta = np.empty((0,) * values.ndim, values.dtype)
    return da.from_array(_InMemory(values), chunks, name, asarray=False, meta=meta)
