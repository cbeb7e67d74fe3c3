"""Corrections of reflectance for the light of the sky: mirrored sky, tilt, hidden sky.

They are applied on request only, and recorded in the attributes of ``reflectance``.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base import schema
from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.facts import documented
from hyperpaint.base.mirrored_light import EXCLUDED, THROUGH_COAT
from hyperpaint.base.schema import BAND, SIGNATURE
from hyperpaint.base.units import convert, takes_quantities
from hyperpaint.light.sky_functions import sunward_gain, zenith_radiance

from .light_split import LightSplit, split_of
from .sun_and_sky import OVERCAST_ZENITH

#: Attributes of reflectance that record corrections.
CORRECTIONS = ("mirrored_sky_removed", "light_corrected", "tilt", "coat_corrected")

#: Maximum relative change of direct light that is treated as a lean, which changes diffuse light, too [1].
MAX_TILT_GAIN = 0.3

#: Normal reflectance of a clear coat of index 1.5, ((n - 1) / (n + 1))^2 [1].
NORMAL_REFLECTANCE = 0.04

#: Mend of the error by the earlier correction.
_MENDS = {
    "mirrored_sky_removed": "start from uncorrected reflectance",
    "coat_corrected": "start from uncorrected reflectance, and correct the coat last",
    "light_corrected": "start from uncorrected reflectance, and remove the mirrored sky first",
    "tilt": "compute reflectance without tilt=, remove the mirrored sky if wanted, then call "
    "correct_light(direct=cos(incidence) / cos(sun zenith), sky_view_factor=(1 + cos(tilt)) / 2)",
}

#: Variables of a flight line or paint library that a subtraction changes; a division changes `WIDTHS`, too.
LEVELS = ("reflectance", "reflectance_quantiles", "member_reflectance")
WIDTHS = ("reflectance_sd", "reflectance_u_random", "reflectance_u_systematic", "reflectance_errors")


@takes_quantities(sun_zenith="degree")
@documented(line="spectra")
def remove_mirrored_sky(
    line: xr.Dataset,
    *,
    strength: float = NORMAL_REFLECTANCE,
    sky_view_factor: float = 1.0,
    diffuse: Any = None,
    sun_zenith: float | None = None,
    sky: str | None = None,
) -> xr.Dataset:
    r"""Subtract the sky that a clear coat mirrors, as seen from above.

    Lazy. For paint; on asphalt, which mirrors nothing, the result is too dark in the blue.

    Parameters
    ----------
    line
    strength
        Reflectance of the coat at normal incidence, :math:`F_0` [1].
    sky_view_factor
        Part of the mirrored directions that show sky [1].
    diffuse, sun_zenith
    sky
        "clear", darker at the zenith than its mean under a low sun; "uniform"; "overcast", brighter there
        (CIE). By default from ``sky_state`` of the lines, between clear and overcast where it is broken or
        contradictory; clear with a modelled split, uniform with a measured one, which may be of any sky.

    Returns
    -------
    Dataset
        The same with reduced ``reflectance``, and a library's quantiles and members; the attribute
        ``mirrored_sky_removed`` of reflectance records the correction, and ``mirror_reflection`` is
        "excluded".

    Raises
    ------
    SchemaError
        ``reflectance`` or ``wavelength`` is missing, numbers are outside 0 to 1, the sky was removed or the
        light corrected before (`correct_light`, or ``tilt=`` of `hyperpaint.reflectance`), or the split or
        the sky is unknown; all are listed.

    Warns
    -----
    PaintWarning
        The state of the sky is unknown, and a clear one is assumed.

    Notes
    -----
    .. math:: \rho = \rho_{obs} - F_0 V f_{dif} L_z / \bar L

    with the radiance :math:`L_z` of the zenith, which a level body part mirrors, over the mean of the sky.
    For a tilted body part, remove the sky first, and correct the light then: mirrored light does not grow
    with the light on the paint.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> seen = xr.DataArray(np.float32([0.042, 0.033]), dims="band", attrs={"units": "1"})
    >>> paint = xr.Dataset({"reflectance": seen}, {"wavelength": ("band", [410.0, 850.0], {"units": "nm"})})
    >>> remove_mirrored_sky(paint, sun_zenith=30.0).reflectance.values.round(3)
    array([0.032, 0.031], dtype=float32)
    """
    line = schema.rename_to_roles(line)
    # all corrections must follow this one: mirrored light does not scale with the light on the paint
    numbers = {"strength": (strength, 0.0, 1.0), "sky_view_factor": (sky_view_factor, 0.0, 1.0)}
    _check(line, CORRECTIONS, numbers)
    line = as_fractions(line)
    split = _split(line, diffuse, sun_zenith, sky)
    mirrored = (strength * sky_view_factor * split.fraction * sky_above(split)).astype(np.float32)
    text = (
        f"F0 {strength:g} x sky view {sky_view_factor:g} x diffuse fraction ({split.source}) "
        f"x zenith of a sky ({split.sky})"
    )
    corrected = {name: line[name] - mirrored for name in LEVELS if name in line.variables}
    return with_correction(line, corrected, "mirrored_sky_removed", text)


@takes_quantities(direct="1", sky_view_factor="1", sun_zenith="degree")
@documented(line="spectra")
def correct_light(
    line: xr.Dataset,
    *,
    direct: Any = 1.0,
    sky_view_factor: Any = 1.0,
    neighbour_reflectance: float = 0.2,
    diffuse: Any = None,
    sun_zenith: float | None = None,
    sky: str | None = None,
) -> xr.Dataset:
    r"""Divide by the light on a tilted surface, or on one with partly hidden sky.

    Lazy. For one surface of known or estimated attitude (`hyperpaint.surroundings.flag` gives 1 - c as
    ``blocked_direct``); `hyperpaint.reflectance` takes a `Tilt` where it is known in degrees.

    Parameters
    ----------
    line
    direct
        Direct light relative to level ground, c = cos(incidence) / cos(zenith) [1]: a number, or a DataArray
        on dims of the line.
    sky_view_factor
        Visible part of the sky, V [1]; as ``direct``.
    neighbour_reflectance
        Reflectance of the objects that hide the rest [1].
    diffuse, sun_zenith
    sky
        As for `remove_mirrored_sky`; a small lean changes as little under an overcast as under a uniform sky.

    Returns
    -------
    Dataset
        The same with ``reflectance`` and its uncertainties divided, and a library's spread, quantiles and
        members; NaN without light. The attribute ``light_corrected`` of reflectance records the correction.

    Raises
    ------
    SchemaError
        ``reflectance`` or ``wavelength`` is missing, numbers are out of range, the light was corrected before
        (here, or by ``tilt=`` of `hyperpaint.reflectance`), or the split is unknown; all are listed.

    Warns
    -----
    PaintWarning
        The state of the sky is unknown, and a clear one is assumed.

    Notes
    -----
    .. math:: \rho = \rho_{obs} / (c f_{dir} + V (1 + g (c - 1)) f_{dif} + (1 - V) \rho_n)

    with the gain g of diffuse light of a surface that leans towards the sun, 0 but under a clear sky
    (`hyperpaint.light.sky_functions.sunward_gain`; to first order, up to `MAX_TILT_GAIN` of c).

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> seen = xr.DataArray(np.float32([0.4, 0.4]), dims="band", attrs={"units": "1"})
    >>> paint = xr.Dataset({"reflectance": seen}, {"wavelength": ("band", [410.0, 850.0], {"units": "nm"})})
    >>> correct_light(paint, direct=1.1, sun_zenith=30.0).reflectance.values.round(3)
    array([0.369, 0.364], dtype=float32)
    """
    line = schema.rename_to_roles(line)
    plain = {
        name: value
        for name, value in (("direct", direct), ("sky_view_factor", sky_view_factor))
        if np.ndim(value) == 0 and not hasattr(value, "dims")
    }
    numbers = {"neighbour_reflectance": neighbour_reflectance, **plain}
    _check(line, ("light_corrected", "tilt"), {name: (value, 0.0, 10.0) for name, value in numbers.items()})
    line = as_fractions(line)
    split = _split(line, diffuse, sun_zenith, sky)
    gain: Any = 0.0
    if split.sky not in ("uniform", "overcast"):
        gain = (1.0 - split.cloud) * _on_bands(sunward_gain(split.wavelength, split.zenith))
    share, lean = split.fraction.astype(np.float32), np.clip(direct - 1.0, -MAX_TILT_GAIN, MAX_TILT_GAIN)
    with _same_pixels():
        sky_light = sky_view_factor * (1.0 + lean * gain) * share
        light = direct * (1.0 - share) + sky_light + (1.0 - sky_view_factor) * neighbour_reflectance
        light = light.where(light > 0)
        corrected = {name: line[name] / light for name in (*LEVELS, *WIDTHS) if name in line.variables}
    factors = {
        name: f"{value:g}" if name in plain else "given"
        for name, value in (("direct", direct), ("sky view", sky_view_factor))
    }
    amounts = ", ".join(f"{name} {value}" for name, value in factors.items())
    text = f"{amounts}, diffuse fraction ({split.source}), sky ({split.sky})"
    return with_correction(line, corrected, "light_corrected", text)


def note_unusable(
    problems: Problems, line: xr.Dataset, numbers: Mapping[str, tuple[float, float, float]]
) -> None:
    """Add missing variables, and numbers (value, minimum, maximum) out of range, to the problems."""
    for name in ("reflectance", "wavelength"):
        if name not in line.variables:
            problems.add(f"{name!r} is missing", code="variable-missing")
    for name, (value, low, high) in numbers.items():
        if not low <= value <= high:
            problems.add(f"{name}={value!r}", expected=f"{low:g} to {high:g}", code="value-out-of-range")


def _check(
    line: xr.Dataset, excluded: tuple[str, ...], numbers: Mapping[str, tuple[float, float, float]]
) -> None:
    # Raise for unusable input, and for reflectance with one of the excluded corrections
    problems = Problems("reflectance cannot be corrected", SchemaError)
    note_unusable(problems, line, numbers)
    attrs = line["reflectance"].attrs if "reflectance" in line.variables else {}
    for name in excluded:
        if name in attrs:
            problems.add(
                f"corrected before: {name} is {attrs[name]!r}", mend=_MENDS[name], code="corrected-before"
            )
    problems.raise_if_any()


@contextlib.contextmanager
def _same_pixels() -> Iterator[None]:
    # Raise where operands differ in their pixels, which xarray would reduce to the common ones
    try:
        with xr.set_options(arithmetic_join="exact"):
            yield
    except xr.AlignmentError as error:
        raise SchemaError(
            "lines or columns of direct= or sky_view_factor= differ from those of the flight line",
            mend="crop all to the same pixels, or drop their coordinates along_track and cross_track",
            code="grid-mismatch",
        ) from error


def as_fractions(line: xr.Dataset) -> xr.Dataset:
    """Return the line with `LEVELS` and `WIDTHS` in units of 1."""
    names = [name for name in (*LEVELS, *WIDTHS) if name in line.variables]
    return line.assign({name: convert(line[name], "1") for name in names})


def sky_above(split: LightSplit) -> Any:
    """Return the radiance of the zenith over the mean of the sky [1], on the dims of the split."""
    if split.sky == "uniform":
        return 1.0
    clear = 0.0 if split.sky == "overcast" else _on_bands(zenith_radiance(split.wavelength, split.zenith))
    return (1.0 - split.cloud) * clear + split.cloud * OVERCAST_ZENITH


def _split(line: xr.Dataset, diffuse: Any, sun_zenith: float | None, sky: str | None) -> LightSplit:
    if isinstance(diffuse, str) and diffuse == "shadow":
        raise SchemaError(
            "diffuse='shadow'", expected="'model', 'pvlib' or a measured spectrum", code="choice-unknown"
        )
    return split_of(line, diffuse, sun_zenith, sky)


def _on_bands(values: Any) -> xr.DataArray:
    return xr.DataArray(values.astype(np.float32), dims=BAND)


def with_correction(line: xr.Dataset, variables: dict[str, xr.DataArray], name: str, text: str) -> xr.Dataset:
    """Return the line with corrected variables and the attributes of the correction."""
    corrected = {
        key: array.astype(np.float32).transpose(*line[key].dims).assign_attrs(line[key].attrs)
        for key, array in variables.items()
    }
    attrs = {}
    if name == "mirrored_sky_removed":
        attrs = {"mirror_reflection": EXCLUDED, "quantity": THROUGH_COAT, "specular_component": EXCLUDED}
    corrected["reflectance"] = corrected["reflectance"].assign_attrs({name: text, **attrs})
    result = line.assign(corrected)
    if SIGNATURE in line["reflectance"].dims:
        earlier = line.attrs.get("corrections", "none")
        entry = f"{name}: {text}"
        result = result.assign_attrs(corrections=entry if earlier == "none" else f"{earlier}; {entry}")
    return result
