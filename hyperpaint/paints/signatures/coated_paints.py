"""Correction of the clear coat for those regions that are paint."""

from __future__ import annotations

import numpy as np
import xarray as xr

from hyperpaint.base.schema import SIGNATURE
from hyperpaint.regions import Regions
from hyperpaint.surroundings.coat_correction import correct_coat
from hyperpaint.surroundings.corrections import LEVELS, WIDTHS

#: Words of a region's ``kind`` or ``material`` that say it has no clear coat.
_NO_PAINT = frozenset(
    {
        "asphalt",
        "concrete",
        "glass",
        "grass",
        "ground",
        "leaf",
        "line",
        "soil",
        "target",
        "tyre",
        "vegetation",
        "wall",
        "white panel",
        "window",
    }
)

#: Words of ``finish`` or ``kind`` of paints whose signature holds at one geometry, the coat included.
_AT_A_GEOMETRY = frozenset({"metallic", "pearl"})


def without_coat(
    library: xr.Dataset,
    regions: Regions,
    index: float,
    sun_zenith: float | None,
) -> xr.Dataset:
    """Return a library without the share of a coat of the given index.

    Regions that are no paint, and metallic paint, stay unchanged.
    """
    words = [
        {str(region.properties.get(name, "")).lower() for name in ("kind", "material", "finish")}
        for region in regions
    ]
    is_paint = np.array([not region_words & (_NO_PAINT | _AT_A_GEOMETRY) for region_words in words])
    if not is_paint.any():
        return library
    corrected = correct_coat(library, index=index, sun_zenith=sun_zenith)
    if is_paint.all():
        return corrected
    paint = xr.DataArray(is_paint, dims=SIGNATURE)
    as_seen = library.assign(
        coat_transmission=xr.ones_like(corrected["coat_transmission"]),
        coat_transmission_u=xr.zeros_like(corrected["coat_transmission_u"]),
        reflectance_u_coat=xr.zeros_like(corrected["reflectance_u_coat"]),
    )
    changed = (*LEVELS, *WIDTHS, "coat_transmission", "coat_transmission_u", "reflectance_u_coat")
    return corrected.assign(
        {
            name: corrected[name].where(paint, as_seen[name]).transpose(*corrected[name].dims)
            for name in changed
            if name in corrected
        }
    )
