"""Disks that fill up, become read-only, vanish or lose power, and cut sources, while a store is written.

Full and vanishing disks are small ones in memory, mounted for the purpose, so that the system itself says
what is wrong. The disk that loses power is an ext4 file system of its own that is shut down as by a cut
(``EXT4_IOC_SHUTDOWN`` without flushing even its journal), and mounted again: what had not been flushed is
gone. What a disk itself loses after it has confirmed it cannot be shown so. All of this needs root on Linux.
Elsewhere only sources are tried, and the campaign says so by failing.
"""

import contextlib
import fcntl
import os
import random
import re
import shutil
import struct
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import xarray as xr

import hyperpaint as hp
from hyperpaint.base.errors import PaintError
from hyperpaint.io.store import computing, is_complete, open_store

from .interruptions import DONE, GROUP, REFUSED, _slab as slab_of, chunks_of, end_of, scene_line, start
from .outcome import Outcome, each, numbers_of

LEVELS, CUTS = 30, 60
OTHER = "flightlines/raw_1"
DISK_BYTES, CUT_DISK_BYTES, PAGE_BYTES = 16 * 2**20, 48 * 2**20, 4096
SLABS, SHAPE, DELAY_S = 12, (32, 16, 200), 0.02
NOBODY = 65534
_SHUTDOWN, _WITHOUT_FLUSH = 0x8004587D, 2
_CANNOT = (OSError, subprocess.SubprocessError)

# --- disks -------------------------------------------------------------------------------------------------


def call(*command: object) -> None:
    subprocess.run([str(word) for word in command], check=True, capture_output=True)


@contextlib.contextmanager
def small_disk(folder: Path, image: Path | None = None) -> Iterator[Path]:
    # Mount a small disk in memory, or a file system in an image; its folder is anyone's to write
    folder.mkdir(exist_ok=True)
    if image is None:
        call("mount", "-t", "tmpfs", "-o", f"size={DISK_BYTES},mode=777", "tmpfs", folder)
    else:
        image.touch()
        os.truncate(image, CUT_DISK_BYTES)
        call("mkfs.ext4", "-q", image)
        call("mount", "-o", "loop", image, folder)
    try:
        yield folder
    finally:
        with contextlib.suppress(subprocess.SubprocessError):
            call("umount", "-l", folder)


def cut_power(disk: Path) -> None:
    # Let nothing that is still in memory reach the disk
    descriptor = os.open(disk, os.O_RDONLY)
    try:
        fcntl.ioctl(descriptor, _SHUTDOWN, struct.pack("I", _WITHOUT_FLUSH))
    finally:
        os.close(descriptor)


def can_mount() -> bool:
    # Tell whether disks can be made here
    try:
        with tempfile.TemporaryDirectory() as scratch, small_disk(Path(scratch)):
            return True
    except _CANNOT:
        return False


def can_cut() -> bool:
    # Tell whether disks can be made and cut off here
    try:
        with tempfile.TemporaryDirectory() as scratch:
            with small_disk(Path(scratch) / "disk", Path(scratch) / "image") as disk:
                cut_power(disk)
            return True
    except _CANNOT:
        return False


def used_bytes(disk: Path) -> int:
    found = os.statvfs(disk)
    return (found.f_blocks - found.f_bfree) * found.f_frsize


def fill_disk(disk: Path, leave: int) -> None:
    # Let a file of somebody else take the disk's room, but for so many bytes
    size = DISK_BYTES - used_bytes(disk) - max(0, leave) // PAGE_BYTES * PAGE_BYTES
    if size > 0:
        with open(disk / "somebody else's", "wb") as file:
            os.posix_fallocate(file.fileno(), 0, size)


# --- what is written ---------------------------------------------------------------------------------------


def _logged_slab(
    seed: int, shape: tuple[int, ...], delay: float, log: str, at: int, share: float, total: int,
    block_id: tuple[int, ...] = (),
) -> Any:  # fmt: skip
    # Return a slab; number ``at`` first lets the disk fill up but for ``share`` of what is lacking
    with open(log, "a") as file:
        file.write(f"{block_id[0]}\n")
    if block_id[0] == at:
        disk = Path(log).with_suffix(".disk")
        fill_disk(disk, int(share * (total - used_bytes(disk))))
    return slab_of(seed, shape, delay, block_id)


def store(path: Path, log: Path, at: int = -1, share: float = 1.0, total: int = 0) -> None:
    options = {"log": str(log), "at": at, "share": share, "total": total}
    line = scene_line(0, SLABS, DELAY_S, SHAPE, _logged_slab, **options)
    hp.to_store(line, path, GROUP, source_token="a scene", overwrite=True)


def process_slowly(collect: Path, out: Path, delay: float = 0.0) -> None:
    # Process a collect, slowly enough for something to happen meanwhile
    plain = computing.write_chunk

    def slow(folder: Path, *rest: Any) -> None:
        time.sleep(delay)
        plain(folder, *rest)

    computing.write_chunk = slow
    hp.process(collect, out)


def chunks_begun(path: Path) -> int:
    # Return how many chunks of the counts an unfinished run has finished
    return len(list(path.parent.glob(f".partial-{path.name}/build-*/counts/c/*/0/0")))


def looks_finished(path: Path, group: str = GROUP) -> bool:
    # Tell whether any of our readers takes a group for whole
    if is_complete(path, group):
        return True
    for takes in (
        lambda: bool(open_store(path, group)),
        lambda: hp.verify(path).ok and (path / group).exists(),
    ):
        with contextlib.suppress(PaintError):
            if takes():
                return True
    return False


def _wait(found: Callable[[], object], seconds: float = 60.0) -> None:
    until = time.monotonic() + seconds
    while not found() and time.monotonic() < until:
        time.sleep(0.001)


def undisturbed(folder: Path) -> tuple[dict[str, bytes], int]:
    # Return the chunks of a run on a disk with room, and the bytes of the disk that it took
    with small_disk(folder / "log.disk") as disk:
        store(disk / "lot.zarr", folder / "log.txt")
        return chunks_of(disk / "lot.zarr" / GROUP), used_bytes(disk)


def processed(folder: Path) -> tuple[Path, dict[str, bytes]]:
    # Return a small collect's folder, and the chunks of an undisturbed run
    size = {"lines": SHAPE[0] * SLABS, "bands": 12, "columns": 16}
    hp.simulate_collect(folder / "collect", scene="plan", seed=3, truth=False, **size)
    hp.process(folder / "collect" / "collect.toml", folder / "whole.zarr")
    return folder / "collect", chunks_of(folder / "whole.zarr")


def _judge(fault: str, path: Path, end: tuple[int, str, int], word: str, outcome: Outcome) -> bool:
    # Note what is wrong with a run that was disturbed; tell whether it was refused
    status, text, _ = end
    stopped = status == REFUSED
    outcome.notes["stopped" if stopped else "written"] += 1
    if status not in (DONE, REFUSED) or (stopped and not re.search(word, text)):
        outcome.wrong.append(f"{fault}: exits with {status}: {text!r:.600}")
    if stopped and looks_finished(path):
        outcome.wrong.append(f"{fault}: looks finished")
    return stopped


def _again(
    fault: str, path: Path, log: Path, expected: dict[str, bytes], outcome: Outcome, *, stopped: bool
) -> None:
    # Run once more; what was finished is not computed again, and the same bytes come out
    finished = chunks_begun(path) if stopped and not path.joinpath(GROUP).exists() else None
    before = len(log.read_text().split()) if log.exists() else 0
    status, text, _ = end_of(start(store, path, log))
    computed = len(log.read_text().split()) - before
    if status != DONE:
        outcome.wrong.append(f"{fault}: the rerun exits with {status}: {text!r:.300}")
        return
    if finished is not None:
        outcome.notes["chunks taken up"] += finished
        if computed != SLABS - finished:
            outcome.wrong.append(
                f"{fault}: {finished} chunks were finished, but {computed} were computed again"
            )
    # a group that went with the store is named, and is nobody's to bring back
    gone = []
    for problem in hp.verify(path).problems:
        group, _, said = problem.partition(": ")
        if not said.startswith("deleted") or (path / group.lstrip("/")).exists():
            gone.append(problem)
    if chunks_of(path / GROUP) != expected or gone:
        outcome.wrong.append(f"{fault}: the rerun differs from an undisturbed run: {gone}")


# --- full --------------------------------------------------------------------------------------------------


def run_full(number: int, folder: Path, expected: dict[str, bytes], total: int, outcome: Outcome) -> None:
    # Let a disk fill up: half of the levels are shares of what is lacking, half its last pages
    rng, level, fault = random.Random(f"full:{number}"), number % LEVELS, f"full {number}"
    at = rng.randrange(SLABS)
    share, pages = (level / LEVELS, 0) if level % 2 == 0 else (1.0, level // 2)
    log = folder / "log.txt"
    outcome.count += 1
    with small_disk(folder / "log.disk") as disk:
        path, others = disk / "lot.zarr", disk / "somebody else's"
        # refused before anything is written
        fill_disk(disk, int(share * total) // 2)
        status, text, _ = end_of(start(store, path, log))
        if status != REFUSED or not re.search(r"\d MiB of disk are needed, \d+ MiB are free", text):
            outcome.wrong.append(f"{fault}: before: exits with {status}: {text!r:.300}")
        if log.exists() or set(os.listdir(disk)) != {others.name}:
            outcome.wrong.append(f"{fault}: before: written or read: {os.listdir(disk)}")
        others.unlink(missing_ok=True)
        # filled up meanwhile
        end = end_of(start(store, path, log, at, share, total - pages * PAGE_BYTES))
        word = r"(?s)(?=.*No space left).*may take \d+ MiB in all, .* free disk space"
        stopped = _judge(fault, path, end, word, outcome)
        others.unlink(missing_ok=True)
        _again(fault, path, log, expected, outcome, stopped=stopped)


# --- folders -----------------------------------------------------------------------------------------------


def _read_only_disk(disk: Path, _: Path) -> None:
    for _ in range(500):  # not while a file is open
        with contextlib.suppress(subprocess.SubprocessError):
            call("mount", "-o", "remount,ro", disk)
            return


def _read_only_folders(_: Path, path: Path) -> None:
    with contextlib.suppress(OSError):
        for folder in (path.parent, *path.parent.rglob("*/")):
            folder.chmod(0o555)


def _remove_some_chunks(_: Path, path: Path) -> None:
    for chunk in list(path.parent.glob(f".partial-{path.name}/build-*/counts/c/*/0/0"))[:2]:
        chunk.unlink(missing_ok=True)


def _move_folder(disk: Path, path: Path) -> None:
    with contextlib.suppress(OSError):
        os.rename(path.parent, disk / "elsewhere")


#: What happens to the folder of a store: from the start, or after some chunks.
FOLDERS: dict[str, Callable[[Path, Path], object]] = {
    "read-only disk": _read_only_disk,
    "read-only folders": _read_only_folders,
    "partial removed": lambda _, path: shutil.rmtree(
        path.with_name(f".partial-{path.name}"), ignore_errors=True
    ),
    "chunks removed": _remove_some_chunks,
    "folder moved": _move_folder,
    "folder removed": lambda _, path: shutil.rmtree(path.parent, ignore_errors=True),
    "store removed": lambda _, path: shutil.rmtree(path, ignore_errors=True),
    "disk unmounted": lambda disk, _: call("umount", "-l", disk),
}


def run_folder(number: int, folder: Path, expected: dict[str, bytes], outcome: Outcome) -> None:
    # Let something happen to a folder while a store is written into it, mend it, and run again
    rng, name = random.Random(f"folder:{number}"), list(FOLDERS)[number % len(FOLDERS)]
    fault, log = f"folder {number} ({name})", folder / "log.txt"
    from_start = name.startswith("read-only") and rng.random() < 0.4
    outcome.count += 1
    with small_disk(folder / "log.disk") as disk:
        path = disk / "flights" / "lot.zarr"
        path.parent.mkdir()
        hp.to_store(xr.Dataset({"a": ("x", [1.0])}), path, OTHER)
        for place in (path.parent, *path.parent.rglob("*")):
            os.chown(place, NOBODY, NOBODY)
            place.chmod(0o777 if place.is_dir() else 0o666)
        if from_start:
            FOLDERS[name](disk, path)
        writer = start(store, path, log, common=name == "read-only folders")
        if not from_start:
            after = rng.randrange(SLABS)
            _wait(lambda: chunks_begun(path) >= after or not writer.is_alive())
            time.sleep(rng.uniform(0.0, 0.02))
            FOLDERS[name](disk, path)
        end = end_of(writer)
        stopped = _judge(fault, path, end, r"lot\.zarr", outcome)
        if end[0] == DONE and path.exists() and not looks_finished(path):
            outcome.wrong.append(f"{fault}: the writer returns, but the store is not whole")
        # mend the disk
        with contextlib.suppress(subprocess.SubprocessError):
            call("mount", "-o", "remount,rw", disk)
        if (disk / "elsewhere").exists() and not path.parent.exists():
            os.rename(disk / "elsewhere", path.parent)
        path.parent.mkdir(exist_ok=True)
        for place in (path.parent, *path.parent.rglob("*/")):
            place.chmod(0o777)
        _again(fault, path, log, expected, outcome, stopped=stopped and name.startswith("read-only"))


# --- sources -----------------------------------------------------------------------------------------------

#: What happens to the cube that a store is made from; rewritten ones go on as an acquisition would.
SOURCES: dict[str, Callable[[Path], object]] = {
    "cube removed": lambda cube: cube.unlink(),
    "cube truncated": lambda cube: os.truncate(cube, cube.stat().st_size // 3),
    "cube emptied": lambda cube: os.truncate(cube, 0),
    "cube rewritten": lambda cube: cube.write_bytes(bytes(cube.stat().st_size)),
    "source folder moved": lambda cube: os.rename(cube.parent, cube.parent.with_name("elsewhere")),
}


def run_source(
    number: int, folder: Path, collect: Path, expected: dict[str, bytes], outcome: Outcome
) -> None:
    # Let something happen to a cube while its collect is processed, put it back, and run again
    rng, name = random.Random(f"source:{number}"), list(SOURCES)[number % len(SOURCES)]
    fault, own, path = f"source {number} ({name})", folder / "collect", folder / "lot.zarr"
    shutil.copytree(collect, own, copy_function=shutil.copy2)
    cube = next((own / "flight").glob("*_0"))
    outcome.count += 1
    writer = start(process_slowly, own / "collect.toml", path, 0.02)
    after = rng.randrange(SLABS)
    _wait(lambda: chunks_begun(path) >= after or not writer.is_alive())
    SOURCES[name](cube)
    _judge(fault, path, end_of(writer), re.escape(cube.name), outcome)
    shutil.rmtree(own, ignore_errors=True)
    shutil.copytree(collect, own, copy_function=shutil.copy2)
    status, text, _ = end_of(start(process_slowly, own / "collect.toml", path))
    if status != DONE or chunks_of(path) != expected or not hp.verify(path).ok:
        outcome.wrong.append(f"{fault}: the rerun exits with {status}, or differs: {text!r:.300}")
    if left := set(os.listdir(folder)) - {"lot.zarr", "collect"}:
        outcome.wrong.append(f"{fault}: left beside the store: {left}")


# --- power -------------------------------------------------------------------------------------------------


def run_cut(number: int, folder: Path, expected: dict[str, bytes], duration: float, outcome: Outcome) -> None:
    # Cut the power while a store is written, or every third time just after; look, run again, compare
    rng, fault, image = random.Random(f"cut:{number}"), f"cut {number}", folder / "image"
    outcome.count += 1
    with small_disk(folder / "disk", image) as disk:
        path = disk / "flights" / "lot.zarr"
        os.sync()  # the folder of the disk; what the writer makes is the writer's to flush
        writer = start(store, path, folder / "log.txt")
        if number % 3 == 0:
            writer.join()
        else:
            time.sleep(rng.uniform(0.0, 1.1 * duration))
        returned = not writer.is_alive()
        cut_power(disk)
        end_of(writer)
        call("umount", disk)
        call("mount", "-o", "loop", image, disk)
        found = looks_finished(path)
        outcome.notes["found written" if found else "found unwritten"] += 1
        if returned and not found:
            outcome.wrong.append(f"{fault}: the writer had returned, but the store is not there")
        try:
            if found and chunks_of(path / GROUP) != expected:
                outcome.wrong.append(f"{fault}: looks finished, but is damaged")
            # between the place of the group and the metadata of the root: whole, and verify asks for the rest
            elif found and not hp.verify(path).ok:
                outcome.notes["the group is there, the root says that it is not"] += 1
        except (PaintError, OSError) as error:
            outcome.wrong.append(f"{fault}: {type(error).__name__}: {error!s:.200}")
        status, text, _ = end_of(start(store, path, folder / "log.txt"))
        if status != DONE or chunks_of(path / GROUP) != expected or not hp.verify(path).ok:
            outcome.wrong.append(f"{fault}: the rerun exits with {status}, or differs: {text!r:.300}")
        if left := set(os.listdir(path.parent)) - {path.name}:
            outcome.wrong.append(f"{fault}: left beside the store: {left}")


# --- campaigns ---------------------------------------------------------------------------------------------


def disks(scale: float = 1.0, *, first: int = 0) -> Iterator[Outcome]:
    # Yield the outcome of every fault; disks that cannot be mounted are an outcome, too
    numbers = numbers_of(LEVELS, scale, first)
    with tempfile.TemporaryDirectory() as scratch:
        collect, whole = processed(Path(scratch))
        if can_mount():
            expected, total = undisturbed(Path(scratch))
            yield from each("full disks", numbers, run_full, expected, total)
            yield from each("read-only and vanishing folders", numbers, run_folder, expected)
        else:
            yield Outcome("full disks (no right to mount any)")
        yield from each("vanishing and cut sources", numbers, run_source, collect, whole)


def cuts(scale: float = 1.0, *, first: int = 0) -> Iterator[Outcome]:
    # Yield the outcome of every cut of the power; that none can be made is an outcome, too
    if not can_cut():
        yield Outcome("power cuts (no right to mount disks)")
        return
    with tempfile.TemporaryDirectory() as scratch:
        expected, _ = undisturbed(Path(scratch))
        began = time.monotonic()
        end_of(start(store, Path(scratch) / "lot.zarr", Path(scratch) / "log.txt"))
        duration = time.monotonic() - began
    yield from each("power cuts", numbers_of(CUTS, scale, first), run_cut, expected, duration)
