"""What readers get of a store: what was written, an error, or what `verify` alone can tell."""

import json
import os
import pickle
import shutil
import sys
import time
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import dask
import dask.array as da
import fsspec
import numpy as np
import pytest
import xarray as xr
import zarr
from hypothesis import given, strategies as st
from support.codecs import flip
from support.painted_lines import raw
from support.refusals import expect_error, expect_errors, expect_refusals

import hyperpaint as hp
from hyperpaint.base.constants import KEPT_BITS
from hyperpaint.base.errors import (
    IncompleteStoreError,
    MissingExtraError,
    PaintError,
    PaintWarning,
    SchemaError,
    StoreError,
)
from hyperpaint.base.schema import FORMAT_VERSION
from hyperpaint.io.store import (
    computing,
    is_complete,
    list_groups,
    load_group,
    open_store,
    open_unverified,
    to_store,
    verify,
)
from hyperpaint.io.store.computing import disk_needed, with_layout

CUBE = ("along_track", "band", "cross_track")
GROUP = "flightlines/raw_0"


def scene(value: int = 1, lines: int = 128) -> xr.Dataset:
    return xr.Dataset(
        {
            "counts": (CUBE, np.arange(lines * 20, dtype="u2").reshape(lines, 4, 5) % 97 + 1000 * value),
            "paint": ("band", np.array([f"{name}{value}" for name in "abcd"], object)),
            "note": ((), f"scene {value}"),
        },
        {"frame": ("along_track", np.arange(lines) + 10_000 * value)},
        {"srf_shape": "gaussian"},
    )


@pytest.fixture
def store(tmp_path: Path) -> Path:
    return to_store(scene(), tmp_path / "lot.zarr", GROUP)


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-7])


def empty(path: Path) -> None:
    path.write_bytes(b"")


def stale(path: Path) -> None:
    older = to_store(scene(2), path.parents[path.parts[::-1].index("lot.zarr")] / "older.zarr", GROUP)
    shutil.copy(older / path.relative_to(next(p for p in path.parents if p.name == "lot.zarr")), path)


def swap(path: Path) -> None:
    one, other = path.parents[2] / "0/0/0", path.with_name("t")
    os.rename(path, other)
    os.rename(one, path)
    os.rename(other, one)


# --- chunks ------------------------------------------------------------------------------------------------


def test_all_that_is_written_is_read(store: Path) -> None:
    opened = open_store(store, GROUP).load()
    xr.testing.assert_identical(opened.drop_attrs(), scene().drop_attrs())
    assert opened.encoding["source"] == str(store)
    assert not [key for key in opened.attrs if key.startswith("hyperpaint_co")]
    # lines that do not fill the last chunk do not count
    to_store(scene(lines=70), store, "short")
    xr.testing.assert_equal(open_store(store, "short"), scene(lines=70))


@pytest.mark.parametrize("key", ["counts/c/2/0/0", "frame/c/0", "paint/c/0", "note/c"])
@pytest.mark.parametrize("damage", [flip, cut, empty])
def test_zarr_refuses_a_damaged_chunk(damage: Callable[[Path], None], key: str, store: Path) -> None:
    damage(store / GROUP / key)
    refusals = (ValueError, StoreError, RuntimeError)
    expect_errors(
        (refusals, None, lambda: open_store(store, GROUP).load()),
        (refusals, None, lambda: xr.open_zarr(store, group=GROUP).load()),
    )
    assert verify(store).problems == (f"/{GROUP}/{key}: the chunk is damaged [chunk-damaged]",)


@pytest.mark.parametrize("damage", [stale, swap])
def test_verify_alone_tells_whole_chunks_of_elsewhere(damage: Callable[[Path], None], store: Path) -> None:
    damage(store / GROUP / "counts/c/2/0/0")
    assert not open_store(store, GROUP).load().equals(scene())
    (problem,) = verify(store).problems
    assert problem.startswith(f"/{GROUP}/counts: ")
    assert problem.endswith("[chunk-changed]")


def test_a_missing_chunk_is_not_read_as_fill(store: Path) -> None:
    (store / GROUP / "counts/c/1/0/0").unlink()
    expect_error(IncompleteStoreError, "chunk-missing", lambda: open_store(store, GROUP))
    # where nobody asks whether it is whole, a chunk may be left out
    assert open_unverified(store, GROUP)["counts"].load()[40, 0, 0] == 65535


def test_behind_a_url_too() -> None:
    url = str(to_store(scene(), "memory://reading.zarr", GROUP))
    xr.testing.assert_equal(open_store(url, GROUP), scene())
    fs = fsspec.filesystem("memory")
    (first, second) = (f"/reading.zarr/{GROUP}/counts/c/{number}/0/0" for number in (0, 1))
    fs.pipe_file(first, fs.cat_file(second))
    assert "exchanged, stale or altered" in str(verify(url))
    fs.rm(first)
    assert "counts/c/0/0/0: the chunk is missing" in str(verify(url))
    expect_error(IncompleteStoreError, "chunk-missing", lambda: open_store(url, GROUP))


def test_what_is_opened_travels_and_keeps_its_codec_and_name(store: Path) -> None:
    opened = open_store(store, GROUP)
    names = [type(codec).__name__ for codec in opened.counts.encoding["compressors"]]
    assert names == ["BloscCodec", "Crc32cCodec"]
    xr.testing.assert_identical(pickle.loads(pickle.dumps(opened)).load(), opened)
    assert open_store(store, GROUP).counts.data.name == opened.counts.data.name
    to_store(scene(2), store, GROUP, overwrite=True)
    assert open_store(store, GROUP).counts.data.name != opened.counts.data.name
    xr.testing.assert_equal(open_store(store, GROUP), scene(2))


def test_a_group_in_the_root_outlives_what_is_added_beside_it(tmp_path: Path) -> None:
    path = to_store(scene(), tmp_path / "lot.zarr")
    opened = open_store(path)
    to_store(scene(2), path, "other")
    xr.testing.assert_equal(opened, scene())


@pytest.mark.filterwarnings("ignore:Consolidated metadata")
@pytest.mark.parametrize("options", [{}, {"consolidated": False}])
@pytest.mark.parametrize("keeps_attrs", [False, True])
def test_what_others_add_is_opened_and_noted(
    options: dict[str, bool], keeps_attrs: bool, store: Path
) -> None:
    ndvi = xr.Dataset({"ndvi": (("along_track", "cross_track"), np.ones((128, 5)))})
    if keeps_attrs:
        ndvi.attrs = open_store(store, GROUP).attrs
    # xarray replaces the attributes of the group by those of what is added
    ndvi.to_zarr(store, group=GROUP, mode="a", **options)
    ndvi.to_zarr(store, group="of_others", **options)
    with pytest.warns(PaintWarning, match="attributes-replaced"):
        opened = open_store(store, GROUP)
    np.testing.assert_array_equal(opened.ndvi, ndvi.ndvi)
    xr.testing.assert_equal(opened.drop_vars("ndvi"), scene())
    report = verify(store)
    assert report.ok, str(report)
    assert f"/{GROUP}/ndvi: added by another program" in str(report)
    assert {note.partition(":")[0] for note in report.notes} == {f"/{GROUP}", f"/{GROUP}/ndvi", "/of_others"}
    with pytest.warns(PaintWarning, match="attributes-replaced"):
        xr.testing.assert_equal(open_store(store)["of_others"].to_dataset(), ndvi)
    # their chunks are read as well
    cut(store / "of_others/ndvi/c/0/0")
    assert "/of_others/ndvi: chunk (0, 0) cannot be read" in str(verify(store))


# --- attributes and strays ---------------------------------------------------------------------------------


def change(path: Path, **attributes: str) -> None:
    document = json.loads(path.read_text())
    document["attributes"] |= attributes
    path.write_text(json.dumps(document))


def test_changed_attributes_are_not_handed_out(store: Path) -> None:
    change(store / GROUP / "zarr.json", srf_shape="slit")
    assert not is_complete(store, GROUP)
    expect_error(IncompleteStoreError, "attributes-changed", lambda: open_store(store, GROUP))


@pytest.mark.parametrize("group", ["", "flightlines"])
def test_groups_without_arrays_are_verified(group: str, store: Path) -> None:
    assert verify(store).ok
    change(store / group / "zarr.json", created="long ago")
    assert f"/{group}: attributes differ from those written" in str(verify(store))
    (store / group / "zarr.json").unlink()
    assert "missing" in str(verify(store))


def test_what_is_not_of_the_store_is_told(store: Path) -> None:
    (store / GROUP / "junk.bin").write_text("x")
    (store / GROUP / "counts/c/9").write_text("x")
    (store / "more").mkdir()
    (store / "more/x").write_text("x")
    (store / ".DS_Store").write_text("of a file manager")
    report = verify(store)
    assert {problem.partition(":")[0] for problem in report.problems} == {f"/{GROUP}/counts/c/9"}
    assert {note.partition(":")[0] for note in report.notes} == {"/more", f"/{GROUP}/junk.bin"}
    zarr.open_group(store / GROUP).attrs["note"] = "of a user"
    assert open_store(store, GROUP).attrs["note"] == "of a user"


# --- what must not be read ---------------------------------------------------------------------------------


def array_of(store: Path, **changes: object) -> None:
    # Add an array of another program whose metadata have other entries
    zarr.create_array(store / GROUP / "a", shape=(4,), chunks=(2,), dtype="f4", dimension_names=["x"])
    path = store / GROUP / "a/zarr.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"shape": [10**12]}, "chunks"),
        ({"shape": [2**30]}, "size-too-large"),
        ({"chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [2**40]}}}, "chunks of"),
        ({"codecs": [{"name": "numcodecs.pickle", "configuration": {"protocol": 5}}]}, "store-unreadable"),
        ({"data_type": "object"}, "store-unreadable"),
        ({"shape": "x"}, "store-unreadable"),
        ({"attributes": {"x": "y" * 70_000_000}}, "bytes"),
    ],
)
def test_metadata_that_are_refused(changes: dict[str, object], match: str, store: Path) -> None:
    array_of(store, **changes)
    expect_error(StoreError, match, lambda: open_store(store, GROUP))
    report = verify(store) if "attributes" not in changes else None
    assert report is None or not report.ok


def test_all_that_is_wrong_is_listed(store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    array_of(
        store, shape=[10**12], chunk_grid={"name": "regular", "configuration": {"chunk_shape": [10**11]}}
    )
    assert len(expect_error(StoreError, None, lambda: open_store(store, GROUP)).problems) == 2
    # one store has so many nodes
    monkeypatch.setattr("hyperpaint.io.store.manifest.MAX_NODES", 3)
    expect_refusals((StoreError, "nodes-too-many", "more than 3 ", lambda: verify(store)))


def test_a_group_that_is_loaded_must_have_about_its_size_on_the_disk(tmp_path: Path) -> None:
    path = tmp_path / "empty.zarr"
    zarr.create_array(
        path / "a", shape=(2**13, 2**13), chunks=(2**11, 2**11), dtype="f4", dimension_names="xy"
    )
    zarr.create_group(path)
    expect_error(StoreError, "file-too-large", lambda: load_group(path))


EMPTY_GROUP = '{"zarr_format": 3, "node_type": "group", "attributes": {}}'


@pytest.mark.parametrize(("name", "depth"), [("d", 600), ("d" * 200, 30)])
@pytest.mark.parametrize("door", [verify, list_groups, lambda path: open_store(path, "no such group")])
def test_deep_stores_are_refused_at_once(
    name: str, depth: int, door: Callable[[Path], object], store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(store)
    for _ in range(depth):
        os.mkdir(name)
        os.chdir(name)
        Path("zarr.json").write_text(EMPTY_GROUP)
    os.chdir(store)
    begun = time.perf_counter()
    assert expect_error(StoreError, "nodes-too-many", lambda: door(store)).codes == (
        "nodes-too-many" if door in (verify, list_groups) else "group-unknown",
    )
    assert time.perf_counter() - begun < 2
    # what is whole can still be read
    xr.testing.assert_equal(open_store(store, GROUP), scene())


# --- places ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("door", [verify, open_store, list_groups])
@pytest.mark.parametrize(
    ("url", "error", "match"),
    [
        ("nosuch://x", StoreError, "nosuch"),
        ("zip://x::/etc/hostname", StoreError, "path-not-plain"),
        ("s3://x/y", PaintError, "dependency-missing"),
        ("not_there.zarr", StoreError, "store-unreadable"),
    ],
)
def test_places_that_cannot_be_opened(
    door: Callable[[str], object], url: str, error: type[PaintError], match: str
) -> None:
    if url.startswith("s3"):
        import importlib.util

        if importlib.util.find_spec("s3fs") is not None:
            pytest.skip("it would ask the network")
        error = MissingExtraError
    expect_error(error, match, lambda: door(url))


def test_the_store_itself_may_be_reached_through_a_link(store: Path) -> None:
    link = store.with_name("link.zarr")
    link.symlink_to(store)
    assert verify(link).ok
    xr.testing.assert_equal(open_store(link, GROUP), scene())


def test_texts_and_empty_arrays_in_several_chunks(tmp_path: Path) -> None:
    names = xr.Dataset(
        {
            "t": (("along_track", "b"), np.full((70, 2), "abc", object)),
            "empty": (("along_track", "c"), np.zeros((70, 0))),
        }
    )
    assert verify(to_store(names, tmp_path / "n.zarr")).ok
    xr.testing.assert_equal(open_store(tmp_path / "n.zarr").load(), names)


# --- chunks, codec and encodings on disk ------------------------------------------------------------------


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
    monkeypatch.setattr(computing, "blosc_encoder", computing.blosc_encoder.__wrapped__)
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
        ("float32", np.float32("nan")),
    ],
)
def test_fill_value_fits_the_dtype(dtype: str, fill: Any) -> None:
    found = computing.fill_value(np.dtype(dtype))
    np.testing.assert_equal(found, fill)
    assert dtype != "float32" or found.dtype == dtype


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
    expect_error(SchemaError, "choice-unknown", lambda: hp.to_store(cube(), store, layout="tiles"))


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


# --- Stores of every format that was released, and of the present one, are read: one of each is kept ---


RELEASED = Path(__file__).with_name("released")


def test_a_store_of_every_format_is_kept() -> None:
    kept = {path.name for path in RELEASED.glob("format_*")}
    assert kept == {f"format_{number}.zip" for number in range(1, FORMAT_VERSION + 1)}


def _unpacked(name: str | int, folder: Path) -> Path:
    stem = f"format_{name}" if isinstance(name, int) else name
    with zipfile.ZipFile(RELEASED / f"{stem}.zip") as archive:
        archive.extractall(folder)
    return folder / f"{stem}.zarr"


def _has_its_counts(tree: xr.DataTree) -> None:
    for number in (1, 2):
        expected = np.random.default_rng(number).integers(0, 4096, (40, 3, 4), dtype="uint16")
        np.testing.assert_array_equal(tree[f"flightlines/raw_{number}"]["counts"].values, expected)


@pytest.mark.parametrize("number", [1, 2])
def test_a_store_of_an_older_format_opens_and_is_noted(number: int, tmp_path: Path) -> None:
    # Two lines as 0.1 and 0.2 began to write them; that of format 2 has a group of a user
    path = _unpacked(number, tmp_path)
    report = hp.verify(path)
    assert report.ok, str(report)
    assert "hyperpaint 0.2 or older" in report.notes[0]
    assert {"flightlines/raw_1", "flightlines/raw_2"} <= set(report.groups)
    tree = hp.open_store(path)
    _has_its_counts(tree)
    assert not [key for key in tree["flightlines/raw_1"].attrs if key.startswith("hyperpaint_complete")]
    chunk = path / "flightlines/raw_1/counts/c/0/0/0"
    chunk.write_bytes(chunk.read_bytes()[:-1])
    assert "/flightlines/raw_1/counts: chunk (0, 0, 0) cannot be read" in str(hp.verify(path))


@pytest.mark.parametrize("number", [1, 2])
def test_a_store_of_an_older_format_takes_more_groups(number: int, tmp_path: Path) -> None:
    path = _unpacked(number, tmp_path)
    hp.to_store(xr.Dataset({"a": ("x", [1.0])}), path, "more")
    report = hp.verify(path)
    assert report.ok, str(report)
    assert len(report.notes) >= 2  # the groups of before are not in the manifest
    _has_its_counts(hp.open_store(path))
    shutil.rmtree(path / "more")
    assert "/more: deleted" in str(hp.verify(path))


def test_a_store_of_format_3_is_whole(tmp_path: Path) -> None:
    path = _unpacked(3, tmp_path)
    report = hp.verify(path)
    assert (report.ok, report.notes) == (True, ()), str(report)
    _has_its_counts(hp.open_store(path))
    shutil.rmtree(path / "flightlines/raw_1")
    assert "/flightlines/raw_1: deleted" in str(hp.verify(path))


@pytest.mark.filterwarnings("ignore::hyperpaint.base.errors.PaintWarning")  # of later numerics
def test_a_store_of_release_0_2_is_whole_and_gives_its_reflectance(tmp_path: Path) -> None:
    # A simulated line as `process` of 0.2.0 stored it, with its collect and calibration
    path = _unpacked("release_0_2", tmp_path)
    report = hp.verify(path)
    assert report.ok, str(report)
    line = hp.open_store(path, "flightlines/raw_0")
    assert line.attrs["hyperpaint_version"] == "0.2.0"
    again = line.drop_vars(["reflectance", "quality"]).paint.reflectance()
    np.testing.assert_allclose(again.reflectance, line.reflectance, rtol=2.0**-KEPT_BITS)
    np.testing.assert_array_equal(again.quality, line.quality)
