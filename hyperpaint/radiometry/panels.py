"""Targets of known reflectance in the scene, and what the chain makes of them without their help."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.schema import ALONG_TRACK, CROSS_TRACK
from hyperpaint.base.units import convert, takes_quantities

from . import slabs

__all__ = ["Panel", "panel_inputs"]


@takes_quantities()
@dataclass(frozen=True)
class Panel:
    """A target of known reflectance in the scene.

    Attributes
    ----------
    along_track, cross_track
        Lines and columns it fills, by position.
    reflectance
        Its reflectance factor: a number [1], or a DataArray [any unit of it] with a coordinate ``wavelength``
        [any unit of length].
    uncertainty
        Relative standard uncertainty of its reflectance [1].

    Raises
    ------
    SchemaError
        The reflectance or its uncertainty is out of range.
    """

    along_track: slice
    cross_track: slice
    reflectance: Any
    uncertainty: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.uncertainty < 1.0:
            raise SchemaError(
                f"the panel's uncertainty is {self.uncertainty}, expected a fraction of 1, such as 0.02"
            )
        labelled = hasattr(self.reflectance, "coords")
        if labelled and "wavelength" not in self.reflectance.coords:
            raise SchemaError("the panel's reflectance has no coordinate 'wavelength' [nm]")
        if not labelled and not (np.ndim(self.reflectance) == 0 and 0 < self.reflectance <= 1.2):
            raise SchemaError(
                f"the panel's reflectance is {self.reflectance}, expected 0 to 1, or a DataArray"
            )

    def at(self, wavelength: Any) -> Any:
        """Return the reflectance at wavelengths (band,) [nm]; NaN outside what is known."""
        if np.ndim(self.reflectance) == 0:
            return np.full(np.shape(wavelength), float(self.reflectance))
        factor = convert(self.reflectance, "1", "reflectance")
        nm = convert(factor["wavelength"].astype(np.float64), "nm").values
        order = np.argsort(nm, kind="stable")
        return np.interp(wavelength, nm[order], factor.values[order], np.nan, np.nan)


def panel_inputs(
    dataset: xr.Dataset, panel: Panel, reflectance: Callable[[xr.Dataset], xr.Dataset]
) -> dict[str, Any]:
    """Return what is known of a panel in the scene, and its reflectance as seen without it.

    ``reflectance`` is that of `hyperpaint.radiometry.counts_to_reflectance`.
    """
    problems = Problems("the panel cannot be used", SchemaError)
    for dim in (ALONG_TRACK, CROSS_TRACK):
        chosen = range(dataset.sizes[dim])[getattr(panel, dim)]
        if not len(chosen):
            problems.add(f"{dim}={getattr(panel, dim)} holds none of the {dataset.sizes[dim]} of this line")
    problems.raise_if_any()
    region = dataset.isel({ALONG_TRACK: panel.along_track, CROSS_TRACK: panel.cross_track})
    # whatever scale the gain has, the panel takes it out
    seen = reflectance(region.assign_attrs(absolute_scale="of the panel"))["reflectance"]
    wavelength = slabs.small(dataset["wavelength"])
    if dataset["wavelength"].chunks is not None:
        wavelength = wavelength.map_blocks(panel.at, dtype=np.float64)
        return {"observed": seen.data, "reflectance": wavelength}
    return {"observed": seen.data, "reflectance": panel.at(wavelength)}
