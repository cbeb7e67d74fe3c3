"""The header of a PLY file, held against the size of the file before anything is made room for."""

from __future__ import annotations

from hyperpaint.base.errors import FormatError

__all__ = ["check_ply"]

_SIZES = {
    "char": 1, "int8": 1, "uchar": 1, "uint8": 1, "short": 2, "int16": 2, "ushort": 2, "uint16": 2, "int": 4,
    "int32": 4, "uint": 4, "uint32": 4, "float": 4, "float16": 2, "float32": 4, "double": 8, "float64": 8,
    "int64": 8, "uint64": 8,
}  # fmt: skip
_LONGEST_HEADER = 65536


def check_ply(data: bytes, where: str) -> None:
    """Do nothing where the header of a PLY file can be true.

    Parameters
    ----------
    data
        The whole file.
    where
        Its name, for messages.

    Raises
    ------
    FormatError
        There is no PLY header, or it declares more than the file can hold.
    """
    if not data.startswith(b"ply"):
        raise FormatError(f"{where}: it begins with {data[:4]!r}, expected b'ply'")
    head, end, _ = data[:_LONGEST_HEADER].partition(b"end_header")
    if not end:
        raise FormatError(
            f"{where}: no end_header in its first {_LONGEST_HEADER} bytes; the file is cut or damaged"
        )
    room = len(data) - len(head) - len(end)
    lines = head.decode("latin-1").split("\n")
    binary = any("binary" in line for line in lines[:3])
    needed, count, row = 0, 0, 0
    for line in [*lines, "element end 0"]:
        words = line.split()
        if words[:1] == ["element"]:
            needed += count * row
            count, row = _count(words, where, line), 0
        elif words[:1] == ["property"]:
            row += _row(words, where, line) if binary else 2  # a digit and what follows it
    if needed > room + 2:
        raise FormatError(
            f"{where}: its header declares {needed} bytes or more, found {room}; the file is cut or damaged"
        )


def _count(words: list[str], where: str, line: str) -> int:
    if len(words) != 3 or not words[2].isascii() or not words[2].isdigit() or len(words[2]) > 18:
        raise FormatError(f"{where}: the header has {line.strip()[:60]!r}, expected 'element NAME COUNT'")
    return int(words[2])


def _row(words: list[str], where: str, line: str) -> int:
    """Return the least number of bytes that a property takes up."""
    kinds = words[2:4] if words[1:2] == ["list"] else words[1:2]
    if len(words) != (5 if words[1:2] == ["list"] else 3) or any(kind not in _SIZES for kind in kinds):
        raise FormatError(
            f"{where}: the header has {line.strip()[:60]!r}, expected 'property TYPE NAME' or a list"
        )
    return _SIZES[kinds[0]]
