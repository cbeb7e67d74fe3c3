"""What a physics review found to pass unseen: each of these once gave a wrong gain, or a wrong certainty."""

import functools
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.refusals import expect_refusals

import hyperpaint as hp
from hyperpaint.base.errors import PaintWarning, SchemaError
from hyperpaint.calibration import anchor_to_radiance, quantum_efficiency
from hyperpaint.calibration.detector import fit_dark_model
from hyperpaint.io.flightline.side_files import scale_attrs
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


def calibrated_silently(sweep: xr.Dataset) -> xr.Dataset:
    # Return a calibration that warns of nothing
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return hp.calibrate(sweep)


# --- dark


@pytest.mark.parametrize("drift", [2.0, -1.4])
def test_a_dark_that_is_off_moves_no_gain_and_is_told(drift: float) -> None:
    sweep = sweep_of(**CLEAN)
    off = with_values(sweep, "dark_counts", sweep.dark_counts.values + drift)
    with pytest.warns(PaintWarning, match="dark-offset") as caught:
        made = hp.calibrate(off)
    # an error of less than a count is none
    calibrated_silently(with_values(sweep, "dark_counts", sweep.dark_counts.values + drift / 2.7))
    assert (caught[0].filename, made.dark_offset_count) == (__file__, pytest.approx(-drift, abs=0.05))
    assert np.nanmax(np.abs(error_of(made, sweep))) < 1e-3
    # a count in every band outside of the line, over the line's area
    assert made.out_of_band_of_one_count == pytest.approx(
        abs(float(made.out_of_band.median()) / drift), rel=0.2
    )


def test_stray_light_is_not_taken_for_a_dark_that_is_off() -> None:
    assert abs(calibrated_silently(sweep_of(stray_light=0.02, **CLEAN)).dark_offset_count) < 0.2


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
        calibrated_silently(sweep_of(**effects))


def test_what_passes_as_an_even_beam_depends_on_the_flux() -> None:
    sweep = sweep_of(columns=24, beam_fwhm_columns=120.0, beam_recorded=False)  # 2.7 % at the ends
    calibrated_silently(sweep)
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
        calibrated_silently(whole.drop_vars("saturation_count"))


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
    with pytest.raises(SchemaError) as caught:
        hp.calibrate(sweep)
    return caught.value


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
