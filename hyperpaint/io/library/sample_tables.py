"""Tables of spectra with properties of the samples: CSV of EcoSIS and R (a row a spectrum), and of SPECCHIO.

A table of EcoSIS has headings of properties, and a heading of each wavelength; one of SPECCHIO is its
transpose: a row for each property, then for each wavelength, and a column for each spectrum.
"""

import contextlib
import csv
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hyperpaint.base.errors import FormatError, Problem, Problems
from hyperpaint.base.schema import BAND, LIBRARY_VARIABLES, SIGNATURE, Bools, Floats
from hyperpaint.io.files.reading import decoded_text, number, numbers, read_limited_text, refuse
from hyperpaint.io.spectrometers.spectrum_texts import NM_HEADING, TIME_HEADING, heading_cells

from .spectra_files import (
    MAX_BYTES,
    MIN_NM,
    PERCENT,
    Spectra,
    in_nanometres,
    other_quantity,
    reflectances,
    text_column,
)

_FIRST_KEYS = ("file name", "spectrum id", "spectrum number")
#: Properties that name a spectrum, by preference.
_NAMES = (
    "spectra", "spectrum", "spectrum name", "sample name", "sample", "sample id", "target name", "file name",
    "name", "id", "spectra id", "title",
)  # fmt: skip
_WAVELENGTH_UNITS = re.compile(r"wave ?lengths? ?units?|x ?units?", re.IGNORECASE)
_VALUE_UNITS = re.compile(r"(?:measurement|reflectance|spectra\w*|y) ?units?", re.IGNORECASE)
_QUANTITY = re.compile(r"(?:measurement )?(?:quantity|type)|measurement", re.IGNORECASE)
_MISSING = {"na", "n/a", "nan", "null", "none", "-"}
_MIN_BANDS, _MAX_CELLS = 3, 4_000_000
_MAX_SHOWN = 5


def is_sample_table(head: str) -> bool:
    # Return whether a text begins as a table of EcoSIS or SPECCHIO.
    lines = [line for line in head.splitlines() if line.strip() and not line.startswith("#")]
    return bool(lines) and (_cells(lines[0])[0].lower() in _FIRST_KEYS or _bands(lines) is not None)


def _bands(lines: Sequence[str]) -> Bools | None:
    # Return which columns of a row a spectrum are wavelengths by their headings; None for other tables.
    cells = _cells(lines[0])
    nm = np.array([np.nan if (value := _nm(cell)) is None else value for cell in cells])
    is_band = np.isfinite(nm)
    steps = np.diff(nm[is_band])
    if is_band[0] or steps.size < _MIN_BANDS - 1 or not ((steps > 0).all() or (steps < 0).all()):
        return None
    # names of spectra may be numbers too, above a first column of wavelengths
    following = _cells(lines[1]) if len(lines) > 1 else [""]
    is_plain = (
        is_band[1:].all() and cells[0] != "" and number(following[0].replace(",", ".") or "-") is not None
    )
    in_um = any(_WAVELENGTH_UNITS.fullmatch(cell) for cell in cells)
    return is_band if not is_plain and (nm[is_band].min() >= MIN_NM or in_um) else None


def _nm(text: str) -> float | None:
    # Return the wavelength of a heading; None for other headings.
    match = NM_HEADING.fullmatch(text.strip())
    return None if match is None else float(match[1].replace(",", "."))


def _cells(line: str) -> list[str]:
    # Return the cells of one line.
    with contextlib.suppress(csv.Error, StopIteration):
        return [cell.strip() for cell in next(csv.reader([line], delimiter=heading_cells(line)[0]))]
    return [""]


def read_sample_table(
    path: Path, *, scale: float | None, wavelength: Floats | None, is_reflectance: bool
) -> Spectra:
    # Read a table of EcoSIS or SPECCHIO; its properties become columns of the library.
    # scale: Stored value of a reflectance of one; by default 100 where units of the table say percent.
    # is_reflectance: Whether values are reflectance, whatever names and values look like.
    # Raises FormatError: Rows have other lengths or cells; the table names another quantity, or is a series
    # of times; all rows are named.
    source = path.name
    text = decoded_text(read_limited_text(path, MAX_BYTES, "a table of spectra"))
    lines = [(n, line) for n, line in enumerate(text.splitlines(), 1) if line.strip() and line[0] != "#"]
    separator = heading_cells(lines[0][1])[0]
    try:
        rows = list(csv.reader([line for _, line in lines], delimiter=separator))
    except csv.Error as error:
        raise FormatError(f"{source}: no table ({error})", code="row-unreadable") from error
    is_band = _bands([line for _, line in lines])
    if is_transposed := is_band is None:
        rows = _transposed(rows, source)
        is_band = np.array([_nm(heading) is not None for heading in rows[0]])
    assert is_band is not None
    bands, others = np.flatnonzero(is_band).tolist(), np.flatnonzero(~is_band).tolist()
    headings, *records = ([cell.strip() for cell in row] for row in rows)
    refuse(
        source,
        (
            TIME_HEADING.fullmatch(headings[0]) is not None and len(others) <= 2,
            Problem(
                "a series of spectra in time", mend="open it with hp.open_irradiance", code="quantity-wrong"
            ),
        ),
        (not records, Problem("no spectra below the headings", code="table-missing")),
        (
            len(records) * len(headings) > _MAX_CELLS,
            Problem(f"{len(records)} spectra", expected="a smaller table", code="file-too-large"),
        ),
    )
    problems = Problems(f"{source} cannot be read", FormatError)
    values = np.full((len(records), len(bands)), np.nan)
    for at, record in enumerate(records):
        is_whole = len(record) == len(headings)
        cells = [record[band] for band in bands] if is_whole else []
        row = numbers("" if cell.lower() in _MISSING else cell.replace(",", ".") for cell in cells)
        if row and is_whole:
            values[at] = row
        elif len(problems) < _MAX_SHOWN:
            place = f"spectrum {at + 1}" if is_transposed else f"line {lines[at + 1][0]}"
            found = f"{place}: {separator.join(record)[:60]!r}"
            expected = f"{len(others)} properties and {len(bands)} numbers"
            problems.add(found, expected=expected, code="row-unreadable")
    problems.raise_if_any()
    properties = {headings[at]: [record[at] for record in records] for at in others}
    units = _shared_words(properties, _WAVELENGTH_UNITS)
    quantity, value_units = _shared_words(properties, _QUANTITY), _shared_words(properties, _VALUE_UNITS)
    names = _names(properties, path, len(records))
    other = next((text for text in (quantity, value_units, *names) if other_quantity(text)), "")
    FormatError.raise_if(
        other and not is_reflectance,
        f"{source}: spectra are {other[:60]!r}",
        expected="reflectance",
        mend="remove them, or pass quantity='reflectance'",
        code="quantity-wrong",
    )
    is_percent = PERCENT.search(value_units) is not None
    # such tables exist in EcoSIS: fractions under a column of units that says percent
    FormatError.raise_if(
        is_percent and scale is None and np.nanmax(values, initial=0.0) <= 1.0,
        f"{source}: units are {value_units[:60]!r}, but values are up to {np.nanmax(values, initial=0.0):g}",
        expected="percent",
        mend="pass scale=1 for fractions, scale=100 for percent",
        code="scale-conflict",
    )
    axis = np.array([_nm(heading) for heading in (headings[band] for band in bands)], np.float64)
    nm, note = in_nanometres(units, axis, source)
    return Spectra(
        source=source,
        form="SPECCHIO table" if is_transposed else "table of one row a spectrum",
        names=names,
        wavelength=nm if wavelength is None else wavelength,
        reflectance=reflectances(
            values,
            source,
            file_scale=100.0 if is_percent else None,
            scale=scale,
            is_reflectance=is_reflectance,
        ),
        columns=_columns(properties),
        notes=[note] if note else [],
    )


def _transposed(rows: Sequence[list[str]], source: str) -> list[list[str]]:
    # Return a table of SPECCHIO as one of a row a spectrum. Its texts may contain commas,
    # so that a row of a property may have more cells than there are spectra.
    bands = sorted(((nm, row) for row in rows if row and (nm := _nm(row[0])) is not None), key=lambda b: b[0])
    fields = [row for row in rows if row and row[0].strip() and _nm(row[0]) is None]
    count = len(bands[0][1]) - 1 if bands else 0
    refuse(
        source,
        (
            len(bands) < _MIN_BANDS or count < 1 or any(len(row) != count + 1 for _, row in bands),
            Problem(
                f"{len(bands)} rows of wavelengths, not all with {count} values",
                expected="a value for each spectrum",
                code="row-unreadable",
            ),
        ),
    )
    fields = [
        [
            row[0],
            *(row[1:] if len(row) == count + 1 else [", ".join(row[1:])] if count == 1 else [""] * count),
        ]
        for row in fields
    ]
    return [list(column) for column in zip(*fields, *(row for _, row in bands), strict=True)]


def _shared_words(properties: dict[str, list[str]], pattern: re.Pattern[str]) -> str:
    # Return the words of a property that all spectra share.
    found = [texts for heading, texts in properties.items() if pattern.fullmatch(heading)]
    return " ".join(dict.fromkeys(text for texts in found for text in texts))[:200]


def _names(properties: dict[str, list[str]], path: Path, count: int) -> list[str]:
    # Return the names of the spectra: of a property that names them, or else of the file.
    by_key = {re.sub(r"[_ ]+", " ", heading.lower()): texts for heading, texts in properties.items()}
    candidates = [by_key[key] for key in _NAMES if key in by_key]
    candidates += [t for t in properties.values() if any(number(cell) is None for cell in t)]
    distinct = [texts for texts in candidates if all(texts) and len(set(texts)) == count]
    if distinct:
        return distinct[0]
    return [path.stem] if count == 1 else [f"{path.stem} {place}" for place in range(1, count + 1)]


def _columns(properties: dict[str, list[str]]) -> dict[str, Any]:
    # Return properties under names of variables: numbers where all cells are numbers, else texts.
    columns: dict[str, Any] = {}
    for heading, texts in properties.items():
        key = re.sub(r"\W+", "_", heading.lower()).strip("_")[:60]
        if not key or not key.isidentifier():
            continue
        row = LIBRARY_VARIABLES.get(key)
        if key in (SIGNATURE, BAND) or row is not None or key in columns:
            key = f"{key}_given"
        values = numbers("" if text.lower() in _MISSING else text for text in texts)
        is_number = values is not None and any(texts)
        columns[key] = np.array(values, np.float64) if is_number else text_column(texts)
    return columns
