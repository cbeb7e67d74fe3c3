"""The one look at all lines that comes before a map: how large it is, and which lines each tile needs.

Nothing of the places is kept but a few numbers a line, so that the memory this takes is that of a few slabs
however long the flight.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from hyperpaint.base.arrays import Floats, Progress
from hyperpaint.base.errors import SchemaError

from .grids import Axes, Box, flight_axes

if TYPE_CHECKING:
    import dask.array as da

__all__ = ["Progress", "Survey", "direction_of_flight", "survey_lines"]


_SAMPLED_LINES = 64
"""Lines that the direction of flight is found from."""
_SAMPLED_COLUMNS = 64
"""Columns of a line, at the least, that its spacing is the median of."""
_COLUMNS = 10
"""Of a line: its box (4), its ends (4), its median spacing across and along (2)."""


@dataclass(frozen=True)
class Survey:
    """What is known of every line.

    Attributes
    ----------
    boxes : (line, 4), float64
        Least and largest way to the right and down along the axes [m]; NaN of a line without any place.
    ends : (line, 2, 2), float64
        East and north of its first and last pixel that has a place [m].
    across, along
        Median over lines of the median distance of neighbouring columns, and to the next line [m].
    """

    boxes: Floats
    ends: Floats
    across: float
    along: float

    @property
    def gsd(self) -> float:
        """The larger of the two spacings [m]."""
        return float(np.nanmax([self.across, self.along]))

    @property
    def box(self) -> Box:
        """The box of all lines."""
        low, high = np.nanmin(self.boxes, axis=0), np.nanmax(self.boxes, axis=0)
        return float(low[0]), float(high[1]), float(low[2]), float(high[3])


def direction_of_flight(east: da.Array, north: da.Array) -> Axes:
    """Return axes along the flight, from some lines spread evenly over it.

    Raises
    ------
    SchemaError
        No line has a place.
    """
    count = east.shape[0]
    sampled = np.unique(np.linspace(0, count - 1, _SAMPLED_LINES).astype(int))
    for lines in (sampled, np.arange(count)):  # all, where those have no pose
        ends = _ends_of(east, north, lines)
        if len(ends):
            break
    if not len(ends):
        raise SchemaError(_NOTHING)
    return flight_axes(ends[:, 0], ends[:, 1])


def survey_lines(east: da.Array, north: da.Array, axes: Axes, progress: Progress | None) -> Survey:
    """Return what is known of every line (eager).

    Raises
    ------
    SchemaError
        No pixel has a place.
    """
    found = _computed(east, north, list(range(east.numblocks[0])), axes, progress)
    table = np.concatenate([rows for rows, _ in found])
    starts = np.cumsum([len(rows) for rows, _ in found])
    for (_, (_, before)), (_, (after, _)), start in zip(found, found[1:], starts, strict=False):
        table[start - 1, 9] = _median(np.hypot(*(after - before)))
    if np.isnan(table[:, :4]).all() or np.isnan(table[:, 8:]).all():
        raise SchemaError(_NOTHING)
    across, along = (_median(table[:, column]) for column in (8, 9))
    return Survey(table[:, :4], table[:, 4:8].reshape(-1, 2, 2), across, along)


def _ends_of(east: da.Array, north: da.Array, lines: npt.NDArray[Any]) -> Floats:
    """Return the ends of lines that have a place (line, 2, 2)."""
    edges = np.cumsum((0, *east.chunks[0]))
    slabs = np.searchsorted(edges, lines, side="right") - 1
    touched = np.unique(slabs)
    found = _computed(east, north, touched.tolist(), Axes((1.0, 0.0), (0.0, 0.0)), None)
    rows = [
        table[lines[slabs == slab] - edges[slab], 4:8]
        for slab, (table, _) in zip(touched, found, strict=True)
    ]
    ends = np.concatenate(rows).reshape(-1, 2, 2)
    return np.asarray(ends[np.isfinite(ends).all(axis=(1, 2))])


_NOTHING = (
    "no two neighbouring pixels are placed on the ground, and so there is nothing to map; look at the poses "
    "and at the quality's off_swath"
)


def _computed(
    east: da.Array, north: da.Array, slabs: list[int], axes: Axes, progress: Progress | None
) -> list[Any]:
    """Return what is found in slabs, with the progress told where it can be."""
    import dask
    from dask.callbacks import Callback

    blocks = [array.to_delayed(optimize_graph=False).ravel() for array in (east, north)]
    look = dask.delayed(_looked_at, pure=False)
    tasks = [look(blocks[0][slab], blocks[1][slab], axes) for slab in slabs]
    if progress is None:
        return list(dask.compute(*tasks))
    waiting = {task.key for task in tasks}

    def told(key: Any, *_: Any) -> None:
        if key in waiting:
            waiting.discard(key)
            progress(len(tasks) - len(waiting), len(tasks))

    # schedulers of a cluster do not call it: they tell of the end alone
    with Callback(posttask=told):
        made = list(dask.compute(*tasks))
    if waiting:
        progress(len(tasks), len(tasks))
    return made


def _looked_at(east: Floats, north: Floats, axes: Axes) -> tuple[Floats, tuple[Floats, Floats]]:
    """Return the rows of the lines of a slab (line, `_COLUMNS`), and where some pixels of its ends lie."""
    out = np.full((len(east), _COLUMNS), np.nan)
    step = max(1, east.shape[1] // _SAMPLED_COLUMNS)
    some = np.stack([east[:, ::step], north[:, ::step]])
    ends = some[:, 0].copy(), some[:, -1].copy()
    known = np.isfinite(east) & np.isfinite(north)
    lines = np.flatnonzero(known.any(axis=1))
    if not lines.size:
        return out, ends
    x, y = axes.along(east[lines], north[lines])
    for column, (way, reduce, empty) in enumerate(
        ((x, np.min, np.inf), (x, np.max, -np.inf), (y, np.min, np.inf), (y, np.max, -np.inf))
    ):
        out[lines, column] = reduce(way if known.all() else np.where(known[lines], way, empty), axis=1)
    first = known[lines].argmax(axis=1)
    last = known.shape[1] - 1 - known[lines, ::-1].argmax(axis=1)
    for column, at in ((4, first), (6, last)):
        out[lines, column], out[lines, column + 1] = east[lines, at], north[lines, at]
    across = [part[:, 1::step] - part[:, :-1:step] for part in (east, north)]
    out[:, 8] = _medians(np.hypot(*across))
    out[:-1, 9] = _medians(np.hypot(*np.diff(some, axis=1)))
    return out, ends


def _medians(steps: Floats) -> Floats:
    """Return the median of every row, without what is NaN; NaN where all of it is."""
    if not steps.shape[1] or not np.isnan(steps).any():
        return np.median(steps, axis=1) if steps.size else np.full(len(steps), np.nan)
    return np.array([_median(row) for row in steps])


def _median(values: Floats) -> float:
    found = values[np.isfinite(values)]
    return float(np.median(found)) if found.size else np.nan
