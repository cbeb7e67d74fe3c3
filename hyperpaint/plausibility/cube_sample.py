"""A sample of a cube: blocks of whole lines, spread over it, and sums of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr

from hyperpaint.base.arrays import Bools, Floats
from hyperpaint.base.constants import lines_a_task


@dataclass(frozen=True)
class SampleRules:
    """Size of the sample of a cube.

    blocks, lines
        Blocks, and lines in each: 128 lines give a mean to a tenth of the noise, and a cube of 640 x 4000 x
        272 is read in a tenth of a second [1].
    """

    blocks: int = 8
    lines: int = 16


RULES = SampleRules()


@dataclass(frozen=True)
class CubeSample:
    """Statistics of a sample of a cube for every element (band, cross_track), in counts."""

    lines: int  #: Lines of the sample
    mean: Floats
    highest: Floats
    divisor: int  #: Greatest common divisor of all counts


def sample_cube(counts: xr.DataArray, recorded: Bools) -> CubeSample | None:
    """Return a sample of lazy counts (along_track, band, cross_track); None where no line is recorded.

    recorded: (along_track,), False where a frame was lost and the line is blank.
    """
    total = int(counts.shape[0])
    size = min(max(2, lines_a_task(4 * int(np.prod(counts.shape[1:])), RULES.lines)), total)
    starts = np.unique(np.linspace(0, total - size, min(RULES.blocks, max(1, total // size))).astype(int))
    shape = counts.shape[1:]
    sums = np.zeros(shape)
    highest = np.full(shape, -np.inf)
    lines, divisor = 0, 0
    for start in starts.tolist():
        block = counts[start : start + size].to_numpy()[recorded[start : start + size]]
        if not len(block):
            continue
        lines += len(block)
        sums += block.sum(axis=0, dtype=np.float64)
        highest = np.maximum(highest, block.max(axis=0))
        divisor = int(np.gcd.reduce(block, axis=None, initial=divisor))
    return None if not lines else CubeSample(lines, sums / lines, highest, divisor)
