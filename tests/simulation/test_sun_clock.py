"""A simulated flight's clock: its sun stands where the scene is lit from."""

from __future__ import annotations

import numpy as np
import pytest

from hyperpaint.base.errors import SchemaError
from hyperpaint.light.sun import solar_position
from hyperpaint.simulation.flight import ORIGIN
from hyperpaint.simulation.settings import NEAR_SUNSET
from hyperpaint.simulation.sun_clock import USUAL_START, sun_at, when_sun_stands

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


@pytest.mark.parametrize(
    ("zenith", "azimuth", "apart"),
    [(60.0, 178.0, 1.0), (50.0, 250.0, 12.0), (75.0, 178.0, 360.0), (*NEAR_SUNSET, 12.0)],
)
def test_the_clock_has_the_sun_of_the_scene(zenith: float, azimuth: float, apart: float) -> None:
    moment = when_sun_stands(zenith, azimuth, *PLACE)
    seen, at = sun_at(moment, *PLACE)
    assert float(seen) == pytest.approx(zenith, abs=1.0)
    assert abs(float(at) - azimuth) <= apart


def test_the_usual_clock_stays_where_it_is_as_good_and_no_clock_has_a_sun_that_never_stands_there() -> None:
    assert when_sun_stands(25.0, 178.0, *PLACE) == USUAL_START
    with pytest.raises(SchemaError, match="never stands there"):
        when_sun_stands(5.0, 178.0, *PLACE)
