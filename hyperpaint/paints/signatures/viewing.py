"""From where pixels are seen, and how that lies to the sun.

Measured directions of every pixel come first; else those of a camera of known look angles and attitude.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from hyperpaint.base import schema
from hyperpaint.base.arrays import Array, Floats

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["ATTITUDE", "Viewing", "mean_view", "relative_azimuth", "viewing_of"]


ATTITUDE = ("roll", "pitch", "heading")
"""Variables of a line that turn its camera."""

_PIXELS = ("view_zenith", "view_azimuth")
_ALONG_THE_VERTICAL = 1e-6
"""Horizontal part of a direction below which it has no azimuth, 0.2 arc seconds."""


class Viewing:
    """What a flight line says of its directions of view.

    Parameters
    ----------
    found
        Those that it has of ``view_zenith``, ``view_azimuth`` (along_track, cross_track), ``look_angle``
        (cross_track) and `ATTITUDE` (along_track) [degree].
    problems
        Why others cannot be used.

    Attributes
    ----------
    planes, lines
        Variables of pixels and of lines that directions are made of.
    look : (cross_track,), float64
        Look angles [degree]; None where they are not needed.
    told
        Where directions are from, or why they are not known.
    """

    def __init__(self, found: Mapping[str, xr.DataArray], problems: tuple[str, ...] = ()) -> None:
        self.planes: dict[str, xr.DataArray] = {}
        self.lines: dict[str, xr.DataArray] = {}
        self.look: Floats | None = None
        if "view_zenith" in found:
            self.planes = {name: found[name] for name in _PIXELS if name in found}
            self.told = " and ".join(self.planes) + " of the pixels"
        elif {"look_angle", "roll", "pitch"} <= set(found):
            self.look = found["look_angle"].values.astype(np.float64)
            self.lines = {name: found[name] for name in ATTITUDE if name in found}
            self.told = f"look_angle with {', '.join(self.lines)}; no angle between camera and platform"
        else:
            missing = [name for name in ("look_angle", "roll", "pitch") if name not in found]
            told = f"not known: no view_zenith of the pixels, and no {', '.join(missing)}"
            self.told = "; ".join([told, *problems])


def viewing_of(line: xr.Dataset) -> Viewing:
    """Return what a line says of its directions of view; what is no such variable is named, not refused."""
    names = [name for name in (*_PIXELS, "look_angle", *ATTITUDE) if name in line.variables]
    found, problems = schema.find(line, names)
    return Viewing(found, tuple(problems))


def mean_view(
    viewing: Viewing, pixels: Mapping[str, Array], lines: Mapping[str, Array], across: Array
) -> tuple[float, float]:
    r"""Return zenith angle and azimuth of the mean direction to the camera [degree], NaN where not known.

    Parameters
    ----------
    viewing
        Of the line.
    pixels, lines : (pixel,)
        Its variables at the pixels, and at their lines.
    across : (pixel,)
        Columns.

    Notes
    -----
    With roll :math:`\phi` (right side down), pitch :math:`\theta` (nose up) and heading (clockwise from
    north), a column of look angle :math:`\alpha` sees along

    .. math:: R_z(heading) \, R_y(\theta) \, R_x(\phi) \, (0, \sin\alpha, \cos\alpha)^T

    in north, east and down; the camera is in the opposite direction. Directions are averaged as unit vectors,
    so that pixels on both sides of the nadir are seen from above. Without azimuths the zenith angle is the
    plain mean.
    """
    if viewing.planes:
        zenith = pixels["view_zenith"].astype(np.float64)
        azimuth = pixels.get("view_azimuth", np.full(zenith.shape, np.nan)).astype(np.float64)
    elif viewing.look is not None:
        heading = lines.get("heading", np.full(across.shape, np.nan))
        zenith, azimuth = _from_attitude(viewing.look[across], lines["roll"], lines["pitch"], heading)
    else:
        return np.nan, np.nan
    known = np.isfinite(zenith)
    zenith, azimuth = zenith[known], azimuth[known]
    if not zenith.size:
        return np.nan, np.nan
    away = np.sin(np.radians(zenith))
    turned = np.isfinite(azimuth) | (away < _ALONG_THE_VERTICAL)
    if not turned.all():
        return float(zenith.mean()), np.nan
    angle = np.radians(np.where(np.isfinite(azimuth), azimuth, 0.0))
    north, east = float((away * np.cos(angle)).mean()), float((away * np.sin(angle)).mean())
    level = np.hypot(north, east)
    made = float(np.degrees(np.arctan2(level, np.cos(np.radians(zenith)).mean())))
    return made, float(np.degrees(np.arctan2(east, north)) % 360.0) if level > _ALONG_THE_VERTICAL else np.nan


def _from_attitude(look: Array, roll: Array, pitch: Array, heading: Array) -> tuple[Floats, Floats]:
    """Return zenith angle and azimuth of the direction to the camera [degree]; see `mean_view`."""
    # roll turns the line of sight within the plane that look angles are in
    side, tilt = np.radians(look.astype(np.float64) - roll), np.radians(pitch.astype(np.float64))
    ahead, right = np.sin(tilt) * np.cos(side), np.sin(side)
    down = np.cos(tilt) * np.cos(side)
    zenith = np.degrees(np.arctan2(np.hypot(ahead, right), down))
    azimuth = (np.degrees(np.arctan2(-right, -ahead)) + heading) % 360.0
    return zenith, azimuth


def relative_azimuth(first: float, second: float) -> float:
    """Return the angle between two azimuths, 0 to 180 [degree].

    Examples
    --------
    >>> relative_azimuth(350.0, 20.0)
    30.0
    """
    return abs((first - second + 180.0) % 360.0 - 180.0)
