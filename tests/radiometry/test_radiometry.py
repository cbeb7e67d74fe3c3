"""Counts to reflectance: the equations, darks, panels and tilt, smile, and what is refused."""

import warnings
from typing import Any

import dask.array as da
import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings, strategies as st
from support.refusals import expect_error, expect_errors, expect_refusals, expect_words, refusal
from support.strategies import SHIFT, START, assert_same, flight, labelled, values

import hyperpaint as hp
from hyperpaint.base.errors import PaintWarning, SchemaError, TimeError, UnitsError
from hyperpaint.base.responsivity import responsivity_slope
from hyperpaint.base.schema import Quality
from hyperpaint.light.sun import solar_position
from hyperpaint.radiometry.counts_to_reflectance import (
    radiance,
    reflectance,
)
from hyperpaint.radiometry.panels import Panel
from hyperpaint.radiometry.pixel_reading import worked_example
from hyperpaint.radiometry.planning import check_light, light_level


def above(line: xr.Dataset) -> np.ndarray:
    # Return counts above the dark (along_track, band, cross_track)
    return (line.counts - line.dark_counts).transpose(*line.counts.dims).values


def counted(line: xr.Dataset, counts: np.ndarray) -> xr.Dataset:
    return line.assign(counts=line.counts.copy(data=np.asarray(counts, np.float32)))


def darkened(line: xr.Dataset, darks: np.ndarray, exposure_s: Any = None, seconds: Any = None) -> xr.Dataset:
    # Return the line with several darks, and the exposures and times at which they were taken
    line = line.drop_vars("dark_counts")
    if seconds is not None:
        line = line.assign_coords(dark_time=("dark_time", START + np.array(seconds, "timedelta64[s]")))
    if exposure_s is not None:
        line["dark_exposure_time"] = ("dark_time", exposure_s, {"units": "s"})
    return line.assign(
        dark_counts=(("dark_time", "band", "cross_track"), darks.astype("f4"), {"units": "count"})
    )


# ------------------------------------------------------------------------------------------ the equations


def test_worked_example_with_gains_built_by_hand() -> None:
    # the whole chain of the example, from the monochromator on
    etendue, t_obs, t_ref, b_obs, b_ref = 1.8598e-11, 5e-3, 50e-3, 6.0, 2.0
    spacing, peak, flux, area = 600 / 271, 2.0e16, 3.0e-12, np.sqrt(np.pi / (4 * np.log(2)))
    counts = t_obs * etendue * (0.40 * 1.30 / np.pi) * peak * area * b_obs
    line_area = t_ref * flux * peak * area * b_obs / spacing
    amplitude = t_ref * flux * peak * b_obs / np.hypot(b_obs, b_ref)
    by_area = flux * t_ref / (etendue * spacing * line_area)
    by_fit = flux * t_ref / (etendue * amplitude * area * np.hypot(b_obs, b_ref))
    assert (counts, line_area, amplitude, by_area) == (
        pytest.approx(1966.09, abs=0.005),
        pytest.approx(8654.12, abs=0.01),
        pytest.approx(2846.05, abs=0.01),
        pytest.approx(by_fit, rel=1e-12),
    )
    line = worked_example()
    assert all("long_name" in line[name].attrs for name in line.data_vars)
    for gain in (by_area, by_fit):
        line["radiance_gain"] = line.radiance_gain.copy(data=np.full((3, 3), gain, np.float32))
        line = counted(line, np.full((1, 3, 3), 1966.09 + 100))
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


def test_linear_light_is_reproduced_exactly_and_the_wrong_neighbour_would_be_seen() -> None:
    # over 6.3 s of a record every 2 s, so that lines fall on all sides of samples
    long, made = flight(lines=900, bands=2, columns=3, drift=0.02), flight(lines=4, drift=0.2, level=0.2)
    made.line["saturation_count"].values[()] = 1e6
    for each in (long, made):
        np.testing.assert_allclose(values(each.line), each.reflectance, rtol=1e-5)
    late = made.line.assign_coords(irradiance_time=made.line.irradiance_time + np.timedelta64(2, "s"))
    assert np.abs(values(late) / made.reflectance - 1).min() > 0.1  # 2 s late


def test_exposure_light_altitude_and_even_smile_leave_reflectance() -> None:
    made, factor = flight(), np.linspace(0.5, 2.0, 24)
    line = made.line.assign(saturation_count=made.line.saturation_count * 3)
    line = counted(line, above(line) * factor[:, None, None] + line.dark_counts.values)
    line["exposure_time"] = ("along_track", 5e-3 * factor, {"units": "s"})
    with pytest.warns(PaintWarning, match="dark-exposure-missing"):
        np.testing.assert_allclose(values(line), made.reflectance, rtol=2e-5)
    # twice the exposure changes counts, and nothing else
    short, long = flight(exposure=4e-3, seed=3).line, flight(exposure=8e-3, seed=3).line
    line = long.assign(radiance_gain=short.radiance_gain, saturation_count=long.saturation_count * 3)
    line = counted(line, 2.0 * above(short) + line.dark_counts.values)
    np.testing.assert_allclose(values(line), values(short), rtol=2e-5)
    # brighter light leaves reflectance, and Spectralon is 0.99
    dim, bright = (flight(level=level, drift=0.0, seed=5).line for level in (0.6, 1.2))
    np.testing.assert_allclose(values(dim), values(bright), rtol=2e-5)
    line = flight(flat=True).line
    spectralon = counted(line, above(line) * (0.99 / 0.4) + line.dark_counts.values)
    np.testing.assert_allclose(values(spectralon), 0.99, rtol=1e-5)
    # altitude never enters
    line = flight(position=True).line
    assert_same(reflectance(line), reflectance(line.assign_coords(altitude=line.altitude * 2)))
    assert_same(reflectance(line), reflectance(line.drop_vars("altitude")))
    # nor does smile without structure
    for smile in (SHIFT, np.broadcast_to(SHIFT, (12, 6)) + np.linspace(-0.2, 0.2, 12)[:, None]):
        made = flight(smile=smile)
        np.testing.assert_allclose(values(made.line), made.reflectance, rtol=1e-5)


def test_units_are_converted_and_not_guessed() -> None:
    line = flight().line
    other = line.assign(
        exposure_time=((), 5, {"units": "ms"}),  # an integer: 5 * 0.001 must not become 0
        irradiance=(line.irradiance * 100).assign_attrs(units="uW cm-2 nm-1"),
        radiance_gain=(line.radiance_gain * 100).assign_attrs(units="uW cm-2 sr-1 nm-1 s count-1"),
        wavelength=(line.wavelength / 1000).assign_attrs(units="Micrometers"),
        irradiance_max_gap=((), 5.0 / 60, {"units": "min"}),
    )
    got = reflectance(other)
    np.testing.assert_allclose(got.reflectance.values, values(line), rtol=2e-6)
    assert got.exposure_time.attrs["units"] == "ms"  # the input as it was
    bare = line.assign(exposure_time=line.exposure_time.drop_attrs())
    for units, match in (
        ("W m-2 nm-1 sr-1", r"irradiance.*sr-1"),
        ("9**9**9", "irradiance"),
        (None, "'irradiance' has no units|'exposure_time' has no units"),
    ):
        light = line.irradiance.drop_attrs() if units is None else line.irradiance.assign_attrs(units=units)
        with pytest.raises((SchemaError, UnitsError), match=match):
            reflectance((bare if units is None else line).assign(irradiance=light))


def test_from_radiance_when_there_are_no_counts() -> None:
    made = flight()
    calibrated = radiance(made.line).drop_vars(["counts", "radiance_gain", "dark_counts", "exposure_time"])
    np.testing.assert_allclose(values(calibrated), made.reflectance, rtol=1e-5)
    # a vendor's cube of scaled integers
    whole = (calibrated.radiance * 1e5).round().astype(np.uint16)
    scaled = calibrated.assign(radiance=whole.assign_attrs(units="1e-5 W m-2 sr-1 nm-1"))
    np.testing.assert_allclose(values(scaled), made.reflectance, atol=5e-5 / 1.2 * np.pi)
    stored_only = reflectance(made.line)[["reflectance"]]
    assert reflectance(stored_only).reflectance.identical(stored_only.reflectance)
    # the slope of the responsivity is kept
    slope = np.linspace(1.0, 3.0, made.line.sizes["band"])[:, None].astype("f4")
    gain = made.line.radiance_gain
    line = made.line.assign(radiance_gain=gain.copy(data=gain.values * slope))
    np.testing.assert_allclose(values(radiance(line).drop_vars("counts")), values(line), rtol=1e-6)


# ------------------------------------------------------------------------------------------------- darks


def test_dark_of_every_line_is_between_the_darks_around_it() -> None:
    made = flight()
    line, low = made.line, made.line.dark_counts.values
    part = ((line.time.values - START) / np.timedelta64(1, "s") - 9.0) / 2.0
    line = counted(line, line.counts.values + 60 * part[:, None, None])
    line = darkened(line, np.stack([low + 60, low, low + 560]), seconds=[11, 9, 300])  # not in order
    np.testing.assert_allclose(values(line), made.reflectance, rtol=2e-5)
    assert np.abs(made.reflectance - values(line)).max() < 1e-4
    # before the first and after the last one, that one is held
    held = values(line.isel(dark_time=[0, 2]))
    assert np.isfinite(held).all()
    np.testing.assert_array_equal(held, values(line.isel(dark_time=0).drop_vars("dark_time")))


def test_darks_at_two_and_at_another_exposure_and_without_a_value() -> None:
    made, bias, rate = flight(exposure=5e-3), 60.0, 8000.0  # count, count per second
    dark = np.broadcast_to(bias + rate * np.array([2e-3, 10e-3])[:, None, None], (2, 12, 6))
    line = darkened(
        counted(made.line, above(made.line) + bias + rate * 5e-3), dark, [2e-3, 10e-3], seconds=[0, 1]
    )
    np.testing.assert_allclose(values(line), made.reflectance, rtol=2e-5)
    # at another exposure it is refused
    line = flight().line
    line["dark_exposure_time"] = ((), 20.0, {"units": "ms"})
    lazily = reflectance(line)
    with refusal(SchemaError, "dark-exposure-differs", "20 ms", " 5 ms"):
        lazily.reflectance.compute()
    line["dark_exposure_time"] = ((), 5.0, {"units": "ms"})
    reflectance(line).reflectance.compute()
    # one without a value makes a bad element
    line = flight(dtype=np.uint16).line
    line["dark_counts"].values[4, 2] = np.nan
    got = reflectance(line).compute()
    expected = np.ones(got.reflectance.shape, bool)
    expected[:, 4, 2] = False
    np.testing.assert_array_equal(np.isfinite(got.reflectance.values), expected)
    flags = np.where(np.arange(6) == 2, Quality.BAD_DETECTOR, 0)  # one of twelve bands
    np.testing.assert_array_equal(got.quality.values, np.broadcast_to(flags, got.quality.shape))


def _line_with_darks_at(*exposures_ms: float) -> xr.Dataset:
    # A line at 5 ms, with darks of 90 counts and 2 a millisecond
    line = flight(exposure=5e-3).line
    dark = 90.0 + 2.0 * np.array(exposures_ms)[:, None, None]
    shape = (len(exposures_ms), line.sizes["band"], line.sizes["cross_track"])
    return darkened(line, np.broadcast_to(dark, shape), np.array(exposures_ms) / 1e3, range(len(dark)))


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
    for exposures, distance in (((1.0, 2.0), r"3\.0"), ((20.0, 30.0), r"1\.5")):
        with pytest.warns(PaintWarning, match=rf"5 ms, {distance} .*dark-exposure-differs"):
            radiance(_line_with_darks_at(*exposures)).radiance.compute()
    with refusal(SchemaError, "dark-exposure-differs", "5 ms, 15.0 "):
        radiance(_line_with_darks_at(1.0, 1.25)).radiance.compute()


# --------------------------------------------------------------------------------------- tilt and panels


@pytest.mark.filterwarnings("ignore:the irradiance fits no sky:hyperpaint.base.errors.PaintWarning")  # flat
def test_a_level_panel_changes_no_bit() -> None:
    line = flight(position=True).line
    assert_same(reflectance(line), reflectance(line, tilt=(0.0, 123.0)))
    tilted = reflectance(line, tilt=(5.0, 180.0)).reflectance
    assert not np.allclose(tilted.values, values(line))
    expect_words(tilted.attrs["tilt"], "Tilt", "sky='clear'")
    expect_errors((SchemaError, "latitude", lambda: reflectance(flight().line, tilt=(5.0, 180.0))))


def test_a_known_tilt_closes() -> None:
    made = flight(position=True)
    tilt = hp.Tilt(8.0, 200.0, ground_reflectance=0.15, diffuse_fraction=0.2)
    onto = tilt.factor(made.line.irradiance_time.values, 43.08, -77.67, made.line.wavelength.values)
    lit = np.array([np.interp(10 + 0.007 * k, 2.0 * np.arange(12), onto[:, 0]) for k in range(24)])
    np.testing.assert_allclose(values(made.line, tilt=tilt), made.reflectance / lit[:, None, None], rtol=2e-5)


def test_a_panel_in_the_scene_sets_the_scale() -> None:
    line, region = flight(flat=True).line, (slice(3, 8), slice(1, 4))
    off = line.assign(radiance_gain=(line.radiance_gain * 1.1).assign_attrs(line.radiance_gain.attrs))
    np.testing.assert_allclose(values(off), 0.44, rtol=1e-5)
    np.testing.assert_allclose(values(off, panel=Panel(*region, 0.4)), 0.4, rtol=1e-5)

    def known(factor: Any, wavelength: Any, nm: str, units: str) -> xr.DataArray:
        axis = {"wavelength": ("wavelength", wavelength, {"units": nm})}
        return xr.DataArray(factor, axis, "wavelength", attrs={"units": units})

    rising = np.linspace(0.3, 0.5, 12)
    # 0.44 where 0.3 to 0.5 are known: applied, and said
    with pytest.warns(PaintWarning, match=r"0\.880 to 1\.467.*panel-doubtful"):
        got = values(off, panel=Panel(*region, known(rising[::-1], off.wavelength.values[::-1], "nm", "1")))
    np.testing.assert_allclose(got, np.broadcast_to(rising[:, None], got.shape), rtol=1e-5)
    grey = known([40.0, 40.0], [0.2, 2.0], "um", "percent")
    np.testing.assert_allclose(values(line, panel=Panel(*region, grey)), 0.4, rtol=1e-5)
    dark = line.copy(deep=True)
    dark["counts"].values[3:8, :, 1:4] = 40950
    expect_refusals(
        (UnitsError, "units-missing", lambda: values(line, panel=Panel(*region, grey.drop_attrs()))),
        (SchemaError, "value-out-of-range", lambda: Panel(*region, 50.0)),
        (SchemaError, "panel-empty", lambda: values(dark, panel=Panel(*region, 0.4))),
        (
            SchemaError,
            "panel-outside-line",
            lambda: reflectance(off, panel=Panel(slice(100, 120), slice(0, 2), 0.4)),
        ),
    )


# -------------------------------------------------------------------------------------- smile, darkness


@pytest.mark.parametrize("smile", [None, SHIFT])
def test_without_light_there_is_no_reflectance(smile: np.ndarray | None) -> None:
    line = flight(smile=smile).line
    line["irradiance"].values[:, 120:200] = 0.0  # 520 to 600 nm: water, or a night
    with pytest.warns(PaintWarning, match="irradiance-(channels|gaps)"):
        got, nm = values(line), line.wavelength.values
    assert np.isnan(got[:, (nm > 528) & (nm < 588)]).all()
    assert np.isfinite(got[:, (nm < 508) | (nm > 612)]).all()
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
    error = expect_error(SchemaError, None, lambda: reflectance(line))
    expect_words(str(error), "radiance_gain", "exposure_time", "fwhm", "dark_counts")


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
    lazily = reflectance(line.assign({name: line[name].copy(data=value)}))
    expect_error(SchemaError, word, lambda: lazily.reflectance.compute())


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


# ----------------------------------------------------------------------------------- what a review found


def test_arguments_that_cannot_be_heeded_are_refused() -> None:
    line = flight(position=True).line
    only = reflectance(line).drop_vars("counts")
    gain = flight(columns=5).line.radiance_gain.values
    wrong: list[dict[str, Any]] = [{"tilt": tilt} for tilt in ([5.0, 180.0], (5.0,), 5.0)]
    for start, options, code in (
        *((only, o, "option-conflict") for o in ({"tilt": (3.0, 90.0)}, {"keep_bits": 12})),
        (only, {"irradiance": line[["irradiance"]]}, "option-conflict"),
        *((line, o, "type-wrong") for o in wrong),
        (line.assign_attrs(srf_shape="round"), {}, "round"),
    ):
        with pytest.raises(SchemaError, match=code):
            reflectance(start, **options)
    expect_error(
        ValueError,
        "cross_track",
        lambda: line.drop_vars("radiance_gain").assign(
            radiance_gain=(("band", "cross_track"), gain, line.radiance_gain.attrs)
        ),
    )
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
    made, rate = flight(), 20_000.0  # counts of dark a second
    factor = np.where(np.arange(24) % 2, 2.0, 1.0)
    dark = made.line.dark_counts.values
    line = made.line.assign(saturation_count=made.line.saturation_count * 3)
    line = counted(line, above(line) * factor[:, None, None] + dark + rate * 5e-3 * factor[:, None, None])
    line["exposure_time"] = ("along_track", 5e-3 * factor, {"units": "s"})
    line = darkened(line, np.stack([dark + rate * t for t in (5e-3, 10e-3)]), [5e-3, 10e-3])
    np.testing.assert_allclose(values(line), made.reflectance, rtol=5e-5)
    expect_error(SchemaError, "dark-exposure-differs", lambda: values(line.isel(dark_time=[0])))


def test_choosing_bands_first_changes_nothing_for_a_slit() -> None:
    # Rationale: the pixel's width is that of the camera, not the distance of the bands that are left
    line, few = flight(bands=40).line.assign_attrs(srf_shape="slit"), [3, 17, 18, 30]
    spacing = np.abs(np.gradient(line.wavelength.values))
    slope = responsivity_slope({name: line[name].values for name in ("wavelength", "fwhm", "radiance_gain")})
    known = line.assign_coords(
        band_spacing=("band", spacing, {"units": "nm"}), responsivity_slope=("band", slope, {"units": "nm-1"})
    )
    np.testing.assert_allclose(values(known.isel(band=few)), values(known)[:, few], rtol=1e-6)
    # four bands cannot tell the slope
    without = known.drop_vars("responsivity_slope")
    np.testing.assert_array_equal(values(without), values(known))
    np.testing.assert_allclose(values(without.isel(band=few)), values(known)[:, few], rtol=2e-3)
    expect_error(SchemaError, "band-spacing-missing", lambda: values(line.isel(band=few)))


# --- line and irradiance times: units, order, clocks, and records of their own ------------------------------


@pytest.mark.parametrize("line_unit", ["s", "ms", "us", "ns"])
@pytest.mark.parametrize("record_unit", ["s", "us", "ns"])
def test_mixed_units_of_time(line_unit: str, record_unit: str) -> None:
    made = flight(lines=4, bands=3, columns=2, drift=0.05)
    # whole seconds, so that every unit can hold them
    seconds = np.array([1, 3, 9, 21])
    line = made.line.assign_coords(time=("along_track", START + seconds.astype("timedelta64[s]")))
    mixed = line.assign_coords(
        time=("along_track", line.time.values.astype(f"datetime64[{line_unit}]")),
        irradiance_time=("irradiance_time", line.irradiance_time.values.astype(f"datetime64[{record_unit}]")),
    )
    np.testing.assert_array_equal(values(mixed), values(line))
    share = made.irradiance / (1.2 + 0.05 * seconds)
    np.testing.assert_allclose(values(line), made.reflectance * share[:, None, None], rtol=1e-5)


def test_shuffled_lines_come_out_in_their_places() -> None:
    line = flight(lines=300, drift=0.05).line
    order = np.random.default_rng(1).permutation(300)
    got, expected = reflectance(line.isel(along_track=order)), reflectance(line).isel(along_track=order)
    assert_same(got, expected)


def test_records_that_run_backwards_or_stand_still_are_refused() -> None:
    line = flight().line
    stamps = line.irradiance_time.values.copy()
    stamps[3] = np.datetime64("NaT", "ns")
    unordered = line.isel(irradiance_time=[0, 2, 1, 3, 4, 5, 6])
    bare = unordered.drop_indexes("irradiance_time")
    lazy = bare.assign_coords(irradiance_time=("irradiance_time", da.from_array(bare.irradiance_time.values)))
    for code, other in (
        ("time-duplicate", line.isel(irradiance_time=[0, 1, 1, 2, 3, 4, 5, 6])),
        ("time-unordered", unordered),
        ("time-unordered", lazy),
        ("time-missing", line.assign_coords(irradiance_time=("irradiance_time", stamps))),
    ):
        with pytest.raises(TimeError, match=code):
            reflectance(other).reflectance.compute()


def test_clocks_that_are_off() -> None:
    line, offset, hours = flight(drift=0.01).line, np.timedelta64(37_250, "ms"), np.timedelta64(5, "h")
    wrong = line.assign_coords(irradiance_time=line.irradiance_time + offset)
    local = line.assign_coords(time=line.time - hours)
    lazily = reflectance(wrong)
    with pytest.warns(PaintWarning, match=r"0 of 24 lines.*time-uncovered"):
        got = lazily.compute()  # the record begins 27 s after the line
    with pytest.warns(PaintWarning, match=r"0 of 24 lines.*time-uncovered"):
        assert np.isnan([got.reflectance.values, values(local)]).all()
    assert (got.quality.values == Quality.IRRADIANCE_GAP).all()
    for other, off in ((wrong, offset), (local, hours)):
        back = other.assign_coords(irradiance_time=other.irradiance_time - off)
        np.testing.assert_array_equal(values(back), values(line))


def test_a_record_of_its_own_replaces_the_lines() -> None:
    made = flight()
    record = made.line[["irradiance", "irradiance_fwhm"]].assign_attrs(irradiance_srf_shape="gaussian")
    light = (record.irradiance * 2).assign_attrs(record.irradiance.attrs)
    twice = record.assign(irradiance=light).isel(irradiance_time=slice(2, 9))
    bare = made.line.drop_vars([n for n in made.line.variables if str(n).startswith("irradiance")])
    for line in (made.line, bare):
        np.testing.assert_allclose(values(line, irradiance=twice), made.reflectance / 2, rtol=1e-5)
    expect_error(SchemaError, "holds light, expected", lambda: reflectance(bare, xr.Dataset({"light": 1})))


def test_another_record_brings_its_own_gap_and_width_even_of_odd_spectra() -> None:
    line = flight().line
    step = float(np.diff(line.irradiance_time.values)[0] / np.timedelta64(1, "s"))
    line = line.assign(irradiance_max_gap=((), 1.5 * step, {"units": "s"}))
    half = line.isel(irradiance_time=slice(None, None, 2))
    other = half[["irradiance", "irradiance_fwhm"]]
    assert [
        bool((made.quality & Quality.IRRADIANCE_GAP).any())
        for made in (reflectance(half), reflectance(line, other))
    ] == [True, False]
    expect_errors(
        (SchemaError, "irradiance_fwhm", lambda: reflectance(line, other.drop_vars("irradiance_fwhm"))),
        (SchemaError, r"DataArray.*type-wrong", lambda: reflectance(line, other.irradiance)),
    )
    # one spectrum with more than the others costs nothing
    line = flight().line
    spectra = np.repeat(line.irradiance.values, 5, axis=0)
    spectra[1:, -2:] = np.nan  # all but one end early
    when = line.irradiance_time.values[0] + np.arange(len(spectra)) * np.timedelta64(1, "s")
    record = xr.Dataset(
        {"irradiance": (line.irradiance.dims, spectra, {"units": "W m-2 nm-1"})},
        {"irradiance_time": when, "irradiance_wavelength": line.irradiance_wavelength},
    ).assign(irradiance_fwhm=line.irradiance_fwhm)
    assert not (reflectance(line, record).quality & Quality.IRRADIANCE_GAP).any()


# --- Irradiance that is no daylight, not that of its place and time, or lacks channels


def _line(factor: float = 1.0, *, position: bool = True, hours: int = 0) -> xr.Dataset:
    # A line with a clear sky's level over it, times a factor, all stamps late by some hours
    line = flight(lines=4, position=position).line
    delay = np.timedelta64(hours, "h")
    times = {name: (line[name].dims, line[name].values + delay) for name in ("time", "irradiance_time")}
    line = line.assign_coords(times)
    return line.assign(irradiance=line.irradiance.copy(data=line.irradiance.values * np.float32(factor)))


@pytest.mark.parametrize("position", [True, False])
@pytest.mark.parametrize("factor", [0.2, 0.5, 1.0, 1.4])
def test_daylight_passes_without_a_word(factor: float, position: bool) -> None:
    reflectance(_line(factor, position=position)).reflectance.compute()


@pytest.mark.parametrize(
    ("factor", "unit"),
    [(1e-6, "declared in uW m-2 nm-1"), (1e-4, "values in W cm-2 nm-1 that are taken"), (10.0, "mW cm-2"),
     (100.0, "values in uW cm-2 nm-1 that are taken"), (1e3, r"mW m-2 nm-1 \(W m-2 um-1\) that are taken")],
)  # fmt: skip
def test_what_no_daylight_is_is_refused_with_the_unit(factor: float, unit: str) -> None:
    # Rationale: a millionth of the sun gave a reflectance of 203, and no flag
    lazily = reflectance(_line(factor))
    expect_error(SchemaError, rf"{unit}.*irradiance-level", lambda: lazily.reflectance.compute())


@pytest.mark.parametrize(
    ("options", "words"),
    [({"factor": 1e-2}, "declared in uW cm-2 nm-1"), ({"factor": 1e-3}, "declared in mW m-2 nm-1"),
     ({"factor": 2.2}, ""), ({"factor": 1e-2, "position": False}, r"0\.02 "), ({"hours": 12}, "local time")],
    ids=["uW", "mW", "too bright", "without a place", "noon by night"],
)  # fmt: skip
def test_what_a_clear_sky_contradicts_is_warned_of(options: dict[str, Any], words: str) -> None:
    lazily = reflectance(_line(**options))
    with pytest.warns(PaintWarning, match=rf"{words}.*irradiance-level"):
        lazily.reflectance.compute()


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_channel_that_is_undefined_is_said_with_the_bands_it_costs(value: float) -> None:
    # Rationale: two of twelve bands had no reflectance, no flag and no word
    line = _line()
    record = line.irradiance.copy(deep=True)
    record[:, 150] = value
    lazily = reflectance(line.assign(irradiance=record))
    with pytest.warns(PaintWarning, match=r"1 channels.* 550 nm: 2 of 12.*irradiance-gaps"):
        lost = np.isnan(lazily.reflectance.values).all(axis=(0, 2))
    assert np.flatnonzero(lost).tolist() == [2, 3]
    # a sample without any channel is a gap and no lost band
    record = line.irradiance.copy(deep=True)
    record[0] = np.nan
    reflectance(line.assign(irradiance=record)).reflectance.compute()


@pytest.mark.parametrize(
    ("zenith", "median", "is_doubtful"),
    [(60.0, 0.02, False), (60.0, 0.011, True), (60.0, 1.5, False), (60.0, 2.2, True), (83.0, 0.25, False),
     (83.0, 0.4, True)],
)  # fmt: skip
def test_limits_of_the_level(zenith: float, median: float, is_doubtful: bool) -> None:
    # relative to a clear sky, or for a sun lower than 80 degrees from the zenith in W m-2 nm-1
    morning = np.datetime64("2024-04-03T06:00", "ns") + np.arange(0, 21600, 20).astype("timedelta64[s]")
    stamp = morning[[np.abs(solar_position(morning, 0.0, 0.0)[0] - zenith).argmin()]]
    place, channels = {"latitude": 0.0, "longitude": 0.0}, np.arange(400.0, 1001.0)
    clear = light_level(place, np.ones((1, channels.size)), channels, stamp).clear if zenith < 80.0 else 1.0
    with warnings.catch_warnings(record=True) as noted:
        warnings.simplefilter("always")
        check_light(place, np.full((1, channels.size), median * clear), channels, stamp)
    assert [w.message.code for w in noted] == ["irradiance-level"] * is_doubtful
