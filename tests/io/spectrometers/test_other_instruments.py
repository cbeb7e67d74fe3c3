"""Files of further instruments, loggers, libraries and laboratories: the right value, or the right code.

The layouts follow files that makers and users published (photobiologyInOut, lightr, EnMAP-Box, EcoSIS, USGS,
FidRadDB); the files here are written after them, since the licences of the originals forbid copies.
"""

import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import ROOT
from support.refusals import expect_refusals

import hyperpaint as hp
from hyperpaint.base.errors import FormatError, PaintError, PaintWarning, TimeError
from hyperpaint.io.spectrometers.asd import EXPORTS
from hyperpaint.io.spectrometers.irradiance import open_irradiance
from hyperpaint.io.spectrometers.spectrum_texts import DIALECTS, FORMS, read_spectrum_text

NM = np.arange(350.0, 1050.0, 5.0)
LIGHT = 1.2 * np.exp(-(((NM - 600.0) / 300.0) ** 2))  # W m-2 nm-1


def columns(*values: Any, sep: str = "\t", comma: bool = False, end: str = "\n", form: str = ".6f") -> str:
    # Return lines of numbers: wavelengths, then columns of values
    texts = (
        sep.join([f"{nm:.2f}", *(f"{cell:{form}}" for cell in row)])
        for nm, *row in zip(NM, *(np.broadcast_to(each, NM.shape) for each in values), strict=True)
    )
    text = end.join(texts) + end
    return text.replace(".", ",") if comma else text


def darwin(headings: str, rows: str, units: str = "W/m^2/sr/nm", measurement: str = "REFLECTANCE") -> str:
    # Return a file of Spectral Evolution's DARWin
    return (
        "Comment: left door\nVersion: 2.3 [1.2.6250C]\nFile Name: folder\\door.sed\n"
        "Instrument: PSR-3500_SN1 [3]\n"
        f"Measurement: {measurement}\nDate: 03/05/2024,03/05/2024\nTime: 10:00:00.07,10:00:20.07\n"
        f"Averages: 5,5\nIntegration: 15,30,50,30\nRadiometric Calibration: RADIANCE\nUnits: {units}\n"
        f"Latitude: 72.35670\nLongitude: n/a\nGPS Time: n/a\nColumns [4]:\nData:\n{headings}\n{rows}"
    )


def ocean(rows: str, first: str = "SpectraSuite Data File", more: str = "", heading: str = "") -> str:
    # Return a file of Ocean Optics
    return (
        f"{first}\n++++++++++++++++++++++++++++++++++++\nDate: Sat Jun 01 10:00:00 CEST 2024\n"
        f"Dark Spectrum Present: Yes\nIntegration Time (usec): 70000 (QEA7025)\n"
        "Spectra Averaged: 3 (QEA7025)\n"
        f"{more}>>>>>Begin Processed Spectral Data<<<<<\n{heading}{rows}"
    )


def avantes(names: str, units: str, rows: str) -> str:
    # Return a text of AvaSoft
    head = (
        "1305084U1- I C\nIntegration time: 95,00 ms\nAverage: 20 scans\nNr of pixels used for smoothing: 1\n"
    )
    return f"{head}Data measured with spectrometer name: 1305084U1\n{names}\n{units}\n{rows}"


END = ">>>>>End Processed Spectral Data<<<<<\n"
LI180 = (
    "Model Name\tLI-180\nSerial Number\tA18M0157\nTime\t2021/03/02_09:24:26\nPPFD\t129.9\nUV%\t1.36\n"
    "R:B\t1.48\nCustom1(655~665nm)\t5.05\nI-Time\t92.0\n"
    + "".join(f"{nm:.0f}nm\t{1e3 * light:.6f}\n" for nm, light in zip(NM, LIGHT, strict=True))
    + "CCT\t5465.0\nu'\t0.203671\nR15\t97.8\n"
)
RAD = "Wvl\tRad. (Ref.)\tRad. (Target)\tTgt./Ref. %"

REFLECTANCES: dict[str, tuple[str, str, dict[str, Any]]] = {
    "radiance of both, their ratio": ("a.sed", darwin(RAD, columns(0.08, 0.02, 25.0, form=".6E")), {}),
    "two columns": ("a.sed", darwin("Wvl\tReflect. %", columns(25.0)), {}),
    "a fraction": ("a.sed", darwin("Wvl\tReflect. [1.0]", columns(0.25)), {}),
    "channels": (
        "a.sed",
        darwin(
            "Chan.#\tWvl\tReflect. %",
            "".join(f"{n}\t{line}\n" for n, line in enumerate(columns(25.0).splitlines())),
        ),
        {},
    ),
    "as CSV": (
        "a.csv",
        darwin("Wvl,Norm. DN (Ref.),Norm. DN (Target),Reflect. %", columns(723.0, 112.0, 25.0, sep=","))
        .replace("Columns [4]:", "Columns [4]:,,,")
        .replace("Data:", "Data:,,,"),
        {},
    ),
    "radiances without a ratio": (
        "a.sed",
        darwin("Wvl\tRad. (Ref.)\tRad. (Target)", columns(0.08, 0.02, form=".4E")),
        {},
    ),
    "Jaz, declared": (
        "a.jaz",
        ocean(columns(1.0, 9.0, 3.0, 25.0), "Jaz Data File", heading="W\tD\tR\tS\tP\n") + END,
        {"quantity": "reflectance", "scale": 100},
    ),
    "R in percent": ("a.txt", ocean(columns(25.0), heading="lambda / nm\tR / %\n") + END, {}),
    "mode by a word": ("a.txt", ocean(columns(25.0), more="Mode: Reflection [%]\n") + END, {}),
    "mode by a word, commas": (
        "a.txt",
        ocean(columns(25.0, comma=True), more="Mode: Reflectance [%]\n") + END,
        {},
    ),
    "Avantes": (
        "a.ttt",
        avantes(
            "Wave   ;Dark     ;Ref      ;Sample   ;Reflectance",
            "[nm]   ;[counts] ;[counts] ;[counts] ;[%]",
            "\n" + columns(3.0, 6429.0, 124.0, 25.0, sep=";", comma=True),
        ),
        {},
    ),
    "EcoSIS": (
        "e.csv",
        "Site,Target Name,Wavelength Units,Measurement Units," + ",".join(f"{x:g}" for x in NM)
        + "\n" + "lot,door,Nanometers,percent," + ",".join(["25"] * NM.size) + "\n",
        {},
    ),
    "EcoSIS in micrometres": (
        "e.csv",
        "id;Wavelength Units;" + ";".join(f"{x / 1e3:g}" for x in NM)
        + "\n" + "door;micrometers;" + ";".join(["0,25"] * NM.size) + "\n",
        {},
    ),
    **{
        f"a row a spectrum, {form}": (
            "e.csv",
            "name," + ",".join(form.format(x, x / 1e3) for x in NM) + "\ndoor" + ",0.25" * NM.size + "\n",
            {},
        )
        for form in ("{1:g}", "{1:g} um", "wl_{0:g}", "nm{0:g}", "R{0:g}", "Reflectance_{0:g}")
    },
    "a row a spectrum, name last": (
        "e.csv",
        ",".join(f"{x:g}" for x in NM) + ",name\n" + "0.25," * NM.size + "door\n",
        {},
    ),
    "headings of R": (
        "e.csv",
        '"","sample_name",' + ",".join(f'"X{x:g}"' for x in NM)
        + '\n"1","door, left",' + ",".join(["0.25"] * NM.size) + "\n",
        {},
    ),
    "SPECCHIO": (
        "s.csv",
        "File Name,door.000\nLocation Name,Hyytiala, Finland\nFile Comments,\nLatitude,61.82\nFOV,25\n"
        + columns(0.25, sep=","),
        {},
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", REFLECTANCES)
def test_reflectance_of_others(name: str, tmp_path: Path) -> None:
    file, text, options = REFLECTANCES[name]
    (tmp_path / file).write_text(text, encoding="utf-8")
    library = hp.open_library(tmp_path / file, **options)
    assert library["reflectance"].dims == ("signature", "band")
    np.testing.assert_allclose(library["reflectance"].values, [[0.25] * NM.size], rtol=1e-6)
    np.testing.assert_allclose(library["wavelength"].values, NM, rtol=1e-12)
    # what was read is written and read again with the same values
    again = hp.open_library(hp.write_library(library, tmp_path / "again.csv"))
    np.testing.assert_array_equal(again["reflectance"].values, library["reflectance"].values)


def test_properties_of_samples_are_kept(tmp_path: Path) -> None:
    path = tmp_path / "eco.csv"
    path.write_text(
        "Site,sample name,Latitude,n,450,550,650\nlot,roof 1,61.5,3,.1,.15,.17\nlot,roof 2,,4,.2,,.26\n"
    )
    library = hp.open_library(path)
    assert library["signature"].values.tolist() == ["roof 1", "roof 2"]
    assert library["site"].values.tolist() == ["lot", "lot"]
    np.testing.assert_array_equal(library["latitude"].values, [61.5, np.nan])
    assert np.isnan(library["reflectance"].values[1, 1])
    path.write_text("File Name,red,blue\nAltitude,170.0,171.5\n450,0.1,0.2\n550,0.3,0.4\n650,0.5,0.6\n")
    library = hp.open_library(path)
    assert library["signature"].values.tolist() == ["red", "blue"]
    assert library["altitude"].values.tolist() == [170.0, 171.5]
    np.testing.assert_allclose(library["reflectance"].values, [[0.1, 0.3, 0.5], [0.2, 0.4, 0.6]])


IRRADIANCES: dict[str, tuple[str, str, dict[str, Any]]] = {
    "DARWin": (
        "a.sed",
        darwin(
            "Wvl\tIrrad. (Ref.)\tIrrad. (Target)",
            columns(1.0, LIGHT, form=".6E"),
            "W/m^2/nm",
            "DIRECT_ENERGY",
        ),
        {"utc_offset_h": 0},
    ),
    "Jaz": (
        "a.JazIrrad",
        ocean(columns(3.0, 90.0, 100.0 * LIGHT), "Jaz Absolute Irradiance File", heading="W\tD\tS\tP\n")
        + END
        + ">>>>>Begin Calibration Data<<<<<\n7.685e-04\n>>>>>End Calibration Data<<<<<\n",
        {},
    ),
    "Jaz, commas": (
        "a.JazIrrad",
        ocean(
            columns(3.0, 90.0, 100.0 * LIGHT, comma=True),
            "Jaz Absolute Irradiance File",
            heading="W\tD\tS\tP\n",
        )
        + END,
        {},
    ),
    "OceanView": (
        "a.OVIrrad",
        ocean(columns(100.0 * LIGHT, comma=True), "Data from roof_AbsoluteIrradiance__0__19-20.txt Node"),
        {},
    ),
    "Spanish": (
        "a.txt",
        ocean(columns(100.0 * LIGHT, comma=True), "Fichero De SpectraSuite", "Unidades: uW/cm^2/nm\n")
        .replace(">>>>>Begin Processed Spectral Data<<<<<", ">>>>> Comienza Data<<<<< Espectral")
        + ">>>>> Data<<<<< Espectral Procesado Extremo\n",
        {"units": "uW cm-2 nm-1", "quantity": "irradiance"},
    ),
    "LI-180": ("a.txt", LI180, {"utc_offset_h": 2}),
}  # fmt: skip


@pytest.mark.parametrize("name", IRRADIANCES)
def test_irradiance_of_others(name: str, tmp_path: Path) -> None:
    file, text, options = IRRADIANCES[name]
    (tmp_path / file).write_text(text, encoding="utf-8")
    opened = open_irradiance(tmp_path / file, fwhm_nm=1.5, max_gap_s=5, **options)
    np.testing.assert_allclose(opened["irradiance"].values[0], LIGHT, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(opened["irradiance_wavelength"].values, NM)


def test_units_of_avantes_irradiance_are_those_of_the_file(tmp_path: Path) -> None:
    rows = columns(100.0 * LIGHT, sep=";", comma=True)
    (tmp_path / "a.ttt").write_text(avantes("Wave ;AbsIrr", "[nm] ;[µW/cm²/nm]", rows), encoding="latin-1")
    opened = hp.open_asd(tmp_path / "a.ttt", "irradiance")
    np.testing.assert_allclose(opened["irradiance"].values[0], LIGHT, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(
    ("date", "expected"),
    [("03/05/2024", "2024-03-05"), ("13.05.2024", "2024-05-13"), ("05.06.2024", "2024-06-05")],
)
def test_dates_of_darwin(tmp_path: Path, date: str, expected: str) -> None:
    text = darwin("Wvl\tReflect. %", columns(25.0)).replace("03/05/2024", date)
    (tmp_path / "a.sed").write_text(text)
    time = read_spectrum_text(tmp_path / "a.sed").local_time
    assert time is not None
    assert time.date().isoformat() == expected


def test_a_date_that_cannot_be_read_is_told(tmp_path: Path) -> None:
    (tmp_path / "a.sed").write_text(
        darwin("Wvl\tReflect. %", columns(25.0)).replace("03/05/2024", "31/31/2024")
    )
    with pytest.warns(PaintWarning, match="time-unreadable"):
        assert read_spectrum_text(tmp_path / "a.sed").local_time is None


def test_zone_and_window_of_a_date(tmp_path: Path) -> None:
    (tmp_path / "a.JazIrrad").write_text(IRRADIANCES["Jaz"][1])
    opened = open_irradiance(tmp_path / "a.JazIrrad", fwhm_nm=1.5, max_gap_s=5)
    expect_refusals(
        (
            TimeError,
            "argument-missing",
            "csv",
            "xarray",
            lambda: open_irradiance(tmp_path / "a.JazIrrad", fwhm_nm=1.5),
        )
    )
    # 10:00:00 CEST at the end of three scans of 70 ms
    assert opened["irradiance_time"].values[0] == np.datetime64("2024-06-01T07:59:59.895")
    (tmp_path / "door.sed").write_text(REFLECTANCES["radiance of both, their ratio"][1])
    field = hp.open_asd(tmp_path / "door.sed", "radiance", utc_offset_h=1)
    np.testing.assert_allclose(field["radiance"].values, [[0.02] * NM.size])
    assert field["time"].values[0] == np.datetime64("2024-03-05T09:00:20.07")
    assert "Spectral Evolution" in field.attrs["instrument"]


def logged(
    head: str = "time",
    sep: str = ",",
    unit: str = "",
    dates: str = "2024-06-01T10:00:{:02d}Z",
    *,
    comma: bool = False,
) -> str:
    rows = (
        dates.format(2 * k) + sep
        + sep.join(f"{x:.5f}".replace(".", "," if comma else ".") for x in LIGHT * (1 + 0.01 * k))
        for k in range(4)
    )  # fmt: skip
    heading = sep.join([head, *(f"{x:g}{unit}" for x in NM)])
    return f"# units: W m-2 nm-1\n# fwhm_nm: 3\n{heading}\n" + "\n".join(rows) + "\n"


@pytest.mark.parametrize(
    ("text", "first"),
    [
        (logged(), "2024-06-01T10:00:00"),
        (logged("Timestamp", unit=" nm"), "2024-06-01T10:00:00"),
        (logged('"Date/Time"', ";", " [nm]", comma=True), "2024-06-01T10:00:00"),
        (logged("Time (UTC)", "\t", "nm", "2024-06-01 10:00:{:02d}", comma=True), "2024-06-01T10:00:00"),
        (logged("datetime", dates="06/13/2024 10:00:{:02d} AM"), "2024-06-13T10:00:00"),
        (logged("datetime", ";", dates="13.06.2024 10:00:{:02d}", comma=True), "2024-06-13T10:00:00"),
        (logged("unix time", dates="17172360{:02d}"), "2024-06-01T10:00:00"),
        (logged("Date,Time", dates="2024-06-01,10:00:{:02d}"), "2024-06-01T10:00:00"),
        (logged("time", ",", "nm").replace("# units", "units"), None),
    ],
)
def test_csv_of_loggers(text: str, first: str | None, tmp_path: Path) -> None:
    path = tmp_path / "sky.csv"
    path.write_text(text)
    if first is None:  # a line that is neither comment nor heading
        expect_refusals((FormatError, "format-unknown", lambda: open_irradiance(path, utc_offset_h=0)))
        return
    opened = open_irradiance(path, utc_offset_h=None if "Z" in text or "UTC" in text or "unix" in text else 0)
    assert opened["irradiance"].shape == (4, 140)
    assert opened["irradiance_time"].values[0] == np.datetime64(first)
    np.testing.assert_allclose(opened["irradiance"].values[0], LIGHT, atol=1e-5)


REFUSED: dict[str, tuple[str, str | bytes, Any, str, tuple[str, ...]]] = {
    # file, content, call, code, words
    "counts alone": (
        "a.sed",
        darwin("Wvl\tNorm. DN (Ref.)\tNorm. DN (Target)", columns(400.0, 100.0), "None"),
        hp.open_library,
        "quantity-wrong",
        ("counts", "0.25"),
    ),
    "irradiance in a library": (
        "a.sed",
        darwin("Wvl\tIrrad. (Ref.)\tIrrad. (Target)", columns(1.0, 0.5), "W/m^2/nm"),
        hp.open_library,
        "quantity-wrong",
        ("irradiance", "open_irradiance"),
    ),
    "a lamp in photons": (
        "a.txt",
        ocean(columns(3.0), more="Units: umol/m^2/s/nm\n") + END,
        lambda path: open_irradiance(path, "irradiance", fwhm_nm=2),
        "units-unknown",
        ("umol",),
    ),
    "processed, of what": (
        "a.txt", ocean(columns(25.0)) + END, hp.open_library, "quantity-ambiguous", ("quantity=",)
    ),
    "a row in the middle": (
        "a.txt",
        ocean(columns(25.0).replace("500.00\t", "oops\t"), more="Mode: Reflection [%]\n") + END,
        hp.open_library,
        "row-unreadable",
        ("line 39",),
    ),
    "Avantes counts": (
        "a.trt",
        avantes("Wave   ;Sample", "[nm]   ;[counts]", columns(805.0, sep=";")),
        hp.open_library,
        "quantity-wrong",
        ("counts",),
    ),
    "Avantes transmittance": (
        "a.ttt",
        avantes("Wave   ;Transmittance", "[nm]   ;[% transmittance]", columns(80.0, sep=";")),
        hp.open_library,
        "quantity-wrong",
        ("ransmittance",),
    ),
    "StellarNet": (
        "a.IRR",
        '" File: Users\\roof"\n" RAD->  Wave:643.77nm  Pix:1050  Val:  0.001  Time:100ms  Avg:1"\n'
        + columns(LIGHT, sep="  ", form=".4E"),
        lambda path: open_irradiance(path, "irradiance", units="W m-2 nm-1", fwhm_nm=2),
        "time-missing",
        ("a.IRR",),
    ),
    "June or January": (
        "sky.csv",
        logged("datetime", dates="06/01/2024 10:00:{:02d}"),
        open_irradiance,
        "date-ambiguous",
        ("2024-01-06", "2024-06-01"),
    ),
    "a series in a library": ("sky.csv", logged(), hp.open_library, "quantity-wrong", ("open_irradiance",)),
    "EcoSIS radiance": (
        "e.csv",
        "id,Measurement Quantity,450,550,650\ndoor,Radiance,1,2,3\n",
        hp.open_library,
        "quantity-wrong",
        ("Radiance",),
    ),
    "EcoSIS fractions under percent": (
        "e.csv",
        "id,Measurement Units,450,550,650\ndoor,Percent,.1,.2,.3\n",
        hp.open_library,
        "scale-conflict",
        ("scale=1",),
    ),
    "EcoSIS ragged": (
        "e.csv",
        "id,site,450,550,650\ndoor,lot,.1,.2,.3\nroof,.1,.2,.3\n",
        hp.open_library,
        "row-unreadable",
        ("line 3",),
    ),
    "sheet": ("a.xlsx", b"PK\x03\x04" + b"\0" * 40, hp.open_library, "format-unknown", ("Excel", "CSV")),
    "certificate as PDF": ("a.pdf", b"%PDF-1.7\n", hp.io.read_certificate, "format-unknown", ("PDF", "text")),
    "JCAMP": ("a.jdx", "##TITLE= door\n##JCAMP-DX= 5\n", hp.open_library, "format-unknown", ("JCAMP",)),
    "AvaSoft 8": ("a.irr8", b"AVS84\0\1\2", open_irradiance, "format-unknown", ("AvaSoft", "text")),
    "GER": ("a.sig", b"///GER SIGNATUR FILE///\n", hp.open_svc, "format-unknown", ("GER",)),
    "MATLAB": ("a.mat", b"MATLAB 5.0 MAT-file" + b" " * 109, hp.open_library, "format-unknown", ("MATLAB",)),
    "netCDF as library": (
        "a.nc", b"CDF\x01" + b"\0" * 40, hp.open_library, "format-unknown", ("xr.open_dataset",)
    ),
    "netCDF as cube": (
        "cube.nc",
        b"\x89HDF\r\n\x1a\n" + b"\0" * 90,
        hp.open_flightline,
        "format-unknown",
        ("xr.open_dataset", "wavelength"),
    ),
    "a table is no ASD text": (
        "a.csv", "a,b\n1,2\n3,4\n", open_irradiance, "format-unknown", ("time,", "xarray")
    ),
    "fractions under percent": (
        "p.csv",
        "Wavelength [nm];Reflectance [%]\n400;0.98\n500;0.97\n",
        hp.io.read_certificate,
        "units-conflict",
        ("%",),
    ),
    "percent without a word": (
        "p.csv", "nm;R\n400;98\n500;97\n", hp.io.read_certificate, "scale-missing", ()
    ),
    **{
        f"certificate of {heading}": ("p.csv", f"# 8/h\n{heading}\n8000;0.9\n9000;0.9\n", read, code, ())
        for read in [hp.io.read_certificate]
        for heading, code in (
            ("nm;absorptance", "quantity-wrong"),
            ("nm;transmittance (%)", "quantity-wrong"),
            ("nm;%T", "quantity-wrong"),
            ("nm;emissivity;u(k=2)", "quantity-wrong"),
            ("cm-1;R", "units-unknown"),
        )
    },
    "wavenumbers of OceanView": (
        "a.txt",
        ocean(columns(0.25), more="XAxis mode: Wavenumbers\nMode: Reflectance\n") + END,
        hp.open_library,
        "units-unknown",
        ("Wavenumbers",),
    ),
    "Raman shifts": (
        "a.txt",
        ocean(columns(0.25), more="XAxis mode: Raman Shifts\n") + END,
        lambda path: hp.open_asd(path, "reflectance"),
        "units-unknown",
        ("Raman",),
    ),
    "SVC as irradiance": (
        "a.sig",
        "/*** Spectra Vista SIG Data ***/\nunits= Irradiance, Irradiance\ndata=\n",
        open_irradiance,
        "format-unknown",
        ("hp.open_svc", "swap_dims"),
    ),
    "two reflectances": (
        "p.csv",
        "nm;R(8/h);R(0/45)\n400;0.98;0.97\n500;0.97;0.96\n",
        hp.io.read_certificate,
        "column-ambiguous",
        (),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_the_way_out_is_named(name: str, tmp_path: Path) -> None:
    file, content, call, code, words = REFUSED[name]
    path = tmp_path / file
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(PaintError) as caught:
        call(path)
    assert code in caught.value.codes
    absent = [word for word in words if word not in str(caught.value)]
    assert not absent, f"{absent} in: {caught.value}"
    assert "neither" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "at_550"),
    [
        ("Wavelength (nm),Reflectance,Uncertainty (k=2)\n400,0.99,0.005\n700,0.93,0.005\n", 0.96),
        ("Wavelength (nm),Reflectance\n700,0.93\n400,0.99\n", 0.96),
        ("Wavelength (nm);Reflectance\n400;0,99\n700;0,93\n", 0.96),
        ("nm\tR\n400\t0,99\n700\t0,93\n", 0.96),
        ("Wellenlaenge nm   Reflexion\n400,0  0,99\n700,0  0,93\n", 0.96),
        ("wavelength [um],reflectance [%],std [%]\n0.4,99,0.2\n0.7,93,0.2\n", 0.96),
        ("# absorbance accessory\nnm,%R\n400,99\n700,93\n", 0.96),
        ("nm;%Reflectance\n400;99\n700;93\n", 0.96),
        ("Wavelength,R (8/h),u(R)\nnm,1,1\n400,0.99,0.005\n700,0.93,0.005\n", 0.96),
        ("400,0.02,0.001\n700,0.02,0.001\n", None),
    ],
)
def test_certificates_as_laboratories_print_them(text: str, at_550: float | None, tmp_path: Path) -> None:
    path = tmp_path / "p.csv"
    path.write_text(text)
    if at_550 is None:
        expect_refusals((FormatError, "column-ambiguous", lambda: hp.io.read_certificate(path)))
    else:
        assert float(hp.io.read_certificate(path).interp(wavelength=550.0)) == pytest.approx(at_550)


def test_usgs_chapters(tmp_path: Path) -> None:
    um = 1 / np.linspace(1 / 1.1225606, 1 / 216.00604, 60)
    values = np.linspace(0.1, 0.3, 60)
    values[7] = -1.23e34

    def column(title: str, numbers: Any) -> str:
        return title + "\n" + "\n".join(f" {number:.7E}" for number in numbers) + "\n"

    chapter = tmp_path / "ASCIIdata_splib07a" / "ChapterA_ArtificialMaterials"
    chapter.mkdir(parents=True)
    axis = chapter.parent / "splib07a_Wavelengths_NIC4_Nicolet_1.12-216microns.txt"
    axis.write_text(column(" splib07a Record=23: Wavelengths NIC4 Nicolet 1.12-216microns", um))
    (chapter / "splib07a_Coat_NIC4ccc_RREF.txt").write_text(
        column(" splib07a Record=900: Coat X NIC4ccc RREF", values)
    )
    bars = chapter / "errorbars_for_splib07a_Coat_NIC4ccc_RREF.txt"
    bars.write_text(column(" splib07a Record=901: error bars for Coat X NIC4ccc RREF", values * 0.01))
    library = hp.open_library(chapter)
    assert library["signature"].values.tolist() == ["Coat X"]
    np.testing.assert_allclose(library["wavelength"].values[[0, -1]], [1122.5606, 216006.04], rtol=1e-6)
    assert np.flatnonzero(np.isnan(library["reflectance"].values[0])).tolist() == [7]
    expect_refusals((FormatError, "quantity-wrong", lambda: hp.open_library(bars)))
    um[3] = -1.23e34  # a channel that the spectrometer lacks
    axis.write_text(column(" splib07a Record=23: Wavelengths NIC4 Nicolet 1.12-216microns", um))
    library = hp.open_library(chapter)
    assert (library.sizes["band"], bool((np.diff(library["wavelength"].values) > 0).all())) == (59, True)


RADCAL_IRRADIANCE = """!FRM4SOC_CP
!RADCAL
[DEVICE]
SAM_8329
[LAMPDATA]
400 0 2.0 1.0
500 0 4.0 1.0
[END_OF_LAMPDATA]
[CALDATA]
0 0 1024 0 0 0 1024 0 512 0
1 400 1e-4 1.5 10 0 900 1 901 1
2 410 1e-4 1.5 10 0 950 1 951 1
[END_OF_CALDATA]
"""
_TABLES = """[COLUMN_NAMES]
px wl\\angle -60 0 60
[COSERROR]
0 400 5.0 0.0 4.0
1 410 5.5 0.0 4.5
[END_OF_COSERROR]
[COLUMN_NAMES]
px wl\\angle -60 0 60
[UNCERTAINTY]
0 400 1.0 0.5 1.0
1 410 1.0 0.5 1.0
[END_OF_UNCERTAINTY]
"""
ANGULAR = (
    "!FRM4SOC_CP\n!ANGDATA\n[DEVICE]\nSAM_8329\n[AZIMUTH_ANGLE]\n0\n"
    + _TABLES
    + "[AZIMUTH_ANGLE]\n90\n"
    + _TABLES
)


def test_irradiance_sensors_of_frm4soc(tmp_path: Path) -> None:
    path = tmp_path / "CP_SAM_8329_RADCAL_20220706.TXT"
    path.write_text(RADCAL_IRRADIANCE)
    calibration = hp.io.read_radcal(path)
    assert calibration["coefficient"].values.tolist() == [1e-4, 1e-4]
    assert not {"panel_reflectance", "panel_radiance"} & set(calibration.variables)
    path.write_text(ANGULAR)
    response = hp.io.read_angular_response(path)
    assert response["cosine_error"].dims == ("azimuth", "wavelength", "zenith")
    assert response["cosine_error"].sel(azimuth=90, wavelength=410, zenith=-60).item() == 0.055
    assert response["cosine_error_u"].sel(azimuth=0, wavelength=400, zenith=0).item() == 0.0025
    assert response.attrs["device"] == "SAM_8329"
    expect_refusals((FormatError, "format-unknown", lambda: hp.io.read_radcal(path)))
    path.write_text(ANGULAR.replace("0 400 5.0 0.0 4.0", "0 400 5.0 0.0", 1))
    expect_refusals((FormatError, "row-unreadable", lambda: hp.io.read_angular_response(path)))


@pytest.mark.real_data
def test_a_real_angular_response(shared_data: Path) -> None:
    response = hp.io.read_angular_response(
        shared_data / "lab_calibration" / "CP_SAM_8329_ANGULAR_20220704122830.TXT"
    )
    assert response["cosine_error"].shape == (2, 256, 45)
    at = response["cosine_error"].isel(azimuth=0)
    assert float(at.sel(wavelength=305.42, zenith=-80.0)) == pytest.approx(0.1817)
    assert float(abs(at.sel(zenith=0.0)).isel(wavelength=slice(1, None)).max()) == 0.0


def test_a_sheet_within_a_folder(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "a.ProcSpec", "w") as file:
        file.writestr("OOISignatures.xml", "<x/>")
    expect_refusals(
        (FormatError, "format-unknown", "ProcSpec", lambda: hp.open_library(tmp_path / "a.ProcSpec"))
    )


def test_the_table_of_the_docs_names_every_form() -> None:
    table = (ROOT / "docs" / "formats" / "index.md").read_text("utf-8")
    rows = [line for line in table.splitlines() if line.count("|") == 6]
    instruments = [*(row.instrument for row in (*EXPORTS, *DIALECTS, *FORMS))]
    assert [name for name in instruments if not any(name in row for row in rows)] == []
