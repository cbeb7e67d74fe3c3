"""Propagate the known errors of the instrument to the uncertainty of every reflectance.

Errors are random or systematic. Random errors are independent in every sample. Systematic errors are shared
by a flight, or by the lines of a column, like the noise of the mean dark and of a calibration.
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base.constants import QUANTISATION_VARIANCE_COUNT2
from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.schema import BAND, CROSS_TRACK, CUBE, VARIABLES, Array, Floats, label, require
from hyperpaint.kernels.arguments import ErrorTerms
from hyperpaint.light.illumination import INTERPOLATED, at_bands, matched_noise
from hyperpaint.radiometry import slabs

NOISE = ("electrons_per_count", "read_noise")
SYSTEMATIC = (
    "dark_counts_u_random",
    "radiance_gain_u_random",
    "reflectance_gain_u_random",
    "irradiance_u_random",
    "radiance_gain_u_systematic",
    "reflectance_gain_u_systematic",
    "irradiance_u_systematic",
    "wavelength_u",
    "dark_counts_u_systematic",
    "linearity_u",
)
OF_WHITE = ("reflectance_gain_u_random", "reflectance_gain_u_systematic")
OF_LIGHT = (
    "radiance_gain_u_random",
    "radiance_gain_u_systematic",
    "irradiance_u_random",
    "irradiance_u_systematic",
    "wavelength_u",
    "linearity_u",
)
#: Attributes of uncertainties, for inputs that are not variables of the line.
WHOLE_COUNTS, MASKED, PANEL_U = "whole_counts", "masked_elements", "panel_u"

UNCERTAINTIES = ("reflectance_u_random", "reflectance_u_systematic")
#: Attribute ``components`` of an uncertainty without any known component, which is zero.
NONE_KNOWN = "none known"
_ABSOLUTE = (
    "electrons_per_count",
    "read_noise",
    "wavelength_u",
    "dark_counts_u_random",
    "dark_counts_u_systematic",
)


def uncertainty_inputs(dataset: xr.Dataset, panel: float | None) -> dict[str, Any]:
    # Return the known noise and systematic errors of a line, by name; ``panel``: uncertainty of a panel [1].
    #
    # Raises `SchemaError, UnitsError`: Variables of the noise are missing, or have other dims or units; all
    # problems are listed.
    problems = Problems("cannot compute uncertainties of reflectance", SchemaError)
    problems.add_if(
        "counts" not in dataset.variables,
        "'counts' is missing, and radiance alone has no noise model",
        code="variable-missing",
    )
    for name in NOISE:
        if name not in dataset.variables:
            problems.add(
                f"{name!r} is missing: {VARIABLES[name].meaning.lower()}",
                mend="take it from a calibration, or line.assign(hp.radiometry.estimate_noise(line))",
                code="variable-missing",
            )
    problems.raise_if_any()
    # a white reference replaces calibration and irradiance, a calibration the white reference
    others = OF_LIGHT if "reflectance_gain" in dataset.variables else OF_WHITE
    names = [name for name in (*NOISE, *SYSTEMATIC) if name in dataset.variables and name not in others]
    arrays = require(dataset, names, "uncertainties of reflectance")
    values = {name: slabs.small(array) for name, array in arrays.items()}
    return values if panel is None else {**values, "panel_u": panel}


def with_uncertainty(result: xr.Dataset, cubes: tuple[Any, ...], uncertain: dict[str, Any]) -> xr.Dataset:
    # Return the dataset with both uncertainties, in obsarray's terms.
    #
    # obsarray distinguishes errors that are independent and errors that are common along a dim. The errors of
    # an element's gain and dark are common to all lines only; treated as common to all samples they are never
    # underestimated. `hyperpaint.radiometry.mean_uncertainty` treats them exactly.
    random = [name for name in NOISE if name in uncertain]
    systematic = [name for name in SYSTEMATIC if name in uncertain]
    of_inputs: dict[str, Any] = {}
    if "masked" in result.variables and result["masked"].chunks is None:
        of_inputs[MASKED] = masked_elements(result)
    if "panel_u" in uncertain:
        replaced = ("radiance_gain_u_systematic", "irradiance_u_systematic")
        systematic = [*(name for name in systematic if name not in replaced), "panel"]
        of_inputs[PANEL_U] = np.asarray(uncertain["panel_u"], np.float64).tolist()
    is_integer = int(np.issubdtype(result["counts"].dtype, np.integer))
    details = ((random, {WHOLE_COUNTS: is_integer}), (systematic, of_inputs))
    for name, cube, (components, extra) in zip(UNCERTAINTIES, cubes, details, strict=True):
        attrs = {
            "pdf_shape": "gaussian",
            "err_corr_1_dim": list(CUBE),
            "err_corr_1_form": name.rpartition("_")[2],
            "err_corr_1_units": [],
            "err_corr_1_params": [],
            "components": ", ".join(components) or NONE_KNOWN,
            **extra,
        }
        result[name] = label(xr.DataArray(cube, dims=CUBE), name, **attrs)
    result["reflectance"].attrs["unc_comps"] = list(UNCERTAINTIES)
    return result


def masked_elements(line: xr.Dataset) -> int:
    # Return the number of elements of a line that receive no light.
    masked = line["masked"]
    other_sizes = [line.sizes[dim] for dim in (BAND, CROSS_TRACK) if dim not in masked.dims]
    return int(masked.values.sum()) * math.prod(other_sizes)


def error_terms(
    uncertain: Mapping[str, Any],
    cube: Mapping[str, Any],
    light: Mapping[str, Any] | None,
    dtype: str,
    bad: Array,
    masked: int = 0,
    dark_share: float = 1.0,
) -> ErrorTerms:
    # Return the terms of the uncertainty of every sample; unknown terms are zero.
    #
    # ``uncertain`` as of `uncertainty_inputs`; ``cube`` and ``light`` are the small variables of the line, by
    # name; ``bad`` (band, column) are elements without a gain; ``masked`` is the number of elements without
    # light, whose mean is subtracted as pedestal of a line: all its samples share the noise of this mean;
    # ``dark_share`` is the largest root sum of squares of the weights with which a line's darks are
    # subtracted.
    #
    # Raises `SchemaError`: Values are impossible for uncertainties; all are listed.
    _check_uncertainties(uncertain, bad)

    def of(name: str) -> Floats:
        return element_rows(uncertain.get(name, 0.0), bad.shape)

    is_integer = np.issubdtype(np.dtype(dtype), np.integer)
    floor = of("read_noise") ** 2 + (QUANTISATION_VARIANCE_COUNT2 if is_integer else 0.0)
    element_dark = (dark_share * of("dark_counts_u_random")) ** 2
    dark_variance = of("dark_counts_u_systematic") ** 2 + element_dark
    if masked:
        dark_variance = dark_variance + float(np.nanmean(floor + element_dark)) / masked
    squares = [of(name) ** 2 for name in ("radiance_gain_u_random", "linearity_u", *OF_WHITE)]
    if "panel_u" in uncertain:
        # the panel's uncertainty replaces those of gain and irradiance that all elements share
        squares.append(of("panel_u") ** 2)
    else:
        irradiance_u = np.asarray(uncertain.get("irradiance_u_systematic", 0.0), np.float64)
        if irradiance_u.ndim and light is not None:
            irradiance_u = at_bands(irradiance_u, light["irradiance_wavelength"], cube["wavelength"])[:, None]
        squares += [of("radiance_gain_u_systematic") ** 2, irradiance_u.reshape(-1, 1) ** 2]
    if "irradiance_u_random" in uncertain and light is not None:
        arrays = {**cube, **light, "irradiance_u_random": uncertain["irradiance_u_random"]}
        squares.append(INTERPOLATED * np.diag(matched_noise(arrays)[1])[:, None])
    offset = np.sqrt(dark_variance)
    wavelength_u = np.broadcast_to(np.asarray(uncertain.get("wavelength_u", 0.0), np.float64), len(bad))
    slope = np.empty((0, 4), np.float32)
    if wavelength_u.any():
        steps = band_steps(np.asarray(cube["wavelength"], np.float64))
        slope = (wavelength_u[:, None] * steps).astype(np.float32)
    elif not offset.any():
        offset = offset[:0]
    terms = (1.0 / of("electrons_per_count"), floor, np.sqrt(sum(squares[1:], squares[0])), offset)
    per_electron, noise, relative, dark = (np.ascontiguousarray(values, np.float32) for values in terms)
    return ErrorTerms(per_electron, noise, relative, dark, slope)


def element_rows(values: Any, shape: tuple[int, ...]) -> Floats:
    # Return a scalar, a value per band, or a value per element as (1 or band, column).
    array = np.asarray(values, np.float64)
    if array.ndim == 1:
        array = array[:, None]
    return np.broadcast_to(array, shape if array.ndim else (1, shape[1]))


def band_steps(wavelength: Floats) -> Floats:
    # Return weights of the differences to the band above and from the band below (band, 4) [nm-1].
    #
    # With two neighbours they give the slope between them, with one neighbour the slope to it. A neighbour
    # across a join of two detectors, where wavelengths decrease, repeat or jump, is ignored.
    step = np.diff(wavelength)
    median_step = np.median(step) if step.size else 1.0
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse_step = np.where((step / median_step > 0.0) & (step / median_step < 3.0), 1.0 / step, 0.0)
    inverse_next, inverse_previous = np.append(inverse_step, 0.0), np.insert(inverse_step, 0, 0.0)
    between = np.zeros_like(wavelength)
    has_both = (inverse_next != 0.0) & (inverse_previous != 0.0)
    between[has_both] = 1.0 / (1.0 / inverse_next[has_both] + 1.0 / inverse_previous[has_both])
    return np.stack(
        [
            np.where(has_both, between, inverse_next),
            inverse_next,
            np.where(has_both, between, inverse_previous),
            inverse_previous,
        ],
        axis=1,
    )


def _check_uncertainties(uncertain: Mapping[str, Any], bad: Array) -> None:
    problems = Problems("uncertainties cannot be computed", SchemaError)
    for name, value in uncertain.items():
        array = np.asarray(value, np.float64)
        values = array[~bad] if array.shape == bad.shape else array
        values = values[~np.isnan(values)]
        if values.size == 0:
            problems.add(f"{name!r} contains no value", code="not-finite")
            continue
        is_positive, low, high = name == "electrons_per_count", values.min(), values.max()
        is_impossible = not np.isfinite(values).all() or low < 0 or (is_positive and low == 0)
        problems.add_if(
            is_impossible,
            f"{name!r} is {low:g} to {high:g}",
            expected=f"finite and {'positive' if is_positive else '0 or more'}",
            code="value-out-of-range",
        )
        problems.add_if(
            not is_impossible and name not in _ABSOLUTE and high > 1.0,
            f"{name!r} is {high:g}",
            expected="a fraction of 1, such as 0.02",
            code="value-out-of-range",
        )
    problems.raise_if_any()
