"""Files as programs write them, and what is wrong with others, said in a sentence."""

import contextlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.refusals import expect_errors, expect_refusals

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
NM = "wavelength units = Nanometers\nwavelength = {450, 550, 650}\n"


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
    library = hp.open_library(write_sli(tmp_path, np.array(ROWS) * scale, NAMES + NM + more))
    np.testing.assert_allclose(library["reflectance"].values, ROWS, rtol=1e-6)
    assert library["signature"].values.tolist() == ["red", "blue"]


@pytest.mark.parametrize("unit", ["Micrometers", "um", "Unknown"])
def test_sli__micrometres(tmp_path: Path, unit: str) -> None:
    library = hp.open_library(
        write_sli(tmp_path, ROWS, NAMES + f"wavelength units = {unit}\nwavelength = {{0.65, 0.55, 0.45}}\n")
    )
    np.testing.assert_allclose(library["wavelength"].values, [650.0, 550.0, 450.0])
    assert ("micrometres" in library.attrs.get("notes", "")) == (unit == "Unknown")


WAVENUMBERS = NAMES + "wavelength units = Wavenumber\nwavelength = {1, 2, 3}\n"
TITLE = "z plot titles = {wavelength, reflectance [*10000]}\n"


@pytest.mark.parametrize(
    ("factor", "more", "options", "code"),
    [
        (100, NAMES + NM, {}, "scale-missing"),
        (100, NAMES + NM, {"scale": -1}, "value-out-of-range"),
        (1e4, f"{NAMES}{NM}reflectance scale factor = 1\n{TITLE}", {}, "scale-conflict"),
        (1, WAVENUMBERS, {}, "wavelength-missing"),
        (1, WAVENUMBERS, {"wavelength": [450, 550]}, "length-mismatch"),
        (1, WAVENUMBERS, {"wavelength": [[450, np.nan]]}, "value-out-of-range"),
        (1, f"{NAMES}{NM}z plot titles = {{Wavelength, Emissivity}}\n", {}, "quantity-wrong"),
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
        write_sli(tmp_path, np.array(ROWS) * 100, WAVENUMBERS),
        scale=100, wavelength=[450, 550, 650], fwhm=np.full(3, 5.0),
    )  # fmt: skip
    np.testing.assert_allclose(given["reflectance"].values, ROWS, rtol=1e-6)
    assert (given["wavelength"].values.tolist(), given["fwhm"].values.tolist()) == (
        [450.0, 550.0, 650.0],
        [5.0] * 3,
    )


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
        library = hp.open_library(write_sli(tmp_path, ROWS, names + NM))
    assert library["signature"].values.tolist() == ["spectrum 1", "spectrum 2"]


def test_sli__bad_bands_are_not_good(tmp_path: Path) -> None:
    assert hp.open_library(write_sli(tmp_path, ROWS, NAMES + NM + "bbl = {1, 0, 1}\n"))[
        "good"
    ].values.tolist() == [True, False, True]


def test_sli__what_does_not_fit_is_listed(tmp_path: Path) -> None:
    path = write_sli(tmp_path, ROWS, NAMES + NM)
    header = path.with_suffix(".hdr")
    header.write_text(header.read_text().replace("bands = 1", "bands = 2"))
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(FormatError) as caught:
        hp.open_library(header)
    assert caught.value.codes == ("dims-wrong", "file-size")
    assert "bands is 2, expected 1" in str(caught.value)
    assert "23 bytes, expected 48" in str(caught.value)
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
        ("nm,red (%),red (1)\n450,10,40\n550,20,50\n", "red.txt", ["red (%)", "red (1)"]),
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
    assert (
        library["wavelength"].values.tolist(),
        library["fwhm"].values.tolist(),
        library["signature"].item(),
    ) == ([450.0, 550.0, 650.0], [10.0] * 3, "Red paint GDS1")
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
    path = write_sli(tmp_path, ROWS, NAMES + NM)
    (tmp_path / "x.csv").write_text("spectra names,kind\nred,car\nblue,van\n")
    table = write_text(tmp_path, "nm,grey\n450,0.1\n550,0.2\n650,0.3\n", "x-grey.csv")
    library = hp.open_library(str(tmp_path / "x*"))
    assert (
        library["signature"].values.tolist(),
        library["kind"].values.tolist(),
        library["file"].values.tolist(),
    ) == (["red", "blue", "grey"], ["car", "van", ""], [path.with_suffix(".hdr").name] * 2 + [table.name])


def test_several__a_width_of_one_file_is_left_out_and_said(tmp_path: Path) -> None:
    library = hp.open_library(
        [
            write_sli(tmp_path, ROWS, NAMES + NM + "fwhm = {5, 5, 5}\n"),
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
    assert (
        library["signature"].values.tolist(),
        library["type"].values.tolist(),
        library["reflectance"].shape,
    ) == (["red 1", "red 2", "red 10", tmp_path.name], ["manmade"] * 3 + [""], ((4, 3)))


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
    assert (
        hp.open_library(path, scale=1)["reflectance"].values.max(),
        hp.open_library(path, scale=100)["reflectance"].values.max(),
    ) == (pytest.approx(1.3), pytest.approx(0.013))


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
    path = write_sli(tmp_path, rows, f"{NAMES}{NM}reflectance scale factor = 10000\n{more}")
    warned = pytest.warns(PaintWarning, match="values-far-below-zero")
    with contextlib.nullcontext() if more else warned:
        values = hp.open_library(path)["reflectance"].values
    assert np.isnan(values).tolist() == [[False, True, False], [True, False, False]]
