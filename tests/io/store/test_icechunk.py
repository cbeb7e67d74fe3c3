"""An existing engine for shared object stores, tried for real: the README's section on icechunk holds."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import dask
import numpy as np
import pytest
import xarray as xr
import zarr
from support.codecs import flip
from support.refusals import expect_error, expect_errors, expect_refusals

import hyperpaint as hp

os.environ.setdefault(
    "ICECHUNK_LOG", "error"
)  # a local repository warns on stdout that commits are not atomic
icechunk = pytest.importorskip("icechunk", reason="needs the extra hyperpaint[icechunk]")

LINE = "flightlines/raw_0"
PRODUCT = "products/raw_0"


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    # A processed collect in a folder
    folder = tmp_path_factory.mktemp("collect")
    collect = hp.simulate_collect(folder / "sim", scene="plan", lines=96, bands=12, columns=16, seed=4)
    return hp.process(collect, folder / "lot.zarr")


def ingest(plain: Path, storage: Any, **options: Any) -> Any:
    repository = icechunk.Repository.create(storage, **options)
    session = repository.writable_session("main")
    with dask.config.set(
        scheduler="threads"
    ):  # also where a cluster is active: a session stays in its process
        for group in (LINE, "irradiance", "calibration"):
            xr.open_zarr(plain, group=group).to_zarr(session.store, group=group, consolidated=False)
    session.commit("ingest")
    return repository


@pytest.fixture
def repository(plain: Path) -> Any:
    return ingest(plain, icechunk.in_memory_storage())


def open_group(repository: Any, group: str) -> xr.Dataset:
    return xr.open_zarr(repository.readonly_session("main").store, group=group, consolidated=False)


def computed(line: xr.Dataset) -> xr.Dataset:
    return line.paint.reflectance()[["reflectance", "quality"]].reset_coords(drop=True)


def write(product: xr.Dataset, session: Any, **options: Any) -> None:
    encoding = hp.io.encoding(product)
    product.to_zarr(session.store, group=PRODUCT, mode="w", encoding=encoding, consolidated=False, **options)


def test_a_collect_in_a_repository_is_the_one_in_the_folder(plain: Path, repository: Any) -> None:
    ours = open_group(repository, LINE)
    theirs = xr.open_zarr(plain, group=LINE)
    assert ours.counts.chunks == theirs.counts.chunks
    xr.testing.assert_identical(ours.compute(), theirs.compute())
    made, expected = computed(ours).compute(), computed(theirs).compute()
    assert made.reflectance.dtype == np.float32
    assert made.reflectance.values.tobytes() == expected.reflectance.values.tobytes()
    xr.testing.assert_identical(made, expected)
    xr.testing.assert_identical(ours.paint.rgb().compute(), theirs.paint.rgb().compute())
    assert next(snapshot.message for snapshot in repository.ancestry(branch="main")) == "ingest"
    # chunks and codec are kept
    counts = zarr.open_group(repository.readonly_session("main").store, mode="r")[LINE]["counts"]
    assert counts.chunks == ((32, 12, 16))
    assert [type(codec).__name__ for codec in counts.compressors] == ["BloscCodec", "Crc32cCodec"]
    assert counts.fill_value == 65535
    # a session is opened as any store
    store = repository.readonly_session("main").store
    xr.testing.assert_equal(hp.open_store(store, LINE), hp.open_store(plain, LINE))
    assert set(hp.open_store(store).groups) >= {f"/{LINE}", "/irradiance", "/calibration"}
    expect_error(hp.StoreError, "group-unknown", lambda: hp.open_store(store, "flightlines/raw_9"))


def test_reflectance_is_written_from_threads(repository: Any) -> None:
    session = repository.writable_session("main")
    product = computed(xr.open_zarr(session.store, group=LINE, consolidated=False))
    write(product, session)
    assert "products" not in zarr.open_group(repository.readonly_session("main").store, mode="r")
    session.commit("reflectance")
    xr.testing.assert_identical(open_group(repository, PRODUCT).compute(), product.compute())


@pytest.mark.slow
def test_reflectance_is_written_from_a_cluster(plain: Path, two_workers: Any, tmp_path: Path) -> None:
    from icechunk.dask import store_dask

    repository = ingest(plain, icechunk.local_filesystem_storage(str(tmp_path / "lot.icechunk")))
    product = computed(open_group(repository, LINE))
    session = repository.writable_session("main")
    fork = session.fork()
    write(product, fork, compute=False)
    group = zarr.open_group(fork.store, path=PRODUCT)
    arrays = [group[name] for name in product.data_vars]
    with two_workers.as_current():
        session.merge(store_dask(sources=[array.data for array in product.values()], targets=arrays))
    session.commit("reflectance")
    xr.testing.assert_identical(open_group(repository, PRODUCT).compute(), product.compute())


def test_of_two_writers_one_is_refused(repository: Any) -> None:
    first, second = repository.writable_session("main"), repository.writable_session("main")
    product = computed(open_group(repository, LINE)).compute()
    write(product, first)
    write(product * 0, second)
    first.commit("first")
    expect_errors(
        (icechunk.ConflictError, "expected parent", lambda: second.commit("second")),
        (icechunk.RebaseFailedError, "conflict", lambda: second.rebase(icechunk.ConflictDetector())),
    )
    xr.testing.assert_identical(open_group(repository, PRODUCT).compute(), product)


_WRITER = """
import sys, icechunk, xarray as xr, hyperpaint as hp
repository = icechunk.Repository.open(icechunk.local_filesystem_storage(sys.argv[1]))
session = repository.writable_session("main")
line = xr.open_zarr(session.store, group=sys.argv[2], consolidated=False)
product = line.paint.reflectance()[["reflectance", "quality"]].reset_coords(drop=True)
product = product.drop_vars("cross_track")
product.to_zarr(
    session.store, group="products/raw_0", encoding=hp.io.encoding(product), consolidated=False, compute=False
)
product.isel(along_track=slice(32)).to_zarr(
    session.store, group="products/raw_0", region={"along_track": slice(0, 32)}, consolidated=False
)
print("half", flush=True)
sys.stdin.read()
"""


def test_a_killed_writer_leaves_the_older_commit(plain: Path, tmp_path: Path) -> None:
    storage = icechunk.local_filesystem_storage(str(tmp_path / "lot.icechunk"))
    before = ingest(plain, storage).lookup_branch("main")
    command = [sys.executable, "-c", _WRITER, str(tmp_path / "lot.icechunk"), LINE]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as writer:
        assert writer.stdout is not None
        assert writer.stdout.readline() == "half\n"
        writer.kill()
    again = icechunk.Repository.open(storage)
    assert again.lookup_branch("main") == before
    assert "products" not in zarr.open_group(again.readonly_session("main").store, mode="r")


@pytest.mark.parametrize("protected", [True, False], ids=["hyperpaint.io.encoding", "default"])
def test_only_our_codec_tells_a_flipped_bit(plain: Path, tmp_path: Path, protected: bool) -> None:
    # noise does not compress, so that nearly every bit is a sample's
    noise = np.random.default_rng(7).integers(0, 2**32, (64, 12, 16), dtype=np.uint32).view(np.float32)
    product = xr.Dataset({"radiance": (("along_track", "band", "cross_track"), np.nan_to_num(noise))})
    folder = tmp_path / "lot.icechunk"
    repository = icechunk.Repository.create(icechunk.local_filesystem_storage(str(folder)))
    session = repository.writable_session("main")
    product.to_zarr(
        session.store, encoding=hp.io.encoding(product) if protected else None, consolidated=False
    )
    session.commit("product")
    session = repository.readonly_session("main")
    chunk = max((folder / "chunks").iterdir(), key=lambda file: file.stat().st_size)
    flip(chunk)
    opened = xr.open_zarr(session.store, consolidated=False)
    if protected:
        expect_error(ValueError, "checksum", lambda: opened.load())
    else:
        assert not opened.load().equals(product)  # and nothing was said


def test_verify_says_what_to_do_instead(plain: Path, tmp_path: Path) -> None:
    folder = tmp_path / "lot.icechunk"
    repository = ingest(plain, icechunk.local_filesystem_storage(str(folder)))
    expect_refusals(
        (hp.StoreError, "store-unreadable", lambda: hp.verify(folder)),
        (hp.StoreError, "type-wrong", lambda: hp.verify(repository.readonly_session("main").store)),
        (hp.StoreError, "store-unknown", lambda: open_group(repository, LINE).paint.verify()),
    )
    expect_error(hp.StoreError, "store-foreign", lambda: hp.to_store(xr.Dataset(), folder))
