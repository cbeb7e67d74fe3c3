"""References of field spectrometers, libraries and stores, and their assignment to paints."""

import csv
import json
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import xarray as xr

from hyperpaint.base import FormatError, PaintError, Problem, Problems, as_path
from hyperpaint.io.files.reading import foreign_format, read_limited_text, refuse
from hyperpaint.io.library import open_library
from hyperpaint.io.store import is_zarr, list_groups, open_store

from .asd import open_asd, sniff
from .spectrum_texts import SPECTRUM_SUFFIXES, find_paths, is_named_as_scans, open_svc

_GROUP = "references/"


def open_references(paths: Sequence[Any]) -> list[xr.Dataset]:
    # Open reference spectra of reflectance.
    #
    # paths: Files, globs or folders: SVC ``.sig``, ASD binary or text export, anything
    #     `hyperpaint.open_library` reads, or a store with groups ``references/<instrument>``: any Zarr in a
    #     folder, zip file, URL or store object.
    # Returns list of xarray.Dataset: One for all files of the same kind and the same wavelengths.
    # Raises FormatError: Files are missing, damaged or of unknown kind; all are named.
    # Raises StoreError: A store was never finished, or is damaged.
    stores = [path for path in paths if is_zarr(path)]
    datasets = []
    for path in stores:
        groups = list_groups(path)
        groups_to_open = [g for g in groups if g.startswith(_GROUP)] or [g for g in groups if not g]
        refuse(
            str(path),
            (
                not groups_to_open,
                Problem(
                    "contains neither a library nor references",
                    expected=f"a paint library, or groups {_GROUP}<instrument>",
                    code="library-missing",
                ),
            ),
        )
        datasets += [open_store(path, group) for group in groups_to_open]

    def of_folder(files: list[Path]) -> list[Path]:
        # the spectrometer files of a folder; or else its text files
        spectra = [path for path in files if path.suffix.lower() == ".asd" or is_named_as_scans(path)]
        return spectra or [path for path in files if path.suffix.lower() in SPECTRUM_SUFFIXES]

    if file_paths := [path for path in paths if not is_zarr(path)]:
        files = find_paths(file_paths, of_folder, ".sig or .asd files, text exports, or a library")
        datasets += open_spectra(files, is_reference=True)
    return datasets


def open_spectra(files: Sequence[Path], *, is_reference: bool = False) -> list[xr.Dataset]:
    # Open files of field spectrometers, grouped by instrument.
    #
    # files: SVC ``.sig``, ASD binary or text exports, tables in CSV, in any mixture.
    # is_reference: References are reflectance, may also be libraries, and may differ in wavelengths; other
    # files have the quantity that they state.
    # Raises FormatError: Files cannot be read, or are of unknown kind; all are named.
    with Problems("references cannot be opened", FormatError) as problems:
        files_by_opener: dict[Any, list[Any]] = {open_svc: [], open_asd: [], open_library: []}
        openers: dict[str, Any] = {
            "scans": open_svc,
            "binary": open_asd,
            "text": open_asd,
            "table": open_asd if is_reference else open_library,
            "instrument": open_library,
        }
        for path in files:
            opener = openers.get("scans" if is_named_as_scans(path) else sniff(path))
            is_table = path.suffix.lower() == ".csv" or (is_reference and path.suffix.lower() != ".asd")
            if opener is None and is_table:
                opener = open_library
            if opener is not None:
                files_by_opener[opener].append(path)
            else:
                unknown = Problem(
                    "not a file of a field spectrometer",
                    expected=".sig, .asd or a text of a spectrometer",
                    code="format-unknown",
                )
                problem = foreign_format(path) or unknown
                problems.extend([replace(problem, found=f"{path}: {problem.found}")])
        datasets: list[xr.Dataset] = []
        for opener, paths in files_by_opener.items():
            # libraries are opened singly; so are references that cannot be opened together
            batches = paths if opener is open_library else [paths] if paths else []
            options = () if opener is open_library else ("reflectance" if is_reference else None,)
            while batches:
                batch, *batches = batches
                try:
                    datasets.append(opener(batch, *options))
                except PaintError as error:
                    if is_reference and isinstance(batch, list) and len(batch) > 1:
                        batches = batch
                    else:
                        problems.add_error("", error)
    return datasets


# --- assignment of references to paints --------------------------------------------------------------------


_MAX_BYTES = 4 << 20
_MAX_SHOWN = 5
_HEADINGS = ("paint", "name", "signature", "region")


def read_pairs(path: str | os.PathLike[str]) -> dict[str, tuple[str, ...]]:
    r"""Read the assignment of references to paints.

    path: Lines of paint and reference, separated by a comma, semicolon or tab, with or without headings; a
        paint may have several lines. Or a JSON object of paints, each with one name or a list of them
        (``.json``).
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
    path = as_path(path)
    data = read_limited_text(path, _MAX_BYTES, "a list of paints and references")
    with FormatError.instead_of(
        UnicodeDecodeError, f"{path}: not UTF-8 text", mend="save it as UTF-8", code="text-unreadable"
    ):
        text = data.decode("utf-8-sig")
    with Problems(f"{path} cannot be used as a list of paints and references", FormatError) as problems:
        # text of an entry in messages, paint, and references
        entries: list[tuple[str, Any, Any]] = []
        expected, code = "paint, comma, reference", "row-unreadable"
        if path.suffix.lower() == ".json":
            document: Any = None
            try:
                document = json.loads(text)
            except (ValueError, RecursionError) as error:
                problems.add(f"not readable as JSON ({error!s:.80})", code="text-unreadable")
            if isinstance(document, dict):
                expected, code = "a name or a list of names", "type-wrong"
                for paint, names in document.items():
                    references = [names] if isinstance(names, str) else names
                    entries.append((f"{paint!r:.60}: {names!r:.60}", paint, references))
            elif not problems:
                problems.add(
                    "the JSON is not an object",
                    expected="an object of paints, each with the name of its reference or a list of names",
                    code="type-wrong",
                )
        else:
            line_number, rows = 0, text.splitlines()
            # the separator that all rows have; spreadsheets of many countries write semicolons
            filled_rows = [row for row in rows if row.strip(" ,;\t") and not row.lstrip().startswith("#")]
            separators = (sign for sign in ",;\t" if all(sign in row for row in filled_rows))
            try:
                table = csv.reader(rows, delimiter=next(separators, ","), strict=True)
                for line_number, row in enumerate(table, 1):
                    cells = [cell.strip() for cell in row]
                    if not any(cells) or cells[0].startswith("#"):
                        continue
                    if line_number > 1 or cells[0].lower() not in _HEADINGS or cells[1:2] != ["reference"]:
                        is_pair = len(cells) == 2 and all(cells)
                        entries.append(
                            (
                                f"line {line_number}: {','.join(row)[:60]!r}",
                                cells[0],
                                cells[1:] if is_pair else [],
                            )
                        )
            except csv.Error as error:
                problems.add(f"after line {line_number}: {error}", code="row-unreadable")
        references_by_paint: dict[str, dict[str, None]] = {}
        for found, paint, references in entries:
            if (
                isinstance(references, list)
                and references
                and all(isinstance(n, str) and n for n in references)
            ):
                references_by_paint.setdefault(paint, {}).update(dict.fromkeys(references))
            elif len(problems) < _MAX_SHOWN:
                problems.extend([Problem(found, expected=expected, code=code)])
        problems.add_if(
            not references_by_paint and not problems, "the file contains no pair", code="empty-input"
        )
    return {paint: tuple(references) for paint, references in references_by_paint.items()}
