"""From what is known of the instrument's errors to the uncertainty of every reflectance.

Errors are of two kinds. Random ones differ from sample to sample; systematic ones are common to a flight,
however they came about: the noise of a calibration is systematic for all that is measured with it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from hyperpaint.base import schema
from hyperpaint.base.arrays import Array, Floats
from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.radiometry import slabs
from hyperpaint.radiometry.slabs import QUANTISATION, ErrorTerms

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["NONE_KNOWN", "UNCERTAINTIES", "error_terms", "uncertainty_inputs", "with_uncertainty"]


_NOISE = ("electrons_per_count", "read_noise", "dark_counts_u_random")
_SYSTEMATIC = (
    "radiance_gain_u_random",
    "radiance_gain_u_systematic",
    "irradiance_u_systematic",
    "wavelength_u",
    "dark_counts_u_systematic",
)
UNCERTAINTIES = ("reflectance_u_random", "reflectance_u_systematic")
NONE_KNOWN = "none known"
"""Attribute ``components`` of an uncertainty that nothing known enters: it is zero for want of knowledge."""
_ABSOLUTE = (
    "electrons_per_count",
    "read_noise",
    "wavelength_u",
    "dark_counts_u_random",
    "dark_counts_u_systematic",
)


def uncertainty_inputs(dataset: xr.Dataset, panel: float | None) -> dict[str, Any]:
    """Return what is known of noise and of systematic errors, by name.

    Parameters
    ----------
    dataset
        A flight line.
    panel
        Relative uncertainty of a panel in the scene [1]; None without.

    Raises
    ------
    SchemaError, UnitsError
        What noise follows from is missing, or has other dims or units; all problems are listed.
    """
    problems = Problems("cannot compute uncertainties of reflectance", SchemaError)
    if "counts" not in dataset.variables:
        problems.add("'counts' is missing: noise follows from counts, and cannot be had from radiance alone")
    for name in _NOISE[:2]:
        if name not in dataset.variables:
            problems.add(
                f"{name!r} is missing: {schema.VARIABLES[name].meaning.lower()}; it comes with a "
                "calibration, or from line.assign(hp.estimate_noise(line))"
            )
    problems.raise_if_any()
    names = [name for name in (*_NOISE, *_SYSTEMATIC) if name in dataset.variables]
    found = schema.require(dataset, names, "uncertainties of reflectance")
    values = {name: slabs.small(array) for name, array in found.items()}
    return values if panel is None else {**values, "panel_u": panel}


def with_uncertainty(result: xr.Dataset, cubes: tuple[Any, ...], uncertain: dict[str, Any]) -> xr.Dataset:
    """Return the dataset with both uncertainties, in obsarray's terms.

    obsarray knows errors that are independent and errors that are common along a dim. The gain's own error of
    every element is common to all lines only; taken as common to all samples it is never underrated.
    """
    import xarray as xr

    known = [name for name in _SYSTEMATIC if name in uncertain]
    if "panel_u" in uncertain:
        known = [n for n in known if n not in ("radiance_gain_u_systematic", "irradiance_u_systematic")]
        known.append("panel")
    entered = {
        "reflectance_u_random": [name for name in _NOISE if name in uncertain],
        "reflectance_u_systematic": known,
    }
    for name, cube in zip(UNCERTAINTIES, cubes, strict=True):
        attrs = {
            "pdf_shape": "gaussian",
            "err_corr_1_dim": list(schema.CUBE),
            "err_corr_1_form": name.rpartition("_")[2],
            "err_corr_1_units": [],
            "err_corr_1_params": [],
            "components": ", ".join(entered[name]) or NONE_KNOWN,
        }
        result[name] = schema.label(xr.DataArray(cube, dims=schema.CUBE), name, **attrs)
    result["reflectance"].attrs["unc_comps"] = list(UNCERTAINTIES)
    return result


def error_terms(
    uncertain: Mapping[str, Any],
    cube: Mapping[str, Any],
    light: Mapping[str, Any] | None,
    dtype: str,
    bad: Array,
) -> ErrorTerms:
    """Return what the uncertainty of every sample follows from; what is not known is zero.

    Parameters
    ----------
    uncertain
        See `uncertainty_inputs`.
    cube, light
        The small variables of the line, by name.
    dtype
        Of the counts.
    bad : (band, column)
        Elements without a gain.

    Raises
    ------
    SchemaError
        Values that no uncertainty can have; all are listed.
    """
    _check_uncertainties(uncertain, bad)

    def of(name: str) -> Floats:
        return _rows(uncertain.get(name, 0.0), bad.shape)

    whole = np.issubdtype(np.dtype(dtype), np.integer)
    floor = of("read_noise") ** 2 + of("dark_counts_u_random") ** 2 + (QUANTISATION if whole else 0.0)
    squares = [of("radiance_gain_u_random") ** 2]
    if "panel_u" in uncertain:
        # scaled to a panel, reflectance has the panel's uncertainty in place of what all elements share
        squares.append(of("panel_u") ** 2)
    else:
        squares += [of("radiance_gain_u_systematic") ** 2, _irradiance_u(uncertain, cube, light) ** 2]
    offset = of("dark_counts_u_systematic")
    wavelength_u = np.broadcast_to(np.asarray(uncertain.get("wavelength_u", 0.0), np.float64), len(bad))
    slope = np.empty((0, 4), np.float32)
    if wavelength_u.any() or offset.any():
        steps = _band_steps(np.asarray(cube["wavelength"], np.float64))
        slope = (wavelength_u[:, None] * steps).astype(np.float32)
    return ErrorTerms(
        per_electron=_float32(1.0 / of("electrons_per_count")),
        noise_floor=_float32(floor),
        relative=_float32(np.sqrt(sum(squares[1:], squares[0]))),
        offset=_float32(offset),
        slope=slope,
    )


def _float32(values: Floats) -> Array:
    return np.ascontiguousarray(values, np.float32)


def _rows(values: Any, shape: tuple[int, ...]) -> Floats:
    """Return a value, one a band, or one an element as (1 or band, column)."""
    array = np.asarray(values, np.float64)
    if array.ndim == 1:
        array = array[:, None]
    return np.broadcast_to(array, shape if array.ndim else (1, shape[1]))


def _irradiance_u(
    uncertain: Mapping[str, Any], cube: Mapping[str, Any], light: Mapping[str, Any] | None
) -> Floats:
    """Return the relative uncertainty of the irradiance of every band (1 or band, 1)."""
    known = np.asarray(uncertain.get("irradiance_u_systematic", 0.0), np.float64)
    if known.ndim == 0 or light is None:
        return known.reshape(1, 1)
    channels = np.asarray(light["irradiance_wavelength"], np.float64)
    order = np.argsort(channels, kind="stable")
    at = np.interp(np.asarray(cube["wavelength"]), channels[order], known[order])
    return np.asarray(at[:, None])


def _band_steps(wavelength: Floats) -> Floats:
    """Return weights of the rise to the band above, and of that from the band below (band, 4) [nm-1].

    With both neighbours they give the slope between these, with one that to it. A neighbour across a join of
    two detectors, where wavelengths turn back, stand still or leap, is none.
    """
    step = np.diff(wavelength)
    usual = np.median(step) if step.size else 1.0
    with np.errstate(divide="ignore", invalid="ignore"):
        joined = (step / usual > 0.0) & (step / usual < 3.0)
        alone = np.where(joined, 1.0 / step, 0.0)
    up, down = np.append(alone, 0.0), np.insert(alone, 0, 0.0)
    both = np.zeros_like(wavelength)
    inside = (up != 0.0) & (down != 0.0)
    both[inside] = 1.0 / (1.0 / up[inside] + 1.0 / down[inside])
    return np.stack([np.where(inside, both, up), up, np.where(inside, both, down), down], axis=1)


def _check_uncertainties(uncertain: Mapping[str, Any], bad: Array) -> None:
    """Refuse what no uncertainty can be; NaN is not known, and gives NaN."""
    problems = Problems("uncertainties cannot be computed", SchemaError)
    for name, value in uncertain.items():
        array = np.asarray(value, np.float64)
        used = array[~bad] if array.shape == bad.shape else array
        used = used[~np.isnan(used)]
        if used.size == 0:
            problems.add(f"{name!r} holds no value")
            continue
        positive = name == "electrons_per_count"
        if not np.isfinite(used).all() or used.min() < 0 or (positive and used.min() == 0):
            wanted = "positive" if positive else "0 or more"
            problems.add(f"{name!r} must be finite and {wanted}, found {used.min():g} to {used.max():g}")
        elif name not in _ABSOLUTE and used.max() > 1.0:
            problems.add(
                f"{name!r} is {used.max():g}; it is relative, expected a fraction of 1, such as 0.02"
            )
    problems.raise_if_any()
