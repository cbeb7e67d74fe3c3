"""A pedestal that drifts, from elements that see no light: plain numpy, a camera's truth, and chunks."""

from typing import Any

import numpy as np
import pytest
import xarray as xr

import hyperpaint as hp  # noqa: F401 (the accessor)
from hyperpaint.base.errors import PaintWarning
from hyperpaint.io.flightline.calibration_store import calibration_parts, check_calibration
from hyperpaint.simulation import simulate_line

# exact signals, which no converter rounds
pytestmark = pytest.mark.filterwarnings("ignore:.*counts-averaged")

COLUMNS, COVERED = 24, 4
CAMERA: dict[str, Any] = {"lines": 40, "bands": 60, "columns": COLUMNS, "masked_columns": COVERED, "seed": 4}
COVER = (np.arange(COLUMNS) < COVERED) | (np.arange(COLUMNS) >= COLUMNS - COVERED)


def declared(line: xr.Dataset, cover: np.ndarray = COVER, dims: Any = "cross_track") -> xr.Dataset:
    return line.assign(masked=(dims, cover))


def drifting(line: xr.Dataset, counts: float = 20.0) -> xr.Dataset:
    # Return the line with a pedestal that wanders by ``counts``, in whole counts where the line has them
    drift = counts * (1 + np.sin(np.linspace(0, 7, line.sizes["along_track"]))) / 2
    drift = drift.round() if line.counts.dtype.kind == "u" else drift
    raised = line.counts + xr.DataArray(drift, dims="along_track")
    return line.assign(counts=raised.astype(line.counts.dtype).assign_attrs(line.counts.attrs))


def test_a_drift_is_taken_out() -> None:
    line = simulate_line(**CAMERA, noise=False, quantise=False)
    expected = line.paint.reflectance().reflectance.values
    raised = drifting(line)
    lit = np.isfinite(expected) & (expected > 0.01)
    assert lit[:, :, ~COVER].mean() > 0.5
    off = raised.paint.reflectance().reflectance.values / expected - 1
    assert np.abs(off[lit]).max() > 0.01
    made = declared(raised).paint.reflectance().reflectance
    assert made.pedestal_applied.startswith("mean of the masked elements")
    assert np.abs(made.values / expected - 1)[lit].max() < 1e-3
    assert np.isnan(made.values[:, :, COVER]).all()


@pytest.mark.slow
def test_with_noise_means_are_right_and_the_noise_is_stated() -> None:
    errors = []
    for seed in range(6):
        camera = CAMERA | {"seed": seed}
        clean = simulate_line(**camera, noise=False, quantise=False).paint.reflectance().reflectance
        noisy = drifting(simulate_line(**camera, dark_noise=False))
        made = declared(noisy).paint.reflectance(uncertainty=True)
        lit = (clean.values > 0.01) & (made.quality.values == 0)[:, None, :]
        pull = ((made.reflectance - clean) / made.reflectance_u_random).values[lit]
        errors.append(((made.reflectance / clean - 1).values[lit].mean(), pull.std()))
    bias, spread = np.mean(errors, axis=0)
    assert abs(bias) < 1e-3
    assert 0.95 < spread < 1.05


def test_rows_and_elements_do_as_columns_do() -> None:
    line = drifting(simulate_line(**CAMERA, noise=False, quantise=False))
    by_column = declared(line).paint.radiance().radiance.values
    elements = np.broadcast_to(COVER, (60, COLUMNS)).copy()
    by_element = declared(line, elements, ("band", "cross_track")).paint.radiance().radiance.values
    assert by_element.tobytes() == by_column.tobytes()
    # rows of the array that no light reaches: all columns of two bands read the pedestal
    dark = line.dark_counts.values.reshape(-1, 60, COLUMNS).mean(axis=0)
    pedestal = (line.counts.values[:, 0, 0] - dark[0, 0])[:, None, None]
    counts = line.counts.values.copy()
    counts[:, :2] = dark[:2] + pedestal
    rows = line.assign(counts=line.counts.copy(data=counts))
    by_row = declared(rows, np.arange(60) < 2, "band").paint.radiance().radiance.values
    np.testing.assert_allclose(by_row[:, 2:], by_column[:, 2:], rtol=1e-4, atol=1e-7)
    assert np.isnan(by_row[:, :2]).all()
    square = rows.isel(cross_track=slice(0, 60), band=slice(0, COLUMNS))
    of_rows = declared(square, np.arange(COLUMNS) < 2, "band").paint.radiance().radiance.values
    assert np.isnan(of_rows[:, :2]).all()
    assert np.isfinite(of_rows[:, 2:, ~COVER]).any()


@pytest.mark.parametrize("attrs", [{}, {"linearity": [1e-5], "linearity_on": "raw"}], ids=["plain", "bent"])
def test_against_plain_numpy_and_chunks_change_no_bit(attrs: dict[str, Any]) -> None:
    line = declared(drifting(simulate_line(**CAMERA))).assign_attrs(attrs)
    products = [
        line.chunk(along_track=size).paint.reflectance(uncertainty=True).compute(scheduler="synchronous")
        for size in (1, 3, 7, 16, 40)
    ]
    for name in ("reflectance", "reflectance_u_random", "quality"):
        assert len({product[name].values.tobytes() for product in products}) == 1
    dark = line.dark_counts.values.reshape(-1, 60, COLUMNS).mean(axis=0).astype(float)
    raw = line.counts.values.astype(float)
    pedestal = (raw - dark)[:, :, COVER].mean(axis=(1, 2))[:, None, None]
    curve = (lambda c: c + 1e-5 * c**2) if attrs else (lambda c: c)
    net = curve(raw) - curve(dark + pedestal)
    exposure = np.broadcast_to(line.exposure_time.values, 40)[:, None, None]
    expected = net * line.radiance_gain.values / exposure
    made = line.paint.radiance().radiance.values
    seen = np.isfinite(made) & ~COVER
    np.testing.assert_allclose(made[seen], expected[seen], rtol=1e-4, atol=1e-4 * np.median(expected[seen]))


def test_a_cosmic_ray_in_the_mask_does_no_harm() -> None:
    line = declared(drifting(simulate_line(**CAMERA)))
    usual = line.paint.radiance().radiance.values
    counts = line.counts.values.copy()
    counts[5, 30, 1] += 3000
    struck = line.assign(counts=line.counts.copy(data=counts)).paint.radiance().radiance.values
    change = (struck / usual - 1)[5][usual[5] > np.nanmedian(usual)]
    assert np.nanmax(np.abs(change)) < 1e-4


def test_a_crop_without_masked_columns_is_noticed() -> None:
    line = declared(simulate_line(**CAMERA)).isel(cross_track=slice(6, 12))
    with pytest.warns(PaintWarning, match="masked-missing"):
        line.paint.radiance().compute()


def test_a_calibration_may_declare_it() -> None:
    line = declared(simulate_line(**CAMERA))
    names = ["radiance_gain", "masked"]
    calibration = line[names].assign_coords(wavelength=line.wavelength, fwhm=line.fwhm)
    checked = check_calibration(calibration.assign_attrs(srf_shape="gaussian"))
    np.testing.assert_array_equal(calibration_parts(checked, is_counts=True)["masked"], COVER)
