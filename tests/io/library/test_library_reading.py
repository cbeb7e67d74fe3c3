"""Files as programs write them, and what is wrong with others, said in a sentence."""

import contextlib
import importlib
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.refusals import expect_errors, expect_refusals, expect_words
from support.wrong_quantities import NM, Case, objection, remarks, sunlight, table

import hyperpaint as hp
from hyperpaint.base.errors import FormatError, PaintWarning, StoreError

HEADER = """ENVI
samples = {samples}
lines = {lines}
bands = 1
data type = 4
interleave = bsq
byte order = 0
file type = ENVI Spectral Library
"""
NAMES = "spectra names = {red, blue}\n"
NANOMETRES = "wavelength units = Nanometers\nwavelength = {450, 550, 650}\n"


def write_sli(folder: Path, rows: object, more: str) -> Path:
    values = np.asarray(rows, "<f4")
    values.tofile(folder / "x.sli")
    lines, samples = values.shape
    (folder / "x.hdr").write_text(HEADER.format(samples=samples, lines=lines) + more, encoding="utf-8")
    return folder / "x.sli"


def write_text(folder: Path, text: str, name: str = "red.txt", encoding: str = "utf-8") -> Path:
    path = folder / name
    path.write_bytes(text.encode(encoding))
    return path


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
    library = hp.open_library(write_sli(tmp_path, np.array(ROWS) * scale, NAMES + NANOMETRES + more))
    np.testing.assert_allclose(library["reflectance"].values, ROWS, rtol=1e-6)
    assert library["signature"].values.tolist() == ["red", "blue"]


@pytest.mark.parametrize("unit", ["Micrometers", "um", "Unknown"])
def test_sli__micrometres(tmp_path: Path, unit: str) -> None:
    library = hp.open_library(
        write_sli(tmp_path, ROWS, NAMES + f"wavelength units = {unit}\nwavelength = {{0.65, 0.55, 0.45}}\n")
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
    library = hp.open_library(write_sli(tmp_path, ROWS, f"{NAMES}wavelength units = {unit}\n{text}"))
    np.testing.assert_allclose(library["wavelength"].values, nm)
    np.testing.assert_allclose(library["fwhm"].values, 5.0, rtol=1e-4)


BAND_NUMBERS = NAMES + "wavelength units = Index\nwavelength = {1, 2, 3}\n"
TITLE = "z plot titles = {wavelength, reflectance [*10000]}\n"


@pytest.mark.parametrize(
    ("factor", "more", "options", "code"),
    [
        (100, NAMES + NANOMETRES, {}, "scale-missing"),
        (100, NAMES + NANOMETRES, {"scale": -1}, "value-out-of-range"),
        (1e4, f"{NAMES}{NANOMETRES}reflectance scale factor = 1\n{TITLE}", {}, "scale-conflict"),
        (1, BAND_NUMBERS, {}, "wavelength-missing"),
        (1, BAND_NUMBERS, {"wavelength": [450, 550]}, "length-mismatch"),
        (1, BAND_NUMBERS, {"wavelength": [[450, np.nan]]}, "value-out-of-range"),
        (1, f"{NAMES}{NANOMETRES}z plot titles = {{Wavelength, Emissivity}}\n", {}, "quantity-wrong"),
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
    assert hp.open_library(write_sli(tmp_path, ROWS, NAMES + NANOMETRES + "bbl = {1, 0, 1}\n"))[
        "good"
    ].values.tolist() == [True, False, True]


def test_sli__what_does_not_fit_is_listed(tmp_path: Path) -> None:
    path = write_sli(tmp_path, ROWS, NAMES + NANOMETRES)
    header = path.with_suffix(".hdr")
    header.write_text(header.read_text().replace("bands = 1", "bands = 2"))
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(FormatError) as caught:
        hp.open_library(header)
    assert caught.value.codes == ("dims-wrong", "file-size")
    expect_words(str(caught.value), "bands is 2, expected 1", "23 bytes, expected 48")
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
        ("450,0.1\n550,0.2\n", "text-unreadable"),
        ("1,0.1\n2e9,0.2\n", "wavelength-range"),
        ("".join(f"{500 + (-1) ** at * at},0.1\n" for at in range(60)), "wavelength-unordered"),
    ],
)
def test_tables__what_is_none_is_refused(tmp_path: Path, text: str, said: str) -> None:
    expect_errors(
        (
            FormatError,
            said,
            lambda: hp.open_library(
                write_text(tmp_path, text, encoding="utf-16" if said == "text-unreadable" else "utf-8")
            ),
        )
    )


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
        with pytest.raises(FormatError, match="option-conflict"):
            hp.open_library(own, scale=100)


def test_patterns__take_a_library_of_two_files_once(tmp_path: Path) -> None:
    path = write_sli(tmp_path, ROWS, NAMES + NANOMETRES)
    (tmp_path / "x.csv").write_text("spectra names,kind\nred,car\nblue,van\n")
    table = write_text(tmp_path, "nm,grey\n450,0.1\n550,0.2\n650,0.3\n", "x-grey.csv")
    library = hp.open_library(str(tmp_path / "x*"))
    assert library["signature"].values.tolist() == ["red", "blue", "grey"]
    assert library["kind"].values.tolist() == ["car", "van", ""]
    assert library["file"].values.tolist() == [path.with_suffix(".hdr").name] * 2 + [table.name]


def test_several__a_width_of_one_file_is_left_out_and_said(tmp_path: Path) -> None:
    library = hp.open_library(
        [
            write_sli(tmp_path, ROWS, NAMES + NANOMETRES + "fwhm = {5, 5, 5}\n"),
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
    import xarray as xr

    hp.to_store(xr.Dataset({"x": ("y", [1.0])}), tmp_path / "x.zarr")
    expect_errors((FormatError, "library-missing", lambda: hp.open_library(tmp_path / "x.zarr")))
    with pytest.raises(StoreError):
        hp.open_library(tmp_path / "absent.zarr")


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
    path = write_sli(tmp_path, rows, f"{NAMES}{NANOMETRES}reflectance scale factor = 10000\n{more}")
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
    with pytest.raises(FormatError) as caught:
        hp.open_library(text)
    message = str(caught.value)
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
        path = folder / "paints.csv"
        path.write_text("\n".join(map(",".join, [[head, *map(str, NM)], *rows])) + "\n", encoding="utf-8")
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
        path = folder / "hood.spectrum.txt"
        path.write_text("\n".join([*head, *rows]) + "\n")
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
