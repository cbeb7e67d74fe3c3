"""The disk of a store: free space, files that survive a power failure, folders exchanged in one step.

The kernel holds written files in memory for about half a minute. All files and folders of a group are
therefore flushed before it is published. Each chunk is scheduled for writing at once, so that little is left
to wait for at the end.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import math
import os
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TypeVar

import xarray as xr

from hyperpaint.base.constants import DEFAULT_CODEC
from hyperpaint.base.errors import PaintError, StoreError

from .budget import MARGIN, size_text, thread_space
from .layout import Codec, chunks_of
from .location import Location, sync

# Disk space of a cube beyond the bits that can differ, over its size in memory: headers, and bits that do not
# compress. White noise of 12 bits in uint16 took 0.76, of 16 bits 1.00.
NOISE_SHARE = 0.03

_SIGN_AND_EXPONENT = 9

# Smallest disk space of a file or folder [byte]; a chunk takes a file and two folders.
_BLOCK = 4096

RUN_AGAIN = "run again: finished chunks are kept"
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def disk_needed(dataset: xr.Dataset, codec: Codec = DEFAULT_CODEC) -> int:
    """Return an upper bound of the bytes a group takes on disk, margin included: as if it were all noise.

    Only the bits of a sample that can differ count: those up to the saturation of the counts, and the
    mantissa bits of a rounded float, in whole bytes where these are shuffled (``"fast"``). Data that
    are not noise take less: real counts of 12 bits about half.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> cube = (("along_track", "band", "cross_track"), np.zeros((640, 272, 640), "uint16"))
    >>> disk_needed(xr.Dataset({"counts": cube})) // 10**6
    245
    """
    needed, blocks = 0.0, 16
    for name, variable in dataset.variables.items():
        # the bits of a sample that can differ
        bits = noisy = 8 * int(variable.dtype.itemsize)
        full = dataset.variables.get("saturation_count") if name == "counts" else None
        if variable.dtype.kind == "f" and bits == 32 and "keep_bits" in variable.attrs:
            noisy = min(bits, _SIGN_AND_EXPONENT + int(variable.attrs["keep_bits"]))
        elif full is not None and full._in_memory and full.size == 1:
            noisy = min(bits, math.ceil(math.log2(max(2.0, float(full.values.item()) + 1))))
        noisy = -(-noisy // 8) * 8 if codec == "fast" else noisy
        needed += variable.nbytes * (min(1.0, noisy / bits + NOISE_SHARE) if bits else 1.0)
        # files and folders of chunks
        grid = zip(variable.shape, chunks_of(variable), strict=True)
        blocks += 4 * math.prod(-(-size // step) for size, step in grid) + 4
    return int(MARGIN * needed) + blocks * _BLOCK


def check_disk(store: Path, needed: int, begun: Iterable[Path] = ()) -> None:
    """Raise StoreError if the disk of a store has less free space than ``needed`` bytes.

    Neither the store nor the folders above need exist. The size of the folders ``begun``, which an
    interrupted run left and this one resumes, is subtracted.
    """
    free, left = _free(store), needed
    for file in (file for folder in begun for file in folder.rglob("*")):
        with contextlib.suppress(OSError):  # another run clears it up
            left -= file.stat().st_size if file.is_file() else 0
    if free is not None and left > free:
        raise StoreError(
            f"cannot write {store}: {size_text(left)} of disk are needed, {size_text(free)} are free",
            mend="make room, choose another disk, or leave reflectance to be computed from counts "
            "(reflectance='none')",
            code="disk-short",
        )


def _free(store: Path) -> int | None:
    # The free bytes of the disk of a store that may not exist yet; None where unknown.
    for folder in store.absolute().parents:
        with contextlib.suppress(OSError):
            return shutil.disk_usage(folder).free
    return None


@contextlib.contextmanager
def errors_of_the_system(location: Location, groups: Mapping[str, xr.Dataset]) -> Iterator[None]:
    """Turn a full disk, exhausted memory and unusable files into one readable StoreError."""

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
                f"{error.problem.found}: {needs()}", mend=f"make room, then {RUN_AGAIN}", code="disk-full"
            ) from cause
        raise
    except OSError as error:
        found, file = f"cannot write {location.url}: {error.strerror or error}", error.filename
        if error.errno in _FULL:
            mend = f"make room, then {RUN_AGAIN}"
            raise StoreError(f"{found}; {needs()}", mend=mend, code="disk-full") from error
        if isinstance(file, str | bytes) and location.local is not None:
            # a file outside of the store and its staging folder is an input
            store, name = os.path.abspath(location.local.parent), location.local.name
            inside = os.path.relpath(os.path.abspath(os.fsdecode(file)), store).split(os.sep)[0]
            is_input = inside not in (name, f".partial-{name}")
            found += f": {os.fsdecode(file)}, an input" if is_input else f" ({os.fsdecode(file)})"
        elif file:
            found += f" ({file})"
        raise StoreError(found, mend=f"mend this, then {RUN_AGAIN}", code="file-unusable") from error
    except (MemoryError, RuntimeError) as error:
        # threads that cannot be started raise a RuntimeError
        if isinstance(error, RuntimeError) and "start new thread" not in str(error):
            raise
        raise StoreError(
            f"cannot write {location.url}: memory ran out ({str(error) or 'an allocation failed'})",
            mend="take fewer lines a dask chunk or fewer threads, end other programs, or raise the limit; "
            + RUN_AGAIN,
            code="memory-short",
        ) from error


_Item = TypeVar("_Item")
_Result = TypeVar("_Result")

# Number of files flushed at a time: disks process several requests at once.
_AT_ONCE = 8


def flush_group(folder: Path, expected: Iterable[Path]) -> None:
    """Flush all files of a folder, then all its folders, to the disk.

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
    """Return the results of a function that waits for the disk, for all items, ``most`` at a time.

    One after the other where the address space is limited: a thread would reserve some 70 MiB of it, which
    the memory plan of a run has assigned to its computing threads.
    """
    if thread_space():
        return [function(item) for item in items]
    with ThreadPoolExecutor(most) as pool:
        return list(pool.map(function, items))


_HERE = -100  # AT_FDCWD
_EXCHANGE = 2  # RENAME_EXCHANGE
#: Errors of kernels, sandboxes and file systems without this call.
_UNKNOWN = (errno.ENOSYS, errno.EINVAL, errno.EOPNOTSUPP, errno.EPERM)


def exchange(one: Path, other: Path) -> bool:
    """Exchange two existing paths in one step; return False, with nothing done, where the system cannot.

    Linux can, on most local disks.
    """
    try:
        rename = ctypes.CDLL(None, use_errno=True).renameat2
    except (OSError, AttributeError, TypeError):  # not Linux
        return False
    # raise the audit event of `os.rename`
    sys.audit("os.rename", os.fspath(one), os.fspath(other), -1, -1)
    if rename(_HERE, os.fsencode(one), _HERE, os.fsencode(other), _EXCHANGE) == 0:
        return True
    code = ctypes.get_errno()
    if code in _UNKNOWN:
        return False
    raise OSError(code, os.strerror(code), os.fspath(one), None, os.fspath(other))
