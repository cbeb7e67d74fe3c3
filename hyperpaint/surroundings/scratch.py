"""Large arrays of a line in unnamed temporary files, so that memory does not grow with the line."""

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

from hyperpaint.base import ALONG_TRACK, CROSS_TRACK, Array, Progress, StoreError

if TYPE_CHECKING:
    import dask.array as da

#: Memory of a survey per pixel, without the channels in their file, measured on 12,000 lines [byte].
SURVEY_BYTES_PER_PIXEL = 30
#: Size of an array above which it is mapped to a file [byte]: a layer of some 3,000 lines.
MAX_ARRAY_BYTES_IN_MEMORY = 8 * 2**20

#: Number of chunks computed together: enough for the threads of a laptop, few enough for its memory.
CHUNKS_AT_ONCE = 8
#: Number of rows gathered together.
_ROWS = 64
#: Number of lines processed together.
_LINES = 128


def survey_planned(line: xr.Dataset, subject: str) -> AbstractContextManager[None]:
    # Return a context to survey a line within the memory limit (`hyperpaint.io.store.budget.planned`).
    from hyperpaint.io.store import budget

    pixels = math.prod(line.sizes.get(dim, 1) for dim in (ALONG_TRACK, CROSS_TRACK))
    return budget.planned(
        subject,
        a_thread=budget.Load.of(line).a_thread,
        min_bytes=budget.LOADED + SURVEY_BYTES_PER_PIXEL * pixels,
    )


def scratch_array(shape: tuple[int, ...], dtype: Any) -> Array:
    # Return an array of zeros; a large one is mapped to a temporary file.
    #
    # Raises `StoreError`: the disk is full.
    size = math.prod(shape) * np.dtype(dtype).itemsize
    if size <= MAX_ARRAY_BYTES_IN_MEMORY:
        return np.zeros(shape, dtype)
    try:
        with tempfile.TemporaryFile(prefix="hyperpaint-") as file:
            # reserve the space now: a full disk at a later write to mapped memory would kill the process
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(file.fileno(), 0, size)
            else:  # pragma: no cover - not Linux
                file.truncate(size)
            mapped = mmap.mmap(file.fileno(), size)
    except OSError as error:
        raise StoreError(
            f"no space for {size / 2**20:.0f} MiB of a flight line in {tempfile.gettempdir()}: {error}",
            mend="free space there, set TMPDIR to another disk, or process fewer lines at a time",
            code="disk-full",
        ) from error
    return np.ndarray(shape, dtype, buffer=mapped)


def release(array: Array) -> None:
    # Release the memory-mapped pages of an array or of its base; values stay on disk.
    base: Any = array
    while base is not None and not isinstance(base, mmap.mmap):
        base = base.obj if isinstance(base, memoryview) else getattr(base, "base", None)
    if base is not None and hasattr(mmap, "MADV_DONTNEED"):
        base.madvise(mmap.MADV_DONTNEED)


def gather(array: Array, indices: Array) -> Array:
    # Return rows of a mapped array; its pages are released after every `_ROWS` rows.
    rows = np.empty((indices.size, *array.shape[1:]), array.dtype)
    for start in range(0, indices.size, _ROWS):
        rows[start : start + _ROWS] = array[indices[start : start + _ROWS]]
        release(array)
    return rows


def trim_memory() -> None:
    # Return freed memory of the allocator to the system, where the C library supports this.
    with contextlib.suppress(OSError, AttributeError, TypeError):  # another C library than glibc
        ctypes.CDLL(None).malloc_trim(0)


def line_blocks(array: Array, overlap: int = 0) -> Iterator[tuple[slice, Array]]:
    # Yield blocks of lines of a mapped array, each with ``overlap`` lines of the next block.
    #
    # The pages of the array are released after every block.
    for start in range(0, len(array), _LINES):
        lines = slice(start, min(start + _LINES, len(array)))
        yield lines, array[start : lines.stop + overlap]
        release(array)


def compute_into(lazy: "Sequence[da.Array]", outs: Sequence[Array], progress: Progress | None = None) -> None:
    # Compute lazy arrays with equal chunks along their lines into ``outs``, some chunks at a time.
    import dask

    edges = [0, *np.cumsum(lazy[0].chunks[0]).tolist()]
    for chunk in range(0, len(edges) - 1, CHUNKS_AT_ONCE):
        lines = slice(edges[chunk], edges[min(chunk + CHUNKS_AT_ONCE, len(edges) - 1)])
        for out, values in zip(outs, dask.compute(*(array[lines] for array in lazy)), strict=True):
            out[lines] = values
            release(out)
        if progress is not None:
            progress(lines.stop, edges[-1])
    trim_memory()
