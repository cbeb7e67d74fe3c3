"""Reflection by surfaces: Fresnel's equations, the GGX microfacet lobe, the diffuse lobe, their sum.

Directions are in the frame of the surface, z along its normal, and point away from it. Four lobes are summed:
the clear coat, metal flakes under it, recycled light (from flakes, reflected back to the paint by the coat),
and the diffuse base. A surface without a coat has the index 1, for which all expressions become those of a
bare surface.

No light is lost: light that a single reflection by a rough coat or by flakes does not include (because it
meets a second facet, or leaves the flakes beyond the critical angle) is computed when a scene is prepared, as
a table over the cosine, and added to the next lobe: coat, then flakes, then base. C. Kulla, A. Conty,
"Revisiting physically based shading at Imageworks", SIGGRAPH course (2017); C. Kelemen, L. Szirmay-Kalos, "A
microfacet based coupled specular-matte BRDF model", Eurographics (2001).
"""

import math
from typing import Any, NamedTuple

import numpy as np

from hyperpaint.base import Array
from hyperpaint.base.jit import borrowing_kernel

from .hierarchy import Vector, dot, unit

#: Minimum roughness of a coat: sampling would never meet the image of a point sun in a smoother coat.
MIN_ALPHA = 5e-4

#: Nodes of the tables of lost light, even in the square root of the cosine, because losses are at grazing
#: angles.
_NODES = 32
_DRAWS = 24  # directions per dimension in the sum for a node


# columns of `Surfaces.numbers`
_INDEX, _ALPHA, WAVINESS, _SHARE, _FLAKE_ALPHA, _ENTERING, _RETURNED = range(7)
_SINGLE = 7  # first node of the single reflection of a coat, relative to a smooth coat
_LOST = _SINGLE + _NODES  # first node of the share of light that does not leave flakes directly


# Properties of all materials in a few arrays; see `surfaces_of`
class Surfaces(NamedTuple):
    # (material, column) float64: refractive index of the clear coat (0 without a coat), its GGX alpha, the
    # root mean square slope of its orange peel [rad]; share of the light entering the paint that meets
    # flakes, GGX alpha of the flakes; share of diffuse light that passes the coat, and the part of it that
    # does not leave flakes directly; tables over the cosine: single reflection of the coat relative to a
    # smooth coat, and share of the entering light that does not leave flakes directly
    numbers: Array
    base_factor: Array  # (material,) int32: number of the spectrum of the diffuse base
    flake_factor: Array  # (material,) int32: number of the spectrum of the flakes; -1 without flakes
    # (material,) int32: number of the spectrum of diffuse transmittance of a thin plate, such as a leaf; -1
    # for opaque surfaces
    through_factor: Array
    # (material,) int32: number of the spectrum of flakes with light and view at right angles; -1 if angles do
    # not matter
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
        Properties of the coats, shape (material,): index (0 without a coat), GGX alpha, slope [rad].
    flake_share, flake_alpha
        Properties of the flakes.
    base_factor, flake_factor, through_factor, turned_factor
        Numbers of the spectra, see `Surfaces`; None for -1 everywhere.

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
            continue  # bare surfaces, and invalid ones that are refused later
        key = row[_INDEX], row[_ALPHA], row[_FLAKE_ALPHA] if flake_factor[number] >= 0 else 0.0
        if key not in tables:
            tables[key] = row[None].copy()
            _fill_tables(*key, tables[key])
        row[_ENTERING:] = tables[key][0, _ENTERING:]
    no_factor = np.full_like(flake_factor, -1)
    through_factor, turned_factor = (
        no_factor if part is None else part for part in (through_factor, turned_factor)
    )
    factors = (base_factor, flake_factor, through_factor, turned_factor)
    return Surfaces(numbers, *(np.ascontiguousarray(part, np.int32) for part in factors))


@borrowing_kernel
def fresnel(cosine: float, index: float) -> float:
    # reflectance of a smooth dielectric for unpolarised light from outside
    g = math.sqrt(index * index - 1.0 + cosine * cosine)
    a = (g - cosine) / (g + cosine)
    b = (cosine * (g + cosine) - 1.0) / (cosine * (g - cosine) + 1.0)
    return 0.5 * a * a * (1.0 + b * b)


@borrowing_kernel
def refracted_cosine(cosine: float, index: float) -> float:
    # cosine inside a medium from the cosine outside (Snell's law)
    return math.sqrt(1.0 - (1.0 - cosine * cosine) / (index * index))


@borrowing_kernel
def facet_density(cosine: float, alpha: float) -> float:
    # GGX density D of facets [sr-1], by the cosine of their normals to the surface normal.
    # B. Walter, S. R. Marschner, H. Li, K. E. Torrance, "Microfacet models for refraction through rough
    # surfaces", EGSR (2007), equation 33.
    square = alpha * alpha
    # 1 + (a^2 - 1) cos^2, written without cancellation near the normal
    root = (1.0 - cosine * cosine) + square * cosine * cosine
    return square / (math.pi * root * root)


@borrowing_kernel
def facet_lambda(cosine: float, alpha: float) -> float:
    # Smith's Lambda of GGX: G1 = 1 / (1 + Lambda), G2 = 1 / (1 + Lambda_o + Lambda_i).
    # E. Heitz, "Understanding the masking-shadowing function in microfacet-based BRDFs", JCGT 3 (2014),
    # equations 72 and 99 (height-correlated).
    square = cosine * cosine
    return 0.5 * (math.sqrt(1.0 + alpha * alpha * (1.0 - square) / square) - 1.0)


@borrowing_kernel
def sample_facet(view: Vector, alpha: float, u: float, v: float) -> Vector:
    # normal of a random GGX facet that is visible from a direction.
    # E. Heitz, "Sampling the GGX distribution of visible normals", JCGT 7 (2018). Reflection by this facet
    # has the weight F G2 / G1.
    # stretched, so that the facets are those of a sphere
    x, y, z = unit((alpha * view[0], alpha * view[1], view[2]))
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
    # a direction with the density cos / pi (Lambert's lobe)
    radius = math.sqrt(u)
    angle = 2.0 * math.pi * v
    return radius * math.cos(angle), radius * math.sin(angle), math.sqrt(1.0 - u)


#: Minimum roughness of coats and flakes for light of a sun after a diffuse reflection. Paths from a diffuse
#: surface by a sharp mirror to the sun are so rare that they would give single bright pixels (fireflies).
#: Paths to the sky use the lobes without this minimum: wider lobes would lose half a per cent of the light of
#: a car park below the horizon.
WIDENED_ALPHA = 0.3

#: Minimum roughness after a mirror reflection, for the glint of a coat in another coat.
BLURRED_ALPHA = 0.05

#: Lobe that a path followed; recycled light meets the base (RECYCLED) or flakes again (TWICE).
BASE, COAT, FLAKES, RECYCLED, TWICE, ENDED = 0, 1, 2, 3, 4, 5

#: Weight of the base against the coat in the choice of a lobe, because paints reflect only part of the light.
_BASE_PREFERENCE = 0.25

_GRAZING = 1e-9  # minimum cosine of directions with light


# The lobes of a surface for a direction of view.
class Lobes(NamedTuple):
    material: int
    refraction: float  # index of the coat; 1 without a coat
    coat_alpha: float
    flake_alpha: float
    least_alpha: float  # minimum roughness for light of a sun
    share: float  # share of flakes
    outgoing: Vector  # direction of view
    mirrored: Vector  # direction of view in the frame of the coat, which orange peel tilts
    passed: float  # transmittance of the coat in the direction of view
    base: float  # weight of the base, without the transmittance of incoming light
    lost: float  # share of the flakes' light in the direction of view that the coat reflects back


@borrowing_kernel
def _table_value(numbers: Array, material: int, first_node: int, cosine: float) -> Any:
    place = math.sqrt(min(cosine, 1.0)) * (_NODES - 1)
    node = min(int(place), _NODES - 2)
    fraction = place - node
    return (1.0 - fraction) * numbers[material, first_node + node] + fraction * numbers[
        material, first_node + node + 1
    ]


@borrowing_kernel
def _transmitted(numbers: Array, material: int, cosine: float, index: float) -> Any:
    # share of the light from a direction that enters a coat (or leaves it in this direction)
    returned = (
        0.0 if index <= 1.0 else fresnel(cosine, index) * _table_value(numbers, material, _SINGLE, cosine)
    )
    return 1.0 - returned


@borrowing_kernel
def lobes_at(surfaces: Surfaces, material: int, view: Vector, mirrored: Vector, least_alpha: float) -> Lobes:
    # lobes of a material
    # surfaces, material: number of the material in the surfaces
    # view, mirrored: direction of view, in the frame of the surface and in that of its coat
    # least_alpha: minimum roughness of mirrors for light of a sun
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
        _table_value(numbers, material, _LOST, view[2]) if share > 0.0 else 0.0,
    )


@borrowing_kernel
def _mirror(view: Vector, light: Vector, alpha: float, radius: float) -> tuple[float, float]:
    # pi f cos_i of a GGX mirror of reflectance 1, and the cosine at its facets.
    # The result is the mean over a disc of light of an angular radius [rad] around a direction. In the plane
    # of slopes in units of alpha, GGX is the stereographic image of a uniform sphere, 1 / (pi (1 + m^2)^2),
    # and a disc is the image of a cap: the share of facets that mirror the disc is the area of the cap over
    # that of the sphere.
    half = unit((view[0] + light[0], view[1] + light[1], view[2] + light[2]))
    cosine = dot(view, half)
    shadow = 1.0 / (1.0 + facet_lambda(view[2], alpha) + facet_lambda(light[2], alpha))
    if radius > 0.0:
        # normals rotate by half the angle of light in the plane of incidence, by 1 / (2 cos) of it across the
        # plane
        reach = 0.5 * radius / (alpha * math.sqrt(max(cosine, 1e-6)))
        slope = math.sqrt(max(0.0, 1.0 - half[2] * half[2])) / (alpha * half[2])
        cap = math.atan2(2.0 * reach, 1.0 + slope * slope - reach * reach)  # full angle of the cap
        ratio = math.sin(0.5 * cap) / (reach * alpha * half[2] * half[2])
        density = ratio * ratio / math.pi
    else:
        density = facet_density(half[2], alpha)
    return math.pi * density * shadow / (4.0 * view[2]), cosine


@borrowing_kernel
def _refracted(direction: Vector, index: float) -> Vector:
    return direction[0] / index, direction[1] / index, refracted_cosine(direction[2], index)


@borrowing_kernel
def turned_part(lobes: Lobes, light: Vector) -> float:
    # share of the flakes' turned spectrum for light from a direction, 0 to 1.
    # A film of optical thickness d on a flake has the phase :math:`2 \pi d \cos\theta_f / \lambda`, with
    # :math:`1 - \cos\theta_f \approx \sin^2\theta_f / 2` in proportion to :math:`\sin^2\theta` of light that
    # meets the flake at an angle :math:`\theta`; that is half the angle between light and view in the coat,
    # :math:`2 \sin^2\theta = 1 - \cos 2\theta`. Spectra are mixed in this proportion, so that no light is
    # lost, and light and view may change places.
    cosine = dot(_refracted(lobes.outgoing, lobes.refraction), _refracted(light, lobes.refraction))
    return min(1.0, max(0.0, 1.0 - cosine))


@borrowing_kernel
def sun_weights(
    numbers: Array, lobes: Lobes, light: Vector, mirrored: Vector, radius: float
) -> tuple[float, float, float, float]:
    # pi f cos_i of base, coat, flakes and recycled light for a sun, without the factors
    # numbers, lobes: properties of all materials, and the lobes of a surface in the direction of view
    # light, mirrored: directions to the sun, in the frame of the surface and in that of its coat
    # radius: angular radius of the sun [rad]; 0 for a point
    cosine = light[2]
    entered, coat, flakes, recycled = 1.0, 0.0, 0.0, 0.0
    if lobes.refraction > 1.0:
        entered = _transmitted(numbers, lobes.material, cosine, lobes.refraction)
        if mirrored[2] > _GRAZING:
            alpha = max(lobes.coat_alpha, lobes.least_alpha)
            coat, facet = _mirror(lobes.mirrored, mirrored, alpha, radius)
            coat *= fresnel(facet, lobes.refraction)
    if lobes.share > 0.0:
        inner_light = _refracted(light, lobes.refraction)
        alpha = max(lobes.flake_alpha, lobes.least_alpha)
        lobe, _ = _mirror(_refracted(lobes.outgoing, lobes.refraction), inner_light, alpha, 0.0)
        flakes = lobes.share * lobes.passed * entered * lobe
        flakes *= cosine / (inner_light[2] * lobes.refraction * lobes.refraction)
        recycled = lobes.share * lobes.passed * lobes.lost * cosine
        recycled *= _returned(numbers, lobes.material, cosine, entered)
    return (1.0 - lobes.share) * lobes.base * entered * cosine, coat, flakes, recycled


@borrowing_kernel
def weights_under_coat(surfaces: Surfaces, light: Vector, view: Vector) -> tuple[float, float, float, float]:
    # pi f cos_i of base, flakes and recycled light of the first material for a point sun, and the share of
    # the flakes' turned spectrum
    lobes = lobes_at(surfaces, 0, view, view, 0.0)
    base, _, flakes, recycled = sun_weights(surfaces.numbers, lobes, light, light, 0.0)
    return base, flakes, recycled, turned_part(lobes, light)


@borrowing_kernel
def _returned(numbers: Array, material: int, cosine: float, entered: float) -> float:
    # directional dependence of recycled light, with the mean 1 over diffuse light
    mean = numbers[material, _RETURNED]
    return entered * _table_value(numbers, material, _LOST, cosine) / mean if mean > 0.0 else 0.0


@borrowing_kernel
def scatter(numbers: Array, lobes: Lobes, u: float, v: float) -> tuple[int, Vector, float]:
    # lobe that a path follows, its new direction, and the factor of its weight.
    # Directions of the coat are in the frame of the coat. Intervals of ``u`` belong to lobes and are scaled
    # to 0 to 1, so that points which fill a square evenly also fill the directions of every lobe evenly.
    mirrored = 1.0 - lobes.passed
    chance = mirrored / (mirrored + _BASE_PREFERENCE * lobes.passed) if lobes.refraction > 1.0 else 0.0
    if u < chance:
        kind, direction, weight = scatter_coat(lobes, u / chance, v)
        return kind, direction, weight / chance
    kind, direction, weight = scatter_body(numbers, lobes, (u - chance) / (1.0 - chance), v)
    return kind, direction, weight / (1.0 - chance)


@borrowing_kernel
def scatter_coat(lobes: Lobes, u: float, v: float) -> tuple[int, Vector, float]:
    # as `scatter`, for the coat only
    direction, weight = _scatter_by_facets(lobes.mirrored, lobes.coat_alpha, lobes.refraction, u, v)
    return COAT if weight > 0.0 else ENDED, direction, weight


@borrowing_kernel
def scatter_body(numbers: Array, lobes: Lobes, u: float, v: float) -> tuple[int, Vector, float]:
    # as `scatter`, for the layers under the coat: base, flakes or recycled light
    direct = lobes.share * (1.0 - lobes.lost)
    twice = direct + lobes.share * (lobes.share - direct)
    if u < direct:
        direction, weight = _leave_flakes(lobes.outgoing, lobes.refraction, lobes.flake_alpha, u / direct, v)
        if weight > 0.0:
            weight *= _transmitted(numbers, lobes.material, direction[2], lobes.refraction)
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
    # a direction from a GGX surface, and F G2 / G1; an index of 0 has F = 1
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
def _leave_flakes(view: Vector, index: float, alpha: float, u: float, v: float) -> tuple[Vector, float]:
    # a direction outside the coat, and G2 / G1; 0 beyond the critical angle
    inside, weight = _scatter_by_facets(_refracted(view, index), alpha, 0.0, u, v)
    square = 1.0 - index * index * (1.0 - inside[2] * inside[2])
    if weight == 0.0 or square < _GRAZING:
        return (0.0, 0.0, 0.0), 0.0
    return (inside[0] * index, inside[1] * index, math.sqrt(square)), weight


@borrowing_kernel
def _fill_tables(index: float, alpha: float, flake_alpha: float, numbers: Array) -> None:
    # Energy of single reflections by a coat, and by flakes under it (alpha 0: no flakes): sums over visible
    # facets, sampled as by paths, then means over diffuse light. ``numbers``: the row of a material.
    alpha, count = max(alpha, MIN_ALPHA), _DRAWS * _DRAWS
    # the table of the coat, then with it that of the flakes
    for number in range(2 if flake_alpha > 0.0 else 1):
        first_node = _LOST if number else _SINGLE
        for node in range(_NODES):
            cosine = max(node / (_NODES - 1.0), 1e-3) ** 2
            view = (math.sqrt(1.0 - cosine * cosine), 0.0, cosine)
            total = 0.0
            for i in range(count):
                u, v = (i // _DRAWS + 0.5) / _DRAWS, (i % _DRAWS + 0.5) / _DRAWS
                if first_node == _SINGLE:
                    _, weight = _scatter_by_facets(view, alpha, index, u, v)
                    total += weight
                else:
                    direction, weight = _leave_flakes(view, index, max(flake_alpha, MIN_ALPHA), u, v)
                    if weight > 0.0:
                        total += weight * _transmitted(numbers, 0, direction[2], index)
            reflected = total / (count * fresnel(cosine, index))
            numbers[0, first_node + node] = (
                reflected if first_node == _SINGLE else max(0.0, 1.0 - total / count)
            )
    entering, returned, steps = 0.0, 0.0, 16 * _NODES
    for i in range(steps):
        root = (i + 0.5) / steps
        cosine = root * root
        passed = _transmitted(numbers, 0, cosine, index)
        entering += 4.0 * root * cosine / steps * passed  # 2 cos d(cos)
        returned += 4.0 * root * cosine / steps * passed * _table_value(numbers, 0, _LOST, cosine)
    numbers[0, _ENTERING], numbers[0, _RETURNED] = entering, returned
