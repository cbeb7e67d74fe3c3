"""One spectrum in a text file: a wavelength and a value a line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from hyperpaint.base.errors import FormatError, Problems
from hyperpaint.io.files.reading import read_limited_text

__all__ = ["read_spectrum_csv"]

_MAX_BYTES = 16 << 20
_MOST_SHOWN = 5
_WAVELENGTHS = (100.0, 100_000.0)  # nm


def read_spectrum_csv(
    path: str | Path, headings: int = 1
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Read a spectrum: lines of wavelength [nm] and value, separated by a comma, semicolon, tab or blanks.

    Lines that are empty or begin with ``#`` are passed over, and so are headings before the first numbers.

    Parameters
    ----------
    path
        The file.
    headings
        Lines at the top that may be headings.

    Returns
    -------
    wavelength, value : numpy.ndarray
        float64, shape (wavelength,).

    Raises
    ------
    FormatError
        A line is not two numbers, wavelengths do not increase or are none in nanometres, or there are fewer
        than two lines; the first problems are listed.
    """
    path = Path(path)
    problems = Problems(f"{path} is no spectrum", FormatError)
    rows: list[tuple[float, float]] = []
    text = read_limited_text(path, _MAX_BYTES, "a spectrum of two columns").decode("utf-8", "replace")
    for number, line in enumerate(text.splitlines(), 1):
        content = line.strip().lstrip("\ufeff")
        if not content or content.startswith("#"):
            continue
        row = _numbers(content)
        if row is not None:
            rows.append(row)
        elif rows or number > headings:
            problems.add(f"line {number}: {content[:60]!r}, expected a wavelength [nm] and a value")
            if len(problems) == _MOST_SHOWN:
                problems.raise_if_any()
    found = np.array(rows, dtype=np.float64).reshape(-1, 2)
    wavelength, values = found[:, 0].copy(), found[:, 1].copy()
    if len(rows) < 2:
        problems.add(f"{len(rows)} lines of numbers, expected two at least")
    elif not (np.isfinite(found).all() and (np.diff(wavelength) > 0).all()):
        problems.add("wavelengths do not increase from line to line, or a value is not finite")
    elif not _WAVELENGTHS[0] <= wavelength[0] <= wavelength[-1] <= _WAVELENGTHS[1]:
        problems.add(f"wavelengths from {wavelength[0]:g} to {wavelength[-1]:g}, expected nanometres")
    problems.raise_if_any()
    return wavelength, values


def _numbers(line: str) -> tuple[float, float] | None:
    parts = line.replace(",", " ").replace(";", " ").split()
    if len(parts) != 2:
        return None
    try:
        return float(parts[0]), float(parts[1])
    except ValueError:
        return None
