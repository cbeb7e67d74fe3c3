"""`write_library`: a paint library in the formats of other programs."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import xarray as xr

from hyperpaint.base.arrays import Progress
from hyperpaint.base.errors import FormatError, SchemaError
from hyperpaint.base.facts import documented
from hyperpaint.base.schema import BAND, LIBRARY_VARIABLES, SIGNATURE, with_integer_dtypes
from hyperpaint.base.units import takes_quantities
from hyperpaint.io.store import to_store

from .csv_library import write_csv_library
from .envi_library import write_envi_library
from .parquet_library import write_parquet_library
from .records import CENTRE, checked_library, spectral_variables


def _write_store(library: xr.Dataset, path: Path, *, overwrite: bool, progress: Progress | None) -> None:
    total = library.sizes[SIGNATURE]
    if progress is not None:
        progress(0, total)
    to_store(library, path, overwrite=overwrite)
    if progress is not None:
        progress(total, total)


_WRITERS: dict[str, Callable[..., Any]] = {
    "envi": write_envi_library,
    "csv": write_csv_library,
    "parquet": write_parquet_library,
    "zarr": _write_store,
}
_OF_SUFFIX = {".sli": "envi", ".hdr": "envi", ".csv": "csv", ".zarr": "zarr", ".parquet": "parquet"}


@takes_quantities()
@documented()
def write_library(
    library: xr.Dataset,
    path: str | os.PathLike[str],
    *,
    format: str | None = None,
    curves: str | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Path:
    """Write a paint library.

    * ``envi``: ``x.sli`` (float32), its header ``x.hdr`` and metadata ``x.sli.json``; the header also lists
      properties of the paints (``paint make = {...}``).
    * ``csv``: ``x.csv``, a table for pandas, R, spreadsheets and EcoSIS: columns of the paint's name and
      properties, then of reflectance [1] at wavelengths [nm]; units and all else in ``x.csv.json``.
    * ``parquet``: ``x.parquet`` in the columns of OpenSpecLib, a row per spectrum, and ``x.parquet.json``;
      needs the extra ``library`` (pyarrow).
    * ``zarr``: a store, see `hyperpaint.to_store`.

    `hyperpaint.open_library` opens all of them; with ``curves="all"`` it returns the library that was
    written, bit for bit. Files appear under their names when all are complete. Lazy libraries are computed in
    blocks of paints.

    Parameters
    ----------
    library
        A paint library, as of `hyperpaint.extract_signatures` or `hyperpaint.open_library`: `reflectance`
        (signature, band), `wavelength` (band), and further properties of the paints.
    path
        The file, or the folder of ``zarr``. ``.sli`` is added where it is missing, ``.csv`` to a name without
        a suffix.
    format
        One of the above; by default chosen by the suffix: ``.sli``, ``.csv``, ``.parquet`` or ``.zarr``.
    curves
        ``centre`` for one spectrum per paint, the default of all formats but ``zarr``: members, quantiles,
        spread and uncertainties are not written. ``all`` for all of them, the default of ``zarr``.
    overwrite
        Replace an existing library. A folder with other files is never replaced.
    progress

    Returns
    -------
    pathlib.Path
        Path for `hyperpaint.open_library`: the ``.sli`` or ``.csv`` file, or the folder.

    Raises
    ------
    FormatError
        The format is unknown, or the suffix belongs to no format.
    SchemaError
        ``curves`` is neither of the two; ``library`` is not a paint library; or names, values or attributes
        cannot be written in the format; all problems are listed.
    StoreError
        The target exists, is being written by another process, or cannot be written; it stays unchanged.
    UnitsError
        Units cannot be read.
    MissingExtraError
        The format is ``parquet``, and pyarrow is not installed.

    Examples
    --------
    >>> import tempfile
    >>> import numpy as np, xarray as xr
    >>> paints = xr.Dataset(
    ...     {"reflectance": (("signature", "band"), np.float32([[0.1, 0.5], [0.2, 0.3]]), {"units": "1"})},
    ...     {"signature": ["red, matt", "blue"], "wavelength": ("band", [450.0, 650.0], {"units": "nm"})},
    ... )
    >>> scratch = tempfile.TemporaryDirectory()
    >>> path = write_library(paints, Path(scratch.name) / "paints.sli")
    >>> sorted(file.name for file in path.parent.iterdir())
    ['paints.hdr', 'paints.sli', 'paints.sli.json']
    >>> from hyperpaint.io.library import open_library
    >>> open_library(path)["signature"].values.tolist()
    ['red, matt', 'blue']
    >>> scratch.cleanup()
    """
    path = Path(path)
    chosen = _OF_SUFFIX.get(path.suffix.lower()) if format is None else format
    if chosen not in _WRITERS:
        requested = f"format {format!r}" if format is not None else f"no format of the suffix {path.suffix!r}"
        raise FormatError(
            requested,
            expected=f"format= one of {', '.join(_WRITERS)}, or suffix .sli, .csv, .parquet, .zarr",
            code="choice-unknown",
        )
    if curves not in (None, "centre", "all"):
        raise SchemaError(f"curves={curves!r}", expected=f"centre or all for {chosen}", code="choice-unknown")
    path = _named(path, chosen)
    library = checked_library(with_integer_dtypes(library, LIBRARY_VARIABLES))
    if curves == "centre" or (curves is None and chosen != "zarr"):
        others = [name for name in spectral_variables(library) if name != CENTRE]
        inner = {dim for name in others for dim in library[name].dims} - {SIGNATURE, BAND}
        library = library.drop_vars(others).drop_dims(inner, errors="ignore")
    _WRITERS[chosen](library, path, overwrite=overwrite, progress=progress)
    return path


def _named(path: Path, format: str) -> Path:
    # Path of the written file, with a suffix that `open_library` recognises
    if format == "envi":
        is_envi = path.suffix.lower() in (".sli", ".hdr")
        return path.with_suffix(".sli") if is_envi else path.with_name(f"{path.name}.sli")
    return path.with_suffix(".csv") if format == "csv" and not path.suffix and not path.is_dir() else path
