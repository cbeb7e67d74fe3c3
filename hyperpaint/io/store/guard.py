"""Zarr stores that hand out nothing unchecked: metadata, chunks and the paths to them.

`xarray` and `zarr` read through these as through any store. Metadata pass `documents`, chunks pass
`decode_chunk`, and both are held against the completion record where there is one: each when it is read, so
that opening stays as cheap as it is and a slab is checked where it is decoded, on a worker too. What is not
the recorded content, be it damaged, exchanged, stale or of a later version, is never handed out. A reader
that opens the same store by its path has none of this.
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

from .chunks import region
from .documents import MOST_JSON_BYTES, MOST_TEXT_BYTES, ChunkForm, check_node, parse_document
from .location import METADATA, Location, plain_file
from .record import COMPLETE, GroupRecord, attributes_checksum, checksum, metadata_checksum, read_seal

if TYPE_CHECKING:
    import numpy as np

_FLOOR = (0, 16, 6)
_CRC_BYTES = 4
_BLOSC_HEADER = 16
#: Zarr 2 keeps its metadata in these: to a guarded reader they do not exist.
_OLD_METADATA = (".zarray", ".zgroup", ".zattrs", ".zmetadata")


def guarded(
    location: Location, *, group: str = "", record: GroupRecord | None = None, content: str = ""
) -> LocalStore | FsspecStore:
    """Return a read-only Zarr store over a place that is not trusted.

    With ``group`` and its completion ``record``, what is read of the group must be what was recorded, and a
    chunk that is missing is refused, where it would otherwise read as the fill value. ``content`` names what
    is stored, for the names of dask's tasks.
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

    version = tuple(int(part) for part in re.findall(r"\d+", numcodecs.__version__)[:3])
    if version < _FLOOR:
        raise StoreError(
            f"numcodecs {numcodecs.__version__} runs code that a store brings along; "
            "install a newer one: python -m pip install 'numcodecs>=0.16.6'"
        )


def decode_chunk(form: ChunkForm, encoded: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Return a chunk (uint8) without compressor and checksum: samples, or texts after their lengths.

    The decompressor allocates what a frame says it holds: a frame of 32 kB can say 1 GiB. Its header is
    therefore compared with the array's metadata first (`documents` bounds what those may declare). StoreError
    where the chunk does not decode to what the array declares, or a checksum in it is wrong.
    """
    if encoded.size > form.most_encoded_bytes:
        raise StoreError(f"{encoded.size} bytes for a chunk that decodes to {form.decoded_bytes}")
    data = encoded
    for codec in reversed(form.codecs):
        data = _without_checksum(data) if codec == "crc32c" else _decompressed(form, data)
    _check_size(form, data.size)
    if form.is_text:
        _check_texts(data.tobytes(), form.items)
    return data


def _check_size(form: ChunkForm, size: int) -> None:
    if form.is_text:
        if size > MOST_TEXT_BYTES:
            raise StoreError(f"it holds {size} bytes of text", expected=f"at most {MOST_TEXT_BYTES}")
    elif size != form.decoded_bytes:
        raise StoreError(f"it holds {size} bytes, the array declares {form.decoded_bytes}")


def _without_checksum(data: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Return what is before a crc32c, which must be that of it."""
    import google_crc32c

    body, stored = data[:-_CRC_BYTES], int.from_bytes(data[-_CRC_BYTES:].tobytes(), "little")
    computed = int(google_crc32c.value(body))
    if data.size < _CRC_BYTES or computed != stored:
        raise StoreError(f"its crc32c is {computed:08x}, stored is {stored:08x}")
    return body


def _decompressed(form: ChunkForm, data: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Return what a blosc frame holds, once its header declares its own length and the size of the chunk."""
    import numcodecs
    import numpy as np

    if data.size < _BLOSC_HEADER:
        raise StoreError(f"{data.size} bytes are no blosc frame")
    header = data[:_BLOSC_HEADER].tobytes()
    size, block, length = (int.from_bytes(header[start : start + 4], "little") for start in (4, 8, 12))
    if length != data.size:
        raise StoreError(f"its blosc frame says {length} bytes, there are {data.size}")
    version, typesize = header[0], header[3]
    if version not in (1, 2) or typesize == 0 or not (0 < block <= size or size == 0):
        raise StoreError(
            f"blosc frame of version {version}, {typesize} bytes a sample, blocks of {block} of {size} bytes"
        )
    _check_size(form, size)
    try:
        return np.frombuffer(numcodecs.Blosc().decode(data), np.uint8)
    except Exception as error:  # the library has no class of its own
        raise StoreError(f"it cannot be decoded ({type(error).__name__}: {error})") from None


def _check_texts(plain: bytes, items: int) -> None:
    """Walk through texts, each after its length, as ``vlen-utf8`` stores them."""
    count = int.from_bytes(plain[:4], "little")
    if count != items:
        raise StoreError(f"it holds {count} texts, the array declares {items}")
    place = 4
    for _ in range(items):
        if place + 4 > len(plain):
            break
        place += 4 + int.from_bytes(plain[place : place + 4], "little")
    if place != len(plain):
        raise StoreError(f"its {items} texts do not end where the chunk ends")


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

    async def get_partial_values(self, prototype: Any, key_ranges: Any) -> list[Any]:
        return [await self.get(key, prototype, byte_range) for key, byte_range in key_ranges]  # type: ignore[attr-defined]

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
        content = self._metadata(key, data.tobytes()) if is_metadata else self._chunk(key, data)
        return (prototype or default_buffer_prototype()).buffer.from_bytes(content)

    def _metadata(self, key: str, raw: bytes) -> bytes:
        where, path = f"{self.url}/{key}", key.rpartition("/")[0]
        document = parse_document(raw, where)
        document.pop("consolidated_metadata", None)
        form = check_node(document, where)
        if self.record is not None:
            self._check_recorded_metadata(key, document)
        if form is not None:
            inner = len(document["codecs"]) - len(form.codecs)
            stored = document["codecs"][inner:]
            self.codecs[path] = [{"name": codec} if isinstance(codec, str) else codec for codec in stored]
            self.forms[path] = form
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
        import numcodecs
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
            values = numcodecs.VLenUTF8().decode(decoded.tobytes()).reshape(form.chunk)[(*inside, ...)]
        else:
            values = decoded.reshape(*form.chunk, form.item_bytes)[inside]
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


def _is_old(key: str) -> bool:
    return key.rpartition("/")[2] in _OLD_METADATA


class _LocalGuard(_Guard, LocalStore):  # type: ignore[misc]
    """A folder. Links in it are not followed, and nothing but plain files is opened."""

    def _is_plain(self, key: str, byte_range: Any) -> bool:
        status = plain_file(os.fspath(self.root), key)
        if status is not None and status.st_size > (most := self._most_bytes(key, byte_range)):
            raise StoreError(f"{self.url}/{key} has {status.st_size} bytes, expected at most {most}")
        return status is not None

    async def get(self, key: str, prototype: Any = None, byte_range: Any = None) -> Any:
        # what is decoded in zarr's one event loop, no other thread could decode at the same time
        return await asyncio.to_thread(self.get_sync, key, prototype=prototype, byte_range=byte_range)

    def get_sync(self, key: str, *, prototype: Any = None, byte_range: Any = None) -> Any:
        if _is_old(key):
            return None
        there = self._is_plain(key, byte_range)
        try:
            content = super().get_sync(key, prototype=prototype, byte_range=byte_range) if there else None
        except OSError as error:
            raise StoreError(f"{self.url}/{key} cannot be read: {error.strerror or error}") from error
        return self._checked(key, content, prototype)


class _RemoteGuard(_Guard, FsspecStore):  # type: ignore[misc]
    """A place behind a URL. How long an object is shows only once it is there."""

    async def get(self, key: str, prototype: Any = None, byte_range: Any = None) -> Any:
        if _is_old(key):
            return None
        most = self._most_bytes(key, byte_range)
        content = await super().get(key, prototype or default_buffer_prototype(), byte_range)
        if content is not None and len(content) > most:
            raise StoreError(f"{self.url}/{key} has {len(content)} bytes, expected at most {most}")
        return await asyncio.to_thread(self._checked, key, content, prototype)
