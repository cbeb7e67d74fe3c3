"""Chunk files of a group under construction: written from dask blocks, resumed by the next run.

A chunk file ends with the crc32c of all bytes before it, and gets its name when it is complete. A power
failure may leave it empty, so that the next run keeps only chunks with a valid checksum.
"""

from __future__ import annotations

import functools
import itertools
import math
import os
import stat
import uuid
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from hyperpaint.base.constants import DEFAULT_CODEC
from hyperpaint.base.errors import PaintError

from .disk import at_once
from .layout import Codec, chunks_of, encode_chunk, fill_value
from .location import Location, replace_file

if TYPE_CHECKING:
    import dask.array as da


@dataclass(frozen=True)
class Target:
    """Stored array to which blocks are written without zarr's event loop; its pickle is small."""

    place: Location  # Of the group
    name: str
    dims: tuple[str, ...]
    shape: tuple[int, ...]
    dtype: np.dtype[Any]  # On disk
    chunk: tuple[int, ...]  # Storage chunk
    fill: Any  # Pads edge chunks
    codec: Codec = DEFAULT_CODEC

    @classmethod
    def of(cls, name: str, variable: xr.Variable, place: Location, codec: Codec) -> Target:
        dtype = np.dtype("<i8") if variable.dtype.kind in "mM" else variable.dtype.newbyteorder("<")
        return cls(
            place,
            name,
            tuple(map(str, variable.dims)),
            variable.shape,
            dtype,
            chunks_of(variable),
            fill_value(variable.dtype),
            codec,
        )

    def key(self, position: tuple[int, ...]) -> str:
        return "/".join(("c", *map(str, position)))

    def write(self, block: np.ndarray[Any, Any], offset: tuple[int, ...]) -> np.ndarray[Any, Any]:
        # Write a block of chunks, whose first has the position ``offset`` in the grid of chunks.
        #
        # Chunks at the far edges of the array may be incomplete. Return the crc32c of the encoded chunks
        # (uint32), in the shape of the block's grid.
        # times are stored as int64 nanoseconds
        if block.dtype.kind in "mM":
            block = block.astype(f"{block.dtype.kind}8[ns]", copy=False).view(np.int64)
        if block.dtype.newbyteorder("<") != self.dtype:
            raise TypeError(f"a block of {self.name} has dtype {block.dtype}, expected {self.dtype}")
        block = block.astype(self.dtype, copy=False)
        grid = tuple(-(-size // step) for size, step in zip(block.shape, self.chunk, strict=True))
        sums = np.empty(grid, dtype=np.uint32)
        for index in np.ndindex(grid):
            region = tuple(slice(i * step, (i + 1) * step) for i, step in zip(index, self.chunk, strict=True))
            samples = np.ascontiguousarray(block[region])
            position = tuple(start + step for start, step in zip(offset, index, strict=True))
            encoded, checksum = encode_chunk(samples, self.chunk, self.fill, self.codec)
            sums[index] = int.from_bytes(checksum, "little")
            key = self.key(position)
            if self.place.local is None:
                self.place.fs.pipe_file(self.place.key(self.name, key), encoded + checksum)
            else:
                write_chunk(self.place.local / self.name, key, [encoded, checksum])
        return sums


def write_chunk(folder: Path, key: str, parts: Sequence[bytes]) -> None:
    # without parents=True, so that a task that runs after its run cannot create the array's folder again
    for parent in reversed((folder / key).relative_to(folder).parents[:-1]):
        (folder / parent).mkdir(exist_ok=True)
    replace_file(folder / key, parts, durable=False)


def is_streamed(variable: xr.Variable) -> bool:
    # Return whether a variable is written block by block; xarray writes small variables.
    import dask

    if variable.dtype.kind not in "biufcmM" or not variable.ndim or not variable.size:
        return False
    return dask.is_dask_collection(variable) or chunks_of(variable) != variable.shape


def placeholder(variable: xr.Variable) -> xr.Variable:
    # Return a variable of the same shape and dtype, for xarray to write metadata; it is never computed.
    import dask.array as da

    chunks = tuple((size,) for size in variable.shape)
    return variable.copy(data=da.Array({}, f"placeholder-{uuid.uuid4().hex}", chunks, dtype=variable.dtype))


def lazy_checksums(
    variable: xr.Variable, target: Target, finished: Mapping[tuple[int, ...], int] | None = None
) -> da.Array:
    # Return the lazy checksums of a variable's chunks; computing them stores the variable in ``target``.
    #
    # ``finished``: checksums of chunks in the store, by position in the grid; blocks of such chunks are not
    # computed.
    import dask
    import dask.array as da
    from dask.highlevelgraph import HighLevelGraph

    if dask.is_dask_collection(variable):
        data = variable.data
    else:  # in memory or in a file: a task reads one storage chunk
        data = variable.chunk(
            dict(zip(variable.dims, target.chunk, strict=True)), name=f"slabs-{uuid.uuid4().hex}"
        ).data
    offsets, grid = [], []
    for sizes, step in zip(data.chunks, target.chunk, strict=True):
        offsets.append(tuple(start // step for start in itertools.accumulate((0, *sizes[:-1]))))
        grid.append(tuple(-(-size // step) for size in sizes))
    sums = da.map_blocks(
        functools.partial(_write_block, target, offsets),
        data,
        chunks=tuple(grid),
        dtype=np.uint32,
        meta=np.empty((0,) * data.ndim, dtype=np.uint32),
        name=f"store-{uuid.uuid4().hex}",
    )
    if not finished:
        return sums
    # checksums of finished blocks replace their tasks, which dask drops
    name = f"resumed-{uuid.uuid4().hex}"
    layer: dict[tuple[Any, ...], Any] = {}
    for index in np.ndindex(sums.numblocks):
        first = tuple(starts[i] for starts, i in zip(offsets, index, strict=True))
        shape = tuple(pieces[i] for pieces, i in zip(sums.chunks, index, strict=True))
        checksums = [
            finished.get(tuple(map(sum, zip(first, step, strict=True)))) for step in np.ndindex(shape)
        ]
        layer[(name, *index)] = (sums.name, *index)
        if None not in checksums:
            layer[(name, *index)] = np.array(checksums, dtype=np.uint32).reshape(shape)
    graph = HighLevelGraph.from_collections(name, layer, dependencies=[sums])
    return da.Array(graph, name, chunks=sums.chunks, meta=sums._meta)


def _write_block(
    target: Target,
    offsets: Sequence[tuple[int, ...]],
    block: np.ndarray[Any, Any],
    block_id: tuple[int, ...] = (),
) -> np.ndarray[Any, Any]:
    # Write a dask block; ``offsets``: positions of the first chunks of all blocks, for every dim
    return target.write(block, tuple(starts[i] for starts, i in zip(offsets, block_id, strict=True)))


def adopt(leftover: Path, target: Target, finished: dict[tuple[int, ...], int]) -> None:
    # Move the chunks of an earlier run with a valid checksum into the array's folder.
    #
    # ``leftover``: folder of the array in the earlier run, which may be missing; ``finished``: gets the
    # checksums of moved chunks, by position in the grid.
    if target.place.local is None or leftover.is_symlink() or not leftover.is_dir():
        return
    folder = target.place.local / target.name
    expected = math.prod(target.chunk) * target.dtype.itemsize

    def moved(position: tuple[int, ...]) -> int | None:
        key = target.key(position)
        source = leftover / key
        try:
            if not stat.S_ISREG(os.lstat(source).st_mode):
                return None
            checksum = whole_chunk(source.read_bytes(), expected)
        except OSError:
            return None
        if checksum is not None:
            (folder / key).parent.mkdir(parents=True, exist_ok=True)
            os.replace(source, folder / key)
        return checksum

    grid = (-(-size // step) for size, step in zip(target.shape, target.chunk, strict=True))
    positions = [position for position in np.ndindex(*grid) if position not in finished]
    checksums = zip(positions, at_once(moved, positions, os.cpu_count() or 1), strict=True)
    finished.update((position, value) for position, value in checksums if value is not None)


def whole_chunk(encoded: bytes, decoded_bytes: int | None = None) -> int | None:
    """Return the crc32c at the end of a chunk, None if it differs from that of the bytes before it.

    ``decoded_bytes``: size that the blosc frame of the chunk must declare; None for any.

    Examples
    --------
    >>> whole_chunk(b"") is None, whole_chunk(bytes(20)) is None
    (True, True)
    """
    import google_crc32c

    body, stored = encoded[:-4], int.from_bytes(encoded[-4:], "little")
    if not body or int(google_crc32c.value(body)) != stored:
        return None
    if decoded_bytes is not None and int.from_bytes(body[4:8], "little") != decoded_bytes:
        return None
    return stored


def is_mendable(error: BaseException) -> bool:
    # Return whether the same run may succeed later, so that its finished chunks are kept.
    #
    # That is so after an interruption, a full disk or memory, or lost workers. An error in the data would
    # occur again.
    if isinstance(error, PaintError):
        return error.__cause__ is not None and is_mendable(error.__cause__)
    is_of_cluster = type(error).__module__.partition(".")[0] == "distributed"
    return is_of_cluster or not isinstance(error, Exception) or isinstance(error, OSError | MemoryError)
