"""Kinds of light over a simulated collect."""

from __future__ import annotations

import numpy as np

from hyperpaint.base.arrays import Floats

from .atmosphere import Sky
from .rendering.sky_models import cloud_transmittance, relative_air_mass

__all__ = ["sky_irradiance"]


_OVERCAST = 8.0  # oktas


def sky_irradiance(sky: str, sun_zenith: float, wavelength: Floats) -> Floats:
    """Return direct and diffuse irradiance of a level surface, shape (2, wavelength) [W m-2 nm-1].

    Parameters
    ----------
    sky
        One of `hyperpaint.simulation.settings.SKIES`. Under an overcast one a quarter of the clear sky's
        light is left, slightly bluer (`rendering.sky_models`), and none of the sun.
    sun_zenith
        [degree]
    wavelength
        [nm]

    Examples
    --------
    >>> direct, diffuse = sky_irradiance("overcast", 25.0, np.array([550.0, 850.0]))
    >>> direct, diffuse.round(3)
    (array([0., 0.]), array([0.329, 0.191]))
    """
    # the layers of the air are curved, which matters where the sun is low
    airmass = relative_air_mass(sun_zenith) if sky == "near_sunset" else None
    clear = np.stack(Sky(sun_zenith, airmass=airmass).irradiance(wavelength))
    if sky == "overcast":
        diffuse = clear.sum(axis=0) * cloud_transmittance(wavelength, _OVERCAST)
        return np.stack([np.zeros_like(diffuse), diffuse])
    return clear
