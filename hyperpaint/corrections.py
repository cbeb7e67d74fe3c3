"""Corrections of reflectance that are offered, never made unasked: mirrored sky, tilt, hidden sky.

Each says in the attributes of ``reflectance`` what was done.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from . import schema
from .errors import Problems, SchemaError
from .scene_model.light import SOURCES, diffuse_from_clear_sky, measured_fraction, sun_zenith_of
from .schema import BAND

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["correct_light", "remove_mirrored_sky"]

NORMAL_REFLECTANCE = 0.04
"""Of a clear coat of index 1.5, ((n - 1) / (n + 1))^2 [1]."""


def remove_mirrored_sky(
    line: xr.Dataset,
    *,
    strength: float = NORMAL_REFLECTANCE,
    sky_view_factor: float = 1.0,
    diffuse: Any = "model",
    sun_zenith: float | None = None,
) -> xr.Dataset:
    r"""Subtract the sky that a clear coat mirrors, as seen from above.

    Lazy. For paint; asphalt, which mirrors nothing, comes out too dark in the blue by as much.

    Parameters
    ----------
    line
        Holds ``reflectance`` [1], on ``band`` and any other dims, and ``wavelength``.
    strength
        Reflectance of the coat at normal incidence, :math:`F_0` [1].
    sky_view_factor
        Part of the mirrored directions that show sky [1].
    diffuse, sun_zenith
        Direct/diffuse split, see `hyperpaint.survey`.

    Returns
    -------
    Dataset
        The same with ``reflectance`` lowered; its attribute ``mirrored_sky_removed`` says by what.

    Raises
    ------
    SchemaError
        ``reflectance`` or ``wavelength`` is missing, numbers leave 0 to 1, the sky was removed before, or the
        split is not known; all are listed.

    Notes
    -----
    .. math:: \rho = \rho_{obs} - F_0 V f_{dif}

    of a sky as bright everywhere. The blue sky near the zenith is darker than its mean when the sun is low.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> seen = xr.DataArray(np.float32([0.042, 0.033]), dims="band", attrs={"units": "1"})
    >>> paint = xr.Dataset({"reflectance": seen}, {"wavelength": ("band", [410.0, 850.0], {"units": "nm"})})
    >>> remove_mirrored_sky(paint, sun_zenith=30.0).reflectance.values.round(3)
    array([0.031, 0.03 ], dtype=float32)
    """
    line = schema.rename_to_roles(line)
    _check(line, "mirrored_sky_removed", strength=strength, sky_view_factor=sky_view_factor)
    fraction = _fraction_of(line, diffuse, sun_zenith)
    taken = (strength * sky_view_factor * fraction).astype(np.float32)
    text = f"F0 {strength:g} x sky view {sky_view_factor:g} x diffuse fraction ({_source(diffuse)})"
    seen = line["reflectance"]
    made = seen - _on_bands(taken, seen)
    return _with(line, made, "mirrored_sky_removed", text)


def correct_light(
    line: xr.Dataset,
    *,
    direct: Any = 1.0,
    sky_view_factor: Any = 1.0,
    neighbour_reflectance: float = 0.2,
    diffuse: Any = "model",
    sun_zenith: float | None = None,
) -> xr.Dataset:
    r"""Divide by the light that a tilted surface, or one with part of its sky hidden, gets.

    Lazy. For one surface, whose attitude is known or was found (`hyperpaint.flag` gives 1 - c as
    ``blocked_direct``); `hyperpaint.reflectance` takes a `Tilt` where it is known in degrees.

    Parameters
    ----------
    line
        Holds ``reflectance`` [1], on ``band`` and any other dims, and ``wavelength``.
    direct
        Direct light relative to level ground, c = cos(incidence) / cos(zenith) [1]: a number, or a DataArray
        on dims of the line.
    sky_view_factor
        Part of the sky that is seen, V [1]; as ``direct``.
    neighbour_reflectance
        Of what hides the rest [1].
    diffuse, sun_zenith
        Direct/diffuse split, see `hyperpaint.survey`.

    Returns
    -------
    Dataset
        The same with ``reflectance`` divided; its attribute ``light_corrected`` says by what.

    Raises
    ------
    SchemaError
        ``reflectance`` or ``wavelength`` is missing, numbers cannot be, the light was corrected before, or
        the split is not known; all are listed.

    Notes
    -----
    .. math:: \rho = \rho_{obs} / (c f_{dir} + V f_{dif} + (1 - V) \rho_n)

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> seen = xr.DataArray(np.float32([0.4, 0.4]), dims="band", attrs={"units": "1"})
    >>> paint = xr.Dataset({"reflectance": seen}, {"wavelength": ("band", [410.0, 850.0], {"units": "nm"})})
    >>> correct_light(paint, direct=1.1, sun_zenith=30.0).reflectance.values.round(3)
    array([0.373, 0.366], dtype=float32)
    """
    line = schema.rename_to_roles(line)
    plain = {
        name: value
        for name, value in (("direct", direct), ("sky_view_factor", sky_view_factor))
        if np.ndim(value) == 0 and not hasattr(value, "dims")
    }
    _check(line, "light_corrected", most=10.0, neighbour_reflectance=neighbour_reflectance, **plain)
    fraction = _fraction_of(line, diffuse, sun_zenith)
    seen = line["reflectance"]
    sky = _on_bands(fraction, seen)
    light = direct * (1.0 - sky) + sky_view_factor * sky + (1.0 - sky_view_factor) * neighbour_reflectance
    made = (seen / light).transpose(*seen.dims)
    told = {
        name: f"{value:g}" if name in plain else "given"
        for name, value in (("direct", direct), ("sky view", sky_view_factor))
    }
    parts = ", ".join(f"{name} {value}" for name, value in told.items())
    return _with(line, made, "light_corrected", f"{parts}, diffuse fraction ({_source(diffuse)})")


def _check(line: xr.Dataset, done: str, *, most: float = 1.0, **numbers: float) -> None:
    problems = Problems("reflectance cannot be corrected", SchemaError)
    for name in ("reflectance", "wavelength"):
        if name not in line.variables:
            problems.add(f"{name!r} is missing")
    for name, value in numbers.items():
        if not 0.0 <= value <= most:
            problems.add(f"{name}={value!r}, expected 0 to {most:g}")
    if "reflectance" in line.variables and done in line["reflectance"].attrs:
        problems.add(f"it was before: {done} is {line['reflectance'].attrs[done]!r}")
    problems.raise_if_any()


def _fraction_of(line: xr.Dataset, diffuse: Any, sun_zenith: float | None) -> Any:
    """Return the diffuse fraction of the bands (band,), float64."""
    wavelength = line["wavelength"].values.astype(np.float64)
    if not isinstance(diffuse, str):
        return measured_fraction(diffuse, wavelength)
    if diffuse not in SOURCES or diffuse == "shadow":
        msg = f"diffuse={diffuse!r}, expected 'model', 'pvlib' or a measured spectrum"
        raise SchemaError(msg)
    return diffuse_from_clear_sky(diffuse, wavelength, sun_zenith_of(line, sun_zenith))


def _source(diffuse: Any) -> str:
    return diffuse if isinstance(diffuse, str) else "measured"


def _on_bands(values: Any, like: xr.DataArray) -> xr.DataArray:
    import xarray as xr

    return xr.DataArray(values.astype(np.float32), dims=BAND).transpose(*(d for d in like.dims if d == BAND))


def _with(line: xr.Dataset, made: xr.DataArray, name: str, text: str) -> xr.Dataset:
    attrs = {**line["reflectance"].attrs, name: text}
    return line.assign(
        reflectance=made.astype(np.float32).transpose(*line["reflectance"].dims).assign_attrs(attrs)
    )
