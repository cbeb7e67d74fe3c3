"""Single elements against the lines they stand in: which see no light, and how much the others differ."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hyperpaint.base.arrays import Bools, Floats
from hyperpaint.kernels.line_fits import profiles

from .lab_sweep import LabSweep
from .line_fits import Window
from .steps import Lines, Read
from .wavelength_map import WavelengthMap

__all__ = ["Differences", "deviant_elements", "element_differences"]


_BRIGHT = 0.12  # of a line's height, from which a dead element would show
_DEVIANT = 0.5  # of the light of its line, by which such an element is off
_SIGNAL_EDGES = np.concatenate([[-np.inf], np.geomspace(2.0, 65536.0, 40), [np.inf]])
_FEWEST = 20  # samples of a bin
_MOVED = 0.01  # band, for a derivative


@dataclass(frozen=True)
class Differences:
    """How far elements lie from the smooth lines through them.

    Attributes
    ----------
    relative
        Standard deviation of the elements' own factors [1].
    slope
        Variance of a step's mean that follows the signal, where noise was not known [count].
    """

    relative: float
    slope: float


def _widths(lab: LabSweep, lines: Lines, surface: WavelengthMap) -> Floats:
    """Return the camera's own width at every step (step,) [nm]; without a good line, that of the nearest."""
    columns = np.arange(lab.shape[2])
    own = lines.own_width * surface.spacing(np.nan_to_num(lines.centre), columns)
    count = lines.trusted.sum(axis=1)
    known = np.flatnonzero(count >= max(0.5 * count.max(), 1))  # a few at the edge may all be wrong
    middle = np.nanmedian(np.where(lines.trusted, own, np.nan)[known], axis=1)
    return np.asarray(np.interp(lab.wavelength, lab.wavelength[known], middle))


def _unit_lines(
    lab: LabSweep, window: Window, step: int, surface: WavelengthMap, centre: Floats, width: float, shape: int
) -> Floats:
    """Return lines of unit area (line, sample) at given centres (line,) [band]."""
    spacing = surface.spacing(centre, window.columns)
    unit = np.empty(window.values.shape)
    profiles(
        window.places - centre[:, None], width / spacing, lab.width[step] / spacing, shape, lab.triangular,
        unit,
    )  # fmt: skip
    return unit


def deviant_elements(lab: LabSweep, read: Read, lines: Lines, surface: WavelengthMap, shape: int) -> Bools:
    """Return the elements (band, cross_track) whose light is not that of the line they stand in.

    Place and width of a line are those that all others tell, which one dead element cannot disturb; its
    height is the median over its bands. Of lines at the edge of the array a side is enough.
    """
    _, bands, columns = lab.shape
    suspect, seen = np.zeros((bands, columns), np.int64), np.zeros((bands, columns), np.int64)
    widths = _widths(lab, lines, surface)
    for step, window in enumerate(read.windows):
        if window is None:
            continue
        centre = surface.band_of(float(lab.wavelength[step]), window.columns)
        cut = (window.first < 0) | (window.first + window.values.shape[1] > bands)
        reach = widths[step] / float(np.median(surface.spacing(centre, window.columns))) + 2.0
        at_edge = cut.any() and abs(float(np.median(centre)) - window.band) < reach
        if not (lines.trusted[step].any() or at_edge):
            continue
        unit = _unit_lines(lab, window, step, surface, centre, float(widths[step]), shape)
        bright = np.isfinite(window.values) & (unit > _BRIGHT * unit.max(axis=1, keepdims=True))
        bright &= (~window.saturated & (bright.sum(axis=1) >= 3))[:, None]
        rows = bright.any(axis=1)
        if not rows.any():
            continue
        ratio = np.full(unit.shape, np.nan)
        np.divide(window.values, unit, out=ratio, where=bright)
        height = np.zeros((len(unit), 1))
        height[rows, 0] = np.nanmedian(ratio[rows], axis=1)
        noise = 8.0 * np.sqrt(read.noise.variance(height * unit, float(lab.frames[step])))
        apart = np.abs(np.where(bright, window.values, 0.0) - height * unit)
        bright &= noise < np.abs(height) * unit  # else noise would hide a dead one
        far = bright & (apart > np.maximum(noise, _DEVIANT * np.abs(height) * unit))
        place = window.places.astype(np.int64)
        column = np.broadcast_to(window.columns[:, None], place.shape)
        for mask, counter in ((far, suspect), (bright, seen)):
            np.add.at(counter, (place[mask], column[mask]), 1)
    return np.asarray((suspect > 0) & (2 * suspect > seen))


def element_differences(
    lab: LabSweep, read: Read, lines: Lines, surface: WavelengthMap, shape: int, *, known_noise: bool
) -> Differences:
    """Return how much elements differ from the lines that all others tell, beyond noise.

    A fit of four parameters hides most of it, since a line is a few bands wide. So place and width are those
    of the map, and each line has its height free, and a small move.

    Parameters
    ----------
    lab, read, lines, surface, shape
        Sweep, windows, good fits, map and line shape of the camera.
    known_noise
        Whether ``read.noise`` tells the noise of bright samples; otherwise that is found too.
    """
    widths = _widths(lab, lines, surface)
    tally = np.zeros((4, len(_SIGNAL_EDGES) - 1))
    shares = []
    for step, window in enumerate(read.windows):
        if window is None or not lines.trusted[step].any():
            continue
        inside = np.isfinite(window.values).all(axis=1) & lines.trusted[step, window.columns]
        if not inside.any():
            continue
        centre = surface.band_of(float(lab.wavelength[step]), window.columns)
        # the dial's error and the slope's pull are common to the columns
        centre = centre + np.median((lines.centre[step, window.columns] - centre)[inside])
        before, unit, after = (
            _unit_lines(lab, window, step, surface, centre + moved, float(widths[step]), shape)[inside]
            for moved in (-_MOVED, 0.0, _MOVED)
        )
        model, apart, loose = _of_free_height_and_place(window.values[inside], unit, after - before)
        excess = apart**2 - read.noise.variance(model, float(lab.frames[step])) * loose
        # beyond lies scattered light
        bright = model > _BRIGHT * model.max(axis=1, keepdims=True)
        shares.append(excess[bright].sum() / (model**2 * loose)[bright].sum())
        bins = np.searchsorted(_SIGNAL_EDGES, model[bright], side="right") - 1
        for row, weight in enumerate((np.ones_like(model), model * loose, model**2 * loose, excess)):
            tally[row] += np.bincount(bins, weight[bright], tally.shape[1])
    if not shares:
        return Differences(0.0, 0.0)
    if known_noise:
        return Differences(float(np.sqrt(max(float(np.median(shares)), 0.0))), 0.0)
    return _split(tally)


def _of_free_height_and_place(values: Floats, unit: Floats, slope: Floats) -> tuple[Floats, Floats, Floats]:
    """Return lines of fitted height, what a small move leaves of the rest, and each sample's freedom.

    Of independent scatter of variances d, sum(d x freedom) is expected to be left.
    """
    first = unit / np.sqrt((unit**2).sum(axis=1, keepdims=True))
    second = slope - (slope * first).sum(axis=1, keepdims=True) * first
    second /= np.sqrt(np.maximum((second**2).sum(axis=1, keepdims=True), 1e-300))
    model = np.maximum((values * first).sum(axis=1, keepdims=True), 1e-300) * first
    apart = values - model
    apart -= (apart * second).sum(axis=1, keepdims=True) * second
    return model, apart, 1.0 - first**2 - second**2


def _split(tally: Floats) -> Differences:
    """Return the parts of the scatter that grow as the signal and as its square, from sums over bins."""
    from scipy.optimize import nnls

    used = tally[0] >= _FEWEST
    if used.sum() < 2:
        return Differences(0.0, 0.0)
    signal, square, found = (row[used] / tally[0][used] for row in tally[1:])
    weight = np.sqrt(tally[0][used]) / np.maximum(np.abs(found), 1e-12)
    terms = np.column_stack([signal, square])
    slope, relative = nnls(terms * weight[:, None], found * weight)[0]
    return Differences(float(np.sqrt(relative)), float(slope))
