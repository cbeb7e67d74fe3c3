"""The location of a store: a local folder, a zip file, a URL of fsspec, or a store object of zarr."""

from __future__ import annotations

import json
import os
import re
import stat
import uuid
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hyperpaint.base.errors import IncompleteStoreError, MissingExtraError, StoreError

METADATA = "zarr.json"

# Group of the root whose attributes are the manifest; see `manifest`.
MANIFEST_NODE = "hyperpaint"

# Maximum size of a metadata document [byte]: the root of a collect of 60 lines has 2 MB, of 1000 lines 30 MB.
MAX_METADATA_BYTES = 32 * 2**20

# Maximum number of brackets and commas in a metadata document; parsed values take many times their text.
MAX_VALUES = 1_000_000

# Maximum nesting of groups; `process` nests two.
MAX_DEPTH = 16

# Maximum number of groups and arrays of a store: about that of 1,600 flight lines.
MAX_NODES = 50_000


def clean_group(group: str | None) -> str:
    # Return a group's path without outer slashes (``""`` for the root); StoreError for invalid names.
    names = [name for name in (group or "").split("/") if name]
    is_reserved = any(name.startswith((".", "__")) or name == METADATA or "\\" in name for name in names)
    StoreError.raise_if(
        is_reserved or names[:1] == [MANIFEST_NODE],
        f"group {group!r}",
        expected="names separated by slashes, without a leading '.' or '__', the first not "
        f"{MANIFEST_NODE!r}",
        code="group-name",
    )
    return "/".join(names)


def joined(*parts: str) -> str:
    # Return the parts that are not empty, separated by slashes.
    return "/".join(part for part in parts if part)


@dataclass(frozen=True)
class Location:
    # Location of a store; metadata and chunks are read and written by their keys.
    url: str  # Argument for zarr and xarray
    root: str  # Path inside the file system ``fs``
    fs: Any
    local: Path | None  # Folder of a store on a local disk; else None

    @classmethod
    def of(cls, path: str | os.PathLike[str]) -> Location:
        # Return the location for a path or a URL.
        #
        # Raises `MissingExtraError`: The package for this kind of URL is not installed.
        # Raises `StoreError`: The kind of URL is unknown, or it cannot be opened.
        from fsspec.core import url_to_fs  # type: ignore[import-untyped]

        try:
            text = os.fspath(path)
        except TypeError:
            raise StoreError(
                f"store given as {type(path).__name__}",
                expected="a folder or URL",
                mend="open it by open_store(store, group) or xarray.open_zarr(store, group=group)",
                code="type-wrong",
            ) from None
        if "::" in text or "\0" in text:
            # a chained URL can start a cluster (dask::), or copy or unpack files
            kind = "a chained URL" if "::" in text else "a name with a NUL character"
            raise StoreError(
                f"{text!r:.200}: {kind}",
                expected="a folder or a plain URL",
                mend="check the path",
                code="path-not-plain",
            )
        try:
            fs, root = url_to_fs(text)
        except ImportError as error:
            raise MissingExtraError(
                f"{text:.200} cannot be opened: {error}",
                mend="install that package with python -m pip install",
                code="dependency-missing",
            ) from error
        except Exception as error:  # every file system of fsspec has its own classes
            raise StoreError(
                f"{text:.200} cannot be opened: {error!s:.200}",
                expected="a folder, or a URL that fsspec knows",
                code="url-unusable",
            ) from error
        if "file" in (fs.protocol if isinstance(fs.protocol, tuple) else (fs.protocol,)):
            folder = Path(root)
            return cls(str(folder), str(folder), fs, folder)
        return cls(text.rstrip("/"), str(root).rstrip("/"), fs, None)

    def key(self, *parts: str) -> str:
        return joined(self.root, *parts)

    def has(self, *parts: str) -> bool:
        if self.local is not None:
            return os.path.exists(self.key(*parts))
        return bool(self.fs.exists(self.key(*parts)))

    def read(self, *parts: str, limit: int | None = MAX_METADATA_BYTES) -> bytes | None:
        # Return a file's bytes, None if there is no file. `StoreError` above ``limit`` bytes.
        key = self.key(*parts)
        try:
            if self.local is not None:
                mode = os.stat(key).st_mode
                if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):  # reading a pipe would never end
                    raise IncompleteStoreError(f"{key:.200} is not a regular file", code="file-not-plain")
            size = os.path.getsize(key) if self.local is not None else self.fs.size(key)
            if limit is not None and size > limit:
                raise IncompleteStoreError(
                    f"{key} has {size} bytes", expected=f"metadata of at most {limit}", code="file-too-large"
                )
            return Path(key).read_bytes() if self.local is not None else bytes(self.fs.cat_file(key))
        except (FileNotFoundError, IsADirectoryError, NotADirectoryError):
            return None
        except OSError as error:
            if isinstance(error, StoreError):
                raise
            raise StoreError(
                f"{key:.200} cannot be read: {error.strerror or error}", code="file-unreadable"
            ) from error

    def end_of(self, *parts: str) -> bytes:
        # Return the last 4 bytes of a chunk, its crc32c; IncompleteStoreError if the chunk is missing.
        key = self.key(*parts)
        try:
            if self.local is None:
                return bytes(self.fs.tail(key, 4))
            with open(key, "rb") as file:
                file.seek(-4, os.SEEK_END)
                return file.read()
        except OSError as error:
            raise IncompleteStoreError(
                f"the chunk {key} is missing or empty", mend="write the group again", code="chunk-missing"
            ) from error

    def read_json(self, *parts: str) -> dict[str, Any] | None:
        # Return a JSON object, None if there is no file; IncompleteStoreError for a damaged one.
        raw = self.read(*parts)
        if raw is None:
            return None
        if len(raw) > 2**20 and sum(map(raw.count, (b"{", b"[", b","))) > MAX_VALUES:
            raise IncompleteStoreError(
                f"{self.key(*parts)} has more than {MAX_VALUES} values", code="file-too-large"
            )
        try:
            document = json.loads(raw)
        except (ValueError, RecursionError) as error:
            raise IncompleteStoreError(
                f"{self.key(*parts)} is damaged: {error!s:.200}", code="metadata-damaged"
            ) from None
        if not isinstance(document, dict):
            raise IncompleteStoreError(
                f"{self.key(*parts)} is damaged", expected="a JSON object", code="metadata-damaged"
            )
        return document

    def metadata(self, path: str) -> dict[str, Any] | None:
        # Return the ``zarr.json`` of a node without consolidated metadata, None if there is no node.
        document = self.read_json(path, METADATA)
        if document is not None:
            document.pop("consolidated_metadata", None)
            if not isinstance(document.get("attributes", {}), dict):
                raise IncompleteStoreError(
                    f"{self.key(path, METADATA)} is damaged: attributes are not an object",
                    code="metadata-damaged",
                )
        return document

    def kind(self, path: str) -> str:
        # Return ``group``, ``array``, ``unreadable``, or an empty text if there is no node.
        try:
            document = self.metadata(path)
        except StoreError:
            return "unreadable"
        return "" if document is None else str(document.get("node_type"))

    def attributes(self, group: str) -> dict[str, Any]:
        # Return the attributes of a group; empty if its metadata are missing or damaged.
        try:
            return dict((self.metadata(group) or {}).get("attributes", {}))
        except StoreError:
            return {}

    def write_json(self, document: Mapping[str, Any], *parts: str) -> None:
        # Write a JSON object; on a local disk atomically and flushed.
        content = json.dumps(document).encode()
        if self.local is None:
            self.fs.pipe_file(self.key(*parts), content)
            return
        path = self.local.joinpath(*(part for part in parts if part))
        for folder in path.parents[: len(path.relative_to(self.local).parts) - 1]:
            StoreError.raise_if(
                folder.is_symlink(),
                f"{folder} is a link; writers do not follow links inside a store",
                code="link-refused",
            )
        is_new_folder = not path.parent.exists()
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_file(path, [content], durable=True)
        if is_new_folder:
            sync(path.parent.parent)

    def write_files(self, files: Mapping[str, bytes]) -> None:
        # Write small files by their paths, without flushing them.
        if self.local is None:
            self.fs.pipe({self.key(path): content for path, content in files.items()})
            return
        for folder in {self.local.joinpath(path).parent for path in files}:
            folder.mkdir(parents=True, exist_ok=True)
        for path, content in files.items():
            replace_file(self.local / path, [content], durable=False)

    def nodes(self) -> dict[str, str]:
        # Return ``group``, ``array`` or ``unreadable`` by the path of every node below the root.
        #
        # `StoreError` for more than `MAX_NODES`, or groups more than `MAX_DEPTH` deep.
        kinds: dict[str, str] = {}
        pending = [""]
        while pending:
            group = pending.pop()
            for name in self.folders(group):
                path = joined(group, name)
                kind = self.kind(path)
                if path != MANIFEST_NODE and kind in ("group", "array", "unreadable"):
                    kinds[path] = kind
                    pending += [path] if kind == "group" else []
                StoreError.raise_if(
                    len(kinds) > MAX_NODES or path.count("/") > MAX_DEPTH,
                    f"{self.url}: more than {MAX_NODES} groups and arrays, or groups more than "
                    f"{MAX_DEPTH} deep ({path:.80})",
                    mend="open one group by its path",
                    code="nodes-too-many",
                )
        return kinds

    def groups(self) -> list[str]:
        # Return the groups with arrays, sorted.
        return sorted({path.rpartition("/")[0] for path, kind in self.nodes().items() if kind == "array"})

    def entries(self, group: str) -> dict[str, bool]:
        # Return the visible names in a group's folder, and whether they are folders.
        try:
            if self.local is not None:
                with os.scandir(self.key(group)) as entries:
                    listed = {entry.name: entry.is_dir() for entry in entries}
            else:
                listed = {
                    row["name"].rstrip("/").rpartition("/")[2]: row["type"] == "directory"
                    for row in self.fs.ls(self.key(group), detail=True)
                }
        except (FileNotFoundError, NotADirectoryError):
            return {}
        except OSError as error:
            raise StoreError(
                f"{self.key(group):.200} cannot be listed: {error.strerror or error}", code="file-unreadable"
            ) from error
        # without hidden files and temporary files of writers
        return {
            name: folder
            for name, folder in listed.items()
            if not name.startswith(".") and not TEMPORARY.fullmatch(name)
        }

    def folders(self, group: str) -> list[str]:
        return sorted(name for name, folder in self.entries(group).items() if folder)

    def strays(self, group: str) -> list[str]:
        # Return the entries of a group's folder that are not nodes of the store.
        return [
            name
            for name, folder in sorted(self.entries(group).items())
            if name != METADATA and not (folder and self.has(group, name, METADATA))
        ]

    def files(self, path: str) -> set[str]:
        # Return the relative paths of all files below a node.
        if self.local is None:
            prefix = self.key(path).rstrip("/") + "/"
            return {file.removeprefix(prefix) for file in self.fs.find(self.key(path))}
        top = self.key(path)
        return {joined(folder[len(top) + 1 :], name) for folder, _, names in os.walk(top) for name in names}


#: Names of temporary files of hyperpaint and zarr.
TEMPORARY = re.compile(r"\..+\.[0-9a-f]{1,32}|zarr\.[0-9a-f]{32}\.partial")


def replace_file(path: Path, parts: Sequence[bytes], *, durable: bool) -> None:
    # Write a file atomically; ``durable``: flush it, so that it survives a power failure.
    #
    # Without ``durable`` the disk begins to write at once, and the function does not wait for it.
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex[:12]}")
    try:
        with open(temporary, "wb") as file:
            for part in parts:
                file.write(part)
            file.flush()
            if durable:
                os.fsync(file.fileno())
            elif hasattr(os, "posix_fadvise"):
                # Linux starts to write these pages; pages being written stay in memory
                os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
        os.replace(temporary, path)
    except OSError:  # free the space on a full disk
        temporary.unlink(missing_ok=True)
        raise
    if durable:
        sync(path.parent)


def sync(path: str | Path) -> None:
    # Flush a file, or renames in a folder, to the disk.
    if os.name != "posix" and os.path.isdir(path):
        return
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
