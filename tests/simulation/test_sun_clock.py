"""A simulated flight's clock: its sun stands where the scene is lit from."""

from pathlib import Path

import numpy as np
import pytest

from hyperpaint.base.errors import SchemaError
from hyperpaint.light.sun import solar_position
from hyperpaint.simulation.collect import simulate_collect
from hyperpaint.simulation.settings import (
    DEFAULT_START,
    NEAR_SUNSET,
    ORIGIN,
    SimulationSettings,
    sun_at,
    when_sun_stands,
)

PLACE = ORIGIN[:2]


def test_the_sun_is_that_of_the_chains_own_ephemeris() -> None:
    moments = np.datetime64("2021-01-01T11:00", "ns") + np.arange(0, 365 * 24, 301) * np.timedelta64(
        3600, "s"
    )
    zenith, azimuth = sun_at(moments, *PLACE)
    expected, at = solar_position(moments, np.full(moments.size, PLACE[0]), np.full(moments.size, PLACE[1]))
    day = expected < 85.0
    np.testing.assert_allclose(zenith[day], expected[day], atol=0.15)
    np.testing.assert_allclose((azimuth - at + 180.0)[day] % 360.0, 180.0, atol=0.3)


def direction(zenith: float, azimuth: float) -> np.ndarray:
    up, north = np.radians(zenith), np.radians(azimuth)
    return np.array([np.sin(up) * np.sin(north), np.sin(up) * np.cos(north), np.cos(up)])


def apart(zenith: float, azimuth: float, moment: np.datetime64) -> float:
    # Return the angle between a direction and the sun of the chain's own ephemeris [degree]
    seen, at = solar_position(np.array([moment]), np.array([PLACE[0]]), np.array([PLACE[1]]))
    cosine = direction(zenith, azimuth) @ direction(float(seen[0]), float(at[0]))
    return float(np.degrees(np.arccos(min(cosine, 1.0))))


@pytest.mark.parametrize(
    ("zenith", "azimuth"),
    [(60.0, 178.0), (50.0, 250.0), (24.0, 200.0), (24.0, 160.0), (30.0, 230.0), (45.0, 110.0), NEAR_SUNSET],
)
def test_the_clock_has_the_sun_of_the_scene(zenith: float, azimuth: float) -> None:
    moment = when_sun_stands(zenith, azimuth, *PLACE)
    assert moment != DEFAULT_START
    assert apart(zenith, azimuth, moment) < 1.2


@pytest.mark.parametrize(
    ("zenith", "azimuth"), [(75.0, 170.0), (24.0, 90.0), (24.0, 5.0), (24.0, 350.0), (20.0, 300.0)]
)
def test_where_the_sun_never_stands_there_its_zenith_angle_is_right(zenith: float, azimuth: float) -> None:
    seen, at = sun_at(when_sun_stands(zenith, azimuth, *PLACE), *PLACE)
    assert float(seen) == pytest.approx(zenith, abs=1.0)
    # in the morning for a light from the east, in the afternoon for one from the west
    assert (float(at) > 180.0) == (azimuth > 180.0)


def test_the_usual_clock_stays_where_its_sun_is_as_good() -> None:
    assert when_sun_stands(25.0, 178.0, *PLACE) == DEFAULT_START
    assert when_sun_stands(22.0, 178.0, *PLACE) == SimulationSettings().start == DEFAULT_START


def test_a_sun_that_never_stands_there_is_refused_with_all_else_that_is_wrong(tmp_path: Path) -> None:
    with pytest.raises(SchemaError) as caught:
        simulate_collect(tmp_path / "new", sun_zenith=12, lines=-1)
    assert caught.value.codes == ("value-out-of-range", "sun-unreachable")
    assert caught.value.problems[0].found == "lines=-1"
    assert "sun_zenith=12" in str(caught.value.problems[1])
    assert "start_time=" in str(caught.value)
    assert not (tmp_path / "new").exists()
    assert SimulationSettings(sun_zenith=12, start_time="2021-06-21T17:10:00").start == np.datetime64(
        "2021-06-21T17:10:00"
    )


def test_an_overcast_sky_asks_for_no_time() -> None:
    # Rationale: nothing under a closed cloud shows where its sun stands
    # Expected: the sun's own time where it has one, the usual one where it has none; a given one in any case
    assert (
        SimulationSettings(sky="overcast", sun_zenith=60.0).start == SimulationSettings(sun_zenith=60.0).start
    )
    assert SimulationSettings(sky="overcast", sun_zenith=5.0).start == DEFAULT_START
    given = SimulationSettings(sky="overcast", sun_zenith=60.0, start_time="2021-06-21T12:00:00")
    assert given.start == np.datetime64("2021-06-21T12:00:00")
