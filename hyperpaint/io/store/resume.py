"""Finished chunks of a run that was cut short: recorded as they are written, taken up by the next run.

Beside every chunk file of a group under construction lies its record ``.<name>.done``: the chunk's key and
the crc32c of its decoded samples. It comes after the chunk, and goes before the group is published. A power
failure may leave either without its content; nothing is therefore believed that does not decode to its
checksum.
"""

from __future__ import annotations

import os
import re
import uuid
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from hyperpaint.base.errors import PaintError, StoreError

from .durability import at_once, start_flush
from .location import plain_file
from .record import checksum

if TYPE_CHECKING:
    from .blocks import Target

__all__ = ["adopt", "is_mendable", "write_chunk"]

_RECORD = re.compile(r"(\S{1,200}) ([0-9a-f]{8})\n")


def write_chunk(folder: Path, key: str, parts: Sequence[bytes], value: int) -> None:
    """Write a chunk file of an array, then its record.

    Parameters
    ----------
    folder
        The array's.
    key
        The chunk's path in it.
    parts
        What the file holds.
    value
        Checksum of the chunk's decoded samples.
    """
    path = folder / key
    _make_parents(folder, path)
    _replace(path, parts, flush=True)
    _replace(_record_of(path), [f"{key} {value:08x}\n".encode()])


def adopt(leftover: Path, target: Target, known: dict[tuple[int, ...], int]) -> None:
    """Move the finished chunks of an array from an earlier run's folder into the array's own.

    Parameters
    ----------
    leftover
        The array's folder in what the earlier run left; need not be there.
    target
        The array, with its metadata already written.
    known
        Position in the grid to checksum; the chunks that are moved, read and found whole are added.
    """
    import numpy as np

    folder, array = target.folder, target.array
    if folder is None or leftover.is_symlink() or not leftover.is_dir():
        return

    def moved(position: tuple[int, ...]) -> int | None:
        key = array.metadata.encode_chunk_key(position)
        value = _recorded(leftover, key)
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
            found = checksum(np.asarray(array[target.region(position)]))
        except Exception:  # a damaged chunk may raise anything that a codec raises
            found = None
        if found != value:
            _record_of(path).unlink()
            path.unlink()
            return None
        return value

    grid = (-(-size // step) for size, step in zip(array.shape, target.chunk, strict=True))
    positions = [position for position in np.ndindex(*grid) if position not in known]
    found = zip(positions, at_once(moved, positions, os.cpu_count() or 1), strict=True)
    known.update((position, value) for position, value in found if value is not None)


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


def _recorded(folder: Path, key: str) -> int | None:
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


def _replace(path: Path, parts: Sequence[bytes], *, flush: bool = False) -> None:
    # a scheduler may run a task twice at once: each writes its own file, the last rename stands
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}")
    try:
        with open(temporary, "wb") as file:
            file.writelines(parts)
            if flush:
                start_flush(file)
        os.replace(temporary, path)
    except OSError:  # on a full disk its room is needed
        temporary.unlink(missing_ok=True)
        raise
