"""Disks that are full or vanish, and power cuts: told before or told cleanly, and nothing looks finished."""

import errno
import os
import shutil
from collections import namedtuple
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import dask
import dask.array as da
import numpy as np
import pytest
import xarray as xr
from support.refusals import expect_error

from hyperpaint.base.errors import StoreError
from hyperpaint.io.store import budget, computing, is_complete, to_store, verify, writer
from hyperpaint.io.store.computing import check_disk, disk_needed

CUBE = ("along_track", "band", "cross_track")
GROUP = "flightlines/raw_0"
Usage = namedtuple("Usage", "total used free")


def line(lines: int = 128, chunk: int = 32, name: str = "counts") -> xr.Dataset:
    values = np.arange(lines * 6, dtype="uint16").reshape(lines, 2, 3)
    return xr.Dataset({name: (CUBE, da.from_array(values, chunks=(chunk, 2, 3)))})


def free(monkeypatch: pytest.MonkeyPatch, size: int) -> None:
    monkeypatch.setattr(computing.shutil, "disk_usage", lambda _: Usage(10**12, 10**12, size))


# --- disk --------------------------------------------------------------------------------------------------


def test_a_full_disk_is_told_before_anything_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    unread = line()
    never = mock.Mock(side_effect=AssertionError)
    unread["counts"] = unread.counts.copy(
        data=unread.counts.data.map_blocks(never, dtype="uint16", meta=np.empty((0, 0, 0), "uint16"))
    )
    free(monkeypatch, 1000)
    expect_error(StoreError, "disk-short", lambda: to_store(unread, tmp_path / "far" / "lot.zarr", GROUP))
    assert not any(tmp_path.iterdir())


def test_what_is_there_already_needs_no_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    to_store(line(), tmp_path / "lot.zarr", GROUP)
    free(monkeypatch, 0)
    to_store(line(), tmp_path / "lot.zarr", GROUP)
    expect_error(
        StoreError, "disk-short", lambda: to_store(line(160), tmp_path / "lot.zarr", GROUP, overwrite=True)
    )


def test_only_what_is_taken_up_is_taken_off(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = {"one": line()}
    needed = disk_needed(whole["one"])
    content = writer.Job("one", whole["one"], writer.token_of(whole["one"], "token")).build
    free(monkeypatch, needed - 500)
    expect_error(StoreError, "disk-short", lambda: writer.check_room(whole, path, {"one": "token"}))
    attempt = "0" * 12
    ours = f"build-one-{content}-{attempt}"
    for build in (ours, f"build-two-{content}-{attempt}", f"build-one-other-{attempt}", "replaced-one"):
        folder = tmp_path / ".partial-lot.zarr" / build
        folder.mkdir(parents=True)
        (folder / "chunk").write_bytes(bytes(600))
        if build == ours:
            writer.check_room(whole, path, {"one": "token"})
            shutil.rmtree(folder)
    expect_error(StoreError, "disk-short", lambda: writer.check_room(whole, path, {"one": "token"}))


def test_a_small_group_asks_for_little_but_for_every_chunk(tmp_path: Path) -> None:
    assert disk_needed(xr.Dataset({"a": ("x", [1.0])})) < 150_000
    to_store(line(6400), tmp_path / "lot.zarr")
    blocks = sum(path.stat().st_blocks for path in (tmp_path / "lot.zarr").rglob("*"))
    assert 512 * blocks < disk_needed(line(6400)) < 4_000_000


def test_a_disk_of_unknown_size_is_no_reason_to_refuse(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        computing.shutil, "disk_usage", mock.Mock(side_effect=OSError(errno.ENOSYS, "unknown"))
    )
    check_disk(tmp_path / "lot.zarr", 10**15)


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT])
def test_a_disk_that_fills_up_says_what_was_needed(number: int, path: Path, tmp_path: Path) -> None:
    plain, write = computing.replace_file, partial(to_store, line(), path, GROUP, source_token="a")

    def full(file: Path, parts: Any, **options: Any) -> None:
        if "c/2/" in str(file):
            raise OSError(number, os.strerror(number), str(file))
        plain(file, parts, **options)

    with dask.config.set(scheduler="synchronous"):
        with mock.patch.object(computing, "replace_file", full):
            expect_error(StoreError, "disk-full", write)
        assert not is_complete(path, GROUP)
        assert verify(write()).ok
    assert os.listdir(tmp_path) == ["lot.zarr"]


# --- errors of the system ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (MemoryError(), "memory-short"),
        (RuntimeError("can't start new thread"), "memory-short"),
        (FileNotFoundError(errno.ENOENT, "gone", "/far/raw_0"), "file-unusable"),
        (PermissionError(errno.EACCES, "no right", "lot.zarr/zarr.json"), "file-unusable"),
        (OSError("odd"), "file-unusable"),
    ],
)
def test_errors_of_the_system_are_told(error: Exception, told: str, tmp_path: Path) -> None:
    location = writer.Location.of("lot.zarr")
    with pytest.raises(StoreError, match=told), computing.errors_of_the_system(location, {GROUP: line()}):
        raise error


def test_other_errors_stay_as_they_are() -> None:
    location = writer.Location.of("lot.zarr")
    for error in (RuntimeError("other"), ValueError("wrong"), StoreError("ours")):
        with pytest.raises(type(error), match=f"^{error}$"), computing.errors_of_the_system(location, {}):
            raise error


# --- memory ------------------------------------------------------------------------------------------------


def test_blocks_that_cannot_fit_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    huge = da.zeros((64_000, 272, 640), chunks=(32_000, 272, 640), dtype="uint16")
    monkeypatch.setattr(budget, "available_memory", lambda: 2**30)
    expect_error(
        StoreError,
        "memory-short",
        lambda: to_store(xr.Dataset({"counts": (CUBE, huge)}), tmp_path / "lot.zarr", GROUP),
    )
    assert not any(tmp_path.iterdir())


# --- power cuts --------------------------------------------------------------------------------------------


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="open files are named in Linux's /proc")
def test_everything_is_flushed_before_the_place(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flushed: list[str] = []  # files and folders, in the order in which they were flushed
    states: list[tuple[int, list[str]]] = []
    fsync, plain = os.fsync, writer.Staging.publish

    def note(descriptor: int) -> None:
        flushed.append(os.readlink(f"/proc/self/fd/{descriptor}"))
        fsync(descriptor)

    def publish(stage: Any, build: Path, group: str) -> None:
        states.append((len(flushed), [str(build), *map(str, build.rglob("*"))]))
        plain(stage, build, group)

    monkeypatch.setattr(os, "fsync", note)
    monkeypatch.setattr(writer.Staging, "publish", publish)
    to_store(line().assign_coords(frame=("along_track", np.arange(128))), path, GROUP)
    ((count, present),) = states
    assert set(present) <= set(flushed[:count])
    assert {str(path / "flightlines"), str(path), str(tmp_path)} <= set(flushed[count:])
    # documents of the groups above come under another name, and replace what is there
    temporary = {name.partition("/.zarr.json.")[0] for name in flushed if "/.zarr.json." in name}
    assert {str(path), str(path / "flightlines")} <= temporary


def test_a_chunk_that_somebody_removed_is_missed(tmp_path: Path) -> None:
    plain, write = (
        writer.flush_group,
        partial(to_store, line(), tmp_path / "lot.zarr", GROUP, source_token="a"),
    )

    def clear_up(folder: Path, expected: list[Path]) -> None:
        (folder / "counts/c/1/0/0").unlink()
        plain(folder, expected)

    with mock.patch.object(writer, "flush_group", clear_up):
        expect_error(StoreError, "file-unusable", write)
    assert not (tmp_path / "lot.zarr").exists()
    assert verify(write()).ok


def test_a_rerun_clears_up_behind_a_writer_that_died_at_its_end(tmp_path: Path) -> None:
    path, partial = tmp_path / "lot.zarr", tmp_path / ".partial-lot.zarr"
    to_store(line(), path, GROUP, source_token="a")
    partial.mkdir()
    (partial / "lock").write_text("{}")
    to_store(line(), path, GROUP, source_token="a")
    assert not partial.exists()
    # what another group was built of is left for its own rerun
    (partial / "build-other-1-1").mkdir(parents=True)
    to_store(line(), path, GROUP, source_token="a")
    assert (partial / "build-other-1-1").exists()


def test_a_disk_that_refuses_to_flush_leaves_nothing_finished(tmp_path: Path) -> None:
    write = partial(to_store, line(), tmp_path / "lot.zarr", GROUP, source_token="a")
    with mock.patch.object(computing, "sync", side_effect=OSError(errno.EIO, "broken disk")):
        expect_error(StoreError, "broken disk", write)
    assert not is_complete(tmp_path / "lot.zarr", GROUP)
    assert verify(write()).ok
