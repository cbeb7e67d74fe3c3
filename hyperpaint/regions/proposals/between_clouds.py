"""Free sun over a car under broken clouds, from the irradiance record and from a shadow beside the car."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from hyperpaint.base.arrays import Array, Bools
from hyperpaint.base.schema import ALONG_TRACK, BAND, IRRADIANCE_TIME
from hyperpaint.light.sun import diffuse_fraction
from hyperpaint.surroundings import SceneModel
from hyperpaint.surroundings.light_split import split_of
from hyperpaint.surroundings.model import SHADED


@dataclass(frozen=True)
class GapRules:
    """Thresholds of light between broken clouds."""

    #: Wavelength from which sunlight and the light of the sky differ most [nm].
    infrared_nm: float = 780.0
    #: Maximum excess of the diffuse fraction over that of a clear sky in free sun: a cloud that blocks half
    #: of the sunlight raises it by at least 0.1 [1].
    max_above_clear: float = 0.08
    #: Maximum ratio of the smallest to the largest irradiance of the record: thinner clouds do not show in a
    #: shadow [1].
    max_dip: float = 0.65
    #: Irradiance relative to free sun, below which a cloud begins [1].
    min_of_free: float = 0.95
    #: Time of free sun required before and after a line [s]: a cloud's edge at 8 m/s moves 80 m.
    around_s: float = 10.0
    #: Maximum diffuse fraction in a shadow beside the car relative to the record [1]: 0.6 to 1 of the sky
    #: lights a shadow; under a cloud the ratio is 2 to 3.
    max_over_record: float = 1.5
    #: Minimum diffuse fraction assumed for the record: light from neighbours reaches every shadow [1].
    least_fraction: float = 0.06
    min_px: int = 40  #: Minimum number of pixels of the shadow, and of the sunlit ground beside it.
    sd: float = 0.025  #: Standard uncertainty of the level between clouds, relative [1].
    around_px: int = 60  #: Margin around a part of a car that may hold its shadow [pixel].


GAPS = GapRules()


class FreeSun(NamedTuple):
    """Times of free sun between clouds, from the irradiance record."""

    lines: Bools  #: (line,): Whether the sun was free.
    fraction: float  #: Diffuse fraction of the infrared in free sun [1].


def sunny_lines(line: xr.Dataset, model: SceneModel, diffuse: Any, zenith: float | None) -> FreeSun | None:
    """Return the lines with free sun by the irradiance record; None where clouds were not broken."""
    if "broken" not in str(model.attrs.get("sky_states", "")).split():
        return None
    no_sun = FreeSun(np.zeros(line.sizes[ALONG_TRACK], bool), np.nan)
    if zenith is None or not {"irradiance", "time", IRRADIANCE_TIME} <= set(line.variables):
        return no_sun
    nm = line["wavelength"].values.astype(np.float64)
    infrared = np.flatnonzero(nm >= min(GAPS.infrared_nm, float(nm.max())))
    fraction = split_of(line, diffuse, zenith).fraction
    if ALONG_TRACK not in fraction.dims:
        return no_sun
    record = line["irradiance"]
    # NaN where a channel is missing: means over fewer channels do not compare
    level = record.mean([dim for dim in record.dims if dim != IRRADIANCE_TIME], skipna=False).values
    if not np.nanmin(level) < GAPS.max_dip * np.nanmax(level):
        return no_sun
    infrared_fraction = fraction.isel({BAND: infrared}).mean(BAND).values
    clear = float(diffuse_fraction(nm[infrared], zenith).mean())
    free = _stays_free(np.asarray(infrared_fraction < clear + GAPS.max_above_clear), level, line)
    return FreeSun(free, float(infrared_fraction[free].mean())) if free.any() else no_sun


def _stays_free(free: Bools, level: Array, line: xr.Dataset) -> Bools:
    # Lines (line,) with free sun in all samples of the record from `around_s` before to `around_s` after
    time, stamps = (
        line[name].values.astype("datetime64[ns]").astype(np.int64) for name in ("time", IRRADIANCE_TIME)
    )
    if not free.any():
        return free
    has_level = np.isfinite(level)
    stamps, level = stamps[has_level], level[has_level]
    free_level = np.median(np.interp(time[free], stamps, level))
    dimmed = stamps[level <= GAPS.min_of_free * free_level]
    # time to the nearest dimmed sample or end of the record
    bounds = np.concatenate([[stamps[0]], dimmed, [stamps[-1]]])
    later = np.clip(np.searchsorted(bounds, time), 1, bounds.size - 1)
    distance = np.minimum(bounds[later] - time, time - bounds[later - 1])
    return np.asarray(free & (distance > GAPS.around_s * 1e9))


def doubt_about_clouds(
    window: tuple[slice, slice], channels: Array, model: SceneModel, sun: FreeSun | None
) -> str:
    """Return why the sun may not have been free over a car under broken clouds; empty where it was.

    Takes ``window``: the part of the picture with the car; ``channels`` (line, column, channel): reflectance
    [1]; ``sun``: see `sunny_lines`.
    """
    if sun is None:
        return ""
    advice = "take a line flown between clouds, or draw the region and check its level by hand"
    if not sun.lines[window[0]].all():
        return (
            "clouds were broken, and no irradiance record shows free sun from "
            f"{GAPS.around_s:g} s before this car was recorded to {GAPS.around_s:g} s after; {advice}"
        )
    shape = channels.shape[:2]
    near = tuple(
        slice(max(axis.start - GAPS.around_px, 0), min(axis.stop + GAPS.around_px, size))
        for axis, size in zip(window, shape, strict=True)
    )
    infrared = model.channel_wavelength >= min(GAPS.infrared_nm, float(model.channel_wavelength.max()))
    brightness = channels[near][..., infrared].mean(axis=2)
    segment = model.segment[near]
    body = np.append(model.body, np.int32(-1))[segment]
    shaded = np.append(model.state == SHADED, False)[segment]
    # only shadows on the ground: the sides of cars that face away from the sun are shaded, too
    shaded &= np.append(model.ground > 0, False)[segment]
    fraction = _shadow_fraction(brightness, body, shaded)
    recorded = max(sun.fraction, GAPS.least_fraction)
    if fraction is None:
        return f"clouds were broken, and no shadow beside this car shows that the sun was free here; {advice}"
    if not fraction <= GAPS.max_over_record * recorded:
        return (
            f"clouds were broken, and a shadow beside this car has {fraction:.0%} of the light, expected "
            f"{recorded:.0%} by the record: a cloud covered the sun here; {advice}"
        )
    return ""


def _shadow_fraction(brightness: Array, body: Array, shaded: Bools) -> float | None:
    # Diffuse fraction in the largest shadow; None without enough of it, or of sunlit ground of the same body
    inside = shaded & (body >= 0) & np.isfinite(brightness)
    if not inside.any():
        return None
    ground = int(np.bincount(body[inside]).argmax())
    dark, lit = brightness[inside & (body == ground)], brightness[~shaded & (body == ground)]
    return None if min(dark.size, lit.size) < GAPS.min_px else float(np.median(dark) / np.median(lit))
