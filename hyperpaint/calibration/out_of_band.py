"""Light where it does not belong: scattered into wings over all bands, and the second order of the grating.

The bands of a sweep outside of its lines are the stray-light matrix, one column a step. Between steps it is
filled by what hardly changes from step to step: the wings as a function of the distance from the line, the
second order as a share of the line at twice its wavelength.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from hyperpaint.base.arrays import Bools, Floats
from hyperpaint.base.constants import MAX_STRAY_LIGHT_U

from .line_fits import Window

#: Least bands outside a lamp line from which scattered light is known.
MIN_BANDS_OUTSIDE = 4
#: Bins of distance beside a lamp line from which its wing is extrapolated, exponentially, by e at most.
_NEAREST_BINS = 3
#: Relative standard uncertainty of the wing inside a line's window, extrapolated from outside [1].
_WING_U = 0.25


class OffLines(NamedTuple):
    """Light off the lamp lines of a sweep."""

    second_order: Floats  #: (step,): counts at twice the wavelength over those of the line [1]
    stray_light: Floats  #: (band, source band): share of each band's counts that every other sees [1]
    relative: float  #: Relative standard uncertainty of that [1]
    wing: float  #: Share of the lines' areas that is light scattered into their windows [1]

    @property
    def is_known(self) -> bool:
        """Whether stray light is known well enough to be subtracted from a flight."""
        return self.relative < MAX_STRAY_LIGHT_U

    @property
    def counted(self) -> float:
        """Measured areas of the lamp lines over their areas without scattered light [1]."""
        return 1.0 / (1.0 - self.wing) if self.is_known else 1.0

    @property
    def counted_u(self) -> float:
        """Relative standard uncertainty of the areas by scattered light [1]."""
        return self.wing * (_WING_U if self.is_known else 1.0)


def light_off_lines(
    rows: Floats, centre: Floats, step_wavelength: Floats, wavelength: Floats, width: Floats,
    dark_check: dict[str, float],
) -> OffLines:  # fmt: skip
    """Return the light off the lamp lines; arguments as of `stray_light_matrix` and `dark_off_lines`."""
    second = second_order_share(rows, step_wavelength, wavelength, width)
    matrix = stray_light_matrix(rows, centre, step_wavelength, wavelength, width, second)
    offset = abs(dark_check.get("dark_offset_count", 0.0)) * dark_check.get("out_of_band_of_one_count", 0.0)
    relative = wing_uncertainty(rows, matrix, centre, offset)
    return OffLines(second, matrix, relative, wing_in_window(rows, matrix, centre))


def dark_off_lines(
    windows: Sequence[Window | None], area: Floats, placed: Bools, rows: Floats
) -> dict[str, float]:
    """Return the offset of the dark, and the effect of one count of it on the light off the lamp lines.

    ``windows`` (step,); ``area`` of the lines [count] and whether they are in place (step, column); ``rows``
    (step, band) as of `second_order_share`. Empty where no step has a background.
    """
    level, areas, bands = np.full(len(rows), np.nan), np.full(len(rows), np.nan), np.zeros(len(rows))
    for step, window in enumerate(windows):
        if window is not None and placed[step].any() and (window.background_variance > 0).any():
            level[step] = np.median(window.background[window.background_variance > 0])
            areas[step] = np.median(area[step, placed[step]])
            bands[step] = np.count_nonzero(rows[step])
    has_level = np.isfinite(level)
    if not has_level.any():
        return {}
    checks = {"out_of_band_of_one_count": float(np.median(bands[has_level] / areas[has_level]))}
    offset = common_offset(level, areas)
    return checks | ({"dark_offset_count": offset} if np.isfinite(offset) else {})


def second_order_share(rows: Floats, step_wavelength: Floats, wavelength: Floats, width: Floats) -> Floats:
    """Return counts at twice the wavelength over counts of the lamp line (step,) [1].

    ``rows`` (step, band) are counts outside the lines relative to the lines' areas, 0 inside their windows;
    ``step_wavelength`` (step,) and ``wavelength`` (band,) [nm]; ``width`` (step,) is the measured full width
    at half maximum of the line [nm]. The second order is up to twice as wide.
    """
    share = np.full(len(rows), np.nan)
    for step, (centre, fwhm) in enumerate(zip(2.0 * step_wavelength, width, strict=True)):
        distance = np.abs(wavelength - centre)
        near, ring = distance <= 2.0 * fwhm, (distance > 3.0 * fwhm) & (distance <= 6.0 * fwhm)
        inside = wavelength.min() + 2.0 * fwhm <= centre <= wavelength.max() - 2.0 * fwhm
        if inside and ring.sum() >= 4 and (rows[step][near] != 0).all():
            share[step] = (rows[step][near] - np.median(rows[step][ring])).sum()
    return share


def common_offset(level: Floats, area: Floats) -> float:
    """Return the offset of the dark: counts off the lamp lines that do not follow their light [count].

    ``level`` and ``area`` (step,) are the counts of a band off the line and the area of the line, medians of
    the lit columns [count].
    """
    usable = np.isfinite(level) & np.isfinite(area) & (area > 0)
    if usable.sum() < 4 or np.ptp(area[usable]) < 0.2 * area[usable].max():
        return float("nan")
    terms = np.column_stack([np.ones(int(usable.sum())), area[usable]])
    return float(np.linalg.lstsq(terms, level[usable], rcond=None)[0][0])


def wing_in_window(rows: Floats, matrix: Floats, centre: Floats) -> float:
    """Return the share of a line's area that is light scattered into its window, beyond the background [1].

    ``rows`` and ``centre`` as in `stray_light_matrix`, of which ``matrix`` (band, source band) is the result.
    """
    shares = []
    for row, source in zip(rows, _bands_of(centre, len(matrix)), strict=True):
        outside = row != 0
        if outside.sum() >= MIN_BANDS_OUTSIDE:
            # the background that is subtracted from a line: the clipped mean of the bands outside
            middle = np.median(row[outside])
            spread = 1.4826 * np.median(np.abs(row[outside] - middle))
            background = row[outside & (np.abs(row - middle) <= 4.0 * spread)].mean()
            shares.append((matrix[~outside, source] - background).sum())
    return max(float(np.median(shares)), 0.0) if shares else 0.0


def _bands_of(centre: Floats, bands: int) -> npt.NDArray[np.int64]:
    return np.clip(np.round(centre), 0, bands - 1).astype(np.int64)


def stray_light_matrix(
    rows: Floats, centre: Floats, step_wavelength: Floats, wavelength: Floats, width: Floats, second: Floats
) -> Floats:
    """Return the share of each band's light that every other band receives (band, source_band) [1].

    ``rows``, ``step_wavelength``, ``wavelength`` and ``width`` as in `second_order_share`, of which
    ``second`` (step,) is the result; ``centre`` (step,) are the bands of the lamp lines.
    """
    bands = rows.shape[1]
    distance = np.arange(bands) - centre[:, None]
    usable = (rows != 0) & (np.abs(wavelength - 2.0 * step_wavelength[:, None]) > 3.0 * width[:, None])
    wing = _line_spread(distance[usable], rows[usable], bands)
    place = np.arange(bands)
    matrix = wing(place[:, None] - place)
    has_second = np.isfinite(second)
    if has_second.any():
        matrix += _second_order(
            step_wavelength[has_second], second[has_second], wavelength, float(np.median(width))
        )
    return np.asarray(matrix)


def _line_spread(distance: Floats, share: Floats, bands: int) -> Any:
    # Wings as a function of the distance in bands: medians of bins that widen with distance
    edges = np.unique(np.round(np.geomspace(1.0, bands, 25)))
    edges = np.concatenate([-edges[::-1], edges])
    bins = np.digitize(distance, edges)
    centres, levels = [], []
    for index in range(1, len(edges)):
        inside = bins == index
        if inside.sum() >= 8:
            centres.append(float(distance[inside].mean()))
            levels.append(float(np.median(share[inside])))
    if not centres:
        return lambda at: np.zeros(np.shape(at))

    near = float(np.abs(distance).min())
    sides = [_side(np.array(centres) * sign, np.array(levels)) for sign in (-1.0, 1.0)]

    def wing(at: npt.NDArray[Any]) -> Floats:
        # within the window of a line scattered light is hidden: extrapolate its rise from outside
        level = np.interp(at, centres, levels)
        for sign, (first, rise) in zip((-1.0, 1.0), sides, strict=True):
            within = np.maximum(near - sign * at, 0.0) * (sign * at >= 0) * rise
            level = np.where((np.abs(at) < near) & (sign * at >= 0), first * np.exp(within), level)
        return np.asarray(np.maximum(level, 0.0))

    return wing


def _side(distance: Floats, levels: Floats) -> tuple[float, float]:
    # Wing nearest to its lamp line on one side, and its rise towards the line [band-1]
    order = np.argsort(np.where(distance > 0, distance, np.inf))[:_NEAREST_BINS]
    at, level = distance[order], levels[order]
    if not ((at > 0) & (level > 0)).all() or level.size < _NEAREST_BINS:
        return float(max(level[0], 0.0)), 0.0
    rise = -float(np.polyfit(at, np.log(level), 1)[0])
    return float(level[0]), float(np.clip(rise, 0.0, 1.0 / at[0]))


def wing_uncertainty(rows: Floats, matrix: Floats, centre: Floats, offset: float) -> float:
    """Return the relative standard uncertainty of the light off the lamp lines in a matrix [1].

    From the difference of its sums to those of single steps, and from the ``offset`` of the dark that is in
    them, relative to a line's area. ``rows`` and ``centre`` as in `stray_light_matrix`, of which ``matrix``
    (band, source band) is the result. 1 without any.
    """
    source = _bands_of(centre, len(matrix))
    modelled = np.where(rows != 0, matrix[:, source].T, 0.0).sum(axis=1)
    scatter = 1.4826 * float(np.median(np.abs(rows.sum(axis=1) - modelled)))
    level = float(np.median(modelled))
    return min(float(np.hypot(scatter, offset)) / level, 1.0) if level > 0 else 1.0


def _second_order(step_wavelength: Floats, share: Floats, wavelength: Floats, width: float) -> Floats:
    inside = (2.0 * wavelength >= wavelength.min()) & (2.0 * wavelength <= wavelength.max())
    level = np.interp(wavelength, step_wavelength, np.maximum(share, 0.0), left=share[0], right=share[-1])
    level = np.where(inside, np.maximum(level, 0.0), 0.0)
    shape = np.exp(-4.0 * np.log(2.0) * ((wavelength[:, None] - 2.0 * wavelength) / (1.5 * width)) ** 2)
    return np.asarray(level * shape / np.maximum(shape.sum(axis=0), 1.0))
