"""Sweeps that must not become a calibration: one clear error that lists everything, or a warning."""

from collections.abc import Callable

import numpy as np
import pytest
import xarray as xr
from support.refusals import expect_refusals

import hyperpaint as hp
from hyperpaint.base.errors import PaintWarning, SchemaError
from hyperpaint.simulation import simulate_sweep


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
