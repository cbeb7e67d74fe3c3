"""Tables of other programs: the role and unit of every column, by its own heading."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.refusals import expect_errors
from support.wrong_quantities import remarks

import hyperpaint as hp
from hyperpaint.base.errors import FormatError

NM = np.arange(400, 1001, 10)
A, B = np.linspace(0.2, 0.4, 61), np.linspace(0.5, 0.3, 61)
ROW = np.arange(61)


def written(path: Path, heading: str, *columns: Any, mark: str = ",", end: str = "") -> Path:
    rows = (mark.join(f"{value:.6g}" for value in row) + end for row in zip(*columns, strict=True))
    path.write_text("\n".join([*([heading] if heading else []), *rows]) + "\n", encoding="utf-8")
    return path


# heading, columns, options of `written`, and the names of the signatures
READ: dict[str, tuple[str, tuple[Any, ...], dict[str, str], list[str]]] = {
    "band number, um": ("band,wavelength_um,reflectance", (ROW + 101, NM / 1e3, A), {}, ["x"]),
    "pandas index": (",wavelength,a", (ROW, NM, A), {}, ["a"]),
    "unnamed index": ("Unnamed: 0,wl,a,b", (ROW, NM, A, B), {}, ["a", "b"]),
    "channel from 1, tabs": ("Ch\tnm\ta", (ROW + 1, NM, A), {"mark": "\t"}, ["a"]),
    "index, no headings": ("", (ROW, NM, A), {}, ["x"]),
    "wavelength last": ("a,b,wavelength (nm)", (A, B, NM), {}, ["a", "b"]),
    "two empty cells": ("Wavelength (nm)\ta\tb", (NM, A, B), {"mark": "\t", "end": "\t\t"}, ["a", "b"]),
    "three empty cells, head too": ("nm;a;b;;;", (NM, A, B), {"mark": ";", "end": ";;;"}, ["a", "b"]),
    "nm and um": ("nm,um,a", (NM, NM / 1e3, A), {}, ["a"]),
    "an axis beside every one": ("nm,a,nm,b", (NM, A, NM, B), {}, ["a", "b"]),
    "per cent of one column": ("nm,a (%),b", (NM, 100 * A, B), {}, ["a", "b"]),
    "pct of one column": ("nm,a,b_pct", (NM, A, 100 * B), {}, ["a", "b_pct"]),
    "spread without its unit": ("nm,a (%),std", (NM, 100 * A, 3 + 0 * A), {}, ["a"]),
    "row of units": ("Wavelength,a,b\nµm,%,1", (NM / 1e3, 100 * A, B), {}, ["a", "b"]),
    "grains in um": ("# grain size 20 um\nwavelength (nm),a", (NM, A), {}, ["a"]),
    "width of bands": ("wavelength (um),fwhm (nm),a", (NM / 1e3, 0 * NM + 12, A), {}, ["a"]),
    "angstrom": ("Wavelength (Angstrom),a", (NM * 10.0, A), {}, ["a"]),
}


@pytest.mark.parametrize("case", READ)
def test_columns_are_read_by_their_headings(case: str, tmp_path: Path) -> None:
    heading, columns, form, names = READ[case]
    path = written(tmp_path / "x.csv", heading, *columns, **form)
    assert remarks(lambda _: hp.open_library(path), tmp_path) == []
    library = hp.open_library(path)
    assert library["signature"].values.tolist() == names
    np.testing.assert_allclose(library["wavelength"].values, NM, rtol=1e-6)
    np.testing.assert_allclose(library["reflectance"].values, [A, B][: len(names)], rtol=1e-5)
    if "fwhm" in heading:
        np.testing.assert_allclose(library["fwhm"].values, 12.0)
    if "std" in heading:
        np.testing.assert_allclose(library["reflectance_sd"].values, 0.03, rtol=1e-5)


LAMP = 0.4 * np.exp(-(((NM - 560) / 40) ** 2)) + 0.01


@pytest.mark.parametrize(
    ("heading", "columns", "code"),
    [
        ('"FILE:SHOP3"\n"REM: CEILING LAMP (QNTM)"\n"INT:  1NM"', (NM, LAMP), "quantity-wrong"),
        ("# photon flux of a lamp\nnm,value", (NM, LAMP), "quantity-wrong"),
        ("nm,umol m-2 s-1 nm-1", (NM, LAMP), "quantity-wrong"),
        ("# PPFD, growth chamber\nnm,chamber 1", (NM, LAMP), "quantity-wrong"),
        ("nm,µE/m²/s", (NM, LAMP), "quantity-wrong"),
        ("nm,a,wavelength,b", (NM, A, NM + 5, B), "grid-mismatch"),
        ("sample,wavelength,a", (ROW % 7, NM, A), "column-unknown"),
        ("nm,a,solar zenith", (NM, A, 0 * NM + 30), "scale-missing"),
    ],
)
def test_columns_that_are_no_reflectance_are_refused(
    heading: str, columns: tuple[Any, ...], code: str, tmp_path: Path
) -> None:
    path = written(tmp_path / "x.csv", heading, *columns)
    expect_errors((FormatError, code, lambda: hp.open_library(path)))


@pytest.mark.parametrize("name", ["Std", "SD", "St. Dev.", "Variance", "N"])
def test_statistics_of_a_spectrometers_table_are_no_spectra(name: str, tmp_path: Path) -> None:
    path = written(tmp_path / "s.csv", f"Wavelength,Reflectance,{name}", NM, A, 0 * A + 0.01)
    with pytest.warns(hp.errors.PaintWarning, match="columns-left-out"):
        opened = hp.open_asd(path, quantity="reflectance")
    assert opened.sizes["spectrum"] == 1
    np.testing.assert_allclose(opened["reflectance"].values[0], A, rtol=1e-5)
