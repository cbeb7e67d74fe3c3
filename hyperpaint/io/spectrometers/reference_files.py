"""References of field spectrometers, libraries and stores, and their assignment to paints."""

from __future__ import annotations

import csv
import json
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import xarray as xr

from hyperpaint.base.errors import FormatError, PaintError, Problems
from hyperpaint.io.files.reading import read_limited_text
from hyperpaint.io.library import open_library
from hyperpaint.io.store import list_groups, open_store
from hyperpaint.io.store.reader import is_zarr

from .asd import open_asd, sniff
from .spectrum_files import find_paths
from .svc import open_svc

_GROUP = "references/"


def open_references(paths: Sequence[Any]) -> list[xr.Dataset]:
    """Open reference spectra of reflectance.

    paths: Files, globs or folders: SVC ``.sig``, ASD binary or text export, anything
        `hyperpaint.open_library` reads, or a store with groups ``references/<instrument>``: any Zarr in a
        folder, zip file, URL or store object.
    Returns list of xarray.Dataset: One for all files of the same kind and the same wavelengths.
    Raises FormatError: Files are missing, damaged or of unknown kind; all are named.
    Raises StoreError: A store was never finished, or is damaged.
    """
    datasets = [dataset for path in paths if is_zarr(path) for dataset in _references_of_store(path)]
    file_paths = [path for path in paths if not is_zarr(path)]
    if file_paths:
        files = find_paths(file_paths, _spectra_of_folder, ".sig or .asd files, text exports, or a library")
        datasets += _open_by_kind(files, "reflectance", is_reference=True)
    return datasets


def _references_of_store(path: Any) -> list[xr.Dataset]:
    groups = list_groups(path)
    groups_to_open = [g for g in groups if g.startswith(_GROUP)] or [g for g in groups if not g]
    if not groups_to_open:
        raise FormatError(
            f"{path}: contains neither a library nor references",
            expected=f"a paint library, or groups {_GROUP}<instrument>",
            code="library-missing",
        )
    return [open_store(path, group) for group in groups_to_open]


def _spectra_of_folder(folder_files: list[Path]) -> list[Path]:
    # Return the spectrometer files of a folder; or else its text files.
    spectra = [path for path in folder_files if path.suffix.lower() in (".sig", ".asd")]
    return spectra or [path for path in folder_files if path.suffix.lower() in (".txt", ".tsv", ".csv")]


def open_spectra(files: Sequence[Path], quantity: str | None = None) -> list[xr.Dataset]:
    """Open files of field spectrometers, grouped by instrument.

    files: SVC ``.sig``, ASD binary or text exports, in any mixture.
    quantity: See `hyperpaint.open_svc` and `hyperpaint.open_asd`; by default the quantity in the files.
    Raises FormatError: Files cannot be read, or are of unknown kind; all are named.
    """
    return _open_by_kind(files, quantity, is_reference=False)


def _open_by_kind(files: Sequence[Path], quantity: str | None, *, is_reference: bool) -> list[xr.Dataset]:
    # Open files of spectrometers. References may also be libraries, and may differ in wavelengths.
    problems = Problems("references cannot be opened", FormatError)
    files_by_opener: dict[Any, list[Path]] = {}
    libraries: list[Path] = []
    for path in files:
        suffix = path.suffix.lower()
        if suffix == ".sig":
            files_by_opener.setdefault(open_svc, []).append(path)
        elif sniff(path) in ("binary", "text"):
            files_by_opener.setdefault(open_asd, []).append(path)
        elif is_reference and suffix != ".asd":
            libraries.append(path)
        else:
            problems.add(
                f"{path}: not a file of a field spectrometer",
                expected=".sig, .asd or a text export",
                code="format-unknown",
            )
    datasets: list[xr.Dataset] = []

    def error_of(opener: Any, *arguments: Any) -> PaintError | None:
        try:
            datasets.append(opener(*arguments))
        except PaintError as error:
            return error
        return None

    errors: list[PaintError | None] = []
    for opener, paths_of_opener in files_by_opener.items():
        error = error_of(opener, paths_of_opener, quantity)
        is_opened_singly = error and is_reference and len(paths_of_opener) > 1
        errors += (
            [error_of(opener, path, quantity) for path in paths_of_opener] if is_opened_singly else [error]
        )
    errors += [error_of(open_library, path) for path in libraries]
    for error in filter(None, errors):
        problems.add_error("", error)
    problems.raise_if_any()
    return datasets


_MAX_BYTES = 4 << 20
_MAX_SHOWN = 5
_HEADINGS = ("paint", "name", "signature", "region")


def read_pairs(path: str | os.PathLike[str]) -> dict[str, tuple[str, ...]]:
    r"""Read the assignment of references to paints.

    path: Lines of paint and reference, separated by a comma, with or without headings; a paint may have
        several lines. Or a JSON object of paints, each with one name or a list of them (``.json``).
    Returns dict: Names of references by names of paints, in the order of the file.
    Raises FormatError: The file has another content; the first problems are listed.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp(), "pairs.csv")
    >>> _ = path.write_text("paint,reference\nhood,svc_0012\nhood,svc_0013\n")
    >>> read_pairs(path)
    {'hood': ('svc_0012', 'svc_0013')}
    """
    path = Path(path)
    data = read_limited_text(path, _MAX_BYTES, "a list of paints and references")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise FormatError(
            f"{path}: not UTF-8 text", mend="save it as UTF-8", code="text-unreadable"
        ) from error
    problems = Problems(f"{path} cannot be used as a list of paints and references", FormatError)
    pairs = (
        _pairs_of_json(text, problems) if path.suffix.lower() == ".json" else _pairs_of_lines(text, problems)
    )
    references_by_paint: dict[str, dict[str, None]] = {}
    for paint, reference in pairs:
        references_by_paint.setdefault(paint, {})[reference] = None
    if not references_by_paint and not problems:
        problems.add("the file contains no pair", code="empty-input")
    problems.raise_if_any()
    return {paint: tuple(references) for paint, references in references_by_paint.items()}


def _pairs_of_lines(text: str, problems: Problems) -> Iterator[tuple[str, str]]:
    rows = csv.reader(text.splitlines(), strict=True)
    line_number = 0
    try:
        for line_number, row in enumerate(rows, 1):
            cells = [cell.strip() for cell in row]
            if not any(cells) or cells[0].startswith("#"):
                continue
            if line_number == 1 and cells[0].lower() in _HEADINGS and cells[1:2] == ["reference"]:
                continue
            if len(cells) == 2 and all(cells):
                yield cells[0], cells[1]
            elif len(problems) < _MAX_SHOWN:
                problems.add(
                    f"line {line_number}: {','.join(row)[:60]!r}",
                    expected="paint, comma, reference",
                    code="row-unreadable",
                )
    except csv.Error as error:
        problems.add(f"after line {line_number}: {error}", code="row-unreadable")


def _pairs_of_json(text: str, problems: Problems) -> Iterator[tuple[str, str]]:
    try:
        document: Any = json.loads(text)
    except (ValueError, RecursionError) as error:
        problems.add(f"not readable as JSON ({error!s:.80})", code="text-unreadable")
        return
    if not isinstance(document, dict):
        problems.add(
            "the JSON is not an object",
            expected="an object of paints, each with the name of its reference or a list of names",
            code="type-wrong",
        )
        return
    for paint, names in document.items():
        references = [names] if isinstance(names, str) else names
        if (
            isinstance(references, list)
            and references
            and all(isinstance(name, str) and name for name in references)
        ):
            yield from ((paint, name) for name in references)
        elif len(problems) < _MAX_SHOWN:
            problems.add(
                f"{paint!r:.60}: {names!r:.60}", expected="a name or a list of names", code="type-wrong"
            )
