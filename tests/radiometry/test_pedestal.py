"""A pedestal that drifts, from elements that see no light: plain numpy, a camera's truth, and chunks."""

import functools
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.refusals import expect_errors

import hyperpaint as hp  # noqa: F401 (the accessor)
from hyperpaint.base.errors import PaintWarning, SchemaError
from hyperpaint.io.flightline.side_files import calibration_parts, check_calibration
from hyperpaint.radiometry import mean_uncertainty
from hyperpaint.simulation import simulate_line

# exact signals, which no converter rounds
pytestmark = pytest.mark.filterwarnings("ignore:.*counts-averaged")

COLUMNS, COVERED = 24, 4
CAMERA: dict[str, Any] = {"lines": 40, "bands": 60, "columns": COLUMNS, "masked_columns": COVERED, "seed": 4}
COVER = (np.arange(COLUMNS) < COVERED) | (np.arange(COLUMNS) >= COLUMNS - COVERED)


def declared(line: xr.Dataset, cover: np.ndarray = COVER, dims: Any = "cross_track") -> xr.Dataset:
    return line.assign(masked=(dims, cover))


@functools.cache
def flown(is_exact: bool = False) -> xr.Dataset:
    return simulate_line(**CAMERA, noise=not is_exact, quantise=not is_exact)


def test_a_calibration_may_declare_it_and_a_crop_without_masked_columns_is_noticed() -> None:
    line = declared(flown())
    calibration = line[["radiance_gain", "masked"]].assign_coords(wavelength=line.wavelength, fwhm=line.fwhm)
    checked = check_calibration(calibration.assign_attrs(srf_shape="gaussian"))
    np.testing.assert_array_equal(calibration_parts(checked, is_counts=True)["masked"], COVER)
    with pytest.warns(PaintWarning, match="masked-missing"):
        line.isel(cross_track=slice(6, 12)).paint.radiance().compute()


def drifting(line: xr.Dataset, counts: float = 20.0) -> xr.Dataset:
    # Return the line with a pedestal that wanders by ``counts``, in whole counts where the line has them
    drift = counts * (1 + np.sin(np.linspace(0, 7, line.sizes["along_track"]))) / 2
    drift = drift.round() if line.counts.dtype.kind == "u" else drift
    raised = line.counts + xr.DataArray(drift, dims="along_track")
    return line.assign(counts=raised.astype(line.counts.dtype).assign_attrs(line.counts.attrs))


def test_a_drift_is_taken_out() -> None:
    line = flown(is_exact=True)
    expected = line.paint.reflectance().reflectance.values
    raised = drifting(line)
    lit = np.isfinite(expected) & (expected > 0.01)
    assert lit[:, :, ~COVER].mean() > 0.5
    assert np.abs((raised.paint.reflectance().reflectance.values / expected - 1)[lit]).max() > 0.01
    made = declared(raised).paint.reflectance().reflectance
    assert made.pedestal_applied.startswith("mean of the masked elements")
    assert np.abs(made.values / expected - 1)[lit].max() < 1e-3
    assert np.isnan(made.values[:, :, COVER]).all()
    # and a cosmic ray in the mask does no harm
    line = declared(drifting(flown()))
    usual, counts = line.paint.radiance().radiance.values, line.counts.values.copy()
    counts[5, 30, 1] += 3000
    struck = line.assign(counts=line.counts.copy(data=counts)).paint.radiance().radiance.values
    assert np.nanmax(np.abs((struck / usual - 1)[5][usual[5] > np.nanmedian(usual)])) < 1e-4


@pytest.mark.slow
def test_with_noise_means_are_right_and_the_noise_is_stated() -> None:
    camera = CAMERA | {"lines": 240}
    clean = simulate_line(**camera, noise=False, quantise=False).paint.reflectance().reflectance
    made = declared(drifting(simulate_line(**camera, dark_noise=False))).paint.reflectance(uncertainty=True)
    lit = (clean.values > 0.01) & (made.quality.values == 0)[:, None, :]
    pull = ((made.reflectance - clean) / made.reflectance_u_random).values[lit]
    assert abs((made.reflectance / clean - 1).values[lit].mean()) < 1e-3
    assert 0.95 < pull.std() < 1.05


def test_rows_and_elements_do_as_columns_do() -> None:
    line = drifting(flown(is_exact=True))

    def radiance(line: xr.Dataset, cover: np.ndarray, dims: Any) -> np.ndarray:
        return declared(line, cover, dims).paint.radiance().radiance.values

    by_column = radiance(line, COVER, "cross_track")
    elements = np.broadcast_to(COVER, (60, COLUMNS)).copy()
    assert radiance(line, elements, ("band", "cross_track")).tobytes() == by_column.tobytes()
    # rows of the array that no light reaches: all columns of two bands read the pedestal
    dark = line.dark_counts.values.reshape(-1, 60, COLUMNS).mean(axis=0)
    counts = line.counts.values.copy()
    counts[:, :2] = dark[:2] + (line.counts.values[:, 0, 0] - dark[0, 0])[:, None, None]
    rows = line.assign(counts=line.counts.copy(data=counts))
    by_row = radiance(rows, np.arange(60) < 2, "band")
    np.testing.assert_allclose(by_row[:, 2:], by_column[:, 2:], rtol=1e-4, atol=1e-7)
    of_rows = radiance(rows.isel(band=slice(0, COLUMNS)), np.arange(COLUMNS) < 2, "band")
    assert np.isnan(by_row[:, :2]).all()
    assert np.isnan(of_rows[:, :2]).all()
    assert np.isfinite(of_rows[:, 2:, ~COVER]).any()


@pytest.mark.parametrize("attrs", [{}, {"linearity": [1e-5], "linearity_on": "raw"}], ids=["plain", "bent"])
def test_against_plain_numpy_and_chunks_change_no_bit(attrs: dict[str, Any]) -> None:
    line = declared(drifting(flown())).assign_attrs(attrs)
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
    expected = net * line.radiance_gain.values / np.broadcast_to(line.exposure_time.values, 40)[:, None, None]
    made = line.paint.radiance().radiance.values
    seen = np.isfinite(made) & ~COVER
    np.testing.assert_allclose(made[seen], expected[seen], rtol=1e-4, atol=1e-4 * np.median(expected[seen]))


L_SHAPE = COVER | (np.arange(60) < 5)[:, None]


def plain_pedestal(net: np.ndarray, order: str, statistic: str) -> np.ndarray:
    # Return the pedestals (line, band, column) of counts above dark, subtracted axis by axis
    mean_of = {"median": np.median, "mean": np.mean}[statistic]
    rest = net
    for axis in order.split(", "):
        covered = rest[:, :, COVER] if axis == "band" else rest[:, :5]
        rest = rest - mean_of(covered, axis=2 if axis == "band" else 1, keepdims=True)
    return net - rest


@pytest.mark.parametrize("order", ["band", "column", "band, column", "column, band"])
@pytest.mark.parametrize("statistic", ["median", "mean"])
def test_pedestals_of_bands_and_columns_against_plain_numpy(order: str, statistic: str) -> None:
    line, rng = declared(flown(is_exact=True), L_SHAPE, ("band", "cross_track")), np.random.default_rng(1)
    offset = rng.normal(0, 20, (40, 60, 1)) + rng.normal(0, 20, (40, 1, COLUMNS))
    line = line.assign(counts=line.counts.copy(data=(line.counts.values + offset).astype("f4")))
    made = line.assign_attrs(pedestal=order, pedestal_statistic=statistic)
    dark = line.dark_counts.values.reshape(-1, 60, COLUMNS).mean(axis=0).astype(float)
    net = line.counts.values - dark
    scale = line.radiance_gain.values / np.broadcast_to(line.exposure_time.values, 40)[:, None, None]
    expected = ((net - plain_pedestal(net, order, statistic)) * scale)[:, ~L_SHAPE]
    radiance = made.paint.radiance().radiance
    assert f"{statistic} of the masked elements of each {order} of each line" in radiance.pedestal_applied
    lit = radiance.values[:, ~L_SHAPE]
    seen = np.isfinite(lit)  # not saturated
    assert seen.mean() > 0.9
    np.testing.assert_allclose(lit[seen], expected[seen], rtol=1e-6, atol=1e-6 * expected[seen].max())
    parts = made.chunk(along_track=7).paint.radiance().radiance.values
    assert parts.tobytes() == radiance.values.tobytes()


@pytest.mark.parametrize(
    ("attrs", "masked", "code"),
    [
        ({"pedestal": "row"}, L_SHAPE, "choice-unknown"),
        ({"pedestal_statistic": "mode"}, L_SHAPE, "choice-unknown"),
        ({"pedestal": "band"}, L_SHAPE & ~COVER, "masked-few"),
        ({"pedestal": "band, column"}, np.broadcast_to(COVER, L_SHAPE.shape), "masked-few"),
    ],
)
def test_impossible_pedestals_are_refused(attrs: dict[str, Any], masked: np.ndarray, code: str) -> None:
    line = declared(flown(), masked, ("band", "cross_track")).assign_attrs(attrs)
    expect_errors(
        (SchemaError, code, lambda: line.paint.radiance().compute()),
        (
            SchemaError,
            "variable-missing",
            lambda: line.assign_attrs(pedestal="band").drop_vars("masked").paint.radiance(),
        ),
    )


def test_noise_of_few_elements_and_errors_of_a_mean() -> None:
    line = declared(flown(), L_SHAPE, ("band", "cross_track"))
    whole, parts = (
        line.assign_attrs(pedestal=order, pedestal_statistic="median").paint.reflectance(uncertainty=True)
        for order in ("line", "band, column")
    )
    whole, parts = (each.reflectance_u_systematic for each in (whole, parts))
    assert parts.masked_elements == pytest.approx(2 / np.pi / (1 / (2 * COVERED) + 1 / 5))
    assert bool((parts > whole).where(whole > 0, True).all())
    # errors of a mean know the pedestal of the whole line
    part = (
        line.assign_attrs(pedestal="band")
        .paint.reflectance(uncertainty=True)
        .isel(cross_track=slice(8, 14))
        .compute()
    )
    assert "reflectance_errors" in mean_uncertainty(part)
