"""Files of a field day: cubes, darks, spectra, calibration and surveyed points of a folder.

`write_collect_toml` writes a commented ``collect.toml`` for them. Values that reflectance needs and that no
file contains are written as ``"?"``; `process` refuses them by name until they are filled in.
"""

import contextlib
import csv
import itertools
import math
import os
import re
import textwrap
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from hyperpaint.base import (
    ALONG_TRACK,
    CROSS_TRACK,
    CollectError,
    Floats,
    FormatError,
    PaintError,
    PaintWarning,
    Problems,
    StoreError,
    documented,
    grouped,
    input_path,
    key_line,
    read_limited,
    toml_text,
)
from hyperpaint.io.collect.collect_toml import SCHEMA
from hyperpaint.io.envi.envi_cubes import declared_quantity, find_pair, open_envi, read_header
from hyperpaint.io.files.publishing import publish_file
from hyperpaint.io.files.reading import UNKNOWN, decoded_text, is_pattern, read_limited_text, unique_names
from hyperpaint.io.flightline.side_files import (
    cube_number,
    find_exposure,
    frame_index_beside,
    lens_lengths,
    navigation_beside,
    open_calibration,
    open_sweep,
    read_frame_index,
    recording_clock,
)
from hyperpaint.io.navigation.navigation_records import column_heading, metres_of, read_imu_gps
from hyperpaint.io.spectrometers.asd import Spectrum, read_spectra, sniff
from hyperpaint.io.spectrometers.reference_files import open_spectra
from hyperpaint.io.spectrometers.spectrum_texts import SPECTRUM_SUFFIXES, find_paths

_MAX_SURVEY_BYTES = 1 << 20
#: Maximum depth of subfolders that are searched.
MAX_DEPTH = 6
#: Maximum number of files and folders in the folder of a field day.
MAX_ENTRIES = 50_000

_STORES = (".zarr", ".nc")
_SPECTRA = "SVC .sig, ASD .asd, texts of spectrometers, or tables in CSV"
_SURVEY = re.compile(r"survey|gcp|control.?point", re.IGNORECASE)
#: Names of cubes of a white tile: Specim's WHITEREF_<scene>, Headwall's whiteReference, a plain white.
_WHITE = re.compile(
    r"^(?:white|spectralon)[ _-]*\d*$"
    r"|(?:^|[^a-z])white[ _-]*(?:ref|tile|panel|cal|standard|board|target|plate)",
    re.IGNORECASE,
)
#: Names of darks: DARKREF_<scene>, darkReference, <scene>_dark, dark_10ms; not darkwood or dark_cars.
_DARK = re.compile(
    r"darks?(?:$|[ _-]*(?:ref|cal|frame|current|cube|noise|before|after|start|end|pre|post|\d))",
    re.IGNORECASE,
)
#: Ratio of the bright elements of a cube to those of the darkest cube from which it is no dark.
_BRIGHT = 2.0
_HEIGHT = re.compile(r"(?:(?:ellipsoid(?:al)?|ell|wgs84|hae)[ _-]?(?:height|elevation|h)|hae)", re.IGNORECASE)

#: Maximum range of surveyed heights for which their median is taken as the height of the ground: from 50 m, 1
#: m moves the outer columns of a 20 degree swath by 0.18 m.
MAX_SURVEY_SPREAD_M = 1.0


@dataclass(frozen=True)
class Survey:
    """Heights of surveyed points above the ellipsoid."""

    path: Path
    height: float  # Median [m]
    spread: float  # Maximum minus minimum [m]
    points: int  # Number of points


@dataclass(frozen=True)
class FlightCube:
    # A raw cube of a flight, and its companion files.
    header: Path
    frame_index: Path | None  # None: line times must come from elsewhere
    navigation: Path | None
    exposure_s: float | None  # from settings.txt or the header
    clock: tuple[str | None, float | None]  # UTC of the first line, and line period [s], from the header
    #: Angle between the outer edges of the columns [degree], and the lens; None: missing in the header, or
    #: pixels are binned.
    lens: tuple[float, str] | None = None
    has_dark: bool = False  # whether dark lines are at the end of the cube


@dataclass(frozen=True)
class FieldFolder:
    # Files of a field day by their kind.
    folder: Path
    cubes: tuple[FlightCube, ...]
    darks: tuple[Path, ...]
    whites: tuple[Path, ...]
    calibration: Path | None
    sweep: Path | None
    irradiance: tuple[Path, ...]  # patterns of spectra of downwelling irradiance
    references: dict[str, list[Path]]  # files, or patterns of files, of reflectance by instrument
    #: Clock of the irradiance record minus UTC [h]; None if no file contains it.
    utc_offset_h: float | None
    #: Minimum and maximum correction of that clock [s] with which the record covers the flight; None if times
    #: of record or flight are missing.
    clock_offsets_s: tuple[float, float] | None
    survey: Survey | None = None
    #: Files that are not used, with reasons.
    notes: tuple[str, ...] = field(default=())

    @property
    def has_white(self) -> bool:
        # Whether reflectance is relative to a white tile: without irradiance and calibration.
        return bool(self.whites) and not (self.irradiance or self.calibration or self.sweep)


def find_field_files(
    folder: str | os.PathLike[str],
    *,
    asd: str | os.PathLike[str] | None = None,
    dark: str | os.PathLike[str] | None = None,
    calibration: str | os.PathLike[str] | None = None,
    references: Sequence[str | os.PathLike[str]] = (),
) -> FieldFolder:
    """Find the files of a field day in a folder, by reading headers and small files.

    Parameters
    ----------
    folder
        Folder to search, with its subfolders to a depth of six.
    asd
        Folder of ASD files, if it is outside ``folder``.
    dark
        Folder of dark cubes, if it is outside ``folder``.
    calibration
        Calibration or lab sweep of the camera; by default the one in the folder.
    references
        Files of reference spectra (``.sig``, ``.asd``, text exports, tables in CSV), patterns, or folders of
        them, if they are outside ``folder``.

    Raises
    ------
    CollectError
        ``folder`` has no raw cube, is not a folder, or holds too many files; ``references`` has no spectra.

    Notes
    -----
    ENVI cubes of integers are raw; they are darks if their name, or a subfolder's name, contains ``dark``,
    and white references if it is called ``white``, ``WHITEREF_...``, ``whiteReference``, ``spectralon`` or
    similar, or ``<scene>_white`` beside the scene. Where other words stand beside ``dark``, as in
    ``dark_cars``, a cube with twice the counts of the darkest one is a flight line; a note names it.
    ASD files of a folder are irradiance or reflectance by the content of the first.
    """
    folder = input_path(
        folder,
        "the folder of a flight",
        CollectError,
        "copy its folder; a collect.toml may name files behind URLs",
    )
    notes: list[str] = []
    raw, darks, whites, calibrations, surveys = (list[Path]() for _ in range(5))
    doubtful: dict[Path, list[Path]] = {}  # the list of a cube that is no dark
    # spectra by the file or the pattern of files that names them in the collect.toml
    spectra: dict[Path, list[Path]] = {}

    def relative(path: Path) -> str:
        return os.path.relpath(path, folder)

    # cubes are known by their headers, other files by their names
    kinds = {"": folder, "dark": dark, "spectra": asd}
    for kind, place in ((kind, place) for kind, place in kinds.items() if place is not None):
        CollectError.raise_if(
            not Path(place).is_dir(),
            f"{place} is not a folder",
            expected=f"a folder of {kind} files" if kind else "the folder of the flight's cubes",
            code="folder-not-found",
        )
        for path in _walk(Path(place)):
            suffix = path.suffix.lower()
            if suffix == ".hdr" and kind != "spectra":
                try:
                    header = read_header(path)
                    find_pair(path)
                except PaintError as error:
                    notes.append(f"{path.name} is not used: {error}")
                    continue
                # a dark outside the folder needs no ``dark`` in its name
                parts = (kind,) if kind else path.relative_to(folder).parts
                is_product = header.map_info is not None or declared_quantity(header)[0] not in (
                    None,
                    "counts",
                )
                if not header.is_spectral_library and (header.dtype.kind not in "ui" or is_product):
                    what = "a product" if is_product else f"{header.dtype}, raw counts are integers"
                    notes.append(f"{relative(path)} is not used: {what}")
                elif not header.is_spectral_library:
                    stems = [re.sub(r"\.hdr$", "", part, flags=re.IGNORECASE) for part in parts]
                    is_white = any(_WHITE.search(stem.split(".")[0]) for stem in stems)
                    is_dark, lit = any("dark" in stem.lower() for stem in stems), whites if is_white else raw
                    (darks if is_dark else lit).append(path)
                    if is_dark and not any(_DARK.search(stem) for stem in stems):
                        doubtful[path] = lit
            elif suffix in (".asd", ".sig") and kind != "dark":
                spectra.setdefault(path.parent / f"*{path.suffix}", []).append(path)
            # a store with flight lines is a processed collect, not a calibration
            elif not kind and suffix in _STORES and not (path / "flightlines").is_dir():
                calibrations.append(path)
            elif not kind and suffix == ".csv" and _SURVEY.search(path.stem):
                surveys.append(path)
    # names with "dark" in another word, or beside another one: the counts tell scenes from darks
    levels = {path: _bright_counts(path) for path in (*raw, *darks) if doubtful}
    for path, lit in doubtful.items():
        if levels[path] > _BRIGHT * min(levels.values()):
            darks.remove(path)
            lit.append(path)
            kind = "white reference" if lit is whites else "flight line"
            notes.append(f"{relative(path)} is taken as a {kind}: it is brighter than a dark")
    # white beside a scene of that name, as lot1_white beside lot1; car_white may be a car
    scenes = {path.stem.lower() for path in raw}
    for path in tuple(raw):
        if re.sub(r"[ _-]+white$", "", path.stem.lower()) in scenes - {path.stem.lower()}:
            raw.remove(path)
            whites.append(path)
            notes.append(f"{relative(path)} is taken as a white reference")
    CollectError.raise_if(
        not raw,
        "; ".join([f"no raw cube in {folder}", *notes]),
        expected=f"ENVI headers (raw_0.hdr) beside cubes, at most {MAX_DEPTH} folders deep",
        code="cube-missing",
    )
    camera, sweep = _calibration(
        calibrations if calibration is None else [Path(calibration)], relative, notes
    )
    # files of reference spectra outside the folder, by file or pattern; tables and exports singly
    named: dict[Path, list[Path]] = {}
    for place in map(Path, references):
        if not place.exists() and is_pattern(str(place)):
            named[place] = find_paths(place, list, _SPECTRA)
            continue
        CollectError.raise_if(
            not place.exists(),
            f"references {place}: no such file or folder",
            mend="check the path",
            code="file-not-found",
        )
        by_pattern = {".asd", ".sig"} if place.is_dir() else set()
        of_place = grouped(
            (path.parent / f"*{path.suffix}" if path.suffix.lower() in by_pattern else path, path)
            for path in (_walk(place) if place.is_dir() else [place])
            if place.is_file() or path.suffix.lower() in {*by_pattern, *SPECTRUM_SUFFIXES}
        )
        CollectError.raise_if(
            not of_place,
            f"references {place}: no spectra in this folder",
            expected=_SPECTRA,
            code="file-not-found",
        )
        named |= of_place
    spectra |= named
    irradiance, instruments = _instruments(spectra, relative, notes)
    CollectError.raise_if(
        named and not {path for paths in instruments.values() for path in paths} & set(named),
        "; ".join([f"no reference spectra in {', '.join(map(str, references))}", *notes]),
        expected=f"reflectance: {_SPECTRA}",
        code="file-not-found",
    )
    raw.sort(key=lambda path: (path.parent, cube_number(path) or 0, path.name))
    cubes = tuple(map(_flight_cube, raw))
    utc_offset_h, clock_offsets_s = _record_times(
        [path for pattern in irradiance for path in spectra[pattern]], cubes
    )
    survey = _survey(surveys, relative, notes)
    if whites and (irradiance or camera or sweep):
        notes.append(
            f"{', '.join(map(relative, whites))} is not used: calibration or irradiance take its place"
        )
    return FieldFolder(
        folder=folder,
        cubes=cubes,
        darks=tuple(sorted(darks)),
        whites=tuple(sorted(whites)),
        calibration=camera,
        sweep=sweep,
        irradiance=tuple(irradiance),
        references=instruments,
        utc_offset_h=utc_offset_h,
        clock_offsets_s=clock_offsets_s,
        survey=survey,
        notes=tuple(notes),
    )


def _bright_counts(header: Path) -> float:
    # 98th percentile of the counts of 16 lines in the middle of a cube; infinite where it cannot be read
    with contextlib.suppress(PaintError), warnings.catch_warnings(action="ignore", category=PaintWarning):
        cube = next(iter(open_envi(header).data_vars.values()))
        middle = max(cube.sizes[ALONG_TRACK] // 2 - 8, 0)
        return float(np.quantile(cube.isel({ALONG_TRACK: slice(middle, middle + 16)}).values, 0.98))
    return math.inf


def _flight_cube(header: Path) -> FlightCube:
    exposure_s, lens, has_dark = None, None, False
    clock: tuple[str | None, float | None] = (None, None)
    with contextlib.suppress(PaintError), warnings.catch_warnings(action="ignore", category=PaintWarning):
        dataset = open_envi(header)
        clock, has_dark = recording_clock(dataset), "dark_lines" in dataset.attrs
        exposure = find_exposure(None, header, header.name, dataset, required=False)[0]
        exposure_s = None if exposure is None else float(exposure)
        if lengths := lens_lengths(read_header(header).comments):
            (focal_mm, pitch_um), columns = lengths, dataset.sizes[CROSS_TRACK]
            angle = 2.0 * math.degrees(math.atan(columns / 2 * pitch_um * 1e-3 / focal_mm))
            lens = angle, f"{focal_mm:g} mm, {columns} pixels of {pitch_um:g} um"
    return FlightCube(
        header, frame_index_beside(header), navigation_beside(header), exposure_s, clock, lens, has_dark
    )


def _survey(paths: list[Path], relative: Callable[[Path], str], notes: list[str]) -> Survey | None:
    # the surveyed height of the ground, from a single file with similar heights
    if len(paths) > 1:
        notes.append(
            f"several surveys ({', '.join(map(relative, paths))}): the height of the ground is not taken "
            "from them"
        )
    for path in paths if len(paths) == 1 else ():
        try:
            heights = surveyed_heights(path)
        except FormatError as error:
            notes.append(f"{relative(path)} is not used: {error}")
            return None
        spread = float(np.ptp(heights))
        if spread <= MAX_SURVEY_SPREAD_M:
            return Survey(path, float(np.median(heights)), spread, heights.size)
        notes.append(
            f"{relative(path)} is not used: its heights differ by {spread:.2f} m, and a single "
            f"height is used for up to {MAX_SURVEY_SPREAD_M:g} m; use a dem instead"
        )
    return None


def _calibration(
    paths: list[Path], relative: Callable[[Path], str], notes: list[str]
) -> tuple[Path | None, Path | None]:
    # the single calibration, else the single lab sweep
    calibrations, sweeps, reasons = [], [], []
    for path in paths:
        try:
            open_calibration(path)
            calibrations.append(path)
        except PaintError as error:
            try:
                open_sweep(path)
                sweeps.append(path)
            except PaintError:
                reasons.append(f"{relative(path)} is not used: {error}")
    candidates = calibrations or sweeps
    notes += [] if candidates else reasons
    if len(candidates) > 1:
        notes.append(
            f"several calibrations ({', '.join(map(relative, candidates))}) are not used; choose one with "
            "--calibration"
        )
        return None, None
    return (candidates[0], None) if calibrations else (None, candidates[0] if sweeps else None)


def _instruments(
    spectra: dict[Path, list[Path]], relative: Callable[[Path], str], notes: list[str]
) -> tuple[list[Path], dict[str, list[Path]]]:
    # patterns of irradiance, and patterns of reflectance by instrument; a table in CSV is its own instrument
    irradiance: list[Path] = []
    references: dict[str, list[Path]] = {}
    for pattern, files in sorted(spectra.items()):
        first = min(files)
        kind = "scans" if pattern.suffix.lower() == ".sig" else sniff(first)
        instrument, quantity = {"scans": "svc"}.get(kind, "asd"), "reflectance"
        try:
            if kind in ("binary", "text", "instrument"):
                quantity = _read_quietly([first])[1]
            if kind not in ("binary", "text", "scans") and quantity == "reflectance":
                (opened,) = open_spectra([first])
                stem = re.sub(r"[^A-Za-z0-9]+", "_", first.stem).strip("_") or "table"
                (instrument,) = unique_names(
                    [stem], ("asd", "svc", *references), suffix="_{}", fold=str.lower
                )
                quantity = str(next(iter(opened.data_vars), "nothing"))
        except PaintError as error:
            notes.append(f"{relative(pattern)} is not used: {error}")
            continue
        if quantity == "irradiance":
            irradiance.append(pattern)
        elif quantity == "reflectance":
            references.setdefault(instrument, []).append(pattern)
        else:
            notes.append(f"{relative(pattern)} is not used: it contains {quantity}")
    return irradiance, references


def surveyed_heights(path: Path) -> Floats:
    # heights above the ellipsoid [m]

    text = decoded_text(read_limited_text(path, _MAX_SURVEY_BYTES, "a table of surveyed points"))
    with FormatError.instead_of(
        csv.Error, "not a table of text ($whole)", expected="rows of short cells", code="text-unreadable"
    ):
        rows = list(csv.reader(line for line in text.splitlines() if line.strip() and line[0] != "#"))
    columns = [n for n, cell in enumerate(rows[0]) if _HEIGHT.search(cell)] if rows else []
    FormatError.raise_if(
        len(columns) != 1 or len(rows) < 2,
        f"{len(columns)} columns of heights above the ellipsoid in {max(len(rows) - 1, 0)} rows",
        expected="one column such as ellipsoidal_height_m (heights above sea level differ)",
        code="height-column-missing",
    )
    with FormatError.instead_of(
        (ValueError, IndexError), "a height is not a number: $whole", code="number-unreadable"
    ):
        heights = np.array([float(row[columns[0]]) for row in rows[1:]])
    FormatError.raise_if(not np.isfinite(heights).all(), "a height is not finite", code="not-finite")
    with Problems("its heights cannot be used", FormatError) as problems:
        metres = metres_of(*column_heading(rows[0][columns[0]]), problems)
    return heights * metres


def _read_quietly(files: list[Path]) -> tuple[list[Spectrum], str]:
    # warnings are given when the files are opened for processing
    with warnings.catch_warnings(action="ignore", category=PaintWarning):
        return read_spectra(files, None)


def _record_times(
    files: list[Path], cubes: Iterable[FlightCube]
) -> tuple[float | None, tuple[float, float] | None]:
    # clock of the PC of the irradiance record minus UTC [h], and minimum and maximum clock offset [s] with
    # which the record covers all cubes; from the first and the last file by name
    try:
        ordered = sorted(files)
        spectra = _read_quietly(list(dict.fromkeys((ordered[0], ordered[-1]))))[0] if files else []
    except PaintError:
        return None, None
    zone_h = next((spectrum.utc_offset_h for spectrum in spectra if spectrum.utc_offset_h is not None), None)
    stamps = [
        np.datetime64(spectrum.local_time, "ns") for spectrum in spectra if spectrum.local_time is not None
    ]
    spans = []  # UTC times of the first and the last line
    for cube in cubes:
        if cube.frame_index is not None and cube.navigation is not None:
            with contextlib.suppress(PaintError):
                index = read_frame_index(cube.frame_index)
                times = read_imu_gps(cube.navigation).clock_for(index).at(index.stamp)
                times = times[~np.isnat(times)]
                spans += [(times.min(), times.max())] if times.size else []
    if zone_h is None or not stamps or not spans:
        return zone_h, None
    zone, second = np.timedelta64(round(zone_h * 3600), "s"), np.timedelta64(1, "s")
    least = max(end for _, end in spans) - (max(stamps) - zone)
    most = min(start for start, _ in spans) - (min(stamps) - zone)
    return zone_h, (least / second, most / second)


def _walk(folder: Path) -> Iterator[Path]:
    entries = 0
    for parent, folders, names in os.walk(folder):
        entries += len(folders) + len(names)
        CollectError.raise_if(
            entries > MAX_ENTRIES,
            f"{folder} holds more than {MAX_ENTRIES} files",
            mend="pass the folder of a single flight",
            code="folder-too-large",
        )
        stores = [name for name in folders if Path(name).suffix.lower() in _STORES]
        yield from (Path(parent, name) for name in sorted(stores))
        depth = len(Path(parent).relative_to(folder).parts)
        folders[:] = sorted(
            name for name in folders if name not in stores and not name.startswith(".") and depth < MAX_DEPTH
        )
        yield from (Path(parent, name) for name in sorted(names) if not name.startswith("."))


_RAW_CUBES = "raw_*[0-9].hdr"


@documented()
def write_collect_toml(
    files: FieldFolder, path: str | os.PathLike[str] | None = None, *, overwrite: bool = False
) -> Path:
    """Write a commented ``collect.toml`` that names the files of a folder.

    Parameters
    ----------
    files
        See `find_field_files`.
    path
        By default ``collect.toml`` in the folder; paths in it are relative to its own folder.
    overwrite

    Returns
    -------
    Path of the file.

    Raises
    ------
    StoreError
        The file exists, is not a ``.toml``, or cannot be written.
    """
    path = files.folder / "collect.toml" if path is None else Path(path)
    StoreError.raise_if(
        path.exists() and path.suffix.lower() != ".toml",
        f"{path} exists and is not a .toml file",
        mend="choose another path",
        code="file-foreign",
    )
    publish_file(path, "\n".join(_toml_lines(files, path.parent)).encode(), overwrite=overwrite)
    return path


def unknown_keys(path: Path) -> list[str]:
    # Return the lines of a ``collect.toml`` that are still to be filled in.
    return [
        line.partition("#")[0].strip()
        for line in read_limited(path, 1 << 20, "a collect.toml").decode().splitlines()
        if f'= "{UNKNOWN}"' in line.partition("#")[0]
    ]


def _toml_lines(files: FieldFolder, base: Path) -> Iterator[str]:
    def relative(path: Path) -> str:
        return Path(os.path.relpath(path, base)).as_posix()

    def key(table: str, name: str, value: Any = None, note: str = "") -> str:
        return key_line(SCHEMA[table], name, value, note)

    def of_path(path: Path | None) -> str:
        return UNKNOWN if path is None else _without_controls(relative(path))

    name, survey, lens = files.folder.resolve().name, files.survey, files.cubes[0].lens
    stamp = "start" if all(cube.clock[0] for cube in files.cubes) else "end"
    camera = [key("camera", "bit_depth", 12), key("camera", "stamp", stamp)]
    exposures = {cube.exposure_s for cube in files.cubes}
    periods = {cube.clock[1] for cube in files.cubes}
    is_indexed = all(cube.frame_index for cube in files.cubes)
    # reflectance relative to a white tile needs no times
    unknown_time = None if files.has_white else UNKNOWN
    unknown_dark = None if all(cube.has_dark for cube in files.cubes) else UNKNOWN
    if None in exposures:
        camera.append(
            key(
                "camera",
                "exposure_time_ms",
                UNKNOWN,
                "exposure [ms]: no settings.txt and no header states it",
            )
        )
    elif not is_indexed and len(exposures) == 1:
        camera.append(key("camera", "exposure_time_ms", _ms(*exposures), "exposure [ms], from the header"))
    if not is_indexed and len(periods) == 1 and None not in periods:
        camera.append(key("camera", "frame_period_ms", _ms(*periods), "1000 / frame rate of the header"))
    elif not is_indexed:
        note = "time from line to line [ms]: a cube has no frame index"
        camera.append(key("camera", "frame_period_ms", unknown_time, note))
    calibration = ("path", files.calibration) if files.sweep is None else ("sweep", files.sweep)
    ground = [key("geometry", "ground"), key("geometry", "dem")]
    if survey is not None:
        source = f"{relative(survey.path)}, median of {survey.points} points within {survey.spread:.2f} m"
        ground = [key("geometry", "ground", round(survey.height, 3), f"m above the ellipsoid: {source}")]
    fov = (None, "") if lens is None else (float(f"{lens[0]:.6g}"), f"lens of the header: {lens[1]}")
    irradiance = [
        key("irradiance", "files", UNKNOWN, "files of the irradiance spectrometer (not needed for radiance)")
    ]
    if files.irradiance:
        patterns = [_without_controls(relative(pattern)) for pattern in files.irradiance]
        note = "logging PC minus UTC [h], such as -5: no file states it"
        # the offset is 0 if the record covers the flight without one, else to be filled in
        offsets = files.clock_offsets_s
        clock_offset: float | str = UNKNOWN
        if offsets is None or offsets[0] <= 0.0 <= offsets[1]:
            clock_offset = 0.0
            clock_note = "added to the clock of the logging PC [s]: no file states it, 0 is assumed"
        elif offsets[0] > offsets[1]:
            clock_note = "the record is shorter than the flight: files are missing"
        else:
            span = f"{offsets[0]:.0f} to {offsets[1]:.0f} s"
            clock_note = f"added to the clock of the logging PC: the record covers the flight with {span}"
        irradiance = [
            key("irradiance", "files", patterns[0] if len(patterns) == 1 else patterns),
            key("irradiance", "quantity", "irradiance"),
            *([key("irradiance", "utc_offset_h", UNKNOWN, note)] if files.utc_offset_h is None else []),
            key("irradiance", "clock_offset_s", clock_offset, clock_note),
            key("irradiance", "fwhm_nm"),
            key("irradiance", "mount"),
            *("", "[alignment]", key("alignment", "apply", "auto")),
        ]
    yield from (
        f"# Written by hyperpaint init from the files in {name}.",
        f'# Replace every "{UNKNOWN}"; a key behind # is optional, with its default or an example.',
        *("", "[collect]", f"name = {_quoted(name)}"),
        *("", "[camera]", *camera),
        *(() if files.has_white else ("", "[calibration]")),
        *(() if files.has_white else [key("calibration", calibration[0], of_path(calibration[1]))]),
        *("", "[dark]", key("dark", "cubes", list(map(of_path, files.darks)) or unknown_dark)),
    )
    if files.has_white:
        note = "reflectance of the tile, such as 0.95; 1.0 gives reflectance relative to the tile"
        yield from (
            *("", "[reference]", key("reference", "white", list(map(of_path, files.whites)))),
            *(key("reference", "dark"), key("reference", "reflectance", UNKNOWN, note)),
            *(key("reference", name) for name in ("certificate", "uncertainty", "exposure_time_ms")),
        )
    yield from (
        ()
        if files.has_white and not any(cube.navigation for cube in files.cubes)
        else (
            *("", "[navigation]  # for maps only"),
            "# Conventions differ between makers, and no file states them. These are assumed for a Headwall",
            "# imu_gps.txt; hyperpaint.geometry.check_conventions compares them with the picture.",
            *(
                key("navigation", choice, fact.default or "left_to_right")
                for choice, fact in SCHEMA["navigation"].items()
                if fact.choices
            ),
            *("", "[geometry]  # for maps only", *ground, key("geometry", "fov_deg", *fov)),
            *(key("geometry", "boresight_deg"), key("geometry", "lever_arm_m")),
        )
    )
    yield from () if files.has_white else ("", "[irradiance]", *irradiance)
    ids = _folder_ids(files.cubes, relative)
    for cube, cubes in _tables(files.cubes, relative):
        yield from ("", "[[flightlines]]")
        folder_id, is_pattern = ids.get(cube.header.parent), cubes.endswith(_RAW_CUBES)
        if folder_id is not None:
            yield f"id = {_quoted(folder_id if is_pattern else f'{folder_id}_{_stem(cube)}')}"
        yield f"cube = {_quoted(cubes)}"
        if is_pattern:
            yield "# every cube has its own frame index; cubes of one recording become one line"
        elif cube.frame_index is not None:
            yield f"frame_index = {_quoted(relative(cube.frame_index))}"
        if cube.navigation is not None:
            yield f"nav = {_quoted(relative(cube.navigation))}"
        start = cube.clock[0]
        if cube.frame_index is None or cube.navigation is None:
            note = "UTC of the first line, " + (
                "from the header" if start else "such as 2021-07-20T17:00:00Z"
            )
            yield key("flightlines", "start_time", start or unknown_time, note)
    yield from (
        ()
        if files.has_white
        else (
            *("", "# [[panels]]  # targets of known reflectance in the scene: they scale their line"),
            '# line = "raw_0"',
            *(key("panels", name) for name in ("along_track", "cross_track", "reflectance", "uncertainty")),
        )
    )
    for instrument, paths in files.references.items():
        names = [_without_controls(relative(path)) for path in paths]
        yield from ("", "[[references]]", f"instrument = {_quoted(instrument)}")
        yield f"files = {toml_text(names[0] if len(names) == 1 else names)}"
    if files.notes:
        yield from ("", "# Files without a use:")
    for note in files.notes:
        yield from textwrap.wrap(note, 100, initial_indent="# * ", subsequent_indent="#   ")
    yield ""


def _ms(seconds: float | None) -> float | None:
    return None if seconds is None else float(f"{1e3 * seconds:.9g}")


def _tables(cubes: Sequence[FlightCube], relative: Callable[[Path], str]) -> Iterator[tuple[FlightCube, str]]:
    # the first cube of every table, and the cube or the pattern of cubes in the table
    for folder, group in itertools.groupby(cubes, key=lambda cube: cube.header.parent):
        folder_cubes = list(group)
        companions = {(cube.navigation, cube.frame_index is None) for cube in folder_cubes}
        pattern_fits = set(folder.glob(_RAW_CUBES)) == {cube.header for cube in folder_cubes}
        if len(folder_cubes) > 1 and len(companions) == 1 and pattern_fits:
            yield folder_cubes[0], f"{relative(folder)}/{_RAW_CUBES}"
        else:
            yield from ((cube, relative(cube.header)) for cube in folder_cubes)


def _folder_ids(cubes: Sequence[FlightCube], relative: Callable[[Path], str]) -> dict[Path, str]:
    # ids of folders, which distinguish cubes of equal names; empty if all names differ
    stems = [_stem(cube).lower() for cube in cubes]
    if len(set(stems)) == len(stems):
        return {}
    folders = dict.fromkeys(cube.header.parent for cube in cubes)
    ids = [re.sub(r"[^A-Za-z0-9]+", "_", relative(folder)).strip("_")[:60] or "flight" for folder in folders]
    # an id has at least two characters, and differs from those of other folders
    short_ids = [name for name in ids if len(name) < 2]
    return dict(zip(folders, unique_names(ids, short_ids, suffix="_{}", fold=str.lower), strict=True))


def _stem(cube: FlightCube) -> str:
    return cube.header.name.split(".")[0]


def _without_controls(text: str) -> str:
    FormatError.raise_if(
        any(ord(letter) < 32 for letter in text),
        f"{text!r}: a file name with control characters",
        mend="rename it",
        code="name-invalid",
    )
    return text


def _quoted(text: str) -> str:
    return toml_text(_without_controls(text))
