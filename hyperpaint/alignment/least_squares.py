"""Shift and width of every column by least squares in windows of the spectrum, and their mean."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np

from hyperpaint.base.arrays import Array, Floats
from hyperpaint.base.errors import Problems, SchemaError

from .lamp import FACTORS, Declared, IrradianceTable

#: Least relative residual, by float32 and the matching [1].
RESIDUAL_FLOOR = 1e-4
_ITERATIONS = 12
MIN_FREEDOM = 3


@dataclass(frozen=True)
class Fit:
    """Result of one window of bands for every column; NaN where a column has too few bands."""

    # shift, shift_u, factor, factor_u, correlation (column,): Wavelength minus the declared one [nm] and
    # width over the declared one [1], with their standard uncertainties and the correlation of their errors
    shift: Floats
    shift_u: Floats
    factor: Floats
    factor_u: Floats
    correlation: Floats
    # residual, residual_declared (column,): Relative departure from a smooth curve, root mean square over
    # the degrees of freedom, at the best and at the declared values
    residual: Floats
    residual_declared: Floats
    # departure, departure_declared (band, column): The same band by band
    departure: Floats
    departure_declared: Floats
    at_limit: Array  # (column,): True where the optimum is at an end of the search, or was not reached
    noise_gain: Floats  # (column,): Largest noise gain of the operators at the fitted width [1]
    freedom: Array  # (column,): Degrees of freedom: bands beyond the fitted parameters


@dataclass(frozen=True, eq=False)
class _Optimum:
    # shift, factor (column,): [nm], [1]
    shift: Floats
    factor: Floats
    tilt: Floats  # (band, column): shift equivalent to the surface's slope [nm]
    last_step: Floats  # (column, 2): of shift and factor; 0 where the optimum was reached


@dataclass(frozen=True)
class _Smooth:
    # Projection of logarithms (band, column) onto polynomials over the bands
    used: Array
    basis: Floats  # (column, band, power), orthonormal over the used bands
    slopes: Floats  # (column, band, power), its derivative [nm-1]

    @classmethod
    def over(cls, wavelength: Floats, used: Array, degree: int) -> _Smooth:
        scale = np.ptp(wavelength) / 2.0
        place = (wavelength - wavelength.min()) / scale - 1.0
        powers = np.polynomial.legendre.legvander(place, degree)
        polynomials = [np.polynomial.Legendre.basis(power) for power in range(degree + 1)]
        derivatives = np.stack([polynomial.deriv()(place) for polynomial in polynomials], axis=-1)
        basis, upper = np.linalg.qr(used.T[:, :, None] * powers)
        upper = np.where(used.any(axis=0).reshape(-1, 1, 1), upper, np.eye(degree + 1))
        return cls(used, basis, derivatives / scale @ np.linalg.inv(upper))

    def slope(self, values: Floats) -> Floats:
        # Derivative of the smooth curve (band, column) [nm-1]
        terms = np.einsum("xbp,bx->xp", self.basis, np.where(self.used, values, 0.0))
        return np.asarray(np.einsum("xbp,xp->bx", self.slopes, terms))

    def without(self, values: Floats) -> Floats:
        usable = np.where(self.used, values, 0.0)
        smooth = np.einsum("xbp,xp->bx", self.basis, np.einsum("xbp,bx->xp", self.basis, usable))
        return np.where(self.used, usable - smooth, 0.0)


@dataclass(frozen=True, eq=False)
class _Ratio:
    # Logarithm of radiance over irradiance (band, column) at trial shifts and widths (column,).
    # `tilt` (band, column) [nm] is the shift equivalent to the surface's own slope.
    table: IrradianceTable
    smooth: _Smooth
    log: Floats  # (band, column), of radiance
    declared: Floats  # (band, column), shift [nm]

    def departure(self, tilt: Floats, shift: Floats, factor: Floats) -> Floats:
        # Its departure from a smooth curve (band, column)
        return self.smooth.without(self._at(tilt, shift, factor))

    def tilt(self, tilt: Floats, shift: Floats, factor: Floats) -> Floats:
        # Next tilt (band, column) [nm] from the slope of the smooth curve
        return np.asarray(self.smooth.slope(self._at(tilt, shift, factor)) * self.table.variance_at(factor))

    def normal_equations(
        self, tilt: Floats, shift: Floats, factor: Floats, away: Floats
    ) -> tuple[Floats, Floats]:
        # Normal matrix (column, 2, 2) and right side (column, 2) of a Gauss-Newton step
        place = self.declared + tilt + shift
        derivatives = (self.table.at(place, factor, dx=1), self.table.at(place, factor, dy=1))
        slopes = np.stack([self.smooth.without(derivative) for derivative in derivatives])
        return np.einsum("ibx,jbx->xij", slopes, slopes), np.einsum("ibx,bx->xi", slopes, away)

    def _at(self, tilt: Floats, shift: Floats, factor: Floats) -> Floats:
        return self.log - self.table.at(self.declared + tilt + shift, factor)


def fewest_bands(degree: int) -> int:
    """Return the number of bands that a fit needs: polynomial, shift and width, and some to spare."""
    return degree + 1 + 2 + MIN_FREEDOM


def fit_columns(
    table: IrradianceTable, spectrum: Floats, declared: Floats, degree: int, max_shift: float
) -> Fit:
    """Find the shift and the width of every column at which radiance over irradiance is smooth.

    ``table``: logarithm of irradiance; ``spectrum`` (band, column): mean radiance of every column, any scale;
    NaN where an element is bad; ``declared`` (band, column): declared shifts [nm]; ``degree``: of the
    polynomial; ``max_shift``: how far from the declared shifts to look [nm].

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
    freedom = used.sum(axis=0) - fewest_bands(degree) + MIN_FREEDOM
    used = used & has_bands
    log = np.where(used, np.log(np.where(used, spectrum, 1.0)), 0.0)
    ratio = _Ratio(table, _Smooth.over(table.wavelength, used, degree), log, declared)
    return _reported(ratio, _search(ratio, max_shift), has_bands, freedom, max_shift)


def _search(ratio: _Ratio, max_shift: float) -> _Optimum:
    tilt: Floats = np.zeros(ratio.log.shape)
    # the best of a grid of shifts and widths: absorption bands cause several minima
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
    # Gauss-Newton, damped a little so that steps stay finite where the light has no structure
    step = np.zeros((shift.size, 2))
    for _ in range(_ITERATIONS):
        tilt = ratio.tilt(tilt, shift, factor)
        away = ratio.departure(tilt, shift, factor)
        normal, right = ratio.normal_equations(tilt, shift, factor, away)
        normal = normal + (1e-12 + 1e-9 * np.trace(normal, axis1=1, axis2=2))[:, None, None] * np.eye(2)
        step = np.clip(np.linalg.solve(normal, right[..., None])[..., 0], (-0.5, -0.1), (0.5, 0.1))
        shift = np.clip(shift + step[:, 0], -max_shift, max_shift)
        factor = np.clip(factor + step[:, 1], FACTORS[0], FACTORS[-1])
    return _Optimum(shift, factor, tilt, step)


def _reported(ratio: _Ratio, optimum: _Optimum, has_bands: Array, freedom: Array, max_shift: float) -> Fit:
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


def _uncertainties(
    after: Floats, normal: Floats, freedom: Array, has_bands: Array
) -> tuple[Floats, Floats, Floats]:
    # Standard uncertainties of shift and factor from the residual, and their correlation.
    # Infinite where the light has no lines, NaN where a column has too few bands.
    variance = np.maximum((after**2).sum(axis=0) / np.maximum(freedom, 1), RESIDUAL_FLOOR**2)
    shift, factor, common = normal[:, 0, 0], normal[:, 1, 1], normal[:, 0, 1]
    # written out, so that a column without lines does not make a singular matrix
    determinant = shift * factor - common**2
    with np.errstate(invalid="ignore", divide="ignore"):
        lit = determinant > 0.0
        shift_u = np.where(lit, np.sqrt(variance * factor / determinant), np.inf)
        factor_u = np.where(lit, np.sqrt(variance * shift / determinant), np.inf)
        correlation = np.where(lit, -common / np.sqrt(shift * factor), 0.0)
    shift_u, factor_u, correlation = (
        np.where(has_bands, values, np.nan) for values in (shift_u, factor_u, correlation)
    )
    return shift_u, factor_u, correlation


Window = tuple[float, float]

#: Default windows [nm]: the oxygen A band and the water around 940 nm, without vegetation's red edge.
WINDOWS = ((740.0, 800.0), (890.0, 985.0))
#: Margin by which the irradiance record must exceed a default window [nm].
_RECORD_MARGIN = 15.0
#: Why a column is not used.
FLAGS = {"no_data": 1, "too_noisy": 2, "at_limit": 4, "record_too_coarse": 8}
MAX_NOISE_GAIN = 3.0
#: Ratio of the windows' variances up to which they are pooled.
_SAME_NOISE = 3.0


def default_windows(declared: Declared, degree: int) -> list[Window]:
    """Return the `WINDOWS` that camera and record cover; the first where they cover none."""
    channels = declared.light.wavelength
    covered = [
        (low, high)
        for low, high in WINDOWS
        if _inside(declared, low, high).sum() >= fewest_bands(degree)
        and channels.min() <= low - _RECORD_MARGIN
        and channels.max() >= high + _RECORD_MARGIN
    ]
    return covered or [*WINDOWS[:1]]


def _inside(declared: Declared, low: float, high: float) -> Array:
    # Whether bands are good and lie in a window, (band,) bool
    return declared.good & (declared.wavelength >= low) & (declared.wavelength <= high)


def checked_windows(window: Any) -> list[Window]:
    """Return the windows in the order passed; SchemaError for invalid ones."""
    problems = Problems(f"window={window!r} cannot be used", SchemaError)
    try:
        values = np.asarray(window, np.float64)
    except (TypeError, ValueError):  # texts, or pairs of unlike lengths
        values = np.empty(0)
    if values.ndim not in (1, 2) or values.shape[-1] != 2 or not values.size:
        problems.add(
            "it is not a pair of numbers",
            expected="a lowest and a highest wavelength in nm, or several such pairs",
            code="window-unreadable",
        )
        problems.raise_if_any()
    pairs = [(float(low), float(high)) for low, high in np.atleast_2d(values)]
    for low, high in pairs:
        if not (np.isfinite([low, high]).all() and low < high):
            problems.add(
                f"({low:g}, {high:g})",
                expected="a lowest wavelength below the highest",
                code="window-reversed",
            )
    for (_, high), (low, _) in itertools.pairwise(sorted(pairs)):
        if low < high:
            problems.add(f"windows overlap from {low:g} to {high:g} nm", code="windows-overlap")
    problems.raise_if_any()
    return pairs


def bands_of(windows: list[Window], declared: Declared, degree: int) -> list[Array]:
    """Return whether good bands lie in each window, (band,) bool; SchemaError for too few."""
    chosen = [_inside(declared, low, high) for low, high in windows]
    fewest = fewest_bands(degree)
    problems = Problems("the line cannot be aligned", SchemaError)
    for (low, high), inside in zip(windows, chosen, strict=True):
        if inside.sum() < fewest:
            problems.add(
                f"{low:g} to {high:g} nm holds {inside.sum()} good bands",
                expected=f"at least {fewest} for a polynomial of degree {degree}, shift and width",
                mend="widen the window or lower degree=",
                code="bands-too-few",
            )
    problems.raise_if_any()
    return chosen


@dataclass(frozen=True)
class Estimate:
    """Shift [nm] and width factor [1] of every column with their covariance, residuals and flags."""

    value: Floats  # (column, 2)
    covariance: Floats  # (column, 2, 2)
    shift: Floats  # (column,), declared [nm]
    fwhm: float  # declared [nm]
    centre: float  # mean wavelength of the bands [nm]
    residual: Floats
    residual_declared: Floats
    freedom: Array
    flag: Array
    chi2: Floats


def estimate(fit: Fit, inside: Array, declared: Declared, shift: Floats) -> Estimate:
    """Return the estimate of one window, without the flag of noise, which depends on the mean of windows."""
    flag = np.where(np.isfinite(fit.shift), 0, FLAGS["no_data"])
    flag |= np.where(fit.at_limit, FLAGS["at_limit"], 0)
    with np.errstate(invalid="ignore"):
        flag |= np.where(fit.noise_gain > MAX_NOISE_GAIN, FLAGS["record_too_coarse"], 0)
        common = fit.correlation * fit.shift_u * fit.factor_u
        covariance = np.array([[fit.shift_u**2, common], [common, fit.factor_u**2]])
    return Estimate(
        value=np.stack([fit.shift, fit.factor], axis=1),
        covariance=np.moveaxis(covariance, -1, 0),
        shift=shift[inside].mean(axis=0),
        fwhm=float(declared.fwhm[inside].mean()),
        centre=float(declared.wavelength[inside].mean()),
        residual=fit.residual,
        residual_declared=fit.residual_declared,
        freedom=fit.freedom,
        flag=flag.astype(np.uint8),
        chi2=np.full(fit.shift.shape, np.nan),
    )


def stacked(estimates: list[Estimate], name: str) -> Array:
    """Return a field of several estimates as one array (estimate, ...)."""
    return np.stack([getattr(estimate, name) for estimate in estimates])


def combined(windows: list[Estimate]) -> Estimate:
    """Return the mean of the reliable windows, weighted with the inverse of their covariances."""
    value, covariance, flag = (stacked(windows, name) for name in ("value", "covariance", "flag"))
    is_reliable = (flag == 0) & np.isfinite(covariance).all(axis=(2, 3))
    covariance = covariance * _one_noise(windows, is_reliable)[..., None, None]
    # where no window is reliable, report the flags of the first
    is_reliable[0] |= ~is_reliable.any(axis=0)
    plain = np.where(is_reliable[..., None, None] & np.isfinite(covariance), covariance, np.eye(2))
    weight = np.where(is_reliable[..., None, None], np.linalg.inv(plain), 0.0)
    total = np.linalg.inv(weight.sum(axis=0))
    used = np.where(is_reliable[..., None], value, 0.0)
    mean = np.einsum("xij,wxjk,wxk->xi", total, weight, used)
    away = used - mean
    chi2 = np.einsum("wxi,wxij,wxj->x", away, weight, away)
    freedom = 2 * (is_reliable.sum(axis=0) - 1)
    # a single reliable window gives its own covariance and flag
    single, only = is_reliable.sum(axis=0) == 1, np.argmax(is_reliable, axis=0)
    columns = np.arange(is_reliable.shape[1])
    return Estimate(
        value=mean,
        covariance=np.where(single[:, None, None], covariance[only, columns], total),
        shift=np.mean(stacked(windows, "shift"), axis=0),
        fwhm=float(np.mean([window.fwhm for window in windows])),
        centre=float(np.mean([window.centre for window in windows])),
        residual=_pooled(windows, is_reliable, "residual"),
        residual_declared=_pooled(windows, is_reliable, "residual_declared"),
        freedom=np.where(is_reliable, stacked(windows, "freedom"), 0).sum(axis=0),
        flag=np.where(single, flag[only, columns], 0).astype(np.uint8),
        chi2=np.where(freedom > 0, chi2 / np.maximum(freedom, 1), np.nan),
    )


def _pooled(windows: list[Estimate], is_reliable: Array, name: str) -> Floats:
    # A residual (column,) pooled over the reliable windows
    freedom = np.where(is_reliable, stacked(windows, "freedom"), 0)
    square = np.where(is_reliable, stacked(windows, name) ** 2, 0.0)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.sqrt((freedom * square).sum(axis=0) / freedom.sum(axis=0)))


def _one_noise(windows: list[Estimate], is_reliable: Array) -> Floats:
    # Pooled variance over each window's own (window, column); 1 where they differ too much.
    # Variances from a few tens of bands are uncertain by a third, and would make weights as uncertain.
    own = np.where(is_reliable, np.maximum(stacked(windows, "residual"), RESIDUAL_FLOOR) ** 2, np.nan)
    pooled = np.maximum(_pooled(windows, is_reliable, "residual"), RESIDUAL_FLOOR) ** 2
    with np.errstate(invalid="ignore", all="ignore"):
        largest, least = (np.where(is_reliable, own, end) for end in (-np.inf, np.inf))
        alike = largest.max(axis=0) <= _SAME_NOISE * least.min(axis=0)
        return np.asarray(np.where(is_reliable & alike, pooled / own, 1.0))
