"""Shift and width of every column by least squares: arrays in, arrays out, all columns at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hyperpaint.base.arrays import Array, Floats

from .lamp import FACTORS, IrradianceTable

__all__ = ["RESIDUAL_FLOOR", "Fit", "fewest_bands", "fit_columns"]


RESIDUAL_FLOOR = 1e-4
"""Relative departure that numbers of float32 and the matching leave in the best of cases."""
_ITERATIONS = 12
_FEWEST_FREEDOM = 3


@dataclass(frozen=True)
class Fit:
    """What one window of bands tells of every column; NaN where it tells nothing.

    Attributes
    ----------
    shift, shift_u, factor, factor_u, correlation : (column,)
        Wavelength minus the declared one [nm] and width over the declared one [1], with their standard
        uncertainties and the correlation of their errors.
    residual, residual_declared : (column,)
        Relative departure from a smooth curve, root mean square over the degrees of freedom, at the best and
        at the declared values.
    departure, departure_declared : (band, column)
        The same band by band.
    at_limit : (column,)
        True where the best lies at an end of the search, or was not reached.
    noise_gain : (column,)
        Largest noise gain of the operators at the width found [1].
    freedom : (column,)
        Bands more than what is fitted.
    """

    shift: Floats
    shift_u: Floats
    factor: Floats
    factor_u: Floats
    correlation: Floats
    residual: Floats
    residual_declared: Floats
    departure: Floats
    departure_declared: Floats
    at_limit: Array
    noise_gain: Floats
    freedom: Array


@dataclass(frozen=True, eq=False)
class _Optimum:
    """Where the search ended.

    Attributes
    ----------
    shift, factor : (column,)
        [nm], [1].
    tilt : (band, column)
        Shift that the surface's slope acts as there [nm].
    last_step : (column, 2)
        Of shift and factor; none where the optimum was reached.
    """

    shift: Floats
    factor: Floats
    tilt: Floats
    last_step: Floats


@dataclass(frozen=True)
class _Smooth:
    """Takes out of logarithms (band, column) what a polynomial over the bands can explain."""

    used: Array
    basis: Floats  # (column, band, power), orthonormal over the used bands
    slopes: Floats  # (column, band, power), its derivative [nm-1]

    @classmethod
    def over(cls, wavelength: Floats, used: Array, degree: int) -> _Smooth:
        scale = np.ptp(wavelength) / 2.0
        place = (wavelength - wavelength.min()) / scale - 1.0
        powers = np.polynomial.legendre.legvander(place, degree)
        derivatives = np.stack(
            [
                np.polynomial.legendre.legval(place, np.polynomial.legendre.legder(row))
                for row in np.eye(degree + 1)
            ],
            axis=-1,
        )
        basis, upper = np.linalg.qr(used.T[:, :, None] * powers)
        upper = np.where(used.any(axis=0).reshape(-1, 1, 1), upper, np.eye(degree + 1))
        return cls(used, basis, derivatives / scale @ np.linalg.inv(upper))

    def slope(self, values: Floats) -> Floats:
        """Return the derivative of the smooth curve (band, column) [nm-1]."""
        usable = np.where(self.used, values, 0.0)
        terms = np.einsum("xbp,bx->xp", self.basis, usable)
        return np.asarray(np.einsum("xbp,xp->bx", self.slopes, terms))

    def without(self, values: Floats) -> Floats:
        """Return the departures, 0 in bands that are not used."""
        usable = np.where(self.used, values, 0.0)
        smooth = np.einsum("xbp,xp->bx", self.basis, np.einsum("xbp,bx->xp", self.basis, usable))
        return np.where(self.used, usable - smooth, 0.0)


@dataclass(frozen=True, eq=False)
class _Ratio:
    """Logarithm of radiance over irradiance (band, column) at trial shifts and widths (column,).

    Of either, ``tilt`` (band, column) [nm] is the shift that the surface's own slope acts as.
    """

    table: IrradianceTable
    smooth: _Smooth
    log: Floats  # (band, column), of radiance
    declared: Floats  # (band, column), shift [nm]

    def departure(self, tilt: Floats, shift: Floats, factor: Floats) -> Floats:
        """Return its departure from a smooth curve (band, column)."""
        return self.smooth.without(self._at(tilt, shift, factor))

    def tilt(self, tilt: Floats, shift: Floats, factor: Floats) -> Floats:
        """Return the next tilt (band, column) [nm] from the slope of the smooth curve."""
        return np.asarray(self.smooth.slope(self._at(tilt, shift, factor)) * self.table.variance_at(factor))

    def normal_equations(
        self, tilt: Floats, shift: Floats, factor: Floats, away: Floats
    ) -> tuple[Floats, Floats]:
        """Return the normal matrix (column, 2, 2) and right side (column, 2) of a Gauss-Newton step."""
        place = self.declared + tilt + shift
        slopes = np.stack(
            [
                self.smooth.without(self.table.at(place, factor, dx=1)),
                self.smooth.without(self.table.at(place, factor, dy=1)),
            ]
        )
        return np.einsum("ibx,jbx->xij", slopes, slopes), np.einsum("ibx,bx->xi", slopes, away)

    def _at(self, tilt: Floats, shift: Floats, factor: Floats) -> Floats:
        return self.log - self.table.at(self.declared + tilt + shift, factor)


def fewest_bands(degree: int) -> int:
    """Return how many bands a fit needs: for the polynomial, shift and width, and some to spare."""
    return degree + 1 + 2 + _FEWEST_FREEDOM


def fit_columns(
    table: IrradianceTable, spectrum: Floats, declared: Floats, degree: int, max_shift: float
) -> Fit:
    """Find the shift and the width of every column at which radiance over irradiance is smooth.

    Parameters
    ----------
    table
        Logarithm of irradiance.
    spectrum : (band, column)
        Mean radiance of every column, any scale; NaN where an element is bad.
    declared : (band, column)
        Declared shifts [nm].
    degree
        Of the polynomial.
    max_shift
        How far from the declared shifts to look [nm].

    Notes
    -----
    Where the surface's spectrum has a slope g, a band of variance v sees it brighter on one side of its
    centre, which acts as a shift g v (exactly so for a Gaussian): it is taken out with the slope of the
    smooth curve.

    A coarse search over the table, since absorption lines make several valleys, then Gauss-Newton.
    Logarithms, because the surface's spectrum is then additive and drops out by projection, and because
    relative noise has no gradient in them: at a relative noise s the ratio itself would be biased by s
    squared.
    """
    covered = np.isfinite(table.log).all(axis=(0, 1)).reshape(-1, 1)
    with np.errstate(invalid="ignore"):
        used = covered & (spectrum > 0.0)
    has_bands = used.sum(axis=0) >= fewest_bands(degree)
    freedom = used.sum(axis=0) - fewest_bands(degree) + _FEWEST_FREEDOM
    used = used & has_bands
    log = np.where(used, np.log(np.where(used, spectrum, 1.0)), 0.0)
    ratio = _Ratio(table, _Smooth.over(table.wavelength, used, degree), log, declared)
    return _reported(ratio, _search(ratio, max_shift), has_bands, freedom, max_shift)


def _search(ratio: _Ratio, max_shift: float) -> _Optimum:
    """Return where the departures are least."""
    tilt = np.zeros(ratio.log.shape)
    shift, factor = _coarse(ratio, tilt, max_shift)
    step = np.zeros((shift.size, 2))
    for _ in range(_ITERATIONS):
        tilt = ratio.tilt(tilt, shift, factor)
        away = ratio.departure(tilt, shift, factor)
        normal, right = ratio.normal_equations(tilt, shift, factor, away)
        step = np.clip(_solved(normal, right), (-0.5, -0.1), (0.5, 0.1))
        shift = np.clip(shift + step[:, 0], -max_shift, max_shift)
        factor = np.clip(factor + step[:, 1], FACTORS[0], FACTORS[-1])
    return _Optimum(shift, factor, tilt, step)


def _coarse(ratio: _Ratio, tilt: Floats, max_shift: float) -> tuple[Floats, Floats]:
    """Return the best of a grid of shifts and widths of every column."""
    columns = tilt.shape[1]
    best = np.full(columns, np.inf)
    shift, factor = np.zeros(columns), np.ones(columns)
    for trial_shift in np.linspace(-max_shift, max_shift, 2 * int(np.ceil(max_shift / 0.4)) + 1):
        for trial_factor in FACTORS[::2]:
            away = ratio.departure(tilt, np.full(columns, trial_shift), np.full(columns, trial_factor))
            total = (away**2).sum(axis=0)
            better = total < best
            best = np.where(better, total, best)
            shift = np.where(better, trial_shift, shift)
            factor = np.where(better, trial_factor, factor)
    return shift, factor


def _reported(ratio: _Ratio, optimum: _Optimum, has_bands: Array, freedom: Array, max_shift: float) -> Fit:
    """Return the fit with its uncertainties, beside what the declared values leave."""
    shift, factor, used = optimum.shift, optimum.factor, ratio.smooth.used
    after = ratio.departure(optimum.tilt, shift, factor)
    normal, _ = ratio.normal_equations(optimum.tilt, shift, factor, after)
    zero, one = np.zeros_like(shift), np.ones_like(shift)
    before = ratio.departure(ratio.tilt(optimum.tilt, zero, one), zero, one)
    ends = (np.abs(shift) >= max_shift) | (factor <= FACTORS[0]) | (factor >= FACTORS[-1])
    ends |= (np.abs(optimum.last_step) > 1e-3).any(axis=1)
    shift_u, factor_u, correlation = _uncertainties(after, normal, freedom, has_bands)

    def residual(departure: Floats) -> Floats:
        return np.where(has_bands, np.sqrt((departure**2).sum(axis=0) / np.maximum(freedom, 1)), np.nan)

    return Fit(
        shift=np.where(has_bands, shift, np.nan),
        shift_u=shift_u,
        factor=np.where(has_bands, factor, np.nan),
        factor_u=factor_u,
        correlation=correlation,
        residual=residual(after),
        residual_declared=residual(before),
        departure=np.where(used, np.expm1(after), np.nan),
        departure_declared=np.where(used, np.expm1(before), np.nan),
        at_limit=ends & has_bands,
        noise_gain=ratio.table.noise_gain_at(factor),
        freedom=np.where(has_bands, freedom, 0),
    )


def _solved(normal: Floats, right: Floats) -> Floats:
    """Return the steps (column, 2); a touch of damping keeps those finite where the light has no lines."""
    damping = 1e-12 + 1e-9 * np.trace(normal, axis1=1, axis2=2)
    return np.asarray(np.linalg.solve(normal + damping[:, None, None] * np.eye(2), right[..., None])[..., 0])


def _uncertainties(
    after: Floats, normal: Floats, freedom: Array, has_bands: Array
) -> tuple[Floats, Floats, Floats]:
    """Return the standard uncertainties of shift and factor from the residual, and their correlation.

    Infinite where the light has no lines, NaN where a column tells nothing.
    """
    variance = np.maximum((after**2).sum(axis=0) / np.maximum(freedom, 1), RESIDUAL_FLOOR**2)
    shift, factor, common = normal[:, 0, 0], normal[:, 1, 1], normal[:, 0, 1]
    # written out, so that a column without lines does not make a singular matrix
    determinant = shift * factor - common**2
    with np.errstate(invalid="ignore", divide="ignore"):
        lit = determinant > 0.0
        shift_u = np.where(lit, np.sqrt(variance * factor / determinant), np.inf)
        factor_u = np.where(lit, np.sqrt(variance * shift / determinant), np.inf)
        correlation = np.where(lit, -common / np.sqrt(shift * factor), 0.0)
    lost = np.full(has_bands.shape, np.nan)
    return (
        np.where(has_bands, shift_u, lost),
        np.where(has_bands, factor_u, lost),
        np.where(has_bands, correlation, lost),
    )
