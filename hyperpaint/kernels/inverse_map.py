"""Which place of a flight line lies at every cell of a map: the inverse of where its pixels lie.

Four neighbouring pixels span a quadrilateral on the map, and a bilinear patch between the lines and columns.
Every cell whose centre lies in it is given the line and the column, as fractions, that the patch has there.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from ._jit import kernel

__all__ = ["FIRST", "LAST", "NADIR", "fill_between", "invert_lines"]

Array = npt.NDArray[Any]

NADIR, FIRST, LAST = 0, 1, 2
"""Which of several patches over one cell counts: that nearest to the middle column, of the first line, or of
the last."""

_EDGE = 1e-9
"""Part of a patch by which its lower edges reach out and its upper ones fall short, so that a centre on the
edge of two belongs to one of them whatever is lost to rounding."""


@kernel
def _inside_patch(
    px: float, py: float, ax: float, ay: float, bx: float, by: float, cx: float, cy: float,
    end_u: float, end_v: float,
) -> tuple[bool, float, float]:  # fmt: skip
    """Return whether p = u a + v b + u v c with u and v from 0 to 1, and these.

    Of v remains a quadratic, whose roots are taken in the form that loses no digits; a step of Newton's
    method takes out what rounding has left.
    """
    k2 = bx * cy - by * cx
    k1 = ax * by - ay * bx - px * cy + py * cx
    k0 = ay * px - ax * py
    inside = k1 * k1 - 4.0 * k2 * k0
    if not inside >= 0.0:
        return False, 0.0, 0.0
    q = -0.5 * (k1 + math.copysign(math.sqrt(inside), k1))
    for root in range(2):
        v = math.nan
        if root == 0 and q != 0.0:
            v = k0 / q
        elif root == 1 and k2 != 0.0:
            v = q / k2
        if not (-0.01 < v < 1.01):
            continue
        jx, jy = ax + v * cx, ay + v * cy
        if jx * jx + jy * jy == 0.0:
            continue
        u = (px - v * bx) / jx if abs(jx) > abs(jy) else (py - v * by) / jy
        kx, ky = bx + u * cx, by + u * cy
        determinant = jx * ky - jy * kx
        if determinant != 0.0:
            fx = px - u * jx - v * bx
            fy = py - u * jy - v * by
            u += (fx * ky - fy * kx) / determinant
            v += (jx * fy - jy * fx) / determinant
        if -_EDGE <= u < end_u and -_EDGE <= v < end_v:
            return True, min(max(u, 0.0), 1.0), min(max(v, 0.0), 1.0)
    return False, 0.0, 0.0


@kernel
def _to_cells(east: Array, north: Array, frame: Array, x: Array, y: Array) -> tuple[float, float]:
    """Write where the pixels of a line lie, in cells; return the least and the largest row."""
    low, high = math.inf, -math.inf
    for j in range(east.size):
        e, n = east[j] - frame[0], north[j] - frame[1]
        x[j] = frame[2] * e + frame[3] * n
        y[j] = frame[4] * e + frame[5] * n
        if y[j] < low:
            low = y[j]
        if y[j] > high:
            high = y[j]
    return low, high


@kernel
def invert_lines(
    east: Array,
    north: Array,
    first: int,
    last: int,
    frame: Array,
    longest: float,
    rule: int,
    line: Array,
    sample: Array,
    rank: Array,
    hits: Array,
) -> None:
    """Write the place in a flight line of every cell of a tile, as far as some of its lines cover it.

    Parameters
    ----------
    east, north : (line, column), float64
        Where the pixels of lines that follow one another lie on the map [m]; NaN where that is not known.
    first, last
        Number of the first of these lines, and of the last line of the flight.
    frame : (6,), float64
        East and north of the centre of the tile's first cell [m]; then what turns metres from there into
        columns of cells, and into rows of cells, each by its part per metre east and north.
    longest
        Edge from which a patch is a gap, and covers nothing [cell].
    rule
        `NADIR`, `FIRST` or `LAST`.
    line, sample : (row, col), float64
        Place in the flight line, written where a patch covers a cell that has none yet or a worse one.
    rank : (row, col), float64
        What cells are compared by, the least wins; infinite where nothing has covered them.
    hits : (row, col), uint16
        Patches over every cell, added to.

    Notes
    -----
    Lines may go back over themselves: every patch is visited, whichever way round it lies.
    """
    rows, cols = line.shape
    columns = east.shape[1]
    middle = 0.5 * (columns - 1)
    x0, y0, x1, y1 = np.empty(columns), np.empty(columns), np.empty(columns), np.empty(columns)
    low0, high0 = _to_cells(east[0], north[0], frame, x0, y0)
    for i in range(1, east.shape[0]):
        low1, high1 = _to_cells(east[i], north[i], frame, x1, y1)
        end_v = 1.0 + _EDGE if first + i == last else 1.0 - _EDGE
        if max(high0, high1) >= -_EDGE and min(low0, low1) <= rows - 1 + _EDGE:
            for j in range(columns - 1):
                left = min(min(x0[j], x0[j + 1]), min(x1[j], x1[j + 1]))
                right = max(max(x0[j], x0[j + 1]), max(x1[j], x1[j + 1]))
                upper = min(min(y0[j], y0[j + 1]), min(y1[j], y1[j + 1]))
                lower = max(max(y0[j], y0[j + 1]), max(y1[j], y1[j + 1]))
                if right < -_EDGE or lower < -_EDGE or left > cols - 1 + _EDGE or upper > rows - 1 + _EDGE:
                    continue
                ax, ay = x0[j + 1] - x0[j], y0[j + 1] - y0[j]
                bx, by = x1[j] - x0[j], y1[j] - y0[j]
                cx, cy = x1[j + 1] - x1[j] - ax, y1[j + 1] - y1[j] - ay
                far_x, far_y = x1[j + 1] - x0[j + 1], y1[j + 1] - y0[j + 1]
                edge = max(
                    max(ax * ax + ay * ay, bx * bx + by * by),
                    max((ax + cx) ** 2 + (ay + cy) ** 2, far_x * far_x + far_y * far_y),
                )
                # a corner that is not known makes the sum NaN, whatever a comparison makes of it
                if not ax + ay + bx + by + cx + cy <= math.inf or not edge <= longest * longest:
                    continue
                end_u = 1.0 + _EDGE if j == columns - 2 else 1.0 - _EDGE
                for row in range(
                    max(0, math.ceil(upper - _EDGE)), min(rows - 1, math.floor(lower + _EDGE)) + 1
                ):
                    for col in range(
                        max(0, math.ceil(left - _EDGE)), min(cols - 1, math.floor(right + _EDGE)) + 1
                    ):
                        found, u, v = _inside_patch(
                            col - x0[j], row - y0[j], ax, ay, bx, by, cx, cy, end_u, end_v
                        )
                        if not found:
                            continue
                        if hits[row, col] < 65535:
                            hits[row, col] += 1
                        here_line, here_sample = first + i - 1 + v, j + u
                        worth = abs(here_sample - middle)
                        if rule == FIRST:
                            worth = here_line
                        elif rule == LAST:
                            worth = -here_line
                        if worth < rank[row, col]:
                            rank[row, col] = worth
                            line[row, col] = here_line
                            sample[row, col] = here_sample
        x0, x1 = x1, x0
        y0, y1 = y1, y0
        low0, high0 = low1, high1


@kernel
def fill_between(ends: Array, frame: Array, inside: Array) -> None:
    """Mark the cells that lie between the ends of lines that follow one another.

    Parameters
    ----------
    ends : (pair, 4, 2), float64
        East and north of the corners of the area between two lines, in the order around it [m].
    frame
        See `invert_lines`.
    inside : (row, col), bool
        Set where the centre of a cell lies in one of the areas.
    """
    rows, cols = inside.shape
    x, y, crossing = np.empty(4), np.empty(4), np.empty(4)
    for pair in range(ends.shape[0]):
        low, high = math.inf, -math.inf
        for k in range(4):
            e, n = ends[pair, k, 0] - frame[0], ends[pair, k, 1] - frame[1]
            x[k] = frame[2] * e + frame[3] * n
            y[k] = frame[4] * e + frame[5] * n
            low, high = min(low, y[k]), max(high, y[k])
        if not (high >= 0.0 and low <= rows - 1):
            continue
        for row in range(max(0, math.ceil(low)), min(rows - 1, math.floor(high)) + 1):
            count = 0
            for k in range(4):
                k1 = (k + 1) % 4
                if (y[k] <= row) != (y[k1] <= row):
                    at = x[k] + (row - y[k]) / (y[k1] - y[k]) * (x[k1] - x[k])
                    place = count
                    while place > 0 and crossing[place - 1] > at:
                        crossing[place] = crossing[place - 1]
                        place -= 1
                    crossing[place] = at
                    count += 1
            for k in range(0, count - 1, 2):
                if crossing[k] > cols - 1 or crossing[k + 1] < 0.0:
                    continue
                for col in range(
                    max(0, math.ceil(crossing[k])), min(cols - 1, math.floor(crossing[k + 1])) + 1
                ):
                    inside[row, col] = True
