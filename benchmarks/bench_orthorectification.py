"""Flight lines to maps: where cells lie in the line, and their spectra."""

from __future__ import annotations

import numpy as np

from .common import THREADS, cases
from .orthorectified_lines import located_line, posed_line, with_counts


def threads():
    import dask

    return dask.config.set(scheduler="threads", num_workers=THREADS)


class Map:
    """From poses to a map of counts in memory, kernels compiled before."""

    params = (cases(100, 500), ["flight", "north"])
    param_names = ("lines", "grid")
    number = 1
    timeout = 300
    bands = 64

    def setup(self, lines, grid):
        columns = 640 if lines > 100 else 64
        self.posed = with_counts(posed_line(lines, columns), self.bands)
        self.located = located_line(self.posed)
        self.time_poses_to_map(lines, grid)

    def time_poses_to_map(self, _lines, grid):
        self._store(located_line(self.posed), grid, "nearest")

    def time_bilinear(self, _lines, grid):
        self._store(self.located, grid, "bilinear")

    def time_index(self, _lines, grid):
        import hyperpaint as hp

        with threads():
            hp.geometry.orthorectify(self.located, grid=grid, variables=[])["glt_line"].compute()

    def time_plan(self, _lines, grid):
        import hyperpaint as hp

        with threads():
            hp.geometry.orthorectify(self.located, grid=grid, variables=["counts"])

    def peakmem_poses_to_map(self, lines, grid):
        self.time_poses_to_map(lines, grid)

    def _store(self, located, grid, method):
        import dask.array as da

        import hyperpaint as hp

        with threads():
            made = hp.geometry.orthorectify(located, grid=grid, variables=["counts"], method=method)["counts"]
            da.store(made.data, np.empty(made.shape, made.dtype), lock=False)
