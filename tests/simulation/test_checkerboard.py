"""A flight over squares whose corners are known."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from click.testing import CliRunner

import hyperpaint as hp
from hyperpaint.cli.program import main
from hyperpaint.simulation import SimulationSettings, simulate_collect, simulate_line
from hyperpaint.simulation.flight import Checkerboard, CheckerboardFlight
from hyperpaint.simulation.settings import PIXEL_ANGLE_RAD


def is_bright(board: Any, east: Any, north: Any) -> Any:
    # Tell which places are on bright squares: those whose numbers differ in being odd
    first, second = np.floor(board.numbers(east, north))
    return (first + second) % 2 == 1


SMALL = {
    "scene": "checkerboard", "lines": 70, "columns": 96, "bands": 3, "swath": 0.96, "wobble": "rough",
    "boresight": (0.4, -0.6, 0.8), "lever_arm": (0.05, -0.02, 0.12), "course": 350.0,
}  # fmt: skip


def flight(**effects: object) -> CheckerboardFlight:
    return CheckerboardFlight(SimulationSettings.of({**SMALL, **effects}))


def test_corners_are_where_four_squares_meet() -> None:
    board = Checkerboard((500.0, 4000.0), 0.16, 27.0)
    corners = board.corners(np.array([[0, 0], [3, -2], [-5, 7]]))
    around = 0.01 * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
    turn = np.radians(27.0)
    along = np.array([[np.sin(turn), np.cos(turn)], [np.cos(turn), -np.sin(turn)]])
    for corner in corners:
        bright = is_bright(board, *(corner + around @ along).T)
        assert bright.sum() == 2
        assert bright[0] == bright[2] != bright[1]
    assert np.hypot(*(corners[1] - corners[0])) == pytest.approx(0.16 * np.hypot(3, 2))


def test_lines_are_the_same_however_they_are_asked_for() -> None:
    whole, part = flight().lines(0, 70), flight().lines(33, 60)
    np.testing.assert_array_equal(whole.counts[33:60], part.counts)
    for name, values in whole.layers.items():
        np.testing.assert_array_equal(values[33:60], part.layers[name])


@pytest.mark.slow
def test_share_is_the_mean_over_pixel_and_exposure() -> None:
    # Expected: what 40 x 40 x 40 places and moments give, to what 80 of them can; on average, closer
    still = flight(wobble="none", boresight=(0, 0, 0), lever_arm=(0, 0, 0), course=0.0, board_turn=0.0)
    made = still.lines(0, 70).layers
    assert 0.02 < (abs(made["bright_share"] - 0.5) < 0.45).mean() < 0.4
    half = still.settings.exposure_time / 2
    parts = np.arange(-39, 40, 2) / 80
    errors = []
    for line in (10, 31):
        origin, rotation = still.trajectory.camera(still.line_times[line] / 1e9 + 2 * half * parts)
        for column in range(15, 40):
            across = (column - 47.5 + parts) * PIXEL_ANGLE_RAD
            fine = [
                is_bright(
                    still.board, *still._map_coordinates(still._places(origin, rotation, across, t))[:2]
                ).mean()
                for t in parts * PIXEL_ANGLE_RAD
            ]
            errors.append(made["bright_share"][line, column] - np.mean(fine))
    assert np.abs(errors).max() < 0.07
    assert abs(np.mean(errors)) < 0.01


def test_ground_is_level() -> None:
    assert np.abs(flight().lines(0, 70).layers["height"] - 160.0).max() < 1e-6


def test_files_hold_what_was_flown(tmp_path: Path) -> None:
    # Expected: both navigation files give the true pose, the truth says how the camera was mounted, and the
    # mean radiance of bright pixels is ten times that of dark ones
    path = simulate_collect(tmp_path / "board", **SMALL, navigation_rate=200, frame_clock_offset_s=0.004)
    truth = xr.open_zarr(path.parent / "truth.zarr")
    assert (truth.attrs["crs"], truth.attrs["boresight"]) == ("EPSG:32618", [0.4, -0.6, 0.8])
    assert (truth.attrs["lever_arm"], truth.attrs["frame_clock_offset_s"]) == ([0.05, -0.02, 0.12], 0.004)
    assert truth.sizes["corner"] > 50
    log = hp.open_navigation(path.parent / "flight" / "imu_gps.txt")
    sbet = hp.open_navigation(path.parent / "flight" / "trajectory.sbet", date="2021-07-20")
    assert log.sizes == sbet.sizes
    assert abs(log["navigation_time"] - sbet["navigation_time"]).max() <= np.timedelta64(1, "us")
    seconds = (log["navigation_time"].values - np.datetime64("2021-07-20T17:10:00", "ns")) / np.timedelta64(
        1, "s"
    )
    pose = flight().trajectory.pose(seconds)
    np.testing.assert_allclose(np.diff(seconds), 0.005)
    for name, within in (("latitude", 1e-9), ("roll", 1e-6), ("heading", 1e-6), ("altitude", 1e-4)):
        np.testing.assert_allclose(log[name], pose[name], atol=within, rtol=0)
    for name in ("roll", "heading"):
        np.testing.assert_allclose(np.degrees(sbet[name]), pose[name], atol=1e-9)
    frame, stamp = np.loadtxt(path.parent / "flight" / "frameIndex_0.txt", skiprows=1).T
    # the stamp is at the end of 5 ms, by a clock that is 4 ms behind
    clock = np.loadtxt(path.parent / "flight" / "imu_gps.txt", skiprows=1, usecols=6)[0]
    np.testing.assert_allclose((stamp - clock) / 1e6 + seconds[0], frame * 0.007 + 0.0025 - 0.004, atol=2e-6)
    share, radiance = truth["bright_share"].values, truth["radiance"].isel(band=1).values
    assert radiance[share == 1].mean() == pytest.approx(10 * radiance[share == 0].mean(), rel=1e-3)


def test_line_in_memory_can_be_located() -> None:
    line = simulate_line(**{**SMALL, "boresight": (0, 0, 0), "lever_arm": (0, 0, 0)})
    placed = line.paint.locate(ground=160.0)
    # the poses are exact, and so are places
    assert (
        float(np.hypot(placed["east"] - line["true_east"], placed["north"] - line["true_north"]).max()) < 1e-5
    )


def test_from_a_terminal(tmp_path: Path) -> None:
    options = ["--scene", "checkerboard", "--lines", "8", "--columns", "40", "--bands", "4", "--quiet"]
    flown = (
        "swath=0.5 wobble=calm course=90 boresight=0.4,-0.6,0.8 lever_arm=0.05,-0.02,0.12 navigation_rate=50"
    )
    for setting in flown.split():
        options += ["--set", setting]
    done = CliRunner().invoke(main, ["simulate", str(tmp_path / "sim"), *options])
    assert done.exit_code == 0, done.output
    truth = xr.open_zarr(tmp_path / "sim" / "truth.zarr")
    assert truth.attrs["lever_arm"] == [0.05, -0.02, 0.12]
    assert np.ptp(truth["north"].values) > np.ptp(truth["east"].values)  # eight lines, flown east
    done = CliRunner().invoke(
        main, ["simulate", str(tmp_path / "two"), "--scene", "plan", "--set", "swath=3"]
    )
    assert done.exit_code == 2
    assert "swath=3.0, expected 16 for all scenes but a checkerboard" in done.output
