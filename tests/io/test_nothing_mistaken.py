"""Records, cubes and arguments taken for something else are refused or warned of; right ones are silent."""

import dataclasses
import json
import re
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from campaigns.faults.seed_files import prepare, sixs_text
from support.envi_cubes import toy, write_cube
from support.files import write_file
from support.strategies import flight
from support.wrong_quantities import NM, Case, objection, remarks, sunlight

import hyperpaint as hp
from hyperpaint.base.errors import PaintError, PaintWarning
from hyperpaint.io.collect.collect_toml import read_collect
from hyperpaint.io.dirsig import open_emissivity, read_materials
from hyperpaint.io.envi.envi_cubes import open_envi, read_header
from hyperpaint.io.flightline.side_files import exposure_seconds, read_frame_index, read_settings
from hyperpaint.io.navigation.navigation_records import open_navigation, read_gps_time, read_imu_gps
from hyperpaint.io.spectrometers.asd import read_asd_text
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


# --- The same content in another spelling, encoding or unit: the same values or a refusal, never others ---


_NMEA = [
    "GPZDA,120000.00,20,07,2021,00,00",
    *(
        f"GPGGA,1200{second:02d}.00,4306.{1000 + second},N,07736.2000,W,4,12,0.8,150.0,M,-34.0,M,,"
        for second in range(12)
    ),
]


def _sentence(body: str) -> str:
    total = 0
    for character in body:
        total ^= ord(character)
    return f"${body}*{total:02X}\n"


WRITTEN = {
    "log.nmea": "".join(map(_sentence, _NMEA)),
    "points.csv": "# crs: EPSG:32617\nname,line,sample,east,north,height\nA,10.5,3,100.25,200.5,50\n"
    "B,20.0,4,101.75,201.0,51.5\n",
    "panel.csv": "nm,reflectance\n" + "".join(f"{400 + 5 * i},{0.9 + i / 1e3}\n" for i in range(40)),
    "cars.geojson": json.dumps(
        {
            "type": "FeatureCollection",
            "coordinates": "sensor",
            "features": [
                {
                    "type": "Feature",
                    "properties": {"name": "Grün", "flightline": "raw_0", "year": 2019},
                    "geometry": {"type": "Polygon", "coordinates": [[[1.5, 2], [5, 2], [5, 7.25], [1.5, 2]]]},
                }
            ],
        },
        ensure_ascii=False,
    ),
}  # fmt: skip

READERS: Mapping[str, tuple[str, Callable[[Path], Any]]] = {
    "ENVI header": ("flight/raw_0.hdr", read_header),
    "settings": ("flight/settings.txt", lambda path: exposure_seconds(read_settings(path), "settings")),
    "frame index": ("flight/frameIndex_0.txt", read_frame_index),
    "frame index of times": ("frameIndex_time.txt", read_frame_index),
    "imu_gps": ("flight/imu_gps.txt", read_imu_gps),
    "imu_gps of months": ("imu_gps_month.txt", read_imu_gps),
    "gps_time": ("gps_time.txt", read_gps_time),
    "navigation table": ("flight.csv", lambda path: open_navigation(path, format="csv")),
    "navigation of GPS time": ("flight_gps.csv", lambda path: open_navigation(path, format="csv")),
    "navigation .lcf": (
        "flight.lcf", lambda path: open_navigation(path, format="lcf", week=2149, leap_seconds=18)
    ),
    "NMEA": ("log.nmea", open_navigation),
    "control points": ("points.csv", hp.io.read_control_points),
    "certificate": ("panel.csv", hp.io.read_certificate),
    "ASD text": ("sky.txt", read_asd_text),
    "SVC": ("svc/red.sig", hp.open_svc),
    "irradiance table": ("sky.csv", hp.open_irradiance),
    "irradiance without a zone": (
        "zone.csv",
        lambda path: hp.open_irradiance(path, utc_offset_h=0.0, fwhm_nm=3.0, units="W m-2 nm-1"),
    ),
    "sky of uvspec": (
        "uvspec.out",
        lambda path: hp.io.read_uvspec(path, sun_zenith=60.0, units="mW m-2 nm-1", directions=5),
    ),
    "sky of MODTRAN": ("tape7", lambda path: hp.io.read_tape7(path, sun_zenith=60.0, ground=0.3)),
    "sky of 6S": (
        "sixs.txt", lambda path: hp.io.read_sixs([path, path.with_name("other.txt")], sun_zenith=60.0)
    ),
    "sky table": ("radiances.csv", hp.io.read_sky_csv),
    "emissivity": ("paint.ems", open_emissivity),
    "materials": ("paints.mat", lambda path: [(each.id, each.name) for each in read_materials(path)]),
    "library table": ("table.csv", hp.open_library),
    "library CSV": ("library/paints.csv", hp.open_library),
    "ECOSTRESS": ("library/text/red.spectrum.txt", hp.open_library),
    "regions": ("cars.geojson", hp.read_regions),
    "collect": ("collect.toml", read_collect),
}  # fmt: skip


def _number_respelt(text: str, spelling: str) -> str:
    # Write decimal fractions in another way; dates, times, versions and names are left
    def other(match: re.Match[str]) -> str:
        number = match[0]
        return f"{number}0" if spelling == "trailing zero" else f"{number}e0"

    return re.sub(r"(?<![\w.:/+-])-?\d{1,4}\.\d+(?![\w.:/-])", other, text)


SPELLINGS: Mapping[str, Callable[[str], bytes]] = {
    "CRLF": lambda text: text.replace("\r\n", "\n").replace("\n", "\r\n").encode(),
    "LF": lambda text: text.replace("\r\n", "\n").encode(),
    "byte order mark": lambda text: b"\xef\xbb\xbf" + text.encode(),
    "no last line end": lambda text: text.rstrip("\r\n").encode(),
    "blank lines at the end": lambda text: text.encode() + b"\n\n\n",
    "blanks at line ends": lambda text: re.sub(r"(\r?\n)", r"  \1", text).encode(),
    "Latin-1": lambda text: text.encode("latin-1", "replace"),
    "UTF-16": lambda text: text.encode("utf-16"),
    "trailing zeros": lambda text: _number_respelt(text, "trailing zero").encode(),
    "exponents": lambda text: _number_respelt(text, "exponent").encode(),
}
#: What these programs write in any case: they are read, not only refused.
MUST_READ = ("CRLF", "LF", "no last line end", "blank lines at the end", "blanks at line ends")


#: Raw text that readers pass on as it is written.
RAW = ("fields", "comments", "header", "factors")


@pytest.fixture(scope="module")
def seeds(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("seeds")
    prepare(folder)
    for name, text in WRITTEN.items():
        (folder / name).write_text(text, encoding="utf-8", newline="")
    (folder / "other.txt").write_text(sixs_text(0.65))
    return folder


def plain(value: Any) -> Any:
    # Return what a reader returned as plain values, without what names files and checksums
    if isinstance(value, xr.Dataset | xr.DataArray):
        value = value.to_dataset(name="values") if isinstance(value, xr.DataArray) else value
        return {
            str(name): (variable.dims, variable.attrs.get("units"), plain(variable.values))
            for name, variable in value.variables.items()
            if name not in RAW
        }
    if isinstance(value, np.ndarray):
        return value.dtype.kind, value.shape, [repr(each) for each in value.ravel().tolist()]
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        names = [field.name for field in dataclasses.fields(value) if field.name not in RAW]
        return {name: plain(getattr(value, name)) for name in names}
    if isinstance(value, Mapping):
        return {str(key): plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [plain(each) for each in value]
    return value.name if isinstance(value, Path) else repr(value)


def values_of(read: Callable[[Path], Any], path: Path) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PaintWarning)
        return plain(read(path))


@pytest.mark.parametrize("spelling", SPELLINGS)
@pytest.mark.parametrize("reader", READERS)
def test_the_same_content_has_the_same_values(reader: str, spelling: str, seeds: Path) -> None:
    name, read = READERS[reader]
    path = seeds / name
    before = path.read_bytes()
    wanted = values_of(read, path)
    try:
        path.write_bytes(SPELLINGS[spelling](before.decode()))
        values = values_of(read, path)
    except PaintError:
        assert spelling not in MUST_READ
        return
    finally:
        path.write_bytes(before)
    assert values == wanted


# --- other units, zones and notations ----------------------------------------------------------------------

_TIMES = [f"{second:02d}" for second in range(0, 20, 2)]


def _irradiance(unit: str, factor: float, zone: str, hour: int, fwhm: str = "# fwhm_nm: 3") -> str:
    waves = [400 + 5 * band for band in range(60)]
    rows = [
        f"2024-05-21T{hour:02d}:00:{second}{zone}"
        + "".join(f",{factor * (1.0 + band / 64 + step / 8):.9g}" for band in range(60))
        for step, second in enumerate(_TIMES)
    ]
    return "\n".join([f"# units: {unit}", fwhm, "time" + "".join(f",{nm}" for nm in waves), *rows]) + "\n"


def _navigation(angle: str, height: str, zone: str, hour: int, columns: str = "rpha") -> str:
    turn = {"rad": 1.0, "degree": 180.0 / np.pi}[angle]
    length = {"m": 1.0, "ft": 1.0 / 0.3048, "km": 1e-3}[height]
    rows = []
    for step, second in enumerate(_TIMES):
        row = [43.1 + step / 1024, -77.6, (150.0 + step / 4) * length, turn * step / 256, 0.0, turn * 0.5]
        rows.append(f"2024-06-01T{hour:02d}:00:{second}{zone}," + ",".join(f"{value:.12g}" for value in row))
    names = f"roll [{angle}],pitch [{angle}],heading [{angle}]"
    return (
        "# column_order: left_to_right\n# roll_positive: right_wing_up\n"
        f"time,latitude [degree],longitude [degree],altitude [{height}],{names}\n" + "\n".join(rows) + "\n"
    )


def _library(mark: str, decimal: str, percent: bool, wave: float, unit: str) -> str:
    head = mark.join(
        [f"wavelength ({unit})", "red (%)" if percent else "red", "blue (%)" if percent else "blue"]
    )
    rows = []
    for band in range(40):
        values = [band / 64, 1 - band / 64]
        cells = [(400 + 5 * band) * wave, *[100 * value if percent else value for value in values]]
        rows.append(mark.join(f"{cell:.9g}".replace(".", decimal) for cell in cells))
    return "\n".join([head, *rows]) + "\n"


def _sky(unit: str, factor: float, light: str, size: float) -> str:
    head = f"wavelength [{unit}],zenith [degree],azimuth [degree],radiance [{light} m-2 sr-1 nm-1]"
    rows = [
        f"{nm * factor:.9g},{zenith},{azimuth},{(zenith + nm) / 8192 * size:.9g},{size * 1.25},{size * 0.25}"
        for nm in (450.0, 550.0) for azimuth in (0.0, 90.0) for zenith in (10.0, 40.0, 70.0)
    ]  # fmt: skip
    return "\n".join([f"{head},direct_normal [{light} m-2 nm-1],diffuse [{light} m-2 nm-1]", *rows]) + "\n"


def _header(unit: str, factor: float, order: int, comma: str) -> str:
    waves = comma.join(f"{factor * (400 + 10 * band):.9g}" for band in range(4))
    widths = comma.join(f"{factor * 5:.9g}" for _ in range(4))
    keys = [
        "samples = 6", "lines = 24", "bands = 4", "header offset = 0", "data type = 12", "interleave = bil",
        "byte order = 0", f"wavelength units = {unit}", f"wavelength = {{{waves}}}", f"fwhm = {{{widths}}}",
    ]  # fmt: skip
    return "\n".join(["ENVI", *keys[::order]]) + "\n"


def _poses(path: Path) -> xr.Dataset:
    # Return navigation with its angles in degrees; it keeps the unit of the file
    poses = open_navigation(path, format="csv")
    radians = [name for name in poses.data_vars if poses[name].attrs.get("units") == "radian"]
    return poses.assign({name: np.degrees(poses[name]).assign_attrs(units="degree") for name in radians})


_REGIONS = json.loads(WRITTEN["cars.geojson"])
_OPEN = {
    "irradiance": ("sky.csv", hp.open_irradiance),
    "navigation": ("flight.csv", _poses),
    "library": ("table.csv", hp.open_library),
    "sky": ("radiances.csv", hp.io.read_sky_csv),
    "header": ("raw_0.hdr", read_header),
    "regions": ("cars.geojson", hp.read_regions),
}
_IRRADIANCE = _irradiance("W m-2 nm-1", 1.0, "Z", 12)
_NAVIGATION = _navigation("rad", "m", "Z", 12)
_LIBRARY = _library(",", ".", False, 1.0, "nm")
_SKY = _sky("nm", 1.0, "W", 1.0)
_HEADER = _header("Nanometers", 1.0, 1, ", ")
SAME: Mapping[str, tuple[str, str, str]] = {
    "irradiance in mW": ("irradiance", _IRRADIANCE, _irradiance("mW m-2 nm-1", 1e3, "Z", 12)),
    "irradiance a micrometre": ("irradiance", _IRRADIANCE, _irradiance("W m-2 um-1", 1e3, "Z", 12)),
    "irradiance in uW and cm": ("irradiance", _IRRADIANCE, _irradiance("uW cm-2 nm-1", 100.0, "Z", 12)),
    "irradiance by a slash": ("irradiance", _IRRADIANCE, _irradiance("W/m^2/nm", 1.0, "Z", 12)),
    "irradiance in another zone": ("irradiance", _IRRADIANCE, _irradiance("W m-2 nm-1", 1.0, "+02:00", 14)),
    "irradiance west of UTC": ("irradiance", _IRRADIANCE, _irradiance("W m-2 nm-1", 1.0, "-05:00", 7)),
    "angles in degrees": ("navigation", _NAVIGATION, _navigation("degree", "m", "Z", 12)),
    "heights in feet": ("navigation", _NAVIGATION, _navigation("rad", "ft", "Z", 12)),
    "heights in km": ("navigation", _NAVIGATION, _navigation("rad", "km", "Z", 12)),
    "navigation in another zone": ("navigation", _NAVIGATION, _navigation("rad", "m", "+02:00", 14)),
    "library in per cent": ("library", _LIBRARY, _library(",", ".", True, 1.0, "nm")),
    "library in micrometres": ("library", _LIBRARY, _library(",", ".", False, 1e-3, "um")),
    "library by semicolons": ("library", _LIBRARY, _library(";", ".", False, 1.0, "nm")),
    "library with decimal commas": ("library", _LIBRARY, _library(";", ",", False, 1.0, "nm")),
    "library by tabs": ("library", _LIBRARY, _library("\t", ".", False, 1.0, "nm")),
    "sky in micrometres": ("sky", _SKY, _sky("um", 1e-3, "W", 1.0)),
    "sky in mW": ("sky", _SKY, _sky("nm", 1.0, "mW", 1e3)),
    "header in micrometres": ("header", _HEADER, _header("Micrometers", 1e-3, 1, ", ")),
    "header in another order": ("header", _HEADER, _header("Nanometers", 1.0, -1, ", ")),
    "header on many lines": ("header", _HEADER, _header("Nanometers", 1.0, 1, " ,\n ")),
    "regions escaped": ("regions", WRITTEN["cars.geojson"], json.dumps(_REGIONS)),
    "regions indented": ("regions", WRITTEN["cars.geojson"], json.dumps(_REGIONS, indent=4)),
    "regions in another order": ("regions", WRITTEN["cars.geojson"], json.dumps(_REGIONS, sort_keys=True)),
    "regions by fractions": (
        "regions", WRITTEN["cars.geojson"], json.dumps(_REGIONS).replace("[5,", "[5.0,"),
    ),
}  # fmt: skip


def _numbers(value: Any) -> Any:
    # Return values to nine digits: what a factor of a unit may change in the last place is no difference
    if isinstance(value, Mapping):
        return {key: _numbers(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_numbers(each) for each in value]
    try:
        return f"{float(value):.6g}"
    except (TypeError, ValueError):
        return value


@pytest.mark.parametrize("notation", SAME)
def test_other_units_and_notations_have_the_same_values(notation: str, tmp_path: Path) -> None:
    kind, text, other = SAME[notation]
    name, read = _OPEN[kind]
    path = write_file(tmp_path / name, text, encoding="utf-8")
    wanted = _numbers(values_of(read, path))
    path.write_text(other, encoding="utf-8")
    assert text != other
    assert _numbers(values_of(read, path)) == wanted


def test_another_spelling_of_a_collect_is_the_same_collect(seeds: Path) -> None:
    # Dotted keys for tables, literal strings
    path = seeds / "collect.toml"
    before = path.read_text()
    wanted = values_of(read_collect, path)
    sections = re.split(r"(?m)^(?=\[)", before)
    single = [section for section in sections[1:] if not section.startswith("[[")]
    dotted = ""
    for section in single:
        name, _, body = section.partition("]\n")
        dotted += re.sub(r"(?m)^(?=[a-z_]+ *=)", f"{name[1:]}.", body)
    several = [section for section in sections[1:] if section.startswith("[[")]
    try:
        path.write_text(sections[0] + dotted.replace('"', "'") + "\n" + "".join(several))
        assert values_of(read_collect, path) == wanted
    finally:
        path.write_text(before)
