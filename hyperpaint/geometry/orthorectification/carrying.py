"""What of a flight line comes along to its map, and what stands where there is nothing."""

from __future__ import annotations

import uuid
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.schema import ALONG_TRACK, BAND, CROSS_TRACK, CUBE, Quality, label
from hyperpaint.radiometry.counts_to_reflectance import reflectance
from hyperpaint.radiometry.spectral_axis import to_nominal

if TYPE_CHECKING:
    import dask.array as da
    import xarray as xr

    from .tiling import Tiles

__all__ = ["empty_value", "in_slabs", "mapped", "prepared"]

_PRODUCTS = ("reflectance", "radiance")
_BY_DEFAULT = ("quality", "time", "irradiance_age", "view_zenith", "view_azimuth", "ground_height")
_RENAMED = {"time": "line_time"}
_TURNING = ("view_azimuth", "sun_azimuth", "heading", "longitude")
"""Angles that jump from 360 to 0, or from 180 to -180, between which nothing can be interpolated."""
_PIXEL = (ALONG_TRACK, CROSS_TRACK)


def prepared(line: xr.Dataset, variables: Iterable[str] | None) -> tuple[xr.Dataset, list[str]]:
    """Return a line whose spectra are at nominal wavelengths, and the variables that are to come along.

    Without a choice that is its reflectance, else its radiance; with counts alone reflectance is computed.

    Raises
    ------
    SchemaError
        Variables that it does not have, of dims that have no place on a map, or of types other than numbers,
        flags and times; all are listed. Or there is no reflectance, and none can be computed.
    UnitsError
        As `hyperpaint.reflectance`.
    """
    if isinstance(variables, str):
        variables = (variables,)
    if variables is None:
        top = [name for name in _PRODUCTS if name in line.variables][:1]
        if not top and "counts" in line.variables:
            line, top = reflectance(line), ["reflectance"]
        names = [*top, *(name for name in _BY_DEFAULT if name in line.variables)]
    else:
        names = list(dict.fromkeys(variables))
    problems = Problems("these cannot be brought to a map", SchemaError)
    for name in names:
        if name not in line.variables:
            held = ", ".join(sorted(map(str, line.variables)))
            problems.add(f"{name!r} is not there; the line has {held:.400}")
        elif not _is_mapped(line[name].dims):
            dims = ", ".join(map(str, line[name].dims)) or "a scalar"
            problems.add(f"{name!r} ({dims}) has no place on a map, expected along_track or cross_track")
        elif _native(line[name].dtype) is None or (BAND in line[name].dims and line[name].dtype.kind == "M"):
            expected = "numbers" if BAND in line[name].dims else "numbers, flags or times"
            problems.add(f"{name!r} is {line[name].dtype}, expected {expected}")
    problems.raise_if_any()
    line = _as_native(line, names)
    spectra = [name for name in names if name in _PRODUCTS]
    if spectra and "wavelength_shift" in line.variables:
        line = line.assign({name: to_nominal(line)[name] for name in spectra})
    return line, names


def _is_mapped(dims: Sequence[Any]) -> bool:
    return set(dims) in ({*CUBE}, {*_PIXEL}, {ALONG_TRACK}, {CROSS_TRACK})


def _native(dtype: np.dtype[Any]) -> np.dtype[Any] | None:
    """Return the type that kernels take in place of one: in the machine's byte order, no half floats."""
    if dtype.kind == "f":
        return np.dtype(np.float64 if dtype.itemsize > 4 else np.float32)
    return dtype.newbyteorder("=") if dtype.kind in "biuM" else None


def _as_native(line: xr.Dataset, names: Sequence[str]) -> xr.Dataset:
    """Return a line whose variables have types that kernels take; what has keeps its memory."""
    wanted = {name: _native(line[name].dtype) for name in names}
    # numpy takes types of either byte order for equal
    other = [
        name for name, dtype in wanted.items() if dtype is not None and dtype.str != line[name].dtype.str
    ]
    made = {name: line[name].astype(wanted[name]) for name in other}
    coords = {name: made.pop(name) for name in other if name in line.coords}
    return line.assign(made).assign_coords(coords)


def empty_value(name: str, dtype: np.dtype[Any]) -> Any:
    """Return what a cell gets that no pixel shows.

    NaN and NaT; ``off_swath`` of ``quality``; of whole numbers -1, or the largest where there is no -1.
    """
    if name == "quality":
        return np.uint16(Quality.OFF_SWATH)
    if dtype.kind == "M":
        return np.datetime64("NaT", "ns")
    if dtype.kind == "f":
        return dtype.type(np.nan)
    if dtype.kind == "b":
        return np.bool_(False)
    return dtype.type(-1) if dtype.kind == "i" else dtype.type(np.iinfo(dtype).max)


def mapped(line: xr.Dataset, names: Sequence[str], tiles: Tiles, lines: tuple[int, ...]) -> dict[str, Any]:
    """Return the variables on a map, by their names there.

    Parameters
    ----------
    line
        What `prepared` has returned.
    names
        Variables.
    tiles
        The map.
    lines
        Lines of every slab.
    """
    import xarray as xr

    made = {}
    for name in names:
        values = _on_map(line[name], name, tiles, lines)
        kept = {key: value for key, value in line[name].attrs.items() if key != "grid_mapping"}
        dims = ("y", "x", BAND)[: values.ndim]
        array = xr.DataArray(values, dims=dims, attrs={**kept, "grid_mapping": "spatial_ref"})
        if name == "quality":
            array = label(array, name, **kept, grid_mapping="spatial_ref")
        elif values.dtype.kind in "iu":
            array.attrs["empty_value"] = empty_value(name, values.dtype)
        made[_RENAMED.get(name, name)] = array
    return made


def _on_map(array: xr.DataArray, name: str, tiles: Tiles, lines: tuple[int, ...]) -> Any:
    if BAND in array.dims:
        dtype = np.dtype(np.float32) if tiles.bilinear and array.dtype.kind != "f" else array.dtype
        return tiles.cube(in_slabs(array.transpose(*CUBE), lines), empty_value(name, dtype))
    array = array.astype("datetime64[ns]") if array.dtype.kind == "M" else array
    empty = empty_value(name, array.dtype)
    if array.ndim == 2:
        return tiles.plane(in_slabs(array.transpose(*_PIXEL), lines), _kind(array, name), empty)
    values = array.chunk({array.dims[0]: -1}).data
    return tiles.lines(values, empty) if array.dims == (ALONG_TRACK,) else tiles.columns(values, empty)


class _InMemory:
    """An array in memory, of which dask neither makes a copy nor a hash."""

    def __init__(self, array: npt.NDArray[Any]) -> None:
        self._array = array
        self.shape, self.dtype, self.ndim = array.shape, array.dtype, array.ndim

    def __getitem__(self, key: Any) -> Any:
        return self._array[key]


def in_slabs(array: xr.DataArray, lines: tuple[int, ...]) -> da.Array:
    """Return an array in chunks of whole lines."""
    chunks: dict[Any, Any] = {dim: lines if dim == ALONG_TRACK else -1 for dim in array.dims}
    values = array.variable._data
    if not isinstance(values, np.ndarray):
        lazy: da.Array = array.chunk(chunks).data
        return lazy
    import dask.array as da

    name = f"in-memory-{uuid.uuid4().hex}"
    meta = np.empty((0,) * values.ndim, values.dtype)
    return da.from_array(_InMemory(values), tuple(chunks.values()), name, asarray=False, meta=meta)


def _kind(array: xr.DataArray, name: str) -> str:
    """Return how a plane is brought to the map where spectra are interpolated."""
    if "flag_masks" in array.attrs or name == "quality":
        return "flags"
    return "bilinear" if array.dtype.kind == "f" and name not in _TURNING else "nearest"
