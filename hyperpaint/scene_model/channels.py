"""A line's cube, averaged over neighbouring bands: a tenth of its size, and all that flags need."""

from __future__ import annotations

import itertools
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from hyperpaint.schema import ALONG_TRACK, CHUNK_LINES
from hyperpaint.slabs import line_chunked

if TYPE_CHECKING:
    import xarray as xr

__all__ = [
    "CHANNELS",
    "Progress",
    "channel_numbers",
    "read_channels",
    "to_channels",
    "watched",
    "without_unknown",
]

Array = npt.NDArray[Any]
Progress = Callable[[int, int], None]

CHANNELS = 24
"""Channels of a cube that has more bands."""
_TOGETHER = 8  # blocks read at a time: enough for the threads of a laptop, little enough for its memory
_BAR = 40


def channel_numbers(wavelength: Array, good: Array) -> npt.NDArray[np.int64]:
    """Return the channel of every band: runs of as many good bands each; -1 for bands that are not good.

    The ends of the spectrum, where colours have their steepest edges, are not treated apart: 24 channels of
    a 400-1000 nm camera are 25 nm wide.
    """
    order = np.flatnonzero(good)[np.argsort(wavelength[good], kind="stable")]
    count = min(CHANNELS, order.size)
    numbers = np.full(wavelength.size, -1, np.int64)
    numbers[order] = np.arange(order.size) * count // max(order.size, 1)
    return numbers


def to_channels(block: Array, channel: npt.NDArray[np.int64]) -> npt.NDArray[np.float32]:
    """Return the means (line, column, channel) of a block (line, band, column)."""
    from hyperpaint.kernels.unmixing import average_bands

    out = np.empty((block.shape[0], block.shape[2], int(channel.max()) + 1), np.float32)
    average_bands(np.ascontiguousarray(block, np.float32), channel, out)
    return out


def read_channels(
    cube: xr.DataArray, channel: npt.NDArray[np.int64], progress: Progress | None
) -> npt.NDArray[np.float32]:
    """Return the whole line in channels (line, column, channel), some blocks in memory at a time.

    A pixel's means depend on its own bands alone, so that blocks change no bit.
    """
    import dask

    cube = line_chunked(cube)
    lines, columns = cube.sizes[ALONG_TRACK], cube.sizes[cube.dims[2]]
    out = np.empty((lines, columns, int(channel.max()) + 1), np.float32)
    starts = (
        np.cumsum((0, *cube.chunks[0])) if cube.chunks else np.arange(0, lines + CHUNK_LINES, CHUNK_LINES)
    )
    parts = [(int(a), min(int(b), lines)) for a, b in itertools.pairwise(starts) if a < lines]
    numbers = dask.delayed(channel)
    for first in range(0, len(parts), _TOGETHER):
        here = parts[first : first + _TOGETHER]
        blocks = cube.data[here[0][0] : here[-1][1]]
        made = [
            dask.delayed(to_channels, pure=True)(block, numbers) for block in np.ravel(blocks.to_delayed())
        ]
        for (start, stop), values in zip(here, dask.compute(*made), strict=True):
            out[start:stop] = values
        if progress is not None:
            progress(here[-1][1], lines)
    return out


def without_unknown(
    channels: npt.NDArray[np.float32], channel: npt.NDArray[np.int64]
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int64]]:
    """Return a line in channels, and the channel of every band, without channels that most pixels lack.

    One channel that is dead for the whole line would otherwise leave no segment of which all is known. Where
    no channel would remain, all do.
    """
    data = int(np.isfinite(channels).any(axis=2).sum())
    known = np.array([np.isfinite(channels[..., k]).sum() for k in range(channels.shape[2])])
    kept = 2 * known >= data
    if kept.all() or not kept.any():
        return channels, channel
    numbers = np.append(np.where(kept, np.cumsum(kept) - 1, -1), -1)  # the last one is that of -1
    return np.ascontiguousarray(channels[..., kept]), numbers[channel]


def watched(progress: Progress | bool | None, label: str) -> Progress | None:
    """Return what draws a bar on stderr where ``progress`` is True, and ``progress`` itself otherwise."""
    if progress is None or progress is False:
        return None
    if progress is not True:
        return progress

    def draw(done: int, total: int) -> None:
        filled = _BAR * done // max(total, 1)
        end = "\n" if done >= total else ""
        sys.stderr.write(f"\r{label} [{'#' * filled}{'-' * (_BAR - filled)}] {done}/{total} lines{end}")
        sys.stderr.flush()

    return draw
