"""Writing of a commented ``collect.toml`` for the files in the folder of a field day.

Values that reflectance needs and that no file contains are written as ``"?"``; `process` refuses them by name
until they are filled in.
"""

from __future__ import annotations

import itertools
import os
import re
import textwrap
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from hyperpaint.base.errors import FormatError, StoreError
from hyperpaint.base.facts import documented, key_line, toml_text
from hyperpaint.base.input_files import read_limited
from hyperpaint.io.collect.collect_toml import SCHEMA
from hyperpaint.io.files.publishing import publish_file
from hyperpaint.io.files.toml_tables import UNKNOWN

from .field_folder import FieldFolder, FlightCube

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
    if path.exists() and path.suffix.lower() != ".toml":
        raise StoreError(
            f"{path} exists and is not a .toml file", mend="choose another path", code="file-foreign"
        )
    publish_file(path, "\n".join(_toml_lines(files, path.parent)).encode(), overwrite=overwrite)
    return path


def unknown_keys(path: Path) -> list[str]:
    """Return the lines of a ``collect.toml`` that are still to be filled in."""
    lines = read_limited(path, 1 << 20, "a collect.toml").decode().splitlines()
    return [line.partition("#")[0].strip() for line in lines if f'= "{UNKNOWN}"' in line.partition("#")[0]]


def _toml_lines(files: FieldFolder, base: Path) -> Iterator[str]:
    def relative(path: Path) -> str:
        return Path(os.path.relpath(path, base)).as_posix()

    def key(name: str, value: Any = None, note: str = "") -> str:
        # ``table`` is the table being written
        return key_line(SCHEMA[table], name, value, note)

    name = files.folder.resolve().name
    yield f"# Written by hyperpaint init from the files in {name}."
    yield f'# Replace every "{UNKNOWN}"; a key behind # is optional, with its default or an example.'
    table = "collect"
    yield from ("", "[collect]", f"name = {_quoted(name)}")

    table = "camera"
    yield from ("", "[camera]", key("bit_depth", 12), key("stamp", "end"))
    if not all(cube.has_exposure for cube in files.cubes):
        yield key("exposure_time_ms", UNKNOWN, "exposure [ms]: no settings.txt and no header states it")
    if not all(cube.frame_index for cube in files.cubes):
        yield key("frame_period_ms", UNKNOWN, "time from line to line [ms]: a cube has no frame index")

    table = "calibration"
    yield from ("", "[calibration]")
    if files.sweep is not None:
        yield key("sweep", _without_controls(relative(files.sweep)))
    else:
        calibration = files.calibration
        yield key("path", UNKNOWN if calibration is None else _without_controls(relative(calibration)))

    table = "dark"
    yield from (
        "",
        "[dark]",
        key("cubes", [_without_controls(relative(path)) for path in files.darks] or UNKNOWN),
    )

    table = "navigation"
    yield from ("", "[navigation]  # for maps only")
    yield "# Conventions differ between makers, and no file states them. These are assumed for a Headwall"
    yield "# imu_gps.txt; hyperpaint.geometry.check_conventions compares them with the picture."
    for choice, fact in SCHEMA["navigation"].items():
        if fact.choices:
            yield key(choice, fact.default or "left_to_right")

    table = "geometry"
    yield from ("", "[geometry]  # for maps only")
    if files.survey is None:
        yield from (key("ground"), key("dem"))
    else:
        survey = files.survey
        source = f"{relative(survey.path)}, median of {survey.points} points within {survey.spread:.2f} m"
        yield key("ground", round(survey.height, 3), f"m above the ellipsoid: {source}")
    lens = files.cubes[0].lens
    if lens is None:
        yield key("fov_deg")
    else:
        optics = f"{lens.focal_length_mm:g} mm, {lens.columns} pixels of {lens.pixel_pitch_um:g} um"
        yield key("fov_deg", float(f"{lens.field_of_view:.6g}"), f"lens of the header: {optics}")
    yield from (key("boresight_deg"), key("lever_arm_m"))

    table = "irradiance"
    yield from ("", "[irradiance]")
    if not files.irradiance:
        yield key("files", UNKNOWN, "files of the irradiance spectrometer (not needed for radiance)")
    else:
        patterns = [_without_controls(f"{relative(folder)}/*{suffix}") for folder, suffix in files.irradiance]
        yield key("files", patterns[0] if len(patterns) == 1 else patterns)
        yield key("quantity", "irradiance")
        if files.utc_offset_h is None:
            yield key("utc_offset_h", UNKNOWN, "logging PC minus UTC [h], such as -5: no file states it")
        yield key("clock_offset_s", *_clock_offset(files.clock_offsets_s))
        yield from (key("fwhm_nm"), key("mount"))
        table = "alignment"
        yield from ("", "[alignment]", key("apply", "auto"))

    table = "flightlines"
    ids = _folder_ids(files.cubes, relative)
    for cube, cubes in _tables(files.cubes, relative):
        yield from ("", "[[flightlines]]")
        folder_id = ids.get(cube.header.parent)
        is_pattern = cubes.endswith(_RAW_CUBES)
        if folder_id is not None:
            yield f"id = {_quoted(folder_id if is_pattern else f'{folder_id}_{_stem(cube)}')}"
        yield f"cube = {_quoted(cubes)}"
        if is_pattern:
            yield "# every cube has its own frame index; cubes of one recording become one line"
        elif cube.frame_index is not None:
            yield f"frame_index = {_quoted(relative(cube.frame_index))}"
        if cube.navigation is not None:
            yield f"nav = {_quoted(relative(cube.navigation))}"
        if cube.frame_index is None or cube.navigation is None:
            yield key("start_time", UNKNOWN, "UTC of the first line, such as 2021-07-20T17:00:00Z")

    table = "panels"
    yield from ("", "# [[panels]]  # targets of known reflectance in the scene: they scale their line")
    yield '# line = "raw_0"'
    yield from map(key, ("along_track", "cross_track", "reflectance", "uncertainty"))
    for instrument, folder, suffix in files.references:
        yield from ("", "[[references]]", f"instrument = {_quoted(instrument)}")
        yield f"files = {_quoted(f'{relative(folder)}/*{suffix}')}"
    if files.notes:
        yield from ("", "# Files without a use:")
        for note in files.notes:
            yield from textwrap.wrap(note, 100, initial_indent="# * ", subsequent_indent="#   ")
    yield ""


def _clock_offset(offsets: tuple[float, float] | None) -> tuple[float | str, str]:
    # the offset is 0 if the record covers the flight without one, else to be filled in
    if offsets is None or offsets[0] <= 0.0 <= offsets[1]:
        return 0.0, "added to the clock of the logging PC [s]: no file states it, 0 is assumed"
    if offsets[0] > offsets[1]:
        return UNKNOWN, "the record is shorter than the flight: files are missing"
    span = f"{offsets[0]:.0f} to {offsets[1]:.0f} s"
    return UNKNOWN, f"added to the clock of the logging PC: the record covers the flight with {span}"


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
    ids: dict[Path, str] = {}
    for folder in dict.fromkeys(cube.header.parent for cube in cubes):
        stem = re.sub(r"[^A-Za-z0-9]+", "_", relative(folder)).strip("_")[:60] or "flight"
        used_ids = {name.lower() for name in ids.values()}
        # an id has at least two characters and differs from those of other folders
        candidates = (stem, *(f"{stem}_{number}" for number in range(2, len(cubes) + 2)))
        ids[folder] = next(name for name in candidates if len(name) > 1 and name.lower() not in used_ids)
    return ids


def _stem(cube: FlightCube) -> str:
    return cube.header.name.split(".")[0]


def _without_controls(text: str) -> str:
    if any(ord(letter) < 32 for letter in text):
        raise FormatError(
            f"{text!r}: a file name with control characters", mend="rename it", code="name-invalid"
        )
    return text


def _quoted(text: str) -> str:
    return toml_text(_without_controls(text))
