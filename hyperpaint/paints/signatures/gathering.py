"""The spectra of single pixels out of a lazy flight line.

Only the blocks of lines that hold wanted pixels are computed, one task a block; the task keeps the wanted
pixels and bands and lets go of the block. Pixels come back in the order they were asked for, whatever the
blocks, so that all that follows from them has the same bits for any chunking.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from hyperpaint.base.arrays import Array, Progress
from hyperpaint.base.schema import ALONG_TRACK, BAND, CROSS_TRACK
from hyperpaint.radiometry.slabs import line_chunked

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["Progress", "gather", "part_of"]


def gather(
    cubes: Mapping[str, xr.DataArray],
    planes: Mapping[str, xr.DataArray],
    along: Array,
    across: Array,
    bands: slice,
    small: Mapping[str, xr.DataArray],
    progress: Progress | None = None,
) -> tuple[dict[str, Array], dict[str, Array]]:
    """Return the spectra of pixels, single values of them, and small variables of the line.

    Parameters
    ----------
    cubes
        Cubes (along_track, band, cross_track), by name.
    planes
        Variables (along_track, cross_track), by name.
    along, across : (pixel,)
        Positions.
    bands
        Which bands.
    small
        Variables (along_track), which are read whole, in the same pass.
    progress
        Called with blocks done and to do.

    Returns
    -------
    spectra
        (pixel, band), float32, by name of the cube.
    values
        Of the planes (pixel,) and of the small variables (along_track,), by name; and ``present`` (pixel,),
        whether a pixel has a value in any band of the first cube, also in one that was not asked for.
    """
    import dask

    chunked = {name: line_chunked(cube) for name, cube in cubes.items()}
    lines = next(iter(chunked.values())).variable.chunksizes[ALONG_TRACK]
    whole: dict[str, Any] = {ALONG_TRACK: lines, CROSS_TRACK: -1}
    aligned = [cube.chunk({**whole, BAND: -1}) for cube in chunked.values()]
    aligned += [plane.transpose(ALONG_TRACK, CROSS_TRACK).chunk(whole) for plane in planes.values()]
    blocks = [array.data.to_delayed(optimize_graph=False).ravel() for array in aligned]
    edges = np.concatenate([[0], np.cumsum(lines)])
    home = np.searchsorted(edges, along, side="right") - 1
    order = np.argsort(home, kind="stable")
    touched, first = np.unique(home[order], return_index=True)
    wanted = np.split(order, first[1:]) if touched.size else []
    take = dask.delayed(_taken, pure=False)
    tasks = [
        take([of[block] for of in blocks], len(cubes), along[pixel] - edges[block], across[pixel], bands)
        for block, pixel in zip(touched, wanted, strict=True)
    ]
    lazy = {name: _whole(array) for name, array in small.items() if array.chunks is not None}
    found = _computed([*tasks, *lazy.values()], progress)
    values = {name: array.values for name, array in small.items() if name not in lazy}
    values |= dict(zip(lazy, found[len(tasks) :], strict=True))
    width = len(range(*bands.indices(next(iter(cubes.values())).sizes[BAND])))
    spectra = {name: np.empty((along.size, width), np.float32) for name in cubes}
    values |= {name: np.empty(along.size, plane.dtype) for name, plane in planes.items()}
    values["present"] = np.empty(along.size, bool)
    outputs = [*spectra.values(), *(values[name] for name in planes), values["present"]]
    for block, pixel in enumerate(wanted):
        for out, part in zip(outputs, found[block], strict=True):
            out[pixel] = part
        found[block] = None  # what is copied is let go, or everything would be held twice
    return spectra, values


def _whole(array: xr.DataArray) -> Any:
    """Return a lazy variable of one dim as one task, which shares what it needs with all others."""
    import dask

    return dask.delayed(np.concatenate)(list(array.data.to_delayed(optimize_graph=False)))


def _taken(blocks: list[Array], cubes: int, rows: Array, columns: Array, bands: slice) -> list[Array]:
    """Return pixels of a block's cubes, (pixel, band), of its planes, and which have a value, (pixel,)."""
    spectra = [block[rows, bands, columns].astype(np.float32, copy=False) for block in blocks[:cubes]]
    present = np.asarray(np.isfinite(blocks[0]).any(axis=1))[rows, columns]
    return [*spectra, *(block[rows, columns] for block in blocks[cubes:]), present]


def _computed(tasks: list[Any], progress: Progress | None) -> list[Any]:
    """Compute everything at once, so that what the tasks share is computed once."""
    import dask
    from dask.base import get_scheduler

    if progress is None or not tasks:
        return list(dask.compute(*tasks))
    client = getattr(get_scheduler(), "__self__", None)
    if hasattr(client, "scheduler_info"):
        return _on_cluster(client, tasks, progress)
    from dask.callbacks import Callback

    waiting = {task.key for task in tasks}

    def told(key: Any, *_: Any) -> None:
        if key in waiting:
            waiting.discard(key)
            progress(len(tasks) - len(waiting), len(tasks))

    with Callback(posttask=told):
        return list(dask.compute(*tasks))


def _on_cluster(client: Any, tasks: list[Any], progress: Progress) -> list[Any]:
    from distributed import as_completed

    futures = client.compute(tasks)
    for done, _ in enumerate(as_completed(futures), start=1):
        progress(done, len(futures))
    return list(client.gather(futures))


def part_of(progress: Progress, number: int, total: int) -> Progress:
    """Return a progress that tells how far one of several parts is, in thousandths of each.

    Examples
    --------
    >>> part_of(print, 1, 4)(5, 10)
    1500 4000
    """

    def told(done: int, steps: int) -> None:
        progress(1000 * number + 1000 * done // max(steps, 1), 1000 * total)

    return told
