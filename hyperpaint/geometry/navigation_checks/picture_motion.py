"""How the picture moves from one row to the next, as the picture alone tells it.

A line camera that rolls shifts its rows sideways. That shift can be measured wherever the ground is rough.
How far two rows are apart along the track cannot be measured so, but the farther they are the less they are
alike; and how alike the ground is over a given way, the rows themselves tell, across the track.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from hyperpaint.base.arrays import Floats

__all__ = ["RowMotion", "row_motion"]


FEWEST_ZONES, MOST_ZONES, ZONE = 4, 12, 64
"""Parts of a row that are looked at each for itself, and their width where there are enough columns."""
REACH = 8
"""Largest shift between rows that is looked for [pixel]."""
_BLOCK = 512
"""Rows at a time."""
_FEWEST_COLUMNS = 12
"""Columns of a zone below which nothing is measured."""
_FLAT = 1e-12
_SLOW = 5
"""Columns over which a row is levelled before shifts are looked for."""


@dataclass(frozen=True)
class RowMotion:
    """What rows say of the motion from each to the next.

    Attributes
    ----------
    shift : (row - 1, zone)
        A row at x shows what the row before shows at x + shift [pixel]; NaN where it is not clear.
    unlikeness : (row - 1, zone)
        Mean square difference of the two rows after that shift, over the variance of either.
    structure : (`REACH` + 1,)
        The same of one row with itself, over whole pixels across the track.
    centres : (zone,)
        Column in the middle of every zone.
    """

    shift: Floats
    unlikeness: Floats
    structure: Floats
    centres: Floats


def row_motion(picture: npt.NDArray[Any]) -> RowMotion | None:
    """Return what a picture (row, column) says; None where it is too narrow.

    Notes
    -----
    The gains of columns are divided out: a pattern that stands still would say that nothing moves. The best
    whole shift is refined by Gauss and Newton's method, both rows being moved by half of it, so that both
    are smoothed alike.
    """
    rows, columns = picture.shape
    zones = int(np.clip(columns // ZONE, FEWEST_ZONES, MOST_ZONES))
    width = (columns - 2 * REACH) // zones
    if width < _FEWEST_COLUMNS or rows < 2:
        return None
    starts = REACH + width * np.arange(zones)
    levelled = _levelled(picture)
    fine = _fine(levelled)
    shift, unlike = np.full((rows - 1, zones), np.nan), np.full((rows - 1, zones), np.nan)
    structure, weight = np.zeros(REACH + 1), 0.0
    for first in range(0, rows - 1, _BLOCK):
        stop = min(first + _BLOCK, rows - 1)
        before, after = levelled[first:stop], levelled[first + 1 : stop + 1]
        for zone, start in enumerate(starts):
            window = slice(int(start), int(start) + width)
            variance = after[:, window].var(axis=1) + before[:, window].var(axis=1)
            known = variance > _FLAT
            if not known.any():
                continue
            moved = _shift(fine[first:stop][known], fine[first + 1 : stop + 1][known], window)
            left = _difference(before[known], after[known], moved, window)
            shift[first:stop, zone][known] = moved
            unlike[first:stop, zone][known] = left / variance[known]
            own = _own_structure(before[known], window) / variance[known, None]
            good = np.isfinite(own).all(axis=1)
            structure += own[good].sum(axis=0)
            weight += float(good.sum())
    if not weight:
        return None
    return RowMotion(shift, unlike, structure / weight, starts + (width - 1) / 2)


def _levelled(picture: npt.NDArray[Any]) -> Floats:
    """Return the logarithm without the gains of columns."""
    values = np.asarray(picture, np.float64)
    known = np.isfinite(values) & (values > 0.0)
    floor = np.quantile(values[known], 0.001) if known.any() else 1.0
    logs = np.log(np.where(known, np.maximum(values, floor), floor))
    logs -= np.median(logs, axis=0)
    return np.asarray(logs)


def _fine(rows: Floats) -> Floats:
    """Return rows without what changes slowly.

    A long edge aslant looks like a shift to any two rows; of what is small there is more, to every side.
    """
    from scipy.ndimage import uniform_filter1d

    level = rows - uniform_filter1d(rows, _SLOW, axis=1, mode="nearest")
    power = uniform_filter1d(level**2, 2 * _SLOW + 1, axis=1, mode="nearest")
    contrast = np.sqrt(np.maximum(power, 0.0)) + 0.1 * np.sqrt(power.mean()) + _FLAT
    return np.asarray(level / contrast)


def _difference(before: Floats, after: Floats, moved: Floats, window: slice) -> Floats:
    """Return the mean square difference of rows that are moved onto one another (row,)."""
    known = np.where(np.isnan(moved), 0.0, moved)
    apart = _moved(after, window, -known / 2) - _moved(before, window, known / 2)
    return np.where(np.isnan(moved), np.nan, (apart**2).mean(axis=1))


def _shift(before: Floats, after: Floats, window: slice) -> Floats:
    """Return the shift of every row (row,), NaN where it is not within `REACH`."""
    still = after[:, window]
    tries = range(-REACH, REACH + 1)
    costs = np.stack(
        [((still - before[:, window.start + k : window.stop + k]) ** 2).mean(axis=1) for k in tries]
    )
    best = costs.argmin(axis=0)
    inner = np.clip(best, 1, 2 * REACH - 1)
    row = np.arange(best.size)
    low, mid, high = costs[inner - 1, row], costs[inner, row], costs[inner + 1, row]
    bend = low + high - 2.0 * mid
    part = np.where(bend > 0.0, 0.5 * (low - high) / np.where(bend > 0.0, bend, 1.0), 0.0)
    moved = inner - REACH + np.clip(part, -1.0, 1.0)
    for _ in range(2):
        first, second = _moved(before, window, moved / 2), _moved(after, window, -moved / 2)
        slope = (np.gradient(first, axis=1) + np.gradient(second, axis=1)) / 2
        step = (slope * (second - first)).sum(axis=1) / np.maximum((slope**2).sum(axis=1), _FLAT)
        moved = moved + np.clip(step, -0.5, 0.5)
    edge = (best == 0) | (best == 2 * REACH) | (np.abs(moved) > REACH)
    return np.where(edge, np.nan, moved)


def _moved(rows: Floats, window: slice, by: Floats) -> Floats:
    """Return rows at columns + ``by``, by cubic convolution (Keys, 1981)."""
    whole = np.floor(by).astype(np.int64)
    t = (by - whole)[:, None]
    weights = (
        ((-0.5 * t + 1.0) * t - 0.5) * t,
        (1.5 * t - 2.5) * t * t + 1.0,
        ((-1.5 * t + 2.0) * t + 0.5) * t,
        (0.5 * t - 0.5) * t * t,
    )
    at = np.arange(window.start, window.stop)[None, :] + whole[:, None]
    last = rows.shape[1] - 1
    taps = (np.take_along_axis(rows, np.clip(at + k - 1, 0, last), axis=1) for k in range(4))
    return np.asarray(sum(w * tap for w, tap in zip(weights, taps, strict=True)))


def _own_structure(rows: Floats, window: slice) -> Floats:
    """Return mean square differences of rows with themselves, 0 to `REACH` columns apart (row, lag)."""
    made = np.zeros((rows.shape[0], REACH + 1))
    for lag in range(1, REACH + 1):
        other = rows[:, window.start + lag : window.stop + lag]
        made[:, lag] = ((other - rows[:, window]) ** 2).mean(axis=1)
    return made
