"""The record of a spectrometer that stands beside a rendered scene and looks at the sky."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import SchemaError
from hyperpaint.base.schema import IRRADIANCE_TIME, IRRADIANCE_WAVELENGTH, VARIABLES, dtype_of
from hyperpaint.simulation.sensor import convolve_gaussian

from .band_responses import cell_means
from .bands import BandSet
from .four_curves import Atmosphere

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["irradiance_record"]


_FWHM, _STEP = 3.0, 1.0  # nm, of the field spectrometer
_GRID_STEP = 0.05  # nm
_REACH = 3.3  # full widths of its line shape
_MARGIN = np.timedelta64(10**9, "ns")  # how far the record goes beyond the lines
_MOST_TIMES = 2000


def irradiance_record(
    traced: xr.Dataset,
    atmosphere: Atmosphere,
    sun_cosine: float,
    bands: BandSet,
    variation: Floats | None,
) -> xr.Dataset:
    """Return ``irradiance`` and its companions, as a flight line has them.

    Parameters
    ----------
    traced
        Its attributes say when the flight begins and ends.
    atmosphere
        The light.
    sun_cosine
        Cosine of the sun's zenith angle.
    bands
        Around which the record is cut.
    variation : (line, 2)
        Factors of direct and diffuse light in every line; the record follows them, lazily. None for ones.

    Raises
    ------
    SchemaError
        The dataset does not say when it begins and ends.
    """
    import xarray as xr

    centres, spectra = _spectra(atmosphere, sun_cosine, bands)
    times = _sample_times(traced, 0 if variation is None else len(variation))
    values: Any = np.broadcast_to(spectra.sum(axis=0), (times.size, centres.size)).astype(np.float32)
    if variation is not None:
        values = _varied(traced, times, variation, spectra)
    gap = np.diff(times).max() / np.timedelta64(1, "s")
    variables = {
        "irradiance": ((IRRADIANCE_TIME, IRRADIANCE_WAVELENGTH), values),
        "irradiance_fwhm": ((), np.float64(_FWHM)),
        "irradiance_max_gap": ((), np.float64(2.5 * gap)),
        "irradiance_clock_uncertainty": ((), np.float64(0.0)),
        IRRADIANCE_TIME: (IRRADIANCE_TIME, times),
        IRRADIANCE_WAVELENGTH: (IRRADIANCE_WAVELENGTH, centres),
    }
    labelled = {name: (*value, VARIABLES[name].attrs) for name, value in variables.items()}
    coords = {name: labelled.pop(name) for name in (IRRADIANCE_TIME, IRRADIANCE_WAVELENGTH)}
    return xr.Dataset(labelled, coords, {"irradiance_srf_shape": "gaussian"})


def _spectra(atmosphere: Atmosphere, sun_cosine: float, bands: BandSet) -> tuple[Floats, Floats]:
    """Return the channels [nm], and what they see of direct and diffuse light, (2, channel)."""
    wavelength = atmosphere.wavelength
    reach = _REACH * _FWHM
    low = max(wavelength[0], bands.lowest() - 4 * _FWHM)
    high = min(wavelength[-1], bands.highest() + 4 * _FWHM)
    centres = np.arange(np.ceil(low / _STEP), np.floor(high / _STEP) + 1) * _STEP
    # at the ends of a table a channel sees the half of its line shape that is there
    first, last = max(wavelength[0], centres[0] - reach), min(wavelength[-1], centres[-1] + reach)
    grid = np.arange(np.ceil(first / _GRID_STEP), np.floor(last / _GRID_STEP) + 1) * _GRID_STEP
    level = (atmosphere.sun * sun_cosine, atmosphere.sky)
    fine = np.stack([cell_means(wavelength, curve, grid) for curve in level])
    return centres, convolve_gaussian(fine, grid, centres, _FWHM)


def _sample_times(traced: xr.Dataset, lines: int) -> NDArray[np.datetime64]:
    """Return when the spectrometer measures: before and after the flight, and between where light varies."""
    try:
        first, last = (np.datetime64(traced.attrs[f"time_coverage_{end}"], "ns") for end in ("start", "end"))
    except (KeyError, ValueError, TypeError) as error:
        raise SchemaError(
            f"this is no traced dataset (see hyperpaint.trace): time_coverage_start or _end: {error}"
        ) from error
    between = np.empty(0, "datetime64[ns]")
    if lines:
        span = int(np.asarray(last - first, "timedelta64[ns]").astype(np.int64))
        steps = np.linspace(0, span, min(max(lines, 2), _MOST_TIMES)).astype(np.int64)
        between = first + np.unique(steps).astype("timedelta64[ns]")
    return np.concatenate([[first - _MARGIN], between, [last + _MARGIN]]).astype("datetime64[ns]")


def _varied(traced: xr.Dataset, times: Any, variation: Floats, spectra: Floats) -> Any:
    import dask
    import dask.array as da

    line_times = traced["time"].data
    shape = (times.size, spectra.shape[1])
    values = dask.delayed(_at_times, pure=True)(line_times, times, variation, spectra)
    return da.from_delayed(values, shape, dtype=dtype_of("irradiance"))


def _at_times(line_times: Any, times: Any, variation: Floats, spectra: Floats) -> NDArray[np.float32]:
    at = np.asarray(line_times).astype("datetime64[ns]").astype(np.int64)
    order = np.argsort(at, kind="stable")
    wanted = times.astype(np.int64) - at[order[0]]
    factors = np.stack([np.interp(wanted, at[order] - at[order[0]], part[order]) for part in variation.T])
    return (factors.T @ spectra).astype(np.float32)
