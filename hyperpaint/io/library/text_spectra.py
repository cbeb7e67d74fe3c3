"""Text files of spectra: bounded reading, lines and numbers."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import FormatError, Problems
from hyperpaint.io.files.reading import decoded_text, numbers, read_limited_text

#: Largest text file [bytes]: 100,000 bands of 30 spectra.
MAX_BYTES = 32 * 2**20

_MAX_SHOWN = 5
_BREAK = re.compile(r"\r\n|\r|\n")
_MICROMETRE = re.compile(r"\b(?:um|micromet(?:er|re)s?|microns?)\b|[µμ]m\b", re.IGNORECASE)
_NANOMETRE = re.compile(r"\b(?:nm|nanomet(?:er|re)s?)\b", re.IGNORECASE)
PERCENT = re.compile(r"percent|%", re.IGNORECASE)
_OTHER_QUANTITY = re.compile(r"radianc\w*|transmi|emissiv|absorb|\bcounts?\b|\bDN\b", re.IGNORECASE)
_OTHER = re.compile(r"\b(?:wave ?numbers?|cm\^?-1|1/cm|angstroms?|[GT]Hz)\b", re.IGNORECASE)


def lines_of(path: Path, expected: str) -> list[str]:
    """Return the lines of a text file, in UTF-8 or else latin-1.

    Raises FormatError: The file cannot be read, is too large, or is binary.
    """
    raw = read_limited_text(path, MAX_BYTES, expected)
    if b"\0" in raw:
        raise FormatError(
            f"{path}: holds NUL bytes",
            expected=expected,
            mend="save UTF-16 text as UTF-8",
            code="text-unreadable",
        )
    return _BREAK.split(decoded_text(raw))


def numbers_of_lines(
    lines: Sequence[str],
    first_line: int,
    columns: int,
    source: str,
    numbers_of: Callable[[str], list[float] | None] | None = None,
) -> Floats:
    """Return lines of numbers as an array (line, column); empty lines are skipped.

    first_line: Index of the first line of numbers.
    columns: Number of columns.
    numbers_of: Function that returns the numbers of a line, None for other text; by default numbers are
        separated by blanks.
    Raises FormatError: Lines contain other text; the first of them are listed.
    """
    problems = Problems(f"{source} cannot be read", FormatError)
    rows = []
    for at, line in enumerate(lines[first_line:], first_line + 1):
        if not line.strip():
            continue
        row = numbers_of(line) if numbers_of else numbers(line.split(None, columns))
        if row is None or len(row) != columns:
            problems.add(
                f"line {at}: {line.strip()[:60]!r}",
                expected=f"{columns} number{'s'[: columns - 1]}",
                code="row-unreadable",
            )
            if len(problems) == _MAX_SHOWN:
                break
        else:
            rows.append(np.array(row, np.float64))
    problems.raise_if_any()
    return np.array(rows, np.float64).reshape(-1, columns)


def in_nanometres(values: Floats, factor: float) -> Floats:
    """Return wavelengths [nm]; overflow of a damaged file becomes infinity, a later error."""
    with np.errstate(over="ignore"):
        nanometres: Floats = values * factor
    return nanometres


def other_quantity(text: str) -> str:
    """Return the word for another quantity than reflectance, empty if there is none."""
    match = _OTHER_QUANTITY.search(text)
    return match[0] if match and "reflect" not in text.lower() else ""


def wavelength_factor(text: str, wavelength: Floats, source: str) -> tuple[float, str]:
    """Return the factor from the wavelengths' unit to nanometres, and a note if the unit is inferred.

    text: Description of the wavelengths in the file; may be empty.
    wavelength: Wavelengths in the file's unit.
    Raises FormatError: The text names another unit, such as wavenumbers.
    """
    if _MICROMETRE.search(text):
        return 1e3, ""
    if _NANOMETRE.search(text):
        return 1.0, ""
    if other_unit := _OTHER.search(text):
        raise FormatError(
            f"{source}: the unit of the first column is {other_unit[0]!r}",
            expected="nm or um",
            mend="pass wavelength=",
            code="units-unknown",
        )
    if wavelength.size and float(np.nanmax(wavelength)) < 100.0:
        return 1e3, "no wavelength units: values below 100 taken as micrometres"
    return 1.0, "no wavelength units: values taken as nanometres"
