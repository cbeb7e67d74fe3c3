"""The sun against pvlib's SPA, and the split of its light against published numbers."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, strategies as st
from support.refusals import expect_error, expect_errors, refusal

from hyperpaint.base.errors import PaintWarning, SchemaError, TimeError, UnitsError
from hyperpaint.base.schema import Quality
from hyperpaint.light.clear_sky import air_mass
from hyperpaint.light.illumination import Tilt, line_light, match_irradiance, smile_cells, timing_sensitivity
from hyperpaint.light.sun import diffuse_fraction, solar_position

PLACES = [(43.08, -77.67), (-33.9, 151.2), (0.0, 0.0), (69.6, 18.9), (64.1, -21.9), (-54.8, -68.3)]


@pytest.mark.parametrize(("latitude", "longitude"), PLACES)
def test_position_is_that_of_the_spa(latitude: float, longitude: float) -> None:
    pvlib = pytest.importorskip("pvlib")
    pandas = pytest.importorskip("pandas")
    times = pandas.date_range("2019-01-03", "2027-12-30", freq="61h13min7s").astype("datetime64[ns]")
    index = pandas.DatetimeIndex(times, tz="UTC")
    expected = pvlib.solarposition.spa_python(index, latitude, longitude, delta_t=69.0)
    zenith, azimuth = solar_position(times.values, latitude, longitude)
    # in degrees on the sky
    off = zenith - expected["zenith"].values
    turn = (azimuth - expected["azimuth"].values + 180) % 360 - 180
    turn *= np.sin(np.radians(zenith))
    assert max(np.abs(off).max(), np.abs(turn).max()) < 0.0125
    # 0.005; with a mean anomaly that is 0.3 degrees off it is 0.008
    assert np.sqrt(np.mean(off**2 + turn**2)) < 0.006


def test_units_of_time_air_mass_and_light_without_sun() -> None:
    stamps = np.array(["2020-06-21T17:15", "NaT"], "datetime64[s]")
    zenith, azimuth = solar_position(stamps, 43.08, -77.67)
    assert zenith[0] == pytest.approx(19.66, abs=0.05)
    assert np.isnan([zenith[1], azimuth[1]]).all()
    for unit in ("ms", "us", "ns"):
        assert solar_position(stamps.astype(f"datetime64[{unit}]"), 43.08, -77.67)[0][0] == zenith[0]
    assert np.isnan(solar_position(stamps[0], np.nan, 0.0)[0])
    # air mass
    assert air_mass(0.0) == pytest.approx(1.0, abs=1e-3)
    assert air_mass(60.0) == pytest.approx(1.994, abs=2e-3)
    assert air_mass(85.0) == pytest.approx(10.3, abs=0.2)
    # without sun all light is diffuse
    for angle in (90.5, 95.0, 120.0, 180.0):
        np.testing.assert_array_equal(diffuse_fraction([450.0, 850.0], angle), 1.0)
    rising = [diffuse_fraction([550.0], z)[0] for z in (0.0, 30.0, 60.0, 75.0, 85.0, 89.9)]
    assert (np.diff(rising) > 0).all()
    assert rising[-1] <= 1.0


@pytest.mark.parametrize(
    ("zenith", "expected"),
    [(28.0, [0.30, 0.23, 0.15, 0.10, 0.06]), (53.0, [0.40, 0.31, 0.19, 0.14, 0.08])],
)
def test_diffuse_fraction_of_the_notes(zenith: float, expected: list[float]) -> None:
    found = diffuse_fraction([400.0, 450.0, 550.0, 650.0, 850.0], zenith)
    np.testing.assert_allclose(found, expected, atol=0.03)


# --- Irradiance of every band and column: in wavelength, over the smile and on a tilted panel


START = np.datetime64("2020-06-21T17:00", "ns")
SAMPLES = np.arange(480.0, 621.0)


def record(spectra: np.ndarray, samples: np.ndarray = SAMPLES) -> xr.DataArray:
    return xr.DataArray(
        spectra,
        dims=("irradiance_time", "irradiance_wavelength"),
        coords={"irradiance_wavelength": ("irradiance_wavelength", samples, {"units": "nm"})},
        attrs={"units": "W m-2 nm-1"},
        name="irradiance",
    )


def ns(seconds: object) -> np.ndarray:
    return START + np.round(np.asarray(seconds, float) * 1e9).astype("timedelta64[ns]")


# ---------------------------------------------------------------------------------------------- matching


def test_match_is_labelled_lazy_and_float32(no_compute: Any) -> None:
    light = record(np.ones((4, 141), "f4")).chunk(irradiance_time=1, irradiance_wavelength=50)
    with no_compute():
        made = match_irradiance(light, [540.0, 550.0], [6.0, 6.0], nodes=[-0.5, 0.0, 0.5])
    assert made.dims == ("irradiance_time", "node", "band")
    assert made.dtype == made.compute().dtype == np.float32
    assert made.attrs["units"] == "W m-2 nm-1"
    assert made.misfit.dims == made.noise_gain.dims == made.coverage.dims == ("node", "band")
    np.testing.assert_allclose(made, 1.0, rtol=1e-6)
    # other units and orders are taken
    spectra = np.random.default_rng(0).uniform(1, 2, (2, 141)).astype("f4")
    plain = match_irradiance(record(spectra), [540.0, 550.0], [6.0, 6.0])
    other = record(spectra[:, ::-1] * 100, SAMPLES[::-1] / 1000).T
    other.attrs["units"] = "uW cm-2 nm-1"
    other.irradiance_wavelength.attrs["units"] = "um"
    before = other.copy(deep=True)
    np.testing.assert_allclose(match_irradiance(other, [540.0, 550.0], [6.0, 6.0]), plain, rtol=1e-5)
    xr.testing.assert_identical(other, before)


def test_missing_samples_touch_their_bands_only_and_others_are_warned_of() -> None:
    spectra = np.ones((2, 141), "f4")
    spectra[1, 60] = np.nan  # 540 nm
    made = match_irradiance(record(spectra), [510.0, 540.0, 600.0], [6.0] * 3).values[:, 0]
    assert np.isnan(made).tolist() == [[False] * 3, [False, True, False]]
    with pytest.warns(PaintWarning, match="2 bands .*bands-too-sharp"):
        match_irradiance(record(spectra[:1]), [540.0, 550.0], [1.5, 1.5])
    with pytest.warns(PaintWarning, match="1 bands .*bands-outside-irradiance"):
        made = match_irradiance(record(spectra[:1]), [300.0, 550.0], [6.0, 6.0])
    assert np.isnan(made.values[0, 0]).tolist() == [True, False]


def test_a_level_panel_is_exactly_one_at_any_hour_and_one_turned_from_the_sun_sees_the_sky() -> None:
    times = START.astype("datetime64[D]") + np.arange(0, 1440, 50).astype("timedelta64[m]")
    np.testing.assert_array_equal(Tilt(0.0, 77.0).factor(times, 43.08, -77.67, np.array([450.0, 850.0])), 1.0)
    time = np.array(["2020-12-21T17:10"], "datetime64[ns]")  # zenith 66 degrees
    steep = Tilt(60.0, 0.0, ground_reflectance=0.0, diffuse_fraction=0.3)
    assert steep.factor(time, 43.08, -77.67, np.array([550.0]))[0, 0] == pytest.approx(0.3 * 0.75, rel=1e-9)


def test_match_refuses() -> None:
    light = record(np.ones((1, 141), "f4"))
    power = light.assign_attrs(units="W m-2 sr-1 nm-1")
    expect_errors(
        (SchemaError, "dims-wrong", lambda: match_irradiance(light[0], [550.0], [6.0])),
        (SchemaError, "fwhm-invalid", lambda: match_irradiance(light, [550.0], [-6.0])),
        (UnitsError, "irradiance", lambda: match_irradiance(power, [550.0], [6.0])),
        (
            SchemaError,
            "coordinate-missing",
            lambda: match_irradiance(light.drop_vars("irradiance_wavelength"), [550.0], [6.0]),
        ),
        (
            SchemaError,
            "choice-unknown",
            lambda: match_irradiance(light, [550.0], [6.0], srf_shape="round"),
        ),
    )


# ------------------------------------------------------------------------------------------------- smile


@given(
    seed=st.integers(0, 10_000),
    columns=st.integers(1, 40),
    rows=st.sampled_from([None, 1, 5]),
    reach=st.floats(0.01, 4.0),
)
def test_every_column_finds_its_cell(seed: int, columns: int, rows: int | None, reach: float) -> None:
    rng = np.random.default_rng(seed)
    shift = rng.uniform(-reach, reach, columns if rows is None else (rows, columns))
    smile = smile_cells(shift, columns)
    table = np.atleast_2d(shift)
    assert ((smile.shift >= 0) & (smile.shift <= 1 + 1e-6)).all()
    for row, edges in enumerate(smile.edges):
        assert (edges[0], edges[-1]) == (0, columns)
        assert (np.diff(edges) >= 0).all()
        for run, cell in enumerate(smile.cells[row]):
            for x in range(edges[run], edges[run + 1]):
                place = smile.nodes[cell + 1] + 0.5 * smile.shift[row, x]
                assert place == pytest.approx(table[row, x], abs=1e-6)


def test_cubics_pass_through_any_cubic() -> None:
    smile = smile_cells(np.array([-1.2, 0.3, 0.9]), 3)
    curve = np.polynomial.Polynomial([0.3, -0.2, 0.1, 0.05])
    cubics = smile.cubics(curve(smile.nodes)[:, None] * np.ones((2, 1, 4)))
    assert cubics.shape == (2, 4, smile.nodes.size - 3, 4)
    for x, wanted in enumerate([-1.2, 0.3, 0.9]):
        terms = cubics[0, 0, smile.cells[0, np.searchsorted(smile.edges[0], x, side="right") - 1]]
        assert np.polyval(terms[::-1], float(smile.shift[0, x])) == pytest.approx(curve(wanted), abs=1e-6)
    # no smile is one node
    series = np.arange(6.0).reshape(2, 1, 3)
    for shift in (None, np.zeros(4)):
        smile = smile_cells(shift, 4)
        assert smile.nodes.tolist() == [0.0]
        np.testing.assert_array_equal(smile.cubics(series)[..., 0, 0], series[:, 0])
    for bad in (np.nan, 500.0):
        with pytest.raises(SchemaError, match="wavelength-shift-range"):
            smile_cells(np.full(4, bad), 4)


# ------------------------------------------------------------------------------------------------- tilt


def test_tilt_closes_to_ten_digits() -> None:
    times, wavelength = ns([0.0, 3600.0]), np.array([450.0, 850.0])
    zenith, azimuth = (np.radians(a) for a in solar_position(times, 43.08, -77.67))
    diffuse, angle, facing, surroundings = np.array([0.23, 0.06]), 10.0, 170.0, 0.15
    # by vectors, not by the formula of the code
    sun = np.stack([np.sin(zenith) * np.sin(azimuth), np.sin(zenith) * np.cos(azimuth), np.cos(zenith)], -1)
    a, f = np.radians(angle), np.radians(facing)
    normal = np.array([np.sin(a) * np.sin(f), np.sin(a) * np.cos(f), np.cos(a)])
    view = (1 + np.cos(a)) / 2
    expected = (
        (1 - diffuse) * (sun @ normal / sun[:, 2])[:, None] + view * diffuse + (1 - view) * surroundings
    )
    tilt = Tilt(angle, facing, ground_reflectance=surroundings, diffuse_fraction=diffuse)
    np.testing.assert_allclose(tilt.factor(times, 43.08, -77.67, wavelength), expected, rtol=1e-10)
    # towards the sun it is brighter, as published
    time = np.array(["2020-07-15T17:15"], "datetime64[ns]")  # noon in Rochester, zenith near 22 degrees
    toward, away = (
        Tilt(5.0, side).factor(time, 43.08, -77.67, np.array([850.0]))[0, 0] for side in (180.0, 0.0)
    )
    assert 1.02 < toward < 1.05
    assert 0.94 < away < 0.98


def test_diffuse_light_is_that_of_the_side_it_faces() -> None:
    time, nm = np.array(["2020-12-21T17:10"], "datetime64[ns]"), np.array([450.0])  # sun in the south, at 66
    split = diffuse_fraction(nm, float(solar_position(time, 43.08, -77.67)[0][0]))
    factors = {
        (sky, azimuth): float(
            Tilt(8.0, azimuth, diffuse_fraction=given, sky=sky).factor(time, 43.08, -77.67, nm)[0, 0]
        )
        for sky, given in (("clear", None), ("uniform", None), ("uniform", split), (None, split))
        for azimuth in (180.0, 0.0)
    }
    assert factors["clear", 180.0] > factors["uniform", 180.0] + 0.02
    assert factors["clear", 0.0] < factors["uniform", 0.0] - 0.02
    # a split that was measured may be of any sky: none is assumed
    assert (factors[None, 180.0], Tilt(8.0, 0.0).sky) == (factors["uniform", 180.0], "clear")
    expect_error(SchemaError, "choice-unknown", lambda: Tilt(8.0, 0.0, sky="blue"))
    # at night, the sky is that of a sun at the horizon
    dark = np.array(["2020-12-21T05:00"], "datetime64[ns]")
    assert np.isfinite(Tilt(8.0, 0.0).factor(dark, 43.08, -77.67, nm)).all()


# --- Which irradiance samples light each line, and what an error of the clocks could do


def test_few_samples_and_gaps() -> None:
    light = line_light(ns([0.0, 1.0]), ns([0.0]), np.ones(1))
    np.testing.assert_array_equal(light.weight, [0.0, np.nan])
    # the largest gap is two and a half intervals
    light = line_light(ns([5.0, 8.0, 12.0, 10.0]), ns([0.0, 2, 4, 6, 10, 16, 18]), np.ones(7))
    assert np.isnan(light.weight).tolist() == [False, False, True, False]
    # far from 1970 no bit is lost
    assert line_light(ns([1e-9]), ns([0.0, 3e-9]), np.ones(2), 1.0).weight[0] == 1 / 3
    # spectra without a value are passed over
    light = line_light(ns([1.0, 2.0]), ns([0.0, 1.0, 4.0]), np.array([1.0, np.nan, 1.0]), 5.0)
    assert (light.before.tolist(), light.after.tolist()) == ([0, 0], [2, 2])
    np.testing.assert_array_equal(light.weight, [0.25, 0.5])
    expect_error(
        TimeError, "irradiance-empty", lambda: line_light(ns([1.0]), ns([0.0, 2.0]), np.full(2, np.nan))
    )


# --- neighbours --------------------------------------------------------------------------------------------


@given(
    steps=st.lists(st.integers(1, 10**11), min_size=1, max_size=12),
    lines=st.lists(st.integers(-(10**10), 10**12), min_size=1, max_size=20),
)
def test_neighbours_and_weights(steps: list[int], lines: list[int]) -> None:
    ticks = np.cumsum([0, *steps])
    light = line_light(
        START + np.array(lines).astype("timedelta64[ns]"),
        START + ticks.astype("timedelta64[ns]"),
        np.ones(ticks.size),
        1e9,
    )
    for k, now in enumerate(lines):
        if now < 0 or now > ticks[-1]:
            assert np.isnan(light.weight[k])
            assert light.flags[k] == Quality.IRRADIANCE_GAP
            continue
        low, high = ticks[light.before[k]], ticks[light.after[k]]
        assert low <= now <= high
        assert light.weight[k] == (now - low) / (high - low)
        assert light.age[k] == np.float32(min(now - low, high - now) / 1e9)
        assert light.flags[k] == 0


# --- clocks ------------------------------------------------------------------------------------------------


@given(
    seed=st.integers(0, 10**6),
    samples=st.integers(2, 30),
    within=st.floats(0.0, 30.0),
)
def test_sensitivity_is_the_worst_of_all_offsets(seed: int, samples: int, within: float) -> None:
    rng = np.random.default_rng(seed)
    ticks = np.cumsum(rng.integers(1, 5 * 10**9, samples))
    levels = rng.uniform(0.2, 1.0, (samples, 3))
    lines = rng.integers(ticks[0], ticks[-1] + 1, 7)
    got = timing_sensitivity(lines, ticks, levels, within)
    u = round(within * 1e9)
    for line, found in zip(lines, got, strict=True):
        # every offset of a fine grid, and those that meet a sample exactly
        offsets = np.concatenate([np.linspace(-u, u, 101).round(), ticks[np.abs(ticks - line) <= u] - line])
        changes = []
        for interval in range(3):
            here = np.interp(line, ticks, levels[:, interval])
            ratio = np.interp(line + offsets, ticks, levels[:, interval]) / here
            changes += [ratio.max() - 1, 1 / ratio.min() - 1]
        assert found == pytest.approx(max(changes), abs=1e-6)


def test_a_known_clock_lifts_the_flag() -> None:
    # Light that falls by 10 % in 20 s: at 0.5 %/s a clock known to 2 s makes 1 %
    samples, times = np.arange(0.0, 101.0, 2.0), ns([10.0, 50.0, 95.0])
    levels = 1.0 - 0.1 * np.clip((samples - 40) / 20, 0, 1)
    for clock, flagged in ((None, [True] * 3), (5.0, [False, True, False]), (1.0, [False] * 3)):
        light = line_light(times, ns(samples), levels, 5.0, clock_uncertainty=clock)
        assert (light.flags & Quality.TIMING_SENSITIVE > 0).tolist() == flagged
    assert light.sensitivity.dtype == np.float32
    assert light.sensitivity[1] == pytest.approx(0.005 / (0.95 - 0.005), rel=1e-4)
    # of a clear sky, 0.1 %/min, as near noon, is 0.07 % in 40 s
    samples = np.arange(0.0, 601.0, 2.0)
    light = line_light(ns([100.0, 300.0]), ns(samples), 1.0 - 0.001 * samples / 60, 5.0)
    assert not light.flags.any()
    assert light.sensitivity.max() < 0.001
    # one sample tells nothing of timing
    assert timing_sensitivity(np.array([5]), np.array([5]), np.ones((1, 2)), 40.0).tolist() == [0.0]


def test_impossible_seconds_are_named_together() -> None:
    with refusal(SchemaError, "value-out-of-range", "max_gap", "-1.0 s", "clock_uncertainty", "-2.0 s"):
        line_light(ns([0.0]), ns([0.0]), np.ones(1), -1.0, clock_uncertainty=-2.0)


@pytest.mark.parametrize(
    ("flag", "limit", "level"),
    [
        (Quality.ILLUMINATION_UNSTABLE, 0.02, lambda change: np.array([1.0, 1.0 + change])),
        (Quality.TIMING_SENSITIVE, 0.01, lambda change: np.array([1.0, 1.0 + 2.0 * change])),
    ],
)
def test_flags_of_changing_light_have_their_limits(flag: Quality, limit: float, level: Callable) -> None:
    # the line is in the middle of two samples, and the clocks agree to half their interval
    for share in (0.7, 1.5):
        flags = line_light(ns([5.0]), ns([0.0, 10.0]), level(share * limit), clock_uncertainty=5.0).flags
        assert bool(flags[0] & flag) == (share > 1.0)


def test_the_flag_of_a_low_sun_begins_at_75_degrees() -> None:
    morning = np.datetime64("2024-04-03T06:00", "ns") + np.arange(0, 7200, 60).astype("timedelta64[s]")
    zenith, _ = solar_position(morning, 0.0, 0.0)
    place = np.zeros(morning.size)
    flags = line_light(morning, morning[[0, -1]], np.ones(2), 1e9, place, place).flags
    np.testing.assert_array_equal((flags & Quality.LOW_SUN) != 0, zenith > 75.0)
