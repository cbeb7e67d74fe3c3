"""End to end: a flight calibrated by the sweep of its own camera, against the truth of the scene."""

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from support.codecs import plain_zarr

import hyperpaint as hp
from hyperpaint.simulation import simulate_collect, simulate_sweep


@pytest.mark.parametrize("shape", ["gaussian", "slit"])
@pytest.mark.slow
def test_oxygen_window_from_a_calibrated_sweep(tmp_path: Path, shape: str) -> None:
    camera = {"columns": 16, "srf_shape": shape, "smile_nm": 0.5, "nonuniformity": 0, "seed": 3}
    path = simulate_collect(tmp_path / "c", scene="plan", lines=64, **camera)
    sweep = simulate_sweep(monochromator_fwhm_nm=3.0, **camera)
    told = [name for name in sweep.variables if str(name).startswith("true_")]
    plain_zarr(sweep.drop_vars(told), tmp_path / "c" / "lab.zarr")
    path.write_text(path.read_text().replace('path = "calibration.zarr"', 'sweep = "lab.zarr"'))
    line = hp.open_collect(path)["flightlines/raw_0"].to_dataset()
    assert line.srf_shape == shape
    found = line.paint.reflectance()
    truth = xr.open_zarr(path.parent / "truth.zarr", consolidated=False).reflectance
    ok = (found.quality == 0).values[:, None, :]
    ratio = np.where(ok, found.reflectance.values / truth.values[: found.sizes["along_track"]], np.nan)
    nm = found.wavelength.values
    usual = (nm > 420) & (nm < 930)
    # the mean over the lines leaves what is not noise
    error = np.nanmean(ratio[:, usual], axis=(0, 2)) - 1
    window = (nm[usual] > 750) & (nm[usual] < 780)
    np.testing.assert_array_less([np.abs(error[window]).max(), np.abs(error).max()], [0.01, 0.015])
