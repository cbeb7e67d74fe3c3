"""Fit the lamp line of a sweep step over bands: centre, lit columns, width and area.

Bands and columns are fitted separately: over bands, light of one wavelength shows the response of the camera;
over columns, it shows the profile of the beam, which is not a property of the camera.
"""

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import chebyshev

from hyperpaint.base import SATURATION_MARGIN_COUNTS, ArrayLike, Bools, Floats, Ints, SchemaError
from hyperpaint.kernels.arguments import LineFits, LineSamples
from hyperpaint.kernels.line_fits import (
    AREA,
    CENTRE,
    GAUSSIAN,
    OFFSET,
    SLIT,
    WIDTH,
    fit_lines,
    full_widths,
    profiles,
)

#: Line shapes that a sweep distinguishes, with their numbers in the kernel.
SHAPES = {"gaussian": GAUSSIAN, "slit": SLIT}

#: Minimum light of a lit column, relative to the brightest column.
LIT = 0.2

#: Half width of the window of a lamp line in full widths at half maximum; 2e-7 of a Gaussian's area lies
#: beyond.
REACH = 2.2

_MAX_DEVIATION_SHARE = 0.15  # of a lamp line's height; a larger deviation from the fit is not noise
_MIN_BACKGROUND_BANDS = 12  # minimum number of bands outside a window for an estimate of its background
_GAUSSIAN_AREA = np.sqrt(np.pi / (4.0 * np.log(2.0)))  # area of a Gaussian of unit height and full width


@dataclass(frozen=True)
class NoiseModel:
    # Variance of one frame, constant + slope x signal, and of the subtracted dark [count2].
    constant: float
    slope: float
    dark: float = 0.0

    def variance(self, signal: Floats, frames: float) -> Floats:
        # Return the variance of the mean of some frames less the dark.
        return np.asarray((self.constant + self.slope * np.maximum(signal, 0.0)) / frames + self.dark)


@dataclass(frozen=True)
class Light:
    """Light of a step, for fits in units of bands: widths in bands, shape of the lamp line."""

    width: Floats
    triangular: bool


@dataclass(frozen=True, eq=False)
class Window:
    """The bands around the lamp line of one step, column by column."""

    columns: Ints  #: (line,): lit columns
    #: (line,): band of the first sample; negative where the window begins before the array
    first: Ints
    #: (line, sample): counts less dark and background; NaN outside the array and at bad elements
    values: Floats
    #: background, background_variance (line,): subtracted background [count], and its variance in units
    #: of the variance of one band
    background: Floats
    background_variance: Floats
    saturated: Bools  #: (line,): whether a sample is at the converter's end
    #: (cross_track,): light of every column relative to the brightest; NaN without valid elements
    beam: Floats
    #: (band,): counts of the bands outside the window relative to the area, mean of the lit columns; 0 inside
    out_of_band: Floats
    band: int  #: Band of the peak

    @property
    def places(self) -> Floats:
        # Band of every sample (line, sample).
        return np.asarray(self.first[:, None] + np.arange(self.values.shape[1]), np.float64)

    def leave_out(self, bad: Bools) -> None:
        # Blank the samples of bad elements (band, cross_track).
        band_numbers = self.first[:, None] + np.arange(self.values.shape[1])
        self.values[bad[np.clip(band_numbers, 0, len(bad) - 1), self.columns[:, None]]] = np.nan


@dataclass(frozen=True, eq=False)
class Fits:
    """Fits of one step's lines; widths and centres in bands."""

    #: (line, 4): centre [band], full width at half maximum of the camera [band], area [count], offset
    #: [count]
    parameters: Floats
    covariance: Floats  #: (line, 4, 4): of the parameters
    width: Floats  #: (line,): full width at half maximum of the measured lamp line [band]
    amplitude: Floats  #: (line,): height [count]
    #: area, area_variance (line,): sum over bands [count]: as measured, with the unseen part taken from
    #: the fit
    area: Floats
    area_variance: Floats
    #: chi2, degrees (line,): weighted sum of squared residuals and degrees of freedom
    chi2: Floats
    degrees: Floats
    converged: Bools  #: (line,): whether the fit converged to finite numbers


def find_line(net: Floats, raw: Floats, bad: Bools, saturation: Floats | None) -> Window | None:
    # Return the window around the lamp line of one step; None without a line.
    #
    # ``net`` (band, cross_track) are counts less dark, ``raw`` counts as read; ``bad`` elements are left
    # out; ``saturation`` is the count at which the converter is full, or None.
    bands, columns = net.shape
    valid_net = np.where(bad | ~np.isfinite(net), np.nan, net)
    spectrum = _mean(valid_net, axis=1)
    is_valid = np.isfinite(spectrum)
    spectrum = np.where(is_valid, spectrum - np.median(spectrum[is_valid]), 0.0)
    smooth = np.convolve(spectrum, np.ones(3) / 3.0, mode="same")
    peak = int(np.argmax(smooth))
    is_far = np.abs(np.arange(bands) - peak) > 0.1 * bands
    scatter = 1.4826 * float(np.median(np.abs(spectrum[is_far]))) if is_far.any() else 0.0
    if not smooth[peak] > max(8.0 * scatter, 1e-9):
        return None
    width = _rough_width(spectrum, peak)
    half_width = int(np.ceil(REACH * width + 2.0))
    # peak of the lamp line in each column, which moves by smile
    margin = int(np.ceil(width)) + 3
    near_bands = np.arange(max(peak - margin, 0), min(peak + margin + 1, bands))
    strip = np.where(np.isfinite(valid_net[near_bands]), valid_net[near_bands], 0.0)
    strip = strip[:-2] + strip[1:-1] + strip[2:] if len(near_bands) > 4 else strip
    peak_bands = near_bands[np.argmax(strip, axis=0) + (1 if len(near_bands) > 4 else 0)]
    first = (peak_bands - half_width).astype(np.int64)
    band_numbers = first[:, None] + np.arange(2 * half_width + 1)
    is_inside = (band_numbers >= 0) & (band_numbers < bands)
    clipped = np.clip(band_numbers, 0, bands - 1)
    column_index = np.arange(columns)[:, None]
    values = np.where(is_inside, valid_net[clipped, column_index], np.nan)
    outside = valid_net.copy()
    outside[clipped, column_index] = np.nan
    # background: clipped mean of each column outside its window, and its variance relative to that of a band
    # A drift of the dark shifts all bands equally; uncorrected, it would add to the area band by band.
    background, variance = np.zeros((2, columns))
    covered = np.flatnonzero(np.isfinite(outside).sum(axis=0) >= _MIN_BACKGROUND_BANDS)
    if covered.size:
        bands_outside = outside[:, covered]
        distance = np.abs(bands_outside - np.nanmedian(bands_outside, axis=0))
        is_background = np.isfinite(distance) & (distance <= 4.0 * 1.4826 * np.nanmedian(distance, axis=0))
        count = np.maximum(is_background.sum(axis=0), 1)
        background[covered] = np.where(is_background, bands_outside, 0.0).sum(axis=0) / count
        variance[covered] = 1.0 / count
    values = values - background[:, None]
    is_saturated = np.zeros(columns, np.bool_)
    if saturation is not None:
        limit = np.broadcast_to(saturation, net.shape) - float(SATURATION_MARGIN_COUNTS)
        is_saturated = ((raw >= limit)[clipped, column_index] & is_inside & np.isfinite(values)).any(axis=1)
    light = np.where(np.isfinite(values).sum(axis=1) >= min(6, bands), np.nansum(values, axis=1), np.nan)
    # light of the brightest columns, insensitive to a single column
    levels = np.where(np.isfinite(light), light, 0.0)
    if columns >= 5:
        levels = np.median(np.lib.stride_tricks.sliding_window_view(levels, 5), axis=1)
    brightest = float(levels.max(initial=0.0))
    lit_columns = np.flatnonzero(light > LIT * brightest)
    if not brightest > 0 or not lit_columns.size:
        return None
    out_of_band = _mean(
        np.where(np.isfinite(outside), outside, np.nan)[:, lit_columns] / light[lit_columns], axis=1
    )
    return Window(
        columns=lit_columns,
        first=first[lit_columns],
        values=values[lit_columns],
        background=background[lit_columns],
        background_variance=variance[lit_columns],
        saturated=is_saturated[lit_columns],
        beam=light / brightest,
        out_of_band=np.where(np.isfinite(out_of_band), out_of_band, 0.0),
        band=peak,
    )


def _mean(values: Floats, axis: int) -> Floats:
    # Return the mean of finite values; NaN without finite values.
    is_finite = np.isfinite(values)
    count = is_finite.sum(axis=axis)
    total = np.where(is_finite, values, 0.0).sum(axis=axis)
    return np.asarray(np.where(count > 0, total / np.maximum(count, 1), np.nan))


def _rough_width(spectrum: Floats, peak: int) -> float:
    # Return the full width of a peak from area over height, at least one band [band].
    half_width = 3
    for _ in range(6):
        samples = spectrum[max(peak - half_width, 0) : peak + half_width + 1]
        # at the edge of the array, a lamp line has only one side
        share = 1.0 + min(peak, len(spectrum) - 1 - peak, half_width) / half_width
        width = max(2.0 * samples.sum() / share / (samples.max() * _GAUSSIAN_AREA), 1.0)
        needed_half = int(np.ceil(2.0 * width + 1.0))
        if needed_half <= half_width:
            break
        half_width = min(needed_half, len(spectrum))
    return float(min(width, len(spectrum) / 4.0))


def fitted(samples: LineSamples, shape: int, triangular: bool, parameters: Floats) -> LineFits:
    # Improve ``parameters`` (line, 4) in place, and return them with the statistics of the fits.
    lamp_lines = len(parameters)
    fits = LineFits(
        parameters, np.empty((lamp_lines, 4, 4)), np.empty(lamp_lines), np.zeros(lamp_lines, np.bool_)
    )
    fit_lines(samples, shape, triangular, fits)
    return fits


def fit_beam(beam: Floats) -> tuple[float, float]:
    # Return centre and full width at half maximum of the beam over columns; NaN without a peak.
    is_finite = np.isfinite(beam)
    columns = np.arange(beam.size, dtype=np.float64)
    weights = np.where(is_finite, 1.0, 0.0)[None]
    values = np.where(is_finite, beam, 0.0)
    total = np.maximum(values, 0.0).sum()
    if is_finite.sum() < 8 or not total > 0:
        return np.nan, np.nan
    centre = float((np.maximum(values, 0.0) * columns).sum() / total)
    fits = fitted(
        LineSamples(values[None], weights, np.zeros(1, np.int64), np.zeros(1)),
        GAUSSIAN,
        False,
        np.array([[centre, total / _GAUSSIAN_AREA, total, 0.0]]),
    )
    beam_centre, width, area, offset = fits.parameters[0]
    is_peak = fits.converged[0] and width < 3.0 * beam.size and -width < beam_centre < beam.size + width
    if is_peak and abs(offset) < 0.5 * area / (width * _GAUSSIAN_AREA):
        return float(beam_centre), float(width)
    return np.nan, np.nan


def fit_window(
    window: Window, noise: NoiseModel, frames: float, shape: int, light: Light, start: Fits | None = None
) -> Fits:
    # Return the fits of all lamp lines of a window, weighted by ``noise`` of ``frames`` frames.
    #
    # ``shape`` is a value of `SHAPES`. ``light`` is the light of the step, of zero width in the first fit,
    # which is a fit without deconvolution. ``start`` are fits with start values.
    is_finite = np.isfinite(window.values)
    values = np.where(is_finite, window.values, 0.0)
    if start is None:
        parameters, model = _start(window, light), values
    else:
        parameters, width = start.parameters.copy(), start.width
        parameters[:, WIDTH] = np.sqrt(np.maximum(width**2 - light.width**2, (0.3 * width) ** 2))
        model = start.parameters[:, AREA, None] * _profiles(window, parameters, shape, light)
    height = np.max(np.where(is_finite, values, -np.inf), axis=1, keepdims=True)
    # weights from the noise of single counts favour low counts: weights follow the model if there is one
    min_variance = (1e-4 * height) ** 2 if start is not None else (3e-2 * height) ** 2
    variance = noise.variance(model, frames) + min_variance
    # fit in place, and again without the worst outlier
    is_used, start_values = is_finite.copy(), parameters.copy()
    for is_last in (False, True):
        parameters[:] = np.where(np.isfinite(parameters), parameters, start_values)
        samples = LineSamples(values, np.where(is_used, 1.0 / variance, 0.0), window.first, light.width)
        fits = fitted(samples, shape, light.triangular, parameters)
        if is_last:
            break
        model = parameters[:, AREA, None] * _profiles(window, parameters, shape, light)
        residual = np.where(is_used, np.abs(values - model - parameters[:, OFFSET, None]), 0.0)
        amplitude = np.abs(parameters[:, AREA] * _peaks(parameters, shape, light))[:, None]
        # a dead element distorts the fit of its neighbours, so only the worst sample is left out
        is_outlier = residual > np.maximum(8.0 * np.sqrt(variance), _MAX_DEVIATION_SHARE * amplitude)
        is_outlier &= residual >= residual.max(axis=1, keepdims=True)
        if not is_outlier.any():
            break
        is_used &= ~is_outlier
    # sum over all bands, of which the part beyond the edge of the array or on bad elements is taken from the
    # fit. Where bands are more than half a lamp line's width apart, their sum is a little more or less than
    # the light, depending on its position between them; the profile corrects this.
    unit = _profiles(window, parameters, shape, light)
    total = np.maximum(unit.sum(axis=1), 1e-300)
    unseen = np.clip(1.0 - np.where(is_used, unit, 0.0).sum(axis=1) / total, 0.0, 1.0)
    area = np.where(is_used, window.values, 0.0).sum(axis=1) / total + unseen * parameters[:, AREA]
    area_variance = np.where(is_used, noise.variance(np.where(is_used, values, 0.0), frames), 0.0).sum(axis=1)
    area_variance += (
        is_used.sum(axis=1) ** 2 * window.background_variance * noise.variance(np.zeros(1), frames)
    )
    area_variance += unseen**2 * fits.covariance[:, AREA, AREA]
    width = np.empty(len(values))
    full_widths(parameters[:, WIDTH].copy(), light.width, shape, light.triangular, width)
    return Fits(
        parameters=parameters,
        covariance=fits.covariance,
        width=width,
        amplitude=parameters[:, AREA] * _peaks(parameters, shape, light),
        area=area,
        area_variance=area_variance,
        chi2=fits.chi2,
        degrees=np.maximum(is_used.sum(axis=1) - 4.0, 1.0),
        converged=fits.converged & np.isfinite(area) & (parameters[:, AREA] > 0),
    )


def _start(window: Window, light: Light) -> Floats:
    values = np.where(np.isfinite(window.values), np.maximum(window.values, 0.0), 0.0)
    peak = np.argmax(values, axis=1)
    height = values.max(axis=1)
    is_near = np.abs(np.arange(values.shape[1]) - peak[:, None]) <= values.shape[1] / 4
    # the larger half is doubled, for lamp lines cut off at the edge of the array
    side = np.arange(values.shape[1]) - peak[:, None]
    halves = [np.where(is_near & (sign * side > 0), values, 0.0).sum(axis=1) for sign in (1, -1)]
    area = height + 2.0 * np.maximum(*halves)
    observed_width = np.maximum(area / (height * _GAUSSIAN_AREA), 1.0)
    camera_width = np.sqrt(np.maximum(observed_width**2 - light.width**2, (0.3 * observed_width) ** 2))
    return np.column_stack([window.first + peak, camera_width, area, np.zeros_like(area)]).astype(np.float64)


def _profiles(window: Window, parameters: Floats, shape: int, light: Light) -> Floats:
    out = np.empty(window.values.shape)
    distance = window.places - parameters[:, CENTRE, None]
    profiles(distance, parameters[:, WIDTH].copy(), light.width, shape, light.triangular, out)
    return out


def _peaks(parameters: Floats, shape: int, light: Light) -> Floats:
    out = np.empty((len(parameters), 1))
    profiles(np.zeros_like(out), parameters[:, WIDTH].copy(), light.width, shape, light.triangular, out)
    return out[:, 0]


# --- fit the wavelength of every element to lamp lines: a smooth surface over bands and columns ------------


BAND_DEGREE = 3
COLUMN_DEGREES = (0, 1, 2, 3, 4)
_TUKEY_SD = 4.685  # standard deviations beyond which Tukey's biweight gives no weight
_ROUNDS = 20
_HALVINGS = 40


@dataclass(frozen=True, eq=False)
class WavelengthMap:
    # Wavelength as a tensor of Chebyshev polynomials in band and column.
    coefficients: Floats  #: (band degree + 1, column degree + 1): [nm]
    #: bands, columns: sizes of the array
    bands: int
    columns: int
    #: First and last column with lamp lines; beyond them the surface is constant
    lit: tuple[int, int]
    residual: float  #: Robust standard deviation of the lines about the surface [nm]

    def at(self, band: ArrayLike, column: ArrayLike) -> Floats:
        # Return the wavelength at fractional bands and columns [nm].
        u, v = self._scaled(np.asarray(band, np.float64), np.asarray(column, np.float64))
        return np.asarray(chebyshev.chebval2d(u, v, self.coefficients))

    def spacing(self, band: ArrayLike, column: ArrayLike) -> Floats:
        # Return ``|d wavelength / d band|`` [nm].
        u, v = self._scaled(np.asarray(band, np.float64), np.asarray(column, np.float64))
        slope = chebyshev.chebder(self.coefficients, axis=0) * (2.0 / max(self.bands - 1, 1))
        return np.asarray(np.abs(chebyshev.chebval2d(u, v, slope)))

    def band_of(self, wavelength: float | Floats, column: Ints) -> Floats:
        # Return the fractional bands of wavelengths [nm] in some columns, to a little beyond the array.
        shape = np.broadcast_shapes(np.shape(wavelength), column.shape)
        low, high = np.full(shape, -0.05 * self.bands - 2.0), np.full(shape, 1.05 * self.bands + 1.0)
        is_rising = self.at(self.bands - 1.0, column) > self.at(0.0, column)
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            is_below = (self.at(middle, column) < wavelength) == is_rising
            low, high = np.where(is_below, middle, low), np.where(is_below, high, middle)
        return np.asarray(0.5 * (low + high))

    def grid(self) -> tuple[Floats, Floats]:
        # Return wavelength and spacing of every element (band, cross_track) [nm].
        band, column = np.meshgrid(np.arange(self.bands), np.arange(self.columns), indexing="ij")
        return self.at(band, column), self.spacing(band, column)

    def _scaled(self, band: Floats, column: Floats) -> tuple[Floats, Floats]:
        band, column = np.broadcast_arrays(band, np.clip(column, *self.lit))
        return 2.0 * band / max(self.bands - 1, 1) - 1.0, 2.0 * column / max(self.columns - 1, 1) - 1.0


def fit_wavelength_map(
    band: Floats, column: Floats, wavelength: Floats, sizes: tuple[int, int], *,
    column_degree: int | None = None, uncertainty: Floats | None = None,
) -> WavelengthMap:  # fmt: skip
    # Return the robust low-order surface through centres of lamp lines; SchemaError if they are too few.
    #
    # ``band`` and ``column`` (line,) are the position of each lamp line, in fractional bands, ``wavelength``
    # (line,) the wavelength of its light [nm], ``uncertainty`` (line,) the standard deviation of its centre
    # [band]; ``sizes`` are bands and columns of the array. ``column_degree`` is the degree of the smile; None
    # for the lowest of 0 to 4 that suffices.
    n_wavelengths = len(np.unique(np.round(wavelength, 6)))
    n_columns = len(np.unique(column))
    degree = min(BAND_DEGREE, n_wavelengths - 2)
    SchemaError.raise_if(
        degree < 1,
        f"lamp lines of {n_wavelengths} wavelengths",
        expected="3 or more for a wavelength map",
        code="lamp-lines-few",
    )
    degrees = [column_degree] if column_degree is not None else [d for d in COLUMN_DEGREES if d < n_columns]
    weight = np.ones_like(band)
    if uncertainty is not None:
        # the monochromator's dial limits the accuracy of bright lamp lines, so their weight is limited
        weight = 1.0 / (uncertainty**2 + max(float(np.median(uncertainty)), 1e-9) ** 2)
        weight /= weight.mean()

    bands, columns = sizes
    u, v = 2.0 * band / max(bands - 1, 1) - 1.0, 2.0 * column / max(columns - 1, 1) - 1.0
    lit = (int(column.min()), int(column.max()))
    best, lowest = None, np.inf
    for trial in degrees:
        shape = (degree + 1, min(trial, max(n_columns - 1, 0)) + 1)
        terms = np.asarray(chebyshev.chebvander2d(u, v, [size - 1 for size in shape]), np.float64)
        coefficients, is_inlier = _robust_fit(terms, wavelength, weight, tolerance=1e-7)
        freedom = max(is_inlier.sum() - terms.shape[1], 1)
        rms = float(np.sqrt(((wavelength - terms @ coefficients)[is_inlier] ** 2).sum() / freedom))
        # Bayesian information criterion, with a lower limit for rounding of counts
        criterion = band.size * 2.0 * np.log(rms + 1e-6) + coefficients.size * np.log(band.size)
        if best is None or criterion < lowest:
            best, lowest = WavelengthMap(coefficients.reshape(shape), bands, columns, lit, rms), criterion
    assert best is not None
    return best


def _robust_fit(terms: Floats, values: Floats, prior: Floats, tolerance: float) -> tuple[Floats, Bools]:
    # Return the coefficients of terms (line, term), and which values have weight: least squares, reweighted
    # by Tukey's biweight until the coefficients change by less than a tolerance.
    tukey, coefficients = np.ones_like(values), np.zeros(terms.shape[1])
    for _ in range(_ROUNDS):
        normal = np.einsum("ni,n,nj->ij", terms, prior * tukey, terms, optimize=True)
        previous, right = coefficients, terms.T @ (prior * tukey * values)
        coefficients = np.linalg.lstsq(normal, right, rcond=None)[0]
        residual = values - terms @ coefficients
        sigma = 1.4826 * float(np.median(np.abs(residual)))
        if sigma < 1e-9 or np.abs(coefficients - previous).max() < tolerance:
            break
        z = residual / (_TUKEY_SD * sigma)
        tukey = np.where(np.abs(z) < 1.0, (1.0 - z**2) ** 2, 0.0)
    return coefficients, tukey > 0


def fit_width(wavelength: Floats, width: Floats, uncertainty: Floats, at: Floats, degree: int = 2) -> Floats:
    # Return the width of every band [nm] by a robust fit to widths of steps, constant beyond them.
    #
    # ``wavelength``, ``width`` and ``uncertainty`` (step,) are of the lamp lines, medians over the columns;
    # ``at`` (band,) are the wavelengths of the result; all in nm.
    low, high = float(wavelength.min()), float(wavelength.max())
    scale = max(high - low, 1.0)
    degree = max(min(degree, len(wavelength) - 2), 0)
    terms = np.asarray(chebyshev.chebvander(2.0 * (wavelength - low) / scale - 1.0, degree), np.float64)
    prior = 1.0 / (uncertainty**2 + max(float(np.median(uncertainty)), 1e-9) ** 2)
    coefficients, _ = _robust_fit(terms, width, prior / prior.mean(), tolerance=0.0)
    return np.asarray(chebyshev.chebval(2.0 * (np.clip(at, low, high) - low) / scale - 1.0, coefficients))
