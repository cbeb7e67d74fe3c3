"""Run all checks of one flight line."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import xarray as xr

from hyperpaint.base.arrays import Floats
from hyperpaint.base.constants import SATURATION_MARGIN_COUNTS
from hyperpaint.base.errors import PaintWarning
from hyperpaint.base.variables import BAND, CROSS_TRACK
from hyperpaint.io.envi.envi_cubes import find_pair, open_envi
from hyperpaint.io.envi.envi_header import read_header
from hyperpaint.io.flightline.dark import DARK_NONE
from hyperpaint.io.flightline.flightline_opening import FlightlineInputs
from hyperpaint.radiometry.planning import SAME_EXPOSURE_SHARE, darks_of_lines

from .cube_sample import CubeSample, sample_cube
from .finding import Finding
from .plausible_bands import judge_bands
from .plausible_counts import judge_range
from .plausible_dark import judge_dark, judge_dark_frames
from .plausible_frames import judge_doubles, judge_index
from .plausible_layout import judge_layout
from .plausible_record import judge_irradiance, judge_navigation


def judge_line(
    line: xr.Dataset, cubes: tuple[FlightlineInputs, ...], *, lit: bool = True
) -> Iterator[Finding]:
    """Judge a flight line and its cubes; samples of them are read.

    ``lit``: whether reflectance is computed, so that the record of irradiance matters.
    """
    name = str(line.attrs["name"])
    if lit:
        yield from judge_irradiance(name, line)
    yield from judge_navigation(name, line)
    for inputs in cubes:
        yield from _judge_cube(line, inputs)


def judge_dark_cube(path: Path) -> Iterator[Finding]:
    """Judge the frames of a dark cube."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PaintWarning)  # opening the dark has warned
        counts = open_envi(path, unsaid="counts")["counts"]
    yield from judge_dark_frames(f"{path.parent.name}/{path.name}", counts)


def _judge_cube(line: xr.Dataset, inputs: FlightlineInputs) -> Iterator[Finding]:
    name = str(inputs.name)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PaintWarning)  # opening the line has warned
        opened = open_envi(
            inputs.path, keep_whole_lines=inputs.keep_whole_lines, quantity=inputs.quantity, unsaid="counts"
        )
        interleave = read_header(find_pair(inputs.path)[0]).interleave
    cube = next(iter(opened.data_vars.values()))
    recorded, findings = judge_index(inputs, cube.shape[0])
    yield from findings
    yield from judge_doubles(name, cube, interleave == "bip", recorded)
    if "counts" not in line or "counts" not in opened:
        return
    layout = list(judge_layout(name, inputs.path, cube.shape[0]))
    yield from layout
    sample = sample_cube(cube, recorded)
    # a cube that is read in a wrong order allows no further check
    if sample is not None and not layout:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # bands without a gain have no mean
            findings = list(_judge_sample(name, line, inputs, sample))
        yield from findings


def _judge_sample(
    name: str, line: xr.Dataset, inputs: FlightlineInputs, sample: CubeSample
) -> Iterator[Finding]:
    saturation = float(np.max(line["saturation_count"].values))
    full = saturation - SATURATION_MARGIN_COUNTS
    yield from judge_range(name, sample, inputs.bit_depth, saturation)
    gain = line["radiance_gain"].transpose(BAND, CROSS_TRACK).values.astype(np.float64)
    dark, is_measured = _dark_of(line)
    if line.attrs.get("dark_source") != DARK_NONE:
        uncertainty = line.get("dark_counts_u_random") if is_measured else None
        spread = None if uncertainty is None else uncertainty.transpose(BAND, CROSS_TRACK).values
        yield from judge_dark(name, dark, spread, gain, sample, full)
    if "wavelength" in line.coords:
        record = None
        if "irradiance" in line:
            record = (line["irradiance_wavelength"].values, line["irradiance"].mean("irradiance_time").values)
        fwhm = float(np.median(line["fwhm"].values)) if "fwhm" in line.coords else 5.0
        light = np.nanmean(np.where(np.isfinite(gain), sample.mean - dark, np.nan), axis=1)
        mean_gain = np.nanmean(gain, axis=1)
        yield from judge_bands(name, light, mean_gain, line["wavelength"].values, fwhm, record)


def _dark_of(line: xr.Dataset) -> tuple[Floats, bool]:
    # Dark (band, cross_track) of a line, and whether it was measured at the line's exposure.
    # A dark that is fitted to darks of other exposures has no noise of its own.
    parts = {"dark_counts": line["dark_counts"].transpose(..., BAND, CROSS_TRACK).values}
    exposure = np.atleast_1d(line["exposure_time"].values).astype(np.float64)
    if "dark_exposure_time" in line:
        parts["dark_exposure_time"] = line["dark_exposure_time"].values
    taken = np.atleast_1d(parts.get("dark_exposure_time", exposure.mean())).astype(np.float64)
    dark = darks_of_lines(parts, exposure)[0].mean(axis=0, dtype=np.float64)
    return dark, bool((np.abs(taken / exposure.mean() - 1.0) <= SAME_EXPOSURE_SHARE).all())
