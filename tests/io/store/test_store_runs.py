"""A run's groups get their places beside one another: in order, and none is left behind."""

import errno
import os
import threading
import time
from pathlib import Path
from typing import Any

import dask.array as da
import numpy as np
import pytest
import xarray as xr
from support.refusals import expect_error

import hyperpaint as hp
from hyperpaint.base.errors import IncompleteStoreError, StoreError
from hyperpaint.io.store import list_groups, writer
from hyperpaint.io.store.manifest import INPUTS
from hyperpaint.io.store.writer import Staging, run_contents, whole_run

LINES = tuple(f"flightlines/raw_{number}" for number in range(3))
WAIT_S = 30.0


def line(name: str, at_compute: Any = None) -> xr.Dataset:
    def block() -> np.ndarray:
        if at_compute is not None:
            at_compute()
        return np.full((8, 2, 3), len(name), "uint16")

    cube = da.map_blocks(block, chunks=((8,), (2,), (3,)), dtype="uint16", meta=np.empty((0, 0, 0), "uint16"))
    return xr.Dataset({"counts": (("along_track", "band", "cross_track"), cube)}, attrs={INPUTS: name})


def run(path: Path, at_compute: Any = None) -> None:
    # Write lines as `process` does; ``at_compute`` is called as the second one is computed
    groups = {name: line(name, at_compute if name == LINES[1] else None) for name in LINES}
    with whole_run(
        path, run_contents(groups), groups, {}, command="hyperpaint process lot.toml", overwrite=False
    ) as turn:
        for name, dataset in groups.items():
            turn.write(name, dataset)


@pytest.fixture
def publish(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    # What is called with the group before one gets its place; append to it
    calls: list[Any] = []
    plain = Staging.publish

    def publish(self: Staging, build: Path, group: str) -> None:
        for call in calls:
            call(group)
        plain(self, build, group)

    monkeypatch.setattr(Staging, "publish", publish)
    return calls


def test_a_group_gets_its_place_while_the_next_is_computed(tmp_path: Path, publish: list[Any]) -> None:
    computed, order = threading.Event(), []

    def placed(group: str) -> None:
        if group == LINES[0]:
            assert computed.wait(WAIT_S), "the second group waited for the first"
        order.append(group)

    publish.append(placed)
    run(tmp_path / "lot.zarr", computed.set)
    assert order == list(LINES)
    assert hp.verify(tmp_path / "lot.zarr").ok
    assert os.listdir(tmp_path) == ["lot.zarr"]


@pytest.mark.parametrize("which", LINES)
def test_what_goes_wrong_in_the_background_ends_the_run(
    which: str, path: Path, tmp_path: Path, publish: list[Any]
) -> None:

    def full(group: str) -> None:
        if group == which:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    publish.append(full)
    expect_error(StoreError, "disk-full", lambda: run(path))
    expect_error(IncompleteStoreError, None, lambda: hp.open_store(path))
    assert set(list_groups(path)) == set(LINES[: LINES.index(which)])
    publish.clear()
    run(path)
    assert hp.verify(path).ok
    assert os.listdir(tmp_path) == ["lot.zarr"]


def test_the_store_is_held_until_the_last_group_has_its_place(
    path: Path, tmp_path: Path, publish: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, waits, plain = threading.Event(), [], writer.wait

    def slow(group: str) -> None:
        begun.set()
        time.sleep(0.5)
        assert (tmp_path / ".partial-lot.zarr" / "lock").exists()

    def interrupted(futures: Any) -> Any:
        waits.append(futures)
        if len(waits) < 3:
            raise KeyboardInterrupt
        return plain(futures)

    def stop() -> None:
        assert begun.wait(WAIT_S)
        raise KeyboardInterrupt

    publish.append(slow)
    monkeypatch.setattr(writer, "wait", interrupted)
    expect_error(KeyboardInterrupt, None, lambda: run(path, stop))
    assert (len(waits), set(list_groups(path))) == (3, {LINES[0]})
    assert not (tmp_path / ".partial-lot.zarr" / "lock").exists()
    monkeypatch.undo()
    run(path)
    assert hp.verify(path).ok
    assert os.listdir(tmp_path) == ["lot.zarr"]


def test_groups_follow_one_another_where_a_thread_would_take_room(
    tmp_path: Path, publish: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    threads: set[str] = set()
    publish.append(lambda _: threads.add(threading.current_thread().name))
    monkeypatch.setattr(writer, "thread_space", lambda: 1)
    run(tmp_path / "lot.zarr")
    assert threads == {threading.current_thread().name}
    assert hp.verify(tmp_path / "lot.zarr").ok


def test_what_failed_before_is_a_note_of_the_error(tmp_path: Path, publish: list[Any]) -> None:
    refused = threading.Event()

    def refuse(group: str) -> None:
        if group == LINES[0]:
            refused.set()
            raise StoreError("the disk is gone")

    def end() -> None:
        refused.wait(WAIT_S)
        raise ValueError("no light")

    publish.append(refuse)
    caught = expect_error(ValueError, "no light", lambda: run(tmp_path / "lot.zarr", end))
    assert any("the disk is gone" in note for note in caught.__notes__)
