"""Where a store lies: a local folder, or a URL of fsspec."""

from __future__ import annotations

import json
import os
import re
import stat
import uuid
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hyperpaint.base.errors import IncompleteStoreError, MissingExtraError, StoreError

from .documents import MOST_JSON_BYTES, parse_document

METADATA = "zarr.json"

MOST_DEPTH = 16
"""Groups within groups; `process` nests two."""

MOST_NODES = 50_000
"""Groups and arrays of a store, and folders of a group: some 1,600 flight lines."""

_HEAD_BYTES = 2**20
"""What is read of the root for its attributes: the record of 1,600 lines has a quarter of it."""

_ATTRIBUTES = re.compile(rb'\s*\{\s*"attributes"\s*:\s*(?=\{)')

_MOST_FOLDERS_DEEP = 40
"""Folders within an array's folder: one for each of its dims, which are 32 at the most."""


def clean_group(group: str | None) -> str:
    """Return a group's path without slashes around it (the root is ``""``), or raise a StoreError."""
    parts = [part for part in (group or "").split("/") if part]
    if any(part.startswith((".", "__")) or part == METADATA or "\\" in part for part in parts):
        raise StoreError(f"group {group!r}: expected names without a leading '.' or '__' between slashes")
    return "/".join(parts)


@dataclass(frozen=True)
class Location:
    """A store's place."""

    url: str  # What zarr and xarray open
    root: str  # Path inside the file system ``fs``
    fs: Any
    local: Path | None  # The folder, where the store is on a local disk

    @classmethod
    def of(cls, path: str | os.PathLike[str]) -> Location:
        """Return the place named by a path or a URL.

        Raises `MissingExtraError`: The package for this kind of URL is not installed; its name is given.
        Raises `StoreError`: The URL is of no known kind, or what it leads to cannot be opened.
        """
        from fsspec.core import url_to_fs  # type: ignore[import-untyped]

        text = os.fspath(path)
        if "::" in text or "\0" in text:
            # dask:: would start a cluster, and others copy or unpack what they are given
            what = "a chained URL" if "::" in text else "a name with a NUL character"
            raise StoreError(f"{text!r:.200}: {what}, expected a folder or a plain URL; check the path")
        try:
            fs, root = url_to_fs(text)
        except ImportError as error:
            raise MissingExtraError(
                f"{text:.200} cannot be opened: {error}; install that package with python -m pip install"
            ) from error
        except Exception as error:  # each file system of fsspec has its own
            raise StoreError(
                f"{text:.200} cannot be opened: {error!s:.200}; expected a folder, or a URL that fsspec knows"
            ) from error
        if "file" in (fs.protocol if isinstance(fs.protocol, tuple) else (fs.protocol,)):
            folder = Path(root)
            return cls(str(folder), str(folder), fs, folder)
        return cls(text.rstrip("/"), str(root).rstrip("/"), fs, None)

    def key(self, group: str, *parts: str) -> str:
        """Return a path inside the file system."""
        return "/".join(part for part in (self.root, group, *parts) if part)

    def group_url(self, group: str) -> str:
        """Return what zarr opens for a group."""
        return f"{self.url}/{group}" if group else self.url

    def has(self, group: str, *parts: str) -> bool:
        """Tell whether a file or folder is there."""
        return bool(self.fs.exists(self.key(group, *parts)))

    def read(self, group: str, *parts: str, head_bytes: int | None = None) -> bytes | None:
        """Return a small file's bytes; None without such a file, StoreError where it may not be read.

        ``head_bytes``: of a file of any size, so many from its begin.
        """
        key = self.key(group, *parts)
        try:
            if self.local is not None:
                if plain_file(self.root, key[len(self.root) :].lstrip("/")) is None:
                    return None
            elif ".." in key.split("/"):
                raise StoreError(f"{key} leads out of the store")
            if head_bytes is not None:
                return bytes(self.fs.cat_file(key, start=0, end=head_bytes))
            if self.fs.size(key) > MOST_JSON_BYTES:
                raise IncompleteStoreError(
                    f"{key} is larger than {MOST_JSON_BYTES} bytes, which no metadata of a store is"
                )
            return bytes(self.fs.cat_file(key))
        except (FileNotFoundError, IsADirectoryError, NotADirectoryError):
            return None
        except OSError as error:
            raise StoreError(f"{key:.200} cannot be read: {error.strerror or error}") from error

    def read_json(self, group: str, *parts: str) -> dict[str, Any] | None:
        """Return a JSON object; None without such a file, IncompleteStoreError where it is damaged."""
        raw = self.read(group, *parts)
        return None if raw is None else parse_document(raw, self.key(group, *parts))

    def root_attributes(self) -> dict[str, Any]:
        """Return the attributes of the root, without its list of all metadata, which is long and follows."""
        head = self.read("", METADATA, head_bytes=_HEAD_BYTES) or b""
        if (match := _ATTRIBUTES.match(head)) is not None:
            try:
                attributes = json.JSONDecoder().raw_decode(head[match.end() :].decode(errors="ignore"))[0]
            except (ValueError, RecursionError):
                pass  # longer than that, or damaged
            else:
                return dict(attributes)
        attributes = (self.read_json("", METADATA) or {}).get("attributes")
        return attributes if isinstance(attributes, dict) else {}

    def metadata(self, group: str, *parts: str) -> dict[str, Any] | None:
        """Return the ``zarr.json`` of a node without consolidated metadata; None where there is no node."""
        document = self.read_json(group, *parts, METADATA)
        if document is not None:
            document.pop("consolidated_metadata", None)
        return document

    def write_json(self, document: dict[str, Any], *parts: str, durable: bool = True) -> None:
        """Write a JSON object, on a local disk so that it is there whole or not at all.

        ``durable``: see `replace_file`.
        """
        content = json.dumps(document).encode()
        if self.local is None:
            self.fs.pipe_file(self.key(*parts), content)
        else:
            replace_file(self.local.joinpath(*parts), [content], durable=durable)

    def write_files(self, files: Mapping[str, bytes]) -> None:
        """Write small files by their paths; see `replace_file` for what is not durable."""
        if self.local is None:
            self.fs.pipe({self.key(path): content for path, content in files.items()})
            return
        for folder in {self.local.joinpath(path).parent for path in files}:
            folder.mkdir(parents=True, exist_ok=True)
        for path, content in files.items():
            replace_file(self.local / path, [content], durable=False)

    def groups(self) -> list[str]:
        """Return every group that holds arrays, sorted; unreadable nodes are passed over; see `nodes`."""
        arrays = (path for path, kind in self.nodes().items() if kind == "array")
        return sorted({path.rpartition("/")[0] for path in arrays})

    def nodes(self) -> dict[str, str]:
        """Return every node below the root: ``group``, ``array``, or ``unreadable``.

        StoreError where there are more than `MOST_NODES`, or groups more than `MOST_DEPTH` deep; or see
        `folders`.
        """
        kinds: dict[str, str] = {}
        pending = [""]
        while pending:
            group = pending.pop()
            for child in self.folders(group):
                path = f"{group}/{child}" if group else child
                if (kind := self.node_type(path)) in ("group", "array", "unreadable"):
                    kinds[path] = str(kind)
                    if len(kinds) > MOST_NODES:
                        raise StoreError(
                            f"{self.url} holds more than {MOST_NODES} groups and arrays, which no store does"
                        )
                if kind == "group":
                    pending.append(path)
        return kinds

    def folders(self, group: str) -> list[str]:
        """Return the names of the folders in a group.

        StoreError where one of them is a link, which would lead out of the store, or around in it without
        end; where there are more than `MOST_NODES`, the group is more than `MOST_DEPTH` deep, or it cannot be
        listed.
        """
        if group.count("/") >= MOST_DEPTH:
            raise StoreError(
                f"{self.url}: groups more than {MOST_DEPTH} deep ({group:.80}...), which no store of ours has"
            )
        names: list[str] = []
        try:
            for name, is_folder, is_link in self._entries(group):
                if is_folder and is_link:
                    place = self.key(group, name)
                    raise StoreError(
                        f"{place}: a link to another folder; a store holds plain files and folders"
                    )
                if is_folder:
                    names.append(name)
                if len(names) > MOST_NODES:
                    raise StoreError(
                        f"{self.key(group)} holds more than {MOST_NODES} folders, which no group does"
                    )
        except (FileNotFoundError, NotADirectoryError):
            return []
        except OSError as error:
            raise StoreError(f"{self.key(group):.200} cannot be listed: {error.strerror or error}") from error
        return sorted(names)

    def _entries(self, group: str) -> Iterator[tuple[str, bool, bool]]:
        """Yield the name of each entry of a group's folder, whether it is a folder, and whether a link."""
        if self.local is not None:
            with os.scandir(self.key(group)) as entries:
                yield from ((e.name, e.is_dir(), e.is_symlink()) for e in entries)
            return
        for entry in self.fs.ls(self.key(group), detail=True):
            yield entry["name"].rstrip("/").rsplit("/", 1)[-1], entry["type"] == "directory", False

    def strays(self, group: str) -> list[str]:
        """Return what lies in a group's folder and is no node of the store; hidden files do not count."""
        visible = [(n, f) for n, f, _ in self._entries(group) if n != METADATA and not n.startswith(".")]
        return sorted(
            name
            for name, is_folder in visible
            if not is_folder or self.node_type(f"{group}/{name}".lstrip("/")) is None
        )

    def node_type(self, path: str) -> str | None:
        """Return ``group``, ``array`` or ``unreadable``, None where there is no node."""
        try:
            document = self.read_json(path, METADATA)
        except StoreError:
            return "unreadable"
        return None if document is None else str(document.get("node_type"))

    def files(self, group: str) -> set[str]:
        """Return the paths of all files below a group, relative to it; links are files."""
        if self.local is None:
            prefix = self.key(group).rstrip("/") + "/"
            return {file.removeprefix(prefix) for file in self.fs.find(self.key(group))}
        top = self.key(group)

        def refuse(error: OSError) -> None:
            if not isinstance(error, FileNotFoundError):
                reason = error.strerror or error
                raise StoreError(f"{error.filename!s:.200} cannot be listed: {reason}") from error

        paths: set[str] = set()
        for folder, folders, names in os.walk(top, onerror=refuse):
            inside = folder[len(top) + 1 :]
            if inside.count("/") > _MOST_FOLDERS_DEEP:
                raise StoreError(f"{top}: folders more than {_MOST_FOLDERS_DEEP} deep, which no array has")
            links = [name for name in folders if os.path.islink(os.path.join(folder, name))]
            paths.update(f"{inside}/{name}".lstrip("/") for name in (*names, *links))
        return paths


def plain_file(root: str, key: str) -> os.stat_result | None:
    """Return the state of a plain file at ``key`` inside a store's folder ``root``; None where there is none.

    The folder itself may be reached through links. StoreError where the path leaves the store, passes through
    a link, or ends in something that is no plain file: a store holds files and folders only.
    """
    parts = key.split("/")
    if any(part in ("", ".", "..") or "\\" in part or "\0" in part for part in parts):
        raise StoreError(f"{root}: {key!r:.200} is no path inside a store")
    place = root
    status: os.stat_result | None = None
    for part in parts:
        place = f"{place}/{part}"
        try:
            status = os.lstat(place)
        except (FileNotFoundError, NotADirectoryError):
            return None
        except OSError as error:
            raise StoreError(f"{place:.200} cannot be read: {error.strerror}") from error
        if stat.S_ISLNK(status.st_mode):
            raise StoreError(f"{place} is a link; a store holds plain files and folders")
    if status is None or stat.S_ISDIR(status.st_mode):
        return None
    if not stat.S_ISREG(status.st_mode):
        raise StoreError(
            f"{place} is no plain file, but a pipe or a device; a store holds plain files and folders"
        )
    return status


#: Names of half-written metadata, ours and zarr's.
_TEMPORARY = re.compile(r"\.zarr\.json\.[0-9a-f]{1,32}|zarr\.[0-9a-f]{32}\.partial")


def is_temporary(name: str) -> bool:
    """Tell whether a file is one that a killed writer left half-written in a group's folder.

    Examples
    --------
    >>> is_temporary(".zarr.json.4711"), is_temporary("notes.partial")
    (True, False)
    """
    return _TEMPORARY.fullmatch(name) is not None


def replace_file(path: Path, parts: Sequence[bytes], *, durable: bool) -> None:
    """Write a file so that it is there whole or not at all; ``durable``: even after a power failure.

    Otherwise the kernel begins to write it to the disk, and is not waited for.
    """
    # a scheduler may run a task twice at once: each writes its own file, the last rename stands
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}")
    try:
        with open(temporary, "wb") as file:
            file.writelines(parts)
            file.flush()
            if durable:
                os.fsync(file.fileno())
            elif hasattr(os, "posix_fadvise"):
                # Linux starts to write what will not be needed; what is on its way stays in memory
                os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
        os.replace(temporary, path)
    except OSError:  # on a full disk its room is needed
        temporary.unlink(missing_ok=True)
        raise
    if durable:
        sync(path.parent)


def sync(path: str | Path) -> None:
    """Make a file, or renames in a folder, outlive a power failure."""
    if os.name != "posix" and os.path.isdir(path):
        return
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
