"""From raw cubes to finished stores and files, against bare encoding and writing of the same chunks."""

# ruff: noqa: ARG002 (asv hands every parameter to every method)

from __future__ import annotations

import functools
import os
import shutil
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from .bench_io import envi_cube
from .bench_pipeline import threads
from .common import (
    BANDS,
    BLOCK_LINES,
    COLUMNS,
    EXPOSURE,
    THREADS,
    cases,
    counts_store,
    flight_line,
    instrument,
    scratch,
)

CAMERA_FRAMES_A_SECOND = 143.0
"""Of a Nano at 640 x 272, of which the cubes here have the shape."""

_PERIOD_MS = 7.0


@functools.cache
def collect_of(lines, flights):
    """Write a collect of so many flight lines of so many scan lines each; return its ``collect.toml``.

    The cubes are links to one file.
    """
    import hyperpaint as hp

    folder = scratch() / f"collect-{lines}-{flights}"
    folder.mkdir()
    line = flight_line(lines)
    sky = line[["irradiance", "irradiance_fwhm"]]
    hp.to_store(sky, folder / "sky.zarr")
    known = ["radiance_gain", "read_noise", "wavelength", "fwhm", "good"]
    calibration = line[known].assign_attrs(srf_shape="gaussian", calibration="benchmark")
    hp.to_store(calibration, folder / "calibration.zarr")
    header = envi_cube(lines)
    text = (
        '[collect]\nname = "benchmark"\n[camera]\nbit_depth = 12\n'
        f'exposure_time_ms = {1e3 * EXPOSURE}\nstamp = "mid"\n[calibration]\npath = "calibration.zarr"\n'
        '[dark]\ncubes = ["dark.hdr"]\n[irradiance]\nfiles = "sky.zarr"\nstamp = "mid"\n'
    )
    dark = np.rint(instrument()["dark"] + np.random.default_rng(3).normal(0.0, 1.0, (16, BANDS, COLUMNS)))
    dark.astype("<u2").tofile(folder / "dark")
    axis = ", ".join(f"{nm:.6f}" for nm in line["wavelength"].values)
    rows = header.read_text() + f"wavelength units = nm\nwavelength = {{{axis}}}\n"
    (folder / "dark.hdr").write_text(rows.replace(f"lines = {lines}\n", "lines = 16\n"))
    for flight in range(flights):
        os.link(header.with_suffix(""), folder / f"raw_{flight}")
        (folder / f"raw_{flight}.hdr").write_text(rows)
        text += f'[[flightlines]]\nid = "raw_{flight}"\ncube = "raw_{flight}.hdr"\n'
        text += f"start_time = {line['time'].values[0]}Z\nframe_period_ms = {_PERIOD_MS}\n"
    (folder / "collect.toml").write_text(text)
    return folder / "collect.toml"


def evict(path):
    """Let the kernel forget what it has read of a file."""
    with open(path, "rb") as file:
        os.fsync(file.fileno())
        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


class Encoded:
    """`to_store` of reflectance and quality; the floor encodes and writes the same chunks, no more."""

    params = ([128], ["compact", "fast"])
    param_names = ("lines", "codec")

    def setup(self, lines, codec):
        import xarray as xr

        self.line = xr.open_zarr(counts_store(lines))
        few = self.line.isel(along_track=slice(0, min(lines, BLOCK_LINES)))
        few = few.paint.reflectance()[["reflectance", "quality"]].compute()
        self.cubes = [few["reflectance"].values, few["quality"].values]

    def teardown(self, *_):
        for folder in scratch().glob("encoded-*"):
            shutil.rmtree(folder)

    def time_to_store(self, lines, codec):
        import hyperpaint as hp

        with threads():
            product = self.line.paint.reflectance()[["reflectance", "quality"]]
            hp.to_store(product, scratch() / "encoded-store", codec=codec)

    def time_floor(self, lines, codec):
        write_chunks(scratch() / "encoded-floor", self.cubes, lines, codec)


def write_chunks(folder, cubes, lines, codec="compact", *, durable=False):
    """Encode and write chunks of 32 lines on `THREADS` threads; shorter cubes are repeated."""
    import google_crc32c
    import numcodecs.blosc
    from numcodecs.blosc import BITSHUFFLE, SHUFFLE, Blosc

    numcodecs.blosc.use_threads = False
    shuffle = BITSHUFFLE if codec == "compact" else SHUFFLE
    encoders = [Blosc("lz4", 5, shuffle, typesize=cube.dtype.itemsize) for cube in cubes]
    folder.mkdir()

    def write(start):
        for number, (cube, encoder) in enumerate(zip(cubes, encoders, strict=True)):
            first = start % len(cube)
            encoded = encoder.encode(np.ascontiguousarray(cube[first : first + 32]))
            with open(folder / f"{number}-{start}", "wb") as file:
                file.writelines((encoded, google_crc32c.value(encoded).to_bytes(4, "little")))
                file.flush()
                if durable:
                    os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)

    def sync(path):
        with open(path, "rb") as file:
            os.fsync(file.fileno())

    with ThreadPoolExecutor(THREADS) as pool:
        list(pool.map(write, range(0, lines, 32)))
        if durable:
            list(pool.map(sync, folder.iterdir()))


class Process:
    """`process` of a collect whose cubes are not in memory; the floor encodes and writes what is stored."""

    params = ([256], cases(1, 2))
    param_names = ("lines", "flights")
    number, repeat, timeout = 1, (1, 3, 60.0), 300

    def setup(self, lines, flights):
        import hyperpaint as hp

        self.path = collect_of(lines, flights)
        first = hp.open_collect(collect_of(BLOCK_LINES, 1))["flightlines/raw_0"].to_dataset()
        few = first.paint.reflectance(keep_bits=12)[["counts", "reflectance"]].compute()
        self.cubes = [few["counts"].values, few["reflectance"].values]
        self.teardown()

    def teardown(self, *_):
        for folder in scratch().glob("process-*"):
            shutil.rmtree(folder)
        evict(self.path.parent / "raw_0")

    def time_process(self, lines, flights):
        self._run()

    def time_fast_codec(self, lines, flights):
        self._run(codec="fast")

    def time_without_reflectance(self, lines, flights):
        self._run(reflectance="none")

    def _run(self, **options):
        import warnings

        import hyperpaint as hp

        with threads(), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a benchmark's collect is not plausible in all
            hp.process(self.path, scratch() / "process-store.zarr", **options)

    def time_floor(self, lines, flights):
        write_chunks(scratch() / "process-floor", self.cubes, lines * flights, durable=True)


class WriteEnvi:
    """A raw cube to a flat file of reflectance; the floor is a loop over lines with `numpy.memmap`."""

    params = ([128],)
    param_names = ("lines",)
    number = 1

    def setup(self, lines):
        self.header = envi_cube(lines)
        self.line = flight_line(lines)

    def teardown(self, lines):
        for path in scratch().glob("flat*"):
            path.unlink()

    def time_one_thread(self, lines):
        self._write(1)

    def time_two_threads(self, lines):
        self._write(2)

    def _write(self, workers):
        import dask
        import xarray as xr

        from hyperpaint.io.backends import EnviBackendEntrypoint
        from hyperpaint.io.envi.envi_cubes import write_envi

        raw = xr.open_dataset(self.header, engine=EnviBackendEntrypoint, chunks={"along_track": 32})
        line = self.line.assign(counts=self.line["counts"].copy(data=raw["counts"].data))
        with dask.config.set(scheduler="threads", num_workers=workers):
            write_envi(line.paint.reflectance(), scratch() / "flat.img", variable="reflectance")

    def time_floor(self, lines):
        shape = (lines, BANDS, COLUMNS)
        raw = np.memmap(self.header.with_suffix(""), np.uint16, "r", shape=shape)
        flat = np.memmap(scratch() / "flat", np.float32, "w+", shape=shape)
        light = self.line["irradiance"].interp(irradiance_time=self.line["time"])
        light = light.interp(irradiance_wavelength=self.line["wavelength"]).values.astype(np.float32)
        parts = instrument()
        factor = (np.pi * parts["gain"] / EXPOSURE).astype(np.float32)
        for number in range(lines):
            flat[number] = (raw[number] - parts["dark"]) * (factor / light[number][:, None])
