"""Position of the sun, diffuse fraction of the irradiance, and sky radiance in a mirror."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from hyperpaint.base.arrays import Floats, Floats32, Ints
from hyperpaint.base.errors import SchemaError, needs_extra
from hyperpaint.light.sky_functions import (
    clear_sky_shares,
    function_shapes,
    relative_radiance,
    scattering_cosine,
    zenith_radiance,
)
from hyperpaint.light.sun import air_mass, diffuse_fraction, solar_position

from .detection_rules import DIFFUSE, MIRROR
from .model import SHADED
from .scratch import gather

if TYPE_CHECKING:
    from .full_light import Matches

#: Sources of the diffuse fraction other than a measured spectrum.
SOURCES = ("model", "pvlib", "shadow")


#: Variables of a line that determine the position of the sun.
SUN_FROM = ("time", "latitude", "longitude")


def sun_zenith_of(line: xr.Dataset, sun_zenith: float | None) -> float:
    """Return the zenith angle of the sun [degree]: the argument, or from time and place of the line."""
    if sun_zenith is not None:
        if not 0.0 <= sun_zenith <= 90.0:
            raise SchemaError(
                f"sun_zenith={sun_zenith!r}", expected="0 to 90 degrees", code="value-out-of-range"
            )
        return float(sun_zenith)
    if not set(SUN_FROM) <= set(line.variables):
        raise SchemaError(
            "the position of the sun is unknown: the line has no time, latitude and longitude",
            mend="pass sun_zenith= [degree], or diffuse= with a measured spectrum",
            option="give --sun-zenith",
            code="sun-unknown",
        )
    zenith, _ = solar_position(*(line[name].values for name in SUN_FROM))
    if not np.isfinite(zenith).any():
        raise SchemaError(
            "time, latitude or longitude is missing on every line",
            mend="pass sun_zenith= [degree]",
            option="give --sun-zenith",
            code="sun-unknown",
        )
    return float(np.mean(zenith[np.isfinite(zenith)]))


def shadow_side_of(line: xr.Dataset, sun_azimuth: float | None, heading: float | None) -> Floats | None:
    """Return the direction (along, across) in the image in which shadows fall; None where it is unknown.

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
    # Mean direction [degree]; None without finite values
    angles = np.radians(np.asarray(degrees, np.float64)[np.isfinite(degrees)])
    if not angles.size:
        return None
    return float(np.degrees(np.arctan2(np.sin(angles).mean(), np.cos(angles).mean())))


def diffuse_from_clear_sky(source: str, wavelength: Floats, zenith: float) -> Floats:
    """Return the diffuse fraction (band,) [1] of a clear sky, by `hyperpaint.light.sun` or by pvlib.

    ``source`` "pvlib" runs SPECTRL2 (Bird & Riordan, J. Climate Appl. Meteor. 25, 87, 1986) for sea level,
    1.5 cm of water vapour, 0.31 atm-cm of ozone and a turbidity of 0.1 at 500 nm.
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
    share = 1.0 - np.ravel(direct) / np.ravel(spectra["poa_global"])
    return np.interp(wavelength, np.ravel(spectra["wavelength"]), share)


def measured_fraction(fraction: Any, wavelength: Floats) -> Floats:
    """Return a measured diffuse fraction at the wavelengths of the bands.

    Takes ``fraction``, an array (band,) or a DataArray with a coordinate ``wavelength``: reading in the shade
    of a small disc over the reading in full light [1]; ``wavelength`` (band,) [nm]. Raises `SchemaError`: it
    does not cover the bands, or values are missing or outside 0 to 1.
    """
    if hasattr(fraction, "coords") and "wavelength" in fraction.coords:
        nm = np.asarray(fraction["wavelength"].values, np.float64)
        order = np.argsort(nm, kind="stable")
        values = np.interp(
            wavelength, nm[order], np.asarray(fraction.values, np.float64)[order], np.nan, np.nan
        )
    else:
        values = np.asarray(fraction, np.float64)
    if values.shape != wavelength.shape:
        raise SchemaError(
            f"diffuse= has shape {values.shape}",
            expected=f"one value for each of the {wavelength.size} bands, or a DataArray with a coordinate "
            "'wavelength' [nm]",
            code="length-mismatch",
        )
    if not ((values >= 0) & (values <= 1)).all():
        raise SchemaError(
            "diffuse= has missing values or values outside 0 to 1",
            expected="0 to 1 in all bands",
            code="value-out-of-range",
        )
    return values


def fraction_in_shadow(
    channels: Floats32, samples: list[Ints], spectrum: Floats, size: Ints, matches: Matches
) -> Floats:
    r"""Return the diffuse fraction (channel,) from the cast shadows on the largest body that has one.

    :math:`f_{dif} = \rho_{shadow} / \rho_{sun}`, from the pixels of the shadows that see most of the sky: the
    60th to 90th percentile of brightness in the bluest quarter of the channels. It is not corrected for the
    unknown sky that objects hide, and the unknown light that they send. Takes ``samples``: flat indices of
    pixels of every segment. Raises `SchemaError`: no cast shadow is large enough.
    """
    shaded = np.flatnonzero((matches.state == SHADED) & (size >= DIFFUSE.min_shadow_px))
    if not shaded.size:
        raise SchemaError(
            f"diffuse='shadow': no cast shadow of at least {DIFFUSE.min_shadow_px} pixels on ground that is "
            "also seen in full sun",
            mend="pass diffuse='model', or a measured spectrum",
            code="shadow-missing",
        )
    bodies = matches.body[shaded]
    largest = bodies[np.argmax(size[bodies])]
    flat = channels.reshape(-1, channels.shape[2])
    indices = np.concatenate([samples[segment] for segment in shaded[bodies == largest]])
    values = gather(flat, indices).astype(np.float64)
    values = values[np.isfinite(values).all(axis=1)]
    blue = values[:, : max(1, values.shape[1] // 4)].mean(axis=1)
    low, high = np.quantile(blue, DIFFUSE.open_sky_quantiles)
    under_open_sky = values[(blue >= low) & (blue <= high)]
    return np.asarray(np.clip(under_open_sky.mean(axis=0) / spectrum[largest], 0.0, 1.0))


#: Distributions of sky radiance: clear (`hyperpaint.light.sky_functions`), uniform, and CIE's overcast sky.
SKIES = ("clear", "uniform", "overcast")

#: Zenith radiance of a CIE overcast sky over the radiance of a uniform sky with the same irradiance [1].
OVERCAST_ZENITH = 9.0 / 7.0

#: Maximum zenith angle of the sun in sky functions; a lower sun is set to this angle [degree].
MAX_SUN_ZENITH_DEG = 89.0


def mirrored_radiances(sky: str, wavelength: Floats, sun_zenith: float) -> tuple[Floats, Floats]:
    """Return the radiance of the zenith, and the excess of the sky around the sun over it (band,) [1].

    Both are relative to the mean of the sky. Only a clear sky is brighter around the sun. Takes ``sky``, one
    of `SKIES`, ``wavelength`` (band,) [nm] and the sun's zenith angle [degree].
    """
    zero = np.zeros(wavelength.shape)
    if sky != "clear":
        return zero + (OVERCAST_ZENITH if sky == "overcast" else 1.0), zero
    zenith = min(sun_zenith, MAX_SUN_ZENITH_DEG)
    above = zenith_radiance(wavelength, zenith)
    cosine = np.cos(np.radians(max(zenith - MIRROR.from_sun_deg, 0.0)))
    from_sun = scattering_cosine(cosine, np.array(0.0), zenith)
    shapes = function_shapes(zenith)
    radiances = np.array([1.0, *(relative_radiance(shape, cosine, from_sun) for shape in shapes)])
    return above, np.maximum(radiances @ clear_sky_shares(wavelength, zenith) - above, 0.0)
