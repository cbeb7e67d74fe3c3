"""Calibration against lamps, certificates and factory files of other people's instruments (SOURCES.md)."""

from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from hyperpaint.base.facts import convert
from hyperpaint.calibration import anchor_to_radiance, calibration_from_coefficients, flat_field
from hyperpaint.calibration.detector import Light, NoiseModel, Window, fit_wavelength_map, fit_window
from hyperpaint.io.envi.envi_cubes import open_envi
from hyperpaint.kernels.line_fits import CENTRE, GAUSSIAN

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
    fits = fit_window(window, NoiseModel(25.0, 1.0), 1.0, GAUSSIAN, Light(np.zeros(1), False))
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
