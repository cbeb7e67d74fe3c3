"""Paint libraries as comma-separated values with their metadata beside them.

Every row is a spectrum: name of the paint, its properties (one column each), then reflectance. The first row
has the names of the columns, and the wavelengths [nm]; the metadata have the units. EcoSIS accepts such
tables. A library with further spectra beside the centres has two more columns after the name: ``variable``
(``reflectance``, ``member_reflectance``, ...) and ``place``, the number, from 1, of a spectrum of which a
paint has several.
"""

from __future__ import annotations

import contextlib
import csv
import io
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
import xarray as xr

from hyperpaint.base.arrays import Floats32
from hyperpaint.base.errors import FormatError, Problems
from hyperpaint.base.input_files import open_input
from hyperpaint.base.old_names import NEW_NAMES
from hyperpaint.base.schema import BAND, SIGNATURE
from hyperpaint.io.files.reading import number, numbers, safe_cell, text_of_cell

from .library_spectra import MIN_NM, check_wavelengths
from .records import CENTRE, Block, Key, restored, spectral_variables, table_columns

#: Headings of the names; hyperpaint 0.2 and before wrote the second.
_NAMES = (SIGNATURE, "paint")
#: Headings of the two columns that identify a spectrum of a paint.
_KEY_COLUMNS = ["variable", "place"]
#: Number of a spectrum of a paint, empty for the only one.
_PLACE = re.compile(r"|[1-9][0-9]{0,8}")
_MAX_BANDS = 100_000
_MAX_BYTES = 2**32
_MAX_SHOWN = 5


def is_csv_library(head: str) -> bool:
    # Return whether a text begins as a paint library: names, then wavelengths, in its first row.
    row, end, _ = head.partition("\n")
    cells = row.strip("\r").split(",")
    nm = number(cells[-1 if end else -2]) if len(cells) > 2 else None  # the head may cut off the last cell
    heading = next(filter(None, cells[:2]), "")  # the second cell after an index of pandas
    return heading in _NAMES and nm is not None and nm >= MIN_NM


# --- writing -----------------------------------------------------------------------------------------------


def write_csv_library(library: xr.Dataset, names: Sequence[str], blocks: Iterable[Block], path: Path) -> None:
    # Write the records of a checked library.
    # Values have nine digits, which restore every bit of float32. A file with characters beyond ASCII begins
    # with the byte order mark by which Excel recognises UTF-8. Names and texts that a spreadsheet would
    # execute as formulas have a leading apostrophe, which the reader removes.
    columns = table_columns(library)
    key_columns = [] if spectral_variables(library) == [CENTRE] else _KEY_COLUMNS
    head = _line(
        [
            SIGNATURE,
            *key_columns,
            *map(safe_cell, columns),
            *(repr(float(value)) for value in library["wavelength"].values),
        ]
    )
    lines = [_line([safe_cell(name)]) for name in names]
    properties = [
        _line(["", *map(safe_cell, map(str, cells))]) for cells in zip(*columns.values(), strict=True)
    ] or [""] * len(lines)
    coding = "utf-8" if "".join([head, *lines, *properties]).isascii() else "utf-8-sig"
    row = ",%.9g" * library.sizes[BAND] + "\n"
    with open(path, "w", encoding=coding, newline="") as file:
        file.write(head + "\n")
        for variable, *records in blocks:
            for paint, inner, values in zip(*records, strict=True):
                key = f",{variable},{'' if inner < 0 else inner + 1}" if key_columns else ""
                file.write(lines[paint] + key + properties[paint] + row % tuple(values.tolist()))


def _line(cells: list[str]) -> str:
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="").writerow([*cells, ""])
    return buffer.getvalue()[:-1]


# --- reading -----------------------------------------------------------------------------------------------


def read_csv_library(path: Path) -> xr.Dataset:
    # Read a library that `write_csv_library` wrote.
    # Raises FormatError: The table or its metadata are damaged, or belong to different libraries. Warns
    # PaintWarning: The metadata are missing.
    source = path.name
    problems = Problems(f"{source} cannot be read", FormatError)
    # the first row: headings, then wavelengths
    cells = _cells(path)
    first_row = next(cells, [])
    if first_row[:1] == [""]:
        first_row, cells = first_row[1:], _without_index(cells, source)
    head_size = len(first_row)
    while head_size and number(first_row[head_size - 1]) is not None:
        head_size -= 1
    head, nm = first_row[:head_size], numbers(first_row[head_size:]) or []
    is_valid = all(name.isidentifier() for name in head) and len(set(head)) == len(head)
    if not head or head[0] not in _NAMES or not is_valid or not 0 < len(nm) <= _MAX_BANDS:
        raise FormatError(
            f"{source}: the first row is {','.join(first_row)[:60]!r}",
            expected=f"{SIGNATURE}, distinct column names, and wavelengths",
            code="header-unreadable",
        )
    if head[0] != SIGNATURE:
        head = [NEW_NAMES.get(name, name) for name in head]
    has_keys = head[1:3] == _KEY_COLUMNS
    first_property = 3 if has_keys else 1
    # every further row is a spectrum
    names: list[str] = []
    columns: dict[str, list[str]] = {text_of_cell(name): [] for name in head[first_property:]}
    keys: list[Key] = []
    rows: list[Floats32] = []
    # the order of the rows distinguishes paints of the same name: numbers of the paints of a name; and, by
    # name and variable, the position of the paint of the last row among them, and its number in this paint
    paints: dict[str, list[int]] = {}
    last: dict[tuple[str, str], tuple[int, int]] = {}
    for number_of_row, row in enumerate(cells, 2):
        row[:head_size] = map(text_of_cell, row[:head_size])
        values = _values(row[head_size:], len(nm))
        name, variable, place = row[:3] if has_keys and len(row) > 2 else (row[0], CENTRE, "")
        place = place.removesuffix(".0")  # pandas writes integers as floats where some cells are empty
        key: Key | None = None
        if variable == CENTRE and not place:
            key = (CENTRE, len(names), -1)
        elif variable.isidentifier() and _PLACE.fullmatch(place):
            inner = int(place or 0) - 1
            position, last_inner = last.get((name, variable), (0, -2))
            position += inner <= last_inner  # the numbers start again: the next paint of that name
            last[name, variable] = (position, inner)
            same_name = paints.get(name, [])
            key = (variable, same_name[position], inner) if position < len(same_name) else None
        if values is None or key is None:
            problems.add(
                f"row {number_of_row}: {','.join(row)[:60]!r}",
                expected=f"{', '.join(head)[:60]}, and {len(nm)} numbers",
                code="row-unreadable",
            )
            if len(problems) == _MAX_SHOWN:
                break
            continue
        if key[0] == CENTRE:
            paints.setdefault(name, []).append(len(names))
            names.append(name)
            for column, cell in zip(columns.values(), row[first_property:], strict=False):
                column.append(cell)
        keys.append(key)
        rows.append(values)
    problems.raise_if_any()
    wavelength = np.array(nm, np.float64)
    check_wavelengths(wavelength, source)
    if not names:
        raise FormatError(
            f"{source}: no row of {CENTRE!r}", mend="write the library again", code="variable-missing"
        )
    return restored(path, names, keys, {"wavelength": wavelength}, [(0, np.array(rows, np.float32))], columns)


def _cells(path: Path) -> Iterator[list[str]]:
    try:
        opened = open_input(path, "a paint library", _MAX_BYTES)
        with io.TextIOWrapper(opened, encoding="utf-8-sig", newline="") as file:
            yield from filter(None, csv.reader(file, strict=True))
    except (csv.Error, UnicodeDecodeError, OSError) as error:
        raise FormatError(f"{path.name} cannot be read: {error!s:.200}", code="file-unreadable") from error


def _without_index(rows: Iterator[list[str]], source: str) -> Iterator[list[str]]:
    # Rows without the unnamed index column of pandas
    for number_of_row, row in enumerate(rows):
        if row[0] != str(number_of_row):
            raise FormatError(
                f"{source}: the first column has no name and holds {row[0][:30]!r}",
                expected=f"{SIGNATURE} as the first column, or the row numbers of pandas before it",
                mend="write it with to_csv(index=False)",
                code="column-name-missing",
            )
        yield row[1:]


def _values(cells: list[str], bands: int) -> Floats32 | None:
    # Numbers of a row; None where a cell is not a number or the count is wrong
    row_numbers = None
    text = "".join(cells)
    if text.isascii() and "_" not in text and len(text) <= 64 * len(cells):
        with contextlib.suppress(ValueError):  # such as an empty cell
            row_numbers = list(map(float, cells))  # several times faster than `numbers`
    row_numbers = row_numbers or numbers(cells)
    if row_numbers is None or len(cells) != bands:
        return None
    with np.errstate(over="ignore"):
        values = np.array(row_numbers, np.float64).astype(np.float32)
    return None if np.isinf(values).any() else values
