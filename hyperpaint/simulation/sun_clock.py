"""Clock of a simulated flight: the time at which the sun stands where the scene is lit from.

The chain has another ephemeris.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from hyperpaint.base.arrays import Array, Floats
from hyperpaint.base.errors import SchemaError

#: Default start of a flight.
USUAL_START = np.datetime64("2021-07-20T17:10:00", "ns")

#: Largest angle between the sun of the default start and the sun of the scene that keeps that start [degree].
MAX_APART_DEG = 3.0

#: Largest angle between the sun of another time and the sun of the scene for a match [degree].
MAX_OFF_DEG = 1.0


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
    # the Earth turns once more in a year than there are days
    hour = np.radians(280.46062 + 360.98564737 * days + longitude) - ascension
    phi = np.radians(latitude)
    height = np.sin(phi) * np.sin(declination) + np.cos(phi) * np.cos(declination) * np.cos(hour)
    north = np.cos(phi) * np.sin(declination) - np.sin(phi) * np.cos(declination) * np.cos(hour)
    east = -np.cos(declination) * np.sin(hour)
    return np.degrees(np.arccos(np.clip(height, -1, 1))), np.degrees(np.arctan2(east, north)) % 360.0


@lru_cache(maxsize=64)
def when_sun_stands(zenith: float, azimuth: float, latitude: float, longitude: float) -> np.datetime64:
    """Return the time at which the sun stands in a direction [degree], on the default day or in its year.

    The default start is kept where its sun is within `MAX_APART_DEG` of the direction; else the time with the
    nearest direction is taken, first on the default day, then in its year.

    Where the sun never stands in that direction (in the north, or high in the east), only the zenith angle of
    the time fits: the brightness agrees with the clock, the side from which the light comes does not.

    Raises
    ------
    SchemaError
        The sun never has that zenith angle.

    Examples
    --------
    >>> when_sun_stands(25.0, 178.0, 43.0845, -77.6749)
    np.datetime64('2021-07-20T17:10:00.000000000')
    """
    if _apart(*sun_at(np.asarray(USUAL_START), latitude, longitude), zenith, azimuth) <= MAX_APART_DEG:
        return USUAL_START
    minute = np.timedelta64(1, "m")
    # the day around the local noon of a place in the west
    usual_day = USUAL_START.astype("datetime64[m]") + np.arange(-12 * 60, 12 * 60) * minute
    year = USUAL_START.astype("datetime64[Y]").astype("datetime64[m]") + np.arange(365 * 24 * 60) * minute
    suns = []
    for moments in (usual_day, year):
        seen, at = sun_at(moments, latitude, longitude)
        apart = _apart(seen, at, zenith, azimuth)
        nearest = int(np.argmin(apart))
        if apart[nearest] <= MAX_OFF_DEG:
            return np.datetime64(moments[nearest], "ns")
        suns.append((moments, seen, at))
    for moments, seen, at in suns:
        turned = np.abs((at - azimuth + 180.0) % 360.0 - 180.0)
        # morning or afternoon, whichever azimuth is nearer
        nearest = int(np.argmin(np.abs(seen - zenith) + 1e-3 * turned))
        if abs(seen[nearest] - zenith) <= MAX_OFF_DEG:
            return np.datetime64(moments[nearest], "ns")
    least = sun_at(year, latitude, longitude)[0].min()
    raise SchemaError(
        f"sun_zenith={zenith:g}: at {latitude:.1f} degrees north the sun stands {least:.1f} degrees or more "
        "from the zenith",
        mend="give start_time= for a clock that disagrees with the sun, or another sun_zenith",
        code="sun-unreachable",
    )


def _apart(zenith: Floats, azimuth: Floats, other_zenith: float, other_azimuth: float) -> Floats:
    one, other = np.radians(zenith), np.radians(other_zenith)
    turn = np.cos(np.radians(azimuth - other_azimuth))
    cosine = np.cos(one) * np.cos(other) + np.sin(one) * np.sin(other) * turn
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))
