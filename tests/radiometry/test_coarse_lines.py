"""A line at the size of a screen: means of blocks against plain loops, stored and computed."""

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.strategies import flight

import hyperpaint as hp
from hyperpaint.base import schema
from hyperpaint.base.errors import SchemaError
from hyperpaint.io.store.layout import storage_chunks
from hyperpaint.kernels.overviews import mix_bands
from hyperpaint.pictures.exploring import Explored
from hyperpaint.radiometry.coarse_lines import coarse, coarse_reflectance


def plain_means(cube: np.ndarray, side: int) -> np.ndarray:
    # Return means of blocks of (line, band, column), NaN left out, by one loop over blocks
    rows, columns = -(-cube.shape[0] // side), -(-cube.shape[2] // side)
    means = np.empty((rows, cube.shape[1], columns))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # blocks without any value
        for y, x in np.ndindex(rows, columns):
            block = cube[y * side : (y + 1) * side, :, x * side : (x + 1) * side].astype("f8")
            means[y, :, x] = np.nanmean(block, axis=(0, 2))
    return means


def speckled(lines: int = 70, columns: int = 11) -> xr.Dataset:
    line = flight(lines=lines, columns=columns).line.paint.reflectance().compute()
    cube = line.reflectance.values.copy()
    rng = np.random.default_rng(5)
    cube[rng.random(cube.shape) < 0.2] = np.nan
    cube[8:16, 1, :8] = np.nan
    cube[0, 0, 0] = 1e30  # more than half precision holds
    line = line.assign_coords(along_track=np.arange(lines))
    return line.assign(reflectance=line.reflectance.copy(data=cube)).drop_vars("counts")


@pytest.mark.parametrize("side", [1, 3, 8, 32])
def test_means_are_those_of_plain_loops(side: int) -> None:
    line = speckled()
    means = coarse_reflectance(line, side)
    assert means.dtype == np.float32
    expected = plain_means(line.reflectance.values, side)
    np.testing.assert_allclose(means.values, expected, rtol=2**-11)
    assert not (means.values.view("u4") & 0x1FFF).any()  # ten bits of the mantissa are kept
    assert side > 8 or np.isnan(means.values[-(-8 // side), 1, 0])


def test_same_bits_whatever_the_chunks() -> None:
    line = speckled()
    whole = coarse_reflectance(line, 8).values
    for chunks in (1, 5, 32, (3, 50, 17)):
        parts = coarse_reflectance(line.chunk({"along_track": chunks, "band": 1}), 8)
        np.testing.assert_array_equal(parts.values, whole)


@pytest.mark.parametrize(("lines", "side"), [(30, 4), (4000, 4), (4001, 8), (12000, 16), (90000, 32)])
def test_a_long_line_has_wider_blocks(lines: int, side: int) -> None:
    cube = xr.DataArray(
        np.broadcast_to(np.float32(0.5), (lines, 2, 3)), dims=("along_track", "band", "cross_track")
    )
    line = xr.Dataset({"reflectance": cube.chunk({"along_track": 4096}).assign_attrs(units="1")})
    means = coarse_reflectance(line)
    assert means.attrs["block_side"] == side
    assert means.shape == (-(-lines // side), 2, 1)


def test_what_is_stored_serves(tmp_path: Path, no_compute: Any) -> None:
    line = speckled().drop_vars("quality").chunk({"along_track": 32})
    path = tmp_path / "lot.zarr"
    hp.to_store(line.assign(coarse_reflectance=coarse_reflectance(line)), path)
    assert hp.verify(path).ok
    opened = hp.open_store(path)
    # a task reads its group of bands, of other cubes all bands
    assert len(opened.coarse_reflectance.chunks[1]) == line.sizes["band"] // 2
    assert len(opened.reflectance.chunks[1]) == 1
    with no_compute():
        small = coarse(opened)
    assert small.reflectance.attrs["level"] == "stored"
    computed = coarse(line)
    assert computed.reflectance.attrs["level"] == "computed"
    np.testing.assert_array_equal(small.reflectance.values, computed.reflectance.values)
    # a line as any other
    assert small.along_track.values[:3].tolist() == [2, 6, 10]
    assert small.along_track.values[-1] == 69  # the last block is cut
    band = small.paint.at(550.0)
    place = int(np.abs(line.wavelength.values - 550.0).argmin())
    np.testing.assert_array_equal(band.reflectance.values, small.reflectance.values[:, place])
    two = [550.0, 560.0]
    xr.testing.assert_identical(opened.paint.at(two).paint.coarse().compute(), small.paint.at(two).compute())
    # not what was cut, changed, or asked for in other blocks
    for other in (
        opened.isel(along_track=slice(0, 40)),
        opened.assign(reflectance=opened.reflectance * np.float32(2.0)).assign(
            reflectance=lambda ds: ds.reflectance.assign_attrs(units="1")
        ),
    ):
        assert coarse(other).reflectance.attrs["level"] == "computed"
    assert coarse(opened, side=8).reflectance.attrs["level"] == "computed"
    # alone it is all there is
    assert coarse(opened.drop_vars("reflectance")).reflectance.attrs["level"] == "stored"
    for side in (0, 33):
        with pytest.raises(SchemaError, match=rf"side={side}.*value-out-of-range"):
            coarse(line, side=side)


def edits(opened: xr.Dataset) -> dict[str, xr.Dataset]:
    loaded = opened.assign(reflectance=opened.reflectance.copy()).load()
    loaded.reflectance.values[:] *= 2
    return {
        "scaled": opened.assign(reflectance=(opened.reflectance * np.float32(0.5)).assign_attrs(units="1")),
        "smooth": opened.paint.smooth(window=3, order=1),
        "backwards": opened.isel(along_track=slice(None, None, -1)),
        "later": opened.isel(along_track=slice(2, None)),
        "data": opened.assign(reflectance=opened.reflectance.copy(data=opened.reflectance.data * 2)),
        "in place": loaded,
    }


def test_means_of_what_was_edited_do_not_serve(tmp_path: Path) -> None:
    line = speckled(71).drop_vars("quality").chunk({"along_track": 32})
    path = tmp_path / "lot.zarr"
    hp.to_store(line.assign(coarse_reflectance=coarse_reflectance(line)), path)
    opened = hp.open_store(path)
    for name, other in edits(opened).items():
        small = coarse(other).reflectance
        assert small.attrs["level"] == "computed", name
        hp.to_store(other, tmp_path / f"{name}.zarr")
        again = coarse(hp.open_store(tmp_path / f"{name}.zarr")).reflectance
        assert again.attrs["level"] == "computed", name
        np.testing.assert_array_equal(again.values, small.values)
    hp.to_store(opened, tmp_path / "same.zarr")
    assert coarse(hp.open_store(tmp_path / "same.zarr")).reflectance.attrs["level"] == "stored"


def test_means_of_counts_follow_what_calibrates_them(tmp_path: Path) -> None:
    line = flight(lines=40, columns=9).line.paint.reflectance().chunk({"along_track": 32})
    line = line.assign(coarse_reflectance=coarse_reflectance(line)).drop_vars("reflectance")
    hp.to_store(line, tmp_path / "lot.zarr")
    opened = hp.open_store(tmp_path / "lot.zarr")
    assert coarse(opened).reflectance.attrs["level"] == "stored"
    for name in ("irradiance", "radiance_gain", "exposure_time"):
        other = opened.assign({name: opened[name].copy(data=opened[name].data * 2)})
        assert coarse(other).reflectance.attrs["level"] == "computed", name


def test_the_explorer_takes_means_of_counts(tmp_path: Path) -> None:
    collect = hp.simulate_collect(tmp_path / "raw", lines=40, bands=12, columns=9, seed=3, truth=False)
    store = hp.process(collect, tmp_path / "lot.zarr", reflectance="none")
    line = hp.open_store(store, "flightlines/raw_0")
    assert line.paint.coarse().reflectance.attrs["level"] == "stored"
    assert Explored(line)._means is not None
    line.paint.pixels(3, 4)  # reads scalars
    assert line.paint.coarse().reflectance.attrs["level"] == "stored"
    assert (
        xr.open_zarr(store, group="flightlines/raw_0").paint.coarse().reflectance.attrs["level"] == "computed"
    )


def test_chunks_are_groups_of_bands() -> None:
    dims = ("coarse_y", "band", "coarse_x")
    assert storage_chunks(dims, (1000, 272, 160), 2) == (128, 34, 160)


def test_process_stores_it(tmp_path: Path) -> None:
    collect = hp.simulate_collect(tmp_path / "raw", lines=40, bands=12, columns=9, seed=3, truth=False)
    line = hp.open_store(hp.process(collect, tmp_path / "lot.zarr"), "flightlines/raw_0")
    small = line.paint.coarse()
    assert small.reflectance.attrs["level"] == "stored"
    expected = plain_means(line.reflectance.values, 4)
    np.testing.assert_allclose(small.reflectance.values, expected, rtol=2**-11)
    assert small.paint.rgb(stretch=(0.0, 100.0)).shape == (10, 3, 3)


def test_colours_are_those_of_a_plain_sum() -> None:
    rng = np.random.default_rng(1)
    values = rng.random((5, 7, 6), np.float32)
    values[rng.random(values.shape) < 0.3] = np.nan
    values[2, :, 3] = np.nan
    weights = rng.normal(size=(3, 7, 6)).astype("f4")
    out = np.empty((5, 6, 3), np.float32)
    mix_bands(values, weights, out)
    seen = np.isfinite(values).any(axis=1, keepdims=True).astype("f4")
    filled = np.where(np.isnan(values), seen, values)
    plain = np.stack([(filled * weight).sum(axis=1, dtype="f4") for weight in weights], axis=-1)
    np.testing.assert_array_equal(out, plain)
    assert not out[2, 3].any()


def test_means_of_an_older_store_serve() -> None:
    line = speckled().drop_vars("quality")
    line = line.assign(reflectance=line.reflectance.clip(max=1.0))
    means = coarse_reflectance(line)
    old = means.astype(np.float16)  # until 0.2
    schema.stamp_means(old, line)
    small = coarse(line.assign(coarse_reflectance=old))
    assert small.reflectance.attrs["level"] == "stored"
    np.testing.assert_array_equal(small.reflectance, means.values)
