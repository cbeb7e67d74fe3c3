"""Wavelengths and line widths of the camera in flight, with the daylight as the lamp.

The irradiance record and the scene show the same absorption bands. Paint changes them smoothly over
some tens of nanometres; where the ratio of radiance to matched irradiance is not smooth, the camera's
wavelengths or widths are not those declared. The check is relative to the irradiance spectrometer, as
reflectance is.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import xarray as xr

from hyperpaint.base import schema
from hyperpaint.base.arrays import Array, Floats, Progress
from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.schema import ALONG_TRACK, BAND, CROSS_TRACK
from hyperpaint.base.units import takes_quantities

from .lamp import Declared, mean_light, table_of_bands
from .least_squares import (
    FLAGS,
    Estimate,
    Fit,
    Window,
    bands_of,
    checked_windows,
    combined,
    default_windows,
    estimate,
    fewest_bands,
    fit_columns,
    stacked,
)
from .oxygen import mean_over_lines, radiance_of_bands

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
    r"""In-flight spectral calibration: smile and FWHM of every column from the daylight's own lines.

    Found are the wavelength shift and the width at which the ratio of radiance to irradiance is smoothest.
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
        (740, 800) and (890, 985), or that of them that camera and record have.
    separate
        Report every window by itself, for a shift or a width that changes with wavelength, instead of their
        weighted mean.
    lines
        Lines to average; all by default.
    degree
        Of the polynomial that stands for the surface's own spectrum.
    group
        Neighbouring columns that are averaged together.
    max_shift
        How far from the declared wavelengths to look [nm].
    max_uncertainty
        Standard uncertainty of the shift above which a column is flagged [nm].
    progress
        Called with lines done and lines to do.

    Returns
    -------
    Dataset
        By ``cross_track`` (and before it ``window``, with ``separate``), float64, each with ``units``:
        ``wavelength_shift`` and ``fwhm`` as found, ``wavelength_shift_u`` and ``fwhm_u``, ``correlation``,
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
    and :math:`P` projects onto polynomials. Pixels with a missing sample in the windows are left out whole,
    since a mean over other pixels in every band would make steps. Uncertainties follow from the residual;
    they know nothing of structure that surfaces have and polynomials lack, such as the foot of vegetation's
    red edge, nor of noise in the irradiance record, which all columns share. The mean over windows weighs
    with the inverse of their covariances.

    The literature ([1]_, [2]_) matches spectra to a modelled atmosphere; here the irradiance record stands in
    its place.

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
    dataset = schema.rename_to_roles(line)
    _check_options(degree, group, max_shift, max_uncertainty)
    declared = Declared.by(dataset)
    windows = default_windows(declared, degree) if window is None else checked_windows(window)
    chosen = bands_of(windows, declared, degree)
    light, level = mean_light(declared, windows, lines)
    used = np.flatnonzero(np.logical_or.reduce(chosen))
    part = dataset if lines is None else dataset.isel({ALONG_TRACK: lines})
    mean, pixels = mean_over_lines(radiance_of_bands(part, used), level, progress)
    spectrum = np.full((declared.wavelength.size, mean.shape[1]), np.nan)
    spectrum[used] = mean
    spectrum, pixels, shift, column = _grouped(spectrum, pixels, declared.shift(mean.shape[1]), group)
    fits = []
    for inside in chosen:
        limits = (float(shift[inside].min()) - max_shift, float(shift[inside].max()) + max_shift)
        table = table_of_bands(declared.light, light, declared.bands(inside), limits, fewest_bands(degree))
        fits.append(fit_columns(table, spectrum[inside], shift[inside], degree, max_shift))
    apart = [estimate(fit, inside, declared, shift) for fit, inside in zip(fits, chosen, strict=True)]
    report = _labelled(apart if separate else [combined(apart)], pixels, column, max_uncertainty)
    return _with_spectra(report, fits, chosen, declared, separate).assign_attrs(
        window="; ".join(f"{low:g}-{high:g} nm" for low, high in windows),
        degree=degree,
        lines=len(level),
        srf_shape=declared.imager.shape,
    )


def _check_options(degree: int, group: int, max_shift: float, max_uncertainty: float) -> None:
    problems = Problems("the line cannot be aligned", SchemaError)
    for is_valid, found, expected in (
        (0 <= degree <= 12, f"degree={degree}", "0 to 12"),
        (group >= 1, f"group={group}", "1 or more columns"),
        (0.0 < max_shift <= 10.0, f"max_shift={max_shift:g}", "above 0, at most 10 nm"),
        (max_uncertainty > 0.0, f"max_uncertainty={max_uncertainty:g}", "above 0 nm"),
    ):
        if not is_valid:
            problems.add(found, expected=expected, code="value-out-of-range")
    problems.raise_if_any()


def _grouped(
    spectrum: Floats, pixels: npt.NDArray[np.int64], shift: Floats, group: int
) -> tuple[Floats, npt.NDArray[np.int64], Floats, Floats]:
    # Spectra, pixels, shifts and column numbers of groups of neighbouring columns
    columns = np.arange(pixels.size, dtype=np.float64)
    if group == 1:
        return spectrum, pixels, shift, columns
    starts = np.arange(0, pixels.size, group)
    # leave out whole columns with a bad element: without it the group's mean would show another surface in
    # that band alone
    in_any_column = np.isfinite(spectrum).any(axis=1, keepdims=True)
    weight = np.where(np.isfinite(spectrum).all(axis=0, where=in_any_column), pixels, 0)
    total = np.add.reduceat(weight, starts)
    size = np.diff(np.append(starts, pixels.size))
    with np.errstate(invalid="ignore", divide="ignore"):
        share = weight / np.repeat(total, size)
    mean = np.add.reduceat(np.where(share > 0, spectrum, 0.0) * share, starts, axis=1)
    return (
        np.where(in_any_column & (total > 0), mean, np.nan),
        total,
        np.add.reduceat(shift, starts, axis=1) / size,
        np.add.reduceat(columns, starts) / size,
    )


def _labelled(
    estimates: list[Estimate], pixels: npt.NDArray[np.int64], column: Floats, max_uncertainty: float
) -> xr.Dataset:
    # Estimates as a Dataset (window, cross_track), with flags of noise and of few pixels
    value, covariance, flag = (stacked(estimates, name) for name in ("value", "covariance", "flag"))
    spread = np.sqrt(np.stack([covariance[..., 0, 0], covariance[..., 1, 1]], axis=-1))
    fwhm = np.array([estimate.fwhm for estimate in estimates])[:, None]
    with np.errstate(invalid="ignore"):
        noisy = ~(spread[..., 0] <= max_uncertainty) & ~np.isnan(value[..., 0])
        correlation = covariance[..., 0, 1] / (spread[..., 0] * spread[..., 1])
    flag |= np.where(noisy, FLAGS["too_noisy"], 0).astype(np.uint8)
    flag |= np.where(pixels < MIN_PIXELS, FLAGS["no_data"], 0).astype(np.uint8)
    columns = {
        "wavelength_shift": value[..., 0] + stacked(estimates, "shift"),
        "wavelength_shift_u": spread[..., 0],
        "shift_correction": value[..., 0],
        "fwhm": value[..., 1] * fwhm,
        "fwhm_u": spread[..., 1] * fwhm,
        "fwhm_factor": value[..., 1],
        "correlation": correlation,
        **{name: stacked(estimates, name) for name in ("residual", "residual_declared", "chi2")},
        "flag": flag,
    }
    report = xr.Dataset({name: (("window", CROSS_TRACK), values) for name, values in columns.items()})
    report["pixels"] = (CROSS_TRACK, pixels)
    centre_attrs = {"units": "nm", "long_name": "Mean wavelength of the bands of a window"}
    return report.assign_coords(
        column=(CROSS_TRACK, column, {"long_name": "Column, or mean column of a group", "units": "1"}),
        window_centre=("window", [estimate.centre for estimate in estimates], centre_attrs),
    )


def _with_spectra(
    report: xr.Dataset, fits: list[Fit], chosen: list[Array], declared: Declared, separate: bool
) -> xr.Dataset:
    shown = report if separate else report.isel(window=0)
    for name in ("departure", "departure_declared"):
        values = np.full((declared.wavelength.size, report.sizes[CROSS_TRACK]), np.nan)
        for fit, inside in zip(fits, chosen, strict=True):
            values[inside] = getattr(fit, name)
        shown[name] = ((BAND, CROSS_TRACK), values)
    shown = shown.assign_coords(wavelength=(BAND, declared.wavelength, schema.VARIABLES["wavelength"].attrs))
    for name in map(str, shown.data_vars):
        if name in schema.VARIABLES:
            shown[name].attrs = schema.VARIABLES[name].attrs
        else:
            units, meaning = _REPORTED[name]
            shown[name].attrs = {"long_name": meaning, "units": units}
    shown["flag"].attrs = {
        "long_name": _REPORTED["flag"][1],
        "flag_masks": np.array(list(FLAGS.values()), np.uint8),
        "flag_meanings": " ".join(FLAGS),
    }
    return shown
