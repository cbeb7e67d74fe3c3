"""Small disks, and children that write to them; see `disks`."""

from __future__ import annotations

import contextlib
import ctypes
import multiprocessing
import os
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

__all__ = [
    "DELAY_S",
    "DISK_BYTES",
    "DONE",
    "GROUP",
    "LEVELS",
    "NOBODY",
    "OTHER",
    "PAGE_BYTES",
    "REFUSED",
    "SHAPE",
    "SLABS",
    "call",
    "can_mount",
    "child",
    "chunks",
    "chunks_begun",
    "ended",
    "fill_disk",
    "looks_finished",
    "process_slowly",
    "scene_line",
    "slab_values",
    "small_disk",
    "store",
    "used_bytes",
]

LEVELS = 30
GROUP, OTHER = "flightlines/raw_0", "flightlines/raw_1"
DISK_BYTES = 16 * 2**20
PAGE_BYTES = 4096
SLABS, SHAPE = 12, (32, 16, 200)
DELAY_S = 0.02
NOBODY = 65534
DONE, REFUSED = 0, 3
_CONTEXT = multiprocessing.get_context("forkserver")
_CONTEXT.set_forkserver_preload(
    ["xarray", "dask.array", "zarr", "hyperpaint", "hyperpaint.workflows.pipeline", __name__]
)


# --- disks -------------------------------------------------------------------------------------------------


def can_mount() -> bool:
    """Tell whether disks can be made here."""
    try:
        with tempfile.TemporaryDirectory() as scratch, small_disk(Path(scratch)):
            return True
    except (OSError, subprocess.SubprocessError):
        return False


@contextlib.contextmanager
def small_disk(folder: Path) -> Iterator[Path]:
    """Mount a small disk; its folder is anyone's to write."""
    call("mount", "-t", "tmpfs", "-o", f"size={DISK_BYTES},mode=777", "tmpfs", folder)
    try:
        yield folder
    finally:
        with contextlib.suppress(subprocess.SubprocessError):
            call("umount", "-l", folder)


def call(*command: object) -> None:
    subprocess.run([str(word) for word in command], check=True, capture_output=True)


def used_bytes(disk: Path) -> int:
    found = os.statvfs(disk)
    return (found.f_blocks - found.f_bfree) * found.f_frsize


def fill_disk(disk: Path, leave: int) -> None:
    """Let a file of somebody else take the disk's room, but for so many bytes."""
    size = DISK_BYTES - used_bytes(disk) - max(0, leave) // PAGE_BYTES * PAGE_BYTES
    if size > 0:
        with open(disk / "somebody else's", "wb") as file:
            os.posix_fallocate(file.fileno(), 0, size)


# --- what is written ---------------------------------------------------------------------------------------


def slab_values(number: int) -> Any:
    return np.random.default_rng(number).integers(0, 4096, SHAPE, dtype="uint16")


def _slab(log: str, at: int, share: float, total: int, block_id: tuple[int, ...] = ()) -> Any:
    """Return a slab; number ``at`` first lets the disk fill up but for ``share`` of what is lacking."""
    log_file = Path(log)
    with open(log_file, "a") as file:
        file.write(f"{block_id[0]}\n")
    if block_id[0] == at:
        disk = log_file.with_suffix(".disk")
        fill_disk(disk, int(share * (total - used_bytes(disk))))
    time.sleep(DELAY_S)
    return slab_values(block_id[0])


def scene_line(log: Path, at: int = -1, share: float = 1.0, total: int = 0) -> xr.Dataset:
    import dask.array as da

    counts = da.map_blocks(
        _slab,
        log=str(log),
        at=at,
        share=share,
        total=total,
        chunks=((SHAPE[0],) * SLABS, *((size,) for size in SHAPE[1:])),
        dtype="uint16",
        meta=np.empty((0, 0, 0), "uint16"),
    )
    frame = np.arange(SHAPE[0] * SLABS)
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
        sys.exit(REFUSED)
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
    hp.to_store(scene_line(*line), path, GROUP, source_token="a scene", overwrite=True)


def process_slowly(collect: Path, out: Path, delay: float = 0.0) -> None:
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


def chunks_begun(path: Path) -> int:
    """Return how many chunks of the counts an unfinished run has finished."""
    return len(list(path.parent.glob(f".partial-{path.name}/build-*/counts/c/*/0/0")))


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
