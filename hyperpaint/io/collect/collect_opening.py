"""A collect as one tree: all flight lines of a ``collect.toml``, opened lazily."""

from __future__ import annotations

import itertools
import os
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base.attitude_conventions import Convention
from hyperpaint.base.errors import (
    CollectError,
    Findings,
    PaintError,
    PaintWarning,
    Problem,
    Problems,
    Unavailable,
)
from hyperpaint.base.schema import ALONG_TRACK, IRRADIANCE_TIME, with_numbers
from hyperpaint.io.envi.envi_cubes import find_pair
from hyperpaint.io.flightline.calibration_store import open_calibration
from hyperpaint.io.flightline.flightline_opening import BLANK_COUNT, assemble
from hyperpaint.io.flightline.timing import Timing
from hyperpaint.io.navigation.navigation_records import Navigation, read_imu_gps
from hyperpaint.io.spectrometers.irradiance import cut_irradiance, open_irradiance
from hyperpaint.io.spectrometers.reference_files import open_spectra

from .collect_toml import Collect, ReferenceEntry, parse_collect


@dataclass(frozen=True)
class OpenedCollect:
    """An opened collect, with the settings of its ``collect.toml``."""

    tree: xr.DataTree
    settings: Collect
    members: Mapping[str, tuple[str, ...]]  #: Names of the cubes of every line, by the line's group.

    @property
    def cubes(self) -> dict[str, tuple[Path, ...]]:
        """Data files of every flight line, by the line's group (``flightlines/<id>``)."""
        files = {str(entry.name): find_pair(entry.path)[1] for entry in self.settings.flightlines}
        return {group: tuple(files[name] for name in names) for group, names in self.members.items()}


def open_collect(
    path: str | os.PathLike[str],
    *,
    need_irradiance: bool = True,
    chunks: Any = "auto",
    calibrate: Callable[[Path], xr.Dataset] | None = None,
) -> xr.DataTree:
    """Open all files of a ``collect.toml``; see `hyperpaint.open_collect`, which passes ``calibrate``."""
    options: Any = {"need_irradiance": need_irradiance, "chunks": chunks, "calibrate": calibrate}
    return open_with_settings(path, **options).tree


def open_with_settings(
    source: str | os.PathLike[str] | Collect,
    *,
    need_irradiance: bool = True,
    chunks: Any = "auto",
    calibrate: Callable[[Path], xr.Dataset] | None = None,
    mount: Callable[[xr.Dataset, Mapping[str, Any]], xr.Dataset] | None = None,
    level: Callable[[xr.Dataset, xr.Dataset], xr.Dataset] | None = None,
) -> OpenedCollect:
    """Open all files of a ``collect.toml``, without reading a cube, together with its settings.

    ``source``: the file, or its settings after `read_collect`; ``calibrate``: computes a calibration from the
    path of a lab sweep; ``mount``: adds the table ``[geometry]`` to a line; ``level``: converts the record of
    a light sensor on the aircraft, with its attitude, to level ground; for the other arguments see
    `hyperpaint.open_collect`.

    Raises `CollectError`: The ``collect.toml``, or one of its files, cannot be used; all problems of all
    files are listed.
    """
    path = source.path if isinstance(source, Collect) else Path(source)
    problems = Problems(f"{path} cannot be processed", CollectError)
    if isinstance(source, Collect):
        collect = source
    else:
        collect = parse_collect(path, problems, need_irradiance=need_irradiance)
    findings = Findings(str(path))
    calibration: xr.Dataset | Unavailable | None = None
    if collect.calibration is not None or collect.sweep is not None:
        calibration = Unavailable.REPORTED
    if isinstance(collect.calibration, Path):
        with findings.step():
            calibration = open_calibration(collect.calibration)
    if collect.sweep is not None:
        calibration = Unavailable.REPORTED
        with findings.step():
            if calibrate is None:
                raise CollectError(
                    f"{collect.sweep} is a lab sweep",
                    mend="open it by hyperpaint.open_collect, or pass calibrate=",
                    code="calibrate-missing",
                )
            calibration = open_calibration(calibrate(collect.sweep))
    irradiance: xr.Dataset | Unavailable | None = Unavailable.REPORTED
    with findings.step():
        irradiance = None
        if collect.irradiance is not None and collect.irradiance.files:
            files: Any = list(collect.irradiance.files)
            irradiance = open_irradiance(files if len(files) > 1 else files[0], **collect.irradiance.options)
    navigation: dict[Path, Navigation] = {}
    for file in collect.nav:
        with findings.step():
            navigation[file] = read_imu_gps(file, collect.clock.correction)
    if (
        collect.irradiance is not None
        and collect.irradiance.on_aircraft
        and isinstance(irradiance, xr.Dataset)
    ):
        with findings.step():
            irradiance = _levelled(irradiance, tuple(navigation.values()), collect, level)
    lines: dict[str, xr.Dataset] = {}
    for entry in collect.flightlines:
        line_findings, timing = Findings(str(entry.name)), entry.timing
        if isinstance(timing, Timing) and isinstance(timing.nav, Path):
            nav = navigation.get(timing.nav)
            timing = Unavailable.REPORTED if nav is None else replace(timing, nav=nav)
        shared: Any = {"calibration": calibration, "irradiance": irradiance, "chunks": chunks}
        line = assemble(replace(entry, timing=timing, **shared), line_findings)
        if mount is not None and line.sizes:
            with line_findings.step():
                line = mount(line, collect.geometry)
        lines[str(entry.name)] = line
        findings.errors += line_findings.errors
    references = dict(_references(collect.references, findings))
    # equal errors of several lines are reported once
    errors = {str(error): error for error in findings.errors}
    problems.extend(
        error.problem if isinstance(error, PaintError) else Problem(text, code="input-unreadable")
        for text, error in errors.items()
    )
    problems.raise_if_any()
    groups: dict[str, xr.Dataset] = {"/": xr.Dataset(attrs={"name": collect.name, "source": path.name})}
    joined_lines = dict(_joined_lines(collect, lines, irradiance))
    groups |= {f"/flightlines/{name}": joined.line for name, joined in joined_lines.items()}
    if isinstance(irradiance, xr.Dataset):
        groups["/irradiance"] = irradiance
    if isinstance(calibration, xr.Dataset):
        groups["/calibration"] = calibration
    groups |= {f"/references/{name}": dataset for name, dataset in references.items()}
    members = {f"flightlines/{name}": joined.members for name, joined in joined_lines.items()}
    return OpenedCollect(xr.DataTree.from_dict(groups), collect, members)


def _joined_lines(
    collect: Collect, lines: Mapping[str, xr.Dataset], irradiance: Any
) -> Iterator[tuple[str, JoinedLine]]:
    # Yield the lines with their names; cubes of one table become one line where the recording continues
    record = irradiance if isinstance(irradiance, xr.Dataset) else None
    # cubes of a table, and its id, by the first cube
    flights = {cubes[0]: (cubes, line_id) for cubes, line_id in collect.flights if cubes}
    later_cubes = {name for cubes, _ in flights.values() for name in cubes[1:]}
    for name, line in lines.items():
        if name not in flights and name not in later_cubes:
            yield name, JoinedLine(line, (name,))
        if name in flights:
            cubes, line_id = flights[name]
            joined_lines = list(join_lines({cube: lines[cube] for cube in cubes}, record))
            for joined in joined_lines:
                if joined.interruption:
                    message = f"{joined.members[0]} is a separate flight line: {joined.interruption}"
                    warnings.warn(PaintWarning(message, code="recording-interrupted"), stacklevel=4)
                joined_name = line_id if line_id and len(joined_lines) == 1 else joined.members[0]
                yield joined_name, replace(joined, line=joined.line.assign_attrs(name=joined_name))


def _levelled(
    record: xr.Dataset,
    navigation: tuple[Navigation, ...],
    collect: Collect,
    level: Callable[[xr.Dataset, xr.Dataset], xr.Dataset] | None,
) -> xr.Dataset:
    # The record of a light sensor on the aircraft, converted to level ground.
    dated = [poses for poses in navigation if poses.utc is not None]
    if level is None or not dated:
        raise CollectError(
            '[irradiance] mount = "aircraft" without the attitude of the aircraft in UTC',
            mend="state nav files with a date, or level the record by hyperpaint.light.level_irradiance",
            code="attitude-missing",
        )
    columns = {
        name: ("time", np.concatenate([poses.values[name] for poses in dated]))
        for name in ("roll", "pitch", "heading", "latitude", "longitude")
    }
    time = np.concatenate([np.asarray(poses.utc) for poses in dated]).astype("datetime64[ns]")
    declared = dict(collect.flightlines[0].convention) if collect.flightlines else {}
    return level(record, xr.Dataset(columns, {"time": time}, Convention(**declared).to_attrs()))


def _references(entries: tuple[ReferenceEntry, ...], findings: Findings) -> Iterator[tuple[str, xr.Dataset]]:
    # Open the files of each field spectrometer, which must have one set of wavelengths
    for entry in entries:
        if not entry.files:  # their fault is reported already
            continue
        with findings.step():
            opened = open_spectra(entry.files)
            if len(opened) > 1:
                raise CollectError(
                    f"[[references]] {entry.instrument!r}: files of {len(opened)} kinds of instruments",
                    mend="write one [[references]] for each instrument",
                    code="instrument-mixed",
                )
            label = {} if entry.group == entry.instrument else {"instrument_name": entry.instrument}
            yield entry.group, opened[0].assign_attrs(label)


# --- cubes of one flight as one line, where the recording continues from cube to cube ----------------------


#: Maximum time from the last line of a cube to the first line of the next cube of a recording, in line
#: periods: one lost frame is allowed, as in the navigation.
MAX_STEP_PERIODS = 2.5


@dataclass(frozen=True)
class JoinedLine:
    """A line of one or more cubes."""

    line: xr.Dataset
    members: tuple[str, ...]  #: Ids of its cubes; the first is the name of the line.
    interruption: str = ""  #: Reason why it does not continue the previous line.


def join_lines(lines: Mapping[str, xr.Dataset], irradiance: xr.Dataset | None) -> Iterator[JoinedLine]:
    """Yield the lines that cubes of one flight form, in their order.

    Parameters
    ----------
    lines
        Line of each cube by its id, in the order of recording.
    irradiance
        The complete irradiance record, which is cut to every line; or None.
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
        yield JoinedLine(_concatenated([lines[name] for name in members], irradiance), tuple(members), reason)


def _interruption(lines: Mapping[str, xr.Dataset], previous_name: str, name: str) -> str:
    # Reason why a cube does not continue the recording of the previous cube; empty where it does
    previous, line = lines[previous_name], lines[name]
    times = _step_and_period(previous, line)
    if times is None:
        return f"the times of {previous_name} or {name} are unknown"
    step, period = times
    if not np.timedelta64(0, "ns") < step <= MAX_STEP_PERIODS * period:
        step_s, period_s = step / np.timedelta64(1, "s"), period / np.timedelta64(1, "s")
        return (
            f"{name} begins {step_s:.3g} s after the end of {previous_name}, at a line period of "
            f"{period_s:.3g} s"
        )
    if set(previous.variables) != set(line.variables):
        names = sorted(map(str, set(previous.variables) ^ set(line.variables)))
        return f"{name} and {previous_name} differ in {names}"
    different = [
        str(key)
        for key, variable in previous.variables.items()
        if not {ALONG_TRACK, IRRADIANCE_TIME} & set(variable.dims)
        and not variable.equals(line.variables[key])
    ]
    return f"{name} and {previous_name} differ in {', '.join(different)}" if different else ""


def _step_and_period(previous: xr.Dataset, line: xr.Dataset) -> tuple[np.timedelta64, np.timedelta64] | None:
    # Time from the last line of a cube to the first line of the next, and the line period
    previous_times, times = (cube["time"].values.astype("datetime64[ns]") for cube in (previous, line))
    # lines of lost frames are blank, without a time
    previous_timed, timed = (np.flatnonzero(~np.isnat(values)) for values in (previous_times, times))
    if previous_timed.size < 2 or not timed.size:
        return None
    periods = np.diff(previous_times[previous_timed]).astype(np.int64) / np.diff(previous_timed)
    period = np.median(periods).astype("timedelta64[ns]")
    blank = int(previous_times.size - 1 - previous_timed[-1] + timed[0])
    return times[timed[0]] - previous_times[previous_timed[-1]] - blank * period, period


def _lost_frames(previous: xr.Dataset, line: xr.Dataset) -> int:
    # Number of frames lost between two cubes: by frame number if it continues, else by time
    by_number = int(line["frame"].values[0]) - int(previous["frame"].values[-1]) - 1
    if 0 <= by_number < MAX_STEP_PERIODS:
        return by_number
    times = _step_and_period(previous, line)
    return 0 if times is None else max(0, round(float(times[0] / times[1])) - 1)


def _blank_lines(previous: xr.Dataset, count: int) -> xr.Dataset:
    # Blank lines for frames lost after a cube, without time and position; frame numbers continue
    blank = previous.isel({ALONG_TRACK: [-1] * count})
    for name, variable in previous.variables.items():
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


def _concatenated(lines: list[xr.Dataset], irradiance: xr.Dataset | None) -> xr.Dataset:
    if len(lines) == 1:
        return lines[0]
    lost = [_lost_frames(*pair) for pair in itertools.pairwise(lines)]
    # without irradiance and line numbers, which are added to the joined line
    pieces = [line.drop_dims(IRRADIANCE_TIME, errors="ignore").drop_vars(ALONG_TRACK) for line in lines]
    for number in reversed(np.flatnonzero(lost)):
        pieces.insert(number + 1, _blank_lines(pieces[number], lost[number]))
    joined: xr.Dataset = xr.concat(
        pieces,
        ALONG_TRACK,
        data_vars="minimal",
        coords="minimal",
        compat="override",
        join="override",
        combine_attrs="override",
    )
    joined = with_numbers(joined)
    # chunks as of a single cube
    for name, variable in pieces[0].variables.items():
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
