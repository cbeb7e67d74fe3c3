"""What a calibration must show: against brute-force sweeps of a camera whose truth is known."""

import functools
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.codecs import plain_zarr
from support.refusals import expect_error, expect_refusals

import hyperpaint as hp
from hyperpaint.base.errors import PaintWarning
from hyperpaint.base.facts import convert
from hyperpaint.calibration import (
    anchor_to_radiance,
    calibration_from_coefficients,
    flat_field,
    quantum_efficiency,
    relative_responsivity,
)
from hyperpaint.calibration.detector import NoiseModel, Window, fit_wavelength_map, fit_window
from hyperpaint.io.envi.envi_cubes import open_envi
from hyperpaint.io.flightline.side_files import calibration_parts, check_calibration
from hyperpaint.kernels.line_fits import CENTRE, GAUSSIAN
from hyperpaint.simulation import simulate_collect, simulate_line, simulate_sweep

CLEAN = {"noise": False, "quantise": False}
FWHM = 6.0


@functools.lru_cache(maxsize=4)
def _sweep(effects: tuple[tuple[str, Any], ...]) -> xr.Dataset:
    return simulate_sweep(**dict(effects))


def sweep_of(**effects: Any) -> xr.Dataset:
    return _sweep(tuple(sorted({"columns": 5, "nonuniformity": 0, "smile_nm": 1.5, **effects}.items())))


def inside(sweep: xr.Dataset, width: float) -> np.ndarray:
    # Bands at least 1.5 FWHM from both ends of array and sweep
    nm = sweep.true_wavelength.values
    margin = 1.5 * np.hypot(FWHM, width)
    low, high = max(nm[0], sweep.step_wavelength.values[0]), min(nm[-1], sweep.step_wavelength.values[-1])
    return (nm >= low + margin) & (nm <= high - margin)


def errors(made: xr.Dataset, sweep: xr.Dataset, width: float) -> dict[str, float]:
    # Largest errors: gain and FWHM relative, wavelengths in nm
    band = inside(sweep, width)
    gain = (made.radiance_gain / sweep.true_radiance_gain - 1).values[band]
    assert np.isfinite(gain).all()
    return {
        "gain": float(np.abs(gain).max()),
        "gain_rms": float(np.sqrt((gain**2).mean())),
        "wavelength": float(np.abs(made.wavelength - sweep.true_wavelength).values[band].max()),
        "smile": float(np.abs(made.wavelength_shift - sweep.true_wavelength_shift).values[band].max()),
        "fwhm": float(np.abs(made.fwhm / sweep.true_fwhm - 1).values[band].max()),
    }


@pytest.mark.parametrize("shape", ["gaussian", "slit"])
@pytest.mark.parametrize(
    ("width", "light"),
    [*((width, "gaussian") for width in (0.5, 2.0, 4.0, 6.0, 12.0)), (2.0, "triangle"), (12.0, "triangle")],
)
def test_gain_whatever_the_monochromator(width: float, shape: str, light: str) -> None:
    sweep = sweep_of(monochromator_fwhm_nm=width, srf_shape=shape, monochromator_shape=light, **CLEAN)
    if width > 0.7 * FWHM:
        with pytest.warns(PaintWarning, match="slit-too-wide"):
            made = hp.calibrate(sweep)
    else:
        made = hp.calibrate(sweep)
    found = errors(made, sweep, width)
    assert made.srf_shape == shape
    np.testing.assert_array_less([found["gain"], found["smile"], found["wavelength"]], [1e-3, 0.05, 0.02])
    if width <= 0.7 * FWHM:
        assert found["fwhm"] < 0.02
    assert made.radiance_gain.dtype == np.float32
    assert made.wavelength.dtype == made.fwhm.dtype == made.wavelength_shift.dtype == np.float64


@pytest.mark.parametrize("shape", ["gaussian", "slit"])
@pytest.mark.parametrize("width", [0.5, 4.0])
def test_gain_with_noise(width: float, shape: str) -> None:
    sweep = sweep_of(monochromator_fwhm_nm=width, srf_shape=shape, columns=40)
    made = hp.calibrate(sweep)
    found = errors(made, sweep, width)
    assert made.srf_shape == shape
    np.testing.assert_array_less(
        [found["gain"], found["gain_rms"], found["wavelength"], found["smile"], found["fwhm"]],
        [5e-3, 1e-3, 0.02, 0.05, 0.02],
    )
    z = ((made.radiance_gain / sweep.true_radiance_gain - 1) / made.radiance_gain_u_random).values
    assert 0.85 < np.nanstd(z) < 1.15
    assert float(made.electrons_per_count) == pytest.approx(float(sweep.true_electrons_per_count), rel=0.02)


def test_a_coarse_camera_keeps_its_area() -> None:
    # bands 4.4 nm apart sum to 0.3 % more or less than the light, depending on where the line falls
    sweep = sweep_of(bands=136, monochromator_fwhm_nm=0.5, **CLEAN)
    assert errors(hp.calibrate(sweep), sweep, 0.5)["gain"] < 1e-3


def test_lines_at_the_edges_are_completed_and_nothing_is_extrapolated() -> None:
    sweep = sweep_of(**CLEAN)
    made = hp.calibrate(sweep)
    truth = sweep.true_wavelength + sweep.true_wavelength_shift
    beyond = (truth < 400.0 - 0.02) | (truth > 1000.0 + 0.02)
    assert np.isnan(made.radiance_gain.values[beyond.transpose("band", "cross_track").values]).all()
    assert int(made.good.sum()) >= 269
    assert np.nanmax(np.abs((made.radiance_gain / sweep.true_radiance_gain - 1).values)) < 2e-3
    part = hp.calibrate(sweep.isel(step=slice(5, 50)))
    assert not part.good.values[((part.wavelength < 449.5) | (part.wavelength > 890.5)).values].any()
    assert np.isnan(part.radiance_gain.values[(truth < 449.9).values]).all()
    known = np.isfinite(part.radiance_gain_u_random.values)
    np.testing.assert_array_equal(known, np.isfinite(part.radiance_gain.values))
    # an array read from the red end
    turned = hp.calibrate(sweep.isel(band=slice(None, None, -1)))
    for name in ("radiance_gain", "wavelength", "wavelength_shift", "fwhm", "good"):
        tolerance = 1e-3 if name != "radiance_gain" else 0
        np.testing.assert_allclose(turned[name].values[::-1], made[name].values, rtol=1e-4, atol=tolerance)


def test_gain_does_not_depend_on_what_cancels() -> None:
    # Flux and counts scaled together, and exposure and counts, leave the gain (physics 2.4, 2 and 4)
    sweep = sweep_of(bands=136, **CLEAN)
    dark = sweep.dark_counts
    whole = hp.calibrate(sweep).radiance_gain
    for name in ("flux", "exposure_time"):
        scaled = sweep.copy()
        scaled["counts"] = ((sweep.counts - dark) * 0.5 + dark).assign_attrs(sweep.counts.attrs)
        scaled[name] = (sweep[name] * 0.5).assign_attrs(sweep[name].attrs)
        if name == "exposure_time" and "dark_exposure_time" in sweep:
            scaled["dark_exposure_time"] = (sweep.dark_exposure_time * 0.5).assign_attrs(units="s")
        np.testing.assert_allclose(hp.calibrate(scaled).radiance_gain, whole, rtol=2e-5)
    # units are converted
    other = sweep.copy()
    other["flux"] = (sweep.flux * 1e6).assign_attrs(units="uW")
    other["exposure_time"] = (sweep.exposure_time * 1e3).assign_attrs(units="ms")
    np.testing.assert_allclose(hp.calibrate(other).radiance_gain, whole, rtol=1e-5)


@pytest.mark.slow
def test_lazy_sweeps_give_the_same_bits() -> None:
    sweep = sweep_of(bands=136)
    eager = hp.calibrate(sweep)
    for chunks in ({"step": 1}, {"step": 7, "band": 50, "cross_track": 3}):
        xr.testing.assert_identical(hp.calibrate(sweep.chunk(chunks)), eager)


def test_a_beam_is_no_response() -> None:
    sweep = sweep_of(bands=136, columns=24, beam_fwhm_columns=10.0, beam_wander_columns=2.0)
    with pytest.warns(PaintWarning, match=r"5 of 24 .*columns-unlit"):
        made = hp.calibrate(sweep)
    lit = np.isfinite(made.radiance_gain.values[68])
    assert (lit[6:19].all(), lit.all()) == (True, False)
    assert np.nanstd((made.radiance_gain / sweep.true_radiance_gain - 1).values[20:-20]) < 4e-3
    assert float(np.nanmedian(made.beam_fwhm)) == pytest.approx(10.0, rel=0.03)
    assert float(np.ptp(made.beam_centre.values[5:-5])) == pytest.approx(4.0, abs=0.3)
    with pytest.warns(PaintWarning, match="flux-profile-missing"):
        hp.calibrate(sweep_of(bands=136, columns=24, beam_fwhm_columns=16.0, beam_recorded=False))


@pytest.mark.slow
def test_a_flat_field_brings_what_lines_cannot_see() -> None:
    sweep = sweep_of(bands=136, columns=24, nonuniformity=0.01)
    band = inside(sweep, 2.0)
    flat = flat_field(0.05 / sweep.true_radiance_gain)
    spread = [
        np.nanstd((made.radiance_gain / sweep.true_radiance_gain - 1).values[band])
        for made in (hp.calibrate(sweep), hp.calibrate(sweep, flat_field=flat))
    ]
    np.testing.assert_array_less([5e-3, spread[1]], [spread[0], 2e-3])


def test_bad_elements_are_found_and_spoil_nothing_else() -> None:
    sweep = sweep_of(columns=24, bad_elements=20)
    made = hp.calibrate(sweep)
    gain = made.radiance_gain.values
    bad = sweep.true_bad.values
    assert np.isnan(gain[bad]).all()
    band = inside(sweep, 2.0)
    assert np.isfinite(gain[band][~bad[band]]).all()
    assert np.nanmax(np.abs((made.radiance_gain / sweep.true_radiance_gain - 1).values[band])) < 8e-3
    said = xr.zeros_like(sweep.true_bad)
    said[100, 3] = True
    assert np.isnan(hp.calibrate(sweep, bad_elements=said).radiance_gain.values[100, 3])


def test_views_provenance_and_progress() -> None:
    told: list[tuple[int, int]] = []
    made = hp.calibrate(sweep_of(bands=136), progress=lambda done, total: told.append((done, total)))
    assert (told[0], told[-1]) == ((1, 244), (244, 244))
    assert 0.1 < float(quantum_efficiency(made).max()) < 0.2  # half of the light falls between 136 bands
    assert float(relative_responsivity(made).max()) == pytest.approx(1.0, abs=0.02)
    assert (made.absolute_scale, made.noise_source) == ("known", "variance of the frames")
    assert made.radiance_gain_u_systematic.dims == ("band",)
    assert float(made.radiance_gain_u_systematic[60]) == pytest.approx(0.04, rel=0.01)
    assert made.wavelength_residual_nm < 0.01
    residual = made.line_centre - made.step_wavelength
    assert float(np.abs(residual.where(made.line_trusted)[2:-2]).max()) < 0.02
    for name, array in made.variables.items():
        assert array.attrs.get("long_name"), name


def test_out_of_band_light_is_reported() -> None:
    made = hp.calibrate(sweep_of(bands=136, columns=12, stray_light=2e-3, second_order=5e-3))
    assert float(np.nanmedian(made.second_order)) == pytest.approx(5e-3, rel=0.05)
    assert 1.2e-3 < np.median(made.stray_light.sum("band").values[70:]) < 2.2e-3
    # what scatters hardly changes within the width of a line: it goes on to the band itself
    beside = made.stray_light.values[70, [62, 78]]
    assert beside.max() < made.stray_light.values[70, 70] < 2.0 * beside.max()


def test_dark_at_any_exposure_once_bias_and_rate_are_known() -> None:
    sweep = sweep_of(bands=136, dark_exposure_ms=20.0)
    expect_refusals((hp.SchemaError, "dark-exposure-differs", "50 ms", "20 ms", lambda: hp.calibrate(sweep)))
    both = _sweep((("bands", 136), ("columns", 5), ("dark_exposure_ms", (20.0, 80.0)), ("nonuniformity", 0)))
    made = hp.calibrate(both)
    assert float(np.abs(made.dark_bias - both.true_dark_bias).max()) < 0.3
    assert errors(made, both, 2.0)["gain"] < 1e-2


def test_other_line_shapes_can_be_asked_for() -> None:
    sweep = sweep_of(bands=136, **CLEAN)
    # the lines are Gaussian: a slit leaves a residual that all of them share
    with pytest.warns(PaintWarning, match=r"'slit'.*response-shape-misfit"):
        assert hp.calibrate(sweep, srf_shape="slit").srf_shape == "slit"
    expect_error(hp.SchemaError, "type-wrong", lambda: hp.calibrate("sweep.zarr"))
    expect_refusals((hp.SchemaError, "choice-unknown", lambda: hp.calibrate(sweep, srf_shape="box")))


# --- end to end: a flight calibrated by the sweep of its own camera, against the truth of the scene ---------


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


# --- what optics and electronics of the simulated camera do, as the calibration of its lab sweep finds it


CAMERA: dict[str, Any] = {"bands": 136, "columns": 12}
EXACT: dict[str, Any] = {"noise": False, "quantise": False}


@pytest.mark.parametrize("share", [0.005, 0.02])
def test_stray_light_of_the_sweep_mends_a_flight(share: float) -> None:
    sweep = simulate_sweep(**CAMERA, stray_light=share)
    matrix, truth = hp.calibrate(sweep).stray_light.values, sweep.true_stray_light.values
    # what falls into a line's own window cannot be told from the line
    far = np.abs(np.subtract.outer(np.arange(136), np.arange(136))) > 12
    assert matrix[far].sum() == pytest.approx(truth[far].sum(), rel=0.1)
    flight: dict[str, Any] = {"lines": 24, "glint": 0.0, **CAMERA, **EXACT}
    hazy, clear = simulate_line(**flight, stray_light=share), simulate_line(**flight)
    seen, true = ((line.counts - line.dark_counts).astype("f8") for line in (hazy, clear))
    mended = np.einsum("bs,lsx->lbx", np.linalg.inv(np.eye(136) + matrix), seen.values)
    error = {
        name: float(np.median(np.abs(cube / true.values - 1)))
        for name, cube in (("none", seen.values), ("swept", mended))
    }
    assert error["none"] == pytest.approx(share, rel=0.1)
    assert error["swept"] < 0.3 * share


@pytest.mark.filterwarnings("ignore:.*counts-averaged")
def test_reflectance_is_freed_of_wings_by_the_sweep_that_holds_them() -> None:
    # By default, by gain and matrix of one calibration, against a camera without wings
    camera: dict[str, Any] = {"bands": 136, "columns": 12, "nonuniformity": 0.02, "seed": 21}
    flight: dict[str, Any] = {"lines": 24, "glint": 0.0, **camera, **EXACT}

    def seen(stray: dict[str, float]) -> list[np.ndarray]:
        # with the gain alone, and with the wings
        calibration = hp.calibrate(simulate_sweep(**camera, **stray))
        parts = calibration_parts(check_calibration(calibration), is_counts=True)
        line = simulate_line(**flight, **stray)
        lines = [
            line.assign({name: parts[name] for name in names if name in parts})
            for names in (gain, gain + wings)
        ]
        return [np.asarray(each.paint.reflectance().reflectance.values) for each in lines]

    gain, wings = ["radiance_gain"], ["stray_light", "stray_light_u"]
    without, expected = seen({})  # without any, nothing is subtracted
    np.testing.assert_array_equal(expected, without)
    for share in (0.01, 0.03):
        unaware, mended = (
            np.nanmedian(np.abs(found / expected - 1.0)[:, 4:-4], axis=(0, 2))
            for found in seen({"stray_light": share})
        )
        np.testing.assert_array_less([share, mended.max(), np.median(mended)], [unaware.max(), 3e-3, 1e-3])


@pytest.mark.parametrize("pedestal", [-3.0, 2.0, 5.0])
def test_a_pedestal_is_the_dark_that_is_off(pedestal: float) -> None:
    with pytest.warns(PaintWarning, match="dark-offset"):
        calibration = hp.calibrate(simulate_sweep(**CAMERA, pedestal=pedestal))
    assert calibration.dark_offset_count == pytest.approx(pedestal, abs=0.02)


def test_smile_is_found_behind_any_optics() -> None:
    optics = {"psf_across_columns": 2.0, "keystone_columns": 0.6, "stray_light": 0.01}
    sweep = simulate_sweep(bands=136, columns=20, smile_nm=0.8, **optics)
    assert float(np.abs(hp.calibrate(sweep).wavelength_shift - sweep.true_wavelength_shift).max()) < 0.02


def test_masked_columns_have_no_gain() -> None:
    with pytest.warns(PaintWarning, match=r"4 of 12 .*columns-unlit"):
        calibration = hp.calibrate(simulate_sweep(**CAMERA, masked_columns=2))
    is_blind = np.isnan(calibration.radiance_gain.values).all(axis=0)
    np.testing.assert_array_equal(is_blind, np.isin(np.arange(12), [0, 1, 10, 11]))


@pytest.mark.parametrize(("nonuniformity", "tolerance"), [(0.0, 0.01), (0.02, 0.06)])
def test_a_narrow_beam_shows_the_keystone(nonuniformity: float, tolerance: float) -> None:
    sweep = simulate_sweep(
        bands=136, columns=41, beam_fwhm_columns=12.0, smile_nm=0.0, keystone_columns=0.6,
        nonuniformity=nonuniformity,
    )  # fmt: skip
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "22 of 41 columns are not lit", PaintWarning)
        calibration = hp.calibrate(sweep)
    keystone = np.interp(sweep.step_wavelength, sweep.true_wavelength, sweep.true_keystone)
    assert np.nanmax(np.abs(calibration.beam_centre.values - 20.0 - keystone)) < tolerance


def test_an_even_beam_shows_no_keystone() -> None:
    plain, skew = (simulate_sweep(**CAMERA, steps=5, keystone_columns=k) for k in (0.0, 0.6))
    np.testing.assert_allclose(plain.counts, skew.counts, rtol=1e-6)


# --- Calibration against lamps, certificates and factory files of other people's instruments (SOURCES.md)


pytestmark = pytest.mark.real_data

ARGON = {696.52: 696.543, 763.35: 763.511, 772.33: 772.376, 811.47: 811.531}
"""Nominal wavelength of the spectrometer at the peak, and that of the line [nm] (in air, NIST)."""


@pytest.fixture(scope="module")
def lab(shared_data: Path) -> Path:
    return shared_data / "lab_calibration"


def table(path: Path, **options: object) -> np.ndarray:
    return np.genfromtxt(path, delimiter=",", **{"skip_header": 1, **options})  # type: ignore[arg-type]


def fitted(signal: np.ndarray, near: int, half: int = 8) -> tuple[float, float]:
    # Return the place of a line by hyperpaint's own fit, and its full width [pixel]
    values = signal[near - half : near + half + 1][None].copy()
    one = np.ones(1)
    window = Window(
        np.zeros(1, np.int64), np.array([near - half]), values, 0 * one, 0 * one, np.zeros(1, bool), one,
        np.zeros(signal.size), near,
    )  # fmt: skip
    fits = fit_window(window, NoiseModel(25.0, 1.0), 1.0, GAUSSIAN, np.zeros(1), triangular=False)
    assert fits.converged[0]
    return float(fits.parameters[0, CENTRE]), float(fits.width[0])


def test_argon_lines_lie_where_the_list_says(lab: Path) -> None:
    nominal, lamp, dark = table(lab / "spectrometer_wlcal_dn.csv").T
    signal = lamp - dark
    places, truth = [], []
    for shown, line in ARGON.items():
        window = np.flatnonzero(np.abs(nominal - shown) < 0.6)
        place, width = fitted(signal, int(window[np.argmax(signal[window])]))
        assert float(np.interp(place, np.arange(nominal.size), nominal)) == pytest.approx(shown, abs=0.1)
        assert 1.2 < width < 8
        places.append(place)
        truth.append(line)
    made = fit_wavelength_map(
        np.array(places), np.zeros(4), np.array(truth), (nominal.size, 1), column_degree=0
    )
    error = made.at(np.array(places), np.zeros(4)) - truth
    assert np.abs(error).max() < 0.05
    # before, the instrument's own wavelengths were off by up to 0.16 nm
    assert np.abs(np.interp(places, np.arange(nominal.size), nominal) - truth).max() > 2 * np.abs(error).max()


def test_the_line_list_holds_these_lines(lab: Path) -> None:
    listed = np.loadtxt(lab / "spectrometer_wlcal_lines.csv", delimiter=",", skiprows=1, usecols=1)
    for line in ARGON.values():
        assert np.abs(listed - line).min() < 2e-3


def sphere(lab: Path) -> xr.DataArray:
    nm, level = table(lab / "openhsi_sphere_112704-1-1_1nm_data.csv").T[:2]
    return xr.DataArray(
        level,
        dims="wavelength",
        coords={"wavelength": ("wavelength", nm, {"units": "nm"})},
        attrs={"units": "uW cm-2 sr-1 nm-1"},
    )


def test_sphere_certificate_converts(lab: Path) -> None:
    radiance = convert(sphere(lab), "W m-2 sr-1 nm-1")
    assert float(radiance[0].wavelength) == 350.0
    assert float(radiance[0]) == pytest.approx(0.02131023907, rel=1e-12)


def test_sphere_anchors_a_camera(lab: Path) -> None:
    # A camera of flat gain, shown the certificate's radiance, gets that gain back
    radiance = sphere(lab)
    nm = np.arange(420.0, 900.0, 5.0)
    axis = {"units": "nm"}
    camera = xr.Dataset(
        coords={"wavelength": ("band", nm, axis), "fwhm": ("band", np.full(nm.size, 6.0), axis)},
        attrs={"srf_shape": "gaussian"},
    )
    response = np.exp(-4 * np.log(2) * ((radiance.wavelength.values - nm[:, None]) / 6.0) ** 2)
    level = (
        (response * radiance.values).sum(axis=1) / response.sum(axis=1) * 0.01
    )  # an oracle on the 1 nm grid
    gain, exposure = 2e-6, 0.01
    counts = xr.DataArray(
        np.repeat((level * exposure / gain)[:, None], 3, axis=1),
        dims=("band", "cross_track"),
        attrs={"units": "count"},
    )
    frames = xr.Dataset(
        {
            "counts": counts,
            "dark_counts": xr.zeros_like(counts),
            "exposure_time": xr.DataArray(exposure, attrs={"units": "s"}),
        }
    )
    np.testing.assert_allclose(anchor_to_radiance(camera, frames, radiance).radiance_gain, gain, rtol=2e-4)


def test_lamp_scans_give_the_response(lab: Path) -> None:
    # response = lamp radiance / (mean lamp - mean dark), as FieldSpectroscopyCC does it
    scans = table(lab / "spectrometer_radcal_dn.csv")
    nm, lamp, dark = scans[:, 0], scans[:, 1:16], scans[:, 16:31]
    lamp_nm, level = table(lab / "spectrometer_radcal_lamp_radiance.csv").T
    assert level[0] == 0.001827
    expected = np.interp(nm, lamp_nm, level) / (lamp.mean(axis=1) - dark.mean(axis=1))
    units = {"units": "nm"}
    camera = xr.Dataset(
        coords={"wavelength": ("band", nm, units), "fwhm": ("band", np.full(nm.size, 0.2), units)},
        attrs={"srf_shape": "gaussian"},
    )
    frames = xr.Dataset(
        {
            "counts": (("along_track", "band", "cross_track"), lamp.T[:, :, None], {"units": "count"}),
            "dark_counts": (("along_track", "band", "cross_track"), dark.T[:, :, None], {"units": "count"}),
            "exposure_time": xr.DataArray(1.0, attrs={"units": "s"}),
        }
    )
    frames["dark_counts"] = frames.dark_counts.mean("along_track").assign_attrs(units="count")
    source = xr.DataArray(
        level,
        dims="wavelength",
        coords={"wavelength": ("wavelength", lamp_nm, units)},
        attrs={"units": "W m-2 sr-1 nm-1"},
    )
    made = anchor_to_radiance(camera, frames, source)
    signal = lamp.mean(axis=1) - dark.mean(axis=1)
    lit = signal > 0.05 * signal.max()
    assert lit.sum() > 1000
    np.testing.assert_allclose(made.radiance_gain.values[lit, 0], expected[lit], rtol=2e-3)


def test_factory_frame_of_a_pushbroom_is_a_gain(lab: Path) -> None:
    frame = open_envi(lab / "specim_fenix_Radiometric_8x2_1x1.dat")
    values = frame[next(iter(frame.data_vars))].isel(along_track=0)
    coefficients = xr.DataArray(
        values.to_numpy(), dims=("band", "cross_track"), attrs={"units": "mW cm-2 um-1 sr-1 count-1"}
    )
    assert coefficients.shape == (363, 384)
    nm = xr.DataArray(np.linspace(380, 2500, 363), dims="band", attrs={"units": "nm"})
    made = calibration_from_coefficients(
        coefficients, nm, xr.full_like(nm, 5.0), exposure_time=1.0
    ).radiance_gain
    to_si = 1e-3 * 1e4 * 1e-3  # mW, cm-2 and um-1
    assert float(made.min()) / to_si == pytest.approx(0.00208997, rel=1e-5)
    assert float(made.max()) / to_si == pytest.approx(6.14506, rel=1e-5)
    assert float(made.astype("f8").mean()) / to_si == pytest.approx(0.106691733, rel=1e-5)
    leveller = flat_field(1.0 / coefficients)
    np.testing.assert_allclose(
        leveller / leveller.mean("cross_track"), coefficients / coefficients.mean("cross_track"), rtol=1e-4
    )


def test_gain_and_bias_of_a_headwall_model(lab: Path) -> None:
    gain, bias = (np.load(lab / f"terraref_vnir_new_{name}_coeff.npy") for name in ("gain", "bias"))
    matched = np.load(lab / "terraref_vnir_new_best_matched_index.npy")
    assert gain.shape == bias.shape == (1, 939)
    assert (np.isfinite(gain).all(), np.isfinite(bias).all()) == (True, True)
    assert (np.diff(matched) >= 0).all()
    assert matched.min() >= 0
    assert matched.max() < 3648


def test_efficiency_of_a_sensor_is_a_share(lab: Path) -> None:
    nm, percent = table(lab / "imx174qe.csv", skip_header=0).T
    np.testing.assert_array_less([0, percent.max()], [percent.min(), 100])
    assert 480 < nm[np.argmax(percent)] < 580
