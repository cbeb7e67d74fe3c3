"""Paths of light from the camera to its sources, recorded without a spectrum.

The radiance of a pixel is the sum over its paths of

    L = w (E / pi) rho_1 rho_2 ...

with the irradiance E of the source, the reflectances rho of the scattering surfaces, and a weight w that does
not depend on wavelength. The code of a path contains source and reflectances; weights of equal codes in a
pixel are summed.
"""

import math
from typing import Any, NamedTuple, Self

import numpy as np

from hyperpaint.base import Array
from hyperpaint.base.jit import borrowing_kernel

from .hierarchy import (
    FACING,
    STACK,
    Geometry,
    Hit,
    Vector,
    behind,
    closest,
    dot,
    frame_of,
    from_frame,
    hit_at,
    in_frame,
    leaves,
    occluded,
    unit,
)
from .path_codes import (
    CLEAR_SKY_FUNCTIONS,
    FIRST_CLEAR_SKY,
    FIRST_DIGIT,
    FIRST_SUN,
    INDIRECT,
    MIRROR,
    OVERCAST_SKY,
    SKY,
    even_pair,
    pixel_key,
    place_of,
    uniforms,
)
from .surfaces import (
    BLURRED_ALPHA,
    COAT,
    ENDED,
    FLAKES,
    MIN_ALPHA,
    RECYCLED,
    TWICE,
    WAVINESS,
    WIDENED_ALPHA,
    Lobes,
    Surfaces,
    lobes_at,
    scatter,
    scatter_body,
    scatter_coat,
    sun_weights,
    turned_part,
)


# Camera position and view for the lines of a block
class Rays(NamedTuple):
    origin: Array  # (line, 2, 3) float64: positions at start and end of the exposure [m]
    # (line, 2, 3, 3) float64: rotations from the camera's axes (forward, right, down) to the scene's, at
    # start and end
    rotation: Array
    column_edges: Array  # (column + 1,) float64: tangents of the edges of columns, across the track
    along_edges: Array  # (2,) float64: tangents of the rear and front edge of a line, along the track


# Light sources besides the uniform sky
class Sources(NamedTuple):
    suns: Array  # (sun, 3) float64: unit vectors towards the suns
    sun_radius: Array  # (sun,) float64: angular radius [rad]; 0 for a point
    overcast: bool  # whether to record the overcast sky besides the uniform sky
    # (sun, function, zenith, azimuth) float64: functions of clear skies relative to a uniform sky, at even
    # steps of the angle from the zenith, 0 to 90 degrees, and of the azimuth from the sun, 0 to 180 degrees;
    # empty without clear skies
    skies: Array = np.zeros((0, CLEAR_SKY_FUNCTIONS, 2, 2))


# Recorded paths and labels, allocated by the caller. NaN (labels: -1) if all samples show the sky.
class Block(NamedTuple):
    weight: Array  # (line, slot, column) float32: weights w [1]; 0 in empty slots
    code: Array  # (line, slot, column) int64: codes, ascending; -1 in empty slots, which are the last
    # material, instance: (line, column) int32: labels of the pair that most samples hit first; the smaller
    # numbers if several pairs have as many samples
    material: Array
    instance: Array
    purity: Array  # (line, column) float32: share of the samples that hit this pair first [1]
    distance: Array  # (line, column) float32: mean distance of the first hits [m]
    position: Array  # (line, 3, column) float64: mean position of the first hits [m]
    # (line, sun, column) float32: share of the first hits that face a sun which is not occluded [1]
    sun_visibility: Array
    # (line, sun, column) float32: mean over the first hits of the cosine between normal and sun, 0 for hits
    # that face away [1]
    incidence: Array

    @classmethod
    def empty(cls, lines: int, slots: int, columns: int, suns: int) -> Self:
        """Return an uninitialised block.

        Examples
        --------
        >>> Block.empty(2, 48, 640, 1).weight.shape
        (2, 48, 640)
        """
        by_pixel, by_slot, by_sun = (lines, columns), (lines, slots, columns), (lines, suns, columns)
        return cls(
            weight=np.empty(by_slot, np.float32),
            code=np.empty(by_slot, np.int64),
            material=np.empty(by_pixel, np.int32),
            instance=np.empty(by_pixel, np.int32),
            purity=np.empty(by_pixel, np.float32),
            distance=np.empty(by_pixel, np.float32),
            position=np.empty((lines, 3, columns)),
            sun_visibility=np.empty(by_sun, np.float32),
            incidence=np.empty(by_sun, np.float32),
        )


# Plain numbers of a trace
class Settings(NamedTuple):
    # number of the block's first line in the flight line, so that random numbers do not depend on blocks
    first_line: int
    samples: int  # number of paths of a pixel
    depth: int  # maximum number of scatterings
    digit_bits: int  # bits of a factor in a code
    seed: int  # non-negative integer


# Weights of a pixel's paths by code: an open-addressing table whose length is a power of two.
class PathTable(NamedTuple):
    codes: Array  # code of every place; -1 for empty places
    sums: Array  # sum of weights of every place
    used: Array  # numbers of the occupied places
    in_use: Array  # (1,) count of the occupied places


@borrowing_kernel
def with_factor(code: Any, factor: Any, digit_bits: int) -> Any:
    # insert a factor into a code, with digits in descending order
    digit = np.int64(factor) + 1
    max_digit = (np.int64(1) << digit_bits) - 1
    place = FIRST_DIGIT
    while (code >> place) & max_digit > digit:
        place += digit_bits
    return (
        (code & ((np.int64(1) << place) - 1)) | (digit << place) | ((code >> place) << (place + digit_bits))
    )


@borrowing_kernel
def add_path(table: PathTable, code: int, weight: float) -> None:
    if not weight > 0.0:
        return
    codes, sums, in_use = table.codes, table.sums, table.in_use
    place = place_of(codes, code)
    if codes[place] < 0:
        codes[place] = code
        sums[place] = 0.0
        table.used[in_use[0]] = place
        in_use[0] += 1
    sums[place] += weight


@borrowing_kernel
def _sort(table: PathTable, count: int, by_weight: bool) -> None:
    # order by descending weight, or by ascending code
    codes, sums, places = table.codes, table.sums, table.used
    gap = 1
    while gap < count // 3:
        gap = 3 * gap + 1
    while gap > 0:
        for i in range(gap, count):
            place = places[i]
            j = i
            while j >= gap:
                other = places[j - gap]
                is_tie = not by_weight or sums[place] == sums[other]
                if not (codes[place] < codes[other] if is_tie else sums[place] > sums[other]):
                    break
                places[j] = other
                j -= gap
            places[j] = place
        gap //= 3


@borrowing_kernel
def _thin(table: PathTable, count: int, slots: int, draw: float) -> int:
    # Reduce the codes of a pixel to ``slots`` without bias or change of the total weight; return their
    # number. The heaviest codes are kept unchanged. Of other codes, systematic sampling selects with
    # probabilities proportional to weights, and gives all selected codes the same weight.
    sums, places = table.sums, table.used
    _sort(table, count, True)
    light_sum = 0.0
    for i in range(count - 1, -1, -1):
        light_sum += sums[places[i]]
    kept_count = 0
    # a code heavier than the mean weight of the remaining slots is kept unchanged
    while kept_count < slots and sums[places[kept_count]] * (slots - kept_count) > light_sum:
        light_sum -= sums[places[kept_count]]
        kept_count += 1
    if kept_count == slots:
        kept_count = slots - 1
    light_sum = 0.0
    for i in range(kept_count, count):
        light_sum += sums[places[i]]
    step = light_sum / (slots - kept_count)
    selected, passed = kept_count, 0.0
    for i in range(kept_count, count):
        passed += sums[places[i]]
        if selected < slots and passed > (selected - kept_count + draw) * step:
            places[selected], places[i] = places[i], places[selected]
            selected += 1
    for i in range(kept_count, selected):
        sums[places[i]] = step
    return selected


@borrowing_kernel
def write_paths(
    table: PathTable, scale: float, draw: float, weight: Array, code: Array, line: int, column: int
) -> None:
    # write the table of a pixel in ascending order of codes
    # table: table of the pixel
    # scale: multiplier of the weights
    # draw: a random number inside (0, 1), for pixels with more codes than slots: see `_thin`
    # weight, code : (line, slot, column), float32 and int64: output
    # line, column: the pixel
    slots = weight.shape[1]
    number = table.in_use[0]
    if number > slots:
        number = _thin(table, number, slots, draw)
    _sort(table, number, False)
    for slot in range(slots):
        if slot < number:
            code[line, slot, column] = table.codes[table.used[slot]]
            weight[line, slot, column] = table.sums[table.used[slot]] * scale
        else:
            code[line, slot, column] = -1
            weight[line, slot, column] = 0.0


@borrowing_kernel
def record_sky(table: PathTable, sources: Sources, code: int, beta: float, direction: Vector) -> None:
    # add an escaped path for every sky: its weight times the relative radiance of the sky in its direction
    # table: table of the pixel
    # sources: sources whose skies are recorded
    # code, beta: code of the path without a source, and its weight
    # direction: unit vector of the escaping path, upwards, because there is no sky below the horizon
    add_path(table, code | SKY, beta)
    cos_zenith = direction[2]
    if sources.overcast:
        add_path(table, code | OVERCAST_SKY, 1.5 * cos_zenith * beta)
    if sources.skies.size == 0:
        return
    rows, columns = sources.skies.shape[2] - 1, sources.skies.shape[3] - 1
    row = math.acos(min(1.0, cos_zenith)) * (rows / (0.5 * math.pi))
    first_row = min(int(row), rows - 1)
    below = row - first_row
    for sun in range(sources.suns.shape[0]):
        x, y = sources.suns[sun, 0], sources.suns[sun, 1]
        # azimuth from the sun; none at the zenith, where functions do not depend on it
        level = math.sqrt((x * x + y * y) * (direction[0] ** 2 + direction[1] ** 2))
        cosine = (x * direction[0] + y * direction[1]) / level if level > 1e-12 else 1.0
        column = math.acos(min(1.0, max(-1.0, cosine))) * (columns / math.pi)
        first_column = min(int(column), columns - 1)
        beside = column - first_column
        for function in range(CLEAR_SKY_FUNCTIONS):
            # bilinear in both angles
            sky, a, b = sources.skies[sun, function], first_row, first_column
            radiance = (1.0 - below) * ((1.0 - beside) * sky[a, b] + beside * sky[a, b + 1]) + below * (
                (1.0 - beside) * sky[a + 1, b] + beside * sky[a + 1, b + 1]
            )
            add_path(table, code | (FIRST_CLEAR_SKY + CLEAR_SKY_FUNCTIONS * sun + function), beta * radiance)


# numbers of draws: even pairs for the first two surfaces, independent numbers from the third surface
_PIXEL, _TIME, _BODY, _COAT, _SECOND, _SUN = 0, 1, 2, 3, 4, 6
_SCATTER, _SHADOW, _SLOT = 16, 1024, 65537
_BEHIND = 64  # offset of the number of a scattering for the sun behind a plate
_LOBES = 6  # maximum number of codes that a sun adds at a surface


class _Workspace(NamedTuple):
    stack: Array  # (STACK,) nodes of a traversal
    entries: Array  # (STACK,) distances at which the ray enters these nodes
    table: PathTable
    # (5 + 2 suns,) sums over the first hits: count, distance, x, y, z; then for every sun the number of hits
    # that it lights, and the cosines
    first_hits: Array


class _Scene(NamedTuple):
    geometry: Geometry
    surfaces: Surfaces
    sources: Sources


# Key of the random numbers of a path.
class _PathKey(NamedTuple):
    seed: int
    line: int
    column: int
    sample: int
    key: int  # key of the pixel
    mask: int  # a power of two minus 1, at least the number of the last sample


# A path of light, followed backwards.
class _Path(NamedTuple):
    origin: Vector
    direction: Vector
    beta: float  # weight so far
    code: int
    spent: int  # number of factors in the code
    least_alpha: float  # minimum roughness of a mirror for light of a sun


# Codes of a path after each lobe of a surface, without a source.
class _Codes(NamedTuple):
    base: int
    coat: int
    flakes: int
    recycled: int  # scattering by flakes, then by the base; -1 if the code has no space for both
    twice: int  # scattering by flakes, then by flakes
    turned: int  # flakes with light and view at right angles; equal to ``flakes`` if angles do not matter


def trace_lines(
    geometry: Geometry,
    surfaces: Surfaces,
    sources: Sources,
    rays: Rays,
    settings: Settings,
    block: Block,
) -> None:
    # Trace lines and record their paths.
    #
    # ``geometry``, ``surfaces``, ``sources``: The scene and its light. ``rays``: Rays of the lines of this
    # block. ``settings``: Settings of the trace. ``block``: Output.
    #
    # Nothing is checked here: `Scene`, `Platform`, `TraceSettings` and `PathCodes` refuse all that the loops
    # cannot handle.
    #
    # At every hit a shadow ray goes to every sun; escaping paths meet the sky. At the first hit both the coat
    # and the layers under it are followed; later a single lobe: the coat with a probability that grows with
    # its reflectance, else the flakes with their share, else the diffuse base. Weights are divided by the
    # probability.
    #
    # The coat is a GGX surface with exact Fresnel reflectance and height-correlated shadowing; orange peel
    # tilts only the coat. It reflects the share E(c) of light from a direction of cosine c; the rest T = 1 -
    # E enters. Light passes the coat twice on the way to and from the base, which multiplies the weight by To
    # Ti / <T>, with the mean <T> of T over diffuse light: with the factor rho (1 - Fi) / (1 - rho Fi) and n^2
    # (1 - Fi) = <T>, this is the reflectance of a diffuse base of albedo rho under a dielectric. Flakes are
    # GGX mirrors under the coat, lit by refracted light:
    #
    # f = share To Ti / n^2 D G2 / (4 cos_o' cos_i')
    #
    # with angles inside the coat (primed). The part K(c) of the entering light that flakes reflect beyond the
    # critical angle, or to other flakes, returns to the paint, meets flakes with their share or else the
    # base, and leaves as To Ko Ti Ki / <T K>, multiplied by both factors: two scatterings of the ``depth``.
    # The base gets the share 1 - share. With all factors 1 no light is lost.
    #
    # The sky, uniform, overcast (L = 1.5 cos(zenith angle) E / pi) or a function of a clear sky, is above the
    # horizon; paths below the horizon end at the ground beyond the scene. Camera rays without a hit are
    # excluded from the mean of a pixel; if no ray has a hit, weights are NaN.
    #
    # A thin plate (``through_factor``) has a Lambert lobe on either side, with another spectrum for the side
    # behind. Suns light both sides; both sides are followed from the first surface, and later one of them at
    # random.
    settings = Settings(*map(int, settings))
    rays = Rays(*(np.ascontiguousarray(array, np.float64) for array in rays))
    suns = len(sources.suns)
    sky_codes = 2 * (2 + CLEAR_SKY_FUNCTIONS * suns)  # both branches may end in the sky
    max_codes = settings.samples * ((2 * settings.depth - 1) * suns * _LOBES + sky_codes)
    size = 1 << max(4, (2 * max_codes - 1).bit_length())
    room = _Workspace(
        stack=np.empty(STACK, np.int64),
        entries=np.empty(STACK),
        table=PathTable(
            np.full(size, -1), np.zeros(size), np.empty(max_codes, np.int64), np.zeros(1, np.int64)
        ),
        first_hits=np.zeros(5 + 2 * suns),
    )
    votes = np.empty((2, settings.samples), np.int64)
    _trace(_Scene(geometry, surfaces, sources), rays, settings, room, votes, block)


@borrowing_kernel
def _trace(
    scene: _Scene, rays: Rays, settings: Settings, room: _Workspace, votes: Array, block: Block
) -> None:
    # ``votes`` (2, sample): distinct pairs of labels, and the number of samples of every pair
    mask = 1
    while mask < settings.samples:
        mask *= 2
    table, first_hits = room.table, room.first_hits
    for line in range(block.material.shape[0]):
        number = settings.first_line + line
        for column in range(block.material.shape[1]):
            for i in range(table.in_use[0]):
                table.codes[table.used[i]] = -1
            table.in_use[0] = 0
            for i in range(first_hits.size):
                first_hits[i] = 0.0
            key = pixel_key(settings.seed, number, column)
            # count the labels of the samples
            distinct = 0
            for sample in range(settings.samples):
                path_key = _PathKey(settings.seed, number, column, sample, key, mask - 1)
                label = _trace_sample(scene, rays, line, path_key, settings, room)
                at = 0
                while at < distinct and votes[0, at] != label:
                    at += 1
                if at == distinct:
                    votes[0, at], votes[1, at] = label, 0
                    distinct += 1
                votes[1, at] += 1
            label, most = votes[0, 0], votes[1, 0]
            for i in range(1, distinct):
                if votes[1, i] > most or (votes[1, i] == most and votes[0, i] < label):
                    label, most = votes[0, i], votes[1, i]
            block.material[line, column] = label >> 32 if label >= 0 else -1
            block.instance[line, column] = label & 0xFFFFFFFF if label >= 0 else -1
            block.purity[line, column] = most / settings.samples
            # means over the first hits
            share = 1.0 / first_hits[0] if first_hits[0] > 0 else np.nan
            block.distance[line, column] = first_hits[1] * share
            for k in range(3):
                block.position[line, k, column] = first_hits[2 + k] * share
            for sun in range(scene.sources.suns.shape[0]):
                block.sun_visibility[line, sun, column] = first_hits[5 + 2 * sun] * share
                block.incidence[line, sun, column] = first_hits[6 + 2 * sun] * share
            draw, _, _, _ = uniforms(settings.seed, number, column, 0, _SLOT)
            write_paths(table, 1.0 / max(first_hits[0], 1.0), draw, block.weight, block.code, line, column)
            if first_hits[0] == 0.0:  # no sample hits a surface
                block.weight[line, 0, column], block.code[line, 0, column] = np.nan, SKY


@borrowing_kernel
def _camera_ray(rays: Rays, line: int, column: int, u: float, v: float, w: float) -> tuple[Vector, Vector]:
    right = rays.column_edges[column] + u * (rays.column_edges[column + 1] - rays.column_edges[column])
    forward = rays.along_edges[0] + v * (rays.along_edges[1] - rays.along_edges[0])
    a = _camera_axes(rays, line, 0, forward, right)
    b = _camera_axes(rays, line, 1, forward, right)
    p, q = rays.origin[line, 0], rays.origin[line, 1]
    origin = (p[0] + w * (q[0] - p[0]), p[1] + w * (q[1] - p[1]), p[2] + w * (q[2] - p[2]))
    return origin, unit((a[0] + w * (b[0] - a[0]), a[1] + w * (b[1] - a[1]), a[2] + w * (b[2] - a[2])))


@borrowing_kernel
def _camera_axes(rays: Rays, line: int, end: int, forward: float, right: float) -> Vector:
    r = rays.rotation[line, end]
    return (
        r[0, 0] * forward + r[0, 1] * right + r[0, 2],
        r[1, 0] * forward + r[1, 1] * right + r[1, 2],
        r[2, 0] * forward + r[2, 1] * right + r[2, 2],
    )


@borrowing_kernel
def _towards_sun(sources: Sources, sun: int, path_key: _PathKey, bounce: int) -> Vector:
    centre = (sources.suns[sun, 0], sources.suns[sun, 1], sources.suns[sun, 2])
    radius = sources.sun_radius[sun]
    if radius <= 0.0:
        return centre
    if bounce == 0:
        u, v = even_pair(path_key.key, path_key.sample, _SUN, path_key.mask)
    else:
        u, v, _, _ = uniforms(
            path_key.seed, path_key.line, path_key.column, path_key.sample, _SHADOW + bounce
        )
    fall = u * 2.0 * math.sin(0.5 * radius) ** 2  # 1 - cosine, without cancellation
    sine = math.sqrt(fall * (2.0 - fall))
    angle = 2.0 * math.pi * v
    return from_frame(frame_of(centre), (sine * math.cos(angle), sine * math.sin(angle), 1.0 - fall))


@borrowing_kernel
def _trace_sample(
    scene: _Scene, rays: Rays, line: int, path_key: _PathKey, settings: Settings, room: _Workspace
) -> Any:
    # trace a sample of a pixel; return the labels of its first hit, -1 for the sky
    geometry, surfaces, sources = scene
    u, v = even_pair(path_key.key, path_key.sample, _PIXEL, path_key.mask)
    w, _ = even_pair(path_key.key, path_key.sample, _TIME, path_key.mask)
    origin, direction = _camera_ray(rays, line, path_key.column, u, v, w)
    distance, face, weights = closest(geometry, room.stack, room.entries, origin, direction, np.inf)
    if face < 0:
        return -1
    material: Any = np.int64(geometry.face_material[face])
    hit, point = hit_at(geometry, face, weights, direction, surfaces.numbers[material, WAVINESS])
    back = (-direction[0], -direction[1], -direction[2])
    lobes = lobes_at(surfaces, material, in_frame(hit.frame, back), in_frame(hit.coat_frame, back), MIN_ALPHA)
    room.first_hits[0] += 1.0
    room.first_hits[1] += distance
    for k in range(3):
        room.first_hits[2 + k] += point[k]
    for sun in range(sources.suns.shape[0]):
        cosine = dot(hit.frame[2], (sources.suns[sun, 0], sources.suns[sun, 1], sources.suns[sun, 2]))
        room.first_hits[6 + 2 * sun] += max(cosine, 0.0)
    codes = _codes_after(surfaces, material, 0, MIRROR, 0, settings)
    _record_suns(scene, room, hit, lobes, codes, 1.0, path_key, 0)
    if lobes.refraction > 1.0:
        u, v = even_pair(path_key.key, path_key.sample, _COAT, path_key.mask)
        kind, local, weight = scatter_coat(lobes, u, v)
        towards = from_frame(hit.coat_frame, local)
        if kind != ENDED and leaves(hit, towards):
            path = _Path(hit.point, towards, weight, codes.coat, 0, BLURRED_ALPHA)
            _follow(scene, room, path, path_key, settings, 1)
    # a plate has no coat, so that the draws of the coat are used for the side behind
    if surfaces.through_factor[material] >= 0:
        rear, through = behind(hit, point), _codes_behind(surfaces, material, 0, settings)
        _record_suns(scene, room, rear, lobes, through, 1.0, path_key, _BEHIND)
        u, v = even_pair(path_key.key, path_key.sample, _COAT, path_key.mask)
        kind, local, weight = scatter_body(surfaces.numbers, lobes, u, v)
        towards = from_frame(rear.frame, local)
        if kind != ENDED and leaves(rear, towards):
            path = _Path(rear.point, towards, weight, through.base, 1, WIDENED_ALPHA)
            _follow(scene, room, path, path_key, settings, 1)
    u, v = even_pair(path_key.key, path_key.sample, _BODY, path_key.mask)
    kind, local, weight = scatter_body(surfaces.numbers, lobes, u, v)
    code, spent = _code_after_lobe(codes, kind, 0, lobes, local, path_key, 0)
    towards = from_frame(hit.frame, local)
    if kind != ENDED and code >= 0 and leaves(hit, towards):
        _follow(
            scene, room, _Path(hit.point, towards, weight, code, spent, WIDENED_ALPHA), path_key, settings, 0
        )
    # pack the two labels into a number that sorts by material first
    return material << 32 | np.int64(geometry.face_instance[face])


@borrowing_kernel
def _codes_after(
    surfaces: Surfaces, material: int, code: int, mirrored: int, spent: int, settings: Settings
) -> _Codes:
    # codes after every lobe of a surface; ``mirrored`` is the code after the coat
    bits, base, flakes = settings.digit_bits, surfaces.base_factor[material], surfaces.flake_factor[material]
    by_flakes = turned = with_factor(code, flakes, bits)
    recycled = twice = -1
    if surfaces.turned_factor[material] >= 0:
        turned = with_factor(code, surfaces.turned_factor[material], bits)
    if flakes >= 0 and spent + 2 <= settings.depth:
        recycled, twice = with_factor(by_flakes, base, bits), with_factor(by_flakes, flakes, bits)
    return _Codes(with_factor(code, base, bits), mirrored, by_flakes, recycled, twice, turned)


@borrowing_kernel
def _codes_behind(surfaces: Surfaces, material: int, code: int, settings: Settings) -> _Codes:
    # codes behind a plate, which has a single lobe
    through = with_factor(code, surfaces.through_factor[material], settings.digit_bits)
    return _Codes(through, through, through, -1, -1, through)


@borrowing_kernel
def _code_after_lobe(
    codes: _Codes, kind: int, spent: int, lobes: Lobes, local: Vector, path_key: _PathKey, turn: int
) -> tuple[int, int]:
    # code after a lobe, and its number of factors; of the two spectra of flakes one is chosen at random
    if kind == COAT:
        return codes.coat, spent
    if kind == FLAKES and codes.turned != codes.flakes:
        _, _, _, draw = uniforms(
            path_key.seed, path_key.line, path_key.column, path_key.sample, _SCATTER + turn
        )
        return codes.turned if draw < turned_part(lobes, local) else codes.flakes, spent + 1
    if kind == FLAKES:
        return codes.flakes, spent + 1
    if kind == RECYCLED:
        return codes.recycled, spent + 2
    return (codes.twice, spent + 2) if kind == TWICE else (codes.base, spent + 1)


@borrowing_kernel
def _follow(
    scene: _Scene, room: _Workspace, path: _Path, path_key: _PathKey, settings: Settings, branch: int
) -> None:
    # follow a path to its end; ``branch`` is 1 for paths that left by the coat, which use other random
    # numbers
    geometry, surfaces, sources = scene
    origin, direction, beta, code, spent, least_alpha = path
    for bounce in range(1, settings.depth):
        _, face, weights = closest(geometry, room.stack, room.entries, origin, direction, np.inf)
        if face < 0:
            if direction[2] > 0.0:  # downward paths end at the ground beyond the scene
                record_sky(room.table, sources, code, beta, direction)
            return
        if spent >= settings.depth:  # the code has no space for another factor
            return
        hit, point = hit_at(geometry, face, weights, direction, 0.0)
        material: Any = np.int64(geometry.face_material[face])
        view = in_frame(hit.frame, (-direction[0], -direction[1], -direction[2]))
        lobes = lobes_at(surfaces, material, view, view, least_alpha)
        code |= INDIRECT
        codes = _codes_after(surfaces, material, code, code, spent, settings)
        turn = 2 * bounce + branch
        _record_suns(scene, room, hit, lobes, codes, beta, path_key, turn)
        if bounce == 1:
            u, v = even_pair(path_key.key, path_key.sample, _SECOND + branch, path_key.mask)
        else:
            u, v, _, _ = uniforms(
                path_key.seed, path_key.line, path_key.column, path_key.sample, _SCATTER + turn
            )
        if surfaces.through_factor[material] >= 0:
            rear, through = behind(hit, point), _codes_behind(surfaces, material, code, settings)
            _record_suns(scene, room, rear, lobes, through, beta, path_key, turn + _BEHIND)
            beta *= 2.0  # only one of the two sides is followed
            _, _, side, _ = uniforms(
                path_key.seed, path_key.line, path_key.column, path_key.sample, _SCATTER + turn
            )
            if side > 0.5:
                hit, codes = rear, through
        kind, local, weight = scatter(surfaces.numbers, lobes, u, v)
        code, spent = _code_after_lobe(codes, kind, spent, lobes, local, path_key, turn)
        origin, direction = hit.point, from_frame(hit.frame, local)
        if kind == ENDED or code < 0 or not leaves(hit, direction):
            return
        beta *= weight
        least_alpha = max(least_alpha, BLURRED_ALPHA if kind == COAT else WIDENED_ALPHA)
    if direction[2] > 0.0 and not occluded(geometry, room.stack, room.entries, origin, direction, np.inf):
        record_sky(room.table, sources, code, beta, direction)


@borrowing_kernel
def _record_suns(
    scene: _Scene,
    room: _Workspace,
    hit: Hit,
    lobes: Lobes,
    codes: _Codes,
    beta: float,
    path_key: _PathKey,
    bounce: int,
) -> None:
    # add the light of every sun: shadow rays go to random points of its disc, angles are those of its centre,
    # lobes are means over the disc
    sources = scene.sources
    for sun in range(sources.suns.shape[0]):
        centre = (sources.suns[sun, 0], sources.suns[sun, 1], sources.suns[sun, 2])
        if dot(hit.frame[2], centre) < FACING or not leaves(hit, centre):
            continue
        towards = _towards_sun(sources, sun, path_key, bounce)
        if occluded(scene.geometry, room.stack, room.entries, hit.point, towards, np.inf):
            continue
        light, mirrored = in_frame(hit.frame, centre), in_frame(hit.coat_frame, centre)
        base, coat, flakes, recycled = sun_weights(
            scene.surfaces.numbers, lobes, light, mirrored, sources.sun_radius[sun]
        )
        add_path(room.table, codes.base | FIRST_SUN + sun, beta * base)
        add_path(room.table, codes.coat | FIRST_SUN + sun, beta * coat)
        turned_share = turned_part(lobes, light) if codes.turned != codes.flakes else 0.0
        add_path(room.table, codes.flakes | FIRST_SUN + sun, beta * flakes * (1.0 - turned_share))
        add_path(room.table, codes.turned | FIRST_SUN + sun, beta * flakes * turned_share)
        if codes.recycled >= 0:
            add_path(room.table, codes.recycled | FIRST_SUN + sun, beta * recycled * (1.0 - lobes.share))
            add_path(room.table, codes.twice | FIRST_SUN + sun, beta * recycled * lobes.share)
        if bounce == 0:
            room.first_hits[5 + 2 * sun] += 1.0
