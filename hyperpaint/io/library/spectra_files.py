"""Files of spectra: texts of other programs; paint libraries as records with metadata: CSV, Parquet, ENVI.

Every spectrum of a library is one record: first the reflectance of all paints, then their further variables
on the bands, then their members. The key of a record is its variable, its paint, and its number within the
paint. The metadata, ``<data file>.json``, are the library as `xarray.Dataset.to_dict` describes it, without
the values of its spectra: strict JSON with one variable per line, for readers and version control.

A plain table has wavelengths in the first column, and a spectrum in every further column. A file of ECOSTRESS
(version 1) or its forerunner ASTER (version 2) has lines ``Key: value``, an empty line, then x and y a line;
the values of ASTER files wrap over lines without a key. A file of the USGS library (splib06, splib07) has a
title, then one value a line; wavelengths and bandwidths are in separate files, one for each spectrometer,
beside the spectra or in a folder above.

CSV: every row is a spectrum: name of the paint, its properties (one column each), then reflectance. The first
row has the names of the columns, and the wavelengths [nm]; the metadata have the units. EcoSIS accepts such
tables. A library with further spectra beside the centres has two more columns after the name: ``variable``
(``reflectance``, ``member_reflectance``, ...) and ``place``, the number, from 1, of a spectrum of which a
paint has several.

Parquet: a row per spectrum in the columns of OpenSpecLib, for pandas and DuckDB. Files of hyperpaint have the
metadata of the library in ``<file>.json``, and the key of every spectrum in
``additional_properties``. Other files need equal wavelengths in all rows.

ENVI: a header, and a file in which every line is a spectrum. The first two records of a library of the USGS
are wavelengths and bandwidths, and its records "error bars to preceding" belong to the spectrum before them;
neither is a spectrum. Libraries of hyperpaint have ``hyperpaint library = 1`` in their header; the name of a
record there contains its paint, variable and index (``red | member 3``). If every record is a
paint, the header has lists such as ``paint make`` and ``paint year`` with a value per paint.
"""

import contextlib
import csv
import io
import itertools
import json
import math
import os
import re
import unicodedata
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import NoneType, SimpleNamespace
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base import (
    BAND,
    LIBRARY_VARIABLES,
    MEMBER,
    NEW_NAMES,
    SIGNATURE,
    VERSION_NAME,
    Array,
    Bools,
    Floats,
    Floats32,
    FormatError,
    Ints,
    Problem,
    Problems,
    Progress,
    SchemaError,
    fetch,
    find,
    json_of,
    needs_extra,
    open_input,
    quality_attrs,
    read_limited,
    refuse_constant,
    warn_if,
    warn_of_old_names,
    warn_user,
    with_band_dim,
)
from hyperpaint.io.envi.envi_cubes import (
    MAX_LIBRARY_HEADER_BYTES,
    EnviHeader,
    bare,
    braced,
    find_pair,
    read_header,
)
from hyperpaint.io.files.reading import (
    cells_of,
    first_row,
    number,
    numbers,
    read_text,
    refuse,
    row_numbers,
    safe_cell,
    text_of_cell,
    unique_names,
)
from hyperpaint.io.spectrometers.spectrum_texts import (
    MEAN,
    SPREAD,
    STATISTIC,
    heading_cells,
    statistics_among,
)

#: Wavelength range of spectral libraries [nm]: far ultraviolet to far infrared (USGS libraries end at 216
#: um). Visible wavelengths in nanometres, read as micrometres, are larger.
MIN_NM, MAX_NM = 100.0, 3e5

#: Message for options that replace data of a library of hyperpaint.
OWN_AXES = (
    "{} is a library of hyperpaint with its own axes and scale: leave wavelength=, fwhm= and scale= out"
)

_PLAUSIBLE = SimpleNamespace(
    #: Maximum median of reflectance as a fraction: a white panel has 1.
    max_median=1.1,
    bright=1.2,
    #: Maximum share of values above `_PLAUSIBLE.bright` in reflectance: noise in opaque bands of air has
    #: 0.05, the brightest of the 2457 spectra of splib07 has 0.01, radiance of a lawn in uW cm-2 sr-1 nm-1
    #: has 0.5.
    max_bright_share=0.1,
    #: Minimum of the largest value of a file; below it the scale is doubtful: black coats reach 0.02 to 0.05.
    min_brightest=0.01,
    #: Stored values that mark missing samples.
    missing_values=(-999.0, -9999.0, -99999.0, -32768.0),
    #: Minimum reflectance with noise [1]: lower values mark missing samples.
    min_reflectance=-0.5,
    #: Maximum of fill values: deleted points of USGS spectra are -1.23e34, and fractions of it in spectra
    #: convolved to another spectrometer.
    max_fill_value=-1e20,
)


@dataclass(frozen=True, eq=False)
class Spectra:
    # Spectra of one file with common wavelengths.
    source: str  # file name
    form: str  # name of the format
    names: Sequence[str]  # of the spectra, as in the file
    wavelength: Floats  # (band) [nm], in the order of the file
    reflectance: Floats32  # (signature, band) as a fraction; NaN for missing samples
    fwhm: Floats | None = None  # (band) [nm]; None if not in the file
    good: Bools | None = None
    # Further variables (signature, band) by their names in `LIBRARY_VARIABLES`
    others: Mapping[str, Floats32] = field(default_factory=dict)
    # Further variables with one value per spectrum
    columns: Mapping[str, Sequence[Any] | Array] = field(default_factory=dict)
    notes: Sequence[str] = ()  # inferred or doubtful properties


def library_of(spectra: Spectra) -> xr.Dataset:
    # Return spectra as a paint library.
    # Raises FormatError: Wavelengths are not finite or outside 100 nm to 300 um, or their number is not that
    # of the bands.
    check_wavelengths(spectra.wavelength, spectra.source)
    bands = spectra.reflectance.shape[1]
    for name, axis in (("wavelength", spectra.wavelength), ("fwhm", spectra.fwhm)):
        if axis is not None and axis.shape != (bands,):
            raise FormatError(
                f"{spectra.source}: {axis.size} values of {name} for {bands} bands",
                mend="pass one value per band",
                code="length-mismatch",
            )
    rows = LIBRARY_VARIABLES
    data = {"reflectance": spectra.reflectance, **spectra.others}
    variables = {name: ((SIGNATURE, BAND), values, dict(rows[name].attrs)) for name, values in data.items()}
    variables["reflectance"][2]["long_name"] = "Reflectance, as the library gives it"
    axes = {"wavelength": spectra.wavelength, "fwhm": spectra.fwhm, "good": spectra.good}
    coords: dict[str, Any] = {SIGNATURE: (SIGNATURE, text_column(spectra.names), rows[SIGNATURE].attrs)}
    coords |= {name: (BAND, values, rows[name].attrs) for name, values in axes.items() if values is not None}
    for name, column in spectra.columns.items():
        row_attrs = rows[name].attrs if name in rows else {"long_name": name.replace("_", " ").capitalize()}
        flags = quality_attrs() if name == "quality" else {}
        coords[name] = (SIGNATURE, np.asarray(column), {**row_attrs, **flags})
    attrs: dict[str, Any] = {"title": "Spectral library", "source": spectra.source, "format": spectra.form}
    if spectra.notes:
        attrs["notes"] = "; ".join(spectra.notes)
    return with_numbers_as_data(xr.Dataset(variables, coords=coords, attrs=attrs))


def with_numbers_as_data(library: xr.Dataset) -> xr.Dataset:
    # Return a library with counts, flags and angles as data variables, not coordinates.
    rows = LIBRARY_VARIABLES
    return library.reset_coords([str(n) for n in library.coords if n in rows and not rows[str(n)].coordinate])


def text_column(texts: Sequence[str]) -> Array:
    # Return texts as an array of objects, as stores hold them.
    return np.array(list(texts), object)


def check_wavelengths(wavelength: Floats, source: str) -> None:
    # Check that there are wavelengths [nm], within the range and without duplicates.
    # Raises FormatError: There are none; they are not finite, outside 100 nm to 300 um, or duplicate.
    is_known = wavelength.size and np.isfinite(wavelength).all()
    low, high = (float(wavelength.min()), float(wavelength.max())) if is_known else (np.nan, np.nan)
    hint = " (nanometres declared as micrometres?)" if low >= MIN_NM * 1e3 and high <= MAX_NM * 1e3 else ""
    values, counts = np.unique(wavelength, return_counts=True)
    repeated = values[counts > 1].tolist()
    refuse(
        source,
        (
            not (low >= MIN_NM and high <= MAX_NM),
            Problem(
                f"wavelengths from {low:g} to {high:g} nm{hint}"
                if is_known
                else f"{wavelength.size} wavelengths, not all of them finite",
                expected=f"{MIN_NM:g} nm to {MAX_NM:g} nm",
                mend="check their units, or pass wavelength= [nm]",
                code="wavelength-range",
            ),
        ),
        (
            repeated,
            Problem(
                f"{len(repeated)} wavelengths occur twice, such as {sum(repeated[:1]):g} nm",
                expected="distinct wavelengths",
                mend="drop one of the two bands",
                code="wavelength-duplicate",
            ),
        ),
    )


def reflectances(
    stored: Array,
    source: str,
    *,
    file_scale: float | None,
    scale: float | None,
    ignore: Any = None,
    is_reflectance: bool = False,
) -> Floats32:
    # Return stored values as reflectance.
    #
    # file_scale, scale: Stored value of a reflectance of one, from the file and from the caller; that of the
    #     caller is preferred.
    # ignore: Stored value of missing samples, besides the fill values of the USGS.
    # is_reflectance: Whether values above 1 are accepted.
    # Returns numpy.ndarray: float32; a fraction.
    # Raises FormatError: The scale is unknown and the values are not fractions; or they do not fit float32.
    # Warns PaintWarning: Values far below 0 were taken for missing; or the scale is doubtful.
    with np.errstate(all="ignore"):  # signalling NaNs of a damaged file
        values = stored.astype(np.float64)
        is_fill = values < _PLAUSIBLE.max_fill_value
    if ignore is not None:
        # compared in the stored dtype: a float32 file holds the float32 nearest to the number in its header
        with np.errstate(over="ignore"):
            is_fill |= stored == (stored.dtype.type(ignore) if stored.dtype.kind == "f" else ignore)
    values[is_fill] = np.nan
    divisor = scale if scale is not None else file_scale
    with np.errstate(over="ignore"):
        far_below = np.isfinite(values) & (values < _PLAUSIBLE.min_reflectance * (divisor or 1.0))
        is_missing = np.isin(values, _PLAUSIBLE.missing_values) | far_below
    if is_missing.any():
        count, example = int(is_missing.sum()), float(values[is_missing][0])
        warn_user(
            f"{source}: {count} value{'s'[: count - 1]} far below 0, such as {example:g}, taken for missing",
            "values-far-below-zero",
        )
        values[is_missing] = np.nan
    if divisor is None:
        max_bright_share = _PLAUSIBLE.max_bright_share if not is_reflectance else 1.0
        # values without a scale must be fractions; if only few spectra are not, warn
        finite = np.isfinite(values)
        magnitudes = np.abs(values[finite])
        advice = (
            "pass scale=100 (hp.open_library) for percent, 10000 for hundredths of a percent, or scale=1 if "
            "values are fractions"
        )
        largest = magnitudes.max(initial=0.0)
        median = float(np.median(magnitudes)) if magnitudes.size else 0.0
        with np.errstate(invalid="ignore"):
            is_bright = (np.abs(values) > _PLAUSIBLE.bright).sum(axis=1) > max_bright_share * np.maximum(
                finite.sum(axis=1), 1
            )
        refuse(
            source,
            (
                median > _PLAUSIBLE.max_median,
                Problem(
                    f"values up to {largest:g}, half of them above {median:g}, and no scale (radiance or "
                    "counts?)",
                    expected="reflectance as a fraction",
                    mend=advice,
                    code="scale-missing",
                ),
            ),
            (
                2 * is_bright.sum() > len(values),
                Problem(
                    f"values up to {largest:g}, more than a tenth above {_PLAUSIBLE.bright:g} (radiance?)",
                    expected="reflectance as a fraction",
                    mend=f"{advice} (for a text: quantity='reflectance')",
                    code="scale-missing",
                ),
            ),
        )
        is_bright = is_bright | [
            bool(is_finite.any()) and float(np.median(spectrum[is_finite])) > _PLAUSIBLE.max_median
            for spectrum, is_finite in zip(values, finite, strict=True)
        ]
        warn_if(
            is_bright.any(),
            f"{source}: {is_bright.sum()} of {len(values)} spectra have many values above "
            f"{_PLAUSIBLE.max_median:g}, up to {largest:g}, and no scale; {advice}",
            "scale-missing",
        )
    elif divisor != 1.0:
        values /= divisor
        finite = values[np.isfinite(values)]
        # the scale is doubtful if many values exceed `_PLAUSIBLE.bright`, or all are near 0
        if finite.any() and (
            (finite > _PLAUSIBLE.bright).mean() > _PLAUSIBLE.max_bright_share
            or finite.max() < _PLAUSIBLE.min_brightest
        ):
            warn_user(
                f"{source}: reflectance up to {finite.max():.3g} with a scale of {divisor:g}; pass scale=",
                "scale-doubtful",
            )
    with np.errstate(over="ignore"):
        reflectance = values.astype(np.float32)
    if not np.isfinite(reflectance[np.isfinite(values)]).all() or np.isinf(values).any():
        largest = np.abs(values[~np.isnan(values)]).max()
        raise FormatError(
            f"{source}: values up to {largest:g}", expected="finite reflectance", code="not-finite"
        )
    return reflectance


# --- records -----------------------------------------------------------------------------------------------


CENTRE = "reflectance"
_BLOCK_BYTES = 16 * 2**20
#: Number of cells of an array that is always allowed; and the number above which padding is limited to seven
#: times the stored cells.
_ALWAYS_ALLOWED_CELLS, _LARGE_CELLS = 2**22, 2**29
#: Unicode categories of characters that names must not have.
_CONTROL = ("Cc", "Cs", "Zl", "Zp")
_MAX_SHOWN = 5

#: Version of the metadata: 2 had one table of variables in place of ``coords`` and ``data_vars``; 1, of
#: hyperpaint 0.2 and before, had the dimension `paint` too.
VERSION = 3
MAX_METADATA_BYTES = 16 * 2**20
_MAX_DIMS = 4
#: Types of JSON values by the kind of the dtype.
_JSON_TYPES: dict[str, set[type]] = {
    "U": {str},
    "M": {str},
    "b": {bool},
    "f": {int, float, NoneType},
    "i": {int},
    "u": {int},
}
_DTYPES = (
    "bool",
    "int8",
    "int16",
    "int32",
    "int64",
    "uint8",
    "uint16",
    "uint32",
    "uint64",
    "float32",
    "float64",
    "str",
    "datetime64[ns]",
)
_TIME = re.compile(r"[0-9]{4}-[0-9]{2}-[0-9]{2}T[0-9]{2}:[0-9]{2}:[0-9]{2}\.[0-9]{9}")
#: Variables omitted from tables: outlines as JSON, columns of the format, words that read as numbers.
_NO_COLUMNS = ("region", "variable", "place", "nan", "inf", "infinity")

#: Variable, number of the paint, and number within the paint, both from 0; the latter is -1 if a paint has
#: only one spectrum of the variable.
Key = tuple[str, int, int]

#: Some records of one variable: its name; numbers of the paint and within the paint (record,), as in `Key`;
#: values (record, band).
Block = tuple[str, Ints, Ints, Floats32]


def checked_library(library: xr.Dataset) -> xr.Dataset:
    # Return a library in the units of the table; values are not checked.
    # Raises SchemaError: It is not a paint library: variables are missing, or have other dims or units; all
    # are listed.
    library = with_band_dim(library)
    found = {name: library[name] for name in LIBRARY_VARIABLES if name in library.variables}
    # a count or a share may lack the attribute units; only spectra must have units
    plain_numbers = {
        name
        for name, array in found.items()
        if BAND not in array.dims and LIBRARY_VARIABLES[name].units == "1" and "units" not in array.attrs
    }
    required = dict.fromkeys((SIGNATURE, CENTRE, "wavelength", *found))
    variables, faults = find(
        library, [name for name in required if name not in plain_numbers], LIBRARY_VARIABLES
    )
    with Problems("the library cannot be written", SchemaError) as problems:
        problems.extend(faults)
        for name, array in variables.items():
            dtype = LIBRARY_VARIABLES[name].dtype
            kind = np.dtype("object" if dtype == "str" else dtype).kind
            problems.add_if(
                array.dtype.kind not in {"f": "fiu", "i": "iu", "u": "iu", "O": "OUT"}.get(kind, kind),
                f"{name!r} is {array.dtype}",
                expected=str(dtype),
                code="type-wrong",
            )
            problems.add_if(
                name in ("wavelength", "fwhm", "good") and array.dims != (BAND,),
                f"{name!r} has dims {array.dims}",
                expected="one value a band",
                code="dims-wrong",
            )
        if CENTRE in variables and not variables[CENTRE].size:
            problems.add(
                f"reflectance has sizes {dict(variables[CENTRE].sizes)}",
                expected="at least one paint and one band",
                code="empty-input",
            )
        problems.extend(
            Problem(
                f"{key!r} has dims {variable.dims}",
                expected="at most one dim beside signature and band",
                code="dims-wrong",
            )
            for key, variable in library.variables.items()
            if {SIGNATURE, BAND} < set(variable.dims) and variable.dtype.kind == "f" and variable.ndim > 3
        )
    wavelength = np.asarray(variables["wavelength"].values, np.float64)
    SchemaError.raise_if(
        not (np.isfinite(wavelength).all() and (wavelength > 0).all()),
        "the library has wavelengths that are not finite, or not above 0",
        mend="drop these bands with .isel",
        code="wavelength-range",
    )
    coords = [name for name in variables if name in library.coords]
    return library.assign_coords({name: variables.pop(name) for name in coords}).assign(variables)


def names_of(library: xr.Dataset) -> list[str]:
    # Return the names of the paints.
    # Raises SchemaError: Names are not text, or hold line breaks or control characters; all are listed.
    with Problems("the library cannot be written", SchemaError) as problems:
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
    return names


def spectral_variables(library: xr.Dataset) -> list[str]:
    # Return the names of the variables with a value at every band of a paint: centre first, members last.
    # They are sorted, since the order of xarray's coordinates differs from process to process.
    names = [
        str(name)
        for name, variable in library.variables.items()
        if {SIGNATURE, BAND} <= set(variable.dims) and variable.dtype.kind == "f" and variable.ndim <= 3
    ]
    return sorted(names, key=lambda name: (name != CENTRE, MEMBER in library[name].dims, name))


def blocks_of(library: xr.Dataset, names: Sequence[str], progress: Progress | None = None) -> Iterator[Block]:
    # Yield the records of variables in blocks of some 16 MiB, without the padding after the last member.
    # Lazy arrays are computed in chunks of paints. ``progress`` counts the paints of all variables.
    paints = library.sizes[SIGNATURE]
    for position, name in enumerate(names):
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
                    has_value: Bools = np.any(~np.isnan(values), axis=2)
                    # up to the last member that has a value
                    is_stored[:] = np.logical_or.accumulate(has_value[:, ::-1], axis=1)[:, ::-1]
                paint, number_in_paint = np.nonzero(is_stored)
                yield name, paint + start, number_in_paint, values[is_stored]
            else:
                paint = np.arange(start, stop)
                yield name, paint, np.full(stop - start, -1), np.ascontiguousarray(values)
            if progress is not None:
                progress(position * paints + stop, len(names) * paints)


def metadata_path(data: Path) -> Path:
    # Return the path of the metadata of a data file.
    return data.with_name(data.name + ".json")


def metadata_text(library: xr.Dataset, spectra: Sequence[str]) -> str:
    # Return all of a library except the values of its spectra, as JSON.
    # Raises SchemaError: Attributes or values cannot be written as JSON; all are listed. Or the text is too
    # large.
    with Problems("the library's metadata cannot be written", SchemaError) as problems:
        document = {"hyperpaint_library": VERSION, **library.to_dict(data=False)}
        entries = document["coords"] | document["data_vars"]
        owners = {
            "the library": document["attrs"],
            **{name: entry["attrs"] for name, entry in entries.items()},
        }
        for owner, key, value in [(name, *item) for name, attrs in owners.items() for item in attrs.items()]:
            try:
                json_of({key: value})
            except (TypeError, ValueError, RecursionError):
                problems.add(
                    f"attribute {key!r} of {owner} is {str(value)[:60]!r}",
                    expected="text or numbers",
                    code="type-wrong",
                )
        for name in [name for name in entries if name not in spectra]:
            values = library.variables[name].values
            dtype = "str" if values.dtype.kind in "OUT" else str(values.dtype)
            data = values.astype(object)
            if dtype not in _DTYPES or (dtype == "str" and not all(isinstance(v, str) for v in data.flat)):
                kinds = sorted({type(value).__name__ for value in data.flat if not isinstance(value, str)})
                problems.add(
                    f"{name!r} is {values.dtype}{' with values of type ' * bool(kinds)}{', '.join(kinds)}",
                    expected="numbers, booleans, text or datetime64[ns]",
                    code="type-wrong",
                )
            elif dtype == "datetime64[ns]":
                data = np.where(np.isnat(values), "", np.datetime_as_string(values))
            elif values.dtype.kind == "f":
                data[np.isnan(values)] = None
                problems.add_if(
                    np.isinf(values).any(),
                    f"{name!r} contains infinity",
                    expected="finite numbers or NaN",
                    code="not-finite",
                )
            entries[name] |= {"dtype": dtype, "data": data.tolist()}
    # xarray gathers coordinates from sets, whose order differs from run to run
    parts = {
        part: dict(sorted((str(k), v) for k, v in document.pop(part).items()))
        for part in ("coords", "data_vars")
    }
    document["dims"] = dict(sorted(document["dims"].items()))
    lines = [f"  {json_of(key)}: {json_of(value)}" for key, value in document.items()]
    for part, variables in parts.items():
        rows = ",\n".join(f"    {json_of(name)}: {json_of(entry)}" for name, entry in variables.items())
        lines.append(f"  {json_of(part)}: {{\n{rows}\n  }}")
    text = "{\n" + ",\n".join(lines) + "\n}\n"
    SchemaError.raise_if(
        len(text.encode()) > MAX_METADATA_BYTES,
        f"the metadata of the library take {len(text.encode())} bytes",
        expected=f"at most {MAX_METADATA_BYTES}",
        mend="drop variables, write fewer paints, or write Zarr",
        code="file-too-large",
    )
    return text


def paint_columns(library: xr.Dataset) -> dict[str, list[Any]]:
    # Return the variables with one value per paint as texts and numbers, NaN and infinity as None.
    columns: dict[str, list[Any]] = {}
    for name in sorted(library.variables, key=str):  # xarray's order of coordinates differs from run to run
        array = library.variables[name]
        # the name of the source file is not written
        if array.dims != (SIGNATURE,) or name in (SIGNATURE, "file") or not str(name).isidentifier():
            continue
        values = array.values
        if values.dtype.kind == "M":
            columns[str(name)] = ["" if np.isnat(value) else str(value) for value in values]
        elif values.dtype.kind in "biufOUT":
            columns[str(name)] = [
                None if isinstance(v, float) and not math.isfinite(v) else v for v in values.tolist()
            ]
    return columns


def table_columns(library: xr.Dataset) -> dict[str, list[str]]:
    # Return the variables with one value per paint as cells of a table, without line breaks.
    return {
        name: [" ".join(str("" if value is None else value).split()) for value in values]
        for name, values in paint_columns(library).items()
        if name.lower() not in _NO_COLUMNS
    }


# --- and back ----------------------------------------------------------------------------------------------


def read_metadata(path: Path, sizes: Mapping[str, int]) -> xr.Dataset:
    # Read the metadata of a library; spectra are NaN without memory.
    # sizes: Sizes of signature and band in the data file. Raises FormatError: The file is not from
    # `metadata_text`, or belongs to another library; all problems are listed.
    problems = Problems(f"{path.name} is not the metadata of its library", FormatError)
    raw = read_limited(path, MAX_METADATA_BYTES, "metadata of a paint library")
    about = xr.Dataset()
    try:
        document = json.loads(raw.decode("utf-8"), parse_constant=refuse_constant)
        if document["hyperpaint_library"] not in (1, 2, VERSION):
            raise ValueError(f"expected version {VERSION}")
        if document["hyperpaint_library"] == 1:
            warn_of_old_names(path.name)
        if document["hyperpaint_library"] < VERSION:
            # metadata of versions 1 and 2 in the form of version 3
            names = NEW_NAMES if document["hyperpaint_library"] == 1 else {}
            all_sizes = {**document["sizes"], **sizes}
            parts: dict[str, Any] = {"coords": {}, "data_vars": {}}
            for name, entry in {**document["variables"], **document["spectra"]}.items():
                dim_names = [names.get(dim, dim) for dim in entry["dims"]]
                data = (
                    {"data": entry["values"]}
                    if "values" in entry
                    else {"shape": [all_sizes[dim] for dim in dim_names]}
                )
                target = parts["coords" if entry.get("coordinate") is True else "data_vars"]
                target[names.get(name, name)] = {"dtype": "float32", **entry, "dims": dim_names, **data}
            attributes = {
                key: 2 if key == VERSION_NAME and value == 1 else value
                for key, value in document["attrs"].items()
            }
            document = {"attrs": attributes, **parts}
        for part in ("coords", "data_vars"):
            for name, entry in document[part].items():
                try:
                    # A variable for `xarray.Dataset.from_dict`
                    dims, attrs = entry["dims"], dict(entry["attrs"])
                    if (
                        len(set(dims)) != len(dims)
                        or len(dims) > _MAX_DIMS
                        or not all(isinstance(dim, str) for dim in dims)
                    ):
                        raise ValueError("expected distinct dims")
                    if "data" in entry:
                        nested = np.array(entry["data"], object)
                        if nested.ndim != len(dims) or any(isinstance(value, list) for value in nested.flat):
                            raise ValueError("expected nested lists of equal lengths, one level per dim")
                        values = typed_values(nested.ravel().tolist(), entry["dtype"]).reshape(nested.shape)
                    else:
                        # only spectra lack values; an axis without values would fill the memory
                        if not (
                            {SIGNATURE, BAND} <= {*dims}
                            and all(type(s) is int and 0 <= s < 2**31 for s in entry["shape"])
                        ):
                            raise ValueError("expected values, or a spectrum with sizes from 0 to 2147483647")
                        values = np.broadcast_to(np.float32(np.nan), entry["shape"])
                    if name == "quality":
                        attrs["flag_masks"] = quality_attrs()["flag_masks"]
                    document[part][name] = {"dims": dims, "attrs": attrs, "data": values}
                except (LookupError, TypeError, ValueError, OverflowError) as error:
                    problems.add(f"{name[:60]!r}: {error!s:.100}", code="metadata-damaged")
        if not len(problems):
            about = xr.Dataset.from_dict(document).assign_attrs(dict(document["attrs"]))
            sizes = {dim: size for dim, size in sizes.items() if about.sizes.get(dim, size) != size}
            problems.add_if(sizes, f"sizes {dict(about.sizes)}", expected=str(sizes), code="metadata-damaged")
    except (LookupError, TypeError, ValueError, AttributeError, RecursionError) as error:
        problems.add(
            f"not readable as JSON of a library ({error!s:.100})",
            expected=f'an object with "hyperpaint_library": {VERSION}',
            mend="copy the file again, or write the library again",
            code="metadata-damaged",
        )
    problems.raise_if_any()
    return about


def typed_values(flat: list[Any], dtype: str) -> Array:
    # Return values from JSON as an array.
    # Raises ValueError, OverflowError: A value is of another type, or out of range.
    if dtype not in _DTYPES:
        raise ValueError(f"expected a dtype of {', '.join(_DTYPES)}")
    kind = np.dtype(dtype).kind
    # bool is a subclass of int, and no number here
    if not set(map(type, flat)) <= _JSON_TYPES[kind]:
        raise ValueError(f"expected only {dtype} values")
    if dtype == "str":
        return text_column(flat)
    if kind == "M":
        # numpy wraps years outside the range of datetime64[ns] without an error
        for text in filter(None, flat):
            if _TIME.fullmatch(text) is None or not 1700 <= int(text[:4]) <= 2261:
                raise ValueError(
                    f"{text[:40]!r}, expected a time such as 2024-05-21T11:33:07.000000000, in 1700 to 2261"
                )
        return np.array([np.datetime64(text or "NaT", "ns") for text in flat], "datetime64[ns]")
    with np.errstate(over="ignore"):
        values: Array = np.array(flat, dtype)
    if kind == "f" and np.isinf(values).any():
        raise ValueError("a number is too large")
    return values


def restored(
    path: Path,
    names: Sequence[str],
    keys: Sequence[Key],
    axes: Mapping[str, Any],
    rows: Iterable[tuple[int, Floats32]],
    columns: Mapping[str, Sequence[str]],
) -> xr.Dataset:
    # Return the library of a file of records, with the metadata beside it.
    # names: Names of the paints, keys: keys of the records, axes: wavelengths and further coordinates of the
    # bands in the file of spectra; names in the metadata take precedence. rows: Blocks of records with the
    # number of their first record. columns: Properties of the paints in the file; those in the metadata take
    # precedence. Raises FormatError: Records or metadata are damaged, or belong to different libraries. Warns
    # PaintWarning: The metadata are missing, or the columns of the file differ.
    paints, bands, source = len(names), len(axes["wavelength"]), path.name
    # numbers of the variable, the paint, and the record within the paint
    variables = list(dict.fromkeys(key[0] for key in keys))
    variable_of = np.array([variables.index(key[0]) for key in keys], np.int64)
    paint_of, inner_of = (np.array([key[at] for key in keys], np.int64) for at in (1, 2))
    data: dict[str, Floats32] = {}
    for position, variable in enumerate(variables):
        paint, inner = paint_of[variable_of == position], inner_of[variable_of == position]
        members = int(inner.max()) + 1
        cells, stored_cells = paints * bands * max(members, 1), len(paint) * bands
        checks = (
            (
                np.unique(np.stack([paint, inner]), axis=1).shape[1] != len(paint),
                f"a record of {variable!r} occurs twice",
                "write the library again",
                "record-duplicate",
            ),
            (
                (inner < 0).any() and (members > 0 or len(paint) != paints),
                f"{len(paint)} records of {variable!r} for {paints} paints",
                "write the library again",
                "length-mismatch",
            ),
            # with padding at most 64 times the stored cells, less in large files
            (
                cells > max(_ALWAYS_ALLOWED_CELLS, min(64 * stored_cells, _LARGE_CELLS + 8 * stored_cells)),
                f"{len(paint)} records of {variable!r} would need {cells} cells",
                "check whether the file is damaged",
                "file-too-large",
            ),
        )
        refuse(
            source, *((wrong, Problem(found, mend=mend, code=code)) for wrong, found, mend, code in checks)
        )
        data[variable] = np.full((paints, *(() if members == 0 else (members,)), bands), np.nan, np.float32)
    sidecar = metadata_path(path)
    about = read_metadata(sidecar, {SIGNATURE: paints, BAND: bands}) if sidecar.exists() else None
    warn_if(
        about is None,
        f"{source}: {sidecar.name} is missing: names and columns are from the file, without units",
        "metadata-missing",
    )
    for first, block in rows:
        records = slice(first, first + len(block))
        for position, values in enumerate(data.values()):
            is_here = variable_of[records] == position
            paint, inner = paint_of[records][is_here], inner_of[records][is_here]
            values[(paint,) if values.ndim == 2 else (paint, inner)] = block[is_here]
    library = _with_metadata(data, axes, names, about, source)
    stored_columns = {} if about is None else table_columns(library)
    edited = [name for name, cells in columns.items() if list(cells) != stored_columns.get(name, cells)]
    warn_if(
        edited,
        f"{source}: {', '.join(edited)} differ from {sidecar.name}, which is used; delete it to use "
        "the table",
        "metadata-differ",
    )
    # names in the table of variables are excluded: their columns have no units
    reserved = {*library.variables, *library.dims, *LIBRARY_VARIABLES}
    added = {}
    for name, texts in columns.items():
        if name not in reserved:
            parsed = numbers(cell or "nan" for cell in texts)
            is_text = parsed is None or not any(texts)
            added[name] = (SIGNATURE, text_column(texts) if is_text else np.array(parsed))
    warn_of_scale(data[CENTRE], f"{source}: the reflectance", "write it again as a fraction")
    return library.assign_coords(added)


def _with_metadata(
    data: Mapping[str, Floats32],
    axes: Mapping[str, Any],
    names: Sequence[str],
    about: xr.Dataset | None,
    source: str,
) -> xr.Dataset:
    # Spectra (signature, band) or (signature, number, band), and their metadata as a library
    rows = LIBRARY_VARIABLES
    with Problems(f"{source} and its metadata belong to different libraries", FormatError) as problems:
        library = (
            xr.Dataset(attrs={"title": "Spectral library", "source": source}) if about is None else about
        )
        spectra = {}
        for name, values in data.items():
            row = rows.get(name)
            dims: tuple[Any, ...] = (SIGNATURE, *[f"place_of_{name}"] * (values.ndim - 2), BAND)
            attrs: Mapping[Any, Any] = {}
            if name in library.variables:
                dims, attrs = library[name].dims, library[name].attrs
            elif row is not None and len(row.dims) == values.ndim:
                dims, attrs = row.dims, row.attrs
            if len(dims) != values.ndim or dims[0] != SIGNATURE or dims[-1] != BAND:
                problems.add(
                    f"{name!r} has {values.ndim} dims",
                    expected=f"{dims}, as in the metadata",
                    code="dims-wrong",
                )
            elif values.ndim == 3:
                # restore the padding of the members, unless it is out of proportion
                members = values.shape[1]
                size = library.sizes.get(dims[1], members)
                if members < size <= 8 * max(members, 8):
                    values = np.pad(values, ((0, 0), (0, size - members), (0, 0)), constant_values=np.nan)
            spectra[name] = (dims, values, dict(attrs))
        problems.extend(
            Problem(f"{missing[:60]!r} has no record in the file", code="record-unmatched")
            for missing in [name for name in spectral_variables(library) if name not in data]
        )
        coords: dict[str, Any] = {SIGNATURE: (SIGNATURE, text_column(names), rows[SIGNATURE].attrs)}
        coords |= {
            name: (BAND, values, rows[name].attrs) for name, values in axes.items() if values is not None
        }
        for name, (_, values, _) in coords.items():
            known = library.variables.get(name)
            problems.add_if(
                name != SIGNATURE and known is not None and not np.array_equal(known.values, values),
                f"{name!r} of the file and of the metadata differ",
                mend="put the files of one library together",
                code="grid-mismatch",
            )
    own_coords = {name: coord for name, coord in coords.items() if name not in library.variables}
    with FormatError.instead_of(  # sizes or dims differ
        ValueError,
        f"{source} and its metadata belong to different libraries: $error",
        code="grid-mismatch",
    ):
        return library.assign(spectra).assign_coords(own_coords)


# --- files -------------------------------------------------------------------------------------------------


#: Largest text file [bytes]: 100,000 bands of 30 spectra.
MAX_BYTES = 32 * 2**20


# also right behind a number, as in "1.12-216microns"
_MICROMETRE = re.compile(r"(?<![a-zA-Z])(?:um|micromet(?:er|re)s?|microns?|[µμ]m)\b", re.IGNORECASE)
_NANOMETRE = re.compile(r"(?<![a-zA-Z])(?:nm|nanomet(?:er|re)s?)\b", re.IGNORECASE)
PERCENT = re.compile(r"per ?cent|pct|%", re.IGNORECASE)
_OTHER_QUANTITY = re.compile(
    r"radianc\w*|transmi\w*|emissiv\w*|absorb\w*|absorptanc\w*|\bcounts?\b|\bDN\b|strahldichte|bestrahlungsst",
    re.IGNORECASE,
)
#: What is made of reflectance, and is none.
TRANSFORMED = re.compile(
    r"\b(?:first|second|1st|2nd)[ _]derivative|continuum[ _-]removed|\blog(?:10)?[ _(\[]*1 ?/ ?R",
    re.IGNORECASE,
)
#: Headings that are a quantity alone; among other words they may name a paint.
_OTHER_HEADING = re.compile(
    r"\s*(?:% ?T|T ?[(\[]? ?%|abs|o\.?d|optical density|k ?/ ?s|extin[ck]tion|absorption|derivative|"
    r"intensit(?:y|ät|é|a|à)|(?:thermal )?emission)\W*(?:[(\[][^()\[\]]*[)\]])?\s*",
    re.IGNORECASE,
)
#: A line above a table that tells the unit of all values.
PERCENT_LINE = re.compile(r"[#\s]*(?:\w+[ _])?units?\s*[:=]\s*(?:%|per ?cent|pct)", re.IGNORECASE)
_WAVE = r"(?:wave ?lengths?|wellenl\w+|wave|wvl?|wl|lambda|λ)"
_ANGSTROM = re.compile(rf"\b(?:angstroms?|Å)\b|\b{_WAVE}(?: in)? (?-i:A)$", re.IGNORECASE)
WAVENUMBER = re.compile(r"\b(?:wave ?numbers?|cm\^?-1|1/cm|[GT]Hz)\b", re.IGNORECASE)
_TABLE = SimpleNamespace(
    #: Depth of the oxygen band at 760 nm, relative to its lower shoulder [1], from which values look like
    #: radiance or irradiance: sunlight has 0.5 to 0.9 at bandwidths of 1 to 5 nm and 0.2 at 15 nm; in thirty
    #: real libraries of reflectance the maximum is 0.023.
    min_oxygen_depth=0.1,
    #: Maximum spacing of wavelengths at which this depth is judged [nm].
    oxygen_step_nm=6.0,
    #: Maximum median ratio of a third column to the second [1] by which a third column without a heading is a
    #: standard deviation. A real lawn has 0.2. Two paints below this ratio need headings.
    max_spread_ratio=0.5,
    #: Maximum share of wavelengths that occur again in rows that are not adjacent [1], by which they come
    #: from overlapping detectors: 0.002 in exports of SVC; two spectra, one below the other, have 0.5.
    max_repeats=0.05,
    max_preamble=500,
    max_candidates=64,
)
_NO_SPREAD, _IS_SPREAD = -1, -2
_SAY_SO = "pass quantity='reflectance' if the values are reflectance"

_IN_FULL = re.compile(r"standard[ _.-]?dev|st\.? ?dev|std[ _.-]*dev", re.I)
_FILLER = re.compile(r"(?<![a-z])(?:reflectance|reflectivity|refl|of|the)(?![a-z])", re.I)
_OF_LIGHT = re.compile(
    r"(?<![a-z])[mµμun]?W(?:att)?s?[ */.·]*(?:c?m\^?-?\(?-?2|/ ?c?m)|/ ?sr\b|\bsr\^?-1", re.I
)
_COUNTED = re.compile(r"irrad|digital (?:number|count)s?|photons?\b|volts?\b", re.I)
_TITLE = re.compile(
    r"irradianc\w*|radianc\w*|transmittance|absorbance|emissivity|photons?\b|\bqntm\b|"
    r"quantum (?:units?|flux)|\b[µμu]mol|[µμ]E\b|\beinsteins?\b|\bppfd\b|\blux\b",
    re.I,
)
#: Words of the source of light; reflectance of a table may have been measured under it.
_LAMP = re.compile(r"\b(?:lamps?|luminaires?)\b", re.I)

#: Headings that do not name a paint.
_GENERIC = re.compile(rf"|r|rho|y|values?|.*(?:reflect|average|mean).*|{MEAN.pattern}", re.IGNORECASE)

#: Units in headings are removed from names of paints, which are paired with references by name.
_UNIT = re.compile(r"\s*[(\[]\s*(?:%|per ?cent|pct|fraction|unitless|-|1)\s*[)\]]\s*$", re.IGNORECASE)
_LENGTH = r"(?:nm|[uµμ]m|(?:nano|micro)met(?:er|re)s?|microns?|angstroms?|Å)"
#: Cells of a line of units below the names.
_UNIT_CELL = re.compile(rf"|-|1|%|per ?cent|pct|fraction|unitless|{_LENGTH}", re.I)
#: Headings, without brackets, of wavelengths, of widths of bands, and of numbers of rows.
_AXIS_NAME = re.compile(
    # with the number of a pair of columns, or of a repeated name
    rf"(?=[^.])(?:(?:band |cent(?:er|re|ral) )?{_WAVE}(?: ?\d{{1,2}})?)?(?: in)? ?{_LENGTH}?"
    rf"(?: ?\.\d{{1,2}})?|{_WAVE}(?: in)? (?-i:A)",
    re.I,
)
_WIDTH_NAME = re.compile(rf"(?:fwhm|band ?widths?|band ?pass)(?: in)? ?{_LENGTH}?", re.I)
_ROW_NAME = re.compile(
    r"|unnamed: ?\d+|(?:index|idx|#|"
    r"(?:row|line|band|channel|chan|ch|sample|spectrum|pixel|object|f?id|no|nr|num)s?\.?"
    r"(?: (?:index|id|number|no|nr)\.?)?)",
    re.I,
)
#: Roles of columns of a table.
_SPECTRUM, _AXIS_COLUMN, _WIDTH, _LEFT_OUT = range(4)

#: Keys of a header of ECOSTRESS, in file order.
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

#: First line of a USGS spectrum.
USGS_RECORD = re.compile(r"\s*(\S{1,40})\s+Record\s*=\s*(\d{1,9})\s*:(.*)$", re.IGNORECASE)
_MEASUREMENT = re.compile(r"[A-Z]{4}")
#: First line of USGS wavelengths, bandwidths or error bars.
USGS_AXIS = re.compile(
    r"\s*\S{1,40}\s+Record\s*=\s*\d{1,9}\s*:\s*(?:wave|bandpass|resolution|fwhm|error ?bars?\b)", re.I
)
_SPECTROMETERS = ("BECK", "NIC4", "AVIRIS", "ASD")
#: Number of folders that are searched for wavelengths, from that of the spectrum upwards.
_FOLDERS = 3


# --- plain tables ------------------------------------------------------------------------------------------


def read_plain_table(
    path: Path, *, scale: float | None = None, wavelength: Floats | None = None, is_reflectance: bool = False
) -> Spectra:
    # Read spectra from a table of two or more columns.
    # Cells are separated by commas, semicolons, tabs or blanks; decimal commas are read where commas are not
    # the separator. Lines above the numbers are headings, the last of them names the columns; lines that
    # begin with ``#`` are comments. A single spectrum with a general heading such as "reflectance" gets the
    # name of the file. A column whose heading says so is the standard deviation of the column before it.
    # scale: Stored value of a reflectance of one; by default 100 if the headings say percent, else 1.
    # wavelength: Wavelengths in place of the first column [nm]. is_reflectance: Whether the values are
    # reflectance, without a check of headings and values. Raises FormatError: There is no table of numbers,
    # its first column is not wavelengths, or the values are not reflectance. Warns PaintWarning: Successive
    # rows have the same wavelength; or the values of a column look like a standard deviation.
    source = path.name
    lines = read_text(path, MAX_BYTES).split("\n")
    without_comments = ["" if line.lstrip().startswith("#") else line for line in lines]
    found = FormatError.raise_if_none(
        first_row(without_comments, _TABLE.max_preamble),
        f"{source}: no table of numbers",
        expected="a wavelength and one or more values a line",
        mend="write wavelengths in the first column, and a column for each spectrum",
        code="table-missing",
    )
    first, dialect = found
    columns = len(row_numbers(lines[first], dialect) or ())
    table = _table(without_comments, first, columns, source, lambda line: row_numbers(line, dialect))
    while table.shape[1] > 2 and np.isnan(table[:, -1]).all():  # every line ends with separators
        table = table[:, :-1]
    preamble = lines[:first]
    headings = _headings(preamble, dialect[0], table.shape[1])
    axis, roles, notes = _roles(headings, table, source, has_axis=wavelength is not None)
    # the wavelengths change direction where detectors join, and not more often
    steps = np.diff(table[:, axis])
    reversals = min(int((steps < 0).sum()), int((steps > 0).sum()))
    FormatError.raise_if(
        np.isnan(table[:, axis]).any() or reversals > max(4, steps.size // 20) or not steps.any(),
        f"{source}: the {'first column' if not axis else 'column of wavelengths'} rises and falls",
        expected="wavelengths",
        mend="write every spectrum as a column",
        code="wavelength-unordered",
    )
    text = " ".join(preamble)
    text_of = {at: _unit_text(headings[at], text) if headings else text for at in range(table.shape[1])}
    # further wavelengths, of single spectra or in another unit, must be those of the first
    nanometres = (
        wavelength if wavelength is not None else in_nanometres(text_of[axis], table[:, axis], source)[0]
    )
    for at in np.flatnonzero((roles == _AXIS_COLUMN) & (np.arange(roles.size) != axis)).tolist():
        further = in_nanometres(text_of[at], table[:, at], source)[0]
        FormatError.raise_if(
            further.shape == nanometres.shape and not np.allclose(further, nanometres, rtol=1e-3),
            f"{source}: column {headings[at].strip()!r} holds other wavelengths than the first",
            expected="spectra with common wavelengths",
            mend="write one table for each set of wavelengths",
            code="grid-mismatch",
        )
    spectra, widths = np.flatnonzero(roles == _SPECTRUM), np.flatnonzero(roles == _WIDTH)[:1]
    # statistics of other columns, except the standard deviations, which belong to their spectra
    names = [headings[at].strip() for at in spectra] if headings else []
    others = [n for n in statistics_among(names) if STATISTIC.search(n) or not SPREAD.search(n)]
    if is_reflectance and 0 < len(others) < len(names):
        warn_user(
            f"{source}: columns {', '.join(map(repr, others))} are statistics, not spectra, and are left out",
            "columns-left-out",
        )
        spectra = spectra[[name not in others for name in names]]
    nm, values, axis_notes = _axis_and_values(
        table[:, [axis, *spectra, *widths]], text_of[axis], source, wavelength
    )
    fwhm = None
    if widths.size:
        fwhm, values = in_nanometres(text_of[int(widths[0])], values[:, -1], source)[0], values[:, :-1]
    headings = [headings[at] for at in [axis, *spectra]] if headings else []
    if not is_reflectance:
        # neither headings nor the lines above may name radiance, irradiance, counts or transmittance
        named = [name for name in names if foreign_quantity(name) or name in others]
        FormatError.raise_if(
            named,
            f"{source}: column headings name {', '.join(map(repr, named[:5]))}",
            expected="reflectance",
            mend=f"remove these columns, or {_SAY_SO}",
            code="quantity-wrong",
        )
        title = None if "reflect" in text.lower() else _TITLE.search(text) or _OF_LIGHT.search(text)
        FormatError.raise_if(
            word := foreign_quantity(preamble[-1] if preamble else "") or (title[0] if title else ""),
            f"{source}: the heading names {word!r}",
            expected="reflectance",
            mend=_SAY_SO,
            code="quantity-wrong",
        )
        if "reflect" not in text.lower() and (lamp := _LAMP.search(text)):
            warn_user(
                f"{source}: the lines above the numbers name a {lamp[0].lower()}: are the values its light? "
                f"{_SAY_SO}",
                "quantity-doubtful",
            )
    # the unit of every column; without names, the last line above the numbers tells the unit of all
    last = [preamble[-1] if preamble else ""] * spectra.size
    is_percent = np.array([PERCENT.search(heading) is not None for heading in headings[1:] or last], np.bool_)
    is_percent |= any(map(PERCENT_LINE.match, preamble))
    spread = _spread_columns(headings, values.T, source, is_reflectance=is_reflectance)
    paints = np.flatnonzero(spread != _IS_SPREAD)
    # names from headings, without units where they stay distinct
    names = [headings[at + 1].strip() for at in paints.tolist()] if headings else [""] * paints.size
    without_units = [_UNIT.sub("", name) for name in names]
    if len(set(without_units)) == len(set(names)):
        names = without_units
    if paints.size == 1 and _GENERIC.fullmatch(names[0]):
        names = [path.stem]
    reflectance = np.empty((paints.size, nm.size), np.float32)
    sd = np.full(reflectance.shape, np.nan, np.float32)
    for percent in {*is_percent[paints].tolist()}:
        with_unit = np.flatnonzero(is_percent[paints] == percent)
        reflectance[with_unit] = reflectances(
            values.T[paints[with_unit]],
            source,
            file_scale=100.0 if percent else None,
            scale=scale,
            is_reflectance=is_reflectance,
        )
    for at in np.flatnonzero(spread[paints] >= 0).tolist():
        column = spread[paints[at]]
        in_percent = is_percent[column] or is_percent[paints[at]]
        sd[at] = reflectances(
            values.T[[column]], source, file_scale=100.0 if in_percent else 1.0, scale=scale
        )[0]
    return Spectra(
        source=source,
        form="table of text",
        names=[name or f"column {at + 2}" for at, name in zip(paints, names, strict=True)],
        wavelength=nm,
        fwhm=fwhm,
        reflectance=reflectance,
        others={"reflectance_sd": sd} if (spread >= 0).any() else {},
        notes=[*axis_notes, *notes],
    )


def _unit_text(heading: str, otherwise: str) -> str:
    # Return a heading that names a unit of length or of wavenumber, else another text
    text = _plain_heading(heading)
    units = (_NANOMETRE, _MICROMETRE, _ANGSTROM, WAVENUMBER)
    return text if any(unit.search(text) for unit in units) else otherwise


def _plain_heading(heading: str) -> str:
    # Words of a heading without brackets and underscores
    return " ".join(re.sub(r"[\[\](){}_/,]", " ", heading).split())


def _roles(
    headings: Sequence[str], table: Floats, source: str, *, has_axis: bool
) -> tuple[int, Ints, list[str]]:
    # Return the column of wavelengths, the role of every column, and notes on columns left out.
    # headings: Names of all columns, or none. has_axis: Whether the caller has the wavelengths.
    # Raises FormatError: There are numbers of rows and no wavelengths; or whole numbers, such as of samples,
    # that are no spectrum.
    columns = range(table.shape[1])
    names = [_plain_heading(heading) for heading in headings] or ["x"] * table.shape[1]
    roles = np.full(table.shape[1], _SPECTRUM)
    with np.errstate(invalid="ignore"):
        is_whole = np.isfinite(table).all(axis=0) & (table == np.round(table)).all(axis=0)
        counted = (np.diff(table, axis=0) == 1.0).all(axis=0) if len(table) > 1 else np.zeros_like(is_whole)
    axes = [at for at in columns if headings and _AXIS_NAME.fullmatch(names[at])]
    numbered = [at for at in columns if at not in axes and headings and _ROW_NAME.fullmatch(names[at])]
    axis = axes[0] if axes else 0
    if not headings and len(columns) > 2:
        # numbers of rows before strictly ordered wavelengths
        steps = np.diff(table[:, 1])
        is_ordered = bool((steps > 0).all() or (steps < 0).all())
        if counted[0] and is_ordered and (table[0, 0] <= 1.0 or table[-1, 0] < 300.0):
            axis, numbered = 1, [0]
    FormatError.raise_if(
        not axes and not has_axis and axis in numbered and counted[axis] and bool(headings),
        f"{source}: the first column, {headings[0].strip()!r}, holds numbers of rows" if headings else "",
        expected="a column of wavelengths",
        mend="name the column of wavelengths 'wavelength (nm)', or pass wavelength=",
        code="wavelength-missing",
    )
    unknown = [
        headings[at].strip()
        for at in numbered
        if is_whole[at] and not counted[at] and at != axis and headings
    ]
    FormatError.raise_if(
        unknown,
        f"{source}: {', '.join(map(repr, unknown[:5]))} hold{'s'[: len(unknown) == 1]} whole numbers",
        expected="columns of wavelengths and spectra",
        mend="remove these columns",
        code="column-unknown",
    )
    roles[axes], roles[[at for at in numbered if counted[at]]] = _AXIS_COLUMN, _LEFT_OUT
    # wavenumbers beside wavelengths
    roles[[at for at in columns if axes and at not in axes and WAVENUMBER.match(names[at])]] = _LEFT_OUT
    roles[[at for at in columns if headings and _WIDTH_NAME.fullmatch(names[at])]] = _WIDTH
    roles[axis] = _AXIS_COLUMN
    left_out = [
        headings[at].strip() or "without a name" for at in columns if headings and roles[at] == _LEFT_OUT
    ]
    notes = [f"numbers of rows or wavenumbers left out: column {', '.join(left_out)}"] if left_out else []
    return axis, roles, notes


def _headings(preamble: Sequence[str], separator: str, columns: int) -> list[str]:
    # Cells of the last heading; empty where they are not as many as columns
    named = [line for line in reversed(preamble) if line.strip()]
    if not named:
        return []
    is_comment = named[0].lstrip().startswith("#")
    # commas may separate headings in a comment where another mark separates numbers
    for mark in [separator, ","] if is_comment else [separator]:
        rows = [_heading_cells(line, mark) for line in named[:2]]
        for cells in rows:
            while len(cells) > columns and not cells[-1].strip():
                cells.pop()
        fits = len(rows[0]) == columns or (len(rows[0]) > columns and is_comment and mark)
        if not fits:
            continue
        # a line of units below the names
        units = [cell.strip() for cell in rows[0]]
        has_units = any(units) and all(map(_UNIT_CELL.fullmatch, units))
        return (
            [f"{name.strip()} ({unit})" if unit else name for name, unit in zip(rows[1], units, strict=True)]
            if has_units and [len(row) for row in rows] == [columns] * 2
            else rows[0][:columns]
        )
    return []


def _heading_cells(line: str, mark: str) -> list[str]:
    text = line.strip().lstrip("#")
    if not mark:  # a unit in brackets belongs to the word before it
        text = re.sub(r"\s+(?=[(\[])", "", text.strip().replace("\t", " "))
    return cells_of(text, mark)


def _spread_columns(headings: Sequence[str], values: Floats, source: str, *, is_reflectance: bool) -> Ints:
    # Return for each column the index of its standard deviation, `_NO_SPREAD`, or `_IS_SPREAD`.
    # headings: Names of the columns, wavelengths first; empty for a file without headings. values: (column,
    # band). is_reflectance: Whether columns without headings are reflectance, without a check of their
    # values.
    # Raises FormatError: The heading of the first spectrum is a standard deviation. Warns PaintWarning: There
    # are three columns without headings, and the third looks like the standard deviation of the second.
    roles = np.full(len(values), _NO_SPREAD)
    if headings:
        # names without units and words for mean and standard deviation: letters and digits
        paints = [
            "".join(filter(str.isalnum, _FILLER.sub(" ", MEAN.sub(" ", SPREAD.sub(" ", heading.lower())))))
            for heading in headings[1:]
        ]
        names_spread = np.array([SPREAD.search(heading) is not None for heading in headings[1:]])
        mean_paints = [paint for paint, spread in zip(paints, names_spread, strict=True) if not spread]
        # "White Std" may be the name of a paint: it is a spread only beside a column "White"
        in_words = [_IN_FULL.search(heading) is not None for heading in headings[1:]]
        is_spread = names_spread & np.array(
            [word or not paint or paint in mean_paints for word, paint in zip(in_words, paints, strict=True)]
        )
        FormatError.raise_if(
            is_spread[0],
            f"{source}: the first spectrum is named {headings[1].strip()!r}",
            expected="reflectance before its standard deviation",
            code="column-order",
        )
        roles[is_spread] = _IS_SPREAD
        spectra = np.flatnonzero(~is_spread)
        for at in np.flatnonzero(is_spread):
            of_same_paint = [int(column) for column in spectra if paints[at] and paints[column] == paints[at]]
            mean = of_same_paint[0] if of_same_paint else spectra[spectra < at][-1]
            roles[mean] = at if roles[mean] == _NO_SPREAD else roles[mean]
    elif len(values) == 2 and not is_reflectance:
        mean, deviation = values
        comparable = np.isfinite(mean) & np.isfinite(deviation) & (mean > 0)
        ratios = deviation[comparable] / mean[comparable]
        if ratios.size and (ratios >= 0).all() and np.median(ratios) <= _TABLE.max_spread_ratio:
            warn_user(
                f"{source}: three columns without headings; the third is taken for the standard deviation of "
                "the second; add headings, or pass quantity='reflectance' if the third is a paint",
                "spread-assumed",
            )
            roles[:] = 1, _IS_SPREAD
    return roles


def _without_repeats(wavelength: Floats, values: Floats, source: str) -> tuple[Ints, Floats, list[str]]:
    # Return rows of distinct wavelengths, their values (band, spectrum), and notes.
    # Of successive equal wavelengths the first row is kept; different values are averaged.
    # Raises FormatError: Many wavelengths occur again in rows that are not adjacent, as of two spectra one
    # below the other. Warns PaintWarning: Values were averaged.
    starts = np.flatnonzero(np.diff(wavelength, prepend=np.nan) != 0)  # first rows of equal wavelengths
    distant_share = 1.0 - np.unique(wavelength[starts]).size / starts.size
    repeats = wavelength.size - np.unique(wavelength).size
    adjacent = wavelength.size - starts.size
    FormatError.raise_if(
        distant_share > _TABLE.max_repeats or 2 * adjacent >= wavelength.size,
        f"{source}: {repeats} of {wavelength.size} wavelengths occur twice",
        expected="one row per wavelength, and one column per spectrum",
        mend="put spectra side by side, or write wavelengths with more digits",
        code="wavelength-duplicate",
    )
    if not adjacent:
        return starts, values, []
    counts = np.diff(np.append(starts, wavelength.size))
    means = np.add.reduceat(values, starts, axis=0) / counts[:, None]
    difference = 2.0 * float(np.nanmax(np.abs(values - np.repeat(means, counts, axis=0)), initial=0.0))
    example = wavelength[starts[counts > 1][0]]
    text = f"{adjacent} wavelengths are equal to that of the row before, such as {example:g}"
    if difference <= 1e-12 * float(np.nanmax(np.abs(values), initial=0.0)):
        return starts, values[starts], [f"{text}: one of the equal rows is kept"]
    text = f"{text}: their values, which differ by up to {difference:.3g}, are averaged"
    warn_user(f"{source}: {text}", "wavelength-duplicate")
    return starts, means, [text]


#: Reflectance that the brightest band of a library exceeds, and that no median of a surface exceeds [1].
PLAUSIBLE_RANGE = (5e-4, 2.0)


def warn_of_scale(spectra: Any, subject: str, mend: str = "divide per cent by 100") -> None:
    # Warn of spectra (signature, band) that no surface has as a fraction.
    spectra = np.nan_to_num(np.asarray(spectra))
    level = np.median(spectra, axis=1).max(initial=0.0) if spectra.size else 0.0
    brightest = spectra.max(initial=0.0)
    warn_if(
        level > PLAUSIBLE_RANGE[1] or 0.0 < brightest < PLAUSIBLE_RANGE[0],
        f"{subject} is up to {brightest:.3g}, the highest median {level:.3g}: no surface has this; {mend}",
        "scale-doubtful",
    )


def warn_of_light(wavelength: Floats, reflectance: Floats32, source: str) -> None:
    # Warn of spectra with the oxygen band of sunlight, which reflectance does not have.
    # wavelength: (band,) [nm]; reflectance: (signature, band) [1].
    # Warns PaintWarning: A spectrum has the band.
    order = np.argsort(wavelength, kind="stable")
    nm, values = wavelength[order], reflectance[:, order].astype(np.float64)
    left, inside, right = ((nm >= lo) & (nm <= hi) for lo, hi in ((745, 755), (757, 767), (771, 781)))
    near = nm[(nm >= 745) & (nm <= 781)]
    if not (left.any() and inside.any() and right.any()) or np.diff(near).max() > _TABLE.oxygen_step_nm:
        return
    # the lower shoulder, since the reflectance of a paint that is black in the visible rises across the band
    shoulder = np.minimum(values[:, left].mean(axis=1), values[:, right].mean(axis=1))
    dip = shoulder - values[:, inside].min(axis=1)
    light = np.flatnonzero(dip > _TABLE.min_oxygen_depth * np.maximum(shoulder, 1e-6))
    if light.size:
        depth = dip[light[0]] / shoulder[light[0]] if shoulder[light[0]] > 0 else np.inf
        warn_user(
            f"{source}: {light.size} of {len(values)} spectra have the oxygen band of sunlight at 760 nm "
            f"({depth:.0%} deep), which reflectance does not have: are they radiance or irradiance? "
            f"{_SAY_SO}",
            "sunlight-in-reflectance",
        )


# --- ECOSTRESS and ASTER -----------------------------------------------------------------------------------


def read_ecostress(path: Path, *, scale: float | None = None, wavelength: Floats | None = None) -> Spectra:
    # Read a spectrum of the ECOSTRESS or ASTER library.
    # scale: y of a reflectance of one, where the file does not state it. wavelength: To be used in place of
    # the file's own [nm]. Raises FormatError: The header or the numbers are damaged, or the values are not
    # reflectance.
    source = path.name
    lines = read_text(path, MAX_BYTES).split("\n")
    # the header: values of ASTER files wrap
    parts: dict[str, list[str]] = {}
    current, is_wrapped = "", False
    for first, line in enumerate(lines):
        match = _KEY.match(line)
        if match and _SPELLED[match[1].lower()] not in parts:
            current = _SPELLED[match[1].lower()]
            parts[current] = [match[2].strip()]
        elif "Number of X Values" in parts and len(numbers(line.split(None, 2)) or ()) == 2:
            break
        elif current and line.strip():
            parts[current].append(line.strip())
            is_wrapped = True
        elif line.strip():
            raise FormatError(
                f"{source}: line {first + 1} is {line.strip()[:60]!r}",
                expected="'Name: ...'",
                code="header-unreadable",
            )
    else:
        raise FormatError(f"{source}: no line of two numbers after the header", code="table-missing")
    fields = {key: " ".join(filter(None, texts)) for key, texts in parts.items()}
    problems = Problems(f"{source} cannot be used", FormatError)
    problems.extend(
        Problem(f"the header has no {key!r}", code="key-missing")
        for key in ("Name", "X Units", "Y Units", "Number of X Values")
        if key not in fields
    )
    units = fields.get("Y Units", "")
    file_scale = 100.0 if PERCENT.search(units) else 1.0 if _FRACTION.search(units) else None
    problems.raise_if_any(
        *(
            (
                foreign_quantity(fields.get(key, "")),
                Problem(
                    f"{key!r} is {fields.get(key, '')[:60]!r}", expected="reflectance", code="quantity-wrong"
                ),
            )
            for key in ("Y Units", "Measurement")
        ),
    )
    table = _table(lines, first, 2, source)
    FormatError.raise_if(
        (count := fields["Number of X Values"]) != str(len(table)),
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
    FormatError.raise_if(
        np.isnan(table[:, 0]).any(), f"{source}: a wavelength is not a number", code="number-unreadable"
    )
    nm, values, further_notes = _axis_and_values(table, fields["X Units"], source, wavelength)
    return Spectra(
        source=source,
        form=f"{'ASTER' if is_wrapped else 'ECOSTRESS'} library text",
        names=[fields["Name"]],
        wavelength=nm,
        reflectance=reflectances(values.T, source, file_scale=file_scale, scale=scale),
        columns=_columns(fields, source),
        notes=notes + further_notes,
    )


def _columns(fields: dict[str, str], source: str) -> dict[str, Any]:
    columns: dict[str, Any] = {
        re.sub(r"[^a-z]+", "_", key.lower()).strip("_"): text_column([fields[key]])
        for key in _KEYS[1:]
        if key in fields and key not in _ABOUT_THE_AXES
    }
    information = fields.get("Additional Information", "")
    if not information.startswith(_METADATA):
        return {**columns, "additional_information": text_column([information])} if information else columns
    # metadata of hyperpaint 0.1 and 0.2: names and values
    reserved = {*columns, SIGNATURE, "band", "wavelength", "reflectance"}
    name = "its JSON"
    try:
        for name, value in json.loads(information.removeprefix(_METADATA)).items():
            if not name.isidentifier() or name in reserved:
                raise ValueError("expected a new identifier")
            row = LIBRARY_VARIABLES.get(name)
            dtype = {str: "str", int: "int64", bool: "bool"}.get(type(value), "float64")
            is_known = row is not None and row.dims == (SIGNATURE,)
            columns[name] = typed_values([value], row.dtype if row is not None and is_known else dtype)
    except (ValueError, AttributeError, OverflowError, RecursionError) as error:
        raise FormatError(
            f"{source}: 'Additional Information' holds damaged metadata, {name[:60]!r} ({error!s:.100})",
            code="metadata-damaged",
        ) from error
    return columns


# --- USGS --------------------------------------------------------------------------------------------------


def read_usgs(
    path: Path, *, scale: float | None = None, wavelength: Floats | None = None, fwhm: Floats | None = None
) -> Spectra:
    # Read a spectrum of the USGS library.
    # scale: Stored value of a reflectance of one, 1 by default. wavelength, fwhm: Wavelengths and widths of
    # the bands [nm]; by default from files beside the spectrum, or in the two folders above it. Raises
    # FormatError: Lines are not numbers; the quantity is not reflectance; or no file of wavelengths is found.
    source = path.name
    title, values = _column(path)
    record = USGS_RECORD.match(title)
    heading = record[3].strip() if record else title.strip()
    name, spectrometer, measurement = heading, "", ""
    words = heading.rsplit(None, 2)
    if len(words) == 3 and _MEASUREMENT.fullmatch(words[2]):
        name, spectrometer, measurement = words
    refuse(
        source,
        (
            USGS_AXIS.match(title),
            Problem(
                f"{heading[:60]!r} is not a spectrum",
                expected="reflectance",
                mend="pass wavelengths as wavelength=, bandwidths as fwhm=; error bars are not read",
                code="quantity-wrong",
            ),
        ),
        (
            measurement == "TRAN",
            Problem(f"{heading[:60]!r} is a transmittance", expected="reflectance", code="quantity-wrong"),
        ),
    )
    notes: list[str] = []
    nm = FormatError.raise_if_none(
        _axis(path, "wave", values.size, spectrometer, notes) if wavelength is None else wavelength,
        f"{source}: no file with {values.size} wavelengths beside it or in the folders above",
        mend=f"pass wavelength=, '..._Wavelengths_...txt' of the spectrometer {spectrometer}".rstrip(),
        code="wavelength-missing",
    )
    width = _axis(path, "bandpass", values.size, spectrometer, notes) if fwhm is None else fwhm
    # channels that the spectrometer lacks have no wavelength
    is_there = np.isfinite(nm) if nm.size == values.size else np.ones(values.size, bool)
    if not is_there.all():
        notes.append(f"{int((~is_there).sum())} channels without a wavelength are left out")
        nm, values = nm[is_there], values[is_there]
        width = None if width is None else width[is_there]
    columns = {"spectrometer": spectrometer, "measurement": measurement}
    if record:
        columns |= {"library": record[1], "record": record[2]}
    return Spectra(
        source=source,
        form="USGS spectral library text",
        names=[name],
        wavelength=nm,
        fwhm=width,
        reflectance=reflectances(values[None, :], source, file_scale=None, scale=scale),
        columns={key: text_column([value]) for key, value in columns.items()},
        notes=notes,
    )


def _column(path: Path) -> tuple[str, Floats]:
    lines = read_text(path, MAX_BYTES).split("\n")
    values = _table(lines, 1, 1, path.name)[:, 0]
    fault = Problem(f"{values.size} values", expected="a title and one value a line", code="table-missing")
    refuse(path.name, (values.size < 2, fault))
    return lines[0], values


def read_usgs_axis(path: Path) -> tuple[Floats, str]:
    # Return the wavelengths or bandwidths of a USGS file [nm], NaN for deleted channels, and a note on units.
    # Raises FormatError: The file is damaged, or has other content.
    title, values = _column(path)
    values[values < _PLAUSIBLE.max_fill_value] = np.nan
    FormatError.raise_if(
        not np.isfinite(values).any(),
        f"{path.name}: none of its {values.size} values are finite",
        code="not-finite",
    )
    return in_nanometres(title.replace("_", " "), values, path.name)


def _axis(path: Path, kind: str, count: int, spectrometer: str, notes: list[str]) -> Floats | None:
    # Wavelengths ("wave") or bandwidths from a file near a spectrum; None without a file of equal length
    words = ("wavelength",) if kind == "wave" else ("bandpass", "fwhm", "resolution")
    folder = path.absolute().parent
    candidates: list[Path] = []
    for searched in [folder, *folder.parents][:_FOLDERS]:
        with contextlib.suppress(OSError):
            for name in sorted(entry.name for entry in searched.iterdir()):
                # names of spectra convolved to another spectrometer contain "wavelength"
                is_axis = any(word in name.lower() for word in words) and name.lower().endswith(".txt")
                if is_axis and (kind == "wave" or "wavelength" not in name.lower()):
                    candidates.append(searched / name)
        if candidates:
            break
    axes = {}
    for file in candidates[: _TABLE.max_candidates]:
        with contextlib.suppress(FormatError):
            values, note = read_usgs_axis(file)
            if values.size == count and file != path.absolute():
                axes[file] = (values, note)
    code = next((code for code in _SPECTROMETERS if spectrometer.upper().startswith(code)), None)
    if len(axes) > 1 and code:
        axes = {file: axis for file, axis in axes.items() if code in file.name.upper()} or axes
    FormatError.raise_if(
        len({values.tobytes() for values, _ in axes.values()}) > 1,
        f"{path.name}: {', '.join(sorted(file.name for file in axes))} have {count} values each",
        mend=f"pass the file of this spectrum as {'wavelength=' if kind == 'wave' else 'fwhm='}",
        code="wavelength-ambiguous",
    )
    for file, (values, note) in axes.items():
        notes.append(f"{'wavelengths' if kind == 'wave' else 'fwhm'} of {file.name}{note and ': ' + note}")
        return values
    return None


# --- lines, numbers, units ---------------------------------------------------------------------------------


def _table(
    lines: Sequence[str],
    first_line: int,
    columns: int,
    source: str,
    numbers_of: Callable[[str], list[float] | None] | None = None,
) -> Floats:
    # Return lines of numbers as an array (line, column); empty lines are skipped.
    # first_line: Index of the first line of numbers. columns: Number of columns. numbers_of: Function that
    # returns the numbers of a line, None for other text; by default numbers are separated by blanks. Raises
    # FormatError: Lines contain other text; the first of them are listed.
    with Problems(f"{source} cannot be read", FormatError) as problems:
        rows = []
        for at, line in enumerate(lines[first_line:], first_line + 1):
            if not line.strip(" \t,;"):  # also rows of empty cells below a table of a spreadsheet
                continue
            row = numbers_of(line) if numbers_of else numbers(line.split(None, columns))
            if row is None or len(row) != columns:
                problems.add(
                    f"line {at}: {line.strip()[:60]!r}",
                    expected=f"{columns} number{'s'[: columns - 1]}",
                    mend="remove lines that do not belong to the table",
                    code="row-unreadable",
                )
                if len(problems) == _MAX_SHOWN:
                    break
            else:
                rows.append(np.array(row, np.float64))
    return np.array(rows, np.float64).reshape(-1, columns)


def other_quantity(text: str) -> str:
    # Return the word for another quantity than reflectance, empty if there is none.
    match = None if "reflect" in text.lower() else _OTHER_QUANTITY.search(text)
    match = match or TRANSFORMED.search(text)
    return match[0] if match else ""


def foreign_quantity(heading: str) -> str:
    # Return the word or unit for another quantity than reflectance in a heading, empty if there is none.
    patterns = (_OF_LIGHT.search, _COUNTED.search, _OTHER_HEADING.fullmatch)
    matches = (find_in(heading) for find_in in patterns if "reflect" not in heading.lower())
    match = next(filter(None, matches), None)
    return other_quantity(heading) or (match[0].strip() if match else "")


def in_nanometres(text: str, wavelength: Floats, source: str) -> tuple[Floats, str]:
    # Return wavelengths [nm], and a note if their unit is inferred.
    # text: Description of the wavelengths in the file; may be empty. wavelength: Wavelengths in the file's
    # unit. Raises FormatError: The text names another unit, such as wavenumbers.
    units = ((_MICROMETRE, 1e3), (_ANGSTROM, 0.1), (_NANOMETRE, 1.0))
    factor, note = next((factor for unit, factor in units if unit.search(text)), 0.0), ""
    if not factor:
        other_unit = WAVENUMBER.search(text)
        FormatError.raise_if(
            other_unit,
            f"{source}: the unit of the first column is {other_unit and other_unit[0]!r}",
            expected="nm or um",
            mend="pass wavelength=",
            code="units-unknown",
        )
        is_small = wavelength.size and float(np.nanmax(wavelength)) < 100.0
        factor, taken = (1e3, "below 100 taken as micrometres") if is_small else (1.0, "taken as nanometres")
        note = f"no wavelength units: values {taken}"
    with np.errstate(over="ignore"):  # overflow of a damaged file becomes infinity, a later error
        nanometres: Floats = wavelength * factor
    return nanometres, note


def _axis_and_values(
    table: Floats, text: str, source: str, wavelength: Floats | None
) -> tuple[Floats, Floats, list[str]]:
    # Wavelengths [nm], values (band, spectrum) and notes of a table whose first column is in the unit that
    # ``text`` names; ``wavelength``: from the caller, in place of that column [nm]
    axis, values = table[:, 0], table[:, 1:]
    if wavelength is not None:
        return wavelength, values, []
    nanometres, note = in_nanometres(text, axis, source)
    starts, values, repeats = _without_repeats(axis, values, source)
    return nanometres[starts], values, [*([note] if note else []), *repeats]


#: Headings of the names; hyperpaint 0.2 and before wrote the second.
_NAMES = (SIGNATURE, "paint")
#: Headings of the two columns that identify a spectrum of a paint.
_KEY_COLUMNS = ["variable", "place"]
#: Number of a spectrum of a paint, empty for the only one.
_PLACE = re.compile(r"|[1-9][0-9]{0,8}")
_MAX_BANDS = 100_000
_MAX_BYTES = 2**32


def is_csv_library(head: str, path: Path) -> bool:
    # Return whether a text begins as a paint library: names, then wavelengths, in its first row.
    # A table with another mark than commas, as spreadsheets save it, needs the metadata or the key columns.
    row, end, _ = head.partition("\n")
    mark, cells = heading_cells(row.rstrip("\r;\t,") if end else row)
    # the head may cut off the last cell
    nm = number(cells[-1 if end else -2].replace(",", ".")) if len(cells) > 2 else None
    first = bool(cells[0] == "")  # an index of pandas
    is_saved = mark == "," or cells[first + 1 : first + 3] == _KEY_COLUMNS or metadata_path(path).exists()
    return cells[first : first + 1] in ([n] for n in _NAMES) and nm is not None and nm >= MIN_NM and is_saved


# --- CSV ---------------------------------------------------------------------------------------------------


def write_csv_library(library: xr.Dataset, names: Sequence[str], blocks: Iterable[Block], path: Path) -> None:
    # Write the records of a checked library.
    # Values have nine digits, which restore every bit of float32. A file with characters beyond ASCII begins
    # with the byte order mark by which Excel recognises UTF-8. Names and texts that a spreadsheet would
    # execute as formulas have a leading apostrophe, which the reader removes.
    columns = table_columns(library)
    key_columns = [] if spectral_variables(library) == [CENTRE] else _KEY_COLUMNS
    head = _line(
        [
            SIGNATURE,
            *key_columns,
            *map(safe_cell, columns),
            *(repr(float(value)) for value in library["wavelength"].values),
        ]
    )
    lines = [_line([safe_cell(name)]) for name in names]
    properties = [
        _line(["", *map(safe_cell, map(str, cells))]) for cells in zip(*columns.values(), strict=True)
    ] or [""] * len(lines)
    coding = "utf-8" if "".join([head, *lines, *properties]).isascii() else "utf-8-sig"
    row = ",%.9g" * library.sizes[BAND] + "\n"
    with open(path, "w", encoding=coding, newline="") as file:
        file.write(head + "\n")
        for variable, *records in blocks:
            for paint, inner, values in zip(*records, strict=True):
                key = f",{variable},{'' if inner < 0 else inner + 1}" if key_columns else ""
                file.write(lines[paint] + key + properties[paint] + row % tuple(values.tolist()))


def _line(cells: list[str]) -> str:
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="").writerow([*cells, ""])
    return buffer.getvalue()[:-1]


def read_csv_library(path: Path, *, scale: float | None = None, is_reflectance: bool = False) -> xr.Dataset:
    # Read a library that `write_csv_library` wrote, or a spreadsheet saved again.
    # scale, is_reflectance: As in `reflectances`, for a table without metadata, which any program may have
    # written.
    # Raises FormatError: The table or its metadata are damaged, or belong to different libraries; or a table
    # without metadata has no reflectance. Warns PaintWarning: The metadata are missing.
    source = path.name
    problems = Problems(f"{source} cannot be read", FormatError)
    # the first row: headings, then wavelengths
    cells = _csv_rows(path)
    first_row = next(cells, [])
    if first_row[:1] == [""]:
        first_row, cells = first_row[1:], _without_index(cells, source)
    while first_row and not first_row[-1]:  # empty columns of a spreadsheet
        first_row.pop()
    first_row = [cell.replace(",", ".") for cell in first_row]
    head_size = len(first_row)
    while head_size and number(first_row[head_size - 1]) is not None:
        head_size -= 1
    head, nm = first_row[:head_size], numbers(first_row[head_size:]) or []
    is_valid = all(name.isidentifier() for name in head) and len(set(head)) == len(head)
    FormatError.raise_if(
        not head or head[0] not in _NAMES or not is_valid or not 0 < len(nm) <= _MAX_BANDS,
        f"{source}: the first row is {','.join(first_row)[:60]!r}",
        expected=f"{SIGNATURE}, distinct column names, and wavelengths",
        code="header-unreadable",
    )
    if head[0] != SIGNATURE:
        head = [NEW_NAMES.get(name, name) for name in head]
    has_keys = head[1:3] == _KEY_COLUMNS
    first_property = 3 if has_keys else 1
    # every further row is a spectrum
    names: list[str] = []
    columns: dict[str, list[str]] = {text_of_cell(name): [] for name in head[first_property:]}
    keys: list[Key] = []
    rows: list[Floats32] = []
    # the order of the rows distinguishes paints of the same name: numbers of the paints of a name; and, by
    # name and variable, the position of the paint of the last row among them, and its number in this paint
    paints: dict[str, list[int]] = {}
    last: dict[tuple[str, str], tuple[int, int]] = {}
    for number_of_row, row in enumerate(cells, 2):
        row[:head_size] = map(text_of_cell, row[:head_size])
        if not any(row[len(first_row) :]):
            del row[len(first_row) :]
        values = _values(row[head_size:], len(nm))
        name, variable, place = row[:3] if has_keys and len(row) > 2 else (row[0], CENTRE, "")
        place = place.removesuffix(".0")  # pandas writes integers as floats where some cells are empty
        key: Key | None = None
        if variable == CENTRE and not place:
            key = (CENTRE, len(names), -1)
        elif variable.isidentifier() and _PLACE.fullmatch(place):
            inner = int(place or 0) - 1
            position, last_inner = last.get((name, variable), (0, -2))
            position += inner <= last_inner  # the numbers start again: the next paint of that name
            last[name, variable] = (position, inner)
            same_name = paints.get(name, [])
            key = (variable, same_name[position], inner) if position < len(same_name) else None
        if values is None or key is None:
            problems.add(
                f"row {number_of_row}: {','.join(row)[:60]!r}",
                expected=f"{', '.join(head)[:60]}, and {len(nm)} numbers",
                code="row-unreadable",
            )
            if len(problems) == _MAX_SHOWN:
                break
            continue
        if key[0] == CENTRE:
            paints.setdefault(name, []).append(len(names))
            names.append(name)
            for column, cell in zip(columns.values(), row[first_property:], strict=False):
                column.append(cell)
        keys.append(key)
        rows.append(values)
    problems.raise_if_any()
    wavelength = np.array(nm, np.float64)
    check_wavelengths(wavelength, source)
    FormatError.raise_if(
        not names, f"{source}: no row of {CENTRE!r}", mend="write the library again", code="variable-missing"
    )
    spectra = np.array(rows, np.float32)
    if not metadata_path(path).exists():
        checked = [at for at, key in enumerate(keys) if CENTRE in key[0]]
        spectra[checked] = reflectances(
            spectra[checked], source, file_scale=None, scale=scale, is_reflectance=is_reflectance
        )
    return restored(path, names, keys, {"wavelength": wavelength}, [(0, spectra)], columns)


def _csv_rows(path: Path) -> Iterator[list[str]]:
    with (
        FormatError.instead_of(
            (csv.Error, UnicodeDecodeError, OSError),
            f"{path.name} cannot be read: $error",
            code="file-unreadable",
        ),
        io.TextIOWrapper(
            open_input(path, "a paint library", _MAX_BYTES), encoding="utf-8-sig", newline=""
        ) as file,
    ):
        heading = next(file, "")
        mark = heading_cells(heading)[0]
        # rows of empty cells are what a spreadsheet leaves below a table
        yield from filter(any, csv.reader(itertools.chain([heading], file), delimiter=mark, strict=True))


def _without_index(rows: Iterator[list[str]], source: str) -> Iterator[list[str]]:
    # Rows without the unnamed index column of pandas
    for number_of_row, row in enumerate(rows):
        FormatError.raise_if(
            row[0] != str(number_of_row),
            f"{source}: the first column has no name and holds {row[0][:30]!r}",
            expected=f"{SIGNATURE} as the first column, or the row numbers of pandas before it",
            mend="write it with to_csv(index=False)",
            code="column-name-missing",
        )
        yield row[1:]


def _values(cells: list[str], bands: int) -> Floats32 | None:
    # Numbers of a row; None where a cell is not a number or the count is wrong
    row_numbers = None
    text = "".join(cells)
    if "," in text:  # decimal commas
        cells = [cell.replace(",", ".") for cell in cells]
    if text.isascii() and "_" not in text and len(text) <= 64 * len(cells):
        with contextlib.suppress(ValueError):  # such as an empty cell
            row_numbers = list(map(float, cells))  # several times faster than `numbers`
    row_numbers = row_numbers or numbers(cells)
    if row_numbers is None or len(cells) != bands:
        return None
    with np.errstate(over="ignore"):
        values = np.array(row_numbers, np.float64).astype(np.float32)
    return None if np.isinf(values).any() else values


# --- Parquet -----------------------------------------------------------------------------------------------


_OURS = b"hyperpaint"
_MAX_ROWS, _MAX_VALUES = 2_000_000, 2**28
_NM_PER_UNIT = {"nm": 1.0, "um": 1e3}
_NM_OF_WAVENUMBER = 1e7  # over cm-1

#: Text columns of OpenSpecLib: columns that must have a value, and optional columns.
_TEXTS = (
    "id",
    "name",
    "source.library",
    "source.library_version",
    "source.original_id",
    "source.url",
    "source.license",
    "source.citation",
    "material.name",
    "material.category",
    "measurement.technique",
    "spectral_data.type",
    "spectral_data.wavelength_unit",
    "additional_properties",
)
_OPTIONAL_TEXTS = (
    "source.filename",
    "material.subcategory",
    "material.formula",
    "sample.id",
    "sample.description",
    "sample.particle_size",
    "sample.origin",
    "sample.owner",
    "sample.preparation",
    "measurement.instrument",
    "measurement.instrument_type",
    "measurement.laboratory",
    "measurement.geometry",
    "quality.notes",
)
_OPTIONAL = (*_OPTIONAL_TEXTS, "sample.collection_date", "measurement.date", "spectral_data.bandpass")


def write_parquet_library(
    library: xr.Dataset, names: Sequence[str], blocks: Iterable[Block], path: Path
) -> None:
    # Write the records of a checked library. Raises MissingExtraError: pyarrow is not installed.
    with needs_extra("pyarrow", "library", "Parquet"):
        import pyarrow as pa
        import pyarrow.parquet as pq
    columns = paint_columns(library)
    numbers = pa.list_(pa.float64())
    types = {
        **dict.fromkeys((*_TEXTS, *_OPTIONAL_TEXTS), pa.string()),
        "material.keywords": pa.list_(pa.string()),
        "sample.collection_date": pa.date32(),
        "measurement.date": pa.date32(),
        "spectral_data.wavelength_min": pa.float64(),
        "spectral_data.wavelength_max": pa.float64(),
        "spectral_data.num_points": pa.int32(),
        "spectral_data.wavelengths": numbers,
        "spectral_data.values": numbers,
        "spectral_data.bandpass": numbers,
        "quality.has_bad_bands": pa.bool_(),
        "quality.bad_band_count": pa.int32(),
        "quality.coverage_fraction": pa.float64(),
    }
    schema = pa.schema(
        [pa.field(name, type_, nullable=name in _OPTIONAL) for name, type_ in types.items()],
        {b"openspeclib_version": b"0", b"source": _OURS},
    )
    wavelength = np.asarray(library["wavelength"].values, np.float64)
    attrs = {**library.attrs, **library[CENTRE].attrs}
    fwhm = library["fwhm"].values if "fwhm" in library.variables and library["fwhm"].dims == (BAND,) else None
    common = {
        "source.library": "hyperpaint",
        "source.library_version": str(attrs.get("paint_library_version", "unknown")),
        "source.url": "",
        "source.license": str(attrs.get("licence", "unknown")),
        "source.citation": str(attrs.get("title", "unknown")),
        "material.category": "man_made",
        "material.subcategory": "car paint",
        "measurement.technique": "reflectance",
        "measurement.geometry": str(attrs.get("measurement_geometry", "unknown")),
        "spectral_data.type": "reflectance",
        "spectral_data.wavelength_unit": "nm",
        "spectral_data.wavelength_min": wavelength.min(),
        "spectral_data.wavelength_max": wavelength.max(),
        "spectral_data.num_points": wavelength.size,
        "spectral_data.wavelengths": wavelength,
        "spectral_data.bandpass": None if fwhm is None else np.asarray(fwhm, np.float64),
    }
    with pq.ParquetWriter(path, schema, compression="zstd") as writer:
        for variable, paints, inners, spectra in blocks:
            rows = []
            for paint, inner, values in zip(paints.tolist(), inners.tolist(), spectra, strict=True):
                missing = int((~np.isfinite(values)).sum())
                identity = f"{paint}" if variable == CENTRE else f"{paint}/{variable}/{inner}"
                properties = {name: column[paint] for name, column in columns.items()}
                words = (properties.get(word) for word in ("colour", "finish", "make", "model"))
                key = {"variable": variable, SIGNATURE: paint, "place": inner}
                rows.append(
                    common
                    | {
                        "id": f"hyperpaint:{identity}",
                        "name": names[paint],
                        "source.original_id": identity,
                        "material.name": names[paint],
                        "material.keywords": [str(word) for word in words if word],
                        "additional_properties": json.dumps({**properties, **key}, allow_nan=False),
                        "spectral_data.values": values.astype(np.float64),
                        "quality.has_bad_bands": missing > 0,
                        "quality.bad_band_count": missing,
                        "quality.coverage_fraction": 1.0 - missing / max(values.size, 1),
                    }
                )
            arrays = [pa.array([row.get(field.name) for row in rows], field.type) for field in schema]
            writer.write_batch(pa.RecordBatch.from_arrays(arrays, schema=schema))


#: Columns that are read; wavelengths and values are lists of numbers.
_NUMBERS = ("spectral_data.wavelengths", "spectral_data.values")
_COLUMNS = (
    "name",
    "additional_properties",
    "spectral_data.type",
    "spectral_data.wavelength_unit",
    *_NUMBERS,
    "source.license",
    "source.citation",
)


def read_parquet_library(path: Path) -> xr.Dataset:
    # Read a library in the columns of OpenSpecLib, of hyperpaint or another program.
    # Raises FormatError: It is damaged or too large, lacks columns, contains another quantity than
    # reflectance, or has rows with different wavelengths. Raises MissingExtraError: pyarrow is not installed.
    with needs_extra("pyarrow", "library", "Parquet"):
        import pyarrow as pa
        import pyarrow.parquet as pq
    source = path.name
    with (
        FormatError.instead_of(
            (pa.ArrowException, OSError),
            f"{source} cannot be read as Parquet: $error",
            mend="copy it again",
            code="file-unreadable",
        ),
        pq.ParquetFile(os.fspath(path)) as file,
    ):
        # columns that are read; refuse files that would fill the memory
        missing, rows = (
            [name for name in _COLUMNS if name not in file.schema_arrow.names],
            file.metadata.num_rows,
        )
        refuse(
            source,
            (
                missing,
                Problem(
                    f"columns {', '.join(missing)} are missing",
                    expected="the columns of OpenSpecLib",
                    code="column-missing",
                ),
            ),
            (
                not 0 < rows <= _MAX_ROWS,
                Problem(f"{rows} rows", expected=f"1 to {_MAX_ROWS}", code="file-too-large"),
            ),
        )
        columns: dict[str, list[Any]] = {name: [] for name in _COLUMNS}
        count = 0
        for batch in file.iter_batches(batch_size=256, columns=list(_COLUMNS)):
            count += sum(len(column.flatten()) for column in batch.columns if hasattr(column, "flatten"))
            FormatError.raise_if(
                count > _MAX_VALUES,
                f"{source}: more than {_MAX_VALUES} values",
                mend="split the file",
                code="file-too-large",
            )
            for name, cells in columns.items():
                column = batch.column(name)
                cells += (
                    [
                        np.empty(0)
                        if cell.values is None
                        else np.asarray(cell.values.to_numpy(zero_copy_only=False), np.float64)
                        for cell in column
                    ]
                    if name in _NUMBERS
                    else column.to_pylist()
                )
        is_ours = (file.schema_arrow.metadata or {}).get(b"source") == _OURS
    names = list(map(str, columns["name"]))
    is_restored = is_ours and metadata_path(path).exists()
    warn_if(
        is_ours and not is_restored,
        f"{source}: {metadata_path(path).name} is missing: names and wavelengths are from the file",
        "metadata-missing",
    )
    # keys of the rows of a library of hyperpaint
    keys: list[Key] = []
    for at, text in enumerate(columns["additional_properties"] if is_restored else []):
        with FormatError.instead_of(
            (ValueError, KeyError, TypeError, OverflowError, RecursionError),
            f"{source}: row {at} has no variable, paint and index in additional_properties",
            mend="write the library again",
            code="record-unmatched",
        ):
            cells = json.loads(text)
            paint = cells[SIGNATURE] if SIGNATURE in cells else cells["paint"]
            keys.append((str(cells["variable"]), int(paint), int(cells["place"])))
    paints = sum(key[0] == CENTRE for key in keys)
    FormatError.raise_if(
        sorted({key[1] for key in keys}) != list(range(paints))
        or any(not -1 <= key[2] < _MAX_ROWS for key in keys),
        f"{source}: rows of a paint are missing",
        mend="write the library again",
        code="record-unmatched",
    )
    kinds = sorted({str(kind) for kind in columns["spectral_data.type"]})
    units = sorted({str(unit) for unit in columns["spectral_data.wavelength_unit"]})
    refuse(
        source,
        (
            not is_restored and kinds != ["reflectance"],
            Problem(
                f"rows of {', '.join(kinds)}",
                expected="reflectance",
                mend="select rows of reflectance",
                code="quantity-wrong",
            ),
        ),
        (
            not is_restored and (len(units) != 1 or units[0] not in (*_NM_PER_UNIT, "cm-1")),
            Problem(
                f"wavelengths are in {', '.join(units)}", expected="one of nm, um, cm-1", code="units-unknown"
            ),
        ),
    )
    # common wavelengths (band,) and values (row, band) of all rows
    axes, spectra = (columns[name] for name in _NUMBERS)
    for at, (axis, spectrum) in enumerate(zip(axes, spectra, strict=True)):
        if not np.array_equal(axis, axes[0]):
            sizes = f"{axis.size} in row {at}, {axes[0].size} in the first row"
            raise FormatError(
                f"{source}: rows have different wavelengths ({sizes})",
                mend="select rows of one instrument",
                code="grid-mismatch",
            )
        FormatError.raise_if(
            spectrum.shape != axis.shape,
            f"{source}: row {at} has {spectrum.size} values",
            expected=f"{axis.size}, as many as wavelengths",
            code="length-mismatch",
        )
    values = np.stack(spectra)
    if is_restored:
        check_wavelengths(axes[0], source)
        names = [name for name, key in zip(names, keys, strict=True) if key[0] == CENTRE]
        return restored(path, names, keys, {"wavelength": axes[0]}, [(0, values.astype(np.float32))], {})
    with np.errstate(divide="ignore"):
        is_wavenumber = units[0] == "cm-1"
        nm = _NM_OF_WAVENUMBER / axes[0] if is_wavenumber else axes[0] * _NM_PER_UNIT[units[0]]
    return library_of(
        Spectra(
            source,
            "OpenSpecLib Parquet",
            names,
            nm,
            reflectances(values, source, file_scale=None, scale=None),
            columns={"licence": list(map(str, columns["source.license"]))},
        )
    )


# --- ENVI --------------------------------------------------------------------------------------------------


_MAX_CLASSES_BYTES = 16 * 2**20
_TITLE_SCALE = re.compile(r"(?<![A-Za-z])[*x\u00d7]\s*(10{1,6}|1e[+]?[1-9])\b", re.IGNORECASE)
_WAVELENGTHS = re.compile(r"wave", re.IGNORECASE)
_BANDWIDTHS = re.compile(r"resolution|bandpass|fwhm", re.IGNORECASE)
_ERROR_BARS = re.compile(r"\s*error ?bars? to (?:preceding|previous)", re.IGNORECASE)


#: Key of a header written by hyperpaint.
_MARK = "hyperpaint library"
_BAR = " | "
_SHORT = {"member_reflectance": "member"}
_LONG = {short: name for name, short in _SHORT.items()}
_LABEL = re.compile(r"([A-Za-z_][A-Za-z0-9_]{0,99})(?: ([1-9][0-9]{0,9}))?")
_FORBIDDEN = str.maketrans({",": ";", "{": "(", "}": ")", "|": "/"})


def read_envi_library(
    path: Path, *, scale: float | None = None, wavelength: Floats | None = None, fwhm: Floats | None = None
) -> xr.Dataset:
    # Read an ENVI spectral library.
    # path: The header or the data file. scale: Stored value of a reflectance of one; by default the header's
    # ``reflectance scale factor``, else its ``z plot titles``. wavelength, fwhm: Values in place of those of
    # the header [nm]. Raises FormatError: The header is damaged, or the data file has another size; or the
    # file is not a library of reflectance, or has no wavelengths. Warns PaintWarning: Names are missing, or
    # an inferred property may make values wrong.
    header_path, data_path = find_pair(path)
    fetch([data_path])
    header = read_header(header_path, MAX_LIBRARY_HEADER_BYTES)
    with Problems(f"{header_path.name} cannot be used", FormatError) as problems:
        stored_bytes, expected_bytes = (
            data_path.stat().st_size,
            header.header_offset + header.lines * header.line_bytes,
        )
        problems.extend(
            Problem(found, expected=expected, mend=mend, code=code)
            for is_wrong, found, expected, mend, code in (
                (
                    not header.is_spectral_library,
                    f"file type is {header.fields.get('file type', 'none')!r}",
                    "a spectral library",
                    "",
                    "format-unknown",
                ),
                (
                    header.bands != 1,
                    f"bands is {header.bands}",
                    "1 (spectra are lines, their wavelengths samples)",
                    "",
                    "dims-wrong",
                ),
                (header.dtype.kind == "c", "values are complex", "reflectance", "", "type-wrong"),
                (
                    header.data_gain_values is not None or header.data_offset_values is not None,
                    "'data gain values' or 'data offset values' are set, which spectral libraries cannot "
                    "have",
                    "",
                    "",
                    "key-unknown",
                ),
                (
                    stored_bytes != expected_bytes,
                    f"{data_path.name} has {stored_bytes} bytes",
                    f"{expected_bytes} ({header.lines} spectra of {header.samples} values of "
                    f"{header.dtype.itemsize} bytes after {header.header_offset})",
                    "copy it again",
                    "file-size",
                ),
            )
            if is_wrong
        )
    if _MARK not in header.fields:
        return library_of(_foreign(header, data_path, scale, wavelength, fwhm))
    FormatError.raise_if(
        scale is not None or wavelength is not None or fwhm is not None,
        OWN_AXES.format(data_path.name),
        code="option-conflict",
    )
    # every record of a library of hyperpaint is named after its paint, variable and index
    source = data_path.name
    # names are counted before the text is split, so that millions of commas do not fill the memory
    text = bare(header.fields.get("spectra names", ""))
    count = text.count(",") + 1
    records = [name.strip() for name in text.split(",", header.lines)]
    names = [record for record in records if _BAR not in record]
    index_of = {name: at for at, name in enumerate(names)}
    keys: list[Key] = [(CENTRE, index, -1) for index in range(len(names))]
    unmatched = []
    for record in records[len(names) :]:
        paint, _, label = record.partition(_BAR)
        match = _LABEL.fullmatch(label)
        if paint in index_of and match is not None:
            keys.append((_LONG.get(match[1], match[1]), index_of[paint], int(match[2] or 0) - 1))
        else:
            unmatched.append(record)
    checks = (
        (
            header.wavelength is None or header.dtype != np.dtype("<f4"),
            "the header is not a hyperpaint header",
            "header-unreadable",
        ),
        (
            count != header.lines,
            f"{count} spectra names for {header.lines} spectra",
            "length-mismatch",
        ),
        (
            len(index_of) != len(names) or records[: len(names)] != names,
            "the first records are not one record per paint",
            "record-unmatched",
        ),
        (
            bool(unmatched),
            f"record {''.join(unmatched[:1])[:80]!r} belongs to no paint",
            "record-unmatched",
        ),
    )
    mend = "write the library again"
    refuse(source, *((is_wrong, Problem(found, mend=mend, code=code)) for is_wrong, found, code in checks))
    return restored(
        data_path,
        names,
        keys,
        {"wavelength": header.wavelength, "fwhm": header.fwhm, "good": header.good},
        _records(header, data_path),
        {},
    )


def _records(header: EnviHeader, path: Path) -> Iterator[tuple[int, Array]]:
    # Index of the first record of every block, and its records
    step = max(1, _BLOCK_BYTES // header.line_bytes)
    with open_input(path, "the data of a spectral library") as file:
        file.seek(header.header_offset)
        for start in range(0, header.lines, step):
            count = min(step, header.lines - start)
            stored = np.fromfile(file, header.dtype, count * header.samples)
            FormatError.raise_if(
                stored.size != count * header.samples,
                f"{path.name} became shorter during reading",
                code="file-truncated",
            )
            yield start, stored.reshape(count, header.samples)


def _foreign(
    header: EnviHeader, path: Path, scale: float | None, wavelength: Floats | None, fwhm: Floats | None
) -> Spectra:
    source = path.name
    notes = list(header.notes)
    warned = list(header.warnings)
    # names are counted before the text is split, so that millions of commas do not fill the memory
    text = bare(header.fields.get("spectra names", ""))
    count = text.rstrip(", \t\n").count(",") + 1 if text else 0
    names = [f"spectrum {number}" for number in range(1, header.lines + 1)]
    given_names = [name.strip() for name in text.split(",", header.lines)[: header.lines]]
    if not text:
        warned.append("no spectra names: spectra are numbered")
    elif count > header.lines or len(given_names) < header.lines:
        warned.append(
            f"{count} spectra names for {header.lines} spectra (a name with a comma counts as two): "
            "spectra are numbered"
        )
    else:
        names = [given or number for given, number in zip(given_names, names, strict=True)]
    stored = np.concatenate([block for _, block in _records(header, path)])
    nm = header.wavelength if wavelength is None else wavelength
    width = header.fwhm if fwhm is None else fwhm
    # leading records that are wavelengths and bandwidths (USGS libraries)
    with np.errstate(invalid="ignore"):  # signalling NaNs of a damaged file
        axis, axes = stored[0].astype(np.float64), 0
    if (
        len(names) > 2
        and _WAVELENGTHS.match(names[0])
        and np.isfinite(axis).all()
        and (axis > 0).all()
        and (nm is None or any(np.allclose(axis * factor, nm, rtol=1e-3) for factor in (1.0, 1e3)))
    ):
        axes = 2 if _BANDWIDTHS.match(names[1]) else 1
        notes.append(f"the first {axes} records are the wavelengths and bandwidths of the spectra")
        factor = 1e3 if np.nanmax(stored[0]) < 100 else 1.0
        nm = axis * factor if nm is None else nm
        if width is None and axes == 2:
            width = stored[1].astype(np.float64) * factor
    nm = FormatError.raise_if_none(
        nm,
        (
            f"{source}: the header has no wavelengths (wavelength units "
            f"{bare(header.fields.get('wavelength units', 'not given'))!r})"
        ),
        mend="pass wavelength= [nm]",
        code="wavelength-missing",
    )
    check_wavelengths(nm, source)
    warn_if(warned, f"{source}: {'; '.join(warned)}", "header-incomplete")
    # stored value of a reflectance of one, from the header; the last title is that of the values, the title
    # of the wavelengths may contain commas
    header_scale = header.reflectance_scale_factor
    title = bare(header.fields.get("z plot titles", "")).rpartition(",")[2]
    match = _TITLE_SCALE.search(title)
    title_scale = float(match[1]) if match else 100.0 if PERCENT.search(title) else None
    # a description may name the file or the cube of radiance that spectra come from, but no unit of light
    description, units = (header.fields.get(key, "") for key in ("description", "data units"))
    is_light = "reflect" not in description.lower() and _OF_LIGHT.search(description) is not None
    FormatError.raise_if(
        is_light or foreign_quantity(title) or foreign_quantity(units),
        f"{source}: the header has {(description if is_light else title + units).strip()[:60]!r}",
        expected="reflectance",
        code="quantity-wrong",
    )
    if header_scale is not None and title_scale is not None and header_scale != title_scale:
        raise FormatError(
            (
                f"{source}: 'reflectance scale factor' is {header_scale:g}, but 'z plot titles' has "
                f"{title.strip()[:60]!r}"
            ),
            mend="pass scale=",
            code="scale-conflict",
        )
    values = reflectances(
        stored[axes:],
        source,
        file_scale=title_scale if header_scale is None else header_scale,
        scale=scale,
        ignore=header.data_ignore_value,
    )
    # error bars follow their spectrum
    is_bar = np.array([_ERROR_BARS.match(name) is not None for name in names[axes:]], np.bool_)
    is_bar[:1] = False
    is_bar[1:] &= ~is_bar[:-1]
    spectra, errors = np.flatnonzero(~is_bar), {}
    if is_bar.any():
        bars = np.full_like(values, np.nan)
        bars[np.flatnonzero(is_bar) - 1] = values[is_bar]
        bars[bars < 0] = np.nan  # from the interpolation of the USGS
        errors["reflectance_u_random"] = bars[spectra]
        notes.append(f"{is_bar.sum()} records are error bars of the spectrum before them")
    numbers = spectra + axes
    return Spectra(
        source=source,
        form="ENVI spectral library",
        names=[names[at] for at in numbers],
        wavelength=nm,
        reflectance=values[spectra],
        fwhm=width,
        good=header.good,
        others=errors,
        columns={"record": numbers, **_classes(path, [names[at] for at in numbers])},
        notes=notes,
    )


def _classes(path: Path, names: Sequence[str]) -> dict[str, Array]:
    # Columns of the table of classes that EnMAP-Box writes beside a library; empty without such a table.
    # Its first column, "spectra names", repeats the names.
    table = path.with_suffix(".csv")
    try:
        text = read_limited(table, _MAX_CLASSES_BYTES, "a table of classes").decode("utf-8-sig", "replace")
        rows = [row for row in csv.reader(io.StringIO(text, newline="")) if row]
    except (FormatError, csv.Error):
        return {}
    if (
        not rows
        or rows[0][0].strip().lower() != "spectra names"
        or [row[0].strip() for row in rows[1:]] != list(names)
        or any(len(row) != len(rows[0]) for row in rows)
    ):
        return {}
    return {
        key: text_column([row[at] for row in rows[1:]])
        for at, key in enumerate(rows[0])
        if at
        and key.isidentifier()
        and key not in ("record", SIGNATURE, "band", "wavelength", "fwhm", "good")
    }


def write_envi_library(
    library: xr.Dataset, names: Sequence[str], blocks: Iterable[Block], path: Path, header_path: Path
) -> None:
    # Write the records of a checked library, and its header.
    # Raises SchemaError: The header would be too large.
    # distinct names without the separators of a header
    names = unique_names(name.translate(_FORBIDDEN).strip() or "unnamed" for name in names)
    records: list[str] = []
    with open(path, "wb") as file:
        for variable, paints, inners, values in blocks:
            np.asarray(values, "<f4").tofile(file)
            # such as "red" and, of its members, "red | member 3"
            label = "" if variable == CENTRE else f"{_BAR}{_SHORT.get(variable, variable)}"
            records += [
                f"{names[paint]}{label}{f' {inner + 1}' if inner >= 0 else ''}"
                for paint, inner in zip(paints.tolist(), inners.tolist(), strict=True)
            ]
    lists = {"wavelength": [repr(float(value)) for value in library["wavelength"].values]}
    # a header can only contain finite numbers; others are in the metadata
    if "fwhm" in library.variables and np.isfinite(library["fwhm"].values).all():
        lists["fwhm"] = [repr(float(value)) for value in library["fwhm"].values]
    if "good" in library.variables:
        lists["bbl"] = ["1" if value else "0" for value in library["good"].values]
    lists["spectra names"] = list(records)
    if len(records) == library.sizes[SIGNATURE]:
        columns = table_columns(library).items()
        lists |= {
            f"paint {name}": [cell.translate(_FORBIDDEN) for cell in column] for name, column in columns
        }
    text = (
        "\n".join(
            [
                "ENVI",
                f"description = {{Paint library of hyperpaint: {library.sizes[SIGNATURE]} paints}}",
                f"samples = {library.sizes[BAND]}",
                f"lines = {len(records)}",
                "bands = 1",
                "header offset = 0",
                "file type = ENVI Spectral Library",
                "data type = 4",
                "interleave = bsq",
                "sensor type = Unknown",
                "byte order = 0",
                "wavelength units = Nanometers",
                "reflectance scale factor = 1.0",
                "z plot titles = {Wavelength (nm), Reflectance}",
                f"{_MARK} = 1",
                *(f"{key} = {braced(values)}" for key, values in lists.items()),
            ]
        )
        + "\n"
    ).encode()
    SchemaError.raise_if(
        len(text) > MAX_LIBRARY_HEADER_BYTES,
        f"the header of {len(records)} spectra takes {len(text)} bytes",
        expected=f"at most {MAX_LIBRARY_HEADER_BYTES}",
        mend="shorten names, write fewer members, or write Zarr",
        code="file-too-large",
    )
    header_path.write_bytes(text)
