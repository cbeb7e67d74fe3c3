"""Virtual stores: the bits of `process` out of raw files that are not copied, and refusals of others."""

from __future__ import annotations

import functools
import http.server
import json
import os
import re
import shutil
import threading
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import fsspec
import numpy as np
import pytest
import xarray as xr

import hyperpaint as hp
from hyperpaint.base.errors import FormatError, PaintError, StoreError
from hyperpaint.cli.info_command import facts_of_path
from hyperpaint.workflows.virtual_store import virtualise

icechunk = pytest.importorskip("icechunk", reason="icechunk is not installed (extra `virtual`)")

LINES = 80
KINDS = ["lot.icechunk", "lot.json"]


@pytest.fixture(scope="module")
def collect(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("day")
    return hp.simulate_collect(folder / "flight 1", scene="plan", lines=LINES, bands=6, columns=10)


@pytest.fixture(scope="module")
def wanted(collect: Path, tmp_path_factory: pytest.TempPathFactory) -> xr.Dataset:
    store = hp.process(collect, tmp_path_factory.mktemp("store") / "lot.zarr", reflectance="none")
    return hp.open_store(store, "flightlines/raw_0").paint.reflectance().compute()


@pytest.fixture
def copied(collect: Path, tmp_path: Path) -> Path:
    """Return a collect of the same files that a test may change."""
    shutil.copytree(collect.parent, tmp_path / "day")
    return tmp_path / "day" / "collect.toml"


def assert_same(line: xr.Dataset, wanted: xr.Dataset) -> None:
    product = line.paint.reflectance().compute()
    for name in ("counts", "reflectance", "quality", "irradiance_age", "irradiance_misfit"):
        values = product[name].transpose(*wanted[name].dims).values
        assert values.tobytes() == wanted[name].values.tobytes(), name
        assert product[name].dtype == wanted[name].dtype
    assert product["reflectance"].attrs == wanted["reflectance"].attrs


def rewritten(collect: Path, interleave: str = "bil", dtype: str = "<u2", offset: int = 0) -> Path:
    """Write the cube of a collect in another layout; return its data file."""
    data = collect.parent / "flight" / "raw_0"
    header = data.with_suffix(".hdr")
    order = {"bil": (0, 1, 2), "bip": (0, 2, 1), "bsq": (1, 0, 2)}[interleave]
    counts = np.fromfile(data, "<u2").reshape(LINES, 6, 10).transpose(order)
    data.write_bytes(bytes(offset) + np.ascontiguousarray(counts, dtype).tobytes())
    text = re.sub(r"interleave *= *\w+", f"interleave = {interleave}", header.read_text())
    text = re.sub(r"byte order *= *\d", f"byte order = {int(dtype[0] == '>')}", text)
    header.write_text(re.sub(r"header offset *= *\d+", f"header offset = {offset}", text))
    return data


@pytest.mark.parametrize("name", KINDS)
def test_the_bits_of_process_and_nothing_copied(
    collect: Path, wanted: xr.Dataset, tmp_path: Path, name: str
) -> None:
    outcome = virtualise(collect, tmp_path / name)
    assert outcome.written == ("flightlines/raw_0",)
    line = hp.io.open_virtual(tmp_path / name, "flightlines/raw_0")
    assert line["counts"].variable.chunksizes["along_track"] == (40, 40)
    assert_same(line, wanted)
    assert_same(hp.io.open_virtual(tmp_path / name, chunks={"along_track": 80}), wanted)
    assert_same(hp.io.open_virtual(tmp_path / name, chunks=None), wanted)
    again = virtualise(collect, tmp_path / name)
    assert (again.written, again.unchanged) == ((), ("flightlines/raw_0",))
    assert sorted(path.name for path in tmp_path.iterdir()) == [name]
    facts = facts_of_path(tmp_path / name)
    assert "1 flight line" in facts["is"]
    assert f"counts: {LINES} along_track" in facts["/flightlines/raw_0 holds"]


def test_as_other_programs_open_them(collect: Path, wanted: xr.Dataset, tmp_path: Path) -> None:
    for name in KINDS:
        virtualise(collect, tmp_path / name)
    prefix = f"file://{collect.parent.parent}/"  # above the name with a space, which icechunk does not match
    repository = icechunk.Repository.open(
        icechunk.local_filesystem_storage(str(tmp_path / "lot.icechunk")),
        authorize_virtual_chunk_access=icechunk.containers_credentials({prefix: None}),
    )
    store = repository.readonly_session("main").store
    assert_same(xr.open_zarr(store, group="flightlines/raw_0", consolidated=False), wanted)
    options = {"fo": str(tmp_path / "lot.json")}
    assert_same(xr.open_zarr("reference://", group="flightlines/raw_0", storage_options=options), wanted)


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize(
    ("interleave", "dtype", "offset"), [("bip", "<u2", 0), ("bil", ">u2", 0), ("bip", ">u2", 512)]
)
def test_other_layouts(
    copied: Path, wanted: xr.Dataset, name: str, interleave: str, dtype: str, offset: int
) -> None:
    rewritten(copied, interleave, dtype, offset)
    virtualise(copied, copied.parent.parent / name)
    assert_same(hp.io.open_virtual(copied.parent.parent / name), wanted)


def test_layouts_that_cannot_be_referred_to(copied: Path, tmp_path: Path) -> None:
    rewritten(copied, "bsq")
    with pytest.raises(FormatError, match=r"/flightlines/raw_0: bsq.*expected bil or bip.*process"):
        virtualise(copied, tmp_path / "lot.json")
    assert not (tmp_path / "lot.json").exists()


def shortened(collect: Path, lines: int) -> None:
    """Cut a collect's cube and its frame index."""
    flight = collect.parent / "flight"
    os.truncate(flight / "raw_0", lines * 6 * 10 * 2)
    text = (flight / "raw_0.hdr").read_text()
    (flight / "raw_0.hdr").write_text(re.sub(r"lines *= *\d+", f"lines = {lines}", text))
    index = (flight / "frameIndex_0.txt").read_text().splitlines(keepends=True)
    extra = len(index) - LINES
    (flight / "frameIndex_0.txt").write_text("".join(index[: lines + extra]))


@pytest.mark.parametrize("name", KINDS)
def test_the_last_short_slab_is_copied(copied: Path, tmp_path: Path, name: str) -> None:
    shortened(copied, 73)  # a prime
    store = hp.process(copied, tmp_path / "lot.zarr", reflectance="none")
    expected = hp.open_store(store, "flightlines/raw_0").paint.reflectance().compute()
    virtualise(copied, tmp_path / name)
    line = hp.io.open_virtual(tmp_path / name)
    assert line["counts"].variable.chunksizes["along_track"] == (32, 32, 9)
    assert_same(line, expected)


@pytest.mark.parametrize("name", KINDS)
def test_lost_frames_are_copied(copied: Path, tmp_path: Path, name: str) -> None:
    index = copied.parent / "flight" / "frameIndex_0.txt"
    rows = index.read_text().splitlines(keepends=True)
    index.write_text("".join(rows[:-20] + rows[-19:]))  # by number now: one of the lines was never recorded
    store = hp.process(copied, tmp_path / "lot.zarr", reflectance="none")
    expected = hp.open_store(store, "flightlines/raw_0").paint.reflectance().compute()
    assert (expected["counts"] == 65535).all(("band", "cross_track")).sum() == 1
    virtualise(copied, tmp_path / name)
    assert_same(hp.io.open_virtual(tmp_path / name), expected)


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize("damage", ["moved", "short", "rewritten"])
def test_other_raw_files_are_refused(copied: Path, tmp_path: Path, name: str, damage: str) -> None:
    data = copied.parent / "flight" / "raw_0"
    virtualise(copied, tmp_path / name)
    line = hp.io.open_virtual(tmp_path / name)
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
    with pytest.raises(StoreError, match=rf"(?s){words}.*write the references again"):
        hp.io.open_virtual(tmp_path / name)
    assert words in facts_of_path(tmp_path / name)["/flightlines/raw_0 NOT WHOLE"]
    if (name, damage) != ("lot.json", "rewritten"):  # references of kerchunk do not know of times
        with pytest.raises(Exception, match=r"(?s)virtual|reference|reshape|Reference|buffer"):
            line["counts"].load()


def test_what_is_there_already(copied: Path, tmp_path: Path) -> None:
    out = tmp_path / "lot.icechunk"
    virtualise(copied, out)
    copied.write_text(copied.read_text().replace("bit_depth = 12", "bit_depth = 13"))
    with pytest.raises(StoreError, match="there already, of other inputs; pass overwrite=True"):
        virtualise(copied, out)
    assert virtualise(copied, out, overwrite=True).written
    assert float(hp.io.open_virtual(out)["saturation_count"]) == 8191
    (tmp_path / "notes.json").write_text("{}")
    for overwrite in (False, True):
        with pytest.raises(StoreError, match="no virtual store"):
            virtualise(copied, tmp_path / "notes.json", overwrite=overwrite)
        with pytest.raises(StoreError, match=r"holds .*, an input"):
            virtualise(copied, copied.parent, overwrite=overwrite)
    with pytest.raises(StoreError, match="expected one of flightlines/raw_0"):
        hp.io.open_virtual(out, "flightlines/raw_1")
    with pytest.raises(StoreError, match="is no virtual store"):
        hp.io.open_virtual(tmp_path / "notes.json")


def test_raw_files_in_memory(collect: Path, wanted: xr.Dataset, tmp_path: Path) -> None:
    memory = fsspec.filesystem("memory")
    memory.pipe("/flight/flight/raw_0", (collect.parent / "flight" / "raw_0").read_bytes())
    with pytest.raises(StoreError, match="icechunk reads no raw files from memory://"):
        virtualise(collect, tmp_path / "lot.icechunk", prefix="memory://flight")
    virtualise(collect, tmp_path / "lot.json", prefix="memory://flight")
    assert_same(hp.io.open_virtual(tmp_path / "lot.json"), wanted)
    memory.pipe("/flight/flight/raw_0", bytes(9600))
    with pytest.raises(FormatError, match=r"differs from .* at byte 0"):
        virtualise(collect, tmp_path / "other.json", prefix="memory://flight")
    memory.rm("/flight", recursive=True)
    with pytest.raises(StoreError, match="FileNotFoundError"):
        hp.io.open_virtual(tmp_path / "lot.json")


class _Ranges(http.server.SimpleHTTPRequestHandler):
    """Serves files, and ranges of them, as web servers do and that of Python does not."""

    def log_message(self, *_: Any) -> None: ...

    def do_GET(self) -> None:
        found = re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers.get("Range", ""))
        if found is None:
            super().do_GET()
            return
        content = Path(self.translate_path(self.path)).read_bytes()
        start, stop = int(found[1]), min(int(found[2]) + 1, len(content))
        self.send_response(206)
        self.send_header("Content-Range", f"bytes {start}-{stop - 1}/{len(content)}")
        self.send_header("Content-Length", str(stop - start))
        self.end_headers()
        self.wfile.write(content[start:stop])


@pytest.fixture
def server(collect: Path) -> Iterator[str]:
    handler = functools.partial(_Ranges, directory=str(collect.parent))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as served:
        threading.Thread(target=served.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{served.server_address[1]}"
        served.shutdown()


def test_raw_files_on_a_web_server(collect: Path, wanted: xr.Dataset, tmp_path: Path, server: str) -> None:
    pytest.importorskip("aiohttp", reason="fsspec reads http with aiohttp")
    virtualise(collect, tmp_path / "lot.json", prefix=server)
    assert_same(hp.io.open_virtual(tmp_path / "lot.json"), wanted)
    assert server in json.dumps(facts_of_path(tmp_path / "lot.json"))
    # icechunk would leave the port out
    with pytest.raises(StoreError, match=r"icechunk reads no raw files from http.*without a port; write"):
        virtualise(collect, tmp_path / "lot.icechunk", prefix=server)


@pytest.fixture
def bucket(collect: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Serve a collect's files from a bucket of S3, as moto mocks it on this machine."""
    moto = pytest.importorskip("moto.server", reason="moto is not installed: no bucket to read from")
    pytest.importorskip("s3fs", reason="s3fs is not installed: fsspec reads no S3")
    served = moto.ThreadedMotoServer("127.0.0.1", 0, verbose=False)
    served.start()
    host, port = served.get_host_and_port()
    environment = {"AWS_ACCESS_KEY_ID": "mock", "AWS_SECRET_ACCESS_KEY": "mock", "AWS_REGION": "us-east-1"}
    for name, value in {**environment, "AWS_ENDPOINT_URL": f"http://{host}:{port}"}.items():
        monkeypatch.setenv(name, value)
    s3 = fsspec.filesystem("s3", skip_instance_cache=True)
    name = f"flights-{uuid.uuid4().hex}"  # all servers of a process share their buckets
    s3.mkdir(name)
    s3.put(f"{collect.parent / 'flight'}/", f"{name}/day/flight/", recursive=True)
    yield f"{name}/day"
    served.stop()
    fsspec.get_filesystem_class("s3").clear_instance_cache()


@pytest.mark.parametrize("name", KINDS)
def test_raw_files_in_a_bucket(
    collect: Path, wanted: xr.Dataset, tmp_path: Path, name: str, bucket: str
) -> None:
    virtualise(collect, tmp_path / name, prefix=f"s3://{bucket}")
    assert_same(hp.io.open_virtual(tmp_path / name), wanted)
    s3 = fsspec.filesystem("s3")
    s3.pipe(f"{bucket}/flight/raw_0", bytes((collect.parent / "flight" / "raw_0").stat().st_size))
    s3.invalidate_cache()
    with pytest.raises(StoreError, match=r"raw_0: etag .*, expected"):
        hp.io.open_virtual(tmp_path / name)


def test_a_folder_of_cubes_is_one_line(copied: Path, tmp_path: Path) -> None:
    flight = copied.parent / "flight"
    data, header = (flight / "raw_0").read_bytes(), (flight / "raw_0.hdr").read_text()
    half = re.sub(r"lines *= *\d+", f"lines = {LINES // 2}", header)
    for name, part in (("raw_0", data[: len(data) // 2]), ("raw_40", data[len(data) // 2 :])):
        (flight / name).write_bytes(part)
        (flight / f"{name}.hdr").write_text(half)
    text = copied.read_text().replace('cube = "flight/raw_0.hdr"', 'cube = "flight/raw_*.hdr"')
    copied.write_text(text)
    store = hp.process(copied, tmp_path / "lot.zarr", reflectance="none")
    expected = hp.open_store(store, "flightlines/raw_0").paint.reflectance().compute()
    assert expected.sizes["along_track"] == LINES
    for name in KINDS:
        virtualise(copied, tmp_path / name)
        line = hp.io.open_virtual(tmp_path / name)
        assert line["counts"].variable.chunksizes["along_track"] == (40, 40)
        assert_same(line, expected)


def test_errors_are_hyperpaints_own(tmp_path: Path) -> None:
    with pytest.raises(PaintError):
        virtualise(tmp_path / "collect.toml", tmp_path / "lot.json")
    with pytest.raises(StoreError, match="writes to a folder"):
        virtualise(tmp_path / "collect.toml", "s3://bucket/lot.icechunk")
