"""Formats of spectral libraries: `open_library` by content, `write_library` by name or suffix.

Tables of spectra with properties of the samples: CSV of EcoSIS and R (a row a spectrum), and of SPECCHIO.

A table of EcoSIS has headings of properties, and a heading of each wavelength; one of SPECCHIO is its
transpose: a row for each property, then for each wavelength, and a column for each spectrum.
"""

import csv
import itertools
import os
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from hyperpaint.base import (
    BAND,
    BODY,
    EXCLUDED,
    FINISHES,
    INCLUDED,
    LIBRARY_VARIABLES,
    OUTSIDE,
    SIGNATURE,
    THROUGH_COAT,
    VERSION_NAME,
    Array,
    Bools,
    Floats,
    FormatError,
    Problem,
    Problems,
    Progress,
    SchemaError,
    StoreError,
    as_path,
    documented,
    head_of,
    is_number,
    listed,
    one_of,
    origin_of,
    takes_quantities,
    warn_user,
    with_band_dim,
    with_integer_dtypes,
    with_new_names,
)
from hyperpaint.io.files.publishing import published_files
from hyperpaint.io.files.reading import (
    MISSING_WORDS,
    cells_of,
    decoded_text,
    foreign_format,
    number,
    numbers,
    read_limited_text,
    refuse,
    unique_names,
)
from hyperpaint.io.spectrometers.spectrum_texts import (
    MEAN,
    NM_HEADING,
    RATIO,
    SPECTRUM_SUFFIXES,
    TIME_HEADING,
    find_paths,
    form_of,
    heading_cells,
    read_spectrum_text,
    statistics_among,
    warn_of,
)
from hyperpaint.io.store import (
    is_zarr,
    list_groups,
    open_store,
    to_store,
)

from .spectra_files import (
    CENTRE,
    MAX_BYTES,
    MIN_NM,
    OWN_AXES,
    PERCENT,
    TRANSFORMED,
    USGS_AXIS,
    USGS_RECORD,
    Spectra,
    blocks_of,
    checked_library,
    foreign_quantity,
    in_nanometres,
    is_csv_library,
    library_of,
    metadata_path,
    metadata_text,
    names_of,
    other_quantity,
    read_csv_library,
    read_ecostress,
    read_envi_library,
    read_parquet_library,
    read_plain_table,
    read_usgs,
    read_usgs_axis,
    reflectances,
    spectral_variables,
    text_column,
    warn_of_light,
    warn_of_scale,
    with_numbers_as_data,
    write_csv_library,
    write_envi_library,
    write_parquet_library,
)

_FIRST_KEYS = ("file name", "spectrum id", "spectrum number")
#: Properties that name a spectrum, by preference.
_NAMES = (
    "spectra", "spectrum", "spectrum name", "sample name", "sample", "sample id", "target name", "file name",
    "name", "id", "spectra id", "title",
)  # fmt: skip
_WAVELENGTH_UNITS = re.compile(r"wave ?lengths? ?units?|x ?units?", re.IGNORECASE)
_VALUE_UNITS = re.compile(r"(?:measurement|reflectance|spectra\w*|values?|data|y)?[ _]?units?", re.IGNORECASE)
_QUANTITY = re.compile(r"(?:measurement )?(?:quantity|type)|measurement", re.IGNORECASE)
_PROCESSING = re.compile(r"(?:data[ _])?process\w*|transform\w*", re.IGNORECASE)
_MISSING = {*MISSING_WORDS, "-"}
#: Headings of bands as other programs write them: ``0.35 um``, ``wl_350``, ``R350``, ``Reflectance_350``.
_BAND_HEADING = re.compile(
    r"(?:x|wl|wvl|wavelength|nm|r|refl(?:ectance)?)?[ _.]?(\d{1,5}(?:[.,]\d{1,6})?)"
    r"\s*(?:[(\[]?(?:nm|[uµμ]m)[)\]]?)?",
    re.IGNORECASE,
)
_MIN_BANDS, _MAX_CELLS, _MAX_UM = 3, 4_000_000, 100.0
_MAX_SHOWN_ROWS = 5


def _bands(lines: Sequence[str]) -> Bools | None:
    # Return which columns of a row a spectrum are wavelengths by their headings; None for other tables.
    cells, following = _cells(lines[0]), _cells(lines[1]) if len(lines) > 1 else [""]
    nm = np.array([_nm(cell, NM_HEADING) for cell in cells])
    if is_worded := int(np.isfinite(nm).sum()) < _MIN_BANDS:
        nm = np.array([_nm(cell) for cell in cells])
    is_band = np.isfinite(nm)
    steps = np.diff(nm[is_band])
    is_number = [number(cell.replace(",", ".") or "-") is not None for cell in following]
    # a spectrum with a name; numbers alone may be columns of spectra whose names resemble wavelengths
    has_name = not all(numeric for numeric, band in zip(is_number, is_band, strict=False) if not band)
    if (
        steps.size < _MIN_BANDS - 1
        or not ((steps > 0).all() or (steps < 0).all())
        or ((is_worded or is_band[0]) and not has_name)
    ):
        return None
    # names of spectra may be numbers too, above a first column of wavelengths
    is_plain = is_band[1:].all() and cells[0] != "" and is_number[0]
    low, high = nm[is_band].min(), nm[is_band].max()
    in_um = any(map(_WAVELENGTH_UNITS.fullmatch, cells)) or (
        has_name and low >= MIN_NM / 1e3 and high < _MAX_UM and (nm[is_band] % 1.0).any()
    )
    return is_band if not is_plain and (low >= MIN_NM or in_um) else None


def _nm(text: str, pattern: re.Pattern[str] = _BAND_HEADING) -> float:
    # Return the wavelength of a heading [nm, or um without a unit]; NaN for other headings.
    match = pattern.fullmatch(text.strip())
    factor = 1e3 if text.rstrip(")] ").lower().endswith(("um", "µm", "μm")) else 1.0
    return np.nan if match is None else float(match[1].replace(",", ".")) * factor


def _cells(line: str) -> list[str]:
    # Return the cells of one line.
    return [cell.strip() for cell in cells_of(line, heading_cells(line)[0])] or [""]


def read_sample_table(
    path: Path, *, scale: float | None, wavelength: Floats | None, is_reflectance: bool
) -> Spectra:
    # Read a table of EcoSIS or SPECCHIO; its properties become columns of the library.
    # scale: Stored value of a reflectance of one; by default 100 where units of the table say percent.
    # is_reflectance: Whether values are reflectance, whatever names and values look like.
    # Raises FormatError: Rows have other lengths or cells; the table names another quantity, or is a series
    # of times; all rows are named.
    source = path.name
    text = decoded_text(read_limited_text(path, MAX_BYTES, "a table of spectra"))
    lines = [
        (n, line) for n, line in enumerate(text.splitlines(), 1) if line.strip(' \t,;"') and line[0] != "#"
    ]
    separator = heading_cells(lines[0][1])[0]
    with FormatError.instead_of(csv.Error, f"{source}: no table ($whole)", code="row-unreadable"):
        rows = list(csv.reader([line for _, line in lines], delimiter=separator))
    is_band = _bands([line for _, line in lines])
    if is_transposed := is_band is None:
        # A table of SPECCHIO becomes one of a row a spectrum. Its texts may contain commas,
        # so that a row of a property may have more cells than there are spectra.
        band_rows = sorted(
            ((band_nm, row) for row in rows if row and np.isfinite(band_nm := _nm(row[0], NM_HEADING))),
            key=lambda b: b[0],
        )
        fields = [row for row in rows if row and row[0].strip() and np.isnan(_nm(row[0], NM_HEADING))]
        count = len(band_rows[0][1]) - 1 if band_rows else 0
        refuse(
            source,
            (
                len(band_rows) < _MIN_BANDS
                or count < 1
                or any(len(row) != count + 1 for _, row in band_rows),
                Problem(
                    f"{len(band_rows)} rows of wavelengths, not all with {count} values",
                    expected="a value for each spectrum",
                    code="row-unreadable",
                ),
            ),
        )
        fields = [
            [
                row[0],
                *(row[1:] if len(row) == count + 1 else [", ".join(row[1:])] if count == 1 else [""] * count),
            ]
            for row in fields
        ]
        rows = [list(column) for column in zip(*fields, *(row for _, row in band_rows), strict=True)]
        is_band = np.isfinite([_nm(heading, NM_HEADING) for heading in rows[0]])
    assert is_band is not None
    bands, others = np.flatnonzero(is_band).tolist(), np.flatnonzero(~is_band).tolist()
    headings, *records = ([cell.strip() for cell in row] for row in rows)
    refuse(
        source,
        (
            TIME_HEADING.fullmatch(headings[0]) is not None and len(others) <= 2,
            Problem(
                "a series of spectra in time", mend="open it with hp.open_irradiance", code="quantity-wrong"
            ),
        ),
        (not records, Problem("no spectra below the headings", code="table-missing")),
        (
            len(records) * len(headings) > _MAX_CELLS,
            Problem(f"{len(records)} spectra", expected="a smaller table", code="file-too-large"),
        ),
    )
    with Problems(f"{source} cannot be read", FormatError) as problems:
        values = np.full((len(records), len(bands)), np.nan)
        for at, record in enumerate(records):
            is_whole = len(record) == len(headings)
            cells = [record[band] for band in bands] if is_whole else []
            row = numbers("" if cell.lower() in _MISSING else cell.replace(",", ".") for cell in cells)
            if row and is_whole:
                values[at] = row
            elif len(problems) < _MAX_SHOWN_ROWS:
                place = f"spectrum {at + 1}" if is_transposed else f"line {lines[at + 1][0]}"
                problems.add(
                    f"{place}: {separator.join(record)[:60]!r}",
                    expected=f"{len(others)} properties and {len(bands)} numbers",
                    code="row-unreadable",
                )
    properties = {headings[at]: [record[at] for record in records] for at in others}
    units = _shared_words(properties, _WAVELENGTH_UNITS)
    quantity, value_units = _shared_words(properties, _QUANTITY), _shared_words(properties, _VALUE_UNITS)
    names = _names(properties, path, len(records))
    statistics = statistics_among(names) if any(map(MEAN.search, names)) else []
    warn_of(
        f"rows {', '.join(map(repr, statistics))} are statistics, not spectra, and are left out",
        [source] if statistics else [],
        "columns-left-out",
    )
    is_kept = [name not in statistics for name in names]
    names, values = list(itertools.compress(names, is_kept)), values[is_kept]
    properties = {key: list(itertools.compress(cells, is_kept)) for key, cells in properties.items()}
    processing = _shared_words(properties, _PROCESSING)  # may also name what reflectance was made of
    texts = [*filter(foreign_quantity, (quantity, value_units)), *filter(TRANSFORMED.search, [processing])]
    other = next(iter([*texts, *filter(other_quantity, names)]), "")
    FormatError.raise_if(
        other and not is_reflectance,
        f"{source}: spectra are {other[:60]!r}",
        expected="reflectance",
        mend="remove them, or pass quantity='reflectance'",
        code="quantity-wrong",
    )
    is_percent = PERCENT.search(value_units) is not None
    # such tables exist in EcoSIS: fractions under a column of units that says percent
    FormatError.raise_if(
        is_percent and scale is None and np.nanmax(values, initial=0.0) <= 1.0,
        f"{source}: units are {value_units[:60]!r}, but values are up to {np.nanmax(values, initial=0.0):g}",
        expected="percent",
        mend="pass scale=1 for fractions, scale=100 for percent",
        code="scale-conflict",
    )
    axis = np.array([_nm(heading) for heading in (headings[band] for band in bands)], np.float64)
    nm, note = in_nanometres(units, axis, source)
    return Spectra(
        source=source,
        form="SPECCHIO table" if is_transposed else "table of one row a spectrum",
        names=names,
        wavelength=nm if wavelength is None else wavelength,
        reflectance=reflectances(
            values,
            source,
            file_scale=100.0 if is_percent else None,
            scale=scale,
            is_reflectance=is_reflectance,
        ),
        columns=_columns(properties),
        notes=[note] if note else [],
    )


def _shared_words(properties: dict[str, list[str]], pattern: re.Pattern[str]) -> str:
    # Return the words of a property that all spectra share.
    found = [texts for heading, texts in properties.items() if pattern.fullmatch(heading)]
    return " ".join(dict.fromkeys(text for texts in found for text in texts))[:200]


def _names(properties: dict[str, list[str]], path: Path, count: int) -> list[str]:
    # Return the names of the spectra: of a property that names them, or else of the file.
    by_key = {re.sub(r"[_ ]+", " ", heading.lower()): texts for heading, texts in properties.items()}
    candidates = [
        *(by_key[key] for key in _NAMES if key in by_key),
        *(texts for texts in properties.values() if any(number(cell) is None for cell in texts)),
    ]
    distinct = [texts for texts in candidates if all(texts) and len(set(texts)) == count]
    if distinct:
        return distinct[0]
    return [path.stem] if count == 1 else [f"{path.stem} {place}" for place in range(1, count + 1)]


def _columns(properties: dict[str, list[str]]) -> dict[str, Any]:
    # Return properties under names of variables: numbers where all cells are numbers, else texts.
    columns: dict[str, Any] = {}
    for heading, texts in properties.items():
        key = re.sub(r"\W+", "_", heading.lower()).strip("_")[:60]
        if not key or not key.isidentifier():
            continue
        if key in (SIGNATURE, BAND) or LIBRARY_VARIABLES.get(key) is not None or key in columns:
            key = f"{key}_given"
        values = numbers("" if text.lower() in _MISSING else text for text in texts)
        is_number = values is not None and any(texts)
        columns[key] = np.array(values, np.float64) if is_number else text_column(texts)
    return columns


# --- tables of samples -------------------------------------------------------------------------------------

Path_ = str | os.PathLike[str]

_HEAD_BYTES = 64 * 1024
_MAX_SHOWN, _MAX_SHOWN_DIFFERENCES = 20, 10
_ENVI_SUFFIXES = (".hdr", ".sli")
_ANCILLARY = ".ancillary.txt"
_DIGITS = re.compile(r"(\d+)")
_BAND_COORDINATES = ("wavelength", "fwhm", "good")


class _Options(NamedTuple):
    # Axes, scale and quantity from the caller
    wavelength: Floats | None
    fwhm: Floats | None
    scale: float | None
    is_reflectance: bool  # whether the caller declares the values as reflectance

    def refuse_for(self, path: Path_) -> None:
        # Raise if there is an option, for a file that hyperpaint wrote with its axes and scale
        FormatError.raise_if(
            any(option is not None for option in self[:3]), OWN_AXES.format(path), code="option-conflict"
        )


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
        * CSV of EcoSIS (a row a spectrum, below headings such as ``350``, ``0.35 um``, ``wl_350`` or
          ``R350``) or SPECCHIO, with the properties of the samples as columns; text of
          a field spectrometer (Spectral Evolution, Ocean Optics, Avantes) with reflectance;
        * Parquet in the columns of OpenSpecLib (extra ``library``), with equal wavelengths in all rows;
        * files of `hyperpaint.write_library`, including CSV and Zarr; any Zarr (folder, zip file, URL or
          store object of zarr); a path inside a store names a group.
    wavelength, fwhm
        Axes of the bands [nm], or a file of the USGS library with them, in place of the axes in ``path``. By
        default they are read for USGS text from files beside it and in the two folders above.
    scale
        Stored value of a reflectance of one (100 for percent). By default from the file: its scale factor,
        units or headings. Without any of these, values that are not fractions are an error.
    quantity
        ``"reflectance"`` declares a text as reflectance whose headings or values look like another quantity,
        or whose third column without a heading looks like a standard deviation. Columns of statistics,
        such as ``red_err`` beside ``red``, are left out.

    Returns
    -------
    xarray.Dataset
        `reflectance` (signature, band) float32 [1], NaN for missing samples; coordinates `signature`,
        `wavelength` [nm] in the order of the file, which may be descending; `fwhm` [nm], `good`, and further
        columns of the file. Names are as in the file; repeated names are numbered. Error bars of the USGS are
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
        metadata are missing, names repeated or wavelengths out of order, or an inferred property may make
        values wrong. Spectra have the oxygen band of sunlight, as radiance and irradiance do. Rows of
        standard deviations, or columns of statistics, are left out.

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
    FormatError.raise_if(
        scale is not None and not (is_number(scale) and scale > 0),
        f"scale is {scale}",
        expected="the stored value of a reflectance of one, such as 100",
        code="value-out-of-range",
    )
    FormatError.raise_if(
        quantity not in (None, "reflectance"),
        f"quantity={quantity!r}",
        expected="'reflectance', as in every paint library",
        mend="leave quantity= out",
        code="choice-unknown",
    )
    axes: dict[str, Floats | None] = {}
    for name, argument in (("wavelength", wavelength), ("fwhm", fwhm)):
        if argument is None or isinstance(argument, str | os.PathLike):
            axes[name] = None if argument is None else read_usgs_axis(Path(argument))[0]
            continue
        try:
            values = np.asarray(argument, np.float64)
        except (TypeError, ValueError):
            values = np.empty(0)
        FormatError.raise_if(
            values.ndim != 1 or not values.size or not np.isfinite(values).all(),
            f"{name}= is {str(argument)[:60]!r}",
            expected="a finite number for every band [nm], or a file",
            code="value-out-of-range",
        )
        axes[name] = values
    options = _Options(**axes, scale=scale, is_reflectance=quantity is not None)
    if is_zarr(path):
        options.refuse_for(str(path))
        # Lazy library from the root group of a Zarr store
        groups = list_groups(path)
        addresses = ", ".join(f"{path}/{group}" for group in groups) or "none"
        FormatError.raise_if(
            "" not in groups,
            f"{path} holds no paint library at its root (groups: {addresses})",
            mend="extract one with hyperpaint signatures; hyperpaint.io.write_envi writes cubes",
            code="library-missing",
        )
        library = with_new_names(open_store(path, ""))
        rows = [row for row in _structure(library) if row[0] and row[1] == "structure"]
        reasons = "; ".join(f"{found}, expected {expected}" for _, _, found, expected in rows)
        FormatError.raise_if(rows, f"{path} holds no paint library: {reasons}", code="library-missing")
        return _with_distinct_names(library, str(path))
    files = find_paths(
        path,
        lambda inside: _spectra_among([file for file in inside if file.suffix.lower() in SPECTRUM_SUFFIXES]),
        "text files of spectra, or the path of a library's file (hp.open_asd opens .asd, hp.open_svc .sig)",
        lambda matches: _spectra_among([file for file in matches if file.suffix.lower() != ".json"]),
    )
    if len(files) == 1:
        return _with_distinct_names(_opened(files[0], options), files[0].name)
    with Problems("the library cannot be opened", FormatError) as problems:
        opened = []
        for file in files:
            try:
                opened.append((file, _opened(file, options)))
            except (FormatError, StoreError) as error:
                problems.add_error("", error)
                if len(problems) == _MAX_SHOWN:
                    break
    return _with_distinct_names(_joined(opened), f"{len(files)} files")


def _with_distinct_names(library: xr.Dataset, source: str) -> xr.Dataset:
    # The library with numbers after repeated names: results by name would show one of the paints
    names = list(map(str, library[SIGNATURE].values))
    distinct = unique_names(names)
    if distinct == names:
        return library
    changed = [new for old, new in zip(names, distinct, strict=True) if new != old]
    warn_user(
        f"{source}: names of paints occur more than once and are numbered: {', '.join(changed[:5])}",
        "paint-duplicate",
    )
    return library.assign_coords({SIGNATURE: (SIGNATURE, text_column(distinct), library[SIGNATURE].attrs)})


# --- which files -------------------------------------------------------------------------------------------


def _spectra_among(paths: Sequence[Path]) -> list[Path]:
    # Files of spectra without companion files (ancillary texts of ECOSTRESS, wavelengths and bandwidths of
    # the USGS, tables of classes), sorted by name with numbers in numeric order
    candidates = []
    for path in paths:
        if not path.is_dir() and not path.name.startswith(".") and not path.name.endswith(_ANCILLARY):
            head = _head(path)
            is_table = head[:20].lower().startswith(("spectra names,", '"spectra names"'))
            if not is_table and not USGS_AXIS.match(head.partition("\n")[0]):
                candidates.append(path)
    # a data file of ENVI is dropped, since its header is in the list
    headers = {path.with_suffix("") for path in candidates if path.suffix.lower() == ".hdr"}
    candidates = [
        path
        for path in candidates
        if path.suffix.lower() in (".hdr", *SPECTRUM_SUFFIXES)
        or (path.with_suffix("") not in headers and path not in headers)
    ]

    def numeric_key(path: Path) -> tuple[list[tuple[int, str]], str]:
        # texts at even positions, numbers between them
        pieces = enumerate(_DIGITS.split(path.stem.lower()))
        return [(int(text[:18]), "") if at % 2 else (-1, text) for at, text in pieces], path.name

    return sorted(candidates, key=numeric_key)


def _head(path: Path) -> str:
    return decoded_text(head_of(path, _HEAD_BYTES))


# --- one file ----------------------------------------------------------------------------------------------


def _opened(path: Path, options: _Options) -> xr.Dataset:
    FormatError.raise_if(
        not path.is_file(),
        f"{origin_of(path)}: {'not a regular file' if os.path.lexists(path) else 'no such file'}",
        expected="a spectral library",
        code="file-not-found",
    )
    suffix = path.suffix.lower()
    nm, fwhm, scale, is_reflectance = options
    try:
        head = _head(path)
        if suffix == ".ems":
            from hyperpaint.io.dirsig import open_emissivity

            return open_emissivity(path)
        # formats of hyperpaint
        is_csv = suffix not in _ENVI_SUFFIXES and is_csv_library(head, path)
        is_plain_csv = is_csv and not metadata_path(path).exists()
        if is_csv or head.startswith("PAR1"):
            (options._replace(scale=None) if is_plain_csv else options).refuse_for(path)
            if not is_plain_csv:
                return (read_csv_library if is_csv else read_parquet_library)(path)
        # formats of other programs, and ENVI of hyperpaint
        is_envi = suffix in _ENVI_SUFFIXES or (
            suffix not in SPECTRUM_SUFFIXES and path.with_suffix(".hdr").is_file()
        )
        refuse(path.name, (True, None if is_envi else foreign_format(path)))
        if is_plain_csv:
            library = read_csv_library(path, scale=scale, is_reflectance=is_reflectance)
        elif is_envi:
            library = read_envi_library(path, scale=scale, wavelength=nm, fwhm=fwhm)
        elif USGS_RECORD.match(head.partition("\n")[0]):
            library = library_of(read_usgs(path, scale=scale, wavelength=nm, fwhm=fwhm))
        else:
            # a text may begin as a table of EcoSIS or SPECCHIO
            rows = [row for row in head.splitlines() if row.strip() and not row.startswith("#")]
            is_sample_table = rows and (_cells(rows[0])[0].lower() in _FIRST_KEYS or _bands(rows) is not None)
            if re.match(r"\s*Name\s*:", head) and "Number of X Values" in head:
                spectra = read_ecostress(path, scale=scale, wavelength=nm)
            elif form_of("\n".join(head.splitlines())) is not None:
                # A column that the file does not name is reflectance only where the caller says so, or gives
                # its scale.
                text = read_spectrum_text(path)
                column = text.column("reflectance")
                is_declared = options.is_reflectance or options.scale is not None
                is_named = column.heading == RATIO or any(c.quantity == "reflectance" for c in text.columns)
                FormatError.raise_if(
                    not (is_named or is_declared),
                    f"{path.name}: {text.instrument} text that does not say what its spectrum is",
                    expected="reflectance",
                    mend="pass quantity='reflectance', with scale=100 for percent; hp.open_irradiance opens "
                    "irradiance",
                    code="quantity-ambiguous",
                )
                values = reflectances(
                    column.values[None, :],
                    path.name,
                    file_scale={"%": 100.0, "1": 1.0, "1.0": 1.0}.get(column.units),
                    scale=options.scale,
                    is_reflectance=options.is_reflectance,
                )
                spectra = Spectra(
                    source=path.name,
                    form=f"{text.instrument} text",
                    names=[path.stem],
                    wavelength=text.wavelength if options.wavelength is None else options.wavelength,
                    reflectance=values,
                )
            else:
                read = read_sample_table if is_sample_table else read_plain_table
                spectra = read(path, scale=scale, wavelength=nm, is_reflectance=is_reflectance)
            library = library_of(spectra if fwhm is None else replace(spectra, fwhm=fwhm))
    except StoreError:
        raise
    except OSError as error:
        raise FormatError(
            f"{path}: cannot be read ({error.strerror or error})", code="file-unreadable"
        ) from error
    if not is_reflectance and "hyperpaint" not in str(library.attrs.get("format", "")):
        warn_of_light(library["wavelength"].values, library["reflectance"].values, path.name)
    nm = library["wavelength"].values
    steps = np.diff(nm)
    direction = 1 if 2 * (steps > 0).sum() >= steps.size else -1
    # where detectors overlap, the wavelengths turn back, but never before the start of the last detector
    starts = nm[np.append(0, np.flatnonzero(direction * steps < 0) + 1)]
    if (direction * np.diff(starts) < 0).any():
        warn_user(f"{path.name}: the wavelengths are out of order; they are sorted", "wavelength-unordered")
        library = library.isel({BAND: np.argsort(direction * nm, kind="stable")})
    return library


def _joined(opened: Sequence[tuple[Path, xr.Dataset]]) -> xr.Dataset:
    # One library from several files, with the file of every paint in the coordinate `file`
    libraries = [library for _, library in opened]
    first_path, first = opened[0]

    def grid(library: xr.Dataset) -> str:
        nm = library["wavelength"].values
        return f"{nm.size} wavelengths from {nm[0]:g} to {nm[-1]:g} nm"

    with Problems("the files cannot be joined to one library", FormatError) as problems:
        for path, library in opened:
            problems.add_if(
                not np.array_equal(library["wavelength"].values, first["wavelength"].values),
                f"{path.name} has {grid(library)}",
                expected=f"{grid(first)} as in {first_path.name}",
                code="grid-mismatch",
            )
            plain_dims = ((SIGNATURE, BAND), (SIGNATURE,))
            problems.add_if(
                variables := sorted(str(n) for n, a in library.data_vars.items() if a.dims not in plain_dims),
                f"{path.name} has {', '.join(variables)}",
                expected="one spectrum per paint",
                mend="open this file alone",
                code="library-not-plain",
            )
            if len(problems) >= _MAX_SHOWN_DIFFERENCES:
                break
    notes = list(dict.fromkeys(text for library in libraries if (text := library.attrs.get("notes"))))
    variables_by_name: dict[Any, xr.Variable] = {}
    for name in dict.fromkeys(name for library in libraries for name in library.variables):
        arrays = [library.variables.get(name) for library in libraries]
        present = [array for array in arrays if array is not None]
        is_whole, kinds = len(present) == len(arrays), {array.dtype.kind for array in present}
        dims, attrs = present[0].dims, present[0].attrs
        if SIGNATURE in dims:
            # where a library lacks a variable its numbers are NaN, its texts empty; other kinds become texts
            is_number = kinds <= set("biuf")
            is_native = is_number or (is_whole and kinds == {"M"})
            fill: Any = np.nan if is_number else ""
            dtype = object if not is_number else np.float32 if BAND in dims else np.float64
            shapes = [(library.sizes[SIGNATURE], *present[0].shape[1:]) for library in libraries]
            values: Array = np.concatenate(
                [
                    np.full(shape, fill, dtype)
                    if array is None
                    else (array.values if is_native else text_column(list(map(str, array.values))))
                    for array, shape in zip(arrays, shapes, strict=True)
                ]
            )
            if is_number and BAND not in dims and not (is_whole and len(kinds) == 1):
                values = values.astype(np.float64)
            variables_by_name[name] = xr.Variable(dims, values, attrs)
        elif name in _BAND_COORDINATES:
            if is_whole and all(np.array_equal(array.values, present[0].values) for array in present):
                variables_by_name[name] = present[0]
            else:
                notes.append(f"{name} differs from file to file and is left out")
    variables_by_name["file"] = xr.Variable(
        SIGNATURE,
        text_column([path.name for path, library in opened for _ in range(library.sizes[SIGNATURE])]),
        {"long_name": "File"},
    )
    forms = dict.fromkeys(str(library.attrs.get("format", "")) for library in libraries)
    attrs = {
        "title": "Spectral library",
        "source": f"{len(opened)} files, {first_path.name} to {opened[-1][0].name}",
        "format": ", ".join(filter(None, forms)),
    }
    if notes:
        attrs["notes"] = "; ".join(notes[:_MAX_SHOWN_DIFFERENCES])
    merged = xr.Dataset(variables_by_name, attrs=attrs)
    return with_numbers_as_data(
        merged.set_coords([name for name, array in merged.variables.items() if array.ndim == 1])
    )


# --- writing -----------------------------------------------------------------------------------------------


_WRITERS: dict[str, Callable[..., Any]] = {
    "envi": write_envi_library,
    "csv": write_csv_library,
    "parquet": write_parquet_library,
    "zarr": to_store,
}
_FORMAT_OF_SUFFIX = {".sli": "envi", ".hdr": "envi", ".csv": "csv", ".zarr": "zarr", ".parquet": "parquet"}


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
    >>> open_library(path)["signature"].values.tolist()
    ['red, matt', 'blue']
    >>> scratch.cleanup()
    """
    path = as_path(path)
    suffix = path.suffix.lower()
    chosen = _FORMAT_OF_SUFFIX.get(suffix, "") if format is None else format
    FormatError.raise_if(
        chosen not in _WRITERS,
        f"format {format!r}" if format is not None else f"no format of the suffix {path.suffix!r}",
        expected=f"format= one of {', '.join(_WRITERS)}, or suffix .sli, .csv, .parquet, .zarr",
        code="choice-unknown",
    )
    SchemaError.raise_if(
        curves not in (None, "centre", "all"),
        f"curves={curves!r}",
        expected=f"centre or all for {chosen}",
        code="choice-unknown",
    )
    # a suffix that `open_library` recognises
    if chosen == "envi":
        path = path.with_suffix(".sli") if suffix in _ENVI_SUFFIXES else path.with_name(f"{path.name}.sli")
    elif chosen == "csv" and not suffix and not path.is_dir():
        path = path.with_suffix(".csv")
    library = checked_library(with_integer_dtypes(library, LIBRARY_VARIABLES))
    library = _with_distinct_names(library, str(path))
    if library[CENTRE].chunks is None:
        warn_of_scale(library[CENTRE].transpose(SIGNATURE, BAND).values, "the reflectance of the library")
    if curves == "centre" or (curves is None and chosen != "zarr"):
        others = [name for name in spectral_variables(library) if name != CENTRE]
        library = library.drop_vars(others).drop_dims(
            {dim for name in others for dim in library[name].dims} - {SIGNATURE, BAND}, errors="ignore"
        )
    if chosen == "zarr":
        report, paints = progress or (lambda *_: None), library.sizes[SIGNATURE]
        report(0, paints)
        to_store(library, path, overwrite=overwrite)
        report(paints, paints)
        return path
    variables = spectral_variables(library)
    names, metadata = names_of(library), metadata_text(library, variables)
    # the header of ENVI, by which the library is found, appears last
    files = [metadata_path(path), path, *([path.with_suffix(".hdr")] if chosen == "envi" else [])]
    with published_files(files, overwrite=overwrite) as (metadata_file, *spectra_files):
        metadata_file.write_bytes(metadata.encode())
        _WRITERS[chosen](library, names, blocks_of(library, variables, progress), *spectra_files)
    return path


# --- specification of a paint library ----------------------------------------------------------------------

# See docs/paint-library.md. A library must state each declaration, or state that it is unknown: without a
# statement, a reader cannot tell which.


#: Version of the specification, the attribute `VERSION_NAME` of a library. 1 had the dim `paint`.
VERSION = 2
UNKNOWN = "unknown"
_MAX_TEXT_CHARS = 4000
_MAX_NAMES = 5


#: Declarations of every library, for all its paints or for each: name, allowed words (any text where there
#: are none), and meaning. A word may be ``unknown``.
TERMS: tuple[tuple[str, tuple[str, ...], str], ...] = (
    (
        "quantity",
        ("HCRF", "BRF", "8/d SCI", "8/d SCE", BODY, THROUGH_COAT, OUTSIDE, UNKNOWN),
        "A reflectance factor, or the reflectance of a sphere with or without the mirror image",
    ),
    ("specular_component", (INCLUDED, EXCLUDED, UNKNOWN), "Whether the coat's mirror image is in it"),
    ("measurement_geometry", (), "From where light came and to where it was seen, such as 45/0 or d/8"),
    ("finish", FINISHES, "What the paint is like"),
    ("provenance", ("measured", "synthetic", "derived", UNKNOWN), "Where the spectra come from"),
    ("licence", (), "Under which terms it may be used: an SPDX identifier, or a text"),
)

#: Reflectance beyond which units are doubtful: noise of a black panel, glint beside a panel.
_REFLECTANCE_RANGE = (-0.1, 2.0)
#: Sunlight to thermal infrared [nm]: micrometres lie below, wavenumbers and picometres above.
_WAVELENGTH_RANGE_NM = (150.0, 50_000.0)
_ANGLES_DEG = {
    "sun_zenith": (0.0, 90.0),
    "view_zenith": (0.0, 90.0),
    "sun_azimuth": (-180.0, 360.0),
    "view_azimuth": (-180.0, 360.0),
    "aspecular_angle": (0.0, 180.0),
    "relative_azimuth": (0.0, 360.0),
}
_SPREADS = (
    "reflectance_sd",
    "reflectance_u_random",
    "reflectance_u_systematic",
    "reflectance_u_coat",
)


@dataclass(frozen=True)
class LibraryFinding:
    # One departure from the specification.
    rule: str  #: Name of the rule in docs/paint-library.md.
    found: str
    expected: str

    def __str__(self) -> str:
        return f"{self.rule}: {self.found}; expected {self.expected}"


@dataclass(frozen=True)
class LibraryReport:
    """Result of comparing a library with the specification."""

    source: str
    paints: int
    bands: int
    findings: tuple[LibraryFinding, ...]

    @property
    def ok(self) -> bool:
        # Whether there is no finding.
        return not self.findings

    def __str__(self) -> str:
        size = f"{self.source}: {self.paints} paints, {self.bands} bands"
        if self.ok:
            return f"{size}: a paint library of version {VERSION}"
        lines = (f"  {finding}" for finding in self.findings)
        return "\n".join([f"{size}: {len(self.findings)} findings", *lines])


def check_library(library: str | os.PathLike[str] | xr.Dataset) -> LibraryReport:
    """Compare a library with the specification (eager: reads its spectra).

    Parameters
    ----------
    library
        A file or store that `hyperpaint.open_library` opens, or a dataset.

    Returns
    -------
    LibraryReport
        All findings; ``ok`` is True without findings.

    Raises
    ------
    FormatError, StoreError
        The file cannot be opened.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> paints = xr.Dataset(
    ...     {"reflectance": (("signature", "band"), np.float32([[5.0, 40.0]]), {"units": "1"})},
    ...     coords={"signature": ["red"], "wavelength": ("band", [450.0, 650.0], {"units": "nm"})},
    ... )
    >>> [finding.rule for finding in check_library(declare_library(paints)).findings]
    ['reflectance-range', 'uncertainty']
    """
    source, dataset = (
        (os.fspath(library), open_library(library))
        if isinstance(library, str | os.PathLike)
        else (str(library.attrs.get("source", "the library")), with_band_dim(with_new_names(library)))
    )
    findings: list[LibraryFinding] = []
    for rules in (_structure, _paints, _populations, _declarations):
        if findings and rules is _paints:
            break  # the other rules need the structure
        findings += [LibraryFinding(*row) for is_wrong, *row in rules(dataset) if is_wrong]
    return LibraryReport(source, dataset.sizes.get(SIGNATURE, 0), dataset.sizes.get(BAND, 0), tuple(findings))


def declare_library(library: xr.Dataset, **words: str) -> xr.Dataset:
    """Return a library with all declarations of the specification; missing ones become ``unknown``.

    Parameters
    ----------
    library
        A paint library.
    **words
        Terms by their names (`TERMS`), such as ``licence="CC-BY-4.0"``, and ``title``.

    Raises
    ------
    SchemaError
        A term is unknown, or its word is not allowed.

    Examples
    --------
    >>> from hyperpaint.paints import starter_library
    >>> declared = declare_library(starter_library(members=2), licence="CC0-1.0", quantity="HCRF")
    >>> declared.attrs["licence"], declared.attrs["measurement_geometry"]
    ('CC0-1.0', 'unknown')
    """
    terms = {name: allowed for name, allowed, _ in TERMS}
    for name, word in words.items():
        one_of(name, (*terms, "title"), "term")
        if terms.get(name):
            one_of(word, terms[name], name)
    library = with_new_names(library)
    declared = library_terms(library)
    attrs = {name: UNKNOWN for name in terms if declared[name] is None}
    title = {} if library.attrs.get("title") else {"title": "Paint library"}
    return library.assign_attrs({VERSION_NAME: VERSION, **title, **attrs, **words})


def library_terms(library: xr.Dataset) -> dict[str, Any]:
    # Return the declaration of each term: a list with a word for every paint, a word for all, or None.
    attrs = {**library.attrs, **library[CENTRE].attrs}
    return {
        name: list(map(str, library[name].values.tolist()))
        if name in library.variables and library[name].dims == (SIGNATURE,)
        else attrs.get(name)
        for name, *_ in TERMS
    }


# --- the rules ---------------------------------------------------------------------------------------------

#: Whether a library departs from a rule; the name of the rule, the observed and the expected state.
_Row = tuple[bool, str, str, str]


def _structure(library: xr.Dataset) -> Iterator[_Row]:
    for name in (CENTRE, "wavelength", SIGNATURE):
        row = LIBRARY_VARIABLES[name]
        missing = Problem(f"{name!r} is missing", code="variable-missing")
        problem = row.dim_problem(library[name]) if name in library.variables else missing
        found = "" if problem is None else problem.found
        yield problem is not None, "structure", found, f"a variable {name} ({', '.join(row.dims)})"
    for name, row in LIBRARY_VARIABLES.items():
        if name in library.variables and name not in (CENTRE, "wavelength", SIGNATURE):
            dims = library[name].dims
            is_wrong = row.dim_problem(library[name]) is not None and dims != (SIGNATURE, *row.dims)
            yield is_wrong, "dims", f"{name} has dims {dims}", " or ".join(map(str, row.allowed_dims))


def _paints(library: xr.Dataset) -> Iterator[_Row]:
    # names, bands and reflectance of the paints
    names = library[SIGNATURE].values.tolist()
    invalid = [name for name in names if not isinstance(name, str) or not name.strip()]
    duplicates = sorted({str(name) for name in names if names.count(name) > 1})
    nm = np.asarray(library["wavelength"].values, np.float64)
    nm_units, (low_nm, high_nm) = library["wavelength"].attrs.get("units"), _WAVELENGTH_RANGE_NM
    is_in_range = (
        np.isfinite(nm).all() and nm.min(initial=low_nm) >= low_nm and nm.max(initial=high_nm) <= high_nm
    )
    steps = np.diff(nm)
    yield from (
        (not names, "paint-names", "there is no paint", "at least one"),
        (
            bool(invalid),
            "paint-names",
            f"{len(invalid)} names are empty or not text",
            "a text for every paint",
        ),
        (
            bool(duplicates),
            "paint-names",
            f"{_listed(duplicates)} occur twice",
            "a unique name for every paint",
        ),
        (nm_units != "nm", "wavelength-units", f"units are {nm_units!r}", "'nm'"),
        (not is_in_range, "wavelength-range", _extremes(nm), f"{low_nm:g} to {high_nm:g} nm"),
        (
            not ((steps > 0).all() or (steps < 0).all()),
            "wavelength-order",
            f"{int((steps == 0).sum())} occur twice, or the direction changes",
            "ascending or descending",
        ),
    )
    if "fwhm" in library.variables:
        fwhm, units = np.asarray(library["fwhm"].values, np.float64), library["fwhm"].attrs.get("units")
        is_positive = bool((fwhm[np.isfinite(fwhm)] > 0).all())
        yield units != "nm" or not is_positive, "fwhm", f"{_extremes(fwhm)} {units}", "positive, in nm"
    is_good = np.ones(nm.size, bool)
    if "good" in library.variables:
        dtype, is_good = library["good"].dtype, library["good"].values.astype(bool)
        yield dtype.kind != "b", "good", f"dtype {dtype}", "bool: whether a band is usable"
    reflectance, (low, high) = library[CENTRE], _REFLECTANCE_RANGE
    units = reflectance.attrs.get("units")
    yield units != "1", "reflectance-units", f"units are {units!r}", "'1', a fraction"
    yield reflectance.dtype.kind != "f", "reflectance-dtype", str(reflectance.dtype), "float32 or float64"
    if reflectance.dtype.kind == "f":
        values = reflectance.transpose(SIGNATURE, BAND).values
        with np.errstate(invalid="ignore"):
            outside = ((values < low) | (values > high) | np.isinf(values)) & is_good
        empty = ~np.isfinite(values).any(axis=1)
        outside_paints, empty_paints = (
            _listed([str(name) for name in library[SIGNATURE].values[mask]])
            for mask in (outside.any(axis=1), empty)
        )
        yield from (
            (
                bool(outside.any()),
                "reflectance-range",
                f"{_extremes(values[outside])} in {outside_paints}",
                f"{low:g} to {high:g} in good bands",
            ),
            (
                bool(empty.any()),
                "reflectance-empty",
                f"no value in {empty_paints}",
                "a value in at least one band",
            ),
        )


def _populations(library: xr.Dataset) -> Iterator[_Row]:
    # uncertainty, members, and the geometry of light and view
    spreads = {name: library[name] for name in _SPREADS if name in library.variables}
    for name, spread in spreads.items():
        units = spread.attrs.get("units")
        yield from (
            (bool((spread.values < 0).any()), "uncertainty-sign", f"{name} is negative", "0 or more"),
            (units != "1", "uncertainty-units", f"{name} has units {units!r}", "'1'"),
        )
    has_spread = any(np.isfinite(spread.values).any() for spread in spreads.values())
    yield (
        not has_spread and library.attrs.get("uncertainty") != UNKNOWN,
        "uncertainty",
        "neither spread nor uncertainty",
        f"reflectance_u_random, reflectance_u_systematic or reflectance_sd, or uncertainty = {UNKNOWN!r}",
    )
    if "reflectance_quantiles" in library.variables and "quantile" in library.variables:
        levels = library["quantile"].values
        values = library["reflectance_quantiles"].transpose(SIGNATURE, "quantile", BAND).values
        is_wrong = bool((np.diff(levels) <= 0).any() or ((levels < 0) | (levels > 1)).any())
        is_falling = bool((np.diff(values, axis=1) < 0).any()) and not is_wrong
        yield from (
            (is_wrong, "quantiles", f"levels {levels.tolist()}", "ascending, from 0 to 1"),
            (is_falling, "quantiles", "quantiles decrease with their level", "quantiles that increase"),
        )
    counts = {name: library[name].values for name in ("n", "n_eff") if name in library.variables}
    if "n" in counts:
        number = counts["n"]
        is_more = bool((counts.get("n_eff", 0) > number * (1 + 1e-6)).any())
        yield from (
            (bool((number < 1).any()), "n", f"{number.min(initial=1)} pixels", "1 or more"),
            (is_more, "n", "more independent pixels than pixels", "n_eff at most n"),
        )
    if "member_reflectance" in library.variables:
        members = library["member_reflectance"]
        is_empty = bool(members.sizes["member"]) and not np.isfinite(members.values).any()
        yield is_empty, "members", "no member has a value", "spectra of single pixels, or no such variable"
    for name, (low, high) in _ANGLES_DEG.items():
        if name in library.variables:
            values, units = np.asarray(library[name].values, np.float64), library[name].attrs.get("units")
            finite = values[np.isfinite(values)]
            is_wrong = units != "degree" or bool(((finite < low) | (finite > high)).any())
            yield is_wrong, "angles", f"{name} {_extremes(finite)} {units}", f"{low:g} to {high:g} degree"
    if "time" in library.variables:
        dtype = library["time"].dtype
        yield dtype.kind != "M", "time", f"dtype {dtype}", "datetime64[ns], UTC"
    if "diffuse_fraction" in library.variables:
        share = library["diffuse_fraction"].values
        yield bool(((share < 0) | (share > 1)).any()), "diffuse-fraction", _extremes(share), "0 to 1"


def _declarations(library: xr.Dataset) -> Iterator[_Row]:
    def is_text(word: Any) -> bool:
        return isinstance(word, str) and len(word.strip()) > 0 and len(word) <= _MAX_TEXT_CHARS

    version, title = library.attrs.get(VERSION_NAME), library.attrs.get("title")
    is_version = version == VERSION and not isinstance(version, bool)
    yield from (
        (
            not is_version,
            "version",
            f"{VERSION_NAME} is {version!r}",
            f"{VERSION}; hp.io.declare_library sets it",
        ),
        (not is_text(title), "title", f"title is {title!r:.40}", "a text"),
    )
    declared = library_terms(library)
    for name, allowed, _ in TERMS:
        words = declared[name] if isinstance(declared[name], list) else [declared[name]]
        invalid = {str(word) for word in words if not is_text(word) or (allowed and word not in allowed)}
        found = "not declared" if declared[name] is None else _listed(sorted(invalid))
        expected = f"one of {', '.join(allowed)}" if allowed else f"a text, or {UNKNOWN!r}"
        yield bool(invalid), name, found, expected
    # specular component that contradicts a quantity
    contradictions = {
        BODY: INCLUDED,
        THROUGH_COAT: INCLUDED,
        OUTSIDE: EXCLUDED,
        "8/d SCI": EXCLUDED,
        "8/d SCE": INCLUDED,
    }
    # both words for every paint: a term is declared for all paints, or has a list
    terms = (declared["quantity"], declared["specular_component"])
    size = max(len(words) if isinstance(words, list) else 1 for words in terms)
    lists = (words if isinstance(words, list) else [words] * size for words in terms)
    pairs = [pair for pair in zip(*lists, strict=False) if contradictions.get(str(pair[0])) == str(pair[1])]
    found = "".join(f"{quantity}, specular component {component}" for quantity, component in pairs[:1])
    yield bool(pairs), "contradiction", found, "terms that agree"


def _listed(names: list[str]) -> str:
    return listed([f"{name!r:.60}" for name in names], _MAX_NAMES)


def _extremes(values: Array) -> str:
    known = values[~np.isnan(values)]
    return f"{known.min():.4g} to {known.max():.4g}" if known.size else "none"
