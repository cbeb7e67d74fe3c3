"""Wavelengths and line widths of the camera in flight, with the daylight as the lamp.

The irradiance record and the scene show the same absorption lines. What paint does to them is smooth over
some tens of nanometres; where the ratio of radiance to matched irradiance is not smooth, the camera's
wavelengths or widths are not those declared. The check is relative to the irradiance spectrometer, as
reflectance is.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from . import schema
from .alignment_fit import FLAGS, Estimate, Fit, combined, estimate, fit_columns, irradiance_table
from .column_means import Progress, mean_over_lines
from .errors import Problems, SchemaError
from .radiometry import radiance
from .responses import Responses, log_slope
from .schema import ALONG_TRACK, BAND, CROSS_TRACK, IRRADIANCE_TIME, IRRADIANCE_WAVELENGTH
from .synchrony import line_light

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["Window", "align_to_irradiance"]

Float = npt.NDArray[np.float64]
Array = npt.NDArray[Any]
Window = tuple[float, float]

WINDOWS = ((740.0, 800.0), (890.0, 985.0))
"""Where to look [nm]: the oxygen A band and the water around 940 nm, without vegetation's red edge."""
FEWEST_PIXELS = 8
"""Pixels below which a column tells nothing."""
_RECORD_MARGIN = 15.0
"""How far beyond a window the irradiance record must reach to be used unasked [nm]."""
#: Units and meaning of what the check reports; wavelength_shift and fwhm are those of the table.
_REPORTED = {
    "wavelength_shift_u": ("nm", "Standard uncertainty of the wavelength shift"),
    "shift_correction": ("nm", "Wavelength found minus wavelength declared"),
    "fwhm_u": ("nm", "Standard uncertainty of the full width at half maximum"),
    "fwhm_factor": ("1", "Full width at half maximum found over that declared"),
    "correlation": ("1", "Correlation of the errors of shift and width"),
    "residual": ("1", "Relative departure of the ratio from a smooth curve, root mean square"),
    "residual_declared": ("1", "The same with the declared wavelengths and widths"),
    "chi2": ("1", "Chi square of the windows against their mean, over its degrees of freedom"),
    "pixels": ("1", "Pixels averaged"),
    "departure": ("1", "Relative departure of the ratio from a smooth curve"),
    "departure_declared": ("1", "The same with the declared wavelengths and widths"),
    "flag": ("", "Why a column cannot tell"),
}


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
    r"""Find the wavelength shift and line width of every column from the daylight's own lines.

    Eager: reads the line once, a slab at a time, and changes nothing; see `hyperpaint.apply_alignment`.

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
        ``shift_correction`` and ``fwhm_factor`` (found against declared), ``residual`` and
        ``residual_declared``, ``chi2`` (of the windows against their mean, over its degrees of freedom),
        ``pixels``, ``flag`` (0 where the column can tell); ``departure`` and ``departure_declared`` (band,
        cross_track): the ratio over its smooth curve minus 1, for a look. Coordinate ``column``: the mean
        column of a group.

    Raises
    ------
    SchemaError, UnitsError, TimeError
        Variables are missing; the window holds too few bands, or the irradiance record does not cover it or
        no line of the flight; options that cannot be. All problems of a kind are listed.

    Notes
    -----
    With :math:`\bar L_b` the mean over lines of radiance over the light's level, and :math:`\bar E` the
    record's mean in the same way, the shift :math:`\delta` and width factor :math:`f` of a column minimise

    .. math:: \sum_b \big( (1 - P) \ln (\bar L_b / \bar E_b(\delta, f)) \big)^2

    where :math:`\bar E_b` is matched to the band's response (`hyperpaint.responses.matching_operator`) and
    :math:`P` projects onto polynomials. Pixels with a missing sample in the windows are left out whole, since
    a mean over other pixels in every band would make steps. Uncertainties follow from the residual; they know
    nothing of structure that surfaces have and polynomials lack, such as the foot of vegetation's red edge,
    nor of noise in the irradiance record, which all columns share. The mean over windows weighs with the
    inverse of their covariances.

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
    known = _known(dataset)
    windows = _default_windows(known, degree) if window is None else _windows(window)
    chosen = _bands_of(windows, known, degree)
    light, level = _mean_light(known, windows, lines)
    used = np.flatnonzero(np.logical_or.reduce(chosen))
    part = dataset.isel({BAND: used})
    if lines is not None:
        part = part.isel({ALONG_TRACK: lines})
    mean, pixels = mean_over_lines(radiance(part)["radiance"], level, progress)
    spectrum = np.full((known["wavelength"].size, mean.shape[1]), np.nan)
    spectrum[used] = mean
    spectrum, pixels, shift, column = _grouped(spectrum, pixels, _declared_shift(known, mean.shape[1]), group)
    fits = [_fit_window(inside, known, light, spectrum, shift, degree, max_shift) for inside in chosen]
    windows_apart = [estimate(fit, inside, known, shift) for fit, inside in zip(fits, chosen, strict=True)]
    made = windows_apart if separate else [combined(windows_apart)]
    found = _labelled(made, pixels, column, max_uncertainty)
    return _with_spectra(found, fits, chosen, known, separate).assign_attrs(
        window="; ".join(f"{low:g}-{high:g} nm" for low, high in windows),
        degree=degree,
        lines=len(level),
        srf_shape=known["srf_shape"],
    )


def _default_windows(known: Mapping[str, Any], degree: int) -> list[Window]:
    """Return those of `WINDOWS` that camera and record have; all of them where they have none."""
    channels, wavelength = known[IRRADIANCE_WAVELENGTH], known["wavelength"]
    good = np.asarray(known.get("good", np.ones(wavelength.size)), bool)
    there = [
        (low, high)
        for low, high in WINDOWS
        if (good & (wavelength >= low) & (wavelength <= high)).sum() >= degree + 6
        and channels.min() <= low - _RECORD_MARGIN
        and channels.max() >= high + _RECORD_MARGIN
    ]
    return there or [*WINDOWS[:1]]


def _windows(window: Any) -> list[Window]:
    """Return the windows, in the order given, or raise."""
    given = np.asarray(window, np.float64)
    problems = Problems(f"window={window!r} cannot be used", SchemaError)
    if given.ndim not in (1, 2) or given.shape[-1] != 2 or not given.size:
        problems.add("expected a lowest and a highest wavelength [nm], or several such pairs")
        problems.raise_if_any()
    pairs = [(float(low), float(high)) for low, high in np.atleast_2d(given)]
    for low, high in pairs:
        if not (np.isfinite([low, high]).all() and low < high):
            problems.add(f"({low:g}, {high:g}): the lowest wavelength must be below the highest [nm]")
    in_order = sorted(pairs)
    for (_, high), (low, _) in itertools.pairwise(in_order):
        if low < high:
            problems.add(f"windows overlap from {low:g} to {high:g} nm")
    problems.raise_if_any()
    return pairs


def _check_options(degree: int, group: int, max_shift: float, max_uncertainty: float) -> None:
    problems = Problems("the alignment cannot be found", SchemaError)
    if not 0 <= degree <= 12:
        problems.add(f"degree={degree}, expected 0 to 12")
    if group < 1:
        problems.add(f"group={group}, expected a number of columns")
    if not 0.0 < max_shift <= 10.0:
        problems.add(f"max_shift={max_shift:g}, expected a length up to 10 nm")
    if not max_uncertainty > 0.0:
        problems.add(f"max_uncertainty={max_uncertainty:g}, expected a length above 0 nm")
    problems.raise_if_any()


def _known(dataset: xr.Dataset) -> dict[str, Any]:
    """Return the small variables of the line by name, as arrays in the units of the table."""
    needed = ["time", "wavelength", "fwhm", "irradiance", "irradiance_fwhm"]
    needed += [IRRADIANCE_TIME, IRRADIANCE_WAVELENGTH]
    optional = ["wavelength_shift", "good", "band_spacing", "radiance_gain", "irradiance_max_gap"]
    optional += ["srf", "srf_offset"]
    found = schema.require(
        dataset, [*needed, *(name for name in optional if name in dataset.variables)], "the alignment"
    )
    values: dict[str, Any] = {name: np.asarray(array.values) for name, array in found.items()}
    values["srf_shape"] = str(dataset.attrs.get("srf_shape", "gaussian"))
    values["irradiance_srf_shape"] = str(dataset.attrs.get("irradiance_srf_shape", "gaussian"))
    return values


def _bands_of(windows: list[Window], known: Mapping[str, Any], degree: int) -> list[Array]:
    """Return which good bands lie in each window, (band,) bool."""
    wavelength = known["wavelength"]
    good = np.asarray(known.get("good", np.ones(wavelength.size)), bool)
    chosen = [good & (wavelength >= low) & (wavelength <= high) for low, high in windows]
    problems = Problems("the alignment cannot be found", SchemaError)
    for (low, high), inside in zip(windows, chosen, strict=True):
        if inside.sum() < degree + 6:
            problems.add(
                f"{low:g} to {high:g} nm holds {inside.sum()} good bands, expected at least {degree + 6} for "
                f"a polynomial of degree {degree}, shift and width; widen the window or lower degree="
            )
    problems.raise_if_any()
    return chosen


def _mean_light(known: Mapping[str, Any], windows: list[Window], lines: slice | None) -> tuple[Float, Float]:
    """Return the record's mean spectrum in units of its level (channel,), and the level of every line."""
    spectra = np.asarray(known["irradiance"], np.float64)
    channels = known[IRRADIANCE_WAVELENGTH]
    inside = (channels >= min(w[0] for w in windows)) & (channels <= max(w[1] for w in windows))
    # a channel that is missing nearly always costs its bands; a spectrum that lacks others is left out
    inside &= np.isnan(spectra).mean(axis=0) <= 0.1
    if not inside.any():
        msg = (
            f"the irradiance record ({channels.min():g} to {channels.max():g} nm) holds nothing in the "
            "window; there is no lamp to align to"
        )
        raise SchemaError(msg)
    level = spectra[:, inside].mean(axis=1)
    level = np.where(level > 0.0, level, np.nan)
    times = known["time"] if lines is None else known["time"][lines]
    gap = known.get("irradiance_max_gap")
    lit = line_light(times, known[IRRADIANCE_TIME], level, None if gap is None else float(gap))
    before, after, weight = lit.before, lit.after, lit.weight
    level_of_line = level[before] + weight * (level[after] - level[before])
    seen = np.flatnonzero(np.isfinite(level_of_line))
    if seen.size == 0:
        msg = "no line of the flight has irradiance at its time; are the clocks right?"
        raise SchemaError(msg)
    share = np.zeros(len(spectra))
    np.add.at(share, before[seen], (1.0 - weight[seen]) / level_of_line[seen])
    np.add.at(share, after[seen], weight[seen] / level_of_line[seen])
    used = share > 0.0
    return (share[used] / seen.size) @ spectra[used], level_of_line


def _declared_shift(known: Mapping[str, Any], columns: int) -> Float:
    """Return the declared shift of every element (band, column) [nm]."""
    given = np.asarray(known.get("wavelength_shift", 0.0), np.float64)
    if not (np.isfinite(given).all() and np.abs(given).max() <= 20.0):
        msg = "'wavelength_shift' must be finite and at most 20 nm; check its units"
        raise SchemaError(msg)
    return np.broadcast_to(given, (known["wavelength"].size, columns))


def _grouped(
    spectrum: Float, pixels: npt.NDArray[np.int64], shift: Float, group: int
) -> tuple[Float, npt.NDArray[np.int64], Float, Float]:
    """Return spectra, pixels, shifts and column numbers of groups of neighbouring columns."""
    columns = np.arange(pixels.size, dtype=np.float64)
    if group == 1:
        return spectrum, pixels, shift, columns
    starts = np.arange(0, pixels.size, group)
    # an element that is bad in one column is left out of the group's mean; its gain makes no step in radiance
    # but its neighbours' surface does, so that columns with one are weighed out whole
    weight = np.where(np.isfinite(spectrum).all(axis=0, where=_any_column(spectrum)), pixels, 0)
    total = np.add.reduceat(weight, starts)
    with np.errstate(invalid="ignore", divide="ignore"):
        share = weight / np.repeat(total, np.diff(np.append(starts, pixels.size)))
    mean = np.add.reduceat(np.where(share > 0, spectrum, 0.0) * share, starts, axis=1)
    size = np.diff(np.append(starts, pixels.size))
    return (
        np.where(_any_column(spectrum) & (total > 0), mean, np.nan),
        total,
        np.add.reduceat(shift, starts, axis=1) / size,
        np.add.reduceat(columns, starts) / size,
    )


def _any_column(spectrum: Float) -> Array:
    """Return which bands are there in any column, (band, 1)."""
    return np.asarray(np.isfinite(spectrum).any(axis=1, keepdims=True))


def _imager(known: Mapping[str, Any]) -> Responses:
    """Return the declared responses of all bands."""
    wavelength, fwhm = known["wavelength"], known["fwhm"]
    slope = None
    if "radiance_gain" in known:
        gain = np.asarray(known["radiance_gain"], np.float64)
        usable = np.isfinite(gain) & (gain > 0)
        total = np.where(usable, 1.0 / np.where(usable, gain, 1.0), 0.0).sum(axis=1)
        with np.errstate(invalid="ignore"):
            slope = log_slope(wavelength, total / usable.sum(axis=1), 2.0 * fwhm)
    return Responses(
        wavelength,
        fwhm,
        known["srf_shape"],
        spacing=known.get("band_spacing"),
        slope=slope,
        offset=known.get("srf_offset"),
        table=known.get("srf"),
    )


def _fit_window(
    inside: Array,
    known: Mapping[str, Any],
    light: Float,
    spectrum: Float,
    shift: Float,
    degree: int,
    max_shift: float,
) -> Fit:
    """Return what the bands of one window tell of every column."""
    imager = _imager(known)
    names = ("wavelength", "fwhm", "spacing", "slope", "table")
    parts: dict[str, Any] = {
        name: np.asarray(values)[inside] for name in names if (values := getattr(imager, name)) is not None
    }
    bands = replace(imager, **parts)
    channels = known[IRRADIANCE_WAVELENGTH]
    width = np.broadcast_to(np.asarray(known["irradiance_fwhm"], np.float64), channels.shape)
    # a spectrometer reaches far beyond the window: channels that no response can touch cost memory
    reach = max_shift + np.abs(shift[inside]).max() + 2.0 * bands.reach().max() + 4.0 * width.max()
    near = np.flatnonzero(np.abs(channels - bands.wavelength.mean()) <= np.ptp(bands.wavelength) / 2 + reach)
    near = near[np.argsort(channels[near], kind="stable")]
    spectrometer = Responses(channels[near], width[near], known["irradiance_srf_shape"])
    limits = (float(shift[inside].min()) - max_shift, float(shift[inside].max()) + max_shift)
    table = irradiance_table(spectrometer, bands, light[near], limits)
    covered = np.isfinite(table.log).all(axis=(0, 1))
    if covered.sum() < degree + 6:
        msg = (
            f"the irradiance record ({channels.min():g} to {channels.max():g} nm, {width.max():g} nm wide) "
            f"covers {covered.sum()} of the {covered.size} bands from {bands.wavelength.min():.1f} to "
            f"{bands.wavelength.max():.1f} nm, expected at least {degree + 6}; there is no lamp to align to"
        )
        raise SchemaError(msg)
    return fit_columns(table, spectrum[inside], shift[inside], degree, max_shift)


def _labelled(
    estimates: list[Estimate], pixels: npt.NDArray[np.int64], column: Float, max_uncertainty: float
) -> xr.Dataset:
    """Return estimates as a Dataset (window, cross_track), with flags that know the noise and the pixels."""
    import xarray as xr

    value = np.stack([each.value for each in estimates])
    covariance = np.stack([each.covariance for each in estimates])
    spread = np.sqrt(np.stack([covariance[..., 0, 0], covariance[..., 1, 1]], axis=-1))
    fwhm = np.array([each.fwhm for each in estimates])[:, None]
    flag = np.stack([each.flag for each in estimates])
    with np.errstate(invalid="ignore"):
        noisy = ~(spread[..., 0] <= max_uncertainty) & ~np.isnan(value[..., 0])
        correlation = covariance[..., 0, 1] / (spread[..., 0] * spread[..., 1])
    flag |= np.where(noisy, FLAGS["too_noisy"], 0).astype(np.uint8)
    flag |= np.where(pixels < FEWEST_PIXELS, FLAGS["no_data"], 0).astype(np.uint8)
    each = {
        "wavelength_shift": value[..., 0] + np.stack([each.shift for each in estimates]),
        "wavelength_shift_u": spread[..., 0],
        "shift_correction": value[..., 0],
        "fwhm": value[..., 1] * fwhm,
        "fwhm_u": spread[..., 1] * fwhm,
        "fwhm_factor": value[..., 1],
        "correlation": correlation,
        "residual": np.stack([each.residual for each in estimates]),
        "residual_declared": np.stack([each.residual_declared for each in estimates]),
        "chi2": np.stack([each.chi2 for each in estimates]),
        "flag": flag,
    }
    made = xr.Dataset({name: (("window", CROSS_TRACK), values) for name, values in each.items()})
    made["pixels"] = (CROSS_TRACK, pixels)
    return made.assign_coords(
        column=(CROSS_TRACK, column, {"long_name": "Column, or mean column of a group", "units": "1"}),
        window_centre=(
            "window",
            [each.centre for each in estimates],
            {"units": "nm", "long_name": "Mean wavelength of the bands of a window"},
        ),
    )


def _with_spectra(
    found: xr.Dataset, fits: list[Fit], chosen: list[Array], known: Mapping[str, Any], separate: bool
) -> xr.Dataset:
    """Return the report with the departures band by band, and all attributes."""
    made = found if separate else found.isel(window=0)
    for name in ("departure", "departure_declared"):
        values = np.full((known["wavelength"].size, found.sizes[CROSS_TRACK]), np.nan)
        for fit, inside in zip(fits, chosen, strict=True):
            values[inside] = getattr(fit, name)
        made[name] = ((BAND, CROSS_TRACK), values)
    made = made.assign_coords(wavelength=(BAND, known["wavelength"], schema.VARIABLES["wavelength"].attrs))
    for name in map(str, made.data_vars):
        if name in schema.VARIABLES:
            made[name].attrs = schema.VARIABLES[name].attrs
        else:
            units, meaning = _REPORTED[name]
            made[name].attrs = {"long_name": meaning, "units": units}
    made["flag"].attrs = {
        "long_name": _REPORTED["flag"][1],
        "flag_masks": np.array(list(FLAGS.values()), np.uint8),
        "flag_meanings": " ".join(FLAGS),
    }
    return made
