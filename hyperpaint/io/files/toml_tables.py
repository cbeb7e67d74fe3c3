"""TOML files as checked tables: checks of values, every problem noted, no file opened."""

from __future__ import annotations

import datetime
import difflib
import itertools
import os
import re
import stat
import sys
import tomllib
from collections.abc import Callable, Collection, Iterable, Mapping
from pathlib import Path
from typing import Any

from hyperpaint.base.errors import FormatError, Problems
from hyperpaint.base.input_files import read_limited

from .reading import is_pattern, matching_files

UNKNOWN = "?"
"""Stands where a value is still to be filled in."""

_MAX_BYTES = 1 << 20
#: A key of so many parts: tomllib's time for it grows with the square of their number.
_LONG_KEY = re.compile(rb"""(?:\.[ \t]*(?:[A-Za-z0-9_-]+|"[^"\n]{0,99}"|'[^'\n]{0,99}')[ \t]*){64}""")


def load_tables(path: Path, kind: str) -> dict[str, Any]:
    """Return the tables of a file; ``kind`` names the kind of file in messages.

    Raises `FormatError`: It cannot be read, is larger than such files are, or is not TOML (with the place of
    the mistake).
    """
    raw = read_limited(path, _MAX_BYTES, kind)
    if _LONG_KEY.search(raw):
        raise FormatError(f"{path}: a key of more than 64 parts, expected those of {kind}")
    try:
        return tomllib.loads(raw.decode("utf-8"))
    except (ValueError, RecursionError) as error:  # TOMLDecodeError and UnicodeDecodeError are ValueErrors
        raise FormatError(f"{path}: not TOML: {error!s:.300}") from error


def suggestion(key: str, allowed: Iterable[str]) -> str:
    """Return what to add to a message on a key that is not known: the nearest, or all of them."""
    allowed = list(allowed)
    close = difflib.get_close_matches(key[:100], allowed, n=1)
    return f"; did you mean {close[0]!r}?" if close else f"; known are {', '.join(allowed)}"


def shown(value: Any) -> str:
    """Return a value for a message, shortened."""
    try:
        text = repr(value)
    except ValueError:  # Python refuses to print whole numbers of over 4300 digits, which hexadecimals can be
        text = "a number of thousands of digits"
    return text if len(text) <= 60 else f"{text[:57]}..."


class TableReader:
    """Takes checked values out of the tables of a file, noting every problem.

    ``path``: the file; paths in it are relative to its folder; ``raw``: its tables; ``schema``: check of
    every key of every table; ``lists``: tables that may be there several times; ``problems``: takes what is
    wrong.

    Attribute ``tables``: what is valid of every table of the schema. In each, ``"?"`` is the set of keys that
    were given: keys that were there but wrong are not missing. ``given``: names of the tables given.
    """

    #: Whether patterns may begin outside the folder of the file, as plain paths may.
    outside = False

    def __init__(
        self,
        path: Path,
        raw: Mapping[str, Any],
        schema: Mapping[str, Mapping[str, Check]],
        lists: Collection[str],
        problems: Problems,
    ) -> None:
        self.folder = path.parent
        self.problems = problems
        self.schema = schema
        self.lists = lists
        self.given = set(raw)
        self.tables = {name: self.section(name, raw.get(name)) for name in schema}
        for key in raw:
            if key not in schema:
                problems.add(f"unknown table or key {key!r}{suggestion(key, schema)}")

    def section(self, name: str, value: Any, extra: str = "") -> list[dict[str, Any]]:
        """Return the tables of this name with what is valid in them; ``extra`` else may stand there."""
        if value is None:
            return []
        several = name in self.lists
        tables = value if isinstance(value, list) else [value]
        if isinstance(value, list) != several or not all(isinstance(table, dict) for table in tables):
            shape = f"[[{name}]]" if several else f"[{name}]"
            self.problems.add(f"{name!r} is {shown(value)}, expected {shape}{extra}")
            return []
        return [self._checked(self.place(name, number), name, table) for number, table in enumerate(tables)]

    def place(self, name: str, number: int) -> str:
        """Return what a table is called in messages."""
        return f"[[{name}]] {number + 1}" if name in self.lists else f"[{name}]"

    def _checked(self, place: str, name: str, table: Mapping[str, Any]) -> dict[str, Any]:
        valid: dict[str, Any] = {}
        for key, value in table.items():
            check = self.schema[name].get(key)
            if check is None:
                self.problems.add(f"{place} unknown key {key!r}{suggestion(key, self.schema[name])}")
                continue
            expected = check(None if value == UNKNOWN else value)
            if value == UNKNOWN:
                self.problems.add(f"{place} {key} is still {UNKNOWN!r}: fill in {expected}")
            elif expected is None:
                valid[key] = value
            else:
                self.problems.add(f"{place} {key} = {shown(value)}, expected {expected}")
        valid["?"] = set(table)
        return valid

    def one(self, name: str) -> dict[str, Any]:
        """Return the single table of this name, empty where absent."""
        return next(iter(self.tables[name]), {"?": set()})

    def path(self, place: str, key: str, value: str | None) -> Path | None:
        """Return a path that exists, taken from the folder of the file."""
        if value is None:
            return None
        path = self.folder / value
        if "\0" in value or not os.path.lexists(path):
            self.problems.add(f"{place} {key} = {value!r}: no such file ({path})")
            return None
        if _is_special(path):
            self.problems.add(f"{place} {key} = {value!r}: {_NO_FILE}")
            return None
        return path

    def files(self, place: str, key: str, value: str | list[str]) -> tuple[Path, ...]:
        """Return the files of paths and globs, each glob sorted; one that matches nothing is a problem."""
        paths: list[Path] = []
        for text in value if isinstance(value, list) else [value]:
            if "\0" not in text and is_pattern(text) and not os.path.lexists(self.folder / text):
                base, pattern = _anchored(text) if self.outside else ("", text)
                try:
                    matches = matching_files(self.folder / base, pattern)
                except ValueError as error:
                    self.problems.add(f"{place} {key} = {shown(text)}: {error}")
                    continue
                for match in filter(_is_special, matches):  # left out, it would be missed by nobody
                    self.problems.add(f"{place} {key} = {text!r}: {match} is {_NO_FILE}")
                paths += matches
                if not matches:
                    self.problems.add(f"{place} {key} = {text!r}: matches no file in {self.folder / base}")
            elif (path := self.path(place, key, text)) is not None:
                paths.append(path)
        return tuple(dict.fromkeys(paths))


def _anchored(pattern: str) -> tuple[str, str]:
    """Split a pattern after its plain folders, such as ``../asd``: those are the user's word."""
    parts = Path(pattern).parts
    plain = list(itertools.takewhile(lambda part: not is_pattern(part), parts))
    return str(Path(*plain)), "/".join(parts[len(plain) :])


_NO_FILE = "a pipe or device, expected a file or folder"


def _is_special(path: Path) -> bool:
    """Tell whether a path names what must not be opened: a pipe would wait, a device never end."""
    try:
        mode = path.stat().st_mode
    except OSError:
        return False
    return not (stat.S_ISREG(mode) or stat.S_ISDIR(mode))


Check = Callable[[Any], str | None]
"""Takes a value, and returns None where it is good, else what was expected."""


def _expect(expected: str, is_good: Callable[[Any], bool]) -> Check:
    def check(value: Any) -> str | None:
        return None if is_good(value) else expected

    return check


def _is_text(value: Any) -> bool:
    return isinstance(value, str) and bool(value.strip())


def _is_number(value: Any) -> bool:
    """Tell whether it is a number; TOML's ``inf`` and ``nan`` are none."""
    # compared, not converted: a whole number may be larger than any float
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return is_number and abs(value) <= sys.float_info.max


text = _expect("a text", _is_text)
number = _expect("a number", _is_number)
positive = _expect("a positive number", lambda value: _is_number(value) and value > 0)
not_negative = _expect("a number from 0 on", lambda value: _is_number(value) and value >= 0)
reflectance = _expect(
    "a fraction above 0, at most 1.2, such as 0.5 for 50 %",
    lambda value: _is_number(value) and 0 < value <= 1.2,
)
fraction = _expect(
    "a fraction from 0 to below 1, such as 0.02 for 2 %", lambda value: _is_number(value) and 0 <= value < 1
)
flag = _expect("true or false", lambda value: isinstance(value, bool))
table = _expect("a table of texts", lambda value: isinstance(value, dict))
#: Or text that spells one.
time = _expect("a date or time", lambda value: isinstance(value, str | datetime.date))
three_numbers = _expect(
    "three numbers",
    lambda value: isinstance(value, list) and len(value) == 3 and all(map(_is_number, value)),
)
number_or_pairs = _expect(
    "a positive number, or a list of pairs [wavelength, value]",
    lambda value: (
        (_is_number(value) and value > 0)
        or (
            isinstance(value, list)
            and bool(value)
            and all(
                isinstance(pair, list) and len(pair) == 2 and all(map(_is_number, pair)) for pair in value
            )
        )
    ),
)
two_numbers = _expect(
    "two numbers",
    lambda value: isinstance(value, list) and len(value) == 2 and all(map(_is_number, value)),
)
first_and_stop = _expect(
    "two whole numbers, the first and the one after the last",
    lambda value: (
        isinstance(value, list)
        and [type(each) for each in value] == [int, int]
        and 0 <= value[0] < value[1] < 2**31
    ),
)
texts = _expect(
    "a text or a list of texts",
    lambda value: all(map(_is_text, value if isinstance(value, list) and value else [value])),
)


def whole(least: int, most: int) -> Check:
    """Expect a whole number between two, both included."""
    return _expect(
        f"a whole number from {least} to {most}",
        lambda value: isinstance(value, int) and not isinstance(value, bool) and least <= value <= most,
    )


def one_of(*allowed: str) -> Check:
    """Expect one of these words."""
    words = ", ".join(map(repr, allowed))
    return _expect(f"one of {words}", lambda value: isinstance(value, str) and value in allowed)
