"""Corrections of reflectance that are offered, never made unasked: mirrored sky, tilt, hidden sky.

Each says in the attributes of ``reflectance`` what was done.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from hyperpaint.base import schema
from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.schema import BAND, PAINT

from .light import SOURCES, diffuse_from_clear_sky, measured_fraction, sun_zenith_of

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["CORRECTIONS", "correct_light", "remove_mirrored_sky"]

CORRECTIONS = ("mirrored_sky_removed", "light_corrected", "tilt")
"""Attributes of reflectance that say what was corrected."""

NORMAL_REFLECTANCE = 0.04
"""Of a clear coat of index 1.5, ((n - 1) / (n + 1))^2 [1]."""

_MENDED = {
    "mirrored_sky_removed": "start from reflectance that is as it was seen",
    "light_corrected": "start from reflectance that is as it was seen, and remove the mirrored sky first",
    "tilt": "compute reflectance without tilt=, remove the mirrored sky first where it is to be removed, "
    "then call correct_light(direct=cos(incidence) / cos(sun zenith), sky_view_factor=(1 + cos(tilt)) / 2)",
}
"""How to go on where a correction was made before."""

_LEVELS = ("reflectance", "reflectance_quantiles", "member_reflectance")
_WIDTHS = ("reflectance_sd", "reflectance_u_random", "reflectance_u_systematic")
"""Of a flight line or of a paint library: what moves with a level, and what only scales."""


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
        Holds ``reflectance`` [1], on ``band`` and any other dims, and ``wavelength``; a paint library too.
    strength
        Reflectance of the coat at normal incidence, :math:`F_0` [1].
    sky_view_factor
        Part of the mirrored directions that show sky [1].
    diffuse, sun_zenith
        Direct/diffuse split, see `hyperpaint.survey`.

    Returns
    -------
    Dataset
        The same with ``reflectance`` lowered, and a library's quantiles and members; the attribute
        ``mirrored_sky_removed`` of reflectance says by what, and ``mirror_reflection`` is "excluded".

    Raises
    ------
    SchemaError
        ``reflectance`` or ``wavelength`` is missing, numbers leave 0 to 1, the sky was removed before or all
        divided by a tilted surface's light (`correct_light`, or ``tilt=`` of `hyperpaint.reflectance`), or
        the split is not known; all are listed.

    Notes
    -----
    .. math:: \rho = \rho_{obs} - F_0 V f_{dif}

    Of a tilted panel, the sky is removed first, and the light corrected then: what is mirrored does not
    become more with the light that falls on the paint. The sky is taken to be as bright everywhere; near the
    zenith it is darker than its mean when the sun is low.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> seen = xr.DataArray(np.float32([0.042, 0.033]), dims="band", attrs={"units": "1"})
    >>> paint = xr.Dataset({"reflectance": seen}, {"wavelength": ("band", [410.0, 850.0], {"units": "nm"})})
    >>> remove_mirrored_sky(paint, sun_zenith=30.0).reflectance.values.round(3)
    array([0.031, 0.03 ], dtype=float32)
    """
    line = schema.rename_to_roles(line)
    # what a tilted surface mirrors is subtracted before all is divided by its light
    _check(line, CORRECTIONS, strength=strength, sky_view_factor=sky_view_factor)
    fraction, source = _fraction_of(line, diffuse, sun_zenith)
    taken = (strength * sky_view_factor * fraction).astype(np.float32)
    text = f"F0 {strength:g} x sky view {sky_view_factor:g} x diffuse fraction ({source})"
    made = {name: line[name] - _on_bands(taken) for name in _LEVELS if name in line.variables}
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
        Holds ``reflectance`` [1], on ``band`` and any other dims, and ``wavelength``; a paint library too.
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
        The same with ``reflectance`` and its uncertainties divided, and a library's spread, quantiles and
        members; NaN where there is no light. The attribute ``light_corrected`` of reflectance says by what.

    Raises
    ------
    SchemaError
        ``reflectance`` or ``wavelength`` is missing, numbers cannot be, the light was corrected before (here,
        or by ``tilt=`` of `hyperpaint.reflectance`), or the split is not known; all are listed.

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
    _check(line, ("light_corrected", "tilt"), most=10.0, neighbour_reflectance=neighbour_reflectance, **plain)
    fraction, source = _fraction_of(line, diffuse, sun_zenith)
    sky = _on_bands(fraction)
    light = direct * (1.0 - sky) + sky_view_factor * sky + (1.0 - sky_view_factor) * neighbour_reflectance
    light = light.where(light > 0)
    made = {name: line[name] / light for name in (*_LEVELS, *_WIDTHS) if name in line.variables}
    told = {
        name: f"{value:g}" if name in plain else "given"
        for name, value in (("direct", direct), ("sky view", sky_view_factor))
    }
    parts = ", ".join(f"{name} {value}" for name, value in told.items())
    return _with(line, made, "light_corrected", f"{parts}, diffuse fraction ({source})")


def _check(line: xr.Dataset, done: tuple[str, ...], *, most: float = 1.0, **numbers: float) -> None:
    problems = Problems("reflectance cannot be corrected", SchemaError)
    for name in ("reflectance", "wavelength"):
        if name not in line.variables:
            problems.add(f"{name!r} is missing")
    for name, value in numbers.items():
        if not 0.0 <= value <= most:
            problems.add(f"{name}={value!r}, expected 0 to {most:g}")
    before = line["reflectance"].attrs if "reflectance" in line.variables else {}
    for name in done:
        if name in before:
            problems.add(f"it was before: {name} is {before[name]!r}; {_MENDED[name]}")
    problems.raise_if_any()


def _fraction_of(line: xr.Dataset, diffuse: Any, sun_zenith: float | None) -> tuple[Any, str]:
    """Return the diffuse fraction of the bands (band,), float64, and where it is from."""
    wavelength = line["wavelength"].values.astype(np.float64)
    if not isinstance(diffuse, str):
        return measured_fraction(diffuse, wavelength), "measured"
    if diffuse not in SOURCES or diffuse == "shadow":
        raise SchemaError(f"diffuse={diffuse!r}, expected 'model', 'pvlib' or a measured spectrum")
    zenith = sun_zenith_of(line, sun_zenith)
    fraction = diffuse_from_clear_sky(diffuse, wavelength, zenith)
    return fraction, f"{diffuse}, sun zenith {zenith:.4g} degree"


def _on_bands(values: Any) -> xr.DataArray:
    import xarray as xr

    return xr.DataArray(values.astype(np.float32), dims=BAND)


def _with(line: xr.Dataset, made: dict[str, xr.DataArray], name: str, text: str) -> xr.Dataset:
    """Return the line with what was corrected, and say so."""
    done = {
        key: array.astype(np.float32).transpose(*line[key].dims).assign_attrs(line[key].attrs)
        for key, array in made.items()
    }
    said = {"mirror_reflection": "excluded"} if name == "mirrored_sky_removed" else {}
    done["reflectance"] = done["reflectance"].assign_attrs({name: text, **said})
    corrected = line.assign(done)
    if PAINT in line["reflectance"].dims:
        before = line.attrs.get("corrections", "none")
        told = f"{name}: {text}"
        corrected = corrected.assign_attrs(corrections=told if before == "none" else f"{before}; {told}")
    return corrected
