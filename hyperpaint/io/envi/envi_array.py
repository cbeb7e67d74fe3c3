"""Samples of an ENVI data file as a lazy array that reads only the requested bytes.

A memory map passed to dask is copied into memory, and pickled with the graph. `EnviArray` takes a few
hundred bytes instead: the path and the layout. Each read opens the file, so that threads and
processes share nothing.
"""

from __future__ import annotations

import io
import itertools
import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from xarray.backends import BackendArray
from xarray.core import indexing

from hyperpaint.base.arrays import Array, Ints
from hyperpaint.base.errors import FormatError

# gaps up to this size are read and dropped, which is faster than another system call [byte]
_MAX_GAP_BYTES = 32 * 2**10
# largest piece read at once if not all of it is kept [byte]
_MAX_BOX_BYTES = 8 * 2**20


@dataclass(frozen=True, eq=False)
class Scaling:
    """From stored samples to values: ``(stored * gain + offset) / divisor``, `ignore` becomes NaN."""

    dtype: np.dtype[Any]  # Type of the values, floating or complex
    ignore: int | float | None = None  # Compared with stored samples, before scaling
    divisor: float | None = None  # The reflectance scale factor
    # gain, offset: One value per band
    gain: npt.NDArray[np.float64] | None = None
    offset: npt.NDArray[np.float64] | None = None

    def apply(self, stored: Array, per_band: Callable[[Array], Array]) -> Array:
        """Return values of `stored`; `per_band` selects and reshapes a band vector to match it."""
        # float32 holds 16 bits exactly; wider integers pass through float64
        values = stored.astype(np.result_type(stored.dtype, np.float32))
        if self.gain is not None:
            values *= per_band(self.gain)
        if self.offset is not None:
            values += per_band(self.offset)
        if self.divisor is not None:
            values /= self.divisor
        if self.ignore is not None:
            values[stored == self.ignore] = np.nan
        return values.astype(self.dtype, copy=False)


@dataclass(frozen=True, eq=False)
class EnviArray(BackendArray):
    """Samples of an ENVI data file, in any order of dims, in native byte order."""

    path: str  # Absolute path of the data file
    # file_size, modified_ns: Of the file when it was opened; a read refuses a file that has changed since.
    # dask names an array by its fields: a changed file gets another name.
    file_size: int
    modified_ns: int
    offset: int  # Bytes before the first sample
    stored: np.dtype[Any]  # Type of a stored sample, byte order included
    file_shape: tuple[int, int, int]  # Slowest axis of the file first
    axes: tuple[int, int, int]  # Axis of the file of each dim
    band_axis: int  # The dim that counts bands
    scaling: Scaling | None = None  # None for stored samples

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(self.file_shape[axis] for axis in self.axes)

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the values, in native byte order."""
        return self.stored.newbyteorder("=") if self.scaling is None else self.scaling.dtype

    def __getitem__(self, key: indexing.ExplicitIndexer) -> Any:
        return indexing.explicit_indexing_adapter(
            key, self.shape, indexing.IndexingSupport.OUTER, self._outer
        )

    def _outer(self, key: tuple[Any, ...]) -> Array:
        # Return the samples at the crossings of an index, slice or sorted index array per dim.
        positions = [_positions(index, size) for index, size in zip(key, self.shape, strict=True)]
        values = self._read(positions)
        if self.scaling is not None:
            vector_shape = tuple(-1 if axis == self.band_axis else 1 for axis in range(3))
            bands = positions[self.band_axis]
            values = self.scaling.apply(values, lambda vector: vector[bands].reshape(vector_shape))
        shape = [
            size
            for size, index in zip(values.shape, key, strict=True)
            if not isinstance(index, int | np.integer)
        ]
        return values.reshape(shape)

    def _read(self, positions: list[Ints]) -> Array:
        samples = np.empty(tuple(len(index) for index in positions), self.stored.newbyteorder("="))
        if samples.size == 0:
            return samples
        # a view of the same memory, axes in the order of the file
        in_file_order = samples.transpose(np.argsort(self.axes))
        indices = [positions[axis] for axis in np.argsort(self.axes)]
        with open(self.path, "rb", buffering=0) as file:
            self._refuse_changed(file)
            # complete successive planes of the file are read in one piece
            planes, rows, columns = indices
            _, height, width = self.file_shape
            if (
                self.axes == (0, 1, 2)
                and (np.diff(planes) == 1).all()
                and np.array_equal(rows, np.arange(height))
                and np.array_equal(columns, np.arange(width))
            ):
                self._fill(file, int(planes[0]) * height * width, samples.reshape(-1))
                if not self.stored.isnative:
                    samples.byteswap(inplace=True)
            else:
                self._gather(file, indices, in_file_order)
        return samples

    def _refuse_changed(self, file: io.FileIO) -> None:
        # Raise FormatError if the file has changed since it was opened: its layout may differ.
        status = os.fstat(file.fileno())
        if (status.st_size, status.st_mtime_ns) != (self.file_size, self.modified_ns):
            raise FormatError(
                f"ENVI data file {self.path!r} has changed since it was opened: found {status.st_size} bytes "
                f"of {np.datetime64(status.st_mtime_ns, 'ns')} UTC",
                expected=f"{self.file_size} bytes of {np.datetime64(self.modified_ns, 'ns')} UTC",
                mend="open it again",
                code="file-changed",
            )

    def _gather(self, file: io.FileIO, indices: list[Ints], out: Array) -> None:
        # Read blocks of file lines around the requested samples, and keep these samples.
        planes, rows, samples = indices
        columns = self.file_shape[2]
        # lines of the file, counted through all planes
        lines = (planes[:, np.newaxis] * self.file_shape[1] + rows).ravel()
        first, last = int(samples[0]), int(samples[-1])
        gaps = np.diff(lines) * columns - (last - first + 1)
        lines_per_box = max(1, _MAX_BOX_BYTES // (columns * self.stored.itemsize))
        is_break = (gaps * self.stored.itemsize > _MAX_GAP_BYTES) | (
            np.diff((lines - lines[0]) // lines_per_box) != 0
        )
        is_break |= np.diff(lines) < 0  # a plane that is repeated
        edges = [0, *(np.flatnonzero(is_break) + 1).tolist(), len(lines)]
        plane_and_row = np.unravel_index(np.arange(len(lines)), out.shape[:2])
        columns_kept = _selector(samples)
        for start, stop in itertools.pairwise(edges):
            first_line = int(lines[start])
            buffer = np.empty((int(lines[stop - 1]) - first_line + 1, columns), self.stored)
            buffer_part = buffer.reshape(-1)[first : (len(buffer) - 1) * columns + last + 1]
            self._fill(file, first_line * columns + first, buffer_part)
            rows = buffer if stop - start == 1 else buffer[_selector(lines[start:stop] - first_line)]
            out[plane_and_row[0][start:stop], plane_and_row[1][start:stop]] = rows[:, columns_kept]

    def _fill(self, file: io.FileIO, first: int, out: Array) -> None:
        # Read samples from number `first` on into contiguous memory, without conversion.
        view = out.view(np.uint8).data
        file.seek(self.offset + first * self.stored.itemsize)
        done = 0
        while done < len(view):
            count = file.readinto(view[done:])
            if not count:
                raise FormatError(
                    f"ENVI data file {self.path!r} ends {len(view) - done} bytes early",
                    expected=f"{self.file_size} bytes, as when it was opened",
                    mend="open it again",
                    code="file-truncated",
                )
            done += count


def _positions(index: Any, size: int) -> Ints:
    if isinstance(index, int | np.integer):
        return np.array([index], dtype=np.int64)
    if isinstance(index, slice):
        return np.arange(*index.indices(size), dtype=np.int64)
    return np.asarray(index, dtype=np.int64)


def _selector(positions: Ints) -> slice | Ints:
    # Return a slice for evenly spaced positions, which avoids a copy.
    steps = np.diff(positions)
    if len(steps) == 0:
        return slice(int(positions[0]), int(positions[0]) + 1)
    if steps[0] > 0 and (steps == steps[0]).all():
        return slice(int(positions[0]), int(positions[-1]) + 1, int(steps[0]))
    return positions
