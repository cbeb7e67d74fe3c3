"""Which variable of a line or map is exported, and which bands stand for red, green and blue."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from hyperpaint.base.errors import SchemaError
from hyperpaint.base.schema import ALONG_TRACK, BAND, CROSS_TRACK, VARIABLES

if TYPE_CHECKING:
    import xarray as xr
    from numpy.typing import ArrayLike

__all__ = ["RGB_WAVELENGTHS", "nearest_bands", "product_of", "stored_float"]

RGB_WAVELENGTHS = (640.0, 550.0, 460.0)
"""Of the bands that are shown as red, green and blue [nm]."""
_FARTHEST = 50.0
_PRODUCTS = ("reflectance", "radiance", "counts", "values")
_GEOMETRIES = ({ALONG_TRACK, CROSS_TRACK}, {"y", "x"})


def product_of(dataset: xr.Dataset, variable: str | None) -> xr.DataArray:
    """Return the variable to be written: the one named, else the first product there is.

    Raises
    ------
    SchemaError
        There is none, or its dims are not those of a cube or of a plane.
    """
    name = variable or next((name for name in _PRODUCTS if name in dataset.data_vars), None)
    if name is None or name not in dataset.variables:
        held = ", ".join(map(str, dataset.data_vars)) or "nothing"
        wanted = "one of " + ", ".join(_PRODUCTS) if name is None else repr(name)
        raise SchemaError(f"there is no {wanted} to write; the dataset holds {held}: name one with variable=")
    array = dataset[name]
    if set(array.dims) - {BAND} not in _GEOMETRIES or not array.size:
        raise SchemaError(
            f"{name!r} is {dict(array.sizes)}, expected ({ALONG_TRACK}, {BAND}, {CROSS_TRACK}) or "
            f"(y, x, {BAND}), with or without {BAND}, and no dim of size 0"
        )
    return array.reset_coords(drop=True)


def stored_float(array: xr.DataArray) -> type[np.floating[Any]]:
    """Return the type that a variable of floats is written in.

    That is float32, but for what needs more: map coordinates in float32 are off by decimetres.
    """
    row = VARIABLES.get(str(array.name))
    exact = row is not None and row.dtype == "float64" and array.dtype.itemsize >= 8
    return np.float64 if exact else np.float32


def nearest_bands(wavelength: ArrayLike, wanted: tuple[float, ...]) -> list[int] | None:
    """Return the indices of the bands nearest to wavelengths [nm]; None where one is over 50 nm away.

    Examples
    --------
    >>> nearest_bands([450.0, 551.0, 645.0, 850.0], RGB_WAVELENGTHS)
    [2, 1, 0]
    """
    nm = np.asarray(wavelength, np.float64)
    away = np.abs(nm[None, :] - np.array(wanted)[:, None])
    if not nm.size or not np.isfinite(nm).all() or (away.min(axis=1) > _FARTHEST).any():
        return None
    return [int(band) for band in away.argmin(axis=1)]
