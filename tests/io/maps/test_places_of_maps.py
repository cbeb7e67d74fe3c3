"""Where other programs place our maps: rioxarray and GDAL against the truth that stands in the cells."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
import rasterio
import shapely
import xarray as xr
from click.testing import CliRunner
from support.flown_lines import EAST, GSD, MAP, NORTH, fly, located
from support.refusals import expect_error

import hyperpaint as hp
from hyperpaint.cli.program import main
from hyperpaint.io.maps import map_grids
from hyperpaint.io.maps.map_grids import (
    RasterFormat,
    cut_at_dateline,
    geozarr_attrs,
    grid_of,
    stac_item,
    with_own_transform,
)
from hyperpaint.workflows.maps import write_map

# rioxarray multiplies transforms the old way, and numpy will read numbers of text otherwise
pytestmark = [
    pytest.mark.filterwarnings("ignore:Use `@` matmul:PendingDeprecationWarning"),
    pytest.mark.filterwarnings("ignore:.*fromstring:DeprecationWarning"),
    pytest.mark.filterwarnings("ignore:Transform that is non-rectilinear:UserWarning"),
    pytest.mark.filterwarnings("ignore:Dataset has no geotransform"),
]
OTHER = "EPSG:32616"
"""The next zone: grid north there is 3.4 degrees off."""


@pytest.fixture(scope="module")
def line() -> xr.Dataset:
    # Return a line whose reflectance is where its pixels lie: east and north of a corner [m].
    flown = fly(120, 90, "calm", heading=37.0)
    places = np.stack([flown.east - EAST, flown.north - NORTH], axis=1)
    cube = (("along_track", "band", "cross_track"), places.astype(np.float32), {"units": "1"})
    return located(flown, reflectance=cube).assign_coords(
        wavelength=("band", [550.0, 650.0], {"units": "nm"}), fwhm=("band", [6.0, 7.0], {"units": "nm"})
    )


def misplacement(cells: np.ndarray, x: Any, y: Any, crs: Any) -> np.ndarray:
    # Return how far the content of cells lies from where a program places them [cell].
    back = pyproj.Transformer.from_crs(crs, MAP, always_xy=True)
    cells = cells.astype(np.float64)
    shown = np.isfinite(cells).all(axis=0)
    assert shown.sum() > 3000
    east, north = back.transform(
        np.broadcast_to(x, shown.shape)[shown], np.broadcast_to(y, shown.shape)[shown]
    )
    return np.hypot(cells[0][shown] + EAST - east, cells[1][shown] + NORTH - north) / GSD


def centres(transform: Any, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    row, col = np.meshgrid(*(np.arange(size) + 0.5 for size in shape), indexing="ij")
    a, b, c, d, e, f = transform[:6]
    return a * col + b * row + c, d * col + e * row + f


PARTS = {"whole": {}, "part": {"y": slice(20, 100), "x": slice(10, 80)}}


@pytest.fixture(scope="module")
def resampled(line: xr.Dataset) -> dict[str, xr.Dataset]:
    return {
        grid: hp.geometry.orthorectify(line, GSD, grid=grid, method="bilinear").load()  # type: ignore[arg-type]
        for grid in ("north", "flight")
    }


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize("grid", ["north", "flight"])
def test_rioxarray_warps_a_stored_map_to_its_place(
    resampled: dict[str, xr.Dataset], tmp_path: Path, grid: Any, part: str
) -> None:
    write_map(resampled[grid].isel(PARTS[part]), tmp_path / "map.zarr")
    opened = xr.open_zarr(tmp_path / "map.zarr")
    bands = opened["reflectance"].transpose("band", "y", "x")
    assert bands.rio.crs.to_epsg() == 32617
    assert misplacement(bands.values, *centres(bands.rio.transform(), bands.shape[1:]), MAP).max() < 0.01
    target: dict[str, Any] = {"resolution": GSD}
    if grid == "flight":
        # the extent that rioxarray itself finds is that of a grid that is not turned
        corner = geozarr_attrs(opened)["spatial:bbox"]
        west, south, east, north = pyproj.Transformer.from_crs(MAP, OTHER, always_xy=True).transform_bounds(
            *corner
        )
        shape = int((north - south) / GSD) + 1, int((east - west) / GSD) + 1
        target = {"transform": rasterio.transform.from_origin(west, north, GSD, GSD), "shape": shape}
    for name in ("bilinear", "nearest"):
        warped = bands.rio.reproject(
            OTHER, resampling=rasterio.enums.Resampling[name], nodata=np.nan, **target
        )
        away = misplacement(warped.values, *centres(warped.rio.transform(), warped.shape[1:]), OTHER)
        # at its outer edge GDAL weighs what it has, half a cell inside
        assert away.max() <= 1.0
        # its own way to the source is good to an eighth of a cell
        assert np.median(away) < (0.1 if name == "bilinear" else 0.5)


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize("grid", ["north", "flight"])
@pytest.mark.parametrize("form", ["tif", "nc", "zarr"])
def test_gdal_warps_a_map_to_its_place(
    resampled: dict[str, xr.Dataset], tmp_path: Path, form: str, grid: Any, part: str
) -> None:
    path = tmp_path / ("map.tif" if form == "tif" else "map.zarr")
    write_map(resampled[grid].isel(PARTS[part]), path)
    if form != "tif":
        # this GDAL knows neither Zarr's codecs of today nor bands that come last
        plain = xr.open_zarr(path)[["reflectance"]].transpose("band", "y", "x").drop_vars("fwhm")
        plain = plain.load().drop_attrs(deep=False).drop_encoding()
        path = tmp_path / f"plain.{form}"
        plain.to_netcdf(path, engine="h5netcdf") if form == "nc" else plain.to_zarr(path, zarr_format=2)
    with rasterio.open(
        {"tif": f"{path}", "nc": f'NETCDF:"{path}":reflectance', "zarr": f'ZARR:"{path}":/reflectance'}[form]
    ) as raster:
        if raster.transform.is_identity:
            # of a turned grid this GDAL reads no place at all from Zarr; it is not misplaced
            assert (grid, form) == ("flight", "zarr")
            return
        assert misplacement(raster.read(), *centres(raster.transform, raster.shape), raster.crs).max() < 0.01
        with rasterio.vrt.WarpedVRT(
            raster, crs=OTHER, resampling=rasterio.enums.Resampling.bilinear
        ) as warped:
            x, y = centres(warped.transform, warped.shape)
            away = misplacement(warped.read(masked=True).filled(np.nan), x, y, OTHER)
        assert away.max() <= 1.0
        assert np.median(away) < 0.01


def test_north_is_up_unless_asked_otherwise(line: xr.Dataset, resampled: dict[str, xr.Dataset]) -> None:
    # no program finds distances under the names of map coordinates
    assert not {"x", "y"} & set(resampled["flight"].variables)
    assert resampled["flight"]["east"].dims == resampled["flight"]["north"].dims == ("y", "x")
    made = hp.geometry.orthorectify(line)
    assert made.attrs["grid"] == "north"
    assert np.diff(made["y"]).max() < 0 < np.diff(made["x"]).min()


@pytest.mark.parametrize("grid", ["north", "flight"])
def test_attributes_of_geozarr_are_those_of_the_cells(resampled: dict[str, xr.Dataset], grid: Any) -> None:
    part = resampled[grid].isel(PARTS["part"])
    attrs = geozarr_attrs(part)
    assert (attrs["proj:code"], attrs["spatial:shape"]) == (MAP, [80, 70])
    x, y = centres(attrs["spatial:transform"], (80, 70))
    there = (part["x"], part["y"]) if grid == "north" else (part["east"], part["north"])
    np.testing.assert_allclose(x, np.broadcast_to(there[0].values, x.shape), atol=1e-6)
    np.testing.assert_allclose(y, np.broadcast_to(there[1].values.reshape(80, -1), y.shape), atol=1e-6)
    west, south, east, north = attrs["spatial:bbox"]
    assert west < x.min() < x.max() < east
    assert south < y.min() < y.max() < north
    assert {one["name"] for one in attrs["zarr_conventions"]} == {"proj:", "spatial:"}
    json.dumps(attrs)
    renewed = grid_of(with_own_transform(part))
    assert renewed is not None
    np.testing.assert_allclose(renewed.transform, grid_of(part).transform)  # type: ignore[union-attr]


def test_a_stac_item_says_where_and_when(resampled: dict[str, xr.Dataset], tmp_path: Path) -> None:
    made = resampled["north"]
    item = stac_item(made, tmp_path / "map.tif")
    assert {"type", "stac_version", "id", "geometry", "bbox", "properties", "links", "assets"} < set(item)
    ring = np.array(item["geometry"]["coordinates"][0])
    assert (ring[0] == ring[-1]).all()
    assert np.sum(np.diff(ring[:, 0]) * (ring[1:, 1] + ring[:-1, 1])) < 0  # counterclockwise
    x, y = pyproj.Transformer.from_crs("EPSG:4326", MAP, always_xy=True).transform(*ring.T)
    assert x.min() == pytest.approx(float(made["x"].min()) - GSD / 2, abs=1e-3)
    assert y.max() == pytest.approx(float(made["y"].max()) + GSD / 2, abs=1e-3)
    about = item["properties"]
    assert (about["proj:code"], about["proj:shape"]) == (MAP, [made.sizes["y"], made.sizes["x"]])
    assert about["start_datetime"] == "2021-07-20T17:10:00.000Z"
    assert about["start_datetime"] < about["datetime"] < about["end_datetime"]
    bands = item["assets"]["data"]["bands"]
    assert bands[1] == {"name": "650 nm", "eo:center_wavelength": 0.65, "eo:full_width_half_max": 0.007}
    expect_error(
        hp.SchemaError,
        "variable-missing",
        lambda: stac_item(made.drop_vars("line_time"), tmp_path / "map.tif"),
    )


@pytest.mark.parametrize(
    ("longitudes", "parts", "west", "east"),
    [
        ((179.9, -179.9), 2, 179.9, -179.9),
        ((179.9, 180.1), 2, 179.9, -179.9),
        ((-180.1, -179.9), 2, 179.9, -179.9),
        ((179.8, 179.9), 1, 179.8, 179.9),
        ((-0.1, 0.1), 1, -0.1, 0.1),
        ((-180.0, -179.9), 1, -180.0, -179.9),
    ],
)
def test_outlines_are_cut_at_the_dateline(
    longitudes: tuple[float, float], parts: int, west: float, east: float
) -> None:
    a, b = longitudes
    ring = [[a, 51.0], [b, 51.0], [b, 52.0], [a, 52.0], [a, 51.0]]
    geometry, box = cut_at_dateline({"type": "Polygon", "coordinates": [ring]})
    assert box == pytest.approx([west, 51.0, east, 52.0])
    shape = shapely.from_geojson(json.dumps(geometry))
    assert (len(shapely.get_parts(shape)), shape.is_valid) == (parts, True)
    assert shape.area == pytest.approx((east - west) % 360.0)
    assert (np.abs(shapely.get_coordinates(shape)[:, 0]) <= 180.0).all()


def test_the_command_writes_overviews_an_item_and_attributes(line: xr.Dataset, tmp_path: Path) -> None:
    hp.to_store(xr.DataTree.from_dict({"/flightlines/raw_0": line}), tmp_path / "lot.zarr")
    call = ["orthorectify", str(tmp_path / "lot.zarr"), "--quiet", "--stac", "--out"]
    done = CliRunner().invoke(main, [*call, str(tmp_path / "map.tif"), "--gsd", "0.002"])
    assert done.exit_code == 0, done.output
    assert "overviews 1:2" in done.output
    with rasterio.open(tmp_path / "map.tif") as raster:
        assert raster.overviews(1)[0] == 2
    assert json.loads((tmp_path / "map.json").read_text())["assets"]["data"]["href"] == "./map.tif"
    again = CliRunner().invoke(main, [*call, str(tmp_path / "map.zarr"), "--geozarr"])
    assert again.exit_code == 2
    assert "--overwrite" in again.output
    done = CliRunner().invoke(main, [*call, str(tmp_path / "map.zarr"), "--geozarr", "--overwrite"])
    assert done.exit_code == 0, done.output
    opened = xr.open_zarr(tmp_path / "map.zarr")
    assert opened.attrs["proj:code"] == MAP
    assert opened["spatial_ref"].attrs["crs_wkt"]
    assert hp.verify(tmp_path / "map.zarr").ok
    assert CliRunner().invoke(main, [*call, str(tmp_path / "other.tif"), "--geozarr"]).exit_code == 2


def test_a_format_of_maps_is_a_row(line: xr.Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hp.to_store(xr.DataTree.from_dict({"/flightlines/raw_0": line}), tmp_path / "lot.zarr")
    words = ["orthorectify", str(tmp_path / "lot.zarr"), "--quiet", "--gsd", "0.002", "--stac", "--out"]
    assert CliRunner().invoke(main, [*words, str(tmp_path / "map.img")]).exit_code == 2
    hfa = RasterFormat("HFA", "application/x-erdas-hfa", {"compressed": "yes"}, {})
    monkeypatch.setitem(map_grids.RASTER_FORMATS, ".img", hfa)
    for name in ("map.img", "map.tif"):
        done = CliRunner().invoke(main, [*words, str(tmp_path / name), "--overwrite"])
        assert done.exit_code == 0, done.output
    with rasterio.open(tmp_path / "map.img") as made, rasterio.open(tmp_path / "map.tif") as tiff:
        assert (made.driver, made.crs, made.transform) == ("HFA", tiff.crs, tiff.transform)
        np.testing.assert_array_equal(made.read(), tiff.read())
