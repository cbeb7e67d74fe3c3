"""Known errors of a flight line, source by source, and the samples that share each of them.

The tables are small for any number of lines: `averages` sums them over the pixels of a region.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import dask
import numpy as np
import xarray as xr

from hyperpaint.base.constants import QUANTISATION_VARIANCE_COUNT2
from hyperpaint.base.errors import SchemaError
from hyperpaint.base.schema import (
    ALONG_TRACK,
    BAND,
    CROSS_TRACK,
    IRRADIANCE_TIME,
    IRRADIANCE_WAVELENGTH,
    Array,
    Floats,
    require,
)
from hyperpaint.light.illumination import COMMON_SHARE, at_bands, matched_noise
from hyperpaint.light.synchrony import line_light
from hyperpaint.radiometry.stray_light import SHIFT_TIME, STRAY, STRAY_LIGHT, STRAY_U

from .propagation import (
    MASKED,
    NOISE,
    PANEL_U,
    SYSTEMATIC,
    UNCERTAINTIES,
    WHOLE_COUNTS,
    element_rows,
    masked_elements,
)


class Form(NamedTuple):
    """Samples that share an error, dim by dim, in the terms of FIDUCEO and obsarray."""

    along_track: str
    band: str
    cross_track: str

    def __str__(self) -> str:
        return ", ".join(f"{dim} {form}" for dim, form in zip(self._fields, self, strict=True))


#: Sources of error of a sample. Smile and smoothing correlate the random errors of neighbouring bands.
FORMS = {
    "noise": Form("random", "random", "random"),
    "mean dark": Form("systematic", "random", "random"),
    "gain of elements": Form("systematic", "random", "random"),
    "irradiance noise": Form("triangle_relative", "bell_relative", "systematic"),
    "pedestal": Form("random", "systematic", "systematic"),
    "gain": Form("systematic", "systematic", "systematic"),
    "white tile": Form("systematic", "systematic", "systematic"),
    "irradiance": Form("systematic", "systematic", "systematic"),
    "linearity": Form("systematic", "systematic", "systematic"),
    "panel": Form("systematic", "systematic", "systematic"),
    "dark": Form("systematic", "systematic", "systematic"),
    "wavelength": Form("systematic", "systematic", "systematic"),
    "stray light": Form("systematic", "systematic", "systematic"),
}

#: Variables of each source.
COMPONENTS = {
    "noise": NOISE,
    "mean dark": ("dark_counts_u_random",),
    "gain of elements": ("radiance_gain_u_random",),
    "irradiance noise": ("irradiance_u_random",),
    "pedestal": ("masked",),
    "gain": ("radiance_gain_u_systematic",),
    "white tile": ("reflectance_gain_u_systematic",),
    "irradiance": ("irradiance_u_systematic",),
    "linearity": ("linearity_u",),
    "panel": ("panel",),
    "dark": ("dark_counts_u_systematic",),
    "wavelength": ("wavelength_u",),
    "stray light": ("stray_light_u",),
}

MAX_HARMONICS = 20


class LightErrors(NamedTuple):
    # Irradiance of the bands, and its noise.
    #: before, after (line,) int64, weight (line,) float64: samples around every line, and weight of the later
    before: Array
    after: Array
    weight: Floats
    level: Floats  #: (band,) float64: irradiance, mean over the record [W m-2 nm-1]
    covariance: Floats  #: (band, band) float64: covariance of the noise of one sample, relative [1]


@dataclass(frozen=True)
class LineErrors:
    # Standard uncertainties of a line by their sources; (band, column) unless noted.
    per_electron: Floats  #: Counts per electron
    noise_floor: Floats  #: Variance of a count without light [count2]
    is_integer: bool  #: Whether counts are integers
    read_noise: Floats  #: [count]
    dark: Floats  #: Uncertainty of each mean dark [count]
    dark_weights: Floats  #: (line, dark): weight of each dark in a line
    gain_of_elements: Floats  #: Relative [1]
    common: Mapping[str, Floats]  #: Errors that all samples share, relative [1], by source
    dark_offset: Floats  #: Error of the dark that all elements share [count]
    pedestal_variance: float  #: Variance of the pedestal of a line [count2]
    wavelength_u: Floats  #: (band,) [nm]
    wavelength: Floats  #: (band,) [nm]
    light: LightErrors | None  #: None without noise of irradiance and without errors of wavelength
    #: (band, band): uncertainty of the light from a source band, counts per count; None without stray light
    stray_light: Floats | None


def line_errors(line: xr.Dataset) -> LineErrors | None:
    # Return the errors of a line whose reflectance has uncertainties; None where they cannot be separated.
    #
    # Reads the small variables. Errors can be separated if the line still holds the variables that its
    # uncertainties were computed from: reflectance from a store or a map without calibration has only their
    # sum.
    if not {"reflectance", *UNCERTAINTIES} <= set(line.variables):
        return None
    attrs = [line[name].attrs for name in UNCERTAINTIES]
    random, systematic = (str(texts.get("components", "")).split(", ") for texts in attrs)
    components = [name for name in systematic if name in SYSTEMATIC]
    required = [
        *NOISE,
        *components,
        "dark_counts",
        "exposure_time",
        *(["time"] if components and "reflectance_gain" not in line.variables else []),
    ]
    is_known_form = tuple(random) == NOISE and WHOLE_COUNTS in attrs[0]
    if not is_known_form or not set(required) <= set(line.variables):
        return None
    try:
        arrays = require(line, required, "errors of a region")
        values = dict(zip(arrays, dask.compute(*(array.values for array in arrays.values())), strict=True))
        return _line_errors(line, values)
    except (SchemaError, ValueError):
        # bands or record were cut afterwards and do not fit the matrices
        return None


def _line_errors(line: xr.Dataset, values: Mapping[str, Any]) -> LineErrors:
    from hyperpaint.radiometry.planning import dark_weights

    shape = (line.sizes[BAND], line.sizes[CROSS_TRACK])
    attrs = line[UNCERTAINTIES[1]].attrs

    def of(name: str) -> Floats:
        return np.broadcast_to(element_rows(values.get(name, 0.0), shape), shape)

    is_integer = bool(line[UNCERTAINTIES[0]].attrs[WHOLE_COUNTS])
    floor = of("read_noise") ** 2 + (QUANTISATION_VARIANCE_COUNT2 if is_integer else 0.0)
    masked = attrs.get(MASKED, masked_elements(line) if "masked" in line.variables else 0)
    common = {name: COMPONENTS[name][0] for name in ("gain", "white tile", "linearity")}
    sources = {name: of(variable) for name, variable in common.items() if variable in values}
    if "irradiance_u_systematic" in values:
        channels = line[IRRADIANCE_WAVELENGTH].values
        band_values = at_bands(values["irradiance_u_systematic"], channels, line["wavelength"].values)
        sources["irradiance"] = np.broadcast_to(band_values[:, None], shape)
    if "panel_scale_u" in line.variables:
        sources["panel"] = np.full(shape, float(np.nanmean(line["panel_scale_u"].values)))
    elif PANEL_U in attrs:
        sources["panel"] = np.broadcast_to(element_rows(attrs[PANEL_U], shape), shape)
    # weights of the darks in every line
    names = ("time", "dark_time", "dark_exposure_time")
    times = {name: line[name].values for name in names if name in line.variables}
    count = line.sizes["dark_time"] if "dark_time" in line["dark_counts"].dims else 1
    exposure = np.broadcast_to(line["exposure_time"].values.astype(np.float64), line.sizes[ALONG_TRACK])
    # a cube with a white reference may lack wavelengths, and has no uncertainty of them then
    wavelength = np.asarray(
        line["wavelength"] if "wavelength" in line.variables else np.full(shape[0], np.nan)
    )
    wavelength_u = np.broadcast_to(np.asarray(values.get("wavelength_u", 0.0), np.float64), shape[:1])
    return LineErrors(
        per_electron=1.0 / of("electrons_per_count"),
        noise_floor=floor,
        is_integer=is_integer,
        read_noise=of("read_noise"),
        dark=of("dark_counts_u_random"),
        dark_weights=dark_weights(times, count, exposure),
        # a line has one of both
        gain_of_elements=of("radiance_gain_u_random") + of("reflectance_gain_u_random"),
        common=sources,
        dark_offset=of("dark_counts_u_systematic"),
        pedestal_variance=float(np.nanmean(floor + of("dark_counts_u_random") ** 2)) / masked
        if masked
        else 0.0,
        wavelength_u=wavelength_u,
        wavelength=wavelength.astype(np.float64),
        light=_light_errors(line) if "irradiance_u_random" in values or wavelength_u.any() else None,
        stray_light=_stray_light_errors(line),
    )


def _stray_light_errors(line: xr.Dataset) -> Floats | None:
    names = [name for name in STRAY_LIGHT if name in line.variables]
    if STRAY_U not in names or len(names) < 2:
        return None
    arrays = require(line, [*names, "exposure_time"], "errors of stray light")
    bands = line.sizes[BAND]
    shares = np.zeros((bands, bands))
    if STRAY in arrays:
        shares += arrays[STRAY].values
    if SHIFT_TIME in arrays:
        shares += float(arrays[SHIFT_TIME]) / float(np.mean(arrays["exposure_time"].values))
    return np.asarray(float(arrays[STRAY_U]) * shares)


def _light_errors(line: xr.Dataset) -> LightErrors:
    names = ["irradiance", "irradiance_fwhm", IRRADIANCE_TIME, IRRADIANCE_WAVELENGTH]
    names += ["wavelength", "fwhm"]
    optional = ("band_spacing", "srf_offset", "srf", "radiance_gain", "irradiance_u_random")
    names += [name for name in optional if name in line.variables]
    arrays = {name: array.values for name, array in require(line, names, "noise of light").items()}
    arrays |= {name: line.attrs.get(name, "gaussian") for name in ("srf_shape", "irradiance_srf_shape")}
    spectra = arrays["irradiance"]
    is_finite = np.isfinite(spectra)
    is_complete = is_finite[:, is_finite.mean(axis=0) > COMMON_SHARE].all(axis=1)
    levels = np.where(is_complete, np.where(is_finite, spectra, 0.0).sum(axis=1), np.nan)
    neighbours = line_light(
        line["time"].values, arrays[IRRADIANCE_TIME], levels, np.inf, clock_uncertainty=0.0
    )
    weight = np.nan_to_num(neighbours.weight)
    return LightErrors(neighbours.before, neighbours.after, weight, *matched_noise(arrays))


def rounding_variance(variance: Array) -> Floats:
    r"""Return the variance that rounding adds to a mean of many counts of one level [count2].

    ``variance``: of the counts before rounding [count2]. The mean of rounded counts is off by
    :math:`\sum_k (-1)^k e^{-2 \pi^2 k^2 \sigma^2} \sin(2 \pi k x) / (\pi k)` (Widrow and Kollar,
    Quantization Noise, 2008). The result is the mean square over all levels x: 1/12 without noise, 0 above
    half a count of noise.
    """
    squares = (np.arange(1, MAX_HARMONICS + 1) ** 2).reshape(-1, *[1] * np.ndim(variance))
    return np.asarray((np.exp(-4.0 * np.pi**2 * squares * variance) / (2.0 * np.pi**2 * squares)).sum(axis=0))
