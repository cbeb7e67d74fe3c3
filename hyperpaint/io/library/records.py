"""Spectra of a paint library as records of a file, and back.

Every spectrum is one record: first the reflectance of all paints, then their further variables on the bands,
then their members. The key of a record is its variable, its paint, and its number within the paint.
"""

from __future__ import annotations

import itertools
import unicodedata
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from hyperpaint.base import schema
from hyperpaint.base.arrays import Floats32, Ints, Progress
from hyperpaint.base.errors import FormatError, PaintWarning, Problems, SchemaError
from hyperpaint.base.schema import BAND, LIBRARY_VARIABLES, MEMBER, SIGNATURE
from hyperpaint.io.files.reading import numbers

from .library_spectra import text_column
from .metadata import Metadata, metadata_path, read_metadata, table_columns

CENTRE = "reflectance"
_BLOCK_BYTES = 16 * 2**20
#: Number of cells of an array that is always allowed; and the number above which padding is limited to seven
#: times the stored cells.
_ALWAYS_ALLOWED_CELLS, _LARGE_CELLS = 2**22, 2**29
#: Unicode categories of characters that names must not have.
_CONTROL = ("Cc", "Cs", "Zl", "Zp")
_MAX_SHOWN = 5

#: Variable, number of the paint, and number within the paint, both from 0; the latter is -1 if a paint has
#: only one spectrum of the variable.
Key = tuple[str, int, int]


@dataclass(frozen=True, eq=False)
class Block:
    """Some records of one variable."""

    variable: str  #: Name of the variable.
    paint: Ints  #: (record,): Number of the paint.
    inner: Ints  #: (record,): Number within the paint, as in `Key`.
    values: Floats32  #: (record, band), float32, contiguous.


# --- from a library ----------------------------------------------------------------------------------------


def checked_library(library: xr.Dataset) -> xr.Dataset:
    """Return a library in the units of the table; values are not checked.

    Raises SchemaError: It is not a paint library: variables are missing, or have other dims or units; all
        are listed.
    """
    required = dict.fromkeys((SIGNATURE, CENTRE, "wavelength"))
    required |= {name: None for name in LIBRARY_VARIABLES if name in library.variables}
    names = [name for name in required if not _is_plain_number(library, name)]
    variables, faults = schema.find(library, names, LIBRARY_VARIABLES)
    problems = Problems("the library cannot be written", SchemaError)
    problems.extend(faults)
    for name in variables:
        dtype = LIBRARY_VARIABLES[name].dtype
        kind = np.dtype("object" if dtype == "str" else dtype).kind
        accepted_kinds = {"f": "fiu", "i": "iu", "u": "iu", "O": "OUT"}.get(kind, kind)
        if variables[name].dtype.kind not in accepted_kinds:
            problems.add(f"{name!r} is {variables[name].dtype}", expected=str(dtype), code="type-wrong")
    if CENTRE in variables and not variables[CENTRE].size:
        problems.add(
            f"reflectance has sizes {dict(variables[CENTRE].sizes)}",
            expected="at least one paint and one band",
            code="empty-input",
        )
    for key, array in library.variables.items():
        if {SIGNATURE, BAND} < set(array.dims) and array.dtype.kind == "f" and array.ndim > 3:
            problems.add(
                f"{key!r} has dims {array.dims}",
                expected="at most one dim beside signature and band",
                code="dims-wrong",
            )
    for name in ("wavelength", "fwhm", "good"):
        if name in variables and variables[name].dims != (BAND,):
            problems.add(
                f"{name!r} has dims {variables[name].dims}", expected="one value a band", code="dims-wrong"
            )
    problems.raise_if_any()
    wavelength = np.asarray(variables["wavelength"].values, np.float64)
    if not (np.isfinite(wavelength).all() and (wavelength > 0).all()):
        raise SchemaError(
            "the library has wavelengths that are not finite, or not above 0",
            mend="drop these bands with .isel",
            code="wavelength-range",
        )
    return library.assign_coords({n: v for n, v in variables.items() if n in library.coords}).assign(
        {n: v for n, v in variables.items() if n not in library.coords}
    )


def _is_plain_number(library: xr.Dataset, name: str) -> bool:
    # Whether a variable is a count or a share without the attribute units; only spectra must have units
    units = LIBRARY_VARIABLES[name].units
    is_scalar = name in library.variables and BAND not in library[name].dims
    return is_scalar and units == "1" and "units" not in library[name].attrs


def names_of(library: xr.Dataset) -> list[str]:
    """Return the names of the paints.

    Raises SchemaError: Names are not text, or hold line breaks or control characters; all are listed.
    """
    problems = Problems("the library cannot be written", SchemaError)
    names: list[Any] = library[SIGNATURE].values.tolist()
    for at, name in enumerate(names):
        if not isinstance(name, str):
            problems.add(f"paint {at} is named {name!r}", expected="text", code="type-wrong")
        elif any(unicodedata.category(character) in _CONTROL for character in name):
            problems.add(
                f"paint {at} is named {name[:60]!r}",
                expected="no line breaks or control characters",
                code="name-unwritable",
            )
        if len(problems) == _MAX_SHOWN:
            break
    problems.raise_if_any()
    return names


def spectral_variables(library: xr.Dataset) -> list[str]:
    """Return the names of the variables with a value at every band of a paint: centre first, members last.

    They are sorted, since the order of xarray's coordinates differs from process to process.
    """
    names = [
        str(name)
        for name, variable in library.variables.items()
        if {SIGNATURE, BAND} <= set(variable.dims) and variable.dtype.kind == "f" and variable.ndim <= 3
    ]
    return sorted(names, key=lambda name: (name != CENTRE, MEMBER in library[name].dims, name))


def blocks_of(library: xr.Dataset, names: Sequence[str], progress: Progress | None = None) -> Iterator[Block]:
    """Yield the records of variables in blocks of some 16 MiB, without the padding after the last member.

    Lazy arrays are computed in chunks of paints. ``progress`` counts the paints of all variables.
    """
    paints = library.sizes[SIGNATURE]
    for number, name in enumerate(names):
        array = library[name]
        inner = [dim for dim in array.dims if dim not in (SIGNATURE, BAND)]
        array = array.transpose(SIGNATURE, *inner, BAND)
        # ranges of paints: the chunks of dask, else as many as fit a block
        if array.chunks is not None:
            edges = [0, *itertools.accumulate(array.chunks[0])]
        else:
            step = max(1, _BLOCK_BYTES // max(1, array.nbytes // array.shape[0]))
            edges = [*range(0, array.shape[0], step), array.shape[0]]
        for start, stop in itertools.pairwise(dict.fromkeys(edges)):
            values: Floats32 = np.asarray(array[start:stop].values, np.float32)
            if inner:
                is_stored = np.ones(values.shape[:2], np.bool_)
                if inner == [MEMBER]:
                    has_value: npt.NDArray[np.bool_] = np.any(~np.isnan(values), axis=2)
                    # up to the last member that has a value
                    is_stored[:] = np.logical_or.accumulate(has_value[:, ::-1], axis=1)[:, ::-1]
                paint, number_in_paint = np.nonzero(is_stored)
                yield Block(name, paint + start, number_in_paint, values[is_stored])
            else:
                paint = np.arange(start, stop)
                yield Block(name, paint, np.full(stop - start, -1), np.ascontiguousarray(values))
            if progress is not None:
                progress(number * paints + stop, len(names) * paints)


# --- and back ----------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Placement:
    """Positions of the records of one variable in its array."""

    records: Ints  #: (record,): Numbers of the records in the file, ascending.
    paint: Ints  #: (record,): As in `Block`.
    inner: Ints  #: (record,): As in `Block`.
    values: Floats32  #: The array; `put` fills it, NaN elsewhere.

    def put(self, first_record: int, rows: Floats32) -> None:
        """Store the rows of this variable from a block of consecutive records."""
        low, high = np.searchsorted(self.records, (first_record, first_record + len(rows)))
        values = rows[self.records[low:high] - first_record]
        if self.values.ndim == 2:
            self.values[self.paint[low:high]] = values
        else:
            self.values[self.paint[low:high], self.inner[low:high]] = values


def placements(keys: Sequence[Key], paints: int, bands: int, source: str) -> dict[str, Placement]:
    """Return the placement of the records of every variable.

    Raises FormatError: Records occur twice or are missing; or few paints have so many members that the
        arrays would be mostly padding.
    """
    by_variable: dict[str, Placement] = {}
    for variable in dict.fromkeys(key[0] for key in keys):
        records = np.array([k for k, key in enumerate(keys) if key[0] == variable], np.int64)
        paint = np.array([keys[k][1] for k in records], np.int64)
        inner = np.array([keys[k][2] for k in records], np.int64)
        if np.unique(np.stack([paint, inner]), axis=1).shape[1] != len(records):
            raise FormatError(
                f"{source}: a record of {variable!r} occurs twice",
                mend="write the library again",
                code="record-duplicate",
            )
        if len(set((inner < 0).tolist())) > 1 or (inner[0] < 0 and len(records) != paints):
            raise FormatError(
                f"{source}: {len(records)} records of {variable!r} for {paints} paints",
                mend="write the library again",
                code="length-mismatch",
            )
        inner_sizes = () if inner[0] < 0 else (int(inner.max()) + 1,)
        cells, stored_cells = paints * bands * (inner_sizes or (1,))[0], len(records) * bands
        # with padding at most 64 times the stored cells, less in large files
        if cells > max(_ALWAYS_ALLOWED_CELLS, min(64 * stored_cells, _LARGE_CELLS + 8 * stored_cells)):
            raise FormatError(
                f"{source}: {len(records)} records of {variable!r} would need {cells} cells",
                mend="check whether the file is damaged",
                code="file-too-large",
            )
        values = np.full((paints, *inner_sizes, bands), np.nan, np.float32)
        by_variable[variable] = Placement(records, paint, inner, values)
    return by_variable


def restored(
    path: Path,
    names: Sequence[str],
    keys: Sequence[Key],
    axes: Mapping[str, Any],
    rows: Iterable[tuple[int, Floats32]],
    columns: Mapping[str, Sequence[str]],
) -> xr.Dataset:
    """Return the library of a file of records, with the metadata beside it.

    names: Names of the paints; keys: keys of the records; axes: see `with_metadata`.
    rows: Blocks of records with the number of their first record.
    columns: Properties of the paints in the file; those in the metadata take precedence.
    Raises FormatError: Records or metadata are damaged, or belong to different libraries.
    Warns PaintWarning: The metadata are missing, or the columns of the file differ.
    """
    bands = len(axes["wavelength"])
    by_variable = placements(keys, len(names), bands, path.name)
    sidecar = metadata_path(path)
    metadata = read_metadata(sidecar, {SIGNATURE: len(names), BAND: bands}) if sidecar.exists() else None
    if metadata is None:
        text = f"{path.name}: {sidecar.name} is missing: names and columns are from the file, without units"
        warnings.warn(PaintWarning(text, code="metadata-missing"), stacklevel=6)
    for first_record, block in rows:
        for placement in by_variable.values():
            placement.put(first_record, block)
    data = {name: placement.values for name, placement in by_variable.items()}
    library = with_metadata(data, axes, names, metadata, path.name)
    stored_columns = {} if metadata is None else table_columns(library)
    if edited := [name for name, cells in columns.items() if list(cells) != stored_columns.get(name, cells)]:
        text = (
            f"{path.name}: {', '.join(edited)} differ from {sidecar.name}, which is used; delete it to use "
            "the table"
        )
        warnings.warn(PaintWarning(text, code="metadata-differ"), stacklevel=6)
    # names in the table of variables are excluded: their columns have no units
    reserved = {*library.variables, *library.dims, *LIBRARY_VARIABLES}
    added = {}
    for name, cells in columns.items():
        if name not in reserved:
            values = numbers(cell or "nan" for cell in cells)
            is_text = values is None or not any(cells)
            added[name] = (SIGNATURE, text_column(cells) if is_text else np.array(values))
    return library.assign_coords(added)


def with_metadata(
    data: Mapping[str, Floats32],
    axes: Mapping[str, Any],
    names: Sequence[str],
    metadata: Metadata | None,
    source: str,
) -> xr.Dataset:
    """Return spectra and their metadata as a library.

    data: Values of the variables (signature, band) or (signature, number, band).
    axes: Wavelengths and further coordinates of the bands in the file of spectra.
    names: Names of the paints in the file of spectra; names in the metadata take precedence.
    metadata: None if it is missing.
    Raises FormatError: Spectra and metadata belong to different libraries.
    """
    rows = LIBRARY_VARIABLES
    problems = Problems(f"{source} and its metadata belong to different libraries", FormatError)
    library = xr.Dataset()
    for name, values in data.items():
        dims, attrs = _dims_and_attrs(name, values.ndim, metadata)
        if len(dims) != values.ndim or dims[0] != SIGNATURE or dims[-1] != BAND:
            problems.add(
                f"{name!r} has {values.ndim} dims", expected=f"{dims}, as in the metadata", code="dims-wrong"
            )
            continue
        if clash := sorted(set(dims) & data.keys()):
            problems.add(
                f"{clash[0][:60]!r} is the name of a variable and of a dim of {name!r}", code="name-clash"
            )
            continue
        if values.ndim == 3 and metadata is not None:
            # restore the padding of the members, unless it is out of proportion
            size, members = metadata.sizes.get(dims[1]), values.shape[1]
            if size is not None and members <= size <= 8 * max(members, 8):
                values = np.pad(values, ((0, 0), (0, size - members), (0, 0)), constant_values=np.nan)
        if any(library.sizes.get(dim, size) != size for dim, size in zip(dims, values.shape, strict=True)):
            problems.add(
                f"{name!r} is {values.shape}", expected=str(dict(library.sizes)), code="grid-mismatch"
            )
            continue
        library[name] = (dims, values, attrs)
    if metadata is not None:
        for missing in sorted(metadata.spectra.keys() - data.keys()):
            problems.add(f"{missing[:60]!r} has no record in the file", code="record-unmatched")
    problems.raise_if_any()
    coords: dict[str, Any] = {SIGNATURE: (SIGNATURE, text_column(names), rows[SIGNATURE].attrs)}
    coords |= {name: (BAND, values, rows[name].attrs) for name, values in axes.items() if values is not None}
    if metadata is None:
        return library.assign_coords(coords).assign_attrs(title="Spectral library", source=source)
    for name in sorted(metadata.variables.keys() & library.variables.keys()):
        problems.add(f"{name[:60]!r} is both among the spectra and in the metadata", code="name-clash")
    for name, (dims, values, _) in metadata.variables.items():
        if name in coords and name != SIGNATURE and not np.array_equal(values, coords[name][1]):
            problems.add(
                f"{name!r} of the file and of the metadata differ",
                mend="put the files of one library together",
                code="grid-mismatch",
            )
        if any(library.sizes.get(dim, size) != size for dim, size in zip(dims, values.shape, strict=True)):
            problems.add(
                f"{name[:60]!r} is {values.shape} on {dims}",
                expected=str(dict(library.sizes)),
                code="grid-mismatch",
            )
        if name in library.dims and dims != (name,):
            problems.add(f"{name!r} is the name of a dim", expected=f"dims ({name},)", code="dims-wrong")
    problems.raise_if_any()
    own_coords = {name: coord for name, coord in coords.items() if name not in metadata.variables}
    library = library.assign(metadata.variables).assign_coords(own_coords)
    coordinates = sorted(metadata.coordinates & set(map(str, library.variables)))
    return library.set_coords(coordinates).assign_attrs(metadata.attrs)


def _dims_and_attrs(
    name: str, ndim: int, metadata: Metadata | None
) -> tuple[tuple[str, ...], dict[str, Any]]:
    if metadata is not None and name in metadata.spectra:
        return metadata.spectra[name]
    row = LIBRARY_VARIABLES.get(name)
    if row is not None and len(row.dims) == ndim:
        return row.dims, dict(row.attrs)
    return (SIGNATURE, BAND) if ndim == 2 else (SIGNATURE, f"place_of_{name}", BAND), {}
