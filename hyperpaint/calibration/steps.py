"""Read all steps of a sweep once, one after the other, and fit their lamp lines."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np

from hyperpaint.base.arrays import Bools, Floats
from hyperpaint.base.constants import QUANTISATION_VARIANCE_COUNT2, SATURATION_MARGIN_COUNTS
from hyperpaint.base.errors import PaintWarning
from hyperpaint.kernels.line_fits import CENTRE, GAUSSIAN, WIDTH
from hyperpaint.radiometry.linear_counts import Linearity
from hyperpaint.radiometry.stray_light import smear_of

from .lab_sweep import LabSweep, listed, refused
from .line_fits import Fits, Light, NoiseModel, Window, find_line, fit_window
from .wavelength_map import WavelengthMap

Tick = Callable[[], None]

#: Sources of a noise model; the third source is the sweep's own statement.
FROM_FRAMES, FROM_SCATTER = "variance of the frames", "scatter of the bands off the lines"

_CLIPPED = 3  # bands of a column that reach the highest count of the sweep: a line does so in one, or two
_SAME_COUNT = 0.25
_INSIDE = 0.5  # full widths between a line's centre and the edge of the array, at least
_SIGNAL_EDGES = np.concatenate([[-np.inf], np.geomspace(2.0, 65536.0, 40), [np.inf]])
SIGNAL_BINS = len(_SIGNAL_EDGES) - 1


@dataclass(frozen=True, eq=False)
class Read:
    """Data of a sweep that are kept after reading."""

    windows: list[Window | None]  #: One a step; None where there is no line
    rows: Floats  #: (step, band): counts outside the lines relative to the lines' areas
    noise: NoiseModel  #: Of one frame
    noise_source: str  #: Says where the noise model comes from


@dataclass(eq=False)
class Lines:
    """Fitted lamp lines of all steps, (step, cross_track) except where noted; NaN without a line."""

    centre: Floats
    own_width: Floats
    width: Floats
    amplitude: Floats
    area: Floats
    area_u: Floats
    centre_u: Floats
    own_width_u: Floats
    covariance: Floats
    chi2: Floats
    degrees: Floats
    trusted: Bools
    completed: Bools

    @classmethod
    def empty(cls, steps: int, columns: int) -> Lines:
        """Return lines without any fit."""
        shape = (steps, columns)
        arrays = {field.name: np.full(shape, np.nan) for field in fields(cls)}
        return cls(
            **arrays
            | {
                "covariance": np.full((*shape, 4, 4), np.nan),
                "trusted": np.zeros(shape, np.bool_),
                "completed": np.zeros(shape, np.bool_),
            }
        )

    def store(self, step: int, window: Window, fits: Fits, bands: int) -> None:
        """Store the fits of one step."""
        at = (step, window.columns)
        self.centre[at] = fits.parameters[:, CENTRE]
        self.own_width[at] = fits.parameters[:, WIDTH]
        self.width[at] = fits.width
        self.amplitude[at] = fits.amplitude
        self.area[at] = fits.area
        with np.errstate(invalid="ignore"):
            self.area_u[at] = np.sqrt(fits.area_variance) / fits.area
            self.centre_u[at] = np.sqrt(fits.covariance[:, CENTRE, CENTRE])
            self.own_width_u[at] = np.sqrt(fits.covariance[:, WIDTH, WIDTH])
        self.covariance[at] = fits.covariance
        self.chi2[at], self.degrees[at] = fits.chi2, fits.degrees
        centre, half = fits.parameters[:, CENTRE], _INSIDE * fits.width
        with np.errstate(invalid="ignore"):
            inside = (centre >= half) & (centre <= bands - 1 - half)
        self.trusted[at] = fits.converged & inside & ~window.saturated & np.isfinite(self.area_u[at])


def read_lines(lab: LabSweep, bad: Bools, curve: Linearity, flat: Floats | None, tick: Tick) -> Read:
    """Read every step once and keep the windows around its lamp lines.

    SchemaError where the lines do not move along the array as the wavelengths do, or light falls where none
    is stated; a warning where lines look clipped and ``saturation_count`` is missing.
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
        variance = lab.frame_variance(step)
        if variance is not None:
            full = lab.saturation is not None and raw >= lab.saturation - float(SATURATION_MARGIN_COUNTS)
            is_counted = np.isfinite(net) & np.isfinite(variance) & ~(bad | full)
            tally += binned(net[is_counted], net[is_counted], variance[is_counted])
        if flat is not None:
            net = net * flat
        window = find_line(net, raw, bad, lab.saturation)
        if window is not None:
            rows[step] = window.out_of_band
            far = net[np.abs(np.arange(bands) - window.band) > 0.25 * bands]
            scatter.append(1.4826**2 * np.nanmedian((far - np.nanmedian(far)) ** 2) * lab.frames[step])
        windows.append(window)
        tick()
    _check_monotone(lab, windows)
    _check_flux(lab, windows)
    if lab.saturation is None:
        _warn_of_clipping(np.where(bad, -np.inf, highest))
    noise, source = _noise_model(lab, tally, scatter)
    return Read(windows, rows, noise, source)


def binned(signal: Floats, *values: Floats) -> Floats:
    """Return, for bins of the signal [count], the number of samples and the sums of values (row, bin)."""
    bins = np.searchsorted(_SIGNAL_EDGES, signal, side="right") - 1
    return np.stack([np.bincount(bins, weight, SIGNAL_BINS) for weight in (None, *values)])


def _noise_model(lab: LabSweep, tally: Floats, scatter: list[float]) -> tuple[NoiseModel, str]:
    # Photon transfer of the sweep, else the stated noise, else the scatter off the lamp lines
    dark = lab.dark.spread**2 * lab.dark.leverage(float(np.median(lab.exposure)))
    alone = lab.dark.leverage(float(np.median(lab.exposure))) / (lab.dark_frames or np.median(lab.frames))
    used = tally[0] > 50
    if used.sum() >= 3 and tally[2][used].any():
        count, (signal, variance) = tally[0][used], tally[1:, used] / tally[0][used]
        weight = np.sqrt(count) / np.maximum(variance, 1e-6)
        terms = np.column_stack([np.ones_like(signal), signal]) * weight[:, None]
        constant, slope = np.linalg.lstsq(terms, variance * weight, rcond=None)[0]
        if slope > 0:
            constant = max(float(constant), 0.0)
            return NoiseModel(constant, float(slope), dark or constant * float(alone)), FROM_FRAMES
    if lab.electrons_per_count is not None:
        constant = (lab.read_noise or 0.0) ** 2 + QUANTISATION_VARIANCE_COUNT2
        return NoiseModel(
            constant, 1.0 / lab.electrons_per_count, dark or constant * float(alone)
        ), "as stated"
    # that scatter includes the dark's own noise
    return NoiseModel(float(np.median(scatter)) if scatter else 0.0, 0.0), FROM_SCATTER


def _check_flux(lab: LabSweep, windows: list[Window | None]) -> None:
    # Refuse lit columns of which flux or capture fraction is zero or NaN
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


def _warn_of_clipping(highest: Floats) -> None:
    # Warn where the highest counts of the elements (band, cross_track) repeat one value along a column
    top = float(highest.max())
    same = highest >= top - _SAME_COUNT
    if (same.sum(axis=0) >= _CLIPPED).any():
        warnings.warn(
            PaintWarning(
                f"saturation_count is missing, and the highest count {top:g} repeats in {int(same.sum())} "
                "elements: clipped lamp lines are not recognised; give saturation_count",
                code="saturation-missing",
            ),
            stacklevel=4,
        )


def _check_monotone(lab: LabSweep, windows: list[Window | None]) -> None:
    peaks = [(step, window.band) for step, window in enumerate(windows) if window is not None]
    if len(peaks) < 3:
        return
    place = np.array([band for _, band in peaks])
    moves = np.diff(place)
    back = np.flatnonzero(moves * np.sign(np.median(moves)) < -2)
    if back.size:
        where = listed(
            [f"{lab.wavelength[peaks[k + 1][0]]:g} nm at band {place[k + 1]}, after {place[k]}" for k in back]
        )
        raise refused(
            f"lamp lines do not move along the array as the wavelengths do: {where}",
            mend="check that counts and step_wavelength belong together, in order",
            code="steps-unordered",
        )


def fit_as_seen(lab: LabSweep, read: Read, tick: Tick) -> tuple[Lines, list[Fits | None]]:
    """Return Gaussian fits of the lamp lines without deconvolution, which give their places."""
    lines = Lines.empty(lab.shape[0], lab.shape[2])
    fits_of_steps: list[Fits | None] = []
    for step, window in enumerate(read.windows):
        fits = None
        if window is not None:
            light = Light(np.zeros(len(window.columns)), False)
            fits = fit_window(window, read.noise, float(lab.frames[step]), GAUSSIAN, light)
            lines.store(step, window, fits, lab.shape[1])
        fits_of_steps.append(fits)
        tick()
    return lines, fits_of_steps


def fit_through(
    lab: LabSweep, read: Read, surface: WavelengthMap, shape: int, seen: list[Fits | None], tick: Tick
) -> Lines:
    """Return fits of the camera's own response, the monochromator's line convolved with it."""
    lines = Lines.empty(lab.shape[0], lab.shape[2])
    for step, (window, start) in enumerate(zip(read.windows, seen, strict=True)):
        if window is not None and start is not None:
            spacing = surface.spacing(start.parameters[:, CENTRE], window.columns)
            light = Light(np.asarray(lab.width[step] / spacing), lab.triangular)
            fits = fit_window(window, read.noise, float(lab.frames[step]), shape, light, start)
            lines.store(step, window, fits, lab.shape[1])
        tick()
    return lines
