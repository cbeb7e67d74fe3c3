"""What a surface does with light: Fresnel's equations, the GGX microfacet lobe, the diffuse lobe, their sum.

Directions are given in the frame of the surface, z along its normal, and point away from it. Three lobes add
up: the clear coat, metal flakes under it, and the diffuse base. Without a coat its index is 1, and every
expression becomes that of a bare surface.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from hyperpaint.base.arrays import Array
from hyperpaint.base.jit import borrowing_kernel

from .vectors import Vector, dot, unit

__all__ = [
    "BASE", "COAT", "ENDED", "FLAKES", "SMALLEST_ALPHA", "WIDENED_ALPHA", "Lobes", "Surfaces",
    "facet_density", "facet_lambda", "fresnel",  "lobes_at", "refracted_cosine",
    "sample_cosine", "sample_facet", "scatter", "sun_weights",
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
        Hemispherical reflectance of the coat for diffuse light from within, `internal_reflectance` of
        `rendering.materials`; 0 without a coat.
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


#: After a diffuse reflection a sun sees coats and flakes at least as rough as this. Light that goes from a
#: diffuse surface by way of a sharp mirror to the sun is met so rarely that it would show as single bright
#: pixels (fireflies). Paths themselves, which end at the sky, follow the lobes as they are: widened, the
#: coats of a car park would lose half a per cent of its light past their horizons.
WIDENED_ALPHA = 0.3

#: What a path has followed.
BASE, COAT, FLAKES, ENDED = 0, 1, 2, 3

#: A base under a coat is followed with four times its fair chance against the coat: paints reflect that much.
_BASE_PREFERENCE = 0.25

_GRAZING = 1e-9  # cosines below this carry no light


class Lobes(NamedTuple):
    """A surface, seen from one direction."""

    refraction: float  # index of the coat; 1 for none
    coat_alpha: float
    flake_alpha: float
    least_alpha: float  # that a sun sees
    share: float  # of the flakes
    outgoing: Vector  # where the path came from
    passed: float  # transmission of the coat towards there
    base: float  # weight of the base, without the transmission of what comes in


@borrowing_kernel
def lobes_at(surfaces: Surfaces, material: int, view: Vector, widened: bool) -> Lobes:
    """Return the lobes of a material, seen from a direction in the surface's frame."""
    index = max(surfaces.coat_index[material], 1.0)
    share = surfaces.flake_share[material] if surfaces.flake_factor[material] >= 0 else 0.0
    view = (view[0], view[1], max(view[2], _GRAZING))
    passed, base = 1.0, 1.0
    if index > 1.0:
        passed = 1.0 - fresnel(view[2], index)
        base = passed / (index * index * (1.0 - surfaces.internal[material]))
    return Lobes(
        index,
        max(surfaces.coat_alpha[material], SMALLEST_ALPHA),
        max(surfaces.flake_alpha[material], SMALLEST_ALPHA),
        WIDENED_ALPHA if widened else SMALLEST_ALPHA,
        share,
        view,
        passed,
        base,
    )


@borrowing_kernel
def _mirror(view: Vector, light: Vector, alpha: float) -> tuple[float, float]:
    """Return pi f cos_i of a GGX mirror that reflects everything, and the cosine at its facets."""
    half = unit((view[0] + light[0], view[1] + light[1], view[2] + light[2]))
    shadow = 1.0 / (1.0 + facet_lambda(view[2], alpha) + facet_lambda(light[2], alpha))
    return math.pi * facet_density(half[2], alpha) * shadow / (4.0 * view[2]), dot(view, half)


@borrowing_kernel
def _refracted(direction: Vector, index: float) -> Vector:
    """Return the direction under a smooth coat."""
    return direction[0] / index, direction[1] / index, refracted_cosine(direction[2], index)


@borrowing_kernel
def sun_weights(lobes: Lobes, light: Vector) -> tuple[float, float, float]:
    """Return what base, coat and flakes make of a sun at ``light``: pi f cos_i, without the factors."""
    cosine = light[2]
    entered, coat, flakes = 1.0, 0.0, 0.0
    if lobes.refraction > 1.0:
        entered = 1.0 - fresnel(cosine, lobes.refraction)
        alpha = max(lobes.coat_alpha, lobes.least_alpha)
        coat, facet = _mirror(lobes.outgoing, light, alpha)
        coat *= fresnel(facet, lobes.refraction)
    if lobes.share > 0.0:
        inside = _refracted(light, lobes.refraction)
        alpha = max(lobes.flake_alpha, lobes.least_alpha)
        lobe, _ = _mirror(_refracted(lobes.outgoing, lobes.refraction), inside, alpha)
        flakes = lobes.share * lobes.passed * entered * lobe
        flakes *= cosine / (inside[2] * lobes.refraction * lobes.refraction)
    return (1.0 - lobes.share) * lobes.base * entered * cosine, coat, flakes


@borrowing_kernel
def scatter(lobes: Lobes, u: float, v: float, w: float) -> tuple[int, Vector, float]:
    """Return the lobe that a path follows, where to, and what its weight is multiplied by."""
    chance = 0.0
    if lobes.refraction > 1.0:
        chance = (1.0 - lobes.passed) / (1.0 - lobes.passed + _BASE_PREFERENCE * lobes.passed)
    if u < chance:
        kind = COAT
        direction, weight = _scatter_by_facets(lobes.outgoing, lobes.coat_alpha, lobes.refraction, v, w)
        weight /= chance
    elif u < chance + (1.0 - chance) * lobes.share:
        kind = FLAKES
        direction, weight = _scatter_by_flakes(lobes, v, w)
        weight *= lobes.passed / (1.0 - chance)
    else:
        kind = BASE
        direction = sample_cosine(v, w)
        weight = lobes.base / (1.0 - chance)
        if lobes.refraction > 1.0:
            weight *= 1.0 - fresnel(direction[2], lobes.refraction)
    if direction[2] < _GRAZING or weight <= 0.0:
        kind = ENDED
    return kind, direction, weight


@borrowing_kernel
def _scatter_by_facets(view: Vector, alpha: float, index: Any, u: float, v: float) -> tuple[Vector, float]:
    """Return a direction from a GGX surface, and F G2 / G1; an index of 0 reflects everything."""
    half = sample_facet(view, alpha, u, v)
    cosine = dot(view, half)
    direction = (
        2.0 * cosine * half[0] - view[0],
        2.0 * cosine * half[1] - view[1],
        2.0 * cosine * half[2] - view[2],
    )
    if direction[2] < _GRAZING or cosine <= 0.0:
        return (0.0, 0.0, 0.0), 0.0
    outgoing = 1.0 + facet_lambda(view[2], alpha)
    weight = outgoing / (outgoing + facet_lambda(direction[2], alpha))
    if index > 0.0:
        weight *= fresnel(cosine, index)
    return direction, weight


@borrowing_kernel
def _scatter_by_flakes(lobes: Lobes, u: float, v: float) -> tuple[Vector, float]:
    """Return a direction from flakes, and G2 / G1 times the transmission on the way out.

    The weight is 0 where the light does not leave the coat.
    """
    view = _refracted(lobes.outgoing, lobes.refraction)
    inside, weight = _scatter_by_facets(view, lobes.flake_alpha, 0.0, u, v)
    square = 1.0 - lobes.refraction * lobes.refraction * (1.0 - inside[2] * inside[2])
    if weight == 0.0 or square < _GRAZING:
        return (0.0, 0.0, 0.0), 0.0
    cosine = math.sqrt(square)
    if lobes.refraction > 1.0:
        weight *= 1.0 - fresnel(cosine, lobes.refraction)
    return (inside[0] * lobes.refraction, inside[1] * lobes.refraction, cosine), weight
