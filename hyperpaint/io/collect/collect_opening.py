"""A whole collect as one tree: every flight line that a ``collect.toml`` names, opened lazily."""

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
    members: Mapping[str, tuple[str, ...]]  # Names of the cubes of every line, by its group

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
    """Open everything a ``collect.toml`` names, see `hyperpaint.open_collect`, which brings ``calibrate``."""
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
    """Open everything a ``collect.toml`` names, without reading a cube, together with its settings.

    ``source``: the file, or its settings where it has been read and checked before; ``calibrate``: turns the
    path of a lab sweep into a calibration; ``mount``: adds the table ``[geometry]`` to a line; ``level``:
    converts the record of a light sensor on the aircraft, with its attitude, to level ground; the others: see
    `hyperpaint.open_collect`.

    Raises `CollectError`: The file, or a file it names, cannot be used; all problems of all files are listed.
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
        own, timing = Findings(str(entry.name)), entry.timing
        if isinstance(timing, Timing) and isinstance(timing.nav, Path):
            nav = navigation.get(timing.nav)
            timing = Unavailable.REPORTED if nav is None else replace(timing, nav=nav)
        parts: Any = {"calibration": calibration, "irradiance": irradiance, "chunks": chunks}
        line = assemble(replace(entry, timing=timing, **parts), own)
        if mount is not None and line.sizes:
            with own.step():
                line = mount(line, collect.geometry)
        lines[str(entry.name)] = line
        findings.errors += own.errors
    references = dict(_references(collect.references, findings))
    # what several lines share is reported once
    errors = {str(error): error for error in findings.errors}
    problems.extend(
        error.problem if isinstance(error, PaintError) else Problem(text, code="input-unreadable")
        for text, error in errors.items()
    )
    problems.raise_if_any()
    groups: dict[str, xr.Dataset] = {"/": xr.Dataset(attrs={"name": collect.name, "source": path.name})}
    joined = dict(_joined(collect, lines, irradiance))
    groups |= {f"/flightlines/{name}": flown.line for name, flown in joined.items()}
    if isinstance(irradiance, xr.Dataset):
        groups["/irradiance"] = irradiance
    if isinstance(calibration, xr.Dataset):
        groups["/calibration"] = calibration
    groups |= {f"/references/{name}": dataset for name, dataset in references.items()}
    members = {f"flightlines/{name}": flown.members for name, flown in joined.items()}
    return OpenedCollect(xr.DataTree.from_dict(groups), collect, members)


def _joined(
    collect: Collect, lines: Mapping[str, xr.Dataset], irradiance: Any
) -> Iterator[tuple[str, JoinedLine]]:
    # The lines by their names; cubes of one table become one line where the recording goes on.
    record = irradiance if isinstance(irradiance, xr.Dataset) else None
    flights = {names[0]: (names, wanted) for names, wanted in collect.flights if names}
    inside = {name for names, _ in flights.values() for name in names[1:]}
    for name, line in lines.items():
        if name not in flights and name not in inside:
            yield name, JoinedLine(line, (name,))
        if name in flights:
            names, wanted = flights[name]
            parts = list(join_lines({member: lines[member] for member in names}, record))
            for part in parts:
                if part.interruption:
                    message = f"{part.members[0]} is a separate flight line: {part.interruption}"
                    warnings.warn(PaintWarning(message, code="recording-interrupted"), stacklevel=4)
                name_of_part = wanted if wanted and len(parts) == 1 else part.members[0]
                yield name_of_part, replace(part, line=part.line.assign_attrs(name=name_of_part))


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
            mend="name nav files that hold a date, or level the record by hyperpaint.light.level_irradiance",
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
    # Open the files of each field spectrometer: one instrument has one set of wavelengths.
    for entry in entries:
        if not entry.files:  # reported before
            continue
        with findings.step():
            opened = open_spectra(entry.files)
            if len(opened) > 1:
                raise CollectError(
                    f"[[references]] {entry.instrument!r}: files of {len(opened)} kinds of instruments",
                    mend="give each its own [[references]]",
                    code="instrument-mixed",
                )
            label = {} if entry.group == entry.instrument else {"instrument_name": entry.instrument}
            yield entry.group, opened[0].assign_attrs(label)


# ----------------------------------------------------------------------------------------------------------
# Cubes of one flight as one line, where the recording continues from one to the next.


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
        yield JoinedLine(_concatenated([lines[name] for name in members], irradiance), tuple(members), reason)


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


def _concatenated(lines: list[xr.Dataset], irradiance: xr.Dataset | None) -> xr.Dataset:
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
