"""Compute blocks on threads or a cluster; errors name the block, a bar shows the progress.

A cluster repeats a task whose worker died, and up to `RETRIES` times a task that raised an error, since a
file system shared by many nodes may fail for a moment. The result of a block is fetched as soon as it is
computed, so that a worker that dies loses only its current blocks.

The disk of a store: free space, files that survive a power failure, exchange of two folders in one step.

The kernel keeps written files in memory for about half a minute. All files and folders of a group are
therefore flushed before it is published. The disk begins to write every chunk at once, so that the final
flush is short.

Chunk files of a group under construction: written from dask blocks, resumed by the next run.

A chunk file ends with the crc32c of all bytes before it, and gets its name when it is complete. A power
failure may leave it empty, so that the next run keeps only chunks with a valid checksum.

Layout on disk: chunks, codec, fill values and encodings of every variable.

All groups have the same rule, so that a chunk of `xarray.open_zarr` is the chunk of one task:

* an array along the flight (`along_track` and one or more further dims) has chunks of 32 lines; with
  `"explore"`, of 32 lines and a group of bands; with `"web"`, of small tiles;
* a map (`y`, `x`, ...) has tiles of 128 x 128 cells with all bands;
* means of blocks of a line (`coarse_y`, ...), for display, have chunks of 128 rows and a group of bands;
* any other array is one chunk, unless it is larger than 64 MiB.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import contextvars
import ctypes
import errno
import functools
import itertools
import math
import os
import shutil
import stat
import sys
import threading
import time
import traceback
import uuid
from collections.abc import Callable, Collection, Generator, Hashable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Literal, NoReturn, TypeVar, get_args

import numpy as np
import xarray as xr

from hyperpaint.base import (
    ALONG_TRACK,
    BAND,
    CHUNK_LINES,
    CROSS_TRACK,
    DEFAULT_CODEC,
    TIME_UNITS,
    PaintError,
    Problems,
    StoreError,
    documented,
    grouped,
    one_of,
)

from .budget import MARGIN, client_in_force, scheduler_in_force, size_text, thread_space
from .manifest import Location, replace_file, sync

# Cells along each side of a map tile: 18 MB of float32 at 272 bands.
TILE = 128

CHUNKING = SimpleNamespace(
    # Maximum size of an array without lines that is stored as one chunk [byte].
    largest_single_chunk=64 * 2**20,
    # Size of the chunks of a larger array [byte].
    split_chunk=16 * 2**20,
    #: Fill value of integers: larger than all 12- and 14-bit counts; as quality it sets every flag.
    integer_fill=65535,
    band_groups=8,
)


# A chunk of a cube holds all bands ("cube"), so that one task computes on one chunk; an eighth of them
# ("explore"), so that a picture of one band reads an eighth; or all bands of a few pixels ("web"), so that a
# spectrum reads little.
Layout = Literal["cube", "explore", "web"]


# Side of a tile of the web layout [pixel]: 280 kB of float32 at 272 bands; 130 kB of flags.
WEB_CUBE, WEB_PLANE = 16, 256

# Samples are shuffled before lz4 by bits (smallest) or by bytes (in half the time).
Codec = Literal["compact", "fast"]

_SHUFFLES: Mapping[Codec, tuple[str, int]] = {"compact": ("bitshuffle", 2), "fast": ("shuffle", 1)}
_LZ4 = {"cname": "lz4", "clevel": 5}
# By kind of dtype. NaN needs no `_FillValue`, for which readers would search all values.
_ENCODINGS: Mapping[str, Mapping[str, Any]] = {
    "f": {"_FillValue": None},
    "c": {"_FillValue": None},
    "M": {"units": TIME_UNITS, "dtype": "int64"},
    "m": {"units": "nanoseconds", "dtype": "int64"},
}


def storage_chunks(
    dims: Sequence[Hashable], shape: Sequence[int], itemsize: int, layout: Layout = "cube"
) -> tuple[int, ...]:
    """Return the storage chunk of an array, each size at least 1; ``itemsize``: bytes of one sample.

    Examples
    --------
    >>> storage_chunks(("along_track", "band", "cross_track"), (2000, 272, 640), 2)
    (32, 272, 640)
    >>> storage_chunks(("along_track", "band", "cross_track"), (2000, 272, 640), 2, "explore")
    (32, 34, 640)
    >>> storage_chunks(("along_track", "band", "cross_track"), (2000, 272, 640), 4, "web")
    (16, 272, 16)
    >>> storage_chunks(("band", "cross_track"), (272, 640), 4)
    (272, 640)
    """
    sizes = dict(zip(dims, shape, strict=True))
    # maximum size of a chunk along some dims; along others it has the size of the array
    max_sizes: dict[Hashable, int] = {}
    if layout == "web" and ({ALONG_TRACK, CROSS_TRACK} <= sizes.keys() or {"y", "x"} <= sizes.keys()):
        max_sizes = dict.fromkeys(
            (ALONG_TRACK, CROSS_TRACK, "y", "x"), WEB_CUBE if BAND in sizes else WEB_PLANE
        )
    elif ALONG_TRACK in sizes and len(dims) > 1:
        max_sizes = {ALONG_TRACK: CHUNK_LINES}
        if layout == "explore" and {BAND, CROSS_TRACK} <= sizes.keys():
            max_sizes[BAND] = -(-sizes[BAND] // CHUNKING.band_groups)
    elif "coarse_y" in sizes and BAND in sizes:
        max_sizes = {"coarse_y": TILE, BAND: -(-sizes[BAND] // CHUNKING.band_groups)}
    elif "y" in sizes and "x" in sizes:
        max_sizes = {"y": TILE, "x": TILE}
    elif len(dims) > 1 and math.prod(shape) * itemsize > CHUNKING.largest_single_chunk:
        max_sizes = {dims[0]: CHUNKING.split_chunk // (math.prod(shape[1:]) * itemsize)}
    return tuple(max(1, min(size, max_sizes.get(dim, size))) for dim, size in zip(dims, shape, strict=True))


def chunks_of(variable: xr.Variable) -> tuple[int, ...]:
    # Return the storage chunk of a variable in its layout (see `with_layout`).
    itemsize = variable.dtype.itemsize if variable.dtype.kind in "biufcmM" else 1
    return storage_chunks(variable.dims, variable.shape, itemsize, variable.encoding.get(_LAYOUT, "cube"))


_LAYOUT = "hyperpaint_layout"


def layouts_of(dataset: xr.Dataset) -> dict[Hashable, Layout]:
    # Return the layouts of variables that are marked with one (see `with_layout`).
    return {name: v.encoding[_LAYOUT] for name, v in dataset.variables.items() if _LAYOUT in v.encoding}


def with_layout(dataset: xr.Dataset, layout: Layout) -> xr.Dataset:
    # Return a dataset whose variables are marked with a layout; `SchemaError` for an unknown layout.
    one_of(layout, get_args(Layout), "layout")
    marked = dataset.copy(deep=False)
    for variable in marked.variables.values():
        if layout != "cube" or _LAYOUT in variable.encoding:
            variable.encoding = {**variable.encoding, _LAYOUT: layout}
    return marked


def regroup(pieces: Sequence[int], step: int) -> tuple[int, ...]:
    """Return dask chunks along one dim that start at multiples of the storage chunk.

    Borders move down to the next multiple of ``step``, and equal borders merge; aligned chunks are returned
    unchanged. ``pieces``: dask chunks along the dim; ``step``: storage chunk along it.

    Examples
    --------
    >>> regroup((50, 50, 20), 32)
    (32, 64, 24)
    >>> regroup((8,) * 9, 32)
    (32, 32, 8)
    """
    size = sum(pieces)
    if size == 0:
        return tuple(pieces)
    borders = {0, size, *(border // step * step for border in itertools.accumulate(pieces))}
    return tuple(end - start for start, end in itertools.pairwise(sorted(borders)))


def fill_value(dtype: np.dtype[Any]) -> Any:
    # Return the value that readers get for samples of a missing chunk; if possible, no valid data has it.
    #
    # NaN for floats, NaT for times, 65535 (or the largest number of a smaller type) for integers. Booleans
    # and strings have no such value: only `hyperpaint.verify` detects their loss.
    if dtype.kind in "fc":
        return dtype.type(np.nan)
    if dtype.kind in "mM":
        return int(np.iinfo(np.int64).min)
    integer = min(CHUNKING.integer_fill, int(np.iinfo(dtype).max)) if dtype.kind in "iu" else None
    return False if dtype.kind == "b" else integer


@documented()
def encoding(dataset: xr.Dataset, codec: Codec = DEFAULT_CODEC) -> dict[Hashable, dict[str, Any]]:
    """Return the xarray encoding that `to_store` uses, for writers other than hyperpaint.

    With it, `Dataset.to_zarr` writes any Zarr v3 store (such as an icechunk session) with chunks of 32 lines,
    fill values that are not valid data, and the crc32c by which readers detect a damaged chunk; the default
    of Zarr has no checksum.

    Parameters
    ----------
    dataset
        The dataset to write; only dims, shapes and dtypes are read.
    codec

    Returns
    -------
    dict
        Variable name to encoding, for the ``encoding`` of `xarray.Dataset.to_zarr`.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> cube = xr.Dataset({"reflectance": (("along_track", "band"), np.ones((100, 4), "float32"))})
    >>> encoding(cube)["reflectance"]["chunks"]
    (32, 4)
    """
    return {name: encoding_of(variable, codec) for name, variable in dataset.variables.items()}


def encoding_of(variable: xr.Variable, codec: Codec = DEFAULT_CODEC) -> dict[str, Any]:
    # Return the xarray encoding of a variable: chunks, codec, fill value, and units of time.
    from zarr.codecs import BloscCodec, Crc32cCodec

    dtype = variable.dtype
    typesize = dtype.itemsize if dtype.kind in "biufcmM" else 1
    shuffle, _ = _SHUFFLES[codec]
    fill = fill_value(dtype)
    return {
        "compressors": (BloscCodec(typesize=typesize, shuffle=shuffle, **_LZ4), Crc32cCodec()),
        "write_empty_chunks": True,
        **({"chunks": chunks_of(variable)} if variable.ndim else {}),
        **({} if fill is None else {"fill_value": fill}),
        **_ENCODINGS.get(dtype.kind, {}),
    }


def prepare(dataset: xr.Dataset, group: str) -> xr.Dataset:
    # Return a dataset without old encodings, with strings as objects and aligned dask chunks.
    #
    # StoreError if names, dtypes or attributes cannot be stored; all are listed.
    import dask.array as da

    with Problems(f"the dataset cannot be stored as group {'/' + group!r}", StoreError) as problems:
        for owner, attrs in {
            "the dataset": dataset.attrs,
            **{f"{name!r}": variable.attrs for name, variable in dataset.variables.items()},
        }.items():
            for key, value in attrs.items():
                problems.add_if(
                    not isinstance(key, str) or not _is_plain(value),
                    f"attribute {key!r} of {owner} is a {type(value).__name__}",
                    expected="text, numbers, lists or dicts of them",
                    mend="write times as ISO text",
                    code="attribute-type",
                )
        for name, variable in dataset.variables.items():
            problems.add_if(
                not isinstance(name, str) or not name or "/" in name or name.startswith((".", "__")),
                f"variable name {name!r}",
                expected="text without '/' that does not start with '.' or '__'",
                code="variable-name",
            )
            if variable.dtype.kind not in "biufcmMUOT":
                problems.add(
                    f"{name!r} has dtype {variable.dtype}",
                    expected="numbers, booleans, times or text",
                    code="type-wrong",
                )
            elif variable.dtype.kind == "O" and variable._in_memory:
                other_types = {
                    type(item).__name__ for item in np.ravel(variable.values) if not isinstance(item, str)
                }
                problems.add_if(
                    other_types,
                    f"{name!r} contains Python objects ({', '.join(sorted(other_types))})",
                    expected="text, or a numeric dtype",
                    code="type-wrong",
                )
        multi = xr.indexes.PandasMultiIndex
        for name in sorted(
            {str(index.dim) for index in dataset.xindexes.values() if isinstance(index, multi)}
        ):
            problems.add(
                f"{name!r} has a multi-index",
                mend=f"call .reset_index({name!r}) first",
                code="index-multiple",
            )
    layouts = layouts_of(dataset)
    prepared = dataset.drop_encoding()
    replaced = {}
    for name, variable in prepared.variables.items():
        if name in layouts:
            variable.encoding = {_LAYOUT: layouts[name]}
        if variable.dtype.kind in "UT":
            # the Zarr v3 specification has no fixed-length text
            replaced[name] = variable.astype(object)
        elif is_at_hand(variable) and isinstance(variable.data, da.Array) and variable.size:
            # let dask chunks begin at storage chunks
            chunks = tuple(
                regroup(pieces, step) if step < size else (size,)
                for pieces, step, size in zip(
                    variable.data.chunks, chunks_of(variable), variable.shape, strict=True
                )
            )
            if chunks != variable.data.chunks:
                replaced[name] = variable.copy(data=variable.data.rechunk(chunks))
    return with_variables(prepared, replaced, prepared.coords)


def with_variables(
    dataset: xr.Dataset, variables: Mapping[Any, xr.Variable], coords: Collection[Hashable]
) -> xr.Dataset:
    # Return a dataset with variables added or replaced; names in ``coords`` become coordinates.
    return dataset.assign_coords({n: v for n, v in variables.items() if n in coords}).assign(
        {name: variable for name, variable in variables.items() if name not in coords}
    )


def is_at_hand(variable: xr.Variable) -> bool:
    # Return whether access to ``variable.data`` reads no file.
    import dask

    return dask.is_dask_collection(variable) or bool(variable._in_memory)


def _is_plain(value: Any, depth: int = 0) -> bool:
    if isinstance(value, np.ndarray):
        return value.dtype.kind in "biufU"
    if isinstance(value, Mapping):
        return depth <= 20 and all(isinstance(k, str) and _is_plain(v, depth + 1) for k, v in value.items())
    if isinstance(value, list | tuple):
        return depth <= 20 and all(_is_plain(item, depth + 1) for item in value)
    return value is None or isinstance(value, str | bool | int | float | np.bool | np.integer | np.floating)


@functools.cache
def blosc_encoder(typesize: int, shuffle: int) -> Callable[[np.ndarray[Any, Any]], bytes]:
    # Function that encodes an array as a blosc frame, by the package ``blosc`` or else numcodecs.
    # Both write the same bytes; ``blosc`` uses faster instructions of new processors. Tasks run in parallel,
    # so that an encoder has one thread.
    import numcodecs.blosc

    try:
        import blosc
    except ImportError:
        numcodecs.blosc.use_threads = False
        encode: Callable[[np.ndarray[Any, Any]], bytes]
        encode = numcodecs.blosc.Blosc(shuffle=shuffle, typesize=typesize, **_LZ4).encode
        return encode
    blosc.set_nthreads(1)
    blosc.set_releasegil(True)

    def frame(block: np.ndarray[Any, Any]) -> bytes:
        return bytes(blosc.compress_ptr(block.ctypes.data, block.size, typesize, shuffle=shuffle, **_LZ4))

    return frame


def encode_chunk(
    block: np.ndarray[Any, Any], chunk: tuple[int, ...], fill: Any, codec: Codec = DEFAULT_CODEC
) -> tuple[bytes, bytes]:
    # Return the bytes of a storage chunk on disk: the blosc frame, and the crc32c after it.
    #
    # The bytes equal those of zarr-python with the codecs of `encoding_of`, whose copies and event loop take
    # as much time as the compression. ``block`` is C-contiguous and little-endian; at the far edge of an
    # array, where it is smaller than ``chunk``, it is padded with ``fill``.
    import google_crc32c

    if block.shape != chunk:
        padded = np.full(chunk, fill, dtype=block.dtype)
        padded[tuple(slice(0, size) for size in block.shape)] = block
        block = padded
    encoded = blosc_encoder(block.dtype.itemsize, _SHUFFLES[codec][1])(block)
    return encoded, int(google_crc32c.value(encoded)).to_bytes(4, "little")


if TYPE_CHECKING:
    import dask.array as da
    from distributed import Client


# Disk space of a cube beyond the bits that vary, relative to its size in memory: headers, and constant bits
# that do not compress completely. White noise of 12 bits in uint16 took 0.76, of 16 bits 1.00.
NOISE_SHARE = 0.03

_SIGN_AND_EXPONENT = 9

# Minimum disk space of a file or folder [byte]; a chunk has a file and two folders.
_BLOCK = 4096

RUN_AGAIN = "run again: finished chunks are kept"
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def disk_needed(dataset: xr.Dataset, codec: Codec = DEFAULT_CODEC) -> int:
    """Return the disk space of a group if all its data were noise, margin included [byte].

    Only the bits of a sample that vary count: those up to the saturation of the counts, and sign, exponent
    and rounded mantissa of a float; ``"fast"``, which shuffles bytes, needs complete bytes. Other data take
    less: real counts of 12 bits about half.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> cube = (("along_track", "band", "cross_track"), np.zeros((640, 272, 640), "uint16"))
    >>> disk_needed(xr.Dataset({"counts": cube})) // 10**6
    245
    """
    total, blocks = 0.0, 16
    for name, variable in dataset.variables.items():
        # bits of a sample, and those that vary
        bits = varying = 8 * int(variable.dtype.itemsize)
        saturation = dataset.variables.get("saturation_count") if name == "counts" else None
        if variable.dtype.kind == "f" and bits == 32 and "keep_bits" in variable.attrs:
            varying = min(bits, _SIGN_AND_EXPONENT + int(variable.attrs["keep_bits"]))
        elif saturation is not None and saturation._in_memory and saturation.size == 1:
            varying = min(bits, math.ceil(math.log2(max(2.0, float(saturation.values.item()) + 1))))
        varying = -(-varying // 8) * 8 if codec == "fast" else varying
        total += variable.nbytes * (min(1.0, varying / bits + NOISE_SHARE) if bits else 1.0)
        # files and folders of chunks
        grid = zip(variable.shape, chunks_of(variable), strict=True)
        blocks += 4 * math.prod(-(-size // step) for size, step in grid) + 4
    return int(MARGIN * total) + blocks * _BLOCK


def check_disk(store: Path, needed: int, begun: Iterable[Path] = ()) -> None:
    # Raise StoreError if the disk of a store has less free space than ``needed`` bytes.
    #
    # The store and its parent folders may be missing. ``begun``: folders of an interrupted run that this run
    # resumes; their size is subtracted.
    free, missing = _free(store), needed
    for file in (file for folder in begun for file in folder.rglob("*")):
        with contextlib.suppress(OSError):  # another run may remove it
            missing -= file.stat().st_size if file.is_file() else 0
    if free is not None and missing > free:
        raise StoreError(
            f"cannot write {store}: {size_text(missing)} of disk are needed, {size_text(free)} are free",
            mend="free disk space or choose another disk; flight lines need a third with reflectance='none'",
            option="free disk space or choose another disk; flight lines need a third if process gets "
            "--reflectance none",
            code="disk-short",
        )


def _free(store: Path) -> int | None:
    # Free bytes of the disk of a store that may not exist yet, None if unknown
    for folder in store.absolute().parents:
        with contextlib.suppress(OSError):
            return shutil.disk_usage(folder).free
    return None


@contextlib.contextmanager
def errors_of_the_system(location: Location, groups: Mapping[str, xr.Dataset]) -> Iterator[None]:
    # Raise a StoreError with a remedy for a full disk, exhausted memory and unusable files.
    def needs() -> str:
        needed = size_text(sum(map(disk_needed, groups.values())))
        free = None if location.local is None else _free(location.local)
        available = "" if free is None else f", {size_text(free)} are free now"
        return f"{', '.join(f'/{group}' for group in groups)} may take {needed} in all{available}"

    try:
        yield
    except PaintError as error:
        cause = error.__cause__  # the error of a block, which names the block
        if isinstance(cause, OSError) and cause.errno in _FULL:
            raise StoreError(
                f"{error.problem.found}: {needs()}",
                mend=f"free disk space, then {RUN_AGAIN}",
                code="disk-full",
            ) from cause
        raise
    except OSError as error:
        found, file = f"cannot write {location.url}: {error.strerror or error}", error.filename
        if error.errno in _FULL:
            raise StoreError(
                f"{found}; {needs()}", mend=f"free disk space, then {RUN_AGAIN}", code="disk-full"
            ) from error
        if isinstance(file, str | bytes) and location.local is not None:
            # a file outside the store and its staging folder is an input of the run
            store, name = os.path.abspath(location.local.parent), location.local.name
            inside = os.path.relpath(os.path.abspath(os.fsdecode(file)), store).split(os.sep)[0]
            is_input = inside not in (name, f".partial-{name}")
            found += f": {os.fsdecode(file)}, an input" if is_input else f" ({os.fsdecode(file)})"
        elif file:
            found += f" ({file})"
        raise StoreError(found, mend=f"remove the cause, then {RUN_AGAIN}", code="file-unusable") from error
    except (MemoryError, RuntimeError) as error:
        # a thread that cannot be started raises a RuntimeError
        if isinstance(error, RuntimeError) and "start new thread" not in str(error):
            raise
        raise StoreError(
            f"cannot write {location.url}: memory ran out ({str(error) or 'an allocation failed'})",
            mend="take fewer lines per dask chunk or fewer threads, end other programs, or raise the limit; "
            + RUN_AGAIN,
            code="memory-short",
        ) from error


_Item = TypeVar("_Item")
_Result = TypeVar("_Result")

# Number of files that are flushed in parallel: disks process several requests together.
_AT_ONCE = 8


def flush_group(folder: Path, expected: Iterable[Path]) -> None:
    # Flush all files of a folder, then all its folders, to the disk.
    #
    # FileNotFoundError if a file of ``expected`` is missing, since another process may have removed it.
    walked = list(os.walk(folder, topdown=False))
    files = {os.path.join(parent, name) for parent, _, names in walked for name in names}
    for path in expected:
        if os.fspath(path) not in files:
            raise FileNotFoundError(errno.ENOENT, "a finished chunk has been removed", os.fspath(path))
    at_once(sync, sorted(files), _AT_ONCE)
    at_once(sync, [parent for parent, _, _ in walked], _AT_ONCE)


def at_once(function: Callable[[_Item], _Result], items: Sequence[_Item], max_parallel: int) -> list[_Result]:
    # Return the results of a function that waits for the disk, ``max_parallel`` items in parallel.
    #
    # The items are processed one after the other if the address space is limited: a thread would reserve some
    # 70 MiB of it, which the memory plan of a run has assigned to its computing threads.
    if thread_space():
        return [function(item) for item in items]
    with ThreadPoolExecutor(max_parallel) as pool:
        return list(pool.map(function, items))


def on_workers(
    function: Callable[[_Item], _Result], items: Iterable[_Item], threads: int | None = None
) -> list[_Result]:
    # Return the results of a function for all items: on the workers of the cluster in force, else on threads.
    client = client_in_force()
    if client is not None:
        with errors_of_the_cluster("cannot read on the cluster"):
            return list(client.gather(client.map(function, list(items), pure=False, retries=RETRIES)))
    with ThreadPoolExecutor(threads or os.cpu_count()) as pool:
        return list(pool.map(function, items))


def in_parallel(function: Callable[[_Item], object], items: Sequence[_Item], most: int) -> None:
    # Call a function for all items, ``most`` at once; after an error no further calls begin. Ctrl-C also
    # cancels what the calls compute on a cluster.
    if most < 2:
        for item in items:
            function(item)
        return
    # threads see the client of their caller
    contexts = [contextvars.copy_context() for _ in items]
    with ThreadPoolExecutor(most) as pool:
        calls = [pool.submit(c.run, function, item) for c, item in zip(contexts, items, strict=True)]
        try:
            for call in concurrent.futures.as_completed(calls):
                call.result()
        except BaseException as error:
            pool.shutdown(wait=False, cancel_futures=True)
            if not isinstance(error, Exception):
                _cancel_all("the run was stopped")
            raise


_HERE = -100  # AT_FDCWD
_EXCHANGE = 2  # RENAME_EXCHANGE
#: Errors of kernels, sandboxes and file systems without this call.
_UNKNOWN = (errno.ENOSYS, errno.EINVAL, errno.EOPNOTSUPP, errno.EPERM)


def exchange(path: Path, target: Path) -> bool:
    # Exchange two existing paths in one step, as Linux can on most local disks; else return False.
    try:
        rename = ctypes.CDLL(None, use_errno=True).renameat2
    except (OSError, AttributeError, TypeError):  # not Linux
        return False
    # raise the audit event of `os.rename`
    sys.audit("os.rename", os.fspath(path), os.fspath(target), -1, -1)
    if rename(_HERE, os.fsencode(path), _HERE, os.fsencode(target), _EXCHANGE) == 0:
        return True
    code = ctypes.get_errno()
    if code in _UNKNOWN:
        return False
    raise OSError(code, os.strerror(code), os.fspath(path), None, os.fspath(target))


# --- room on the disk --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Target:
    # Stored array to which blocks are written without zarr's event loop; its pickle is small.
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
        return cls(
            place,
            name,
            tuple(map(str, variable.dims)),
            variable.shape,
            np.dtype("<i8") if variable.dtype.kind in "mM" else variable.dtype.newbyteorder("<"),
            chunks_of(variable),
            fill_value(variable.dtype),
            codec,
        )

    def key(self, position: tuple[int, ...]) -> str:
        return "/".join(("c", *map(str, position)))

    def write(
        self,
        offsets: Sequence[tuple[int, ...]],
        block: np.ndarray[Any, Any],
        block_id: tuple[int, ...] = (),
    ) -> np.ndarray[Any, Any]:
        # Write a dask block; ``offsets``: positions of the first chunks of all blocks, for every dim.
        #
        # Chunks at the far edges of the array may be incomplete. Return the crc32c of the encoded chunks
        # (uint32), in the shape of the block's grid.
        # times are stored as int64 nanoseconds
        if block.dtype.kind in "mM":
            block = block.astype(f"{block.dtype.kind}8[ns]", copy=False).view(np.int64)
        if block.dtype.newbyteorder("<") != self.dtype:
            raise TypeError(f"a block of {self.name} has dtype {block.dtype}, expected {self.dtype}")
        block = block.astype(self.dtype, copy=False)
        offset = [starts[i] for starts, i in zip(offsets, block_id, strict=True)]
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

    has_blocks = variable.dtype.kind in "biufcmM" and variable.ndim and variable.size
    return bool(has_blocks and (dask.is_dask_collection(variable) or chunks_of(variable) != variable.shape))


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
        functools.partial(target.write, offsets),
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
    is_resized = decoded_bytes is not None and int.from_bytes(body[4:8], "little") != decoded_bytes
    return None if is_resized else stored


def is_mendable(error: BaseException) -> bool:
    # Return whether the same run may succeed later, so that its finished chunks are kept.
    #
    # That is so after an interruption, a full disk or memory, or lost workers. An error in the data would
    # occur again.
    if isinstance(error, PaintError):
        return error.__cause__ is not None and is_mendable(error.__cause__)
    is_of_cluster = type(error).__module__.partition(".")[0] == "distributed"
    return is_of_cluster or not isinstance(error, Exception) or isinstance(error, OSError | MemoryError)


# --- chunks ------------------------------------------------------------------------------------------------

# Number of times a cluster repeats a task that raised an error.
RETRIES = 3

SAME_FILES = "; every worker must see the same files, under the same paths"
_CANCELLED = (asyncio.CancelledError, concurrent.futures.CancelledError)

Key = Any  # Of dask: a text, or a tuple of a name and numbers
Results = Generator[tuple[Key, Any], None, None]


@dataclass(frozen=True)
class _Block:
    array: str
    sums: tuple[slice, ...]  # Its region in the checksums of the array
    words: str  # Description of its lines, for messages
    stage: int  # Stages are computed one after the other


def compute(
    lazy: Mapping[str, da.Array],
    targets: Mapping[str, Target],
    *,
    group: str,
    progress: bool,
    get: Callable[..., Any] | None = None,
) -> dict[str, np.ndarray[Any, Any]]:
    # Compute lazy checksums (`chunks.lazy_checksums`) together, so that tasks of two arrays run once.
    #
    # ``get``: scheduler of dask, by default the one in force.
    #
    # Raises `StoreError`: A block could not be read, computed or written, or the cluster was lost; the
    # message names group and block. Other errors of a task are raised unchanged, with a note that names it.
    from dask.array.core import slices_from_chunks
    from dask.highlevelgraph import HighLevelGraph

    if not lazy:
        return {}
    # stages of a map are rows of tiles, or columns if it is wider than high
    maps = [name for name in lazy if targets[name].dims[:2] == ("y", "x")]
    axis = int(bool(maps) and targets[maps[0]].shape[1] > targets[maps[0]].shape[0])
    size = max((max(lazy[name].chunks[axis]) * targets[name].chunk[axis] for name in maps), default=1)
    blocks: dict[Key, _Block] = {}
    for name, array in lazy.items():
        target = targets[name]
        plural = "lines" if target.dims[0] == ALONG_TRACK else target.dims[0]
        for index, region in zip(np.ndindex(array.numblocks), slices_from_chunks(array.chunks), strict=True):
            start = region[0].start * target.chunk[0]
            end = min(region[0].stop * target.chunk[0], target.shape[0]) - 1
            stage = region[axis].start * target.chunk[axis] // size if name in maps else 0
            blocks[(array.name, *index)] = _Block(name, region, f"{plural} {start} to {end} of {name}", stage)
    arrays = list(lazy.values())
    merged = HighLevelGraph.merge(*(array.__dask_graph__() for array in arrays))
    # the arrays are optimised together, so that dask does not fuse a shared task into both
    graph = dict(arrays[0].__dask_optimize__(merged, list(blocks)))
    sums = {name: np.empty(array.shape, array.dtype) for name, array in lazy.items()}
    client = client_in_force() if get is None else None
    with contextlib.ExitStack() as stack:
        bar = stack.enter_context(BlockBar(len(blocks))) if progress else None
        results = (
            _on_threads(get or scheduler_in_force(), graph, blocks, group, bar, is_worker=get is not None)
            if client is None
            else _on_cluster(client, graph, blocks, group, bar)
        )
        stack.enter_context(contextlib.closing(results))
        for key, value in results:
            sums[blocks[key].array][blocks[key].sums] = value
    return sums


@contextlib.contextmanager
def errors_of_the_cluster(subject: str) -> Iterator[None]:
    # Raise a StoreError for lost workers or a lost scheduler; ``subject`` begins the message.
    try:
        yield
    except (Exception, *_CANCELLED) as error:
        reason = _cluster_failure(error)
        if reason is None:
            raise
        raise StoreError(f"{subject}: {reason}", mend=RUN_AGAIN, code="cluster-lost") from error


def _on_threads(
    get: Any,
    graph: dict[Key, Any],
    blocks: Mapping[Key, _Block],
    group: str,
    bar: BlockBar | None,
    *,
    is_worker: bool,
) -> Results:
    # Keys and checksums, stage by stage; ``get``: scheduler of dask in this process
    from dask.callbacks import Callback
    from dask.core import get_deps
    from dask.local import execute_task

    def count(key: Any, *_: Any) -> None:
        if bar is not None and key in blocks:
            bar.advance()

    try:
        # not without a bar: callbacks are those of the process, and threads of a worker would mix them up
        with contextlib.nullcontext() if bar is None else Callback(posttask=count):
            yield from in_stages(get, graph, {key: block.stage for key, block in blocks.items()})
    except Exception as error:
        # find the blocks that depend on the failed task
        frames = [frame for frame, _ in traceback.walk_tb(error.__traceback__)]
        pending = [frame.f_locals.get("key") for frame in frames if frame.f_code is execute_task.__code__]
        _, dependents = get_deps(graph)
        affected: set[Any] = set()
        while pending:
            key = pending.pop()
            if key not in affected:
                affected.add(key)
                pending.extend(dependents.get(key, ()))
        hint = SAME_FILES if is_worker and isinstance(error, FileNotFoundError | PermissionError) else ""
        _raise_named(error, group, [block for key, block in blocks.items() if key in affected], hint)


#: Futures by key, of every group that is being written, so that another thread can cancel them.
_running: contextvars.ContextVar[dict[int, dict[Key, Any]]] = contextvars.ContextVar("running")
#: Time without any worker after which a write gives up [s]; workers of cloud services start within minutes.
LOST_WAIT = 300.0


def _cancel_all(reason: str, own: Client | None = None) -> None:
    # Cancel the writes that run, and all that a client of our own waits for
    for futures_by_key in list(_running.get({}).values()):
        with contextlib.suppress(Exception):  # the scheduler may be lost
            futures = list(futures_by_key.values())
            futures[0].client.cancel(futures, force=True, reason=reason)
    if own is not None:
        from distributed import Future

        with contextlib.suppress(Exception):
            own.cancel([Future(key, own) for key in list(own.futures)], force=True, reason=reason)


@contextlib.contextmanager
def watched(client: Client | None, *, is_own: bool = False) -> Iterator[None]:
    # Cancel the writes inside once a cluster has had no worker for `LOST_WAIT`: they would never end.
    # Of a client of our own everything is cancelled, also what only reads or computes.
    if client is None:
        yield
        return
    is_over, token = threading.Event(), _running.set({})

    def watch() -> None:
        last_seen = time.monotonic()
        while not is_over.wait(min(5.0, LOST_WAIT)):
            with contextlib.suppress(Exception):  # the scheduler may be lost
                if client.nthreads():
                    last_seen = time.monotonic()
            if time.monotonic() - last_seen > LOST_WAIT:
                _cancel_all(
                    f"the cluster has had no worker for {LOST_WAIT:.0f} s", client if is_own else None
                )

    watcher = threading.Thread(target=contextvars.copy_context().run, args=(watch,), daemon=True)
    watcher.start()
    try:
        yield
    finally:
        is_over.set()
        _running.reset(token)


@contextlib.contextmanager
def _cancelled_at_the_end(futures: Iterable[Any]) -> Iterator[dict[Key, Any]]:
    # Futures by key; those that are left at the end are cancelled. A traceback keeps the futures of failed
    # tasks, and the next run would get them.
    futures_by_key = {future.key: future for future in futures}
    running = _running.get({})  # empty outside `watched`
    running[id(futures_by_key)] = futures_by_key
    try:
        yield futures_by_key
    finally:
        del running[id(futures_by_key)]
        if futures_by_key:
            with contextlib.suppress(Exception):  # the scheduler may be lost
                rest = list(futures_by_key.values())
                rest[0].client.cancel(rest, force=True)


def on_one_worker(function: Callable[..., _Result], *arguments: Any, group: str) -> _Result:
    # Return the result of a function that writes a group as one task of the cluster in force.
    client = client_in_force()
    assert client is not None
    future = client.submit(function, *arguments, pure=False, retries=RETRIES)
    with errors_of_the_cluster(f"cannot store /{group}"), _cancelled_at_the_end([future]) as running:
        result: _Result = future.result()
        running.clear()
    return result


def _on_cluster(
    client: Client, graph: dict[Key, Any], blocks: Mapping[Key, _Block], group: str, bar: BlockBar | None
) -> Results:
    from distributed import as_completed

    with errors_of_the_cluster(f"cannot store /{group}"):
        futures = client.get(graph, list(blocks), sync=False, retries=RETRIES)
    with _cancelled_at_the_end(futures) as futures_by_key:
        del futures
        for future, result in as_completed(futures_by_key.values(), with_results=True, raise_errors=False):
            # the future's status may have changed since the result was fetched, if its worker died
            if isinstance(result, tuple | BaseException):
                # the error of a task is a tuple with type and traceback, a cancellation is an exception
                error = result[1] if isinstance(result, tuple) else result
                hint = SAME_FILES if isinstance(error, FileNotFoundError | PermissionError) else ""
                _raise_named(error, group, [blocks[future.key]], hint)
            # released, so that a worker that dies loses no finished block
            del futures_by_key[future.key]
            if bar is not None:
                bar.advance()
            yield future.key, result


def in_stages(
    get: Callable[..., Any], graph: Mapping[Key, Any], stage_of: Mapping[Key, int]
) -> Iterator[tuple[Key, Any]]:
    """Yield the keys of a graph in ``stage_of`` and their values, stage by stage.

    If one task computes several variables of a map, dask computes the variables one after another, and
    keeps all slabs of the flight line in memory until the last. Here the tiles of one row (or of one
    column, if a map is wider than high) are a stage. Results that a later stage needs are passed on, so
    that every task runs once.

    ``get``: scheduler of dask; ``stage_of``: stages by key.

    Examples
    --------
    >>> from operator import add
    >>> graph = {"slab": 1, "first": (add, "slab", 1), "second": (add, "slab", 2)}
    >>> import dask
    >>> dict(in_stages(dask.get, graph, {"first": 0, "second": 1}))
    {'first': 2, 'second': 3}
    """
    if len(set(stage_of.values())) < 2:
        keys = list(stage_of)
        yield from zip(keys, get(dict(graph), keys), strict=True)
        return
    from dask._task_spec import DataNode
    from dask.core import get_deps

    dependencies, dependents = get_deps(dict(graph))
    # first and last stage that needs the value of a key
    first_stage: dict[Key, int] = {}
    for target, stage in sorted(stage_of.items(), key=lambda item: item[1]):
        pending = [target]
        while pending:
            key = pending.pop()
            if key not in first_stage:
                first_stage[key] = stage
                pending.extend(dependencies[key])
    last_stage = {
        key: max(
            (first_stage[dependent] for dependent in dependents[key] if dependent in first_stage), default=0
        )
        for key in first_stage
    }
    by_stage = grouped((stage, key) for key, stage in first_stage.items())
    carried: dict[Key, Any] = {}
    for stage in sorted(by_stage):
        tasks = by_stage[stage]
        targets = [key for key in tasks if key in stage_of]
        shared = [key for key in tasks if last_stage[key] > stage]
        values = get({key: graph[key] for key in tasks} | carried, [*targets, *shared])
        yield from zip(targets, values, strict=False)
        carried = {key: node for key, node in carried.items() if last_stage[key] > stage}
        carried |= {
            key: DataNode(key, value) for key, value in zip(shared, values[len(targets) :], strict=True)
        }
        del values


def _cluster_failure(error: BaseException) -> str | None:
    # Description of a failure of the cluster, None for other errors
    if type(error).__name__ == "KilledWorker":
        times = getattr(error, "allowed_failures", 0) + 1
        worker = getattr(getattr(error, "last_worker", None), "address", "unknown")
        workers = "a worker" if times == 1 else f"{times} workers"
        return f"{workers} died during it, last {worker}; see its log; most often memory is too small"
    if isinstance(error, _CANCELLED):
        reason = getattr(error, "reason", error)
        return "the scheduler was lost" if "connection" in str(reason) else f"it was cancelled ({reason})"
    is_lost = type(error).__module__.partition(".")[0] == "distributed"
    return f"the cluster was lost ({type(error).__name__}: {error})" if is_lost else None


def _raise_named(error: BaseException, group: str, blocks: Sequence[_Block], hint: str = "") -> NoReturn:
    # Raise a task's error with the names of its blocks; an error of system, memory or cluster as StoreError.
    # A task that several blocks of an array need is named by its group only.
    words = dict.fromkeys(block.words for block in blocks)
    is_one_each = 0 < len(words) == len({block.array for block in blocks})
    subject = f"/{group}, {' and '.join(words)}" if is_one_each else f"/{group}"
    reason = _cluster_failure(error)
    if reason is None and not isinstance(error, PaintError) and isinstance(error, OSError | MemoryError):
        reason = f"{type(error).__name__}: {error}{hint}"
    if reason is None:
        error.add_note(f"while storing {subject}")
        raise error
    raise StoreError(f"cannot store {subject}: {reason}", mend=RUN_AGAIN, code="block-failed") from error


_WIDTH = 40
_MIN_SHARE = 0.02  # share finished before the remaining time is estimated


class BlockBar:
    # A progress bar on stdout for ``total`` blocks, in dask's style, with the remaining time.
    def __init__(self, total: int) -> None:
        self._total, self._done, self._shown = total, 0, 0
        self._begun = time.perf_counter()

    def __enter__(self) -> BlockBar:
        self.advance(0)
        return self

    def __exit__(self, *_: object) -> None:
        sys.stdout.write("\n")  # an error is reported below the bar
        sys.stdout.flush()

    def advance(self, blocks: int = 1) -> None:
        # Count finished blocks, and draw.
        from dask.utils import format_time

        self._done += blocks
        elapsed = time.perf_counter() - self._begun
        share = self._done / max(self._total, 1)
        bar, percent = "#" * int(_WIDTH * share), int(100 * share)
        text = f"[{bar:<{_WIDTH}}] | {percent}% Completed | {format_time(elapsed)}"
        if _MIN_SHARE <= share < 1.0:
            text += f", {format_time(elapsed / share - elapsed).strip()} left"
        # blanks first, to erase the end of a longer text
        sys.stdout.write("\r" + " " * self._shown + "\r" + text)
        sys.stdout.flush()
        self._shown = len(text)
