"""From a wobbling flight through the instruments' files to a map: is everything where it is?

The simulator has its own geodesy, rotations and navigation; nothing of the way back is shared with it.
"""

import importlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

import hyperpaint as hp
from hyperpaint.simulation import simulate_collect
from hyperpaint.workflows.pipeline import process

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def straightened() -> Any:
    return importlib.import_module("campaigns.straightened")


@pytest.fixture(scope="module", params=["calm", "rough"])
def flight(
    request: pytest.FixtureRequest, straightened: Any, tmp_path_factory: pytest.TempPathFactory
) -> tuple[xr.Dataset, xr.Dataset]:
    # Return a processed line of 640 columns over a checkerboard, and its truth
    line, truth = straightened.fly(tmp_path_factory.mktemp("board"), request.param, lines=640)
    return line, truth


@pytest.fixture(scope="module")
def short(straightened: Any, tmp_path_factory: pytest.TempPathFactory) -> tuple[xr.Dataset, xr.Dataset, Path]:
    # Return a shorter line whose frames are stamped by a clock that is 10 ms behind, and its collect
    folder = tmp_path_factory.mktemp("short")
    line, truth = straightened.fly(
        folder, "rough", lines=300, columns=320, frame_clock_offset_s=0.01, course=250.0, navigation_rate=200
    )
    return line, truth, folder / "rough"


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.31, -0.17)])
def test_finder_of_corners(straightened: Any, shift: tuple[float, float]) -> None:
    # Expected: of a board drawn 10 x 10 times finer than its pixels, with noise, what it was shifted by
    from campaigns.saddle_points import misplacement

    size, fine, gsd, turn = 200, 10, 0.008, np.radians(27.0)
    x, y = (np.arange(size * fine) + 0.5) / fine * gsd, (np.arange(size * fine)[:, None] + 0.5) / fine * gsd
    x, y = x - shift[0] * gsd - 0.8, -(y - shift[1] * gsd) + 0.8
    u, v = x * np.sin(turn) + y * np.cos(turn), x * np.cos(turn) - y * np.sin(turn)
    bright = (np.floor(u / 0.16) + np.floor(v / 0.16)) % 2
    picture = bright.reshape(size, fine, size, fine).mean(axis=(1, 3))
    picture += np.random.default_rng(0).normal(0.0, 0.01, picture.shape)
    i, j = (n.ravel() * 0.16 for n in np.meshgrid(np.arange(-5, 6), np.arange(-5, 6)))
    corners = i * np.sin(turn) + j * np.cos(turn), i * np.cos(turn) - j * np.sin(turn)
    miss = misplacement(picture, (-0.8, gsd, 0.0, 0.8, 0.0, -gsd), *corners, 27.0, 0.16)
    assert len(miss) > 60
    np.testing.assert_allclose(miss.mean(axis=0), shift, atol=0.004)
    assert miss.std(axis=0).max() < 0.02


def test_pixels_are_where_they_are(flight: tuple[xr.Dataset, xr.Dataset], straightened: Any) -> None:
    # Expected: what linear interpolation of 100 Hz leaves, 0.05 of a pixel for a rough flight
    line, truth = flight
    placed = straightened.located(line, truth)
    error = straightened.pixel_errors(placed, truth)
    np.testing.assert_array_less([np.sqrt((error**2).mean()), error.max()], [0.02, 0.06])
    np.testing.assert_allclose(placed["ground_height"], truth["height"], atol=1e-5, rtol=0)
    # headings cross north
    assert np.ptp(line["heading"].values) > 350.0


@pytest.mark.parametrize(("method", "most"), [("bilinear", 0.15), ("nearest", 0.25)])
def test_corners_are_where_they_are(
    flight: tuple[xr.Dataset, xr.Dataset], straightened: Any, method: str, most: float
) -> None:
    line, truth = flight
    miss = straightened.corner_errors(straightened.located(line, truth), truth, method=method, grid="flight")
    assert len(miss) >= 850
    assert np.sqrt((miss**2).sum(axis=1).mean()) <= most
    assert np.abs(miss.mean(axis=0)).max() <= 0.02


def test_store_says_all_but_the_height_of_the_ground(tmp_path: Path) -> None:
    # Expected: a processed line of a camera that is mounted straight is located by the ground alone
    path = simulate_collect(
        tmp_path / "board", lines=60, columns=80, bands=4, scene="checkerboard", swath=0.64, wobble="calm"
    )
    process(path, tmp_path / "board.zarr")
    line = xr.open_zarr(tmp_path / "board.zarr", group="flightlines/raw_0")
    truth = xr.open_zarr(tmp_path / "board" / "truth.zarr")
    assert line.attrs["convention_stamp_reference"] == "end"
    assert line.attrs["convention_column_order"] == "left_to_right"
    placed = line.paint.locate(ground=160.0)
    assert placed["east"].attrs["crs"] == truth.attrs["crs"]
    error = np.hypot(placed["east"] - truth["east"], placed["north"] - truth["north"]) / 0.008
    assert float(error.max()) < 0.05


@pytest.mark.parametrize("record", ["imu_gps.txt", "trajectory.sbet"])
def test_clock_of_the_frames(
    short: tuple[xr.Dataset, xr.Dataset, Path], straightened: Any, record: str
) -> None:
    # Expected: right with the offset, by 200 Hz of either file; a pixel and more off without
    line, truth, folder = short
    options = {name: truth.attrs[name] for name in ("ground", "boresight", "lever_arm", "crs")}
    navigation = hp.open_navigation(
        folder / "flight" / record, date="2021-07-20" if record.endswith("sbet") else None
    )
    right = line.paint.locate(
        navigation=navigation, clock_offset_s=truth.attrs["frame_clock_offset_s"], **options
    )
    assert straightened.pixel_errors(right, truth).max() < 0.03
    wrong = straightened.pixel_errors(line.paint.locate(navigation=navigation, **options), truth)
    assert np.sqrt((wrong**2).mean()) > 1.0


@pytest.mark.parametrize(
    ("named", "least"),
    [
        ({"boresight": (0.0, 0.0, 0.0)}, 10.0), ({"lever_arm": (0.0, 0.0, 0.0)}, 5.0),
        ({"ground": 160.05}, 0.3), ({"boresight": (0.4, -0.6, 1.8)}, 1.0),
    ],
)  # fmt: skip
def test_what_is_wrong_is_seen(
    short: tuple[xr.Dataset, xr.Dataset, Path], straightened: Any, named: dict[str, Any], least: float
) -> None:
    line, truth, folder = short
    options = {name: truth.attrs[name] for name in ("ground", "boresight", "lever_arm", "crs")}
    navigation = hp.open_navigation(folder / "flight" / "imu_gps.txt")
    placed = line.paint.locate(navigation=navigation, clock_offset_s=0.01, **{**options, **named})
    assert np.sqrt((straightened.pixel_errors(placed, truth) ** 2).mean()) > least


def test_cars_are_where_they_are(tmp_path: Path) -> None:
    # Expected: pixels of level ground at the mean place of their rays, which scatter by a tenth of a pixel;
    # roofs are displaced away from the middle, by their height times the tangent of the view
    path = simulate_collect(
        tmp_path / "lot", lines=120, columns=160, bands=4, wobble="rough", boresight=(0.4, -0.6, 0.8)
    )
    process(path, tmp_path / "lot.zarr")
    line = xr.open_zarr(tmp_path / "lot.zarr", group="flightlines/raw_0")
    truth = xr.open_zarr(tmp_path / "lot" / "truth.zarr").load()
    placed = line.paint.locate(ground=160.0, boresight=truth.attrs["boresight"])
    east, north = (((placed[name] - truth[name]) / 0.1).values for name in ("east", "north"))
    level = np.abs(truth["up"].values) < 1e-3
    assert level.sum() > 5000
    for error in (east[level], north[level]):
        np.testing.assert_array_less([abs(error.mean()), error.std()], [0.01, 0.1])
    roofs = (truth["up"].values > 1.2) & (truth["car_id"].values >= 0) & (truth["purity"].values > 0.99)
    assert roofs.sum() > 100
    expected = truth["up"].values * np.tan(np.radians(placed["view_zenith"].values)) / 0.1
    np.testing.assert_allclose(np.hypot(east, north)[roofs], expected[roofs], atol=0.6)
