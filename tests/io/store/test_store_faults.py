"""Killed writers, damaged stores, two writers: nothing half-written or damaged is taken for whole."""

import contextlib
import functools
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import dask
import dask.array as da
import numpy as np
import pytest
import xarray as xr
import zarr
from filelock._identity import host_name
from support.files import write_file
from support.refusals import expect_error, expect_errors, expect_refusals, expect_words

import hyperpaint as hp
from hyperpaint.base.errors import StoreError
from hyperpaint.io.store import computing, is_complete, list_groups, open_store, to_store, verify, writer
from hyperpaint.io.store.computing import exchange, in_stages
from hyperpaint.io.store.writer import MARK_TEXT, Staging, staging

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


# --- Staging: what changes places, what a killed writer left, and what somebody else put there


def small(value: int = 1) -> xr.Dataset:
    return xr.Dataset({"a": ("x", np.full(5, value))})


@pytest.fixture
def staged(tmp_path: Path) -> Path:
    to_store(small(), tmp_path / "lot.zarr", "flightlines/raw_0")
    return tmp_path / "lot.zarr"


def unmarked(staged: Path) -> Path:
    folder = staged.parent / f".partial-{staged.name}"
    folder.mkdir(exist_ok=True)
    return folder


def partial(staged: Path) -> Path:
    (unmarked(staged) / "hyperpaint").write_bytes(writer.MARK_TEXT)
    return unmarked(staged)


def write(staged: Path, value: int = 2, group: str = "other", **options: Any) -> None:
    to_store(small(value), staged, group, **options)


# --- the folder --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name",
    [
        *(
            f"replaced-{name}"
            for name in ("..%2Fescaped", "lines%2F..%2F..%2Fescaped", "%2e%2e", ".x", "", "a%2F")
        ),
        f"build-..%2Fescaped-x-{'0' * 12}",
    ],
)
def test_names_that_lead_out_are_refused(name: str, staged: Path) -> None:
    hostile = partial(staged) / name
    hostile.mkdir()
    (hostile / "zarr.json").write_text("{}")
    expect_error(StoreError, "staging-foreign", lambda: write(staged))
    assert sorted(os.listdir(staged.parent)) == [".partial-lot.zarr", "lot.zarr"]
    assert hostile.is_dir()


@pytest.mark.parametrize("name", ["replaced-g", "build-other-x-y", "discarded-1", "notes"])
def test_links_in_the_folder_are_refused(name: str, staged: Path, tmp_path: Path) -> None:
    (tmp_path / "precious").mkdir()
    (tmp_path / "precious/keep").touch()
    (partial(staged) / name).symlink_to(tmp_path / "precious")
    expect_error(StoreError, "link-refused", lambda: write(staged))
    assert os.listdir(tmp_path / "precious") == ["keep"]


def test_a_link_for_the_folder_is_refused(staged: Path, tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere/build-x-1").mkdir()
    (tmp_path / ".partial-lot.zarr").symlink_to(tmp_path / "elsewhere")
    expect_error(StoreError, "link-refused", lambda: write(staged))
    assert os.listdir(tmp_path / "elsewhere") == ["build-x-1"]


def test_an_old_group_is_not_put_back_through_a_link(staged: Path, tmp_path: Path) -> None:
    (tmp_path / "outside").mkdir()
    (staged / "more").symlink_to(tmp_path / "outside")
    (partial(staged) / "replaced-more%2Fraw_0").mkdir()
    with pytest.raises(StoreError, match="link-refused"), staging(staged):
        pass
    assert os.listdir(tmp_path / "outside") == []


def test_an_old_group_is_put_back_though_its_parent_is_gone(staged: Path) -> None:
    os.rename(staged / "flightlines/raw_0", partial(staged) / "replaced-flightlines%2Fraw_0")
    (staged / "flightlines/zarr.json").unlink()
    (staged / "flightlines").rmdir()
    with staging(staged):
        pass
    assert open_store(staged, "flightlines/raw_0")["a"][0] == 1
    write(staged)
    assert verify(staged).ok


def test_what_is_half_removed_does_not_come_back(staged: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    remove = shutil.rmtree

    def die(folder: Any, *args: Any, **options: Any) -> None:
        if "discarded-" in str(folder) or "replaced-" in str(folder):
            raise KeyboardInterrupt
        remove(folder, *args, **options)

    monkeypatch.setattr(writer, "exchange", lambda *_: False)
    with monkeypatch.context() as patch:
        patch.setattr(shutil, "rmtree", die)
        expect_error(KeyboardInterrupt, None, lambda: write(staged, 2, "flightlines/raw_0", overwrite=True))
    assert not list(partial(staged).glob("replaced-*"))
    assert open_store(staged, "flightlines/raw_0")["a"][0] == 2


# --- half-written files ------------------------------------------------------------------------------------


def test_only_our_half_written_files_are_removed(staged: Path, tmp_path: Path) -> None:
    outside = tmp_path / "outside"
    outside.mkdir()
    ours = [
        staged / ".zarr.json.4711",
        staged / "flightlines/.zarr.json.12",
        staged / f"flightlines/zarr.{'0f' * 16}.partial",
    ]
    foreign = [
        staged / "thesis.partial",
        staged / "flightlines/raw_0/notes.partial",
        staged / ".zarr.json.backup",
        staged / "flightlines/photos/.zarr.json.1",
        outside / ".zarr.json.1",
    ]
    (staged / "flightlines/photos").mkdir()
    (staged / "linked").symlink_to(outside)
    for file in (*ours, *foreign):
        file.write_text("x")
    with staging(staged, ["flightlines/raw_1"]):
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
    expect_error(FileNotFoundError, None, lambda: exchange(tmp_path / "a", tmp_path / "c"))


@pytest.mark.parametrize("exchanging", [True, False])
@pytest.mark.parametrize("failing", range(1, 4))
@pytest.mark.parametrize("group", ["", "flightlines/raw_0"])
def test_the_old_group_stands_where_publishing_fails(
    group: str, failing: int, exchanging: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    staged = tmp_path / "lot.zarr"
    to_store(small(), staged, group)
    if not exchanging:
        monkeypatch.setattr(writer, "exchange", lambda *_: False)
    rename, calls = os.rename, iter(range(1, 100))

    def fail(source: Any, target: Any) -> None:
        if next(calls) == failing:
            raise PermissionError(13, "Permission denied", os.fspath(source))
        rename(source, target)

    made = Staging(staged)
    build = made.build(group, "content")
    build.mkdir(parents=True)
    monkeypatch.setattr(os, "rename", fail)
    with contextlib.suppress(PermissionError):
        made.publish(build, group)
    monkeypatch.undo()
    there = staged / group
    assert there.is_dir()
    assert is_complete(staged, group) or not os.listdir(there)


# --- the lock ----------------------------------------------------------------------------------------------


@pytest.fixture
def lock(tmp_path: Path) -> Path:
    return partial(tmp_path / "lot.zarr") / "lock"


def record(pid: object, host: str | None = None, start: int | None = None) -> str:
    # Return what a writer leaves in its lock
    lines = [str(pid), host or host_name(), *([] if start is None else [str(start)])]
    return "".join(f"{line}\n" for line in lines)


def is_taken_over(lock: Path) -> None:
    os.utime(lock, (0, 0))  # filelock waits 2 s for the record of a younger lock
    write(lock.parent.with_name(lock.parent.name.removeprefix(".partial-")))
    assert not lock.parent.exists()


@pytest.mark.parametrize(
    ("make", "code"),
    [(os.mkfifo, "lock-foreign"), (os.mkdir, "lock-foreign"),
     (lambda lock: lock.symlink_to("precious"), "link-refused"),
     (lambda lock: lock.write_bytes(b"[" * 4000), "lock-foreign")],
)  # fmt: skip
def test_what_is_no_lock_is_refused(make: Callable[[Path], object], code: str, lock: Path) -> None:
    (lock.parent / "precious").write_text("x")
    make(lock)
    expect_error(StoreError, code, lambda: write(lock.parent.parent / "lot.zarr"))
    assert (lock.parent / "precious").read_text() == "x"


def test_locks_of_nobody_are_taken_over(tmp_path: Path) -> None:
    contents = (
        *("{", '{"host": "a"}' + " " * 100, "\xff\xfe\x00"),  # no record
        *(record(pid) for pid in (2**64, -1, True, "x", None, 2**31 - 1)),  # of a dead process
        record(os.getpid(), start=1),  # another process had the number of this one, which started later
    )
    locks = [partial(tmp_path / f"{number}.zarr") / "lock" for number in range(len(contents))]
    for lock, content in zip(locks, contents, strict=True):
        lock.write_bytes(content.encode("latin-1"))
    # all at once: filelock waits 2 s for some of them
    with ThreadPoolExecutor(len(locks)) as pool:
        list(pool.map(is_taken_over, locks))


def test_an_empty_lock_is_taken_over_once_it_is_old(lock: Path) -> None:
    lock.touch()
    expect_error(StoreError, "store-locked", lambda: write(lock.parent.parent / "lot.zarr"))
    is_taken_over(lock)


def test_our_own_lock_is_respected_in_each_thread(lock: Path) -> None:
    store = lock.parent.parent / "lot.zarr"
    with writer.locked(lock, lock.parent), ThreadPoolExecutor(1) as pool:
        expect_refusals(
            (StoreError, "store-locked", lambda: write(store)),
            (StoreError, "store-locked", lambda: pool.submit(write, store).result()),
        )
    assert not lock.exists()


def test_writers_that_cannot_be_seen_are_respected(lock: Path) -> None:
    for host in ("elsewhere", f"{host_name()}?pidns-1"):
        lock.write_text(record(2**30, host))  # the number is that of nobody here
        expect_error(StoreError, "store-locked", lambda: write(lock.parent.parent / "lot.zarr"))
        assert lock.exists()


def test_a_killed_writers_lock_is_taken_over(lock: Path) -> None:
    code = (
        "import os, sys, filelock; a = filelock.SoftFileLock(sys.argv[1]).acquire(); os.kill(os.getpid(), 9)"
    )
    subprocess.run([sys.executable, "-c", code, str(lock)], timeout=60, check=False)
    assert lock.exists()
    is_taken_over(lock)


def test_another_writers_lock_is_left_alone(lock: Path) -> None:
    with writer.locked(lock, lock.parent):
        other = write_file(lock.with_name("other"), "another's, who was told that we are dead")
        other.replace(lock)
    assert lock.read_text().startswith("another's")


# --- whose folder it is ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    # the last has the name of the mark, but is none
    "name",
    ["thesis.txt", "build-mine", "build-house-plan", "discarded-photos", "notes/a", "hyperpaint"],
)
def test_a_folder_of_somebody_elses_is_refused_and_kept(name: str, tmp_path: Path) -> None:
    staged = tmp_path / "lot.zarr"
    theirs = unmarked(staged) / name
    theirs.parent.mkdir(parents=True, exist_ok=True)
    theirs.write_text("precious")
    for overwrite in (False, True):
        expect_error(
            StoreError, "staging-foreign", functools.partial(to_store, small(), staged, overwrite=overwrite)
        )
    assert theirs.read_text() == "precious"
    assert [each.name for each in unmarked(staged).iterdir()] == [name.partition("/")[0]]


def test_what_a_power_failure_leaves_empty_is_ours(tmp_path: Path) -> None:
    folder = unmarked(tmp_path / "lot.zarr")
    for name in ("lock", "hyperpaint"):
        (folder / name).touch()
        os.utime(folder / name, (0, 0))
    to_store(small(), tmp_path / "lot.zarr")
    assert os.listdir(tmp_path) == ["lot.zarr"]


def test_lock_and_mark_are_on_the_disk_before_anything_is_built(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced: list[str] = []
    monkeypatch.setattr(writer, "sync", lambda staged: synced.append(Path(staged).name))
    with staging(tmp_path / "lot.zarr"):
        assert synced == ["lock", "hyperpaint", ".partial-lot.zarr"]


def test_what_lies_in_our_folder_and_is_not_ours_stays(tmp_path: Path) -> None:
    staged = tmp_path / "lot.zarr"
    with staging(staged):
        (unmarked(staged) / "build-house-plan").write_text("precious")
        (unmarked(staged) / f"build-old-{'0' * 32}-{'0' * 12}").mkdir()
    to_store(small(), staged)
    assert sorted(os.listdir(unmarked(staged))) == ["build-house-plan", "hyperpaint"]
    (unmarked(staged) / "build-house-plan").unlink()
    with staging(staged):
        pass
    assert os.listdir(tmp_path) == ["lot.zarr"]


# --- maps are computed stage by stage: every task once, and what is shared is held no longer than needed ---


def _slabs_and_tiles(slabs: int, counted: list[int]) -> tuple[dict, dict]:
    # Return a graph in which a tile reads two slabs of which the next reads one, and the tiles' stages
    def slab(number: int) -> np.ndarray:
        counted.append(number)
        return np.full(3, number)

    graph: dict = {("slab", k): (slab, k) for k in range(slabs)}
    graph |= {("tile", k): (np.add, ("slab", k), ("slab", k + 1)) for k in range(slabs - 1)}
    return graph, {("tile", k): k for k in range(slabs - 1)}


def test_tasks_that_stages_share_are_computed_once_and_in_turn() -> None:
    counted: list[int] = []
    graph, stages = _slabs_and_tiles(6, counted)
    seen = []
    for (_, tile), value in in_stages(dask.get, graph, stages):
        seen.append(tile)
        assert (value == 2 * tile + 1).all()
        assert max(counted) == tile + 1, "no slab is read ahead of its stage"
    assert (seen, sorted(counted)) == (list(range(5)), list(range(6)))


def test_one_stage_is_one_call() -> None:
    calls = []

    def get(graph: dict, keys: list) -> list:
        calls.append(len(keys))
        return dask.get(graph, keys)

    graph, stages = _slabs_and_tiles(4, [])
    values = dict(in_stages(get, graph, dict.fromkeys(stages, 0)))
    assert (calls, [int(value[0]) for value in values.values()]) == ([3], [1, 3, 5])


def test_a_wide_map_is_stored_by_columns(tmp_path) -> None:
    order: list[int] = []

    def tile(block_info: dict | None = None) -> np.ndarray:
        (rows, columns) = block_info[None]["chunk-location"]
        order.append(columns)
        return np.full(block_info[None]["chunk-shape"], 10.0 * rows + columns)

    def cells(rows: int, columns: int) -> xr.Dataset:
        chunks = ((256,) * rows, (256,) * columns)
        lazy = da.map_blocks(tile, chunks=chunks, dtype=float, meta=np.empty((0, 0)))
        return xr.Dataset({"red": (("y", "x"), lazy)})

    with dask.config.set(scheduler="sync"):
        hp.to_store(cells(2, 4), tmp_path / "wide.zarr")
        assert order == sorted(order)
        order.clear()
        hp.to_store(cells(4, 2), tmp_path / "high.zarr")
    assert order != sorted(order)
    stored = hp.open_store(tmp_path / "wide.zarr").red.values
    assert (stored[0, 300], stored[300, 900]) == (1.0, 13.0)


# --- the bar counts blocks, says what time is left, and leaves nothing of a longer line ---------------------


def test_the_bar_says_what_is_left(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = iter([0.0, 0.0, 1.0, 70.0, 80.0])
    monkeypatch.setattr(computing.time, "perf_counter", lambda: next(clock))
    bar = computing.BlockBar(8)
    for blocks in (0, 1, 6, 1):
        bar.advance(blocks)
    drawn = [part for part in re.split(r"\r+ *", capsys.readouterr().out) if part]
    expect_words(drawn[0], "] | 0% Completed | ", without=("left",))
    assert drawn[1].startswith("[" + "#" * 5 + " " * 35 + "] | 12% Completed | ")
    assert drawn[1].endswith("7.00 s left")
    assert drawn[2].endswith("10.00 s left")
    assert drawn[3].startswith("[" + "#" * 40 + "] | 100% Completed")
    assert "left" not in drawn[3]


def test_every_block_moves_the_bar(capsys: pytest.CaptureFixture[str], tmp_path: object) -> None:
    cube = da.zeros((96, 2, 3), chunks=(32, 2, 3), dtype="uint16")
    line = xr.Dataset({"counts": (("along_track", "band", "cross_track"), cube)})
    to_store(line, f"{tmp_path}/lot.zarr", progress=True)
    shown = capsys.readouterr().out
    assert [int(share) for share in re.findall(r"(\d+)% Completed", shown)] == [0, 33, 66, 100]
    assert shown.endswith("\n")
