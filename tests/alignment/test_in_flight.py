"""Camera and record compared in flight, against the simulator, which shares no code with the chain."""

from pathlib import Path
from typing import Any

import dask
import numpy as np
import pytest
import xarray as xr

import hyperpaint as hp
from hyperpaint.alignment.comparison import divided, record_against_sun
from hyperpaint.base.errors import PaintWarning, SchemaError
from hyperpaint.simulation import simulate_line


def flown(**effects: Any) -> xr.Dataset:
    # Return a line whose width of the record is what it is said to be
    return simulate_line(**{"lines": 24, "columns": 32, "irradiance_noise": 1e-3, **effects})


def misdeclared(
    line: xr.Dataset, *, fwhm: float = 3.0, record: float = 0.33, camera: float = 0.2
) -> xr.Dataset:
    # Return a line that says another width of the record, and wavelengths that are off [nm]
    channels, bands = line.irradiance_wavelength, line.wavelength
    told = line.assign_coords(irradiance_wavelength=channels - record, wavelength=bands + camera)
    return told.assign(irradiance_fwhm=xr.full_like(line.irradiance_fwhm, fwhm))


def errors(line: xr.Dataset) -> tuple[float, float]:
    # Return the largest relative error of the mean reflectance at the oxygen band, and at 420 to 740 nm
    measured, truth = hp.reflectance(line).reflectance.values.astype(float), line.true_reflectance.values
    whole = np.isfinite(measured).all(axis=1, keepdims=True) & (truth > 0.02).all(axis=1, keepdims=True)
    ratio = np.where(whole, measured, 0).sum(axis=(0, 2)) / np.where(whole, truth, 0).sum(axis=(0, 2))
    away = np.abs(ratio - 1)
    nm = line.wavelength.values
    return float(away[abs(nm - 760.5) < 6].max()), float(away[(nm > 420) & (nm < 740)].max())


@pytest.fixture(scope="module")
def wide() -> xr.Dataset:
    # A line whose record is 4 nm wide, and says so
    return flown(seed=302, irradiance_fwhm_nm=4.0, irradiance_noise=0.0, noise=False)


@pytest.fixture(scope="module")
def told(wide: xr.Dataset) -> xr.Dataset:
    # The same, said to be 3 nm wide and to stand elsewhere
    return misdeclared(wide)


@pytest.fixture(scope="module")
def aligned(told: xr.Dataset) -> xr.Dataset:
    return hp.alignment.align(told)


@pytest.mark.parametrize("shape", ["gaussian", "slit"])
def test_a_record_that_is_as_declared_is_left_alone(shape: str) -> None:
    line = flown(seed=301, srf_shape=shape)
    same = hp.alignment.align(line)
    assert same.attrs["alignment_state"] == "not significant"
    assert abs(same.attrs["alignment_shift"]) < 0.02
    assert abs(same.attrs["alignment_width"] - 1) < 0.02
    xr.testing.assert_identical(same.drop_attrs(), line.drop_attrs())


def test_a_record_4_nm_wide_and_shifted_is_found_and_corrected(told: xr.Dataset, aligned: xr.Dataset) -> None:
    oxygen, blue = errors(told)
    np.testing.assert_array_less([0.05, 0.015], [oxygen, blue])
    found = aligned.attrs
    assert (found["alignment_state"], aligned.irradiance_fwhm.dims) == ("applied", ("irradiance_wavelength",))
    assert abs(found["alignment_shift"] + 0.53) < 4 * found["alignment_shift_u"] < 0.05
    assert abs(found["alignment_width"] - 4 / 3) < 4 * found["alignment_width_u"] < 0.1
    oxygen, blue = errors(aligned)
    np.testing.assert_array_less([oxygen, blue], [0.003, 0.001])


def test_what_was_corrected_is_not_found_again(aligned: xr.Dataset) -> None:
    again = hp.alignment.align(aligned)
    assert again.attrs["alignment_state"] == "not significant"
    np.testing.assert_array_equal(again.irradiance_wavelength, aligned.irradiance_wavelength)


def test_never_says_so_and_changes_nothing(told: xr.Dataset) -> None:
    with pytest.warns(PaintWarning, match="alignment-differs"):
        same = hp.alignment.align(told, apply="never")
    assert same.attrs["alignment_state"] == "not applied"
    xr.testing.assert_identical(same.drop_attrs(), told.drop_attrs())
    # the response that irradiance was matched to is not the camera's, and the product says how far it is
    before, after = hp.reflectance(told), hp.reflectance(same)
    np.testing.assert_array_equal(before.reflectance, after.reflectance)
    assert float(before.irradiance_misfit.max()) < 0.02
    assert float(after.irradiance_misfit.min()) > 0.1


def test_always_corrects_what_is_not_significant(wide: xr.Dataset) -> None:
    corrected = hp.alignment.align(wide, apply="always")
    assert corrected.attrs["alignment_state"] == "applied"
    assert 0 < np.abs(corrected.irradiance_wavelength.values - wide.irradiance_wavelength.values).max() < 0.03


def test_the_same_whatever_the_chunks_and_cubes_stay_lazy(told: xr.Dataset, aligned: xr.Dataset) -> None:
    other = hp.alignment.align(told.chunk(along_track=7, band=50, cross_track=11))
    assert aligned.attrs == other.attrs
    np.testing.assert_array_equal(aligned.irradiance_wavelength, other.irradiance_wavelength)
    assert dask.is_dask_collection(other.counts.data)
    assert dask.is_dask_collection(hp.reflectance(other).reflectance.data)


def test_a_camera_of_few_bands_is_not_compared() -> None:
    line = flown(bands=20)
    same = hp.alignment.align(line)
    assert same.attrs["alignment_state"] == "not compared"
    xr.testing.assert_identical(same.drop_attrs(), line.drop_attrs())
    with pytest.raises(SchemaError, match="choice-unknown"):
        hp.alignment.align(line, apply="yes")  # type: ignore[arg-type]


def test_what_lies_beyond_the_search_is_not_corrected(wide: xr.Dataset) -> None:
    with pytest.warns(PaintWarning, match="alignment-at-limit"):
        same = hp.alignment.align(misdeclared(wide, camera=1.9))
    assert same.attrs["alignment_state"] == "not applied"


def test_what_separates_them_is_divided_by_the_suns_lines(wide: xr.Dataset, aligned: xr.Dataset) -> None:
    # a share of the camera within 3 of its uncertainties, 0.07 nm, moves the record alone
    assert "wavelength_shift" not in aligned.attrs["alignment"]
    told = misdeclared(wide, camera=0.4)
    aligned = hp.alignment.align(told)
    found = aligned.attrs
    for name, truth in (("record_shift", 0.33), ("camera_shift", -0.4), ("record_fwhm", 4.0)):
        value, spread = found[f"alignment_{name}"], found[f"alignment_{name}_u"]
        assert abs(value - truth) < 2.5 * spread < 0.5
    moved = aligned.irradiance_wavelength.values - told.irradiance_wavelength.values
    shift = aligned.wavelength_shift.values - told.wavelength_shift.values
    assert f"and the camera's wavelength_shift by {shift.mean():+.3f} nm" in found["alignment"]
    # whatever its division, what separates them is the same
    np.testing.assert_allclose(np.median(moved) - shift.mean(), -found["alignment_shift"], atol=0.01)


def test_what_is_applied_afterwards_leaves_no_numbers_of_the_line_as_it_was(told: xr.Dataset) -> None:
    numbers = {"alignment_shift": -0.53, "alignment_shift_slope": 0.0, "alignment_width": 4 / 3}
    attrs = {"alignment": "camera and irradiance record differ", "alignment_state": "not applied", **numbers}
    panel = xr.DataArray(np.ones((1, told.sizes["band"]), np.float32), dims=("panel", "band"))
    product = hp.reflectance(told.assign_attrs(attrs)).assign(panel_factor=panel)
    assert float(product.irradiance_misfit.min()) > 0.1
    moved = hp.alignment.apply_alignment(product, hp.alignment.align_to_irradiance(told, group=8), degree=1)
    assert not {"reflectance", "irradiance_misfit", "panel_factor"} & set(moved.variables)
    assert [name for name in moved.attrs if name.startswith("alignment")] == ["alignment"]
    # the camera follows the record now: what they differed by no longer shows in the misfit
    assert float(hp.reflectance(moved).irradiance_misfit.max()) < 0.05
    again = hp.alignment.align(moved.isel(band=slice(None, None, 14)))
    assert again.attrs["alignment"].startswith(
        f"{moved.attrs['alignment']}; then camera and irradiance record not"
    )


# --- shift and width that separate camera and record, and how well they are known -------------------------


@pytest.mark.slow
def test_uncertainties_are_what_scatters() -> None:
    # Eight scenes of one camera, noise and smile: nothing is wrong, and shifts lie within their uncertainty
    away = []
    for seed in range(420, 428):
        line = simulate_line(lines=16, columns=48, seed=seed, irradiance_noise=1e-3, nonuniformity=0.0)
        found = hp.alignment.compared(line)
        assert found is not None
        assert not found.is_significant()
        away.append(
            np.array([found.shift, found.tilt, found.width - 1.0]) / np.sqrt(np.diag(found.covariance))
        )
    assert 0.2 < np.sqrt(np.mean(np.square(away))) < 1.6


def test_a_record_too_short_for_any_window_is_not_compared() -> None:
    assert (
        hp.alignment.compared(simulate_line(lines=16, columns=16).sel(irradiance_wavelength=slice(600, 680)))
        is None
    )


def test_air_below_the_camera_is_no_width_of_the_record() -> None:
    # One per cent of the oxygen that the light has crossed lies between ground and camera: 150 m or more
    line = hp.radiance(simulate_line(lines=24, columns=32, seed=431, noise=False)).drop_vars("counts")
    light = line.irradiance.values.mean(axis=0).astype(float)
    nm = line.wavelength.values
    seen = np.interp(nm, line.irradiance_wavelength.values, light)
    beside = np.interp(nm, [755.0, 772.0], [np.interp(at, nm, seen) for at in (755.0, 772.0)])
    path = np.where((nm > 755.0) & (nm < 772.0), np.minimum(seen / beside, 1.0), 1.0) ** 0.01
    cube = line.radiance.transpose("along_track", "band", "cross_track")
    deeper = line.assign(radiance=cube.copy(data=(cube.values * path[:, None]).astype("f4")))
    before, after = hp.alignment.compared(line), hp.alignment.compared(deeper)
    assert before is not None
    assert after is not None
    assert not after.is_significant()
    assert abs(after.width - before.width) < 0.015


# --- the record alone against the sun's lines ---------------------------------------------------------------


@pytest.mark.parametrize("width", [3.0, 4.0])
def test_a_simulated_record_is_found(width: float) -> None:
    record = simulate_line(lines=4, columns=4, bands=4, irradiance_fwhm_nm=width, seed=311)
    seen = record.irradiance.values.mean(axis=0).astype(float)
    found = record_against_sun(record.irradiance_wavelength.values - 0.33, seen)
    assert found is not None
    assert abs(found.shift - 0.33) < 2 * found.shift_u < 0.3
    assert abs(found.width - width) < 2 * found.width_u < 1.0


def test_a_record_of_few_channels_says_nothing() -> None:
    channels = np.arange(400.0, 1000.0, 10.0)
    assert record_against_sun(channels, np.ones(channels.size)) is None


def test_without_a_sun_what_is_believed_before_divides() -> None:
    apart = divided((-0.5, 0.01), (1.0, 0.01), None, (3.0, 6.0))
    assert apart["camera_shift"] - apart["record_shift"] == pytest.approx(-0.5, abs=0.01)
    assert apart["record_shift"] > -apart["camera_shift"] > 0.0
    assert apart["record_fwhm"] == pytest.approx(3.0)


@pytest.mark.real_data
def test_a_real_field_spectrometer_stands_eight_tenths_off(shared_data: Path) -> None:
    # Real irradiance of an ASD; its three windows agree to 0.15 nm. No other measurement of it is known.
    text = (shared_data / "asd_ascii" / "asd-e-irrad-sky.tsv").read_text(errors="replace")
    cells = [line.split("\t") for line in text.splitlines()]
    rows = [(float(one[0]), float(one[1])) for one in cells if len(one) == 2 and one[0].isdigit()]
    channels, seen = np.array(rows).T
    found = record_against_sun(channels, seen)
    assert found is not None
    assert found.shift == pytest.approx(-0.8, abs=0.1)
    assert 2.5 < found.width < 4.5
