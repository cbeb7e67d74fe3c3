"""Virtual stores: groups whose cube stays in the camera's raw files, referenced slab by slab.

A virtual store is a repository of icechunk, a folder; everything but the cube is stored in it. The root's
attribute `RAW_FILES` lists the raw files of every group.

Repositories may come from anyone, so none of their parts is trusted. Configuration, containers and
credentials are ours. The list of raw files names files, but only the user says below which folders files may
be read. Each reference is compared with the list and with the size of the file. Links in the folder are
refused. References of kerchunk (JSON) are refused by name: their readers run templates.
"""

from __future__ import annotations

import asyncio
import contextlib
import datetime
import itertools
import json
import math
import os
import posixpath
import re
import shlex
import stat
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

import numpy as np
import xarray as xr

from hyperpaint.base.arrays import Array
from hyperpaint.base.errors import (
    FormatError,
    IncompleteStoreError,
    PaintError,
    Problems,
    StoreError,
    needs_extra,
)
from hyperpaint.base.facts import documented
from hyperpaint.base.input_files import head_of, read_limited

from .layout import encoding, prepare
from .location import clean_group
from .manifest import INPUTS

# Attribute of the root: the raw files of every group, with size and time, and a digest of its inputs.
RAW_FILES = "raw_files"

_FILL = 65535
_MAX_JSON_BYTES = 2**26
# Number of chunks checked at a time.
MAX_PARALLEL_READS = 64
_ZARR_2 = (".zarray", ".zattrs", ".zgroup", ".zmetadata", "zarr.json")
# a host without user and port (icechunk ignores ports), a path that all programs read alike
_REMOTE = re.compile(r"(s3|https?)://[A-Za-z0-9_.-]+(/(?!.*::)[^%?#\\]*)?")
_AGAIN = "write it again: hyperpaint virtual COLLECT.toml --out STORE --overwrite"

Allow = str | os.PathLike[str] | Sequence[str | os.PathLike[str]]


@dataclass(frozen=True)
class RawFile:
    """A raw file as it was when it was referenced."""

    url: str
    size: int
    changed_ns: int | None = None  #: When it was changed last; of a local file
    etag: str | None = None  #: Identifies its content, where the server states it

    @classmethod
    def of(cls, url: str) -> RawFile:
        """Return the present state of a file, read with the credentials of the environment.

        Raises `StoreError`: it cannot be reached, or icechunk could not read it.
        """
        check_url(url)
        if url.startswith("file:"):
            try:
                status = os.stat(_local_path(url))
            except OSError as error:
                raise StoreError(f"{url}: {error.strerror}", code="file-unreadable") from error
            if not stat.S_ISREG(status.st_mode):
                raise StoreError(
                    f"{url} is no plain file",
                    expected="a raw file",
                    mend="check the path",
                    code="file-not-plain",
                )
            return cls(url, status.st_size, status.st_mtime_ns)
        from fsspec.core import url_to_fs  # type: ignore[import-untyped]

        try:
            fs, path = url_to_fs(url)
            info = fs.info(path)
            etag = info.get("ETag")
            return cls(url, int(info["size"]), etag=None if etag is None else str(etag).strip('"'))
        except Exception as error:  # each file system of fsspec has its own
            raise StoreError(
                f"{url}: {type(error).__name__}: {error!s:.200}",
                mend="check the URL and the credentials of the environment",
                code="file-unreadable",
            ) from error

    def difference(self) -> str:
        """Return how the present file differs from this one; empty where it does not."""
        try:
            now = RawFile.of(self.url)
        except StoreError as error:
            return str(error)
        if self.size != now.size:
            return f"{self.url}: {now.size} bytes, expected {self.size}"
        if self.etag != now.etag:
            return f"{self.url}: etag {now.etag!r:.100}, expected {self.etag!r:.100}"
        if self.changed_ns != now.changed_ns:
            times = [np.datetime64(each or 0, "ns") for each in (now.changed_ns, self.changed_ns)]
            return f"{self.url}: changed at {times[0]} UTC, expected {times[1]}"
        return ""


def _local_path(url: str) -> str:
    return url.removeprefix("file://")


@dataclass(frozen=True)
class VirtualCube:
    """A cube in raw files: slab ``k`` begins at line ``k * lines``."""

    name: str
    dims: tuple[str, ...]  #: In the order of the files, lines first
    shape: tuple[int, ...]
    lines: int  #: Of a slab
    dtype: np.dtype[Any]  #: Byte order included
    attrs: Mapping[str, Any]
    files: tuple[RawFile, ...]
    slabs: tuple[tuple[int, int, int], ...]  #: Number of a slab, of its file, and the byte where it begins
    copies: Mapping[int, Array]  #: Values of slabs that are no run of bytes of one file

    @property
    def chunk(self) -> tuple[int, ...]:
        """Shape of a slab."""
        return (self.lines, *self.shape[1:])


Groups = Mapping[str, tuple["xr.Dataset", VirtualCube]]


def summary_of(groups: Groups) -> dict[str, dict[str, Any]]:
    """Return the inputs digest of every group, and its raw files, in the form of `virtual_groups`."""
    return {
        name: {INPUTS: dataset.attrs.get(INPUTS), RAW_FILES: list(cube.files)}
        for name, (dataset, cube) in groups.items()
    }


def write_icechunk(folder: Path, groups: Groups, attrs: Mapping[str, Any]) -> None:
    """Write groups (the cube's companions, and the cube as references) into a new repository of icechunk.

    Raises `MissingExtraError`: icechunk is not installed; `StoreError`: it cannot read the raw files'
    locations.
    """
    import zarr
    from zarr.codecs import BytesCodec

    icechunk = _icechunk()
    config = _own_config([file.url for _, cube in groups.values() for file in cube.files])
    repository = icechunk.Repository.create(icechunk.local_filesystem_storage(str(folder)), config)
    session = repository.writable_session("main")
    about = {**attrs, RAW_FILES: json.dumps(summary_of(groups), default=asdict)}
    zarr.open_group(session.store, mode="a", attributes=about)
    for name, (dataset, cube) in groups.items():
        rest = prepare(dataset, name)
        rest.to_zarr(session.store, group=name, encoding=encoding(rest), consolidated=False, mode="a")
        array = zarr.open_group(session.store, path=name).create_array(
            cube.name,
            shape=cube.shape,
            chunks=cube.chunk,
            dtype=cube.dtype,
            compressors=None,
            serializer=BytesCodec(endian="big" if cube.dtype.str.startswith(">") else "little"),
            fill_value=_FILL,
            dimension_names=cube.dims,
            attributes=dict(cube.attrs),
        )
        slabs, size = [], math.prod(cube.chunk) * cube.dtype.itemsize
        for number, file, offset in cube.slabs:
            raw, changed = cube.files[file], None
            # icechunk reads the path as part of a URL: a percent sign or a hash in it would lead elsewhere
            url = f"file://{quote(_local_path(raw.url))}" if raw.url.startswith("file:") else raw.url
            if raw.changed_ns is not None:  # icechunk compares whole seconds
                changed = datetime.datetime.fromtimestamp(-(-raw.changed_ns // 10**9), datetime.UTC)
            slabs.append(icechunk.VirtualChunkSpec([number, 0, 0], url, offset, size, raw.etag, changed))
        # rejected references would be read as missing chunks
        if session.store.set_virtual_refs(f"/{name}/{cube.name}", slabs):
            raise StoreError(
                f"icechunk does not reach {cube.files[0].url}",
                expected="raw files below a folder or URL that icechunk reads",
                mend="copy the raw files to a local disk",
                code="file-unreadable",
            )
        for number, block in cube.copies.items():
            array[number * cube.lines : number * cube.lines + len(block)] = block
    session.commit("references to raw cubes")


def _icechunk() -> Any:
    with needs_extra("icechunk", "virtual", "a virtual store"):
        import icechunk
    # icechunk warns of two writers on a local disk; here a repository is written once
    icechunk.set_logs_filter("error")
    return icechunk


def check_url(url: str) -> None:
    """Refuse a URL below which icechunk reads no raw files, or that icechunk and fsspec read differently."""
    if url.startswith("file:///"):
        good = posixpath.normpath(_local_path(url)) == _local_path(url)
    else:
        good = _REMOTE.fullmatch(url) is not None and not {".", ".."} & set(url.split("/"))
    if not (good and url.isprintable()):
        raise StoreError(
            f"icechunk reads no raw files from {url!r:.200}",
            expected="a local path, or a URL with s3, or http or https without a port",
            code="url-unusable",
        )


def _own_config(urls: Sequence[str]) -> Any:
    # A configuration of icechunk with the containers of raw files, and no others.
    # S3 is configured by the environment.
    icechunk = _icechunk()
    config = icechunk.RepositoryConfig.default()
    config.clear_virtual_chunk_containers()
    prefixes = set()
    for url in urls:
        check_url(url)
        # the deepest folder that is spelled alike in paths and URLs
        parts = url.split("/")[:-1]
        plain = itertools.takewhile(lambda part: quote(part) == part, parts[3:])
        prefixes.add("/".join([*parts[:3], *plain, ""]))
    for prefix in sorted(prefixes):
        if prefix.startswith("file:"):
            place = icechunk.local_filesystem_store(_local_path(prefix))
        elif prefix.startswith("http"):
            place = icechunk.http_store({"allow_http": "true"} if prefix.startswith("http:") else {})
        else:
            endpoint = os.environ.get("AWS_ENDPOINT_URL")
            place = icechunk.s3_store(
                region=os.environ.get("AWS_REGION") or os.environ.get("AWS_DEFAULT_REGION") or "us-east-1",
                endpoint_url=endpoint,
                allow_http=str(endpoint).startswith("http:"),
                force_path_style=endpoint is not None,
                s3_compatible=endpoint is not None,
            )
        config.set_virtual_chunk_container(icechunk.VirtualChunkContainer(prefix, place))
    return config


def is_virtual(path: str | os.PathLike[str]) -> bool:
    """Return whether a path leads to a repository of icechunk.

    Examples
    --------
    >>> is_virtual("lot.zarr")
    False
    """
    return all((Path(path) / name).is_dir() for name in ("snapshots", "refs"))


def refuse_kerchunk(path: str | os.PathLike[str], *, write: bool = False) -> None:
    """Refuse references of kerchunk, a JSON file or a folder of parquet; their content is not used.

    ``write``: the path is to be written, and its name decides.

    Raises `StoreError`: they are kerchunk references; parts that programs execute are named.
    """
    place = Path(path)
    file = place / ".zmetadata" if place.is_dir() else place
    keys: set[str] = set()
    if write:
        if place.suffix.lower() in (".json", ".parq", ".parquet"):
            keys = {"refs"}
    elif head_of(file, 64).lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"{"):
        try:
            keys = set(json.loads(read_limited(file, _MAX_JSON_BYTES, "references")))
        except FormatError:  # larger than the limit
            keys = {"refs"}
        except (ValueError, RecursionError):
            pass  # not JSON
    of_zarr_2 = not place.is_dir() and any(key.endswith(_ZARR_2) for key in keys)
    if of_zarr_2 or keys & {"refs", "gen", "templates", "record_size"}:
        parts = "".join(
            f", with `{part}`, which programs run" for part in sorted(keys & {"gen", "templates"})
        )
        raise StoreError(
            f"{os.fspath(path)}: kerchunk references{parts}",
            expected="a repository of icechunk, a folder",
            mend="convert references that you trust with tools that you trust, such as virtualizarr, or "
            "write a repository with `hyperpaint virtual COLLECT.toml --out lot.icechunk`",
            code="kerchunk-refused",
        )


@contextlib.contextmanager
def _own_errors(path: str | os.PathLike[str]) -> Iterator[None]:
    # Turn errors of icechunk and zarr about a damaged or forged repository into IncompleteStoreError.
    try:
        yield
    except PaintError:
        raise
    except Exception as error:  # each library has its own; icechunk names the cause in the last line
        cause = str(error).rstrip("\n |`->").rpartition("\n")[2].strip(" |`->")
        raise IncompleteStoreError(
            f"{os.fspath(path)} is damaged: {type(error).__name__}: {cause:.300}",
            expected="a virtual store",
            mend=_AGAIN,
            code="store-damaged",
        ) from error


def _session(path: str | os.PathLike[str], urls: Sequence[str] = ()) -> tuple[Any, Any]:
    refuse_kerchunk(path)
    if not is_virtual(path):
        raise StoreError(
            f"{os.fspath(path)} is no virtual store",
            expected="one of `hyperpaint virtual`",
            code="store-unreadable",
        )
    for entry in Path(path).rglob("*"):
        if entry.is_symlink():
            raise StoreError(
                f"{os.fspath(entry)!r} is a link",
                expected="plain files and folders",
                mend=_AGAIN,
                code="link-refused",
            )
    icechunk = _icechunk()
    config = _own_config(urls)
    access = {
        prefix: icechunk.s3_from_env_credentials() if prefix.startswith("s3:") else None
        for prefix in config.virtual_chunk_containers or ()
    }
    repository = icechunk.Repository.open(
        icechunk.local_filesystem_storage(os.fspath(path)),
        config,
        authorize_virtual_chunk_access=icechunk.containers_credentials(access),
    )
    return repository, repository.readonly_session("main")


def virtual_groups(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Return the inputs digest of every group, and its raw files, which are not read.

    Raises `StoreError`: there is no such store, it is damaged, or its list of raw files is invalid.
    """
    import zarr

    with _own_errors(path):
        _, session = _session(path)
        text = zarr.open_group(session.store, mode="r").attrs.get(RAW_FILES)
        if not isinstance(text, str):
            raise StoreError(
                f"{os.fspath(path)} does not name its raw files",
                expected="a store of `hyperpaint virtual`",
                mend="open others with icechunk and xarray.open_zarr",
                code="raw-files-unnamed",
            )
        groups: dict[str, Any] = json.loads(text)
        for name, about in groups.items():
            if not name or clean_group(name) != name or not name.isprintable():
                raise StoreError(
                    f"{os.fspath(path)} names a group {name!r:.200}",
                    expected="a path such as 'flightlines/raw_0'",
                    mend=_AGAIN,
                    code="group-name",
                )
            about[RAW_FILES] = [RawFile(**row) for row in about[RAW_FILES]]
            for raw in about[RAW_FILES]:
                check_url(raw.url)
                numbers = isinstance(raw.size, int) and isinstance(raw.changed_ns, int | None)
                if not (numbers and isinstance(raw.etag, str | None)):
                    raise StoreError(
                        f"{os.fspath(path)} describes a raw file by {raw!r:.200}",
                        expected="size and time as whole numbers, the etag as text",
                        mend=_AGAIN,
                        code="type-wrong",
                    )
    return groups


def outside(
    path: str | os.PathLike[str], groups: Mapping[str, Any], allow: Allow = ()
) -> tuple[list[str], list[str]]:
    """Return the raw files that may not be read, and the folders and URLs to allow for them.

    Files may be read below the folder that holds the repository and below ``allow``, links resolved.
    """
    home = os.path.dirname(os.path.realpath(path))
    prefixes = [] if home == os.path.dirname(home) else [f"file://{home}/"]  # not the root of the file system
    for each in [allow] if isinstance(allow, str | os.PathLike) else allow:
        text = os.fspath(each)
        if "://" not in text or text.startswith("file://"):
            text = f"file://{os.path.realpath(_local_path(text))}"
        check_url(text)
        prefixes.append(text.rstrip("/") + "/")
    refused, needed = [], []
    places: dict[str, set[str]] = {}
    for url in dict.fromkeys(raw.url for about in groups.values() for raw in about[RAW_FILES]):
        real = f"file://{os.path.realpath(_local_path(url))}" if url.startswith("file:") else url
        if not any(f"{real}/".startswith(prefix) for prefix in prefixes):
            refused.append(real)
            parts = real.split("/", 3)
            places.setdefault("/".join(parts[:3]), set()).add(posixpath.dirname("/".join(["", *parts[3:]])))
    for root, folders in places.items():
        common = posixpath.commonpath(folders)
        if root != "file://":
            needed.append(f"{root}{common}".rstrip("/"))
        else:  # the common folder, but not the root of the file system
            needed += sorted(folders) if common == "/" else [common]
    return refused, needed


async def _check_chunks(repository: Any, session: Any, name: str, urls: Sequence[str], place: str) -> None:
    # Refuse a group with chunks outside the files of ``urls``; ``place`` names it in errors.
    # The first and the last two bytes of each chunk are read: icechunk fails beyond the end of a file.
    import zarr
    from zarr.abc.store import RangeByteRequest, SuffixByteRequest
    from zarr.core.buffer import default_buffer_prototype

    def error(fault: str, expected: str = "") -> IncompleteStoreError:
        return IncompleteStoreError(
            f"{place}: /{name} {fault}", expected=expected, mend=_AGAIN, code="reference-wrong"
        )

    # icechunk lists the references of all groups: delete the others in memory, without a commit
    own, above = repository.writable_session("main"), ""
    for part in name.split("/"):
        for other in [each async for each in own.store.list_dir(above)]:
            if other not in (part, "zarr.json"):
                await own.store.delete_dir(f"{above}{other}")
        above += f"{part}/"
    foreign = {unquote(url) for url in own.all_virtual_chunk_locations()} - set(urls)
    if foreign:
        raise error(f"refers to {min(foreign)!r:.200}", "a raw file that the root names")
    limit = asyncio.Semaphore(MAX_PARALLEL_READS)

    async def check(key: str, size: int | None) -> None:
        async with limit:
            length = await session.store.getsize(key)
            if size is not None and length != size:
                raise error(f"has {length} bytes in {key}", str(size))
            some = min(2, length)
            for part in (RangeByteRequest(0, some), SuffixByteRequest(some)) if some else ():
                content = await session.store.get(key, default_buffer_prototype(), part)
                if content is None or len(content) != some:  # offsets near 2**64 wrap around
                    raise error(f"lacks bytes in {key}")

    group = await zarr.api.asynchronous.open_group(session.store, path=name, mode="r")
    async for _, array in group.arrays():
        path = f"{name}/{array.basename}"
        places = [tuple(at) async for at in session.chunk_coordinates(f"/{path}")]
        kinds = [await session.chunk_type_async(f"/{path}", at) for at in places]
        size = None
        if _icechunk().ChunkType.VIRTUAL in kinds:
            # slabs of raw files hold plain samples, and none is missing
            size = math.prod(array.chunks) * array.dtype.itemsize
            codecs = [type(codec).__name__ for codec in array.metadata.codecs]
            if codecs != ["BytesCodec"] or len(places) != math.prod(array.cdata_shape):
                raise error(f"has chunks of {array.basename} that `hyperpaint virtual` does not write")
        keys = [f"{path}/{array.metadata.encode_chunk_key(at)}" for at in places]
        await asyncio.gather(*(check(key, size) for key in keys))


@documented()
def open_virtual(
    path: str | os.PathLike[str],
    group: str | None = None,
    *,
    allow: Allow = (),
    **kwargs: Any,
) -> xr.Dataset:
    """Open a flight line whose cube stays in the raw files, as `hyperpaint virtual` writes it, lazily.

    A store may come from anyone, and names the files that are read as counts. So a raw file is read only if
    it lies below the folder that holds the store, or below a folder or URL of ``allow``, after links are
    resolved; if the store lists it, with its present size and time of change (or etag); and if every
    reference lies inside it. Only for URLs of ``allow`` is the network read, and are credentials of the
    environment used.

    Parameters
    ----------
    path
        A repository of icechunk, a folder.
    group
        Such as ``"flightlines/raw_0"``; may be omitted where there is one.
    allow
        More folders, or URLs (s3, http, https), below which raw files may be read; one or several. S3
        takes region, endpoint and keys from the environment.
    **kwargs

    Returns
    -------
    xarray.Dataset
        As one of `hyperpaint.open_collect`, with one dask chunk to a slab of the file.

    Raises
    ------
    StoreError
        There is no such store or group; raw files lie elsewhere (the message says what to allow), are
        missing, or differ from those referenced, all of which are listed; references lead to other files or
        beyond the end of one; the store is damaged, holds links, or is references of kerchunk.
    MissingExtraError
        icechunk is not installed.

    Examples
    --------
    >>> line = open_virtual("lot.icechunk", "flightlines/raw_0", allow="/data/day")     # doctest: +SKIP
    >>> line = line.paint.reflectance()                                                 # doctest: +SKIP

    >>> import tempfile
    >>> references = Path(tempfile.mkdtemp(), "lot.json")
    >>> _ = references.write_text('{"version": 1, "gen": [], "refs": {}}')
    >>> open_virtual(references)
    Traceback (most recent call last):
    hyperpaint.base.errors.StoreError: ...lot.json: kerchunk references, with `gen`, which programs run, ...
    """
    groups = virtual_groups(path)
    name = (group or "").strip("/")
    if not name and len(groups) == 1:
        (name,) = groups
    if name not in groups:
        raise StoreError(
            f"group {name!r} of {os.fspath(path)}",
            expected=f"one of {', '.join(groups)}",
            code="group-unknown",
        )
    # raw files: all are allowed, and are the files that the record describes
    refused, needed = outside(path, groups, allow)
    if refused:
        shown = needed[0] if len(needed) == 1 else needed
        options = " ".join(f"--allow {shlex.quote(each)}" for each in needed)
        raise StoreError(
            f"{os.fspath(path)} refers to raw files elsewhere ({len(refused)}, such as {refused[0]!r})",
            expected=f"files below {os.path.dirname(os.path.realpath(path))}",
            mend=f"pass allow={shown!r} if these are your raw files",
            option=f"pass {options} if these are your raw files",
            code="raw-file-not-allowed",
        )
    problems = Problems(f"{os.fspath(path)} refers to raw files that have changed", StoreError)
    for raw in groups[name][RAW_FILES]:
        if difference := raw.difference():
            problems.add(difference, mend=_AGAIN, code="raw-file-changed")
    problems.raise_if_any()
    urls = [raw.url for raw in groups[name][RAW_FILES]]
    # references: each lies in one of these files
    with _own_errors(path):
        repository, session = _session(path, urls)
        # in a thread of its own: a notebook has a running loop
        with ThreadPoolExecutor(1) as thread:
            checked = _check_chunks(repository, session, name, urls, os.fspath(path))
            thread.submit(asyncio.run, checked).result()
        opened: xr.Dataset = xr.open_zarr(session.store, group=name, **{"consolidated": False, **kwargs})
    return opened
