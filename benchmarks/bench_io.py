"""Raw cubes in and stores out."""

# ruff: noqa: ARG002 (asv hands every parameter to every method)

from __future__ import annotations

import functools
import os

import numpy as np

from .common import BANDS, BLOCK_LINES, COLUMNS, THREADS, counts_block, scratch


@functools.cache
def envi_cube(lines):
    """Write an ENVI cube, band-interleaved by line; return its header."""
    path = scratch() / f"raw-{lines}"
    block = counts_block(min(lines, BLOCK_LINES))
    with open(path, "wb") as file:
        for start in range(0, lines, len(block)):
            file.write(block[: lines - start].tobytes())
    header = path.with_suffix(".hdr")
    header.write_text(
        f"ENVI\nsamples = {COLUMNS}\nlines = {lines}\nbands = {BANDS}\nheader offset = 0\n"
        "description = {raw counts}\nfile type = ENVI Standard\ndata type = 12\ninterleave = bil\n"
        "byte order = 0\n"
    )
    return header


class ReadEnvi:
    """A raw cube drained slab by slab; the floor is pread into one buffer a thread."""

    params = ([128],)
    param_names = ("lines",)

    def setup(self, lines):
        import xarray as xr

        self.header = envi_cube(lines)
        self.dataset = xr.open_dataset(self.header, engine=_engine(), chunks={"along_track": 32})

    def time_open(self, lines):
        import xarray as xr

        xr.open_dataset(self.header, engine=_engine())

    def time_drain(self, lines):
        import dask

        with dask.config.set(scheduler="threads", num_workers=THREADS):
            self.dataset["counts"].data.map_blocks(_drop, dtype=np.uint8, chunks=(1, 1, 1)).compute()

    def time_floor(self, lines):
        from concurrent.futures import ThreadPoolExecutor

        size = 32 * BANDS * COLUMNS * 2
        file = os.open(self.header.with_suffix(""), os.O_RDONLY)

        def read(part):
            buffer = bytearray(size)
            for start in range(part * size, lines * BANDS * COLUMNS * 2, THREADS * size):
                os.preadv(file, [buffer], start)

        with ThreadPoolExecutor(THREADS) as pool:
            list(pool.map(read, range(THREADS)))
        os.close(file)

    def time_one_spectrum(self, lines):
        self.dataset["counts"].isel(along_track=lines // 2, cross_track=20).compute(scheduler="synchronous")


def _engine():
    # by class: the entry point is there only where the package is installed
    from hyperpaint.io.backends import EnviBackendEntrypoint

    return EnviBackendEntrypoint


def _drop(_block):
    return np.zeros((1, 1, 1), np.uint8)
