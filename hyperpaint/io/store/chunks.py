"""Chunk files of a group under construction: written from dask blocks, taken up by the next run.

Beside every chunk file lies its record ``.<name>.done``: the chunk's key and the crc32c of its decoded
samples. It is written after the chunk and removed before the group is published. A power failure may leave
either without its content, so a chunk is taken up only where it decodes to its checksum.
"""

from __future__ import annotations

import itertools
import os
import re
import uuid
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hyperpaint.base.errors import PaintError, StoreError

from .disk import at_once
from .layout import Codec, chunks_of, encode_chunk
from .location import plain_file, replace_file
from .record import checksum

if TYPE_CHECKING:
    import dask.array as da
    import numpy as np
    import xarray as xr


@dataclass(frozen=True)
class Target:
    """A Zarr array that blocks are written to; pickles small, for processes and clusters."""

    array: Any  # The Zarr array
    folder: Path | None  # On a local disk: chunks are then encoded and written without zarr's event loop
    chunk: tuple[int, ...]  # Storage chunk
    fill: Any  # Fills what an edge chunk lacks
    codec: Codec = "compact"

    def write(self, block: np.ndarray[Any, Any], offset: tuple[int, ...]) -> np.ndarray[Any, Any]:
        """Write a block of whole chunks that starts at the chunk ``offset`` of the grid; return checksums.

        At the far edges of the array chunks may be cut. The checksums (uint32) have the shape of the block's
        grid.
        """
        import numpy as np

        block = _as_stored(block, self.array.dtype)
        grid = tuple(-(-size // step) for size, step in zip(block.shape, self.chunk, strict=True))
        sums = np.empty(grid, dtype=np.uint32)
        for index in np.ndindex(grid):
            piece = np.ascontiguousarray(block[region(index, self.chunk, block.shape)])
            sums[index] = checksum(piece)
            position = tuple(first + step for first, step in zip(offset, index, strict=True))
            if self.folder is None:
                self.array[self.region(position)] = piece
            else:
                key = self.array.metadata.encode_chunk_key(position)
                encoded = encode_chunk(piece, self.chunk, self.fill, self.codec)
                write_chunk(self.folder, key, encoded, int(sums[index]))
        return sums

    def region(self, position: tuple[int, ...]) -> tuple[slice, ...]:
        """Return the part of the array that one storage chunk holds."""
        return region(position, self.chunk, self.array.shape)


class _Slabs:
    """An array in memory or in a file, as dask slices it: by block, inside the task, without copies."""

    def __init__(self, variable: xr.Variable) -> None:
        self.variable = variable
        self.shape, self.dtype, self.ndim = variable.shape, variable.dtype, variable.ndim

    def __getitem__(self, key: Any) -> np.ndarray[Any, Any]:
        import numpy as np

        return np.asarray(self.variable[key].values)


def region(index: tuple[int, ...], chunk: tuple[int, ...], shape: tuple[int, ...]) -> tuple[slice, ...]:
    """Return the part of an array that one storage chunk holds.

    Examples
    --------
    >>> region((1, 0), (32, 5), (40, 5))
    (slice(32, 40, None), slice(0, 5, None))
    """
    return tuple(
        slice(i * step, min((i + 1) * step, size)) for i, step, size in zip(index, chunk, shape, strict=True)
    )


def is_streamed(variable: xr.Variable) -> bool:
    """Tell whether a variable is written block by block; the others are small and written by xarray."""
    import dask

    if variable.dtype.kind not in "biufcmM" or not variable.ndim or not variable.size:
        return False
    return dask.is_dask_collection(variable) or chunks_of(variable) != variable.shape


def placeholder(variable: xr.Variable) -> xr.Variable:
    """Return a variable of the same form, from which xarray makes the metadata; it is never computed."""
    import dask.array as da

    chunks = tuple((size,) for size in variable.shape)
    return variable.copy(data=da.Array({}, f"placeholder-{uuid.uuid4().hex}", chunks, dtype=variable.dtype))


def lazy_checksums(
    variable: xr.Variable, target: Target, finished: Mapping[tuple[int, ...], int] | None = None
) -> da.Array:
    """Return the checksums of a variable's chunks; to compute them is to store the variable in ``target``.

    A block of which all chunks are ``finished`` (position in the grid to checksum) is not computed.
    """
    import dask
    import dask.array as da
    import numpy as np

    data = variable.data if dask.is_dask_collection(variable) else _sliced(variable, target.chunk)
    offsets = tuple(
        tuple(start // step for start in itertools.accumulate((0, *sizes[:-1])))
        for sizes, step in zip(data.chunks, target.chunk, strict=True)
    )
    grid = tuple(
        tuple(-(-size // step) for size in sizes)
        for sizes, step in zip(data.chunks, target.chunk, strict=True)
    )
    sums = da.map_blocks(
        _Writing(target, offsets),
        data,
        chunks=grid,
        dtype=np.uint32,
        meta=np.empty((0,) * data.ndim, dtype=np.uint32),
        name=f"store-{uuid.uuid4().hex}",
    )
    return _without_finished(sums, offsets, finished) if finished else sums


def _without_finished(
    sums: da.Array, offsets: tuple[tuple[int, ...], ...], finished: Mapping[tuple[int, ...], int]
) -> da.Array:
    """Put values in the place of blocks whose chunks are finished; their tasks are then culled."""
    import dask.array as da
    import numpy as np
    from dask.highlevelgraph import HighLevelGraph

    name = f"resumed-{uuid.uuid4().hex}"
    layer: dict[tuple[Any, ...], Any] = {}
    for index in np.ndindex(sums.numblocks):
        first = tuple(starts[i] for starts, i in zip(offsets, index, strict=True))
        sizes = tuple(pieces[i] for pieces, i in zip(sums.chunks, index, strict=True))
        chunks = [finished.get(tuple(map(sum, zip(first, step, strict=True)))) for step in np.ndindex(sizes)]
        if None in chunks:
            layer[(name, *index)] = (sums.name, *index)
        else:
            layer[(name, *index)] = np.array(chunks, dtype=np.uint32).reshape(sizes)
    graph = HighLevelGraph.from_collections(name, layer, dependencies=[sums])
    return da.Array(graph, name, chunks=sums.chunks, meta=sums._meta)


def _sliced(variable: xr.Variable, chunk: tuple[int, ...]) -> da.Array:
    import dask.array as da
    import numpy as np

    return da.from_array(
        _Slabs(variable),
        chunks=chunk,
        name=f"slabs-{uuid.uuid4().hex}",
        asarray=False,
        meta=np.empty((0,) * variable.ndim, dtype=variable.dtype),
    )


class _Writing:
    """Stores blocks of one array; whole to dask, which looks for its own in arguments, tuple by tuple."""

    def __init__(self, target: Target, offsets: tuple[tuple[int, ...], ...]) -> None:
        self._target, self._offsets = target, offsets

    def __call__(self, block: np.ndarray[Any, Any], block_id: tuple[int, ...] = ()) -> np.ndarray[Any, Any]:
        offset = tuple(starts[i] for starts, i in zip(self._offsets, block_id, strict=True))
        return self._target.write(block, offset)


def _as_stored(block: np.ndarray[Any, Any], dtype: np.dtype[Any]) -> np.ndarray[Any, Any]:
    """Return a block in the dtype on disk: times as int64 nanoseconds."""
    import numpy as np

    if block.dtype.kind in "mM":
        return block.astype(f"{block.dtype.kind}8[ns]", copy=False).view(np.int64)
    if block.dtype.newbyteorder("=") != dtype.newbyteorder("="):
        raise TypeError(f"a block came as {block.dtype}, declared was {dtype}")
    return block.astype(dtype.newbyteorder("<"), copy=False)


_RECORD = re.compile(r"(\S{1,200}) ([0-9a-f]{8})\n")


def write_chunk(folder: Path, key: str, parts: Sequence[bytes], value: int) -> None:
    """Write the file ``key`` of an array's folder from ``parts``, then its record with the checksum."""
    path = folder / key
    _make_parents(folder, path)
    replace_file(path, parts, durable=False)
    replace_file(_record_of(path), [f"{key} {value:08x}\n".encode()], durable=False)


def adopt(leftover: Path, target: Target, finished: dict[tuple[int, ...], int]) -> None:
    """Move finished chunks of an earlier run's array into the array's own folder; add them to ``finished``.

    ``leftover`` need not exist; the target's metadata are already written. A chunk is added, by its position
    in the grid, once it has been read and its checksum is the recorded one.
    """
    import numpy as np

    folder, array = target.folder, target.array
    if folder is None or leftover.is_symlink() or not leftover.is_dir():
        return

    def moved(position: tuple[int, ...]) -> int | None:
        key = array.metadata.encode_chunk_key(position)
        value = recorded(leftover, key)
        if value is None:
            return None
        path = folder / key
        _make_parents(folder, path)
        try:
            os.replace(leftover / key, path)
        except FileNotFoundError:
            return None
        # the record follows before the chunk is read: after a kill in between both are taken up once more
        os.replace(_record_of(leftover / key), _record_of(path))
        try:
            computed = checksum(np.asarray(array[target.region(position)]))
        except Exception:  # a damaged chunk may raise anything that a codec raises
            computed = None
        if computed != value:
            _record_of(path).unlink()
            path.unlink()
            return None
        return value

    grid = (-(-size // step) for size, step in zip(array.shape, target.chunk, strict=True))
    positions = [position for position in np.ndindex(*grid) if position not in finished]
    checksums = zip(positions, at_once(moved, positions, os.cpu_count() or 1), strict=True)
    finished.update((position, value) for position, value in checksums if value is not None)


def is_mendable(error: BaseException) -> bool:
    """Tell whether the same run may succeed later, so that its finished chunks are worth their room.

    So it is after an interruption, a full disk or memory, or lost workers; what is wrong with the data will
    be wrong again, or come with other content.
    """
    if isinstance(error, PaintError):
        return error.__cause__ is not None and is_mendable(error.__cause__)
    lost = type(error).__module__.partition(".")[0] == "distributed"
    return lost or not isinstance(error, Exception) or isinstance(error, OSError | MemoryError)


def _record_of(path: Path) -> Path:
    return path.with_name(f".{path.name}.done")


def forget(folder: Path, key: str) -> None:
    """Drop the record of a chunk, without which it is not taken up."""
    _record_of(folder / key).unlink(missing_ok=True)


def recorded(folder: Path, key: str) -> int | None:
    """Return the recorded checksum of a chunk; None without one, or where anything is a link or a pipe."""
    record = _record_of(folder / key)
    try:
        if plain_file(str(folder), key) is None:
            return None
        if plain_file(str(folder), record.relative_to(folder).as_posix()) is None:
            return None
        with open(record, "rb") as file:
            match = _RECORD.fullmatch(file.read(300).decode("ascii", "replace"))
    except (OSError, StoreError):
        return None
    return int(match[2], 16) if match is not None and match[1] == key else None


def _make_parents(folder: Path, path: Path) -> None:
    # step by step from the array's folder: a task that outlives its failed run must not make that again
    for parent in reversed(path.relative_to(folder).parents[:-1]):
        (folder / parent).mkdir(exist_ok=True)
