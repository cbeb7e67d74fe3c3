"""From poses to the map in one go, of flights that go wrong: nothing is smeared, nothing raises."""

from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.geocentric_rays import LEFT_TO_RIGHT, PERIOD, UTM, flown, recorded

import hyperpaint as hp

OFF = int(hp.Quality.OFF_SWATH)
ALTITUDE, COLUMNS, LINES = 15.24, 24, 120
CAMERA = hp.geometry.PinholeCamera(COLUMNS, pixel_pitch=0.008, focal_length=ALTITUDE)
PLACES = ("east", "north", "ground_height", "view_zenith", "view_azimuth")


def steady(**pose: Any) -> xr.Dataset:
    # Return a line that flies north with pixels of 8 mm, whose `number` tells lines and columns
    line = flown(LINES, COLUMNS, **({"wobble": 0.15, "heading": 0.0} | pose)).drop_vars("counts")
    number = np.arange(LINES)[:, None] + np.arange(COLUMNS)[None, :] / 1000.0
    return line.assign(number=(("along_track", "cross_track"), number)).chunk(along_track=32)


def mapped(line: xr.Dataset, **options: Any) -> tuple[xr.Dataset, xr.Dataset]:
    # Return the located line, and its map, both computed, with what must be true of every one
    given: dict[str, Any] = {
        "ground": 0.0,
        "camera": CAMERA,
        "crs": UTM,
        "convention": LEFT_TO_RIGHT,
    } | options
    if "dem" in given:
        del given["ground"]
    located = hp.geometry.locate(line, **given)
    made = hp.geometry.orthorectify(
        located, variables=["number", "east", "north", "view_azimuth", "quality"], method="bilinear"
    ).compute()
    located = located.compute()
    lost = np.isnan(located.east.values)
    for name in PLACES:
        np.testing.assert_array_equal(np.isnan(located[name]), lost)
    np.testing.assert_array_equal(located.quality.values & OFF > 0, lost)
    shown = made.hits.values > 0
    for name in ("number", "glt_line", "view_azimuth"):
        np.testing.assert_array_equal(np.isfinite(made[name]), shown)
    np.testing.assert_array_equal(made.quality.values & OFF > 0, ~shown)
    assert not (shown & made.gap.values).any()
    # every cell has its own place, and the four pixels around it are placed, and near one another
    east, north = (made[f"{name}"].values[shown] for name in ("east", "north"))
    c, a, b, f, d, e = map(float, made.spatial_ref.attrs["GeoTransform"].split())
    row, col = (index[shown] + 0.5 for index in np.indices(shown.shape))
    away = np.hypot(c + a * col + b * row - east, f + d * col + e * row - north)
    assert away.max() <= 1e-3 * made.attrs["gsd"]
    low = [np.floor(made[name].values[shown]).astype(int) for name in ("glt_line", "glt_sample")]
    high = [np.ceil(made[name].values[shown]).astype(int) for name in ("glt_line", "glt_sample")]
    for i in (low[0], high[0]):
        for j in (low[1], high[1]):
            assert not lost[i, j].any()
            assert np.abs(located.east.values[i, j] - east).max() < 20 * made.attrs["gsd"]
    return located, made


def test_a_gap_of_the_navigation() -> None:
    line = steady()
    record = recorded(line.compute())
    bare = line.drop_vars(["latitude", "longitude", "altitude", "roll", "pitch", "heading"])
    located, made = mapped(bare, navigation=record.isel(navigation_time=np.r_[0:40, 80:LINES]), max_gap_s=0.1)
    np.testing.assert_array_equal(
        np.flatnonzero(np.isnan(located.east.values).all(axis=1)), np.arange(40, 80)
    )
    inside = made.hits.values == 0
    assert made.gap.values[made.sizes["y"] // 2].sum() > COLUMNS / 2
    assert not ((made.number.values > 39.5) & (made.number.values < 79.5))[~inside].any()
    # without a record's first and last lines there is nothing to extrapolate
    ends, _ = mapped(bare, navigation=record.isel(navigation_time=slice(10, 100)))
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(ends.east[:, 0])), np.r_[0:10, 100:LINES])


@pytest.mark.parametrize("name", ["latitude", "altitude", "roll", "pitch", "heading"])
def test_a_pose_that_is_half_known(name: str) -> None:
    line = steady().compute()
    line[name][[0, 7, 50, 51, LINES - 1]] = np.nan
    line[name][30] = np.inf
    for chunked in (line, line.chunk(along_track=32)):
        located, made = mapped(chunked)
        np.testing.assert_array_equal(
            np.flatnonzero(np.isnan(located.east.values).all(axis=1)), [0, 7, 30, 50, 51, LINES - 1]
        )
        assert made.gap.values.any()
    # one missing row of a record is between two known ones
    bare = line.drop_vars(["latitude", "longitude", "altitude", "roll", "pitch", "heading"])
    located, _ = mapped(bare, navigation=recorded(line))
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(located.east[:, 0])), [0, LINES - 1])


def test_attitudes_that_are_the_same_turn() -> None:
    # A full turn more or less, or pitch over the top, is the same attitude, also halfway between rows
    line = steady(heading=np.mod(0.5 * np.sin(np.arange(LINES)), 360.0)).compute()
    bare = line.drop_vars(["latitude", "longitude", "altitude", "roll", "pitch", "heading"])
    between = bare.assign_coords(time=bare.time + PERIOD / 2).isel(along_track=slice(0, -1))
    record = recorded(line)
    whole, expected = mapped(between, navigation=record)
    odd = np.arange(LINES) % 2 == 1
    turned = record.copy(deep=True)
    for name, change in (("roll", 180.0), ("heading", 180.0)):
        turned[name] = record[name] + np.where(odd, change, 0.0)
    turned["pitch"] = xr.where(odd, 180.0 - record["pitch"], record["pitch"]).assign_attrs(
        record["pitch"].attrs
    )
    wound = record.assign(
        {name: record[name] + 360.0 * ((np.arange(LINES) % 3) - 1) for name in ("roll", "pitch", "heading")}
    )
    for other in (turned, wound):
        for name in ("roll", "pitch", "heading"):
            other[name].attrs = dict(record[name].attrs)
        for interpolation in ("linear", "cubic"):
            located, made = mapped(between, navigation=other, interpolation=interpolation)
            limit = 1e-6 if interpolation == "linear" else 2e-3
            np.testing.assert_allclose(located.east, whole.east, rtol=0, atol=limit)
            np.testing.assert_allclose(located.north, whole.north, rtol=0, atol=limit)
            assert abs(int(made.hits.sum()) - int(expected.hits.sum())) < 0.02 * expected.hits.size


@pytest.mark.parametrize("course", [0.0, 180.0, 359.9])
def test_headings_that_wrap(course: float) -> None:
    swing = 0.4 * np.sin(np.arange(LINES) / 9.0)
    line = steady(heading=np.mod(course + swing, 360.0)).compute()
    signed = line.copy(deep=True)
    signed["heading"][:] = (line["heading"].values + 180.0) % 360.0 - 180.0
    half = PERIOD / 2
    names = ["latitude", "longitude", "altitude", "roll", "pitch", "heading"]
    between = line.drop_vars(names).assign_coords(time=line.time + half).isel(along_track=slice(0, -1))
    located, made = mapped(between, navigation=recorded(line))
    other, same = mapped(between, navigation=recorded(signed))
    np.testing.assert_allclose(located.east, other.east, rtol=0, atol=1e-7)
    assert not made.gap.values.any()
    assert (same.hits.values > 0).sum() == pytest.approx((made.hits.values > 0).sum(), rel=1e-3)
    # no line between two is swept right round
    steps = np.hypot(located.east.diff("along_track").values, located.north.diff("along_track").values)
    assert steps.max() < 0.05


def test_rays_above_the_horizon() -> None:
    roll = np.where((np.arange(LINES) >= 50) & (np.arange(LINES) < 70), 100.0, 0.0)
    roll[20] = 95.0
    located, made = mapped(steady(roll=roll))
    lost = np.isnan(located.east.values)
    assert (lost[50:70].all(), lost[20].all(), lost[[0, 19, 21, 49, 70]].any()) == (True, True, False)
    assert made.sizes["x"] < 2 * COLUMNS


def test_a_real_raster_with_holes() -> None:
    # Holes as rioxarray reads them, one inside, one at the edge, and a raster that ends under the line
    line = steady()
    flat, whole = mapped(line)
    x0, y0 = float(flat.east.min()), float(flat.north.max())
    size = 0.05
    heights = np.zeros((int((y0 - float(flat.north.min())) / size) + 20, 30), np.float32)
    heights[6:9, 8:11] = np.nan
    heights[12:14, :] = np.nan
    heights[20, 0] = np.nan
    dem = xr.DataArray(
        heights, {"y": y0 + 0.2 - size * np.arange(len(heights)), "x": x0 - 0.3 + size * np.arange(30)},
        ("y", "x"), attrs={"crs": UTM, "height_reference": "ellipsoid"},
    )  # fmt: skip
    located, made = mapped(line, dem=dem)
    lost = np.isnan(located.east.values)
    assert 0.05 < lost.mean() < 0.6
    # not a cell is shown where the raster knows nothing
    shown = made.hits.values > 0
    col = (made.east.values[shown] - float(dem.x[0])) / size
    row = (float(dem.y[0]) - made.north.values[shown]) / size
    near = dem.values[np.floor(row + 1e-3).astype(int), np.floor(col + 1e-3).astype(int)]
    corner = dem.values[np.ceil(row - 1e-3).astype(int), np.ceil(col - 1e-3).astype(int)]
    assert (np.isfinite(near).all(), np.isfinite(corner).all(), made.gap.values.any()) == (True, True, True)
    np.testing.assert_allclose(np.where(lost, np.nan, flat.east), located.east, rtol=0, atol=1e-6)
    # with the holes as a number, and in a leading band, as files have them
    again, same = mapped(
        line, dem=dem.fillna(-9999.0).expand_dims(band=[1]).assign_attrs(dem.attrs, _FillValue=-9999.0)
    )
    np.testing.assert_array_equal(again.east, located.east)
    np.testing.assert_array_equal(same.hits, made.hits)
    # a line that half leaves the raster
    part, _ = mapped(line, dem=dem.isel(y=slice(14, None)))
    assert 0.2 < np.isnan(part.east.values).mean() < 0.95
    assert whole.sizes["y"] > 0


@pytest.mark.parametrize("grid", ["flight", "north"])
@pytest.mark.parametrize("wobble", [0.15, 0.42])
def test_no_hole_inside_the_hull_that_is_not_a_gap(wobble: float, grid: Any) -> None:
    # The hull is drawn by shapely, of the lines' ends and all that lies between, and not by the kernel
    import shapely

    line = steady(wobble=wobble, heading=31.0 + 7.0 * wobble * np.sin(np.arange(LINES) / 11.0), seed=3)
    located = hp.geometry.locate(line, ground=0.0, camera=CAMERA, crs=UTM).compute()
    for lost in (range(0), range(50, 60)):
        placed = located.copy(deep=True)
        placed.east[list(lost)] = np.nan
        made = hp.geometry.orthorectify(placed, grid=grid, variables=["east"]).compute()
        known = np.isfinite(placed.east.values).all(axis=1)
        east, north = (placed[name].values[known] for name in ("east", "north"))
        outline = [(e[:-1, :-1], e[:-1, 1:], e[1:, 1:], e[1:, :-1]) for e in (east, north)]
        rings = np.stack([np.stack(part, axis=-1).reshape(-1, 4) for part in outline], axis=-1)
        hull = shapely.union_all(shapely.polygons(rings)).buffer(-1e-6)
        c, a, b, f, d, e = map(float, made.spatial_ref.attrs["GeoTransform"].split())
        row, col = (index + 0.5 for index in np.indices(made.hits.shape))
        inside = shapely.contains_xy(hull, c + a * col + b * row, f + d * col + e * row)
        empty = made.hits.values == 0
        assert inside.sum() > 1000
        assert not (inside & empty & ~made.gap.values).any()
        if not lost:
            assert (made.gap.values.any(), (inside & empty).any()) == (False, False)
            assert hp.geometry.map_report(made)["gaps"] == 0
        else:
            assert hp.geometry.map_report(made)["gaps"] > 60
            assert (inside & empty).sum() > 60
