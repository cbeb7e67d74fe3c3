"""Lamp lines that agree with the wavelength map, lamp lines cut off at the edges, and deviant elements.

Four parameters cannot be fitted to half a lamp line. For a lamp line at the edge of the array the wavelength
map gives the centre and the neighbours give the width; only the height is fitted, and the area follows.
"""

from __future__ import annotations

import numpy as np

from hyperpaint.base.arrays import Bools, Floats
from hyperpaint.kernels.line_fits import AREA, profiles

from .detector import row_medians
from .lab_sweep import LabSweep
from .line_fits import SHAPES, NoiseModel, Window
from .steps import SIGNAL_BINS, LampLines, SweepData, binned
from .wavelength_map import WavelengthMap, fit_width

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
    step_medians = row_medians(widths, lamp_lines.trusted)[fitted_steps]
    return np.asarray(np.interp(lab.wavelength, lab.wavelength[fitted_steps], step_medians))


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
    """Return the elements (band, cross_track) whose counts do not fit the lamp lines that cover them.

    Centre and width of a lamp line follow from all other lamp lines, which one dead element does not affect;
    its height is the median over its bands. One side suffices for lamp lines at the edge of the array.
    """
    _, bands, columns = lab.shape
    suspect, tested = np.zeros((bands, columns), np.int64), np.zeros((bands, columns), np.int64)
    widths = _camera_widths(lab, lamp_lines, wavelength_map)
    for step, window in enumerate(sweep_data.windows):
        if window is None:
            continue
        centre = wavelength_map.band_of(float(lab.wavelength[step]), window.columns)
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
    """Return the standard deviation of the factors of elements [1], beyond noise, and a slope of noise.

    The slope is that of the variance of a step's mean over the signal [count], 0 with ``has_noise``.
    A fit of four parameters hides most of them, since a lamp line is a few bands wide. So centre and width
    are taken from the map, and only height and a small shift are fitted. Without ``has_noise``,
    ``sweep_data.noise`` is not valid for bright samples, and their noise is determined too.
    """
    from scipy.optimize import nnls

    widths = _camera_widths(lab, lamp_lines, wavelength_map)
    tally = np.zeros((4, SIGNAL_BINS))
    shares = []
    for step, window in enumerate(sweep_data.windows):
        if window is None or not lamp_lines.trusted[step].any():
            continue
        is_usable = np.isfinite(window.values).all(axis=1) & lamp_lines.trusted[step, window.columns]
        if not is_usable.any():
            continue
        centre = wavelength_map.band_of(float(lab.wavelength[step]), window.columns)
        # error of the dial and slope shift are common to the columns
        centre = centre + np.median((lamp_lines.centre[step, window.columns] - centre)[is_usable])
        unit_before, unit, unit_after = (
            _unit_lines(lab, window, step, wavelength_map, centre + centre_shift, float(widths[step]), shape)[
                is_usable
            ]
            for centre_shift in (-_CENTRE_STEP_BANDS, 0.0, _CENTRE_STEP_BANDS)
        )
        model, residual, freedom = _residuals_of_fit(window.values[is_usable], unit, unit_after - unit_before)
        excess = residual**2 - sweep_data.noise.variance(model, float(lab.frames[step])) * freedom
        # samples that are not bright contain scattered light
        is_bright = model > _MIN_BRIGHT_SHARE * model.max(axis=1, keepdims=True)
        shares.append(excess[is_bright].sum() / (model**2 * freedom)[is_bright].sum())
        weights = (model * freedom, model**2 * freedom, excess)
        tally += binned(model[is_bright], *(weight[is_bright] for weight in weights))
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


def _residuals_of_fit(values: Floats, unit: Floats, slope: Floats) -> tuple[Floats, Floats, Floats]:
    # Return lamp lines of fitted height, residuals after a small shift, and the freedom of each sample.
    # For independent scatter of variances d, the expected sum of squared residuals is sum(d x freedom).
    first = unit / np.sqrt((unit**2).sum(axis=1, keepdims=True))
    second = slope - (slope * first).sum(axis=1, keepdims=True) * first
    second /= np.sqrt(np.maximum((second**2).sum(axis=1, keepdims=True), 1e-300))
    model = np.maximum((values * first).sum(axis=1, keepdims=True), 1e-300) * first
    residual = values - model
    residual -= (residual * second).sum(axis=1, keepdims=True) * second
    return model, residual, 1.0 - first**2 - second**2


#: Largest distance of a lamp line from the wavelength map [nm].
MAX_MISPLACEMENT_NM = 0.5
#: Largest chi2 relative to the step's median; above, a lamp line contains several dead elements.
MAX_RELATIVE_CHI2 = 20.0
#: Largest deviation of a width from the step's median [1].
MAX_WIDTH_DEVIATION = 0.3


def line_wavelengths(lamp_lines: LampLines, wavelength_map: WavelengthMap, slope_shift: Floats) -> Floats:
    """Return mapped wavelengths of lamp line centres (step, cross_track) [nm], less the slope shift."""
    wavelength = (
        wavelength_map.at(np.nan_to_num(lamp_lines.centre), np.arange(lamp_lines.centre.shape[1]))
        - slope_shift[:, None]
    )
    return np.asarray(np.where(np.isfinite(lamp_lines.centre), wavelength, np.nan))


def placed_lines(
    lab: LabSweep, lamp_lines: LampLines, wavelength_map: WavelengthMap, slope_shift: Floats
) -> Bools:
    """Return the valid fits (step, cross_track) with typical width and chi2 that agree with the map."""
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
    """Return the camera's width of every band (band,) [nm] from the placed lamp lines."""
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
    """Return a property of the bands (band,) at the wavelengths of the steps (step,)."""
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
    """Fit the heights of lamp lines that are cut off by the edge of the array, and mark them as completed.

    ``lamp_lines`` is changed. ``light`` (step,) are the wavelengths of the lamp lines in the camera [nm],
    ``fwhm`` (step,) the width of the camera [nm], ``shape`` its line shape.
    """
    for step, window in enumerate(sweep_data.windows):
        if window is None:
            continue
        is_cut = (window.first < 0) | (window.first + window.values.shape[1] > lab.shape[1])
        is_cut &= ~lamp_lines.trusted[step, window.columns] & ~window.saturated
        if is_cut.any():
            centre = wavelength_map.band_of(float(light[step]), window.columns)
            _complete_step(
                lab, sweep_data.noise, lamp_lines, wavelength_map, step, window,
                is_cut=is_cut, centre=centre, fwhm=float(fwhm[step]), shape=shape,
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
    is_deviant = residual > np.maximum(8.0 * np.sqrt(variance), _MAX_EDGE_RESIDUAL * height[:, None])
    is_complete = (
        is_cut
        & (visible >= MIN_VISIBLE_AREA)
        & (fitted > 0)
        & np.isfinite(area_variance)
        & ~is_deviant.any(axis=1)
    )
    index = (step, window.columns[is_complete])
    lamp_lines.area[index] = area[is_complete]
    lamp_lines.area_u[index] = np.sqrt(area_variance[is_complete]) / area[is_complete]
    lamp_lines.centre[index] = centre[is_complete]
    lamp_lines.completed[index] = True
    lamp_lines.covariance[(*index, AREA, AREA)] = area_variance[is_complete]
