"""Chunks, codec and encodings on disk."""

import sys
from pathlib import Path
from typing import Any

import dask
import dask.array as da
import numpy as np
import pytest
import xarray as xr
import zarr
from hypothesis import given, strategies as st
from support.painted_lines import raw
from support.refusals import expect_error

import hyperpaint as hp
from hyperpaint.base.errors import IncompleteStoreError, SchemaError, StoreError
from hyperpaint.io.store import computing
from hyperpaint.io.store.computing import disk_needed, with_layout


@given(st.lists(st.integers(1, 90), min_size=1, max_size=12), st.integers(1, 40))
def test_regrouped_chunks_start_at_storage_chunks(pieces: list[int], step: int) -> None:
    made = computing.regroup(pieces, step)
    starts = np.cumsum((0, *made))[:-1]
    assert sum(made) == sum(pieces)
    assert (starts % step == 0).all()
    assert all(size >= step for size in made[:-1])
    assert computing.regroup(made, step) == made
    # no task gets to hold more than the pieces it is made of, and what completes its first chunk
    assert max(made) <= max(pieces) + step


@pytest.mark.parametrize("pieces", [(32,) * 5, (64, 32, 7), (128,), (31,)])
def test_aligned_chunks_stay(pieces: tuple[int, ...]) -> None:
    assert computing.regroup(pieces, 32) == pieces


@pytest.mark.parametrize(
    ("dims", "shape", "expected"),
    [
        (("along_track", "band", "cross_track"), (2000, 272, 640), (32, 272, 640)),
        (("along_track", "band", "cross_track"), (7, 272, 640), (7, 272, 640)),
        (("along_track", "cross_track"), (2000, 640), (32, 640)),
        (("band", "along_track"), (4, 2000), (4, 32)),
        (("along_track",), (100_000,), (100_000,)),
        (("band", "cross_track"), (272, 640), (272, 640)),
        (("irradiance_time", "irradiance_wavelength"), (3600, 2151), (3600, 2151)),
        (("irradiance_time", "irradiance_wavelength"), (86_400, 2151), (1949, 2151)),
        (("y", "x", "band"), (1000, 900, 272), (128, 128, 272)),
        ((), (), ()),
    ],
)
def test_storage_chunks(dims: tuple[str, ...], shape: tuple[int, ...], expected: tuple[int, ...]) -> None:
    assert computing.storage_chunks(dims, shape, 4) == expected


@pytest.mark.parametrize("dtype", ["uint16", "float32", "float64", "int64", "uint8", "bool", "int16"])
@pytest.mark.parametrize("lines", [32, 5])
@pytest.mark.parametrize("codec", ["compact", "fast"])
@pytest.mark.parametrize("package", ["blosc", "numcodecs"])
def test_chunk_has_the_bytes_that_zarr_writes(
    dtype: str, lines: int, codec: Any, package: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if package == "blosc":
        pytest.importorskip("blosc")
    else:
        monkeypatch.setitem(sys.modules, "blosc", None)
    monkeypatch.setattr(computing, "_blosc", computing._blosc.__wrapped__)
    values = (np.random.default_rng(0).random((lines, 7, 11)) * 100).astype(dtype)
    encoding = computing.encoding_of(
        xr.Variable(("along_track", "band", "cross_track"), np.zeros((64, 7, 11), dtype)), codec
    )
    array = zarr.create_array(
        tmp_path / "a.zarr",
        shape=(lines, 7, 11),
        dtype=dtype,
        chunks=encoding["chunks"],
        compressors=encoding["compressors"],
        fill_value=encoding["fill_value"],
    )
    array[:] = values
    encoded, crc = computing.encode_chunk(values, encoding["chunks"], encoding["fill_value"], codec)
    assert (tmp_path / "a.zarr/c/0/0/0").read_bytes() == encoded + crc


@pytest.mark.parametrize(
    ("dtype", "fill"),
    [
        ("uint16", 65535),
        ("uint8", 255),
        ("int16", 32767),
        ("int64", 65535),
        ("bool", False),
        ("M8[ns]", np.iinfo("i8").min),
    ],
)
def test_fill_value_fits_the_dtype(dtype: str, fill: int) -> None:
    assert computing.fill_value(np.dtype(dtype)) == fill


def test_float_fill_is_nan_of_the_dtype() -> None:
    fill = computing.fill_value(np.dtype("float32"))
    assert fill.dtype == "float32"
    assert np.isnan(fill)


@given(
    st.lists(st.integers(1, 50), min_size=1, max_size=5),
    st.sampled_from([(6,), (1, 5), (2, 2, 2)]),
)
def test_prepared_blocks_hold_whole_storage_chunks(lines: list[int], bands: tuple[int, ...]) -> None:
    data = da.zeros((sum(lines), 6, 4), chunks=(tuple(lines), bands, 3), dtype="float32")
    chunks = computing.prepare(
        xr.Dataset({"radiance": (("along_track", "band", "cross_track"), data)}), ""
    ).radiance.chunks
    assert chunks is not None
    assert chunks[1:] == ((6,), (4,))
    assert all(size % 32 == 0 for size in chunks[0][:-1])


def test_prepare_lists_all_problems() -> None:
    dataset = xr.Dataset(
        {
            "a/b": ("x", [1]),
            "when": ("x", [1], {"start": np.datetime64("2026-01-01")}),
            "thing": ("x", np.array([{}], dtype=object)),
        },
        attrs={"o": object()},
    )
    caught = expect_error(StoreError, None, lambda: computing.prepare(dataset, "g"))
    assert all(text in str(caught) for text in ("'a/b'", "'start' of 'when'", "'thing'", "'o'"))


def test_multi_index_is_refused_with_the_mend() -> None:
    dataset = xr.Dataset(coords={"a": ("x", [1, 2]), "b": ("x", [3, 4])}).set_index(x=["a", "b"])
    expect_error(StoreError, "reset_index", lambda: computing.prepare(dataset, ""))


# --- cubes cut into groups of bands: the same values for every reader, verified, resumed and planned for ----


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
