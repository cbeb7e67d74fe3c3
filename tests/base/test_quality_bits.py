"""Which bits of `quality` are set, where, and what is missing there."""

from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.strategies import START, flight, values

from hyperpaint.base.schema import Quality
from hyperpaint.radiometry.counts_to_reflectance import radiance, reflectance

pytestmark = pytest.mark.filterwarnings("ignore:.*counts-averaged")


def with_samples(line: xr.Dataset, **samples: list[tuple[Any, Any]]) -> xr.Dataset:
    # Return the line with samples of its variables set: pairs of index and value
    for name, pairs in samples.items():
        for index, value in pairs:
            line[name].values[index] = value
    return line


def test_from_radiance_keeps_every_flag_that_was_set() -> None:
    line = flight().line
    line = with_samples(line, counts=[((2, 3, 1), line.saturation_count)])
    got = reflectance(radiance(line).compute().drop_vars("counts"))
    assert got.quality.values[2, 1] & Quality.SATURATED
    assert np.isnan(got.reflectance.values[2, 3, 1])


def quality_of(line: xr.Dataset) -> np.ndarray:
    return reflectance(line)["quality"].values


@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_saturation_starts_sixteen_counts_below_the_end(dtype: Any) -> None:
    line = flight(dtype=dtype).line
    end, whole = line.saturation_count, np.rint(line["counts"].values)
    samples = [(..., whole), ((3, 5, 2), end - 16), ((4, 5, 2), end - 17)]
    got = reflectance(with_samples(line, counts=samples)).compute()
    np.testing.assert_array_equal(np.argwhere(got.quality.values & Quality.SATURATED), [[3, 2]])
    np.testing.assert_array_equal(np.argwhere(np.isnan(got.reflectance.values)), [[3, 5, 2]])
    assert got.quality.values.sum() == Quality.SATURATED


def test_saturation_is_judged_before_the_dark_is_taken_away() -> None:
    line = with_samples(flight(dtype=np.uint16, dark=300.0).line, counts=[((0, 0, 0), 4090)])
    assert quality_of(line)[0, 0] == Quality.SATURATED  # 3790 above the dark


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
    assert (missing[:, [0, 7], [0, 3]].all(), missing.sum()) == (True, 48)
    saturated = got.quality.values & Quality.SATURATED > 0
    assert (saturated == np.isin(range(6), [0, 3])).all()


def test_unknown_saturation_of_an_element_never_saturates() -> None:
    line = flight(dtype=np.uint16).line.drop_vars("saturation_count")
    own = np.full((12, 6), 4095.0)
    own[2, 2] = np.nan
    line["saturation_count"] = (("band", "cross_track"), own, {"units": "count"})
    with_samples(line, counts=[((0, 2, 2), 4090), ((1, 2, 3), 4090)])
    np.testing.assert_array_equal(np.argwhere(reflectance(line).compute().quality.values), [[1, 3]])


def test_a_stuck_bad_element_does_not_saturate_its_column() -> None:
    line = flight(bands=40, dtype=np.uint16).line
    full = [(np.s_[:, 9, 1], 4095), (np.s_[:, 17], 4095)]
    line = with_samples(line, counts=full, radiance_gain=[((9, 1), np.nan)], good=[(17, False)])
    got = reflectance(line).compute()
    assert (got.quality.values.any(), np.isnan(got.reflectance.values[:, 9, 1]).all()) == (False, True)
    # in a pixel where another element saturates, it does
    np.testing.assert_array_equal(
        np.argwhere(quality_of(with_samples(line, counts=[((5, 20, 1), 4095)]))), [[5, 1]]
    )


@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_below_dark_by_five_sigma(dtype: Any) -> None:
    # five times sqrt(2^2 + 1/12) is 10.104: quantisation is noise too
    samples = [((1, 3, 0), 89), ((2, 3, 0), 90 if dtype == np.uint16 else 89.95)]
    got = reflectance(with_samples(flight(bands=40, dark=100.0, dtype=dtype).line, counts=samples)).compute()
    np.testing.assert_array_equal(np.argwhere(got.quality.values == Quality.BELOW_DARK), [[1, 0]])
    assert got.quality.values.sum() == Quality.BELOW_DARK
    assert got.reflectance.values[1, 3, 0] < 0  # kept


def test_below_dark_in_more_than_a_tenth_of_the_bands() -> None:
    # the last samples are not below the dark
    samples = [(np.s_[1, :5, 0], 99), (np.s_[2, :3, 0], 99), (np.s_[3, :40:8, 1], 100)]
    line = with_samples(flight(bands=40, dark=100.0, dtype=np.uint16).line, counts=samples)
    np.testing.assert_array_equal(np.argwhere(quality_of(line)), [[1, 0]])
    assert not quality_of(with_samples(line, good=[(np.s_[:2], False)])).any()


def test_bad_detector_only_over_five_per_cent_of_the_good_bands() -> None:
    gains = [(([1, 2], 0), np.nan), (([1, 2, 3], 1), np.nan), (([1, 2, 3], 2), np.inf)]
    line = with_samples(flight(bands=40).line, radiance_gain=gains)
    assert (quality_of(line) == Quality.BAD_DETECTOR * np.isin(range(6), [1, 2])).all()
    # two of 39 good bands are left, then one of 38
    for band, is_flagged in ((3, True), (2, False)):
        quality = quality_of(with_samples(line, good=[(band, False)]))
        assert (quality[:, 1:3] == Quality.BAD_DETECTOR * is_flagged).all()
    assert not quality.any()


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
    assert (np.isfinite(got.reflectance.values[0]).all(), got.quality.values[0, 0]) == (True, 0)
    # 5 s are allowed: linear light comes out right
    np.testing.assert_allclose(values(holed), made.reflectance, rtol=1e-5)


def test_nothing_is_extrapolated() -> None:
    made = flight(lines=900)
    short = made.line.isel(irradiance_time=slice(6, 8))  # 12 and 14 s
    got = reflectance(short).compute()
    seconds = (short.time.values - START) / np.timedelta64(1, "s")
    outside = (seconds < 12) | (seconds > 14)
    is_gap = got.quality.values == Quality.IRRADIANCE_GAP
    assert (np.isnan(got.reflectance.values) == outside[:, None, None]).all()
    assert (is_gap == outside[:, None]).all()
    np.testing.assert_allclose(
        got.irradiance_age.values, np.minimum(np.abs(seconds - 12), np.abs(seconds - 14)), atol=1e-6
    )
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
    quality = quality_of(line) & ~np.uint16(Quality.TIMING_SENSITIVE)
    between = line.time.values < START + np.timedelta64(12, "s")
    assert ((quality == Quality.ILLUMINATION_UNSTABLE) == (between[:, None] & flagged)).all()


@pytest.mark.filterwarnings("ignore:the median irradiance")  # light of noon, moved to the evening
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
    line = flight(dtype=np.uint16, position=True).line
    line["counts"].values[5] = 65535
    stamps = line.time.values.copy()
    stamps[5] = np.datetime64("NaT", "ns")
    line = line.assign_coords(time=("along_track", stamps))
    for got, name in ((reflectance(line), "reflectance"), (radiance(line), "radiance")):
        is_dropped = np.arange(24) == 5
        assert ((got.quality.values == Quality.NO_DATA) == is_dropped[:, None]).all()
        assert not np.delete(got.quality.values, 5, axis=0).any()
        assert (is_dropped == np.isnan(got[name].values).T).all()
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
    np.testing.assert_array_equal(reflectance(reflectance(line)).quality.values, quality)


def test_quality_attributes_follow_cf() -> None:
    attrs = reflectance(flight().line).quality.attrs
    assert attrs["flag_masks"].dtype == np.uint16
    assert len(attrs["flag_meanings"].split()) == len(attrs["flag_masks"])
    assert "units" not in attrs


def test_radiance_leaves_the_bits_of_light_alone() -> None:
    line = flight().line
    line["irradiance_max_gap"] = ((), 0.01, {"units": "s"})
    lit = reflectance(line).compute()
    assert (lit.quality & Quality.IRRADIANCE_GAP).any()
    np.testing.assert_array_equal(radiance(lit).quality, lit.quality)


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
