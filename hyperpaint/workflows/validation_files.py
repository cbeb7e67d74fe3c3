"""From a stored paint library and files of references to a table: where readers and validation meet."""

from __future__ import annotations

import csv
import io
import json
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hyperpaint.base.errors import Problems, SchemaError, StoreError

if TYPE_CHECKING:
    import xarray as xr

    from hyperpaint.validation import Validation

__all__ = ["check_table", "validate_files", "write_table"]

_TABLES = (".csv", ".json")
_PAIR = ("paint", "reference", "instrument", "overlap", "overlap_matched", "mirror_reflection")
_DEPTHS = ("oxygen_residual", "reference_oxygen_residual")


def validate_files(
    library: str | os.PathLike[str],
    references: Sequence[str | os.PathLike[str]] = (),
    *,
    pairs: str | os.PathLike[str] | None = None,
    panel: str | os.PathLike[str] | None = None,
    **options: Any,
) -> Validation:
    """Compare a stored paint library with references in files.

    Parameters
    ----------
    library
        A paint library, see `hyperpaint.open_library`.
    references
        See `hyperpaint.io.spectrometers.reference_files.open_references`. By default those of the store that
        the library was made from, where it stands beside the library.
    pairs
        See `hyperpaint.io.spectrometers.reference_files.read_pairs`.
    panel
        See `hyperpaint.read_certificate`.
    **options
        Of `hyperpaint.validate`.

    Raises
    ------
    FormatError, SchemaError, StoreError, UnitsError
        Something cannot be read, or as `hyperpaint.validate`.
    """
    from hyperpaint.io.library import open_library
    from hyperpaint.io.spectrometers.reference_files import open_references, read_pairs
    from hyperpaint.io.spectrometers.spectrum_csv import read_certificate
    from hyperpaint.validation import validate

    signatures = open_library(library)
    named = None if pairs is None else read_pairs(pairs)
    certified = None if panel is None else read_certificate(panel)
    opened = open_references(references or [_store_of(signatures, Path(library))])
    return validate(signatures, opened, named, panel=certified, **options)


def _store_of(signatures: xr.Dataset, library: Path) -> Path:
    """Return the store that a library was made from."""
    name = signatures.attrs.get("store")
    place = library.absolute().parent / str(name)
    # only a name: no path from inside a file leads out of the folder
    plain = isinstance(name, str) and name not in ("", ".", "..") and Path(name).name == name
    if not plain or not (place / "references").is_dir():
        raise SchemaError(
            f"no references: the store that {library} was made from has none, or is not beside it; name "
            "files with --reference"
        )
    return place


# --- tables ------------------------------------------------------------------------------------------------


def check_table(path: Path, *, overwrite: bool = False) -> None:
    """Refuse a place for a table before anything is read.

    Raises
    ------
    StoreError
        A table may not go there; all reasons are listed.
    """
    problems = Problems(f"the table cannot be written to {path}", StoreError)
    if path.suffix.lower() not in _TABLES:
        problems.add(f"expected a name that ends in {' or '.join(_TABLES)}")
    if path.is_dir():
        problems.add("that is a folder; name a file in it, such as agreement.csv")
    elif path.exists() and not overwrite:
        problems.add(
            "it exists already",
            mend="pass overwrite=True to replace it",
            option="pass --overwrite to replace it",
        )
    if not path.absolute().parent.is_dir():
        problems.add(f"there is no folder {path.absolute().parent}")
    problems.raise_if_any()


def write_table(found: Validation, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
    """Write the statistics of a validation: ``.csv``, a line for every part of every pair, or ``.json``.

    Numbers have all their digits; what is not known is empty, or null.

    Raises
    ------
    StoreError
        The table may not go there, or cannot be written.
    """
    from hyperpaint.io.files.publishing import publish_file

    path = Path(path)
    check_table(path, overwrite=overwrite)
    made = _as_csv(found) if path.suffix.lower() == ".csv" else _as_json(found)
    publish_file(path, made.encode(), overwrite=overwrite)


def _as_csv(found: Validation) -> str:
    table = found.statistics
    by_part = [str(name) for name, array in table.data_vars.items() if array.dims == ("pair", "part")]
    written = io.StringIO()
    rows = csv.writer(written, lineterminator="\n")
    rows.writerow([*_PAIR, "part", *by_part, *_DEPTHS])
    for row in range(table.sizes["pair"]):
        pair = table.isel(pair=row)
        for column in range(table.sizes["part"]):
            one = pair.isel(part=column)
            cells = [_plain(one[name].values.item()) for name in (*_PAIR, "part", *by_part, *_DEPTHS)]
            rows.writerow(["" if cell is None else cell for cell in cells])
    return written.getvalue()


def _as_json(found: Validation) -> str:
    table = found.statistics
    by_part = [str(name) for name, array in table.data_vars.items() if array.dims == ("pair", "part")]
    pairs = []
    for row in range(table.sizes["pair"]):
        pair = table.isel(pair=row)
        made = {name: _plain(pair[name].values.item()) for name in (*_PAIR, *_DEPTHS)}
        made["notes"] = list(found.notes[row])
        made["parts"] = {
            str(part): {name: _plain(pair[name].values[column].item()) for name in by_part}
            for column, part in enumerate(table["part"].values)
        }
        pairs.append(made)
    document = {
        "passed": found.passed,
        "tolerance": dict(found.tolerance),
        "units": {name: table[name].attrs["units"] for name in by_part if "units" in table[name].attrs},
        "parts": {
            str(part): [_plain(float(edge)) for edge in edges]
            for part, *edges in zip(
                table["part"].values,
                table["first_wavelength"].values,
                table["last_wavelength"].values,
                strict=True,
            )
        },
        "pairs": pairs,
        "unpaired_signatures": list(found.unpaired_signatures),
        "unpaired_references": list(found.unpaired_references),
        "missing": list(found.missing),
    }
    return json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def _plain(value: Any) -> Any:
    """Return a value as Python writes it; None for a number that is none."""
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value
