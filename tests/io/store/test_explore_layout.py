"""Cubes cut into groups of bands: the same values for every reader, verified, resumed and planned for."""

from pathlib import Path
from typing import Any

import dask
import dask.array as da
import numpy as np
import pytest
import xarray as xr
from support.painted_lines import raw
from support.refusals import expect_error

import hyperpaint as hp
from hyperpaint.base.errors import IncompleteStoreError, SchemaError
from hyperpaint.io.store.computing import disk_needed, with_layout

DIMS = ("along_track", "band", "cross_track")


def cube(lines: int = 70, bands: int = 20, columns: int = 6) -> xr.Dataset:
    values = np.random.default_rng(0).integers(0, 4000, (lines, bands, columns)).astype(np.uint16)
    flags = values[:, 0] % 7
    return xr.Dataset(
        {"counts": (DIMS, values), "quality": (("along_track", "cross_track"), flags)},
        {"wavelength": ("band", np.linspace(400.0, 900.0, bands))},
    )


@pytest.mark.parametrize("is_lazy", [False, True])
def test_every_reader_reads_what_was_written(tmp_path: Path, *, is_lazy: bool) -> None:
    line = cube().chunk({"along_track": 32, "band": 7}) if is_lazy else cube()
    store = hp.to_store(line, tmp_path / "lot.zarr", layout="explore")
    plain, ours = xr.open_zarr(store), hp.open_store(store)
    for opened in (plain, ours, xr.open_zarr(store, chunks=None)):
        np.testing.assert_array_equal(opened.counts, line.counts)
        np.testing.assert_array_equal(opened.quality, line.quality)
    assert plain.counts.data.chunksize == ((32, 3, 6))
    assert ours.counts.data.numblocks == ((3, 1, 1))  # one task a slab
    assert ours.quality.data.chunksize == (32, 6)
    assert hp.verify(store).ok
    # a missing group of bands is noticed
    (store / "counts/c/2/4/0").rename(tmp_path / "away")
    expect_error(IncompleteStoreError, "c/2/4/0", lambda: hp.open_store(store))
    (tmp_path / "away").rename(store / "counts/c/2/4/0")
    # a copy has the layout that is asked for, not that of its source
    assert xr.open_zarr(hp.to_store(ours, tmp_path / "again.zarr")).counts.data.chunksize == (32, 20, 6)


def test_what_is_there_whole_is_not_written_again(tmp_path: Path) -> None:
    store = hp.to_store(cube(), tmp_path / "lot.zarr")
    hp.to_store(cube(), store, layout="explore")
    assert xr.open_zarr(store).counts.data.chunksize == (32, 20, 6)
    with pytest.raises(SchemaError, match="choice-unknown"):
        hp.to_store(cube(), store, layout="tiles")  # type: ignore[arg-type]


def test_a_run_cut_short_is_taken_up_in_its_own_layout(tmp_path: Path) -> None:
    whole = cube(lines=160)
    computed: list[int] = []
    is_stopping = True

    def slab(block: np.ndarray, block_info: Any = None) -> np.ndarray:
        first = block_info[0]["array-location"][0][0]
        if is_stopping and len(computed) == 2:
            raise KeyboardInterrupt
        computed.append(first)
        return block

    def lazily() -> xr.Dataset:
        data = da.from_array(whole.counts.values, chunks=(32, -1, -1), name="raw")
        data = data.map_blocks(slab, dtype=np.uint16, name="slab", meta=np.empty((0, 0, 0), np.uint16))
        return xr.Dataset({"counts": (DIMS, data)})

    store = tmp_path / "lot.zarr"
    with dask.config.set(scheduler="sync"):
        expect_error(
            KeyboardInterrupt, None, lambda: hp.to_store(lazily(), store, layout="explore", source_token="a")
        )
        is_stopping = False
        hp.to_store(lazily(), store, layout="explore", source_token="a")
    assert sorted(computed) == [0, 32, 64, 96, 128]
    np.testing.assert_array_equal(hp.open_store(store).counts, whole.counts)
    assert hp.verify(store).ok


def test_more_files_take_more_room() -> None:
    line = cube(lines=640)
    assert disk_needed(with_layout(line, "explore")) > disk_needed(line)
    assert disk_needed(with_layout(with_layout(line, "explore"), "cube")) == disk_needed(line)


def test_reflectance_is_the_same_from_both(tmp_path: Path) -> None:
    line = raw()
    cubes = hp.to_store(line, tmp_path / "cube.zarr")
    groups = hp.to_store(line, tmp_path / "explore.zarr", layout="explore")
    expected = xr.open_zarr(cubes).paint.reflectance()
    for opened in (xr.open_zarr(groups), hp.open_store(groups)):
        lazy = opened.paint.reflectance()
        assert lazy.reflectance.data.numblocks[1] == 1
        for name in ("reflectance", "quality"):
            assert lazy[name].values.tobytes() == expected[name].values.tobytes()
        band = opened.paint.pixels(wavelength=float(line.wavelength[5]))
        assert band.reflectance.values.tobytes() == expected.reflectance.values[:, 5].tobytes()
