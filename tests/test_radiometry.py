"""Counts to reflectance: physics first, then bits, chunks, laziness and refusals."""

from __future__ import annotations

import time as clock
from typing import Any

import dask
import dask.array as da
import numpy as np
import pytest
import xarray as xr
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from strategies import START, chunkings, flight, labelled, stored

import hyperpaint as hp
from hyperpaint.errors import PaintWarning, SchemaError, TimeError, UnitsError
from hyperpaint.radiometry import Panel, radiance, reflectance, subtract_dark, worked_example
from hyperpaint.schema import Quality


def values(line: xr.Dataset, **options: Any) -> np.ndarray:
    return reflectance(line, **options)["reflectance"].values


def assert_same(first: xr.Dataset, second: xr.Dataset) -> None:
    for name in ("reflectance", "quality", "irradiance_age"):
        assert first[name].values.tobytes() == second[name].values.tobytes(), name


# ------------------------------------------------------------------------------------------ the equations


def test_worked_example_with_gains_built_by_hand() -> None:
    # the whole chain of the example, from the monochromator on
    etendue, t_obs, t_ref, b_obs, b_ref = 1.8598e-11, 5e-3, 50e-3, 6.0, 2.0
    spacing, peak, flux, area = 600 / 271, 2.0e16, 3.0e-12, np.sqrt(np.pi / (4 * np.log(2)))
    truth = 0.40 * 1.30 / np.pi
    counts = t_obs * etendue * truth * peak * area * b_obs
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


@settings(max_examples=15, deadline=None)
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
    with pytest.warns(PaintWarning, match="one dark is taken for all"):
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


def test_from_radiance_keeps_every_flag_that_was_set() -> None:
    line = flight().line
    line["counts"].values[2, 3, 1] = 4095
    calibrated = radiance(line).compute().drop_vars("counts")
    got = reflectance(calibrated)
    assert got.quality.values[2, 1] & Quality.SATURATED
    assert np.isnan(got.reflectance.values[2, 3, 1])


# ------------------------------------------------------------------------------------------------- darks


def test_dark_of_every_line_is_between_the_darks_around_it() -> None:
    made = flight()
    line = made.line
    low, high = line.dark_counts.values, line.dark_counts.values + 60
    seconds = (line.time.values - START) / np.timedelta64(1, "s")
    part = (seconds - 9.0) / 2.0
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
    early = line.isel(dark_time=[0, 2])
    held = values(early)
    expected = made.reflectance - values(line)
    assert np.isfinite(held).all()
    assert np.abs(expected).max() < 1e-4
    first_only = line.isel(dark_time=0)
    np.testing.assert_array_equal(held, values(first_only.drop_vars("dark_time")))


def test_dark_at_two_exposures_gives_bias_and_rate() -> None:
    made = flight(exposure=5e-3)
    bias, rate = 60.0, 8000.0  # count, count per second
    line = made.line
    above = (line.counts - line.dark_counts).transpose(*line.counts.dims).values
    line["counts"] = line.counts.copy(data=(above + bias + rate * 5e-3).astype(np.float32))
    shape = (2, 12, 6)
    dark = np.broadcast_to(bias + rate * np.array([2e-3, 10e-3])[:, None, None], shape)
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
    with pytest.raises(SchemaError, match=r"dark was taken at 20 ms, the line at 5 ms"):
        lazily.reflectance.compute()
    line["dark_exposure_time"] = ((), 5.0, {"units": "ms"})
    reflectance(line).reflectance.compute()


def test_a_dark_without_a_value_makes_a_bad_element() -> None:
    line = flight(dtype=np.uint16).line
    line["dark_counts"].values[4, 2] = np.nan
    got = reflectance(line).compute()
    assert np.isnan(got.reflectance.values[:, 4, 2]).all()
    assert np.isfinite(got.reflectance.values).sum() == got.reflectance.size - 24
    assert (got.quality.values[:, 2] == Quality.BAD_DETECTOR).all()  # one of twelve bands
    assert (np.delete(got.quality.values, 2, axis=1) == 0).all()


def test_subtract_dark_is_a_view_of_the_signal() -> None:
    line = flight(dtype=np.uint16).line
    above = subtract_dark(line.counts, line.dark_counts)
    assert above.dtype == np.float32
    np.testing.assert_array_equal(above.values, line.counts.values.astype("f4") - line.dark_counts.values)


# ------------------------------------------------------------------------------------------------- flags


def quality_of(line: xr.Dataset) -> np.ndarray:
    return reflectance(line)["quality"].values


@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_saturation_starts_sixteen_counts_below_the_end(dtype: Any) -> None:
    line = flight(dtype=dtype).line
    line["counts"].values[3, 5, 2] = 4079
    line["counts"].values[4, 5, 2] = 4078
    got = reflectance(line).compute()
    flagged = np.argwhere(got.quality.values & Quality.SATURATED)
    np.testing.assert_array_equal(flagged, [[3, 2]])
    np.testing.assert_array_equal(np.argwhere(np.isnan(got.reflectance.values)), [[3, 5, 2]])
    assert got.quality.values.sum() == Quality.SATURATED


def test_saturation_is_judged_before_the_dark_is_taken_away() -> None:
    line = flight(dtype=np.uint16, dark=300.0).line
    line["counts"].values[0, 0, 0] = 4090  # 3790 above the dark
    assert quality_of(line)[0, 0] == Quality.SATURATED


@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_saturation_of_every_element_of_its_own(dtype: Any) -> None:
    made = flight(dtype=dtype, flat=True)
    own = np.full((12, 6), 5000.0)
    own[0, 0] = 600.0  # the first element must not speak for the others
    own[7, 3] = 700.0
    line = made.line.drop_vars("saturation_count")
    line["saturation_count"] = (("band", "cross_track"), own, {"units": "count"})
    got = reflectance(line).compute()
    missing = np.isnan(got.reflectance.values)
    assert missing[:, 0, 0].all()
    assert missing[:, 7, 3].all()
    assert missing.sum() == 48
    saturated = got.quality.values & Quality.SATURATED
    assert saturated[:, [0, 3]].all()
    assert not saturated[:, [1, 2, 4, 5]].any()


def test_unknown_saturation_of_an_element_never_saturates() -> None:
    line = flight(dtype=np.uint16).line.drop_vars("saturation_count")
    own = np.full((12, 6), 4095.0)
    own[2, 2] = np.nan
    line["saturation_count"] = (("band", "cross_track"), own, {"units": "count"})
    line["counts"].values[0, 2, 2] = 4090
    line["counts"].values[1, 2, 3] = 4090
    got = reflectance(line).compute()
    np.testing.assert_array_equal(np.argwhere(got.quality.values), [[1, 3]])


def test_a_stuck_bad_element_does_not_saturate_its_column() -> None:
    line = flight(bands=40, dtype=np.uint16).line
    line["counts"].values[:, 9, 1] = 4095
    line["radiance_gain"].values[9, 1] = np.nan
    line["counts"].values[:, 17, :] = 4095
    line["good"].values[17] = False
    got = reflectance(line).compute()
    assert not got.quality.values.any()
    assert np.isnan(got.reflectance.values[:, 9, 1]).all()
    # in a pixel where another element saturates, it does
    line["counts"].values[5, 20, 1] = 4095
    np.testing.assert_array_equal(np.argwhere(quality_of(line)), [[5, 1]])


@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_below_dark_by_five_sigma(dtype: Any) -> None:
    line = flight(bands=40, dark=100.0, dtype=dtype).line
    # five times sqrt(2^2 + 1/12) is 10.104
    line["counts"].values[1, 3, 0] = 89
    line["counts"].values[2, 3, 0] = 90 if dtype == np.uint16 else 89.95  # quantisation is noise too
    got = reflectance(line).compute()
    np.testing.assert_array_equal(np.argwhere(got.quality.values == Quality.BELOW_DARK), [[1, 0]])
    assert got.quality.values.sum() == Quality.BELOW_DARK
    assert got.reflectance.values[1, 3, 0] < 0  # kept


def test_below_dark_in_more_than_a_tenth_of_the_bands() -> None:
    line = flight(bands=40, dark=100.0, dtype=np.uint16).line
    line["counts"].values[1, :5, 0] = 99
    line["counts"].values[2, :3, 0] = 99
    line["counts"].values[3, :40:8, 1] = 100  # not under the dark
    np.testing.assert_array_equal(np.argwhere(quality_of(line)), [[1, 0]])
    line["good"].values[:2] = False
    assert not quality_of(line).any()


def test_bad_detector_only_over_five_per_cent_of_the_good_bands() -> None:
    line = flight(bands=40).line
    line["radiance_gain"].values[[1, 2], 0] = np.nan
    line["radiance_gain"].values[[1, 2, 3], 1] = np.nan
    line["radiance_gain"].values[[1, 2, 3], 2] = np.inf
    got = reflectance(line).compute()
    assert (got.quality.values[:, 1:3] == Quality.BAD_DETECTOR).all()
    assert not got.quality.values[:, [0, 3, 4, 5]].any()
    line["good"].values[3] = False  # two of 39 good bands are left
    assert (quality_of(line)[:, 1:3] == Quality.BAD_DETECTOR).all()
    line["good"].values[2] = False
    assert not quality_of(line).any()


def test_a_band_that_is_bad_everywhere_warns_nobody() -> None:
    made = flight(bands=40)
    made.line["radiance_gain"].values[7] = np.nan
    got = values(made.line)
    assert np.isnan(got[:, 7]).all()
    np.testing.assert_allclose(np.delete(got, 7, 1), np.delete(made.reflectance, 7, 1), rtol=1e-5)


def test_gaps_are_missing_and_flagged() -> None:
    made = flight(lines=900)  # 10.0 to 16.3 s
    keep = made.line.irradiance_time.values != START + np.timedelta64(12, "s")
    holed = made.line.isel(irradiance_time=keep)  # 10, 14, 16, 18 s
    wide = holed.assign(irradiance_max_gap=holed.irradiance_max_gap * 0.6)  # 3 s
    got = reflectance(wide).compute()
    seconds = (wide.time.values - START) / np.timedelta64(1, "s")
    inside = (seconds > 10) & (seconds < 14)
    assert ((got.quality.values & Quality.IRRADIANCE_GAP != 0) == inside[:, None]).all()
    assert (np.isnan(got.reflectance.values) == inside[:, None, None]).all()
    np.testing.assert_allclose(got.reflectance.values[~inside], made.reflectance[~inside], rtol=1e-5)
    # on a sample there is light, whatever the gap beside it
    assert np.isfinite(got.reflectance.values[0]).all()
    assert got.quality.values[0, 0] == 0
    # 5 s are allowed: linear light comes out right
    np.testing.assert_allclose(values(holed), made.reflectance, rtol=1e-5)


def test_nothing_is_extrapolated() -> None:
    made = flight(lines=900)
    short = made.line.isel(irradiance_time=slice(6, 8))  # 12 and 14 s
    got = reflectance(short).compute()
    seconds = (short.time.values - START) / np.timedelta64(1, "s")
    outside = (seconds < 12) | (seconds > 14)
    assert (np.isnan(got.reflectance.values) == outside[:, None, None]).all()
    assert ((got.quality.values == Quality.IRRADIANCE_GAP) == outside[:, None]).all()
    age = np.minimum(np.abs(seconds - 12), np.abs(seconds - 14))
    np.testing.assert_allclose(got.irradiance_age.values, age, atol=1e-6)
    assert got.irradiance_age.dtype == np.float32


def test_a_spectrum_with_holes_is_left_out() -> None:
    made = flight(lines=300)
    made.line["irradiance"].values[6, 100:120] = np.nan  # at 12 s
    got = reflectance(made.line).compute()
    np.testing.assert_allclose(got.reflectance.values, made.reflectance, rtol=1e-5)
    assert got.irradiance_age.values.max() > 1.9


@pytest.mark.parametrize(("change", "flagged"), [(0.019, False), (0.021, True), (-0.0206, True)])
def test_unstable_light_over_two_per_cent(change: float, flagged: bool) -> None:
    line = flight(lines=300, drift=0.0).line  # 10.0 to 12.1 s
    line["irradiance"].values[6:] *= 1 + change
    quality = quality_of(line)
    between = line.time.values < START + np.timedelta64(12, "s")
    assert ((quality == Quality.ILLUMINATION_UNSTABLE) == (between[:, None] & flagged)).all()


def test_low_sun_needs_a_position() -> None:
    made = flight(position=True)
    evening = np.timedelta64(6 * 3600 + 40 * 60, "s")  # zenith about 82 degrees
    line = made.line.assign_coords(
        time=made.line.time + evening, irradiance_time=made.line.irradiance_time + evening
    )
    assert (quality_of(line) == Quality.LOW_SUN).all()
    assert not quality_of(line.drop_vars(["latitude", "longitude"])).any()
    assert not quality_of(made.line).any()


def test_dropped_frames_are_no_data_and_nothing_else() -> None:
    made = flight(dtype=np.uint16, position=True)
    line = made.line
    line["counts"].values[5] = 65535
    stamps = line.time.values.copy()
    stamps[5] = np.datetime64("NaT", "ns")
    line = line.assign_coords(time=("along_track", stamps))
    for got, name in ((reflectance(line), "reflectance"), (radiance(line), "radiance")):
        assert (got.quality.values[5] == Quality.NO_DATA).all()
        assert not np.delete(got.quality.values, 5, axis=0).any()
        assert np.isnan(got[name].values[5]).all()
        assert np.isfinite(np.delete(got[name].values, 5, axis=0)).all()
    assert np.isnan(reflectance(line).irradiance_age.values[5])


def test_flags_of_others_stay() -> None:
    line = flight(dtype=np.uint16).line
    found = np.zeros((24, 6), np.uint16)
    found[2, 3] = Quality.GLINT | Quality.SATURATED  # the second is found anew, from counts
    found[4, 1] = Quality.SHADOW
    line["quality"] = (("along_track", "cross_track"), found)
    line["counts"].values[7, 0, 0] = 4095
    quality = quality_of(line)
    assert quality[2, 3] == Quality.GLINT
    assert quality[4, 1] == Quality.SHADOW
    assert quality[7, 0] == Quality.SATURATED
    assert np.count_nonzero(quality) == 3
    again = reflectance(reflectance(line)).quality.values
    np.testing.assert_array_equal(again, quality)


def test_quality_attributes_follow_cf() -> None:
    attrs = reflectance(flight().line).quality.attrs
    assert attrs["flag_masks"].dtype == np.uint16
    assert len(attrs["flag_meanings"].split()) == len(attrs["flag_masks"])
    assert "units" not in attrs


# -------------------------------------------------------------------------------------------------- time


@pytest.mark.parametrize("line_unit", ["s", "ms", "us", "ns"])
@pytest.mark.parametrize("record_unit", ["s", "us", "ns"])
def test_mixed_units_of_time(line_unit: str, record_unit: str) -> None:
    made = flight(lines=4, bands=3, columns=2, drift=0.05)
    line = made.line
    # whole seconds, so that every unit can hold them
    seconds = np.array([1, 3, 9, 21])
    line = line.assign_coords(time=("along_track", START + seconds.astype("timedelta64[s]")))
    expected = values(line)
    mixed = line.assign_coords(
        time=("along_track", line.time.values.astype(f"datetime64[{line_unit}]")),
        irradiance_time=("irradiance_time", line.irradiance_time.values.astype(f"datetime64[{record_unit}]")),
    )
    np.testing.assert_array_equal(values(mixed), expected)
    light = 1.2 + 0.05 * seconds
    np.testing.assert_allclose(
        expected, made.reflectance * (made.irradiance / light)[:, None, None], rtol=1e-5
    )


def test_shuffled_lines_come_out_in_their_places() -> None:
    line = flight(lines=300, drift=0.05).line
    order = np.random.default_rng(1).permutation(300)
    got, expected = reflectance(line.isel(along_track=order)), reflectance(line).isel(along_track=order)
    assert_same(got, expected)


def test_records_that_run_backwards_or_stand_still_are_refused() -> None:
    line = flight().line
    for order, word in (([0, 1, 1, 2, 3, 4, 5, 6], "duplicate"), ([0, 2, 1, 3, 4, 5, 6], "backwards")):
        with pytest.raises(TimeError, match=word):
            reflectance(line.isel(irradiance_time=order))
    stamps = line.irradiance_time.values.copy()
    stamps[3] = np.datetime64("NaT", "ns")
    with pytest.raises(TimeError, match="NaT"):
        reflectance(line.assign_coords(irradiance_time=("irradiance_time", stamps)))


def test_a_lazy_record_is_refused_when_it_is_read() -> None:
    line = flight().line.isel(irradiance_time=[0, 2, 1, 3, 4, 5, 6]).drop_indexes("irradiance_time")
    lazily = line.assign_coords(
        irradiance_time=("irradiance_time", da.from_array(line.irradiance_time.values))
    )
    with pytest.raises(TimeError, match="backwards"):
        reflectance(lazily).reflectance.compute()


def test_clocks_that_are_off() -> None:
    made = flight(drift=0.01)
    offset = np.timedelta64(37_250_000_000, "ns")
    wrong = made.line.assign_coords(irradiance_time=made.line.irradiance_time + offset)
    got = reflectance(wrong).compute()  # the record begins 27 s after the line
    assert np.isnan(got.reflectance.values).all()
    assert (got.quality.values == Quality.IRRADIANCE_GAP).all()
    np.testing.assert_array_equal(
        values(wrong.assign_coords(irradiance_time=wrong.irradiance_time - offset)), values(made.line)
    )
    hours = np.timedelta64(5 * 3600, "s")
    local = made.line.assign_coords(time=made.line.time - hours)
    assert np.isnan(values(local)).all()
    both = local.assign_coords(irradiance_time=local.irradiance_time - hours)
    np.testing.assert_array_equal(values(both), values(made.line))


def test_a_record_of_its_own_replaces_the_lines() -> None:
    made = flight()
    record = made.line[["irradiance", "irradiance_fwhm"]].assign_attrs(irradiance_srf_shape="gaussian")
    twice = record.assign(irradiance=record.irradiance * 2).isel(irradiance_time=slice(2, 9))
    twice["irradiance"].attrs = dict(record.irradiance.attrs)
    np.testing.assert_allclose(values(made.line, irradiance=twice), made.reflectance / 2, rtol=1e-5)
    bare = made.line.drop_vars([n for n in made.line.variables if str(n).startswith("irradiance")])
    np.testing.assert_allclose(values(bare, irradiance=twice), made.reflectance / 2, rtol=1e-5)
    with pytest.raises(SchemaError, match="holds light, expected"):
        reflectance(bare, xr.Dataset({"light": 1}))


# --------------------------------------------------------------------------------------- tilt and panels


def test_a_level_panel_changes_no_bit() -> None:
    line = flight(position=True).line
    assert_same(reflectance(line), reflectance(line, tilt=(0.0, 123.0)))
    tilted = reflectance(line, tilt=(5.0, 180.0))
    assert not np.allclose(tilted.reflectance.values, values(line))
    assert "Tilt" in tilted.reflectance.attrs["tilt"]


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
    panel = Panel(slice(3, 8), slice(1, 4), 0.4)
    np.testing.assert_allclose(values(off, panel=panel), 0.4, rtol=1e-5)
    known = xr.DataArray(
        np.linspace(0.3, 0.5, 12)[::-1],
        dims="wavelength",
        attrs={"units": "1"},
        coords={"wavelength": ("wavelength", off.wavelength.values[::-1], {"units": "nm"})},
    )
    got = values(off, panel=Panel(slice(3, 8), slice(1, 4), known))
    np.testing.assert_allclose(got, np.broadcast_to(np.linspace(0.3, 0.5, 12)[:, None], got.shape), rtol=1e-5)
    with pytest.raises(SchemaError, match="holds none"):
        reflectance(off, panel=Panel(slice(100, 120), slice(0, 2), 0.4))


def test_a_panel_without_light_is_refused() -> None:
    line = flight().line
    line["counts"].values[3:8, :, 1:4] = 4095
    with pytest.raises(SchemaError, match="no valid pixel"):
        values(line, panel=Panel(slice(3, 8), slice(1, 4), 0.4))


# ------------------------------------------------------------------------------------------ bits, chunks

SHIFT = np.linspace(-1.4, 1.2, 6) ** 2


@pytest.fixture(scope="module")
def hard_line() -> xr.Dataset:
    """Every branch at once: smile, two darks, saturation, bad elements, a dropped frame, a gap."""
    line = flight(lines=40, bands=12, columns=6, dtype=np.uint16, smile=SHIFT, position=True, drift=0.01).line
    rng = np.random.default_rng(4)
    line["counts"].values[rng.random((40, 12, 6)) < 0.01] = 4095
    line["radiance_gain"].values[3, 4] = np.nan
    stamps = line.time.values.copy() + np.arange(40) * np.timedelta64(300_000_000, "ns")
    stamps[11] = np.datetime64("NaT", "ns")
    dark = line.dark_counts.values
    line = line.drop_vars("dark_counts").assign_coords(
        time=("along_track", stamps),
        dark_time=("dark_time", START + np.array([0, 30], "timedelta64[s]")),
    )
    line["dark_counts"] = (
        ("dark_time", "band", "cross_track"),
        np.stack([dark, dark + 3]),
        {"units": "count"},
    )
    return line


@pytest.mark.parametrize("scheduler", ["synchronous", "threads"])
@pytest.mark.parametrize(
    "chunks",
    [
        {"along_track": 1},
        {"along_track": 7, "band": -1, "cross_track": -1},
        {"along_track": 40},
        {"along_track": 16, "band": 5},
        {"along_track": (3, 30, 7), "band": (1, 11), "cross_track": (4, 2)},
    ],
)
def test_the_same_bits_whatever_the_chunks(hard_line: xr.Dataset, chunks: Any, scheduler: str) -> None:
    with dask.config.set(scheduler="synchronous"):
        whole = reflectance(hard_line, keep_bits=12).compute()
    with dask.config.set(scheduler=scheduler):
        assert_same(whole, reflectance(hard_line.chunk(chunks), keep_bits=12).compute())


def test_the_same_bits_in_other_processes(hard_line: xr.Dataset) -> None:
    line = hard_line.chunk({"along_track": 20})
    with dask.config.set(scheduler="processes", num_workers=1):
        other = reflectance(line)[["reflectance", "quality", "irradiance_age"]].compute()
    assert_same(reflectance(line), other)


@settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_the_same_bits_for_any_chunks(hard_line: xr.Dataset, data: st.DataObject) -> None:
    chunks = {
        dim: data.draw(chunkings(hard_line.sizes[dim]), label=dim)
        for dim in ("along_track", "band", "cross_track")
    }
    with dask.config.set(scheduler="synchronous"):
        assert_same(reflectance(hard_line), reflectance(hard_line.chunk(chunks)))


def test_any_order_of_dims(hard_line: xr.Dataset) -> None:
    turned = hard_line.transpose("cross_track", "band", "along_track", ...)
    assert_same(reflectance(hard_line), reflectance(turned))
    other = hard_line.rename_dims(along_track="downtrack", band="bands", cross_track="crosstrack")
    assert_same(reflectance(hard_line), other.paint.reflectance())


@pytest.mark.parametrize("dtype", ["uint8", ">u2", "int16", "int32", "float64", "float32"])
def test_counts_of_other_types(dtype: str) -> None:
    line = flight(dtype=np.uint16).line
    line["counts"].values[:] = line.counts.values // 20
    np.testing.assert_array_equal(values(line.assign(counts=line.counts.astype(dtype))), values(line))


def test_rounding_keeps_the_bits_that_were_asked_for() -> None:
    line = flight().line
    full, rounded = values(line), values(line, keep_bits=12)
    np.testing.assert_allclose(rounded, full, rtol=2.0**-13)
    assert not (rounded.view(np.uint32) & ((1 << 11) - 1)).any()
    np.testing.assert_array_equal(values(line, keep_bits=23), full)
    for bad in (0, 24, -1):
        with pytest.raises(SchemaError, match="keep_bits"):
            reflectance(line, keep_bits=bad)


# -------------------------------------------------------------------------------------- smile, darkness


def test_smile_without_structure_changes_nothing() -> None:
    made = flight(smile=SHIFT)
    np.testing.assert_allclose(values(made.line), made.reflectance, rtol=1e-5)
    shift = np.broadcast_to(SHIFT, (12, 6)) + np.linspace(-0.2, 0.2, 12)[:, None]
    both = flight(smile=shift)
    np.testing.assert_allclose(values(both.line), both.reflectance, rtol=1e-5)


@pytest.mark.parametrize("smile", [None, SHIFT])
def test_without_light_there_is_no_reflectance(smile: np.ndarray | None) -> None:
    line = flight(smile=smile).line
    line["irradiance"].values[:, 120:200] = 0.0  # 520 to 600 nm: water, or a night
    got = values(line)
    dark = (line.wavelength.values > 528) & (line.wavelength.values < 588)
    assert np.isnan(got[:, dark]).all()
    far = (line.wavelength.values < 508) | (line.wavelength.values > 612)
    assert np.isfinite(got[:, far]).all()
    assert not np.isinf(got).any()


def test_bands_outside_the_record_are_missing_with_a_warning() -> None:
    line = flight().line.isel(irradiance_wavelength=slice(120, None))  # from 520 nm on
    with pytest.warns(PaintWarning, match="outside the irradiance record"):
        got = values(line)
    assert np.isnan(got[:, 0]).all()
    assert np.isfinite(got[:, 3:]).all()


# ------------------------------------------------------------------------------------------------- lazy


def test_nothing_is_read_while_building(tmp_path: Any, hard_line: xr.Dataset, no_compute: Any) -> None:
    line = stored(hard_line, tmp_path / "line.zarr")
    assert line.time.chunks is not None  # non-index coordinates are lazy too
    with no_compute():
        made = reflectance(line, panel=Panel(slice(0, 4), slice(0, 3), 0.4), tilt=(3.0, 90.0))
        calibrated = line.paint.radiance()
        for name, array in (("reflectance", made), ("radiance", calibrated)):
            assert array[name].dtype == np.float32
            assert array[name].chunks is not None
            assert array.quality.dtype == np.uint16
            assert array[name].dims == ("along_track", "band", "cross_track")
            assert array.quality.dims == ("along_track", "cross_track")
        assert made.irradiance_age.dtype == np.float32
        smoothed = made.paint.smooth()
    for name in ("reflectance", "quality", "irradiance_age"):
        assert made[name].compute().dtype == made[name].dtype
        assert made[name].compute().shape == made[name].shape
    assert smoothed.reflectance.compute().dtype == np.float32
    assert_same(reflectance(hard_line), reflectance(line))


def test_lazy_from_radiance(tmp_path: Any, no_compute: Any) -> None:
    line = radiance(flight().line).drop_vars("counts").compute()
    lazily = stored(line, tmp_path / "radiance.zarr")
    with no_compute():
        made = reflectance(lazily)
    assert_same(reflectance(line), made)


def test_two_tasks_a_slab_at_the_most(tmp_path: Any) -> None:
    sizes = {}
    for lines in (16, 96):
        line = stored(flight(lines=lines).line, tmp_path / f"{lines}.zarr")
        (fused,) = dask.optimize(line.paint.reflectance()["reflectance"])
        sizes[lines] = len(fused.__dask_graph__())
    assert (sizes[96] - sizes[16]) / 10 <= 2


def test_graph_of_a_long_line_is_quick(no_compute: Any, record_property: Any) -> None:
    line = flight(lines=1, bands=272, columns=640).line
    lines = 100_000
    long = line.drop_dims("along_track").assign_coords(
        time=("along_track", START + np.arange(lines) * np.timedelta64(7_000_000, "ns"))
    )
    cube = da.zeros((lines, 272, 640), chunks=(32, -1, -1), dtype=np.uint16)
    long["counts"] = (("along_track", "band", "cross_track"), cube, {"units": "count"})
    begin = clock.perf_counter()
    with no_compute():
        made = reflectance(long)["reflectance"]
        dask.optimize(made)
    spent = clock.perf_counter() - begin
    record_property("seconds", spent)
    assert spent < 2.0


def test_inputs_are_never_changed(hard_line: xr.Dataset) -> None:
    before = hard_line.copy(deep=True)
    reflectance(hard_line, tilt=(2.0, 10.0), panel=Panel(slice(0, 4), slice(0, 3), 0.4)).compute()
    radiance(hard_line).compute()
    xr.testing.assert_identical(hard_line, before)


@pytest.mark.parametrize("keep", [True, False, "default"])
def test_attributes_are_replaced(keep: Any) -> None:
    line = flight().line
    line["counts"].attrs["comment"] = "stale"
    with xr.set_options(keep_attrs=keep):
        made = reflectance(line)
        bright = radiance(line)
    assert made.reflectance.attrs["units"] == "1"
    assert made.reflectance.attrs["long_name"]
    assert "comment" not in made.reflectance.attrs
    assert bright.radiance.attrs["units"] == "W m-2 sr-1 nm-1"
    assert made.irradiance_age.attrs["units"] == "s"
    assert made.quality.attrs["flag_meanings"].startswith("saturated below_dark")
    assert made.attrs["name"] == "raw_0"
    assert set(line.variables) < set(made.variables)


def test_stored_reflectance_is_always_computed_anew() -> None:
    made = flight()
    stale = made.line.assign(reflectance=made.line.counts.assign_attrs(units="1"))
    np.testing.assert_allclose(values(stale), made.reflectance, rtol=1e-5)


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
        ("exposure_time", -0.005, "positive"),
        ("exposure_time", 0.0, "positive"),
        ("exposure_time", np.nan, "positive"),
        ("exposure_time", 500.0, "milliseconds"),
        ("radiance_gain", np.full((12, 6), -1e-6, "f4"), "positive"),
        ("radiance_gain", np.full((12, 6), np.nan, "f4"), "no finite value"),
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


def test_radiance_leaves_the_bits_of_light_alone() -> None:
    line = flight().line
    line["irradiance_max_gap"] = ((), 0.01, {"units": "s"})
    lit = reflectance(line).compute()
    assert (lit.quality & Quality.IRRADIANCE_GAP).any()
    np.testing.assert_array_equal(radiance(lit).quality, lit.quality)


def test_another_record_brings_its_own_gap_and_width() -> None:
    line = flight().line
    step = float(np.diff(line.irradiance_time.values)[0] / np.timedelta64(1, "s"))
    line = line.assign(irradiance_max_gap=((), 1.5 * step, {"units": "s"}))
    other = line[["irradiance", "irradiance_fwhm"]].isel(irradiance_time=slice(None, None, 2))
    assert (
        reflectance(line.isel(irradiance_time=slice(None, None, 2))).quality & Quality.IRRADIANCE_GAP
    ).any()
    assert not (reflectance(line, other).quality & Quality.IRRADIANCE_GAP).any()
    with pytest.raises(SchemaError, match="irradiance_fwhm"):
        reflectance(line, other.drop_vars("irradiance_fwhm"))
    with pytest.raises(SchemaError, match="is DataArray, expected a Dataset"):
        reflectance(line, other.irradiance)  # type: ignore[arg-type]


def test_arguments_that_cannot_be_heeded_are_refused() -> None:
    line = flight(position=True).line
    only = reflectance(line).drop_vars("counts")
    for options in ({"tilt": (3.0, 90.0)}, {"keep_bits": 12}, {"irradiance": line[["irradiance"]]}):
        with pytest.raises(SchemaError, match="found 'reflectance' only"):
            reflectance(only, **options)
    for tilt in ([5.0, 180.0], (5.0,), 5.0):
        with pytest.raises(SchemaError, match=r"expected hyperpaint\.Tilt"):
            reflectance(line, tilt=tilt)  # type: ignore[arg-type]
    with pytest.raises(SchemaError, match=r"angle 120.*\n.*azimuth nan"):
        reflectance(line, tilt=(120.0, float("nan")))
    with pytest.raises(SchemaError, match="expected 'counts' with dark_counts"):
        reflectance(line.drop_vars("counts"))


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
    with pytest.raises(SchemaError, match="take a dark at the line's exposure"):
        values(line.isel(dark_time=[0]))


def test_below_dark_follows_a_drifting_dark() -> None:
    line = flight(dtype=np.uint16).line
    level = line.dark_counts.values
    drift = np.array([-10.0, 10.0], "f4")[:, None, None]
    span = line.time.values[[0, -1]]
    line = line.drop_vars("dark_counts")
    line["dark_counts"] = (("dark_time", "band", "cross_track"), level + drift, {"units": "count"})
    line = line.assign_coords(dark_time=span)
    weight = ((line.time.values - span[0]) / (span[1] - span[0]))[:, None, None]
    dark = np.broadcast_to(level - 10 + 20 * weight, line.counts.shape)

    def flags(offset: float) -> xr.DataArray:
        counts = np.ceil(dark + offset).clip(0).astype("u2")
        return reflectance(line.assign(counts=line.counts.copy(data=counts))).quality & Quality.BELOW_DARK

    assert not flags(1.0).any()
    assert flags(-8.0).all()


def test_radiance_as_a_start_keeps_the_slope_of_the_responsivity() -> None:
    line = flight().line
    slope = np.linspace(1.0, 3.0, line.sizes["band"])[:, None].astype("f4")
    line["radiance_gain"] = line.radiance_gain.copy(data=line.radiance_gain.values * slope)
    start = radiance(line).drop_vars("counts")
    np.testing.assert_allclose(values(start), values(line), rtol=1e-6)


def test_one_spectrum_with_more_than_the_others_costs_nothing() -> None:
    line = flight().line
    spectra = np.repeat(line.irradiance.values, 5, axis=0)
    spectra[1:, -2:] = np.nan  # all but one end early
    when = line.irradiance_time.values[0] + np.arange(len(spectra)) * np.timedelta64(1, "s")
    record = xr.Dataset(
        {"irradiance": (line.irradiance.dims, spectra, {"units": "W m-2 nm-1"})},
        {"irradiance_time": when, "irradiance_wavelength": line.irradiance_wavelength},
    ).assign(irradiance_fwhm=line.irradiance_fwhm)
    assert not (reflectance(line, record).quality & Quality.IRRADIANCE_GAP).any()


def test_a_long_record_does_not_weigh_on_the_tasks() -> None:
    line = flight().line
    when = line.irradiance_time.values[0] + np.arange(5000) * np.timedelta64(1, "s")
    record = xr.Dataset(
        {
            "irradiance": (
                line.irradiance.dims,
                np.repeat(line.irradiance.values[:1], 5000, 0),
                {"units": "W m-2 nm-1"},
            )
        },
        {"irradiance_time": when, "irradiance_wavelength": line.irradiance_wavelength},
    ).assign(irradiance_fwhm=line.irradiance_fwhm)
    made = reflectance(line, record).reflectance.data
    (key,) = (key for key in made.dask if str(key).startswith("make_plan"))
    plan = dask.get(dict(made.dask), key)
    assert len(plan.series) < 100


def test_panel_units_are_converted() -> None:
    line = flight(flat=True).line
    half = xr.DataArray(
        [50.0, 50.0],
        dims="wavelength",
        attrs={"units": "percent"},
        coords={"wavelength": ("wavelength", [0.2, 2.0], {"units": "um"})},
    )
    region = slice(3, 8), slice(1, 4)
    np.testing.assert_allclose(values(line, panel=Panel(*region, half)), 0.5, rtol=1e-5)
    with pytest.raises(UnitsError, match="no units"):
        values(line, panel=Panel(*region, half.drop_attrs()))
    with pytest.raises(SchemaError, match="expected 0 to 1"):
        Panel(*region, 50.0)


def test_choosing_bands_first_changes_nothing_for_a_slit() -> None:
    """Rationale: the pixel's width is that of the camera, not the distance of the bands that are left."""
    line = flight(bands=40).line.assign_attrs(srf_shape="slit")
    spacing = np.abs(np.gradient(line.wavelength.values))
    known = line.assign_coords(band_spacing=("band", spacing, {"units": "nm"}))
    whole = values(known)
    few = [3, 17, 18, 30]
    # what is left is the slope of the responsivity, which four bands cannot tell
    np.testing.assert_allclose(values(known.isel(band=few)), whole[:, few], rtol=2e-3)
    with pytest.raises(SchemaError, match="give 'band_spacing'"):
        values(line.isel(band=few))
