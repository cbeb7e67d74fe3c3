"""Virtual stores: groups whose cube stays in the camera's raw files, with references to its slabs.

A virtual store is a repository of icechunk, a folder, with all data except the cube. The root's attribute
`RAW_FILES` lists the raw files of every group.

Repositories may be of unknown origin, so that nothing in them is trusted. Configuration, containers and
credentials do not come from the repository. Raw files are only read below folders that the user allows.
Every reference is compared with the list of raw files and with the size of the file. Links in the folder are
errors. References of kerchunk (JSON) are errors, too, since their readers run templates.
"""

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
from types import SimpleNamespace
from typing import Any
from urllib.parse import quote, unquote

import numpy as np
import xarray as xr

from hyperpaint.base import (
    Array,
    FormatError,
    IncompleteStoreError,
    PaintError,
    Problems,
    StoreError,
    documented,
    grouped,
    head_of,
    needs_extra,
    read_limited,
)

from .computing import encoding, prepare, whole_chunk
from .manifest import INPUTS, clean_group

# Attribute of the root: the raw files of every group, with size and time, and a digest of its inputs.
RAW_FILES = "raw_files"

_READING = SimpleNamespace(
    fill=65535,
    max_json_bytes=2**26,
    # Number of chunks that are checked in parallel.
    max_parallel_reads=64,
)
_ZARR_2 = (".zarray", ".zattrs", ".zgroup", ".zmetadata", "zarr.json")
# a host without user and port (icechunk ignores ports), and a path without characters of special meaning
_REMOTE = re.compile(r"(s3|https?)://[A-Za-z0-9_.-]+(/(?!.*::)[^%?#\\]*)?")
_AGAIN = "write it again: hyperpaint virtual COLLECT.toml --out STORE --overwrite"

Allow = str | os.PathLike[str] | Sequence[str | os.PathLike[str]]


@dataclass(frozen=True)
class RawFile:
    # State of a raw file when references to it were written.
    url: str
    size: int  #: [byte]
    changed_ns: int | None = None  #: Time of the last change [ns]; None for a remote file
    etag: str | None = None  #: ID of the content from the server; None if it has none

    @classmethod
    def of(cls, url: str) -> "RawFile":
        # Return the present state of a file, read with the credentials of the environment.
        #
        # Raises `StoreError`: The file cannot be reached, or icechunk cannot read such URLs.
        check_url(url)
        if url.startswith("file:"):
            with StoreError.instead_of(OSError, f"{url}: $reason", code="file-unreadable"):
                status = os.stat(_local_path(url))
            StoreError.raise_if(
                not stat.S_ISREG(status.st_mode),
                f"{url} is not a regular file",
                expected="a raw file",
                mend="check the path",
                code="file-not-plain",
            )
            return cls(url, status.st_size, status.st_mtime_ns)
        from fsspec.core import url_to_fs  # type: ignore[import-untyped]

        # every file system of fsspec has its own classes
        with StoreError.instead_of(
            Exception,
            f"{url}: $kind: $error",
            mend="check the URL and the credentials of the environment",
            code="file-unreadable",
        ):
            fs, path = url_to_fs(url)
            info = fs.info(path)
            etag = info.get("ETag")
            return cls(url, int(info["size"]), etag=None if etag is None else str(etag).strip('"'))

    def difference(self) -> str:
        # Return a description of how the present file differs from this state, empty if equal.
        try:
            present = RawFile.of(self.url)
        except StoreError as error:
            return str(error)
        if self.size != present.size:
            return f"{self.url}: {present.size} bytes, expected {self.size}"
        if self.etag != present.etag:
            return f"{self.url}: etag {present.etag!r:.100}, expected {self.etag!r:.100}"
        if self.changed_ns != present.changed_ns:
            times = [np.datetime64(time or 0, "ns") for time in (present.changed_ns, self.changed_ns)]
            return f"{self.url}: changed at {times[0]} UTC, expected {times[1]}"
        return ""


def _local_path(url: str) -> str:
    return url.removeprefix("file://")


@dataclass(frozen=True)
class VirtualCube:
    # A cube in raw files: slab ``k`` begins at line ``k * lines``.
    name: str
    dims: tuple[str, ...]  #: In the order of the files, lines first
    shape: tuple[int, ...]
    lines: int  #: Number of lines of a slab
    dtype: np.dtype[Any]  #: With byte order
    attrs: Mapping[str, Any]
    files: tuple[RawFile, ...]
    slabs: tuple[tuple[int, int, int], ...]  #: Index of the slab, index of its file, first byte in the file
    copies: Mapping[int, Array]  #: Values of slabs that are not contiguous in one file, by index of the slab

    @property
    def chunk(self) -> tuple[int, ...]:
        # Shape of a slab.
        return (self.lines, *self.shape[1:])


Groups = Mapping[str, tuple["xr.Dataset", VirtualCube]]


def summary_of(groups: Groups) -> dict[str, dict[str, Any]]:
    # Return the inputs digest of every group, and its raw files, in the form of `virtual_groups`.
    return {
        name: {INPUTS: dataset.attrs.get(INPUTS), RAW_FILES: list(cube.files)}
        for name, (dataset, cube) in groups.items()
    }


def write_icechunk(folder: Path, groups: Groups, attrs: Mapping[str, Any]) -> None:
    # Write groups into a new repository of icechunk: the cube as references, other variables as values.
    #
    # Raises `MissingExtraError`: icechunk is not installed; `StoreError`: it cannot read the raw files'
    # locations.
    import zarr
    from zarr.codecs import BytesCodec

    icechunk = _icechunk()
    repository = icechunk.Repository.create(
        icechunk.local_filesystem_storage(str(folder)),
        _own_config([file.url for _, cube in groups.values() for file in cube.files]),
    )
    session = repository.writable_session("main")
    zarr.open_group(
        session.store,
        mode="a",
        attributes={**attrs, RAW_FILES: json.dumps(summary_of(groups), default=asdict)},
    )
    for name, (dataset, cube) in groups.items():
        companions = prepare(dataset, name)
        companions.to_zarr(
            session.store, group=name, encoding=encoding(companions), consolidated=False, mode="a"
        )
        array = zarr.open_group(session.store, path=name).create_array(
            cube.name,
            shape=cube.shape,
            chunks=cube.chunk,
            dtype=cube.dtype,
            compressors=None,
            serializer=BytesCodec(endian="big" if cube.dtype.str.startswith(">") else "little"),
            fill_value=_READING.fill,
            dimension_names=cube.dims,
            attributes=dict(cube.attrs),
        )
        slabs, size = [], math.prod(cube.chunk) * cube.dtype.itemsize
        for number, file, offset in cube.slabs:
            raw, changed = cube.files[file], None
            # quoted, since icechunk decodes percent signs and hashes of the path as parts of a URL
            url = f"file://{quote(_local_path(raw.url))}" if raw.url.startswith("file:") else raw.url
            if raw.changed_ns is not None:  # icechunk compares whole seconds
                changed = datetime.datetime.fromtimestamp(-(-raw.changed_ns // 10**9), datetime.UTC)
            slabs.append(icechunk.VirtualChunkSpec([number, 0, 0], url, offset, size, raw.etag, changed))
        # icechunk returns rejected references; their chunks would be missing
        StoreError.raise_if(
            session.store.set_virtual_refs(f"/{name}/{cube.name}", slabs),
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
    # without the warning of two writers on a local disk: a repository is written once
    icechunk.set_logs_filter("error")
    return icechunk


def check_url(url: str) -> None:
    # Raise for a URL that icechunk cannot read, or that icechunk and fsspec parse differently.
    is_readable = (
        posixpath.normpath(_local_path(url)) == _local_path(url)
        if url.startswith("file:///")
        else _REMOTE.fullmatch(url) is not None and not {".", ".."} & set(url.split("/"))
    )
    StoreError.raise_if(
        not (is_readable and url.isprintable()),
        f"icechunk cannot read raw files from {url!r:.200}",
        expected="a local path, or a URL with s3, or http or https without a port",
        code="url-unusable",
    )


def _own_config(urls: Sequence[str]) -> Any:
    # Configuration of icechunk with only the containers of the raw files; S3 is configured by the environment
    icechunk = _icechunk()
    config = icechunk.RepositoryConfig.default()
    config.clear_virtual_chunk_containers()
    prefixes = set()
    for url in urls:
        check_url(url)
        # the deepest parent folder whose path needs no quotes in a URL
        parts = url.split("/")[:-1]
        plain = itertools.takewhile(lambda part: quote(part) == part, parts[3:])
        prefixes.add("/".join([*parts[:3], *plain, ""]))
    for prefix in sorted(prefixes):
        if prefix.startswith("file:"):
            storage = icechunk.local_filesystem_store(_local_path(prefix))
        elif prefix.startswith("http"):
            storage = icechunk.http_store({"allow_http": "true"} if prefix.startswith("http:") else {})
        else:
            endpoint = os.environ.get("AWS_ENDPOINT_URL")
            storage = icechunk.s3_store(
                region=os.environ.get("AWS_REGION") or os.environ.get("AWS_DEFAULT_REGION") or "us-east-1",
                endpoint_url=endpoint,
                allow_http=str(endpoint).startswith("http:"),
                force_path_style=endpoint is not None,
                s3_compatible=endpoint is not None,
            )
        config.set_virtual_chunk_container(icechunk.VirtualChunkContainer(prefix, storage))
    return config


def is_virtual(path: str | os.PathLike[str]) -> bool:
    """Return whether a path is a repository of icechunk.

    Examples
    --------
    >>> is_virtual("lot.zarr")
    False
    """
    return all((Path(path) / name).is_dir() for name in ("snapshots", "refs"))


def refuse_kerchunk(path: str | os.PathLike[str], *, write: bool = False) -> None:
    # Raise for references of kerchunk, a JSON file or a folder of parquet; their content is not used.
    #
    # ``write``: whether the path will be written, so that only its suffix is checked.
    #
    # Raises `StoreError`: The path has kerchunk references; keys that programs execute are listed.
    path = Path(path)
    file = path / ".zmetadata" if path.is_dir() else path
    keys: set[str] = set()
    if write:
        if path.suffix.lower() in (".json", ".parq", ".parquet"):
            keys = {"refs"}
    elif head_of(file, 64).lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"{"):
        try:
            keys = set(json.loads(read_limited(file, _READING.max_json_bytes, "references")))
        except FormatError:  # larger than the limit
            keys = {"refs"}
        except (ValueError, RecursionError):
            pass  # not JSON
    is_zarr_2 = not path.is_dir() and any(key.endswith(_ZARR_2) for key in keys)
    if is_zarr_2 or keys & {"refs", "gen", "templates", "record_size"}:
        executed = "".join(
            f", with `{key}`, which programs run" for key in sorted(keys & {"gen", "templates"})
        )
        raise StoreError(
            f"{os.fspath(path)}: kerchunk references{executed}",
            expected="a repository of icechunk, a folder",
            mend="convert trusted references, for instance with virtualizarr, or write a repository with "
            "`hyperpaint virtual COLLECT.toml --out lot.icechunk`",
            code="kerchunk-refused",
        )


@contextlib.contextmanager
def _own_errors(path: str | os.PathLike[str]) -> Iterator[None]:
    # Raise IncompleteStoreError for errors of icechunk and zarr in a damaged or forged repository
    try:
        yield
    except PaintError:
        raise
    except Exception as error:  # both have their own classes; icechunk has the cause in the last line
        cause = str(error).rstrip("\n |`->").rpartition("\n")[2].strip(" |`->")
        raise IncompleteStoreError(
            f"{os.fspath(path)} is damaged: {type(error).__name__}: {cause:.300}",
            expected="a virtual store",
            mend=_AGAIN,
            code="store-damaged",
        ) from error


def _session(path: str | os.PathLike[str], urls: Sequence[str] = ()) -> tuple[Any, Any]:
    refuse_kerchunk(path)
    StoreError.raise_if(
        not is_virtual(path),
        f"{os.fspath(path)} is not a virtual store",
        expected="a folder of `hyperpaint virtual`",
        code="store-unreadable",
    )
    for entry in Path(path).rglob("*"):
        StoreError.raise_if(
            entry.is_symlink(),
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
    # Return the inputs digest and the raw files of every group, without reading the raw files.
    #
    # Raises `StoreError`: There is no such store, it is damaged, or its list of raw files is invalid.
    import zarr

    with _own_errors(path):
        _, session = _session(path)
        text = zarr.open_group(session.store, mode="r").attrs.get(RAW_FILES)
        StoreError.raise_if(
            not isinstance(text, str),
            f"{os.fspath(path)} has no list of raw files",
            expected="a store of `hyperpaint virtual`",
            mend="open it with icechunk and xarray.open_zarr",
            code="raw-files-unnamed",
        )
        groups: dict[str, Any] = json.loads(text)
        for name, about in groups.items():
            StoreError.raise_if(
                not name or clean_group(name) != name or not name.isprintable(),
                f"{os.fspath(path)} has a group {name!r:.200}",
                expected="a path such as 'flightlines/raw_0'",
                mend=_AGAIN,
                code="group-name",
            )
            about[RAW_FILES] = [RawFile(**row) for row in about[RAW_FILES]]
            for raw in about[RAW_FILES]:
                check_url(raw.url)
                numbers = isinstance(raw.size, int) and isinstance(raw.changed_ns, int | None)
                StoreError.raise_if(
                    not (numbers and isinstance(raw.etag, str | None)),
                    f"{os.fspath(path)} describes a raw file by {raw!r:.200}",
                    expected="size and time as whole numbers, the etag as text",
                    mend=_AGAIN,
                    code="type-wrong",
                )
    return groups


def outside(
    path: str | os.PathLike[str], groups: Mapping[str, Any], allow: Allow = ()
) -> tuple[list[str], list[str]]:
    # Return the raw files that may not be read, and the folders and URLs that ``allow`` lacks for them.
    #
    # Files may be read below the parent folder of the repository and below ``allow``, after links are
    # resolved.
    home = os.path.dirname(os.path.realpath(path))
    prefixes = [] if home == os.path.dirname(home) else [f"file://{home}/"]  # not the root of the file system
    for folder_or_url in [allow] if isinstance(allow, str | os.PathLike) else allow:
        text = os.fspath(folder_or_url)
        if "://" not in text or text.startswith("file://"):
            text = f"file://{os.path.realpath(_local_path(text))}"
        check_url(text)
        prefixes.append(text.rstrip("/") + "/")
    real_urls = [
        f"file://{os.path.realpath(_local_path(url))}" if url.startswith("file:") else url
        for url in dict.fromkeys(raw.url for about in groups.values() for raw in about[RAW_FILES])
    ]
    refused = [url for url in real_urls if not f"{url}/".startswith(tuple(prefixes))]
    places = (url.split("/", 3) for url in refused)
    folders_by_root = grouped(
        ("/".join(parts[:3]), posixpath.dirname("/".join(["", *parts[3:]]))) for parts in places
    )
    to_allow: list[str] = []
    for root, folders in folders_by_root.items():
        common = posixpath.commonpath(folders)
        if root != "file://":
            to_allow.append(f"{root}{common}".rstrip("/"))
        else:  # the common folder, unless it is the root of the file system
            to_allow += sorted(set(folders)) if common == "/" else [common]
    return refused, to_allow


async def _check_chunks(repository: Any, session: Any, name: str, urls: Sequence[str], store: str) -> None:
    # Raise for a group with chunks outside the files of ``urls``; ``store``: path in errors.
    # The first and last two bytes of every chunk of the cube are read, since icechunk fails beyond the end of
    # a file; other chunks are read whole, and compared with their checksums.
    import zarr
    from zarr.abc.store import RangeByteRequest, SuffixByteRequest
    from zarr.core.buffer import default_buffer_prototype

    def error(fault: str, expected: str = "", code: str = "reference-wrong") -> IncompleteStoreError:
        return IncompleteStoreError(f"{store}: /{name} {fault}", expected=expected, mend=_AGAIN, code=code)

    # icechunk lists the references of all groups: delete other groups in memory, without a commit
    scratch, parent = repository.writable_session("main"), ""
    for child in name.split("/"):
        for entry in [entry async for entry in scratch.store.list_dir(parent)]:
            if entry not in (child, "zarr.json"):
                await scratch.store.delete_dir(f"{parent}{entry}")
        parent += f"{child}/"
    foreign = {unquote(url) for url in scratch.all_virtual_chunk_locations()} - set(urls)
    if foreign:
        raise error(f"refers to {min(foreign)!r:.200}", "a raw file in the list of the root")
    limit = asyncio.Semaphore(_READING.max_parallel_reads)

    async def check(key: str, size: int | None, has_checksum: bool) -> None:
        async with limit:
            if has_checksum:  # of the encoded bytes, so that a forged chunk is not unpacked
                chunk = await session.store.get(key, default_buffer_prototype())
                if chunk is None or whole_chunk(chunk.to_bytes()) is None:
                    raise error(f"has a damaged chunk, {key}", code="store-damaged")
                return
            length = await session.store.getsize(key)
            if size is not None and length != size:
                raise error(f"has {length} bytes in {key}", str(size))
            count = min(2, length)
            for request in (RangeByteRequest(0, count), SuffixByteRequest(count)) if count else ():
                content = await session.store.get(key, default_buffer_prototype(), request)
                if content is None or len(content) != count:  # offsets near 2**64 wrap around
                    raise error(f"lacks bytes in {key}")

    group = await zarr.api.asynchronous.open_group(session.store, path=name, mode="r")
    async for _, array in group.arrays():
        path = f"{name}/{array.basename}"
        positions = [tuple(at) async for at in session.chunk_coordinates(f"/{path}")]
        kinds = [await session.chunk_type_async(f"/{path}", at) for at in positions]
        size = None
        codecs = [type(codec).__name__ for codec in array.metadata.codecs]
        if _icechunk().ChunkType.VIRTUAL in kinds:
            # references must cover all chunks, with samples that are not encoded
            size = math.prod(array.chunks) * array.dtype.itemsize
            if codecs != ["BytesCodec"] or len(positions) != math.prod(array.cdata_shape):
                raise error(f"has chunks of {array.basename} that `hyperpaint virtual` does not write")
        keys = [f"{path}/{array.metadata.encode_chunk_key(at)}" for at in positions]
        await asyncio.gather(*(check(key, size, codecs[-1] == "Crc32cCodec") for key in keys))


@documented()
def open_virtual(
    path: str | os.PathLike[str],
    group: str | None = None,
    *,
    allow: Allow = (),
    **kwargs: Any,
) -> xr.Dataset:
    """Open a flight line of `hyperpaint virtual`, whose cube stays in the raw files, lazily.

    A store of unknown origin could refer to any file of this computer. A raw file is therefore only read if
    its path, after links are resolved, is below the parent folder of the store, or below a folder or URL of
    ``allow``; if the store lists it with its present size and time of change (or etag); and if all references
    are inside it. The network and credentials of the environment are used for URLs of ``allow`` only.

    Parameters
    ----------
    path
        A repository of icechunk, a folder.
    group
        Group such as ``"flightlines/raw_0"``; may be omitted if there is only one.
    allow
        One or several further folders or URLs (s3, http, https) below which raw files may be read. For S3,
        region, endpoint and keys come from the environment.
    **kwargs

    Returns
    -------
    xarray.Dataset
        A flight line as from `hyperpaint.open_collect`, with one dask chunk per slab of the file.

    Raises
    ------
    StoreError
        There is no such store or group; raw files are in other folders (the message lists them), are missing,
        or have changed, all of which are listed; references point to other files or beyond the end of a
        file; the store is damaged, contains links, or consists of kerchunk references.
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
    StoreError.raise_if(
        name not in groups,
        f"group {name!r} of {os.fspath(path)}",
        expected=f"one of {', '.join(groups)}",
        code="group-unknown",
    )
    # all raw files must be allowed, and unchanged
    refused, to_allow = outside(path, groups, allow)
    if refused:
        argument = to_allow[0] if len(to_allow) == 1 else to_allow
        options = " ".join(f"--allow {shlex.quote(location)}" for location in to_allow)
        raise StoreError(
            f"{os.fspath(path)} refers to {len(refused)} raw files in other folders, such as {refused[0]!r}",
            expected=f"files below {os.path.dirname(os.path.realpath(path))}",
            mend=f"pass allow={argument!r} if these are your raw files",
            option=f"pass {options} if these are your raw files",
            code="raw-file-not-allowed",
        )
    with Problems(f"{os.fspath(path)} refers to raw files that have changed", StoreError) as problems:
        for raw in groups[name][RAW_FILES]:
            problems.add_if(difference := raw.difference(), difference, mend=_AGAIN, code="raw-file-changed")
    urls = [raw.url for raw in groups[name][RAW_FILES]]
    # every reference must be inside one of these files
    with _own_errors(path):
        repository, session = _session(path, urls)
        # in a separate thread, since a notebook has a running event loop
        with ThreadPoolExecutor(1) as thread:
            thread.submit(
                asyncio.run, _check_chunks(repository, session, name, urls, os.fspath(path))
            ).result()
        opened: xr.Dataset = xr.open_zarr(session.store, group=name, **{"consolidated": False, **kwargs})
    return opened
