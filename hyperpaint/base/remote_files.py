"""Files at URLs: texts are copied when they are read, cubes are read by byte ranges.

The functions of the package read files by local paths. A URL therefore gets a place in a temporary folder of
this process, where its folder is repeated name by name: a file there is a placeholder until it is read
(`fetch`), a folder is listed when something is looked for in it (`discover`). Data files of cubes stay
placeholders; `open_data` reads ranges of their bytes. `UrlPath` is a URL in the form of a path, for outputs
and for Zarr stores, which read their chunks themselves.

File systems and credentials are those of fsspec: environment variables and the files of its configuration.
"""

import bisect
import contextlib
import functools
import hashlib
import io
import math
import os
import re
import shutil
import tempfile
import threading
import time
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from .errors import FormatError, MissingExtraError, SchemaError
from .groups import grouped

#: ``https://...``, also after pathlib reduced ``//`` to ``/``; a drive of Windows has one letter.
_URL = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+):/+(?=[^/])(?!.*::)", re.DOTALL)
_FILE = re.compile(r"(?:file|local):/+")
#: ``dask::...``, which may start a cluster, or copy and unpack files.
_CHAINED = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+(?:::|:/.*::)", re.DOTALL)
CHAINED_MEND = "give the URL after '::' (texts are copied once, cubes read by ranges); unpack zip files first"
#: Largest sum of files that are copied at once [byte].
MAX_COPY_BYTES = 4 * 2**30
MAX_LISTED = 100_000
#: Longest gap between ranges that one request reads [byte].
MAX_GAP_BYTES = 2**16
#: Size of files that are read whole and kept for a while [byte].
SMALL_BYTES = 4 * 2**20


def url_of(path: str | os.PathLike[str]) -> str | None:
    """Return a plain URL with both of its slashes; None for the name of a local file.

    Examples
    --------
    >>> url_of(Path("s3://bucket/flight/raw_0.hdr"))
    's3://bucket/flight/raw_0.hdr'
    >>> url_of("flight/raw_0.hdr"), url_of("C:/flight"), url_of("dask::s3://bucket")
    (None, None, None)
    """
    text = os.fsdecode(path)
    match = _URL.match(text)
    if match is None or "\0" in text or _FILE.match(text) or ("://" not in text and os.path.lexists(text)):
        return None
    return f"{match[1]}://{text[match.end() :]}"


class UrlPath(type(Path())):  # type: ignore[misc]
    # A URL in the form of a path: its text keeps both slashes, and it never becomes relative to a folder.
    def __str__(self) -> str:
        return _URL.sub(r"\1://", super().__str__(), count=1)

    def __fspath__(self) -> str:
        return str(self)

    def _has(self, kind: str, **_: Any) -> bool:
        with _reached(str(self)) as (fs, key):
            return bool(getattr(fs, kind)(key))

    exists = functools.partialmethod(_has, "exists")
    is_dir = functools.partialmethod(_has, "isdir")
    is_file = functools.partialmethod(_has, "isfile")

    def iterdir(self) -> Iterator["UrlPath"]:
        with _reached(str(self)) as (fs, key):
            names = fs.ls(key, detail=False)
        return (self / str(name).rstrip("/").rpartition("/")[2] for name in names)

    def is_symlink(self) -> bool:
        return False

    def mkdir(self, *_: Any, **__: Any) -> None:
        pass  # servers have names, not folders

    def open(self, mode: str = "r", *options: Any, **named: Any) -> Any:
        assert not set(mode) & set("wax+")  # writers publish what is complete
        place = mirrored(str(self))
        fetch([place])
        return open(place, mode, *options, **named)

    def resolve(self, *_: Any, **__: Any) -> "UrlPath":
        return self

    absolute = resolve


def as_path(path: str | os.PathLike[str]) -> Path:
    # Return a local path, also of ``file:///...``, or the URL in the form of a path; refuse a chained URL.
    SchemaError.raise_if(
        not isinstance(path, str | bytes | os.PathLike),
        f"a path is {type(path).__name__}",
        expected="a text or pathlib.Path, the name of a file",
        code="type-wrong",
    )
    url, text = url_of(path), os.fsdecode(path)
    FormatError.raise_if(
        url is None and _CHAINED.match(text) and not os.path.lexists(text),
        f"{text:.200}: a chained URL",
        expected="a path or a plain URL",
        mend=CHAINED_MEND,
        code="url-not-plain",
    )
    return Path(re.sub(rf"^{_FILE.pattern}", "/", text)) if url is None else UrlPath(url)


def file_system(url: str) -> tuple[Any, str]:
    # Return the file system of a URL, and the name of the file in it. Listings are not kept, since other
    # processes write.
    from fsspec.core import url_to_fs  # type: ignore[import-untyped]

    with _errors_of(url):
        fs, key = url_to_fs(url, use_listings_cache=False)
    return fs, str(key)


@contextlib.contextmanager
def _errors_of(url: str) -> Iterator[None]:
    # Every file system has its own classes of errors.
    try:
        yield
    except (FileNotFoundError, FormatError, MissingExtraError):
        raise
    except ImportError as error:
        raise MissingExtraError(
            f"{url} cannot be opened: {error}",
            mend="install that package with python -m pip install",
            code="dependency-missing",
        ) from error
    except Exception as error:
        raise FormatError(
            f"{url:.200} cannot be read: {type(error).__name__}: {error!s:.200}",
            expected="a URL that fsspec can read; credentials by its usual environment variables",
            code="url-unusable",
        ) from error


@contextlib.contextmanager
def _reached(url: str) -> Iterator[tuple[Any, str]]:
    # Yield the file system of a URL, and the name of the file in it; errors are those of this package.
    fs, key = file_system(url)
    with _errors_of(url):
        yield fs, key


# --- the temporary folder, which repeats names -------------------------------------------------------------

#: URLs of placeholders, by their place.
_PLACEHOLDERS: dict[str, str] = {}
#: State on the server of every file, by its place: it changes with the content.
_STATES: dict[str, str] = {}
#: Time when a folder was listed, or a file looked for [s].
_ASKED_AT: dict[str, float] = {}
#: Threads of dask open files, too.
_LOCK = threading.RLock()
#: Time after which the server is asked again [s]; a step of the package asks once.
ASK_AGAIN_S = 5.0


@functools.cache
def _mirror() -> tuple[Path, Any]:
    # The object removes the folder when the process ends.
    folder = tempfile.TemporaryDirectory(prefix="hyperpaint-")
    return Path(folder.name), folder


def place_in_mirror(url: str) -> Path:
    # Return the place of a URL in the temporary folder, where nothing need be.
    scheme, _, rest = url.partition("://")
    parts = [part for part in rest.split("/") if part not in ("", ".")]
    FormatError.raise_if(
        ".." in parts or not parts, f"{url:.200}", expected="a URL without '..'", code="path-invalid"
    )
    # a store names the collect that it was made from: no secret may be in it
    FormatError.raise_if(
        "?" in url or re.match(r"[^/]*:[^/]*@", rest),
        f"{scheme}://{rest.partition('?')[0].rpartition('@')[2]:.200}: a URL with a query or a password",
        expected="a plain URL",
        mend="give credentials by the environment, or download the file",
        code="url-not-plain",
    )
    return _mirror()[0].joinpath(scheme, *parts)


def mirrored(url: str) -> Path:
    # Return the place of a URL in the temporary folder, after the server was asked for it.
    path = place_in_mirror(url)
    discover(path)
    return path


def origin_of(path: str | os.PathLike[str]) -> str:
    # Return the URL of a place in the temporary folder; other paths are returned as they are.
    if _mirror.cache_info().currsize and Path(path).is_relative_to(_mirror()[0]):
        scheme, *parts = Path(path).relative_to(_mirror()[0]).parts
        return f"{scheme}://{'/'.join(parts)}"
    return os.fspath(path)


def discover(path: str | os.PathLike[str]) -> None:
    # Make placeholders for a file of the temporary folder and what is beside it, or for what a folder holds.
    place = os.fspath(path)
    url = origin_of(place)
    # the root of a server lists its buckets, but the memory has files there
    if url == place or (url.count("/") < 3 and not url.startswith("memory://")):
        return
    with _LOCK:
        _list(os.path.dirname(place))
        if os.path.isdir(place):
            _list(place)
        elif place not in _STATES and _is_due(place):  # servers without listings know their files
            try:
                with _reached(url) as (fs, key):
                    state = fs.info(key)
            except FileNotFoundError as error:
                if isinstance(error.__cause__, OSError):  # of a server that does not answer
                    del _ASKED_AT[place]
                    with _errors_of(url):
                        raise error.__cause__ from None
                return
            except Exception:  # told again at the next call
                del _ASKED_AT[place]
                raise
            if state["type"] != "directory":
                _add_placeholder(place, url, state)


def _is_due(place: str) -> bool:
    now, asked = time.monotonic(), _ASKED_AT.get(place, -math.inf)
    _ASKED_AT[place] = now if now - asked > ASK_AGAIN_S else asked
    return now - asked > ASK_AGAIN_S


def _list(folder: str) -> None:
    url = origin_of(folder)
    if url.count("/") < 2:
        return
    fs, key = file_system(url)
    if not _is_due(folder):
        return
    os.makedirs(folder, exist_ok=True)
    rows: list[Any] = []
    # a server may refuse to list what it gives by name
    with contextlib.suppress(FileNotFoundError, FormatError), _errors_of(url):
        rows = fs.ls(key, detail=True)
    if len(rows) > MAX_LISTED:  # files in it are found by their names
        return
    listed = {str(row["name"]).rstrip("/").rpartition("/")[2]: row for row in rows}
    for name in os.listdir(folder):  # removed on the server, or to be asked for by name
        place = os.path.join(folder, name)
        if name not in listed and place in _STATES:
            forget(place)
    for name, row in listed.items():
        place = os.path.join(folder, name)
        is_folder = row["type"] == "directory"
        # buckets may have a file and a folder of one name: the first stays
        if (
            name in ("", ".", "..")
            or "\0" in name
            or (os.path.lexists(place) and os.path.isdir(place) != is_folder)
        ):
            continue
        if is_folder:
            os.makedirs(place, exist_ok=True)
        else:
            _add_placeholder(place, origin_of(place), row)


def _content_state(state: Mapping[str, Any]) -> str:
    # What servers tell that changes with the content of a file.
    return "\n".join(
        str(state[name])
        for name in ("size", "ETag", "LastModified", "Last-Modified", "mtime", "created")
        if state.get(name) is not None
    )


def _add_placeholder(place: str, url: str, state: Mapping[str, Any]) -> None:
    content = _content_state(state)
    # pages that list files tell nothing else
    if not content and place in _STATES and place not in _PLACEHOLDERS:
        fs, key = file_system(url)
        content = _content_state(fs.info(key))
    if place not in _STATES or _STATES[place] != content:
        os.makedirs(os.path.dirname(place), exist_ok=True)
        Path(place).write_text(f"{url} is not copied\n", encoding="utf-8")
        _PLACEHOLDERS[place], _STATES[place] = url, content


def forget(path: str | os.PathLike[str]) -> None:
    # Remove what is known of a place, or of a URL that was written.
    url = url_of(path)
    place = os.fspath(path if url is None else place_in_mirror(url))
    with _LOCK:
        for table in (_PLACEHOLDERS, _STATES, _ASKED_AT):
            table.pop(place, None)
        _ASKED_AT.pop(os.path.dirname(place), None)
        with contextlib.suppress(OSError):  # not copied, or a folder
            os.unlink(place)


def fetch(paths: Iterable[str | os.PathLike[str]]) -> None:
    # Copy the content of placeholders; other paths are left as they are.
    #
    # Raises `FormatError`: They cannot be read, or are together above `MAX_COPY_BYTES`.
    with _LOCK:
        urls = {place: _PLACEHOLDERS[place] for place in map(str, paths) if place in _PLACEHOLDERS}
        for places in grouped((url.partition("://")[0], place) for place, url in urls.items()).values():
            fs, _ = file_system(urls[places[0]])
            keys = [file_system(urls[place])[1] for place in places]
            subject = urls[places[0]] if len(places) == 1 else f"{urls[places[0]]} and {len(places) - 1} more"
            with _errors_of(subject), tempfile.TemporaryDirectory(dir=_mirror()[0]) as folder:
                size = sum(size or 0 for size in fs.sizes(keys))
                FormatError.raise_if(
                    size > MAX_COPY_BYTES,
                    f"{subject}: {size} bytes",
                    expected=f"at most {MAX_COPY_BYTES}",
                    mend="download it, and give the path of the copy",
                    code="file-too-large",
                )
                copies = [os.path.join(folder, str(number)) for number in range(len(places))]
                with FormatError.instead_of(
                    FileNotFoundError, f"{subject}: $error is no longer there", code="file-unreadable"
                ):
                    fs.get(keys, copies)
                for place, key, copy in zip(places, keys, copies, strict=True):
                    shutil.move(copy, place)
                    _STATES[place] = _STATES.get(place) or _content_state(fs.info(key))
                    del _PLACEHOLDERS[place]


def remote_states(url: str, only: str = "") -> list[tuple[str, str]]:
    # Return the names of the files below a URL, and what changes with their content; ``only``: their end.
    with _reached(url) as (fs, key):
        rows = fs.find(key, detail=True)
    names = (name for name in sorted(rows) if name.endswith(only))
    return [(name.removeprefix(key), _content_state(rows[name])) for name in names]


def byte_size(path: Path) -> int:
    # Return the size of a file or of all files of a folder, also behind a URL [byte].
    if (url := url_of(origin_of(path))) is not None:
        with _reached(url) as (fs, key):
            return sum(int(row["size"] or 0) for row in fs.find(key, detail=True).values())
    return sum(file.stat().st_size for file in [path, *path.rglob("*")] if file.is_file())


@contextlib.contextmanager
def open_data(path: str | os.PathLike[str]) -> Iterator[tuple[Any, int, int]]:
    # Yield a file to read ranges of its bytes, its size [byte] and a number that changes with its content.
    #
    # ``path``: a local file, a placeholder or a URL.
    url = url_of(origin_of(path))
    if url is None:
        with open(path, "rb", buffering=0) as file:
            status = os.fstat(file.fileno())
            yield file, status.st_size, status.st_mtime_ns
        return
    with _reached(url) as (fs, key):
        state = fs.info(key)
    version = int.from_bytes(hashlib.sha256(_content_state(state).encode()).digest()[:7])
    size = int(state["size"])
    yield RemoteData(fs, key, url, size, version), size, version


def pieces_of(file: Any, starts: list[int], size: int) -> list[bytes]:
    # Return ``size`` bytes from each of the places of a file from `open_data`; requests of a URL run at once.
    if isinstance(file, RemoteData):
        return file.pieces(starts, [start + size for start in starts])
    pieces = []
    for start in starts:
        file.seek(start)
        pieces.append(file.read(size))
    return pieces


@functools.lru_cache(maxsize=16)
def _small_file(url: str, version: int) -> bytes:  # noqa: ARG001
    # A small file is read several times: for its digest, for checks, and to process it.
    with _reached(url) as (fs, key):
        return bytes(fs.cat_file(key))


class RemoteData(io.RawIOBase):
    # A file behind a URL, read by ranges of bytes; small files are read whole.
    def __init__(self, fs: Any, key: str, url: str, size: int, version: int) -> None:
        self._fs, self._key, self._url, self._size, self._version = fs, key, url, size, version
        self._position = 0

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        assert whence == os.SEEK_SET
        self._position = offset
        return offset

    def pieces(self, starts: list[int], ends: list[int]) -> list[bytes]:
        # Return the bytes of ranges; those close to each other come in one request.
        if self._size <= SMALL_BYTES:
            return [self._block(*limits) for limits in zip(starts, ends, strict=True)]
        from fsspec.utils import merge_offset_ranges  # type: ignore[import-untyped]

        ranges = merge_offset_ranges([self._key] * len(starts), starts, ends, max_gap=MAX_GAP_BYTES)
        firsts, lasts = ranges[1], [min(end or 0, self._size) for end in ranges[2]]
        blocks = [self._block(firsts[0], lasts[0])] if firsts else []  # shows whether the server knows ranges
        with _errors_of(self._url):
            blocks += self._fs.cat_ranges(ranges[0][1:], firsts[1:], lasts[1:], on_error="raise")
        for block, first, last in zip(blocks, firsts, lasts, strict=True):
            self._check(block, first, last)
        places = [bisect.bisect_right(firsts, start) - 1 for start in starts]
        return [
            blocks[block][start - firsts[block] : end - firsts[block]]
            for block, start, end in zip(places, starts, ends, strict=True)
        ]

    def readinto(self, buffer: Any) -> int:
        view = memoryview(buffer).cast("B")
        start, end = self._position, min(self._position + len(view), self._size)
        if end <= start:
            return 0
        view[: end - start] = self._block(start, end)
        self._position = end
        return end - start

    def _block(self, start: int, end: int) -> bytes:
        if self._size <= SMALL_BYTES:
            content = _small_file(self._url, self._version)
            self._check(content, 0, self._size)
            return content[start:end]
        with _errors_of(self._url):
            content = bytes(self._fs.cat_file(self._key, start=start, end=end))
        self._check(content, start, end)
        return content

    def _check(self, content: bytes, start: int, end: int) -> None:
        FormatError.raise_if(
            len(content) != end - start,
            f"{self._url}: {len(content)} bytes",
            expected=f"bytes {start} to {end}",
            mend="the server must answer requests for ranges; else download the file",
            code="range-missing",
        )
