"""Disk space: whether a store has room, before it is written; and what a full disk, or memory, is told as."""

from __future__ import annotations

import contextlib
import errno
import math
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from hyperpaint.base.errors import PaintError, StoreError

from .budget import MARGIN, size_text
from .layout import storage_chunks
from .location import Location

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["check_disk", "disk_needed", "errors_of_the_system"]

NOISE_SHARE = 0.03
"""Share of its bytes in memory that a cube takes on disk beyond the bits that can differ: headers, and what
the compressor cannot pack. White noise of 12 bits in uint16 took 0.76, of 16 bits 1.00."""

_SIGN_AND_EXPONENT = 9

_BLOCK = 4096
"""Least room of a file or folder; a chunk is a file in two folders, with a record beside it for a while."""

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def disk_needed(dataset: xr.Dataset) -> int:
    """Return the bytes a group takes on disk at the most, margin included: as if it were all noise.

    Of a sample only the bits that can differ count: those up to the saturation of the counts, and the
    mantissa that is kept of a rounded float. What is not noise takes less: real counts of 12 bits about half.

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
        share = min(1.0, _noise_bits(dataset, str(name)) / bits + NOISE_SHARE) if bits else 1.0
        needed += share * variable.nbytes
        chunk = storage_chunks(variable.dims, variable.shape, variable.dtype.itemsize)
        chunks = math.prod(-(-size // step) for size, step in zip(variable.shape, chunk, strict=True))
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
    """Refuse a store for which its disk has no room.

    Parameters
    ----------
    store
        Where it will be; neither it nor the folders above need be there yet.
    needed
        Bytes to be written.
    begun
        What an interrupted run left and this one takes up: its bytes are taken off.

    Raises
    ------
    StoreError
        There is less room; the figures are given.
    """
    free = _free(store)
    left = needed - sum(_size(file) for folder in begun for file in folder.rglob("*"))
    if free is not None and left > free:
        raise StoreError(
            f"cannot write {store}: {size_text(left)} of disk are needed, {size_text(free)} are free; make "
            "room, choose another disk, or leave reflectance to be computed from counts (reflectance='none')"
        )


def _free(store: Path) -> int | None:
    """Return the free bytes of the disk on which a store is, or will be; None where that cannot be told."""
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
    """Turn a full disk or memory, and folders and files that cannot be used, into one readable error.

    Parameters
    ----------
    location
        The store.
    groups
        What is being written.
    """
    try:
        yield
    except PaintError as error:
        cause = error.__cause__  # a block's error, which names the block
        if isinstance(cause, OSError) and cause.errno in _FULL:
            raise StoreError(f"{error}; {_room(location, groups)}") from cause
        raise
    except OSError as error:
        raise StoreError(_told(error, location, groups)) from error
    except (MemoryError, RuntimeError) as error:
        # threads that cannot be started are told as a RuntimeError
        if isinstance(error, RuntimeError) and "start new thread" not in str(error):
            raise
        raise StoreError(
            f"cannot write {location.url}: memory ran out ({str(error) or 'nothing can be allocated'}); take "
            "fewer lines a dask chunk or fewer threads, end other programs, or raise the limit; run again: "
            "the chunks that are finished will be taken up"
        ) from error


def _told(error: OSError, location: Location, groups: Mapping[str, xr.Dataset]) -> str:
    reason = error.strerror or str(error)
    again = "run again: the chunks that are finished will be taken up"
    if error.errno in _FULL:
        reason = f"{reason}; {_room(location, groups)}"
    elif error.filename and location.local is not None and not _is_beside(error.filename, location.local):
        reason = f"{reason}: {error.filename}, which it is made from; mend this"
    else:
        reason = f"{reason}{f' ({error.filename})' if error.filename else ''}; mend this"
    return f"cannot write {location.url}: {reason} and {again}"


def _room(location: Location, groups: Mapping[str, xr.Dataset]) -> str:
    """Return words for the room that groups need, and that there is."""
    needed = size_text(sum(map(disk_needed, groups.values())))
    free = None if location.local is None else _free(location.local)
    found = "" if free is None else f", {size_text(free)} are free now"
    return f"{', '.join(f'/{group}' for group in groups)} may take {needed} in all{found}; make room"


def _is_beside(file: object, store: Path) -> bool:
    """Tell whether a file is in a store or in the folder where it is staged."""
    above = os.path.abspath(store.parent)
    inside = (
        os.path.relpath(os.path.abspath(os.fsdecode(file)), above) if isinstance(file, str | bytes) else ""
    )
    return inside.split(os.sep)[0] in (store.name, f".partial-{store.name}")
