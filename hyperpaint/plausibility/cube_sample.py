"""A sample of a cube: blocks of whole lines, spread over it, and sums of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr

from hyperpaint.base.arrays import Bools, Floats, Floats32

__all__ = ["CubeSample", "sample_cube"]


@dataclass(frozen=True)
class SampleRules:
    """How much of a cube is looked at.

    blocks, lines
        Blocks, and lines in each: 128 lines tell a mean to a tenth of the noise, and a cube of 640 x 4000 x
        272 is read in a tenth of a second [1].
    pixels
        Pixels whose spectra are looked at one by one [1].
    """

    blocks: int = 8
    lines: int = 16
    pixels: int = 2048


RULES = SampleRules()


@dataclass(frozen=True)
class CubeSample:
    """What a sample of a cube shows of every element (band, cross_track), in counts."""

    lines: int  #: Lines of the sample
    mean: Floats
    least: Floats
    most: Floats
    noise: Floats  #: From the differences of successive lines: noise, and what the scene changes
    divisor: int  #: Greatest common divisor of all counts
    pixels: Floats32  #: Spectra of some pixels (pixel, band)


def sample_cube(counts: xr.DataArray, recorded: Bools) -> CubeSample | None:
    """Return a sample of lazy counts (along_track, band, cross_track); None where no line is recorded.

    recorded: (along_track,), False where a frame was lost and the line is blank.
    """
    total = int(counts.shape[0])
    size = min(RULES.lines, total)
    starts = np.unique(np.linspace(0, total - size, min(RULES.blocks, max(1, total // size))).astype(int))
    shape = counts.shape[1:]
    sums, squares = np.zeros(shape), np.zeros(shape)
    least, most = np.full(shape, np.inf), np.full(shape, -np.inf)
    lines, pairs, divisor = 0, 0, 0
    spectra = []
    step = max(1, len(starts) * size * shape[1] // RULES.pixels)
    for start in starts.tolist():
        block = counts[start : start + size].to_numpy()[recorded[start : start + size]]
        if not len(block):
            continue
        lines += len(block)
        sums += block.sum(axis=0, dtype=np.float64)
        least, most = np.minimum(least, block.min(axis=0)), np.maximum(most, block.max(axis=0))
        changes = np.diff(block.astype(np.float32), axis=0)
        squares += np.square(changes).sum(axis=0, dtype=np.float64)
        pairs += len(changes)
        divisor = int(np.gcd.reduce(block, axis=None, initial=divisor))
        spectra.append(block.transpose(0, 2, 1).reshape(-1, shape[0])[::step].astype(np.float32))
    if not lines:
        return None
    noise = np.sqrt(squares / max(2 * pairs, 1)) if pairs else np.full(shape, np.nan)
    return CubeSample(lines, sums / lines, least, most, noise, divisor, np.concatenate(spectra))
