"""Platforms: where rays start and look, how drones move, and the ellipsoid, against scipy and PROJ."""

import math
from typing import Any

import numpy as np
import pyproj
import pytest
from hypothesis import given, strategies as st
from scipy.spatial.transform import Rotation, Slerp
from support.refusals import expect_words, refusal

from hyperpaint.base.errors import SchemaError
from hyperpaint.simulation import SimulationSettings
from hyperpaint.simulation.rendering.platforms import (
    LocalFrame,
    Platform,
    Trajectory,
    TransverseMercator,
    geocentric,
    geodetic,
    platform_from_poses,
    pushbroom,
)
from hyperpaint.simulation.settings import ORIGIN

NED_TO_ENU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
ANGLE = st.floats(-80.0, 80.0)


def ground_of(platform: Platform, along: float, across: float, moment: int = 0) -> np.ndarray:
    # Return where the ray (along, across, 1) of every line meets z = 0
    direction = platform.rotation[:, moment] @ np.array([along, across, 1.0])
    origin = platform.origin[:, moment]
    return origin - direction * (origin[:, 2:] / direction[:, 2:])


def test_a_level_flight_north_looks_down_with_columns_to_the_east() -> None:
    flight = pushbroom(5, 4, altitude=10.0, ground_sample=0.1, exposure_time=0.0)
    assert flight.origin.dtype == flight.rotation.dtype == np.float64
    assert flight.time.dtype == np.int64
    assert flight.time.tolist() == [0, 7_000_000, 14_000_000, 21_000_000, 28_000_000]
    np.testing.assert_allclose(flight.position[:, 1], [-0.2, -0.1, 0.0, 0.1, 0.2], atol=1e-12)
    left, right = (ground_of(flight, 0.0, edge) for edge in flight.column_edges[[0, -1]])
    np.testing.assert_allclose(left[:, 0], -0.2, atol=1e-12)
    np.testing.assert_allclose(right[:, 0], 0.2, atol=1e-12)
    near, far = (ground_of(flight, edge, 0.0) for edge in flight.along_edges)
    np.testing.assert_allclose((far - near)[:, 1], 0.1, atol=1e-12)


@pytest.mark.parametrize(
    ("heading", "ahead", "right"), [(0, (0, 1), (1, 0)), (90, (1, 0), (0, -1)), (225, (-1, -1), (-1, 1))]
)
def test_headings_turn_clockwise(heading: float, ahead: tuple[int, int], right: tuple[int, int]) -> None:
    flight = pushbroom(3, 2, altitude=10.0, heading=heading, start=(3.0, 4.0), line_spacing=1.0)
    unit = np.array(ahead) / np.hypot(*ahead)
    np.testing.assert_allclose(flight.position[0, :2], [3.0, 4.0], atol=1e-12)
    np.testing.assert_allclose(np.diff(flight.position[:, :2], axis=0), [unit, unit], atol=1e-12)
    aside = ground_of(flight, 0.0, 0.1)[1, :2] - flight.position[1, :2]
    exposed = flight.position[1, :2] - flight.origin[1, 0, :2]
    np.testing.assert_allclose(aside + exposed, np.array(right) / np.hypot(*right), atol=1e-9)


@given(ANGLE, ANGLE, st.floats(0.0, 359.9))
def test_rotations_are_those_of_scipy_and_angles_come_back(roll: float, pitch: float, heading: float) -> None:
    flight = platform_from_poses(
        [0, 1], [0, 0], [0, 0], [9, 9], [roll] * 2, [pitch] * 2, [heading] * 2, columns=1
    )
    expected = NED_TO_ENU @ Rotation.from_euler("ZYX", [heading, pitch, roll], degrees=True).as_matrix()
    np.testing.assert_allclose(flight.rotation[0, 1], expected, atol=1e-12)
    found = flight.attitude[0]
    np.testing.assert_allclose(found[:2], [roll, pitch], atol=1e-6)
    assert abs((found[2] - heading + 180.0) % 360.0 - 180.0) < 1e-6


def test_poses_between_samples_are_on_the_great_arc() -> None:
    time = np.array([0.0, 0.4, 1.0])
    angles = np.array([[3.0, -2.0, 350.0], [-8.0, 4.0, 10.0], [1.0, 1.0, 40.0]])
    at = np.array([0.1, 0.35, 0.77])
    flight = platform_from_poses(
        time, [0, 1, 2], [0, 3, 5], [20, 21, 20], *angles.T, columns=3, line_time=at, exposure_time=0.02
    )
    slerp = Slerp(time, Rotation.from_euler("ZYX", angles[:, ::-1], degrees=True))
    for moment, shift in enumerate((-0.01, 0.01)):
        np.testing.assert_allclose(
            flight.rotation[:, moment], NED_TO_ENU @ slerp(at + shift).as_matrix(), atol=1e-9
        )
        np.testing.assert_allclose(flight.origin[:, moment, 0], np.interp(at + shift, time, [0, 1, 2]))
    assert flight.time.tolist() == [0, 250_000_000, 670_000_000]


def test_boresight_and_lever_arm_are_in_the_frame_of_the_unit() -> None:
    poses = ([0, 1], [0, 0], [0, 0], [10, 10], [2, 2], [3, 3], [90, 90])
    flight = platform_from_poses(*poses, columns=2, boresight=(1.0, -2.0, 5.0), lever_arm=(0.5, 0.2, 0.1))
    unit = Rotation.from_euler("ZYX", [90, 3, 2], degrees=True)
    camera = unit * Rotation.from_euler("ZYX", [5, -2, 1], degrees=True)
    np.testing.assert_allclose(flight.rotation[0, 0], NED_TO_ENU @ camera.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(flight.origin[0, 0], NED_TO_ENU @ unit.apply([0.5, 0.2, 0.1]) + [0, 0, 10])


def test_the_exposure_smears_by_speed_times_time() -> None:
    flight = pushbroom(4, 2, altitude=15.0, speed=4.0, exposure_time=5e-3)
    np.testing.assert_allclose((flight.origin[:, 1] - flight.origin[:, 0])[:, 1], 0.02, atol=1e-12)


def test_wobble_has_the_spread_it_is_given_and_follows_the_seed() -> None:
    one = pushbroom(20_000, 1, wobble=(0.5, 0.3, 1.0), heading=180.0, sway=0.2, seed=4)
    np.testing.assert_allclose(one.attitude.std(axis=0), [0.5, 0.3, 1.0], rtol=0.15)
    assert one.position[:, 2].std() == pytest.approx(0.2, rel=0.2)
    again = pushbroom(20_000, 1, wobble=(0.5, 0.3, 1.0), heading=180.0, sway=0.2, seed=4)
    other = pushbroom(20_000, 1, wobble=(0.5, 0.3, 1.0), heading=180.0, sway=0.2, seed=5)
    np.testing.assert_array_equal(one.rotation, again.rotation)
    assert not np.allclose(one.rotation, other.rotation)


def test_record_times_are_utc() -> None:
    time = np.array(["2021-07-20T17:00:00", "2021-07-20T17:00:10"], dtype="datetime64[ns]")
    lines = np.array(["2021-07-20T17:00:02.5", "2021-07-20T17:00:03"], dtype="datetime64[ns]")
    flight = platform_from_poses(time, *[[0, 0]] * 2, [9, 9], *[[0, 0]] * 3, columns=1, line_time=lines)
    np.testing.assert_array_equal(flight.utc, lines)


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"lines": 0}, "lines=0"),
        ({"lines": 10**12}, "lines=1000000000000"),
        ({"columns": True}, "columns=True"),
        ({"altitude": math.nan}, "altitude=nan"),
        ({"altitude": 10**400}, "altitude=1000"),
        ({"altitude": "high"}, "altitude='high'"),
        ({"ifov": 0.001, "ground_sample": 0.1}, "option-conflict"),
        ({"speed": 1.0, "line_spacing": 0.1}, "option-conflict"),
        ({"wobble": (1.0, 2.0)}, "wobble="),
        ({"centre": (0.0, math.inf)}, "centre="),
        ({"exposure_time": 8e-3}, "exposure-too-long"),
        ({"columns": 20_000, "ifov": 0.01}, "view-too-wide"),
        ({"start_time": "now"}, "start_time='now'"),
        ({"start_time": "yesterday"}, "start_time='yesterday'"),
    ],
)
def test_flights_that_cannot_be_flown_are_refused(wrong: dict[str, Any], text: str) -> None:
    with pytest.raises(SchemaError) as caught:
        pushbroom(**{"lines": 4, "columns": 4, **wrong})
    assert text in str(caught.value)


def test_all_problems_of_a_flight_are_told_at_once() -> None:
    with refusal(SchemaError, "value-out-of-range", "lines=0", "altitude=0", "wobble=-1", "seed=-1"):
        pushbroom(0, 4, altitude=0, wobble=-1, seed=-1)


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"time": [0, 0]}, "time-unordered"),
        ({"time": [0]}, "pose-missing"),
        ({"roll": [math.nan, 0]}, "roll"),
        ({"north": [0, 0, 0]}, "north.*dims-wrong"),
        ({"heading": [0, 170]}, "poses 0 and 1.*turn-too-large"),
        ({"line_time": [2.0]}, "lines-outside-poses"),
        ({"line_time": np.array(["2021-01-01"], "datetime64[ns]")}, "type-wrong"),
        ({"columns": 0}, "columns=0"),
        ({"up": [0, 1e9]}, "up has.*value-out-of-range"),
        ({"east": ["a", "b"]}, "east"),
    ],
)
def test_records_that_cannot_be_used_are_refused(wrong: dict[str, Any], text: str) -> None:
    poses: dict[str, Any] = {name: [0, 0] for name in ("east", "north", "roll", "pitch", "heading")}
    poses |= {"time": [0, 1], "up": [9, 9], "columns": 2, "line_time": [0.5]}
    with pytest.raises(SchemaError, match=text):
        platform_from_poses(**(poses | wrong))


def test_platforms_of_wrong_arrays_are_refused() -> None:
    good = pushbroom(3, 2)
    given = {
        name: getattr(good, name) for name in ("origin", "rotation", "column_edges", "along_edges", "time")
    }
    for name, wrong, text in (
        ("origin", np.zeros((3, 3)), r"origin.*dims-wrong"),
        ("rotation", -good.rotation, "rotation-invalid"),
        ("column_edges", good.column_edges[::-1], "edges-invalid"),
        ("time", good.time.astype(float), "type-wrong"),
    ):
        with pytest.raises(SchemaError, match=text):
            Platform(**(given | {name: wrong}))


# --- the motion of a drone ----------------------------------------------------------------------------------

SECONDS = np.arange(0.0, 600.0, 0.01)


def flown(**effects: object) -> Trajectory:
    return Trajectory.of(
        SimulationSettings.of({"scene": "checkerboard", **effects}), LocalFrame(*ORIGIN), 1.14, 15.24
    )


@pytest.mark.parametrize(
    ("wobble", "tilt", "heading", "fastest"),
    [("calm", 0.15, 1.1, (2.2, 2.8, 12.0)), ("rough", 0.42, 3.1, (6.0, 8.0, 34.0))],
)
def test_wobble_is_that_of_drones(
    wobble: str, tilt: float, heading: float, fastest: tuple[float, float, float]
) -> None:
    # Expected: spreads and highest rates [degree, degree s-1] of ``georeference_reliability.md`` 1.2
    path = flown(wobble=wobble, seed=3)
    pose = path.pose(SECONDS)
    yaw = (pose["heading"] + 180.0) % 360.0 - 180.0
    assert pose["roll"].std() == pytest.approx(tilt, rel=0.1)
    assert (pose["pitch"].std(), yaw.std()) == (pytest.approx(tilt, rel=0.1), pytest.approx(heading, rel=0.1))
    for angle, most in zip((pose["roll"], pose["pitch"], yaw), fastest, strict=True):
        assert np.abs(np.gradient(angle, 0.01)).max() == pytest.approx(most, rel=0.35)
    # which crosses north, and is written from 0 to 360
    assert pose["heading"].min() >= 0.0
    assert pose["heading"].max() < 360.0
    assert np.abs(np.diff(pose["heading"])).max() > 350.0
    assert max(np.abs(pose["roll"]).max(), np.abs(pose["pitch"]).max()) < path.steepest
    assert np.abs(yaw).max() < path.max_yaw


def test_seeds_wobble_differently_and_again_the_same() -> None:
    rolls = [flown(wobble="calm", seed=seed).pose(SECONDS)["roll"] for seed in (1, 1, 2)]
    np.testing.assert_array_equal(rolls[0], rolls[1])
    assert np.abs(np.corrcoef(rolls[0], rolls[2])[0, 1]) < 0.2


def test_without_wobble_it_flies_straight() -> None:
    pose = flown(wobble="none", course=63.0).pose(SECONDS)
    assert not pose["roll"].any()
    assert not pose["pitch"].any()
    assert (pose["heading"] == 63.0).all()
    assert (pose["altitude"] == 160.0 + 15.24).all()
    azimuth, _, distance = pyproj.Geod(ellps="WGS84").inv(
        pose["longitude"][0], pose["latitude"][0], pose["longitude"][-1], pose["latitude"][-1]
    )
    assert (azimuth, distance) == (pytest.approx(63.0, abs=1e-3), pytest.approx(1.14 * SECONDS[-1], rel=1e-4))


def test_camera_is_where_pose_and_mounting_put_it() -> None:
    # Expected: by scipy's rotations and PROJ's geodesy, lever arm and boresight as rotations
    path = flown(
        wobble="rough", course=300.0, boresight=(0.4, -0.6, 0.8), lever_arm=(0.05, -0.02, 0.12), seed=5
    )
    seconds = np.array([0.0, 3.0, 50.0])
    pose, (origin, rotation) = path.pose(seconds), path.camera(seconds)
    to_scene = pyproj.Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
        f"+step +proj=topocentric +ellps=WGS84 +lon_0={ORIGIN[1]} +lat_0={ORIGIN[0]} +h_0={ORIGIN[2]}"
    )
    place = np.stack(to_scene.transform(pose["longitude"], pose["latitude"], pose["altitude"]), axis=-1)
    body = Rotation.from_euler("ZYX", np.stack([pose[n] for n in ("heading", "pitch", "roll")], -1), True)
    camera = body * Rotation.from_euler("ZYX", [0.8, -0.6, 0.4], degrees=True)
    swap = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
    # the vertical there is not that of the origin: 57 m are 5e-4 degrees
    np.testing.assert_allclose(rotation, swap @ camera.as_matrix(), atol=2e-5)
    np.testing.assert_allclose(origin, place + body.apply([0.05, -0.02, 0.12]) @ swap.T, atol=1e-5)


def test_motions_and_mountings_that_cannot_be_flown() -> None:
    with pytest.raises(SchemaError) as caught:
        SimulationSettings(
            wobble="wild", boresight=(1.0, 2.0), lever_arm=(0.0, 0.0, 9.0), swath=0.0, course=999.0
        )
    for text in ("wobble='wild'", "boresight=(1.0, 2.0)", "lever_arm=", "swath=0.0", "course=999.0"):
        assert text in str(caught.value)
    with pytest.raises(SchemaError) as caught:
        SimulationSettings(scene="plan", course=10.0, swath=5.0, navigation_rate=300)
    expect_words(str(caught.value), "course=10.0", "swath=5.0", "navigation_rate=300")


# --- the ellipsoid and the map ------------------------------------------------------------------------------

RNG = np.random.default_rng(8)
LATITUDE = RNG.uniform(0.0, 83.0, 500)
LONGITUDE = -75.0 + RNG.uniform(-3.0, 3.0, 500)
HEIGHT = RNG.uniform(-100.0, 5000.0, 500)


def transformed(source: str, target: str, *values: np.ndarray) -> tuple[np.ndarray, ...]:
    made = pyproj.Transformer.from_crs(source, target, always_xy=True).transform(*values)
    return tuple(np.asarray(part) for part in made)


def test_geocentric_and_back() -> None:
    expected = np.stack(transformed("EPSG:4979", "EPSG:4978", LONGITUDE, LATITUDE, HEIGHT), axis=-1)
    np.testing.assert_allclose(geocentric(LATITUDE, LONGITUDE, HEIGHT), expected, atol=1e-8, rtol=0)
    latitude, longitude, height = geodetic(expected)
    assert np.abs(latitude - LATITUDE).max() < 1e-11  # degree: a micrometre
    assert np.abs(longitude - LONGITUDE).max() < 1e-12
    assert np.abs(height - HEIGHT).max() < 1e-7


@pytest.mark.parametrize("zone", [1, 18, 31, 60])
def test_map_is_that_of_utm(zone: int) -> None:
    plane = TransverseMercator(zone)
    longitude = LONGITUDE + 6.0 * (zone - 18)
    east, north = plane.project(LATITUDE, longitude)
    x, y = transformed("EPSG:4326", plane.crs, longitude, LATITUDE)
    assert np.abs(east - x).max() < 1e-7
    assert np.abs(north - y).max() < 1e-7


def test_zone_of_a_place() -> None:
    zones = [TransverseMercator.of(43.0, longitude).zone for longitude in (-180.0, -77.7, 0.0, 179.9)]
    assert zones == [1, 18, 31, 60]
    with pytest.raises(ValueError, match="-20"):
        TransverseMercator.of(-20.0, 0.0)


def test_local_frame_is_that_of_proj() -> None:
    frame = LocalFrame(43.0845, -77.6749, 160.0)
    latitude, longitude = 43.0845 + RNG.normal(0, 0.01, 50), -77.6749 + RNG.normal(0, 0.01, 50)
    height = RNG.uniform(100.0, 300.0, 50)
    pipeline = pyproj.Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
        "+step +proj=topocentric +ellps=WGS84 +lon_0=-77.6749 +lat_0=43.0845 +h_0=160"
    )
    made = frame.local(latitude, longitude, height)
    np.testing.assert_allclose(
        made, np.stack(pipeline.transform(longitude, latitude, height), axis=-1), atol=1e-7, rtol=0
    )
    for value, wanted, within in zip(
        frame.geodetic(made), (latitude, longitude, height), (1e-11, 1e-11, 1e-7), strict=True
    ):
        np.testing.assert_allclose(value, wanted, atol=within, rtol=0)
