"""What `open_store` hands out: the recorded content, or an error."""

from __future__ import annotations

import contextlib
import json
import os
import pickle
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import dask
import fsspec
import numpy as np
import pytest
import xarray as xr
import zarr

from hyperpaint.base.errors import IncompleteStoreError, MissingExtraError, PaintError, StoreError
from hyperpaint.io.store import is_complete, list_groups, open_store, open_unverified, to_store, verify

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


# --- chunks ------------------------------------------------------------------------------------------------


def test_all_that_is_written_is_read(store: Path) -> None:
    opened = open_store(store, GROUP).load()
    xr.testing.assert_equal(opened, scene())
    assert opened.counts.dtype == "uint16"
    # lines that do not fill the last chunk do not count
    to_store(scene(lines=70), store, "short")
    xr.testing.assert_equal(open_store(store, "short"), scene(lines=70))


@pytest.mark.parametrize("key", ["counts/c/2/0/0", "frame/c/0", "paint/c/0", "note/c"])
@pytest.mark.parametrize("damage", [flip, cut, empty, stale])
def test_a_damaged_chunk_is_refused_by_name(damage: Callable[[Path], None], key: str, store: Path) -> None:
    damage(store / GROUP / key)
    with pytest.raises(IncompleteStoreError, match=rf"{key} is .*run hyperpaint\.verify, and write .* again"):
        open_store(store, GROUP).load()


def test_exchanged_chunks_are_refused(store: Path) -> None:
    one, two = (store / GROUP / f"counts/c/{number}/0/0" for number in (1, 2))
    held = one.read_bytes()
    one.write_bytes(two.read_bytes())
    two.write_bytes(held)
    opened = open_store(store, GROUP)
    np.testing.assert_array_equal(opened.counts[:32], scene().counts[:32])
    for part in (slice(32, 64), slice(64, 96)):
        with pytest.raises(IncompleteStoreError, match="not what was written"):
            opened.counts[part].load()


def test_a_chunk_that_nobody_recorded_is_held_to_its_own_checksum(store: Path) -> None:
    flip(store / GROUP / "counts/c/1/0/0")
    with pytest.raises(StoreError, match="its crc32c is"):
        open_unverified(store, GROUP).load()


@pytest.mark.filterwarnings("ignore:Consolidated metadata")
def test_a_chunk_without_a_checksum_fails_as_an_error_of_ours(store: Path) -> None:
    foreign = xr.Dataset({"a": ("x", np.arange(4096.0))})
    codec = {"compressors": zarr.codecs.BloscCodec()}
    foreign.to_zarr(store, group="foreign", encoding={"a": codec}, consolidated=False)
    xr.testing.assert_equal(open_unverified(store, "foreign"), foreign)
    path = store / "foreign/a/c/0"
    frame = path.read_bytes()
    path.write_bytes(frame[:16] + b"\xff" * (len(frame) - 16))
    with pytest.raises(StoreError, match="it cannot be decoded"):
        open_unverified(store, "foreign").load()


def test_behind_a_url_too() -> None:
    url = str(to_store(scene(), "memory://reading.zarr", GROUP))
    xr.testing.assert_equal(open_store(url, GROUP), scene())
    fs = fsspec.filesystem("memory")
    (first, second) = (f"/reading.zarr/{GROUP}/counts/c/{number}/0/0" for number in (0, 1))
    fs.pipe_file(first, fs.cat_file(second))
    with pytest.raises(IncompleteStoreError, match="not what was written"):
        open_store(url, GROUP).counts.load()


def test_what_is_opened_travels_and_keeps_its_codec(store: Path) -> None:
    opened = open_store(store, GROUP)
    names = [type(codec).__name__ for codec in opened.counts.encoding["compressors"]]
    assert names == ["BloscCodec", "Crc32cCodec"]
    flip(store / GROUP / "counts/c/1/0/0")
    sent = pickle.loads(pickle.dumps(opened))
    np.testing.assert_array_equal(sent.counts[:32], scene().counts[:32])
    with pytest.raises(IncompleteStoreError):
        sent.counts[32:64].load()


def test_a_group_in_the_root_outlives_what_is_added_beside_it(tmp_path: Path) -> None:
    path = to_store(scene(), tmp_path / "lot.zarr")
    opened = open_store(path)
    to_store(scene(2), path, "other")
    xr.testing.assert_equal(opened, scene())


# --- replaced groups ---------------------------------------------------------------------------------------


def test_a_replaced_group_is_not_read_on(store: Path) -> None:
    opened = open_store(store, GROUP)
    opened.counts[:32].load()
    to_store(scene(2), store, GROUP, overwrite=True)
    with pytest.raises(IncompleteStoreError, match="was replaced since it was opened; open it again"):
        opened.counts[32:].load()
    xr.testing.assert_equal(open_store(store, GROUP), scene(2))


REPLACER = """
import importlib.util, sys
from hyperpaint.io.store import to_store

spec = importlib.util.spec_from_file_location("reading", sys.argv[1])
reading = importlib.util.module_from_spec(spec)
spec.loader.exec_module(reading)
print("ready", flush=True)
for number in range(20):
    to_store(reading.scene(2 + number % 2), sys.argv[2], reading.GROUP, overwrite=True)
"""


@pytest.mark.slow
def test_a_reader_during_replacements_never_mixes(store: Path) -> None:
    command = [sys.executable, "-c", REPLACER, __file__, str(store)]
    writer = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert writer.stdout is not None
    assert writer.stdout.readline() == "ready\n"
    read, until = [], time.monotonic() + 60
    with dask.config.set(scheduler="synchronous"):
        while writer.poll() is None and time.monotonic() < until:
            with contextlib.suppress(StoreError):
                opened = open_store(store, GROUP).load()
                read.append((int(opened.frame[0]) // 10_000, opened.drop_attrs()))
    writer.communicate(timeout=60)
    assert writer.returncode == 0
    assert {value for value, _ in read} >= {2, 3}
    for value, opened in read:
        assert opened.equals(scene(value).drop_attrs())


# --- attributes and strays ---------------------------------------------------------------------------------


def change(path: Path, **attributes: str) -> None:
    document = json.loads(path.read_text())
    document["attributes"] |= attributes
    path.write_text(json.dumps(document))


def test_changed_attributes_are_not_handed_out(store: Path) -> None:
    change(store / GROUP / "zarr.json", srf_shape="slit")
    assert not is_complete(store, GROUP)
    with pytest.raises(IncompleteStoreError, match="attributes other than recorded"):
        open_store(store, GROUP)


@pytest.mark.parametrize("group", ["", "flightlines"])
def test_attributes_of_groups_without_arrays_are_verified(group: str, store: Path) -> None:
    assert verify(store).ok
    change(store / group / "zarr.json", created="long ago")
    assert f"/{group}: attributes are not those that were written" in str(verify(store))


def test_what_is_not_of_the_store_is_told(store: Path) -> None:
    (store / GROUP / "junk.bin").write_text("x")
    (store / "more").mkdir()
    (store / "more/x").write_text("x")
    (store / ".DS_Store").write_text("of a file manager")
    assert verify(store).problems == (
        "/more: neither a group nor an array of the store",
        f"/{GROUP}/junk.bin: neither a group nor an array of the store",
    )


# --- depth and places --------------------------------------------------------------------------------------

EMPTY_GROUP = '{"zarr_format": 3, "node_type": "group", "attributes": {}}'


def nest(store: Path, name: str, depth: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(store)
    for _ in range(depth):
        os.mkdir(name)
        os.chdir(name)
        Path("zarr.json").write_text(EMPTY_GROUP)
    os.chdir(store)


@pytest.mark.parametrize(("name", "depth"), [("d", 600), ("d" * 200, 30)])
@pytest.mark.parametrize("door", [verify, list_groups, lambda path: open_store(path, "no such group")])
def test_deep_stores_are_refused_at_once(
    name: str, depth: int, door: Callable[[Path], object], store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    nest(store, name, depth, monkeypatch)
    begun = time.perf_counter()
    with pytest.raises(StoreError, match="more than 16 deep"):
        door(store)
    assert time.perf_counter() - begun < 2
    # what is whole can still be read
    xr.testing.assert_equal(open_store(store, GROUP), scene())


def test_deep_folders_in_an_array_are_told(store: Path) -> None:
    (store / GROUP / "counts" / "/".join("d" * 60)).mkdir(parents=True)
    assert "folders more than 40 deep" in str(verify(store))


def test_too_many_nodes(store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hyperpaint.io.store.location.MOST_NODES", 3)
    with pytest.raises(StoreError, match="more than 3"):
        verify(store)


@pytest.mark.parametrize("door", [verify, open_store, list_groups])
@pytest.mark.parametrize(
    ("url", "error", "said"),
    [
        ("nosuch://x", StoreError, "nosuch"),
        ("zip://x::/etc/hostname", StoreError, "a chained URL"),
        ("s3://x/y", PaintError, "cannot be opened|not a Zarr|cannot be"),
    ],
)
def test_places_that_cannot_be_opened(
    door: Callable[[str], object], url: str, error: type[PaintError], said: str
) -> None:
    if url.startswith("s3") and _has_s3():
        pytest.skip("it would ask the network")
    with pytest.raises(MissingExtraError if url.startswith("s3") else error, match=said):
        door(url)


def _has_s3() -> bool:
    import importlib.util

    return importlib.util.find_spec("s3fs") is not None
