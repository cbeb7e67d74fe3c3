"""The geometry of a flight line for ray tracing.

Frames: the scene has x east, y north, z up [m]. The camera has x forward, y right, z down; the line of sight
of a column is (tangent forward, tangent to the right, 1). With heading H clockwise from north, pitch P (nose
up) and roll R (right wing down), a direction of the camera is in north, east, down

    d_ned = Rz(H) Ry(P) Rx(R) d_camera

(the aerospace sequence yaw, pitch, roll of ISO 1151-2), and x, y, z = east, north, -down.

Quaternions are (scalar, x, y, z), of unit length, and rotate camera directions to north, east, down; q and -q
are the same rotation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.simulation.setting_checks import finite_floats

#: Maximum size of a flight; poses are held in memory, 200 bytes per line.
MAX_LINES, MAX_COLUMNS = 1_000_000, 20_000

#: Default UTC at mid-exposure of the first scan line.
START = np.datetime64("2021-07-20T17:10:00", "ns")

#: Maximum tangent of a view angle.
MAX_VIEW_TANGENT = float(np.tan(np.radians(85.0)))


@dataclass(frozen=True, eq=False)
class Platform:
    """The geometry of a flight line for ray tracing.

    Attributes
    ----------
    origin
        Position of the camera at start and end of every exposure, shape (line, 2, 3) [m].
    rotation
        Rotations from the camera to the scene at start and end, shape (line, 2, 3, 3).
    column_edges
        Tangents of the edges of columns, positive to the right, shape (columns + 1,).
    along_edges
        Tangents of the rear and front edge of a line, positive forward, shape (2,).
    time
        Mid-exposure of every line [ns after the first], shape (line,), int64.
    exposure_time
        Exposure [s].
    start
        UTC at which ``time`` is zero.

    Raises
    ------
    SchemaError
        Shapes do not fit, numbers are not finite, matrices are not rotations, tangents do not increase; all
        are listed.
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
        if not 1 <= lines <= MAX_LINES:
            problems.add(f"{lines} lines", expected=f"1 to {MAX_LINES}", code="value-out-of-range")
        # shapes
        expected = {
            "origin": (lines, 2, 3),
            "rotation": (lines, 2, 3, 3),
            "along_edges": (2,),
            "time": (lines,),
        }
        for name, shape in expected.items():
            actual = np.shape(getattr(self, name))
            if actual != shape:
                problems.add(f"{name} has shape {actual}", expected=f"{shape}", code="dims-wrong")
        edges = self.column_edges.shape
        if len(edges) != 1 or not 2 <= edges[0] <= MAX_COLUMNS + 1:
            problems.add(
                f"column_edges has shape {edges}",
                expected=f"(columns + 1,) with 1 to {MAX_COLUMNS} columns",
                code="dims-wrong",
            )
        if np.asarray(self.time).dtype != np.int64:
            problems.add(
                f"time is {np.asarray(self.time).dtype}",
                expected="int64 nanoseconds after the first line",
                code="type-wrong",
            )
        problems.raise_if_any()
        # values
        products = self.rotation @ self.rotation.swapaxes(-1, -2)
        if not np.allclose(products, np.eye(3), atol=1e-6) or (np.linalg.det(self.rotation) < 0).any():
            problems.add("rotation contains matrices that are not rotations", code="rotation-invalid")
        for name in ("column_edges", "along_edges"):
            edges = getattr(self, name)
            if not (np.diff(edges) > 0).all() or np.abs(edges).max() > MAX_VIEW_TANGENT:
                problems.add(
                    f"{name} do not increase, or exceed 85 degrees",
                    expected="tangents of view angles",
                    code="edges-invalid",
                )
        if not 0 <= self.exposure_time < 3600:
            problems.add(
                f"exposure_time={self.exposure_time!r}",
                expected="a number of seconds from 0 to below 3600",
                code="value-out-of-range",
            )
        problems.raise_if_any()

    @property
    def lines(self) -> int:
        return len(self.origin)

    @property
    def columns(self) -> int:
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


#: Matrix between north, east, down and east, north, up, in both directions.
_SCENE = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
_MIN_ARC_RAD = 1e-8  # angle below which rotations are interpolated linearly


def quaternions(roll: ArrayLike, pitch: ArrayLike, heading: ArrayLike) -> Floats:
    """Return qz(heading) qy(pitch) qx(roll), shape (..., 4); angles [degree]."""
    halves = [np.radians(np.asarray(angle, dtype=np.float64)) / 2 for angle in (roll, pitch, heading)]
    (cr, cp, ch), (sr, sp, sh) = ([f(half) for half in halves] for f in (np.cos, np.sin))
    return np.stack(
        [
            cr * cp * ch + sr * sp * sh,
            sr * cp * ch - cr * sp * sh,
            cr * sp * ch + sr * cp * sh,
            cr * cp * sh - sr * sp * ch,
        ],
        axis=-1,
    )


def turns(rotation: Floats) -> Floats:
    """Return quaternions as matrices within the frame forward, right, down, shape (..., 3, 3)."""
    w, x, y, z = np.moveaxis(rotation, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def matrices(rotation: Floats) -> Floats:
    """Return rotation matrices from camera directions to the scene's, of quaternions, shape (..., 3, 3).

    Examples
    --------
    Heading east, right is south and down stays down:

    >>> matrices(quaternions([0.0], [0.0], [90.0]))[0].round(9) + 0.0
    array([[ 1.,  0.,  0.],
           [ 0., -1.,  0.],
           [ 0.,  0., -1.]])
    """
    return np.asarray(_SCENE @ turns(rotation))


def interpolate(first: Floats, second: Floats, share: Floats) -> Floats:
    """Return rotations on the shorter arc from ``first`` (part 0) to ``second`` (part 1), shape (..., 4)."""
    dot = (first * second).sum(axis=-1)
    second = np.where((dot < 0)[..., None], -second, second)
    angle = np.arccos(np.clip(np.abs(dot), 0.0, 1.0))
    sine = np.where(angle > _MIN_ARC_RAD, np.sin(angle), 1.0)
    is_near = angle <= _MIN_ARC_RAD
    first_weight = np.where(is_near, 1.0 - share, np.sin((1.0 - share) * angle) / sine)
    second_weight = np.where(is_near, share, np.sin(share * angle) / sine)
    sums = first_weight[..., None] * first + second_weight[..., None] * second
    return np.asarray(sums / np.linalg.norm(sums, axis=-1, keepdims=True))


def attitude_of(rotation: Floats) -> Floats:
    # roll, pitch, heading of the mean of two rotations (line, 2, 3, 3), shape (line, 3) [degree]
    rotation_sum = _SCENE @ rotation.sum(axis=1)
    # the mean is the rotation nearest to the sum (Moakher 2002)
    u, _, v_transposed = np.linalg.svd(rotation_sum)
    mean = u @ v_transposed
    roll = np.arctan2(mean[:, 2, 1], mean[:, 2, 2])
    pitch = -np.arcsin(np.clip(mean[:, 2, 0], -1.0, 1.0))
    angles = np.degrees(np.stack([roll, pitch, np.arctan2(mean[:, 1, 0], mean[:, 0, 0])], axis=-1))
    angles[:, 2] %= 360.0
    return np.asarray(angles)
