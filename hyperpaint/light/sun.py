"""Position of the sun, and the split of clear-sky light into direct and diffuse."""

from typing import NamedTuple

import numpy as np

from hyperpaint.base.facts import documented, takes_quantities
from hyperpaint.base.schema import ArrayLike, Floats

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


def air_mass(zenith: ArrayLike) -> Floats:
    """Return the relative optical air mass at a zenith angle [degree] (Kasten 1966, as in SPECTRL2).

    Examples
    --------
    >>> print(air_mass(60.0).round(3))
    1.993
    """
    zenith = np.asarray(zenith, np.float64)
    below = np.clip(93.885 - zenith, 1e-3, None)
    return np.asarray(1.0 / (np.cos(np.radians(zenith)) + 0.15 * below**-1.253))


def diffuse_fraction(
    wavelength: ArrayLike,
    zenith: float,
    *,
    aerosol_optical_depth: float = 0.1,
    angstrom_exponent: float = 1.14,
    pressure: float = 101_325.0,
    ground_reflectance: float = 0.2,
) -> Floats:
    r"""Return the diffuse part of the global horizontal irradiance under a clear sky [1].

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
    The scattering half of SPECTRL2 [1]_: gas absorption is left out, since it acts on both parts alike.
    With :math:`T_r, T_{as}, T_{aa}` the transmittances of Rayleigh scattering, aerosol scattering and
    aerosol absorption and :math:`F_s` the forward fraction, the scattered parts are
    :math:`\tfrac12 (1 - T_r^{0.95}) T_{aa}`, :math:`T_r^{1.5} T_{aa} (1 - T_{as}) F_s` and their
    reflection between sky and ground.

    References
    ----------
    .. [1] R. E. Bird and C. Riordan, "Simple Solar Spectral Model for Direct and Diffuse Irradiance on
       Horizontal and Tilted Planes at the Earth's Surface for Cloudless Atmospheres", J. Climate Appl.
       Meteor. 25, 87-97 (1986). doi:10.1175/1520-0450(1986)025<0087:SSSMFD>2.0.CO;2

    Examples
    --------
    >>> print(diffuse_fraction([450.0, 850.0], zenith=28.0).round(2))
    [0.23 0.06]
    """
    nm = np.atleast_1d(np.asarray(wavelength, np.float64))
    if zenith > 90.0:  # all light comes from the sky
        return np.ones_like(nm)
    direct, diffuse = scattered_light(
        nm, zenith, Scatterers(aerosol_optical_depth, angstrom_exponent, pressure, ground_reflectance)
    )
    return np.asarray(diffuse / (diffuse + direct))


class Scatterers(NamedTuple):
    """Scattering properties of a clear atmosphere.

    Attributes
    ----------
    aerosol
        Optical depth at 500 nm [1].
    angstrom
        Exponent of its decrease with wavelength [1].
    pressure
        At the ground [Pa].
    ground
        Mean reflectance of the surroundings [1].
    """

    aerosol: float | Floats = 0.1
    angstrom: float | Floats = 1.14
    pressure: float | Floats = 101_325.0
    ground: float | Floats = 0.2


def scattered_light(
    wavelength: Floats, zenith: float, air: Scatterers, mass: float | None = None
) -> tuple[Floats, Floats]:
    """Return direct and diffuse level irradiance relative to the sun above the air, without gas absorption.

    The scattering half of SPECTRL2, see `diffuse_fraction`, at ``wavelength`` (point,) [nm] with the sun at
    ``zenith`` [degree]; ``mass`` is the air mass of the direct path, by default `air_mass`.

    Examples
    --------
    >>> direct, diffuse = scattered_light(np.array([450.0, 850.0]), 60.0, Scatterers())
    >>> print(direct.round(3), diffuse.round(3))
    [0.256 0.434] [0.138 0.045]
    """
    um = wavelength / 1000.0
    cosine = max(np.cos(np.radians(zenith)), 1e-3)
    if mass is None:
        mass = float(air_mass(zenith))
    optical_depth = air.aerosol * (um / 0.5) ** -air.angstrom
    albedo = 0.945 * np.exp(-0.095 * np.log(um / 0.4) ** 2)

    def transmittances(path: float) -> tuple[Floats, Floats, Floats]:
        rayleigh = np.exp(-path * air.pressure / 101_325.0 / (um**4 * (115.6406 - 1.335 / um**2)))
        return rayleigh, np.exp(-albedo * optical_depth * path), np.exp(-(1 - albedo) * optical_depth * path)

    def forward(cosine: float) -> float:
        log = np.log(1.0 - 0.65)  # asymmetry of the rural aerosol
        first = log * (1.459 + log * (0.1595 + log * 0.4129))
        second = log * (0.0783 + log * (-0.3824 - log * 0.5874))
        return float(1.0 - 0.5 * np.exp((first + second * cosine) * cosine))

    rayleigh, scattering, absorption = transmittances(mass)
    direct = cosine * rayleigh * scattering * absorption
    violet_correction = np.where(um <= 0.45, (um + 0.55) ** 1.8, 1.0)
    single_scattering = (
        cosine
        * absorption
        * (0.5 * (1 - rayleigh**0.95) + rayleigh**1.5 * (1 - scattering) * forward(cosine))
    )
    rayleigh, scattering, absorption = transmittances(1.8)
    sky = absorption * (0.5 * (1 - rayleigh) + (1 - forward(1 / 1.8)) * rayleigh * (1 - scattering))
    return direct, (
        single_scattering + (direct + single_scattering) * sky * air.ground / (1 - sky * air.ground)
    ) * violet_correction
