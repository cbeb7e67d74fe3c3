"""Virtual stores: the bits of `process` out of raw files that are not copied, and refusals of others."""

import contextlib
import os
import re
import shlex
import shutil
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import fsspec
import numpy as np
import pytest
import xarray as xr
from support.commands import hyperpaint
from support.refusals import expect_error, expect_errors, expect_refusals, expect_words
from support.servers import s3_bucket
from support.tiny_collects import without_references

import hyperpaint as hp
from hyperpaint.base.errors import FormatError, PaintError, StoreError
from hyperpaint.cli.info_command import facts_of_path
from hyperpaint.io.store import check_url
from hyperpaint.workflows.pipeline import virtualise

icechunk = pytest.importorskip("icechunk", reason="icechunk is not installed (extra `virtual`)")

LINES = 80
NAME = "lot.icechunk"
GROUP = "flightlines/raw_0"


@pytest.fixture(scope="module")
def collect(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("day")
    return without_references(
        hp.simulate_collect(folder / "flight 1", scene="plan", lines=LINES, bands=6, columns=10, truth=False)
    )


@pytest.fixture(scope="module")
def wanted(collect: Path, tmp_path_factory: pytest.TempPathFactory) -> xr.Dataset:
    return computed(collect, tmp_path_factory.mktemp("store") / "lot.zarr")


@pytest.fixture
def copied(collect: Path, tmp_path: Path) -> Path:
    # Return a collect of the same files that a test may change
    shutil.copytree(collect.parent, tmp_path / "day")
    return tmp_path / "day" / "collect.toml"


def assert_same(line: xr.Dataset, wanted: xr.Dataset) -> None:
    product = line.paint.reflectance().compute()
    for name in ("counts", "reflectance", "quality", "irradiance_age", "irradiance_misfit"):
        assert (
            product[name].transpose(*wanted[name].dims).values.tobytes() == wanted[name].values.tobytes()
        ), name
        assert product[name].dtype == wanted[name].dtype
    assert product["reflectance"].attrs == wanted["reflectance"].attrs


def computed(collect: Path, store: Path) -> xr.Dataset:
    # Return the product of the counts that `process` stores
    hp.process(collect, store, reflectance="none")
    return hp.open_store(store, "flightlines/raw_0").paint.reflectance().compute()


def rewritten(collect: Path, interleave: str = "bil", dtype: str = "<u2", offset: int = 0) -> Path:
    # Write the cube of a collect in another layout; return its data file
    data = collect.parent / "flight" / "raw_0"
    header = data.with_suffix(".hdr")
    order = {"bil": (0, 1, 2), "bip": (0, 2, 1), "bsq": (1, 0, 2)}[interleave]
    counts = np.fromfile(data, "<u2").reshape(LINES, 6, 10).transpose(order)
    data.write_bytes(bytes(offset) + np.ascontiguousarray(counts, dtype).tobytes())
    text = re.sub(r"interleave *= *\w+", f"interleave = {interleave}", header.read_text())
    text = re.sub(r"byte order *= *\d", f"byte order = {int(dtype[0] == '>')}", text)
    header.write_text(re.sub(r"header offset *= *\d+", f"header offset = {offset}", text))
    return data


def test_the_bits_of_process_and_nothing_copied(collect: Path, wanted: xr.Dataset, tmp_path: Path) -> None:
    out, flight = tmp_path / NAME, str(collect.parent / "flight")
    assert f"allow={flight!r}" in hyperpaint("virtual", collect, "--out", out, status=0).output
    line = hp.io.open_virtual(out, GROUP, allow=collect.parent)
    assert line["counts"].variable.chunksizes["along_track"] == (40, 40)
    assert_same(line, wanted)
    assert_same(hp.io.open_virtual(out, allow=[collect.parent], chunks={"along_track": 80}), wanted)
    assert_same(hp.io.open_virtual(out, allow=str(collect.parent), chunks=None), wanted)
    again = virtualise(collect, out)
    assert (again.written, again.unchanged, list(tmp_path.iterdir())) == ((), (GROUP,), [out])
    # as other programs open it, above the name with a space, which icechunk does not match
    repository = icechunk.Repository.open(
        icechunk.local_filesystem_storage(str(out)),
        authorize_virtual_chunk_access=icechunk.containers_credentials(
            {f"file://{collect.parent.parent}/": None}
        ),
    )
    assert_same(
        xr.open_zarr(repository.readonly_session("main").store, group=GROUP, consolidated=False), wanted
    )
    # as the command line describes it
    facts = facts_of_path(out, [str(collect.parent)])
    assert "1 flight line" in facts["is"]
    assert f"counts: {LINES} along_track" in facts[f"/{GROUP} holds"]
    expect_words(hyperpaint("info", out).output, "NOT READ", f"pass --allow '{flight}'")
    assert "NOT READ" not in hyperpaint("info", out, "--allow", flight).output


@pytest.mark.parametrize(
    ("interleave", "dtype", "offset"), [("bip", "<u2", 0), ("bil", ">u2", 0), ("bip", ">u2", 512)]
)
def test_other_layouts(copied: Path, wanted: xr.Dataset, interleave: str, dtype: str, offset: int) -> None:
    rewritten(copied, interleave, dtype, offset)
    virtualise(copied, copied.parent.parent / NAME)
    assert_same(hp.io.open_virtual(copied.parent.parent / NAME), wanted)


def test_layouts_that_cannot_be_referred_to(copied: Path, tmp_path: Path) -> None:
    rewritten(copied, "bsq")
    expect_error(FormatError, "interleave-unsupported", lambda: virtualise(copied, tmp_path / NAME))
    assert not (tmp_path / NAME).exists()


def shortened(collect: Path, lines: int) -> None:
    # Cut a collect's cube and its frame index
    flight = collect.parent / "flight"
    os.truncate(flight / "raw_0", lines * 6 * 10 * 2)
    (flight / "raw_0.hdr").write_text(
        re.sub(r"lines *= *\d+", f"lines = {lines}", (flight / "raw_0.hdr").read_text())
    )
    index = (flight / "frameIndex_0.txt").read_text().splitlines(keepends=True)
    (flight / "frameIndex_0.txt").write_text("".join(index[: lines + (len(index) - LINES)]))


def test_the_last_short_slab_is_copied(copied: Path, tmp_path: Path) -> None:
    shortened(copied, 73)  # a prime
    expected = computed(copied, tmp_path / "lot.zarr")
    virtualise(copied, tmp_path / NAME)
    line = hp.io.open_virtual(tmp_path / NAME)
    assert line["counts"].variable.chunksizes["along_track"] == (32, 32, 9)
    assert_same(line, expected)


def test_lost_frames_are_copied(copied: Path, tmp_path: Path) -> None:
    index = copied.parent / "flight" / "frameIndex_0.txt"
    rows = index.read_text().splitlines(keepends=True)
    index.write_text("".join(rows[:-20] + rows[-19:]))  # by number now: one of the lines was never recorded
    expected = computed(copied, tmp_path / "lot.zarr")
    assert (expected["counts"] == 65535).all(("band", "cross_track")).sum() == 1
    virtualise(copied, tmp_path / NAME)
    assert_same(hp.io.open_virtual(tmp_path / NAME), expected)


@pytest.mark.parametrize("damage", ["moved", "short", "rewritten"])
def test_other_raw_files_are_refused(copied: Path, tmp_path: Path, damage: str) -> None:
    data = copied.parent / "flight" / "raw_0"
    virtualise(copied, tmp_path / NAME)
    line = hp.io.open_virtual(tmp_path / NAME)
    if damage == "moved":
        data.rename(data.with_name("elsewhere"))
        words = "No such file"
    elif damage == "short":
        status = data.stat()
        os.truncate(data, 5000)
        os.utime(data, ns=(status.st_atime_ns, status.st_mtime_ns))
        words = "5000 bytes, expected 9600"
    else:
        data.write_bytes(bytes(data.stat().st_size))
        os.utime(data, (2e9, 2e9))
        words = "changed at 2033"
    expect_error(StoreError, rf"(?s){words}.*again", lambda: hp.io.open_virtual(tmp_path / NAME))
    assert words in facts_of_path(tmp_path / NAME)[f"/{GROUP} NOT READ"]
    expect_error(icechunk.IcechunkError, "virtual", lambda: line["counts"].load())


def test_what_is_there_already(copied: Path, tmp_path: Path) -> None:
    out = tmp_path / "lot.icechunk"
    virtualise(copied, out)
    copied.write_text(copied.read_text().replace("bit_depth = 12", "bit_depth = 13"))
    expect_error(StoreError, "store-exists", lambda: virtualise(copied, out))
    assert virtualise(copied, out, overwrite=True).written
    assert float(hp.io.open_virtual(out)["saturation_count"]) == 8191
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "notes.txt").write_text("notes")
    expect_refusals(
        *(
            (StoreError, code, partial(virtualise, copied, place, overwrite=overwrite))
            for overwrite in (False, True)
            for code, place in (("store-exists", tmp_path / "notes"), ("output-is-input", copied.parent))
        ),
        (
            StoreError,
            "group-unknown",
            "flightlines/raw_0",
            lambda: hp.io.open_virtual(out, "flightlines/raw_1"),
        ),
        (StoreError, "store-unreadable", lambda: hp.io.open_virtual(tmp_path / "notes")),
    )


@pytest.mark.parametrize(
    "url",
    ["memory://flight", "http://127.0.0.1:1/x", "simplecache::http://host/x", "http://host/x::file:///etc",
     "http://user@host/x", "http://host/x/../y", "http://host/%2e%2e/y", "s3://bucket\\x", "file:///etc/../x"],
)  # fmt: skip
def test_urls_that_icechunk_does_not_read(url: str) -> None:
    expect_error(StoreError, "url-unusable", lambda: check_url(url))


def test_a_collect_where_icechunk_does_not_read(collect: Path, tmp_path: Path) -> None:
    memory = fsspec.filesystem("memory")
    memory.put(str(collect.parent), "/virtual", recursive=True)
    call = partial(virtualise, "memory://virtual/collect.toml", tmp_path / NAME)
    expect_error(FormatError, "url-unusable", call)
    assert not list(tmp_path.iterdir())


def test_the_place_of_the_raw_files(collect: Path, wanted: xr.Dataset, tmp_path: Path) -> None:
    # characters that mean something in URLs
    flight = shutil.copytree(collect.parent, tmp_path / "a%20b" / "a#b?c" / "\u00fc [1]")
    copied, out = flight / "collect.toml", tmp_path / "stores" / NAME
    virtualise(copied, out)
    caught = expect_error(StoreError, "raw-file-not-allowed", lambda: hp.io.open_virtual(out))
    (needed,) = re.findall(r"allow='([^']*)'", str(caught))
    assert needed == str(copied.parent / "flight")
    assert f"--allow {shlex.quote(needed)}" in caught.text(on_command_line=True)
    assert_same(hp.io.open_virtual(out, allow=needed), wanted)
    assert not virtualise(copied, out).written


def test_the_old_store_is_there_until_the_new_one_is(
    copied: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / NAME
    virtualise(copied, out)
    copied.write_text(copied.read_text().replace("bit_depth = 12", "bit_depth = 13"))

    def fails(*_: Any, **__: Any) -> None:
        raise OSError(5, "Input/output error")

    for broken in ("os.replace", "os.rename", "hyperpaint.io.store.raw_references.write_icechunk"):
        with monkeypatch.context() as patch:
            patch.setattr(broken, fails)
            patch.setattr("hyperpaint.io.store.writer.exchange", lambda *_: False)
            with contextlib.suppress(StoreError):
                virtualise(copied, out, overwrite=True)
        assert float(hp.io.open_virtual(out)["saturation_count"]) in (4095, 8191), broken
    virtualise(copied, out, overwrite=True)
    assert (
        float(hp.io.open_virtual(out)["saturation_count"]),
        sorted(path.name for path in tmp_path.iterdir()),
    ) == (8191, ["day", NAME])


def test_half_a_repository_is_written_again(copied: Path, tmp_path: Path) -> None:
    shortened(copied, 73)  # so that a slab is copied
    out = tmp_path / NAME
    virtualise(copied, out)
    for lost in ("chunks", "manifests"):
        shutil.rmtree(out / lost)
        expect_error(StoreError, "store-damaged", lambda: hp.io.open_virtual(out))
        assert virtualise(copied, out).written
        assert hp.io.open_virtual(out).load().sizes["along_track"] == 73
    # one byte of a stored variable is another (copied slabs of the cube have no checksum)
    for number in (0, -1):
        chunk = sorted(out.glob("chunks/*"), key=lambda path: path.stat().st_size)[number]
        content = bytearray(chunk.read_bytes())
        content[len(content) // 2] ^= 255
        chunk.write_bytes(content)
        expect_error(StoreError, "store-damaged", lambda: hp.io.open_virtual(out))
        assert virtualise(copied, out).written
    assert not virtualise(copied, out).written
    shutil.rmtree(out / "snapshots")
    (out / "snapshots").mkdir()
    expect_error(StoreError, "store-damaged", lambda: virtualise(copied, out))
    assert virtualise(copied, out, overwrite=True).written
    shutil.rmtree(out / "refs")
    caught = expect_error(StoreError, "store-exists", lambda: virtualise(copied, out))
    assert "overwrite" not in caught.text(on_command_line=True)


@pytest.fixture
def bucket(collect: Path) -> Iterator[str]:
    # Serve a collect's files from a bucket of S3, as moto mocks it on this machine
    with s3_bucket() as url:
        home = f"{url.removeprefix('s3://')}/day"
        fsspec.filesystem("s3").put(f"{collect.parent}/", f"{home}/", recursive=True)
        yield home


def test_raw_files_in_a_bucket(collect: Path, wanted: xr.Dataset, tmp_path: Path, bucket: str) -> None:
    virtualise(f"s3://{bucket}/collect.toml", tmp_path / NAME)
    expect_error(StoreError, f"allow='s3://{bucket}/flight'", lambda: hp.io.open_virtual(tmp_path / NAME))
    assert_same(hp.io.open_virtual(tmp_path / NAME, allow=f"s3://{bucket}"), wanted)
    s3 = fsspec.filesystem("s3")
    s3.pipe(f"{bucket}/flight/raw_0", bytes((collect.parent / "flight" / "raw_0").stat().st_size))
    s3.invalidate_cache()
    expect_error(
        StoreError,
        r"raw_0: etag .*, expected",
        lambda: hp.io.open_virtual(tmp_path / NAME, allow=f"s3://{bucket}"),
    )


def test_a_folder_of_cubes_is_one_line(copied: Path, tmp_path: Path) -> None:
    flight = copied.parent / "flight"
    data, header = (flight / "raw_0").read_bytes(), (flight / "raw_0.hdr").read_text()
    half = re.sub(r"lines *= *\d+", f"lines = {LINES // 2}", header)
    for name, part in (("raw_0", data[: len(data) // 2]), ("raw_40", data[len(data) // 2 :])):
        (flight / name).write_bytes(part)
        (flight / f"{name}.hdr").write_text(half)
    copied.write_text(copied.read_text().replace('cube = "flight/raw_0.hdr"', 'cube = "flight/raw_*.hdr"'))
    expected = computed(copied, tmp_path / "lot.zarr")
    assert expected.sizes["along_track"] == LINES
    virtualise(copied, tmp_path / NAME)
    line = hp.io.open_virtual(tmp_path / NAME)
    assert line["counts"].variable.chunksizes["along_track"] == (40, 40)
    assert_same(line, expected)


def test_errors_are_hyperpaints_own(tmp_path: Path) -> None:
    expect_errors(
        (PaintError, None, lambda: virtualise(tmp_path / "collect.toml", tmp_path / NAME)),
        (
            StoreError,
            "output-is-url",
            lambda: virtualise(tmp_path / "collect.toml", "s3://bucket/lot.icechunk"),
        ),
    )
