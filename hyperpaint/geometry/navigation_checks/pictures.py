"""One grey picture of a flight line, from a few of its bands."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from hyperpaint.base.errors import SchemaError
from hyperpaint.base.schema import ALONG_TRACK, BAND, CROSS_TRACK

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["picture_of"]

_CUBES = ("counts", "radiance", "reflectance")
_MOST_BANDS = 12
"""Bands averaged: enough against noise, without reading what adds nothing."""
_WAVELENGTHS = (500.0, 850.0)
"""Where a silicon camera sees best, and the atmosphere lets it [nm]."""


def picture_of(line: xr.Dataset, image: xr.DataArray | None) -> npt.NDArray[np.float32]:
    """Return a picture (along_track, cross_track) of a line, read once.

    Parameters
    ----------
    line
        Has ``counts``, ``radiance`` or ``reflectance``.
    image
        The picture itself, (along_track, cross_track), instead.

    Raises
    ------
    SchemaError
        There is no cube; the picture has other dims or sizes than the line.
    """
    if image is None:
        name = next((name for name in _CUBES if name in line.variables), None)
        if name is None:
            raise SchemaError(f"this line has no picture: none of {', '.join(_CUBES)}; give image=")
        image = line[name]
        if BAND in image.dims:
            image = image.isel({BAND: _bands(line)}).mean(BAND, dtype=np.float32)
    sizes = {dim: line.sizes[dim] for dim in (ALONG_TRACK, CROSS_TRACK) if dim in line.sizes}
    if set(image.dims) != {ALONG_TRACK, CROSS_TRACK} or any(image.sizes[d] != n for d, n in sizes.items()):
        raise SchemaError(f"the image is {dict(image.sizes)}, expected {sizes} as the line")
    values: Any = image.transpose(ALONG_TRACK, CROSS_TRACK).values
    return np.asarray(values, np.float32)


def _bands(line: xr.Dataset) -> npt.NDArray[np.int64]:
    chosen = np.arange(line.sizes[BAND])
    if "wavelength" in line.variables:
        wavelength = np.asarray(line["wavelength"].values, np.float64)
        inside = (wavelength >= _WAVELENGTHS[0]) & (wavelength <= _WAVELENGTHS[1])
        if "good" in line.variables:
            inside &= np.asarray(line["good"].values, bool)
        chosen = np.flatnonzero(inside) if inside.any() else chosen
    spread = np.linspace(0, chosen.size - 1, min(_MOST_BANDS, chosen.size))
    return np.asarray(chosen[np.unique(np.round(spread).astype(np.int64))])
