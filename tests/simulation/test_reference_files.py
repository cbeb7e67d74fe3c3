"""Files of field spectrometers beside a simulated collect: what real ones look like, and what they hold."""

import datetime as dt
import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hyperpaint as hp
from hyperpaint.simulation import SimulationSettings, simulate_collect
from hyperpaint.simulation.flight import PlanFlight
from hyperpaint.simulation.instruments import SVC_DETECTORS, svc_wavelengths
from hyperpaint.simulation.rendering.scene_spectra import CAR_PAINTS, reflectance

#: What a line of the header may look like. `test_the_pattern_is_that_of_real_files` holds it to real files.
PAIR = r"-?[\d.]+, ?-?[\d.]+"
CLOCK = r"\d{1,2}/\d{1,2}/\d{4} \d{1,2}:\d\d:\d\d( ?[AP]M)?"
PLACE = r"(\d{4,5}\.\d{4}[NSEW])?"
HEADER = {
    "name": r"\S+\.sig",
    "instrument": r"HI: \w{7} \(HR-1024i\)",
    "integration": r"[\d.]+(, [\d.]+){5}",
    "scan method": "Time-based, Time-based",
    "scan coadds": r"\d+(, \d+){5}",
    "scan time": PAIR,
    "scan settings": "AI, AI",
    "external data set1": r"\d+(, ?\d+){15}((, ?\d+){16})?",
    "external data set2": r"\d+(, ?\d+){15}((, ?\d+){16})?",
    "external data dark": r"\d+(, ?\d+){7}((, ?\d+){8})?",
    "external data mask": r"\d+",
    "optic": r"[\w ]+\(\d\), [\w ]+\(\d\)",
    "temp": r"-?[\d.]+(, -?[\d.]+){5}",
    "vis detector temp": PAIR,
    "battery": PAIR,
    "error": PAIR,
    "units": "Radiance, Radiance",
    "time": f"{CLOCK}, {CLOCK}",
    "longitude": f"{PLACE} *, ?{PLACE} *",
    "latitude": f"{PLACE} *, ?{PLACE} *",
    "gpstime": r"(\d{6}\.\d{3})? *, ?(\d{6}\.\d{3})? *",
    "comm": ".*",
    "memory slot": PAIR,
    "factors": r"([\d.]+, [\d.]+, [\d.]+ \[Overlap: .*\])+",
    "inclinometer x offset": PAIR,
    "inclinometer y offset": PAIR,
    "sun zenith": PAIR,
    "sun azimuth": PAIR,
    "weather": r"\{.*\}",
    "data": "",
}
OPTIONAL = {  # later versions of the firmware have them
    "vis detector temp", "inclinometer x offset", "inclinometer y offset", "sun zenith", "sun azimuth",
    "weather",
}  # fmt: skip
ROW = re.compile(r"\d{3,4}\.\d  -?\d+\.\d\d  -?\d+\.\d\d  -?\d+\.\d\d")


def svc(path: Path) -> tuple[dict[str, str], np.ndarray]:
    # Read a file of an HR-1024i strictly: keys in their order, then rows of four numbers (row, 4)
    first, *lines = path.read_bytes().decode("ascii").replace("\r\n", "\n").removesuffix("\n").split("\n")
    assert first == "/*** Spectra Vista SIG Data ***/"
    keys: dict[str, str] = {}
    for line in lines:
        key, _, value = line.partition("=")
        assert value.startswith(" ") or not value, line
        keys[key] = value.strip()
        if key == "data":
            break
    assert list(keys) == [key for key in HEADER if key in keys or key not in OPTIONAL]
    for key, value in keys.items():
        assert re.fullmatch(HEADER[key], value), f"{key}= {value}"
    rows = lines[len(keys) :]
    assert all(ROW.fullmatch(row) for row in rows)
    return keys, np.array([row.split() for row in rows], dtype=np.float64)


@pytest.fixture(scope="module")
def collect(tmp_path_factory: pytest.TempPathFactory) -> Path:
    # A small collect with its spectrometers' files
    return simulate_collect(
        tmp_path_factory.mktemp("references"), scene="plan", lines=4, bands=4, columns=4, utc_offset_h=5.5
    ).parent


@pytest.mark.real_data
def test_the_pattern_is_that_of_real_files(shared_data: Path) -> None:
    files = sorted((shared_data / "svc_sig").glob("*.sig"))
    assert files
    for path in files:
        keys, rows = svc(path)
        np.testing.assert_allclose(
            rows[:, 3], 100 * rows[:, 2] / rows[:, 1], atol=0.01 + 1 / rows[:, 1].min()
        )
        if "Preserve" in keys["factors"] and "Remove" not in keys["factors"]:
            # three detectors of the sizes that are simulated, within what differs from unit to unit
            assert (np.flatnonzero(np.diff(rows[:, 0]) < 0) + 1).tolist() == [512, 768]
            np.testing.assert_allclose(rows[:, 0], svc_wavelengths(), atol=20)


def test_svc_files_hold_the_paints(collect: Path) -> None:
    files = sorted((collect / "svc").glob("*.sig"))
    assert [path.stem for path in files] == sorted(CAR_PAINTS)
    for path in files:
        keys, rows = svc(path)
        assert (keys["name"], len(rows)) == (path.name, 1024)
        np.testing.assert_array_equal(rows[:, 0], svc_wavelengths())
        np.testing.assert_allclose(rows[:, 3], 100 * rows[:, 2] / rows[:, 1], atol=0.0051)
        # what a detector's resolution takes from the paints' edges, most at the sun's G band, 430 nm
        np.testing.assert_allclose(
            rows[:, 2] / rows[:, 1], reflectance([path.stem], rows[:, 0])[0], atol=0.0045
        )


def test_svc_counts_radiance_in_units_of_the_instrument(collect: Path) -> None:
    # 1e-10 W cm-2 sr-1 nm-1: a white panel at noon, by hand from the light that the flight has
    _, rows = svc(collect / "svc" / "grey.sig")
    flight = PlanFlight(SimulationSettings(lines=4, bands=4, columns=4))
    for nm in (550.2, 870.0):
        row = int(np.abs(rows[:512, 0] - nm).argmin())
        weight = np.exp(-4 * np.log(2) * ((flight.grid - rows[row, 0]) / SVC_DETECTORS[0].fwhm) ** 2)
        assert rows[row, 1] * 1e-10 * 1e4 == pytest.approx(
            ((flight.sky.sum(axis=0) * weight).sum() / weight.sum()) / np.pi, rel=1e-3
        )


def test_svc_clocks_and_places(collect: Path) -> None:
    # Local time of the instrument's clock, UTC of its GPS, the panel first, all before the flight
    keys, _ = svc(collect / "svc" / "red.sig")
    panel, target = (dt.datetime.strptime(text, "%m/%d/%Y %I:%M:%S %p") for text in keys["time"].split(", "))
    assert dt.timedelta(0) < target - panel < dt.timedelta(minutes=1)
    utc = [local - dt.timedelta(hours=5.5) for local in (panel, target)]
    assert [text.strip() for text in keys["gpstime"].split(",")] == [f"{moment:%H%M%S}.000" for moment in utc]
    assert utc[1] < dt.datetime(2021, 7, 20, 17, 10)
    assert (keys["latitude"].split()[0], keys["longitude"].split()[0]) == ("4305.0700N", "07740.4940W")


@pytest.mark.parametrize(
    ("moment", "shown"),
    [
        ("2021-07-20T00:30:00", "7/19/2021 11:31:00 PM"),
        ("2021-07-20T01:30:00", "7/20/2021 12:31:00 AM"),
        ("2021-12-31T13:30:00", "12/31/2021 12:31:00 PM"),
    ],
)
def test_svc_hours_are_those_of_a_clock_face(tmp_path: Path, moment: str, shown: str) -> None:
    # The panel of the first paint is seen 59 minutes before the flight
    simulate_collect(
        tmp_path, scene="plan", lines=4, bands=4, columns=4, start_time=moment, utc_offset_h=0.0, truth=False
    )
    keys, _ = svc(tmp_path / "svc" / "white.sig")
    assert keys["time"].split(", ")[0] == shown


def test_asd_files_hold_the_paints(collect: Path) -> None:
    files = sorted((collect / "asd_reflectance").glob("*.asd"))
    assert [path.stem for path in files] == sorted(CAR_PAINTS)
    made = hp.open_asd(files)
    assert set(made.data_vars) == {"reflectance"}
    wavelength = made["wavelength"].values
    for index, path in enumerate(made["source"].values.tolist()):
        np.testing.assert_allclose(
            made["reflectance"].values[index], reflectance([Path(path).stem], wavelength)[0], atol=0.004
        )
    seconds = (np.datetime64("2021-07-20T17:10:00") - made["time"].values) / np.timedelta64(1, "s")
    assert (seconds > 0).all()
    assert (seconds < 7200).all()


@pytest.mark.real_data
def test_asd_headers_say_what_those_of_reflectance_do(collect: Path, shared_data: Path) -> None:
    # Data type, fore optic, ordinate and reference flag, as in a file of the same version
    def told(path: Path) -> dict[str, Any]:
        raw = path.read_bytes()
        channels = int.from_bytes(raw[204:206], "little")
        return {
            "version": raw[:3],
            "type": raw[186],
            "format": raw[199],
            "ordinate": tuple(np.frombuffer(raw, "<f4", 2, 402).tolist()),
            "reference": raw[484 + 8 * channels :][:2],
        }

    assert told(collect / "asd_reflectance" / "red.asd") == told(
        shared_data / "asd_binary" / "v7sample00003.asd"
    )


def test_collect_toml_names_the_references(collect: Path) -> None:
    assert tomllib.loads((collect / "collect.toml").read_text())["references"] == [
        {"instrument": "svc", "files": "svc/*.sig"},
        {"instrument": "asd", "files": "asd_reflectance/*.asd"},
    ]
    hp.open_collect(collect / "collect.toml")
