"""What one task does with one slab of lines, and the lazy graph of such tasks.

A slab is whole lines with all bands and columns. Everything that is small (calibration, matched irradiance,
weights of the lines) is gathered once into a `Plan`, a single node of the graph that every task shares; the
task then makes one pass over the slab's counts. Nothing is read while the graph is built.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from .errors import Problems, SchemaError
from .illumination import LineLight, Smile, Tilt, line_light, matched_series, smile_cells
from .schema import CHUNK_LINES, CUBE, Quality
from .units import convert

if TYPE_CHECKING:
    import dask.array as da
    import xarray as xr

__all__ = [
    "Plan",
    "age_of_irradiance",
    "calibrated",
    "line_chunked",
    "make_plan",
    "plan_values",
    "run_slab",
    "small",
]

Array = npt.NDArray[Any]
Float = npt.NDArray[np.float64]

SATURATION_MARGIN = 16.0
"""Counts below the converter's end from which a sample is no longer trusted."""
NOISE_SIGMAS = 5.0
DEFAULT_READ_NOISE = 2.0
"""Spread of a dark count [count] where neither the calibration nor the dark tells."""
BAD_BAND_SHARE = 0.05
NEGATIVE_BAND_SHARE = 0.1
_QUANTISATION = 1.0 / 12.0


@dataclass(frozen=True)
class Plan:
    """All that a slab needs beside its counts; see `hyperpaint.kernels.radiometry.calibrate_slab`.

    Attributes
    ----------
    rate : (line,), float64
        Inverse exposure time [s-1]; 1 for a radiance cube.
    series : (sample, band, cell, 1 or 4), float64, or None
        Matched irradiance [W m-2 nm-1], as cubics over the smile; None for radiance.
    scale : (band,), float64
        Factor of a known panel in the scene; 1 without.
    starts : (slab,)
        First line of every slab.
    """

    dark: Array
    dark_index: Array
    dark_weight: Array
    gain: Array
    rate: Float
    scale: Float
    series: Float | None
    lines: LineLight | None
    smile: Smile
    limit: Array
    floor: Array
    zero: Array
    watched: Array
    flag_limits: Array
    line_flags: Array
    column_flags: Array
    dropped: int
    starts: Array

    def light(self, start: int, stop: int) -> Array:
        """Return what the kernel multiplies or divides lines by, (line, band, cell, 1 or 4), float32."""
        rate = self.rate[start:stop, None, None, None]
        scale = self.scale[None, :, None, None]
        if self.series is None or self.lines is None:
            return np.ascontiguousarray(rate * scale, np.float32)
        before, after = self.lines.before[start:stop], self.lines.after[start:stop]
        weight = self.lines.weight[start:stop, None, None, None]
        irradiance = self.series[before] + weight * (self.series[after] - self.series[before])
        if self.smile.nodes.size > 1:
            # where there is no light at either end of a cell
            dim = (irradiance[..., :1] <= 0) | (irradiance.sum(axis=-1, keepdims=True) <= 0)
            irradiance = np.where(dim, np.nan, irradiance)
            return np.ascontiguousarray(irradiance / (np.pi * rate * scale), np.float32)
        lit = np.where(irradiance > 0, irradiance, np.nan)
        return np.ascontiguousarray(np.pi * rate * scale / lit, np.float32)


def small(array: xr.DataArray) -> Any:
    """Return a small variable's values, or its dask array where it is lazy."""
    return array.data if array.chunks is not None else array.values


def line_chunked(cube: xr.DataArray) -> xr.DataArray:
    """Return a cube as (along_track, band, cross_track) whose dask chunks are whole lines."""
    cube = cube.transpose(*CUBE)
    if cube.chunks is None:
        return cube.chunk({CUBE[0]: CHUNK_LINES, CUBE[1]: -1, CUBE[2]: -1})
    if any(len(cube.variable.chunksizes[dim]) > 1 for dim in CUBE[1:]):
        return cube.chunk({CUBE[1]: -1, CUBE[2]: -1})
    return cube


def plan_values(dataset: xr.Dataset, names: Mapping[str, str]) -> dict[str, Any]:
    """Return optional variables as plan inputs, converted to ``names``'s units ("" for none)."""
    found: dict[str, Any] = {}
    for name, units in names.items():
        if name in dataset.variables:
            found[name] = small(convert(dataset[name], units) if units else dataset[name])
    return found


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
) -> Plan:
    """Gather what every slab of a cube needs.

    Parameters
    ----------
    shape, dtype
        Of the cube (along_track, band, cross_track).
    starts : (slab,)
        First line of every slab.
    cube
        Values of `dark_counts`, `radiance_gain`, `exposure_time` and the other variables of the table, by
        name; without a gain the cube is taken to be radiance.
    light
        Values of `irradiance` and its companions; None for radiance.
    tilt, panel, keep_bits
        See `hyperpaint.radiometry.reflectance`.

    Raises
    ------
    SchemaError, TimeError
        Values that cannot be: all that were found.
    """
    lines, bands, columns = shape
    _check_values(cube, shape)
    good = np.asarray(cube.get("good", np.ones(bands, bool)), bool)
    dark, dark_index, dark_weight = _darks(cube, shape)
    from_counts = "radiance_gain" in cube
    gain = np.asarray(cube["radiance_gain"] if from_counts else np.ones((bands, columns)), np.float32)
    exposure = np.broadcast_to(np.asarray(cube["exposure_time"] if from_counts else 1.0, np.float64), lines)
    bad = ~np.isfinite(gain + dark.sum(axis=0))
    watched = good[:, None] & ~bad
    limit, floor, zero = _count_limits(cube, dark, watched, np.dtype(dtype))
    bad_share = bad[good].mean(axis=0) if good.any() else np.zeros(columns)
    column_flags = np.where(bad_share > BAD_BAND_SHARE, Quality.BAD_DETECTOR, 0).astype(np.uint16)
    time = np.asarray(cube["time"]).astype("datetime64[ns]") if "time" in cube else None
    line_flags = np.zeros(lines, np.uint16)
    if time is not None:
        line_flags[np.isnat(time)] = Quality.NO_DATA
    smile = smile_cells(cube.get("wavelength_shift") if light else None, columns)
    series = neighbours = None
    if light is not None and time is not None:
        responsivity = None
        if from_counts:
            # a band that is bad in every column is NaN, and is left out of the slope
            usable = np.isfinite(gain)
            with np.errstate(invalid="ignore"):
                total = np.where(usable, 1.0 / gain.astype(np.float64), 0.0).sum(axis=1)
                responsivity = total / usable.sum(axis=1)
        series, neighbours = _illuminate(cube, light, time, smile, responsivity, tilt)
        line_flags |= neighbours.flags
    rate = np.where(line_flags & Quality.NO_DATA, np.nan, 1.0 / exposure)
    return Plan(
        dark=dark,
        dark_index=dark_index,
        dark_weight=dark_weight,
        gain=gain,
        rate=rate,
        scale=np.ones(bands) if panel is None else _panel_scale(panel),
        series=series,
        lines=neighbours,
        smile=smile,
        limit=limit,
        floor=floor,
        zero=zero,
        watched=watched,
        flag_limits=np.array([int(NEGATIVE_BAND_SHARE * good.sum()), Quality.NO_DATA], np.uint16),
        line_flags=line_flags,
        column_flags=column_flags,
        dropped=0 if keep_bits is None else 23 - keep_bits,
        starts=starts,
    )


def _check_values(cube: Mapping[str, Any], shape: tuple[int, int, int]) -> None:
    problems = Problems("this line cannot be calibrated", SchemaError)
    for name, value in cube.items():
        expected = {"dark_counts": shape[1:], "radiance_gain": shape[1:]}.get(name)
        if expected and np.shape(value)[-2:] != expected:
            problems.add(f"{name!r} has shape {np.shape(value)}, expected (band, cross_track) = {expected}")
    exposure = np.asarray(cube.get("exposure_time", 1.0), np.float64)
    wrong = exposure[~(np.isfinite(exposure) & (exposure > 0))]
    if wrong.size:
        problems.add(f"'exposure_time' must be positive, found {wrong[0]:g} s")
    elif (exposure > 60).any():
        problems.add(f"'exposure_time' is {exposure.max():g} s; is it in milliseconds? set its units to 'ms'")
    gain = np.asarray(cube.get("radiance_gain", 1.0))
    if np.isfinite(gain).any() and np.nanmin(gain) <= 0:
        problems.add("'radiance_gain' must be positive; NaN marks a bad element")
    if not np.isfinite(gain).any():
        problems.add("'radiance_gain' holds no finite value")
    problems.raise_if_any()


def _darks(cube: Mapping[str, Any], shape: tuple[int, int, int]) -> tuple[Array, Array, Array]:
    """Return darks (n, band, column) at the line's exposure, and the neighbours and weights of each line."""
    lines, bands, columns = shape
    none = np.zeros(lines, np.int64), np.zeros(lines, np.float32)
    if "dark_counts" not in cube:
        return np.zeros((1, bands, columns), np.float32), *none
    dark = np.asarray(cube["dark_counts"], np.float32)
    dark = dark[None] if dark.ndim == 2 else dark
    times = cube.get("dark_time")
    order = np.arange(len(dark)) if times is None else np.argsort(np.asarray(times), kind="stable")
    dark = dark[order]
    exposure = float(np.median(np.asarray(cube.get("exposure_time", np.nan), np.float64)))
    taken_at = cube.get("dark_exposure_time")
    if taken_at is not None and np.isfinite(exposure):
        taken = np.broadcast_to(np.asarray(taken_at, np.float64), len(dark))[order]
        same = np.abs(taken / exposure - 1.0) <= 0.01
        if not same.any():
            return _scaled_dark(dark, taken, exposure)[None], *none
        dark, order = dark[same], order[same]
    if len(dark) == 1 or times is None or "time" not in cube:
        return dark.mean(axis=0, dtype=np.float64).astype(np.float32)[None], *none
    stamps = np.asarray(times).astype("datetime64[ns]").astype(np.int64)[order]
    now = np.asarray(cube["time"]).astype("datetime64[ns]")
    ticks = np.where(np.isnat(now), stamps[0], now.astype(np.int64))
    # before the first and after the last dark that one is held: the best there is, and a dark drifts slowly
    index = np.clip(np.searchsorted(stamps, ticks, side="right") - 1, 0, len(dark) - 2)
    weight = (ticks - stamps[index]) / np.maximum(stamps[index + 1] - stamps[index], 1)
    return dark, index.astype(np.int64), np.clip(weight, 0.0, 1.0).astype(np.float32)


def _scaled_dark(dark: Array, taken: Float, exposure: float) -> Array:
    """Return bias + rate x exposure, fitted to darks at two exposures or more; the bias is never scaled."""
    if np.unique(taken.round(9)).size < 2:
        msg = (
            f"the dark was taken at {taken[0] * 1e3:g} ms, the line at {exposure * 1e3:g} ms; take a dark at "
            "the line's exposure, or darks at two exposures, from which bias and rate follow"
        )
        raise SchemaError(msg)
    centred = taken - taken.mean()
    rate = np.tensordot(centred, dark, axes=(0, 0)) / (centred @ centred)
    return np.asarray(dark.mean(axis=0) + rate * (exposure - taken.mean()), np.float32)


def _count_limits(
    cube: Mapping[str, Any], dark: Array, watched: Array, dtype: np.dtype[Any]
) -> tuple[Array, Array, Array]:
    """Return counts that are saturated (1, 1 or band, column), under the noise and under the dark."""
    bands, columns = watched.shape
    whole = np.issubdtype(dtype, np.integer)
    nothing = np.zeros((bands, columns), dtype) if whole else np.full((bands, columns), -np.inf, dtype)
    if "radiance_gain" not in cube:
        return np.full((1, 1), np.inf, dtype), nothing, nothing
    saturation = np.asarray(cube["saturation_count"], np.float64) - SATURATION_MARGIN
    saturation = np.where(np.isnan(saturation), np.inf, saturation)
    limit = saturation.reshape(1, 1) if saturation.ndim == 0 else saturation
    noise = np.asarray(cube.get("read_noise", DEFAULT_READ_NOISE), np.float64)
    sigma = np.sqrt(noise**2 + _QUANTISATION)
    level = dark.mean(axis=0, dtype=np.float64)
    below, zero = np.where(watched, level - NOISE_SIGMAS * sigma, 0.0), np.where(watched, level, 0.0)
    if whole:
        most = np.iinfo(dtype).max
        # an integer is below a bound exactly when it is below the bound rounded up
        limit, below, zero = (np.clip(np.ceil(bound), 0, most) for bound in (limit, below, zero))
    return (
        np.ascontiguousarray(limit, dtype),
        np.where(watched, below, nothing).astype(dtype),
        np.where(watched, zero, nothing).astype(dtype),
    )


def _illuminate(
    cube: Mapping[str, Any],
    light: Mapping[str, Any],
    time: Array,
    smile: Smile,
    responsivity: Float | None,
    tilt: Tilt | None,
) -> tuple[Float, LineLight]:
    """Return the matched series as cubics over the smile, and the neighbours of every line."""
    spectra = np.asarray(light["irradiance"], np.float64)
    samples = np.asarray(light["irradiance_wavelength"], np.float64)
    imager = {
        "wavelength": np.asarray(cube["wavelength"], np.float64),
        "fwhm": np.asarray(cube["fwhm"], np.float64),
        "srf_shape": light["srf_shape"],
        "srf_offset": cube.get("srf_offset"),
        "srf": cube.get("srf"),
        "responsivity": responsivity,
    }
    matched = matched_series(
        spectra, samples, light["irradiance_fwhm"], light["irradiance_srf_shape"], imager, smile.nodes
    )
    if tilt is not None:
        latitude, longitude = float(np.nanmean(cube["latitude"])), float(np.nanmean(cube["longitude"]))
        onto = tilt.factor(light["irradiance_time"], latitude, longitude, np.asarray(cube["wavelength"]))
        matched = matched * onto[:, None, :]
    gap = light.get("irradiance_max_gap")
    neighbours = line_light(
        time,
        light["irradiance_time"],
        _power(spectra, samples),
        None if gap is None else float(gap),
        cube.get("latitude"),
        cube.get("longitude"),
    )
    return smile.cubics(matched), neighbours


def _power(spectra: Float, samples: Float) -> Float:
    """Return the 400-1000 nm sum of each spectrum; NaN where it misses a value that others have."""
    inside = spectra[:, (samples >= 400.0) & (samples <= 1000.0)]
    if inside.shape[1] == 0:
        inside = spectra
    known = ~np.isnan(inside).all(axis=0)
    return np.asarray(inside[:, known].sum(axis=1)) if known.any() else np.full(len(spectra), np.nan)


def _panel_scale(panel: Mapping[str, Any]) -> Float:
    """Return known over observed reflectance of a panel, band by band."""
    observed = np.asarray(panel["observed"], np.float64)
    pixels = np.isfinite(observed)
    total = np.where(pixels, observed, 0.0).sum(axis=(0, 2))
    number = pixels.sum(axis=(0, 2))
    if not number.any():
        msg = "the panel's region holds no valid pixel; it is saturated, in a gap, or outside the line"
        raise SchemaError(msg)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(panel["reflectance"] * number / total)


def run_slab(counts: Array, plan: Plan, block_id: tuple[int, ...]) -> tuple[Array, Array]:
    """Return the calibrated slab (line, band, column), float32, and its quality (line, column), uint16."""
    from .kernels.radiometry import calibrate_slab

    start = int(plan.starts[block_id[0]])
    lines, bands, columns = counts.shape
    out = np.empty((lines, bands, columns), np.float32)
    quality = np.empty((lines, columns), np.uint16)
    here = slice(start, start + lines)
    calibrate_slab(
        np.ascontiguousarray(counts),
        plan.dark,
        plan.dark_index[here],
        plan.dark_weight[here],
        plan.gain,
        plan.light(start, start + lines),
        plan.smile.shift,
        plan.smile.edges,
        plan.smile.cells,
        plan.limit,
        plan.floor,
        plan.zero,
        plan.watched,
        plan.flag_limits,
        plan.line_flags[here],
        plan.column_flags,
        np.uint32(plan.dropped),
        out,
        out.view(np.uint32),
        quality,
    )
    return out, quality


def _cube_of(slab: tuple[Array, Array]) -> Array:
    return slab[0]


def _quality_of(slabs: list[tuple[Array, Array]]) -> Array:
    return slabs[0][1]


def age_of_irradiance(plan: Plan) -> Array:
    """Return the time from every line to the nearest irradiance sample (line,) [s]."""
    return np.full(plan.rate.shape, np.nan, np.float32) if plan.lines is None else plan.lines.age


def calibrated(source: xr.DataArray, **inputs: Any) -> tuple[da.Array, da.Array, Any]:
    """Return the calibrated cube and its quality, lazily, and the plan they share.

    One task a slab makes both; asked for alone, either costs one fused task a slab.

    Parameters
    ----------
    source : (along_track, band, cross_track)
        Counts or radiance in chunks of whole lines; see `line_chunked`.
    **inputs
        Of `make_plan`.
    """
    import dask
    import dask.array as da

    counts = source.data
    if counts.dtype not in (np.dtype(np.uint16), np.dtype(np.float32)):
        counts = counts.astype(np.float32)
    starts = np.cumsum((0, *counts.chunks[0][:-1]))
    plan = dask.delayed(make_plan, pure=True)(counts.shape, counts.dtype.str, starts, **inputs)
    slabs = da.map_blocks(run_slab, counts, plan, dtype=object, meta=np.empty((0, 0, 0), object), name=None)
    made = da.blockwise(_cube_of, "lbx", slabs, "lbx", meta=np.empty((0, 0, 0), np.float32))
    quality = da.blockwise(_quality_of, "lx", slabs, "lbx", meta=np.empty((0, 0), np.uint16))
    return made, quality, plan
