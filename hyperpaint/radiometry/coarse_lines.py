"""Means of blocks of pixels: a flight line at the size of a screen, stored beside the line by `process`."""

import numpy as np
import xarray as xr

from hyperpaint.base.errors import SchemaError
from hyperpaint.base.facts import documented
from hyperpaint.base.schema import (
    ALONG_TRACK,
    CHUNK_LINES,
    CROSS_TRACK,
    CUBE,
    VARIABLES,
    Array,
    has_own_means,
    label,
    rename_to_roles,
    require,
    round_bits,
    stamp_means,
)
from hyperpaint.kernels.overviews import average_blocks

from .counts_to_reflectance import reflectance
from .slabs import line_chunked

SCREEN_LINES = 1000
#: Pixels along the side of the smallest block: stored means are at most a sixteenth of the cube.
MIN_BLOCK_SIDE = 4
#: Mantissa bits of a stored mean: precision and size of float16, in a type that netCDF holds.
MEANS_BITS = 10

_SIDE = "block_side"


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
    >>> from hyperpaint.radiometry.example_pixel import worked_example
    >>> coarse(worked_example(), side=4).reflectance.values.round(3)
    array([[[0.4],
            [0.4],
            [0.4]]], dtype=float32)
    """
    line = rename_to_roles(dataset)
    if side is not None and not 1 <= side <= CHUNK_LINES:
        raise SchemaError(
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
        side = MIN_BLOCK_SIDE
        while side < CHUNK_LINES and lines > SCREEN_LINES * side:
            side *= 2
    # every task has complete blocks
    starts = np.unique([*(np.cumsum((0, *cube.data.chunks[0])) // side * side)[:-1], lines])
    sizes = tuple(np.diff(starts).tolist()) or (0,)
    slabs = cube.data if sizes == cube.data.chunks[0] else cube.data.rechunk({0: sizes})
    means = da.map_blocks(
        _means,
        slabs,
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
    return round_bits(out, MEANS_BITS)


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
