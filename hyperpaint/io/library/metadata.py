"""Metadata of a paint library as JSON: names, numbers, times, attributes.

The file is ``<data file>.json``: strict JSON with one variable per line, for readers and version control.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base.arrays import Array
from hyperpaint.base.errors import FormatError, Problems, SchemaError
from hyperpaint.base.input_files import read_limited
from hyperpaint.base.old_names import NEW_NAMES, VERSION_NAME, warn_of_old_names
from hyperpaint.base.schema import BAND, SIGNATURE, quality_attrs

from .library_spectra import text_column

#: Version of the file; 1, of hyperpaint 0.2 and before, has the dimension `paint` where 2 has
#: `signature`.
VERSION = 2
MAX_BYTES = 16 * 2**20
_MAX_DIMS = 4
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


@dataclass
class Metadata:
    """Checked metadata of a library."""

    attrs: dict[str, Any] = field(default_factory=dict)  # of the dataset
    # Sizes of further dims of the spectra, beside signature and band
    sizes: dict[str, int] = field(default_factory=dict)
    # Dims and attributes of the variables of spectra, whose values are in the data file
    spectra: dict[str, tuple[tuple[str, ...], dict[str, Any]]] = field(default_factory=dict)
    # Dims, values and attributes of all other variables, coordinates included
    variables: dict[str, tuple[tuple[str, ...], Array, dict[str, Any]]] = field(default_factory=dict)
    coordinates: set[str] = field(default_factory=set)  # names of the coordinates


def metadata_path(data: Path) -> Path:
    """Return the path of the metadata of a data file."""
    return data.with_name(data.name + ".json")


# --- writing -----------------------------------------------------------------------------------------------


def metadata_text(library: xr.Dataset, spectra: Iterable[str]) -> str:
    """Return all of a library except the values of its spectra, as JSON.

    Raises SchemaError: Attributes or values cannot be written as JSON; all are listed. Or the text is too
        large.
    """
    names = list(spectra)
    problems = Problems("the library's metadata cannot be written", SchemaError)
    inner = {dim for name in names for dim in library[name].dims} - {SIGNATURE, BAND}
    parts = {
        "hyperpaint_library": VERSION,
        "attrs": _attrs(library.attrs, "the library", problems),
        "sizes": {str(dim): library.sizes[dim] for dim in sorted(inner, key=str)},
        "spectra": {
            name: {
                "dims": [str(dim) for dim in library[name].dims],
                "attrs": _attrs(library[name].attrs, name, problems),
            }
            for name in names
        },
    }
    # xarray gathers coordinates from sets, whose order differs from run to run
    variables = {
        str(name): _described(str(name), library.variables[name], name in library.coords, problems)
        for name in sorted(library.variables, key=str)
        if name not in names
    }
    problems.raise_if_any()
    lines = [f"  {json.dumps(key)}: {_dumped(value)}" for key, value in parts.items()]
    rows = ",\n".join(f"    {_dumped(name)}: {_dumped(value)}" for name, value in variables.items())
    text = "{\n" + ",\n".join([*lines, '  "variables": {\n' + rows + "\n  }"]) + "\n}\n"
    if len(text.encode()) > MAX_BYTES:
        raise SchemaError(
            f"the metadata of the library take {len(text.encode())} bytes",
            expected=f"at most {MAX_BYTES}",
            mend="drop variables, write fewer paints, or write Zarr",
            code="file-too-large",
        )
    return text


def paint_columns(library: xr.Dataset) -> dict[str, list[Any]]:
    """Return the variables with one value per paint as texts and numbers, NaN and infinity as None."""
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


#: Variables omitted from tables: outlines as JSON, columns of the format, words that read as numbers.
_NO_COLUMNS = ("region", "variable", "place", "nan", "inf", "infinity")


def table_columns(library: xr.Dataset) -> dict[str, list[str]]:
    """Return the variables with one value per paint as cells of a table, without line breaks."""
    return {
        name: [" ".join(str("" if value is None else value).split()) for value in values]
        for name, values in paint_columns(library).items()
        if name.lower() not in _NO_COLUMNS
    }


def _dumped(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False, allow_nan=False)


def _attrs(attrs: Mapping[Any, Any], owner: str, problems: Problems) -> dict[str, Any]:
    plain_attrs = {}
    for key, value in attrs.items():
        plain = value.tolist() if isinstance(value, np.ndarray | np.generic) else value
        try:
            _dumped(plain)
        except (TypeError, ValueError, RecursionError):
            problems.add(
                f"attribute {key!r} of {owner} is {str(value)[:60]!r}",
                expected="text or numbers",
                code="type-wrong",
            )
        plain_attrs[str(key)] = plain
    return plain_attrs


def _described(name: str, variable: xr.Variable, coordinate: bool, problems: Problems) -> dict[str, Any]:
    values = np.asarray(variable.values)
    dtype = "str" if values.dtype.kind in "OUT" else str(values.dtype)
    plain: Any = None
    if dtype not in _DTYPES:
        problems.add(
            f"{name!r} is {values.dtype}",
            expected="numbers, booleans, text or datetime64[ns]",
            code="type-wrong",
        )
    elif dtype == "str":
        plain = values.tolist()
        no_text = next((value for value in values.ravel().tolist() if not isinstance(value, str)), None)
        if no_text is not None:
            problems.add(
                f"{name!r} contains a value of type {type(no_text).__name__}",
                expected="only texts",
                code="type-wrong",
            )
    elif dtype == "datetime64[ns]":
        plain = np.where(np.isnat(values), "", np.datetime_as_string(values)).tolist()
    else:
        plain = _without_nan(values.tolist())
        if values.dtype.kind == "f" and np.isinf(values).any():
            problems.add(f"{name!r} contains infinity", expected="finite numbers or NaN", code="not-finite")
    return {
        "dims": [str(dim) for dim in variable.dims],
        "dtype": dtype,
        "coordinate": coordinate,
        "attrs": _attrs(variable.attrs, name, problems),
        "values": plain,
    }


def _without_nan(values: Any) -> Any:
    if isinstance(values, list):
        return [_without_nan(value) for value in values]
    return None if isinstance(values, float) and math.isnan(values) else values


# --- reading -----------------------------------------------------------------------------------------------


def read_metadata(path: Path, sizes: Mapping[str, int]) -> Metadata:
    """Read the metadata of a library.

    sizes: Sizes of signature and band in the data file.
    Raises FormatError: The file is not from `metadata_text`, or belongs to another library; all problems are
        listed.
    """
    raw = read_limited(path, MAX_BYTES, "metadata of a paint library")
    try:
        document = json.loads(raw.decode("utf-8"), parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise FormatError(
            f"{path.name}: not readable as JSON ({error!s:.100})",
            mend="copy the file again, or write the library again",
            code="metadata-damaged",
        ) from error
    problems = Problems(f"{path.name} is not the metadata of its library", FormatError)
    metadata = Metadata()
    if not isinstance(document, dict) or document.get("hyperpaint_library") not in (1, VERSION):
        problems.add(
            "the version is missing or another",
            expected=f'an object with "hyperpaint_library": {VERSION}',
            code="metadata-damaged",
        )
    else:
        if document["hyperpaint_library"] == 1:
            warn_of_old_names(path.name)
            document = _with_new_names(document)
        _read_document(document, metadata, dict(sizes), problems)
    problems.raise_if_any()
    return metadata


def _refuse_constant(text: str) -> None:
    raise ValueError(f"{text} is not JSON")


def _with_new_names(document: dict[str, Any]) -> dict[str, Any]:
    # Metadata of version 1 as version 2; damage is reported by `_read_document`
    def renamed(entry: Any) -> Any:
        dims = entry.get("dims") if isinstance(entry, dict) else None
        if not isinstance(dims, list):
            return entry
        return {**entry, "dims": [NEW_NAMES.get(dim, dim) if isinstance(dim, str) else dim for dim in dims]}

    document = dict(document)
    for key in ("spectra", "variables"):
        if isinstance(entries := document.get(key), dict):
            document[key] = {NEW_NAMES.get(name, name): renamed(entry) for name, entry in entries.items()}
    attrs = document.get("attrs")
    if isinstance(attrs, dict) and attrs.get(VERSION_NAME) == 1:
        document["attrs"] = {**attrs, VERSION_NAME: 2}
    return document


def _read_document(
    document: dict[str, Any], metadata: Metadata, sizes: dict[str, int], problems: Problems
) -> None:
    no_objects = [
        key for key in ("attrs", "sizes", "spectra", "variables") if not isinstance(document.get(key), dict)
    ]
    if no_objects:
        problems.add(f"{', '.join(no_objects)}", expected="an object", code="metadata-damaged")
        return
    metadata.attrs = _plain_attrs(document["attrs"], "attrs", problems)
    for dim, size in document["sizes"].items():
        if type(size) is not int or not 0 <= size <= 2**31 or dim in (SIGNATURE, BAND):
            problems.add(
                f"size of {dim[:60]!r} is {str(size)[:30]}",
                expected="a whole number from 0 to 2147483648",
                code="metadata-damaged",
            )
        else:
            metadata.sizes[dim] = size
    for name, entry in document["spectra"].items():
        dims = _dims_of(entry, problems, name)
        if dims is not None:
            metadata.spectra[name] = (dims, _plain_attrs(entry.get("attrs"), name, problems))
    all_sizes = {**metadata.sizes, **sizes}
    for name, entry in document["variables"].items():
        variable = _variable(name, entry, all_sizes, problems)
        if variable is not None:
            metadata.variables[name] = variable
            if entry.get("coordinate") is True:
                metadata.coordinates.add(name)


def _plain_attrs(attrs: Any, owner: str, problems: Problems) -> dict[str, Any]:
    if isinstance(attrs, dict):
        return dict(attrs)
    problems.add(f"attributes of {owner[:60]!r}", expected="an object", code="metadata-damaged")
    return {}


def _variable(
    name: str, entry: Any, sizes: dict[str, int], problems: Problems
) -> tuple[tuple[str, ...], Array, dict[str, Any]] | None:
    dims = _dims_of(entry, problems, name)
    if dims is None:
        return None
    dtype, attrs = entry.get("dtype"), entry.get("attrs")
    if dtype not in _DTYPES or not isinstance(attrs, dict):
        problems.add(
            f"{name[:60]!r} has an unknown dtype, or no attributes",
            expected=f"attributes, and a dtype of {', '.join(_DTYPES)}",
            code="metadata-damaged",
        )
        return None
    try:
        nested = np.array(entry.get("values"), object)
        if nested.ndim != len(dims) or any(isinstance(value, list) for value in nested.flat):
            raise ValueError("expected nested lists of equal lengths, one level per dim")
        # a dim that is not in `sizes` gets its size from the first variable with it
        expected = tuple(sizes.setdefault(dim, size) for dim, size in zip(dims, nested.shape, strict=True))
        if nested.shape != expected:
            raise ValueError(f"shape {nested.shape}, expected {expected}")
        values = typed_values(nested.ravel().tolist(), dtype).reshape(nested.shape)
    except (ValueError, TypeError, OverflowError) as error:
        problems.add(f"{name[:60]!r} ({dtype}): {error!s:.100}", code="metadata-damaged")
        return None
    if name == "quality":
        attrs = {**attrs, "flag_masks": quality_attrs()["flag_masks"]}
    return dims, values, dict(attrs)


def _dims_of(entry: Any, problems: Problems, name: str) -> tuple[str, ...] | None:
    dims = entry.get("dims") if isinstance(entry, dict) else None
    are_texts = isinstance(dims, list) and all(isinstance(dim, str) for dim in dims)
    if isinstance(dims, list) and are_texts and len(set(dims)) == len(dims) <= _MAX_DIMS:
        return tuple(dims)
    problems.add(
        f"{name[:60]!r}",
        expected="an object with distinct dims, attributes and values",
        code="metadata-damaged",
    )
    return None


def typed_values(flat: list[Any], dtype: str) -> Array:
    """Return values from JSON as an array.

    Raises ValueError: A value is of another type, or out of range.
    """
    if dtype in ("str", "datetime64[ns]"):
        _check_types(flat, str)
        return text_column(flat) if dtype == "str" else _times(flat)
    if dtype == "bool":
        _check_types(flat, bool)
        return np.array(flat, np.bool_)
    if dtype.startswith("float"):
        _check_types([value for value in flat if value is not None], (int, float))
        numbers = np.array([np.nan if value is None else float(value) for value in flat], np.float64)
        with np.errstate(over="ignore"):
            values: Array = numbers.astype(dtype)
        if np.isinf(values).any():
            raise ValueError("a number is too large")
        return values
    _check_types(flat, int)
    limits = np.iinfo(dtype)
    if any(not limits.min <= value <= limits.max for value in flat):
        raise ValueError("a number is out of range")
    return np.array(flat, dtype)


def _check_types(values: list[Any], types: type | tuple[type, ...]) -> None:
    # bool is a subclass of int, and no number here
    if not all(isinstance(value, types) and isinstance(value, bool) == (types is bool) for value in values):
        raise ValueError(f"expected only {getattr(types, '__name__', 'number')} values")


def _times(flat: list[str]) -> Array:
    # Times from `metadata_text`; numpy wraps years outside the range of datetime64[ns] without an error
    for text in filter(None, flat):
        if _TIME.fullmatch(text) is None or not 1700 <= int(text[:4]) <= 2261:
            raise ValueError(
                f"{text[:40]!r}, expected a time such as 2024-05-21T11:33:07.000000000, in 1700 to 2261"
            )
    return np.array([np.datetime64(text or "NaT", "ns") for text in flat], "datetime64[ns]")
