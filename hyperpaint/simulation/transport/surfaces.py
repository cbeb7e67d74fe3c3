"""What a surface does with light: Fresnel's equations, the GGX microfacet lobe, the diffuse lobe.

Directions are given in the frame of the surface, z along its normal, and point away from it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from hyperpaint.base.arrays import Array
from hyperpaint.base.jit import borrowing_kernel

from .vectors import Vector, unit

__all__ = [
    "SMALLEST_ALPHA", "Surfaces", "facet_density", "facet_lambda", "fresnel", "internal_reflectance",
    "refracted_cosine", "sample_cosine", "sample_facet",
]  # fmt: skip


#: A smoother coat is taken to be as rough as this: its image of a point sun would never be met.
SMALLEST_ALPHA = 1e-3


class Surfaces(NamedTuple):
    """What is known of every material; arrays of shape (material,).

    Attributes
    ----------
    coat_index : float64
        Refractive index of the clear coat; 0 without one.
    coat_alpha : float64
        GGX alpha of the coat.
    internal : float64
        Hemispherical reflectance of the coat for diffuse light from within, `internal_reflectance`; 0
        without a coat.
    flake_share : float64
        Part of the light that enters the paint and meets flakes.
    flake_alpha : float64
        GGX alpha of the flakes.
    base_factor : int32
        Number of the spectrum of the diffuse base.
    flake_factor : int32
        Number of the spectrum of the flakes; -1 without them.
    """

    coat_index: Array
    coat_alpha: Array
    internal: Array
    flake_share: Array
    flake_alpha: Array
    base_factor: Array
    flake_factor: Array


def internal_reflectance(index: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return the reflectance of a smooth surface for diffuse light that comes from within.

    Parameters
    ----------
    index
        Refractive index [1], above 1; any shape.

    Returns
    -------
    Reflectance [1], same shape.

    Notes
    -----
    Fi = 1 - (1 - Fe) / n^2, with Fe the integral of Fresnel's equations over diffuse light from outside:
    J. W. T. Walsh, in Dept. Sci. Indust. Res. Illum. Res. Tech. Pap. 2 (1926); S. Q. Duntley, J. Opt. Soc.
    Am. 32, 61 (1942).

    Examples
    --------
    >>> round(float(internal_reflectance(1.5)), 4)
    0.5963
    """
    n = np.asarray(index, np.float64)
    square, fourth = n**2, n**4
    external = (
        0.5
        + (n - 1) * (3 * n + 1) / (6 * (n + 1) ** 2)
        + square * (square - 1) ** 2 / (square + 1) ** 3 * np.log((n - 1) / (n + 1))
        - 2 * n**3 * (square + 2 * n - 1) / ((square + 1) * (fourth - 1))
        + 8 * fourth * (fourth + 1) / ((square + 1) * (fourth - 1) ** 2) * np.log(n)
    )
    return np.asarray(1 - (1 - external) / square)


@borrowing_kernel
def fresnel(cosine: float, index: float) -> float:
    """Return the reflectance of a smooth dielectric for unpolarised light from outside."""
    g2 = index * index - 1.0 + cosine * cosine
    g = math.sqrt(g2)
    a = (g - cosine) / (g + cosine)
    b = (cosine * (g + cosine) - 1.0) / (cosine * (g - cosine) + 1.0)
    return 0.5 * a * a * (1.0 + b * b)


@borrowing_kernel
def refracted_cosine(cosine: float, index: float) -> float:
    """Return the cosine inside a medium for a cosine outside (Snell's law)."""
    return math.sqrt(1.0 - (1.0 - cosine * cosine) / (index * index))


@borrowing_kernel
def facet_density(cosine: float, alpha: float) -> float:
    """Return the GGX density D of facets whose normals stand at a cosine to the surface normal [sr-1].

    B. Walter, S. R. Marschner, H. Li, K. E. Torrance, "Microfacet models for refraction through rough
    surfaces", EGSR (2007), equation 33.
    """
    square = alpha * alpha
    # 1 + (a^2 - 1) cos^2, without the cancellation near the normal
    root = (1.0 - cosine * cosine) + square * cosine * cosine
    return square / (math.pi * root * root)


@borrowing_kernel
def facet_lambda(cosine: float, alpha: float) -> float:
    """Return Smith's Lambda of GGX: G1 = 1 / (1 + Lambda), G2 = 1 / (1 + Lambda_o + Lambda_i).

    E. Heitz, "Understanding the masking-shadowing function in microfacet-based BRDFs", JCGT 3 (2014),
    equations 72 and 99 (height-correlated).
    """
    square = cosine * cosine
    return 0.5 * (math.sqrt(1.0 + alpha * alpha * (1.0 - square) / square) - 1.0)


@borrowing_kernel
def sample_facet(view: Vector, alpha: float, u: float, v: float) -> Vector:
    """Return the normal of a GGX facet that is visible from a direction.

    E. Heitz, "Sampling the GGX distribution of visible normals", JCGT 7 (2018). A reflection about it has
    the weight F G2 / G1.
    """
    x, y, z = unit((alpha * view[0], alpha * view[1], view[2]))  # stretched: the facets of a sphere
    plane = math.sqrt(x * x + y * y)
    ax, ay = (-y / plane, x / plane) if plane > 0.0 else (1.0, 0.0)
    bx, by, bz = -z * ay, z * ax, x * ay - y * ax
    radius = math.sqrt(u)
    s, t = radius * math.cos(2.0 * math.pi * v), radius * math.sin(2.0 * math.pi * v)
    half = 0.5 * (1.0 + z)
    t = (1.0 - half) * math.sqrt(max(0.0, 1.0 - s * s)) + half * t
    r = math.sqrt(max(0.0, 1.0 - s * s - t * t))
    hx, hy, hz = s * ax + t * bx + r * x, s * ay + t * by + r * y, t * bz + r * z
    return unit((alpha * hx, alpha * hy, max(hz, 1e-12)))


@borrowing_kernel
def sample_cosine(u: float, v: float) -> Vector:
    """Return a direction with density cos / pi (Lambert's lobe)."""
    radius = math.sqrt(u)
    angle = 2.0 * math.pi * v
    return radius * math.cos(angle), radius * math.sin(angle), math.sqrt(1.0 - u)
