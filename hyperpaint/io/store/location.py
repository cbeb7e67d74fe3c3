"""Where a store lies: a local folder, or a URL of fsspec."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hyperpaint.errors import IncompleteStoreError, StoreError

__all__ = ["METADATA", "Location", "clean_group", "replace_file", "sync_folder"]

METADATA = "zarr.json"

#: A metadata document larger than this is not metadata of ours (a collect of 60 lines has 2 MB).
_LARGEST_JSON = 256 * 2**20


def clean_group(group: str | None) -> str:
    """Return a group's path without leading or trailing slashes; the root is ``""``.

    Raises
    ------
    StoreError
        The path leaves the store, or a part of it cannot be a group's name.
    """
    parts = [part for part in (group or "").split("/") if part]
    if any(part.startswith((".", "__")) or part == METADATA or "\\" in part for part in parts):
        msg = f"group {group!r}: expected names without a leading '.' or '__' between slashes"
        raise StoreError(msg)
    return "/".join(parts)


@dataclass(frozen=True)
class Location:
    """A store's place.

    Attributes
    ----------
    url
        What zarr and xarray open.
    root
        Path inside the file system ``fs``.
    local
        The folder, where the store is on a local disk.
    """

    url: str
    root: str
    fs: Any
    local: Path | None

    @classmethod
    def of(cls, path: str | os.PathLike[str]) -> Location:
        """Return the place named by a path or a URL."""
        from fsspec.core import url_to_fs  # type: ignore[import-untyped]

        text = os.fspath(path)
        fs, root = url_to_fs(text)
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

    def read(self, group: str, *parts: str) -> bytes | None:
        """Return a small file's bytes; None where there is no such file."""
        key = self.key(group, *parts)
        try:
            if self.fs.size(key) > _LARGEST_JSON:
                msg = f"{key} is larger than {_LARGEST_JSON} bytes, which no metadata of a store is"
                raise IncompleteStoreError(msg)
            return bytes(self.fs.cat_file(key))
        except (FileNotFoundError, IsADirectoryError, NotADirectoryError):
            return None

    def read_json(self, group: str, *parts: str) -> dict[str, Any] | None:
        """Return a JSON object; None where there is no such file.

        Raises
        ------
        IncompleteStoreError
            The file is not a JSON object.
        """
        raw = self.read(group, *parts)
        if raw is None:
            return None
        try:
            document = json.loads(raw)
        except (ValueError, RecursionError) as error:
            msg = f"{self.key(group, *parts)} is damaged: {type(error).__name__}: {error}"
            raise IncompleteStoreError(msg) from None
        if not isinstance(document, dict):
            kind = type(document).__name__
            msg = f"{self.key(group, *parts)} is damaged: expected a JSON object, found {kind}"
            raise IncompleteStoreError(msg)
        return document

    def metadata(self, group: str, *parts: str) -> dict[str, Any] | None:
        """Return the ``zarr.json`` of a node without consolidated metadata; None where there is no node."""
        document = self.read_json(group, *parts, METADATA)
        if document is not None:
            document.pop("consolidated_metadata", None)
        return document

    def write_json(self, document: dict[str, Any], *parts: str) -> None:
        """Write a JSON object, on a local disk so that it is there whole or not at all."""
        content = json.dumps(document).encode()
        if self.local is None:
            self.fs.pipe_file(self.key(*parts), content)
        else:
            replace_file(self.local.joinpath(*parts), content)

    def groups(self) -> list[str]:
        """Return every group that holds arrays, sorted; unreadable nodes are passed over."""
        found: set[str] = set()
        pending = [""]
        while pending:
            group = pending.pop()
            for child in self.folders(group):
                path = f"{group}/{child}" if group else child
                node = self._node_type(path)
                if node == "group":
                    pending.append(path)
                elif node == "array":
                    found.add(group)
        return sorted(found)

    def subgroups(self, group: str) -> list[str]:
        """Return the names of the groups right below a group."""
        return [
            child
            for child in self.folders(group)
            if self._node_type(f"{group}/{child}" if group else child) == "group"
        ]

    def folders(self, group: str) -> list[str]:
        """Return the names of the folders in a group."""
        try:
            entries = self.fs.ls(self.key(group), detail=True)
        except (FileNotFoundError, NotADirectoryError):
            return []
        return [
            entry["name"].rstrip("/").rsplit("/", 1)[-1] for entry in entries if entry["type"] == "directory"
        ]

    def _node_type(self, path: str) -> str | None:
        try:
            document = self.read_json(path, METADATA)
        except IncompleteStoreError:
            return None
        return None if document is None else str(document.get("node_type"))


def replace_file(path: Path, content: bytes) -> None:
    """Write a file so that it is there whole or not at all, even after a power failure."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    with open(temporary, "wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    os.replace(temporary, path)
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Make renames in a folder outlive a power failure."""
    if os.name != "posix":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
