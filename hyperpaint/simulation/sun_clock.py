"""Clock of a simulated flight: the time at which the sun is in the direction that lights the scene.

The ephemeris is independent of the one in `hyperpaint.light`.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from hyperpaint.base.arrays import Array, Floats
from hyperpaint.base.errors import SchemaError

#: Default start of a flight.
DEFAULT_START = np.datetime64("2021-07-20T17:10:00", "ns")

#: Maximum angle between the sun at the default start and the sun of the scene, to use this start [degree].
MAX_DEFAULT_ANGLE_DEG = 3.0

#: Maximum angle between the sun at another time and the sun of the scene, to use this time [degree].
MAX_ANGLE_DEG = 1.0


def sun_at(moment: Array, latitude: float, longitude: float) -> tuple[Floats, Floats]:
    """Return zenith angle and azimuth of the sun [degree] at UTC times, to some hundredths of a degree.

    The low-precision ephemeris of the Astronomical Almanac, without refraction.

    Examples
    --------
    >>> zenith, azimuth = sun_at(np.datetime64("2021-07-20T17:10"), 43.04, -77.7)
    >>> float(zenith.round(1)), float(azimuth.round(-1))
    (22.6, 180.0)
    """
    days = (np.asarray(moment, "datetime64[s]") - np.datetime64("2000-01-01T12:00:00")).astype(float) / 86400
    anomaly = np.radians(357.528 + 0.9856003 * days)
    longitude_deg = 280.460 + 0.9856474 * days + 1.915 * np.sin(anomaly) + 0.020 * np.sin(2 * anomaly)
    ecliptic, tilt = np.radians(longitude_deg), np.radians(23.439 - 4e-7 * days)
    ascension = np.arctan2(np.cos(tilt) * np.sin(ecliptic), np.cos(ecliptic))
    declination = np.arcsin(np.sin(tilt) * np.sin(ecliptic))
    # sidereal rotation: one more turn in a year than days
    hour = np.radians(280.46062 + 360.98564737 * days + longitude) - ascension
    phi = np.radians(latitude)
    height = np.sin(phi) * np.sin(declination) + np.cos(phi) * np.cos(declination) * np.cos(hour)
    north = np.cos(phi) * np.sin(declination) - np.sin(phi) * np.cos(declination) * np.cos(hour)
    east = -np.cos(declination) * np.sin(hour)
    return np.degrees(np.arccos(np.clip(height, -1, 1))), np.degrees(np.arctan2(east, north)) % 360.0


@lru_cache(maxsize=64)
def when_sun_stands(zenith: float, azimuth: float, latitude: float, longitude: float) -> np.datetime64:
    """Return the time at which the sun is in a direction [degree], on the default day or in its year.

    The default start is used if its sun is within `MAX_DEFAULT_ANGLE_DEG` of the direction; otherwise the
    time with the nearest direction, first on the default day, then in its year.

    If the sun is never in this direction (in the north, or high in the east), only the zenith angle agrees:
    the brightness fits the clock, the azimuth of the light does not.

    Raises
    ------
    SchemaError
        The sun never has that zenith angle.

    Examples
    --------
    >>> when_sun_stands(25.0, 178.0, 43.0845, -77.6749)
    np.datetime64('2021-07-20T17:10:00.000000000')
    """
    if (
        _angle_between(*sun_at(np.asarray(DEFAULT_START), latitude, longitude), zenith, azimuth)
        <= MAX_DEFAULT_ANGLE_DEG
    ):
        return DEFAULT_START
    minute = np.timedelta64(1, "m")
    # the default day, from noon to noon UTC, for a place in the west
    default_day = DEFAULT_START.astype("datetime64[m]") + np.arange(-12 * 60, 12 * 60) * minute
    year = DEFAULT_START.astype("datetime64[Y]").astype("datetime64[m]") + np.arange(365 * 24 * 60) * minute
    suns = []
    for moments in (default_day, year):
        zeniths, azimuths = sun_at(moments, latitude, longitude)
        angles = _angle_between(zeniths, azimuths, zenith, azimuth)
        nearest = int(np.argmin(angles))
        if angles[nearest] <= MAX_ANGLE_DEG:
            return np.datetime64(moments[nearest], "ns")
        suns.append((moments, zeniths, azimuths))
    for moments, zeniths, azimuths in suns:
        azimuth_differences = np.abs((azimuths - azimuth + 180.0) % 360.0 - 180.0)
        # of morning and afternoon, take the time with the nearer azimuth
        nearest = int(np.argmin(np.abs(zeniths - zenith) + 1e-3 * azimuth_differences))
        if abs(zeniths[nearest] - zenith) <= MAX_ANGLE_DEG:
            return np.datetime64(moments[nearest], "ns")
    min_zenith = sun_at(year, latitude, longitude)[0].min()
    raise SchemaError(
        f"sun_zenith={zenith:g}: at {latitude:.1f} degrees north the sun is always "
        f"{min_zenith:.1f} degrees or more from the zenith",
        mend="pass start_time= for a clock that disagrees with the sun, or another sun_zenith",
        code="sun-unreachable",
    )


def _angle_between(zenith: Floats, azimuth: Floats, other_zenith: float, other_azimuth: float) -> Floats:
    zenith_rad, other_zenith_rad = np.radians(zenith), np.radians(other_zenith)
    turn = np.cos(np.radians(azimuth - other_azimuth))
    cosine = (
        np.cos(zenith_rad) * np.cos(other_zenith_rad) + np.sin(zenith_rad) * np.sin(other_zenith_rad) * turn
    )
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))
