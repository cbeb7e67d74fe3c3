"""Names of the records of our ENVI libraries: plain for other programs, and leading back to the paint.

A paint keeps its name but for what the header's grammar forbids; where two paints then have one name, the
second gets a number. What else is known of a paint follows its name after a bar: ``red | member 3``.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

from hyperpaint.base.errors import FormatError

from .records import CENTRE, Key

__all__ = ["MARK", "header_names", "keys_of", "record_name"]

MARK = "hyperpaint library"
"""Key of a header that says that names lead back."""

_BAR = " | "
_SHORT = {"member_reflectance": "member"}
_LONG = {short: name for name, short in _SHORT.items()}
_LABEL = re.compile(r"([A-Za-z_][A-Za-z0-9_]{0,99})(?: ([1-9][0-9]{0,9}))?")
_FORBIDDEN = str.maketrans({",": ";", "{": "(", "}": ")", "|": "/"})


def header_names(names: Sequence[str]) -> list[str]:
    """Return names that a header can hold, no two alike.

    Examples
    --------
    >>> header_names(["red, matt", "blue", "", "blue"])
    ['red; matt', 'blue', 'unnamed', 'blue (2)']
    """
    made: list[str] = []
    taken: set[str] = set()
    counts: dict[str, int] = {}
    for name in names:
        plain = name.translate(_FORBIDDEN).strip() or "unnamed"
        unique = plain
        while unique in taken:
            counts[plain] = counts.get(plain, 1) + 1
            unique = f"{plain} ({counts[plain]})"
        taken.add(unique)
        made.append(unique)
    return made


def record_name(paint: str, variable: str, inner: int) -> str:
    """Return the name of a record.

    Examples
    --------
    >>> record_name("red", "reflectance", -1), record_name("red", "member_reflectance", 2)
    ('red', 'red | member 3')
    """
    if variable == CENTRE:
        return paint
    place = "" if inner < 0 else f" {inner + 1}"
    return f"{paint}{_BAR}{_SHORT.get(variable, variable)}{place}"


def keys_of(text: str, count: int, source: str) -> tuple[list[str], list[Key]]:
    """Return the names of the paints, and what each record is.

    Parameters
    ----------
    text
        The names of all records, as the header has them.
    count
        Records of the file.
    source
        Names the file in messages.

    Raises
    ------
    FormatError
        There are not as many names, or one leads nowhere.
    """
    if text.count(",") + 1 != count:
        raise FormatError(
            f"{source}: {text.count(',') + 1} spectra names for {count} spectra; write the library anew"
        )
    records = [name.strip() for name in text.split(",")]
    names = list(_paints(records))
    places = {name: at for at, name in enumerate(names)}
    if len(places) != len(names) or records[: len(names)] != names:
        raise FormatError(
            f"{source}: its first records are not its paints, each once; write the library anew"
        )
    return names, [_key(record, places, source) for record in records]


def _paints(records: Sequence[str]) -> Iterator[str]:
    return (record for record in records if _BAR not in record)


def _key(record: str, places: dict[str, int], source: str) -> Key:
    if record in places:
        return CENTRE, places[record], -1
    paint, _, label = record.partition(_BAR)
    match = _LABEL.fullmatch(label)
    if paint not in places or match is None:
        raise FormatError(f"{source}: record {record[:80]!r} leads to no paint; write the library anew")
    return _LONG.get(match[1], match[1]), places[paint], int(match[2] or 0) - 1
