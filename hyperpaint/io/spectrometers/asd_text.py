"""Text exports of ASD spectra, as ViewSpec writes them.

Known variants: a table ``Wavelength;name.asd`` whose cells are separated by semicolons, tabs or commas, with
one column or (exported by rows) one row for each spectrum, with or without a preamble of sentences. The
preamble may contain the comment field as NUL bytes, a blank first line and undocumented sentences. No variant
contains the quantity, its units, or the UTC offset of the time stamp.
"""

from __future__ import annotations

import datetime as dt
import math
import os
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from hyperpaint.base.errors import FormatError
from hyperpaint.io.files.reading import read_limited_text

from .asd_binary import nominal_integration_ms

_MAX_BYTES = 512 * 2**20
_SEPARATORS = (";", "\t", ",")
_NUMBER = r"([-+]?[0-9]+(?:\.[0-9]*)?(?:[Ee][-+]?[0-9]+)?)"
_TABLE = re.compile(r'"?wavelengths?"?\s*[;,\t]', re.IGNORECASE)
# NaN and infinity as Windows' C library prints them
_NON_FINITE_SPELLINGS = {"1.#qnan": math.nan, "-1.#ind": math.nan, "1.#ind": math.nan, "1.#inf": math.inf}


@dataclass(frozen=True, eq=False)
class AsdText:
    """Content of one text export; arrays are float64 and read-only."""

    name: str  # file name without its folder
    spectra: tuple[str, ...]  # names of the spectra
    wavelength: npt.NDArray[np.float64]  # (wavelength) [nm]
    values: npt.NDArray[np.float64]  # (spectrum, wavelength), in the exported quantity
    # Local time of the logging PC when it saved the spectrum; None without a preamble
    local_time: dt.datetime | None
    # As in binary files; None if not in the preamble
    instrument_number: str | None
    integration_ms: float | None
    sample_averages: int | None
    ymax: float | None  # upper end of the operator's plot, the only hint at the quantity
    splices: tuple[float, float] | None
    # Whether a cosine receptor was attached, and whether a white reference was measured; or None
    cosine_receptor: bool | None
    white_reference: bool | None

    @property
    def likely_quantity(self) -> str | None:
        """Quantity guessed from ``ymax``."""
        return {1.25: "reflectance", 2.5: "irradiance", 65535.0: "counts"}.get(self.ymax or 0.0)


def is_asd_text(head: bytes) -> bool:
    """Return whether the first bytes of a file are a text export of ASD spectra."""
    return any(_TABLE.match(line) for line in _lines(head))


def read_asd_text(path: str | os.PathLike[str]) -> AsdText:
    r"""Read one text export of ASD spectra.

    path: A file that ViewSpec exported, of any of its variants.
    Returns AsdText: Spectra (spectrum, wavelength) and the fields of the preamble.
    Raises FormatError: The file cannot be read, or has no table ``Wavelength``, or its table is damaged.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp(), "sky.txt")
    >>> _ = path.write_text("Wavelength;sky.asd\n550; 0.89 \n551; 9.1E-01 \n")
    >>> read_asd_text(path).values
    array([[0.89, 0.91]])
    """
    path = Path(path)
    lines = _lines(read_limited_text(path, _MAX_BYTES, "a text export of spectra"))
    start = next((i for i, line in enumerate(lines) if _TABLE.match(line)), None)
    if start is None:
        raise FormatError(
            f"{path.name}: no line begins with 'Wavelength' and a separator",
            expected="a text export of ASD spectra",
            code="format-unknown",
        )
    spectra, wavelength, values = _table(path.name, lines[start:])
    return AsdText(path.name, spectra, wavelength, values, **_preamble(path.name, "\n".join(lines[:start])))


def _lines(data: bytes) -> list[str]:
    return data.replace(b"\0", b"").decode("latin-1").replace("\r\n", "\n").replace("\r", "\n").split("\n")


def _preamble(name: str, text: str) -> dict[str, Any]:
    def parsed(pattern: str, make: Callable[[re.Match[str]], Any]) -> Any:
        match = re.search(pattern, text, re.IGNORECASE)
        return None if match is None else make(match)

    return {
        "local_time": parsed(
            r"spectrum saved:?\s*(\d{1,2})/(\d{1,2})/(\d{1,4})\s+at\s+(\d{1,2}):(\d\d):(\d\d)\s*([AP]M)?",
            lambda match: _local_time(name, match),
        ),
        "instrument_number": parsed(r"instrument number(?: was|:)\s*(\S{1,40})", lambda match: match[1]),
        "integration_ms": parsed(
            r"VNIR integration time\s*:\s*(\d{1,9})(?!\d)",
            lambda match: nominal_integration_ms(int(match[1])),
        ),
        "sample_averages": parsed(
            r"\b(\d{1,6}|one) samples? per data value",
            lambda match: 1 if match[1].lower() == "one" else int(match[1]),
        ),
        "ymax": parsed(rf"ymax\s*=\s*{_NUMBER}", lambda match: float(match[1])),
        "splices": parsed(
            rf"join between VNIR and SWIR1 was {_NUMBER} nm(?s:.){{0,200}}?SWIR1 and SWIR2 was {_NUMBER} nm",
            lambda match: (float(match[1]), float(match[2])),
        ),
        "cosine_receptor": parsed(
            r"there was (.{0,80}?) attached", lambda match: "cosine receptor" in match[1].lower()
        ),
        "white_reference": parsed(
            r"data is (not )?compared to a white reference", lambda match: match[1] is None
        ),
    }


def _local_time(name: str, match: re.Match[str]) -> dt.datetime:
    month, day, year, hour, minute, second = (int(match[i]) for i in range(1, 7))
    if match[7]:
        hour = hour % 12 + (12 if match[7].upper() == "PM" else 0)
    try:
        # older programs write years since 1900
        stamp = dt.datetime(year + 1900 if year < 1000 else year, month, day, hour, minute, second)
        if not 1980 <= stamp.year < 2150:
            raise ValueError
        return stamp
    except ValueError as error:
        raise FormatError(
            f"{name}: {match[0]!r} is not a date", expected="month/day/year", code="time-unreadable"
        ) from error


_Table = tuple[tuple[str, ...], npt.NDArray[np.float64], npt.NDArray[np.float64]]


def _table(name: str, lines: list[str]) -> _Table:
    header = lines[0]
    separator = max(_SEPARATORS, key=header.count)
    cells = [cell.strip().strip('"') for cell in header.split(separator)]
    while cells and not cells[-1]:  # a separator at the end of the line
        cells.pop()
    if len(cells) < 2:
        raise FormatError(
            f"{name}: the table has no column beside 'Wavelength'",
            mend="export the spectra again",
            code="column-missing",
        )
    is_spectrum_per_row = all(_cell_number(cell) is not None for cell in cells[1:])
    labels, values = _labelled_rows(name, lines[1:], separator, len(cells), is_row_names=is_spectrum_per_row)
    if is_spectrum_per_row:
        spectra, wavelength = tuple(labels), np.array([_cell_number(cell) for cell in cells[1:]], np.float64)
    else:
        spectra, wavelength = (
            tuple(cells[1:]),
            np.array([_cell_number(label) for label in labels], np.float64),
        )
        values = values.T
    if not (np.all(np.isfinite(wavelength)) and np.all(wavelength > 0) and np.all(np.diff(wavelength) > 0)):
        raise FormatError(
            f"{name}: the wavelengths do not increase",
            mend="export the spectra again",
            code="wavelength-unordered",
        )
    values = np.ascontiguousarray(values)
    wavelength.flags.writeable = values.flags.writeable = False
    return spectra, wavelength, values


def _labelled_rows(
    name: str, lines: list[str], separator: str, cell_count: int, *, is_row_names: bool
) -> tuple[list[str], npt.NDArray[np.float64]]:
    # Return the first cell of each row, and the numbers in its other cells.
    # Lines of another kind, such as ``x2bar``, may precede and follow the rows of wavelengths, but not
    # interrupt them.
    labels: list[str] = []
    values: list[list[float]] = []
    table_end: int | None = None
    for line_number, line in enumerate(lines, start=2):
        cells = [cell.strip() for cell in line.rstrip().rstrip(separator).split(separator)]
        row = [_cell_number(cell) for cell in cells[1:]]
        row_values = [value for value in row if value is not None]
        if not (line.strip() and (is_row_names or _cell_number(cells[0]) is not None)):
            table_end = table_end or (line_number if labels and line.strip() else None)
            continue
        if len(cells) != cell_count or len(row_values) != len(row) or table_end is not None:
            raise FormatError(
                f"{name}: line {line_number} of the table holds {line.strip()[:60]!r}",
                expected=f"{cell_count} cells separated by {separator!r}",
                mend="export the spectra again",
                code="row-unreadable",
            )
        labels.append(cells[0])
        values.append(row_values)
    if not labels:
        raise FormatError(
            f"{name}: the table is empty", mend="export the spectra again", code="table-missing"
        )
    return labels, np.array(values, np.float64)


def _cell_number(cell: str) -> float | None:
    try:
        # a comma within a cell is a decimal comma; float() would accept 1_000
        return None if "_" in cell else float(cell.replace(",", "."))
    except ValueError:
        return _NON_FINITE_SPELLINGS.get(cell.lower())
