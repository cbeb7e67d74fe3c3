"""ENVI and GeoTIFF exports: bit for bit, in the right place, whole or not at all."""

import contextlib
import errno
import http.server
import os
import shutil
import subprocess
import sys
import threading
import warnings
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import dask.array as da
import numpy as np
import pytest
import rasterio
import rioxarray
import xarray as xr
from hypothesis import given, strategies as st
from support.files import write_file
from support.refusals import expect_equal, expect_error, expect_errors, expect_refusals

import hyperpaint as hp
from hyperpaint.base import schema
from hyperpaint.base.errors import FormatError, SchemaError, StoreError
from hyperpaint.io.envi.envi_cubes import open_envi, read_header
from hyperpaint.io.maps.map_grids import (
    Grid,
    envi_map_info,
    grid_of,
    nearest_bands,
    read_geotiff_header,
    read_heights,
)

NM = np.array([450.25, 550.0, 640.125, 700.0, 850.0])
UTM17 = "EPSG:32617"


def values(lines: int = 40, bands: int = 5, samples: int = 30, *, seed: int = 0) -> np.ndarray:
    made = np.random.default_rng(seed).random((lines, bands, samples), dtype=np.float32)
    made[3:6, :, 4:9] = np.nan
    return made


def line_of(cube: np.ndarray, name: str = "reflectance", chunks: Any = (16, -1, -1)) -> xr.Dataset:
    attrs = schema.VARIABLES[name].attrs
    line = xr.Dataset(
        {name: (schema.CUBE, cube if chunks is None else da.from_array(cube, chunks=chunks), attrs)}
    )
    width = np.full(cube.shape[1], 6.5)
    good = np.arange(cube.shape[1]) != 1
    return line.assign_coords(
        wavelength=("band", NM[: cube.shape[1]], {"units": "nm"}), fwhm=("band", width, {"units": "nm"}),
        good=("band", good),
    )  # fmt: skip


def turned(degrees: float, gsd: float = 0.25, *, mirrored: bool = False) -> tuple[float, ...]:
    # Return a GeoTransform whose columns step at an angle from east, counterclockwise.
    angle, side = np.radians(degrees), 1.0 if mirrored else -1.0
    step = gsd * np.cos(angle), gsd * np.sin(angle)
    return (
        300_000.25,
        float(step[0]),
        float(-side * step[1]),
        4_700_000.5,
        float(step[1]),
        float(side * step[0]),
    )


def map_of(
    cube: np.ndarray, transform: tuple[float, ...], crs: str | None = UTM17, chunks: Any = (16, 12, -1)
) -> xr.Dataset:
    # Return a map (y, x, band) with its grid mapping.
    line = line_of(np.ascontiguousarray(cube), chunks=None)
    array = np.ascontiguousarray(np.moveaxis(cube, 1, -1))
    attrs: dict[str, Any] = {"GeoTransform": " ".join(map(repr, transform))}
    if crs is not None:
        attrs["crs_wkt"] = pytest.importorskip("pyproj").CRS(crs).to_wkt()
    data = da.from_array(array, chunks=chunks) if chunks else array
    reflectance = (("y", "x", "band"), data, schema.VARIABLES["reflectance"].attrs)
    return xr.Dataset({"reflectance": reflectance}, line.coords).assign_coords(spatial_ref=((), 0, attrs))


def place(transform: tuple[float, ...], column: Any, row: Any) -> tuple[Any, Any]:
    a, b, c, d, e, f = transform
    return a + b * column + c * row, d + e * column + f * row


# --- ENVI: values ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("interleave", ["bil", "bip", "bsq"])
@pytest.mark.parametrize("chunks", [None, (16, -1, -1), (7, 2, 11)])
def test_a_line_comes_back_bit_for_bit(tmp_path: Path, interleave: Any, chunks: Any) -> None:
    cube = values()
    seen: list[tuple[int, int]] = []
    header = hp.io.write_envi(
        line_of(cube, chunks=chunks),
        tmp_path / "line",
        interleave=interleave,
        progress=lambda *at: seen.append(at),
    )
    assert (header, seen[-1]) == (tmp_path / "line.hdr", (6000, 6000))
    assert [done for done, _ in seen] == sorted(done for done, _ in seen)
    opened = open_envi(header)
    assert (opened["reflectance"].dims, opened["reflectance"].dtype) == (schema.CUBE, np.float32)
    np.testing.assert_array_equal(opened["reflectance"].values.view("u4"), cube.view("u4"))
    np.testing.assert_array_equal(opened.wavelength, NM)
    np.testing.assert_array_equal(opened.fwhm, np.full(5, 6.5))
    np.testing.assert_array_equal(opened.good, [True, False, True, True, True])
    found = read_header(header)
    assert (found.interleave, found.fields["default bands"]) == (interleave, "{3, 2, 1}")


def test_counts_and_radiance_keep_what_they_are(tmp_path: Path) -> None:
    counts = np.arange(24 * 5 * 6, dtype=np.uint16).reshape(24, 5, 6)
    opened = open_envi(hp.io.write_envi(line_of(counts, "counts"), tmp_path / "raw_0"))
    expect_equal((opened["counts"].dtype, np.uint16), (opened["counts"], counts))
    opened = open_envi(hp.io.write_envi(line_of(values(), "radiance"), tmp_path / "radiance.dat"))
    np.testing.assert_array_equal(opened["radiance"], values())
    assert opened["radiance"].attrs["units"] == schema.VARIABLES["radiance"].units


def test_reflectance_as_integers(tmp_path: Path) -> None:
    cube = values(4, 5, 3)
    cube[0, 0] = [-0.1, 7.0, 0.00005]
    header = hp.io.write_envi(line_of(cube), tmp_path / "line", dtype="uint16")
    assert read_header(header).dtype == np.uint16
    stored = np.fromfile(tmp_path / "line.img", "<u2").reshape(4, 5, 3)
    expected = np.where(np.isnan(cube), 65535, np.clip(np.round(cube * np.float32(1e4)), 0, 65534))
    np.testing.assert_array_equal(stored, expected.astype(np.uint16))
    np.testing.assert_allclose(open_envi(header)["reflectance"][1:].values, cube[1:], rtol=0, atol=5.1e-5)
    expect_error(
        SchemaError,
        "type-wrong",
        lambda: hp.io.write_envi(line_of(values(), "radiance"), tmp_path / "other", dtype="uint16"),
    )


def test_a_plane_is_one_band(tmp_path: Path) -> None:
    line = line_of(values(8))
    line["quality"] = (("along_track", "cross_track"), np.arange(240, dtype=np.uint16).reshape(8, 30))
    found = read_header(hp.io.write_envi(line, tmp_path / "flags", variable="quality"))
    assert (found.bands, found.band_names, found.wavelength) == (1, ("quality",), None)
    np.testing.assert_array_equal(np.fromfile(tmp_path / "flags.img", "<u2"), np.arange(240))


@given(
    shape=st.tuples(st.integers(1, 9), st.integers(1, 5), st.integers(1, 9)),
    chunks=st.tuples(st.integers(1, 9), st.integers(1, 5), st.integers(1, 9)),
    interleave=st.sampled_from(["bil", "bip", "bsq"]),
    order=st.permutations(schema.CUBE),
)
def test_any_shape_and_chunks_come_back(
    tmp_path_factory: pytest.TempPathFactory, shape: Any, chunks: Any, interleave: Any, order: list[str]
) -> None:
    cube = np.random.default_rng(1).random(shape, dtype=np.float32)
    line = line_of(cube, chunks=chunks).transpose(*order)
    header = hp.io.write_envi(line, tmp_path_factory.mktemp("envi") / "line", interleave=interleave)
    np.testing.assert_array_equal(open_envi(header)["reflectance"], cube)


def test_blocks_are_written_as_they_are_computed(tmp_path: Path) -> None:
    events: list[str] = []

    def compute(block: np.ndarray) -> np.ndarray:
        events.append("computed")
        return block

    cube = da.zeros((64, 5, 30), chunks=(1, -1, -1), dtype=np.float32).map_blocks(
        compute, meta=np.zeros((0, 0, 0), "f4")
    )
    line = xr.Dataset({"reflectance": (schema.CUBE, cube, {"units": "1"})})
    hp.io.write_envi(line, tmp_path / "line", progress=lambda *_: events.append("written"))
    assert events.count("computed") == events.count("written") == 64
    # no more blocks are waiting than there are threads
    assert np.cumsum([1 if event == "computed" else -1 for event in events]).max() <= 32


def test_a_full_disk_is_told_before_anything_is_computed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, no_compute: Any
) -> None:
    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("os.posix_fallocate", full, raising=False)
    with no_compute(), pytest.raises(StoreError, match="disk-full"):
        hp.io.write_envi(line_of(values()), tmp_path / "line")
    assert not list(tmp_path.iterdir())


# --- ENVI: place -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("degrees", [0.0, 30.0, 90.0, 143.0, 180.0, -170.0, -37.5])
@pytest.mark.parametrize("mirrored", [False, True])
def test_gdal_finds_an_envi_map_in_its_place(tmp_path: Path, degrees: float, mirrored: bool) -> None:
    cube, transform = values(), turned(degrees, mirrored=mirrored)
    opened = open_envi(hp.io.write_envi(map_of(cube, transform), tmp_path / "map"))["reflectance"]
    assert opened.dims == ("y", "x", "band")
    expected = np.moveaxis(cube, 1, -1)[:: -1 if mirrored else 1]
    np.testing.assert_array_equal(opened, expected)
    with rasterio.open(tmp_path / "map.img") as raster:
        expect_equal((raster.crs.to_epsg(), 32617), (raster.read(), np.moveaxis(expected, -1, 0)))
        found = raster.transform.to_gdal()
    for column, row in ((0.5, 0.5), (29.5, 0.5), (0.5, 39.5), (12.5, 33.5)):
        seen = place(found, column, 40 - row if mirrored else row)
        np.testing.assert_allclose(seen, place(transform, column, row), rtol=0, atol=1e-6)


def test_geographic_and_other_systems(tmp_path: Path) -> None:
    for crs, transform in (
        ("EPSG:4326", (-77.6, 1e-6, 0.0, 43.1, 0.0, -2e-6)),
        ("EPSG:32733", (5e5, 0.5, 0.0, 6.2e6, 0.0, -0.5)),
        ("EPSG:3035", (4e6, 0.5, 0.0, 3e6, 0.0, -0.5)),
    ):
        name = crs.replace(":", "_")
        hp.io.write_envi(map_of(values(), transform, crs), tmp_path / name)
        with rasterio.open(tmp_path / f"{name}.img") as raster:
            # ESRI's text of a geographic system has its axes the other way round
            assert raster.crs.is_geographic if crs == "EPSG:4326" else raster.crs.to_epsg() == int(crs[5:])
            np.testing.assert_allclose(raster.transform.to_gdal(), transform, rtol=1e-14)


def test_spectral_reads_the_export(tmp_path: Path) -> None:
    spectral = pytest.importorskip("spectral")
    cube = values()
    header = hp.io.write_envi(map_of(cube, turned(30.0)), tmp_path / "map", interleave="bsq")
    image = spectral.open_image(str(header))
    np.testing.assert_array_equal(image.read_subregion((0, 40), (0, 30)), np.moveaxis(cube, 1, -1))
    np.testing.assert_allclose(image.bands.centers, NM)
    np.testing.assert_allclose(image.bands.bandwidths, 6.5)


def test_north_up_maps_are_placed_by_their_coordinates(tmp_path: Path) -> None:
    made = map_of(values(), turned(0.0)).assign_coords(
        x=300_000.125 + 0.25 * np.arange(30), y=4e6 - 0.5 * np.arange(40)
    )
    del made["spatial_ref"].attrs["GeoTransform"]
    grid = grid_of(made)
    assert grid is not None
    assert grid.transform == (300_000.0, 0.25, 0.0, 4e6 + 0.25, 0.0, -0.5)
    opened = open_envi(hp.io.write_envi(made, tmp_path / "map"))
    expect_equal((opened.x, made.x), (opened.y, made.y))
    uneven = made.assign_coords(x=np.arange(30.0) ** 2)
    expect_errors((SchemaError, r"'x'.*spacing-uneven", lambda: hp.io.write_envi(uneven, tmp_path / "other")))


SELECTIONS: dict[str, dict[str, slice]] = {
    "whole": {},
    "window": {"y": slice(9, 31), "x": slice(4, 23)},
    "every second": {"y": slice(1, None, 2), "x": slice(None, None, 2)},
    "upside down": {"y": slice(None, None, -1)},
    "turned round": {"y": slice(None, None, -1), "x": slice(None, None, -1)},
    "one row": {"y": slice(12, 13)},
}


@pytest.mark.parametrize("kind", ["flight", "north"])
@pytest.mark.parametrize("heading", [0.0, 37.0, 180.0, 270.0])
@pytest.mark.slow
def test_a_part_of_a_map_stays_in_its_place(tmp_path: Path, heading: float, kind: Any) -> None:
    angle = np.radians(heading)
    along, across = np.meshgrid(0.1 * np.arange(40), 0.1 * np.arange(30), indexing="ij")
    east = 500_000.0 + along * np.sin(angle) + across * np.cos(angle)
    north = 4e6 + along * np.cos(angle) - across * np.sin(angle)
    dims, attrs = ("along_track", "cross_track"), {"units": "m", "crs": UTM17}
    values = np.stack([east - 500_000.0, north - 4e6], axis=1).astype(np.float32)
    line = xr.Dataset({"values": (schema.CUBE, values, {"units": "1"})})
    line = line.assign_coords(east=(dims, east, attrs), north=(dims, north, attrs))
    made = hp.geometry.orthorectify(line, grid=kind, variables="values", method="bilinear").load()
    for name, selection in SELECTIONS.items():
        part = made.isel(selection)  # type: ignore[arg-type]
        files = [hp.io.write_geotiff(part, tmp_path / f"{name}.tif")]
        if name not in ("upside down", "every second"):
            files.append(hp.io.write_envi(part, tmp_path / name).with_suffix(".img"))
        for path in files:
            with rasterio.open(path) as raster:
                found = raster.read()
                rows, cols = np.nonzero(np.isfinite(found[0]))
                assert rows.size, path
                x, y = place(raster.transform.to_gdal(), cols + 0.5, rows + 0.5)
            places = np.stack([x - 500_000.0, y - 4e6])
            np.testing.assert_allclose(found[:2, rows, cols], places, rtol=0, atol=1e-4, err_msg=path.name)


def test_a_whole_map_keeps_the_numbers_of_its_geotransform() -> None:
    made = map_of(values(), turned(0.0), None)
    x, y = 300_000.25 + 0.25 * (np.arange(30) + 0.5), 4_700_000.5 - 0.25 * (np.arange(40) + 0.5)
    grid = grid_of(made.assign_coords(x=x + 1e-10, y=y))
    assert grid is not None
    assert grid.transform == turned(0.0)


def test_coordinates_that_no_grid_has_are_refused() -> None:
    made = map_of(values(), turned(37.0), None).assign_coords(
        {"x": 0.25 * (np.arange(30) + 0.5), "y": 0.25 * (np.arange(40) + 0.5)}
    )
    assert grid_of(made) is not None
    expect_errors((SchemaError, "place-ambiguous", lambda: grid_of(made.isel(x=slice(3, None)))))
    col, row = np.meshgrid(np.arange(30) + 0.5, np.arange(40) + 0.5)
    east, north = place(turned(37.0), col, row)
    placed = made.drop_vars(["x", "y"]).assign_coords(east=(("y", "x"), east), north=(("y", "x"), north))
    part = grid_of(placed.isel(x=slice(4, None, 2)))
    assert part is not None
    np.testing.assert_allclose(place(part.transform, 0.5, 0.5), (east[0, 4], north[0, 4]), rtol=0, atol=1e-7)
    expect_errors((SchemaError, r"'east'.*spacing-uneven", lambda: grid_of(placed.isel(x=[0, 1, 5]))))
    unknown = placed.assign_coords(east=placed["east"].where(col != 7.5))
    expect_errors((SchemaError, r"'east'.*spacing-uneven", lambda: grid_of(unknown)))


def test_places_are_written_to_the_last_bit(tmp_path: Path) -> None:
    made = map_of(values(), turned(37.0), None)
    exact = np.random.default_rng(2).uniform(4e6, 4.1e6, (40, 30))
    made = made.assign(dict.fromkeys(("north", "glt_line", "wetness"), (("y", "x"), exact)))
    for name, dtype in (("north", "float64"), ("glt_line", "float64"), ("wetness", "float32")):
        for path in (
            hp.io.write_geotiff(made, tmp_path / f"{name}.tif", variable=name),
            hp.io.write_envi(made, tmp_path / name, variable=name).with_suffix(".img"),
        ):
            with rasterio.open(path) as raster:
                expect_equal((raster.dtypes, (dtype,)), (raster.read(1), exact.astype(dtype)))
    header = hp.io.write_envi(made, tmp_path / "short", variable="north", dtype="float32")
    assert read_header(header).dtype == np.float32


@pytest.mark.parametrize(
    ("transform", "match"),
    [
        ((0.0, 1.0, 0.5, 0.0, 0.0, -1.0), "grid-sheared"),
        ((0.0, 1.0, 2.0, 0.0, 1.0, -2.0), "not square"),
        ((0.0, 1.0, 0.0, 0.0, 0.0, 1.0), "mirrored"),
    ],
)
def test_grids_that_envi_cannot_tell(transform: Any, match: str) -> None:
    expect_errors((SchemaError, match, lambda: envi_map_info(Grid(transform, None))))


@pytest.mark.parametrize("text", ["1 2 3", "a b c d e f", "0 1 0 0 0 nan", "0 1 1 0 1 1", 5])
def test_a_geotransform_that_is_none_is_refused(tmp_path: Path, text: Any) -> None:
    made = map_of(values(), turned(0.0), None)
    made["spatial_ref"].attrs["GeoTransform"] = text
    expect_errors((SchemaError, "transform-wrong", lambda: hp.io.write_envi(made, tmp_path / "map")))


# --- whole or not at all -----------------------------------------------------------------------------------


def _failing(message: str = "power cut") -> xr.Dataset:
    def fail(block: np.ndarray) -> np.ndarray:
        raise OSError(message)

    cube = da.zeros((8, 2, 3), chunks=(4, -1, -1), dtype=np.float32).map_blocks(
        fail, dtype=np.float32, meta=np.zeros(0, "f4")
    )
    return xr.Dataset({"reflectance": (schema.CUBE, cube, {"units": "1"})})


def test_an_interrupted_export_leaves_what_was_there(tmp_path: Path) -> None:
    hp.io.write_envi(line_of(values()), tmp_path / "line")
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    expect_error(
        StoreError, "power cut", lambda: hp.io.write_envi(_failing(), tmp_path / "line", overwrite=True)
    )
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
    expect_errors((StoreError, "power cut", lambda: hp.io.write_envi(_failing(), tmp_path / "other")))
    assert sorted(before) == sorted(path.name for path in tmp_path.iterdir())


def test_files_are_replaced_on_request_alone(tmp_path: Path) -> None:
    made = map_of(values(), turned(30.0))
    for write, name in ((hp.io.write_envi, "map.hdr"), (hp.io.write_geotiff, "map.tif")):
        write(made, tmp_path / name)
        expect_error(StoreError, "file-exists", partial(write, made, tmp_path / name))
        write(made, tmp_path / name, overwrite=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["map.hdr", "map.img", "map.tif"]


@pytest.mark.parametrize("write", [hp.io.write_envi, hp.io.write_geotiff])
def test_what_cannot_be_written_is_told(tmp_path: Path, write: Any) -> None:
    made = map_of(values(), turned(0.0), None)
    for dataset, arguments, match in (
        (made.drop_vars("reflectance"), {}, "variable-missing"),
        (made, {"variable": "radiance"}, "variable-missing"),
        (made, {"variable": "wavelength"}, "dim-missing"),
        (made.isel(y=slice(0)), {}, "dim-missing"),
        (made.astype(np.complex64), {}, "complex64"),
    ):
        expect_error(SchemaError, match, partial(write, dataset, tmp_path / "map", **arguments))
    assert not list(tmp_path.iterdir())


# --- GeoTIFF -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cog", [True, False])
@pytest.mark.parametrize("transform", [turned(0.0), turned(37.0), turned(-120.0, mirrored=True)])
def test_geotiff_holds_every_band_in_its_place(
    tmp_path: Path, cog: bool, transform: tuple[float, ...]
) -> None:
    cube = values(300, 5, 280)
    with rasterio.open(
        hp.io.write_geotiff(map_of(cube, transform, chunks=(128, 100, 3)), tmp_path / "map.tif", cog=cog)
    ) as raster:
        assert raster.dtypes == ("float32",) * 5
        assert np.isnan(raster.nodata)
        np.testing.assert_array_equal(
            raster.read().view("u4"), np.ascontiguousarray(np.moveaxis(cube, 1, 0)).view("u4")
        )
        np.testing.assert_allclose(raster.transform.to_gdal(), transform, rtol=1e-14)
        assert (raster.crs.to_epsg(), raster.descriptions[0]) == (32617, "450.25 nm")
        assert raster.tags(3)["wavelength"] == "640.125"
        assert [band.name for band in raster.colorinterp][:4] == ["blue", "green", "red", "undefined"]
        assert (raster.block_shapes[0], bool(raster.overviews(1))) == ((256, 256), cog)
        assert (raster.tags(ns="IMAGE_STRUCTURE").get("LAYOUT") == "COG") == cog


def test_a_picture_is_true_colour(tmp_path: Path) -> None:
    cube = np.full((64, 5, 60), 0.05, np.float32)
    cube[:, 2, :20] = 0.6  # red
    cube[:, 1, 20:40] = 0.6  # green
    cube[:, 0, 40:] = 0.6  # blue
    cube[0, 0, 0] = np.nan
    with rasterio.open(
        hp.io.write_geotiff(map_of(cube, turned(20.0)), tmp_path / "map.tif", bands="rgb")
    ) as raster:
        shown = raster.read()
        assert raster.dtypes == ("uint8",) * 4
        assert [one.name for one in raster.colorinterp] == ["red", "green", "blue", "alpha"]
        assert (raster.nodata, raster.descriptions) == (None, ("640.125 nm", "550 nm", "450.25 nm", "alpha"))
    assert (shown[:, 5, 5].tolist(), shown[:, 5, 25].tolist()) == ([255, 1, 1, 255], [1, 255, 1, 255])
    assert shown[:, 5, 45].tolist() == [1, 1, 255, 255]
    assert (shown[:, 0, 0].tolist(), shown[:, 1:].min()) == ([0, 0, 0, 0], 1)


def test_chosen_bands_and_planes(tmp_path: Path) -> None:
    cube = values()
    made = map_of(cube, turned(10.0))
    seen: list[tuple[int, int]] = []
    hp.io.write_geotiff(made, tmp_path / "two.tif", bands=[4, -5], progress=lambda *at: seen.append(at))
    assert seen[-1] == (2400, 2400)
    with rasterio.open(tmp_path / "two.tif") as raster:
        np.testing.assert_array_equal(raster.read(), np.moveaxis(cube, 1, 0)[[4, 0]])
        assert raster.descriptions == ("850 nm", "450.25 nm")
    made["quality"] = (("y", "x"), np.arange(1200, dtype=np.uint16).reshape(40, 30))
    hp.io.write_geotiff(made, tmp_path / "flags.tif", variable="quality", cog=False)
    with rasterio.open(tmp_path / "flags.tif") as raster:
        expect_equal((raster.read(1), made["quality"]), (raster.descriptions, ("quality",)))
        assert raster.nodata is None


@pytest.mark.parametrize(
    ("lost", "arguments", "match"),
    [
        ([], {"bands": [7]}, "value-out-of-range"),
        ([], {"bands": []}, "value-out-of-range"),
        ([], {"bands": "cir"}, "bands 'cir'"),
        ([], {"bands": "rgb", "stretch": (98.0, 2.0)}, "stretch"),
        (["wavelength"], {"bands": "rgb"}, "band-missing"),
        (["spatial_ref"], {}, "place-unknown"),
    ],
)
def test_bands_or_a_place_that_are_not_there(
    tmp_path: Path, lost: list[str], arguments: dict[str, Any], match: str
) -> None:
    made = map_of(values(), turned(0.0)).drop_vars(lost)
    expect_errors(
        (SchemaError, match, lambda: hp.io.write_geotiff(made, tmp_path / "map.tif", **arguments)),
        (SchemaError, "dim-missing", lambda: hp.io.write_geotiff(line_of(values()), tmp_path / "map.tif")),
    )


@pytest.mark.parametrize("wavelength", [[900.0, 1000.0], [], [640.0, np.nan]])
def test_no_picture_without_visible_bands(wavelength: list[float]) -> None:
    assert nearest_bands(wavelength, (640.0, 550.0, 460.0)) is None


def test_a_full_disk_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Rationale: GDAL says "Write failed" alone, so that the disk is tried out.

    def failed(*_: Any, **__: Any) -> None:
        raise rasterio.errors.RasterioIOError("Write failed. See previous exception for details.")

    def full(*_: Any, **__: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    path = hp.io.write_geotiff(map_of(values(), turned(0.0)), tmp_path / "map.tif")
    before = path.read_bytes()
    monkeypatch.setattr("hyperpaint.io.maps.map_grids._write", failed)
    expect_error(
        StoreError,
        "file-unwritable",
        lambda: hp.io.write_geotiff(map_of(values(), turned(0.0)), path, overwrite=True),
    )
    monkeypatch.setattr("tempfile.TemporaryFile", full)
    expect_error(
        StoreError,
        "disk-full",
        lambda: hp.io.write_geotiff(map_of(values(), turned(0.0)), path, overwrite=True),
    )
    assert (path.read_bytes(), [each.name for each in tmp_path.iterdir()]) == (before, ["map.tif"])


# --- Rasters of heights: read by window where they are large ---


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
    path = write_file(
        tmp_path / name, _vrt(str(secret) if kind == "local" else f"/vsicurl/{server.url}/a.tif")
    )
    with warnings.catch_warnings(), contextlib.suppress(rasterio.errors.RasterioError):
        warnings.simplefilter("ignore")
        rasterio.open(path).read(1)  # GDAL by itself takes the bait
        assert kind == "local"
    assert bool(server.requests) == (kind == "curl")
    seen = len(server.requests)
    for read in (read_heights, read_geotiff_header):
        expect_error(FormatError, None, partial(read, path))
    assert len(server.requests) == seen


@pytest.mark.parametrize("place", ["/vsicurl/{}/a.tif", "/vsizip/x.zip/a.tif", "GTIFF_DIR:1:x.tif"])
def test_names_that_gdal_alone_knows_are_refused(place: str, server: _Server) -> None:
    for read in (read_heights, read_geotiff_header):
        expect_error(FormatError, None, partial(read, place.format(server.url)))
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
        expect_error(FormatError, "file-not-alone", partial(read, tagged))
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
    path = write_file(tmp_path / "dem.asc", GRID + "1 2 3\n4 5 6\n")
    os.mkfifo(path.with_suffix(suffix))
    expect_refusals(
        (FormatError, "file-special", "a pipe", "crs of an ASCII grid", lambda: read_heights(path))
    )
    path.with_suffix(suffix).unlink()
    path.with_suffix(suffix).write_text(" " * 70_000)
    expect_refusals((FormatError, "file-too-large", "at most 65536 bytes", lambda: read_heights(path)))


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
    path = write_file(tmp_path / "dem.asc", header + "1 2 3\n4 -9999 6\n")
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
