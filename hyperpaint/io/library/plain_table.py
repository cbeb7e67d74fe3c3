"""Spectra in a plain text table: wavelengths in the first column, a spectrum in every further column."""

from __future__ import annotations

import csv
import itertools
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hyperpaint.base.arrays import Floats, Ints
from hyperpaint.base.errors import FormatError
from hyperpaint.io.files.reading import numbers

from .column_quantities import IS_SPREAD, check_words, spread_columns, without_repeats
from .library_spectra import Spectra, reflectances, text_column
from .text_spectra import PERCENT, in_nanometres, lines_of, numbers_of_lines, wavelength_factor

_MAX_PREAMBLE = 500
#: Headings that do not name a paint.
_GENERIC = re.compile(r"|r|rho|y|values?|.*(?:reflect|average|mean).*", re.IGNORECASE)

#: Units in headings are removed from names of paints, which are paired with references by name.
_UNIT = re.compile(r"\s*[(\[]\s*(?:%|per ?cent|fraction|-|1)\s*[)\]]\s*$", re.IGNORECASE)


@dataclass(frozen=True)
class _Dialect:
    # Separator and decimal mark of a table
    separator: str  # empty for blanks
    comma: bool  # whether the decimal mark is a comma

    def cells(self, line: str) -> list[str]:
        return line.split(self.separator) if self.separator else line.split()

    def row(self, line: str) -> list[float] | None:
        # Numbers of a line; None for other lines, and for an empty first cell
        cells = self.cells(line.strip(" "))
        if len(cells) < 2 or not cells[0].strip():
            return None
        return numbers(cell.replace(",", ".") if self.comma else cell for cell in cells)


_DIALECTS = (
    _Dialect("\t", False),
    _Dialect(";", False),
    _Dialect(",", False),
    _Dialect("", False),
    _Dialect("\t", True),
    _Dialect(";", True),
    _Dialect("", True),
)


def read_plain_table(
    path: Path, *, scale: float | None = None, wavelength: Floats | None = None, is_reflectance: bool = False
) -> Spectra:
    """Read spectra from a table of two or more columns.

    Cells are separated by commas, semicolons, tabs or blanks; decimal commas are read where commas are not
    the separator. Lines above the numbers are headings, the last of them names the columns; lines that begin
    with ``#`` are comments. A single spectrum with a general heading such as "reflectance" gets the name of
    the file. A column whose heading says so is the standard deviation of the column before it.

    scale: Stored value of a reflectance of one; by default 100 if the headings say percent, else 1.
    wavelength: Wavelengths in place of the first column [nm].
    is_reflectance: Whether the values are reflectance, without a check of headings and values.
    Raises FormatError: There is no table of numbers, its first column is not wavelengths, or the values are
        not reflectance.
    Warns PaintWarning: Successive rows have the same wavelength; or the values of a column look like a
        standard deviation.
    """
    source = path.name
    lines = lines_of(path, "a table of wavelengths and reflectance")
    first_line, dialect, columns = _beginning(lines, source)
    without_comments = ["" if line.lstrip().startswith("#") else line for line in lines]
    table = numbers_of_lines(without_comments, first_line, columns, source, dialect.row)
    if columns > 2 and np.isnan(table[:, -1]).all():  # every line ends with a separator
        table, columns = table[:, :-1], columns - 1
    _check_order(table[:, 0], source)
    preamble = lines[:first_line]
    headings = _headings(preamble, dialect, columns)
    preamble_text = " ".join(preamble)
    if not is_reflectance:
        check_words(preamble, headings, source)
    factor, note = wavelength_factor(preamble_text, table[:, 0], source)
    percent = 100.0 if PERCENT.search(preamble[-1] if preamble else "") else None
    nm, values, notes = table[:, 0], table[:, 1:], [note] if note else []
    if wavelength is None:
        nm, values, repeats = without_repeats(nm, values, source)
        notes += repeats
    spread = spread_columns(headings, values.T, source, is_reflectance=is_reflectance)
    names = _names(headings, spread, path.stem)
    paints = np.flatnonzero(spread != IS_SPREAD)
    reflectance = reflectances(
        values.T[paints], source, file_scale=percent, scale=scale, is_reflectance=is_reflectance
    )
    further = {}
    if (spread >= 0).any():
        sd = reflectances(values.T[spread[paints]], source, file_scale=percent or 1.0, scale=scale)
        further["reflectance_sd"] = np.where(spread[paints, None] >= 0, sd, np.float32(np.nan))
    return Spectra(
        source=source,
        form="table of text",
        names=names,
        wavelength=in_nanometres(nm, factor) if wavelength is None else wavelength,
        reflectance=reflectance,
        others=further,
        notes=notes,
    )


def _beginning(lines: Sequence[str], source: str) -> tuple[int, _Dialect, int]:
    # Index of the first line of numbers, its dialect, and its number of columns
    text_lines = [at for at, line in enumerate(lines) if line.strip() and not line.lstrip().startswith("#")]
    for at, following in itertools.pairwise(text_lines[: _MAX_PREAMBLE + 1]):
        rows = [(dialect, row) for dialect in _DIALECTS if (row := dialect.row(lines[at])) is not None]
        if rows:
            # the dialect in which the next line has as many columns, else the first, with which the next
            # line is reported later
            fitting = [d for d, row in rows if len(d.row(lines[following]) or ()) == len(row)]
            dialect = fitting[0] if fitting else rows[0][0]
            return at, dialect, next(len(row) for d, row in rows if d == dialect)
    raise FormatError(
        f"{source}: no table of numbers",
        expected="a wavelength and one or more values a line",
        code="table-missing",
    )


def _check_order(wavelength: Floats, source: str) -> None:
    # Raise for a first column that changes direction more often than detectors join
    steps = np.diff(wavelength)
    reversals = min(int((steps < 0).sum()), int((steps > 0).sum()))
    if np.isnan(wavelength).any() or reversals > max(4, steps.size // 20) or not steps.any():
        raise FormatError(
            f"{source}: the first column rises and falls",
            expected="wavelengths",
            mend="write every spectrum as a column",
            code="wavelength-unordered",
        )


def _names(headings: Sequence[str], spread: Ints, stem: str) -> list[str]:
    paints = np.flatnonzero(spread != IS_SPREAD)
    names = [headings[at + 1].strip() for at in paints.tolist()] if headings else []
    without_units = [_UNIT.sub("", name) for name in names]
    if len(set(without_units)) == len(set(names)):
        names = without_units
    if paints.size == 1:
        return [stem if not names or _GENERIC.fullmatch(names[0]) else names[0]]
    names = names or [""] * paints.size
    return [name or f"column {at + 2}" for at, name in zip(paints, names, strict=True)]


def _headings(preamble: Sequence[str], dialect: _Dialect, columns: int) -> list[str]:
    # Cells of the last heading; empty where they are not as many as columns
    line = next((line for line in reversed(preamble) if line.strip()), "")
    is_comment = line.lstrip().startswith("#")
    text = line.strip().lstrip("#")
    # commas may separate headings in a comment where another mark separates numbers
    separators = [dialect.separator, ","] if is_comment else [dialect.separator]
    for separator in separators:
        try:
            cells = next(csv.reader([text], delimiter=separator)) if separator else text.split()
        except csv.Error:
            continue
        if len(cells) == columns + 1 and not cells[-1].strip():
            cells.pop()
        if len(cells) == columns or (len(cells) > columns and is_comment and separator):
            return cells[:columns]
    return []


# --- spectra of the USGS spectral library (splib06, splib07) as text ---------------------------------------
# A title, then one value a line. Wavelengths and bandwidths are in separate files, one for each spectrometer,
# beside the spectra or in a folder above.


_TITLE = re.compile(r"\s*(\S{1,40})\s+Record\s*=\s*(\d{1,9})\s*:(.*)$", re.IGNORECASE)
_MEASUREMENT = re.compile(r"[A-Z]{4}")
_AXIS = re.compile(r"\s*\S{1,40}\s+Record\s*=\s*\d{1,9}\s*:\s*(?:wave|bandpass|resolution|fwhm)", re.I)
_SPECTROMETERS = ("BECK", "NIC4", "AVIRIS", "ASD")
_MAX_CANDIDATES = 64
#: Number of folders that are searched for wavelengths, from that of the spectrum upwards.
_FOLDERS = 3


def is_usgs(head: str) -> bool:
    """Return whether the first line of a text is that of a USGS spectrum."""
    return _TITLE.match(head.partition("\n")[0]) is not None


def is_usgs_axis(head: str) -> bool:
    """Return whether the first line of a text is that of USGS wavelengths or bandwidths."""
    return _AXIS.match(head.partition("\n")[0]) is not None


def read_usgs(
    path: Path, *, scale: float | None = None, wavelength: Floats | None = None, fwhm: Floats | None = None
) -> Spectra:
    """Read a spectrum of the USGS library.

    scale: Stored value of a reflectance of one, 1 by default.
    wavelength, fwhm: Wavelengths and widths of the bands [nm]; by default from files beside the spectrum, or
        in the two folders above it.
    Raises FormatError: Lines are not numbers; the quantity is not reflectance; or no file of wavelengths is
        found.
    """
    source = path.name
    title, values = _column(path)
    record = _TITLE.match(title)
    heading = record[3].strip() if record else title.strip()
    name, spectrometer, measurement = heading, "", ""
    words = heading.rsplit(None, 2)
    if len(words) == 3 and _MEASUREMENT.fullmatch(words[2]):
        name, spectrometer, measurement = words
    if is_usgs_axis(title):
        raise FormatError(
            f"{source}: {heading[:60]!r} is not a spectrum",
            expected="reflectance",
            mend="pass the file as wavelength= or fwhm=",
            code="quantity-wrong",
        )
    if measurement == "TRAN":
        raise FormatError(
            f"{source}: {heading[:60]!r} is a transmittance", expected="reflectance", code="quantity-wrong"
        )
    notes: list[str] = []
    nm = _axis(path, "wave", values.size, spectrometer, notes) if wavelength is None else wavelength
    if nm is None:
        raise FormatError(
            f"{source}: no file with {values.size} wavelengths beside it or in the folders above",
            mend=f"pass wavelength=, '..._Wavelengths_...txt' of the spectrometer {spectrometer}".rstrip(),
            code="wavelength-missing",
        )
    width = _axis(path, "bandpass", values.size, spectrometer, notes) if fwhm is None else fwhm
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
    lines = lines_of(path, "a file of the USGS spectral library")
    values = numbers_of_lines(lines, 1, 1, path.name)[:, 0]
    if values.size < 2:
        raise FormatError(
            f"{path.name}: {values.size} values",
            expected="a title and one value a line",
            code="table-missing",
        )
    return lines[0], values


def read_usgs_axis(path: Path) -> tuple[Floats, str]:
    """Return the wavelengths or bandwidths of a USGS file [nm], and a note on their units.

    Raises FormatError: The file is damaged, or has other content.
    """
    title, values = _column(path)
    factor, note = wavelength_factor(title.replace("_", " "), values, path.name)
    if not np.isfinite(values).all():
        raise FormatError(f"{path.name}: not all of its {values.size} values are finite", code="not-finite")
    return in_nanometres(values, factor), note


def _axis(path: Path, kind: str, count: int, spectrometer: str, notes: list[str]) -> Floats | None:
    # Wavelengths ("wave") or bandwidths from a file near a spectrum; None without a file of equal length
    axes = {}
    for file in _candidates(path, kind):
        try:
            values, note = read_usgs_axis(file)
        except FormatError:
            continue
        if values.size == count:
            axes[file] = (values, note)
    code = next((code for code in _SPECTROMETERS if spectrometer.upper().startswith(code)), None)
    if len(axes) > 1 and code:
        axes = {file: axis for file, axis in axes.items() if code in file.name.upper()} or axes
    if len({values.tobytes() for values, _ in axes.values()}) > 1:
        listed = ", ".join(sorted(file.name for file in axes))
        option = "wavelength=" if kind == "wave" else "fwhm="
        raise FormatError(
            f"{path.name}: {listed} have {count} values each",
            mend=f"pass the file of this spectrum as {option}",
            code="wavelength-ambiguous",
        )
    for file, (values, note) in axes.items():
        notes.append(f"{'wavelengths' if kind == 'wave' else 'fwhm'} of {file.name}{note and ': ' + note}")
        return values
    return None


def _candidates(path: Path, kind: str) -> list[Path]:
    words = ("wavelength",) if kind == "wave" else ("bandpass", "fwhm", "resolution")
    folder = path.absolute().parent
    for searched in [folder, *folder.parents][:_FOLDERS]:
        try:
            names = sorted(entry.name for entry in searched.iterdir())
        except OSError:
            continue
        fitting = [n for n in names if n.lower().endswith(".txt") and any(w in n.lower() for w in words)]
        if kind != "wave":  # names of spectra convolved to another spectrometer contain "wavelength"
            fitting = [name for name in fitting if "wavelength" not in name.lower()]
        if fitting:
            paths = (searched / name for name in fitting[:_MAX_CANDIDATES])
            return [file for file in paths if file != path.absolute()]
    return []
