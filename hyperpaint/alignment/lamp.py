"""Declared bands and irradiance record of a flight line, and the irradiance matched to the bands.

Mean spectra of columns, and the residual oxygen A band in them: a sign of wrong wavelengths.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base import (
    ALONG_TRACK,
    BAND,
    CROSS_TRACK,
    IRRADIANCE_TIME,
    IRRADIANCE_WAVELENGTH,
    Array,
    Bools,
    Floats,
    Indices,
    Ints,
    Progress,
    SchemaError,
    documented,
    rename_to_roles,
    require,
    takes_quantities,
)
from hyperpaint.light.illumination import line_light
from hyperpaint.light.responses import (
    GAUSSIAN_SIGMA,
    Matching,
    Responses,
    log_slope,
    matching_operator,
    mean_responsivity,
)
from hyperpaint.radiometry.counts_to_reflectance import radiance, reflectance
from hyperpaint.radiometry.slabs import line_chunked
from hyperpaint.radiometry.stray_light import described

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
    names = ["wavelength", "reflectance", *(n for n in ("wavelength_shift",) if n in dataset.variables)]
    arrays = require(dataset, names, "the oxygen residual")
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
    residual = xr.DataArray(depth, dims=CROSS_TRACK, name="oxygen_residual")
    return residual.assign_attrs(
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
    """The bands of a line and their light, in the units of the table."""

    time: Array  # (line,): At mid exposure
    # wavelength, fwhm (band,): [nm]
    wavelength: Floats
    fwhm: Floats
    good: Bools  # (band,), bool: all True by default
    wavelength_shift: Floats  # () or (column,) or (band, column): [nm]; 0 by default
    imager: Responses  # Responses of all bands
    light: Light  # The irradiance record

    @classmethod
    def by(cls, dataset: xr.Dataset) -> Declared:
        # Return the declarations of a dataset; SchemaError if any are missing.
        names = [*_NEEDED, *(name for name in _OPTIONAL if name in dataset.variables)]
        arrays = require(dataset, names, "the alignment")
        values: dict[str, Array] = {name: np.asarray(array.values) for name, array in arrays.items()}
        wavelength, fwhm = values["wavelength"], values["fwhm"]
        slope = (
            log_slope(wavelength, mean_responsivity(values["radiance_gain"]), 2.0 * fwhm)
            if "radiance_gain" in values
            else None
        )
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
                slope=slope,
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

    def variance_at(self, factor: Floats) -> Floats:
        # Return the variance of the responses (band, column) at widths (column,) [nm2].
        position = np.interp(factor, self.factors, np.arange(self.factors.size))
        lower = np.minimum(position.astype(np.int64), self.factors.size - 2)
        return np.asarray(
            self.variance[lower].T + (position - lower) * (self.variance[lower + 1] - self.variance[lower]).T
        )


def mean_light(
    declared: Declared, windows: list[tuple[float, float]], lines: slice | None
) -> tuple[Floats, Floats]:
    # Return the record's mean spectrum in units of its level (channel,), and the level of every line.
    share, level_of_line = shares_of_samples(declared, windows, lines)
    is_used = share > 0.0
    return share[is_used] @ declared.light.spectra[is_used], level_of_line


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
    imagers = [_widened(bands, float(factor)) for factor in FACTORS]
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


def responses_table(
    spectrometer: Responses, imager: Responses, spectrum: Floats, limits: tuple[float, float], widths: Floats
) -> tuple[Floats, Floats, Floats]:
    # Return shifts (shift,) [nm], and the logarithm (shift, width, band) of a spectrum matched to bands.
    #
    # Widths are relative to the declared ones of the spectrometer; otherwise as `table_of_bands`. The third
    # result are the weights (band, channel) of the channels at the middle shift and the declared width.
    shifts = _shift_nodes(limits)
    spectrometers = [replace(spectrometer, fwhm=spectrometer.fwhm * width) for width in widths]
    operators = [_operator(widened, imager, shifts) for widened in spectrometers]
    weights = operators[int(np.abs(widths - 1.0).argmin())].weights[len(shifts) // 2]
    logs = np.stack([_log_matched(matching, spectrum) for matching in operators], axis=1)
    return np.array(shifts), logs, weights


def _shift_nodes(limits: tuple[float, float]) -> tuple[float, ...]:
    # Return even shifts [nm] around the limits.
    first, last = np.floor(limits[0] / SHIFT_STEP) - 1, np.ceil(limits[1] / SHIFT_STEP) + 1
    return tuple((np.arange(first, last + 1) * SHIFT_STEP).tolist())


@functools.lru_cache(maxsize=132)
def _operator(spectrometer: Responses, imager: Responses, shifts: tuple[float, ...]) -> Matching:
    # Cached for all flight lines of a camera: some windows, at all widths of camera or record.
    return matching_operator(spectrometer, imager, shifts)


def _widened(imager: Responses, factor: float) -> Responses:
    # Return responses of another width; the pixel width of a slit response does not change.
    return (
        replace(imager, offset=np.asarray(imager.offset) * factor)
        if imager.shape == "tabulated"
        else replace(imager, fwhm=imager.fwhm * factor)
    )


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
