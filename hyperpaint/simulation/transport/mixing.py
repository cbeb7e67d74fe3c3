"""Recorded paths times products of spectra: radiance at the surface, and after the air before the camera.

Pixels of weathered surfaces show members of a population instead of its mean (`member_rows`).
"""

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from hyperpaint.base import Array
from hyperpaint.base.jit import borrowing_kernel, kernel

from .path_codes import philox, place_of

# Members of populations shown by pixels: smooth random fields over the positions of a scene.
#
# A field is value noise on a cubic lattice, interpolated smoothly between corners, of variance 1 everywhere:
#
#     g(x) = SUM_i w_i z_i / sqrt(SUM_i w_i^2)
#
# with normal numbers z keyed by corner, instance and octave, so that values do not depend on other pixels.
# Octaves of several lengths are summed; the rank of a pixel's member in its population is the normal
# distribution function of the sum.

_MASK = 0xFFFFFFFF
_STEP = 2.0**-32
_COS = tuple(math.cos(angle) for angle in (0.4, 1.5, 2.3, 0.9))
_SIN = tuple(math.sin(angle) for angle in (0.4, 1.5, 2.3, 0.9))


# Spatial variation of populations; arrays with a row for every material
class Grain(NamedTuple):
    # first, members: (material,) int64: first row and number of the members; 0 without a population
    first: Array
    members: Array
    length: Array  # (material, octave) float64: length of the variation of an octave [m]
    share: Array  # (material, octave) float64: share of the variance [1]
    # (material,) bool: whether octaves shorter than a pixel are averaged; False for members measured on
    # pixels
    is_averaged: Array
    # aspecular_angle, angle_range: (material,) float64: angle between view and mirrored sun of the middle
    # member, and range of these angles [degree]; a range of 0 where a random field selects the member
    aspecular_angle: Array
    angle_range: Array


# Ratios from the mean spectra of pixels to the spectra of members
class Texture(NamedTuple):
    row: Array  # (line, column) int32: row of the member; -1 for no member
    factor: Array  # (row,) int64: factor of a path that the member changes
    ratio: Array  # (row, band) float32: multiplier of this factor [1]
    paths: Array  # (path, digit) int64: factors of every path; -1 for no factor


def member_rows(
    material: Array,
    instance: Array,
    east: Array,
    north: Array,
    up: Array,
    incidence: Array,
    *,
    sun_zenith: float,
    grain: Grain,
    seed: int,
) -> Array:
    """Return the member row of every pixel, (line, column) int32; -1 for no member.

    Members of a paint with flakes are ordered by the angle between view and mirrored sun. The pixel is seen
    from above and leans towards or away from the sun by its incidence; in shade it shows the middle member.

    Parameters
    ----------
    material, instance : (line, column) int32
        Labels of a pixel; -1 for the sky.
    east, north, up : (line, column) float64
        Position of a pixel [m].
    incidence : (line, column) float32
        Cosine between normal and sun; NaN without direct sunlight.
    sun_zenith
        Zenith angle of the sun [degree].
    grain
        Spatial variation of every material.
    seed
        Seed of the field.

    Examples
    --------
    >>> grain = Grain(*map(np.array, ([0], [9], [[0.1]], [[1.0]], [False], [40.0], [20.0])))
    >>> label = np.zeros((1, 4), np.int32)
    >>> incidence = np.cos(np.radians([[35.0, 40.0, 45.0, np.nan]]))
    >>> member_rows(label, label, label, label, label, incidence, sun_zenith=40.0, grain=grain, seed=0)
    array([[8, 4, 0, 4]], dtype=int32)
    """
    rows = np.full(material.shape, -1, np.int32)
    place = np.stack([east, north, up])
    # median distance of neighbouring pixels [m], by scan line
    pixel = np.zeros(place.shape[1])
    if place.shape[2] > 1:
        for line, distances in enumerate(np.hypot(*np.diff(place[:2], axis=2))):
            if np.isfinite(distances).any():
                pixel[line] = np.median(distances[np.isfinite(distances)])
    labels = np.ascontiguousarray(material, np.int32), np.ascontiguousarray(instance, np.int32)
    _write_rows(*labels, np.ascontiguousarray(place, np.float64), pixel, grain, int(seed) & _MASK, rows)
    shown = np.where(rows >= 0, material, 0)
    by_angle = (rows >= 0) & (grain.angle_range[shown] > 0.0)
    if by_angle.any():
        surface, cosine = shown[by_angle], np.minimum(incidence[by_angle], 1.0)
        # a lean turns the mirrored sun by twice its angle
        angle = np.abs(2.0 * np.degrees(np.arccos(cosine)) - sun_zenith)
        turn = (grain.aspecular_angle[surface] - angle) / grain.angle_range[surface]
        place_in_range = 0.5 + np.nan_to_num(np.clip(turn, -0.5, 0.5))
        last = grain.members[surface] - 1
        rows[by_angle] = grain.first[surface] + np.rint(place_in_range * last).astype(np.int32)
    return rows


@borrowing_kernel
def _write_rows(
    material: Array, instance: Array, place: Array, pixel: Array, grain: Grain, seed: int, rows: Array
) -> None:
    for line in range(rows.shape[0]):
        for column in range(rows.shape[1]):
            surface = material[line, column]
            if surface < 0 or grain.members[surface] == 0:
                continue
            x, y, z = place[0, line, column], place[1, line, column], place[2, line, column]
            if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(z)):
                continue
            total = 0.0
            for octave in range(grain.length.shape[1]):
                length, share = grain.length[surface, octave], grain.share[surface, octave]
                if grain.is_averaged[surface]:
                    share /= 1.0 + (pixel[line] / length) ** 2
                if share > 0.0:
                    # rotate the lattice between octaves, so that its grid is not visible
                    u, v = _COS[octave % 4] / length, _SIN[octave % 4] / length
                    a, b = u * x - v * y, v * x + u * y
                    total += math.sqrt(share) * _noise(a, b, z / length, instance[line, column], octave, seed)
            count = grain.members[surface]
            rows[line, column] = grain.first[surface] + min(
                int((0.5 * (1.0 + math.erf(total * math.sqrt(0.5)))) * count), count - 1
            )


@borrowing_kernel
def _noise(x: float, y: float, z: float, instance: int, octave: int, seed: int) -> float:
    i, j, k = math.floor(x), math.floor(y), math.floor(z)
    u, v, w = _smooth_step(x - i), _smooth_step(y - j), _smooth_step(z - k)
    total, square = 0.0, 0.0
    for corner in range(8):
        a, b, c = corner & 1, (corner >> 1) & 1, corner >> 2
        weight = (u if a else 1.0 - u) * (v if b else 1.0 - v) * (w if c else 1.0 - w)
        if weight > 0.0:
            total += weight * _normal(i + a, j + b, k + c, instance, octave, seed)
            square += weight * weight
    return total / math.sqrt(square)


@borrowing_kernel
def _smooth_step(t: float) -> float:
    return t * t * (3.0 - 2.0 * t)


@borrowing_kernel
def _normal(i: int, j: int, k: int, instance: int, octave: int, seed: int) -> float:
    # a normal number by Box & Muller (1958)
    a, b, _, _ = philox(
        np.uint64(int(i) & _MASK),
        np.uint64(int(j) & _MASK),
        np.uint64(int(k) & _MASK),
        np.uint64(octave),
        np.uint64(int(instance) & _MASK),
        np.uint64(seed),
    )
    return math.sqrt(-2.0 * math.log((np.float64(a) + 0.5) * _STEP)) * math.cos(
        2.0 * math.pi * (np.float64(b) + 0.5) * _STEP
    )


_TILE = 16  # columns whose spectra are summed together, before they are written band by band


def index_paths(code: npt.NDArray[np.int64]) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int32]]:
    """Return the distinct codes of a block, and the index of every code among them.

    Parameters
    ----------
    code
        Codes of any shape, int64; negative for empty slots.

    Returns
    -------
    distinct, index
        Distinct codes in ascending order, and the index of every code among them, int32, same shape; -1 for
        empty slots.

    Examples
    --------
    >>> distinct, index = index_paths(np.array([[34, 2, -1], [2, 2, -1]]))
    >>> distinct.tolist(), index.tolist()
    ([2, 34], [[1, 0, -1], [0, 0, -1]])
    """
    codes = np.ascontiguousarray(code, np.int64).ravel()
    index = np.empty(codes.size, np.int32)
    size = 1024
    while True:
        table, places = np.full(size, -1), np.empty(size, np.int32)
        distinct = np.empty(size // 2, np.int64)
        number = _number(codes, table, places, distinct, index)
        if number >= 0:
            break
        size *= 4
    distinct = distinct[:number]
    order = np.argsort(distinct)
    rank = np.full(number + 1, -1, np.int32)  # the last entry is for index -1
    rank[order] = np.arange(number, dtype=np.int32)
    return distinct[order], rank[index].reshape(np.shape(code))


@borrowing_kernel
def _number(codes: Array, table: Array, places: Array, distinct: Array, index: Array) -> int:
    # number the codes in order of appearance; return the count, or -1 if the table is too small
    number = 0
    for i in range(codes.size):
        code = codes[i]
        if code < 0:
            index[i] = -1
            continue
        place = place_of(table, code)
        if table[place] < 0:
            if number == distinct.size:
                return -1
            table[place] = code
            places[place] = number
            distinct[number] = code
            number += 1
        index[i] = places[place]
    return number


def mix(
    weight: npt.NDArray[np.float32],
    index: npt.NDArray[np.int32],
    table: npt.NDArray[Any],
    out: npt.NDArray[np.float32],
) -> None:
    # Write the sum of weight x spectrum over slots.
    #
    # ``weight``, ``index``: Weights and rows of the table, shape (line, slot, column), float32 and int32; -1
    # for an empty slot. ``table``: Spectra, shape (path, band), float32 or float64; sums are float32.
    # ``out``: Output, shape (line, band, column), float32.
    columns = out.shape[2]
    mix_shifted(weight, index, np.asarray(table)[None], np.zeros(columns, int), np.ones((columns, 1)), out)


def mix_shifted(
    weight: npt.NDArray[np.float32],
    index: npt.NDArray[np.int32],
    table: npt.NDArray[Any],
    node: npt.NDArray[Any],
    node_weight: npt.NDArray[Any],
    out: npt.NDArray[np.float32],
    texture: Texture | None = None,
) -> None:
    # Write the sum of weight x spectrum over slots, with different spectra in every column.
    #
    # ``weight``, ``index``, ``out``: As for `mix`. ``table``: Spectra at nodes of the wavelength shift, shape
    # (node, path, band). ``node``: Number of the first node used by a column, shape (column,), integers.
    # ``node_weight``: Weights of the nodes from the first, shape (column, 4 or fewer). ``texture``: Members
    # shown by pixels instead of the mean; None for the means.
    spectra = np.ascontiguousarray(table, np.float32)
    weights, rows = np.ascontiguousarray(weight, np.float32), np.ascontiguousarray(index, np.int32)
    first_node, share = np.ascontiguousarray(node, np.int64), np.ascontiguousarray(node_weight, np.float32)
    if texture is None:
        lines, bands, columns = out.shape
        row, empty = np.full((lines, columns), -1, np.int32), np.zeros(0, np.int64)
        texture = Texture(row, empty, np.zeros((0, bands), np.float32), empty[:, None])
    sums = np.empty((2, _TILE, out.shape[1]), np.float32)
    _mix_shifted(weights, rows, spectra, first_node, share, texture, sums, out)


@borrowing_kernel
def _add_row(sums: Array, at: int, table: Array, node: int, row: int, weight: Any) -> None:
    # a loop of its own, which the compiler vectorises
    for band in range(table.shape[2]):
        sums[at, band] += weight * table[node, row, band]


@borrowing_kernel
def _has_factor(factors: Array, path: int, factor: int) -> bool:
    has_factor = False
    for digit in range(factors.shape[1]):
        has_factor = has_factor or factors[path, digit] == factor
    return has_factor


@borrowing_kernel
def _mix_shifted(
    weight: Array,
    index: Array,
    table: Array,
    node: Array,
    node_weight: Array,
    texture: Texture,
    sums: Array,
    out: Array,
) -> None:
    # ``sums`` (2, column, band): sum of paths without, and with, the factor that the pixel's member changes
    columns, bands = out.shape[2], out.shape[1]
    for line in range(out.shape[0]):
        for start in range(0, columns, _TILE):
            stop = min(start + _TILE, columns)
            for column in range(start, stop):
                at, member = column - start, texture.row[line, column]
                for band in range(bands):
                    sums[0, at, band] = sums[1, at, band] = 0
                for slot in range(weight.shape[1]):
                    row = index[line, slot, column]
                    if row < 0:
                        continue
                    term = 1 if member >= 0 and _has_factor(texture.paths, row, texture.factor[member]) else 0
                    for k in range(node_weight.shape[1]):
                        share = weight[line, slot, column] * node_weight[column, k]
                        _add_row(sums[term], at, table, node[column] + k, row, share)
                if member >= 0:
                    # the paths with the changed factor are multiplied by the member's ratio
                    for band in range(bands):
                        sums[0, at, band] += sums[1, at, band] * texture.ratio[member, band]
            for band in range(bands):
                for column in range(start, stop):
                    out[line, band, column] = sums[0, column - start, band]


@kernel
def integrate_bands(
    factors: Array, path_factors: Array, source: Array, weights: Array, first_band: Array, out: Array
) -> None:
    # integrate the products of paths over bands.
    # Every path is summed separately and in the order of wavelengths, so that its result does not depend on
    # other paths.
    # factors : (factor, grid), float64: spectra
    # path_factors : (path, digit), int64: factors of every path; -1 for no factor
    # source : (path,), int64: row of ``weights``; -1 for a source without light
    # weights : (source, node, grid, width), float64: integral of response x source x the basis function of a
    # grid point, for the bands from ``first_band``
    # first_band : (grid,), int64: first of the ``width`` bands to which a grid point contributes
    # out : (node, path, band), float32: output
    grid, width = weights.shape[2], weights.shape[3]
    nodes, bands = out.shape[0], out.shape[2]
    product, total = np.empty(grid, np.float64), np.empty(bands, np.float64)
    for path in range(path_factors.shape[0]):
        for point in range(grid):
            product[point] = 1.0
        for digit in range(path_factors.shape[1]):
            factor = path_factors[path, digit]
            if factor >= 0:
                for point in range(grid):
                    product[point] *= factors[factor, point]
        for node in range(nodes):
            for band in range(bands):
                total[band] = 0.0
            if source[path] >= 0:
                row = weights[source[path], node]
                for point in range(grid):
                    band_start, value = first_band[point], product[point]
                    for band in range(width):
                        total[band_start + band] += row[point, band] * value
            for band in range(bands):
                out[node, path, band] = total[band]


_THIN_DEPTH = 0.15  # optical depth up to which a short series is exact to float32


def through_air(surface: Array, extinction: Array, path_radiance: Array, distance: Array, out: Array) -> None:
    # write L exp(-k d) + Lp d
    # surface : (line, band, column), float32: L [W m-2 sr-1 nm-1]
    # extinction, path_radiance : (band, column or 1), float32: k [m-1], Lp [W m-2 sr-1 nm-1 m-1]
    # distance : (line, column), float32: d [m]; not finite without air
    # out : (line, band, column), float32: output
    extinctions = np.ascontiguousarray(
        np.broadcast_to(extinction, (surface.shape[1], surface.shape[2])), np.float32
    )
    added = np.ascontiguousarray(np.broadcast_to(path_radiance, extinctions.shape), np.float32)
    metres = np.ascontiguousarray(np.where(np.isfinite(distance), distance, 0.0), np.float32)
    max_extinction = extinctions.max(axis=0, initial=0.0)
    for line in range(len(surface)):
        # decide by line, so that bits do not depend on other lines of the block
        if (max_extinction * metres[line]).max(initial=0.0) < _THIN_DEPTH:
            thin_air(surface[line], extinctions, added, metres[line], out[line])
        else:
            np.multiply(surface[line], np.exp(extinctions * -metres[line]), out=out[line])
            out[line] += added * metres[line]


@kernel
def thin_air(surface: Array, extinctions: Array, added: Array, metres: Array, out: Array) -> None:
    unity = np.float32(1.0)
    for band in range(surface.shape[0]):
        for column in range(surface.shape[1]):
            depth = extinctions[band, column] * metres[column]
            # series of exp(-depth) with an error below depth^6 / 720
            transmittance = unity - depth * np.float32(1 / 5)
            transmittance = unity - depth * np.float32(1 / 4) * transmittance
            transmittance = unity - depth * np.float32(1 / 3) * transmittance
            transmittance = unity - depth * np.float32(1 / 2) * transmittance
            transmittance = unity - depth * transmittance
            out[band, column] = surface[band, column] * transmittance + added[band, column] * metres[column]
