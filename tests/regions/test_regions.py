"""Regions: which pixels lie in them, exactly."""

import json
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pyproj
import pytest
import xarray as xr
from hypothesis import given, strategies as st
from support.refusals import expect_refusals

from hyperpaint.base.errors import FormatError, PaintWarning, SchemaError, StoreError
from hyperpaint.regions import (
    Region,
    Regions,
    pixels,
    pixels_of,
    polygons,
    read_regions,
    region_mask,
    regions_from,
    write_regions,
)
from hyperpaint.regions.polygons import contains, renumbered

SQUARE = [(1, 1), (5, 1), (5, 5), (1, 5)]


def rational(ring: Any) -> list[tuple[Fraction, Fraction]]:
    return [(Fraction(float(x)), Fraction(float(y))) for x, y in ring]


def on_edge(ring: Any, x: Fraction, y: Fraction) -> bool:
    corners = rational(ring)
    for (x0, y0), (x1, y1) in pairwise([*corners, corners[0]]):
        near = min(x0, x1) <= x <= max(x0, x1) and min(y0, y1) <= y <= max(y0, y1)
        if near and (x1 - x0) * (y - y0) == (y1 - y0) * (x - x0):
            return True
    return False


def wound(ring: Any, x: Fraction, y: Fraction) -> bool:
    # Tell whether a ray to the right crosses a ring an odd number of times, in rational numbers
    corners = rational(ring)
    crossings = 0
    for (x0, y0), (x1, y1) in pairwise([*corners, corners[0]]):
        if (y0 > y) != (y1 > y):
            crossings += x < x0 + (y - y0) * (x1 - x0) / (y1 - y0)
    return crossings % 2 == 1


def slow(polygon: Any, holes: Any, px: float, py: float) -> bool:
    x, y = Fraction(px), Fraction(py)
    inside = on_edge(polygon, x, y) or wound(polygon, x, y)
    return inside and all(on_edge(hole, x, y) or not wound(hole, x, y) for hole in holes)


def fast(polygon: Any, holes: Any, points: Any) -> list[bool]:
    x, y = np.array(points, float).T
    return contains(np.array(polygon, float), [np.array(hole, float) for hole in holes], x, y).tolist()


# --- points in polygons ------------------------------------------------------------------------------------

NEXT = float(np.nextafter(2.0, 3.0))
# what pixels, their fractions and maps have; GEOS is exact there, but not for 1e9 and 1e-16 in one polygon
awkward = st.sampled_from(
    [
        0.0,
        1.0,
        2.0,
        3.0,
        5.0,
        0.5,
        1.5,
        0.1,
        0.3,
        0.7,
        1 / 3,
        NEXT,
        2.0 - 2**-52,
        1e-300,
        3e-162,
        7e-162,
        1.1e-161,
        5e-324,
        -1.0,
        1e9,
        -1e9,
    ]
)
corner = st.tuples(awkward, awkward)
ring = st.lists(corner, min_size=3, max_size=9)


@given(polygon=ring, holes=st.lists(ring, max_size=2), points=st.lists(corner, min_size=1, max_size=12))
def test_points_of_any_polygon_as_in_rational_numbers(polygon: Any, holes: Any, points: Any) -> None:
    # rings that cross and touch themselves, edges that meet points by a hair, holes outside
    assert fast(polygon, holes, points) == [slow(polygon, holes, *point) for point in points]


@given(
    start=st.tuples(st.integers(-9, 9), st.integers(-9, 9)),
    step=st.tuples(st.integers(-7, 7), st.integers(-7, 7)),
    parts=st.integers(2, 9),
)
def test_points_along_an_edge_lie_on_it(start: Any, step: Any, parts: int) -> None:
    stop = (start[0] + parts * step[0], start[1] + parts * step[1])
    points = [(start[0] + k * step[0], start[1] + k * step[1]) for k in range(parts + 1)]
    assert all(fast([start, stop, (50, -60)], [], points))
    # divided, it does not pass through these points in float64, but near enough for a rounded test
    scaled = [tuple(value / 3 for value in each) for each in (start, stop, (50, -60))]
    assert fast(scaled, [], [tuple(v / 3 for v in p) for p in points]) == [
        slow(scaled, [], *(v / 3 for v in p)) for p in points
    ]


def test_edges_corners_holes_and_crossed_rings() -> None:
    hole = [(2, 2), (4, 2), (4, 4), (2, 4)]
    points = {(1, 1): True, (5, 3): True, (3, 5): True, (0, 3): False, (5.0001, 3): False, (3, 3): False}
    points |= {(2, 3): True, (4, 4): True, (4.5, 3): True}
    assert fast(SQUARE, [hole], list(points)) == list(points.values())
    horseshoe = [(0, 0), (6, 0), (6, 6), (4, 6), (4, 2), (2, 2), (2, 6), (0, 6)]
    assert fast(horseshoe, [], [(1, 5), (3, 5), (5, 5), (3, 1), (3, 2)]) == [True, False, True, True, True]
    bow = [(0, 0), (4, 4), (4, 0), (0, 4)]
    assert fast(bow, [], [(1, 2), (3, 2), (2, 1), (2, 3), (2, 2)]) == [True, True, False, False, True]
    assert fast([*SQUARE, *SQUARE], [], [(3, 3), (1, 3)]) == [False, True]
    rng = np.random.default_rng(0)
    polygon = rng.uniform(0, 20, (12, 2))
    y, x = np.mgrid[0:20, 0:20].reshape(2, -1).astype(float)
    expected = contains(polygon, [], x, y)
    for turned in (polygon[::-1], np.roll(polygon, 5, axis=0)):
        np.testing.assert_array_equal(contains(turned, [], x, y), expected)
    shuffled = rng.permutation(x.size)
    np.testing.assert_array_equal(contains(polygon, [], x[shuffled], y[shuffled]), expected[shuffled])
    assert fast(SQUARE, [], [(np.nan, 3), (3, np.nan), (np.inf, 3), (3, 3)]) == [False, False, False, True]


# --- pixels of a line --------------------------------------------------------------------------------------


def line(lines: int = 12, columns: int = 9, **variables: Any) -> xr.Dataset:
    quality = (("along_track", "cross_track"), np.zeros((lines, columns), "u2"))
    return xr.Dataset({"quality": quality, **variables})


def test_pixels_are_columns_and_lines() -> None:
    along, across = pixels(Region("a", [(2, 5), (4.9, 5), (4.9, 6), (2, 6)]), line())
    assert along.dtype == across.dtype == np.int64
    assert (along.tolist(), across.tolist()) == ([5, 5, 5, 6, 6, 6], [2, 3, 4, 2, 3, 4])
    along, across = pixels(Region("a", [(-5, -5), (1, -5), (1, 1), (-5, 1)]), line())
    assert sorted(zip(along.tolist(), across.tolist(), strict=True)) == [(0, 0), (0, 1), (1, 0), (1, 1)]
    for far in ([(20, 20), (30, 20), (30, 30)], [(2.1, 3.1), (2.9, 3.1), (2.5, 3.9)]):
        assert pixels(Region("a", far), line())[0].size == 0
    both = Regions((Region("red car", [(0, 0), (2, 0), (2, 1)]), Region("b", [(2, 0), (5, 0), (5, 3)])))
    mask = region_mask(both, line())
    assert (mask.dims, mask.dtype) == (("along_track", "cross_track"), np.int16)
    assert mask.attrs["flag_meanings"] == "none red_car b"
    assert mask.values[0, :7].tolist() == [0, 0, 1, 1, 1, 1, -1]
    with pytest.raises(SchemaError, match=r"cross_track.*dim-missing"):
        pixels(Region("a", SQUARE), xr.Dataset({"time": ("along_track", [1.0])}))


@pytest.mark.filterwarnings("ignore:.*polygon-crossing")
def test_blocks_of_pixels_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    region = Region("a", np.random.default_rng(1).uniform(0, 40, (9, 2)))
    whole = pixels(region, line(50, 45))
    monkeypatch.setattr(polygons, "_BLOCK_PIXELS", 100)
    for axis in (0, 1):
        np.testing.assert_array_equal(pixels(region, line(50, 45))[axis], whole[axis])


def turned(lines: int = 12, columns: int = 9) -> tuple[np.ndarray, np.ndarray]:
    # Return places of pixels on a grid that is turned and half a metre wide
    y, x = np.mgrid[0:lines, 0:columns].astype(float)
    return 300000 + 0.5 * (x - 0.3 * y), 4770000 + 0.5 * (y + 0.3 * x)


PLANE = ("along_track", "cross_track")


@pytest.mark.parametrize("chunks", [None, {"along_track": 5}, {"cross_track": 2}])
def test_pixels_by_their_place_on_the_ground(chunks: Any) -> None:
    east, north = turned()
    located = line(east=(PLANE, east, {"crs": "EPSG:32618"}), north=(PLANE, north))
    region = Region("a", [(300000, 4770001), (300003, 4770001), (300003, 4770004), (300000, 4770004)])
    located = located if chunks is None else located.chunk(chunks)
    found = pixels(region, located, coordinates="map", crs="urn:ogc:def:crs:EPSG::32618")
    inside = (east >= 300000) & (east <= 300003) & (north >= 4770001) & (north <= 4770004)
    for axis, expected in enumerate(np.nonzero(inside)):
        np.testing.assert_array_equal(found[axis], expected)
    assert inside.sum() > 5


def test_pixels_of_a_map(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(polygons, "_BLOCK_PIXELS", 20)
    grid = xr.Dataset({"reflectance": (("y", "x", "band"), np.zeros((8, 6, 2), "f4"))})
    grid = grid.assign_coords(x=100.0 + 0.5 * np.arange(6), y=50.0 - 0.5 * np.arange(8))
    region = Region("a", [(101, 48.9), (101.6, 48.9), (101.6, 50), (101, 50)])
    along, across = pixels(region, grid, coordinates="map")
    assert (sorted(set(along.tolist())), sorted(set(across.tolist()))) == ([0, 1, 2], [2, 3])


def test_degrees_are_not_metres() -> None:
    east, north = turned()
    both = line(
        east=(PLANE, east, {"crs": "EPSG:32618"}),
        north=(PLANE, north),
        longitude=(PLANE, east / 1e5 - 80),
        latitude=(PLANE, north / 1e5),
    )
    region = Region("a", [(-78, 47), (-76, 47), (-77, 48)])
    assert pixels(region, both, coordinates="map", crs="OGC:CRS84")[0].size > 50
    with pytest.raises(SchemaError, match="crs-missing"):
        pixels(region, both, coordinates="map")
    # of another map: brought to that of the line, where it lies elsewhere
    assert not pixels(region, both, coordinates="map", crs="EPSG:2225")[0].size
    # of the camera, which no pixel is at
    camera = line(longitude=("along_track", np.zeros(12)), latitude=("along_track", np.zeros(12)))
    with pytest.raises(SchemaError, match="pixel-places-missing"):
        pixels(region, camera, coordinates="map")


# --- regions as data ---------------------------------------------------------------------------------------


def test_region_is_closed_once_and_cannot_be_changed() -> None:
    given_ring = [*SQUARE, SQUARE[0]]
    region = Region(
        "a", given_ring, holes=([(2, 2), (3, 2), (3, 3)],), properties={"year": 2019, "tags": ["x"]}
    )
    assert (region.polygon.shape, region.polygon.dtype) == ((4, 2), np.float64)
    with pytest.raises(ValueError, match="read-only"):
        region.polygon[0, 0] = 9
    assert region == Region("a", SQUARE, region.holes, properties={"year": 2019, "tags": ["x"]})
    assert region != Region("a", SQUARE)
    assert len({region, Region("b", SQUARE)}) == 2


def test_everything_wrong_with_a_region_is_told() -> None:
    with pytest.raises(SchemaError) as caught:
        Region("", [(0, 0), (1, np.nan)], ([1, 2],), " x", {"name": "y", "f": np.nan})  # type: ignore[list-item]
    assert caught.value.codes == (
        "region-name-missing",
        "name-unprintable",
        "corner-count",
        "corner-wrong",
        "dims-wrong",
        "property-reserved",
        "property-not-json",
    )
    for properties in ({1: 2}, {"a": object()}, {"a": "\ud800"}, [1]):
        with pytest.raises(SchemaError, match="propert"):
            Region("a", SQUARE, properties=properties)  # type: ignore[arg-type]


def test_polygons_of_other_forms_are_regions() -> None:
    shapely = pytest.importorskip("shapely")
    shape, boxes = shapely.Polygon(SQUARE), [shapely.box(0, 0, 1, 1), shapely.box(3, 3, 4, 4)]
    for source, names in (
        (shape, ("region 1",)),
        (shapely.MultiPolygon(boxes), ("region 1", "region 2")),
        ([shape], ("region 1",)),
        ({"hood": SQUARE}, ("hood",)),
        ([("hood", shape), Region("roof", SQUARE)], ("hood", "roof")),
    ):
        assert regions_from(source).names == names
    for mask in (np.ones((4, 5), bool), xr.DataArray(np.ones((4, 5), int)), [np.array(SQUARE)]):
        with pytest.raises(SchemaError, match="type-wrong"):
            regions_from(mask)


def test_names_of_tables_and_rows_without_a_drawing() -> None:
    document = collection(properties={"name": 5})
    document["features"] += [{**document["features"][0], "properties": {"name": "red "}}]
    document["features"] += [{**document["features"][0], "geometry": None}]
    with pytest.warns(PaintWarning, match="geometry-missing"):
        assert regions_from(document).names == ("5", "red")


def test_an_outline_that_crosses_itself_is_told() -> None:
    line = xr.Dataset(coords={"along_track": np.arange(9), "cross_track": np.arange(9)})
    with pytest.warns(PaintWarning, match="'bow'.*polygon-crossing"):
        pixels(Region("bow", [SQUARE[0], SQUARE[2], SQUARE[1], SQUARE[3]]), line)
    spike = [(0, 0), (4, 0), (8, 0), (4, 0), (4, 4), (0, 4)]  # edges on one another do not cross
    assert pixels(Region("spike", spike), line)[0].size == 29


def test_regions_are_a_sequence() -> None:
    three = Regions(tuple(Region(name, SQUARE, flightline=name) for name in "abc"), "map", "EPSG:32618")
    assert (len(three), three[1].name, three[1:].names) == (3, "b", ("b", "c"))
    assert (three[1:].crs, three.flightlines) == ("EPSG:32618", ("a", "b", "c"))
    expect_refusals(
        (SchemaError, "region-name-duplicate", lambda: Regions((Region("a", SQUARE), Region("a", SQUARE)))),
        (SchemaError, "option-conflict", lambda: Regions((), "sensor", "EPSG:4326")),
        (SchemaError, "choice-unknown", lambda: Regions((), "pixels")),
    )
    same = {
        Regions((Region("a", SQUARE, properties=p),)).digest for p in ({"x": 1, "y": 2}, {"y": 2, "x": 1})
    }
    assert len(same) == 1
    others = [Region("a", SQUARE, properties={"x": 1, "y": 3}), Region("b", SQUARE), Region("a", SQUARE[1:])]
    assert len({*same, *(Regions((each,)).digest for each in others)}) == 4
    hole = ((2.0, 2.0), (3.0, 2.0), (3.0, 3.0))
    regions = Regions(
        (
            Region("hood", [(0, 0), (8, 0), (8, 4)], (np.array(hole),), "raw_0", {"colour": "#ff8000"}),
            Region("<i>roof</i>", [(0, 0), (8, 0), (8, 4)], properties={"colour": 'red" onload="x'}),
        )
    )
    shown = regions._repr_html_()
    assert "2 regions (sensor)" in shown
    assert "hood (raw_0)" in shown
    assert shown.count("<svg") == shown.count('stroke="currentColor"') == 2
    # eight columns fill 20 of 24 pixels; lines count downwards
    assert 'd="M2,7 L22,7 L22,17ZM' in shown
    assert 'fill="#ff8000"' in shown
    assert "onload" not in shown
    assert "<i>" not in shown
    north_up = Regions(regions.regions, "map", "EPSG:32617")._repr_html_()
    assert 'd="M2,17 L22,17 L22,7ZM' in north_up
    assert "EPSG:32617" in north_up
    many = Regions(tuple(Region(f"r{k}", [(0, 0), (1, 0), (1, 1)]) for k in range(70)))._repr_html_()
    assert "70 regions (sensor), of which 60 are shown" in many
    ElementTree.fromstring(shown)


@pytest.mark.filterwarnings("ignore:.*polygon-crossing")
def test_pixels_of_many_regions_are_those_of_each() -> None:
    rng = np.random.default_rng(2)
    many = Regions(tuple(Region(f"r{k}", rng.uniform(0, 12, (5, 2))) for k in range(6)))
    for found, region in zip(pixels_of(many, line()), many, strict=True):
        for axis, expected in enumerate(pixels(region, line())):
            np.testing.assert_array_equal(found[axis], expected)


def test_regions_of_a_line_outline_the_same_on_its_crop() -> None:
    values = np.arange(20 * 12, dtype=np.int64).reshape(20, 12)
    line = xr.Dataset(
        {"number": (("along_track", "cross_track"), values)},
        {"along_track": np.arange(20), "cross_track": np.arange(12)},
    )
    regions = Regions((Region("a", [(3, 6), (8, 6), (8, 11), (4, 12)]),))
    whole = line.number.values[pixels_of(regions, line)[0]]
    crop = line.isel(along_track=slice(5, 15), cross_track=slice(2, 10))
    np.testing.assert_array_equal(crop.number.values[pixels_of(regions, crop)[0]], whole)
    twice = xr.concat([line, line.isel(along_track=slice(7, 9))], "along_track")
    expect_refusals((SchemaError, "label-duplicate", lambda: pixels_of(regions, twice)))
    elsewhere = xr.concat([line, line.isel(along_track=slice(1, 3))], "along_track")
    np.testing.assert_array_equal(elsewhere.number.values[pixels_of(regions, elsewhere)[0]], whole)
    # what lies off the crop is left out, and thinned lines keep those of theirs that lie inside
    half = line.isel(along_track=slice(9, None))
    inside = half.number.values[pixels_of(regions, half)[0]]
    assert set(inside) == {number for number in whole if number >= 9 * 12}
    thinned = line.isel(along_track=slice(None, None, 2))
    inside = thinned.number.values[pixels_of(regions, thinned)[0]]
    assert set(inside) == {number for number in whole if number // 12 % 2 == 0}
    mask = region_mask(regions, crop)
    assert set(crop.number.values[mask.values == 0]) == set(whole)
    # without numbers, positions are meant
    bare = crop.drop_vars(["along_track", "cross_track"])
    assert set(bare.number.values[pixels_of(regions, bare)[0]]) != set(whole)
    # there and back
    shifted = renumbered(regions, crop, back=True)
    np.testing.assert_array_equal(shifted[0].polygon, regions[0].polygon - [2, 5])
    np.testing.assert_array_equal(renumbered(shifted, crop)[0].polygon, regions[0].polygon)
    assert renumbered(regions, line) is regions


# --- Files of regions, whoever wrote them


plain = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=6,
).filter(lambda value: "\\ud" not in json.dumps(value))  # halves of characters are no text
keys = st.text(min_size=1, max_size=6).filter(
    lambda k: k not in ("name", "flightline") and "\\ud" not in json.dumps(k)
)
coordinate = st.floats(-1e9, 1e9) | st.integers(-1000, 1000).map(float)
regions = st.builds(
    lambda rings, properties, flightline: Region("a", rings[0], tuple(rings[1:]), flightline, properties),
    st.lists(
        st.lists(st.tuples(coordinate, coordinate), min_size=4, max_size=6), min_size=1, max_size=3
    ).filter(lambda rings: all(r[0] != r[-1] for r in rings)),
    st.dictionaries(keys, plain, max_size=4),
    st.sampled_from(["", "raw_0", "línea 2"]),
)


@given(region=regions, crs=st.sampled_from([None, "EPSG:32618"]))
def test_files_come_back_as_they_went(region: Region, crs: str | None, tmp_path: Path) -> None:
    before = Regions((region,), "sensor" if crs is None else "map", crs)
    first = write_regions(before, tmp_path / "a.geojson", overwrite=True)
    after = read_regions(first)
    assert (after, after.digest) == (before, before.digest)
    assert after[0].polygon.tobytes() == region.polygon.tobytes()
    second = write_regions(after, tmp_path / "b.geojson", overwrite=True)
    assert first.read_bytes() == second.read_bytes()


def test_the_file_is_as_designed(tmp_path: Path) -> None:
    hood = Region("hood", SQUARE, flightline="raw_0", properties={"make": "Škoda", "year": 2019})
    path = write_regions(
        Regions((hood, Region("roof", [(0, 0.5), (1, 0), (1, -0.0)]))), tmp_path / "r.geojson"
    )
    lines = path.read_text(encoding="utf-8").splitlines()
    assert lines[:4] == ["{", '"type": "FeatureCollection",', '"coordinates": "sensor",', '"features": [']
    assert lines[4].startswith(
        '{"type": "Feature", "properties": {"name": "hood", "flightline": "raw_0", "make": "Škoda"'
    )
    assert '"coordinates": [[[1, 1], [5, 1], [5, 5], [1, 5], [1, 1]]]' in lines[4]
    assert "[[[0, 0.5], [1, 0], [1, 0], [0, 0.5]]]" in lines[5]
    document = json.loads(path.read_text(encoding="utf-8"))
    assert (
        regions_from(document)
        == regions_from(path)
        == regions_from(str(path))
        == regions_from(regions_from(path))
    )
    assert regions_from([hood]) == regions_from(hood) == Regions((hood,))
    assert regions_from(Regions((hood,)).__geo_interface__) == Regions((hood,))
    (folder := tmp_path / "again").mkdir()
    path = write_regions(Regions((Region("a", SQUARE),)), folder / "r.geojson")
    write_regions(Regions((Region("a", SQUARE),)), path)
    with pytest.raises(StoreError, match="overwrite=True"):
        write_regions(Regions((Region("b", SQUARE),)), path)
    assert read_regions(path).names == ("a",)
    assert write_regions(Regions((Region("b", SQUARE),)), path, overwrite=True) == path
    with pytest.raises(StoreError, match="file-unwritable"):
        write_regions(Regions(()), path / "in a file" / "r.geojson")
    assert [each.name for each in folder.iterdir()] == ["r.geojson"]
    ring = [[1, 1, 12.5], [5, 1, 12.5], [5, 5, 12.5]]
    feature = {"type": "Feature", "id": 3, "properties": {"name": "a", "fid": None}}
    several = {"type": "MultiPolygon", "coordinates": [[ring]]}
    document = {
        "type": "FeatureCollection",
        "bbox": [0, 0, 1, 1],
        "features": [{**feature, "geometry": several}],
    }
    (tmp_path / "r.json").write_text("\ufeff" + json.dumps(document), encoding="utf-8")
    found = read_regions(tmp_path / "r.json")
    assert (found.coordinates, found[0].polygon.tolist()) == ("sensor", [[1, 1], [5, 1], [5, 5]])
    assert found[0].properties == {"fid": None}
    old = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32618"}}
    assert regions_from({**document, "crs": old}).coordinates == "map"
    assert regions_from({**document, "crs": "EPSG:32618"}).crs == "EPSG:32618"
    assert regions_from({**feature, "geometry": {"type": "Polygon", "coordinates": [ring]}}).names == ("a",)


def collection(**changed: Any) -> dict[str, Any]:
    geometry = {"type": "Polygon", "coordinates": [[[0, 0], [4, 0], [4, 4], [0, 0]]]}
    feature = {"type": "Feature", "properties": {"name": "a"}, "geometry": geometry, **changed}
    return {"type": "FeatureCollection", "features": [feature]}


HOSTILE: dict[str, Any] = {
    "nothing": b"",
    "no json": b"{'type': 1}",
    "no text": b"\xff\xfe\x00\x01",
    "cut": json.dumps(collection()).encode()[:-9],
    "deep": b'{"a":' * 100_000,
    "lists": b"[" * 100_000,
    "nan": json.dumps(collection()).replace("4", "NaN").encode(),
    "infinity": json.dumps(collection()).replace("4", "1e999").encode(),
    "huge": json.dumps(collection()).replace("4", "9" * 400).encode(),
    "endless": json.dumps(collection()).replace("4", "9" * 5000).encode(),
    "twice": b'{"type": "FeatureCollection", "features": [], "features": []}',
    "half a character": json.dumps(collection(properties={"name": "\ud800"})).encode(),
    "half in a property": json.dumps(collection(properties={"name": "a", "b": ["\ud800"]})).encode(),
    "many lists": b"[" + b"[]," * 600_000 + b"[]]",
    "a list": [],
    "a point": {"type": "Point", "coordinates": [0, 0]},
    "no features": {"type": "FeatureCollection"},
    "features of text": {"type": "FeatureCollection", "features": "abc"},
    "many": {"type": "FeatureCollection", "features": [{}] * 10_001},
    "no feature": {"type": "FeatureCollection", "features": [1, None, "x", []]},
    "no name": collection(properties={}),
    "no properties": collection(properties=None),
    "a number for a name": collection(properties={"name": 7.5}),
    "a list for a name": collection(properties={"name": ["a"]}),
    "a path for a name": collection(properties={"name": "a\x00b"}),
    "a long name": collection(properties={"name": "a" * 201}),
    "a number for a line": collection(properties={"name": "a", "flightline": 7}),
    "no geometry": collection(geometry=None),
    "other geometry": collection(geometry={"type": "LineString", "coordinates": [[0, 0], [1, 1]]}),
    "no rings": collection(geometry={"type": "Polygon", "coordinates": []}),
    "rings of text": collection(geometry={"type": "Polygon", "coordinates": "abc"}),
    "corners of text": collection(geometry={"type": "Polygon", "coordinates": ["abc"]}),
    "flags for numbers": collection(geometry={"type": "Polygon", "coordinates": [[[True, False]] * 4]}),
    "two corners": collection(geometry={"type": "Polygon", "coordinates": [[[0, 0], [1, 1], [0, 0]]]}),
    "many corners": collection(geometry={"type": "Polygon", "coordinates": [[[k, 0] for k in range(10002)]]}),
    "two polygons": collection(geometry={"type": "MultiPolygon", "coordinates": [[], []]}),
    "far away": collection(geometry={"type": "Polygon", "coordinates": [[[0, 0], [1e300, 0], [1, 1]]]}),
    "unknown coordinates": {**collection(), "coordinates": "pixel"},
    "listed coordinates": {**collection(), "coordinates": ["sensor"]},
    "two kinds": {**collection(), "coordinates": "sensor", "crs": "EPSG:4326"},
    "a nameless crs": {**collection(), "crs": {"type": "name"}},
    "a crs of nothing": {**collection(), "crs": {"type": "name", "properties": {"name": None}}},
    "a number for a crs": {**collection(), "crs": 4326},
}  # fmt: skip


@pytest.mark.parametrize("kind", HOSTILE)
def test_hostile_files(kind: str, tmp_path: Path) -> None:
    content = HOSTILE[kind]
    path = tmp_path / "r.geojson"
    path.write_bytes(content if isinstance(content, bytes) else json.dumps(content).encode())
    with pytest.raises(FormatError, match=r"r\.geojson"):
        read_regions(path)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ('<?xml version="1.0"?>\n<kml>', "a KML file"),
        ("; ENVI Output of ROIs (5.3)\n", "regions of interest of ENVI"),
        ("name,x,y\na,1,2\n", "convert it to GeoJSON"),
    ],
)
def test_other_forms_of_regions_are_named(tmp_path: Path, text: str, expected: str) -> None:
    (tmp_path / "r.txt").write_text(text)
    with pytest.raises(FormatError, match=f"(?s){expected}.*text-unreadable"):
        read_regions(tmp_path / "r.txt")


def test_what_is_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for path in (tmp_path, tmp_path / "none", tmp_path / "a\0b"):
        with pytest.raises(FormatError, match="check the path"):
            read_regions(path)
    monkeypatch.setattr(polygons, "MAX_FILE_BYTES", 10)
    (tmp_path / "r").write_bytes(b"[           ]")
    with pytest.raises(FormatError, match="13 bytes"):
        read_regions(tmp_path / "r")
    with pytest.raises(SchemaError, match="type-wrong"):
        regions_from(3)


@pytest.mark.parametrize("key", ["name", "Name", "NAME", "label", "Label", "PAINT", "title"])
def test_regions_are_named_by_the_property_that_other_programs_write(key: str) -> None:
    document = collection(properties={"fid": 1, "klass": "car", key: "roof"})
    region = regions_from(document).regions[0]
    assert (region.name, dict(region.properties)) == ("roof", {"fid": 1, "klass": "car"})


@pytest.mark.parametrize(
    ("properties", "name"),
    [
        ({"label": "b", "name": "a"}, "a"),
        ({"name": None, "Label": "b"}, "b"),
        ({"title": "c", "Name": "a"}, "a"),
    ],
)
def test_names_by_preference(properties: dict[str, Any], name: str) -> None:
    assert regions_from(collection(properties=properties)).regions[0].name == name


def test_the_properties_that_are_there_are_named() -> None:
    document = collection(properties={"fid": 1, "klass": "car"})
    expect_refusals((FormatError, "region-name-missing", "fid", "klass", lambda: regions_from(document)))


class Frame:
    # GeoJSON with a crs beside it, as of geopandas
    def __init__(self, crs: Any, /, **members: Any) -> None:
        self.crs, self.members = crs, members

    @property
    def __geo_interface__(self) -> dict[str, Any]:
        return {**collection(properties={"name": "a"}), **self.members}


@pytest.mark.parametrize(
    ("frame", "crs"),
    [
        (Frame(pyproj.CRS(32618)), "EPSG:32618"),
        (Frame("EPSG:4326"), "EPSG:4326"),
        (Frame(None), None),
        (Frame(pyproj.CRS(32618), crs={"type": "name", "properties": {"name": "EPSG:32618"}}), "EPSG:32618"),
        (Frame("EPSG:32618", crs="urn:ogc:def:crs:EPSG::32618"), "EPSG:32618"),
    ],
)
def test_the_crs_of_an_object_is_read(frame: Frame, crs: str | None) -> None:
    regions = regions_from(frame)
    assert (regions.crs, regions.coordinates) == (crs, "sensor" if crs is None else "map")


@pytest.mark.parametrize(
    ("frame", "code"),
    [
        (Frame(pyproj.CRS(32618), crs="EPSG:32617"), "crs-conflict"),
        (Frame("EPSG:32618", coordinates="sensor"), "option-conflict"),
    ],
)
def test_a_crs_that_contradicts_the_geojson_is_refused(frame: Frame, code: str) -> None:
    expect_refusals((FormatError, code, lambda: regions_from(frame)))


def test_every_bad_feature_is_told_of() -> None:
    good = collection()["features"][0]
    bad = collection(geometry={"type": "Point", "coordinates": [1, 2]})["features"][0]
    with pytest.raises(FormatError) as caught:
        regions_from({"type": "FeatureCollection", "features": [bad, good, {}, bad]})
    assert [f"feature {k}" in str(caught.value) for k in range(4)] == [True, False, True, True]
    with pytest.raises(FormatError, match=r"80 .*features-invalid"):
        regions_from({"type": "FeatureCollection", "features": [bad] * 100})
    with pytest.raises(FormatError, match="region-name-duplicate"):
        regions_from({"type": "FeatureCollection", "features": [good, good]})


VALID = json.dumps({**collection(properties={"name": "a", "year": 2019}), "coordinates": "sensor"}).encode()


@given(
    edits=st.lists(
        st.tuples(
            st.integers(0, len(VALID) - 1),
            st.sampled_from([b"", b"[", b"]", b"{", b'"', b",", b"9", b"-", b"null"]),
        ),
        min_size=1,
        max_size=4,
    )
)
def test_a_damaged_file_is_read_or_refused(edits: Any, tmp_path: Path) -> None:
    damaged = VALID
    for place, piece in edits:
        damaged = damaged[:place] + piece + damaged[place + 1 :]
    path = tmp_path / "r.geojson"
    path.write_bytes(damaged)
    try:
        found = read_regions(path)
    except FormatError:
        return
    assert regions_from(found.__geo_interface__) == found


# --- regions that would take too long, or cannot be: refused at once, with what to do ---------------------


def zigzag(corners: int, lines: int, columns: int) -> Region:
    # Return a comb whose teeth run across all lines
    x = np.linspace(0.0, columns - 1.0, corners)
    return Region("comb", np.stack([x, np.where(np.arange(corners) % 2, lines - 1.0, 0.0)], axis=1))


def test_pixels__of_a_wild_zigzag_are_refused_at_once() -> None:
    # Rationale: 10,000 corners across 2.6 million pixels would take half an hour
    # Expected: an error that names the region and says what to do
    line = xr.Dataset(coords={"along_track": np.arange(4000), "cross_track": np.arange(640)})
    with pytest.raises(SchemaError, match=r"(?s)'comb'.*too-complex"):
        pixels(zigzag(10_000, 4000, 640), line)


def test_pixels__of_holes_like_a_zigzag_are_refused_at_once() -> None:
    line = xr.Dataset(coords={"along_track": np.arange(4000), "cross_track": np.arange(640)})
    comb = zigzag(1000, 4000, 640).polygon
    frame = np.array([(0.0, 0.0), (639.0, 0.0), (639.0, 3999.0), (0.0, 3999.0)])
    with pytest.raises(SchemaError, match="polygon-too-complex"):
        pixels(Region("grate", frame, (comb,)), line)


def test_pixels__of_many_corners_are_found() -> None:
    # Expected: a circle of 10,000 corners holds the pixels within its radius
    turn = np.linspace(0.0, 2.0 * np.pi, 10_000, endpoint=False)
    circle = Region("disc", 300.0 + 250.2 * np.stack([np.cos(turn), np.sin(turn)], axis=1))
    line = xr.Dataset(coords={"along_track": np.arange(600), "cross_track": np.arange(600)})
    along, across = pixels(circle, line)
    y, x = np.mgrid[:600, :600]
    expected = np.hypot(y - 300.0, x - 300.0)
    assert along.size == np.count_nonzero(expected <= 250.2)
    assert expected[along, across].max() <= 250.2


@pytest.mark.parametrize(("coordinates", "crs"), [("sensor", 5), ("map", 5), ("map", b"EPSG:4326")])
def test_regions__with_a_crs_that_is_no_text_are_refused(coordinates: str, crs: Any) -> None:
    with pytest.raises(SchemaError, match="type-wrong"):
        Regions((), coordinates, crs)
