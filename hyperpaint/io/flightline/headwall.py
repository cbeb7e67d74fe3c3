"""Side files of a Headwall flight folder: settings, frame index, header comments, dark cubes.

A flight consists of cubes ``raw_<N>``, where N is the number of the cube's first frame; the frame numbers of
``frameIndex_<N>.txt`` are absolute. The vendor publishes no description of these files: the supported
variants are from public code (Nano-Hyperspec with APX-15, its older software, TERRA-REF).
"""

import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from hyperpaint.base import (
    ALONG_TRACK,
    CHUNK_LINES,
    CUBE,
    FormatError,
    Problem,
    Problems,
    SchemaError,
    TimeError,
    UnitsError,
    conversion_factor,
    warn_user,
)
from hyperpaint.io.files.reading import Table, name_rows, read_table, read_text, refuse, to_integers

_MAX_FRAME = 1 << 40
_SECOND_US = 1_000_000
_DAY_US = 86_400 * _SECOND_US
_TIME_OF_DAY = re.compile(r"(\d{1,2}):(\d{2}):(\d{2})(?: +(\d{1,6})|\.(\d{1,6})\d*)?")
_EXPOSURE = re.compile(r"(?:exposure|integration)(?: time)? *\(([^()]*)\)", re.IGNORECASE)
#: Keys of the exposure [ms] and of the frame rate [Hz] in headers of Specim and Resonon.
_EXPOSURE_KEYS, _RATE_KEYS = ("tint", "shutter"), ("fps", "framerate")
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
        try:
            value = float(f"{float(text) * conversion_factor(match[1].strip(), 's'):.12g}")
        except (ValueError, UnitsError) as error:
            raise FormatError(
                f"{source}: {key} = {text[:40]!r}",
                expected="a number, and a unit of time in the brackets",
                code="number-unreadable",
            ) from error
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
    if key := next((key for key in _EXPOSURE_KEYS if key in fields), None):
        yield "header", {"exposure (ms)": fields[key]}


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
        if len(set(stated.values())) > 1:
            warn_user(f"{name}: {stated_text}; the first is used", "exposure-conflict")
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
    for number, cell in enumerate(table.columns[name]):
        match = _TIME_OF_DAY.fullmatch(cell.strip())
        if match is None or int(match[1]) > 23 or int(match[2]) > 59 or int(match[3]) > 60:
            faulty_rows.append(int(table.rows[number]))
            continue
        hours, minutes, seconds, micros, fraction = match.groups()
        whole_seconds = whole_seconds and micros is None and fraction is None
        micros_of_day[number] = (int(hours) * 60 + int(minutes)) * 60 * _SECOND_US + int(seconds) * _SECOND_US
        micros_of_day[number] += int(micros) if micros is not None else int((fraction or "0").ljust(6, "0"))
    FormatError.raise_if(
        faulty_rows,
        f"{table.name}: column {name!r} is unreadable in {name_rows(faulty_rows)}",
        expected="'HH:MM:SS microseconds'",
        code="time-unreadable",
    )
    # a decrease by more than half a day is midnight
    days = np.concatenate([[0], np.cumsum(np.diff(micros_of_day) < -_DAY_US // 2)])
    return micros_of_day + days * _DAY_US, whole_seconds


def cube_number(cube: Path) -> int | None:
    # Return N of ``raw_<N>``, the number of the cube's first frame, or None.
    match = _CUBE_NUMBER.fullmatch(cube.name.split(".")[0])
    return int(match[1]) if match else None


def frame_index_beside(cube: Path) -> Path | None:
    # Return the last frame index in the folder of a cube that begins at or before its first frame.
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
    # Raises `FormatError`: The counts are not a cube of unsigned integers with at least one line.
    problems = Problems(f"{subject} cannot serve as {subject.partition(' ')[0]} reference", FormatError)
    if counts.dims != CUBE:
        problems.add(f"dims {tuple(map(str, counts.dims))}", expected=str(CUBE), code="dims-wrong")
    elif counts.sizes[CUBE[0]] == 0:
        problems.add("the cube has no lines", code="empty-input")
    problems.raise_if_any(
        (
            counts.dtype.kind != "u" or counts.dtype.itemsize > 2,
            Problem(
                f"dtype {counts.dtype}", expected="unsigned raw counts of 8 or 16 bits", code="type-wrong"
            ),
        ),
    )
    shape = counts.shape[1:]
    total, squares = np.zeros(shape, np.uint64), np.zeros(shape, np.uint64)
    maximum, line_means = np.zeros(shape, counts.dtype), []
    for start in range(0, counts.shape[0], CHUNK_LINES):
        slab: NDArray[Any] = counts[start : start + CHUNK_LINES].to_numpy()
        total += slab.sum(axis=0, dtype=np.uint64)
        squares += np.square(slab, dtype=np.uint64).sum(axis=0)
        maximum = np.maximum(maximum, slab.max(axis=0))
        line_means.append(slab.mean(axis=(1, 2), dtype=np.float64))
    return DarkFrames(int(counts.shape[0]), total, squares, maximum, np.concatenate(line_means))
