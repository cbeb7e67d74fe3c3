"""Clear skies: what of the sun arrives at the ground directly, and what by way of the sky."""

from __future__ import annotations

import numpy as np

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import MissingExtraError, SchemaError
from hyperpaint.simulation.atmosphere import Sky

__all__ = ["built_in_sky", "check_wavelengths", "relative_air_mass", "spectrl2_sky"]


def check_wavelengths(wavelength: Floats) -> None:
    """Refuse what is no grid of wavelengths.

    Raises
    ------
    SchemaError
        The grid has not one dim and two samples, or they are not positive, finite and increasing.
    """
    if wavelength.ndim != 1 or wavelength.size < 2:
        raise SchemaError(f"wavelength has shape {wavelength.shape}, expected one dim and at least 2 samples")
    if not (np.isfinite(wavelength).all() and wavelength[0] > 0.0 and (np.diff(wavelength) > 0.0).all()):
        raise SchemaError("wavelength must be positive, finite and increasing [nm]; sort it, drop duplicates")


def built_in_sky(
    wavelength: Floats, sun_zenith: float, *, aerosol: float = 0.10, ozone: float = 0.31, water: float = 1.0
) -> tuple[Floats, Floats]:
    """Return direct normal and diffuse level irradiance of the simulator's own sky [W m-2 nm-1].

    The model of `hyperpaint.simulation.atmosphere.Sky`, with the air mass of Kasten & Young in place of
    1 / cos(zenith).

    Parameters
    ----------
    wavelength
        Increasing, shape (wavelength,) [nm].
    sun_zenith
        Angle between the sun and the vertical [degree].
    aerosol, ozone, water
        As for `Sky`.

    Raises
    ------
    SchemaError
        The sun is not above the horizon, or the wavelengths are no grid.
    """
    check_wavelengths(wavelength)
    mass = relative_air_mass(sun_zenith)
    sky = Sky(sun_zenith=sun_zenith, aerosol=aerosol, ozone=ozone, water=water, airmass=mass)
    direct, diffuse = sky.irradiance(wavelength)
    # Sky gives the direct light of a level surface
    return direct / np.cos(np.radians(sun_zenith)), diffuse


def spectrl2_sky(
    wavelength: Floats,
    sun_zenith: float,
    *,
    aerosol: float = 0.10,
    ozone: float = 0.31,
    precipitable_water: float = 1.5,
    ground: float = 0.15,
    pressure: float = 101325.0,
    dayofyear: int = 172,
) -> tuple[Floats, Floats]:
    """Return direct normal and diffuse level irradiance of SPECTRL2 [W m-2 nm-1].

    Parameters
    ----------
    wavelength
        Shape (wavelength,), within 300 to 4000 [nm]; straight lines join SPECTRL2's samples.
    sun_zenith
        Angle between the sun and the vertical [degree].
    aerosol, ozone, precipitable_water, ground, pressure, dayofyear
        As for `Atmosphere.spectrl2`.

    Raises
    ------
    MissingExtraError
        pvlib is not installed.
    SchemaError
        The sun is not above the horizon, or the wavelengths are no grid or leave SPECTRL2's.
    """
    check_wavelengths(wavelength)
    try:
        from pvlib.spectrum import spectrl2
    except ImportError as error:
        needed = MissingExtraError.of("pvlib", "sim", "the SPECTRL2 atmosphere")
        raise needed from error
    found = spectrl2(
        apparent_zenith=sun_zenith,
        aoi=sun_zenith,
        surface_tilt=0.0,
        ground_albedo=ground,
        surface_pressure=pressure,
        relative_airmass=relative_air_mass(sun_zenith),
        precipitable_water=precipitable_water,
        ozone=ozone,
        aerosol_turbidity_500nm=aerosol,
        dayofyear=dayofyear,
    )
    coarse = np.asarray(found["wavelength"], dtype=np.float64)
    if not (coarse[0] <= wavelength[0] and wavelength[-1] <= coarse[-1]):
        span = f"from {wavelength[0]:g} to {wavelength[-1]:g} nm"
        raise SchemaError(f"wavelength goes {span}; SPECTRL2 covers {coarse[0]:g} to {coarse[-1]:g} nm")
    sun, sky = (np.interp(wavelength, coarse, np.ravel(found[name])) for name in ("dni", "dhi"))
    return sun, sky


def relative_air_mass(sun_zenith: float) -> float:
    """Return the relative optical air mass of Kasten & Young (Applied Optics 28, 4735, 1989).

    Parameters
    ----------
    sun_zenith
        Apparent zenith angle, 0 to 90 [degree].

    Raises
    ------
    SchemaError
        The sun is not above the horizon.

    Examples
    --------
    >>> round(relative_air_mass(85.0), 2), round(float(1.0 / np.cos(np.radians(85.0))), 2)
    (10.31, 11.47)
    """
    if not 0.0 <= sun_zenith <= 90.0:
        raise SchemaError(f"sun_zenith is {sun_zenith!r}, expected 0 to 90 degrees")
    return float(1.0 / (np.cos(np.radians(sun_zenith)) + 0.50572 * (96.07995 - sun_zenith) ** -1.6364))
