"""Files behind URLs: read as local ones are, cubes by ranges, products put there completely or not at all."""

import contextlib
import pickle
import re
import shutil
import time
import uuid
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import fsspec
import numpy as np
import pytest
import xarray as xr
from support.commands import hyperpaint
from support.files import write_file
from support.refusals import expect_error, expect_refusals, refusal
from support.servers import s3_bucket, web_server

import hyperpaint as hp
from hyperpaint.base import remote_files
from hyperpaint.base.errors import CollectError, FormatError, PaintError, StoreError
from hyperpaint.base.remote_files import UrlPath, as_path, mirrored, url_of
from hyperpaint.io.envi.envi_cubes import open_envi
from hyperpaint.io.files.reading import sampled_digest
from hyperpaint.io.store import INPUTS, StoreWriter, list_groups


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("day") / "flight"
    return hp.simulate_collect(folder, scene="plan", lines=70, bands=12, columns=16, cubes=2)


@pytest.fixture(scope="module")
def local(flight: Path) -> Path:
    return hp.process(flight, flight.parent.with_name("lot.zarr"))


@pytest.fixture
def day(flight: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    # The collect behind a URL of this process; servers are asked again at once
    monkeypatch.setattr(remote_files, "ASK_AGAIN_S", -1.0)
    name = f"/{uuid.uuid4().hex}"
    memory = fsspec.filesystem("memory")
    memory.put(str(flight.parent), f"{name}/flight", recursive=True)
    yield f"memory:/{name}"
    memory.rm(name, recursive=True)


def assert_same_stores(one: Any, other: Any, *groups: str) -> None:
    # groups: whose contents are compared; by default all
    assert list_groups(one) == list_groups(other)
    for group in groups or filter(None, list_groups(one)):
        xr.testing.assert_equal(hp.open_store(one, group).load(), hp.open_store(other, group).load())


def test_a_url_in_the_form_of_a_path() -> None:
    path = as_path("s3://bucket/day/raw_0.hdr")
    assert str(path) == "s3://bucket/day/raw_0.hdr" == str(pickle.loads(pickle.dumps(path)))
    assert (str(path.parent / "raw_1"), path.suffix) == ("s3://bucket/day/raw_1", ".hdr")
    assert path.resolve() == path.absolute() == path == UrlPath("s3:/bucket/day/raw_0.hdr")
    assert as_path((Path.home() / "raw_0").as_uri()) == Path.home() / "raw_0"
    assert [url_of(text) for text in ("C:/day", "C:\\day", "day", "file:///day", "a::s3://b")] == [None] * 5


def test_a_collect_behind_a_url_gives_the_bits_of_its_copy(day: str, local: Path) -> None:
    out = hp.process(f"{day}/flight/collect.toml", f"{day}/lot.zarr")
    assert str(out) == f"{day}/lot.zarr"
    assert_same_stores(local, out)
    assert hp.verify(out).ok
    contents = [hp.open_store(store, "flightlines/raw_0").attrs[INPUTS] for store in (local, out)]
    assert contents[0] == contents[1]  # the same inputs, wherever they are
    assert "memory:" not in str(hp.open_store(local, "flightlines/raw_0").attrs)
    text = hyperpaint("process", f"{day}/flight/collect.toml", "--out", f"{day}/lot.zarr").output
    assert "already complete" in text
    assert "all unchanged" in hyperpaint("verify", f"{day}/lot.zarr", "--inputs").output


def test_cubes_are_read_by_ranges(day: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(remote_files, "SMALL_BYTES", 0)
    url = f"{day}/flight/flight/raw_0"
    line = open_envi(f"{url}.hdr")
    read: list[int] = []
    memory = type(fsspec.filesystem("memory"))
    plain = memory.cat_file

    def counted(files: Any, path: str, start: int = 0, end: int = 0, **options: Any) -> bytes:
        content = plain(files, path, start=start, end=end, **options)
        read.append(len(content))
        return content

    monkeypatch.setattr(memory, "cat_file", counted)
    band = line["counts"].isel(along_track=3, band=[5]).values
    assert read == [band.nbytes]
    assert "is not copied" in mirrored(url).read_text()
    # a cube that has changed since is refused
    fsspec.filesystem("memory").pipe(url.removeprefix("memory:/"), bytes(35 * 12 * 16 * 2))
    expect_refusals((FormatError, "file-changed", "raw_0", lambda: line["counts"].isel(along_track=4).load()))


def test_a_text_that_changes_is_copied_again(day: str) -> None:
    regions, memory = f"{day}/regions.geojson", fsspec.filesystem("memory")
    for names in (["hood"], ["hood", "roof"]):
        hp.write_regions(
            [hp.Region(name, [(0, 0), (4, 0), (4, 3)]) for name in names], regions, overwrite=True
        )
        assert list(hp.read_regions(regions).names) == names
    memory.rm(regions.removeprefix("memory:/"))
    expect_refusals((FormatError, "file-unreadable", regions, lambda: hp.read_regions(regions)))


@pytest.mark.parametrize("scheme", ["memory", pytest.param("s3", marks=pytest.mark.slow)])
def test_every_reader_takes_a_url(scheme: str, flight: Path, local: Path, request: Any) -> None:
    with contextlib.ExitStack() as stack:
        url = stack.enter_context(s3_bucket()) if scheme == "s3" else request.getfixturevalue("day")
        if scheme == "s3":
            fsspec.filesystem("s3").put(str(flight.parent), f"{url}/flight", recursive=True)
        folder, home = f"{url}/flight", flight.parent
        readers: dict[str, Callable[[Any], xr.Dataset]] = {
            "asd": hp.open_asd, "asd/*.asd": hp.open_asd, "svc/red.sig": hp.open_svc, "svc": hp.open_svc,
            "flight/imu_gps.txt": hp.open_navigation, "calibration.zarr": hp.io.open_calibration,
            "flight/raw_0.hdr": open_envi,
        }  # fmt: skip
        for name, read in readers.items():
            xr.testing.assert_equal(read(f"{folder}/{name}").load(), read(str(home / name)).load())
        assert hp.read_regions(f"{folder}/regions.geojson") == hp.read_regions(home / "regions.geojson")
        if scheme == "s3":  # the test of a whole collect reads all groups, in memory
            out = hp.process(f"{folder}/collect.toml", f"{url}/lot.zarr")
            assert_same_stores(local, out, "flightlines/raw_35")
            assert hp.verify(f"{folder}/calibration.zarr").ok


def test_damaged_files_are_refused_as_on_a_disk(day: str, flight: Path, tmp_path: Path) -> None:
    memory = fsspec.filesystem("memory")
    shutil.copytree(flight.parent, tmp_path / "day")
    for name in ("flight/raw_0", "asd/sky00000.asd", "flight/imu_gps.txt", "flight/raw_0.hdr"):
        codes: list[Any] = []
        whole = (tmp_path / "day" / name).read_bytes()
        for content in (whole[: len(whole) // 2], b""):
            (tmp_path / "day" / name).write_bytes(content)
            memory.pipe(f"{day}/flight/{name}".removeprefix("memory:/"), content)
            places: list[Any] = [tmp_path / "day/collect.toml", f"{day}/flight/collect.toml"]
            calls = (partial(hp.open_collect, place) for place in places)
            codes += [expect_error(PaintError, None, call).codes for call in calls]
        (tmp_path / "day" / name).write_bytes(whole)
        memory.pipe(f"{day}/flight/{name}".removeprefix("memory:/"), whole)
        assert codes[0] == codes[1], name
        assert codes[2] == codes[3], name


def test_files_beside_a_cube_are_found(day: str, flight: Path) -> None:
    lines = []
    for home in (flight.parent, f"{day}/flight"):
        names = {"dark": "dark/raw_0.hdr", "calibration": "calibration.zarr", "nav": "flight/imu_gps.txt"}
        files = {key: f"{home}/{name}" for key, name in names.items()}
        index = f"{home}/flight/frameIndex_0.txt"
        lines.append(hp.open_flightline(f"{home}/flight/raw_0.hdr", frame_index=index, **files))
    xr.testing.assert_identical(lines[1].drop_attrs(), lines[0].drop_attrs())
    assert lines[1].attrs["exposure_source"] == lines[0].attrs["exposure_source"] == "settings.txt"


def test_threads_read_one_file_once(day: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(remote_files, "ASK_AGAIN_S", 60.0)
    memory = fsspec.filesystem("memory")
    plain, copied = memory.get, list[str]()

    def slow(names: list[str], places: list[str]) -> None:
        copied.extend(names)
        time.sleep(0.1)
        plain(names, places)

    monkeypatch.setattr(type(memory), "get", staticmethod(slow))
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(hp.read_regions, [f"{day}/flight/regions.geojson"] * 4))
    assert len(copied) == 1
    assert all(regions == found[0] for regions in found)


def test_a_local_collect_may_name_urls(day: str, flight: Path, local: Path, tmp_path: Path) -> None:
    text = flight.read_text(encoding="utf-8")
    for name in ("flight/", "asd/", "dark/", "calibration.zarr", "svc/", "asd_reflectance/"):
        text = re.sub(f"""(["'])({re.escape(name)})""", rf"\1{day}/flight/\2", text)
    (tmp_path / "collect.toml").write_text(text, encoding="utf-8")
    assert_same_stores(local, hp.process(tmp_path / "collect.toml", tmp_path / "lot.zarr"))


def test_a_collect_behind_a_url_names_no_file_of_this_machine(day: str, tmp_path: Path) -> None:
    secret = write_file(tmp_path / "secret.txt", "1")
    memory, name = fsspec.filesystem("memory"), f"{day}/flight/collect.toml".removeprefix("memory:/")
    text = memory.cat_file(name).decode()
    for path in (str(secret), "../" * 20 + str(secret)[1:]):
        other = re.sub(r"(?m)^frame_index = .*$", f'frame_index = "{path}"', text)
        memory.pipe(name, other.encode())
        expect_refusals(
            (
                CollectError,
                "file-not-found",
                "frame_index",
                lambda: hp.open_collect(f"{day}/flight/collect.toml"),
            )
        )
    for pattern in (f"{tmp_path}/*.txt", "../" * 20 + f"{tmp_path}/*.txt"[1:]):
        memory.pipe(name, re.sub(r"(?m)^files = .*asd.*$", f'files = "{pattern}"', text).encode())
        error = expect_error(
            CollectError, "file-not-found", lambda: hp.open_collect(f"{day}/flight/collect.toml")
        )
        assert "secret" not in str(error)


def test_a_web_server_gives_files_by_name(flight: Path, tmp_path: Path) -> None:
    with web_server(flight.parent) as address:
        line = open_envi(f"{address}/flight/raw_0.hdr")
        xr.testing.assert_equal(line.load(), open_envi(flight.parent / "flight/raw_0.hdr").load())
        expect_refusals(
            (
                FormatError,
                "file-unreadable",
                f"{address}/none.sig",
                lambda: hp.open_svc(f"{address}/none.sig"),
            )
        )
    with open(flight.parent / "flight/large", "wb") as file:
        file.truncate(20 * 2**20)
    with web_server(flight.parent, ranges=False) as address:
        line = open_envi(f"{address}/flight/raw_0.hdr")
        assert line["counts"].isel(along_track=4).values.any()  # small files are read whole
        expect_refusals(
            (
                FormatError,
                "range-missing",
                "ranges",
                lambda: sampled_digest(mirrored(f"{address}/flight/large")),
            )
        )
    with refusal(FormatError, "url-unusable", f"{address}/red.sig"):  # nobody answers there now
        hp.open_svc(f"{address}/red.sig")


def test_urls_that_nothing_can_read(day: str) -> None:
    expect_refusals(
        (FormatError, "url-unusable", "ftpx", lambda: hp.read_regions("ftpx://server/cars.geojson")),
        (FormatError, "path-invalid", "..", lambda: hp.read_regions(f"{day}/../cars.geojson")),
        (FormatError, "url-not-plain", "::", lambda: hp.read_regions(f"simplecache::{day}/cars.geojson")),
        (FormatError, "file-unreadable", day, lambda: hp.read_regions(f"{day}/none.geojson")),
        (StoreError, "url-not-local", day, lambda: hp.simulate_collect(f"{day}/new")),
        (FormatError, "url-not-plain", "query", lambda: hp.open_svc("https://bucket/red.sig?sign=1")),
        (
            FormatError,
            "url-not-plain",
            "https://bucket/red",
            lambda: hp.open_svc("https://me:key@bucket/red.sig"),
        ),
        (FormatError, "path-invalid", "..", lambda: hp.write_regions([], f"{day}/../x.json", overwrite=True)),
        (FormatError, "url-not-plain", "chained", lambda: hp.write_regions([], f"simplecache::{day}/x.json")),
    )


def test_files_at_the_root_of_the_memory_are_found() -> None:
    name = f"memory://{uuid.uuid4().hex}.geojson"
    hp.write_regions([hp.Region("hood", [(0, 0), (4, 0), (4, 3)])], name)
    assert hp.read_regions(name).names == ("hood",)


def test_xarray_opens_files_behind_urls(day: str) -> None:
    assert "counts" in xr.open_dataset(f"{day}/flight/flight/raw_0.hdr")
    assert "flightlines" in xr.open_datatree(f"{day}/flight/collect.toml")


def test_a_library_at_a_file_url_is_opened(tmp_path: Path) -> None:
    path = hp.write_library(hp.paints.starter_library(members=0), tmp_path / "paints.csv")
    xr.testing.assert_identical(hp.open_library(path.as_uri()), hp.open_library(path))


def test_a_store_at_a_server_that_takes_no_files_is_refused(day: str, tmp_path: Path) -> None:
    with web_server(tmp_path) as url:
        expect_error(
            StoreError, "file-unwritable", lambda: hp.to_store(xr.Dataset({"a": 1.0}), f"{url}/a.zarr")
        )


def test_products_behind_a_url(day: str, local: Path) -> None:
    page, memory = f"{day}/report.html", fsspec.filesystem("memory")
    hp.report.write_report(local, page)
    assert memory.cat_file(page.removeprefix("memory:/")).startswith(b"<!DOCTYPE html>")
    expect_refusals((StoreError, "file-exists", page, lambda: hp.report.write_report(local, page)))
    hp.report.write_site(local, f"{day}/page")
    names = {Path(name).name for name in memory.find(f"{day}/page".removeprefix("memory:/"))}
    assert {"index.html", "site.json", "zarr.json"} <= names
    memory.pipe(f"{day}/photos/holiday.jpg".removeprefix("memory:/"), b"x")
    for write in (hp.report.write_site, hp.report.write_report):  # nothing of others is replaced
        expect_error(
            StoreError,
            r"folder-occupied|path-is-folder",
            partial(write, local, f"{day}/photos", overwrite=True),
        )
    assert memory.cat_file(f"{day}/photos/holiday.jpg".removeprefix("memory:/")) == b"x"
    hp.report.write_site(local, f"{day}/page", flightlines=["raw_0"], overwrite=True)
    assert list_groups(f"{day}/page/store.zarr") == ["flightlines/raw_0"]  # as in a folder
    assert hp.verify(f"{day}/page/store.zarr").ok


def test_the_old_group_stays_until_the_new_one_is_complete(day: str, monkeypatch: pytest.MonkeyPatch) -> None:
    store, memory = f"{day}/lot.zarr", fsspec.filesystem("memory")

    def line(value: float, lines: int = 64) -> xr.Dataset:
        return xr.Dataset({"light": (("along_track", "band"), np.full((lines, 2), value, "f4"))})

    hp.to_store(line(1.0, 96), store, "a")
    replace = partial(hp.to_store, line(2.0), store, "a", overwrite=True)
    with monkeypatch.context() as patch:  # killed when the new group is complete
        patch.setattr(type(memory), "rm", mock.Mock(side_effect=KeyboardInterrupt))
        expect_error(KeyboardInterrupt, None, replace)
    xr.testing.assert_equal(hp.open_store(store, "a").load(), line(1.0, 96))
    with monkeypatch.context() as patch:  # killed while the server copies it
        patch.setattr(type(memory), "copy", mock.Mock(side_effect=KeyboardInterrupt))
        expect_error(KeyboardInterrupt, None, replace)
    expect_error(StoreError, None, lambda: hp.open_store(store, "a"))
    expect_error((KeyError, FileNotFoundError), None, lambda: xr.open_zarr(store, group="a"))
    replace()
    xr.testing.assert_equal(hp.open_store(store, "a").load(), line(2.0))
    assert hp.verify(store).ok
    assert not any(".partial-" in name for name in memory.find(day.removeprefix("memory:/")))


def test_an_interrupted_write_is_begun_again(day: str, monkeypatch: pytest.MonkeyPatch) -> None:
    line = xr.Dataset({"light": (("along_track", "band"), np.ones((64, 2), "f4"))})
    store = f"{day}/lot.zarr"
    hp.to_store(line, store, "a")
    with monkeypatch.context() as patch:  # killed between the arrays and the metadata of their group
        patch.setattr(StoreWriter, "_note", mock.Mock(side_effect=KeyboardInterrupt))
        expect_error(KeyboardInterrupt, None, lambda: hp.to_store(line + 1, store, "b"))
    hp.to_store(line + 1, store, "b")
    xr.testing.assert_equal(hp.open_store(store, "b").load(), line + 1)
    assert hp.verify(store).ok
    # arrays that no run of hyperpaint began are those of another program
    fsspec.filesystem("memory").rm(f"{store}/b/zarr.json".removeprefix("memory:/"))
    expect_refusals(
        (StoreError, "store-exists", "was not written", lambda: hp.to_store(line + 1, store, "b"))
    )
