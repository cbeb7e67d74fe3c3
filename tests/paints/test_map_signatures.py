"""Regions drawn on a map: signatures of the map, of the stored map, and of the line that it was made from."""

from pathlib import Path
from typing import Any

import dask.array as da
import numpy as np
import pytest
import shapely
import xarray as xr
from support.flown_lines import GSD, MAP, Flown, fly, located
from support.refusals import expect_error, expect_errors, expect_words

import hyperpaint as hp
from hyperpaint.base.attitude_conventions import Convention
from hyperpaint.base.errors import SchemaError
from hyperpaint.regions import Region, Regions, pixels, region_mask

CUBE = ("along_track", "band", "cross_track")
Pairs = set[tuple[int, int]]


@pytest.fixture(scope="module")
def flown() -> Flown:
    return fly(260, 120, "calm", heading=30.0)


@pytest.fixture(scope="module")
def line(flown: Flown) -> xr.Dataset:
    values = np.random.default_rng(0).random((260, 6, 120)).astype(np.float32)
    age = ("along_track", np.linspace(0.0, 1.0, 260, dtype=np.float32), {"units": "s"})
    line = located(flown, reflectance=(CUBE, values, {"units": "1"}), irradiance_age=age)
    return line.assign_coords(wavelength=("band", np.linspace(450.0, 700.0, 6), {"units": "nm"}))


@pytest.fixture(scope="module")
def north(line: xr.Dataset) -> xr.Dataset:
    # Return the map with cells of a pixel
    return hp.geometry.orthorectify(line, grid="north").compute()


@pytest.fixture(scope="module")
def fine(line: xr.Dataset) -> xr.Dataset:
    # Return the map with cells of half a pixel
    return hp.geometry.orthorectify(line, GSD / 2, grid="north").compute()


def drawn(flown: Flown) -> Regions:
    # Return two turned outlines in the middle of the line, as QGIS would draw them
    middle = np.array([flown.east[130, 60], flown.north[130, 60]])
    outlines = []
    for half, degrees in ((0.32, 20.0), (0.2, 70.0)):
        a = np.radians(degrees)
        turn = np.array([[np.cos(a), np.sin(a)], [-np.sin(a), np.cos(a)]])
        outlines.append(np.array([[-1, -1], [1, -1], [1.2, 0.9], [-0.8, 1]]) * half @ turn + middle)
    return Regions((Region("large", outlines[0]), Region("small", outlines[1])), "map", MAP)


def inside(region: Region, flown: Flown) -> Pairs:
    # Return the pixels whose centre lies in an outline, by GEOS
    is_in = shapely.contains_xy(shapely.Polygon(region.polygon), flown.east, flown.north)
    return {(int(along), int(across)) for along, across in np.argwhere(is_in)}


def used(library: xr.Dataset, paint: int) -> Pairs:
    # Return the pixels of the flight line that a paint was made of, each of them once
    names = ("member_along_track", "member_cross_track")
    places = np.stack([library[name].values[paint] for name in names], axis=-1)
    pairs = [(int(along), int(across)) for along, across in places if along >= 0]
    assert len(set(pairs)) == len(pairs) == library["n"].values[paint]
    return set(pairs)


def extract(source: Any, regions: Any) -> xr.Dataset:
    return hp.extract_signatures(source, regions, exclude=0, members=10**6, min_pixels=1)


def test_a_located_line_gives_the_pixels_that_lie_in_the_outline(
    flown: Flown, line: xr.Dataset, north: xr.Dataset
) -> None:
    regions = drawn(flown)
    library = extract(line, regions)
    for number, region in enumerate(regions):
        assert used(library, number) == inside(region, flown)
    whole = extract(north, regions)
    large, small = (used(whole, number) for number in range(2))
    # nearest cells leave pixels out, and show few from beyond the edge
    assert len(large & inside(regions[0], flown)) >= 0.99 * len(large)
    assert len(small & inside(regions[1], flown)) >= 0.98 * len(small)
    assert 0.6 * len(inside(regions[0], flown)) < len(large)
    for tile in (17, 64):
        made = hp.geometry.orthorectify(line, grid="north", tile=tile)
        assert extract(made, regions).drop_attrs().identical(whole.drop_attrs())
    mask = region_mask(drawn(flown), north)
    assert north["quality"].where(mask == 1).dims == ("y", "x")


@pytest.mark.parametrize(
    "crs", ["EPSG:32616", "urn:ogc:def:crs:OGC:1.3:CRS84", "EPSG:4326", "EPSG:3857", "WKT"]
)
def test_outlines_of_another_reference_system_are_the_same(
    flown: Flown, line: xr.Dataset, fine: xr.Dataset, crs: str
) -> None:
    pyproj = pytest.importorskip("pyproj")
    crs = pyproj.CRS("EPSG:26917").to_wkt() if crs == "WKT" else crs
    turned = pyproj.Transformer.from_crs(MAP, crs, always_xy=True)
    regions = drawn(flown)
    there = tuple(Region(one.name, np.stack(turned.transform(*one.polygon.T), axis=-1)) for one in regions)
    for source in (line, fine):
        same, moved = (extract(source, each) for each in (regions, Regions(there, "map", crs)))
        for number in range(2):
            pairs = used(same, number), used(moved, number)
            assert len(pairs[0] ^ pairs[1]) <= 0.001 * len(pairs[0])


@pytest.mark.parametrize("grid", ["north", "flight"])
def test_a_map_gives_the_pixels_of_the_line(
    flown: Flown, line: xr.Dataset, tmp_path: Path, grid: Any
) -> None:
    regions = drawn(flown)
    direct = extract(line, regions)
    made = hp.geometry.orthorectify(line, GSD / 2, grid=grid)
    hp.to_store(made, tmp_path / "map.zarr")
    stored = hp.open_store(tmp_path / "map.zarr")
    library = extract(made, regions)
    for number, region in enumerate(regions):
        of_map, of_line = used(library, number), inside(region, flown)
        assert len(of_map & of_line) >= 0.985 * len(of_map | of_line)
    for name in ("reflectance", "reflectance_sd", "n", "member_reflectance", "irradiance_age"):
        np.testing.assert_array_equal(extract(stored, regions)[name], library[name])
    np.testing.assert_allclose(library["irradiance_age"], direct["irradiance_age"], atol=0.02)
    away = abs(library["time"] - direct["time"]).values.astype(np.int64)
    assert away.max() < 20e6
    # the middle of the map is the middle of the flight, near noon
    assert library["sun_zenith"].values == pytest.approx([14.2, 14.2], abs=0.05)


def test_outlines_of_the_sensor_are_those_of_the_pixels_that_a_map_shows(line: xr.Dataset) -> None:
    # corners beyond the first line and column: cells without a pixel say -1
    region = Region("corner", [(-2, -2), (40, -2), (40, 30), (-2, 30)])
    pairs = used(extract(hp.geometry.orthorectify(line, GSD / 3, grid="north"), region), 0)
    everywhere = {(along, across) for along in range(31) for across in range(41)}
    assert pairs <= everywhere
    assert len(pairs) > 0.99 * len(everywhere)


def test_a_map_that_says_nothing_of_pixels_is_taken_cell_by_cell(flown: Flown, fine: xr.Dataset) -> None:
    plain = fine.drop_vars([name for name in fine.data_vars if name not in ("reflectance", "quality")])
    region = drawn(flown)[1]
    x, y = np.meshgrid(fine["x"], fine["y"])
    cells = shapely.contains_xy(shapely.Polygon(region.polygon), x, y)
    library = extract(plain, Regions((region,), "map", MAP))
    assert library["n"].item() == cells.sum()
    np.testing.assert_allclose(
        library["reflectance_quantiles"][0, 2],
        np.median(fine["reflectance"].values[cells], axis=0),
        rtol=1e-5,
    )


# rioxarray multiplies transforms the old way
@pytest.mark.filterwarnings("ignore:Use `@` matmul:PendingDeprecationWarning")
def test_cells_of_a_geotiff(flown: Flown, line: xr.Dataset, north: xr.Dataset, tmp_path: Path) -> None:
    rioxarray = pytest.importorskip("rioxarray")
    path = hp.io.write_geotiff(north, tmp_path / "map.tif")
    opened = rioxarray.open_rasterio(path).to_dataset(name="reflectance")
    opened = opened.assign_coords(wavelength=("band", line["wavelength"].values, {"units": "nm"}))
    opened = opened.drop_vars("band")
    opened["reflectance"].attrs["units"] = "1"
    region = Regions(drawn(flown)[1:].regions, "map", MAP)
    cells = pixels(region[0], north, coordinates="map", crs=MAP)
    np.testing.assert_array_equal(pixels(region[0], opened, coordinates="map", crs=MAP), cells)
    assert extract(opened, region)["n"].item() == cells[0].size
    expect_error(
        SchemaError,
        "corner-outside-crs",
        lambda: extract(opened, Regions(region.regions, "map", "EPSG:4326")),
    )


def test_only_the_tiles_of_the_regions_are_read(flown: Flown, line: xr.Dataset) -> None:
    made = hp.geometry.orthorectify(line, grid="north", tile=32).compute()
    read: list[Any] = []

    def block(part: np.ndarray, block_info: Any = None) -> np.ndarray:
        read.append(block_info[0]["chunk-location"])
        return part

    cube = da.from_array(made["reflectance"].values, chunks=(32, 32, -1)).map_blocks(
        block, dtype=np.float32, meta=np.empty((0, 0, 0), np.float32)
    )
    extract(made.assign(reflectance=(("y", "x", "band"), cube, made["reflectance"].attrs)), drawn(flown)[1:])
    rows, cols = (-(-made.sizes[name] // 32) for name in ("y", "x"))
    assert 0 < len(set(read)) < 0.6 * rows * cols


@pytest.mark.parametrize("grid", ["north", "flight"])
def test_the_accessor_and_the_picture_of_a_map(flown: Flown, line: xr.Dataset, grid: Any) -> None:
    pytest.importorskip("matplotlib")
    made = hp.geometry.orthorectify(line, GSD, grid=grid)
    regions = drawn(flown)
    library = made.paint.signatures(regions, members=4)
    expected = hp.extract_signatures(made, regions, members=4)
    np.testing.assert_array_equal(library["sun_zenith"], expected["sun_zenith"])
    assert library["sun_zenith"].values == pytest.approx([14.2, 14.2], abs=0.05)
    (axes, *_) = made.paint.spectrum(regions).axes
    # one line of each region, through its centre
    (large, _) = (curve.get_ydata() for curve in axes.get_lines())
    np.testing.assert_allclose(large, expected["reflectance"][0], rtol=1e-5)


# --- lines that are located for it -------------------------------------------------------------------------


def with_poses(flown: Flown, line: xr.Dataset) -> xr.Dataset:
    # Return the line without places: positions, attitude, look angles, and what the signs mean
    back = pytest.importorskip("pyproj").Transformer.from_crs(MAP, "EPSG:4979", always_xy=True)
    longitude, latitude = back.transform(*flown.position[:, :2].T)
    roll, pitch, heading = flown.attitude.T
    poses = {"latitude": latitude, "longitude": longitude, "altitude": flown.position[:, 2] + 152.4}
    poses |= {"roll": roll, "pitch": pitch, "heading": heading}
    columns = line.sizes["cross_track"]
    look = np.degrees(np.arctan((np.arange(columns) - (columns - 1) / 2) * GSD / 15.24))
    bare = line.drop_vars(["east", "north"])
    bare = bare.assign_coords({
        name: ("along_track", values, {"units": "m" if name == "altitude" else "degree"})
        for name, values in poses.items()
    })  # fmt: skip
    bare = bare.assign_coords(look_angle=("cross_track", look, {"units": "degree"}))
    return bare.assign_attrs(Convention().to_attrs())


def test_a_line_with_poses_is_located_for_regions_of_a_map(flown: Flown, line: xr.Dataset) -> None:
    bare = with_poses(flown, line)
    regions = drawn(flown)
    refused = expect_error(SchemaError, "ground-height-missing", lambda: extract(bare, regions))
    assert "--ground" in refused.text(on_command_line=True)
    library = extract(bare.assign_attrs(ground=152.4), regions)
    by_hand = extract(hp.geometry.locate(bare, ground=152.4), regions)
    for number in range(2):
        assert used(library, number) == used(by_hand, number)
        # a flat earth is flat to a part of a pixel
        assert (
            len(used(library, number) ^ inside(regions[number], flown)) <= 0.05 * library["n"].values[number]
        )


def test_degrees_without_a_crs_are_not_guessed_but_said(flown: Flown, line: xr.Dataset) -> None:
    # GeoJSON as RFC 7946 has it, which names no reference system
    turned = pytest.importorskip("pyproj").Transformer.from_crs(MAP, "OGC:CRS84", always_xy=True)
    features = [
        Region(one.name, np.stack(turned.transform(*one.polygon.T), axis=-1)).feature()
        for one in drawn(flown)
    ]
    document = {"type": "FeatureCollection", "features": features}
    expect_error(SchemaError, r"OGC:CRS84.*region-empty", lambda: extract(line, document))
    # as the error says
    assert (extract(line, {**document, "crs": "OGC:CRS84"})["n"] > 50).all()
    # what can be no degrees is not taken for them
    far = Region("far", [(500, 500), (600, 500), (600, 600)])
    error = expect_error(SchemaError, "region-empty", lambda: extract(line, far))
    expect_words(str(error), without=("CRS84", "crs="))
    # what can only be metres of a map
    expect_error(
        SchemaError, r"crs=.*region-empty", lambda: extract(line, Region("metres", drawn(flown)[0].polygon))
    )


# --- regions on the mosaic of several flight lines: the pixels of each line are its own -------------------


GSD_SIGNATURES, SIZE, MAP_SIGNATURES = 2.0, 30, "EPSG:32617"
DIMS = ("along_track", "cross_track")


def flight_line(name: str, first: float, value: float, *, back: bool = False) -> xr.Dataset:
    # Return a line of one paint, whose columns are east of ``first`` [m]; flown ``back`` to the south
    step = -1 if back else 1
    north, east = (
        axis[::step, ::step].copy()
        for axis in np.meshgrid(
            GSD_SIGNATURES * np.arange(SIZE), first + GSD_SIGNATURES * np.arange(SIZE), indexing="ij"
        )
    )
    noise = np.random.default_rng(SIZE).normal(0.0, 1e-3, (SIZE, 4, SIZE))
    metres = {"units": "m", "crs": MAP_SIGNATURES}
    return xr.Dataset(
        {
            "reflectance": (
                ("along_track", "band", "cross_track"),
                np.float32(value + noise),
                {"units": "1"},
            ),
            "view_zenith": (DIMS, np.ones((SIZE, SIZE)), {"units": "degree"}),
            "quality": (DIMS, np.zeros((SIZE, SIZE), np.uint16)),
        },
        coords={
            "wavelength": ("band", [450.0, 550.0, 650.0, 750.0], {"units": "nm"}),
            "east": (DIMS, east, metres),
            "north": (DIMS, north, metres),
        },
        attrs={"name": name},
    )


@pytest.fixture(scope="module")
def lines() -> dict[str, xr.Dataset]:
    # Return two lines on opposite courses, side by side
    return {"a": flight_line("a", 0.0, 0.2), "b": flight_line("b", 60.0, 0.8, back=True)}


@pytest.fixture(scope="module", params=["made", "stored"])
def mosaic(
    lines: dict[str, xr.Dataset], request: Any, tmp_path_factory: pytest.TempPathFactory
) -> xr.Dataset:
    mosaic = hp.geometry.mosaic(lines, GSD_SIGNATURES)
    if request.param == "made":
        return mosaic
    path: Path = tmp_path_factory.mktemp("mosaic") / "map.zarr"
    hp.to_store(mosaic, path)
    return hp.open_store(path)


def square(name: str, low: float, high: float, **more: Any) -> Region:
    return Region(name, [(low, low), (high, low), (high, high), (low, high)], **more)


def test_a_region_of_a_line_is_of_its_cells_alone(lines: dict[str, xr.Dataset], mosaic: xr.Dataset) -> None:
    drawn = Regions((square("ours", 4.5, 15.5, flightline="a"), square("theirs", 3.5, 12.5, flightline="b")))
    of_lines, of_map = (hp.extract_signatures(source, drawn) for source in (lines, mosaic))
    np.testing.assert_allclose(of_map.reflectance, of_lines.reflectance, atol=2e-4)
    np.testing.assert_allclose(of_map.reflectance[:, 0], [0.2, 0.8], atol=1e-3)
    # nearest cells show each pixel of these lines
    np.testing.assert_array_equal(of_map.n, of_lines.n)
    np.testing.assert_array_equal(of_map.n, [121, 81])
    # a mosaic of one line needs no name
    alone = hp.geometry.mosaic({"a": lines["a"]}, GSD_SIGNATURES)
    library = hp.extract_signatures(alone, Regions((square("hood", 4.5, 15.5),)))
    assert library.n.item() == 121


def test_a_region_over_a_seam_has_the_pixels_of_both_lines(mosaic: xr.Dataset) -> None:
    seam = Regions((Region("seam", [(45, 21), (73, 21), (73, 37), (45, 37)]),), "map", MAP_SIGNATURES)
    row, col = pixels(seam[0], mosaic, coordinates="map", crs=MAP_SIGNATURES)
    shown = mosaic.flightline.values[row, col]
    assert min(np.sum(shown == number) for number in (0, 1)) >= 30
    # the two lines are flown towards each other: some pixels have the line and column of others
    places = np.stack([mosaic[name].values[row, col] for name in ("nearest_line", "nearest_sample")])
    assert np.unique(places[:, shown >= 0], axis=1).shape[1] < np.sum(shown >= 0)
    library = hp.extract_signatures(mosaic, seam, members=10**4)
    keyed = np.unique(np.concatenate([places, shown[None]])[:, shown >= 0], axis=1)
    assert library.n.item() == keyed.shape[1]
    assert library.reflectance_quantiles.values[0, [0, -1], 0] == pytest.approx([0.2, 0.8], abs=0.005)
    # what two lines show alike is not one neighbourhood
    assert 1.0 <= library.n_eff.item() <= library.n.item() / 1.3


@pytest.mark.parametrize("flightline", ["", "c"])
def test_a_region_of_the_sensor_names_its_line(mosaic: xr.Dataset, flightline: str) -> None:
    regions = Regions((square("hood", 4.5, 15.5, flightline=flightline),))
    expect_errors(
        (SchemaError, "flightline-unknown", lambda: hp.extract_signatures(mosaic, regions)),
        (SchemaError, "one of a, b;", lambda: pixels(regions[0], mosaic)),
    )
