"""What is read of a store that nobody vouches for: honest ones whole, others not at all."""

from __future__ import annotations

import pickle
import warnings
from pathlib import Path
from typing import Any

import google_crc32c
import numpy as np
import pytest
import xarray as xr
import zarr
from hypothesis import given, settings, strategies as st
from numcodecs import Blosc

from hyperpaint.base.errors import IncompleteStoreError, StoreError
from hyperpaint.io import store as hp
from hyperpaint.io.store import guard
from hyperpaint.io.store.documents import MOST_CHUNKS, ChunkForm, array_form, parse_document
from hyperpaint.io.store.location import Location, plain_file


def document(**changes: Any) -> dict[str, Any]:
    made = {
        "zarr_format": 3,
        "node_type": "array",
        "shape": [70, 6],
        "data_type": "uint16",
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [32, 6]}},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
        "fill_value": 0,
        "codecs": [{"name": "bytes", "configuration": {"endian": "little"}}, "blosc", "crc32c"],
    }
    return made | changes


# --- metadata ----------------------------------------------------------------------------------------------


def test_form_of_an_array() -> None:
    form = array_form(document(), "a")
    assert form == ChunkForm((70, 6), (32, 6), 2, ("blosc", "crc32c"))
    assert (form.grid, form.items, form.decoded_bytes) == ((3, 1), 192, 384)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"data_type": "object"}, "data_type 'object'"),
        ({"data_type": {"name": "struct", "configuration": {"fields": []}}}, "data_type"),
        ({"shape": [True, 6]}, "shape"),
        ({"shape": [70.0, 6]}, "shape"),
        ({"shape": "70"}, "shape"),
        ({"shape": None}, "shape None"),
        ({"chunk_grid": {"name": "rectilinear"}}, "chunk_grid"),
        ({"shape": [MOST_CHUNKS + 1, 6], "chunk_grid": {
            "name": "regular", "configuration": {"chunk_shape": [1, 6]}}}, "1000001 chunks"),
        ({"codecs": []}, "codecs"),
        ({"codecs": ["bytes", {"name": 3}]}, "codec {'name': 3}"),
        ({"codecs": ["blosc"]}, "expected those of hyperpaint: bytes"),
        ({"codecs": ["bytes", "bytes"]}, "expected those of hyperpaint: bytes"),
        ({"codecs": ["transpose", "bytes"]}, "codec 'transpose', expected those of hyperpaint: bytes"),
        ({"codecs": ["bytes", "crc32c", "blosc"]}, "expected those of hyperpaint: bytes"),
        ({"codecs": [{"name": "bytes", "configuration": {"endian": "big"}}]}, "expected those of hyperpaint"),
        ({"codecs": ["bytes", "zstd"]}, "codec 'zstd', .*plain xarray.open_zarr"),
        ({"codecs": ["vlen-utf8"]}, "expected those of hyperpaint: bytes"),
        ({"data_type": "string"}, "expected those of hyperpaint: vlen-utf8"),
        ({"codecs": ["bytes", {"name": "blosc", "configuration": {"clevel": {}}}]}, "configuration of codec"),
        ({"dimension_names": [1, 2]}, "dimension_names"),
        ({"chunk_key_encoding": {"name": "default", "configuration": {"separator": "../"}}}, "chunk_key"),
        ({"storage_transformers": [{}]}, "storage_transformers"),
    ],
)  # fmt: skip
def test_metadata_that_are_refused(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(StoreError, match=said):
        array_form(document(**changes), "a")


def test_all_that_is_wrong_is_said_at_once() -> None:
    with pytest.raises(StoreError) as caught:
        array_form(document(data_type="object", shape=[-1], codecs=["pickle"]), "counts")
    assert [line.split()[0] for line in str(caught.value).splitlines()] == [
        "counts",
        "data_type",
        "shape",
        "codec",
    ]


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=6,
)


@settings(max_examples=150)
@given(key=st.sampled_from(sorted(document())), value=json_values)
def test_any_metadata_are_read_or_refused(key: str, value: Any) -> None:
    try:
        form = array_form(document(**{key: value}), "a")
    except StoreError:
        return
    assert form.decoded_bytes <= 2**30


def test_depth_is_bounded_between_ours_and_theirs() -> None:
    assert parse_document(b'{"a": ' + b"[" * 60 + b"]" * 60 + b"}", "x")
    with pytest.raises(IncompleteStoreError, match="nested more than 64 deep"):
        parse_document(b'{"a": ' + b"[" * 70 + b"]" * 70 + b"}", "x")


# --- chunks ------------------------------------------------------------------------------------------------


def form(*codecs: str, count: int = 96) -> ChunkForm:
    return ChunkForm((count,), (count,), 4, codecs)


def decoded(chunk: ChunkForm, frame: bytes) -> np.ndarray[Any, Any]:
    return guard.decode_chunk(chunk, np.frombuffer(frame, np.uint8))


@pytest.mark.parametrize("count", [1, 96, 70_000, 400_000])
@pytest.mark.parametrize("noise", [False, True])
def test_honest_frames_pass(count: int, noise: bool) -> None:
    rng = np.random.default_rng(count)
    values = rng.integers(0, 2**31, count, dtype="i4") if noise else np.arange(count, dtype="i4")
    frame = bytes(Blosc().encode(values))
    np.testing.assert_array_equal(decoded(form("blosc", count=count), frame).view("i4"), values)
    sealed = frame + int(google_crc32c.value(frame)).to_bytes(4, "little")
    np.testing.assert_array_equal(decoded(form("blosc", "crc32c", count=count), sealed).view("i4"), values)
    with pytest.raises(StoreError, match="its crc32c is"):
        decoded(form("blosc", "crc32c", count=count), frame + b"\0\0\0\0")
    with pytest.raises(StoreError, match=r"declares|more than"):
        decoded(form("blosc", count=count + 1), frame)


@settings(max_examples=300)
@given(place=st.integers(0, 400), new=st.binary(max_size=6), cut=st.integers(0, 400))
def test_any_frame_passes_or_is_refused_and_never_holds_more(place: int, new: bytes, cut: int) -> None:
    frame = bytearray(Blosc().encode(np.arange(96, dtype="i4")))
    frame[place : place + len(new)] = new
    data = bytes(frame[: len(frame) - cut] if cut else frame)
    try:
        chunk = decoded(form("blosc"), data)
    except StoreError:
        return
    assert chunk.nbytes == 384


def test_plain_bytes_have_their_length() -> None:
    decoded(ChunkForm((3,), (3,), 8, ()), bytes(24))
    with pytest.raises(StoreError, match="it holds 23 bytes, the array declares 24"):
        decoded(ChunkForm((3,), (3,), 8, ()), bytes(23))


# --- stores ------------------------------------------------------------------------------------------------


def dataset() -> xr.Dataset:
    rng = np.random.default_rng(1)
    return xr.Dataset(
        {
            "counts": (("along_track", "band"), rng.integers(0, 4000, (70, 3)).astype("u2")),
            "paint": ("band", np.array(["rot", "grün", ""], dtype=object)),
            "flag": ("band", [True, False, True]),
            "scalar": ((), 1.5),
        },
        {"time": ("along_track", np.datetime64("2024-05-21", "ns") + np.arange(70))},
    )


def test_what_to_store_writes_is_read_back(tmp_path: Path) -> None:
    written = dataset()
    hp.to_store(written, tmp_path / "lot.zarr", "a/b")
    opened = hp.open_store(tmp_path / "lot.zarr", "a/b")
    assert opened.encoding["source"] == str(tmp_path / "lot.zarr")
    xr.testing.assert_identical(pickle.loads(pickle.dumps(opened)).load().drop_attrs(), written.drop_attrs())
    again = hp.open_store(tmp_path / "lot.zarr", "a/b")
    assert again["counts"].data.name == opened["counts"].data.name
    assert hp.verify(tmp_path / "lot.zarr").ok


def test_behind_a_url(request: pytest.FixtureRequest) -> None:
    url = f"memory://{request.node.name}.zarr"
    hp.to_store(dataset(), url)
    xr.testing.assert_equal(hp.open_store(url).load(), dataset())
    location = Location.of(url)
    key = location.key("counts/c/0/0")
    location.fs.pipe_file(key, location.fs.cat_file(key)[:-9] + bytes(9000))
    with pytest.raises(StoreError, match="expected at most"):
        hp.open_store(url).load()
    assert "expected at most" in str(hp.verify(url))
    location.fs.rm(key)
    with pytest.raises(IncompleteStoreError, match="is missing"):
        hp.open_store(url).load()


def test_a_missing_chunk_is_not_read_as_fill(tmp_path: Path) -> None:
    hp.to_store(dataset(), tmp_path / "lot.zarr")
    opened = hp.open_store(tmp_path / "lot.zarr")
    (tmp_path / "lot.zarr/counts/c/1/0").unlink()
    assert opened["counts"][:32].load().shape == (32, 3)
    with pytest.raises(IncompleteStoreError, match=r"counts/c/1/0 is missing; run hyperpaint\.verify"):
        opened["counts"].load()
    # where nobody said that it is whole, a chunk may be left out
    assert hp.open_unverified(tmp_path / "lot.zarr")["counts"].load()[40, 0] == 65535


def written_by_another(path: Path, compressors: Any) -> Path:
    encoding = {name: {"compressors": compressors} for name in dataset().variables}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        dataset().to_zarr(path, encoding=encoding, zarr_format=3)
    return path


@pytest.mark.parametrize("compressor", [None, zarr.codecs.BloscCodec(cname="zstd")])
def test_stores_of_other_programs_with_our_codecs_are_read(compressor: Any, tmp_path: Path) -> None:
    path = written_by_another(tmp_path / "other.zarr", compressor)
    xr.testing.assert_equal(hp.load_unverified(path), dataset())


@pytest.mark.parametrize("codec", ["gzip", "zstd"])
def test_foreign_compressors_are_refused_with_a_way_out(codec: str, tmp_path: Path) -> None:
    compressor = {"gzip": zarr.codecs.GzipCodec(), "zstd": zarr.codecs.ZstdCodec()}[codec]
    path = written_by_another(tmp_path / "other.zarr", compressor)
    said = rf"codec '{codec}', expected those of hyperpaint.*; .* open it with plain xarray\.open_zarr"
    with pytest.raises(StoreError, match=said):
        hp.load_unverified(path)
    xr.testing.assert_equal(xr.open_zarr(path).load(), dataset())


def test_shards_and_zarr_2_are_refused_with_a_way_out(tmp_path: Path) -> None:
    array = zarr.create_array(tmp_path / "s.zarr/a", shape=(8,), chunks=(2,), shards=(4,), dtype="f4")
    array[:] = 1.0
    zarr.create_group(tmp_path / "s.zarr", zarr_format=3)
    with pytest.raises(StoreError, match=r"sharding_indexed'.*plain xarray.open_zarr"):
        hp.load_unverified(tmp_path / "s.zarr")
    zarr.create_group(tmp_path / "v2.zarr", zarr_format=2)
    with pytest.raises(StoreError, match="Zarr 2: rewrite it"):
        hp.load_unverified(tmp_path / "v2.zarr")


def test_an_old_numcodecs_is_refused(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    import numcodecs

    hp.to_store(dataset(), tmp_path / "lot.zarr")
    monkeypatch.setattr(numcodecs, "__version__", "0.16.5")
    guard._check_numcodecs.cache_clear()
    with pytest.raises(StoreError, match=r"pip install 'numcodecs>=0.16.6'"):
        hp.open_store(tmp_path / "lot.zarr")
    monkeypatch.undo()
    guard._check_numcodecs.cache_clear()
    assert hp.open_store(tmp_path / "lot.zarr").sizes["band"] == 3


@pytest.mark.parametrize("key", ["../x", "a/../x", "/x", "a//x", "./x", "a\\x", "a\0x", ""])
def test_paths_that_are_none_inside_a_store(key: str, tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="no path inside a store"):
        plain_file(str(tmp_path), key)


def test_the_store_itself_may_be_reached_through_a_link(tmp_path: Path) -> None:
    hp.to_store(dataset(), tmp_path / "disk/lot.zarr")
    (tmp_path / "lot.zarr").symlink_to(tmp_path / "disk/lot.zarr")
    assert hp.verify(tmp_path / "lot.zarr").ok
    assert hp.open_store(tmp_path / "lot.zarr").load().sizes["along_track"] == 70


def test_texts_and_empty_arrays_in_several_chunks(tmp_path: Path) -> None:
    names = xr.Dataset(
        {
            "t": (("along_track", "b"), np.full((70, 2), "abc", object)),
            "empty": (("along_track", "c"), np.zeros((70, 0))),
        }
    )
    hp.to_store(names, tmp_path / "n.zarr")
    assert hp.verify(tmp_path / "n.zarr").ok
    xr.testing.assert_equal(hp.open_store(tmp_path / "n.zarr").load(), names)


def test_the_list_of_five_hundred_lines_is_read(tmp_path: Path) -> None:
    cube = xr.Dataset({"counts": (("along_track", "band"), np.ones((4, 3)), {"units": "1"})})
    array = (hp.to_store(cube, tmp_path / "a") / "counts/zarr.json").read_text()
    arrays = ", ".join(f'"flightlines/raw_{number}/counts": {array}' for number in range(20_500))
    assert len(parse_document(f"{{{arrays}}}".encode(), "here")) == 20_500
