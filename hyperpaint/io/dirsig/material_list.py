"""DIRSIG's material list (``.mat``): sections in curly brackets, and ``KEY = value``.

The opening bracket is on the line of the section's name, the closing bracket on a separate line [1]_.

References
----------
.. [1] DIRSIG manual, "Material Database", https://dirsig.cis.rit.edu/docs/new/mat.html
"""

from __future__ import annotations

import os
import re
import unicodedata
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hyperpaint.base.errors import FormatError, Problems
from hyperpaint.io.files.reading import decoded_text, read_limited_text, unique_names

_MAX_ID_CHARS, _MAX_NAME_CHARS = 48, 120
#: ASCII spellings of letters, an umlaut as two letters; other accents are dropped.
_LETTERS = str.maketrans(
    {
        "ä": "ae",
        "ö": "oe",
        "ü": "ue",
        "Ä": "Ae",
        "Ö": "Oe",
        "Ü": "Ue",
        "ß": "ss",
        "æ": "ae",
        "Æ": "Ae",
        "ø": "oe",
        "Ø": "Oe",
        "å": "aa",
        "Å": "Aa",
        "œ": "oe",
        "Œ": "Oe",
        "ł": "l",
        "Ł": "L",
        "µ": "u",
        "\u2013": "-",
        "\u2014": "-",
        "\u2019": "'",
    }
)
_UNSAFE = re.compile(r"[^ -~]|[{}=\"#<>&;]")
_NO_TOKEN = re.compile(r"[^A-Za-z0-9]+")
#: Names of devices on Windows, which files cannot have.
_DEVICES = {"con", "prn", "aux", "nul", *(f"{port}{n}" for port in ("com", "lpt") for n in range(10))}


def plain_name(name: str) -> str:
    """Return a name in ASCII without the signs of the tag format.

    Umlauts become two letters, other accents are dropped, and other signs become underscores.

    Examples
    --------
    >>> plain_name("Brillantsilber métallisé, 775/9775 {Türkis}")
    'Brillantsilber metallise, 775/9775 _Tuerkis_'
    """
    # Unicode has two encodings of letters with accents
    text = unicodedata.normalize("NFC", name).translate(_LETTERS)
    text = "".join(sign for sign in unicodedata.normalize("NFKD", text) if not unicodedata.combining(sign))
    return " ".join(_UNSAFE.sub("_", " ".join(text.split())).split())[:_MAX_NAME_CHARS].strip()


def material_names(names: Iterable[str], used: Collection[str] = ()) -> list[str]:
    """Return a plain name for every name, all distinct and not in ``used``.

    Examples
    --------
    >>> material_names(["red", "red", "赤"], used=["red"])
    ['red (2)', 'red (3)', 'paint 3']
    """
    plain = [plain_name(name) for name in names]
    usable = [text if text.strip("_ ") else f"paint {number}" for number, text in enumerate(plain, start=1)]
    return unique_names(usable, used, fold=str.casefold)


def material_ids(names: Iterable[str], used: Collection[str] = ()) -> list[str]:
    """Return an ID for every name, all distinct on every file system and not in ``used``.

    Examples
    --------
    >>> material_ids(["Rouge / Grün", "rouge grün", "1", "", "con"])
    ['Rouge_Gruen', 'rouge_gruen_2', 'paint_1', 'paint_4', 'paint_con']
    """
    tokens = []
    for number, name in enumerate(names, start=1):
        token = _NO_TOKEN.sub("_", plain_name(name)).strip("_")[:_MAX_ID_CHARS].strip("_")
        if token.isdigit() or token.lower() in _DEVICES:
            # IDs of a scene's materials are often numbers
            token = f"paint_{token}"
        tokens.append(token or f"paint_{number}")
    return unique_names(tokens, used, suffix="_{}", fold=str.casefold)


MAX_BYTES = 16 * 2**20
MAX_LINES = 400_000
_MAX_DEPTH = 16
_MAX_SHOWN = 8
_OPENED = re.compile(r"([A-Za-z_][A-Za-z0-9_]*+)[ \t]*+\{")
_VARIABLE = re.compile(r"([A-Za-z_][A-Za-z0-9_.]*+)[ \t]*+=[ \t]*+(.*+)")
_LOOK_UP = re.compile(r"([^ \t:{}=]++)[ \t]*+:[ \t]*+([^ \t:{}=]++)")
_TOKEN = re.compile(r"[^\s{}=]++")
_ENTRY = "MATERIAL_ENTRY"


@dataclass(frozen=True)
class Section:
    """A section of the tag format."""

    name: str  # Text before the bracket
    # Pairs of key and value, and sections, in the order of the file
    items: tuple[tuple[str, str] | Section, ...] = ()

    def get(self, key: str) -> str | None:
        """Return the value of a key, None without one."""
        return next((item[1] for item in self.items if isinstance(item, tuple) and item[0] == key), None)

    def section(self, name: str) -> Section | None:
        """Return the section of a name, None without one."""
        return next((item for item in self.sections() if item.name == name), None)

    def sections(self) -> Iterator[Section]:
        """Yield the inner sections."""
        return (item for item in self.items if isinstance(item, Section))


@dataclass(frozen=True)
class Material:
    """An entry of a material list."""

    id: str  # ID of the material in geometry files
    name: str  # Name for readers
    entry: Section  # Complete entry of the file

    @property
    def emissivity_file(self) -> str | None:
        """Path of the emissivity file, as written; not opened."""
        return self._property("EMISSIVITY_PROP", "FILENAME")

    @property
    def reflectance_file(self) -> str | None:
        """Path of the two-column reflectance file, as written."""
        return self._property("REFLECTANCE_PROP", "TXT_FILENAME")

    @property
    def specular_fraction(self) -> float | None:
        """Share of reflectance that is specular [1]; None if the file does not have it."""
        text = self._property("EMISSIVITY_PROP", "SPECULAR_FRACTION")
        return None if text is None else float(text)

    def _property(self, section: str, key: str) -> str | None:
        surface = self.entry.section("SURFACE_PROPERTIES")
        properties = surface.section(section) if surface else None
        return properties.get(key) if properties else None


def read_materials(path: str | os.PathLike[str]) -> tuple[Material, ...]:
    """Read a material list.

    Raises
    ------
    FormatError
        The file cannot be read; brackets or lines are not of the tag format; keys or sections occur twice; a
        material has no ID or name, or the ID of another material; a solver or property has a name but no
        section; SPECULAR_FRACTION is not 0 to 1. All are listed.
    """
    data = read_limited_text(Path(path), MAX_BYTES, "a DIRSIG material list", MAX_LINES)
    problems = Problems(f"{os.fspath(path)} is not a DIRSIG material list", FormatError)
    top = _parse(decoded_text(data), problems)
    problems.raise_if_any()
    entries = [item for item in top if item.name == _ENTRY]
    materials = [_material(entry, number, problems) for number, entry in enumerate(entries, start=1)]
    counts = Counter(material.id for material in materials)
    for token in [token for token, count in counts.items() if count > 1][:_MAX_SHOWN]:
        problems.add(f"ID {token[:40]!r} occurs twice", expected="distinct IDs", code="id-duplicate")
    if not top:
        problems.add("there is no section", expected=f"{_ENTRY} {{ ... }}", code="section-missing")
    problems.raise_if_any()
    return tuple(materials)


def _parse(text: str, problems: Problems) -> list[Section]:
    # name, first line and content of the open sections, innermost last
    opened: list[tuple[str, int, list[Any]]] = [("", 0, [])]
    for number, raw in enumerate(text.split("\n"), start=1):
        line = raw.strip(" \t\r")
        if not line:
            continue
        name, _, items = opened[-1]
        if line == "}" and len(opened) > 1:
            opened.pop()
            opened[-1][2].append(Section(name, tuple(items)))
        elif (heading := _OPENED.fullmatch(line)) and len(opened) <= _MAX_DEPTH:
            opened.append((heading[1], number, []))
        elif name and (pair := _VARIABLE.fullmatch(line) or (name == "LUT" and _LOOK_UP.fullmatch(line))):
            items.append((pair[1], pair[2]))
        else:
            problems.add(
                f"line {number}: {line[:60]!r}",
                expected=_expected(line, len(opened)),
                code="row-unreadable",
            )
            if len(problems) >= _MAX_SHOWN:
                return []
    for name, number, _ in opened[1:][:_MAX_SHOWN]:
        problems.add(
            f"line {number}: section {name} is not closed", expected="a line '}'", code="section-open"
        )
    return opened[0][2]


def _expected(line: str, depth: int) -> str:
    if line == "}":
        return "no bracket, since no section is open"
    if depth > _MAX_DEPTH:
        return f"sections at most {_MAX_DEPTH} deep"
    return "'NAME {', '}'" + (" or 'KEY = value'" if depth > 1 else "")


def _material(entry: Section, number: int, problems: Problems) -> Material:
    # DIRSIG 3 wrote MATERIAL_ID and MATERIAL_NAME
    token, name = (entry.get(key) or entry.get(f"MATERIAL_{key}") or "" for key in ("ID", "NAME"))
    subject = f"material {number} ({token[:40]!r})"
    if len(problems) < _MAX_SHOWN:
        if not _TOKEN.fullmatch(token):
            problems.add(f"{subject} has no ID", expected="an ID without blanks", code="id-missing")
        if not name:
            problems.add(f"{subject} has no NAME", code="name-missing")
        for fault, code in _section_problems(entry):
            problems.add(f"{subject}: {fault}", code=code)
        fraction = Material(token, name, entry)._property("EMISSIVITY_PROP", "SPECULAR_FRACTION")
        if fraction is not None and not _is_fraction(fraction):
            problems.add(
                f"{subject}: SPECULAR_FRACTION = {fraction[:40]!r}",
                expected="0 to 1",
                code="value-out-of-range",
            )
    return Material(token, name, entry)


def _section_problems(section: Section) -> Iterator[tuple[str, str]]:
    keys = Counter(item[0] if isinstance(item, tuple) else item.name for item in section.items)
    for key, count in keys.items():
        if count > 1:
            yield f"{key} occurs twice in {section.name}", "key-duplicate"
    inside = {item.name for item in section.sections()}
    for key in sorted(keys.keys() - inside):
        name = key.removesuffix("_NAME")
        if name != key and name.endswith(("_SOLVER", "_PROP")) and name not in inside:
            yield f"{key} without a section {name}", "section-missing"
    for item in section.sections():
        yield from _section_problems(item)


def _is_fraction(text: str) -> bool:
    try:
        return 0.0 <= float(text) <= 1.0
    except ValueError:
        return False


def materials_text(entries: Iterable[Section]) -> str:
    """Return sections as the text of a material list, in the layout of DIRSIG's distribution.

    Examples
    --------
    >>> print(materials_text([Section("MATERIAL_ENTRY", (("ID", "7"), ("NAME", "red paint")))]), end="")
    MATERIAL_ENTRY {
        ID   = 7
        NAME = red paint
    }
    """
    return "\n".join("\n".join(_lines(entry, "")) + "\n" for entry in entries)


def _lines(section: Section, indent: str) -> Iterator[str]:
    yield f"{indent}{section.name} {{"
    inner = indent + "    "
    items = section.items
    run: list[tuple[str, str]] = []
    for number, item in enumerate(items):
        following = items[number + 1] if number + 1 < len(items) else None
        if isinstance(item, Section):
            yield from _aligned(run, inner)
            run = []
            if f"{item.name}_NAME" not in {pair[0] for pair in items[:number] if isinstance(pair, tuple)}:
                yield ""
            yield from _lines(item, inner)
        elif isinstance(following, Section) and item[0] == f"{following.name}_NAME":
            # the name of a solver or property is written directly before its section
            yield from _aligned(run, inner)
            run = [item]
            yield ""
        else:
            run.append(item)
    yield from _aligned(run, inner)
    yield f"{indent}}}"


def _aligned(pairs: Sequence[tuple[str, str]], indent: str) -> Iterator[str]:
    width = max((len(key) for key, _ in pairs), default=0)
    for key, value in pairs:
        yield f"{indent}{key:<{width}} = {value}"
