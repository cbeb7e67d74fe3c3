"""Paint libraries as comma-separated values with their metadata beside them.

A row is a spectrum: the paint, what of it (``reflectance``, ``member_reflectance``, ...), its place where a
paint has several (from 1), then the values. The first row has the wavelengths [nm].
"""

from __future__ import annotations

import contextlib
import csv
import io
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hyperpaint.base.arrays import Floats, Floats32
from hyperpaint.base.errors import FormatError, Problems
from hyperpaint.base.schema import BAND
from hyperpaint.io.files.publishing import published_files
from hyperpaint.io.files.reading import numbers

from .library_spectra import check_wavelengths
from .metadata import metadata_path, metadata_text
from .records import CENTRE, Key, blocks_of, names_of, restored, spectral_variables

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["is_csv_library", "read_csv_library", "write_csv_library"]

_HEAD = ("paint", "variable", "place")
_MOST_BANDS = 100_000
_MOST_BYTES = 2**32
_MOST_SHOWN = 5


def is_csv_library(head: str) -> bool:
    """Tell from its first line whether a text is such a library."""
    return head.startswith(",".join(_HEAD) + ",")


# --- writing -----------------------------------------------------------------------------------------------


def write_csv_library(
    library: xr.Dataset, path: Path, *, overwrite: bool, progress: Callable[[int, int], None] | None
) -> None:
    """Write a checked library to ``path``, and its metadata to ``<path>.json``.

    Nine digits a value: float32 comes back as it was.

    Raises SchemaError: Names or metadata cannot be written.
    Raises StoreError: Files exist, or cannot be written.
    """
    variables = spectral_variables(library)
    metadata = metadata_text(library, variables)
    starts = [_starting(name) for name in names_of(library)]
    row = ",%.9g" * library.sizes[BAND] + "\n"
    with published_files([metadata_path(path), path], overwrite=overwrite) as (metadata_file, table):
        metadata_file.write_bytes(metadata.encode())
        with open(table, "w", encoding="utf-8", newline="") as file:
            wavelengths = [repr(float(value)) for value in library["wavelength"].values]
            file.write(",".join([*_HEAD, *wavelengths]) + "\n")
            for block in blocks_of(library, variables, progress):
                for paint, inner, values in zip(block.paint, block.inner, block.values, strict=True):
                    place = "" if inner < 0 else str(inner + 1)
                    file.write(f"{starts[paint]},{block.variable},{place}" + row % tuple(values.tolist()))


def _starting(name: str) -> str:
    """Return a name as a cell."""
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="").writerow([name, ""])
    return buffer.getvalue()[:-1]


# --- reading -----------------------------------------------------------------------------------------------


def read_csv_library(path: Path) -> xr.Dataset:
    """Read a library that `write_csv_library` wrote.

    Raises FormatError: The table or its metadata are damaged, or do not go together.
    Warns PaintWarning: The metadata are missing.
    """
    source = path.name
    wavelength, names, keys, rows = _table(path)
    check_wavelengths(wavelength, source)
    if not names:
        raise FormatError(f"{source}: no row of {CENTRE!r}; write the library anew")
    return restored(path, names, keys, {"wavelength": wavelength}, [(0, np.array(rows, np.float32))])


def _table(path: Path) -> tuple[Floats, list[str], list[Key], list[Floats32]]:
    """Return wavelengths, names of the paints, what each row is, and the rows."""
    source = path.name
    problems = Problems(f"{source} cannot be read", FormatError)
    names: list[str] = []
    keys: list[Key] = []
    rows: list[Floats32] = []
    owner = _Owner()
    cells = _cells(path)
    wavelength = _wavelengths(next(cells, []), source)
    for at, row in enumerate(cells, 2):
        values = _values(row, wavelength.size)
        key = owner.key(row) if values is not None else None
        if values is None or key is None:
            problems.add(
                f"row {at}: {','.join(row)[:60]!r}, expected a paint, what of it, its place, and "
                f"{wavelength.size} numbers"
            )
            if len(problems) == _MOST_SHOWN:
                break
            continue
        if key[0] == CENTRE:
            names.append(row[0])
        keys.append(key)
        rows.append(values)
    problems.raise_if_any()
    return wavelength, names, keys, rows


class _Owner:
    """Finds the paint that a row belongs to, also where two have one name: rows are in the paints' order."""

    def __init__(self) -> None:
        self._paints: dict[str, list[int]] = {}
        self._count = 0
        self._last: dict[tuple[str, str], tuple[int, int]] = {}

    def key(self, row: list[str]) -> Key | None:
        name, variable, place = row[: len(_HEAD)]
        if variable == CENTRE and not place:
            self._paints.setdefault(name, []).append(self._count)
            self._count += 1
            return CENTRE, self._count - 1, -1
        valid = not place or (place.isascii() and place.isdigit() and 0 < len(place) < 10 and place[0] != "0")
        if name not in self._paints or not variable.isidentifier() or not valid:
            return None
        inner = int(place or 0) - 1
        turn, before = self._last.get((name, variable), (0, -2))
        if inner <= before:  # the places begin anew: it is the next paint of that name
            turn += 1
        self._last[name, variable] = (turn, inner)
        owners = self._paints[name]
        return (variable, owners[turn], inner) if turn < len(owners) else None


def _cells(path: Path) -> Iterator[list[str]]:
    """Yield the rows as texts."""
    try:
        if not path.is_file() or path.stat().st_size > _MOST_BYTES:
            raise FormatError(f"{path}: no plain file, or over {_MOST_BYTES} bytes, expected a paint library")
        with open(path, encoding="utf-8-sig", newline="") as file:
            yield from filter(None, csv.reader(file, strict=True))
    except (csv.Error, UnicodeDecodeError, OSError) as error:
        raise FormatError(f"{path.name} cannot be read: {error!s:.200}") from error


def _wavelengths(row: list[str], source: str) -> Floats:
    wavelengths = numbers(row[len(_HEAD) :])
    if tuple(row[: len(_HEAD)]) != _HEAD or not wavelengths or len(wavelengths) > _MOST_BANDS:
        raise FormatError(
            f"{source}: its first row is {','.join(row)[:60]!r}, expected {','.join(_HEAD)} and wavelengths"
        )
    return np.array(wavelengths, np.float64)


def _values(row: list[str], bands: int) -> Floats32 | None:
    """Return the numbers of a row, None where they are none or too many."""
    cells, plain = row[len(_HEAD) :], None
    if len(cells) != bands:
        return None
    text = "".join(cells)
    if text.isascii() and "_" not in text and len(text) <= 64 * len(cells):
        with contextlib.suppress(ValueError):  # an empty cell, perhaps
            plain = list(map(float, cells))  # several times faster than `numbers`
    plain = plain or numbers(cells)
    if plain is None:
        return None
    with np.errstate(over="ignore"):
        values = np.array(plain, np.float64).astype(np.float32)
    return None if np.isinf(values).any() else values
