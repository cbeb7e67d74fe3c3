"""The part of an irradiance record that belongs to a flight line."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from hyperpaint.base.errors import TimeError
from hyperpaint.base.schema import IRRADIANCE_TIME, label, require

if TYPE_CHECKING:
    import xarray as xr
    from numpy.typing import NDArray

__all__ = ["cut_irradiance"]

_MARGIN = np.timedelta64(60, "s")


def cut_irradiance(irradiance: xr.Dataset, time: NDArray[np.datetime64]) -> xr.Dataset:
    """Cut an irradiance record to a line +- 60 s, and at least to its bracketing samples.

    irradiance: ``irradiance`` (irradiance_time, irradiance_wavelength), ``irradiance_fwhm``,
        ``irradiance_max_gap`` and, where known, ``irradiance_clock_uncertainty``.
    time: UTC of the lines, NaT allowed, (along_track,).
    Returns xarray.Dataset: In memory, in the units of the table.
    Raises SchemaError: Variables or units are missing.
    Raises TimeError: Irradiance times do not increase, or no sample and no interval covers the line.
    """
    import xarray as xr

    names = ["irradiance", "irradiance_fwhm", "irradiance_max_gap"]
    if "irradiance_clock_uncertainty" in irradiance:
        names.append("irradiance_clock_uncertainty")
    variables = require(irradiance, names, "the irradiance of a flight line")
    stamps = variables["irradiance"][IRRADIANCE_TIME].values.astype("datetime64[ns]")
    if np.isnat(stamps).any() or (np.diff(stamps) <= np.timedelta64(0, "ns")).any():
        raise TimeError("irradiance times repeat, run backwards or are missing; sort them and drop repeats")
    valid_times = time[~np.isnat(time)]
    if (
        not valid_times.size
        or stamps.size == 0
        or stamps[-1] < valid_times.min()
        or stamps[0] > valid_times.max()
    ):
        covered = f"{_second(stamps[0])} to {_second(stamps[-1])}" if stamps.size else "nothing"
        flown = (
            f"{_second(valid_times.min())} to {_second(valid_times.max())}"
            if valid_times.size
            else "at unknown times"
        )
        raise TimeError(
            f"the irradiance record covers {covered} UTC, the line was flown {flown} UTC;"
            " check utc_offset_h and clock_offset_s"
        )
    first, last = valid_times.min(), valid_times.max()
    start = min(
        np.searchsorted(stamps, first - _MARGIN), max(np.searchsorted(stamps, first, side="right") - 1, 0)
    )
    stop = max(np.searchsorted(stamps, last + _MARGIN, side="right"), np.searchsorted(stamps, last) + 1)
    cut = xr.Dataset({name: label(array, name) for name, array in variables.items()})
    cut = cut.isel({IRRADIANCE_TIME: slice(int(start), int(stop))}).load()
    cut = cut.assign_coords({IRRADIANCE_TIME: cut[IRRADIANCE_TIME].astype("datetime64[ns]")})
    shape = irradiance.attrs.get("irradiance_srf_shape", "gaussian")
    return cut.drop_encoding().assign_attrs(irradiance_srf_shape=shape)


def _second(time: Any) -> str:
    return str(np.datetime_as_string(time, unit="s"))
