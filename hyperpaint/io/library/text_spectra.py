"""Text files of spectra: bounded reading, lines and numbers."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import FormatError, Problems
from hyperpaint.io.files.reading import decoded_text, read_limited_text

__all__ = ["in_nanometres", "lines_of", "number", "numbers_of_lines", "wavelength_factor"]

MOST_BYTES = 32 * 2**20
"""Bytes of a text file that is read whole: 100,000 bands of 30 spectra."""

_MOST_SHOWN = 5
_BREAK = re.compile(r"\r\n|\r|\n")
_MICROMETRE = re.compile(r"\b(?:um|micromet(?:er|re)s?|microns?)\b|[µμ]m\b", re.IGNORECASE)
_NANOMETRE = re.compile(r"\b(?:nm|nanomet(?:er|re)s?)\b", re.IGNORECASE)
_OTHER = re.compile(r"\b(?:wave ?numbers?|cm\^?-1|1/cm|angstroms?|[GT]Hz)\b", re.IGNORECASE)


def lines_of(path: Path, expected: str) -> list[str]:
    """Return the lines of a text file, in UTF-8 or else latin-1.

    Raises FormatError: The file cannot be read, is too large, or is no text.
    """
    raw = read_limited_text(path, MOST_BYTES, expected)
    if b"\0" in raw:
        raise FormatError(f"{path}: holds NUL bytes, expected {expected}; UTF-16 text must be saved as UTF-8")
    return _BREAK.split(decoded_text(raw))


def number(text: str) -> float | None:
    """Return a number, NaN of an empty cell, None of anything else.

    Unlike float(), takes neither underscores, other scripts' digits, nor infinities.
    """
    text = text.strip()
    if not text:
        return float("nan")
    if len(text) > 64 or not text.isascii() or "_" in text:
        return None
    try:
        value = float(text)
    except ValueError:
        return None
    return None if value in (float("inf"), float("-inf")) else value


def numbers_of_lines(lines: list[str], first: int, columns: int, source: str) -> Floats:
    """Return lines of blank-separated numbers, (line, column); empty lines are passed over.

    first: Index of the first line of numbers.
    columns: Numbers of each line.
    Raises FormatError: Lines hold something else; the first are listed.
    """
    problems = Problems(f"{source} cannot be read", FormatError)
    rows = []
    for at, line in enumerate(lines[first:], first + 1):
        cells = line.split(None, columns)
        if not cells:
            continue
        row = [number(cell) for cell in cells]
        if len(row) != columns or None in row:
            problems.add(f"line {at}: {line.strip()[:60]!r}, expected {columns} number{'s'[: columns - 1]}")
            if len(problems) == _MOST_SHOWN:
                break
        else:
            rows.append(row)
    problems.raise_if_any()
    return np.array(rows, np.float64).reshape(-1, columns)


def in_nanometres(values: Floats, factor: float) -> Floats:
    """Return wavelengths [nm]; those of a damaged file may become infinite, which is refused later."""
    with np.errstate(over="ignore"):
        nanometres: Floats = values * factor
    return nanometres


def wavelength_factor(text: str, wavelength: Floats, source: str) -> tuple[float, str]:
    """Return the nanometres of one unit of the wavelengths, and a note where that is inferred.

    text: What the file says of its wavelengths; may be empty.
    wavelength: Their numbers.
    Raises FormatError: They are no wavelengths, but wavenumbers, say.
    """
    if _MICROMETRE.search(text):
        return 1e3, ""
    if _NANOMETRE.search(text):
        return 1.0, ""
    if other_unit := _OTHER.search(text):
        raise FormatError(f"{source}: x in {other_unit[0]!r}, expected nm or um; pass wavelength=")
    if wavelength.size and float(np.nanmax(wavelength)) < 100.0:
        return 1e3, "no wavelength units: values below 100 taken as micrometres"
    return 1.0, "no wavelength units: values taken as nanometres"
