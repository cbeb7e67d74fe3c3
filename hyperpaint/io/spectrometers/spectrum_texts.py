"""Texts of field and pocket spectrometers: a head, headings, and columns that have a quantity each.

`FORMS` has one row for each way to write such a file, `_COLUMNS` the quantity of a column by its heading.
Numbers have a decimal point or comma. A column without a heading is what the head of the file says, or is
declared by the caller.
"""

import datetime as dt
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hyperpaint.base import VARIABLES, Floats, FormatError, Problem, UnitsError, conversion_factor
from hyperpaint.io.files.reading import first_row, read_limited_text, refuse, row_numbers

from .spectrum_files import ratio, text_lines
from .svc import read_stamp


class Form(NamedTuple):
    """Form of a text that an instrument or its program writes."""

    instrument: str
    # Up to the headings, or to the rows where there are none; of the first 16 kB of a file
    begins: re.Pattern[str]
    # Line after the rows; text below it is not read
    ends: re.Pattern[str] | None = None
    # Date and time of the spectrum in the head, and the order of a date with slashes
    stamp: str = r"^(?:Date|Time)[^:\t\n]*[:\t] *(?P<date>[\d/.-]{8,10})[ _,]+(?P<time>[\d:]{7,8})"
    dayfirst: bool | None = None
    units: str = ""  # of radiance or irradiance, where the file does not say
    quantity: str = ""  # of a column without a heading, where the head does not say


def _pattern(text: str) -> re.Pattern[str]:
    return re.compile(text, re.MULTILINE | re.IGNORECASE)


#: Layouts by files that users published: EnMAP-Box (DARWin), photobiologyInOut and lightr (the others).
FORMS = (
    Form(
        "Spectral Evolution",
        _pattern(r'^"?Data:"?[,;\t ]*\n(?="?(?:Chan\.?#"?[,;\t]"?)?Wvl\b)'),
        # of the reference, then of the target
        stamp=r"^Date: *(?:[^,\n]*, *)?(?P<date>[\d/]{8,10})[^\n]*\n"
        r"Time: *(?:[^,\n]*, *)?(?P<time>[\d:]{7,8})(?P<fraction>\.\d{1,6})?",
        dayfirst=False,
    ),
    # in the languages of their software: "Begin Spectral Data", "Comienza Data"
    Form(
        "Ocean Optics",
        _pattern(r"^>{4,}[^\n]*\n"),
        re.compile(r">{4,}"),
        stamp=r"^(?:Date|Fecha|Datum): *(?:(?P<date>[\d-]{8,10}), *(?P<time>[\d:]{7,8})|"
        r"\w{3} (?P<month>[^\W\d]{3}) (?P<day>\d{1,2}) (?P<clock>[\d:]{8}) ?"
        r"(?P<zone>[A-Z]{3,4})? (?P<year>\d{4}))",
        units="uW cm-2 nm-1",
    ),
    Form("Avantes", _pattern(r"^(?=Wave[a-z]*\s*[;\t,][^\n]*\n\s*\[nm\])")),
    Form(
        "LI-180",
        _pattern(r"\AModel Name\tLI-180[^\n]*\n(?:\D[^\n]*\n){1,100}?(?=\d{3}nm\t)"),
        re.compile(r"\D"),
        units="mW m-2 nm-1",
        quantity="irradiance",
    ),
    Form("StellarNet", _pattern(r'\A" ?File:[^\n]*\n"[^\n]*Time:[^\n]*\n'), re.compile(r": ?\d")),
    Form("LI-1800", _pattern(r'\A"FILE:[^\n]*\n(?:"[^\n]*\n){2,20}')),
)
#: Suffixes of texts of spectra, in a folder.
SPECTRUM_SUFFIXES = (
    ".txt", ".tsv", ".csv", ".asc", ".sed", ".jaz", ".jazirrad",
    ".ssirrad", ".ovirrad", ".ttt", ".trt", ".irr"
)  # fmt: skip
#: Quantity and scan of a column by its heading: no quantity for numbers of channels, an empty one where the
#: head decides.
_COLUMNS = tuple(
    (re.compile(pattern, re.IGNORECASE), quantity, scan)
    for pattern, quantity, scan in (
        (r"chan|pixel", None, ""),
        (r"transm|absorb", "transmittance or absorbance", "target"),
        (r"reflect|tgt\.? ?/ ?ref", "reflectance", "target"),
        (r"irrad.*\bref\b", "irradiance", "reference"),
        (r"irrad", "irradiance", "target"),
        (r"\brad.*\bref\b", "radiance", "reference"),
        (r"\brad", "radiance", "target"),
        (r"^(?:d|dark)\b", "counts", "dark"),
        (r"^(?:r|ref|reference)\b|dn \(ref", "counts", "reference"),
        (r"^(?:s|sample|scope)\b|\bdn\b|count|intensit", "counts", "target"),
        (r"", "", "target"),
    )
)
RATIO = "target / reference"
_WAVELENGTH = re.compile(r"w(?:vl|ave\w*|l)?\b", re.IGNORECASE)
#: What the head says of columns without a heading: words, and quantity.
_HEAD = (
    (_pattern(r'^"?rem:[^\n]*(?:\bqntm\b|photon|quant)'), "photons"),
    (_pattern(r"absolute ?irradiance|^\S*mode: *irradiance"), "irradiance"),
    (_pattern(r"^[^\n:]*mode: *reflect|^\"?rem: *refl"), "reflectance"),
    (_pattern(r"^[^\n:]*mode: *(?:transm|absorb)"), "transmittance or absorbance"),
    (_pattern(r"^[^\n:]*mode: *(?:scope|counts)"), "counts"),
)
_UNITS = _pattern(r'^"?(?:[yY] ?)?(?:units?|unidades|einheit(?:en)?) *[:=\t] *([^\n,"]{1,40})')
_IN_BRACKETS = re.compile(r"\[([^\[\]]{1,40})\]")
_INTEGRATION = _pattern(
    r"^(?:integration time|tiempo de integraci\S*|i-time)\s*(?:[(\[](usec|msec|sec|ms)[)\]])?\s*[:\t]\s*"
    r"(\d{1,9}(?:[.,]\d{1,9})?(?:E[+-]?\d{1,2})?)"
)
_SECONDS = {"usec": 1e-6, "sec": 1.0}
_AVERAGES = _pattern(r"^(?:spectra averaged|scans to average|average|averaging[^:\n]*) *: *(\d{1,6})\b")
#: Local time minus UTC [h] of the abbreviations that have one meaning.
_ZONES = {"UTC": 0, "GMT": 0, "WET": 0, "WEST": 1, "CET": 1, "CEST": 2, "EET": 2, "EEST": 3}
_GPS = _pattern(
    r"^Latitude: *(-?\d{1,2}\.\d+)\s*\nLongitude: *(-?\d{1,3}\.\d+)\s*\nAltitude: *(-?\d{1,5}(?:\.\d+)?)\s*\n"
    r"GPS Time: *(\d\d):(\d\d):(\d\d)"
)
#: Quantities of a file, the derived ones first.
_PREFERRED = ("reflectance", "irradiance", "radiance", "counts")
_HEAD_BYTES = 16 * 1024
_MAX_BYTES, _MAX_COLUMNS = 16 << 20, 32


class TextColumn(NamedTuple):
    # One spectrum of a file, in the units of the file.
    heading: str
    quantity: str  # empty where the file does not say
    scan: str
    units: str  # empty where the file does not say
    values: Floats


class SpectrumText(NamedTuple):
    # Content of one file.
    name: str
    instrument: str
    wavelength: Floats  # (wavelength) [nm]
    columns: tuple[TextColumn, ...]
    units: str  # of light by the head, or else the maker's; may be empty
    local_time: dt.datetime | None
    utc_offset_h: float | None
    averaging_s: float | None
    gps: tuple[float, float, float, dt.time] | None  # degrees north and east, metres, UTC

    @property
    def quantity(self) -> str | None:
        # Quantity of the file, the derived one of several; None where it does not say.
        found = {column.quantity for column in self.columns if column.scan == "target"}
        return next((quantity for quantity in _PREFERRED if quantity in found), None)

    def column(self, quantity: str, units: str | None = None) -> TextColumn:
        """Return the target's spectrum of a quantity: in SI units, or reflectance as in the file.

        units: Of the values, where the file does not say.

        Raises FormatError: The file holds other quantities alone, or its units are unknown.
        """
        targets = [column for column in self.columns if column.scan == "target"]
        known = [column for column in targets if column.quantity == quantity]
        unknown = [column for column in targets if not column.quantity]
        radiances = {column.scan: column.values for column in self.columns if column.quantity == "radiance"}
        if quantity == "reflectance" and not known and {"target", "reference"} <= set(radiances):
            values = ratio(radiances["target"], radiances["reference"])
            return TextColumn(RATIO, quantity, "target", "1", values)
        held = sorted({f"{c.quantity or 'an unnamed quantity'} of the {c.scan}" for c in self.columns})
        refuse(
            self.name,
            (
                not known and not unknown,
                Problem(
                    f"{self.instrument} text of {' and '.join(held)}, no {quantity}{self._hint()}",
                    mend=_WAYS_OUT.get(self.quantity or "", "export it with the instrument's software"),
                    code="quantity-wrong",
                ),
            ),
        )
        column = (known or unknown)[-1]
        if quantity not in ("radiance", "irradiance"):
            return column._replace(quantity=quantity)
        target_units, file_units = VARIABLES[quantity].units, column.units or (self.units if known else "")
        refuse(
            self.name,
            (
                not (file_units or units),
                Problem(
                    f"{self.instrument} text without units of {quantity}",
                    mend=f"pass units=, for example {target_units!r}",
                    code="units-missing",
                ),
            ),
        )
        try:
            factor = conversion_factor(file_units or str(units), target_units)
            is_conflict = bool(units) and conversion_factor(str(units), target_units) != factor
        except UnitsError as error:
            problem = Problem(f"units of {quantity}: {error.problem.found}", code="units-unknown")
            raise FormatError(f"{self.name}: {problem.found}", code=problem.code) from error
        refuse(
            self.name,
            (
                is_conflict,
                Problem(
                    f"units={units!r}, but the file has {file_units!r}",
                    mend="correct one of them",
                    code="units-conflict",
                ),
            ),
        )
        return column._replace(quantity=quantity, units=target_units, values=column.values * factor)

    def _hint(self) -> str:
        # The ratio of counts that a user may want to check by hand.
        counts = {column.scan: column.values[0] for column in self.columns if column.quantity == "counts"}
        if counts.get("reference") and "target" in counts:
            share = counts["target"] / counts["reference"]
            return f" (target / reference is {share:.3g} at {self.wavelength[0]:g} nm)"
        return ""


_WAYS_OUT = {
    "irradiance": "open it with hp.open_irradiance",
    "radiance": "open it with hp.open_asd(path, 'radiance')",
    "counts": "save reflectance with the instrument's software",
}


#: Heading of a column of times, and of a wavelength [nm], in the csv of a logger.
TIME_HEADING = re.compile(
    r"(?:(?:utc|local|unix|posix|epoch|sample|log|gps)[ _-]*)?"
    r"(?:time(?:[ _-]*stamp)?|date(?:[ _/-]*time)?|datum|(?:uhr)?zeit(?:stempel)?|utc)"
    r"[ _]*(?:utc|[(\[][^)\]]{0,20}[)\]])?",
    re.IGNORECASE,
)
NM_HEADING = re.compile(r"[xX]?(\d{1,5}(?:[.,]\d{1,6})?)\s*(?:[(\[]?nm[)\]]?)?", re.IGNORECASE)


def heading_cells(line: str) -> tuple[str, list[str]]:
    # Return the separator of a line of headings, and its cells without quotes.
    separator = max(";\t,", key=line.count)
    return separator, [cell.strip().strip('"').strip() for cell in line.strip().split(separator)]


def is_logger_csv(lines: Sequence[str]) -> bool:
    # Return whether a text begins as the csv of a logger: times, then wavelengths, below comments.
    first = next((line for line in lines if line.strip() and not line.lstrip("\ufeff").startswith("#")), "")
    _, (head, *cells) = heading_cells(first.lstrip("\ufeff"))
    if head.lower() == "time":
        return True
    times = [cell for cell in cells[:1] if TIME_HEADING.fullmatch(cell)]
    is_wavelength = bool(cells[len(times) :]) and NM_HEADING.fullmatch(cells[len(times)]) is not None
    return is_wavelength and TIME_HEADING.fullmatch(head) is not None


def form_of(head: str) -> tuple[Form, re.Match[str]] | None:
    # Return the form of a text, and where its headings or rows begin; None for other files.
    found = ((form, form.begins.search(head[:_HEAD_BYTES])) for form in FORMS)
    return next(((form, match) for form, match in found if match is not None), None)


def read_spectrum_text(path: str | os.PathLike[str]) -> SpectrumText:
    r"""Read one text of an instrument in `FORMS`.

    Raises FormatError: The file cannot be read, is of another kind, or its table is damaged.

    Examples
    --------
    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp(), "door.sed")
    >>> _ = path.write_text("Instrument: PSR\nData:\nWvl\tReflect. %\n550.0\t 6.7\n551.0\t 6.8\n")
    >>> read_spectrum_text(path).column("reflectance").values
    array([6.7, 6.8])
    """
    path = Path(path)
    lines = text_lines(read_limited_text(path, _MAX_BYTES, "a text of a spectrometer"))
    text = "\n".join(lines)
    found = FormatError.raise_if_none(
        form_of(text),
        f"{path.name}: no text of a spectrometer",
        expected=f"one of {', '.join(form.instrument for form in FORMS)}",
        code="format-unknown",
    )
    form, begins = found
    head, start = text[: begins.end()], text.count("\n", 0, begins.end())
    # LI-180 writes the unit behind each wavelength
    rows = [re.sub(r"^(\d+)nm\b", r"\1", line) for line in lines[start:]]
    at = first_row(rows)
    again = "copy the file again from the instrument"
    at = FormatError.raise_if_none(at, f"{path.name}: no table of numbers", mend=again, code="table-missing")
    first, dialect = at
    count = len(row_numbers(rows[first], dialect) or ())
    table: list[list[float]] = []
    for line_number, line in enumerate(rows[first:], start + first + 1):
        if form.ends is not None and form.ends.match(line) and table:
            break
        if not line.strip(" \t,;"):
            continue
        cells = row_numbers(line, dialect)
        FormatError.raise_if(
            cells is None or len(cells) != count,
            f"{path.name}: line {line_number} holds {line.strip()[:60]!r}",
            expected=f"{count} numbers",
            mend=again,
            code="row-unreadable",
        )
        table.append(cells or [])
    # headings, in one line or in two: names, then units
    separator = dialect[0] or None
    cells_of = [
        [cell.strip().strip('"') for cell in line.split(separator)] for line in rows[:first] if line.strip()
    ]
    lists = [cells for cells in cells_of if len(cells) == count][:2]
    headings = [" ".join(filter(None, cells)) for cells in zip(*lists, strict=True)] or [""] * count
    axis = next((i for i, heading in enumerate(headings) if _WAVELENGTH.match(heading)), 0)
    values = np.array(table, np.float64).T
    wavelength = values[axis]
    refuse(
        path.name,
        (count > _MAX_COLUMNS, Problem(f"{count} columns", expected=f"{_MAX_COLUMNS}", code="file-damaged")),
        (len(table) < 2, Problem(f"{len(table)} rows", expected="a spectrum", code="table-missing")),
        (
            not (np.isfinite(wavelength).all() and wavelength[0] > 0 and (np.diff(wavelength) > 0).all()),
            Problem("the wavelengths do not increase", mend=again, code="wavelength-unordered"),
        ),
    )  # fmt: skip
    head_quantity = next((quantity for pattern, quantity in _HEAD if pattern.search(head)), form.quantity)
    unit_line = _UNITS.search(head)
    head_units = unit_line[1].strip() if unit_line is not None else ""
    columns = []
    for number, heading in enumerate(headings):
        quantity, scan = next((q, s) for pattern, q, s in _COLUMNS if pattern.search(heading))
        if number == axis or quantity is None:
            continue
        bracket = _IN_BRACKETS.search(heading if quantity else head if head_quantity == "reflectance" else "")
        units = bracket[1] if bracket is not None else "%" if "%" in heading else ""
        column = TextColumn(heading, quantity or head_quantity, scan, units, values[number])
        columns.append(column if quantity or units or not head_units else _by_units(column, head_units))
    local, offset = _time_of(form, head)
    seconds, averages, fix = (pattern.search(head) for pattern in (_INTEGRATION, _AVERAGES, _GPS))
    gps = None
    if fix is not None and max(int(fix[5]), int(fix[6])) < 60 and int(fix[4]) < 24:
        utc = dt.time(int(fix[4]), int(fix[5]), int(fix[6]))
        gps = (float(fix[1]), float(fix[2]), float(fix[3]), utc)
    window = None
    if seconds is not None:
        window = float(seconds[2].replace(",", ".")) * _SECONDS.get((seconds[1] or "").lower(), 1e-3)
        window *= max(int(averages[1]), 1) if averages is not None else 1
    units = head_units if head_units.lower() != "none" else ""
    return SpectrumText(
        path.name,
        form.instrument,
        wavelength,
        tuple(columns),
        units or form.units,
        local,
        offset,
        window,
        gps,
    )


def _by_units(column: TextColumn, units: str) -> TextColumn:
    # Return a column without a heading with the quantity that the units of the head have.
    for quantity in ("irradiance", "radiance"):
        try:
            conversion_factor(units, VARIABLES[quantity].units)
        except UnitsError:
            continue
        return column._replace(quantity=quantity, units=units)
    return column._replace(units=units)


def _time_of(form: Form, head: str) -> tuple[dt.datetime | None, float | None]:
    # Return the local time in the head, and local time minus UTC [h]; None where unknown or ambiguous.
    match = re.search(form.stamp, head, re.MULTILINE)
    if match is None:
        return None, None
    parts: dict[str, Any] = {"fraction": None, "zone": None, "month": None} | match.groupdict()
    date = f"{parts['day']}-{parts['month']}-{parts['year']}" if parts["month"] else parts["date"]
    if form.dayfirst is None and not parts["month"]:
        date = date.replace("-", "/")  # of an order that differs between versions: kept only where certain
    stamp = read_stamp(f"{date} {parts['clock'] if parts['month'] else parts['time']}")
    local = None if stamp is None else stamp.read(form.dayfirst)
    if local is not None and parts["fraction"]:
        local += dt.timedelta(seconds=float(parts["fraction"]))
    return local, _ZONES.get(parts["zone"] or "")
