"""The disk under a store: its free space, files that survive a power failure, folders that change places.

The kernel keeps written files in memory for half a minute or so. A group is therefore flushed, every file and
folder of it, before it is sealed and before it gets its place; chunks begin to be written as soon as they are
in their files, so that little is left to wait for at the end.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import functools
import math
import os
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from hyperpaint.base.errors import PaintError, StoreError

from .budget import MARGIN, size_text, thread_space
from .layout import Codec, chunks_of
from .location import Location, sync

if TYPE_CHECKING:
    import xarray as xr

NOISE_SHARE = 0.03
"""Share of its bytes in memory that a cube takes on disk beyond the bits that can differ: headers, and what
the compressor cannot pack. White noise of 12 bits in uint16 took 0.76, of 16 bits 1.00."""

_SIGN_AND_EXPONENT = 9

_BLOCK = 4096
"""Least room of a file or folder; a chunk is a file in two folders, with a record beside it for a while."""

RUN_AGAIN = "run again: the chunks that are finished will be taken up"
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def disk_needed(dataset: xr.Dataset, codec: Codec = "compact") -> int:
    """Return the bytes a group takes on disk at the most, margin included: as if it were all noise.

    Of a sample only the bits that can differ count: those up to the saturation of the counts, and the
    mantissa that is kept of a rounded float, in whole bytes where these are shuffled (``"fast"``). What is
    not noise takes less: real counts of 12 bits about half.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> cube = (("along_track", "band", "cross_track"), np.zeros((640, 272, 640), "uint16"))
    >>> disk_needed(xr.Dataset({"counts": cube})) // 10**6
    245
    """
    needed, blocks = 0.0, 16
    for name, variable in dataset.variables.items():
        bits = 8 * variable.dtype.itemsize
        noisy = _noise_bits(dataset, str(name))
        noisy = -(-noisy // 8) * 8 if codec == "fast" else noisy
        share = min(1.0, noisy / bits + NOISE_SHARE) if bits else 1.0
        needed += share * variable.nbytes
        grid = zip(variable.shape, chunks_of(variable), strict=True)
        chunks = math.prod(-(-size // step) for size, step in grid)
        blocks += 4 * chunks + 4
    return int(MARGIN * needed) + blocks * _BLOCK


def _noise_bits(dataset: xr.Dataset, name: str) -> int:
    """Return how many bits of each sample of a variable can differ."""
    variable = dataset.variables[name]
    bits = 8 * int(variable.dtype.itemsize)
    if variable.dtype.kind == "f" and bits == 32 and "keep_bits" in variable.attrs:
        return min(bits, _SIGN_AND_EXPONENT + int(variable.attrs["keep_bits"]))
    full = dataset.variables.get("saturation_count")
    if name == "counts" and full is not None and full._in_memory and full.size == 1:
        return min(bits, math.ceil(math.log2(max(2.0, float(full.values.item()) + 1))))
    return bits


def check_disk(store: Path, needed: int, begun: Iterable[Path] = ()) -> None:
    """Refuse a store whose disk has less free space than ``needed`` bytes, with the figures.

    Neither the store nor the folders above need exist. The size of the folders ``begun``, which an
    interrupted run left and this one takes up, is taken off.
    """
    free = _free(store)
    left = needed - sum(_size(file) for folder in begun for file in folder.rglob("*"))
    if free is not None and left > free:
        raise StoreError(
            f"cannot write {store}: {size_text(left)} of disk are needed, {size_text(free)} are free; make "
            "room, choose another disk, or leave reflectance to be computed from counts (reflectance='none')"
        )


def _free(store: Path) -> int | None:
    """Return the free bytes of the disk on which a store is, or will be; None where it is not known."""
    for folder in store.absolute().parents:
        with contextlib.suppress(OSError):
            return shutil.disk_usage(folder).free
    return None


def _size(path: Path) -> int:
    try:
        return path.stat().st_size if path.is_file() else 0
    except OSError:  # another run clears it up
        return 0


@contextlib.contextmanager
def errors_of_the_system(location: Location, groups: Mapping[str, xr.Dataset]) -> Iterator[None]:
    """Turn a full disk or memory, and files that cannot be used, into one readable error."""
    try:
        yield
    except PaintError as error:
        cause = error.__cause__  # a block's error, which names the block
        if isinstance(cause, OSError) and cause.errno in _FULL:
            raise StoreError(f"{error}; {_room(location, groups)}") from cause
        raise
    except OSError as error:
        reason = _reason(error, location, groups)
        raise StoreError(f"cannot write {location.url}: {reason} and {RUN_AGAIN}") from error
    except (MemoryError, RuntimeError) as error:
        # threads that cannot be started raise a RuntimeError
        if isinstance(error, RuntimeError) and "start new thread" not in str(error):
            raise
        raise StoreError(
            f"cannot write {location.url}: memory ran out ({str(error) or 'nothing can be allocated'}); take "
            f"fewer lines a dask chunk or fewer threads, end other programs, or raise the limit; {RUN_AGAIN}"
        ) from error


def _reason(error: OSError, location: Location, groups: Mapping[str, xr.Dataset]) -> str:
    reason = error.strerror or str(error)
    if error.errno in _FULL:
        return f"{reason}; {_room(location, groups)}"
    if error.filename and location.local is not None and not _is_beside(error.filename, location.local):
        return f"{reason}: {error.filename}, which it is made from; mend this"
    return f"{reason}{f' ({error.filename})' if error.filename else ''}; mend this"


def _room(location: Location, groups: Mapping[str, xr.Dataset]) -> str:
    """Return words for the room that groups need, and that there is."""
    needed = size_text(sum(map(disk_needed, groups.values())))
    free = None if location.local is None else _free(location.local)
    available = "" if free is None else f", {size_text(free)} are free now"
    return f"{', '.join(f'/{group}' for group in groups)} may take {needed} in all{available}; make room"


def _is_beside(file: object, store: Path) -> bool:
    """Tell whether a file is in a store or in the folder where it is staged."""
    if not isinstance(file, str | bytes):
        return False
    inside = os.path.relpath(os.path.abspath(os.fsdecode(file)), os.path.abspath(store.parent))
    return inside.split(os.sep)[0] in (store.name, f".partial-{store.name}")


_Item = TypeVar("_Item")
_Result = TypeVar("_Result")

_AT_ONCE = 8
"""Files flushed at a time: disks take several orders at once."""


def flush_group(folder: Path, expected: Iterable[Path]) -> None:
    """Flush all files of a folder, then all its folders; return when the disk has them.

    FileNotFoundError where one of the files ``expected`` is missing: another process may have removed it.
    """
    walked = list(os.walk(folder, topdown=False))
    files = {os.path.join(above, name) for above, _, names in walked for name in names}
    for path in expected:
        if os.fspath(path) not in files:
            raise FileNotFoundError(errno.ENOENT, "a finished chunk has been removed", os.fspath(path))
    at_once(sync, sorted(files), _AT_ONCE)
    at_once(sync, [above for above, _, _ in walked], _AT_ONCE)


def at_once(function: Callable[[_Item], _Result], items: Sequence[_Item], most: int) -> list[_Result]:
    """Return what a function that waits for the disk makes of every item, some at a time.

    One after the other where the address space is limited: a thread would reserve some 70 MiB of it, which
    the plan of a run has given to its computing threads.
    """
    if thread_space():
        return [function(item) for item in items]
    with ThreadPoolExecutor(most) as pool:
        return list(pool.map(function, items))


_HERE = -100  # AT_FDCWD
_EXCHANGE = 2  # RENAME_EXCHANGE
#: What kernels, sandboxes and file systems that do not know it answer.
_UNKNOWN = (errno.ENOSYS, errno.EINVAL, errno.EOPNOTSUPP, errno.EPERM)


def exchange(one: Path, other: Path) -> bool:
    """Let two existing paths change places; return False, with nothing done, where system or disk cannot.

    Linux can, on most local disks.
    """
    rename = _renameat2()
    if rename is None:
        return False
    # as `os.rename` does: this is one
    sys.audit("os.rename", os.fspath(one), os.fspath(other), -1, -1)
    if rename(_HERE, os.fsencode(one), _HERE, os.fsencode(other), _EXCHANGE) == 0:
        return True
    code = ctypes.get_errno()
    if code in _UNKNOWN:
        return False
    raise OSError(code, os.strerror(code), os.fspath(one), None, os.fspath(other))


@functools.cache
def _renameat2() -> Any:
    """Return the C library's function, None where there is none."""
    if sys.platform != "linux":
        return None
    try:
        function = ctypes.CDLL(None, use_errno=True).renameat2
    except (OSError, AttributeError):
        return None
    function.argtypes = (ctypes.c_int, ctypes.c_char_p, ctypes.c_int, ctypes.c_char_p, ctypes.c_uint)
    function.restype = ctypes.c_int
    return function
