"""The graph of a map: one task a tile for where it lies in the line, and one for every variable of it.

A task is given the slabs of lines that cover its tile, and no others.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from hyperpaint.base.arrays import Array

from .grids import MapGrid
from .indexing import Plan, Window, gaps_of, index_tile, reading_of
from .resampling import column_values, line_values, map_spectra, plane_values

if TYPE_CHECKING:
    import dask.array as da

__all__ = ["Tiles", "tile_windows"]

Place = tuple[int, int]
"""Row and column of a tile."""


def tile_windows(shape: tuple[int, int], tile: int) -> list[list[Window]]:
    """Return the tiles of a grid, by row and column."""
    rows, cols = ([slice(k, min(k + tile, size)) for k in range(0, size, tile)] for size in shape)
    return [[(row, col) for col in cols] for row in rows]


@dataclass(frozen=True)
class Tiles:
    """The tiles of a map, and what each of them reads.

    Attributes
    ----------
    grid
        How the cells lie.
    windows
        Cells of the tiles, by row and column.
    slabs
        Slabs of lines that each tile reads.
    starts
        First line of every slab.
    index, gap
        The `TileIndex` of every tile, lazily, as an array of one object a tile, and its gaps (row, col).
    nearest, before
        The `Reading` of every tile, of the nearest pixels, and of those before each place.
    bilinear
        Whether to interpolate.
    """

    grid: MapGrid
    windows: list[list[Window]]
    slabs: dict[Place, list[int]]
    starts: tuple[int, ...]
    index: da.Array
    gap: da.Array
    nearest: da.Array
    before: da.Array
    bilinear: bool

    @classmethod
    def of(
        cls,
        plan: Plan,
        windows: list[list[Window]],
        slabs: dict[Place, list[int]],
        east: da.Array,
        north: da.Array,
        *,
        bilinear: bool,
    ) -> Tiles:
        """Return tiles whose index follows from where the pixels lie."""
        from dask.base import tokenize

        starts = tuple(np.cumsum((0, *east.chunks[0][:-1])).tolist())
        shared = {f"orthorectification-plan-{tokenize(plan)}": plan}
        key = next(iter(shared))
        tasks: dict[Place, Any] = {}
        for place, (rows, cols) in _each(windows):
            first = [starts[slab] for slab in slabs[place]]
            read = [[(of.name, slab, 0) for slab in slabs[place]] for of in (east, north)]
            tasks[place] = (index_tile, key, rows, cols, first, *read)
        single = ((1,) * len(windows), (1,) * len(windows[0]))
        index = _array("map-index", tasks, single, object, [east, north], plan, shared)
        gaps = {p: (gaps_of, key, *window, (index.name, *p)) for p, window in _each(windows)}
        gap = _array("map-gap", gaps, _chunks(windows), np.bool_, [index], plan, shared)
        nearest, before = (
            _array(
                "map-reading",
                {place: (reading_of, (index.name, *place), between) for place, _ in _each(windows)},
                single,
                object,
                [index],
                between,
            )
            for between in (False, True)
        )
        return cls(plan.grid, windows, slabs, starts, index, gap, nearest, before, bilinear)

    def part(self, name: str, dtype: Any) -> da.Array:
        """Return a part of the index (row, col)."""
        tasks = {place: (getattr, (self.index.name, *place), name) for place, _ in _each(self.windows)}
        return _array(f"map-{name}", tasks, _chunks(self.windows), dtype, [self.index])

    def cube(self, cube: da.Array, empty: Any) -> da.Array:
        """Return spectra (row, col, band) of a cube (line, band, column) in chunks of the slabs.

        They have the type of what stands in empty cells.
        """
        reading = self.before if self.bilinear else self.nearest
        return self._made("map-cube", map_spectra, reading, cube, (empty,), cube.shape[1:2])

    def plane(self, plane: da.Array, kind: str, empty: Any) -> da.Array:
        """Return values (row, col) of a plane (line, column) in chunks of the slabs.

        Where spectra are interpolated, ``kind`` is ``"bilinear"``, ``"nearest"``, or ``"flags"``, which
        joins.
        """
        reading = self.nearest if kind == "nearest" or not self.bilinear else self.before
        return self._made("map-plane", plane_values, reading, plane, (kind == "flags", empty))

    def lines(self, values: da.Array, empty: Any) -> da.Array:
        """Return values (row, col) of what every line has one of (line,), in one chunk."""
        return self._made("map-lines", line_values, self.index, values, (empty,))

    def columns(self, values: da.Array, empty: Any) -> da.Array:
        """Return values (row, col) of what every column has one of (column,), in one chunk."""
        return self._made("map-columns", column_values, self.index, values, (empty,))

    def centres(self) -> tuple[da.Array, da.Array]:
        """Return east and north of the centres of cells (row, col) [m]."""
        made = []
        for part, name in enumerate(("east", "north")):
            tasks = {place: (_centres, self.grid, *window, part) for place, window in _each(self.windows)}
            made.append(_array(f"map-{name}", tasks, _chunks(self.windows), np.float64, [], (self.grid,)))
        return made[0], made[1]

    def _made(
        self,
        label: str,
        function: Callable[..., Array],
        where: da.Array,
        source: da.Array,
        options: tuple[Any, ...],
        bands: tuple[int, ...] = (),
    ) -> da.Array:
        """Return the array whose tiles ``function`` makes of places, of what it reads, and of options."""
        tasks: dict[tuple[int, ...], Any] = {}
        dtype = np.asarray(options[-1]).dtype
        for place, (rows, cols) in _each(self.windows):
            needed = self.slabs[place]
            key = (*place, *(0 for _ in bands))
            if not needed:
                shape = [rows.stop - rows.start, cols.stop - cols.start, *bands]
                tasks[key] = (np.full, shape, options[-1], dtype)
                continue
            read: list[Any] = [(source.name, 0)]
            if source.ndim > 1:
                blocks = [(source.name, slab, *(0,) * (source.ndim - 1)) for slab in needed]
                read = [[self.starts[slab] for slab in needed], blocks]
            tasks[key] = (function, (where.name, *place), *read, *options)
        chunks = (*_chunks(self.windows), *((size,) for size in bands))
        return _array(label, tasks, chunks, dtype, [where, source], options)


def _chunks(windows: list[list[Window]]) -> tuple[tuple[int, ...], ...]:
    rows = tuple(row[0][0].stop - row[0][0].start for row in windows)
    return rows, tuple(window[1].stop - window[1].start for window in windows[0])


def _each(windows: list[list[Window]]) -> Iterator[tuple[Place, Window]]:
    for row, windowsof_row in enumerate(windows):
        for col, window in enumerate(windowsof_row):
            yield (row, col), window


def _centres(grid: MapGrid, rows: slice, cols: slice, part: int) -> Array:
    return grid.centres(rows, cols)[part]


def _array(
    label: str,
    tasks: Mapping[Any, Any],
    chunks: tuple[tuple[int, ...], ...],
    dtype: Any,
    sources: Sequence[da.Array],
    options: Any = None,
    shared: Mapping[str, Any] | None = None,
) -> da.Array:
    """Return the array of some tasks, by place; its name follows from what it is made of."""
    import dask.array as da
    from dask.base import tokenize
    from dask.highlevelgraph import HighLevelGraph

    name = f"{label}-{tokenize([source.name for source in sources], chunks, str(dtype), options)}"
    layer = {(name, *place): task for place, task in tasks.items()} | dict(shared or {})
    graph = HighLevelGraph.from_collections(name, layer, dependencies=list(sources))
    return da.Array(graph, name, chunks=chunks, meta=np.empty((0,) * len(chunks), dtype))
