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

from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.schema import (
    ALONG_TRACK,
    BAND,
    CROSS_TRACK,
    CUBE,
    Array,
    Bools,
    Floats,
    Ints,
    Quality,
    label,
)
from hyperpaint.kernels.arguments import InverseTile, LinePositions, MapCells, Places
from hyperpaint.kernels.rays import fill_between, gather_bilinear, gather_nearest, invert_lines
from hyperpaint.radiometry.counts_to_reflectance import reflectance
from hyperpaint.radiometry.spectral_axis import to_nominal

from .grids import MapGrid, Place, Survey, tile_array

# --- pixel of a line at every cell of a tile --------------------------------------------------------------


Window = tuple[slice, slice]  # rows and columns of a tile

RULES = ("nadir", "first", "last")  # choice among several positions, in the order of the kernel's numbers


@dataclass(frozen=True)
class Plan:
    # Settings that all tiles share.
    grid: MapGrid
    rule: int  #: Position in `RULES`
    longest: float  #: Longest edge of a patch of four pixels [cell]
    last: int  #: Number of the last line
    #: Largest relative shift of neighbouring pixels by their heights without hidden ground [m]
    parallax: float
    #: (pair, 4, 2) float64: east and north of the corners of the area between every located line and the next
    #: located line, in order around it [m]
    between: Floats


@dataclass(frozen=True)
class TileIndex:
    # Positions in the line at the cells of a tile.
    line: Floats  #: (row, col) float64: as fractions; NaN where no patch covers a cell
    sample: Floats
    #: (row, col) int32: nearest of the four pixels around the position; -1 in uncovered cells
    nearest_line: Array
    nearest_sample: Array
    hits: Array  #: (row, col) uint16: patches over a cell


@dataclass(frozen=True)
class Reading:
    """Pixels of a tile in the order of reading, and the cells they fill."""

    shape: tuple[int, int]  #: Rows and columns of the tile
    #: (place,) int64: covered cells, numbered row by row, in the order of their lines
    cells: Ints
    lines: Ints  #: (place,) int64: pixel to read; for interpolation, the pixel before the position
    columns: Ints
    #: (place,) float64: fraction towards the next line and column; empty without interpolation
    along: Floats
    across: Floats


def needed_slabs(
    survey: Survey, grid: MapGrid, chunks: Sequence[int], windows: Sequence[Sequence[Window]]
) -> dict[tuple[int, int], list[int]]:
    # Return the slabs of lines that cover each tile; ``chunks`` are the lines of every slab.
    ends = np.cumsum(chunks)
    cells = survey.boxes / grid.gsd - np.repeat([grid.first[1], grid.first[0]], 2) - 0.5
    low, high = np.fmin(cells[:-1], cells[1:]), np.fmax(cells[:-1], cells[1:])
    # a patch needs both of its lines
    is_placed = np.isfinite(cells[:-1, 0]) & np.isfinite(cells[1:, 0])
    needed = {}
    for row, tile_row in enumerate(windows):
        row_slice = tile_row[0][0]
        pairs = np.flatnonzero(
            is_placed & (high[:, 3] >= row_slice.start - 1) & (low[:, 2] <= row_slice.stop)
        )
        for col, (_, col_slice) in enumerate(tile_row):
            covering_pairs = pairs[
                (high[pairs, 1] >= col_slice.start - 1) & (low[pairs, 0] <= col_slice.stop)
            ]
            needed[row, col] = np.unique(
                np.searchsorted(ends, np.concatenate([covering_pairs, covering_pairs + 1]), side="right")
            ).tolist()
    return needed


def index_tile(
    plan: Plan,
    rows: slice,
    cols: slice,
    starts: Sequence[int],
    east: Sequence[Floats],
    north: Sequence[Floats],
    *relief: Sequence[Floats],
) -> TileIndex:
    # Return the positions in the line at the cells of a tile.
    #
    # ``starts`` are the first lines of the slabs, whose pixels lie at ``east`` and ``north`` (line, column);
    # ``relief``, if available, are the height of the ground [m] and the tangent of the view zenith angle:
    # between pixels of very different height lies ground that neither shows.
    shape = rows.stop - rows.start, cols.stop - cols.start
    position, nearest = np.full((2, *shape), np.nan), np.full((2, *shape), -1, np.int32)
    rank, hits = np.full(shape, np.inf), np.zeros(shape, np.uint16)
    out = InverseTile(position, nearest, rank, hits)
    cells = MapCells(plan.grid.frame, (rows.start, cols.start), plan.longest, plan.rule)
    next_start, line_before = -1, [np.empty(0)] * (2 + len(relief))
    for start, *slab in zip(starts, east, north, *relief, strict=True):
        if start != next_start:
            line_before = [np.full(slab[0].shape[1], np.nan)] * len(slab)
        e, n, *surface = (np.ascontiguousarray(part) for part in slab)
        hidden = (
            hidden_between(surface[0], surface[1], line_before[2:], plan.parallax)
            if surface
            else np.zeros((0, 0), bool)
        )
        invert_lines(
            LinePositions(e, n, line_before[0], line_before[1], hidden), start, plan.last, cells, out
        )
        line_before, next_start = [e[-1], n[-1], *(part[-1] for part in surface)], start + len(e)
    return TileIndex(position[0], position[1], nearest[0], nearest[1], hits)


def hidden_between(height: Floats, tangent: Floats, before: Sequence[Floats], parallax: float) -> Bools:
    # Return where ground is hidden between pixels and those of the line before (line, column - 1).
    #
    # ``height`` [m] and ``tangent`` of the zenith angle (line, column) belong to consecutive lines,
    # ``before`` (column,) to the line before. For four pixels that span a patch, the difference of heights
    # times the tangent is their shift on the map against the line of sight of their neighbours. It exceeds
    # the pixel spacing only where the surface falls away steeper than the line of sight; on a visible wall it
    # equals the spacing.
    heights, tangents = (
        np.concatenate([first[None], lines]) for first, lines in zip(before, (height, tangent), strict=True)
    )

    def of_patches(reduce: np.ufunc, values: Floats) -> Floats:
        of_pairs = reduce(values[:-1], values[1:])
        return np.asarray(reduce(of_pairs[:, :-1], of_pairs[:, 1:]))

    drop = of_patches(np.maximum, heights) - of_patches(np.minimum, heights)
    return np.asarray(drop * of_patches(np.maximum, tangents) > parallax)


def gaps_of(plan: Plan, rows: slice, cols: slice, index: TileIndex) -> Array:
    # Return the uncovered cells between the ends of lines (row, col).
    frame = plan.grid.frame
    is_between: Bools = np.zeros(index.hits.shape, bool)
    offset = plan.between - frame[:2]
    is_near = np.ones(len(offset), bool)
    for (a, b), cells in ((frame[2:4], cols), (frame[4:6], rows)):
        coordinate = np.asarray(a * offset[..., 0] + b * offset[..., 1])
        is_near &= (coordinate.max(axis=1) >= cells.start) & (coordinate.min(axis=1) <= cells.stop - 1)
    fill_between(plan.between[is_near], frame, (rows.start, cols.start), is_between)
    return np.asarray(is_between & (index.hits == 0))


def reading_of(index: TileIndex, bilinear: bool) -> Reading:
    # Return the reading order of the pixels of a tile: the nearest pixels, or those before each place.
    positions = (index.line, index.sample) if bilinear else (index.nearest_line, index.nearest_sample)
    cells = np.flatnonzero(index.hits)
    line, sample = (part.ravel()[cells] for part in positions)
    order = np.argsort(line, kind="stable")
    line, sample = line[order], sample[order]
    lines, columns = line.astype(np.int64), sample.astype(np.int64)
    along, across = (
        np.asarray(position - whole if bilinear else [], np.float64)
        for position, whole in ((line, lines), (sample, columns))
    )
    return Reading(index.hits.shape, cells[order], lines, columns, along, across)


# --- values of a tile ----------------------------------------------------------------------------------


def map_spectra(reading: Reading, starts: Sequence[int], slabs: Sequence[Array], empty: Any) -> Array:
    # Return spectra (row, col, band) from slabs (line, band, column) that begin at the lines ``starts``.
    #
    # Uncovered cells get ``empty``, whose type the result has.
    bands, columns = slabs[0].shape[1:]
    bilinear = reading.along.size > 0
    dtype = np.asarray(empty).dtype
    out = np.empty((reading.shape[0] * reading.shape[1], bands), dtype)
    if reading.cells.size < len(out):
        is_uncovered = np.ones(len(out), bool)
        is_uncovered[reading.cells] = False
        out[is_uncovered] = empty
    buffer = np.empty((columns, bands), dtype)
    for slab, start, is_slab in _by_slab(reading, starts, slabs):
        pixel = reading.lines[is_slab] - start, reading.columns[is_slab]
        block = np.ascontiguousarray(slabs[slab])
        if not bilinear:
            gather_nearest(block, *pixel, reading.cells[is_slab], buffer, out)
            continue
        fractions = reading.along[is_slab].astype(dtype), reading.across[is_slab].astype(dtype)
        next_line = _line_after(starts, slabs, slab)
        positions = Places(*pixel, *fractions, reading.cells[is_slab])
        gather_bilinear(block, next_line, positions, buffer, np.empty_like(buffer), out)
    return out.reshape(*reading.shape, bands)


def plane_values(
    reading: Reading, starts: Sequence[int], slabs: Sequence[Array], flags: bool, empty: Any
) -> Array:
    # Return values (row, col) of slabs (line, column), see `map_spectra`.
    #
    # With ``flags`` the bits of the four pixels of an interpolation are combined by OR.
    out = np.full(reading.shape[0] * reading.shape[1], empty, slabs[0].dtype)
    for slab, start, is_slab in _by_slab(reading, starts, slabs):
        line, column, cells = reading.lines[is_slab] - start, reading.columns[is_slab], reading.cells[is_slab]
        if not reading.along.size:
            out[cells] = slabs[slab][line, column]
            continue
        along, across = reading.along[is_slab], reading.across[is_slab]
        lines = np.concatenate([slabs[slab], _line_after(starts, slabs, slab)[None]])
        # a pixel at distance 0 needs no neighbour
        corners = ((0, 0), (0, 1), (1, 0), (1, 1))
        corner_values = [lines[line + i * (along > 0), column + j * (across > 0)] for i, j in corners]
        if flags:
            out[cells] = corner_values[0] | corner_values[1] | corner_values[2] | corner_values[3]
        else:
            before = corner_values[0] + across * (corner_values[1] - corner_values[0])
            after = corner_values[2] + across * (corner_values[3] - corner_values[2])
            out[cells] = before + along * (after - before)
    return out.reshape(reading.shape)


def nearest_values(index: TileIndex, values: Array, of_lines: bool, empty: Any) -> Array:
    # Return values (row, col) of the nearest line or column, from one value per line or column.
    pixel = index.nearest_line if of_lines else index.nearest_sample
    return np.where(pixel >= 0, values[np.maximum(pixel, 0)], np.asarray(empty, values.dtype))


def _by_slab(
    reading: Reading, starts: Sequence[int], slabs: Sequence[Array]
) -> Iterator[tuple[int, int, slice]]:
    # Yield every slab with pixels to read, its first line, and the range of these pixels.
    edges = np.searchsorted(reading.lines, [*starts, starts[-1] + len(slabs[-1])])
    for slab, start in enumerate(starts):
        pixels = slice(int(edges[slab]), int(edges[slab + 1]))
        if pixels.stop > pixels.start:
            yield slab, start, pixels


def _line_after(starts: Sequence[int], slabs: Sequence[Array], slab: int) -> Array:
    # Return the first line of the next slab, or the last line of this slab if the next one is not read.
    is_consecutive = slab + 1 < len(slabs) and starts[slab + 1] == starts[slab] + len(slabs[slab])
    return np.ascontiguousarray(slabs[slab + 1][0] if is_consecutive else slabs[slab][-1])


def tile_windows(shape: tuple[int, int], tile: int) -> list[list[Window]]:
    rows, cols = ([slice(k, min(k + tile, size)) for k in range(0, size, tile)] for size in shape)
    return [[(row, col) for col in cols] for row in rows]


@dataclass(frozen=True)
class Tiles:
    # The tiles of a map, and the slabs that each of them reads.
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
        # Return tiles whose index follows from the places of pixels: see `index_tile`.
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

    def tiles_of(
        self,
        label: str,
        function: Callable[..., Array],
        index_array: da.Array,
        source: da.Array,
        options: tuple[Any, ...],
        bands: tuple[int, ...] = (),
    ) -> da.Array:
        # Return tiles (row, col[, band]) that ``function`` computes from an index or readings, and a source.
        #
        # The source is a cube (line, band, column) or plane (line, column) in chunks of the slabs, or one
        # value per line or column in one chunk; the result has the type of the last option.
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
    # Return a line with spectra at nominal wavelengths, and the names of the variables to map.
    #
    # By default reflectance, else radiance; from counts alone reflectance is computed.
    #
    # Raises `SchemaError`: Variables that are missing, of dims that a map lacks, or of types other than
    # numbers, flags and times; all are listed. Or reflectance is missing and cannot be computed. Raises
    # `UnitsError`: As `hyperpaint.reflectance`.
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
    # Return the value of an uncovered cell.
    #
    # NaN or NaT; ``off_swath`` for ``quality``; for integers -1, or the largest of an unsigned type.
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
    # Return the variables of a `prepared` line on a map, by new name; ``lines`` is the number per slab.
    variables = {}
    for name in names:
        source = line[name]
        if BAND in source.dims:
            is_mixed = tiles.bilinear and source.dtype.kind != "f"
            empty = empty_value(name, np.dtype(np.float32) if is_mixed else source.dtype)
            cube = in_slabs(source.transpose(*CUBE), lines)
            reading = tiles.before if tiles.bilinear else tiles.nearest
            values = tiles.tiles_of("map-cube", map_spectra, reading, cube, (empty,), cube.shape[1:2])
        else:
            source = source.astype("datetime64[ns]") if source.dtype.kind == "M" else source
            empty = empty_value(name, source.dtype)
            kind = "bilinear" if source.dtype.kind == "f" and name not in _WRAPPING else "nearest"
            if "flag_masks" in source.attrs or name == "quality":
                kind = "flags"
            if source.ndim == 2:
                plane = in_slabs(source.transpose(*_PIXEL), lines)
                reading = tiles.nearest if kind == "nearest" or not tiles.bilinear else tiles.before
                # flags of all pixels are joined
                options = (kind == "flags", empty)
                values = tiles.tiles_of("map-plane", plane_values, reading, plane, options)
            else:
                row = source.chunk({source.dims[0]: -1}).data
                options = (source.dims == (ALONG_TRACK,), empty)
                values = tiles.tiles_of("map-nearest", nearest_values, tiles.index, row, options)
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
    # Return an array in memory as a dask array, whose chunks are views of it.
    return da.from_array(
        _InMemory(values), chunks, name, asarray=False, meta=np.empty((0,) * values.ndim, values.dtype)
    )
