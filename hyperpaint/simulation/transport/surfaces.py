"""Reflection by surfaces: Fresnel's equations, the GGX microfacet lobe, the diffuse lobe, their sum.

Directions are given in the frame of the surface, z along its normal, and point away from it. Four lobes add
up: the clear coat, metal flakes under it, light of the flakes that the coat throws back at the paint, and the
diffuse base. Without a coat its index is 1, and every expression becomes that of a bare surface.

No light is lost: what one reflection by a rough coat or by flakes does not account for (light that meets a
second facet, or leaves the flakes beyond the critical angle) is measured when a scene is prepared, as a table
over the cosine, and given to the lobes below: coat, then flakes, then base. C. Kulla, A. Conty, "Revisiting
physically based shading at Imageworks", SIGGRAPH course (2017); C. Kelemen, L. Szirmay-Kalos, "A microfacet
based coupled specular-matte BRDF model", Eurographics (2001).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from hyperpaint.base.arrays import Array
from hyperpaint.base.jit import borrowing_kernel

from .vectors import Vector, dot, unit

#: A smoother coat is taken to be as rough as this: its image of a point sun would never be met.
MIN_ALPHA = 5e-4

#: Nodes of the tables of lost light, evenly over the square root of the cosine: losses are at grazing angles.
_NODES = 32
_DRAWS = 24  # directions each way in the sum that makes a node


# columns of what is known of a material
_INDEX, _ALPHA, WAVINESS, _SHARE, _FLAKE_ALPHA, _ENTERING, _RETURNED = range(7)
_SINGLE = 7  # first node of what one reflection gives of a smooth coat's reflectance
_LOST = _SINGLE + _NODES  # first node of the part of the light that flakes alone would not let out again


class Surfaces(NamedTuple):
    """Properties of all materials in a few arrays, which every kernel call passes on; see `surfaces_of`.

    Attributes
    ----------
    numbers : (material, column) float64
        Refractive index of the clear coat (0 without one), its GGX alpha, the root mean square slope of its
        orange peel [rad]; part of the light that enters the paint and meets flakes, GGX alpha of the flakes;
        part of diffuse light that passes the coat, and the part of it that flakes alone would not let out
        again; tables over the cosine of what one reflection gives of a smooth coat's reflectance, and of the
        part of the light that enters and that flakes alone would not let out again.
    base_factor : (material,) int32
        Number of the spectrum of the diffuse base.
    flake_factor : (material,) int32
        Number of the spectrum of the flakes; -1 without them.
    through_factor : (material,) int32
        Number of the spectrum that a thin plate, such as a leaf, passes diffusely; -1 of what is opaque.
    turned_factor : (material,) int32
        Number of the spectrum of flakes where light and view are at right angles; -1 where angles do not
        matter.
    """

    numbers: Array
    base_factor: Array
    flake_factor: Array
    through_factor: Array
    turned_factor: Array


def surfaces_of(
    coat_index: Array,
    coat_alpha: Array,
    waviness: Array,
    flake_share: Array,
    flake_alpha: Array,
    base_factor: Array,
    flake_factor: Array,
    through_factor: Array | None = None,
    *,
    turned_factor: Array | None = None,
) -> Surfaces:
    """Return surfaces with their tables of lost light.

    Parameters
    ----------
    coat_index, coat_alpha, waviness
        Of the coats, shape (material,): index 0 without one, GGX alpha, slope [rad].
    flake_share, flake_alpha
        Of the flakes.
    base_factor, flake_factor, through_factor, turned_factor
        Numbers of the spectra; -1 without flakes, of what passes no light, of flakes of one spectrum; None
        where nothing does.

    Examples
    --------
    >>> one = np.ones(1)
    >>> surfaces_of(1.5 * one, 1e-3 * one, 0 * one, 0 * one, one, [0], [-1]).numbers[0, 5].round(4)
    np.float64(0.9082)
    """
    flake_factor = np.ascontiguousarray(flake_factor, np.int32)
    numbers = np.ones((flake_factor.size, _LOST + _NODES))
    for column, part in enumerate((coat_index, coat_alpha, waviness, flake_share, flake_alpha)):
        numbers[:, column] = part
    numbers[:, [_RETURNED, *range(_LOST, _LOST + _NODES)]] = 0.0
    tables: dict[tuple[float, ...], Array] = {}
    for number, row in enumerate(numbers):
        if not (1.0 < row[_INDEX] < np.inf and 0.0 <= row[_ALPHA] <= 1.0):
            continue  # bare, or refused later
        key = row[_INDEX], row[_ALPHA], row[_FLAKE_ALPHA] if flake_factor[number] >= 0 else 0.0
        if key not in tables:
            tables[key] = row[_ENTERING:].copy()
            _fill_tables(*key, tables[key])
        row[_ENTERING:] = tables[key]
    none = np.full_like(flake_factor, -1)
    through_factor, turned_factor = (
        none if part is None else part for part in (through_factor, turned_factor)
    )
    factors = (base_factor, flake_factor, through_factor, turned_factor)
    return Surfaces(numbers, *(np.ascontiguousarray(part, np.int32) for part in factors))


@borrowing_kernel
def fresnel(cosine: float, index: float) -> float:
    # Reflectance of a smooth dielectric for unpolarised light from outside.
    g2 = index * index - 1.0 + cosine * cosine
    g = math.sqrt(g2)
    a = (g - cosine) / (g + cosine)
    b = (cosine * (g + cosine) - 1.0) / (cosine * (g - cosine) + 1.0)
    return 0.5 * a * a * (1.0 + b * b)


@borrowing_kernel
def refracted_cosine(cosine: float, index: float) -> float:
    # Cosine inside a medium for a cosine outside (Snell's law).
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
    # A direction with density cos / pi (Lambert's lobe).
    radius = math.sqrt(u)
    angle = 2.0 * math.pi * v
    return radius * math.cos(angle), radius * math.sin(angle), math.sqrt(1.0 - u)


#: After a diffuse reflection a sun sees coats and flakes at least as rough as this. Light that goes from a
#: diffuse surface by way of a sharp mirror to the sun is met so rarely that it would show as single bright
#: pixels (fireflies). Paths themselves, which end at the sky, follow the lobes as they are: widened, the
#: coats of a car park would lose half a per cent of its light past their horizons.
WIDENED_ALPHA = 0.3

#: After a mirror reflection, likewise: the glint of one coat in another.
BLURRED_ALPHA = 0.05

#: What a path has followed; light that flakes recycle meets the base next, or flakes once more.
BASE, COAT, FLAKES, RECYCLED, TWICE, ENDED = 0, 1, 2, 3, 4, 5

#: A base under a coat is followed with four times its fair chance against the coat: paints reflect that much.
_BASE_PREFERENCE = 0.25

_GRAZING = 1e-9  # cosines below this carry no light


# A surface, seen from one direction.
class Lobes(NamedTuple):
    material: int
    refraction: float  # index of the coat; 1 for none
    coat_alpha: float
    flake_alpha: float
    least_alpha: float  # that a sun sees
    share: float  # of the flakes
    outgoing: Vector  # where the path came from
    mirrored: Vector  # the same in the frame of the coat, which orange peel tilts
    passed: float  # transmission of the coat towards there
    base: float  # weight of the base, without the transmission of what comes in
    lost: float  # part of the flakes' light towards there that the coat throws back


@borrowing_kernel
def _at_node(numbers: Array, material: int, first: int, cosine: float) -> Any:
    place = math.sqrt(min(cosine, 1.0)) * (_NODES - 1)
    node = min(int(place), _NODES - 2)
    part = place - node
    return (1.0 - part) * numbers[material, first + node] + part * numbers[material, first + node + 1]


@borrowing_kernel
def _between(row: Array, first: int, cosine: float) -> Any:
    place = math.sqrt(cosine) * (_NODES - 1)
    node = min(int(place), _NODES - 2)
    part = place - node
    return (1.0 - part) * row[first + node] + part * row[first + node + 1]


@borrowing_kernel
def _transmitted(numbers: Array, material: int, cosine: float, index: float) -> Any:
    # Part of the light from a direction that enters a coat (or leaves it in that direction).
    if index <= 1.0:
        return 1.0
    return 1.0 - fresnel(cosine, index) * _at_node(numbers, material, _SINGLE, cosine)


@borrowing_kernel
def lobes_at(surfaces: Surfaces, material: int, view: Vector, mirrored: Vector, least_alpha: float) -> Lobes:
    """Return the lobes of a material.

    Parameters
    ----------
    surfaces, material
        Which one.
    view, mirrored
        Where it is seen from, in the frame of the surface and in that of its coat.
    least_alpha
        How rough its mirrors are at least for a sun.
    """
    numbers = surfaces.numbers
    index = max(numbers[material, _INDEX], 1.0)
    share = numbers[material, _SHARE] if surfaces.flake_factor[material] >= 0 else 0.0
    view = (view[0], view[1], max(view[2], _GRAZING))
    passed = _transmitted(numbers, material, view[2], index)
    return Lobes(
        material,
        index,
        max(numbers[material, _ALPHA], MIN_ALPHA),
        max(numbers[material, _FLAKE_ALPHA], MIN_ALPHA),
        least_alpha,
        share,
        view,
        (mirrored[0], mirrored[1], max(mirrored[2], _GRAZING)),
        passed,
        passed / numbers[material, _ENTERING],
        _at_node(numbers, material, _LOST, view[2]) if share > 0.0 else 0.0,
    )


@borrowing_kernel
def _mirror(view: Vector, light: Vector, alpha: float, radius: float) -> tuple[float, float]:
    """Return pi f cos_i of a GGX mirror that reflects everything, and the cosine at its facets.

    It is the mean over a disc of light of an angular radius [rad] around a direction. In the plane of slopes,
    in units of alpha, GGX is the stereographic image of an even sphere, 1 / (pi (1 + m^2)^2), and a disc
    that of a cap: the part of the facets that mirror some of the disc is the cap's area over the sphere's.
    """
    half = unit((view[0] + light[0], view[1] + light[1], view[2] + light[2]))
    cosine = dot(view, half)
    shadow = 1.0 / (1.0 + facet_lambda(view[2], alpha) + facet_lambda(light[2], alpha))
    if radius > 0.0:
        # normals turn half as far as light in the plane of incidence, 1 / (2 cos) as far across it
        reach = 0.5 * radius / (alpha * math.sqrt(max(cosine, 1e-6)))
        slope = math.sqrt(max(0.0, 1.0 - half[2] * half[2])) / (alpha * half[2])
        cap = math.atan2(2.0 * reach, 1.0 + slope * slope - reach * reach)  # its angle, rim to rim
        part = math.sin(0.5 * cap) / (reach * alpha * half[2] * half[2])
        density = part * part / math.pi
    else:
        density = facet_density(half[2], alpha)
    return math.pi * density * shadow / (4.0 * view[2]), cosine


@borrowing_kernel
def _refracted(direction: Vector, index: float) -> Vector:
    return direction[0] / index, direction[1] / index, refracted_cosine(direction[2], index)


@borrowing_kernel
def turned_part(lobes: Lobes, light: Vector) -> float:
    r"""Return the part of the turned flakes' spectrum in light from a direction to the view, 0 to 1.

    A film of optical thickness d on a flake has the phase :math:`2 \pi d \cos\theta_f / \lambda`, with
    :math:`1 - \cos\theta_f \approx \sin^2\theta_f / 2` in proportion to :math:`\sin^2\theta` of light that
    meets the flake at an angle :math:`\theta`; that is half the angle between light and view in the coat,
    :math:`2 \sin^2\theta = 1 - \cos 2\theta`. Spectra are mixed in this proportion, so that no light is
    lost, and light and view may change places.
    """
    inside = dot(_refracted(lobes.outgoing, lobes.refraction), _refracted(light, lobes.refraction))
    return min(1.0, max(0.0, 1.0 - inside))


@borrowing_kernel
def sun_weights(
    numbers: Array, lobes: Lobes, light: Vector, mirrored: Vector, radius: float
) -> tuple[float, float, float, float]:
    """Return pi f cos_i of base, coat, flakes and recycled light for a sun, without the factors.

    Parameters
    ----------
    numbers, lobes
        Of all materials, and lobes of one in the viewing direction.
    light, mirrored
        Towards the sun, in the frame of the surface and in that of its coat.
    radius
        Of the sun's disc [rad]; 0 for a point.
    """
    cosine = light[2]
    entered, coat, flakes, recycled = 1.0, 0.0, 0.0, 0.0
    if lobes.refraction > 1.0:
        entered = _transmitted(numbers, lobes.material, cosine, lobes.refraction)
        if mirrored[2] > _GRAZING:
            alpha = max(lobes.coat_alpha, lobes.least_alpha)
            coat, facet = _mirror(lobes.mirrored, mirrored, alpha, radius)
            coat *= fresnel(facet, lobes.refraction)
    if lobes.share > 0.0:
        inside = _refracted(light, lobes.refraction)
        alpha = max(lobes.flake_alpha, lobes.least_alpha)
        lobe, _ = _mirror(_refracted(lobes.outgoing, lobes.refraction), inside, alpha, 0.0)
        flakes = lobes.share * lobes.passed * entered * lobe
        flakes *= cosine / (inside[2] * lobes.refraction * lobes.refraction)
        recycled = lobes.share * lobes.passed * lobes.lost * cosine
        recycled *= _returned(numbers, lobes.material, cosine, entered)
    return (1.0 - lobes.share) * lobes.base * entered * cosine, coat, flakes, recycled


@borrowing_kernel
def _returned(numbers: Array, material: int, cosine: float, entered: float) -> float:
    # Directional dependence of recycled light: 1 on average over diffuse light.
    whole = numbers[material, _RETURNED]
    return entered * _at_node(numbers, material, _LOST, cosine) / whole if whole > 0.0 else 0.0


@borrowing_kernel
def scatter(numbers: Array, lobes: Lobes, u: float, v: float) -> tuple[int, Vector, float]:
    """Return the lobe that a path follows, its new direction, and the factor of its weight.

    Directions along the coat are in its own frame. Stretches of ``u`` belong to the lobes, and its place in
    one is as even as the whole: points that cover a square evenly do so for the directions of each lobe.
    """
    chance = 0.0
    if lobes.refraction > 1.0:
        chance = (1.0 - lobes.passed) / (1.0 - lobes.passed + _BASE_PREFERENCE * lobes.passed)
    if u < chance:
        kind, direction, weight = scatter_coat(lobes, u / chance, v)
        return kind, direction, weight / chance
    kind, direction, weight = scatter_body(numbers, lobes, (u - chance) / (1.0 - chance), v)
    return kind, direction, weight / (1.0 - chance)


@borrowing_kernel
def scatter_coat(lobes: Lobes, u: float, v: float) -> tuple[int, Vector, float]:
    # Same for the coat alone.
    direction, weight = _scatter_by_facets(lobes.mirrored, lobes.coat_alpha, lobes.refraction, u, v)
    return COAT if weight > 0.0 else ENDED, direction, weight


@borrowing_kernel
def scatter_body(numbers: Array, lobes: Lobes, u: float, v: float) -> tuple[int, Vector, float]:
    # Same for the layers under the coat: base, flakes or recycled light.
    direct = lobes.share * (1.0 - lobes.lost)
    twice = direct + lobes.share * (lobes.share - direct)
    if u < direct:
        direction, weight = _scatter_by_flakes(numbers, lobes, u / direct, v)
        kind, weight = FLAKES, weight * lobes.passed / (1.0 - lobes.lost)
    elif u < lobes.share:
        kind, begin, end = (TWICE, direct, twice) if u < twice else (RECYCLED, twice, lobes.share)
        direction = sample_cosine((u - begin) / (end - begin), v)
        entered = _transmitted(numbers, lobes.material, direction[2], lobes.refraction)
        weight = lobes.passed * _returned(numbers, lobes.material, direction[2], entered)
    else:
        kind, direction = BASE, sample_cosine((u - lobes.share) / (1.0 - lobes.share), v)
        weight = lobes.base * _transmitted(numbers, lobes.material, direction[2], lobes.refraction)
    if direction[2] < _GRAZING or weight <= 0.0:
        kind = ENDED
    return kind, direction, weight


@borrowing_kernel
def _scatter_by_facets(view: Vector, alpha: float, index: Any, u: float, v: float) -> tuple[Vector, float]:
    # A direction from a GGX surface, and F G2 / G1; an index of 0 reflects everything.
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
def _scatter_by_flakes(numbers: Array, lobes: Lobes, u: float, v: float) -> tuple[Vector, float]:
    # G2 / G1 times the transmission on the way out; 0 where the light does not leave the coat.
    direction, weight = _leave_flakes(lobes.outgoing, lobes.refraction, lobes.flake_alpha, u, v)
    if weight > 0.0:
        weight *= _transmitted(numbers, lobes.material, direction[2], lobes.refraction)
    return direction, weight


@borrowing_kernel
def _leave_flakes(view: Vector, index: float, alpha: float, u: float, v: float) -> tuple[Vector, float]:
    # A direction outside, and G2 / G1; 0 beyond the critical angle.
    inside, weight = _scatter_by_facets(_refracted(view, index), alpha, 0.0, u, v)
    square = 1.0 - index * index * (1.0 - inside[2] * inside[2])
    if weight == 0.0 or square < _GRAZING:
        return (0.0, 0.0, 0.0), 0.0
    return (inside[0] * index, inside[1] * index, math.sqrt(square)), weight


@borrowing_kernel
def _fill_tables(index: float, alpha: float, flake_alpha: float, row: Array) -> None:
    # Energy of single reflections by a coat, and by flakes under it (alpha 0: none). Sums over the facets
    # that are visible, as paths meet them; then the means over diffuse light. ``row`` are the columns of a
    # material from the transmission of diffuse light on.
    single, lost = _SINGLE - _ENTERING, _LOST - _ENTERING
    alpha, count = max(alpha, MIN_ALPHA), _DRAWS * _DRAWS
    for node in range(_NODES):
        cosine = max(node / (_NODES - 1.0), 1e-3) ** 2
        view = (math.sqrt(1.0 - cosine * cosine), 0.0, cosine)
        total = 0.0
        for i in range(count):
            u, v = (i // _DRAWS + 0.5) / _DRAWS, (i % _DRAWS + 0.5) / _DRAWS
            _, weight = _scatter_by_facets(view, alpha, index, u, v)
            total += weight
        row[single + node] = total / (count * fresnel(cosine, index))
    for node in range(_NODES if flake_alpha > 0.0 else 0):
        cosine = max(node / (_NODES - 1.0), 1e-3) ** 2
        view = (math.sqrt(1.0 - cosine * cosine), 0.0, cosine)
        total = 0.0
        for i in range(count):
            u, v = (i // _DRAWS + 0.5) / _DRAWS, (i % _DRAWS + 0.5) / _DRAWS
            out, weight = _leave_flakes(view, index, max(flake_alpha, MIN_ALPHA), u, v)
            if weight > 0.0:
                total += weight * (1.0 - fresnel(out[2], index) * _between(row, single, out[2]))
        row[lost + node] = max(0.0, 1.0 - total / count)
    entering, returned, steps = 0.0, 0.0, 16 * _NODES
    for i in range(steps):
        root = (i + 0.5) / steps
        cosine = root * root
        passed = 1.0 - fresnel(cosine, index) * _between(row, single, cosine)
        entering += 4.0 * root * cosine / steps * passed  # 2 cos d(cos)
        returned += 4.0 * root * cosine / steps * passed * _between(row, lost, cosine)
    row[0], row[_RETURNED - _ENTERING] = entering, returned
