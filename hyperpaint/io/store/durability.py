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
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from .location import sync_folder

__all__ = ["flush_group", "start_flush"]

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
    with ThreadPoolExecutor(_AT_ONCE) as pool:
        list(pool.map(_flush, sorted(files)))
        list(pool.map(sync_folder, folders))


def _flush(path: str | Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
