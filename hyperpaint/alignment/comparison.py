"""Compare camera and irradiance record in one flight: their difference in wavelength and in width.

Both measured the same daylight. Spectra of surfaces are smooth over some tens of nanometres; solar
lines and absorption bands are not. Where they remain in radiance over matched irradiance, one of the two
instruments differs from its declaration. A few slabs of lines are read, the same for all chunks.

Wavelengths and widths of the camera in flight, from absorption bands of the daylight.

The irradiance record and the scene show the same absorption bands. Spectra of paint are smooth over
some tens of nanometres. Where the ratio of radiance to matched irradiance is not smooth, the camera's
wavelengths or widths differ from the declared ones. The check is relative to the irradiance spectrometer, as
reflectance is.
"""

import functools
import itertools
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from hyperpaint.base import (
    ALIGNMENTS,
    ALONG_TRACK,
    BAND,
    CROSS_TRACK,
    IRRADIANCE_TIME,
    IRRADIANCE_WAVELENGTH,
    VARIABLES,
    Alignment,
    Array,
    Bools,
    Floats,
    Indices,
    Ints,
    PaintError,
    PaintWarning,
    Problems,
    Progress,
    SchemaError,
    documented,
    has_labels_of,
    label,
    label_digest,
    one_of,
    rename_to_roles,
    require,
    responsivity_slope,
    takes_quantities,
    warn_user,
)
from hyperpaint.light.clear_sky import disort_tables, sunlight_table
from hyperpaint.light.illumination import (
    ALIGNED_AT_NM,
    ALIGNED_PER_NM,
    line_light,
    noise_of_record,
    shift_at,
)
from hyperpaint.light.responses import GAUSSIAN_SIGMA, Matching, Responses, matching_operator
from hyperpaint.radiometry.counts_to_reflectance import radiance, reflectance
from hyperpaint.radiometry.slabs import line_chunked
from hyperpaint.radiometry.stray_light import described

# --- declared bands and irradiance record of a flight line, and the irradiance matched to the bands ---------


#: Number of first lines in which bad elements are detected.
_FIRST_LINES = 64


def radiance_of_bands(dataset: xr.Dataset, used: Indices) -> xr.DataArray:
    # Return radiance of some bands on any scale, lazily; stray light is subtracted with all bands.
    dataset = dataset.assign_attrs(absolute_scale="not needed")  # wavelengths do not depend on the scale
    return (
        radiance(dataset.isel({BAND: used}))["radiance"]
        if described(dataset.variables) is None
        else radiance(dataset)["radiance"].isel({BAND: used})
    )


def mean_over_lines(
    cube: xr.DataArray, level: Floats, progress: Progress | None = None
) -> tuple[Floats, Ints]:
    # Return the mean over lines of a cube over its light's level (band, column), and its number of pixels.
    #
    # One slab is in memory at a time. Lines are added in order, so that the result does not depend
    # on chunks. A pixel counts if all bands are valid, apart from bands without values in all of the first
    # lines, whose mean is NaN.
    cube = line_chunked(cube)
    count = cube.sizes[ALONG_TRACK]
    first_lines = cube[:_FIRST_LINES].values
    has_values = np.isfinite(first_lines).any(axis=1, keepdims=True)
    is_bad = (np.isnan(first_lines) | ~has_values).all(axis=0) & has_values.any(axis=0)
    total = np.zeros(cube.shape[1:])
    scaled = np.empty_like(total)
    pixels = np.zeros(cube.shape[2], np.int64)
    start = 0
    for size in cube.chunks[0] if cube.chunks else (count,):
        stop = start + size
        slab = first_lines[start:stop] if stop <= len(first_lines) else cube[start:stop].values
        for values, light in zip(slab, level[start:stop], strict=True):
            if np.isfinite(light):
                is_complete = (np.isfinite(values) | is_bad).all(axis=0)
                pixels += is_complete
                np.add(total, np.divide(values, light, out=scaled), out=total, where=is_complete & ~is_bad)
        start += size
        if progress is not None:
            progress(start, count)
    with np.errstate(invalid="ignore"):
        return np.where(is_bad | (pixels == 0), np.nan, total / pixels), pixels


#: Intervals beside the oxygen A band, free of it at a width of 6 nm [nm].
SHOULDERS = ((740.0, 753.0), (775.0, 788.0))
#: Weights of bands fall linearly from 1 at this wavelength to 0 at this distance [nm].
CENTRE, REACH = 760.0, 5.0
MIN_SHOULDER_BANDS = 4


@documented()
def oxygen_residual(dataset: xr.Dataset, *, progress: Progress | None = None) -> xr.DataArray:
    r"""Return the residual depth of the oxygen A band in the reflectance of every column.

    Eager: reads the line once, a slab at a time; the result does not depend on chunks.

    Parameters
    ----------
    dataset
        A flight line with ``reflectance`` (along_track, band, cross_track) and ``wavelength`` (band), or with
        the variables that `hyperpaint.reflectance` needs.
    progress

    Returns
    -------
    (cross_track,), float64
        Depth [1]: positive where the band remains in reflectance, negative where it is overcorrected; NaN
        where no pixel has all samples.

    Raises
    ------
    SchemaError, UnitsError
        Variables are missing, or no bands lie in the oxygen band or on one of its shoulders.

    Notes
    -----
    .. math:: d = 1 - \sum_b w_b \bar\rho_b / \rho_{c,b}, \qquad
              w_b \propto \max(0, 1 - |\lambda_b - 760| / 5), \qquad \sum_b w_b = 1

    with :math:`\bar\rho` the mean over lines at the column's own wavelengths, and :math:`\rho_c` the parabola
    through its shoulders, 740-753 and 775-788 nm. 760 nm is on the steep side of the band, where
    shift and width both show: with a 6 nm camera the depth is about -0.06 for each nanometre that declared
    wavelengths are too long, and 0.03 for each that declared widths are too large. The two can cancel;
    `hyperpaint.alignment.align_to_irradiance` separates them.

    Examples
    --------
    >>> from hyperpaint.simulation import simulate_line
    >>> line = simulate_line(lines=8, columns=3, smile_nm=0.0, noise=False)
    >>> moved = line.assign_coords(wavelength=line.wavelength + 0.5)
    >>> bool(abs(oxygen_residual(line)).max() < 0.01 < abs(oxygen_residual(moved)).min())
    True
    """
    dataset = rename_to_roles(dataset)
    if "reflectance" not in dataset.variables:
        dataset = reflectance(dataset)
    arrays = require(
        dataset,
        ["wavelength", "reflectance", *(n for n in ("wavelength_shift",) if n in dataset.variables)],
        "the oxygen residual",
    )
    cube = arrays["reflectance"]
    shift = arrays["wavelength_shift"].values if "wavelength_shift" in arrays else 0.0
    wavelengths = arrays["wavelength"].values[:, None] + np.broadcast_to(
        shift, (cube.sizes[BAND], cube.sizes[CROSS_TRACK])
    )
    shoulders, weight = _parts(wavelengths)
    SchemaError.raise_if(
        not (weight.any(axis=0) & (shoulders.sum(axis=0) >= MIN_SHOULDER_BANDS)).all(),
        "too few bands for the oxygen residual",
        expected=f"one in 755-765 nm and {MIN_SHOULDER_BANDS} in its shoulders, 740-753 and 775-788 nm, "
        "in every column",
        code="bands-too-few",
    )
    used_bands = np.flatnonzero((shoulders | (weight > 0)).any(axis=1))
    mean, _ = mean_over_lines(cube[:, used_bands], np.ones(cube.sizes[ALONG_TRACK]), progress)
    depth = np.array([oxygen_depth(wavelengths[used_bands, x], mean[:, x]) for x in range(mean.shape[1])])
    return xr.DataArray(depth, dims=CROSS_TRACK, name="oxygen_residual").assign_attrs(
        units="1", long_name="Depth of the oxygen A band left in reflectance; negative where overcorrected"
    )


def _parts(wavelength: Floats) -> tuple[Bools, Floats]:
    shoulders = np.logical_or.reduce([(wavelength >= low) & (wavelength <= high) for low, high in SHOULDERS])
    return shoulders, np.clip(1.0 - np.abs(wavelength - CENTRE) / REACH, 0.0, None)


@takes_quantities(wavelength="nm", spectrum="1")
def oxygen_depth(wavelength: Floats, spectrum: Floats) -> float:
    """Return the residual depth of the oxygen A band in one spectrum, see `oxygen_residual`.

    Parameters
    ----------
    wavelength, spectrum : (band,), float64
        [nm], and reflectance [1]; NaN where it is missing.

    Returns
    -------
    float
        Depth [1]; NaN where there are too few bands in it or on its shoulders.

    Examples
    --------
    >>> nm = np.arange(740.0, 781.0, 2.0)
    >>> left = oxygen_depth(nm, 0.3 - 0.03 * np.exp(-(((nm - 761.0) / 3.0) ** 2)))
    >>> abs(oxygen_depth(nm, np.full(nm.size, 0.3))) < 1e-12 < left
    True
    """
    shoulders, weight = _parts(wavelength)
    is_finite = np.isfinite(spectrum)
    in_shoulders, in_band = shoulders & is_finite, (weight > 0.0) & is_finite
    if in_shoulders.sum() < MIN_SHOULDER_BANDS or not in_band.any():
        return float("nan")
    curve = np.polynomial.Polynomial.fit(wavelength[in_shoulders], spectrum[in_shoulders], 2)
    return float(1.0 - np.average(spectrum[in_band] / curve(wavelength[in_band]), weights=weight[in_band]))


# --- oxygen ------------------------------------------------------------------------------------------------

#: Largest declared shift [nm]; larger values have wrong units.
MAX_SHIFT_NM = 20.0
_NEEDED = (
    "time",
    "wavelength",
    "fwhm",
    "irradiance",
    "irradiance_fwhm",
    IRRADIANCE_TIME,
    IRRADIANCE_WAVELENGTH,
)
_OPTIONAL = (
    "wavelength_shift",
    "good",
    "band_spacing",
    "responsivity_slope",
    "radiance_gain",
    "irradiance_max_gap",
    "srf",
    "srf_offset",
)


@dataclass(frozen=True, eq=False)
class Light:
    """The irradiance record."""

    spectra: Floats  # (sample, channel): Irradiance, any unit
    time: Array  # (sample,)
    wavelength: Floats  # (channel,), of the channels [nm]
    fwhm: Floats  # () or (channel,): Full width at half maximum of the channels [nm]
    srf_shape: str  # Line shape of the spectrometer
    max_gap: float | None  # Longest time without a sample [s], or None


@dataclass(frozen=True, eq=False)
class Declared:
    # The bands of a line and their light, in the units of the table.
    time: Array  # (line,): At mid exposure
    # wavelength, fwhm (band,): [nm]
    wavelength: Floats
    fwhm: Floats
    good: Bools  # (band,), bool: all True by default
    wavelength_shift: Floats  # () or (column,) or (band, column): [nm]; 0 by default
    imager: Responses  # Responses of all bands
    light: Light  # The irradiance record

    @classmethod
    def by(cls, dataset: xr.Dataset) -> "Declared":
        # Return the declarations of a dataset; SchemaError if any are missing.
        arrays = require(
            dataset, [*_NEEDED, *(name for name in _OPTIONAL if name in dataset.variables)], "the alignment"
        )
        values: dict[str, Array] = {name: np.asarray(array.values) for name, array in arrays.items()}
        wavelength, fwhm = values["wavelength"], values["fwhm"]
        max_gap = values.get("irradiance_max_gap")
        return cls(
            time=values["time"],
            wavelength=wavelength,
            fwhm=fwhm,
            good=np.asarray(values.get("good", np.ones(wavelength.size)), bool),
            wavelength_shift=np.asarray(values.get("wavelength_shift", 0.0), np.float64),
            imager=Responses(
                wavelength,
                fwhm,
                str(dataset.attrs.get("srf_shape", "gaussian")),
                spacing=values.get("band_spacing"),
                slope=responsivity_slope(values),
                offset=values.get("srf_offset"),
                table=values.get("srf"),
            ),
            light=Light(
                spectra=np.asarray(values["irradiance"], np.float64),
                time=values[IRRADIANCE_TIME],
                wavelength=values[IRRADIANCE_WAVELENGTH],
                fwhm=np.asarray(values["irradiance_fwhm"], np.float64),
                srf_shape=str(dataset.attrs.get("irradiance_srf_shape", "gaussian")),
                max_gap=None if max_gap is None else float(max_gap),
            ),
        )

    def shift(self, columns: int) -> Floats:
        # Return the declared shift of every element (band, column) [nm].
        shift = self.wavelength_shift
        SchemaError.raise_if(
            not (np.isfinite(shift).all() and np.abs(shift).max() <= MAX_SHIFT_NM),
            "'wavelength_shift' is not finite or too large",
            expected=f"at most {MAX_SHIFT_NM:g} nm",
            mend="check its units",
            code="wavelength-shift-range",
        )
        return np.broadcast_to(shift, (self.wavelength.size, columns))

    def bands(self, inside: Array) -> Responses:
        parts: dict[str, Any] = {
            name: np.asarray(values)[inside]
            for name in ("wavelength", "fwhm", "spacing", "slope", "table")
            if (values := getattr(self.imager, name)) is not None
        }
        return replace(self.imager, **parts)


#: Distance of the shifts at which irradiance is matched [nm]; splines between are good to 1e-3 nm.
SHIFT_STEP = 0.5
#: Widths over the declared ones at which irradiance is matched.
FACTORS = np.linspace(0.6, 1.6, 9)


@dataclass(frozen=True)
class IrradianceTable:
    # Irradiance matched to bands at a grid of shifts and widths.
    wavelength: Floats  # (band,): Declared centres [nm]
    shifts: Floats  # (shift,): wavelength minus `wavelength` [nm]
    factors: Floats  # (factor,): width over the declared one [1]
    log: Floats  # (shift, factor, band): Logarithm of irradiance; NaN where the record does not cover a band
    noise_gain: Floats  # (factor,): Largest noise gain of the operators at a width [1]
    variance: Floats  # (factor, band): Variance of the response of a band [nm2]

    @cached_property
    def splines(self) -> list[Any]:
        # Splines of the bands; None for bands that are not covered.
        from scipy.interpolate import RectBivariateSpline

        return [
            RectBivariateSpline(self.shifts, self.factors, values) if np.isfinite(values).all() else None
            for values in np.moveaxis(self.log, -1, 0)
        ]

    def at(self, shift: Floats, factor: Floats, *, dx: int = 0, dy: int = 0) -> Floats:
        # Return the logarithm, or a derivative of it, (band, column), at (band, column) and (column,).
        log = np.full(shift.shape, np.nan)
        for band, spline in enumerate(self.splines):
            if spline is not None:
                log[band] = spline.ev(shift[band], factor, dx=dx, dy=dy)
        return log


def shares_of_samples(
    declared: Declared, windows: list[tuple[float, float]], lines: slice | None
) -> tuple[Floats, Floats]:
    # Return the weights of the record's samples (sample,) in the mean light, and the level of lines.
    light = declared.light
    low, high = min(low for low, _ in windows), max(high for _, high in windows)
    is_inside = (light.wavelength >= low) & (light.wavelength <= high)
    # leave out channels that are missing in over a tenth of the spectra, then spectra that lack other
    # channels
    has_values = np.isfinite(light.spectra).any(axis=1)
    is_inside &= np.isnan(light.spectra[has_values]).mean(axis=0) <= 0.1 if has_values.any() else False
    SchemaError.raise_if(
        not is_inside.any(),
        f"the irradiance record ({light.wavelength.min():g} to {light.wavelength.max():g} nm) has no "
        "channel in the window",
        mend="choose a window that the record covers",
        code="irradiance-coverage",
    )
    level = light.spectra[:, is_inside].mean(axis=1)
    level = np.where(level > 0.0, level, np.nan)  # mean irradiance of every sample
    times = declared.time if lines is None else declared.time[lines]
    neighbours = line_light(times, light.time, level, light.max_gap)
    before, after, weight = neighbours.before, neighbours.after, neighbours.weight
    level_of_line = level[before] + weight * (level[after] - level[before])
    lines_with_light = np.flatnonzero(np.isfinite(level_of_line))
    SchemaError.raise_if(
        lines_with_light.size == 0,
        "no line of the flight has irradiance at its time",
        mend="check the clocks",
        code="irradiance-time-gap",
    )
    share = np.zeros(len(light.spectra))
    np.add.at(
        share, before[lines_with_light], (1.0 - weight[lines_with_light]) / level_of_line[lines_with_light]
    )
    np.add.at(share, after[lines_with_light], weight[lines_with_light] / level_of_line[lines_with_light])
    return share / lines_with_light.size, level_of_line


def table_of_bands(
    light: Light, spectrum: Floats, bands: Responses, limits: tuple[float, float], fewest: int
) -> IrradianceTable:
    # Return the light matched to some bands; SchemaError where the record covers too few of them.
    #
    # ``light``: the record; ``spectrum`` (channel,): its mean; ``bands``: as declared; ``limits``: lowest and
    # highest shift [nm]; ``fewest``: number of bands that must be covered.
    nearby, spectrometer = channels_near(light, bands, limits, widths=4.0)
    # bands of other widths; the pixel width of a slit response does not change
    imagers = [
        replace(bands, offset=np.asarray(bands.offset) * factor)
        if bands.shape == "tabulated"
        else replace(bands, fwhm=bands.fwhm * factor)
        for factor in map(float, FACTORS)
    ]
    shifts = _shift_nodes(limits)
    operators = [_operator(spectrometer, imager, shifts) for imager in imagers]
    log = np.stack([_log_matched(matching, spectrum[nearby]) for matching in operators], axis=1)
    covered = np.isfinite(log).all(axis=(0, 1))
    if covered.sum() < fewest:
        channels = light.wavelength
        raise SchemaError(
            f"the irradiance record ({channels.min():g} to {channels.max():g} nm, {light.fwhm.max():g} nm "
            f"wide) covers {covered.sum()} of the {covered.size} bands from {bands.wavelength.min():.1f} to "
            f"{bands.wavelength.max():.1f} nm",
            expected=f"at least {fewest}",
            mend="choose a window that the record covers",
            code="irradiance-coverage",
        )
    gain = np.array([np.nan_to_num(matching.noise_gain).max() for matching in operators])
    variance = np.stack([variance_of_responses(imager) for imager in imagers])
    return IrradianceTable(bands.wavelength, np.array(shifts), FACTORS, log, gain, variance)


def channels_near(
    light: Light, bands: Responses, limits: tuple[float, float], widths: float
) -> tuple[Ints, Responses]:
    # Return the channels of a record near a window, in order of wavelength, and their responses.
    #
    # ``limits``: lowest and highest shift of the bands [nm]; ``widths``: margin in widths of the channels.
    channels, width = light.wavelength, np.broadcast_to(light.fwhm, light.wavelength.shape)
    order = np.argsort(channels, kind="stable")
    reach = np.abs(limits).max() + 2.0 * bands.reach().max() + widths * width.max()
    nearby = order[np.abs(channels[order] - bands.wavelength.mean()) <= np.ptp(bands.wavelength) / 2 + reach]
    return nearby, Responses(channels[nearby], width[nearby], light.srf_shape)


def _log_matched(matching: Matching, spectrum: Floats) -> Floats:
    # Return the logarithm of a spectrum (channel,) matched to bands (shift, band); NaN without channels.
    is_missing = ~np.isfinite(spectrum)
    matched = np.einsum("nbc,c->nb", matching.weights, np.where(is_missing, 0.0, spectrum))
    is_incomplete = (np.abs(matching.weights[..., is_missing]) > 1e-6).any(axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.where((matched > 0.0) & ~is_incomplete, np.log(matched), np.nan))


def _shift_nodes(limits: tuple[float, float]) -> tuple[float, ...]:
    # Return even shifts [nm] around the limits.
    first, last = np.floor(limits[0] / SHIFT_STEP) - 1, np.ceil(limits[1] / SHIFT_STEP) + 1
    return tuple((np.arange(first, last + 1) * SHIFT_STEP).tolist())


#: Cached for all flight lines of a camera: some windows, at all widths of camera or record.
_operator = functools.lru_cache(maxsize=132)(matching_operator)


def smooth_basis(wavelength: Floats, used: Bools, degree: int) -> tuple[Floats, Floats]:
    # Return polynomials (column, band, power), orthonormal over the used bands, and derivatives [nm-1].
    #
    # ``wavelength`` (band,) [nm]; ``used`` (band, column).
    scale = np.ptp(wavelength) / 2.0
    position = (wavelength - wavelength.min()) / scale - 1.0
    polynomials = [np.polynomial.Legendre.basis(power) for power in range(degree + 1)]
    derivatives = np.stack([polynomial.deriv()(position) for polynomial in polynomials], axis=-1)
    basis, upper = np.linalg.qr(used.T[:, :, None] * np.polynomial.legendre.legvander(position, degree))
    upper = np.where(used.any(axis=0).reshape(-1, 1, 1), upper, np.eye(degree + 1))
    return basis, derivatives / scale @ np.linalg.inv(upper)


def variance_of_responses(bands: Responses) -> Floats:
    # Return the variance of every band's line shape [nm2].
    if bands.shape == "slit":
        return np.asarray((bands.fwhm**2 + np.asarray(bands.spacing) ** 2) / 12.0)
    if bands.shape == "tabulated":
        offset, table = np.asarray(bands.offset), np.asarray(bands.table)
        weight = table * np.gradient(offset)
        weight = weight / weight.sum(axis=1, keepdims=True)
        return np.asarray(weight @ offset**2 - (weight @ offset) ** 2)
    return np.asarray((GAUSSIAN_SIGMA * bands.fwhm) ** 2)


# -- Shift and width of every column by least squares in windows of the spectrum, and their mean.

_COLUMN_FIT = SimpleNamespace(
    #: Lower limit of relative residuals, from float32 and matching [1].
    residual_floor=1e-4,
    fit_iterations=12,
    min_freedom=3,
)


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
        # variance of the responses (band, column) at widths (column,) [nm2]
        factors, variance = self.table.factors, self.table.variance
        position = np.interp(factor, factors, np.arange(factors.size))
        lower = np.minimum(position.astype(np.int64), factors.size - 2)
        variance_at = variance[lower].T + (position - lower) * (variance[lower + 1] - variance[lower]).T
        return np.asarray(np.einsum("xbp,xp->bx", self.slopes, terms) * variance_at)

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
    # Shift [nm] and width factor [1] of every column with their covariance, residuals and flags.
    #
    # NaN where a column has too few bands.
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
    # Return the number of bands that a fit needs: polynomial, shift, width, and `_COLUMN_FIT.min_freedom`
    # more.
    return int(degree + 1 + 2 + _COLUMN_FIT.min_freedom)


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
    freedom = used.sum(axis=0) - fewest_bands(degree) + _COLUMN_FIT.min_freedom
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
    for _ in range(_COLUMN_FIT.fit_iterations):
        tilt = ratio.tilt(tilt, best, factor)
        departure = ratio.departure(tilt, best, factor)
        matrix, vector = ratio.normal_equations(tilt, best, factor, departure)
        matrix = matrix + (1e-12 + 1e-9 * np.trace(matrix, axis1=1, axis2=2))[:, None, None] * np.eye(2)
        last_step = np.clip(np.linalg.solve(matrix, vector[..., None])[..., 0], (-0.5, -0.1), (0.5, 0.1))
        best = np.clip(best + last_step[:, 0], -max_shift, max_shift)
        factor = np.clip(factor + last_step[:, 1], FACTORS[0], FACTORS[-1])
    at_limit = (
        (np.abs(best) >= max_shift)
        | (factor <= FACTORS[0])
        | (factor >= FACTORS[-1])
        | (np.abs(last_step) > 1e-3).any(axis=1)
    )
    departure = ratio.departure(tilt, best, factor)
    zero, one = np.zeros_like(best), np.ones_like(best)
    departure_declared = ratio.departure(ratio.tilt(tilt, zero, one), zero, one)
    # covariance from the residual; infinite where the light has no lines
    matrix, _ = ratio.normal_equations(tilt, best, factor, departure)
    residual, residual_declared = (
        (values**2).sum(axis=0) / np.maximum(freedom, 1) for values in (departure, departure_declared)
    )
    variance = np.maximum(residual, _COLUMN_FIT.residual_floor**2)
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
    flag = (
        np.where(has_bands & np.isfinite(best), 0, FLAGS["no_data"])
        | np.where(at_limit & has_bands, FLAGS["at_limit"], 0)
        | np.where(gain > MAX_NOISE_GAIN, FLAGS["record_too_coarse"], 0)
    )
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


def _is_inside(declared: Declared, low: float, high: float) -> Array:
    # Return whether bands are good and inside a window (band,).
    return declared.good & (declared.wavelength >= low) & (declared.wavelength <= high)


def checked_windows(window: Any) -> list[Window]:
    # Return the windows in the order passed; SchemaError for invalid ones.
    with Problems(f"window={window!r} cannot be used", SchemaError) as problems:
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
            problems.add_if(
                low < high, f"windows overlap from {low:g} to {high:g} nm", code="windows-overlap"
            )
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
    variance = np.where(
        is_reliable, np.maximum(stacked(windows, "residual"), _COLUMN_FIT.residual_floor) ** 2, np.nan
    )
    with np.errstate(all="ignore"):
        largest, smallest = (np.where(is_reliable, variance, limit) for limit in (-np.inf, np.inf))
        is_alike = largest.max(axis=0) <= _MAX_VARIANCE_RATIO * smallest.min(axis=0)
        noise_factor = np.maximum(residual, _COLUMN_FIT.residual_floor) ** 2 / variance
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
    with Problems("the line cannot be aligned", SchemaError) as problems:
        for is_valid, found, expected in (
            (0 <= degree <= 12, f"degree={degree}", "0 to 12"),
            (group >= 1, f"group={group}", "1 or more columns"),
            (0.0 < max_shift <= 10.0, f"max_shift={max_shift:g}", "above 0, at most 10 nm"),
            (max_uncertainty > 0.0, f"max_uncertainty={max_uncertainty:g}", "above 0 nm"),
        ):
            problems.add_if(not is_valid, found, expected=expected, code="value-out-of-range")
    declared = Declared.by(dataset)
    # by default the `WINDOWS` that camera and record cover; the first where they cover none
    channels = declared.light.wavelength
    covered = [
        (low, high)
        for low, high in WINDOWS
        if _is_inside(declared, low, high).sum() >= fewest_bands(degree)
        and channels.min() <= low - _RECORD_MARGIN
        and channels.max() >= high + _RECORD_MARGIN
    ]
    windows = (covered or [*WINDOWS[:1]]) if window is None else checked_windows(window)
    # Which bands are good and inside each window (band,); SchemaError for too few.
    inside_windows = [_is_inside(declared, low, high) for low, high in windows]
    fewest = fewest_bands(degree)
    with Problems("the line cannot be aligned", SchemaError) as problems:
        for (low, high), is_inside in zip(windows, inside_windows, strict=True):
            problems.add_if(
                is_inside.sum() < fewest,
                f"{low:g} to {high:g} nm holds {is_inside.sum()} good bands",
                expected=f"at least {fewest} for a polynomial of degree {degree}, shift and width",
                mend="widen the window or lower degree=",
                code="bands-too-few",
            )
    # the record's mean spectrum in units of its level (channel,), and the level of every line
    share, level = shares_of_samples(declared, windows, lines)
    light = share[share > 0.0] @ declared.light.spectra[share > 0.0]
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
    return report.assign_coords(
        wavelength=(BAND, declared.wavelength, VARIABLES["wavelength"].attrs)
    ).assign_attrs(
        window="; ".join(f"{low:g}-{high:g} nm" for low, high in windows),
        degree=degree,
        lines=len(level),
        srf_shape=declared.imager.shape,
        labels=label_digest(dataset, (CROSS_TRACK,)),
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
    report = xr.Dataset(
        {name: (("window", CROSS_TRACK), values, _attrs_of(name)) for name, values in columns.items()}
    )
    report["pixels"] = (CROSS_TRACK, pixels, _attrs_of("pixels"))
    return report.assign_coords(
        column=(CROSS_TRACK, column, {"long_name": "Column, or mean column of a group", "units": "1"}),
        window_centre=(
            "window",
            [estimate.centre for estimate in estimates],
            {"units": "nm", "long_name": "Mean wavelength of the bands of a window"},
        ),
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


# --- estimates ---------------------------------------------------------------------------------------------


#: Settings and thresholds of the comparison of camera and record.
COMPARISON = SimpleNamespace(
    # Compared intervals [nm]: solar lines in the blue and green, H-alpha and the oxygen B band's beginning,
    # the oxygen A band, water; not 690 to 740, where no polynomial of low degree fits the edge of vegetation.
    windows=(
        (402.0, 460.0),
        (460.0, 530.0),
        (530.0, 600.0),
        (625.0, 690.0),
        (740.0, 800.0),
        (800.0, 870.0),
        (890.0, 985.0),
    ),
    # Degree of the polynomial that models a surface's spectrum in a window: it fits features of 15 nm and
    # wider.
    degree=5,
    # Number of slabs read, evenly over the line, and lines per slab; they bound time and memory.
    blocks=8,
    block_lines=16,
    # Number of groups of neighbouring columns that are averaged; over an eighth of the swath a smile of 0.5
    # nm changes by 0.1 nm, which widens the mean by less than 0.1 %.
    column_groups=8,
    # Minimum number of pixels of a group, and of groups of a window.
    least_pixels=64,
    least_groups=2,
    # Range of the search; a field spectrometer is specified to 0.5 nm.
    max_shift_nm=1.5,
    # Trial widths relative to the declared one [1].
    widths=(0.6, 0.8, 1.0, 1.2, 1.4, 1.6),
    # Wavelength above which lines are absorption of the air, not of the sun [nm], and the standard deviation
    # of the share of the air path below the camera [1]: 100 m are 0.9 % under a sun at 45 degrees, half that
    # in saturated bands.
    airy=680.0,
    path_prior=0.01,
    # Standard deviations of the prior: of the shift [nm], its change over 100 nm [nm], and the width over the
    # declared one [1]. They are wide, and matter only where the light has no structure.
    shift_prior_nm=1.0,
    tilt_prior=0.05,
    width_prior=0.5,
    # Lower limits of reported uncertainties: residuals of closed loops with line shapes slightly different
    # from the declared ones [nm], [1].
    least_shift_u_nm=0.003,
    least_width_u=0.003,
    # Departure over its standard uncertainty above which instruments differ; 5, since neighbouring bands are
    # not independent and there are three parameters.
    significance=5.0,
    # Shift of the camera over its uncertainty above which the camera is corrected by its share; otherwise
    # only the record is.
    camera_significance=3.0,
    # Relative change of matched irradiance below which no band is corrected [1].
    least_effect=1e-3,
)

_FIT = SimpleNamespace(
    coarse_step_nm=0.25,
    iterations=8,
    #: Number of neighbouring bands whose errors form a cluster: noise of a channel spreads over both
    #: responses.
    cluster_bands=4,
    min_residual=2e-4,
)
_DERIVATIVE_NM, _DERIVATIVE_WIDTH = 0.02, 0.01


class Comparison(NamedTuple):
    """Difference between camera and record, with standard uncertainties.

    ``shift`` and ``tilt``: wavelength of the camera minus wavelength of the record, both relative to their
    declarations [nm], at 600 nm and its change over 100 nm; ``width``: width of the record over the declared
    one [1] if the camera is as declared; ``covariance`` (3, 3) of these. ``residual`` and
    ``residual_declared``: relative departure of radiance over irradiance from smooth, rms [1]. ``wavelength``
    (band,) and ``effect`` (band,): relative change of matched irradiance in the compared bands. ``sun``: the
    record compared with solar lines, None with too few channels; ``declared_fwhm``: of record and camera
    [nm].
    """

    shift: float
    tilt: float
    width: float
    covariance: Floats
    residual: float
    residual_declared: float
    wavelength: Floats
    effect: Floats
    groups: int
    at_limit: bool
    sun: "RecordAgainstSun | None" = None
    declared_fwhm: tuple[float, float] = (np.nan, np.nan)

    @property
    def u(self) -> Floats:
        # Standard uncertainties of shift [nm], tilt [nm] and width [1].
        return np.sqrt(np.diag(self.covariance))

    @property
    def departure(self) -> float:
        # Departure from the declared values over its uncertainty [1].
        deviation = np.array([self.shift, self.tilt, self.width - 1.0])
        return float(np.sqrt(deviation @ np.linalg.solve(self.covariance, deviation)))

    def is_significant(self, rules: SimpleNamespace = COMPARISON) -> bool:
        # Return whether camera and record differ beyond chance and beyond `COMPARISON.least_effect`.
        return bool(
            not self.at_limit
            and self.departure > rules.significance
            and np.nanmax(np.abs(self.effect)) > rules.least_effect
        )


@dataclass(frozen=True, eq=False)
class _WindowFit:
    # Inputs of the fit of a window: means of groups of pixels, and the light matched to the bands.
    wavelength: Floats  # (band,)
    log: Floats  # (band, group): logarithm of radiance
    shift: Floats  # (band, group): declared [nm]
    valid: Array  # (group,): whether a group has enough pixels
    basis: Floats  # (band, power), orthonormal
    slopes: Floats  # (band, power): derivative of the basis [nm-1]
    variance: Floats  # (band,): variance of the camera's responses [nm2]
    nodes: Floats  # (node,): even shifts [nm]
    widths: Floats  # (width,)
    light: Floats  # (node, width, band): logarithm of matched irradiance
    noise: Floats  # (channel, band): noise of the logarithm by each channel of the record
    by_width: dict[float, Floats] = field(default_factory=dict)  # (node, band): cache of light at a width

    def light_at(self, shift: Floats, width: float) -> Floats:
        # Interpolate light (band, group) at shifts (band, group) [nm] and a width, by polynomials in both.
        # the light at a width is cached: many shifts are tested with the same widths
        at_width = self.by_width.get(float(width))
        if at_width is None:
            # polynomial through the light at all widths
            offsets, nodes = width - self.widths, self.widths
            weights_of_widths = np.array(
                [
                    np.prod(np.delete(offsets, k)) / np.prod(nodes[k] - np.delete(nodes, k))
                    for k in range(nodes.size)
                ]
            )
            at_width = np.einsum("nwb,w->nb", self.light, weights_of_widths)
            self.by_width[float(width)] = at_width
        position = (shift - self.nodes[0]) / (self.nodes[1] - self.nodes[0])
        lower = np.clip(np.floor(position).astype(np.int64), 1, self.nodes.size - 3)
        t = position - lower
        weights = (
            -t * (t - 1) * (t - 2) / 6,
            (t + 1) * (t - 1) * (t - 2) / 2,
            -(t + 1) * t * (t - 2) / 2,
            (t + 1) * t * (t - 1) / 6,
        )
        first = (lower - 1) * shift.shape[0] + np.arange(shift.shape[0])[
            :, None
        ]  # flat indices: half the time
        values = at_width.ravel()
        return np.asarray(sum(w * values[first + k * shift.shape[0]] for k, w in enumerate(weights)))

    def departure(self, shift: Floats, width: float) -> Floats:
        # Return the logarithm of radiance over light (band, group) without its smooth part.
        # A surface of spectral slope g in a band of variance v acts as a shift g v; g comes from the smooth
        # curve.
        total_shift = self.shift + shift[:, None]
        ratio = self.log - self.light_at(total_shift, width)
        tilt = (self.slopes @ (self.basis.T @ ratio)) * self.variance[:, None]
        ratio = self.log - self.light_at(total_shift + tilt, width)
        return np.asarray(ratio - self.basis @ (self.basis.T @ ratio))


def compared(line: xr.Dataset, rules: SimpleNamespace = COMPARISON) -> Comparison | None:
    """Return the difference between camera and record; None without a window of enough bands and light.

    ``line``: with counts or radiance and their irradiance, as `hyperpaint.reflectance` needs them. Raises
    `SchemaError`, `UnitsError`: variables are missing, or have other dims or units.

    Examples
    --------
    >>> from hyperpaint.simulation import simulate_line
    >>> line = simulate_line(lines=32, columns=32, smile_nm=0.0, irradiance_fwhm_nm=4.0)
    >>> line = line.assign_coords(irradiance_wavelength=line.irradiance_wavelength - 0.3)
    >>> round(compared(line).shift, 1)  # camera minus record [nm]
    -0.3
    """
    dataset = rename_to_roles(line)
    declared = Declared.by(dataset)
    channels, bands = declared.light.wavelength, declared.wavelength
    is_inside = {(low, high): (bands >= low) & (bands <= high) & declared.good for low, high in rules.windows}
    windows = [
        (low, high)
        for (low, high), inside in is_inside.items()
        if inside.sum() >= rules.degree + 1 + 6 and channels.min() < low and channels.max() > high
    ]
    if not windows:
        return None
    inside_windows = [is_inside[window] for window in windows]
    used_bands = np.flatnonzero(np.logical_or.reduce(inside_windows))
    # Slabs evenly over the line, and the weights (sample,) of record samples in their light. Of a
    # slab: means (band, column) of all bands, NaN for bands that were not read, and pixels (column,).
    lines = dataset.sizes[ALONG_TRACK]
    size = min(rules.block_lines, lines)
    starts = np.unique(np.linspace(0, lines - size, rules.blocks).astype(np.int64))
    cube = radiance_of_bands(dataset, used_bands)
    blocks, block_shares = [], []
    for start in starts:
        lines_of_block = slice(int(start), int(start) + size)
        share, level = shares_of_samples(declared, windows, lines_of_block)
        mean, pixels = mean_over_lines(cube[lines_of_block], level)
        radiance = np.full((declared.wavelength.size, pixels.size), np.nan)
        radiance[used_bands] = mean
        blocks.append((radiance, pixels))
        block_shares.append(share)
    shares = np.asarray(np.mean(block_shares, axis=0))
    spectra = declared.light.spectra[shares > 0]
    light, squared_noise = shares[shares > 0] @ spectra, shares[shares > 0] ** 2 @ spectra**2
    relative = noise_of_record(declared.light.spectra, declared.light.time, fewest=1)
    noise = np.sqrt(squared_noise) * (0.0 if relative is None else relative)
    fits = [_window_fit(declared, inside, blocks, (light, noise), rules) for inside in inside_windows]
    usable = [fit for fit in fits if fit is not None]
    if not usable:
        return None
    is_between = (channels >= windows[0][0]) & (channels <= windows[-1][1])
    width = float(np.broadcast_to(declared.light.fwhm, channels.shape)[is_between].mean())
    # Fit shift, tilt and width at which radiance over irradiance is smoothest in all windows and groups.
    # A fourth parameter is the air below the camera, which increases absorption in radiance only.
    prior = 1.0 / np.array([rules.shift_prior_nm, rules.tilt_prior, rules.width_prior, rules.path_prior]) ** 2
    # the best of a grid of shifts and widths for the mean group: solar lines cause several minima
    steps = int(np.ceil(rules.max_shift_nm / _FIT.coarse_step_nm))
    shifts = np.linspace(-rules.max_shift_nm, rules.max_shift_nm, 2 * steps + 1)
    totals = np.zeros((len(rules.widths), shifts.size))
    for fit in usable:
        # every shift is a group
        mean_log, mean_shift = (a[:, fit.valid].mean(axis=1, keepdims=True) for a in (fit.log, fit.shift))
        trial = replace(fit, log=mean_log, shift=mean_shift + shifts)
        for row, factor in zip(totals, rules.widths, strict=True):
            row += (trial.departure(np.zeros(fit.wavelength.size), factor) ** 2).sum(axis=0)
    at_width, at_shift = divmod(int(totals.argmin()), shifts.size)
    parameters = np.array([shifts[at_shift], 0.0, rules.widths[at_width], 0.0])
    limits = np.array([rules.max_shift_nm, 0.3, np.inf, 0.1])
    for _ in range(_FIT.iterations):
        departures, slopes = _linearised(usable, parameters, rules)
        weights = _weights(usable, departures)
        matrix, vector = np.diag(prior), -prior * (parameters - [0.0, 0.0, 1.0, 0.0])
        for r, j, w in zip(departures, slopes, weights, strict=True):
            matrix = matrix + np.einsum("ibg,jbg,bg->ij", j, j, w)
            vector = vector - np.einsum("ibg,bg,bg->i", j, r, w)
        parameters = np.clip(parameters + np.linalg.solve(matrix, vector), -limits, limits)
        parameters[2] = np.clip(parameters[2], rules.widths[0], rules.widths[-1])
    departures, slopes = _linearised(usable, parameters, rules)
    effects = [
        (
            fit.light_at(fit.shift + shift_at(fit.wavelength, *parameters[:2])[:, None], parameters[2])
            - fit.light_at(fit.shift, 1.0)
        ).mean(axis=1)
        for fit in usable
    ]
    return Comparison(
        shift=float(parameters[0]),
        tilt=float(parameters[1]),
        width=float(parameters[2]),
        covariance=_covariance(usable, departures, slopes, np.diag(prior), rules),
        residual=_rms(usable, departures),
        residual_declared=_rms(usable, [fit.departure(np.zeros(fit.wavelength.size), 1.0) for fit in usable]),
        wavelength=np.concatenate([fit.wavelength for fit in usable]),
        effect=np.concatenate(effects),
        groups=max(int(fit.valid.sum()) for fit in usable),
        at_limit=bool(
            abs(parameters[0]) >= rules.max_shift_nm or not rules.widths[0] < parameters[2] < rules.widths[-1]
        ),
        sun=record_against_sun(channels, light),
        declared_fwhm=(width, float(declared.fwhm[used_bands].mean())),
    )


def _window_fit(
    declared: Declared,
    is_inside: Array,
    blocks: list[tuple[Floats, Array]],
    record: tuple[Floats, Floats],
    rules: SimpleNamespace,
) -> _WindowFit | None:
    # Return the inputs of the fit of a window; None where record or pixels cover too little of it.
    light, noise = record  # (channel,): mean of the light, and its noise
    # spectra and declared shifts (band, group) of neighbouring columns; NaN spectra where pixels are too few
    columns = blocks[0][1].size
    shift = declared.shift(columns)[is_inside]
    edges = np.unique(np.linspace(0, columns, rules.column_groups + 1).astype(np.int64))
    spectra, shifts = [], []
    for block_radiance, pixels in blocks:
        # leave out columns with bad elements: that band would be averaged over another surface
        values = block_radiance[is_inside]
        is_complete = np.isfinite(values).all(axis=0)
        for first, last in itertools.pairwise(edges):
            weight = np.where(is_complete, pixels, 0)[first:last]
            has_enough = weight.sum() >= rules.least_pixels
            share = weight / weight.sum() if has_enough else np.full(last - first, 1.0 / (last - first))
            mean = np.where(is_complete, values, 0.0)[:, first:last] @ share
            spectra.append(mean if has_enough else np.full(mean.shape, np.nan))
            shifts.append(shift[:, first:last] @ share)
    spectrum, declared_shift = np.stack(spectra, axis=1), np.stack(shifts, axis=1)
    valid = np.asarray(np.isfinite(spectrum).all(axis=0))
    if valid.sum() < rules.least_groups:
        return None
    bands = declared.bands(is_inside)
    limits = (
        float(declared_shift.min()) - rules.max_shift_nm,
        float(declared_shift.max()) + rules.max_shift_nm,
    )
    nearby_channels, spectrometer = channels_near(declared.light, bands, limits, widths=8.0)
    widths = np.asarray(rules.widths)
    # logarithm (shift, width, band) of the light matched to the bands, by trial shifts and widths, as in
    # `table_of_bands`; weights (band, channel) of the channels at the middle shift and the declared width
    nodes = _shift_nodes(limits)
    spectrometers = [replace(spectrometer, fwhm=spectrometer.fwhm * width) for width in widths]
    operators = [_operator(widened, bands, nodes) for widened in spectrometers]
    weights = operators[int(np.abs(widths - 1.0).argmin())].weights[len(nodes) // 2]
    logs = np.stack([_log_matched(matching, light[nearby_channels]) for matching in operators], axis=1)
    is_covered = np.isfinite(logs).all(axis=(0, 1)) & (spectrum[:, valid] > 0).all(axis=1)
    if is_covered.sum() < rules.degree + 7:
        return None
    wavelength = bands.wavelength[is_covered]
    by_channel = np.zeros((light.size, is_covered.sum()))
    light_nearby, sd = np.nan_to_num(light[nearby_channels]), np.nan_to_num(noise[nearby_channels])
    by_channel[nearby_channels] = (weights[is_covered] * sd / (weights[is_covered] @ light_nearby)[:, None]).T
    basis, slopes = smooth_basis(wavelength, np.ones((wavelength.size, 1), bool), rules.degree)
    return _WindowFit(
        wavelength=wavelength,
        log=np.log(np.where(valid, spectrum, 1.0)[is_covered]),
        shift=declared_shift[is_covered],
        valid=valid,
        basis=basis[0],
        slopes=slopes[0],
        variance=variance_of_responses(bands)[is_covered],
        nodes=np.array(nodes),
        widths=widths,
        light=logs[:, :, is_covered],
        noise=by_channel,
    )


def _linearised(
    fits: list[_WindowFit], parameters: Floats, rules: SimpleNamespace
) -> tuple[list[Floats], list[Floats]]:
    # Return departures (band, group) and their derivatives (parameter, band, group) of every window.
    departures, slopes = [], []
    for fit in fits:
        shift, width = shift_at(fit.wavelength, *parameters[:2]), float(parameters[2])
        by_shift = (
            fit.departure(shift + _DERIVATIVE_NM, width) - fit.departure(shift - _DERIVATIVE_NM, width)
        ) / (2 * _DERIVATIVE_NM)
        by_width = (
            fit.departure(shift, width + _DERIVATIVE_WIDTH) - fit.departure(shift, width - _DERIVATIVE_WIDTH)
        ) / (2 * _DERIVATIVE_WIDTH)
        # the light without its smooth part: its lines, which are deeper below more air
        light = fit.light_at(fit.shift + shift[:, None], width)
        path = (light - fit.basis @ (fit.basis.T @ light)) * (fit.wavelength[-1] > rules.airy)
        departures.append(fit.departure(shift, width) - parameters[3] * path)
        lever = ((fit.wavelength - ALIGNED_AT_NM) / ALIGNED_PER_NM)[:, None]
        slopes.append(np.stack([by_shift, lever * by_shift, by_width, -path]))
    return departures, slopes


def _weights(fits: list[_WindowFit], departures: list[Floats]) -> list[Floats]:
    # Return inverse variances (band, group): half from the departures of the group, half from the window.
    weights = []
    for fit, r in zip(fits, departures, strict=True):
        group_variance = (r**2).mean(axis=0)
        variance = 0.5 * group_variance + 0.5 * np.median(group_variance[fit.valid]) + _FIT.min_residual**2
        weights.append(np.broadcast_to(np.where(fit.valid, 1.0 / variance, 0.0), r.shape))
    return weights


def _covariance(
    fits: list[_WindowFit],
    departures: list[Floats],
    slopes: list[Floats],
    prior: Floats,
    rules: SimpleNamespace,
) -> Floats:
    # Return the covariance (3, 3) of shift, tilt, width: scatter between groups (surfaces) and bands.
    #
    # Errors that all groups share (noise of the record, gains) scatter between bands only; errors of a
    # surface scatter between groups. Both are sandwich estimates with sums over clusters, and are added.
    # Noise of a channel is propagated through the operator: it spreads over bands, most where the camera is
    # sharper.
    weights = _weights(fits, departures)
    groups = departures[0].shape[1]
    matrix = prior.copy()
    by_group = np.zeros((groups, 4))
    by_band = []
    by_channel = np.zeros((fits[0].noise.shape[0], 4))
    for fit, r, j, w in zip(fits, departures, slopes, weights, strict=True):
        matrix += np.einsum("ibg,jbg,bg->ij", j, j, w)
        score = j * (r * w)
        # derivatives of departures have no smooth part, so noise needs no further projection
        by_channel += fit.noise @ (j * w).sum(axis=2).T
        by_group += score.sum(axis=1).T
        edges = np.arange(0, r.shape[0], _FIT.cluster_bands)
        freedom_factor = r.shape[0] / max(r.shape[0] - rules.degree - 2, 1)
        by_band.append(np.add.reduceat(score.sum(axis=2), edges, axis=1).T * np.sqrt(freedom_factor))
    bands = np.concatenate(by_band)
    meat = (
        by_group.T @ by_group * groups / max(groups - 1, 1)
        + bands.T @ bands * len(bands) / max(len(bands) - 3, 1)
        + by_channel.T @ by_channel
    )
    inverse = np.linalg.inv(matrix)
    min_variance = np.diag([rules.least_shift_u_nm, rules.least_shift_u_nm, rules.least_width_u]) ** 2
    return np.asarray((inverse @ (meat + prior) @ inverse)[:3, :3] + min_variance)


def _rms(fits: list[_WindowFit], departures: list[Floats]) -> float:
    means = [r[:, fit.valid].mean(axis=1) for fit, r in zip(fits, departures, strict=True)]
    return float(np.sqrt(np.mean(np.concatenate(means) ** 2)))


# -- Compare camera and irradiance record of a flight line, and correct significant differences.

_OXYGEN_NM, _BLUE_NM = 760.0, 450.0
#: Upper end of the silicon detector of field spectrometers [nm]; results do not apply to detectors beyond.
VNIR_END_NM = 1000.0


@documented()
def align(
    line: xr.Dataset,
    *,
    apply: Alignment = "auto",
    rules: SimpleNamespace = COMPARISON,
) -> xr.Dataset:
    r"""Compare camera and irradiance record in flight, and correct significant differences.

    Eager, except for the cubes: 128 lines are read, evenly over the line, independently of chunks.

    Parameters
    ----------
    line
        A flight line with the variables that `hyperpaint.reflectance` needs.
    apply
        ``"auto"``: correct where camera and record differ significantly, and irradiance changes enough to
        matter (``significance`` and ``least_effect`` of the rules). ``"never"``: report only. ``"always"``:
        correct any difference.
    rules

    Returns
    -------
    Dataset
        The line; cubes stay lazy. Where a correction is applied, ``irradiance_wavelength`` and
        ``irradiance_fwhm`` are corrected, ``wavelength_shift`` holds the camera's share where that is
        significant (``camera_significance``), and reflectance, which held for other wavelengths, is removed.
        Channels of detectors beyond 1000 nm, which the comparison does not cover, keep their declared widths.
        The attributes:

        * ``alignment``: a sentence, after those of earlier corrections; ``alignment_state``: ``"applied"``,
          ``"not significant"``, ``"not applied"`` or ``"not compared"``.
        * ``alignment_shift``, ``alignment_shift_slope``: wavelength of the camera minus wavelength of the
          record, relative to their declarations, at 600 nm [nm], and its change over 100 nm [nm];
          ``alignment_width``: width of the record over the declared one [1], if the whole difference is due
          to the record. Each with ``_u``.
        * ``alignment_departure``: joint departure of these from agreement, in standard uncertainties;
          ``alignment_effect``: largest relative change of irradiance [1].
        * ``alignment_residual``, ``alignment_residual_declared``: rms of the light's structure that remains
          in radiance over irradiance on average, relative, corrected and as declared [1].
        * ``alignment_record_shift``, ``alignment_camera_shift`` [nm], ``alignment_record_fwhm`` [nm],
          ``alignment_camera_width`` [1]: the share of each instrument, by the solar lines in the record.
          Each with ``_u``.

    Raises
    ------
    SchemaError
        ``apply`` is unknown.

    Warns
    -----
    PaintWarning
        Camera and record differ, and the correction is switched off or beyond the range of the search.

    Notes
    -----
    With :math:`\bar L_{bg}` the mean radiance of a band over the pixels of a group (columns and lines beside
    each other) and :math:`\bar E_b` the record's mean, shift :math:`\delta(\lambda)`, a straight line, and
    the record's width :math:`w` minimise

    .. math:: \sum_{g, b} \frac{1}{\sigma_g^2}
              \big( (1 - P) \ln (\bar L_{bg} / \bar E_b(\delta, w)) \big)^2

    over the windows of the rules, in which :math:`P` projects onto polynomials. Surfaces differ between
    groups: their scatter, and that between bands, is the uncertainty.

    Only the difference of the two affects reflectance. Solar lines in the record attribute it to one of them,
    with much larger uncertainty; the camera's ``wavelength_shift`` takes its share where that is significant,
    the record the rest. A record that is wider than declared and a camera that is narrower look alike; the
    record, whose width is seldom measured, takes the correction.

    Examples
    --------
    >>> from hyperpaint.simulation import simulate_line
    >>> line = simulate_line(lines=32, columns=32, smile_nm=0.0, irradiance_fwhm_nm=4.0)
    >>> line["irradiance_fwhm"] = line.irradiance_fwhm - 1.0
    >>> aligned = align(line.assign_coords(irradiance_wavelength=line.irradiance_wavelength - 0.3))
    >>> aligned.attrs["alignment_state"], round(aligned.attrs["alignment_shift"], 1)
    ('applied', -0.3)
    """
    one_of(apply, ALIGNMENTS, "apply")
    try:
        # computing the line itself warns
        with warnings.catch_warnings(action="ignore", category=PaintWarning):
            comparison = compared(line, rules)
    except (PaintError, OSError) as error:  # processing of the line raises it again
        return _not_compared(line, str(error).splitlines()[0])
    if comparison is None:
        return _not_compared(line, "too few bands, pixels or channels where daylight has lines")
    shift_u, tilt_u, width_u = comparison.u
    shares = divided(
        (comparison.shift, float(shift_u)),
        (comparison.width, float(width_u)),
        comparison.sun,
        comparison.declared_fwhm,
    )
    values = {
        "shift": comparison.shift,
        "shift_u": shift_u,
        "shift_slope": comparison.tilt,
        "shift_slope_u": tilt_u,
        "width": comparison.width,
        "width_u": width_u,
        "effect": np.nanmax(np.abs(comparison.effect)),
        "departure": comparison.departure,
        "residual": comparison.residual,
        "residual_declared": comparison.residual_declared,
        **shares,
    }
    numbers = {f"alignment_{name}": float(f"{value:.6g}") for name, value in values.items()}
    is_significant = comparison.is_significant(rules)
    if comparison.at_limit:
        text = f"camera and irradiance record differ by more than can be corrected ({_sentence(comparison)})"
        warn_user(f"{text}; check wavelengths and widths of both", "alignment-at-limit")
        return restated(line, text, numbers=numbers, state="not applied")
    if apply == "always" or (apply == "auto" and is_significant):
        # the camera's wavelengths move only where its share is significant
        share, share_u = shares["camera_shift"], shares["camera_shift_u"]
        camera = float(f"{share:.3f}") if abs(share) > rules.camera_significance * share_u else 0.0
        camera_text = f", and the camera's wavelength_shift by {camera:+.3f} nm" if camera else ""
        text = f"irradiance record corrected in flight{camera_text}: {_sentence(comparison)}"
        # the line with corrected channels of the record; `camera`: share of the camera [nm]
        dataset = rename_to_roles(line)
        arrays = require(dataset, [IRRADIANCE_WAVELENGTH, "irradiance_fwhm"], "the alignment")
        channels = arrays[IRRADIANCE_WAVELENGTH].values.astype(np.float64)
        # the shift is constant beyond the compared bands
        limited = np.clip(channels, comparison.wavelength.min(), comparison.wavelength.max())
        shifted = channels - shift_at(limited, comparison.shift, comparison.tilt) + camera
        width = np.broadcast_to(arrays["irradiance_fwhm"].values, channels.shape)
        is_same_detector = channels <= max(VNIR_END_NM, comparison.wavelength.max())
        widths = xr.DataArray(
            np.where(is_same_detector, width * comparison.width, width), dims=IRRADIANCE_WAVELENGTH
        )
        coordinate = xr.DataArray(shifted, dims=IRRADIANCE_WAVELENGTH)
        aligned = (
            without_products(dataset)
            .drop_vars("irradiance_fwhm")
            .assign_coords({IRRADIANCE_WAVELENGTH: label(coordinate, IRRADIANCE_WAVELENGTH)})
        )
        if camera:
            # ``wavelength`` stays, the common axis of all lines; the shift of columns changes
            names = [name for name in ("wavelength_shift",) if name in aligned.variables]
            declared = require(aligned, names, "the alignment")
            zero = xr.DataArray(np.zeros(aligned.sizes[CROSS_TRACK]), dims=CROSS_TRACK)
            shift = declared.get("wavelength_shift", zero) + camera
            new_shift = xr.DataArray(shift.values, dims=shift.dims)
            aligned = aligned.assign_coords(wavelength_shift=label(new_shift, "wavelength_shift"))
        return restated(
            aligned.assign(irradiance_fwhm=label(widths, "irradiance_fwhm")),
            text,
            numbers=numbers,
            state="applied",
        )
    if is_significant:
        text = f"camera and irradiance record differ: {_sentence(comparison)}"
        mend = (
            "correct fwhm_nm and wavelengths of the collect, or correct them automatically: "
            "hp.alignment.align(line) in Python, --alignment auto on the command line, "
            '[alignment] apply = "auto" in collect.toml'
        )
        warn_user(f"{text}; {mend}", "alignment-differs")
        return restated(line, text, numbers=numbers, state="not applied")
    text = f"camera and irradiance record agree: {_sentence(comparison)}"
    return restated(line, text, numbers=numbers, state="not significant")


def _not_compared(line: xr.Dataset, reason: str) -> xr.Dataset:
    return restated(line, f"camera and irradiance record not compared: {reason}", state="not compared")


def _sentence(comparison: Comparison) -> str:
    shift_u, tilt_u, width_u = comparison.u
    changes = ", ".join(
        f"{float(comparison.effect[nearest]):+z.2%} at {comparison.wavelength[nearest]:.0f} nm"
        for nearest in (int(np.abs(comparison.wavelength - nm).argmin()) for nm in (_BLUE_NM, _OXYGEN_NM))
    )
    return (
        f"camera minus record {comparison.shift:+z.3f} +- {shift_u:.3f} nm at 600 nm, changing by "
        f"{comparison.tilt:+z.3f} +- {tilt_u:.3f} nm over 100 nm; width of the record "
        f"{comparison.width:.3f} +- "
        f"{width_u:.3f} of that declared; irradiance changes by {changes}, at most "
        f"{np.nanmax(np.abs(comparison.effect)):.2%}"
    )


# --- wavelengths and width of the irradiance record alone, from solar lines and those of oxygen ------------


#: Settings of the comparison of a record with solar lines.
SUN_LINES = SimpleNamespace(
    # Compared intervals [nm]: magnesium b and iron, H-alpha, the oxygen A band; the blue, where cells of 1 nm
    # hold many solar lines, gave widths twice too large of a real spectrometer.
    windows=((475.0, 540.0), (610.0, 680.0), (745.0, 775.0)),
    # Degree of the polynomial that models the unknown colour of the light in a window.
    degree=5,
    # Trials: shifts [nm] and full widths at half maximum [nm], both even.
    shifts_nm=(-2.0, 2.0, 0.1),
    widths_nm=(1.0, 12.0, 0.25),
    # Width of the table's cells, which widens every solar line [nm].
    cell_nm=1.0,
    # Lower limits of reported uncertainties: three windows of a real record agreed to 0.06 nm and 0.9 nm (0.3
    # nm without the narrowest solar lines).
    least_shift_u_nm=0.06,
    least_width_u_nm=0.3,
    # Standard deviations of the prior: of the wavelengths of a field spectrometer (its makers specify 0.5 nm
    # at most) and of a calibrated camera [nm], and of the camera's width [1].
    record_prior_nm=0.3,
    camera_prior_nm=0.2,
    camera_width_prior=0.02,
)


class RecordAgainstSun(NamedTuple):
    # True minus declared wavelength of the record's channels, and their width, with uncertainties [nm].
    shift: float
    shift_u: float
    width: float
    width_u: float


def divided(
    shift: tuple[float, float],
    width: tuple[float, float],
    sun: RecordAgainstSun | None,
    declared_fwhm: tuple[float, float],
) -> dict[str, float]:
    # Return the shares of both instruments in their difference, each with its standard uncertainty (``_u``).
    #
    # ``record_shift`` and ``camera_shift``: true minus declared wavelength [nm]; ``record_fwhm`` [nm];
    # ``camera_width``: over the declared one [1].
    #
    # ``shift``: camera minus record [nm] and its uncertainty; ``width``: width of the record over the
    # declared one, if the camera is as declared, and its uncertainty; ``declared_fwhm``: of record and camera
    # [nm].
    #
    # Least squares of two unknowns for shifts, and two for widths: record and camera. Their difference is
    # measured, the record is measured by the sun, and both have priors. Widths add as squares: :math:`w^2 -
    # (W^2 - W_0^2)` is measured.
    record, camera = declared_fwhm
    rows = [
        (-1.0, 1.0, *shift),
        (1.0, 0.0, 0.0, SUN_LINES.record_prior_nm),
        (0.0, 1.0, 0.0, SUN_LINES.camera_prior_nm),
    ]
    squares = [
        (1.0, -1.0, (record * width[0]) ** 2, 2.0 * record**2 * width[0] * width[1]),
        (0.0, 1.0, 0.0, 2.0 * camera**2 * SUN_LINES.camera_width_prior),
    ]
    if sun is not None:
        rows.append((1.0, 0.0, sun.shift, sun.shift_u))
        squares.append((1.0, 0.0, sun.width**2, 2.0 * sun.width * sun.width_u))
    (record_shift, camera_shift), (u_record, u_camera) = _least_squares(rows)
    (record_square, camera_square), (v_record, v_camera) = _least_squares(squares)
    record_fwhm = np.sqrt(max(record_square, 0.01))
    camera_fwhm = np.sqrt(max(camera**2 + camera_square, 0.01))
    return {
        "record_shift": record_shift,
        "record_shift_u": u_record,
        "camera_shift": camera_shift,
        "camera_shift_u": u_camera,
        "record_fwhm": float(record_fwhm),
        "record_fwhm_u": float(v_record / (2.0 * record_fwhm)),
        "camera_width": float(camera_fwhm / camera),
        "camera_width_u": float(v_camera / (2.0 * camera_fwhm * camera)),
    }


def _least_squares(rows: list[tuple[float, float, float, float]]) -> tuple[list[float], list[float]]:
    table = np.array(rows)
    weighted = table[:, :3] / table[:, 3:]
    inverse = np.linalg.inv(weighted[:, :2].T @ weighted[:, :2])
    return (inverse @ weighted[:, :2].T @ weighted[:, 2]).tolist(), np.sqrt(np.diag(inverse)).tolist()


def record_against_sun(channels: Floats, spectrum: Floats) -> RecordAgainstSun | None:
    # Return shift and width of a record (channel,) of daylight; None where it has too few channels.
    #
    # In every window the logarithm of the table at a shift and a width, with free strengths of oxygen and
    # water and plus a polynomial, is fitted to the logarithm of the record. Windows are weighted by the
    # inverse of their variance; where they disagree by more than their uncertainty, the uncertainty of the
    # result is increased.
    windows = [_window(channels, spectrum, low, high) for low, high in SUN_LINES.windows]
    fits = np.array([fit for fit in windows if fit is not None])
    if not len(fits):
        return None
    numbers = []
    for value, uncertainty, min_uncertainty in (
        (fits[:, 0], fits[:, 1], SUN_LINES.least_shift_u_nm),
        (fits[:, 2], fits[:, 3], SUN_LINES.least_width_u_nm),
    ):
        weight = 1.0 / (uncertainty**2 + min_uncertainty**2)
        mean = float(weight @ value / weight.sum())
        chi2 = float(weight @ (value - mean) ** 2) / max(len(value) - 1, 1)
        numbers += [mean, float(np.sqrt(max(chi2, 1.0) / weight.sum() + min_uncertainty**2))]
    return RecordAgainstSun(*numbers)


def _window(
    channels: Floats, spectrum: Floats, low: float, high: float
) -> tuple[float, float, float, float] | None:
    # Return shift and width of a window, each with its uncertainty [nm]; None without a minimum.
    is_used = (channels >= low) & (channels <= high) & (spectrum > 0)
    if is_used.sum() < SUN_LINES.degree + 1 + 12:
        return None
    wavelength, log = channels[is_used], np.log(spectrum[is_used])
    shifts, widths, log_sun, basis = _trials(tuple(wavelength.tolist()))
    residual = log - log_sun
    residual = residual - np.einsum("swck,swk->swc", basis, np.einsum("swck,swc->swk", basis, residual))
    costs = np.einsum("swc,swc->sw", residual, residual)
    i, j = divmod(int(costs.argmin()), widths.size)
    if i in (0, shifts.size - 1) or j in (0, widths.size - 1):
        return None
    # minimum of the paraboloid around the best trial, with its uncertainties
    costs_around = costs[i - 1 : i + 2, j - 1 : j + 2]
    gradient = (
        np.array([costs_around[2, 1] - costs_around[0, 1], costs_around[1, 2] - costs_around[1, 0]]) / 2.0
    )
    mixed = (costs_around[2, 2] - costs_around[2, 0] - costs_around[0, 2] + costs_around[0, 0]) / 4.0
    curvature = np.array(
        [
            costs_around[2, 1] - 2 * costs_around[1, 1] + costs_around[0, 1],
            costs_around[1, 2] - 2 * costs_around[1, 1] + costs_around[1, 0],
        ]
    )
    hessian = np.array([[curvature[0], mixed], [mixed, curvature[1]]])
    step = np.clip(-np.linalg.solve(hessian, gradient), -1.0, 1.0)
    freedom = wavelength.size - (SUN_LINES.degree + 1) - 4
    variance = 2.0 * np.diag(np.linalg.inv(hessian)) * costs_around[1, 1] / max(freedom, 1)
    steps = np.array([shifts[1] - shifts[0], widths[1] - widths[0]])
    uncertainty = np.sqrt(np.maximum(variance, 0.0)) * steps
    shift, width = shifts[i] + step[0] * steps[0], widths[j] + step[1] * steps[1]
    return shift, uncertainty[0], width, uncertainty[1]


@functools.lru_cache(maxsize=4)  # the lines of a collect have the same channels
def _trials(channels: tuple[float, ...]) -> tuple[Floats, Floats, Floats, Floats]:
    # Return trial shifts (shift,) and widths (width,) [nm], logarithms of the sun above the air (shift,
    # width, channel), and an orthonormal basis (shift, width, channel, term): polynomial, then gases, 0 for
    # missing gases.
    wavelength = np.array(channels)
    smooth = np.polynomial.legendre.legvander(
        (wavelength - wavelength.mean()) / (np.ptp(wavelength) / 2.0), SUN_LINES.degree
    )
    first, last, step = SUN_LINES.shifts_nm
    shifts = np.arange(first, last + step / 2, step)
    first, last, step = SUN_LINES.widths_nm
    widths = np.arange(first, last + step / 2, step)
    log_sun = np.empty((shifts.size, widths.size, wavelength.size))
    basis = np.zeros((*log_sun.shape, smooth.shape[1] + 2))
    for j, width in enumerate(widths):
        # logarithms of the table (shift, channel) of the sun above the air, and the changes by two gases
        # (gas, shift, channel), at air mass 1.5 and 1.4 cm of water
        table, tables_of_gases = sunlight_table(), disort_tables()
        wavelengths, band_width = wavelength + shifts[:, None], float(width)
        from_mean = np.abs(table.wavelength - wavelengths.mean(axis=1, keepdims=True))
        half_span = np.ptp(wavelengths, axis=1, keepdims=True) / 2.0
        is_near = from_mean < half_span + 3.0 * band_width  # (shift, cell)
        cells = is_near.any(axis=0)
        squared_width = max(band_width**2 - 8.0 * np.log(2.0) * SUN_LINES.cell_nm**2 / 12.0, 0.25)
        offset = table.wavelength[cells] - wavelengths[..., None]
        response = np.exp(-4.0 * np.log(2.0) / squared_width * offset**2) * is_near[:, None, cells]
        response /= response.sum(axis=2, keepdims=True)
        sun = table.extraterrestrial[cells]
        oxygen, water = (
            np.interp(table.wavelength[cells], tables_of_gases["line"], tables_of_gases[name][place])
            for name, place in (("oxygen_depth", np.s_[:, 1]), ("water_depth", np.s_[:, 1, 3]))
        )
        lights = np.stack([sun, sun * np.exp(-oxygen), sun * np.exp(-water)], axis=-1)
        logs = np.moveaxis(np.log(response @ lights), -1, 0)
        log_sun[:, j], gases = logs[0], logs[1:] - logs[0]
        has_lines = np.ptp(gases, axis=2) > 1e-4  # (gas, shift)
        for group in itertools.product((False, True), repeat=len(gases)):
            shifts_of_group = np.flatnonzero((has_lines == np.array(group)[:, None]).all(axis=0))
            terms = np.moveaxis(gases[np.flatnonzero(group)][:, shifts_of_group], 0, -1)
            terms_of_group = np.concatenate(
                [np.broadcast_to(smooth, (shifts_of_group.size, *smooth.shape)), terms], axis=-1
            )
            basis[shifts_of_group, j, :, : terms_of_group.shape[-1]] = np.linalg.qr(terms_of_group)[0]
    return shifts, widths, log_sun, basis


# --- apply wavelengths and widths measured in flight to a flight line --------------------------------------


#: Variables of an alignment that are used.
_VARIABLES = (
    "flag",
    "shift_correction",
    "wavelength_shift_u",
    "fwhm_factor",
    "fwhm_u",
    "column",
    "window_centre",
)
_WINDOW = "window"


@takes_quantities()
def apply_alignment(
    line: xr.Dataset, alignment: xr.Dataset, *, degree: int = 2, fwhm: bool = True
) -> xr.Dataset:
    """Return the line with wavelengths and widths from `hyperpaint.alignment.align_to_irradiance`.

    Parameters
    ----------
    line
        The flight line that was measured.
    alignment
        Result of `hyperpaint.alignment.align_to_irradiance`, whole or in groups of columns; flagged columns
        are not used.
    degree
        Degree of the polynomial over columns that smooths the shift.
    fwhm
        Whether widths are replaced too.

    Returns
    -------
    Dataset
        The line with ``wavelength_shift`` (cross_track), or (band, cross_track) with several windows or where
        the line has these dims, float64 [nm]; ``fwhm`` (band), float64 [nm], times the mean factor, since the
        table has no width of a column. Between windows both are linear in wavelength, beyond them constant.
        The attribute ``alignment`` describes the correction; attributes of an earlier comparison
        (``alignment_shift`` ..., see `align`), and reflectance, which belongs to other wavelengths, are
        removed. ``wavelength`` is unchanged, so that flight lines keep one axis: the shift at the centre
        column need not be zero.

    Raises
    ------
    SchemaError
        ``line`` or ``alignment`` lacks variables or dims, the alignment belongs to another line, or too few
        columns are reliable. All problems of a kind are listed.

    Notes
    -----
    Columns are weighted by the inverse of their variance, and less the farther they lie from the curve
    (Huber's weights, at 1.5 times the scatter), so that a column with a bad element does not change its
    neighbours.

    Examples
    --------
    >>> from hyperpaint.alignment import align_to_irradiance
    >>> from hyperpaint.simulation import simulate_line
    >>> line = simulate_line(lines=16, bands=272, columns=3, smile_nm=0.0)
    >>> moved = line.assign_coords(wavelength=line.wavelength - 0.4)
    >>> mended = apply_alignment(moved, align_to_irradiance(moved), degree=1)
    >>> bool((abs(mended.wavelength_shift - 0.4) < 0.1).all())
    True
    """
    dataset = rename_to_roles(line)
    declared = require(
        dataset,
        ["wavelength", "fwhm", *(n for n in ("wavelength_shift",) if n in dataset.variables)],
        "the alignment",
    )
    SchemaError.raise_if(
        CROSS_TRACK not in dataset.dims,
        f"the line has dims {', '.join(map(str, dataset.dims))}",
        expected=f"a dim {CROSS_TRACK!r}",
        code="dim-missing",
    )
    columns = dataset.sizes[CROSS_TRACK]
    # the alignment with a leading dim of windows
    with Problems("this dataset is not a result of align_to_irradiance", SchemaError) as problems:
        for kind, names, present, code in (
            ("", _VARIABLES, alignment.variables, "variable-missing"),
            ("dim ", (BAND, CROSS_TRACK), alignment.dims, "dim-missing"),
        ):
            for name in (name for name in names if name not in present):
                problems.add(f"{kind}{name!r} is missing", code=code)
        problems.add_if(
            _WINDOW not in alignment.attrs,
            f"attribute {_WINDOW!r} is missing",
            code="attribute-missing",
        )
    windows = alignment if _WINDOW in alignment.dims else alignment.expand_dims(_WINDOW)
    for name in _VARIABLES[:5]:
        if set(windows[name].dims) != {_WINDOW, CROSS_TRACK}:
            dims = ", ".join(map(str, alignment[name].dims)) or "no dim"
            problems.add(f"{name!r} is on {dims}", expected=CROSS_TRACK, code="dims-wrong")
    problems.raise_if_any()
    windows = windows.transpose(_WINDOW, ...)
    is_reliable = windows["flag"].values == 0
    with Problems("the alignment cannot be applied", SchemaError) as problems:
        problems.add_if(
            windows.sizes[BAND] != dataset.sizes[BAND]
            or not -0.5 < float(windows["column"].max()) <= columns - 1
            or not has_labels_of(alignment, dataset, (CROSS_TRACK,)),
            "it belongs to a line with other bands or columns",
            code="grid-mismatch",
        )
        problems.add_if(degree < 0, f"degree={degree}", expected="0 or more", code="value-out-of-range")
        for centre, number in zip(np.ravel(windows["window_centre"]), is_reliable.sum(axis=1), strict=True):
            problems.add_if(
                number < degree + 1,
                f"{number} of {is_reliable.shape[1]} columns are reliable at {centre:.0f} nm",
                expected=f"at least {degree + 1} for a polynomial of degree {degree}",
                mend="see 'flag', or average groups of columns",
                code="columns-too-few",
            )
    # correction of the shift (window, column) [nm], and mean width factor (window,)
    smoothed = [
        _smoothed(windows.isel(window=w, **{CROSS_TRACK: is_reliable[w]}), columns, degree)
        for w in range(len(is_reliable))
    ]
    correction, factor = (np.array(values) for values in zip(*smoothed, strict=True))
    centres, wavelength = np.atleast_1d(windows["window_centre"].values), declared["wavelength"].values
    order = np.argsort(centres)

    def over_bands(values: Floats) -> Floats:
        return np.asarray(np.interp(wavelength, centres[order], values[order]))

    shift = (
        xr.DataArray(correction[0], dims=CROSS_TRACK)
        if len(order) == 1
        else xr.DataArray(np.apply_along_axis(over_bands, 0, correction), dims=(BAND, CROSS_TRACK))
    )
    if "wavelength_shift" in declared:
        shift = shift + xr.DataArray(
            declared["wavelength_shift"].values, dims=declared["wavelength_shift"].dims
        )
    order_of_dims = [dim for dim in (BAND, CROSS_TRACK) if dim in shift.dims]
    aligned = without_products(dataset).assign_coords(
        wavelength_shift=label(shift.transpose(*order_of_dims), "wavelength_shift")
    )
    sentence = (
        f"wavelength_shift corrected in flight against the irradiance record at {windows.attrs[_WINDOW]}, "
        f"mean {correction.mean():+.3f} nm"
    )
    if fwhm:
        width = xr.DataArray(declared["fwhm"].values * over_bands(factor), dims=BAND)
        aligned = aligned.assign_coords(fwhm=label(width, "fwhm"))
        sentence += f"; fwhm times {', '.join(f'{value:.4f}' for value in factor)}"
    return restated(aligned, sentence)


def _smoothed(window: xr.Dataset, columns: int, degree: int) -> tuple[Floats, float]:
    # Return the correction of the shift (column,) [nm] and the mean width factor of a window.
    scale = max((columns - 1) / 2.0, 1.0)
    basis = np.polynomial.legendre.legvander(window["column"].values / scale - 1.0, degree)
    shift, spread = window["shift_correction"].values, np.maximum(window["wavelength_shift_u"].values, 1e-6)
    weight = 1.0 / spread
    for _ in range(20):
        coefficients = np.linalg.lstsq(basis * weight[:, None], shift * weight, rcond=None)[0]
        deviation = np.abs(shift - basis @ coefficients) / spread
        scatter = max(1.4826 * float(np.median(deviation)), 1e-3)
        # square roots: a weight multiplies the residual, which is then squared
        weight = np.sqrt(np.minimum(1.0, 1.5 * scatter / np.maximum(deviation, 1e-12))) / spread
    basis_of_columns = np.polynomial.legendre.legvander(np.arange(columns) / scale - 1.0, degree)
    factor, inverse_variance = (
        window["fwhm_factor"].values,
        1.0 / np.maximum(window["fwhm_u"].values, 1e-6) ** 2,
    )
    is_inlier = np.abs(factor - np.median(factor)) <= 3.0 * 1.4826 * np.median(
        np.abs(factor - np.median(factor))
    )
    return basis_of_columns @ coefficients, float(
        (factor * inverse_variance)[is_inlier].sum() / inverse_variance[is_inlier].sum()
    )


def without_products(dataset: xr.Dataset) -> xr.Dataset:
    # Return a line without products that depend on wavelengths: reflectance and panel results.
    names = (
        "reflectance",
        "coarse_reflectance",
        "reflectance_u_random",
        "reflectance_u_systematic",
        "irradiance_misfit",
    )
    return dataset.drop_vars(
        [name for name in dataset.variables if name in names or str(name).startswith("panel_")]
    )


def restated(
    line: xr.Dataset, sentence: str, *, numbers: Mapping[str, float] | None = None, state: str | None = None
) -> xr.Dataset:
    # Return a line whose attribute ``alignment`` ends with ``sentence``.
    #
    # ``numbers`` and ``state`` replace those of an earlier comparison.
    earlier = line.attrs.get("alignment")
    attrs = {name: value for name, value in line.attrs.items() if not str(name).startswith("alignment_")}
    attrs |= numbers or {}
    attrs["alignment"] = f"{earlier}; then {sentence}" if earlier else sentence
    if state is not None:
        attrs["alignment_state"] = state
    return line.drop_attrs(deep=False).assign_attrs(attrs)
