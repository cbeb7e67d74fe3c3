"""Headers of other programs: keys that change the meaning of samples are honoured, or named."""

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from support.refusals import expect_errors
from support.wrong_quantities import objection, remarks

from hyperpaint.base.errors import FormatError
from hyperpaint.io.envi.envi_cubes import open_envi

SIZES = "ENVI\nsamples = 4\nlines = 10\nbands = 3\nheader offset = 0\ndata type = 12\nbyte order = 0\n"
PLAIN = "interleave = bil\nwavelength units = nm\nwavelength = {500, 510, 520}\n"
PLACE = "map info = {UTM, 1, 1, 500000, 4500000, 0.5, 0.5, 18, North, WGS-84}\n"


def header(folder: Path, text: str) -> Path:
    (folder / "a.hdr").write_text(SIZES + text)
    np.arange(120, dtype="u2").tofile(folder / "a")
    return folder / "a.hdr"


@pytest.mark.parametrize(
    ("unit", "wavelength", "fwhm", "expected", "is_told"),
    [
        ("um", "0.5, 0.51, 0.52", "5, 5, 5", 5.0, True),
        ("nm", "500, 510, 520", "0.005, 0.005, 0.005", 5.0, True),
        ("Unknown", "0.5, 0.51, 0.52", "5, 6, 5", 5.0, True),
        ("Angstroms", "5000, 5100, 5200", "5, 5, 5", 0.5, False),
        ("um", "0.5, 0.51, 0.52", "0.005, 0.005, 0.005", 5.0, False),
        ("nm", "760, 760.1, 760.2", "0.11, 0.11, 0.11", 0.11, False),
        ("nm", "450, 550, 850", "60, 60, 150", 60.0, False),
        ("nm", "500, 510, 520", "0, 0, 0", 0.0, False),
    ],
)
def test_widths_in_another_unit(
    unit: str, wavelength: str, fwhm: str, expected: float, is_told: bool, tmp_path: Path
) -> None:
    lists = f"wavelength units = {unit}\nwavelength = {{{wavelength}}}\nfwhm = {{{fwhm}}}\n"
    path = header(tmp_path, f"interleave = bil\ndescription = {{raw}}\n{lists}")
    said = remarks(lambda _: open_envi(path), tmp_path)
    assert [text for text in said if "fwhm" in text] == said * is_told
    with pytest.warns(match="header-doubtful") if is_told else xr.set_options():
        np.testing.assert_allclose(open_envi(path).fwhm[0], expected)


@pytest.mark.parametrize(
    ("text", "code", "word"),
    [
        (PLAIN + "file type = PCI\n", "file-type-wrong", "PCI"),
        (PLAIN + "file type = ERDAS IMAGINE\n", "file-type-wrong", "ERDAS"),
        (
            PLAIN + "file type = ENVI Standard\nread procedures = {a, b}\n",
            "file-type-wrong",
            "read procedures",
        ),
        (PLAIN + "data reflectance gain values = {1, 2, 3}\n", "header-doubtful", "data reflectance gain"),
        (PLAIN + "radiance scale factor = 100\n", "header-doubtful", "radiance scale factor"),
        (PLAIN.replace("bil", "bsq") + "autodarkstartline = 8\n", "header-doubtful", "autodarkstartline"),
        (PLAIN + "autodarkstartline = {8}\n", "header-doubtful", "autodarkstartline"),
        (PLAIN + "autodarkstartline = 12\n", "header-doubtful", "autodarkstartline"),
    ],
)
def test_keys_that_change_samples_are_named(text: str, code: str, word: str, tmp_path: Path) -> None:
    path = header(tmp_path, text)
    said = objection(lambda _: open_envi(path), tmp_path)
    assert code in said
    assert word in said


@pytest.mark.parametrize(
    ("text", "name"),
    [
        (PLACE + "description = {[HEADWALL Hyperspec III],[HEADWALL Hyperspec III OR]}\n", "values"),
        (PLACE + "description = {raw_0 OR}\nfile type = ENVI\n", "values"),
        (PLACE + "data units = DN\n", "counts"),
        ("description = {[HEADWALL Hyperspec III]}\n", "counts"),
        ("autodarkstartline = 8\ndescription = {raw}\n", "counts"),
        ("autodarkstartline = 0\ndescription = {raw}\n", "counts"),
    ],
)
def test_integers_of_a_map_are_counts_only_by_their_units(text: str, name: str, tmp_path: Path) -> None:
    path = header(tmp_path, PLAIN + text)
    assert remarks(lambda _: open_envi(path), tmp_path) == []
    cube = open_envi(path)
    assert list(cube.data_vars) == [name]
    assert cube.sizes.get("along_track", 10) == (8 if "= 8" in text else 10)


def test_a_map_of_integers_is_no_dark(tmp_path: Path) -> None:
    path = header(tmp_path, PLAIN + PLACE)
    assert "values" in open_envi(path, unsaid="counts").data_vars
    expect_errors((FormatError, "dark-missing", lambda: open_envi(path, dark_lines=True)))
