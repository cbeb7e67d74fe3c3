"""The beam's profile along the slit, which passes for response where the flux of a column is not told."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import chebyshev

from hyperpaint.base.arrays import Floats

__all__ = ["beam_problem"]


_DEGREE = 4  # of a beam's log profile over the columns
_SURE = 4.5  # standard deviations of noise and of the elements' differences
_CHANGING = 1.0 / 3.0  # of the tolerance, by which a profile may change from step to step


@dataclass(frozen=True, eq=False)
class _Profiles:
    """Smooth log profiles of the lines' areas over the columns.

    Attributes
    ----------
    level, spread : (step, cross_track)
        The profile about its median, and its standard deviation; NaN where a line is not trusted.
    """

    level: Floats
    spread: Floats


def beam_problem(wavelength: Floats, areas: Floats, tolerance: float) -> str | None:
    """Return what betrays a beam that does not light all columns alike, or None.

    Parameters
    ----------
    wavelength : (step,)
        [nm]
    areas : (step, cross_track)
        Of the fitted lines [count], which a dead element does not dim; NaN where there is none.
    tolerance
        Relative fall over the columns that is let pass.
    """
    count = np.isfinite(areas).sum(axis=1)
    steps = np.flatnonzero(count >= max(4.0, 0.5 * count.max()))
    if steps.size < 4:
        return None
    found = _profiles(areas[steps])
    fall = np.nanmax(found.level, axis=1) - np.nanmin(found.level, axis=1)
    sure = fall - _SURE * np.sqrt(2.0) * np.nanmax(found.spread, axis=1)
    mean = np.nanmean(found.level, axis=0)
    mean_spread = np.nanmax(found.spread / np.sqrt(np.isfinite(found.level).sum(axis=0)))
    if np.ptp(mean) - _SURE * np.sqrt(2.0) * mean_spread > tolerance or sure.max() > tolerance:
        worst = int(np.argmax(sure))
        at = wavelength[steps[worst]]
        return f"lines fall by {1.0 - np.exp(-fall[worst]):.1%} over the columns (at {at:g} nm)"
    changes = np.nanmean((found.level - mean) ** 2, axis=0)
    noise = np.nanmean(found.spread**2, axis=0)
    column = int(np.argmax(changes - noise))
    excess = float(np.sqrt(max(changes[column] - 2.0 * noise[column], 0.0)))
    if excess > _CHANGING * tolerance:
        share = float(np.sqrt(changes[column]))
        where = int(np.flatnonzero(np.isfinite(areas[steps]).any(axis=0))[column])
        return f"the share of light of column {where} varies by {share:.1%} from step to step"
    return None


def _profiles(areas: Floats) -> _Profiles:
    lit = np.flatnonzero(np.isfinite(areas).any(axis=0))
    level = np.full((len(areas), lit.size), np.nan)
    spread = level.copy()
    place = np.linspace(-1.0, 1.0, lit.size)
    for row, area in enumerate(areas[:, lit]):
        known = np.isfinite(area) & (area > 0)
        degree = min(_DEGREE, int(known.sum()) // 4)
        terms = np.asarray(chebyshev.chebvander(place[known], degree), np.float64)
        log = np.log(area[known])
        inverse = np.linalg.pinv(terms)
        fitted = terms @ (inverse @ log)
        free = max(int(known.sum()) - degree - 1, 1)
        rms = float(np.sqrt(((log - fitted) ** 2).sum() / free))
        level[row, known] = fitted - np.median(fitted)
        spread[row, known] = rms * np.sqrt(np.einsum("ij,ji->i", terms, inverse))
    return _Profiles(level, spread)
