"""Members of populations shown by pixels: smooth random fields over the positions of a scene.

A field is value noise on a cubic lattice, interpolated smoothly between corners, with variance 1 everywhere:

    g(x) = SUM_i w_i z_i / sqrt(SUM_i w_i^2)

with normal numbers z keyed by corner, instance and octave, so that values do not depend on other pixels.
Octaves of several lengths are summed; the rank of a pixel's member in its population is the normal
distribution function of the sum.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hyperpaint.base.arrays import Array
from hyperpaint.base.jit import borrowing_kernel

from .draws import philox

_MASK = 0xFFFFFFFF
_STEP = 2.0**-32
_COS = tuple(math.cos(angle) for angle in (0.4, 1.5, 2.3, 0.9))
_SIN = tuple(math.sin(angle) for angle in (0.4, 1.5, 2.3, 0.9))


class Grain(NamedTuple):
    """Spatial variation of populations; arrays with a row for every material.

    Attributes
    ----------
    first, members : (material,) int64
        First row and number of the members; 0 without a population.
    length : (material, octave) float64
        Length of the variation of an octave [m].
    share : (material, octave) float64
        Share of the variance [1].
    is_averaged : (material,) bool
        Whether octaves shorter than a pixel are averaged; False for members measured on pixels.
    """

    first: Array
    members: Array
    length: Array
    share: Array
    is_averaged: Array


class Texture(NamedTuple):
    """Ratios from the mean spectra of pixels to the spectra of members.

    Attributes
    ----------
    row : (line, column) int32
        Row of the member; -1 for no member.
    factor : (row,) int64
        Factor of a path that the member changes.
    ratio : (row, band) float32
        Multiplier of this factor [1].
    paths : (path, digit) int64
        Factors of every path; -1 for no factor.
    """

    row: Array
    factor: Array
    ratio: Array
    paths: Array


def member_rows(material: Array, instance: Array, place: Array, grain: Grain, seed: int) -> Array:
    """Return the member row of every pixel, (line, column) int32; -1 for no member.

    Parameters
    ----------
    material, instance : (line, column) int32
        Labels of a pixel; -1 for the sky.
    place : (3, line, column) float64
        Position of a pixel [m].
    grain
        Spatial variation of every material.
    seed
        Seed of the field.

    Examples
    --------
    >>> grain = Grain(*map(np.array, ([0], [9], [[0.1]], [[1.0]], [False])))
    >>> label = np.zeros((1, 4), np.int32)
    >>> place = np.stack([np.array([[0.0, 0.01, 3.0, 9.0]]), 0.0 * label, 0.0 * label])
    >>> member_rows(label, label, place, grain, 0)[0, 0] == member_rows(label, label, place, grain, 0)[0, 0]
    np.True_
    """
    rows = np.full(material.shape, -1, np.int32)
    pixel = _pixel_sizes(place)
    labels = np.ascontiguousarray(material, np.int32), np.ascontiguousarray(instance, np.int32)
    _write_rows(*labels, np.ascontiguousarray(place, np.float64), pixel, grain, int(seed) & _MASK, rows)
    return rows


def _pixel_sizes(place: Array) -> Array:
    # median distance of neighbouring pixels [m], by scan line
    if place.shape[2] < 2:
        return np.zeros(place.shape[1])
    distances = np.hypot(*np.diff(place[:2], axis=2))
    sizes = np.zeros(place.shape[1])
    for line, row in enumerate(distances):
        finite = row[np.isfinite(row)]
        if finite.size:
            sizes[line] = np.median(finite)
    return sizes


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
            rank = 0.5 * (1.0 + math.erf(total * math.sqrt(0.5)))
            count = grain.members[surface]
            rows[line, column] = grain.first[surface] + min(int(rank * count), count - 1)


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
    radius = math.sqrt(-2.0 * math.log((np.float64(a) + 0.5) * _STEP))
    return radius * math.cos(2.0 * math.pi * (np.float64(b) + 0.5) * _STEP)
