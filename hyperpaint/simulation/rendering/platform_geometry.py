"""The geometry of a flight line, as rays need it.

Frames: the scene's is x east, y north, z up [m]. The camera's is x forward, y right, z down; a column looks
along (tangent forward, tangent to the right, 1). With heading H clockwise from north, pitch P (nose up) and
roll R (right wing down), a direction of the camera is in north, east, down

    d_ned = Rz(H) Ry(P) Rx(R) d_camera

(the aerospace sequence yaw, pitch, roll of ISO 1151-2), and x, y, z = east, north, -down.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import Problems, SchemaError

from .rotations import attitude_of

__all__ = ["MOST_COLUMNS", "MOST_LINES", "START", "STEEPEST", "Platform", "finite_floats"]


MOST_LINES, MOST_COLUMNS = 1_000_000, 20_000
"""Sizes of a flight that are taken; poses are held in memory, 200 bytes a line."""

START = np.datetime64("2021-07-20T17:10:00", "ns")
"""UTC at mid exposure of the first line, where nothing else is said."""

STEEPEST = float(np.tan(np.radians(85.0)))
"""Tangent of the steepest view that is taken."""


@dataclass(frozen=True, eq=False)
class Platform:
    """The geometry of a flight line, as rays need it.

    Attributes
    ----------
    origin
        Camera at begin and end of every exposure, shape (line, 2, 3) [m].
    rotation
        What turns camera directions into the scene's, at the same moments, shape (line, 2, 3, 3).
    column_edges
        Tangents between which the columns look, to the right, shape (columns + 1,).
    along_edges
        Tangents between which every column looks, forward, shape (2,).
    time
        Mid exposure of every line [ns after the first], shape (line,), int64.
    exposure_time
        [s]
    start
        UTC at which ``time`` is zero.

    Raises
    ------
    SchemaError
        Shapes do not fit, numbers are not finite, rotations are none, tangents do not increase; all are
        listed.
    """

    origin: Floats
    rotation: Floats
    column_edges: Floats
    along_edges: Floats
    time: NDArray[np.int64]
    exposure_time: float = 0.0
    start: np.datetime64 = START

    def __post_init__(self) -> None:
        problems = Problems("the platform cannot be used", SchemaError)
        for name in ("origin", "rotation", "column_edges", "along_edges"):
            object.__setattr__(self, name, finite_floats(getattr(self, name), name, problems))
        problems.raise_if_any()
        lines = len(self.origin) if self.origin.ndim else 0
        if not 1 <= lines <= MOST_LINES:
            problems.add(f"{lines} lines, expected 1 to {MOST_LINES}")
        self._check_shapes(lines, problems)
        problems.raise_if_any()
        self._check_values(problems)
        problems.raise_if_any()

    def _check_shapes(self, lines: int, problems: Problems) -> None:
        expected = {
            "origin": (lines, 2, 3),
            "rotation": (lines, 2, 3, 3),
            "along_edges": (2,),
            "time": (lines,),
        }
        for name, shape in expected.items():
            found = np.shape(getattr(self, name))
            if found != shape:
                problems.add(f"{name} has shape {found}, expected {shape}")
        edges = self.column_edges.shape
        if len(edges) != 1 or not 2 <= edges[0] <= MOST_COLUMNS + 1:
            problems.add(
                f"column_edges has shape {edges}, expected columns + 1, of 1 to {MOST_COLUMNS} columns"
            )
        if np.asarray(self.time).dtype != np.int64:
            problems.add(
                f"time is {np.asarray(self.time).dtype}, expected int64 nanoseconds after the first line"
            )

    def _check_values(self, problems: Problems) -> None:
        turned = self.rotation @ self.rotation.swapaxes(-1, -2)
        if not np.allclose(turned, np.eye(3), atol=1e-6) or (np.linalg.det(self.rotation) < 0).any():
            problems.add("rotation holds matrices that are no rotations")
        for name in ("column_edges", "along_edges"):
            edges = getattr(self, name)
            if not (np.diff(edges) > 0).all() or np.abs(edges).max() > STEEPEST:
                problems.add(f"{name} do not increase, or look more than 85 degrees aside; expected tangents")
        if not 0 <= self.exposure_time < 3600:
            problems.add(f"exposure_time={self.exposure_time!r}, expected seconds from 0 on")

    @property
    def lines(self) -> int:
        """Scan lines."""
        return len(self.origin)

    @property
    def columns(self) -> int:
        """Columns of the camera."""
        return len(self.column_edges) - 1

    @property
    def position(self) -> Floats:
        """East, north and up of the camera at mid exposure, shape (line, 3) [m]."""
        return np.asarray(self.origin.mean(axis=1))

    @property
    def attitude(self) -> Floats:
        """Roll, pitch and heading at mid exposure, shape (line, 3) [degree]; heading from 0 to 360."""
        return attitude_of(self.rotation)

    @property
    def utc(self) -> NDArray[np.datetime64]:
        """UTC at mid exposure, shape (line,), datetime64[ns]."""
        return np.asarray(self.start + self.time.astype("timedelta64[ns]"))

    def select(self, start: int, stop: int) -> Platform:
        """Return the lines from ``start`` to before ``stop``; their times count from the same moment."""
        here = slice(start, stop)
        return replace(self, origin=self.origin[here], rotation=self.rotation[here], time=self.time[here])


def finite_floats(values: Any, name: str, problems: Problems) -> Floats:
    """Return values as float64, noting what is no array of finite numbers."""
    try:
        made = np.ascontiguousarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        problems.add(f"{name} is not an array of numbers")
        return np.zeros(0)
    if not np.isfinite(made).all():
        problems.add(f"{name} holds {np.count_nonzero(~np.isfinite(made))} values that are not finite")
    return made
