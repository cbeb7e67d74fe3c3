"""Exact test of points in a polygon, for any coordinates.

A point on an edge is inside. The sign of a cross product tells on which side of an edge a point lies. Where
its float64 value is within its rounding error bound [1]_, it is computed again in rational numbers. shapely
is not used: GEOS takes points very close to an edge for points on it (tests/regions/test_regions.py, corners
divided by three).

References
----------
.. [1] J. R. Shewchuk, "Adaptive Precision Floating-Point Arithmetic and Fast Robust Geometric Predicates",
   Discrete Comput. Geom. 18, 305-363 (1997), section 4.1.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction

import numpy as np
import numpy.typing as npt

from hyperpaint.base.arrays import Bools, Floats
from hyperpaint.base.errors import SchemaError

Index = npt.NDArray[np.intp]

_EPSILON = 2.0**-53
_ROUNDING = (3.0 + 16.0 * _EPSILON) * _EPSILON
_TINIEST = float(np.finfo(np.float64).tiny)

#: Maximum mean number of edges whose y range contains the y of a pixel: few for an outline, thousands for a
#: zigzag.
MAX_EDGES_PER_PIXEL = 100
#: Number of comparisons of an edge with a point below which no polygon is refused.
FREE_COMPARISONS = 10_000_000


def contains(polygon: Floats, holes: Sequence[Floats], x: Floats, y: Floats) -> Bools:
    """Return whether points lie in a polygon or on one of its edges (point,).

    ``polygon`` (vertex, 2): x and y of its corners, in order, the last joined to the first; ``holes``: rings
    cut out of it, whose edges belong to the polygon; ``x``, ``y`` (point,): the points; NaN are in no
    polygon. Where a ring crosses itself, areas that it winds around an even number of times are outside
    (even-odd rule).

    Raises `SchemaError`: too many long edges; the test would take minutes.

    Examples
    --------
    >>> square = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0]])
    >>> contains(square, [], np.array([1.0, 2.0, 2.1]), np.array([1.0, 0.5, 0.5])).tolist()
    [True, True, False]
    """
    low, high = polygon.min(axis=0), polygon.max(axis=0)
    near = np.flatnonzero((x >= low[0]) & (x <= high[0]) & (y >= low[1]) & (y <= high[1]))
    # sorted by y, the points within the y range of an edge are one run
    near = near[np.argsort(y[near], kind="stable")]
    near_x, near_y = x[near], y[near]
    rings = [polygon, *holes]
    runs = [_runs(ring, near_y) for ring in rings]
    comparisons = sum(int((last - first).clip(0).sum()) for first, last in runs)
    if comparisons > FREE_COMPARISONS + MAX_EDGES_PER_PIXEL * near.size:
        raise SchemaError(
            f"on average {comparisons / near.size:.0f} edges lie beside each of {near.size} pixels",
            expected=f"at most {MAX_EDGES_PER_PIXEL}",
            mend="split the polygon, or give it fewer corners",
            code="polygon-too-complex",
        )
    inside = np.ones(near.size, bool)
    for number, (ring, (first, last)) in enumerate(zip(rings, runs, strict=True)):
        # only points within the y range of a hole can lie in it
        run = slice(int(first.min()), int(last.max())) if number else slice(0, near.size)
        if run.start >= run.stop:
            continue
        within, edge = _ring(ring, near_x[run], near_y[run], first - run.start, last - run.start)
        inside[run] &= ~within | edge if number else within | edge
    belongs: Bools = np.zeros(x.size, bool)
    belongs[near] = inside
    return belongs


def _runs(ring: Floats, y: Floats) -> tuple[Index, Index]:
    # Start and stop (edge,) of the points whose y lies within an edge's y range; y ascends
    closed = np.concatenate([ring, ring[:1]])[:, 1]
    first = np.searchsorted(y, np.minimum(closed[:-1], closed[1:]), "left")
    return first, np.searchsorted(y, np.maximum(closed[:-1], closed[1:]), "right")


def _ring(ring: Floats, x: Floats, y: Floats, first: Index, last: Index) -> tuple[Bools, Bools]:
    # Masks of the points that a ring winds around an odd number of times, and of those on the ring
    within = np.zeros(x.size, bool)
    edge = np.zeros(x.size, bool)
    closed = np.concatenate([ring, ring[:1]])
    low, high = np.minimum(closed[:-1], closed[1:]), np.maximum(closed[:-1], closed[1:])
    for k in np.flatnonzero(first < last):
        run = slice(first[k], last[k])
        start, stop = closed[k], closed[k + 1]
        side = _side(start, stop, x[run], y[run])
        edge[run] |= (side == 0) & (x[run] >= low[k, 0]) & (x[run] <= high[k, 0])
        # a ray from the point in +x crosses rising edges left of them, falling edges right of them;
        # half-open y ranges count a corner once
        rises = (start[1] <= y[run]) & (y[run] < stop[1]) & (side > 0)
        within[run] ^= rises | (stop[1] <= y[run]) & (y[run] < start[1]) & (side < 0)
    return within, edge


def _side(start: Floats, stop: Floats, x: Floats, y: Floats) -> npt.NDArray[np.int8]:
    # 1 for points left of a directed edge, -1 right of it, 0 on its line
    along_x, along_y = stop[0] - start[0], stop[1] - start[1]
    off_x, off_y = x - start[0], y - start[1]
    product_xy, product_yx = along_x * off_y, along_y * off_x
    cross = product_xy - product_yx
    side: npt.NDArray[np.int8] = np.sign(cross).astype(np.int8)
    doubtful = np.abs(cross) <= _ROUNDING * (np.abs(product_xy) + np.abs(product_yx)) + _TINIEST
    # products with a zero difference are exact
    doubtful &= ((along_x != 0) & (off_y != 0)) | ((along_y != 0) & (off_x != 0))
    # the sign in exact rational arithmetic
    x0, y0, x1, y1 = (Fraction(float(value)) for value in (*start, *stop))
    for k in np.flatnonzero(doubtful).tolist():
        exact = (x1 - x0) * (Fraction(float(y[k])) - y0) - (y1 - y0) * (Fraction(float(x[k])) - x0)
        side[k] = (exact > 0) - (exact < 0)
    return side
