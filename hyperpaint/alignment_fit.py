"""The least squares behind `hyperpaint.alignment`: arrays in, arrays out, all columns at once."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from .responses import GAUSSIAN_SIGMA, Matching, Responses, matching_operator

__all__ = [
    "FLAGS",
    "Estimate",
    "Fit",
    "IrradianceTable",
    "combined",
    "estimate",
    "fit_columns",
    "irradiance_table",
]

Float = npt.NDArray[np.float64]
Array = npt.NDArray[Any]

SHIFT_STEP = 0.5
"""Distance of the shifts at which irradiance is matched [nm]; splines between are good to 1e-3 nm."""
FACTORS = np.linspace(0.6, 1.6, 9)
"""Widths over the declared ones at which irradiance is matched."""
RESIDUAL_FLOOR = 1e-4
"""Relative departure that numbers of float32 and the matching leave in the best of cases."""
_ITERATIONS = 12
MAX_NOISE_GAIN = 3.0
FLAGS = {"no_data": 1, "too_noisy": 2, "at_limit": 4, "record_too_coarse": 8}
"""Why a column cannot tell."""
_SAME_NOISE = 3.0
"""Ratio of the windows' variances up to which they are taken for one."""


@dataclass(frozen=True)
class IrradianceTable:
    """Irradiance as bands would see it at a grid of shifts and widths.

    Attributes
    ----------
    wavelength : (band,)
        Declared centres [nm].
    shifts : (shift,), factors : (factor,)
        The grid: wavelength minus `wavelength` [nm], width over the declared one [1].
    log : (shift, factor, band)
        Logarithm of irradiance; NaN where the record does not cover a band.
    noise_gain : (factor,)
        Largest noise gain of the operators at a width [1].
    variance : (factor, band)
        Mean square distance from its centre at which a band responds [nm2].
    """

    wavelength: Float
    shifts: Float
    factors: Float
    log: Float
    noise_gain: Float
    variance: Float

    @cached_property
    def splines(self) -> list[Any]:
        """One spline a band that is covered; None for the others."""
        from scipy.interpolate import RectBivariateSpline

        return [
            RectBivariateSpline(self.shifts, self.factors, values) if np.isfinite(values).all() else None
            for values in np.moveaxis(self.log, -1, 0)
        ]

    def at(self, shift: Float, factor: Float, *, dx: int = 0, dy: int = 0) -> Float:
        """Return the logarithm, or a derivative of it, (band, column), at (band, column) and (column,)."""
        made = np.full(shift.shape, np.nan)
        for band, spline in enumerate(self.splines):
            if spline is not None:
                made[band] = spline.ev(shift[band], factor, dx=dx, dy=dy)
        return made

    def variance_at(self, factor: Float) -> Float:
        """Return the variance of the responses (band, column) at widths (column,) [nm2]."""
        place = np.interp(factor, self.factors, np.arange(self.factors.size))
        low = np.minimum(place.astype(np.int64), self.factors.size - 2)
        return np.asarray(
            self.variance[low].T + (place - low) * (self.variance[low + 1] - self.variance[low]).T
        )

    def noise_gain_at(self, factor: Float) -> Float:
        """Return the noise gain at widths (column,) [1]."""
        return np.asarray(np.interp(factor, self.factors, self.noise_gain))


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

    shift: Float
    shift_u: Float
    factor: Float
    factor_u: Float
    correlation: Float
    residual: Float
    residual_declared: Float
    departure: Float
    departure_declared: Float
    at_limit: Array
    noise_gain: Float
    freedom: Array


def irradiance_table(
    spectrometer: Responses, imager: Responses, spectrum: Float, limits: tuple[float, float]
) -> IrradianceTable:
    """Return a spectrum (channel,) as an imager's bands would see it at many shifts and widths.

    Parameters
    ----------
    spectrometer, imager
        Responses of the channels, in order, and of the bands as declared.
    spectrum : (channel,)
        Irradiance, any unit.
    limits
        Lowest and highest shift [nm].
    """
    shifts, operators = _operators(spectrometer, imager, limits)
    log = np.empty((shifts.size, FACTORS.size, imager.wavelength.size))
    missing = ~np.isfinite(spectrum)
    for index, matching in enumerate(operators):
        seen = np.einsum("nbc,c->nb", matching.weights, np.where(missing, 0.0, spectrum))
        touched = (np.abs(matching.weights[..., missing]) > 1e-6).any(axis=-1)
        with np.errstate(invalid="ignore", divide="ignore"):
            log[:, index] = np.where((seen > 0.0) & ~touched, np.log(seen), np.nan)
    gain = np.array([np.nan_to_num(matching.noise_gain).max() for matching in operators])
    variance = np.stack([_variance(_widened(imager, float(factor))) for factor in FACTORS])
    return IrradianceTable(imager.wavelength, shifts, FACTORS, log, gain, variance)


@functools.lru_cache(maxsize=4)
def _operators(
    spectrometer: Responses, imager: Responses, limits: tuple[float, float]
) -> tuple[Float, list[Matching]]:
    """Return the shifts, and the operators at every width; once for all flight lines of a camera."""
    first, last = np.floor(limits[0] / SHIFT_STEP) - 1, np.ceil(limits[1] / SHIFT_STEP) + 1
    shifts = np.arange(first, last + 1) * SHIFT_STEP
    widened = [_widened(imager, float(factor)) for factor in FACTORS]
    return shifts, [matching_operator(spectrometer, bands, shifts) for bands in widened]


def _widened(imager: Responses, factor: float) -> Responses:
    """Return responses of another width; what a slit's pixels are wide does not change."""
    if imager.shape == "tabulated":
        return replace(imager, offset=np.asarray(imager.offset) * factor)
    return replace(imager, fwhm=imager.fwhm * factor)


def _variance(bands: Responses) -> Float:
    """Return the variance of every band's line shape [nm2]."""
    if bands.shape == "slit":
        return np.asarray((bands.fwhm**2 + np.asarray(bands.spacing) ** 2) / 12.0)
    if bands.shape == "tabulated":
        offset, table = np.asarray(bands.offset), np.asarray(bands.table)
        weight = table * np.gradient(offset)
        weight = weight / weight.sum(axis=1, keepdims=True)
        return np.asarray(weight @ offset**2 - (weight @ offset) ** 2)
    return np.asarray((GAUSSIAN_SIGMA * bands.fwhm) ** 2)


@dataclass(frozen=True)
class _Smooth:
    """Takes out of logarithms (band, column) what a polynomial over the bands can explain."""

    used: Array
    basis: Float  # (column, band, power), orthonormal over the used bands
    slopes: Float  # (column, band, power), its derivative [nm-1]

    @classmethod
    def over(cls, wavelength: Float, used: Array, degree: int) -> _Smooth:
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

    def slope(self, values: Float) -> Float:
        """Return the derivative of the smooth curve (band, column) [nm-1]."""
        kept = np.where(self.used, values, 0.0)
        terms = np.einsum("xbp,bx->xp", self.basis, kept)
        return np.asarray(np.einsum("xbp,xp->bx", self.slopes, terms))

    def without(self, values: Float) -> Float:
        """Return the departures, 0 in bands that are not used."""
        kept = np.where(self.used, values, 0.0)
        smooth = np.einsum("xbp,xp->bx", self.basis, np.einsum("xbp,bx->xp", self.basis, kept))
        return np.where(self.used, kept - smooth, 0.0)


def fit_columns(
    table: IrradianceTable, spectrum: Float, declared: Float, degree: int, max_shift: float
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
    columns = spectrum.shape[1]
    covered = np.isfinite(table.log).all(axis=(0, 1)).reshape(-1, 1)
    with np.errstate(invalid="ignore"):
        used = covered & (spectrum > 0.0)
    freedom = used.sum(axis=0) - degree - 3
    told = freedom >= 3
    used = used & told
    log = np.where(used, np.log(np.where(used, spectrum, 1.0)), 0.0)
    smooth = _Smooth.over(table.wavelength, used, degree)

    tilt = np.zeros(spectrum.shape)

    def departure(shift: Float, factor: Float) -> Float:
        return smooth.without(log - table.at(declared + tilt + shift, factor))

    def surface(shift: Float, factor: Float) -> Float:
        ratio = log - table.at(declared + tilt + shift, factor)
        return np.asarray(smooth.slope(ratio) * table.variance_at(factor))

    shift, factor = _coarse(departure, columns, max_shift)
    zero, one = np.zeros(columns), np.ones(columns)
    step = np.zeros((columns, 2))
    for _ in range(_ITERATIONS):
        tilt = surface(shift, factor)
        away = departure(shift, factor)
        normal, right = _normal_equations(table, smooth, declared + tilt + shift, factor, away)
        step = np.clip(_solved(normal, right), (-0.5, -0.1), (0.5, 0.1))
        shift = np.clip(shift + step[:, 0], -max_shift, max_shift)
        factor = np.clip(factor + step[:, 1], FACTORS[0], FACTORS[-1])
    after = departure(shift, factor)
    normal, _ = _normal_equations(table, smooth, declared + tilt + shift, factor, after)
    tilt = surface(zero, one)
    before = departure(zero, one)
    ends = (np.abs(shift) >= max_shift) | (factor <= FACTORS[0]) | (factor >= FACTORS[-1])
    ends |= (np.abs(step) > 1e-3).any(axis=1)
    spread = _uncertainties(after, normal, freedom, told)
    count = np.maximum(freedom, 1)
    return Fit(
        np.where(told, shift, np.nan),
        spread[0],
        np.where(told, factor, np.nan),
        spread[1],
        spread[2],
        np.where(told, np.sqrt((after**2).sum(axis=0) / count), np.nan),
        np.where(told, np.sqrt((before**2).sum(axis=0) / count), np.nan),
        np.where(used, np.expm1(after), np.nan),
        np.where(used, np.expm1(before), np.nan),
        ends & told,
        table.noise_gain_at(factor),
        np.where(told, freedom, 0),
    )


def _coarse(departure: Any, columns: int, max_shift: float) -> tuple[Float, Float]:
    """Return the best of a grid of shifts and widths of every column."""
    best = np.full(columns, np.inf)
    shift, factor = np.zeros(columns), np.ones(columns)
    for trial_shift in np.linspace(-max_shift, max_shift, 2 * int(np.ceil(max_shift / 0.4)) + 1):
        for trial_factor in FACTORS[::2]:
            away = departure(np.full(columns, trial_shift), np.full(columns, trial_factor))
            total = (away**2).sum(axis=0)
            better = total < best
            best = np.where(better, total, best)
            shift = np.where(better, trial_shift, shift)
            factor = np.where(better, trial_factor, factor)
    return shift, factor


def _normal_equations(
    table: IrradianceTable, smooth: _Smooth, shift: Float, factor: Float, away: Float
) -> tuple[Float, Float]:
    """Return the normal matrix (column, 2, 2) and right side (column, 2) of a Gauss-Newton step."""
    slopes = np.stack(
        [
            smooth.without(table.at(shift, factor, dx=1)),
            smooth.without(table.at(shift, factor, dy=1)),
        ]
    )
    return np.einsum("ibx,jbx->xij", slopes, slopes), np.einsum("ibx,bx->xi", slopes, away)


def _solved(normal: Float, right: Float) -> Float:
    """Return the steps (column, 2); a touch of damping keeps those finite where the light has no lines."""
    damping = 1e-12 + 1e-9 * np.trace(normal, axis1=1, axis2=2)
    return np.asarray(np.linalg.solve(normal + damping[:, None, None] * np.eye(2), right[..., None])[..., 0])


def _uncertainties(after: Float, normal: Float, freedom: Array, told: Array) -> tuple[Float, Float, Float]:
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
    lost = np.full(told.shape, np.nan)
    return (
        np.where(told, shift_u, lost),
        np.where(told, factor_u, lost),
        np.where(told, correlation, lost),
    )


@dataclass(frozen=True)
class Estimate:
    """Shift [nm] and width factor [1] of every column with their covariance, and what goes with them."""

    value: Float  # (column, 2)
    covariance: Float  # (column, 2, 2)
    shift: Float  # (column,), declared [nm]
    fwhm: float  # declared [nm]
    centre: float  # mean wavelength of the bands [nm]
    residual: Float
    residual_declared: Float
    freedom: Array
    flag: Array
    chi2: Float


def estimate(fit: Fit, inside: Array, known: Mapping[str, Any], shift: Float) -> Estimate:
    """Return what one window tells; its flags but that of noise, which is for the mean to decide."""
    flag = np.where(np.isfinite(fit.shift), 0, FLAGS["no_data"])
    flag |= np.where(fit.at_limit, FLAGS["at_limit"], 0)
    with np.errstate(invalid="ignore"):
        flag |= np.where(fit.noise_gain > MAX_NOISE_GAIN, FLAGS["record_too_coarse"], 0)
        common = fit.correlation * fit.shift_u * fit.factor_u
        covariance = np.array([[fit.shift_u**2, common], [common, fit.factor_u**2]])
    return Estimate(
        np.stack([fit.shift, fit.factor], axis=1),
        np.moveaxis(covariance, -1, 0),
        shift[inside].mean(axis=0),
        float(known["fwhm"][inside].mean()),
        float(known["wavelength"][inside].mean()),
        fit.residual,
        fit.residual_declared,
        fit.freedom,
        flag.astype(np.uint8),
        np.full(fit.shift.shape, np.nan),
    )


def combined(windows: list[Estimate]) -> Estimate:
    """Return the mean of the windows that can tell, weighted with the inverse of their covariances."""
    value = np.stack([each.value for each in windows])
    covariance = np.stack([each.covariance for each in windows])
    flag = np.stack([each.flag for each in windows])
    told = (flag == 0) & np.isfinite(covariance).all(axis=(2, 3))
    covariance = covariance * _one_noise(windows, told)[..., None, None]
    # where no window can tell, the first says why
    told[0] |= ~told.any(axis=0)
    plain = np.where(told[..., None, None] & np.isfinite(covariance), covariance, np.eye(2))
    weight = np.where(told[..., None, None], np.linalg.inv(plain), 0.0)
    total = np.linalg.inv(weight.sum(axis=0))
    seen = np.where(told[..., None], value, 0.0)
    mean = np.einsum("xij,wxjk,wxk->xi", total, weight, seen)
    away = seen - mean
    freedom = 2 * (told.sum(axis=0) - 1)
    chi2 = np.einsum("wxi,wxij,wxj->x", away, weight, away)
    single = told.sum(axis=0) == 1
    only = np.argmax(told, axis=0)
    columns = np.arange(single.size)

    def average(name: str) -> Float:
        return np.asarray(np.mean(np.stack([getattr(each, name) for each in windows]), axis=0))

    return Estimate(
        mean,
        np.where(single[:, None, None], covariance[only, columns], total),
        average("shift"),
        float(np.mean([each.fwhm for each in windows])),
        float(np.mean([each.centre for each in windows])),
        _pooled(windows, told, "residual"),
        _pooled(windows, told, "residual_declared"),
        np.stack([np.where(t, each.freedom, 0) for each, t in zip(windows, told, strict=True)]).sum(axis=0),
        np.where(single, flag[only, columns], 0).astype(np.uint8),
        np.where(freedom > 0, chi2 / np.maximum(freedom, 1), np.nan),
    )


def _pooled(windows: list[Estimate], told: Array, name: str) -> Float:
    """Return a residual (column,) over the windows that can tell."""
    freedom = np.where(told, np.stack([each.freedom for each in windows]), 0)
    square = np.where(told, np.stack([getattr(each, name) for each in windows]) ** 2, 0.0)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.sqrt((freedom * square).sum(axis=0) / freedom.sum(axis=0)))


def _one_noise(windows: list[Estimate], told: Array) -> Float:
    """Return the pooled variance over each window's own (window, column); 1 where they differ too much.

    Variances from a few tens of bands are uncertain by a third, and would make weights as uncertain.
    """
    own = np.where(
        told, np.stack([np.maximum(each.residual, RESIDUAL_FLOOR) for each in windows]) ** 2, np.nan
    )
    pooled = np.maximum(_pooled(windows, told, "residual"), RESIDUAL_FLOOR) ** 2
    with np.errstate(invalid="ignore", all="ignore"):
        largest, least = (np.where(told, own, end) for end in (-np.inf, np.inf))
        alike = largest.max(axis=0) <= _SAME_NOISE * least.min(axis=0)
        return np.asarray(np.where(told & alike, pooled / own, 1.0))
