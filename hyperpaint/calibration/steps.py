"""Read all steps of a sweep once, one after the other, and fit their lamp lines."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np

from hyperpaint.base.arrays import Bools, Floats
from hyperpaint.base.constants import QUANTISATION_VARIANCE_COUNT2, SATURATION_MARGIN_COUNTS
from hyperpaint.base.errors import PaintWarning
from hyperpaint.base.schema import STEP
from hyperpaint.kernels.line_fits import CENTRE, WIDTH
from hyperpaint.radiometry.linear_counts import Linearity
from hyperpaint.radiometry.stray_light import smear_of

from .lab_sweep import LabSweep, listed, refused
from .line_fits import Fits, Light, NoiseModel, Window, find_line, fit_window
from .wavelength_map import WavelengthMap

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
    """Data of a sweep that are kept after reading."""

    windows: list[Window | None]  #: Window of every step; None without a lamp line
    rows: Floats  #: (step, band): counts outside the lines relative to the lines' areas
    noise: NoiseModel  #: Noise of one frame
    noise_source: str  #: Source of the noise model


@dataclass(eq=False)
class LampLines:
    """Fitted lamp lines of all steps, (step, cross_track) except where noted; NaN without a line."""

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
        """Return lines without any fit."""
        lamp_lines = cls(*(np.full((steps, columns), np.nan) for _ in fields(cls)))
        lamp_lines.covariance = np.full((steps, columns, 4, 4), np.nan)
        lamp_lines.trusted, lamp_lines.completed = np.zeros((2, steps, columns), np.bool_)
        return lamp_lines

    def store(self, step: int, window: Window, fits: Fits, bands: int) -> None:
        """Store the fits of one step."""
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
    """Read every step once and keep the windows around its lamp lines.

    SchemaError if the lamp lines do not move along the array with the wavelengths, or columns without flux
    are lit; a warning if lamp lines look clipped and ``saturation_count`` is missing.
    """
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
            text = (
                f"saturation_count is missing, and the highest count {highest.max():g} repeats in "
                f"{int(is_highest.sum())} elements: clipped lamp lines are not recognised; "
                "give saturation_count"
            )
            warnings.warn(PaintWarning(text, code="saturation-missing"), stacklevel=3)
    return SweepData(windows, rows, *_noise_model(lab, tally, scatter))


def binned(signal: Floats, *values: Floats) -> Floats:
    """Return, for bins of the signal [count], the number of samples and the sums of values (row, bin)."""
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
        terms = np.column_stack([np.ones_like(signal), signal]) * weight[:, None]
        constant, slope = np.linalg.lstsq(terms, variance * weight, rcond=None)[0]
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
    """Return the lamp lines of all steps, and the fits of every step (None for a step without a line).

    Without ``first``, the monochromator's line is not deconvolved: such fits give the centres. With a
    wavelength map and first fits, they are fits of the camera's response convolved with that line.
    """
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
