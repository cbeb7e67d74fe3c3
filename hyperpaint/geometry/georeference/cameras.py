"""Look directions of the columns of a line camera."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import xarray as xr

from hyperpaint.base.attitude_conventions import Convention
from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.facts import convert, one_of, takes_quantities
from hyperpaint.base.schema import CROSS_TRACK, Floats

_MAX_LOOK_ANGLE_DEG = 89.0  # angle from the optical axis


@takes_quantities(pixel_pitch="m", focal_length="m", field_of_view="degree")
@dataclass(frozen=True)
class PinholeCamera:
    """A line camera whose columns are evenly spaced behind one projection centre.

    Columns are evenly spaced in the tangent of the angle, not in the angle.

    Attributes
    ----------
    columns
        Number of columns; the axis runs through their middle.
    pixel_pitch, focal_length
        Distance of columns on the detector, and of the detector from the projection centre [m].
    field_of_view
        Angle between the outermost columns [degree], instead of the two lengths.
    edges
        Ends of ``field_of_view``: ``"centres"`` of the outermost columns, or their ``"outer"`` edges. The two
        differ by half a column at either edge of the swath; makers use both, so there is no default.

    Raises
    ------
    SchemaError
        Neither or both of the two descriptions, or numbers out of range; all are listed.

    Examples
    --------
    >>> PinholeCamera(3, pixel_pitch=7.4e-6, focal_length=7.4e-6).look_across("left_to_right")
    array([-45.,   0.,  45.])
    >>> PinholeCamera(3, field_of_view=90.0, edges="centres").look_across("right_to_left")
    array([ 45.,   0., -45.])
    """

    columns: int
    pixel_pitch: float | None = None
    focal_length: float | None = None
    field_of_view: float | None = None
    edges: Literal["centres", "outer"] | None = None

    def __post_init__(self) -> None:
        problems = Problems("the description of this camera is not valid", SchemaError)
        problems.add_if(
            not (isinstance(self.columns, int | np.integer) and self.columns > 0),
            f"columns {self.columns!r:.60}",
            expected="a whole number above 0",
            code="value-out-of-range",
        )
        lengths = (self.pixel_pitch, self.focal_length)
        problems.add_if(
            (self.field_of_view is None) == (None in lengths)
            or (self.field_of_view is not None and lengths != (None, None)),
            "pixel_pitch, focal_length and field_of_view do not describe one camera",
            expected="either the two lengths, or field_of_view with edges",
            code="option-conflict",
        )
        for name, limit, expected in (
            ("pixel_pitch", np.inf, "a length above 0 [m]"),
            ("focal_length", np.inf, "a length above 0 [m]"),
            ("field_of_view", 2 * _MAX_LOOK_ANGLE_DEG, "0 to 178 [degree]"),
        ):
            value = getattr(self, name)
            problems.add_if(
                value is not None and not 0.0 < value < limit,
                f"{name} {value!r:.60}",
                expected=expected,
                code="value-out-of-range",
            )
        problems.add_if(
            self.field_of_view is not None
            and one_of(self.edges, ("centres", "outer"), "edges", problems=problems)
            and self.edges == "centres"
            and self.columns == 1,
            "one column has no angle between centres",
            mend="give edges='outer'",
            code="option-conflict",
        )
        problems.raise_if_any()

    @property
    def spacing(self) -> float:
        """Distance of neighbouring columns at unit distance, a tangent [1]."""
        if self.pixel_pitch is not None and self.focal_length is not None:
            return self.pixel_pitch / self.focal_length
        intervals = self.columns - 1 if self.edges == "centres" else self.columns
        return float(2.0 * np.tan(np.radians(self.field_of_view or 0.0) / 2.0) / intervals)

    def look_across(self, column_order: Literal["left_to_right", "right_to_left"]) -> Floats:
        """Return the angles of the columns from the axis, positive to the right (cross_track,) [degree]."""
        sign = -1.0 if column_order == "right_to_left" else 1.0
        offset = np.arange(self.columns) - (self.columns - 1) / 2
        return np.asarray(np.degrees(np.arctan(sign * offset * self.spacing)) + 0.0)


def look_angles(
    line: xr.Dataset, camera: PinholeCamera | xr.Dataset | None, convention: Convention
) -> tuple[Any, Any]:
    # Return look angles of the columns, across and along the track (cross_track,) [degree]; maybe lazy.
    #
    # ``line``: Has ``cross_track``; and, without a camera, ``look_across`` and perhaps ``look_along``, or
    # ``look_angle``. ``camera``: A pinhole, whose ``column_order`` the convention must declare; or a table of
    # the angles of every column: ``look_across`` [degree], positive to the right, and, for a slit that is
    # seen bent or turned, ``look_along``, positive forward. ``convention``: Declares ``column_order``; not
    # needed for a table, whose angles have signs.
    #
    # Raises `SchemaError`: No camera, a camera with another number of columns, or an undeclared order of
    # columns. Raises `UnitsError`: The angles of a table have no units.
    if isinstance(camera, PinholeCamera):
        if convention.column_order is None:
            raise SchemaError(
                "the order of columns is not declared: whether column 0 looks left or right",
                mend="give convention=Convention(column_order='left_to_right') or 'right_to_left'",
                code="column-order-missing",
            )
        across = camera.look_across(convention.column_order)
        along = np.zeros_like(across)
    else:
        source = line if camera is None else camera
        name = next((name for name in ("look_across", "look_angle") if name in source.variables), None)
        if name is None:
            raise SchemaError(
                "the line has neither look_across nor look_angle (cross_track) [degree]",
                mend="give camera=hp.geometry.PinholeCamera(columns, pixel_pitch, focal_length), or a table "
                "of the angles",
                code="camera-missing",
            )
        across = convert(source[name], "degree").data.astype(np.float64)
        along = (
            convert(source["look_along"], "degree").data.astype(np.float64)
            if "look_along" in source.variables
            else np.zeros(across.shape)
        )
    problems = Problems("the directions of the columns cannot be used", SchemaError)
    for name, angles in (("look_across", across), ("look_along", along)):
        problems.add_if(
            angles.shape != (line.sizes[CROSS_TRACK],),
            f"{name} has shape {angles.shape}",
            expected=f"{line.sizes[CROSS_TRACK]} columns, as the line",
            code="length-mismatch",
        )
    problems.raise_if_any()
    return across, along


def directions(across: Floats, along: Floats) -> Floats:
    # Return unit vectors in the camera's frame (cross_track, 3): forward, right, along the optical axis.
    #
    # Raises `SchemaError`: Angles that are not finite, or point to the horizon or above it.
    SchemaError.raise_if(
        not (np.abs(across) < _MAX_LOOK_ANGLE_DEG).all() or not (np.abs(along) < _MAX_LOOK_ANGLE_DEG).all(),
        "some columns look to the horizon or above it, or have no angle",
        expected=f"angles below {_MAX_LOOK_ANGLE_DEG:g} degrees",
        code="value-out-of-range",
    )
    vectors = np.stack([np.tan(np.radians(along)), np.tan(np.radians(across)), np.ones(across.size)], axis=1)
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
