"""A flight line from the files of its instruments: counts and all inputs of their calibration, lazily.

Time and position of the exposure of each line of a cube, from frame index, clocks and navigation.

Dark references: cubes recorded with a closed lens, averaged element by element.

Flight lines as a table of text: time, place, attitude, and every other variable of a line.
"""

import datetime
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple, cast

import numpy as np
import xarray as xr

from hyperpaint.base import (
    ALONG_TRACK,
    BAND,
    CHUNK_LINES,
    CROSS_TRACK,
    CUBE,
    ELEMENT,
    MID_EXPOSURE_OFFSETS,
    QUANTISATION_VARIANCE_COUNT2,
    VARIABLES,
    Array,
    Bools,
    Convention,
    Findings,
    Floats,
    FormatError,
    Indices,
    Ints,
    PaintError,
    Problem,
    Problems,
    SchemaError,
    TimeError,
    Times,
    Unavailable,
    as_path,
    conversion_factor,
    convert,
    documented,
    dtype_of,
    input_path,
    label,
    one_of,
    refuse_other_labels,
    rename_to_roles,
    require,
    responsivity_slope,
    takes_quantities,
    warn_if,
    warn_user,
    with_calibration_names,
    with_numbers,
)
from hyperpaint.io.envi.envi_cubes import open_envi
from hyperpaint.io.files.publishing import published_files
from hyperpaint.io.files.reading import refuse
from hyperpaint.io.navigation.navigation_records import (
    ASSUMED,
    CLOCK_LIMITS,
    NS_PER_S,
    Clock,
    Navigation,
    midnight_of,
    read_gps_time,
    read_imu_gps,
    to_utc,
)
from hyperpaint.io.spectrometers.irradiance import cut_irradiance, open_irradiance, record_attrs

from .side_files import (
    DAY_US,
    DarkFrames,
    FrameIndex,
    calibration_parts,
    cube_number,
    exposure_seconds,
    exposure_sources,
    find_exposure,
    match_frames,
    open_calibration,
    read_frame_index,
    recording_clock,
    saturation_of,
    scale_attrs,
    sum_dark,
)

#: Variables of the first columns, in their order.
_FIRST_COLUMNS = (
    *("frame", "time", "latitude", "longitude", "altitude", "roll", "pitch", "heading"),
    *("exposure_time", "irradiance_age"),
)


@takes_quantities()
@documented()
def write_line_table(line: xr.Dataset, path: str | os.PathLike[str], *, overwrite: bool = False) -> Path:
    """Write the variables on ``along_track`` of a flight line as comma-separated values.

    `open_navigation` reads a file with the pose again, and every number keeps its bits; the first lines of
    the file declare the conventions of its angles.

    Parameters
    ----------
    line
        A flight line; its variables of numbers or times with the only dim ``along_track`` are written. A
        scalar exposure time is repeated.
    path
    overwrite

    Returns
    -------
    pathlib.Path
        The file: ``line``, then a column a variable with its unit, ``roll [degree]``; times are UTC at mid
        exposure, ISO 8601; unknown values are empty.

    Raises
    ------
    SchemaError
        There is no ``along_track``, or no variable on it.
    StoreError
        The file exists, or cannot be written. An existing file is unchanged.

    Examples
    --------
    >>> import tempfile, xarray as xr
    >>> scratch = tempfile.TemporaryDirectory()
    >>> line = xr.Dataset({"roll": ("along_track", [0.5, -0.25], {"units": "degree"})})
    >>> print(write_line_table(line, Path(scratch.name) / "lines.csv").read_text())
    line,roll [degree]
    0,0.5
    1,-0.25
    >>> scratch.cleanup()
    """
    path = as_path(path)
    names = [str(name) for name, array in line.variables.items() if array.dims == (ALONG_TRACK,)]
    SchemaError.raise_if(
        not names,
        f"no variable has the only dim {ALONG_TRACK!r}, dims are {dict(line.sizes)}",
        mend="pass a flight line",
        code="dim-missing",
    )
    lines = line.sizes[ALONG_TRACK]
    names += [name for name in _FIRST_COLUMNS if name in line.variables and line.variables[name].dims == ()]
    order = {name: number for number, name in enumerate(_FIRST_COLUMNS)}
    columns: dict[str, Any] = {}
    for name in sorted(set(names), key=lambda name: (order.get(name, len(order)), name)):
        values = line[name].values
        if values.dtype.kind in "iufbM":
            units = line[name].attrs.get("units")
            plain = units in (None, "", "1") or values.dtype.kind in "Mb" or "," in str(units)
            columns[name if plain else f"{name} [{units}]"] = np.broadcast_to(values, (lines,))
    convention = Convention.from_attrs(line.attrs)
    declared = {} if convention is None else convention.to_attrs()
    with (
        published_files([path], overwrite=overwrite) as (target,),
        open(target, "w", encoding="utf-8", newline="\n") as file,
    ):
        file.writelines(f"# {key}: {value}\n" for key, value in declared.items())
        file.write(",".join(["line", *columns]) + "\n")
        cells = (map(str, range(lines)), *map(_texts, columns.values()))
        file.writelines(",".join(row) + "\n" for row in zip(*cells, strict=True))
    return path


def _texts(values: Any) -> list[str]:
    if values.dtype.kind == "M":
        stamps = np.datetime_as_string(values.astype("datetime64[ns]"), unit="ns")
        return ["" if stamp == "NaT" else f"{stamp}Z" for stamp in stamps]
    # of a float the shortest text that is read as the same number
    is_float = values.dtype.kind == "f"
    return [
        "" if is_float and np.isnan(value) else str(value if is_float else int(value)) for value in values
    ]


# --- a table of the lines ----------------------------------------------------------------------------------

# --- times of the lines ------------------------------------------------------------------------------------

_MAX_EXPOSURE_S = 3600.0
#: Source of the times of lines without times.
UNKNOWN_TIMES = "unknown"
_MAX_INTERVAL_S = 1e4


@dataclass(frozen=True)
class Timing:
    # Clock settings of one flight line; see `hyperpaint.open_flightline`.
    frame_index: Path | None = None
    nav: Path | Navigation | None = None
    gps_time: Path | None = None
    date: str | None = None
    start_time: Any = None
    frame_period: float | None = None
    stamp: str = "end"
    clock_offset_s: float | None = None
    time_scale: Literal["utc", "gps"] = "utc"
    gps_leap_seconds: int | None = None
    max_gap_s: float | None = None

    def utc_of(self, stamp: Ints) -> Ints:
        # Return UTC of stamps of the navigation [ns since 1970-01-01].
        return to_utc(stamp, self.clock_offset_s or 0.0, self.time_scale, self.gps_leap_seconds)


@dataclass(frozen=True)
class LineTimes:
    # Times and poses of the lines of a cube.

    frame: Ints  #: (along_track,): Frame numbers.
    recorded: Bools  #: (along_track,): False where the frame was dropped and the line is blank.
    time: Times  #: (along_track,): UTC at mid exposure, NaT where unknown.
    #: ``latitude`` to ``heading`` (along_track,), float64, by name; empty without navigation.
    pose: Mapping[str, Floats] = field(repr=False)
    dropped: int  #: Number of frames missing between the first and the last line, blank lines included.
    source: str  #: Source of the times.


def utc_of(value: Any, name: str) -> np.datetime64:
    """Return an instant as datetime64[ns] UTC.

    ``value``: ISO text or a datetime, both with a zone, or a numpy.datetime64, which is UTC; ``name``: name
    of the value in messages.

    Raises `TimeError`: The value is unreadable, or without a zone.

    Examples
    --------
    >>> utc_of("2024-06-01T14:00:00+02:00", "start_time")
    np.datetime64('2024-06-01T12:00:00.000000000')
    """
    if isinstance(value, np.datetime64) and not np.isnat(value):
        return np.datetime64(value.astype("datetime64[ns]").astype(np.int64).item(), "ns")
    if isinstance(value, str):
        with TimeError.instead_of(
            ValueError,
            f"{name} {value[:60]!r} is not a time",
            expected="a time such as '2024-06-01T12:00:00Z'",
            code="time-unreadable",
        ):
            value = datetime.datetime.fromisoformat(value.strip())
    TimeError.raise_if(
        not isinstance(value, datetime.datetime) or value.tzinfo is None,
        f"{name} {value!s:.60} has no zone",
        mend="write '2024-06-01T12:00:00Z', or '-05:00' at the end",
        code="zone-missing",
    )
    TimeError.raise_if(
        not 1980 <= value.year <= 2200,
        f"{name} {value!s:.60} is out of range",
        expected="a year from 1980 to 2200",
        code="value-out-of-range",
    )
    return np.datetime64(value.astimezone(datetime.UTC).replace(tzinfo=None), "ns")


def line_times(
    cube: Path,
    lines: int,
    timing: Timing,
    exposure_time: float | Floats = 0.0,
    *,
    shortened: bool = False,
) -> LineTimes:
    # Return times and poses of the lines of a cube, from frame index, clocks and navigation.
    #
    # The stamp of a line in the instrument's microseconds is converted to UTC by linear interpolation, in
    # int64, between rows of the navigation record that have both clocks; nothing is extrapolated. Half an
    # exposure leads from the start or end of an exposure to its middle.
    #
    # ``cube``: path of the cube, whose name ``raw_<N>`` states its first frame; ``lines``: its number of
    # lines; ``timing``: the sources; ``exposure_time``: seconds, scalar or (along_track,); ``shortened``:
    # whether the file was cut short, so that its frame index may have more rows than the cube has lines.
    #
    # Raises `FormatError`: A side file is damaged, or the frame index does not fit the cube. Raises
    # `TimeError`: Sources are missing or contradict each other, or no line lies within the navigation record.
    #
    # Warns `PaintWarning`: Lines outside the navigation record; a frame period or exposure that the stamps
    # contradict; stamps of whole seconds.
    with Problems("the clocks of the flight cannot be used as described", TimeError) as problems:
        one_of(timing.stamp, MID_EXPOSURE_OFFSETS, "stamp", problems=problems)
        one_of(timing.time_scale, ("utc", "gps"), "time_scale", problems=problems)
        problems.add_if(
            not abs(timing.clock_offset_s or 0.0) <= CLOCK_LIMITS.max_offset_s,
            f"clock offset {timing.clock_offset_s} s",
            expected=f"{-CLOCK_LIMITS.max_offset_s:g} to {CLOCK_LIMITS.max_offset_s:g} s",
            code="value-out-of-range",
        )
        exposure_s = float(np.max(exposure_time, initial=0.0))
        problems.add_if(
            exposure_s > _MAX_EXPOSURE_S,
            f"an exposure of {exposure_s:g} s",
            expected=f"at most {_MAX_EXPOSURE_S:g} s",
            code="value-out-of-range",
        )
        for name, seconds in (("frame_period", timing.frame_period), ("nav_max_gap_s", timing.max_gap_s)):
            problems.add_if(
                seconds is not None and not 0 < seconds <= _MAX_INTERVAL_S,
                f"{name} {seconds} s",
                expected="a positive number",
                code="value-out-of-range",
            )
    index = read_frame_index(timing.frame_index) if timing.frame_index is not None else None
    nav = read_imu_gps(timing.nav, timing.utc_of) if isinstance(timing.nav, Path) else timing.nav
    if index is None:
        frame = np.arange(lines, dtype=np.int64) + (cube_number(cube) or 0)
        row = np.arange(lines)
    else:
        frame, row = match_frames(index, lines, cube, shortened=shortened)
    recorded = row >= 0
    clock = _clock(timing, index, nav, row[recorded], cube)
    time = np.full(lines, np.datetime64("NaT", "ns"), "datetime64[ns]")
    if index is not None:
        time[recorded] = clock.at(index.stamp[row[recorded]])
        if index.fitted:
            text = f"{index.name} has whole seconds: line times are from a straight line fit"
            warn_user(f"{cube.name}: {text}", "time-rounded")
        # warn where stated period, exposure and stamps contradict one another
        rows, stated = row[recorded], timing.frame_period
        if len(rows) > 1:
            period = float(np.median(np.diff(index.stamp[rows]) / np.diff(index.frame[rows]))) * 1e-6
            if stated and abs(period / stated - 1.0) > 0.05:
                text = f"{index.name} has {period * 1e3:.4g} ms a frame; its stamps are used"
                warn_user(f"{cube.name}: frame_period {stated * 1e3:g} ms, but {text}", "frame-rate-conflict")
            if exposure_s > 1.01 * period:
                text = f"is longer than the {period * 1e3:.4g} ms between frames; check its unit"
                warn_user(f"{cube.name}: exposure {exposure_s * 1e3:g} ms {text}", "exposure-too-long")
    else:
        time = clock.at(np.zeros(1, np.int64)) + np.round(
            (frame - frame[0]) * (NS_PER_S * float(timing.frame_period or 0.0))
        ).astype("timedelta64[ns]")
    outside = np.isnat(time[recorded])
    if outside.any():
        TimeError.raise_if(
            outside.all(),
            f"{cube.name}: no line lies inside {clock.source}",
            mend="pass the record of this flight",
            code="time-uncovered",
        )
        missing = np.flatnonzero(outside)
        warn_user(
            f"{cube.name}: {len(missing)} of {len(outside)} lines ({missing[0]} to {missing[-1]}) lie "
            f"outside {clock.source} and have no time and position",
            "time-uncovered",
        )
    # from the stamped instant of the exposure to its middle
    to_middle = np.asarray(exposure_time) * MID_EXPOSURE_OFFSETS[timing.stamp]
    time = time + np.round(to_middle * NS_PER_S).astype("timedelta64[ns]")
    pose = {} if nav is None else nav.dated_by(clock).at(time, timing.max_gap_s)
    dropped = int(frame[-1] - frame[0]) + 1 - int(recorded.sum()) if lines else 0
    return LineTimes(frame, recorded, time, pose, dropped, clock.source)


def _clock(
    timing: Timing, index: FrameIndex | None, nav: Navigation | None, rows: Indices, cube: Path
) -> Clock:
    if timing.start_time is not None:
        TimeError.raise_if(
            index is not None and nav is not None and nav.utc is not None,
            f"{cube.name}: both start_time and a navigation record with UTC",
            mend="pass one of them",
            code="option-conflict",
        )
        start = utc_of(timing.start_time, "start_time").astype(np.int64)
        TimeError.raise_if(
            index is None and not timing.frame_period,
            f"{cube.name}: start_time without frame_index or frame_period",
            mend="pass one of them",
            code="argument-missing",
        )
        return _steady(0 if index is None else int(index.stamp[rows[0]]), int(start), "start_time")
    if index is None:
        files = ", ".join(
            name
            for name in (f"frameIndex_{cube_number(cube)}.txt", "imu_gps.txt")
            if (cube.parent / name).is_file()
        )
        beside = f" (beside the cube: {files})" if files else ""
        raise TimeError(
            f"{cube.name}: no line times",
            mend=f"pass frame_index and nav, or start_time and frame_period{beside}",
            code="time-missing",
        )
    if index.clock == "time of day" and timing.gps_time is not None:
        return read_gps_time(timing.gps_time, timing.utc_of)
    if index.clock == "time of day" and timing.date is not None:
        # midnight of the date on the recording computer's clock
        midnight = TimeError.raise_if_none(
            midnight_of(timing.date),
            f"date {str(timing.date)[:40]!r}",
            expected="a date such as '2024-06-01'",
            code="time-unreadable",
        )
        TimeError.raise_if(
            timing.clock_offset_s is None,
            "date without clock_offset_s",
            mend="pass clock_offset_s = UTC minus the computer's clock (0.0 for a clock in UTC)",
            code="clock-offset-missing",
        )
        return _steady(0, int(timing.utc_of(np.array([midnight]))[0]), "date and time of day")
    nav = TimeError.raise_if_none(
        nav,
        f"{cube.name}: {index.name} has no UTC",
        mend="pass nav (imu_gps.txt), or start_time",
        code="time-missing",
    )
    return nav.clock_for(index)


def _steady(stamp: int, utc: int, source: str) -> Clock:
    # A clock without drift, from one stamp and its UTC
    span = np.array([-10 * DAY_US, 10 * DAY_US], np.int64)
    return Clock(stamp + span, utc + span * 1000, source)


# --- darks -------------------------------------------------------------------------------------------------

DARK_NONE = "none"
_DARK_OF_CALIBRATION = "calibration"
#: Minimum number of lines of a dark cube for an estimate of read noise.
MIN_NOISE_LINES = 16


@dataclass(frozen=True)
class Dark:
    # Dark counts of a flight line.
    counts: xr.DataArray  #: ``dark_counts`` ([dark_time,] band, cross_track), float32 [count].
    exposures: tuple[float | None, ...]  #: Exposure time of each reference [s]; None where unknown.
    #: (band, cross_track): Standard deviation over the lines without quantisation noise [count]; None with
    #: too few lines.
    read_noise: xr.DataArray | None
    source: str  #: Source of the counts.
    uncertainty: xr.DataArray | None = None  #: (band, cross_track): Standard uncertainty of the mean [count].

    def variables(self, *, needs_noise: bool) -> dict[str, xr.DataArray]:
        # Return the variables of a flight line, with ``needs_noise`` also the read noise.
        variables = {"dark_counts": self.counts}
        exposures = [seconds for seconds in self.exposures if seconds is not None]
        if exposures and len(exposures) == len(self.exposures):
            by_time = "dark_time" in self.counts.dims
            array = xr.DataArray(
                np.array(exposures if by_time else exposures[0]), dims=("dark_time",) if by_time else ()
            )
            variables["dark_exposure_time"] = label(array, "dark_exposure_time")
        if needs_noise and self.read_noise is not None:
            variables["read_noise"] = self.read_noise
        if self.uncertainty is not None:
            variables["dark_counts_u_random"] = self.uncertainty
        return variables


class Reference(NamedTuple):
    # Sums over a cube of a dark or of a white tile, its UTC at mid recording, and its exposure [s].
    name: str
    frames: DarkFrames
    time: np.datetime64 | None
    exposure: float | None
    wavelength: Floats | None  #: (band,) of its header [nm]


def open_dark(
    source: Any, timing: Timing, calibration: xr.Dataset | None, cube: xr.DataArray | None
) -> Dark | None:
    # Open the dark references of a line; None where the cube or the calibration failed to open.
    # Several references with known times are stacked along ``dark_time``; otherwise they are averaged.
    # ``source``: path or Dataset of a dark cube, or several; a Dataset with ``dark_counts``; ``"none"`` or
    # ``"calibration"``; ``timing``: clock settings of the flight, also for ``frameIndex_<N>.txt`` and
    # ``imu_gps.txt`` beside a dark cube; ``calibration``: calibration of the camera, or None if it failed to
    # open; ``cube``: counts of the line, or None if they failed to open.
    # Raises `SchemaError`: There is no dark, or a dark does not fit the cube. Raises `FormatError`: A file is
    # not a cube of raw counts.
    SchemaError.raise_if(
        source is None or (isinstance(source, (list, tuple)) and not source),
        "no dark reference",
        mend=(
            'pass dark=, or dark="none" where the counts are dark-corrected '
            '(in collect.toml: cubes = [...] or cubes = "none" in [dark])'
        ),
        code="dark-missing",
    )
    shape = None if cube is None else tuple(cube.sizes[dim] for dim in ELEMENT)
    if isinstance(source, str) and source == DARK_NONE:
        if shape is None:
            return None
        zeros = label(xr.DataArray(np.zeros(shape, np.float32), dims=ELEMENT), "dark_counts", dark="none")
        return Dark(zeros, (None,), None, DARK_NONE)
    if isinstance(source, str) and source == _DARK_OF_CALIBRATION:
        return None if calibration is None else _from_dark_counts(calibration, shape, "the calibration")
    sources: Sequence[Any] = source if isinstance(source, (list, tuple)) else [source]
    for dataset in sources:
        if isinstance(dataset, xr.Dataset) and cube is not None:
            refuse_other_labels(rename_to_roles(dataset), cube, "dark=", (CROSS_TRACK,))
    if isinstance(source, xr.Dataset) and "dark_counts" in source:
        return _from_dark_counts(source, shape, "a Dataset")
    references = [read_reference(reference, timing, shape) for reference in sources]
    # Stack references along time where all times are known, else average them
    long = [ref.frames for ref in references if ref.frames.lines >= MIN_NOISE_LINES]
    measured = long or [ref.frames for ref in references if ref.frames.lines > 1]
    noise = variance = None
    if measured:
        freedom = np.array([frames.lines - 1 for frames in measured], np.float64)
        squares = sum(k * frames.variance for k, frames in zip(freedom, measured, strict=True))
        if long:
            variance = squares / freedom.sum()
            noise = _labelled(np.sqrt(np.maximum(variance - QUANTISATION_VARIANCE_COUNT2, 0.0)), "read_noise")
        else:
            # few lines: shrink the variance of an element to the mean variance, with the weight of
            # `MIN_NOISE_LINES` lines
            pooled = float(np.sum(squares)) / (freedom.sum() * squares.size)
            variance = (squares + MIN_NOISE_LINES * pooled) / (freedom.sum() + MIN_NOISE_LINES)
    source = ", ".join(f"{ref.name} ({ref.frames.lines} lines)" for ref in references)
    times = [ref.time for ref in references if ref.time is not None]
    if len(references) > 1 and len(times) == len(references) == len(set(times)):
        references = sorted(references, key=lambda ref: ref.time or np.datetime64(0, "ns"))
        counts = label(
            xr.DataArray(
                np.stack([ref.frames.mean for ref in references]).astype(np.float32),
                dims=("dark_time", *ELEMENT),
            ),
            "dark_counts",
        )
        counts = counts.assign_coords(
            dark_time=label(
                xr.DataArray(np.array([ref.time for ref in references], "datetime64[ns]"), dims="dark_time"),
                "dark_time",
            )
        )
        min_lines = min(ref.frames.lines for ref in references)
        u = None if variance is None else _labelled(np.sqrt(variance / min_lines), "dark_counts_u_random")
        return Dark(counts, tuple(ref.exposure for ref in references), noise, source, u)
    exposures = ", ".join(
        f"{ref.name} {'unknown' if ref.exposure is None else f'{ref.exposure * 1e3:g} ms'}"
        for ref in references
    )
    SchemaError.raise_if(
        len({ref.exposure for ref in references}) > 1,
        f"dark cubes of unknown times cannot be averaged, since their exposures differ: {exposures}",
        code="exposure-conflict",
    )
    lines = sum(ref.frames.lines for ref in references)
    total = sum((ref.frames.total for ref in references), np.zeros_like(references[0].frames.total))
    mean = (total / np.float64(lines)).astype(np.float32)
    if len(references) > 1:
        source += "; averaged, since their times are unknown"
    u = None if variance is None else _labelled(np.sqrt(variance / lines), "dark_counts_u_random")
    return Dark(_labelled(mean, "dark_counts"), (references[0].exposure,), noise, source, u)


def own_dark(source: Any, path: Path | None, opened: xr.Dataset) -> Any:
    # Return the source of a dark: ``source``, else the dark lines at the end of the scene, else None.
    return (
        source
        if source is not None or path is None or "dark_lines" not in opened.attrs
        else open_envi(path, unsaid="counts", dark_lines=True)
    )


def _from_dark_counts(dataset: xr.Dataset, shape: tuple[int, ...] | None, name: str) -> Dark:
    exposure = dataset.get("dark_exposure_time")
    arrays = require(
        dataset, ["dark_counts"] + ([] if exposure is None else ["dark_exposure_time"]), "a dark correction"
    )
    counts = arrays["dark_counts"].astype(dtype_of("dark_counts"))
    check_shape(tuple(counts.sizes[dim] for dim in ELEMENT), shape, f"dark_counts of {name}")
    SchemaError.raise_if(
        not np.isfinite(counts.values).any(), f"dark_counts of {name} have no finite value", code="not-finite"
    )
    times = counts.coords["dark_time"] if "dark_time" in counts.dims else None
    counts = label(counts.reset_coords(drop=True), "dark_counts")
    if times is not None:
        counts = counts.assign_coords(dark_time=times.astype("datetime64[ns]"))
    seconds = [None] if exposure is None else np.atleast_1d(arrays["dark_exposure_time"].values).tolist()
    return Dark(counts, tuple(seconds), None, name)


def check_shape(
    actual: tuple[int, ...], shape: tuple[int, ...] | None, name: str, role: str = "dark"
) -> None:
    SchemaError.raise_if(
        shape is not None and actual != shape,
        "{}: {} bands x {} columns".format(name, *actual),
        expected="{} x {}, as the cube".format(*(shape or actual)),
        mend=f"pass a {role} of this camera with the same binning",
        code="grid-mismatch",
    )


def read_reference(
    source: Any, timing: Timing, shape: tuple[int, ...] | None, role: str = "dark"
) -> Reference:
    # Sum a cube of counts, a path or a Dataset; ``role``: "dark" or "white"; see `open_dark`.
    if isinstance(source, xr.Dataset):
        opened, path = rename_to_roles(source), None
        name = str(source.attrs.get("source", role))
    else:
        path = input_path(source, f"a {role} cube", content=False)
        opened, name = open_envi(path, unsaid="counts"), path.name
    FormatError.raise_if(
        "counts" not in opened,
        f"{name}: holds {', '.join(map(str, opened.data_vars)) or 'nothing'}",
        expected=f"a {role} cube of raw counts",
        code="counts-missing",
    )
    counts = opened["counts"]
    if set(counts.dims) == set(CUBE):
        counts = counts.transpose(*CUBE)
        check_shape(counts.shape[1:], shape, f"{role} {name}", role)
    frames = sum_dark(counts, f"{role} {name}")
    stated: Iterator[float | None] = (
        exposure_seconds(pairs, f"{role} {name}: {file}") for file, pairs in exposure_sources(path, opened)
    )
    if "exposure_time" in opened:
        seconds = np.unique(require(opened, ["exposure_time"], "a dark correction")["exposure_time"].values)
        stated = iter(map(float, seconds)) if seconds.size == 1 else stated
    exposure = next((seconds for seconds in stated if seconds is not None), None)
    wavelength = opened["wavelength"].values if "wavelength" in opened.coords else None
    return Reference(
        name, frames, _mid_time(opened, path, timing, counts.sizes[ALONG_TRACK]), exposure, wavelength
    )


def _mid_time(opened: xr.Dataset, path: Path | None, timing: Timing, lines: int) -> np.datetime64 | None:
    # UTC at the middle of a dark cube; None where unknown
    stamps = (
        opened["time"].values.astype("datetime64[ns]") if "time" in opened.coords else np.empty(0, "M8[ns]")
    )
    if path is not None and "time" not in opened.coords:
        index = path.parent / f"frameIndex_{cube_number(path)}.txt"
        nav = path.parent / "imu_gps.txt"
        if index.is_file() and nav.is_file():
            dark_timing = Timing(
                frame_index=index,
                nav=nav,
                stamp=timing.stamp,
                clock_offset_s=timing.clock_offset_s,
                time_scale=timing.time_scale,
                gps_leap_seconds=timing.gps_leap_seconds,
            )
            try:
                stamps = line_times(path, lines, dark_timing).time
            except PaintError as error:
                warn_user(f"dark {path.name}: time unknown; {error}", "dark-time-unknown")
    stamps = stamps[~np.isnat(stamps)]
    if stamps.size:
        first, last = stamps[[0, -1]].astype(np.int64).tolist()
        return np.datetime64((first + last) // 2, "ns")
    if "time" in opened.coords:
        return None
    start, period = recording_clock(opened)
    if start is not None:
        return utc_of(start, "start time") + np.timedelta64(round(0.5e9 * lines * (period or 0.0)), "ns")
    stated = json.loads(opened.attrs.get("envi_header", "{}")).get("acquisition time")
    try:
        return None if stated is None else utc_of(str(stated), "acquisition time")
    except TimeError:
        return None  # such as a time without a zone


def _labelled(values: Array, name: str) -> xr.DataArray:
    return label(xr.DataArray(values.astype(np.float32), dims=ELEMENT), name)


# --- flight lines ------------------------------------------------------------------------------------------

type_path = str | os.PathLike[str]

#: Difference between the wavelengths of header and calibration above which a warning is given [nm].
_WAVELENGTH_TOLERANCE_NM = 0.5
#: Count in the lines of dropped frames.
BLANK_COUNT = np.uint16(65535)


@dataclass(frozen=True, kw_only=True)
class FlightlineInputs:
    # Inputs of `assemble`; the fields are the arguments of `open_flightline`.
    cube: Path | xr.Dataset
    timing: Timing | Unavailable
    exposure_time: Any = None
    dark: Any = None
    calibration: type_path | xr.Dataset | Unavailable | None = None
    irradiance: Any = None
    bit_depth: int = 12
    saturation_count: float | None = None
    radiance_units: str | None = None
    quantity: str | None = None
    fwhm_nm: float | None = None
    chunks: Any = "auto"
    name: str | None = None
    keep_whole_lines: bool = False
    has_white: bool = False  #: A white reference replaces the calibration, and times may be unknown.
    convention: Mapping[str, Any] = field(default_factory=dict)
    attrs: Mapping[str, Any] = field(default_factory=dict)

    @property
    def path(self) -> Path:
        # Path of the cube, or the name of its Dataset in messages.
        return (
            self.cube
            if isinstance(self.cube, Path)
            else Path(self.name or str(self.cube.attrs.get("source", "cube")))
        )


@takes_quantities(
    exposure_time="s",
    frame_period="s",
    nav_clock_offset_s="s",
    nav_max_gap_s="s",
    saturation_count="count",
    fwhm_nm="nm",
)
def open_flightline(
    cube: type_path | xr.Dataset,
    *,
    frame_index: type_path | None = None,
    nav: type_path | Navigation | None = None,
    dark: Any = None,
    calibration: type_path | xr.Dataset | None = None,
    irradiance: Any = None,
    exposure_time: float | Sequence[float] | None = None,
    frame_period: float | None = None,
    start_time: Any = None,
    gps_time: type_path | None = None,
    date: str | None = None,
    stamp: Literal["start", "mid", "end"] = "end",
    nav_clock_offset_s: float | None = None,
    time_scale: Literal["utc", "gps"] = "utc",
    gps_leap_seconds: int | None = None,
    nav_max_gap_s: float | None = None,
    convention: Mapping[str, Any] | None = None,
    bit_depth: int = 12,
    saturation_count: float | None = None,
    radiance_units: str | None = None,
    quantity: Literal["counts", "radiance"] | None = None,
    fwhm_nm: float | None = None,
    chunks: Any = "auto",
    name: str | None = None,
    keep_whole_lines: bool = False,
) -> xr.Dataset:
    """Open a flight line with all inputs of its calibration, without reading the cube.

    Parameters
    ----------
    cube
        ENVI cube in sensor geometry (either file of the pair), or its Dataset: raw counts, or a vendor's
        radiance, which needs neither ``calibration`` nor ``dark``.
    frame_index
        ``frameIndex_<N>.txt``, of this cube or of the complete flight. A cube with one line a row is matched
        by row. A cube with one line a frame number is matched by number; lines of dropped frames are blank
        (``time`` NaT, ``counts`` 65535).
    nav
        ``imu_gps.txt``: UTC, and position and attitude at mid exposure.
    dark
        Dark cube or cubes (``dark_counts`` is the mean of their lines), a Dataset with ``dark_counts``,
        ``"calibration"`` for the dark counts of the calibration, or ``"none"``.
    calibration
        See `open_calibration`. Its wavelengths replace the header's.
    irradiance
        From `open_irradiance`, or its paths. The record is cut to the line +- 60 s, and at least the samples
        around it. Without it no reflectance can be computed.
    exposure_time
        Seconds, scalar or (along_track,); by default from ``settings.txt`` beside the cube, else from the
        comment lines of the header. The argument takes precedence.
    frame_period
        Seconds from line to line; with ``start_time`` it replaces ``frame_index`` and ``nav``.
    start_time
        Stamp of the first line, with a zone.
    gps_time, date
        For frame indices stamped by the recording computer: ``gps_time.txt``, or the day (``"2024-06-01"``),
        with ``nav_clock_offset_s``.
    stamp
        Instant of the exposure that a line's time stamp marks.
    nav_clock_offset_s, time_scale, gps_leap_seconds
        UTC = stamp of the navigation + offset [s]; with ``"gps"`` less the leap seconds, by default from a
        table.
    nav_max_gap_s
        Maximum interval of the navigation that is interpolated [s]; by default 2.5 x the median, at least
        0.1 s.
    convention
        Declared conventions of the angles and heights of ``nav`` and of the order of columns: fields of
        `hyperpaint.Convention`, such as ``{"column_order": "left_to_right"}``. Usual meanings of the format
        are assumed for the other fields, which the attribute ``navigation_assumed`` of the line lists.
    bit_depth, saturation_count
        Count of a saturated element: ``saturation_count``, else that of the calibration, else
        ``2**bit_depth - 1``.
    radiance_units
        Units of a radiance cube whose header does not state them.
    quantity
        ``counts`` or ``radiance``: quantity of an ENVI cube whose header does not state it. By default
        integers are counts if ``dark`` is passed, and radiance if ``radiance_units`` is passed.
    fwhm_nm
        Width of the bands [nm] if neither calibration nor header states it.
    chunks
        dask chunks of the cube: ``"auto"`` for 32 complete lines, None for no dask (except where units are
        converted or dropped lines blanked), else as for `xarray.Dataset.chunk`.
    name
        Name of the line; by default the cube's.
    keep_whole_lines
        Open the complete lines of a file that was cut short.

    Returns
    -------
    xarray.Dataset
        ``counts`` (along_track, band, cross_track) uint16 or ``radiance`` float32, lazy, with the variables
        and coordinates of `hyperpaint.base.schema`; ``time`` is UTC at mid exposure.

    Raises
    ------
    FormatError
        A file is damaged or has another format.
    TimeError
        Line times are missing or contradictory, or navigation or irradiance does not cover the line.
    SchemaError, UnitsError
        The calibration is incomplete, or does not fit the cube.
    CollectError
        Several of these problems; all are listed.

    Warns
    -----
    PaintWarning
        Sources disagree, or lines fall outside the navigation record.

    Examples
    --------
    >>> import tempfile
    >>> from hyperpaint.simulation import simulate_collect
    >>> folder = simulate_collect(tempfile.mkdtemp(), scene="plan", lines=40, bands=4, columns=6).parent
    >>> line = open_flightline(
    ...     folder / "flight/raw_0.hdr",
    ...     frame_index=folder / "flight/frameIndex_0.txt",
    ...     nav=folder / "flight/imu_gps.txt",
    ...     dark=folder / "dark/raw_0.hdr",
    ...     calibration=folder / "calibration.zarr",
    ... )
    >>> line["counts"].chunks, line["time"].values[0], line.attrs["exposure_source"]
    (((32, 8), (4,), (6,)), np.datetime64('2021-07-20T17:10:00.000000000'), 'settings.txt')
    """
    source = cube if isinstance(cube, xr.Dataset) else input_path(cube, "a cube", content=False)
    inputs = FlightlineInputs(
        cube=source,
        timing=Timing(
            frame_index=None if frame_index is None else Path(frame_index),
            nav=nav if nav is None or isinstance(nav, Navigation) else Path(nav),
            gps_time=None if gps_time is None else Path(gps_time),
            date=date,
            start_time=start_time,
            frame_period=frame_period,
            stamp=stamp,
            clock_offset_s=nav_clock_offset_s,
            time_scale=time_scale,
            gps_leap_seconds=gps_leap_seconds,
            max_gap_s=nav_max_gap_s,
        ),
        exposure_time=exposure_time,
        dark=dark,
        calibration=calibration,
        irradiance=irradiance,
        bit_depth=bit_depth,
        saturation_count=saturation_count,
        radiance_units=radiance_units,
        quantity=quantity,
        fwhm_nm=fwhm_nm,
        chunks=chunks,
        name=name,
        keep_whole_lines=keep_whole_lines,
        convention=convention or {},
    )
    subject = name or (source.name if isinstance(source, Path) else "from a Dataset")
    findings = Findings(f"flight line {subject!r} cannot be opened")
    line = assemble(inputs, findings)
    findings.raise_if_any()
    return line


def assemble(inputs: FlightlineInputs, findings: Findings) -> xr.Dataset:
    # Open every input, with errors added to ``findings``; return the line, empty after an error.
    #
    # Steps whose input failed are skipped, so that every problem is reported once.
    path = inputs.path
    on_disk = inputs.cube if isinstance(inputs.cube, Path) else None
    cube: xr.DataArray | None = None
    opened = xr.Dataset()
    is_counts = True
    with findings.step():
        if isinstance(inputs.cube, Path):
            opened = open_envi(
                inputs.cube,
                keep_whole_lines=inputs.keep_whole_lines,
                quantity=inputs.quantity,
                unsaid="counts" if inputs.dark is not None or inputs.has_white else "values",
            )
        else:
            opened = rename_to_roles(inputs.cube)
        if "values" in opened and inputs.radiance_units:
            opened = opened.rename(values="radiance")
        is_counts = "counts" in opened
        cube = _check_cube(opened, inputs)
    exposure, exposure_source = findings.attempt(
        find_exposure, inputs.exposure_time, on_disk, path.name, opened, required=is_counts
    ) or (None, "")
    calibration = findings.attempt(_calibration, inputs, cube, required=is_counts and not inputs.has_white)
    timing = Timing() if isinstance(inputs.timing, Unavailable) else inputs.timing
    times: LineTimes | None = None
    if inputs.has_white and timing.frame_index is None and timing.start_time is None:
        start, period = recording_clock(opened)
        if start is not None and period is not None:
            inputs = replace(inputs, timing=replace(timing, start_time=start, frame_period=period))
            timing = cast(Timing, inputs.timing)
    if cube is not None and inputs.has_white and timing.frame_index is None and timing.start_time is None:
        numbers = np.arange(cube.sizes[ALONG_TRACK])
        unknown_time = np.full(numbers.shape, np.datetime64("NaT", "ns"), "datetime64[ns]")
        times = LineTimes(numbers, np.ones(numbers.shape, bool), unknown_time, {}, 0, UNKNOWN_TIMES)
    elif cube is not None and timing is inputs.timing:
        times = findings.attempt(
            line_times,
            path,
            cube.sizes[ALONG_TRACK],
            timing,
            0.0 if exposure is None else exposure,
            shortened=inputs.keep_whole_lines,
        )
    dark: Dark | None = None
    if is_counts and not isinstance(inputs.dark, Unavailable):
        dark = findings.attempt(open_dark, own_dark(inputs.dark, on_disk, opened), timing, calibration, cube)
    irradiance: xr.Dataset | None = None
    with findings.step():
        if inputs.irradiance is not None and not isinstance(inputs.irradiance, Unavailable):
            is_open = isinstance(inputs.irradiance, xr.Dataset)
            irradiance = inputs.irradiance if is_open else open_irradiance(inputs.irradiance)
            irradiance = irradiance if times is None else cut_irradiance(irradiance, times.time)
    convention_attrs: dict[str, Any] = {}
    with findings.step():
        # the conventions of the navigation, with the names of assumed ones
        if timing.nav is not None:
            accepted = {item.name for item in fields(Convention)} - {"angle_unit", "stamp_reference"}
            declared = inputs.convention
            SchemaError.raise_if(
                (unknown := set(declared) - accepted),
                f"convention has {', '.join(sorted(unknown))}",
                expected=f"some of {', '.join(sorted(accepted))}",
                mend="pass angles in degree, and stamp= as a separate argument",
                code="key-unknown",
            )
            convention_attrs = Convention(**{"stamp_reference": timing.stamp, **declared}).to_attrs()
            assumed = [name for name in ASSUMED if name not in declared]
            convention_attrs |= {"navigation_assumed": ", ".join(assumed)} if assumed else {}
    saturation = findings.attempt(saturation_of, inputs.saturation_count, inputs.bit_depth, calibration)
    if findings.errors or cube is None or times is None:
        return xr.Dataset()
    variables: dict[str, xr.DataArray] = {cube.name: _lazy_cube(cube, times, inputs)}  # type: ignore[dict-item]
    attrs: dict[str, Any] = {"name": inputs.name or path.name.split(".")[0], "source": path.name}
    if exposure is not None:
        variables["exposure_time"] = label(
            xr.DataArray(exposure, dims=(ALONG_TRACK,) if exposure.ndim else ()), "exposure_time"
        )
        attrs["exposure_source"] = exposure_source
    variables |= calibration_parts(calibration, is_counts)
    if dark is not None and saturation is not None:
        variables["saturation_count"] = saturation
        variables |= dark.variables(needs_noise="read_noise" not in variables)
        attrs["dark_source"] = dark.source
    if irradiance is not None:
        variables |= {str(key): value for key, value in irradiance.data_vars.items()}
    line = with_numbers(xr.Dataset(variables, _coordinates(opened, calibration, times, inputs, path)))
    line = with_calibration_names(line)
    line.attrs = {
        **attrs,
        "srf_shape": "gaussian" if calibration is None else calibration.attrs["srf_shape"],
        "irradiance_srf_shape": "gaussian",
        **({} if irradiance is None else record_attrs(irradiance)),
        **scale_attrs(calibration if is_counts else None),
        "time_source": times.source,
        "stamp": timing.stamp,
        **convention_attrs,
        "dropped_frames": times.dropped,
        **{key: opened.attrs[key] for key in ("envi_comments", "envi_notes") if key in opened.attrs},
        **inputs.attrs,
    }
    return line


# --- cube --------------------------------------------------------------------------------------------------


def _check_cube(opened: xr.Dataset, inputs: FlightlineInputs) -> xr.DataArray:
    # Variable ``counts`` or ``radiance`` in sensor geometry, with units
    path = inputs.path
    name = next((name for name in ("counts", "radiance") if name in opened), None)
    if name is None:
        FormatError.raise_if(
            "values" in opened and opened["values"].dtype.kind in "iu",
            f"{path}: integers of an undeclared quantity",
            mend="pass dark=, quantity='counts' (in collect.toml: quantity = \"counts\" in [camera]), "
            "or radiance_units=",
            code="quantity-ambiguous",
        )
        raise FormatError(
            f"{path}: holds {', '.join(map(str, opened.data_vars)) or 'nothing'}",
            expected="raw counts, or radiance with radiance_units",
            code="quantity-wrong",
        )
    cube = opened[name]
    stated = cube.attrs.get("units")
    units = inputs.radiance_units or stated
    refuse(
        str(path),
        (
            set(cube.dims) != set(CUBE),
            Problem(
                f"dims {tuple(map(str, cube.dims))}",
                expected=f"{CUBE} (sensor geometry, not a map)",
                code="dims-wrong",
            ),
        ),
        (
            not all(cube.sizes.values()),
            Problem(f"an empty cube of sizes {dict(cube.sizes)}", code="empty-input"),
        ),
        (
            name == "counts" and (cube.dtype.kind != "u" or cube.dtype.itemsize > 2),
            Problem(
                f"samples are {cube.dtype}",
                expected="raw counts: uint16 (ENVI data type 12) or uint8 (1)",
                code="type-wrong",
            ),
        ),
        (
            name == "radiance" and units is None,
            Problem(
                "radiance without units",
                mend="pass radiance_units, for example 'mW cm-2 sr-1 um-1'",
                code="units-missing",
            ),
        ),
        (
            name == "radiance" and stated and conversion_factor(str(stated), str(units)) != 1.0,
            Problem(
                f"radiance_units is {units!r}, but its header says {stated!r}",
                mend="correct one of them",
                code="units-conflict",
            ),
        ),
    )
    if name == "radiance":
        cube = cube.assign_attrs(units=units)
        # raises for an unreadable unit now, so that it is listed with the other problems
        conversion_factor(str(units), VARIABLES[name].units)
    return cube if cube.dims == CUBE else cube.transpose(*CUBE)


def _lazy_cube(cube: xr.DataArray, times: LineTimes, inputs: FlightlineInputs) -> xr.DataArray:
    # Chunk the cube, convert it, and blank its dropped lines, without reading samples
    name = str(cube.name)
    cube = cube.drop_vars(list(cube.coords)).drop_encoding()
    dropped = np.flatnonzero(~times.recorded)
    units = cube.attrs.get("units")
    needs_conversion = name != "counts" and (units != VARIABLES[name].units or cube.dtype != np.float32)
    automatic = isinstance(inputs.chunks, str) and inputs.chunks == "auto"
    if not automatic and inputs.chunks is not None:
        cube = cube.chunk(inputs.chunks)
    elif cube.chunks is None and (automatic or dropped.size or needs_conversion):
        # without dask, conversion and blanking would read the cube
        cube = cube.chunk({ALONG_TRACK: CHUNK_LINES, BAND: -1, CROSS_TRACK: -1})
    if name == "radiance":
        cube = convert(cube.astype(np.float32, copy=False), VARIABLES[name].units)
    elif cube.dtype != np.uint16:
        cube = cube.astype(np.uint16)
    if dropped.size:
        blanked = cube.data.map_blocks(_blank, dropped=dropped, dtype=cube.dtype, meta=cube.data._meta)
        cube = cube.copy(data=blanked)
    return label(cube, name)


def _blank(block: Array, dropped: Indices, block_info: Mapping[Any, Any] | None = None) -> Array:
    # A block of lines with its dropped lines blanked
    start, stop = (block_info or {})[0]["array-location"][0]
    inside = dropped[(dropped >= start) & (dropped < stop)] - start
    if inside.size:
        block = block.copy()
        block[inside] = BLANK_COUNT if block.dtype == np.uint16 else np.nan
    return block


# --- calibration -------------------------------------------------------------------------------------------


def _calibration(inputs: FlightlineInputs, cube: xr.DataArray | None, *, required: bool) -> xr.Dataset | None:
    if isinstance(inputs.calibration, Unavailable):
        return None
    line = inputs.path.name
    if inputs.calibration is None:
        SchemaError.raise_if(
            required,
            f"{line}: no calibration of the raw counts",
            mend="pass calibration=",
            code="calibration-missing",
        )
        SchemaError.raise_if(
            cube is not None and "wavelength" not in cube.coords,
            f"{line}: no wavelengths in the header",
            mend="pass the calibration of this camera",
            code="wavelength-missing",
        )
        return None
    calibration = open_calibration(inputs.calibration)
    gain = calibration["radiance_gain"]
    if cube is not None and any(cube.sizes[dim] != size for dim, size in gain.sizes.items()):
        raise SchemaError(
            "{} has {} bands x {} columns, the calibration {} bands x {} columns".format(
                line, *(sizes[dim] for sizes in (cube.sizes, gain.sizes) for dim in (BAND, CROSS_TRACK))
            ),
            mend="pass the calibration of this camera with the same binning",
            code="grid-mismatch",
        )
    return calibration


# --- coordinates -------------------------------------------------------------------------------------------


def _coordinates(
    opened: xr.Dataset, calibration: xr.Dataset | None, times: LineTimes, inputs: FlightlineInputs, path: Path
) -> dict[str, xr.DataArray]:
    coords: dict[str, xr.DataArray] = {}
    for source in (opened, calibration):
        for name in ("wavelength", "fwhm", "band_spacing", "good", "wavelength_shift", "srf_offset"):
            if source is not None and name in source.coords:
                array = source.coords[name].reset_coords(drop=True)
                is_joint = name == "good" and name in coords
                coords[name] = label(array & coords[name] if is_joint else array, name)
    if "fwhm" not in coords and inputs.fwhm_nm is not None:
        coords["fwhm"] = label(xr.DataArray(np.full(opened.sizes[BAND], inputs.fwhm_nm), dims=BAND), "fwhm")
    if "wavelength" in coords and coords["wavelength"].size > 1 and "band_spacing" not in coords:
        # stored for every band, as the slope below, so that it remains after a selection of bands
        coords["band_spacing"] = label(
            xr.DataArray(np.abs(np.gradient(coords["wavelength"].values)), dims=BAND), "band_spacing"
        )
    if calibration is not None:
        gain = calibration["radiance_gain"].transpose(*ELEMENT)
        slope = responsivity_slope(
            {"radiance_gain": gain.values, **{n: coords[n].values for n in ("wavelength", "fwhm")}}
        )
        coords["responsivity_slope"] = label(xr.DataArray(slope, dims=BAND), "responsivity_slope")
    if calibration is not None and "wavelength" in opened.coords:
        difference_nm = float(np.abs(opened["wavelength"].values - calibration["wavelength"].values).max())
        warn_if(
            difference_nm > _WAVELENGTH_TOLERANCE_NM,
            f"{path.name}: wavelengths of header and calibration are up to {difference_nm:.3g} nm apart; "
            "the wavelengths of the calibration are used",
            "wavelength-conflict",
        )
    line_values = {"time": times.time, "frame": times.frame, **times.pose}
    return coords | {
        name: label(xr.DataArray(values, dims=ALONG_TRACK), name)
        for name, values in line_values.items()
        if name != "time" or times.source != UNKNOWN_TIMES
    }
