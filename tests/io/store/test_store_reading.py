"""What readers get of a store: what was written, an error, or what `verify` alone can tell."""

import json
import os
import pickle
import shutil
import time
from collections.abc import Callable
from pathlib import Path

import fsspec
import numpy as np
import pytest
import xarray as xr
import zarr
from support.refusals import expect_error, expect_errors, refusal

from hyperpaint.base.errors import (
    IncompleteStoreError,
    MissingExtraError,
    PaintError,
    PaintWarning,
    StoreError,
)
from hyperpaint.io.store import (
    is_complete,
    list_groups,
    load_group,
    open_store,
    open_unverified,
    to_store,
    verify,
)

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


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 4
    path.write_bytes(data)


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


def test_all_that_is_wrong_is_listed(store: Path) -> None:
    array_of(
        store, shape=[10**12], chunk_grid={"name": "regular", "configuration": {"chunk_shape": [10**11]}}
    )
    assert len(expect_error(StoreError, None, lambda: open_store(store, GROUP)).problems) == 2


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


def test_too_many_nodes(store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hyperpaint.io.store.manifest.MAX_NODES", 3)
    with refusal(StoreError, "nodes-too-many", "more than 3 "):
        verify(store)


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
