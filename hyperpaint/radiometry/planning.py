"""Compute the `Plan` that all slabs of a line share from its small variables: darks, limits, light.

It runs once per line, as a node of the graph: wrong values are reported when results are computed.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base.arrays import Array, Floats
from hyperpaint.base.constants import QUANTISATION_VARIANCE_COUNT2, SATURATION_MARGIN_COUNTS
from hyperpaint.base.errors import PaintWarning, Problems, SchemaError, TimeError
from hyperpaint.base.schema import IRRADIANCE_TIME, IRRADIANCE_WAVELENGTH, VARIABLES, Quality
from hyperpaint.light.diffuse_record import SKY_STATES, diffuse_from_record
from hyperpaint.light.illumination import (
    MAX_SUN_ZENITH_DEG,
    Smile,
    Tilt,
    imager_of,
    matched_series,
    smile_cells,
)
from hyperpaint.light.sky_functions import sunward_gain
from hyperpaint.light.sun import solar_position
from hyperpaint.light.synchrony import LineLight, line_light

from .linear_counts import TABLE, Linearity
from .panel_judging import REFUSED, RULES as PANEL_RULES, PanelClosure, PanelContext, judge_panels
from .plausible_light import check_light, warn_of_lost_bands
from .slabs import Plan, panel_correction, scale_of_factors, usable_panels
from .stray_light import check_stray_light, stray_light_of
from .uncertainty.irradiance_noise import at_bands
from .uncertainty.propagation import error_terms

# -- Light on a tilted surface under the sky that the irradiance record shows, which may not be clear.

_CLEAR, _HAZY, _CONTRADICTORY = (SKY_STATES.index(word) for word in ("clear", "hazy", "contradictory"))


#: Largest distance in time of irradiance samples that determine the sky over a panel.
MAX_PANEL_DISTANCE = np.timedelta64(120, "s")


def tilt_factors(
    tilt: Tilt, light: Mapping[str, Any], used: Array, wavelength: Floats, position: tuple[float, float]
) -> Floats:
    """Return irradiance on the surface relative to level ground (sample, band) [1], for the ``used`` samples.

    A diffuse fraction of the tilt is used first. Otherwise the fraction of the lines, if they have one;
    otherwise the split by `hyperpaint.light.diffuse_from_record`, which leaves a clear sky to the model of
    `Tilt`. Diffuse light is uniform except under a clear or hazy sky.

    light: ``irradiance``, its time and wavelengths, and of lines ``time``, ``diffuse_fraction`` and
        ``sky_state``; position: latitude and longitude [degree].

    Warns PaintWarning: The record fits no sky, and a clear sky is assumed.
    """
    stamps = np.asarray(light["irradiance_time"]).astype("datetime64[ns]")

    def factor(sky: Tilt, samples: Array) -> Floats:
        return sky.factor(stamps[used[samples]], *position, wavelength)

    if tilt.diffuse_fraction is not None or tilt.angle == 0.0:
        return factor(tilt, np.arange(used.size))
    fraction, state = _split(light, stamps, wavelength, position)
    if fraction is None:
        return factor(tilt, np.arange(used.size))
    factors = np.empty((used.size, wavelength.size))
    fraction, state = fraction[used], state[used]
    is_modelled = (state == _CLEAR) | (state == _CONTRADICTORY) | ~np.isfinite(fraction).all(axis=1)
    if (state == _CONTRADICTORY).any():
        text = (
            f"the irradiance fits no sky at its place and time in {(state == _CONTRADICTORY).sum()} of "
            f"{used.size} samples; tilt= assumes a clear sky for them, otherwise pass "
            "Tilt(diffuse_fraction=)"
        )
        warnings.warn(PaintWarning(text, code="sky-unknown"), stacklevel=2)
    if is_modelled.any():
        factors[is_modelled] = factor(tilt, np.flatnonzero(is_modelled))
    for sample in np.flatnonzero(~is_modelled):
        sky = "clear" if state[sample] == _HAZY else "uniform"
        factors[sample] = factor(
            replace(tilt, diffuse_fraction=fraction[sample], sky=sky), np.array([sample])
        )[0]
    return factors


def direct_share(
    light: Mapping[str, Any], time: np.datetime64, wavelength: Floats, position: tuple[float, float]
) -> Floats | None:
    """Return the relative change of a panel's light with its direct part (sky, band) [1].

    1 - f for a uniform diffuse fraction f; under a clear sky a second row includes the bright side of the sky
    around the sun. None where the split is unknown. Arguments as of `tilt_factors`.
    """
    stamps = np.asarray(light["irradiance_time"]).astype("datetime64[ns]")
    distance = np.abs(stamps - time)
    nearby_samples = np.flatnonzero(distance <= max(MAX_PANEL_DISTANCE, distance.min()))
    nearby_light = {
        **light,
        "irradiance": np.asarray(light["irradiance"])[nearby_samples],
        "irradiance_time": stamps[nearby_samples],
    }
    if "diffuse_fraction" in light and len(np.atleast_2d(light["diffuse_fraction"])) == stamps.size:
        nearby_light |= {
            name: np.asarray(light[name])[nearby_samples]
            for name in ("diffuse_fraction", "sky_state")
            if name in light
        }
    fraction, state = _split(nearby_light, stamps[nearby_samples], wavelength, position)
    if fraction is None:
        return None
    nearest = int(distance[nearby_samples].argmin())
    zenith = float(solar_position(np.array([time]), *position)[0][0])
    if zenith >= MAX_SUN_ZENITH_DEG:
        return None
    shares = [1.0 - fraction[nearest]]
    if state[nearest] in (_CLEAR, _HAZY, _CONTRADICTORY):
        shares.append(shares[0] + fraction[nearest] * sunward_gain(wavelength, zenith))
    return np.stack(shares)


def _split(
    light: Mapping[str, Any], stamps: Array, wavelength: Floats, position: tuple[float, float]
) -> tuple[Floats | None, Array]:
    # Return the diffuse fraction (sample, band), None where unknown, and the number of the sky state
    # (sample,).
    if "diffuse_fraction" in light:
        fraction = np.atleast_2d(np.asarray(light["diffuse_fraction"], np.float64))
        time = np.asarray(light["time"]).astype("datetime64[ns]")
        # one row per sample, or one row for all samples
        rows = np.minimum(np.arange(stamps.size), len(fraction) - 1)
        if len(fraction) == time.size:  # the line nearest to every sample
            lines = np.flatnonzero(~np.isnat(time))
            if not lines.size:
                return None, np.zeros(stamps.size, np.int8)
            # float64 seconds resolve stamps of a flight to a microsecond
            line_seconds, sample_seconds = (
                (moments - time[lines[0]]) / np.timedelta64(1, "s") for moments in (time[lines], stamps)
            )
            rows = lines[np.abs(line_seconds[:, None] - sample_seconds).argmin(axis=0)]
        state = np.asarray(light.get("sky_state", SKY_STATES.index("overcast"))).ravel()
        state = state[rows] if state.size == len(fraction) else np.broadcast_to(state[:1], rows.shape)
        return np.broadcast_to(fraction, (len(fraction), wavelength.size))[rows], state
    channels = xr.Variable(
        IRRADIANCE_WAVELENGTH, light["irradiance_wavelength"], VARIABLES[IRRADIANCE_WAVELENGTH].attrs
    )
    record = xr.DataArray(
        np.asarray(light["irradiance"]),
        {IRRADIANCE_TIME: stamps, IRRADIANCE_WAVELENGTH: channels},
        (IRRADIANCE_TIME, IRRADIANCE_WAVELENGTH),
        attrs=VARIABLES["irradiance"].attrs,
    )
    try:
        # rounded to a kilometre, so that a crop of the line gets the same sky
        rounded_position = tuple(round(degrees, 2) for degrees in position)
        split = diffuse_from_record(
            record.to_dataset(name="irradiance"), *rounded_position, wavelength=wavelength
        )
    except SchemaError:  # a record without channels in the compared intervals
        return None, np.zeros(stamps.size, np.int8)
    return split["diffuse_fraction"].values.astype(np.float64), split["sky_state"].values


NOISE_MARGIN_SD = 5.0
#: Spread of a dark count if neither calibration nor dark give it [count].
DEFAULT_READ_NOISE_COUNTS = 2.0
BAD_BAND_SHARE = 0.05
NEGATIVE_BAND_SHARE = 0.1
#: Relative difference of exposure times up to which a dark is valid for a line.
SAME_EXPOSURE_SHARE = 0.01
#: Extrapolation beyond the exposures of the darks above which it is reported, and refused [widths of the
#: interval between them]. Darks of a real camera at 20 to 55 ms extrapolate to 0.3 counts rms inside, 0.7 at
#: a width and 1.7 at four; the noise of the means of two darks grows as sqrt(0.5 + 2 (0.5 + widths)^2), to 15
#: times at ten.
TRUSTED_DARK_SPANS, MAX_DARK_SPANS = 1.0, 10.0


def make_plan(
    shape: tuple[int, int, int],
    dtype: str,
    starts: Array,
    *,
    cube: Mapping[str, Any],
    light: Mapping[str, Any] | None,
    tilt: Tilt | None = None,
    panel: Mapping[str, Any] | None = None,
    keep_bits: int | None = None,
    uncertain: Mapping[str, Any] | None = None,
) -> Plan:
    """Compute the plan of a cube (along_track, band, cross_track); ``starts``: first lines of its slabs.

    ``cube`` holds the values of ``dark_counts``, ``radiance_gain``, ``exposure_time`` and the other variables
    of the table, by name; without dark counts the cube is radiance, and a gain gives its responsivity only.
    ``light`` holds irradiance and its companions, None for radiance; ``uncertain`` noise and the known
    uncertainties, None where none are requested. ``tilt``, ``panel`` and ``keep_bits`` as in
    `hyperpaint.radiometry.counts_to_reflectance.reflectance`.

    Raises
    ------
    SchemaError, TimeError
        Values are out of range or contradict one another; all are listed.
    """
    lines, bands, columns = shape
    is_from_counts = "dark_counts" in cube
    is_without_exposure = np.isnan(
        np.broadcast_to(np.asarray(cube.get("exposure_time", 1.0), np.float64), lines)
    )
    if is_without_exposure.any() and not is_without_exposure.all():
        # lines without data after `where`: fits over exposures need a number
        exposures = np.asarray(cube["exposure_time"], np.float64)
        cube = {**cube, "exposure_time": np.where(is_without_exposure, np.nanmedian(exposures), exposures)}
    _check_values(cube, shape)
    good = np.asarray(cube.get("good", np.ones(bands, bool)), bool)
    exposure = np.broadcast_to(
        np.asarray(cube["exposure_time"] if is_from_counts else 1.0, np.float64), lines
    )
    # dark and gain of every element
    dark, dark_index = np.zeros((1, bands, columns), np.float32), np.zeros(lines, np.int64)
    dark_weight = np.zeros(lines, np.float32)
    if is_from_counts:
        dark, dark_index, dark_weight = darks_of_lines(cube, exposure)
    masked = _masked(cube, dark)
    gain = np.ones((bands, columns), np.float32)
    if is_from_counts:
        gain = np.array(cube["radiance_gain"], np.float32)
        gain[tuple(masked.T)] = np.nan
        gain[~np.isfinite(gain) | ~np.isfinite(dark).all(axis=0)] = np.nan
    is_bad = np.isnan(gain)
    is_lit = good[:, None] & np.ones_like(is_bad)
    is_lit[tuple(masked.T)] = False  # masked elements are not bad
    bad_share = (is_bad & is_lit).sum(axis=0) / np.maximum(is_lit.sum(axis=0), 1)
    # flags of whole lines, and the light of each
    time = np.asarray(cube["time"]).astype("datetime64[ns]") if "time" in cube else None
    line_flags = np.zeros(lines, np.uint16)
    line_flags[is_without_exposure] = Quality.NO_DATA
    if time is not None:
        line_flags[np.isnat(time)] = Quality.NO_DATA
    smile = smile_cells(cube.get("wavelength_shift") if light else None, columns)
    series = neighbours = None
    misfit = np.full(bands, np.nan, np.float32)
    if light is not None and time is not None:
        series, neighbours, misfit = _illuminate(cube, light, time, smile, tilt)
        line_flags |= neighbours.flags
    # scale by panels
    scale, closure, panel_weights, panel_u = np.ones(bands), None, None, None
    if panel is not None:
        if "factor" in panel:  # panels that were measured before
            is_refused = (np.asarray(panel["state"]) & REFUSED) != 0
            scale, panel_weights = scale_of_factors(panel["factor"], np.asarray(panel["weight"]), is_refused)
            panel_u = np.asarray(panel["scale_u"], np.float64)
        else:
            scale, closure, panel_weights, panel_u = _panel_scale(panel, cube, light, good, lines)
        if uncertain is not None:
            uncertain = {**uncertain, "panel_u": float(np.nanmax(panel_u))}
    # margin below the dark that noise explains, for good elements only
    read_noise = np.asarray(cube.get("read_noise", DEFAULT_READ_NOISE_COUNTS), np.float64)
    margin = NOISE_MARGIN_SD * np.sqrt(read_noise**2 + QUANTISATION_VARIANCE_COUNT2)
    is_flaggable = good[:, None] & ~is_bad & is_from_counts
    terms = None
    if uncertain is not None:
        darks = np.shape(cube.get("dark_counts", 0.0))
        weights_by_dark = dark_weights(cube, darks[0] if len(darks) == 3 else 1, exposure)
        dark_share = float(np.sqrt((weights_by_dark**2).sum(axis=1)).max(initial=0.0))
        terms = error_terms(uncertain, cube, light, dtype, is_bad, len(masked), dark_share)
    return Plan(
        dark=np.nan_to_num(dark, posinf=0.0, neginf=0.0),
        dark_index=dark_index,
        dark_weight=dark_weight,
        gain=gain,
        rate=np.where(line_flags & Quality.NO_DATA, np.nan, 1.0 / exposure),
        scale=scale,
        closure=closure,
        panel_weights=panel_weights,
        panel_u=panel_u,
        series=series,
        lines=neighbours,
        misfit=misfit,
        smile=smile,
        saturation_limit=_saturation_limit(cube, np.dtype(dtype)),
        noise_margin=np.ascontiguousarray(np.where(is_flaggable, margin, np.nan), np.float32),
        max_negative_bands=int(NEGATIVE_BAND_SHARE * good.sum()),
        line_flags=line_flags,
        column_flags=np.where(bad_share > BAD_BAND_SHARE, Quality.BAD_DETECTOR, 0).astype(np.uint16),
        cleared_bits=0 if keep_bits is None else 23 - keep_bits,
        starts=starts,
        detector=_linearity(cube).detector_model(_highest_count(cube))._replace(masked=masked),
        stray=stray_light_of(cube, exposure, gain, masked) if is_from_counts else None,
        error_terms=terms,
    )


def _check_values(cube: Mapping[str, Any], shape: tuple[int, int, int]) -> None:
    problems = Problems("this line cannot be calibrated", SchemaError)
    for name in ("dark_counts", "radiance_gain"):
        if name in cube and np.shape(cube[name])[-2:] != shape[1:]:
            problems.add(
                f"{name!r} has shape {np.shape(cube[name])}",
                expected=f"(band, cross_track) = {shape[1:]}",
                code="length-mismatch",
            )
    exposure = np.asarray(cube.get("exposure_time", 1.0), np.float64)
    invalid = exposure[~(np.isfinite(exposure) & (exposure > 0))]
    if invalid.size:
        problems.add(
            f"'exposure_time' is {invalid[0]:g} s", expected="a positive number", code="value-out-of-range"
        )
    elif (exposure > 60).any():
        problems.add(
            f"'exposure_time' is {exposure.max():g} s",
            expected="at most 60 s",
            mend="set its units to 'ms' if it is in milliseconds",
            code="exposure-implausible",
        )
    gain = np.asarray(cube.get("radiance_gain", 1.0))
    if np.isfinite(gain).any() and np.min(gain[np.isfinite(gain)]) <= 0:
        problems.add(
            "'radiance_gain' is not positive", mend="mark bad elements by NaN", code="value-out-of-range"
        )
    if not np.isfinite(gain).any():
        problems.add("'radiance_gain' contains no finite value", code="not-finite")
    saturation = np.asarray(cube.get("saturation_count", np.inf), np.float64)
    if (saturation <= 2 * SATURATION_MARGIN_COUNTS).any():
        problems.add(
            f"'saturation_count' is {np.nanmin(saturation):g}",
            expected="the highest count of the converter, such as 4095",
            code="saturation-implausible",
        )
    _linearity(cube).check(problems, _highest_count(cube))
    check_stray_light(cube, shape[1], exposure, problems)
    problems.raise_if_any()


def _linearity(cube: Mapping[str, Any]) -> Linearity:
    # Return the linearity curve of a line's counts; the identity for a radiance cube.
    curve: Linearity = cube.get("linearity") or Linearity()
    if "linear_counts" in cube:
        measured, linear = (np.asarray(cube[name], np.float64) for name in TABLE)
        curve = Linearity((), measured, linear, curve.on_raw)
    return curve


def _masked(cube: Mapping[str, Any], dark: Array) -> Array:
    # Return band and column of masked elements with finite darks (n, 2) int64.
    # `masked` is (column,), (band, 1) or (band, column).
    if "masked" not in cube:
        return np.empty((0, 2), np.int64)
    is_masked = np.asarray(cube["masked"], bool)
    shape = dark.shape[1:]
    elements = np.argwhere(np.broadcast_to(is_masked, shape) & np.isfinite(dark).all(axis=0)).astype(np.int64)
    if not len(elements):
        text = (
            "'masked' is declared, but this part of the line has no masked element: no pedestal is "
            "subtracted; compute reflectance of the whole line before cutting it"
        )
        warnings.warn(PaintWarning(text, code="masked-missing"), stacklevel=2)
    return elements


def _highest_count(cube: Mapping[str, Any]) -> float:
    saturation = np.asarray(cube.get("saturation_count", np.inf), np.float64)
    return float(saturation[np.isfinite(saturation)].max(initial=0.0)) or np.inf


def dark_weights(cube: Mapping[str, Any], count: int, exposure: Floats) -> Floats:
    """Return the weight of each of ``count`` darks in every line (line, dark).

    ``cube`` holds times and exposures of the darks, as of `make_plan`; ``exposure`` (line,) [s].
    """
    if count == 1:
        return np.ones((exposure.size, 1))
    # the subtracted dark is linear in the darks: unit darks give their weights
    darks = {**cube, "dark_counts": np.eye(count, dtype=np.float32)[:, :, None]}
    with warnings.catch_warnings():  # the plan warns
        warnings.simplefilter("ignore")
        unit_darks, index, weight = darks_of_lines(darks, exposure)
    next_index = np.minimum(index + 1, len(unit_darks) - 1)
    shares = unit_darks[index, :, 0] + weight[:, None] * (
        unit_darks[next_index, :, 0] - unit_darks[index, :, 0]
    )
    return np.asarray(shares, np.float64)


def darks_of_lines(cube: Mapping[str, Any], exposure: Floats) -> tuple[Array, Array, Array]:
    """Return darks (n, band, column), and for every line its earlier dark and the weight of the later.

    Darks at the line's exposure are interpolated in time. Without such darks, or if lines differ in exposure,
    bias and rate are fitted to the darks, and every line is interpolated between two fitted darks; the bias
    is never scaled.
    """
    dark = np.asarray(cube["dark_counts"], np.float32)
    dark = dark[None] if dark.ndim == 2 else dark
    times = cube.get("dark_time")
    dark_exposure_time = cube.get("dark_exposure_time")
    if dark_exposure_time is not None:
        dark_exposure = np.broadcast_to(np.asarray(dark_exposure_time, np.float64), len(dark))
        is_usable = np.abs(dark_exposure[:, None] / exposure - 1.0) <= SAME_EXPOSURE_SHARE
        if not is_usable.all(axis=1).any():
            return _darks_in_exposure(dark, dark_exposure, exposure)
        dark = dark[is_usable.all(axis=1)]
        times = None if times is None else np.asarray(times)[is_usable.all(axis=1)]
    elif np.ptp(exposure) > SAME_EXPOSURE_SHARE * exposure.max():
        text = "lines differ in exposure and 'dark_exposure_time' is missing: one dark is used for all"
        warnings.warn(PaintWarning(text, code="dark-exposure-missing"), stacklevel=2)
    index, weight = np.zeros(exposure.size, np.int64), np.zeros(exposure.size, np.float32)
    if len(dark) == 1 or times is None or "time" not in cube:
        return dark.mean(axis=0, dtype=np.float64).astype(np.float32)[None], index, weight
    stamps = np.asarray(times).astype("datetime64[ns]")
    if np.isnat(stamps).any():
        raise TimeError(
            f"{np.isnat(stamps).sum()} of {stamps.size} 'dark_time' are missing (NaT)",
            mend="drop these darks",
            code="time-missing",
        )
    order = np.argsort(stamps, kind="stable")
    dark, ticks = dark[order], stamps[order].astype(np.int64)
    line_time = np.asarray(cube["time"]).astype("datetime64[ns]")
    line_ns = np.where(np.isnat(line_time), ticks[0], line_time.astype(np.int64))
    # beyond their times the first and the last dark are used: a dark drifts slowly
    index = np.clip(np.searchsorted(ticks, line_ns, side="right") - 1, 0, len(dark) - 2)
    weight = (line_ns - ticks[index]) / np.maximum(ticks[index + 1] - ticks[index], 1)
    return dark, index.astype(np.int64), np.clip(weight, 0.0, 1.0).astype(np.float32)


def _darks_in_exposure(dark: Array, dark_exposure: Floats, exposure: Floats) -> tuple[Array, Array, Array]:
    if np.ptp(dark_exposure) <= SAME_EXPOSURE_SHARE * dark_exposure.max():
        exposures_ms = np.unique(exposure.round(9)) * 1e3
        raise SchemaError(
            f"the dark was taken at {dark_exposure[0] * 1e3:g} ms, the line at "
            f"{', '.join(f'{ms:g}' for ms in exposures_ms[:4])} ms",
            mend="take a dark at the line's exposure, or darks at two exposures, for bias and rate",
            code="dark-exposure-differs",
        )
    # lines beyond the exposures of the darks
    below, above = dark_exposure.min() - exposure.min(), exposure.max() - dark_exposure.max()
    spans = max(below, above) / np.ptp(dark_exposure)
    if spans > TRUSTED_DARK_SPANS * (1.0 + SAME_EXPOSURE_SHARE):
        farthest = exposure.max() if above >= below else exposure.min()
        text = (
            f"darks at {dark_exposure.min() * 1e3:g} to {dark_exposure.max() * 1e3:g} ms are extrapolated to "
            f"{farthest * 1e3:g} ms, {spans:.1f} times the interval between them"
        )
        mend, code = "take a dark at the line's exposure", "dark-exposure-differs"
        if spans > MAX_DARK_SPANS:
            raise SchemaError(text, expected=f"at most {MAX_DARK_SPANS:g}", mend=mend, code=code)
        warnings.warn(PaintWarning(f"{text}: {mend}", code=code), stacklevel=2)
    centred = dark_exposure - dark_exposure.mean()
    rate = np.tensordot(centred, dark, axes=(0, 0)) / (centred @ centred)
    shortest, longest = exposure.min(), exposure.max()
    darks_at_ends = [
        dark.mean(axis=0, dtype=np.float64) + rate * (exposure_at_end - dark_exposure.mean())
        for exposure_at_end in (shortest, longest)
    ]
    fitted = np.stack(darks_at_ends).astype(np.float32)
    index = np.zeros(exposure.size, np.int64)
    if longest == shortest:
        return fitted[:1], index, np.zeros(exposure.size, np.float32)
    return fitted, index, ((exposure - shortest) / (longest - shortest)).astype(np.float32)


def _saturation_limit(cube: Mapping[str, Any], dtype: np.dtype[Any]) -> Array:
    # Return the counts from which a sample is saturated, (1, 1) or (band, column).
    if "dark_counts" not in cube:
        return np.full((1, 1), np.inf, dtype)
    limit = np.asarray(cube["saturation_count"], np.float64) - SATURATION_MARGIN_COUNTS
    limit = np.where(np.isnan(limit), np.inf, limit)
    if np.issubdtype(dtype, np.integer):
        # an integer reaches a limit exactly if it reaches the limit rounded up
        limit = np.clip(np.ceil(limit), 0, np.iinfo(dtype).max)
    return np.ascontiguousarray(limit.reshape(1, 1) if limit.ndim == 0 else limit, dtype)


def _illuminate(
    cube: Mapping[str, Any], light: Mapping[str, Any], time: Array, smile: Smile, tilt: Tilt | None
) -> tuple[Floats, LineLight, Array]:
    # Return the matched series as cubics over the smile, the samples around every line, and the misfit.
    spectra = np.asarray(light["irradiance"], np.float64)
    channels = np.asarray(light["irradiance_wavelength"], np.float64)
    stamps = np.asarray(light["irradiance_time"]).astype("datetime64[ns]")
    max_gap, clock = (light.get(name) for name in ("irradiance_max_gap", "irradiance_clock_uncertainty"))
    lines = line_light(
        time,
        stamps,
        _levels(spectra, channels),
        None if max_gap is None else float(max_gap),
        cube.get("latitude"),
        cube.get("longitude"),
        None if clock is None else float(clock),
    )
    # select the samples around the lines from the record of a day
    used_samples, index = np.unique(np.stack([lines.before, lines.after]), return_inverse=True)
    before, after = index.reshape(2, -1)
    check_light(cube, spectra[used_samples], channels, stamps[used_samples])
    imager = imager_of(cube, light["srf_shape"])
    matched, misfit = matched_series(
        spectra[used_samples],
        channels,
        light["irradiance_fwhm"],
        light["irradiance_srf_shape"],
        imager,
        smile.nodes,
        light.get("departure"),
    )
    warn_of_lost_bands(spectra[used_samples], channels, matched, imager["wavelength"])
    if tilt is not None:
        factors = tilt_factors(
            tilt, {**light, "time": time}, used_samples, imager["wavelength"], _mean_position(cube)
        )
        matched = matched * factors[:, None, :]
    light_of_lines = LineLight(before, after, lines.weight, lines.age, lines.sensitivity, lines.flags)
    return smile.cubics(matched), light_of_lines, misfit.max(axis=0).astype(np.float32)


def _mean_position(cube: Mapping[str, Any]) -> tuple[float, float]:
    # Return mean latitude and longitude of the lines [degree].
    position = []
    for name in ("latitude", "longitude"):
        degrees = np.asarray(cube[name], np.float64)
        degrees = degrees[np.isfinite(degrees)]
        if degrees.size == 0:
            raise SchemaError(
                f"tilt= needs the sun's position, but {name!r} is missing on every line", code="place-missing"
            )
        position.append(float(degrees.mean()))
    return position[0], position[1]


def _levels(spectra: Floats, channels: Floats) -> Floats:
    # Return sums of each spectrum over intervals of 100 nm; NaN where a common channel is missing.
    # Channels that are missing in more than a tenth of the spectra are ignored: only their
    # bands become NaN, not the record.
    has_values = np.isfinite(spectra).any(axis=1)
    is_used = (channels >= 400.0) & (channels <= 1000.0)
    is_used = is_used if is_used.any() else np.ones(channels.size, bool)
    if has_values.any():
        is_used = is_used & (np.isnan(spectra[has_values]).mean(axis=0) <= 0.1)
    if not has_values.any() or not is_used.any():
        return np.full((len(spectra), 1), np.nan)
    interval = np.floor(np.minimum(channels, 999.0) / 100.0)
    return np.stack(
        [spectra[:, is_used & (interval == i)].sum(axis=1) for i in np.unique(interval[is_used])], axis=1
    )


def _panel_scale(
    inputs: Mapping[str, Any],
    cube: Mapping[str, Any],
    light: Mapping[str, Any] | None,
    good: Array,
    lines: int,
) -> tuple[Floats, PanelClosure, Floats | None, Floats]:
    # Return the scale by panels in the form of a `Plan`, with results, weights and uncertainties (line,);
    # `inputs` as of `panels.panel_inputs`.
    # combined uncertainty of gain and irradiance, as stated or by default
    wavelength = np.asarray(cube["wavelength"], np.float64)
    stated = {name: np.asarray(value, np.float64) for name, value in inputs["stated"].items()}
    gain = stated.get("radiance_gain_u_systematic", np.asarray(PANEL_RULES.gain_u))
    gain = np.nanmean(gain, axis=1) if gain.ndim == 2 else gain
    record = stated.get("irradiance_u_systematic", np.asarray(PANEL_RULES.irradiance_u))
    if record.ndim and light is not None:
        record = at_bands(record, light["irradiance_wavelength"], wavelength)
    line_u = np.broadcast_to(np.hypot(gain, record), wavelength.shape)
    # factor of every panel
    time = np.asarray(cube["time"]).astype("datetime64[ns]")
    is_located = all(name in cube and np.isfinite(cube[name]).any() for name in ("latitude", "longitude"))
    panels = []
    for panel in inputs["panels"]:
        stamps = time[slice(*panel["lines"])]
        stamps = stamps[~np.isnat(stamps)]
        if not stamps.size:
            raise TimeError(f"{panel['name']}: its lines have no time", code="time-missing")
        middle_time, share = stamps[0] + (stamps[-1] - stamps[0]) // 2, None
        if light is not None and is_located:
            share = direct_share({**light, "time": time}, middle_time, wavelength, _mean_position(cube))
        panels.append({**panel, "time": middle_time, "direct_share": share})
    closure = judge_panels(tuple(panels), PanelContext(wavelength, good, line_u, inputs["has_scale"]))
    if not inputs["refuses"]:
        return np.ones(good.size), closure, None, np.full(lines, np.nan)
    # scale of all lines, from a single panel or interpolated between several
    usable = usable_panels(closure)
    declared_u = max(float(panels[k]["uncertainty"]) for k in usable)
    if usable.size == 1:
        noise = float(np.nanmedian(closure.mean_u[usable[0]]))
        return closure.scale[usable[0]], closure, None, np.full(lines, np.hypot(declared_u, noise))
    scale, weights, u = panel_correction(closure.at(usable), time)
    return scale, closure, weights, np.hypot(declared_u, u)
