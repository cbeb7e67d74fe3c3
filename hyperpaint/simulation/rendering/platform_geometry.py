"""The geometry of a flight line, as rays need it.

Frames: the scene's is x east, y north, z up [m]. The camera's is x forward, y right, z down; a column looks
along (tangent forward, tangent to the right, 1). With heading H clockwise from north, pitch P (nose up) and
roll R (right wing down), a direction of the camera is in north, east, down

    d_ned = Rz(H) Ry(P) Rx(R) d_camera

(the aerospace sequence yaw, pitch, roll of ISO 1151-2), and x, y, z = east, north, -down.

Quaternions are (scalar, x, y, z), of unit length, and turn camera directions into north, east, down; q and -q
are the same rotation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.simulation.setting_checks import finite_floats

#: Sizes of a flight that are taken; poses are held in memory, 200 bytes a line.
MAX_LINES, MAX_COLUMNS = 1_000_000, 20_000

#: UTC at mid exposure of the first scan line, by default.
START = np.datetime64("2021-07-20T17:10:00", "ns")

#: Tangent of the steepest view that is taken.
MAX_VIEW_TANGENT = float(np.tan(np.radians(85.0)))


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
        turned = self.rotation @ self.rotation.swapaxes(-1, -2)
        if not np.allclose(turned, np.eye(3), atol=1e-6) or (np.linalg.det(self.rotation) < 0).any():
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


#: north, east, down into east, north, up, and the other way round
_SCENE = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
_NEARLY_EQUAL = 1e-8  # angles below which the arc is taken for its chord [rad]


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


def interpolate(first: Floats, second: Floats, part: Floats) -> Floats:
    """Return rotations on the shorter arc from ``first`` (part 0) to ``second`` (part 1), shape (..., 4)."""
    dot = (first * second).sum(axis=-1)
    second = np.where((dot < 0)[..., None], -second, second)
    angle = np.arccos(np.clip(np.abs(dot), 0.0, 1.0))
    sine = np.where(angle > _NEARLY_EQUAL, np.sin(angle), 1.0)
    near = angle <= _NEARLY_EQUAL
    one = np.where(near, 1.0 - part, np.sin((1.0 - part) * angle) / sine)
    other = np.where(near, part, np.sin(part * angle) / sine)
    between = one[..., None] * first + other[..., None] * second
    return np.asarray(between / np.linalg.norm(between, axis=-1, keepdims=True))


def attitude_of(rotation: Floats) -> Floats:
    # Roll, pitch, heading halfway between two rotations (line, 2, 3, 3), shape (line, 3) [degree].
    sum_of_both = _SCENE @ rotation.sum(axis=1)
    # the rotation nearest to the sum is the one halfway (Moakher 2002)
    left, _, right = np.linalg.svd(sum_of_both)
    middle = left @ right
    roll = np.arctan2(middle[:, 2, 1], middle[:, 2, 2])
    pitch = -np.arcsin(np.clip(middle[:, 2, 0], -1.0, 1.0))
    angles = np.degrees(np.stack([roll, pitch, np.arctan2(middle[:, 1, 0], middle[:, 0, 0])], axis=-1))
    angles[:, 2] %= 360.0
    return np.asarray(angles)
