"""Wavelengths and widths of the camera in flight, from absorption bands of the daylight.

The irradiance record and the scene show the same absorption bands. Spectra of paint are smooth over
some tens of nanometres. Where the ratio of radiance to matched irradiance is not smooth, the camera's
wavelengths or widths differ from the declared ones. The check is relative to the irradiance spectrometer, as
reflectance is.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.facts import documented, takes_quantities
from hyperpaint.base.schema import (
    ALONG_TRACK,
    BAND,
    CROSS_TRACK,
    VARIABLES,
    Array,
    Floats,
    Ints,
    Progress,
    rename_to_roles,
)

from .lamp import (
    FACTORS,
    Declared,
    IrradianceTable,
    mean_light,
    mean_over_lines,
    radiance_of_bands,
    smooth_basis,
    table_of_bands,
)

# -- Shift and width of every column by least squares in windows of the spectrum, and their mean.

#: Lower limit of relative residuals, from float32 and matching [1].
RESIDUAL_FLOOR = 1e-4
_FIT_ITERATIONS = 12
MIN_FREEDOM = 3


@dataclass(frozen=True, eq=False)
class _Ratio:
    # Logarithm of radiance over irradiance (band, column) at trial shifts and widths (column,), and its
    # smooth part by projection onto polynomials over the bands.
    # A `tilt` (band, column) [nm] is the shift equivalent to the surface's own slope.
    table: IrradianceTable
    log: Floats  # (band, column), of radiance
    declared: Floats  # (band, column), shift [nm]
    used: Array  # (band, column)
    basis: Floats  # (column, band, power), orthonormal over the used bands
    slopes: Floats  # (column, band, power), its derivative [nm-1]

    def without_smooth(self, values: Floats) -> Floats:
        usable = np.where(self.used, values, 0.0)
        smooth = np.einsum("xbp,bx->xp", self.basis, usable)
        return np.where(self.used, usable - np.einsum("xbp,xp->bx", self.basis, smooth), 0.0)

    def departure(self, tilt: Floats, shift: Floats, factor: Floats) -> Floats:
        # Return the departure of the ratio from a smooth curve (band, column).
        return self.without_smooth(self.log - self.table.at(self.declared + tilt + shift, factor))

    def tilt(self, tilt: Floats, shift: Floats, factor: Floats) -> Floats:
        # Return the next tilt (band, column) [nm], from the slope of the smooth curve [nm-1].
        ratio = self.log - self.table.at(self.declared + tilt + shift, factor)
        terms = np.einsum("xbp,bx->xp", self.basis, np.where(self.used, ratio, 0.0))
        return np.asarray(np.einsum("xbp,xp->bx", self.slopes, terms) * self.table.variance_at(factor))

    def normal_equations(
        self, tilt: Floats, shift: Floats, factor: Floats, departure: Floats
    ) -> tuple[Floats, Floats]:
        # Return normal matrix (column, 2, 2) and right side (column, 2) of a Gauss-Newton step.
        total_shift = self.declared + tilt + shift
        derivatives = (self.table.at(total_shift, factor, dx=1), self.table.at(total_shift, factor, dy=1))
        slopes = np.stack([self.without_smooth(derivative) for derivative in derivatives])
        return np.einsum("ibx,jbx->xij", slopes, slopes), np.einsum("ibx,bx->xi", slopes, departure)


@dataclass(frozen=True)
class Estimate:
    """Shift [nm] and width factor [1] of every column with their covariance, residuals and flags.

    NaN where a column has too few bands.
    """

    value: Floats  # (column, 2): wavelength minus the declared one, and width over the declared one
    covariance: Floats  # (column, 2, 2): of their errors
    shift: Floats  # (column,), declared [nm]
    fwhm: float  # declared [nm]
    centre: float  # mean wavelength of the bands [nm]
    # residual, residual_declared (column,): Relative departure from a smooth curve, root mean square over
    # the degrees of freedom, at the best and at the declared values
    residual: Floats
    residual_declared: Floats
    freedom: Array  # (column,): Degrees of freedom: bands beyond the fitted parameters
    flag: Array  # (column,): without the flag of noise, which depends on the mean of windows
    chi2: Floats  # (column,): of windows against their mean


def fewest_bands(degree: int) -> int:
    # Return the number of bands that a fit needs: polynomial, shift, width, and `MIN_FREEDOM` more.
    return degree + 1 + 2 + MIN_FREEDOM


def fit_columns(
    declared: Declared, table: IrradianceTable, spectrum: Floats, shift: Floats, inside: Array,
    degree: int, max_shift: float,
) -> tuple[Estimate, Floats, Floats]:  # fmt: skip
    # Find the shift and the width of every column at which radiance over irradiance is smooth.
    #
    # ``table``: logarithm of irradiance in the bands of a window; ``spectrum`` (band, column): mean radiance
    # of every column, any scale, NaN where an element is bad; ``shift`` (band, column): declared [nm];
    # ``inside`` (band,): whether bands are in the window; ``degree``: of the polynomial; ``max_shift``: range
    # of the search around the declared shifts [nm]. Returns the estimate of the window, and the relative
    # departures of its bands (band, column) at the best and at the declared values.
    #
    # Where the surface's spectrum has a slope g, a band of variance v gets more light on one side of its
    # centre, which acts as a shift g v (exactly for a Gaussian); it is subtracted with the slope of the
    # smooth curve.
    #
    # A coarse search over the table, since absorption bands cause several minima, then Gauss-Newton.
    # Logarithms are used because the surface's spectrum is then additive and is removed by projection, and
    # because relative noise does not depend on the ratio: with relative noise s the ratio would be biased by
    # s squared.
    radiance = spectrum[inside]
    covered = np.isfinite(table.log).all(axis=(0, 1)).reshape(-1, 1)
    with np.errstate(invalid="ignore"):
        used = covered & (radiance > 0.0)
    has_bands = used.sum(axis=0) >= fewest_bands(degree)
    freedom = used.sum(axis=0) - fewest_bands(degree) + MIN_FREEDOM
    used = used & has_bands
    log = np.where(used, np.log(np.where(used, radiance, 1.0)), 0.0)
    ratio = _Ratio(table, log, shift[inside], used, *smooth_basis(table.wavelength, used, degree))
    # Shift [nm] and factor (column,), tilt (band, column), and the last step of shift and factor
    # (column, 2), which is 0 where the search converged.
    tilt: Floats = np.zeros(ratio.log.shape)
    # the best of a grid of shifts and widths: absorption bands cause several minima
    columns = tilt.shape[1]
    lowest_cost = np.full(columns, np.inf)
    best, factor = np.zeros(columns), np.ones(columns)
    for trial_shift in np.linspace(-max_shift, max_shift, 2 * int(np.ceil(max_shift / 0.4)) + 1):
        for trial_factor in FACTORS[::2]:
            departure = ratio.departure(tilt, np.full(columns, trial_shift), np.full(columns, trial_factor))
            cost = (departure**2).sum(axis=0)
            is_better = cost < lowest_cost
            lowest_cost = np.where(is_better, cost, lowest_cost)
            best = np.where(is_better, trial_shift, best)
            factor = np.where(is_better, trial_factor, factor)
    # Gauss-Newton, slightly damped: steps stay finite where the light has no structure
    last_step = np.zeros((best.size, 2))
    for _ in range(_FIT_ITERATIONS):
        tilt = ratio.tilt(tilt, best, factor)
        departure = ratio.departure(tilt, best, factor)
        matrix, vector = ratio.normal_equations(tilt, best, factor, departure)
        matrix = matrix + (1e-12 + 1e-9 * np.trace(matrix, axis1=1, axis2=2))[:, None, None] * np.eye(2)
        last_step = np.clip(np.linalg.solve(matrix, vector[..., None])[..., 0], (-0.5, -0.1), (0.5, 0.1))
        best = np.clip(best + last_step[:, 0], -max_shift, max_shift)
        factor = np.clip(factor + last_step[:, 1], FACTORS[0], FACTORS[-1])
    at_limit = (np.abs(best) >= max_shift) | (factor <= FACTORS[0]) | (factor >= FACTORS[-1])
    at_limit |= (np.abs(last_step) > 1e-3).any(axis=1)
    departure = ratio.departure(tilt, best, factor)
    zero, one = np.zeros_like(best), np.ones_like(best)
    departure_declared = ratio.departure(ratio.tilt(tilt, zero, one), zero, one)
    # covariance from the residual; infinite where the light has no lines
    matrix, _ = ratio.normal_equations(tilt, best, factor, departure)
    residual, residual_declared = (
        (values**2).sum(axis=0) / np.maximum(freedom, 1) for values in (departure, departure_declared)
    )
    variance = np.maximum(residual, RESIDUAL_FLOOR**2)
    by_shift, by_factor, mixed = matrix[:, 0, 0], matrix[:, 1, 1], matrix[:, 0, 1]
    # explicit inverse: a column without absorption bands would make the matrix singular
    determinant = by_shift * by_factor - mixed**2
    gain = np.interp(factor, table.factors, table.noise_gain)
    with np.errstate(invalid="ignore", divide="ignore"):
        has_structure = determinant > 0.0
        shift_u = np.where(has_structure, np.sqrt(variance * by_factor / determinant), np.inf)
        factor_u = np.where(has_structure, np.sqrt(variance * by_shift / determinant), np.inf)
        common = np.where(has_structure, -mixed / np.sqrt(by_shift * by_factor), 0.0) * shift_u * factor_u
    covariance = np.moveaxis(np.array([[shift_u**2, common], [common, factor_u**2]]), -1, 0)
    flag = np.where(has_bands & np.isfinite(best), 0, FLAGS["no_data"])
    flag |= np.where(at_limit & has_bands, FLAGS["at_limit"], 0)
    flag |= np.where(gain > MAX_NOISE_GAIN, FLAGS["record_too_coarse"], 0)
    estimate = Estimate(
        value=np.where(has_bands[:, None], np.stack([best, factor], axis=1), np.nan),
        covariance=np.where(has_bands[:, None, None], covariance, np.nan),
        shift=ratio.declared.mean(axis=0),
        fwhm=float(declared.fwhm[inside].mean()),
        centre=float(declared.wavelength[inside].mean()),
        residual=np.where(has_bands, np.sqrt(residual), np.nan),
        residual_declared=np.where(has_bands, np.sqrt(residual_declared), np.nan),
        freedom=np.where(has_bands, freedom, 0),
        flag=flag.astype(np.uint8),
        chi2=np.full(best.shape, np.nan),
    )
    best_relative, declared_relative = (
        np.where(used, np.expm1(values), np.nan) for values in (departure, departure_declared)
    )
    return estimate, best_relative, declared_relative


Window = tuple[float, float]

#: Default windows [nm]: the oxygen A band and the water around 940 nm, without vegetation's red edge.
WINDOWS = ((740.0, 800.0), (890.0, 985.0))
#: Margin by which the irradiance record must exceed a default window [nm].
_RECORD_MARGIN = 15.0
#: Reasons why a column is not used.
FLAGS = {"no_data": 1, "too_noisy": 2, "at_limit": 4, "record_too_coarse": 8}
MAX_NOISE_GAIN = 3.0
#: Largest ratio of the windows' variances for which they are pooled.
_MAX_VARIANCE_RATIO = 3.0


def default_windows(declared: Declared, degree: int) -> list[Window]:
    # Return the `WINDOWS` that camera and record cover; the first where they cover none.
    channels = declared.light.wavelength
    covered = [
        (low, high)
        for low, high in WINDOWS
        if _is_inside(declared, low, high).sum() >= fewest_bands(degree)
        and channels.min() <= low - _RECORD_MARGIN
        and channels.max() >= high + _RECORD_MARGIN
    ]
    return covered or [*WINDOWS[:1]]


def _is_inside(declared: Declared, low: float, high: float) -> Array:
    # Return whether bands are good and inside a window (band,).
    return declared.good & (declared.wavelength >= low) & (declared.wavelength <= high)


def checked_windows(window: Any) -> list[Window]:
    # Return the windows in the order passed; SchemaError for invalid ones.
    problems = Problems(f"window={window!r} cannot be used", SchemaError)
    try:
        limits = np.asarray(window, np.float64)
    except (TypeError, ValueError):  # texts, or pairs of unlike lengths
        limits = np.empty(0)
    if limits.ndim not in (1, 2) or limits.shape[-1] != 2 or not limits.size:
        problems.add(
            "it is not a pair of numbers",
            expected="a lowest and a highest wavelength in nm, or several such pairs",
            code="window-unreadable",
        )
        problems.raise_if_any()
    pairs = [(float(low), float(high)) for low, high in np.atleast_2d(limits)]
    for low, high in pairs:
        problems.add_if(
            not (np.isfinite([low, high]).all() and low < high),
            f"({low:g}, {high:g})",
            expected="a lowest wavelength below the highest",
            code="window-reversed",
        )
    for (_, high), (low, _) in itertools.pairwise(sorted(pairs)):
        problems.add_if(low < high, f"windows overlap from {low:g} to {high:g} nm", code="windows-overlap")
    problems.raise_if_any()
    return pairs


def stacked(estimates: list[Estimate], name: str) -> Array:
    # Return a field of several estimates as one array (estimate, ...).
    return np.stack([getattr(estimate, name) for estimate in estimates])


def combined(windows: list[Estimate]) -> Estimate:
    # Return the mean of the reliable windows, weighted with the inverse of their covariances.
    value, covariance, flag = (stacked(windows, name) for name in ("value", "covariance", "flag"))
    is_reliable = (flag == 0) & np.isfinite(covariance).all(axis=(2, 3))
    residual = _pooled(windows, is_reliable, "residual")
    # pooled variance over the variance of each window, where they are alike: variances from a few tens of
    # bands are uncertain by a third, and so would be weights from them
    variance = np.where(is_reliable, np.maximum(stacked(windows, "residual"), RESIDUAL_FLOOR) ** 2, np.nan)
    with np.errstate(all="ignore"):
        largest, smallest = (np.where(is_reliable, variance, limit) for limit in (-np.inf, np.inf))
        is_alike = largest.max(axis=0) <= _MAX_VARIANCE_RATIO * smallest.min(axis=0)
        noise_factor = np.maximum(residual, RESIDUAL_FLOOR) ** 2 / variance
    covariance = covariance * np.where(is_reliable & is_alike, noise_factor, 1.0)[..., None, None]
    # where no window is reliable, report the flags of the first
    is_reliable[0] |= ~is_reliable.any(axis=0)
    finite_covariance = np.where(
        is_reliable[..., None, None] & np.isfinite(covariance), covariance, np.eye(2)
    )
    weight = np.where(is_reliable[..., None, None], np.linalg.inv(finite_covariance), 0.0)
    total = np.linalg.inv(weight.sum(axis=0))
    reliable_values = np.where(is_reliable[..., None], value, 0.0)
    mean = np.einsum("xij,wxjk,wxk->xi", total, weight, reliable_values)
    deviation = reliable_values - mean
    chi2 = np.einsum("wxi,wxij,wxj->x", deviation, weight, deviation)
    freedom = 2 * (is_reliable.sum(axis=0) - 1)
    # a single reliable window gives its own covariance and flag
    is_single, single_window = is_reliable.sum(axis=0) == 1, np.argmax(is_reliable, axis=0)
    columns = np.arange(is_reliable.shape[1])
    return Estimate(
        value=mean,
        covariance=np.where(is_single[:, None, None], covariance[single_window, columns], total),
        shift=np.mean(stacked(windows, "shift"), axis=0),
        fwhm=float(np.mean([window.fwhm for window in windows])),
        centre=float(np.mean([window.centre for window in windows])),
        residual=_pooled(windows, is_reliable, "residual"),
        residual_declared=_pooled(windows, is_reliable, "residual_declared"),
        freedom=np.where(is_reliable, stacked(windows, "freedom"), 0).sum(axis=0),
        flag=np.where(is_single, flag[single_window, columns], 0).astype(np.uint8),
        chi2=np.where(freedom > 0, chi2 / np.maximum(freedom, 1), np.nan),
    )


def _pooled(windows: list[Estimate], is_reliable: Array, name: str) -> Floats:
    # Return a residual (column,) pooled over the reliable windows.
    freedom = np.where(is_reliable, stacked(windows, "freedom"), 0)
    square = np.where(is_reliable, stacked(windows, name) ** 2, 0.0)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.sqrt((freedom * square).sum(axis=0) / freedom.sum(axis=0)))


#: Pixels below which a column is not used.
MIN_PIXELS = 8
#: Units and meaning of reported variables; wavelength_shift and fwhm are in the table.
_REPORTED = {
    "wavelength_shift_u": ("nm", "Standard uncertainty of the wavelength shift"),
    "shift_correction": ("nm", "Measured minus declared wavelength"),
    "fwhm_u": ("nm", "Standard uncertainty of the full width at half maximum"),
    "fwhm_factor": ("1", "Measured over declared full width at half maximum"),
    "correlation": ("1", "Correlation of the errors of shift and width"),
    "residual": ("1", "Relative departure of the ratio from a smooth curve, root mean square"),
    "residual_declared": ("1", "The same with the declared wavelengths and widths"),
    "chi2": ("1", "Chi square of the windows against their mean, over its degrees of freedom"),
    "pixels": ("1", "Pixels averaged"),
    "departure": ("1", "Relative departure of the ratio from a smooth curve"),
    "departure_declared": ("1", "The same with the declared wavelengths and widths"),
    "flag": ("", "Why a column is not reliable"),
}


@takes_quantities(window="nm", max_shift="nm", max_uncertainty="nm")
@documented()
def align_to_irradiance(
    line: xr.Dataset,
    *,
    window: Window | Sequence[Window] | None = None,
    separate: bool = False,
    lines: slice | None = None,
    degree: int = 5,
    group: int = 1,
    max_shift: float = 2.0,
    max_uncertainty: float = 0.1,
    progress: Progress | None = None,
) -> xr.Dataset:
    r"""In-flight spectral calibration: smile and FWHM of every column from lines of the daylight.

    Fits the wavelength shift and the width at which the ratio of radiance to irradiance is smoothest.
    Eager: reads the line once, a slab at a time, and changes nothing; see
    `hyperpaint.alignment.apply_alignment`.

    Parameters
    ----------
    line
        A flight line with what `hyperpaint.radiance` needs, or ``radiance``; ``time`` (along_track),
        ``wavelength`` and ``fwhm`` (band), ``wavelength_shift`` where smile is known, and the irradiance.
    window
        Lowest and highest wavelength [nm], or several such pairs, each with a polynomial of its own:
        (640, 700) holds H-alpha and the oxygen B band, (800, 860) and (890, 985) the water's. By default
        (740, 800) and (890, 985), as far as camera and record cover them.
    separate
        Report every window separately, for a shift or a width that changes with wavelength, instead of their
        weighted mean.
    lines
        Lines to average; all by default.
    degree
        Degree of the polynomial that models the surface's spectrum.
    group
        Neighbouring columns that are averaged together.
    max_shift
        Range of the search around the declared wavelengths [nm].
    max_uncertainty
        Standard uncertainty of the shift above which a column is flagged [nm].
    progress

    Returns
    -------
    Dataset
        By ``cross_track`` (and before it ``window``, with ``separate``), float64, each with ``units``:
        ``wavelength_shift`` and ``fwhm`` as fitted, ``wavelength_shift_u`` and ``fwhm_u``, ``correlation``,
        ``shift_correction`` and ``fwhm_factor`` (measured against declared), ``residual`` and
        ``residual_declared``, ``chi2`` (of the windows against their mean, over its degrees of freedom),
        ``pixels``, ``flag`` (0 where the column is reliable); ``departure`` and ``departure_declared`` (band,
        cross_track): the ratio over its smooth curve minus 1, to inspect. Coordinate ``column``: the mean
        column of a group.

    Raises
    ------
    SchemaError, UnitsError, TimeError
        Variables are missing; the window holds too few bands, or the irradiance record does not cover it or
        no line of the flight; options are out of range. All problems of a kind are listed.

    Notes
    -----
    With :math:`\bar L_b` the mean over lines of radiance over the light's level, and :math:`\bar E` the
    record's mean in the same way, the shift :math:`\delta` and width factor :math:`f` of a column minimise

    .. math:: \sum_b \big( (1 - P) \ln (\bar L_b / \bar E_b(\delta, f)) \big)^2

    where :math:`\bar E_b` is matched to the band's response (`hyperpaint.light.responses.matching_operator`)
    and :math:`P` projects onto polynomials. Pixels with a missing sample in the windows are left out in all
    bands, since means over different pixels would make steps between bands. Uncertainties follow from the
    residual; they do not include structure of surfaces that polynomials cannot fit, such as the beginning of
    vegetation's red edge, nor noise of the irradiance record, which all columns share. The mean over windows
    is weighted by the inverse of their covariances.

    The literature ([1]_, [2]_) matches spectra to a modelled atmosphere; here the irradiance record replaces
    the model.

    References
    ----------
    .. [1] B.-C. Gao, M. J. Montes and C. O. Davis, "Refinement of wavelength calibrations of hyperspectral
       imaging data using a spectrum-matching technique", Remote Sens. Environ. 90, 424-433, 2004.
    .. [2] L. Guanter, R. Richter and J. Moreno, "Spectral calibration of hyperspectral imagery using
       atmospheric absorption features", Appl. Opt. 45, 2360-2370, 2006.

    Examples
    --------
    >>> from hyperpaint.simulation import simulate_line
    >>> line = simulate_line(lines=16, bands=272, columns=3, smile_nm=0.0)
    >>> moved = line.assign_coords(wavelength=line.wavelength - 0.4)
    >>> found = align_to_irradiance(moved)
    >>> bool((abs(found.shift_correction - 0.4) < 0.1).all())
    True
    """
    dataset = rename_to_roles(line)
    problems = Problems("the line cannot be aligned", SchemaError)
    for is_valid, found, expected in (
        (0 <= degree <= 12, f"degree={degree}", "0 to 12"),
        (group >= 1, f"group={group}", "1 or more columns"),
        (0.0 < max_shift <= 10.0, f"max_shift={max_shift:g}", "above 0, at most 10 nm"),
        (max_uncertainty > 0.0, f"max_uncertainty={max_uncertainty:g}", "above 0 nm"),
    ):
        problems.add_if(not is_valid, found, expected=expected, code="value-out-of-range")
    problems.raise_if_any()
    declared = Declared.by(dataset)
    windows = default_windows(declared, degree) if window is None else checked_windows(window)
    # Which bands are good and inside each window (band,); SchemaError for too few.
    inside_windows = [_is_inside(declared, low, high) for low, high in windows]
    fewest = fewest_bands(degree)
    problems = Problems("the line cannot be aligned", SchemaError)
    for (low, high), is_inside in zip(windows, inside_windows, strict=True):
        problems.add_if(
            is_inside.sum() < fewest,
            f"{low:g} to {high:g} nm holds {is_inside.sum()} good bands",
            expected=f"at least {fewest} for a polynomial of degree {degree}, shift and width",
            mend="widen the window or lower degree=",
            code="bands-too-few",
        )
    problems.raise_if_any()
    light, level = mean_light(declared, windows, lines)
    used_bands = np.flatnonzero(np.logical_or.reduce(inside_windows))
    selected = dataset if lines is None else dataset.isel({ALONG_TRACK: lines})
    mean, pixels = mean_over_lines(radiance_of_bands(selected, used_bands), level, progress)
    spectrum = np.full((declared.wavelength.size, mean.shape[1]), np.nan)
    spectrum[used_bands] = mean
    shift = declared.shift(mean.shape[1])
    # Spectra, pixels, shifts and column numbers of groups of neighbouring columns.
    column = np.arange(pixels.size, dtype=np.float64)
    if group > 1:
        starts = np.arange(0, pixels.size, group)
        # leave out columns with a bad element in all bands: otherwise the group's mean would show
        # another surface in the band of that element
        has_band = np.isfinite(spectrum).any(axis=1, keepdims=True)
        weight = np.where(np.isfinite(spectrum).all(axis=0, where=has_band), pixels, 0)
        total = np.add.reduceat(weight, starts)
        size = np.diff(np.append(starts, pixels.size))
        with np.errstate(invalid="ignore", divide="ignore"):
            share = weight / np.repeat(total, size)
        mean = np.add.reduceat(np.where(share > 0, spectrum, 0.0) * share, starts, axis=1)
        spectrum, pixels, shift, column = (
            np.where(has_band & (total > 0), mean, np.nan),
            total,
            np.add.reduceat(shift, starts, axis=1) / size,
            np.add.reduceat(column, starts) / size,
        )
    estimates, departures = [], []
    for is_inside in inside_windows:
        limits = (float(shift[is_inside].min()) - max_shift, float(shift[is_inside].max()) + max_shift)
        table = table_of_bands(declared.light, light, declared.bands(is_inside), limits, fewest_bands(degree))
        estimate, *of_bands = fit_columns(declared, table, spectrum, shift, is_inside, degree, max_shift)
        estimates.append(estimate)
        departures.append(of_bands)
    report = _labelled(estimates if separate else [combined(estimates)], pixels, column, max_uncertainty)
    report = report if separate else report.isel(window=0)
    for number, name in enumerate(("departure", "departure_declared")):
        values = np.full((declared.wavelength.size, report.sizes[CROSS_TRACK]), np.nan)
        for of_bands, is_inside in zip(departures, inside_windows, strict=True):
            values[is_inside] = of_bands[number]
        report[name] = ((BAND, CROSS_TRACK), values, _attrs_of(name))
    attrs = VARIABLES["wavelength"].attrs
    return report.assign_coords(wavelength=(BAND, declared.wavelength, attrs)).assign_attrs(
        window="; ".join(f"{low:g}-{high:g} nm" for low, high in windows),
        degree=degree,
        lines=len(level),
        srf_shape=declared.imager.shape,
    )


def _labelled(estimates: list[Estimate], pixels: Ints, column: Floats, max_uncertainty: float) -> xr.Dataset:
    # Return estimates as a Dataset (window, cross_track), with flags of noise and of few pixels.
    value, covariance, flag = (stacked(estimates, name) for name in ("value", "covariance", "flag"))
    uncertainties = np.sqrt(np.stack([covariance[..., 0, 0], covariance[..., 1, 1]], axis=-1))
    fwhm = np.array([estimate.fwhm for estimate in estimates])[:, None]
    with np.errstate(invalid="ignore"):
        is_noisy = ~(uncertainties[..., 0] <= max_uncertainty) & ~np.isnan(value[..., 0])
        correlation = covariance[..., 0, 1] / (uncertainties[..., 0] * uncertainties[..., 1])
    flag |= np.where(is_noisy, FLAGS["too_noisy"], 0).astype(np.uint8)
    flag |= np.where(pixels < MIN_PIXELS, FLAGS["no_data"], 0).astype(np.uint8)
    columns = {
        "wavelength_shift": value[..., 0] + stacked(estimates, "shift"),
        "wavelength_shift_u": uncertainties[..., 0],
        "shift_correction": value[..., 0],
        "fwhm": value[..., 1] * fwhm,
        "fwhm_u": uncertainties[..., 1] * fwhm,
        "fwhm_factor": value[..., 1],
        "correlation": correlation,
        **{name: stacked(estimates, name) for name in ("residual", "residual_declared", "chi2")},
        "flag": flag,
    }
    dims = ("window", CROSS_TRACK)
    report = xr.Dataset({name: (dims, values, _attrs_of(name)) for name, values in columns.items()})
    report["pixels"] = (CROSS_TRACK, pixels, _attrs_of("pixels"))
    centre_attrs = {"units": "nm", "long_name": "Mean wavelength of the bands of a window"}
    return report.assign_coords(
        column=(CROSS_TRACK, column, {"long_name": "Column, or mean column of a group", "units": "1"}),
        window_centre=("window", [estimate.centre for estimate in estimates], centre_attrs),
    )


def _attrs_of(name: str) -> dict[str, Any]:
    # Return the attributes of a reported variable.
    if name in VARIABLES:
        return VARIABLES[name].attrs
    units, meaning = _REPORTED[name]
    if name == "flag":
        masks = np.array(list(FLAGS.values()), np.uint8)
        return {"long_name": meaning, "flag_masks": masks, "flag_meanings": " ".join(FLAGS)}
    return {"long_name": meaning, "units": units}
