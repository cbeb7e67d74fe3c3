"""A paint library written for DIRSIG, and one of its files read back."""

# ruff: noqa: ARG002 (asv hands every parameter to every method)

from __future__ import annotations

import resource
import shutil
import subprocess
import sys

import numpy as np

from .common import BANDS, cases, scratch, wavelengths

MEMBERS = 200
_ALONE = "from benchmarks.bench_dirsig import peak; import sys; print(peak(int(sys.argv[1])))"


def paint_library(paints, members=MEMBERS, bands=BANDS):
    """Return a library whose members are made block by block, as they would come from a store."""
    import dask.array as da
    import xarray as xr

    def block(block_info=None):
        rng = np.random.default_rng(block_info[None]["chunk-location"][0])
        return rng.uniform(0.02, 0.95, block_info[None]["chunk-shape"]).astype(np.float32)

    step = min(paints, 10)
    chunks = ((step,) * (paints // step), (members,), (bands,))
    values = da.map_blocks(block, chunks=chunks, dtype=np.float32, meta=np.empty((0, 0, 0), np.float32))
    centre = np.full((paints, bands), 0.5, np.float32)
    return xr.Dataset(
        {
            "member_reflectance": (("signature", "member", "band"), values, {"units": "1"}),
            "reflectance": (("signature", "band"), centre, {"units": "1"}),
        },
        {
            "signature": [f"Türkis {number}, matt" for number in range(paints)],
            "wavelength": ("band", wavelengths(bands), {"units": "nm"}),
        },
    )


def peak(paints):
    """Return the most memory this process ever had after writing a library [byte]."""
    from hyperpaint.io.dirsig import write_dirsig

    out = scratch() / "peak"
    write_dirsig(paint_library(paints), out)
    shutil.rmtree(out)
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


class WriteDirsig:
    """A thousand paints of 200 members are a gigabyte of text; formatted one by one, half a minute."""

    params = (cases(10, 100, 1000),)
    param_names = ("paints",)
    timeout = 600
    number, repeat, warmup_time = 1, 1, 0

    def setup(self, paints):
        self.out = scratch() / "dirsig"
        self.library = paint_library(paints)

    def teardown(self, paints):
        shutil.rmtree(self.out, ignore_errors=True)

    def time_write(self, paints):
        from hyperpaint.io.dirsig import write_dirsig

        write_dirsig(self.library, self.out, overwrite=True)

    def track_peak(self, paints):
        done = subprocess.run(
            [sys.executable, "-c", _ALONE, str(paints)], capture_output=True, text=True, check=True
        )
        return int(done.stdout)

    track_peak.unit = "byte"


class OneFile:
    """One paint of 200 members: text made at once, one value at a time, and read back."""

    def setup(self):
        from hyperpaint.io.dirsig.dirsig_files import ColumnText, emissivity_head

        self.values = np.random.default_rng(0).random((MEMBERS, BANDS))
        self.text = ColumnText(wavelengths(), "CURVE_BEGIN")
        self.path = scratch() / "one.ems"
        self.path.write_bytes(emissivity_head(MEMBERS) + self.text.text(self.values))

    def time_text(self):
        self.text.text(self.values)

    def time_text_one_by_one(self):
        nm = wavelengths() / 1000
        "".join("CURVE_BEGIN\n" + "".join(map("%.7f\t%.6f\n".__mod__, zip(nm, row))) for row in self.values)  # noqa: B905

    def time_read(self):
        from hyperpaint.io.dirsig import read_emissivity

        read_emissivity(self.path)
