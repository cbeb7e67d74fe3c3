"""What a physics review found to pass unseen: each of these once gave a wrong gain, or a wrong certainty."""

import contextlib
import functools
from collections.abc import Callable
from functools import partial
from typing import Any

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
    quantum_efficiency,
)
from hyperpaint.calibration.calibration_dataset import MIN_REPORTED_ERROR, error_between_lines
from hyperpaint.calibration.detector import fit_dark_model, interpolate_nodes, monotone_slopes
from hyperpaint.io.flightline.side_files import open_calibration, scale_attrs
from hyperpaint.radiometry.stray_light import Linearity
from hyperpaint.simulation import simulate_line, simulate_sweep

CLEAN = {"noise": False, "quantise": False}


@functools.lru_cache(maxsize=4)
def _sweep(effects: tuple[tuple[str, Any], ...]) -> xr.Dataset:
    return simulate_sweep(**dict(effects))


def sweep_of(**effects: Any) -> xr.Dataset:
    return _sweep(
        tuple(sorted({"columns": 12, "bands": 136, "nonuniformity": 0, "seed": 1, **effects}.items()))
    )


def with_values(sweep: xr.Dataset, name: str, values: Any) -> xr.Dataset:
    return sweep.assign({name: (sweep[name].dims, np.asarray(values), sweep[name].attrs)})


def error_of(made: xr.Dataset, sweep: xr.Dataset) -> np.ndarray:
    return (made.radiance_gain / sweep.true_radiance_gain - 1).values


def spread_of_z(made: xr.Dataset, sweep: xr.Dataset) -> float:
    return float(np.nanstd(error_of(made, sweep) / made.radiance_gain_u_random.values))


# --- dark


@pytest.mark.parametrize("drift", [2.0, -1.4])
def test_a_dark_that_is_off_moves_no_gain_and_is_told(drift: float) -> None:
    sweep = sweep_of(**CLEAN)
    off = with_values(sweep, "dark_counts", sweep.dark_counts.values + drift)
    with pytest.warns(PaintWarning, match="dark-offset") as caught:
        made = hp.calibrate(off)
    # an error of less than a count is none
    hp.calibrate(with_values(sweep, "dark_counts", sweep.dark_counts.values + drift / 2.7))
    assert (caught[0].filename, made.dark_offset_count) == (__file__, pytest.approx(-drift, abs=0.05))
    assert np.nanmax(np.abs(error_of(made, sweep))) < 1e-3
    # a count in every band outside of the line, over the line's area
    assert made.out_of_band_of_one_count == pytest.approx(
        abs(float(made.out_of_band.median()) / drift), rel=0.2
    )


def test_stray_light_is_not_taken_for_a_dark_that_is_off() -> None:
    assert abs(hp.calibrate(sweep_of(stray_light=0.02, **CLEAN)).dark_offset_count) < 0.2


def test_noise_of_the_dark_is_in_the_uncertainty() -> None:
    sweep = sweep_of(columns=20, dark_frames=1)
    made = hp.calibrate(sweep)
    assert 0.85 < spread_of_z(made, sweep) < 1.15
    assert float(made.radiance_gain_u_random.median()) > 1.4 * float(
        hp.calibrate(sweep_of(columns=20)).radiance_gain_u_random.median()
    )


@pytest.mark.parametrize("exposures", [(10.0, 10.02), (10.0, 11.0)])
def test_a_dark_rate_is_not_carried_far(exposures: tuple[float, float]) -> None:
    sweep = sweep_of(dark_exposure_ms=exposures, step_exposure_ms=50.0)
    expect_refusals((SchemaError, "dark-exposure-differs", "50 ms", lambda: hp.calibrate(sweep)))


def test_a_dark_model_reaches_as_far_as_it_is_known() -> None:
    rng = np.random.default_rng(0)
    model = fit_dark_model(100.0 + 2.0 * rng.standard_normal((8, 40, 50)), np.repeat([0.0499, 0.0501], 4))
    assert (model.spread, model.leverage(0.05)) == (pytest.approx(2.0, rel=0.05), pytest.approx(1 / 8))
    assert model.is_valid_at(0.05)
    assert not model.is_valid_at(0.055)  # to 70 counts


# --- elements


@pytest.mark.parametrize("seed", [1, 3])
def test_dead_elements_at_the_edge_spoil_no_neighbour(seed: int) -> None:
    sweep = sweep_of(bands=272, columns=20, bad_elements=200, seed=seed)
    made = hp.calibrate(sweep)
    assert np.nanmax(np.abs(error_of(made, sweep))) < 0.02
    dead = sweep.true_bad.transpose("band", "cross_track").values
    assert not np.isfinite(made.radiance_gain.values[dead]).any()


def test_one_dead_element_at_either_end() -> None:
    # One in every column
    sweep, dead = sweep_of(columns=6), ([0, 1, 2, 133, 134, 135], range(6))
    counts = sweep.counts.values.copy()
    counts[:, *dead] = sweep.dark_counts.values[dead]
    assert np.nanmax(np.abs(error_of(hp.calibrate(with_values(sweep, "counts", counts)), sweep))) < 0.02


@pytest.mark.parametrize("nonuniformity", [0.0, 0.005, 0.02])
def test_elements_that_differ_are_uncertain_by_as_much(nonuniformity: float) -> None:
    sweep = sweep_of(bands=272, columns=20, nonuniformity=nonuniformity)
    made = hp.calibrate(sweep)
    assert made.element_differences == pytest.approx(nonuniformity, rel=0.1, abs=3e-4)
    assert 0.8 < spread_of_z(made, sweep) < 1.15


@pytest.mark.parametrize("nonuniformity", [0.0, 0.01])
def test_noise_that_nobody_tells_is_found(nonuniformity: float) -> None:
    sweep = sweep_of(bands=272, columns=20, nonuniformity=nonuniformity)
    with pytest.warns(PaintWarning, match="noise-missing") as caught:
        made = hp.calibrate(sweep.drop_vars("counts_variance"))
    assert (caught[0].filename, "electrons_per_count" in made) == (__file__, False)
    assert 0.75 < spread_of_z(made, sweep) < 1.25
    assert made.electrons_per_count_source == "none"


# --- beam


@pytest.mark.slow
def test_a_beam_that_is_not_told_is_seen() -> None:
    wandering = {"columns": 24, "beam_fwhm_columns": 60.0, "beam_wander_columns": 6.0}
    with pytest.warns(PaintWarning, match="flux-profile-missing"):
        hp.calibrate(sweep_of(beam_recorded=False, **wandering))
    # neither elements that differ nor dead ones are a beam
    for effects in (wandering, {"columns": 24, "nonuniformity": 0.02}, {"columns": 24, "bad_elements": 60}):
        hp.calibrate(sweep_of(**effects))


def test_what_passes_as_an_even_beam_depends_on_the_flux() -> None:
    sweep = sweep_of(columns=24, beam_fwhm_columns=120.0, beam_recorded=False)  # 2.7 % at the ends
    hp.calibrate(sweep)
    with pytest.warns(PaintWarning, match=r"fall by 2.*flux-profile-missing"):
        hp.calibrate(sweep, flux_uncertainty=0.02)


def test_columns_without_light() -> None:
    sweep = sweep_of(columns=24, beam_fwhm_columns=8.0, smile_nm=1.5)
    flux = sweep.flux.values.copy()
    flux[flux < 0.01 * flux.max(axis=1, keepdims=True)] = 0.0
    with pytest.warns(PaintWarning, match=r"11 of 24 .*columns-unlit"):
        made = hp.calibrate(with_values(sweep, "flux", flux))
    first, last = made.lit_columns
    assert (first, last, np.isnan(made.radiance_gain.values[:, :first]).all()) == (6, 18, True)
    flat = xr.ones_like(sweep.true_radiance_gain).assign_attrs(units="1")
    with pytest.warns(PaintWarning, match="columns-unlit"):
        levelled = hp.calibrate(sweep, flat_field=flat)
    assert np.isnan(levelled.radiance_gain.values[:, last + 1 :]).all()
    anchored = anchor_to_radiance(made, frames_of(sweep), even_radiance())
    assert np.isnan(anchored.radiance_gain.values[:, :first]).all()
    assert np.isfinite(anchored.radiance_gain.values[50, first : last + 1]).all()
    flux[3, 12] = 0.0
    expect_refusals(
        (
            SchemaError,
            "flux-missing",
            "430 nm (1 of 13",
            lambda: hp.calibrate(with_values(sweep, "flux", flux)),
        )
    )
    flux[3] = 0.0
    expect_refusals(
        (
            SchemaError,
            "value-out-of-range",
            "'flux'",
            "1 of 61 steps",
            lambda: hp.calibrate(with_values(sweep, "flux", flux)),
        )
    )


# --- the door


def test_clipped_lines_without_a_saturation_count() -> None:
    sweep = sweep_of(bands=272, beam_power_w=6e-6)
    with pytest.warns(PaintWarning, match=r"4095.*saturation-missing") as caught:
        hp.calibrate(sweep.drop_vars("saturation_count"))
    assert caught[0].filename == __file__
    for whole in (sweep_of(bands=272), sweep_of(**CLEAN)):
        hp.calibrate(whole.drop_vars("saturation_count"))


@pytest.mark.filterwarnings("ignore::hyperpaint.base.errors.PaintWarning")
def test_lines_are_clipped_below_the_saturation_count() -> None:
    sweep = sweep_of(**CLEAN)
    full = 0.7 * float(sweep.counts.max())
    with pytest.warns(PaintWarning, match=rf"4095, but.*{full:g}.*saturation-missing"):
        hp.calibrate(changed(sweep, counts=sweep.counts.clip(max=full)))


@pytest.mark.parametrize("value", [np.nan, -3.0, np.inf])
def test_a_read_noise_that_is_none(value: float) -> None:
    noise = {"electrons_per_count": ((), 20.0, {"units": "electron count-1"}),
             "read_noise": ((), value, {"units": "count"})}  # fmt: skip
    expect_refusals(
        (
            SchemaError,
            "value-out-of-range",
            "'read_noise'",
            lambda: hp.calibrate(sweep_of().drop_vars("counts_variance").assign(noise)),
        )
    )


@pytest.mark.parametrize("shape", ["gaussian", "slit"])
def test_bands_too_far_apart_are_named_as_such(shape: str) -> None:
    sweep = sweep_of(bands=40, monochromator_fwhm_nm=0.5, srf_shape=shape, **CLEAN)
    expect_refusals((SchemaError, "lamp-lines-few", lambda: hp.calibrate(sweep)))


# --- stray light, wavelengths


def test_second_order_without_stray_light() -> None:
    made = hp.calibrate(sweep_of(second_order=0.05, **CLEAN))
    assert float(np.nanmedian(made.second_order)) == pytest.approx(0.05, rel=0.1)
    assert made.stray_light.dtype == np.float64


def test_stray_light_within_the_lines_is_taken_out_and_what_is_left_is_uncertainty() -> None:
    sweep = sweep_of(stray_light=0.05, **CLEAN)
    made = hp.calibrate(sweep, flux_uncertainty=0.0)
    bias = abs(np.nanmedian(error_of(made, sweep)[20:-20]))
    np.testing.assert_array_less([5e-3, bias], [made.stray_light_in_lines, 0.3 * made.stray_light_in_lines])
    assert bias < 2 * float(made.radiance_gain_u_systematic.median())
    assert hp.calibrate(sweep_of(**CLEAN)).stray_light_in_lines < 1e-4


def test_the_dial_is_in_the_uncertainty_of_wavelengths() -> None:
    sweep = sweep_of()
    assert float(hp.calibrate(sweep).wavelength_u) == pytest.approx(0.1, rel=0.01)
    made = hp.calibrate(sweep, wavelength_uncertainty=0.3)
    assert float(made.wavelength_u) == pytest.approx(np.hypot(0.3, made.wavelength_residual_nm))
    assert made.wavelength_uncertainty_nm == 0.3


def test_nothing_far_beyond_the_last_step() -> None:
    made = hp.calibrate(sweep_of(monochromator_jitter_nm=0.3, first_step_nm=450.0, steps=56))
    assert made.wavelength_residual_nm > 0.1
    there = (made.wavelength + made.wavelength_shift).transpose("band", "cross_track").values
    assert np.isnan(made.radiance_gain.values[there < 450.0 - 0.051]).all()


# --- after the calibration


def even_radiance() -> xr.DataArray:
    nm = xr.DataArray([300.0, 1200.0], dims="wavelength", attrs={"units": "nm"})
    return xr.DataArray(
        [0.05, 0.05], dims="wavelength", coords={"wavelength": nm}, attrs={"units": "W m-2 sr-1 nm-1"}
    )


def frames_of(sweep: xr.Dataset, dark_ms: float = 5.0, rate: float = 0.0) -> xr.Dataset:
    dark = xr.full_like(sweep.true_radiance_gain, 100.0).astype("f8")
    counts = (dark + 0.05 * 5e-3 / sweep.true_radiance_gain).fillna(100.0) + rate * 5e-3
    seconds = {"units": "s"}
    return xr.Dataset(
        {
            "counts": counts.assign_attrs(units="count"),
            "dark_counts": (dark + rate * dark_ms * 1e-3).assign_attrs(units="count"),
            "exposure_time": xr.DataArray(5e-3, attrs=seconds),
            "dark_exposure_time": xr.DataArray(dark_ms * 1e-3, attrs=seconds),
        }
    )


@pytest.fixture(scope="module")
def relative() -> tuple[xr.Dataset, xr.Dataset]:
    sweep = sweep_of(columns=6, **CLEAN)
    return sweep, hp.calibrate(sweep.drop_vars(["capture_fraction", "etendue"]), absolute=False)


@pytest.mark.parametrize("scale", ["element", "common"])
def test_an_anchor_takes_all_with_it(relative: tuple[xr.Dataset, xr.Dataset], scale: str) -> None:
    sweep, shape = relative
    made = anchor_to_radiance(shape, frames_of(sweep), even_radiance(), scale=scale)
    ratio = (made.responsivity * made.radiance_gain / (shape.responsivity * shape.radiance_gain)).values
    np.testing.assert_allclose(ratio[np.isfinite(ratio)], 1.0, rtol=1e-5)
    assert ("radiance_gain_u_random" in made) == (scale == "common")
    # the etendue that belongs to this responsivity is not known, its scale is
    assert np.isfinite(made.radiance_gain.values[60]).all()


def test_an_anchor_wants_a_dark_of_its_exposure(relative: tuple[xr.Dataset, xr.Dataset]) -> None:
    sweep, shape = relative
    expect_refusals(
        (
            SchemaError,
            "dark-exposure-differs",
            "5 ms",
            "50 ms",
            lambda: anchor_to_radiance(shape, frames_of(sweep, dark_ms=50.0, rate=400.0), even_radiance()),
        )
    )
    rate = xr.full_like(shape.radiance_gain, 400.0).assign_attrs(units="count s-1")
    made = anchor_to_radiance(
        shape.assign(dark_rate=rate), frames_of(sweep, dark_ms=50.0, rate=400.0), even_radiance()
    )
    assert np.nanmax(np.abs(error_of(made, sweep))) < 1e-4


@pytest.mark.filterwarnings("ignore:the panel at lines:hyperpaint.base.errors.PaintWarning")  # no panel
def test_no_scale_no_quantum_efficiency_and_no_radiance(relative: tuple[xr.Dataset, xr.Dataset]) -> None:
    expect_refusals((SchemaError, "scale-unknown", lambda: quantum_efficiency(relative[1], 20.0)))
    line = simulate_line(lines=8, bands=20, columns=6).assign_attrs(absolute_scale="unknown")
    expect_refusals(
        (SchemaError, "scale-unknown", line.paint.radiance),
        (SchemaError, "scale-unknown", line.paint.reflectance),
    )
    panel = hp.Panel(slice(0, 4), slice(0, 3), 0.1)  # about as bright as the scene there
    scaled = line.paint.reflectance(panel=panel).reflectance.values
    usual = line.assign_attrs(absolute_scale="known").paint.reflectance(panel=panel).reflectance.values
    np.testing.assert_array_equal(scaled, usual)


def test_an_anchor_of_a_linearised_calibration_is_linearised() -> None:
    sweep = sweep_of(columns=6, **CLEAN)
    made = hp.calibrate(sweep, linearity=(0.0, 1e-9)).assign_attrs(linearity=[1e-4])
    frames = frames_of(sweep)
    curved = (-1 + np.sqrt(1 + 4e-4 * (frames.counts - frames.dark_counts))) / 2e-4  # c + 1e-4 c^2 = bent
    frames["counts"] = (curved + frames.dark_counts).assign_attrs(units="count")
    anchored = anchor_to_radiance(made, frames, even_radiance())
    assert np.nanmax(np.abs(error_of(anchored, sweep))) < 1e-5
    assert anchored.linearity == [1e-4]


def test_lines_keep_what_the_calibration_says() -> None:
    for attrs in ({"linearity": [1e-6], "absolute_scale": "unknown"}, {"absolute_scale": "known"}, {}):
        assert scale_attrs(xr.Dataset(attrs=attrs)) == attrs


# --- Sweeps that must not become a calibration: one clear error that lists everything, or a warning


@pytest.fixture(scope="module")
def sweep() -> xr.Dataset:
    return simulate_sweep(steps=31, bands=136, columns=6, nonuniformity=0)


def changed(sweep: xr.Dataset, **values: object) -> xr.Dataset:
    made = sweep.copy()
    for name, value in values.items():
        made[name] = value if isinstance(value, xr.DataArray) else (sweep[name].dims, value)
        made[name].attrs = {**sweep[name].attrs, **made[name].attrs}
    return made


def refusal_of(sweep: xr.Dataset) -> SchemaError:
    return expect_error(SchemaError, None, lambda: hp.calibrate(sweep))


def flux_of(sweep: xr.Dataset, step: int, value: float) -> xr.Dataset:
    flux = sweep.flux.values.copy()
    flux[step] = value
    return changed(sweep, flux=flux)


def test_arguments_are_of_the_elements_of_the_sweep() -> None:
    sweep = simulate_sweep(steps=31, bands=136, columns=4, noise=False, quantise=False, nonuniformity=0)
    numbered = sweep.assign_coords(cross_track=[0, 1, 2, 3]).swap_dims(step="step_wavelength")
    flat = xr.DataArray(np.tile([1.3, 1.1, 0.9, 0.8], (136, 1)), dims=("band", "cross_track"))
    bad = (flat > 1.2) & (np.arange(136) == 40)[:, None]
    made = hp.calibrate(numbered, flat_field=flat.values, bad_elements=bad.values)
    xr.testing.assert_equal(made, hp.calibrate(sweep, flat_field=flat, bad_elements=bad))
    other = flat.assign_coords(cross_track=[3, 2, 1, 0])
    expect_refusals(
        (SchemaError, "grid-mismatch", lambda: hp.calibrate(numbered, flat_field=other)),
        (SchemaError, "grid-mismatch", lambda: hp.calibrate(numbered, bad_elements=other > 1.2)),
        (SchemaError, "grid-mismatch", lambda: hp.calibrate(numbered, flat_field=flat.values[:, :2])),
    )


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_a_step_of_nan_is_left_out(sweep: xr.Dataset) -> None:
    with pytest.warns(PaintWarning, match=r"540 nm.*steps-dark"):
        hp.calibrate(changed(sweep, counts=sweep.counts.where(sweep.step_wavelength != 540.0)))


@pytest.mark.parametrize(
    ("change", "field", "code"),
    [
        (lambda s: flux_of(s, 3, 0.0), "'flux' is 0 at 1 of 31 steps (460 nm)", "value-out-of-range"),
        (lambda s: flux_of(s, 3, np.nan), "'flux' is nan at 1 of 31 steps (460 nm)", "value-out-of-range"),
        (lambda s: flux_of(s, 3, -1.0), "'flux' is -1 at 1 of 31 steps", "value-out-of-range"),
        (lambda s: s.drop_vars("flux"), "'flux' is missing", ""),
        (lambda s: s.drop_vars("capture_fraction"), "'capture_fraction' is missing", ""),
        (lambda s: changed(s, capture_fraction=1.5), "'capture_fraction'", "value-out-of-range"),
        (lambda s: changed(s, flux=s.flux * 1e6), "uW for W", "scale-implausible"),
        (lambda s: changed(s, flux=s.flux * 1e-4), "expected below 1", "scale-implausible"),
        (lambda s: changed(s.drop_vars("dark_exposure_time"), exposure_time=s.exposure_time * 1e3),
         "ms for s", "scale-implausible"),
        (lambda s: s.isel(step=[1, 0, *range(2, 31)]), "400 after 420 nm (step 1)", "steps-unordered"),
        (lambda s: s.isel(step=[0, 1, 1, *range(2, 31)]), "420 after 420 nm", "steps-unordered"),
        (lambda s: changed(s, counts=s.counts.values[[*range(15), *range(20, 31), *range(15, 20)]]),
         "step_wavelength", "steps-unordered"),
        (lambda s: changed(s, counts=s.counts * 0 + s.dark_counts), "at 31 of", "steps-dark"),
        (lambda s: s.isel(step=slice(0, 3)), "3 steps", "steps-too-few"),
        (lambda s: changed(s, dark_exposure_time=s.exposure_time / 2), "dark at", "dark-exposure-differs"),
        (lambda s: s.assign_attrs(monochromator_shape="box"), "'box'", "choice-unknown"),
        (lambda s: changed(s, saturation_count=s.saturation_count * 0 + 300), "saturated", "lamp-lines-few"),
    ],
)  # fmt: skip
def test_one_problem_at_a_time(
    sweep: xr.Dataset, change: Callable[[xr.Dataset], xr.Dataset], field: str, code: str
) -> None:
    error = refusal_of(change(sweep))
    assert field in str(error)
    assert not code or error.codes == (code,)


def test_all_problems_at_once(sweep: xr.Dataset) -> None:
    bad = flux_of(sweep, 3, 0.0).isel(step=[1, 0, *range(2, 31)]).drop_vars("etendue")
    bad["exposure_time"].attrs["units"] = "m"
    bad = bad.rename(cross_track="x").assign_attrs(monochromator_shape="box")
    message = str(refusal_of(bad))
    for part in ("'counts' has dims (step, band, x)", "'etendue' is missing", "'exposure_time' has units 'm'",
                 "'flux' is 0", "out of order", "monochromator_shape"):  # fmt: skip
        assert part in message
    assert message.count("\n") >= 7


def test_a_few_saturated_lines_are_left_out(sweep: xr.Dataset) -> None:
    counts = sweep.counts.values.copy()
    counts[10] = np.minimum(counts[10] * 30, 4095)
    variance = sweep.counts_variance.values.copy()
    variance[10] = 0.0
    with pytest.warns(PaintWarning, match=r"600 nm \(6 of 6.*steps-saturated"):
        made = hp.calibrate(changed(sweep, counts=counts, counts_variance=variance))
    assert not made.line_trusted.values[10].any()
    assert float(np.abs((made.radiance_gain / sweep.true_radiance_gain - 1)[10:-10]).max()) < 0.02


def test_a_lost_step_is_left_out(sweep: xr.Dataset) -> None:
    counts = sweep.counts.values.copy()
    counts[12] = sweep.dark_counts.values[12] if sweep.dark_counts.ndim == 3 else sweep.dark_counts.values
    with pytest.warns(PaintWarning, match=r"640 nm.*steps-dark"):
        made = hp.calibrate(changed(sweep, counts=counts))
    assert made.steps_left_out_nm == [640.0]


def test_a_wide_gap_between_steps_is_not_bridged(sweep: xr.Dataset) -> None:
    made = hp.calibrate(sweep.isel(step=[*range(10), *range(16, 31)]))
    assert not made.good.values[((made.wavelength > 585) & (made.wavelength < 715)).values].any()
    assert made.good.values[(made.wavelength < 575).values][3:].all()


def test_without_a_scale_the_shape_is_left(sweep: xr.Dataset) -> None:
    made = hp.calibrate(sweep.drop_vars(["capture_fraction", "etendue"]), absolute=False)
    assert made.absolute_scale == "unknown"
    ratio = (made.radiance_gain / sweep.true_radiance_gain).values[10:-10]
    assert np.nanstd(ratio) / np.nanmean(ratio) < 4e-3


def test_elements_that_are_not_finite_are_bad(sweep: xr.Dataset) -> None:
    counts = sweep.counts.values.copy()
    counts[:, 60, 2] = np.nan
    made = hp.calibrate(changed(sweep, counts=counts), bad_elements=xr.zeros_like(sweep.true_bad))
    others = np.ones(made.radiance_gain.shape, bool)
    others[60, 2] = False
    assert np.abs(np.where(others, made.radiance_gain / sweep.true_radiance_gain - 1, 0)[10:-10]).max() < 0.02
    expect_refusals(
        (
            SchemaError,
            "grid-mismatch",
            lambda: hp.calibrate(
                sweep, bad_elements=xr.DataArray(np.zeros((2, 2), bool), dims=("band", "cross_track"))
            ),
        )
    )


@pytest.mark.filterwarnings("ignore::hyperpaint.base.errors.PaintWarning")
@pytest.mark.parametrize(("fwhm", "steps"), [(6.0, 31), (6.0, 61), (12.0, 31)])
def test_bands_further_apart_than_they_are_wide__are_refused(fwhm: float, steps: int) -> None:
    # Rationale: 40 bands 15 nm apart of 6 nm gave a calibration of 19 bands, wrong by tens of per cent
    sparse = {"bands": 40, "columns": 6, "steps": steps, "fwhm_nm": fwhm, "nonuniformity": 0}
    error = refusal_of(simulate_sweep(**sparse))
    assert error.codes == ("bands-undersampled",)
    assert "bands 15" in str(error)


@pytest.mark.filterwarnings("ignore::hyperpaint.base.errors.PaintWarning")
@pytest.mark.parametrize("settings", [{"fwhm_nm": 16.0, "steps": 61}, {"monochromator_fwhm_nm": 18.5}])
def test_bands_that_touch_or_wide_lines__are_calibrated(settings: dict[str, float]) -> None:
    # Expected: the gain of the simulated camera, to a per cent in the median; also of narrow bands, where the
    # monochromator's line, as wide as the refusal asks for, reaches from one to the next
    sweep = simulate_sweep(bands=40, columns=6, nonuniformity=0, **{"fwhm_nm": 6.0, "steps": 31, **settings})
    error = hp.calibrate(sweep).radiance_gain / sweep.true_radiance_gain - 1
    np.testing.assert_array_less([float(abs(error).median()), float(abs(error).max())], [0.01, 0.03])


# --- Absolute anchors, dark, flat field, linearity and stray light on their own ---


ELEMENT = ("band", "cross_track")


def test_etendue_from_both_sides() -> None:
    image = etendue_from_optics(2.5, 7.4e-6, 20e-6)
    assert image == pytest.approx(1.860e-11, rel=2e-4)
    assert etendue_from_pupil(12e-3 / 2.5, 7.4e-6 / 12e-3, 20e-6 / 12e-3) == pytest.approx(image, rel=1e-12)
    expect_refusals((SchemaError, "value-out-of-range", lambda: etendue_from_optics(2.5, 7.4, 20.0)))


@pytest.fixture(scope="module")
def anchored_sweep() -> xr.Dataset:
    return simulate_sweep(bands=136, columns=6, nonuniformity=0.02, smile_nm=1.5, noise=False, quantise=False)


def frames_at(sweep: xr.Dataset, radiance: xr.DataArray | float, exposure: float = 5e-3) -> xr.Dataset:
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
def test_a_sphere_gives_every_element_its_gain(anchored_sweep: xr.Dataset) -> None:
    made = hp.calibrate(anchored_sweep)
    flat = spectrum([5.0, 5.0], [300.0, 1200.0], "uW cm-2 sr-1 nm-1")  # 0.05 in SI
    anchored = anchor_to_radiance(made, frames_at(anchored_sweep, 0.05), flat)
    known = np.isfinite(anchored_sweep.true_radiance_gain.values)
    np.testing.assert_allclose(
        anchored.radiance_gain.values[known], anchored_sweep.true_radiance_gain.values[known], rtol=1e-5
    )
    # a sloping spectrum is averaged over each column's own responses, smile and all
    slope = spectrum([0.02, 0.08], [300.0, 1200.0])
    level = (
        0.02
        + 0.06 * ((anchored_sweep.true_wavelength + anchored_sweep.true_wavelength_shift) - 300.0) / 900.0
    )
    error = (
        anchor_to_radiance(made, frames_at(anchored_sweep, level), slope).radiance_gain
        / anchored_sweep.true_radiance_gain
        - 1
    )
    assert float(np.abs(error).max()) < 4e-4


@pytest.mark.slow
def test_one_factor_leaves_the_shape_of_the_sweep(anchored_sweep: xr.Dataset) -> None:
    shape = hp.calibrate(anchored_sweep.drop_vars(["capture_fraction", "etendue"]), absolute=False)
    anchored = anchor_to_radiance(
        shape, frames_at(anchored_sweep, 0.05), spectrum([0.05, 0.05], [300.0, 1200.0]), scale="common"
    )
    ratio = anchored.radiance_gain / shape.radiance_gain
    assert float(ratio.std() / ratio.mean()) < 1e-6
    assert float(np.abs((anchored.radiance_gain / anchored_sweep.true_radiance_gain).median() - 1)) < 5e-3
    assert anchored.absolute_scale == "known"


def test_an_anchor_extrapolates_nothing_and_drops_what_is_saturated(anchored_sweep: xr.Dataset) -> None:
    made = hp.calibrate(anchored_sweep)
    part = anchor_to_radiance(made, frames_at(anchored_sweep, 0.05), spectrum([0.05, 0.05], [500.0, 800.0]))
    beyond = (made.wavelength < 490) | (made.wavelength > 810)
    assert np.isnan(part.radiance_gain.values[beyond.values]).all()
    assert not part.good.values[beyond.values].any()
    frames = frames_at(anchored_sweep, 0.05)
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
        (
            SchemaError,
            "source-coverage",
            lambda: anchor_to_radiance(made, frames_at(anchored_sweep, 0.05), beyond),
        ),
        (SchemaError, "variable-missing", "'exposure_time'", lambda: anchor_to_radiance(made, untimed, flat)),
        (UnitsError, "units-not-convertible", lambda: anchor_to_radiance(made, frames, irradiance)),
    )
    # frames of nearly equal exposures, and dims in another order
    several = frames_at(anchored_sweep, 0.05).expand_dims(along_track=2, axis=0)
    several["exposure_time"] = ("along_track", [5e-3, 5.00001e-3], {"units": "s"})
    several["dark_counts"] = several.dark_counts.isel(along_track=0)
    np.testing.assert_allclose(
        anchor_to_radiance(made.transpose("cross_track", ...), several, flat).radiance_gain,
        anchor_to_radiance(made, frames_at(anchored_sweep, 0.05), flat).radiance_gain,
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
                partial(hp.calibrate, anchored_sweep, flux_uncertainty=wrong),
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
