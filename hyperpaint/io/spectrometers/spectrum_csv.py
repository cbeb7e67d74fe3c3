"""One spectrum in a text file, a wavelength and a value a line; also the certificate of a white panel."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from hyperpaint.base.errors import FormatError, Problems, UnitsError
from hyperpaint.base.schema import VARIABLES
from hyperpaint.base.units import conversion_factor
from hyperpaint.io.files.reading import numbers, read_limited_text

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["read_certificate", "read_spectrum_csv"]

_MAX_BYTES = 16 << 20
_MOST_SHOWN = 5
_WAVELENGTHS = (100.0, 100_000.0)  # nm


def read_spectrum_csv(
    path: str | Path, headings: int = 1
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Read a spectrum: lines of wavelength [nm] and value, separated by a comma, semicolon, tab or blanks.

    Lines that are empty or begin with ``#`` are passed over, and so are headings before the first numbers.

    headings: Lines at the top that may be headings.
    Returns wavelength, value : numpy.ndarray: float64, shape (wavelength,).
    Raises FormatError: A line is not two numbers, wavelengths do not increase or are none in nanometres, or
        there are fewer than two lines; the first problems are listed.
    """
    wavelength, values, _ = _table(Path(path), headings)
    return wavelength, values


def _table(
    path: Path, headings: int, *, in_units: bool = False
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64], list[str]]:
    """Return the columns of `read_spectrum_csv`, the first in nanometres, and the headings above them.

    in_units: Whether the last heading names a unit of the wavelengths.
    """
    problems = Problems(f"{path} is no spectrum", FormatError)
    rows: list[list[float]] = []
    above: list[str] = []
    text = read_limited_text(path, _MAX_BYTES, "a spectrum of two columns").decode("utf-8", "replace")
    for number, line in enumerate(text.splitlines(), 1):
        content = line.strip().lstrip("\ufeff")
        if not content or content.startswith("#"):
            continue
        row = numbers(content.replace(",", " ").replace(";", " ").split())
        if row is not None and len(row) == 2:
            rows.append(row)
        elif rows or number > headings:
            problems.add(f"line {number}: {content[:60]!r}, expected a wavelength [nm] and a value")
            if len(problems) == _MOST_SHOWN:
                problems.raise_if_any()
        else:
            above.append(content)
    table = np.array(rows, dtype=np.float64).reshape(-1, 2)
    if in_units:
        table[:, 0] *= _factor(above, 0, "nm", path)
    wavelength, values = table.T.copy()
    if len(rows) < 2:
        problems.add(f"{len(rows)} lines of numbers, expected two at least")
    elif not (np.isfinite(table).all() and (np.diff(wavelength) > 0).all()):
        problems.add("wavelengths do not increase from line to line, or a value is not finite")
    elif not _WAVELENGTHS[0] <= wavelength[0] <= wavelength[-1] <= _WAVELENGTHS[1]:
        problems.add(f"wavelengths from {wavelength[0]:g} to {wavelength[-1]:g}, expected nanometres")
    problems.raise_if_any()
    return wavelength, values, above


_UNIT = re.compile(r"[\[(]([^\[\]()]{1,40})[\])]$|(?:^|[ _])(nm|um|µm|μm|%|percent)$")


_PURE = ("", "-", "1", "fraction", "unitless")


def _factor(headings: Sequence[str], column: int, wanted: str, path: Path) -> float:
    """Return what turns a column into a unit, by the last heading above it; 1 where that says none."""
    cells = next((cells for text in headings[-1:] for cells in (_cells(text),) if len(cells) == 2), None)
    unit = None if cells is None else _UNIT.search(cells[column])
    name = "" if unit is None else str(unit[1] or unit[2]).strip()
    if name.lower() in _PURE:
        return 1.0
    try:
        return conversion_factor(name, wanted)
    except UnitsError as error:
        problem = f"{path}: heading {headings[-1][:60]!r} names {name!r}"
        raise FormatError(f"{problem}, expected a unit such as {wanted!r}; correct the heading") from error


def _cells(line: str) -> list[str]:
    """Return the cells of a heading, parted as numbers below it may be."""
    mark = next((mark for mark in (";", "\t", ",") if mark in line), None)
    return [cell.strip() for cell in (line.split(mark, 2) if mark else line.split(None, 2))]


_MAX_HEADING_LINES = 40
_MAX_PANEL_REFLECTANCE = 1.2  # of a diffuse panel, as a fraction


def read_certificate(path: str | os.PathLike[str]) -> xr.DataArray:
    r"""Read the certificate of a white panel: lines of wavelength [nm] and reflectance.

    Parameters
    ----------
    path
        Text of two columns, separated by a comma, semicolon, tab or blanks, below 40 lines of headings or
        less. Units that the last of these names, ``Wavelength [um];R [%]``, are converted.

    Returns
    -------
    (wavelength,), float64
        Reflectance factor of the panel [1].

    Raises
    ------
    FormatError
        The file is no such table, a heading names a unit of something else, or values are no fractions;
        percent that no heading names is refused rather than guessed.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp(), "panel.csv")
    >>> _ = path.write_text("Diffuse target;95 %\nnm;R\n400;0.981\n450;0.985\n")
    >>> read_certificate(path).values
    array([0.981, 0.985])
    """
    import xarray as xr

    path = Path(path)
    wavelength, values, headings = _table(path, _MAX_HEADING_LINES, in_units=True)
    values = values * _factor(headings, 1, "1", path)
    if not ((values > 0.0) & (values <= _MAX_PANEL_REFLECTANCE)).all():
        raise FormatError(
            f"{path}: values from {values.min():g} to {values.max():g}, expected reflectance as a fraction; "
            "divide percent by 100"
        )
    attrs = {**VARIABLES["wavelength"].attrs, "long_name": "Wavelength of the certificate"}
    return xr.DataArray(
        values,
        dims="wavelength",
        coords={"wavelength": ("wavelength", wavelength, attrs)},
        name="reflectance",
        attrs={"units": "1", "long_name": "Reflectance factor of the panel", "source": path.name},
    )
