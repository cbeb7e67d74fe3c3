"""The manifest of a store: its groups, their contents, and checksums of their files.

It is stored in the attributes of the group ``hyperpaint`` in the root, a Zarr group without arrays, and is
written last. For every group it records

* ``content``: path, inputs and settings, equal to the group's attribute `CONTENT`;
* ``metadata``: the crc32c of its ``zarr.json``, parsed as JSON, and those of its arrays;
* for every array the number of its chunks, and a digest over their keys and their crc32c.

A writer first records the groups that it will publish (`Write`), so that a store whose writer was killed is
recognised as unfinished. Groups and arrays of other programs are not in the manifest.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from itertools import product
from shlex import join, split
from typing import Any, NamedTuple

from hyperpaint.base.constants import NUMERICS_VERSION
from hyperpaint.base.errors import IncompleteStoreError, Problem, StoreError
from hyperpaint.base.schema import FORMAT_VERSION

from .budget import counted
from .location import MANIFEST_NODE, METADATA, Location, clean_group, joined

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
    """Groups that an unfinished writer will publish."""

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
    def from_document(cls, document: Mapping[str, Any], where: str) -> Manifest:
        # Return the manifest in a ``zarr.json``; `IncompleteStoreError` if it is damaged or newer.
        try:
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
            invalid = [name for name in group_names if clean_group(name) != name]
            invalid += [name for name in arrays if "/" in name or clean_group(f"g/{name}") != f"g/{name}"]
            invalid += [name for name in (*group_names, *arrays) if "\0" in name or len(name.encode()) > 1000]
            if invalid:
                raise ValueError(f"invalid name {invalid[0]!r:.40}")
            if len(writes) > MAX_WRITES:
                raise ValueError(f"{len(writes)} writes have not ended")
            return cls(groups, writes, str(content["command"]))
        except (ValueError, KeyError, TypeError, IndexError, AttributeError, StoreError) as error:
            raise IncompleteStoreError(
                f"the manifest {where} is damaged ({error!s:.100})",
                mend="write all groups of the store with overwrite=True",
                option="run its command again with --overwrite; complete groups stay",
                code="manifest-damaged",
            ) from None

    @classmethod
    def read(cls, location: Location, *, ignore_damage: bool = False) -> Manifest | None:
        # Return the manifest of a store, None if it has none, or a damaged one with ``ignore_damage``.
        where = location.key(MANIFEST_NODE, METADATA)
        try:
            document = location.read_json(MANIFEST_NODE, METADATA)
            return None if document is None else cls.from_document(document, where)
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

    def settled(self, location: Location) -> Manifest:
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
    if entry is not None and attributes_replaced(location, group, entry):
        return entry.content
    return str(location.attributes(group).get(CONTENT, ""))


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
    try:
        chunk = document["chunk_grid"]["configuration"]["chunk_shape"]
        grid = [-(-int(size) // int(step)) for size, step in zip(document["shape"], chunk, strict=True)]
        if 0 <= math.prod(grid) <= MAX_CHUNKS:
            return ["/".join(("c", *map(str, position))) for position in product(*map(range, grid))]
    except (LookupError, TypeError, ValueError, ArithmeticError):
        pass
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
