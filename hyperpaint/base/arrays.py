"""Types that all rooms share: arrays by dtype, and the progress callback."""

from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

Array: TypeAlias = npt.NDArray[Any]
ArrayLike: TypeAlias = npt.ArrayLike
Bools: TypeAlias = npt.NDArray[np.bool_]
Floats: TypeAlias = npt.NDArray[np.float64]
Floats32: TypeAlias = npt.NDArray[np.float32]
Indices: TypeAlias = npt.NDArray[np.intp]
Ints: TypeAlias = npt.NDArray[np.int64]
Times: TypeAlias = npt.NDArray[np.datetime64]
#: Called with the number of steps done and the total.
Progress: TypeAlias = Callable[[int, int], None]


def round_bits(values: Floats32, kept: int) -> Floats32:
    """Return values rounded to ``kept`` bits of the float32 mantissa, half to even, to compress well.

    Examples
    --------
    >>> round_bits(np.float32([0.1, np.nan]), 10)
    array([0.09997559,        nan], dtype=float32)
    """
    dropped = np.uint32(23 - kept)
    bits = np.ascontiguousarray(values).view(np.uint32)
    half = np.uint32((1 << (int(dropped) - 1)) - 1)
    return ((bits + half + ((bits >> dropped) & np.uint32(1))) >> dropped << dropped).view(np.float32)
