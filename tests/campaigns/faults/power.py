"""Power cuts while a store is written, and right after: what is found then is whole, or says that it is not.

The disk is an ext4 file system of its own that is shut down as by a cut (``EXT4_IOC_SHUTDOWN`` without
flushing even its journal), and mounted again: what had not been flushed is gone. That needs root on Linux.
What a disk itself loses after it has confirmed it cannot be shown so.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import random
import struct
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import hyperpaint as hp
from hyperpaint.base.errors import PaintError

from . import disks, mounts
from .outcome import Outcome

__all__ = ["campaign", "can_cut", "run_cut"]

CUTS = 60
_SHUTDOWN, _WITHOUT_FLUSH = 0x8004587D, 2
_DISK_BYTES = 48 * 2**20


@contextlib.contextmanager
def _disk(image: Path) -> Iterator[Path]:
    """Make and mount a small file system in a file."""
    with open(image, "wb") as file:
        file.truncate(_DISK_BYTES)
    mounts.call("mkfs.ext4", "-q", image)
    disk = image.with_suffix(".disk")
    disk.mkdir()
    mounts.call("mount", "-o", "loop", image, disk)
    try:
        yield disk
    finally:
        with contextlib.suppress(subprocess.SubprocessError):
            mounts.call("umount", disk)


def _cut(disk: Path) -> None:
    """Cut the power: nothing that is still in memory reaches the disk."""
    descriptor = os.open(disk, os.O_RDONLY)
    try:
        fcntl.ioctl(descriptor, _SHUTDOWN, struct.pack("I", _WITHOUT_FLUSH))
    finally:
        os.close(descriptor)


def _restart(image: Path, disk: Path) -> None:
    mounts.call("umount", disk)
    mounts.call("mount", "-o", "loop", image, disk)


def can_cut() -> bool:
    """Tell whether disks can be made and cut off here."""
    try:
        with tempfile.TemporaryDirectory() as scratch, _disk(Path(scratch) / "image") as disk:
            _cut(disk)
            return True
    except (OSError, subprocess.SubprocessError):
        return False


def run_cut(number: int, folder: Path, expected: dict[str, bytes], duration: float, made: Outcome) -> None:
    """Cut the power while a store is written, or as soon as it is; look, run again and compare.

    Parameters
    ----------
    number
        Of the fault; every third cut comes when the writer has just returned.
    folder
        Empty.
    expected
        Chunks of an undisturbed run.
    duration
        Of a whole write [s].
    made
        Takes the outcome.
    """
    rng = random.Random(f"cut:{number}")
    image, log = folder / "image", folder / "log.txt"
    made.count += 1
    with _disk(image) as disk:
        path = disk / "flights" / "lot.zarr"
        os.sync()  # the folder of the disk; what the writer makes is the writer's to flush
        writer = mounts.child(mounts.store, path, log)
        if number % 3 == 0:
            writer.join()
        else:
            time.sleep(rng.uniform(0.0, 1.1 * duration))
        returned = not writer.is_alive()
        _cut(disk)
        mounts.ended(writer)
        _restart(image, disk)
        found = mounts.looks_finished(path)
        made.notes["found written" if found else "found unwritten"] += 1
        if returned and not found:
            made.wrong.append(f"cut {number}: the writer had returned, but the store is not there")
        try:
            if found and mounts.chunks(path / mounts.GROUP) != expected:
                made.wrong.append(f"cut {number}: looks finished, but is damaged")
            # between the place of the group and the metadata of the root: whole, and verify asks for the rest
            elif found and not hp.verify(path).ok:
                made.notes["the group is there, the root says that it is not"] += 1
        except (PaintError, OSError) as error:
            made.wrong.append(f"cut {number}: {type(error).__name__}: {error!s:.200}")
        status, said = mounts.ended(mounts.child(mounts.store, path, log))
        if status or mounts.chunks(path / mounts.GROUP) != expected or not hp.verify(path).ok:
            made.wrong.append(f"cut {number}: the rerun exits with {status}, or differs: {said!r:.300}")
        if left := set(os.listdir(path.parent)) - {path.name}:
            made.wrong.append(f"cut {number}: left beside the store: {left}")


def campaign(scale: float = 1.0, *, first: int = 0) -> Iterator[Outcome]:
    """Yield the outcome of every cut; that none can be made is an outcome, too."""
    title = "power cuts"
    if not can_cut():
        yield Outcome(f"{title} (no right to mount disks)")
        return
    with tempfile.TemporaryDirectory() as scratch:
        expected, _ = disks.undisturbed(Path(scratch))
        begun = time.monotonic()
        mounts.ended(mounts.child(mounts.store, Path(scratch) / "lot.zarr", Path(scratch) / "log.txt"))
        duration = time.monotonic() - begun
    for number in range(first, first + max(1, round(CUTS * scale))):
        with tempfile.TemporaryDirectory() as scratch:
            made = Outcome(title)
            run_cut(number, Path(scratch), expected, duration, made)
            yield made
