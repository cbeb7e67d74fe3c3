"""A map from the command line."""

import json
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from support.commands import hyperpaint
from support.flown_lines import fly, located
from support.refusals import expect_words

import hyperpaint as hp


def stored(path: Path, count: int) -> Path:
    # Store flight lines that cross each other at right angles; the second looks down more steeply
    pytest.importorskip("pyproj")
    lines = {}
    for number in range(count):
        flown = fly(40, 20, "calm", heading=30.0 + 90.0 * number, seed=number)
        values = np.random.default_rng(number).random((40, 6, 20)).astype(np.float32)
        line = located(flown, reflectance=(("along_track", "band", "cross_track"), values, {"units": "1"}))
        zenith = (("along_track", "cross_track"), np.full((40, 20), 5.0 - number), {"units": "degree"})
        wavelength = ("band", np.linspace(450.0, 700.0, 6), {"units": "nm"})
        lines[f"/flightlines/raw_{number}"] = line.assign_coords(wavelength=wavelength, view_zenith=zenith)
    return hp.to_store(xr.DataTree.from_dict(lines), path)


@pytest.fixture
def store(tmp_path: Path) -> Path:
    return stored(tmp_path / "lot.zarr", 1)


def test_a_map_as_store_and_as_geotiff(store: Path) -> None:
    hyperpaint("orthorectify", store, "--out", store.parent / "map.zarr", "--quiet", status=0)
    made = xr.open_zarr(store.parent / "map.zarr")
    assert {"reflectance", "quality", "line_time", "glt_line", "hits", "gap"} <= set(made.variables)
    rasterio = pytest.importorskip("rasterio")
    hyperpaint("orthorectify", store, "--gsd", "0.01", "--out", store.parent / "map.tif", "--quiet", status=0)
    with rasterio.open(store.parent / "map.tif") as picture:
        assert (picture.count, picture.crs.to_epsg(), picture.transform.b) == (6, 32617, 0.0)


def test_what_is_wrong_is_said(store: Path) -> None:
    inside = (store, store / "map.tif", store / "flightlines" / "map.zarr")
    for options, refusal in (
        (("--out", "map.png"), "ends in .tif, .tiff or .zarr"),
        (("--line", "raw_9", "--out", "map.zarr"), "no flight line 'raw_9'"),
        *((("--out", place, "--overwrite"), "in the store itself") for place in inside),
    ):
        assert refusal in hyperpaint("orthorectify", store, *options, status=2).output
    assert hp.verify(store).ok


# rioxarray multiplies transforms the old way
_OLD_TRANSFORMS = pytest.mark.filterwarnings("ignore:Use `@` matmul:PendingDeprecationWarning")
MOUNTED = (0.34, -0.95, -0.13)
SETTINGS = ("focal_length_mm=12", "pixel_pitch_um=7.4", "column_order=left_to_right")
CAMERA = tuple(word for setting in SETTINGS for word in ("--set", setting))
BORESIGHT = ("--set", f"boresight={','.join(map(str, MOUNTED))}")


@pytest.fixture(scope="module")
def board(tmp_path_factory: pytest.TempPathFactory) -> Path:
    # Return the folder of a simulated collect over a level checkerboard, with its DEM, after processing
    pytest.importorskip("pyproj")
    rasterio = pytest.importorskip("rasterio")
    folder = tmp_path_factory.mktemp("board")
    collect = hp.simulate_collect(
        folder / "collect", lines=32, bands=4, columns=24, scene="checkerboard", boresight=MOUNTED
    )
    hyperpaint("process", collect, "--out", folder / "lot.zarr", "--quiet", status=0)
    truth = xr.open_zarr(folder / "collect" / "truth.zarr")
    corner = float(truth.east.min()) - 5.0, float(truth.north.max()) + 5.0
    size = int(max(np.ptp(truth.east.values), np.ptp(truth.north.values)) + 10.0) + 2
    profile = {"driver": "GTiff", "width": size, "height": size, "count": 1, "dtype": "float32"}
    where = rasterio.Affine(1.0, 0.0, corner[0], 0.0, -1.0, corner[1])
    with rasterio.open(
        folder / "dem.tif", "w", crs=truth.attrs["crs"], transform=where, nodata=-9999.0, **profile
    ) as dem:
        heights = np.full((size, size), truth.attrs["ground"], np.float32)
        heights[0, 0] = -9999.0
        dem.write(heights, 1)
    return folder


def shift(board: Path, *options: str) -> float:
    # Return how far the pixel of a cell truly lies from it, as the median [cell]
    out = board / "map.zarr"
    call = ["orthorectify", str(board / "lot.zarr"), *options, "--grid", "flight", "--out", str(out)]
    call += ["--quiet", "--overwrite"]
    hyperpaint(*call, status=0)
    with xr.open_zarr(out) as made, xr.open_zarr(board / "collect" / "truth.zarr") as truth:
        line, sample = made.nearest_line.values, made.nearest_sample.values
        shown = line >= 0
        assert shown.mean() > 0.3
        assert np.isfinite(made.reflectance.values[shown]).any()
        pixel = line[shown], sample[shown]
        off = (made[name].values[shown] - truth[name].values[pixel] for name in ("east", "north"))
        return float(np.median(np.hypot(*off)) / made.attrs["gsd"])


@_OLD_TRANSFORMS
@pytest.mark.slow
def test_a_camera_a_dem_and_a_boresight_put_pixels_in_their_place(board: Path) -> None:
    dem = ("--dem", str(board / "dem.tif"), "--set", "dem_heights=ellipsoid")
    level = ("--ground", str(xr.open_zarr(board / "collect" / "truth.zarr").attrs["ground"]))
    for ground in (dem, level):
        assert shift(board, *ground, *CAMERA, *BORESIGHT) < 1.0
    assert shift(board, *level, *CAMERA) < 1.0  # the mounting that the collect declares
    assert shift(board, *level, *CAMERA, "--set", "boresight=0,0,0") > 5.0


@_OLD_TRANSFORMS
def test_a_dem_whose_heights_are_above_nothing(board: Path) -> None:
    call = ["orthorectify", str(board / "lot.zarr"), "--dem", str(board / "dem.tif"), *CAMERA]
    assert "dem_heights" in hyperpaint(*call, "--out", board / "none.zarr", "--quiet", status=2).output
    assert not (board / "none.zarr").exists()


def test_a_line_that_declares_no_signs_is_not_guessed_at(board: Path, tmp_path: Path) -> None:
    line = hp.open_store(board / "lot.zarr", "flightlines/raw_0")
    line.attrs = {name: value for name, value in line.attrs.items() if not name.startswith("convention_")}
    hp.to_store(xr.DataTree.from_dict({"/flightlines/raw_0": line}), tmp_path / "bare.zarr")
    call = ["orthorectify", str(tmp_path / "bare.zarr"), "--ground", "0", *CAMERA, "--quiet"]
    done = hyperpaint(*call, "--out", tmp_path / "map.zarr", status=2)
    expect_words(done.output, "roll_positive", "[navigation]")
    assert not (tmp_path / "map.zarr").exists()


def test_a_store_of_one_nameless_line_has_no_line_of_a_name(store: Path, tmp_path: Path) -> None:
    hp.to_store(hp.open_store(store, "flightlines/raw_0"), tmp_path / "one.zarr")
    call = ["orthorectify", str(tmp_path / "one.zarr"), "--out", str(tmp_path / "map.zarr"), "--quiet"]
    assert "no flight line 'nope'" in hyperpaint(*call, "--line", "nope", status=2).output
    assert hyperpaint(*call).exit_code == 0


# --- A mosaic from the command line ---


@pytest.fixture
def store_mosaic(tmp_path: Path) -> Path:
    return stored(tmp_path / "lot.zarr", 2)


def test_a_mosaic_as_store_and_as_geotiff(store_mosaic: Path) -> None:
    rasterio = pytest.importorskip("rasterio")
    folder = store_mosaic.parent
    done = hyperpaint("mosaic", store_mosaic, "--out", folder / "both.zarr", "--quiet", status=0)
    assert "raw_0, raw_1" in done.output
    made = xr.open_zarr(folder / "both.zarr")
    assert {"reflectance", "quality", "flightline", "line_time", "view_zenith", "gap"} <= set(made.variables)
    # the second looks down more steeply
    assert float((made.flightline == 1).sum()) > float((made.flightline == 0).sum()) > 0
    options = ["--rule", "newest", "--gsd", "0.01", "--seamlines", str(folder / "seams.geojson"), "--quiet"]
    done = hyperpaint("mosaic", store_mosaic, "--out", folder / "both.tif", *options, status=0)
    with rasterio.open(folder / "both.tif") as picture:
        assert (picture.count, picture.crs.to_epsg()) == (6, 32617)
    assert len(json.loads((folder / "seams.geojson").read_text())["features"]) == 2


def test_what_is_wrong_is_said_mosaic(store_mosaic: Path) -> None:
    for options, reason in (
        (["--out", "map.png"], "ends in .tif, .tiff or .zarr"),
        (["--line", "raw_9", "--out", "map.zarr"], "no raw_9"),
        (["--out", str(store_mosaic), "--overwrite"], "in the store itself"),
        (["--out", str(store_mosaic / "map.tif")], "in the store itself"),
        (
            ["--out", "map.tif", "--seamlines", str(store_mosaic / "zarr.json"), "--overwrite"],
            "in the store itself",
        ),
        (["--out", str(store_mosaic.parent), "--overwrite"], "ends in .tif, .tiff or .zarr"),
    ):
        assert reason in hyperpaint("mosaic", store_mosaic, *options, status=2).output
