"""`NUMERICS_VERSION` is raised when results change: numbers of `process` are held against those on record.

After a change that is meant, raise the version and record anew: ``python`` with the path of this file.
"""

import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

import hyperpaint as hp
from hyperpaint.base.constants import NUMERICS_VERSION

RECORD = Path(__file__).with_name("numerics.json")
INPUTS = ("counts", "irradiance", "radiance_gain", "dark_counts")
RESULTS = (
    *("reflectance", "quality", "irradiance_age", "overview", "diffuse_fraction", "diffuse_fraction_u"),
    *("sky_state", "wavelength_shift"),
)
#: Kernels compiled for another processor differ in the last place, which may turn one of the 12 kept bits.
TOLERANCE = 2.0**-11


def numbers_of(folder: Path) -> dict[str, list[float]]:
    # Process a small collect; return the mean and 16 samples of every variable
    collect = hp.simulate_collect(
        folder / "raw", scene="plan", seed=3, truth=False, lines=40, bands=12, columns=8
    )
    line = xr.open_zarr(hp.process(collect, folder / "lot.zarr"), group="flightlines/raw_0").load()
    numbers = {}
    for name in (*INPUTS, *RESULTS):
        plain = line[name].values.ravel().astype("f8")
        places = np.linspace(0, plain.size - 1, 16).astype(int)
        numbers[name] = [float(np.nanmean(plain)), *np.nan_to_num(plain[places]).tolist()]
    return numbers


def changed(names: tuple[str, ...], actual: dict[str, Any], recorded: dict[str, Any]) -> list[str]:
    return [
        name for name in names if not np.allclose(actual[name], recorded[name], rtol=TOLERANCE, atol=1e-9)
    ]


@pytest.mark.slow
def test_results_change_with_the_version_only(tmp_path: Path) -> None:
    record = json.loads(RECORD.read_text())
    assert record["version"] == NUMERICS_VERSION, f"record the numbers of the new version: python {__file__}"
    actual = numbers_of(tmp_path)
    assert not changed(INPUTS, actual, record["numbers"]), "the simulator changed, not the chain: record anew"
    assert not changed(RESULTS, actual, record["numbers"]), "raise NUMERICS_VERSION, and record anew"


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as scratch:
        document = {"version": NUMERICS_VERSION, "numbers": numbers_of(Path(scratch))}
    RECORD.write_text(json.dumps(document, indent=1) + "\n")
    sys.exit(0)
