"""A whole collect as one tree: every flight line that a ``collect.toml`` names, opened lazily."""

from __future__ import annotations

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
from hyperpaint.io.envi.envi_cubes import find_pair
from hyperpaint.io.flightline.calibration_store import open_calibration
from hyperpaint.io.flightline.flightline_opening import assemble
from hyperpaint.io.flightline.timing import Timing
from hyperpaint.io.navigation.navigation_records import Navigation, read_imu_gps
from hyperpaint.io.spectrometers.irradiance import open_irradiance
from hyperpaint.io.spectrometers.reference_files import open_spectra

from .collect_toml import Collect, ReferenceEntry, parse_collect
from .joining import JoinedLine, join_lines


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
        error.problem if isinstance(error, PaintError) else Problem(text) for text, error in errors.items()
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
