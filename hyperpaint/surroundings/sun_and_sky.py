"""How the irradiance divides into sun and sky, and the corrections of reflectance that follow from it.

Corrections (mirrored sky, tilt, hidden sky) are made on request only; each says in the attributes of
``reflectance`` what was done.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from hyperpaint.base import schema
from hyperpaint.base.arrays import Floats, Floats32, Ints
from hyperpaint.base.errors import Problems, SchemaError, needs_extra
from hyperpaint.base.schema import BAND, PAINT
from hyperpaint.base.units import convert, takes_quantities
from hyperpaint.light.sky_functions import (
    clear_sky_shares,
    function_shapes,
    relative_radiance,
    scattering_cosine,
    sunward_gain,
    zenith_radiance,
)
from hyperpaint.light.sun import air_mass, diffuse_fraction, solar_position

from .detection_rules import DIFFUSE, MIRROR
from .model import SHADED

if TYPE_CHECKING:
    import xarray as xr

    from .full_light import Matches

__all__ = [
    "CORRECTIONS", "SKIES", "SOURCES", "SUN_FROM", "correct_light", "diffuse_from_clear_sky",
    "fraction_in_shadow", "measured_fraction", "mirrored_radiances", "remove_mirrored_sky", "shadow_side_of",
    "sky_of", "sun_zenith_of",
]  # fmt: skip


SOURCES = ("model", "pvlib", "shadow")
"""Where the diffuse fraction may come from, beside a measured spectrum."""


SUN_FROM = ("time", "latitude", "longitude")
"""Variables of a line that say where the sun is."""


def sun_zenith_of(line: xr.Dataset, sun_zenith: float | None) -> float:
    """Return the zenith angle of the sun [degree], given or from time and place of the line."""
    if sun_zenith is not None:
        if not 0.0 <= sun_zenith <= 90.0:
            raise SchemaError(f"sun_zenith={sun_zenith!r}, expected 0 to 90 degrees")
        return float(sun_zenith)
    if not set(SUN_FROM) <= set(line.variables):
        raise SchemaError(
            "the sun's place is not known: the line has no time, latitude and longitude",
            mend="give sun_zenith= [degree], or diffuse= with a measured spectrum",
            option="give --sun-zenith",
        )
    zenith, _ = solar_position(*(line[name].values for name in SUN_FROM))
    if not np.isfinite(zenith).any():
        raise SchemaError(
            "time, latitude or longitude is missing on every line",
            mend="give sun_zenith= [degree]",
            option="give --sun-zenith",
        )
    return float(np.mean(zenith[np.isfinite(zenith)]))


def shadow_side_of(line: xr.Dataset, sun_azimuth: float | None, heading: float | None) -> Floats | None:
    """Return the direction (along, across) in the image in which shadows fall, None where it is not known.

    The right-hand column is to the right of the flight.
    """
    if heading is None and "heading" in line.variables:
        heading = _mean_angle(line["heading"].values)
    if sun_azimuth is None and set(SUN_FROM) <= set(line.variables):
        _, azimuth = solar_position(*(line[name].values for name in SUN_FROM))
        sun_azimuth = _mean_angle(azimuth)
    if heading is None or sun_azimuth is None:
        return None
    away = np.radians(sun_azimuth + 180.0 - heading)
    return np.array([np.cos(away), np.sin(away)])


def _mean_angle(degrees: Any) -> float | None:
    """Return the mean direction [degree]; None where none is known."""
    angles = np.radians(np.asarray(degrees, np.float64)[np.isfinite(degrees)])
    if not angles.size:
        return None
    return float(np.degrees(np.arctan2(np.sin(angles).mean(), np.cos(angles).mean())))


def diffuse_from_clear_sky(source: str, wavelength: Floats, zenith: float) -> Floats:
    """Return the diffuse fraction (band,) [1] of a clear sky, by the core's model or by pvlib's.

    pvlib's SPECTRL2 (Bird & Riordan, J. Climate Appl. Meteor. 25, 87, 1986) is asked for sea level, 1.5 cm of
    water vapour, 0.31 atm-cm of ozone and a turbidity of 0.1 at 500 nm.
    """
    if source != "pvlib":
        return diffuse_fraction(wavelength, zenith)
    with needs_extra("pvlib", "sim", "the direct/diffuse split of SPECTRL2"):
        from pvlib.spectrum import spectrl2
    spectra: Any = spectrl2(
        apparent_zenith=zenith,
        aoi=zenith,
        surface_tilt=0,
        ground_albedo=0.2,
        surface_pressure=101_325.0,
        relative_airmass=float(air_mass(zenith)),
        precipitable_water=1.5,
        ozone=0.31,
        aerosol_turbidity_500nm=0.1,
        dayofyear=172,
    )
    direct = spectra["poa_global"] - spectra["poa_sky_diffuse"] - spectra["poa_ground_diffuse"]
    whole = np.ravel(spectra["poa_global"])
    share = 1.0 - np.ravel(direct) / whole
    return np.interp(wavelength, np.ravel(spectra["wavelength"]), share)


def measured_fraction(given: Any, wavelength: Floats) -> Floats:
    """Return a measured diffuse fraction at the bands' wavelengths; `SchemaError` where it does not fit them.

    Takes ``given`` (band,) or DataArray with a coordinate ``wavelength``: reading in the shade of a small
    disc over that in full light [1]; ``wavelength`` (band,): [nm].
    """
    if hasattr(given, "coords") and "wavelength" in given.coords:
        nm = np.asarray(given["wavelength"].values, np.float64)
        order = np.argsort(nm, kind="stable")
        values = np.interp(wavelength, nm[order], np.asarray(given.values, np.float64)[order], np.nan, np.nan)
    else:
        values = np.asarray(given, np.float64)
    if values.shape != wavelength.shape:
        raise SchemaError(
            f"diffuse= has shape {values.shape}, expected one value for each of the {wavelength.size} bands, "
            "or a DataArray with a coordinate 'wavelength' [nm]"
        )
    if not ((values >= 0) & (values <= 1)).all():
        raise SchemaError("diffuse= leaves 0 to 1, or does not cover the bands")
    return values


def fraction_in_shadow(
    channels: Floats32, places: list[Ints], spectrum: Floats, size: Ints, matches: Matches
) -> Floats:
    r"""Return the diffuse fraction (channel,) from a shadow on the largest body that has one of some size.

    :math:`f_{dif} = \rho_{shadow} / \rho_{sun}`, of the pixels of the shadow that see most of the sky: the
    60th to 90th percentile of brightness in the bluest quarter. What things around hide of the sky, and light
    that comes off them, is not known, and remains in it. Raises `SchemaError`: there is no such shadow.
    """
    shaded = np.flatnonzero((matches.state == SHADED) & (size >= DIFFUSE.min_shadow_px))
    if not shaded.size:
        raise SchemaError(
            "diffuse='shadow' found no cast shadow of 60 pixels beside its ground in full sun; "
            "use diffuse='model', or give a measured spectrum"
        )
    ground = matches.body[shaded]
    best = ground[np.argmax(size[ground])]
    flat = channels.reshape(-1, channels.shape[2])
    here = np.concatenate([places[segment] for segment in shaded[ground == best]])
    values = flat[here].astype(np.float64)
    values = values[np.isfinite(values).all(axis=1)]
    blue = values[:, : max(1, values.shape[1] // 4)].mean(axis=1)
    low, high = np.quantile(blue, DIFFUSE.open_sky_quantiles)
    open_ = values[(blue >= low) & (blue <= high)]
    return np.asarray(np.clip(open_.mean(axis=0) / spectrum[best], 0.0, 1.0))


def mirrored_radiances(sky: str, wavelength: Floats, sun_zenith: float) -> tuple[Floats, Floats]:
    """Return the radiance of the zenith, and by how much that around the sun is larger (band,) [1].

    Over the mean of the sky, one of `SKIES`; only a clear one has a brighter side. Takes ``wavelength``
    (band,) [nm] and the sun's zenith angle [degree].
    """
    none = np.zeros(wavelength.shape)
    if sky != "clear":
        return none + (OVERCAST_ZENITH if sky == "overcast" else 1.0), none
    zenith = min(sun_zenith, MAX_SUN_ZENITH_DEG)
    above = zenith_radiance(wavelength, zenith)
    cosine = np.cos(np.radians(max(zenith - MIRROR.from_sun_deg, 0.0)))
    from_sun = scattering_cosine(cosine, np.array(0.0), zenith)
    shapes = function_shapes(zenith)
    parts = np.array([1.0, *(relative_radiance(shape, cosine, from_sun) for shape in shapes)])
    return above, np.maximum(parts @ clear_sky_shares(wavelength, zenith) - above, 0.0)


CORRECTIONS = ("mirrored_sky_removed", "light_corrected", "tilt")
"""Attributes of reflectance that say what was corrected."""

SKIES = ("clear", "uniform", "overcast")
"""Where the light of the sky comes from: `hyperpaint.light.sky_functions`, evenly, or CIE's overcast sky."""

OVERCAST_ZENITH = 9.0 / 7.0
"""Radiance of the zenith of a CIE overcast sky over that of a uniform one [1]."""

MAX_SUN_ZENITH_DEG = 89.0
"""Sun from which on the sky's directions are taken for what they are there [degree]."""

MAX_TILT_GAIN = 0.3
"""Change of the direct light up to which a surface gains sky with it, as one that leans [1]."""

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


@takes_quantities(sun_zenith="degree")
def remove_mirrored_sky(
    line: xr.Dataset,
    *,
    strength: float = NORMAL_REFLECTANCE,
    sky_view_factor: float = 1.0,
    diffuse: Any = "model",
    sun_zenith: float | None = None,
    sky: str | None = None,
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
        Direct/diffuse split, see `hyperpaint.surroundings.survey`.
    sky
        "clear", darker at the zenith than its mean when the sun is low; "uniform"; "overcast", brighter there
        (CIE). By default clear with a modelled split, uniform with a measured one, which may be of any sky.

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
        the split or the sky is not known; all are listed.

    Notes
    -----
    .. math:: \rho = \rho_{obs} - F_0 V f_{dif} L_z / \bar L

    with the radiance :math:`L_z` of the zenith, which a level panel mirrors, over the mean of the sky. Of a
    tilted panel, the sky is removed first, and the light corrected then: what is mirrored does not become
    more with the light that falls on the paint.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> seen = xr.DataArray(np.float32([0.042, 0.033]), dims="band", attrs={"units": "1"})
    >>> paint = xr.Dataset({"reflectance": seen}, {"wavelength": ("band", [410.0, 850.0], {"units": "nm"})})
    >>> remove_mirrored_sky(paint, sun_zenith=30.0).reflectance.values.round(3)
    array([0.032, 0.031], dtype=float32)
    """
    line = schema.rename_to_roles(line)
    # what a tilted surface mirrors is subtracted before all is divided by its light
    _check(line, CORRECTIONS, strength=strength, sky_view_factor=sky_view_factor)
    line = _as_fractions(line)
    fraction, source = _fraction_of(line, diffuse, sun_zenith)
    name = sky_of(sky, diffuse)
    above: Any = OVERCAST_ZENITH if name == "overcast" else 1.0
    if name == "clear":
        above = zenith_radiance(line["wavelength"].values, sun_zenith_of(line, sun_zenith))
    taken = (strength * sky_view_factor * fraction * above).astype(np.float32)
    text = (
        f"F0 {strength:g} x sky view {sky_view_factor:g} x diffuse fraction ({source}) "
        f"x zenith of a sky ({name})"
    )
    corrected = {name: line[name] - _on_bands(taken) for name in _LEVELS if name in line.variables}
    return _with(line, corrected, "mirrored_sky_removed", text)


@takes_quantities(direct="1", sky_view_factor="1", sun_zenith="degree")
def correct_light(
    line: xr.Dataset,
    *,
    direct: Any = 1.0,
    sky_view_factor: Any = 1.0,
    neighbour_reflectance: float = 0.2,
    diffuse: Any = "model",
    sun_zenith: float | None = None,
    sky: str | None = None,
) -> xr.Dataset:
    r"""Divide by the light that a tilted surface, or one with part of its sky hidden, gets.

    Lazy. For one surface, whose attitude is known or was found (`hyperpaint.surroundings.flag` gives 1 - c as
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
        Direct/diffuse split, see `hyperpaint.surroundings.survey`.
    sky
        As for `remove_mirrored_sky`; under an overcast sky a small lean changes as little as under a uniform.

    Returns
    -------
    Dataset
        The same with ``reflectance`` and its uncertainties divided, and a library's spread, quantiles and
        members; NaN where there is no light. The attribute ``light_corrected`` of reflectance says by what.

    Raises
    ------
    SchemaError
        ``reflectance`` or ``wavelength`` is missing, numbers are out of range, the light was corrected before
        (here, or by ``tilt=`` of `hyperpaint.reflectance`), or the split is not known; all are listed.

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
    _check(line, ("light_corrected", "tilt"), most=10.0, neighbour_reflectance=neighbour_reflectance, **plain)
    line = _as_fractions(line)
    fraction, source = _fraction_of(line, diffuse, sun_zenith)
    model = sky_of(sky, diffuse)
    gain = np.zeros(fraction.shape)
    if model == "clear":
        gain = sunward_gain(line["wavelength"].values, sun_zenith_of(line, sun_zenith))
    share, lean = _on_bands(fraction), np.clip(direct - 1.0, -MAX_TILT_GAIN, MAX_TILT_GAIN)
    with _same_pixels():
        seen = sky_view_factor * (1.0 + lean * _on_bands(gain)) * share
        light = direct * (1.0 - share) + seen + (1.0 - sky_view_factor) * neighbour_reflectance
        light = light.where(light > 0)
        corrected = {name: line[name] / light for name in (*_LEVELS, *_WIDTHS) if name in line.variables}
    factors = {
        name: f"{value:g}" if name in plain else "given"
        for name, value in (("direct", direct), ("sky view", sky_view_factor))
    }
    parts = ", ".join(f"{name} {value}" for name, value in factors.items())
    return _with(line, corrected, "light_corrected", f"{parts}, diffuse fraction ({source}), sky ({model})")


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


@contextlib.contextmanager
def _same_pixels() -> Iterator[None]:
    """Refuse arrays of other lines or columns than the line's, which xarray would cut to those in common."""
    import xarray as xr

    try:
        with xr.set_options(arithmetic_join="exact"):
            yield
    except xr.AlignmentError as error:
        raise SchemaError(
            "direct= or sky_view_factor= is of other lines or columns than the line",
            mend="crop them alike, or drop their coordinates along_track and cross_track",
        ) from error


def _as_fractions(line: xr.Dataset) -> xr.Dataset:
    """Return the line with what is corrected in units of 1."""
    names = [name for name in (*_LEVELS, *_WIDTHS) if name in line.variables]
    return line.assign({name: convert(line[name], "1") for name in names})


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


def sky_of(sky: str | None, diffuse: Any) -> str:
    """Return which sky is meant; `SchemaError` where there is no such."""
    if sky is None:
        return "clear" if isinstance(diffuse, str) else "uniform"
    if sky not in SKIES:
        raise SchemaError(f"sky={sky!r}, expected one of {', '.join(SKIES)}")
    return sky


def _on_bands(values: Any) -> xr.DataArray:
    import xarray as xr

    return xr.DataArray(values.astype(np.float32), dims=BAND)


def _with(line: xr.Dataset, variables: dict[str, xr.DataArray], name: str, text: str) -> xr.Dataset:
    """Return the line with what was corrected, and say so."""
    done = {
        key: array.astype(np.float32).transpose(*line[key].dims).assign_attrs(line[key].attrs)
        for key, array in variables.items()
    }
    said = {"mirror_reflection": "excluded"} if name == "mirrored_sky_removed" else {}
    done["reflectance"] = done["reflectance"].assign_attrs({name: text, **said})
    corrected = line.assign(done)
    if PAINT in line["reflectance"].dims:
        before = line.attrs.get("corrections", "none")
        entry = f"{name}: {text}"
        corrected = corrected.assign_attrs(corrections=entry if before == "none" else f"{before}; {entry}")
    return corrected
