"""Spectra of one file as a paint library, and a paint library as records of a file with metadata beside it.

Every spectrum of a library is one record: first the reflectance of all paints, then their further variables
on the bands, then their members. The key of a record is its variable, its paint, and its number within the
paint. The metadata, ``<data file>.json``, are the library as `xarray.Dataset.to_dict` describes it, without
the values of its spectra: strict JSON with one variable per line, for readers and version control.
"""

from __future__ import annotations

import itertools
import json
import math
import re
import unicodedata
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import NoneType
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from hyperpaint.base.arrays import Array, Floats, Floats32, Ints, Progress
from hyperpaint.base.errors import FormatError, Problem, Problems, SchemaError, warn_user
from hyperpaint.base.input_files import read_limited
from hyperpaint.base.old_names import NEW_NAMES, VERSION_NAME, warn_of_old_names
from hyperpaint.base.schema import BAND, LIBRARY_VARIABLES, MEMBER, SIGNATURE, find, quality_attrs
from hyperpaint.io.files.reading import numbers, refuse

#: Wavelength range of spectral libraries [nm]: far ultraviolet to far infrared (USGS libraries end at 216
#: um). Visible wavelengths in nanometres, read as micrometres, are larger.
MIN_NM, MAX_NM = 100.0, 3e5

#: Message for options that replace data of a library of hyperpaint.
OWN_AXES = (
    "{} is a library of hyperpaint with its own axes and scale: leave wavelength=, fwhm= and scale= out"
)

#: Maximum median of reflectance as a fraction: a white panel has 1.
_MAX_MEDIAN = 1.1

_BRIGHT = 1.2
#: Maximum share of values above `_BRIGHT` in reflectance: noise in opaque bands of air has 0.05, the
#: brightest of the 2457 spectra of splib07 has 0.01, radiance of a lawn in uW cm-2 sr-1 nm-1 has 0.5.
_MAX_BRIGHT_SHARE = 0.1

#: Minimum of the largest value of a file; below it the scale is doubtful: black coats reach 0.02 to 0.05.
_MIN_BRIGHTEST = 0.01

#: Stored values that mark missing samples.
_MISSING_VALUES = (-999.0, -9999.0, -99999.0, -32768.0)

#: Minimum reflectance with noise [1]: lower values mark missing samples.
_MIN_REFLECTANCE = -0.5

#: Maximum of fill values: deleted points of USGS spectra are -1.23e34, and fractions of it in spectra
#: convolved to another spectrometer.
_MAX_FILL_VALUE = -1e20


@dataclass(frozen=True, eq=False)
class Spectra:
    # Spectra of one file with common wavelengths.
    source: str  # file name
    form: str  # name of the format
    names: Sequence[str]  # of the spectra, as in the file
    wavelength: Floats  # (band) [nm], in the order of the file
    reflectance: Floats32  # (signature, band) as a fraction; NaN for missing samples
    fwhm: Floats | None = None  # (band) [nm]; None if not in the file
    good: npt.NDArray[np.bool_] | None = None
    # Further variables (signature, band) by their names in `LIBRARY_VARIABLES`
    others: Mapping[str, Floats32] = field(default_factory=dict)
    # Further variables with one value per spectrum
    columns: Mapping[str, Sequence[Any] | npt.NDArray[Any]] = field(default_factory=dict)
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


def text_column(texts: Sequence[str]) -> npt.NDArray[np.object_]:
    # Return texts as an array of objects, as stores hold them.
    column = np.empty(len(texts), object)
    column[:] = list(texts)
    return column


def check_wavelengths(wavelength: Floats, source: str) -> None:
    # Check that there are wavelengths [nm], within the range and without duplicates.
    # Raises FormatError: There are none; they are not finite, outside 100 nm to 300 um, or duplicate.
    description = f"{wavelength.size} wavelengths, not all of them finite"
    if wavelength.size and np.isfinite(wavelength).all():
        low, high = float(wavelength.min()), float(wavelength.max())
        if low >= MIN_NM and high <= MAX_NM:
            values, counts = np.unique(wavelength, return_counts=True)
            if not (counts > 1).any():
                return
            raise FormatError(
                f"{source}: {int((counts > 1).sum())} wavelengths occur twice, such as "
                f"{values[counts > 1][0]:g} nm",
                expected="distinct wavelengths",
                mend="drop one of the two bands",
                code="wavelength-duplicate",
            )
        description = f"wavelengths from {low:g} to {high:g} nm"
        if low >= MIN_NM * 1e3 and high <= MAX_NM * 1e3:
            description += " (nanometres declared as micrometres?)"
    raise FormatError(
        f"{source}: {description}",
        expected=f"{MIN_NM:g} nm to {MAX_NM:g} nm",
        mend="check their units, or pass wavelength= [nm]",
        code="wavelength-range",
    )


def reflectances(
    stored: npt.NDArray[Any],
    source: str,
    *,
    file_scale: float | None,
    scale: float | None,
    ignore: Any = None,
    is_reflectance: bool = False,
) -> Floats32:
    """Return stored values as reflectance.

    file_scale, scale: Stored value of a reflectance of one, from the file and from the caller; that of the
        caller is preferred.
    ignore: Stored value of missing samples, besides the fill values of the USGS.
    is_reflectance: Whether values above 1 are accepted.
    Returns numpy.ndarray: float32; a fraction.
    Raises FormatError: The scale is unknown and the values are not fractions; or they do not fit float32.
    Warns PaintWarning: Values far below 0 were taken for missing; or the scale is doubtful.
    """
    with np.errstate(all="ignore"):  # signalling NaNs of a damaged file
        values = stored.astype(np.float64)
        is_fill = values < _MAX_FILL_VALUE
    if ignore is not None:
        # compared in the stored dtype: a float32 file holds the float32 nearest to the number in its header
        with np.errstate(over="ignore"):
            is_fill |= stored == (stored.dtype.type(ignore) if stored.dtype.kind == "f" else ignore)
    values[is_fill] = np.nan
    divisor = scale if scale is not None else file_scale
    with np.errstate(over="ignore"):
        far_below = np.isfinite(values) & (values < _MIN_REFLECTANCE * (divisor or 1.0))
        is_missing = np.isin(values, _MISSING_VALUES) | far_below
    if is_missing.any():
        count, example = int(is_missing.sum()), float(values[is_missing][0])
        msg = f"{source}: {count} value{'s'[: count - 1]} far below 0, such as {example:g}, taken for missing"
        warn_user(msg, "values-far-below-zero")
        values[is_missing] = np.nan
    if divisor is None:
        _judge_fractions(values, source, _MAX_BRIGHT_SHARE if not is_reflectance else 1.0)
    elif divisor != 1.0:
        values /= divisor
        finite = values[np.isfinite(values)]
        # the scale is doubtful if many values exceed `_BRIGHT`, or all are near 0
        if finite.any() and ((finite > _BRIGHT).mean() > _MAX_BRIGHT_SHARE or finite.max() < _MIN_BRIGHTEST):
            msg = f"{source}: reflectance up to {finite.max():.3g} with a scale of {divisor:g}; pass scale="
            warn_user(msg, "scale-doubtful")
    with np.errstate(over="ignore"):
        reflectance = values.astype(np.float32)
    if not np.isfinite(reflectance[np.isfinite(values)]).all() or np.isinf(values).any():
        largest = np.abs(values[~np.isnan(values)]).max()
        raise FormatError(
            f"{source}: values up to {largest:g}", expected="finite reflectance", code="not-finite"
        )
    return reflectance


def _judge_fractions(values: Floats, source: str, max_bright_share: float) -> None:
    # Raise if values without a scale are not fractions; warn if only few spectra are not
    finite = np.isfinite(values)
    magnitudes = np.abs(values[finite])
    advice = (
        "pass scale=100 for percent, 10000 for hundredths of a percent, or scale=1 if values are fractions"
    )
    if magnitudes.size and float(np.median(magnitudes)) > _MAX_MEDIAN:
        raise FormatError(
            f"{source}: values up to {magnitudes.max():g}, half of them above "
            f"{np.median(magnitudes):g}, and no scale (radiance or counts?)",
            expected="reflectance as a fraction",
            mend=advice,
            code="scale-missing",
        )
    with np.errstate(invalid="ignore"):
        is_bright = (np.abs(values) > _BRIGHT).sum(axis=1) > max_bright_share * np.maximum(
            finite.sum(axis=1), 1
        )
    if 2 * is_bright.sum() > len(values):
        raise FormatError(
            f"{source}: values up to {magnitudes.max():g}, more than a tenth above {_BRIGHT:g} (radiance?)",
            expected="reflectance as a fraction",
            mend=f"{advice} (for a text: quantity='reflectance')",
            code="scale-missing",
        )
    is_bright = is_bright | [
        bool(is_finite.any()) and float(np.median(spectrum[is_finite])) > _MAX_MEDIAN
        for spectrum, is_finite in zip(values, finite, strict=True)
    ]
    if is_bright.any():
        msg = (
            f"{source}: {is_bright.sum()} of {len(values)} spectra have many values above "
            f"{_MAX_MEDIAN:g}, up to {magnitudes.max():g}, and no scale; {advice}"
        )
        warn_user(msg, "scale-missing")


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
MAX_BYTES = 16 * 2**20
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
    problems = Problems("the library cannot be written", SchemaError)
    problems.extend(faults)
    for name, array in variables.items():
        dtype = LIBRARY_VARIABLES[name].dtype
        kind = np.dtype("object" if dtype == "str" else dtype).kind
        accepted_kinds = {"f": "fiu", "i": "iu", "u": "iu", "O": "OUT"}.get(kind, kind)
        problems.add_if(
            array.dtype.kind not in accepted_kinds,
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
    problems.raise_if_any()
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
                yield name, paint + start, number_in_paint, values[is_stored]
            else:
                paint = np.arange(start, stop)
                yield name, paint, np.full(stop - start, -1), np.ascontiguousarray(values)
            if progress is not None:
                progress(number * paints + stop, len(names) * paints)


def metadata_path(data: Path) -> Path:
    # Return the path of the metadata of a data file.
    return data.with_name(data.name + ".json")


def metadata_text(library: xr.Dataset, spectra: Sequence[str]) -> str:
    # Return all of a library except the values of its spectra, as JSON.
    # Raises SchemaError: Attributes or values cannot be written as JSON; all are listed. Or the text is too
    # large.
    problems = Problems("the library's metadata cannot be written", SchemaError)
    document = {"hyperpaint_library": VERSION, **library.to_dict(data=False)}
    entries = document["coords"] | document["data_vars"]
    owners = {"the library": document["attrs"], **{name: entry["attrs"] for name, entry in entries.items()}}
    for owner, key, value in [(name, *item) for name, attrs in owners.items() for item in attrs.items()]:
        try:
            _json({key: value})
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
    problems.raise_if_any()
    # xarray gathers coordinates from sets, whose order differs from run to run
    names = ("coords", "data_vars")
    parts = {part: dict(sorted((str(k), v) for k, v in document.pop(part).items())) for part in names}
    document["dims"] = dict(sorted(document["dims"].items()))
    lines = [f"  {_json(key)}: {_json(value)}" for key, value in document.items()]
    for part, variables in parts.items():
        rows = ",\n".join(f"    {_json(name)}: {_json(entry)}" for name, entry in variables.items())
        lines.append(f"  {_json(part)}: {{\n{rows}\n  }}")
    text = "{\n" + ",\n".join(lines) + "\n}\n"
    if len(text.encode()) > MAX_BYTES:
        raise SchemaError(
            f"the metadata of the library take {len(text.encode())} bytes",
            expected=f"at most {MAX_BYTES}",
            mend="drop variables, write fewer paints, or write Zarr",
            code="file-too-large",
        )
    return text


def _json(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False, allow_nan=False)


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
            plain = values.tolist()
            columns[str(name)] = [None if isinstance(v, float) and not math.isfinite(v) else v for v in plain]
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
    def refuse_constant(text: str) -> None:
        raise ValueError(f"{text} is not JSON")

    problems = Problems(f"{path.name} is not the metadata of its library", FormatError)
    raw = read_limited(path, MAX_BYTES, "metadata of a paint library")
    about = xr.Dataset()
    try:
        document = json.loads(raw.decode("utf-8"), parse_constant=refuse_constant)
        if document["hyperpaint_library"] not in (1, 2, VERSION):
            raise ValueError(f"expected version {VERSION}")
        if document["hyperpaint_library"] == 1:
            warn_of_old_names(path.name)
        if document["hyperpaint_library"] < VERSION:
            document = _upgraded(document, sizes)
        for part in ("coords", "data_vars"):
            for name, entry in document[part].items():
                try:
                    document[part][name] = _decoded(name, entry)
                except (LookupError, TypeError, ValueError, OverflowError) as error:
                    problems.add(f"{name[:60]!r}: {error!s:.100}", code="metadata-damaged")
        if not len(problems):
            about = xr.Dataset.from_dict(document).assign_attrs(dict(document["attrs"]))
            sizes = {dim: size for dim, size in sizes.items() if about.sizes.get(dim, size) != size}
            if sizes:
                problems.add(f"sizes {dict(about.sizes)}", expected=str(sizes), code="metadata-damaged")
    except (LookupError, TypeError, ValueError, AttributeError, RecursionError) as error:
        problems.add(
            f"not readable as JSON of a library ({error!s:.100})",
            expected=f'an object with "hyperpaint_library": {VERSION}',
            mend="copy the file again, or write the library again",
            code="metadata-damaged",
        )
    problems.raise_if_any()
    return about


def _upgraded(document: dict[str, Any], sizes: Mapping[str, int]) -> dict[str, Any]:
    # Metadata of versions 1 and 2 in the form of version 3
    names = NEW_NAMES if document["hyperpaint_library"] == 1 else {}
    sizes = {**document["sizes"], **sizes}
    parts: dict[str, Any] = {"coords": {}, "data_vars": {}}
    for name, entry in {**document["variables"], **document["spectra"]}.items():
        dims = [names.get(dim, dim) for dim in entry["dims"]]
        data = {"data": entry["values"]} if "values" in entry else {"shape": [sizes[dim] for dim in dims]}
        part = parts["coords" if entry.get("coordinate") is True else "data_vars"]
        part[names.get(name, name)] = {"dtype": "float32", **entry, "dims": dims, **data}
    attrs = {
        key: 2 if key == VERSION_NAME and value == 1 else value for key, value in document["attrs"].items()
    }
    return {"attrs": attrs, **parts}


def _decoded(name: str, entry: Mapping[str, Any]) -> dict[str, Any]:
    # A variable for `xarray.Dataset.from_dict`
    dims, attrs = entry["dims"], dict(entry["attrs"])
    if len(set(dims)) != len(dims) or len(dims) > _MAX_DIMS or not all(isinstance(dim, str) for dim in dims):
        raise ValueError("expected distinct dims")
    if "data" in entry:
        nested = np.array(entry["data"], object)
        if nested.ndim != len(dims) or any(isinstance(value, list) for value in nested.flat):
            raise ValueError("expected nested lists of equal lengths, one level per dim")
        values = typed_values(nested.ravel().tolist(), entry["dtype"]).reshape(nested.shape)
    else:
        # only spectra lack values; an axis without values would fill the memory with its index
        if not (
            {SIGNATURE, BAND} <= {*dims} and all(type(s) is int and 0 <= s < 2**31 for s in entry["shape"])
        ):
            raise ValueError("expected values, or a spectrum with sizes from 0 to 2147483647")
        values = np.broadcast_to(np.float32(np.nan), entry["shape"])
    if name == "quality":
        attrs["flag_masks"] = quality_attrs()["flag_masks"]
    return {"dims": dims, "attrs": attrs, "data": values}


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
    about = None
    if sidecar.exists():
        about = read_metadata(sidecar, {SIGNATURE: paints, BAND: bands})
    else:
        text = f"{source}: {sidecar.name} is missing: names and columns are from the file, without units"
        warn_user(text, "metadata-missing")
    for first, block in rows:
        records = slice(first, first + len(block))
        for number, values in enumerate(data.values()):
            is_here = variable_of[records] == number
            paint, inner = paint_of[records][is_here], inner_of[records][is_here]
            values[(paint,) if values.ndim == 2 else (paint, inner)] = block[is_here]
    library = _with_metadata(data, axes, names, about, source)
    stored_columns = {} if about is None else table_columns(library)
    if edited := [name for name, cells in columns.items() if list(cells) != stored_columns.get(name, cells)]:
        text = (
            f"{source}: {', '.join(edited)} differ from {sidecar.name}, which is used; delete it to use "
            "the table"
        )
        warn_user(text, "metadata-differ")
    # names in the table of variables are excluded: their columns have no units
    reserved = {*library.variables, *library.dims, *LIBRARY_VARIABLES}
    added = {}
    for name, texts in columns.items():
        if name not in reserved:
            parsed = numbers(cell or "nan" for cell in texts)
            is_text = parsed is None or not any(texts)
            added[name] = (SIGNATURE, text_column(texts) if is_text else np.array(parsed))
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
    problems = Problems(f"{source} and its metadata belong to different libraries", FormatError)
    library = xr.Dataset(attrs={"title": "Spectral library", "source": source}) if about is None else about
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
                f"{name!r} has {values.ndim} dims", expected=f"{dims}, as in the metadata", code="dims-wrong"
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
    coords |= {name: (BAND, values, rows[name].attrs) for name, values in axes.items() if values is not None}
    for name, (_, values, _) in coords.items():
        known = library.variables.get(name)
        problems.add_if(
            name != SIGNATURE and known is not None and not np.array_equal(known.values, values),
            f"{name!r} of the file and of the metadata differ",
            mend="put the files of one library together",
            code="grid-mismatch",
        )
    problems.raise_if_any()
    own_coords = {name: coord for name, coord in coords.items() if name not in library.variables}
    try:
        return library.assign(spectra).assign_coords(own_coords)
    except ValueError as error:  # sizes or dims differ
        subject = f"{source} and its metadata belong to different libraries"
        problem = Problem(f"{error!s:.200}", code="grid-mismatch")
        raise FormatError(subject, problems=[problem]) from error
