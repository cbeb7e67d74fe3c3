"""Slabs that were written of a line in flight, and which of them are those that the batch would write."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from hyperpaint.base.constants import KEPT_BITS, NUMERICS_VERSION
from hyperpaint.base.schema import ALONG_TRACK, CHUNK_LINES, CROSS_TRACK, CUBE

if TYPE_CHECKING:
    from hyperpaint.io.store.layout import Codec
    from hyperpaint.io.store.stage import Staging
    from hyperpaint.io.store.writer import Job
    from hyperpaint.radiometry.slabs import Plan

#: Variables computed from counts in flight.
PRODUCTS = ("reflectance", "quality")


def form_of(bands: int, columns: int, dtype: np.dtype[Any]) -> xr.Dataset:
    """Return arrays of counts and products, with lines enough for any flight and no values."""
    import dask.array as da

    lines = CHUNK_LINES * 2**20
    cube = {"counts": dtype, "reflectance": np.dtype(np.float32)}
    variables = {
        name: (CUBE, da.zeros((lines, bands, columns), dtype=each, chunks=-1)) for name, each in cube.items()
    }
    flags = da.zeros((lines, columns), dtype=np.uint16, chunks=-1)
    return xr.Dataset({**variables, "quality": ((ALONG_TRACK, CROSS_TRACK), flags)})


def digest_of(plan: Plan, first: int) -> str:
    """Return a digest of the inputs of a slab's products, counts excepted."""
    from dask.base import tokenize

    return str(tokenize(NUMERICS_VERSION, KEPT_BITS, plan.digest(first, first + CHUNK_LINES)))


def take_up(stage: Staging, job: Job) -> None:
    """Hand over to the writer the slabs of a line in flight that equal those of the finished line.

    Every slab is compared: its counts by their checksum, read again from the cube; its products by their
    calibration.
    """
    from hyperpaint.radiometry.slabs import plan_of

    from .flight_blocks import FlightBlocks

    dataset = job.dataset
    if "quality" not in dataset or "counts" not in dataset or dataset.sizes[ALONG_TRACK] < CHUNK_LINES:
        return
    counts = dataset["counts"]
    form = form_of(counts.shape[1], counts.shape[2], counts.dtype)
    names = [name for name in ("counts", *PRODUCTS) if name in dataset]
    for blocks in FlightBlocks.begun(stage, job.group, form[names], job.codec):
        plan = plan_of(dataset["quality"].data)
        sums = slab_sums(counts, job.codec)
        slabs = range(len(sums))
        blocks.forget([slab for slab in slabs if blocks.checksum("counts", slab) != sums[slab]], names)
        whole = counts.sizes[ALONG_TRACK] // CHUNK_LINES
        other = [
            slab
            for slab in slabs
            if slab >= whole or blocks.digests.get(slab) != digest_of(plan, slab * CHUNK_LINES)
        ]
        blocks.forget(other, [name for name in names if name != "counts"])
        blocks.hand_over(stage, job)


def slab_sums(counts: xr.DataArray, codec: Codec) -> list[int]:
    """Return the crc32c of every slab of counts as it would be stored; the counts are read anew."""
    import dask.array as da

    from hyperpaint.io.store.layout import encode_chunk, fill_value

    chunk = (CHUNK_LINES, *counts.shape[1:])

    def sums(block: Any) -> Any:
        firsts = range(0, len(block), CHUNK_LINES)
        fill = fill_value(block.dtype)
        slabs = [np.ascontiguousarray(block[first : first + CHUNK_LINES]) for first in firsts]
        ends = [encode_chunk(slab, chunk, fill, codec)[1] for slab in slabs]
        return np.array([int.from_bytes(end, "little") for end in ends], np.uint32)[:, None, None]

    data = counts.data
    chunks = (tuple(-(-size // CHUNK_LINES) for size in data.chunks[0]), (1,), (1,))
    read = da.map_blocks(sums, data, dtype=np.uint32, chunks=chunks, meta=np.empty((0, 0, 0), np.uint32))
    return [int(value) for value in read.compute().ravel()]
