"""A clock that agrees with the sun of a simulated flight: when it stands where the scene is lit from.

Shares no code with the chain, whose ephemeris is another one.
"""

from __future__ import annotations

import numpy as np

from hyperpaint.base.arrays import Array, Floats
from hyperpaint.base.errors import SchemaError

__all__ = ["USUAL_START", "sun_at", "when_sun_stands"]

USUAL_START = np.datetime64("2021-07-20T17:10:00", "ns")
"""When a flight starts unless its sun says otherwise."""

MAX_APART_DEG = 3.0
"""Distance of the usual clock's sun from that of the scene, up to which the usual clock is kept [degree]."""

MAX_AZIMUTH_APART_DEG = 12.0
"""Distance in azimuth up to which the usual day is kept [degree]."""


def sun_at(moment: Array, latitude: float, longitude: float) -> tuple[Floats, Floats]:
    """Return zenith angle and azimuth of the sun [degree] at UTC moments, to some hundredths of a degree.

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


def when_sun_stands(zenith: float, azimuth: float, latitude: float, longitude: float) -> np.datetime64:
    """Return when the sun stands at two angles [degree], on the usual day or else on another of its year.

    The usual start where its sun is as good; where the sun never stands at that azimuth with that zenith
    angle, the time of the usual day with the zenith angle. Raises `SchemaError`: that is not reached either.
    """
    usual, _ = sun_at(np.asarray(USUAL_START), latitude, longitude)
    if abs(float(usual) - zenith) <= MAX_APART_DEG:
        return USUAL_START
    day = USUAL_START.astype("datetime64[D]")
    minutes = np.arange(24 * 60).astype("timedelta64[m]")
    # of a place in the west, the day is that of its noon
    today = USUAL_START.astype("datetime64[m]") + minutes - np.timedelta64(12, "h")
    seen, at = sun_at(today, latitude, longitude)
    apart = np.abs((at - azimuth + 180.0) % 360.0 - 180.0)
    nearest = int(np.argmin(np.abs(seen - zenith) + 1e-3 * apart))
    is_reached = abs(seen[nearest] - zenith) < 1.0
    if not (is_reached and apart[nearest] < MAX_AZIMUTH_APART_DEG):
        year = day.astype("datetime64[Y]").astype("datetime64[D]") + np.arange(365)
        moments = year[:, None].astype("datetime64[m]") + minutes
        seen, at = sun_at(moments, latitude, longitude)
        one, other = np.radians(seen), np.radians(zenith)
        cosine = np.cos(one) * np.cos(other) + np.sin(one) * np.sin(other) * np.cos(np.radians(at - azimuth))
        best = np.unravel_index(int(np.argmax(cosine)), cosine.shape)
        if np.degrees(np.arccos(min(cosine[best], 1.0))) < 1.0:
            return np.datetime64(moments[best], "ns")
    if not is_reached:
        raise SchemaError(
            f"sun_zenith={zenith:g}: the sun never stands there at {latitude:.1f} degrees north, and a clock "
            "with another sun makes the light look like that of a cloudy sky",
            mend="give start_time= for a clock that is wrong on purpose, or another sun_zenith",
        )
    return np.datetime64(today[nearest], "ns")
