"""References of a stranger: nothing in them is executed, read or sent, and the error is our own.

Each is put where users put stores: the JSON in the current folder, the repository beside the raw cubes.
"""

import contextlib
import http.server
import json
import posixpath
import re
import shutil
import threading
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import pytest
import zarr
from support.commands import hyperpaint
from support.refusals import expect_error, expect_words

import hyperpaint as hp
from hyperpaint.base.errors import MissingExtraError, StoreError
from hyperpaint.io.store.raw_references import RawFile
from hyperpaint.workflows.pipeline import virtualise

GROUP = "flightlines/raw_0"
SECRET = b"PRIVATE " * 40_000


@pytest.fixture(scope="module")
def master(tmp_path_factory: pytest.TempPathFactory) -> Path:
    # Return a folder with a copy of all that `home` holds at first
    master = tmp_path_factory.mktemp("master")
    home = master / "place" / "home"
    hp.simulate_collect(home / "day", scene="plan", lines=160, bands=6, columns=10, truth=False)
    with contextlib.suppress(MissingExtraError):
        virtualise(home / "day" / "collect.toml", home / "lot.icechunk")
    (home.parent / "secret").write_bytes(SECRET)
    shutil.move(home.parent, master / "copy")
    return master


@pytest.fixture
def home(master: Path) -> Iterator[Path]:
    # Yield a folder with a collect and its virtual store, beside a file that is nobody's business; always at
    # the same place, to which the store refers
    place = shutil.copytree(master / "copy", master / "place")
    yield place / "home"
    shutil.rmtree(place)


@pytest.fixture
def server(home: Path) -> Iterator[tuple[str, list[str]]]:
    # Serve a URL, and list what is asked of it; it may also lead back to this machine under another name
    asked: list[str] = []

    class Handler(http.server.BaseHTTPRequestHandler):
        def log_message(self, *_: Any) -> None: ...

        def do_GET(self) -> None:
            asked.append(self.path)
            self.send_error(404)

        do_HEAD = do_PUT = do_POST = do_GET  # noqa: N815

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as served:
        threading.Thread(target=served.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{served.server_address[1]}", asked
        served.shutdown()


# --- JSON: references of kerchunk ---

REFS = {".zgroup": '{"zarr_format":2}', "x/0.0.0": ["{{u}}", 0, 960]}
RUN = "{{ cycler.__init__.__globals__.os.mkdir('%(mark)s') }}"
DOCUMENTS: dict[str, Any] = {
    "environment": {
        "version": 1,
        "templates": {"u": "%(server)s/{{g.__globals__[os].environ[HP_WORD]}}", "g": "{{x}}"},
        "refs": REFS,
    },
    "gen": {"version": 1, "templates": {}, "refs": {}, "gen": [
        {"key": "x", "url": RUN, "dimensions": {"i": [1]}}
    ]},
    "http": {"version": 1, "refs": {**REFS, "x/0.0.0": ["%(server)s/cube", 0, 960]}},
    "outside": {"version": 1, "refs": {**REFS, "x/0.0.0": ["file://%(secret)s", 0, 960]}},
    "nested": {"version": 1, "templates": {"u": "{{ '{{' }}" + RUN + "{{ '}}' }}"}, "refs": REFS},
    "flat, of version 0": {**REFS, "x/0.0.0": ["%(server)s/cube", 0, 960]},
}  # fmt: skip


@pytest.mark.parametrize("name", DOCUMENTS)
def test_json_is_refused_by_name(
    home: Path, server: tuple[str, list[str]], monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.setenv("HP_WORD", "word-of-the-environment")
    url, asked = server
    plain, evil = json.dumps(DOCUMENTS[name]), home / "evil.json"
    words = {"server": url, "mark": str(home / "mark"), "secret": str(home.parent / "secret")}
    for word, value in words.items():
        plain = plain.replace(f"%({word})s", value)
    escaped = re.sub(r'"(g|r|templat)e(n|fs|s)"', r'"\1\\u0065\2"', plain)
    for text in (plain, "\ufeff\n " + json.dumps(json.loads(plain), indent=3), escaped):
        evil.write_text(text, encoding="utf-8")
        call = partial(hp.io.open_virtual, evil, allow=[url, home.parent])
        error = str(expect_error(StoreError, "kerchunk-refused", call))
        for part in ("gen", "templates"):
            assert (f"`{part}`" in error) == (part in DOCUMENTS[name])
        assert "virtualizarr" in error
        assert "kerchunk references" in hyperpaint("info", evil, "--allow", url, status=2).output
        assert (asked, (home / "mark").exists()) == ([], False)


def test_a_folder_of_parquet_references_is_refused(home: Path) -> None:
    (home / "refs").mkdir()
    (home / "refs" / ".zmetadata").write_text('{"metadata": {}, "record_size": 10000}')
    expect_error(StoreError, "kerchunk-refused", lambda: hp.io.open_virtual(home / "refs"))
    assert "kerchunk references" in hyperpaint("info", home / "refs").output


@pytest.mark.parametrize("name", ["lot.json", "lot.JSON", "lot.parq", "lot.parquet"])
def test_json_is_not_written(home: Path, name: str) -> None:
    before = sorted(home.rglob("*"))
    expect_error(
        StoreError, r"kerchunk.*icechunk", lambda: virtualise(home / "day" / "collect.toml", home / name)
    )
    assert sorted(home.rglob("*")) == before


def test_no_module_hands_references_to_fsspec() -> None:
    sources = {path: path.read_text(encoding="utf-8") for path in Path(hp.__file__).parent.rglob("*.py")}
    for word in ("ReferenceFileSystem", "reference://", 'engine="kerchunk"', "import kerchunk"):
        assert [path.name for path, text in sources.items() if word in text] == []


# --- icechunk ---


class Repository:
    # The virtual store of a home, which is forged by a test
    def __init__(self, home: Path) -> None:
        self.icechunk = pytest.importorskip("icechunk", reason="icechunk is not installed (extra `virtual`)")
        self.home, self.path = home, home / "lot.icechunk"
        self.raw = home / "day" / "flight" / "raw_0"
        self.slab = 2 * 6 * 10 * 32  # of 32 lines

    def refer(
        self, url: str, offset: int = 0, length: int | None = None, place: Any = None, record: bool = False
    ) -> None:
        # Let the second slab lie elsewhere, in a container of its own; name it in the record if asked
        ice = self.icechunk
        storage = ice.local_filesystem_storage(str(self.path))
        config = ice.Repository.fetch_config(storage)
        scheme, _, path = url.partition("://")
        prefix = f"{scheme}://{posixpath.dirname(posixpath.normpath(unquote(path)))}/"
        place = place or ice.local_filesystem_store(prefix.removeprefix("file://"))
        config.set_virtual_chunk_container(ice.VirtualChunkContainer(prefix, place))
        repository = ice.Repository.open(storage, config)
        repository.save_config()
        session = repository.writable_session("main")
        size = self.slab if length is None else length
        assert not session.store.set_virtual_refs(
            f"/{GROUP}/counts", [ice.VirtualChunkSpec([1, 0, 0], url, offset, size, None, None)]
        )
        session.commit("forged")
        if record:
            local = Path(url.removeprefix("file://"))
            row = {"url": url, "size": 10**6, "changed_ns": None, "etag": None}
            if local.exists():
                row |= {"size": local.stat().st_size, "changed_ns": local.stat().st_mtime_ns}
            self.record(lambda groups: groups[GROUP]["raw_files"].append(row))

    def record(self, change: Callable[[Any], Any]) -> None:
        # Change the record of raw files
        session = self.icechunk.Repository.open(
            self.icechunk.local_filesystem_storage(str(self.path))
        ).writable_session("main")
        root = zarr.open_group(session.store, mode="r+")
        groups = json.loads(root.attrs["raw_files"])
        change(groups)
        root.attrs["raw_files"] = json.dumps(groups)
        session.commit("forged")


def link_that_leads_out(repository: Repository, server: str) -> None:
    (repository.home / "day" / "cube").symlink_to(repository.home.parent / "secret")
    repository.refer(f"file://{repository.home}/day/cube", record=True)


def folder_that_is_a_link(repository: Repository, server: str) -> None:
    (repository.home / "day" / "up").symlink_to(repository.home.parent)
    repository.refer(f"file://{repository.home}/day/up/secret", record=True)


def another_file_beside(repository: Repository, server: str) -> None:
    (repository.raw.parent / "letter").write_bytes(SECRET)
    repository.refer(f"file://{repository.raw.parent}/letter")


def s3_container(repository: Repository, server: str, *, record: bool = True) -> None:
    place = repository.icechunk.s3_store(
        region="us-east-1", endpoint_url=server, allow_http=True, force_path_style=True, s3_compatible=True
    )
    repository.refer("s3://bucket/cube", place=place, record=record)


def http_container(repository: Repository, server: str) -> None:
    repository.refer(
        "http://localhost/cube", place=repository.icechunk.http_store({"allow_http": "true"}), record=True
    )


def record_with_another_url(repository: Repository, server: str) -> None:
    row = {"url": f"simplecache::{server}/cube", "size": 1}
    repository.record(lambda groups: groups[GROUP]["raw_files"].append(row))


def chunk_that_is_a_link(repository: Repository, server: str) -> None:
    chunk = next(path for path in (repository.path / "chunks").iterdir() if path.is_file())
    chunk.unlink()
    chunk.symlink_to(repository.home.parent / "secret")


Forge = Callable[[Repository, str], Any]
#: Forgeries by name, with words of the refusal.
FORGED: dict[str, tuple[Forge, str]] = {
    "container_elsewhere": (
        lambda repository, _: repository.refer(f"file://{repository.home.parent}/secret"),
        "reference-wrong",
    ),
    "link_that_leads_out": (link_that_leads_out, "raw files in other folders"),
    "folder_that_is_a_link": (folder_that_is_a_link, "raw files in other folders"),
    "offset_beyond_the_end": (
        lambda repository, _: repository.refer(f"file://{repository.raw}", 10**9),
        "store-damaged",
    ),
    "length_beyond_the_end": (
        lambda repository, _: repository.refer(
            f"file://{repository.raw}", repository.raw.stat().st_size - repository.slab + 1
        ),
        "store-damaged",
    ),
    "offset_that_overflows": (
        lambda repository, _: repository.refer(f"file://{repository.raw}", 2**64 - 100),
        "lacks bytes|store-damaged",
    ),
    "another_length": (
        lambda repository, _: repository.refer(f"file://{repository.raw}", 0, repository.slab // 2),
        "bytes in flightlines",
    ),
    "another_file_beside": (another_file_beside, "reference-wrong"),
    "another_file_by_dots": (
        lambda repository, _: repository.refer(f"file://{repository.raw.parent}/%2e%2e/%2e%2e/%2e%2e/secret"),
        "reference-wrong",
    ),
    "s3_container": (s3_container, "raw files in other folders"),
    "s3_container_of_no_record": (partial(s3_container, record=False), "reference-wrong"),
    "http_container": (http_container, "raw files in other folders"),
    "record_of_a_file_outside": (
        lambda repository, _: repository.refer(f"file://{repository.home.parent}/secret", record=True),
        "raw files in other folders",
    ),
    "record_with_another_url": (record_with_another_url, "icechunk cannot read raw files from"),
    "chunk_that_is_a_link": (chunk_that_is_a_link, "is a link"),
}


@pytest.mark.parametrize(("forge", "words"), FORGED.values(), ids=FORGED)
def test_forged_repositories_are_refused(
    home: Path,
    server: tuple[str, list[str]],
    monkeypatch: pytest.MonkeyPatch,
    forge: Forge,
    words: str,
) -> None:
    url, asked = server
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "HPKEY")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "word")
    repository = Repository(home)
    # what is refused is the forgery: the store as it was opens
    assert hp.io.open_virtual(repository.path)["counts"].load().sizes["along_track"] == 160
    forge(repository, url)
    opened: list[str] = []
    state_of = RawFile.of
    monkeypatch.setattr(RawFile, "of", lambda url: opened.append(url) or state_of(url))
    expect_error(StoreError, words, lambda: hp.io.open_virtual(repository.path))
    assert not asked
    assert set(opened) <= {f"file://{repository.raw}"}
    expect_words(
        hyperpaint("info", repository.path).output,
        without=("PRIVATE", "counts:"),
    )
    assert not asked


@pytest.mark.parametrize("name", ["flightlines/raw_1", "flightlines", "flightlines/raw_0/counts"])
def test_references_to_the_file_of_another_line(home: Path, name: str) -> None:
    # A line may refer to its own files alone: those of others are not compared when it is opened
    repository = Repository(home)
    (home / "day" / "other").write_bytes(SECRET)
    repository.refer(f"file://{home}/day/other")
    row = {"url": f"file://{home}/day/other", "size": 1, "changed_ns": 0}
    repository.record(lambda groups: groups.update({name: {**groups[GROUP], "raw_files": [row]}}))
    expect_error(StoreError, "reference-wrong", lambda: hp.io.open_virtual(repository.path, GROUP))


def test_records_that_are_none(home: Path) -> None:
    repository = Repository(home)
    session = repository.icechunk.Repository.open(
        repository.icechunk.local_filesystem_storage(str(repository.path))
    ).readonly_session("main")
    record = zarr.open_group(session.store, mode="r").attrs["raw_files"]
    changes: list[Callable[[Any], Any]] = [
        lambda groups: groups.update({"../x": groups[GROUP]}),
        lambda groups: groups.update({"x\x1b[31m": groups[GROUP]}),
        lambda groups: groups.update({"": groups[GROUP]}),
        lambda groups: groups[GROUP]["raw_files"][0].update(size="many"),
        lambda groups: groups[GROUP]["raw_files"][0].update(changed_ns="now"),
        lambda groups: groups[GROUP]["raw_files"][0].update(url=7),
        lambda groups: groups[GROUP]["raw_files"][0].update(words=7),
        lambda groups: groups[GROUP].update(raw_files=7),
        lambda groups: groups.update({GROUP: 7}),
        lambda groups: groups.clear(),
    ]
    for change in changes:
        changed = json.loads(str(record))
        change(changed)
        repository.record(lambda groups, changed=changed: (groups.clear(), groups.update(changed)))
        expect_error(StoreError, None, partial(hp.io.open_virtual, repository.path, GROUP))
        run = hyperpaint("info", repository.path)
        assert run.exception is None or isinstance(run.exception, SystemExit)
        assert "\x1b" not in run.output


@pytest.mark.parametrize(
    "allow", ["home", "day/flight", "day/flight/raw_0", "http://localhost", "s3://bucket"]
)
def test_what_is_allowed_is_a_place_not_the_record(home: Path, tmp_path: Path, allow: str) -> None:
    # A prefix is a whole name of a folder, links resolved; URLs allow no files
    pytest.importorskip("icechunk")
    (tmp_path / "stores").mkdir()
    store = Path(shutil.move(home / "lot.icechunk", tmp_path / "stores" / "lot.icechunk"))
    given = allow if "://" in allow else str(home) if allow == "home" else str(home / allow)
    expect_error(StoreError, "other folders", lambda: hp.io.open_virtual(store, allow=f"{given}x"))
    if "://" in allow:
        expect_error(StoreError, "other folders", lambda: hp.io.open_virtual(store, allow=allow))
        return
    assert hp.io.open_virtual(store, allow=given).sizes["along_track"] == 160
    (tmp_path / "link").symlink_to(given)
    assert hp.io.open_virtual(store, allow=tmp_path / "link").sizes["along_track"] == 160
