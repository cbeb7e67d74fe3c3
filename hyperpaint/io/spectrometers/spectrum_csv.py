"""One spectrum in a text file, a wavelength and a value a line; also certificates of white panels."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
import xarray as xr

from hyperpaint.base.errors import FormatError, Problems
from hyperpaint.base.schema import VARIABLES
from hyperpaint.base.units import conversion_factor, is_unit
from hyperpaint.io.files.reading import numbers, read_limited_text

_MAX_BYTES = 16 << 20
_MAX_SHOWN = 5
_WAVELENGTH_RANGE_NM = (100.0, 100_000.0)  # nm


def read_spectrum_csv(
    path: str | Path, headings: int = 1
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Read a spectrum: lines of wavelength [nm] and value, separated by a comma, semicolon, tab or blanks.

    Ignores empty lines, lines that begin with ``#``, and headings before the first numbers.

    headings: Number of lines at the top that may be headings.
    Returns wavelength, value : numpy.ndarray: float64, shape (wavelength,).
    Raises FormatError: A line is not two numbers, wavelengths do not increase or are not in nanometres, or
        there are fewer than two lines; the first problems are listed.
    """
    wavelength, values, _ = _table(Path(path), headings)
    return wavelength, values


def _table(
    path: Path, headings: int, *, has_units: bool = False
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64], list[str]]:
    # Return both columns, the wavelengths in nanometres, and the headings above them.
    # has_units: Whether the headings, and the comments above the numbers, may contain units.
    problems = Problems(f"{path} cannot be used as a spectrum", FormatError)
    rows: list[list[float]] = []
    headings_above: list[str] = []
    comments: list[str] = []
    text = read_limited_text(path, _MAX_BYTES, "a spectrum of two columns").decode("utf-8", "replace")
    for line_number, line in enumerate(text.splitlines(), 1):
        content = line.strip().lstrip("\ufeff")
        if not content or content.startswith("#"):
            if content and not rows:
                comments.append(content)
            continue
        row = numbers(content.replace(",", " ").replace(";", " ").split())
        if row is not None and len(row) == 2:
            rows.append(row)
        elif rows or line_number > headings:
            problems.add(
                f"line {line_number}: {content[:60]!r}",
                expected="a wavelength [nm] and a value",
                code="row-unreadable",
            )
            if len(problems) == _MAX_SHOWN:
                problems.raise_if_any()
        else:
            headings_above.append(content)
    table = np.array(rows, dtype=np.float64).reshape(-1, 2)
    if has_units:
        headings_above = [*comments, *headings_above]
        table[:, 0] *= _factor(headings_above, 0, path)
    wavelength, values = table.T.copy()
    if len(rows) < 2:
        problems.add(f"{len(rows)} lines of numbers", expected="at least two", code="table-missing")
    elif not (np.isfinite(table).all() and (np.diff(wavelength) > 0).all()):
        problems.add(
            "wavelengths do not increase from line to line, or a value is not finite",
            code="wavelength-unordered",
        )
    elif not _WAVELENGTH_RANGE_NM[0] <= wavelength[0] <= wavelength[-1] <= _WAVELENGTH_RANGE_NM[1]:
        problems.add(
            f"wavelengths from {wavelength[0]:g} to {wavelength[-1]:g}",
            expected="nanometres",
            code="wavelength-range",
        )
    problems.raise_if_any()
    return wavelength, values, headings_above


_LENGTHS = {
    **dict.fromkeys(("nm", "nanometer", "nanometers", "nanometre", "nanometres"), "nm"),
    **dict.fromkeys(("um", "µm", "μm", "micron", "microns", "micrometer", "micrometers"), "um"),
    **dict.fromkeys(("micrometre", "micrometres"), "um"),
    **dict.fromkeys(("angstrom", "angstroms", "å", "a"), "angstrom"),
    **{name: name for name in ("mm", "cm", "m")},
}
_SHARES = {
    **dict.fromkeys(("%", "percent", "per cent", "pct"), "percent"),
    **dict.fromkeys(("1", "-", "fraction", "unitless", "dimensionless", "ratio", "decimal"), "1"),
}
_UNITS = ("nm", _LENGTHS), ("1", _SHARES)
_BRACKETS = re.compile(r"[\[(]([^\[\]()]*)[\])]")
_UNIT_AT_END = re.compile(
    r"/ *([^ /\d]+)$|(?:^|[ _,])(nm|um|µm|μm|percent|per cent|pct)$|(?<!\d)(?<!\d )(%)$"
)
_PERCENT = re.compile(r"(?<!\d)(?<!\d )(?:%|\bper ?cent\b)", re.IGNORECASE)
_WAVELENGTH = re.compile(r"(?:cent(?:er|re|ral) |band )?(?:wave ?lengths?|wvl?|wl|lambda|λ)?(?: in)?[ _/,:]*")
_UNCERTAINTY_WORDS = re.compile(r"uncert|error|deviation|\bstd\b|\bsd\b")


def _factor(headings: Sequence[str], column: int, path: Path) -> float:
    # Return the factor from the unit in a column's headings to nm or to a fraction; 1 without a unit.
    base_unit, unit_names = _UNITS[column]
    units: dict[str, str] = {}
    for heading in headings:
        for name in _units_in_heading(heading, column, is_last=heading == headings[-1]):
            unit = unit_names.get(name.lower())
            if unit is not None:
                units[unit] = name
            elif is_unit(name):
                raise FormatError(
                    f"{path}: heading {heading[:60]!r} contains {name!r:.40}",
                    expected=f"a unit such as {base_unit!r}",
                    mend="correct the heading",
                    code="units-unknown",
                )
    if len(units) > 1:
        names = " and ".join(map(repr, units.values()))
        raise FormatError(
            f"{path}: headings contain {names} for one column",
            expected="one unit",
            mend="correct the headings",
            code="units-conflict",
        )
    percent = next((heading for heading in headings if _PERCENT.search(" ".join(heading.split()))), None)
    if column == 1 and not units and percent is not None:
        raise FormatError(
            f"{path}: {percent[:60]!r} contains percent, but does not state the column",
            mend=("write [%] or [1] after the name of the values, such as 'wavelength [nm],reflectance [%]'"),
            code="units-ambiguous",
        )
    return conversion_factor(next(iter(units), base_unit), base_unit)


def _units_in_heading(heading: str, column: int, is_last: bool) -> list[str]:
    # Return the texts of a two-column heading that may be the unit of a column: in brackets, or at the end.
    is_comment, text = heading.startswith("#"), heading.lstrip("# \t").replace('"', " ")
    # replace brackets by NUL, so that separators within them split no cell; their texts are units or labels
    bracket_texts = _BRACKETS.findall(text)
    text = re.sub(r" *\x00", "\x00", _BRACKETS.sub("\x00", text.replace("\x00", " ")))
    separator = next((separator for separator in (";", "\t", ",", "  ") if separator in text.strip()), None)
    cells = [cell.strip() for cell in text.strip().split(separator, 1)]
    if (
        separator in (None, "  ")
        and len(cells) == 2
        and cells[1].startswith(("nm ", "um ", "µm ", "μm ", "/"))
    ):
        cells = [f"{cells[0]} {cells[1].split(None, 1)[0]}", "".join(cells[1].split(None, 1)[1:])]
    if len(cells) != 2:
        return []
    texts_by_column: list[list[str]] = []
    for cell in cells:
        cell_units = [bracket_texts.pop(0).strip() for _ in range(cell.count("\x00"))]
        unit_at_end = _UNIT_AT_END.search(" ".join(cell.replace("\x00", " ").split()))
        texts_by_column.append(
            [
                *cell_units,
                *([] if unit_at_end is None else [unit_at_end[1] or unit_at_end[2] or unit_at_end[3]]),
            ]
        )
    cell_words = [
        " ".join(_UNIT_AT_END.sub("", cell.replace("\x00", " ").strip()).split()).lower() for cell in cells
    ]
    is_column_heading = bool(_WAVELENGTH.fullmatch(cell_words[0])) and (
        cell_words[0] != "" or bool(texts_by_column[0])
    )
    if _UNCERTAINTY_WORDS.search(cell_words[1]) or not (is_column_heading or (is_last and not is_comment)):
        return []
    return [re.sub(r"^in ", "", " ".join(unit.split())) for unit in texts_by_column[column]]


_MAX_HEADING_LINES = 40
_MAX_PANEL_REFLECTANCE = 1.2  # of a diffuse panel, as a fraction


def read_certificate(path: str | os.PathLike[str]) -> xr.DataArray:
    r"""Read the certificate of a white panel: lines of wavelength [nm] and reflectance.

    Parameters
    ----------
    path
        Text of two columns, separated by a comma, semicolon, tab or blanks, below up to 40 lines of headings.
        Units in headings and comments, ``Wavelength [um];R [%]``, are converted; other
        text in brackets, ``R (8/h)``, is a label.

    Returns
    -------
    (wavelength,), float64
        Reflectance factor of the panel [1].

    Raises
    ------
    FormatError
        The file is not such a table, a heading contains a unit of another dimension, or values are not
        fractions; percent without a heading that says so is refused.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp(), "panel.csv")
    >>> _ = path.write_text("Diffuse target;95 %\nnm;R\n400;0.981\n450;0.985\n")
    >>> read_certificate(path).values
    array([0.981, 0.985])
    """
    path = Path(path)
    wavelength, values, headings = _table(path, _MAX_HEADING_LINES, has_units=True)
    values = values * _factor(headings, 1, path)
    if not ((values > 0.0) & (values <= _MAX_PANEL_REFLECTANCE)).all():
        raise FormatError(
            f"{path}: values from {values.min():g} to {values.max():g}",
            expected="reflectance as a fraction",
            mend="divide percent by 100",
            code="scale-missing",
        )
    attrs = {**VARIABLES["wavelength"].attrs, "long_name": "Wavelength of the certificate"}
    return xr.DataArray(
        values,
        dims="wavelength",
        coords={"wavelength": ("wavelength", wavelength, attrs)},
        name="reflectance",
        attrs={"units": "1", "long_name": "Reflectance factor of the panel", "source": path.name},
    )
