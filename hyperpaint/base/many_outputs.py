"""Tasks with several outputs: each array that a task computes becomes one lazy array.

A node of dask has one result. The task therefore returns all its arrays, by name or in order, as one block of
dtype object, and every output picks its array from it; dask fuses the picking with the next step.
"""

from collections.abc import Hashable, Mapping
from typing import Any, TypeVar

import dask.array as da
import numpy as np
import numpy.typing as npt

from .schema import Array

Key = TypeVar("Key", bound=Hashable)


def split_outputs(
    blocks: da.Array,
    dims: str,
    outputs: Mapping[Key, tuple[str, npt.DTypeLike]],
    sizes: Mapping[str, int] | None = None,
) -> dict[Key, da.Array]:
    # Return every output of the blocks as a lazy array.
    #
    # ``blocks``: dtype object; each block is the mapping or the tuple of arrays that a task returns.
    # ``dims``: Index of the blocks, one letter per dim. An output may lack dims along which there is a single
    # block. ``outputs``: Index and dtype of each output, by its key in the mapping or its position in the
    # tuple. ``sizes``: Length of the dims of outputs that ``blocks`` lacks.
    return {
        key: da.blockwise(
            _pick, index, blocks, dims, key=key, concatenate=False, dtype=np.dtype(dtype),
            new_axes={dim: (sizes or {})[dim] for dim in index if dim not in dims},
            meta=np.empty((0,) * len(index), dtype),
        )
        for key, (index, dtype) in outputs.items()
    }  # fmt: skip


def _pick(block: Any, key: Hashable) -> Array:
    while isinstance(block, list):  # along dims that the output lacks
        (block,) = block
    array: Array = block[key]
    return array
