"""Lamp lines that agree with the wavelength map, lamp lines cut off at the edges, and deviant elements.

Four parameters cannot be fitted to half a lamp line. For a lamp line at the edge of the array the wavelength
map gives the centre and the neighbours give the width; only the height is fitted, and the area follows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np

from hyperpaint.base import (
    QUANTISATION_VARIANCE_COUNT2,
    SATURATION_MARGIN_COUNTS,
    STEP,
    Bools,
    Floats,
    warn_user,
)
from hyperpaint.kernels.arguments import LineSamples
from hyperpaint.kernels.line_fits import AREA, CENTRE, WIDTH, profiles
from hyperpaint.radiometry.stray_light import Linearity, smear_of

from .detector import LabSweep, listed, refused, row_medians
from .line_fits import (
    SHAPES,
    Fits,
    Light,
    NoiseModel,
    WavelengthMap,
    Window,
    find_line,
    fit_width,
    fit_window,
    fitted,
)

_MIN_BRIGHT_SHARE = 0.12  # share of a lamp line's height above which a dead element is visible
_MIN_DEVIATION_SHARE = 0.5  # deviation of a dead element, as a share of its lamp line
MIN_BIN_SAMPLES = 20
_CENTRE_STEP_BANDS = 0.01  # [band], step of a derivative


def _camera_widths(lab: LabSweep, lamp_lines: LampLines, wavelength_map: WavelengthMap) -> Floats:
    # Return the width of the camera at every step (step,) [nm]; interpolated over steps without valid lamp
    # lines.
    widths = lamp_lines.camera_width * wavelength_map.spacing(
        np.nan_to_num(lamp_lines.centre), np.arange(lab.shape[2])
    )
    count = lamp_lines.trusted.sum(axis=1)
    fitted_steps = np.flatnonzero(
        count >= max(0.5 * count.max(), 1)
    )  # a few lamp lines at the edge may all be wrong
    return np.asarray(
        np.interp(
            lab.wavelength,
            lab.wavelength[fitted_steps],
            row_medians(widths, lamp_lines.trusted)[fitted_steps],
        )
    )


def _unit_lines(
    lab: LabSweep,
    window: Window,
    step: int,
    wavelength_map: WavelengthMap,
    centre: Floats,
    width: float,
    shape: int,
) -> Floats:
    # Return lamp lines of unit area (line, sample) at centres (line,) [band].
    spacing = wavelength_map.spacing(centre, window.columns)
    unit = np.empty(window.values.shape)
    profiles(
        window.places - centre[:, None], width / spacing, lab.width[step] / spacing, shape, lab.triangular,
        unit,
    )  # fmt: skip
    return unit


def deviant_elements(
    lab: LabSweep, sweep_data: SweepData, lamp_lines: LampLines, wavelength_map: WavelengthMap, shape: int
) -> Bools:
    # Return the elements (band, cross_track) whose counts do not fit the lamp lines that cover them.
    #
    # Centre and width of a lamp line follow from all other lamp lines, which one dead element does not
    # affect; its height is the median over its bands. One side suffices for lamp lines at the edge of the
    # array.
    _, bands, columns = lab.shape
    suspect, tested = np.zeros((bands, columns), np.int64), np.zeros((bands, columns), np.int64)
    widths = _camera_widths(lab, lamp_lines, wavelength_map)
    centres = wavelength_map.band_of(lab.wavelength[:, None], np.arange(columns))
    for step, window in enumerate(sweep_data.windows):
        if window is None:
            continue
        centre = centres[step, window.columns]
        is_cut = (window.first < 0) | (window.first + window.values.shape[1] > bands)
        reach = widths[step] / float(np.median(wavelength_map.spacing(centre, window.columns))) + 2.0
        is_at_edge = is_cut.any() and abs(float(np.median(centre)) - window.band) < reach
        if not (lamp_lines.trusted[step].any() or is_at_edge):
            continue
        unit = _unit_lines(lab, window, step, wavelength_map, centre, float(widths[step]), shape)
        is_bright = np.isfinite(window.values) & (unit > _MIN_BRIGHT_SHARE * unit.max(axis=1, keepdims=True))
        is_bright &= (~window.saturated & (is_bright.sum(axis=1) >= 3))[:, None]
        rows = is_bright.any(axis=1)
        if not rows.any():
            continue
        ratio = np.full(unit.shape, np.nan)
        np.divide(window.values, unit, out=ratio, where=is_bright)
        height = np.zeros((len(unit), 1))
        height[rows, 0] = np.nanmedian(ratio[rows], axis=1)
        noise = 8.0 * np.sqrt(sweep_data.noise.variance(height * unit, float(lab.frames[step])))
        deviation = np.abs(np.where(is_bright, window.values, 0.0) - height * unit)
        is_bright &= noise < np.abs(height) * unit  # elsewhere noise hides a dead element
        is_deviant = is_bright & (deviation > np.maximum(noise, _MIN_DEVIATION_SHARE * np.abs(height) * unit))
        band = window.places.astype(np.int64)
        column = np.broadcast_to(window.columns[:, None], band.shape)
        for mask, counter in ((is_deviant, suspect), (is_bright, tested)):
            np.add.at(counter, (band[mask], column[mask]), 1)
    return np.asarray((suspect > 0) & (2 * suspect > tested))


def element_differences(
    lab: LabSweep,
    sweep_data: SweepData,
    lamp_lines: LampLines,
    wavelength_map: WavelengthMap,
    shape: int,
    *,
    has_noise: bool,
) -> tuple[float, float]:
    # Return the standard deviation of the factors of elements [1], beyond noise, and a slope of noise.
    #
    # The slope is that of the variance of a step's mean over the signal [count], 0 with ``has_noise``.
    # A fit of four parameters hides most of them, since a lamp line is a few bands wide. So centre and width
    # are taken from the map, and only height and a small shift are fitted. Without ``has_noise``,
    # ``sweep_data.noise`` is not valid for bright samples, and their noise is determined too.
    from scipy.optimize import nnls

    widths = _camera_widths(lab, lamp_lines, wavelength_map)
    centres = wavelength_map.band_of(lab.wavelength[:, None], np.arange(lab.shape[2]))
    tally, shares = np.zeros((4, SIGNAL_BINS)), []
    for step, window in enumerate(sweep_data.windows):
        if window is None or not lamp_lines.trusted[step].any():
            continue
        is_usable = np.isfinite(window.values).all(axis=1) & lamp_lines.trusted[step, window.columns]
        if not is_usable.any():
            continue
        # error of the dial and slope shift are common to the columns
        centre = centres[step, window.columns]
        centre = centre + np.median((lamp_lines.centre[step, window.columns] - centre)[is_usable])
        unit_before, unit, unit_after = (
            _unit_lines(lab, window, step, wavelength_map, centre + centre_shift, float(widths[step]), shape)[
                is_usable
            ]
            for centre_shift in (-_CENTRE_STEP_BANDS, 0.0, _CENTRE_STEP_BANDS)
        )
        values = window.values[is_usable]
        slope = unit_after - unit_before
        # Lamp lines of fitted height, residuals after a small shift, and the freedom of each sample.
        # For independent scatter of variances d, the expected sum of squared residuals is sum(d x freedom).
        first = unit / np.sqrt((unit**2).sum(axis=1, keepdims=True))
        second = slope - (slope * first).sum(axis=1, keepdims=True) * first
        second /= np.sqrt(np.maximum((second**2).sum(axis=1, keepdims=True), 1e-300))
        model = np.maximum((values * first).sum(axis=1, keepdims=True), 1e-300) * first
        residual = values - model
        residual -= (residual * second).sum(axis=1, keepdims=True) * second
        freedom = 1.0 - first**2 - second**2
        excess = residual**2 - sweep_data.noise.variance(model, float(lab.frames[step])) * freedom
        # samples that are not bright contain scattered light
        is_bright = model > _MIN_BRIGHT_SHARE * model.max(axis=1, keepdims=True)
        shares.append(excess[is_bright].sum() / (model**2 * freedom)[is_bright].sum())
        tally += binned(
            model[is_bright], *(weight[is_bright] for weight in (model * freedom, model**2 * freedom, excess))
        )
    is_used = tally[0] >= MIN_BIN_SAMPLES
    if has_noise:
        return float(np.sqrt(max(float(np.median(shares)), 0.0))) if shares else 0.0, 0.0
    if is_used.sum() < 2:
        return 0.0, 0.0
    # excess variance = slope x signal + (relative x signal)^2
    signal, square, excess = (row[is_used] / tally[0][is_used] for row in tally[1:])
    weight = np.sqrt(tally[0][is_used]) / np.maximum(np.abs(excess), 1e-12)
    slope, relative = nnls(np.column_stack([signal, square]) * weight[:, None], excess * weight)[0]
    return float(np.sqrt(relative)), float(slope)


#: Largest distance of a lamp line from the wavelength map [nm].
MAX_MISPLACEMENT_NM = 0.5
#: Largest chi2 relative to the step's median; above, a lamp line contains several dead elements.
MAX_RELATIVE_CHI2 = 20.0
#: Largest deviation of a width from the step's median [1].
MAX_WIDTH_DEVIATION = 0.3


def line_wavelengths(lamp_lines: LampLines, wavelength_map: WavelengthMap, slope_shift: Floats) -> Floats:
    # Return mapped wavelengths of lamp line centres (step, cross_track) [nm], less the slope shift.
    wavelength = (
        wavelength_map.at(np.nan_to_num(lamp_lines.centre), np.arange(lamp_lines.centre.shape[1]))
        - slope_shift[:, None]
    )
    return np.asarray(np.where(np.isfinite(lamp_lines.centre), wavelength, np.nan))


def placed_lines(
    lab: LabSweep, lamp_lines: LampLines, wavelength_map: WavelengthMap, slope_shift: Floats
) -> Bools:
    # Return the valid fits (step, cross_track) with typical width and chi2 that agree with the map.
    distance = np.abs(line_wavelengths(lamp_lines, wavelength_map, slope_shift) - lab.wavelength[:, None])
    misfit = np.where(lamp_lines.trusted, lamp_lines.chi2 / lamp_lines.degrees, np.nan)
    width = np.where(lamp_lines.trusted, lamp_lines.camera_width, np.nan)
    median, median_width = np.maximum(row_medians(misfit), 1.0)[:, None], row_medians(width)[:, None]
    with np.errstate(invalid="ignore"):
        is_typical = misfit < MAX_RELATIVE_CHI2 * median
        is_typical &= np.abs(width / median_width - 1.0) < MAX_WIDTH_DEVIATION
        return np.asarray(is_typical & (distance < max(MAX_MISPLACEMENT_NM, 6.0 * wavelength_map.residual)))


def band_widths(
    lab: LabSweep, lamp_lines: LampLines, wavelength_map: WavelengthMap, is_placed: Bools
) -> Floats:
    # Return the camera's width of every band (band,) [nm] from the placed lamp lines.
    steps = np.flatnonzero(is_placed.any(axis=1))
    spacing = wavelength_map.spacing(np.nan_to_num(lamp_lines.centre), np.arange(lab.shape[2]))
    widths = np.where(is_placed, lamp_lines.camera_width * spacing, np.nan)[steps]
    uncertainties = np.where(is_placed, lamp_lines.camera_width_u * spacing, np.nan)[steps]
    return fit_width(
        lab.wavelength[steps],
        np.nanmedian(widths, axis=1),
        np.nanmedian(uncertainties, axis=1) / np.sqrt(is_placed[steps].sum(axis=1)),
        wavelength_map.at(np.arange(lab.shape[1]), lab.shape[2] // 2),
    )


def at_steps(lab: LabSweep, wavelength_map: WavelengthMap, values: Floats) -> Floats:
    # Return a property of the bands (band,) at the wavelengths of the steps (step,).
    centre = wavelength_map.at(np.arange(lab.shape[1]), lab.shape[2] // 2)
    order = np.argsort(centre)
    return np.interp(lab.wavelength, centre[order], values[order])


#: Minimum visible share of a lamp line's area at the edge [1].
MIN_VISIBLE_AREA = 0.3
_MAX_EDGE_RESIDUAL = 0.15  # share of a lamp line's height; a larger residual belongs to another lamp line
_EDGE_WIDTH_U = 0.005  # relative uncertainty of the width at the edge, where it is extrapolated


def complete_edge_lines(
    lab: LabSweep,
    sweep_data: SweepData,
    lamp_lines: LampLines,
    wavelength_map: WavelengthMap,
    light: Floats,
    fwhm: Floats,
    shape: str,
) -> None:
    # Fit the heights of lamp lines that are cut off by the edge of the array, and mark them as completed.
    #
    # ``lamp_lines`` is changed. ``light`` (step,) are the wavelengths of the lamp lines in the camera [nm],
    # ``fwhm`` (step,) the width of the camera [nm], ``shape`` its line shape.
    for step, window in enumerate(sweep_data.windows):
        if window is None:
            continue
        is_cut = (window.first < 0) | (window.first + window.values.shape[1] > lab.shape[1])
        is_cut &= ~lamp_lines.trusted[step, window.columns] & ~window.saturated
        if is_cut.any():
            _complete_step(
                lab, sweep_data.noise, lamp_lines, wavelength_map, step, window,
                is_cut=is_cut, centre=wavelength_map.band_of(float(light[step]), window.columns),
                fwhm=float(fwhm[step]), shape=shape,
            )  # fmt: skip


def _complete_step(
    lab: LabSweep, noise: NoiseModel, lamp_lines: LampLines, wavelength_map: WavelengthMap, step: int,
    window: Window, *,
    is_cut: Bools, centre: Floats, fwhm: float, shape: str,
) -> None:  # fmt: skip
    spacing = wavelength_map.spacing(centre, window.columns)
    width, source = fwhm / spacing, lab.width[step] / spacing
    frames = float(lab.frames[step])

    def profile(shift: float, width_factor: float) -> Floats:
        out = np.empty(window.values.shape)
        distance = window.places - (centre + shift)[:, None]
        profiles(distance, width * width_factor, source, SHAPES[shape], lab.triangular, out)
        return out

    is_finite = np.isfinite(window.values)
    values = np.where(is_finite, window.values, 0.0)
    unit_profile = np.where(is_finite, profile(0.0, 1.0), 0.0)
    variance = noise.variance(values, frames) + (1e-4 * values.max(axis=1, keepdims=True)) ** 2
    weight = np.where(is_finite, 1.0 / np.maximum(variance, 1e-300), 0.0)
    norm = np.maximum((weight * unit_profile**2).sum(axis=1), 1e-300)

    def area_of(line_profile: Floats) -> Floats:
        line_profile = np.where(is_finite, line_profile, 0.0)
        height = (weight * line_profile * values).sum(axis=1)
        return np.asarray(height / np.maximum((weight * line_profile**2).sum(axis=1), 1e-300))

    fitted = area_of(unit_profile)
    visible = unit_profile.sum(axis=1)
    area = values.sum(axis=1) + (1.0 - visible) * fitted
    # uncertainty of the area by centre, width and noise
    change_by_centre, change_by_width = (
        (1.0 - visible) * (area_of(changed_profile) - fitted) / 1e-3
        - (changed_profile * is_finite - unit_profile).sum(axis=1) * fitted / 1e-3
        for changed_profile in (profile(1e-3, 1.0), profile(0.0, 1.0 + 1e-3))
    )
    variance_by_noise = np.where(is_finite, noise.variance(values, frames), 0.0).sum(axis=1)
    variance_by_noise = variance_by_noise + (1.0 - visible) ** 2 / norm
    area_variance = (
        variance_by_noise
        + (change_by_centre * wavelength_map.residual / spacing) ** 2
        + (change_by_width * _EDGE_WIDTH_U) ** 2
    )
    residual = np.abs(np.where(is_finite, values - fitted[:, None] * unit_profile, 0.0))
    height = np.abs(fitted) * profile(0.0, 1.0).max(axis=1)
    # one free parameter: residuals above noise are dead elements, or another lamp line
    is_complete = (
        is_cut
        & (visible >= MIN_VISIBLE_AREA)
        & (fitted > 0)
        & np.isfinite(area_variance)
        & ~(residual > np.maximum(8.0 * np.sqrt(variance), _MAX_EDGE_RESIDUAL * height[:, None])).any(axis=1)
    )
    index = (step, window.columns[is_complete])
    lamp_lines.area[index] = area[is_complete]
    lamp_lines.area_u[index] = np.sqrt(area_variance[is_complete]) / area[is_complete]
    lamp_lines.centre[index] = centre[is_complete]
    lamp_lines.completed[index] = True
    lamp_lines.covariance[(*index, AREA, AREA)] = area_variance[is_complete]


# --- from the areas of lamp lines to the gain of every element ---------------------------------------------


_MAX_GAP_STEPS = 3.0  # median steps; wider gaps are not interpolated


def shape_variance(fwhm: Floats, shape: str, spacing: Floats | float = 0.0) -> Floats:
    # Return the variance of a line shape [nm2]: "gaussian", "triangle" (of equal slits) or "slit".
    if shape == "gaussian":
        return np.asarray(fwhm**2 / (8.0 * np.log(2.0)))
    return np.asarray(fwhm**2 / 6.0 if shape == "triangle" else (fwhm**2 + np.square(spacing)) / 12.0)


def second_order_factor(
    wavelength: Floats, level: Floats, camera_variance: Floats, source_variance: Floats
) -> Floats:
    # Return the factor from the responsivity in a lamp line to that of a band at the same wavelength.
    #
    # ``wavelength`` (step,) [nm]; ``level`` (step,) is the responsivity from the lamp lines' areas at any
    # scale, median of the columns, NaN where unknown; ``camera_variance`` and ``source_variance`` (step,) are
    # those of the camera's line shape and of the monochromator's [nm2].
    factor = np.ones_like(level)
    positive = np.flatnonzero(np.isfinite(level) & (level > 0))
    if positive.size < 5:
        return factor
    x, y = wavelength[positive], level[positive]
    step_before, step_after = np.diff(x)[:-1], np.diff(x)[1:]
    curvature = (
        2.0 * ((y[2:] - y[1:-1]) / step_after - (y[1:-1] - y[:-2]) / step_before) / (step_before + step_after)
    )
    relative_curvature = np.empty_like(y)
    relative_curvature[1:-1] = curvature / y[1:-1]
    relative_curvature[0], relative_curvature[-1] = relative_curvature[1], relative_curvature[-2]
    # smoothed, since noise of a second difference is six times that of the values
    factor[positive] = 1.0 + 0.5 * (camera_variance - source_variance)[positive] * np.convolve(
        np.pad(relative_curvature, 1, mode="edge"), [0.25, 0.5, 0.25], mode="valid"
    )
    return np.clip(factor, 0.9, 1.1)


def monotone_slopes(x: Floats, y: Floats) -> Floats:
    # Return slopes at nodes ``x`` (node,) for interpolation of ``y`` (node, column) without ringing.
    #
    # Slopes of a cubic spline, of fourth order. Where curvature changes sign, they are limited
    # as by Fritsch and Carlson (Hyman 1983), which keeps monotone pieces monotone.
    from scipy.interpolate import CubicSpline

    if len(x) < 3:
        return np.repeat(np.diff(y, axis=0) / np.diff(x)[:, None], len(x), axis=0)
    slope = np.asarray(CubicSpline(x, y, axis=0).derivative()(x))
    secant = np.diff(y, axis=0) / np.diff(x)[:, None]
    secant_before, secant_after = np.vstack([secant[:1], secant]), np.vstack([secant, secant[-1:]])
    limit = 3.0 * np.minimum(np.abs(secant_before), np.abs(secant_after))
    limited = np.clip(slope, -limit, limit)
    limited = np.where((secant_before * secant_after > 0) & (limited * secant_before < 0), 0.0, limited)
    curvature = np.sign(np.diff(secant, axis=0))
    # concave or convex at a node and both its neighbours: a smooth extremum, not the foot of a step
    padded = np.vstack([curvature[:1], curvature[:1], curvature, curvature[-1:], curvature[-1:]])
    is_smooth = (padded[:-2] == padded[1:-1]) & (padded[1:-1] == padded[2:]) & (padded[1:-1] != 0)
    return np.asarray(np.where(is_smooth, slope, limited))


def interpolate_nodes(
    x: Floats, y: Floats, used: Bools, at: Floats, tolerance: float = 0.0
) -> tuple[Floats, Bools]:
    # Return each column's values (place, column) between its used nodes, and where they are finite.
    #
    # ``x`` (node,) increases; ``y`` and ``used`` (node, column): columns with fewer than four used nodes get
    # nothing; ``at`` (place, column) may lie ``tolerance`` beyond the outer nodes. NaN beyond them and in
    # gaps of over three steps.
    values = np.full(at.shape, np.nan)
    patterns, member = np.unique(used, axis=1, return_inverse=True)
    max_gap = _MAX_GAP_STEPS * float(np.median(np.diff(x)))
    for index in range(patterns.shape[1]):
        nodes = np.flatnonzero(patterns[:, index])
        columns = np.flatnonzero(member.ravel() == index)
        if nodes.size < 4:
            continue
        x_used, y_used, place = x[nodes], y[np.ix_(nodes, columns)], at[:, columns]
        place = np.where((place < x_used[0]) & (place >= x_used[0] - tolerance), x_used[0], place)
        place = np.where((place > x_used[-1]) & (place <= x_used[-1] + tolerance), x_used[-1], place)
        # cubic Hermite polynomials between the nodes
        left = np.clip(np.searchsorted(x_used, place, side="right") - 1, 0, len(x_used) - 2)
        width = np.diff(x_used)[left]
        u = (place - x_used[left]) / width
        slope, column = monotone_slopes(x_used, y_used), np.arange(columns.size)
        y0, y1 = y_used[left, column], y_used[left + 1, column]
        m0, m1 = slope[left, column] * width, slope[left + 1, column] * width
        cubic = y0 * (1 + 2 * u) * (1 - u) ** 2 + m0 * u * (1 - u) ** 2
        cubic += y1 * u**2 * (3 - 2 * u) + m1 * u**2 * (u - 1)
        values[:, columns] = np.where((u >= 0) & (u <= 1) & (width <= max_gap), cubic, np.nan)
    return values, np.isfinite(values)


def element_gain(
    step_wavelength: Floats,
    node: Floats,
    used: Bools,
    wavelength: Floats,
    etendue: Floats,
    tolerance: float = 0.0,
) -> tuple[Floats, Bools]:
    # Return the gain of every element [W m-2 sr-1 nm-1 s count-1], and whether it is known.
    #
    # NaN where it would be extrapolated. ``node`` (step, cross_track) is the responsivity of a band times
    # spacing, the integral of its response [count nm J-1], of the steps ``used`` there; ``step_wavelength``
    # (step,) and ``wavelength`` (band, cross_track) of the elements [nm]; ``etendue`` (cross_track,) [m2 sr].
    # Within the ``tolerance``, the uncertainty of the wavelengths [nm], an element counts as on the outer
    # step.
    log = np.log(np.where(used & (node > 0), node, 1.0))
    log_gain, finite = interpolate_nodes(step_wavelength, log, used & (node > 0), wavelength, tolerance)
    return np.asarray(np.exp(-log_gain) / etendue), finite


_PARTS = 161  # points of the monochromator's line
_REACH = {True: 1.0, False: 2.2}  # half support of a triangle and of a Gaussian in full widths


def slope_shift_of_lines(
    lab: LabSweep,
    noise: NoiseModel,
    slope: Floats,
    camera_width: Floats,
    spacing: Floats,
    amplitude: Floats,
    shape: str,
) -> Floats:
    # Return by how much a sloping responsivity shifts the centres of the lamp lines (step,) [nm].
    #
    # ``slope`` (step,) is d ln responsivity / d wavelength [nm-1]; ``camera_width``, ``spacing`` and
    # ``amplitude`` (step,) are the width of the camera's line [nm], the spacing of the bands [nm] and the
    # height of the line [count]; ``shape`` is the camera's line shape, ``noise`` weights the fits.
    curvature = np.gradient(slope, lab.wavelength)
    shifts = np.zeros(len(slope))
    for step, source in enumerate(lab.width):
        offset = np.linspace(-1.0, 1.0, _PARTS) * _REACH[lab.triangular] * source
        light = (
            np.maximum(1.0 - np.abs(offset) / source, 0.0)
            if lab.triangular
            else np.exp(-4.0 * np.log(2.0) * (offset / source) ** 2)
        )
        light *= np.exp(slope[step] * offset + 0.5 * curvature[step] * offset**2)
        # a lamp line of this light in units of bands, and the shift of its fitted centre
        place, width, slit = (nm / spacing[step] for nm in (offset, camera_width[step], source))
        half = int(np.ceil(2.2 * np.hypot(width, slit) + 2.0))
        bands = np.arange(-half, half + 1, dtype=np.float64)
        parts = np.empty((_PARTS, bands.size))
        widths, zeros = np.full(_PARTS, width), np.zeros(_PARTS)
        profiles(bands - place[:, None], widths, zeros, SHAPES[shape], False, parts)
        line = (light / light.sum()) @ parts
        line *= amplitude[step] / line.max()
        variance = noise.variance(line, float(lab.frames[step])) + (1e-4 * amplitude[step]) ** 2
        samples = LineSamples(line[None], 1.0 / variance[None], np.array([-half]), np.array([slit]))
        fits = fitted(samples, SHAPES[shape], lab.triangular, np.array([[0.0, width, line.sum(), 0.0]]))
        shifts[step] = spacing[step] * (fits.parameters[0, CENTRE] if fits.converged[0] else 0.0)
    return shifts


# --- read all steps of a sweep once, one after the other, and fit their lamp lines -------------------------


Tick = Callable[[], None]

#: Sources of a noise model; the third source is the sweep's own statement.
FROM_FRAMES, FROM_SCATTER = "variance of the frames", "scatter of the bands off the lines"

_MIN_CLIPPED_BANDS = (
    3  # bands of a column at the highest count of the sweep; a lamp line that is not clipped has one or two
)
_COUNT_TOLERANCE = 0.25
_MIN_EDGE_DISTANCE = 0.5  # minimum distance of a lamp line's centre from the edge of the array [full widths]
_SIGNAL_EDGES = np.concatenate([[-np.inf], np.geomspace(2.0, 65536.0, 40), [np.inf]])
SIGNAL_BINS = len(_SIGNAL_EDGES) - 1


@dataclass(frozen=True, eq=False)
class SweepData:
    # Data of a sweep that are kept after reading.
    windows: list[Window | None]  #: Window of every step; None without a lamp line
    rows: Floats  #: (step, band): counts outside the lines relative to the lines' areas
    noise: NoiseModel  #: Noise of one frame
    noise_source: str  #: Source of the noise model


@dataclass(eq=False)
class LampLines:
    # Fitted lamp lines of all steps, (step, cross_track) except where noted; NaN without a line.
    centre: Floats
    camera_width: Floats
    width: Floats
    amplitude: Floats
    area: Floats
    area_u: Floats
    centre_u: Floats
    camera_width_u: Floats
    covariance: Floats
    chi2: Floats
    degrees: Floats
    trusted: Bools
    completed: Bools

    @classmethod
    def empty(cls, steps: int, columns: int) -> LampLines:
        # Return lines without any fit.
        lamp_lines = cls(*(np.full((steps, columns), np.nan) for _ in fields(cls)))
        lamp_lines.covariance = np.full((steps, columns, 4, 4), np.nan)
        lamp_lines.trusted, lamp_lines.completed = np.zeros((2, steps, columns), np.bool_)
        return lamp_lines

    def store(self, step: int, window: Window, fits: Fits, bands: int) -> None:
        # Store the fits of one step.
        index = (step, window.columns)
        self.centre[index] = fits.parameters[:, CENTRE]
        self.camera_width[index] = fits.parameters[:, WIDTH]
        self.width[index] = fits.width
        self.amplitude[index] = fits.amplitude
        self.area[index] = fits.area
        with np.errstate(invalid="ignore"):
            self.area_u[index] = np.sqrt(fits.area_variance) / fits.area
            self.centre_u[index] = np.sqrt(fits.covariance[:, CENTRE, CENTRE])
            self.camera_width_u[index] = np.sqrt(fits.covariance[:, WIDTH, WIDTH])
        self.covariance[index] = fits.covariance
        self.chi2[index], self.degrees[index] = fits.chi2, fits.degrees
        centre, margin = fits.parameters[:, CENTRE], _MIN_EDGE_DISTANCE * fits.width
        with np.errstate(invalid="ignore"):
            is_inside = (centre >= margin) & (centre <= bands - 1 - margin)
        self.trusted[index] = fits.converged & is_inside & ~window.saturated & np.isfinite(self.area_u[index])


def read_lines(lab: LabSweep, bad: Bools, curve: Linearity, flat: Floats | None, tick: Tick) -> SweepData:
    # Read every step once and keep the windows around its lamp lines.
    #
    # SchemaError if the lamp lines do not move along the array with the wavelengths, or columns without flux
    # are lit; a warning if lamp lines look clipped and ``saturation_count`` is missing.
    steps, bands, _ = lab.shape
    windows: list[Window | None] = []
    rows = np.zeros((steps, bands))
    tally = np.zeros((3, SIGNAL_BINS))
    scatter = []
    highest = np.full(bad.shape, -np.inf)
    for step in range(steps):
        raw = lab.frame(step)
        highest = np.fmax(highest, raw)
        net = curve.net(raw, lab.dark.at(float(lab.exposure[step])))
        if lab.band_shift_time:
            smear = smear_of(lab.band_shift_time, float(lab.exposure[step]), bands)
            net = net - smear * np.nansum(net, axis=0)
        if lab.variance is not None:
            variance = np.asarray(lab.variance.isel({STEP: step}).to_numpy(), np.float64)
            is_saturated = lab.saturation is not None and raw >= lab.saturation - float(
                SATURATION_MARGIN_COUNTS
            )
            is_counted = np.isfinite(net) & np.isfinite(variance) & ~(bad | is_saturated)
            tally += binned(net[is_counted], net[is_counted], variance[is_counted])
        if flat is not None:
            net = net * flat
        window = find_line(net, raw, bad, lab.saturation)
        if window is not None:
            rows[step] = window.out_of_band
            far_counts = net[np.abs(np.arange(bands) - window.band) > 0.25 * bands]
            scatter.append(
                1.4826**2 * np.nanmedian((far_counts - np.nanmedian(far_counts)) ** 2) * lab.frames[step]
            )
        windows.append(window)
        tick()
    _check_monotone(lab, windows)
    # lit columns without flux or capture fraction
    missing_flux = [
        f"{lab.wavelength[step]:g} nm ({missing} of {window.columns.size} lit columns)"
        for step, window in enumerate(windows)
        if window is not None and (missing := int((~np.isfinite(lab.power[step, window.columns])).sum()))
    ]
    if missing_flux:
        raise refused(
            f"flux x capture_fraction is zero or NaN in lit columns: {listed(missing_flux)}",
            mend="measure it there",
            code="flux-missing",
        )
    # one highest count that repeats along a column
    if lab.saturation is None:
        highest = np.where(bad, -np.inf, highest)
        is_highest = highest >= highest.max() - _COUNT_TOLERANCE
        if (is_highest.sum(axis=0) >= _MIN_CLIPPED_BANDS).any():
            warn_user(
                f"saturation_count is missing, and the highest count {highest.max():g} repeats in "
                f"{int(is_highest.sum())} elements: clipped lamp lines are not recognised; "
                "give saturation_count",
                "saturation-missing",
            )
    return SweepData(windows, rows, *_noise_model(lab, tally, scatter))


def binned(signal: Floats, *values: Floats) -> Floats:
    # Return, for bins of the signal [count], the number of samples and the sums of values (row, bin).
    bins = np.searchsorted(_SIGNAL_EDGES, signal, side="right") - 1
    return np.stack([np.bincount(bins, weight, SIGNAL_BINS) for weight in (None, *values)])


def _noise_model(lab: LabSweep, tally: Floats, scatter: list[float]) -> tuple[NoiseModel, str]:
    # Return the noise by photon transfer of the sweep, else as stated, else by scatter off the lamp lines.
    dark_variance = lab.dark.spread**2 * lab.dark.leverage(float(np.median(lab.exposure)))
    dark_share = lab.dark.leverage(float(np.median(lab.exposure))) / (
        lab.dark_frames or np.median(lab.frames)
    )
    is_used = tally[0] > 50
    if is_used.sum() >= 3 and tally[2][is_used].any():
        count, (signal, variance) = tally[0][is_used], tally[1:, is_used] / tally[0][is_used]
        weight = np.sqrt(count) / np.maximum(variance, 1e-6)
        constant, slope = np.linalg.lstsq(
            np.column_stack([np.ones_like(signal), signal]) * weight[:, None], variance * weight, rcond=None
        )[0]
        if slope > 0:
            constant = max(float(constant), 0.0)
            return NoiseModel(
                constant, float(slope), dark_variance or constant * float(dark_share)
            ), FROM_FRAMES
    if lab.electrons_per_count is not None:
        constant = (lab.read_noise or 0.0) ** 2 + QUANTISATION_VARIANCE_COUNT2
        return NoiseModel(
            constant, 1.0 / lab.electrons_per_count, dark_variance or constant * float(dark_share)
        ), "as stated"
    # scatter includes the noise of the dark
    return NoiseModel(float(np.median(scatter)) if scatter else 0.0, 0.0), FROM_SCATTER


def _check_monotone(lab: LabSweep, windows: list[Window | None]) -> None:
    peaks = [(step, window.band) for step, window in enumerate(windows) if window is not None]
    if len(peaks) < 3:
        return
    peak_bands = np.array([band for _, band in peaks])
    steps_of_peaks = np.diff(peak_bands)
    reversed_steps = np.flatnonzero(steps_of_peaks * np.sign(np.median(steps_of_peaks)) < -2)
    if reversed_steps.size:
        listed_peaks = listed(
            [
                f"{lab.wavelength[peaks[k + 1][0]]:g} nm at band {peak_bands[k + 1]}, after {peak_bands[k]}"
                for k in reversed_steps
            ]
        )
        raise refused(
            f"lamp lines do not move along the array as the wavelengths do: {listed_peaks}",
            mend="check that counts and step_wavelength belong together, in order",
            code="steps-unordered",
        )


def fit_steps(
    lab: LabSweep,
    sweep_data: SweepData,
    shape: int,
    tick: Tick,
    first: tuple[WavelengthMap, list[Fits | None]] | None = None,
) -> tuple[LampLines, list[Fits | None]]:
    # Return the lamp lines of all steps, and the fits of every step (None for a step without a line).
    #
    # Without ``first``, the monochromator's line is not deconvolved: such fits give the centres. With a
    # wavelength map and first fits, they are fits of the camera's response convolved with that line.
    lamp_lines = LampLines.empty(lab.shape[0], lab.shape[2])
    fits_of_steps: list[Fits | None] = [None] * lab.shape[0]
    for step, window in enumerate(sweep_data.windows):
        if window is not None:
            light, start = Light(np.zeros(len(window.columns)), False), None
            if first is not None and (start := first[1][step]) is not None:
                spacing = first[0].spacing(start.parameters[:, CENTRE], window.columns)
                light = Light(np.asarray(lab.width[step] / spacing), lab.triangular)
            fits = fit_window(window, sweep_data.noise, float(lab.frames[step]), shape, light, start)
            lamp_lines.store(step, window, fits, lab.shape[1])
            fits_of_steps[step] = fits
        tick()
    return lamp_lines, fits_of_steps
