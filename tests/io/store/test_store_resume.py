"""Runs cut short are taken up: nothing finished is made again, nothing damaged is believed."""

import errno
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any
from unittest import mock

import dask
import dask.array as da
import numpy as np
import pytest
import xarray as xr
from support.codecs import flip
from support.refusals import expect_error

from hyperpaint.base.errors import SchemaError, StoreError
from hyperpaint.io.store import computing, is_complete, open_store, to_store, verify
from hyperpaint.io.store.manifest import MANIFEST_NODE
from hyperpaint.io.store.reader import version_of_program

CUBE = ("along_track", "band", "cross_track")
GROUP = "flightlines/raw_0"
BLOCKS = 12
TOKEN = "inputs"

#: What hooks into the source of a test, and the blocks it was asked for.
before: list[Callable[[int], None]] = []
asked: list[int] = []


def slab(log: str | None, block_id: tuple[int, ...] = ()) -> np.ndarray[Any, Any]:
    number = block_id[0]
    if log is None:
        for hook in before:
            hook(number)
        asked.append(number)
    else:
        time.sleep(0.02)
        with open(log, "a") as file:
            file.write(f"{number}\n")
    return np.random.default_rng(number).integers(0, 4096, (32, 4, 50), dtype="uint16")


def line(log: str | None = None, lines: int = 32) -> xr.Dataset:
    # Two cubes of one source, a map of tiles, times and a small array, all lazy but the last
    counts = da.map_blocks(
        slab, log, chunks=((32,) * BLOCKS, (4,), (50,)), dtype="uint16", meta=np.empty((0, 0, 0), "uint16")
    ).rechunk((lines, 4, 50))
    height = da.random.default_rng(5).random((200, 300), chunks=128, dtype="float32")
    start = np.datetime64("2026-06-01T10:00:00", "ns")
    time = start + (da.arange(32 * BLOCKS, chunks=-1) * 7_000_000).astype("m8[ns]")
    return xr.Dataset(
        {
            "counts": (CUBE, counts),
            "reflectance": (CUBE, (counts / 4096).astype("float32")),
            "height": (("y", "x"), height),
        },
        coords={"time": ("along_track", time), "wavelength": ("band", [400.0, 500.0, 600.0, 700.0])},
    )


WRITER = """
import importlib.util, pathlib, sys
import dask
from hyperpaint.io.store import to_store

sys.path.append(str(pathlib.Path(sys.argv[1]).parents[2]))
spec = importlib.util.spec_from_file_location("resumed", sys.argv[1])
resumed = importlib.util.module_from_spec(spec)
spec.loader.exec_module(resumed)
print("ready", flush=True)
with dask.config.set(scheduler="threads", num_workers=2):
    to_store(resumed.line(sys.argv[3]), sys.argv[2], resumed.GROUP, source_token=resumed.TOKEN)
"""


@pytest.fixture(autouse=True)
def _fresh() -> Iterator[None]:
    before.clear()
    asked.clear()
    with dask.config.set(scheduler="synchronous"):
        yield
    before.clear()


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    # What an uninterrupted run leaves
    path = tmp_path_factory.mktemp("whole") / "lot.zarr"
    with dask.config.set(scheduler="synchronous"):
        to_store(line(), path, GROUP, source_token=TOKEN)
    return content(path)


def content(path: Path) -> dict[str, Any]:
    # Return every file of a store but its manifest, without the time it was made
    found: dict[str, Any] = {}
    for file in sorted(path.rglob("*")):
        if file.is_file() and file.parent != path / MANIFEST_NODE:
            raw = file.read_bytes()
            found[str(file.relative_to(path))] = _timeless(json.loads(raw)) if file.suffix == ".json" else raw
    return found


def _timeless(document: Any) -> Any:
    if not isinstance(document, dict):
        return document
    volatile = ("created", "history", "hyperpaint_content")
    return {key: _timeless(value) for key, value in document.items() if key not in volatile}


def partial(path: Path) -> Path:
    return path.parent / f".partial-{path.name}"


def leftover(path: Path) -> Path:
    # Return the one group under construction
    (found,) = partial(path).glob("build-*")
    return found


def fail_after(count: int, error: BaseException) -> Callable[[int], None]:
    def fail(_: int) -> None:
        if len(asked) == count:
            raise error

    return fail


def cut_short(path: Path, count: int = 7, error: BaseException | None = None) -> list[int]:
    # Fail after some blocks of the source; return those that are left to do
    before.append(fail_after(count, error or OSError(errno.ENOSPC, "No space left on device")))
    expect_error(
        (StoreError, KeyboardInterrupt, MemoryError),
        None,
        lambda: to_store(line(), path, GROUP, source_token=TOKEN),
    )
    left = sorted({*range(BLOCKS)} - {*asked})
    before.clear()
    asked.clear()
    return left


def assert_whole(path: Path, expected: dict[str, Any]) -> None:
    assert content(path) == expected
    assert verify(path).ok
    assert [name for name in os.listdir(path.parent) if "lot" in name] == ["lot.zarr"]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.slow
def test_killed_at_a_random_instant(seed: int, tmp_path: Path, whole: dict[str, Any]) -> None:
    path, log = tmp_path / "lot.zarr", tmp_path / "log"
    log.touch()
    random = np.random.default_rng(seed)
    writer = subprocess.Popen(
        [sys.executable, "-c", WRITER, __file__, str(path), str(log)], stdout=subprocess.PIPE, text=True
    )
    assert writer.stdout is not None
    assert writer.stdout.readline() == "ready\n"
    until = time.monotonic() + 30
    while len(log.read_text().split()) < random.integers(1, BLOCKS) and time.monotonic() < until:
        time.sleep(0.001)
    time.sleep(random.uniform(0, 0.02))
    writer.send_signal(signal.SIGKILL)
    writer.communicate(timeout=60)
    if not is_complete(path, GROUP):  # what was not there is not there now
        expect_error(StoreError, None, lambda: open_store(path, GROUP))
    # the function's argument is part of the content: the same log again
    to_store(line(str(log)), path, GROUP, source_token=TOKEN)
    assert len(log.read_text().split()) <= BLOCKS + 2
    assert_whole(path, whole)


@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "full"), KeyboardInterrupt(), MemoryError()])
def test_finished_blocks_are_not_computed_again(
    error: BaseException, path: Path, tmp_path: Path, whole: dict[str, Any]
) -> None:
    left = cut_short(path, 7, error)
    assert (len(left), os.listdir(tmp_path)) == (BLOCKS - 7, [".partial-lot.zarr"])
    to_store(line(), path, GROUP, source_token=TOKEN)
    assert sorted(asked) == left
    assert_whole(path, whole)


def test_cut_short_again_and_again(path: Path, whole: dict[str, Any]) -> None:
    for count in (2, 0, 3, 6):
        cut_short(path, count)
        leftover(path)
    to_store(line(), path, GROUP, source_token=TOKEN)
    assert len(asked) == BLOCKS - 11
    assert_whole(path, whole)


def test_stopped_just_before_the_end(path: Path, whole: dict[str, Any]) -> None:
    with mock.patch("hyperpaint.io.store.writer.flush_group", side_effect=KeyboardInterrupt):
        expect_error(KeyboardInterrupt, None, lambda: to_store(line(), path, GROUP, source_token=TOKEN))
    asked.clear()
    to_store(line(), path, GROUP, source_token=TOKEN)
    assert asked == []
    assert_whole(path, whole)


def test_stopped_while_it_is_taken_up(path: Path, whole: dict[str, Any]) -> None:
    left = cut_short(path)
    with mock.patch("hyperpaint.io.store.writer.discard", side_effect=KeyboardInterrupt):
        expect_error(KeyboardInterrupt, None, lambda: to_store(line(), path, GROUP, source_token=TOKEN))
    assert len(list(partial(path).glob("build-*"))) == 2
    asked.clear()
    to_store(line(), path, GROUP, source_token=TOKEN)
    assert sorted(asked) == left
    assert_whole(path, whole)


@pytest.mark.parametrize("lines", [64, 96, 32 * BLOCKS])
def test_other_dask_chunks(lines: int, path: Path, whole: dict[str, Any]) -> None:
    touched = {number * 32 // lines for number in cut_short(path)}
    to_store(line(lines=lines), path, GROUP, source_token=TOKEN)
    assert sorted(asked) == [number for number in range(BLOCKS) if number * 32 // lines in touched]
    assert_whole(path, whole)


@pytest.mark.parametrize(
    "damage",
    [
        flip,
        lambda chunk: chunk.write_bytes(chunk.read_bytes()[:50]),
        lambda chunk: chunk.write_bytes(b""),
        Path.unlink,
    ],
    ids=["flipped", "truncated", "empty", "deleted"],
)
def test_damaged_leftovers_are_made_again(
    damage: Callable[[Path], object], path: Path, whole: dict[str, Any]
) -> None:
    left = cut_short(path)
    chosen = [number for number in range(BLOCKS) if number not in left][2]
    damage(leftover(path) / f"counts/c/{chosen}/0/0")
    to_store(line(), path, GROUP, source_token=TOKEN)
    assert sorted(asked) == sorted([chosen, *left])
    assert_whole(path, whole)


@pytest.mark.parametrize(("version", "token"), [("0.0", TOKEN), (version_of_program(), "other inputs")])
def test_leftovers_of_other_content_or_version_are_discarded(
    version: str, token: str, path: Path, whole: dict[str, Any]
) -> None:
    with mock.patch("hyperpaint.io.store.writer.version_of_program", return_value=version):
        cut_short(path)
    to_store(line(), path, GROUP, source_token=token)
    assert sorted(asked) == list(range(BLOCKS))
    assert_whole(path, whole)


def test_leftovers_of_another_group_are_discarded(path: Path, tmp_path: Path) -> None:
    cut_short(path)
    to_store(xr.Dataset({"a": ("x", [1.0])}), path, "other")
    assert os.listdir(tmp_path) == ["lot.zarr"]


@pytest.mark.parametrize("error", [RuntimeError("broken"), SchemaError("not of this shape")])
def test_wrong_data_leave_nothing(error: Exception, path: Path, tmp_path: Path) -> None:
    cut_short(path)
    before.append(fail_after(2, error))
    expect_error(type(error), None, lambda: to_store(line(), path, GROUP, source_token=TOKEN))
    assert os.listdir(tmp_path) == []


def test_one_group_of_a_tree_is_taken_up(path: Path, whole: dict[str, Any]) -> None:
    tree = xr.DataTree.from_dict({"/flightlines/raw_0": line(), "/irradiance": line()[["wavelength"]]})
    before.append(fail_after(7, OSError(errno.EROFS, "read-only")))
    for _ in range(2):
        expect_error(StoreError, "read-only", lambda: to_store(tree, path, source_token=TOKEN))
    before.clear()
    assert len(asked) == 7
    to_store(tree, path, source_token=TOKEN)
    assert sorted(asked) == list(range(BLOCKS))
    done = content(path)
    assert {key: done[key] for key in whole if key.startswith(GROUP)} == {
        key: value for key, value in whole.items() if key.startswith(GROUP)
    }
    assert verify(path).ok


def test_tasks_that_outlive_their_run_harm_nothing(path: Path, whole: dict[str, Any]) -> None:
    waiting, go = threading.Event(), threading.Event()

    def late(block: int) -> None:
        if block == 0:
            waiting.set()
            assert go.wait(30)
        elif block == 1:
            assert waiting.wait(30)
            raise OSError(errno.ENOSPC, "full")

    before.append(late)
    pool = ThreadPoolExecutor(2)
    with dask.config.set(scheduler="threads", pool=pool), pytest.raises(StoreError, match="full"):
        to_store(line(), path, GROUP, source_token=TOKEN)
    before.clear()
    before.append(lambda _: go.set())
    to_store(line(), path, GROUP, source_token=TOKEN)
    pool.shutdown(wait=True)
    assert_whole(path, whole)


def test_resumed_blocks_are_the_values(path: Path) -> None:
    cut_short(path)
    to_store(line(), path, GROUP, source_token=TOKEN)
    xr.testing.assert_equal(open_store(path, GROUP).compute(), line().compute())


FULL_DISK = """
import errno, sys
import hyperpaint as hp
from hyperpaint.io.store import computing

write, calls = computing.write_chunk, []
def until_full(*args):
    if len(calls) == 12:
        raise OSError(errno.ENOSPC, "No space left on device")
    calls.append(args)
    write(*args)

computing.write_chunk = until_full
try:
    hp.process(sys.argv[1], sys.argv[2])
except hp.errors.StoreError:
    sys.exit(3)
"""


@pytest.mark.slow
def test_process_is_resumed_by_another_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import hyperpaint as hp

    collect, path = tmp_path / "raw/collect.toml", tmp_path / "lot.zarr"
    hp.simulate_collect(collect.parent, scene="plan", lines=320, bands=20, columns=12, cubes=1, seed=3)
    hp.process(collect, tmp_path / "whole.zarr")
    command = [sys.executable, "-c", FULL_DISK, str(collect), str(path)]
    assert subprocess.run(command, timeout=120, check=False).returncode == 3
    built = leftover(path)
    finished = {str(chunk.relative_to(built)) for chunk in built.glob("*/c/**/0") if chunk.is_file()}
    assert len(finished) >= 12
    whole = {name for name in finished if (built / name).stat().st_size > 0}
    written: list[str] = []
    write = computing.write_chunk

    def count(folder: Path, key: str, *args: Any) -> None:
        written.append(f"{folder.name}/{key}")
        write(folder, key, *args)

    monkeypatch.setattr(computing, "write_chunk", count)
    hp.process(collect, path)
    assert not whole & set(written)
    assert_whole(path, content(tmp_path / "whole.zarr"))
