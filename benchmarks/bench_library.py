"""A paint library written in the formats that hold members, and read back."""

# ruff: noqa: ARG002 (asv hands every parameter to every method)

from __future__ import annotations

import resource
import shutil
import subprocess
import sys

from .bench_dirsig import paint_library
from .common import cases, scratch

FORMATS = ("sli", "zarr", "csv")
PAINTS = cases(10, 100, 1000)
_ALONE = "from benchmarks.bench_library import peak; import sys; print(peak(sys.argv[1], int(sys.argv[2])))"


def peak(suffix, paints):
    """Return the most memory this process ever had after writing a library [byte]."""
    from hyperpaint.io.library import write_library

    out = scratch() / "peak_library"
    write_library(paint_library(paints), out / f"paints.{suffix}")
    shutil.rmtree(out)
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


class Libraries:
    """A thousand paints of 200 members: 220 MB of values, seconds as ENVI or Zarr, half a minute as text."""

    params = (FORMATS, PAINTS)
    param_names = ("format", "paints")
    timeout = 600
    number, repeat, warmup_time = 1, 1, 0

    def setup(self, suffix, paints):
        from hyperpaint.io.library import write_library

        self.out = scratch() / "library"
        self.library = paint_library(paints)
        self.path = write_library(self.library, self.out / f"paints.{suffix}", overwrite=True)

    def teardown(self, suffix, paints):
        shutil.rmtree(self.out, ignore_errors=True)

    def time_write(self, suffix, paints):
        from hyperpaint.io.library import write_library

        write_library(self.library, self.path, overwrite=True)

    def time_open(self, suffix, paints):
        from hyperpaint.io.library import open_library

        open_library(self.path).load()

    def track_peak(self, suffix, paints):
        done = subprocess.run(
            [sys.executable, "-c", _ALONE, suffix, str(paints)], capture_output=True, text=True, check=True
        )
        return int(done.stdout)

    track_peak.unit = "byte"
