"""Killed writers, damaged stores, two writers: nothing half-written or damaged is taken for whole."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import dask.array as da
import numpy as np
import pytest
import xarray as xr
import zarr
from support.refusals import expect_error, expect_errors

from hyperpaint.base.errors import StoreError
from hyperpaint.io.store import is_complete, list_groups, open_store, to_store, verify
from hyperpaint.io.store.writer import MARK_TEXT, staging

CUBE = ("along_track", "band", "cross_track")
GROUP = "flightlines/raw_0"

LINES = 20 * 32


def slab(block_id: tuple[int, ...] = (), delay: float = 0.0) -> np.ndarray:
    time.sleep(delay)
    return np.random.default_rng(block_id[0]).integers(0, 4096, (32, 4, 50), dtype="uint16")


def slow_line(name: str, delay: float = 0.0) -> xr.Dataset:
    blocks = ((32,) * (LINES // 32), (4,), (50,))
    meta = np.empty((0, 0, 0), "uint16")
    counts = da.map_blocks(slab, delay=delay, chunks=blocks, dtype="uint16", meta=meta, name=f"slab-{name}")
    return xr.Dataset({"counts": (CUBE, counts)})


WRITER = """
import importlib.util, pathlib, sys
import dask
from hyperpaint.io.store import to_store

sys.path.append(str(pathlib.Path(sys.argv[1]).parents[2]))
spec = importlib.util.spec_from_file_location("faults", sys.argv[1])
faults = importlib.util.module_from_spec(spec)
spec.loader.exec_module(faults)
print("ready", flush=True)
with dask.config.set(scheduler="threads", num_workers=1):
    to_store(faults.slow_line("new", delay=0.03), sys.argv[2], faults.GROUP, overwrite=True)
print("done", flush=True)
"""


@pytest.fixture
def store(tmp_path: Path) -> Path:
    rng = np.random.default_rng(0)
    for number in range(2):
        line = xr.Dataset(
            {
                "counts": (CUBE, rng.integers(0, 4096, (70, 3, 50), dtype="uint16")),
                "radiance_gain": (("band", "cross_track"), rng.random((3, 50), dtype="float32")),
            },
            coords={"wavelength": ("band", [400.0, 500.0, 600.0]), "frame": ("along_track", np.arange(70))},
        )
        to_store(line, tmp_path / "lot.zarr", f"flightlines/raw_{number}")
    return tmp_path / "lot.zarr"


def chunk(store: Path, key: str = "counts/c/1/0/0") -> Path:
    return store / GROUP / key


def start_writer(path: Path) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", WRITER, __file__, str(path)]
    writer = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert writer.stdout is not None
    assert writer.stdout.readline() == "ready\n"
    return writer


def wait_for(found: Callable[[], object], seconds: float = 30.0) -> None:
    until = time.monotonic() + seconds
    while not found():
        assert time.monotonic() < until, "waited in vain"
        time.sleep(0.005)


def chunks_built(path: Path) -> int:
    return len(list((path.parent / f".partial-{path.name}").glob("build-*/counts/c/*/0/0")))


@pytest.mark.parametrize(
    # at random instants and before each call: campaigns/faults/interruptions.py
    "chunks_before_kill",
    [3, 20],
)
@pytest.mark.slow
def test_killed_writer(chunks_before_kill: int, path: Path, tmp_path: Path) -> None:
    to_store(slow_line("old").isel(along_track=slice(70)), path, GROUP)
    writer = start_writer(path)
    wait_for(lambda: chunks_built(path) >= chunks_before_kill or writer.poll() is not None)
    if chunks_before_kill < 20:  # it is writing
        other = xr.Dataset({"a": ("x", [1.0])})
        expect_error(StoreError, "store-locked", lambda: to_store(other, path, "other"))
    writer.send_signal(signal.SIGKILL)
    writer.communicate(timeout=60)
    assert is_complete(path, GROUP)
    if chunks_before_kill < 20:
        # what was there is there still
        assert open_store(path, GROUP).sizes["along_track"] == 70
        assert verify(path).ok
    to_store(slow_line("new"), path, GROUP, overwrite=True)
    np.testing.assert_array_equal(
        open_store(path, GROUP).counts, np.concatenate([slab((i,)) for i in range(LINES // 32)])
    )
    assert verify(path).ok
    assert os.listdir(tmp_path) == ["lot.zarr"]


def test_kill_between_the_two_renames_gives_the_old_group_back(store: Path) -> None:
    partial = store.parent / f".partial-{store.name}"
    partial.mkdir()
    (partial / "hyperpaint").write_bytes(MARK_TEXT)
    os.rename(store / GROUP, partial / "replaced-flightlines%2Fraw_0")
    (partial / f"build-x-{'0' * 32}-{'0' * 12}").mkdir()  # as a writer names it
    (store / ".zarr.json.123").write_text("{")
    with staging(store):
        assert is_complete(store, GROUP)
    assert not partial.exists()
    assert verify(store).ok


@pytest.mark.parametrize("stage", ["unlisted", "listed late"])
def test_kill_before_the_root_is_consolidated(stage: str, store: Path) -> None:
    root = json.loads((store / "zarr.json").read_text())
    if stage == "unlisted":
        del root["consolidated_metadata"]
    else:
        for name in [n for n in root["consolidated_metadata"]["metadata"] if n.startswith(GROUP)]:
            del root["consolidated_metadata"]["metadata"][name]
    (store / "zarr.json").write_text(json.dumps(root))
    assert not verify(store).ok
    source = open_store(store, GROUP).compute()
    expect_error(StoreError, "store-exists", lambda: to_store(source, store, GROUP))
    assert verify(to_store(source, store, GROUP, overwrite=True)).ok
    xr.open_zarr(store, group=GROUP)


def test_missing_store_and_group_are_named(store: Path) -> None:
    expect_errors(
        (StoreError, "group-unknown", lambda: open_store(store, "flightlines/raw_7")),
        (StoreError, "store-unreadable", lambda: list_groups(store.parent / "none.zarr")),
        (StoreError, "store-unreadable", lambda: verify(store.parent / "none.zarr")),
    )


#: What happens to the chunks of a group; damaged, exchanged and stale ones: test_store_reading.py.
CHUNKS: dict[str, Callable[[Path], object]] = {
    "deleted": lambda store: chunk(store).unlink(),
    "stray": lambda store: shutil.copy(chunk(store), chunk(store).with_name("1")),
    "small one deleted": lambda store: chunk(store, "frame/c/0").unlink(),
}


@pytest.mark.parametrize("damage", CHUNKS.values(), ids=CHUNKS)
def test_damaged_chunks_are_seen_by_verify(damage: Callable[[Path], object], store: Path) -> None:
    damage(store)
    report = verify(store)
    assert not report.ok
    assert all(line.startswith("/flightlines/raw_0/") for line in report.problems)
    assert len(report.problems) == 1


def _group_of_another(store: Path) -> None:
    shutil.rmtree(store / GROUP)
    shutil.copytree(store / "flightlines/raw_1", store / GROUP)


def _content_damaged(store: Path) -> None:
    path = store / GROUP / "zarr.json"
    path.write_text(path.read_text().replace('"hyperpaint_content"', '"hyperpaint_contend"'))


METADATA: dict[str, Callable[[Path], object]] = {
    "array gone": lambda store: shutil.rmtree(store / GROUP / "radiance_gain"),
    "group gone": lambda store: shutil.rmtree(store / GROUP),
    "of an array changed": lambda store: zarr.open_array(store / GROUP / "counts").attrs.update(units="W"),
    "attributes changed": lambda store: zarr.open_group(store / GROUP).attrs.update(created="long ago"),
    "JSON damaged": lambda store: (store / GROUP / "counts/zarr.json").write_text("[" * 100_000),
    "array of another": lambda store: shutil.copy(
        store / "flightlines/raw_1/counts/zarr.json", store / GROUP / "frame"
    ),
    "group of another": _group_of_another,
    "content damaged": _content_damaged,
    "of the group damaged": lambda store: (store / GROUP / "zarr.json").write_text(""),
}


@pytest.mark.parametrize("damage", METADATA.values(), ids=METADATA)
def test_damaged_metadata(damage: Callable[[Path], object], store: Path) -> None:
    damage(store)
    assert not verify(store).ok
    assert not is_complete(store, GROUP)
    expect_error(StoreError, None, lambda: open_store(store, GROUP))
    # the other group is none the worse, and this one can be written again
    assert is_complete(store, "flightlines/raw_1")
    assert verify(to_store(open_store(store, "flightlines/raw_1").compute(), store, GROUP, overwrite=True)).ok


def test_concurrent_writers_take_turns_or_are_refused(tmp_path: Path) -> None:
    from concurrent.futures import ThreadPoolExecutor

    def write(number: int) -> str:
        try:
            to_store(xr.Dataset({"a": ("x", np.full(9, float(number)))}), tmp_path / "lot.zarr", f"g{number}")
        except StoreError as error:
            return str(error)
        return "done"

    with ThreadPoolExecutor(4) as pool:
        done = list(pool.map(write, range(8)))
    assert "done" in done
    assert all(word == "done" or "being written" in word for word in done)
    assert list_groups(tmp_path / "lot.zarr") == [f"g{n}" for n, word in enumerate(done) if word == "done"]
    assert verify(tmp_path / "lot.zarr").ok
    assert os.listdir(tmp_path) == ["lot.zarr"]


@pytest.mark.slow
def test_cluster_of_processes(two_workers: Any, tmp_path: Path) -> None:
    random = np.random.default_rng(1).integers(0, 4096, (300, 4, 20), dtype="uint16")
    line = xr.Dataset({"counts": (CUBE, da.from_array(random, chunks=(100, 4, 20)))})
    with two_workers.as_current():
        to_store(line, tmp_path / "lot.zarr", GROUP, progress=True)
    np.testing.assert_array_equal(open_store(tmp_path / "lot.zarr", GROUP).counts, random)
    assert verify(tmp_path / "lot.zarr").ok
    assert os.listdir(tmp_path) == ["lot.zarr"]
