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
#: Maximum depth of subfolders that are searched.
MAX_DEPTH = 6
#: Maximum number of files and folders in the folder of a field day.
MAX_ENTRIES = 50_000

_STORES = (".zarr", ".nc")
_SURVEY = re.compile(r"survey|gcp|control.?point", re.IGNORECASE)
_HEIGHT = re.compile(r"(?:(?:ellipsoid(?:al)?|ell|wgs84|hae)[ _-]?(?:height|elevation|h)|hae)", re.IGNORECASE)

#: Maximum range of surveyed heights for which their median is taken as the height of the ground: from 50 m, 1
#: m moves the outer columns of a 20 degree swath by 0.18 m.
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
        half_width_mm = self.columns / 2 * self.pixel_pitch_um * 1e-3 / self.focal_length_mm
        return 2.0 * math.degrees(math.atan(half_width_mm))


@dataclass(frozen=True)
class Survey:
    """Heights of surveyed points above the ellipsoid."""

    path: Path
    height: float  # Median [m]
    spread: float  # Maximum minus minimum [m]
    points: int  # Number of points


@dataclass(frozen=True)
class FlightCube:
    """A raw cube of a flight, and its companion files."""

    header: Path
    frame_index: Path | None  # None: line times must come from elsewhere
    navigation: Path | None
    has_exposure: bool  # whether settings.txt or the header contains the exposure
    lens: Lens | None = None  # None: missing in the header, or pixels are binned


@dataclass(frozen=True)
class FieldFolder:
    """Files of a field day by their kind."""

    folder: Path
    cubes: tuple[FlightCube, ...]
    darks: tuple[Path, ...]
    calibration: Path | None
    sweep: Path | None
    #: Spectra of downwelling irradiance (folder, suffix), and of reflectance (instrument, folder, suffix).
    irradiance: tuple[tuple[Path, str], ...]
    references: tuple[tuple[str, Path, str], ...]
    #: Clock of the irradiance record minus UTC [h]; None if no file contains it.
    utc_offset_h: float | None
    #: Minimum and maximum correction of that clock [s] with which the record covers the flight; None if times
    #: of record or flight are missing.
    clock_offsets_s: tuple[float, float] | None
    survey: Survey | None = None
    #: Files that are not used, with reasons.
    notes: tuple[str, ...] = field(default=())


def find_field_files(
    folder: str | os.PathLike[str],
    *,
    asd: str | os.PathLike[str] | None = None,
    dark: str | os.PathLike[str] | None = None,
    calibration: str | os.PathLike[str] | None = None,
) -> FieldFolder:
    """Find the files of a field day in a folder, by reading headers and small files, but no cubes.

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

    Raises
    ------
    CollectError
        ``folder`` has no raw cube, is not a folder, or holds too many files.

    Notes
    -----
    ENVI cubes of integers are raw; they are darks if their name, or a subfolder's name, contains ``dark``.
    ASD files of a folder are irradiance or reflectance by the content of the first.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise CollectError(
            f"{folder} is not a folder", expected="the folder of the flight's cubes", code="folder-not-found"
        )
    search = _FileSearch(folder)
    for path in _walk(folder):
        search.add(path)
    for extra, kind in ((dark, "dark"), (asd, "spectra")):
        if extra is not None:
            search.add_folder(Path(extra), kind)
    if calibration is not None:
        search.calibrations = [Path(calibration)]
    return search.result()


class _FileSearch:
    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.raw: list[Path] = []
        self.darks: list[Path] = []
        self.spectra: dict[tuple[Path, str], list[Path]] = {}
        self.calibrations: list[Path] = []
        self.surveys: list[Path] = []
        self.notes: list[str] = []

    def add(self, path: Path) -> None:
        # classify cubes by their header, other files by their names
        suffix = path.suffix.lower()
        if suffix == ".hdr":
            inner = path.relative_to(self.folder) if path.is_relative_to(self.folder) else path
            self._add_cube(path, is_dark=any("dark" in part.lower() for part in inner.parts))
        elif suffix in (".asd", ".sig"):
            self.spectra.setdefault((path.parent, suffix), []).append(path)
        # a store with flight lines is a processed collect, not a calibration
        elif suffix in _STORES and not (path / "flightlines").is_dir():
            self.calibrations.append(path)
        elif suffix == ".csv" and _SURVEY.search(path.stem):
            self.surveys.append(path)

    def add_folder(self, folder: Path, kind: str) -> None:
        # a dark outside the field folder needs no ``dark`` in its name
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
            self.notes.append(f"{self._relative(path)} is not used: {header.dtype}, raw counts are integers")
            return
        (self.darks if is_dark else self.raw).append(path)

    def _relative(self, path: Path) -> str:
        return os.path.relpath(path, self.folder)

    def result(self) -> FieldFolder:
        if not self.raw:
            reasons = f"; {'; '.join(self.notes)}" if self.notes else ""
            raise CollectError(
                f"no raw cube in {self.folder}{reasons}",
                expected=f"ENVI headers (raw_0.hdr) beside cubes, at most {MAX_DEPTH} folders deep",
                code="cube-missing",
            )
        calibration, sweep = self._calibration()
        irradiance, references = self._instruments()
        cubes = tuple(self._flight_cubes())
        record = _record_times([path for folder, _ in irradiance for path in self.spectra[folder, ".asd"]])
        return FieldFolder(
            folder=self.folder,
            cubes=cubes,
            darks=tuple(sorted(self.darks)),
            calibration=calibration,
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
                dataset = open_envi(header)
                has_exposure = (
                    find_exposure(None, header, header.name, dataset, required=False)[0] is not None
                )
                lengths = lens_lengths(read_header(header).comments)
                lens = None if lengths is None else Lens(*lengths, dataset.sizes[CROSS_TRACK])
            companions = frame_index_beside(header), navigation_beside(header)
            yield FlightCube(header, *companions, has_exposure, lens)

    def _survey(self) -> Survey | None:
        # the surveyed height of the ground, from a single file with similar heights
        if len(self.surveys) != 1:
            if self.surveys:
                names = ", ".join(map(self._relative, self.surveys))
                self.notes.append(
                    f"several surveys ({names}): the height of the ground is not taken from them"
                )
            return None
        (path,) = self.surveys
        try:
            heights = _surveyed_heights(path)
        except FormatError as error:
            self.notes.append(f"{self._relative(path)} is not used: {error}")
            return None
        spread = float(np.ptp(heights))
        if spread > MAX_SURVEY_SPREAD_M:
            self.notes.append(
                f"{self._relative(path)} is not used: its heights differ by {spread:.2f} m, and a single "
                f"height is used for up to {MAX_SURVEY_SPREAD_M:g} m; use a dem instead"
            )
            return None
        return Survey(path, float(np.median(heights)), spread, heights.size)

    def _calibration(self) -> tuple[Path | None, Path | None]:
        # the single calibration, else the single lab sweep
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
                    reasons.append(f"{self._relative(path)} is not used: {error}")
        candidates = calibrations or sweeps
        if not candidates:
            self.notes += reasons
        if len(candidates) > 1:
            names = ", ".join(map(self._relative, candidates))
            self.notes.append(f"several calibrations ({names}) are not used; choose one with --calibration")
            return None, None
        return (candidates[0], None) if calibrations else (None, candidates[0] if sweeps else None)

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
                self.notes.append(f"{self._relative(folder)}/*.asd is not used: {error}")
                continue
            if quantity == "irradiance":
                irradiance.append((folder, suffix))
            elif quantity == "reflectance":
                references.append(("asd", folder, suffix))
            else:
                self.notes.append(f"{self._relative(folder)}/*.asd is not used: it contains {quantity}")
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
            expected="one column such as ellipsoidal_height_m (heights above sea level differ)",
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
    # warnings are given when the files are opened for processing
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PaintWarning)
        return read_spectra(files, None)


@dataclass(frozen=True)
class _Record:
    # first and last time of the irradiance record, by the clock of its PC
    first: np.datetime64 | None = None
    last: np.datetime64 | None = None
    utc_offset_h: float | None = None

    def offsets_for(self, cubes: Iterable[FlightCube]) -> tuple[float, float] | None:
        # minimum and maximum clock offset [s] with which the record covers all cubes
        spans = [span for cube in cubes if (span := _flight_times(cube)) is not None]
        if self.first is None or self.last is None or self.utc_offset_h is None or not spans:
            return None
        zone = np.timedelta64(round(self.utc_offset_h * 3600), "s")
        least = max(most for _, most in spans) - (self.last - zone)
        most = min(least for least, _ in spans) - (self.first - zone)
        return least / np.timedelta64(1, "s"), most / np.timedelta64(1, "s")


def _record_times(files: list[Path]) -> _Record:
    # times of the first and the last file by name
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


def _flight_times(cube: FlightCube) -> tuple[np.datetime64, np.datetime64] | None:
    # UTC times of the first and the last line
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
    for parent, folders, names in os.walk(folder):
        entries += len(folders) + len(names)
        if entries > MAX_ENTRIES:
            raise CollectError(
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
