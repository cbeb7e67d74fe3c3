"""Ground behind cars that no pixel shows is a gap of the map, and what is seen stays."""

import numpy as np
import pytest
import xarray as xr
from support.hidden_ground import (
    COLUMNS,
    EAST,
    HEIGHT,
    LINES,
    MAP,
    NORTH,
    SPACING,
    Seen,
    fly_over_cars,
    is_hidden,
    located,
    surface,
)  # fmt: skip

import hyperpaint as hp
from hyperpaint.base.attitude_conventions import Convention
from hyperpaint.geometry.orthorectification.mapping import hidden_between

DIMS = ("along_track", "cross_track")


@pytest.fixture(scope="module")
def seen() -> Seen:
    return fly_over_cars()


def within(east: np.ndarray, north: np.ndarray) -> np.ndarray:
    # Return which places lie well inside of what the line covers
    x, y = east - EAST, north - NORTH
    return (x > 0.3) & (x < COLUMNS * SPACING - 0.3) & (y > 0.3) & (y < (LINES - 3) * SPACING)


@pytest.mark.parametrize("turn", [0, 180])
@pytest.mark.parametrize("chunk", [7, 260])
def test_what_is_hidden_is_a_gap(seen: Seen, chunk: int, turn: int) -> None:
    line = located(seen, quality=(DIMS, np.zeros(seen.east.shape, np.uint16))).chunk(along_track=chunk)
    if turn:  # flown to the south
        line = line.isel(along_track=slice(None, None, -1), cross_track=slice(None, None, -1))
    made = hp.geometry.orthorectify(line, SPACING, variables=["quality", "ground_height"]).compute()
    east, north = np.meshgrid(made["x"], made["y"])
    hidden, shown = is_hidden(east, north), made["hits"].values > 0
    assert (hidden & within(east, north)).sum() > 1500
    assert ((hidden & shown).any(), made["gap"].values[hidden & within(east, north)].all()) == (False, True)
    assert (made["quality"].values[hidden] == int(hp.Quality.OFF_SWATH)).all()
    assert np.isnan(made["ground_height"].values[hidden]).all()
    # what is shown is what stands there: no car on the ground
    assert not (shown & (surface(east, north) == 0.0) & (made["ground_height"].values > 0.1)).any()
    # little of what was seen goes with it, along the edges of cars
    there = ~hidden & within(east, north)
    assert (there & ~shown).sum() < 0.03 * there.sum()


def test_without_heights_it_was_shown(seen: Seen) -> None:
    line = located(seen)
    made = hp.geometry.orthorectify(
        line.drop_vars(["ground_height", "view_zenith"]), SPACING, variables=[], max_stretch=20.0
    ).compute()
    east, north = np.meshgrid(made["x"], made["y"])
    assert ((made["hits"].values > 0) & is_hidden(east, north)).sum() > 1500
    # of level ground no height is read
    same = hp.geometry.orthorectify(line.assign_attrs(ground=0.0), SPACING, variables=[], max_stretch=20.0)
    np.testing.assert_array_equal(same["hits"], made["hits"])


def test_a_line_that_is_located_on_a_model_of_the_surface(seen: Seen) -> None:
    back = pytest.importorskip("pyproj").Transformer.from_crs(MAP, "EPSG:4979", always_xy=True)
    middle = np.full(LINES, EAST + COLUMNS * SPACING / 2)
    longitude, latitude = back.transform(middle, NORTH + np.arange(LINES) * SPACING)
    poses = {"latitude": latitude, "longitude": longitude, "altitude": np.full(LINES, HEIGHT)}
    poses |= dict.fromkeys(("roll", "pitch", "heading"), np.zeros(LINES))
    line = xr.Dataset(coords={
        name: ("along_track", values, {"units": "m" if name == "altitude" else "degree"})
        for name, values in poses.items()
    })  # fmt: skip
    line = line.assign_coords(cross_track=np.arange(COLUMNS)).assign_attrs(Convention().to_attrs())
    x, y = EAST - 2.0 + np.arange(560) * 0.05, NORTH + 28.0 - np.arange(600) * 0.05
    heights = surface(*np.meshgrid(x, y))
    dem = xr.DataArray(
        heights, {"y": y, "x": x}, ("y", "x"), attrs={"crs": MAP, "height_reference": "ellipsoid"}
    )
    camera = hp.geometry.PinholeCamera(COLUMNS, pixel_pitch=SPACING, focal_length=HEIGHT)
    placed = line.paint.locate(
        dem=dem, camera=camera, convention=Convention(column_order="left_to_right"), crs=MAP
    )
    assert np.median(np.hypot(placed["east"] - seen.east, placed["north"] - seen.north).values) < 0.02
    made = hp.geometry.orthorectify(placed, SPACING, variables=["ground_height"]).compute()
    east, north = np.meshgrid(made["x"], made["y"])
    hidden, shown = is_hidden(east, north), made["hits"].values > 0
    # walls of a raster lean by a cell of it: the last cells of a shadow are then seen, as ground beside them
    assert (hidden & shown).sum() < 0.2 * (hidden & within(east, north)).sum()
    assert (shown & hidden & (surface(east, north) == 0.0) & (made["ground_height"].values > 0.75)).sum() == 0
    there = ~hidden & within(east, north)
    assert (there & ~shown).sum() < 0.04 * there.sum()


def test_patches_one_by_one() -> None:
    rng = np.random.default_rng(4)
    height, tangent = rng.uniform(0, 2, (9, 7)), rng.uniform(0, 0.6, (9, 7))
    height[3, 2] = np.nan
    hidden = hidden_between(height[1:], tangent[1:], (height[0], tangent[0]), 0.4)
    for i in range(8):
        for j in range(6):
            four = height[i : i + 2, j : j + 2]
            assert hidden[i, j] == ((four.max() - four.min()) * tangent[i : i + 2, j : j + 2].max() > 0.4)
    # a wall that is seen: heights fall by the spacing over the tangent
    wall = np.broadcast_to(np.arange(7) * 0.1 / 0.36, (2, 7))
    at = np.full((2, 7), 0.36)
    assert not hidden_between(wall[1:], at[1:], (wall[0], at[0]), 0.105).any()
