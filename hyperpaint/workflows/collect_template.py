"""The commented ``collect.toml`` of what lies in the folder of a field day.

What no file says, and reflectance depends on, is written as ``"?"``, which `process` refuses by name until it
is filled in.
"""

from __future__ import annotations

import itertools
import os
import re
import textwrap
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

from hyperpaint.base.attitude_conventions import Convention
from hyperpaint.base.errors import FormatError, StoreError
from hyperpaint.base.input_files import read_limited
from hyperpaint.io.files.toml_tables import UNKNOWN

from .field_folder import FieldFolder, FlightCube

_RAW_CUBES = "raw_*[0-9].hdr"
_DECLARED = (
    "roll_positive", "pitch_positive", "heading_positive", "heading_reference", "euler_order",
    "height_reference", "column_order",
)  # fmt: skip


def write_collect_toml(
    found: FieldFolder, path: str | os.PathLike[str] | None = None, *, overwrite: bool = False
) -> Path:
    """Write a commented ``collect.toml`` that names what was found.

    Parameters
    ----------
    found
        See `find_field_files`.
    path
        By default ``collect.toml`` in the folder; paths in it are relative to its own folder.
    overwrite
        Replace a file that is there.

    Returns
    -------
    Path of the file.

    Raises
    ------
    StoreError
        The file is there already, is another than a ``.toml``, or cannot be written.
    """
    from hyperpaint.io.files.publishing import publish_file

    path = found.folder / "collect.toml" if path is None else Path(path)
    if path.exists() and path.suffix.lower() != ".toml":
        raise StoreError(f"{path} is no collect.toml, and stays as it is; choose another path")
    text = "\n".join(_text(found, path.parent))
    publish_file(path, text.encode(), overwrite=overwrite)
    return path


def unknown_keys(path: Path) -> list[str]:
    """Return the lines of a ``collect.toml`` that are still to be filled in."""
    lines = read_limited(path, 1 << 20, "a collect.toml").decode().splitlines()
    return [line.partition("#")[0].strip() for line in lines if f'= "{UNKNOWN}"' in line.partition("#")[0]]


def _text(found: FieldFolder, base: Path) -> Iterator[str]:
    """Yield the file, line by line."""

    def relative(path: Path) -> str:
        return Path(os.path.relpath(path, base)).as_posix()

    yield f"# Written by hyperpaint init from what lies in {found.folder.resolve().name}."
    yield f'# Replace every "{UNKNOWN}"; a key behind # is optional, and says what holds without it.'
    yield ""
    yield "[collect]"
    yield f"name = {_quoted(found.folder.resolve().name)}"
    yield from _camera(found)
    yield ""
    yield "[calibration]"
    if found.sweep is not None:
        yield f"sweep = {_quoted(relative(found.sweep))}  # a lab sweep, calibrated at opening"
    elif found.calibration is not None:
        yield f"path = {_quoted(relative(found.calibration))}"
    else:
        yield f'path = "{UNKNOWN}"  # counts to radiance: made from a lab sweep by hyperpaint calibrate'
    yield ""
    yield "[dark]"
    if found.darks:
        yield f"cubes = [{', '.join(_quoted(relative(path)) for path in found.darks)}]"
    else:
        yield f'cubes = "{UNKNOWN}"  # dark cubes, or "none", or "calibration"'
    yield from _declared()
    yield from _geometry(found, relative)
    yield from _irradiance(found, relative)
    ids = _folder_ids(found.cubes, relative)
    for cube, text in _tables(found.cubes, relative):
        yield from _line(cube, text, ids.get(cube.header.parent), relative)
    yield ""
    yield "# [[panels]]  # of known reflectance in the scene: they scale their line, and are judged"
    yield '# line = "raw_0"  # with along_track = [first, stop], cross_track = [first, stop] and'
    yield '# reflectance = 0.5  # or certificate = "panel.csv"; uncertainty = 0.02; tilt = [angle, azimuth]'
    for instrument, folder, suffix in found.references:
        yield ""
        yield "[[references]]"
        yield f"instrument = {_quoted(instrument)}"
        yield f"files = {_quoted(f'{relative(folder)}/*{suffix}')}"
    if found.notes:
        yield ""
        yield "# Seen, and not used:"
        yield from _comment(found.notes)
    yield ""


def _camera(found: FieldFolder) -> Iterator[str]:
    yield ""
    yield "[camera]"
    yield "bit_depth = 12  # of the converter: 12 in a Nano-Hyperspec"
    yield 'stamp = "end"  # what the stamp of a frame marks of its exposure: start, mid or end'
    if not all(cube.has_exposure for cube in found.cubes):
        yield f'exposure_time_ms = "{UNKNOWN}"  # no settings.txt and no header states it'
    if not all(cube.frame_index for cube in found.cubes):
        yield f'frame_period_ms = "{UNKNOWN}"  # from line to line: there is no frame index for every cube'


def _declared() -> Iterator[str]:
    convention = Convention()
    yield ""
    yield "[navigation]  # only maps depend on it"
    yield "# Makers differ in what their angles mean, and no file says it. This is assumed of a Headwall"
    yield "# imu_gps.txt; hyperpaint.geometry.check_conventions compares it with the picture."
    for name in _DECLARED:
        yield f"{name} = {_quoted(str(getattr(convention, name) or 'left_to_right'))}"


def _geometry(found: FieldFolder, relative: Callable[[Path], str]) -> Iterator[str]:
    yield ""
    yield "[geometry]  # only maps depend on it"
    if found.survey is None:
        yield "# ground = 152.4  # height of the ground above the ellipsoid [m]; no map is made without, or"
        yield '# dem = "dsm.tif"  # heights as a raster, with dem_heights = "ellipsoid" or "geoid" and geoid'
    else:
        yield (
            f"ground = {found.survey.height:.3f}  # m above the ellipsoid: {relative(found.survey.path)}, "
            f"median of {found.survey.points} points within {found.survey.spread:.2f} m"
        )
    lens = found.cubes[0].lens
    if lens is None:
        yield "# fov_deg = 18.9  # between the outer edges of the columns; no map is made without"
    else:
        yield (
            f"fov_deg = {lens.field_of_view:.6g}  # the header's lens of {lens.focal_length_mm:g} mm, "
            f"{lens.columns} pixels of {lens.pixel_pitch_um:g} um"
        )
    yield "# boresight_deg = [0.0, 0.0, 0.0]  # roll, pitch and heading of the camera in the platform"
    yield "# lever_arm_m = [0.0, 0.0, 0.0]  # forward, right and down from the antenna to the camera"


def _irradiance(found: FieldFolder, relative: Callable[[Path], str]) -> Iterator[str]:
    yield ""
    if not found.irradiance:
        yield "[irradiance]"
        yield f'files = "{UNKNOWN}"  # the spectrometer that looked at the sky (not needed for radiance)'
        return
    yield "[irradiance]"
    patterns = [_quoted(f"{relative(folder)}/*{suffix}") for folder, suffix in found.irradiance]
    yield f"files = {patterns[0] if len(patterns) == 1 else '[' + ', '.join(patterns) + ']'}"
    yield 'quantity = "irradiance"'
    if found.utc_offset_h is None:
        yield f'utc_offset_h = "{UNKNOWN}"  # logging PC minus UTC [h], such as -5: no file says it'
    yield _clock_offset(found.clock_offsets_s)
    yield "# fwhm_nm = 3.0  # width of the spectrometer's channels, or [[400, 3.2], [1000, 3.0]]"
    yield '# mount = "ground"  # or "aircraft", where it leans with the camera and is corrected to level'
    yield ""
    yield "[alignment]  # camera and spectrometer compared in flight by the daylight's lines"
    yield 'apply = "auto"  # correct the record where it is significant; or never, or always'


def _clock_offset(offsets: tuple[float, float] | None) -> str:
    """Return the clock's offset: 0 where the record covers the flight with it, else what would be needed."""
    if offsets is None or offsets[0] <= 0.0 <= offsets[1]:
        return "clock_offset_s = 0.0  # added to the clock of the logging PC: no file says it, 0 is assumed"
    if offsets[0] > offsets[1]:
        return f'clock_offset_s = "{UNKNOWN}"  # the record is shorter than the flight: files are missing'
    span = f"{offsets[0]:.0f} to {offsets[1]:.0f} s"
    return (
        f'clock_offset_s = "{UNKNOWN}"  # added to the logging PC: the record covers the flight with {span}'
    )


def _tables(cubes: Sequence[FlightCube], relative: Callable[[Path], str]) -> Iterator[tuple[FlightCube, str]]:
    """Yield a cube of each table, with the cube or the pattern of cubes that it names."""
    for folder, inside in itertools.groupby(cubes, key=lambda cube: cube.header.parent):
        several = list(inside)
        shared = {(cube.navigation, cube.frame_index is None) for cube in several}
        matches = set(folder.glob(_RAW_CUBES)) == {cube.header for cube in several}
        if len(several) > 1 and len(shared) == 1 and matches:
            yield several[0], f"{relative(folder)}/{_RAW_CUBES}"
        else:
            yield from ((cube, relative(cube.header)) for cube in several)


def _folder_ids(cubes: Sequence[FlightCube], relative: Callable[[Path], str]) -> dict[Path, str]:
    """Return what the lines of each folder are called by; nothing where no two cubes have the same name."""
    stems = [_stem(cube).lower() for cube in cubes]
    if len(set(stems)) == len(stems):
        return {}
    ids: dict[Path, str] = {}
    for folder in dict.fromkeys(cube.header.parent for cube in cubes):
        own = re.sub(r"[^A-Za-z0-9]+", "_", relative(folder)).strip("_")[:60] or "flight"
        taken = {each.lower() for each in ids.values()}
        # two letters at the least, and a name of no other folder
        endings = ("", *(f"_{number}" for number in range(2, len(cubes) + 2)))
        ids[folder] = next(
            own + end for end in endings if len(own + end) > 1 and (own + end).lower() not in taken
        )
    return ids


def _stem(cube: FlightCube) -> str:
    return cube.header.name.split(".")[0]


def _line(
    cube: FlightCube, text: str, folder_id: str | None, relative: Callable[[Path], str]
) -> Iterator[str]:
    yield ""
    yield "[[flightlines]]"
    if folder_id is not None:
        yield f"id = {_quoted(folder_id if text.endswith(_RAW_CUBES) else f'{folder_id}_{_stem(cube)}')}"
    yield f"cube = {_quoted(text)}"
    if text.endswith(_RAW_CUBES):
        yield "# each with its own frame index; cubes that go on where the one before ended are one line"
    elif cube.frame_index is not None:
        yield f"frame_index = {_quoted(relative(cube.frame_index))}"
    if cube.navigation is not None:
        yield f"nav = {_quoted(relative(cube.navigation))}"
    if cube.frame_index is None or cube.navigation is None:
        yield f'start_time = "{UNKNOWN}"  # UTC of the first line, such as 2021-07-20T17:00:00Z'


def _comment(notes: Iterable[str]) -> Iterator[str]:
    for note in notes:
        yield from textwrap.wrap(note, 100, initial_indent="# * ", subsequent_indent="#   ")


def _quoted(text: str) -> str:
    """Return a TOML basic string."""
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    if any(ord(letter) < 32 for letter in escaped):
        raise FormatError(f"{text!r}: a name with control characters; rename it")
    return f'"{escaped}"'
