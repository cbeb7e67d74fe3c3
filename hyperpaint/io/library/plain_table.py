"""Spectra side by side in a plain text table: wavelengths in the first column, a spectrum in each other."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hyperpaint.base.arrays import Floats, Ints
from hyperpaint.base.errors import FormatError
from hyperpaint.io.files.reading import numbers

from .column_quantities import IS_SPREAD, check_words, spread_columns, without_repeats
from .library_spectra import Spectra, reflectances
from .text_spectra import PERCENT, in_nanometres, lines_of, numbers_of_lines, wavelength_factor

_MAX_PREAMBLE = 500
_GENERIC = re.compile(r"|r|rho|y|values?|.*(?:reflect|average|mean).*", re.IGNORECASE)

#: Units in headings are removed from names of paints, which are paired with references by name.
_UNIT = re.compile(r"\s*[(\[]\s*(?:%|per ?cent|fraction|-|1)\s*[)\]]\s*$", re.IGNORECASE)


@dataclass(frozen=True)
class _Dialect:
    # Separator and decimal mark of a table; an empty separator stands for blanks.
    separator: str
    comma: bool

    def cells(self, line: str) -> list[str]:
        return line.split(self.separator) if self.separator else line.split()

    def row(self, line: str) -> list[float] | None:
        # The numbers of a line, None for any other line; the first cell must not be empty.
        cells = self.cells(line.strip(" "))
        if len(cells) < 2 or not cells[0].strip():
            return None
        return numbers(cell.replace(",", ".") if self.comma else cell for cell in cells)


_DIALECTS = (
    _Dialect("\t", False),
    _Dialect(";", False),
    _Dialect(",", False),
    _Dialect("", False),
    _Dialect("\t", True),
    _Dialect(";", True),
    _Dialect("", True),
)


def read_plain_table(
    path: Path, *, scale: float | None = None, wavelength: Floats | None = None, is_reflectance: bool = False
) -> Spectra:
    """Read spectra from a table of two or more columns.

    Cells are separated by commas, semicolons, tabs or blanks; decimal commas are understood where no comma
    separates. Lines above the numbers are headings, the last of them names the columns; lines that begin with
    ``#`` are comments. Where there is one spectrum and its heading says no more than "reflectance", it has
    the name of the file. A column whose heading says so is the standard deviation of the one before it.

    scale: Value of a reflectance of one; by default 100 where the headings say percent, else 1.
    wavelength: To be used in place of the first column [nm].
    is_reflectance: The values are reflectance, without a check of headings and values.
    Raises FormatError: There is no table of numbers, or its first column holds no wavelengths, or the values
        are no reflectance.
    Warns PaintWarning: Wavelengths stand twice in a row; or a column is a standard deviation by its values.
    """
    source = path.name
    lines = lines_of(path, "a table of wavelengths and reflectance")
    first, dialect, columns = _beginning(lines, source)
    written = ["" if line.lstrip().startswith("#") else line for line in lines]
    table = numbers_of_lines(written, first, columns, source, dialect.row)
    if columns > 2 and np.isnan(table[:, -1]).all():  # every line ends with a separator
        table, columns = table[:, :-1], columns - 1
    _check_order(table[:, 0], source)
    preamble = lines[:first]
    headings = _headings(preamble, dialect, columns)
    preamble_text = " ".join(preamble)
    if not is_reflectance:
        check_words(preamble, headings, source)
    factor, note = wavelength_factor(preamble_text, table[:, 0], source)
    percent = 100.0 if PERCENT.search(preamble[-1] if preamble else "") else None
    nm, values, notes = table[:, 0], table[:, 1:], [note] if note else []
    if wavelength is None:
        nm, values, repeats = without_repeats(nm, values, source)
        notes += repeats
    spread = spread_columns(headings, values.T, source, is_reflectance=is_reflectance)
    names = _names(headings, spread, path.stem)
    paints = np.flatnonzero(spread != IS_SPREAD)
    reflectance = reflectances(
        values.T[paints], source, file_scale=percent, scale=scale, is_reflectance=is_reflectance
    )
    others = {}
    if (spread >= 0).any():
        sd = reflectances(values.T[spread[paints]], source, file_scale=percent or 1.0, scale=scale)
        others["reflectance_sd"] = np.where(spread[paints, None] >= 0, sd, np.float32(np.nan))
    return Spectra(
        source=source,
        form="table of text",
        names=names,
        wavelength=in_nanometres(nm, factor) if wavelength is None else wavelength,
        reflectance=reflectance,
        others=others,
        notes=notes,
    )


def _beginning(lines: Sequence[str], source: str) -> tuple[int, _Dialect, int]:
    # The index of the first line of numbers, its dialect, and the number of columns.
    shown = [at for at, line in enumerate(lines) if line.strip() and not line.lstrip().startswith("#")]
    for position, at in enumerate(shown[:_MAX_PREAMBLE]):
        rows = [(dialect, row) for dialect in _DIALECTS if (row := dialect.row(lines[at])) is not None]
        if rows and position + 1 < len(shown):
            following = lines[shown[position + 1]]
            fitting = [d for d, row in rows if len(d.row(following) or ()) == len(row)]
            # where the next line fits none, it is reported: no line of numbers is taken for a heading
            dialect = fitting[0] if fitting else rows[0][0]
            return at, dialect, next(len(row) for d, row in rows if d == dialect)
    raise FormatError(
        f"{source}: no table of numbers",
        expected="a wavelength and one or more values a line",
        code="table-missing",
    )


def _check_order(wavelength: Floats, source: str) -> None:
    # Refuse a first column that changes direction more often than detectors join.
    steps = np.diff(wavelength)
    back = min(int((steps < 0).sum()), int((steps > 0).sum()))
    if np.isnan(wavelength).any() or back > max(4, steps.size // 20) or not steps.any():
        raise FormatError(
            f"{source}: the first column rises and falls",
            expected="wavelengths",
            mend="spectra belong in columns",
            code="wavelength-unordered",
        )


def _names(headings: Sequence[str], spread: Ints, stem: str) -> list[str]:
    paints = np.flatnonzero(spread != IS_SPREAD)
    names = [headings[at + 1].strip() for at in paints.tolist()] if headings else []
    without_units = [_UNIT.sub("", name) for name in names]
    if len(set(without_units)) == len(set(names)):
        names = without_units
    if paints.size == 1:
        return [stem if not names or _GENERIC.fullmatch(names[0]) else names[0]]
    names = names or [""] * paints.size
    return [name or f"column {at + 2}" for at, name in zip(paints, names, strict=True)]


def _headings(preamble: Sequence[str], dialect: _Dialect, columns: int) -> list[str]:
    # The cells of the last heading; empty where their number is not that of the columns.
    last = next((line for line in reversed(preamble) if line.strip()), "")
    text = last.strip().lstrip("#")
    # a heading in a comment may have commas although another mark separates the numbers
    separators = [dialect.separator, ","] if last.lstrip().startswith("#") else [dialect.separator]
    for separator in separators:
        try:
            cells = next(csv.reader([text], delimiter=separator)) if separator else text.split()
        except csv.Error:
            continue
        if len(cells) == columns + 1 and not cells[-1].strip():
            cells.pop()
        if len(cells) == columns or (len(cells) > columns and last.lstrip().startswith("#") and separator):
            return cells[:columns]
    return []
