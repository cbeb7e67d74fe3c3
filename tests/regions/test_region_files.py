"""Files of regions, whoever wrote them."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
import xarray as xr
from hypothesis import given, strategies as st
from support.refusals import expect_refusals

from hyperpaint.base.errors import FormatError, SchemaError, StoreError
from hyperpaint.regions import Region, Regions, pixels, polygons, read_regions, regions_from, write_regions

SQUARE = [(1, 1), (5, 1), (5, 5), (1, 5)]

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
    "a number for a name": collection(properties={"name": 7}),
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
    bad = collection(geometry=None)["features"][0]
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
