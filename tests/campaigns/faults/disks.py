"""Disks that fill up, become read-only or vanish, and sources that are cut short, while a store is written.

The disks are small ones in memory, mounted for the purpose, so that the system itself says what is wrong;
that needs root on Linux. Elsewhere disks and folders are not tried, and the campaign says so by failing.
"""

from __future__ import annotations

import contextlib
import os
import random
import re
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import xarray as xr

import hyperpaint as hp

from .mounts import (
    DONE,
    GROUP,
    LEVELS,
    NOBODY,
    OTHER,
    PAGE_BYTES,
    REFUSED,
    SHAPE,
    SLABS,
    call,
    can_mount,
    child,
    chunks,
    chunks_begun,
    ended,
    fill_disk,
    looks_finished,
    process_slowly,
    small_disk,
    store,
    used_bytes,
)
from .outcome import Outcome

__all__ = ["FOLDERS", "SOURCES", "campaign", "can_mount", "run_folder", "run_full", "run_source"]

# --- full --------------------------------------------------------------------------------------------------


def run_full(number: int, folder: Path, expected: dict[str, bytes], total: int, made: Outcome) -> None:
    """Let a disk fill up: half of the levels are shares of what is lacking, half its last pages.

    Parameters
    ----------
    number
        Of the fault.
    folder
        Empty.
    expected
        Chunks of an undisturbed run.
    total
        Bytes of the disk that it takes.
    made
        Takes the outcome.
    """
    rng = random.Random(f"full:{number}")
    level = number % LEVELS
    at = rng.randrange(SLABS)
    share = level / LEVELS if level % 2 == 0 else 1.0
    pages = 0 if level % 2 == 0 else level // 2
    disk, log = folder / "log.disk", folder / "log.txt"
    disk.mkdir()
    made.count += 1
    with small_disk(disk):
        path = disk / "lot.zarr"
        # told before anything is written
        fill_disk(disk, int(share * total) // 2)
        status, said = ended(child(store, path, log))
        if status != REFUSED or not re.search(r"\d MiB of disk are needed, \d+ MiB are free", said):
            made.wrong.append(f"full {number}: before: exits with {status}: {said!r:.300}")
        if log.exists() or set(os.listdir(disk)) != {"somebody else's"}:
            made.wrong.append(f"full {number}: before: written or read: {os.listdir(disk)}")
        _free(disk)
        # filled up meanwhile
        status, said = ended(child(store, path, log, at, share, total - pages * PAGE_BYTES))
        made.notes["stopped" if status == REFUSED else "written in what was left"] += 1
        if status == REFUSED:
            if "No space left" not in said or not re.search(
                r"may take \d+ MiB in all, .* free disk space", said
            ):
                made.wrong.append(f"full {number}: said {said!r:.300}")
            if looks_finished(path):
                made.wrong.append(f"full {number}: looks finished")
        elif status != DONE:
            made.wrong.append(f"full {number}: exits with {status}: {said!r:.600}")
        _free(disk)
        _again(f"full {number}", path, log, expected, made, stopped=status == REFUSED)


def _free(disk: Path) -> None:
    (disk / "somebody else's").unlink(missing_ok=True)


def _again(
    fault: str, path: Path, log: Path, expected: dict[str, bytes], made: Outcome, *, stopped: bool
) -> None:
    """Run once more; what was finished is not computed again, and the same bytes come out."""
    finished = chunks_begun(path) if stopped and not path.joinpath(GROUP).exists() else None
    before = len(log.read_text().split()) if log.exists() else 0
    status, said = ended(child(store, path, log))
    computed = len(log.read_text().split()) - before
    if status != DONE:
        made.wrong.append(f"{fault}: the rerun exits with {status}: {said!r:.300}")
        return
    if finished is not None:
        made.notes["chunks taken up"] += finished
        if computed != SLABS - finished:
            made.wrong.append(f"{fault}: {finished} chunks were finished, but {computed} were computed again")
    # a group that went with the store is named, and is nobody's to bring back
    gone = [text for text in hp.verify(path).problems if not _is_deleted(text, path)]
    if chunks(path / GROUP) != expected or gone:
        made.wrong.append(f"{fault}: the rerun differs from an undisturbed run: {gone}")


def _is_deleted(problem: str, path: Path) -> bool:
    group, _, text = problem.partition(": ")
    return text.startswith("deleted") and not (path / group.lstrip("/")).exists()


# --- folders -----------------------------------------------------------------------------------------------


def _read_only_disk(disk: Path, _path: Path) -> None:
    for _ in range(500):  # not while a file is open
        with contextlib.suppress(subprocess.SubprocessError):
            call("mount", "-o", "remount,ro", disk)
            return


def _writable_disk(disk: Path) -> None:
    with contextlib.suppress(subprocess.SubprocessError):
        call("mount", "-o", "remount,rw", disk)


def _read_only_folders(small_disk: Path, path: Path) -> None:
    with contextlib.suppress(OSError):
        for folder in (path.parent, *path.parent.rglob("*/")):
            folder.chmod(0o555)


def _remove_partial(small_disk: Path, path: Path) -> None:
    shutil.rmtree(path.with_name(f".partial-{path.name}"), ignore_errors=True)


def _remove_some_chunks(small_disk: Path, path: Path) -> None:
    for chunk in list(path.parent.glob(f".partial-{path.name}/build-*/counts/c/*/0/0"))[:2]:
        chunk.unlink(missing_ok=True)


def _move_folder(disk: Path, path: Path) -> None:
    with contextlib.suppress(OSError):
        os.rename(path.parent, disk / "elsewhere")


def _remove_folder(small_disk: Path, path: Path) -> None:
    shutil.rmtree(path.parent, ignore_errors=True)


def _remove_store(small_disk: Path, path: Path) -> None:
    shutil.rmtree(path, ignore_errors=True)


def _unmount(disk: Path, _path: Path) -> None:
    call("umount", "-l", disk)


FOLDERS: dict[str, Callable[[Path, Path], None]] = {
    "read-only disk": _read_only_disk,
    "read-only folders": _read_only_folders,
    "partial removed": _remove_partial,
    "chunks removed": _remove_some_chunks,
    "folder moved": _move_folder,
    "folder removed": _remove_folder,
    "store removed": _remove_store,
    "disk unmounted": _unmount,
}
"""What happens to the folder of a store: from the start, or after some chunks."""


def run_folder(number: int, folder: Path, expected: dict[str, bytes], made: Outcome) -> None:
    """Let something happen to a folder while a store is written into it, mend it, and run again.

    Parameters
    ----------
    number
        Of the fault.
    folder
        Empty.
    expected
        Chunks of an undisturbed run.
    made
        Takes the outcome.
    """
    rng = random.Random(f"folder:{number}")
    name = list(FOLDERS)[number % len(FOLDERS)]
    fault = f"folder {number} ({name})"
    from_start = name.startswith("read-only") and rng.random() < 0.4
    disk, log = folder / "log.disk", folder / "log.txt"
    disk.mkdir()
    made.count += 1
    with small_disk(disk):
        path = disk / "flights" / "lot.zarr"
        path.parent.mkdir()
        hp.to_store(xr.Dataset({"a": ("x", [1.0])}), path, OTHER)
        for each in (path.parent, *path.parent.rglob("*")):
            os.chown(each, NOBODY, NOBODY)
            each.chmod(0o777 if each.is_dir() else 0o666)
        if from_start:
            FOLDERS[name](disk, path)
        writer = child(store, path, log, common=name == "read-only folders")
        if not from_start:
            after = rng.randrange(SLABS)
            _wait(lambda: chunks_begun(path) >= after or not writer.is_alive())
            time.sleep(rng.uniform(0.0, 0.02))
            FOLDERS[name](disk, path)
        status, said = ended(writer)
        made.notes["stopped" if status == REFUSED else "written"] += 1
        if status not in (DONE, REFUSED) or (status == REFUSED and "lot.zarr" not in said):
            made.wrong.append(f"{fault}: exits with {status}: {said!r:.600}")
        if status == REFUSED and looks_finished(path):
            made.wrong.append(f"{fault}: looks finished")
        if status == DONE and path.exists() and not looks_finished(path):
            made.wrong.append(f"{fault}: said to be done, but is not")
        _mend(disk, path)
        kept = status == REFUSED and name.startswith("read-only")
        _again(fault, path, log, expected, made, stopped=kept)


def _mend(disk: Path, path: Path) -> None:
    _writable_disk(disk)
    if (disk / "elsewhere").exists() and not path.parent.exists():
        os.rename(disk / "elsewhere", path.parent)
    path.parent.mkdir(exist_ok=True)
    for each in (path.parent, *path.parent.rglob("*/")):
        each.chmod(0o777)


def _wait(found: Callable[[], object], seconds: float = 60.0) -> None:
    until = time.monotonic() + seconds
    while not found() and time.monotonic() < until:
        time.sleep(0.001)


# --- sources -----------------------------------------------------------------------------------------------


def _remove(cube: Path) -> None:
    cube.unlink()


def _truncate(cube: Path) -> None:
    os.truncate(cube, cube.stat().st_size // 3)


def _empty(cube: Path) -> None:
    os.truncate(cube, 0)


def _move_all(cube: Path) -> None:
    os.rename(cube.parent, cube.parent.with_name("elsewhere"))


def _rewrite(cube: Path) -> None:
    """Put other values of the same size in the cube's place, as an acquisition that goes on would."""
    cube.write_bytes(bytes(cube.stat().st_size))


SOURCES: dict[str, Callable[[Path], None]] = {
    "cube removed": _remove,
    "cube truncated": _truncate,
    "cube emptied": _empty,
    "cube rewritten": _rewrite,
    "source folder moved": _move_all,
}
"""What happens to the cube that a store is made from."""


def run_source(number: int, folder: Path, collect: Path, expected: dict[str, bytes], made: Outcome) -> None:
    """Let something happen to a cube while its collect is processed, put it back, and run again.

    Parameters
    ----------
    number
        Of the fault.
    folder
        Empty.
    collect
        Folder of a collect, which is copied.
    expected
        Chunks of an undisturbed run.
    made
        Takes the outcome.
    """
    rng = random.Random(f"source:{number}")
    name = list(SOURCES)[number % len(SOURCES)]
    fault = f"source {number} ({name})"
    shutil.copytree(collect, folder / "collect", copy_function=shutil.copy2)
    cube = next((folder / "collect" / "flight").glob("*_0"))
    path = folder / "lot.zarr"
    made.count += 1
    writer = child(process_slowly, folder / "collect" / "collect.toml", path, 0.02)
    after = rng.randrange(SLABS)
    _wait(lambda: chunks_begun(path) >= after or not writer.is_alive())
    SOURCES[name](cube)
    status, said = ended(writer)
    made.notes["stopped" if status == REFUSED else "read before"] += 1
    if status not in (DONE, REFUSED) or (status == REFUSED and cube.name not in said):
        made.wrong.append(f"{fault}: exits with {status}: {said!r:.600}")
    if status == REFUSED and looks_finished(path):
        made.wrong.append(f"{fault}: looks finished")
    shutil.rmtree(folder / "collect", ignore_errors=True)
    shutil.copytree(collect, folder / "collect", copy_function=shutil.copy2)
    status, said = ended(child(process_slowly, folder / "collect" / "collect.toml", path))
    if status != DONE or chunks(path) != expected or not hp.verify(path).ok:
        made.wrong.append(f"{fault}: the rerun exits with {status}, or differs: {said!r:.300}")
    if left := set(os.listdir(folder)) - {"lot.zarr", "collect"}:
        made.wrong.append(f"{fault}: left beside the store: {left}")


# --- all ---------------------------------------------------------------------------------------------------


def undisturbed(folder: Path) -> tuple[dict[str, bytes], int]:
    """Return the chunks of a run on a disk with room, and the bytes of the disk that it took."""
    disk = folder / "log.disk"
    disk.mkdir()
    with small_disk(disk):
        store(disk / "lot.zarr", folder / "log.txt")
        return chunks(disk / "lot.zarr" / GROUP), used_bytes(disk)


def processed(folder: Path) -> tuple[Path, dict[str, bytes]]:
    """Return a small collect's folder, and the chunks of an undisturbed run."""
    hp.simulate_collect(
        folder / "collect", scene="plan", lines=SHAPE[0] * SLABS, bands=12, columns=16, seed=3, truth=False
    )
    hp.process(folder / "collect" / "collect.toml", folder / "whole.zarr")
    return folder / "collect", chunks(folder / "whole.zarr")


def campaign(scale: float = 1.0, *, first: int = 0) -> Iterator[Outcome]:
    """Yield the outcome of every fault; disks that cannot be mounted are an outcome, too."""
    numbers = range(first, first + max(1, round(LEVELS * scale)))
    with tempfile.TemporaryDirectory() as scratch:
        collect, whole = processed(Path(scratch))
        if can_mount():
            expected, total = undisturbed(Path(scratch))
            yield from _each(numbers, "full disks", run_full, expected, total)
            yield from _each(numbers, "read-only and vanishing folders", run_folder, expected)
        else:
            yield Outcome("full disks (no right to mount any)")
        yield from _each(numbers, "vanishing and cut sources", run_source, collect, whole)


def _each(numbers: range, title: str, run: Callable[..., None], *arguments: Any) -> Iterator[Outcome]:
    for number in numbers:
        with tempfile.TemporaryDirectory() as scratch:
            made = Outcome(title)
            run(number, Path(scratch), *arguments, made)
            yield made
