"""What a store's root says: the attributes of groups without variables, and the list of all metadata.

Plain `xarray.open_zarr` reads the metadata of every group from the root's list; our readers ask each group.
"""

from __future__ import annotations

import contextlib
import json
import warnings
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from hyperpaint.base.errors import IncompleteStoreError
from hyperpaint.base.schema import FORMAT_VERSION

from .location import METADATA, Location, sync
from .record import ATTRIBUTES, COMPLETE, GroupRecord, metadata_checksum, read_record, sealed_attributes

VOLATILE_ATTRS = ("created", "history", "hyperpaint_version", ATTRIBUTES, COMPLETE)
"""Attributes that say when, not what: they do not make another content."""

INPUTS = "inputs_digest"
"""Attribute of what `process` writes: names the inputs and parameters. In what a user made of that it would
say so no longer, and is left out."""


def groups_above(group: str) -> list[str]:
    """Return the groups that a group is in, the root first."""
    parts = group.split("/") if group else []
    return ["/".join(parts[:depth]) for depth in range(len(parts))]


def stamped(attrs: Any, action: str) -> dict[str, Any]:
    """Return attributes with format, version, time and one more line of history."""
    import datetime

    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    line = f"{now} hyperpaint {version_of_program()}: {action}"
    return {
        **{key: value for key, value in attrs.items() if key != COMPLETE},
        "Conventions": "CF-1.11",
        "hyperpaint_format": FORMAT_VERSION,
        "hyperpaint_version": version_of_program(),
        "created": now,
        "history": "\n".join(text for text in (str(attrs.get("history", "")), line) if text),
    }


def version_of_program() -> str:
    """Return the version of hyperpaint that is running."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("hyperpaint")
    except PackageNotFoundError:
        return "unknown"


@contextlib.contextmanager
def without_known_warnings() -> Iterator[None]:
    """Silence the one known warning: consolidated metadata are not in the v3 specification."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Consolidated metadata is currently not part")
        yield


def make_groups_above(group: str, location: Location) -> None:
    """Make the groups that a group is in, where they are missing."""
    for above in groups_above(group):
        if location.metadata(above) is None:
            _write_group(above, stamped({}, "created"), location)


def has_all_chunks(location: Location, group: str, record: GroupRecord) -> bool:
    """Tell whether every chunk of a finished group has its file; none is read."""
    import itertools

    for name, array in record.arrays.items():
        present = location.files(f"{group}/{name}" if group else name)
        places = itertools.product(*map(range, array.grid))
        if not all("/".join(("c", *map(str, place))) in present for place in places):
            return False
    return True


def is_damaged(group: str, location: Location) -> bool:
    """Tell whether there is metadata of a group that cannot be read; a link or pipe there is a StoreError."""
    try:
        location.metadata(group)
    except IncompleteStoreError:
        return True
    return False


def rebuild_groups(groups: Iterable[str], location: Location) -> None:
    """Write the metadata of damaged or missing groups without arrays anew; what is in them stays."""
    for group in groups:
        _write_group(group, stamped({}, "rebuilt"), location)


def _write_group(group: str, attributes: Mapping[str, Any], location: Location) -> None:
    """Write the metadata of a group without arrays: there whole or not at all, even after a power cut."""
    if location.local is not None:
        (location.local / group).mkdir(parents=True, exist_ok=True)
    plain = json.loads(json.dumps(attributes, default=lambda value: value.tolist()))
    node = {"attributes": sealed_attributes(plain), "zarr_format": 3, "node_type": "group"}
    location.write_json(node, group, METADATA)
    if location.local is not None:
        sync((location.local / group).absolute().parent)


def unlist(group: str, location: Location) -> None:
    """Drop consolidated metadata that lists a group about to be replaced: they would describe the old one."""
    document = location.read_json("", METADATA) if group else None
    if location.local is None or document is None:
        return
    listed = (document.get("consolidated_metadata") or {}).get("metadata", {})
    if group in listed:
        del document["consolidated_metadata"]
        location.write_json(document, METADATA)


def finish_root(attrs: Mapping[str, dict[str, Any]], location: Location) -> None:
    """Set the attributes of groups without variables (by group), then list all metadata in the root."""
    for group, wanted in attrs.items():
        make_groups_above(group, location)
        node = location.metadata(group)
        if node is None or not _has_attrs(node, wanted):
            stored = (node or {}).get("attributes", {})
            _write_group(group, {**stored, **stamped({**stored, **_plain(wanted)}, "to_store")}, location)
    location.write_json(_consolidated(location), METADATA)


def _consolidated(location: Location) -> dict[str, Any]:
    """Return the root's metadata with those of all nodes in it.

    zarr does it, to a copy of the metadata in memory: what it writes to a disk itself a power cut could tear.
    """
    import zarr
    from zarr.core.buffer import default_buffer_prototype

    copied: dict[str, Any] = {}
    pending = [""]
    while pending:
        path = pending.pop()
        document = location.metadata(path)
        if document is None:
            continue
        raw = json.dumps(document).encode()
        copied[f"{path}/{METADATA}".lstrip("/")] = default_buffer_prototype().buffer.from_bytes(raw)
        if document.get("node_type") == "group":
            pending += [f"{path}/{child}".lstrip("/") for child in location.folders(path)]
    with without_known_warnings():
        zarr.consolidate_metadata(zarr.storage.MemoryStore(copied), zarr_format=3)
    return dict(json.loads(copied[METADATA].to_bytes()))


def _plain(attrs: dict[str, Any]) -> dict[str, Any]:
    """Return attributes as JSON holds them."""
    import numpy as np

    return {
        key: value.tolist() if isinstance(value, np.ndarray | np.generic) else value
        for key, value in attrs.items()
    }


def _has_attrs(node: dict[str, Any], wanted: dict[str, Any]) -> bool:
    stored = node.get("attributes", {})
    return all(
        key in stored and stored[key] == value
        for key, value in _plain(wanted).items()
        if key not in VOLATILE_ATTRS
    )


def is_listed(groups: Iterable[str], attrs: Mapping[str, dict[str, Any]], location: Location) -> bool:
    """Tell whether the root's consolidated metadata and attributes are up to date."""
    root = location.read_json("", METADATA) or {}
    listed = (root.get("consolidated_metadata") or {}).get("metadata", {})
    for group, wanted in attrs.items():
        node = location.metadata(group)
        if node is None or not _has_attrs(node, wanted) or (group and group not in listed):
            return False
    return all(_lists(listed, group, read_record(location, group)) for group in groups)


def _lists(listed: dict[str, Any], group: str, record: GroupRecord | None) -> bool:
    if record is None:
        return False
    prefix = f"{group}/" if group else ""
    return all(
        name in listed and metadata_checksum(listed[name]) == array.metadata
        for name, array in ((prefix + key, array) for key, array in record.arrays.items())
    )
