"""All speed goals as ratios, each measured in one process with its floor beside it.

    python benchmarks/ratios.py             every ratio, about two minutes
    python benchmarks/ratios.py kernel io   only these
    python benchmarks/ratios.py click       a pixel, a region, a band of 4,000 lines; writes 3 GB under TMPDIR
    python benchmarks/ratios.py kernel --processors host,generic,haswell,skylake-avx512
    python benchmarks/ratios.py distributed two workers of dask.distributed against two threads
    python benchmarks/ratios.py memory      peak memory; writes 13 GB under TMPDIR and removes them
    python benchmarks/ratios.py collects    whole collects of 10,000 lines from a cold page cache, 8 GB
    python benchmarks/ratios.py flight      a rendered flight line of 640 x 1000 x 272, some minutes

Absolute times are those of this machine at this moment; the ratios are what can be compared. Repeats are
interleaved, the least of each counts.
"""

from __future__ import annotations

import argparse
import functools
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
if __package__ in (None, ""):  # run as a script: `benchmarks` is then not importable yet
    sys.path.insert(0, str(ROOT))


@dataclass(frozen=True)
class Row:
    """One line of the table."""

    what: str
    ours: float
    floor: float
    unit: str
    goal: float
    at_least: bool = False

    @property
    def ratio(self) -> float:
        return self.floor / self.ours if self.at_least else self.ours / self.floor

    @property
    def met(self) -> bool:
        return self.ratio >= self.goal if self.at_least else self.ratio <= self.goal

    def __str__(self) -> str:
        goal = f"{'>=' if self.at_least else '<='} {self.goal:g}x"
        measured = f"{self.ours:10.4g} {self.floor:10.4g} {self.unit:<5}"
        return f"{self.what:<62} {measured} {self.ratio:7.2f}x  {goal:<9} {'met' if self.met else 'MISSED'}"


HEADER = f"{'':<62} {'ours':>10} {'floor':>10} {'':<5} {'ratio':>8}  goal"


def timed(case: Any, arguments: tuple[Any, ...], names: tuple[str, ...], rounds: int) -> dict[str, float]:
    """Return the least wall time [ms] of the methods of a benchmark class."""
    from benchmarks.common import best_of

    case.setup(*arguments)
    variants = {name: functools.partial(getattr(case, name), *arguments) for name in names}
    clear = functools.partial(getattr(case, "teardown", lambda *_: None), *arguments)
    return {name: 1e3 * seconds for name, seconds in best_of(variants, rounds, clear).items()}


def imports() -> Iterator[Row]:
    from benchmarks.common import best_of

    environment = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    environment["PYTHONPATH"] = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])

    def start(module: str) -> None:
        subprocess.run([sys.executable, "-c", f"import {module}"], check=True, env=environment, cwd=ROOT)

    best = best_of({name: functools.partial(start, name) for name in ("hyperpaint", "xarray")}, 15)
    yield Row("import hyperpaint / import xarray", 1e3 * best["hyperpaint"], 1e3 * best["xarray"], "ms", 1.15)


def kernel() -> Iterator[Row]:
    from benchmarks.bench_kernels import Calibrate, Smooth

    names = (
        "time_floor",
        "time_plain",
        "time_smile_quality_rounding",
        "time_uncertainty",
        "time_everything",
        "time_three_casts",
    )
    floor, plain, full, uncertain, everything, casts = timed(Calibrate(), (128,), names, 25).values()
    yield Row("kernel, 128 lines, one thread / np.copyto(float32, uint16)", plain, floor, "ms", 1.4)
    yield Row("  the same with smile, quality and rounding", full, floor, "ms", 3)
    yield Row("  with both uncertainties", uncertain, floor, "ms", 5)
    yield Row("  against three casts, since it writes three cubes", uncertain, casts, "ms", 1.5)
    yield Row("  with smile, quality, rounding and both uncertainties", everything, floor, "ms", 5)
    names = ("time_floor", "time_box", "time_wide_box", "time_savitzky_golay")
    floor, box, wide, polynomial = timed(Smooth(), (128,), names, 15).values()
    yield Row("box of 11 bands / np.copyto(float32, uint16)", box, floor, "ms", 3.5)
    yield Row("  of 51 bands", wide, floor, "ms", 3.5)
    yield Row("  Savitzky-Golay of 11 bands", polynomial, floor, "ms", 5)


def eager() -> Iterator[Row]:
    """A cube in memory, against the arithmetic alone in plain float32 xarray, without flags and smile."""
    import numpy as np

    from benchmarks.bench_pipeline import threads
    from benchmarks.common import best_of, counts_block, flight_line

    line = flight_line(480, smile=True, counts=np.tile(counts_block(240), (2, 1, 1)))
    light = line["irradiance"].interp(irradiance_time=line["time"])
    light = light.interp(irradiance_wavelength=line["wavelength"]).reset_coords(drop=True).astype("f4")
    exposure = line["exposure_time"].astype("f4")

    def ours() -> None:
        with threads():
            line.paint.reflectance()[["reflectance", "quality"]].compute()

    def plain(counts: Any = line["counts"]) -> None:
        above = counts.astype("f4") - line["dark_counts"]
        with threads():
            (np.float32(np.pi) * (above * line["radiance_gain"] / exposure) / light).compute()

    chunked = line["counts"].chunk({"along_track": 32})
    variants = {"ours": ours, "plain": plain, "dask": functools.partial(plain, chunked)}
    best = best_of(variants, 7)
    peer = min(best["plain"], best["dask"])
    text = "480 lines in memory, reflectance and quality: plain xarray / ours"
    yield Row(text, 1e3 * best["ours"], 1e3 * peer, "ms", 2, at_least=True)


def irradiance() -> Iterator[Row]:
    from benchmarks.bench_kernels import MatchIrradiance

    names = ("time_floor", "time_match", "time_match_with_smile", "integral_of_each_band")
    floor, ours, bent, slow = timed(MatchIrradiance(), (1800,), names, 7).values()
    yield Row("one hour of sky spectra to 272 bands / 12 ms", ours, 12.0, "ms", 1)
    yield Row("  with smile / 25 ms", bent, 25.0, "ms", 1)
    yield Row("one hour of sky spectra to 272 bands / bare matrix product", ours, floor, "ms", 10)
    yield Row("  against an integral for each band", ours, slow, "ms", 300, at_least=True)


def store() -> Iterator[Row]:
    from benchmarks.bench_pipeline import ToStore

    names = ("time_floor", "time_to_store", "time_naive")
    floor, ours, naive = timed(ToStore(), (4096,), names, 2).values()
    yield Row("to_store(reflectance), 4096 lines / read-encode-write", ours, floor, "ms", 1.6)
    yield Row("  against naive xarray + dask", ours, naive, "ms", 4, at_least=True)
    from benchmarks.bench_writing import Encoded

    for codec in ("compact", "fast"):
        floor, ours = timed(Encoded(), (2048, codec), ("time_floor", "time_to_store"), 7).values()
        text = f"to_store(reflectance, quality), codec {codec} / bare encode + write"
        yield Row(text, ours, floor, "ms", 1.25)


def look() -> Iterator[Row]:
    from benchmarks.bench_pipeline import Look

    goals = {"every_pixel": 1.3, "one_spectrum": 1.3, "region": 1.3, "one_band": 1.3, "lines_64": 0.87}
    for view, goal in goals.items():
        names = ("time_floor_stored_float32", "time_from_counts")
        stored, ours = timed(Look(), (2048, view), names, 4).values()
        text = f"{view.replace('_', ' ')}: from counts against stored float32"
        yield Row(text, ours, stored, "ms", goal, at_least=True)


def click(lines: int = 4000) -> Iterator[Row]:
    """Milliseconds of one look at a long line, the medians of nine, and the processor's beside them."""
    from benchmarks.bench_pipeline import Click
    from benchmarks.common import best_of

    limits = {"time_pixel": 8.0, "time_region": 20.0, "time_band": 150.0}
    limits |= {f"time_{each}_at_the_size_of_a_screen": 150.0 for each in ("band", "colours")}
    for layout in ("cube", "explore"):
        case = Click()
        case.setup(lines, layout)
        for name, limit in limits.items():
            wall, processor = _median(functools.partial(getattr(case, name), lines, layout), 9)
            what = f"{name.removeprefix('time_').replace('_', ' ')} of {lines} lines, {layout} / {limit:g} ms"
            yield Row(what, wall, limit, "ms", 1.0)
            yield Row("  the processor's time", processor, limit, "ms", 1.0)
        names = ("time_every_pixel", "time_every_pixel_of_stored_float32")
        passes = {name: functools.partial(getattr(case, name), lines, layout) for name in names}
        ours, stored = (1e3 * seconds for seconds in best_of(passes, 7).values())
        what = f"every pixel of {lines} lines, {layout}, against reading stored float32"
        yield Row(what, ours, stored, "ms", 1.0, at_least=True)


def _median(run: Callable[[], Any], rounds: int) -> tuple[float, float]:
    """Return the medians of wall and processor time of calls after the first [ms]."""
    run()
    spent = []
    for _ in range(rounds):
        start = time.perf_counter(), time.process_time()
        run()
        spent.append((time.perf_counter() - start[0], time.process_time() - start[1]))
    wall, processor = (1e3 * statistics.median(each) for each in zip(*spent, strict=True))
    return wall, processor


def graph() -> Iterator[Row]:
    from benchmarks.bench_graph import Graph

    case = Graph()
    (milliseconds,) = timed(case, (100_000,), ("time_build_and_optimise",), 9).values()
    with counted_reads("counts/c/") as reads:
        case.time_open(100_000)
        case.time_build_and_optimise(100_000)
    yield Row("graph of 100,000 lines, build and optimise / 1 s", milliseconds, 1e3, "ms", 0.4)
    yield Row("  tasks a slab, reflectance alone", case.track_tasks_per_slab(100_000), 1.0, "tasks", 2)
    yield Row("  chunks of the cube read meanwhile", float(len(reads)), 1.0, "reads", 0)


def io() -> Iterator[Row]:
    from benchmarks.bench_io import ReadEnvi

    floor, ours = timed(ReadEnvi(), (1024,), ("time_floor", "time_drain"), 8).values()
    yield Row("ENVI cube drained through dask / pread into one buffer", ours, floor, "ms", 2)
    from benchmarks.bench_writing import WriteEnvi

    names = ("time_floor", "time_one_thread", "time_two_threads")
    loop, one, two = timed(WriteEnvi(), (512,), names, 7).values()
    yield Row(
        "raw cube to flat reflectance file, one thread, against memmap", one, loop, "ms", 1, at_least=True
    )
    yield Row("  on two threads", two, loop, "ms", 1.5, at_least=True)


def distributed(lines: int = 2048) -> Iterator[Row]:
    """Two workers of one thread against two threads, each with the chunks the package takes there."""
    import dask
    from distributed import Client, LocalCluster

    from benchmarks.bench_pipeline import threads
    from benchmarks.common import THREADS, best_of, counts_store, scratch
    from hyperpaint.base.schema import CHUNK_LINES
    from hyperpaint.workflows.pipeline import CLUSTER_LINES

    products = {
        "to_store(reflectance)": ["reflectance"],
        "to_store(counts, reflectance, quality)": ["counts", "reflectance", "quality"],
    }
    with (
        LocalCluster(n_workers=THREADS, threads_per_worker=1, dashboard_address=":0") as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        for text, names in products.items():

            def on_threads(names: list[str] = names) -> None:
                with threads():
                    _write(counts_store(lines), names, CHUNK_LINES)

            def on_cluster(names: list[str] = names) -> None:
                with client.as_current(), dask.config.set(scheduler=client):
                    _write(counts_store(lines), names, CLUSTER_LINES)

            variants = {"threads": on_threads, "cluster": on_cluster}
            best = best_of(variants, 5, lambda: shutil.rmtree(scratch() / "out.zarr"))
            what = f"{text}, {lines} lines, 2 workers / 2 threads"
            yield Row(what, 1e3 * best["cluster"], 1e3 * best["threads"], "ms", 1.7)


def _write(store: Path, names: list[str], chunk: int) -> None:
    import xarray as xr

    import hyperpaint as hp
    from benchmarks.common import scratch

    line = xr.open_zarr(store, chunks=None).chunk({"along_track": chunk})
    hp.to_store(line.paint.reflectance(keep_bits=12)[names], scratch() / "out.zarr")


def render() -> Iterator[Row]:
    from benchmarks.bench_render import Block, Render

    names = ("time_trace", "time_relight", "time_relight_with_smile", "time_shares", "time_floor")
    traced, relit, bent, shares, floor = timed(Block(), (64,), names, 3).values()
    yield Row("relight 32 x 640 x 272, one thread / trace it with 64 samples", relit, traced, "ms", 0.02)
    yield Row("  with a smile of 1.5 nm", bent, traced, "ms", 0.05)
    yield Row("  shares of light alone", shares, traced, "ms", 0.02)
    yield Row("  against writing a cube of that size", relit, floor, "ms", 30)
    names = ("time_scene_to_radiance", "time_relight_other_paints")
    whole, again = timed(Render(), (64,), names, 3).values()
    yield Row("scene to radiance, 64 x 64 x 272, 64 samples, 2 threads / 1.5 s", whole, 1500.0, "ms", 1)
    yield Row("  other paints on the traced scene / scene to radiance", again, whole, "ms", 0.1)


def collects() -> Iterator[Row]:
    """`process` of collects whose cubes are not in the page cache: one long line, and many short ones."""
    from benchmarks.bench_writing import CAMERA_FRAMES_A_SECOND, Process

    lines, short, flights = 10_000, 500, 20
    names = ("time_floor", "time_process", "time_fast_codec", "time_without_reflectance")
    floor, ours, fast, bare = timed(Process(), (lines, 1), names, 2).values()
    yield Row(f"process, {lines} lines, cold / bare encode + write + fsync", ours, floor, "ms", 1.4)
    for text, took in {"": ours, ", codec fast": fast, ", without reflectance": bare}.items():
        speed = 1e3 * lines / took
        what = f"  frames a second / {CAMERA_FRAMES_A_SECOND:g}{text}"
        yield Row(what, 1.0 / speed, 1.0 / CAMERA_FRAMES_A_SECOND, "s", 6, at_least=True)
    (many,) = timed(Process(), (short, flights), ("time_process",), 2).values()
    each = (many - ours) / (flights - 1)
    yield Row(
        f"  {flights} lines of {short}: each over the cost of one of {lines} / 0.2 s", each, 200.0, "ms", 1
    )


def flight() -> Iterator[Row]:
    """A whole flight line in a process of its own: time and peak memory."""
    with tempfile.TemporaryDirectory(prefix="hyperpaint-flight-") as name:
        done = _child("_fly", Path(name), "1000")
    yield Row("rendered flight line, 640 x 1000 x 272, 64 samples / 100 s", done["seconds"], 100.0, "s", 1)
    yield Row("  peak memory / 1.5 GiB", done["peak"], 1.5 * 1024**3 / 1e6, "MB", 1)


class counted_reads:  # noqa: N801 (a context manager)
    """Gather the keys that are read from local Zarr stores and contain a text."""

    def __init__(self, text: str) -> None:
        self.text, self.keys = text, []

    def __enter__(self) -> list[str]:
        from zarr.storage import LocalStore

        self.plain = plain = LocalStore.get

        async def get(store: Any, key: str, *args: Any, **kwargs: Any) -> Any:
            if self.text in key:
                self.keys.append(key)
            return await plain(store, key, *args, **kwargs)

        LocalStore.get = get
        return self.keys

    def __exit__(self, *_: object) -> None:
        from zarr.storage import LocalStore

        LocalStore.get = self.plain


def memory() -> Iterator[Row]:
    """Peak memory of whole processes; each child reports its own.

    The long store holds the short one's chunks as hard links, so that it costs no disk.
    """
    with tempfile.TemporaryDirectory(prefix="hyperpaint-memory-") as name:
        folder = Path(name)
        idle = _child("_imports", folder)["peak"]
        _child("_prepare", folder)
        peaks = {}
        for lines in (6_144, 24_576):
            done = _child("_process", folder, str(lines))
            peaks[lines] = done["peak"]
            print(f"  {lines} lines: {done['peak']:.0f} MB at most, {done['seconds']:.1f} s", file=sys.stderr)
        long, short = peaks[24_576], peaks[6_144]
    yield Row("peak memory, 24,576 lines, above the imports / 100 MB", long - idle, 100.0, "MB", 4)
    yield Row("  24,576 against 6,144 lines", long, short, "MB", 1.15)


def _child(step: str, *arguments: object) -> dict[str, float]:
    command = [sys.executable, __file__, step, *map(str, arguments)]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    return dict(json.loads(done.stdout.splitlines()[-1]))


def _peak() -> float:
    """Return the peak memory of this process [MB]."""
    try:
        # not ru_maxrss, which Linux hands down from the process that started this one
        status = Path("/proc/self/status").read_text()
        return int(status.split("VmHWM:")[1].split()[0]) / 1e3
    except (OSError, IndexError):
        import resource

        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1e6 if sys.platform == "darwin" else 1e3)


def _imports(_folder: Path) -> None:
    import importlib

    modules = ("dask.array", "numba", "numcodecs.blosc", "pint", "scipy.interpolate", "xarray", "zarr")
    for module in (*modules, "hyperpaint.kernels.radiometry", "hyperpaint.io.store"):
        importlib.import_module(module)


def _prepare(folder: Path) -> None:
    from benchmarks.common import BLOCK_LINES, chunk_files, flight_line
    from hyperpaint import to_store

    to_store(flight_line(BLOCK_LINES), folder / "block.zarr")
    blocks = chunk_files(folder / "block.zarr")
    for lines in (6_144, 24_576):
        path = folder / f"{lines}.zarr"
        _write_frame(path, lines)
        for number in range(lines // 32):
            place = path / "counts" / "c" / str(number) / "0"
            place.mkdir(parents=True)
            os.link(blocks[number % len(blocks)], place / "0")


def _write_frame(path: Path, lines: int) -> None:
    from benchmarks.bench_graph import write_without_cube

    write_without_cube(path, lines)


def _process(folder: Path, lines: str) -> None:
    import xarray as xr

    import hyperpaint as hp
    from benchmarks.bench_pipeline import threads

    line = xr.open_zarr(folder / f"{lines}.zarr")
    with threads():
        hp.to_store(line.paint.reflectance()[["reflectance"]], folder / "out.zarr")
    shutil.rmtree(folder / "out.zarr")


def _fly(folder: Path, lines: str) -> None:
    import hyperpaint as hp
    from benchmarks.bench_pipeline import threads
    from benchmarks.bench_render import SUN, platform, scene

    traced = hp.simulation.trace(scene(), platform(int(lines), 640), [SUN], samples=64)
    with threads():
        hp.to_store(traced.paint.relight(truth=False)[["radiance"]], folder / "out.zarr")


GROUPS: dict[str, Callable[[], Iterator[Row]]] = {
    group.__name__: group for group in (imports, kernel, eager, irradiance, graph, io, look, store, render)
}
EXTRA = {
    "click": click, "distributed": distributed, "memory": memory, "collects": collects, "flight": flight,
}  # fmt: skip
CHILDREN = {child.__name__: child for child in (_imports, _prepare, _process, _fly)}


def _processor() -> str:
    import llvmlite.binding

    return str(llvmlite.binding.get_host_cpu_name())


def _compiled_for(processor: str, groups: list[str]) -> int:
    """Run groups in a process, with a cache of its own, whose kernels are for a processor; its status."""
    with tempfile.TemporaryDirectory(prefix="hyperpaint-kernels-") as cache:
        environment = {**os.environ, "NUMBA_CACHE_DIR": cache}
        if processor != "host":
            environment["NUMBA_CPU_NAME"] = processor
        return subprocess.run([sys.executable, __file__, *groups], check=False, env=environment).returncode


def main(arguments: list[str]) -> int:
    if arguments and arguments[0] in CHILDREN:
        start = time.perf_counter()
        CHILDREN[arguments[0]](Path(arguments[1]), *arguments[2:])
        print(json.dumps({"peak": _peak(), "seconds": time.perf_counter() - start}))
        return 0
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "groups", nargs="*", choices=[*GROUPS, *EXTRA, []], help="default: all but the last five"
    )
    parser.add_argument(
        "--processors", help="compile for these too, each in its own process: host,generic,haswell"
    )
    given = parser.parse_args(arguments)
    if given.processors:
        return sum(_compiled_for(name, given.groups) for name in given.processors.split(","))
    chosen = given.groups or list(GROUPS)
    print(f"{_processor()}; compiled for {os.environ.get('NUMBA_CPU_NAME') or 'it'}; ", end="")
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores\n{HEADER}")
    rows = []
    for name in chosen:
        for row in {**GROUPS, **EXTRA}[name]():
            print(row, flush=True)
            rows.append(row)
    missed = sum(not row.met for row in rows)
    print(f"{len(rows) - missed} of {len(rows)} goals met; load {os.getloadavg()[0]:.1f}")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
