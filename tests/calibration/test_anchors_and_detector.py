"""Absolute anchors, dark, flat field, linearity and stray light on their own."""

import contextlib
from functools import partial

import numpy as np
import pytest
import xarray as xr
from support.refusals import expect_error, expect_refusals

import hyperpaint as hp
from hyperpaint.base.errors import PaintError, PaintWarning, SchemaError, UnitsError
from hyperpaint.calibration import (
    anchor_to_radiance,
    calibration_from_coefficients,
    dark_at,
    dark_model,
    etendue_from_optics,
    etendue_from_pupil,
    flat_field,
    linearity,
    panel_radiance,
)
from hyperpaint.calibration.calibration_dataset import MIN_REPORTED_ERROR, error_between_lines
from hyperpaint.calibration.detector import interpolate_nodes, monotone_slopes
from hyperpaint.io.flightline.side_files import open_calibration
from hyperpaint.radiometry.stray_light import Linearity
from hyperpaint.simulation import simulate_sweep

ELEMENT = ("band", "cross_track")


def test_etendue_from_both_sides() -> None:
    image = etendue_from_optics(2.5, 7.4e-6, 20e-6)
    assert image == pytest.approx(1.860e-11, rel=2e-4)
    assert etendue_from_pupil(12e-3 / 2.5, 7.4e-6 / 12e-3, 20e-6 / 12e-3) == pytest.approx(image, rel=1e-12)
    expect_refusals((SchemaError, "value-out-of-range", lambda: etendue_from_optics(2.5, 7.4, 20.0)))


@pytest.fixture(scope="module")
def sweep() -> xr.Dataset:
    return simulate_sweep(bands=136, columns=6, nonuniformity=0.02, smile_nm=1.5, noise=False, quantise=False)


def frames_of(sweep: xr.Dataset, radiance: xr.DataArray | float, exposure: float = 5e-3) -> xr.Dataset:
    dark = xr.full_like(sweep.true_radiance_gain, 100.0).astype("f8")
    counts = (dark + radiance * exposure / sweep.true_radiance_gain).fillna(100.0)
    return xr.Dataset(
        {
            "counts": counts.assign_attrs(units="count"),
            "dark_counts": dark.assign_attrs(units="count"),
            "exposure_time": xr.DataArray(exposure, attrs={"units": "s"}),
        }
    )


def spectrum(values: list[float], nm: list[float], units: str = "W m-2 sr-1 nm-1") -> xr.DataArray:
    return xr.DataArray(
        values,
        dims="wavelength",
        coords={"wavelength": ("wavelength", nm, {"units": "nm"})},
        attrs={"units": units},
    )


@pytest.mark.slow
def test_a_sphere_gives_every_element_its_gain(sweep: xr.Dataset) -> None:
    made = hp.calibrate(sweep)
    flat = spectrum([5.0, 5.0], [300.0, 1200.0], "uW cm-2 sr-1 nm-1")  # 0.05 in SI
    anchored = anchor_to_radiance(made, frames_of(sweep, 0.05), flat)
    known = np.isfinite(sweep.true_radiance_gain.values)
    np.testing.assert_allclose(
        anchored.radiance_gain.values[known], sweep.true_radiance_gain.values[known], rtol=1e-5
    )
    # a sloping spectrum is averaged over each column's own responses, smile and all
    slope = spectrum([0.02, 0.08], [300.0, 1200.0])
    level = 0.02 + 0.06 * ((sweep.true_wavelength + sweep.true_wavelength_shift) - 300.0) / 900.0
    error = (
        anchor_to_radiance(made, frames_of(sweep, level), slope).radiance_gain / sweep.true_radiance_gain - 1
    )
    assert float(np.abs(error).max()) < 4e-4


@pytest.mark.slow
def test_one_factor_leaves_the_shape_of_the_sweep(sweep: xr.Dataset) -> None:
    shape = hp.calibrate(sweep.drop_vars(["capture_fraction", "etendue"]), absolute=False)
    anchored = anchor_to_radiance(
        shape, frames_of(sweep, 0.05), spectrum([0.05, 0.05], [300.0, 1200.0]), scale="common"
    )
    ratio = anchored.radiance_gain / shape.radiance_gain
    assert float(ratio.std() / ratio.mean()) < 1e-6
    assert float(np.abs((anchored.radiance_gain / sweep.true_radiance_gain).median() - 1)) < 5e-3
    assert anchored.absolute_scale == "known"


def test_an_anchor_extrapolates_nothing_and_drops_what_is_saturated(sweep: xr.Dataset) -> None:
    made = hp.calibrate(sweep)
    part = anchor_to_radiance(made, frames_of(sweep, 0.05), spectrum([0.05, 0.05], [500.0, 800.0]))
    beyond = (made.wavelength < 490) | (made.wavelength > 810)
    assert np.isnan(part.radiance_gain.values[beyond.values]).all()
    assert not part.good.values[beyond.values].any()
    frames = frames_of(sweep, 0.05)
    frames["counts"][40, 3] = 1e5
    with pytest.warns(PaintWarning, match=r"1 elements.*elements-saturated") as caught:
        made = anchor_to_radiance(
            made, frames.assign(saturation_count=4095.0), spectrum([0.05, 0.05], [300.0, 1200.0])
        )
    assert caught[0].filename == __file__
    assert np.isnan(made.radiance_gain.values[40, 3])
    flat, beyond = (spectrum([1.0, 1.0], [first, 1200.0]) for first in (300.0, 1100.0))
    untimed, irradiance = frames.drop_vars("exposure_time"), flat.assign_attrs(units="W m-2 nm-1")
    expect_refusals(
        (SchemaError, "source-coverage", lambda: anchor_to_radiance(made, frames_of(sweep, 0.05), beyond)),
        (SchemaError, "variable-missing", "'exposure_time'", lambda: anchor_to_radiance(made, untimed, flat)),
        (UnitsError, "units-not-convertible", lambda: anchor_to_radiance(made, frames, irradiance)),
    )
    # frames of nearly equal exposures, and dims in another order
    several = frames_of(sweep, 0.05).expand_dims(along_track=2, axis=0)
    several["exposure_time"] = ("along_track", [5e-3, 5.00001e-3], {"units": "s"})
    several["dark_counts"] = several.dark_counts.isel(along_track=0)
    np.testing.assert_allclose(
        anchor_to_radiance(made.transpose("cross_track", ...), several, flat).radiance_gain,
        anchor_to_radiance(made, frames_of(sweep, 0.05), flat).radiance_gain,
        rtol=1e-5,
    )
    numbered = made.assign_coords(cross_track=np.arange(6))
    moved = frames.assign_coords(cross_track=np.arange(1, 7))
    for code, arguments in (
        ("grid-mismatch", (made, frames.isel(cross_track=slice(3)), flat)),
        ("grid-mismatch", (numbered, moved, flat)),
        ("wavelength-missing", (made, frames, flat.drop_vars("wavelength"))),
        ("value-out-of-range", (made, frames, (-flat).assign_attrs(flat.attrs))),
        ("value-out-of-range", (made, frames, flat.copy(data=[0.0, 0.0]))),
        ("type-wrong", (made, frames, flat.to_series())),
    ):
        expect_refusals((SchemaError, code, partial(anchor_to_radiance, *arguments)))
    expect_refusals(
        *(
            (SchemaError, "value-out-of-range", call)
            for wrong in (2.0, -0.02)
            for call in (
                partial(anchor_to_radiance, made, frames, flat, uncertainty=wrong),
                partial(hp.calibrate, sweep, flux_uncertainty=wrong),
            )
        )
    )


def test_a_panel_is_a_sphere_with_pi() -> None:
    lit = xr.DataArray([1.3], dims="irradiance_wavelength", attrs={"units": "W m-2 nm-1"})
    made = panel_radiance(lit, 0.40)
    assert (float(made[0]), made.units) == (pytest.approx(0.165521, rel=1e-5), "W m-2 sr-1 nm-1")
    expect_error(UnitsError, None, lambda: panel_radiance(lit.assign_attrs(units="W m-2 sr-1 nm-1"), 0.4))
    percent = xr.DataArray(40.0, attrs={"units": "%"})
    np.testing.assert_allclose(panel_radiance(lit, percent), made)
    here, there = ({"irradiance_wavelength": [nm]} for nm in (500.0, 500.5))
    other = xr.DataArray([0.4], there, dims="irradiance_wavelength")
    expect_refusals(
        (SchemaError, "value-out-of-range", lambda: panel_radiance(lit, 95.0)),
        (SchemaError, "grid-mismatch", lambda: panel_radiance(lit.assign_coords(here), other)),
    )


def test_coefficients_of_a_vendor() -> None:
    gain = xr.DataArray(
        [[1e-6, 0.0], [2e-6, np.nan]], dims=ELEMENT, attrs={"units": "W m-2 sr-1 nm-1 s count-1"}
    )
    nm = {"units": "nm"}
    axis = xr.DataArray([500.0, 502.0], dims="band", attrs=nm)
    width = xr.DataArray([6.0, 6.0], dims="band", attrs=nm)
    made = calibration_from_coefficients(gain, axis, width, srf_shape="slit")
    np.testing.assert_allclose(made.radiance_gain, [[1e-6, np.nan], [2e-6, np.nan]], rtol=1e-6)
    assert made.radiance_gain.dtype == np.float32
    assert open_calibration(made).srf_shape == "slit"
    timeless, counts = (gain.assign_attrs(units=units) for units in ("W m-2 sr-1 nm-1 count-1", "count"))
    expect_refusals(
        (SchemaError, "exposure-missing", lambda: calibration_from_coefficients(timeless, axis, width)),
        (UnitsError, "units-not-convertible", lambda: calibration_from_coefficients(counts, axis, width)),
    )
    xr.testing.assert_identical(
        calibration_from_coefficients(gain, axis.rename(band="wavelength").values, 6, srf_shape="slit"), made
    )
    for code, arguments, options in (
        ("wavelength-range", ([500.0, np.nan], width), {}),
        ("units-missing", (xr.DataArray(axis.values), width), {}),
        ("value-out-of-range", (axis, 0.0), {}),
        ("length-mismatch", (axis[:1], width), {}),
        ("choice-unknown", (axis, width), {"srf_shape": "triangle"}),
        ("value-out-of-range", (axis, width), {"uncertainty": 5.0}),
    ):
        expect_refusals(
            (PaintError, code, partial(calibration_from_coefficients, gain, *arguments, **options))
        )
    expect_refusals((SchemaError, "dims-wrong", lambda: calibration_from_coefficients(gain.values, axis, 6)))


def dark(seconds: float, bias: float = 100.0, rate: float = 50.0) -> xr.Dataset:
    return xr.Dataset(
        {
            "dark_counts": (ELEMENT, np.full((2, 3), bias + rate * seconds), {"units": "count"}),
            "dark_exposure_time": ((), seconds * 1e3, {"units": "ms"}),
        }
    )


def test_dark_is_bias_plus_rate_times_exposure() -> None:
    model = dark_model([dark(0.01), dark(0.02), dark(0.05)])
    np.testing.assert_allclose(model.dark_bias, 100.0, rtol=1e-6)
    np.testing.assert_allclose(model.dark_rate, 50.0, rtol=1e-5)
    np.testing.assert_allclose(dark_at(model, 1.0), 150.0, rtol=1e-6)
    assert abs(model.dark_drift_count) < 1e-9
    drifting = dark_model([dark(0.01), dark(0.05), dark(0.01, bias=103.0), dark(0.05, bias=103.0)])
    assert drifting.dark_drift_count == pytest.approx(3.0, abs=0.01)
    narrow = dark(0.02).isel(band=[0])
    expect_refusals(
        (SchemaError, "dark-exposures-few", lambda: dark_model([dark(0.01), dark(0.01)])),
        (SchemaError, "grid-mismatch", "shapes", lambda: dark_model([dark(0.01), narrow])),
        (SchemaError, "empty-input", lambda: dark_model([])),
        (SchemaError, "type-wrong", lambda: dark_model([narrow.dark_counts])),
        (SchemaError, "variable-missing", lambda: dark_at(narrow, 0.02)),
    )


def test_flat_fields_of_sphere_and_scene() -> None:
    rng = np.random.default_rng(0)
    response = 1 + 0.05 * rng.standard_normal((4, 30))
    ground = rng.uniform(0.5, 1.5, (400, 1, 1)) * [[[800.0]], [[900.0]]][0]
    scene = xr.DataArray(ground * response + 100, dims=("along_track", *ELEMENT))
    offset = xr.full_like(scene.isel(along_track=0), 100.0)
    made = flat_field(scene, offset)
    level = (made * response).values
    np.testing.assert_allclose(level / level.mean(axis=1, keepdims=True), 1.0, atol=1e-6)
    lazy = flat_field(scene.chunk(along_track=50), offset)
    np.testing.assert_allclose(lazy, made)
    assert lazy.chunks is not None
    for dark in (100, offset.values, xr.full_like(scene, 100.0)):
        np.testing.assert_array_equal(flat_field(scene, dark), made)
    columns = [xr.DataArray(np.arange(30) + first, dims="cross_track") for first in (0, 2)]
    numbered, other = (
        scene.assign_coords(cross_track=columns[0]),
        offset.assign_coords(cross_track=columns[1]),
    )
    expect_refusals(
        (SchemaError, "dims-wrong", lambda: flat_field(scene.rename(band="b"))),
        (SchemaError, "dims-wrong", lambda: flat_field(scene.values)),
        (SchemaError, "dims-wrong", lambda: flat_field(scene.to_dataset(name="counts"))),
        (SchemaError, "grid-mismatch", lambda: flat_field(numbered, other)),
        (SchemaError, "grid-mismatch", lambda: flat_field(scene, offset[:, :7])),
    )


def test_linearity_is_the_identity_by_default_and_closes() -> None:
    counts = np.arange(5.0)
    assert Linearity().net(counts, 0.0).tobytes() == counts.tobytes()
    light = np.linspace(0.05, 1.0, 20)
    measured = 4000 * light - 0.03 * 4000 * light**2
    straight = Linearity(linearity(light, measured)).net(measured, 0.0) / light
    assert np.ptp(straight) / straight.mean() < 1e-3
    sweep = simulate_sweep(columns=3, noise=False, quantise=False, nonuniformity=0, nonlinearity=0.03)
    full = float(sweep.saturation_count)
    signal = np.linspace(0.02, 1.0, 30)
    inverse = linearity(signal, full * signal * (1 - 0.03 * signal))
    errors = [
        np.nanmax(np.abs(made.radiance_gain / sweep.true_radiance_gain - 1)[10:-10])
        for made in (hp.calibrate(sweep), hp.calibrate(sweep, linearity=inverse))
    ]
    np.testing.assert_array_less([5e-3, errors[1]], [errors[0], 1e-3])
    expect_refusals((SchemaError, "signals-too-few", lambda: linearity([1.0], [1.0])))


def test_linearity_leaves_full_counts_out() -> None:
    light = np.linspace(0.05, 1.0, 20)
    measured = 4000 * light - 0.03 * 4000 * light**2
    with pytest.warns(PaintWarning, match="elements-saturated"):
        made = linearity(light, np.minimum(measured, 3000.0), degree=2.0)
    assert made == pytest.approx(linearity(light[:15], measured[:15], degree=2))
    holes = [np.where(np.arange(20) == 3, value, measured) for value in (np.nan, 0.0)]
    full = np.full(20, 4095.0)
    with pytest.warns(PaintWarning, match="elements-saturated"):
        expect_refusals((SchemaError, "signals-too-few", lambda: linearity(light, full)))
    expect_refusals(
        *((SchemaError, "value-out-of-range", "number 3", lambda h=h: linearity(light, h)) for h in holes)
    )


def test_interpolation_is_exact_for_smooth_and_calm_at_steps() -> None:
    x = np.linspace(400, 1000, 61)
    at = np.linspace(405, 995, 500)[:, None]
    smooth = np.exp(-0.5 * ((x - 603.0) / 90.0) ** 2)[:, None]
    made, _ = interpolate_nodes(x, smooth, np.ones_like(smooth, bool), at)
    assert np.abs(made - np.exp(-0.5 * ((at - 603.0) / 90.0) ** 2)).max() < 1e-4
    edge = np.where(x > 650, 1.0, 0.1)[:, None]
    made, _ = interpolate_nodes(x, edge, np.ones_like(edge, bool), at)
    assert made.min() >= 0.1 - 1e-12
    assert made.max() <= 1.0 + 1e-12
    assert (monotone_slopes(x, edge) >= 0).all()
    beyond, known = interpolate_nodes(
        x, smooth, np.ones_like(smooth, bool), np.array([[399.9], [1000.1], [400.0]])
    )
    np.testing.assert_array_equal(known.ravel(), [False, False, True])
    assert np.isnan(beyond[:2]).all()


# --- Fringes that the steps of a sweep miss, and ripples that they follow


STEPS = np.arange(400.0, 1001.0, 10.0)
VARIANCE = np.full(STEPS.size, 2.0**2 / (8 * np.log(2)))
FINE = np.arange(430.0, 970.0, 0.5)


def fringed(nm: np.ndarray, period: float, phase: float = 0.7) -> np.ndarray:
    # Return the logarithm of a responsivity with fringes of 5 %
    return np.log1p(0.05 * np.cos(2 * np.pi * nm / period + phase)) - ((nm - 620.0) / 300.0) ** 2


def slope_of(nm: np.ndarray, period: float) -> np.ndarray:
    return (fringed(nm + 0.01, period) - fringed(nm - 0.01, period)) / 0.02


def stated(period: float) -> float:
    level, moved = np.exp(fringed(STEPS, period)), VARIANCE * slope_of(STEPS, period)
    noise = 2e-4 * np.random.default_rng(6).standard_normal(STEPS.size)
    between = error_between_lines(STEPS, level, moved + noise, VARIANCE)
    assert between is not None
    return between[0]


def largest_error(period: float) -> float:
    used = np.ones((STEPS.size, 1), bool)
    values, _ = interpolate_nodes(STEPS, fringed(STEPS, period)[:, None], used, FINE[:, None])
    return float(np.abs(np.expm1(values[:, 0] - fringed(FINE, period))).max())


@pytest.mark.parametrize("period", [6.0, 7.0, 8.0, 12.0, 15.0])
def test_fringes_that_steps_miss_are_stated_within_a_factor_of_two(period: float) -> None:
    assert 0.5 < stated(period) / largest_error(period) < 2.0


@pytest.mark.parametrize("period", [60.0, 90.0])
def test_ripples_that_steps_follow_are_none(period: float) -> None:
    assert stated(period) < MIN_REPORTED_ERROR


def test_a_sweep_of_too_few_lines_says_nothing() -> None:
    assert error_between_lines(STEPS[:10], np.ones(10), np.zeros(10), VARIANCE[:10]) is None


@pytest.mark.parametrize("depth", [0.05, 0.015, 0.007])
def test_calibrate_warns_and_is_as_unsure(depth: float) -> None:
    sweep = simulate_sweep(columns=8, bands=136, seed=21, nonuniformity=0.0)
    fringe = 1 + depth * np.cos(2 * np.pi * sweep.step_wavelength / 8.0)
    sweep["counts"] = ((sweep.counts - sweep.dark_counts) * fringe + sweep.dark_counts).transpose(
        *sweep.counts.dims
    ).assign_attrs(sweep.counts.attrs)  # fmt: skip
    # an error below 1 % is not reported
    expected = pytest.warns(PaintWarning, match=r"10 nm.*steps-too-coarse")
    with expected if depth > 0.01 else contextlib.nullcontext():
        calibration = hp.calibrate(sweep)
    size = calibration.attrs["gain_between_lines"]
    wrong = np.abs(calibration.radiance_gain / sweep.true_radiance_gain - 1)[10:-10]
    assert 0.5 < size / float(wrong.max()) < 2.0
    assert (float(calibration.radiance_gain_u_systematic.min()) >= size) or depth < 0.01
