"""Paints looked for in a flight line from counts: planned without a value, then computed slab by slab."""

# ruff: noqa: ARG002 (asv hands every parameter to every method)

from __future__ import annotations

from .bench_pipeline import threads
from .common import cases, counts_store

PAINTS = 6


class Detect:
    """Six paints of the starter library, the others of it unknown; two threads."""

    params = (cases(128, 1024, 4096),)
    param_names = ("lines",)
    timeout = 600

    def setup(self, lines):
        import xarray as xr

        from hyperpaint.paints import starter_library

        self.line = xr.open_zarr(counts_store(lines))
        library = starter_library(members=0)
        self.paints = library.isel(signature=slice(0, PAINTS))
        self.others = library.isel(signature=slice(PAINTS, None))

    def time_plan(self, lines):
        self.planned()

    def time_detect(self, lines):
        with threads():
            self.planned().compute()

    def planned(self):
        import hyperpaint as hp

        reflectance = self.line.paint.reflectance()
        return hp.paints.detect(reflectance, self.paints, false_alarm_rate=1e-2, others=self.others)
