"""The manifest of a store: its groups, their contents, and checksums of their files.

It is stored in the attributes of the group ``hyperpaint`` in the root, a Zarr group without arrays, and is
written last. For every group it records

* ``content``: path, inputs and settings, equal to the group's attribute `CONTENT`;
* ``metadata``: the crc32c of its ``zarr.json``, parsed as JSON, and those of its arrays;
* for every array the number of its chunks, and a digest over their keys and their crc32c.

A writer first records the groups that it will publish (`Write`), so that a store whose writer was killed is
recognised as unfinished. Groups and arrays of other programs are not in the manifest.

The location of a store: a local folder, a zip file, a URL of fsspec, or a store object of zarr.
"""

import contextlib
import functools
import hashlib
import json
import math
import os
import re
import stat
import uuid
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from shlex import join, split
from typing import Any, NamedTuple

from hyperpaint.base import (
    CHAINED_MEND,
    FORMAT_VERSION,
    NUMERICS_VERSION,
    FormatError,
    IncompleteStoreError,
    Problem,
    StoreError,
    file_system,
)

from .budget import counted

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


def _json_object(raw: bytes, where: str) -> dict[str, Any]:
    IncompleteStoreError.raise_if(
        len(raw) > 2**20 and sum(map(raw.count, (b"{", b"[", b","))) > MAX_VALUES,
        f"{where} has more than {MAX_VALUES} values",
        code="file-too-large",
    )
    with IncompleteStoreError.instead_of(
        (ValueError, RecursionError), f"{where} is damaged: $error", code="metadata-damaged"
    ):
        document: dict[str, Any] = json.loads(raw)
    IncompleteStoreError.raise_if(
        not isinstance(document, dict),
        f"{where} is damaged",
        expected="a JSON object",
        code="metadata-damaged",
    )
    return document


@dataclass(frozen=True)
class Location:
    # Location of a store; metadata and chunks are read and written by their keys.
    url: str  # Argument for zarr and xarray
    root: str  # Path inside the file system ``fs``
    fs: Any
    local: Path | None  # Folder of a store on a local disk; else None

    @classmethod
    def of(cls, path: str | os.PathLike[str]) -> "Location":
        # Return the location for a path or a URL.
        #
        # Raises `MissingExtraError`: The package for this kind of URL is not installed.
        # Raises `StoreError`: The kind of URL is unknown, or it cannot be opened.
        with StoreError.instead_of(
            TypeError,
            f"store given as {type(path).__name__}",
            expected="a folder or URL",
            mend="open it by open_store(store, group) or xarray.open_zarr(store, group=group)",
            code="type-wrong",
        ):
            text = os.fspath(path)
        if "::" in text or "\0" in text:
            # a chained URL can start a cluster (dask::), or copy or unpack files
            kind = "a chained URL" if "::" in text else "a name with a NUL character"
            raise StoreError(
                f"{text!r:.200}: {kind}",
                expected="a folder or a plain URL",
                mend=CHAINED_MEND if "::" in text else "check the path",
                code="path-not-plain",
            )
        with StoreError.instead_of(
            FormatError,
            f"{text:.200} cannot be opened: $error",
            expected="a folder, or a URL that fsspec knows",
            code="url-unusable",
        ):
            fs, root = file_system(text)
        if "file" in (fs.protocol if isinstance(fs.protocol, tuple) else (fs.protocol,)):
            folder = Path(root)
            return cls(str(folder), str(folder), fs, folder)
        return cls(text.rstrip("/"), str(root).rstrip("/"), fs, None)

    def key(self, *parts: str) -> str:
        return joined(self.root, *parts)

    def has(self, *parts: str) -> bool:
        return (
            os.path.exists(self.key(*parts))
            if self.local is not None
            else bool(self.fs.exists(self.key(*parts)))
        )

    def read(self, *parts: str, limit: int | None = MAX_METADATA_BYTES) -> bytes | None:
        # Return a file's bytes, None if there is no file. `StoreError` above ``limit`` bytes.
        key = self.key(*parts)
        try:
            if self.local is not None:
                mode = os.stat(key).st_mode
                IncompleteStoreError.raise_if(
                    not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)),
                    f"{key:.200} is not a regular file",
                    code="file-not-plain",
                )
            size = os.path.getsize(key) if self.local is not None else self.fs.size(key)
            IncompleteStoreError.raise_if(
                limit is not None and size > limit,
                f"{key} has {size} bytes",
                expected=f"metadata of at most {limit}",
                code="file-too-large",
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
        with IncompleteStoreError.instead_of(
            OSError,
            f"the chunk {key} is missing or empty",
            mend="write the group again",
            code="chunk-missing",
        ):
            if self.local is None:
                return bytes(self.fs.tail(key, 4))
            with open(key, "rb") as file:
                file.seek(-4, os.SEEK_END)
                return file.read()

    def read_json(self, *parts: str) -> dict[str, Any] | None:
        # Return a JSON object, None if there is no file; IncompleteStoreError for a damaged one.
        raw = self.read(*parts)
        return None if raw is None else _json_object(raw, self.key(*parts))

    def metadata(self, path: str) -> dict[str, Any] | None:
        # Return the ``zarr.json`` of a node without consolidated metadata, None if there is no node.
        document = self.read_json(path, METADATA)
        if document is not None:
            document.pop("consolidated_metadata", None)
            IncompleteStoreError.raise_if(
                not isinstance(document.get("attributes", {}), dict),
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
            # every server has its own errors
            try:
                self.fs.pipe_file(self.key(*parts), content)
            except OSError:
                raise
            except Exception as error:
                raise StoreError(
                    f"{self.url} cannot be written: {type(error).__name__}: {error!s:.200}",
                    mend="check that the server takes files, and the credentials",
                    code="file-unwritable",
                ) from error
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
    if os.name == "posix" or not os.path.isdir(path):
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


# --- manifests ---------------------------------------------------------------------------------------------

# Attribute of a group: its path, inputs and settings.
CONTENT = "hyperpaint_content"

# Attribute of a group: number of its arrays and digest over their entries, written before the manifest.
SEAL = "hyperpaint_seal"

# Attribute of groups of `process`: digest of inputs and parameters. Datasets that a user derives from them
# are stored without it.
INPUTS = "inputs_digest"

# Attribute of a dataset that a run will store: the settings of the run.
SETTINGS = "hyperpaint_settings"

# Attributes of a stored group that are not valid for datasets derived from it.
OWN_ATTRS = (
    CONTENT,
    SEAL,
    SETTINGS,
    "hyperpaint_complete",
    "hyperpaint_attributes",
    "hyperpaint_set",
    "hyperpaint_group",  # format 2 and 1
)

# File of checksums in an array's folder in formats 1 and 2.
OLD_RECORD = "hyperpaint-chunks.json"

# Maximum number of unfinished writes, one per killed writer.
MAX_WRITES = 100

# Maximum number of chunks of an array: 32 million lines.
MAX_CHUNKS = 1_000_000

MAX_MESSAGES = 20
MAX_MESSAGE_CHARS = 2000

_COMMAND = re.compile(r"hyperpaint (process|render|run) ")
_NUMERICS = re.compile(r"\bnumerics=(\d{1,9})\b")


class ArrayEntry(NamedTuple):
    metadata: int  # crc32c of its ``zarr.json``
    chunks: int
    digest: str  # See `chunk_digest`


class GroupEntry(NamedTuple):
    # Entry of one group; a parent of groups has an empty content and no arrays.
    content: str
    metadata: int  # crc32c of its ``zarr.json``
    arrays: Mapping[str, ArrayEntry]
    # Of a group with arrays: recorded, since xarray replaces them when it adds an array
    attributes: Mapping[str, Any] = {}


class Write(NamedTuple):
    # Groups that an unfinished writer will publish.
    contents: Mapping[str, str]  # By group
    command: str = ""  # Command line of the run, with ``{store}`` for the store's path

    @property
    def source(self) -> list[str]:
        # First three words of the command: program, subcommand and input of the store.
        try:
            return split(self.command)[:3]
        except ValueError:  # unbalanced quotes: not of hyperpaint
            return [self.command]


@dataclass(frozen=True)
class Manifest:
    # The groups of a store, by path, and its unfinished writes.
    groups: Mapping[str, GroupEntry] = field(default_factory=dict)
    writes: tuple[Write, ...] = ()
    command: str = ""  # Of the last run, which made the store

    def document(self) -> dict[str, Any]:
        content = json.loads(
            json.dumps({"groups": self.groups, "writes": self.writes, "command": self.command})
        )
        return {
            "zarr_format": 3,
            "node_type": "group",
            "attributes": {
                "hyperpaint_format": FORMAT_VERSION,
                "crc32c": document_checksum(content),
                "manifest": content,
            },
        }

    @classmethod
    def from_document(cls, document: Mapping[str, Any], where: str) -> "Manifest":
        # Return the manifest in a ``zarr.json``; `IncompleteStoreError` if it is damaged or newer.
        with IncompleteStoreError.instead_of(
            (ValueError, KeyError, TypeError, IndexError, AttributeError, StoreError),
            f"the manifest {where} is damaged ($error)",
            mend="write all groups of the store with overwrite=True",
            option="run its command again with --overwrite; complete groups stay",
            code="manifest-damaged",
        ):
            attributes = document["attributes"]
            version, content = attributes["hyperpaint_format"], attributes["manifest"]
            if version != FORMAT_VERSION:
                raise ValueError(f"format {version!r:.20}, expected {FORMAT_VERSION}; update hyperpaint")
            if document_checksum(content) != attributes["crc32c"] or document.get("zarr_format") != 3:
                raise ValueError("its checksum differs")
            groups = {
                path: GroupEntry(str(text), crc, {n: ArrayEntry(*a) for n, a in arrays.items()}, dict(attrs))
                for path, (text, crc, arrays, attrs) in content["groups"].items()
            }
            writes = tuple(
                Write({name: str(content_name) for name, content_name in names.items()}, str(command))
                for names, command in content["writes"]
            )
            # raise for names of paths outside the store
            group_names = {*groups, *(name for write in writes for name in write.contents)}
            arrays = {name for entry in groups.values() for name in entry.arrays}
            invalid = [
                *(name for name in group_names if clean_group(name) != name),
                *(name for name in arrays if "/" in name or clean_group(f"g/{name}") != f"g/{name}"),
                *(name for name in (*group_names, *arrays) if "\0" in name or len(name.encode()) > 1000),
            ]
            if invalid:
                raise ValueError(f"invalid name {invalid[0]!r:.40}")
            if len(writes) > MAX_WRITES:
                raise ValueError(f"{len(writes)} writes have not ended")
            return cls(groups, writes, str(content["command"]))

    @classmethod
    def read(cls, location: Location, *, ignore_damage: bool = False) -> "Manifest | None":
        # Return the manifest of a store, None if it has none, or a damaged one with ``ignore_damage``.
        where = location.key(MANIFEST_NODE, METADATA)
        try:
            raw = location.read(MANIFEST_NODE, METADATA)
            return None if raw is None else _parsed(raw, where)
        except IncompleteStoreError:
            if ignore_damage:
                return None
            raise

    def write(self, location: Location) -> None:
        location.write_json(self.document(), MANIFEST_NODE, METADATA)

    def allowed(self, group: str) -> set[str]:
        # Return the valid contents of a group: that of its entry, and those of unfinished writes.
        contents = {write.contents[group] for write in self.writes if group in write.contents}
        return (contents | ({self.groups[group].content} if group in self.groups else set())) - {""}

    def lacking(self, write: Write, contents: Callable[[str], str]) -> list[str]:
        # Return the groups that an unfinished write has not published.
        #
        # ``contents``: function that returns the stored content of a group. Empty if all groups are published
        # or unchanged, and for a write of one group.
        lacking = [name for name, content in write.contents.items() if contents(name) != content]
        is_unchanged = all(
            name in self.groups and contents(name) == self.groups[name].content for name in write.contents
        )
        return [] if is_unchanged or len(write.contents) == 1 else lacking

    def settled(self, location: Location) -> "Manifest":
        # Return the manifest without the writes that are finished or changed nothing.
        #
        # Entries of groups that such a write has published are computed from the files.
        contents = functools.cache(lambda name: content_of(location, name, self))
        groups, writes = dict(self.groups), []
        for write in self.writes:
            if self.lacking(write, contents):
                writes.append(write)
                continue
            for name, content in write.contents.items():
                if contents(name) == content:
                    with contextlib.suppress(IncompleteStoreError):  # the group will be written again
                        groups[name] = entry_of(location, name)
        return replace(self, groups=groups, writes=tuple(writes))


@functools.lru_cache(maxsize=4)
def _parsed(raw: bytes, where: str) -> Manifest:
    # Opening every group of a store reads its manifest, which lists all groups.
    return Manifest.from_document(_json_object(raw, where), where)


@dataclass(frozen=True)
class StoreState:
    # Differences of the groups of a store from its manifest.
    faults: tuple[Problem, ...] = ()
    notes: tuple[str, ...] = ()
    resume: str = ""  # Command that finishes the store, empty if unknown

    @property
    def problems(self) -> tuple[str, ...]:
        # The faults as lines of text.
        return tuple(map(str, self.faults))


def store_state(location: Location, groups: Iterable[str] | None = None) -> StoreState:
    # Compare the manifest of a store with its groups; ``groups``: groups with arrays, by default listed.
    present = list(location.groups() if groups is None else groups)
    try:
        manifest = Manifest.read(location)
    except IncompleteStoreError as error:
        return StoreState((error.problem,))
    contents = functools.cache(lambda name: content_of(location, name, manifest))
    if manifest is None:
        if any(contents(name).startswith(f"/{name} ") for name in present):
            lost = Problem(
                f"the manifest of {location.url}, the group {MANIFEST_NODE!r} of its root, is missing",
                mend="run the command that wrote the store again; complete groups stay",
                code="manifest-lost",
            )
            return StoreState((lost,))
        origins = {
            "copied from a store of hyperpaint, without its manifest": map(contents, present),
            "written by hyperpaint 0.2 or older, without a manifest": (
                "hyperpaint_complete" in location.attributes(name) for name in present
            ),
        }
        origin = next((text for text, signs in origins.items() if any(signs)), "not written by hyperpaint")
        lost_text = "missing or exchanged groups and chunks cannot be detected; all chunks were read"
        return StoreState((), (f"{origin}: {lost_text}",))
    faults: list[Problem] = []
    notes, resume = [], ""
    # unfinished writes
    for write in manifest.writes:
        if not (lacking := manifest.lacking(write, contents)):
            continue
        plain = _COMMAND.match(write.command) and write.command.isprintable()
        if plain and len(write.command) <= MAX_MESSAGE_CHARS // 2:
            with contextlib.suppress(ValueError):  # unbalanced quotes
                resume = join(location.url if word == "{store}" else word for word in split(write.command))
        progress = (
            f"{len(write.contents) - len(lacking)} of {counted(len(write.contents), 'group')} are written"
        )
        missing_names = ", ".join(f"/{name}" for name in lacking[:5]) + (" ..." if len(lacking) > 5 else "")
        mend = f"to finish it: {resume}" if resume else "run its writer again"
        faults.append(
            Problem(f"unfinished: {progress}, without {missing_names}", mend=mend, code="store-unfinished")
        )
    # groups that differ from the manifest
    mend = "write it again" + (", or run its command with --overwrite" if manifest.command else "")
    for name, entry in manifest.groups.items():
        # an unfinished write may be changing its groups: those are not faults
        if (
            entry.content
            and contents(name) not in manifest.allowed(name)
            and not any(
                name in write.contents and (len(write.contents) > 1 or location.has(name, METADATA))
                for write in manifest.writes
            )
        ):
            faults.append(
                Problem(
                    f"/{name}: changed: its content differs from the manifest",
                    mend=mend,
                    code="group-changed",
                )
                if location.has(name, METADATA)
                else Problem(f"/{name}: deleted", mend=mend, code="group-deleted")
            )
    notes += [
        f"/{name}: added by another program, not in the manifest"
        for name in present
        if not manifest.allowed(name)
    ]
    versions = {numerics_of(entry.content) for entry in manifest.groups.values()} - {None, NUMERICS_VERSION}
    notes += [
        f"made by numerics {version}, this is {NUMERICS_VERSION}: --overwrite computes it again"
        for version in sorted(filter(None, versions))
    ]
    # limit the length, and replace unprintable characters of group names
    shown = [
        replace(
            fault,
            found="".join(c if c.isprintable() else "\ufffd" for c in fault.found[:MAX_MESSAGE_CHARS]),
        )
        for fault in faults[:MAX_MESSAGES]
    ]
    if len(faults) > MAX_MESSAGES:
        shown.append(Problem(counted(len(faults) - MAX_MESSAGES, "more problem"), code="problems-omitted"))
    return StoreState(tuple(shown), tuple(notes), resume)


def check_state(location: Location) -> None:
    # Raise IncompleteStoreError if a store is unfinished, or its groups differ from its manifest.
    if faults := store_state(location).faults:
        raise IncompleteStoreError(
            f"{location.url} is incomplete; hyperpaint.io.store.open_group(path, group) opens other groups",
            problems=faults,
        )


# --- state of the disk -------------------------------------------------------------------------------------


def content_text(group: str, identity: str, settings: str = "") -> str:
    return " ".join(part for part in (f"/{group}", identity, settings) if part)


def content_of(location: Location, group: str, manifest: Manifest | None = None) -> str:
    # Return the content of a group as in its attribute, empty if it has none.
    #
    # ``manifest``: gives the content of a group whose attributes another program replaced.
    entry = manifest.groups.get(group) if manifest is not None else None
    return (
        entry.content
        if entry is not None and attributes_replaced(location, group, entry)
        else str(location.attributes(group).get(CONTENT, ""))
    )


def attributes_replaced(location: Location, group: str, entry: GroupEntry) -> bool:
    # Return whether another program replaced all attributes of a group, as ``to_zarr(mode="a")`` does.
    #
    # In a damaged file `CONTENT` or its value would remain.
    try:
        attributes = (location.metadata(group) or {}).get("attributes")
        if attributes is None or CONTENT in attributes or entry.content in attributes.values():
            return False
        documents = {name: location.metadata(joined(group, name)) for name in entry.arrays}
    except StoreError:
        return False
    # the arrays are unchanged: otherwise another program wrote a new group
    return bool(documents) and all(
        document_checksum(documents[name]) == array.metadata for name, array in entry.arrays.items()
    )


def changed_attributes(location: Location, group: str, entry: GroupEntry) -> list[str]:
    # Return the attributes of a group that changed since it was written; new attributes are ignored.
    document = location.metadata(group) or {}
    attributes = document.get("attributes", {})
    changed = [key for key, value in entry.attributes.items() if attributes.get(key) != value]
    recorded = document if not entry.arrays else {**document, "attributes": dict(entry.attributes)}
    return changed or ([] if document_checksum(recorded) == entry.metadata else ["its metadata"])


def numerics_of(content: str) -> int | None:
    # Return the version of the numerics in a content or settings text, None if it has none.
    match = _NUMERICS.search(content)
    return None if match is None else int(match[1])


def document_checksum(document: Any) -> int:
    # Return the crc32c of a JSON value, independent of spacing and of the order of keys.
    import google_crc32c

    return int(google_crc32c.value(json.dumps(document, sort_keys=True).encode()))


def chunk_digest(group: str, name: str, chunks: Iterable[tuple[str, bytes]]) -> str:
    # Return the digest over the keys of an array's chunks and their last 4 bytes, the crc32c.
    digest = hashlib.blake2b(f"/{group}/{name}".encode(), digest_size=16)
    for key, checksum in chunks:
        digest.update(key.encode() + b"\0" + checksum)
    return digest.hexdigest()


def chunk_keys(document: Mapping[str, Any], name: str) -> list[str]:
    # Return the keys of an array's chunks, in C order, from its ``zarr.json``.
    #
    # Raises `IncompleteStoreError`: The grid is missing, or has more than `MAX_CHUNKS` chunks.
    with contextlib.suppress(LookupError, TypeError, ValueError, ArithmeticError):
        chunk = document["chunk_grid"]["configuration"]["chunk_shape"]
        grid = [-(-int(size) // int(step)) for size, step in zip(document["shape"], chunk, strict=True)]
        if 0 <= math.prod(grid) <= MAX_CHUNKS:
            return ["/".join(("c", *map(str, position))) for position in product(*map(range, grid))]
    raise IncompleteStoreError(
        f"{name}: chunk grid missing or too large",
        expected=f"at most {MAX_CHUNKS} chunks",
        mend="write the group again",
        code="metadata-damaged",
    )


def seal_of(arrays: Mapping[str, ArrayEntry]) -> str:
    # Return the number of a group's arrays, and the digest over their entries.
    text = json.dumps(sorted(arrays.items()))
    return f"{len(arrays)} {hashlib.blake2b(text.encode(), digest_size=16).hexdigest()}"


def entry_of(location: Location, group: str) -> GroupEntry:
    # Return the entry of a group from its files, without arrays whose chunks have no crc32c.
    #
    # Raises `IncompleteStoreError`: Chunks are missing, or the digest over the arrays differs from `SEAL`.
    entries = {}
    for name in location.folders(group):
        document = location.metadata(joined(group, name)) or {}
        # arrays of other programs have no crc32c
        if document.get("node_type") == "array" and "crc32c" in str(document.get("codecs"))[-40:]:
            keys = chunk_keys(document, joined(group, name))
            entries[name] = ArrayEntry(
                document_checksum(document),
                len(keys),
                chunk_digest(group, name, [(key, location.end_of(group, name, key)) for key in keys]),
            )
    metadata = location.metadata(group) or {}
    attributes = metadata.get("attributes", {}) if entries else {}
    IncompleteStoreError.raise_if(
        attributes.get(SEAL, seal_of(entries)) != seal_of(entries),
        f"the arrays of {joined(location.url, group)} differ from those that were written",
        mend="write the group again",
        code="group-changed",
    )
    return GroupEntry(content_of(location, group), document_checksum(metadata), entries, attributes)
