"""Paths of light from the camera to its sources, recorded without a spectrum.

The radiance of a pixel is the sum over its paths of

    L = w (E / pi) rho_1 rho_2 ...

with the irradiance E of the source, the reflectances of what scattered the light, and a weight w that does
not depend on wavelength. A path's code says which source and which reflectances; equal codes of a pixel are
added up.

Random numbers have no state: a stream that is drawn from in turn would give other numbers for other blocks of
lines. A counter-based generator gives the number that belongs to (seed, line, column, sample, draw), whoever
asks, in any order.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from hyperpaint.base.arrays import Array
from hyperpaint.base.jit import borrowing_kernel

from .codes import PathTable, add_path, with_factor, write_paths
from .hierarchy import STACK, Geometry, closest, occluded
from .path_blocks import Block, Rays, Settings, Sources, check
from .path_codes import FIRST_SUN, INDIRECT, MIRROR, OVERCAST_SKY, SKY
from .surfaces import BASE, COAT, ENDED, WIDENED_ALPHA, Lobes, Surfaces, lobes_at, scatter, sun_weights
from .vectors import Frame, Vector, along, dot, frame_of, from_frame, in_frame, unit

__all__ = ["WIDENED_ALPHA", "Block", "Rays", "Settings", "Sources", "philox", "trace_lines", "uniforms"]


_CAMERA, _SCATTER, _SUN, _SLOT, _LOBE = 0, 16, 1024, 65536, 65537  # what random numbers are for
_GOLDEN = 0.6180339887498949  # multiples of it spread evenly over the unit interval
_FACING = 1e-9  # a sun at a smaller cosine does not shine on a surface
_LIFT = 1e-9  # of the size of the coordinates
_MASK = np.uint64(0xFFFFFFFF)
_HALF = np.uint64(32)
_MULTIPLIER_0, _MULTIPLIER_1 = np.uint64(0xD2511F53), np.uint64(0xCD9E8D57)
_WEYL_0, _WEYL_1 = np.uint64(0x9E3779B9), np.uint64(0xBB67AE85)
_STEP = 2.0**-32


class _Room(NamedTuple):
    """Memory of one pixel at a time."""

    stack: Array  # (STACK,) nodes of a traversal
    entries: Array  # (STACK,) and where the ray enters them
    table: PathTable
    labels: Array  # (sample,) distinct pairs of labels
    votes: Array  # (sample,) samples that meet them
    first: Array  # (5,) of the first hits: number, sum of distance, x, y, z
    seen: Array  # (sun,) number that see a sun
    cosines: Array  # (sun,) sum of cosines


class _Scene(NamedTuple):
    """What paths meet."""

    geometry: Geometry
    surfaces: Surfaces
    sources: Sources


class _Place(NamedTuple):
    """What the random numbers of a path belong to."""

    seed: int
    line: int
    column: int
    sample: int


class _Hit(NamedTuple):
    """Where a path meets a surface."""

    point: Vector  # lifted off the surface
    own: Vector  # normal of the triangle, on the side the path comes from
    frame: Frame  # its last vector is the shading normal


class _Codes(NamedTuple):
    """Codes that a path has after each lobe of a surface, without a source."""

    base: int
    coat: int
    flakes: int


def trace_lines(
    geometry: Geometry,
    surfaces: Surfaces,
    sources: Sources,
    rays: Rays,
    settings: Settings,
    block: Block,
) -> None:
    """Trace whole lines and record their paths.

    Parameters
    ----------
    geometry, surfaces, sources
        The scene and its light.
    rays
        Lines of this block only.
    settings
        How they are traced.
    block
        Written.

    Raises
    ------
    ValueError
        For codes that do not fit 63 bits, more than six suns, and numbers that make no sense.

    Notes
    -----
    At every hit a shadow ray goes to every sun; the sky is met by escaping. One lobe is followed: the coat's
    with a probability that grows with its reflectance, else the flakes' with their share, else the diffuse
    base; weights are divided by the probability.

    The coat is a GGX surface with exact Fresnel reflectance F and height-correlated shadowing. Light passes
    it twice on the way to and from the base, which adds To Ti / (n^2 (1 - Fi)) to the weight, T = 1 - F: with
    the factor rho (1 - Fi) / (1 - rho Fi) that is the reflectance of a diffuse base of albedo rho under a
    smooth dielectric. Flakes are GGX mirrors under it, met by refracted light:

        f = share To Ti / n^2  D G2 / (4 cos_o' cos_i')

    with angles inside the coat (dashed); light they send beyond the critical angle is lost, and so is light
    that goes on between flakes and base. The base keeps 1 - share. No term can add energy.

    Uniform sky is radiance from every direction, below the horizon as well (a scene has an edge); overcast
    sky, L = 1.5 cos(zenith angle) E / pi, is above it only.
    """
    settings = Settings(*map(int, settings))
    check(geometry, surfaces, sources, rays, settings, block)
    suns = np.ascontiguousarray(sources.suns, np.float64).reshape(-1, 3)
    surfaces = Surfaces(
        *(np.ascontiguousarray(part, np.float64) for part in surfaces[:5]),
        *(np.ascontiguousarray(part, np.int32) for part in surfaces[5:]),
    )
    sources = Sources(suns, np.ascontiguousarray(sources.sun_radius, np.float64), bool(sources.overcast))
    rays = Rays(*(np.ascontiguousarray(part, np.float64) for part in rays))
    _trace(_Scene(geometry, surfaces, sources), rays, settings, _room(settings, len(suns)), block)


def _room(settings: Settings, suns: int) -> _Room:
    """Return memory for the paths of a pixel."""
    most = settings.samples * (settings.depth * suns * 3 + 2)
    size = 1 << max(4, (2 * most - 1).bit_length())
    return _Room(
        stack=np.empty(STACK, np.int64),
        entries=np.empty(STACK),
        table=PathTable(np.full(size, -1), np.zeros(size), np.empty(most, np.int64), np.zeros(1, np.int64)),
        labels=np.empty(settings.samples, np.int64),
        votes=np.empty(settings.samples, np.int64),
        first=np.zeros(5),
        seen=np.zeros(suns),
        cosines=np.zeros(suns),
    )


@borrowing_kernel
def philox(c0: Any, c1: Any, c2: Any, c3: Any, k0: Any, k1: Any) -> tuple[Any, Any, Any, Any]:
    """Return four words of 32 bits: Philox4x32-10.

    Parameters
    ----------
    c0, c1, c2, c3
        The counter, words of 32 bits held in uint64.
    k0, k1
        The key, likewise.

    Notes
    -----
    J. K. Salmon, M. A. Moraes, R. O. Dror, D. E. Shaw, "Parallel random numbers: as easy as 1, 2, 3", SC11
    (2011). Products of two 32-bit words fit 64 bits: nothing overflows, compiled or not.
    """
    for _ in range(10):
        product_0 = _MULTIPLIER_0 * c0
        product_1 = _MULTIPLIER_1 * c2
        c0 = (product_1 >> _HALF) ^ c1 ^ k0
        c2 = (product_0 >> _HALF) ^ c3 ^ k1
        c1 = product_1 & _MASK
        c3 = product_0 & _MASK
        k0 = (k0 + _WEYL_0) & _MASK
        k1 = (k1 + _WEYL_1) & _MASK
    return c0, c1, c2, c3


@borrowing_kernel
def uniforms(seed: Any, line: Any, column: Any, sample: Any, draw: Any) -> tuple[float, float, float, float]:
    """Return four numbers inside (0, 1) that belong to one draw of one sample of one pixel.

    Parameters
    ----------
    seed
        Non-negative integer.
    line, column, sample, draw
        Non-negative integers below 2^32: the absolute scan line, the column, the sample of the pixel, and
        what the numbers are for.
    """
    key = np.uint64(seed)
    a, b, c, d = philox(
        np.uint64(line), np.uint64(column), np.uint64(sample), np.uint64(draw), key & _MASK, key >> _HALF
    )
    return (
        (np.float64(a) + 0.5) * _STEP,
        (np.float64(b) + 0.5) * _STEP,
        (np.float64(c) + 0.5) * _STEP,
        (np.float64(d) + 0.5) * _STEP,
    )


@borrowing_kernel
def _trace(scene: _Scene, rays: Rays, settings: Settings, room: _Room, block: Block) -> None:
    """Trace every pixel of a block."""
    for line in range(block.material.shape[0]):
        for column in range(block.material.shape[1]):
            _clear_pixel(room)
            distinct = 0
            for sample in range(settings.samples):
                label = _trace_sample(scene, rays, line, column, sample, settings, room)
                distinct = _vote(label, distinct, room)
            _write_pixel(block, line, column, distinct, settings, room)
            draw, _, _, _ = uniforms(settings.seed, settings.first_line + line, column, 0, _SLOT)
            write_paths(room.table, 1.0 / settings.samples, draw, block.weight, block.code, line, column)


@borrowing_kernel
def _clear_pixel(room: _Room) -> None:
    """Forget the pixel before."""
    for i in range(room.table.in_use[0]):
        room.table.codes[room.table.used[i]] = -1
    room.table.in_use[0] = 0
    room.first[:] = 0.0
    room.seen[:] = 0.0
    room.cosines[:] = 0.0


@borrowing_kernel
def _vote(label: int, distinct: int, room: _Room) -> int:
    """Count a sample's first hit, and return the number of distinct pairs of labels."""
    for i in range(distinct):
        if room.labels[i] == label:
            room.votes[i] += 1
            return distinct
    room.labels[distinct] = label
    room.votes[distinct] = 1
    return distinct + 1


@borrowing_kernel
def _write_pixel(
    block: Block, line: int, column: int, distinct: int, settings: Settings, room: _Room
) -> None:
    """Write what the first hits say."""
    best = 0
    for i in range(1, distinct):
        more = room.votes[i] > room.votes[best]
        if more or (room.votes[i] == room.votes[best] and room.labels[i] < room.labels[best]):
            best = i
    label = room.labels[best]
    block.material[line, column] = label >> 32 if label >= 0 else -1
    block.instance[line, column] = label & 0xFFFFFFFF if label >= 0 else -1
    block.purity[line, column] = room.votes[best] / settings.samples
    share = 1.0 / room.first[0] if room.first[0] > 0 else np.nan
    block.distance[line, column] = room.first[1] * share
    for k in range(3):
        block.position[line, k, column] = room.first[2 + k] * share
    for sun in range(room.seen.size):
        block.sun_visibility[line, sun, column] = room.seen[sun] * share
        block.incidence[line, sun, column] = room.cosines[sun] * share


@borrowing_kernel
def _camera_ray(rays: Rays, line: int, column: int, u: float, v: float, w: float) -> tuple[Vector, Vector]:
    """Return a ray through a pixel at some time of the exposure; attitude and position change evenly."""
    right = rays.column_edges[column] + u * (rays.column_edges[column + 1] - rays.column_edges[column])
    forward = rays.along_edges[0] + v * (rays.along_edges[1] - rays.along_edges[0])
    a = _camera_axes(rays, line, 0, forward, right)
    b = _camera_axes(rays, line, 1, forward, right)
    p, q = rays.origin[line, 0], rays.origin[line, 1]
    origin = (p[0] + w * (q[0] - p[0]), p[1] + w * (q[1] - p[1]), p[2] + w * (q[2] - p[2]))
    return origin, unit((a[0] + w * (b[0] - a[0]), a[1] + w * (b[1] - a[1]), a[2] + w * (b[2] - a[2])))


@borrowing_kernel
def _camera_axes(rays: Rays, line: int, end: int, forward: float, right: float) -> Vector:
    """Return a direction of the camera in the scene's axes, at one end of the exposure."""
    r = rays.rotation[line, end]
    return (
        r[0, 0] * forward + r[0, 1] * right + r[0, 2],
        r[1, 0] * forward + r[1, 1] * right + r[1, 2],
        r[2, 0] * forward + r[2, 1] * right + r[2, 2],
    )


@borrowing_kernel
def _corner(array: Array, face: int, corner: int) -> Vector:
    """Return a vector that belongs to the corner of a triangle."""
    at = 9 * face + 3 * corner
    return array[at], array[at + 1], array[at + 2]


@borrowing_kernel
def _at_hit(array: Array, face: int, weights: Vector) -> Vector:
    """Return the mean of what belongs to the corners."""
    point = along((0.0, 0.0, 0.0), _corner(array, face, 0), weights[0])
    point = along(point, _corner(array, face, 1), weights[1])
    return along(point, _corner(array, face, 2), weights[2])


@borrowing_kernel
def _normals(geometry: Geometry, face: int, weights: Vector, direction: Vector) -> tuple[Vector, Vector]:
    """Return the triangle's normal and the shading normal, both on the side that a ray comes from."""
    at = 3 * face
    own = (geometry.face_normal[at], geometry.face_normal[at + 1], geometry.face_normal[at + 2])
    if dot(own, direction) > 0.0:
        own = (-own[0], -own[1], -own[2])
    first = _corner(geometry.corner_normals, face, 0)
    if first[0] == 0.0 and first[1] == 0.0 and first[2] == 0.0:
        return own, own
    shading = _at_hit(geometry.corner_normals, face, weights)
    square = dot(shading, shading)
    if square < 1e-12:
        return own, own
    shading = along((0.0, 0.0, 0.0), shading, math.copysign(1.0 / math.sqrt(square), dot(shading, own)))
    if dot(shading, direction) > -_FACING:  # interpolated past the horizon
        return own, own
    return own, shading


@borrowing_kernel
def _lifted(point: Vector, normal: Vector) -> Vector:
    """Return a point lifted off its surface by more than rounding may have sunk it."""
    return along(point, normal, _LIFT * (1.0 + abs(point[0]) + abs(point[1]) + abs(point[2])))


@borrowing_kernel
def _towards_sun(sources: Sources, sun: int, place: _Place, bounce: int) -> Vector:
    """Return a direction to a point of a sun's disc, evenly over its solid angle."""
    middle = (sources.suns[sun, 0], sources.suns[sun, 1], sources.suns[sun, 2])
    radius = sources.sun_radius[sun]
    if radius <= 0.0:
        return middle
    u, v, _, _ = uniforms(place.seed, place.line, place.column, place.sample, _SUN + 8 * bounce + sun)
    fall = u * 2.0 * math.sin(0.5 * radius) ** 2  # 1 - cosine, without cancellation
    across = math.sqrt(fall * (2.0 - fall))
    angle = 2.0 * math.pi * v
    return from_frame(frame_of(middle), (across * math.cos(angle), across * math.sin(angle), 1.0 - fall))


@borrowing_kernel
def _as_label(material: Any, instance: Any) -> Any:
    """Return two labels as one number, which sorts by material first."""
    return np.int64(material) << 32 | np.int64(instance)


@borrowing_kernel
def _evenly(place: _Place) -> float:
    """Return the number that chooses a sample's first lobe.

    Even over the samples of a pixel, from a random start: each lobe gets its share of them almost exactly.
    Few paths follow a coat, and on a dark car by chance twice as many in one pixel as in the next would show.
    """
    start, _, _, _ = uniforms(place.seed, place.line, place.column, 0, _LOBE)
    return (start + place.sample * _GOLDEN) % 1.0


@borrowing_kernel
def _record_first(sources: Sources, room: _Room, distance: float, point: Vector, normal: Vector) -> None:
    """Add up what is known of the first hits."""
    room.first[0] += 1.0
    room.first[1] += distance
    for k in range(3):
        room.first[2 + k] += point[k]
    for sun in range(sources.suns.shape[0]):
        cosine = dot(normal, (sources.suns[sun, 0], sources.suns[sun, 1], sources.suns[sun, 2]))
        room.cosines[sun] += max(cosine, 0.0)


@borrowing_kernel
def _trace_sample(
    scene: _Scene, rays: Rays, line: int, column: int, sample: int, settings: Settings, room: _Room
) -> int:
    """Follow one path, record what it gathers, and return the labels of its first hit as one number."""
    geometry, surfaces, sources = scene
    place = _Place(settings.seed, settings.first_line + line, column, sample)
    u, v, w, _ = uniforms(settings.seed, place.line, column, sample, _CAMERA)
    origin, direction = _camera_ray(rays, line, column, u, v, w)
    label, beta, code, widened = -1, 1.0, 0, False
    for bounce in range(settings.depth):
        distance, face, weights = closest(geometry, room.stack, room.entries, origin, direction, np.inf)
        if face < 0:
            _record_sky(sources, room, code, beta, direction)
            return label
        own, normal = _normals(geometry, face, weights, direction)
        point = _at_hit(geometry.triangles, face, weights)
        hit = _Hit(_lifted(point, own), own, frame_of(normal))
        material = geometry.face_material[face]
        view = in_frame(hit.frame, (-direction[0], -direction[1], -direction[2]))
        lobes = lobes_at(surfaces, material, view, widened)
        if bounce == 0:
            label = _as_label(material, geometry.face_instance[face])
            _record_first(sources, room, distance, point, normal)
        else:
            code |= INDIRECT
        codes = _Codes(
            with_factor(code, surfaces.base_factor[material], settings.digit_bits),
            code | MIRROR if bounce == 0 else code,
            with_factor(code, surfaces.flake_factor[material], settings.digit_bits),
        )
        _record_suns(scene, room, hit, lobes, codes, beta, place, bounce)
        u, v, w, _ = uniforms(settings.seed, place.line, column, sample, _SCATTER + bounce)
        if bounce == 0:
            u = _evenly(place)
        kind, local, weight = scatter(lobes, u, v, w)
        origin, direction = hit.point, from_frame(hit.frame, local)
        if kind == ENDED or dot(own, direction) <= 0.0:  # a shading normal may promise too much
            return label
        beta *= weight
        code = codes.base if kind == BASE else (codes.coat if kind == COAT else codes.flakes)
        widened = widened or kind == BASE
    if not occluded(geometry, room.stack, origin, direction, np.inf):
        _record_sky(sources, room, code, beta, direction)
    return label


@borrowing_kernel
def _record_suns(
    scene: _Scene,
    room: _Room,
    hit: _Hit,
    lobes: Lobes,
    codes: _Codes,
    beta: float,
    place: _Place,
    bounce: int,
) -> None:
    """Add what a surface reflects of the suns that it sees."""
    sources = scene.sources
    for sun in range(sources.suns.shape[0]):
        towards = _towards_sun(sources, sun, place, bounce)
        if dot(hit.frame[2], towards) < _FACING or dot(hit.own, towards) <= 0.0:
            continue
        if occluded(scene.geometry, room.stack, hit.point, towards, np.inf):
            continue
        base, coat, flakes = sun_weights(lobes, in_frame(hit.frame, towards))
        add_path(room.table, codes.base | FIRST_SUN + sun, beta * base)
        add_path(room.table, codes.coat | FIRST_SUN + sun, beta * coat)
        add_path(room.table, codes.flakes | FIRST_SUN + sun, beta * flakes)
        if bounce == 0:
            room.seen[sun] += 1.0


@borrowing_kernel
def _record_sky(sources: Sources, room: _Room, code: int, beta: float, direction: Vector) -> None:
    """Add a path that has escaped."""
    add_path(room.table, code | SKY, beta)
    if sources.overcast:
        add_path(room.table, code | OVERCAST_SKY, 1.5 * direction[2] * beta)  # nothing from below the horizon
