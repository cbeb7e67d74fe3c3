"""Platforms: the path, attitude, mounting and pixels of a camera that flies over a scene.

`Trajectory` is the flight of a drone over the earth, in the instruments' files of a simulated collect: a
straight course with deviations by wind and propellers. `pushbroom` is a straight flight over a scene, and
`platform_from_poses` a flight as it was recorded. All give the camera's position and rotation at the begin
and end of every exposure (`Platform`), for ray tracing.

The scene has x east, y north, z up [m]. The camera has x forward, y right, z down; the line of sight of a
column is (tangent forward, tangent to the right, 1). Angles are those of ISO 1151-2: heading H clockwise
from true north, pitch P with the nose up, roll R with the right wing down. A direction of the camera is in
north, east, down

    d_ned = Rz(H) Ry(P) Rx(R) d_camera,

and x, y, z = east, north, -down. Heights are above the ellipsoid WGS-84, which closed formulas describe; the
map is a UTM zone. Simulation and geolocation must be independent: this module uses neither a geodesy library
nor `hyperpaint.geometry`. A deviation is a sum of sines with random frequencies, so that it is defined at
all times and not only at samples.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np

from hyperpaint.base import (
    ArrayLike,
    Fact,
    Floats,
    Ints,
    Problem,
    Problems,
    SchemaError,
    Spelling,
    Times,
    as_argument,
    check_values,
    takes_quantities,
)
from hyperpaint.simulation.settings import (
    DEFAULT_START,
    MAX_SEED,
    PIXEL_ANGLE_RAD,
    SimulationSettings,
    finite_floats,
    moment_of,
)

#: Maximum size of a flight; poses are held in memory, 200 bytes per line.
MAX_LINES, MAX_COLUMNS = 1_000_000, 20_000

#: Maximum tangent of a view angle.
MAX_VIEW_TANGENT = float(np.tan(np.radians(85.0)))

#: Matrix between north, east, down and east, north, up, in both directions.
_SCENE = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


def turns(roll: ArrayLike, pitch: ArrayLike, heading: ArrayLike) -> Floats:
    # rz(heading) Ry(pitch) Rx(roll), shape (..., 3, 3); angles [degree]
    # by quaternions
    halves = [np.radians(np.asarray(angle, dtype=np.float64)) / 2 for angle in (roll, pitch, heading)]
    (cr, cp, ch), (sr, sp, sh) = ([f(half) for half in halves] for f in (np.cos, np.sin))
    w, x = cr * cp * ch + sr * sp * sh, sr * cp * ch - cr * sp * sh
    y, z = cr * sp * ch + sr * cp * sh, cr * cp * sh - sr * sp * ch
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def matrices(roll: ArrayLike, pitch: ArrayLike, heading: ArrayLike) -> Floats:
    """Return rotations from camera directions to those of the scene, shape (..., 3, 3); angles [degree].

    Examples
    --------
    Heading east, right is south and down stays down:

    >>> matrices([0.0], [0.0], [90.0])[0].round(9) + 0.0
    array([[ 1.,  0.,  0.],
           [ 0., -1.,  0.],
           [ 0.,  0., -1.]])
    """
    return np.asarray(_SCENE @ turns(roll, pitch, heading))


def pixel_edges(columns: int, ifov: float) -> tuple[Floats, Floats]:
    # tangents of the edges of columns, and of the rear and front edge of a line; ``ifov``: angle of a pixel
    edges = np.asarray((np.arange(columns + 1) - 0.5 * columns) * ifov, dtype=np.float64)
    return edges, np.array([-0.5, 0.5]) * ifov


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
    time: Ints
    exposure_time: float = 0.0
    start: np.datetime64 = DEFAULT_START

    def __post_init__(self) -> None:
        problems = Problems("the platform cannot be used", SchemaError)
        for name in ("origin", "rotation", "column_edges", "along_edges"):
            object.__setattr__(self, name, finite_floats(getattr(self, name), name, problems))
        problems.raise_if_any()
        lines = len(self.origin) if self.origin.ndim else 0
        shapes = {
            "origin": (lines, 2, 3),
            "rotation": (lines, 2, 3, 3),
            "along_edges": (2,),
            "time": (lines,),
        }
        edges, kind = self.column_edges.shape, np.asarray(self.time).dtype
        problems.raise_if_any(
            (
                not 1 <= lines <= MAX_LINES,
                Problem(f"{lines} lines", f"1 to {MAX_LINES}", code="value-out-of-range"),
            ),
            *(
                (
                    np.shape(getattr(self, name)) != shape,
                    Problem(
                        f"{name} has shape {np.shape(getattr(self, name))}", f"{shape}", code="dims-wrong"
                    ),
                )
                for name, shape in shapes.items()
            ),
            (
                len(edges) != 1 or not 2 <= edges[0] <= MAX_COLUMNS + 1,
                Problem(
                    f"column_edges has shape {edges}",
                    f"(columns + 1,) with 1 to {MAX_COLUMNS} columns",
                    code="dims-wrong",
                ),
            ),
            (
                kind != np.int64,
                Problem(f"time is {kind}", "int64 nanoseconds after the first line", code="type-wrong"),
            ),
        )
        products = self.rotation @ self.rotation.swapaxes(-1, -2)
        problems.raise_if_any(
            (
                not np.allclose(products, np.eye(3), atol=1e-6) or (np.linalg.det(self.rotation) < 0).any(),
                Problem("rotation contains matrices that are not rotations", code="rotation-invalid"),
            ),
            *(
                (
                    not (np.diff(tangents) > 0).all() or np.abs(tangents).max() > MAX_VIEW_TANGENT,
                    Problem(
                        f"{name} do not increase, or exceed 85 degrees",
                        "tangents of view angles",
                        code="edges-invalid",
                    ),
                )
                for name, tangents in (("column_edges", self.column_edges), ("along_edges", self.along_edges))
            ),
            (
                not 0 <= self.exposure_time < 3600,
                Problem(
                    f"exposure_time={self.exposure_time!r}",
                    "a number of seconds from 0 to below 3600",
                    code="value-out-of-range",
                ),
            ),
        )

    @property
    def lines(self) -> int:
        return len(self.origin)

    @property
    def columns(self) -> int:
        return len(self.column_edges) - 1

    @property
    def position(self) -> Floats:
        # East, north and up of the camera at mid exposure, shape (line, 3) [m].
        return np.asarray(self.origin.mean(axis=1))

    @property
    def attitude(self) -> Floats:
        # Roll, pitch and heading at mid exposure, shape (line, 3) [degree]; heading from 0 to 360.
        # the mean of both rotations is the rotation nearest to their sum (Moakher 2002)
        u, _, v_transposed = np.linalg.svd(_SCENE @ self.rotation.sum(axis=1))
        mean = u @ v_transposed
        roll = np.arctan2(mean[:, 2, 1], mean[:, 2, 2])
        pitch = -np.arcsin(np.clip(mean[:, 2, 0], -1.0, 1.0))
        angles = np.degrees(np.stack([roll, pitch, np.arctan2(mean[:, 1, 0], mean[:, 0, 0])], axis=-1))
        angles[:, 2] %= 360.0
        return np.asarray(angles)

    @property
    def utc(self) -> Times:
        # UTC at mid exposure, shape (line,), datetime64[ns].
        return np.asarray(self.start + self.time.astype("timedelta64[ns]"))


_A, _F = 6_378_137.0, 1 / 298.257223563
_B = _A * (1 - _F)
_E2 = _F * (2 - _F)
_N = _F / (2 - _F)


def geocentric(latitude: ArrayLike, longitude: ArrayLike, height: ArrayLike) -> Floats:
    # earth-centred coordinates (..., 3) [m] of latitude and longitude [degree] and height [m]
    lat, lon = np.radians(latitude), np.radians(longitude)
    h = np.asarray(height, np.float64)
    normal = _A / np.sqrt(1 - _E2 * np.sin(lat) ** 2)
    axis_distance = (normal + h) * np.cos(lat)
    return np.stack(
        [axis_distance * np.cos(lon), axis_distance * np.sin(lon), ((1 - _E2) * normal + h) * np.sin(lat)], -1
    )


def geodetic(xyz: Floats) -> tuple[Floats, Floats, Floats]:
    """Return latitude, longitude [degree] and height [m] of earth-centred coordinates (..., 3).

    Notes
    -----
    Bowring (1976), "Transformation from spatial to geographical coordinates": one step has an
    error below a micrometre up to some tens of kilometres of height.

    Examples
    --------
    >>> [float(value.round(6)) for value in geodetic(geocentric(43.0, -77.5, 160.0))]
    [43.0, -77.5, 160.0]
    """
    x, y, z = np.moveaxis(xyz, -1, 0)
    axis_distance = np.hypot(x, y)
    reduced = np.arctan2(z * _A, axis_distance * _B)
    second_eccentricity = _E2 / (1 - _E2)
    lat = np.arctan2(
        z + second_eccentricity * _B * np.sin(reduced) ** 3, axis_distance - _E2 * _A * np.cos(reduced) ** 3
    )
    sine = np.sin(lat)
    height = axis_distance * np.cos(lat) + z * sine - _A * np.sqrt(1 - _E2 * sine**2)
    return np.degrees(lat), np.degrees(np.arctan2(y, x)), height


def north_east_down(latitude: ArrayLike, longitude: ArrayLike) -> Floats:
    # rotations from north, east, down at a position [degree] to the earth-centred frame (..., 3, 3)
    lat, lon = np.broadcast_arrays(np.radians(latitude), np.radians(longitude))
    (cl, co), (sl, so) = ([f(angle) for angle in (lat, lon)] for f in (np.cos, np.sin))
    rows = [[-sl * co, -so, -cl * co], [-sl * so, co, -cl * so], [cl, np.zeros_like(cl), -sl]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


@dataclass(frozen=True)
class LocalFrame:
    """A local tangent frame at a position: x east, y north, z up [m].

    Attributes
    ----------
    latitude, longitude
        Position of the origin [degree].
    height
        Height of the origin above the ellipsoid [m].

    Examples
    --------
    At a distance of a kilometre, the tangent plane is eight centimetres above the ellipsoid:

    >>> frame = LocalFrame(43.0, -77.5, 160.0)
    >>> latitude, longitude, height = frame.geodetic(np.array([0.0, 1000.0, 0.0]))
    >>> round(float(height - 160.0), 3)
    0.079
    """

    latitude: float
    longitude: float
    height: float

    @cached_property
    def _origin(self) -> Floats:
        return geocentric(self.latitude, self.longitude, self.height)

    @cached_property
    def axes(self) -> Floats:
        # rotation from this frame to the earth-centred frame, (3, 3)
        north, east, down = north_east_down(self.latitude, self.longitude).T
        return np.stack([east, north, -down], axis=-1)

    def local(self, latitude: ArrayLike, longitude: ArrayLike, height: ArrayLike) -> Floats:
        # x, y, z (..., 3) of positions
        return np.asarray((geocentric(latitude, longitude, height) - self._origin) @ self.axes)

    def geodetic(self, xyz: Floats) -> tuple[Floats, Floats, Floats]:
        # latitude, longitude [degree] and height [m] of x, y, z (..., 3)
        return geodetic(self._origin + xyz @ self.axes.T)


@dataclass(frozen=True)
class TransverseMercator:
    """The map projection of a UTM zone in the northern hemisphere.

    Attributes
    ----------
    zone
        Number of the zone, 1 to 60.

    Notes
    -----
    The series of Krüger (1912) in the third flattening, to its sixth power as Karney (2011, "Transverse
    Mercator with an accuracy of a few nanometers", eq. 35) gives it.

    Examples
    --------
    >>> plane = TransverseMercator.of(43.0845, -77.6749)
    >>> plane.crs, plane.project(43.0, -75.0)[0].round(6)
    ('EPSG:32618', np.float64(500000.0))
    """

    zone: int

    @classmethod
    def of(cls, latitude: float, longitude: float) -> Self:
        # projection of the zone of a position [degree] in the northern hemisphere
        if not 0.0 <= latitude < 84.0:
            raise ValueError(latitude)
        return cls(int((longitude + 180.0) // 6.0) % 60 + 1)

    @property
    def crs(self) -> str:
        # EPSG code
        return f"EPSG:{32600 + self.zone}"

    def project(self, latitude: ArrayLike, longitude: ArrayLike) -> tuple[Floats, Floats]:
        # east and north [m] of latitude and longitude [degree]
        lat = np.radians(np.asarray(latitude, np.float64))
        lon = np.radians(np.asarray(longitude, np.float64) - (6.0 * self.zone - 183.0))
        tau = np.tan(lat)
        sigma = np.sinh(np.sqrt(_E2) * np.arctanh(np.sqrt(_E2) * np.sin(lat)))
        conformal = tau * np.sqrt(1 + sigma**2) - sigma * np.sqrt(1 + tau**2)
        xi = np.arctan2(conformal, np.cos(lon))
        eta = np.arcsinh(np.sin(lon) / np.hypot(conformal, np.cos(lon)))
        north, east = xi.copy(), eta.copy()
        for order, weight in enumerate(_ALPHA, 1):
            north += weight * np.sin(2 * order * xi) * np.cosh(2 * order * eta)
            east += weight * np.cos(2 * order * xi) * np.sinh(2 * order * eta)
        return 500_000.0 + _SCALE * east, _SCALE * north


_ALPHA = tuple(
    sum(part * _N**power for power, part in enumerate(parts, order))
    for order, parts in enumerate(
        (
            (1 / 2, -2 / 3, 5 / 16, 41 / 180, -127 / 288, 7891 / 37800),
            (13 / 48, -3 / 5, 557 / 1440, 281 / 630, -1983433 / 1935360),
            (61 / 240, -103 / 140, 15061 / 26880, 167603 / 181440),
            (49561 / 161280, -179 / 168, 6601661 / 7257600),
            (34729 / 80640, -3418889 / 1995840),
            (212378941 / 319334400,),
        ),
        1,
    )
)
_SCALE = 0.9996 * _A / (1 + _N) * (1 + _N**2 / 4 + _N**4 / 64 + _N**6 / 256)


#: Conventions of angles, heights and columns of a simulated flight.
CONVENTION = {
    "roll_positive": "right_wing_down",
    "pitch_positive": "nose_up",
    "heading_positive": "clockwise",
    "heading_reference": "true",
    "euler_order": "ZYX",
    "height_reference": "ellipsoid",
    "column_order": "left_to_right",
}


# A sum of sines around a mean
class Motion(NamedTuple):
    # amplitude, frequency, phase: parameters of the sines, shape (sine,); frequency [Hz], phase [rad]
    amplitude: Floats
    frequency: Floats
    phase: Floats
    mean: float = 0.0  # mean of the motion

    def at(self, seconds: Floats) -> Floats:
        # motion at times [s]
        motion = np.full(np.shape(seconds), self.mean)
        for a, f, p in np.stack([self.amplitude, self.frequency, self.phase], axis=1).tolist():
            motion += a * np.sin(2 * np.pi * f * seconds + p)
        return motion

    @property
    def peak(self) -> float:
        # maximum possible magnitude
        return abs(self.mean) + float(np.abs(self.amplitude).sum())


_STILL = Motion(np.zeros(0), np.zeros(0), np.zeros(0))
_STREAM, _SINES = 20, 12  # key of the random stream, and number of sines

#: Amplitude, period [s], phase [rad] and mean of slow motions, angles [degree] or distances [m].
_SLOW = {
    "roll": (0.4, 3.1, 0.3, 0.0), "pitch": (0.3, 4.7, 1.1, 0.0), "heading": (0.2, 7.9, 0.0, 0.5),
    "altitude": (0.1, 11.0, 0.0, 0.0),
}  # fmt: skip

#: Standard deviations of motions of drones, angles [degree] or distances [m], and of their rates [s-1].
_STANDARD_DEVIATIONS: Mapping[str, Mapping[str, tuple[float, float]]] = {
    "calm": {
        "roll": (0.15, 0.69), "pitch": (0.15, 0.87), "heading": (1.1, 3.7),
        "right": (0.02, 0.03), "altitude": (0.02, 0.03),
    },
    "rough": {
        "roll": (0.42, 1.9), "pitch": (0.42, 2.5), "heading": (3.1, 10.6),
        "right": (0.05, 0.08), "altitude": (0.05, 0.08),
    },
}  # fmt: skip


def _random_motion(sd: float, rate_sd: float, rng: np.random.Generator) -> Motion:
    # random sines with these standard deviations of the motion and of its rate of change [s-1]
    relative_frequency = np.geomspace(0.2, 2.0, _SINES) * rng.uniform(0.94, 1.06, _SINES)
    amplitude = relative_frequency**-0.5
    amplitude *= sd * np.sqrt(2 / (amplitude**2).sum())
    rate = np.sqrt(((amplitude * relative_frequency) ** 2).sum() / 2)
    frequency = relative_frequency * rate_sd / rate / (2 * np.pi)
    return Motion(amplitude, frequency, rng.uniform(0, 2 * np.pi, _SINES))


# Pose of the navigation system, and of the camera fixed to it, at any time
@dataclass(frozen=True)
class Trajectory:
    # frame of the scene: x east, y north, z up, from the point on the ground below the camera at time zero
    # [m]
    frame: LocalFrame
    course: float  # direction of flight, clockwise from north [degree]
    speed: float  # ground speed [m s-1]
    altitude: float  # height of the navigation's reference point above the ground [m]
    # roll, pitch and heading of the camera in the body [degree]
    boresight: tuple[float, float, float] = (0.0, 0.0, 0.0)
    # position of the camera from the navigation's reference point: forward, right, down [m]
    lever_arm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    # motions of ``roll``, ``pitch``, ``heading`` [degree], ``altitude``, and to the ``right`` of the course
    # [m]
    motions: Mapping[str, Motion] = field(default_factory=dict)

    @classmethod
    def of(cls, settings: SimulationSettings, frame: LocalFrame, speed: float, altitude: float) -> Self:
        if settings.wobble == "slow":
            motions = {
                name: Motion(np.array([amplitude]), np.array([1 / period]), np.array([phase]), mean)
                for name, (amplitude, period, phase, mean) in _SLOW.items()
            }
        else:
            rng = np.random.default_rng([settings.seed, _STREAM])
            deviations = _STANDARD_DEVIATIONS.get(settings.wobble, {})
            motions = {name: _random_motion(*pair, rng) for name, pair in deviations.items()}
        (roll, pitch, heading), (forward, right, down) = (
            map(float, three) for three in (settings.boresight, settings.lever_arm)
        )
        mounting = (roll, pitch, heading), (forward, right, down)
        return cls(frame, float(settings.course), speed, altitude, *mounting, motions)

    def pose(self, seconds: Floats) -> dict[str, Floats]:
        # position and attitude of the navigation system [degree, m]; heading from 0 to 360
        seconds = np.asarray(seconds, np.float64)
        sine, cosine = np.sin(np.radians(self.course)), np.cos(np.radians(self.course))
        ahead, right = self.speed * seconds, self._motion("right").at(seconds)
        level = np.stack(
            [ahead * sine + right * cosine, ahead * cosine - right * sine, np.zeros_like(ahead)], axis=-1
        )
        latitude, longitude, _ = self.frame.geodetic(level)
        return {
            "roll": self._motion("roll").at(seconds),
            "pitch": self._motion("pitch").at(seconds),
            "heading": (self.course + self._motion("heading").at(seconds)) % 360.0,
            "latitude": latitude,
            "longitude": longitude,
            "altitude": self.frame.height + self.altitude + self._motion("altitude").at(seconds),
        }

    def camera(self, seconds: Floats) -> tuple[Floats, Floats]:
        # position of the camera (..., 3) [m], and its rotation to the scene's axes (..., 3, 3)
        # With M the rotation from north, east, down at the platform to the scene, R the attitude of the body,
        # B that of the camera in the body, and l the lever arm: p = p_nav + M R l, and the rotation is M R B
        pose = self.pose(seconds)
        position = self.frame.local(pose["latitude"], pose["longitude"], pose["altitude"])
        down = np.asarray(self.frame.axes.T @ north_east_down(pose["latitude"], pose["longitude"]))
        body = down @ turns(pose["roll"], pose["pitch"], pose["heading"])
        return position + body @ np.array(self.lever_arm), body @ turns(*self.boresight)

    @property
    def steepest(self) -> float:
        # maximum angle between camera axis and vertical, along or across the track [degree]
        return max(self._motion("roll").peak, self._motion("pitch").peak) + max(map(abs, self.boresight[:2]))

    @property
    def max_yaw(self) -> float:
        # maximum angle between camera and course [degree]
        return self._motion("heading").peak + abs(self.boresight[2])

    def _motion(self, name: str) -> Motion:
        return self.motions.get(name, _STILL)


_WOBBLE = 16  # key of the random stream
_WOBBLE_RATES = np.geomspace(0.15, 6.0, 9)  # Hz


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
    start_time: np.datetime64 | str = DEFAULT_START,
) -> Platform:
    """Return a straight, level flight of a camera that looks down.

    Parameters
    ----------
    lines, columns
        Size of the cube.
    altitude
        Height above z = 0 [m].
    ground_sample
        Across-track size of a pixel on z = 0 [m], an alternative to ``ifov``; by default that of a 12 mm
        lens and pixels of 7.4 um.
    ifov
        Angle of a pixel, pixel pitch / focal length [rad]; columns have equal steps of the tangent.
    speed
        Ground speed [m s-1], an alternative to ``line_spacing`` [m]; by default lines are as long as pixels
        are wide.
    centre
        East and north of the middle of the flight [m].
    start
        East and north of the camera at the first line [m], an alternative to ``centre``.
    heading
        Direction of flight, clockwise from north [degree].
    exposure_time, frame_period
        Exposure, and time from line to line [s].
    wobble
        Standard deviation of roll, pitch and heading [degree], or one for all three: sums of nine
        oscillations from 0.15 to 6 Hz whose amplitudes fall with the root of the frequency.
    sway
        Standard deviation of east, north and up [m], with the same oscillations.
    seed
        Seed of wobble and sway.
    start_time
        UTC at mid exposure of the first line.

    Raises
    ------
    SchemaError
        A value is out of its range, or alternatives are combined; all are listed.

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
    with Problems("the flight cannot be flown", SchemaError) as problems:
        note_pushbroom_faults(values, problems)
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
    turned = np.broadcast_to(np.asarray(wobble, dtype=np.float64), (3,))[:, None, None] * _oscillations(
        moment, seed, 0
    )
    origin = (
        first
        + np.array([0.0, 0.0, altitude])
        + ahead * (speed * moment)[..., None]
        + (sway * _oscillations(moment, seed, 1)).transpose(1, 2, 0)
    )
    rotation = matrices(turned[0], turned[1], turned[2] + heading)
    return Platform(
        origin, rotation, *pixel_edges(columns, angle), time, exposure_time, moment_of(start_time)
    )


def _oscillations(moment: Floats, seed: int, stream: int) -> Floats:
    # three smooth functions of time [s] of unit variance, shape (3, ...)
    rng = np.random.default_rng([seed, _WOBBLE, stream])
    rates = _WOBBLE_RATES * rng.uniform(0.9, 1.1, (3, len(_WOBBLE_RATES)))
    phases = rng.uniform(0.0, 2.0 * np.pi, rates.shape)
    weights = _WOBBLE_RATES**-0.5
    weights *= np.sqrt(2.0 / (weights**2).sum())
    return np.stack([Motion(weights, *pair).at(moment) for pair in zip(rates, phases, strict=True)])


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
    problems.add_if(
        exposure > period,
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
        Times of the poses, increasing, shape (pose,): datetime64 (UTC), or seconds.
    east, north, up
        Position of the navigation unit in the scene's frame, shape (pose,) [m].
    roll, pitch, heading
        Its attitude, shape (pose,) [degree].
    columns
        Number of columns of the camera.
    ifov
        Angle of a pixel, pixel pitch / focal length [rad].
    line_time
        Mid exposure of every line, on the clock of ``time``, shape (line,); by default one line per pose.
    exposure_time
        Exposure of a line [s].
    boresight
        Roll, pitch and heading of the camera in the frame of the navigation unit [degree].
    lever_arm
        Position of the camera in that frame: forward, right, down [m].

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
    from scipy.spatial.transform import Rotation  # slow to import

    base, seconds, at = _clock(time, line_time, problems)
    arrays = {"east": east, "north": north, "up": up, "roll": roll, "pitch": pitch, "heading": heading}
    mounting = {"boresight": boresight, "lever_arm": lever_arm}
    poses = {name: finite_floats(values, name, problems) for name, values in {**arrays, **mounting}.items()}
    increases = (np.diff(seconds) > 0).all()
    shapes = {name: (3,) if name in mounting else seconds.shape for name in poses}
    problems.raise_if_any(
        (not increases, Problem("time does not increase from pose to pose", code="time-unordered")),
        (
            increases and seconds[-1] - seconds[0] > 1e8,
            Problem("time spans more than three years", "seconds", code="value-out-of-range"),
        ),
        *(
            (
                values.shape != shapes[name],
                Problem(f"{name} has shape {values.shape}", f"{shapes[name]}", code="dims-wrong"),
            )
            for name, values in poses.items()
        ),
        *(
            (
                values.shape == shapes[name] and not np.abs(values).max(initial=0.0) <= 1e6,
                Problem(
                    f"{name} has values beyond 1e6",
                    "a local frame in metres, angles in degrees",
                    code="value-out-of-range",
                ),
            )
            for name, values in poses.items()
        ),
    )
    angles = np.stack([poses[name] for name in ("heading", "pitch", "roll")], axis=-1)
    turned = Rotation.from_euler("ZYX", angles, degrees=True)
    steps = turned[:-1].inv() * turned[1:]
    where = int(np.argmax(steps.magnitude()))
    problems.add_if(
        steps.magnitude()[where] > np.pi / 2,
        f"the platform turns by over 90 degrees between poses {where} and {where + 1}",
        code="turn-too-large",
    )
    check_values(PUSHBROOM, {"columns": columns}, problems)
    PUSHBROOM["ifov"].note(problems, as_argument("ifov", ifov), ifov)
    PUSHBROOM["exposure_time"].note(problems, as_argument("exposure_time", exposure_time), exposure_time)
    problems.raise_if_any()
    slack = exposure_time / 2 if line_time is None else 1e-9
    early, late = at.min() - exposure_time / 2, at.max() + exposure_time / 2
    problems.raise_if_any(
        (
            early < seconds[0] - slack - 1e-9 or late > seconds[-1] + slack + 1e-9,
            Problem(
                f"lines are exposed from {early:.6f} to {late:.6f} s",
                f"times within the poses, {seconds[0]:.6f} to {seconds[-1]:.6f} s",
                code="lines-outside-poses",
            ),
        ),
        (len(at) > MAX_LINES, Problem(f"{len(at)} lines", f"at most {MAX_LINES}", code="size-too-large")),
    )
    moment = at[:, None] + exposure_time * np.array([-0.5, 0.5])
    before = np.clip(np.searchsorted(seconds, moment, side="right") - 1, 0, len(seconds) - 2)
    part = ((moment - seconds[before]) / (seconds[before + 1] - seconds[before]))[..., None]
    # attitudes on the great arc from one pose to the next
    arc = Rotation.from_rotvec((part * steps.as_rotvec()[before]).reshape(-1, 3))
    body = _SCENE @ (turned[before.ravel()] * arc).as_matrix().reshape(*before.shape, 3, 3)
    place = np.stack([poses[name] for name in ("east", "north", "up")], axis=-1)
    origin = place[before] + part * (place[before + 1] - place[before]) + body @ poses["lever_arm"]
    rotation = body @ Rotation.from_euler("ZYX", poses["boresight"][::-1], degrees=True).as_matrix()
    ticks = np.rint((at - at[0]) * 1e9).astype(np.int64)
    start = DEFAULT_START if base is None else base + np.timedelta64(round(at[0] * 1e9), "ns")
    return Platform(origin, rotation, *pixel_edges(columns, ifov), ticks, exposure_time, start)


def _clock(
    time: ArrayLike, line_time: ArrayLike | None, problems: Problems
) -> tuple[np.datetime64 | None, Floats, Floats]:
    # The zero moment (None for seconds), and both times as seconds.
    poses = np.asarray(time)
    lines = poses if line_time is None else np.asarray(line_time)
    is_date = poses.dtype.kind == "M"
    for check in (
        (
            poses.ndim != 1 or lines.ndim != 1 or len(poses) < 2 or not len(lines),
            Problem(
                f"{poses.size} pose times and {lines.size} line times",
                "at least two poses and one line",
                code="pose-missing",
            ),
        ),
        (
            is_date != (lines.dtype.kind == "M"),
            Problem(
                f"time is {poses.dtype}, line_time {lines.dtype}",
                "both datetime64 or both seconds",
                code="type-wrong",
            ),
        ),
        (
            any(times.dtype.kind == "M" and np.isnat(times).any() for times in (poses, lines)),
            Problem("time or line_time contains NaT", "a time for each", code="time-missing"),
        ),
    ):
        problems.raise_if_any(check)
    base = None
    if is_date:
        base = poses[0].astype("datetime64[ns]")
        poses, lines = (
            (times.astype("datetime64[ns]") - base) / np.timedelta64(1, "s") for times in (poses, lines)
        )
    seconds, at = finite_floats(poses, "time", problems), finite_floats(lines, "line_time", problems)
    if not seconds.size:
        problems.raise_if_any()  # without times nothing else can be checked
    return base, seconds, at
