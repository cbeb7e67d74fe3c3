"""Large arrays of a line in unnamed temporary files, so that memory does not grow with the line."""

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

#: Memory of a survey for every pixel, beside the channels in their file, measured on 12,000 lines [byte].
SURVEYED_BYTES = 30
#: Maximum size of an array in memory [byte]: a layer of some 3,000 lines.
MOST_IN_MEMORY_BYTES = 8 * 2**20

#: Chunks computed at a time: enough for the threads of a laptop, few enough for its memory.
CHUNKS_AT_ONCE = 8
#: Rows of an array gathered at a time.
_ROWS = 64
#: Lines processed together.
_LINES = 128


def survey_planned(line: xr.Dataset, subject: str) -> AbstractContextManager[None]:
    """Return a context to survey a line within the memory limit (`hyperpaint.io.store.budget.planned`)."""
    from hyperpaint.io.store import budget

    pixels = math.prod(line.sizes.get(dim, 1) for dim in (ALONG_TRACK, CROSS_TRACK))
    least = budget.LOADED + SURVEYED_BYTES * pixels
    return budget.planned(subject, a_thread=budget.Load.of(line).a_thread, least=least)


def scratch_array(shape: tuple[int, ...], dtype: Any) -> Array:
    """Return an array of zeros; a large one is mapped to a temporary file.

    Raises `StoreError`: the disk is full.
    """
    size = math.prod(shape) * np.dtype(dtype).itemsize
    if size <= MOST_IN_MEMORY_BYTES:
        return np.zeros(shape, dtype)
    try:
        with tempfile.TemporaryFile(prefix="hyperpaint-") as file:
            # space is reserved now: a disk full at a later write would kill the process
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
    """Release the memory-mapped pages of an array or of its base; values stay on disk."""
    base: Any = array
    while base is not None and not isinstance(base, mmap.mmap):
        base = base.obj if isinstance(base, memoryview) else getattr(base, "base", None)
    if base is not None and hasattr(mmap, "MADV_DONTNEED"):
        base.madvise(mmap.MADV_DONTNEED)


def gather(array: Array, places: Array) -> Array:
    """Return rows of an array; the pages mapped around each row are released in between."""
    pieces = [places[first : first + _ROWS] for first in range(0, places.size, _ROWS)]
    out = np.empty((places.size, *array.shape[1:]), array.dtype)
    for first, piece in enumerate(pieces):
        out[first * _ROWS : first * _ROWS + piece.size] = array[piece]
        release(array)
    return out


def trim_memory() -> None:
    """Return freed memory of the allocator to the system, where it supports this."""
    with contextlib.suppress(OSError, AttributeError, TypeError):  # another C library than glibc
        ctypes.CDLL(None).malloc_trim(0)


def line_parts(array: Array, more: int = 0) -> Iterator[tuple[slice, Array]]:
    """Yield some lines of an array at a time, with ``more`` lines that follow; memory is released."""
    for first in range(0, len(array), _LINES):
        part = slice(first, min(first + _LINES, len(array)))
        yield part, array[first : part.stop + more]
        release(array)


def compute_into(lazy: Sequence[da.Array], outs: Sequence[Array], progress: Progress | None = None) -> None:
    """Compute arrays of equal chunks along their lines into other arrays, some chunks at a time."""
    import dask

    edges = [0, *np.cumsum(lazy[0].chunks[0]).tolist()]
    for first in range(0, len(edges) - 1, CHUNKS_AT_ONCE):
        part = slice(edges[first], edges[min(first + CHUNKS_AT_ONCE, len(edges) - 1)])
        for out, values in zip(outs, dask.compute(*(array[part] for array in lazy)), strict=True):
            out[part] = values
            release(out)
        if progress is not None:
            progress(part.stop, edges[-1])
    trim_memory()
