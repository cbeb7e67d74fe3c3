"""The ground of a car park: strips of grass, kerbs, bays with painted lines and aisles, without overlaps."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from hyperpaint.base.errors import SchemaError

from .primitives import Mesh, cuboid, polygon, put_together, uniform

#: Length and width of a bay [m].
BAY = (5.0, 2.5)

_GRASS, _KERB, _GUTTER = 1.0, 0.3, 0.1  # widths of what lies west of the first row [m]
_AISLE, _WIDEST_AISLE = 4.5, 6.5
_KERB_HEIGHT, _LAWN = 0.12, 0.10  # above the asphalt [m]
_ISLAND_PERIOD, _ISLAND_START = 11, 7  # bays
_TUFTED = 2.5  # how far from the kerb the lawn has blades [m]
_WEAR = 4  # what a random number is for
_BEYOND = 7.0  # how far the asphalt goes on before the first bay and behind the last [m]


@dataclass(frozen=True)
class Layout:
    """Where things are in a car park; x from west to east, y from south to north [m].

    Attributes
    ----------
    length, width, margin, line_width
        As of the car park.
    rows, aisles
        West and east end of each.
    with_islands
        Whether islands take the place of some bays.
    """

    length: float
    width: float
    margin: float
    line_width: float
    rows: tuple[tuple[float, float], ...]
    aisles: tuple[tuple[float, float], ...]
    with_islands: bool

    @property
    def bays(self) -> int:
        """Number of bays in a row, the last one perhaps only begun."""
        return int(np.ceil(round(self.length / BAY[1], 9)))

    @property
    def kerb(self) -> tuple[float, float]:
        """Ends of the kerb in the west."""
        west = -0.5 * self.width + _GRASS
        return west, west + _KERB

    @property
    def east_kerb(self) -> tuple[float, float]:
        """Ends of the kerb in the east."""
        west = self.rows[-1][1] + _GUTTER
        return west, west + _KERB

    @property
    def wall(self) -> float:
        """Middle of the wall in the east."""
        return max(0.5 * self.width - 0.5, self.east_kerb[1] + 0.2)

    @property
    def west_trees(self) -> float:
        """Line of trees in the west, just outside the park."""
        return -0.5 * self.width - 0.3

    @property
    def lamps(self) -> float:
        """Line of lamps in the west."""
        return -0.5 * self.width + 0.6

    def is_island(self, bay: int, row: int) -> bool:
        """Return whether an island takes the place of a bay; those of two rows back to back lie together."""
        return self.with_islands and (bay + 5 * ((row + 1) // 2)) % _ISLAND_PERIOD == _ISLAND_START

    def islands(self) -> Iterator[tuple[int, tuple[float, float]]]:
        """Yield bay, and west and east end, of every island."""
        for bay in range(self.bays):
            for row, ends in enumerate(self.rows):
                if self.is_island(bay, row):
                    yield bay, ends


def strips_across(
    length: float, width: float, rows: int | None, *, margin: float, line_width: float, islands: bool
) -> Layout:
    """Return the layout of rows and aisles.

    Raises
    ------
    SchemaError
        The rows do not fit into the width.

    Examples
    --------
    >>> layout = strips_across(20.0, 16.0, None, margin=10.0, line_width=0.1, islands=False)
    >>> [(round(a, 3), round(b, 3)) for a, b in (*layout.rows, *layout.aisles)]
    [(-6.6, -1.6), (2.9, 7.9), (-1.6, 2.9)]
    """
    edge = _GRASS + _KERB + _GUTTER
    most = max((n for n in range(1, 200) if _least_width(n) <= width + 1e-9), default=0)
    wanted = most if rows is None else rows
    if not 1 <= wanted <= most:
        least = _least_width(max(wanted, 1))
        raise SchemaError(
            f"the car park is {width:g} m wide",
            expected=f"{least:.1f} m or more for {max(wanted, 1)} rows of bays",
            code="car-park-too-narrow",
        )
    aisles = (wanted + 1) // 2
    aisle = min(_AISLE + (width - _least_width(wanted)) / aisles, _WIDEST_AISLE) if wanted < 4 else _AISLE
    west, row_ends, aisle_ends = edge - 0.5 * width, [], []
    for row in range(wanted):
        row_ends.append((west, west + BAY[0]))
        west += BAY[0]
        if row % 2 == 0:
            aisle_ends.append((west, west + aisle))
            west += aisle
    return Layout(length, width, margin, line_width, tuple(row_ends), tuple(aisle_ends), islands)


def _least_width(rows: int) -> float:
    return _GRASS + _KERB + 2 * _GUTTER + BAY[0] * rows + _AISLE * ((rows + 1) // 2)


def paved(layout: Layout) -> Mesh:
    """Return the ground, of the surfaces "asphalt", "line", "concrete" and "grass".

    Lines are cells of the ground, not plates upon it; kerbs and islands stand out of it. A sheet of asphalt
    a little deeper closes the joints.
    """
    south, north = -layout.margin, layout.length + layout.margin
    first, last = max(-_BEYOND, south), min(layout.length + _BEYOND, north)
    west, east = layout.kerb[1], layout.east_kerb[0]
    far_west, far_east = -0.5 * layout.width - layout.margin, 0.5 * layout.width + layout.margin
    pieces = [_level(far_west, far_east, south, north, "asphalt", -0.05)]
    for begin, end in (*_gaps(layout.rows, west, east), (layout.kerb[0], west), (east, layout.east_kerb[1])):
        pieces.append(_level(begin, end, first, last, "asphalt"))
    for begin, end in layout.rows:
        pieces += _bays(layout, begin, end, first, last)
    for begin, end in (layout.kerb, layout.east_kerb):
        kerb = cuboid((end - begin, last - first, _KERB_HEIGHT + 0.03), "concrete")
        pieces.append(kerb.shifted((0.5 * (begin + end), 0.5 * (first + last), -0.03)))
    for edge in (first - 0.5 * _KERB, last + 0.5 * _KERB):
        kerb = cuboid((layout.east_kerb[1] - layout.kerb[0], _KERB, _KERB_HEIGHT + 0.04), "concrete")
        pieces.append(kerb.shifted((0.5 * (layout.east_kerb[1] + layout.kerb[0]), edge, -0.03)))
    lawns = [(far_west, layout.kerb[0], south, north), (layout.east_kerb[1], far_east, south, north)]
    lawns += [(layout.kerb[0], layout.east_kerb[1], *ends) for ends in ((south, first), (last, north))]
    pieces += [_level(*lawn, "grass", _LAWN) for lawn in lawns if lawn[1] > lawn[0] and lawn[3] > lawn[2]]
    for bay, (begin, end) in layout.islands():
        pieces += _island(bay, begin, end)
    pieces += _arrows(layout)
    return put_together(pieces)


def worn(layout: Layout, seed: int) -> list[Mesh]:
    """Return traces of wear: stains in bays and patches in aisles, 3 mm thick, and tufts of grass.

    Its surfaces are "patch" and "grass".
    """
    pieces = []
    angle = 2 * np.pi * np.arange(11) / 11
    for row, (begin, end) in enumerate(layout.rows):
        for bay in range(layout.bays):
            rng = np.random.default_rng([seed, _WEAR, bay, row])
            if layout.is_island(bay, row) or rng.random() < 0.4:
                continue
            radius = rng.uniform(0.08, 0.30) * rng.uniform(0.75, 1.2, (11, 1))
            middle = (rng.uniform(begin + 1.2, end - 1.2), (bay + 0.5) * BAY[1] + rng.uniform(-0.4, 0.4))
            rim = middle + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
            pieces.append(polygon(np.column_stack([rim, np.full(11, 0.003)]), "patch"))
    for number, (begin, end) in enumerate(layout.aisles):
        for step in range(int(layout.length // 12.0)):
            rng = np.random.default_rng([seed, _WEAR, step, number, 1])
            west, south = rng.uniform(begin + 0.2, end - 1.6), 12.0 * step + rng.uniform(4.0, 9.0)
            size = rng.uniform((0.5, 0.6), (1.3, 2.5))
            pieces.append(_level(west, west + size[0], south, south + size[1], "patch", 0.003))
    return [*pieces, *_tufts(layout, seed)]


def _tufts(layout: Layout, seed: int) -> list[Mesh]:
    """Return blades of grass on the lawn nearest to the cars: one mesh for every bay's length."""
    tufts = []
    for bay in range(layout.bays):
        rng = np.random.default_rng([seed, _WEAR, bay])
        east, count = layout.kerb[0], 300
        foot = rng.uniform(
            (east - _TUFTED, bay * BAY[1], _LAWN), (east, (bay + 1) * BAY[1], _LAWN), (count, 3)
        )
        lean = rng.normal(0.0, 0.05, (count, 3)) * (1, 1, 0) + (0, 0, 0.07)
        side = rng.normal(0.0, 0.06, (count, 3)) * (1, 1, 0)
        corners = np.stack([foot - side, foot + side, foot + lean], axis=1)
        tufts.append(uniform(corners.reshape(-1, 3), np.arange(3 * count), "grass"))
    return tufts


def _gaps(rows: tuple[tuple[float, float], ...], west: float, east: float) -> Iterator[tuple[float, float]]:
    """Yield the strips between the rows: aisles and gutters."""
    for begin, end in itertools.pairwise([(west, west), *rows, (east, east)]):
        if end[0] - begin[1] > 1e-6:
            yield begin[1], end[0]


def _bays(layout: Layout, begin: float, end: float, first: float, last: float) -> Iterator[Mesh]:
    """Yield the cells of one row of bays: asphalt and the painted lines."""
    south = first
    for line in range(layout.bays + 1):
        low, high = (line * BAY[1] + side * 0.5 * layout.line_width for side in (-1, 1))
        if high > last:
            break
        if low > south:
            yield _level(begin, end, south, low, "asphalt")
        if low >= south:
            yield _level(begin, end, low, high, "line")
            south = high
    if last > south:
        yield _level(begin, end, south, last, "asphalt")


def _island(bay: int, begin: float, end: float) -> Iterator[Mesh]:
    """Yield a kerbed island that fills a bay."""
    at = (0.5 * (begin + end), (bay + 0.5) * BAY[1])
    length, wide = end - begin - 0.1, BAY[1] - 0.3
    yield cuboid((length, wide, _KERB_HEIGHT + 0.03), "concrete").shifted((*at, -0.03))
    yield cuboid((length - 0.4, wide - 0.4, 0.06), "grass").shifted((*at, _KERB_HEIGHT - 0.03))


def _arrows(layout: Layout) -> Iterator[Mesh]:
    """Yield the painted arrows of the aisles, 4 mm thick."""
    outline = [
        [[-0.09, -1.2], [0.09, -1.2], [0.09, 0.4], [-0.09, 0.4]],
        [[-0.32, 0.4], [0.32, 0.4], [0.0, 1.2]],
    ]
    for number, (begin, end) in enumerate(layout.aisles):
        way = -1.0 if number % 2 else 1.0
        for y in np.arange(10.0, layout.length, 15.0):
            for piece in outline:
                corners = [(0.5 * (begin + end) + way * px, y + way * py, 0.004) for px, py in piece]
                yield polygon(corners, "line")


def _level(west: float, east: float, south: float, north: float, surface: str, height: float = 0.0) -> Mesh:
    return polygon(
        [(west, south, height), (east, south, height), (east, north, height), (west, north, height)], surface
    )
