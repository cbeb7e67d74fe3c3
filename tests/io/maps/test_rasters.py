"""Rasters of heights: what they hold is read, by window where they are large, and nothing else is opened."""

import contextlib
import http.server
import os
import shutil
import subprocess
import sys
import threading
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.refusals import expect_equal, expect_errors, refusal

from hyperpaint.base.errors import FormatError, SchemaError
from hyperpaint.io.maps.map_grids import read_geotiff_header, read_heights

rasterio = pytest.importorskip("rasterio", reason="rasterio (extra 'geo') reads rasters")
HEIGHTS = np.array([[1.0, 2.0, 3.0], [4.0, -9999.0, 6.0]], np.float32)


def written(
    path: Path, heights: Any = HEIGHTS, tags: Any = None, changes: Any = None, **profile: Any
) -> Path:
    place = rasterio.Affine(0.3, 0.0, 500000.1, 0.0, -0.7, 3700000.3)
    shape = dict(zip(("height", "width"), heights.shape, strict=True))
    given = {"count": 1, "dtype": heights.dtype, "nodata": -9999.0, "crs": "EPSG:32617", "transform": place}
    with rasterio.open(path, "w", driver="GTiff", **{**given, **shape, **profile}) as raster:
        raster.write(heights, 1)
        for namespace, pairs in (tags or {}).items():
            raster.update_tags(ns=namespace, **pairs)
    with rasterio.open(path, "r+") if changes else contextlib.nullcontext() as raster:
        for name, value in (changes or {}).items():
            setattr(raster, name, value)
    return path


@pytest.mark.filterwarnings("ignore::PendingDeprecationWarning")
def test_heights_are_as_rioxarray_has_them(tmp_path: Path) -> None:
    rioxarray = pytest.importorskip("rioxarray")
    path = written(tmp_path / "dem.tif", tags={"": {"height_reference": "ellipsoid"}})
    ours, theirs = read_heights(path), rioxarray.open_rasterio(path, masked=True).squeeze(drop=True)
    expect_equal((ours, theirs), (ours.dtype, theirs.dtype))
    for name in ("x", "y"):
        np.testing.assert_array_equal(ours[name], theirs[name])
    assert ours.spatial_ref.GeoTransform.split() == theirs.spatial_ref.GeoTransform.split()
    assert ours.height_reference == theirs.height_reference == "ellipsoid"


def test_scale_offset_and_unit_of_a_raster_count(tmp_path: Path) -> None:
    cells, changes = [[10, 20], [-9999, 40]], {"scales": (0.5,), "offsets": (100.0,), "units": ("ft",)}
    heights = read_heights(written(tmp_path / "dem.tif", np.array(cells, np.int16), changes=changes))
    expect_equal((heights, [[105.0, 110.0], [np.nan, 120.0]]), (heights.attrs["units"], "ft"))
    # what is not finite is no height
    cells = np.array([[0x7F800001, 0x7F800000], [0x3F800000, 0x40000000]], np.uint32).view(np.float32)
    path = written(tmp_path / "odd.tif", cells, changes={"scales": (2.0,)}, nodata=None)
    np.testing.assert_array_equal(read_heights(path), [[np.nan, np.nan], [2.0, 4.0]])


TURNED = rasterio.Affine(0.0, 1.0, 500000.0, 1.0, 0.0, 3700000.0)


@pytest.mark.parametrize(
    ("profile", "changes", "code"),
    [
        ({}, {"scales": (0.0,), "offsets": (1.0,)}, "scale-wrong"),
        ({}, {"scales": (np.inf,)}, "scale-wrong"),
        ({}, {"offsets": (np.nan,)}, "scale-wrong"),
        ({}, {"transform": rasterio.Affine(np.inf, 0.0, 1.0, 0.0, -1.0, 2.0)}, "not-finite"),
        ({"count": 2}, {}, "band-count"),
        ({"dtype": "complex_int16"}, {}, "type-wrong"),
        ({"transform": TURNED}, {}, "grid-rotated"),
        ({"transform": rasterio.Affine.identity()}, {}, "place-unknown"),
        ({"crs": None}, {}, "place-unknown"),
    ],
)
@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_a_raster_that_holds_no_heights_in_a_place_is_refused(
    tmp_path: Path, profile: dict[str, Any], changes: dict[str, Any], code: str
) -> None:
    path = written(tmp_path / "dem.tif", changes=changes, **profile)
    expect_errors((FormatError, code, lambda: read_heights(path)))


def test_holes_of_a_mask_inside_the_file(tmp_path: Path) -> None:
    path = written(tmp_path / "dem.tif", HEIGHTS[:, ::2], nodata=None)
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), rasterio.open(path, "r+") as raster:
        raster.write_mask(np.array([[True, False], [True, True]]))
    assert [file.name for file in tmp_path.iterdir()] == ["dem.tif"]
    np.testing.assert_array_equal(read_heights(path), [[1.0, np.nan], [4.0, 6.0]])


class _Server:
    # Counts what is fetched.

    def __init__(self) -> None:
        self.requests: list[str] = []
        counter = self

        class Handler(http.server.BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                counter.requests.append(self.path)
                self.send_error(404)

            do_HEAD = do_GET  # noqa: N815

            def log_message(self, *_: Any) -> None:
                pass

        self.server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server.server_port}"
        threading.Thread(target=self.server.serve_forever, args=(0.01,), daemon=True).start()


@pytest.fixture
def server() -> Iterator[_Server]:
    made = _Server()
    yield made
    made.server.shutdown()
    made.server.server_close()


def _vrt(source: str) -> str:
    return (
        '<VRTDataset rasterXSize="3" rasterYSize="2"><VRTRasterBand dataType="Float32" band="1">'
        "<SimpleSource>"
        f'<SourceFilename relativeToVRT="0">{source}</SourceFilename><SourceBand>1</SourceBand>'
        "</SimpleSource></VRTRasterBand></VRTDataset>"
    )


@pytest.mark.parametrize("kind", ["local", "curl"])
@pytest.mark.parametrize("name", ["dem.tif", "dem.vrt", "dem.asc"])
def test_a_virtual_raster_is_no_raster(tmp_path: Path, name: str, kind: str, server: _Server) -> None:
    secret = written(tmp_path / "secret.tif")
    path = tmp_path / name
    path.write_text(_vrt(str(secret) if kind == "local" else f"/vsicurl/{server.url}/a.tif"))
    with warnings.catch_warnings(), contextlib.suppress(rasterio.errors.RasterioError):
        warnings.simplefilter("ignore")
        rasterio.open(path).read(1)  # GDAL by itself takes the bait
        assert kind == "local"
    assert bool(server.requests) == (kind == "curl")
    seen = len(server.requests)
    for read in (read_heights, read_geotiff_header):
        with pytest.raises(FormatError):
            read(path)
    assert len(server.requests) == seen


@pytest.mark.parametrize("place", ["/vsicurl/{}/a.tif", "/vsizip/x.zip/a.tif", "GTIFF_DIR:1:x.tif"])
def test_names_that_gdal_alone_knows_are_refused(place: str, server: _Server) -> None:
    for read in (read_heights, read_geotiff_header):
        with pytest.raises(FormatError):
            read(place.format(server.url))
    assert server.requests == []


def test_nothing_beside_a_raster_is_opened(tmp_path: Path, server: _Server) -> None:
    # Of files beside it, and of the file that a tag names.
    path = written(tmp_path / "dem.tif")
    bait = _vrt(f"/vsicurl/{server.url}/bait.tif")
    for suffix in (".ovr", ".msk"):
        (tmp_path / f"dem.tif{suffix}").write_text(bait)
    (tmp_path / "dem.tif.aux.xml").write_text(
        '<PAMDataset><Metadata domain="OVERVIEWS"><MDI key="OVERVIEW_FILE">'
        f"{server.url}/overview.tif</MDI></Metadata></PAMDataset>"
    )
    (tmp_path / "dem.tfw").write_text("1\n0\n0\n-1\n0\n0\n")
    assert (float(read_heights(path)[0, 0]), read_geotiff_header(path).overviews) == (1.0, ())
    tagged = written(tmp_path / "tagged.tif", tags={"OVERVIEWS": {"OVERVIEW_FILE": f"{server.url}/o.tif"}})
    for read in (read_heights, read_geotiff_header):
        with pytest.raises(FormatError, match="file-not-alone"):
            read(tagged)
    assert server.requests == []


@pytest.fixture(scope="module")
def sparse(tmp_path_factory: pytest.TempPathFactory) -> Path:
    # Return a raster of 200,000 x 200,000 cells of which some hold heights, on a file of megabytes.
    path = tmp_path_factory.mktemp("sparse") / "large.tif"
    place = rasterio.Affine(1.0, 0.0, 400000.0, 0.0, -1.0, 3800000.0)
    profile = {"count": 1, "dtype": "float32", "crs": "EPSG:32617", "transform": place, "nodata": -9999.0}
    with rasterio.open(
        path, "w", driver="GTiff", width=200_000, height=200_000, tiled=True, blockxsize=512, blockysize=512,
        sparse_ok=True, bigtiff="yes", **profile,
    ) as raster:  # fmt: skip
        heights = np.arange(1024.0 * 1024.0, dtype=np.float32).reshape(1024, 1024) % 97.0
        raster.write(heights, 1, window=rasterio.windows.Window(99_840, 99_840, 1024, 1024))
    return path


_READ_LARGE = """
import sys
from rasterio.warp import transform
from hyperpaint.io.maps.map_grids import read_heights
longitude, latitude = transform("EPSG:32617", "EPSG:4326", [500100.0, 500300.0], [3699900.0, 3699800.0])
heights = read_heights(sys.argv[1], (longitude, latitude, [200.0, 210.0]))
# ru_maxrss would be that of the process which started this one, where that was larger
status = dict(line.split(":", 1) for line in open("/proc/self/status"))
peak = int(status["VmHWM"].split()[0])
print(*heights.shape, float(heights.sel(x=500100.5, y=3699900.5)), peak)
"""


@pytest.mark.slow
def test_of_a_large_raster_a_window_is_read(sparse: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", _READ_LARGE, str(sparse)],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    rows, columns, height, peak = (float(text) for text in done.stdout.split())
    assert 200 < rows < 3000
    assert 200 < columns < 3000
    # row 99 of the patch begins 160 cells above the middle
    column, row = 100_100 - 99_840, 100_099 - 99_840
    assert height == (row * 1024 + column) % 97
    assert peak * 1024 < 600e6


@pytest.mark.parametrize(
    ("flight", "error", "code"),
    [
        (None, SchemaError, "positions-missing"),
        (([10.0], [50.0], [100.0]), FormatError, "flight-outside"),
        (([-81.6, -80.9], [32.9, 34.2], [500.0, 500.0]), FormatError, "file-too-large"),
    ],
)
def test_a_large_raster_is_not_read_whole(sparse: Path, flight: Any, error: Any, code: str) -> None:
    expect_errors((error, code, lambda: read_heights(sparse, flight)))


@pytest.mark.parametrize("suffix", [".prj", ".PRJ"])
def test_a_prj_that_is_a_pipe_is_not_waited_for(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / "dem.asc"
    path.write_text(GRID + "1 2 3\n4 5 6\n")
    os.mkfifo(path.with_suffix(suffix))
    with refusal(FormatError, "file-special", "a pipe", "crs of an ASCII grid"):
        read_heights(path)
    path.with_suffix(suffix).unlink()
    path.with_suffix(suffix).write_text(" " * 70_000)
    with refusal(FormatError, "file-too-large", "at most 65536 bytes"):
        read_heights(path)


def test_a_block_of_any_size_is_not_decoded(tmp_path: Path) -> None:
    path = tmp_path / "strip.tif"
    place = rasterio.Affine(1.0, 0.0, 400000.0, 0.0, -1.0, 3800000.0)
    profile = {"count": 1, "dtype": "uint8", "crs": "EPSG:32617", "transform": place, "sparse_ok": True}
    with rasterio.open(
        path, "w", driver="GTiff", width=12_000, height=12_000, tiled=True, blockxsize=12_000,
        blockysize=12_000, **profile,
    ):  # fmt: skip
        pass
    expect_errors((FormatError, "file-too-large", lambda: read_heights(path, ([-82.0], [34.0], [500.0]))))


def test_a_large_raster_of_a_local_crs_is_refused(sparse: Path, tmp_path: Path) -> None:
    local = shutil.copyfile(sparse, tmp_path / "local.tif")
    with rasterio.open(local, "r+") as raster:
        raster.crs = rasterio.CRS.from_wkt('LOCAL_CS["site",UNIT["metre",1]]')
    expect_errors((FormatError, "crs-unknown", lambda: read_heights(local, ([-81.0], [33.4], [500.0]))))


GRID = "NCols 3\nNRows 2\nXLLCorner 500000\nYLLCorner 3700000\nCellSize 2\nNODATA_value -9999\n"


@pytest.mark.parametrize(
    "header", [GRID, GRID.lower(), GRID.upper(), "nrows 2\nncols 3" + GRID.lower()[GRID.index("\nX") :]]
)
def test_headers_of_ascii_grids(tmp_path: Path, header: str) -> None:
    path = tmp_path / "dem.asc"
    path.write_text(header + "1 2 3\n4 -9999 6\n")
    path.with_suffix(".prj").write_text(rasterio.CRS.from_epsg(32617).to_wkt(version="WKT1_ESRI"))
    heights = read_heights(path)
    np.testing.assert_array_equal(heights, [[1.0, 2.0, 3.0], [4.0, np.nan, 6.0]])
    assert "UTM" in heights.spatial_ref.crs_wkt


_AUX = "<PAMDataset><PAMRasterBand band='1'><NoDataValue>-9999</NoDataValue></PAMRasterBand></PAMDataset>"
BARE = {"nodata": None, "crs": None, "transform": rasterio.Affine.identity()}


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
@pytest.mark.parametrize(
    ("lacking", "name", "text", "said"),
    [
        ("nodata", "dem.tif.aux.xml", _AUX, "file-not-alone"),
        ("nodata", "dem.tif.msk", "", "file-not-alone"),
        ("transform", "dem.tfw", "2\n0\n0\n-2\n1\n1\n", "file-not-alone"),
        ("crs", "dem.prj", "", "file-not-alone"),
    ],
)
def test_what_a_raster_lacks_and_has_beside_it(
    tmp_path: Path, lacking: str, name: str, text: str, said: str
) -> None:
    whole, lone = written(tmp_path / "whole.tif"), tmp_path / "dem.tif"
    (tmp_path / name).write_text(text)
    lone.write_bytes(whole.read_bytes())
    assert np.isnan(read_heights(lone)[1, 1])  # it lacks nothing
    bait = (tmp_path / name).read_text()
    lone.unlink()
    written(lone, **{lacking: BARE[lacking]})
    (tmp_path / name).write_text(bait)
    expect_errors((FormatError, said, lambda: read_heights(lone)))
