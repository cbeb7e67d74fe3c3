"""Dark references: cubes recorded with a closed lens, averaged element by element."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from hyperpaint.base.constants import QUANTISATION_VARIANCE_COUNT2
from hyperpaint.base.errors import FormatError, PaintError, SchemaError, TimeError, warn_user
from hyperpaint.base.schema import (
    ALONG_TRACK,
    BAND,
    CROSS_TRACK,
    CUBE,
    dtype_of,
    label,
    rename_to_roles,
    require,
)
from hyperpaint.io.envi.envi_cubes import open_envi

from .headwall import (
    DarkFrames,
    cube_number,
    exposure_seconds,
    exposure_sources,
    recording_clock,
    sum_dark,
)
from .timing import Timing, line_times, utc_of

DARK_NONE = "none"
_DARK_OF_CALIBRATION = "calibration"
#: Minimum number of lines of a dark cube for an estimate of read noise.
MIN_NOISE_LINES = 16
_ELEMENT = (BAND, CROSS_TRACK)


@dataclass(frozen=True)
class Dark:
    """Dark counts of a flight line."""

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
    wavelength: NDArray[np.float64] | None  #: (band,) of its header [nm]


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
    shape = None if cube is None else tuple(cube.sizes[dim] for dim in _ELEMENT)
    if isinstance(source, str) and source == DARK_NONE:
        if shape is None:
            return None
        zeros = label(xr.DataArray(np.zeros(shape, np.float32), dims=_ELEMENT), "dark_counts", dark="none")
        return Dark(zeros, (None,), None, DARK_NONE)
    if isinstance(source, str) and source == _DARK_OF_CALIBRATION:
        return None if calibration is None else _from_dark_counts(calibration, shape, "the calibration")
    if isinstance(source, xr.Dataset) and "dark_counts" in source:
        return _from_dark_counts(source, shape, "a Dataset")
    sources: Sequence[Any] = source if isinstance(source, (list, tuple)) else [source]
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
                dims=("dark_time", *_ELEMENT),
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
    if source is not None or path is None or "dark_lines" not in opened.attrs:
        return source
    return open_envi(path, unsaid="counts", dark_lines=True)


def _from_dark_counts(dataset: xr.Dataset, shape: tuple[int, ...] | None, name: str) -> Dark:
    exposure = dataset.get("dark_exposure_time")
    arrays = require(
        dataset, ["dark_counts"] + ([] if exposure is None else ["dark_exposure_time"]), "a dark correction"
    )
    counts = arrays["dark_counts"].astype(dtype_of("dark_counts"))
    check_shape(tuple(counts.sizes[dim] for dim in _ELEMENT), shape, f"dark_counts of {name}")
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
    if shape is not None and actual != shape:
        raise SchemaError(
            f"{name}: {actual[0]} bands x {actual[1]} columns",
            expected=f"{shape[0]} x {shape[1]}, as the cube",
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
        path = Path(source)
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
    sources = exposure_sources(path, opened)
    stated: Iterator[float | None] = (
        exposure_seconds(pairs, f"{role} {name}: {file}") for file, pairs in sources
    )
    if "exposure_time" in opened and opened["exposure_time"].ndim == 0:
        stated = iter([float(require(opened, ["exposure_time"], "a dark correction")["exposure_time"])])
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


def _labelled(values: NDArray[Any], name: str) -> xr.DataArray:
    return label(xr.DataArray(values.astype(np.float32), dims=_ELEMENT), name)
