"""From a labelled flight line to what its plan is made of: checked by their labels, read by nobody yet."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base import schema
from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.schema import BAND, CROSS_TRACK, IRRADIANCE_TIME, IRRADIANCE_WAVELENGTH
from hyperpaint.light.illumination import Tilt, departure_of_record
from hyperpaint.light.synchrony import check_irradiance_times

from . import slabs
from .linear_counts import TABLE, declared_linearity
from .panels import Panel
from .stray_light import SHIFT_TIME, STRAY_LIGHT
from .uncertainty.propagation import uncertainty_inputs

COUNTED = ("counts", "dark_counts", "radiance_gain", "exposure_time", "saturation_count")
_LIGHT = ("irradiance", "irradiance_fwhm")
_OPTIONAL = (
    "dark_exposure_time",
    "dark_time",
    "read_noise",
    "time",
    "good",
    "band_spacing",
    "wavelength_shift",
    "latitude",
    "longitude",
    "srf",
    "srf_offset",
)


def plan_inputs(
    dataset: xr.Dataset,
    stored: dict[str, Any] | None,
    scaling: Sequence[Panel],
    *,
    tilt: Tilt | None = None,
    keep_bits: int | None = None,
    uncertainty: bool = False,
) -> tuple[xr.DataArray, dict[str, Any]]:
    """Return the cube that reflectance of a line starts from, and what `make_plan` takes besides its form.

    ``scaling``: panels that give the scale; ``stored``: that scale, where they were measured before.
    """
    if "counts" in dataset.variables:
        refuse_calibration(dataset, needs_scale=not scaling)
    cube, values = cube_inputs(dataset, "reflectance")
    # the plan adds how well the pixels of panels, and lines between them, are known
    own_u = max((panel.uncertainty for panel in scaling), default=None)
    return cube, {
        "cube": values,
        "light": _light_inputs(dataset, tilt, bool(scaling) and stored is None),
        "tilt": tilt,
        "panel": stored,
        "keep_bits": keep_bits,
        "uncertain": uncertainty_inputs(dataset, own_u) if uncertainty else None,
    }


def refuse_calibration(dataset: xr.Dataset, *, needs_scale: bool) -> None:
    """Refuse gains that have no absolute scale."""
    problems = Problems("the calibration of this line cannot be applied to its counts", SchemaError)
    if needs_scale and dataset.attrs.get("absolute_scale") == "unknown":
        problems.add(
            (
                "its gain has no absolute scale (attribute absolute_scale 'unknown'): give it "
                "one by hyperpaint.calibration.anchor_to_radiance"
            ),
            mend="reflectance can do with panel=",
            code="scale-unknown",
        )
    problems.raise_if_any()


def cube_inputs(dataset: xr.Dataset, purpose: str) -> tuple[xr.DataArray, dict[str, Any]]:
    """Return the cube to start from and the small variables that calibrate it."""
    schema.warn_of_lost_belongings(dataset, purpose)
    from_counts = "counts" in dataset.variables
    needed = [*COUNTED] if from_counts else ["radiance"]
    if purpose == "reflectance":
        needed += ["time", "wavelength", "fwhm", *(n for n in _LIGHT if n not in dataset.variables)]
    optional = [name for name in _OPTIONAL if name in dataset.variables]
    if from_counts:
        optional += [name for name in (*TABLE, "masked", *STRAY_LIGHT) if name in dataset.variables]
    elif "radiance_gain" in dataset.variables:
        optional.append("radiance_gain")  # gives the slope of the responsivity
    arrays = schema.require(dataset, dict.fromkeys([*needed, *optional]), purpose)
    cube = arrays.pop("counts" if from_counts else "radiance")
    if not from_counts:
        cube = cube.astype(np.float32)
    if purpose == "radiance":
        arrays.pop("wavelength_shift", None)
    if "masked" in arrays and arrays["masked"].dims == (BAND,):
        arrays["masked"] = arrays["masked"].expand_dims(CROSS_TRACK, axis=1)
    values = {name: slabs.small(array) for name, array in arrays.items()}
    if from_counts and (TABLE[0] in values or declared_linearity(dataset.attrs)):
        values["linearity"] = declared_linearity(dataset.attrs)
    if SHIFT_TIME in values:
        values["shifted_bands"] = dataset[SHIFT_TIME].attrs.get("bands")
    return cube, values


def _light_inputs(dataset: xr.Dataset, tilt: Any, has_panels: bool) -> dict[str, Any]:
    """Return the irradiance and its companions, checked as far as their labels allow."""
    names = [*_LIGHT, IRRADIANCE_TIME, IRRADIANCE_WAVELENGTH]
    companions = ("irradiance_max_gap", "irradiance_clock_uncertainty")
    names += [name for name in companions if name in dataset.variables]
    if tilt is not None:
        names += ["latitude", "longitude"]
    if tilt is not None or has_panels:
        names += [name for name in ("diffuse_fraction", "sky_state") if name in dataset.variables]
    arrays = schema.require(dataset, names, "reflectance")
    if arrays[IRRADIANCE_TIME].chunks is None:
        check_irradiance_times(arrays[IRRADIANCE_TIME].values.astype("datetime64[ns]"))
    values = {name: slabs.small(array) for name, array in arrays.items()}
    values["srf_shape"] = _shape(dataset, "srf_shape")
    values["irradiance_srf_shape"] = _shape(dataset, "irradiance_srf_shape")
    values["as_found"] = departure_of_record(dataset.attrs)
    return values


def _shape(dataset: xr.Dataset, attr: str) -> str:
    shape = str(dataset.attrs.get(attr, "gaussian"))
    if shape not in schema.SRF_SHAPES:
        raise SchemaError(
            f"attribute {attr!r} is {shape!r}",
            expected=f"one of {', '.join(schema.SRF_SHAPES)}",
            code="choice-unknown",
        )
    return shape
