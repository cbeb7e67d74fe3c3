"""A flight line from the files of its instruments: counts and all inputs of their calibration, lazily."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from hyperpaint.base.attitude_conventions import Convention
from hyperpaint.base.errors import (
    Findings,
    FormatError,
    Problem,
    SchemaError,
    Unavailable,
    warn_user,
)
from hyperpaint.base.facts import conversion_factor, convert, takes_quantities
from hyperpaint.base.schema import (
    ALONG_TRACK,
    BAND,
    CHUNK_LINES,
    CROSS_TRACK,
    CUBE,
    VARIABLES,
    label,
    rename_to_roles,
    with_calibration_names,
    with_numbers,
)
from hyperpaint.io.envi.envi_cubes import open_envi
from hyperpaint.io.files.reading import refuse
from hyperpaint.io.navigation.navigation_records import ASSUMED, Navigation
from hyperpaint.io.spectrometers.irradiance import cut_irradiance, open_irradiance, record_attrs

from .calibration_store import calibration_parts, open_calibration, saturation_of, scale_attrs
from .dark import Dark, open_dark, own_dark
from .headwall import find_exposure, recording_clock
from .timing import UNKNOWN_TIMES, LineTimes, Timing, line_times

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
        if isinstance(self.cube, Path):
            return self.cube
        return Path(self.name or str(self.cube.attrs.get("source", "cube")))


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
    source = cube if isinstance(cube, xr.Dataset) else Path(cube)
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
        times = LineTimes.unknown(cube.sizes[ALONG_TRACK])
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
    units = inputs.radiance_units or cube.attrs.get("units")
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


def _blank(
    block: NDArray[Any], dropped: NDArray[np.intp], block_info: Mapping[Any, Any] | None = None
) -> NDArray[Any]:
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
        # stored for every band, so that it remains after a selection of bands
        coords["band_spacing"] = label(
            xr.DataArray(np.abs(np.gradient(coords["wavelength"].values)), dims=BAND), "band_spacing"
        )
    if calibration is not None and "wavelength" in opened.coords:
        difference_nm = float(np.abs(opened["wavelength"].values - calibration["wavelength"].values).max())
        if difference_nm > _WAVELENGTH_TOLERANCE_NM:
            warn_user(
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
