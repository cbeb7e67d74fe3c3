"""Integers are counts of a flight line where their header, a dark or the user says so."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.headwall_flights import BANDS, LINES, open_line, write_cube

from hyperpaint.base.errors import FormatError

WORDLESS = {"description": "{hood}"}


def _rewrite(folder: Path, counts: np.ndarray[Any, Any], **fields: str) -> None:
    write_cube(folder / "flight", "raw_0", counts, **{**WORDLESS, **fields})


def test_a_dark_says_that_integers_are_counts(folder: Path, counts: np.ndarray[Any, Any]) -> None:
    _rewrite(folder, counts)
    write_cube(folder / "dark", "raw_0", np.full_like(counts, 100), **WORDLESS)
    line = open_line(folder)
    np.testing.assert_array_equal(line["counts"].values, counts)
    assert float(line["dark_counts"].mean()) == 100


@pytest.mark.parametrize("said", [{"quantity": "counts", "dark": "none"}, {"dark": "none"}])
def test_so_does_the_user(folder: Path, counts: np.ndarray[Any, Any], said: dict[str, Any]) -> None:
    _rewrite(folder, counts)
    assert open_line(folder, **said)["counts"].shape == counts.shape


def test_otherwise_they_are_refused_with_the_ways_out(folder: Path, counts: np.ndarray[Any, Any]) -> None:
    _rewrite(folder, counts)
    with pytest.raises(FormatError, match="quantity-ambiguous"):
        open_line(folder, dark=None)


@pytest.mark.parametrize("said", [{}, {"quantity": "radiance"}])
def test_integers_with_units_of_radiance_are_no_counts(
    folder: Path, counts: np.ndarray[Any, Any], said: dict[str, Any]
) -> None:
    # Rationale: a vendor's radiance in integers opened as counts, and its units were of no account
    _rewrite(folder, counts)
    said = {"radiance_units": "uW m-2 sr-1 nm-1", "dark": None, "calibration": None, **said}
    line = open_line(folder, **said, fwhm_nm=6.0)
    assert "counts" not in line
    assert line["radiance"].shape == (LINES, BANDS, counts.shape[2])
    np.testing.assert_allclose(line["radiance"].values[3, 1, 2], counts[3, 1, 2] * 1e-6, rtol=1e-6)


def test_a_dark_that_is_radiance_is_refused(folder: Path, counts: np.ndarray[Any, Any]) -> None:
    write_cube(folder / "dark", "raw_0", counts, description="{[HEADWALL Hyperspec III],RADIANCE}")
    with pytest.raises(FormatError, match="counts-missing"):
        open_line(folder)


def test_what_the_user_says_against_the_header_is_refused(folder: Path) -> None:
    with pytest.raises(FormatError, match=r"header.* counts"):
        open_line(folder, quantity="radiance", radiance_units="W m-2 sr-1 nm-1")
