"""A flight line at the size of a screen: means of blocks of pixels, stored beside the line by `process`."""

from __future__ import annotations

import numpy as np
import xarray as xr

from hyperpaint.base import schema
from hyperpaint.base.arrays import Array, round_bits
from hyperpaint.base.errors import SchemaError
from hyperpaint.base.schema import ALONG_TRACK, CHUNK_LINES, CROSS_TRACK, CUBE
from hyperpaint.kernels.overviews import average_blocks

from .counts_to_reflectance import reflectance
from .slabs import line_chunked

SCREEN_LINES = 1000
#: Pixels along a side of a block: what is stored is at most a sixteenth of the cube.
SMALLEST_SIDE = 4
#: Mantissa bits of a stored mean: as good as half precision, in a type that netCDF holds, and as small.
MEANS_BITS = 10

_SIDE = "block_side"


def coarse(dataset: xr.Dataset, *, side: int | None = None) -> xr.Dataset:
    """Return a flight line at the size of a screen: means of blocks of ``side`` x ``side`` pixels.

    Lazy. What `process` stored beside the line is read where it serves, else the whole cube when it is
    computed.

    Parameters
    ----------
    dataset
        A flight line with ``reflectance``, or with what it follows from.
    side
        Lines and columns of a block, at most 32; by default of what is stored, else the smallest power of 2
        from 4 to 32 by which no more than 1,000 lines are left.

    Returns
    -------
    Dataset
        ``reflectance`` (along_track, band, cross_track), float32, and its coordinates, those of the middles
        of blocks: a line as any other. ``coarse(line).paint.at(650.0)`` is the picture of a band,
        ``coarse(line).paint.rgb()`` that of colours. Its pixel ``(y, x)`` is the mean, without what is
        missing, of lines ``y * side`` to ``(y + 1) * side`` and those columns. Attributes of ``reflectance``:
        ``block_side`` is the side, ``level`` says whether it was ``stored``, with 11 bits, or ``computed``.

    Raises
    ------
    SchemaError
        The line has no reflectance, nor what it follows from; or ``side`` is not 1 to 32.

    Notes
    -----
    What is stored is taken where the reflectance, or without it all it follows from, is as `open_store`
    opened it.

    Examples
    --------
    >>> from hyperpaint.radiometry.example_pixel import worked_example
    >>> coarse(worked_example(), side=4).reflectance.values.round(3)
    array([[[0.4],
            [0.4],
            [0.4]]], dtype=float32)
    """
    line = schema.rename_to_roles(dataset)
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
        means = stored.transpose(*schema.VARIABLES["coarse_reflectance"].dims)
    side = int(means.attrs[_SIDE])
    middles = {
        dim: np.minimum(np.arange(0, line.sizes[dim], side) + side // 2, line.sizes[dim] - 1)
        for dim in (ALONG_TRACK, CROSS_TRACK)
    }
    small = [name for name in line.coords if set(line[name].dims) <= set(CUBE)]
    labels = line[small].isel(middles, missing_dims="ignore")
    level = "computed" if stored is None else "stored"
    values = xr.DataArray(means.data.astype(np.float32), dims=CUBE)
    return labels.assign(reflectance=schema.label(values, "reflectance", **{_SIDE: side, "level": level}))


def coarse_reflectance(line: xr.Dataset, side: int | None = None) -> xr.DataArray:
    """Return the means of blocks of reflectance as they are stored beside a line, lazily.

    Made from the slabs that are written, one small task each; the same bits whatever the chunks.
    """
    import dask.array as da

    cube = line_chunked(schema.require(line, ["reflectance"], "means of blocks")["reflectance"])
    lines, bands, columns = cube.shape
    if side is None:
        side = SMALLEST_SIDE
        while side < CHUNK_LINES and lines > SCREEN_LINES * side:
            side *= 2
    # whole blocks in every task
    starts = np.unique([*(np.cumsum((0, *cube.data.chunks[0])) // side * side)[:-1], lines])
    sizes = tuple(np.diff(starts).tolist()) or (0,)
    slabs = cube.data if sizes == cube.data.chunks[0] else cube.data.rechunk({0: sizes})
    rows = tuple(-(-size // side) for size in sizes)
    means = da.map_blocks(
        _means,
        slabs,
        side=side,
        chunks=(rows, (bands,), (-(-columns // side),)),
        dtype=np.float32,
        meta=np.empty((0, 0, 0), np.float32),
    )
    row = schema.VARIABLES["coarse_reflectance"]
    out = xr.DataArray(means, dims=row.dims, name=row.name, attrs={**row.attrs, _SIDE: side})
    schema.stamp_means(out, line)
    return out


def _means(values: Array, side: int) -> Array:
    lines, bands, columns = values.shape
    out = np.empty((-(-lines // side), bands, -(-columns // side)), np.float32)
    average_blocks(np.ascontiguousarray(values, np.float32), side, out)
    return round_bits(out, MEANS_BITS)


def _stored(line: xr.Dataset, side: int | None) -> xr.DataArray | None:
    """Return the stored means where they are of this line, whole and as it was stored."""
    row = schema.VARIABLES["coarse_reflectance"]
    stored = line.get(row.name)
    if stored is None or set(stored.dims) != set(row.dims):
        return None
    own = stored.attrs.get(_SIDE)
    if not isinstance(own, int | np.integer) or own < 1 or side not in (None, own):
        return None
    sizes = {
        "coarse_y": -(-line.sizes.get(ALONG_TRACK, 0) // own),
        "coarse_x": -(-line.sizes.get(CROSS_TRACK, 0) // own),
    }
    if any(stored.sizes[dim] != size for dim, size in sizes.items()):
        return None
    return stored if schema.has_own_means(line) else None
