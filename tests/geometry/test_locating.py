"""Rays to level ground against geocentric space, signs by hand, and what `locate` promises of its result."""

import functools
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
import shapely
import xarray as xr
from scipy.spatial.transform import Rotation
from support.geocentric_rays import LEFT_TO_RIGHT, PERIOD, UTM, exact_places, flown, level, recorded
from support.refusals import expect_error, expect_refusals
from support.strategies import flight

import hyperpaint as hp
from hyperpaint.base.attitude_conventions import Convention
from hyperpaint.base.errors import MissingExtraError, PaintWarning, SchemaError, TimeError
from hyperpaint.base.schema import VARIABLES, Quality
from hyperpaint.geometry.georeference.locating import meridian_convergence, utm_zone
from hyperpaint.regions import pixels

PLACES = ("east", "north", "ground_height", "view_zenith", "view_azimuth")
CAMERA = hp.geometry.PinholeCamera(5, field_of_view=40.0, edges="centres")
TANGENTS = np.column_stack([np.zeros(5), np.linspace(-1, 1, 5) * np.tan(np.radians(20.0))])


def still(**pose: float) -> xr.Dataset:
    return flown(1, 5, **({"roll": 0, "pitch": 0, "heading": 0, "altitude": 100.0} | pose))


def offsets(line: xr.Dataset, **options: Any) -> tuple[np.ndarray, np.ndarray]:
    # Return how far pixels are to the true east and north of the camera, with the map turned back
    made = hp.geometry.locate(line, ground=0.0, crs=UTM, camera=CAMERA, **options)
    lat, lon = float(line.latitude[0]), float(line.longitude[0])
    x, y = pyproj.Transformer.from_crs("EPSG:4326", UTM, always_xy=True).transform(lon, lat)
    factors = pyproj.Proj(UTM).get_factors(lon, lat)
    turn = np.radians(factors.meridian_convergence)
    scale = factors.meridional_scale
    e, n = (made.east.values[0] - x) / scale, (made.north.values[0] - y) / scale
    return e * np.cos(turn) + n * np.sin(turn), n * np.cos(turn) - e * np.sin(turn)


# --- physics -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("altitude", "limit"), [(15.24, 1e-8), (120.0, 1e-7), (5000.0, 5e-3)])
@pytest.mark.parametrize(
    ("latitude", "longitude"), [(34.0, -80.2), (-33.0, -78.1), (69.0, -83.4), (0.0, -81.0)]
)
def test_rays_end_where_those_of_geocentric_space_end(
    altitude: float, limit: float, latitude: float, longitude: float
) -> None:
    rng = np.random.default_rng(1)
    line = flown(
        30, 5, altitude=altitude, latitude=latitude + rng.uniform(-0.01, 0.01, 30),
        longitude=longitude + rng.uniform(-0.01, 0.01, 30), roll=rng.uniform(-15, 15, 30),
        pitch=rng.uniform(-15, 15, 30), heading=rng.uniform(0, 360, 30),
    )  # fmt: skip
    mounting = {"boresight": (0.4, -0.6, 0.8), "lever_arm": (0.05, -0.02, 0.12)}
    made = hp.geometry.locate(line, ground=2.0, crs=UTM, camera=CAMERA, **mounting)
    wanted = exact_places(line, TANGENTS, level(2.0), farthest=3 * altitude, **mounting)
    for name in ("east", "north", "ground_height"):
        np.testing.assert_allclose(made[name], wanted[name], rtol=0, atol=max(limit, 3e-9))
    np.testing.assert_allclose(made.view_zenith, wanted["view_zenith"], rtol=0, atol=1e-7 + 1e-2 * limit)
    turned = (made.view_azimuth.values - wanted["view_azimuth"] + 180.0) % 360.0 - 180.0
    assert np.abs(turned * np.sin(np.radians(wanted["view_zenith"]))).max() < 1e-7 + 1e-2 * limit


def test_signs_by_hand() -> None:
    tan10, tan20 = np.tan(np.radians([10.0, 20.0]))
    east, north = offsets(still())
    np.testing.assert_allclose(east[[0, 2, 4]], [-100 * tan20, 0, 100 * tan20], atol=1e-3)
    np.testing.assert_allclose(north, 0, atol=1e-3)
    east, north = offsets(still(roll=10.0))  # right wing down: to the left
    assert east[2] == pytest.approx(-100 * tan10, abs=1e-3)
    east, north = offsets(still(pitch=10.0))  # nose up: forward
    assert north[2] == pytest.approx(100 * tan10, abs=1e-3)
    east, north = offsets(still(heading=90.0, pitch=10.0))
    assert (east[2], north[2]) == pytest.approx((100 * tan10, 0), abs=1e-3)
    assert north[4] < -30  # flying east, the right is south
    east, north = offsets(still(), convention=LEFT_TO_RIGHT.replace(column_order="right_to_left"))
    assert east[0] == pytest.approx(100 * tan20, abs=1e-3)


def test_boresight_and_lever_arm_by_hand() -> None:
    east, north = offsets(still(heading=90.0), lever_arm=(3.0, 2.0, 10.0))
    # forward is east, right is south, and 10 m lower the swath is narrower
    assert (east[2], north[2]) == pytest.approx((3.0, -2.0), abs=1e-3)
    assert north[0] + 2.0 == pytest.approx(90 * np.tan(np.radians(20.0)), abs=1e-3)
    # a rotation, not a sum of angles: flying tilted by 30 degrees the two differ
    turned = Rotation.from_euler("ZYX", [20, 10, 30], degrees=True) * Rotation.from_euler(
        "ZYX", [3, 2, 1], degrees=True
    )
    heading, pitch, roll = turned.as_euler("ZYX", degrees=True)
    tilted = offsets(still(heading=20, pitch=10, roll=30), boresight=(1.0, 2.0, 3.0))
    np.testing.assert_allclose(tilted, offsets(still(heading=heading, pitch=pitch, roll=roll)), atol=1e-9)
    assert np.abs(tilted[0] - offsets(still(heading=23, pitch=12, roll=31))[0]).max() > 0.1


def test_map_north_and_scale() -> None:
    # G4
    rng = np.random.default_rng(2)
    lat, lon, heading = rng.uniform(-75, 75, 50), rng.uniform(-84, -78, 50), rng.uniform(0, 360, 50)
    gamma = pyproj.Proj(UTM).get_factors(lon, lat).meridian_convergence
    found = heading - meridian_convergence(lat, lon, UTM)
    assert np.abs((found - heading + gamma + 180) % 360 - 180).max() < 1e-6
    np.testing.assert_allclose(
        gamma, np.degrees(np.arctan(np.tan(np.radians(lon + 81)) * np.sin(np.radians(lat)))), atol=1e-3
    )
    # pixels of a line that flies to true north lie, on the map, across its grid heading
    line = flown(50, 5, roll=0, pitch=0, heading=heading, latitude=lat, longitude=lon)
    made = hp.geometry.locate(line, ground=0.0, crs=UTM, camera=CAMERA)
    across = np.degrees(np.arctan2(made.east[:, 4] - made.east[:, 0], made.north[:, 4] - made.north[:, 0]))
    assert np.abs((across.values - found - 90 + 180) % 360 - 180).max() < 1e-4
    for stretched in ("EPSG:3857", "EPSG:32612"):
        with pytest.warns(PaintWarning, match="crs-distorted"):
            hp.geometry.locate(flown(5, 5), ground=0.0, crs=stretched, camera=CAMERA)
    # and 1 km on the ground is 1 km less the map's scale; back to degrees within 1 mm
    geod = pyproj.Geod(ellps="WGS84")
    far_lon, far_lat, _ = geod.fwd([-80.2], [34.0], [37.0], [1000.0])
    ends = flown(2, 1, roll=0, pitch=0, heading=0, latitude=[34.0, far_lat[0]], longitude=[-80.2, far_lon[0]])
    made = hp.geometry.locate(
        ends, ground=0.0, crs=UTM, camera=hp.geometry.PinholeCamera(1, field_of_view=1.0, edges="outer")
    )
    back = pyproj.Transformer.from_crs(UTM, "EPSG:4326", always_xy=True).transform(made.east, made.north)
    _, _, distance = geod.inv(back[0][0], back[1][0], back[0][1], back[1][1])
    assert distance[0] == pytest.approx(1000.0, abs=1e-3)
    step = np.hypot(np.diff(made.east[:, 0]), np.diff(made.north[:, 0]))[0]
    assert step / 1000.0 == pytest.approx(
        pyproj.Proj(UTM).get_factors(-80.2, 34.0).meridional_scale, abs=1e-5
    )


def test_the_antimeridian_and_southern_zones() -> None:
    line = flown(4, 5, longitude=[179.9999, 179.99999, -179.99999, -179.9999], latitude=-17.0)
    made = hp.geometry.locate(line, ground=0.0, camera=CAMERA)
    assert made.east.attrs["crs"] in ("EPSG:32760", "EPSG:32701")
    assert (np.isfinite(made.east).all(), utm_zone(-17.0, 180.0)) == (True, "EPSG:32701")
    assert np.abs(made.north - made.north[0, 2]).max() < 100
    assert (utm_zone(78.0, 20.0), utm_zone(60.0, 3.5)) == ("EPSG:32633", "EPSG:32632")
    expect_refusals((SchemaError, "crs-missing", lambda: utm_zone(85.0, 0.0)))


def test_what_a_line_declares_stands_for_what_is_not_asked() -> None:
    line = still(roll=1.0, pitch=2.0, heading=30.0)
    turn, arm = (0.5, -0.3, 1.0), (0.2, 0.1, -0.4)
    asked = hp.geometry.locate(line, ground=20.0, boresight=turn, lever_arm=arm, camera=CAMERA)
    declaring = line.assign_attrs(ground=20.0, boresight=list(turn), lever_arm=list(arm))
    made = hp.geometry.locate(declaring, camera=CAMERA)
    assert made.attrs["location_from"] == asked.attrs["location_from"].replace("as passed", "of the line")
    xr.testing.assert_identical(made.assign_attrs(location_from=""), asked.assign_attrs(location_from=""))
    # what is asked for wins, a height model over a level ground too
    other = hp.geometry.locate(declaring, ground=0.0, boresight=(0, 0, 0), lever_arm=(0, 0, 0), camera=CAMERA)
    bare = hp.geometry.locate(line, ground=0.0, camera=CAMERA)
    assert "boresight 0 0 0 degrees assumed" in bare.attrs["location_from"]
    xr.testing.assert_identical(other.assign_attrs(location_from=""), bare.assign_attrs(location_from=""))
    expect_refusals(
        (
            SchemaError,
            "not-finite",
            lambda: hp.geometry.locate(line.assign_attrs(ground="low"), camera=CAMERA),
        )
    )


def test_tables_of_look_angles() -> None:
    line = flown(6, 5)
    across, along = np.array([-20.0, -9.0, 0.5, 11.0, 21.0]), np.array([0.1, 0.0, -0.1, 0.0, 0.2])
    unit = {"units": "degree"}
    table = xr.Dataset(
        {"look_across": ("cross_track", across, unit), "look_along": ("cross_track", along, unit)}
    )
    tangents = np.tan(np.radians(np.column_stack([along, across])))
    wanted = exact_places(line, tangents, level(1.0))
    for made in (
        hp.geometry.locate(line, ground=1.0, crs=UTM, camera=table),
        hp.geometry.locate(line.assign(table), ground=1.0, crs=UTM),
    ):
        np.testing.assert_allclose(made.east, wanted["east"], rtol=0, atol=1e-8)
        np.testing.assert_allclose(made.north, wanted["north"], rtol=0, atol=1e-8)
    # the angles that come with a calibration, in radians, need no order of columns
    line.attrs = Convention().to_attrs()
    made = hp.geometry.locate(
        line.assign(look_angle=("cross_track", np.radians(across), {"units": "radian"})), ground=1.0, crs=UTM
    )
    tangents[:, 0] = 0.0
    np.testing.assert_allclose(made.east, exact_places(line, tangents, level(1.0))["east"], rtol=0, atol=1e-8)


def test_pinholes_by_hand() -> None:
    outer = hp.geometry.PinholeCamera(640, field_of_view=40.0, edges="outer")
    centres = hp.geometry.PinholeCamera(640, field_of_view=40.0, edges="centres")
    assert centres.spacing / outer.spacing == pytest.approx(640 / 639)
    assert centres.look_across("left_to_right")[[0, -1]] == pytest.approx([-20, 20])
    lens = hp.geometry.PinholeCamera(4, pixel_pitch=7.4e-6, focal_length=12e-3)
    tangent = np.tan(np.radians(lens.look_across("right_to_left")))
    assert tangent == pytest.approx(np.array([1.5, 0.5, -0.5, -1.5]) * 7.4e-6 / 12e-3)
    both = ("value-out-of-range", "option-conflict")
    expect_refusals(
        (SchemaError, "choice-unknown", lambda: hp.geometry.PinholeCamera(4, field_of_view=40.0)),
        (SchemaError, both, lambda: hp.geometry.PinholeCamera(0, pixel_pitch=7.4e-6)),
    )


# --- what has no place -------------------------------------------------------------------------------------


def test_rays_to_the_horizon_and_lines_without_a_pose() -> None:
    line = flown(5, 5, roll=[0.0, 69.5, 70.5, 110.0, 180.0], pitch=0, heading=0)
    made = hp.geometry.locate(line, ground=0.0, crs=UTM, camera=CAMERA).compute()
    # column 0 looks 20 degrees to the left, roll turns it further
    assert np.isfinite(made.east[:, 0]).values.tolist() == [True, True, False, False, False]
    assert np.isfinite(made.east[:, 4]).values.tolist() == [True, True, True, False, False]
    for name in PLACES:
        np.testing.assert_array_equal(np.isnan(made[name]), np.isnan(made.east))
    np.testing.assert_array_equal((made.quality & Quality.OFF_SWATH) > 0, np.isnan(made.east))
    with pytest.warns(PaintWarning, match="ground-not-seen"):  # underground
        assert np.isnan(hp.geometry.locate(line, ground=16.0, crs=UTM, camera=CAMERA).east).all()
    # lines without a pose
    line = flown(6, 5)
    line["roll"][1] = np.nan
    line["latitude"][2] = np.nan
    line["altitude"][4] = np.inf
    line["quality"] = (("along_track", "cross_track"), np.full((6, 5), 3, np.uint16))
    made = hp.geometry.locate(line, ground=0.0, crs=UTM, camera=CAMERA).compute()
    lost = np.array([False, True, True, False, True, False])
    for name in PLACES:
        np.testing.assert_array_equal(np.isnan(made[name]).all("cross_track"), lost)
        np.testing.assert_array_equal(np.isnan(made[name]).any("cross_track"), lost)
    np.testing.assert_array_equal(made.quality[:, 0], np.where(lost, 1027, 3))
    for name in ("latitude", "roll", "heading"):
        np.testing.assert_array_equal(np.isnan(made[name]), lost)


# --- what it promises --------------------------------------------------------------------------------------


def test_names_units_and_dtypes(tmp_path: Path) -> None:
    line = flown(40, 5)
    made = hp.geometry.locate(line, ground=0.0, camera=CAMERA, lever_arm=(0, 0, 1), clock_offset_s=0.0)
    for state in (made, made.compute()):
        for name in PLACES:
            assert (state[name].dtype, state[name].dims) == (np.float64, ("along_track", "cross_track"))
            assert state[name].attrs["units"] == VARIABLES[name].units
            assert (state[name].attrs["grid_mapping"], name in state.coords) == ("spatial_ref", True)
        assert state.quality.dtype == np.uint16
        assert state.spatial_ref.attrs["grid_mapping_name"] == "transverse_mercator"
        assert (state.east.attrs["crs"], state.attrs["ground"]) == (UTM, 0.0)
        assert state.attrs["lever_arm"] == [0.0, 0.0, 1.0]
        assert Convention.from_attrs(state.attrs) == LEFT_TO_RIGHT
    assert set(line.coords) <= set(made.coords)
    xr.testing.assert_identical(made.counts.drop_vars(made.coords), line.counts.drop_vars(line.coords))
    xr.testing.assert_identical(line.paint.locate(ground=0.0, camera=CAMERA, lever_arm=(0, 0, 1)), made)
    # and survive a store
    hp.to_store(made, tmp_path / "lot.zarr", "flightlines/raw_0")
    opened = xr.open_zarr(tmp_path / "lot.zarr", group="flightlines/raw_0")
    np.testing.assert_array_equal(opened.east, made.east)
    assert (Convention.from_attrs(opened.attrs), opened.east.attrs["crs"]) == (LEFT_TO_RIGHT, UTM)


def test_nothing_is_computed_until_asked(no_compute: Callable[[], Any]) -> None:
    line = flown(70, 5).chunk(along_track=32)
    assert line["roll"].chunks is not None
    record = recorded(flown(70, 5)).chunk()
    with no_compute():
        own = hp.geometry.locate(line, ground=0.0, crs=UTM, camera=CAMERA)
        nav = hp.geometry.locate(line, navigation=record, ground=0.0, crs=UTM, camera=CAMERA,
                        convention=LEFT_TO_RIGHT)  # fmt: skip
        assert own.chunks["along_track"] == (32, 32, 6)
        eager = hp.geometry.locate(flown(70, 5), ground=0.0, camera=CAMERA)
        assert eager.east.chunks is not None
    np.testing.assert_array_equal(own.east, eager.east)
    np.testing.assert_allclose(nav.east, eager.east, rtol=0, atol=1e-8)


@pytest.mark.parametrize("dem", [False, True])
@pytest.mark.slow
def test_no_bit_depends_on_chunks(dem: bool) -> None:
    line = flown(61, 5)
    if dem:
        x, y = 573_700 + np.arange(400) * 0.5, 3_762_300 + np.arange(400) * 0.5
        made = hp.geometry.locate(line, ground=0.0, crs=UTM, camera=CAMERA)
        x, y = x - x.mean() + float(made.east.mean()), y - y.mean() + float(made.north.mean())
        heights = np.random.default_rng(0).uniform(0, 2, (400, 400))
        attrs = {"crs": UTM, "height_reference": "ellipsoid"}
        ground: dict[str, Any] = {"dem": xr.DataArray(heights, {"y": y, "x": x}, ("y", "x"), attrs=attrs)}
    else:
        ground = {"ground": 0.0}
    whole = hp.geometry.locate(line.chunk(along_track=-1), crs=UTM, camera=CAMERA, **ground).compute()
    assert np.isfinite(whole.east).all()
    for chunks in (1, 7, (20, 1, 40)):
        parts = hp.geometry.locate(line.chunk(along_track=chunks), crs=UTM, camera=CAMERA, **ground).compute()
        for name in (*PLACES, "quality", "roll"):
            np.testing.assert_array_equal(whole[name], parts[name])
    single = hp.geometry.locate(line.isel(along_track=slice(17, 18)), crs=UTM, camera=CAMERA, **ground)
    np.testing.assert_array_equal(whole.east[17:18], single.east)


def test_it_may_be_located_again() -> None:
    line = flown(20, 5)
    line["roll"] = -line["roll"]
    line["roll"].attrs["units"] = "degree"
    once = hp.geometry.locate(
        line, ground=0.0, camera=CAMERA, convention=LEFT_TO_RIGHT.replace(roll_positive="right_wing_up")
    )
    np.testing.assert_array_equal(once.east, hp.geometry.locate(flown(20, 5), ground=0.0, camera=CAMERA).east)
    again = hp.geometry.locate(once, ground=0.0, camera=CAMERA)
    np.testing.assert_allclose(again.east, once.east, rtol=0, atol=1e-9)
    np.testing.assert_allclose(again["roll"], flown(20, 5)["roll"], rtol=0, atol=1e-12)


def test_other_navigation_than_the_line_knows() -> None:
    line = flown(60, 5)
    bare = line.drop_vars(["latitude", "longitude", "altitude", "roll", "pitch", "heading"])
    record = recorded(line)
    made = hp.geometry.locate(bare, navigation=record, ground=0.0, camera=CAMERA)
    np.testing.assert_allclose(
        made.east, hp.geometry.locate(line, ground=0.0, camera=CAMERA).east, rtol=0, atol=1e-8
    )
    # the clock of the navigation is three lines ahead
    late = record.assign_coords(navigation_time=record.navigation_time.values + 3 * PERIOD)
    shifted = hp.geometry.locate(bare, navigation=late, ground=0.0, camera=CAMERA, clock_offset_s=0.021)
    np.testing.assert_allclose(shifted.east, made.east, rtol=0, atol=1e-8)
    # the same of the line's own poses: what is outside them has no place
    own = hp.geometry.locate(line, ground=0.0, camera=CAMERA, clock_offset_s=0.021)
    np.testing.assert_allclose(own.east[:-3], made.east[3:], rtol=0, atol=1e-8)
    assert np.isnan(own.east[-3:]).all()


# --- refusals ----------------------------------------------------------------------------------------------


def test_what_cannot_be_is_said_at_once() -> None:
    line = flown(4, 5)
    bare = line.assign_attrs()
    bare.attrs = {}
    wrong = line.drop_vars("roll").copy(deep=True)
    wrong["pitch"].attrs["units"] = "radian"
    lost = line.copy(deep=True)
    lost["roll"][:] = np.nan
    columns = np.arange(5)
    table = xr.Dataset({"look_across": ("cross_track", columns / 2.0, {"units": "degree"})})
    table = table.assign_coords(cross_track=columns + 5)
    four = hp.geometry.PinholeCamera(4, field_of_view=9.0, edges="outer")
    record = recorded(line).isel(navigation_time=[0, 2, 1, 3])
    numbers: dict[str, Any] = {"boresight": (1, 2), "lever_arm": (np.nan, 0, 0), "clock_offset_s": np.inf}
    level_ground: dict[str, Any] = {"ground": 0.0, "camera": CAMERA}
    for refused, options, error, codes in (
        (line, numbers, SchemaError, ("type-wrong", "type-wrong", "argument-missing", "not-finite")),
        (bare, level_ground, SchemaError, ("convention-missing",)),
        (bare, {**level_ground, "convention": Convention()}, SchemaError, ("column-order-missing",)),
        (line, {**level_ground, "camera": four}, SchemaError, ("length-mismatch",) * 2),
        (
            line.assign_coords(cross_track=columns),
            {"ground": 0.0, "camera": table},
            SchemaError,
            ("grid-mismatch",),
        ),
        (line, {"ground": 0.0}, SchemaError, ("camera-missing",)),
        (wrong, level_ground, SchemaError, ("variable-missing", "units-conflict")),
        (line, {**level_ground, "crs": "EPSG:nothing"}, SchemaError, ("crs-unknown",)),
        (line, {**level_ground, "crs": "EPSG:4326"}, SchemaError, ("crs-unusable",)),
        (lost, level_ground, SchemaError, ("pose-missing",)),
        (line, {**level_ground, "interpolation": "quintic"}, SchemaError, ("choice-unknown",)),
        (line, {**level_ground, "navigation": record}, TimeError, ("time-backwards",)),
    ):
        expect_refusals((error, codes, functools.partial(hp.geometry.locate, refused, **options)))


def test_a_missing_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyproj", None)
    expect_error(
        MissingExtraError,
        r"\[geo\].*extra-missing",
        lambda: hp.geometry.locate(flown(4, 5), ground=0.0, camera=CAMERA, crs="EPSG:32618"),
    )
    monkeypatch.setitem(sys.modules, "shapely", None)
    expect_error(MissingExtraError, r"\[geo\].*extra-missing", lambda: hp.geometry.footprint(xr.Dataset()))


# --- coverage ----------------------------------------------------------------------------------------------


def test_spacing_by_hand() -> None:
    line = flown(11, 5, roll=0, pitch=0, heading=0, altitude=10.0)
    made = hp.geometry.spacing(hp.geometry.locate(line, ground=0.0, camera=CAMERA))
    scale = pyproj.Proj(UTM).get_factors(-80.2, 34.0).meridional_scale
    assert made["across"] == pytest.approx(scale * 5 * np.tan(np.radians(20.0)), rel=1e-4)
    assert (made["along"], made["gsd"]) == (pytest.approx(1.14 * 0.007, rel=2e-3), made["across"])
    assert made["reversed"] == made["off_swath"] == 0.0
    nodding = line.assign(pitch=("along_track", [0, 3] * 5 + [0], {"units": "degree"}))
    assert hp.geometry.spacing(hp.geometry.locate(nodding, ground=0.0, camera=CAMERA))[
        "reversed"
    ] == pytest.approx(0.5)
    expect_error(SchemaError, "'east' is missing", lambda: hp.geometry.spacing(line))


def test_footprints() -> None:
    line = flown(200, 5, altitude=10.0, roll=0, pitch=0, heading=5)
    located = hp.geometry.locate(line, ground=0.0, camera=CAMERA)
    outline = hp.geometry.footprint(located, crs=UTM)
    shape = shapely.from_geojson(json.dumps(outline["geometry"]))
    assert shape.is_valid
    assert shape.geom_type == "Polygon"
    width, length = 2 * 10 * np.tan(np.radians(20.0)), 199 * 0.007 * 1.14
    assert outline["properties"]["area"] == pytest.approx(width * length, rel=0.02)
    inside = shapely.contains_xy(
        shape.buffer(0.01), located.east.values.ravel(), located.north.values.ravel()
    )
    assert inside.mean() > 0.99
    lon, lat = np.array(hp.geometry.footprint(located)["geometry"]["coordinates"][0]).mean(axis=0)
    assert (lon, lat) == pytest.approx((-80.2, 34.0), abs=1e-4)
    line["roll"][90:110] = np.nan
    parted = hp.geometry.footprint(hp.geometry.locate(line, ground=0.0, camera=CAMERA))
    assert (parted["geometry"]["type"], parted["properties"]["lines"]) == ("MultiPolygon", 180)
    expect_refusals(
        (SchemaError, "ground-not-seen", lambda: hp.geometry.footprint(located.isel(along_track=[0])))
    )
    # across the dateline it has two parts
    line = flown(200, 5, altitude=10.0, roll=0, pitch=0, heading=5)
    middle = float(line["longitude"].mean())
    line["longitude"] = line["longitude"] - middle + 180.0
    line["longitude"] = (line["longitude"] + 180.0) % 360.0 - 180.0
    parts = hp.geometry.footprint(hp.geometry.locate(line, ground=0.0, camera=CAMERA))["geometry"]
    assert parts["type"] == "MultiPolygon"
    spans = [np.ptp(np.array(rings[0])[:, 0]) for rings in parts["coordinates"]]
    assert len(spans) == 2
    assert max(spans) < 1e-3


# --- A located line in the hands of the rest of the package: reflectance, regions of the map, signatures ---


POSE = ("latitude", "longitude", "altitude", "roll", "pitch", "heading")
CAMERA_LINES = hp.geometry.PinholeCamera(6, field_of_view=40.0, edges="centres")


def line_with_poses() -> xr.Dataset:
    line = flight().line
    poses = flown(line.sizes["along_track"], 6, wobble=0.05)
    made = line.assign_coords({name: poses[name].variable for name in POSE})
    made["roll"][3] = np.nan
    return made.assign_attrs(LEFT_TO_RIGHT.to_attrs())


def test_reflectance_and_place_in_either_order() -> None:
    line = line_with_poses()
    before = line.paint.locate(ground=0.0, camera=CAMERA_LINES).paint.reflectance()
    after = line.paint.reflectance().paint.locate(ground=0.0, camera=CAMERA_LINES)
    for made in (before, after):
        assert (made.quality.values[3] & hp.Quality.OFF_SWATH == hp.Quality.OFF_SWATH).all()
        assert not (np.delete(made.quality.values, 3, axis=0) & hp.Quality.OFF_SWATH).any()
    for name in ("reflectance", "quality", "east", "view_zenith"):
        np.testing.assert_array_equal(before[name], after[name])
    np.testing.assert_array_equal(before.reflectance, line.paint.reflectance().reflectance)


def test_regions_of_the_map_find_their_pixels() -> None:
    located = line_with_poses().paint.locate(ground=0.0, camera=CAMERA_LINES).paint.reflectance()
    east, north = located.east.values, located.north.values
    corner = (east[10, 2], north[10, 2])
    region = hp.Region(
        "panel", [(corner[0] + a, corner[1] + b) for a, b in ((-1, -0.03), (1, -0.03), (1, 0.03), (-1, 0.03))]
    )
    along, across = pixels(region, located, coordinates="map", crs=UTM)
    inside = (np.abs(east - corner[0]) <= 1) & (np.abs(north - corner[1]) <= 0.03)
    assert inside[10, 2]
    np.testing.assert_array_equal(np.stack([along, across]), np.stack(np.nonzero(inside)))
    assert 3 not in along
    paints = hp.extract_signatures(located, hp.Regions((region,), "map", UTM))
    assert int(paints.n[0]) == inside.sum()
    assert paints.attrs["view_geometry"] == "view_zenith and view_azimuth of the pixels"
    np.testing.assert_allclose(paints.view_zenith[0], located.view_zenith.values[inside].mean(), atol=0.2)
