"""Encoded chunks: decoded once it is known that one decodes to what its array declares.

The decompressors believe the frame: they allocate what it says it holds, and some read where it points to. A
frame of 32 kB can say 1 GiB, one of 3 MB hold 6 GB (`documents` bounds what an array may declare).
"""

from __future__ import annotations

import zlib
from typing import TYPE_CHECKING, Any

from hyperpaint.base.errors import StoreError

from .documents import COMPRESSORS, MOST_TEXT_BYTES

if TYPE_CHECKING:
    import numpy as np

    from .documents import ChunkForm

__all__ = ["check_frame", "decode_chunk"]

_CRC_BYTES = 4
_BLOSC_HEADER = 16
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
#: Bytes inflated at a time only to count them.
_PIECE = 2**20


def decode_chunk(form: ChunkForm, encoded: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Return an encoded chunk without its compressor and checksums.

    Parameters
    ----------
    form
        Of the array.
    encoded
        The chunk as it is stored, uint8.

    Returns
    -------
    numpy.ndarray of uint8
        Its samples, or its texts each after its length (walked through).

    Raises
    ------
    StoreError
        It does not decode to what the array declares, or a checksum in it is wrong.
    """
    check_frame(form, encoded.data)
    data = encoded
    for codec in reversed(form.codecs):
        data = _without_checksum(data) if codec == "crc32c" else _decompressed(codec, data)
    if form.is_text:
        _check_texts(data.tobytes(), form.items)
    elif data.size != form.decoded_bytes:
        raise StoreError(f"it decodes to {data.size} bytes, the array declares {form.decoded_bytes}")
    return data


def _without_checksum(data: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Return what is before a crc32c, which must be that of it."""
    import google_crc32c

    body, stored = data[:-_CRC_BYTES], int.from_bytes(data[-_CRC_BYTES:].tobytes(), "little")
    found = int(google_crc32c.value(body))
    if data.size < _CRC_BYTES or found != stored:
        raise StoreError(f"its crc32c is {found:08x}, stored is {stored:08x}")
    return body


def _decompressed(codec: str, data: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    import numcodecs
    import numpy as np

    decoders = {"blosc": numcodecs.Blosc, "zstd": numcodecs.Zstd, "gzip": numcodecs.GZip}
    try:
        return np.frombuffer(decoders[codec]().decode(data), np.uint8)
    except Exception as error:  # each library has its own
        raise StoreError(f"it cannot be decoded ({type(error).__name__}: {error})") from None


def check_frame(form: ChunkForm, encoded: bytes | memoryview) -> None:
    """Check that an encoded chunk decodes to the size that its array declares, before it is decoded.

    The header of a blosc frame says it (and must fit the frame's own length), as does that of a zstd frame,
    which must be the only one; a gzip stream is inflated piece by piece, no further than is allowed. Texts
    must stay within `documents.MOST_TEXT_BYTES`.

    Parameters
    ----------
    form
        Of the array.
    encoded
        The chunk as it is stored.

    Raises
    ------
    StoreError
        It does not.
    """
    data = memoryview(encoded).cast("B")
    if len(data) > form.most_encoded_bytes:
        raise StoreError(f"{len(data)} bytes for a chunk that decodes to {form.decoded_bytes}")
    at = next((i for i, name in enumerate(form.codecs) if name in COMPRESSORS), None)
    inside = form.codecs if at is None else form.codecs[:at]
    outside = () if at is None else form.codecs[at + 1 :]
    plain = form.decoded_bytes + _CRC_BYTES * len(inside)
    # whether a checksum is right shows when the chunk is decoded; here it is only not part of the frame
    data = data[: max(0, len(data) - _CRC_BYTES * len(outside))]
    held = len(data) if at is None else _held(form.codecs[at], data, plain)
    if form.is_text:
        if held > MOST_TEXT_BYTES:
            raise StoreError(f"it holds {held} bytes of text, expected at most {MOST_TEXT_BYTES}")
    elif held != plain:
        raise StoreError(f"it holds {held} bytes, the array declares {plain}")


def _held(codec: str, data: memoryview, limit: int) -> int:
    """Return how many bytes a frame decodes to, followed no further than just beyond the limit."""
    if codec == "blosc":
        return _blosc(data)
    return _zstd(data, limit) if codec == "zstd" else _gzip(data, limit)


def _blosc(data: memoryview) -> int:
    """Return the decoded bytes that a blosc frame declares."""
    if len(data) < _BLOSC_HEADER:
        raise StoreError(f"{len(data)} bytes are no blosc frame")
    version, typesize = data[0], data[3]
    held, block, size = (int.from_bytes(data[start : start + 4], "little") for start in (4, 8, 12))
    if size != len(data):
        raise StoreError(f"its blosc frame says {size} bytes, there are {len(data)}")
    if version not in (1, 2) or typesize == 0 or not (0 < block <= held or held == 0):
        raise StoreError(
            f"blosc frame of version {version}, {typesize} bytes a sample, blocks of {block} of {held} bytes"
        )
    return held


def _zstd(data: memoryview, limit: int) -> int:
    """Return the decoded bytes that a zstd frame declares (RFC 8878, 3.1.1)."""
    if len(data) < 6 or data[:4] != _ZSTD_MAGIC:
        raise StoreError("it is no zstd frame")
    descriptor = data[4]
    single, checked = bool(descriptor & 0x20), bool(descriptor & 0x04)
    start = 5 + (0 if single else 1) + (0, 1, 2, 4)[descriptor & 3]
    width = (1 if single else 0, 2, 4, 8)[descriptor >> 6]
    if width == 0:
        raise StoreError(
            "its zstd frame does not say how much it holds; write it with a zstd that does, or with blosc"
        )
    held = int.from_bytes(data[start : start + width], "little") + (256 if width == 2 else 0)
    if held <= limit:
        _check_zstd_blocks(data, start + width, len(data) - (4 if checked else 0), held)
    return held


def _check_zstd_blocks(data: memoryview, place: int, end: int, held: int) -> None:
    """Follow the blocks of a frame to its end: what came after it would be decoded as well."""
    # a block shorter than 256 bytes is never worth its header to a compressor
    for _ in range(held // 256 + 16):
        header = int.from_bytes(data[place : place + 3], "little")
        last, kind, size = header & 1, header >> 1 & 3, header >> 3
        place += 3 + (1 if kind == 1 else size)
        if kind == 3 or place > end:
            break
        if last:
            if place == end:
                return
            break
    raise StoreError("the blocks of its zstd frame do not end where the chunk ends")


def _gzip(data: memoryview, limit: int) -> int:
    """Return the bytes that a gzip stream inflates to; more than the limit is an error at once."""
    stream = zlib.decompressobj(wbits=31)
    held, pending = 0, bytes(data)
    while not stream.eof and held <= limit:
        try:
            piece = stream.decompress(pending, _PIECE)
        except zlib.error as error:
            raise StoreError(f"it is no gzip stream ({error})") from None
        if not piece and not stream.eof:
            break
        held, pending = held + len(piece), stream.unconsumed_tail
    if held > limit:
        raise StoreError(f"its gzip stream holds more than the {limit} bytes that the array declares")
    if not stream.eof or stream.unused_data:
        raise StoreError("its gzip stream does not end where the chunk ends")
    return held


def _check_texts(plain: bytes, items: int) -> None:
    """Walk through texts, each after its length, as ``vlen-utf8`` stores them."""
    found = int.from_bytes(plain[:4], "little")
    if found != items:
        raise StoreError(f"it holds {found} texts, the array declares {items}")
    place = 4
    for _ in range(items):
        if place + 4 > len(plain):
            break
        place += 4 + int.from_bytes(plain[place : place + 4], "little")
    if place != len(plain):
        raise StoreError(f"its {items} texts do not end where the chunk ends")
