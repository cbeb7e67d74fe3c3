"""What the metadata of a store may say, whoever wrote it: bounded JSON, plain numbers, known codecs.

A store from another source is a program for the libraries that read it: its metadata name the codecs that
are run, and how much memory is allocated for a chunk. Here is what hyperpaint accepts; `guard` holds the
chunks to it.

Codecs are those that `layout` writes: ``bytes`` or, for text, ``vlen-utf8``, then ``blosc`` and ``crc32c``,
of which either may be missing. All others are refused with the advice to use plain `xarray.open_zarr`:
foreign compressors, ``sharding_indexed``, everything under ``numcodecs.``, where ``pickle`` lives.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeGuard

from hyperpaint.base.errors import IncompleteStoreError, Problems, StoreError

MOST_JSON_BYTES = 32 * 2**20
"""Bytes of a metadata document: a collect of 60 lines has 2 MB, one of 1000 lines 30."""

#: Objects, lists and separators in it: each costs memory many times its own size. A line has 660 and 1040.
_MOST_CONTAINERS = 750_000
_MOST_SEPARATORS = 1_200_000
_MOST_DEPTH = 64

MOST_CHUNK_BYTES = 2**30
"""Decoded bytes of a chunk; `layout` makes none above a tenth of it for any camera there is."""

MOST_AXIS_BYTES = 256 * 2**20
"""Bytes of an array with one dim: xarray loads those that are indexes as soon as a group is opened."""

MOST_CHUNKS = 1_000_000
"""Chunks of an array: 32 million lines."""

MOST_TEXT_BYTES = 64 * 2**20
"""Decoded bytes of a chunk of text, whose metadata do not say how long it is."""

_MOST_DIMS = 32
_MOST_NAME = 255
_MOST_FILL = 4096
_LARGEST_SIZE = 2**48

_ITEM_BYTES = {
    **dict.fromkeys(("bool", "int8", "uint8"), 1),
    **dict.fromkeys(("int16", "uint16", "float16"), 2),
    **dict.fromkeys(("int32", "uint32", "float32"), 4),
    **dict.fromkeys(("int64", "uint64", "float64", "complex64"), 8),
    "complex128": 16,
}
_TIME_TYPES = ("numpy.datetime64", "numpy.timedelta64")
_FIXED_TEXT_TYPES = ("fixed_length_utf32", "null_terminated_bytes")
_TEXT_TYPES = ("string", "variable_length_utf8")
_LONGEST_FIXED_TEXT = 2**16

_CODECS = ("bytes", "vlen-utf8", "blosc", "crc32c")
_BYTES_TO_BYTES = ((), ("blosc",), ("crc32c",), ("blosc", "crc32c"))
_OTHER_READER = "if you trust it, open it with plain xarray.open_zarr, then write it with hyperpaint.to_store"


@dataclass(frozen=True)
class ChunkForm:
    """What every encoded chunk of an array has to be."""

    shape: tuple[int, ...]  # Of the array
    chunk: tuple[int, ...]  # Shape of a chunk
    item_bytes: int  # Of a sample; 0 for text, whose samples have no fixed length
    codecs: tuple[str, ...]  # Names of those from bytes to bytes, in the order in which they encode

    @property
    def is_text(self) -> bool:
        """Whether samples have no fixed length."""
        return self.item_bytes == 0

    @property
    def grid(self) -> tuple[int, ...]:
        """Chunks along each dim."""
        return tuple(-(-size // step) for size, step in zip(self.shape, self.chunk, strict=True))

    @property
    def items(self) -> int:
        """Samples of a chunk; what an edge chunk holds beyond the array counts."""
        return math.prod(self.chunk)

    @property
    def decoded_bytes(self) -> int:
        """Bytes of a decoded chunk; of text, the most that it may have."""
        return MOST_TEXT_BYTES if self.is_text else self.items * self.item_bytes

    @property
    def most_encoded_bytes(self) -> int:
        """Bytes that no encoded chunk exceeds: compressors add little to what they cannot compress."""
        return self.decoded_bytes + self.decoded_bytes // 64 + 4096


def parse_document(raw: bytes, where: str) -> dict[str, Any]:
    """Return the JSON object of a metadata file, which ``where`` names in messages.

    IncompleteStoreError where it is no JSON object, or larger, deeper or longer than any metadata of a store.
    """
    containers = raw.count(b"{") + raw.count(b"[")
    # not even parsed: its values could fill the memory
    if len(raw) > MOST_JSON_BYTES:
        problem = f"{len(raw)} bytes, expected metadata of at most {MOST_JSON_BYTES}"
    elif containers > _MOST_CONTAINERS or raw.count(b",") > _MOST_SEPARATORS:
        problem = f"more values than metadata of a store have ({_MOST_CONTAINERS} objects and lists)"
    else:
        try:
            document = json.loads(raw)
        except (ValueError, RecursionError) as error:
            problem = f"{type(error).__name__}: {error}"
        else:
            if not isinstance(document, dict):
                problem = f"expected a JSON object, found {type(document).__name__}"
            elif _is_deep(document):
                problem = f"values are nested more than {_MOST_DEPTH} deep"
            else:
                return document
    raise IncompleteStoreError(f"{where} is damaged: {problem}")


def _is_deep(document: dict[str, Any]) -> bool:
    level: list[Any] = [document]
    for _ in range(_MOST_DEPTH):
        children: list[Any] = []
        for value in level:
            children.extend(value.values() if isinstance(value, dict) else value)
        level = [child for child in children if isinstance(child, dict | list)]
        if not level:
            return False
    return True


def check_node(document: Mapping[str, Any], where: str) -> ChunkForm | None:
    """Check the ``zarr.json`` of a node; return the form of an array's chunks, None for a group."""
    kind = document.get("node_type")
    if document.get("zarr_format") != 3 or kind not in ("group", "array"):
        raise StoreError(
            f"{where}: zarr_format {document.get('zarr_format')!r:.40}, node_type {kind!r:.40}; "
            "expected a group or an array of Zarr format 3"
        )
    if not isinstance(document.get("attributes", {}), dict):
        raise StoreError(f"{where}: attributes are not a JSON object")
    return array_form(document, where) if kind == "array" else None


def array_form(document: Mapping[str, Any], where: str) -> ChunkForm:
    """Return what the chunks of an array have to be, from its ``zarr.json``.

    ``document``: parsed metadata; ``where``: names the array in messages.

    Raises `StoreError`: Data type, sizes, codecs or another entry is not one that is read; all problems are
    listed.

    Examples
    --------
    >>> codecs = [{"name": "bytes", "configuration": {"endian": "little"}}, {"name": "numcodecs.pickle"}]
    >>> array_form({"shape": [64], "data_type": "uint16", "fill_value": 0, "codecs": codecs,
    ...             "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [32]}}}, "counts")
    Traceback (most recent call last):
    hyperpaint.base.errors.StoreError: counts will not be read:
      codec 'numcodecs.pickle', expected those of hyperpaint: bytes (little-endian), then blosc, ...
    """
    problems = Problems(f"{where} will not be read", StoreError)
    item_bytes = _item_bytes(document.get("data_type"), problems)
    shape = _sizes(document.get("shape"), 0)
    grid, configuration = _named(document.get("chunk_grid"))
    chunk = _sizes(configuration.get("chunk_shape"), 1) if grid == "regular" else None
    if shape is None:
        problems.add(f"shape {document.get('shape')!r:.80}; expected at most {_MOST_DIMS} sizes below 2**48")
    if chunk is None:
        problems.add(f"chunk_grid {document.get('chunk_grid')!r:.120}; expected a regular one, sizes from 1")
    codecs = _codecs(document.get("codecs"), text=item_bytes == 0, problems=problems)
    _check_others(document, problems)
    form = ChunkForm(shape or (), chunk or (), item_bytes or 0, codecs)
    if not (shape is None or chunk is None or item_bytes is None):
        _check_sizes(form, problems)
    problems.raise_if_any()
    return form


def _is_whole(value: Any) -> TypeGuard[int]:
    return isinstance(value, int) and not isinstance(value, bool)


def _sizes(values: Any, least: int) -> tuple[int, ...] | None:
    if not isinstance(values, list) or len(values) > _MOST_DIMS:
        return None
    if not all(_is_whole(value) and least <= value <= _LARGEST_SIZE for value in values):
        return None
    return tuple(values)


def _named(entry: Any) -> tuple[str, dict[str, Any]]:
    """Return the name and the configuration of a codec, grid or data type; "" where it is neither."""
    if isinstance(entry, str):
        return entry, {}
    if isinstance(entry, dict) and isinstance(entry.get("name"), str):
        configuration = entry.get("configuration", {})
        if isinstance(configuration, dict):
            return entry["name"], configuration
    return "", {}


def _item_bytes(data_type: Any, problems: Problems) -> int | None:
    """Return the bytes of a sample, 0 for text; None where the data type is not one that is read."""
    name, configuration = _named(data_type)
    if name in _ITEM_BYTES:
        return _ITEM_BYTES[name]
    if name in _TEXT_TYPES:
        return 0
    if name in _TIME_TYPES:
        return 8
    length = configuration.get("length_bytes")
    if name in _FIXED_TEXT_TYPES and _is_whole(length) and 1 <= length <= _LONGEST_FIXED_TEXT:
        return length
    problems.add(f"data_type {data_type!r:.80}; expected numbers, booleans, times or text")
    return None


def _codecs(entries: Any, *, text: bool, problems: Problems) -> tuple[str, ...]:
    """Return the codecs from bytes to bytes."""
    first = "vlen-utf8" if text else "bytes"
    expected = f"those of hyperpaint: {first} (little-endian), then blosc, then crc32c"
    if not isinstance(entries, list) or not 1 <= len(entries) <= 3:
        problems.add(f"codecs {entries!r:.80}", expected=expected, mend=_OTHER_READER)
        return ()
    named = [_named(entry) for entry in entries]
    names = tuple(name for name, _ in named)
    foreign = [name or entry for entry, name in zip(entries, names, strict=True) if name not in _CODECS]
    if foreign:
        problems.add(f"codec {foreign[0]!r:.60}", expected=expected, mend=_OTHER_READER)
        return ()
    if names[0] != first or names[1:] not in _BYTES_TO_BYTES or named[0][1].get("endian") == "big":
        problems.add(f"codecs {', '.join(names)}", expected=expected, mend=_OTHER_READER)
    if wrong := [name for name, configuration in named if not _is_plain(configuration)]:
        problems.add(f"configuration of codec {', '.join(wrong)}", expected="numbers, names and short lists")
    return names[1:]


def _is_plain(configuration: Mapping[str, Any]) -> bool:
    """Tell whether a codec's configuration holds nothing but small numbers, names and lists of numbers."""

    def small(value: Any) -> bool:
        if isinstance(value, str):
            return len(value) <= _MOST_NAME
        return value is None or isinstance(value, bool) or (_is_whole(value) and abs(value) < 2**31)

    return all(
        len(value) <= _MOST_DIMS and all(_is_whole(number) and small(number) for number in value)
        if isinstance(value, list)
        else small(value)
        for value in configuration.values()
    )


def _check_others(document: Mapping[str, Any], problems: Problems) -> None:
    if document.get("storage_transformers"):
        problems.add("storage_transformers; expected none")
    if len(json.dumps(document.get("fill_value"))) > _MOST_FILL:
        problems.add(f"a fill_value of more than {_MOST_FILL} characters")
    names = document.get("dimension_names", [])
    if not isinstance(names, list | None) or not all(
        name is None or (isinstance(name, str) and len(name) <= _MOST_NAME) for name in names or ()
    ):
        problems.add(f"dimension_names {names!r:.80}; expected one short text for each dim")
    name, configuration = _named(document.get("chunk_key_encoding", "default"))
    if name not in ("default", "v2") or configuration.get("separator", "/") not in ("/", "."):
        problems.add(f"chunk_key_encoding {document.get('chunk_key_encoding')!r:.80}; expected 'default'")


def _check_sizes(form: ChunkForm, problems: Problems) -> None:
    if len(form.shape) != len(form.chunk):
        problems.add(f"chunks of {form.chunk} for a shape of {form.shape}")
        return
    if not form.is_text and form.decoded_bytes > MOST_CHUNK_BYTES:
        size = f"chunks of {form.chunk} with {form.item_bytes} bytes a sample"
        problems.add(f"{size}; expected at most {MOST_CHUNK_BYTES} bytes")
    if form.is_text and form.items * 4 > MOST_TEXT_BYTES:
        problems.add(f"chunks of {form.chunk} texts; expected at most {MOST_TEXT_BYTES // 4}")
    if (count := math.prod(form.grid)) > MOST_CHUNKS:
        problems.add(f"{count} chunks ({form.grid}); expected at most {MOST_CHUNKS}")
    if len(form.shape) == 1 and form.shape[0] * max(form.item_bytes, 4) > MOST_AXIS_BYTES:
        problems.add(
            f"{form.shape[0]} samples along one dim; expected at most {MOST_AXIS_BYTES} bytes of them"
        )
