"""Zarr stores that hand out nothing unchecked: metadata, chunks and the paths to them.

`xarray` and `zarr` read through these as through any store. Metadata pass `documents`, chunks are decoded by
`frames`, and both are held against the completion record where there is one: each when it is read, so that
opening stays as cheap as it is and a slab is checked where it is decoded, on a worker too. What is not the
recorded content, be it damaged, exchanged, stale or of a later version, is never handed out. A reader that
opens the same store by its path has none of this.
"""

from __future__ import annotations

import asyncio
import functools
import json
import os
import re
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from zarr.core.buffer import default_buffer_prototype
from zarr.storage import FsspecStore, LocalStore

from hyperpaint.base.errors import IncompleteStoreError, StoreError

from .blocks import region
from .documents import MOST_JSON_BYTES, ChunkForm, check_node, parse_document
from .frames import decode_chunk
from .location import METADATA, Location, plain_file
from .record import COMPLETE, GroupRecord, attributes_checksum, checksum, metadata_checksum, read_seal

if TYPE_CHECKING:
    import numpy as np

__all__ = ["guarded", "stored_codecs"]

_FLOOR = (0, 16, 6)
#: Zarr 2 keeps its metadata in these: to a guarded reader they do not exist.
_OLD_METADATA = (".zarray", ".zgroup", ".zattrs", ".zmetadata")


def guarded(
    location: Location, *, group: str = "", record: GroupRecord | None = None, content: str = ""
) -> LocalStore | FsspecStore:
    """Return a read-only Zarr store over a place that nobody vouches for.

    Parameters
    ----------
    location
        The place.
    group, record
        A group, and its completion record: what is read of it must be what was recorded, and a chunk that
        is missing is refused, where it would otherwise read as the fill value.
    content
        Names what is stored, for the names of dask's tasks.

    Raises
    ------
    StoreError
        The numcodecs installed runs code that stores name.
    """
    _check_numcodecs()
    if location.local is not None:
        store: _LocalGuard | _RemoteGuard = _LocalGuard(location.local, read_only=True)
    else:
        store = _RemoteGuard.from_url(location.url, read_only=True)
    store.group, store.record, store.content, store.url = group, record, content, location.url
    store.forms, store.codecs = {}, {}
    return store


def stored_codecs(store: LocalStore | FsspecStore, path: str) -> tuple[Any, ...]:
    """Return the compressor and checksum with which an array is stored, which a guard keeps from zarr."""
    from zarr.registry import get_codec_class

    return tuple(get_codec_class(entry["name"]).from_dict(entry) for entry in store.codecs.get(path, ()))


@functools.cache
def _check_numcodecs() -> None:
    """Refuse a numcodecs whose text codecs pass what they decode on to pickle."""
    import numcodecs

    found = tuple(int(part) for part in re.findall(r"\d+", numcodecs.__version__)[:3])
    if found < _FLOOR:
        raise StoreError(
            f"numcodecs {numcodecs.__version__} runs code that a store brings along; "
            "install a newer one: python -m pip install 'numcodecs>=0.16.6'"
        )


class _Guard:
    """What both kinds of store have in common.

    Chunks are decoded here, so that they can be held against the record, and handed on without compressor
    and checksum; the metadata that zarr is given name none.
    """

    group = ""
    record: GroupRecord | None = None
    content = ""
    url = ""
    forms: dict[str, ChunkForm]
    codecs: dict[str, list[dict[str, Any]]]

    def __dask_tokenize__(self) -> tuple[str, str, str]:
        return (type(self).__name__, self.url, self.content)

    def _array_of(self, key: str) -> str | None:
        """Return the path of the array that a chunk is of; None where it is of none read so far."""
        parts = key.split("/")
        paths = ("/".join(parts[:end]) for end in range(len(parts) - 1, -1, -1))
        return next((path for path in paths if path in self.forms), None)

    def _most_bytes(self, key: str, byte_range: Any) -> int:
        """Return how long the file of a key may be."""
        if key.rpartition("/")[2] == METADATA:
            return MOST_JSON_BYTES
        array = self._array_of(key)
        if array is None or byte_range is not None:
            raise StoreError(
                f"{self.url}/{key} was asked for, which is neither metadata nor a chunk of an array"
            )
        return self.forms[array].most_encoded_bytes

    def _checked(self, key: str, value: Any, prototype: Any) -> Any:
        """Return what was read, as zarr is to see it, or raise."""
        is_metadata = key.rpartition("/")[2] == METADATA
        if value is None:
            if self.record is not None and not is_metadata:
                raise self._not_recorded(key, "is missing")
            return None
        data = value.as_numpy_array()
        made = self._metadata(key, data.tobytes()) if is_metadata else self._chunk(key, data)
        return (prototype or default_buffer_prototype()).buffer.from_bytes(made)

    def _metadata(self, key: str, raw: bytes) -> bytes:
        where, path = f"{self.url}/{key}", key.rpartition("/")[0]
        document = parse_document(raw, where)
        document.pop("consolidated_metadata", None)
        form = check_node(document, where)
        if self.record is not None:
            self._check_recorded_metadata(key, document)
        if form is not None:
            inner = len(document["codecs"]) - len(form.codecs)
            self.forms[path], self.codecs[path] = form, _as_objects(document["codecs"][inner:])
            document["codecs"] = document["codecs"][:inner]
        return json.dumps(document).encode()

    def _check_recorded_metadata(self, key: str, document: Mapping[str, Any]) -> None:
        assert self.record is not None
        path = key.rpartition("/")[0]
        folder, _, name = path.rpartition("/")
        if path == self.group:
            seal = document.get("attributes", {}).get(COMPLETE)
            if seal != self.record.seal or attributes_checksum(document) != self.record.attributes:
                raise self._not_recorded(key, "holds other attributes than were written")
        elif folder == self.group and document["node_type"] == "array":
            array = self.record.arrays.get(name)
            if array is None or metadata_checksum(document) != array.metadata:
                raise self._not_recorded(key, "holds other metadata than were written")

    def _chunk(self, key: str, data: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        path = self._array_of(key)
        assert path is not None  # a key of no array has been refused
        form = self.forms[path]
        try:
            decoded = decode_chunk(form, data)
        except StoreError as error:
            if self.record is not None:
                raise self._not_recorded(key, f"is damaged or forged: {error}") from None
            raise StoreError(f"the chunk {self.url}/{key} is damaged or forged: {error}") from None
        if self.record is not None and not self._is_recorded(path, key, decoded):
            raise self._not_recorded(key, "is not what was written (its checksum differs)")
        return decoded

    def _is_recorded(self, path: str, key: str, decoded: np.ndarray[Any, Any]) -> bool:
        """Tell whether a decoded chunk has the checksum that was recorded for its place."""
        import numpy as np

        assert self.record is not None
        form, array = self.forms[path], self.record.arrays.get(path.rpartition("/")[2])
        place = tuple(map(int, re.findall(r"\d+", key.removeprefix(path)))) if form.shape else ()
        if array is None or len(place) != len(array.grid):
            return False
        # what an edge chunk holds beyond the array does not count
        inside: tuple[Any, ...] = tuple(
            slice(part.stop - part.start) for part in region(place, form.chunk, form.shape)
        )
        if form.is_text:
            values = _texts(decoded).reshape(form.chunk)[(*inside, ...)]
        elif form.is_plain:
            values = decoded.reshape(*form.chunk, form.item_bytes)[inside]
        else:  # big-endian or transposed, which no writer of ours seals
            return False
        return checksum(values) == array.chunks[int(np.ravel_multi_index(place, array.grid)) if place else 0]

    def _not_recorded(self, key: str, state: str) -> IncompleteStoreError:
        """Return the error for something that is not as it was recorded."""
        if read_seal(Location.of(self.url), self.group) not in (None, self.record and self.record.seal):
            return IncompleteStoreError(
                f"group {'/' + self.group!r} of {self.url} was replaced since it was opened; open it again"
            )
        what = "" if key.rpartition("/")[2] == METADATA else "the chunk "
        mend = "run hyperpaint.verify, and write the group again"
        return IncompleteStoreError(f"{what}{self.url}/{key} {state}; {mend}")


def _as_objects(codecs: list[Any]) -> list[dict[str, Any]]:
    return [{"name": entry} if isinstance(entry, str) else entry for entry in codecs]


def _texts(decoded: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    import numcodecs

    texts: np.ndarray[Any, Any] = numcodecs.VLenUTF8().decode(decoded.tobytes())
    return texts


def _is_old(key: str) -> bool:
    return key.rpartition("/")[2] in _OLD_METADATA


class _LocalGuard(_Guard, LocalStore):  # type: ignore[misc]
    """A folder. Links in it are not followed, and nothing but plain files is opened."""

    def _is_plain(self, key: str, byte_range: Any) -> bool:
        found = plain_file(os.fspath(self.root), key)
        if found is not None and found.st_size > (most := self._most_bytes(key, byte_range)):
            raise StoreError(f"{self.url}/{key} has {found.st_size} bytes, expected at most {most}")
        return found is not None

    async def get(self, key: str, prototype: Any = None, byte_range: Any = None) -> Any:
        # what is decoded in zarr's one event loop, no other thread could decode at the same time
        return await asyncio.to_thread(self.get_sync, key, prototype=prototype, byte_range=byte_range)

    def get_sync(self, key: str, *, prototype: Any = None, byte_range: Any = None) -> Any:
        if _is_old(key):
            return None
        there = self._is_plain(key, byte_range)
        try:
            found = super().get_sync(key, prototype=prototype, byte_range=byte_range) if there else None
        except OSError as error:
            raise StoreError(f"{self.url}/{key} cannot be read: {error.strerror or error}") from error
        return self._checked(key, found, prototype)

    async def get_partial_values(self, prototype: Any, key_ranges: Any) -> list[Any]:
        return [await self.get(key, prototype, byte_range) for key, byte_range in key_ranges]


class _RemoteGuard(_Guard, FsspecStore):  # type: ignore[misc]
    """A place behind a URL. How long an object is shows only once it is there."""

    async def get(self, key: str, prototype: Any = None, byte_range: Any = None) -> Any:
        if _is_old(key):
            return None
        most = self._most_bytes(key, byte_range)
        found = await super().get(key, prototype or default_buffer_prototype(), byte_range)
        if found is not None and len(found) > most:
            raise StoreError(f"{self.url}/{key} has {len(found)} bytes, expected at most {most}")
        return await asyncio.to_thread(self._checked, key, found, prototype)

    async def get_partial_values(self, prototype: Any, key_ranges: Any) -> list[Any]:
        return [await self.get(key, prototype, byte_range) for key, byte_range in key_ranges]
