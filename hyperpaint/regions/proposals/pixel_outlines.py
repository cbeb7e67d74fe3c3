"""From a set of pixels to the polygon around them, along the sides of the pixels."""

from __future__ import annotations

import numpy as np

from hyperpaint.base.arrays import Bools, Floats

__all__ = ["outline"]


_STEPS = ((0, 1), (1, 0), (0, -1), (-1, 0))
"""Right, down, left, up, as (line, column); a right turn is the next one."""


def outline(mask: Bools, first: tuple[int, int] = (0, 0)) -> tuple[Floats, tuple[Floats, ...]]:
    """Return the ring around a connected set of pixels, and those around its holes.

    Parameters
    ----------
    mask : (line, column)
        The pixels; neighbours share a side.
    first
        Line and column of the first pixel of ``mask`` in the flight line.

    Returns
    -------
    polygon : (vertex, 2), float64
        x (column) and y (line) of its corners, halfway between pixel centres.
    holes
        Rings cut out of it.

    Examples
    --------
    >>> outline(np.ones((1, 2), bool), (4, 10))[0].tolist()
    [[9.5, 3.5], [11.5, 3.5], [11.5, 4.5], [9.5, 4.5]]
    """
    sides = _sides(mask)
    rings = []
    while sides:
        # the first corner in line order, so that the first ring is the one around all others
        rings.append(_follow(min(sides), sides))
    offset = np.array([first[1] - 0.5, first[0] - 0.5])
    made = [np.array([(x, y) for y, x in ring], np.float64) + offset for ring in rings]
    return made[0], tuple(made[1:])


def _sides(mask: Bools) -> dict[tuple[int, int], list[int]]:
    """Return the ways that lead from every corner along the mask, which lies to their right."""
    wide = np.pad(mask, 1)
    inner = wide[1:-1, 1:-1]
    beside = (wide[:-2, 1:-1], wide[1:-1, 2:], wide[2:, 1:-1], wide[1:-1, :-2])
    corner = ((0, 0), (0, 1), (1, 1), (1, 0))  # where the side above, right, below, left begins
    made: dict[tuple[int, int], list[int]] = {}
    for way, (other, (down, right)) in enumerate(zip(beside, corner, strict=True)):
        for line, column in np.argwhere(inner & ~other).tolist():
            made.setdefault((line + down, column + right), []).append(way)
    return made


def _follow(start: tuple[int, int], sides: dict[tuple[int, int], list[int]]) -> list[tuple[int, int]]:
    """Return the corners of the ring that begins at a corner, and take its sides away."""
    ring = []
    here = start
    way = min(sides[start])
    before = -1
    while here in sides:
        ways = sides[here]
        if len(ways) > 1 and before >= 0:
            # two pixels touch at a corner only: turn right, and stay with this one
            way = min(ways, key=lambda one: (one - before - 1) % 4)
        else:
            way = ways[0] if before >= 0 else way
        ways.remove(way)
        if not ways:
            del sides[here]
        if way != before:
            ring.append(here)
        here = (here[0] + _STEPS[way][0], here[1] + _STEPS[way][1])
        before = way
        if here == start:
            break
    return ring
