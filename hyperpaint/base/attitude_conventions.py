"""What the numbers of a navigation system mean: signs, units, references, and the order of the columns.

Makers differ in every one of these, and few publish them. A `Convention` therefore is declared, stored with
the data it belongs to, and taken out of them in one place. What everything is turned into, the canonical
form, is: body axes forward, right, down; roll positive with the right wing down, pitch with the nose up,
heading clockwise from true north [degree]; turned about the body's own axes in the order heading, pitch,
roll; heights above the ellipsoid [m].
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from .arrays import Floats
from .errors import Problems, SchemaError
from .units import takes_quantities

_PREFIX = "convention_"
_CHOICES: Mapping[str, tuple[str, ...]] = {
    "roll_positive": ("right_wing_down", "right_wing_up"),
    "pitch_positive": ("nose_up", "nose_down"),
    "heading_positive": ("clockwise", "counterclockwise"),
    "heading_reference": ("true", "grid", "magnetic"),
    "angle_unit": ("degree", "radian"),
    "euler_order": ("ZYX", "ZXY", "XYZ"),
    "height_reference": ("ellipsoid", "geoid"),
    "stamp_reference": ("start", "mid", "end"),
    "column_order": ("left_to_right", "right_to_left"),
}
_UNDECLARED = ("stamp_reference", "column_order")


@takes_quantities(declination="degree", geoid_undulation="m")
@dataclass(frozen=True, kw_only=True)
class Convention:
    """What the numbers of a navigation system, and the columns of a camera, mean.

    Attributes
    ----------
    roll_positive
        ``"right_wing_down"`` or ``"right_wing_up"``.
    pitch_positive
        ``"nose_up"`` or ``"nose_down"``.
    heading_positive
        ``"clockwise"`` (towards east) or ``"counterclockwise"``.
    heading_reference
        North that headings count from: ``"true"``, that of a map ``"grid"``, or ``"magnetic"``.
    angle_unit
        ``"degree"`` or ``"radian"``, of roll, pitch and heading.
    euler_order
        Axes of the body (x forward, y right, z down) in the order in which it is turned, each about where
        the turns before have left it: ``"ZYX"`` is heading, pitch, roll; ``"ZXY"`` heading, roll, pitch.
    height_reference
        What heights are above: ``"ellipsoid"``, or ``"geoid"`` (mean sea level).
    stamp_reference
        What the time stamp of a frame marks of its exposure: ``"start"``, ``"mid"``, ``"end"``; None where it
        is not known.
    column_order
        Column 0 looks to the left of the direction of flight in ``"left_to_right"``, to the right in
        ``"right_to_left"``; None where it is not known.
    declination
        Of magnetic north, east of true north [degree]; added to magnetic headings.
    geoid_undulation
        Height of the geoid above the ellipsoid [m]; added to heights above the geoid.
    grid_crs
        Reference system of the map whose north ``"grid"`` headings count from, such as ``"EPSG:32617"``.

    Raises
    ------
    SchemaError
        A choice that does not exist; numbers that are not finite; all are listed.

    Examples
    --------
    >>> resonon = Convention(roll_positive="right_wing_up", angle_unit="radian", column_order="left_to_right")
    >>> roll, pitch, heading = resonon.canonical(-np.pi / 18, 0.0, np.pi / 2)
    >>> round(float(roll), 9), round(float(pitch), 9), round(float(heading), 9)
    (10.0, 0.0, 90.0)
    >>> Convention.from_attrs(resonon.to_attrs()) == resonon
    True
    """

    roll_positive: Literal["right_wing_down", "right_wing_up"] = "right_wing_down"
    pitch_positive: Literal["nose_up", "nose_down"] = "nose_up"
    heading_positive: Literal["clockwise", "counterclockwise"] = "clockwise"
    heading_reference: Literal["true", "grid", "magnetic"] = "true"
    angle_unit: Literal["degree", "radian"] = "degree"
    euler_order: Literal["ZYX", "ZXY", "XYZ"] = "ZYX"
    height_reference: Literal["ellipsoid", "geoid"] = "ellipsoid"
    stamp_reference: Literal["start", "mid", "end"] | None = None
    column_order: Literal["left_to_right", "right_to_left"] | None = None
    declination: float | None = None
    geoid_undulation: float | None = None
    grid_crs: str | None = None

    def __post_init__(self) -> None:
        problems = Problems("this convention cannot be used", SchemaError)
        for name, choices in _CHOICES.items():
            choice = getattr(self, name)
            if choice not in choices and not (choice is None and name in _UNDECLARED):
                problems.add(f"{name} {choice!r:.60}, expected {' or '.join(map(repr, choices))}")
        for name in ("declination", "geoid_undulation"):
            number = getattr(self, name)
            if number is not None and not (_is_number(number) and np.isfinite(number)):
                problems.add(f"{name} {number!r:.60}, expected a finite number")
        grid: Any = self.grid_crs
        if grid is not None and not isinstance(grid, str):
            problems.add(f"grid_crs {grid!r:.60}, expected text such as 'EPSG:32617'")
        problems.raise_if_any()

    def to_attrs(self) -> dict[str, str | float]:
        """Return the declaration as attributes of a dataset, ``convention_...``; None is left out."""
        declared = ((f.name, getattr(self, f.name)) for f in fields(self))
        return {
            f"{_PREFIX}{name}": value if isinstance(value, str) else float(value)
            for name, value in declared
            if value is not None
        }

    @classmethod
    def from_attrs(cls, attrs: Mapping[Any, Any]) -> Convention | None:
        """Return the convention that attributes declare; None where they declare nothing.

        Raises
        ------
        SchemaError
            They declare what does not exist.
        """
        names = {f.name for f in fields(cls)}
        declared = {name: attrs[f"{_PREFIX}{name}"] for name in names if f"{_PREFIX}{name}" in attrs}
        for name in ("declination", "geoid_undulation"):
            if _is_number(declared.get(name)):
                declared[name] = float(declared[name])  # numpy's, after a round trip through netCDF
        return cls(**declared) if declared else None

    @property
    def of_canonical(self) -> Convention:
        """The canonical form, with this one's ``stamp_reference`` and ``column_order``."""
        return Convention(stamp_reference=self.stamp_reference, column_order=self.column_order)

    def canonical(
        self,
        roll: npt.ArrayLike,
        pitch: npt.ArrayLike,
        heading: npt.ArrayLike,
        *,
        convergence: npt.ArrayLike | None = None,
    ) -> tuple[Floats, Floats, Floats]:
        """Return canonical roll, pitch (-180 to 180) and heading (0 to 360) [degree].

        Parameters
        ----------
        roll, pitch, heading
            Angles as this convention means them.
        convergence
            Grid north, east of true north [degree]; needed for headings from grid north alone. See
            `hyperpaint.geometry.georeference.meridian_convergence`.

        Returns
        -------
        roll, pitch, heading
            Of the broadcast shape, float64; NaN where any of the three is, or is infinite.

        Raises
        ------
        SchemaError
            Headings count from magnetic north and there is no declination, or from grid north and there is
            no convergence.
        """
        scale = 180.0 / np.pi if self.angle_unit == "radian" else 1.0
        signs = (
            -1.0 if self.roll_positive == "right_wing_up" else 1.0,
            -1.0 if self.pitch_positive == "nose_down" else 1.0,
            -1.0 if self.heading_positive == "counterclockwise" else 1.0,
        )
        given = zip(signs, (roll, pitch, heading), strict=True)
        x, y, z = np.broadcast_arrays(*(sign * scale * np.asarray(a, np.float64) for sign, a in given))
        x, y, z = _nan_together(x, y, z)
        if self.euler_order != "ZYX":
            x, y, z = _reordered(x, y, z, self.euler_order)
        x, y, z = _nan_together(x, y, z + self._north(convergence))
        # twice, as a hair less than 0 comes to 360 itself
        return wrapped(x), y, np.mod(np.mod(z, 360.0), 360.0)

    def ellipsoidal(self, height: npt.ArrayLike) -> Floats:
        """Return heights above the ellipsoid [m].

        Raises
        ------
        SchemaError
            Heights are above the geoid, and ``geoid_undulation`` is not declared.
        """
        heights = np.asarray(height, np.float64)
        if self.height_reference == "ellipsoid":
            return heights
        if self.geoid_undulation is None:
            raise SchemaError(
                "heights are above the geoid, and geoid_undulation is not declared; look up the height of "
                "the geoid above the ellipsoid at the place [m] and declare it: "
                "Convention(height_reference='geoid', geoid_undulation=...)"
            )
        return heights + self.geoid_undulation

    def replace(self, **changes: Any) -> Convention:
        """Return the convention with other choices."""
        return replace(self, **changes)

    def _north(self, convergence: npt.ArrayLike | None) -> Floats:
        """Return the direction that headings count from, clockwise from true north [degree]."""
        if self.heading_reference == "true":
            return np.zeros(())
        if self.heading_reference == "magnetic":
            if self.declination is None:
                raise SchemaError(
                    "headings count from magnetic north, and declination is not declared; look up that of "
                    "the place and day [degree, east positive]: "
                    "Convention(heading_reference='magnetic', declination=...)"
                )
            return np.asarray(self.declination, np.float64)
        if convergence is None:
            raise SchemaError(
                "headings count from grid north, whose direction is not known here; declare the map it is "
                "of: Convention(heading_reference='grid', grid_crs='EPSG:...')"
            )
        return np.asarray(convergence, np.float64)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)


def _nan_together(x: Floats, y: Floats, z: Floats) -> tuple[Floats, Floats, Floats]:
    """Return angles that are NaN, all three of them, where any is no finite number."""
    unknown = ~(np.isfinite(x) & np.isfinite(y) & np.isfinite(z))
    return np.where(unknown, np.nan, x), np.where(unknown, np.nan, y), np.where(unknown, np.nan, z)


def wrapped(angle: Floats) -> Floats:
    """Return angles within -180 and 180; those that are there already keep their bits."""
    return np.where(np.abs(angle) > 180.0, (angle + 180.0) % 360.0 - 180.0, angle)


def _reordered(roll: Floats, pitch: Floats, heading: Floats, order: str) -> tuple[Floats, Floats, Floats]:
    """Return the angles that, in the order heading, pitch, roll, make the same rotation."""
    axes = {"X": roll, "Y": pitch, "Z": heading}
    turned = np.eye(3)
    for axis in order:
        turned = turned @ _turn("XYZ".index(axis), np.radians(axes[axis]))
    # R[2, 0] = -sin(pitch); R[2, 1:] = cos(pitch) (sin, cos)(roll); R[:2, 0] = cos(pitch) (cos, sin)(heading)
    return (
        np.degrees(np.arctan2(turned[..., 2, 1], turned[..., 2, 2])),
        np.degrees(np.arcsin(np.clip(-turned[..., 2, 0], -1.0, 1.0))),
        np.degrees(np.arctan2(turned[..., 1, 0], turned[..., 0, 0])),
    )


def _turn(axis: int, angle: Floats) -> Floats:
    """Return rotations about one axis (..., 3, 3)."""
    rotations = np.zeros((*angle.shape, 3, 3))
    first, second = (axis + 1) % 3, (axis + 2) % 3
    rotations[..., axis, axis] = 1.0
    rotations[..., first, first] = rotations[..., second, second] = np.cos(angle)
    rotations[..., second, first] = np.sin(angle)
    rotations[..., first, second] = -np.sin(angle)
    return rotations
