"""Rays to rasters of heights: planes, an independent march in small steps, what is hidden, and holes."""

import functools
from typing import Any

import numpy as np
import pyproj
import pytest
import xarray as xr
from scipy.ndimage import map_coordinates
from support.geocentric_rays import UTM, exact_places, flown
from support.refusals import expect_refusals

import hyperpaint as hp
from hyperpaint.base.errors import PaintError, PaintWarning, SchemaError
from hyperpaint.base.facts import plain
from hyperpaint.base.schema import Quality
from hyperpaint.geometry.georeference.locating import grid_of, terrain_of

COLUMNS = 21
CAMERA = hp.geometry.PinholeCamera(COLUMNS, field_of_view=60.0, edges="centres")
TANGENTS = np.column_stack([np.zeros(COLUMNS), np.linspace(-1, 1, COLUMNS) * np.tan(np.radians(30.0))])
TO_UTM = pyproj.Transformer.from_crs("EPSG:4326", UTM, always_xy=True)
CENTRE = np.array(TO_UTM.transform(-80.2, 34.0))
LEVEL = {"roll": 0.0, "pitch": 0.0, "heading": 0.0}


def dem(heights: np.ndarray, cell: float = 0.25, **attrs: Any) -> xr.DataArray:
    # Return a raster around the place where `flown` lines start, rows from north to south
    rows, cols = heights.shape
    y = CENTRE[1] + ((rows - 1) / 2 - np.arange(rows)) * cell
    x = CENTRE[0] + (np.arange(cols) - (cols - 1) / 2) * cell
    told = {"crs": UTM, "height_reference": "ellipsoid"} | attrs
    return xr.DataArray(
        heights, {"y": y, "x": x}, ("y", "x"), attrs={k: v for k, v in told.items() if v is not None}
    )


def surface(raster: xr.DataArray) -> Any:
    # Return the bilinear surface through a raster over longitude and latitude
    def height(longitude: np.ndarray, latitude: np.ndarray) -> np.ndarray:
        x, y = TO_UTM.transform(longitude, latitude)
        step_x, step_y = (float(raster[name][1] - raster[name][0]) for name in ("x", "y"))
        at = [(y - float(raster.y[0])) / step_y, (x - float(raster.x[0])) / step_x]
        return map_coordinates(raster.values, at, order=1, mode="nearest")

    return height


def test_hits_lie_on_the_surface_and_nothing_is_in_the_way() -> None:
    rng = np.random.default_rng(0)
    heights = rng.uniform(0, 1.5, (160, 160))
    heights[70:90, 40:60] += 3.0
    raster = dem(heights)
    line = flown(40, COLUMNS, wobble=8.0, heading=rng.uniform(0, 360, 40))
    made = hp.geometry.locate(line, dem=raster, crs=UTM, camera=CAMERA).compute()
    assert np.isfinite(made.east).all()
    # on the bilinear surface
    lon, lat = pyproj.Transformer.from_crs(UTM, "EPSG:4326", always_xy=True).transform(
        made.east.values, made.north.values
    )
    assert np.abs(surface(raster)(lon, lat) - made.ground_height).max() < 2e-7
    # on the ray: bent to end on a level at the height of the hit, it ends there
    flat = exact_places(line, TANGENTS, lambda *_: made.ground_height.values)
    assert np.abs(flat["east"] - made.east).max() < 1e-7
    assert np.abs(flat["north"] - made.north).max() < 1e-7
    # and free all the way from the camera: on 2,000 points nothing stands above it
    x0, y0 = TO_UTM.transform(line.longitude.values, line.latitude.values)
    for part in np.linspace(0.0, 0.9999, 2000):
        x = x0[:, None] + part * (made.east.values - x0[:, None])
        y = y0[:, None] + part * (made.north.values - y0[:, None])
        z = 15.24 + part * (made.ground_height.values - 15.24)
        at = [(y - float(raster.y[0])) / -0.25, (x - float(raster.x[0])) / 0.25]
        assert (z - map_coordinates(heights, at, order=1) > -1e-6).all()


@pytest.mark.parametrize("crs", [UTM, "EPSG:32618", "EPSG:4326"])
def test_a_raster_on_another_map(crs: str) -> None:
    # a slope that is a plane on the raster's own map
    line = flown(12, COLUMNS)
    x0, y0 = pyproj.Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(-80.2, 34.0)
    cell = 0.5 if crs != "EPSG:4326" else 5e-6
    x, y = x0 + (np.arange(101) - 50) * cell, y0 + (np.arange(101) - 50) * cell
    slope = 0.05 / (1.0 if crs != "EPSG:4326" else 9e-6)
    heights = 2.0 + slope * (x - x0)[None, :] - 0.5 * slope * (y - y0)[:, None]
    raster = xr.DataArray(
        heights, {"y": y, "x": x}, ("y", "x"), attrs={"crs": crs, "height_reference": "ellipsoid"}
    )
    made = hp.geometry.locate(line, dem=raster, crs=UTM, camera=CAMERA)
    to_raster = pyproj.Transformer.from_crs("EPSG:4326", crs, always_xy=True)

    def plane(longitude: np.ndarray, latitude: np.ndarray) -> np.ndarray:
        at_x, at_y = to_raster.transform(longitude, latitude)
        return 2.0 + slope * (at_x - x0) - 0.5 * slope * (at_y - y0)

    wanted = exact_places(line, TANGENTS, plane)
    for name in ("east", "north", "ground_height"):
        np.testing.assert_allclose(made[name], wanted[name], rtol=0, atol=2e-7)


def test_a_level_raster_is_level_ground() -> None:
    line = flown(20, COLUMNS)
    flat = hp.geometry.locate(line, ground=1.25, crs=UTM, camera=CAMERA).compute()
    made = hp.geometry.locate(line, dem=dem(np.full((200, 200), 1.25)), crs=UTM, camera=CAMERA).compute()
    for name in ("east", "north", "ground_height", "view_zenith", "view_azimuth"):
        np.testing.assert_allclose(made[name], flat[name], rtol=0, atol=1e-7)


def test_boxes_hide_what_is_behind_them() -> None:
    # G5: 1.5 m boxes, seen from 15.24 m, throw blind strips away from the camera
    heights = np.zeros((800, 800))
    heights[:, 480:560] = heights[:, 200:240] = 1.5
    raster = dem(heights, 0.02)
    line = flown(1, 301, **LEVEL)
    camera = hp.geometry.PinholeCamera(301, field_of_view=50.0, edges="centres")
    made = hp.geometry.locate(line, dem=raster, crs=UTM, camera=camera).compute()
    flat = hp.geometry.locate(line, ground=0.0, crs=UTM, camera=camera).compute()
    away = made.east.values[0] - CENTRE[0]
    left, right = (0.02 * (np.array(edges) - 399.5) for edges in ((199.0, 240.0), (479.0, 560.0)))
    top = made.ground_height.values[0]
    for near, far in ((right[0], right[1]), (left[1], left[0])):
        # the ray over the far edge of the roof ends behind it on the ground, at these similar triangles
        shadow_end = (far - np.sign(far) * 0.02) * 15.24 / (15.24 - 1.5)
        behind = (
            (np.abs(away) > abs(far) + 1e-3)
            & (np.abs(away) < abs(shadow_end) - 0.03)
            & (np.sign(away) == np.sign(far))
        )
        assert not behind.any()
        roof = (
            (np.abs(away) > abs(near) + 0.02)
            & (np.abs(away) < abs(far) - 0.02)
            & (np.sign(away) == np.sign(far))
        )
        assert roof.sum() > 5
        np.testing.assert_allclose(top[roof], 1.5, atol=1e-8)
    # a roof is nearer than the ground behind it that level ground would show
    raised = top > 1.499
    assert (np.abs(away[raised]) < np.abs(flat.east.values[0, raised] - CENTRE[0])).all()
    # looking down a wall is a hit on the wall, in order
    assert (np.diff(away) > 0).all()


def test_thin_walls_and_peaks_are_not_jumped_over() -> None:
    heights = np.zeros((201, 201))
    heights[:, 130] = 10.0
    heights[100, 60] = 12.0
    gamma = pyproj.Proj(UTM).get_factors(-80.2, 34.0).meridian_convergence
    line = flown(1, 4001, **(LEVEL | {"heading": float(gamma)}))  # to the raster's own north
    camera = hp.geometry.PinholeCamera(4001, field_of_view=150.0, edges="centres")
    made = hp.geometry.locate(line, dem=dem(heights, 0.5), crs=UTM, camera=camera).compute()
    away = made.east.values[0] - CENTRE[0]
    # the wall stands at 15 m; over its top of 10 m the ground is seen from 15 * 15.24 / 5.24 m on
    assert (((away > 15.01) & (away < 43.6)).any(), (away > 43.6).any()) == (False, True)
    top = made.ground_height.values[0]
    np.testing.assert_array_less([9.9, 9.5], [np.nanmax(top[away > 0]), np.nanmax(top[away < 0])])


def test_holes_and_edges_are_not_ground() -> None:
    heights = np.full((200, 200), 0.5)
    line = flown(3, COLUMNS, **LEVEL)
    whole = hp.geometry.locate(line, dem=dem(heights, 0.1), crs=UTM, camera=CAMERA).compute()
    away = whole.east.values - CENTRE[0]
    heights[:, 120:130] = np.nan
    holed = hp.geometry.locate(line, dem=dem(heights, 0.1), crs=UTM, camera=CAMERA).compute()
    lost = np.isnan(holed.east.values)
    over = (away > 0.1 * (119 - 99.5)) & (away < 0.1 * (130 - 99.5))
    np.testing.assert_array_equal(lost, over)
    np.testing.assert_array_equal((holed.quality & Quality.OFF_SWATH) > 0, lost)
    np.testing.assert_array_equal(holed.east.values[~lost], whole.east.values[~lost])
    # the same marked by a number, and nothing but it
    marked = dem(np.where(np.isnan(heights), -9999, heights), 0.1, _FillValue=-9999)
    np.testing.assert_array_equal(
        hp.geometry.locate(line, dem=marked, crs=UTM, camera=CAMERA).east, holed.east
    )
    # a tall thing behind a hole: rays that fly over the hole reach it, those that end in it do not
    tall = np.full((200, 200), 0.5)
    tall[:, 120:125], tall[:, 126:] = np.nan, 6.0
    seen = hp.geometry.locate(line, dem=dem(tall, 0.1), crs=UTM, camera=CAMERA).compute()
    assert np.isnan(seen.east.values[over & (away < 2.4)]).all()
    assert seen.ground_height.values[0, -3:] == pytest.approx(6.0)
    # past the edge there is nothing
    small = hp.geometry.locate(line, dem=dem(np.full((200, 60), 0.5), 0.1), crs=UTM, camera=CAMERA).compute()
    np.testing.assert_array_equal(np.isnan(small.east.values), np.abs(away) > 2.95)
    expect_refusals(
        (
            SchemaError,
            "dem-empty",
            lambda: hp.geometry.locate(line, dem=dem(np.full((9, 9), np.nan)), crs=UTM, camera=CAMERA),
        )
    )


def test_a_camera_below_the_surface_or_the_top() -> None:
    line = flown(1, COLUMNS, altitude=4.0, **LEVEL)
    heights = np.full((200, 200), 0.5)
    heights[:, :60] = 9.0  # a building beside the camera, higher than it
    made = hp.geometry.locate(line, dem=dem(heights, 0.1), crs=UTM, camera=CAMERA).compute()
    assert (np.isfinite(made.east).all(), float(made.ground_height.max())) == (True, pytest.approx(0.5))
    raster = dem(np.full((200, 200), 5.0), 0.1)
    for unseen in (raster, raster.assign_coords(x=raster.x + 5000.0)):
        with pytest.warns(PaintWarning, match="ground-not-seen"):
            under = hp.geometry.locate(line, dem=unseen, crs=UTM, camera=CAMERA)
        assert np.isnan(under.east).all()


@pytest.mark.parametrize("unit", ["m", "ft"])
def test_a_mark_of_holes_that_is_not_declared_is_a_hole(unit: str) -> None:
    heights = np.full((20, 20), 3.0)
    raster = dem(heights, units=unit)
    heights[9, 9] = -9999.0
    with pytest.warns(PaintWarning, match="dem-heights"):
        terrain = terrain_of(heights, grid_of(raster))
    assert (np.isnan(terrain.heights).sum(), terrain.lowest) == (1, terrain.highest)


def test_heights_above_the_geoid() -> None:
    line = flown(3, COLUMNS)
    sea = dem(np.full((200, 200), 34.0), height_reference="geoid", geoid_undulation=-33.0)
    wanted = hp.geometry.locate(line, ground=1.0, crs=UTM, camera=CAMERA)
    np.testing.assert_allclose(
        hp.geometry.locate(line, dem=sea, crs=UTM, camera=CAMERA).east, wanted.east, atol=1e-7
    )


def test_rasters_that_cannot_be_used() -> None:
    line, heights = flown(3, COLUMNS), np.zeros((9, 9))
    even = dem(heights)
    uneven = even.assign_coords(x=even.x.values + 0.01 * (np.arange(9) == 4))
    place = functools.partial(hp.geometry.locate, line, crs=UTM, camera=CAMERA)
    missing, geoid = dem(heights, crs=None, height_reference=None), dem(heights, height_reference="geoid")
    expect_refusals(
        (SchemaError, ("crs-missing", "height-reference-missing"), lambda: place(dem=missing)),
        (SchemaError, "type-wrong", lambda: place(dem="dem.tif")),
        (SchemaError, "type-wrong", lambda: place(dem=even.to_dataset(name="band_data"))),
        (SchemaError, "undulation-missing", lambda: place(dem=geoid)),
        (SchemaError, "grid-uneven", lambda: place(dem=uneven)),
        (SchemaError, "dim-missing", lambda: place(dem=even.rename(y="lat", x="lon"))),
        (SchemaError, "option-conflict", lambda: place(dem=even, ground=0.0)),
    )


@pytest.mark.filterwarnings("ignore:Use `@` matmul:PendingDeprecationWarning")  # affine 3 in rioxarray
def test_rasters_as_rioxarray_opens_them(tmp_path: Any, no_compute: Any) -> None:
    rioxarray = pytest.importorskip("rioxarray")
    heights = np.random.default_rng(4).uniform(0, 1, (160, 160)).astype(np.float32)
    raster = dem(heights.astype(np.float64))
    raster.rio.write_crs(UTM).rio.write_nodata(-9999).astype(np.float32).rio.to_raster(tmp_path / "dsm.tif")
    opened = rioxarray.open_rasterio(tmp_path / "dsm.tif", masked=True, chunks=64)
    declared = opened.assign_attrs(height_reference="ellipsoid")
    line = flown(3, COLUMNS)
    with no_compute():
        made = hp.geometry.locate(line, dem=declared, crs=UTM, camera=CAMERA)
    wanted = hp.geometry.locate(line, dem=raster, crs=UTM, camera=CAMERA)
    np.testing.assert_allclose(made.east, wanted.east, rtol=0, atol=1e-8)
    opened.close()


@pytest.mark.parametrize(("longitude", "middle"), [(-81.0, 279.0), (-179.9999, 180.0), (179.9999, -180.0)])
def test_longitudes_of_a_dem_may_count_from_elsewhere(longitude: float, middle: float) -> None:
    # From 0 to 360, or across 180
    line = flown(4, COLUMNS)
    line = line.assign(longitude=line.longitude * 0.0 + longitude, latitude=line.latitude * 0.0 + 10.0)
    steps = np.arange(-300, 301) * 1e-5
    raster = xr.DataArray(
        np.zeros((601, 601)),
        {"y": 10.0 + steps, "x": middle + steps},
        ("y", "x"),
        attrs={"crs": "EPSG:4326", "height_reference": "ellipsoid"},
    )
    told = {"crs": "EPSG:32601" if abs(longitude) > 170 else "EPSG:32617", "camera": CAMERA}
    made, level = hp.geometry.locate(line, dem=raster, **told), hp.geometry.locate(line, ground=0.0, **told)
    np.testing.assert_allclose(made.east, level.east, atol=1e-4)
    assert np.isfinite(made.east).all()


@pytest.mark.parametrize("transform", ["0 0.5 0.3 0 0.3 -0.5", "0 0 1 0 1 0", "0 -1 0 0 0 1"])
def test_a_grid_along_a_flight_is_no_dem(transform: str) -> None:
    raster = dem(np.zeros((40, 40)))
    turned = raster.assign_coords(spatial_ref=((), 0, {"GeoTransform": transform}))
    expect_refusals(
        (SchemaError, "grid-turned", lambda: hp.geometry.locate(flown(4, COLUMNS), dem=turned, camera=CAMERA))
    )
    straight = raster.assign_coords(spatial_ref=((), 0, {"GeoTransform": "0 0.25 0 0 0 -0.25"}))
    assert hp.geometry.locate(
        flown(4, COLUMNS), dem=straight.isel(y=slice(None, None, 2)), camera=CAMERA
    ).east.size


# --- units, scales and zeros that a raster or its reference system names -----------------------------------


def compound(vertical: int) -> str:
    return str(pyproj.crs.CompoundCRS("map and heights", [pyproj.CRS(UTM), pyproj.CRS(vertical)]).to_wkt())


METRES_PER_FOOT = 1200 / 3937


@pytest.mark.parametrize(
    ("stored", "attrs", "told"),
    [
        (160.0, {}, None),
        (160.0, {"crs": compound(5703), "height_reference": "geoid", "geoid_undulation": 0.0}, None),
        *((160 / METRES_PER_FOOT, {"units": text}, None) for text in ("us-ft", "US survey foot", "Foot_US")),
        *((160 / 0.3048, {"units": text}, None) for text in ("foot", "FEET", "international foot", "Ft")),
        (160 / METRES_PER_FOOT, {"crs": compound(6360)}, "heights-conflict"),
        (160 / METRES_PER_FOOT, {"crs": compound(6360), "units": "us-ft"}, "heights-conflict"),
        (160.0, {"crs": compound(3855)}, "heights-conflict"),
        (-160.0, {"crs": compound(6357)}, "heights-conflict"),  # NAVD88 depth
        (1600, {"scale_factor": 0.1, "add_offset": 0.0}, None),
        (1500, {"scale_factor": 0.1, "add_offset": 10.0, "units": "m"}, None),
        (16000, {"scale_factor": 0.1, "units": "dm"}, None),
    ],
)
def test_heights_are_read_in_the_unit_and_scale_of_the_raster(
    stored: float, attrs: dict[str, Any], told: str | None, recwarn: pytest.WarningsRecorder
) -> None:
    raster = plain(dem(np.full((4, 5), stored), **attrs))
    heights = terrain_of(raster.values, grid_of(raster)).heights
    np.testing.assert_allclose(heights, 160.0, rtol=1e-9)
    assert [told in str(one.message) for one in recwarn] == ([True] if told else [])


@pytest.mark.parametrize("crs", ["EPSG:4979", pyproj.CRS("EPSG:32617").to_3d().to_wkt()], ids=["4979", "utm"])
def test_a_zero_that_the_reference_system_names_is_taken(crs: str) -> None:
    raster = dem(np.full((4, 5), 160.0), crs=crs, height_reference=None)
    assert grid_of(raster).heights.height_reference == "ellipsoid"


@pytest.mark.parametrize(
    ("attrs", "code"),
    [
        ({"units": "furlong"}, "units-unreadable"),
        ({"units": "W m-2"}, "units-not-convertible"),
        ({"units": "m", "crs": compound(6360)}, "units-conflict"),
        ({"units": "ft", "crs": compound(5703)}, "units-conflict"),
        ({"scale_factor": "x"}, "scale-wrong"),
        ({"scale_factor": 0.0}, "scale-wrong"),
        ({"add_offset": np.nan}, "scale-wrong"),
    ],
)
def test_units_and_scales_that_contradict_are_refused(attrs: dict[str, Any], code: str) -> None:
    expect_refusals((PaintError, code, lambda: grid_of(plain(dem(np.zeros((4, 5)), **attrs)))))
