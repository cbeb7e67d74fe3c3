"""Check for frames that belong to another cube, are doubled, or are missing."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import xarray as xr

from hyperpaint.base.arrays import Array, Bools, Floats, Ints
from hyperpaint.io.flightline.flightline_opening import FlightlineInputs
from hyperpaint.io.flightline.headwall import cube_number, match_frames, read_frame_index
from hyperpaint.io.flightline.timing import Timing

from .finding import KINDS, Finding


@dataclass(frozen=True)
class FrameRules:
    """Thresholds of doubled and lost frames.

    samples, block
        Samples of a line that are compared with the next, and lines read at once.
    chance
        Doubled lines that noise alone may cause, in the whole cube [1].
    noisy
        Share of equal samples in the most similar of the other neighbouring lines, up to which noise is
        visible.
    jump, window
        Lasting step of the stamps, in frame periods, and lines before and after it that show it: stamps of
        a computer are delayed one by one, and catch up.
    """

    samples: int = 1024
    block: int = 1024
    chance: float = 1e-3
    noisy: float = 0.9
    jump: float = 0.7
    window: int = 8


RULES = FrameRules()


def judge_index(inputs: FlightlineInputs, lines: int) -> tuple[Bools, list[Finding]]:
    """Return whether each line of a cube was recorded (along_track,), and findings of its frame index."""
    timing, name = inputs.timing, str(inputs.name)
    if not isinstance(timing, Timing) or timing.frame_index is None:
        return np.ones(lines, bool), []
    index = read_frame_index(timing.frame_index)
    frame, row = match_frames(index, lines, inputs.path, shortened=inputs.keep_whole_lines)
    findings = []
    number, first = cube_number(inputs.path), int(frame[0])
    if number is not None and number != first:
        # a cube may lack its first frame or be renamed: the index is foreign only if the cube has another
        matching = timing.frame_index.with_name(f"frameIndex_{number}.txt")
        foreign = matching != timing.frame_index and matching.is_file()
        kind = KINDS["foreign-frame-index" if foreign else "first-frame"]
        found = f"the first frame of {timing.frame_index.name} for {inputs.path.name} is {first}"
        findings.append(Finding(kind, name, found, str(number)))
    recorded = row >= 0
    if not index.fitted:
        findings += _jumps(name, frame[recorded], index.stamp[row[recorded]])
    return recorded, findings


def _jumps(name: str, frame: Ints, stamp: Ints) -> Iterator[Finding]:
    wide = RULES.window
    if frame.size < 4 * wide:
        return
    steps = np.diff(stamp) / np.diff(frame)
    period = float(np.median(steps))
    late = stamp - stamp[0] - period * (frame - frame[0])
    windows = np.median(np.lib.stride_tricks.sliding_window_view(late, wide), axis=1)
    # compare before and after every long step
    for at in np.flatnonzero(steps[wide - 1 : 1 - wide] > (1.0 + RULES.jump) * period) + wide - 1:
        if (windows[at + 1] - windows[at + 1 - wide]) / period > RULES.jump:
            yield Finding(
                KINDS["lost-frames"],
                name,
                f"stamps step by {steps[at] / period:.3g} periods from frame {frame[at]} to {frame[at + 1]}, "
                "and stay late",
                "1, or frame numbers that skip the lost frames",
            )
            return


def judge_doubles(name: str, counts: xr.DataArray, by_pixel: bool, recorded: Bools) -> Iterator[Finding]:
    """Find lines of lazy counts (along_track, band, cross_track) that repeat the line before.

    by_pixel: whether samples of one pixel lie together in the file; recorded: (along_track,).
    """
    lines, bands, columns = counts.shape
    axis, across = (2, bands) if by_pixel else (1, columns)
    size = counts.shape[axis]
    count = min(size, 4 + RULES.samples // across)
    middle = slice((size - count) // 2, (size + count) // 2)  # contiguous: one read a line
    equal = _equal_shares(counts.isel({counts.dims[axis]: middle}), RULES.block)
    equal = equal[recorded[1:] & recorded[:-1]]
    doubled = equal == 1.0
    if not doubled.any():
        return
    highest = float(equal[~doubled].max()) if not doubled.all() else 0.0
    by_chance = doubled.size * highest ** (count * across)
    if highest > RULES.noisy or by_chance > RULES.chance:
        return
    first = int(np.flatnonzero(doubled)[0]) + 1
    yield Finding(
        KINDS["doubled-frames"],
        name,
        f"{int(doubled.sum())} of {lines} lines are bit for bit the line before, the first is line {first}",
        f"noise: of other neighbouring lines at most {100 * highest:.3g} % of the samples are equal",
    )


def _equal_shares(rows: xr.DataArray, block: int) -> Floats:
    # Share of samples that equal the line before, (along_track - 1,)
    shares: list[Array] = []
    for start in range(0, rows.shape[0] - 1, block):
        part = rows[start : start + block + 1].to_numpy()
        shares.append((part[1:] == part[:-1]).mean(axis=(1, 2)))
    return np.concatenate(shares) if shares else np.zeros(0)
