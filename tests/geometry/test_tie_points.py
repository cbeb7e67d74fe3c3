"""Tie points found in the pictures of lines over a checkerboard, and the mounting that follows from them.

The simulator has its own geodesy, rotations and navigation; nothing of the way back is shared with it.
"""

import itertools
from typing import Any

import numpy as np
import pytest
import xarray as xr
from scipy.ndimage import map_coordinates
from support.refusals import expect_refusals

import hyperpaint as hp
from hyperpaint.base.errors import SchemaError
from hyperpaint.simulation import simulate_collect

pytest.importorskip("pyproj")

GSD, SQUARE, TURN = 0.008, 0.64, 27.0
MOUNTED, LEVER_ARM = (0.4, -0.6, 0.8), (0.05, -0.02, 0.12)
COURSES = {"north": 0.0, "east": 90.0, "south": 180.0, "west": 270.0, "again": 0.0}
CROSSING = ("north", "east", "south", "west")


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[xr.Dataset, xr.Dataset]]:
    # Return lines that leave one place for the four quarters, one twice, with what is true of them
    folder = tmp_path_factory.mktemp("crossing")
    flown = {}
    for seed, (name, course) in enumerate(COURSES.items()):
        collect = simulate_collect(
            folder / name, lines=384, columns=640, bands=2, scene="checkerboard", swath=640 * GSD,
            square=SQUARE, board_turn=TURN, wobble="calm", boresight=MOUNTED, lever_arm=LEVER_ARM,
            course=course, seed=seed,
        )  # fmt: skip
        line = hp.open_collect(collect)["flightlines/raw_0"].to_dataset()
        flown[name] = line, xr.open_zarr(folder / name / "truth.zarr")
    return flown


def placed(flight: Any, boresight: Any, *names: str) -> dict[str, xr.Dataset]:
    return {
        name: line.paint.locate(
            ground=truth.attrs["ground"], crs=truth.attrs["crs"], boresight=boresight, lever_arm=LEVER_ARM
        )
        for name, (line, truth) in flight.items()
        if name in names
    }


@pytest.mark.slow
def test_ties_show_one_place_and_solve_the_mounting(flight: Any) -> None:
    from campaigns.saddle_points import misplacement

    lines = placed(flight, (0.0, 0.0, 0.0), *CROSSING)
    ties = hp.geometry.find_tie_points(lines, search_m=0.4)
    assert ties.sizes["point"] > 60
    # by the truth, both lines show one place
    places = np.empty((2, 2, ties.sizes["point"]))
    pixels = np.stack([ties.along_track_pixel, ties.cross_track_pixel])
    for side, name, (axis, variable) in itertools.product(range(2), CROSSING, enumerate(("east", "north"))):
        is_of = ties.flightline.values[:, side] == name
        truth = flight[name][1][variable].values
        places[side, axis, is_of] = map_coordinates(truth, pixels[:, is_of, side], order=1)
    assert np.median(np.hypot(*(places[0] - places[1])) / GSD) < 0.5
    fit = hp.geometry.solve_boresight(lines, ties, lever_arm=LEVER_ARM)
    assert fit.solved == ("roll", "pitch", "heading")
    # a false tie is left out on both sides
    false = ties.copy(deep=True)
    false["cross_track_pixel"][7, 1] += 15.0
    found = hp.geometry.solve_boresight(lines, false, lever_arm=LEVER_ARM)
    assert np.flatnonzero(found.points.outlier).tolist() == [7, 7 + ties.sizes["point"]]
    np.testing.assert_allclose(found.boresight, MOUNTED, atol=0.02)
    lines = placed(flight, fit.boresight, *CROSSING)
    made = hp.geometry.mosaic(lines, GSD, method="bilinear", variables=["counts", "view_zenith"])
    picture = made["counts"].isel(band=1).values
    transform = tuple(map(float, made["spatial_ref"].attrs["GeoTransform"].split()))
    truth = flight["north"][1]
    corners = truth["corner_east"].values, truth["corner_north"].values
    miss = misplacement(picture.astype(float), transform, *corners, TURN, SQUARE)
    assert len(miss) > 40
    assert np.sqrt((miss**2).sum(axis=1).mean()) <= 0.3
    np.testing.assert_allclose(fit.boresight, MOUNTED, atol=0.02)


@pytest.mark.slow
def test_no_overlap_is_said(flight: Any) -> None:
    lines = placed(flight, MOUNTED, "north")
    apart = {
        "a": lines["north"].isel(along_track=slice(0, 100)),
        "b": lines["north"].isel(along_track=slice(250, 384)),
    }
    expect_refusals(
        (SchemaError, "tie-points-missing", lambda: hp.geometry.find_tie_points(apart)),
        (SchemaError, "line-number", lambda: hp.geometry.find_tie_points(lines)),
    )


@pytest.mark.slow
def test_lines_of_one_course_do_not_tell_the_pitch(flight: Any) -> None:
    lines = placed(flight, (0.0, 0.0, 0.0), "north", "again")
    ties = hp.geometry.find_tie_points(lines)

    with pytest.raises(SchemaError) as caught:
        hp.geometry.solve_boresight(lines, ties, lever_arm=LEVER_ARM)
    assert caught.value.codes == ("parameter-correlated",) * 3 + ("condition-poor",)
    assert caught.value.problems[1].found.startswith("pitch")
