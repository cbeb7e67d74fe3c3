"""Mean spectra of the columns of a cube, one slab in memory at a time."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from hyperpaint.base.arrays import Floats, Progress
from hyperpaint.base.schema import ALONG_TRACK
from hyperpaint.radiometry.slabs import line_chunked

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["Progress", "mean_over_lines"]


_FIRST_LINES = 64
"""Lines that tell which elements are bad."""


def mean_over_lines(
    cube: xr.DataArray, level: Floats, progress: Progress | None = None
) -> tuple[Floats, npt.NDArray[np.int64]]:
    """Return the mean over lines of a cube over its light's level (band, column), and the pixels in it.

    One slab is in memory at a time. Lines are added one after the other, so that the result does not depend
    on chunks. A pixel counts where no band is missing but those that are missing in each of the first lines;
    of these the mean is NaN.
    """
    cube = line_chunked(cube)
    count = cube.sizes[ALONG_TRACK]
    first = cube[:_FIRST_LINES].values
    seen = np.isfinite(first).any(axis=1, keepdims=True)
    bad = (np.isnan(first) | ~seen).all(axis=0) & seen.any(axis=0)
    total = np.zeros(cube.shape[1:])
    pixels = np.zeros(cube.shape[2], np.int64)
    start = 0
    for size in cube.chunks[0] if cube.chunks else (count,):
        slab = cube[start : start + size].values
        for values, light in zip(slab, level[start : start + size], strict=True):
            if np.isfinite(light):
                whole = (np.isfinite(values) | bad).all(axis=0)
                pixels += whole
                total += np.where(whole & ~bad, values, 0.0) / light
        start += size
        if progress is not None:
            progress(start, count)
    with np.errstate(invalid="ignore"):
        return np.where(bad | (pixels == 0), np.nan, total / pixels), pixels
