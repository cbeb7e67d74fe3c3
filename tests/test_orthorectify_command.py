"""A map from the command line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from click.testing import CliRunner
from flown_lines import fly, located

import hyperpaint as hp
from hyperpaint.cli import main


@pytest.fixture
def store(tmp_path: Path) -> Path:
    pytest.importorskip("pyproj")
    flown = fly(40, 20, "calm", heading=30.0)
    values = np.random.default_rng(0).random((40, 6, 20)).astype(np.float32)
    line = located(flown, reflectance=(("along_track", "band", "cross_track"), values, {"units": "1"}))
    line = line.assign_coords(wavelength=("band", np.linspace(450.0, 700.0, 6), {"units": "nm"}))
    hp.to_store(xr.DataTree.from_dict({"/flightlines/raw_0": line}), tmp_path / "lot.zarr")
    return tmp_path / "lot.zarr"


def test_a_map_as_store_and_as_geotiff(store: Path) -> None:
    done = CliRunner().invoke(
        main, ["orthorectify", str(store), "--out", str(store.parent / "map.zarr"), "--quiet"]
    )
    assert done.exit_code == 0, done.output
    made = xr.open_zarr(store.parent / "map.zarr")
    assert {"reflectance", "quality", "line_time", "glt_line", "hits", "gap"} <= set(made.variables)
    rasterio = pytest.importorskip("rasterio")
    done = CliRunner().invoke(
        main, ["orthorectify", str(store), "--gsd", "0.01", "--out", str(store.parent / "map.tif"), "--quiet"]
    )
    assert done.exit_code == 0, done.output
    with rasterio.open(store.parent / "map.tif") as picture:
        assert picture.count == 6
        assert picture.crs.to_epsg() == 32617
        assert picture.transform.b == 0.0


def test_what_is_wrong_is_said(store: Path) -> None:
    done = CliRunner().invoke(main, ["orthorectify", str(store), "--out", "map.png"])
    assert done.exit_code == 2
    assert "ends in .tif or .zarr" in done.output
    done = CliRunner().invoke(main, ["orthorectify", str(store), "--line", "raw_9", "--out", "map.zarr"])
    assert done.exit_code == 2
    assert "there is no 'raw_9'" in done.output
