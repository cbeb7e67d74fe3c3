"""Text tables of laboratories: spectra, certificates of white panels, calibrations of FRM4SOC."""

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base import (
    VARIABLES,
    Floats,
    FormatError,
    Problem,
    Problems,
    as_path,
    conversion_factor,
    is_unit,
)
from hyperpaint.io.files.reading import (
    TABLE_DIALECTS,
    cells_of,
    decoded_text,
    first_row,
    foreign_format,
    number,
    numbers,
    read_limited_text,
    refuse,
    row_numbers,
    table_of,
)
from hyperpaint.io.library.spectra_files import WAVENUMBER, foreign_quantity
from hyperpaint.io.spectrometers.spectrum_texts import SPREAD, STATISTIC

_MAX_BYTES = 16 << 20
_MAX_SHOWN = 5
_WAVELENGTH_RANGE_NM = (100.0, 100_000.0)  # nm


# --- spectra of two columns --------------------------------------------------------------------------------


def read_spectrum_csv(path: str | Path, headings: int = 1) -> tuple[Floats, Floats]:
    # Read a spectrum: lines of wavelength [nm] and value, separated by a comma, semicolon, tab or blanks,
    # with decimal points or commas; in ascending or descending order. Separators may differ from line to line
    # where numbers have decimal points.
    #
    # Ignores empty lines, lines that begin with ``#``, and headings before the first numbers.
    #
    # headings: Number of lines at the top that may be headings.
    # Returns wavelength, value : numpy.ndarray: float64, shape (wavelength,), in ascending order.
    # Raises FormatError: A line is not two numbers, wavelengths are not monotonic or not in nanometres, or
    #     there are fewer than two lines; the first problems are listed.
    wavelength, values, _ = _table(Path(path), headings)
    return wavelength, values


def _table(path: Path, headings: int, *, has_units: bool = False) -> tuple[Floats, Floats, list[str]]:
    # Return wavelengths [nm] and values, and the headings of these two columns.
    # has_units: Whether the headings, and the comments above the numbers, may contain units and name further
    #     columns, of uncertainties.
    with Problems(f"{path} cannot be used as a spectrum", FormatError) as problems:
        data = read_limited_text(path, _MAX_BYTES, "a spectrum of two columns")
        refuse(str(path), (True, foreign_format(path, is_binary=True)))
        lines = [line.strip() for line in decoded_text(data).splitlines()]
        _, dialect = first_row(["" if line.startswith("#") else line for line in lines]) or (0, (",", False))
        rows: list[list[float]] = []
        headings_above: list[str] = []
        comments: list[str] = []
        for line_number, content in enumerate(lines, 1):
            if not content or content.startswith("#"):
                comments += [content.rstrip(",; \t")] if content and not rows else []
                continue
            row = row_numbers(content, dialect)
            if row is None and not dialect[1]:
                row = next((r for d in TABLE_DIALECTS if not d[1] and (r := row_numbers(content, d))), None)
            if row is not None and len(row) == len(rows[0] if rows else row) and (has_units or len(row) == 2):
                rows.append(row)
            elif not rows and line_number <= headings:
                headings_above.append(content.rstrip(",; \t"))
            else:
                problems.add(
                    f"line {line_number}: {content[:60]!r}",
                    expected="a wavelength [nm] and a value",
                    code="row-unreadable",
                )
                if len(problems) == _MAX_SHOWN:
                    problems.raise_if_any()
        table = np.array(rows, dtype=np.float64).reshape(len(rows), len(rows[0]) if rows else 2)
        if has_units:
            while table.shape[1] > 2 and np.isnan(table[:, -1]).all():  # every line ends with separators
                table = table[:, :-1]
            # the column of reflectance, the only one that is no uncertainty, and the headings of two columns
            column, count, mark = 1, table.shape[1], dialect[0]
            if count > 2:
                cells = [
                    cells_of(line, mark) if mark else re.split(r" {2,}|\t", line) for line in headings_above
                ]
                cells = [line for line in cells if len(line) == count]
                columns = [
                    at
                    for at in range(1, count)
                    if cells and not any(_UNCERTAINTY_WORDS.search(line[at]) for line in cells)
                ]
                FormatError.raise_if(
                    len(columns) != 1,
                    f"{path}: {count} columns, of which {len(columns) or 'an unknown number'} may be "
                    "reflectance",
                    expected="wavelength, reflectance, and uncertainties under headings that say so",
                    mend="remove the others, or write headings such as 'nm,reflectance,uncertainty'",
                    code="column-ambiguous",
                )
                column = columns[0]
                headings_above = [f"{line[0].strip()}{mark or '  '}{line[column].strip()}" for line in cells]
            table = table[:, [0, column]]
            headings_above = [*comments, *headings_above]
            # "A" is the angstrom above numbers that are too large for nanometres, else the name of a column
            is_angstrom = (
                headings_above and re.match(r'"?[AÅ]\W', headings_above[-1]) and table[:, 0].min() > 2000.0
            )
            table[:, :1] *= 0.1 if is_angstrom else _factor(headings_above, 0, path)
        table = table.reshape(-1, 2)
        wavelength, values = (table[::-1] if len(rows) > 1 and table[0, 0] > table[-1, 0] else table).T.copy()
        first, last = (wavelength[0], wavelength[-1]) if rows else (0.0, 0.0)
        checks = (
            (
                len(rows) < 2,
                Problem(f"{len(rows)} lines of numbers", expected="at least two", code="table-missing"),
            ),
            (
                not (np.isfinite(table).all() and (np.diff(wavelength) > 0).all()),
                Problem(
                    "wavelengths do not increase or decrease throughout, or a value is not finite",
                    code="wavelength-unordered",
                ),
            ),
            (
                not _WAVELENGTH_RANGE_NM[0] <= first <= last <= _WAVELENGTH_RANGE_NM[1],
                Problem(
                    f"wavelengths from {first:g} to {last:g}", expected="nanometres", code="wavelength-range"
                ),
            ),
        )
        problems.extend([problem for is_wrong, problem in checks if is_wrong][:1])
    return wavelength, values, headings_above


# --- certificates of panels --------------------------------------------------------------------------------


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
    r"/ *([^ /\d]+)$|(?:^|[ _,])(nm|um|µm|μm|percent|per cent|pct)$|(?<!\d)(?<!\d )(%)$|^(%) ?(?=[a-zA-Z])"
)
_PERCENT = re.compile(r"(?<!\d)(?<!\d )(?:%|\bper ?cent\b)", re.IGNORECASE)
_WAVELENGTH = re.compile(r"(?:cent(?:er|re|ral) |band )?(?:wave ?lengths?|wvl?|wl|lambda|λ)?(?: in)?[ _/,:]*")
_UNCERTAINTY_WORDS = re.compile(rf"{STATISTIC.pattern}|{SPREAD.pattern}|error|deviation|\bstd", re.IGNORECASE)


def _factor(headings: Sequence[str], column: int, path: Path) -> float:
    # Return the factor from the unit in a column's headings to nm or to a fraction; 1 without a unit.
    base_unit, unit_names = _UNITS[column]
    names = [
        (heading, name)
        for heading in headings
        for name in _units_in_heading(heading, column, is_last=heading == headings[-1])
    ]
    units = {unit_names[name.lower()]: name for _, name in names if name.lower() in unit_names}
    others = (pair for pair in names if pair[1].lower() not in unit_names and is_unit(pair[1]))
    heading, other = next(others, ("", ""))
    percent = next((text for text in headings if _PERCENT.search(" ".join(text.split()))), "")
    refuse(
        str(path),
        (
            other,
            Problem(
                f"heading {heading[:60]!r} contains {other!r:.40}",
                expected=f"a unit such as {base_unit!r}",
                mend="correct the heading",
                code="units-unknown",
            ),
        ),
        (
            len(units) > 1,
            Problem(
                f"headings contain {' and '.join(map(repr, units.values()))} for one column",
                expected="one unit",
                mend="correct the headings",
                code="units-conflict",
            ),
        ),
        (
            column == 1 and not units and percent,
            Problem(
                f"{percent[:60]!r} contains percent, but does not state the column",
                mend=(
                    "write [%] or [1] after the name of the values, such as 'wavelength [nm],reflectance [%]'"
                ),
                code="units-ambiguous",
            ),
        ),
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
                *([] if unit_at_end is None else [unit_at_end[unit_at_end.lastindex or 0]]),
            ]
        )
    cell_words = [
        " ".join(_UNIT_AT_END.sub("", cell.replace("\x00", " ").strip()).split()).lower() for cell in cells
    ]
    if _UNCERTAINTY_WORDS.search(cell_words[1]) or not (
        (bool(_WAVELENGTH.fullmatch(cell_words[0])) and (cell_words[0] != "" or bool(texts_by_column[0])))
        or (is_last and not is_comment)
    ):
        return []
    return [re.sub(r"^in ", "", " ".join(unit.split())) for unit in texts_by_column[column]]


_MAX_HEADING_LINES = 40
_MAX_PANEL_REFLECTANCE = 1.2  # of a diffuse panel, as a fraction


def read_certificate(path: str | os.PathLike[str]) -> xr.DataArray:
    r"""Read the certificate of a white panel: lines of wavelength [nm] and reflectance.

    Parameters
    ----------
    path
        Text of two columns, separated by a comma, semicolon, tab or blanks, below up to 40 lines of headings;
        with decimal points or commas, wavelengths ascending or descending. Further columns need headings,
        and are uncertainties. Units in headings and comments, ``Wavelength [um];R [%]``, are converted; other
        text in brackets, ``R (8/h)``, is a label.

    Returns
    -------
    (wavelength,), float64
        Reflectance factor of the panel [1].

    Raises
    ------
    FormatError
        The file is not such a table, a heading contains another quantity or a unit of another dimension, or
        values are not fractions; percent without a heading that says so is refused, and fractions under
        percent.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp(), "panel.csv")
    >>> _ = path.write_text("Diffuse target;95 %\nnm;R\n400;0.981\n450;0.985\n")
    >>> read_certificate(path).values
    array([0.981, 0.985])
    """
    path = as_path(path)
    wavelength, values, headings = _table(path, _MAX_HEADING_LINES, has_units=True)
    factor = _factor(headings, 1, path)
    # the line of names; the lines above it may describe accessories
    named = [cell.strip() for line in headings[-1:] for cell in re.split(r"[;,\t]| {2,}", line.lstrip("#"))]
    refuse(
        str(path),
        (
            word := next(filter(None, map(foreign_quantity, named)), ""),
            Problem(f"the heading names {word!r}", expected="reflectance", code="quantity-wrong"),
        ),
        (
            unit := next(filter(None, map(WAVENUMBER.search, named[:1])), None),
            Problem(f"wavelengths under {unit and unit[0]!r}", expected="nm or um", code="units-unknown"),
        ),
    )
    FormatError.raise_if(
        factor < 1.0 and values.max() <= _MAX_PANEL_REFLECTANCE,
        f"{path}: values from {values.min():g} to {values.max():g} under a heading with %",
        expected="percent, or fractions",
        mend="write fractions, with [1] in place of %",
        code="units-conflict",
    )
    values = values * factor
    FormatError.raise_if(
        not ((values > 0.0) & (values <= _MAX_PANEL_REFLECTANCE)).all(),
        f"{path}: values from {values.min():g} to {values.max():g}",
        expected="reflectance as a fraction",
        mend="divide percent by 100",
        code="scale-missing",
    )
    return xr.DataArray(
        values,
        dims="wavelength",
        coords={
            "wavelength": (
                "wavelength",
                wavelength,
                {**VARIABLES["wavelength"].attrs, "long_name": "Wavelength of the certificate"},
            )
        },
        name="reflectance",
        attrs={"units": "1", "long_name": "Reflectance factor of the panel", "source": path.name},
    )


#: Directions of a table of a panel's factors [degree].
PANEL_DIRECTIONS = ("sun_zenith", "view_zenith", "relative_azimuth")


def read_panel_table(path: str | os.PathLike[str]) -> xr.DataArray:
    r"""Read measured factors of a panel by direction, for `hyperpaint.radiometry.panel_factor`.

    Parameters
    ----------
    path
        Text with a header line and cells separated by commas: ``factor``, the reflectance factor of the panel
        over its certificate [1], ``sun_zenith``, and optionally ``view_zenith``, ``relative_azimuth``
        [degree] and ``wavelength`` [nm], with one row for every combination of their values. A column that is
        left out has no influence on the factor. Lines that begin with ``#`` are ignored.

    Returns
    -------
    DataArray
        Factors, float64, with the columns as dimensions.

    Raises
    ------
    FormatError
        The file is not such a table, a combination is missing or occurs twice, or a value is out of range.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp(), "panel.csv")
    >>> _ = path.write_text("sun_zenith,factor\n30,1.04\n60,0.97\n")
    >>> read_panel_table(path).sel(sun_zenith=60.0).item()
    0.97
    """
    path = as_path(path)
    data = read_limited_text(path, _MAX_BYTES, "a table of a panel's factors")
    lines = [
        (at, [cell.strip() for cell in line.split(",")])
        for at, line in enumerate(decoded_text(data).splitlines(), 1)
        if line.strip() and not line.startswith("#")
    ]
    names = [name.lower() for name in lines[0][1]] if lines else []
    columns = ("factor", *PANEL_DIRECTIONS, "wavelength")
    FormatError.raise_if(
        not {"factor", "sun_zenith"} <= set(names) <= set(columns) or len(set(names)) != len(names),
        f"{path}: columns {', '.join(names)[:80] or 'none'}",
        expected=f"sun_zenith and factor, and optionally {', '.join(columns[2:])}",
        mend="write this header, and cells separated by commas",
        code="header-wrong",
    )
    table = table_of(path, names, lines[1:])
    values = {name: np.array(numbers(cells) or [np.nan]) for name, cells in table.columns.items()}
    with Problems(f"{path} cannot be used as a table of a panel's factors", FormatError) as problems:
        for name, least, most in (
            ("factor", 0.2, 5.0),
            *((direction, 0.0, 180.0 if "azimuth" in direction else 90.0) for direction in PANEL_DIRECTIONS),
            ("wavelength", *_WAVELENGTH_RANGE_NM),
        ):
            problems.add_if(
                name in values and not ((values[name] >= least) & (values[name] <= most)).all(),
                f"{name} has a value outside {least:g} to {most:g}, or not a number",
                expected="nm" if name == "wavelength" else "1" if name == "factor" else "degree",
                code="value-out-of-range",
            )
    factor = values.pop("factor")
    dims = [name for name in columns if name in values]
    axes, indices = zip(*(np.unique(values[dim], return_inverse=True) for dim in dims), strict=True)
    shape = tuple(len(axis) for axis in axes)
    flat = np.ravel_multi_index(indices, shape)
    FormatError.raise_if(
        factor.size != np.prod(shape) or np.unique(flat).size != factor.size,
        f"{path}: {np.unique(flat).size} different directions and wavelengths in {factor.size} rows",
        expected=f"one row for each of {np.prod(shape)} combinations",
        mend="add the missing rows, and delete repeated ones",
        code="grid-mismatch",
    )
    units = {name: {"units": "nm" if name == "wavelength" else "degree"} for name in dims}
    return xr.DataArray(
        factor[np.argsort(flat)].reshape(shape),
        {name: (name, axis, units[name]) for name, axis in zip(dims, axes, strict=True)},
        dims,
        "factor",
        {"units": "1", "long_name": "Reflectance factor of a panel over its certificate"},
    )


# --- radiometric calibrations of FRM4SOC -------------------------------------------------------------------


_MAX_ROWS = 100_000
#: Number of columns of each table, and the coordinate with its column of wavelengths [nm].
_TABLES = {
    "LAMPDATA": (4, "lamp_wavelength", 0),
    "PANELDATA": (4, "panel_wavelength", 0),
    "CALDATA": (10, "wavelength", 1),
}
#: Factor from an expanded uncertainty (k = 2) in percent to a standard uncertainty as a fraction.
_STANDARD_PER_EXPANDED_PERCENT = 1.0 / 200.0
#: Variables: table, column, factor to the units, units.
_COLUMNS: dict[str, tuple[str, Any, float, str]] = {
    "lamp_irradiance": ("LAMPDATA", 2, 1e-3, "W m-2 nm-1"),
    "lamp_irradiance_u": ("LAMPDATA", 3, _STANDARD_PER_EXPANDED_PERCENT, "1"),
    "panel_reflectance": ("PANELDATA", 2, 1.0, "1"),
    "panel_reflectance_u": ("PANELDATA", 3, _STANDARD_PER_EXPANDED_PERCENT, "1"),
    "coefficient": ("CALDATA", 2, 1.0, ""),
    "coefficient_u": ("CALDATA", 3, _STANDARD_PER_EXPANDED_PERCENT, "1"),
    "dark": ("CALDATA", 4, 1.0, "count"),
    "counts": ("CALDATA", [6, 8], 1.0, "count"),
}
#: Attributes by section of one line: texts, and numbers.
_TEXTS = {
    "DEVICE": "device",
    "CALDATE": "calibration_time",
    "CALLAB": "laboratory",
    "LAMP_ID": "lamp",
    "PANEL_ID": "panel",
}
_NUMBERS = {"AMBIENT_TEMP": "ambient_temperature_degC", "DEVICE_TEMP": "device_temperature_degC"}


def read_radcal(path: str | os.PathLike[str]) -> xr.Dataset:
    r"""Read a radiometric calibration of FRM4SOC: lamp, panel and coefficients of a spectrometer.

    Parameters
    ----------
    path
        Text file that begins with ``!FRM4SOC_CP`` and ``!RADCAL``, with sections ``[LAMPDATA]``,
        ``[PANELDATA]`` (not of sensors of irradiance) and ``[CALDATA]``, such as
        ``CP_SAT0385_RADCAL_20220606105303.TXT``.

    Returns
    -------
    xarray.Dataset
        ``lamp_irradiance`` (lamp_wavelength) [W m-2 nm-1] at the lamp's distance; with a panel,
        ``panel_reflectance``
        (panel_wavelength) [1]; ``panel_radiance`` (lamp_wavelength) [W m-2 sr-1 nm-1] of the panel under
        the lamp, NaN outside the wavelengths of its certificate; ``coefficient`` (wavelength), in units of
        the instrument's class, NaN where missing, ``dark`` and two series of ``counts`` (series,
        wavelength). The first two and the coefficient have a relative standard uncertainty each,
        ``..._u``, half of the file's value for k = 2. All float64. Attributes: device, time, laboratory,
        lamp, panel and temperatures.

    Raises
    ------
    FormatError
        The file is of another kind, or sections are missing or damaged; all problems are listed.

    Notes
    -----
    .. math:: L = E \rho / \pi

    of a panel of reflectance factor :math:`\rho` for 0 degrees to 45 under the lamp's irradiance :math:`E`.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> path = Path(tempfile.mkdtemp(), "radcal.txt")
    >>> _ = path.write_text('''!FRM4SOC_CP
    ... !RADCAL
    ... [DEVICE]
    ... X1
    ... [LAMPDATA]
    ... 400 0 2.0 1.0
    ... 500 0 4.0 1.0
    ... [END_OF_LAMPDATA]
    ... [PANELDATA]
    ... 400 0 0.99 1.2
    ... 500 0 0.99 1.2
    ... [END_OF_PANELDATA]
    ... [CALDATA]
    ... 0 0 1024 0 0 0 1024 0 512 0
    ... 1 400 1e-4 1.5 10 0 900 1 901 1
    ... 2 410 1e-4 1.5 10 0 950 1 951 1
    ... [END_OF_CALDATA]
    ... ''')
    >>> lamp = read_radcal(path)
    >>> lamp.panel_radiance.values.round(4), lamp.lamp_irradiance_u.values
    (array([0.0006, 0.0013]), array([0.005, 0.005]))
    """
    path = as_path(path)
    sections: dict[str, list[tuple[int, str]]] = {}
    for name, rows in _sections(path, "!RADCAL"):
        sections.setdefault(name, []).extend(rows)
    # sensors of irradiance are calibrated under the lamp, without a panel
    tables_of = {name: row for name, row in _TABLES.items() if name != "PANELDATA" or name in sections}
    with Problems(f"{path} cannot be used as a radiometric calibration", FormatError) as problems:
        tables: dict[str, Floats] = {}
        for name, (columns, _, nm_column) in tables_of.items():
            rows = sections.get(name, [])
            if len(rows) < 2 or f"END_OF_{name}" not in sections or len(rows) > _MAX_ROWS:
                problems.add(
                    f"[{name}] has {len(rows)} rows",
                    expected=f"at least two up to [END_OF_{name}]",
                    code="table-missing",
                )
                continue
            cells = [numbers(text.split()) for _, text in rows]
            wrong = (row for row, values in zip(rows, cells, strict=True) if len(values or ()) != columns)
            if (row := next(wrong, None)) is not None:
                problems.add(
                    f"line {row[0]}: {row[1][:60]!r}",
                    expected=f"{columns} numbers of [{name}]",
                    code="row-unreadable",
                )
                continue
            table = np.array(cells, np.float64)
            # the first row of this table holds integration times
            tables[name] = table[1:] if name == "CALDATA" else table
            problems.add_if(
                not np.isfinite(table).all() or (np.diff(tables[name][:, nm_column]) <= 0).any(),
                f"[{name}] has wavelengths that do not increase, or values that are not finite",
                code="wavelength-unordered",
            )
    data = xr.Dataset(
        coords={dim: (dim, tables[name][:, nm], {"units": "nm"}) for name, (_, dim, nm) in tables_of.items()}
    )
    for name, (table_name, column, factor, units) in _COLUMNS.items():
        if table_name not in tables:
            continue
        dim = _TABLES[table_name][1]
        values = tables[table_name][:, column].T * factor
        data[name] = (dim if values.ndim == 1 else ("series", dim), values, {"units": units} if units else {})
    # missing coefficients are 0
    has_coefficient = data["coefficient"] > 0
    for name in ("coefficient", "coefficient_u"):
        data[name] = data[name].where(has_coefficient)
    if "PANELDATA" in tables:
        lamp, panel = tables["LAMPDATA"], tables["PANELDATA"]
        reflectance = np.interp(lamp[:, 0], panel[:, 0], panel[:, 2], np.nan, np.nan)
        radiance = lamp[:, 2] * 1e-3 * reflectance / np.pi
        data["panel_radiance"] = ("lamp_wavelength", radiance, {"units": "W m-2 sr-1 nm-1"})
    texts = {key: sections[name][0][1] for name, key in _TEXTS.items() if sections.get(name)}
    values_by_key = {
        key: number(sections[name][0][1]) for name, key in _NUMBERS.items() if sections.get(name)
    }
    known = {key: value for key, value in values_by_key.items() if value is not None}
    return data.assign_attrs(texts | known | {"source": path.name})


def _sections(path: Path, kind: str) -> list[tuple[str, list[tuple[int, str]]]]:
    # Return the sections of a file of FRM4SOC in their order: name, and numbered lines without comments.
    # kind: Second line of the file. Raises FormatError: The file is of another kind.
    text = decoded_text(read_limited_text(path, _MAX_BYTES, "a calibration of FRM4SOC"))
    lines = [line.strip() for line in text.splitlines()]
    FormatError.raise_if(
        lines[:2] != ["!FRM4SOC_CP", kind],
        f"{path} begins with {' '.join(lines[:2])[:60]!r}",
        expected=f"!FRM4SOC_CP and {kind}",
        mend="read_radcal reads !RADCAL, read_angular_response reads !ANGDATA",
        code="format-unknown",
    )
    sections: list[tuple[str, list[tuple[int, str]]]] = [("", [])]
    for line_number, line in enumerate(lines, 1):
        if line.startswith("[") and line.endswith("]"):
            sections.append((line[1:-1].upper(), []))
        elif line and not line.startswith(("#", "!")):
            sections[-1][1].append((line_number, line))
    return sections


_ANGULAR = {"COSERROR": "cosine_error", "UNCERTAINTY": "cosine_error_u"}


def read_angular_response(path: str | os.PathLike[str]) -> xr.Dataset:
    r"""Read the angular response of an irradiance sensor from a file of FRM4SOC.

    Parameters
    ----------
    path
        Text file that begins with ``!FRM4SOC_CP`` and ``!ANGDATA``, with ``[AZIMUTH_ANGLE]``,
        ``[COLUMN_NAMES]``, ``[COSERROR]`` and ``[UNCERTAINTY]`` of each azimuth.

    Returns
    -------
    xarray.Dataset
        ``cosine_error`` (azimuth, wavelength, zenith) [1], float64: response over that of an ideal cosine
        receptor, minus 1; and its standard uncertainty ``cosine_error_u``, half of the file's value for
        k = 2. ``azimuth`` and ``zenith`` [degree], ``wavelength`` [nm]. Attributes: device, time, laboratory.

    Raises
    ------
    FormatError
        The file is of another kind, or its tables are damaged or differ in angles; all problems are listed.

    Examples
    --------
    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp(), "angular.txt")
    >>> names = "[COLUMN_NAMES]\npx wl\\angle -60 0 60\n"
    >>> table = "0 400 5 0 4\n1 410 6 0 4\n"
    >>> error = f"{names}[COSERROR]\n{table}[END_OF_COSERROR]\n"
    >>> u = f"{names}[UNCERTAINTY]\n{table}[END_OF_UNCERTAINTY]\n"
    >>> _ = path.write_text(f"!FRM4SOC_CP\n!ANGDATA\n[AZIMUTH_ANGLE]\n0\n{error}{u}")
    >>> float(read_angular_response(path)["cosine_error"].sel(azimuth=0, wavelength=410, zenith=-60))
    0.06
    """
    path = as_path(path)
    with Problems(f"{path} cannot be used as an angular response", FormatError) as problems:
        azimuths: list[float] = []
        zenith: list[float] | None = None
        axis: Floats | None = None
        tables: dict[str, list[Floats]] = {name: [] for name in _ANGULAR.values()}
        texts: dict[str, str] = {}
        for name, rows in _sections(path, "!ANGDATA"):
            if name in _TEXTS and rows:
                texts[_TEXTS[name]] = rows[0][1]
            elif name == "AZIMUTH_ANGLE" and rows and (angle := number(rows[0][1])) is not None:
                azimuths.append(angle)
            elif name == "COLUMN_NAMES" and rows:
                angles = numbers(rows[0][1].split()[2:])
                problems.add_if(
                    not angles or zenith not in (None, angles),
                    f"line {rows[0][0]}: {rows[0][1][:60]!r}",
                    expected="px, wl and the same angles in every table",
                    code="header-unreadable",
                )
                zenith = angles or zenith
            elif name in _ANGULAR:
                cells = [numbers(text.split()) for _, text in rows]
                count = len(zenith or ()) + 2
                wrong = next(
                    (n for (n, _), row in zip(rows, cells, strict=True) if len(row or ()) != count), None
                )
                if len(rows) < 2 or wrong is not None:
                    found = f"line {wrong}" if wrong is not None else f"[{name}] has {len(rows)} rows"
                    problems.add(found, expected=f"{count} numbers of [{name}]", code="row-unreadable")
                    continue
                table = np.array(cells, np.float64)
                axis = table[:, 1] if axis is None else axis
                problems.add_if(
                    not np.isfinite(table).all()
                    or not np.array_equal(table[:, 1], axis)
                    or (np.diff(axis) <= 0).any(),
                    f"[{name}] has wavelengths that do not increase or differ, or values that are not finite",
                    code="wavelength-unordered",
                )
                tables[_ANGULAR[name]].append(table[:, 2:])
        problems.add_if(
            not problems and (len({len(azimuths), *map(len, tables.values())}) > 1 or not azimuths),
            f"{len(azimuths)} azimuths, {' and '.join(f'{len(t)} of {n}' for n, t in tables.items())}",
            expected="[AZIMUTH_ANGLE], [COSERROR] and [UNCERTAINTY] of each",
            code="table-missing",
        )
    dims = ("azimuth", "wavelength", "zenith")
    scales = {"cosine_error": 1e-2, "cosine_error_u": _STANDARD_PER_EXPANDED_PERCENT}
    return xr.Dataset(
        {name: (dims, np.stack(t) * scales[name], {"units": "1"}) for name, t in tables.items()},
        coords={
            "azimuth": ("azimuth", np.array(azimuths), {"units": "degree"}),
            "wavelength": ("wavelength", axis, {"units": "nm"}),
            "zenith": ("zenith", np.array(zenith), {"units": "degree"}),
        },
        attrs=texts | {"source": path.name},
    )
