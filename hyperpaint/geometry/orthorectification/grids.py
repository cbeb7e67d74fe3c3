"""How the cells of a map lie: north up, or along the flight."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from hyperpaint.base.arrays import Floats

__all__ = ["Axes", "Box", "MapGrid", "box_of", "covering", "flight_axes", "north_axes"]

Box = tuple[float, float, float, float]
"""Least and largest way to the right, then down, from the anchor of axes [m]."""

_ELONGATED = 2.0
"""How much longer than wide a track is, to tell a direction of flight."""
_ROUNDING = 1e-6
"""Part of a cell that is not worth a cell of its own."""


@dataclass(frozen=True)
class Axes:
    """Directions that the columns and rows of a grid go in, and the place they are counted from.

    Attributes
    ----------
    right
        East and north of one step to the right, of unit length. Down is a right angle clockwise of it, so
        that a map is never seen from below.
    anchor
        East and north that lie on a corner of cells [m].
    """

    right: tuple[float, float]
    anchor: tuple[float, float]

    @property
    def down(self) -> tuple[float, float]:
        """East and north of one step down."""
        return self.right[1], -self.right[0]

    def along(self, east: Floats, north: Floats) -> tuple[Floats, Floats]:
        """Return how far places lie to the right of, and down from, the anchor [m]."""
        e, n = east - self.anchor[0], north - self.anchor[1]
        (a, b), (c, d) = self.right, self.down
        return a * e + b * n, c * e + d * n

    def moved(self, x: float, y: float) -> Axes:
        """Return axes whose anchor lies a way to the right and down from this one's [m]."""
        (a, b), (c, d) = self.right, self.down
        return Axes(self.right, (self.anchor[0] + x * a + y * c, self.anchor[1] + x * b + y * d))


@dataclass(frozen=True)
class MapGrid:
    """Square cells on a map.

    Attributes
    ----------
    axes
        Which way the grid lies.
    gsd
        Edge of a cell [m].
    first
        Row and column of its first cell, counted from the anchor of the axes.
    shape
        Rows and columns.

    Examples
    --------
    >>> grid = MapGrid(north_axes(), 2.0, first=(-50, 10), shape=(30, 20))
    >>> grid.transform
    (20.0, 2.0, 0.0, 100.0, 0.0, -2.0)
    """

    axes: Axes
    gsd: float
    first: tuple[int, int]
    shape: tuple[int, int]

    @property
    def transform(self) -> tuple[float, float, float, float, float, float]:
        """Map coordinates of the outer corner of the first cell, and steps, in the order of GDAL."""
        (a, b), (c, d), size = self.axes.right, self.axes.down, self.gsd
        east, north = self._place(0.0, 0.0)
        return (east, size * a, size * c, north, size * b, size * d)

    def _place(self, row: float, col: float) -> tuple[float, float]:
        (a, b), (c, d) = self.axes.right, self.axes.down
        y, x = (self.first[0] + row) * self.gsd, (self.first[1] + col) * self.gsd
        return self.axes.anchor[0] + x * a + y * c, self.axes.anchor[1] + x * b + y * d

    def centres(self, rows: slice, cols: slice) -> tuple[Floats, Floats]:
        """Return east and north of the centres of cells (row, col) [m]."""
        row = np.arange(rows.start, rows.stop)[:, None] + 0.5
        col = np.arange(cols.start, cols.stop)[None, :] + 0.5
        (a, b), (c, d) = self.axes.right, self.axes.down
        y, x = (self.first[0] + row) * self.gsd, (self.first[1] + col) * self.gsd
        return self.axes.anchor[0] + x * a + y * c, self.axes.anchor[1] + x * b + y * d

    @property
    def frame(self) -> Floats:
        """What turns map coordinates into cells, see `hyperpaint.kernels.inverse_map`."""
        east, north = self._place(0.5, 0.5)
        turn = np.array([*self.axes.right, *self.axes.down]) / self.gsd
        return np.concatenate([[east, north], turn])


def north_axes() -> Axes:
    """Return axes of a map with north up, whose cells start at whole multiples of their size."""
    return Axes((1.0, 0.0), (0.0, 0.0))


def flight_axes(left: Floats, right: Floats) -> Axes:
    """Return axes along a flight, which goes up.

    Parameters
    ----------
    left, right : (line, 2)
        East and north of either end of lines in the order of flight [m].

    Notes
    -----
    The direction is the longest axis of the middles of the lines. A track that is hardly longer than it is
    wide tells none; square to the lines is taken instead.
    """
    middle = (left + right) / 2
    _, spread, directions = np.linalg.svd(middle - middle.mean(axis=0), full_matrices=False)
    ahead = middle[-1] - middle[0]
    flight = directions[0]
    if len(middle) < 3 or not spread[0] > _ELONGATED * spread[1]:
        across = (right - left).mean(axis=0)
        flight = np.array([-across[1], across[0]])
        if not np.hypot(*flight) > 0.0:
            flight = np.array([0.0, 1.0])
    if flight @ ahead < 0.0:
        flight = -flight
    heading = math.atan2(flight[0], flight[1])
    return Axes((math.cos(heading), -math.sin(heading)), (float(middle[0, 0]), float(middle[0, 1])))


def covering(axes: Axes, gsd: float, box: Box, *, whole: bool) -> MapGrid:
    """Return the grid over a box of the axes; with ``whole`` cells reach over all of it, else centres do."""
    left, right, upper, lower = (edge / gsd for edge in box)
    if whole:
        first = math.floor(upper + _ROUNDING), math.floor(left + _ROUNDING)
        last = math.ceil(lower - _ROUNDING), math.ceil(right - _ROUNDING)
    else:
        first = math.ceil(upper - 0.5 - _ROUNDING), math.ceil(left - 0.5 - _ROUNDING)
        last = math.floor(lower + 0.5 + _ROUNDING), math.floor(right + 0.5 + _ROUNDING)
    shape = max(last[0] - first[0], 1), max(last[1] - first[1], 1)
    return MapGrid(axes, gsd, first, shape)


def box_of(axes: Axes, bounds: Any) -> Box:
    """Return the box of the axes around bounds of the map: west, south, east, north [m]."""
    west, south, east, north = (float(edge) for edge in bounds)
    x, y = axes.along(np.array([west, west, east, east]), np.array([south, north, south, north]))
    return float(x.min()), float(x.max()), float(y.min()), float(y.max())
