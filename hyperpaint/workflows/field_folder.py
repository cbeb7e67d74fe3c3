"""Files of a field day: cubes, darks, spectra, calibration and surveyed points of a folder."""

from __future__ import annotations

import contextlib
import csv
import math
import os
import re
import warnings
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from hyperpaint.base.errors import CollectError, FormatError, PaintError, PaintWarning, Problems
from hyperpaint.base.schema import CROSS_TRACK
from hyperpaint.io.envi.envi_cubes import find_pair, open_envi
from hyperpaint.io.envi.envi_header import read_header
from hyperpaint.io.flightline.headwall import (
    cube_number,
    find_exposure,
    frame_index_beside,
    lens_lengths,
    navigation_beside,
    read_frame_index,
)
from hyperpaint.io.spectrometers.asd import Spectrum, read_spectra

_MAX_SURVEY_BYTES = 1 << 20
MAX_DEPTH = 6
#: Folders below the one that is looked at, and files and folders in it, beyond which it is no field day.
MAX_ENTRIES = 50_000

_STORES = (".zarr", ".nc")
_SURVEY = re.compile(r"survey|gcp|control.?point", re.IGNORECASE)
_HEIGHT = re.compile(r"(?:(?:ellipsoid(?:al)?|ell|wgs84|hae)[ _-]?(?:height|elevation|h)|hae)", re.IGNORECASE)

#: Between the lowest and the highest point, up to which one height stands for the ground; 1 m seen from 50 m
#: moves the outer columns of a 20 degree swath by 0.18 m.
MAX_SURVEY_SPREAD_M = 1.0


@dataclass(frozen=True)
class Lens:
    """Optics of the camera, from a header."""

    focal_length_mm: float
    pixel_pitch_um: float
    columns: int

    @property
    def field_of_view(self) -> float:
        """Angle between the outer edges of the columns [degree]."""
        half = self.columns / 2 * self.pixel_pitch_um * 1e-3 / self.focal_length_mm
        return 2.0 * math.degrees(math.atan(half))


@dataclass(frozen=True)
class Survey:
    """Heights of surveyed points above the ellipsoid."""

    path: Path
    height: float  # Median [m]
    spread: float  # Of all points [m]
    points: int


@dataclass(frozen=True)
class FlightCube:
    """One raw cube of a flight, and its companion files."""

    header: Path
    frame_index: Path | None  # None: line times must come from elsewhere
    navigation: Path | None
    has_exposure: bool  # whether settings.txt or the header states it
    lens: Lens | None = None  # None: the header says none, or pixels are binned


@dataclass(frozen=True)
class FieldFolder:
    """Files of a field day by their kind."""

    folder: Path
    cubes: tuple[FlightCube, ...]
    darks: tuple[Path, ...]
    calibration: Path | None
    sweep: Path | None
    #: Folders of spectra: of downwelling irradiance, and (instrument, folder, suffix) of reflectance.
    irradiance: tuple[tuple[Path, str], ...]
    references: tuple[tuple[str, Path, str], ...]
    #: Hours of the irradiance's clock ahead of UTC, None where no file says them.
    utc_offset_h: float | None
    #: Least and largest seconds to be added to that clock with which the record covers the flight; None
    #: where its times, or those of the flight, are not known.
    clock_offsets_s: tuple[float, float] | None
    survey: Survey | None = None
    #: What was seen and not used, with the reason.
    notes: tuple[str, ...] = field(default=())


def find_field_files(
    folder: str | os.PathLike[str],
    *,
    asd: str | os.PathLike[str] | None = None,
    dark: str | os.PathLike[str] | None = None,
    calibration: str | os.PathLike[str] | None = None,
) -> FieldFolder:
    """Find the files of a field day in a folder; headers and small files are read, no cube.

    Parameters
    ----------
    folder
        Folder to search, with its subfolders to a depth of six.
    asd
        Folder of ASD files, where they lie elsewhere.
    dark
        Folder of dark cubes, where they lie elsewhere.
    calibration
        Calibration or lab sweep of the camera; by default the one in the folder.

    Raises
    ------
    CollectError
        ``folder`` has no raw cube, is not a folder, or holds too many files.

    Notes
    -----
    An integer ENVI cube is raw; one with ``dark`` in its name, or in the name of a folder between, is a dark.
    ASD files of a folder are irradiance or reflectance by their content, and all of one kind.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise CollectError(
            f"{folder} is not a folder", expected="the folder of the flight's cubes", code="folder-not-found"
        )
    seen = _Seen(folder)
    for path in _walk(folder):
        seen.add(path)
    for extra, kind in ((dark, "dark"), (asd, "spectra")):
        if extra is not None:
            seen.add_folder(Path(extra), kind)
    if calibration is not None:
        seen.calibrations = [Path(calibration)]
    return seen.result()


class _Seen:
    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.raw: list[Path] = []
        self.darks: list[Path] = []
        self.spectra: dict[tuple[Path, str], list[Path]] = {}
        self.calibrations: list[Path] = []
        self.surveys: list[Path] = []
        self.notes: list[str] = []

    def add(self, path: Path) -> None:
        # a cube by its header, other files by their names
        suffix = path.suffix.lower()
        if suffix == ".hdr":
            inner = path.relative_to(self.folder) if path.is_relative_to(self.folder) else path
            self._add_cube(path, is_dark=any("dark" in part.lower() for part in inner.parts))
        elif suffix in (".asd", ".sig"):
            self.spectra.setdefault((path.parent, suffix), []).append(path)
        elif suffix in _STORES and not (path / "flightlines").is_dir():  # a processed collect holds its own
            self.calibrations.append(path)
        elif suffix == ".csv" and _SURVEY.search(path.stem):
            self.surveys.append(path)

    def add_folder(self, folder: Path, kind: str) -> None:
        # a dark outside of the field folder needs no ``dark`` in its name
        if not folder.is_dir():
            raise CollectError(
                f"{folder} is not a folder", expected=f"a folder of {kind} files", code="folder-not-found"
            )
        for path in _walk(folder):
            if kind == "dark" and path.suffix.lower() == ".hdr":
                self._add_cube(path, is_dark=True)
            elif kind == "spectra" and path.suffix.lower() in (".asd", ".sig"):
                self.add(path)

    def _add_cube(self, path: Path, *, is_dark: bool) -> None:
        try:
            header = read_header(path)
            find_pair(path)
        except PaintError as error:
            self.notes.append(f"{path.name} is not used: {error}")
            return
        if header.is_spectral_library:
            return
        if header.dtype.kind not in "ui":
            self.notes.append(f"{self._shown(path)} is not used: {header.dtype}, raw counts are integers")
            return
        (self.darks if is_dark else self.raw).append(path)

    def _shown(self, path: Path) -> str:
        return os.path.relpath(path, self.folder)

    def result(self) -> FieldFolder:
        if not self.raw:
            seen = f"; {'; '.join(self.notes)}" if self.notes else ""
            raise CollectError(
                f"no raw cube in {self.folder}{seen}",
                expected=f"ENVI headers (raw_0.hdr) beside cubes, at most {MAX_DEPTH} folders deep",
                code="cube-missing",
            )
        stored, sweep = self._calibration()
        irradiance, references = self._instruments()
        cubes = tuple(self._flight_cubes())
        record = _record_times([path for folder, _ in irradiance for path in self.spectra[folder, ".asd"]])
        return FieldFolder(
            folder=self.folder,
            cubes=cubes,
            darks=tuple(sorted(self.darks)),
            calibration=stored,
            sweep=sweep,
            irradiance=tuple(irradiance),
            references=tuple(references),
            utc_offset_h=record.utc_offset_h,
            clock_offsets_s=record.offsets_for(cubes),
            survey=self._survey(),
            notes=tuple(self.notes),
        )

    def _flight_cubes(self) -> Iterator[FlightCube]:
        for header in sorted(self.raw, key=lambda path: (path.parent, cube_number(path) or 0, path.name)):
            has_exposure, lens = False, None
            with contextlib.suppress(PaintError), warnings.catch_warnings():
                warnings.simplefilter("ignore", PaintWarning)
                opened = open_envi(header)
                has_exposure = find_exposure(None, header, header.name, opened, required=False)[0] is not None
                lengths = lens_lengths(read_header(header).comments)
                lens = None if lengths is None else Lens(*lengths, opened.sizes[CROSS_TRACK])
            beside = frame_index_beside(header), navigation_beside(header)
            yield FlightCube(header, *beside, has_exposure, lens)

    def _survey(self) -> Survey | None:
        # only of one such file, and where its heights agree
        if len(self.surveys) != 1:
            if self.surveys:
                names = ", ".join(map(self._shown, self.surveys))
                self.notes.append(f"several surveys ({names}): none is chosen for the height of the ground")
            return None
        (path,) = self.surveys
        try:
            heights = _surveyed_heights(path)
        except FormatError as error:
            self.notes.append(f"{self._shown(path)} is not used: {error}")
            return None
        spread = float(np.ptp(heights))
        if spread > MAX_SURVEY_SPREAD_M:
            self.notes.append(
                f"{self._shown(path)} is not used: its points lie {spread:.2f} m apart in height, and one "
                f"height is meant for up to {MAX_SURVEY_SPREAD_M:g} m; name a dem"
            )
            return None
        return Survey(path, float(np.median(heights)), spread, heights.size)

    def _calibration(self) -> tuple[Path | None, Path | None]:
        # the one calibration, else the one lab sweep
        from hyperpaint.io.flightline.calibration_store import open_calibration, open_sweep

        calibrations, sweeps, reasons = [], [], []
        for path in self.calibrations:
            try:
                open_calibration(path)
                calibrations.append(path)
            except PaintError as error:
                try:
                    open_sweep(path)
                    sweeps.append(path)
                except PaintError:
                    reasons.append(f"{self._shown(path)} is not used: {error}")
        several = calibrations or sweeps
        if not several:
            self.notes += reasons
        if len(several) > 1:
            names = ", ".join(map(self._shown, several))
            self.notes.append(f"several calibrations ({names}): none is chosen; name one with --calibration")
            return None, None
        return (several[0], None) if calibrations else (None, several[0] if sweeps else None)

    def _instruments(self) -> tuple[list[tuple[Path, str]], list[tuple[str, Path, str]]]:
        # folders of irradiance, and folders of reflectance with their instruments
        irradiance: list[tuple[Path, str]] = []
        references: list[tuple[str, Path, str]] = []
        for (folder, suffix), files in sorted(self.spectra.items()):
            if suffix == ".sig":
                references.append(("svc", folder, suffix))
                continue
            try:
                quantity = _read_quietly(sorted(files)[:1])[1]
            except PaintError as error:
                self.notes.append(f"{self._shown(folder)}/*.asd is not used: {error}")
                continue
            if quantity == "irradiance":
                irradiance.append((folder, suffix))
            elif quantity == "reflectance":
                references.append(("asd", folder, suffix))
            else:
                self.notes.append(f"{self._shown(folder)}/*.asd is not used: it holds {quantity}")
        return irradiance, references


def _surveyed_heights(path: Path) -> npt.NDArray[np.float64]:
    # heights above the ellipsoid [m]
    from hyperpaint.io.files.reading import read_limited_text
    from hyperpaint.io.navigation.control_points import column_heading, metres_of

    text = read_limited_text(path, _MAX_SURVEY_BYTES, "a table of surveyed points").decode(
        "utf-8-sig", "replace"
    )
    try:
        rows = list(csv.reader(line for line in text.splitlines() if line.strip() and line[0] != "#"))
    except csv.Error as error:
        raise FormatError(
            f"not a table of text ({error})", expected="rows of short cells", code="text-unreadable"
        ) from error
    columns = [n for n, cell in enumerate(rows[0]) if _HEIGHT.search(cell)] if rows else []
    if len(columns) != 1 or len(rows) < 2:
        raise FormatError(
            f"{len(columns)} columns of heights above the ellipsoid in {max(len(rows) - 1, 0)} rows",
            expected="one such as ellipsoidal_height_m (heights above the sea differ by tens of metres)",
            code="height-column-missing",
        )
    try:
        heights = np.array([float(row[columns[0]]) for row in rows[1:]])
    except (ValueError, IndexError) as error:
        raise FormatError(f"a height is not a number: {error}", code="number-unreadable") from error
    if not np.isfinite(heights).all():
        raise FormatError("a height is not finite", code="not-finite")
    problems = Problems("its heights cannot be used", FormatError)
    metres = metres_of(*column_heading(rows[0][columns[0]]), problems)
    problems.raise_if_any()
    return heights * metres


def _read_quietly(files: list[Path]) -> tuple[list[Spectrum], str]:
    # a later reading repeats the warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PaintWarning)
        return read_spectra(files, None)


@dataclass(frozen=True)
class _Record:
    # times of the irradiance record, by the clock of its PC
    first: np.datetime64 | None = None
    last: np.datetime64 | None = None
    utc_offset_h: float | None = None

    def offsets_for(self, cubes: Iterable[FlightCube]) -> tuple[float, float] | None:
        # clock offsets [s] with which the record covers all cubes
        spans = [span for cube in cubes if (span := _flown(cube)) is not None]
        if self.first is None or self.last is None or self.utc_offset_h is None or not spans:
            return None
        zone = np.timedelta64(round(self.utc_offset_h * 3600), "s")
        first = max(last for _, last in spans) - (self.last - zone)
        last = min(first for first, _ in spans) - (self.first - zone)
        return first / np.timedelta64(1, "s"), last / np.timedelta64(1, "s")


def _record_times(files: list[Path]) -> _Record:
    # the first and the last file by name
    if not files:
        return _Record()
    ordered = sorted(files)
    try:
        spectra = _read_quietly(list(dict.fromkeys((ordered[0], ordered[-1]))))[0]
    except PaintError:
        return _Record()
    zones = [spectrum.utc_offset_h for spectrum in spectra if spectrum.utc_offset_h is not None]
    stamps = [
        np.datetime64(spectrum.local_time, "ns") for spectrum in spectra if spectrum.local_time is not None
    ]
    zone = zones[0] if zones else None
    return _Record(min(stamps), max(stamps), zone) if stamps else _Record(utc_offset_h=zone)


def _flown(cube: FlightCube) -> tuple[np.datetime64, np.datetime64] | None:
    # times of the first and the last line of the frame index [UTC]
    from hyperpaint.io.navigation.navigation_records import read_imu_gps

    if cube.frame_index is None or cube.navigation is None:
        return None
    try:
        index = read_frame_index(cube.frame_index)
        times = read_imu_gps(cube.navigation).clock_for(index).at(index.stamp)
    except PaintError:
        return None
    times = times[~np.isnat(times)]
    return (times.min(), times.max()) if times.size else None


def _walk(folder: Path) -> Iterator[Path]:
    entries = 0
    for place, folders, names in os.walk(folder):
        entries += len(folders) + len(names)
        if entries > MAX_ENTRIES:
            raise CollectError(
                f"{folder} holds more than {MAX_ENTRIES} files",
                mend="name the folder of one flight",
                code="folder-too-large",
            )
        stores = [name for name in folders if Path(name).suffix.lower() in _STORES]
        yield from (Path(place, name) for name in sorted(stores))
        depth = len(Path(place).relative_to(folder).parts)
        folders[:] = sorted(
            name for name in folders if name not in stores and not name.startswith(".") and depth < MAX_DEPTH
        )
        yield from (Path(place, name) for name in sorted(names) if not name.startswith("."))
