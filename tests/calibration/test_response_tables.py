"""Responses that no line model is; sweep and flight are plain sums over a fine grid."""

from typing import Any

import numpy as np
import pytest
import xarray as xr

import hyperpaint as hp
from hyperpaint.base.errors import PaintWarning
from hyperpaint.simulation import simulate_sweep
from hyperpaint.simulation.atmosphere import Sky

GRID = np.arange(680.0, 850.0, 0.05)
BANDS = np.arange(710.0, 820.0, 2.22)
SHIFT = np.array([0.0, 0.3, 0.7])
CHANNELS = np.arange(690.0, 841.0)


def slit(offset: np.ndarray, tail: float = 0.0) -> np.ndarray:
    # Return a slit of 6 nm before pixels of 2.22 nm, with a tail of exp(-x / tail) to longer wavelengths
    x = np.arange(-30.0, 30.001, 0.01)
    response = np.clip(0.5 * (6.0 + 2.22) - np.abs(x), 0.0, 2.22)
    if tail:
        response = np.convolve(response, np.where(x >= 0, np.exp(-np.clip(x, 0, None) / tail), 0.0), "same")
    return np.interp(offset, x, response / (response.sum() * 0.01), 0.0, 0.0)


def camera(tail: float) -> np.ndarray:
    # Return the responses of all elements (band, column, grid)
    return slit(GRID - (BANDS[:, None] + SHIFT)[..., None], tail) * np.exp(-(((GRID - 650.0) / 260.0) ** 2))


def sweep_of(elements: np.ndarray, light_nm: float = 2.0) -> xr.Dataset:
    # Return a sweep of 2 nm lines: the frame of the simulator's, with counts that are sums over the grid
    size: dict[str, Any] = {"bands": BANDS.size, "columns": SHIFT.size, "steps": 19}
    sweep = simulate_sweep(
        **size, first_step_nm=705.0, last_step_nm=825.0, monochromator_fwhm_nm=light_nm,
        first_wavelength=BANDS[0], last_wavelength=BANDS[-1], noise=False, quantise=False, dark_pattern=0.0,
    )  # fmt: skip
    lines = np.exp(-4 * np.log(2) * ((GRID - sweep.step_wavelength.values[:, None]) / light_nm) ** 2)
    seen = np.einsum("bcg,kg->kbc", elements, lines / lines.sum(axis=1, keepdims=True))
    power = (sweep.flux * sweep.capture_fraction * sweep.exposure_time).broadcast_like(sweep.counts)
    counts = seen * power.transpose("step", "band", "cross_track").values
    counts *= 2500.0 / counts.max()
    noise = np.sqrt((counts / 20.0 + 0.25) / 50.0) * np.random.default_rng(5).standard_normal(counts.shape)
    sweep["counts"].values[...] = counts + noise + sweep.dark_counts.values
    sweep["counts_variance"].values[...] = counts / 20.0 + 0.25
    return sweep


def error_in_flight(elements: np.ndarray, calibration: xr.Dataset) -> float:
    # Return the largest relative error of reflectance from 745 to 785 nm
    light = sum(Sky(48.2).irradiance(GRID))
    surface = 0.3 + 0.1 * np.tanh((GRID - 760.0) / 60.0)
    seen, lit, area = (
        elements @ part for part in (surface * light / np.pi, light / np.pi, np.ones(GRID.size))
    )
    record = np.exp(-4 * np.log(2) * ((GRID - CHANNELS[:, None]) / 3.0) ** 2)
    record /= record.sum(axis=1, keepdims=True)
    start, wanted = np.datetime64("2021-07-20T17:00", "ns"), ("wavelength", "fwhm", "wavelength_shift")
    line = xr.Dataset(
        {
            "radiance": (("along_track", "band", "cross_track"), (seen / area)[None].astype("f4"), RADIANCE),
            "irradiance": (("irradiance_time", "irradiance_wavelength"), [record @ light] * 2, IRRADIANCE),
            "irradiance_fwhm": ((), 3.0, {"units": "nm"}),
            "radiance_gain": calibration["radiance_gain"],
        },
        {
            "time": ("along_track", [start]),
            "irradiance_time": ("irradiance_time", start + np.array([-1, 1], "timedelta64[s]")),
            "irradiance_wavelength": ("irradiance_wavelength", CHANNELS, {"units": "nm"}),
            **{
                name: calibration[name]
                for name in (*wanted, "band_spacing", "srf_offset")
                if name in calibration
            },
        },
        {"srf_shape": calibration.attrs["srf_shape"]},
    )
    if "srf" in calibration:
        line["srf"] = calibration["srf"]
    near = (BANDS > 745.0) & (BANDS < 785.0)
    return float(np.abs(hp.reflectance(line).reflectance.values[0] / (seen / lit) - 1)[near].max())


RADIANCE, IRRADIANCE = {"units": "W m-2 sr-1 nm-1"}, {"units": "W m-2 nm-1"}


@pytest.fixture(scope="module")
def lopsided() -> np.ndarray:
    return camera(tail=1.5)


def test_a_lopsided_slit_becomes_a_table_that_is_used(lopsided: np.ndarray) -> None:
    calibration = hp.calibrate(sweep_of(lopsided))
    assert (calibration.srf_shape, calibration.srf.dims) == ("tabulated", ("band", "srf_offset"))
    # the response itself, wherever its centre is taken to be
    offset = calibration.srf_offset.values
    seen = calibration.srf.values[20] / np.trapezoid(calibration.srf.values[20], offset)
    away = [np.linalg.norm(slit(offset + d, 1.5) - seen) for d in np.arange(0.0, 3.0, 0.05)]
    assert min(away) < 0.03 * np.linalg.norm(seen)
    assert error_in_flight(lopsided, calibration) < 0.003


def test_a_model_that_is_asked_for_warns_of_what_it_costs(lopsided: np.ndarray) -> None:
    with pytest.warns(PaintWarning, match=r"'gaussian'.*response-shape-misfit") as caught:
        calibration = hp.calibrate(sweep_of(lopsided), srf_shape="gaussian")
    assert (calibration.srf_shape, caught[0].filename) == ("gaussian", __file__)
    assert 0.5 < calibration.attrs["srf_model_effect"] / error_in_flight(lopsided, calibration) < 2.0


@pytest.mark.parametrize(("tail", "most"), [(0.0, 0.005), (0.4, 0.012), (0.5, 0.02)])
def test_a_slit_stays_a_slit(tail: float, most: float) -> None:
    # Up to a tail that changes the curve by 1.2 %
    calibration = hp.calibrate(sweep_of(camera(tail)))
    shape = "slit" if tail < 0.45 else "tabulated"
    assert (calibration.srf_shape, "srf" in calibration) == (shape, shape == "tabulated")
    assert calibration.attrs["srf_model_misfit"] < most
