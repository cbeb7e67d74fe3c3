"""`open_library`: spectral libraries of any format, as paint libraries."""

from __future__ import annotations

import itertools
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base.arrays import Array, Floats
from hyperpaint.base.errors import FormatError, Problems, StoreError
from hyperpaint.base.facts import is_number
from hyperpaint.base.input_files import head_of
from hyperpaint.base.old_names import with_new_names
from hyperpaint.base.schema import BAND, LIBRARY_VARIABLES, SIGNATURE
from hyperpaint.io.spectrometers.spectrum_files import find_paths
from hyperpaint.io.store import list_groups, open_store
from hyperpaint.io.store.reader import is_zarr

from .column_quantities import warn_of_light
from .csv_library import is_csv_library, read_csv_library
from .ecostress import is_ecostress, read_ecostress
from .envi_library import read_envi_library
from .library_spectra import OWN_AXES, library_of, text_column, with_numbers_as_data
from .parquet_library import is_parquet, read_parquet_library
from .plain_table import is_usgs, is_usgs_axis, read_plain_table, read_usgs, read_usgs_axis

Path_ = str | os.PathLike[str]

_HEAD_BYTES = 64 * 1024
_MAX_SHOWN = 20
_ENVI_SUFFIXES = (".hdr", ".sli")
_TEXT_SUFFIXES = (".txt", ".csv", ".tsv", ".asc")
_ANCILLARY = ".ancillary.txt"
_DIGITS = re.compile(r"(\d+)")


@dataclass(frozen=True, eq=False)
class _Options:
    # Axes, scale and quantity from the caller
    wavelength: Floats | None
    fwhm: Floats | None
    scale: float | None
    is_reflectance: bool  # whether the caller declares the values as reflectance

    def refuse_for(self, path: Path_) -> None:
        # Raise if there is an option, for a file that hyperpaint wrote with its axes and scale
        if self.wavelength is not None or self.fwhm is not None or self.scale is not None:
            raise FormatError(OWN_AXES.format(path), code="option-conflict")


def open_library(
    path: Path_ | Sequence[Path_],
    *,
    wavelength: Path_ | Any | None = None,
    fwhm: Path_ | Any | None = None,
    scale: float | None = None,
    quantity: str | None = None,
) -> xr.Dataset:
    r"""Open a spectral library as a paint library.

    Parameters
    ----------
    path
        A file, a folder, a pattern (``"svc/*.txt"``), or a list of files:

        * an ENVI spectral library (``.sli`` or its ``.hdr``), also those of the USGS, whose first records are
          wavelengths and bandwidths;
        * emissivity of DIRSIG (``.ems``), one opaque paint per file, its curves as members;
        * text of the ECOSTRESS library (version 1), the ASTER library (version 2) or the USGS library, or a
          table with wavelengths in its first column: several files with equal wavelengths become one
          library;
        * Parquet in the columns of OpenSpecLib (extra ``library``), with equal wavelengths in all rows;
        * files of `hyperpaint.write_library`, including CSV and Zarr; any Zarr (folder, zip file, URL or
          store object of zarr); a path inside a store names a group.
    wavelength, fwhm
        Axes of the bands [nm], or a file of the USGS library that holds them. They replace those of the file.
        By default they are read for USGS text from files beside it and in the two folders above.
    scale
        Stored value of a reflectance of one (100 for percent). By default from the file: its scale factor,
        units or headings. Without any of these, values that are not fractions are an error.
    quantity
        ``"reflectance"`` declares a text as reflectance whose headings or values look like another quantity,
        or whose third column without a heading looks like a standard deviation.

    Returns
    -------
    xarray.Dataset
        `reflectance` (signature, band) float32 [1], NaN for missing samples; coordinates `signature`,
        `wavelength` [nm] in the order of the file, which may be descending; `fwhm` [nm], `good`, and further
        columns of the file. Names are as in the file, duplicates included. Error bars of the USGS are
        `reflectance_u_random`. Attributes: `source`, `format`, and `notes` on inferred properties. A library
        of hyperpaint is returned as it was written; a Zarr store lazily.

    Raises
    ------
    FormatError
        A file is damaged, in another format, not reflectance by its headings or values, without wavelengths
        or of unknown scale; or several files have different wavelengths. All problems are listed.
    StoreError
        A Zarr store was never finished, or there is no store at the path.

    Warns
    -----
    PaintWarning
        The library is of hyperpaint 0.2 or before: its dimension `paint` is renamed `signature`. Names or
        metadata are missing, or an inferred property may make values wrong. Spectra have the oxygen band of
        sunlight, as radiance and irradiance do.

    Examples
    --------
    >>> import tempfile
    >>> scratch = tempfile.TemporaryDirectory()
    >>> file = Path(scratch.name) / "red.csv"
    >>> _ = file.write_text("wavelength (nm),reflectance (%)\n450,10\n650,50\n")
    >>> library = open_library(file)
    >>> library["signature"].item(), library["reflectance"].values.tolist()
    ('red', [[0.10000000149011612, 0.5]])
    >>> scratch.cleanup()
    """
    if scale is not None and not (is_number(scale) and scale > 0):
        raise FormatError(
            f"scale is {scale}",
            expected="the stored value of a reflectance of one, such as 100",
            code="value-out-of-range",
        )
    if quantity not in (None, "reflectance"):
        raise FormatError(
            f"quantity={quantity!r}",
            expected="'reflectance', as in every paint library",
            mend="leave quantity= out",
            code="choice-unknown",
        )
    options = _Options(_axis(wavelength, "wavelength"), _axis(fwhm, "fwhm"), scale, quantity is not None)
    if is_zarr(path):
        options.refuse_for(str(path))
        return _read_store(path)
    files = find_paths(
        path,
        lambda inside: _spectra_among([file for file in inside if file.suffix.lower() in _TEXT_SUFFIXES]),
        "text files of spectra, or the path of a library's file",
        lambda matches: _spectra_among([file for file in matches if file.suffix.lower() != ".json"]),
    )
    if len(files) == 1:
        return _opened(files[0], options)
    problems = Problems("the library cannot be opened", FormatError)
    opened = []
    for file in files:
        try:
            opened.append((file, _opened(file, options)))
        except (FormatError, StoreError) as error:
            problems.add_error("", error)
            if len(problems) == _MAX_SHOWN:
                break
    problems.raise_if_any()
    return _joined(opened)


def _axis(argument: Path_ | Any | None, name: str) -> Floats | None:
    # Wavelengths or bandwidths from numbers or a file
    if argument is None:
        return None
    if isinstance(argument, str | os.PathLike):
        return read_usgs_axis(Path(argument))[0]
    try:
        values = np.asarray(argument, np.float64)
    except (TypeError, ValueError):
        values = np.empty(0)
    if values.ndim != 1 or not values.size or not np.isfinite(values).all():
        raise FormatError(
            f"{name}= is {str(argument)[:60]!r}",
            expected="a finite number for every band [nm], or a file",
            code="value-out-of-range",
        )
    return values


# --- which files -------------------------------------------------------------------------------------------


def _spectra_among(paths: Sequence[Path]) -> list[Path]:
    # Files of spectra without companion files (ancillary texts of ECOSTRESS, wavelengths and bandwidths of
    # the USGS, tables of classes), sorted by name with numbers in numeric order
    candidates = []
    for path in paths:
        if not path.is_dir() and not path.name.startswith(".") and not path.name.endswith(_ANCILLARY):
            head = _head(path)
            is_table = head[:20].lower().startswith(("spectra names,", '"spectra names"'))
            if not is_table and not is_usgs_axis(head):
                candidates.append(path)
    # a data file of ENVI is dropped, since its header is in the list
    headers = {path.with_suffix("") for path in candidates if path.suffix.lower() == ".hdr"}
    candidates = [
        path
        for path in candidates
        if path.suffix.lower() in (".hdr", *_TEXT_SUFFIXES)
        or (path.with_suffix("") not in headers and path not in headers)
    ]

    def numeric_key(path: Path) -> tuple[list[tuple[int, str]], str]:
        # texts at even positions, numbers between them
        pieces = enumerate(_DIGITS.split(path.stem.lower()))
        return [(int(text[:18]), "") if at % 2 else (-1, text) for at, text in pieces], path.name

    return sorted(candidates, key=numeric_key)


def _head(path: Path) -> str:
    return head_of(path, _HEAD_BYTES).decode("latin-1").removeprefix("\xef\xbb\xbf")


# --- one file ----------------------------------------------------------------------------------------------


def _opened(path: Path, options: _Options) -> xr.Dataset:
    if not path.is_file():
        fault = "not a regular file" if os.path.lexists(path) else "no such file"
        raise FormatError(f"{path}: {fault}", expected="a spectral library", code="file-not-found")
    try:
        return _by_content(path, options)
    except OSError as error:
        if isinstance(error, StoreError):
            raise
        raise FormatError(
            f"{path}: cannot be read ({error.strerror or error})", code="file-unreadable"
        ) from error


def _by_content(path: Path, options: _Options) -> xr.Dataset:
    suffix, head = path.suffix.lower(), _head(path)
    if suffix == ".ems":
        from hyperpaint.io.dirsig import open_emissivity

        return open_emissivity(path)
    if is_parquet(head_of(path, 4)):
        options.refuse_for(path)
        return read_parquet_library(path)
    if suffix not in _ENVI_SUFFIXES and is_csv_library(head):
        options.refuse_for(path)
        return read_csv_library(path)
    library = _foreign(path, suffix, head, options)
    if not options.is_reflectance and "hyperpaint" not in str(library.attrs.get("format", "")):
        warn_of_light(library["wavelength"].values, library["reflectance"].values, path.name)
    return library


def _foreign(path: Path, suffix: str, head: str, options: _Options) -> xr.Dataset:
    # Open a library of another program, or one of hyperpaint in ENVI format
    nm, scale = options.wavelength, options.scale
    if suffix in _ENVI_SUFFIXES or (suffix not in _TEXT_SUFFIXES and path.with_suffix(".hdr").is_file()):
        return read_envi_library(path, scale=scale, wavelength=nm, fwhm=options.fwhm)
    if is_usgs(head):
        return library_of(read_usgs(path, scale=scale, wavelength=nm, fwhm=options.fwhm))
    if is_ecostress(head):
        spectra = read_ecostress(path, scale=scale, wavelength=nm)
    else:
        spectra = read_plain_table(path, scale=scale, wavelength=nm, is_reflectance=options.is_reflectance)
    return library_of(spectra if options.fwhm is None else replace(spectra, fwhm=options.fwhm))


_MAX_SHOWN_DIFFERENCES = 10
_BAND_COORDINATES = ("wavelength", "fwhm", "good")


def _joined(opened: Sequence[tuple[Path, xr.Dataset]]) -> xr.Dataset:
    # One library from several files, with the file of every paint in the coordinate `file`
    opened = [
        (
            path,
            library.set_coords([n for n, array in library.data_vars.items() if array.dims == (SIGNATURE,)]),
        )
        for path, library in opened
    ]
    libraries = [library for _, library in opened]
    first_path, first = opened[0]
    problems = Problems("the files cannot be joined to one library", FormatError)
    for path, library in opened:
        if not np.array_equal(library["wavelength"].values, first["wavelength"].values):
            problems.add(
                f"{path.name} has {_grid(library)}",
                expected=f"{_grid(first)} as in {first_path.name}",
                code="grid-mismatch",
            )
        if variables := sorted(
            str(name) for name, a in library.data_vars.items() if a.dims != (SIGNATURE, BAND)
        ):
            problems.add(
                f"{path.name} has {', '.join(variables)}",
                expected="one spectrum per paint",
                mend="open this file alone",
                code="library-not-plain",
            )
        if len(problems) >= _MAX_SHOWN_DIFFERENCES:
            break
    problems.raise_if_any()
    notes = list(dict.fromkeys(text for library in libraries if (text := library.attrs.get("notes"))))
    merged = xr.Dataset()
    for name in dict.fromkeys(name for library in libraries for name in library.data_vars):
        attrs = next(library[name].attrs for library in libraries if name in library)
        values = [
            library[name].values
            if name in library
            else np.full((library.sizes[SIGNATURE], library.sizes[BAND]), np.nan, np.float32)
            for library in libraries
        ]
        merged[name] = ((SIGNATURE, BAND), np.concatenate(values), attrs)
    for name in _BAND_COORDINATES:
        arrays = [library[name] for library in libraries if name in library.coords]
        if len(arrays) == len(libraries) and all(np.array_equal(a.values, arrays[0].values) for a in arrays):
            merged = merged.assign_coords({name: arrays[0]})
        elif arrays:
            notes.append(f"{name} differs from file to file and is left out")
    names = dict.fromkeys(
        name for lib in libraries for name, a in lib.coords.items() if a.dims == (SIGNATURE,)
    )
    merged = merged.assign_coords({name: _column(name, libraries) for name in names})
    files = text_column([path.name for path, library in opened for _ in range(library.sizes[SIGNATURE])])
    merged = merged.assign_coords(file=(SIGNATURE, files, {"long_name": "File"}))
    forms = dict.fromkeys(str(library.attrs.get("format", "")) for library in libraries)
    merged.attrs = {
        "title": "Spectral library",
        "source": f"{len(opened)} files, {first_path.name} to {opened[-1][0].name}",
        "format": ", ".join(filter(None, forms)),
    }
    if notes:
        merged.attrs["notes"] = "; ".join(notes[:_MAX_SHOWN_DIFFERENCES])
    return with_numbers_as_data(merged)


def _grid(library: xr.Dataset) -> str:
    nm = library["wavelength"].values
    return f"{nm.size} wavelengths from {nm[0]:g} to {nm[-1]:g} nm"


def _column(name: Any, libraries: Sequence[xr.Dataset]) -> tuple[str, Array, dict[str, Any]]:
    # A coordinate of the paints of all libraries, empty or NaN for libraries without it
    arrays = [library[name] for library in libraries if name in library.coords]
    kinds = {array.dtype.kind for array in arrays}
    attrs = arrays[0].attrs
    if len(kinds) == 1 and len(arrays) == len(libraries) and not kinds <= set("OUT"):
        return SIGNATURE, np.concatenate([array.values for array in arrays]), attrs
    absent: Any = np.nan if kinds <= set("biuf") else ""
    columns = (
        library[name].values if name in library.coords else [absent] * library.sizes[SIGNATURE]
        for library in libraries
    )
    values = list(itertools.chain.from_iterable(columns))
    if kinds <= set("biuf"):
        return SIGNATURE, np.array(values, np.float64), attrs
    return SIGNATURE, text_column(values if kinds <= set("OUT") else list(map(str, values))), attrs


# --- Zarr stores -------------------------------------------------------------------------------------------


def _read_store(path: Any) -> xr.Dataset:
    # Lazy library from the root group of a Zarr store
    groups = list_groups(path)
    if "" not in groups:
        addresses = ", ".join(f"{path}/{group}" for group in groups) or "none"
        raise FormatError(
            f"{path} holds no paint library at its root (groups: {addresses})", code="library-missing"
        )
    library = with_new_names(open_store(path, ""))
    rows = {name: LIBRARY_VARIABLES[name] for name in (SIGNATURE, "reflectance", "wavelength")}
    missing = [name for name in rows if name not in library.variables]
    dim_problems = [row.dim_problem(library[name]) for name, row in rows.items() if name not in missing]
    if missing or any(dim_problems):
        texts = [str(problem) for problem in dim_problems if problem]
        reasons = "; ".join([f"{name!r} is missing" for name in missing] + texts)
        raise FormatError(f"{path} holds no paint library: {reasons}", code="library-missing")
    return library
