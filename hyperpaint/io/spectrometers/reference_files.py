"""References in files of any kind known: field spectrometers, paint libraries, stores."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hyperpaint.base.errors import FormatError, PaintError, Problems

from .spectrum_files import find_paths

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["open_references", "open_spectra"]

_GROUP = "references/"


def open_references(paths: Sequence[str | os.PathLike[str]]) -> list[xr.Dataset]:
    """Open references of reflectance.

    Parameters
    ----------
    paths
        Files, globs or folders: SVC ``.sig``, ASD binary or text export, anything `hyperpaint.open_library`
        reads, or a store with groups ``references/<instrument>``.

    Returns
    -------
    list of xarray.Dataset
        Files of one kind and one set of wavelengths are in one Dataset.

    Raises
    ------
    FormatError
        Files are missing, damaged or of no kind known; all are named.
    StoreError
        A store was never finished, or is damaged.
    """
    stores = [Path(path) for path in paths if (Path(path) / "zarr.json").is_file()]
    others = [path for path in paths if Path(path) not in stores]
    made = [dataset for store in stores for dataset in _of_store(store)]
    if others:
        files = find_paths(others, _spectra_in, ".sig or .asd files, text exports, or a library")
        made += _of_files(files)
    return made


def _of_files(files: Sequence[Path]) -> list[xr.Dataset]:
    from hyperpaint.io.library import open_library

    spectra = [path for path in files if _is_spectrum(path)]
    problems = Problems("references cannot be opened", FormatError)
    made = _opened(spectra, "reflectance", problems, apart=True)
    made += _one_by_one(open_library, [path for path in files if path not in spectra], problems)
    problems.raise_if_any()
    return made


def _is_spectrum(path: Path) -> bool:
    from .asd import sniff

    return path.suffix.lower() in (".sig", ".asd") or sniff(path) in ("binary", "text")


def _of_store(path: Path) -> list[xr.Dataset]:
    from hyperpaint.io.store import list_groups, open_store

    groups = list_groups(path)
    wanted = [group for group in groups if group.startswith(_GROUP)] or [
        group for group in groups if not group
    ]
    if not wanted:
        raise FormatError(f"{path}: expected a paint library, or groups {_GROUP}<instrument>")
    return [open_store(path, group or None) for group in wanted]


def _spectra_in(inside: list[Path]) -> list[Path]:
    """Return the spectra of a folder; text exports only where there is nothing else."""
    own = [path for path in inside if path.suffix.lower() in (".sig", ".asd")]
    return own or [path for path in inside if path.suffix.lower() in (".txt", ".tsv", ".csv")]


def open_spectra(
    files: Sequence[Path], quantity: str | None = None, *, apart: bool = False
) -> list[xr.Dataset]:
    """Open files of field spectrometers, those of one instrument together.

    Parameters
    ----------
    files
        SVC ``.sig``, ASD binary or text exports, in any mixture.
    quantity
        See `hyperpaint.open_svc` and `hyperpaint.open_asd`; by default what the files hold.
    apart
        Open files one by one where they differ in wavelengths.

    Raises
    ------
    FormatError
        Files cannot be read, or are of no kind known; all are named.
    """
    problems = Problems("references cannot be opened", FormatError)
    made = _opened(files, quantity, problems, apart=apart)
    problems.raise_if_any()
    return made


def _opened(
    files: Sequence[Path], quantity: str | None, problems: Problems, *, apart: bool
) -> list[xr.Dataset]:
    """Open spectra as `open_spectra`; note what cannot be opened."""
    from .asd import open_asd, sniff
    from .svc import open_svc

    kinds: dict[Any, list[Path]] = {}
    for path in files:
        if path.suffix.lower() == ".sig":
            kinds.setdefault(open_svc, []).append(path)
        elif sniff(path) in ("binary", "text"):
            kinds.setdefault(open_asd, []).append(path)
        else:
            problems.add(f"{path}: no file of a field spectrometer; expected .sig, .asd or a text export")
    made: list[xr.Dataset] = []
    for opener, own in kinds.items():
        try:
            made.append(opener(own, quantity))
        except PaintError as error:
            if not apart or len(own) == 1:
                problems.add(str(error))
                continue
            made += _one_by_one(opener, own, problems, quantity=quantity)
    return made


def _one_by_one(opener: Any, files: Sequence[Path], problems: Problems, **options: Any) -> list[xr.Dataset]:
    made = []
    for path in files:
        try:
            made.append(opener(path, **options))
        except PaintError as error:
            problems.add(str(error))
    return made
