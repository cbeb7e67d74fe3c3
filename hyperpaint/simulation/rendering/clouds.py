"""A layer of clouds over a clear sky: how much light is left, of which colour, and from where.

*Amount*: Kasten & Czeplak (Solar Energy 24, 1980) found in ten years at Hamburg that N oktas of cloud leave
``1 - 0.75 (N/8)^3.4`` of the clear sky's global irradiance. The direct beam is taken to be hidden for N/8 of
the time; what is left beyond it is diffuse.

*Colour*: Bartlett, Ciotti, Davis & Cullen (J. Geophys. Res. 103, 31017, 1998) fitted the ratio of cloudy to
clear irradiance over 412-700 nm with ``CF (a(CF) + b(CF) (lambda/490)^-4)``, where the cloud factor CF is
the ratio at 490 nm: overcast light is slightly bluer. Their coefficients were seen here second-hand only
(a = 0.76 + 0.24 CF, b = 0.24 (1 - CF)), so that they are an argument. Limits: the broadband factor of Kasten
& Czeplak stands for CF; beyond 700 nm the form is extrapolated; longer paths of light in clouds deepen the
bands of water and oxygen, which is left out; the same authors found skies (Bering Sea) that do not follow it.

*Direction*: the CIE overcast sky (Moon & Spencer 1942), L = L_zenith (1 + 2 cos theta) / 3, is a sum of a
uniform sky and one whose radiance goes with cos theta. On a level surface the first gives pi L_z / 3 and the
second 4 pi L_z / 9: shares of 3/7 and 4/7 of the diffuse irradiance.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import Problems, SchemaError

if TYPE_CHECKING:
    from .four_curves import Atmosphere

__all__ = ["CIE_OVERCAST_SHARE", "add_clouds", "cloud_factor", "cloud_transmittance"]


CIE_OVERCAST_SHARE = 4.0 / 7.0
"""Share of the cosine part in the diffuse irradiance of a CIE overcast sky."""

_REFERENCE = 490.0  # nm


def cloud_factor(oktas: float) -> float:
    """Return the part of a clear sky's global irradiance that ``oktas`` eighths of cloud leave.

    Parameters
    ----------
    oktas
        Cloud amount, 0 to 8.

    Raises
    ------
    SchemaError
        There are no such oktas.

    Examples
    --------
    >>> cloud_factor(8)
    0.25
    """
    if not 0.0 <= oktas <= 8.0:
        raise SchemaError(f"cloud amount is {oktas!r} oktas, expected 0 (clear) to 8 (overcast)")
    return float(1.0 - 0.75 * (oktas / 8.0) ** 3.4)


def cloud_transmittance(wavelength: Floats, oktas: float, *, colour: float = 0.24) -> Floats:
    """Return global irradiance under clouds over that of the clear sky.

    Parameters
    ----------
    wavelength
        Any shape [nm].
    oktas
        Cloud amount, 0 to 8.
    colour
        Strength of the blue tint, 0 to 1: b = colour (1 - CF) and a = 1 - b; 0 for grey clouds.

    Returns
    -------
    numpy.ndarray
        Shape of ``wavelength`` [1].

    Raises
    ------
    SchemaError
        ``oktas`` or ``colour`` is outside its range; both are listed.

    Examples
    --------
    >>> cloud_transmittance(np.array([400.0, 490.0, 700.0, 1000.0]), 8).round(3)
    array([0.306, 0.25 , 0.216, 0.208])
    """
    problems = Problems("clouds cannot be made", SchemaError)
    if not 0.0 <= oktas <= 8.0:
        problems.add(f"cloud amount is {oktas!r} oktas, expected 0 (clear) to 8 (overcast)")
    if not 0.0 <= colour <= 1.0:
        problems.add(f"colour is {colour!r}, expected 0 (grey) to 1")
    problems.raise_if_any()
    factor = cloud_factor(oktas)
    tint = colour * (1.0 - factor)
    return np.asarray(factor * (1.0 - tint + tint * (wavelength / _REFERENCE) ** -4.0))


def add_clouds(clear: Atmosphere, oktas: float, *, colour: float = 0.24) -> Atmosphere:
    """Return a clear atmosphere with clouds over it; see `Atmosphere.clouded`."""
    from .four_curves import Atmosphere

    hidden = oktas / 8.0
    left = cloud_transmittance(clear.wavelength, oktas, colour=colour)
    sun = clear.sun * (1.0 - hidden)
    sky = clear.irradiance * left - sun * clear.sun_cosine
    if clear.haze is not None:
        path = clear.haze.path_radiance(clear.wavelength, sun, sky, clear.sun_zenith)
    else:
        # from what directions the air scatters is not known: in proportion to the light at a point in the air
        before, after = clear.sun + 2.0 * clear.sky, sun + 2.0 * sky
        path = clear.path_radiance * np.divide(after, before, out=np.zeros_like(after), where=before > 0)
    return Atmosphere(
        wavelength=clear.wavelength,
        sun=sun,
        sky=sky,
        extinction=clear.extinction,
        path_radiance=path,
        sun_zenith=clear.sun_zenith,
        sun_azimuth=clear.sun_azimuth,
        overcast_share=(1.0 - hidden) * clear.overcast_share + hidden * CIE_OVERCAST_SHARE,
        name=f"{clear.name}, {oktas:g} oktas" if clear.name else f"{oktas:g} oktas",
        haze=clear.haze,
    )
