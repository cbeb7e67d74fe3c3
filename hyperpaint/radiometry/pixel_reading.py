"""Reflectance of a pixel, a region or a band: reads only its storage chunks, without a scheduler.

The worked example: one pixel of known reflectance, with its calibration and light.

Means of blocks of pixels: a flight line at the size of a screen, stored beside the line by `process`.
"""

import dataclasses
from types import SimpleNamespace
from typing import Any

import dask
import numpy as np
import xarray as xr

from hyperpaint.base import (
    ALONG_TRACK,
    BAND,
    CHUNK_LINES,
    CROSS_TRACK,
    CUBE,
    IRRADIANCE_TIME,
    IRRADIANCE_WAVELENGTH,
    VARIABLES,
    Array,
    ArrayLike,
    SchemaError,
    documented,
    has_own_means,
    is_number,
    label,
    rename_to_roles,
    require,
    round_bits,
    stamp_means,
    takes_quantities,
)
from hyperpaint.io.store import scheduler_in_force
from hyperpaint.kernels.arguments import SlabOutputs
from hyperpaint.kernels.overviews import average_blocks

from .counts_to_reflectance import applied, merged_quality, reflectance
from .panels import declared_panels, declared_scale
from .planning import PLANS, Entry, make_plan, plan_inputs
from .slabs import NO_CUBE, Plan, calibrate_lines, line_chunked
from .spectral_axis import bands_at

SCREEN = SimpleNamespace(
    lines=1000,
    #: Pixels along the side of the smallest block: stored means are at most a sixteenth of the cube.
    min_block_side=4,
    #: Mantissa bits of a stored mean: precision and size of float16, in a type that netCDF holds.
    means_bits=10,
)

_SIDE = "block_side"


@takes_quantities()
@documented()
def coarse(dataset: xr.Dataset, *, side: int | None = None) -> xr.Dataset:
    """Return a flight line at the size of a screen: means of blocks of ``side`` x ``side`` pixels.

    Lazy. Reads the means that `process` stored beside the line if they are valid, else computes them from the
    cube.

    Parameters
    ----------
    dataset
    side
        Lines and columns of a block, at most 32; by default the stored side, else the smallest power of 2
        from 4 to 32 that leaves at most 1,000 lines.

    Returns
    -------
    Dataset
        ``reflectance`` (along_track, band, cross_track), float32, with the coordinates of the middles of
        blocks: an ordinary flight line. ``coarse(line).paint.at(650.0)`` is the picture of a band,
        ``coarse(line).paint.rgb()`` the picture in colour. Its pixel ``(y, x)`` is the mean of the valid
        pixels of lines ``y * side`` to ``(y + 1) * side`` and those columns. Attributes of ``reflectance``:
        ``block_side`` is the side, ``level`` is ``stored``, with 11 bits, or ``computed``.

    Raises
    ------
    SchemaError
        The line has neither reflectance nor the variables to compute it; or ``side`` is not 1 to 32.

    Notes
    -----
    Stored means are used where the reflectance, or without it the variables that it is computed from, are
    unchanged since `open_store` opened them.

    Examples
    --------
    >>> from hyperpaint.radiometry.pixel_reading import worked_example
    >>> coarse(worked_example(), side=4).reflectance.values.round(3)
    array([[[0.4],
            [0.4],
            [0.4]]], dtype=float32)
    """
    line = rename_to_roles(dataset)
    SchemaError.raise_if(
        side is not None and not 1 <= side <= CHUNK_LINES,
        f"side={side}",
        expected=f"1 to {CHUNK_LINES} lines and columns of a block",
        code="value-out-of-range",
    )
    stored = _stored(line, side)
    if stored is None:
        line = line if "reflectance" in line.variables else reflectance(line)
        means = coarse_reflectance(line, side)
    else:
        means = stored.transpose(*VARIABLES["coarse_reflectance"].dims)
    side = int(means.attrs[_SIDE])
    middle_positions = {
        dim: np.minimum(np.arange(0, line.sizes[dim], side) + side // 2, line.sizes[dim] - 1)
        for dim in (ALONG_TRACK, CROSS_TRACK)
    }
    small_coordinates = [name for name in line.coords if set(line[name].dims) <= set(CUBE)]
    labels = line[small_coordinates].isel(middle_positions, missing_dims="ignore")
    level = "computed" if stored is None else "stored"
    values = xr.DataArray(means.data.astype(np.float32), dims=CUBE)
    return labels.assign(reflectance=label(values, "reflectance", **{_SIDE: side, "level": level}))


def coarse_reflectance(line: xr.Dataset, side: int | None = None) -> xr.DataArray:
    # Return the means of blocks of reflectance as they are stored beside a line, lazily.
    #
    # One small task per written slab; the same bits for all chunks.
    import dask.array as da

    cube = line_chunked(require(line, ["reflectance"], "means of blocks")["reflectance"])
    lines, bands, columns = cube.shape
    if side is None:
        side = SCREEN.min_block_side
        while side < CHUNK_LINES and lines > SCREEN.lines * side:
            side *= 2
    # every task has complete blocks
    starts = np.unique([*(np.cumsum((0, *cube.data.chunks[0])) // side * side)[:-1], lines])
    sizes = tuple(np.diff(starts).tolist()) or (0,)
    means = da.map_blocks(
        _means,
        cube.data if sizes == cube.data.chunks[0] else cube.data.rechunk({0: sizes}),
        side=side,
        chunks=(tuple(-(-size // side) for size in sizes), (bands,), (-(-columns // side),)),
        dtype=np.float32,
        meta=np.empty((0, 0, 0), np.float32),
    )
    spec = VARIABLES["coarse_reflectance"]
    out = xr.DataArray(means, dims=spec.dims, name=spec.name, attrs={**spec.attrs, _SIDE: side})
    stamp_means(out, line)
    return out


def _means(values: Array, side: int) -> Array:
    lines, bands, columns = values.shape
    out = np.empty((-(-lines // side), bands, -(-columns // side)), np.float32)
    average_blocks(np.ascontiguousarray(values, np.float32), side, out)
    return round_bits(out, SCREEN.means_bits)


def _stored(line: xr.Dataset, side: int | None) -> xr.DataArray | None:
    # Return the stored means if they belong to this line and are complete, else None.
    spec = VARIABLES["coarse_reflectance"]
    stored = line.get(spec.name)
    if stored is None or set(stored.dims) != set(spec.dims):
        return None
    stored_side = stored.attrs.get(_SIDE)
    if not isinstance(stored_side, int | np.integer) or stored_side < 1 or side not in (None, stored_side):
        return None
    lengths = {"coarse_y": line.sizes.get(ALONG_TRACK, 0), "coarse_x": line.sizes.get(CROSS_TRACK, 0)}
    is_complete = all(stored.sizes[dim] == -(-length // stored_side) for dim, length in lengths.items())
    return stored if is_complete and has_own_means(line) else None


# --- coarse lines ------------------------------------------------------------------------------------------


def worked_example() -> xr.Dataset:
    # Return one pixel whose reflectance is 0.4 by construction (three equal columns, three bands).
    #
    # E 1.3 W m-2 nm-1 on a surface of reflectance 0.4; etendue 1.8598e-11 m2 sr, 5 ms, bands 6 nm wide of
    # peak response 2e16 counts per joule: 1966.09 counts above the dark.
    gaussian_area = np.sqrt(np.pi / (4 * np.log(2)))
    etendue, exposure, peak, fwhm = 1.8598e-11, 5e-3, 2.0e16, 6.0
    gain = 1.0 / (etendue * peak * gaussian_area * fwhm)
    counts = exposure * 0.4 * 1.3 / np.pi / gain
    time = np.datetime64("2020-06-21T17:00:00", "ns")
    variables = {
        "counts": (CUBE, np.full((1, 3, 3), counts + 100.0, np.float32)),
        "dark_counts": ((BAND, CROSS_TRACK), np.full((3, 3), 100.0, np.float32)),
        "radiance_gain": ((BAND, CROSS_TRACK), np.full((3, 3), gain, np.float32)),
        "exposure_time": ((), exposure),
        "saturation_count": ((), np.float32(4095.0)),
        "irradiance": ((IRRADIANCE_TIME, IRRADIANCE_WAVELENGTH), np.full((2, 301), 1.3, np.float32)),
        "irradiance_fwhm": ((), 3.0),
    }
    coords = {
        "time": (ALONG_TRACK, [time + np.timedelta64(1, "s")]),
        "wavelength": (BAND, [548.0, 550.0, 552.0]),
        "fwhm": (BAND, np.full(3, fwhm)),
        IRRADIANCE_TIME: time + np.array([0, 2], "timedelta64[s]"),
        IRRADIANCE_WAVELENGTH: np.arange(400.0, 701.0),
    }
    line = xr.Dataset(variables, coords)
    for name in line.variables:
        line[name].attrs = dict(VARIABLES[str(name)].attrs)
    return line


# --- the worked example ------------------------------------------------------------------------------------

Place = int | slice

#: Number of lines that are read and calibrated together, beginning at the border of a storage chunk.
BLOCK_LINES = 2 * CHUNK_LINES

_NO_QUALITY = np.empty((0, 0), np.uint16)


@takes_quantities(wavelength="nm")
def pixels(
    dataset: xr.Dataset,
    along_track: Place = slice(None),
    cross_track: Place = slice(None),
    *,
    wavelength: ArrayLike | None = None,
) -> xr.Dataset:
    """Return reflectance of a pixel, a region or a band, with the bits of `reflectance`.

    Eager: only the storage chunks of the cube
    that hold the selection are read, without a scheduler. Calibration and light of a line are read on the
    first call and reused by later calls.

    Parameters
    ----------
    dataset
        A flight line with the variables that `reflectance` needs; where it has neither counts nor radiance,
        stored reflectance is read.
    along_track, cross_track
        Positions: a whole number, which drops the dim, or a slice.
    wavelength
        Wavelengths whose nearest bands are returned, as in `at`: a number, which drops the dim ``band``, or
        several [nm]; by default all.

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
    >>> from hyperpaint.radiometry.pixel_reading import worked_example
    >>> line = worked_example()
    >>> pixels(line, 0, 0).reflectance.values.round(3)
    array([0.4, 0.4, 0.4], dtype=float32)
    >>> pixels(line, wavelength=550.0).reflectance.dims
    ('along_track', 'cross_track')
    """
    line = rename_to_roles(dataset)
    selection: dict[str, Any] = {ALONG_TRACK: along_track, BAND: slice(None), CROSS_TRACK: cross_track}
    entry = _entry_of(line) if {"counts", "radiance"} & set(line.variables) else None
    if wavelength is not None:
        selection[BAND] = bands_at(line if entry is None else entry.labels, wavelength)
    positions = {dim: _positions(position, line, dim) for dim, position in selection.items()}
    if entry is None:
        names = [name for name in ("reflectance", "quality") if name in line.variables]
        require(line, names or ["reflectance"], "reflectance of pixels")
        return line[names].isel(positions, missing_dims="ignore").compute(scheduler=scheduler_in_force())
    single = {dim: 0 for dim, position in positions.items() if isinstance(position, int)}
    positions |= {dim: slice(positions[dim], positions[dim] + 1) for dim in single}
    # The reflectance of a region, `chosen` by dim, and with all bands its quality.
    lines, bands, columns = positions.values()
    plan, sizes = entry.plan, line.sizes
    is_flagged = isinstance(bands, slice) and bands == slice(0, sizes[BAND])
    is_from_counts = "counts" in line.variables
    # stray light and pedestal need all bands and columns of a line
    ranges_read: tuple[Any, Any] = (slice(0, sizes[BAND]), slice(0, sizes[CROSS_TRACK]))
    selected: tuple[Any, Any] = (bands, columns)
    if plan.stray is None and not len(plan.detector.masked):
        ranges_read = bands, _range_of(columns)
        selected = slice(None), slice(None) if isinstance(columns, slice) else columns - ranges_read[1].start
        plan = _part_of_plan(plan, *ranges_read)
    # the cube, which the plan was checked against
    cube = (
        line.variables["counts"].transpose(*CUBE)
        if is_from_counts
        else require(line, ["radiance"], "reflectance")["radiance"].variable
    )
    cubes, flags = [], []
    samples = sizes[BAND] * sizes[CROSS_TRACK]
    # blocks of lines that share storage chunks; small parts of lines are read in longer blocks
    numbers_of_lines = np.arange(sizes[ALONG_TRACK])[lines]
    first = numbers_of_lines.min(initial=sizes[ALONG_TRACK]) // CHUNK_LINES * CHUNK_LINES
    block = (numbers_of_lines - first) // (BLOCK_LINES * max(1, samples // max(1, plan.gain.size)))
    for numbers in np.split(numbers_of_lines, np.flatnonzero(np.diff(block)) + 1):
        rows_read = _range_of(numbers)
        counts = np.ascontiguousarray(_read_part(cube, (rows_read, *ranges_read)))
        if counts.dtype != np.uint16:
            counts = counts.astype(np.float32, copy=False)
        quality = np.empty(counts.shape[::2], np.uint16) if is_flagged else _NO_QUALITY
        outputs = SlabOutputs(np.empty(counts.shape, np.float32), quality, NO_CUBE, NO_CUBE)
        calibrate_lines(plan, counts, rows_read.start, outputs)
        rows = slice(None) if isinstance(lines, slice) else numbers - rows_read.start
        cubes.append(outputs.cube[rows][:, selected[0]][:, :, selected[1]])
        if is_flagged:
            flags.append(quality[rows][:, selected[1]])
    labels = entry.labels.isel(positions, missing_dims="ignore")
    values = label(xr.DataArray(np.concatenate(cubes), dims=CUBE), "reflectance", **labels.attrs)
    products = {"reflectance": values.variable}
    if is_flagged:
        earlier = None
        if "quality" in line.variables:
            stored = require(line, ["quality"], "reflectance")["quality"]
            part = stored.isel({ALONG_TRACK: lines, CROSS_TRACK: columns}).variable
            earlier = part.compute(scheduler=scheduler_in_force())
        merged = merged_quality("reflectance", np.concatenate(flags), earlier, anew=is_from_counts)
        products["quality"] = merged.variable
    region = labels.assign(products).assign_attrs(line.attrs)
    return region.isel(single) if single else region


def _positions(selection: Any, line: xr.Dataset, dim: str) -> Any:
    # Return a position from 0, a slice of step 1 if possible, or an array of positions.
    size = line.sizes.get(dim, 0)
    if isinstance(selection, slice):
        numbers = range(size)[selection]
        return slice(numbers.start, numbers.stop) if numbers.step == 1 else np.asarray(numbers)
    if np.ndim(selection):
        return np.asarray(selection)
    SchemaError.raise_if(
        not (is_number(selection) and -size <= selection < size and selection % 1 == 0),
        f"{dim} {selection!r:.40} is outside of this line",
        expected=f"a slice, or a whole number from {-size} to {size - 1}",
        code="pixel-outside-line",
    )
    return int(selection) % size


def _entry_of(line: xr.Dataset) -> Entry:
    cube = line["counts" if "counts" in line.variables else "radiance"]
    shape = (cube.sizes.get(ALONG_TRACK, 0), cube.sizes.get(BAND, 0), cube.sizes.get(CROSS_TRACK, 0))
    dtype = cube.dtype if cube.dtype == np.uint16 else np.dtype(np.float32)
    stored = declared_scale(line, other_light=False)
    options = (stored is None, None, False, make_plan, shape, dtype.str)
    entry = PLANS.entry(line, options)
    if entry.plan is not None and len(entry.labels.coords):
        return entry
    scale_panels = () if stored is None else declared_panels(line)
    inputs = plan_inputs(line, stored, scale_panels)[1]
    if entry.plan is None:
        (values,) = dask.compute(inputs, scheduler=scheduler_in_force())
        entry.plan = make_plan(shape, dtype.str, np.zeros(1, np.int64), **values)
    # small coordinates and the smile
    coords = {
        name: line[name]
        for name in line.coords
        if name == "wavelength_shift" or (set(line[name].dims) <= set(CUBE) and line[name].ndim < 2)
    }
    entry.labels = line[[]].assign_coords(coords).compute(scheduler=scheduler_in_force())
    attributes = {**applied(inputs["cube"]), "panel": "; ".join(map(str, scale_panels))}
    entry.labels.attrs = {name: text for name, text in attributes.items() if text}
    PLANS.add(entry)
    return entry


def _range_of(positions: Any) -> slice:
    if isinstance(positions, slice):
        return positions
    return slice(int(positions.min()), int(positions.max()) + 1) if len(positions) else slice(0, 0)


def _part_of_plan(plan: Plan, bands: Any, columns: slice) -> Plan:
    # Return the plan of selected bands and neighbouring columns; flags are only valid with all bands.
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
        detector=plan.detector._replace(weights=cut(plan.detector.weights)),
        column_flags=plan.column_flags[columns],
    )


def _read_part(cube: xr.Variable, selection: tuple[Any, ...]) -> Array:
    # Read a part of a cube; a dask array that wraps a file is read without dask.
    if cube.chunks is None:
        return np.asarray(cube[selection].values)
    data = cube.data
    # the array that was passed to `dask.array.from_array`
    sources = list(data.dask.layers.get(f"original-{data.name}", {}).values())
    if len(sources) == 1 and len(data.dask.layers) == 2:
        has_shape = getattr(sources[0], "shape", None) == data.shape
        if has_shape and getattr(sources[0], "dtype", None) == data.dtype:
            return np.asarray(sources[0][selection])
    return np.asarray(data[selection].compute(scheduler=scheduler_in_force()))
