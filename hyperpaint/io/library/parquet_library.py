"""Paint libraries as Parquet in the columns of OpenSpecLib, a row per spectrum, for pandas and DuckDB.

Files of hyperpaint have the metadata of the library in ``<file>.json``, and the key of every spectrum (see
`records`) in ``additional_properties``. Other files need equal wavelengths in all rows.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base.errors import FormatError, needs_extra
from hyperpaint.base.schema import BAND, SIGNATURE

from .library_spectra import Spectra, check_wavelengths, library_of, reflectances
from .records import CENTRE, Block, Key, metadata_path, paint_columns, restored

_MAGIC = b"PAR1"
_OURS = b"hyperpaint"
_MAX_ROWS, _MAX_VALUES = 2_000_000, 2**28
_NM_PER_UNIT = {"nm": 1.0, "um": 1e3}
_NM_OF_WAVENUMBER = 1e7  # over cm-1
_PURPOSE = "Parquet"

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


def is_parquet(head: bytes) -> bool:
    # Return whether the first bytes of a file are those of Parquet.
    return head[:4] == _MAGIC


# --- writing -----------------------------------------------------------------------------------------------


def write_parquet_library(
    library: xr.Dataset, names: Sequence[str], blocks: Iterable[Block], path: Path
) -> None:
    # Write the records of a checked library. Raises MissingExtraError: pyarrow is not installed.
    with needs_extra("pyarrow", "library", _PURPOSE):
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


# --- reading -----------------------------------------------------------------------------------------------


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
    with needs_extra("pyarrow", "library", _PURPOSE):
        import pyarrow as pa
        import pyarrow.parquet as pq
    source = path.name
    try:
        with pq.ParquetFile(os.fspath(path)) as file:
            columns = _columns(file, source)
            is_ours = (file.schema_arrow.metadata or {}).get(b"source") == _OURS
    except (pa.ArrowException, OSError) as error:
        raise FormatError(
            f"{source} cannot be read as Parquet: {error!s:.200}",
            mend="copy it again",
            code="file-unreadable",
        ) from error
    names = list(map(str, columns["name"]))
    is_restored = is_ours and metadata_path(path).exists()
    keys = _keys(columns["additional_properties"], source) if is_restored else []
    kinds = sorted({str(kind) for kind in columns["spectral_data.type"]})
    units = sorted({str(unit) for unit in columns["spectral_data.wavelength_unit"]})
    if not is_restored and kinds != ["reflectance"]:
        raise FormatError(
            f"{source}: rows of {', '.join(kinds)}",
            expected="reflectance",
            mend="select rows of reflectance",
            code="quantity-wrong",
        )
    if not is_restored and (len(units) != 1 or units[0] not in (*_NM_PER_UNIT, "cm-1")):
        raise FormatError(
            f"{source}: wavelengths are in {', '.join(units)}",
            expected="one of nm, um, cm-1",
            code="units-unknown",
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
        if spectrum.shape != axis.shape:
            raise FormatError(
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


def _columns(file: Any, source: str) -> dict[str, list[Any]]:
    # Columns that are read; raise for files that would fill the memory
    if missing := [name for name in _COLUMNS if name not in file.schema_arrow.names]:
        raise FormatError(
            f"{source}: columns {', '.join(missing)} are missing",
            expected="the columns of OpenSpecLib",
            code="column-missing",
        )
    if not 0 < file.metadata.num_rows <= _MAX_ROWS:
        raise FormatError(
            f"{source}: {file.metadata.num_rows} rows", expected=f"1 to {_MAX_ROWS}", code="file-too-large"
        )
    columns: dict[str, list[Any]] = {name: [] for name in _COLUMNS}
    count = 0
    for batch in file.iter_batches(batch_size=256, columns=list(_COLUMNS)):
        count += sum(len(column.flatten()) for column in batch.columns if hasattr(column, "flatten"))
        if count > _MAX_VALUES:
            raise FormatError(
                f"{source}: more than {_MAX_VALUES} values", mend="split the file", code="file-too-large"
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
    return columns


def _keys(properties: Sequence[Any], source: str) -> list[Key]:
    # Keys of the rows of a library of hyperpaint
    keys: list[Key] = []
    for at, text in enumerate(properties):
        try:
            cells = json.loads(text)
            paint = cells[SIGNATURE] if SIGNATURE in cells else cells["paint"]
            keys.append((str(cells["variable"]), int(paint), int(cells["place"])))
        except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
            raise FormatError(
                f"{source}: row {at} has no variable, paint and index in additional_properties",
                mend="write the library again",
                code="record-unmatched",
            ) from error
    paints = sum(key[0] == CENTRE for key in keys)
    if sorted({key[1] for key in keys}) != list(range(paints)) or any(
        not -1 <= key[2] < _MAX_ROWS for key in keys
    ):
        raise FormatError(
            f"{source}: rows of a paint are missing", mend="write the library again", code="record-unmatched"
        )
    return keys
