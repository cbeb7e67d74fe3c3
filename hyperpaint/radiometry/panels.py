"""Targets of known reflectance in the scene, declared and measured."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import dask
import dask.array as da
import numpy as np
import xarray as xr

from hyperpaint.base.constants import SATURATION_MARGIN_COUNTS
from hyperpaint.base.errors import Problems, SchemaError, warn_user
from hyperpaint.base.facts import convert, takes_quantities
from hyperpaint.base.schema import ALONG_TRACK, BAND, CROSS_TRACK, PANEL, VARIABLES, label, require

from . import slabs
from .panel_judging import PANEL_STATES

#: Variables of the results of panels.
CLOSURE = ("panel_factor", "panel_factor_u", "panel_used", "panel_state", "panel_time")

#: Variables that hold the scale of a line by panels, also in a crop without panels.
_SCALE = ("panel_factor", "panel_state", "panel_weight", "panel_scale_u")

#: Uncertainties of a line that limit how far panel factors may be from 1.
_STATED = ("radiance_gain_u_systematic", "irradiance_u_systematic")


@takes_quantities()
@dataclass(frozen=True)
class Panel:
    """A target of known reflectance in the scene.

    Attributes
    ----------
    along_track, cross_track
        Lines and columns of the panel, by position.
    reflectance
        Certified reflectance factor: a number [1], or a DataArray [1 or percent] with a coordinate
        ``wavelength`` [any unit of length].
    uncertainty
        Relative standard uncertainty of the reflectance [1]. A panel whose measured tilt changes its light by
        more than twice this is refused.
    tilt
        Attitude if the panel is not level, as `hyperpaint.Tilt` or (angle, azimuth) [degree].

    Raises
    ------
    SchemaError
        The reflectance or its uncertainty is out of range.

    Examples
    --------
    >>> panel = Panel(along_track=slice(10, 20), cross_track=slice(4, 9), reflectance=0.5, uncertainty=0.02)
    >>> panel.at([450.0, 850.0])
    array([0.5, 0.5])
    """

    along_track: slice
    cross_track: slice
    reflectance: Any
    uncertainty: float = 0.0
    tilt: Any = None

    def __post_init__(self) -> None:
        SchemaError.raise_if(
            not 0.0 <= self.uncertainty < 1.0,
            f"the panel's uncertainty is {self.uncertainty}",
            expected="a fraction of 1, such as 0.02",
            code="value-out-of-range",
        )
        is_labelled = hasattr(self.reflectance, "coords")
        SchemaError.raise_if(
            is_labelled and "wavelength" not in self.reflectance.coords,
            "the panel's reflectance has no coordinate 'wavelength' [nm]",
            code="coordinate-missing",
        )
        SchemaError.raise_if(
            not is_labelled and not (np.ndim(self.reflectance) == 0 and 0 < self.reflectance <= 1.2),
            f"the panel's reflectance is {self.reflectance}",
            expected="0 to 1, or a DataArray",
            code="value-out-of-range",
        )

    def at(self, wavelength: Any) -> Any:
        """Return the reflectance at wavelengths (band,) [nm]; NaN outside the range of ``reflectance``."""
        if np.ndim(self.reflectance) == 0:
            return np.full(np.shape(wavelength), float(self.reflectance))
        factor = convert(self.reflectance, "1", "reflectance")
        wavelengths = convert(factor["wavelength"].astype(np.float64), "nm").values
        order = np.argsort(wavelengths, kind="stable")
        return np.interp(wavelength, wavelengths[order], factor.values[order], np.nan, np.nan)


def declared_panels(dataset: xr.Dataset) -> tuple[Panel, ...]:
    # Return the panels that a flight line declares (attribute ``panels``), as a ``collect.toml`` names them.
    #
    # Raises SchemaError: The attribute does not declare panels.
    try:
        panels = []
        for row in json.loads(str(dataset.attrs.get("panels", "[]"))):
            region = slice(*row["along_track"]), slice(*row["cross_track"])
            # a number, or pairs of wavelength [nm] and reflectance
            reflectance, tilt = row["reflectance"], row["tilt"]
            if isinstance(reflectance, list):
                wavelengths, values = np.array(reflectance, np.float64).T
                axis = {"wavelength": ("wavelength", wavelengths, {"units": "nm"})}
                reflectance = xr.DataArray(values, axis, ("wavelength",), attrs={"units": "1"})
            panels.append(
                Panel(*region, reflectance, row["uncertainty"], None if tilt is None else tuple(tilt))
            )
        return tuple(panels)
    except (ValueError, TypeError, KeyError) as error:
        raise SchemaError(f"attribute 'panels' cannot be read: {error}", code="panels-unreadable") from error


def declared_scale(dataset: xr.Dataset, *, other_light: bool) -> dict[str, Any] | None:
    # Return the stored scale from the panels that a line declares; None without one.
    #
    # Panels are declared by position in the whole line; their stored scale is valid in any crop, but only
    # with the line's own irradiance record.
    #
    # Warns PaintWarning: A scale is stored, but ``other_light`` replaces its irradiance record.
    if "panels" not in dataset.attrs or not set(_SCALE) <= set(dataset.variables):
        return None
    if other_light:
        warn_user(
            "the scale by panels belongs to the line's own irradiance and is left out; pass panel=",
            "panel-scale-foreign",
        )
        return None
    arrays = require(dataset, list(_SCALE), "the scale by panels")
    return {name.removeprefix("panel_"): slabs.small(array) for name, array in arrays.items()}


def without_panels(dataset: xr.Dataset) -> xr.Dataset:
    # Return a line without the results of panels.
    return dataset.drop_vars([name for name in dataset.variables if str(name).startswith("panel_")])


def several_panels(panel: Panel | Sequence[Panel] | None) -> tuple[Panel, ...]:
    # Return panels as a tuple; empty only for None.
    panels = () if panel is None else (panel,) if isinstance(panel, Panel) else tuple(panel)
    if (panel is not None and not panels) or not all(isinstance(item, Panel) for item in panels):
        raise SchemaError(
            f"panel={panel!r:.80}", expected="hyperpaint.Panel, or several of them", code="type-wrong"
        )
    return panels


def panel_inputs(
    dataset: xr.Dataset, panels: Sequence[Panel], reflectance: Callable[..., xr.Dataset]
) -> dict[str, Any]:
    # Return the inputs of panels for a plan, with their reflectance through the irradiance record.
    #
    # ``reflectance`` is `hyperpaint.radiometry.counts_to_reflectance.reflectance`.
    problems = Problems("the panel cannot be used", SchemaError)
    for panel in panels:
        for dim in (ALONG_TRACK, CROSS_TRACK):
            problems.add_if(
                not len(range(dataset.sizes[dim])[getattr(panel, dim)]),
                f"{dim}={getattr(panel, dim)} is outside of this line",
                expected=f"positions below {dataset.sizes[dim]}",
                code="panel-outside-line",
            )
    problems.raise_if_any()
    names = [name for name in _STATED if name in dataset.variables]
    return {
        "panels": [_inputs_of_panel(dataset, panel, reflectance) for panel in panels],
        "stated": {name: slabs.small(array) for name, array in require(dataset, names, "panels").items()},
        "has_scale": dataset.attrs.get("absolute_scale") != "unknown",
    }


def _inputs_of_panel(
    dataset: xr.Dataset, panel: Panel, reflectance: Callable[..., xr.Dataset]
) -> dict[str, Any]:
    # all columns of its lines: masked elements give the pedestal
    region = dataset.isel({ALONG_TRACK: panel.along_track})
    columns = {CROSS_TRACK: panel.cross_track}
    # the scale of the gain cancels in the factor of the panel
    region = without_panels(region).assign_attrs(absolute_scale="of the panel")
    wavelength = slabs.small(dataset["wavelength"])
    expected = (
        wavelength.map_blocks(panel.at, dtype=np.float64)
        if dataset["wavelength"].chunks is not None
        else panel.at(wavelength)
    )
    lines = range(dataset.sizes[ALONG_TRACK])[panel.along_track]
    inputs = {
        "observed": reflectance(region, tilt=panel.tilt)["reflectance"].isel(columns).data,
        "ceiling": None,
        "reflectance": expected,
        "uncertainty": panel.uncertainty,
        "lines": (min(lines), max(lines) + 1),
        "name": f"the panel at lines {min(lines)} to {max(lines)}",
    }
    if "counts" in dataset.variables:
        # reflectance of the highest unsaturated counts; masked elements, which receive no light, and elements
        # without a limit keep their counts
        counts = region["counts"]
        limit = np.ceil(region["saturation_count"].astype(np.float64) - SATURATION_MARGIN_COUNTS) - 1.0
        keep_counts = np.isnan(limit)
        if "masked" in region.variables:
            keep_counts = keep_counts | region["masked"]
        highest = xr.where(keep_counts, counts, limit).transpose(*counts.dims).astype(counts.dtype)
        brightest = reflectance(region.assign(counts=highest.assign_attrs(counts.attrs)), tilt=panel.tilt)
        inputs["ceiling"] = brightest["reflectance"].isel(columns).data
    return inputs


def closure_variables(plan: Any, panels: int, bands: int, lines: int) -> dict[str, xr.DataArray]:
    # Return the results of a plan's panels as variables, lazily.
    masks = 1 << np.arange(len(PANEL_STATES), dtype=np.uint8)
    attrs = {"panel_state": {"flag_masks": masks, "flag_meanings": " ".join(PANEL_STATES)}}
    variables = {}
    for name in (*CLOSURE, "panel_weight", "panel_scale_u"):
        spec = VARIABLES[name]
        shape = tuple({PANEL: panels, BAND: bands, ALONG_TRACK: lines}[dim] for dim in spec.dims)
        values = dask.delayed(slabs.panel_result, pure=True)(plan, name.removeprefix("panel_"))
        array = xr.DataArray(da.from_delayed(values, shape, np.dtype(spec.dtype)), dims=spec.dims)
        variables[name] = label(array, name, **attrs.get(name, {}))
    return variables
