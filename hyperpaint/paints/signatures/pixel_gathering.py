"""Spectra of selected pixels of a lazy cube: only blocks with such pixels are computed, one task a block."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import dask
import numpy as np
import xarray as xr

from hyperpaint.base.arrays import Array, Progress
from hyperpaint.base.schema import ALONG_TRACK, BAND, CROSS_TRACK, CUBE
from hyperpaint.io.store.computing import client_in_force
from hyperpaint.radiometry.slabs import line_chunked
from hyperpaint.surroundings.scratch import trim_memory

#: Number of blocks computed together.
BLOCKS_AT_ONCE = 16


def gather(
    cubes: Mapping[str, xr.DataArray],
    planes: Mapping[str, xr.DataArray],
    along: Array,
    across: Array,
    bands: slice,
    small: Mapping[str, xr.DataArray],
    progress: Progress | None = None,
) -> tuple[dict[str, Array], dict[str, Array]]:
    """Return the spectra of pixels by cube, and values of other variables, both by name.

    Spectra are (pixel, band), float32. The other values are those of ``planes`` (pixel,) and ``small``
    (along_track,), and ``present`` (pixel,): whether a pixel has a value in any band of the first cube, also
    outside ``bands``.

    Takes ``cubes``: cubes (along_track, band, cross_track), by name; ``planes``: variables (along_track,
    cross_track), by name; ``along``, ``across`` (pixel,): positions; ``bands``: slice of the bands;
    ``small``: variables (along_track), read completely in the same pass; ``progress``: called with the
    numbers of computed and of all blocks.
    """
    first = next(iter(cubes.values()))
    # a flight line is computed in slabs of lines, a map in its tiles
    sizes = (line_chunked(first) if first.chunks is None else first).variable.chunksizes
    chunks: dict[str, Any] = {dim: sizes[dim] for dim in (ALONG_TRACK, CROSS_TRACK)}
    aligned = [cube.transpose(*CUBE).chunk({**chunks, BAND: -1}) for cube in cubes.values()]
    aligned += [plane.transpose(ALONG_TRACK, CROSS_TRACK).chunk(chunks) for plane in planes.values()]
    blocks = [array.data.to_delayed(optimize_graph=False).ravel() for array in aligned]
    # block of every pixel, and the pixels of every block
    rows, columns = (np.concatenate([[0], np.cumsum(sizes)]) for sizes in chunks.values())
    block_row, block_column = (
        np.searchsorted(edges, positions, side="right") - 1
        for edges, positions in ((rows, along), (columns, across))
    )
    pixel_block = block_row * (len(columns) - 1) + block_column
    order = np.argsort(pixel_block, kind="stable")
    used_blocks, starts = np.unique(pixel_block[order], return_index=True)
    block_pixels = np.split(order, starts[1:]) if used_blocks.size else []
    select = dask.delayed(_selected, pure=False)
    row, column = along - rows[block_row], across - columns[block_column]
    tasks = [
        select([arrays[block] for arrays in blocks], len(cubes), row[pixels], column[pixels], bands)
        for block, pixels in zip(used_blocks, block_pixels, strict=True)
    ]
    lazy = {name: _concatenated(array) for name, array in small.items() if array.chunks is not None}
    values = {name: array.values for name, array in small.items() if name not in lazy}
    width = len(range(*bands.indices(first.sizes[BAND])))
    spectra = {name: np.empty((along.size, width), np.float32) for name in cubes}
    values |= {name: np.empty(along.size, plane.dtype) for name, plane in planes.items()}
    values["present"] = np.empty(along.size, bool)
    outputs = [*spectra.values(), *(values[name] for name in planes), values["present"]]
    # results are deleted once copied: they would otherwise be in memory twice
    for start in range(0, max(len(tasks), 1), BLOCKS_AT_ONCE):
        batch = tasks[start : start + BLOCKS_AT_ONCE]
        batch_progress = None if progress is None else _offset(progress, start, len(tasks))
        results = _computed([*batch, *([] if start else lazy.values())], batch_progress)
        for pixels, arrays in zip(block_pixels[start : start + BLOCKS_AT_ONCE], results, strict=False):
            for output, array in zip(outputs, arrays, strict=True):
                output[pixels] = array
        if not start:
            values |= dict(zip(lazy, results[len(batch) :], strict=True))
        del results
        trim_memory()
    return spectra, values


def _offset(progress: Progress, finished: int, tasks: int) -> Progress:
    # Progress over all tasks, from the progress over a batch after `finished` tasks
    return lambda count, _: progress(min(finished + count, tasks), tasks)


def _concatenated(array: xr.DataArray) -> Any:
    return dask.delayed(np.concatenate)(list(array.data.to_delayed(optimize_graph=False)))


def _selected(blocks: list[Array], cubes: int, rows: Array, columns: Array, bands: slice) -> list[Array]:
    # Pixels of the cubes (pixel, band) and planes (pixel,) in a block, and whether they have a value (pixel,)
    spectra = [block[rows, bands, columns].astype(np.float32, copy=False) for block in blocks[:cubes]]
    present = np.asarray(np.isfinite(blocks[0]).any(axis=1))[rows, columns]
    return [*spectra, *(block[rows, columns] for block in blocks[cubes:]), present]


def _computed(tasks: list[Any], progress: Progress | None) -> list[Any]:
    if progress is None or not tasks:
        return list(dask.compute(*tasks))
    client = client_in_force()
    if client is not None:
        from distributed import as_completed

        futures = client.compute(tasks)
        for count, _ in enumerate(as_completed(futures), start=1):
            progress(count, len(futures))
        return list(client.gather(futures))
    from dask.callbacks import Callback

    waiting = {task.key for task in tasks}

    def report(key: Any, *_: Any) -> None:
        if key in waiting:
            waiting.discard(key)
            progress(len(tasks) - len(waiting), len(tasks))

    with Callback(posttask=report):
        return list(dask.compute(*tasks))
