"""Virtual stores: groups whose cube stays in the camera's raw files, referred to slab by slab.

Written as a repository of icechunk (a folder) or as references of kerchunk (a JSON file); everything but the
cube is stored in it. The root's attribute `RAW_FILES` says which files they were, and `open_virtual` refuses
others; icechunk itself compares the time of change, or the etag, with every slab that is read.
"""

from __future__ import annotations

import base64
import datetime
import itertools
import json
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote, urlsplit

import numpy as np

from hyperpaint.base.arrays import Array
from hyperpaint.base.errors import FormatError, Problems, StoreError, needs_extra

from .groups import INPUTS
from .layout import encoding, prepare

if TYPE_CHECKING:
    import xarray as xr

__all__ = [
    "RAW_FILES", "RawFile", "VirtualCube", "is_virtual", "open_virtual", "summary_of", "virtual_groups",
    "write_icechunk", "write_kerchunk",
]  # fmt: skip

RAW_FILES = "raw_files"
"""Attribute of the root: of every group its raw files as they were, and what names its inputs, as JSON."""

MOST_JSON_BYTES = 2**30
_FILL = 65535
_JSON = "write references of kerchunk, which fsspec follows anywhere: a name that ends in .json"
_JSON_OPTION = "give --out a name that ends in .json"
_METADATA_2 = (".zarray", ".zattrs", ".zgroup")


@dataclass(frozen=True)
class RawFile:
    """A raw file as it was when it was referred to."""

    url: str
    size: int
    changed_ns: int | None = None  #: When it was changed last; of a local file
    etag: str | None = None  #: What names its content, where the server says it

    @classmethod
    def of(cls, url: str, options: Mapping[str, Any] | None = None) -> RawFile:
        """Return what a file is now; ``options``: of its file system.

        Raises `StoreError`: it cannot be reached.
        """
        if url.startswith("file:"):
            try:
                status = os.stat(_local_path(url))
            except OSError as error:
                raise StoreError(f"{url}: {error.strerror}") from error
            return cls(url, status.st_size, status.st_mtime_ns)
        from fsspec.core import url_to_fs  # type: ignore[import-untyped]

        try:
            fs, path = url_to_fs(url, **(options or {}))
            info = fs.info(path)
        except Exception as error:  # each file system of fsspec has its own
            raise StoreError(f"{url}: {type(error).__name__}: {error!s:.200}") from error
        etag = info.get("ETag")
        return cls(url, int(info["size"]), etag=None if etag is None else str(etag).strip('"'))

    def difference(self, now: RawFile) -> str:
        """Return in words how a file differs from this one; empty where it does not."""
        if self.size != now.size:
            return f"{now.size} bytes, expected {self.size}"
        if self.etag != now.etag:
            return f"etag {now.etag}, expected {self.etag}"
        if self.changed_ns != now.changed_ns:
            times = [np.datetime64(each or 0, "ns") for each in (now.changed_ns, self.changed_ns)]
            return f"changed at {times[0]} UTC, expected {times[1]}"
        return ""


def _local_path(url: str) -> str:
    return url.removeprefix("file://")


@dataclass(frozen=True)
class VirtualCube:
    """A cube in raw files: the slab ``k`` is the lines from ``k * lines`` on."""

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

    @property
    def slab_bytes(self) -> int:
        """Bytes of a slab."""
        return int(np.prod(self.chunk)) * self.dtype.itemsize


Groups = Mapping[str, tuple["xr.Dataset", VirtualCube]]


def summary_of(groups: Groups) -> dict[str, dict[str, Any]]:
    """Return what names the inputs of every group, and its raw files, as `virtual_groups` finds them."""
    return {
        name: {INPUTS: dataset.attrs.get(INPUTS), RAW_FILES: [asdict(each) for each in cube.files]}
        for name, (dataset, cube) in groups.items()
    }


def write_icechunk(folder: Path, groups: Groups, attrs: Mapping[str, Any]) -> None:
    """Write groups, each the cube's companions and the cube, into a new repository of icechunk.

    Raises `MissingExtraError`: icechunk is not installed; `StoreError`: raw files lie where it cannot read.
    """
    import zarr
    from zarr.codecs import BytesCodec

    icechunk = _icechunk()
    config = icechunk.RepositoryConfig.default()
    for prefix in sorted({_prefix(file.url) for _, cube in groups.values() for file in cube.files}):
        container = icechunk.VirtualChunkContainer(prefix, _object_store(prefix))
        config.set_virtual_chunk_container(container)
    repository = icechunk.Repository.create(icechunk.local_filesystem_storage(str(folder)), config)
    session = repository.writable_session("main")
    about = {**attrs, RAW_FILES: json.dumps(summary_of(groups))}
    zarr.open_group(session.store, mode="a", attributes=about)
    for name, (dataset, cube) in groups.items():
        rest = prepare(dataset, name)
        rest.to_zarr(session.store, group=name, encoding=encoding(rest), consolidated=False, mode="a")
        array = zarr.open_group(session.store, path=name).create_array(
            cube.name, shape=cube.shape, chunks=cube.chunk, dtype=cube.dtype, compressors=None,
            serializer=BytesCodec(endian="big" if cube.dtype.str.startswith(">") else "little"),
            fill_value=_FILL, dimension_names=cube.dims, attributes=dict(cube.attrs),
        )  # fmt: skip
        slabs = [_specification(icechunk, cube, *slab) for slab in cube.slabs]
        # what it does not take would be read as missing
        if session.store.set_virtual_refs(f"/{name}/{cube.name}", slabs):
            raise StoreError(f"icechunk does not reach {cube.files[0].url}", mend=_JSON, option=_JSON_OPTION)
        for number, block in cube.copies.items():
            array[number * cube.lines : number * cube.lines + len(block)] = block
    session.commit("references to raw cubes")


def _specification(icechunk: Any, cube: VirtualCube, number: int, file: int, offset: int) -> Any:
    raw = cube.files[file]
    changed = None
    if raw.changed_ns is not None:  # whole seconds count there
        changed = datetime.datetime.fromtimestamp(-(-raw.changed_ns // 10**9), datetime.UTC)
    return icechunk.VirtualChunkSpec([number, 0, 0], raw.url, offset, cube.slab_bytes, raw.etag, changed)


def _icechunk() -> Any:
    with needs_extra("icechunk", "virtual", "a virtual store that is a folder (another is a .json)"):
        import icechunk
    # a repository is written once here: its warning of two writers on a local disk says nothing
    icechunk.set_logs_filter("error")
    return icechunk


def _prefix(url: str) -> str:
    """Return the folder below which icechunk may read: one that is spelled alike in paths and URLs."""
    parts = url.split("/")[:-1]
    plain = list(itertools.takewhile(lambda part: quote(part) == part, parts[3:]))
    return "/".join([*parts[:3], *plain, ""])


def _object_store(prefix: str) -> Any:
    """Return how icechunk reads below a URL; of S3 as the environment says."""
    icechunk = _icechunk()
    scheme = urlsplit(prefix).scheme
    if scheme == "file":
        return icechunk.local_filesystem_store(_local_path(prefix))
    if scheme in ("http", "https") and urlsplit(prefix).port is None:  # it leaves ports out
        return icechunk.http_store({"allow_http": "true"} if scheme == "http" else {})
    if scheme == "s3":
        endpoint = os.environ.get("AWS_ENDPOINT_URL")
        return icechunk.s3_store(
            region=os.environ.get("AWS_REGION") or os.environ.get("AWS_DEFAULT_REGION") or "us-east-1",
            endpoint_url=endpoint, allow_http=str(endpoint).startswith("http:"),
            force_path_style=endpoint is not None, s3_compatible=endpoint is not None,
        )  # fmt: skip
    raise StoreError(
        f"icechunk reads no raw files from {prefix}",
        expected="a local path, or a URL with s3, or http or https without a port",
        mend=_JSON,
        option=_JSON_OPTION,
    )


def write_kerchunk(file: Path, groups: Groups, attrs: Mapping[str, Any]) -> None:
    """Write groups, each the cube's companions and the cube, as references of kerchunk (JSON, Zarr 2)."""
    from numcodecs import Blosc
    from zarr.storage import MemoryStore

    codec = Blosc("zstd", clevel=9, shuffle=Blosc.BITSHUFFLE)
    store: dict[str, Any] = {}
    templates: dict[str, str] = {}
    refs: dict[str, Any] = {}
    for name, (dataset, cube) in groups.items():
        rest = prepare(dataset, name)
        stored = {
            key: {word: value for word, value in each.items() if word in ("chunks", "units", "dtype")}
            | {"compressors": (codec,)}
            for key, each in encoding(rest).items()
        }
        options: dict[str, Any] = {"zarr_format": 2, "consolidated": False, "mode": "a"}
        rest.to_zarr(MemoryStore(store), group=name, encoding=stored, **options)
        place = f"{name}/{cube.name}"
        refs[f"{place}/.zarray"] = json.dumps({
            "zarr_format": 2, "shape": cube.shape, "chunks": cube.chunk, "dtype": cube.dtype.str,
            "compressor": None, "filters": None, "fill_value": None, "order": "C",
        })  # fmt: skip
        refs[f"{place}/.zattrs"] = json.dumps({**cube.attrs, "_ARRAY_DIMENSIONS": cube.dims})
        words = [f"f{len(templates) + number}" for number in range(len(cube.files))]
        templates |= {word: raw.url for word, raw in zip(words, cube.files, strict=True)}
        for number, own, offset in cube.slabs:
            refs[f"{place}/{number}.0.0"] = [f"{{{{{words[own]}}}}}", offset, cube.slab_bytes]
        for number, block in cube.copies.items():
            whole = np.full(cube.chunk, _FILL, cube.dtype)
            whole[: len(block)] = block
            refs[f"{place}/{number}.0.0"] = _inline(whole.tobytes())
    refs |= {key: _inline(buffer.to_bytes()) for key, buffer in store.items()}
    about = {**attrs, RAW_FILES: json.dumps(summary_of(groups))}
    refs[".zgroup"], refs[".zattrs"] = '{"zarr_format": 2}', json.dumps(about)
    # zarr does not find the members of a group in references by itself
    metadata = {key: json.loads(text) for key, text in refs.items() if key.endswith(_METADATA_2)}
    refs[".zmetadata"] = json.dumps({"metadata": metadata, "zarr_consolidated_format": 1})
    document = {"version": 1, "templates": templates, "refs": refs}
    file.write_text(json.dumps(document, separators=(",", ":")), encoding="utf-8")


def _inline(content: bytes) -> str:
    """Return bytes as they stand in references."""
    try:
        text = content.decode("ascii")
    except UnicodeDecodeError:
        text = ""
    # double braces would be a template
    plain = text and "{{" not in text and not text.startswith("base64:")
    return text if plain else "base64:" + base64.b64encode(content).decode()


def is_virtual(path: str | os.PathLike[str]) -> bool:
    """Tell whether a path is that of a repository of icechunk, or of references of kerchunk; files are cheap.

    Examples
    --------
    >>> is_virtual("lot.zarr")
    False
    """
    place = Path(path)
    if place.is_dir():
        return (place / "snapshots").is_dir() and (place / "refs").is_dir()
    if place.suffix.lower() != ".json" or not place.is_file():
        return False
    with open(place, "rb") as file:
        return file.read(32).replace(b" ", b"").startswith(b'{"version":1')


def _store(path: str | os.PathLike[str], options: Mapping[str, Any] | None) -> Any:
    """Return the Zarr store of virtual groups, read-only."""
    if not is_virtual(path):
        raise StoreError(f"{os.fspath(path)} is no virtual store", expected="one of `hyperpaint virtual`")
    if Path(path).is_dir():
        icechunk = _icechunk()
        storage = icechunk.local_filesystem_storage(os.fspath(path))
        config = icechunk.Repository.fetch_config(storage)
        prefixes = [] if config is None else list(config.virtual_chunk_containers or ())
        on_s3 = icechunk.s3_from_env_credentials()
        access = {prefix: on_s3 if prefix.startswith("s3:") else None for prefix in prefixes}
        repository = icechunk.Repository.open(
            storage, authorize_virtual_chunk_access=icechunk.containers_credentials(access)
        )
        return repository.readonly_session("main").store
    from fsspec.implementations.reference import ReferenceFileSystem  # type: ignore[import-untyped]
    from zarr.storage import FsspecStore

    if os.path.getsize(path) > MOST_JSON_BYTES:
        raise FormatError(f"{os.fspath(path)} has over {MOST_JSON_BYTES} bytes, which no references have")
    references = json.loads(Path(path).read_text(encoding="utf-8"))
    remote = {**(options or {}), "asynchronous": True}
    return FsspecStore(
        ReferenceFileSystem(references, remote_options=remote, asynchronous=True), read_only=True
    )


def virtual_groups(path: str | os.PathLike[str], options: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Return what names the inputs of every group, and its raw files; see `summary_of`."""
    import zarr

    text = zarr.open_group(_store(path, options), mode="r").attrs.get(RAW_FILES)
    if not isinstance(text, str):
        raise StoreError(
            f"{os.fspath(path)} does not say what its raw files were",
            expected="a store of `hyperpaint virtual`",
            mend="open others by xarray.open_zarr, or by xarray.open_dataset with engine='kerchunk'",
        )
    groups: dict[str, Any] = json.loads(text)
    return groups


def open_virtual(
    path: str | os.PathLike[str],
    group: str | None = None,
    *,
    storage_options: Mapping[str, Any] | None = None,
    **kwargs: Any,
) -> xr.Dataset:
    """Open a flight line whose cube stays in the raw files, as `hyperpaint virtual` writes it, lazily.

    Parameters
    ----------
    path
        A folder of icechunk, or a ``.json`` of kerchunk.
    group
        Such as ``"flightlines/raw_0"``; may be left out where there is one.
    storage_options
        Of the file system of the raw files, for references of kerchunk.
    **kwargs
        Passed to `xarray.open_zarr`, such as ``chunks={"along_track": 256}``.

    Returns
    -------
    xarray.Dataset
        As one of `hyperpaint.open_collect`, with one dask chunk to a slab of the file.

    Raises
    ------
    StoreError
        There is no such store or group; or raw files are missing, or others than those referred to (size,
        and time of change or etag); all are listed.

    Examples
    --------
    >>> import tempfile, hyperpaint as hp
    >>> from hyperpaint.workflows.virtual_store import virtualise  # as `hyperpaint virtual` does
    >>> collect = hp.simulate_collect(tempfile.mkdtemp(), scene="plan", lines=64, bands=4, columns=6)
    >>> line = open_virtual(virtualise(collect, collect.with_name("lot.json")).path)
    >>> line.paint.reflectance().sizes["along_track"]
    64
    """
    import xarray as xr

    groups = virtual_groups(path, storage_options)
    name = (group or "").strip("/")
    if not name and len(groups) == 1:
        (name,) = groups
    if name not in groups:
        raise StoreError(f"group {name!r} of {os.fspath(path)}", expected=f"one of {', '.join(groups)}")
    problems = Problems(f"{os.fspath(path)} refers to raw files that are not what they were", StoreError)
    mend = "write the references again: hyperpaint virtual COLLECT.toml --out STORE --overwrite"
    for row in groups[name][RAW_FILES]:
        before = RawFile(**row)
        try:
            difference = before.difference(RawFile.of(before.url, storage_options))
        except StoreError as error:
            problems.add(str(error), mend=mend)
            continue
        if difference:
            problems.add(f"{before.url}: {difference}", mend=mend)
    problems.raise_if_any()
    options = {"consolidated": not Path(path).is_dir(), **kwargs}
    opened: xr.Dataset = xr.open_zarr(_store(path, storage_options), group=name, **options)
    return opened
