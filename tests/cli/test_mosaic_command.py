"""A mosaic from the command line."""

import json
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from support.commands import hyperpaint
from support.flown_lines import fly, located

import hyperpaint as hp


@pytest.fixture
def store(tmp_path: Path) -> Path:
    pytest.importorskip("pyproj")
    lines = {}
    for number in range(2):
        flown = fly(40, 20, "calm", heading=30.0 + 90.0 * number, seed=number)
        values = np.random.default_rng(number).random((40, 6, 20)).astype(np.float32)
        line = located(flown, reflectance=(("along_track", "band", "cross_track"), values, {"units": "1"}))
        zenith = (("along_track", "cross_track"), np.full((40, 20), 5.0 - number), {"units": "degree"})
        line = line.assign_coords(
            wavelength=("band", np.linspace(450.0, 700.0, 6), {"units": "nm"}), view_zenith=zenith
        )
        lines[f"/flightlines/raw_{number}"] = line
    hp.to_store(xr.DataTree.from_dict(lines), tmp_path / "lot.zarr")
    return tmp_path / "lot.zarr"


def test_a_mosaic_as_store_and_as_geotiff(store: Path) -> None:
    rasterio = pytest.importorskip("rasterio")
    folder = store.parent
    done = hyperpaint("mosaic", store, "--out", folder / "both.zarr", "--quiet", status=0)
    assert "raw_0, raw_1" in done.output
    made = xr.open_zarr(folder / "both.zarr")
    assert {"reflectance", "quality", "flightline", "line_time", "view_zenith", "gap"} <= set(made.variables)
    # the second looks down more steeply
    assert float((made.flightline == 1).sum()) > float((made.flightline == 0).sum()) > 0
    options = ["--rule", "newest", "--gsd", "0.01", "--seamlines", str(folder / "seams.geojson"), "--quiet"]
    done = hyperpaint("mosaic", store, "--out", folder / "both.tif", *options, status=0)
    with rasterio.open(folder / "both.tif") as picture:
        assert (picture.count, picture.crs.to_epsg()) == (6, 32617)
    assert len(json.loads((folder / "seams.geojson").read_text())["features"]) == 2


def test_what_is_wrong_is_said(store: Path) -> None:
    for options, reason in (
        (["--out", "map.png"], "ends in .tif or .zarr"),
        (["--line", "raw_9", "--out", "map.zarr"], "no raw_9"),
        (["--out", str(store), "--overwrite"], "in the store itself"),
        (["--out", str(store / "map.tif")], "in the store itself"),
        (["--out", "map.tif", "--seamlines", str(store / "zarr.json"), "--overwrite"], "in the store itself"),
        (["--out", str(store.parent), "--overwrite"], "ends in .tif or .zarr"),
    ):
        done = hyperpaint("mosaic", store, *options, status=2)
        assert reason in done.output
