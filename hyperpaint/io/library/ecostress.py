"""Spectra of the ECOSTRESS library (version 1) and of its forerunner, the ASTER library (version 2).

Lines ``Key: value``, an empty line, then x and y a line. The values of ASTER files wrap over lines without a
key, values of ECOSTRESS files do not; both are read alike.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import FormatError, Problems
from hyperpaint.base.schema import LIBRARY_VARIABLES, SIGNATURE
from hyperpaint.io.files.reading import number, numbers

from .column_quantities import without_repeats
from .library_spectra import Spectra, reflectances, text_column
from .metadata import typed_values
from .text_spectra import (
    PERCENT,
    in_nanometres,
    lines_of,
    numbers_of_lines,
    other_quantity,
    wavelength_factor,
)

#: Keys of a header, in file order.
_KEYS = (
    "Name",
    "Type",
    "Class",
    "Subclass",
    "Genus",
    "Species",
    "Particle Size",
    "Sample No.",
    "Owner",
    "Wavelength Range",
    "Origin",
    "Collection Date",
    "Description",
    "Measurement",
    "First Column",
    "Second Column",
    "X Units",
    "Y Units",
    "First X Value",
    "Last X Value",
    "Number of X Values",
    "Additional Information",
)

#: Opens the additional information of files that hyperpaint 0.1 and 0.2 wrote; JSON follows.
_METADATA = "hyperpaint metadata "

_KEY = re.compile(rf"\s*({'|'.join(map(re.escape, _KEYS))})\s*:(.*)", re.IGNORECASE)
_SPELLED = {key.lower(): key for key in _KEYS}
_ABOUT_THE_AXES = _KEYS[_KEYS.index("First Column") :]
_FRACTION = re.compile(r"fraction|unitless|decimal|\b0 ?(?:-|to) ?1\b|\(1\)", re.IGNORECASE)


def is_ecostress(head: str) -> bool:
    """Return whether a text begins as a file of the ECOSTRESS or ASTER library."""
    return re.match(r"\s*Name\s*:", head) is not None and "Number of X Values" in head


def read_ecostress(path: Path, *, scale: float | None = None, wavelength: Floats | None = None) -> Spectra:
    """Read a spectrum of the ECOSTRESS or ASTER library.

    scale: y of a reflectance of one, where the file does not state it.
    wavelength: To be used in place of the file's own [nm].
    Raises FormatError: The header or the numbers are damaged, or the values are not reflectance.
    """
    source = path.name
    lines = lines_of(path, "a spectrum of the ECOSTRESS or ASTER library")
    fields, first, wrapped = _header(lines, source)
    problems = Problems(f"{source} cannot be used", FormatError)
    for key in ("Name", "X Units", "Y Units", "Number of X Values"):
        if key not in fields:
            problems.add(f"the header has no {key!r}", code="key-missing")
    units = fields.get("Y Units", "")
    file_scale = 100.0 if PERCENT.search(units) else 1.0 if _FRACTION.search(units) else None
    if other_quantity(units):
        problems.add(f"'Y Units' is {units[:60]!r}", expected="reflectance", code="quantity-wrong")
    problems.raise_if_any()
    table = numbers_of_lines(lines, first, 2, source)
    if (count := fields["Number of X Values"]) != str(len(table)):
        raise FormatError(
            f"{source}: {len(table)} values",
            expected=f"{count[:30]}, as the header says",
            mend="copy the file again",
            code="length-mismatch",
        )
    notes = []
    for key, actual in (("First X Value", table[0, 0]), ("Last X Value", table[-1, 0])):
        stated = number(fields.get(key, ""))
        # the header rounds
        if stated is not None and np.isfinite(stated) and abs(stated - actual) > 1e-2 * abs(actual):
            notes.append(f"{key!r} is {stated:g}, found {actual:g}")
    factor, note = wavelength_factor(fields["X Units"], table[:, 0], source)
    if np.isnan(table[:, 0]).any():
        raise FormatError(f"{source}: a wavelength is not a number", code="number-unreadable")
    nm, values = table[:, 0], table[:, 1:]
    if wavelength is None:
        nm, values, repeats = without_repeats(nm, values, source)
        notes = [*notes, *repeats]
    return Spectra(
        source=source,
        form=f"{'ASTER' if wrapped else 'ECOSTRESS'} library text",
        names=[fields["Name"]],
        wavelength=in_nanometres(nm, factor) if wavelength is None else wavelength,
        reflectance=reflectances(values.T, source, file_scale=file_scale, scale=scale),
        columns=_columns(fields, source),
        notes=[*notes, *([note] if note else [])],
    )


def _header(lines: list[str], source: str) -> tuple[dict[str, str], int, bool]:
    fields: dict[str, list[str]] = {}
    current, wrapped = "", False
    for at, line in enumerate(lines):
        match = _KEY.match(line)
        if match and _SPELLED[match[1].lower()] not in fields:
            current = _SPELLED[match[1].lower()]
            fields[current] = [match[2].strip()]
        elif "Number of X Values" in fields and len(numbers(line.split(None, 2)) or ()) == 2:
            return {key: " ".join(filter(None, parts)) for key, parts in fields.items()}, at, wrapped
        elif current and line.strip():
            fields[current].append(line.strip())
            wrapped = True
        elif line.strip():
            raise FormatError(
                f"{source}: line {at + 1} is {line.strip()[:60]!r}",
                expected="'Name: ...'",
                code="header-unreadable",
            )
    raise FormatError(f"{source}: no line of two numbers after the header", code="table-missing")


def _columns(fields: dict[str, str], source: str) -> dict[str, Any]:
    columns: dict[str, Any] = {
        re.sub(r"[^a-z]+", "_", key.lower()).strip("_"): text_column([fields[key]])
        for key in _KEYS[1:]
        if key in fields and key not in _ABOUT_THE_AXES
    }
    information = fields.get("Additional Information", "")
    if not information.startswith(_METADATA):
        return {**columns, "additional_information": text_column([information])} if information else columns
    where = f"{source}: 'Additional Information'"
    try:
        entries = json.loads(information.removeprefix(_METADATA))
    except (ValueError, RecursionError) as error:
        raise FormatError(
            f"{where} holds damaged metadata ({error!s:.100})", code="metadata-damaged"
        ) from error
    if not isinstance(entries, dict):
        raise FormatError(
            f"{where} holds {type(entries).__name__}", expected="names and values", code="metadata-damaged"
        )
    for name, value in entries.items():
        if not name.isidentifier() or name in {*columns, SIGNATURE, "band", "wavelength", "reflectance"}:
            raise FormatError(
                f"{where} names {name[:60]!r}", expected="a new identifier", code="metadata-damaged"
            )
        columns[name] = _metadata_column(name, value, source)
    return columns


def _metadata_column(name: str, value: Any, source: str) -> Any:
    row = LIBRARY_VARIABLES.get(name)
    if row is not None and row.dims == (SIGNATURE,):
        try:
            return typed_values([value], row.dtype)
        except ValueError as error:
            raise FormatError(f"{source}: metadata {name!r}: {error}", code="metadata-damaged") from error
    if isinstance(value, str):
        return text_column([value])
    if value is None:
        return np.array([np.nan])
    if (isinstance(value, int) and abs(value) < 2**53) or (isinstance(value, float) and np.isfinite(value)):
        return np.array([value])
    raise FormatError(
        f"{source}: metadata {name!r} is {str(value)[:60]!r}",
        expected="text or a number",
        code="metadata-damaged",
    )
