"""What a cluster adds: workers that die, tasks that fail, a scheduler that goes; and the same for threads."""

import asyncio
import contextlib
import errno
import functools
import importlib
import logging
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import dask
import dask.array as da
import distributed
import numpy as np
import pytest
import xarray as xr
from support import ROOT
from support.commands import hyperpaint
from support.refusals import expect_error

import hyperpaint as hp
from hyperpaint.base.errors import FormatError, StoreError
from hyperpaint.base.schema import CUBE
from hyperpaint.io.store import computing, list_groups
from hyperpaint.io.store.computing import is_mendable
from hyperpaint.workflows.pipeline import computing_on

GROUP = "flightlines/raw_0"
SLABS = 6


@contextlib.contextmanager
def cluster(workers: int = 2, **options: Any) -> Iterator[Any]:
    local = distributed.LocalCluster(
        n_workers=workers,
        threads_per_worker=1,
        dashboard_address=":0",
        silence_logs=logging.CRITICAL,
        **options,
    )
    with local, distributed.Client(local) as client:
        yield client


@pytest.fixture(scope="module")
def client() -> Iterator[Any]:
    # Two workers in this process
    with cluster(processes=False) as made:
        yield made


def line_with(task: Any, **more: Any) -> xr.Dataset:
    # Return a line whose slabs a task makes from their values and number
    values = np.random.default_rng(1).integers(0, 4096, (32 * SLABS, 3, 5), dtype="uint16")
    cube = da.from_array(values, chunks=(32, 3, 5))
    meta = np.empty((0, 0, 0), "uint16")
    return xr.Dataset({"counts": (CUBE, da.map_blocks(task, cube, dtype="uint16", meta=meta, **more))})


def whole(block: np.ndarray) -> np.ndarray:
    return block


def raising(block: np.ndarray, error: BaseException, at: int, block_id: Any = ()) -> np.ndarray:
    if block_id[0] == at:
        raise error
    return block


def failing_at_first(
    block: np.ndarray, folder: str, times: int, error: BaseException, block_id: Any = ()
) -> np.ndarray:
    # Fail a few times, then succeed, as a file system does that many nodes share
    for attempt in range(times):
        with contextlib.suppress(FileExistsError):
            (Path(folder) / f"{block_id[0]}-{attempt}").touch(exist_ok=False)
            raise error
    return block


def dying(block: np.ndarray, at: int, block_id: Any = ()) -> np.ndarray:
    if block_id[0] == at:
        os.kill(os.getpid(), signal.SIGKILL)
    return block


def slow(block: np.ndarray) -> np.ndarray:
    time.sleep(0.4)
    return block


def check_again(path: Path) -> None:
    # Run once more without faults: the store is right, and nothing lies beside it
    hp.to_store(line_with(whole), path, GROUP, source_token="line")
    assert hp.verify(path).ok
    np.testing.assert_array_equal(
        xr.open_zarr(path, group=GROUP)["counts"].values, line_with(whole)["counts"].values
    )
    assert os.listdir(path.parent) == ["lot.zarr"]


# --- errors name the block ---------------------------------------------------------------------------------


@pytest.mark.parametrize("scheduler", ["threads", "synchronous"])
@pytest.mark.parametrize("error", [OSError(errno.ESTALE, "Stale file handle"), MemoryError("too much")])
def test_error_of_the_system_names_the_block(scheduler: str, error: Exception, tmp_path: Path) -> None:
    path = tmp_path / "lot.zarr"
    expected = rf"cannot store /{GROUP}, lines 64 to 95 of counts: {type(error).__name__}.*run again"
    with dask.config.set(scheduler=scheduler), pytest.raises(StoreError, match=expected) as caught:
        hp.to_store(line_with(raising, error=error, at=2), path, GROUP, source_token="line")
    assert isinstance(caught.value.__cause__, type(error))
    assert not path.exists()
    check_again(path)


def test_error_of_the_data_keeps_its_class_and_gets_a_note(tmp_path: Path) -> None:
    for error in (FormatError("raw_0: cut short"), ZeroDivisionError("no gain")):
        line = line_with(raising, error=error, at=SLABS - 1)
        call = functools.partial(hp.to_store, line, tmp_path / "lot.zarr", GROUP)
        caught = expect_error(type(error), str(error), call)
        assert caught.__notes__ == [f"while storing /{GROUP}, lines 160 to 191 of counts"]
    assert os.listdir(tmp_path) == []


def test_error_of_what_arrays_share_names_all_of_them(tmp_path: Path) -> None:
    line = line_with(raising, error=OSError("gone"), at=1)
    line["radiance"] = line["counts"] * np.float32(2.0)
    expect_error(
        StoreError, "63 of radiance: OSError", lambda: hp.to_store(line, tmp_path / "lot.zarr", GROUP)
    )


def test_error_of_what_all_blocks_share_names_the_group(tmp_path: Path) -> None:
    def fail() -> None:
        raise OSError("gone")

    line = line_with(whole)
    shared = da.from_delayed(dask.delayed(fail)(), (1, 1, 1), "uint16", meta=np.empty((0, 0, 0), "uint16"))
    line["counts"] = line["counts"].copy(data=line["counts"].data + shared)
    expect_error(
        StoreError, f"/{GROUP}: OSError: gone", lambda: hp.to_store(line, tmp_path / "lot.zarr", GROUP)
    )


def test_map_geometry_is_named_by_its_own_dims(tmp_path: Path) -> None:
    dims, shape = ("y", "x", "band"), (600, 1100, 3)
    chunk = computing.storage_chunks(dims, shape, 4)
    assert chunk[0] < shape[0]
    cube = da.zeros(shape, chunks=(chunk[0], shape[1], 3), dtype="float32")
    cube = da.map_blocks(raising, cube, error=OSError("gone"), at=1, dtype="float32", meta=cube._meta)
    grid = xr.Dataset({"reflectance": (dims, cube)})
    expected = rf"/map, y {chunk[0]} to {min(2 * chunk[0], 600) - 1} of reflectance: OSError: gone"
    expect_error(StoreError, expected, lambda: hp.to_store(grid, tmp_path / "lot.zarr", "map"))


def test_the_causes_that_pass_are_mendable() -> None:
    def caused(cause: BaseException) -> StoreError:
        error = StoreError("cannot store")
        error.__cause__ = cause
        return error

    assert is_mendable(caused(OSError()))
    assert is_mendable(caused(distributed.scheduler.KilledWorker("key", None, 3)))
    assert not is_mendable(caused(ValueError()))
    assert not is_mendable(StoreError("it exists"))


@pytest.mark.parametrize(
    "error",
    [
        distributed.comm.CommClosedError("in <TCP>: Stream is closed"),
        distributed.client.FutureCancelledError("store-1", "scheduler-connection-lost"),
        asyncio.CancelledError("lost"),
        distributed.scheduler.KilledWorker("store-1", None, 3),
    ],
    ids=lambda error: type(error).__name__,
)
def test_errors_of_the_cluster_are_ours(error: BaseException) -> None:
    with (
        pytest.raises(StoreError, match=r"process .*run again") as caught,
        computing.errors_of_the_cluster("cannot process collect.toml"),
    ):
        raise error
    assert caught.value.__cause__ is error
    assert is_mendable(caught.value)


@pytest.mark.parametrize("error", [ValueError("a"), OSError("b"), FormatError("c"), KeyboardInterrupt()])
def test_errors_of_others_pass(error: BaseException) -> None:
    with pytest.raises(type(error)) as caught, computing.errors_of_the_cluster("cannot process"):
        raise error
    assert caught.value is error


# --- a cluster ---------------------------------------------------------------------------------------------


def test_what_fails_for_a_moment_is_tried_again(client: Any, tmp_path: Path) -> None:
    marks = tmp_path / "marks"
    marks.mkdir()
    stale = OSError(errno.ESTALE, "Stale file handle")
    line = line_with(failing_at_first, folder=str(marks), times=computing.RETRIES, error=stale)
    hp.to_store(line, tmp_path / "lot.zarr", GROUP, source_token="line")
    assert len(list(marks.iterdir())) == SLABS * computing.RETRIES
    shutil.rmtree(marks)
    check_again(tmp_path / "lot.zarr")


def test_result_whose_worker_died_once_it_was_fetched(
    client: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    as_completed = distributed.as_completed

    def lost(futures: Any, **options: Any) -> Iterator[Any]:
        for future, result in as_completed(futures, **options):
            yield types.SimpleNamespace(key=future.key, status="lost"), result

    monkeypatch.setattr(distributed, "as_completed", lost)
    hp.to_store(line_with(whole), tmp_path / "lot.zarr", GROUP, source_token="line")
    check_again(tmp_path / "lot.zarr")


def test_what_fails_for_good_names_the_block(client: Any, tmp_path: Path) -> None:
    path = tmp_path / "lot.zarr"
    missing = FileNotFoundError(errno.ENOENT, "No such file", "/data/raw_0")
    expected = rf"cannot store /{GROUP}, lines 96 to 127 of counts: .*/data/raw_0.*every worker.*run again"
    caught = expect_error(
        StoreError,
        expected,
        lambda: hp.to_store(line_with(raising, error=missing, at=3), path, GROUP, source_token="line"),
    )
    assert isinstance(caught.__cause__, FileNotFoundError)
    # the traceback is still held here: the cluster must not remember the failed tasks for its sake
    assert not path.exists()
    check_again(path)


def test_error_of_the_data_passes_through_a_cluster(client: Any, tmp_path: Path) -> None:
    line = line_with(raising, error=FormatError("raw_0: cut short"), at=0)
    caught = expect_error(FormatError, "cut short", lambda: hp.to_store(line, tmp_path / "lot.zarr", GROUP))
    assert any(f"/{GROUP}, lines 0 to 31 of counts" in note for note in caught.__notes__)
    assert os.listdir(tmp_path) == []


def test_progress_is_drawn_to_its_end(
    client: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    hp.to_store(line_with(whole), tmp_path / "lot.zarr", GROUP, progress=True)
    shown = capsys.readouterr().out
    assert shown.count("% Completed") == SLABS + 1
    assert re.search(r"\r\[#{40}\] \| 100% Completed \| [\d. ]+ms\n$|100% Completed \| [\d. ]+s\n$", shown)


@pytest.mark.slow
def test_task_whose_workers_die_is_named(tmp_path: Path) -> None:
    path = tmp_path / "lot.zarr"
    with cluster() as client:
        client.cluster.scheduler.allowed_failures = 1
        expected = rf"cannot store /{GROUP}, lines \d+ to \d+ of counts: 2 workers died.*run again"
        expect_error(
            StoreError,
            expected,
            lambda: hp.to_store(line_with(dying, at=1), path, GROUP, source_token="line"),
        )
        assert not path.exists()
        check_again(path)


SCHEDULER = """
import asyncio, sys
import distributed

async def serve():
    async with distributed.Scheduler(port=0, dashboard_address=":0", host="127.0.0.1") as scheduler:
        print(scheduler.address, flush=True)
        async with distributed.Worker(scheduler.address, nthreads=1):
            await scheduler.finished()

asyncio.run(serve())
"""


@pytest.mark.slow
def test_scheduler_that_is_lost(tmp_path: Path) -> None:
    path = tmp_path / "lot.zarr"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")])}
    process = subprocess.Popen(
        [sys.executable, "-c", SCHEDULER], stdout=subprocess.PIPE, text=True, env=environment
    )
    try:
        assert process.stdout is not None
        line = line_with(slow)
        with distributed.Client(process.stdout.readline().strip()) as client:
            client.run_on_scheduler(_end_soon)
            expect_error(
                StoreError,
                rf"/{GROUP}, lines .* of counts",
                lambda: hp.to_store(line, path, GROUP, source_token="line"),
            )
    finally:
        process.kill()
        process.communicate()
    assert not path.exists()
    check_again(path)


def _end_soon() -> None:
    threading.Timer(1.0, os._exit, (9,)).start()


def test_cluster_without_workers_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hyperpaint.workflows.pipeline.WORKERS_WAIT", 0.2)
    collect = hp.simulate_collect(tmp_path / "raw", scene="plan", lines=8, bands=24, columns=4, truth=False)
    with (
        cluster(0, processes=False) as client,
        pytest.raises(StoreError, match=r"inproc.*worker-missing"),
    ):
        hp.process(collect, tmp_path / "lot.zarr", scheduler=client.scheduler.address)
    assert not (tmp_path / "lot.zarr").exists()


@pytest.mark.slow
def test_every_step_computes_on_the_scheduler_of_the_command_line(client: Any, tmp_path: Path) -> None:
    collect = hp.simulate_collect(tmp_path / "day", scene="plan", lines=120, bands=12, columns=64, cubes=3)
    with dask.config.set(scheduler="threads"):
        local, store = hp.process(collect, tmp_path / "local.zarr"), tmp_path / "lot.zarr"
    commands: dict[str, list[object]] = {
        "process": [collect, "--out", store],
        "verify": [store],
        "verify --inputs": [store],
        "signatures": [store, "--regions", collect.with_name("regions.geojson")],
        "orthorectify": [store, "--line", "raw_0", "--out", tmp_path / "map.zarr"],
        "mosaic": [store, "--out", tmp_path / "mosaic.zarr"],
        "report": [store, "--line", "raw_0", "--cards", 0, "--out", tmp_path / "report.html"],
    }
    scheduler, keys = client.cluster.scheduler, dict[str, list[str]]()
    for name, words in commands.items():
        before = scheduler.transition_counter
        with distributed.get_task_stream(client) as stream:
            hyperpaint(*name.split(), *words, "--scheduler", client.scheduler.address, status=0)
        assert scheduler.transition_counter > before, name
        keys[name] = [task["key"] for task in stream.data]
    # three short lines at once, each one task
    assert sum("_write_arrays" in key for key in keys["process"]) == len(list_groups(store))
    assert not any(key.startswith("store-") for key in keys["process"])
    for group in filter(None, list_groups(local)):
        xr.testing.assert_equal(hp.open_store(local, group).load(), hp.open_store(store, group).load())


def test_a_line_of_several_slabs_is_several_tasks(client: Any, tmp_path: Path) -> None:
    # its arrays have different blocks: cubes slabs, times the whole line
    collect = hp.simulate_collect(tmp_path / "day", scene="plan", lines=300, bands=12, columns=4)
    store, group = hp.process(collect, tmp_path / "lot.zarr"), "flightlines/raw_0"
    with dask.config.set(scheduler="threads"):
        local = hp.process(collect, tmp_path / "local.zarr")
    xr.testing.assert_equal(hp.open_store(local, group).load(), hp.open_store(store, group).load())


def test_worker_that_does_not_see_the_folder(
    client: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    collect = hp.simulate_collect(tmp_path / "day", scene="plan", lines=64, bands=12, columns=16, cubes=4)
    on_one_worker = computing.on_one_worker

    def elsewhere(function: Any, job: Any, place: Any, **options: Any) -> Any:
        os.rmdir(place.local)
        return on_one_worker(function, job, place, **options)

    monkeypatch.setattr(computing, "on_one_worker", elsewhere)
    expect_error(
        StoreError,
        r"does not exist on the worker; every worker must see",
        lambda: hp.process(collect, tmp_path / "lot.zarr"),
    )


@pytest.mark.slow
def test_cluster_that_loses_all_workers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(computing, "LOST_WAIT", 0.5)
    path = tmp_path / "lot.zarr"
    with cluster(1, processes=False) as client:
        timer = threading.Timer(0.6, client.cluster.scale, (0,))
        timer.start()
        expected = (
            r"lines .* of counts: it was cancelled \(the cluster has had no worker for 0 s\).*run again"
        )
        expect_error(
            StoreError, expected, lambda: hp.to_store(line_with(slow), path, GROUP, source_token="line")
        )
        timer.join()
    assert not path.exists()
    check_again(path)


@pytest.mark.slow
def test_computation_ends_when_the_cluster_loses_all_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    # surveys, checks and maps compute without a write, and would wait for ever
    monkeypatch.setattr(computing, "LOST_WAIT", 0.5)
    line = line_with(slow)
    with cluster(1, processes=False) as client:
        timer = threading.Timer(0.6, client.cluster.scale, (0,))

        def compute() -> None:
            with computing_on(client.scheduler.address):
                timer.start()
                line.compute()

        expect_error(StoreError, r"cannot compute on the cluster: it was cancelled.*no worker", compute)
        timer.join()


def test_missing_file_of_a_group_written_by_one_worker(tmp_path: Path) -> None:
    # what `_write_arrays` runs on a worker: the error names the block, and where files must be
    missing = FileNotFoundError(errno.ENOENT, "No such file", "/data/raw_0")
    line = line_with(raising, error=missing, at=3)[["counts"]]
    target = computing.Target.of("counts", line["counts"].variable, computing.Location.of(tmp_path), "fast")
    (tmp_path / "counts").mkdir()
    lazy = {"counts": computing.lazy_checksums(line["counts"].variable, target)}
    expect_error(
        StoreError,
        rf"cannot store /{GROUP}, lines 96 to 127 of counts: .*/data/raw_0.*every worker.*run again",
        lambda: computing.compute(lazy, {"counts": target}, group=GROUP, progress=False, get=dask.get),
    )


def wait_for(released: Path) -> None:
    while not released.exists():
        time.sleep(0.1)


@pytest.mark.slow
def test_interrupted_groups_are_cancelled(client: Any, tmp_path: Path) -> None:
    # Ctrl-C reaches the main thread only; the others wait for their workers
    main, released, cancelled = threading.main_thread().ident, tmp_path / "released", []

    def write(_: int) -> None:
        try:
            computing.on_one_worker(wait_for, released, group=GROUP)
        except StoreError as error:
            cancelled.append(str(error))

    assert main is not None
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background ignores it
    threading.Timer(1.0, signal.pthread_kill, (main, signal.SIGINT)).start()
    try:
        with computing.watched(client), pytest.raises(KeyboardInterrupt):
            computing.in_parallel(write, range(4), 4)
    finally:
        signal.signal(signal.SIGINT, before)
        released.touch()
    assert len(cancelled) == 4
    assert all("it was cancelled (the run was stopped)" in message for message in cancelled)


@pytest.mark.slow
@pytest.mark.campaign
def test_campaign_of_killed_workers(tmp_path: Path) -> None:
    faults = importlib.import_module("campaigns.faults.workers")
    made = importlib.import_module("campaigns.faults.outcome").Outcome("workers killed")
    (tmp_path / "run").mkdir()
    with faults.Cluster() as killed:
        faults.run_kills(0, tmp_path / "run", killed, faults.storing(tmp_path, 4.0), made)
    assert made.good, made.wrong
    assert made.count == faults.kills_in(0) == 4
    assert sum(map(faults.kills_in, range(faults.RUNS))) == 100


# --- compiled kernels --------------------------------------------------------------------------------------


def compile_and_count() -> dict[str, int]:
    # Calibrate a slab; return what the kernel found on disk
    from hyperpaint.kernels.radiometry import calibrate_slab
    from hyperpaint.simulation import simulate_line

    simulate_line(lines=2, bands=8, columns=3).paint.reflectance()["reflectance"].compute(scheduler="sync")
    stats: Any = calibrate_slab
    return {"hits": len(stats.stats.cache_hits), "misses": len(stats.stats.cache_misses)}


@pytest.mark.slow
def test_fresh_workers_load_kernels_from_disk() -> None:
    compile_and_count()  # compiles where nobody did before
    with cluster(1) as client:
        found = client.submit(compile_and_count).result()
    assert found == {"hits": 1, "misses": 0}


KERNEL = """
from kernels.jit import kernel
from kernels.doubled import doubled
assert doubled(2) == 4
print(len(doubled.stats.cache_hits), len(doubled.stats.cache_misses))
"""


@pytest.fixture
def read_only_package(tmp_path: Path) -> Path:
    # Return a folder with a kernel beside which nothing can be written, not even by root
    package = tmp_path / "kernels"
    package.mkdir()
    shutil.copy(ROOT / "hyperpaint/base/jit.py", package)
    (package / "__init__.py").touch()
    text = "from kernels.jit import kernel\n\n@kernel\ndef doubled(value):\n    return 2 * value\n"
    (package / "doubled.py").write_text(text)
    (package / "__pycache__").touch()
    return tmp_path


def cached(folder: Path, home: str) -> str:
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("NUMBA", "XDG", "PYTHON"))}
    environment |= {"HOME": home, "PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run(
        [sys.executable, "-c", KERNEL], env=environment, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


@pytest.mark.skipif(sys.platform != "linux", reason="where the user's cache lies is asked of Linux")
@pytest.mark.slow
def test_package_that_must_not_be_written(read_only_package: Path) -> None:
    assert cached(read_only_package, "/dev/null") == "0 1"  # nothing can be written
    assert not list(read_only_package.rglob("*.nbi"))
    home = read_only_package / "home"
    assert cached(read_only_package, str(home)) == "0 1"
    assert list(home.rglob("*.nbi"))  # in the user's cache folder
    assert cached(read_only_package, str(home)) == "1 0"
