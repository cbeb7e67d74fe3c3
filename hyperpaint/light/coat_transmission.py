r"""Transmission of a clear coat for light of sun and sky, and for light that leaves.

A Lambertian body under a coat of index n, lit from the angle i and seen at the angle v, sends
:math:`T(i) T(v) b / (n^2 (1 - b F_i))` of a perfect diffuser's light, :math:`T = 1 - F` the interface's
transmittance and :math:`F_i` its diffuse internal reflectance. The factors that depend on the body, the
albedo b and all internal returns, are the same in every geometry. Relative to the same paint lit and seen
near its normal, as by a field spectrometer, there remains

.. math:: C = \frac{f_{dir} T(\theta_s) + f_{dif} (1 - F_{sky})}{T(0)} \cdot \frac{T(\theta_v)}{T(0)}

with :math:`F_{sky}` the mean of F over the sky as level ground is lit by it: 0.092 of a uniform sky, more of
a clear one, which is bright at the horizon. Not for flakes, whose light leaves in a cone.
"""

import functools
from typing import Any

import numpy as np

from hyperpaint.base import ArrayLike, Floats

from .clear_sky import between_nodes, dome, dome_radiance

#: Refractive index of automotive clear coats, 1.48 to 1.55, and its standard uncertainty [1].
COAT_INDEX, COAT_INDEX_U = 1.5, 0.03


def interface_reflectance(angle: ArrayLike, index: float = COAT_INDEX) -> Floats:
    """Return Fresnel's reflectance for unpolarised light from outside at an angle of incidence [degree].

    Examples
    --------
    >>> print(interface_reflectance([0.0, 60.0, 75.0]).round(3))
    [0.04  0.089 0.253]
    """
    return _reflectance(np.maximum(np.cos(np.radians(np.asarray(angle, np.float64))), 0.0), index)


def _reflectance(cosine: Floats, index: float) -> Floats:
    cosine_inside = np.sqrt(1.0 - (1.0 - cosine**2) / index**2)
    perpendicular = ((cosine - index * cosine_inside) / (cosine + index * cosine_inside)) ** 2
    parallel = ((cosine_inside - index * cosine) / (cosine_inside + index * cosine)) ** 2
    return np.asarray(0.5 * (perpendicular + parallel))


@functools.lru_cache(maxsize=64)
def _mean_reflectances(sun_zenith: float, index: float) -> tuple[Floats, float]:
    # mean reflectance for a clear sky at the nodes of wavelength (node,), and for CIE's overcast sky
    sky = dome()
    reflected = sky.level * _reflectance(sky.cosine, index)
    overcast = (1.0 + 2.0 * sky.cosine) * 3.0 / 7.0
    return np.tensordot(dome_radiance(sun_zenith), reflected), float((reflected * overcast).sum())


def sky_reflectance(
    wavelength: ArrayLike, sun_zenith: float | None, cloud: float = 0.0, index: float = COAT_INDEX
) -> Floats:
    """Return the reflectance of a level coat for the light of the sky (band,) [1].

    Parameters
    ----------
    wavelength : (band,)
        [nm]
    sun_zenith
        Below 90 [degree]; None for a uniform sky.
    cloud
        Weight of CIE's overcast sky, 0 to 1; the rest is clear.
    index
        Refractive index.

    Examples
    --------
    >>> print(sky_reflectance([550.0], None).round(3), sky_reflectance([550.0], 60.0).round(3))
    [0.092] [0.139]
    """
    if sun_zenith is None:
        sky = dome()
        return np.full(np.shape(wavelength), float((sky.level * _reflectance(sky.cosine, index)).sum()))
    clear, overcast = _mean_reflectances(float(sun_zenith), float(index))
    return np.asarray((1.0 - cloud) * between_nodes(clear, wavelength) + cloud * overcast)


def transmitted_share(
    fraction: Any, sky: Any, incidence: float, view: float = 0.0, index: float = COAT_INDEX
) -> Any:
    """Return C, the transmission of a coat in and out relative to normal incidence and view [1].

    Parameters
    ----------
    fraction : (..., band)
        Diffuse part of the irradiance [1]: an array, or a DataArray.
    sky : (..., band)
        `sky_reflectance` for the same index [1].
    incidence, view
        Angles of the sun and of the camera to the surface's normal [degree].
    index
        Refractive index.

    Examples
    --------
    >>> import numpy as np
    >>> print(transmitted_share(np.array([0.12, 1.0]), 0.0918, 60.0).round(3))
    [0.948 0.946]
    """
    at_normal, entering, leaving = 1.0 - interface_reflectance([0.0, incidence, view], index)
    return ((1.0 - fraction) * entering + fraction * (1.0 - sky)) / at_normal * leaving / at_normal
