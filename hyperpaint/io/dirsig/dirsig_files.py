"""Files of DIRSIG: spectral emissivity (``.ems``) and material lists (``.mat``), their readers and texts.

An ``.ems`` file is text: the number of curves, 91 weights for view angles of 0 to 90 degrees, then the
curves. In the new layout a curve begins with the line ``CURVE_BEGIN``, and its rows are wavelength [um],
ascending, and emissivity. In the old layout a curve begins with its number, from 0, and has the 396 rows of
wavenumbers 39850, 39750, ... 350 [cm-1] and emissivity [1]_. Several curves are the variability within a
material: DIRSIG's texture selects one for every point.

A material list has sections in curly brackets, and ``KEY = value``. The opening bracket is on the line of the
section's name, the closing bracket on a separate line [2]_.

References
----------
.. [1] DIRSIG manual, "Emissivity Files", https://dirsig.cis.rit.edu/docs/new/ems.html
.. [2] DIRSIG manual, "Material Database", https://dirsig.cis.rit.edu/docs/new/mat.html
"""

import itertools
import os
import re
import unicodedata
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base import (
    BAND,
    LIBRARY_VARIABLES,
    MEMBER,
    SIGNATURE,
    Array,
    Floats,
    FormatError,
    Problem,
    Problems,
    SchemaError,
    as_path,
)
from hyperpaint.io.files.reading import decoded_text, numbers, read_limited_text, unique_names

#: Line before every curve in the new layout of an ``.ems`` file.
CURVE_BEGIN = "CURVE_BEGIN"

#: Decimals of an emissivity or reflectance, as in files of DIRSIG's distribution.
DECIMALS = 6

#: Decimals of a wavelength [um]: a ten-thousandth of a nanometre.
WAVELENGTH_DECIMALS = 7

_ANGLES = 91


def emissivity_head(count: int) -> bytes:
    """Return the first lines of an ``.ems`` file: the number of curves, and a weight for every degree.

    All weights are 1, as in nearly all files, since an imager measures at one view angle only.

    Examples
    --------
    >>> emissivity_head(3).split()[:3], len(emissivity_head(3).split())
    ([b'3', b'1.0', b'1.0'], 92)
    """
    return f"{count}\n".encode() + b"1.0\n" * _ANGLES


class ColumnText:
    r"""Format of spectra with common wavelengths as two columns, wavelength [um] and value [1].

    The digits of the values of many spectra are computed together, by integer division, and inserted into
    copies of a template.

    ``wavelength``: ascending [nm]; ``title``: line before every spectrum, empty for none.

    Raises `SchemaError`: Wavelengths rounded to the written decimals are not ascending.

    Examples
    --------
    >>> ColumnText([400.0, 702.5]).text(np.array([[0.25, 1.0]]))
    b'0.4000000\t0.250000\n0.7025000\t1.000000\n'
    """

    def __init__(self, wavelength: Sequence[float] | Array, title: str = "") -> None:
        micrometres = [f"{nm / 1000.0:.{WAVELENGTH_DECIMALS}f}" for nm in np.asarray(wavelength, float)]
        pairs = itertools.pairwise(micrometres)
        SchemaError.raise_if(
            equal := next((text for text, following in pairs if float(following) <= float(text)), ""),
            f"two successive wavelengths at or below {equal} um",
            expected="ascending wavelengths",
            mend="keep one of them",
            code="wavelength-unordered",
        )
        head = f"{title}\n" if title else ""
        rows = [f"{text}\t0.{'0' * DECIMALS}\n" for text in micrometres]
        self._template = np.frombuffer((head + "".join(rows)).encode(), np.uint8)
        # Successive rows of equal width: their bytes, their indices, their width
        self._runs: list[tuple[slice, slice, int]] = []
        start, row = len(head), 0
        for width, group in itertools.groupby(map(len, rows)):
            count = len(list(group))
            self._runs.append((slice(start, start + count * width), slice(row, row + count), width))
            start, row = start + count * width, row + count

    def text(self, values: Array) -> bytes:
        # Return the text of spectra (spectrum, wavelength) between 0 and 1.
        digits_left = np.rint(np.asarray(values, np.float64) * 10**DECIMALS).astype(np.uint32)
        texts = np.repeat(self._template[np.newaxis], len(digits_left), axis=0)
        # views of shape (spectrum, row, character)
        tables = [
            (texts[:, text_slice].reshape(len(digits_left), -1, width), columns)
            for text_slice, columns, width in self._runs
        ]
        for digit in range(DECIMALS + 1):
            quotient = digits_left // np.uint32(10)
            characters = (digits_left - quotient * np.uint32(10)).astype(np.uint8) + np.uint8(ord("0"))
            # position from the end of the row, after the line feed; the point is before the decimals
            at = -2 - digit if digit < DECIMALS else -3 - digit
            for table, columns in tables:
                table[:, :, at] = characters[:, columns]
            digits_left = quotient
        return texts.tobytes()


#: Largest ``.ems`` file [bytes]: a thousand curves of 2000 wavelengths have some 36 MB.
MAX_EMS_BYTES = 128 * 2**20

MAX_CURVES = 100_000
_WAVENUMBERS = np.arange(39850.0, 349.0, -100.0)
_MAX_WAVELENGTH_UM = 100.0  # [um]
_MAX_SHOWN = 8

# possessive quantifiers, so that a long line is read once
_NUMBER = rb"[+-]?+(?:[0-9]{1,40}+(?:\.[0-9]{0,40}+)?+|\.[0-9]{1,40}+)(?:[eE][+-]?+[0-9]{1,4}+)?+"
_ROW = rb"[ \t]*+" + _NUMBER + rb"[ \t]++" + _NUMBER + rb"[ \t]*+"
_ONE_NUMBER = re.compile(rb"[ \t]*+" + _NUMBER + rb"[ \t]*+")
_COUNT = re.compile(rb"[ \t]*+([0-9]{1,9}+)[ \t]*+")
_ONE_ROW = re.compile(_ROW)
_ROWS = re.compile(rb"(?:" + _ROW + rb"\n)++(?:[ \t]*+\n)*+")
_NEW_MARK = re.compile(rb"^[ \t]*+CURVE_BEGIN[ \t]*+\n", re.MULTILINE)
_OLD_MARK = re.compile(rb"^[ \t]*+([0-9]{1,9}+)[ \t]*+\n", re.MULTILINE)


@dataclass(frozen=True, eq=False)
class Curve:
    # One spectrum.
    wavelength: Floats  # Ascending (wavelength,) [um]
    emissivity: Floats  # (wavelength,) [1]


@dataclass(frozen=True, eq=False)
class Emissivity:
    """Content of an ``.ems`` file."""

    weights: Floats  # Factor on emissivity at 0, 1, ... 90 degrees from the normal (91,) [1]
    curves: tuple[Curve, ...]  # One or more
    layout: str  # ``new`` or ``old``


def read_emissivity(path: str | os.PathLike[str]) -> Emissivity:
    # Read a spectral emissivity file of the old or new layout.
    #
    # Raises `FormatError`: The file cannot be read, or differs from the format in
    # `hyperpaint.io.dirsig.dirsig_files`: the number of curves is not that of the first line, wavelengths do
    # not ascend or are not in micrometres, emissivity is outside 0 to 1, or there is other text; all are
    # listed.
    name = os.fspath(path)
    data = read_limited_text(Path(path), MAX_EMS_BYTES, "a DIRSIG emissivity file")
    problems = Problems(f"{name} is not a DIRSIG emissivity file", FormatError)
    text = data.replace(b"\r\n", b"\n") if b"\r" in data else data
    lines = (text if text.endswith(b"\n") else text + b"\n").split(b"\n", _ANGLES + 1)
    match = _COUNT.fullmatch(lines[0])
    count = int(match[1]) if match else 0
    problems.add_if(
        not 1 <= count <= MAX_CURVES,
        f"line 1: {_shown(lines[0])}",
        expected=f"a number of curves, 1 to {MAX_CURVES}",
        code="number-unreadable",
    )
    if len(lines) < _ANGLES + 2:
        problems.add(
            f"{len(lines) - 1} lines",
            expected=f"the number of curves, {_ANGLES} weights and curves",
            code="file-truncated",
        )
        problems.raise_if_any()
    weights = np.array([float(line) if _ONE_NUMBER.fullmatch(line) else np.nan for line in lines[1:-1]])
    problems.extend(
        Problem(
            f"line {angle + 2}: {_shown(lines[angle + 1])}",
            expected=f"the weight of {angle} degrees",
            code="number-unreadable",
        )
        for angle in np.flatnonzero(np.isnan(weights))[:_MAX_SHOWN].tolist()
    )
    problems.raise_if_any(
        (
            np.isinf(weights).any() or (weights < 0.0).any(),
            Problem(
                "a weight of a view angle is negative or not finite",
                expected="0 or more",
                code="value-out-of-range",
            ),
        ),
    )
    body = lines[-1]
    # Layout, and curves after the weights
    start = body.rfind(b"\n", 0, len(body) - len(body.lstrip(b" \t\n"))) + 1  # first line with text
    is_new = _NEW_MARK.match(body, start) is not None
    layout, mark = ("new", _NEW_MARK) if is_new else ("old", _OLD_MARK)
    marks = list(mark.finditer(body, start))
    line = _ANGLES + 3 + body.count(b"\n", 0, start)
    first_line = body[start : body.find(b"\n", start)]
    begins_right = mark.match(body, start) is not None
    problems.raise_if_any(
        (
            not begins_right,
            Problem(
                f"line {line - 1}: {_shown(first_line)}",
                expected=f"{CURVE_BEGIN} or the number 0 of a curve",
                code="row-unreadable",
            ),
        ),
        (
            begins_right and len(marks) != count,
            Problem(
                f"{len(marks)} curves",
                expected=f"{count}, as line 1 says",
                mend="check whether the file is cut off",
                code="length-mismatch",
            ),
        ),
    )
    curves = []
    ends = [mark.start() for mark in marks[1:]] + [len(body)]
    for number, (heading, end) in enumerate(zip(marks, ends, strict=True)):
        if not is_new and int(heading[1]) != number:
            problems.add(
                f"line {line - 1}: curve {int(heading[1])}", expected=str(number), code="row-unreadable"
            )
        rows = body[heading.end() : end]
        if _ROWS.fullmatch(rows):
            axis, emissivity = np.array(rows.split(), np.float64).reshape(-1, 2).T.copy()
            subject = f"curve {number}, from line {line}"
            # the first check that fails is reported
            for is_wrong, found, expected, mend, code in (
                (
                    not is_new and not np.array_equal(axis, _WAVENUMBERS),
                    f"{subject}: {len(axis)} rows",
                    f"the {len(_WAVENUMBERS)} wavenumbers 39850, 39750, ... 350 [cm-1]",
                    "",
                    "grid-mismatch",
                ),
                (
                    not np.isfinite(axis).all()
                    or axis[0] <= 0.0
                    or (is_new and (np.diff(axis) <= 0.0).any()),
                    f"{subject}: wavelengths do not ascend from above 0",
                    "",
                    "sort the rows, and keep one per wavelength",
                    "wavelength-unordered",
                ),
                (
                    is_new and axis[-1] > _MAX_WAVELENGTH_UM,
                    f"{subject}: wavelengths up to {axis[-1]:g}",
                    "micrometres",
                    "divide nanometres by 1000",
                    "wavelength-range",
                ),
                (
                    not (
                        np.isfinite(emissivity).all() and emissivity.min() >= 0.0 and emissivity.max() <= 1.0
                    ),
                    f"{subject}: emissivity from {emissivity.min():g} to {emissivity.max():g}",
                    "0 to 1",
                    "divide percent by 100",
                    "value-out-of-range",
                ),
            ):
                if is_wrong:
                    problems.add(found, expected=expected, mend=mend, code=code)
                    break
            else:
                curves.append(Curve(axis if is_new else 1e4 / axis, emissivity))
        elif not rows.strip():
            problems.add(
                f"line {line}: a curve without rows",
                expected="wavelength and emissivity",
                code="table-missing",
            )
        else:
            cells = enumerate(rows.rstrip(b" \t\n").split(b"\n"), line)
            at, row = next((cell for cell in cells if not _ONE_ROW.fullmatch(cell[1])), (line, b""))
            problems.add(f"line {at}: {_shown(row)}", expected="two numbers", code="row-unreadable")
        if len(problems) >= _MAX_SHOWN:
            break
        line += rows.count(b"\n") + 1
    problems.raise_if_any()
    return Emissivity(weights, tuple(curves), layout)


def _shown(line: bytes) -> str:
    return repr(line[:60].decode("ascii", "replace"))


def open_emissivity(path: str | os.PathLike[str]) -> xr.Dataset:
    # Open an ``.ems`` file as a paint library of one opaque paint, with its curves as members.
    #
    # Returns: ``member_reflectance`` (signature, member, band) = 1 - emissivity and ``reflectance``
    # (signature, band), their mean, float32 [1]; ``wavelength`` (band) [nm]. Weights of view angles are
    # ignored.
    #
    # Raises `FormatError`: As `read_emissivity`; or its curves have different wavelengths.
    path = as_path(path)
    file = read_emissivity(path)
    wavelength = file.curves[0].wavelength
    FormatError.raise_if(
        not all(np.array_equal(curve.wavelength, wavelength) for curve in file.curves),
        f"{path}: the curves have different wavelengths",
        expected="equal wavelengths",
        mend="read each curve with read_emissivity",
        code="grid-mismatch",
    )
    members = 1.0 - np.array([curve.emissivity for curve in file.curves])
    centre = members.mean(axis=0, dtype=np.float64)[np.newaxis].astype(np.float32)
    about_centre = {"units": "1", "long_name": "Reflectance, mean of the curves"}
    # nm rounded to the decimals that are written, so that reading and writing again gives the same text
    return xr.Dataset(
        {
            "reflectance": ((SIGNATURE, BAND), centre, about_centre),
            "member_reflectance": (
                (SIGNATURE, MEMBER, BAND),
                members[np.newaxis].astype(np.float32),
                {"units": "1", "long_name": "Reflectance of a curve"},
            ),
        },
        {
            SIGNATURE: np.array([path.stem], object),
            "wavelength": (BAND, np.round(wavelength * 1e3, 10), LIBRARY_VARIABLES["wavelength"].attrs),
        },
        {"source": path.name, "layout": f"DIRSIG emissivity, {file.layout}"},
    )


# --- material lists ----------------------------------------------------------------------------------------

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


MAX_MAT_BYTES = 16 * 2**20
MAX_LINES = 400_000
_MAX_DEPTH = 16
_OPENED = re.compile(r"([A-Za-z_][A-Za-z0-9_]*+)[ \t]*+\{")
_VARIABLE = re.compile(r"([A-Za-z_][A-Za-z0-9_.]*+)[ \t]*+=[ \t]*+(.*+)")
_LOOK_UP = re.compile(r"([^ \t:{}=]++)[ \t]*+:[ \t]*+([^ \t:{}=]++)")
_TOKEN = re.compile(r"[^\s{}=]++")
_ENTRY = "MATERIAL_ENTRY"


@dataclass(frozen=True)
class Section:
    # A section of the tag format.
    name: str  # Text before the bracket
    # Pairs of key and value, and sections, in the order of the file
    items: "tuple[tuple[str, str] | Section, ...]" = ()

    def get(self, key: str) -> str | None:
        # Return the value of a key, None without one.
        return next((item[1] for item in self.items if isinstance(item, tuple) and item[0] == key), None)

    def section(self, name: str) -> "Section | None":
        # Return the section of a name, None without one.
        return next((item for item in self.sections() if item.name == name), None)

    def sections(self) -> "Iterator[Section]":
        # Yield the inner sections.
        return (item for item in self.items if isinstance(item, Section))


@dataclass(frozen=True)
class Material:
    """An entry of a material list."""

    id: str  # ID of the material in geometry files
    name: str  # Name for readers
    entry: Section  # Complete entry of the file

    @property
    def emissivity_file(self) -> str | None:
        # Path of the emissivity file, as written; not opened. That of a BRDF includes its coat.
        return self._property("EMISSIVITY_PROP", "FILENAME") or self._property(
            "REFLECTANCE_PROP", "EMISSIVITY_FILE"
        )

    @property
    def reflectance_file(self) -> str | None:
        # Path of the two-column reflectance file, as written.
        return self._property("REFLECTANCE_PROP", "TXT_FILENAME")

    def _property(self, section: str, key: str) -> str | None:
        surface = self.entry.section("SURFACE_PROPERTIES")
        properties = surface.section(section) if surface else None
        return properties.get(key) if properties else None


def read_materials(path: str | os.PathLike[str]) -> tuple[Material, ...]:
    # Read a material list.
    #
    # Raises `FormatError`: The file cannot be read; brackets or lines are not of the tag format; keys or
    # sections occur twice; a material has no ID or name, or the ID of another material; a solver or property
    # has a name but no section; SPECULAR_FRACTION is not 0 to 1. All are listed.
    data = read_limited_text(Path(path), MAX_MAT_BYTES, "a DIRSIG material list", MAX_LINES)
    with Problems(f"{os.fspath(path)} is not a DIRSIG material list", FormatError) as problems:
        top = _sections(decoded_text(data), problems)
    materials = []
    for entry in (section for section in top if section.name == _ENTRY):
        # DIRSIG 3 wrote MATERIAL_ID and MATERIAL_NAME
        token, name = (entry.get(key) or entry.get(f"MATERIAL_{key}") or "" for key in ("ID", "NAME"))
        materials.append(Material(token, name, entry))
        if len(problems) < _MAX_SHOWN:
            fraction = materials[-1]._property("EMISSIVITY_PROP", "SPECULAR_FRACTION")
            for is_wrong, found, expected, code in (
                (not _TOKEN.fullmatch(token), " has no ID", "an ID without blanks", "id-missing"),
                (not name, " has no NAME", "", "name-missing"),
                *((True, f": {fault}", "", code) for fault, code in _section_problems(entry)),
                (
                    fraction is not None
                    and not all(0.0 <= share <= 1.0 for share in numbers([fraction]) or [-1.0]),
                    f": SPECULAR_FRACTION = {(fraction or '')[:40]!r}",
                    "0 to 1",
                    "value-out-of-range",
                ),
            ):
                if is_wrong:
                    subject = f"material {len(materials)} ({token[:40]!r})"
                    problems.add(f"{subject}{found}", expected=expected, code=code)
    counts = Counter(material.id for material in materials)
    problems.extend(
        Problem(f"ID {token[:40]!r} occurs twice", expected="distinct IDs", code="id-duplicate")
        for token in [token for token, count in counts.items() if count > 1][:_MAX_SHOWN]
    )
    problems.raise_if_any(
        (not top, Problem("there is no section", expected=f"{_ENTRY} {{ ... }}", code="section-missing")),
    )
    return tuple(materials)


def _sections(text: str, problems: Problems) -> list[Section]:
    # name, first line and content of the open sections, innermost last
    opened: list[tuple[str, int, list[Any]]] = [("", 0, [])]
    for at, raw in enumerate(text.split("\n"), start=1):
        line = raw.strip(" \t\r")
        name, _, items = opened[-1]
        if not line:
            continue
        if line == "}" and len(opened) > 1:
            opened.pop()
            opened[-1][2].append(Section(name, tuple(items)))
        elif (heading := _OPENED.fullmatch(line)) and len(opened) <= _MAX_DEPTH:
            opened.append((heading[1], at, []))
        elif name and (pair := _VARIABLE.fullmatch(line) or (name == "LUT" and _LOOK_UP.fullmatch(line))):
            items.append((pair[1], pair[2]))
        else:
            expected = "'NAME {', '}'" + (" or 'KEY = value'" if len(opened) > 1 else "")
            if line == "}":
                expected = "no bracket, since no section is open"
            elif len(opened) > _MAX_DEPTH:
                expected = f"sections at most {_MAX_DEPTH} deep"
            problems.add(f"line {at}: {line[:60]!r}", expected=expected, code="row-unreadable")
            if len(problems) >= _MAX_SHOWN:
                return []
    problems.extend(
        Problem(f"line {at}: section {name} is not closed", expected="a line '}'", code="section-open")
        for name, at, _ in opened[1:][:_MAX_SHOWN]
    )
    return opened[0][2]


def _section_problems(section: Section) -> Iterator[tuple[str, str]]:
    keys = Counter(item.name if isinstance(item, Section) else item[0] for item in section.items)
    inside = {item.name for item in section.sections()}
    for key, count in keys.items():
        if count > 1:
            yield f"{key} occurs twice in {section.name}", "key-duplicate"
    for key in sorted(keys.keys() - inside):
        name = key.removesuffix("_NAME")
        if name != key and name.endswith(("_SOLVER", "_PROP")) and name not in inside:
            yield f"{key} without a section {name}", "section-missing"
    for item in section.sections():
        yield from _section_problems(item)


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
    pairs: list[tuple[str, str]] = []
    keys = set()
    for item, following in zip(section.items, (*section.items[1:], None), strict=False):
        # the name of a solver or property is written directly before its section, after a blank line
        is_name = (
            isinstance(item, tuple) and isinstance(following, Section) and item[0] == f"{following.name}_NAME"
        )
        if is_name or isinstance(item, Section):
            yield from _aligned(pairs, indent)
            pairs = []
        if is_name or (isinstance(item, Section) and f"{item.name}_NAME" not in keys):
            yield ""
        if isinstance(item, Section):
            yield from _lines(item, indent + "    ")
        else:
            pairs.append(item)
            keys.add(item[0])
    yield from _aligned(pairs, indent)
    yield f"{indent}}}"


def _aligned(pairs: Sequence[tuple[str, str]], indent: str) -> list[str]:
    width = max((len(key) for key, _ in pairs), default=0)
    return [f"{indent}    {key:<{width}} = {value}" for key, value in pairs]
