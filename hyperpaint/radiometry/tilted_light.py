"""Light on a tilted surface under the sky that the irradiance record shows, which may not be clear."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base.arrays import Array, Floats
from hyperpaint.base.errors import PaintWarning, SchemaError
from hyperpaint.base.schema import IRRADIANCE_TIME, IRRADIANCE_WAVELENGTH, VARIABLES
from hyperpaint.light.diffuse_record import SKY_STATES, diffuse_from_record
from hyperpaint.light.illumination import MAX_SUN_ZENITH_DEG, Tilt
from hyperpaint.light.sky_functions import sunward_gain
from hyperpaint.light.sun import solar_position

_CLEAR, _HAZY, _CONTRADICTORY = (SKY_STATES.index(word) for word in ("clear", "hazy", "contradictory"))


#: Largest distance in time of samples that give the sky over a panel, changes over a minute included.
MAX_PANEL_DISTANCE = np.timedelta64(120, "s")


def tilt_factors(
    tilt: Tilt, light: Mapping[str, Any], used: Array, wavelength: Floats, place: tuple[float, float]
) -> Floats:
    """Return irradiance on the surface relative to level ground (sample, band) [1], for the ``used`` samples.

    A diffuse fraction of the tilt itself is used first. Else the fraction of the lines, where they have one;
    else the split by `hyperpaint.light.diffuse_from_record`, which leaves a clear sky to the tilt's own
    model. Diffuse light is uniform except under a clear or hazy sky.

    light: ``irradiance``, its time and wavelengths, and of lines ``time``, ``diffuse_fraction`` and
        ``sky_state``; place: latitude and longitude [degree].

    Warns PaintWarning: The record fits no sky, and the surface is lit as under a clear one.
    """
    stamps = np.asarray(light["irradiance_time"]).astype("datetime64[ns]")

    def factor(sky: Tilt, samples: Array) -> Floats:
        return sky.factor(stamps[used[samples]], *place, wavelength)

    if tilt.diffuse_fraction is not None or tilt.angle == 0.0:
        return factor(tilt, np.arange(used.size))
    fraction, state = _split(light, stamps, wavelength, place)
    if fraction is None:
        return factor(tilt, np.arange(used.size))
    factors = np.empty((used.size, wavelength.size))
    fraction, state = fraction[used], state[used]
    by_model = (state == _CLEAR) | (state == _CONTRADICTORY) | ~np.isfinite(fraction).all(axis=1)
    if (state == _CONTRADICTORY).any():
        text = (
            f"the irradiance fits no sky at its place and time in {(state == _CONTRADICTORY).sum()} of "
            f"{used.size} samples; tilt= assumes a clear sky for them, otherwise pass "
            "Tilt(diffuse_fraction=)"
        )
        warnings.warn(PaintWarning(text, code="sky-unknown"), stacklevel=2)
    if by_model.any():
        factors[by_model] = factor(tilt, np.flatnonzero(by_model))
    for at in np.flatnonzero(~by_model):
        sky = "clear" if state[at] == _HAZY else "uniform"
        factors[at] = factor(replace(tilt, diffuse_fraction=fraction[at], sky=sky), np.array([at]))[0]
    return factors


def direct_share(
    light: Mapping[str, Any], moment: np.datetime64, wavelength: Floats, place: tuple[float, float]
) -> Floats | None:
    """Return the relative change of a panel's light with its direct part (sky, band) [1].

    1 - f for a diffuse fraction f that is uniform; under a clear sky also with its bright side moving with
    the sun. None where the split is unknown. The arguments are those of `tilt_factors`.
    """
    stamps = np.asarray(light["irradiance_time"]).astype("datetime64[ns]")
    away = np.abs(stamps - moment)
    near = np.flatnonzero(away <= max(MAX_PANEL_DISTANCE, away.min()))
    nearby = {**light, "irradiance": np.asarray(light["irradiance"])[near], "irradiance_time": stamps[near]}
    if "diffuse_fraction" in light and len(np.atleast_2d(light["diffuse_fraction"])) == stamps.size:
        nearby |= {
            name: np.asarray(light[name])[near] for name in ("diffuse_fraction", "sky_state") if name in light
        }
    fraction, state = _split(nearby, stamps[near], wavelength, place)
    if fraction is None:
        return None
    at = int(away[near].argmin())
    zenith = float(solar_position(np.array([moment]), *place)[0][0])
    if zenith >= MAX_SUN_ZENITH_DEG:
        return None
    shares = [1.0 - fraction[at]]
    if state[at] in (_CLEAR, _HAZY, _CONTRADICTORY):
        shares.append(shares[0] + fraction[at] * sunward_gain(wavelength, zenith))
    return np.stack(shares)


def _split(
    light: Mapping[str, Any], stamps: Array, wavelength: Floats, place: tuple[float, float]
) -> tuple[Floats | None, Array]:
    # Diffuse fraction (sample, band) and number of the state (sample,); None where unknown
    if "diffuse_fraction" in light:
        return _split_of_lines(light, stamps, wavelength.size)
    channels = xr.Variable(
        IRRADIANCE_WAVELENGTH, light["irradiance_wavelength"], VARIABLES[IRRADIANCE_WAVELENGTH].attrs
    )
    record = xr.DataArray(
        np.asarray(light["irradiance"]),
        {IRRADIANCE_TIME: stamps, IRRADIANCE_WAVELENGTH: channels},
        (IRRADIANCE_TIME, IRRADIANCE_WAVELENGTH),
        attrs=VARIABLES["irradiance"].attrs,
    )
    try:
        # to a kilometre, so that a crop of the line means the same sky
        at = tuple(round(degrees, 2) for degrees in place)
        split = diffuse_from_record(record.to_dataset(name="irradiance"), *at, wavelength=wavelength)
    except SchemaError:  # a record without channels in the compared intervals
        return None, np.zeros(stamps.size, np.int8)
    return split["diffuse_fraction"].values.astype(np.float64), split["sky_state"].values


def _split_of_lines(light: Mapping[str, Any], stamps: Array, bands: int) -> tuple[Floats | None, Array]:
    # Fraction and state of the line nearest to each sample; None where no line has a time
    fraction = np.atleast_2d(np.asarray(light["diffuse_fraction"], np.float64))
    time = np.asarray(light["time"]).astype("datetime64[ns]")
    if len(fraction) == time.size:
        lines = np.flatnonzero(~np.isnat(time))
        if not lines.size:
            return None, np.zeros(stamps.size, np.int8)
        # a float64 of seconds orders stamps of a flight to a microsecond
        at, sampled = (
            (moments - time[lines[0]]) / np.timedelta64(1, "s") for moments in (time[lines], stamps)
        )
        rows = lines[np.abs(at[:, None] - sampled).argmin(axis=0)]
    else:  # one a sample, or one for all
        rows = np.minimum(np.arange(stamps.size), len(fraction) - 1)
    state = np.asarray(light.get("sky_state", SKY_STATES.index("overcast"))).ravel()
    state = state[rows] if state.size == len(fraction) else np.broadcast_to(state[:1], rows.shape)
    return np.broadcast_to(fraction, (len(fraction), bands))[rows], state
