"""Spectra of the ECOSTRESS library (version 1) and of its forerunner, the ASTER library (version 2).

Lines ``Key: value``, an empty line, then x and y a line. The values of ASTER files wrap over lines without a
key of their own, those of ECOSTRESS files do not; both are read alike.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import FormatError, Problems
from hyperpaint.base.schema import LIBRARY_VARIABLES, PAINT

from .metadata import typed_values
from .spectra import Spectra, reflectances, text_column
from .text_spectra import in_nanometres, lines_of, number, numbers_of_lines, wavelength_factor

__all__ = ["KEYS", "METADATA", "is_ecostress", "read_ecostress"]

KEYS = (
    "Name", "Type", "Class", "Subclass", "Genus", "Species", "Particle Size", "Sample No.", "Owner",
    "Wavelength Range", "Origin", "Collection Date", "Description", "Measurement", "First Column",
    "Second Column", "X Units", "Y Units", "First X Value", "Last X Value", "Number of X Values",
    "Additional Information",
)  # fmt: skip
"""Of a header, in their order."""

METADATA = "hyperpaint metadata "
"""Opens the additional information of files that `hyperpaint.write_library` wrote; JSON follows."""

_KEY = re.compile(rf"\s*({'|'.join(map(re.escape, KEYS))})\s*:(.*)", re.IGNORECASE)
_SPELLED = {key.lower(): key for key in KEYS}
_ABOUT_THE_AXES = KEYS[KEYS.index("First Column") :]
_PERCENT = re.compile(r"percent|%", re.IGNORECASE)
_FRACTION = re.compile(r"fraction|unitless|decimal|\b0 ?(?:-|to) ?1\b|\(1\)", re.IGNORECASE)
_OTHER_QUANTITY = re.compile(r"transmi|emissiv|absorb|radianc", re.IGNORECASE)


def is_ecostress(head: str) -> bool:
    """Tell from its beginning whether a text is such a file."""
    return re.match(r"\s*Name\s*:", head) is not None and "Number of X Values" in head


def read_ecostress(path: Path, *, scale: float | None = None, wavelength: Floats | None = None) -> Spectra:
    """Read a spectrum of the ECOSTRESS or ASTER library.

    Parameters
    ----------
    path
        The file.
    scale
        y of a reflectance of one, where the file does not say it.
    wavelength
        To be used in place of the file's own [nm].

    Raises
    ------
    FormatError
        The header or the numbers are not as they should be, or it is no reflectance.
    """
    source = path.name
    lines = lines_of(path, "a spectrum of the ECOSTRESS or ASTER library")
    fields, first, wrapped = _header(lines, source)
    problems = Problems(f"{source} cannot be used", FormatError)
    for key in ("Name", "X Units", "Y Units", "Number of X Values"):
        if key not in fields:
            problems.add(f"{key!r} is missing in its header")
    said = _scale_of(fields.get("Y Units", ""))
    if found := _OTHER_QUANTITY.search(fields.get("Y Units", "")):
        problems.add(f"'Y Units' is {fields['Y Units'][:60]!r} ({found[0]}...), expected reflectance")
    problems.raise_if_any()
    table = numbers_of_lines(lines, first, 2, source)
    notes = _compared(fields, table, source)
    factor, note = wavelength_factor(fields["X Units"], table[:, 0], source)
    if np.isnan(table[:, 0]).any():
        raise FormatError(f"{source}: a wavelength is not a number")
    return Spectra(
        source=source,
        form=f"{'ASTER' if wrapped else 'ECOSTRESS'} library text",
        names=[fields["Name"]],
        wavelength=in_nanometres(table[:, 0], factor) if wavelength is None else wavelength,
        reflectance=reflectances(table[None, :, 1], source, said=said, given=scale),
        columns=_columns(fields, source),
        notes=[*notes, *([note] if note else [])],
    )


def _header(lines: list[str], source: str) -> tuple[dict[str, str], int, bool]:
    """Return the fields, the index of the first line of numbers, and whether values wrap."""
    fields: dict[str, list[str]] = {}
    current, wrapped = "", False
    for at, line in enumerate(lines):
        match = _KEY.match(line)
        if match and _SPELLED[match[1].lower()] not in fields:
            current = _SPELLED[match[1].lower()]
            fields[current] = [match[2].strip()]
        elif "Number of X Values" in fields and _is_pair(line):
            return {key: " ".join(filter(None, parts)) for key, parts in fields.items()}, at, wrapped
        elif current and line.strip():
            fields[current].append(line.strip())
            wrapped = True
        elif line.strip():
            raise FormatError(f"{source}: line {at + 1} is {line.strip()[:60]!r}, expected 'Name: ...'")
    raise FormatError(f"{source}: no line of two numbers after its header")


def _is_pair(line: str) -> bool:
    cells = line.split(None, 2)
    return len(cells) == 2 and all(number(cell) is not None for cell in cells)


def _scale_of(units: str) -> float | None:
    if _PERCENT.search(units):
        return 100.0
    return 1.0 if _FRACTION.search(units) else None


def _compared(fields: dict[str, str], table: Floats, source: str) -> list[str]:
    """Refuse another number of values than the header says; return what else does not fit it."""
    count = fields["Number of X Values"]
    if count != str(len(table)):
        raise FormatError(f"{source}: {len(table)} values, its header says {count[:30]}; copy the file again")
    notes = []
    for key, found in (("First X Value", table[0, 0]), ("Last X Value", table[-1, 0])):
        told = number(fields.get(key, ""))
        # the header rounds
        if told is not None and np.isfinite(told) and abs(told - found) > 1e-2 * abs(found):
            notes.append(f"{key!r} is {told:g}, found {found:g}")
    return notes


def _columns(fields: dict[str, str], source: str) -> dict[str, Any]:
    """Return what the header says of the sample, each as a column of one paint."""
    made: dict[str, Any] = {
        re.sub(r"[^a-z]+", "_", key.lower()).strip("_"): text_column([fields[key]])
        for key in KEYS[1:]
        if key in fields and key not in _ABOUT_THE_AXES
    }
    more = fields.get("Additional Information", "")
    if not more.startswith(METADATA):
        return {**made, "additional_information": text_column([more])} if more else made
    try:
        told = json.loads(more.removeprefix(METADATA))
    except (ValueError, RecursionError) as error:
        raise FormatError(
            f"{source}: 'Additional Information' holds damaged metadata ({error!s:.100})"
        ) from error
    if not isinstance(told, dict):
        raise FormatError(
            f"{source}: 'Additional Information' holds {type(told).__name__}, expected names and values"
        )
    for name, value in told.items():
        if not name.isidentifier() or name in made or name in ("paint", "band", "wavelength", "reflectance"):
            raise FormatError(
                f"{source}: 'Additional Information' names {name[:60]!r}, expected a new plain name"
            )
        made[name] = _told(name, value, source)
    return made


def _told(name: str, value: Any, source: str) -> Any:
    row = LIBRARY_VARIABLES.get(name)
    if row is not None and row.dims == (PAINT,):
        try:
            return typed_values([value], row.dtype)
        except ValueError as error:
            raise FormatError(f"{source}: metadata {name!r}: {error}") from error
    if isinstance(value, str):
        return text_column([value])
    if value is None:
        return np.array([np.nan])
    if isinstance(value, bool) or (isinstance(value, int) and abs(value) < 2**53):
        return np.array([value])
    if isinstance(value, float) and np.isfinite(value):
        return np.array([value])
    raise FormatError(f"{source}: metadata {name!r} is {str(value)[:60]!r}, expected text or a number")
