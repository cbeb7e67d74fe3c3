"""Spectra for renders out of files: one spectrum of two columns, or a paint library of any kind we write."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base.errors import FormatError, Problems
from hyperpaint.base.input_files import input_path, read_limited
from hyperpaint.io.spectrometers.spectrum_csv import read_spectrum_csv

_PLAIN = (".csv", ".txt", ".tsv", ".asc", "")
MAX_EXPORT_BYTES = 64 << 20
_DIRSIG_MARKER, _MATERIALS = "paints.json", "materials.mat"


def read_spectra(path: Path) -> Any:
    """Return the spectra of a file of ``[spectra]``, as `hyperpaint.simulation.relight` takes them.

    A file of two columns is (wavelength [nm], reflectance) in double precision; other files are libraries.
    Raises `FormatError` or `StoreError` as `read_paints`.
    """
    if input_path(path, "spectra").is_file() and path.suffix.lower() in _PLAIN:
        try:
            return read_spectrum_csv(path)
        except FormatError as plain:
            try:
                return read_paints(path)
            except FormatError:
                raise plain from None
    return read_paints(path)


def read_paints(path: Path) -> dict[str, xr.Dataset] | xr.Dataset:
    """Return the paints of a file or folder: one library, or libraries of one paint by name.

    Taken as they are: all that `hyperpaint.open_library` opens, so each format of `hyperpaint.write_library`;
    and exports of `hyperpaint.write_dirsig`, by their folder, their material list (``.mat``), or one of
    their ``.ems`` and ``.txt``.

    Raises
    ------
    FormatError
        It is none of these; the list names a file that is not there.
    StoreError
        A Zarr store was never finished, or is none.
    """
    from hyperpaint.io.library import open_library

    if path.suffix.lower() == ".mat":
        return _dirsig_paints(path)
    if path.is_dir() and (path / _DIRSIG_MARKER).is_file() and (path / _MATERIALS).is_file():
        return _dirsig_paints(path / _MATERIALS)
    return open_library(path)


def _dirsig_paints(path: Path) -> dict[str, xr.Dataset]:
    from hyperpaint.io.dirsig.material_list import read_materials
    from hyperpaint.io.library import open_library

    records = _records_of_export(path.parent)
    problems = Problems(f"{path} cannot be rendered", FormatError)
    paints: dict[str, xr.Dataset] = {}
    for material in read_materials(path):
        file = material.emissivity_file or material.reflectance_file
        if file is None:
            problems.add(
                f"material {material.name!r} without an emissivity or reflectance file",
                code="material-without-file",
            )
        elif not (path.parent / file).is_file():
            problems.add(
                f"material {material.name!r}: no file {file!r} beside the list", code="file-not-found"
            )
        else:
            paint, record = open_library(path.parent / file), records.get(str(material.id), {})
            centre = path.parent / str(record.get("reflectance_file", file))
            if centre.is_file():  # a list of curves has no centre of its own
                paint = _with_centre(paint, open_library(centre))
            paints[str(record.get("paint", material.name))] = paint
    problems.raise_if_any()
    return paints


def _with_centre(paint: xr.Dataset, centre: xr.Dataset) -> xr.Dataset:
    # reflectance of another file on the same wavelengths
    own, other = paint["wavelength"].values, centre["wavelength"].values
    if own.shape != other.shape or not np.allclose(own, other, rtol=0.0, atol=1e-3):
        return paint
    return paint.assign(reflectance=(paint["reflectance"].dims, centre["reflectance"].values, {"units": "1"}))


def _records_of_export(folder: Path) -> dict[str, dict[str, Any]]:
    # empty for material lists of other programs
    try:
        document = json.loads(read_limited(folder / _DIRSIG_MARKER, MAX_EXPORT_BYTES, "an export"))
        return {str(record["id"]): dict(record) for record in document["paints"]}
    except (FormatError, OSError, ValueError, TypeError, KeyError):
        return {}


def spectra_digest(spectra: Mapping[str, Any]) -> str:
    """Return a digest of all values of spectra, by which a render knows whether it was made from them."""
    digest = hashlib.sha256()
    for name, value in spectra.items():
        digest.update(f"{name} ".encode())
        if isinstance(value, Mapping) and not hasattr(value, "data_vars"):
            digest.update(spectra_digest(value).encode())
        elif hasattr(value, "data_vars"):
            names = ("signature", "wavelength", "good", "reflectance", "member_reflectance")
            for part in (part for part in names if part in value.variables):
                values = np.asarray(value[part].values)
                digest.update(
                    str(values.tolist()).encode() if values.dtype.kind in "OUT" else values.tobytes()
                )
        else:
            for part in value:
                digest.update(np.asarray(part).tobytes())
    return digest.hexdigest()
