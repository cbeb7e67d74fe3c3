"""Directions of view of the pixels of a flight line."""

import contextlib
from collections.abc import Mapping

import numpy as np
import xarray as xr

from hyperpaint.base import (
    ALONG_TRACK,
    ANGLES,
    CROSS_TRACK,
    Array,
    Convention,
    Floats,
    MissingExtraError,
    SchemaError,
    schema,
)

from .locating import directions, matrices, meridian_convergence, quaternions

_VIEW_ANGLES = ("view_zenith", "view_azimuth")
_NO_ROTATION = (0.0, 0.0, 0.0)
#: Minimum horizontal part of a direction with an azimuth, 0.2 arc seconds.
MIN_HORIZONTAL_PART = 1e-6


class Viewing:
    """Directions of view of a flight line.

    They follow from ``view_zenith`` and ``view_azimuth`` of pixels (along_track, cross_track), else from
    ``look_across`` or ``look_angle`` (cross_track) with `ANGLES` (along_track) [degree], in the declared
    convention of the line and with its ``boresight``. Unusable variables raise no error.

    Attributes
    ----------
    planes, lines
        Variables of pixels, and of lines.
    look, ahead : (cross_track,)
        Look angles across and along the track [degree]; None where not needed.
    boresight
        Roll, pitch and heading of the camera in the platform [degree].
    convention
        Convention of the attitude, in degrees; None where it needs no conversion.
    description
        Source of the directions, or the reason why they are unknown, with unusable variables.
    """

    def __init__(self, line: xr.Dataset) -> None:
        look_names = ("look_across", "look_along", "look_angle")
        variables, faults = schema.find(
            line, [name for name in (*_VIEW_ANGLES, *look_names, *ANGLES) if name in line.variables]
        )
        problems = [fault.text() for fault in faults]
        self.planes: dict[str, xr.DataArray] = {}
        self.lines: dict[str, xr.DataArray] = {}
        self.look: Floats | None = None
        self.ahead: Floats | None = None
        self.boresight: tuple[float, ...] = tuple(map(float, line.attrs.get("boresight", _NO_ROTATION)))
        # convention of the attitude; None where it is canonical or undeclared
        try:
            declared = Convention.from_attrs(line.attrs)
        except SchemaError as error:
            problems.append(str(error))
            declared = None
        if declared is not None:
            # the variables are in degrees already
            declared = declared.replace(
                angle_unit="degree", height_reference="ellipsoid", geoid_undulation=None
            )
        self.convention = None if declared is None or declared == declared.of_canonical else declared
        look = next((name for name in ("look_across", "look_angle") if name in variables), None)
        if "view_zenith" in variables:
            self.planes = {name: variables[name] for name in _VIEW_ANGLES if name in variables}
            self.description = " and ".join(self.planes) + " of the pixels"
        elif look is not None and {"roll", "pitch"} <= set(variables):
            self.look = variables[look].values.astype(np.float64)
            if "look_along" in variables:
                self.ahead = variables["look_along"].values.astype(np.float64)
            self.lines = {name: variables[name] for name in ANGLES if name in variables}
            angles = ", ".join(f"{angle:g}" for angle in self.boresight)
            mounting = (
                f"boresight {angles}" if any(self.boresight) else "no angle between camera and platform"
            )
            self.description = "; ".join([f"{look} with {', '.join(self.lines)}", mounting, *problems])
        else:
            missing = [name for name in ("look_angle", "roll", "pitch") if name not in variables]
            self.description = "; ".join(
                [f"unknown: no view_zenith of the pixels, and no {', '.join(missing)}", *problems]
            )


def mean_view(
    viewing: Viewing, pixels: Mapping[str, Array], lines: Mapping[str, Array], across: Array
) -> tuple[float, float]:
    r"""Return zenith angle and azimuth of the mean direction to the camera [degree], NaN where unknown.

    Takes ``viewing``: directions of the line; ``pixels``, ``lines`` (pixel,): values of ``viewing.planes``
    and ``viewing.lines`` for every pixel; ``across`` (pixel,): columns.

    Notes
    -----
    With roll :math:`\phi` (right side down), pitch :math:`\theta` (nose up) and heading (clockwise from
    north), a column of look angle :math:`\alpha` sees along

    .. math:: R_z(heading) \, R_y(\theta) \, R_x(\phi) \, (0, \sin\alpha, \cos\alpha)^T

    in north, east and down, with the turn by the boresight before :math:`R_x` where there is one; the camera
    is in the opposite direction. Directions are averaged as unit vectors, so that pixels on both sides of the
    nadir are seen from above. Without azimuths the zenith angle is the plain mean.
    """
    if viewing.planes:
        zenith = pixels["view_zenith"].astype(np.float64)
        azimuth = pixels.get("view_azimuth", np.full(zenith.shape, np.nan)).astype(np.float64)
    elif viewing.look is not None:
        attitude = _canonical(viewing.convention, lines)
        ahead = None if viewing.ahead is None else viewing.ahead[across]
        zenith, azimuth = _from_attitude(viewing.look[across], ahead, viewing.boresight, *attitude)
    else:
        return np.nan, np.nan
    is_finite = np.isfinite(zenith)
    zenith, azimuth = zenith[is_finite], azimuth[is_finite]
    if not zenith.size:
        return np.nan, np.nan
    horizontal = np.sin(np.radians(zenith))
    if not (np.isfinite(azimuth) | (horizontal < MIN_HORIZONTAL_PART)).all():
        return float(zenith.mean()), np.nan
    # components of the mean unit vector
    angle = np.radians(np.where(np.isfinite(azimuth), azimuth, 0.0))
    north, east = float((horizontal * np.cos(angle)).mean()), float((horizontal * np.sin(angle)).mean())
    length = np.hypot(north, east)
    mean_zenith = float(np.degrees(np.arctan2(length, np.cos(np.radians(zenith)).mean())))
    mean_azimuth = float(np.degrees(np.arctan2(east, north)) % 360.0)
    return mean_zenith, mean_azimuth if length > MIN_HORIZONTAL_PART else np.nan


def pixel_view(line: xr.Dataset) -> tuple[xr.DataArray, xr.DataArray] | None:
    # Return zenith angle and azimuth of the direction to the camera (along_track, cross_track) [degree].
    #
    # See `mean_view`; lazy where ``reflectance`` of the line is lazy, None where they are unknown. Dims of
    # ``line`` are named by role. Attitudes are read: they are small.
    viewing, chunks = Viewing(line), line["reflectance"].variable.chunksizes

    def aligned(array: xr.DataArray) -> xr.DataArray:
        array = array.reset_coords(drop=True)
        return array.chunk({dim: chunks[dim] for dim in array.dims}) if chunks else array

    if set(_VIEW_ANGLES) <= set(viewing.planes):
        zenith, azimuth = (aligned(viewing.planes[name]) for name in _VIEW_ANGLES)
        return zenith, azimuth
    if viewing.look is None or "heading" not in viewing.lines:
        return None
    names = [*viewing.lines, *(name for name in ("latitude", "longitude") if name in line.variables)]
    attitude = _canonical(viewing.convention, {name: line[name].values for name in names})
    looks = [viewing.look] if viewing.ahead is None else [viewing.look, viewing.ahead]

    def of_block(roll: Array, pitch: Array, heading: Array, *looks: Array) -> tuple[Floats, Floats]:
        look, *further = np.broadcast_arrays(*looks, roll, pitch, heading)
        ahead = further[0].ravel() if len(looks) > 1 else None
        angles = (array.ravel() for array in further[-3:])
        zenith, azimuth = _from_attitude(look.ravel(), ahead, viewing.boresight, *angles)
        return zenith.reshape(look.shape), azimuth.reshape(look.shape)

    view: tuple[xr.DataArray, xr.DataArray] = xr.apply_ufunc(
        of_block,
        *(aligned(xr.DataArray(values, dims=ALONG_TRACK)) for values in attitude),
        *(aligned(xr.DataArray(values, dims=CROSS_TRACK)) for values in looks),
        output_core_dims=[[], []],
        dask="parallelized",
        output_dtypes=[np.float64, np.float64],
    )
    return view


def _canonical(convention: Convention | None, lines: Mapping[str, Array]) -> list[Floats]:
    # Roll (right wing down), pitch (nose up) and heading from true north (pixel,) [degree].
    # Headings are NaN where their reference north is unknown.
    roll, pitch = lines["roll"], lines["pitch"]
    heading = lines.get("heading", np.full(roll.shape, np.nan))
    if convention is None:
        return [roll, pitch, heading]
    # angle from true north to grid north, clockwise (pixel,) [degree]; None where the map is unknown
    convergence = None
    has_place = {"latitude", "longitude"} <= set(lines)
    if convention.heading_reference == "grid" and has_place and convention.grid_crs is not None:
        with contextlib.suppress(MissingExtraError, SchemaError):
            convergence = meridian_convergence(lines["latitude"], lines["longitude"], convention.grid_crs)
    has_reference = {"grid": convergence is not None, "magnetic": convention.declination is not None}
    if has_reference.get(convention.heading_reference, True) and np.isfinite(heading).all():
        return list(convention.canonical(roll, pitch, heading, convergence=convergence))
    # roll and pitch do not depend on an unknown heading where the heading is the first rotation
    filled = np.where(
        np.isfinite(heading), heading, 0.0 if convention.euler_order.startswith("Z") else np.nan
    )
    attitude = convention.replace(heading_reference="true").canonical(roll, pitch, filled)
    return [attitude[0], attitude[1], np.full(roll.shape, np.nan)]


def _from_attitude(
    look: Array,
    along: Array | None,
    boresight: tuple[float, ...],
    roll: Array,
    pitch: Array,
    heading: Array,
) -> tuple[Floats, Floats]:
    # Zenith angle and azimuth of the direction to the camera [degree]; see `mean_view`.
    # `look` and `along` are angles of the line of sight in the camera's frame, across and along the track.
    if along is not None or any(boresight):
        sight = directions(look, np.zeros(look.shape) if along is None else along)
        no_heading = np.zeros(roll.shape)
        rotation = matrices(quaternions(roll, pitch, no_heading)) @ matrices(quaternions(*boresight))
        ahead, right, down = np.einsum("pij,pj->ip", rotation, sight)
    else:
        # roll rotates the line of sight within the plane of the look angles
        side, tilt = np.radians(look.astype(np.float64) - roll), np.radians(pitch.astype(np.float64))
        ahead, right, down = np.sin(tilt) * np.cos(side), np.sin(side), np.cos(tilt) * np.cos(side)
    zenith = np.degrees(np.arctan2(np.hypot(ahead, right), down))
    return zenith, (np.degrees(np.arctan2(-right, -ahead)) + heading) % 360.0
