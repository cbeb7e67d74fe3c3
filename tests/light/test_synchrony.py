"""Which irradiance samples light each line, and what an error of the clocks could do."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, strategies as st
from support.refusals import refusal

from hyperpaint.base.errors import SchemaError, TimeError
from hyperpaint.base.schema import Quality
from hyperpaint.light.illumination import line_light, timing_sensitivity
from hyperpaint.light.sun import solar_position

START = np.datetime64("2020-06-21T17:00", "ns")


def ns(seconds: object) -> np.ndarray:
    return START + np.round(np.asarray(seconds, float) * 1e9).astype("timedelta64[ns]")


def test_few_samples_and_gaps() -> None:
    light = line_light(ns([0.0, 1.0]), ns([0.0]), np.ones(1))
    np.testing.assert_array_equal(light.weight, [0.0, np.nan])
    # the largest gap is two and a half intervals
    light = line_light(ns([5.0, 8.0, 12.0, 10.0]), ns([0.0, 2, 4, 6, 10, 16, 18]), np.ones(7))
    assert np.isnan(light.weight).tolist() == [False, False, True, False]
    # far from 1970 no bit is lost
    assert line_light(ns([1e-9]), ns([0.0, 3e-9]), np.ones(2), 1.0).weight[0] == 1 / 3


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


def test_spectra_without_a_value_are_passed_over() -> None:
    light = line_light(ns([1.0, 2.0]), ns([0.0, 1.0, 4.0]), np.array([1.0, np.nan, 1.0]), 5.0)
    assert (light.before.tolist(), light.after.tolist()) == ([0, 0], [2, 2])
    np.testing.assert_array_equal(light.weight, [0.25, 0.5])
    with pytest.raises(TimeError, match="irradiance-empty"):
        line_light(ns([1.0]), ns([0.0, 2.0]), np.full(2, np.nan))


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
    with refusal(SchemaError, "value-out-of-range", "max_gap", "-1 s", "clock_uncertainty", "-2 s"):
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
