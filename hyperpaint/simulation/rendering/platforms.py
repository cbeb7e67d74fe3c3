"""Flights: position and attitude of the camera at the begin and end of every exposure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.facts import Fact, Spelling, as_argument, check_values
from hyperpaint.base.units import takes_quantities
from hyperpaint.simulation.setting_checks import finite_floats, moment_of
from hyperpaint.simulation.settings import MAX_SEED, PIXEL_ANGLE_RAD

from .platform_geometry import (
    MAX_COLUMNS,
    MAX_LINES,
    MAX_VIEW_TANGENT,
    START,
    Platform,
    interpolate,
    matrices,
    quaternions,
    turns,
)

_WOBBLE = 16  # key of the random stream
_WOBBLE_RATES = np.geomspace(0.15, 6.0, 9)  # Hz


# --- a straight flight -------------------------------------------------------------------------------------


def pushbroom(
    lines: int,
    columns: int,
    *,
    altitude: float = 15.0,
    ground_sample: float | None = None,
    ifov: float | None = None,
    speed: float | None = None,
    line_spacing: float | None = None,
    centre: tuple[float, float] = (0.0, 0.0),
    start: tuple[float, float] | None = None,
    heading: float = 0.0,
    exposure_time: float = 5e-3,
    frame_period: float = 7e-3,
    wobble: float | Sequence[float] = 0.0,
    sway: float = 0.0,
    seed: int = 0,
    start_time: np.datetime64 | str = START,
) -> Platform:
    """Return a straight, level flight of a camera that looks down.

    Parameters
    ----------
    lines, columns
        Size of the cube.
    altitude
        Height above z = 0 [m].
    ground_sample
        Across-track size of a pixel on z = 0 [m]; or give ``ifov``. By default that of a 12 mm lens in front
        of 7.4 um pixels.
    ifov
        Angle of a pixel, pixel pitch / focal length [rad]; columns have equal steps of the tangent.
    speed
        [m s-1]; or give ``line_spacing`` [m]. By default a line is as long as a pixel is wide.
    centre
        East and north of the middle of the flight [m].
    start
        East and north of the camera at the first line [m], in place of ``centre``.
    heading
        Of the flight, clockwise from north [degree].
    exposure_time, frame_period
        Exposure, and time from line to line [s].
    wobble
        Spread (1 sigma) of roll, pitch and heading [degree], or one for all three: sums of nine
        oscillations from 0.15 to 6 Hz whose amplitudes fall with the root of the frequency.
    sway
        The same of east, north and up [m].
    seed
        Of the wobble and sway.
    start_time
        UTC at mid exposure of the first line.

    Raises
    ------
    SchemaError
        A value is out of its range, or two of them exclude one another; all are listed.

    Examples
    --------
    >>> flight = pushbroom(100, 64, altitude=15.0, ground_sample=0.1)
    >>> flight.position[0].round(3), flight.column_edges[[0, -1]].round(4)
    (array([ 0.  , -4.95, 15.  ]), array([-0.2133,  0.2133]))
    """
    values = {
        "lines": lines, "columns": columns, "altitude": altitude, "ground_sample": ground_sample,
        "ifov": ifov, "speed": speed, "line_spacing": line_spacing, "centre": centre, "start": start,
        "heading": heading, "exposure_time": exposure_time, "frame_period": frame_period, "wobble": wobble,
        "sway": sway, "seed": seed, "start_time": start_time,
    }  # fmt: skip
    problems = Problems("the flight cannot be flown", SchemaError)
    note_pushbroom_faults(values, problems)
    problems.raise_if_any()
    utc = moment_of(start_time)
    angle = _pixel_angle(values)
    if speed is None:
        speed = (angle * altitude if line_spacing is None else line_spacing) / frame_period
    time = np.rint(np.arange(lines) * (frame_period * 1e9)).astype(np.int64)
    ahead = np.array([np.sin(np.radians(heading)), np.cos(np.radians(heading)), 0.0])
    first = (
        np.array([*centre, 0.0]) - ahead * (speed * time[-1] * 0.5e-9)
        if start is None
        else np.array([*start, 0.0])
    )
    moment = time[:, None] * 1e-9 + exposure_time * np.array([-0.5, 0.5])
    spread = np.broadcast_to(np.asarray(wobble, dtype=np.float64), (3,))
    turned = spread[:, None, None] * _oscillations(moment, 3, seed, 0)
    origin = (
        first
        + np.array([0.0, 0.0, altitude])
        + ahead * (speed * moment)[..., None]
        + (sway * _oscillations(moment, 3, seed, 1)).transpose(1, 2, 0)
    )
    rotation = matrices(quaternions(turned[0], turned[1], turned[2] + heading))
    edges = np.asarray((np.arange(columns + 1) - 0.5 * columns) * angle)
    return Platform(origin, rotation, edges, np.array([-0.5, 0.5]) * angle, time, exposure_time, utc)


def _oscillations(moment: Floats, number: int, seed: int, stream: int) -> Floats:
    # Smooth functions of time [s] of unit variance, shape (number, ...).
    rng = np.random.default_rng([seed, _WOBBLE, stream])
    rates = _WOBBLE_RATES * rng.uniform(0.9, 1.1, (number, len(_WOBBLE_RATES)))
    phases = rng.uniform(0.0, 2.0 * np.pi, rates.shape)
    weights = _WOBBLE_RATES**-0.5
    weights *= np.sqrt(2.0 / (weights**2).sum())
    oscillations = np.zeros((number, *moment.shape))
    for oscillation, (rate, phase) in zip(oscillations, zip(rates, phases, strict=True), strict=True):
        for weight, r, p in zip(weights, rate, phase, strict=True):
            oscillation += weight * np.sin(2.0 * np.pi * r * moment + p)
    return oscillations


def note_pushbroom_faults(
    values: dict[str, Any], problems: Problems, spelled: Spelling = as_argument
) -> None:
    before = len(problems)
    present = {name: value for name, value in values.items() if value is not None}
    check_values(PUSHBROOM, present, problems, spelled)
    for one, other in (("ground_sample", "ifov"), ("speed", "line_spacing")):
        if one in present and other in present:
            problems.add(
                f"{spelled(one, values[one])} and {spelled(other, values[other])}",
                expected="one of them",
                mend="keep one",
                code="option-conflict",
            )
    if len(problems) > before:
        return
    exposure, period = (
        present.get(name, PUSHBROOM[name].default) for name in ("exposure_time", "frame_period")
    )
    if exposure > period:
        problems.add(
            f"{spelled('exposure_time', exposure)} exceeds {spelled('frame_period', period)}",
            mend="shorten the exposure, or lengthen the period",
            code="exposure-too-long",
        )
    angle = _pixel_angle(values)
    if angle * values["columns"] / 2 > MAX_VIEW_TANGENT:
        aside = np.degrees(np.arctan(angle * values["columns"] / 2))
        problems.add(
            f"{spelled('columns', values['columns'])}: the outer ones look {aside:.1f} degrees aside",
            expected="at most 85",
            mend="take fewer columns, smaller pixels or a higher flight",
            code="view-too-wide",
        )


def _pixel_angle(values: dict[str, Any]) -> float:
    if values.get("ground_sample") is not None:
        return float(values["ground_sample"] / values.get("altitude", PUSHBROOM["altitude"].default))
    return PIXEL_ANGLE_RAD if values.get("ifov") is None else float(values["ifov"])


def _is_flight_time(value: Any) -> bool:
    # "now" would be another flight at every call
    moment = moment_of("NaT" if isinstance(value, str) and not value[:1].isdigit() else value)
    return bool(np.datetime64("1980-01-01") <= moment < np.datetime64("2100-01-01"))


_PLACE: dict[str, Any] = {
    "kind": "numbers", "unit": "m", "length": 2, "least": -1e6, "most": 1e6,
}  # fmt: skip
_FACTS = (
    Fact(name="lines", kind="whole", least=1, most=MAX_LINES, needed=True, doc="number of lines of the cube"),
    Fact(name="columns", kind="whole", least=1, most=MAX_COLUMNS, needed=True,
         doc="number of columns of the cube"),
    Fact(
        name="altitude", key="altitude_m", kind="number", unit="m", scale=1.0, least=0.1, most=1e5,
        default=15.0, doc="height of the camera above the level z = 0 of the scene",
    ),
    Fact(
        name="ground_sample", key="ground_sample_m", kind="number", unit="m", scale=1.0, least=1e-5, most=1e4,
        doc="size of a pixel across the track, on the level z = 0; an alternative to ifov_mrad",
    ),
    Fact(
        name="ifov", key="ifov_mrad", kind="number", unit="mrad", scale=1e-3, least=1e-7, most=1.0,
        doc="field of view of one pixel; by default that of a 12 mm lens and pixels of 7.4 um",
    ),
    Fact(
        name="speed", key="speed_m_s", kind="number", unit="m s-1", scale=1.0, least=1e-4, most=1e4,
        doc="speed of the platform over ground; an alternative to line_spacing_m",
    ),
    Fact(
        name="line_spacing", key="line_spacing_m", kind="number", unit="m", scale=1.0, least=1e-5, most=1e4,
        doc="distance between lines along the track; by default the size of a pixel across the track",
    ),
    Fact(name="centre", key="centre_m", **_PLACE,
         doc="east and north coordinate of the middle of the flight; an alternative to start_m"),
    Fact(
        name="start", key="start_m", **_PLACE,
        doc="east and north coordinate of the camera at the first line; an alternative to centre_m",
    ),
    Fact(
        name="heading", key="heading_deg", kind="number", unit="degree", scale=1.0, least=-360.0, most=360.0,
        default=0.0, doc="direction of flight, clockwise from north",
    ),
    Fact(
        name="exposure_time", key="exposure_time_ms", kind="number", unit="ms", scale=1e-3, least=0.0,
        most=3600.0, default=5e-3, doc="exposure time of a line",
    ),
    Fact(
        name="frame_period", key="frame_period_ms", kind="number", unit="ms", scale=1e-3, least=1e-6,
        most=3600.0, default=7e-3, doc="time from the start of a line to the start of the next line",
    ),
    Fact(
        name="wobble", key="wobble_deg", kind="numbers", single=True, length=3, unit="degree", least=0.0,
        most=20.0, default=0.0,
        doc="standard deviation of roll, pitch and heading; one number for all, or three",
    ),
    Fact(
        name="sway", key="sway_m", kind="number", unit="m", scale=1.0, least=0.0, most=100.0, default=0.0,
        doc="standard deviation of the deviation from the straight course in east, north and up",
    ),
    Fact(
        name="start_time", kind="own", accepts=_is_flight_time, doc="UTC at mid exposure of the first line",
        phrase="a UTC time such as '2021-07-20T17:10:00'",
    ),
    Fact(
        name="seed", kind="whole", least=0, most=MAX_SEED, default=0,
        doc="seed of the random numbers for wobble and sway",
    ),
)  # fmt: skip

#: Facts of the arguments of `pushbroom`; ``key`` is the spelling in ``[platform]`` of a ``scene.toml``.
PUSHBROOM = {one.name: one for one in _FACTS}


# --- a flight as it was recorded ---------------------------------------------------------------------------


@takes_quantities(
    east="m",
    north="m",
    up="m",
    roll="degree",
    pitch="degree",
    heading="degree",
    ifov="rad",
    exposure_time="s",
    boresight="degree",
    lever_arm="m",
)
def platform_from_poses(
    time: ArrayLike,
    east: ArrayLike,
    north: ArrayLike,
    up: ArrayLike,
    roll: ArrayLike,
    pitch: ArrayLike,
    heading: ArrayLike,
    *,
    columns: int,
    ifov: float = PIXEL_ANGLE_RAD,
    line_time: ArrayLike | None = None,
    exposure_time: float = 5e-3,
    boresight: Sequence[float] = (0.0, 0.0, 0.0),
    lever_arm: Sequence[float] = (0.0, 0.0, 0.0),
) -> Platform:
    """Return the platform of a navigation record.

    Between poses, positions are interpolated linearly and attitudes on the great arc between them (slerp:
    Shoemake, "Animating rotation with quaternion curves", 1985), so that a heading may pass north. Up to half
    an exposure before the first pose and after the last, the outer pair of poses is continued.

    Parameters
    ----------
    time
        Of the poses, increasing, shape (pose,): datetime64 (UTC), or seconds.
    east, north, up
        Of the navigation unit in the scene's frame, shape (pose,) [m].
    roll, pitch, heading
        Shape (pose,) [degree].
    columns
        Of the camera.
    ifov
        Angle of a pixel, pixel pitch / focal length [rad].
    line_time
        Mid exposure of every line, on the clock of ``time``, shape (line,); by default a line a pose.
    exposure_time
        [s]
    boresight
        Roll, pitch and heading of the camera in the frame of the navigation unit [degree].
    lever_arm
        Camera in that frame: forward, right, down [m].

    Raises
    ------
    SchemaError
        Lengths differ, numbers are not finite, times do not increase, lines lie outside of the record, or the
        platform turns more than 90 degrees from one pose to the next; all are listed.

    Examples
    --------
    >>> flight = platform_from_poses([0, 1], [0, 0], [0, 4], [15, 15], [0, 0], [0, 0], [358, 2], columns=2,
    ...                              line_time=[0.75])
    >>> flight.position.round(3), flight.attitude.round(3) + 0.0
    (array([[ 0.,  3., 15.]]), array([[0., 0., 1.]]))
    """
    problems = Problems("the poses cannot be used", SchemaError)
    base, seconds, at = _clock(time, line_time, problems)
    poses = {
        name: finite_floats(values, name, problems)
        for name, values in (
            ("east", east),
            ("north", north),
            ("up", up),
            ("roll", roll),
            ("pitch", pitch),
            ("heading", heading),
            ("boresight", boresight),
            ("lever_arm", lever_arm),
        )
    }
    _check_poses(poses, seconds, problems)
    check_values(PUSHBROOM, {"columns": columns}, problems)
    PUSHBROOM["ifov"].note(problems, as_argument("ifov", ifov), ifov)
    PUSHBROOM["exposure_time"].note(problems, as_argument("exposure_time", exposure_time), exposure_time)
    problems.raise_if_any()
    slack = exposure_time / 2 if line_time is None else 1e-9
    early, late = at.min() - exposure_time / 2, at.max() + exposure_time / 2
    if early < seconds[0] - slack - 1e-9 or late > seconds[-1] + slack + 1e-9:
        problems.add(
            f"lines are exposed from {early:.6f} to {late:.6f} s",
            expected=f"times within the poses, {seconds[0]:.6f} to {seconds[-1]:.6f} s",
            code="lines-outside-poses",
        )
    if len(at) > MAX_LINES:
        problems.add(f"{len(at)} lines", expected=f"at most {MAX_LINES}", code="size-too-large")
    problems.raise_if_any()
    moment = at[:, None] + exposure_time * np.array([-0.5, 0.5])
    before = np.clip(np.searchsorted(seconds, moment, side="right") - 1, 0, len(seconds) - 2)
    part = (moment - seconds[before]) / (seconds[before + 1] - seconds[before])
    turned = quaternions(poses["roll"], poses["pitch"], poses["heading"])
    body = matrices(interpolate(turned[before], turned[before + 1], part))
    place = np.stack([poses[name] for name in ("east", "north", "up")], axis=-1)
    origin = place[before] + part[..., None] * (place[before + 1] - place[before]) + body @ poses["lever_arm"]
    rotation = body @ turns(quaternions(*poses["boresight"]))
    edges = np.asarray((np.arange(columns + 1) - 0.5 * columns) * ifov, dtype=np.float64)
    along = np.asarray([-0.5 * ifov, 0.5 * ifov])
    ticks = np.rint((at - at[0]) * 1e9).astype(np.int64)
    start = START if base is None else base + np.timedelta64(round(at[0] * 1e9), "ns")
    return Platform(origin, rotation, edges, along, ticks, exposure_time, start)


def _clock(
    time: ArrayLike, line_time: ArrayLike | None, problems: Problems
) -> tuple[np.datetime64 | None, Floats, Floats]:
    # The zero moment (None for seconds), and both times as seconds.
    poses = np.asarray(time)
    lines = poses if line_time is None else np.asarray(line_time)
    if poses.ndim != 1 or lines.ndim != 1 or len(poses) < 2 or not len(lines):
        problems.add(
            f"{poses.size} pose times and {lines.size} line times",
            expected="at least two poses and one line",
            code="pose-missing",
        )
        problems.raise_if_any()
    if (poses.dtype.kind == "M") != (lines.dtype.kind == "M"):
        problems.add(
            f"time is {poses.dtype}, line_time {lines.dtype}",
            expected="both datetime64 or both seconds",
            code="type-wrong",
        )
        problems.raise_if_any()
    base = None
    if poses.dtype.kind == "M":
        if np.isnat(poses).any() or np.isnat(lines).any():
            problems.add("time or line_time contains NaT", expected="a time for each", code="time-missing")
            problems.raise_if_any()
        base = poses[0].astype("datetime64[ns]")
        poses, lines = (
            (times.astype("datetime64[ns]") - base) / np.timedelta64(1, "s") for times in (poses, lines)
        )
    return base, finite_floats(poses, "time", problems), finite_floats(lines, "line_time", problems)


def _check_poses(poses: dict[str, Floats], seconds: Floats, problems: Problems) -> None:
    if not (np.diff(seconds) > 0).all():
        problems.add("time does not increase from pose to pose", code="time-unordered")
    elif seconds[-1] - seconds[0] > 1e8:
        problems.add("time spans more than three years", expected="seconds", code="value-out-of-range")
    for name, values in poses.items():
        expected = (3,) if name in ("boresight", "lever_arm") else seconds.shape
        if values.shape != expected:
            problems.add(f"{name} has shape {values.shape}", expected=f"{expected}", code="dims-wrong")
        elif values.size and not np.abs(values).max() <= 1e6:
            problems.add(
                f"{name} has values beyond 1e6",
                expected="a local frame in metres, angles in degrees",
                code="value-out-of-range",
            )
    problems.raise_if_any()
    turned = quaternions(poses["roll"], poses["pitch"], poses["heading"])
    apart = np.abs((turned[1:] * turned[:-1]).sum(axis=-1))
    if (apart < np.cos(np.radians(45.0))).any():
        where = int(np.argmin(apart))
        problems.add(
            f"the platform turns by over 90 degrees between poses {where} and {where + 1}",
            code="turn-too-large",
        )
