"""The disk of a store: free space, files that survive a power failure, exchange of two folders in one step.

The kernel keeps written files in memory for about half a minute. All files and folders of a group are
therefore flushed before it is published. The disk begins to write every chunk at once, so that the final
flush is short.
"""

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
            mend="free disk space, choose another disk, or do not store reflectance (reflectance='none'), "
            "which can be computed from counts",
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
