"""From a store of counts to a store of reflectance, and to what a person looks at."""

# ruff: noqa: ARG002 (asv hands every parameter to every method)

from __future__ import annotations

import functools
import itertools
import shutil
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from .common import BANDS, COLUMNS, THREADS, chunk_files, counts_store, plan_of, scratch

_numbers = itertools.count()
_SLAB = (32, BANDS, COLUMNS)


def threads():
    import dask

    return dask.config.set(scheduler="threads", num_workers=THREADS)


class ToStore:
    """Counts to stored float32 reflectance, two threads.

    The floor does the same job with nothing around it: read, decode, kernel, encode, write, in memory that is
    used again. The naive variant is what one writes with xarray and dask alone.
    """

    params = ([128],)
    param_names = ("lines",)
    number = 1
    timeout = 120

    def setup(self, lines):
        import numcodecs.blosc
        import xarray as xr

        numcodecs.blosc.use_threads = False
        self.line = xr.open_zarr(counts_store(lines))
        self.files = chunk_files(counts_store(lines))
        self.plan = plan_of(self.line)

    def teardown(self, lines):
        for folder in scratch().glob("out-*"):
            shutil.rmtree(folder)

    def _fresh(self):
        return scratch() / f"out-{next(_numbers)}"

    def time_to_store(self, lines):
        import hyperpaint as hp

        with threads():
            hp.to_store(self.line.paint.reflectance()[["reflectance"]], self._fresh())

    def time_to_store_with_quality(self, lines):
        import hyperpaint as hp

        with threads():
            hp.to_store(self.line.paint.reflectance()[["reflectance", "quality"]], self._fresh())

    def time_floor(self, lines):
        folder = self._fresh()
        folder.mkdir()
        with ThreadPoolExecutor(THREADS) as pool:
            list(pool.map(lambda part: self._bare(folder, part), range(THREADS)))

    def _bare(self, folder, part):
        import google_crc32c
        from numcodecs.blosc import BITSHUFFLE, Blosc

        from hyperpaint.kernels.arguments import SlabOutputs
        from hyperpaint.radiometry.slabs import calibrate_lines

        coder, encoder = Blosc(), Blosc("lz4", 5, BITSHUFFLE, typesize=4)
        counts, out = np.empty(_SLAB, np.uint16), np.empty(_SLAB, np.float32)
        no_quality, none = np.empty((0, 0), np.uint16), np.empty((0, 0, 0), np.float32)
        for number in range(part, len(self.files), THREADS):
            stored = memoryview(self.files[number].read_bytes())
            # the codec is blosc, then crc32c in the last four bytes
            if google_crc32c.value(stored[:-4].tobytes()) != int.from_bytes(stored[-4:], "little"):
                raise ValueError(number)
            coder.decode(stored[:-4], out=counts)
            calibrate_lines(self.plan, counts, number * _SLAB[0], SlabOutputs(out, no_quality, none, none))
            encoded = encoder.encode(out)
            checksum = google_crc32c.value(encoded).to_bytes(4, "little")
            with open(folder / str(number), "wb") as file:
                file.writelines((encoded, checksum))

    def time_naive(self, lines):
        line = self.line
        light = line["irradiance"].astype("float64").interp(irradiance_time=line["time"])
        light = light.interp(irradiance_wavelength=line["wavelength"]).reset_coords(drop=True)
        above = line["counts"] - line["dark_counts"].astype("float64")
        radiance = above * line["radiance_gain"].astype("float64") / line["exposure_time"]
        made = (np.pi * radiance / light).transpose(*line["counts"].dims).to_dataset(name="reflectance")
        with threads():
            made.to_zarr(self._fresh(), zarr_format=3, consolidated=False)


@functools.cache
def reflectance_store(lines):
    import xarray as xr

    import hyperpaint as hp

    path = scratch() / f"reflectance-{lines}.zarr"
    made = xr.open_zarr(counts_store(lines)).paint.reflectance()[["reflectance"]]
    with threads():
        return hp.to_store(made, path, source_token=str(lines))


class Look:
    """What a person asks of a cube, computed from counts or read as stored float32 (the floor)."""

    params = ([128], ["every_pixel", "one_spectrum", "region", "one_band", "lines_64"])
    param_names = ("lines", "view")
    timeout = 120

    def setup(self, lines, view):
        import xarray as xr

        self.counted = xr.open_zarr(counts_store(lines)).paint.reflectance()["reflectance"].data
        self.stored = xr.open_zarr(reflectance_store(lines))["reflectance"].data

    def _look(self, cube, lines, view):
        middle = lines // 2
        with threads():
            if view == "every_pixel":
                cube.max(axis=(0, 2)).compute()
            elif view == "one_spectrum":
                cube[middle, :, 20].compute()
            elif view == "region":
                cube[middle : middle + 40, :, 20:60].compute()
            elif view == "one_band":
                cube[:, 20, :].compute()
            else:
                cube[middle - 32 : middle + 32].compute()

    def time_from_counts(self, lines, view):
        self._look(self.counted, lines, view)

    def time_floor_stored_float32(self, lines, view):
        self._look(self.stored, lines, view)


class Click:
    """A pixel, a region and a band of a line from our store, as a person clicks: nothing is cut out before.

    The lazy cube of the same place, and for all lines reading stored float32, stand beside.
    """

    params = ([128], ["cube", "explore"])
    param_names = ("lines", "layout")
    timeout = 300

    def setup(self, lines, layout):
        import hyperpaint as hp

        self.line = hp.open_store(counts_store(lines, smile=True, layout=layout, coarse=True))
        self.middle = lines // 2 - lines // 2 % 32
        self.line.paint.pixels(0, 0)  # what is small is read with the first click
        self.stored = hp.open_store(reflectance_store(lines))["reflectance"]

    def time_pixel(self, lines, layout):
        self.line.paint.pixels(self.middle + 5, 20)

    def time_region(self, lines, layout):
        self.line.paint.pixels(slice(self.middle, self.middle + 32), slice(20, 52))

    def time_band(self, lines, layout):
        self.line.paint.pixels(wavelength=650.0)

    def time_band_at_the_size_of_a_screen(self, lines, layout):
        with threads():
            self.line.paint.coarse().paint.at(650.0).reflectance.compute()

    def time_colours_at_the_size_of_a_screen(self, lines, layout):
        with threads():
            self.line.paint.coarse().paint.rgb().compute()

    def time_pixel_of_the_lazy_cube(self, lines, layout):
        with threads():
            self.line.paint.reflectance().reflectance[self.middle + 5, :, 20].compute()

    def time_every_pixel(self, lines, layout):
        with threads():
            self.line.paint.reflectance().reflectance.data.max(axis=(0, 2)).compute()

    def time_every_pixel_of_stored_float32(self, lines, layout):
        with threads():
            self.stored.data.max(axis=(0, 2)).compute()
