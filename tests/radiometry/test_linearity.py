"""The detector's curve, undone in flight: against plain numpy, and closed on a camera that bends."""

import functools
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.refusals import expect_error
from support.slab_arguments import calibrate, oracle, problem

import hyperpaint as hp
from hyperpaint.base.errors import SchemaError
from hyperpaint.calibration import linearity
from hyperpaint.io.flightline.side_files import calibration_parts, check_calibration, scale_attrs
from hyperpaint.kernels.arguments import SlabOutputs
from hyperpaint.radiometry.stray_light import Linearity
from hyperpaint.simulation import simulate_line, simulate_sweep

# exact signals, which no converter rounds
pytestmark = pytest.mark.filterwarnings("ignore:.*counts-averaged")

FULL = 4095.0
TABLE = (np.array([0.0, 900.0, 2500.0, FULL]), np.array([0.0, 905.0, 2600.0, 4400.0]))
CURVES = {
    "polynomial": Linearity((2e-5, -1e-9, 5e-14, -2e-18)), "long": Linearity((2e-5, 0.0, 0.0, 0.0, 1e-18)),
    "table": Linearity((), *TABLE),
}  # fmt: skip


def curve_of(kind: str, on_raw: bool) -> Linearity:
    one = CURVES[kind]
    return Linearity(one.coefficients, one.measured, one.linear, on_raw)


@functools.cache
def clean_camera() -> tuple[xr.Dataset, xr.Dataset]:
    # Return the calibration of a camera that is linear, and a line of it
    return hp.calibrate(simulate_sweep(**CLEAN, seed=5)), simulate_line(lines=24, **CLEAN, seed=5)


@functools.cache
def small_line() -> xr.Dataset:
    return simulate_line(lines=12, bands=20, columns=9, smile_nm=1.0, seed=2)


@pytest.mark.parametrize("on_raw", [False, True], ids=["dark-subtracted", "raw"])
@pytest.mark.parametrize("kind", list(CURVES))
@pytest.mark.parametrize("smile", [0, 1, 2])
def test_kernel_against_plain_numpy(smile: int, kind: str, on_raw: bool) -> None:
    curve = curve_of(kind, on_raw)
    p = problem(np.uint16, smile=smile, darks=3, own_limit=True)
    expected, flags = oracle(p)
    i, w = p["dark_index"], p["dark_weight"][:, None, None].astype(float)
    dark = (1 - w) * p["dark"][i].astype(float) + w * p["dark"][i + 1].astype(float)
    raw = p["counts"].astype(float)
    with np.errstate(invalid="ignore", divide="ignore"):
        expected = expected * (curve.net(raw, dark) / (raw - dark))
    out = np.empty(p["counts"].shape, np.float32)
    quality = np.empty((out.shape[0], out.shape[2]), np.uint16)
    none = np.empty((0, 0, 0), np.float32)
    p["detector"] = curve.detector_model(FULL)
    calibrate(p, SlabOutputs(out, quality, none, none))
    far = np.isfinite(expected) & (np.abs(raw - dark) > 1.0)
    # tables are known at 8192 places: a kink between two of them is cut by some hundredths of a count
    np.testing.assert_allclose(out[far], expected[far], rtol=5e-6 if kind == "polynomial" else 2e-4)
    np.testing.assert_array_equal(np.isnan(out), np.isnan(expected))
    np.testing.assert_array_equal(quality, flags)


@pytest.mark.parametrize("kind", list(CURVES))
def test_chunks_change_no_bit(kind: str) -> None:
    line = declared(small_line(), CURVES[kind], on="raw")
    products = [
        line.chunk(along_track=size).paint.reflectance(uncertainty=True).compute(scheduler="synchronous")
        for size in (1, 2, 5, 7, 12)
    ]
    for name in ("reflectance", "reflectance_u_random", "reflectance_u_systematic", "quality"):
        assert len({product[name].values.tobytes() for product in products}) == 1


def declared(line: xr.Dataset, curve: Linearity, on: str) -> xr.Dataset:
    # Return the line of a calibration that declares a curve
    if curve.measured is None:
        return line.assign_attrs(linearity=list(curve.coefficients), linearity_on=on)
    units = {"units": "count"}
    table = {"linear_counts": ("linearity_counts", curve.linear, units)}
    made = line.assign(table).assign_coords(linearity_counts=("linearity_counts", curve.measured, units))
    return made.assign_attrs(linearity="table", linearity_on=on)


def bent(line: xr.Dataset, loss: float) -> xr.Dataset:
    # Return the line as a camera reads it that loses ``loss`` of a signal that would fill the converter
    dark = line.dark_counts.mean("dark_time") if "dark_time" in line.dark_counts.dims else line.dark_counts
    signal = (line.counts.astype(np.float64) - dark).compute()
    full = float(line.saturation_count)
    counts = (dark + signal - loss * signal**2 / full).transpose(*line.counts.dims).astype(np.float32)
    return line.assign(counts=counts.assign_attrs(line.counts.attrs))


CLEAN: dict[str, Any] = {"noise": False, "quantise": False, "nonuniformity": 0.0, "columns": 8, "bands": 136}


@pytest.mark.parametrize("loss", [0.01, 0.05])
@pytest.mark.slow
def test_a_bent_camera_closes_by_its_own_sweep(loss: float) -> None:
    sweep, (straight, line) = simulate_sweep(**CLEAN, nonlinearity=loss, seed=5), clean_camera()
    light = np.linspace(0.02, 1.0, 40)
    curve = linearity(light, float(sweep.saturation_count) * light * (1.0 - loss * light), degree=5)
    calibration = hp.calibrate(sweep, linearity=curve)
    assert calibration.linearity_on == "dark-subtracted"
    ratio = (calibration.radiance_gain / straight.radiance_gain).values
    expected = line.paint.reflectance().reflectance.values
    gain = (line.radiance_gain * ratio).assign_attrs(line.radiance_gain.attrs)
    camera, bright = bent(line, loss).assign(radiance_gain=gain), line.counts.values > 100
    wrong = camera.paint.reflectance().reflectance.values / expected - 1
    assert np.nanmax(np.abs(wrong[bright])) > 0.2 * loss
    made = camera.assign_attrs(linearity=calibration.linearity, linearity_on="dark-subtracted")
    closed = made.paint.reflectance().reflectance
    assert closed.linearity_applied == "polynomial of degree 5 on dark-subtracted counts"
    assert np.nanmax(np.abs(closed.values / expected - 1)[bright]) < 1e-3


@pytest.mark.parametrize("on", ["raw", "dark-subtracted"])
def test_a_calibration_travels_with_its_curve(on: str) -> None:
    axis = {"linearity_counts": ("linearity_counts", TABLE[0], {"units": "count"})}
    table = xr.DataArray(TABLE[1], axis, "linearity_counts", attrs={"units": "count"})
    sweep = simulate_sweep(**CLEAN | {"columns": 4, "bands": 136}, steps=31)
    made = hp.calibrate(sweep, linearity=table, linearity_on=on, linearity_uncertainty=0.002)
    checked = check_calibration(made)
    assert (made.linearity, made.linearity_on, scale_attrs(checked)["linearity_on"]) == ("table", on, on)
    assert float(made.linearity_u) == pytest.approx(0.002)
    parts = calibration_parts(checked, is_counts=True)
    np.testing.assert_array_equal(parts["linear_counts"].linearity_counts, TABLE[0])


def test_noise_grows_with_the_slope() -> None:
    line, coefficient = small_line(), 0.05 / FULL
    plain, made = (
        each.paint.reflectance(uncertainty=True).reflectance_u_random.values
        for each in (line, line.assign_attrs(linearity=[coefficient]))
    )
    slope = 1 + 2 * coefficient * (line.counts.values - line.dark_counts.values)
    np.testing.assert_allclose(made / plain, np.where(np.isnan(made / plain), np.nan, slope), rtol=2e-5)
    unsure = line.assign(linearity_u=((), 0.03, {"units": "1"})).paint.reflectance(uncertainty=True)
    assert "linearity_u" in unsure.reflectance_u_systematic.components


@pytest.mark.parametrize(
    ("attrs", "problem"),
    [
        ({"linearity": [-1e-3]}, "linearity-not-monotonic"),
        ({"linearity": [1e-6], "linearity_on": "wells"}, "choice-unknown"),
        ({"linearity": [float("nan")]}, "linearity-invalid"),
    ],
)
def test_impossible_curves_are_refused(attrs: dict[str, Any], problem: str) -> None:
    expect_error(SchemaError, problem, lambda: small_line().assign_attrs(attrs).paint.radiance().compute())


def of_elements(line: xr.Dataset, nodes: np.ndarray, on: str) -> xr.Dataset:
    # Return the line of a calibration whose elements have curves of their own
    rng, shape = np.random.default_rng(3), (2, line.sizes["band"], line.sizes["cross_track"])
    basis = np.stack([np.sqrt(np.abs(nodes)) / 64, (nodes / FULL) ** 2])
    weights = rng.normal(0, 0.02, shape).astype(np.float32)
    made = declared(line, Linearity((), nodes, nodes + 1e-5 * nodes**2), on)
    return made.assign(
        linearity_basis=(("linearity_term", "linearity_counts"), basis, {"units": "1"}),
        linearity_map=(("linearity_term", "band", "cross_track"), weights, {"units": "1"}),
    )


def plain_curve(line: xr.Dataset, counts: np.ndarray) -> np.ndarray:
    # Return linear counts (line, band, column) by numpy's interpolation in every term
    nodes = line.linearity_counts.values
    made = np.interp(counts, nodes, line.linear_counts.values)
    for basis, weights in zip(line.linearity_basis.values, line.linearity_map.values, strict=True):
        made = made + weights * np.interp(counts, nodes, nodes * basis)
    return made


@pytest.mark.parametrize("on", ["dark-subtracted", "raw"])
@pytest.mark.parametrize("nodes", [np.arange(4096.0), np.geomspace(1, 4097, 9) - 1], ids=["every", "few"])
def test_curves_of_elements_against_plain_numpy(nodes: np.ndarray, on: str) -> None:
    line = of_elements(small_line(), nodes, on)
    made = line.chunk(along_track=5).paint.reflectance(uncertainty=True).compute()
    plain = small_line().paint.reflectance(uncertainty=True).compute()
    dark = line.dark_counts.values.reshape(-1, 20, 9).mean(axis=0)
    raw = line.counts.values.astype(float)
    if on == "raw":
        net, slopes = (plain_curve(line, each) - plain_curve(line, dark) for each in (raw, raw + 1e-3))
    else:
        net, slopes = (plain_curve(line, each - dark) for each in (raw, raw + 1e-3))
    bright = np.isfinite(plain.reflectance.values) & (raw - dark > 50)
    # nodes that are not evenly spaced are resampled, so that kinks are cut by hundredths of a count
    within = 2e-6 if len(nodes) > 9 else 1e-4
    expected = (plain.reflectance.values * net / (raw - dark))[bright]
    np.testing.assert_allclose(made.reflectance.values[bright], expected, rtol=within)
    ratio = (made.reflectance_u_random / plain.reflectance_u_random).values[bright]
    np.testing.assert_allclose(ratio, ((slopes - net) / 1e-3)[bright], rtol=0.01)
    column = line.paint.reflectance().isel(cross_track=slice(4, 6)).reflectance.values
    np.testing.assert_array_equal(column, made.reflectance.values[:, :, 4:6])


@pytest.mark.parametrize(
    ("change", "code"),
    [
        (lambda line: line.drop_vars("linearity_map"), "variable-missing"),
        (lambda line: line.assign(linearity_map=line.linearity_map * np.nan), "linearity-invalid"),
        (lambda line: line.assign(linearity_map=line.linearity_map * 100), "linearity-not-monotonic"),
        (lambda line: line.assign(linearity_map=line.linearity_map.isel(band=0)), "dims-wrong"),
    ],
)
def test_impossible_curves_of_elements_are_refused(change: Any, code: str) -> None:
    with xr.set_options(keep_attrs=True), pytest.raises(SchemaError, match=code):
        change(of_elements(small_line(), np.arange(4096.0), "raw")).paint.radiance().compute()


def test_a_sweep_may_have_curves_of_elements() -> None:
    sweep = simulate_sweep(**CLEAN | {"columns": 4, "bands": 136}, steps=31)
    line = xr.Dataset(coords={"band": range(136), "cross_track": range(4)}).drop_vars(["band", "cross_track"])
    line = line.assign(blank=(("band", "cross_track"), np.zeros((136, 4))))
    curves = of_elements(line, np.arange(4096.0), "raw")
    made, plain = (hp.calibrate(sweep, linearity=curve) for curve in (curves, ()))
    parts = calibration_parts(check_calibration(made), is_counts=True)
    np.testing.assert_array_equal(parts["linearity_map"], curves.linearity_map)
    assert np.nanmax(np.abs(made.radiance_gain / plain.radiance_gain - 1)) > 1e-3
    expect_error(
        SchemaError, "length-mismatch", lambda: hp.calibrate(sweep, linearity=curves.isel(band=slice(9)))
    )
