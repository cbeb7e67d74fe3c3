"""Collect the inputs of a plan from a labelled flight line; labels are checked, values are not read."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base import schema
from hyperpaint.base.errors import SchemaError
from hyperpaint.base.facts import one_of
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
    scale_panels: Sequence[Panel],
    *,
    tilt: Tilt | None = None,
    keep_bits: int | None = None,
    uncertainty: bool = False,
) -> tuple[xr.DataArray, dict[str, Any]]:
    """Return the cube from which reflectance is computed, and the inputs of `make_plan` besides its shape.

    ``scale_panels``: panels that give the scale; ``stored``: their scale, if measured before.
    """
    if "counts" in dataset.variables:
        refuse_calibration(dataset, needs_scale=not scale_panels)
    cube, values = cube_inputs(dataset, "reflectance")
    # the plan adds the uncertainty of the panels' means, and of lines between panels
    panel_u = max((panel.uncertainty for panel in scale_panels), default=None)
    return cube, {
        "cube": values,
        "light": _light_inputs(dataset, tilt, bool(scale_panels) and stored is None),
        "tilt": tilt,
        "panel": stored,
        "keep_bits": keep_bits,
        "uncertain": uncertainty_inputs(dataset, panel_u) if uncertainty else None,
    }


def refuse_calibration(dataset: xr.Dataset, *, needs_scale: bool) -> None:
    """Raise SchemaError for gains without an absolute scale, where one is needed."""
    if needs_scale and dataset.attrs.get("absolute_scale") == "unknown":
        raise SchemaError(
            "the gain of this line has no absolute scale (attribute absolute_scale 'unknown')",
            mend="compute it with hyperpaint.calibration.anchor_to_radiance, or pass panel= to reflectance",
            code="scale-unknown",
        )


def cube_inputs(dataset: xr.Dataset, purpose: str) -> tuple[xr.DataArray, dict[str, Any]]:
    """Return the counts or the radiance of a line, and the small variables that calibrate it."""
    schema.warn_of_lost_calibration(dataset, purpose)
    is_from_counts = "counts" in dataset.variables
    required = [*COUNTED] if is_from_counts else ["radiance"]
    if purpose == "reflectance":
        required += ["time", "wavelength", "fwhm", *(n for n in _LIGHT if n not in dataset.variables)]
    optional = [name for name in _OPTIONAL if name in dataset.variables]
    if is_from_counts:
        optional += [name for name in (*TABLE, "masked", *STRAY_LIGHT) if name in dataset.variables]
    elif "radiance_gain" in dataset.variables:
        optional.append("radiance_gain")  # for the slope of the responsivity
    arrays = schema.require(dataset, dict.fromkeys([*required, *optional]), purpose)
    cube = arrays.pop("counts" if is_from_counts else "radiance")
    if not is_from_counts:
        cube = cube.astype(np.float32)
    if purpose == "radiance":
        arrays.pop("wavelength_shift", None)
    if "masked" in arrays and arrays["masked"].dims == (BAND,):
        arrays["masked"] = arrays["masked"].expand_dims(CROSS_TRACK, axis=1)
    values = {name: slabs.small(array) for name, array in arrays.items()}
    if is_from_counts and (TABLE[0] in values or declared_linearity(dataset.attrs)):
        values["linearity"] = declared_linearity(dataset.attrs)
    if SHIFT_TIME in values:
        values["shifted_bands"] = dataset[SHIFT_TIME].attrs.get("bands")
    return cube, values


def _light_inputs(dataset: xr.Dataset, tilt: Any, has_panels: bool) -> dict[str, Any]:
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
    for attr in ("srf_shape", "irradiance_srf_shape"):
        values[attr] = str(dataset.attrs.get(attr, "gaussian"))
        one_of(values[attr], schema.SRF_SHAPES, f"attribute {attr}")
    values["departure"] = departure_of_record(dataset.attrs)
    return values
