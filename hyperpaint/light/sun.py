"""Position of the sun, and the split of clear-sky light into direct and diffuse."""

import numpy as np

from hyperpaint.base import ArrayLike, Floats, documented, takes_quantities

from .clear_sky import ClearSky

_J2000 = np.datetime64("2000-01-01T12:00:00", "ns")


@takes_quantities(latitude="degree", longitude="degree")
@documented()
def solar_position(time: ArrayLike, latitude: ArrayLike, longitude: ArrayLike) -> tuple[Floats, Floats]:
    """Return the zenith angle and the azimuth of the sun [degree].

    Parameters
    ----------
    time
        UTC, datetime64.
    latitude, longitude

    Returns
    -------
    zenith, azimuth
        Geometric zenith angle, without refraction, and azimuth clockwise from north [degree]. NaN where
        an input is missing.

    Notes
    -----
    The low-accuracy series of [1]_, ch. 25, good to 0.01 degree between 1950 and 2050, with UT1 taken for
    UTC (less than 0.9 s, 0.004 degree).

    References
    ----------
    .. [1] J. Meeus, *Astronomical Algorithms*, 2nd ed., Willmann-Bell, 1998.

    Examples
    --------
    >>> zenith, azimuth = solar_position(np.datetime64("2020-06-21T17:15", "ns"), 43.08, -77.67)
    >>> print(f"{zenith:.1f} {azimuth:.1f}")
    19.7 181.6
    """
    stamps = np.asarray(time).astype("datetime64[ns]")
    days = np.where(np.isnat(stamps), np.nan, (stamps - _J2000).astype(np.int64) / 86_400e9)
    century = days / 36_525.0
    mean_longitude = 280.46646 + century * (36_000.76983 + century * 0.0003032)
    anomaly = np.radians(357.52911 + century * (35_999.05029 - century * 0.0001537))
    centre = (
        (1.914602 - century * (0.004817 + century * 0.000014)) * np.sin(anomaly)
        + (0.019993 - century * 0.000101) * np.sin(2 * anomaly)
        + 0.000289 * np.sin(3 * anomaly)
    )
    node = np.radians(125.04 - 1934.136 * century)
    ecliptic = np.radians(mean_longitude + centre - 0.00569 - 0.00478 * np.sin(node))
    obliquity = np.radians(23.439291 - 0.0130042 * century + 0.00256 * np.cos(node))
    declination = np.arcsin(np.sin(obliquity) * np.sin(ecliptic))
    right_ascension = np.arctan2(np.cos(obliquity) * np.sin(ecliptic), np.cos(ecliptic))
    sidereal = 280.46061837 + 360.98564736629 * days + century**2 * 0.000387933
    hour_angle = np.radians(sidereal + np.asarray(longitude, np.float64)) - right_ascension
    phi = np.radians(np.asarray(latitude, np.float64))
    up = np.sin(phi) * np.sin(declination) + np.cos(phi) * np.cos(declination) * np.cos(hour_angle)
    north = np.cos(phi) * np.sin(declination) - np.sin(phi) * np.cos(declination) * np.cos(hour_angle)
    east = -np.cos(declination) * np.sin(hour_angle)
    return np.degrees(np.arctan2(np.hypot(east, north), up)), np.degrees(np.arctan2(east, north)) % 360.0


def diffuse_fraction(
    wavelength: ArrayLike,
    zenith: float,
    *,
    aerosol_optical_depth: float = 0.1,
    angstrom_exponent: float = 1.14,
    pressure: float = 101_325.0,
    ground_reflectance: float = 0.2,
) -> Floats:
    """Return the diffuse part of the global horizontal irradiance under a clear sky [1].

    Parameters
    ----------
    wavelength : (band,)
        [nm]
    zenith
        Zenith angle of the sun [degree].
    aerosol_optical_depth
        At 500 nm [1].
    angstrom_exponent
        Exponent of its decrease with wavelength [1].
    pressure
        At the ground [Pa].
    ground_reflectance
        Mean reflectance of the surroundings [1].

    Notes
    -----
    Scattering alone, from the tables of `hyperpaint.light.clear_sky`: gases are left out. They take nearly
    the same share of both parts; in the water band of 940 nm they change the fraction by 0.007 to 0.02.

    Examples
    --------
    >>> print(diffuse_fraction([450.0, 850.0], zenith=28.0).round(2))
    [0.24 0.06]
    """
    nm = np.atleast_1d(np.asarray(wavelength, np.float64))
    if zenith >= 90.0:  # all light comes from the sky
        return np.ones_like(nm)
    sky = ClearSky(
        zenith,
        aerosol_optical_depth,
        angstrom_exponent,
        pressure=pressure,
        ground=ground_reflectance,
    )
    direct, diffuse = sky.transmittances(nm)
    return np.asarray(diffuse / (diffuse + direct))
