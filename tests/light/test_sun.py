"""The sun against pvlib's SPA, and the split of its light against published numbers."""

import numpy as np
import pytest

from hyperpaint.light.clear_sky import air_mass
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


def test_units_of_time_and_missing_stamps() -> None:
    stamps = np.array(["2020-06-21T17:15", "NaT"], "datetime64[s]")
    zenith, azimuth = solar_position(stamps, 43.08, -77.67)
    assert zenith[0] == pytest.approx(19.66, abs=0.05)
    assert np.isnan([zenith[1], azimuth[1]]).all()
    for unit in ("ms", "us", "ns"):
        assert solar_position(stamps.astype(f"datetime64[{unit}]"), 43.08, -77.67)[0][0] == zenith[0]
    assert np.isnan(solar_position(stamps[0], np.nan, 0.0)[0])


def test_air_mass() -> None:
    assert air_mass(0.0) == pytest.approx(1.0, abs=1e-3)
    assert air_mass(60.0) == pytest.approx(1.994, abs=2e-3)
    assert air_mass(85.0) == pytest.approx(10.3, abs=0.2)


@pytest.mark.parametrize(
    ("zenith", "expected"),
    [(28.0, [0.30, 0.23, 0.15, 0.10, 0.06]), (53.0, [0.40, 0.31, 0.19, 0.14, 0.08])],
)
def test_diffuse_fraction_of_the_notes(zenith: float, expected: list[float]) -> None:
    found = diffuse_fraction([400.0, 450.0, 550.0, 650.0, 850.0], zenith)
    np.testing.assert_allclose(found, expected, atol=0.03)


def test_without_sun_all_light_is_diffuse() -> None:
    for zenith in (90.5, 95.0, 120.0, 180.0):
        np.testing.assert_array_equal(diffuse_fraction([450.0, 850.0], zenith), 1.0)
    rising = [diffuse_fraction([550.0], z)[0] for z in (0.0, 30.0, 60.0, 75.0, 85.0, 89.9)]
    assert (np.diff(rising) > 0).all()
    assert rising[-1] <= 1.0
