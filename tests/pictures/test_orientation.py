"""Pictures lie as the ground does: triangles keep their sense on the screen, and their lengths."""

from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.flown_lines import fly, located

pytest.importorskip("matplotlib")

from matplotlib.figure import Figure

from hyperpaint.pictures.figures import orientation_of, show_picture

LINES, COLUMNS = 40, 20


def on_screen(dataset: xr.Dataset) -> Any:
    # Return what leads from the data coordinates of the picture to the screen [pixel]
    axes = Figure(figsize=(6, 6)).add_subplot()
    lines, columns = (dataset.sizes[dim] for dim in ("along_track", "cross_track"))
    show_picture(axes, np.zeros((lines, columns, 3)), orientation_of(dataset))
    axes.figure.draw_without_rendering()
    return axes, axes.transData.transform


def line_of(heading: float, turned: bool) -> xr.Dataset:
    line = located(fly(LINES, COLUMNS, "none", heading=heading), chunk=None)
    return line.isel(cross_track=slice(None, None, -1)) if turned else line


@pytest.mark.parametrize("heading", [0.0, 60.0, 180.0, 290.0])
@pytest.mark.parametrize("turned", [False, True])
def test_a_line_is_never_mirrored(heading: float, turned: bool) -> None:
    # Expected: of three pixels, east and north turn the same way as right and up on the screen, whichever way
    # the flight goes and the columns run; the flight goes upwards; and lengths are those of the ground
    line = line_of(heading, turned)
    axes, to_screen = on_screen(line)
    pixels = [(5, 3), (30, 3), (5, 16)]  # line, column
    ground = np.array([[float(line[name][pixel]) for name in ("east", "north")] for pixel in pixels])
    shown = to_screen([(column, row) for row, column in pixels])
    sides = [points[1:] - points[0] for points in (ground, shown)]
    assert np.sign(np.linalg.det(sides[0])) == np.sign(np.linalg.det(sides[1]))
    assert shown[1, 1] > shown[0, 1]
    lengths = [np.linalg.norm(side, axis=1) for side in sides]
    assert lengths[1][0] / lengths[1][1] == pytest.approx(lengths[0][0] / lengths[0][1], rel=0.02)
    assert axes.get_ylabel() == "along_track [line], flown upwards"


@pytest.mark.parametrize(
    ("order", "rightwards", "label"),
    [
        ("left_to_right", True, "cross_track [column]"),
        ("right_to_left", False, "cross_track [column]"),
        (None, True, "cross_track [column], assumed to run to the right"),
    ],
)
def test_columns_run_as_declared(order: str | None, rightwards: bool, label: str) -> None:
    dataset = xr.Dataset({"quality": (("along_track", "cross_track"), np.zeros((LINES, COLUMNS), np.uint16))})
    if order:
        dataset.attrs["convention_column_order"] = order
    axes, to_screen = on_screen(dataset)
    left, right = to_screen([(2, 5), (9, 5)])
    assert bool(right[0] > left[0]) is rightwards
    assert axes.get_xlabel() == label
    up, along = np.diff(to_screen([(0, 0), (0, 1), (1, 1)]), axis=0)
    assert np.linalg.norm(up) == pytest.approx(np.linalg.norm(along), rel=1e-6)  # square


@pytest.mark.parametrize("rows_go_south", [True, False])
def test_a_map_has_north_up(rows_go_south: bool) -> None:
    north = 4_770_000.0 + 0.5 * np.arange(LINES) * (-1 if rows_go_south else 1)
    attrs = {"units": "m", "standard_name": "projection_y_coordinate"}
    axes, to_screen = on_screen(
        xr.Dataset(
            {"quality": (("along_track", "cross_track"), np.zeros((LINES, COLUMNS), np.uint16))},
            {
                "y": ("along_track", north, attrs),
                "x": ("cross_track", 3e5 + 0.5 * np.arange(COLUMNS), {"units": "m"}),
            },
        )
    )
    south, far_north = to_screen([(3e5, north.min()), (3e5, north.max())])
    assert far_north[1] > south[1]
    assert axes.images[0].get_extent()[2] == north[0] - 0.25 * np.sign(north[1] - north[0])
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("east [m]", "north, up [m]")


def test_angles_of_the_columns_count_before_the_declared_order() -> None:
    line = xr.Dataset({"a": (("along_track", "cross_track"), np.zeros((4, 3)))})
    line.attrs["convention_column_order"] = "left_to_right"
    assert not orientation_of(line).is_mirrored
    turned = line.assign_coords(look_across=("cross_track", [9.0, 0.0, -9.0], {"units": "degree"}))
    assert orientation_of(turned).is_mirrored
    assert orientation_of(turned).labels[0] == "cross_track [column]"
