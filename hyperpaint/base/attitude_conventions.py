"""Conventions of navigation systems: signs, units, references, and the order of the columns.

Makers differ in each of these, and few publish them. A `Convention` therefore is declared, stored with its
data, and applied in one place. The canonical form is: body axes forward, right, down; roll positive with the
right wing down, pitch with the nose up, heading clockwise from true north [degree]; rotations about the axes
of the body in the order heading, pitch, roll; heights above the ellipsoid [m].
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Literal

import numpy as np

from .errors import Problems, SchemaError
from .facts import check_fields, declared, fact, is_number
from .schema import ArrayLike, Floats

#: Coordinate of a navigation record: UTC of its poses.
NAVIGATION_TIME = "navigation_time"

#: Variables of a line or a navigation record that rotate its camera.
ANGLES = ("roll", "pitch", "heading")


_PREFIX = "convention_"


@declared
@dataclass(frozen=True, kw_only=True)
class Convention:
    """Meaning of the numbers of a navigation system, and of the columns of a camera.

    Raises
    ------
    SchemaError
        An unknown choice, or a number that is not finite; all are listed.

    Examples
    --------
    >>> resonon = Convention(roll_positive="right_wing_up", angle_unit="radian", column_order="left_to_right")
    >>> roll, pitch, heading = resonon.canonical(-np.pi / 18, 0.0, np.pi / 2)
    >>> round(float(roll), 9), round(float(pitch), 9), round(float(heading), 9)
    (10.0, 0.0, 90.0)
    >>> Convention.from_attrs(resonon.to_attrs()) == resonon
    True
    """

    roll_positive: Literal["right_wing_down", "right_wing_up"] = fact(
        "right_wing_down", "movement for which roll is positive", choices=("right_wing_down", "right_wing_up")
    )
    pitch_positive: Literal["nose_up", "nose_down"] = fact(
        "nose_up", "movement for which pitch is positive", choices=("nose_up", "nose_down")
    )
    heading_positive: Literal["clockwise", "counterclockwise"] = fact(
        "clockwise",
        "direction in which heading increases, seen from above",
        choices=("clockwise", "counterclockwise"),
    )
    heading_reference: Literal["true", "grid", "magnetic"] = fact(
        "true",
        "north direction from which heading is measured; grid is the north of the map projection",
        choices=("true", "grid", "magnetic"),
    )
    angle_unit: Literal["degree", "radian"] = fact(
        "degree", "unit of roll, pitch and heading", choices=("degree", "radian")
    )
    euler_order: Literal["ZYX", "ZXY", "XYZ"] = fact(
        "ZYX",
        "order of the rotations about moving body axes (x forward, y right, z down); ZYX is heading, then "
        "pitch, then roll",
        choices=("ZYX", "ZXY", "XYZ"),
    )
    height_reference: Literal["ellipsoid", "geoid"] = fact(
        "ellipsoid",
        "surface from which heights are measured; the geoid is mean sea level",
        choices=("ellipsoid", "geoid"),
    )
    stamp_reference: Literal["start", "mid", "end"] | None = fact(
        None,
        "instant of the exposure that the time stamp of a frame marks; None for unknown",
        choices=("start", "mid", "end"),
    )
    column_order: Literal["left_to_right", "right_to_left"] | None = fact(
        None,
        "order of the columns, seen in the direction of flight; by default unknown",
        choices=("left_to_right", "right_to_left"),
    )
    declination: float | None = fact(
        None,
        "angle from true north to magnetic north, positive towards east; added to magnetic headings",
        kind="number",
        unit="degree",
    )
    geoid_undulation: float | None = fact(
        None,
        "height of the geoid above the ellipsoid; added to heights above the geoid",
        kind="number",
        unit="m",
    )
    grid_crs: str | None = fact(
        None,
        'coordinate reference system of the map to whose north grid headings refer, such as "EPSG:32617"',
        phrase="text such as 'EPSG:32617'",
    )

    def __post_init__(self) -> None:
        with Problems("this convention cannot be used", SchemaError) as problems:
            check_fields(self, problems)

    def to_attrs(self) -> dict[str, str | float]:
        """Return the declaration as attributes of a dataset, ``convention_...``; None is left out."""
        return {
            f"{_PREFIX}{name}": value if isinstance(value, str) else float(value)
            for name, value in {field.name: getattr(self, field.name) for field in fields(self)}.items()
            if value is not None
        }

    @classmethod
    def from_attrs(cls, attrs: Mapping[Any, Any]) -> "Convention | None":
        """Return the convention that attributes declare; None where they declare nothing.

        Raises
        ------
        SchemaError
            They declare an unknown choice or a wrong number.
        """
        names = {f.name for f in fields(cls)}
        values = {name: attrs[f"{_PREFIX}{name}"] for name in names if f"{_PREFIX}{name}" in attrs}
        for name in ("declination", "geoid_undulation"):
            if is_number(values.get(name)):
                values[name] = float(values[name])  # numpy's, after a round trip through netCDF
        return cls(**values) if values else None

    @property
    def of_canonical(self) -> "Convention":
        """The canonical form, with the same ``stamp_reference`` and ``column_order``."""
        return Convention(stamp_reference=self.stamp_reference, column_order=self.column_order)

    def canonical(
        self,
        roll: ArrayLike,
        pitch: ArrayLike,
        heading: ArrayLike,
        *,
        convergence: ArrayLike | None = None,
    ) -> tuple[Floats, Floats, Floats]:
        """Return canonical roll, pitch (-180 to 180) and heading (0 to 360) [degree].

        Parameters
        ----------
        roll, pitch, heading
            Angles in this convention.
        convergence
            Grid north, east of true north [degree]; needed for headings from grid north alone. See
            `hyperpaint.geometry.georeference.locating.meridian_convergence`.

        Returns
        -------
        roll, pitch, heading
            Broadcast shape, float64; all NaN where one of the three is not finite.

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
        angles = zip(signs, (roll, pitch, heading), strict=True)
        x, y, z = np.broadcast_arrays(*(sign * scale * np.asarray(a, np.float64) for sign, a in angles))
        x, y, z = _nan_together(x, y, z)
        if self.euler_order != "ZYX":
            # the same rotation in the order heading, pitch, roll
            axes = {"X": x, "Y": y, "Z": z}
            rotation = np.eye(3)
            for axis in self.euler_order:
                turn, number = np.radians(axes[axis]), "XYZ".index(axis)
                first, second = (number + 1) % 3, (number + 2) % 3
                about_axis = np.zeros((*turn.shape, 3, 3))
                about_axis[..., number, number] = 1.0
                about_axis[..., first, first] = about_axis[..., second, second] = np.cos(turn)
                about_axis[..., second, first] = np.sin(turn)
                about_axis[..., first, second] = -np.sin(turn)
                rotation = rotation @ about_axis
            # R[2, 0] = -sin(pitch); R[2, 1:] = cos(pitch) (sin, cos)(roll);
            # R[:2, 0] = cos(pitch) (cos, sin)(heading)
            x, y, z = (
                np.degrees(np.arctan2(rotation[..., 2, 1], rotation[..., 2, 2])),
                np.degrees(np.arcsin(np.clip(-rotation[..., 2, 0], -1.0, 1.0))),
                np.degrees(np.arctan2(rotation[..., 1, 0], rotation[..., 0, 0])),
            )
        x, y, z = _nan_together(x, y, z + self._north(convergence))
        # twice: the first mod turns a tiny negative angle into 360
        return wrapped(x), y, np.mod(np.mod(z, 360.0), 360.0)

    def ellipsoidal(self, height: ArrayLike) -> Floats:
        """Return heights above the ellipsoid [m].

        Raises
        ------
        SchemaError
            Heights are above the geoid, and ``geoid_undulation`` is not declared.
        """
        heights = np.asarray(height, np.float64)
        if self.height_reference == "ellipsoid":
            return heights
        return heights + SchemaError.raise_if_none(
            self.geoid_undulation,
            "heights are above the geoid, and geoid_undulation is not declared",
            mend="look up the height of the geoid above the ellipsoid at the place [m] and declare it: "
            "Convention(height_reference='geoid', geoid_undulation=...)",
            code="undulation-missing",
        )

    def replace(self, **changes: Any) -> "Convention":
        """Return the convention with other choices."""
        return replace(self, **changes)

    def _north(self, convergence: ArrayLike | None) -> Floats:
        # Headings count from this direction, clockwise from true north [degree].
        if self.heading_reference == "true":
            return np.zeros(())
        if self.heading_reference == "magnetic":
            north: Any = SchemaError.raise_if_none(
                self.declination,
                "headings count from magnetic north, and declination is not declared",
                mend="look up the declination of the place and day [degree, east positive]: "
                "Convention(heading_reference='magnetic', declination=...)",
                code="declination-missing",
            )
        else:
            north = SchemaError.raise_if_none(
                convergence,
                "headings count from grid north, and the map is not declared",
                mend="declare it: Convention(heading_reference='grid', grid_crs='EPSG:...')",
                code="grid-crs-missing",
            )
        return np.asarray(north, np.float64)


def _nan_together(x: Floats, y: Floats, z: Floats) -> tuple[Floats, Floats, Floats]:
    is_missing = ~(np.isfinite(x) & np.isfinite(y) & np.isfinite(z))
    return np.where(is_missing, np.nan, x), np.where(is_missing, np.nan, y), np.where(is_missing, np.nan, z)


def wrapped(angle: Floats) -> Floats:
    # Return angles within -180 and 180; angles in that range keep their bits.
    return np.where(np.abs(angle) > 180.0, (angle + 180.0) % 360.0 - 180.0, angle)
