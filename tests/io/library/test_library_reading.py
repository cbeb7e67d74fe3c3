"""Files as programs write them, and what is wrong with others, said in a sentence."""

import contextlib
import csv
import importlib
import json
import os
import re
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import xarray as xr
from hypothesis import given, settings, strategies as st
from support import painted_lines
from support.files import write_file
from support.library_examples import NAMES, make_library
from support.refusals import expect_error, expect_errors, expect_refusals, expect_words
from support.wrong_quantities import NM, Case, objection, remarks, sunlight, table

import hyperpaint as hp
from hyperpaint.base.errors import FormatError, PaintWarning, SchemaError, StoreError
from hyperpaint.io.files import publishing
from hyperpaint.io.library import spectra_files
from hyperpaint.io.store.writer import MARK_TEXT

HEADER = """ENVI
samples = {samples}
lines = {lines}
bands = 1
data type = 4
interleave = bsq
byte order = 0
file type = ENVI Spectral Library
"""
SPECTRA_NAMES = "spectra names = {red, blue}\n"
NANOMETRES = "wavelength units = Nanometers\nwavelength = {450, 550, 650}\n"


def write_sli(folder: Path, rows: object, more: str) -> Path:
    values = np.asarray(rows, "<f4")
    values.tofile(folder / "x.sli")
    lines, samples = values.shape
    (folder / "x.hdr").write_text(HEADER.format(samples=samples, lines=lines) + more, encoding="utf-8")
    return folder / "x.sli"


def write_text(folder: Path, text: str, name: str = "red.txt", encoding: str = "utf-8") -> Path:
    return write_file(folder / name, text.encode(encoding))


ROWS = [[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]]


# --- ENVI ---


@pytest.mark.parametrize(
    ("more", "scale"),
    [
        ("reflectance scale factor = 10000\n", 1e4),
        ("z plot titles = {wavelength, reflectance [*10000]}\n", 1e4),
        ("z plot titles = {wavelength, reflectance (x 100)}\n", 100.0),
        ("z plot titles = {Wavelength, Reflectance (percent)}\n", 100.0),
        ("z plot titles = {Wavelength, Reflectance}\n", 1.0),
        ("z plot titles = {Wavelength, Reflectance (max 10)}\n", 1.0),
        ("", 1.0),
    ],
)
def test_sli__scale_of_the_header_or_the_plot_title(tmp_path: Path, more: str, scale: float) -> None:
    library = hp.open_library(write_sli(tmp_path, np.array(ROWS) * scale, SPECTRA_NAMES + NANOMETRES + more))
    np.testing.assert_allclose(library["reflectance"].values, ROWS, rtol=1e-6)
    assert library["signature"].values.tolist() == ["red", "blue"]


@pytest.mark.parametrize("unit", ["Micrometers", "um", "Unknown"])
def test_sli__micrometres(tmp_path: Path, unit: str) -> None:
    library = hp.open_library(
        write_sli(
            tmp_path, ROWS, SPECTRA_NAMES + f"wavelength units = {unit}\nwavelength = {{0.65, 0.55, 0.45}}\n"
        )
    )
    np.testing.assert_allclose(library["wavelength"].values, [650.0, 550.0, 450.0])
    assert ("micrometres" in library.attrs.get("notes", "")) == (unit == "Unknown")


@pytest.mark.parametrize(
    ("unit", "speed"), [("Wavenumber", 1e7), ("GHz", 299_792_458.0), ("MHz", 299_792_458e3)]
)
def test_sli__reciprocals_of_wavelength(tmp_path: Path, unit: str, speed: float) -> None:
    nm = np.array([650.0, 550.0, 450.0])
    lists = {"wavelength": speed / nm, "fwhm": speed / (nm - 2.5) - speed / (nm + 2.5)}
    text = "".join(f"{key} = {{{', '.join(map(repr, each.tolist()))}}}\n" for key, each in lists.items())
    library = hp.open_library(write_sli(tmp_path, ROWS, f"{SPECTRA_NAMES}wavelength units = {unit}\n{text}"))
    np.testing.assert_allclose(library["wavelength"].values, nm)
    np.testing.assert_allclose(library["fwhm"].values, 5.0, rtol=1e-4)


BAND_NUMBERS = SPECTRA_NAMES + "wavelength units = Index\nwavelength = {1, 2, 3}\n"
TITLE = "z plot titles = {wavelength, reflectance [*10000]}\n"


@pytest.mark.parametrize(
    ("factor", "more", "options", "code"),
    [
        (100, SPECTRA_NAMES + NANOMETRES, {}, "scale-missing"),
        (100, SPECTRA_NAMES + NANOMETRES, {"scale": -1}, "value-out-of-range"),
        (1e4, f"{SPECTRA_NAMES}{NANOMETRES}reflectance scale factor = 1\n{TITLE}", {}, "scale-conflict"),
        (1, BAND_NUMBERS, {}, "wavelength-missing"),
        (1, BAND_NUMBERS, {"wavelength": [450, 550]}, "length-mismatch"),
        (1, BAND_NUMBERS, {"wavelength": [[450, np.nan]]}, "value-out-of-range"),
        (1, f"{SPECTRA_NAMES}{NANOMETRES}z plot titles = {{Wavelength, Emissivity}}\n", {}, "quantity-wrong"),
    ],
)
def test_sli__what_is_unclear_is_refused(
    tmp_path: Path, factor: float, more: str, options: dict[str, Any], code: str
) -> None:
    expect_errors(
        (
            FormatError,
            code,
            lambda: hp.open_library(write_sli(tmp_path, np.array(ROWS) * factor, more), **options),
        )
    )


def test_sli__takes_the_scale_and_the_wavelengths_given(tmp_path: Path) -> None:
    given = hp.open_library(
        write_sli(tmp_path, np.array(ROWS) * 100, BAND_NUMBERS),
        scale=100, wavelength=[450, 550, 650], fwhm=np.full(3, 5.0),
    )  # fmt: skip
    np.testing.assert_allclose(given["reflectance"].values, ROWS, rtol=1e-6)
    assert given["wavelength"].values.tolist() == [450.0, 550.0, 650.0]
    assert given["fwhm"].values.tolist() == [5.0] * 3


def test_sli__wavelengths_and_bandwidths_as_records_alone(tmp_path: Path) -> None:
    # Rationale: a library of the USGS whose header lost its lists still has them in its first records.
    rows = [[0.45, 0.55, 0.65], [0.01, 0.011, 0.012], *ROWS, [0.001, -0.1, 0.003]]
    names = "Wavelengths in microns 3ch, Resolution in microns 3ch, red, blue, error bars to preceding"
    library = hp.open_library(write_sli(tmp_path, rows, f"spectra names = {{{names}}}\n"))
    np.testing.assert_allclose(library["wavelength"].values, [450, 550, 650], rtol=1e-6)
    np.testing.assert_allclose(library["fwhm"].values, [10, 11, 12], rtol=1e-6)
    assert library["signature"].values.tolist() == ["red", "blue"]
    np.testing.assert_allclose(
        library["reflectance_u_random"].values, [[np.nan] * 3, [0.001, np.nan, 0.003]], rtol=1e-6
    )


@pytest.mark.parametrize("names", ["", "spectra names = {red, matt, blue}\n", "spectra names = {red}\n"])
def test_sli__names_that_cannot_be_trusted_are_numbers(tmp_path: Path, names: str) -> None:
    with pytest.warns(PaintWarning, match="header-incomplete"):
        library = hp.open_library(write_sli(tmp_path, ROWS, names + NANOMETRES))
    assert library["signature"].values.tolist() == ["spectrum 1", "spectrum 2"]


def test_sli__bad_bands_are_not_good(tmp_path: Path) -> None:
    assert hp.open_library(write_sli(tmp_path, ROWS, SPECTRA_NAMES + NANOMETRES + "bbl = {1, 0, 1}\n"))[
        "good"
    ].values.tolist() == [True, False, True]


def test_sli__what_does_not_fit_is_listed(tmp_path: Path) -> None:
    path = write_sli(tmp_path, ROWS, SPECTRA_NAMES + NANOMETRES)
    header = path.with_suffix(".hdr")
    header.write_text(header.read_text().replace("bands = 1", "bands = 2"))
    path.write_bytes(path.read_bytes()[:-1])
    caught = expect_error(FormatError, None, lambda: hp.open_library(header))
    assert caught.codes == ("dims-wrong", "file-size")
    expect_words(str(caught), "bands is 2, expected 1", "23 bytes, expected 48")
    header.write_text(header.read_text().replace("Spectral Library", "Standard"))
    expect_refusals((FormatError, "length-mismatch", "wavelength", lambda: hp.open_library(header)))


# --- tables ---


@pytest.mark.parametrize(
    "text",
    [
        "nm,red,blue\n450,0.1,0.4\n550,0.2,0.5\n650,0.3,0.6\n",
        "wavelength [nm]\tred\tblue\n450\t0.1\t0.4\n550\t0.2\t0.5\n650\t0.3\t0.6\n",
        "a title\n\nnm;red;blue\r\n450;0,1;0,4\r\n550;0,2;0,5\r\n650;0,3;0,6\r\n\r\n",
        "# nm red blue\n450   0.1 0.4\n# detector 2\n550 2e-1  0.5\n650 0.3 0.6",
        "wavelength (um),red (%),blue (%)\n0.45,10,40\n0.55,20,50\n0.65,30,60\n",
        "wavelength (µm);red (percent);blue (percent)\n0,45;10;40\n0,55;20;50\n0,65;30;60\n",
        'nm,"red","blue",\n450,0.1,0.4,\n550,0.2,0.5,\n650,0.3,0.6,\n',
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8-sig", "latin-1"])
def test_tables__separators_units_and_headings(tmp_path: Path, text: str, encoding: str) -> None:
    library = hp.open_library(write_text(tmp_path, text, "both.csv", encoding))
    np.testing.assert_allclose(library["wavelength"].values, [450.0, 550.0, 650.0])
    np.testing.assert_allclose(library["reflectance"].values, ROWS, rtol=1e-6)
    assert library["signature"].values.tolist() == ["red", "blue"]


@pytest.mark.parametrize(
    ("text", "name", "expected"),
    [
        # units stay in names that would be alike
        ("nm,red (%),red (1)\n450,10,0.4\n550,20,0.5\n", "red.txt", ["red (%)", "red (1)"]),
        # one spectrum is named by its file or heading
        ("450,0.1\n550,0.2\n", "Grün 3.txt", ["Grün 3"]),
        ("nm,reflectance\n450,0.1\n550,0.2\n", "red.txt", ["red"]),
        ("nm,VW LA3G\n450,0.1\n550,0.2\n", "red.txt", ["VW LA3G"]),
    ],
)
def test_tables__names(tmp_path: Path, text: str, name: str, expected: list[str]) -> None:
    assert hp.open_library(write_text(tmp_path, text, name))["signature"].values.tolist() == expected


def test_tables__empty_cells_are_nan_and_wavelengths_may_fall(tmp_path: Path) -> None:
    library = hp.open_library(write_text(tmp_path, "nm,a,b\n650,0.3,\n550,,0.5\n450,nan,0.4\n"))
    assert library["wavelength"].values.tolist() == [650.0, 550.0, 450.0]
    np.testing.assert_array_equal(
        library["reflectance"].values, np.float32([[0.3, np.nan, np.nan], [np.nan, 0.5, 0.4]])
    )


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "table-missing"),
        ("hello\nworld\n", "table-missing"),
        ("450\n550\n650\n", "table-missing"),
        ("450,0.1,0.2\n550,0.2\n650,0.3\n", "line 2.*row-unreadable"),
        ("450,0.1\n550,0.2\nend of file\n650,0.3\n", "line 3.*row-unreadable"),
        ("450,0.1\n550,0.2\n650,0.3,0.4\n", "line 3.*row-unreadable"),
        ("450,0.1\n550,inf\n650,0.3\n", "line 2: '550,inf'"),
        ("450,0.1\n550,0.2\n650,0.3\n660,1_0\n670,1e400\n", "line 4.*row-unreadable"),
        ("450,10\n550,20\n650,30\n", "no scale.*scale=100"),
        ("nm,radiance\n450,0.1\n550,0.2\n", "'radiance'.*quantity-wrong"),
        ("cm-1,reflectance\n4500,0.1\n5500,0.2\n", "'cm-1'.*units-unknown"),
        ("450,0.1\n550,0.2\n" + 9000 * "\n" + "\0", "text-unreadable"),
        ("1,0.1\n2e9,0.2\n", "wavelength-range"),
        ("".join(f"{500 + (-1) ** at * at},0.1\n" for at in range(60)), "wavelength-unordered"),
    ],
)
def test_tables__what_is_none_is_refused(tmp_path: Path, text: str, said: str) -> None:
    expect_errors((FormatError, said, lambda: hp.open_library(write_text(tmp_path, text))))


# --- ECOSTRESS, ASTER, USGS ---

ECOSTRESS = """Name: red
Type: manmade
X Units: Wavelength (micrometer)
Y Units: Reflectance (percentage)
First X Value: 0.65
Last X Value: 0.45
Number of X Values: 3
Additional Information: none

0.65 30
0.55 20
0.45 10
"""


def test_ecostress__spellings_of_units(tmp_path: Path) -> None:
    library = hp.open_library(
        write_text(
            tmp_path,
            ECOSTRESS.replace(": none", ': hyperpaint metadata {"matt": true, "n": 7, "year": null}'),
        )
    )
    assert [library[name].item() for name in ("matt", "n")] == [True, 7]
    assert np.isnan(library["year"]).all()
    np.testing.assert_allclose(library["reflectance"].values, [[0.3, 0.2, 0.1]], rtol=1e-6)
    np.testing.assert_allclose(library["wavelength"].values, [650, 550, 450])
    library = hp.open_library(
        write_text(
            tmp_path,
            ECOSTRESS.replace("percentage", "fraction")
            .replace(" 30", " .3")
            .replace(" 20", " .2")
            .replace(" 10\n", " .1\n"),
        )
    )
    np.testing.assert_allclose(library["reflectance"].values, [[0.3, 0.2, 0.1]], rtol=1e-6)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("Number of X Values: 3", "Number of X Values: 4", "length-mismatch"),
        ("Reflectance (percentage)", "Transmittance (percent)", "expected reflectance"),
        ("(micrometer)", "(cm-1, wavenumber)", "units-unknown"),
        ("X Units", "Units of x", "key-missing"),
        ("0.55 20", "0.55 20 7", "line 11.*row-unreadable"),
        ("0.55 20", "nan 20", "number-unreadable"),
        (": none", ": hyperpaint metadata {", "damaged metadata"),
        (": none", ': hyperpaint metadata {"signature": "x"}', "metadata-damaged"),
        (": none", ': hyperpaint metadata {"n": "x"}', "'n'.*metadata-damaged"),
    ],
)
def test_ecostress__what_is_wrong_is_said(tmp_path: Path, old: str, new: str, said: str) -> None:
    expect_errors(
        (FormatError, said, lambda: hp.open_library(write_text(tmp_path, ECOSTRESS.replace(old, new))))
    )


def usgs(title: str, values: list[float]) -> str:
    return f" {title}\n" + "".join(f" {value:.7e}\n" for value in values)


def test_usgs__takes_the_wavelengths_of_its_spectrometer(tmp_path: Path) -> None:
    # Expected: those of the nearest folder, a chapter's own or above; of several, the spectrometer's.
    chapter = tmp_path / "ChapterA"
    chapter.mkdir()
    write_text(
        tmp_path,
        usgs("splib07a Record=1: Wavelengths ASD (microns)", [0.45, 0.55, 0.65]),
        "w_Wavelengths_ASD.txt",
    )
    write_text(
        tmp_path,
        usgs("splib07a Record=2: Wavelengths BECK (microns)", [0.4, 0.5, 0.6]),
        "w_Wavelengths_BECK.txt",
    )
    write_text(
        tmp_path, usgs("splib07a Record=3: Bandpass (FWHM) ASD (microns)", [0.01] * 3), "w_Bandpass_ASD.txt"
    )
    values = [0.1, -1.23e34, 0.3]
    library = hp.open_library(
        write_text(chapter, usgs("splib07a Record=9: Red paint GDS1 ASDFRa AREF", values), "a.txt")
    )
    assert library["wavelength"].values.tolist() == [450.0, 550.0, 650.0]
    assert (library["fwhm"].values.tolist(), library["signature"].item()) == ([10.0] * 3, "Red paint GDS1")
    np.testing.assert_array_equal(library["reflectance"].values, np.float32([[0.1, np.nan, 0.3]]))
    other = write_text(chapter, usgs("splib07a Record=9: Red paint XYZa AREF", values), "b.txt")
    expect_refusals(
        (
            FormatError,
            "wavelength-ambiguous",
            "w_Wavelengths_ASD.txt",
            "w_Wavelengths_BECK.txt",
            lambda: hp.open_library(other),
        ),
        (
            FormatError,
            "quantity-wrong",
            lambda: hp.open_library(
                write_text(chapter, usgs("splib07a Record=9: Glass NIC4a TRAN", values), "c.txt")
            ),
        ),
    )


# --- which files ---


def test_what_the_caller_says__is_never_passed_over(tmp_path: Path) -> None:
    library = hp.open_library(write_text(tmp_path, "450,0.1\n550,0.2\n"), fwhm=[5.0, 6.0])
    assert library["fwhm"].values.tolist() == [5.0, 6.0]
    for name in ("own.sli", "own.csv", "own.zarr"):
        own = hp.write_library(library, tmp_path / name)
        expect_error(FormatError, "option-conflict", partial(hp.open_library, own, scale=100))


def test_patterns__take_a_library_of_two_files_once(tmp_path: Path) -> None:
    path = write_sli(tmp_path, ROWS, SPECTRA_NAMES + NANOMETRES)
    (tmp_path / "x.csv").write_text("spectra names,kind\nred,car\nblue,van\n")
    table = write_text(tmp_path, "nm,grey\n450,0.1\n550,0.2\n650,0.3\n", "x-grey.csv")
    library = hp.open_library(str(tmp_path / "x*"))
    assert library["signature"].values.tolist() == ["red", "blue", "grey"]
    assert library["kind"].values.tolist() == ["car", "van", ""]
    assert library["file"].values.tolist() == [path.with_suffix(".hdr").name] * 2 + [table.name]


def test_several__a_width_of_one_file_is_left_out_and_said(tmp_path: Path) -> None:
    library = hp.open_library(
        [
            write_sli(tmp_path, ROWS, SPECTRA_NAMES + NANOMETRES + "fwhm = {5, 5, 5}\n"),
            write_text(tmp_path, "nm,grey\n450,0.1\n550,0.2\n650,0.3\n"),
        ]
    )
    assert "fwhm" not in library.variables
    assert "fwhm differs from file to file and is left out" in library.attrs["notes"]


def test_several__one_bad_file_is_an_error_that_names_it(tmp_path: Path) -> None:
    write_text(tmp_path, "450,0.1\n550,0.2\n", "a.txt")
    write_text(tmp_path, "nothing\n", "b.txt")
    expect_errors((FormatError, r"b.txt.*table-missing", lambda: hp.open_library(tmp_path)))


def test_several__are_in_the_order_of_their_numbers_with_all_that_they_say(tmp_path: Path) -> None:
    for number in (2, 10, 1):
        write_text(tmp_path, ECOSTRESS.replace("red", f"red {number}"), f"red{number}.txt")
    library = hp.open_library(
        [
            tmp_path,
            write_text(
                tmp_path / "..", "nm,reflectance\n650,0.3\n550,0.2\n450,0.1\n", f"{tmp_path.name}.csv"
            ),
        ]
    )
    assert library["signature"].values.tolist() == ["red 1", "red 2", "red 10", tmp_path.name]
    assert (library["type"].values.tolist(), library["reflectance"].shape) == (["manmade"] * 3 + [""], (4, 3))


@pytest.mark.parametrize("path", ["absent.sli", "absent.txt", "*.nothing", "folder", []])
def test_nothing_there__is_said(tmp_path: Path, path: str | list[str]) -> None:
    (tmp_path / "folder").mkdir()
    expect_errors(
        (
            FormatError,
            "file-not-found" if path else "empty-input",
            lambda: hp.open_library(str(tmp_path / path) if isinstance(path, str) else path),
        )
    )


def test_zarr__that_is_no_library_is_refused(tmp_path: Path) -> None:
    hp.to_store(xr.Dataset({"x": ("y", [1.0])}), tmp_path / "x.zarr")
    expect_errors((FormatError, "library-missing", lambda: hp.open_library(tmp_path / "x.zarr")))
    expect_error(StoreError, None, lambda: hp.open_library(tmp_path / "absent.zarr"))


# --- values that cannot be ---


def ecostress(x: list[float], y: list[float], units: str, x_units: str = "Wavelength (micrometers)") -> str:
    rows = "".join(f"{a:g}\t{b:g}\n" for a, b in zip(x, y, strict=True))
    return (
        f"Name: paint\nType: manmade\nX Units: {x_units}\nY Units: {units}\nFirst X Value: {x[0]:g}\n"
        f"Last X Value: {x[-1]:g}\nNumber of X Values: {len(x)}\nAdditional Information: none\n\n{rows}"
    )


def test_nanometres_that_are_called_micrometres_are_refused(tmp_path: Path) -> None:
    path = write_text(tmp_path, ecostress([400.0, 500.0, 590.0], [10.0] * 3, "Reflectance (percent)"))
    expect_errors((FormatError, "wavelength-range", lambda: hp.open_library(path)))
    assert hp.open_library(path, wavelength=[400, 500, 590])["wavelength"].values.tolist() == [400, 500, 590]
    assert (
        hp.open_library(
            write_text(
                tmp_path, ecostress([1.2, 20.0, 216.0], [10.0] * 3, "Reflectance (percent)"), "far.txt"
            )
        )["wavelength"].values.max()
        == 216_000.0
    )


def test_a_dark_paint_in_percent_is_no_bright_one(tmp_path: Path) -> None:
    path = write_text(tmp_path, ecostress([0.4, 0.5, 0.6], [1.2, 1.1, 1.3], "Reflectance"))
    expect_refusals((FormatError, "scale-missing", "scale=1 ", lambda: hp.open_library(path)))
    assert hp.open_library(path, scale=1)["reflectance"].values.max() == pytest.approx(1.3)
    assert hp.open_library(path, scale=100)["reflectance"].values.max() == pytest.approx(0.013)


def test_a_bright_paint_among_dark_ones_tells_of_percent(tmp_path: Path) -> None:
    text = "wavelength (nm),black,soot,white\n450,0.8,0.7,80\n550,0.9,0.6,81\n650,0.8,0.6,82\n"
    with pytest.warns(PaintWarning, match="scale-missing") as noted:
        hp.open_library(write_text(tmp_path, text, "few.csv"))
    assert noted[0].filename == __file__  # the line of the caller


@pytest.mark.parametrize(
    ("units", "y", "expected"),
    [
        ("Reflectance (percent)", [-999.0, 50.0, 60.0], [np.nan, 0.5, 0.6]),
        ("Reflectance (percent)", [-9999.0, 50.0, -0.5], [np.nan, 0.5, -0.005]),
        ("Reflectance", [-999.0, 0.5, -999.0], [np.nan, 0.5, np.nan]),
        ("Reflectance (fraction)", [-32768.0, 0.5, 0.6], [np.nan, 0.5, 0.6]),
    ],
)
def test_marks_of_missing_values_are_missing(
    tmp_path: Path, units: str, y: list[float], expected: list[float]
) -> None:
    path = write_text(tmp_path, ecostress([0.4, 0.5, 0.6], y, units))
    with pytest.warns(PaintWarning, match="values-far-below-zero"):
        library = hp.open_library(path)
    np.testing.assert_allclose(library["reflectance"].values[0], expected, rtol=1e-6)


@pytest.mark.parametrize("more", ["", "data ignore value = -9999\n"])
def test_marks_of_missing_values_are_missing_at_a_scale_that_hides_them(tmp_path: Path, more: str) -> None:
    # a fill of the header is compared with what is stored, and needs no warning
    rows = np.array(ROWS) * 1e4
    rows[0, 1], rows[1, 0] = -9999.0, -9999.0 if more else -999.0
    path = write_sli(tmp_path, rows, f"{SPECTRA_NAMES}{NANOMETRES}reflectance scale factor = 10000\n{more}")
    warned = pytest.warns(PaintWarning, match="values-far-below-zero")
    with contextlib.nullcontext() if more else warned:
        values = hp.open_library(path)["reflectance"].values
    assert np.isnan(values).tolist() == [[False, True, False], [True, False, False]]


# --- Damaged libraries are refused with an error of ours, or read; the campaign tries thousands ---


@pytest.fixture(scope="module")
def seeds(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder: Path = tmp_path_factory.mktemp("seeds")
    importlib.import_module("campaigns.faults.parsers").prepare(folder)
    return folder


@pytest.mark.campaign
@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="memory is counted by Linux")
@pytest.mark.parametrize("name", ["library-envi", "library-metadata", "library-csv", "library-text"])
def test_three_hundred_damages(name: str, seeds: Path) -> None:
    parsers: Any = importlib.import_module("campaigns.faults.parsers")
    made = parsers.run_part(name, seeds, range(300))
    assert made.wrong == []
    assert made.notes["read"] > 10
    assert made.notes["refused"] > 10


# --- Real libraries with their known values, and against SPy, which reads them by its own code ---

USGS = "splib07a_Brilliant(Hansa)yellowGDS785_ASDFRa_AREF.txt"
METAL = "jhu.becknic.manmade.roofing.metal.solid.0384uuu.spectrum.txt"
CEMENT = "jhu.becknic.manmade.construction.cement.solid.0432uuu.spectrum.txt"
SOIL = "soil.alfisol.haploxeralf.none.all.87p313.jhu.becknic.spectrum.txt"
AXES = ("reflectance", "wavelength")
WAVELENGTHS = "s07_ASD_Wavelengths_ASD_0.35-2.5_microns_2151_ch.txt"


@pytest.fixture
def sli(shared_data: Path) -> Path:
    return shared_data / "envi_sli"


@pytest.fixture
def text(shared_data: Path) -> Path:
    return shared_data / "spectra_ascii"


SPY_ON_NUMPY_2_5 = pytest.mark.filterwarnings("ignore:Setting the shape on a NumPy array:DeprecationWarning")


def spy_library(path: Path) -> Any:
    return pytest.importorskip("spectral.io.envi").open(str(path.with_suffix(".hdr")), str(path))


def assert_is_library(library: xr.Dataset) -> None:
    assert [(library[name].dims, library[name].dtype, library[name].attrs["units"]) for name in AXES] == [
        (("signature", "band"), np.float32, "1"),
        (("band",), np.float64, "nm"),
    ]
    assert all(library.attrs[key] for key in ("source", "format"))


@pytest.mark.real_data
def test_berlin__has_its_scale_in_a_plot_title_and_its_classes_beside_it(sli: Path) -> None:
    # Expected: first stored value 589.95611966 of a reflectance times 10,000; 75 spectra, 177 bands.
    library = hp.open_library(sli / "library_berlin.hdr")
    assert_is_library(library)
    assert dict(library.sizes) == {"signature": 75, "band": 177}
    assert library["reflectance"].values[0, 0] == np.float32(0.058995611966)
    assert library["wavelength"].values[[0, -1]].tolist() == [460.0, 2409.0]
    roof = library.sel(signature="zinc")
    assert (roof["level_1"].item(), roof["level_3"].item()) == ("impervious", "roof")
    xr.testing.assert_identical(library, hp.open_library(sli / "library_berlin.sli"))


@pytest.mark.real_data
@SPY_ON_NUMPY_2_5
def test_berlin__is_as_spy_reads_it(sli: Path) -> None:
    found, spy = hp.open_library(sli / "library_berlin.sli"), spy_library(sli / "library_berlin.sli")
    assert found["signature"].values.tolist() == [name.strip() for name in spy.names]
    np.testing.assert_allclose(found["reflectance"].values, spy.spectra / 1e4, rtol=1e-6)
    np.testing.assert_allclose(found["wavelength"].values, np.array(spy.bands.centers) * 1e3)
    np.testing.assert_allclose(found["fwhm"].values, np.array(spy.bands.bandwidths) * 1e3)


@pytest.mark.real_data
def test_usgs_aviris__has_two_records_that_are_no_spectra_and_error_bars(sli: Path) -> None:
    # Expected: the values of SOURCES.md, and wavelengths that fall at 31 and 95.
    library = hp.open_library(sli / "s07_AV95_envi.sli")
    assert_is_library(library)
    # 3,139 records: wavelengths, bandwidths, and 680 error bars beside the spectra
    assert dict(library.sizes) == {"signature": 3139 - 2 - 680, "band": 224}
    painted = library.isel(
        signature=[at for at, n in enumerate(library["signature"].values) if "GDS333" in n][:1]
    )
    assert "Painted_Aluminum" in painted["signature"].item()
    np.testing.assert_allclose(painted["reflectance"].values[0, [20, 50]], [0.52703726, 0.4621601], rtol=1e-6)
    np.testing.assert_allclose(
        (
            library.isel(
                signature=[at for at, n in enumerate(library["signature"].values) if "GDS398" in n][:1]
            )
        )["reflectance"].values[0, [20, 50]],
        [0.10421019, 0.670282],
        rtol=1e-6,
    )
    assert np.flatnonzero(np.diff(library["wavelength"].values) < 0).tolist() == [31, 95]
    assert float(library["reflectance"].min()) > -0.1
    assert float(library["reflectance_u_random"].min()) >= 0.0


@pytest.mark.real_data
@SPY_ON_NUMPY_2_5
def test_usgs_aviris__is_as_spy_reads_it(sli: Path) -> None:
    # Rationale: the coordinate `record` leads back, so every one of the 3,139 records is accounted for.
    found, spy = hp.open_library(sli / "s07_AV95_envi.hdr"), spy_library(sli / "s07_AV95_envi.sli")
    stored = spy.spectra.astype(np.float64)
    assert (stored < -1e30).sum() == 80591
    stored[stored < -1e20] = np.nan  # convolution has spread some of the fill to its neighbours
    record = found["record"].values
    np.testing.assert_array_equal(found["reflectance"].values, stored[record].astype(np.float32))
    assert found["signature"].values.tolist() == [spy.names[at].strip() for at in record]
    known = np.isfinite(found["reflectance_u_random"].values).any(axis=1)
    expected = stored[record[known] + 1].astype(np.float32)
    expected[expected < 0] = np.nan
    np.testing.assert_array_equal(found["reflectance_u_random"].values[known], expected)
    bars = {at for at, name in enumerate(spy.names) if name.strip().startswith("error bars to preceding")}
    assert {*record.tolist(), *bars, 0, 1} == set(range(3139))
    np.testing.assert_allclose(found["wavelength"].values, stored[0] * 1e3, rtol=1e-5)
    np.testing.assert_allclose(found["fwhm"].values, stored[1] * 1e3, rtol=2e-3)


@pytest.mark.real_data
@pytest.mark.parametrize(
    ("name", "paint", "form", "count", "ends", "first"),
    [
        (METAL, "Aluminum Metal", "ASTER", 536, (300.0, 12500.0), 0.2907),
        (CEMENT, "Construction Concrete", "ASTER", 491, (420.0, 14000.0), 0.250946),
        (SOIL, "Brown to dark brown gravelly loam", "ECOSTRESS", 2844, (14011.2, 400.0), 0.015945),
    ],
)
def test_ecostress_and_aster__have_their_known_values(
    text: Path, name: str, paint: str, form: str, count: int, ends: tuple[float, float], first: float
) -> None:
    library = hp.open_library(text / name)
    assert_is_library(library)
    assert library["signature"].values.tolist() == [paint]
    assert library.attrs["format"].startswith(form)
    assert library.sizes["band"] == count
    np.testing.assert_allclose(library["wavelength"].values[[0, -1]], ends)
    assert library["reflectance"].values[0, 0] == np.float32(first)
    assert "notes" not in library.attrs


@pytest.mark.real_data
def test_aster__values_that_wrap_are_whole(text: Path) -> None:
    library = hp.open_library(text / METAL)
    assert (library["origin"].item(), library["sample_no"].item()) == (
        "Spectra obtained from the Noncoventional Exploitation Factors Data System of the National "
        "Photographic Interpretation Center.",
        "0384UUUALM",
    )


@pytest.mark.real_data
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # SPy leaves files open
@pytest.mark.parametrize("name", [METAL, CEMENT, SOIL])
def test_ecostress_and_aster__are_as_spy_reads_them(text: Path, name: str) -> None:
    module, function = ("ecostress", "read_ecostress_file") if name == SOIL else ("aster", "read_aster_file")
    theirs = getattr(pytest.importorskip(f"spectral.database.{module}"), function)(str(text / name))
    ours = hp.open_library(text / name).sortby("wavelength")
    np.testing.assert_allclose(ours["wavelength"].values, np.array(theirs.x) * 1e3)
    np.testing.assert_allclose(ours["reflectance"].values[0], np.array(theirs.y) / 100.0, rtol=1e-6)


@pytest.mark.real_data
@pytest.mark.parametrize("given", [False, True])
def test_usgs_text__finds_its_wavelengths_or_is_told_them(text: Path, given: bool) -> None:
    library = hp.open_library(text / USGS, wavelength=text / WAVELENGTHS if given else None)
    assert_is_library(library)
    assert library["signature"].values.tolist() == ["Brilliant(Hansa)yellowGDS785"]
    assert (library["spectrometer"].item(), library["measurement"].item()) == ("ASDFRa", "AREF")
    assert library["reflectance"].values[0, 0] == np.float32(1.1358514e-2)
    assert (library["wavelength"].values[0], library.sizes["band"]) == (pytest.approx(349.99999), 2151)


@pytest.mark.real_data
def test_usgs_text__is_as_spy_reads_it(text: Path) -> None:
    usgs = pytest.importorskip("spectral.database.usgs")
    theirs = usgs.SampleData.read_from_file(str(text / USGS))
    axis = usgs.SpectrometerData.read_from_file(str(text / WAVELENGTHS))
    ours = hp.open_library(text / USGS)
    np.testing.assert_array_equal(ours["reflectance"].values[0], np.float32(theirs.values))
    np.testing.assert_allclose(ours["wavelength"].values, np.array(axis.values) * 1e3)


@pytest.mark.real_data
def test_usgs_text__without_wavelengths_says_what_is_missing(text: Path, tmp_path: Path) -> None:
    alone = tmp_path / "a" / "b" / "c" / USGS
    alone.parent.mkdir(parents=True)
    alone.write_bytes((text / USGS).read_bytes())
    expect_errors((FormatError, "wavelength-missing", lambda: hp.open_library(alone)))


@pytest.mark.real_data
def test_wavelengths_are_no_spectrum(text: Path) -> None:
    expect_errors((FormatError, "quantity-wrong", lambda: hp.open_library(text / WAVELENGTHS)))


@pytest.mark.real_data
@pytest.mark.parametrize(("name", "first"), [("PVC_Red", (344.200012, 0.367868)), ("R90", (250.0, 0.942517))])
def test_plain_tables__have_their_known_values(text: Path, name: str, first: tuple[float, float]) -> None:
    library = hp.open_library(text / f"{name}.txt")
    assert (library["signature"].values.tolist(), library["wavelength"].values[0]) == ([name], first[0])
    assert library["reflectance"].values[0, 0] == np.float32(first[1])


@pytest.mark.real_data
def test_tables_with_headings__are_read(shared_data: Path) -> None:
    # Expected: latin-1 and semicolons; and a mean with its standard deviation, of which a comment tells.
    panel = hp.open_library(shared_data / "lab_calibration/zenith_lite_95R_certificate.csv")
    assert panel["reflectance"].values[0, 0] == np.float32(0.911211)
    assert "notes" not in panel.attrs  # "nm" stands in its heading
    lawn = hp.open_library(shared_data / "radiance_vs_field/insitu_BeckmanLawn.txt")
    assert (
        lawn["signature"].values.tolist(),
        lawn["reflectance"].values[0, int(np.flatnonzero(lawn["wavelength"].values == 550.0)[0])],
        lawn["reflectance_sd"].values[0, 0],
    ) == (["insitu_BeckmanLawn"], np.float32(0.0670867), np.float32(0.00805685))


@pytest.mark.real_data
def test_several_files__make_one_library_where_wavelengths_are_equal(text: Path) -> None:
    library = hp.open_library(str(text / "PVC_*.txt"))
    assert library["signature"].values.tolist() == ["PVC_Red", "PVC_White"]
    assert library["file"].values.tolist() == ["PVC_Red.txt", "PVC_White.txt"]
    assert "one of the equal rows is kept" in library.attrs["notes"]  # two of 1024, where detectors join
    expect_errors(
        (
            FormatError,
            r"R90.txt.*grid-mismatch",
            lambda: hp.open_library([text / "PVC_Red.txt", text / "PVC_White.txt", text / "R90.txt"]),
        )
    )


@pytest.mark.real_data
def test_a_folder_of_different_grids__is_one_error_that_names_them_all(text: Path) -> None:
    # Rationale: the ancillary text and the file of wavelengths are no spectra, and are not among them.
    caught = expect_error(FormatError, None, lambda: hp.open_library(text))
    message = str(caught)
    expect_words(message, without=("ancillary", WAVELENGTHS))
    assert all(name in message for name in (SOIL, METAL, USGS, "R90.txt"))


# --- Texts and libraries that hold no reflectance are refused or warned of; those that do open in silence ---

GREY = 0.3 + 0.1 * np.sin(NM / 90.0)
LIGHT = sunlight()
SIGNALLING = np.array(0x7F800001, np.uint32).view(np.float32)


def tabled(
    nm: Any, *columns: Any, heading: str = "", name: str = "paint.csv", **options: Any
) -> Callable[[Path], Any]:
    # a function that writes a table of text and opens it as a library of paints
    return lambda folder: hp.open_library(table(folder / name, nm, *columns, heading=heading), **options)


rows = partial(tabled, NM)
TWICE = np.sort(np.append(NM, 500.0))


def envi(values: Any, *header: str) -> Callable[[Path], Any]:
    # Return what writes a spectral library of ENVI and opens it.

    def opened(folder: Path) -> Any:
        np.asarray(values, "<f4").tofile(folder / "paints.sli")
        rows = [
            "ENVI", f"samples = {NM.size}", "lines = 1", "bands = 1", "data type = 4", "interleave = bsq",
            "byte order = 0", "file type = ENVI Spectral Library", "wavelength units = Nanometers",
            "spectra names = {hood}", "wavelength = {" + ",".join(map(str, NM)) + "}", *header,
        ]  # fmt: skip
        (folder / "paints.hdr").write_text("\n".join(rows) + "\n")
        return hp.open_library(folder / "paints.hdr")

    return opened


def each(*spectra: Any, head: str = "name", cells: str = "{}", **options: Any) -> Callable[[Path], Any]:
    # Return what writes a table of one row a spectrum and opens it; `cells`: format of the names.

    def opened(folder: Path) -> Any:
        rows = [[cells.format(at + 1), *map(str, values)] for at, values in enumerate(spectra)]
        path = write_file(
            folder / "paints.csv",
            "\n".join(map(",".join, [[head, *map(str, NM)], *rows])) + "\n",
            encoding="utf-8",
        )
        return hp.open_library(path, **options)

    return opened


def aster(
    values: Any, y: str, x: str = "Wavelength (micrometers)", more: str = "Class: paint"
) -> Callable[[Path], Any]:
    # Return what writes a text of the ECOSTRESS library and opens it.

    def opened(folder: Path) -> Any:
        head = [
            "Name: hood", "Type: manmade", more, f"X Units: {x}", f"Y Units: {y}",
            f"First X Value: {NM[0] / 1e3}", f"Last X Value: {NM[-1] / 1e3}",
            f"Number of X Values: {NM.size}", "",
        ]  # fmt: skip
        rows = [f"{nm / 1e3:.4f}\t{value:.6g}" for nm, value in zip(NM, values, strict=True)]
        path = write_file(folder / "hood.spectrum.txt", "\n".join([*head, *rows]) + "\n")
        return hp.open_library(path)

    return opened


# flat reflectance with a dip of 6, 15 and 50 % at the oxygen band; wavelengths, 7 % and 4 % of them twice
DIP_6, DIP_15, DIP_50 = (
    np.where(np.abs(NM - 762) <= 5, 0.5 * (1 - depth), 0.5) for depth in (0.06, 0.15, 0.5)
)
AGAIN, RARELY_AGAIN = np.r_[400.0:600.0, 584.0:600.0], np.r_[400.0:600.0, 592.0:600.0]
PLACES = np.arange(NM.size)

WRONG_LIBRARIES = [
    Case("radiance by its heading", rows(LIGHT / 9, heading="wavelength (nm),radiance"), "radiance"),
    Case("radiance by its unit", rows(LIGHT / 9, heading="nm,W m-2 sr-1 nm-1"), "W m-2"),
    Case("radiance by a unit per cm2", rows(LIGHT * 9, heading="nm,hood [uW/cm2/sr/nm]"), "uW"),
    Case("radiance by a title", rows(LIGHT / 9, heading="# Radiance of a hood\n# 7\nnm,hood"), "Radiance"),
    Case("radiance beside reflectance", rows(LIGHT / 9, GREY, heading="nm,radiance,reflectance"), "radiance"),
    Case("radiance in uW, no word", rows(2.75 * LIGHT / LIGHT.max()), "radiance"),
    Case("radiance in W, no word", rows(GREY * LIGHT / np.pi), "oxygen band"),
    Case("radiance of a dark paint", rows(0.03 * LIGHT), "oxygen band"),
    Case("irradiance in W, no word", rows(LIGHT), "radiance"),
    Case("irradiance by its heading", rows(LIGHT, heading="nm,Irradiance"), "radiance"),
    Case("irradiance by its unit", rows(LIGHT, heading="nm,E (W/m^2/nm)"), "W/m"),
    Case("counts by their heading", rows(1e-4 * LIGHT, heading="nm,counts"), "counts"),
    Case("digital numbers", rows(np.round(3000 * LIGHT), heading="nm,DN"), "DN"),
    Case("counts, no word", rows(np.round(3000 * LIGHT)), "scale"),
    Case("percent, no word", rows(100 * GREY), "scale"),
    Case("percent of a black paint", rows(2.0 + GREY), "scale"),
    Case("hundredths of a percent", rows(np.round(1e4 * GREY)), "scale"),
    Case("one spectrum of two in percent", rows(GREY, 100 * GREY, heading="nm,hood,roof"), "scale"),
    Case("fractions said to be percent", rows(0.9 * GREY, heading="nm,hood (%)"), "scale="),
    Case("hundredths said to be percent", rows(1e4 * GREY, heading="nm,hood (%)"), "scale="),
    Case("a scale that is wrong", rows(1e4 * GREY, scale=100), "scale="),
    Case("transmittance", rows(GREY, heading="nm,Transmittance"), "Transmi"),
    Case("absorbance", rows(GREY, heading="nm,Absorbance"), "Absorb"),
    Case("emissivity", rows(GREY, heading="nm,emissivity"), "emissiv"),
    Case("a standard deviation, no word", rows(GREY, 0.05 * GREY), "standard deviation"),
    Case("a standard deviation alone", rows(0.05 * GREY, heading="nm,std"), "standard deviation"),
    Case("an expanded uncertainty", rows(GREY, 0.1 * GREY, heading="nm,hood,uncertainty"), "uncertainty"),
    Case("a number of samples", rows(GREY, 0 * GREY + 8, heading="nm,hood,N"), "'N'"),
    Case("a number of spectra", rows(GREY, 0 * GREY + 8, heading="nm,hood,n samples"), "n samples"),
    Case("a variance", rows(GREY, 0.01 * GREY, heading="nm,hood,variance"), "variance"),
    *[
        Case(f"statistics {names}", rows(GREY, GREY / 9, GREY / 8, heading=f"nm,{names}"), "quantity-wrong")
        for names in ("mean,SE,CV", "Reflectance,lower95,upper95", "min,max,mean", "R,std error,quality_flag")
    ],
    Case("two spectra one below the other", tabled(np.tile(NM, 2), np.tile(GREY, 2)), "occur twice"),
    Case("wavelengths rounded", tabled(np.round(NM / 1e3, 2), GREY, heading="um,reflectance"), "twice"),
    Case("one wavelength, two values", tabled(TWICE, np.linspace(0.2, 0.3, TWICE.size)), "averaged"),
    Case("micrometres said to be nanometres", rows(GREY, heading="nm,hood", wavelength=NM / 1e3), "nm"),
    Case("nanometres said to be micrometres", rows(GREY, heading="um,hood"), "nanometres"),
    Case("a shallow oxygen band", rows(DIP_15), "oxygen band"),
    Case("an oxygen band at 4 nm", tabled(NM[::2], DIP_50[::2]), "oxygen band"),
    Case("a spread of a third", rows(GREY, 0.35 * GREY), "standard deviation"),
    Case("7 % of the wavelengths again", tabled(AGAIN, 0 * AGAIN + 0.3), "side by side"),
    Case("4 % of the wavelengths again", tabled(RARELY_AGAIN, 0 * RARELY_AGAIN + 0.3), "drop one of the two"),
    Case("a median above one", rows(0 * NM + 1.15), "scale"),
    Case("a seventh of bright values", rows(np.where(PLACES % 7 == 0, 1.3, 0.5)), "a tenth above 1.2"),
    Case("a paint that is too black", rows(0 * NM + 0.7, heading="nm,black (percent)"), "scale="),
    Case("wavenumbers", rows(GREY, heading="wavenumber (cm-1),hood"), "wavenumber"),
    Case("a library of radiance", envi(LIGHT / 9, "z plot titles = {Wavelength, Radiance}"), "Radiance"),
    Case("a library of light, no word", envi(LIGHT / 9), "oxygen band"),
    Case("a library in percent, no word", envi(100 * GREY), "scale"),
    Case("a library whose scale is wrong", envi(1e4 * GREY, "reflectance scale factor = 100"), "scale="),
    Case("derivatives", each(0.01 * GREY, head="name,Processing", cells="p{},first derivative"), "deriv"),
    Case("ECOSTRESS transmittance", aster(GREY, "Fraction", more="Measurement: Transmittance"), "Transmi"),
    Case("ECOSTRESS emission", aster(GREY, "Fraction", more="Measurement: Emission"), "Emission"),
    Case("a library without a continuum", envi(GREY, "z plot titles = {nm, Continuum Removed}"), "Continuum"),
    Case("a library of radiance by its units", envi(GREY, "data units = Radiance"), "Radiance"),
    Case("a library of light by a unit", envi(GREY, "description = {lawn, W/m2/sr/nm}"), "W/m2"),
    *[
        Case(f"whole heading {heading}", rows(GREY, heading=f"nm,{heading}"), "quantity-wrong")
        for heading in (
            "%T", "T (%)", "Log 1/R", "log(1/R)", "First Derivative", "Abs", "OD", "K/S", "Extinktion",
            "Absorption (a.u.)", "Strahldichte", "Bestrahlungsstärke", "Intensity", "Absorptance",
        )
    ],
    Case("our headings, percent", each(100 * GREY, head="signature"), "scale=100"),
    Case("our headings, negative percent", each(-100 * GREY, head="signature"), "far below 0"),
    Case("our headings, light", each(LIGHT / 9, head="signature"), "oxygen band"),
    Case("ECOSTRESS text of radiance", aster(LIGHT / 9, "Radiance (W m-2 sr-1 nm-1)"), "Radiance"),
    Case("ECOSTRESS text of fractions", aster(0.9 * GREY, "Reflectance (percent)"), "scale="),
]  # fmt: skip

RIGHT_LIBRARIES = [
    Case("a fraction", rows(GREY), ""),
    Case("a fraction, named", rows(GREY, heading="wavelength (nm),reflectance"), ""),
    Case("percent, named", rows(100 * GREY, heading="wavelength (nm),reflectance (%)"), ""),
    Case("percent of a black paint, named", rows(0 * NM + 1.5, heading="nm,black (percent)"), ""),
    Case("percent, told", rows(100 * GREY, scale=100), ""),
    Case("a dip of 6 % at the oxygen band", rows(DIP_6), ""),
    Case("a dip at a step of 10 nm", tabled(NM[::5], DIP_50[::5]), ""),
    Case("a darker paint", rows(GREY, 0.7 * GREY), ""),
    Case("a fifteenth of bright values", rows(np.where(PLACES % 15 == 0, 1.3, 0.5)), ""),
    Case("a white panel", rows(0 * NM + 0.99, heading="nm,panel"), ""),
    Case("a fluorescent paint", rows(GREY + 1.1 * np.exp(-(((NM - 610) / 12) ** 2))), ""),
    Case("a paint and its spread", rows(GREY, 0.05 * GREY, heading="nm,hood,std"), ""),
    Case("two paints with spreads", rows(GREY, GREY / 9, GREY / 2, GREY / 8, heading="nm,a,sd,b,sd"), ""),
    Case("two paints", rows(GREY, 0.1 * GREY, heading="nm,white,black"), ""),
    Case("two paints, told", rows(GREY, 0.1 * GREY, quantity="reflectance"), ""),
    Case("reflectance made of radiance", rows(GREY, heading="# from radiance\nnm,reflectance"), ""),
    Case("light, told to be reflectance", rows(GREY * LIGHT, quantity="reflectance"), ""),
    Case("a shift of the oxygen band", rows(GREY * (1 + 0.03 * np.exp(-(((NM - 761) / 3) ** 2)))), ""),
    Case("a sharp dip elsewhere", rows(GREY * (1 - 0.5 * np.exp(-(((NM - 690) / 3) ** 2)))), ""),
    Case("vegetation", rows(0.04 + 0.4 / (1 + np.exp(-(NM - 715) / 9))), ""),
    Case("a library", envi(GREY), ""),
    Case("a library with a signalling NaN", envi(np.where(NM == 700, SIGNALLING, np.float32(GREY))), ""),
    Case("a library in percent", envi(100 * GREY, "z plot titles = {Wavelength, Reflectance (%)}"), ""),
    Case("percent by a comment", rows(100 * GREY, heading="# units: percent\nnm,hood"), ""),
    Case("percent by a column", each(100 * GREY, head="name,Units", cells="p{},percent"), ""),
    Case("rows of quantities", each(GREY, GREY, head="name,Processing", cells="OD {},from radiance"), ""),
    Case("paints named as quantities", rows(GREY, 0.9 * GREY, heading="nm,Abs 1,red OD"), ""),
    Case("a library of a folder", envi(GREY, "description = {D:/radiance/counts.sli}"), ""),
    Case("ECOSTRESS text", aster(100 * GREY, "Reflectance (percent)"), ""),
]  # fmt: skip


@pytest.mark.parametrize("case", WRONG_LIBRARIES, ids=lambda case: case.name)
def test_what_is_no_reflectance__does_not_become_a_paint_in_silence(case: Case, tmp_path: Path) -> None:
    said = objection(case.opened, tmp_path)
    assert re.search(case.words, said), said or "silent"


@pytest.mark.parametrize("case", RIGHT_LIBRARIES, ids=lambda case: case.name)
def test_reflectance__opens_without_a_word(case: Case, tmp_path: Path) -> None:
    assert remarks(case.opened, tmp_path) == []


@pytest.mark.real_data
@pytest.mark.parametrize(
    ("name", "word"),
    [
        # radiance in uW cm-2 sr-1 nm-1 by their origin; no word in them says so
        ("radiance_vs_field/ang20171108t184227_rdn_v2p11_BeckmanLawn.txt", "radiance"),
        ("radiance_vs_field/ang20171108t184227_rdn_v2p11_AstroRedBaseball.txt", "radiance"),
        ("downwelling/ASTMG173.csv", "irrad"),
    ],
)
def test_real_texts_of_light__are_refused(shared_data: Path, name: str, word: str) -> None:
    expect_errors((FormatError, word, lambda: hp.open_library(shared_data / name)))


def test_columns_of_spread__are_those_of_the_paint_before_them(tmp_path: Path) -> None:
    library = rows(GREY, GREY / 9, GREY / 2, heading="nm,a,a sd,b")(tmp_path)
    assert library["signature"].values.tolist() == ["a", "b"]
    np.testing.assert_allclose(library["reflectance_sd"].values[0], GREY / 9, rtol=1e-6)
    assert np.isnan(library["reflectance_sd"].values[1]).all()


def test_a_white_standard_is_a_paint(tmp_path: Path) -> None:
    # Words of a spread name one only where the rest of the heading names another column.
    names = ["Red 12", "White Std", "SD45"]
    assert (
        rows(GREY, GREY / 2, GREY / 3, heading="nm," + ",".join(names))(tmp_path)["signature"].values.tolist()
        == names
    )
    spread = rows(GREY, GREY / 2, GREY / 9, GREY / 8, heading="nm,red,blue,blue std,red std")(tmp_path)
    assert spread["signature"].values.tolist() == ["red", "blue"]
    np.testing.assert_allclose(spread["reflectance_sd"].values[0], GREY / 8, rtol=1e-6)


# --- tables of other programs: the role and unit of every column, by its own heading ----------------------


NMS = np.arange(400, 1001, 10)
A, B = np.linspace(0.2, 0.4, 61), np.linspace(0.5, 0.3, 61)
ROW = np.arange(61)


def written(path: Path, heading: str, *columns: Any, mark: str = ",", end: str = "", last: str = "") -> Path:
    rows = (mark.join(f"{value:.6g}" for value in row) + end for row in zip(*columns, strict=True))
    path.write_text("\n".join([*([heading] if heading else []), *rows, last]) + "\n", encoding="utf-8")
    return path


# heading, columns, options of `written`, and the names of the signatures
READ: dict[str, tuple[str, tuple[Any, ...], dict[str, str], list[str]]] = {
    "band number, um": ("band,wavelength_um,reflectance", (ROW + 101, NMS / 1e3, A), {}, ["x"]),
    "pandas index": (",wavelength,a", (ROW, NMS, A), {}, ["a"]),
    "unnamed index": ("Unnamed: 0,wl,a,b", (ROW, NMS, A, B), {}, ["a", "b"]),
    "channel from 1, tabs": ("Ch\tnm\ta", (ROW + 1, NMS, A), {"mark": "\t"}, ["a"]),
    "index, no headings": ("", (ROW, NMS, A), {}, ["x"]),
    "wavelength last": ("a,b,wavelength (nm)", (A, B, NMS), {}, ["a", "b"]),
    "two empty cells": (
        "Wavelength (nm)\ta\tb",
        (NMS, A, B),
        {"mark": "\t", "end": "\t\t"},
        ["a", "b"],
    ),
    "three empty cells, head too": ("nm;a;b;;;", (NMS, A, B), {"mark": ";", "end": ";;;"}, ["a", "b"]),
    "nm and um": ("nm,um,a", (NMS, NMS / 1e3, A), {}, ["a"]),
    "an axis beside every one": ("nm,a,nm,b", (NMS, A, NMS, B), {}, ["a", "b"]),
    "per cent of one column": ("nm,a (%),b", (NMS, 100 * A, B), {}, ["a", "b"]),
    "pct of one column": ("nm,a,b_pct", (NMS, A, 100 * B), {}, ["a", "b_pct"]),
    "spread without its unit": ("nm,a (%),std", (NMS, 100 * A, 3 + 0 * A), {}, ["a"]),
    "row of units": ("Wavelength,a,b\nµm,%,1", (NMS / 1e3, 100 * A, B), {}, ["a", "b"]),
    "German spread": ("nm;Mittelwert;Standardabweichung", (NMS, A, 0.1 * A), {"mark": ";"}, ["x"]),
    "French spread": ("nm;a moyenne;a écart-type", (NMS, A, 0.1 * A), {"mark": ";"}, ["a moyenne"]),
    "names that are statistics elsewhere": ("nm,SE,max", (NMS, A, B), {}, ["SE", "max"]),
    "empty row": ("nm,a,b", (NMS, A, B), {"last": ",,"}, ["a", "b"]),
    "grains in um": ("# grain size 20 um\nwavelength (nm),a", (NMS, A), {}, ["a"]),
    "width of bands": ("wavelength (um),fwhm (nm),a", (NMS / 1e3, 0 * NMS + 12, A), {}, ["a"]),
    "angstrom": ("Wavelength (Angstrom),a", (NMS * 10.0, A), {}, ["a"]),
    "A": ("Wavelength (A),a", (NMS * 10.0, A), {}, ["a"]),
    "lambda_A": ("lambda_A,A,B", (NMS * 10.0, A, B), {}, ["A", "B"]),
    "pairs of columns": ("wl1,a,wl2,b", (NMS / 1e3, A, NMS / 1e3, B), {}, ["a", "b"]),
    "a repeated name": ("Wavelength (nm),a,Wavelength (nm).1,b", (NMS, A, NMS, B), {}, ["a", "b"]),
    "wavenumbers too": ("Wavenumber (cm-1),Wavelength (nm),a", (1e7 / NMS, NMS, A), {}, ["a"]),
    "names with words of statistics": ("nm,cherry,mint", (NMS, A, B), {}, ["cherry", "mint"]),
    "a median alone": ("nm,median grey,max", (NMS, A, B), {}, ["median grey", "max"]),
    "a separator line": ("sep=;\nnm;a", (NMS, A), {"mark": ";"}, ["a"]),
}


@pytest.mark.parametrize("case", READ)
def test_columns_are_read_by_their_headings(case: str, tmp_path: Path) -> None:
    heading, columns, form, names = READ[case]
    path = written(tmp_path / "x.csv", heading, *columns, **form)
    assert remarks(lambda _: hp.open_library(path), tmp_path) == []
    library = hp.open_library(path)
    assert library["signature"].values.tolist() == names
    np.testing.assert_allclose(library["wavelength"].values, NMS, rtol=1e-6)
    np.testing.assert_allclose(library["reflectance"].values, [A, B][: len(names)], rtol=1e-5)
    if "fwhm" in heading:
        np.testing.assert_allclose(library["fwhm"].values, 12.0)
    if "std" in heading:
        np.testing.assert_allclose(library["reflectance_sd"].values, 0.03, rtol=1e-5)


LAMP = 0.4 * np.exp(-(((NMS - 560) / 40) ** 2)) + 0.01


@pytest.mark.parametrize(
    ("heading", "columns", "code"),
    [
        ('"FILE:SHOP3"\n"REM: CEILING LAMP (QNTM)"\n"INT:  1NM"', (NMS, LAMP), "quantity-wrong"),
        ("# photon flux of a lamp\nnm,value", (NMS, LAMP), "quantity-wrong"),
        ("nm,umol m-2 s-1 nm-1", (NMS, LAMP), "quantity-wrong"),
        ("# PPFD, growth chamber\nnm,chamber 1", (NMS, LAMP), "quantity-wrong"),
        ("nm,µE/m²/s", (NMS, LAMP), "quantity-wrong"),
        ("nm,a,wavelength,b", (NMS, A, NMS + 5, B), "grid-mismatch"),
        ("sample,wavelength,a", (ROW % 7, NMS, A), "column-unknown"),
        ("nm,a,solar zenith", (NMS, A, 0 * NMS + 30), "scale-missing"),
    ],
)
def test_columns_that_are_no_reflectance_are_refused(
    heading: str, columns: tuple[Any, ...], code: str, tmp_path: Path
) -> None:
    path = written(tmp_path / "x.csv", heading, *columns)
    expect_errors((FormatError, code, lambda: hp.open_library(path)))


@pytest.mark.parametrize(
    "names", [["R401", "R402", "R403"], ["0.5", "1", "2"], ["wl_500", "wl_600", "wl_700"]]
)
def test_names_of_columns_that_resemble_wavelengths_are_names(names: list[str], tmp_path: Path) -> None:
    path = written(tmp_path / "x.csv", f"index,wavelength,{','.join(names)}", ROW, NMS, A, B, A)
    assert hp.open_library(path)["signature"].values.tolist() == names


@pytest.mark.parametrize(
    "names",
    [
        *(
            "red,red_err",
            "R,err",
            "R,u(R)",
            "R,dR",
            "red,red +/-",
            "rho,rho_unc",
            "R,k=2",
            "red,red variance",
        ),
        *(
            "red,red_min,red_max",
            "R,R lower,R upper",
            "R,ci_low,ci_high",
            "median,q25,q75",
            "red,red std err",
        ),
        *("reflectance,reflectance_uncertainty", "rho,rho_se", "mean,min,max", "hood,Expanded uncertainty"),
    ],
)
def test_statistics_beside_their_spectrum_are_no_paints(names: str, tmp_path: Path) -> None:
    path = written(tmp_path / "x.csv", f"nm,{names}", NMS, A, *[0 * A + 0.01] * names.count(","))
    expect_errors((FormatError, "quantity-wrong", lambda: hp.open_library(path)))
    with pytest.warns(PaintWarning, match="columns-left-out"):
        library = hp.open_library(path, quantity="reflectance")
    np.testing.assert_allclose(library["reflectance"].values, [A], rtol=1e-5)


@pytest.mark.parametrize(
    ("text", "encoding"),
    [
        ('"nm","a","b"\n"450","0.1","NA"\n"550","0.2","0.3"\n', "utf-8"),
        ('"","wavelength","a","b"\n"1",450,0.1,#N/A\n"2",550,0.2,0.3\n', "utf-8"),
        ('"nm" "a" "b"\n450 0.1 NA\n550 0.2 0.3\n', "utf-8"),
        ("Wavelength (µm)\ta\tb\n0.45\t0.1\t\n0.55\t0.2\t0.3\n", "utf-16"),
        ("Wavelength (µm);a;b\n0,45;0,1;nan\n0,55;0,2;0,3\n", "cp1252"),
    ],
)
def test_tables_as_r_and_spreadsheets_write_them(text: str, encoding: str, tmp_path: Path) -> None:
    library = hp.open_library(write_text(tmp_path, text, encoding=encoding))
    assert library["signature"].values.tolist() == ["a", "b"]
    np.testing.assert_allclose(library["wavelength"].values, [450.0, 550.0])
    np.testing.assert_allclose(library["reflectance"].values, [[0.1, 0.2], [np.nan, 0.3]], rtol=1e-6)


def test_rows_of_statistics_and_empty_rows_are_no_paints(tmp_path: Path) -> None:
    rows = [["name", *map(str, NMS)], *([name, *["0.3"] * 61] for name in ("mean", "std")), [""] * 62]
    path = write_text(tmp_path, "\n".join(map(",".join, rows)), "rows.csv")
    with pytest.warns(PaintWarning, match="columns-left-out"):
        assert hp.open_library(path)["signature"].values.tolist() == ["mean"]


@pytest.mark.parametrize(
    "names",
    [
        "Reflectance,Std",
        "Reflectance,SD",
        "R,St. Dev.",
        "R,Variance",
        "R,N",
        "a.asd mean,a.asd std",
        "mean,SE",
    ],
)
def test_statistics_of_a_spectrometers_table_are_no_spectra(names: str, tmp_path: Path) -> None:
    path = written(tmp_path / "s.csv", f"Wavelength,{names}", NMS, A, 0 * A + 0.01)
    with pytest.warns(hp.errors.PaintWarning, match="columns-left-out"):
        opened = hp.open_asd(path, quantity="reflectance")
    assert opened.sizes["spectrum"] == 1
    np.testing.assert_allclose(opened["reflectance"].values[0], A, rtol=1e-5)


# --- What is written comes back: bit for bit, and byte for byte when it is written again ---


def files_of(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def trip(library: xr.Dataset, folder: Path, name: str, **options: Any) -> xr.Dataset:
    # Write, read and write again; the two are the same byte for byte.
    first = hp.write_library(library, folder / "one" / name, **options)
    found = hp.open_library(first)
    second = hp.write_library(found, folder / "two" / name, **options)
    assert files_of(first.parent) == files_of(second.parent)
    return found


@pytest.mark.parametrize("name", ["paints.sli", "paints.csv"])
def test_sli_and_csv__give_the_library_back(library: xr.Dataset, tmp_path: Path, name: str) -> None:
    # Expected: every value, dtype, attribute and name, members with their padding, and NaN as it was.
    for folder, one in (("rising", library), ("falling", library.isel(band=slice(None, None, -1)))):
        found = trip(one, tmp_path / folder, name, curves="all")
        xr.testing.assert_identical(found, one)
    assert {key: found[key].dtype for key in library.variables} == dict(library.dtypes) | {
        key: library[key].dtype for key in library.coords
    }


@pytest.mark.parametrize("name", ["paints.sli", "paints.csv"])
def test_files_do_not_depend_on_the_order_of_coordinates(
    library: xr.Dataset, tmp_path: Path, name: str
) -> None:
    # xarray gathers coordinates from sets, whose order follows PYTHONHASHSEED.
    coords = {key: library.variables[key] for key in reversed([*library.coords])}
    turned = xr.Dataset(library.reset_coords(drop=True).data_vars, coords, library.attrs)
    paths = [
        hp.write_library(one, tmp_path / folder / name, curves="all")
        for folder, one in (("one", library), ("two", turned))
    ]
    one, two = (files_of(path.parent) for path in paths)
    assert one == two


def test_zarr__gives_the_library_back(library: xr.Dataset, tmp_path: Path) -> None:
    found = hp.open_library(hp.write_library(library, tmp_path / "paints.zarr"))
    assert found["member_reflectance"].chunks is not None
    for name, variable in library.variables.items():
        np.testing.assert_array_equal(found[name].values, variable.values, err_msg=str(name))
    assert hp.verify(tmp_path / "paints.zarr").ok


@SPY_ON_NUMPY_2_5
def test_sli__is_read_by_spy(library: xr.Dataset, tmp_path: Path) -> None:
    # Expected: SPy finds the centres first, under their names, and members named after their paint.
    envi = pytest.importorskip("spectral.io.envi")
    path = hp.write_library(library, tmp_path / "paints.sli", curves="all")
    theirs = envi.open(str(path.with_suffix(".hdr")), str(path))
    assert list(theirs.names[:5]) == ["red; matt", "Grün", "Grün (2)", 'a/b "x" / c (d)', "unnamed"]
    np.testing.assert_array_equal(theirs.spectra[:5], library["reflectance"].values)
    np.testing.assert_array_equal(
        theirs.spectra[list(theirs.names).index("Grün (2) | member 3")],
        library["member_reflectance"].values[2, 2],
    )
    np.testing.assert_array_equal(theirs.bands.centers, library["wavelength"].values)
    # the header of centres has the columns of the paints
    path = hp.write_library(library, tmp_path / "centres.sli")
    theirs = envi.open(str(path.with_suffix(".hdr")), str(path))
    assert theirs.spectra.shape == library["reflectance"].shape
    assert theirs.metadata["paint make"] == ["VW", "", "Škoda", "a b", "ß"]
    assert theirs.metadata["paint year"] == ["2001", "2", "3", "4", "5"]


def test_csv__of_all_curves_says_what_each_row_is(library: xr.Dataset, tmp_path: Path) -> None:
    with open(
        hp.write_library(library, tmp_path / "paints.csv", curves="all"), encoding="utf-8-sig", newline=""
    ) as file:
        head, *rows = csv.reader(file)
    assert head[:3] == ["signature", "variable", "place"]
    first = len(head) - library.sizes["band"]
    assert [float(cell) for cell in head[first:]] == library["wavelength"].values.tolist()
    assert ({len(row) for row in rows}, [row[0] for row in rows[:5]]) == ({len(head)}, NAMES)
    assert [np.float32(cell) for cell in rows[1][first:]] == library["reflectance"].values[1].tolist()
    members = [row for row in rows if row[1] == "member_reflectance"]
    assert [(row[0], row[2]) for row in members if row[0].startswith("Grün")] == [
        *[("Grün", str(place)) for place in (1, 2)],  # padding is left out
        *[("Grün (2)", str(place)) for place in (1, 2, 3, 4)],
    ]
    assert (
        json.loads((tmp_path / "paints.csv.json").read_text(encoding="utf-8"))["coords"]["make"]["data"]
        == library["make"].values.tolist()
    )


def test_csv__is_a_rectangle_for_pandas_and_excel(library: xr.Dataset, tmp_path: Path) -> None:
    # Expected: a row a paint, what is said of it, then numbers alone; Excel knows UTF-8 by its mark.
    path = hp.write_library(library, tmp_path / "paints.csv")
    assert path.read_bytes().startswith(b"\xef\xbb\xbfsignature,make,n,n_eff,quality,time,year,400.0,")
    table = pd.read_csv(path, keep_default_na=False, na_values={"n_eff": [""]}, dtype={"make": str})
    assert (table["signature"].tolist(), table["make"].tolist()) == (NAMES, ["VW", "", "Škoda", "a b", "ß"])
    assert table["year"].tolist() == [2001, 2, 3, 4, 5]
    np.testing.assert_array_equal(table["n_eff"], library["n_eff"])
    assert str(table["time"][0]) == "2024-05-21T11:33:07.123456789"
    values = table.iloc[:, table.columns.get_loc("400.0") :]
    assert [float(name) for name in values.columns] == library["wavelength"].values.tolist()
    np.testing.assert_array_equal(values.to_numpy("f4"), library["reflectance"].values)
    assert (
        hp.write_library(
            library.isel(signature=[0]).assign_coords(make=("signature", np.array(["VW"], object))),
            tmp_path / "plain.csv",
        )
        .read_bytes()
        .startswith(b"signature,")
    )


@pytest.mark.parametrize("name", ["paints.sli", "paints.csv"])
def test_centres__are_the_default_and_come_back(library: xr.Dataset, tmp_path: Path, name: str) -> None:
    # Expected: the centre and what is said of paints, to the bit; no member, quantile or spread.
    xr.testing.assert_identical(
        trip(library, tmp_path, name), library.drop_vars(["reflectance_sd"]).drop_dims(["member", "quantile"])
    )
    if name == "paints.csv":
        assert len((tmp_path / "one" / name).read_text(encoding="utf-8-sig").splitlines()) == 1 + len(NAMES)
    else:
        assert (tmp_path / "one" / name).stat().st_size == 4 * library["reflectance"].size


def test_formats_hold_what_they_can(library: xr.Dataset, tmp_path: Path) -> None:
    expect_errors(
        (
            SchemaError,
            "choice-unknown",
            lambda: hp.write_library(library, tmp_path / "paints.csv", curves="members"),
        )
    )
    assert not {"member", "quantile"} & {
        *hp.open_library(hp.write_library(library, tmp_path / "paints.zarr", curves="centre")).dims
    }


def test_csv__written_by_earlier_versions_opens(library: xr.Dataset, tmp_path: Path) -> None:
    # Rationale: the earlier table had no columns between the place and the wavelengths, and no mark.
    path = hp.write_library(library, tmp_path / "paints.csv", curves="all")
    with open(path, encoding="utf-8-sig", newline="") as file:
        rows = list(csv.reader(file))
    first = len(rows[0]) - library.sizes["band"]
    with open(path, "w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(row[:3] + row[first:] for row in rows)
    xr.testing.assert_identical(hp.open_library(path), library)


def test_csv__edited_in_a_spreadsheet(library: xr.Dataset, tmp_path: Path) -> None:
    # Expected: a column that is new is taken; one that contradicts the metadata is not, which is said.
    path = hp.write_library(library, tmp_path / "paints.csv")
    table = pd.read_csv(path, keep_default_na=False)
    table.insert(1, "finish", ["matt", "matt", "gloss", "gloss", ""])
    table.insert(1, "layers", [1, 2, 3, 4, ""])
    table.to_csv(path, index=False)
    found = hp.open_library(path)
    assert found["finish"].values.tolist() == ["matt", "matt", "gloss", "gloss", ""]
    np.testing.assert_array_equal(found["layers"].values, [1, 2, 3, 4, np.nan])
    table["make"] = "Seat"
    table.to_csv(path, index=False)
    with pytest.warns(PaintWarning, match="metadata-differ"):
        assert hp.open_library(path)["make"].values[0] == "VW"
    path.with_name("paints.csv.json").unlink()
    with pytest.warns(PaintWarning, match="is missing"):
        found = hp.open_library(path)
    assert set(found["make"].values) == {"Seat"}
    np.testing.assert_array_equal(found["reflectance"].values, library["reflectance"].values)
    assert "n" not in found.variables  # its units are lost
    hp.write_library(found, tmp_path / "again.csv")


@pytest.mark.parametrize(
    ("first", "row", "said"),
    [
        ("signature,make,make,400,500", "a,b,c,1,1", "header-unreadable"),
        ("paint,my make,400,500", "a,b,1,1", "header-unreadable"),
        ("signature,make,400,500", "a,1,1", "row 2.*row-unreadable"),
        ("signature,make,400,500", "a,b,1,x", "row 2: 'a,b,1,x'"),
        ("signature,make,400,-500", "a,b,1,1", "table-missing"),
    ],
)
def test_csv__what_is_no_table_is_said(first: str, row: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "x.csv").write_text(f"{first}\n{row}\n")
    expect_errors((FormatError, said, lambda: hp.open_library(tmp_path / "x.csv")))


@pytest.mark.parametrize("name", ["paints.sli", "paints.csv"])
def test_without_metadata__spectra_and_members_still_lead_back(
    library: xr.Dataset, tmp_path: Path, name: str
) -> None:
    path = hp.write_library(library, tmp_path / name, curves="all")
    path.with_name(path.name + ".json").unlink()
    with pytest.warns(PaintWarning, match="metadata-missing") as noted:
        found = hp.open_library(path)
    assert noted[0].filename == __file__  # the line of the caller
    for variable in ("reflectance", "member_reflectance", "reflectance_quantiles", "reflectance_sd"):
        np.testing.assert_array_equal(found[variable].values, library[variable].values)
        assert found[variable].dims == library[variable].dims
    assert found["signature"].values[0] == ("red; matt" if name.endswith("sli") else "red, matt")
    assert ("make" in found.coords) == name.endswith("csv")


@pytest.mark.parametrize(
    ("separator", "point", "quotes", "tail"),
    [
        (";", ".", csv.QUOTE_MINIMAL, []),
        (";", ",", csv.QUOTE_MINIMAL, []),
        ("\t", ",", csv.QUOTE_MINIMAL, []),
        (",", ".", csv.QUOTE_MINIMAL, ["", ""]),
        (",", ".", csv.QUOTE_ALL, []),
    ],
)
def test_csv_saved_again_by_a_spreadsheet__is_the_same(
    tmp_path: Path, separator: str, point: str, quotes: Any, tail: list[str]
) -> None:
    # Rationale: rows of standard deviations and members became paints, and an empty row too.
    path = hp.write_library(make_library(), tmp_path / "paints.csv", curves="all")
    with path.open(encoding="utf-8-sig", newline="") as file:
        rows = [[*row, *tail] for row in csv.reader(file)]
    expected = hp.open_library(path).load()
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, delimiter=separator, quoting=quotes)
        writer.writerows(
            [re.sub(r"^(-?\d+)\.(\d+)", rf"\1{point}\2", cell) for cell in row]
            for row in [*rows, [""] * len(rows[0])]
        )
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "(?s).*metadata-differ")  # decimal commas in properties
        xr.testing.assert_identical(hp.open_library(path).load(), expected)


@pytest.mark.parametrize("name", ["paints.sli", "paints.csv"])
def test_metadata_of_another_library__are_refused(library: xr.Dataset, tmp_path: Path, name: str) -> None:
    path = hp.write_library(library, tmp_path / name, curves="all")
    other = hp.write_library(
        library.assign_coords(wavelength=library["wavelength"] + 1.0), tmp_path / "other" / name, curves="all"
    )
    path.with_name(path.name + ".json").write_bytes(other.with_name(path.name + ".json").read_bytes())
    expect_errors((FormatError, "grid-mismatch", lambda: hp.open_library(path)))
    fewer = hp.write_library(library.isel(signature=[0, 1]), tmp_path / "fewer" / name, curves="all")
    path.with_name(path.name + ".json").write_bytes(fewer.with_name(path.name + ".json").read_bytes())
    # an axis without values, which an index would fill the memory with
    metadata = json.loads(whole := path.with_name(path.name + ".json").read_text(encoding="utf-8"))
    metadata["coords"]["x"] = {"dims": ["x"], "attrs": {}, "dtype": "float32", "shape": [2**31 - 1]}
    for text, message in ((whole, "sizes"), (json.dumps(metadata), "'x': expected values")):
        path.with_name(path.name + ".json").write_text(text, encoding="utf-8")
        expect_error(FormatError, rf"{message}.*metadata-damaged", lambda: hp.open_library(path))


@pytest.mark.parametrize("name", ["paints.sli", "paints.csv", "paints.zarr"])
def test_lazy_libraries__are_written_as_loaded_ones(tmp_path: Path, name: str) -> None:
    library = make_library()
    lazy = library.chunk({"signature": 2, "member": 3, "band": 4})
    calls: list[tuple[int, int]] = []
    eager = hp.write_library(
        library, tmp_path / "eager" / name, curves="all", progress=lambda *call: calls.append(call)
    )
    steps, totals = zip(*calls, strict=True)
    assert list(steps) == sorted(steps)
    assert steps[-1] == totals[-1] > 0
    done = hp.write_library(lazy, tmp_path / "lazy" / name, curves="all")
    if not done.is_dir():
        assert files_of(done.parent) == files_of(eager.parent)
    xr.testing.assert_identical(
        hp.open_library(done).load().drop_attrs(), hp.open_library(eager).load().drop_attrs()
    )


def test_units__are_brought_to_those_of_the_table(library: xr.Dataset, tmp_path: Path) -> None:
    # Rationale: percent and micrometres are said by units and converted; no units are an error.
    percent = library[["reflectance"]]
    percent["reflectance"] = (percent["reflectance"] * 100).assign_attrs(units="percent")
    percent["wavelength"] = (percent["wavelength"] / 1e3).assign_attrs(units="um")
    found = hp.open_library(hp.write_library(percent, tmp_path / "paints.sli"))
    np.testing.assert_allclose(found["reflectance"].values, library["reflectance"].values, rtol=1e-6)
    np.testing.assert_allclose(found["wavelength"].values, library["wavelength"].values)
    del percent["reflectance"].attrs["units"]
    expect_errors(
        (SchemaError, r"'reflectance'.*units", lambda: hp.write_library(percent, tmp_path / "more.sli"))
    )


def test_what_cannot_be_written__is_said_all_at_once(library: xr.Dataset, tmp_path: Path) -> None:
    bad = library.drop_vars("wavelength")
    bad["n"] = bad["n"].assign_attrs(units="m")
    caught = expect_error(SchemaError, None, lambda: hp.write_library(bad, tmp_path / "paints.sli"))
    expect_words(str(caught), "'wavelength' is missing", "'n' has units 'm'")
    broken = library.assign_coords(signature=["a\nb", "c", "d\x00", "e", "f"])
    for format in ("envi", "csv"):
        expect_error(
            SchemaError,
            "name-unwritable",
            partial(hp.write_library, broken.isel(band=[0, 1]), tmp_path / "paints", format=format),
        )
    for name, options in (
        ("paints.xlsx", {}),
        ("red.spectrum.txt", {}),
        ("paints", {"format": "ecostress"}),
    ):
        expect_error(
            FormatError,
            r"envi, csv, parquet, zarr.*choice-unknown",
            partial(hp.write_library, library, tmp_path / name, **options),
        )
    expect_errors(
        (
            SchemaError,
            r"'when'.*type-wrong",
            lambda: hp.write_library(library.assign_attrs(when=object()), tmp_path / "paints.csv"),
        )
    )
    assert list(tmp_path.iterdir()) == []


@settings(max_examples=12)
@given(
    names=st.lists(
        st.text(st.characters(exclude_categories=("Cs", "Cc", "Zl", "Zp")), max_size=12),
        min_size=1,
        max_size=8,
        unique=True,
    ),
    data=st.data(),
)
@pytest.mark.filterwarnings("ignore:.*scale-doubtful")
def test_any_names_and_values__come_back(
    tmp_path_factory: Any, names: list[str], data: st.DataObject
) -> None:
    # Property: names of any characters, and every float32 but infinities.
    value = st.floats(width=32, allow_infinity=False)
    values = data.draw(
        st.lists(st.lists(value, min_size=3, max_size=3), min_size=len(names), max_size=len(names))
    )
    members = data.draw(
        st.lists(st.lists(value, min_size=6, max_size=6), min_size=len(names), max_size=len(names))
    )
    library = xr.Dataset(
        {
            "reflectance": (("signature", "band"), np.array(values, np.float32), {"units": "1"}),
            "member_reflectance": (
                ("signature", "member", "band"),
                np.array(members, np.float32).reshape(-1, 2, 3),
                {"units": "1"},
            ),
        },
        coords={
            "signature": np.array(names, object),
            "wavelength": ("band", [400.0, 500.5, 1 / 3 + 600], {"units": "nm"}),
        },
    )
    for name in ("paints.sli", "paints.csv"):
        xr.testing.assert_identical(
            trip(library, tmp_path_factory.mktemp("any"), name, curves="all"), library
        )


@pytest.mark.parametrize("name", ["paints.sli", "paints.csv"])
def test_signatures_of_a_flight__come_back_whole(tmp_path: Path, name: str) -> None:
    # Rationale: what `extract_signatures` makes holds regions, flags, times and uncertainties as well.
    paints = hp.extract_signatures(painted_lines.made(), painted_lines.TWO, members=5)
    found = trip(paints, tmp_path, name, curves="all")
    assert (set(found.variables), set(found.coords)) == (set(paints.variables), set(paints.coords))
    for variable in paints.variables:
        np.testing.assert_array_equal(found[variable].values, paints[variable].values, err_msg=str(variable))
        assert found[variable].dtype == paints[variable].dtype, variable
        assert dict(found[variable].attrs).keys() == dict(paints[variable].attrs).keys()
    assert found.attrs == paints.attrs


@pytest.mark.real_data
def test_what_is_read_from_others__can_be_written(shared_data: Path, tmp_path: Path) -> None:
    # Rationale: 2,457 names with runs of blanks, wavelengths that fall, missing values, error bars.
    usgs = hp.open_library(shared_data / "envi_sli" / "s07_AV95_envi.sli")
    for name in ("usgs.sli", "usgs.csv"):
        xr.testing.assert_identical(trip(usgs, tmp_path, name, curves="all"), usgs)
    text = hp.open_library(sorted((shared_data / "spectra_ascii").glob("PVC_*.txt")))
    np.testing.assert_array_equal(
        trip(text, tmp_path, "pvc.csv")["reflectance"].values, text["reflectance"].values
    )


@pytest.mark.parametrize("name", ["=HYPERLINK(1)", "+red", "-matt", "@lab", "'=x", "''-y", "-5.25", "'red'"])
def test_no_name_is_a_formula_to_a_spreadsheet(tmp_path: Path, name: str) -> None:
    values = np.array([[0.25, 0.5], [-0.01, 0.75]], np.float32)
    paints = xr.Dataset(
        {"reflectance": (("signature", "band"), values, {"units": "1"})},
        coords={
            "signature": [name, "blue"], "make": ("signature", ["=1+1", "-3"]),
            "wavelength": ("band", [450.0, 650.0], {"units": "nm"}),
        },
    )  # fmt: skip
    path = tmp_path / "paints.csv"
    hp.write_library(paints, path)
    with path.open(newline="") as file:
        cells = [cell for row in csv.reader(file) for cell in row]
    dangerous = [cell for cell in cells if cell[:1] in ("=", "+", "-", "@", "\t", "\r")]
    assert all(float(cell) < 0 for cell in dangerous)  # numbers stay numbers
    back = hp.open_library(path)
    assert back["signature"].values.tolist() == [name, "blue"]
    assert back["make"].values.tolist() == ["=1+1", "-3"]
    np.testing.assert_array_equal(back["reflectance"], paints["reflectance"])


def test_a_wavelength_given_twice_is_refused(tmp_path: Path) -> None:
    path = write_file(
        tmp_path / "twice.csv",
        "wavelength (nm),red\n400,0.1\n500,0.2\n600,0.3\n700,0.4\n500,0.25\n800,0.3\n900,0.2\n",
    )
    expect_errors(
        (
            FormatError,
            "wavelength-duplicate",
            lambda: hp.open_library(path, wavelength=[400.0, 500.0, 600.0, 700.0, 500.0, 800.0, 900.0]),
        )
    )


# --- Parquet in the columns of OpenSpecLib: read by pyarrow alone, and files of others ---


def foreign(path, **changes):
    # Write a file as OpenSpecLib describes it, with pyarrow alone.
    wavelengths = [0.4, 0.5, 0.6]
    columns = {
        "id": ["usgs:1", "usgs:2"], "name": ["olivine", "asphalt"],
        "source.license": ["public domain"] * 2, "source.citation": ["Kokaly 2017"] * 2,
        "spectral_data.type": ["reflectance"] * 2, "spectral_data.wavelength_unit": ["um"] * 2,
        "spectral_data.wavelengths": [wavelengths] * 2,
        "spectral_data.values": [[0.1, None, 0.3], [0.2, 0.2, 0.2]], "additional_properties": ["{}"] * 2,
    } | changes  # fmt: skip
    pq.write_table(pa.table(columns), path)
    return path


def test_a_file_of_others_is_a_library(tmp_path):
    library = hp.open_library(foreign(tmp_path / "usgs.parquet"))
    np.testing.assert_allclose(library.wavelength, [400.0, 500.0, 600.0])
    assert library["signature"].values.tolist() == ["olivine", "asphalt"]
    np.testing.assert_array_equal(library.reflectance, np.float32([[0.1, np.nan, 0.3], [0.2, 0.2, 0.2]]))
    assert library.licence.values.tolist() == ["public domain"] * 2
    library = hp.open_library(
        foreign(
            tmp_path / "tes.parquet",
            **{
                "spectral_data.wavelength_unit": ["cm-1"] * 2,
                "spectral_data.wavelengths": [[20000.0, 16000.0, 12500.0]] * 2,
            },
        )
    )
    np.testing.assert_allclose(library.wavelength, [500.0, 625.0, 800.0])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"spectral_data.type": ["emissivity"] * 2}, "quantity-wrong"),
        ({"spectral_data.wavelength_unit": ["um", "nm"]}, "units-unknown"),
        ({"spectral_data.wavelengths": [[0.4, 0.5, 0.6], [0.4, 0.5, 0.7]]}, "different wavelengths"),
        ({"spectral_data.values": [[0.1, 0.2], [0.2, 0.2, 0.2]]}, "row 0.*length-mismatch"),
        ({"spectral_data.values": [None, [0.2, 0.2, 0.2]]}, "row 0.*length-mismatch"),
    ],
)
def test_what_is_no_library_is_refused(tmp_path, changes, message):
    expect_errors(
        (hp.FormatError, message, lambda: hp.open_library(foreign(tmp_path / "x.parquet", **changes)))
    )


def test_damaged_files_are_refused(tmp_path):
    whole = foreign(tmp_path / "x.parquet").read_bytes()
    pq.write_table(pa.table({"name": ["a"]}), tmp_path / "x.parquet")
    expect_errors((hp.FormatError, "column-missing", lambda: hp.open_library(tmp_path / "x.parquet")))
    for cut in (4, 40, len(whole) // 2, len(whole) - 4):
        (tmp_path / "cut.parquet").write_bytes(whole[:cut])
        expect_error(hp.FormatError, "file-unreadable", lambda: hp.open_library(tmp_path / "cut.parquet"))


def test_pandas_readers_see_a_row_a_paint(tmp_path):
    starter = hp.paints.starter_library(members=2)
    path = hp.write_library(starter, tmp_path / "starter.parquet")
    rows = pq.read_table(path).to_pylist()
    assert [row["material.name"] for row in rows] == starter["signature"].values.tolist()
    assert {row["material.category"] for row in rows} == {"man_made"}
    assert json.loads(rows[0]["additional_properties"])["finish"] == "solid"
    np.testing.assert_array_equal(
        np.float32([row["spectral_data.values"] for row in rows]), starter.reflectance.values
    )
    path.with_name("starter.parquet.json").unlink()  # as others hand it on
    with pytest.warns(hp.errors.PaintWarning, match="metadata-missing"):
        alone = hp.open_library(path)
    np.testing.assert_array_equal(alone.reflectance.values, starter.reflectance.values)
    assert alone["signature"].values.tolist() == starter["signature"].values.tolist()


def test_names_of_paints_are_unique(tmp_path):
    starter = hp.paints.starter_library(members=0).isel(signature=[0, 1, 2]).assign_coords(signature=[*"aab"])
    with pytest.warns(hp.errors.PaintWarning, match="paint-duplicate"):
        written = hp.write_library(starter, tmp_path / "p.csv")
    assert hp.open_library(written)["signature"].values.tolist() == ["a", "a (2)", "b"]
    path = write_file(
        tmp_path / "plain.csv", "wavelength,a,a,b\n450,0.1,0.2,0.3\n550,0.1,0.3,0.3\n650,0.1,0.2,0.4\n"
    )
    with pytest.warns(hp.errors.PaintWarning, match="paint-duplicate"):
        assert hp.open_library(path)["signature"].values.tolist() == ["a", "a (2)", "b"]


def test_wavelengths_out_of_order_are_sorted(tmp_path):
    path, nm = tmp_path / "rolled.csv", np.roll(np.arange(400, 1001, 50), 3)
    path.write_text("wavelength,a\n" + "".join(f"{x},{x / 1e4}\n" for x in nm))
    with pytest.warns(hp.errors.PaintWarning, match="wavelength-unordered"):
        library = hp.open_library(path)
    np.testing.assert_array_equal(library.wavelength, np.sort(nm))
    np.testing.assert_allclose(library.reflectance.values[0], np.sort(nm) / 1e4, rtol=1e-6)


@pytest.mark.parametrize("name", ["p.csv", "p.sli", "p.parquet"])
def test_per_cent_labelled_1_is_told(tmp_path, name):
    starter = hp.paints.starter_library(members=0)
    starter["reflectance"] = 100.0 * starter["reflectance"].assign_attrs(units="1")
    with pytest.warns(hp.errors.PaintWarning, match="scale-doubtful"):
        path = hp.write_library(starter, tmp_path / name)
    with pytest.warns(hp.errors.PaintWarning, match="scale-doubtful"):
        hp.open_library(path)


def test_a_library_by_wavelength_is_written(tmp_path):
    starter = hp.paints.starter_library(members=2)
    path = hp.write_library(starter.swap_dims(band="wavelength"), tmp_path / "p.parquet", curves="all")
    xr.testing.assert_identical(hp.open_library(path), starter)


def test_a_number_beyond_64_bits_is_refused(tmp_path):
    path = hp.write_library(
        hp.paints.starter_library(members=3).isel(signature=[0, 1, 2]), tmp_path / "p.parquet", curves="all"
    )
    # a number beyond 64 bits
    rows = pq.read_table(path)
    keys = [
        text.replace('"place": 2', f'"place": {10**30}') for text in rows["additional_properties"].to_pylist()
    ]
    at = rows.schema.get_field_index("additional_properties")
    pq.write_table(rows.set_column(at, rows.schema.field(at), pa.array(keys)), path)
    expect_errors((hp.FormatError, "record-unmatched", lambda: hp.open_library(path)))


# --- What is written appears whole or not at all, and nothing is replaced unasked ---


FILES = {"envi": "paints.sli", "csv": "paints.csv", "zarr": "paints.zarr"}


@pytest.fixture
def library(library: xr.Dataset) -> xr.Dataset:
    return library.isel(band=[0, 1, 3, 4])


@pytest.fixture(autouse=True)
def _no_leftovers(tmp_path: Path) -> Iterator[None]:
    yield
    assert not list(tmp_path.glob(".*"))


def state(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.mark.parametrize("format", FILES)
def test_nothing_is_replaced_unasked(library: xr.Dataset, tmp_path: Path, format: str) -> None:
    path = tmp_path / FILES[format]
    assert hp.write_library(library, path, format=format) == path
    before = state(tmp_path)
    other = library.isel(signature=[0, 1])
    expect_errors(
        (StoreError, r"exist.*overwrite=True", lambda: hp.write_library(other, path, format=format))
    )
    assert state(tmp_path) == before
    hp.write_library(other, path, format=format, overwrite=True)
    assert hp.open_library(path).sizes["signature"] == 2
    # a folder with anything else is never replaced
    thesis = tmp_path / "folder" / "thesis.doc"
    thesis.parent.mkdir()
    thesis.write_text("ten years of work")
    expect_errors(
        (
            StoreError,
            r"is a folder|holds|other",
            lambda: hp.write_library(
                library, thesis.parent, format="zarr" if format == "zarr" else "csv", overwrite=True
            ),
        )
    )
    assert thesis.read_text() == "ten years of work"


@pytest.mark.parametrize(
    ("format", "name", "written"),
    [
        ("csv", "paints", "paints.csv"),
        ("csv", "paints.txt", "paints.txt"),
        ("envi", "paints", "paints.sli"),
        ("envi", "paints.hdr", "paints.sli"),
        ("envi", "paints.v2", "paints.v2.sli"),
    ],
)
def test_a_file_gets_the_suffix_that_it_is_known_by(
    library: xr.Dataset, tmp_path: Path, format: str, name: str, written: str
) -> None:
    path = hp.write_library(library, tmp_path / name, format=format)
    assert (path, hp.open_library(path).sizes["signature"]) == (tmp_path / written, 5)


@pytest.mark.parametrize("format", ["envi", "csv"])
@pytest.mark.parametrize("overwrite", [False, True])
def test_a_failure_leaves_what_was_there(
    library: xr.Dataset, tmp_path: Path, format: str, overwrite: bool
) -> None:
    path = tmp_path / FILES[format]
    if overwrite:
        hp.write_library(library.isel(signature=[0]), path, format=format)
    before = state(tmp_path)

    def stop(done: int, total: int) -> None:
        raise KeyboardInterrupt

    expect_error(
        KeyboardInterrupt,
        None,
        lambda: hp.write_library(library, path, format=format, overwrite=overwrite, progress=stop),
    )
    assert state(tmp_path) == before


class Power(BaseException):
    """The lights go out: nothing is cleared up."""


@pytest.mark.parametrize("step", range(3))
@pytest.mark.parametrize("overwrite", [False, True])
def test_a_kill_between_two_renames__leaves_nothing_that_opens_as_another(
    library: xr.Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: int, overwrite: bool
) -> None:
    # Rationale: a library of ENVI is three files; without its header it is none.
    path = tmp_path / "paints.sli"
    old, new = library.isel(signature=[0, 1]), library
    if overwrite:
        hp.write_library(old, path)
    names, left = ("paints.sli", "paints.sli.json", "paints.hdr"), [step]

    def dying(move: Any) -> Any:
        def call(source: Any, target: Any) -> None:
            if Path(target).name in names and Path(target).parent == tmp_path:
                if not left[0]:
                    raise Power
                left[0] -= 1
            move(source, target)

        return call

    with monkeypatch.context() as patched:
        for name in ("replace", "rename"):
            patched.setattr(publishing.os, name, dying(getattr(os, name)))
        patched.setattr(publishing, "_settle", lambda _: None)  # as a process that is killed
        expect_error(Power, None, lambda: hp.write_library(new, path, overwrite=overwrite))
    expect_errors((FormatError, r"no header|no such file", lambda: hp.open_library(path)))
    hp.write_library(new, path, overwrite=overwrite)
    assert hp.open_library(path).sizes["signature"] == 5
    assert sorted(p.name for p in tmp_path.iterdir()) == ["paints.hdr", "paints.sli", "paints.sli.json"]


def test_leftovers_of_a_killed_writer__are_cleared(library: xr.Dataset, tmp_path: Path) -> None:
    stage = tmp_path / ".partial-paints.hdr"
    build = stage / "build-%root-product-0123456789ab"
    build.mkdir(parents=True)
    (build / "paints.sli").write_bytes(b"half")
    (stage / "hyperpaint").write_bytes(MARK_TEXT)
    hp.write_library(library, tmp_path / "paints.sli")
    assert not stage.exists()


def test_one_writer_at_a_time(library: xr.Dataset, tmp_path: Path) -> None:
    path = tmp_path / "paints.csv"

    def second(done: int, total: int) -> None:
        if done == total:  # it is there by now
            return
        expect_errors((StoreError, "is being written", lambda: hp.write_library(library, path)))

    hp.write_library(library, path, progress=second)
    assert hp.open_library(path).sizes["signature"] == 5


def test_a_header_too_large_to_be_read__is_refused(
    library: xr.Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(spectra_files, "MAX_LIBRARY_HEADER_BYTES", 500)
    expect_errors((ValueError, "file-too-large", lambda: hp.write_library(library, tmp_path / "paints.sli")))
    assert list(tmp_path.iterdir()) == []


def test_members_are_written_some_paints_at_a_time(tmp_path: Path) -> None:
    # Rationale: 40,000 lazy members of 100 bands are 16 MB; no more than two lots are in memory at once.
    import dask.array as da

    seen: list[int] = []

    def block(block_info: Any = None) -> np.ndarray:
        seen.append(block_info[None]["array-location"][0][0])
        return np.full((20, 100, 100), 0.5, np.float32)

    lazy = da.map_blocks(
        block, chunks=((20,) * 20, (100,), (100,)), dtype=np.float32, meta=np.empty((0, 0, 0), "f4")
    )
    library = xr.Dataset(
        {
            "reflectance": (("signature", "band"), np.full((400, 100), 0.5, np.float32), {"units": "1"}),
            "member_reflectance": (("signature", "member", "band"), lazy, {"units": "1"}),
        },
        coords={
            "signature": [f"paint {at}" for at in range(400)],
            "wavelength": ("band", np.linspace(400, 1000, 100), {"units": "nm"}),
        },
    )
    done: list[tuple[int, int]] = []
    path = hp.write_library(
        library, tmp_path / "many.sli", curves="all", progress=lambda *call: done.append((len(seen), call[0]))
    )
    assert seen == list(range(0, 400, 20))
    # what is computed is written before the next is
    assert [computed for computed, _ in done[1:]] == list(range(1, 21))
    assert path.stat().st_size == 4 * 100 * (400 + 40_000)
