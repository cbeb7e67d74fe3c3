"""Irradiance series as comma-separated values."""

from __future__ import annotations

import datetime as dt
import math
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from hyperpaint.base.errors import FormatError
from hyperpaint.io.files.reading import read_limited_text

__all__ = ["IrradianceTable", "is_irradiance_csv", "read_irradiance_csv"]

_LARGEST_FILE = 2**30
_YEARS = range(1970, 2200)  # datetime64[ns] would wrap around in silence from 2262 on


@dataclass(frozen=True, eq=False)
class IrradianceTable:
    """What one file holds.

    Attributes
    ----------
    name
        File name without its folder.
    times
        (sample), with a zone where the file gives one.
    lines
        (sample), line numbers in the file.
    wavelength
        (wavelength) [nm].
    values
        (sample, wavelength), NaN where a cell is empty.
    units, fwhm_nm
        As the comments say, or None.
    """

    name: str
    times: tuple[dt.datetime, ...]
    lines: tuple[int, ...]
    wavelength: npt.NDArray[np.float64]
    values: npt.NDArray[np.float64]
    units: str | None
    fwhm_nm: float | None


def is_irradiance_csv(head: bytes) -> bool:
    """Tell from its first bytes whether a file is such a table."""
    lines = head.decode("utf-8-sig", "replace").splitlines()
    first = next((line for line in lines if line.strip() and not line.startswith("#")), "")
    return first.split(",")[0].strip().strip('"').lower() == "time"


def read_irradiance_csv(path: str | os.PathLike[str]) -> IrradianceTable:
    r"""Read an irradiance series from comma-separated values.

    The layout: comments ``# units: W m-2 nm-1`` and ``# fwhm_nm: 3`` (both may be missing), a header ``time``
    with the wavelengths in nanometres, then a row a sample that begins with an ISO 8601 stamp, with a zone
    (``2024-05-21T12:00:00.5Z``) or, all of them, without.

    Parameters
    ----------
    path
        The file.

    Returns
    -------
    IrradianceTable
        Values (sample, wavelength) and what the comments say.

    Raises
    ------
    FormatError
        The file cannot be read, or its header or rows are not as above.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp(), "sky.csv")
    >>> _ = path.write_text("# units: W m-2 nm-1\ntime,550,551\n2024-05-21T12:00:00Z,0.89,0.9\n")
    >>> table = read_irradiance_csv(path)
    >>> table.units, table.values
    ('W m-2 nm-1', array([[0.89, 0.9 ]]))
    """
    path = Path(path)
    data = read_limited_text(path, _LARGEST_FILE, "an irradiance series (a longer one fits Zarr)")
    text = data.decode("utf-8-sig", errors="replace")
    return _parse(path.name, text.replace("\r\n", "\n").replace("\r", "\n"))


def _parse(name: str, text: str) -> IrradianceTable:
    comments: dict[str, str] = {}
    rows: list[tuple[int, list[str]]] = []
    for number, line in enumerate(text.split("\n"), start=1):
        if line.startswith("#"):
            key, _, value = line[1:].partition(":")
            comments[key.strip().lower()] = value.strip()
        elif line.strip():
            rows.append((number, [cell.strip().strip('"') for cell in line.strip().split(",")]))
    if not rows or rows[0][1][0].lower() != "time":
        raise FormatError(f"{name}: no header 'time,<wavelength>,...': not an irradiance series")
    wavelength = _wavelength(name, rows[0][1][1:])
    if len(rows) < 2:
        raise FormatError(
            f"{name}: no rows under the header; expected a time and {len(wavelength)} values in each"
        )
    times, values = [], np.empty((len(rows) - 1, len(wavelength)))
    for index, (number, cells) in enumerate(rows[1:]):
        try:
            times.append(_time(cells[0]))
            if len(cells) != len(wavelength) + 1:
                raise ValueError(f"{len(cells) - 1} values")
            values[index] = [float(cell) if cell else math.nan for cell in cells[1:]]
        except (ValueError, OverflowError) as error:
            raise FormatError(
                f"{name}: line {number} cannot be read ({error}); expected an ISO 8601 time such as "
                f"2024-05-21T12:00:00Z and {len(wavelength)} numbers"
            ) from error
    if len({time.tzinfo is None for time in times}) > 1:
        raise FormatError(f"{name}: some stamps have a zone and some have not; give it to all or to none")
    lines = tuple(number for number, _ in rows[1:])
    return IrradianceTable(
        name, tuple(times), lines, wavelength, values, comments.get("units"), _width(name, comments)
    )


def _wavelength(name: str, cells: list[str]) -> npt.NDArray[np.float64]:
    try:
        made = np.array([float(cell) for cell in cells], np.float64)
    except ValueError as error:
        raise FormatError(
            f"{name}: the header cannot be read ({error}); expected 'time' and wavelengths in nm"
        ) from error
    if not (len(made) and np.all(np.isfinite(made)) and np.all(made > 0) and np.all(np.diff(made) > 0)):
        raise FormatError(f"{name}: the wavelengths in the header must be positive and increase")
    return made


def _time(cell: str) -> dt.datetime:
    made = dt.datetime.fromisoformat(cell)
    if made.year not in _YEARS:
        raise ValueError(f"the year {made.year} lies outside {_YEARS.start} to {_YEARS.stop - 1}")
    return made


def _width(name: str, comments: dict[str, str]) -> float | None:
    if "fwhm_nm" not in comments:
        return None
    try:
        made = float(comments["fwhm_nm"])
    except ValueError:
        made = math.nan
    if not 0 < made < math.inf:
        raise FormatError(f"{name}: '# fwhm_nm: {comments['fwhm_nm'][:40]}', expected a positive number")
    return made
