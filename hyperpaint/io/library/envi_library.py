"""ENVI spectral libraries: a header, and a file in which every line is a spectrum.

The first two records of a library of the USGS are wavelengths and bandwidths, and its records "error bars to
preceding" belong to the spectrum before them; neither is a spectrum. Libraries of hyperpaint have
``hyperpaint library = 1`` in their header; the name of a record there contains its paint, variable and index
(``red | member 3``), see `records`. If every record is a paint, the header has lists such as ``paint make``
and ``paint year`` with a value per paint.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
import xarray as xr

from hyperpaint.base.arrays import Array, Floats
from hyperpaint.base.errors import FormatError, Problem, Problems, SchemaError, warn_user
from hyperpaint.base.input_files import open_input, read_limited
from hyperpaint.base.schema import BAND, SIGNATURE
from hyperpaint.io.envi.envi_cubes import (
    MAX_LIBRARY_HEADER_BYTES,
    EnviHeader,
    bare,
    braced,
    find_pair,
    read_header,
)
from hyperpaint.io.files.reading import unique_names

from .library_spectra import OWN_AXES, Spectra, check_wavelengths, library_of, reflectances, text_column
from .records import CENTRE, Block, Key, restored, table_columns
from .text_spectra import PERCENT, other_quantity

_BLOCK_BYTES = 16 * 2**20
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
    header = read_header(header_path, MAX_LIBRARY_HEADER_BYTES)
    problems = Problems(f"{header_path.name} cannot be used", FormatError)
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
                "'data gain values' or 'data offset values' are set, which spectral libraries cannot have",
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
    problems.raise_if_any()
    if _MARK not in header.fields:
        return library_of(_foreign(header, data_path, scale, wavelength, fwhm))
    if scale is not None or wavelength is not None or fwhm is not None:
        raise FormatError(OWN_AXES.format(data_path.name), code="option-conflict")
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
    for is_wrong, found, code in (
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
    ):
        if is_wrong:
            raise FormatError(f"{source}: {found}", mend="write the library again", code=code)
    axes = {"wavelength": header.wavelength, "fwhm": header.fwhm, "good": header.good}
    return restored(data_path, names, keys, axes, _records(header, data_path), {})


def _records(header: EnviHeader, path: Path) -> Iterator[tuple[int, Array]]:
    # Index of the first record of every block, and its records
    step = max(1, _BLOCK_BYTES // header.line_bytes)
    with open_input(path, "the data of a spectral library") as file:
        file.seek(header.header_offset)
        for start in range(0, header.lines, step):
            count = min(step, header.lines - start)
            stored = np.fromfile(file, header.dtype, count * header.samples)
            if stored.size != count * header.samples:
                raise FormatError(f"{path.name} became shorter during reading", code="file-truncated")
            yield start, stored.reshape(count, header.samples)


# --- libraries of other programs ---------------------------------------------------------------------------


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
    if nm is None:
        raise FormatError(
            (
                f"{source}: the header has no wavelengths (wavelength units "
                f"{bare(header.fields.get('wavelength units', 'not given'))!r})"
            ),
            mend="pass wavelength= [nm]",
            code="wavelength-missing",
        )
    check_wavelengths(nm, source)
    if warned:
        warn_user(f"{source}: {'; '.join(warned)}", "header-incomplete")
    # stored value of a reflectance of one, from the header; the last title is that of the values, the title
    # of the wavelengths may contain commas
    header_scale = header.reflectance_scale_factor
    title = bare(header.fields.get("z plot titles", "")).rpartition(",")[2]
    match = _TITLE_SCALE.search(title)
    title_scale = float(match[1]) if match else 100.0 if PERCENT.search(title) else None
    if other_quantity(title):
        raise FormatError(
            f"{source}: the z plot title is {title.strip()[:60]!r}",
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
    if not rows or rows[0][0].strip().lower() != "spectra names" or len(rows) != len(names) + 1:
        return {}
    if [row[0].strip() for row in rows[1:]] != list(names) or any(len(row) != len(rows[0]) for row in rows):
        return {}
    return {
        key: text_column([row[at] for row in rows[1:]])
        for at, key in enumerate(rows[0])
        if at
        and key.isidentifier()
        and key not in ("record", SIGNATURE, "band", "wavelength", "fwhm", "good")
    }


# --- our own -----------------------------------------------------------------------------------------------


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
    lines = [
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
    text = ("\n".join(lines) + "\n").encode()
    if len(text) > MAX_LIBRARY_HEADER_BYTES:
        raise SchemaError(
            f"the header of {len(records)} spectra takes {len(text)} bytes",
            expected=f"at most {MAX_LIBRARY_HEADER_BYTES}",
            mend="shorten names, write fewer members, or write Zarr",
            code="file-too-large",
        )
    header_path.write_bytes(text)
