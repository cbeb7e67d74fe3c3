"""Files beside the cubes: of a Headwall flight, calibration stores, lab sweeps.

Calibration stores have `radiance_gain` and the spectral axis of an imager.

Lab sweeps as tables in CSV: counts in the table, or in cubes that its rows name.

Side files of a Headwall flight folder: settings, frame index, header comments, dark cubes.

A flight consists of cubes ``raw_<N>``, where N is the number of the cube's first frame; the frame numbers of
``frameIndex_<N>.txt`` are absolute. The vendor publishes no description of these files: the supported
variants are from public code (Nano-Hyperspec with APX-15, its older software, TERRA-REF).
"""

import csv
import difflib
import functools
import json
import os
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from hyperpaint.base import (
    ALONG_TRACK,
    BAND,
    CHUNK_LINES,
    CROSS_TRACK,
    CUBE,
    ELEMENT,
    MAX_STRAY_LIGHT_U,
    SRF_SHAPES,
    STEP,
    SWEEP_VARIABLES,
    VARIABLES,
    Floats,
    FormatError,
    PaintError,
    Problem,
    Problems,
    SchemaError,
    TimeError,
    UnitsError,
    conversion_factor,
    convert,
    dtype_of,
    input_path,
    label,
    one_of,
    warn_if,
    warn_user,
)
from hyperpaint.base.schema import with_steps
from hyperpaint.io.envi.envi_cubes import open_envi
from hyperpaint.io.files.reading import (
    Table,
    decoded_text,
    load_netcdf,
    name_rows,
    number,
    read_limited_text,
    read_table,
    read_text,
    refuse,
    to_integers,
)
from hyperpaint.io.store import (
    is_zarr,
    list_groups,
    load_group,
    open_unverified,
)

_MAX_FRAME = 1 << 40
_SECOND_US = 1_000_000
DAY_US = 86_400 * _SECOND_US
_TIME_OF_DAY = re.compile(r"(\d{1,2}):(\d{2}):(\d{2})(?: +(\d{1,6})|\.(\d{1,6})\d*)?")
_EXPOSURE = re.compile(r"(?:exposure|integration)(?: time)? *\(([^()]*)\)", re.IGNORECASE)
#: Keys of the exposure (ms without a unit) and of the frame rate [Hz] in headers of Specim and Resonon.
_EXPOSURE_KEY, _RATE_KEYS = re.compile(r"(?:tint|shutter) ?(?:\((.*)\))?"), ("fps", "framerate")
_CUBE_NUMBER = re.compile(r"raw_(\d{1,12})", re.IGNORECASE)
_SPECIM_DATE = re.compile(r"DATE\(yyyy-mm-dd\): *(\d{4}-\d{2}-\d{2})")
_SPECIM_TIME = re.compile(r"UTC TIME: *(\d{2}:\d{2}:\d{2}(?:\.\d+)?)")
_FRAME_INDEX = re.compile(r"frameindex_?(\d{0,12})\.txt", re.IGNORECASE)
_IMU_GPS = re.compile(r".*imu.*gps.*\.txt", re.IGNORECASE)


# --- settings ----------------------------------------------------------------------------------------------


def read_settings(path: str | Path) -> dict[str, str]:
    # Return the values of all lines ``key = value`` in ``settings.txt`` by key.
    #
    # Raises `FormatError`: The file is unreadable, binary or too large.
    pairs = (line.partition("=") for line in read_text(Path(path)).split("\n"))
    return {key.strip(): value.strip() for key, sign, value in pairs if sign and key.strip()}


def exposure_seconds(pairs: Mapping[str, str], source: str) -> float | None:
    """Return the exposure [s] from ``Exposure (ms)`` or a similar key; None without such a key.

    ``pairs``: from `read_settings`, or the comment lines of a header; ``source``: their name in messages.

    Raises `FormatError`: The value is not a positive number, or several keys contradict one another.

    Examples
    --------
    >>> exposure_seconds({"Exposure (ms)": "5.0"}, "settings.txt")
    0.005
    """
    exposures: dict[str, float] = {}
    for key, text in pairs.items():
        match = _EXPOSURE.fullmatch(" ".join(key.split()))
        if match is None:
            continue
        with FormatError.instead_of(
            (ValueError, UnitsError),
            f"{source}: {key} = {text[:40]!r}",
            expected="a number, and a unit of time in the brackets",
            code="number-unreadable",
        ):
            # a decimal comma, which is not that of thousands
            amount = float(re.sub(r"^(\d+),(?!\d{3}$)(\d+)$", r"\1.\2", text))
            value = float(f"{amount * conversion_factor(match[1].strip(), 's'):.12g}")
        FormatError.raise_if(
            not (np.isfinite(value) and value > 0),
            f"{source}: {key} = {text}",
            expected="a positive exposure",
            code="value-out-of-range",
        )
        exposures[key] = value
    stated = ", ".join(f"{key} = {pairs[key]}" for key in exposures)
    FormatError.raise_if(
        len(set(exposures.values())) > 1,
        f"{source}: contradictory exposures {stated}",
        code="exposure-conflict",
    )
    return next(iter(exposures.values()), None)


def lens_lengths(pairs: Mapping[str, str]) -> tuple[float, float] | None:
    # Return focal length [mm] and pixel pitch [um] from the comment lines of a header, if stated.
    #
    # None also where pixels are binned, since the binned axis is unknown.
    plain = {" ".join(key.split()).lower(): text for key, text in pairs.items()}
    if any(text.strip() != "1" for key, text in plain.items() if key.endswith(" binning")):
        return None
    try:
        lengths = float(plain["lens efl (mm)"]), float(plain["array pixel pitch (um)"])
    except (KeyError, ValueError):
        return None
    return lengths if all(np.isfinite(length) and length > 0 for length in lengths) else None


def exposure_sources(cube: Path | None, opened: xr.Dataset) -> Iterator[tuple[str, Mapping[str, str]]]:
    # Yield the sources of a cube's exposure: ``settings.txt`` beside it, the header's comments, its keys.
    if cube is not None:
        # ``settings.txt``, or ``<id>_settings.txt`` of ``<id>_raw``
        stem = cube.name.split(".")[0]
        names = [f"{stem.removesuffix('_raw')}_settings.txt"] if stem.endswith("_raw") else []
        files = (cube.parent / name for name in (*names, "settings.txt"))
        settings = next((file for file in files if file.is_file()), None)
        if settings is not None:
            yield "settings.txt", read_settings(settings)
    yield "header comments", json.loads(opened.attrs.get("envi_comments", "{}"))
    fields = json.loads(opened.attrs.get("envi_header", "{}"))
    matches = (_EXPOSURE_KEY.fullmatch(key) for key in sorted(fields, reverse=True))
    if match := next(filter(None, matches), None):
        value, _, unit = fields[match[0]].partition(" ")
        yield "header", {f"exposure ({match[1] or unit.strip() or 'ms'})": value}


def recording_clock(opened: xr.Dataset) -> tuple[str | None, float | None]:
    """Return UTC of the first line and period of the lines [s] that the header of a line scanner states.

    Examples
    --------
    >>> fields = {"acquisition date": "DATE(yyyy-mm-dd): 2024-06-14", "start time": "UTC TIME: 09:47:35"}
    >>> recording_clock(xr.Dataset(attrs={"envi_header": json.dumps({**fields, "fps": "50.00"})}))
    ('2024-06-14T09:47:35Z', 0.02)
    """
    fields = json.loads(opened.attrs.get("envi_header", "{}"))
    day = _SPECIM_DATE.fullmatch(fields.get("acquisition date", ""))
    clock = _SPECIM_TIME.fullmatch(fields.get("start time", ""))
    rate = next((fields[key] for key in _RATE_KEYS if key in fields), "")
    is_rate = re.fullmatch(r"\d+(\.\d*)?", rate) is not None and float(rate) > 0
    return f"{day[1]}T{clock[1]}Z" if day and clock else None, 1.0 / float(rate) if is_rate else None


def find_exposure(
    exposure_time: Any, cube: Path | None, name: str, opened: xr.Dataset, *, required: bool
) -> tuple[NDArray[np.float64] | None, str]:
    # Return the exposure [s] and its source: the argument, ``settings.txt``, or the header.
    argument = None if exposure_time is None else np.asarray(exposure_time, np.float64)
    if argument is not None:
        lines = opened.sizes.get(ALONG_TRACK, argument.size)
        refuse(
            name,
            (
                argument.ndim > 1 or (argument.ndim == 1 and argument.size != lines),
                Problem(
                    f"exposure_time has shape {argument.shape}",
                    expected=f"a scalar or {lines} lines",
                    code="length-mismatch",
                ),
            ),
            (
                not (np.isfinite(argument).all() and (argument > 0).all()),
                Problem(
                    f"exposure_time {np.min(argument, initial=np.inf) * 1000.0:g} ms",
                    expected="a positive number",
                    code="value-out-of-range",
                ),
            ),
            error=SchemaError,
        )
    stated: dict[str, float] = {}
    for source, pairs in exposure_sources(cube, opened):
        try:
            value = exposure_seconds(pairs, f"{name}: {source}")
        except FormatError:
            if argument is None:
                raise
            continue
        if value is not None:
            stated[source] = value
    stated_text = ", ".join(f"{source} {value * 1e3:g} ms" for source, value in stated.items())
    if argument is not None:
        if any(not np.allclose(argument, value, rtol=1e-6, atol=0) for value in stated.values()):
            used = f"exposure_time {argument.flat[0] * 1e3:g} ms is used"
            warn_user(f"{name}: {used}; {stated_text}", "exposure-conflict")
        return argument, "given"
    if stated:
        source, value = next(iter(stated.items()))
        warn_if(
            len(set(stated.values())) > 1, f"{name}: {stated_text}; the first is used", "exposure-conflict"
        )
        return np.array(value), source
    # with an unreadable header, the exposure is not a problem of its own
    SchemaError.raise_if(
        required and opened.sizes,
        f"{name}: no exposure in settings.txt beside the cube, or in the header (comments, tint, shutter)",
        mend="pass exposure_time= [s] (in collect.toml: exposure_time_ms)",
        code="exposure-missing",
    )
    return None, ""


# --- frame index -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class FrameIndex:
    # Frame numbers and time stamps of recorded lines.
    name: str  #: File name, for messages.
    frame: NDArray[np.int64]  #: (row,): Absolute frame numbers, strictly increasing.
    stamp: NDArray[np.int64]  #: (row,): Microseconds of the clock, strictly increasing.
    #: ``"instrument"``: the clock of ``Timestamp`` in ``imu_gps.txt``; ``"time of day"``: since midnight of
    #: the first row's day on the recording computer.
    clock: Literal["instrument", "time of day"]
    fitted: bool = False  #: Whether the stamps are from a straight line fit to whole seconds.


def read_frame_index(path: str | Path) -> FrameIndex:
    # Read ``frameIndex_<N>.txt`` with any of three kinds of time stamps.
    #
    # ``Timestamp`` in microseconds of the instrument's clock; or ``Time`` as ``HH:MM:SS <microseconds>`` of
    # the recording computer; or ``HH:MM:SS``, whole seconds, which are replaced by a straight line fit over
    # the frame numbers, since a pushbroom camera records at a steady rate.
    #
    # Raises `FormatError`: The file is not a frame index, or cells do not fit the header. Raises `TimeError`:
    # Stamps repeat or decrease, or whole seconds fit no steady rate.
    table = read_table(path, "frame index", needs=["frame#"])
    second_column = next((column for column in table.columns if column != "frame#"), "")
    name = next((name for name in ("timestamp", "time") if name in table.columns), second_column)
    FormatError.raise_if(
        not name,
        f"{path}: one column only",
        expected="'Frame#' and 'Timestamp' or 'Time'",
        code="column-missing",
    )
    frame = to_integers(table, "frame#")
    steps = np.flatnonzero(np.diff(frame) <= 0)
    rows = table.rows[steps + 1] if steps.size else table.rows[:1]
    FormatError.raise_if(
        steps.size or frame[0] < 0 or frame[-1] > _MAX_FRAME,
        f"{path}: frame numbers repeat, decrease or are out of range in {name_rows(rows)}",
        code="frame-unordered",
    )
    if ":" not in table.columns[name][0]:
        stamp = to_integers(table, name)
        check_increasing(stamp, table.rows, f"{path}: column {name!r}")
        return FrameIndex(table.name, frame, stamp, "instrument")
    stamp, whole_seconds = time_of_day(table, name)
    if not whole_seconds or len(stamp) < 2:
        check_increasing(stamp, table.rows, f"{path}: column {name!r}")
        return FrameIndex(table.name, frame, stamp, "time of day")
    # stamps on a straight line over the frame numbers, fitted to whole seconds
    TimeError.raise_if(
        len(np.unique(stamp)) < 3,
        f"{path}: fewer than three different seconds",
        mend="pass start_time= and frame_period=",
        code="frame-rate-unknown",
    )
    x = (frame - frame[0]).astype(np.float64)
    y = (stamp - stamp[0]) + 0.5 * _SECOND_US  # truncation reduces a stamp by half a second on average
    slope, offset = np.polyfit(x, y, 1)
    TimeError.raise_if(
        slope <= 0 or np.abs(y - (offset + slope * x)).max() > 0.75 * _SECOND_US,
        f"{path}: the whole seconds fit no steady frame rate",
        code="frame-rate-unknown",
    )
    fitted: NDArray[np.int64] = stamp[0] + np.round(offset + slope * x).astype(np.int64)
    return FrameIndex(table.name, frame, fitted, "time of day", fitted=True)


def check_increasing(stamp: NDArray[np.int64], rows: NDArray[np.int64], subject: str) -> None:
    # Raise a `TimeError` about the rows whose stamp does not exceed the previous stamp.
    faulty_rows = rows[1:][np.diff(stamp) <= 0]
    TimeError.raise_if(
        faulty_rows.size,
        f"{subject} repeats or decreases in {name_rows(faulty_rows)}",
        mend="delete or reorder these rows",
        code="time-unordered",
    )


def time_of_day(table: Table, name: str) -> tuple[NDArray[np.int64], bool]:
    # Return microseconds since midnight of the first row's day, and whether all are full seconds.
    micros_of_day = np.empty(len(table.rows), np.int64)
    faulty_rows: list[int] = []
    whole_seconds = True
    for place, cell in enumerate(table.columns[name]):
        match = _TIME_OF_DAY.fullmatch(cell.strip())
        if match is None or int(match[1]) > 23 or int(match[2]) > 59 or int(match[3]) > 60:
            faulty_rows.append(int(table.rows[place]))
            continue
        hours, minutes, seconds, micros, fraction = match.groups()
        whole_seconds = whole_seconds and micros is None and fraction is None
        seconds_of_day = (int(hours) * 60 + int(minutes)) * 60 + int(seconds)
        below_second = int(micros) if micros is not None else int((fraction or "0").ljust(6, "0"))
        micros_of_day[place] = seconds_of_day * _SECOND_US + below_second
    FormatError.raise_if(
        faulty_rows,
        f"{table.name}: column {name!r} is unreadable in {name_rows(faulty_rows)}",
        expected="'HH:MM:SS microseconds'",
        code="time-unreadable",
    )
    # a decrease by more than half a day is midnight
    days = np.concatenate([[0], np.cumsum(np.diff(micros_of_day) < -DAY_US // 2)])
    return micros_of_day + days * DAY_US, whole_seconds


def cube_number(cube: Path) -> int | None:
    # Return N of ``raw_<N>``, the number of the cube's first frame, or None.
    match = _CUBE_NUMBER.fullmatch(cube.name.split(".")[0])
    return int(match[1]) if match else None


def frame_index_beside(cube: Path) -> Path | None:
    # Return the last frame index in the folder of a cube that begins at or before its first frame.
    # renamed files: raw_a has frameIndex_a.txt
    own = f"frameindex_{cube.name.split('.')[0].partition('_')[2]}.txt".lower()
    for path in cube.parent.iterdir():
        if path.name.lower() == own:
            return path
    matches = [match for path in cube.parent.iterdir() if (match := _FRAME_INDEX.fullmatch(path.name))]
    files = {int(match[1] or 0): cube.with_name(match[0]) for match in matches}
    first_frame = cube_number(cube)
    if first_frame is None:
        return next(iter(files.values())) if len(files) == 1 else None
    earlier = ((number, path) for number, path in files.items() if number <= first_frame)
    return max(earlier, default=(0, None))[1]


def navigation_beside(cube: Path) -> Path | None:
    # Return the only ``imu_gps.txt`` in the folder of a cube, or in the parent folder.
    for folder in (cube.parent, cube.parent.parent):
        records = [path for path in folder.iterdir() if _IMU_GPS.fullmatch(path.name)]
        if records:
            return records[0] if len(records) == 1 else None
    return None


def match_frames(
    index: FrameIndex, lines: int, cube: Path, *, shortened: bool = False
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    # Return the frame number and the row of the index of each line of a cube.
    #
    # ``index``: frame index of the cube, or of the complete flight; ``lines``: lines of the cube; ``cube``:
    # its path, whose name ``raw_<N>`` and neighbours determine the rows of the cube in an index of the
    # complete flight; ``shortened``: whether the file was cut short, so that it may have fewer lines than
    # rows.
    #
    # Returns frame numbers (along_track,), and rows of the index (along_track,), -1 for a dropped frame.
    #
    # Raises `FormatError`: The number of lines is neither that of the rows nor that of the frames.
    first_frame, last_frame, rows = int(index.frame[0]), int(index.frame[-1]), len(index.frame)
    # first row, number of rows, first frame and one past the last: of the index, then of the cube in it
    ranges = [(0, rows, first_frame, last_frame + 1)]
    number = cube_number(cube)
    if number is not None and first_frame <= number <= last_frame:
        numbers = [cube_number(path) for path in cube.parent.glob("raw_*.hdr")]
        end_frame = min((n for n in numbers if n is not None and n > number), default=last_frame + 1)
        start, stop = np.searchsorted(index.frame, [number, end_frame])
        ranges.append((int(start), int(stop - start), number, end_frame))
    for start, length, begin, end in ranges:
        # a line for every row
        if lines == length or (shortened and lines < length == end - begin):
            row = np.arange(start, start + lines)
            return index.frame[row], row
        # a line for every frame number, blank for a dropped frame
        if lines == end - begin and length:
            frame = np.arange(begin, end)
            row = np.full(lines, -1)
            row[index.frame[start : start + length] - begin] = np.arange(start, start + length)
            return frame, row
    raise FormatError(
        (
            f"{cube.name} has {lines} lines, {index.name} has {rows} rows, frames {first_frame} to "
            f"{last_frame} ({last_frame - first_frame + 1} by number)"
        ),
        expected="as many lines as rows, or as frames",
        mend=(
            "pass the frame index of this cube, or keep_whole_lines=True for a cube cut short in flight "
            "(in collect.toml: keep_whole_lines = true)"
        ),
        code="frame-index-mismatch",
    )


# --- dark cubes --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class DarkFrames:
    # Exact sums over the lines of one cube of a dark or of a white tile.

    lines: int  #: Number of lines.
    # integers, so that the sums do not depend on the order of addition
    total: NDArray[np.uint64]  #: (band, cross_track): Sum of the counts.
    squares: NDArray[np.uint64]  #: (band, cross_track): Sum of the squared counts.
    maximum: NDArray[Any]  #: (band, cross_track): Highest count.
    line_mean: NDArray[np.float64]  #: (along_track,): Mean count of every line.

    @property
    def mean(self) -> NDArray[np.float64]:
        # Mean dark count, (band, cross_track).
        return self.total / np.float64(self.lines)

    @property
    def variance(self) -> NDArray[np.float64]:
        # Variance over the lines with n - 1 in the denominator, (band, cross_track).
        spread = self.squares.astype(np.float64) - self.total.astype(np.float64) * self.mean
        return np.maximum(spread, 0.0) / (self.lines - 1)


def sum_dark(counts: xr.DataArray, subject: str) -> DarkFrames:
    # Sum the lines of a cube in blocks of lines.
    # ``counts``: raw counts (along_track, band, cross_track), lazily indexed; ``subject``: name of the cube
    # in messages, such as "dark raw_0".
    # Raises `FormatError`: The counts are not a cube of whole numbers from 0 to 65535 with at least one line.
    Problems(f"{subject} cannot serve as {subject.partition(' ')[0]} reference", FormatError).raise_if_any(
        (
            counts.dims != CUBE,
            Problem(f"dims {tuple(map(str, counts.dims))}", expected=str(CUBE), code="dims-wrong"),
        ),
        (counts.dims == CUBE and not counts.size, Problem("the cube has no lines", code="empty-input")),
        (
            counts.dtype.kind not in "uif",
            Problem(f"dtype {counts.dtype}", expected="raw counts of 8 or 16 bits", code="type-wrong"),
        ),
    )
    is_raw = counts.dtype.kind == "u" and counts.dtype.itemsize <= 2
    shape = counts.shape[1:]
    total, squares = np.zeros(shape, np.uint64), np.zeros(shape, np.uint64)
    maximum, line_means = np.zeros(shape, counts.dtype if is_raw else np.uint16), []
    for start in range(0, counts.shape[0], CHUNK_LINES):
        slab: NDArray[Any] = counts[start : start + CHUNK_LINES].to_numpy()
        if not is_raw:  # counts after where(), arithmetic or netCDF
            values, slab = slab, np.clip(np.nan_to_num(slab), 0, 65535).astype(np.uint16)
            FormatError.raise_if(
                (values != slab).any(),
                f"{subject}: {counts.dtype} with missing, negative or broken values, or above 65535",
                expected="raw counts of 8 or 16 bits",
                mend="pass the cube as it was opened; select lines by isel(along_track=...), not by where()",
                code="value-out-of-range",
            )
        total += slab.sum(axis=0, dtype=np.uint64)
        squares += np.square(slab, dtype=np.uint64).sum(axis=0)
        maximum = np.maximum(maximum, slab.max(axis=0))
        line_means.append(slab.mean(axis=(1, 2), dtype=np.float64))
    return DarkFrames(int(counts.shape[0]), total, squares, maximum, np.concatenate(line_means))


#: Maximum size of a table [byte]; larger sweeps are cubes, or a Zarr store.
_MAX_BYTES = 64 << 20
_MAX_SHOWN = 8
_HEADING = re.compile(r"^\s*(.*?)\s*(?:\[([^\]]*)\])?\s*$")
_WIDE = re.compile(r"column (\d+)")
#: Columns of a step; a row without any of `_LIGHT` is of a dark.
_LIGHT = ("step_wavelength", "flux", "level")
_OF_STEP = (
    *_LIGHT, "exposure_time", "monochromator_fwhm", "capture_fraction", "etendue", "frame_count",
    "dark_frame_count", "saturation_count", "electrons_per_count", "read_noise",
)  # fmt: skip
#: Units of columns without one.
_ASSUMED = {unit: unit for unit in ("1", "count", "electron count-1")}
_DIMS = (STEP, *ELEMENT)


def read_sweep_table(path: Path) -> xr.Dataset:
    # Return a lab sweep from a table in CSV, see docs/formats/lab_sweep.md; lazily from cubes.
    #
    # Raises `FormatError`: Headings, units or cells cannot be read, or elements are missing; all are listed
    # with row and column.
    problems = Problems(f"{path} is not a table of a lab sweep", FormatError)
    text = read_limited_text(path, _MAX_BYTES, "a table of a lab sweep", mend="name cubes in a column 'cube'")
    numbered = [
        (n, line)
        for n, line in enumerate(decoded_text(text).splitlines(), 1)
        if line.strip(' \t,;"') and not line.startswith("#")
    ]
    separator = max(",;\t", key=numbered[0][1].count) if numbered else ","
    cells = list(csv.reader((line for _, line in numbered), delimiter=separator)) or [[]]
    headings = [_HEADING.findall(cell.replace("\n", " "))[0] for cell in cells[0]]
    # factors from units of the columns to those of the variables of a sweep
    factors = {}
    known = (*_OF_STEP, "counts", *ELEMENT, "cube")
    ignored: dict[int, str] = {}
    for k, (name, unit) in enumerate(headings):
        if name in SWEEP_VARIABLES:
            wanted = SWEEP_VARIABLES[name].units
            try:
                factors[name] = conversion_factor(unit or _ASSUMED.get(wanted, ""), wanted)
            except UnitsError:
                problems.add(
                    f"column {name!r} has {f'the unit {unit!r}' if unit else 'no unit'}",
                    expected=f"a unit such as [{wanted}]",
                    mend=f"write {name} [{wanted}]",
                    code="units-unknown",
                )
        elif name not in known and not _WIDE.fullmatch(name):
            # a spreadsheet leaves empty columns, pandas a first column of row numbers
            texts = [row[k].strip() for row in cells[1:] if k < len(row)]
            is_blank = not any(texts) or (k == 0 and texts == [str(n) for n in range(len(texts))])
            close = difflib.get_close_matches(name.lower(), known, 1)
            if (name or is_blank) and not close:
                ignored[k] = name
                continue
            problems.add(
                f"unknown column {name!r}",
                expected=", ".join((*known, "column 0 ...")),
                mend=f"did you mean {close[0]!r}?" if close else "",
                code="column-unknown",
            )
    columns = {name: k for k, (name, _) in enumerate(headings) if k not in ignored}
    wide = [name for name in columns if _WIDE.fullmatch(name)]
    of_elements = BAND in columns and (bool(wide) or {"counts", CROSS_TRACK} <= set(columns))
    problems.raise_if_any(
        (
            ("cube" in columns) == of_elements
            or "exposure_time" not in columns
            or len(columns) + len(ignored) < len(headings),
            Problem(
                f"columns {', '.join(name for name, _ in headings)[:200]}",
                expected="each once: exposure_time; cube, or band, cross_track, counts, or band, column 0...",
                code="column-missing",
            ),
        ),
    )
    unknown = ", ".join(repr(name[:40]) for name in ignored.values() if name)
    warn_if(unknown, f"{path}: unknown columns {unknown} are ignored", "column-unknown")
    # counts, or cubes, by the values of a step: all rows with these values are of one step
    steps: dict[tuple[float, ...], dict[tuple[float, float], Any]] = {}
    of_step = [name for name in _OF_STEP if name in columns]
    for (line, _), row in zip(numbered[1:], cells[1:], strict=True):
        problems.add_if(
            len(row) != len(headings),
            f"row {line}: {len(row)} cells",
            expected=f"{len(headings)}, as in the heading",
            code="row-unreadable",
        )
        if len(row) == len(headings):
            if separator == ";":  # spreadsheets of languages with a decimal comma
                name_of_cube = columns.get("cube")
                row = [cell if k == name_of_cube else cell.replace(",", ".") for k, cell in enumerate(row)]
            values = {
                name: _cell(row, k, line, cells[0], problems) * factors.get(name, 1.0)
                for name, k in columns.items()
                if name != "cube"
            }
            key = tuple(values[name] if values[name] == values[name] else -1.0 for name in of_step)
            counts = steps.setdefault(key, {})
            # the only element of a cube is its name
            across: list[tuple[float, Any]] = [(float(name[7:]), values[name]) for name in wide]
            if not wide:
                across = [
                    (values.get(CROSS_TRACK, 0.0), values.get("counts", row[columns.get("cube", 0)].strip()))
                ]
            for column, value in across:
                at = (values.get(BAND, 0.0), column)
                problems.add_if(
                    not all(n == n and n >= 0 and n == int(n) for n in at) or at in counts,
                    f"row {line}: band {at[0]:g}, column {at[1]:g}{' again' * (at in counts)}",
                    expected="whole numbers from 0, each element, or one cube, once a step",
                    code="row-duplicate",
                )
                counts[at] = value
        if len(problems) >= _MAX_SHOWN:
            problems.raise_if_any()
    problems.raise_if_any()
    arrays = {}
    for key, counts in steps.items():
        stated = (f"{name} {value:g}" for name, value in zip(of_step, key, strict=True) if value >= 0)
        with problems.noting(FormatError):
            is_cube = "cube" in columns
            arrays[key] = _cube(path.parent / counts[0, 0]) if is_cube else _array(", ".join(stated), counts)
    shapes = {array.shape[1:] for array in arrays.values()}
    problems.raise_if_any(
        (
            len(shapes) > 1,
            Problem(
                f"steps of {' and '.join(map(str, sorted(shapes)))} bands and columns",
                expected="one size",
                code="shape-mismatch",
            ),
        ),
    )
    return _sweep(of_step, arrays, problems, has_frames="cube" in columns)


def _cell(row: list[str], k: int, line: int, heading: list[str], problems: Problems) -> float:
    value = number(row[k])
    problems.add_if(
        value is None,
        f"row {line}, column {heading[k].strip()!r}: {row[k][:40]!r}",
        expected="a number, or an empty cell",
        code="number-unreadable",
    )
    return np.nan if value is None else value


def _cube(path: Path) -> xr.DataArray:
    # frames (frame, band, cross_track) of a cube
    with FormatError.instead_of(
        (PaintError, OSError, KeyError),
        f"cube {path.name!r}: $whole",
        expected="an ENVI cube of counts",
        code="cube-missing",
    ):
        counts = open_envi(path, unsaid="counts")["counts"].reset_coords(drop=True).drop_attrs()
    return counts.chunk({ALONG_TRACK: CHUNK_LINES}).rename({ALONG_TRACK: "frame"})


def _array(step: str, counts: Mapping[tuple[float, float], float]) -> xr.DataArray:
    # counts (frame, band, cross_track) of a step, by band and column
    bands, columns = (int(max(at[axis] for at in counts)) + 1 for axis in (0, 1))
    FormatError.raise_if(
        len(counts) != bands * columns,
        f"the step with {step} has {len(counts)} counts",
        expected=f"{bands} bands times {columns} columns",
        code="shape-mismatch",
    )
    return xr.DataArray(
        np.array(
            [[[counts[band, column] for column in range(columns)] for band in range(bands)]], np.float32
        ),
        dims=("frame", *ELEMENT),
    )


def _sweep(
    names: list[str],
    arrays: Mapping[tuple[float, ...], xr.DataArray],
    problems: Problems,
    *,
    has_frames: bool,
) -> xr.Dataset:
    # light and darks by their keys, in the order of wavelengths
    light = [k for k, name in enumerate(names) if name in _LIGHT]
    exposure = names.index("exposure_time")
    lit = sorted(key for key in arrays if any(key[k] > 0 for k in light))
    darks = [key for key in arrays if key not in set(lit)]
    problems.raise_if_any(
        (
            not lit or not darks,
            Problem(
                f"{len(lit)} steps with light and {len(darks)} darks",
                expected=f"both; a dark has no {', '.join(names[k] for k in light)}",
                code="dark-missing",
            ),
        ),
    )
    sweep = xr.Dataset()
    for name, values in zip(names, np.where(np.array(lit) < 0, np.nan, lit).T, strict=True):
        is_constant = name not in _LIGHT and (values == values[0]).all()
        sweep[name] = ((), values[0]) if is_constant else (STEP, values)
    # of every step the dark at the nearest exposure; a single dark is that of all steps
    nearest = [min(darks, key=lambda dark: abs(dark[exposure] - key[exposure])) for key in lit]
    shared = {STEP: 0} if len(set(nearest)) == 1 else {}
    for prefix, keys in (("", lit), ("dark_", nearest)):
        frames = [arrays[key].astype(np.float32) for key in keys]
        sweep[f"{prefix}counts"] = xr.concat([cube.mean("frame") for cube in frames], STEP)
        if has_frames:
            sweep[f"{prefix}frame_count"] = STEP, [cube.sizes["frame"] for cube in frames]
            if not prefix and min(cube.sizes["frame"] for cube in frames) > 1:
                sweep["counts_variance"] = xr.concat([cube.var("frame", ddof=1) for cube in frames], STEP)
    sweep["dark_exposure_time"] = STEP, [dark[exposure] for dark in nearest]
    for name in ("dark_counts", "dark_exposure_time"):
        sweep[name] = sweep[name].isel(shared)
    for name in map(str, sweep.variables):
        sweep[name].attrs = {"units": SWEEP_VARIABLES[name].units}
    return sweep.transpose(*_DIMS, missing_dims="ignore")


# --- tables of a sweep -------------------------------------------------------------------------------------

#: Required and optional variables of a calibration; `hyperpaint.base.schema` has their units and dims.
_REQUIRED = ("radiance_gain", "wavelength", "fwhm")
_OPTIONAL = (
    "wavelength_shift",
    "band_spacing",
    "good",
    "dark_counts",
    "dark_exposure_time",
    "saturation_count",
    "electrons_per_count",
    "read_noise",
    "look_angle",
    "masked",
)
#: Further variables of a lab calibration; only their units and dims are checked. In their names ``line`` is a
#: lamp line.
_SWEEP_RESULTS = (
    "radiance_gain_u_random",
    "radiance_gain_u_systematic",
    "wavelength_u",
    "irradiance_u_systematic",
    "dark_bias",
    "dark_rate",
    "flat_field",
    "responsivity",
    "quantum_efficiency",
    "linearity_counts",
    "linear_counts",
    "linearity_basis",
    "linearity_map",
    "linearity_u",
    "stray_light",
    "stray_light_across",
    "stray_light_u",
    "band_shift_time",
    "step_wavelength",
    "line_band",
    "line_centre",
    "line_fwhm",
    "line_own_fwhm",
    "line_amplitude",
    "line_area",
    "line_covariance",
    "line_trusted",
    "beam_centre",
    "beam_fwhm",
    "out_of_band",
    "second_order",
)
#: Variables of tabulated line shapes.
_TABULATED = ("srf_offset", "srf")


#: Rule of the values by variable: test of the array, fault, expected, and code of the error.
_VALUE_RULES: Mapping[str, tuple[Callable[[Floats], Any], str, str, str]] = {
    # ultraviolet to thermal infrared: micrometres lie below
    "wavelength": (
        lambda v: ((v > 150.0) & (v < 50_000.0)).all(), "is not in nanometres", "150 to 50000 nm",
        "wavelength-range",
    ),
    **dict.fromkeys(
        ("fwhm", "band_spacing", "saturation_count", "electrons_per_count"),
        (lambda v: np.isfinite(v).all() and (v > 0).all(), "is not finite and positive everywhere", "",
         "value-out-of-range"),
    ),
    "wavelength_shift": (
        lambda v: np.isfinite(v).all() and (np.abs(v) < 100.0).all(),
        "is not finite and below 100 nm everywhere", "", "value-out-of-range",
    ),
    "look_angle": (
        lambda v: np.isfinite(v).all() and (np.abs(v) < 90.0).all(),
        "is not finite and below 90 degrees everywhere", "", "value-out-of-range",
    ),
    **dict.fromkeys(
        (
            "radiance_gain_u_random", "radiance_gain_u_systematic", "wavelength_u", "irradiance_u_systematic",
        ),
        (lambda v: not (v < 0).any(), "has negative values", "a standard uncertainty", "value-out-of-range"),
    ),
    "read_noise": (
        lambda v: not np.isinf(v).any() and not (v < 0).any(),  # NaN where unknown
        "is not finite and at least zero everywhere", "", "value-out-of-range",
    ),
    "srf": (
        lambda v: np.isfinite(v).all() and (v >= 0).all(),
        "is not finite and at least zero everywhere", "", "value-out-of-range",
    ),
    "srf_offset": (
        lambda v: np.isfinite(v).all() and (np.diff(v) > 0).all(),
        "does not increase strictly", "", "axis-unordered",
    ),
}  # fmt: skip


def open_calibration(
    source: Any, *, group: str | None = None, bad_elements: str | os.PathLike[str] | None = None
) -> xr.Dataset:
    """Open a calibration and check it.

    Parameters
    ----------
    source
        A Zarr store (folder, zip file, URL or store object of zarr) or netCDF file with ``radiance_gain``
        (band, cross_track), ``wavelength`` (band) and ``fwhm`` (band) at its root, all with units; or such a
        Dataset.
    group
        Group of the calibration; by default the root, or ``calibration`` if the store is a collect.
    bad_elements
        List of bad elements, whose gain becomes NaN: a table in CSV, of band and column, both numbered from
        0, below a row of headings; or an ENVI file of one value an element, 0 for good elements.

    Returns
    -------
    xarray.Dataset
        In memory, in the units, dims and dtypes of `hyperpaint.base.schema`; attribute ``srf_shape``.
        Elements with a NaN gain are bad. Other variables on ``band`` and ``cross_track`` are kept.

    Raises
    ------
    FormatError
        The store or the list cannot be read, or the store differs from its manifest.
    SchemaError
        Variables, units or values are missing or impossible; all problems are listed. The list has other
        bands or columns.

    Warns
    -----
    PaintWarning
        The line shape is not declared; a Gaussian is assumed.

    Examples
    --------
    >>> import xarray as xr
    >>> gain = xr.DataArray([[1e-8, 1e-8]], dims=("band", "cross_track"))
    >>> gain.attrs["units"] = "uW cm-2 sr-1 nm-1 s count-1"
    >>> nm = {"units": "nm"}
    >>> calibration = open_calibration(xr.Dataset(
    ...     {"radiance_gain": gain},
    ...     {"wavelength": ("band", [550.0], nm), "fwhm": ("band", [6.0], nm)},
    ...     {"srf_shape": "slit"}))
    >>> float(calibration.radiance_gain[0, 0]), calibration.radiance_gain.units
    (1.00...e-10, 'W m-2 sr-1 nm-1 s count-1')
    """

    def load(source: Any, group: str | None) -> xr.Dataset:
        groups = {} if group is not None else {"", "calibration"}.intersection(list_groups(source))
        return load_group(source, "calibration" if groups == {"calibration"} else group)

    calibration = (
        check_calibration(source)
        if isinstance(source, xr.Dataset)
        else check_calibration(_read(source, group, "calibration", load), str(source))
    )
    if bad_elements is not None:
        gain = calibration["radiance_gain"]
        path = input_path(bad_elements, "a list of bad elements")
        shape = gain.shape
        # whether the elements (band, cross_track) are in the list
        if path.suffix.lower() == ".csv":
            rows = read_limited_text(path, _MAX_BYTES, "a table of bad elements").splitlines()
            with FormatError.instead_of(
                ValueError, f"{path}: $whole", expected="numbers of band and column", code="file-unreadable"
            ):
                places = np.loadtxt(rows, np.int64, delimiter=",", skiprows=1, usecols=(0, 1), ndmin=2)
            sizes, is_fitting = places.max(axis=0, initial=-1) + 1, ((places >= 0) & (places < shape)).all()
            bad = np.zeros(shape, bool)
            if is_fitting:
                bad[tuple(places.T)] = True
        else:
            bad = np.squeeze(open_envi(path, quantity="values")["values"].to_numpy()) != 0
            sizes, is_fitting = np.array(bad.shape), bad.shape == shape
        SchemaError.raise_if(
            not is_fitting,
            f"{path}: bad elements up to {tuple(sizes.tolist())}",
            expected=f"bands and columns of the calibration, {shape}",
            code="grid-mismatch",
        )
        calibration["radiance_gain"] = gain.copy(data=np.where(bad, np.float32(np.nan), gain.values))
    return calibration


def _read(
    source: Any, group: str | None, content: str, open_zarr: Callable[[Any, str | None], xr.Dataset]
) -> xr.Dataset:
    # Open a Zarr store, or load a netCDF file; `content` names it in messages
    zarr = is_zarr(source)
    is_path = isinstance(source, str | os.PathLike) and "://" not in os.fspath(source)
    FormatError.raise_if(
        is_path and not input_path(Path(source), f"a {content} in a Zarr store or netCDF file").exists(),
        f"{source}: no such {content}",
        expected="a Zarr store or a netCDF file",
        code="file-not-found",
    )
    # zarr and the netCDF engines raise errors of many classes
    with FormatError.instead_of(
        Exception,
        f"{source}: not a readable Zarr store or netCDF file ($kind: $error)",
        mend="" if zarr or find_spec("h5netcdf") else "install for netCDF-4: python -m pip install h5netcdf",
        code="file-unreadable",
    ):
        return open_zarr(source, group) if zarr else load_netcdf(Path(source), group)


def check_calibration(dataset: xr.Dataset, subject: str = "this Dataset") -> xr.Dataset:
    # Return a calibration in the units, dims and dtypes of the table of variables, with all faults listed.
    # ``dataset``: see `open_calibration`; ``subject``: its name in messages.
    # Raises `SchemaError`: Variables, units or values are missing or impossible; all problems are listed.
    # Warns `PaintWarning`: The line shape is not declared; a Gaussian is assumed.
    problems = Problems(f"{subject} cannot be used as calibration", SchemaError)
    shape = dataset.attrs.get("srf_shape")
    names = [*_REQUIRED, *(name for name in (*_OPTIONAL, *_SWEEP_RESULTS) if name in dataset.variables)]
    if shape == "tabulated" or "srf" in dataset.variables:
        names += _TABULATED
    arrays: dict[str, xr.DataArray] = {}
    for name in names:
        with problems.noting((SchemaError, UnitsError)):
            # A variable in the units, dims and dtype of the table, without coordinates
            spec = VARIABLES[name]
            SchemaError.raise_if(
                name not in dataset.variables,
                f"{name!r} is missing",
                expected=f"{spec.meaning.lower()} ({', '.join(spec.dims)}) [{spec.units}]",
                code="variable-missing",
            )
            array = dataset[name].reset_coords(drop=True)
            allowed = [dims for dims in (spec.dims, *spec.alternatives) if set(dims) == set(array.dims)]
            SchemaError.raise_if(
                not allowed,
                f"{name!r} has dims ({', '.join(map(str, array.dims))})",
                expected=" or ".join(f"({', '.join(dims)})" for dims in (spec.dims, *spec.alternatives)),
                code="dims-wrong",
            )
            SchemaError.raise_if(
                array.dtype.kind not in ("biu" if spec.dtype == "bool" else "fiu"),
                f"{name!r} has dtype {array.dtype}",
                expected=spec.dtype,
                code="type-wrong",
            )
            array = array.transpose(*allowed[0])
            if spec.units and spec.units != "1":
                # converted in float64, so that values are rounded once
                array = convert(array.astype(np.float64), spec.units, name)
            arrays[name] = label(array.astype(dtype_of(name)), name)
    for name, array in arrays.items():
        test, fault, expected, code = _VALUE_RULES.get(name, (lambda _: True, "", "", ""))
        problems.add_if(not test(array.values), f"{name!r} {fault}", expected=expected, code=code)
    if "radiance_gain" in arrays:
        gains = arrays["radiance_gain"].values
        unusable = int((np.isinf(gains) | (gains <= 0)).sum())
        problems.add_if(
            np.isnan(gains).all(),
            "'radiance_gain' is NaN everywhere",
            expected="a gain for the elements that are not bad",
            code="not-finite",
        )
        problems.add_if(
            unusable,
            f"'radiance_gain' is zero, negative or infinite in {unusable} elements",
            expected="positive gains, and NaN for bad elements",
            code="value-out-of-range",
        )
    if shape is not None:
        one_of(shape, SRF_SHAPES, "attribute srf_shape", problems=problems)
    sizes = {name: size for name, size in dataset.sizes.items() if name in ELEMENT}
    problems.raise_if_any(
        (
            any(size == 0 for size in sizes.values()),
            Problem(f"sizes {sizes}", expected="at least one element", code="empty-input"),
        ),
    )
    if shape is None:
        shape = "gaussian"
        warn_user(f"{subject}: no attribute srf_shape; a Gaussian line shape is assumed", "srf-shape-missing")
    # further variables of the elements are kept
    for key, array in dataset.data_vars.items():
        in_table = str(key) in VARIABLES
        if not in_table and array.ndim and set(array.dims) <= set(ELEMENT) and array.dtype.kind in "fiu":
            arrays[str(key)] = array
    coords = {
        name: arrays.pop(name) for name in list(arrays) if name in VARIABLES and VARIABLES[name].coordinate
    }
    return xr.Dataset(arrays, coords, {**dataset.attrs, "srf_shape": shape})


def calibration_parts(calibration: xr.Dataset | None, is_counts: bool) -> dict[str, xr.DataArray]:
    # Return the variables of a calibration that a flight line needs.
    # A line of radiance needs only the line shape and the look angles.
    if calibration is None:
        return {}
    excluded = {
        "dark_counts",
        "dark_exposure_time",
        "dark_bias",
        "dark_rate",
        "responsivity",
        "saturation_count",
    }
    # variables of lamp lines and sweep steps have other dims
    line_dims = {
        BAND,
        CROSS_TRACK,
        "srf_offset",
        "irradiance_wavelength",
        "linearity_counts",
        "linearity_term",
        "source_band",
        "source_column",
    }
    names = [str(name) for name, array in calibration.data_vars.items() if set(array.dims) <= line_dims]
    if float(calibration.get("stray_light_u", 0.0)) >= MAX_STRAY_LIGHT_U:
        names = [name for name in names if not name.startswith("stray_light")]
    if not {"stray_light", "stray_light_across"} & set(names):
        excluded.add("flat_field")  # part of the gain; stray light needs the levels of elements
    names = [name for name in names if name not in excluded]
    if not is_counts:
        names = [name for name in names if name in ("srf", "look_angle")]
    return {name: calibration[name].reset_coords(drop=True) for name in names}


def scale_attrs(calibration: xr.Dataset | None) -> dict[str, Any]:
    # Return the attributes of a calibration on linearity and absolute scale.
    names = ("linearity", "linearity_on", "pedestal", "pedestal_statistic", "absolute_scale")
    return {} if calibration is None else {k: calibration.attrs[k] for k in names if k in calibration.attrs}


def open_sweep(path: Any, *, group: str | None = None) -> xr.Dataset:
    """Open a lab sweep, lazily from a store or cubes.

    Its content is checked by `hyperpaint.calibrate`. The documentation describes the format of tables and has
    example files (Formats, Lab sweeps).

    Parameters
    ----------
    path
        A Zarr store or netCDF file; a table in CSV with counts, or with a column ``cube`` of ENVI headers and
        the readings of a power meter; or a folder with such cubes and one table.
    group
        Group of the sweep in the store; by default the root.

    Returns
    -------
    xarray.Dataset
        The variables of `hyperpaint.base.schema.SWEEP_VARIABLES`, such as ``counts`` (step, band,
        cross_track) [count], ``exposure_time`` [s], ``flux`` [W]; others are dropped.

    Raises
    ------
    FormatError
        The file cannot be read, or has no counts of steps; faults of a table are listed with row, column and
        unit.

    Warns
    -----
    PaintWarning
        A table has unknown columns, which are ignored.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> table = pathlib.Path(tempfile.mkdtemp(), "sphere.csv")
    >>> rows = ["level [1],exposure_time [ms],band,column 0,column 1", ",5,0,101,102", "1,5,0,501,510"]
    >>> _ = table.write_text(chr(10).join(rows))
    >>> sphere = open_sweep(table)
    >>> (sphere.counts - sphere.dark_counts).values.tolist(), float(sphere.exposure_time)
    ([[[400.0, 408.0]]], 0.005)
    """
    # in chunks of steps: the calibration processes few steps at a time
    table = path if str(path).lower().endswith((".csv", ".tsv", ".txt")) else None
    place = input_path(path, "a sweep") if isinstance(path, str | os.PathLike) and not is_zarr(path) else None
    if place is not None and place.is_dir():
        tables = sorted(place.glob("*.csv"))
        FormatError.raise_if(
            len(tables) != 1,
            f"{path}: {len(tables) or 'no'} tables of a lab sweep",
            expected="one .csv, with a row for every cube, or a Zarr store",
            mend="name the table in place of its folder" if tables else "",
            code="sweep-missing",
        )
        table = tables[0]
    if table is not None:
        return read_sweep_table(Path(table))
    opened = with_steps(_read(path, group, "sweep", functools.partial(open_unverified, chunks={})))
    FormatError.raise_if(
        "counts" not in opened.variables or STEP not in opened["counts"].dims,
        f"{path}: holds {', '.join(sorted(map(str, opened.variables))[:8]) or 'nothing'}",
        expected="a lab sweep with 'counts' (step, band, cross_track)",
        code="counts-missing",
    )
    names = [name for name in SWEEP_VARIABLES if name in opened.variables]
    # differences of unsigned integers wrap around
    for name in (n for n in names if opened[n].dtype.kind in "iu" and "float" in SWEEP_VARIABLES[n].dtype):
        opened[name] = opened[name].astype(SWEEP_VARIABLES[name].dtype)
    return opened[names].reset_coords(drop=True) if not set(names) & set(opened.coords) else opened[names]


def saturation_of(
    saturation_count: float | None, bit_depth: int, calibration: xr.Dataset | None
) -> xr.DataArray:
    # Return ``saturation_count``: the argument, else that of the calibration, else 2^bit_depth - 1.
    # Raises `SchemaError`: The count or the bit depth is out of range.
    if saturation_count is None and calibration is not None and "saturation_count" in calibration:
        return calibration["saturation_count"].reset_coords(drop=True)
    if saturation_count is None:
        SchemaError.raise_if(
            not 1 <= bit_depth <= 16, f"bit_depth {bit_depth}", expected="1 to 16", code="value-out-of-range"
        )
        saturation_count = 2**bit_depth - 1
    SchemaError.raise_if(
        not 0 < saturation_count <= 65535,
        f"saturation_count {saturation_count}",
        expected="a count up to 65535",
        code="value-out-of-range",
    )
    return label(xr.DataArray(np.float32(saturation_count)), "saturation_count")
