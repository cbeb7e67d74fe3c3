"""Texts and libraries that hold no reflectance are refused or warned of; those that do open in silence."""

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.refusals import expect_errors
from support.wrong_quantities import NM, Case, objection, remarks, sunlight, table

import hyperpaint as hp
from hyperpaint.base.errors import FormatError

GREY = 0.3 + 0.1 * np.sin(NM / 90.0)
LIGHT = sunlight()
SIGNALLING = np.array(0x7F800001, np.uint32).view(np.float32)


def tabled(
    nm: Any, *columns: Any, heading: str = "", name: str = "paint.csv", **options: Any
) -> Callable[[Path], Any]:
    # a function that writes a table of text and opens it as a library of paints
    return lambda folder: hp.open_library(table(folder / name, nm, *columns, heading=heading), **options)


text = partial(tabled, NM)
TWICE = np.sort(np.append(NM, 500.0))


def sli(values: Any, *header: str) -> Callable[[Path], Any]:
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


def ecostress(values: Any, y: str, x: str = "Wavelength (micrometers)") -> Callable[[Path], Any]:
    # Return what writes a text of the ECOSTRESS library and opens it.

    def opened(folder: Path) -> Any:
        head = [
            "Name: hood", "Type: manmade", "Class: paint", f"X Units: {x}", f"Y Units: {y}",
            f"First X Value: {NM[0] / 1e3}", f"Last X Value: {NM[-1] / 1e3}",
            f"Number of X Values: {NM.size}", "",
        ]  # fmt: skip
        rows = [f"{nm / 1e3:.4f}\t{value:.6g}" for nm, value in zip(NM, values, strict=True)]
        path = folder / "hood.spectrum.txt"
        path.write_text("\n".join([*head, *rows]) + "\n")
        return hp.open_library(path)

    return opened


# flat reflectance with a dip of 6, 15 and 50 % at the oxygen band; wavelengths of which 7 % come again
DIP_6, DIP_15, DIP_50 = (
    np.where(np.abs(NM - 762) <= 5, 0.5 * (1 - depth), 0.5) for depth in (0.06, 0.15, 0.5)
)
AGAIN = np.r_[400.0:600.0, 584.0:600.0]
PLACES = np.arange(NM.size)

WRONG_LIBRARIES = [
    Case("radiance by its heading", text(LIGHT / 9, heading="wavelength (nm),radiance"), "radiance"),
    Case("radiance by its unit", text(LIGHT / 9, heading="nm,W m-2 sr-1 nm-1"), "W m-2"),
    Case("radiance by a unit per cm2", text(LIGHT * 9, heading="nm,hood [uW/cm2/sr/nm]"), "uW"),
    Case("radiance by a title", text(LIGHT / 9, heading="# Radiance of a hood\n# 7\nnm,hood"), "Radiance"),
    Case("radiance beside reflectance", text(LIGHT / 9, GREY, heading="nm,radiance,reflectance"), "radiance"),
    Case("radiance in uW, no word", text(2.75 * LIGHT / LIGHT.max()), "radiance"),
    Case("radiance in W, no word", text(GREY * LIGHT / np.pi), "oxygen band"),
    Case("radiance of a dark paint", text(0.03 * LIGHT), "oxygen band"),
    Case("irradiance in W, no word", text(LIGHT), "radiance"),
    Case("irradiance by its heading", text(LIGHT, heading="nm,Irradiance"), "radiance"),
    Case("irradiance by its unit", text(LIGHT, heading="nm,E (W/m^2/nm)"), "W/m"),
    Case("counts by their heading", text(1e-4 * LIGHT, heading="nm,counts"), "counts"),
    Case("digital numbers", text(np.round(3000 * LIGHT), heading="nm,DN"), "DN"),
    Case("counts, no word", text(np.round(3000 * LIGHT)), "scale"),
    Case("percent, no word", text(100 * GREY), "scale"),
    Case("percent of a black paint", text(2.0 + GREY), "scale"),
    Case("hundredths of a percent", text(np.round(1e4 * GREY)), "scale"),
    Case("one spectrum of two in percent", text(GREY, 100 * GREY, heading="nm,hood,roof"), "scale"),
    Case("fractions said to be percent", text(0.9 * GREY, heading="nm,hood (%)"), "scale="),
    Case("hundredths said to be percent", text(1e4 * GREY, heading="nm,hood (%)"), "scale="),
    Case("a scale that is wrong", text(1e4 * GREY, scale=100), "scale="),
    Case("transmittance", text(GREY, heading="nm,Transmittance"), "Transmi"),
    Case("absorbance", text(GREY, heading="nm,Absorbance"), "Absorb"),
    Case("emissivity", text(GREY, heading="nm,emissivity"), "emissiv"),
    Case("a standard deviation, no word", text(GREY, 0.05 * GREY), "standard deviation"),
    Case("a standard deviation alone", text(0.05 * GREY, heading="nm,std"), "standard deviation"),
    Case("an expanded uncertainty", text(GREY, 0.1 * GREY, heading="nm,hood,uncertainty"), "uncertainty"),
    Case("a number of samples", text(GREY, 0 * GREY + 8, heading="nm,hood,N"), "'N'"),
    Case("a number of spectra", text(GREY, 0 * GREY + 8, heading="nm,hood,n samples"), "n samples"),
    Case("a variance", text(GREY, 0.01 * GREY, heading="nm,hood,variance"), "variance"),
    Case("two spectra one below the other", tabled(np.tile(NM, 2), np.tile(GREY, 2)), "occur twice"),
    Case("wavelengths rounded", tabled(np.round(NM / 1e3, 2), GREY, heading="um,reflectance"), "twice"),
    Case("one wavelength, two values", tabled(TWICE, np.linspace(0.2, 0.3, TWICE.size)), "averaged"),
    Case("micrometres said to be nanometres", text(GREY, heading="nm,hood", wavelength=NM / 1e3), "nm"),
    Case("nanometres said to be micrometres", text(GREY, heading="um,hood"), "nanometres"),
    Case("a shallow oxygen band", text(DIP_15), "oxygen band"),
    Case("an oxygen band at 4 nm", tabled(NM[::2], DIP_50[::2]), "oxygen band"),
    Case("a spread of a third", text(GREY, 0.35 * GREY), "standard deviation"),
    Case("7 % of the wavelengths again", tabled(AGAIN, 0 * AGAIN + 0.3), "side by side"),
    Case("a median above one", text(0 * NM + 1.15), "scale"),
    Case("a seventh of bright values", text(np.where(PLACES % 7 == 0, 1.3, 0.5)), "radiance"),
    Case("a paint that is too black", text(0 * NM + 0.7, heading="nm,black (percent)"), "scale="),
    Case("wavenumbers", text(GREY, heading="wavenumber (cm-1),hood"), "wavenumber"),
    Case("a library of radiance", sli(LIGHT / 9, "z plot titles = {Wavelength, Radiance}"), "Radiance"),
    Case("a library of light, no word", sli(LIGHT / 9), "oxygen band"),
    Case("a library in percent, no word", sli(100 * GREY), "scale"),
    Case("a library whose scale is wrong", sli(1e4 * GREY, "reflectance scale factor = 100"), "scale="),
    Case("ECOSTRESS text of radiance", ecostress(LIGHT / 9, "Radiance (W m-2 sr-1 nm-1)"), "Radiance"),
    Case("ECOSTRESS text of fractions", ecostress(0.9 * GREY, "Reflectance (percent)"), "scale="),
]  # fmt: skip

RIGHT_LIBRARIES = [
    Case("a fraction", text(GREY), ""),
    Case("a fraction, named", text(GREY, heading="wavelength (nm),reflectance"), ""),
    Case("percent, named", text(100 * GREY, heading="wavelength (nm),reflectance (%)"), ""),
    Case("percent of a black paint, named", text(0 * NM + 1.5, heading="nm,black (percent)"), ""),
    Case("percent, told", text(100 * GREY, scale=100), ""),
    Case("a dip of 6 % at the oxygen band", text(DIP_6), ""),
    Case("a dip at a step of 10 nm", tabled(NM[::5], DIP_50[::5]), ""),
    Case("a darker paint", text(GREY, 0.7 * GREY), ""),
    Case("a fifteenth of bright values", text(np.where(PLACES % 15 == 0, 1.3, 0.5)), ""),
    Case("a white panel", text(0 * NM + 0.99, heading="nm,panel"), ""),
    Case("a fluorescent paint", text(GREY + 1.1 * np.exp(-(((NM - 610) / 12) ** 2))), ""),
    Case("a paint and its spread", text(GREY, 0.05 * GREY, heading="nm,hood,std"), ""),
    Case("two paints with spreads", text(GREY, GREY / 9, GREY / 2, GREY / 8, heading="nm,a,sd,b,sd"), ""),
    Case("two paints", text(GREY, 0.1 * GREY, heading="nm,white,black"), ""),
    Case("two paints, told", text(GREY, 0.1 * GREY, quantity="reflectance"), ""),
    Case("reflectance made of radiance", text(GREY, heading="# from radiance\nnm,reflectance"), ""),
    Case("light, told to be reflectance", text(GREY * LIGHT, quantity="reflectance"), ""),
    Case("a shift of the oxygen band", text(GREY * (1 + 0.03 * np.exp(-(((NM - 761) / 3) ** 2)))), ""),
    Case("a sharp dip elsewhere", text(GREY * (1 - 0.5 * np.exp(-(((NM - 690) / 3) ** 2)))), ""),
    Case("vegetation", text(0.04 + 0.4 / (1 + np.exp(-(NM - 715) / 9))), ""),
    Case("a library", sli(GREY), ""),
    Case("a library with a signalling NaN", sli(np.where(NM == 700, SIGNALLING, np.float32(GREY))), ""),
    Case("a library in percent", sli(100 * GREY, "z plot titles = {Wavelength, Reflectance (%)}"), ""),
    Case("ECOSTRESS text", ecostress(100 * GREY, "Reflectance (percent)"), ""),
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
    library = text(GREY, GREY / 9, GREY / 2, heading="nm,a,a sd,b")(tmp_path)
    assert library["signature"].values.tolist() == ["a", "b"]
    np.testing.assert_allclose(library["reflectance_sd"].values[0], GREY / 9, rtol=1e-6)
    assert np.isnan(library["reflectance_sd"].values[1]).all()


def test_a_white_standard_is_a_paint(tmp_path: Path) -> None:
    # Words of a spread name one only where the rest of the heading names another column.
    names = ["Red 12", "White Std", "SD45"]
    assert (
        text(GREY, GREY / 2, GREY / 3, heading="nm," + ",".join(names))(tmp_path)["signature"].values.tolist()
        == names
    )
    spread = text(GREY, GREY / 2, GREY / 9, GREY / 8, heading="nm,red,blue,blue std,red std")(tmp_path)
    assert spread["signature"].values.tolist() == ["red", "blue"]
    np.testing.assert_allclose(spread["reflectance_sd"].values[0], GREY / 8, rtol=1e-6)
