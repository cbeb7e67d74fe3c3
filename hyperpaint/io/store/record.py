"""The completion record of a group: what was stored, with a checksum for every chunk.

Two parts. Every array has a file in its own folder with the checksums of its chunks (in an array's folder,
since `zarr` warns of any file it does not know in a group's). The group has the attribute
``hyperpaint_complete``, written last: the seal over all those files.

Attributes travel with a Dataset into whatever is computed from it. The seal is therefore worth nothing
without the files it seals: a half-written copy made by another program carries it, and is refused. Tools that
copy files (cp, rsync, object-store sync) carry both.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from hyperpaint.base.errors import IncompleteStoreError, StoreError
from hyperpaint.base.schema import FORMAT_VERSION

from .documents import ChunkForm, check_node
from .location import Location

if TYPE_CHECKING:
    import numpy as np

CHUNKS = "hyperpaint-chunks.json"
"""File in an array's folder."""

COMPLETE = "hyperpaint_complete"
"""Attribute of a finished group."""

ATTRIBUTES = "hyperpaint_attributes"
"""Attribute of a group without arrays, which has no completion record: the checksum of the others."""

SET = "hyperpaint_set"
"""Attribute of a root: the groups that the store is to hold. It has a checksum of its own, and is in no
other."""

PLACE = "hyperpaint_group"
"""Attribute of a group: its path, with a slash before it."""

SETTINGS = "hyperpaint_settings"
"""Attribute of a group that a run of several groups made: names the run's settings."""

OWN_ATTRS = (ATTRIBUTES, COMPLETE, SET, PLACE, SETTINGS)
"""Attributes that the writer gives a group: what a dataset brings along of them is of another."""

_MOST_DIMS = 32
SEAL = re.compile(r"token=([0-9A-Za-z_-]{1,64}) chunks=([0-9a-f]{8}) attributes=([0-9a-f]{8})")


@dataclass(frozen=True)
class ArrayRecord:
    """One array of a group."""

    metadata: int  # Checksum of its ``zarr.json``
    grid: tuple[int, ...]  # Number of chunks along each dim
    # crc32c of the decoded samples of every chunk, little-endian, in C order of the grid; what an edge chunk
    # holds beyond the array does not count
    chunks: tuple[int, ...]
    version: int = FORMAT_VERSION  # Of the layout with which it was written

    def to_document(self) -> dict[str, Any]:
        """Return the content of the array's file."""
        return {
            "hyperpaint_format": self.version,
            "metadata": self.metadata,
            "grid": list(self.grid),
            "crc32c": list(self.chunks),
        }

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> ArrayRecord:
        """Return the record that a parsed file holds; any of four errors where it holds none."""
        version = int(document["hyperpaint_format"])
        if version > FORMAT_VERSION:
            raise ValueError(f"format {version} is newer than {FORMAT_VERSION}; update hyperpaint")
        record = cls(document["metadata"], tuple(document["grid"]), tuple(document["crc32c"]), version)
        if len(record.grid) > _MOST_DIMS or not all(
            type(number) is int and 0 <= number < 2**32
            for number in (record.metadata, *record.grid, *record.chunks)
        ):
            raise ValueError("expected whole numbers below 2**32")
        if math.prod(record.grid) != len(record.chunks):
            raise ValueError(f"a grid of {record.grid} chunks has {len(record.chunks)} checksums")
        return record


@dataclass(frozen=True)
class GroupRecord:
    """The completion record of a group."""

    token: str  # Names inputs and parameters: equal tokens, equal content
    attributes: int  # Checksum of the group's attributes, the seal left out
    arrays: Mapping[str, ArrayRecord] = field(default_factory=dict)  # By name

    @property
    def digest(self) -> int:
        """Checksum over the records of all arrays."""
        return metadata_checksum(
            {name: metadata_checksum(array.to_document()) for name, array in self.arrays.items()}
        )

    @property
    def seal(self) -> str:
        """The attribute's value."""
        return f"token={self.token} chunks={self.digest:08x} attributes={self.attributes:08x}"


def read_seal(location: Location, group: str) -> str | None:
    """Return the seal of a group as it is now; None where there is none, or it cannot be read."""
    try:
        node = location.metadata(group) or {}
    except StoreError:
        return None
    seal = (node.get("attributes") or {}).get(COMPLETE)
    return None if seal is None else str(seal)


def read_record(location: Location, group: str) -> GroupRecord | None:
    """Return the completion record of a group; None where it was never finished.

    IncompleteStoreError where the record is damaged or not of this group, or arrays are missing or were
    added.
    """
    node = location.metadata(group) or {}
    seal = (node.get("attributes") or {}).get(COMPLETE)
    if seal is None:
        return None
    where = f"group {'/' + group!r} of {location.url}"
    match = SEAL.fullmatch(str(seal))
    if match is None:
        raise IncompleteStoreError(
            f"the completion record of {where} is damaged: {COMPLETE} = {seal!r:.80}; write it again"
        )
    record = GroupRecord(match[1], int(match[3], 16), _array_records(location, group, where))
    if record.digest != int(match[2], 16):
        raise IncompleteStoreError(
            f"the arrays in {where} are not all those that were stored together; write it again"
        )
    return record


def _array_records(location: Location, group: str, where: str) -> dict[str, ArrayRecord]:
    records = {}
    for name in location.folders(group):
        if location.node_type(f"{group}/{name}".lstrip("/")) == "group":
            continue
        document = location.read_json(group, name, CHUNKS)
        if document is None:
            raise IncompleteStoreError(
                f"array {name!r} in {where} has no record of its chunks: it was added, or never finished"
            )
        try:
            records[name] = ArrayRecord.from_document(document)
        except (ValueError, KeyError, TypeError, OverflowError) as error:
            raise IncompleteStoreError(
                f"the record {location.key(group, name, CHUNKS)} is damaged: {error!r}; write the group again"
            ) from None
    return records


def recorded_form(location: Location, group: str, name: str, record: ArrayRecord) -> ChunkForm:
    """Return the form of an array's chunks.

    IncompleteStoreError where its metadata are not those recorded.
    """
    document = location.metadata(group, name)
    if document is None:
        state = "is missing"
    elif metadata_checksum(document) != record.metadata:
        state = "has metadata other than recorded"
    else:
        form = check_node(document, location.key(group, name))
        if form is not None and form.grid == record.grid:
            return form
        state = f"has {form and form.grid} chunks, recorded are {record.grid}"
    where = f"array {name!r} in group {'/' + group!r} of {location.url}"
    raise IncompleteStoreError(f"{where} {state}; write the group again")


def attributes_checksum(node: Mapping[str, Any]) -> int:
    """Return the crc32c of the attributes in a group's ``zarr.json``, without the seals."""
    attributes = node.get("attributes") or {}
    return metadata_checksum({key: value for key, value in attributes.items() if key not in (COMPLETE, SET)})


def sealed_attributes(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Return the attributes of a group without arrays with their checksum among them."""
    others = {key: value for key, value in attributes.items() if key not in (ATTRIBUTES, COMPLETE)}
    checked = {key: value for key, value in others.items() if key != SET}
    return {**others, ATTRIBUTES: f"crc32c={metadata_checksum(checked):08x}"}


def has_sealed_attributes(node: Mapping[str, Any]) -> bool:
    """Tell whether a group without arrays has the attributes that it was written with.

    A group that is sealed with its arrays, or was not made by hyperpaint, is none of this function's.
    """
    attributes = node.get("attributes") or {}
    if COMPLETE in attributes or "hyperpaint_format" not in attributes:
        return True
    return bool(sealed_attributes(attributes)[ATTRIBUTES] == attributes.get(ATTRIBUTES))


def checksum(values: np.ndarray[Any, Any]) -> int:
    """Return the crc32c of decoded samples.

    Examples
    --------
    >>> import numpy as np
    >>> checksum(np.arange(4, dtype="uint16")) == checksum(np.arange(4, dtype=">u2"))
    True
    """
    import google_crc32c
    import numpy as np

    if values.dtype.kind in "OTU":
        return int(google_crc32c.value(json.dumps([str(text) for text in values.ravel()]).encode()))
    plain = np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("<"))
    return int(google_crc32c.value(plain))


def metadata_checksum(document: Mapping[str, Any]) -> int:
    """Return the crc32c of a JSON object, whatever its spacing and the order of its keys."""
    import google_crc32c

    return int(google_crc32c.value(json.dumps(document, sort_keys=True).encode()))
