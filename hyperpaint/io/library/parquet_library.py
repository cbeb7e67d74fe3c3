"""Paint libraries as Parquet in the columns of OpenSpecLib, a row per spectrum, for pandas and DuckDB.

Files of hyperpaint have the metadata of the library in ``<file>.json``, and the key of every spectrum (see
`records`) in ``additional_properties``. Other files need equal wavelengths in all rows.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from hyperpaint.base.arrays import Floats, Floats32
from hyperpaint.base.errors import FormatError, needs_extra
from hyperpaint.base.schema import BAND, SIGNATURE
from hyperpaint.io.files.publishing import published_files

from .library_spectra import Spectra, check_wavelengths, library_of, reflectances
from .metadata import metadata_path, metadata_text, paint_columns
from .records import CENTRE, Key, blocks_of, names_of, restored, spectral_variables

if TYPE_CHECKING:
    import pyarrow as pa
_MAGIC = b"PAR1"
_OURS = b"hyperpaint"
_MAX_ROWS, _MAX_VALUES = 2_000_000, 2**28
_NM_PER_UNIT = {"nm": 1.0, "um": 1e3}
_NM_OF_WAVENUMBER = 1e7  # over cm-1
_PURPOSE = "Parquet"

#: Columns of OpenSpecLib that hold text: those that must not be empty, and those that may.
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


def is_parquet(head: bytes) -> bool:
    """Return whether the first bytes of a file are those of Parquet."""
    return head[:4] == _MAGIC


# --- writing -----------------------------------------------------------------------------------------------


def write_parquet_library(
    library: xr.Dataset, path: Path, *, overwrite: bool, progress: Callable[[int, int], None] | None
) -> None:
    """Write a checked library to ``path``, and its metadata to ``<path>.json``.

    Raises MissingExtraError: pyarrow is not installed.
    Raises SchemaError: Names or metadata cannot be written.
    Raises StoreError: Files exist, or cannot be written.
    """
    with needs_extra("pyarrow", "library", _PURPOSE):
        import pyarrow as pa
        import pyarrow.parquet as pq
    variables = spectral_variables(library)
    metadata = metadata_text(library, variables)
    names = names_of(library)
    columns = paint_columns(library)
    schema = _schema().with_metadata({b"openspeclib_version": b"0", b"source": _OURS})
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
    with published_files([metadata_path(path), path], overwrite=overwrite) as (metadata_file, table):
        metadata_file.write_bytes(metadata.encode())
        with pq.ParquetWriter(table, schema, compression="zstd") as writer:
            for block in blocks_of(library, variables, progress):
                rows = []
                for paint, inner, values in zip(block.paint, block.inner, block.values, strict=True):
                    properties = {name: column[paint] for name, column in columns.items()}
                    key = (block.variable, int(paint), int(inner))
                    rows.append(_row(common, names[paint], properties, key, values))
                arrays = [pa.array([row.get(field.name) for row in rows], field.type) for field in schema]
                writer.write_batch(pa.RecordBatch.from_arrays(arrays, schema=schema))


def _schema() -> pa.Schema:
    import pyarrow as pa

    numbers = pa.list_(pa.float64())
    return pa.schema(
        [
            *(pa.field(name, pa.string(), nullable=False) for name in _TEXTS),
            *(pa.field(name, pa.string()) for name in _OPTIONAL_TEXTS),
            pa.field("material.keywords", pa.list_(pa.string()), nullable=False),
            pa.field("sample.collection_date", pa.date32()),
            pa.field("measurement.date", pa.date32()),
            pa.field("spectral_data.wavelength_min", pa.float64(), nullable=False),
            pa.field("spectral_data.wavelength_max", pa.float64(), nullable=False),
            pa.field("spectral_data.num_points", pa.int32(), nullable=False),
            pa.field("spectral_data.wavelengths", numbers, nullable=False),
            pa.field("spectral_data.values", numbers, nullable=False),
            pa.field("spectral_data.bandpass", numbers),
            pa.field("quality.has_bad_bands", pa.bool_(), nullable=False),
            pa.field("quality.bad_band_count", pa.int32(), nullable=False),
            pa.field("quality.coverage_fraction", pa.float64(), nullable=False),
        ]
    )


def _row(
    common: dict[str, Any], name: str, properties: dict[str, Any], key: Key, values: Floats32
) -> dict[str, Any]:
    # Cells of one spectrum; ``key``: its variable, paint, and index along the inner dim
    variable, paint, inner = key
    missing = int((~np.isfinite(values)).sum())
    identity = f"{paint}" if key[0] == CENTRE else f"{paint}/{variable}/{inner}"
    additional = {**properties, "variable": variable, SIGNATURE: paint, "place": inner}
    keywords = [
        str(properties[word]) for word in ("colour", "finish", "make", "model") if properties.get(word)
    ]
    return common | {
        "id": f"hyperpaint:{identity}",
        "name": name,
        "source.original_id": identity,
        "material.name": name,
        "material.keywords": keywords,
        "additional_properties": json.dumps(additional, allow_nan=False),
        "spectral_data.values": values.astype(np.float64),
        "quality.has_bad_bands": missing > 0,
        "quality.bad_band_count": missing,
        "quality.coverage_fraction": 1.0 - missing / max(values.size, 1),
    }


# --- reading -----------------------------------------------------------------------------------------------


def read_parquet_library(path: Path) -> xr.Dataset:
    """Read a library in the columns of OpenSpecLib, of hyperpaint or another program.

    Raises FormatError: It is damaged or too large, lacks columns, contains another quantity than reflectance,
        or has rows with different wavelengths.
    Raises MissingExtraError: pyarrow is not installed.
    """
    with needs_extra("pyarrow", "library", _PURPOSE):
        import pyarrow as pa
        import pyarrow.parquet as pq
    try:
        with pq.ParquetFile(os.fspath(path)) as file:
            rows = _rows(file, path.name)
            is_ours = (file.schema_arrow.metadata or {}).get(b"source") == _OURS
    except (pa.ArrowException, OSError) as error:
        raise FormatError(
            f"{path.name} cannot be read as Parquet: {error!s:.200}",
            mend="copy it again",
            code="file-unreadable",
        ) from error
    if is_ours and metadata_path(path).exists():
        return _restored(path, rows)
    return library_of(_spectra(path.name, rows))


_COLUMNS = (
    "name",
    "additional_properties",
    "spectral_data.type",
    "spectral_data.wavelength_unit",
    "spectral_data.wavelengths",
    "spectral_data.values",
    "source.license",
    "source.citation",
)


def _rows(file: Any, source: str) -> list[dict[str, Any]]:
    # Rows with the columns that are read; raise for files that would fill the memory
    missing = [name for name in _COLUMNS if name not in file.schema_arrow.names]
    if missing:
        raise FormatError(
            f"{source}: columns {', '.join(missing)} are missing",
            expected="the columns of OpenSpecLib",
            code="column-missing",
        )
    if not 0 < file.metadata.num_rows <= _MAX_ROWS:
        raise FormatError(
            f"{source}: {file.metadata.num_rows} rows", expected=f"1 to {_MAX_ROWS}", code="file-too-large"
        )
    rows: list[dict[str, Any]] = []
    count = 0
    for batch in file.iter_batches(batch_size=256, columns=list(_COLUMNS)):
        count += sum(len(column.flatten()) for column in batch.columns if hasattr(column, "flatten"))
        if count > _MAX_VALUES:
            raise FormatError(
                f"{source}: more than {_MAX_VALUES} values", mend="split the file", code="file-too-large"
            )
        columns = {name: batch.column(name) for name in _COLUMNS}
        for at in range(batch.num_rows):
            row: dict[str, Any] = {}
            for name, column in columns.items():
                if name not in ("spectral_data.wavelengths", "spectral_data.values"):
                    row[name] = column[at].as_py()
                elif (values := column[at].values) is None:
                    row[name] = np.empty(0)
                else:
                    row[name] = np.asarray(values.to_numpy(zero_copy_only=False), np.float64)
            rows.append(row)
    return rows


def _restored(path: Path, rows: list[dict[str, Any]]) -> xr.Dataset:
    keys: list[Key] = []
    for at, row in enumerate(rows):
        try:
            additional = json.loads(row["additional_properties"])
            key = (
                str(additional["variable"]),
                int(additional[SIGNATURE] if SIGNATURE in additional else additional["paint"]),
                int(additional["place"]),
            )
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise FormatError(
                f"{path.name}: row {at} has no variable, paint and index in additional_properties",
                mend="write the library again",
                code="record-unmatched",
            ) from error
        keys.append(key)
    names = [str(row["name"]) for row, key in zip(rows, keys, strict=True) if key[0] == CENTRE]
    if sorted({key[1] for key in keys}) != list(range(len(names))) or any(key[2] < -1 for key in keys):
        raise FormatError(
            f"{path.name}: rows of a paint are missing",
            mend="write the library again",
            code="record-unmatched",
        )
    wavelength, values = _stacked(path.name, rows)
    check_wavelengths(wavelength, path.name)
    return restored(path, names, keys, {"wavelength": wavelength}, [(0, values.astype(np.float32))], {})


def _stacked(source: str, rows: list[dict[str, Any]]) -> tuple[Floats, Floats]:
    # Common wavelengths (band,) and values (row, band) of all rows
    wavelength = rows[0]["spectral_data.wavelengths"]
    for at, row in enumerate(rows):
        if not np.array_equal(row["spectral_data.wavelengths"], wavelength):
            difference = (
                f"{row['spectral_data.wavelengths'].size} in row {at}, {wavelength.size} in the first row"
            )
            raise FormatError(
                f"{source}: rows have different wavelengths ({difference})",
                mend="select rows of one instrument",
                code="grid-mismatch",
            )
        if row["spectral_data.values"].shape != wavelength.shape:
            raise FormatError(
                f"{source}: row {at} has {row['spectral_data.values'].size} values",
                expected=f"{wavelength.size}, as many as wavelengths",
                code="length-mismatch",
            )
    return wavelength, np.stack([row["spectral_data.values"] for row in rows])


def _spectra(source: str, rows: list[dict[str, Any]]) -> Spectra:
    units = {str(row["spectral_data.wavelength_unit"]) for row in rows}
    kinds = {str(row["spectral_data.type"]) for row in rows}
    if kinds != {"reflectance"}:
        raise FormatError(
            f"{source}: rows of {', '.join(sorted(kinds))}",
            expected="reflectance",
            mend="select rows of reflectance",
            code="quantity-wrong",
        )
    if len(units) != 1 or not units <= {*_NM_PER_UNIT, "cm-1"}:
        raise FormatError(
            f"{source}: wavelengths are in {', '.join(sorted(units))}",
            expected="one of nm, um, cm-1",
            code="units-unknown",
        )
    axis, values = _stacked(source, rows)
    unit = units.pop()
    with np.errstate(divide="ignore"):
        wavelength = _NM_OF_WAVENUMBER / axis if unit == "cm-1" else axis * _NM_PER_UNIT[unit]
    columns = {"licence": [str(row["source.license"]) for row in rows]}
    return Spectra(
        source,
        "OpenSpecLib Parquet",
        [str(row["name"]) for row in rows],
        wavelength,
        reflectances(values, source, file_scale=None, scale=None),
        columns=columns,
    )
