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
    #: Largest excess of a line's diffuse fraction over a clear sky's in free sun: under a cloud that takes
    #: half of the sunlight it is at least 0.1 higher [1].
    max_above_clear: float = 0.08
    #: Largest ratio of least to largest irradiance of the record: thinner clouds do not show in a shadow [1].
    max_dip: float = 0.65
    #: Irradiance relative to free sun, below which a cloud begins [1].
    min_of_free: float = 0.95
    #: Time of free sun required before and after a line [s]: a cloud's edge at 8 m/s moves 80 m.
    around_s: float = 10.0
    #: Largest diffuse fraction in a shadow beside the car, relative to the record's. A shadow sees 0.6 to 1
    #: of the sky; under such a cloud the fraction is 2 to 3 times as large [1].
    max_over_record: float = 1.5
    #: Smallest diffuse fraction assumed for the record: light from around reaches every shadow [1].
    least_fraction: float = 0.06
    min_px: int = 40  #: Minimum number of pixels of the shadow, and of the same ground in the sun.
    sd: float = 0.025  #: Standard uncertainty of the level between clouds, relative [1].
    around_px: int = 60  #: Margin around a part of a car that may hold its shadow [pixel].


GAPS = GapRules()


class FreeSun(NamedTuple):
    """State of the sun between clouds in the irradiance record."""

    lines: Bools  #: (line,): Whether it was free.
    fraction: float  #: Diffuse fraction of the infrared where it was [1].


def sunny_lines(line: xr.Dataset, model: SceneModel, diffuse: Any, zenith: float | None) -> FreeSun | None:
    """Return the lines at which the record had free sun, between clouds that take much of it.

    None where clouds were not broken.
    """
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
    # a channel missing in some samples would shift their means
    level = record.mean([dim for dim in record.dims if dim != IRRADIANCE_TIME], skipna=False).values
    if not np.nanmin(level) < GAPS.max_dip * np.nanmax(level):
        return no_sun
    infrared_fraction = fraction.isel({BAND: infrared}).mean(BAND).values
    clear = float(diffuse_fraction(nm[infrared], zenith).mean())
    free = _stays(np.asarray(infrared_fraction < clear + GAPS.max_above_clear), level, line)
    return FreeSun(free, float(infrared_fraction[free].mean())) if free.any() else no_sun


def _stays(free: Bools, level: Array, line: xr.Dataset) -> Bools:
    # Lines around which every sample of the record has the level of free sun (line,)
    time, stamps = (
        line[name].values.astype("datetime64[ns]").astype(np.int64) for name in ("time", IRRADIANCE_TIME)
    )
    if not free.any():
        return free
    has_level = np.isfinite(level)
    stamps, level = stamps[has_level], level[has_level]
    in_sun = np.median(np.interp(time[free], stamps, level))
    dark = stamps[level <= GAPS.min_of_free * in_sun]
    bounds = np.concatenate([[stamps[0]], dark, [stamps[-1]]])
    after = np.clip(np.searchsorted(bounds, time), 1, bounds.size - 1)
    distance = np.minimum(bounds[after] - time, time - bounds[after - 1])
    return np.asarray(free & (distance > GAPS.around_s * 1e9))


def doubt_about_clouds(
    window: tuple[slice, slice], channels: Array, model: SceneModel, sun: FreeSun | None
) -> str:
    """Return the reason why the light of a car under broken clouds is uncertain; empty where it is certain.

    Takes ``window``: the part of the picture with the car; ``channels`` (line, column, channel): reflectance
    [1]; ``sun``: see `sunny_lines`.
    """
    if sun is None:
        return ""
    advice = "take a line flown between clouds, or draw the region and check its level by hand"
    if not sun.lines[window[0]].all():
        return (
            "clouds were broken, and no record says that the sun was free from "
            f"{GAPS.around_s:g} s before this car was seen to {GAPS.around_s:g} s after; {advice}"
        )
    shape = channels.shape[:2]
    near = tuple(
        slice(max(part.start - GAPS.around_px, 0), min(part.stop + GAPS.around_px, size))
        for part, size in zip(window, shape, strict=True)
    )
    infrared = model.channel_wavelength >= min(GAPS.infrared_nm, float(model.channel_wavelength.max()))
    brightness = channels[near][..., infrared].mean(axis=2)
    segment = model.segment[near]
    body = np.append(model.body, np.int32(-1))[segment]
    shaded = np.append(model.state == SHADED, False)[segment]
    # only shadows on the ground: sides of cars turned away from the sun are shaded, too
    shaded &= np.append(model.ground > 0, False)[segment]
    fraction = _of_shadow(brightness, body, shaded)
    recorded = max(sun.fraction, GAPS.least_fraction)
    if fraction is None:
        return f"clouds were broken, and no shadow beside this car shows that the sun was free here; {advice}"
    if not fraction <= GAPS.max_over_record * recorded:
        return (
            f"clouds were broken, and a shadow beside this car has {fraction:.0%} of all light, where the "
            f"record says {recorded:.0%}: a cloud was over it; {advice}"
        )
    return ""


def _of_shadow(brightness: Array, body: Array, shaded: Bools) -> float | None:
    # Diffuse fraction in the largest shadow; None without one beside its ground
    inside = shaded & (body >= 0) & np.isfinite(brightness)
    if not inside.any():
        return None
    ground = int(np.bincount(body[inside]).argmax())
    dark, lit = brightness[inside & (body == ground)], brightness[~shaded & (body == ground)]
    return None if min(dark.size, lit.size) < GAPS.min_px else float(np.median(dark) / np.median(lit))
