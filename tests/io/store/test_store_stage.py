"""Staging: what changes places, what a killed writer left, and what somebody else put there."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

from hyperpaint.base.errors import StoreError
from hyperpaint.io.store import is_complete, lock as locks, open_store, stage, to_store, verify
from hyperpaint.io.store.stage import Staging, staging
from hyperpaint.io.store.swap import exchange


def small(value: int = 1) -> xr.Dataset:
    return xr.Dataset({"a": ("x", np.full(5, value))})


@pytest.fixture
def path(tmp_path: Path) -> Path:
    to_store(small(), tmp_path / "lot.zarr", "flightlines/raw_0")
    return tmp_path / "lot.zarr"


def partial(path: Path) -> Path:
    folder = path.parent / f".partial-{path.name}"
    folder.mkdir(exist_ok=True)
    return folder


def write(path: Path, value: int = 2, group: str = "other", **options: Any) -> None:
    to_store(small(value), path, group, **options)


# --- the folder --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name", ["..%2Fescaped", "flightlines%2F..%2F..%2Fescaped", "%2e%2e", ".x", "", "a%2F"]
)
def test_names_that_lead_out_are_refused(name: str, path: Path) -> None:
    hostile = partial(path) / f"replaced-{name}"
    hostile.mkdir()
    (hostile / "zarr.json").write_text("{}")
    with pytest.raises(StoreError, match="names no group"):
        write(path)
    assert sorted(os.listdir(path.parent)) == [".partial-lot.zarr", "lot.zarr"]
    assert hostile.is_dir()


@pytest.mark.parametrize("name", ["replaced-g", "build-other-x-y", "discarded-1", "notes"])
def test_links_in_the_folder_are_refused(name: str, path: Path, tmp_path: Path) -> None:
    (tmp_path / "precious").mkdir()
    (tmp_path / "precious/keep").touch()
    (partial(path) / name).symlink_to(tmp_path / "precious")
    with pytest.raises(StoreError, match="is a link"):
        write(path)
    assert os.listdir(tmp_path / "precious") == ["keep"]


def test_a_link_for_the_folder_is_refused(path: Path, tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere/build-x-1").mkdir()
    (tmp_path / ".partial-lot.zarr").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(StoreError, match="is a link"):
        write(path)
    assert os.listdir(tmp_path / "elsewhere") == ["build-x-1"]


def test_an_old_group_is_not_put_back_through_a_link(path: Path, tmp_path: Path) -> None:
    (tmp_path / "outside").mkdir()
    (path / "more").symlink_to(tmp_path / "outside")
    (partial(path) / "replaced-more%2Fraw_0").mkdir()
    with pytest.raises(StoreError, match="is a link"), staging(path):
        pass
    assert os.listdir(tmp_path / "outside") == []


def test_an_old_group_is_put_back_though_its_parent_is_gone(path: Path) -> None:
    os.rename(path / "flightlines/raw_0", partial(path) / "replaced-flightlines%2Fraw_0")
    (path / "flightlines/zarr.json").unlink()
    (path / "flightlines").rmdir()
    with staging(path):
        pass
    assert open_store(path, "flightlines/raw_0")["a"][0] == 1
    write(path)
    assert verify(path).ok


def test_what_is_half_removed_does_not_come_back(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    remove = shutil.rmtree

    def die(folder: Any, *args: Any, **options: Any) -> None:
        if "discarded-" in str(folder) or "replaced-" in str(folder):
            raise KeyboardInterrupt
        remove(folder, *args, **options)

    monkeypatch.setattr(stage, "exchange", lambda *_: False)
    with monkeypatch.context() as patch:
        patch.setattr(shutil, "rmtree", die)
        with pytest.raises(KeyboardInterrupt):
            write(path, 2, "flightlines/raw_0", overwrite=True)
    assert not list(partial(path).glob("replaced-*"))
    assert open_store(path, "flightlines/raw_0")["a"][0] == 2


# --- half-written files ------------------------------------------------------------------------------------


def test_only_our_half_written_files_are_removed(path: Path, tmp_path: Path) -> None:
    outside = tmp_path / "outside"
    outside.mkdir()
    ours = [
        path / ".zarr.json.4711",
        path / "flightlines/.zarr.json.12",
        path / f"flightlines/raw_0/zarr.{'0f' * 16}.partial",
    ]
    foreign = [
        path / "thesis.partial",
        path / "flightlines/raw_0/notes.partial",
        path / ".zarr.json.backup",
        path / "flightlines/photos/.zarr.json.1",
        outside / ".zarr.json.1",
    ]
    (path / "flightlines/photos").mkdir()
    (path / "linked").symlink_to(outside)
    for file in (*ours, *foreign):
        file.write_text("x")
    with staging(path):
        pass
    assert not any(file.exists() for file in ours)
    assert all(file.exists() for file in foreign)


# --- change of places --------------------------------------------------------------------------------------


def test_two_folders_change_places(tmp_path: Path) -> None:
    for name in "ab":
        (tmp_path / name).mkdir()
        (tmp_path / name / f"of-{name}").touch()
    if not exchange(tmp_path / "a", tmp_path / "b"):
        pytest.skip("this system cannot exchange two names")
    assert os.listdir(tmp_path / "a") == ["of-b"]
    with pytest.raises(FileNotFoundError):
        exchange(tmp_path / "a", tmp_path / "c")


@pytest.mark.parametrize("exchanging", [True, False])
@pytest.mark.parametrize("failing", range(1, 4))
@pytest.mark.parametrize("group", ["", "flightlines/raw_0"])
def test_the_old_group_stands_where_publishing_fails(
    group: str, failing: int, exchanging: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "lot.zarr"
    to_store(small(), path, group)
    if not exchanging:
        monkeypatch.setattr(stage, "exchange", lambda *_: False)
    rename, calls = os.rename, iter(range(1, 100))

    def fail(source: Any, target: Any) -> None:
        if next(calls) == failing:
            raise PermissionError(13, "Permission denied", os.fspath(source))
        rename(source, target)

    made = Staging(path)
    build = made.build(group, "content")
    build.mkdir(parents=True)
    monkeypatch.setattr(os, "rename", fail)
    with contextlib.suppress(PermissionError):
        made.publish(build, group)
    monkeypatch.undo()
    there = path / group
    assert there.is_dir()
    assert is_complete(path, group) or not os.listdir(there)


# --- the lock ----------------------------------------------------------------------------------------------


@pytest.fixture
def lock(tmp_path: Path) -> Path:
    return partial(tmp_path / "lot.zarr") / "lock"


def owner(**entries: object) -> str:
    return json.dumps({**locks._owner("token of a dead one"), **entries})


def dies_before(seconds: float, lock: Path) -> None:
    begun = time.monotonic()
    write(lock.parent.parent / "lot.zarr")
    assert time.monotonic() - begun < seconds
    assert not lock.parent.exists()


@pytest.mark.parametrize(
    "make",
    [
        lambda lock: os.mkfifo(lock),
        lambda lock: lock.mkdir(),
        lambda lock: lock.write_text("[" * 4000),
        lambda lock: lock.write_text('{"host": "a"}' + " " * 10**6),
        lambda lock: lock.write_bytes(b"\xff\xfe\x00"),
    ],
)
def test_what_is_no_lock_is_refused(make: Callable[[Path], None], lock: Path) -> None:
    make(lock)
    with pytest.raises(StoreError, match="delete it once you know"):
        write(lock.parent.parent / "lot.zarr")


def test_a_link_for_a_lock_is_refused(lock: Path, tmp_path: Path) -> None:
    (tmp_path / "precious").write_text("x")
    lock.symlink_to(tmp_path / "precious")
    with pytest.raises(StoreError, match="is a link"):
        write(tmp_path / "lot.zarr")
    assert (tmp_path / "precious").read_text() == "x"


@pytest.mark.parametrize("pid", [2**64, -1, True, "1", None])
def test_odd_process_numbers_are_those_of_the_dead(pid: object, lock: Path) -> None:
    lock.write_text(owner(pid=pid))
    dies_before(5, lock)


def test_our_own_stale_lock_is_taken_over_at_once(lock: Path) -> None:
    lock.write_text(owner())
    dies_before(5, lock)


def test_our_own_lock_is_respected(lock: Path) -> None:
    with locks.locked(lock, lock.parent), pytest.raises(StoreError, match=f"by process {os.getpid()}"):
        write(lock.parent.parent / "lot.zarr")
    assert not lock.exists()


@pytest.mark.parametrize("entries", [{"namespace": "pid:[1]"}, {"boot": "another", "machine": None}])
def test_writers_that_cannot_be_seen_are_respected(entries: dict[str, Any], lock: Path) -> None:
    here = locks._here()
    if any(here[key] is None for key in entries if key != "machine"):
        pytest.skip("the system does not tell")
    # its number is that of nobody here
    lock.write_text(owner(pid=2**30, **entries))
    with pytest.raises(StoreError, match=r"being written by process 1073741824.*or delete"):
        write(lock.parent.parent / "lot.zarr")
    assert lock.exists()


def test_a_lock_from_before_the_last_boot_is_taken_over(lock: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    here = {"host": socket.gethostname(), "machine": "m", "boot": "b", "namespace": "n"}
    monkeypatch.setattr(locks, "_here", lambda: dict(here))
    lock.write_text(owner(boot="earlier", pid=os.getpid()))
    dies_before(5, lock)


def test_another_writers_lock_is_left_alone(lock: Path) -> None:
    with locks.locked(lock, lock.parent):
        lock.write_text("another's, who was told that we are dead")
    assert lock.read_text().startswith("another's")


@pytest.fixture(autouse=True)
def _no_lock_is_left() -> Iterator[None]:
    yield
    assert not locks._HELD
