"""Large arrays of a line, in files without a name that go with them: memory does not grow with the line."""

from __future__ import annotations

import contextlib
import ctypes
import math
import mmap
import os
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from hyperpaint.base.arrays import Array, Progress
from hyperpaint.base.errors import StoreError
from hyperpaint.base.schema import ALONG_TRACK, CROSS_TRACK

if TYPE_CHECKING:
    import dask.array as da

#: Memory of a survey for every pixel, beside the channels in their file: what 12,000 lines took.
SURVEYED_BYTES = 30
#: Size up to which an array is in memory as any other: a layer of some 3,000 lines.
MOST_IN_MEMORY_BYTES = 8 * 2**20

#: Chunks that are computed at a time: enough for the threads of a laptop, little enough for its memory.
_TOGETHER = 8
#: Rows of an array that are gathered at a time.
_ROWS = 64
#: Lines that are looked at together.
_LINES = 128


def survey_planned(line: xr.Dataset, subject: str) -> AbstractContextManager[None]:
    """Return where a line is surveyed within the memory limit (`hyperpaint.io.store.budget.planned`)."""
    from hyperpaint.io.store import budget

    pixels = math.prod(line.sizes.get(dim, 1) for dim in (ALONG_TRACK, CROSS_TRACK))
    least = budget.LOADED + SURVEYED_BYTES * pixels
    return budget.planned(subject, a_thread=budget.Load.of(line).a_thread, least=least)


def scratch_array(shape: tuple[int, ...], dtype: Any) -> Array:
    """Return an array of zeros, of which a large one is in a file of the folder for temporary ones.

    Raises `StoreError`: the disk is full.
    """
    size = math.prod(shape) * np.dtype(dtype).itemsize
    if size <= MOST_IN_MEMORY_BYTES:
        return np.zeros(shape, dtype)
    try:
        with tempfile.TemporaryFile(prefix="hyperpaint-") as file:
            # a disk that is full only when pages are written to it would end the process
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(file.fileno(), 0, size)
            else:  # pragma: no cover - not Linux
                file.truncate(size)
            mapped = mmap.mmap(file.fileno(), size)
    except OSError as error:
        raise StoreError(
            f"no room for {size / 2**20:.0f} MiB of a flight line in {tempfile.gettempdir()}: {error}",
            mend="make room there, set TMPDIR to another disk, or take fewer lines at a time",
            code="disk-full",
        ) from error
    return np.ndarray(shape, dtype, buffer=mapped)


def release(array: Array) -> None:
    """Let go of the memory that mirrors the file of an array, or of what it is a part of; its values stay."""
    base: Any = array
    while base is not None and not isinstance(base, mmap.mmap):
        base = base.obj if isinstance(base, memoryview) else getattr(base, "base", None)
    if base is not None and hasattr(mmap, "MADV_DONTNEED"):
        base.madvise(mmap.MADV_DONTNEED)


def gather(array: Array, places: Array) -> Array:
    """Return rows of an array; the system maps some pages around each, which are let go in between."""
    pieces = [places[first : first + _ROWS] for first in range(0, places.size, _ROWS)]
    out = np.empty((places.size, *array.shape[1:]), array.dtype)
    for first, piece in enumerate(pieces):
        out[first * _ROWS : first * _ROWS + piece.size] = array[piece]
        release(array)
    return out


def trim_memory() -> None:
    """Give back to the system what the allocator keeps of the slabs that were read, where it does that."""
    with contextlib.suppress(OSError, AttributeError, TypeError):  # not of glibc
        ctypes.CDLL(None).malloc_trim(0)


def line_parts(array: Array, more: int = 0) -> Iterator[tuple[slice, Array]]:
    """Yield lines of an array, some at a time, with so many ``more`` that follow; memory is released."""
    for first in range(0, len(array), _LINES):
        part = slice(first, min(first + _LINES, len(array)))
        yield part, array[first : part.stop + more]
        release(array)


def compute_into(lazy: Sequence[da.Array], outs: Sequence[Array], progress: Progress | None = None) -> None:
    """Compute arrays that are chunked alike along their lines into others, some chunks at a time."""
    import dask

    from hyperpaint.io.store.budget import share_one_heap

    share_one_heap()
    edges = [0, *np.cumsum(lazy[0].chunks[0]).tolist()]
    for first in range(0, len(edges) - 1, _TOGETHER):
        part = slice(edges[first], edges[min(first + _TOGETHER, len(edges) - 1)])
        for out, values in zip(outs, dask.compute(*(array[part] for array in lazy)), strict=True):
            out[part] = values
            release(out)
        if progress is not None:
            progress(part.stop, edges[-1])
    trim_memory()
