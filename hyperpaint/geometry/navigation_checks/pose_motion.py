"""How a picture should move from one row to the next, as the poses have it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from hyperpaint.base.arrays import Floats
from hyperpaint.base.attitude_conventions import Convention
from hyperpaint.base.errors import SchemaError
from hyperpaint.base.schema import ALONG_TRACK, require
from hyperpaint.geometry.georeference.cameras import look_angles
from hyperpaint.geometry.georeference.poses import ANGLES, NAVIGATION_TIME, POSE, canonical_values, poses_at
from hyperpaint.geometry.georeference.rotations import matrices, quaternions

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["Motion", "Recorded", "View", "course_of", "local_metres", "recorded_poses", "units_of", "view_of"]


_AXIS, _ECCENTRICITY2 = 6378137.0, 6.69437999014e-3  # WGS 84
_LOWEST = 0.05
"""Downward part of a direction below which it meets no ground worth the name."""


@dataclass(frozen=True)
class Motion:
    """What should be seen from each row to the next; see `picture_motion.RowMotion`.

    Attributes
    ----------
    shift : (line - 1, zone)
        Sideways [pixel].
    travel : (line - 1, zone)
        Across the row, forward positive [pixel of the row].
    """

    shift: Floats
    travel: Floats


@dataclass(frozen=True)
class Recorded:
    """Poses as recorded, with the times they are wanted at.

    Attributes
    ----------
    times : (row,)
        Of the record.
    columns
        Values (row,) as the file has them, by the name of the variable.
    wanted : (line,)
        Mid exposures.
    crs
        Map whose north grid headings count from.
    """

    times: npt.NDArray[np.datetime64]
    columns: dict[str, Floats]
    wanted: npt.NDArray[np.datetime64]
    crs: Any = None

    def at(self, convention: Convention, clock_offset_s: float = 0.0) -> Floats:
        """Return canonical poses (6, line) if the record means what ``convention`` says."""
        columns = (self.columns[name] for name in POSE)
        values = canonical_values(*columns, convention=convention, crs=self.crs)
        return poses_at(self.times, values, self.wanted, clock_offset_s=clock_offset_s)

    def swapped(self) -> Recorded:
        """Return the same with latitude and longitude in each other's place."""
        latitude, longitude = self.columns["longitude"], self.columns["latitude"]
        return replace(self, columns={**self.columns, "latitude": latitude, "longitude": longitude})

    def mirrored(self) -> Recorded:
        """Return the same with longitudes of the other sign."""
        return replace(self, columns={**self.columns, "longitude": -self.columns["longitude"]})


@dataclass(frozen=True)
class View:
    """How a camera looks down from its platform.

    Attributes
    ----------
    right, forward : (zone,)
        Tangents of the middle of every zone, to the right and forward, columns from left to right.
    step : (zone,)
        Change of ``right`` from a column to the next.
    boresight
        Roll, pitch, heading of the camera in the body [degree].
    lever_arm
        Forward, right, down [m].
    ground
        Height of the ground above the ellipsoid [m].
    """

    right: Floats
    forward: Floats
    step: Floats
    boresight: tuple[float, float, float]
    lever_arm: tuple[float, float, float]
    ground: float

    def motion(self, poses: Floats, *, boresight: tuple[float, float, float] | None = None) -> Motion:
        """Return the motion that poses (6, line) mean; NaN where a pose is not known."""
        north, east = local_metres(poses[0], poses[1])
        body = matrices(quaternions(*poses[3:]))
        whole = body @ matrices(quaternions(*(boresight or self.boresight)))
        origin = np.stack([north, east], axis=-1)
        arm = body @ np.array(self.lever_arm)
        height = poses[2] - arm[:, 2] - self.ground
        here = self._hits(origin + arm[:, :2], height, whole, 0.0)
        pixel = self._hits(origin + arm[:, :2], height, whole, 1.0) - here
        way = np.diff(here, axis=0)
        pixel = (pixel[1:] + pixel[:-1]) / 2
        area = (pixel**2).sum(axis=-1)
        with np.errstate(invalid="ignore", divide="ignore"):
            sideways = (way * pixel).sum(axis=-1) / area
            forward = (way[..., 0] * pixel[..., 1] - way[..., 1] * pixel[..., 0]) / area
        return Motion(sideways, forward * np.sign(self.step))

    def _hits(self, origin: Floats, height: Floats, rotation: Floats, columns: float) -> Floats:
        u = np.stack([self.forward, self.right + columns * self.step, np.ones_like(self.right)], axis=-1)
        d = np.einsum("nij,zj->nzi", rotation, u)
        with np.errstate(invalid="ignore", divide="ignore"):
            s = np.where(d[..., 2] > _LOWEST, height[:, None] / d[..., 2], np.nan)
        return np.asarray(origin[:, None] + s[..., None] * d[..., :2])


def local_metres(latitude: Floats, longitude: Floats) -> tuple[Floats, Floats]:
    """Return metres to the north and to the east of the first known place; good for a flight line."""
    known = np.flatnonzero(np.isfinite(latitude) & np.isfinite(longitude))
    if not known.size:
        return np.full(latitude.shape, np.nan), np.full(latitude.shape, np.nan)
    start = known[0]
    phi = np.radians(latitude[start])
    root = 1.0 - _ECCENTRICITY2 * np.sin(phi) ** 2
    meridian = _AXIS * (1.0 - _ECCENTRICITY2) / root**1.5
    parallel = _AXIS / np.sqrt(root) * np.cos(phi)
    north = np.radians(latitude - latitude[start]) * meridian
    return north, np.radians(longitude - longitude[start]) * parallel


def course_of(poses: Floats) -> float:
    """Return the direction from the first place to the last, clockwise from true north [degree]."""
    north, east = local_metres(poses[0], poses[1])
    known = np.flatnonzero(np.isfinite(north))
    if known.size < 2:
        return float("nan")
    return float(np.degrees(np.arctan2(east[known[-1]], north[known[-1]])) % 360.0)


def recorded_poses(line: xr.Dataset, navigation: xr.Dataset | None, crs: Any = None) -> Recorded:
    """Return the record of a line's poses, whatever its units say.

    Raises
    ------
    SchemaError
        Variables are missing.
    """
    source = line if navigation is None else navigation
    dim = ALONG_TRACK if navigation is None else NAVIGATION_TIME
    wanted = require(line, ["time"], "a check of navigation")["time"].values
    missing = [name for name in (*POSE, *(() if navigation is None else (NAVIGATION_TIME,)))
               if name not in source.variables or source[name].dims != (dim,)]  # fmt: skip
    if missing:
        subject = "this line" if navigation is None else "this navigation record"
        raise SchemaError(
            f"{subject} has no {', '.join(missing)} ({dim}); give navigation=hp.open_navigation(...)"
        )
    times = wanted if navigation is None else source[NAVIGATION_TIME].values
    columns = {name: np.asarray(source[name].values, np.float64) for name in POSE}
    return Recorded(times.astype("datetime64[ns]"), columns, wanted.astype("datetime64[ns]"), crs)


def view_of(
    line: xr.Dataset,
    camera: Any,
    centres: Floats,
    boresight: tuple[float, float, float],
    lever_arm: tuple[float, float, float],
    ground: float,
) -> tuple[View, bool]:
    """Return where zones look, and whether the order of columns matters: not with a table, which has signs.

    Raises
    ------
    SchemaError
        The camera is not known; see `hyperpaint.geometry.georeference.cameras.look_angles`.
    """
    from hyperpaint.geometry.georeference import PinholeCamera

    across, along = look_angles(line, camera, Convention(column_order="left_to_right"))
    right, forward = np.tan(np.radians(np.asarray(across))), np.tan(np.radians(np.asarray(along)))
    column = np.arange(right.size)
    view = View(
        np.interp(centres, column, right),
        np.interp(centres, column, forward),
        np.interp(centres, column, np.gradient(right)),
        boresight,
        lever_arm,
        ground,
    )
    return view, isinstance(camera, PinholeCamera)


def units_of(line: xr.Dataset, navigation: xr.Dataset | None) -> str | None:
    """Return the unit that all three angles are labelled with; None where they are not."""
    source = line if navigation is None else navigation
    found = {str(source[name].attrs.get("units")) for name in ANGLES}
    return found.pop() if len(found) == 1 and "None" not in found else None
