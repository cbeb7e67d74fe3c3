"""A line's cube, averaged over neighbouring bands: a tenth of its size, and all that flags need."""

from __future__ import annotations

import itertools
import sys
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from hyperpaint.base import schema
from hyperpaint.base.arrays import Array, Progress
from hyperpaint.base.schema import ALONG_TRACK, BAND, CHUNK_LINES, CROSS_TRACK
from hyperpaint.radiometry.slabs import line_chunked

if TYPE_CHECKING:
    import xarray as xr

__all__ = [
    "CHANNELS",
    "Progress",
    "channel_noise",
    "channel_numbers",
    "read_channels",
    "shift_of_channels",
    "to_channels",
    "to_nominal_channels",
    "watched",
    "without_unknown",
]


CHANNELS = 24
"""Channels of a cube that has more bands."""
_TOGETHER = 8  # blocks read at a time: enough for the threads of a laptop, little enough for its memory
_BAR = 40
_PAIRS = 100_000
_DARK = 0.01


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


def shift_of_channels(
    line: xr.Dataset, channel: npt.NDArray[np.int64], columns: int
) -> npt.NDArray[np.float64]:
    """Return by how much a channel's true wavelength differs from the nominal one (channel, column) [nm].

    0 where the line has no ``wavelength_shift``, or it is not known.
    """
    bands = (channel == np.arange(channel.max() + 1)[:, None]).astype(np.float64)
    bands /= bands.sum(axis=1, keepdims=True)
    if "wavelength_shift" not in line.variables:
        return np.zeros((len(bands), columns))
    found = schema.require(line, ["wavelength_shift"], "smile")["wavelength_shift"].variable
    if found.ndim > 1:
        found = found.transpose(BAND, CROSS_TRACK)
    shift = np.nan_to_num(np.asarray(found.values, np.float64))
    return np.ascontiguousarray(bands @ np.broadcast_to(shift, (channel.size, columns)))


def to_nominal_channels(
    channels: npt.NDArray[np.float32],
    centre: npt.NDArray[np.float64],
    shift: npt.NDArray[np.float64],
) -> None:
    """Take the smile out of channels (line, column, channel), in place: what they change by over the shift.

    The slope is that between the channels on both sides, which are much wider than any smile.
    """
    if len(centre) < 2 or not shift.any():
        return
    for block in np.split(channels, range(CHUNK_LINES, len(channels), CHUNK_LINES)):
        slope = np.gradient(block.astype(np.float64), centre, axis=2)
        block -= np.nan_to_num(slope * shift.T).astype(np.float32)


def channel_noise(
    channels: npt.NDArray[np.float32], number: npt.NDArray[np.int32], inside: npt.NDArray[np.bool_]
) -> npt.NDArray[np.float64]:
    """Return the noise of channels (channel,), relative to what is seen [1].

    From second differences over the channels of what neighbouring pixels of one segment differ by: the
    light and the surface change little from pixel to pixel, and smoothly over the channels. 0 where nothing
    is known of it.

    Parameters
    ----------
    channels : (line, column, channel)
        Reflectance [1].
    number, inside : (line, column)
        Segment of every pixel, and whether it lies inside.
    """
    count = channels.shape[2]
    same = (number[:, 1:] == number[:, :-1]) & (number[:, 1:] >= 0) & inside[:, 1:] & inside[:, :-1]
    line, x = np.nonzero(same)
    step = max(1, line.size // _PAIRS)
    line, x = line[::step], x[::step]
    if count < 3 or not line.size:
        return np.zeros(count)
    one, other = (channels[line, x + right].astype(np.float64) for right in (0, 1))
    apart, level = one - other, (one + other)[:, 1:-1] / 2
    bent = (apart[:, 1:-1] - (apart[:, 2:] + apart[:, :-2]) / 2) / np.maximum(level, _DARK)
    noise = np.zeros(count - 2)
    for k, values in enumerate(bent.T):
        known = np.abs(values[np.isfinite(values)])
        # three variances of a channel: one and two halves, squared, of two pixels
        noise[k] = 1.4826 * np.median(known) / np.sqrt(3.0) if known.size else 0.0
    return np.pad(noise, 1, mode="edge")


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
