"""Spectra of chosen pixels of a lazy cube: only blocks with chosen pixels are computed, one task a block."""

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

#: Blocks computed at a time.
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
    """Return the spectra of pixels (pixel, band), float32, by cube, and values by name of other variables.

    Takes ``cubes``: cubes (along_track, band, cross_track), by name; ``planes``: variables (along_track,
    cross_track), by name; ``along``, ``across`` (pixel,): positions; ``bands``: which bands; ``small``:
    variables (along_track), read whole in the same pass; ``progress``: called with blocks done and to do.
    Values are those of the planes (pixel,) and of the small variables (along_track,), and ``present``
    (pixel,), whether a pixel has a value in any band of the first cube, also in bands outside ``bands``.
    """
    first = next(iter(cubes.values()))
    # a flight line is computed in slabs of lines, a map in its tiles
    sizes = (line_chunked(first) if first.chunks is None else first).variable.chunksizes
    blocked: dict[str, Any] = {dim: sizes[dim] for dim in (ALONG_TRACK, CROSS_TRACK)}
    aligned = [cube.transpose(*CUBE).chunk({**blocked, BAND: -1}) for cube in cubes.values()]
    aligned += [plane.transpose(ALONG_TRACK, CROSS_TRACK).chunk(blocked) for plane in planes.values()]
    blocks = [array.data.to_delayed(optimize_graph=False).ravel() for array in aligned]
    rows, columns = (np.concatenate([[0], np.cumsum(part)]) for part in blocked.values())
    block_row, block_column = (
        np.searchsorted(edges, place, side="right") - 1 for edges, place in ((rows, along), (columns, across))
    )
    home = block_row * (len(columns) - 1) + block_column
    order = np.argsort(home, kind="stable")
    touched, starts = np.unique(home[order], return_index=True)
    wanted = np.split(order, starts[1:]) if touched.size else []
    take = dask.delayed(_taken, pure=False)
    here = along - rows[block_row], across - columns[block_column]
    tasks = [
        take([of[block] for of in blocks], len(cubes), *(part[pixel] for part in here), bands)
        for block, pixel in zip(touched, wanted, strict=True)
    ]
    lazy = {name: _whole(array) for name, array in small.items() if array.chunks is not None}
    values = {name: array.values for name, array in small.items() if name not in lazy}
    width = len(range(*bands.indices(first.sizes[BAND])))
    spectra = {name: np.empty((along.size, width), np.float32) for name in cubes}
    values |= {name: np.empty(along.size, plane.dtype) for name, plane in planes.items()}
    values["present"] = np.empty(along.size, bool)
    outputs = [*spectra.values(), *(values[name] for name in planes), values["present"]]
    # results are deleted once copied, or everything would be held twice
    for start in range(0, max(len(tasks), 1), BLOCKS_AT_ONCE):
        part = tasks[start : start + BLOCKS_AT_ONCE]
        share = None if progress is None else _share(progress, start, len(tasks))
        results = _computed([*part, *([] if start else lazy.values())], share)
        for pixel, taken in zip(wanted[start : start + BLOCKS_AT_ONCE], results, strict=False):
            for out, piece in zip(outputs, taken, strict=True):
                out[pixel] = piece
        if not start:
            values |= dict(zip(lazy, results[len(part) :], strict=True))
        del results
        trim_memory()
    return spectra, values


def _share(progress: Progress, before: int, tasks: int) -> Progress:
    return lambda done, _: progress(min(before + done, tasks), tasks)


def _whole(array: xr.DataArray) -> Any:
    return dask.delayed(np.concatenate)(list(array.data.to_delayed(optimize_graph=False)))


def _taken(blocks: list[Array], cubes: int, rows: Array, columns: Array, bands: slice) -> list[Array]:
    # Pixels of a block's cubes (pixel, band) and planes, and whether they have a value (pixel,)
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
        for done, _ in enumerate(as_completed(futures), start=1):
            progress(done, len(futures))
        return list(client.gather(futures))
    from dask.callbacks import Callback

    waiting = {task.key for task in tasks}

    def report(key: Any, *_: Any) -> None:
        if key in waiting:
            waiting.discard(key)
            progress(len(tasks) - len(waiting), len(tasks))

    with Callback(posttask=report):
        return list(dask.compute(*tasks))
