"""What a ``collect.toml`` says: read, checked, and its files found, before anything is opened."""

from __future__ import annotations

import itertools
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from hyperpaint.base.constants import ALIGNMENTS, Alignment
from hyperpaint.base.errors import CollectError, FormatError, Problems, TimeError, Unavailable
from hyperpaint.io.files import toml_tables as check
from hyperpaint.io.files.reading import is_pattern
from hyperpaint.io.files.toml_tables import TableReader, load_tables, shown
from hyperpaint.io.flightline.flightline_opening import FlightlineInputs
from hyperpaint.io.flightline.headwall import cube_number, frame_index_beside, navigation_beside
from hyperpaint.io.flightline.timing import Timing, utc_of

_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")
#: Names that mean something to Zarr.
_RESERVED = {"zarr.json", "c"}
_SIDE_FILES = ("frame_index", "nav", "gps_time")
_CLOCK = ("stamp", "clock_offset_s", "time_scale", "gps_leap_seconds")
_STAMP = check.one_of("start", "mid", "end")
_SCHEMA: Mapping[str, Mapping[str, check.Check]] = {
    "collect": {"name": check.text, "description": check.text},
    "camera": {
        "bit_depth": check.whole(1, 16),
        "saturation_count": check.positive,
        "exposure_time_ms": check.positive,
        "frame_period_ms": check.positive,
        "stamp": _STAMP,
        "clock_offset_s": check.number,
        "time_scale": check.one_of("utc", "gps"),
        "gps_leap_seconds": check.whole(-100, 100),
        "fwhm_nm": check.positive,
        "radiance_units": check.text,
        "quantity": check.one_of("counts", "radiance"),
    },
    "navigation": {
        "roll_positive": check.one_of("right_wing_down", "right_wing_up"),
        "pitch_positive": check.one_of("nose_up", "nose_down"),
        "heading_positive": check.one_of("clockwise", "counterclockwise"),
        "heading_reference": check.one_of("true", "grid", "magnetic"),
        "euler_order": check.one_of("ZYX", "ZXY", "XYZ"),
        "height_reference": check.one_of("ellipsoid", "geoid"),
        "column_order": check.one_of("left_to_right", "right_to_left"),
        "declination": check.number,
        "geoid_undulation": check.number,
        "grid_crs": check.text,
    },
    "geometry": {
        "ground": check.number,
        "dem": check.text,
        "dem_heights": check.one_of("ellipsoid", "geoid"),
        "geoid": check.number,
        "fov_deg": check.positive,
        "look_angle": check.text,
        "boresight_deg": check.three_numbers,
        "lever_arm_m": check.three_numbers,
    },
    "calibration": {"path": check.text, "sweep": check.text},
    "dark": {"cubes": check.texts},
    "irradiance": {
        "files": check.texts,
        "quantity": check.text,
        "utc_offset_h": check.number,
        "clock_offset_s": check.number,
        "stamp": _STAMP,
        "fwhm_nm": check.number_or_pairs,
        "max_gap_s": check.positive,
        "clock_uncertainty_s": check.not_negative,
        "units": check.text,
        "averaging_s": check.number,
        "calibration": check.table,
        "mount": check.one_of("ground", "aircraft"),
    },
    "alignment": {"apply": check.one_of(*ALIGNMENTS)},
    "flightlines": {
        "id": check.text,
        "cube": check.text,
        "frame_index": check.text,
        "nav": check.text,
        "gps_time": check.text,
        "date": check.time,
        "start_time": check.time,
        "exposure_time_ms": check.positive,
        "frame_period_ms": check.positive,
        "keep_whole_lines": check.flag,
    },
    "references": {"instrument": check.text, "files": check.texts},
    "panels": {
        "line": check.text,
        "along_track": check.first_and_stop,
        "cross_track": check.first_and_stop,
        "reflectance": check.reflectance,
        "certificate": check.text,
        "uncertainty": check.fraction,
        "tilt": check.two_numbers,
    },
}
"""Check of every key of every table."""

_LISTS = ("flightlines", "references", "panels")
"""Tables that may be there several times."""


@dataclass(frozen=True)
class IrradianceEntry:
    """``[irradiance]``: files in a fixed order, and arguments of `open_irradiance`."""

    files: tuple[Path, ...]
    options: Mapping[str, Any] = field(default_factory=dict)
    on_aircraft: bool = False  # Whether it leans as the camera does


@dataclass(frozen=True)
class ReferenceEntry:
    """One ``[[references]]``: a field spectrometer's files."""

    instrument: str
    files: tuple[Path, ...]

    @property
    def group(self) -> str:
        """Name of the group that they go to: the instrument's, blanks as underscores.

        Examples
        --------
        >>> ReferenceEntry("SVC HR-1024i", ()).group
        'SVC_HR-1024i'
        """
        return "_".join(self.instrument.split())


@dataclass(frozen=True)
class PanelEntry:
    """One ``[[panels]]``: where a panel of known reflectance lies."""

    line: str  # Its flight line
    along_track: tuple[int, int]
    cross_track: tuple[int, int]
    reflectance: float | Path  # Or the file of its certificate
    uncertainty: float
    tilt: tuple[float, float] | None


@dataclass(frozen=True)
class Collect:
    """What a ``collect.toml`` says, its paths absolute and found."""

    path: Path  # The file
    name: str  # Of the collect
    flightlines: tuple[FlightlineInputs, ...]  # Their calibration and irradiance are still to be opened
    calibration: Path | Unavailable | None  # None where not needed and not given
    irradiance: IrradianceEntry | None  # As well
    clock: Timing  # What the camera's table says of the clocks
    nav: tuple[Path, ...]  # Navigation files, each once; the lines of one flight share them
    references: tuple[ReferenceEntry, ...]
    panels: tuple[PanelEntry, ...]  # Of known reflectance, in the scene
    sweep: Path | None  # Lab sweep to calibrate in place of a ``calibration``
    # Ground [m above the ellipsoid] or dem (a path), and how the camera sits in the platform
    geometry: Mapping[str, Any]
    alignment: Alignment  # When what separates camera and record is corrected
    # Names of cubes of one table, a pattern or a folder, in their order, with the id that the table gives
    flights: tuple[tuple[tuple[str, ...], str | None], ...]


# --- tables into checked values ----------------------------------------------------------------------------


class _Reader(TableReader):
    """Reads a collect's tables, of which one may be a word."""

    outside = True  # files of camera and spectrometer are often copied to different folders

    def __init__(self, path: Path, raw: Mapping[str, Any], problems: Problems) -> None:
        self.dark = self._dark_word(raw)
        super().__init__(path, raw, _SCHEMA, _LISTS, problems)
        self.file_name = path.name
        self.collect_name = self.one("collect").get("name", path.resolve().parent.name)
        self.clock = Timing(**{key: value for key, value in self.one("camera").items() if key in _CLOCK})
        self.nav: dict[Path, None] = {}
        self.flights: list[tuple[tuple[str, ...], str | None]] = []

    def _dark_word(self, raw: Mapping[str, Any]) -> str | None:
        word = raw.get("dark")
        if isinstance(word, dict):
            word = word.get("cubes")
        return word if word in ("none", "calibration") else None

    def section(self, name: str, value: Any, extra: str = "") -> list[dict[str, Any]]:
        """Return the tables of this name with what is valid in them; for the dark there may be a word."""
        if name == "dark":
            if value in ("none", "calibration"):
                return []
            extra = ', or dark = "none"'
        return super().section(name, value, extra)


# --- tables into dataclasses -------------------------------------------------------------------------------


def _seconds(key: str, *tables: Mapping[str, Any]) -> float | None:
    """Return seconds from the milliseconds of the first table that has them."""
    return next((float(f"{table[key] / 1000:.12g}") for table in tables if key in table), None)


def _camera(reader: _Reader) -> dict[str, Any]:
    """Return what holds for all flight lines."""
    table, dark = reader.one("camera"), _dark(reader)
    same = ("bit_depth", "saturation_count", "fwhm_nm", "radiance_units", "quantity")
    convention = {key: value for key, value in reader.one("navigation").items() if key != "?"}
    return {key: table[key] for key in same if key in table} | {"dark": dark, "convention": convention}


def _calibration(reader: _Reader) -> tuple[Path | Unavailable | None, Path | None]:
    """Return the paths of a calibration and of a lab sweep, of which there is one at most."""
    table = reader.one("calibration")
    if {"path", "sweep"} <= table["?"]:
        reader.problems.add("[calibration] has both path and sweep; keep the one that is to be used")
    path = reader.path("[calibration]", "path", table.get("path"))
    sweep = reader.path("[calibration]", "sweep", table.get("sweep"))
    if reader.tables["calibration"] and not table["?"] & {"path", "sweep"}:
        reader.problems.add("[calibration] path is missing (or sweep, a lab sweep)")
    if path is None and sweep is None and table["?"]:
        return Unavailable.REPORTED, None
    return path, sweep


def _dark(reader: _Reader) -> tuple[Path, ...] | str | Unavailable | None:
    if reader.dark is not None:
        return reader.dark
    table = reader.one("dark")
    cubes = reader.files("[dark]", "cubes", table["cubes"]) if "cubes" in table else ()
    return cubes or (Unavailable.REPORTED if table["?"] else None)


def _irradiance(reader: _Reader) -> IrradianceEntry | None:
    table = reader.one("irradiance")
    if "files" not in table:
        if table["?"] and "files" not in table["?"]:
            reader.problems.add("[irradiance] files is missing: the spectrometer's files")
        return None
    options = {
        key: value for key, value in table.items() if key not in ("?", "files", "calibration", "mount")
    }
    if "calibration" in table:
        certificates = {
            str(key): reader.path("[irradiance.calibration]", str(key), str(value))
            for key, value in table["calibration"].items()
        }
        options["calibration"] = {key: path for key, path in certificates.items() if path is not None}
    files = reader.files("[irradiance]", "files", table["files"])
    return IrradianceEntry(files, options, table.get("mount") == "aircraft")


def _cubes(
    reader: _Reader, number: int, table: Mapping[str, Any], shared: Mapping[str, Any]
) -> Iterator[FlightlineInputs | None]:
    """Yield the cubes of one ``[[flightlines]]``: one, or those of a pattern or a folder in their order."""
    place = f"[[flightlines]] {number + 1}"
    if "cube" not in table:
        if "cube" not in table["?"]:
            reader.problems.add(f"{place} cube is missing")
        return
    text = table["cube"]
    is_folder = os.path.isdir(reader.folder / text)  # of names too long for a path, too, false
    if not (is_folder or is_pattern(text)):
        yield _flightline(reader, place, table, reader.path(place, "cube", text), shared)
        return
    files = reader.files(place, "cube", f"{text.rstrip('/')}/*.hdr" if is_folder else text)
    headers = [path for path in files if path.suffix.lower() == ".hdr"] or list(files)
    headers.sort(key=lambda path: (path.parent, cube_number(path) or 0, path.name))
    if "id" in table and not _is_id(reader, place, table["id"]):
        return
    # with an id, cubes of other folders may have the same names
    prefix = f"{table['id']}_" if "id" in table else ""
    names = tuple(prefix + path.name.split(".")[0] for path in headers)
    reader.flights.append((names, table.get("id")))
    for name, cube in zip(names, headers, strict=True):
        yield _flightline(reader, place, {**table, "id": name}, cube, shared)


def _is_id(reader: _Reader, place: str, name: str) -> bool:
    """Tell whether a group of the store can have this name; what is wrong with it is noted."""
    if _ID.fullmatch(name) and name not in _RESERVED:
        return True
    expected = "letters, digits, '.', '_' and '-': it names a group of the store"
    reader.problems.add(f"{place} id = {shown(name)}, expected {expected}")
    return False


def _flightline(
    reader: _Reader, place: str, table: Mapping[str, Any], cube: Path | None, shared: Mapping[str, Any]
) -> FlightlineInputs | None:
    camera = reader.one("camera")
    name = table.get("id", Path(table["cube"]).name.split(".")[0])
    _is_id(reader, place, name)
    before = len(reader.problems)
    table = _with_files_beside(table, cube)
    paths: dict[str, Any] = {key: reader.path(place, key, table.get(key)) for key in _SIDE_FILES}
    if paths["nav"] is not None:
        reader.nav[paths["nav"]] = None
    start = table.get("start_time")
    if start is not None:
        try:
            start = utc_of(start, "start_time")
        except TimeError as error:
            reader.problems.add(f"{place} {error}")
    _check_timing(reader, place, table)
    timing: Timing | Unavailable = Unavailable.REPORTED
    if len(reader.problems) == before:
        timing = replace(
            reader.clock,
            **paths,
            date=str(table["date"]) if "date" in table else None,
            start_time=start,
            frame_period=_seconds("frame_period_ms", table, camera),
        )
    if cube is None:
        return None
    exposure = _seconds("exposure_time_ms", table, camera)
    source = {} if exposure is None else {"exposure_source": reader.file_name}
    return FlightlineInputs(
        **shared,
        cube=cube,
        timing=timing,
        exposure_time=exposure,
        name=name,
        keep_whole_lines=table.get("keep_whole_lines", False),
        attrs={"collect": reader.collect_name, **source},
    )


def _with_files_beside(table: Mapping[str, Any], cube: Path | None) -> Mapping[str, Any]:
    """Return the table with the frame index and the navigation beside the cube, where none is named."""
    given = table["?"]
    if cube is None or not os.path.isdir(cube.parent) or given & {"frame_index", "start_time"}:
        return table
    beside = {"frame_index": frame_index_beside(cube)}
    if not given & {"nav", "gps_time", "date"}:
        beside["nav"] = navigation_beside(cube)
    paths = {key: str(path.absolute()) for key, path in beside.items() if path is not None}
    return {**table, **paths, "?": given | set(paths)}


def _check_timing(reader: _Reader, place: str, table: Mapping[str, Any]) -> None:
    given = table["?"]
    period = "frame_period_ms" in given or "frame_period_ms" in reader.one("camera")["?"]
    by_index = "frame_index" in given and given & {"nav", "start_time", "gps_time", "date"}
    if not by_index and not ("start_time" in given and period):
        stated = sorted(given & {"frame_index", "nav", "start_time"}) + (
            ["frame_period_ms"] if period else []
        )
        reader.problems.add(
            f"{place} no line times: found {', '.join(stated) or 'nothing'},"
            " expected frame_index and nav, or start_time and frame_period_ms"
        )
    if "date" in given and reader.clock.clock_offset_s is None:
        reader.problems.add(
            f"{place} date needs [camera] clock_offset_s: UTC = computer clock + clock_offset_s"
        )


def _flightlines(reader: _Reader) -> tuple[FlightlineInputs, ...]:
    tables, shared = reader.tables["flightlines"], _camera(reader)
    if not tables:
        reader.problems.add("no [[flightlines]]: at least one with a cube is needed")
    candidates = (_cubes(reader, number, table, shared) for number, table in enumerate(tables))
    entries = [entry for entry in itertools.chain.from_iterable(candidates) if entry is not None]
    # as on file systems that ignore case; cubes of a pattern may become one line, of the id of its table
    names = [str(entry.name).lower() for entry in entries]
    names += [wanted.lower() for members, wanted in reader.flights if members and wanted]
    for name in sorted({name for name in names if names.count(name) > 1}):
        reader.problems.add(
            f"[[flightlines]] id {name!r} is given to {names.count(name)} lines; each needs its own",
            mend="give each table an id: cubes of a pattern are then called <id>_<name of the cube>",
        )
    return tuple(entries)


def _geometry(reader: _Reader) -> dict[str, Any]:
    table = {key: value for key, value in reader.one("geometry").items() if key != "?"}
    for key in ("dem", "look_angle"):
        if key in table:
            table[key] = reader.path("[geometry]", key, table[key])
    for one, other in (("ground", "dem"), ("fov_deg", "look_angle")):
        if one in table and other in table:
            reader.problems.add(f"[geometry] has both {one} and {other}; keep the one that is to be used")
    return {key: tuple(value) if isinstance(value, list) else value for key, value in table.items()}


def _references(reader: _Reader) -> tuple[ReferenceEntry, ...]:
    entries: list[ReferenceEntry] = []
    for number, table in enumerate(reader.tables["references"]):
        place = f"[[references]] {number + 1}"
        absent = [key for key in ("instrument", "files") if key not in table["?"]]
        if absent:
            reader.problems.add(f"{place} {' and '.join(absent)} missing")
        if "instrument" not in table or "files" not in table:
            continue
        name = table["instrument"]
        group = ReferenceEntry(name, ()).group
        if not _ID.fullmatch(group) or group in _RESERVED:
            expected = "letters, digits, blanks, '.', '_' and '-': it names a group of the store"
            reader.problems.add(f"{place} instrument = {shown(name)}, expected {expected}")
        elif group.lower() in (entry.group.lower() for entry in entries):
            reader.problems.add(f"{place} instrument {name!r} is there already; list all its files in one")
        else:
            entries.append(ReferenceEntry(name, reader.files(place, "files", table["files"])))
    return tuple(entries)


def _panels(reader: _Reader) -> Iterator[PanelEntry]:
    needed = ("line", "along_track", "cross_track")
    for number, table in enumerate(reader.tables["panels"]):
        place = f"[[panels]] {number + 1}"
        absent = [key for key in needed if key not in table["?"]]
        if absent:
            given = ", ".join(key for key in needed if key in table["?"]) or "none of them"
            reader.problems.add(
                f"{place} {' and '.join(absent)} missing: found {given}, expected {', '.join(needed)}"
            )
        stated = sorted({"reflectance", "certificate"} & table["?"])
        if len(stated) != 1:
            reader.problems.add(
                f"{place} found {' and '.join(stated) or 'no reflectance'}, expected a reflectance, or the "
                "file of a certificate"
            )
        factor = reader.path(place, "certificate", table.get("certificate")) or table.get("reflectance")
        if factor is None or not set(needed) <= set(table):
            continue
        along, across = (tuple(table[key]) for key in needed[1:])
        tilt = tuple(table["tilt"]) if "tilt" in table else None
        yield PanelEntry(table["line"], along, across, factor, table.get("uncertainty", 0.0), tilt)


def parse_collect(
    path: Path, problems: Problems, *, need_irradiance: bool, tables: Mapping[str, Any] | None = None
) -> Collect:
    """Return what of a ``collect.toml`` is valid, so that what it names can be checked as well.

    ``path``: the file; ``problems``: takes what is wrong; ``need_irradiance``: false where only radiance is
    wanted; ``tables``: its content, where that is not as in the file. What is `Unavailable` has had its
    problem noted.

    Raises `CollectError`: The file cannot be read, or is not TOML.
    """
    try:
        raw = load_tables(path, "a collect.toml") if tables is None else tables
        reader = _Reader(path, raw, problems)
    except FormatError as error:
        raise CollectError(str(error)) from error
    irradiance = _irradiance(reader)
    if need_irradiance and "irradiance" not in reader.given:
        problems.add("no [irradiance]: reflectance needs the spectrometer's files (not needed for radiance)")
    calibration, sweep = _calibration(reader)
    return Collect(
        path=path,
        name=reader.collect_name,
        flightlines=_flightlines(reader),
        calibration=calibration,
        irradiance=irradiance,
        clock=reader.clock,
        nav=tuple(reader.nav),
        references=_references(reader),
        panels=tuple(_panels(reader)),
        sweep=sweep,
        geometry=_geometry(reader),
        alignment=reader.one("alignment").get("apply", "auto"),
        flights=tuple(reader.flights),
    )


def read_collect(path: str | os.PathLike[str], *, need_irradiance: bool = True) -> Collect:
    """Read and check a ``collect.toml``; what it names is looked for, not opened.

    ``path``: the file; paths in it are relative to its folder; ``need_irradiance``: false where only radiance
    is wanted.

    Raises `CollectError`: Not TOML (with the line), unknown keys, wrong types or values, what is missing or
    not found; all problems are listed.
    """
    path = Path(path)
    problems = Problems(f"{path} cannot be processed", CollectError)
    collect = parse_collect(path, problems, need_irradiance=need_irradiance)
    problems.raise_if_any()
    return collect
