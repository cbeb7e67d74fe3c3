"""Disks that fill up, become read-only or vanish, and sources that are cut short, while a store is written.

The disks are small ones in memory, mounted for the purpose, so that the system itself says what is wrong;
that needs root on Linux. Elsewhere disks and folders are not tried, and the campaign says so by failing.
"""

from __future__ import annotations

import contextlib
import ctypes
import multiprocessing
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

import hyperpaint as hp
from hyperpaint.base.errors import PaintError
from hyperpaint.io.store import is_complete, open_store

from .outcome import Outcome

__all__ = ["FOLDERS", "SOURCES", "campaign", "can_mount", "run_folder", "run_full", "run_source"]

LEVELS = 30
GROUP, OTHER = "flightlines/raw_0", "flightlines/raw_1"
DISK_BYTES = 16 * 2**20
_PAGE = 4096
_SLABS, _SHAPE = 12, (32, 16, 200)
_DELAY = 0.02
_NOBODY = 65534
_DONE, _REFUSED = 0, 3
_CONTEXT = multiprocessing.get_context("forkserver")
_CONTEXT.set_forkserver_preload(
    ["xarray", "dask.array", "zarr", "hyperpaint", "hyperpaint.workflows.pipeline", __name__]
)


# --- disks -------------------------------------------------------------------------------------------------


def can_mount() -> bool:
    """Tell whether disks can be made here."""
    try:
        with tempfile.TemporaryDirectory() as scratch, _disk(Path(scratch)):
            return True
    except (OSError, subprocess.SubprocessError):
        return False


@contextlib.contextmanager
def _disk(folder: Path) -> Iterator[Path]:
    """Mount a small disk; its folder is anyone's to write."""
    call("mount", "-t", "tmpfs", "-o", f"size={DISK_BYTES},mode=777", "tmpfs", folder)
    try:
        yield folder
    finally:
        with contextlib.suppress(subprocess.SubprocessError):
            call("umount", "-l", folder)


def call(*command: object) -> None:
    subprocess.run([str(word) for word in command], check=True, capture_output=True)


def _used(disk: Path) -> int:
    found = os.statvfs(disk)
    return (found.f_blocks - found.f_bfree) * found.f_frsize


def _fill(disk: Path, leave: int) -> None:
    """Let a file of somebody else take the disk's room, but for so many bytes."""
    size = DISK_BYTES - _used(disk) - max(0, leave) // _PAGE * _PAGE
    if size > 0:
        with open(disk / "somebody else's", "wb") as file:
            os.posix_fallocate(file.fileno(), 0, size)


# --- what is written ---------------------------------------------------------------------------------------


def _values(number: int) -> Any:
    return np.random.default_rng(number).integers(0, 4096, _SHAPE, dtype="uint16")


def _slab(log: str, at: int, share: float, total: int, block_id: tuple[int, ...] = ()) -> Any:
    """Return a slab; number ``at`` first lets the disk fill up but for ``share`` of what is lacking."""
    log_file = Path(log)
    with open(log_file, "a") as file:
        file.write(f"{block_id[0]}\n")
    if block_id[0] == at:
        disk = log_file.with_suffix(".disk")
        _fill(disk, int(share * (total - _used(disk))))
    time.sleep(_DELAY)
    return _values(block_id[0])


def _line(log: Path, at: int = -1, share: float = 1.0, total: int = 0) -> xr.Dataset:
    import dask.array as da

    counts = da.map_blocks(
        _slab,
        log=str(log),
        at=at,
        share=share,
        total=total,
        chunks=((_SHAPE[0],) * _SLABS, *((size,) for size in _SHAPE[1:])),
        dtype="uint16",
        meta=np.empty((0, 0, 0), "uint16"),
    )
    frame = np.arange(_SHAPE[0] * _SLABS)
    return xr.Dataset(
        {"counts": (("along_track", "band", "cross_track"), counts)}, {"frame": ("along_track", frame)}
    )


def child(work: Callable[..., object], *arguments: Any, common: bool = False) -> Any:
    """Start a child, which heeds permissions as a common user does; its ``report`` says how it ended."""
    descriptor, report = tempfile.mkstemp(prefix="hyperpaint-report-")
    os.close(descriptor)
    process = _CONTEXT.Process(target=_reported, args=(Path(report), common, work, *arguments))
    process.start()
    process.report = Path(report)
    return process


def _reported(report: Path, common: bool, work: Callable[..., object], *arguments: Any) -> None:
    import dask

    if common:
        _drop_capabilities()
    try:
        with dask.config.set(scheduler="threads", num_workers=1):
            work(*arguments)
    except PaintError as error:
        report.write_text(str(error))
        sys.exit(_REFUSED)
    except BaseException:
        report.write_text(traceback.format_exc()[-800:])
        sys.exit(1)


def _drop_capabilities() -> None:
    """Let permission bits hold for root; another user may not be able to read Python itself."""
    header, none = (ctypes.c_uint32 * 2)(0x20080522, 0), (ctypes.c_uint32 * 6)()
    if ctypes.CDLL(None, use_errno=True).capset(header, none):
        raise OSError(ctypes.get_errno(), "capset")


def ended(process: Any) -> tuple[int, str]:
    """Wait for a child; return its exit status and what it said."""
    process.join(120)
    if process.is_alive():
        process.kill()
        process.join()
    said = process.report.read_text()
    process.report.unlink()
    return process.exitcode, said


def store(path: Path, *line: Any) -> None:
    hp.to_store(_line(*line), path, GROUP, source_token="a scene", overwrite=True)


def _process(collect: Path, out: Path, delay: float = 0.0) -> None:
    """Process a collect, slowly enough for something to happen meanwhile."""
    from hyperpaint.io.store import chunks

    plain = chunks.write_chunk

    def slow(folder: Path, *rest: Any) -> None:
        time.sleep(delay)
        plain(folder, *rest)

    chunks.write_chunk = slow
    hp.process(collect, out)


def chunks(path: Path) -> dict[str, bytes]:
    files = (file for file in sorted(path.rglob("*")) if file.is_file() and "c" in file.parts)
    return {str(file.relative_to(path)): file.read_bytes() for file in files}


def _begun(path: Path) -> int:
    """Return how many chunks of the counts an unfinished run has finished."""
    return len(list(path.parent.glob(f".partial-{path.name}/build-*/counts/c/*/0/.0.done")))


def looks_finished(path: Path, group: str = GROUP) -> bool:
    """Tell whether any of our readers takes a group for whole."""
    if is_complete(path, group):
        return True
    try:
        open_store(path, group)
    except PaintError:
        pass
    else:
        return True
    try:
        return hp.verify(path).ok and path.joinpath(group).exists()
    except PaintError:
        return False


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
    at = rng.randrange(_SLABS)
    share = level / LEVELS if level % 2 == 0 else 1.0
    pages = 0 if level % 2 == 0 else level // 2
    disk, log = folder / "log.disk", folder / "log.txt"
    disk.mkdir()
    made.count += 1
    with _disk(disk):
        path = disk / "lot.zarr"
        # told before anything is written
        _fill(disk, int(share * total) // 2)
        status, said = ended(child(store, path, log))
        if status != _REFUSED or not re.search(r"\d MiB of disk are needed, \d+ MiB are free", said):
            made.wrong.append(f"full {number}: before: exits with {status}: {said!r:.300}")
        if log.exists() or set(os.listdir(disk)) != {"somebody else's"}:
            made.wrong.append(f"full {number}: before: written or read: {os.listdir(disk)}")
        _free(disk)
        # filled up meanwhile
        status, said = ended(child(store, path, log, at, share, total - pages * _PAGE))
        made.notes["stopped" if status == _REFUSED else "written in what was left"] += 1
        if status == _REFUSED:
            if "No space left" not in said or not re.search(r"may take \d+ MiB in all, .* make room", said):
                made.wrong.append(f"full {number}: said {said!r:.300}")
            if looks_finished(path):
                made.wrong.append(f"full {number}: looks finished")
        elif status != _DONE:
            made.wrong.append(f"full {number}: exits with {status}: {said!r:.600}")
        _free(disk)
        _again(f"full {number}", path, log, expected, made, stopped=status == _REFUSED)


def _free(disk: Path) -> None:
    (disk / "somebody else's").unlink(missing_ok=True)


def _again(
    fault: str, path: Path, log: Path, expected: dict[str, bytes], made: Outcome, *, stopped: bool
) -> None:
    """Run once more; what was finished is not computed again, and the same bytes come out."""
    finished = _begun(path) if stopped and not path.joinpath(GROUP).exists() else None
    before = len(log.read_text().split()) if log.exists() else 0
    status, said = ended(child(store, path, log))
    computed = len(log.read_text().split()) - before
    if status != _DONE:
        made.wrong.append(f"{fault}: the rerun exits with {status}: {said!r:.300}")
        return
    if finished is not None:
        made.notes["chunks taken up"] += finished
        if computed != _SLABS - finished:
            made.wrong.append(f"{fault}: {finished} chunks were finished, but {computed} were computed again")
    if chunks(path / GROUP) != expected or not hp.verify(path).ok:
        made.wrong.append(f"{fault}: the rerun differs from an undisturbed run")
    if left := set(os.listdir(path.parent)) - {path.name}:
        made.wrong.append(f"{fault}: left beside the store: {left}")


# --- folders -----------------------------------------------------------------------------------------------


def _read_only_disk(disk: Path, _path: Path) -> None:
    for _ in range(500):  # not while a file is open
        with contextlib.suppress(subprocess.SubprocessError):
            call("mount", "-o", "remount,ro", disk)
            return


def _writable_disk(disk: Path) -> None:
    with contextlib.suppress(subprocess.SubprocessError):
        call("mount", "-o", "remount,rw", disk)


def _read_only_folders(_disk: Path, path: Path) -> None:
    with contextlib.suppress(OSError):
        for folder in (path.parent, *path.parent.rglob("*/")):
            folder.chmod(0o555)


def _remove_partial(_disk: Path, path: Path) -> None:
    shutil.rmtree(path.with_name(f".partial-{path.name}"), ignore_errors=True)


def _remove_some_chunks(_disk: Path, path: Path) -> None:
    for chunk in list(path.parent.glob(f".partial-{path.name}/build-*/counts/c/*/0/0"))[:2]:
        chunk.unlink(missing_ok=True)


def _move_folder(disk: Path, path: Path) -> None:
    with contextlib.suppress(OSError):
        os.rename(path.parent, disk / "elsewhere")


def _remove_folder(_disk: Path, path: Path) -> None:
    shutil.rmtree(path.parent, ignore_errors=True)


def _remove_store(_disk: Path, path: Path) -> None:
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
    with _disk(disk):
        path = disk / "flights" / "lot.zarr"
        path.parent.mkdir()
        hp.to_store(xr.Dataset({"a": ("x", [1.0])}), path, OTHER)
        for each in (path.parent, *path.parent.rglob("*")):
            os.chown(each, _NOBODY, _NOBODY)
            each.chmod(0o777 if each.is_dir() else 0o666)
        if from_start:
            FOLDERS[name](disk, path)
        writer = child(store, path, log, common=name == "read-only folders")
        if not from_start:
            after = rng.randrange(_SLABS)
            _wait(lambda: _begun(path) >= after or not writer.is_alive())
            time.sleep(rng.uniform(0.0, 0.02))
            FOLDERS[name](disk, path)
        status, said = ended(writer)
        made.notes["stopped" if status == _REFUSED else "written"] += 1
        if status not in (_DONE, _REFUSED) or (status == _REFUSED and "lot.zarr" not in said):
            made.wrong.append(f"{fault}: exits with {status}: {said!r:.600}")
        if status == _REFUSED and looks_finished(path):
            made.wrong.append(f"{fault}: looks finished")
        if status == _DONE and path.exists() and not looks_finished(path):
            made.wrong.append(f"{fault}: said to be done, but is not")
        _mend(disk, path)
        kept = status == _REFUSED and name.startswith("read-only")
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
    writer = child(_process, folder / "collect" / "collect.toml", path, 0.02)
    after = rng.randrange(_SLABS)
    _wait(lambda: _begun(path) >= after or not writer.is_alive())
    SOURCES[name](cube)
    status, said = ended(writer)
    made.notes["stopped" if status == _REFUSED else "read before"] += 1
    if status not in (_DONE, _REFUSED) or (status == _REFUSED and cube.name not in said):
        made.wrong.append(f"{fault}: exits with {status}: {said!r:.600}")
    if status == _REFUSED and looks_finished(path):
        made.wrong.append(f"{fault}: looks finished")
    shutil.rmtree(folder / "collect", ignore_errors=True)
    shutil.copytree(collect, folder / "collect", copy_function=shutil.copy2)
    status, said = ended(child(_process, folder / "collect" / "collect.toml", path))
    if status != _DONE or chunks(path) != expected or not hp.verify(path).ok:
        made.wrong.append(f"{fault}: the rerun exits with {status}, or differs: {said!r:.300}")
    if left := set(os.listdir(folder)) - {"lot.zarr", "collect"}:
        made.wrong.append(f"{fault}: left beside the store: {left}")


# --- all ---------------------------------------------------------------------------------------------------


def undisturbed(folder: Path) -> tuple[dict[str, bytes], int]:
    """Return the chunks of a run on a disk with room, and the bytes of the disk that it took."""
    disk = folder / "log.disk"
    disk.mkdir()
    with _disk(disk):
        store(disk / "lot.zarr", folder / "log.txt")
        return chunks(disk / "lot.zarr" / GROUP), _used(disk)


def processed(folder: Path) -> tuple[Path, dict[str, bytes]]:
    """Return a small collect's folder, and the chunks of an undisturbed run."""
    hp.simulate_collect(
        folder / "collect", scene="plan", lines=_SHAPE[0] * _SLABS, bands=12, columns=16, seed=3, truth=False
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
