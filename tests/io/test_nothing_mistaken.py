"""Records, cubes and arguments taken for something else are refused or warned of; right ones are silent."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.envi_cubes import toy, write_cube
from support.strategies import flight
from support.wrong_quantities import NM, Case, objection, remarks, sunlight

import hyperpaint as hp
from hyperpaint.io.envi.envi_cubes import open_envi
from hyperpaint.io.spectrometers.spectrum_csv import read_certificate
from hyperpaint.radiometry.panels import Panel

SUN = sunlight()
W = "W m-2 nm-1"


def sky(
    values: Any = SUN, units: str = W, nm: Any = NM, zone: str = "Z", fwhm: float = 3.0, **options: Any
) -> Callable[[Path], Any]:
    # Return what writes a series of irradiance as csv and opens it
    def opened(folder: Path) -> Any:
        head = [f"# units: {units}"] if units else []
        rows = [
            f"2024-05-21T12:00:0{second}{zone}," + ",".join(map("{:.6g}".format, values)) for second in (0, 2)
        ]
        lines = [*head, f"# fwhm_nm: {fwhm}", "time," + ",".join(map("{:.6g}".format, nm)), *rows]
        (folder / "sky.csv").write_text("\n".join(lines) + "\n")
        return hp.open_irradiance(folder / "sky.csv", **options)

    return opened


def cube(dtype: str, *header: str, **options: Any) -> Callable[[Path], Any]:
    # Return what writes a cube of ENVI and opens it
    return lambda folder: open_envi(write_cube(folder / "toy", toy(dtype), *header), **options)


def poses(
    latitude: float = 43.0, longitude: float = -77.6, altitude: float = 120.0, heading: float = 40.0,
    *, unit: str = "degree", time: str = "time", stamp: str = "2024-05-21T12:00:{:02d}Z",
) -> Callable[[Path], Any]:  # fmt: skip
    # Return what writes a record of navigation, of a flight to the north-east, and opens it
    def opened(folder: Path) -> Any:
        angles = ",".join(f"{name} [{unit}]" for name in ("roll", "pitch", "heading"))
        rows = [f"{time},lat [degree],lon [degree],alt [m],{angles}"]
        for k in range(40):
            place = f"{latitude + 4e-5 * k:.8f},{longitude + 4.6e-5 * k:.8f},{altitude}"
            rows.append(f"{stamp.format(k)},{place},0.02,0.01,{heading}")
        (folder / "nav.csv").write_text("\n".join(rows) + "\n")
        return hp.open_navigation(folder / "nav.csv")

    return opened


def certificate(text: str) -> Callable[[Path], Any]:
    def opened(folder: Path) -> Any:
        (folder / "panel.csv").write_text(text)
        return read_certificate(folder / "panel.csv")

    return opened


def line(scaled: float | None = None, **variables: Any) -> Callable[[Path], Any]:
    # Return what computes reflectance of a line with other variables, or a scaled record
    def computed(folder: Path) -> Any:
        dataset = flight(lines=4, position=True).line.assign(variables)
        if scaled is not None:
            record = dataset.irradiance
            dataset = dataset.assign(irradiance=record.copy(data=record.values * np.float32(scaled)))
        return hp.reflectance(dataset).reflectance.compute()

    return computed


def given(argument: Callable[[], Any]) -> Callable[[Path], Any]:
    return lambda _: argument()


GAINS = f"data gain values = {{{'2,' * 20}}}"
TO_SWIR = np.arange(350.0, 2500.0, 5.0)
PATCH = (slice(0, 4), slice(0, 3))
NANOMETRES = {"units": "nm"}
WRONG = [
    Case("irradiance in mW m-2", sky(1e3 * SUN), "values in mW m-2 nm-1"),
    Case("irradiance in uW cm-2", sky(100 * SUN), "values in uW cm-2 nm-1"),
    Case("irradiance in W cm-2", sky(1e-4 * SUN), "values in W cm-2 nm-1"),
    Case("W said to be uW", sky(units="uW m-2 nm-1"), "declared in uW m-2 nm-1"),
    Case("W said to be uW cm-2", sky(units="uW cm-2 nm-1"), "declared in uW cm-2 nm-1"),
    Case("W said to be mW", sky(units="mW m-2 nm-1"), "declared in mW m-2 nm-1"),
    Case("W per um taken for W per nm", sky(1e3 * SUN), "W m-2 um-1"),
    Case("counts as irradiance", sky(3000 * SUN), "counts"),
    Case("percent as irradiance", sky(0 * NM + 50), "other units"),
    Case("a dark subtracted twice", sky(-SUN), "darker"),
    Case("radiance as irradiance", sky(units="W m-2 sr-1 nm-1"), "solid angle"),
    Case("broadband irradiance", sky(units="W m-2"), "check the quantity"),
    Case("illuminance", sky(units="lux"), "lux"),
    Case("no unit", sky(units=""), "no units"),
    Case("wavelengths in um", sky(nm=NM / 1e3), "micrometres"),
    Case("wavelengths in angstrom", sky(nm=NM * 10), "angstroms"),
    Case("wavenumbers", sky(nm=np.sort(1e7 / NM)), "wavenumbers"),
    Case("width in um", sky(fwhm=0.003), "micrometres"),
    Case("width told in um", sky(fwhm_nm=0.003), "micrometres"),
    Case("a stamp without a zone", sky(zone=""), "zone"),
    Case("an offset in seconds", sky(zone="", utc_offset_h=7200), "hours"),
    Case("radiance, told counts", cube("f4", "description = {x,RADIANCE}", quantity="counts"), "header"),
    Case("reflectance, told counts", cube("u2", "reflectance scale factor = 9", quantity="counts"), "header"),
    Case("floats, told counts", cube("f4", quantity="counts"), "no counts"),
    Case("gains, told counts", cube("u2", GAINS, quantity="counts"), "no counts"),
    Case("counts, told radiance", cube("u2", "description = {raw}", quantity="radiance"), "header says"),
    Case("integers, told reflectance", cube("u2", quantity="reflectance"), "scale factor"),
    Case("integers called reflectance", cube("u2", "description = {x,REFLECTANCE}"), "scale factor"),
    Case("latitude and longitude swapped", poses(latitude=-100.0, longitude=43.0), "latitude"),
    Case("degrees and minutes", poses(latitude=4300.0, longitude=-7736.0), "latitude"),
    Case("degrees times 1e7", poses(latitude=43e7, longitude=-77.6e7), "lat"),
    Case("altitude in mm", poses(altitude=120_000.0), "altitude"),
    Case("heading in hundredths of a degree", poses(heading=4000.0), "heading"),
    Case("degrees said to be radian", poses(unit="radian"), "heading"),
    Case("local time without a zone", poses(stamp="2024-05-21T12:00:{:02d}"), "zone"),
    Case("seconds of what", poses(stamp="2160{:02d}"), "time-origin-unknown"),
    Case("a panel in percent", given(lambda: Panel(*PATCH, 50.0)), "expected 0 to 1"),
    Case("its uncertainty in percent", given(lambda: Panel(*PATCH, 0.5, uncertainty=2.0)), "fraction of 1"),
    Case("a tilt in hundredths of a degree", given(lambda: hp.Tilt(500.0, 180.0)), "0 to 90"),
    Case("ground reflectance in percent", given(lambda: hp.Tilt(5.0, 0, ground_reflectance=20)), "0 to 1"),
    Case("a certificate in percent", certificate("400,98.1\n450,98.5\n"), "fraction"),
    Case("a certificate in um", certificate("0.40,0.98\n0.45,0.98\n"), "nanometres"),
    Case("an exposure in ms", line(exposure_time=((), 500.0, {"units": "s"})), "milliseconds"),
    Case("bits for a saturation", line(saturation_count=((), 12.0, {"units": "count"})), "4095"),
    Case("bands in um", line(wavelength=("band", np.linspace(0.5, 0.7, 12), NANOMETRES)), "outside"),
    Case("widths in um", line(fwhm=("band", np.full(12, 6e-3), NANOMETRES)), "sharper than"),
    Case("a smile in angstrom", line(wavelength_shift=("cross_track", np.full(6, 30.0), NANOMETRES)), "20"),
    Case("a millionth of the sun", line(1e-6), "declared in uW m-2"),
    Case("a thousandth of the sun", line(1e-3), "declared in mW m-2"),
    Case("a hundredth of the sun", line(1e-2), "declared in uW cm-2"),
    Case("twice the sun", line(2.2), "times that of a clear sky"),
]  # fmt: skip

RIGHT = [
    Case("irradiance", sky(), ""),
    Case("irradiance in mW", sky(1e3 * SUN, "mW m-2 nm-1"), ""),
    Case("irradiance in uW cm-2", sky(100 * SUN, "uW cm-2 nm-1"), ""),
    Case("an overcast sky", sky(0.1 * SUN), ""),
    Case("a low sun under cloud", sky(0.03 * SUN), ""),
    Case("stamps of a zone", sky(zone="+02:00"), ""),
    Case("a local clock, told", sky(zone="", utc_offset_h=-4), ""),
    Case("a broad spectrometer", sky(fwhm=12.0), ""),
    Case("a record to 2500 nm", sky(np.interp(TO_SWIR, NM, SUN), nm=TO_SWIR), ""),
    Case("a cube of counts", cube("u2", "description = {raw}"), ""),
    Case("a cube of Headwall", cube("u2", "description = {[HEADWALL Hyperspec III]}"), ""),
    Case("integers, told counts", cube("u2", quantity="counts"), ""),
    Case("integers of no word", cube("u2"), ""),
    Case("radiance", cube("f4", "description = {x,RADIANCE}", ";Units = mW/(cm2*sr*um)"), ""),
    Case("scaled reflectance", cube("u2", "reflectance scale factor = 10000"), ""),
    Case("floats, told radiance", cube("f4", quantity="radiance"), ""),
    Case("poses in degree", poses(), ""),
    Case("poses to the north", poses(heading=2.0), ""),
    Case("poses in radian", poses(unit="radian", heading=np.radians(40.0)), ""),
    Case("a hovering drone over the equator", poses(latitude=0.0, longitude=0.1), ""),
    Case("a panel", given(lambda: Panel(*PATCH, 0.5, uncertainty=0.02)), ""),
    Case("a panel a bit above 1", given(lambda: Panel(*PATCH, 1.01)), ""),
    Case("a tilt", given(lambda: hp.Tilt(5.0, 180.0, ground_reflectance=0.2)), ""),
    Case("a certificate", certificate("nm;R\n400;0.981\n450;0.985\n"), ""),
    Case("a line", line(), ""),
    Case("a line in half the light", line(0.5), ""),
    Case("a line at 8 bits", line(saturation_count=((), 40950.0, {"units": "count"})), ""),
]  # fmt: skip


@pytest.mark.parametrize("case", WRONG, ids=lambda case: case.name)
def test_what_is_something_else__is_refused_or_warned_of(case: Case, tmp_path: Path) -> None:
    said = objection(case.opened, tmp_path)
    assert re.search(case.words, said), said or "silent"


@pytest.mark.parametrize("case", RIGHT, ids=lambda case: case.name)
def test_what_is_right__passes_without_a_word(case: Case, tmp_path: Path) -> None:
    assert remarks(case.opened, tmp_path) == []


REAL: dict[str, Callable[[Path], xr.Dataset]] = {
    **{
        f"spectra_ascii/{name}": hp.open_library
        for name in ("PVC_Red.txt", "PVC_White.txt", "R90.txt")
    },
    **{
        f"round_robin/{name}.csv": hp.open_library
        for name in ("Headwall_Hyperspec_III", "Hyspex_VNIR1600", "Hyspex_VNIR1800", "Specim_V10E_1",
                     "Specim_V10E_2", "Specim_V10E_3", "pigment_panel_reference",
                     "wavelength_standard_reference")
    },
    "radiance_vs_field/insitu_BeckmanLawn.txt": hp.open_library,
    "radiance_vs_field/insitu_AstroRedBaseball.txt": hp.open_library,
    "lab_calibration/zenith_lite_95R_certificate.csv": hp.open_library,
    "envi_sli/library_berlin.hdr": hp.open_library,
    "envi_sli/s07_AV95_envi.hdr": hp.open_library,
    "dirsig/emissivity/background_1.ems": hp.open_library,
    "dirsig/emissivity/ideal_mat_2.ems": hp.open_library,
    "dirsig/emissivity/grass_texture.ems": hp.open_library,
    "dirsig/emissivity/muddy_water.ems": hp.open_library,
    "envi_cube/darkReference.hdr": open_envi,
    "envi_cube/prm20231110t071521_rdn_two_px.hdr": open_envi,
    "asd_binary/ww00045.asd": hp.open_asd,
    "asd_binary/ww00046.asd": hp.open_asd,
    "asd_binary/ww00047.asd": hp.open_asd,
}  # fmt: skip


@pytest.mark.real_data
@pytest.mark.parametrize("name", REAL)
def test_real_files__open_without_a_word(name: str, shared_data: Path) -> None:
    assert remarks(lambda folder: REAL[name](folder / name), shared_data) == []
