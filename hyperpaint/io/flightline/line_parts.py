"""The steps of a flight line that need its cube and arguments alone: cube, exposure, saturation."""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hyperpaint.base.errors import FormatError, PaintWarning, SchemaError, Unavailable
from hyperpaint.base.schema import (
    ALONG_TRACK,
    BAND,
    CHUNK_LINES,
    CROSS_TRACK,
    CUBE,
    VARIABLES,
    label,
    rename_to_roles,
)
from hyperpaint.base.units import conversion_factor, convert

from .headwall import exposure_seconds, find_settings, read_settings
from .timing import LineTimes, Timing

if TYPE_CHECKING:
    import xarray as xr
    from numpy.typing import NDArray

__all__ = [
    "FlightlineInputs",
    "check_cube",
    "find_exposure",
    "find_saturation",
    "lazy_cube",
    "open_file",
    "path_of",
]

_BLANK = np.uint16(65535)


@dataclass(frozen=True, kw_only=True)
class FlightlineInputs:
    """What `assemble` needs; the fields are the arguments of `open_flightline`."""

    cube: Path | xr.Dataset
    timing: Timing | Unavailable
    exposure_time: Any = None
    dark: Any = None
    calibration: Path | xr.Dataset | Unavailable | None = None
    irradiance: Any = None
    bit_depth: int = 12
    saturation_count: float | None = None
    radiance_units: str | None = None
    fwhm_nm: float | None = None
    chunks: Any = "auto"
    name: str | None = None
    keep_whole_lines: bool = False
    convention: Mapping[str, Any] = field(default_factory=dict)
    attrs: Mapping[str, Any] = field(default_factory=dict)


def path_of(inputs: FlightlineInputs) -> Path:
    """Return the cube's path, or what names it in messages where it is a Dataset."""
    if isinstance(inputs.cube, Path):
        return inputs.cube
    return Path(inputs.name or str(inputs.cube.attrs.get("source", "cube")))


# --- cube --------------------------------------------------------------------------------------------------


def open_file(inputs: FlightlineInputs) -> xr.Dataset:
    """Open the cube's file, or give the dims of a Dataset the names of their roles."""
    from hyperpaint.io.envi.envi_cubes import open_envi

    if isinstance(inputs.cube, Path):
        opened = open_envi(inputs.cube, keep_whole_lines=inputs.keep_whole_lines)
    else:
        opened = rename_to_roles(inputs.cube)
    if "values" in opened and inputs.radiance_units:
        opened = opened.rename(values="radiance")
    return opened


def check_cube(opened: xr.Dataset, inputs: FlightlineInputs) -> xr.DataArray:
    """Return ``counts`` or ``radiance`` in sensor geometry, with units."""
    path = path_of(inputs)
    name = next((name for name in ("counts", "radiance") if name in opened), None)
    if name is None:
        held = ", ".join(map(str, opened.data_vars)) or "nothing"
        raise FormatError(f"{path}: holds {held}, expected raw counts or radiance (then give radiance_units)")
    cube = opened[name]
    if set(cube.dims) != set(CUBE):
        raise FormatError(
            f"{path}: dims {tuple(map(str, cube.dims))}, expected {CUBE}: sensor geometry, not a map"
        )
    if not all(cube.sizes.values()):
        raise FormatError(f"{path}: empty, {dict(cube.sizes)}")
    if name == "counts" and (cube.dtype.kind != "u" or cube.dtype.itemsize > 2):
        raise FormatError(
            f"{path}: samples are {cube.dtype}, expected raw counts: uint16 (ENVI data type 12) or uint8 (1)"
        )
    if name == "radiance":
        units = inputs.radiance_units or cube.attrs.get("units")
        if units is None:
            raise FormatError(
                f"{path}: radiance without units; give radiance_units, for example 'mW cm-2 sr-1 um-1'"
            )
        cube = cube.assign_attrs(units=units)
        # a wrong unit is reported now, with the other problems
        conversion_factor(str(units), VARIABLES[name].units)
    return cube if cube.dims == CUBE else cube.transpose(*CUBE)


def lazy_cube(cube: xr.DataArray, times: LineTimes, inputs: FlightlineInputs) -> xr.DataArray:
    """Chunk the cube, convert it, blank its dropped lines; no sample is read."""
    name = str(cube.name)
    cube = cube.drop_vars(list(cube.coords)).drop_encoding()
    dropped = np.flatnonzero(~times.recorded)
    units = cube.attrs.get("units")
    as_is = name == "counts" or (units == VARIABLES[name].units and cube.dtype == np.float32)
    automatic = isinstance(inputs.chunks, str) and inputs.chunks == "auto"
    if not automatic and inputs.chunks is not None:
        cube = cube.chunk(inputs.chunks)
    elif cube.chunks is None and (automatic or dropped.size or not as_is):
        # without dask, converting or blanking would read the cube
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
    """Return a block of lines without what stands in the dropped ones."""
    start, stop = (block_info or {})[0]["array-location"][0]
    inside = dropped[(dropped >= start) & (dropped < stop)] - start
    if inside.size:
        block = block.copy()
        block[inside] = _BLANK if block.dtype == np.uint16 else np.nan
    return block


# --- exposure ----------------------------------------------------------------------------------------------


def find_exposure(
    inputs: FlightlineInputs, path: Path, opened: xr.Dataset, *, required: bool
) -> tuple[NDArray[np.float64] | None, str]:
    """Return seconds and where they come from: the argument, ``settings.txt``, the header's comments."""
    said: dict[str, float] = {}
    given = None if inputs.exposure_time is None else np.asarray(inputs.exposure_time, np.float64)
    if given is not None:
        lines = opened.sizes.get(ALONG_TRACK)
        if given.ndim > 1 or (given.ndim == 1 and lines is not None and given.size != lines):
            raise SchemaError(
                f"{path.name}: exposure_time has shape {given.shape}, expected a scalar or {lines} lines"
            )
        if not (np.isfinite(given).all() and (given > 0).all()):
            raise SchemaError(
                f"{path.name}: exposure_time {given.min() * 1e3:g} ms, expected a positive number"
            )
    settings = find_settings(path) if isinstance(inputs.cube, Path) else None
    comments = json.loads(opened.attrs.get("envi_comments", "{}"))
    for source, pairs in (
        ("settings.txt", settings and read_settings(settings)),
        ("header comments", comments),
    ):
        try:
            value = exposure_seconds(pairs or {}, f"{path.name}: {source}")
        except FormatError:
            if given is None:
                raise
            continue
        if value is not None:
            said[source] = value
    stated = ", ".join(f"{source} {value * 1e3:g} ms" for source, value in said.items())
    if given is not None:
        if any(not np.allclose(given, value, rtol=1e-6, atol=0) for value in said.values()):
            message = f"exposure_time {given.flat[0] * 1e3:g} ms is used; {stated}"
            warnings.warn(f"{path.name}: {message}", PaintWarning, stacklevel=4)
        return given, "given"
    if said:
        source, value = next(iter(said.items()))
        if len(set(said.values())) > 1:
            warnings.warn(f"{path.name}: {stated}; the first is used", PaintWarning, stacklevel=4)
        return np.array(value), source
    # an unread header is another problem, not a missing exposure
    if required and opened.sizes:
        raise SchemaError(
            f"{path.name}: no exposure in settings.txt beside the cube nor in the header's comments;"
            " give exposure_time [s] (exposure_time_ms in collect.toml)"
        )
    return None, ""


# --- saturation --------------------------------------------------------------------------------------------


def find_saturation(inputs: FlightlineInputs, calibration: xr.Dataset | None) -> xr.DataArray:
    """Return ``saturation_count``: the argument, that of the calibration, or the converter's last count."""
    import xarray as xr

    given = inputs.saturation_count
    if given is None and calibration is not None and "saturation_count" in calibration:
        return calibration["saturation_count"].reset_coords(drop=True)
    if given is None:
        if not 1 <= inputs.bit_depth <= 16:
            raise SchemaError(f"bit_depth {inputs.bit_depth}, expected 1 to 16")
        given = 2**inputs.bit_depth - 1
    if not 0 < given <= 65535:
        raise SchemaError(f"saturation_count {given}, expected a count up to 65535")
    return label(xr.DataArray(np.float32(given)), "saturation_count")
