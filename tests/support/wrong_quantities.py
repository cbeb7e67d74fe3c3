"""Judges what is said of inputs that are something else than they are taken for."""

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hyperpaint.base.errors import PaintError

NM = np.arange(400.0, 1001.0, 2.0)
"""Wavelengths of small spectra [nm]."""


class Case(NamedTuple):
    # An input that is not what it is taken for, and words that must be in what is said of it
    name: str
    opened: Callable[[Path], Any]
    words: str  # regular expression


def objection(opened: Callable[[Path], Any], folder: Path) -> str:
    # Return how an input is refused or warned of; empty where it passes in silence
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            opened(folder)
        except PaintError as error:
            return f"refused: {error}"
    return "".join(f"warned: {one.message}\n" for one in caught)


def remarks(opened: Callable[[Path], Any], folder: Path) -> list[str]:
    # Return every warning of an input that is right; its errors are raised
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        opened(folder)
    return [str(one.message) for one in caught]


def sunlight(nm: Any = NM) -> Any:
    # Return something like global irradiance [W m-2 nm-1]: a smooth sun with the oxygen band at 760 nm
    band = 1.0 - 0.6 * np.exp(-0.5 * ((nm - 761.0) / 2.5) ** 2)
    return 1.5 * np.exp(-(((nm - 520.0) / 420.0) ** 2)) * band


def table(path: Path, *columns: Any, heading: str = "", separator: str = ",") -> Path:
    # Write columns of numbers as text below a heading
    rows = (separator.join(f"{value:.7g}" for value in row) for row in zip(*columns, strict=True))
    path.write_text("\n".join([*([heading] if heading else []), *rows]) + "\n")
    return path
