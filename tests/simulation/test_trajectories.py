"""How simulated platforms move."""

from __future__ import annotations

import numpy as np
import pyproj
import pytest
from scipy.spatial.transform import Rotation

from hyperpaint.base.errors import SchemaError
from hyperpaint.simulation import SimulationSettings
from hyperpaint.simulation.rendering.platforms import LocalFrame, Trajectory
from hyperpaint.simulation.settings import ORIGIN

SECONDS = np.arange(0.0, 600.0, 0.01)


def flown(**effects: object) -> Trajectory:
    settings = SimulationSettings.of({"scene": "checkerboard", **effects})
    return Trajectory.of(settings, LocalFrame(*ORIGIN), 1.14, 15.24)


@pytest.mark.parametrize(
    ("wobble", "tilt", "heading", "fastest"),
    [("calm", 0.15, 1.1, (2.2, 2.8, 12.0)), ("rough", 0.42, 3.1, (6.0, 8.0, 34.0))],
)
def test_wobble_is_that_of_drones(
    wobble: str, tilt: float, heading: float, fastest: tuple[float, float, float]
) -> None:
    """Expected: spreads and highest rates [degree, degree s-1] of ``georeference_reliability.md`` 1.2."""
    path = flown(wobble=wobble, seed=3)
    pose = path.pose(SECONDS)
    yaw = (pose["heading"] + 180.0) % 360.0 - 180.0
    assert pose["roll"].std() == pytest.approx(tilt, rel=0.1)
    assert pose["pitch"].std() == pytest.approx(tilt, rel=0.1)
    assert yaw.std() == pytest.approx(heading, rel=0.1)
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
    assert azimuth == pytest.approx(63.0, abs=1e-3)
    assert distance == pytest.approx(1.14 * SECONDS[-1], rel=1e-4)


def test_camera_is_where_pose_and_mounting_put_it() -> None:
    """Expected: by scipy's rotations and PROJ's geodesy, lever arm and boresight as rotations."""
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


def test_what_cannot_be_flown() -> None:
    with pytest.raises(SchemaError) as caught:
        SimulationSettings(
            wobble="wild", boresight=(1.0, 2.0), lever_arm=(0.0, 0.0, 9.0), swath=0.0, course=999.0
        )
    for text in ("wobble='wild'", "boresight=(1.0, 2.0)", "lever_arm=", "swath=0.0", "course=999.0"):
        assert text in str(caught.value)
    with pytest.raises(SchemaError) as caught:
        SimulationSettings(scene="plan", course=10.0, swath=5.0, navigation_rate=300)
    for text in ("course=10.0", "swath=5.0", "navigation_rate=300"):
        assert text in str(caught.value)
