"""Zarr stores that hand out nothing unchecked: metadata, chunks and the paths to them.

`xarray` and `zarr` read through these as through any store. Metadata pass `documents`, chunks pass `frames`,
each when it is read, so that opening stays as cheap as it is and a slab is checked where it is decoded, on a
worker too. A reader that opens the same store by its path has none of this.
"""

from __future__ import annotations

import functools
import os
import re
from typing import Any

from zarr.core.buffer import default_buffer_prototype
from zarr.storage import FsspecStore, LocalStore

from hyperpaint.errors import IncompleteStoreError, StoreError

from .documents import MOST_JSON_BYTES, ChunkForm, check_node, parse_document
from .frames import check_frame
from .location import METADATA, Location, plain_file

__all__ = ["guarded"]

_FLOOR = (0, 16, 6)
#: Zarr 2 keeps its metadata in these: to a guarded reader they do not exist.
_OLD_METADATA = (".zarray", ".zgroup", ".zattrs", ".zmetadata")


def guarded(location: Location, *, whole: bool = False, content: str = "") -> LocalStore | FsspecStore:
    """Return a read-only Zarr store over a place that nobody vouches for.

    Parameters
    ----------
    location
        The place.
    whole
        Refuse to read a chunk that is missing, where it would otherwise read as the fill value.
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
    store.whole, store.content, store.url, store.forms = whole, content, location.url, {}
    return store


@functools.cache
def _check_numcodecs() -> None:
    """Refuse a numcodecs whose text codecs pass what they decode on to pickle."""
    import numcodecs

    found = tuple(int(part) for part in re.findall(r"\d+", numcodecs.__version__)[:3])
    if found < _FLOOR:
        msg = (
            f"numcodecs {numcodecs.__version__} runs code that a store brings along; "
            "install a newer one: python -m pip install 'numcodecs>=0.16.6'"
        )
        raise StoreError(msg)


class _Guard:
    """What both kinds of store have in common."""

    whole = False
    content = ""
    url = ""
    forms: dict[str, ChunkForm]

    def __dask_tokenize__(self) -> tuple[str, str, str]:
        return (type(self).__name__, self.url, self.content)

    def _form(self, key: str) -> ChunkForm | None:
        """Return the form of the array that a chunk is of; None where the key is of none read so far."""
        parts = key.split("/")
        paths = ("/".join(parts[:end]) for end in range(len(parts) - 1, -1, -1))
        return next((self.forms[path] for path in paths if path in self.forms), None)

    def _most_bytes(self, key: str, byte_range: Any) -> int:
        """Return how long the file of a key may be."""
        if key.rpartition("/")[2] == METADATA:
            return MOST_JSON_BYTES
        form = self._form(key)
        if form is None or byte_range is not None:
            msg = f"{self.url}/{key} was asked for, which is neither metadata nor a chunk of an array"
            raise StoreError(msg)
        return form.most_encoded_bytes

    def _check(self, key: str, value: Any) -> Any:
        """Return what was read, or raise."""
        where = f"{self.url}/{key}"
        folder, _, name = key.rpartition("/")
        if value is None:
            if self.whole and name != METADATA:
                msg = f"the chunk {where} is missing; run hyperpaint.verify, and write the group again"
                raise IncompleteStoreError(msg)
            return None
        data = value.as_numpy_array()
        if name == METADATA:
            form = check_node(parse_document(data.tobytes(), where), where)
            if form is not None:
                self.forms[folder] = form
        elif (form := self._form(key)) is not None:
            try:
                check_frame(form, memoryview(data))
            except StoreError as error:
                msg = f"the chunk {where} is damaged or forged: {error}"
                raise StoreError(msg) from None
        return value


def _is_old(key: str) -> bool:
    return key.rpartition("/")[2] in _OLD_METADATA


class _LocalGuard(_Guard, LocalStore):  # type: ignore[misc]
    """A folder. Links in it are not followed, and nothing but plain files is opened."""

    def _is_plain(self, key: str, byte_range: Any) -> bool:
        found = plain_file(os.fspath(self.root), key)
        if found is not None and found.st_size > (most := self._most_bytes(key, byte_range)):
            msg = f"{self.url}/{key} has {found.st_size} bytes, expected at most {most}"
            raise StoreError(msg)
        return found is not None

    async def get(self, key: str, prototype: Any = None, byte_range: Any = None) -> Any:
        if _is_old(key):
            return None
        there = self._is_plain(key, byte_range)
        return self._check(key, await super().get(key, prototype, byte_range) if there else None)

    def get_sync(self, key: str, *, prototype: Any = None, byte_range: Any = None) -> Any:
        if _is_old(key):
            return None
        there = self._is_plain(key, byte_range)
        found = super().get_sync(key, prototype=prototype, byte_range=byte_range) if there else None
        return self._check(key, found)

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
            msg = f"{self.url}/{key} has {len(found)} bytes, expected at most {most}"
            raise StoreError(msg)
        return self._check(key, found)

    async def get_partial_values(self, prototype: Any, key_ranges: Any) -> list[Any]:
        return [await self.get(key, prototype, byte_range) for key, byte_range in key_ranges]
