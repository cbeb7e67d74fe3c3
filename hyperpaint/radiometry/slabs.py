"""Calibrate one slab of lines in one task, and build the lazy graph of such tasks.

A slab is whole lines with all bands and columns. All small inputs (calibration, matched irradiance,
weights of the lines) are collected once in a `Plan`, a single node of the graph that all tasks share; the
task then makes one pass over the counts of a slab. No values are read while the graph is built.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import dask.array as da
import numpy as np
import xarray as xr

from hyperpaint.base import (
    CHUNK_LINES,
    CUBE,
    Array,
    Floats,
    Ints,
    Quality,
    Times,
    lines_a_task,
    warn_user,
)
from hyperpaint.base.many_outputs import split_outputs
from hyperpaint.kernels.arguments import (
    Calibration,
    DetectorModel,
    ErrorTerms,
    FixedFlags,
    SlabOutputs,
    StrayLight,
    count_limits,
    light_cells,
    rounding,
    without_empty_arrays,
)
from hyperpaint.light.illumination import LineLight, Smile


class PanelClosure(NamedTuple):
    # Results of panels, stacked: (panel, band), except ``state`` and ``time`` (panel,).
    scale: Floats  # Expected over measured, by which reflectance is multiplied [1]
    factor: Floats  # Measured over expected [1]
    factor_u: Floats  # Combined standard uncertainty of the factor [1]
    mean_u: Floats  # Relative standard uncertainty of the mean over pixels [1]
    used: Floats  # Share of pixels used [1]
    state: Array
    time: Times
    reasons: tuple[str, ...]  # Reason of the refusal of a panel; empty if not refused

    def at(self, indices: Ints) -> "PanelClosure":
        # Return the results of the panels at indices.
        arrays: list[Any] = [*self[:-1]]
        reasons = tuple(self.reasons[k] for k in indices)
        return PanelClosure._make([*(values[indices] for values in arrays), reasons])


@dataclass(frozen=True)
class Plan:
    # Inputs of a slab other than counts.
    dark: Array  #: (n, band, column) float32: darks in the order of time
    #: dark_index, dark_weight (line,): the dark of a line is between ``dark[i]`` and ``dark[i + 1]``, at
    #: this weight of the later one
    dark_index: Array
    dark_weight: Array
    #: (band, column) float32: radiance per count rate [W m-2 sr-1 nm-1 s count-1]; NaN marks a bad element
    gain: Array
    #: (line,) float64: inverse exposure time [s-1]; 1 for a radiance cube, NaN for a line without data
    rate: Floats
    #: (band,) float64: scale by a panel in the scene, 1 without panels; with several panels (panel, band),
    scale: Floats
    #: (time, band, cell, 1 or 4) float64, or None: matched irradiance [W m-2 nm-1], as cubics over the smile;
    #: None for radiance
    series: Floats | None
    lines: LineLight | None  #: Irradiance samples around every line in time; None for radiance
    #: (band,) float32: largest distance of the matched response from the imager's over the smile, relative
    #: [1]
    misfit: Array
    smile: Smile  #: Cells of the smile, and positions of columns in them
    #: (1, 1) or (band, column), like the counts: counts from which a sample is saturated
    saturation_limit: Array
    #: (band, column) float32: largest depth below the dark by noise [count]; NaN for elements that
    #: set no flag, because the element is bad or the band is not good
    noise_margin: Array
    max_negative_bands: int  #: Number of bands below the dark above which a pixel is flagged
    #: line_flags (line,), column_flags (column,) uint16: bits of `Quality` that hold for whole lines and
    #: columns
    line_flags: Array
    column_flags: Array
    cleared_bits: int  #: Mantissa bits that rounding clears; 0 rounds nothing
    starts: Array  #: (slab,): first line of every slab
    detector: DetectorModel  #: Detector effects that are corrected
    stray: StrayLight | None = None  #: Light of other bands, which is subtracted; None without stray light
    error_terms: ErrorTerms | None = None  #: None where uncertainties are not requested
    closure: PanelClosure | None = None  #: Results of panels; None without panels
    panel_weights: Floats | None = None  #: (line, panel): weights of several panels; otherwise None
    #: (line,) relative standard uncertainty of the scale by panels; None without panels
    panel_u: Floats | None = None

    @functools.cached_property
    def warning_of_means(self) -> None:
        # Warn, once per line, of counts that are means.
        warn_user(
            "counts are not whole numbers: means of several readings may hide a saturated one, and from "
            "counts without their dark it is subtracted twice; pixels above half of the range are flagged "
            "'saturated'; average reflectance instead of counts, and leave the dark in them",
            "counts-averaged",
        )

    def light(self, start: int, stop: int) -> Array:
        # Return the kernel's factors or divisors of lines, (line, band, cell, 1 or 4), float32.
        rate = self.rate[start:stop, None, None, None]
        scale = self.scale[None, :, None, None]
        if self.panel_weights is not None:
            # of lines (line, band), from logarithms of the panels' scales and weights of the lines; panel by
            # panel, so that the bits do not depend on the grouping of lines
            weights = self.panel_weights[start:stop]
            total = np.zeros((len(weights), self.scale.shape[1]))
            for panel, weight in zip(self.scale, weights.T, strict=True):
                total += weight[:, None] * panel
            scale = np.exp(total)[:, :, None, None]
        if self.series is None or self.lines is None:
            return np.ascontiguousarray(rate * scale, np.float32)
        # in place: copies would take half as long as the kernel
        before = self.series[self.lines.before[start:stop]]
        irradiance = self.series[self.lines.after[start:stop]]
        irradiance -= before
        irradiance *= self.lines.weight[start:stop, None, None, None]
        irradiance += before
        if self.smile.nodes.size > 1:
            # NaN without light at either end of a cell
            value_at_end = irradiance[..., 0] + irradiance[..., 1] + irradiance[..., 2] + irradiance[..., 3]
            irradiance[(irradiance[..., 0] <= 0) | (value_at_end <= 0)] = np.nan
            return (irradiance / (np.pi * rate * scale)).astype(np.float32)
        positive = np.where(irradiance > 0, irradiance, np.nan)
        return np.ascontiguousarray(np.pi * rate * scale / positive, np.float32)


def small(array: xr.DataArray) -> Any:
    # Return a small variable's values, or its dask array where it is lazy.
    return array.data if array.chunks is not None else array.values


def line_chunked(cube: xr.DataArray) -> xr.DataArray:
    # Return a cube as (along_track, band, cross_track) whose dask chunks are whole lines.
    cube = cube.transpose(*CUBE)
    if cube.chunks is None:
        line_bytes = cube.sizes[CUBE[1]] * cube.sizes[CUBE[2]] * np.dtype(np.float32).itemsize
        lines = lines_a_task(line_bytes, CHUNK_LINES)
        if cube.variable._in_memory:
            # views with a random name: dask would hash the values, which takes longer than calibrating them
            return cube.copy(data=da.from_array(cube.values, chunks=(lines, -1, -1), name=False))
        return cube.chunk({CUBE[0]: lines, CUBE[1]: -1, CUBE[2]: -1})
    return (
        cube.chunk({CUBE[1]: -1, CUBE[2]: -1})
        if any(len(cube.variable.chunksizes[dim]) > 1 for dim in CUBE[1:])
        else cube
    )


NO_CUBE = np.empty((0, 0, 0), np.float32)


def calibrate_lines(plan: Plan, counts: Array, start: int, out: SlabOutputs) -> None:
    # Calibrate contiguous counts (line, band, column), uint16 or float32, from line ``start`` on.
    #
    # Writes the arrays of ``out`` that are not empty; uncertainties need the plan's ``error_terms``.
    from hyperpaint.kernels.radiometry import calibrate_slab

    lines = slice(start, start + len(counts))
    is_single_dark = len(plan.dark) == 1
    calibration = Calibration(
        plan.dark,
        None if is_single_dark else plan.dark_index[lines],
        None if is_single_dark else plan.dark_weight[lines],
        plan.gain,
        without_empty_arrays(plan.detector),
    )
    light = light_cells(
        plan.light(lines.start, lines.stop), plan.smile.shift, plan.smile.edges, plan.smile.cells
    )
    is_integer = np.issubdtype(counts.dtype, np.integer)
    if not is_integer:
        counts = np.where(np.isneginf(counts), np.float32(np.nan), counts)
    flags = FixedFlags(plan.line_flags[lines], plan.column_flags, np.uint16(Quality.NO_DATA))
    has_uncertainty = plan.error_terms is not None and out.u_random.size > 0
    calibrate_slab(
        counts,
        calibration,
        light,
        count_limits(
            plan.saturation_limit, plan.noise_margin, np.uint16(plan.max_negative_bands), is_integer
        ),
        flags if out.quality.size else None,
        without_empty_arrays(plan.error_terms) if plan.error_terms is not None and has_uncertainty else None,
        rounding(plan.cleared_bits) if plan.stray is None else None,
        out,
    )
    if plan.stray is not None:
        from hyperpaint.kernels.radiometry import subtract_stray_light

        stray = plan.stray._replace(smear=plan.stray.smear[lines])
        subtract_stray_light(counts, calibration, light, stray, rounding(plan.cleared_bits), out)
    # Flag pixels without counts, and pixels whose counts are means that may include a saturated reading.
    # One of two or more readings may be saturated where their mean is halfway from the dark to the limit.
    # All bands of a pixel are judged together, since a mean can be an integer.
    is_flaggable = np.isfinite(plan.noise_margin)
    if is_integer or not out.quality.size or not is_flaggable.any():  # none of radiance
        return
    for quality, row, number in zip(out.quality, counts, range(lines.start, lines.stop), strict=True):
        if plan.line_flags[number] & Quality.NO_DATA:
            continue
        quality[(np.isnan(row) & is_flaggable).any(axis=0)] |= np.uint16(Quality.NO_DATA)
        is_mean = ((np.rint(row) != row) & np.isfinite(row) & is_flaggable).any(axis=0)
        if is_mean.any():
            halfway = 0.5 * (plan.dark[plan.dark_index[number]] + plan.saturation_limit)
            may_be_saturated = is_mean & ((row >= halfway) & is_flaggable).any(axis=0)
            quality[may_be_saturated] |= np.uint16(Quality.SATURATED)
            if may_be_saturated.any():
                plan.warning_of_means  # noqa: B018


def run_slab(counts: Array, plan: Plan, block_id: tuple[int, ...]) -> tuple[Array, ...]:
    # Return the calibrated slab (line, band, column), float32, and its quality (line, column), uint16.
    #
    # With the plan's `ErrorTerms`, the random and the systematic uncertainty follow, shaped as the slab.
    is_certain = plan.error_terms is None
    cube = np.empty(counts.shape, np.float32)
    quality = np.empty((counts.shape[0], counts.shape[2]), np.uint16)
    cubes = (NO_CUBE, NO_CUBE) if is_certain else (np.empty_like(cube), np.empty_like(cube))
    out = SlabOutputs(cube, quality, *cubes)
    calibrate_lines(plan, np.ascontiguousarray(counts), int(plan.starts[block_id[0]]), out)
    return out[:2] if is_certain else tuple(out)


def light_of_lines(plan: Plan, name: str) -> Array:
    # Return ``age`` or ``sensitivity`` of the `LineLight` of every line (line,); NaN without light.
    return np.full(plan.rate.shape, np.nan, np.float32) if plan.lines is None else getattr(plan.lines, name)


def panel_result(plan: Plan, name: str) -> Array:
    # Return a result of panels by its name, ``weight`` (line, panel), or ``scale_u`` (line,).
    #
    # Results have the dtypes of the table of variables.
    assert plan.closure is not None
    if name == "weight":
        array: Any = np.zeros((plan.rate.size, len(plan.closure.reasons)))
        array[:, [not reason for reason in plan.closure.reasons]] = (
            1.0 if plan.panel_weights is None else plan.panel_weights
        )
    else:
        array = plan.panel_u if name == "scale_u" else getattr(plan.closure, name)
    return np.asarray(array, np.float32 if array.dtype == np.float64 else None)


def calibrated(
    source: xr.DataArray, planner: Callable[..., Any], *, cubes: int = 1
) -> tuple[tuple[da.Array, ...], da.Array, Any]:
    # Return the calibrated cubes and their quality, lazily, and the plan they share.
    #
    # One task per slab computes all outputs.
    #
    # ``source`` (along_track, band, cross_track): Counts or radiance in chunks of whole lines; see
    # `line_chunked`. ``cubes``: 1, or 3 where the plan holds `ErrorTerms`: the cube, its random and its
    # systematic uncertainty. ``planner``: Returns the lazy plan for the cube's shape, dtype and slabs.
    counts = source.data
    if counts.dtype not in (np.dtype(np.uint16), np.dtype(np.float32)):
        counts = counts.astype(np.float32)
    plan = planner(counts.shape, counts.dtype.str, np.cumsum((0, *counts.chunks[0][:-1])))
    slabs = da.map_blocks(run_slab, counts, plan, dtype=object, meta=np.empty((0, 0, 0), object), name=None)
    # the order of `run_slab`
    layout = (("lbx", np.float32), ("lx", np.uint16), ("lbx", np.float32), ("lbx", np.float32))
    reflectance, quality, *uncertainties = split_outputs(
        slabs, "lbx", dict(enumerate(layout[: 1 + cubes]))
    ).values()
    return (reflectance, *uncertainties), quality, plan
