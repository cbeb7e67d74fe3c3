"""Certificates of panels: units of headings are converted, labels are none, percent is never guessed."""

from pathlib import Path

import pytest

from hyperpaint.base.errors import FormatError
from hyperpaint.io.spectrometers.spectrum_csv import read_certificate

NM = "Wavelength [nm]"


def _read(folder: Path, headings: str, first: float, scale: float) -> tuple[list[float], list[float]]:
    path = folder / "panel.csv"
    rows = "".join(f"{nm * scale:g},{first}\n" for nm in (400, 500))
    path.write_text(f"{headings}\n{rows}", encoding="utf-8")
    certificate = read_certificate(path)
    return certificate.wavelength.values.tolist(), certificate.values.tolist()


@pytest.mark.parametrize(
    "heading",
    [
        f"{NM},Reflectance (99%)", f"{NM},Panel (50%)", f"{NM},R (2024)", f"{NM},Reflectance (8/h)",
        f"{NM},R (45/0)", f"{NM},R (absolute)", f"{NM},R (k=2)", f"{NM},R (SRS-99)", f"{NM},R [1]",
        "Wavelength (air), Reflectance (N)", "Panel,99 %", "Diffuse target;95 %\nnm;R",
        f"# accurate to 0.5 %\n{NM},R", "wavelength reflectance", "# made in May, 2024\nnm,R/1", "nm;R",
        "Wavelength (nm);Reflectance (fraction)",
    ],
)  # fmt: skip
def test_a_label_is_no_factor(tmp_path: Path, heading: str) -> None:
    assert _read(tmp_path, heading, 0.98, 1.0) == ([400.0, 500.0], [0.98, 0.98])


@pytest.mark.parametrize(
    "heading",
    [
        "Wavelength (um)  Reflectance (%)", "Wavelength (um) Diffuse Reflectance (%)",
        "Wavelength  (um)   Hemispherical Reflectance Factor  (%)", "# Wavelength [um],Reflectance [%]",
        "Wavelength/um;R/%", "Wavelength [um],Reflectance, %", "Wavelength um, Reflectance %",
        "Wavelength [um],Reflectance [%]\n-----,-----", "Wavelength,R\num,%", "wavelength_um\tR_percent",
        "Wavelength [µm],R (8/h) [%]", "Wavelength [Microns];R (per cent)", "# Wavelength [um],R [%]\na,b",
        "Wavelength um R %", 
        "wavelength_um;reflectance_%", '"Wavelength um","Reflectance %"', "Wavelength   um   Reflectance   %",
    ],
)  # fmt: skip
def test_percent_and_micrometres_are_converted(tmp_path: Path, heading: str) -> None:
    wavelength, values = _read(tmp_path, heading, 98.0, 1e-3)
    assert (wavelength, values) == (pytest.approx([400.0, 500.0]), [0.98, 0.98])
    assert _read(tmp_path, heading, 1.5, 1e-3)[1] == [0.015, 0.015]


@pytest.mark.parametrize(
    ("heading", "problem"),
    [
        (f"# all values in %\n{NM},R", "units-ambiguous"),
        (f"# {NM}, uncertainty [%]\n{NM},R", "units-ambiguous"),
        (f"{NM},R [nm]", "contains 'nm'.*units-unknown"),
        (f"{NM},R [W m-2 nm-1]", "contains 'W m-2 nm-1'"),
        ("Wavenumber [cm-1],R", "contains 'cm-1'"),
        (f"{NM},R [%]\n{NM},R [1]", "'%'.*units-conflict"),
    ],
)
def test_what_is_not_clear_is_refused(tmp_path: Path, heading: str, problem: str) -> None:
    with pytest.raises(FormatError, match=problem.replace("[", r"\[")):
        _read(tmp_path, heading, 0.98, 1.0)
