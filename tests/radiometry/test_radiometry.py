"""Counts to reflectance: the equations, darks, panels and tilt, smile, and what is refused."""

from typing import Any

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings, strategies as st
from support.refusals import expect_refusals, refusal
from support.strategies import SHIFT, START, assert_same, flight, labelled, values

import hyperpaint as hp
from hyperpaint.base.errors import PaintWarning, SchemaError, UnitsError
from hyperpaint.base.schema import Quality
from hyperpaint.radiometry.counts_to_reflectance import (
    radiance,
    reflectance,
)
from hyperpaint.radiometry.example_pixel import worked_example
from hyperpaint.radiometry.panels import Panel

# ------------------------------------------------------------------------------------------ the equations


def test_worked_example_with_gains_built_by_hand() -> None:
    # the whole chain of the example, from the monochromator on
    etendue, t_obs, t_ref, b_obs, b_ref = 1.8598e-11, 5e-3, 50e-3, 6.0, 2.0
    spacing, peak, flux, area = 600 / 271, 2.0e16, 3.0e-12, np.sqrt(np.pi / (4 * np.log(2)))
    counts = t_obs * etendue * (0.40 * 1.30 / np.pi) * peak * area * b_obs
    line_area = t_ref * flux * peak * area * b_obs / spacing
    amplitude = t_ref * flux * peak * b_obs / np.hypot(b_obs, b_ref)
    assert counts == pytest.approx(1966.09, abs=0.005)
    assert line_area == pytest.approx(8654.12, abs=0.01)
    assert amplitude == pytest.approx(2846.05, abs=0.01)
    by_area = flux * t_ref / (etendue * spacing * line_area)
    by_fit = flux * t_ref / (etendue * amplitude * area * np.hypot(b_obs, b_ref))
    assert by_area == pytest.approx(by_fit, rel=1e-12)
    for gain in (by_area, by_fit):
        line = worked_example()
        line["radiance_gain"] = line.radiance_gain.copy(data=np.full((3, 3), gain, np.float32))
        line["counts"] = line.counts.copy(data=np.full((1, 3, 3), 1966.09 + 100, np.float32))
        np.testing.assert_allclose(radiance(line).radiance.values, 0.165521, atol=5e-7)
        np.testing.assert_allclose(values(line), 0.400000, atol=1e-6)


@settings(max_examples=15)
@given(
    seed=st.integers(0, 2**31),
    exposure=st.floats(1e-4, 0.1),
    dark=st.floats(0, 300),
    level=st.floats(0.1, 2.0),
)
def test_closure_from_reflectance_to_counts_and_back(
    seed: int, exposure: float, dark: float, level: float
) -> None:
    made = flight(lines=5, bands=6, columns=4, seed=seed, exposure=exposure, dark=dark, level=level, drift=0)
    # light scales the counts: keep them below saturation whatever it is
    line = made.line.assign(saturation_count=made.line.saturation_count * 100)
    np.testing.assert_allclose(values(line), made.reflectance, rtol=1e-5)
    np.testing.assert_allclose(radiance(line).radiance.values, made.radiance, rtol=1e-5)


def test_linear_light_is_reproduced_exactly() -> None:
    made = flight(lines=900, bands=2, columns=3, drift=0.02)
    # over 6.3 s of a record every 2 s, so that lines fall on all sides of samples
    np.testing.assert_allclose(values(made.line), made.reflectance, rtol=1e-5)


def test_the_wrong_neighbour_in_time_would_be_seen() -> None:
    made = flight(lines=4, drift=0.2, level=0.2)
    made.line["saturation_count"].values[()] = 1e6
    np.testing.assert_allclose(values(made.line), made.reflectance, rtol=1e-5)
    late = made.line.assign_coords(irradiance_time=made.line.irradiance_time + np.timedelta64(2, "s"))
    assert np.abs(values(late) / made.reflectance - 1).min() > 0.1  # 2 s late


def test_twice_the_exposure_changes_counts_and_nothing_else() -> None:
    short, long = flight(exposure=4e-3, seed=3), flight(exposure=8e-3, seed=3)
    gain = short.line.radiance_gain
    signal = (short.line.counts - short.line.dark_counts).transpose(*short.line.counts.dims)
    line = long.line.assign(radiance_gain=gain, saturation_count=long.line.saturation_count * 3)
    twice = (2.0 * signal + line.dark_counts).transpose(*signal.dims).astype(np.float32)
    line["counts"] = line.counts.copy(data=twice.values)
    np.testing.assert_allclose(values(line), values(short.line), rtol=2e-5)


def test_exposure_may_change_from_line_to_line() -> None:
    made = flight()
    factor = np.linspace(0.5, 2.0, 24)
    above = (made.line.counts - made.line.dark_counts).transpose(*made.line.counts.dims).values
    counts = above * factor[:, None, None] + made.line.dark_counts.values
    line = made.line.assign(saturation_count=made.line.saturation_count * 3)
    line["counts"] = made.line.counts.copy(data=counts.astype(np.float32))
    line["exposure_time"] = ("along_track", 5e-3 * factor, {"units": "s"})
    with pytest.warns(PaintWarning, match="dark-exposure-missing"):
        np.testing.assert_allclose(values(line), made.reflectance, rtol=2e-5)


def test_altitude_never_enters() -> None:
    line = flight(position=True).line
    high = line.assign_coords(altitude=line.altitude * 2)
    assert_same(reflectance(line), reflectance(high))
    assert_same(reflectance(line), reflectance(line.drop_vars("altitude")))


def test_brighter_light_leaves_reflectance_and_spectralon_is_099() -> None:
    dim = flight(level=0.6, drift=0.0, seed=5)
    bright = flight(level=1.2, drift=0.0, seed=5)
    np.testing.assert_allclose(values(dim.line), values(bright.line), rtol=2e-5)
    made = flight(flat=True)
    above = (made.line.counts - made.line.dark_counts).transpose(*made.line.counts.dims)
    spectralon = (above * (0.99 / 0.4) + made.line.dark_counts).transpose(*above.dims).astype(np.float32)
    line = made.line.assign(counts=made.line.counts.copy(data=spectralon.values))
    np.testing.assert_allclose(values(line), 0.99, rtol=1e-5)


def test_units_are_converted_and_not_guessed() -> None:
    line = flight().line
    other = line.copy()
    other["exposure_time"] = ((), 5, {"units": "ms"})  # an integer: 5 * 0.001 must not become 0
    other["irradiance"] = (line.irradiance * 100).assign_attrs(units="uW cm-2 nm-1")
    other["radiance_gain"] = (line.radiance_gain * 100).assign_attrs(units="uW cm-2 sr-1 nm-1 s count-1")
    other["wavelength"] = (line.wavelength / 1000).assign_attrs(units="Micrometers")
    other["irradiance_max_gap"] = ((), 5.0 / 60, {"units": "min"})
    got = reflectance(other)
    np.testing.assert_allclose(got.reflectance.values, values(line), rtol=2e-6)
    assert got.exposure_time.attrs["units"] == "ms"  # the input as it was
    power = line.copy()
    power["irradiance"] = line.irradiance.assign_attrs(units="W m-2 nm-1 sr-1")
    with pytest.raises(SchemaError, match=r"irradiance.*sr-1"):
        reflectance(power)
    bare = line.copy()
    bare["irradiance"] = line.irradiance.drop_attrs()
    bare["exposure_time"] = line.exposure_time.drop_attrs()
    with pytest.raises(SchemaError) as caught:
        reflectance(bare)
    assert "'irradiance' has no units" in str(caught.value) or "'exposure_time' has no units" in str(
        caught.value
    )


def test_from_radiance_when_there_are_no_counts() -> None:
    made = flight()
    calibrated = radiance(made.line).drop_vars(["counts", "radiance_gain", "dark_counts", "exposure_time"])
    np.testing.assert_allclose(values(calibrated), made.reflectance, rtol=1e-5)
    # a vendor's cube of scaled integers
    scaled = calibrated.copy()
    whole = (calibrated.radiance * 1e5).round().astype(np.uint16)
    scaled["radiance"] = whole.assign_attrs(units="1e-5 W m-2 sr-1 nm-1")
    np.testing.assert_allclose(values(scaled), made.reflectance, atol=5e-5 / 1.2 * np.pi)
    stored_only = reflectance(made.line)[["reflectance"]]
    assert reflectance(stored_only).reflectance.identical(stored_only.reflectance)


# ------------------------------------------------------------------------------------------------- darks


def test_dark_of_every_line_is_between_the_darks_around_it() -> None:
    made = flight()
    line = made.line
    low, high = line.dark_counts.values, line.dark_counts.values + 60
    part = ((line.time.values - START) / np.timedelta64(1, "s") - 9.0) / 2.0
    counts = line.counts.values + 60 * part[:, None, None]
    line["counts"] = line.counts.copy(data=counts.astype(np.float32))
    stamps = START + np.array([11, 9, 300], "timedelta64[s]")  # not in order
    line = line.drop_vars("dark_counts").assign_coords(dark_time=("dark_time", stamps))
    line["dark_counts"] = (
        ("dark_time", "band", "cross_track"),
        np.stack([high, low, high + 500]),
        {"units": "count"},
    )
    np.testing.assert_allclose(values(line), made.reflectance, rtol=2e-5)
    # before the first and after the last one, that one is held
    held = values(line.isel(dark_time=[0, 2]))
    expected = made.reflectance - values(line)
    assert np.isfinite(held).all()
    assert np.abs(expected).max() < 1e-4
    np.testing.assert_array_equal(held, values(line.isel(dark_time=0).drop_vars("dark_time")))


def test_dark_at_two_exposures_gives_bias_and_rate() -> None:
    made = flight(exposure=5e-3)
    bias, rate = 60.0, 8000.0  # count, count per second
    line = made.line
    above = (line.counts - line.dark_counts).transpose(*line.counts.dims).values
    line["counts"] = line.counts.copy(data=(above + bias + rate * 5e-3).astype(np.float32))
    dark = np.broadcast_to(bias + rate * np.array([2e-3, 10e-3])[:, None, None], (2, 12, 6))
    line = line.drop_vars("dark_counts").assign_coords(
        dark_time=("dark_time", START + np.array([0, 1], "timedelta64[s]"))
    )
    line["dark_counts"] = (("dark_time", "band", "cross_track"), dark.astype(np.float32), {"units": "count"})
    line["dark_exposure_time"] = ("dark_time", [2.0, 10.0], {"units": "ms"})
    np.testing.assert_allclose(values(line), made.reflectance, rtol=2e-5)


def test_a_dark_at_another_exposure_is_refused() -> None:
    line = flight().line
    line["dark_exposure_time"] = ((), 20.0, {"units": "ms"})
    lazily = reflectance(line)
    with refusal(SchemaError, "dark-exposure-differs", "20 ms", " 5 ms"):
        lazily.reflectance.compute()
    line["dark_exposure_time"] = ((), 5.0, {"units": "ms"})
    reflectance(line).reflectance.compute()


def _line_with_darks_at(*exposures_ms: float) -> xr.Dataset:
    # A line at 5 ms, with darks of 90 counts and 2 a millisecond
    line = flight(exposure=5e-3).line
    element = np.ones((line.sizes["band"], line.sizes["cross_track"]), np.float32)
    dark = np.stack([(90.0 + 2.0 * ms) * element for ms in exposures_ms])
    stamps = line.time.values[0] + np.arange(len(dark)).astype("timedelta64[s]")
    dark_counts = xr.DataArray(dark, dims=("dark_time", "band", "cross_track"), attrs={"units": "count"})
    line = line.drop_vars("dark_counts").assign(dark_counts=dark_counts.assign_coords(dark_time=stamps))
    line["dark_exposure_time"] = ("dark_time", list(exposures_ms), {"units": "ms"})
    return line


@pytest.mark.parametrize("exposures_ms", [(4.0, 8.0), (2.5, 3.75), (1.0, 3.0), (6.0, 9.0)])
def test_darks_at_exposures_around_or_near_the_line_serve_in_silence(
    exposures_ms: tuple[float, ...],
) -> None:
    line = _line_with_darks_at(*exposures_ms)
    expected = (line.counts - 100.0) * line.radiance_gain / 5e-3
    found = radiance(line).radiance
    np.testing.assert_allclose(found, expected.transpose(*found.dims).where(np.isfinite(found)), rtol=1e-4)


def test_darks_beyond_their_exposures_are_warned_of_and_far_beyond_refused() -> None:
    # Rationale: darks of 1 and 2 ms served 20 ms in silence, at 26 times the noise of their means
    with pytest.warns(PaintWarning, match=r"5 ms, 3\.0 .*dark-exposure-differs"):
        radiance(_line_with_darks_at(1.0, 2.0)).radiance.compute()
    with pytest.warns(PaintWarning, match=r"5 ms, 1\.5 .*dark-exposure-differs"):
        radiance(_line_with_darks_at(20.0, 30.0)).radiance.compute()
    with refusal(SchemaError, "dark-exposure-differs", "5 ms, 15.0 "):
        radiance(_line_with_darks_at(1.0, 1.25)).radiance.compute()


def test_a_dark_without_a_value_makes_a_bad_element() -> None:
    line = flight(dtype=np.uint16).line
    line["dark_counts"].values[4, 2] = np.nan
    got = reflectance(line).compute()
    assert np.isnan(got.reflectance.values[:, 4, 2]).all()
    assert np.isfinite(got.reflectance.values).sum() == got.reflectance.size - 24
    assert (got.quality.values[:, 2] == Quality.BAD_DETECTOR).all()  # one of twelve bands
    assert (np.delete(got.quality.values, 2, axis=1) == 0).all()


# --------------------------------------------------------------------------------------- tilt and panels


@pytest.mark.filterwarnings("ignore:the irradiance fits no sky:hyperpaint.base.errors.PaintWarning")  # flat
def test_a_level_panel_changes_no_bit() -> None:
    line = flight(position=True).line
    assert_same(reflectance(line), reflectance(line, tilt=(0.0, 123.0)))
    tilted = reflectance(line, tilt=(5.0, 180.0))
    assert not np.allclose(tilted.reflectance.values, values(line))
    assert "Tilt" in tilted.reflectance.attrs["tilt"]
    assert "sky='clear'" in tilted.reflectance.attrs["tilt"]


def test_a_known_tilt_closes() -> None:
    made = flight(position=True)
    tilt = hp.Tilt(8.0, 200.0, ground_reflectance=0.15, diffuse_fraction=0.2)
    onto = tilt.factor(made.line.irradiance_time.values, 43.08, -77.67, made.line.wavelength.values)
    lit = np.array([np.interp(10 + 0.007 * k, 2.0 * np.arange(12), onto[:, 0]) for k in range(24)])
    np.testing.assert_allclose(values(made.line, tilt=tilt), made.reflectance / lit[:, None, None], rtol=2e-5)


def test_tilt_needs_a_position() -> None:
    with pytest.raises(SchemaError, match="latitude"):
        reflectance(flight().line, tilt=(5.0, 180.0))


def test_a_panel_in_the_scene_sets_the_scale() -> None:
    made = flight(flat=True)
    off = made.line.assign(radiance_gain=made.line.radiance_gain * 1.1)
    off["radiance_gain"].attrs = dict(made.line.radiance_gain.attrs)
    np.testing.assert_allclose(values(off), 0.44, rtol=1e-5)
    np.testing.assert_allclose(values(off, panel=Panel(slice(3, 8), slice(1, 4), 0.4)), 0.4, rtol=1e-5)
    known = xr.DataArray(
        np.linspace(0.3, 0.5, 12)[::-1],
        dims="wavelength",
        attrs={"units": "1"},
        coords={"wavelength": ("wavelength", off.wavelength.values[::-1], {"units": "nm"})},
    )
    # 0.44 where 0.3 to 0.5 are known: applied, and said
    with pytest.warns(PaintWarning, match=r"0\.880 to 1\.467.*panel-doubtful"):
        got = values(off, panel=Panel(slice(3, 8), slice(1, 4), known))
    np.testing.assert_allclose(got, np.broadcast_to(np.linspace(0.3, 0.5, 12)[:, None], got.shape), rtol=1e-5)
    with pytest.raises(SchemaError, match="panel-outside-line"):
        reflectance(off, panel=Panel(slice(100, 120), slice(0, 2), 0.4))


def test_a_panel_without_light_is_refused() -> None:
    line = flight().line
    line["counts"].values[3:8, :, 1:4] = 40950
    with pytest.raises(SchemaError, match="panel-empty"):
        values(line, panel=Panel(slice(3, 8), slice(1, 4), 0.4))


# -------------------------------------------------------------------------------------- smile, darkness


def test_smile_without_structure_changes_nothing() -> None:
    made = flight(smile=SHIFT)
    np.testing.assert_allclose(values(made.line), made.reflectance, rtol=1e-5)
    both = flight(smile=np.broadcast_to(SHIFT, (12, 6)) + np.linspace(-0.2, 0.2, 12)[:, None])
    np.testing.assert_allclose(values(both.line), both.reflectance, rtol=1e-5)


@pytest.mark.parametrize("smile", [None, SHIFT])
def test_without_light_there_is_no_reflectance(smile: np.ndarray | None) -> None:
    line = flight(smile=smile).line
    line["irradiance"].values[:, 120:200] = 0.0  # 520 to 600 nm: water, or a night
    got = values(line)
    assert np.isnan(got[:, (line.wavelength.values > 528) & (line.wavelength.values < 588)]).all()
    assert np.isfinite(got[:, (line.wavelength.values < 508) | (line.wavelength.values > 612)]).all()
    assert not np.isinf(got).any()


def test_bands_outside_the_record_are_missing_with_a_warning() -> None:
    line = flight().line.isel(irradiance_wavelength=slice(120, None))  # from 520 nm on
    with pytest.warns(PaintWarning, match="bands-outside-irradiance"):
        got = values(line)
    assert np.isnan(got[:, 0]).all()
    assert np.isfinite(got[:, 3:]).all()


# ------------------------------------------------------------------------------------------------ refusals


def test_all_problems_at_once() -> None:
    line = flight().line.drop_vars(["radiance_gain", "exposure_time", "fwhm"])
    line["irradiance"] = line.irradiance.assign_attrs(units="W m-2")
    line["dark_counts"] = line.dark_counts.rename(band="colour")
    with pytest.raises(SchemaError) as caught:
        reflectance(line)
    message = str(caught.value)
    for word in ("radiance_gain", "exposure_time", "fwhm", "dark_counts"):
        assert word in message


@pytest.mark.parametrize(
    ("name", "value", "word"),
    [
        ("exposure_time", -0.005, "value-out-of-range"),
        ("exposure_time", 0.0, "value-out-of-range"),
        ("exposure_time", np.nan, "value-out-of-range"),
        ("exposure_time", 500.0, "exposure-implausible"),
        ("radiance_gain", np.full((12, 6), -1e-6, "f4"), "value-out-of-range"),
        ("radiance_gain", np.full((12, 6), np.nan, "f4"), "not-finite"),
    ],
)
def test_values_that_cannot_be(name: str, value: Any, word: str) -> None:
    line = flight().line
    line[name] = line[name].copy(data=value)
    lazily = reflectance(line)
    with pytest.raises(SchemaError, match=word):
        lazily.reflectance.compute()


def test_calibration_of_another_camera() -> None:
    line, other = flight().line, flight(columns=5).line
    wrong = line.drop_vars("radiance_gain")
    gain = other.radiance_gain.values
    with pytest.raises(ValueError, match="cross_track"):
        wrong.assign(radiance_gain=(("band", "cross_track"), gain, line.radiance_gain.attrs))


def test_unreadable_units_are_named() -> None:
    line = flight().line
    line["irradiance"] = line.irradiance.assign_attrs(units="9**9**9")
    with pytest.raises((SchemaError, UnitsError), match="irradiance"):
        reflectance(line)


def test_srf_shapes_are_checked() -> None:
    line = flight().line.assign_attrs(srf_shape="round")
    with pytest.raises(SchemaError, match="round"):
        reflectance(line)


def test_tabulated_line_shapes_equal_the_gaussian_they_were_made_from() -> None:
    made = flight()
    offset = np.linspace(-14, 14, 281)
    shape = np.exp(-0.5 * (offset / (6.0 / 2.354820045)) ** 2)
    ripple = 1 + 0.4 * np.sin(made.line.irradiance_wavelength.values / 2.0)
    made.line["irradiance"].values[:] *= ripple.astype(np.float32)
    table = labelled({"srf_offset": (("srf_offset",), offset)})
    line = made.line.assign_coords(table.coords).assign_attrs(srf_shape="tabulated")
    line["srf"] = (("band", "srf_offset"), np.tile(3 * shape, (12, 1)), {"units": "1"})
    np.testing.assert_allclose(values(line), values(made.line), rtol=2e-4)


def test_worked_example_is_labelled() -> None:
    line = worked_example()
    assert all("long_name" in line[name].attrs for name in line.data_vars)


# ----------------------------------------------------------------------------------- what a review found


def test_arguments_that_cannot_be_heeded_are_refused() -> None:
    line = flight(position=True).line
    only = reflectance(line).drop_vars("counts")
    for options in ({"tilt": (3.0, 90.0)}, {"keep_bits": 12}, {"irradiance": line[["irradiance"]]}):
        with pytest.raises(SchemaError, match="option-conflict"):
            reflectance(only, **options)
    for tilt in ([5.0, 180.0], (5.0,), 5.0):
        with pytest.raises(SchemaError, match="type-wrong"):
            reflectance(line, tilt=tilt)  # type: ignore[arg-type]
    expect_refusals(
        (
            SchemaError,
            "value-out-of-range",
            "angle 120",
            "azimuth nan",
            lambda: reflectance(line, tilt=(120.0, float("nan"))),
        ),
        (
            SchemaError,
            "variable-missing",
            "'counts' with dark_counts",
            lambda: reflectance(line.drop_vars("counts")),
        ),
    )


def test_lines_of_two_exposures_have_their_own_darks() -> None:
    made = flight()
    factor = np.where(np.arange(24) % 2, 2.0, 1.0)
    rate = 20_000.0  # counts of dark a second
    above = (made.line.counts - made.line.dark_counts).transpose(*made.line.counts.dims).values
    dark = made.line.dark_counts.values + rate * 5e-3 * factor[:, None, None]
    line = made.line.assign(saturation_count=made.line.saturation_count * 3)
    line["counts"] = made.line.counts.copy(data=(above * factor[:, None, None] + dark).astype("f4"))
    line["exposure_time"] = ("along_track", 5e-3 * factor, {"units": "s"})
    darks = np.stack([made.line.dark_counts.values + rate * t for t in (5e-3, 10e-3)]).astype("f4")
    line = line.drop_vars("dark_counts")
    line["dark_counts"] = (("dark_time", "band", "cross_track"), darks, {"units": "count"})
    line["dark_exposure_time"] = ("dark_time", [5e-3, 10e-3], {"units": "s"})
    np.testing.assert_allclose(values(line), made.reflectance, rtol=5e-5)
    with pytest.raises(SchemaError, match="dark-exposure-differs"):
        values(line.isel(dark_time=[0]))


def test_radiance_as_a_start_keeps_the_slope_of_the_responsivity() -> None:
    line = flight().line
    slope = np.linspace(1.0, 3.0, line.sizes["band"])[:, None].astype("f4")
    line["radiance_gain"] = line.radiance_gain.copy(data=line.radiance_gain.values * slope)
    np.testing.assert_allclose(values(radiance(line).drop_vars("counts")), values(line), rtol=1e-6)


def test_panel_units_are_converted() -> None:
    line = flight(flat=True).line
    grey = xr.DataArray(
        [40.0, 40.0],
        dims="wavelength",
        attrs={"units": "percent"},
        coords={"wavelength": ("wavelength", [0.2, 2.0], {"units": "um"})},
    )
    region = slice(3, 8), slice(1, 4)
    np.testing.assert_allclose(values(line, panel=Panel(*region, grey)), 0.4, rtol=1e-5)
    expect_refusals(
        (UnitsError, "units-missing", lambda: values(line, panel=Panel(*region, grey.drop_attrs()))),
        (SchemaError, "value-out-of-range", lambda: Panel(*region, 50.0)),
    )


def test_choosing_bands_first_changes_nothing_for_a_slit() -> None:
    # Rationale: the pixel's width is that of the camera, not the distance of the bands that are left
    line = flight(bands=40).line.assign_attrs(srf_shape="slit")
    spacing = np.abs(np.gradient(line.wavelength.values))
    known = line.assign_coords(band_spacing=("band", spacing, {"units": "nm"}))
    whole = values(known)
    few = [3, 17, 18, 30]
    # what is left is the slope of the responsivity, which four bands cannot tell
    np.testing.assert_allclose(values(known.isel(band=few)), whole[:, few], rtol=2e-3)
    with pytest.raises(SchemaError, match="band-spacing-missing"):
        values(line.isel(band=few))
