"""Collects: a ``collect.toml`` read and checked, its files located, then opened lazily as one tree."""

import itertools
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base import (
    ALIGNMENTS,
    ALONG_TRACK,
    IRRADIANCE_TIME,
    PANEL_SURFACES,
    Alignment,
    CollectError,
    Convention,
    Fact,
    Facts,
    Findings,
    FormatError,
    PaintError,
    Problem,
    Problems,
    TimeError,
    Unavailable,
    by_key,
    facts_of,
    input_path,
    is_number,
    listed,
    origin_of,
    warn_if,
    with_numbers,
)
from hyperpaint.io.envi.envi_cubes import find_pair
from hyperpaint.io.files.reading import TableReader, is_pattern, load_tables, values
from hyperpaint.io.flightline.flightline_opening import (
    BLANK_COUNT,
    FlightlineInputs,
    Timing,
    assemble,
    utc_of,
)
from hyperpaint.io.flightline.side_files import (
    cube_number,
    frame_index_beside,
    navigation_beside,
    open_calibration,
)
from hyperpaint.io.navigation.navigation_records import Navigation, read_imu_gps
from hyperpaint.io.spectrometers.irradiance import UncoveredError, cut_irradiance, open_irradiance
from hyperpaint.io.spectrometers.reference_files import open_spectra

#: Keys of a flight line's files beside its cube.
_SIDE_FILES = ("frame_index", "nav", "gps_time")
#: Keys of [camera] that describe its clock.
_CLOCK = ("stamp", "clock_offset_s", "time_scale", "gps_leap_seconds")
#: Keys of [navigation].
_CONVENTION = (
    "roll_positive", "pitch_positive", "heading_positive", "heading_reference", "euler_order",
    "height_reference", "column_order", "declination", "geoid_undulation", "grid_crs",
)  # fmt: skip


def _is_width(value: Any) -> bool:
    # Whether a value is a positive number, or a list of pairs of numbers
    if not isinstance(value, list):
        return is_number(value) and value > 0
    pairs = (isinstance(pair, list) and len(pair) == 2 and all(map(is_number, pair)) for pair in value)
    return bool(value) and all(pairs)


def _is_span(value: Any) -> bool:
    # Whether a value is a list of the first index and the index after the last
    is_int_pair = isinstance(value, list) and [type(index) for index in value] == [int, int]
    return is_int_pair and 0 <= value[0] < value[1] < 2**31


def _number(name: str, doc: str, **options: Any) -> Fact:
    return Fact(name=name, kind="number", doc=doc, **options)


def _choice(name: str, doc: str, *choices: str, **options: Any) -> Fact:
    return Fact(name=name, kind="choice", doc=doc, choices=choices, **options)


_STAMPS = ("start", "mid", "end")
_HEIGHTS = ("ellipsoid", "geoid")
_SPAN: Any = {
    "kind": "own", "accepts": _is_span,
    "phrase": "two whole numbers: the first index, and the index after the last",
    "needed": True, "example": [70, 84],
}  # fmt: skip
_SURFACE = Fact(
    name="surface",
    doc="surface of the panel or tile, for its reflectance by direction: lambertian, "
    "sintered-ptfe (such as Spectralon, white), or a file of its own factors",
    default=PANEL_SURFACES[0],
    example=PANEL_SURFACES[1],
)
_EXPOSURE: Any = {"unit": "ms", "least": 0, "above": True, "example": 5.0}

#: Facts of every key of every table.
SCHEMA: Mapping[str, Facts] = {
    "collect": by_key([
        Fact(name="name", doc="name of the collect; by default the name of its folder"),
        Fact(name="description", doc="description of the collect, a free text"),
    ]),
    "camera": by_key([
        Fact(name="bit_depth", kind="whole", doc="number of bits of the camera's analogue-digital converter",
             least=1, most=16, example=12),
        _number("saturation_count", "count at which a detector element is saturated; by default from the "
                "calibration, or 2^bit_depth - 1", unit="count", least=0, above=True),
        _number("exposure_time_ms",
                "exposure time of a line; by default from settings.txt or the header of the "
                "cube", **_EXPOSURE),
        _number("frame_period_ms", "time from the start of a line to the start of the next line; for cubes "
                "without a frame index", **_EXPOSURE),
        _choice("stamp", "instant of the exposure that the time stamp of a frame marks", *_STAMPS,
                default="end"),
        _number("clock_offset_s", "correction added to the time stamps of the navigation: UTC = stamp + "
                "clock_offset_s", unit="s"),
        _choice("time_scale", "time scale of the time stamps of the navigation", "utc", "gps", default="utc"),
        Fact(name="gps_leap_seconds", kind="whole",
             doc="GPS time minus UTC; for time_scale = \"gps\"",
             unit="s", least=-100, most=100,
             example=18),
        _number("fwhm_nm", "full width at half maximum of the bands, if no file states it", unit="nm",
                least=0, above=True),
        Fact(name="radiance_units", doc="units of a cube of radiance, if its header does not state them"),
        _choice("quantity",
                "physical quantity of the cubes, if their headers do not state it",
                "counts", "radiance"),
    ]),
    "navigation": by_key(facts_of(Convention)[name] for name in _CONVENTION),
    "geometry": by_key([
        _number("ground",
                "height of level ground above the ellipsoid; an alternative to dem",
                unit="m", example=160.0),
        Fact(name="dem", doc="raster file of ground heights; an alternative to ground", example="dsm.tif"),
        _choice("dem_heights", "surface from which the heights in the raster dem are measured", *_HEIGHTS),
        _number("geoid", "height of the geoid above the ellipsoid; for dem_heights = \"geoid\"", unit="m"),
        _number("fov_deg", "angle between the outer edges of the first and last column; an alternative to "
                "look_angle", unit="degree", least=0, above=True, example=22.3),
        Fact(name="look_angle", doc="file with the look angle of every column; an alternative to fov_deg",
             example="angles.txt"),
        Fact(name="boresight_deg", kind="numbers", length=3, unit="degree", default=[0.0, 0.0, 0.0],
             doc="mounting angles of the camera on the platform: roll, pitch and heading"),
        Fact(name="lever_arm_m", kind="numbers", length=3, unit="m", default=[0.0, 0.0, 0.0],
             doc="vector from the navigation antenna to the camera: forward, right and down"),
    ]),
    "calibration": by_key([
        Fact(name="path", doc="calibration file, written by hyperpaint calibrate; an alternative to sweep",
             example="calibration.zarr"),
        Fact(name="sweep",
             doc="file of a lab sweep, from which the calibration is computed; an alternative to path",
             example="lab/sweep.zarr"),
        Fact(name="bad_elements",
             doc="list of bad elements: a CSV table of band and column, or an ENVI file that is 0 for "
             "good ones",
             example="lab/bad.csv"),
    ]),
    "dark": by_key([
        Fact(name="cubes", kind="texts", needed=True,
             doc='files of the dark cubes; "none" for no dark, "calibration" for the dark of the calibration',
             example=["dark/raw_0.hdr"]),
    ]),
    "reference": by_key([
        Fact(name="white", kind="texts", needed=True,
             doc="cubes of a white tile in the light of the scene, in place of [calibration] and "
             "[irradiance]; several where the light changes",
             example="WHITEREF_*.hdr"),
        Fact(name="dark", kind="texts", example="dark/DARKREF_white.hdr",
             doc="dark cubes of the white; by default those of [dark], which must have its exposure"),
        _number("reflectance", "reflectance of the tile; 1.0 gives reflectance relative to the tile; an "
                "alternative to certificate", least=0, above=True, most=1.2, example=0.95),
        Fact(name="certificate",
             doc="file of the certified reflectance of the tile; an alternative to reflectance",
             example="tile.csv"),
        _number("uncertainty",
                "relative standard uncertainty of the tile's reflectance, such as 0.02 for 2 %",
                least=0, most=1, below=True, example=0.02),
        _SURFACE,
        _number("light_zenith_deg", "zenith angle of the lamps or the sun over the tile; for surface",
                unit="degree", least=0, most=90, example=45.0),
        _number("direct_share", "direct light over all light on the tile; for surface",
                least=0, most=1, default=1.0),
        _number("exposure_time_ms", "exposure time of the white; by default from settings.txt or the header "
                "of its cube", **_EXPOSURE),
    ]),
    "irradiance": by_key([
        Fact(name="files", kind="texts", needed=True,
             doc="files of the irradiance spectrometer: .asd, text exports or csv", example="asd/*.asd"),
        Fact(name="quantity", doc="physical quantity in the spectrometer files, if they do not state it",
             example="irradiance"),
        _number("utc_offset_h",
                "time zone of the logging computer: local time minus UTC; by default from the "
                "files", unit="h",
                example=-5.0),
        _number("clock_offset_s", "correction added to the time stamps of the spectrometer: UTC = stamp - "
                "utc_offset_h + clock_offset_s", unit="s",
                example=37.25),
        _choice("stamp",
                "instant of a scan of the spectrometer that its time stamp marks",
                *_STAMPS, example="end"),
        Fact(name="fwhm_nm", kind="own", accepts=_is_width, unit="nm", example=3.0,
             phrase="a positive number, or a list of pairs [wavelength, value]",
             doc="full width at half maximum of the spectrometer channels; by default the width of an ASD "
             "spectrometer"),
        _number("max_gap_s", "longest time between two spectra across which irradiance is interpolated; by "
                "default 2.5 times the median interval", unit="s", least=0, above=True),
        _number("clock_uncertainty_s",
                "largest possible error of clock_offset_s",
                unit="s", least=0, example=0.5),
        Fact(name="units", doc="units of the values in the spectrometer files, if they do not state them"),
        _number("averaging_s", "duration of a scan of the spectrometer; by default from the files", unit="s"),
        Fact(name="calibration", kind="table",
             doc="calibration files of the spectrometer, by their kind, such as \"lamp\""),
        _choice("mount",
                "place of the irradiance sensor; on the aircraft, its tilt is corrected with the navigation",
                "ground", "aircraft", default="ground"),
    ]),
    "alignment": by_key([
        _choice("apply",
                "when to correct the wavelengths of camera and irradiance record from solar lines; auto: if "
                "their difference is significant",
                *ALIGNMENTS, default="auto"),
    ]),
    "flightlines": by_key([
        Fact(name="id", doc="name of the flight line; by default the name of its cube", example="raw_0"),
        Fact(name="cube", doc="header file of the cube, a pattern of several header files, or their folder",
             needed=True, example="flight/raw_0.hdr"),
        Fact(name="frame_index",
             doc="file of the time stamps of the frames; by default in the folder of the cube",
             example="flight/frameIndex_0.txt"),
        Fact(name="nav", doc="navigation file; by default in the folder of the cube",
             example="flight/imu_gps.txt"),
        Fact(name="gps_time", doc="file of the GPS times of the frames"),
        Fact(name="date", kind="time",
             doc="date of the flight; for a frame index that states only the time of day"),
        Fact(name="start_time", kind="time", doc="UTC of the first line; for cubes without a frame index",
             example="2021-07-20T17:00:00Z"),
        _number("exposure_time_ms",
                "exposure time of this flight line; by default from [camera]",
                **_EXPOSURE),
        _number("frame_period_ms",
                "time between scan lines of this flight line; by default from [camera]",
                **_EXPOSURE),
        Fact(name="keep_whole_lines", kind="flag", default=False,
             doc="whether to open the complete lines of a truncated cube"),
    ]),
    "references": by_key([
        Fact(name="instrument", doc="name of the field spectrometer", needed=True),
        Fact(name="files", kind="texts", doc="files of the field spectrometer", needed=True,
             example="svc/*.sig"),
    ]),
    "panels": by_key([
        Fact(name="line", doc="id of the flight line that shows the panel", needed=True),
        Fact(name="along_track", doc="lines that show the panel", **_SPAN),
        Fact(name="cross_track", doc="columns that show the panel", **_SPAN),
        _number("reflectance",
                "reflectance of the panel, such as 0.5 for 50 %; an alternative to certificate",
                least=0, above=True, most=1.2, example=0.5),
        Fact(name="certificate",
             doc="file of the certified reflectance of the panel; an alternative to reflectance",
             example="panel.csv"),
        _number("uncertainty", "relative standard uncertainty of the panel reflectance, such as 0.02 for 2 %",
                least=0, most=1, below=True, default=0.0),
        Fact(name="tilt", kind="numbers", length=2, unit="degree", example=[2.0, 180.0],
             doc="tilt of the panel: angle of its normal from the vertical, and azimuth of the normal, "
             "clockwise from north; by default level"),
        _SURFACE,
        Fact(name="view", kind="numbers", length=2, unit="degree", default=[0.0, 0.0],
             doc="zenith angle of the camera, seen from the panel, and its azimuth, clockwise from north; "
             "for surface"),
    ]),
}  # fmt: skip

#: Tables that may occur several times.
_LISTS = ("flightlines", "references", "panels")


@dataclass(frozen=True)
class IrradianceEntry:
    # ``[irradiance]``: files in a fixed order, and arguments of `open_irradiance`.

    files: tuple[Path, ...]
    options: Mapping[str, Any] = field(default_factory=dict)
    on_aircraft: bool = False  #: Whether the sensor is mounted on the aircraft and leans with it.


@dataclass(frozen=True)
class WhiteEntry:
    # ``[reference]``: cubes of a white tile, and arguments of `hyperpaint.radiometry.white_reference`.
    cubes: tuple[Path, ...]
    options: Mapping[str, Any]


@dataclass(frozen=True)
class ReferenceEntry:
    # One ``[[references]]``: a field spectrometer's files.

    instrument: str
    files: tuple[Path, ...]

    @property
    def group(self) -> str:
        """Name of the group of these spectra: the instrument's name with underscores for blanks.

        Examples
        --------
        >>> ReferenceEntry("SVC HR-1024i", ()).group
        'SVC_HR-1024i'
        """
        return "_".join(self.instrument.split())


@dataclass(frozen=True)
class PanelEntry:
    # One ``[[panels]]``: position and reflectance of a panel.

    line: str  #: Id of the flight line.
    along_track: tuple[int, int]  #: First line of the panel, and the one after its last.
    cross_track: tuple[int, int]  #: First column of the panel, and the one after its last.
    reflectance: float | Path  #: Reflectance, or the file of its certificate.
    uncertainty: float
    tilt: tuple[float, float] | None
    surface: str | Path  #: One of `PANEL_SURFACES`, or the file of its factors.
    view: tuple[float, float]


@dataclass(frozen=True)
class Collect:
    # Content of a ``collect.toml``; its paths are absolute and exist.
    path: Path  #: The ``collect.toml``.
    name: str
    flightlines: tuple[FlightlineInputs, ...]  #: Inputs of every cube, without calibration and irradiance.
    calibration: Path | Unavailable | None  #: None without a table.
    irradiance: IrradianceEntry | None  #: None without a table.
    white: WhiteEntry | None  #: None without a table, or without files.
    clock: Timing  #: Clock settings of the table [camera].
    nav: tuple[Path, ...]  #: Distinct navigation files; the lines of a flight share a file.
    references: tuple[ReferenceEntry, ...]
    panels: tuple[PanelEntry, ...]
    sweep: Path | None  #: Lab sweep to calibrate in place of a ``calibration``.
    geometry: Mapping[str, Any]  #: Table [geometry]: ground or dem, and the mounting of the camera.
    alignment: Alignment  #: When differences between camera and record are corrected.
    bad_elements: Path | None  #: List of bad elements.
    #: Names of the cubes of each table with a pattern or a folder, in their order, and the table's id.
    flights: tuple[tuple[tuple[str, ...], str | None], ...]


# --- tables into checked values ----------------------------------------------------------------------------


class _Reader(TableReader):
    # Reader of a collect's tables; `dark` may be a word instead of a table
    by_ranges = ("cube", "cubes", "white", "dark")

    def __init__(self, path: Path, raw: Mapping[str, Any], problems: Problems) -> None:
        word = raw["dark"].get("cubes") if isinstance(raw.get("dark"), dict) else raw.get("dark")
        self.dark: str | None = word if word in ("none", "calibration") else None
        super().__init__(path, raw, SCHEMA, _LISTS, problems)
        self.file_name = path.name
        self.collect_name = self.one("collect").get("name", path.resolve().parent.name)
        self.clock = Timing(**{key: value for key, value in self.one("camera").items() if key in _CLOCK})
        self.nav: dict[Path, None] = {}
        self.flights: list[tuple[tuple[str, ...], str | None]] = []
        for name, facts in SCHEMA.items():
            needed = [key for key, fact in facts.items() if fact.needed]
            for number, table in enumerate(self.tables[name]):
                # an empty [dark] or [irradiance] is taken as none
                for key in needed if table["?"] or name not in ("dark", "irradiance") else ():
                    problems.add_if(
                        key not in table["?"],
                        f"{self.place(name, number)} {key} is missing",
                        mend=f"state the {facts[key].doc}",
                        code="key-missing",
                    )

    def section(self, name: str, value: Any, extra: str = "") -> list[dict[str, Any]]:
        if name == "dark":
            if value in ("none", "calibration"):
                return []
            extra = ', or dark = "none"'
        return super().section(name, value, extra)


# --- tables into dataclasses -------------------------------------------------------------------------------


def _seconds(key: str, *tables: Mapping[str, Any]) -> float | None:
    # Value of the first table that has a key in milliseconds, in seconds
    return next((float(f"{table[key] / 1000:.12g}") for table in tables if key in table), None)


def _target_reflectance(reader: _Reader, subject: str, table: Mapping[str, Any]) -> float | Path | None:
    # Reflectance of a panel or a white tile, or the file of its certificate; None where both are missing
    reader.exclude(subject, table, "reflectance", "certificate")
    reader.problems.add_if(
        not {"reflectance", "certificate"} & table["?"],
        f"{subject} reflectance is missing",
        mend="state reflectance=, or certificate= with the file of a certificate",
        code="key-missing",
    )
    return reader.path(subject, "certificate", table.get("certificate")) or table.get("reflectance")


def _surface(reader: _Reader, subject: str, table: Mapping[str, Any]) -> Any:
    # Name of the surface of a panel or a white tile, or the file of its factors
    name = table.get("surface", PANEL_SURFACES[0])
    return name if name in PANEL_SURFACES else reader.path(subject, "surface", name)


def _white(reader: _Reader) -> WhiteEntry | None:
    table = reader.one("reference")
    if not reader.tables["reference"]:
        return None
    tile = _target_reflectance(reader, "[reference]", table)
    for other in ("irradiance", "calibration"):
        reader.problems.add_if(
            other in reader.given,
            f"both [reference] and [{other}]",
            mend="delete one: a white reference replaces calibration and irradiance",
            code="option-conflict",
        )
    files = {key: reader.files("[reference]", key, table[key]) for key in ("white", "dark") if key in table}
    return WhiteEntry(
        files.get("white", ()),
        {
            "tile": tile,
            "tile_uncertainty": table.get("uncertainty"),
            "tile_surface": _surface(reader, "[reference]", table),
            "light_zenith": table.get("light_zenith_deg"),
            "direct_share": table.get("direct_share", 1.0),
            "white_dark": list(files["dark"]) if "dark" in files else None,
            "white_exposure_time": _seconds("exposure_time_ms", table),
        },
    )


def _cubes(
    reader: _Reader, number: int, table: Mapping[str, Any], shared: Mapping[str, Any]
) -> Iterator[FlightlineInputs | None]:
    # Inputs of the cubes of one ``[[flightlines]]``: one cube, or those of a pattern or a folder in order
    subject = f"[[flightlines]] {number + 1}"
    if "cube" not in table:
        return
    text = table["cube"]
    is_folder = os.path.isdir(reader.folder / text)  # False also for names too long for a path
    if not (is_folder or is_pattern(text)):
        yield _flightline(reader, subject, table, reader.path(subject, "cube", text), shared)
        return
    files = reader.files(subject, "cube", f"{text.rstrip('/')}/*.hdr" if is_folder else text)
    headers = [path for path in files if path.suffix.lower() == ".hdr"] or list(files)
    headers.sort(key=lambda path: (path.parent, cube_number(path) or 0, path.name))
    if "id" in table and not reader.is_name(subject, "id", table["id"]):
        return
    # the id distinguishes cubes with equal names in different folders
    prefix = f"{table['id']}_" if "id" in table else ""
    names = tuple(prefix + path.name.split(".")[0] for path in headers)
    reader.flights.append((names, table.get("id")))
    for name, cube in zip(names, headers, strict=True):
        yield _flightline(reader, subject, {**table, "id": name}, cube, shared)


def _flightline(
    reader: _Reader, subject: str, table: Mapping[str, Any], cube: Path | None, shared: Mapping[str, Any]
) -> FlightlineInputs | None:
    camera = reader.one("camera")
    name = table.get("id", Path(table["cube"]).name.split(".")[0])
    reader.is_name(subject, "id", name)
    problem_count = len(reader.problems)
    stated = table["?"]
    # the frame index and the navigation beside the cube, where the table states none
    if cube is not None and os.path.isdir(cube.parent) and not stated & {"frame_index", "start_time"}:
        files = {"frame_index": frame_index_beside(cube)}
        if not stated & {"nav", "gps_time", "date"}:
            files["nav"] = navigation_beside(cube)
        beside = {key: str(path.absolute()) for key, path in files.items() if path is not None}
        table, stated = {**table, **beside}, stated | set(beside)
    paths: dict[str, Any] = {key: reader.path(subject, key, table.get(key)) for key in _SIDE_FILES}
    if paths["nav"] is not None:
        reader.nav[paths["nav"]] = None
    start = table.get("start_time")
    if start is not None:
        with reader.problems.noting(TimeError, subject):
            start = utc_of(start, "start_time")
    has_period = "frame_period_ms" in stated | camera["?"]
    by_index = "frame_index" in stated and stated & {"nav", "start_time", "gps_time", "date"}
    sources_of_time = {"frame_index", "nav", "start_time"} & stated
    is_timed = bool(by_index) or ("start_time" in stated and has_period)
    # reflectance relative to a white tile needs no times
    sources = [*sorted(sources_of_time), *(["frame_period_ms"] if has_period else [])]
    reader.problems.add_if(
        not is_timed and (sources_of_time or not shared["has_white"]),
        f"{subject} no line times: found {', '.join(sources) or 'nothing'}",
        expected="frame_index and nav, or start_time and frame_period_ms",
        code="line-times-missing",
    )
    reader.problems.add_if(
        "date" in stated and reader.clock.clock_offset_s is None,
        f"{subject} date without [camera] clock_offset_s",
        mend="state clock_offset_s: UTC = computer clock + clock_offset_s",
        code="clock-offset-missing",
    )
    timing: Timing | Unavailable = Unavailable.REPORTED
    if len(reader.problems) == problem_count:
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
    return FlightlineInputs(
        **shared,
        cube=cube,
        timing=timing,
        exposure_time=exposure,
        name=name,
        keep_whole_lines=table.get("keep_whole_lines", False),
        attrs={
            "collect": reader.collect_name,
            **({} if exposure is None else {"exposure_source": reader.file_name}),
        },
    )


def _panels(reader: _Reader) -> Iterator[PanelEntry]:
    position_keys = ("line", "along_track", "cross_track")
    for number, table in enumerate(reader.tables["panels"]):
        subject = f"[[panels]] {number + 1}"
        reflectance = _target_reflectance(reader, subject, table)
        if reflectance is None or not set(position_keys) <= set(table):
            continue
        along, across = (tuple(table[key]) for key in position_keys[1:])
        yield PanelEntry(
            table["line"],
            along,
            across,
            reflectance,
            table.get("uncertainty", 0.0),
            tuple(table["tilt"]) if "tilt" in table else None,
            _surface(reader, subject, table),
            tuple(table.get("view", (0.0, 0.0))),
        )


def parse_collect(path: Path, problems: Problems, *, need_irradiance: bool) -> Collect:
    # Return the valid part of a ``collect.toml``, so that its valid files can be checked, too.
    # ``path``: the file; ``problems``: takes the faults, also those of inputs that are `Unavailable` in the
    # result; ``need_irradiance``: False if only radiance will be computed.
    # Raises `CollectError`: The file cannot be read, or is not TOML.
    try:
        reader = _Reader(path, load_tables(path, "a collect.toml"), problems)
    except FormatError as error:
        fault = error.problem
        raise CollectError(fault.found, expected=fault.expected, mend=fault.mend, code=fault.code) from error
    # The irradiance record
    table, irradiance = reader.one("irradiance"), None
    if "files" in table:
        options = {k: v for k, v in values(table).items() if k not in ("files", "calibration", "mount")}
        if "calibration" in table:
            certificates = {
                str(key): reader.path("[irradiance.calibration]", str(key), str(value))
                for key, value in table["calibration"].items()
            }
            options["calibration"] = {key: path for key, path in certificates.items() if path is not None}
        irradiance = IrradianceEntry(
            reader.files("[irradiance]", "files", table["files"]), options, table.get("mount") == "aircraft"
        )
    problems.add_if(
        need_irradiance and not {"irradiance", "reference"} & set(reader.given),
        "no [irradiance], which reflectance needs",
        mend="name the files of the spectrometer, or a white tile in [reference], or compute radiance only",
        code="irradiance-missing",
    )
    # a calibration, or the lab sweep to compute it from
    table = reader.one("calibration")
    reader.exclude("[calibration]", table, "path", "sweep")
    calibration, sweep, bad_elements = (
        reader.path("[calibration]", key, table.get(key)) for key in ("path", "sweep", "bad_elements")
    )
    problems.add_if(
        reader.tables["calibration"] and not table["?"] & {"path", "sweep"},
        "[calibration] path is missing",
        mend="state path= of a calibration, or sweep= of a lab sweep",
        code="key-missing",
    )
    is_lost = calibration is None and sweep is None and table["?"]
    # The flight lines
    tables, camera = reader.tables["flightlines"], reader.one("camera")
    # inputs common to all flight lines
    keys = ("bit_depth", "saturation_count", "fwhm_nm", "radiance_units", "quantity")
    dark: Any = reader.dark
    if dark is None:
        table = reader.one("dark")
        cubes = reader.files("[dark]", "cubes", table["cubes"]) if "cubes" in table else ()
        dark = cubes or (Unavailable.REPORTED if table["?"] else None)
    shared = {key: camera[key] for key in keys if key in camera} | {
        "dark": dark,
        "convention": values(reader.one("navigation")),
        "has_white": bool(reader.tables["reference"]),
    }
    reader.problems.add_if(
        not tables,
        "no [[flightlines]]",
        mend="state the cube of at least one flight line",
        code="flightline-missing",
    )
    candidates = (_cubes(reader, number, table, shared) for number, table in enumerate(tables))
    entries = [entry for entry in itertools.chain.from_iterable(candidates) if entry is not None]
    # in lower case, as some file systems ignore case; joined cubes of a pattern have the id of their table
    names = [
        *(str(entry.name).lower() for entry in entries),
        *(line_id.lower() for cubes, line_id in reader.flights if cubes and line_id),
    ]
    for name in sorted({name for name in names if names.count(name) > 1}):
        reader.problems.add(
            f"[[flightlines]] {names.count(name)} lines have the id {name!r}",
            mend="give each table a unique id: cubes of a pattern are then called <id>_<name of the cube>",
            code="name-duplicate",
        )
    references: list[ReferenceEntry] = []
    for number, table in enumerate(reader.tables["references"]):
        subject = f"[[references]] {number + 1}"
        if "instrument" not in table or "files" not in table:
            continue
        name = table["instrument"]
        group = ReferenceEntry(name, ()).group
        if group.lower() in (entry.group.lower() for entry in references):
            reader.problems.add(
                f"{subject} instrument {name!r} has another table, too",
                mend="list all its files in one table",
                code="name-duplicate",
            )
        elif reader.is_name(subject, "instrument", group, "blanks, "):
            references.append(ReferenceEntry(name, reader.files(subject, "files", table["files"])))
    panels = tuple(_panels(reader))
    table = reader.one("geometry")
    reader.exclude("[geometry]", table, "ground", "dem")
    reader.exclude("[geometry]", table, "fov_deg", "look_angle")
    geometry: dict[str, Any] = {
        key: tuple(value) if isinstance(value, list) else value for key, value in values(table).items()
    }
    geometry |= {
        key: reader.path("[geometry]", key, geometry[key]) for key in ("dem", "look_angle") if key in geometry
    }
    return Collect(
        path=path,
        name=reader.collect_name,
        flightlines=tuple(entries),
        calibration=Unavailable.REPORTED if is_lost else calibration,
        irradiance=irradiance,
        white=_white(reader),
        clock=reader.clock,
        nav=tuple(reader.nav),
        references=tuple(references),
        panels=panels,
        sweep=sweep,
        bad_elements=bad_elements,
        geometry=geometry,
        alignment=reader.one("alignment").get("apply", "auto"),
        flights=tuple(reader.flights),
    )


def read_collect(path: str | os.PathLike[str], *, need_irradiance: bool = True) -> Collect:
    # Read and check a ``collect.toml``; its files are located, not opened.
    #
    # ``path``: the file; paths in it are relative to its folder; ``need_irradiance``: False if only radiance
    # will be computed.
    #
    # Raises `CollectError`: Not TOML (with the line), unknown keys, wrong types or values, missing keys or
    # files; all problems are listed.
    path = input_path(path, "a collect.toml")
    with Problems(f"{origin_of(path)} cannot be processed", CollectError) as problems:
        return parse_collect(path, problems, need_irradiance=need_irradiance)


@dataclass(frozen=True)
class OpenedCollect:
    # An opened collect, with the settings of its ``collect.toml``.
    tree: xr.DataTree
    settings: Collect
    members: Mapping[str, tuple[str, ...]]  #: Names of the cubes of every line, by the line's group.

    @property
    def cubes(self) -> dict[str, tuple[Path, ...]]:
        # Data files of every flight line, by the line's group (``flightlines/<id>``).
        files = {str(entry.name): find_pair(entry.path)[1] for entry in self.settings.flightlines}
        return {group: tuple(files[name] for name in names) for group, names in self.members.items()}


def open_with_settings(
    source: str | os.PathLike[str] | Collect,
    *,
    need_irradiance: bool = True,
    chunks: Any = "auto",
    calibrate: Callable[[Path], xr.Dataset] | None = None,
    mount: Callable[[xr.Dataset, Mapping[str, Any]], xr.Dataset] | None = None,
    level: Callable[[xr.Dataset, xr.Dataset], xr.Dataset] | None = None,
    whiten: Callable[[xr.Dataset, WhiteEntry], xr.Dataset] | None = None,
) -> OpenedCollect:
    # Open all files of a ``collect.toml``, without reading a cube, together with its settings.
    #
    # ``source``: the file, or its settings after `read_collect`; ``calibrate``: computes a calibration from
    # the path of a lab sweep; ``mount``: adds the table ``[geometry]`` to a line; ``level``: converts the
    # record of a light sensor on the aircraft, with its attitude, to level ground; ``whiten``: calibrates a
    # line by the table ``[reference]``; for the other arguments see `hyperpaint.open_collect`.
    #
    # Raises `CollectError`: The ``collect.toml``, or one of its files, cannot be used; all problems of all
    # files are listed.
    path = source.path if isinstance(source, Collect) else input_path(source, "a collect.toml")
    problems = Problems(f"{origin_of(path)} cannot be processed", CollectError)
    collect = (
        source
        if isinstance(source, Collect)
        else parse_collect(path, problems, need_irradiance=need_irradiance)
    )
    findings = Findings(str(path))
    is_stated = collect.calibration is not None or collect.sweep is not None
    calibration: xr.Dataset | Unavailable | None = Unavailable.REPORTED if is_stated else None
    if isinstance(collect.calibration, Path):
        with findings.step():
            calibration = open_calibration(collect.calibration, bad_elements=collect.bad_elements)
    if collect.sweep is not None:
        with findings.step():
            calibrate = CollectError.raise_if_none(
                calibrate,
                f"{collect.sweep} is a lab sweep",
                mend="open it by hyperpaint.open_collect, or pass calibrate=",
                code="calibrate-missing",
            )
            calibration = open_calibration(calibrate(collect.sweep), bad_elements=collect.bad_elements)
    irradiance: xr.Dataset | Unavailable | None = Unavailable.REPORTED
    with findings.step():
        irradiance = None
        if collect.irradiance is not None and collect.irradiance.files:
            files: Any = list(collect.irradiance.files)
            irradiance = open_irradiance(files if len(files) > 1 else files[0], **collect.irradiance.options)
    navigation: dict[Path, Navigation] = {}
    for file in collect.nav:
        with findings.step():
            navigation[file] = read_imu_gps(file, collect.clock.utc_of)
    if (
        collect.irradiance is not None
        and collect.irradiance.on_aircraft
        and isinstance(irradiance, xr.Dataset)
    ):
        with findings.step():
            # The record of a light sensor on the aircraft, converted to level ground.
            dated = [poses for poses in tuple(navigation.values()) if poses.utc is not None]
            if level is None or not dated:
                raise CollectError(
                    '[irradiance] mount = "aircraft" without the attitude of the aircraft in UTC',
                    mend="state nav files with a date, or level the record by "
                    "hyperpaint.light.level_irradiance",
                    code="attitude-missing",
                )
            columns = {
                name: ("time", np.concatenate([poses.values[name] for poses in dated]))
                for name in ("roll", "pitch", "heading", "latitude", "longitude")
            }
            time = np.concatenate([np.asarray(poses.utc) for poses in dated]).astype("datetime64[ns]")
            declared = dict(collect.flightlines[0].convention) if collect.flightlines else {}
            irradiance = level(
                irradiance, xr.Dataset(columns, {"time": time}, Convention(**declared).to_attrs())
            )
    lines: dict[str, xr.Dataset] = {}
    uncovered: dict[str, UncoveredError] = {}
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
        if whiten is not None and collect.white is not None and line.sizes:
            with line_findings.step():
                line = whiten(line, collect.white)
        lines[str(entry.name)] = line
        findings.errors += line_findings.errors
        uncovered |= {
            str(entry.name): error for error in line_findings.errors if isinstance(error, UncoveredError)
        }
    # a wrong clock of the record is one fault of all lines
    if uncovered and len(lines) > 1 and isinstance(irradiance, xr.Dataset):
        findings.errors = [error for error in findings.errors if error not in uncovered.values()]
        times = [np.sort(line["time"].values) for line in lines.values() if "time" in line.coords]
        some = "" if len(uncovered) == len(lines) else f"{len(uncovered)} of "
        subject = f"{some or 'all '}{len(lines)} cubes ({listed(list(uncovered), 3)}) were"
        spans = [span for error in uncovered.values() for span in error.lines]
        others = [stamps[~np.isnat(stamps)] for stamps in times]
        findings.errors.append(UncoveredError.of(irradiance, spans, subject, others))
    # the files of each field spectrometer must have one set of wavelengths
    references = {}
    for reference in collect.references:
        if not reference.files:  # their fault is reported already
            continue
        with findings.step():
            spectra = open_spectra(reference.files)
            CollectError.raise_if(
                len(spectra) > 1,
                f"[[references]] {reference.instrument!r}: files of {len(spectra)} kinds of instruments",
                mend="write one [[references]] for each instrument",
                code="instrument-mixed",
            )
            label = (
                {} if reference.group == reference.instrument else {"instrument_name": reference.instrument}
            )
            references[reference.group] = spectra[0].assign_attrs(label)
    # equal errors of several lines are reported once
    problems.extend(
        error.problem if isinstance(error, PaintError) else Problem(text, code="input-unreadable")
        for text, error in {str(error): error for error in findings.errors}.items()
    )
    problems.raise_if_any()
    joined_lines = dict(_joined_lines(collect, lines, irradiance))
    shared_groups = {"/irradiance": irradiance, "/calibration": calibration}
    groups = {
        "/": xr.Dataset(attrs={"name": collect.name, "source": path.name}),
        **{f"/flightlines/{name}": line for name, (line, _) in joined_lines.items()},
        **{name: shared for name, shared in shared_groups.items() if isinstance(shared, xr.Dataset)},
        **{f"/references/{name}": dataset for name, dataset in references.items()},
    }
    members = {f"flightlines/{name}": cubes for name, (_, cubes) in joined_lines.items()}
    return OpenedCollect(xr.DataTree.from_dict(groups), collect, members)


def _joined_lines(
    collect: Collect, lines: Mapping[str, xr.Dataset], irradiance: Any
) -> Iterator[tuple[str, tuple[xr.Dataset, tuple[str, ...]]]]:
    # Yield lines with their names and the ids of their cubes; cubes of one table are one line where the
    # recording continues
    record = irradiance if isinstance(irradiance, xr.Dataset) else None
    # cubes of a table, and its id, by the first cube
    flights = {cubes[0]: (cubes, line_id) for cubes, line_id in collect.flights if cubes}
    later_cubes = {name for cubes, _ in flights.values() for name in cubes[1:]}
    for name, line in lines.items():
        if name not in flights and name not in later_cubes:
            yield name, (line, (name,))
        if name in flights:
            cubes, line_id = flights[name]
            joined_lines = list(join_lines({cube: lines[cube] for cube in cubes}, record))
            for joined, members, interruption in joined_lines:
                warn_if(
                    interruption,
                    f"{members[0]} is a separate flight line: {interruption}",
                    "recording-interrupted",
                )
                joined_name = line_id if line_id and len(joined_lines) == 1 else members[0]
                yield joined_name, (joined.assign_attrs(name=joined_name), members)


# --- cubes of one flight as one line, where the recording continues from cube to cube ----------------------


#: Maximum time from the last line of a cube to the first line of the next cube of a recording, in line
#: periods: one lost frame is allowed, as in the navigation.
MAX_STEP_PERIODS = 2.5


def join_lines(
    lines: Mapping[str, xr.Dataset], irradiance: xr.Dataset | None
) -> Iterator[tuple[xr.Dataset, tuple[str, ...], str]]:
    # Yield the lines that cubes of one flight form, in their order, with the ids of their cubes and the
    # reason why they do not continue the previous line.
    # ``lines``: line of each cube by its id, in the order of recording; ``irradiance``: the complete record,
    # which is cut to every line, or None.
    groups: list[tuple[list[str], str]] = []
    for name in lines:
        reason = _interruption(lines, groups[-1][0][-1], name) if groups else ""
        if groups and not reason:
            groups[-1][0].append(name)
        else:
            groups.append(([name], reason))
    for members, reason in groups:
        yield _concatenated([lines[name] for name in members], irradiance), tuple(members), reason


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


def _concatenated(lines: list[xr.Dataset], irradiance: xr.Dataset | None) -> xr.Dataset:
    if len(lines) == 1:
        return lines[0]
    # frames lost between two cubes: by frame number if it continues, else by time
    lost = []
    for previous, line in itertools.pairwise(lines):
        by_number = int(line["frame"].values[0]) - int(previous["frame"].values[-1]) - 1
        times = _step_and_period(previous, line)
        by_time = 0 if times is None else max(0, round(float(times[0] / times[1])) - 1)
        lost.append(by_number if 0 <= by_number < MAX_STEP_PERIODS else by_time)
    # without irradiance and line numbers, which are added to the joined line
    pieces = [line.drop_dims(IRRADIANCE_TIME, errors="ignore").drop_vars(ALONG_TRACK) for line in lines]
    for number in reversed(np.flatnonzero(lost)):
        previous = pieces[number]
        count = lost[number]
        # Blank lines for frames lost after a cube, without time and position; frame numbers continue
        blank = previous.isel({ALONG_TRACK: [-1] * count})
        blank["frame"] += np.arange(1, count + 1)
        for name, variable in previous.variables.items():
            if ALONG_TRACK in variable.dims and name not in ("frame", "exposure_time"):
                missing: Any = np.datetime64("NaT", "ns") if variable.dtype.kind == "M" else np.nan
                empty = BLANK_COUNT if name == "counts" else missing
                blank[name] = xr.full_like(blank[name], empty).variable
        pieces.insert(number + 1, blank)
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
    return joined.assign_attrs(
        source=", ".join(str(line.attrs["source"]) for line in lines),
        dropped_frames=sum(int(line.attrs["dropped_frames"]) for line in lines) + sum(lost),
    )
