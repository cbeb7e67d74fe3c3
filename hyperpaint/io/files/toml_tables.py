"""TOML files as tables checked by their facts: all problems are noted, named files are not opened."""

import difflib
import itertools
import os
import re
import tomllib
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Any

from hyperpaint.base import Facts, FormatError, Problems, read_limited, shown

from .reading import is_pattern, matching_files

#: Placeholder of a value that the user has to fill in.
UNKNOWN = "?"

_MAX_BYTES = 1 << 20
#: A key of 64 parts or more: the time of tomllib grows with the square of the number of parts.
_LONG_KEY = re.compile(rb"""(?:\.[ \t]*(?:[A-Za-z0-9_-]+|"[^"\n]{0,99}"|'[^'\n]{0,99}')[ \t]*){64}""")


def load_tables(path: Path, kind: str) -> dict[str, Any]:
    # Return the tables of a file; ``kind`` names the kind of file in messages.
    #
    # Raises `FormatError`: The file cannot be read, is too large, or is not TOML (with the place of the
    # mistake).
    raw = read_limited(path, _MAX_BYTES, kind)
    FormatError.raise_if(
        _LONG_KEY.search(raw),
        f"{path}: a key of more than 64 parts",
        expected=f"the keys of {kind}",
        code="key-too-long",
    )
    try:
        return tomllib.loads(raw.decode("utf-8"))
    except (ValueError, RecursionError) as error:  # TOMLDecodeError and UnicodeDecodeError are ValueErrors
        raise FormatError(f"{path}: not TOML: {error!s:.300}", code="toml-unreadable") from error


def suggestion(key: str, allowed: Iterable[str]) -> str:
    # Return the mend for an unknown key: the nearest key, or all of them.
    allowed = list(allowed)
    close = difflib.get_close_matches(key[:100], allowed, n=1)
    return f"did you mean {close[0]!r}?" if close else f"known are {', '.join(allowed)}"


class TableReader:
    # Reads checked values from the tables of a file, and notes every problem.
    #
    # ``path``: the file; paths in it are relative to its folder; ``raw``: its tables; ``schema``: facts of
    # every key of every table; ``lists``: tables that may occur several times; ``problems``: receives the
    # faults.
    #
    # Attribute ``tables``: the valid keys of every table of the schema. In each, ``"?"`` is the set of keys
    # in the file, with wrong values too. ``given``: names of the tables in the file.
    #: Whether patterns may begin outside the folder of the file, as plain paths may.
    outside = False

    def __init__(
        self,
        path: Path,
        raw: Mapping[str, Any],
        schema: Mapping[str, Facts],
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
                problems.add(
                    f"unknown table or key {key!r}", mend=suggestion(key, schema), code="key-unknown"
                )

    def section(self, name: str, value: Any, extra: str = "") -> list[dict[str, Any]]:
        # Return the valid keys of the tables of this name; ``extra`` names another accepted value.
        if value is None:
            return []
        is_list = name in self.lists
        tables = value if isinstance(value, list) else [value]
        if isinstance(value, list) != is_list or not all(isinstance(table, dict) for table in tables):
            shape = f"[[{name}]]" if is_list else f"[{name}]"
            mend = f"write one table for each {name}" if is_list else "write it once"
            self.problems.add(
                f"{name!r} is {shown(value)}", expected=f"{shape}{extra}", mend=mend, code="table-shape"
            )
            return []
        return [self._checked(self.place(name, number), name, table) for number, table in enumerate(tables)]

    def place(self, name: str, number: int) -> str:
        # Return the name of a table in messages.
        return f"[[{name}]] {number + 1}" if name in self.lists else f"[{name}]"

    def _checked(self, table_place: str, name: str, table: Mapping[str, Any]) -> dict[str, Any]:
        valid: dict[str, Any] = {}
        facts = self.schema[name]
        for key, value in table.items():
            if key not in facts:
                self.problems.add(
                    f"{table_place} unknown key {key!r}", mend=suggestion(key, facts), code="key-unknown"
                )
            elif value == UNKNOWN:
                self.problems.add(
                    f"{table_place} {key} is still {UNKNOWN!r}",
                    mend=f"fill in {facts[key].expected}",
                    code="value-unfilled",
                )
            elif facts[key].note(
                self.problems, f"{table_place} {key} = {shown(value)}", value, facts[key].mend
            ):
                valid[key] = value
        valid["?"] = set(table)
        return valid

    def one(self, name: str) -> dict[str, Any]:
        # Return the single table of this name, empty where absent.
        return next(iter(self.tables[name]), {"?": set()})

    def exclude(self, place: str, table: Mapping[str, Any], *keys: str) -> None:
        # Note keys of a table that exclude each other.
        present = [key for key in keys if key in table["?"]]
        self.problems.add_if(
            len(present) > 1, f"{place} has {' and '.join(present)}", mend="keep one", code="option-conflict"
        )

    def is_name(self, place: str, key: str, name: str, blanks: str = "") -> bool:
        # Return whether a group of the store can have this name; otherwise note the fault.
        if _NAME.fullmatch(name) and name not in _ZARR_NAMES:
            return True
        self.problems.add(
            f"{place} {key} = {shown(name)}",
            expected=f"letters, digits, {blanks}'.', '_' and '-'",
            mend="choose a name that can name a group of the store",
            code="name-invalid",
        )
        return False

    def path(self, place: str, key: str, value: str | None) -> Path | None:
        # Return a path that exists, taken from the folder of the file.
        if value is None:
            return None
        path = self.folder / value
        if "\0" in value or not os.path.lexists(path):
            self.problems.add(
                f"{place} {key} = {value!r}: no such file ({path})", mend=_RELATIVE, code="file-not-found"
            )
            return None
        if _is_special(path):
            self._note_special(f"{place} {key} = {value!r}")
            return None
        return path

    def files(self, place: str, key: str, value: str | list[str]) -> tuple[Path, ...]:
        # Return the files of paths and patterns, sorted by pattern; note patterns without a match.
        paths: list[Path] = []
        for text in value if isinstance(value, list) else [value]:
            if "\0" in text or not is_pattern(text) or os.path.lexists(self.folder / text):
                if (path := self.path(place, key, text)) is not None:
                    paths.append(path)
                continue
            base, pattern = _anchored(text) if self.outside else ("", text)
            try:
                matches = matching_files(self.folder / base, pattern)
            except ValueError as error:
                self.problems.add(
                    f"{place} {key} = {shown(text)}: {error}", mend="shorten it", code="pattern-invalid"
                )
                continue
            for match in filter(_is_special, matches):  # reported, since a missing match would not be noticed
                self._note_special(f"{place} {key} = {text!r}: {match}")
            paths += matches
            if not matches:
                self.problems.add(
                    f"{place} {key} = {text!r} matches no file in {self.folder / base}",
                    mend=_RELATIVE,
                    code="file-not-found",
                )
        return tuple(dict.fromkeys(paths))

    def _note_special(self, found: str) -> None:
        self.problems.add(
            f"{found} is a pipe or device",
            expected="a file or folder",
            mend="copy it into a file",
            code="file-special",
        )


_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")
_ZARR_NAMES = {"zarr.json", "c"}
_RELATIVE = "paths count from the folder of this file"


def values(table: Mapping[str, Any]) -> dict[str, Any]:
    # Return the valid keys of a table of `TableReader`.
    return {key: value for key, value in table.items() if key != "?"}


def _anchored(pattern: str) -> tuple[str, str]:
    # Split a pattern after its folders without wildcards, such as ``../asd``, which may leave the folder.
    parts = Path(pattern).parts
    folders = list(itertools.takewhile(lambda part: not is_pattern(part), parts))
    return str(Path(*folders)), "/".join(parts[len(folders) :])


def _is_special(path: Path) -> bool:
    # Return whether a path names a pipe or device: reading it would block or never end.
    return os.path.exists(path) and not (os.path.isfile(path) or os.path.isdir(path))
