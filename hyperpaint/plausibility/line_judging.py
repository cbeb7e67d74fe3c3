"""All that is judged of one flight line."""

from __future__ import annotations

import warnings
from collections.abc import Iterator

import numpy as np
import xarray as xr

from hyperpaint.base.errors import PaintWarning
from hyperpaint.io.envi.envi_cubes import open_envi
from hyperpaint.io.flightline.dark import DARK_NONE
from hyperpaint.io.flightline.flightline_opening import FlightlineInputs

from .cube_sample import sample_cube
from .finding import Finding
from .plausible_counts import judge_range
from .plausible_dark import judge_dark

__all__ = ["judge_line"]


def judge_line(line: xr.Dataset, cubes: tuple[FlightlineInputs, ...]) -> Iterator[Finding]:
    """Judge a flight line and the cubes that it is made of; samples of them are read."""
    if "counts" not in line:
        return
    for inputs in cubes:
        yield from _judge_cube(line, inputs)


def _judge_cube(line: xr.Dataset, inputs: FlightlineInputs) -> Iterator[Finding]:
    name = str(inputs.name)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PaintWarning)  # said when the line was opened
        counts = open_envi(
            inputs.path, keep_whole_lines=inputs.keep_whole_lines, quantity=inputs.quantity, unsaid="counts"
        )["counts"]
    sample = sample_cube(counts, np.ones(counts.shape[0], bool))
    if sample is None:
        return
    saturation = float(np.max(line["saturation_count"].values))
    yield from judge_range(name, sample, inputs.bit_depth, saturation)
    if line.attrs.get("dark_source") != DARK_NONE:
        dark = line["dark_counts"].values.astype(np.float64)
        yield from judge_dark(name, dark.mean(axis=0) if dark.ndim == 3 else dark, sample)
