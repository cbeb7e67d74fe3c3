"""Poses between the rows of a navigation record against scipy's, and what becomes of gaps."""

from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
import xarray as xr
from hypothesis import given, strategies as st
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline, Slerp
from support.geocentric_rays import LEFT_TO_RIGHT, PERIOD, START, UTM, flown, recorded
from support.refusals import expect_refusals

import hyperpaint as hp
from hyperpaint.base.attitude_conventions import Convention
from hyperpaint.base.errors import SchemaError, TimeError
from hyperpaint.geometry.georeference.locating import angles_of, matrices, quaternions, slerp

POSE = ("latitude", "longitude", "altitude", "roll", "pitch", "heading")
CANONICAL = Convention()
SECOND = np.timedelta64(1_000_000_000, "ns")


def record(rows: int = 60, period: float = 0.01, **fixed: Any) -> xr.Dataset:
    # Return a smooth record that turns through north
    t = np.arange(rows) * period
    values = {
        "latitude": 34 + 1e-5 * t, "longitude": -81 + 2e-5 * np.sin(t), "altitude": 15 + 0.2 * np.cos(3 * t),
        "roll": 4 * np.sin(7 * t), "pitch": 3 * np.cos(5 * t), "heading": np.mod(-2 + 20 * t, 360),
    } | {name: np.asarray(value, float) for name, value in fixed.items()}  # fmt: skip
    units = {"altitude": "m"}
    return xr.Dataset(
        {n: ("navigation_time", v, {"units": units.get(n, "degree")}) for n, v in values.items()},
        {"navigation_time": START + np.round(t * 1e9).astype("timedelta64[ns]")},
        CANONICAL.to_attrs(),
    )


def at(seconds: Any) -> xr.DataArray:
    return xr.DataArray(
        START + np.round(np.asarray(seconds, float) * 1e9).astype("timedelta64[ns]"), dims="along_track"
    )


def scipy_rotations(data: xr.Dataset) -> Rotation:
    return Rotation.from_euler(
        "ZYX", np.stack([data[n].values for n in ("heading", "pitch", "roll")], -1), degrees=True
    )


def turn_between(made: xr.Dataset, wanted: Rotation) -> np.ndarray:
    return np.degrees((scipy_rotations(made) * wanted.inv()).magnitude())


SECONDS = np.linspace(0.0, 0.58, 211)


def test_linear_poses_are_those_of_scipy() -> None:
    data = record()
    made = hp.geometry.interpolate_pose(data, at(SECONDS))
    knots = np.arange(60) * 0.01
    assert turn_between(made, Slerp(knots, scipy_rotations(data))(SECONDS)).max() < 1e-6
    for name in POSE[:3]:
        np.testing.assert_allclose(made[name], np.interp(SECONDS, knots, data[name]), rtol=0, atol=1e-9)
        assert made[name].dtype == np.float64
    assert ((made["heading"] >= 0).all(), (made["heading"] < 360).all()) == (True, True)


def test_cubic_poses_are_those_of_scipy() -> None:
    data = record(13, 0.05)
    made = hp.geometry.interpolate_pose(data, at(SECONDS), interpolation="cubic")
    knots = np.arange(13) * 0.05
    assert turn_between(made, RotationSpline(knots, scipy_rotations(data))(SECONDS)).max() < 1e-6
    np.testing.assert_allclose(made.altitude, CubicSpline(knots, data.altitude)(SECONDS), rtol=0, atol=1e-9)
    truth = record(584, 0.001)
    fine = truth.isel(navigation_time=slice(100, 500))  # away from the ends, where a spline is free
    times = at(np.arange(100, 500) * 0.001)
    errors = [
        turn_between(
            hp.geometry.interpolate_pose(data, times, interpolation=kind), scipy_rotations(fine)
        ).max()
        for kind in ("linear", "cubic")
    ]
    assert errors[1] < 0.2 * errors[0]


def test_quaternions_change_sign_without_harm() -> None:
    # the heading that jumps from 359 to 1 is a step of 2 degrees, the one from 179 to 181 too
    for before, after in ((359.0, 1.0), (179.0, 181.0), (-1.0, 1.0), (1.0, 359.0)):
        data = record(2, 0.1, roll=[0, 0], pitch=[0, 0], heading=[before, after])
        for kind in ("linear", "cubic"):
            made = hp.geometry.interpolate_pose(data, at([0.05]), interpolation=kind)
            gap = (float(made["heading"][0]) - before + 180) % 360 - 180
            assert abs(gap) == pytest.approx(1.0, abs=1e-9), (before, kind)
    data = record(2, 0.1, longitude=[179.9999, -179.9999])
    middle = hp.geometry.interpolate_pose(data, at([0.02, 0.05, 0.08])).longitude.values
    assert np.abs(np.abs(middle) - 180).max() < 1e-4


@given(st.lists(st.floats(-180, 180), min_size=6, max_size=6), st.floats(0, 1))
def test_rotations_are_those_of_scipy(angles: list[float], weight: float) -> None:
    ends = np.array(angles).reshape(2, 3)
    mine = quaternions(*ends.T)
    theirs = Rotation.from_euler("ZYX", ends[:, ::-1], degrees=True)
    np.testing.assert_allclose(matrices(mine), theirs.as_matrix(), rtol=0, atol=1e-12)
    between = slerp(mine[0], mine[1], np.float64(weight))
    arc = (theirs[0].inv() * theirs[1]).magnitude()
    if arc < np.pi - 1e-3:
        wanted = Slerp([0, 1], theirs)(weight).as_matrix()
        np.testing.assert_allclose(matrices(between), wanted, rtol=0, atol=1e-9)
        np.testing.assert_allclose(matrices(quaternions(*angles_of(between))), wanted, rtol=0, atol=1e-7)


def known(made: xr.Dataset) -> list[bool]:
    states = np.stack([np.isfinite(made[name]) for name in POSE])
    assert (states == states[0]).all()  # half a pose places nothing
    return [bool(state) for state in states[0]]


@pytest.mark.parametrize("kind", ["linear", "cubic"])
def test_nothing_is_extrapolated(kind: Any) -> None:
    assert known(
        hp.geometry.interpolate_pose(record(), at([-0.001, 0.0, 0.3, 0.59, 0.591]), interpolation=kind)
    ) == [False, True, True, True, False]
    times = at([0.1, 0.2])
    times[1] = np.datetime64("NaT", "ns")
    assert known(hp.geometry.interpolate_pose(record(), times, interpolation=kind)) == [True, False]


@pytest.mark.parametrize("kind", ["linear", "cubic"])
def test_gaps_are_not_bridged(kind: Any) -> None:
    data = record()
    rows = [*range(20), *range(35, 60)]  # 0.15 s are missing
    holed = data.isel(navigation_time=rows)
    seconds = [0.18, 0.19, 0.191, 0.3, 0.349, 0.35, 0.36]
    wanted = [True, True, False, False, False, True, True]
    assert known(hp.geometry.interpolate_pose(holed, at(seconds), interpolation=kind)) == wanted
    assert all(known(hp.geometry.interpolate_pose(holed, at(seconds), interpolation=kind, max_gap_s=0.2)))
    assert known(
        hp.geometry.interpolate_pose(data, at([0.005, 0.01]), interpolation=kind, max_gap_s=0.009)
    ) == [
        False,
        True,
    ]
    # a row without an attitude is missing for the attitude, one without a place for the place
    for name in ("pitch", "altitude"):
        lost = data.copy(deep=True)
        lost[name][20:35] = np.nan
        assert known(hp.geometry.interpolate_pose(lost, at(seconds), interpolation=kind)) == wanted
    lost["roll"][:] = np.nan
    assert not any(known(hp.geometry.interpolate_pose(lost, at(seconds), interpolation=kind)))
    # one that stands alone between two gaps holds at its own time
    lone = data.isel(navigation_time=[0, 1, 2, 25, 50, 51])
    made = hp.geometry.interpolate_pose(lone, at([0.25, 0.251, 0.505]), interpolation=kind)
    assert known(made) == [True, False, True]
    assert float(made.altitude[0]) == pytest.approx(float(data.altitude[25]), abs=1e-12)


def test_times_of_a_record() -> None:
    data = record(5)
    twice = xr.concat(
        [data.isel(navigation_time=[0, 1]), data.isel(navigation_time=[1, 2, 3])], "navigation_time"
    )
    made = hp.geometry.interpolate_pose(twice, at([0.015]))
    assert float(made.altitude[0]) == pytest.approx(float(data.altitude[1:3].mean()), abs=1e-12)
    backwards = data.isel(navigation_time=slice(None, None, -1))
    numbers = data.assign_coords(navigation_time=np.arange(5.0))
    expect_refusals(
        (TimeError, "time-backwards", "4 of 5", lambda: hp.geometry.interpolate_pose(backwards, at([0.0]))),
        (TimeError, "type-wrong", lambda: hp.geometry.interpolate_pose(numbers, at([0.0]))),
    )
    for kind in ("linear", "cubic"):
        one = data.isel(navigation_time=[2])
        made = hp.geometry.interpolate_pose(one, at([0.01, 0.02, 0.03]), interpolation=kind)  # type: ignore[arg-type]
        assert known(made) == [False, True, False]


def test_clock_offsets_shift_the_line() -> None:
    made = hp.geometry.interpolate_pose(record(), at(SECONDS[:100]), clock_offset_s=0.0375)
    wanted = hp.geometry.interpolate_pose(record(), at(SECONDS[:100] + 0.0375))
    for name in POSE:
        np.testing.assert_allclose(made[name], wanted[name], rtol=0, atol=1e-7)


# --- conventions -------------------------------------------------------------------------------------------

FOREIGN = {
    "roll": {"roll_positive": "right_wing_up"},
    "pitch": {"pitch_positive": "nose_down"},
    "heading": {"heading_positive": "counterclockwise"},
}


@pytest.mark.parametrize("name", FOREIGN)
def test_signs_of_makers(name: str) -> None:
    data = record()
    mirrored = data.assign({name: -data[name]})
    mirrored[name].attrs["units"] = "degree"
    made = hp.geometry.canonical_navigation(mirrored, convention=Convention(**FOREIGN[name]))
    for other in POSE:
        np.testing.assert_allclose(made[other], data[other], rtol=0, atol=1e-12)
    assert Convention.from_attrs(made.attrs) == CANONICAL


@pytest.mark.parametrize("order", ["ZXY", "XYZ"])
def test_orders_of_turning(order: Any) -> None:
    rng = np.random.default_rng(3)
    angles = {"X": rng.uniform(-30, 30, 50), "Y": rng.uniform(-30, 30, 50), "Z": rng.uniform(0, 360, 50)}
    wanted = Rotation.from_euler(order, np.stack([angles[axis] for axis in order], -1), degrees=True)
    made = Convention(euler_order=order).canonical(angles["X"], angles["Y"], angles["Z"])
    found = Rotation.from_euler("ZYX", np.stack(made[::-1], -1), degrees=True)
    assert np.degrees((found * wanted.inv()).magnitude()).max() < 1e-6
    assert np.abs(made[0] - angles["X"]).max() > 0.1


def test_units_references_and_heights() -> None:
    data = record(8)
    radians = data.copy(deep=True)
    for name in ("roll", "pitch", "heading"):
        radians[name] = np.radians(data[name]).assign_attrs(units="radian")
    made = hp.geometry.canonical_navigation(radians, convention=Convention(angle_unit="radian"))
    np.testing.assert_allclose(made["heading"], data["heading"], rtol=0, atol=1e-12)
    assert made["heading"].attrs["units"] == "degree"
    turned = hp.geometry.canonical_navigation(
        data, convention=Convention(heading_reference="magnetic", declination=-7.5)
    )["heading"]
    assert np.abs((turned - data["heading"] + 7.5 + 180) % 360 - 180).max() < 1e-9
    high = Convention(height_reference="geoid", geoid_undulation=-33.2)
    np.testing.assert_allclose(
        hp.geometry.canonical_navigation(data, convention=high).altitude, data.altitude - 33.2
    )
    undeclared, geoid = Convention(heading_reference="magnetic"), Convention(height_reference="geoid")
    canonical = hp.geometry.canonical_navigation
    expect_refusals(
        (SchemaError, ("units-conflict",) * 3, lambda: canonical(radians)),
        (SchemaError, "declination-missing", lambda: canonical(data, convention=undeclared)),
        (SchemaError, "undulation-missing", lambda: canonical(data, convention=geoid)),
    )


def test_headings_from_grid_north() -> None:
    data = record(8, longitude=np.full(8, -79.0))
    gamma = pyproj.Proj("EPSG:32617").get_factors(-79.0, 34.0).meridian_convergence
    assert gamma > 1.0
    for convention, crs in ((Convention(heading_reference="grid"), 32617),
                            (Convention(heading_reference="grid", grid_crs="EPSG:32617"), None)):  # fmt: skip
        made = hp.geometry.canonical_navigation(data, convention=convention, crs=crs)["heading"]
        assert np.abs((made - data["heading"] - gamma + 180) % 360 - 180).max() < 1e-5
    expect_refusals(
        (
            SchemaError,
            "grid-crs-missing",
            lambda: hp.geometry.canonical_navigation(data, convention=Convention(heading_reference="grid")),
        )
    )


def test_conventions_are_stored_with_the_data(tmp_path: Path) -> None:
    convention = Convention(
        roll_positive="right_wing_up", height_reference="geoid", geoid_undulation=-33, stamp_reference="end",
        column_order="right_to_left", grid_crs="EPSG:32617",
    )  # fmt: skip
    data = record(3).assign_attrs(convention.to_attrs())
    data.to_netcdf(tmp_path / "nav.nc", engine="h5netcdf")
    with xr.open_dataset(tmp_path / "nav.nc", engine="h5netcdf") as opened:
        assert Convention.from_attrs(opened.attrs) == convention
    data.to_zarr(tmp_path / "nav.zarr", zarr_format=3, consolidated=False)
    assert Convention.from_attrs(xr.open_zarr(tmp_path / "nav.zarr", consolidated=False).attrs) == convention
    assert Convention.from_attrs({"title": "x"}) is None
    wrong: dict[str, Any] = {"roll_positive": "up", "column_order": 3, "declination": np.nan}
    codes, words = (
        ("choice-unknown", "choice-unknown", "not-finite"),
        (f"{k}={v!r}" for k, v in wrong.items()),
    )
    expect_refusals((SchemaError, codes, *words, lambda: Convention(**wrong)))


@pytest.mark.real_data
def test_a_real_flight_with_every_other_row_left_out(shared_data: Path) -> None:
    rows = np.fromfile(shared_data / "nav" / "ang20170323t202244_eph_att", "<f8").reshape(-1, 7)
    time, lat, lon, alt, pitch, roll, heading = rows.T
    data = record(
        len(rows), 0.1, latitude=lat, longitude=lon, altitude=alt, roll=roll, pitch=pitch, heading=heading
    )
    data = data.assign_coords(navigation_time=at(time - time[0]).values)
    made = hp.geometry.interpolate_pose(
        data.isel(navigation_time=slice(0, None, 2)), at(time - time[0])[1:-1:2], max_gap_s=1
    )
    error = turn_between(made, scipy_rotations(data.isel(navigation_time=slice(1, -1, 2))))
    np.testing.assert_array_less([np.sqrt(np.mean(error**2)), error.max()], [0.006, 0.08])


# --- From poses to the map in one go, of flights that go wrong: nothing is smeared, nothing raises


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
