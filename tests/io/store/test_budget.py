"""Memory and disk are known before a run, and a run that would not fit is refused."""

import contextlib
import errno
import functools
import importlib
import os
import shutil
import subprocess
import sys
import threading
from collections import namedtuple
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import dask
import dask.array as da
import numpy as np
import psutil
import pytest
import xarray as xr
from click.testing import CliRunner
from support.refusals import expect_error, expect_refusals
from support.strategies import flight

import hyperpaint as hp
from hyperpaint.base.errors import SchemaError, StoreError
from hyperpaint.cli.program import main
from hyperpaint.io.store import budget, computing, is_complete, to_store, verify, writer
from hyperpaint.io.store.budget import (
    HELPER_SPACE,
    THREAD_SPACE,
    Load,
    available_memory,
    check_memory,
    fit,
    limited_threads,
    parse_size,
    process_limit,
    resident_memory,
    thread_count,
    thread_space,
)
from hyperpaint.io.store.computing import check_disk, disk_needed
from hyperpaint.workflows import pipeline

MIB = 2**20
Usage = namedtuple("Usage", "total used free")
Available = namedtuple("Available", "available")
Held = namedtuple("Held", "rss vms")


def load(lines: int = 6400) -> Load:
    # The load of a flight line of 272 bands and 640 columns
    return Load(scan_line=272 * 640 * 6, light=34_816, encoded=33_423_360, shared=4_000_000, lines=lines)


@pytest.fixture(scope="module")
def collect(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return hp.simulate_collect(
        tmp_path_factory.mktemp("collect"), scene="plan", lines=72, bands=20, columns=12, seed=3, truth=False
    )


# --- memory ------------------------------------------------------------------------------------------------


def test_a_load_counts_cube_product_and_what_is_shared() -> None:
    line = flight(lines=100, bands=10, columns=8, dtype=np.uint16).line
    found = Load.of(line)
    assert (found.scan_line, found.encoded, found.lines) == (10 * 8 * (2 + 4), 1.5 * 32 * 10 * 8 * 4, 100)
    assert found.shared > 2 * (line.dark_counts.nbytes + line.radiance_gain.nbytes + line.irradiance.nbytes)
    smiling = line.assign_coords(wavelength_shift=("cross_track", np.linspace(0, 3, 8), {"units": "nm"}))
    assert Load.of(smiling).light > 5 * found.light
    assert Load.of(smiling.chunk()).light >= Load.of(smiling).light  # not at hand: never less
    start = line.drop_vars("counts").assign(radiance=line.counts.astype(np.float32))
    assert Load.of(start).scan_line == 10 * 8 * 8


def test_the_peak_grows_with_threads_and_lines_but_not_with_the_flight() -> None:
    alone = load().peak(lines=32, threads=1, fixed=0)
    assert load().peak(lines=32, threads=3, fixed=0) > 2.5 * alone
    assert load().peak(lines=128, threads=1, fixed=0) > 2.5 * alone
    assert load().peak(lines=32, threads=1, fixed=5) == alone + 5
    assert alone < load(lines=64_000).peak(lines=32, threads=1, fixed=0) < 1.4 * alone
    # what is shorter than a task, or than all the threads, asks for less
    assert load(lines=8).peak(lines=32, threads=8, fixed=0) < alone
    # one more thread costs its slabs and what it encodes; in another step half of what is encoded
    one = load()
    assert (
        one.a_thread
        == one.peak(lines=32, threads=2, fixed=0) - one.peak(lines=32, threads=1, fixed=0) - one.encoded // 2
    )


def test_lines_a_task_go_first_then_threads() -> None:
    wished: dict[str, Any] = {"lines": 256, "threads": 4, "fixed": 200 * MIB}
    free = fit({"a": load()}, limit=None, **wished)
    assert ((free.lines, free.threads), fit({"a": load()}, limit=free.needed, **wished)) == ((256, 4), free)
    fewer = fit({"a": load()}, limit=free.needed - 1, **wished)
    assert (fewer.lines, fewer.threads) == (128, 4)
    tight = fit({"a": load()}, limit=500 * MIB, **wished)
    assert (tight.lines, tight.threads) == (32, 2)
    assert tight.needed <= 500 * MIB


def test_what_never_fits_is_refused_with_the_figure() -> None:
    wished: dict[str, Any] = {"lines": 32, "threads": 4, "fixed": 200 * MIB}
    loads = {"flightlines/small": load(lines=8), "flightlines/large": load()}
    expect_refusals(
        (StoreError, "memory-short", lambda: fit(loads, limit=250 * MIB, **wished)),
        (StoreError, "memory-short", lambda: fit(loads, limit=400 * MIB, least_threads=4, **wished)),
    )
    assert fit({}, limit=1, **wished).needed == 0  # nothing to do needs nothing


@pytest.mark.parametrize(
    "size", ["", "much", "GiB", "-1 GiB", 0, -5, "1 parsec", float("inf"), float("nan"), None]
)
def test_what_is_no_size(size: Any) -> None:
    expect_error(SchemaError, "size-unreadable", lambda: parse_size(size))


def test_available_memory_of_this_machine() -> None:
    assert available_memory() > 10 * MIB
    assert 10 * MIB < resident_memory() < 100 * 2**30


def write(folder: Path, **files: str | int) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        (folder / name.replace("__", ".")).write_text(f"{text}\n")


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> None:
    # A machine of which 8 GB are available
    monkeypatch.setattr(psutil, "virtual_memory", lambda: Available(8_000_000 * 1024))


@pytest.mark.usefixtures("machine")
def test_a_container_leaves_less_than_its_machine(tmp_path: Path) -> None:
    assert available_memory(tmp_path) == 8_000_000 * 1024
    write(tmp_path / "proc/self", cgroup="0::/outer/inner")
    groups = tmp_path / "sys/fs/cgroup"
    write(groups / "outer/inner", memory__max="max", memory__current=5)
    assert available_memory(tmp_path) == 8_000_000 * 1024
    # the limit of a group above holds as well; cached files give way
    write(groups / "outer", memory__max=3000, memory__current=2500, memory__stat="anon 7\ninactive_file 400")
    assert available_memory(tmp_path) == 900
    write(groups / "outer", memory__current=9000)
    assert available_memory(tmp_path) == 0
    # version one of control groups
    write(tmp_path / "old/proc/self", cgroup="5:cpu:/x\n4:hugetlb,memory:/job")
    write(tmp_path / "old/sys/fs/cgroup/memory/job", memory__limit_in_bytes=7000, memory__usage_in_bytes=1000)
    assert available_memory(tmp_path / "old") == 6000


# --- address space -----------------------------------------------------------------------------------------


def limited(monkeypatch: pytest.MonkeyPatch, size: int | None) -> None:
    monkeypatch.setattr(budget, "_address_limit", lambda: size)


@pytest.mark.usefixtures("machine")
def test_a_limited_address_space_leaves_less(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    used = 400_000_000
    monkeypatch.setattr(psutil.Process, "memory_info", lambda _: Held(rss=20_000_000, vms=used))
    limited(monkeypatch, None)
    assert (available_memory(tmp_path), thread_space()) == (8_000_000 * 1024, 0)
    limited(monkeypatch, used + 4 * 2**30)
    monkeypatch.setattr(budget.os, "cpu_count", lambda: 2)
    monkeypatch.setattr(budget.threading, "enumerate", list)
    assert (available_memory(tmp_path), thread_space()) == (4 * 2**30 - 7 * HELPER_SPACE, THREAD_SPACE)
    # helpers that run have taken their space already
    started = [threading.Thread(name=name) for name in ("asyncio_0", "zarr_io", "mine")]
    monkeypatch.setattr(budget.threading, "enumerate", lambda: started)
    assert available_memory(tmp_path) == 4 * 2**30 - 5 * HELPER_SPACE
    limited(monkeypatch, used + 1)
    assert available_memory(tmp_path) == 0


def test_the_limit_of_a_process_is_the_least_of_all(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(budget, "_shared_memory", lambda _: 1000)
    monkeypatch.setattr(budget, "_address_space", lambda: None)
    assert (process_limit(50), process_limit(50, 10_000)) == (850, 10_000)  # who gives a limit means it
    monkeypatch.setattr(budget, "_address_space", lambda: 600)
    assert process_limit(50) == 650  # no other program takes of it
    assert (process_limit(50, 10_000), process_limit(50, 100)) == (650, 100)


def test_each_thread_costs_address_space() -> None:
    wished: dict[str, Any] = {"lines": 32, "threads": 4, "fixed": 200 * MIB}
    free = fit({"a": load()}, limit=None, **wished)
    assert fit({"a": load()}, limit=None, a_thread=70 * MIB, **wished).needed == free.needed + 280 * MIB
    assert fit({"a": load()}, limit=free.needed, a_thread=70 * MIB, **wished).threads < 4
    expect_error(
        StoreError, "memory-short", lambda: fit({"a": load()}, limit=300 * MIB, a_thread=70 * MIB, **wished)
    )


LIMITED = """
import resource, sys
import hyperpaint.io.collect.collect_toml, hyperpaint.workflows.pipeline
import hyperpaint.radiometry.counts_to_reflectance, zarr, dask.array
used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + 300 * 2**20,) * 2)
try:
    hyperpaint.process(sys.argv[1], sys.argv[2])
except hyperpaint.base.errors.StoreError as error:
    print(error)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="address space is limited on Linux")
@pytest.mark.slow
def test_a_process_of_too_little_address_space_is_refused_with_the_figure(
    collect: Path, tmp_path: Path
) -> None:
    command = [sys.executable, "-c", LIMITED, str(collect), str(tmp_path / "lot.zarr")]
    # one arena for all threads: how many glibc reserves while the collect is opened is a matter of chance
    run = functools.partial(subprocess.run, capture_output=True, text=True, timeout=120, check=False)
    done = run(command, env=os.environ | {"MALLOC_ARENA_MAX": "1"})
    assert "/flightlines/raw_0 needs " in done.stdout, done.stderr[-500:]
    assert "(ulimit -v)" in done.stdout
    assert not (tmp_path / "lot.zarr").exists()


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="address space is limited on Linux")
@pytest.mark.campaign
@pytest.mark.timeout(900)  # a gigabyte is processed twice, which takes minutes beside other tests
def test_a_cube_larger_than_the_address_space(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert importlib.import_module("campaigns.address_space").show(tmp_path, 1050 * MIB, 1024 * MIB)
    assert "bit-identical" in capsys.readouterr().out


# --- threads -----------------------------------------------------------------------------------------------


def test_threads_are_limited_and_given_back() -> None:
    with dask.config.set(scheduler="threads", num_workers=4, pool=None):
        assert thread_count() == 4
        with limited_threads(2):
            assert thread_count() == 2
        for same in (None, 4, 9):
            with limited_threads(same):
                assert thread_count() == 4
        with dask.config.set(scheduler="synchronous"):
            assert thread_count() == 1


def test_blocks_of_a_lazy_cube_limit_the_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    cube = xr.DataArray(
        da.zeros((6400, 272, 640), chunks=(64, 272, 640), dtype="float32"),
        dims=("along_track", "band", "cross_track"),
    )
    stored = xr.Dataset({"reflectance": cube})
    with dask.config.set(scheduler="threads", num_workers=4):
        monkeypatch.setattr(budget, "available_memory", lambda: 16 * 2**30)
        monkeypatch.setattr(budget, "_shared_memory", lambda _: 16 * 2**30)
        assert check_memory(stored, "it") == 4
        monkeypatch.setattr(budget, "_shared_memory", lambda _: 700 * MIB)
        assert check_memory(stored, "it") in (1, 2)
        monkeypatch.setattr(budget, "available_memory", lambda: 60 * MIB)
        expect_error(StoreError, "memory-short", lambda: check_memory(stored, "it"))
        assert check_memory(stored.isel(band=0).load(), "it") is None  # in memory already


def test_blocks_of_other_arrays_count(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(budget, "available_memory", lambda: 60 * MIB)
    tall = xr.DataArray(da.zeros((4096, 4096), chunks=(4096, 4096), dtype="float32"), dims=("y", "x"))
    expect_error(StoreError, "memory-short", lambda: check_memory(xr.Dataset({"slope": tall}), "it"))
    assert check_memory(xr.Dataset({"slope": tall.chunk(x=1024)}), "it") is None
    assert check_memory(xr.Dataset({"slope": tall[:0]}), "it") is None


# --- disk --------------------------------------------------------------------------------------------------


def test_a_rounded_cube_takes_less_disk() -> None:
    cube = xr.DataArray(np.zeros((64, 272, 640), np.float32), dims=("along_track", "band", "cross_track"))
    bare = disk_needed(xr.Dataset({"reflectance": cube}))
    rounded = disk_needed(xr.Dataset({"reflectance": cube.assign_attrs(keep_bits=12)}))
    assert bare > cube.nbytes
    assert rounded < 0.7 * bare


@pytest.mark.parametrize(("bits", "told"), [(12, True), (12, False), (16, False)])
def test_white_noise_takes_no_more_disk_than_is_asked_for(bits: int, told: bool, tmp_path: Path) -> None:
    counts = np.random.default_rng(0).integers(0, 2**bits, (64, 50, 100)).astype("uint16")
    line = xr.Dataset({"counts": (("along_track", "band", "cross_track"), counts)})
    if told:
        line["saturation_count"] = np.float32(2**bits - 1)
    hp.to_store(line, tmp_path / "lot.zarr")
    used = sum(512 * path.stat().st_blocks for path in (tmp_path / "lot.zarr").rglob("*"))
    assert 0.5 * disk_needed(line) < used < disk_needed(line)


def test_a_full_disk_is_refused_before_anything_is_written(
    collect: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "far" / "lot.zarr"
    monkeypatch.setattr(computing.shutil, "disk_usage", lambda _: Usage(10**12, 10**12, 1000))
    expect_error(StoreError, "disk-short", lambda: hp.process(collect, out))
    assert not any(tmp_path.iterdir())


# --- process -----------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_process_takes_fewer_threads_and_the_same_bits_come_out(
    collect: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[budget.Demand] = []
    threads: list[int | None] = []
    monkeypatch.setattr(budget, "resident_memory", lambda: 0)
    monkeypatch.setattr(budget, "PROCESS", 0)
    monkeypatch.setattr(budget, "RUNNING", 0)
    found = budget.fit

    def spy(*args: Any, **options: Any) -> budget.Demand:
        seen.append(found(*args, **options))
        return seen[-1]

    def rehearse(*_: Any) -> None:
        threads.append(dask.config.get("num_workers", None))

    monkeypatch.setattr(budget, "fit", spy)
    monkeypatch.setattr(pipeline, "check_room", rehearse)
    monkeypatch.setattr(pipeline, "CHUNK_LINES", 64)
    with dask.config.set(num_workers=3):
        wide = hp.process(collect, tmp_path / "wide.zarr", memory_limit="1 GiB")
        tight = hp.process(collect, tmp_path / "tight.zarr", memory_limit=seen[0].needed // 2)
    assert (((seen[0].lines, seen[0].threads), (seen[1].lines, seen[1].threads))) == (((64, 3), (32, 1)))
    assert threads == [3, 1]
    assert hp.verify(tight).ok
    first, second = (xr.open_zarr(path, group="flightlines/raw_0") for path in (wide, tight))
    for name in ("counts", "reflectance", "quality"):
        np.testing.assert_array_equal(first[name].values, second[name].values)


@pytest.mark.slow
def test_process_refuses_what_cannot_fit(collect: Path, tmp_path: Path) -> None:
    out = tmp_path / "lot.zarr"
    expect_refusals(
        (StoreError, "memory-short", lambda: hp.process(collect, out, memory_limit="10 MiB")),
        (SchemaError, "size-unreadable", lambda: hp.process(collect, out, memory_limit="much")),
    )
    assert not out.exists()
    hp.process(collect, out)
    hp.process(collect, out, memory_limit="10 MiB")  # there is nothing left to do


@pytest.mark.slow
def test_the_command_line_takes_a_limit(
    collect: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = ["process", str(collect), "--out", str(tmp_path / "lot.zarr"), "--memory-limit"]
    done = CliRunner().invoke(main, [*out, "10 MiB"])
    assert done.exit_code == 2
    assert "raise the memory limit" in done.stderr
    # the limit counts the memory that is resident already; a run of all tests holds more than a command
    monkeypatch.setattr(budget, "resident_memory", lambda: 300 * MIB)
    assert CliRunner().invoke(main, [*out, "2 GiB"]).exit_code == 0


def test_a_cluster_is_asked_for_the_memory_of_its_workers() -> None:
    lines = {"flightlines/a": flight(lines=300).line}

    class Client:
        def __init__(self, **worker: int) -> None:
            self.workers = {"a": {"nthreads": 2, "memory_limit": 8 * 2**30}, "b": worker}

        def scheduler_info(self, n_workers: int) -> dict[str, Any]:
            assert n_workers == -1
            return {"workers": self.workers}

    found = pipeline.demand_of(lines, 256, Client(nthreads=4, memory_limit=2**30), None)  # type: ignore[arg-type]
    assert (found.lines, found.threads) == (256, 4)
    expect_error(
        StoreError,
        "memory-short",
        lambda: pipeline.demand_of(lines, 256, Client(nthreads=4, memory_limit=200 * MIB), None),
    )
    free = pipeline.demand_of(lines, 256, Client(nthreads=4, memory_limit=0), 2**30)  # type: ignore[arg-type]
    assert free.lines == 256


MEASURE = """
import sys, dask, hyperpaint
from hyperpaint.io.store import budget
found = budget.fit
def spy(*args, **options):
    global needed
    demand = found(*args, **options)
    needed = demand.needed
    return demand
budget.fit = spy
with dask.config.set(num_workers=int(sys.argv[3])):
    hyperpaint.process(sys.argv[1], sys.argv[2])
status = dict(line.split(":", 1) for line in open("/proc/self/status"))
print(needed, int(status["VmHWM"].split()[0]) * 1024)
"""


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="the peak is read from Linux's /proc")
@pytest.mark.parametrize("threads", [1, 2])
def test_measured_peaks_stay_below_the_model(large: Path, tmp_path: Path, threads: int) -> None:
    done = subprocess.run(
        [sys.executable, "-c", MEASURE, str(large), str(tmp_path / "lot.zarr"), str(threads)],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    needed, peak = map(int, done.stdout.split())
    assert peak <= needed
    if threads == 1:  # a second thread that waits for a busy core holds no slab, and the peak is anyone's
        assert needed <= 1.4 * peak
    size = sum(path.stat().st_size for path in (tmp_path / "lot.zarr").rglob("*") if path.is_file())
    counts, product = 128 * 272 * 640 * 2, 128 * 272 * 640 * 4
    assert size < 1.1 * (0.55 * counts + 0.45 * product)


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> Path:
    # A collect of the camera's whole width, four slabs long
    return hp.simulate_collect(
        tmp_path_factory.mktemp("large"), scene="plan", lines=128, bands=272, columns=640, seed=3, truth=False
    )


def test_a_limit_in_force_holds_for_every_plan_and_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(budget, "thread_count", lambda: 8)
    monkeypatch.setattr(budget, "resident_memory", lambda: 100 * 10**6)
    monkeypatch.setattr(budget, "_address_space", lambda: None)
    before = budget.process_limit(100 * 10**6)
    taken = []
    monkeypatch.setattr(
        budget, "limited_threads", lambda count: taken.append(count) or contextlib.nullcontext()
    )
    with budget.memory_limit("1 GB"):
        assert budget.process_limit(100 * 10**6) == 10**9
        assert budget.available_memory() <= 900 * 10**6
        with budget.planned("a line", a_thread=100 * 10**6, fixed=400 * 10**6):
            assert taken == [5]  # 1.1 x (400 + 5 x 100) MB
        expect_error(
            StoreError,
            "memory-short",
            lambda: budget.planned("a line", a_thread=1, min_bytes=10**9).__enter__(),
        )
    assert budget.process_limit(100 * 10**6) == pytest.approx(before, rel=0.2)
    expect_error(SchemaError, "size-unreadable", lambda: budget.memory_limit("much").__enter__())


def test_commands_refuse_what_does_not_fit_the_limit(tmp_path: Path) -> None:
    line = hp.simulation.simulate_line(lines=32, bands=40, columns=24, smile_nm=0.0)
    hp.to_store(line, tmp_path / "lot.zarr", group="flightlines/raw_0")
    hp.write_regions(
        hp.Regions((hp.Region("grass", [(0, 0), (0, 31), (0.4, 31), (0.4, 0)]),)), tmp_path / "grass.geojson"
    )
    call = ["signatures", tmp_path / "lot.zarr", "--regions", tmp_path / "grass.geojson", "--no-flags"]
    small = CliRunner().invoke(main, [*map(str, call), "--memory-limit", "300 MB"])
    assert small.exit_code == 2
    assert "extracting from raw_0 needs" in small.output
    assert not (tmp_path / "paints.zarr").exists()
    enough = CliRunner().invoke(main, [*map(str, call), "--memory-limit", "4 GB"])
    assert enough.exit_code == 0, enough.output


# --- Disks that are full or vanish, and power cuts: told before or told cleanly, and nothing looks finished


CUBE = ("along_track", "band", "cross_track")
GROUP = "flightlines/raw_0"


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
