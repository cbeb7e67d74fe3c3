"""Darks of a real camera at six exposures: what bias and rate of some of them say of the others."""

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from support.refusals import expect_error
from support.strategies import labelled

import hyperpaint as hp
from hyperpaint.base.errors import PaintWarning, SchemaError

pytestmark = pytest.mark.real_data

EXPOSURES_MS = (20, 30, 35, 40, 45, 55)


@pytest.fixture(scope="module")
def darks(shared_data: Path) -> dict[int, np.ndarray]:
    # Return dark counts of every exposure [ms], each (band,)
    pytest.importorskip("h5netcdf", reason="the darks are netCDF, which h5netcdf reads")
    folder = shared_data / "dark_exposures"
    return {
        ms: xr.open_dataset(folder / f"calibration_vnir_{ms}ms.nc")["xps_img_drk"].values.astype(np.float64)
        for ms in EXPOSURES_MS
    }


def left(darks: dict[int, np.ndarray], of: int, by: tuple[int, ...]) -> np.ndarray:
    # Return what radiance leaves of a dark frame [count], by darks of other exposures (band,)
    several = np.stack([darks[ms] for ms in by])[..., None].astype(np.float32)
    line = labelled(
        {
            "counts": (("along_track", "band", "cross_track"), darks[of][None, :, None].astype(np.float32)),
            "dark_counts": (("dark_time", "band", "cross_track"), several),
            "dark_exposure_time": (("dark_time",), np.array(by) / 1e3),
            "radiance_gain": (("band", "cross_track"), np.ones((darks[of].size, 1), np.float32)),
            "exposure_time": ((), of / 1e3),
            "saturation_count": ((), np.float32(65535)),
        }
    )  # fmt: skip
    return hp.radiance(line).radiance.values.ravel() * of / 1e3


def rms(values: np.ndarray) -> float:
    return float(np.sqrt((values**2).mean()))


def test_bias_and_rate_fit_all_of_them(darks: dict[int, np.ndarray]) -> None:
    rest = [left(darks, ms, tuple(set(EXPOSURES_MS) - {ms})) for ms in (30, 35, 40, 45)]
    assert rms(np.concatenate(rest)) < 0.45
    design = np.stack([np.ones(6), np.array(EXPOSURES_MS)], axis=1)
    measured = np.stack([darks[ms] for ms in EXPOSURES_MS])
    fit = design @ np.linalg.lstsq(design, measured, rcond=None)[0]
    assert rms(measured - fit) < 0.30  # as SOURCES.md has it
    # two darks around an exposure
    inside = [
        left(darks, of, (low, high))
        for low, high in combinations(EXPOSURES_MS, 2)
        for of in EXPOSURES_MS
        if low < of < high
    ]
    assert 0.2 < rms(np.concatenate(inside)) < 0.6


def test_the_farther_from_the_darks_the_worse_and_it_is_said(darks: dict[int, np.ndarray]) -> None:
    near = rms(left(darks, 40, (30, 35)))  # a width away
    with pytest.warns(PaintWarning, match=r"55 ms, 4\.0 .*dark-exposure-differs"):
        far = rms(left(darks, 55, (30, 35)))
    assert 0.4 < near < 1.0
    assert far > 1.5 * near
    scaled = darks[30] * 55.0 / 30.0 - darks[55]  # what scaling the whole dark would leave
    assert rms(scaled) > 10.0 * far
    expect_error(SchemaError, "dark-exposure-differs", lambda: left({**darks, 200: darks[55]}, 200, (30, 35)))
