"""Navigation files of others: values known from other programs, signs, and what is refused."""

from pathlib import Path

import numpy as np
import pytest
from support.navigation_files import (
    GPS_EPOCH,
    POSE,
    seconds_since,
    write_csv,
    write_sbet,
)

import hyperpaint as hp
from hyperpaint.base.errors import FormatError


@pytest.mark.real_data
def test_the_two_records_of_pdal(shared_data: Path) -> None:
    flight = hp.open_navigation(shared_data / "nav/2-points.sbet", week=1947)
    # radians of PDAL's test; its degrees have a slip in the first latitude, within its tolerance of 1e-4
    expected = {
        "roll": [-2.813407149321339e-02, -2.813856631423094e-02],
        "pitch": [-2.429905393889139e-02, -2.425215669392169e-02],
        "platform_heading": [3.046773230278662, 3.047131105236811],
        "wander_angle": [-2.198414736922658e-02, -2.198416007932108e-02],
        "altitude": [107.7152953296560, 107.7151424357507],
    }
    for name, values in expected.items():
        np.testing.assert_allclose(flight[name], values, rtol=0, atol=1e-12)
    np.testing.assert_allclose(
        np.radians(flight.latitude), [5.680211852972264e-01, 5.680211834722869e-01], atol=1e-12
    )
    np.testing.assert_allclose(flight.longitude, [-116.978180, -116.978180], rtol=0, atol=1e-6)
    np.testing.assert_allclose(np.degrees(flight["roll"][0]), -1.611964, rtol=0, atol=1e-6)
    np.testing.assert_allclose(np.degrees(flight.pitch[0]), -1.392233, rtol=0, atol=1e-6)
    np.testing.assert_allclose(np.degrees(flight.platform_heading[0]), 174.567247, rtol=0, atol=1e-6)
    week = GPS_EPOCH + np.timedelta64(1947 * 7, "D") - np.timedelta64(18, "s")
    assert seconds_since(flight.navigation_time.values, week) == pytest.approx(
        [151631.0028360710, 151631.0078318641], abs=1e-8
    )


@pytest.mark.real_data
def test_the_sign_of_the_wander_angle(shared_data: Path) -> None:
    # velocities are along the axes of the wander frame (north, west, up): turned by the wander angle they
    # must point where the platform went
    stored = np.fromfile(shared_data / "nav/2-points.sbet", "<f8").reshape(2, 17)
    north = (stored[1, 1] - stored[0, 1]) * 6.3540e6
    track = np.degrees(np.arctan2((stored[1, 2] - stored[0, 2]) * 6.3843e6 * np.cos(stored[0, 1]), north))
    velocity = stored[:, 4:6].mean(axis=0)
    in_frame = np.degrees(np.arctan2(-velocity[1], velocity[0]))
    wander = np.degrees(stored[0, 10])
    assert abs(in_frame - wander - track) < 0.5
    assert abs(in_frame + wander - track) > 2.0


@pytest.mark.real_data
def test_a_truncated_sbet_is_refused(shared_data: Path) -> None:
    with pytest.raises(FormatError, match="file-truncated"):
        hp.open_navigation(shared_data / "nav/badfile.sbet", week=1947)


@pytest.mark.real_data
def test_a_line_of_aviris(shared_data: Path) -> None:
    flight = hp.open_navigation(shared_data / "nav/ang20170323t202244_eph_att")
    assert flight.sizes["navigation_time"] == 17_540
    # the name says 20:22:44
    assert str(flight.navigation_time.values[0]).startswith("2017-03-23T20:22:39.004")
    assert flight.attrs["gps_week"] == 1941
    steps = np.diff(flight.navigation_time.values) / np.timedelta64(1, "ms")
    assert 92.0 < steps.min() < steps.max() < 101.0
    assert float(flight["roll"].max()) == pytest.approx(11.2, abs=0.05)
    assert -17.6 < float(flight.heading.min()) < float(flight.heading.max()) < -6.6
    # an aircraft that banks turns: with the right wing down, clockwise, by g tan(roll) / speed
    time = (flight.navigation_time.values - flight.navigation_time.values[0]) / np.timedelta64(1, "s")
    smooth = np.ones(51) / 51
    turn = np.convolve(np.gradient(np.unwrap(flight.heading.values, period=360.0), time), smooth, "valid")
    slope = np.polyfit(np.convolve(flight["roll"].values, smooth, "valid"), turn, 1)[0]
    north = np.gradient(flight.latitude.values, time) * 110.9e3
    east = np.gradient(flight.longitude.values, time) * 111.3e3 * np.cos(np.radians(flight.latitude.values))
    assert slope == pytest.approx(9.8 / np.hypot(north, east).mean(), rel=0.1)


@pytest.mark.real_data
def test_attitude_alone_is_no_navigation(shared_data: Path) -> None:
    with pytest.raises(FormatError) as caught:
        hp.open_navigation(shared_data / "gps_imu/px4_attitude_69s.csv")
    assert all(f"no column of {name}" in str(caught.value) for name in ("latitude", "longitude", "altitude"))


@pytest.mark.real_data
def test_real_attitude_through_every_format(shared_data: Path, tmp_path: Path) -> None:
    table = np.loadtxt(shared_data / "gps_imu/px4_attitude_69s.csv", delimiter=",", skiprows=1)[
        :, [0, 5, 6, 7]
    ]
    seconds, angles = table[:, 0] / 1e6, np.radians(table[:, 1:]).T
    sbet = write_sbet(
        tmp_path / "a.sbet", seconds, latitude=0.75, longitude=-1.35,
        roll=angles[0], pitch=angles[1], heading=angles[2],
    )  # fmt: skip
    names = "tow [s],lat [rad],lon [rad],alt [m],roll [rad],pitch [rad],yaw [rad]"
    rows = zip(seconds.tolist(), *angles.tolist(), strict=True)
    csv = write_csv(
        tmp_path / "a.csv", names, *(f"{t!r},0.75,-1.35,0,{r!r},{p!r},{y!r}" for t, r, p, y in rows)
    )
    one, other = (hp.open_navigation(path, week=2158) for path in (sbet, csv))
    for name in POSE:
        np.testing.assert_array_equal(one[name], other[name])
    np.testing.assert_array_equal(one.navigation_time, other.navigation_time)
    assert float(np.degrees(one["roll"].min())) == pytest.approx(-22.2, abs=0.05)
