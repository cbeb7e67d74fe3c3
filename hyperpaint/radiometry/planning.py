"""Compute the `Plan` that all slabs of a line share from its small variables: darks, limits, light.

It runs once per line, as a node of the graph: wrong values are reported when results are computed.
"""

import dataclasses
import math
import threading
import weakref
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, NamedTuple

import dask
import dask.array as da
import numpy as np
import xarray as xr
from dask.delayed import Delayed

from hyperpaint.base import (
    ALONG_TRACK,
    BAND,
    CROSS_TRACK,
    DULL_MEDIAN,
    HIGHEST_MEDIAN,
    IRRADIANCE_TIME,
    IRRADIANCE_WAVELENGTH,
    LOWEST_MEDIAN,
    QUANTISATION_VARIANCE_COUNT2,
    SATURATION_MARGIN_COUNTS,
    SRF_SHAPES,
    Array,
    Floats,
    Problems,
    Quality,
    SchemaError,
    TimeError,
    brightest_median,
    one_of,
    require,
    unit_slip,
    warn_if,
    warn_of_lost_calibration,
    warn_user,
)
from hyperpaint.io.spectrometers.record_faults import FAULTS_ATTR, judge_record, warn_of_faults
from hyperpaint.light.clear_sky import ClearSky, sunward_gain
from hyperpaint.light.diffuse_record import SKY_STATES, split_of_arrays
from hyperpaint.light.illumination import (
    MAX_SUN_ZENITH_DEG,
    UNSTABLE_CHANGE,
    LineLight,
    Smile,
    Tilt,
    at_bands,
    between_stamps,
    check_irradiance_times,
    departure_of_record,
    imager_of,
    line_light,
    matched_series,
    smile_cells,
)
from hyperpaint.light.sun import solar_position

from . import slabs
from .darks import dark_weights, darks_of_lines
from .panels import (
    REFUSED,
    RULES as PANEL_RULES,
    Panel,
    PanelContext,
    is_lambertian,
    judge_panels,
    panel_correction,
    panel_factor,
    scale_of_factors,
    usable_panels,
)
from .slabs import PanelClosure, Plan
from .stray_light import (
    FLAT,
    SHIFT_TIME,
    STRAY_LIGHT,
    Linearity,
    check_stray_light,
    declared_linearity,
    declared_pedestal,
    pedestal_of,
    stray_light_of,
    table_names,
    tabulated,
)
from .uncertainty import error_terms, uncertainty_inputs

# -- Light on a tilted surface under the sky that the irradiance record shows, which may not be clear.

_CLEAR, _HAZY, _CONTRADICTORY = (SKY_STATES.index(word) for word in ("clear", "hazy", "contradictory"))


#: Largest distance in time of irradiance samples that determine the sky over a panel.
MAX_PANEL_DISTANCE = np.timedelta64(120, "s")


def tilt_factors(
    tilt: Tilt, light: Mapping[str, Any], used: Array, wavelength: Floats, position: tuple[float, float]
) -> Floats:
    # Return irradiance on the surface relative to level ground (sample, band) [1], for the ``used`` samples.
    #
    # A diffuse fraction of the tilt is used first. Otherwise the fraction of the lines, if they have one;
    # otherwise the split by `hyperpaint.light.diffuse_from_record`, which leaves a clear sky to the model of
    # `Tilt`. Diffuse light is uniform except under a clear or hazy sky.
    #
    # light: ``irradiance``, its time and wavelengths, and of lines ``time``, ``diffuse_fraction`` and
    #     ``sky_state``; position: latitude and longitude [degree].
    #
    # Warns PaintWarning: The record fits no sky, and a clear sky is assumed.
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
    warn_if(
        (state == _CONTRADICTORY).any(),
        f"the irradiance fits no sky at its place and time in {(state == _CONTRADICTORY).sum()} of "
        f"{used.size} samples; tilt= assumes a clear sky for them, otherwise pass "
        "Tilt(diffuse_fraction=)",
        "sky-unknown",
    )
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
    # Return the relative change of a panel's light with its direct part (sky, band) [1].
    #
    # 1 - f for a uniform diffuse fraction f; under a clear sky a second row includes the bright side of the
    # sky around the sun. None where the split is unknown. Arguments as of `tilt_factors`.
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
    # rounded to a kilometre, so that a crop of the line gets the same sky
    place = round(position[0], 2), round(position[1], 2)
    spectra, channels = np.asarray(light["irradiance"]), light["irradiance_wavelength"]
    try:
        return split_of_arrays(spectra, stamps, channels, place, wavelength)
    except SchemaError:  # a record without channels in the compared intervals
        return None, np.zeros(stamps.size, np.int8)


BANDS = SimpleNamespace(
    noise_margin_sd=5.0,
    #: Spread of a dark count if neither calibration nor dark give it [count].
    default_read_noise_counts=2.0,
    bad_band_share=0.05,
    negative_band_share=0.1,
)


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
    # Compute the plan of a cube (along_track, band, cross_track); ``starts``: first lines of its slabs.
    #
    # ``cube`` holds the values of ``dark_counts``, ``radiance_gain``, ``exposure_time`` and the other
    # variables of the table, by name; without dark counts the cube is radiance, and a gain gives its
    # responsivity only. ``light`` holds irradiance and its companions, None for radiance; ``uncertain`` noise
    # and the known uncertainties, None where none are requested. ``tilt``, ``panel`` and ``keep_bits`` as in
    # `hyperpaint.radiometry.counts_to_reflectance.reflectance`.
    #
    # Raises `SchemaError, TimeError`: Values are out of range or contradict one another; all are listed.
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
    # masked elements (band, column); `masked` is (column,), (band, 1) or (band, column).
    is_masked = np.broadcast_to(np.asarray(cube.get("masked", False), bool), dark.shape[1:])
    usable = np.asarray(np.isfinite(dark).all(axis=0))
    warn_if(
        "masked" in cube and not (is_masked & usable).any(),
        "'masked' is declared, but this part of the line has no masked element: no pedestal is "
        "subtracted; compute reflectance of the whole line before cutting it",
        "masked-missing",
    )
    pedestal = pedestal_of(is_masked, usable, cube.get("pedestal") or declared_pedestal({}))
    masked = np.argwhere(is_masked & usable)
    gain = np.ones((bands, columns), np.float32)
    if is_from_counts:
        gain = np.array(cube["radiance_gain"], np.float32)
        gain[is_masked] = np.nan
        gain[~np.isfinite(gain) | ~np.isfinite(dark).all(axis=0)] = np.nan
    is_bad = np.isnan(gain)
    is_lit = good[:, None] & np.ones_like(is_bad)
    is_lit[is_masked & usable] = False  # masked elements are not bad
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
    elif "white_level" in cube and time is not None:
        # The light on white references as a series of a `Plan`, and the whites around every line: light is
        # linear in time between two whites; before the first and after the last it is constant.
        level = np.asarray(cube["white_level"], np.float64)
        before, weight = between_stamps(np.asarray(cube["white_time"]).astype("datetime64[ns]"), time)
        change = np.nanmedian(np.abs(level[before + 1] / level[before] - 1.0), axis=1)
        unknown = np.full(time.shape, np.nan, np.float32)
        flags = np.where(change > UNSTABLE_CHANGE, Quality.ILLUMINATION_UNSTABLE, 0).astype(np.uint16)
        # the kernel divides pi by the light
        series, neighbours = (
            np.pi * level[:, :, None, None],
            LineLight(before, before + 1, weight, unknown, unknown, flags),
        )
    if neighbours is not None:
        line_flags |= neighbours.flags
    # scale by panels
    scale, closure, panel_weights, panel_u = np.ones(bands), None, None, None
    if panel is not None:
        if "factor" in panel:  # panels that were measured before
            scale, panel_weights = scale_of_factors(
                panel["factor"], np.asarray(panel["weight"]), (np.asarray(panel["state"]) & REFUSED) != 0
            )
            panel_u = np.asarray(panel["scale_u"], np.float64)
        else:
            scale, closure, panel_weights, panel_u = _panel_scale(panel, cube, light, good, lines)
        if uncertain is not None:
            uncertain = {**uncertain, "panel_u": float(np.nanmax(panel_u))}
    # margin below the dark that noise explains, for good elements only
    read_noise = np.asarray(cube.get("read_noise", BANDS.default_read_noise_counts), np.float64)
    margin = BANDS.noise_margin_sd * np.sqrt(read_noise**2 + QUANTISATION_VARIANCE_COUNT2)
    is_flaggable = good[:, None] & ~is_bad & is_from_counts
    terms = None
    if uncertain is not None:
        darks = np.shape(cube.get("dark_counts", 0.0))
        weights_by_dark = dark_weights(cube, darks[0] if len(darks) == 3 else 1, exposure)
        dark_share = float(np.sqrt((weights_by_dark**2).sum(axis=1)).max(initial=0.0))
        terms = error_terms(uncertain, cube, light, dtype, is_bad, pedestal.elements, dark_share)
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
        max_negative_bands=int(BANDS.negative_band_share * good.sum()),
        line_flags=line_flags,
        column_flags=np.where(bad_share > BANDS.bad_band_share, Quality.BAD_DETECTOR, 0).astype(np.uint16),
        cleared_bits=0 if keep_bits is None else 23 - keep_bits,
        starts=starts,
        detector=_linearity(cube)
        .detector_model(_highest_count(cube))
        ._replace(masked=pedestal.masked, groups=pedestal.groups, is_median=pedestal.is_median),
        stray=stray_light_of(cube, exposure, gain, masked) if is_from_counts else None,
        error_terms=terms,
    )


def _check_values(cube: Mapping[str, Any], shape: tuple[int, int, int]) -> None:
    with Problems("this line cannot be calibrated", SchemaError) as problems:
        for name in ("dark_counts", "radiance_gain", FLAT):
            problems.add_if(
                name in cube and np.shape(cube[name])[-2:] != shape[1:],
                f"{name!r} has shape {np.shape(cube.get(name, 0.0))}",
                expected=f"(band, cross_track) = {shape[1:]}",
                code="length-mismatch",
            )
        exposure = np.asarray(cube.get("exposure_time", 1.0), np.float64)
        invalid = exposure[~(np.isfinite(exposure) & (exposure > 0))]
        if invalid.size:
            problems.add(
                f"'exposure_time' is {invalid[0]:g} s",
                expected="a positive number",
                code="value-out-of-range",
            )
        elif (exposure > 60).any():
            problems.add(
                f"'exposure_time' is {exposure.max():g} s",
                expected="at most 60 s",
                mend="set its units to 'ms' if it is in milliseconds",
                code="exposure-implausible",
            )
        gain = np.asarray(cube.get("radiance_gain", 1.0))
        problems.add_if(
            np.isfinite(gain).any() and np.min(gain[np.isfinite(gain)]) <= 0,
            "'radiance_gain' is not positive",
            mend="mark bad elements by NaN",
            code="value-out-of-range",
        )
        problems.add_if(
            not np.isfinite(gain).any(), "'radiance_gain' contains no finite value", code="not-finite"
        )
        saturation = float(np.nanmin(np.append(np.asarray(cube.get("saturation_count", np.inf)), np.inf)))
        problems.add_if(
            saturation <= 2 * SATURATION_MARGIN_COUNTS,
            f"'saturation_count' is {saturation:g}",
            expected="the highest count of the converter, such as 4095",
            code="saturation-implausible",
        )
        _linearity(cube).check(problems, _highest_count(cube))
        check_stray_light(cube, *shape[1:], exposure, problems)


def _linearity(cube: Mapping[str, Any]) -> Linearity:
    # Return the linearity curve of a line's counts; the identity for a radiance cube.
    curve: Linearity = cube.get("linearity", Linearity())
    return tabulated(cube, curve.on_raw) if table_names(cube) else curve


def _highest_count(cube: Mapping[str, Any]) -> float:
    saturation = np.asarray(cube.get("saturation_count", np.inf), np.float64)
    return float(saturation[np.isfinite(saturation)].max(initial=0.0)) or np.inf


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
    check_irradiance_times(stamps)
    spectra, faults = judge_record(channels, stamps, spectra)  # finds nothing in an opened record
    warn_of_faults(faults)
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
    known = time[~np.isnat(time)]
    warn_if(
        known.size and ((known < stamps[0]) | (known > stamps[-1])).all(),
        f"0 of {known.size} lines are within the irradiance record, which runs from {stamps[0]!s:.19} to "
        f"{stamps[-1]!s:.19}; the line runs from {known.min()!s:.19} to {known.max()!s:.19}, and its "
        "reflectance is NaN. State utc_offset_h= of the record, or the offset of the camera's clock",
        "time-uncovered",
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
    spectra = spectra[used_samples]
    wavelength = imager.wavelength
    # Warn of bands (band,) whose matched irradiance is undefined because channels of a sample are missing.
    #
    # spectra: (sample, channel); matched: (sample, node, band). A sample without any channel is a gap.
    has_values = np.isfinite(spectra).any(axis=1)
    is_lost = (
        np.isnan(matched[has_values]).any(axis=(0, 1))
        & (wavelength >= channels[0])
        & (wavelength <= channels[-1])
    )
    is_missing = np.isnan(spectra[has_values]).any(axis=0)
    # channels that were left out of a record were told when it was opened
    if is_lost.any() and is_missing.any() and "irradiance-channels" not in light.get(FAULTS_ATTR, ""):
        warn_user(
            f"irradiance is undefined in {is_missing.sum()} channels, such as "
            f"{channels[is_missing][0]:g} nm: {is_lost.sum()} of {is_lost.size} bands become NaN at these "
            f"times, {wavelength[is_lost].min():g} to {wavelength[is_lost].max():g} nm; interpolate the "
            "record over them",
            "irradiance-gaps",
        )
    if tilt is not None:
        factors = tilt_factors(tilt, {**light, "time": time}, used_samples, wavelength, _mean_position(cube))
        matched = matched * factors[:, None, :]
    light_of_lines = LineLight(before, after, lines.weight, lines.age, lines.sensitivity, lines.flags)
    return smile.cubics(matched), light_of_lines, misfit.max(axis=0).astype(np.float32)


_PLACE = ("latitude", "longitude")


def _mean_position(cube: Mapping[str, Any]) -> tuple[float, float]:
    # Return mean latitude and longitude of the lines [degree].
    for name in _PLACE:
        SchemaError.raise_if(
            not np.isfinite(cube[name]).any(),
            f"tilt= needs the sun's position, but {name!r} is missing on every line",
            code="place-missing",
        )
    latitude, longitude = (np.asarray(cube[name], np.float64) for name in _PLACE)
    return float(latitude[np.isfinite(latitude)].mean()), float(longitude[np.isfinite(longitude)].mean())


def _is_located(cube: Mapping[str, Any]) -> bool:
    # Return whether latitude and longitude of any line are known.
    return all(name in cube and bool(np.isfinite(cube[name]).any()) for name in _PLACE)


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
    panels = []
    for panel in inputs["panels"]:
        stamps = time[slice(*panel["lines"])]
        stamps = stamps[~np.isnat(stamps)]
        TimeError.raise_if(not stamps.size, f"{panel['name']}: its lines have no time", code="time-missing")
        middle_time, share = stamps[0] + (stamps[-1] - stamps[0]) // 2, None
        if light is not None and _is_located(cube):
            share = direct_share({**light, "time": time}, middle_time, wavelength, _mean_position(cube))
        row = {**panel, "time": middle_time, "direct_share": share}
        if not is_lambertian(panel["surface"]):
            share = SchemaError.raise_if_none(
                share,
                f"{panel['name']}: the surface of the panel is declared, but the direct share of its "
                "light is unknown",
                expected="a line with positions and times, an irradiance record with visible channels, "
                f"and the sun less than {MAX_SUN_ZENITH_DEG:g} degrees from the zenith",
                mend="declare the position of the line, or diffuse_fraction; or leave out surface",
                code="panel-light-unknown",
            )
            zenith, azimuth = map(float, solar_position(middle_time, *_mean_position(cube)))
            factor, u = panel_factor(
                wavelength,
                zenith,
                panel["view"][0],
                azimuth - panel["view"][1],
                surface=panel["surface"],
                direct_share=share[0],
            )
            row["reflectance"] = np.asarray(panel["reflectance"], np.float64) * factor
            row["uncertainty"] = float(np.hypot(panel["uncertainty"], np.nanmax(u, initial=0.0)))
        panels.append(row)
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


# --- cache of the plans of recently used lines in this process, so that later calls for pixels -------------


MAX_PLANS = 8
#: Largest size of all plans and of the inputs they were made from [byte].
MAX_BYTES = 64 * 2**20
#: Largest plan that is embedded in a graph [byte]; tasks compute larger plans from smaller inputs.
MAX_EMBEDDED_BYTES = 8 * 2**20


def _is_lazy(variable: xr.Variable) -> bool:
    data = variable._data
    return (isinstance(data, da.Array) or not variable._in_memory) and not getattr(data, "_copied", False)


class PlanSource:
    # The inputs that a plan is made from, to be compared with those of another line.
    #
    # ``line``: flight line with dims named by role; ``options``: compared with ``==``.
    def __init__(self, line: xr.Dataset, options: tuple[Any, ...]) -> None:
        self._options = (*options, "counts" in line.variables)
        self._attrs: dict[Any, Any] = dict(line.attrs)
        self._contents, self._sources, self.nbytes = {}, {}, 0
        for name, variable in line.variables.items():
            if ALONG_TRACK in variable.dims and {BAND, CROSS_TRACK} & set(variable.dims):
                continue
            self._attrs |= {(name, key): value for key, value in variable.attrs.items()}
            if _is_lazy(variable):
                data = variable._data
                # assigning to a part of a dask array changes its name
                content = getattr(data, "name", None)
                # an array that lives has one weak reference; xarray's wrapper of a file has none
                self._sources[name] = weakref.ref(data) if isinstance(data, da.Array) else data
            else:
                # bytes are compared: NaN equals NaN, and the sign of zero matters
                values = np.asarray(variable.values)
                content = values.tolist() if values.dtype == object else values.tobytes()
                self.nbytes += values.nbytes
            self._contents[name] = (variable.dims, variable.shape, variable.dtype, content)

    def is_of(self, other: "PlanSource") -> bool:
        # Return whether the inputs of another line give the same plan.
        return (
            self._options == other._options
            and self._contents == other._contents
            and all(source is other._sources[name] for name, source in self._sources.items())
            and bool(xr.core.utils.dict_equiv(self._attrs, other._attrs))
        )

    def __reduce__(self) -> Any:
        # None in another process, which has a cache of its own, if any.
        return type(None), ()


@dataclasses.dataclass(eq=False)
class Entry:
    # A plan with the inputs it was made from, and the small coordinates of its line.
    source: PlanSource
    plan: Any = None  #: a `Plan`, None until it is made
    #: Small coordinates; the attributes are those of reflectance
    labels: xr.Dataset = dataclasses.field(default_factory=xr.Dataset)

    @property
    def nbytes(self) -> int:
        # Bytes of the copies of small variables, of the coordinates, and of the plan where it is made.
        return self.source.nbytes + self.labels.nbytes + bytes_of(self.plan)


class PlanCache:
    # The most recently used plans by the inputs they were made from; thread-safe.
    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._entries: list[Entry] = []  # most recently used last

    def entry(self, line: xr.Dataset, options: tuple[Any, ...]) -> Entry:
        # Return the plan of a line; an entry without a plan where it is not cached.
        source = PlanSource(line, options)
        for cached in self._entries[::-1]:
            if cached.source.is_of(source):
                self.add(cached)
                return cached
        return Entry(source)

    def add(self, entry: Entry) -> None:
        # Add a plan or mark it as used; the least recently used plans are dropped.
        with self._lock:
            self._entries = [*(other for other in self._entries if other is not entry), entry]
            while len(self._entries) > MAX_PLANS or sum(e.nbytes for e in self._entries) > MAX_BYTES:
                del self._entries[0]


PLANS = PlanCache()


def bytes_of(value: Any) -> int:
    # Return the bytes of all arrays of a plan.
    if isinstance(value, np.ndarray):
        return int(value.nbytes)
    if dataclasses.is_dataclass(value):
        return sum(map(bytes_of, vars(value).values()))
    return sum(map(bytes_of, value)) if isinstance(value, tuple) else 0


def lazy_plan(
    line: xr.Dataset, options: tuple[Any, ...] | None, planner: Callable[..., Plan], **inputs: Any
) -> Callable[..., Delayed]:
    # Return a function from a cube's shape, dtype and slabs to its lazy plan, named by a hash of the inputs.
    #
    # With ``options`` None no cache is used; else a cached plan is embedded in the graph.
    def of_cube(shape: tuple[int, int, int], dtype: str, starts: Array) -> Delayed:
        name = f"make_plan-{dask.base.tokenize(planner, shape, dtype, starts, inputs)}"
        source = None
        if options is not None:
            entry = PLANS.entry(line, (*options, planner, shape, dtype))
            if entry.plan is not None and bytes_of(entry.plan) <= MAX_EMBEDDED_BYTES:
                return Delayed(name, {name: dataclasses.replace(entry.plan, starts=starts)})
            # the graph keeps the inputs alive, not the plan
            source = entry.source if entry.plan is None and entry.nbytes <= MAX_BYTES // 2 else None
        return dask.delayed(_computed, pure=True)(
            source, planner, shape, dtype, starts, inputs, dask_key_name=name
        )

    return of_cube


def _computed(
    source: PlanSource | None,
    planner: Callable[..., Plan],
    shape: Any,
    dtype: str,
    starts: Array,
    inputs: Any,
) -> Plan:
    plan = planner(shape, dtype, starts, **inputs)
    if source is not None:
        PLANS.add(Entry(source, plan))
    return plan


# --- collect the inputs of a plan from a labelled flight line; labels are checked, values are --------------


COUNTED = ("counts", "dark_counts", "radiance_gain", "exposure_time", "saturation_count")
#: Calibration of a line by a white reference, and what it needs where the light changed between whites.
WHITE_GAIN, WHITE_LIGHT = "reflectance_gain", ("white_level", "white_time", "time")
_LIGHT = ("irradiance", "irradiance_fwhm")
_OPTIONAL = (
    "dark_exposure_time",
    "dark_time",
    "read_noise",
    "time",
    "good",
    "band_spacing",
    "responsivity_slope",
    "wavelength_shift",
    "latitude",
    "longitude",
    "srf",
    "srf_offset",
)


def plan_inputs(
    dataset: xr.Dataset,
    stored: dict[str, Any] | None,
    scale_panels: Sequence[Panel],
    *,
    tilt: Tilt | None = None,
    keep_bits: int | None = None,
    uncertainty: bool = False,
) -> tuple[xr.DataArray, dict[str, Any]]:
    # Return the cube from which reflectance is computed, and the inputs of `make_plan` besides its shape.
    #
    # ``scale_panels``: panels that give the scale; ``stored``: their scale, if measured before.
    is_white = has_white(dataset)
    if "counts" in dataset.variables and not is_white:
        refuse_calibration(dataset, needs_scale=not scale_panels)
    cube, values = cube_inputs(dataset, "reflectance")
    # the plan adds the uncertainty of the panels' means, and of lines between panels
    panel_u = max((panel.uncertainty for panel in scale_panels), default=None)
    return cube, {
        "cube": values,
        "light": None if is_white else _light_inputs(dataset, tilt, bool(scale_panels) and stored is None),
        "tilt": tilt,
        "panel": stored,
        "keep_bits": keep_bits,
        "uncertain": uncertainty_inputs(dataset, panel_u) if uncertainty else None,
    }


def has_white(dataset: xr.Dataset) -> bool:
    # Return whether a white reference calibrates the counts of a line.
    return "counts" in dataset.variables and WHITE_GAIN in dataset.variables


def is_lamp_lit(dataset: xr.Dataset) -> bool:
    # Return whether a line is taken as lit by a lamp: it has a white reference and no position on the ground.
    # Flags of sun and sky (glint, shadow, adjacency) do not apply to it.
    return has_white(dataset) and "latitude" not in dataset.variables


def refuse_calibration(dataset: xr.Dataset, *, needs_scale: bool) -> None:
    # Raise SchemaError for gains without an absolute scale, where one is needed.
    SchemaError.raise_if(
        needs_scale and dataset.attrs.get("absolute_scale") == "unknown",
        "the gain of this line has no absolute scale (attribute absolute_scale 'unknown')",
        mend="compute it with hyperpaint.calibration.anchor_to_radiance, or pass panel= to reflectance",
        code="scale-unknown",
    )


def cube_inputs(dataset: xr.Dataset, purpose: str) -> tuple[xr.DataArray, dict[str, Any]]:
    # Return the counts or the radiance of a line, and the small variables that calibrate it.
    warn_of_lost_calibration(dataset, purpose)
    is_from_counts = "counts" in dataset.variables
    is_white = purpose == "reflectance" and has_white(dataset)
    required = [*COUNTED] if is_from_counts else ["radiance"]
    if is_white:
        required[required.index("radiance_gain")] = WHITE_GAIN
        required += WHITE_LIGHT if WHITE_LIGHT[0] in dataset.variables else ()
    elif purpose == "reflectance":
        required += ["time", "wavelength", "fwhm", *(n for n in _LIGHT if n not in dataset.variables)]
    optional = [name for name in _OPTIONAL if name in dataset.variables]
    if is_from_counts:
        required += (*table_names(dataset.variables), *(["masked"] if "pedestal" in dataset.attrs else ()))
        optional += [name for name in ("masked", *STRAY_LIGHT) if name in dataset.variables]
    elif "radiance_gain" in dataset.variables:
        optional.append("radiance_gain")  # for the slope of the responsivity
    arrays = require(dataset, dict.fromkeys([*required, *optional]), purpose)
    cube = arrays.pop("counts" if is_from_counts else "radiance")
    if not is_from_counts:
        cube = cube.astype(np.float32)
    if purpose == "radiance":
        arrays.pop("wavelength_shift", None)
    if "masked" in arrays and arrays["masked"].dims == (BAND,):
        arrays["masked"] = arrays["masked"].expand_dims(CROSS_TRACK, axis=1)
    values = {name: slabs.small(array) for name, array in arrays.items()}
    if is_white:
        values["radiance_gain"] = values.pop(WHITE_GAIN)
    if is_from_counts and (table_names(values) or declared_linearity(dataset.attrs)):
        values["linearity"] = declared_linearity(dataset.attrs)
    if "masked" in values:
        values["pedestal"] = declared_pedestal(dataset.attrs)
    if SHIFT_TIME in values:
        values["shifted_bands"] = dataset[SHIFT_TIME].attrs.get("bands")
    return cube, values


def _light_inputs(dataset: xr.Dataset, tilt: Any, has_panels: bool) -> dict[str, Any]:
    names = [*_LIGHT, IRRADIANCE_TIME, IRRADIANCE_WAVELENGTH]
    names += [
        name for name in ("irradiance_max_gap", "irradiance_clock_uncertainty") if name in dataset.variables
    ]
    if tilt is not None:
        names += ["latitude", "longitude"]
    if tilt is not None or has_panels:
        names += [name for name in ("diffuse_fraction", "sky_state") if name in dataset.variables]
    arrays = require(dataset, names, "reflectance")
    if arrays[IRRADIANCE_TIME].chunks is None:
        check_irradiance_times(arrays[IRRADIANCE_TIME].values.astype("datetime64[ns]"))
    values = {name: slabs.small(array) for name, array in arrays.items()}
    for attr in ("srf_shape", "irradiance_srf_shape"):
        values[attr] = str(dataset.attrs.get(attr, "gaussian"))
        one_of(values[attr], SRF_SHAPES, f"attribute {attr}")
    values["departure"] = departure_of_record(dataset.attrs)
    values[FAULTS_ATTR] = str(dataset.attrs.get(FAULTS_ATTR, ""))
    return values


# --- check that irradiance is plausible daylight and has all channels, before reflectance is ---------------


#: Limits of an irradiance record that fits the sky over a flight.
RULES = SimpleNamespace(
    # Median of 400-1000 nm over the median of a clear sky at the place and time [1]. A thunderstorm transmits
    # 0.02, light off the sides of clouds adds 0.5, and the clear sky is modelled to a tenth.
    least_share=0.015,
    most_share=1.8,
    # Zenith angle of the sun up to which the clear sky is modelled [degree].
    max_zenith=80.0,
    # Largest median for a lower sun [W m-2 nm-1]: a clear sky has 0.2 at 80 degree.
    most_low_sun=0.3,
)


class LightLevel(NamedTuple):
    # Brightness of a record: median over 400-1000 nm of its brightest sample [W m-2 nm-1], or NaN.
    #
    # zenith: smallest zenith angle of the sun [degree]; clear: median of a clear sky at that angle; NaN if
    # unknown.
    median: float
    zenith: float
    clear: float

    @property
    def slip(self) -> str:
        # Mistaken unit that explains the level, as "A taken for B"; empty without one.
        return unit_slip(self.median / (self.clear if math.isfinite(self.clear) else 1.0))

    @property
    def doubt(self) -> str:
        # How the level differs from daylight at its place and time; empty where it does not.
        level, zenith, clear = self
        slip = f", {self.slip}" if self.slip else ""
        if math.isfinite(clear):
            is_doubtful = not RULES.least_share <= level / clear <= RULES.most_share
            comparison = f"{level / clear:.2g} times that of a clear sky at its place and time{slip}"
        elif zenith > RULES.max_zenith:
            is_doubtful = level > RULES.most_low_sun
            comparison = (
                f"with the sun {90 - zenith:.0f} degree above the horizon, as with local time for UTC"
            )
        else:
            is_doubtful = level < DULL_MEDIAN
            comparison = f"expected at least {DULL_MEDIAN:g} by day{slip}"
        median = f"the median irradiance of 400-1000 nm is {level:.3g} W m-2 nm-1"
        return f"{median}, {comparison}" if is_doubtful else ""


def light_level(cube: Mapping[str, Any], spectra: Array, channels: Floats, stamps: Array) -> LightLevel:
    # Return the brightness of the spectra (sample, channel) that light a line, at its place and time.
    # smallest zenith angle of the sun; NaN where the position is unknown
    zenith = clear = math.nan
    if _is_located(cube) and stamps.size:
        zenith = float(np.min(solar_position(stamps, *_mean_position(cube))[0]))
    if zenith <= RULES.max_zenith:
        nm = channels[(channels >= 300.0) & (channels <= 2500.0)][:: max(1, channels.size // 200)]
        clear = brightest_median(nm, np.asarray(sum(ClearSky(zenith).irradiance(nm)))[None])
    return LightLevel(brightest_median(channels, np.asarray(spectra, np.float64)), zenith, clear)


def check_light(cube: Mapping[str, Any], spectra: Array, channels: Floats, stamps: Array) -> None:
    # Check the level of the spectra (sample, channel) that light a line [W m-2 nm-1].
    #
    # Raises SchemaError: The level is impossible for daylight. Warns PaintWarning: It does not fit position
    # and time.
    light = light_level(cube, spectra, channels, stamps)
    if not math.isfinite(light.median):
        return
    SchemaError.raise_if(
        not LOWEST_MEDIAN <= light.median <= HIGHEST_MEDIAN,
        f"the median irradiance of 400-1000 nm is {light.median:.3g} W m-2 nm-1",
        expected=f"{LOWEST_MEDIAN:g} to {HIGHEST_MEDIAN:g} of daylight{light.slip and ', '}{light.slip}",
        mend="correct its units",
        code="irradiance-level",
    )
    warn_if(
        light.doubt, f"{light.doubt}; check its units, its time, and the line's place", "irradiance-level"
    )
