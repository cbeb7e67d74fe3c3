"""Others on the same samples, side by side in one run: reflectance, maps and scenes.

    python benchmarks/peers.py                      the table of docs/figures.md, some minutes
    python benchmarks/peers.py --lines 128 files    one job, a first look

Jobs: ``files`` a raw ENVI cube to a file of reflectance, ``memory`` counts in memory, ``map`` the place of
every cell of a map, ``render`` a small car park. Rounds are interleaved and the least wall time counts. Every
peer is given its best: no flags, no smile, one spectrum of irradiance for the whole line, as they have it;
hyperpaint does what it always does, with quality and the irradiance of every line. What openhsi (0.4.2) and
MassiPipe (0.3.2) compute is said again here in numpy, without their files. Packages that are not installed
are named and left out.
"""

from __future__ import annotations

import argparse
import importlib
import platform
import shutil
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
for folder in (ROOT, ROOT / "tests"):  # run as a script: neither is importable yet
    if str(folder) not in sys.path:
        sys.path.insert(0, str(folder))

from benchmarks.common import (  # noqa: E402
    EXPOSURE,
    FULL_SCALE,
    THREADS,
    best_of,
    counts_block,
    flight_line,
    instrument,
    scratch,
    sky,
    wavelengths,
)  # fmt: skip

SLAB = 32
OURS = "hyperpaint"


@dataclass(frozen=True)
class Result:
    """What one program took for a job."""

    job: str
    program: str
    how: str
    seconds: float


def missing(*packages: str) -> str:
    """Return the first of some packages that cannot be imported; empty where all can."""
    for package in packages:
        try:
            importlib.import_module(package)
        except ImportError:
            return package
    return ""


def raced(job: str, variants: dict[str, tuple[str, Callable[[], Any]]], rounds: int) -> Iterator[Result]:
    """Yield what programs took; a key is a program, and after a slash what tells its ways apart."""
    seconds = best_of({name: run for name, (_, run) in variants.items()}, rounds)
    for name, (how, _) in variants.items():
        yield Result(job, name.partition("/")[0], how, seconds[name])


# --- counts to reflectance ---------------------------------------------------------------------------------


class Constants:
    """What every program is given beside the counts: (band, column) and (band,), float32."""

    def __init__(self) -> None:
        parts = instrument()
        self.dark, self.gain = parts["dark"], parts["gain"]
        self.irradiance = sky(wavelengths()).astype(np.float32)
        self.factor = (np.pi * self.gain / EXPOSURE / self.irradiance[:, None]).astype(np.float32)

    def of_a_block(self, counts: Any) -> Any:
        """Return reflectance, as somebody who knows numpy writes it."""
        block = counts.astype(np.float32)
        block -= self.dark
        block *= self.factor
        return block


def by_openhsi(counts: Any, known: Constants, out: Any) -> None:
    """Do what `dn2rad` and `rad2ref_6SV` of openhsi do to every line, into its buffer of the cube.

    Counts above dark are scaled by radiance over counts of a lamp, at the exposures of both; then they are
    divided by the radiance that a model expects of a white surface, one spectrum a flight.
    """
    scale = known.gain / np.float32(EXPOSURE)
    white = (known.irradiance / np.float32(np.pi))[:, None]
    for line, row in zip(counts, out, strict=True):
        radiance = (line.astype(np.float32) - known.dark) * scale
        row[:] = radiance / white


def by_massipipe(counts: Any, known: Constants) -> Any:
    """Do what MassiPipe does to an image (line, column, band): float64, then whole microflicks.

    Negative radiance becomes 0, and so do all bands of a saturated pixel; then comes the mean spectrum of
    irradiance in the same units.
    """
    microflicks = 1e5
    radiance = (counts - known.dark.T.astype(np.float64)) * (known.gain.T / EXPOSURE * microflicks)
    radiance[radiance < 0] = 0
    radiance[np.any(counts >= FULL_SCALE, axis=2)] = 0
    whole = radiance.astype(np.uint16)
    irradiance = known.irradiance * microflicks
    return np.pi * (whole.astype(np.float32) / irradiance.astype(np.float32))


def memory(lines: int, rounds: int) -> Iterator[Result]:
    """Counts in memory to reflectance in memory."""
    import dask
    import dask.array as da

    import hyperpaint as hp

    counts, known = counts_block(lines), Constants()
    line = flight_line(lines, counts=counts).chunk(along_track=SLAB)
    out, quality = np.empty(counts.shape, np.float32), np.empty((lines, counts.shape[2]), np.uint16)
    image = np.ascontiguousarray(counts.transpose(0, 2, 1))

    def ours(threads: int) -> None:
        made = hp.reflectance(line)
        with dask.config.set(scheduler="threads", num_workers=threads):
            da.store([made["reflectance"].data, made["quality"].data], [out, quality], lock=False)

    def naive() -> Any:
        return (
            np.pi
            * (counts - known.dark.astype(np.float64))
            * known.gain
            / EXPOSURE
            / known.irradiance[:, None]
        )

    def blocks() -> None:
        for start in range(0, lines, SLAB):
            out[start : start + SLAB] = known.of_a_block(counts[start : start + SLAB])

    yield from raced(
        "memory",
        {
            OURS: ("reflectance and quality, irradiance of every line, two threads", lambda: ours(THREADS)),
            f"{OURS}/1": ("the same on one thread", lambda: ours(1)),
            "numpy": ("slabs, float32, one factor", blocks),
            "numpy/64": ("one expression, float64", naive),
            "openhsi": ("its arithmetic, line by line", lambda: by_openhsi(counts, known, out)),
            "MassiPipe": ("its arithmetic, whole image", lambda: by_massipipe(image, known)),
        },
        rounds,
    )


def files(lines: int, rounds: int) -> Iterator[Result]:
    """A raw ENVI cube to a file of reflectance, both in the page cache."""
    import dask

    import hyperpaint as hp
    from benchmarks.bench_io import envi_cube
    from hyperpaint.io.envi.envi_cubes import open_envi, write_envi

    header, known = envi_cube(lines), Constants()
    raw = header.with_suffix("")
    shape = (lines, *known.dark.shape)
    folder = Path(tempfile.mkdtemp(dir=scratch()))
    counts = open_envi(header)["counts"].chunk(along_track=SLAB)
    line = flight_line(lines, counts=counts.data)

    def ours(threads: int) -> None:
        with dask.config.set(scheduler="threads", num_workers=threads):
            write_envi(hp.reflectance(line), folder / "ours", variable="reflectance", overwrite=True)

    def mapped(threads: int) -> None:
        source = np.memmap(raw, np.uint16, "r", shape=shape)
        target = np.memmap(folder / "mapped", np.float32, "w+", shape=shape)

        def one(start: int) -> None:
            target[start : start + SLAB] = known.of_a_block(source[start : start + SLAB])

        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(one, range(0, lines, SLAB)))
        target.flush()

    variants: dict[str, tuple[str, Callable[[], Any]]] = {
        OURS: ("open_envi, reflectance, write_envi, two threads", lambda: ours(THREADS)),
        f"{OURS}/1": ("the same on one thread", lambda: ours(1)),
        "np.memmap": ("a loop over slabs, two threads", lambda: mapped(THREADS)),
        "np.memmap/1": ("the same on one thread", lambda: mapped(1)),
    }
    if not (absent := missing("spectral")):
        variants |= _spy(header, shape, known, folder)
    else:
        print(f"SPy left out: {absent} is not installed")
    if not (absent := missing("rioxarray", "rasterio")):
        how = "open_rasterio in chunks of lines, stored in a memory map"
        variants["rioxarray"] = (how, lambda: _rioxarray(raw, shape, known, folder))
    else:
        print(f"rioxarray left out: {absent} is not installed")
    yield from raced("files", variants, rounds)
    shutil.rmtree(folder)


def _spy(header: Path, shape: Any, known: Constants, folder: Path) -> dict[str, Any]:
    """Return two ways of SPy: memory maps in and out, and a cube that is loaded and saved."""
    from spectral.io import envi

    lines, bands, columns = shape

    def mapped() -> None:
        source = envi.open(header).open_memmap(interleave="source")
        fields = {"lines": lines, "samples": columns, "bands": bands, "data type": 4, "interleave": "bil"}
        image = envi.create_image(str(folder / "spy.hdr"), fields, ext="", force=True)
        target = image.open_memmap(interleave="source", writable=True)
        for start in range(0, lines, SLAB):
            target[start : start + SLAB] = known.of_a_block(source[start : start + SLAB])
        target.flush()

    def loaded() -> None:
        cube = np.asarray(envi.open(header).load())
        made = (cube - known.dark.T) * known.factor.T
        envi.save_image(str(folder / "saved.hdr"), made, dtype=np.float32, force=True, ext="")

    return {
        "SPy": ("open_memmap in and out, a loop over slabs", mapped),
        "SPy/load": ("load, numpy, save_image", loaded),
    }


def _rioxarray(raw: Path, shape: Any, known: Constants, folder: Path) -> None:
    import dask
    import dask.array as da
    import rioxarray

    # a cube in sensor geometry has no place on a map
    warnings.filterwarnings("ignore", message="Dataset has no geotransform")
    source = rioxarray.open_rasterio(raw, chunks={"band": -1, "y": SLAB, "x": -1}, lock=False)
    counts = source.data.astype(np.float32)  # (band, y, x)
    made = (counts - known.dark[:, None, :]) * known.factor[:, None, :]
    target = np.memmap(folder / "rio", np.float32, "w+", shape=(shape[1], shape[0], shape[2]))
    with dask.config.set(scheduler="threads", num_workers=THREADS):
        da.store(made, target, lock=False)
    target.flush()


# --- lines to maps, scenes to radiance ---------------------------------------------------------------------

_HOW_MAPPED = {
    OURS: "orthorectify: nearest pixel of every cell, two threads",
    "scipy": "k-d tree of all pixels, two threads",
    "pyresample": "kd_tree.get_neighbour_info, one thread",
    "gdal": "warp by geolocation arrays through rasterio, two threads",
}


def maps(lines: int, rounds: int) -> Iterator[Result]:
    """Which pixel lies in every cell of a map with north up; 640 columns."""
    import contextlib
    import io

    import dask

    from benchmarks.orthorectified_lines import compare

    said = io.StringIO()
    with dask.config.set(scheduler="threads", num_workers=THREADS), contextlib.redirect_stdout(said):
        seconds = compare(lines, 640, False, rounds)
    for text in said.getvalue().splitlines():
        if "left out" in text:
            print(text)
    for program, how in _HOW_MAPPED.items():
        if program in seconds:
            yield Result("map", "GDAL" if program == "gdal" else program, how, seconds[program])


PIXELS, SAMPLES = 64, 64


def render(_lines: int, rounds: int) -> Iterator[Result]:
    """Radiance of a small car park from straight above, 64 x 64 pixels of 64 paths."""
    import dask

    import hyperpaint as hp
    from benchmarks.bench_render import SUN, platform as flight_over, scene

    def ours(bands: Any) -> None:
        with dask.config.set(scheduler="threads", num_workers=THREADS):
            traced = hp.simulation.trace(
                scene(), flight_over(PIXELS, PIXELS), [SUN], samples=SAMPLES, chunk_lines=PIXELS // 8
            )
            traced.paint.relight(truth=False, **bands)["radiance"].compute()

    variants: dict[str, tuple[str, Callable[[], Any]]] = {
        OURS: ("trace and relight, 272 bands, two threads", lambda: ours({})),
    }
    if absent := missing("mitsuba"):
        print(f"Mitsuba left out: {absent} is not installed")
    else:
        described = _described()
        import mitsuba

        how = f"{mitsuba.variant()}, path, 4 of these bands, all cores"
        variants["Mitsuba"] = (how, lambda: np.array(mitsuba.render(described)))
    yield from raced("render", variants, rounds)


def _described() -> Any:
    """Return the same car park, sky and view for Mitsuba, loaded."""
    from dataclasses import replace

    import mitsuba

    mitsuba.set_variant("scalar_spectral")  # that of LLVM ends the process on some processors
    from oracles.mitsuba_scenes import FrameCamera, to_mitsuba

    from benchmarks.bench_render import scene
    from hyperpaint.simulation.atmosphere import Atmosphere

    noon = replace(Atmosphere.clear(30.0, 90.0, haze=None), clear_shares=None)
    height, ground = 40.0, 12.0
    angle = 2.0 * np.degrees(np.arctan(ground / 2.0 / height))
    camera = FrameCamera((0.0, 0.0, height), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), angle, PIXELS, PIXELS)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what Mitsuba cannot do as the scene has it
        described = to_mitsuba(
            scene(), noon, scratch() / "meshes", wavelength=[450.0, 550.0, 650.0, 850.0], camera=camera,
            samples=SAMPLES,
        )  # fmt: skip
    return mitsuba.load_dict(described)


# --- the table ---------------------------------------------------------------------------------------------

JOBS = {"files": files, "memory": memory, "map": maps, "render": render}


def processor() -> str:
    """Return the name of the processor, and what numba compiles for where that was asked for."""
    import os

    name = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        names = [
            line.partition(":")[2].strip() for line in info.read_text().splitlines() if "model name" in line
        ]
        name = names[0] if names else name
    wanted = os.environ.get("NUMBA_CPU_NAME")
    return f"{name}, {os.cpu_count()} cores{f', kernels for {wanted}' if wanted else ''}"


def rows(results: list[Result], lines: dict[str, int]) -> Iterator[str]:
    """Yield the table in Markdown."""
    yield f"| job | program | what was run on {processor()} | ms | x hyperpaint |"
    yield "| --- | --- | --- | ---: | ---: |"
    for result in results:
        ours = next(each.seconds for each in results if each.job == result.job)
        size = "64 x 64 pixels" if result.job == "render" else f"{lines[result.job]} lines"
        took = f"{1e3 * result.seconds:.0f} | {result.seconds / ours:.2f}"
        yield f"| {result.job}, {size} | {result.program} | {result.how} | {took} |"


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("jobs", nargs="*", default=list(JOBS), metavar="JOB", help=", ".join(JOBS))
    parser.add_argument("--lines", type=int, default=480, help="of files and memory")
    parser.add_argument("--map-lines", type=int, default=1000)
    parser.add_argument("--rounds", type=int, default=5)
    asked = parser.parse_args()
    if unknown := set(asked.jobs) - set(JOBS):
        parser.error(f"{', '.join(unknown)}: expected some of {', '.join(JOBS)}")
    lines = {"files": asked.lines, "memory": asked.lines, "map": asked.map_lines, "render": 0}
    results: list[Result] = []
    for job in asked.jobs:
        results += JOBS[job](lines[job], asked.rounds)
    print("\n".join(rows(results, lines)))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
