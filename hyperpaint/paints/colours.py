"""Colours of the paints of a library in daylight."""

from __future__ import annotations

import numpy as np
import xarray as xr

from hyperpaint.base import schema
from hyperpaint.base.errors import SchemaError
from hyperpaint.base.facts import takes_quantities
from hyperpaint.base.schema import Floats32
from hyperpaint.light.daylight_colours import srgb


@takes_quantities()
def paint_colours(paints: xr.Dataset) -> Floats32:
    """Return the colour of every paint in daylight, (signature, 3), sRGB 0 to 1; NaN without visible bands.

    Bands that are not ``good`` are excluded.

    Examples
    --------
    >>> from hyperpaint.paints import starter_library
    >>> paints = starter_library(members=0)
    >>> red = paint_colours(paints.isel(signature=[5]))[0]
    >>> int(red.argmax()), red.shape
    (0, (3,))
    """
    variables = schema.require(paints, ["reflectance", "wavelength"], "colours", schema.LIBRARY_VARIABLES)
    values = variables["reflectance"].values
    if "good" in paints.variables:
        values = np.where(paints["good"].values.astype(bool), values, np.nan)
    try:
        return np.asarray(srgb(values, variables["wavelength"].values), np.float32)
    except SchemaError:  # fewer than three visible bands
        return np.full((len(values), 3), np.nan, np.float32)
