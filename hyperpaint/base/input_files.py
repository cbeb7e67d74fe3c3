"""Opening of input files: the name is checked, only plain files are opened, the size is bounded.

A pipe may block for ever, a device has no end, a socket cannot be read, and a URL may reach another machine.
"""

import json
import os
import stat
from io import BufferedReader
from pathlib import Path
from typing import Any

from .errors import FormatError, PaintError
from .remote_files import as_path, discover, fetch, mirrored, open_data, origin_of, url_of

#: Bytes of one name of a path: NAME_MAX of Linux, macOS and Windows.
MAX_NAME_BYTES = 255

#: Bytes of a path: PATH_MAX of Linux.
MAX_PATH_BYTES = 4096

#: Opening does not wait for the writer of a pipe, and the file does not become the controlling terminal.
_OPEN_FLAGS = os.O_RDONLY | sum(
    getattr(os, name, 0) for name in ("O_NONBLOCK", "O_NOCTTY", "O_CLOEXEC", "O_BINARY")
)
#: First bytes of a file of outlines by suffix. They are checked because pyogrio and fiona ignore the suffix,
#: and some formats of theirs open further files.
VECTOR_FILES = {".gpkg": b"SQLite format 3\0", ".shp": b"\0\0\x27\x0a", ".fgb": b"fgb"}
_CHECK_PATH = "check the path"
_KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a pipe",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFSOCK: "a socket",
}


def input_path(
    path: str | os.PathLike[str],
    expected: str = "a file",
    error: type[PaintError] = FormatError,
    instead: str = "",
    content: bool = True,
) -> Path:
    """Return the path of a local file or folder, which need not exist; its name and kind are checked.

    A file behind a URL is copied first, see `hyperpaint.base.remote_files`; with ``content`` false it has a
    place, and is not copied. ``expected`` names the kind of file in messages. Raises ``error``: the name
    holds a NUL or is longer than systems allow; it is a URL where ``instead`` is the mend for outputs that
    need a disk; or it is a pipe, device or socket. Raises `FormatError`: A URL is chained, or cannot be read.

    Examples
    --------
    >>> input_path("dask::https://example.org/sky.csv", "an irradiance series")
    Traceback (most recent call last):
    hyperpaint.base.errors.FormatError: dask::https://example.org/sky.csv: a chained URL, expected a path or \
a plain URL; give the URL after '::' (texts are copied once, cubes read by ranges); unpack zip files first \
[url-not-plain]
    """
    text = os.fsdecode(path)
    shown = text if len(text) <= 200 else f"{text[:120]}...{text[-40:]}"
    error.raise_if(
        "\0" in text,
        f"{shown!r}: a name with a NUL character",
        expected=f"the path of {expected}",
        mend=_CHECK_PATH,
        code="path-invalid",
    )
    encoded = text.encode(errors="surrogatepass")
    error.raise_if(
        len(encoded) > MAX_PATH_BYTES
        or any(len(part) > MAX_NAME_BYTES for part in encoded.split(os.sep.encode())),
        f"{shown}: a path of {len(text)} characters",
        expected=f"{expected} under names of at most {MAX_NAME_BYTES} bytes, {MAX_PATH_BYTES} in all",
        mend=_CHECK_PATH,
        code="path-too-long",
    )
    url = url_of(path)
    error.raise_if(
        url is not None and instead,
        f"{shown}: a URL",
        expected=f"{expected} on a local disk",
        mend=instead,
        code="url-not-local",
    )
    text = os.fspath(as_path(text) if url is None else mirrored(url))
    discover(text)
    if content:
        fetch([text])
    try:
        mode = os.stat(text).st_mode
    except (OSError, ValueError):
        return Path(text)  # opening it raises the error with the reason
    error.raise_if(
        not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)),
        f"{shown}: {_kind(mode)}",
        expected=expected,
        mend=_CHECK_PATH,
        code="file-special",
    )
    return Path(text)


def _kind(mode: int) -> str:
    return _KINDS.get(stat.S_IFMT(mode), "a special file")


def is_plain_file(path: str | os.PathLike[str]) -> bool:
    # Return whether a path names a plain file; False for any name that cannot exist.
    if (url := url_of(path)) is not None:
        return is_plain_file(mirrored(url))
    try:
        discover(path)
        return stat.S_ISREG(os.stat(path).st_mode)
    except (OSError, ValueError):
        return False


def open_input(path: str | os.PathLike[str], expected: str, limit: int | None = None) -> BufferedReader:
    # Open a plain file to read its bytes; ``expected`` names the kind of file in messages.
    #
    # The checks use the open descriptor: another file may take the name in the meantime.
    #
    # Raises `FormatError`: As `input_path`; the file cannot be read, is a folder, or is larger than ``limit``
    # bytes.
    file_path = input_path(path, expected)
    with FormatError.instead_of(
        (OSError, ValueError),
        f"{origin_of(file_path)}: cannot be read ($reason)",
        mend=_CHECK_PATH,
        code="file-unreadable",
    ):
        descriptor = os.open(file_path, _OPEN_FLAGS)
    status = os.fstat(descriptor)
    if stat.S_ISREG(status.st_mode) and (limit is None or status.st_size <= limit):
        return os.fdopen(descriptor, "rb")
    os.close(descriptor)
    FormatError.raise_if(
        stat.S_ISREG(status.st_mode),
        f"{file_path}: {status.st_size} bytes",
        expected=f"{expected} of at most {limit} bytes",
        mend=_CHECK_PATH,
        code="file-too-large",
    )
    raise FormatError(
        f"{origin_of(file_path)}: {_kind(status.st_mode)}",
        expected=expected,
        mend=_CHECK_PATH,
        code="file-special",
    )


def read_limited(path: str | os.PathLike[str], limit: int, expected: str) -> bytes:
    # Return all bytes of a file; ``expected`` names the kind of file in messages.
    #
    # Raises `FormatError`: As `open_input`.
    unreadable = FormatError.instead_of(
        OSError, f"{path}: cannot be read ($reason)", mend="copy it again", code="file-unreadable"
    )
    # read() allocates the requested size
    with open_input(path, expected, limit) as file, unreadable:
        return file.read(os.fstat(file.fileno()).st_size)


def head_of(path: str | os.PathLike[str], count: int) -> bytes:
    # Return the first bytes of a plain file; empty where it cannot be read.
    try:
        place = input_path(path, content=False)
        if origin_of(place) != os.fspath(place):  # behind a URL no more than these are read
            with open_data(place) as (data, _, _):
                return bytes(data.read(count))
        with open_input(path, "a file") as file:
            return file.read(count)
    except (FormatError, OSError):
        return b""


def json_of(value: Any) -> str:
    # Return a value as JSON of one line; ValueError for NaN and infinity, which JSON does not have.
    return json.dumps(value, ensure_ascii=False, allow_nan=False)


def refuse_constant(text: str) -> None:
    # Refuse NaN and infinity; ``parse_constant`` of `json.loads`.
    raise ValueError(f"{text} is not JSON")
