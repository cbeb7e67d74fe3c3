"""Spectra for renders from files: a spectrum of two columns, or a paint library of any format."""

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

_TABLE_SUFFIXES = (".csv", ".txt", ".tsv", ".asc", "")
MAX_EXPORT_BYTES = 64 << 20
_DIRSIG_MARKER, _MATERIALS = "paints.json", "materials.mat"


def read_spectra(path: Path) -> Any:
    """Return the spectra of a file of ``[spectra]``, in the form that `hyperpaint.simulation.relight` takes.

    A file of two columns gives (wavelength [nm], reflectance) in double precision; other files are libraries.
    Raises `FormatError` or `StoreError` as `read_paints`.
    """
    if input_path(path, "spectra").is_file() and path.suffix.lower() in _TABLE_SUFFIXES:
        try:
            return read_spectrum_csv(path)
        except FormatError as plain:
            try:
                return read_paints(path)
            except FormatError:
                raise plain from None
    return read_paints(path)


def read_paints(path: Path) -> dict[str, xr.Dataset] | xr.Dataset:
    """Return the paints of a file or folder: a library, or libraries of one paint by name.

    Accepted are all files that `hyperpaint.open_library` opens, and exports of `hyperpaint.write_dirsig`:
    their folder, their material list (``.mat``), or one of their ``.ems`` and ``.txt`` files.

    Raises
    ------
    FormatError
        The file has another format, or a file of the material list is missing.
    StoreError
        A Zarr store is unfinished or invalid.
    """
    from hyperpaint.io.library import open_library

    if path.suffix.lower() == ".mat":
        return _dirsig_paints(path)
    if path.is_dir() and (path / _DIRSIG_MARKER).is_file() and (path / _MATERIALS).is_file():
        return _dirsig_paints(path / _MATERIALS)
    return open_library(path)


def _dirsig_paints(path: Path) -> dict[str, xr.Dataset]:
    from hyperpaint.io.dirsig.dirsig_files import read_materials
    from hyperpaint.io.library import open_library

    records = _export_records(path.parent)
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
            if centre.is_file():  # an emissivity file of many curves lacks the centre of the paint
                paint = _with_centre(paint, open_library(centre))
            paints[str(record.get("paint", material.name))] = paint
    problems.raise_if_any()
    return paints


def _with_centre(paint: xr.Dataset, centre: xr.Dataset) -> xr.Dataset:
    # take the reflectance of another file, if it is on the same wavelengths
    nm, centre_nm = paint["wavelength"].values, centre["wavelength"].values
    if nm.shape != centre_nm.shape or not np.allclose(nm, centre_nm, rtol=0.0, atol=1e-3):
        return paint
    return paint.assign(reflectance=(paint["reflectance"].dims, centre["reflectance"].values, {"units": "1"}))


def _export_records(folder: Path) -> dict[str, dict[str, Any]]:
    # records of paints by material id; empty for material lists of other programs
    try:
        document = json.loads(read_limited(folder / _DIRSIG_MARKER, MAX_EXPORT_BYTES, "an export"))
        return {str(record["id"]): dict(record) for record in document["paints"]}
    except (FormatError, OSError, ValueError, TypeError, KeyError):
        return {}


def spectra_digest(spectra: Mapping[str, Any]) -> str:
    """Return a digest of all values of spectra, which shows whether a render was made from them."""
    digest = hashlib.sha256()
    for name, value in spectra.items():
        digest.update(f"{name} ".encode())
        if isinstance(value, Mapping) and not hasattr(value, "data_vars"):
            digest.update(spectra_digest(value).encode())
        elif hasattr(value, "data_vars"):
            stored_names = ("signature", "wavelength", "good", "reflectance", "member_reflectance")
            for variable in (variable for variable in stored_names if variable in value.variables):
                values = np.asarray(value[variable].values)
                digest.update(
                    str(values.tolist()).encode() if values.dtype.kind in "OUT" else values.tobytes()
                )
        else:
            for array in value:
                digest.update(np.asarray(array).tobytes())
    return digest.hexdigest()
