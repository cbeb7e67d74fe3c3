"""Reflectance of a pixel, a region or a band: reads only its storage chunks, without a scheduler."""

from __future__ import annotations

import dataclasses
from typing import Any

import dask
import numpy as np
import numpy.typing as npt
import xarray as xr

from hyperpaint.base import schema
from hyperpaint.base.arrays import Array
from hyperpaint.base.errors import SchemaError
from hyperpaint.base.schema import ALONG_TRACK, BAND, CHUNK_LINES, CROSS_TRACK, CUBE
from hyperpaint.base.units import takes_quantities
from hyperpaint.io.store.computing import scheduler_in_force
from hyperpaint.kernels.arguments import SlabOutputs

from .counts_to_reflectance import applied, merged_quality
from .line_inputs import plan_inputs
from .panels import declared_panels, declared_scale
from .plan_cache import PLANS, Entry, Origin
from .planning import make_plan
from .slabs import Plan, calibrate_lines
from .spectral_axis import bands_at

Place = int | slice

#: Lines that are read and calibrated at once, from the border of a storage chunk on.
BLOCK_LINES = 2 * CHUNK_LINES

_NO_QUALITY = np.empty((0, 0), np.uint16)
_NO_CUBE = np.empty((0, 0, 0), np.float32)


@takes_quantities(wavelength="nm")
def pixels(
    dataset: xr.Dataset,
    along_track: Place = slice(None),
    cross_track: Place = slice(None),
    *,
    wavelength: npt.ArrayLike | None = None,
) -> xr.Dataset:
    """Return reflectance of a pixel, a region or a band, with the bits of `reflectance`.

    Eager: the selection is known before anything is calibrated, so that only the storage chunks of the cube
    that hold it are read, without a scheduler. The calibration and light of a line are read on the first call
    and serve later ones.

    Parameters
    ----------
    dataset
        A flight line with the variables that `reflectance` needs; where it has neither counts nor radiance,
        stored reflectance is read.
    along_track, cross_track
        Positions: a whole number, which drops the dim, or a slice.
    wavelength
        The bands nearest to it, as in `at`: a number, which drops the dim ``band``, or several [nm]; by
        default all.

    Returns
    -------
    Dataset
        ``reflectance`` (along_track, band, cross_track), float32 [1], in memory, with its coordinates, and
        with all bands also ``quality`` (along_track, cross_track), uint16. The same bits as
        ``reflectance(dataset).isel(...)``.

    Raises
    ------
    SchemaError, UnitsError, TimeError
        As `reflectance` and `at`; or there is no such pixel.

    Examples
    --------
    >>> from hyperpaint.radiometry.example_pixel import worked_example
    >>> line = worked_example()
    >>> pixels(line, 0, 0).reflectance.values.round(3)
    array([0.4, 0.4, 0.4], dtype=float32)
    >>> pixels(line, wavelength=550.0).reflectance.dims
    ('along_track', 'cross_track')
    """
    line = schema.rename_to_roles(dataset)
    places: dict[str, Any] = {ALONG_TRACK: along_track, BAND: slice(None), CROSS_TRACK: cross_track}
    entry = None
    if {"counts", "radiance"} & set(line.variables):
        entry = _entry_of(line)
    if wavelength is not None:
        places[BAND] = bands_at(line if entry is None else entry.labels, wavelength)
    chosen = {dim: _positions(place, line, dim) for dim, place in places.items()}
    if entry is None:
        names = [name for name in ("reflectance", "quality") if name in line.variables]
        schema.require(line, names or ["reflectance"], "reflectance of pixels")
        return line[names].isel(chosen, missing_dims="ignore").compute(scheduler=scheduler_in_force())
    single = {dim: 0 for dim, place in chosen.items() if isinstance(place, int)}
    chosen |= {dim: slice(chosen[dim], chosen[dim] + 1) for dim in single}
    region = _calibrated(line, entry, chosen)
    return region.isel(single) if single else region


def _positions(place: Any, line: xr.Dataset, dim: str) -> Any:
    # A position from 0, a slice of step 1 where possible, or an array of positions
    size = line.sizes.get(dim, 0)
    if isinstance(place, slice):
        numbers = range(size)[place]
        return slice(numbers.start, numbers.stop) if numbers.step == 1 else np.asarray(numbers)
    if np.ndim(place):
        return np.asarray(place)
    if not -size <= place < size:
        raise SchemaError(
            f"{dim} {place} is outside of this line",
            expected=f"{-size} to {size - 1}",
            code="pixel-outside-line",
        )
    return int(place) % size


def _entry_of(line: xr.Dataset) -> Entry:
    cube = line["counts" if "counts" in line.variables else "radiance"]
    shape = (cube.sizes.get(ALONG_TRACK, 0), cube.sizes.get(BAND, 0), cube.sizes.get(CROSS_TRACK, 0))
    dtype = cube.dtype if cube.dtype == np.uint16 else np.dtype(np.float32)
    stored = declared_scale(line, other_light=False)
    options = (stored is None, None, False, make_plan, shape, dtype.str)
    entry = PLANS.entry(line, options)
    if entry is not None and len(entry.labels.coords):
        return entry
    scaling = () if stored is None else declared_panels(line)
    inputs = plan_inputs(line, stored, scaling)[1]
    if entry is None:
        (read,) = dask.compute(inputs, scheduler=scheduler_in_force())
        entry = Entry(Origin(line, options), make_plan(shape, dtype.str, np.zeros(1, np.int64), **read))
    small = [name for name in line.coords if set(line[name].dims) <= set(CUBE) and line[name].ndim < 2]
    smile = {"wavelength_shift"} & set(line.coords)
    notes = {**applied(inputs["cube"]), "panel": "; ".join(map(str, scaling))}
    labels = line[[]].assign_coords({name: line[name] for name in {*small, *smile}})
    entry.labels = labels.compute(scheduler=scheduler_in_force())
    entry.labels.attrs = {name: text for name, text in notes.items() if text}
    PLANS.add(entry)
    return entry


def _calibrated(line: xr.Dataset, entry: Entry, chosen: dict[str, Any]) -> xr.Dataset:
    # Reflectance of a region, `chosen` by dim, and with all bands its quality
    lines, bands, columns = chosen.values()
    plan, sizes = entry.plan, line.sizes
    is_flagged = isinstance(bands, slice) and bands == slice(0, sizes[BAND])
    is_from_counts = "counts" in line.variables
    # stray light and pedestal need all bands and columns of a line
    read: tuple[Any, Any] = (slice(0, sizes[BAND]), slice(0, sizes[CROSS_TRACK]))
    selected: tuple[Any, Any] = (bands, columns)
    if plan.stray is None and not len(plan.detector.masked):
        read = bands, _range_of(columns)
        selected = slice(None), slice(None) if isinstance(columns, slice) else columns - read[1].start
        plan = _part(plan, *read)
    # the cube, which was compared with the plan's
    cube = (
        line.variables["counts"].transpose(*CUBE)
        if is_from_counts
        else schema.require(line, ["radiance"], "reflectance")["radiance"].variable
    )
    cubes, flags = [], []
    samples = sizes[BAND] * sizes[CROSS_TRACK]
    for numbers in _blocks(np.arange(sizes[ALONG_TRACK])[lines], samples // max(1, plan.gain.size)):
        rows_read = _range_of(numbers)
        counts = np.ascontiguousarray(_read(cube, (rows_read, *read)))
        if counts.dtype != np.uint16:
            counts = counts.astype(np.float32, copy=False)
        quality = np.empty(counts.shape[::2], np.uint16) if is_flagged else _NO_QUALITY
        out = SlabOutputs(np.empty(counts.shape, np.float32), quality, _NO_CUBE, _NO_CUBE)
        calibrate_lines(plan, counts, rows_read.start, out)
        rows = slice(None) if isinstance(lines, slice) else numbers - rows_read.start
        cubes.append(out.cube[rows][:, selected[0]][:, :, selected[1]])
        if is_flagged:
            flags.append(quality[rows][:, selected[1]])
    labels = entry.labels.isel(chosen, missing_dims="ignore")
    values = schema.label(xr.DataArray(_joined(cubes), dims=CUBE), "reflectance", **labels.attrs)
    products = {"reflectance": values.variable}
    if is_flagged:
        before = None
        if "quality" in line.variables:
            stored = schema.require(line, ["quality"], "reflectance")["quality"]
            before = stored.isel({ALONG_TRACK: lines, CROSS_TRACK: columns}).variable.compute(
                scheduler=scheduler_in_force()
            )
        merged = merged_quality("reflectance", _joined(flags), before, anew=is_from_counts)
        products["quality"] = merged.variable
    return labels.assign(products).assign_attrs(line.attrs)


def _range_of(places: Any) -> slice:
    if isinstance(places, slice):
        return places
    return slice(int(places.min()), int(places.max()) + 1) if len(places) else slice(0, 0)


def _joined(blocks: list[Array]) -> Array:
    return blocks[0] if len(blocks) == 1 else np.concatenate(blocks)


def _blocks(numbers: Array, times: int) -> list[Array]:
    # Numbers of lines in blocks that share storage chunks: `times` as many lines as usual
    if not numbers.size:
        return [np.zeros(0, np.int64)]
    block = (numbers - numbers.min() // CHUNK_LINES * CHUNK_LINES) // (BLOCK_LINES * max(1, times))
    return np.split(numbers, np.flatnonzero(np.diff(block)) + 1)


def _part(plan: Plan, bands: Any, columns: slice) -> Plan:
    # Plan of some bands and neighbouring columns; flags hold with all bands only
    def cut(array: Array) -> Array:
        array = array[..., bands, :] if array.shape[-2] > 1 else array
        return np.ascontiguousarray(array[..., columns] if array.shape[-1] > 1 else array)

    def runs(array: Array) -> Array:
        return array[bands] if len(array) > 1 else array

    edges = np.clip(runs(plan.smile.edges) - columns.start, 0, columns.stop - columns.start)
    smile = dataclasses.replace(
        plan.smile, shift=cut(plan.smile.shift), edges=edges, cells=runs(plan.smile.cells)
    )
    return dataclasses.replace(
        plan,
        dark=cut(plan.dark),
        gain=cut(plan.gain),
        scale=plan.scale[..., bands],
        series=None if plan.series is None else plan.series[:, bands],
        smile=smile,
        saturation_limit=cut(plan.saturation_limit),
        noise_margin=cut(plan.noise_margin),
        column_flags=plan.column_flags[columns],
    )


def _read(cube: xr.Variable, places: tuple[Any, ...]) -> Array:
    # A part of a cube; a dask array that wraps a file is read without dask
    if cube.chunks is None:
        return np.asarray(cube[places].values)
    data = cube.data
    # the argument of `dask.array.from_array`
    sources = list(data.dask.layers.get(f"original-{data.name}", {}).values())
    if len(sources) == 1 and len(data.dask.layers) == 2:
        is_whole = getattr(sources[0], "shape", None) == data.shape
        if is_whole and getattr(sources[0], "dtype", None) == data.dtype:
            return np.asarray(sources[0][places])
    return np.asarray(data[places].compute(scheduler=scheduler_in_force()))
