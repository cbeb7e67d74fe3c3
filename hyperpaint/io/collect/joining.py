"""Cubes of one flight as one line, where the recording continues from one to the next."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base.schema import ALONG_TRACK, IRRADIANCE_TIME, with_numbers
from hyperpaint.io.flightline.flightline_opening import BLANK_COUNT
from hyperpaint.io.spectrometers.irradiance import cut_irradiance

#: Maximum time from the last line of a cube to the first of the next within one recording [line periods]:
#: one lost frame is bridged, as in the navigation.
MAX_STEP_PERIODS = 2.5


@dataclass(frozen=True)
class JoinedLine:
    """A line of one or more cubes."""

    line: xr.Dataset
    members: tuple[str, ...]  #: Ids of its cubes; the first names it
    interruption: str = ""  #: Why it does not continue the line before


def join_lines(lines: Mapping[str, xr.Dataset], irradiance: xr.Dataset | None) -> Iterator[JoinedLine]:
    """Yield the lines that cubes of one flight make, in their order.

    Parameters
    ----------
    lines
        Id to the line of each cube, in the order of recording.
    irradiance
        The whole record, from which each line takes the part that covers it, or None.
    """
    groups: list[list[str]] = []
    reasons: list[str] = []
    for name in lines:
        reason = _interruption(lines, groups[-1][-1], name) if groups else ""
        if groups and not reason:
            groups[-1].append(name)
        else:
            groups.append([name])
            reasons.append(reason)
    for members, reason in zip(groups, reasons, strict=True):
        yield JoinedLine(_joined([lines[name] for name in members], irradiance), tuple(members), reason)


def _interruption(lines: Mapping[str, xr.Dataset], before: str, name: str) -> str:
    first, second = lines[before], lines[name]
    apart = _apart(first, second)
    if apart is None:
        return f"the times of {before} or {name} are not known"
    step, period = apart
    if not np.timedelta64(0, "ns") < step <= MAX_STEP_PERIODS * period:
        seconds, usual = step / np.timedelta64(1, "s"), period / np.timedelta64(1, "s")
        return f"{name} begins {seconds:.3g} s after {before} ended, where lines are {usual:.3g} s apart"
    if set(first.variables) != set(second.variables):
        return (
            f"{name} and {before} differ in {sorted(map(str, set(first.variables) ^ set(second.variables)))}"
        )
    different = [
        str(key)
        for key, variable in first.variables.items()
        if not {ALONG_TRACK, IRRADIANCE_TIME} & set(variable.dims)
        and not variable.equals(second.variables[key])
    ]
    return f"{name} and {before} differ in {', '.join(different)}" if different else ""


def _apart(first: xr.Dataset, second: xr.Dataset) -> tuple[np.timedelta64, np.timedelta64] | None:
    # The time from the last line of a cube to the first of the next, and from line to line.
    times, after = (line["time"].values.astype("datetime64[ns]") for line in (first, second))
    # lines of lost frames are blank, without a time
    timed, timed_after = (np.flatnonzero(~np.isnat(values)) for values in (times, after))
    if timed.size < 2 or not timed_after.size:
        return None
    period = np.median(np.diff(times[timed]).astype(np.int64) / np.diff(timed)).astype("timedelta64[ns]")
    blank = int(times.size - 1 - timed[-1] + timed_after[0])
    return after[timed_after[0]] - times[timed[-1]] - blank * period, period


def _frames_between(first: xr.Dataset, second: xr.Dataset) -> int:
    # The number of frames lost between two cubes: by frame number if it continues, else by time.
    by_number = int(second["frame"].values[0]) - int(first["frame"].values[-1]) - 1
    if 0 <= by_number < MAX_STEP_PERIODS:
        return by_number
    apart = _apart(first, second)
    return 0 if apart is None else max(0, round(float(apart[0] / apart[1])) - 1)


def _blank_lines(before: xr.Dataset, count: int) -> xr.Dataset:
    # Blank lines for lost frames, without time and place; frame numbers continue.
    blank = before.isel({ALONG_TRACK: [-1] * count})
    for name, variable in before.variables.items():
        filled = blank[name]
        if ALONG_TRACK not in variable.dims or name == "exposure_time":
            continue
        if name == "frame":
            filled = filled + np.arange(1, count + 1)
        elif name == "counts":
            filled = xr.full_like(filled, BLANK_COUNT)
        else:
            empty: Any = np.datetime64("NaT", "ns") if variable.dtype.kind == "M" else np.nan
            filled = xr.full_like(filled, empty)
        blank[name] = filled.variable
    return blank


def _joined(lines: list[xr.Dataset], irradiance: xr.Dataset | None) -> xr.Dataset:
    if len(lines) == 1:
        return lines[0]
    lost = [_frames_between(*pair) for pair in itertools.pairwise(lines)]
    bare = [line.drop_dims(IRRADIANCE_TIME, errors="ignore").drop_vars(ALONG_TRACK) for line in lines]
    for place in reversed(np.flatnonzero(lost)):
        bare.insert(place + 1, _blank_lines(bare[place], lost[place]))
    joined: xr.Dataset = xr.concat(
        bare,
        ALONG_TRACK,
        data_vars="minimal",
        coords="minimal",
        compat="override",
        join="override",
        combine_attrs="override",
    )
    joined = with_numbers(joined)  # they count on from cube to cube
    # the tasks that one cube would have been read in
    for name, variable in bare[0].variables.items():
        if variable.chunks is not None and ALONG_TRACK in variable.dims:
            joined[name] = joined[name].chunk({ALONG_TRACK: variable.chunksizes[ALONG_TRACK][0]})
    if irradiance is not None:
        joined = joined.merge(cut_irradiance(irradiance, joined["time"].values), compat="override")
    return joined.assign_attrs(_attrs(lines, sum(lost)))


def _attrs(lines: list[xr.Dataset], lost: int) -> dict[str, Any]:
    return {
        "source": ", ".join(str(line.attrs["source"]) for line in lines),
        "dropped_frames": sum(int(line.attrs["dropped_frames"]) for line in lines) + lost,
    }
