"""What a check needs of a line before it can look at a picture: poses, the view, and the picture's motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from hyperpaint.base.attitude_conventions import Convention
from hyperpaint.base.errors import SchemaError
from hyperpaint.base.schema import ALONG_TRACK
from hyperpaint.geometry.georeference.poses import convention_of

from .picture_motion import RowMotion, row_motion
from .pictures import picture_of
from .pose_motion import Motion, Recorded, View, recorded_poses, view_of

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["MOST_LINES", "Setting", "setting_of"]


MOST_LINES = 4000
"""Lines that a check looks at unless told otherwise: those in the middle."""
_FEWEST_LINES = 64
_STEADY = 1.5
"""Median intervals between lines beyond which frames are missing."""


@dataclass(frozen=True)
class Setting:
    """A line as a check sees it.

    Attributes
    ----------
    declared
        What the record is said to mean.
    recorded
        Poses as recorded.
    seen
        Motion of the picture.
    view
        How the camera looks down, its columns from left to right.
    columns_matter
        Whether the order of columns is to be found out.
    interval
        Between lines [s].
    exposure
        [s]; NaN where it is not known.
    lines
        Which lines.
    """

    declared: Convention
    recorded: Recorded
    seen: RowMotion
    view: View
    columns_matter: bool
    interval: float
    exposure: float
    lines: slice

    @property
    def steady(self) -> npt.NDArray[np.bool_]:
        """Tell after which lines no frame is missing (line - 1,)."""
        stamps = self.recorded.wanted.astype(np.int64).astype(np.float64)
        steps = np.diff(stamps) / 1e9
        return np.asarray((steps > 0) & (steps < _STEADY * self.interval))

    def comparable(self, meant: Motion) -> npt.NDArray[np.bool_]:
        """Tell where motion is known of picture and poses, and no frame is missing (line - 1, zone)."""
        known = np.isfinite(self.seen.shift) & np.isfinite(self.seen.unlikeness)
        return np.asarray(known & np.isfinite(meant.shift) & self.steady[:, None])


def setting_of(
    line: xr.Dataset,
    navigation: xr.Dataset | None,
    *,
    convention: Convention | None,
    camera: Any,
    ground: float | None,
    boresight: Sequence[float],
    lever_arm: Sequence[float],
    image: xr.DataArray | None,
    lines: slice | None,
    crs: Any,
) -> Setting:
    """Return what a check needs (eager: reads a few bands of the lines).

    Raises
    ------
    SchemaError
        No convention, camera, height of the ground, pose or picture; too few lines or columns.
    """
    source, subject = (line, "this line") if navigation is None else (navigation, "this navigation record")
    declared = convention_of(source, convention, subject)
    own = Convention.from_attrs(line.attrs)
    if own is not None:
        declared = declared.replace(
            column_order=declared.column_order or own.column_order,
            stamp_reference=declared.stamp_reference or own.stamp_reference,
        )
    if ground is None:
        told = line.attrs.get("ground")
        if not isinstance(told, int | float):
            raise SchemaError("the height of the ground is not known; give ground= [m above the ellipsoid]")
        ground = float(told)
    chosen = _middle(line.sizes[ALONG_TRACK]) if lines is None else lines
    part = line.isel({ALONG_TRACK: chosen})
    if part.sizes[ALONG_TRACK] < _FEWEST_LINES:
        raise SchemaError(f"{part.sizes[ALONG_TRACK]} lines, expected {_FEWEST_LINES} at least")
    seen = row_motion(picture_of(part, None if image is None else image.isel({ALONG_TRACK: chosen})))
    if seen is None:
        raise SchemaError("the picture is too narrow, or shows nothing at all; expected 64 columns at least")
    roll, pitch, heading = (float(angle) for angle in boresight)
    forward, right, down = (float(length) for length in lever_arm)
    view, matter = view_of(
        line, camera, seen.centres, (roll, pitch, heading), (forward, right, down), float(ground)
    )
    recorded = recorded_poses(part, navigation, crs)
    steps = np.diff(recorded.wanted.astype(np.int64)) / 1e9
    exposure = float(np.median(part["exposure_time"].values)) if "exposure_time" in part.variables else np.nan
    return Setting(
        declared, recorded, seen, view, matter, float(np.median(steps[steps > 0])), exposure, chosen
    )


def _middle(count: int) -> slice:
    first = max((count - MOST_LINES) // 2, 0)
    return slice(first, min(first + MOST_LINES, count))
