"""Fit the wavelength of every element to lamp lines: a smooth surface over bands and columns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numpy.polynomial import chebyshev

from hyperpaint.base.arrays import Bools, Floats
from hyperpaint.base.errors import SchemaError

BAND_DEGREE = 3
COLUMN_DEGREES = (0, 1, 2, 3, 4)
_TUKEY_SD = 4.685  # standard deviations beyond which Tukey's biweight gives no weight
_ROUNDS = 20
_HALVINGS = 40


@dataclass(frozen=True, eq=False)
class WavelengthMap:
    """Wavelength as a tensor of Chebyshev polynomials in band and column."""

    coefficients: Floats  #: (band degree + 1, column degree + 1): [nm]
    #: bands, columns: sizes of the array
    bands: int
    columns: int
    #: First and last column with lamp lines; beyond them the surface is constant
    lit: tuple[int, int]
    residual: float  #: Robust standard deviation of the lines about the surface [nm]

    def at(self, band: npt.ArrayLike, column: npt.ArrayLike) -> Floats:
        """Return the wavelength at fractional bands and columns [nm]."""
        u, v = self._scaled(np.asarray(band, np.float64), np.asarray(column, np.float64))
        return np.asarray(chebyshev.chebval2d(u, v, self.coefficients))

    def spacing(self, band: npt.ArrayLike, column: npt.ArrayLike) -> Floats:
        """Return ``|d wavelength / d band|`` [nm]."""
        u, v = self._scaled(np.asarray(band, np.float64), np.asarray(column, np.float64))
        slope = chebyshev.chebder(self.coefficients, axis=0) * (2.0 / max(self.bands - 1, 1))
        return np.asarray(np.abs(chebyshev.chebval2d(u, v, slope)))

    def band_of(self, wavelength: float, column: npt.NDArray[np.int64]) -> Floats:
        """Return the fractional bands of a wavelength [nm] in some columns, to a little beyond the array."""
        low = np.full(column.shape, -0.05 * self.bands - 2.0)
        high = np.full(column.shape, 1.05 * self.bands + 1.0)
        is_rising = self.at(self.bands - 1.0, column) > self.at(0.0, column)
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            is_below = (self.at(middle, column) < wavelength) == is_rising
            low, high = np.where(is_below, middle, low), np.where(is_below, high, middle)
        return np.asarray(0.5 * (low + high))

    def grid(self) -> tuple[Floats, Floats]:
        """Return wavelength and spacing of every element (band, cross_track) [nm]."""
        band, column = np.meshgrid(np.arange(self.bands), np.arange(self.columns), indexing="ij")
        return self.at(band, column), self.spacing(band, column)

    def _scaled(self, band: Floats, column: Floats) -> tuple[Floats, Floats]:
        band, column = np.broadcast_arrays(band, np.clip(column, *self.lit))
        return 2.0 * band / max(self.bands - 1, 1) - 1.0, 2.0 * column / max(self.columns - 1, 1) - 1.0


def fit_wavelength_map(
    band: Floats, column: Floats, wavelength: Floats, sizes: tuple[int, int], *,
    column_degree: int | None = None, uncertainty: Floats | None = None,
) -> WavelengthMap:  # fmt: skip
    """Return the robust low-order surface through centres of lamp lines; SchemaError if they are too few.

    ``band`` and ``column`` (line,) are the position of each lamp line, in fractional bands, ``wavelength``
    (line,) the wavelength of its light [nm], ``uncertainty`` (line,) the standard deviation of its centre
    [band]; ``sizes`` are bands and columns of the array. ``column_degree`` is the degree of the smile; None
    for the lowest of 0 to 4 that suffices.
    """
    n_wavelengths = len(np.unique(np.round(wavelength, 6)))
    n_columns = len(np.unique(column))
    degree = min(BAND_DEGREE, n_wavelengths - 2)
    if degree < 1:
        raise SchemaError(
            f"lamp lines of {n_wavelengths} wavelengths",
            expected="3 or more for a wavelength map",
            code="lamp-lines-few",
        )
    degrees = [column_degree] if column_degree is not None else [d for d in COLUMN_DEGREES if d < n_columns]
    weight = np.ones_like(band)
    if uncertainty is not None:
        # the monochromator's dial limits the accuracy of bright lamp lines, so their weight is limited
        min_uncertainty = max(float(np.median(uncertainty)), 1e-9)
        weight = 1.0 / (uncertainty**2 + min_uncertainty**2)
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
    """Return the width of every band [nm] by a robust fit to widths of steps, constant beyond them.

    ``wavelength``, ``width`` and ``uncertainty`` (step,) are of the lamp lines, medians over the columns;
    ``at`` (band,) are the wavelengths of the result; all in nm.
    """
    low, high = float(wavelength.min()), float(wavelength.max())
    scale = max(high - low, 1.0)
    degree = max(min(degree, len(wavelength) - 2), 0)
    terms = np.asarray(chebyshev.chebvander(2.0 * (wavelength - low) / scale - 1.0, degree), np.float64)
    prior = 1.0 / (uncertainty**2 + max(float(np.median(uncertainty)), 1e-9) ** 2)
    coefficients, _ = _robust_fit(terms, width, prior / prior.mean(), tolerance=0.0)
    clipped = np.clip(at, low, high)
    return np.asarray(chebyshev.chebval(2.0 * (clipped - low) / scale - 1.0, coefficients))
