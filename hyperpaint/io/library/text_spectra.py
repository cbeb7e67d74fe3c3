"""Spectra in texts: plain tables, files of the ECOSTRESS and ASTER libraries, files of the USGS library.

A plain table has wavelengths in the first column, and a spectrum in every further column. A file of ECOSTRESS
(version 1) or its forerunner ASTER (version 2) has lines ``Key: value``, an empty line, then x and y a line;
the values of ASTER files wrap over lines without a key. A file of the USGS library (splib06, splib07) has a
title, then one value a line; wavelengths and bandwidths are in separate files, one for each spectrometer,
beside the spectra or in a folder above.
"""

from __future__ import annotations

import contextlib
import csv
import itertools
import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hyperpaint.base.arrays import Floats, Floats32, Ints
from hyperpaint.base.errors import FormatError, Problem, Problems, warn_user
from hyperpaint.base.schema import LIBRARY_VARIABLES, SIGNATURE
from hyperpaint.io.files.reading import decoded_text, number, numbers, read_limited_text

from .records import Spectra, reflectances, text_column, typed_values

#: Largest text file [bytes]: 100,000 bands of 30 spectra.
MAX_BYTES = 32 * 2**20

_MAX_SHOWN = 5
_BREAK = re.compile(r"\r\n|\r|\n")
_MICROMETRE = re.compile(r"\b(?:um|micromet(?:er|re)s?|microns?)\b|[µμ]m\b", re.IGNORECASE)
_NANOMETRE = re.compile(r"\b(?:nm|nanomet(?:er|re)s?)\b", re.IGNORECASE)
PERCENT = re.compile(r"percent|%", re.IGNORECASE)
_OTHER_QUANTITY = re.compile(r"radianc\w*|transmi|emissiv|absorb|\bcounts?\b|\bDN\b", re.IGNORECASE)
_OTHER = re.compile(r"\b(?:wave ?numbers?|cm\^?-1|1/cm|angstroms?|[GT]Hz)\b", re.IGNORECASE)
#: Depth of the oxygen band at 760 nm, relative to its lower shoulder [1], from which values look like
#: radiance or irradiance: sunlight has 0.5 to 0.9 at bandwidths of 1 to 5 nm and 0.2 at 15 nm; in thirty real
#: libraries of reflectance the maximum is 0.023.
_MIN_OXYGEN_DEPTH = 0.1
#: Maximum spacing of wavelengths at which this depth is judged [nm].
_OXYGEN_STEP_NM = 6.0
#: Maximum median ratio of a third column to the second [1] by which a third column without a heading is a
#: standard deviation. A real lawn has 0.2. Two paints below this ratio need headings.
_MAX_SPREAD_RATIO = 0.5
#: Maximum share of wavelengths that occur again in rows that are not adjacent [1], by which they come from
#: overlapping detectors: 0.002 in exports of SVC; two spectra, one below the other, have 0.5.
_MAX_REPEATS = 0.05
_NO_SPREAD, _IS_SPREAD = -1, -2
_SAY_SO = "pass quantity='reflectance' if the values are reflectance"

_SPREAD = re.compile(
    r"(?<![a-z])(?:standard[ _.-]?dev\w*|st\.? ?dev\w*|std(?:ev|dev)?|s\.?d\.?|sigma|stdv|1s)(?![a-z])", re.I
)
_STATISTIC = re.compile(
    r"(?<![a-z])(?:variance|var|uncertaint\w*|unc|errors?|std ?err\w*|sem|cov|snr|flags?|qc|weights?|"
    r"n ?(?:obs|spectra|samples)?|number)(?![a-z])",
    re.I,
)
_IN_FULL = re.compile(r"standard[ _.-]?dev|st\.? ?dev|std[ _.-]?dev", re.I)
_MEAN = re.compile(r"(?<![a-z])(?:mean|average|avg|reflectance|reflectivity|refl|of|the)(?![a-z])", re.I)
_OF_LIGHT = re.compile(
    r"(?<![a-z])[mµμun]?W(?:att)?s?[ */.·]*(?:c?m\^?-?\(?-?2|/ ?c?m)|/ ?sr\b|\bsr\^?-1", re.I
)
_COUNTED = re.compile(r"irrad|digital (?:number|count)s?|photons?\b|volts?\b", re.I)
_TITLE = re.compile(r"irradianc\w*|radianc\w*|transmittance|absorbance|emissivity", re.I)

_MAX_PREAMBLE = 500
#: Headings that do not name a paint.
_GENERIC = re.compile(r"|r|rho|y|values?|.*(?:reflect|average|mean).*", re.IGNORECASE)

#: Units in headings are removed from names of paints, which are paired with references by name.
_UNIT = re.compile(r"\s*[(\[]\s*(?:%|per ?cent|fraction|-|1)\s*[)\]]\s*$", re.IGNORECASE)
#: Separators and decimal marks of tables, by preference; "" for blanks, True for decimal commas.
_DIALECTS = (("\t", False), (";", False), (",", False), ("", False), ("\t", True), (";", True), ("", True))

#: Keys of a header of ECOSTRESS, in file order.
_KEYS = (
    "Name",
    "Type",
    "Class",
    "Subclass",
    "Genus",
    "Species",
    "Particle Size",
    "Sample No.",
    "Owner",
    "Wavelength Range",
    "Origin",
    "Collection Date",
    "Description",
    "Measurement",
    "First Column",
    "Second Column",
    "X Units",
    "Y Units",
    "First X Value",
    "Last X Value",
    "Number of X Values",
    "Additional Information",
)
#: Opens the additional information of files that hyperpaint 0.1 and 0.2 wrote; JSON follows.
_METADATA = "hyperpaint metadata "

_KEY = re.compile(rf"\s*({'|'.join(map(re.escape, _KEYS))})\s*:(.*)", re.IGNORECASE)
_SPELLED = {key.lower(): key for key in _KEYS}
_ABOUT_THE_AXES = _KEYS[_KEYS.index("First Column") :]
_FRACTION = re.compile(r"fraction|unitless|decimal|\b0 ?(?:-|to) ?1\b|\(1\)", re.IGNORECASE)

_RECORD = re.compile(r"\s*(\S{1,40})\s+Record\s*=\s*(\d{1,9})\s*:(.*)$", re.IGNORECASE)
_MEASUREMENT = re.compile(r"[A-Z]{4}")
_AXIS = re.compile(r"\s*\S{1,40}\s+Record\s*=\s*\d{1,9}\s*:\s*(?:wave|bandpass|resolution|fwhm)", re.I)
_SPECTROMETERS = ("BECK", "NIC4", "AVIRIS", "ASD")
_MAX_CANDIDATES = 64
#: Number of folders that are searched for wavelengths, from that of the spectrum upwards.
_FOLDERS = 3


def is_ecostress(head: str) -> bool:
    # Return whether a text begins as a file of the ECOSTRESS or ASTER library.
    return re.match(r"\s*Name\s*:", head) is not None and "Number of X Values" in head


def is_usgs(head: str) -> bool:
    # Return whether the first line of a text is that of a USGS spectrum.
    return _RECORD.match(head.partition("\n")[0]) is not None


def is_usgs_axis(head: str) -> bool:
    # Return whether the first line of a text is that of USGS wavelengths or bandwidths.
    return _AXIS.match(head.partition("\n")[0]) is not None


# --- plain tables ------------------------------------------------------------------------------------------


def read_plain_table(
    path: Path, *, scale: float | None = None, wavelength: Floats | None = None, is_reflectance: bool = False
) -> Spectra:
    # Read spectra from a table of two or more columns.
    # Cells are separated by commas, semicolons, tabs or blanks; decimal commas are read where commas are not
    # the separator. Lines above the numbers are headings, the last of them names the columns; lines that
    # begin with ``#`` are comments. A single spectrum with a general heading such as "reflectance" gets the
    # name of the file. A column whose heading says so is the standard deviation of the column before it.
    # scale: Stored value of a reflectance of one; by default 100 if the headings say percent, else 1.
    # wavelength: Wavelengths in place of the first column [nm]. is_reflectance: Whether the values are
    # reflectance, without a check of headings and values. Raises FormatError: There is no table of numbers,
    # its first column is not wavelengths, or the values are not reflectance. Warns PaintWarning: Successive
    # rows have the same wavelength; or the values of a column look like a standard deviation.
    source = path.name
    lines = _lines(path, "a table of wavelengths and reflectance")
    without_comments = ["" if line.lstrip().startswith("#") else line for line in lines]
    text_lines = [at for at, line in enumerate(without_comments) if line.strip()]
    for first, following in itertools.pairwise(text_lines[: _MAX_PREAMBLE + 1]):
        rows = {dialect: row for dialect in _DIALECTS if (row := _cells(lines[first], dialect)) is not None}
        # the dialect in which the next line has as many columns, else the first, with which the next line is
        # reported later
        fitting = (d for d, row in rows.items() if len(_cells(lines[following], d) or ()) == len(row))
        if rows:
            dialect = next(fitting, next(iter(rows)))
            break
    else:
        raise FormatError(
            f"{source}: no table of numbers",
            expected="a wavelength and one or more values a line",
            code="table-missing",
        )
    columns = len(rows[dialect])
    table = _table(without_comments, first, columns, source, lambda line: _cells(line, dialect))
    if columns > 2 and np.isnan(table[:, -1]).all():  # every line ends with a separator
        table, columns = table[:, :-1], columns - 1
    # the first column changes direction where detectors join, and not more often
    steps = np.diff(table[:, 0])
    reversals = min(int((steps < 0).sum()), int((steps > 0).sum()))
    if np.isnan(table[:, 0]).any() or reversals > max(4, steps.size // 20) or not steps.any():
        raise FormatError(
            f"{source}: the first column rises and falls",
            expected="wavelengths",
            mend="write every spectrum as a column",
            code="wavelength-unordered",
        )
    preamble = lines[:first]
    headings = _headings(preamble, dialect[0], columns)
    if not is_reflectance:
        _check_words(preamble, headings, source)
    percent = 100.0 if PERCENT.search(preamble[-1] if preamble else "") else None
    nm, values, notes = _axis_and_values(table, " ".join(preamble), source, wavelength)
    spread = _spread_columns(headings, values.T, source, is_reflectance=is_reflectance)
    paints = np.flatnonzero(spread != _IS_SPREAD)
    # names from headings, without units where they stay distinct
    names = [headings[at + 1].strip() for at in paints.tolist()] if headings else [""] * paints.size
    without_units = [_UNIT.sub("", name) for name in names]
    if len(set(without_units)) == len(set(names)):
        names = without_units
    if paints.size == 1 and _GENERIC.fullmatch(names[0]):
        names = [path.stem]
    further = {}
    reflectance = reflectances(
        values.T[paints], source, file_scale=percent, scale=scale, is_reflectance=is_reflectance
    )
    if (spread >= 0).any():
        sd = reflectances(values.T[spread[paints]], source, file_scale=percent or 1.0, scale=scale)
        further["reflectance_sd"] = np.where(spread[paints, None] >= 0, sd, np.float32(np.nan))
    return Spectra(
        source=source,
        form="table of text",
        names=[name or f"column {at + 2}" for at, name in zip(paints, names, strict=True)],
        wavelength=nm,
        reflectance=reflectance,
        others=further,
        notes=notes,
    )


def _cells(line: str, dialect: tuple[str, bool]) -> list[float] | None:
    # Numbers of a line; None for other lines, and for an empty first cell
    separator, has_commas = dialect
    cells = line.strip(" ").split(separator or None)
    if len(cells) < 2 or not cells[0].strip():
        return None
    return numbers(cell.replace(",", ".") if has_commas else cell for cell in cells)


def _headings(preamble: Sequence[str], separator: str, columns: int) -> list[str]:
    # Cells of the last heading; empty where they are not as many as columns
    line = next((line for line in reversed(preamble) if line.strip()), "")
    is_comment = line.lstrip().startswith("#")
    text = line.strip().lstrip("#")
    # commas may separate headings in a comment where another mark separates numbers
    for mark in [separator, ","] if is_comment else [separator]:
        try:
            cells = next(csv.reader([text], delimiter=mark)) if mark else text.split()
        except csv.Error:
            continue
        if len(cells) == columns + 1 and not cells[-1].strip():
            cells.pop()
        if len(cells) == columns or (len(cells) > columns and is_comment and mark):
            return cells[:columns]
    return []


def _check_words(preamble: Sequence[str], headings: Sequence[str], source: str) -> None:
    # Check that the headings and units of a table do not name another quantity than reflectance.
    # preamble: Lines above the numbers; headings: names of all columns, or none.
    # Raises FormatError: A heading names radiance, irradiance, counts, transmittance or a statistic; or the
    # lines above name such a quantity and not reflectance.
    def foreign(text: str) -> str:
        # Word or unit of another quantity than reflectance, empty if there is none
        match = None if "reflect" in text.lower() else _OF_LIGHT.search(text) or _COUNTED.search(text)
        return other_quantity(text) or (match[0].strip() if match else "")

    named = [name.strip() for name in headings[1:] if foreign(name) or _STATISTIC.fullmatch(name.strip())]
    if named:
        raise FormatError(
            f"{source}: column headings name {', '.join(map(repr, named[:5]))}",
            expected="reflectance",
            mend=f"remove these columns, or {_SAY_SO}",
            code="quantity-wrong",
        )
    text = " ".join(preamble)
    title = None if "reflect" in text.lower() else _TITLE.search(text) or _OF_LIGHT.search(text)
    if word := foreign(preamble[-1] if preamble else "") or (title[0] if title else ""):
        raise FormatError(
            f"{source}: the heading names {word!r}",
            expected="reflectance",
            mend=_SAY_SO,
            code="quantity-wrong",
        )


def _spread_columns(headings: Sequence[str], values: Floats, source: str, *, is_reflectance: bool) -> Ints:
    # Return for each column the index of its standard deviation, `_NO_SPREAD`, or `_IS_SPREAD`.
    # headings: Names of the columns, wavelengths first; empty for a file without headings. values: (column,
    # band). is_reflectance: Whether columns without headings are reflectance, without a check of their
    # values.
    # Raises FormatError: The heading of the first spectrum is a standard deviation. Warns PaintWarning: There
    # are three columns without headings, and the third looks like the standard deviation of the second.
    roles = np.full(len(values), _NO_SPREAD)
    if headings:
        # names without units and words for mean and standard deviation: letters and digits
        paints = [
            "".join(filter(str.isalnum, _MEAN.sub(" ", _SPREAD.sub(" ", heading.lower()))))
            for heading in headings[1:]
        ]
        names_spread = np.array([_SPREAD.search(heading) is not None for heading in headings[1:]])
        mean_paints = [paint for paint, spread in zip(paints, names_spread, strict=True) if not spread]
        # "White Std" may be the name of a paint: it is a spread only beside a column "White"
        in_words = [_IN_FULL.search(heading) is not None for heading in headings[1:]]
        is_spread = names_spread & np.array(
            [word or not paint or paint in mean_paints for word, paint in zip(in_words, paints, strict=True)]
        )
        if is_spread[0]:
            raise FormatError(
                f"{source}: the first spectrum is named {headings[1].strip()!r}",
                expected="reflectance before its standard deviation",
                code="column-order",
            )
        roles[is_spread] = _IS_SPREAD
        spectra = np.flatnonzero(~is_spread)
        for at in np.flatnonzero(is_spread):
            of_same_paint = [int(column) for column in spectra if paints[at] and paints[column] == paints[at]]
            mean = of_same_paint[0] if of_same_paint else spectra[spectra < at][-1]
            roles[mean] = at if roles[mean] == _NO_SPREAD else roles[mean]
    elif len(values) == 2 and not is_reflectance:
        mean, deviation = values
        comparable = np.isfinite(mean) & np.isfinite(deviation) & (mean > 0)
        ratios = deviation[comparable] / mean[comparable]
        if ratios.size and (ratios >= 0).all() and np.median(ratios) <= _MAX_SPREAD_RATIO:
            text = (
                f"{source}: three columns without headings; the third is taken for the standard deviation of "
                "the second; add headings, or pass quantity='reflectance' if the third is a paint"
            )
            warn_user(text, "spread-assumed")
            roles[:] = 1, _IS_SPREAD
    return roles


def _without_repeats(wavelength: Floats, values: Floats, source: str) -> tuple[Ints, Floats, list[str]]:
    # Return rows of distinct wavelengths, their values (band, spectrum), and notes.
    # Of successive equal wavelengths the first row is kept; different values are averaged.
    # Raises FormatError: Many wavelengths occur again in rows that are not adjacent, as of two spectra one
    # below the other. Warns PaintWarning: Values were averaged.
    starts = np.flatnonzero(np.diff(wavelength, prepend=np.nan) != 0)  # first rows of equal wavelengths
    distant_share = 1.0 - np.unique(wavelength[starts]).size / starts.size
    adjacent = wavelength.size - starts.size
    if distant_share > _MAX_REPEATS or 2 * adjacent >= wavelength.size:
        repeats = wavelength.size - np.unique(wavelength).size
        raise FormatError(
            f"{source}: {repeats} of {wavelength.size} wavelengths occur twice",
            expected="one row per wavelength, and one column per spectrum",
            mend="put spectra side by side, or write wavelengths with more digits",
            code="wavelength-duplicate",
        )
    if not adjacent:
        return starts, values, []
    counts = np.diff(np.append(starts, wavelength.size))
    means = np.add.reduceat(values, starts, axis=0) / counts[:, None]
    difference = 2.0 * float(np.nanmax(np.abs(values - np.repeat(means, counts, axis=0)), initial=0.0))
    example = wavelength[starts[counts > 1][0]]
    text = f"{adjacent} wavelengths are equal to that of the row before, such as {example:g}"
    if difference <= 1e-12 * float(np.nanmax(np.abs(values), initial=0.0)):
        return starts, values[starts], [f"{text}: one of the equal rows is kept"]
    text = f"{text}: their values, which differ by up to {difference:.3g}, are averaged"
    warn_user(f"{source}: {text}", "wavelength-duplicate")
    return starts, means, [text]


def warn_of_light(wavelength: Floats, reflectance: Floats32, source: str) -> None:
    # Warn of spectra with the oxygen band of sunlight, which reflectance does not have.
    # wavelength: (band,) [nm]; reflectance: (signature, band) [1].
    # Warns PaintWarning: A spectrum has the band.
    order = np.argsort(wavelength, kind="stable")
    nm, values = wavelength[order], reflectance[:, order].astype(np.float64)
    left, inside, right = ((nm >= lo) & (nm <= hi) for lo, hi in ((745, 755), (757, 767), (771, 781)))
    near = nm[(nm >= 745) & (nm <= 781)]
    if not (left.any() and inside.any() and right.any()) or np.diff(near).max() > _OXYGEN_STEP_NM:
        return
    # the lower shoulder, since the reflectance of a paint that is black in the visible rises across the band
    shoulder = np.minimum(values[:, left].mean(axis=1), values[:, right].mean(axis=1))
    dip = shoulder - values[:, inside].min(axis=1)
    light = np.flatnonzero(dip > _MIN_OXYGEN_DEPTH * np.maximum(shoulder, 1e-6))
    if light.size:
        depth = dip[light[0]] / shoulder[light[0]] if shoulder[light[0]] > 0 else np.inf
        text = (
            f"{source}: {light.size} of {len(values)} spectra have the oxygen band of sunlight at 760 nm "
            f"({depth:.0%} deep), which reflectance does not have: are they radiance or irradiance? {_SAY_SO}"
        )
        warn_user(text, "sunlight-in-reflectance")


# --- ECOSTRESS and ASTER -----------------------------------------------------------------------------------


def read_ecostress(path: Path, *, scale: float | None = None, wavelength: Floats | None = None) -> Spectra:
    # Read a spectrum of the ECOSTRESS or ASTER library.
    # scale: y of a reflectance of one, where the file does not state it. wavelength: To be used in place of
    # the file's own [nm]. Raises FormatError: The header or the numbers are damaged, or the values are not
    # reflectance.
    source = path.name
    lines = _lines(path, "a spectrum of the ECOSTRESS or ASTER library")
    # the header: values of ASTER files wrap
    parts: dict[str, list[str]] = {}
    current, is_wrapped = "", False
    for first, line in enumerate(lines):
        match = _KEY.match(line)
        if match and _SPELLED[match[1].lower()] not in parts:
            current = _SPELLED[match[1].lower()]
            parts[current] = [match[2].strip()]
        elif "Number of X Values" in parts and len(numbers(line.split(None, 2)) or ()) == 2:
            break
        elif current and line.strip():
            parts[current].append(line.strip())
            is_wrapped = True
        elif line.strip():
            raise FormatError(
                f"{source}: line {first + 1} is {line.strip()[:60]!r}",
                expected="'Name: ...'",
                code="header-unreadable",
            )
    else:
        raise FormatError(f"{source}: no line of two numbers after the header", code="table-missing")
    fields = {key: " ".join(filter(None, texts)) for key, texts in parts.items()}
    problems = Problems(f"{source} cannot be used", FormatError)
    problems.extend(
        Problem(f"the header has no {key!r}", code="key-missing")
        for key in ("Name", "X Units", "Y Units", "Number of X Values")
        if key not in fields
    )
    units = fields.get("Y Units", "")
    file_scale = 100.0 if PERCENT.search(units) else 1.0 if _FRACTION.search(units) else None
    if other_quantity(units):
        problems.add(f"'Y Units' is {units[:60]!r}", expected="reflectance", code="quantity-wrong")
    problems.raise_if_any()
    table = _table(lines, first, 2, source)
    if (count := fields["Number of X Values"]) != str(len(table)):
        raise FormatError(
            f"{source}: {len(table)} values",
            expected=f"{count[:30]}, as the header says",
            mend="copy the file again",
            code="length-mismatch",
        )
    notes = []
    for key, actual in (("First X Value", table[0, 0]), ("Last X Value", table[-1, 0])):
        stated = number(fields.get(key, ""))
        # the header rounds
        if stated is not None and np.isfinite(stated) and abs(stated - actual) > 1e-2 * abs(actual):
            notes.append(f"{key!r} is {stated:g}, found {actual:g}")
    if np.isnan(table[:, 0]).any():
        raise FormatError(f"{source}: a wavelength is not a number", code="number-unreadable")
    nm, values, further_notes = _axis_and_values(table, fields["X Units"], source, wavelength)
    return Spectra(
        source=source,
        form=f"{'ASTER' if is_wrapped else 'ECOSTRESS'} library text",
        names=[fields["Name"]],
        wavelength=nm,
        reflectance=reflectances(values.T, source, file_scale=file_scale, scale=scale),
        columns=_columns(fields, source),
        notes=notes + further_notes,
    )


def _columns(fields: dict[str, str], source: str) -> dict[str, Any]:
    columns: dict[str, Any] = {
        re.sub(r"[^a-z]+", "_", key.lower()).strip("_"): text_column([fields[key]])
        for key in _KEYS[1:]
        if key in fields and key not in _ABOUT_THE_AXES
    }
    information = fields.get("Additional Information", "")
    if not information.startswith(_METADATA):
        return {**columns, "additional_information": text_column([information])} if information else columns
    # metadata of hyperpaint 0.1 and 0.2: names and values
    reserved = {*columns, SIGNATURE, "band", "wavelength", "reflectance"}
    name = "its JSON"
    try:
        for name, value in json.loads(information.removeprefix(_METADATA)).items():
            if not name.isidentifier() or name in reserved:
                raise ValueError("expected a new identifier")
            row = LIBRARY_VARIABLES.get(name)
            dtype = {str: "str", int: "int64", bool: "bool"}.get(type(value), "float64")
            is_known = row is not None and row.dims == (SIGNATURE,)
            columns[name] = typed_values([value], row.dtype if row is not None and is_known else dtype)
    except (ValueError, AttributeError, OverflowError, RecursionError) as error:
        raise FormatError(
            f"{source}: 'Additional Information' holds damaged metadata, {name[:60]!r} ({error!s:.100})",
            code="metadata-damaged",
        ) from error
    return columns


# --- USGS --------------------------------------------------------------------------------------------------


def read_usgs(
    path: Path, *, scale: float | None = None, wavelength: Floats | None = None, fwhm: Floats | None = None
) -> Spectra:
    # Read a spectrum of the USGS library.
    # scale: Stored value of a reflectance of one, 1 by default. wavelength, fwhm: Wavelengths and widths of
    # the bands [nm]; by default from files beside the spectrum, or in the two folders above it. Raises
    # FormatError: Lines are not numbers; the quantity is not reflectance; or no file of wavelengths is found.
    source = path.name
    title, values = _column(path)
    record = _RECORD.match(title)
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
    lines = _lines(path, "a file of the USGS spectral library")
    values = _table(lines, 1, 1, path.name)[:, 0]
    if values.size < 2:
        raise FormatError(
            f"{path.name}: {values.size} values",
            expected="a title and one value a line",
            code="table-missing",
        )
    return lines[0], values


def read_usgs_axis(path: Path) -> tuple[Floats, str]:
    # Return the wavelengths or bandwidths of a USGS file [nm], and a note on their units.
    # Raises FormatError: The file is damaged, or has other content.
    title, values = _column(path)
    if not np.isfinite(values).all():
        raise FormatError(f"{path.name}: not all of its {values.size} values are finite", code="not-finite")
    return _in_nanometres(title.replace("_", " "), values, path.name)


def _axis(path: Path, kind: str, count: int, spectrometer: str, notes: list[str]) -> Floats | None:
    # Wavelengths ("wave") or bandwidths from a file near a spectrum; None without a file of equal length
    words = ("wavelength",) if kind == "wave" else ("bandpass", "fwhm", "resolution")
    folder = path.absolute().parent
    candidates: list[Path] = []
    for searched in [folder, *folder.parents][:_FOLDERS]:
        with contextlib.suppress(OSError):
            for name in sorted(entry.name for entry in searched.iterdir()):
                # names of spectra convolved to another spectrometer contain "wavelength"
                is_axis = any(word in name.lower() for word in words) and name.lower().endswith(".txt")
                if is_axis and (kind == "wave" or "wavelength" not in name.lower()):
                    candidates.append(searched / name)
        if candidates:
            break
    axes = {}
    for file in candidates[:_MAX_CANDIDATES]:
        with contextlib.suppress(FormatError):
            values, note = read_usgs_axis(file)
            if values.size == count and file != path.absolute():
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


# --- lines, numbers, units ---------------------------------------------------------------------------------


def _lines(path: Path, expected: str) -> list[str]:
    # Return the lines of a text file, in UTF-8 or else latin-1.
    # Raises FormatError: The file cannot be read, is too large, or is binary.
    raw = read_limited_text(path, MAX_BYTES, expected)
    if b"\0" in raw:
        raise FormatError(
            f"{path}: holds NUL bytes",
            expected=expected,
            mend="save UTF-16 text as UTF-8",
            code="text-unreadable",
        )
    return _BREAK.split(decoded_text(raw))


def _table(
    lines: Sequence[str],
    first_line: int,
    columns: int,
    source: str,
    numbers_of: Callable[[str], list[float] | None] | None = None,
) -> Floats:
    # Return lines of numbers as an array (line, column); empty lines are skipped.
    # first_line: Index of the first line of numbers. columns: Number of columns. numbers_of: Function that
    # returns the numbers of a line, None for other text; by default numbers are separated by blanks. Raises
    # FormatError: Lines contain other text; the first of them are listed.
    problems = Problems(f"{source} cannot be read", FormatError)
    rows = []
    for at, line in enumerate(lines[first_line:], first_line + 1):
        if not line.strip():
            continue
        row = numbers_of(line) if numbers_of else numbers(line.split(None, columns))
        if row is None or len(row) != columns:
            problems.add(
                f"line {at}: {line.strip()[:60]!r}",
                expected=f"{columns} number{'s'[: columns - 1]}",
                code="row-unreadable",
            )
            if len(problems) == _MAX_SHOWN:
                break
        else:
            rows.append(np.array(row, np.float64))
    problems.raise_if_any()
    return np.array(rows, np.float64).reshape(-1, columns)


def other_quantity(text: str) -> str:
    # Return the word for another quantity than reflectance, empty if there is none.
    match = _OTHER_QUANTITY.search(text)
    return match[0] if match and "reflect" not in text.lower() else ""


def _in_nanometres(text: str, wavelength: Floats, source: str) -> tuple[Floats, str]:
    # Return wavelengths [nm], and a note if their unit is inferred.
    # text: Description of the wavelengths in the file; may be empty. wavelength: Wavelengths in the file's
    # unit. Raises FormatError: The text names another unit, such as wavenumbers.
    factor, note = 1.0, ""
    if _MICROMETRE.search(text):
        factor = 1e3
    elif not _NANOMETRE.search(text):
        if other_unit := _OTHER.search(text):
            raise FormatError(
                f"{source}: the unit of the first column is {other_unit[0]!r}",
                expected="nm or um",
                mend="pass wavelength=",
                code="units-unknown",
            )
        note = "no wavelength units: values taken as nanometres"
        if wavelength.size and float(np.nanmax(wavelength)) < 100.0:
            factor, note = 1e3, "no wavelength units: values below 100 taken as micrometres"
    with np.errstate(over="ignore"):  # overflow of a damaged file becomes infinity, a later error
        nanometres: Floats = wavelength * factor
    return nanometres, note


def _axis_and_values(
    table: Floats, text: str, source: str, wavelength: Floats | None
) -> tuple[Floats, Floats, list[str]]:
    # Wavelengths [nm], values (band, spectrum) and notes of a table whose first column is in the unit that
    # ``text`` names; ``wavelength``: from the caller, in place of that column [nm]
    axis, values = table[:, 0], table[:, 1:]
    if wavelength is not None:
        return wavelength, values, []
    nanometres, note = _in_nanometres(text, axis, source)
    starts, values, repeats = _without_repeats(axis, values, source)
    return nanometres[starts], values, [*([note] if note else []), *repeats]
