"""`to_store`: what goes in comes out, and nothing else in the store changes."""

import errno
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import dask
import dask.array as da
import numpy as np
import pytest
import xarray as xr
import zarr
from support.codecs import plain_zarr
from support.refusals import expect_error, expect_errors

import hyperpaint as hp
from hyperpaint.base.errors import IncompleteStoreError, SchemaError, StoreError
from hyperpaint.io.store import (
    is_complete,
    list_groups,
    open_store,
    open_unverified,
    to_store,
    verify,
    writer,
)
from hyperpaint.io.store.manifest import INPUTS
from hyperpaint.io.store.reader import reads_from
from hyperpaint.io.store.writer import Staging, run_contents, whole_run

CUBE = ("along_track", "band", "cross_track")
GROUP = "flightlines/raw_0"


def flightline(lines: int = 70, seed: int = 0, *, lazy: bool = True) -> xr.Dataset:
    rng = np.random.default_rng(seed)
    counts = rng.integers(0, 65536, (lines, 3, 5), dtype="uint16")
    reflectance = rng.random((lines, 3, 5), dtype="float32")
    reflectance[1, 1, 1], reflectance[2] = np.inf, np.nan
    time = np.datetime64("2026-06-01T12:00:00.123456789", "ns") + (np.arange(lines) * 7_000_001).astype(
        "m8[ns]"
    )
    time[3] = np.datetime64("NaT", "ns")
    dataset = xr.Dataset(
        {
            "counts": (CUBE, counts, {"units": "count"}),
            "reflectance": (CUBE, reflectance, {"units": "1"}),
            "quality": (
                ("along_track", "cross_track"),
                counts[:, 0],
                {"flag_masks": np.array([1, 2], "uint16")},
            ),
            "radiance_gain": (("band", "cross_track"), rng.random((3, 5), dtype="float32")),
            "exposure_time": ((), 0.005, {"units": "s"}),
            "irradiance": (("irradiance_time", "irradiance_wavelength"), rng.random((4, 6), dtype="float32")),
            "lag": ("irradiance_time", np.array([1, 2, np.iinfo("i8").min, 4]).view("m8[ns]")),
            "note": ("band", np.array(["", "blue\n\u00e9", "c"], dtype=object)),
            "camera": ((), "nano"),
        },
        coords={
            "time": ("along_track", time),
            "frame": ("along_track", np.arange(lines) + 2**40),
            "wavelength": ("band", [400.1, 500.2, 600.3]),
            "good": ("band", [True, False, True]),
            "irradiance_time": time[:1] + (np.arange(4) * 10**9).astype("m8[ns]"),
        },
        attrs={"srf_shape": "gaussian", "gain": np.float32(2), "bands": np.arange(3)},
    )
    if lazy:
        dataset = dataset.chunk({"along_track": 13})
        dataset["time"] = dataset["time"].chunk(9)
    return dataset


def assert_same(stored: xr.Dataset, source: xr.Dataset) -> None:
    # Bit for bit, dtypes included
    assert (set(stored.variables), set(stored.coords)) == (set(source.variables), set(source.coords))
    for name, variable in source.variables.items():
        found = stored.variables[name]
        assert found.dims == variable.dims
        if variable.dtype.kind in "OUT":
            assert found.values.tolist() == variable.values.tolist()
            continue
        assert found.dtype == variable.dtype, name
        assert found.values.tobytes() == np.ascontiguousarray(variable.values).tobytes(), name


def files(folder: Path) -> dict[str, tuple[int, bytes]]:
    return {
        str(path.relative_to(folder)): (path.stat().st_mtime_ns, path.read_bytes())
        for path in folder.rglob("*")
        if path.is_file()
    }


@pytest.mark.parametrize("lazy", [True, False])
@pytest.mark.parametrize("group", [GROUP, None])
def test_round_trip(lazy: bool, group: str | None, tmp_path: Path) -> None:
    source = flightline(lazy=lazy)
    assert to_store(source, tmp_path / "lot.zarr", group) == tmp_path / "lot.zarr"
    stored = xr.open_zarr(tmp_path / "lot.zarr", group=group)
    assert stored.counts.chunks == (((32, 32, 6), (3,), (5,)))
    assert ((stored.quality.chunks, stored.time.chunks)) == ((((32, 32, 6), (5,)), ((70,),)))
    assert "wavelength" not in stored.indexes
    assert_same(stored, source)
    assert_same(open_store(tmp_path / "lot.zarr", group), source)
    assert stored.counts.attrs == {"units": "count"}
    assert verify(tmp_path / "lot.zarr").ok
    assert os.listdir(tmp_path) == ["lot.zarr"]


def test_attributes(tmp_path: Path) -> None:
    to_store(flightline().assign_attrs(history="2026-01-01 flown"), tmp_path / "lot.zarr", GROUP)
    attrs = xr.open_zarr(tmp_path / "lot.zarr", group=GROUP).attrs
    assert ((attrs["hyperpaint_format"], attrs["Conventions"])) == ((3, "CF-1.11"))
    assert ((attrs["srf_shape"], attrs["gain"], attrs["bands"])) == (("gaussian", 2, [0, 1, 2]))
    assert attrs["history"].startswith("2026-01-01 flown\n20")
    assert attrs["created"] > "2024-01-01T00:00:00+00:00"
    assert zarr.open_group(tmp_path / "lot.zarr", mode="r").attrs["hyperpaint_format"] == 3


def test_counts_have_a_sentinel_but_no_mask(tmp_path: Path) -> None:
    to_store(flightline(), tmp_path / "lot.zarr", GROUP)
    (tmp_path / "lot.zarr" / GROUP / "counts/c/1/0/0").unlink()
    (tmp_path / "lot.zarr" / GROUP / "time/c/0").unlink()
    stored = xr.open_zarr(tmp_path / "lot.zarr", group=GROUP)
    assert stored.counts.dtype == "uint16"
    assert (stored.counts[32:64] == 65535).all()
    assert stored.time.isnull().all()


def test_file_backed_variable_without_dask(tmp_path: Path) -> None:
    source = flightline(lazy=False)
    to_store(source, tmp_path / "a.zarr", "x")
    lazy = xr.open_zarr(tmp_path / "a.zarr", group="x", chunks=None)
    assert not lazy.counts.variable._in_memory
    to_store(lazy, tmp_path / "b.zarr")
    assert not lazy.counts.variable._in_memory
    assert_same(xr.open_zarr(tmp_path / "b.zarr"), source)


@pytest.mark.parametrize("dims", [("band", "along_track", "cross_track"), ("y", "x", "band")])
def test_other_orders(dims: tuple[str, ...], tmp_path: Path) -> None:
    values = np.random.default_rng(2).random((3, 150, 140), dtype="float32")
    source = xr.Dataset({"reflectance": (dims, values)})
    to_store(source.chunk(), tmp_path / "a.zarr")
    to_store(source, tmp_path / "b.zarr")
    assert_same(xr.open_zarr(tmp_path / "a.zarr"), source)
    assert_same(xr.open_zarr(tmp_path / "b.zarr"), source)


def test_big_endian_source(tmp_path: Path) -> None:
    values = np.arange(70 * 6, dtype=">u2").reshape(70, 2, 3)
    to_store(xr.Dataset({"counts": (CUBE, values)}).chunk(along_track=32), tmp_path / "a.zarr")
    stored = xr.open_zarr(tmp_path / "a.zarr")
    np.testing.assert_array_equal(stored.counts, values)
    assert stored.counts.dtype == "uint16"
    assert verify(tmp_path / "a.zarr").ok


def test_stale_encoding_is_dropped(tmp_path: Path) -> None:
    source = flightline()
    source.counts.encoding = {"chunks": (5, 1, 1), "scale_factor": 0.1, "dtype": "int32", "_FillValue": 0}
    source.time.encoding = {"units": "milliseconds since 2000-01-01", "dtype": "int32"}
    to_store(source, tmp_path / "lot.zarr", GROUP)
    assert_same(xr.open_zarr(tmp_path / "lot.zarr", group=GROUP), source)
    assert source.counts.encoding["chunks"] == (5, 1, 1)


def test_same_content_writes_nothing(path: Path, tmp_path: Path) -> None:
    to_store(flightline(), path, GROUP)
    before = files(tmp_path)
    to_store(flightline(), path, GROUP)
    to_store(flightline(), path, GROUP, overwrite=True)
    assert files(tmp_path) == before


def test_other_content_needs_overwrite(path: Path, tmp_path: Path) -> None:
    to_store(flightline(), path, GROUP)
    to_store(flightline(seed=5), path, "flightlines/raw_1")
    before = files(tmp_path)
    expect_error(StoreError, "store-exists", lambda: to_store(flightline(seed=1), path, GROUP))
    assert files(tmp_path) == before
    to_store(flightline(lines=40, seed=1), path, GROUP, overwrite=True)
    assert_same(xr.open_zarr(path, group=GROUP), flightline(lines=40, seed=1))
    assert_same(xr.open_zarr(path, group="flightlines/raw_1"), flightline(seed=5))
    assert verify(path).ok
    assert os.listdir(tmp_path) == ["lot.zarr"]


def test_source_token_names_the_content(path: Path) -> None:

    def unnamed() -> xr.Dataset:
        values = da.random.default_rng(3).random((40, 2, 2), chunks=20).astype("float32")
        return xr.Dataset(
            {"radiance": (CUBE, da.map_blocks(np.copy, values, name=f"x{os.urandom(4).hex()}"))}
        )

    to_store(unnamed(), path, source_token="a")
    to_store(unnamed(), path, source_token="a")
    expect_errors(
        (StoreError, "store-exists", lambda: to_store(unnamed(), path, source_token="b")),
        (StoreError, "store-exists", lambda: to_store(unnamed(), path)),
    )


@pytest.mark.parametrize("url", ["memory://{}.zarr", "{}/source.zarr"])
@pytest.mark.parametrize("guarded", [True, False])
def test_a_source_that_was_rewritten_is_other_content(url: str, guarded: bool, tmp_path: Path) -> None:
    url = url.format(tmp_path if url.startswith("{") else os.urandom(4).hex())

    def rewrite(seed: int) -> None:
        plain_zarr(flightline(seed=seed)[["counts"]].drop_vars("time"), url)

    def source() -> xr.Dataset:
        return open_unverified(url) if guarded else xr.open_zarr(url, consolidated=False)

    rewrite(0)
    to_store(source(), tmp_path / "lot.zarr", GROUP)
    rewrite(1)
    expect_error(StoreError, "store-exists", lambda: to_store(source(), tmp_path / "lot.zarr", GROUP))
    to_store(source() * 1, tmp_path / "lot.zarr", GROUP, overwrite=True)
    np.testing.assert_array_equal(
        open_store(tmp_path / "lot.zarr", GROUP)["counts"], flightline(seed=1)["counts"]
    )


def test_an_interrupted_copy_of_a_source_that_is_rewritten_is_not_mixed(tmp_path: Path) -> None:
    url, path = f"memory://{os.urandom(4).hex()}.zarr", tmp_path / "lot.zarr"

    def source(number: int, *, failing: bool) -> xr.Dataset:
        xr.Dataset({"counts": (CUBE, np.full((128, 2, 3), number, "uint16"))}).chunk(along_track=32).to_zarr(
            url, mode="w", consolidated=False
        )
        if failing:
            zarr.open_array(f"{url}/counts").store_path.store.fs.rm(f"{url}/counts/c/3/0/0")
            zarr.open_array(f"{url}/counts").store_path.store.fs.pipe_file(f"{url}/counts/c/3/0/0", b"x")
        return xr.open_zarr(url, consolidated=False)

    with dask.config.set(scheduler="synchronous"):
        expect_error(Exception, r".", lambda: to_store(source(1, failing=True), path, GROUP))
        to_store(source(2, failing=False), path, GROUP)
    assert (open_store(path, GROUP).counts == 2).all()


def test_a_copy_of_our_own_group_is_known_again(tmp_path: Path) -> None:
    to_store(flightline(), tmp_path / "a.zarr", GROUP)
    to_store(open_store(tmp_path / "a.zarr", GROUP), tmp_path / "b.zarr")
    before = files(tmp_path)
    to_store(open_store(tmp_path / "a.zarr", GROUP), tmp_path / "b.zarr")
    assert files(tmp_path) == before


def test_refuses_to_overwrite_what_it_reads(path: Path, tmp_path: Path) -> None:
    to_store(flightline(), path, GROUP)
    before = files(tmp_path)
    for opened in (
        xr.open_zarr(path, group=GROUP),
        xr.open_zarr(path, group=GROUP, chunks=None),
        xr.open_zarr(path, group=GROUP)
        .persist(optimize_graph=False)
        .assign(
            reflectance=xr.open_zarr(os.path.relpath(path), group=GROUP)["reflectance"].astype("float32") * 2
        ),
    ):
        expect_error(StoreError, "source-overwritten", partial(to_store, opened, path, GROUP, overwrite=True))
        assert files(tmp_path) == before
    to_store(xr.open_zarr(path, group=GROUP), path, "copies/raw_0")
    to_store(xr.open_zarr(path, group=GROUP).compute(), path, GROUP, overwrite=True)


def test_finds_the_source_through_a_rewritten_graph(path: Path, tmp_path: Path) -> None:
    from hyperpaint.io.store.manifest import Location

    to_store(flightline(), path, GROUP)
    (optimised,) = dask.optimize(xr.open_zarr(path, group=GROUP)[["counts"]].reset_coords(drop=True) + 1)
    assert reads_from(optimised, Location.of(path), GROUP) == ["counts"]
    assert reads_from(optimised, Location.of(path), "flightlines/raw") == []
    assert reads_from(optimised, Location.of(tmp_path), "") == ["counts"]


@pytest.mark.parametrize(
    ("prepare", "group", "message"),
    [
        (lambda path: path.write_text("x"), None, "store-foreign"),
        (lambda path: (path.mkdir(), (path / "a.txt").write_text("x")), "g", "store-foreign"),
        (lambda path: to_store(flightline(), path, "a/b"), "a", "group-occupied"),
        (lambda path: to_store(flightline(), path, "a/b"), None, "group-occupied"),
        (lambda path: to_store(flightline(), path, "a"), "a/counts", "array"),
        (lambda path: to_store(flightline(), path, "a"), "a/counts/x", "array"),
        (Path.exists, "../x", "group"),
        (Path.exists, "a/.partial", "group"),
    ],
)
def test_refusals(prepare: Callable[[Path], Any], group: str | None, message: str, tmp_path: Path) -> None:
    prepare(tmp_path / "lot.zarr")
    before = files(tmp_path)
    expect_error(
        StoreError,
        message,
        lambda: to_store(flightline(seed=9), tmp_path / "lot.zarr", group, overwrite=True),
    )
    assert files(tmp_path) == before


def test_source_that_fails_leaves_everything_as_it_was(path: Path, tmp_path: Path) -> None:
    to_store(flightline(), path, GROUP)
    before = files(tmp_path)

    def fail(block: np.ndarray, block_id: tuple[int, ...] = ()) -> np.ndarray:
        if block_id[0] == 1:
            raise RuntimeError("the disk of the camera broke")
        return block

    counts = da.map_blocks(fail, da.zeros((96, 2, 2), chunks=(32, 2, 2), dtype="uint16"), dtype="uint16")
    source = xr.Dataset({"counts": (CUBE, counts)})
    for group in (GROUP, "flightlines/raw_1"):
        expect_error(RuntimeError, "camera", partial(to_store, source, path, group, overwrite=True))
        assert files(tmp_path) == before
    expect_error(RuntimeError, "camera", lambda: to_store(source, tmp_path / "new.zarr"))
    assert os.listdir(tmp_path) == ["lot.zarr"]


def test_folder_that_must_not_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    expect_error(StoreError, "file-unusable", lambda: to_store(flightline(), tmp_path / "file" / "lot.zarr"))


def test_datatree(path: Path, tmp_path: Path) -> None:
    tree = xr.DataTree.from_dict(
        {
            "/": xr.Dataset(attrs={"name": "parking-lot"}),
            "/flightlines/raw_0": flightline(),
            "/flightlines/raw_1": flightline(lines=40, seed=1),
            "/irradiance": flightline()[["irradiance"]],
        }
    )
    to_store(tree, path)
    assert list_groups(path) == ["flightlines/raw_0", "flightlines/raw_1", "irradiance"]
    before = files(tmp_path)
    to_store(tree, path)
    assert files(tmp_path) == before
    opened = xr.open_datatree(path, engine="zarr", chunks={})
    root = xr.open_zarr(path)
    assert opened.attrs["name"] == "parking-lot"
    assert not root.variables
    for node in ("flightlines/raw_0", "flightlines/raw_1"):
        assert_same(opened[node].to_dataset(), tree[node].to_dataset())
    assert verify(path).ok
    tree["flightlines/raw_1"] = xr.DataTree(flightline(lines=33, seed=2))
    expect_error(StoreError, "raw_1", lambda: to_store(tree, path))
    to_store(tree["flightlines"], path, "flightlines", overwrite=True)
    assert_same(xr.open_zarr(path, group="flightlines/raw_1"), flightline(lines=33, seed=2))
    assert zarr.open_group(path, mode="r").attrs["name"] == "parking-lot"
    assert verify(path).ok


def test_memory_url() -> None:
    url = f"memory://{os.urandom(4).hex()}.zarr"
    assert to_store(flightline(), url, GROUP) == url
    to_store(flightline(), url, GROUP)
    assert_same(xr.open_zarr(url, group=GROUP), flightline())
    expect_errors(
        (StoreError, "overwrite", lambda: to_store(flightline(seed=1), url, GROUP)),
        (
            StoreError,
            "source-overwritten",
            lambda: to_store(open_store(url, GROUP), url, GROUP, overwrite=True),
        ),
    )
    to_store(flightline(lines=33, seed=1), url, GROUP, overwrite=True)
    assert_same(open_store(url, GROUP), flightline(lines=33, seed=1))
    assert verify(url).ok
    assert not is_complete(url, "flightlines")


def test_memory_url_of_a_failed_writer_keeps_the_old_group() -> None:
    url = f"memory://{os.urandom(4).hex()}.zarr"
    to_store(flightline(), url, GROUP)

    fail = mock.Mock(side_effect=RuntimeError("broken"))
    counts = da.map_blocks(
        fail, da.zeros((96, 2, 2), chunks=(32, 2, 2)), dtype="float64", meta=np.empty((0, 0, 0))
    )
    expect_error(
        RuntimeError,
        "broken",
        lambda: to_store(xr.Dataset({"counts": (CUBE, counts)}), url, GROUP, overwrite=True),
    )
    assert is_complete(url, GROUP)
    assert verify(url).ok
    expect_error(
        RuntimeError,
        "broken",
        lambda: to_store(xr.Dataset({"counts": (CUBE, counts)}), url, "flightlines/raw_1"),
    )
    assert not is_complete(url, "flightlines/raw_1")


@pytest.mark.parametrize("scheduler", ["threads", "processes", "synchronous"])
@pytest.mark.slow
def test_schedulers_write_the_same_bytes(
    scheduler: str, tmp_path: Path, two_processes: ProcessPoolExecutor
) -> None:
    with dask.config.set(scheduler="synchronous"):
        to_store(flightline(), tmp_path / "a.zarr")
    with dask.config.set(scheduler=scheduler, pool=two_processes if scheduler == "processes" else None):
        to_store(flightline(), tmp_path / "b.zarr")
    for name in ("counts", "reflectance", "time"):
        one, two = files(tmp_path / f"a.zarr/{name}"), files(tmp_path / f"b.zarr/{name}")
        assert {key: value[1] for key, value in one.items()} == {key: value[1] for key, value in two.items()}


def test_each_source_block_is_computed_once(tmp_path: Path) -> None:
    count = mock.Mock(side_effect=np.copy)
    cube = da.map_blocks(
        count, da.zeros((96, 2, 2), chunks=(32, 2, 2)), dtype="float64", meta=np.empty((0, 0, 0))
    )
    shared = xr.Dataset({"radiance": (CUBE, cube), "reflectance": (CUBE, cube * 2)})
    with dask.config.set(scheduler="synchronous"):
        to_store(shared, tmp_path / "a.zarr")
    assert count.call_count == 3


def test_the_fast_codec_holds_the_same_values_and_any_reader_reads_it(tmp_path: Path) -> None:
    source, path = flightline(), tmp_path / "a.zarr"
    to_store(source, path, GROUP, source_token="a", codec="fast")
    assert b'"shuffle":"shuffle"' in (path / GROUP / "counts/zarr.json").read_bytes().replace(b" ", b"")
    assert_same(open_store(path, GROUP), source)
    assert_same(xr.open_zarr(path, group=GROUP), source)
    assert verify(path).ok
    written = (path / GROUP / "counts/c/0/0/0").stat().st_mtime_ns
    to_store(source, path, GROUP, source_token="a")  # the same content, which stays as it is
    assert (path / GROUP / "counts/c/0/0/0").stat().st_mtime_ns == written
    expect_error(SchemaError, "choice-unknown", lambda: to_store(source, path, codec="zstd"))


@pytest.mark.slow
def test_import_stays_light() -> None:
    code = (
        "import sys, xarray; before = set(sys.modules); import hyperpaint.io.store; "
        "print([m for m in ('zarr', 'dask', 'numcodecs', 'google_crc32c', 'fsspec') "
        "if m in sys.modules and m not in before])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True
    )
    assert done.stdout.strip() == "[]"


# --- What stands in a group's place, and around it, is not lost; what is damaged there can be mended


def line(value: int = 1) -> xr.Dataset:
    counts = np.full((70, 2, 3), value, "uint16")
    return xr.Dataset({"counts": (("along_track", "band", "cross_track"), counts)})


@pytest.fixture
def occupied(tmp_path: Path) -> Path:
    to_store(line(), tmp_path / "lot.zarr", GROUP)
    return tmp_path / "lot.zarr"


def holds(occupied: Path, value: int, group: str = GROUP) -> bool:
    return verify(occupied).ok and bool((open_store(occupied, group).counts == value).all())


def contents(folder: Path) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


@pytest.mark.parametrize("name", [".zarr.json.4711", f"zarr.{'ab' * 16}.partial"])
def test_a_writer_killed_at_its_first_metadata_is_no_other_store(name: str, tmp_path: Path) -> None:
    occupied = tmp_path / "lot.zarr"
    occupied.mkdir()
    (occupied / name).write_text("{")
    to_store(line(), occupied, GROUP)
    assert holds(occupied, 1)
    assert not (occupied / name).exists()


@pytest.mark.parametrize(
    "damage",
    [
        lambda occupied: (occupied / "flightlines/zarr.json").write_text("{"),
        lambda occupied: (occupied / "flightlines/zarr.json").unlink(),
        lambda occupied: (occupied / "flightlines/zarr.json").write_text('{"node_type": "group"'),
    ],
)
@pytest.mark.parametrize("group", [None, "flightlines"])
def test_groups_below_damaged_metadata_are_not_lost(
    damage: Callable[[Path], object], group: str | None, occupied: Path
) -> None:
    damage(occupied)
    before = contents(occupied)
    for overwrite in (True, False):
        expect_error(
            StoreError, "group-occupied", partial(to_store, line(2), occupied, group, overwrite=overwrite)
        )
        assert contents(occupied) == before


def test_a_folder_of_somebody_elses_is_not_lost(occupied: Path) -> None:
    (occupied / "photos/2026").mkdir(parents=True)
    (occupied / "photos/2026/a.jpg").touch()
    expect_error(StoreError, "group-occupied", lambda: to_store(line(2), occupied, "photos", overwrite=True))
    (occupied / "notes").mkdir()
    (occupied / "notes/a.txt").touch()
    (occupied / GROUP / "notes.txt").touch()
    for group in ("notes", GROUP):
        expect_error(
            StoreError, "group-occupied", partial(to_store, line(2), occupied, group, overwrite=True)
        )


@pytest.mark.parametrize("place", [GROUP, f"{GROUP}/counts", "new"])
def test_nothing_is_written_as_a_store_into_a_store(place: str, occupied: Path) -> None:
    before = contents(occupied)
    for group in (None, "g"):
        expect_error(
            StoreError,
            "path-inside-store",
            partial(to_store, line(2), occupied / place, group, overwrite=True),
        )
    assert contents(occupied) == before


def test_damaged_arrays_do_not_keep_a_group_from_being_replaced(occupied: Path) -> None:
    (occupied / GROUP / "counts/zarr.json").write_text("{")
    to_store(line(2), occupied, GROUP, overwrite=True)
    assert holds(occupied, 2)


@pytest.mark.parametrize("damage", ["damaged", "missing"])
@pytest.mark.parametrize("value", [1, 2])
def test_a_root_is_rebuilt_when_asked_for(value: int, damage: str, occupied: Path) -> None:
    to_store(line(5), occupied, "flightlines/raw_1")
    if damage == "damaged":
        (occupied / "zarr.json").write_text('{"attributes": {')
    else:
        (occupied / "zarr.json").unlink()
    before = contents(occupied)
    expect_error(StoreError, "metadata-damaged", lambda: to_store(line(value), occupied, GROUP))
    assert contents(occupied) == before
    to_store(line(value), occupied, GROUP, overwrite=True)
    assert holds(occupied, value)
    assert holds(occupied, 5, "flightlines/raw_1")
    assert os.listdir(occupied.parent) == ["lot.zarr"]


def test_a_damaged_group_above_is_rebuilt_when_asked_for(occupied: Path) -> None:
    (occupied / "flightlines/zarr.json").write_text("[" * 1000)
    expect_error(StoreError, "metadata-damaged", lambda: to_store(line(2), occupied, "flightlines/raw_1"))
    to_store(line(2), occupied, "flightlines/raw_1", overwrite=True)
    assert holds(occupied, 1)
    assert holds(occupied, 2, "flightlines/raw_1")


@pytest.mark.parametrize("group", [GROUP, None])
def test_a_group_that_lacks_a_chunk_is_made_again(group: str | None, tmp_path: Path) -> None:
    occupied = tmp_path / "lot.zarr"
    to_store(line(), occupied, group)
    (occupied / (group or "") / "counts/c/1/0/0").unlink()
    to_store(line(), occupied, group)
    assert holds(occupied, 1, group or "")
    (occupied / (group or "") / "counts/c/1/0/0").unlink()
    expect_error(StoreError, "store-exists", lambda: to_store(line(2), occupied, group))


def test_a_store_behind_a_link_is_written_where_it_is(occupied: Path, tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir()
    os.rename(occupied, tmp_path / "disk/lot.zarr")
    occupied.symlink_to(tmp_path / "disk/lot.zarr")
    to_store(line(2), occupied, GROUP, overwrite=True)
    assert occupied.is_symlink()
    assert holds(occupied, 2)
    assert os.listdir(tmp_path / "disk") == ["lot.zarr"]


# --- A run's groups get their places beside one another: in order, and none is left behind ---


LINES = tuple(f"flightlines/raw_{number}" for number in range(3))
WAIT_S = 30.0


def named_line(name: str, at_compute: Any = None) -> xr.Dataset:
    def block() -> np.ndarray:
        if at_compute is not None:
            at_compute()
        return np.full((8, 2, 3), len(name), "uint16")

    cube = da.map_blocks(block, chunks=((8,), (2,), (3,)), dtype="uint16", meta=np.empty((0, 0, 0), "uint16"))
    return xr.Dataset({"counts": (("along_track", "band", "cross_track"), cube)}, attrs={INPUTS: name})


def run(path: Path, at_compute: Any = None) -> None:
    # Write lines as `process` does; ``at_compute`` is called as the second one is computed
    groups = {name: named_line(name, at_compute if name == LINES[1] else None) for name in LINES}
    with whole_run(
        path, run_contents(groups), groups, {}, command="hyperpaint process lot.toml", overwrite=False
    ) as turn:
        for name, dataset in groups.items():
            turn.write(name, dataset)


@pytest.fixture
def publish(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    # What is called with the group before one gets its place; append to it
    calls: list[Any] = []
    plain = Staging.publish

    def publish(self: Staging, build: Path, group: str) -> None:
        for call in calls:
            call(group)
        plain(self, build, group)

    monkeypatch.setattr(Staging, "publish", publish)
    return calls


def test_a_group_gets_its_place_while_the_next_is_computed(tmp_path: Path, publish: list[Any]) -> None:
    computed, order = threading.Event(), []

    def placed(group: str) -> None:
        if group == LINES[0]:
            assert computed.wait(WAIT_S), "the second group waited for the first"
        order.append(group)

    publish.append(placed)
    run(tmp_path / "lot.zarr", computed.set)
    assert order == list(LINES)
    assert hp.verify(tmp_path / "lot.zarr").ok
    assert os.listdir(tmp_path) == ["lot.zarr"]


@pytest.mark.parametrize("which", LINES)
def test_what_goes_wrong_in_the_background_ends_the_run(
    which: str, path: Path, tmp_path: Path, publish: list[Any]
) -> None:

    def full(group: str) -> None:
        if group == which:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    publish.append(full)
    expect_error(StoreError, "disk-full", lambda: run(path))
    expect_error(IncompleteStoreError, None, lambda: hp.open_store(path))
    assert set(list_groups(path)) == set(LINES[: LINES.index(which)])
    publish.clear()
    run(path)
    assert hp.verify(path).ok
    assert os.listdir(tmp_path) == ["lot.zarr"]


def test_the_store_is_held_until_the_last_group_has_its_place(
    path: Path, tmp_path: Path, publish: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, waits, plain = threading.Event(), [], writer.wait

    def slow(group: str) -> None:
        begun.set()
        time.sleep(0.5)
        assert (tmp_path / ".partial-lot.zarr" / "lock").exists()

    def interrupted(futures: Any) -> Any:
        waits.append(futures)
        if len(waits) < 3:
            raise KeyboardInterrupt
        return plain(futures)

    def stop() -> None:
        assert begun.wait(WAIT_S)
        raise KeyboardInterrupt

    publish.append(slow)
    monkeypatch.setattr(writer, "wait", interrupted)
    expect_error(KeyboardInterrupt, None, lambda: run(path, stop))
    assert (len(waits), set(list_groups(path))) == (3, {LINES[0]})
    assert not (tmp_path / ".partial-lot.zarr" / "lock").exists()
    monkeypatch.undo()
    run(path)
    assert hp.verify(path).ok
    assert os.listdir(tmp_path) == ["lot.zarr"]


def test_groups_follow_one_another_where_a_thread_would_take_room(
    tmp_path: Path, publish: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    threads: set[str] = set()
    publish.append(lambda _: threads.add(threading.current_thread().name))
    monkeypatch.setattr(writer, "thread_space", lambda: 1)
    run(tmp_path / "lot.zarr")
    assert threads == {threading.current_thread().name}
    assert hp.verify(tmp_path / "lot.zarr").ok


def test_what_failed_before_is_a_note_of_the_error(tmp_path: Path, publish: list[Any]) -> None:
    refused = threading.Event()

    def refuse(group: str) -> None:
        if group == LINES[0]:
            refused.set()
            raise StoreError("the disk is gone")

    def end() -> None:
        refused.wait(WAIT_S)
        raise ValueError("no light")

    publish.append(refuse)
    caught = expect_error(ValueError, "no light", lambda: run(tmp_path / "lot.zarr", end))
    assert any("the disk is gone" in note for note in caught.__notes__)
