"""Compare lamp lines and elements with all others: lines in place, lines cut off, deviant elements.

Four parameters cannot be fitted to half a lamp line. For a line at the edge of the array the wavelength map
gives the place and the neighbours give the width; only the height is fitted, and the area follows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hyperpaint.base.arrays import Bools, Floats
from hyperpaint.kernels.line_fits import AREA, profiles

from .detector import row_medians
from .lab_sweep import LabSweep
from .line_fits import SHAPES, NoiseModel, Window
from .steps import SIGNAL_BINS, Lines, Read, binned
from .wavelength_map import WavelengthMap, fit_width

_BRIGHT = 0.12  # share of a line's height from which a dead element is visible
_DEVIANT = 0.5  # deviation of such an element, as a share of its line
MIN_BIN_SAMPLES = 20
_MOVED = 0.01  # band, for a derivative


@dataclass(frozen=True)
class Differences:
    """Deviations of elements from the smooth lamp lines."""

    relative: float  #: Standard deviation of the elements' own factors [1]
    slope: float  #: Variance of a step's mean that follows the signal, where noise was not known [count]


def _widths(lab: LabSweep, lines: Lines, surface: WavelengthMap) -> Floats:
    # Camera's own width at every step (step,) [nm]; interpolated without a good lamp line
    own = lines.own_width * surface.spacing(np.nan_to_num(lines.centre), np.arange(lab.shape[2]))
    count = lines.trusted.sum(axis=1)
    fitted_steps = np.flatnonzero(count >= max(0.5 * count.max(), 1))  # a few at the edge may all be wrong
    middle = row_medians(own, lines.trusted)[fitted_steps]
    return np.asarray(np.interp(lab.wavelength, lab.wavelength[fitted_steps], middle))


def _unit_lines(
    lab: LabSweep, window: Window, step: int, surface: WavelengthMap, centre: Floats, width: float, shape: int
) -> Floats:
    # Lamp lines of unit area (line, sample) at given centres (line,) [band]
    spacing = surface.spacing(centre, window.columns)
    unit = np.empty(window.values.shape)
    profiles(
        window.places - centre[:, None], width / spacing, lab.width[step] / spacing, shape, lab.triangular,
        unit,
    )  # fmt: skip
    return unit


def deviant_elements(lab: LabSweep, read: Read, lines: Lines, surface: WavelengthMap, shape: int) -> Bools:
    """Return the elements (band, cross_track) whose counts do not fit the lamp lines that cover them.

    Place and width of a lamp line follow from all others, which one dead element cannot disturb; its
    height is the median over its bands. One side suffices for lines at the edge of the array.
    """
    _, bands, columns = lab.shape
    suspect, tested = np.zeros((bands, columns), np.int64), np.zeros((bands, columns), np.int64)
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
        bright &= noise < np.abs(height) * unit  # else noise hides a dead element
        far = bright & (apart > np.maximum(noise, _DEVIANT * np.abs(height) * unit))
        place = window.places.astype(np.int64)
        column = np.broadcast_to(window.columns[:, None], place.shape)
        for mask, counter in ((far, suspect), (bright, tested)):
            np.add.at(counter, (place[mask], column[mask]), 1)
    return np.asarray((suspect > 0) & (2 * suspect > tested))


def element_differences(
    lab: LabSweep, read: Read, lines: Lines, surface: WavelengthMap, shape: int, *, known_noise: bool
) -> Differences:
    """Return the deviations of elements from smooth lamp lines, beyond noise.

    A fit of four parameters hides most of it, since a lamp line is a few bands wide. So place and width are
    taken from the map, and each line has its height free, and a small move. Without ``known_noise``,
    ``read.noise`` does not hold for bright samples, and their noise is determined too.
    """
    widths = _widths(lab, lines, surface)
    tally = np.zeros((4, SIGNAL_BINS))
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
        # outside bright samples is scattered light
        bright = model > _BRIGHT * model.max(axis=1, keepdims=True)
        shares.append(excess[bright].sum() / (model**2 * loose)[bright].sum())
        weights = (model * loose, model**2 * loose, excess)
        tally += binned(model[bright], *(weight[bright] for weight in weights))
    if not shares:
        return Differences(0.0, 0.0)
    if known_noise:
        return Differences(float(np.sqrt(max(float(np.median(shares)), 0.0))), 0.0)
    return _split(tally)


def _of_free_height_and_place(values: Floats, unit: Floats, slope: Floats) -> tuple[Floats, Floats, Floats]:
    # Lamp lines of fitted height, residuals without a small move, and each sample's freedom.
    # For independent scatter of variances d, the expected sum of squared residuals is sum(d x freedom).
    first = unit / np.sqrt((unit**2).sum(axis=1, keepdims=True))
    second = slope - (slope * first).sum(axis=1, keepdims=True) * first
    second /= np.sqrt(np.maximum((second**2).sum(axis=1, keepdims=True), 1e-300))
    model = np.maximum((values * first).sum(axis=1, keepdims=True), 1e-300) * first
    apart = values - model
    apart -= (apart * second).sum(axis=1, keepdims=True) * second
    return model, apart, 1.0 - first**2 - second**2


def _split(tally: Floats) -> Differences:
    from scipy.optimize import nnls

    used = tally[0] >= MIN_BIN_SAMPLES
    if used.sum() < 2:
        return Differences(0.0, 0.0)
    signal, square, excess = (row[used] / tally[0][used] for row in tally[1:])
    weight = np.sqrt(tally[0][used]) / np.maximum(np.abs(excess), 1e-12)
    slope, relative = nnls(np.column_stack([signal, square]) * weight[:, None], excess * weight)[0]
    return Differences(float(np.sqrt(relative)), float(slope))


#: Largest distance of a lamp line from the wavelength map [nm].
MAX_MISPLACEMENT_NM = 0.5
#: Largest chi2 relative to the step's median: beyond are several dead elements in one line.
MAX_RELATIVE_CHI2 = 20.0
#: Largest deviation of a width from the step's median [1].
MAX_WIDTH_DEVIATION = 0.3


def line_wavelengths(lines: Lines, surface: WavelengthMap, pull: Floats) -> Floats:
    """Return the wavelength of the lamp lines' centres in the map (step, cross_track) [nm], less the pull."""
    wavelength = surface.at(np.nan_to_num(lines.centre), np.arange(lines.centre.shape[1])) - pull[:, None]
    return np.asarray(np.where(np.isfinite(lines.centre), wavelength, np.nan))


def placed_lines(lab: LabSweep, lines: Lines, surface: WavelengthMap, pull: Floats) -> Bools:
    """Return the good fits (step, cross_track) that resemble the others and agree with the map."""
    apart = np.abs(line_wavelengths(lines, surface, pull) - lab.wavelength[:, None])
    misfit = np.where(lines.trusted, lines.chi2 / lines.degrees, np.nan)
    width = np.where(lines.trusted, lines.own_width, np.nan)
    median, median_width = np.maximum(row_medians(misfit), 1.0)[:, None], row_medians(width)[:, None]
    with np.errstate(invalid="ignore"):
        like_others = misfit < MAX_RELATIVE_CHI2 * median
        like_others &= np.abs(width / median_width - 1.0) < MAX_WIDTH_DEVIATION
        return np.asarray(like_others & (apart < max(MAX_MISPLACEMENT_NM, 6.0 * surface.residual)))


def band_widths(lab: LabSweep, lines: Lines, surface: WavelengthMap, placed: Bools) -> Floats:
    """Return the camera's own width of every band (band,) [nm] from those of the placed lamp lines."""
    steps = np.flatnonzero(placed.any(axis=1))
    spacing = surface.spacing(np.nan_to_num(lines.centre), np.arange(lab.shape[2]))
    widths = np.where(placed, lines.own_width * spacing, np.nan)[steps]
    spread = np.where(placed, lines.own_width_u * spacing, np.nan)[steps]
    return fit_width(
        lab.wavelength[steps],
        np.nanmedian(widths, axis=1),
        np.nanmedian(spread, axis=1) / np.sqrt(placed[steps].sum(axis=1)),
        surface.at(np.arange(lab.shape[1]), lab.shape[2] // 2),
    )


def at_steps(lab: LabSweep, surface: WavelengthMap, of_bands: Floats) -> Floats:
    """Return a property of the bands (band,) at the wavelengths of the steps (step,)."""
    centre = surface.at(np.arange(lab.shape[1]), lab.shape[2] // 2)
    order = np.argsort(centre)
    return np.interp(lab.wavelength, centre[order], of_bands[order])


#: Least visible share of a line's area at the edge [1].
MIN_VISIBLE_AREA = 0.3
_MAX_EDGE_RESIDUAL = 0.15  # share of a line's height; a larger residual belongs to another line
_OWN_WIDTH_U = 0.005  # relative uncertainty of the width at the edge, where no line shows it


def complete_edge_lines(
    lab: LabSweep, read: Read, lines: Lines, surface: WavelengthMap, light: Floats, fwhm: Floats, shape: str
) -> None:
    """Fit the heights of lamp lines that are cut off by the edge of the array, and mark them as completed.

    ``lines`` is changed. ``light`` (step,) are the wavelengths at which the camera sees the lines [nm],
    ``fwhm`` (step,) its own width there [nm], ``shape`` its line shape.
    """
    for step, window in enumerate(read.windows):
        if window is None:
            continue
        cut = (window.first < 0) | (window.first + window.values.shape[1] > lab.shape[1])
        cut &= ~lines.trusted[step, window.columns] & ~window.saturated
        if cut.any():
            centre = surface.band_of(float(light[step]), window.columns)
            _complete(
                lab, read.noise, lines, surface, step, window,
                cut=cut, centre=centre, fwhm=float(fwhm[step]), shape=shape,
            )  # fmt: skip


def _complete(
    lab: LabSweep, noise: NoiseModel, lines: Lines, surface: WavelengthMap, step: int, window: Window, *,
    cut: Bools, centre: Floats, fwhm: float, shape: str,
) -> None:  # fmt: skip
    spacing = surface.spacing(centre, window.columns)
    width, source = fwhm / spacing, lab.width[step] / spacing
    frames = float(lab.frames[step])

    def profile(moved: float, wider: float) -> Floats:
        out = np.empty(window.values.shape)
        distance = window.places - (centre + moved)[:, None]
        profiles(distance, width * wider, source, SHAPES[shape], lab.triangular, out)
        return out

    is_finite = np.isfinite(window.values)
    values = np.where(is_finite, window.values, 0.0)
    unit = np.where(is_finite, profile(0.0, 1.0), 0.0)
    variance = noise.variance(values, frames) + (1e-4 * values.max(axis=1, keepdims=True)) ** 2
    weight = np.where(is_finite, 1.0 / np.maximum(variance, 1e-300), 0.0)
    norm = np.maximum((weight * unit**2).sum(axis=1), 1e-300)

    def area_of(shape_of: Floats) -> Floats:
        shape_of = np.where(is_finite, shape_of, 0.0)
        height = (weight * shape_of * values).sum(axis=1)
        return np.asarray(height / np.maximum((weight * shape_of**2).sum(axis=1), 1e-300))

    fitted = area_of(unit)
    visible = unit.sum(axis=1)
    area = values.sum(axis=1) + (1.0 - visible) * fitted
    # uncertainty of the area by place, width and noise
    by_place, by_width = (
        (1.0 - visible) * (area_of(changed) - fitted) / 1e-3
        - (changed * is_finite - unit).sum(axis=1) * fitted / 1e-3
        for changed in (profile(1e-3, 1.0), profile(0.0, 1.0 + 1e-3))
    )
    by_noise = np.where(is_finite, noise.variance(values, frames), 0.0).sum(axis=1)
    by_noise = by_noise + (1.0 - visible) ** 2 / norm
    total = by_noise + (by_place * surface.residual / spacing) ** 2 + (by_width * _OWN_WIDTH_U) ** 2
    apart = np.abs(np.where(is_finite, values - fitted[:, None] * unit, 0.0))
    height = np.abs(fitted) * profile(0.0, 1.0).max(axis=1)
    # one free parameter: residuals beyond noise are dead elements, or a line elsewhere
    far = apart > np.maximum(8.0 * np.sqrt(variance), _MAX_EDGE_RESIDUAL * height[:, None])
    complete = cut & (visible >= MIN_VISIBLE_AREA) & (fitted > 0) & np.isfinite(total) & ~far.any(axis=1)
    at = (step, window.columns[complete])
    lines.area[at] = area[complete]
    lines.area_u[at] = np.sqrt(total[complete]) / area[complete]
    lines.centre[at] = centre[complete]
    lines.completed[at] = True
    lines.covariance[(*at, AREA, AREA)] = total[complete]
