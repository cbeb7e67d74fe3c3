"""What outlives a power cut.

The kernel keeps written files in memory for half a minute or so. Before a group is sealed with its completion
record, and before it is renamed into its place, every file of it and every folder is therefore flushed to the
disk: a sealed group that is found after a power cut is whole. A group that was under construction may have
lost files; what is taken up of it is checked against its checksums first.

A chunk's way to the disk begins as soon as it is written, while others are computed, so that little is left
to wait for at the end.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

from .budget import thread_space
from .location import sync_folder

__all__ = ["at_once", "flush_group", "start_flush"]

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")

_AT_ONCE = 8
"""Files flushed at a time: disks take several orders at once."""


def start_flush(file: Any) -> None:
    """Let the kernel begin to write a file to the disk, without waiting for it."""
    if hasattr(os, "posix_fadvise"):
        file.flush()
        # Linux starts to write what it is told will not be needed; what is on its way stays in memory
        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def flush_group(folder: Path, expected: Iterable[Path]) -> None:
    """Flush all files of a folder, then all its folders; return when the disk has them.

    Parameters
    ----------
    folder
        A group under construction.
    expected
        Files that must be there: somebody may have cleared up while they were written.

    Raises
    ------
    FileNotFoundError
        One is missing.
    OSError
        The disk could not take them.
    """
    files: set[str] = set()
    folders: list[Path] = []
    for above, _, names in os.walk(folder, topdown=False):
        files.update(os.path.join(above, name) for name in names)
        folders.append(Path(above))
    for path in expected:
        if os.fspath(path) not in files:
            raise FileNotFoundError(errno.ENOENT, "a finished chunk has been removed", os.fspath(path))
    at_once(_flush, sorted(files), _AT_ONCE)
    at_once(sync_folder, folders, _AT_ONCE)


def at_once(function: Callable[[_Item], _Result], items: Sequence[_Item], most: int) -> list[_Result]:
    """Return what a function that waits for the disk makes of every item, some at a time.

    One after the other where the address space is limited: a thread would reserve some 70 MiB of it, which
    the plan of a run has given to its computing threads.
    """
    if thread_space():
        return [function(item) for item in items]
    with ThreadPoolExecutor(most) as pool:
        return list(pool.map(function, items))


def _flush(path: str | Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
