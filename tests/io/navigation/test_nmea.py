"""Logs of NMEA sentences, and tables without a header."""

from functools import reduce
from operator import xor
from pathlib import Path

import numpy as np
import pytest

import hyperpaint as hp
from hyperpaint.base.errors import FormatError, PaintWarning, SchemaError, TimeError


def sentence(text: str) -> str:
    return f"${text}*{reduce(xor, text.encode()):02X}"


def log_of(path: Path, *texts: str) -> Path:
    path.write_text("".join(sentence(text) + "\r\n" for text in texts))
    return path


def gga(clock: str, place: str = "4330.0000,N,07736.0000,W", height: str = "150.0,M,-34.5,M") -> str:
    return f"GPGGA,{clock},{place},4,12,0.8,{height},,"


def test_a_real_log(shared_data: Path) -> None:
    with pytest.warns(PaintWarning, match="attitude-missing"):
        flight = hp.open_navigation(shared_data / "gps_imu" / "asd_nmea_042122gps.log", date="2022-04-21")
    assert flight.sizes["navigation_time"] == 185
    row = flight.sel(navigation_time="2022-04-21T10:49:07")
    assert float(row.latitude) == pytest.approx(48.25090667, abs=1e-8)
    assert float(row.longitude) == pytest.approx(11.70987500, abs=1e-8)
    assert float(row.altitude) == pytest.approx(475.4 + 46.8)
    assert np.isnan(flight.heading).all()


def test_position_date_and_attitude(tmp_path: Path) -> None:
    path = log_of(
        tmp_path / "flight.txt",
        "GPRMC,235959.50,A,4330.0000,N,07736.0000,W,11.2,87.0,310524,,,A",
        "PASHR,235959.50,359.25,T,+1.50,-2.25,,0.01,0.01,0.02,1,1",
        gga("235959.50"),
        gga("000000.00", "4330.0060,N,07736.0000,W"),
        "PASHR,000000.00,0.25,T,-1.25,2.00,,0.01,0.01,0.02,1,1",
        gga("000000.50", "3330.0000,S,15112.0000,E", "20.0,M,,M"),
        "GPHDT,12.5,T",
        "GPGGA,000001.00,,,,,0,00,,,M,,M,,",
    )
    flight = hp.open_navigation(path)
    assert flight.format == "NMEA 0183"
    expected = np.array(["2024-05-31T23:59:59.5", "2024-06-01T00:00:00", "2024-06-01T00:00:00.5"], "M8[ns]")
    np.testing.assert_array_equal(flight.navigation_time, expected)
    np.testing.assert_allclose(flight.latitude, [43.5, 43.5001, -33.5])
    np.testing.assert_allclose(flight.longitude, [-77.6, -77.6, 151.2])
    np.testing.assert_allclose(flight.altitude, [150.0, 150.0, 20.0])
    np.testing.assert_allclose(flight.heading, [359.25, 0.25, 12.5])
    np.testing.assert_allclose(flight["roll"], [1.5, -1.25, np.nan])
    # the third says no height of the geoid: all heights are above that
    assert flight.convention_height_reference == "geoid"
    assert "roll_positive" in flight.assumed


def test_late_sentences_headings_first_and_positions_that_are_none(tmp_path: Path) -> None:
    path = log_of(
        tmp_path / "flight.txt",
        "GPHDT,90.0,T",
        "GPZDA,235959.00,31,05,2024,00,00",
        gga("235959.00"),
        "GPHDT,100.0,T",
        gga("000000.00"),
        "PASHR,235959.50,,T,+1.50,-2.25,,0.01,0.01,0.02,1,1",  # late, and without a heading
        "GPHDT,110.0,T",
        gga("000001.00"),
        gga("000002.00").replace(",4,12,", ",8,12,"),  # simulated
    )
    flight = hp.open_navigation(path)
    expected = np.array(["2024-05-31T23:59:59", "2024-06-01T00:00:00", "2024-06-01T00:00:01"], "M8[ns]")
    np.testing.assert_array_equal(flight.navigation_time, expected)
    np.testing.assert_allclose(flight.heading, [90.0, 100.0, 110.0])


def test_damage_is_counted_or_refused(tmp_path: Path) -> None:
    path = log_of(
        tmp_path / "flight.nmea", "GPZDA,120000.00,01,06,2024,00,00", gga("120000.00"), gga("120001.00")
    )
    damaged = path.read_text().replace("120001.00,4330", "120001.00,4331")
    path.write_text(damaged)
    with pytest.warns(PaintWarning) as warned:
        flight = hp.open_navigation(path, format="nmea")
    texts = [str(each.message) for each in warned]
    assert any("1 of 3 sentences have a wrong checksum" in text for text in texts), texts
    assert flight.sizes["navigation_time"] == 1
    path.write_text(damaged.replace(",2024,", ",2023,").replace("120000.00,4330", "120000.00,4332"))
    with pytest.raises(FormatError, match=r"sentence.*checksum-wrong"):
        hp.open_navigation(path, format="nmea")


@pytest.mark.parametrize(
    ("texts", "error", "problem"),
    [
        ((gga("120000.00"),), TimeError, "date-missing"),
        ((gga("120000.00", "4399.0000,X,07736.0000,W"),), FormatError, "row-unreadable"),
        (("GPZDA,120000.00,01,06,2024,00,00",), FormatError, "position-missing"),
        ((gga("120000.00", "9930.0000,N,07736.0000,W"),), FormatError, "latitude is 99.5"),
    ],
)
def test_what_is_no_log_is_refused(
    tmp_path: Path, texts: tuple[str, ...], error: type[Exception], problem: str
) -> None:
    path = log_of(tmp_path / "log.txt", "GPZDA,115959.00,01,06,2024,00,00", *texts)
    if error is TimeError:
        path = log_of(tmp_path / "log.txt", *texts)
    with pytest.raises(error, match=problem):
        hp.open_navigation(path, format="nmea")


COLUMNS = (
    "time_of_week [s]",
    "lat [rad]",
    "lon [rad]",
    "alt [m]",
    "-",
    "roll [degree]",
    "pitch [degree]",
    "yaw [degree]",
)


@pytest.mark.parametrize("separator", [" ", "  ", ",", "\t", ";"])
def test_columns_of_a_table_without_a_header(tmp_path: Path, separator: str) -> None:
    path = tmp_path / "poses.txt"
    rows = "302400.5 0.76 -1.35 150 x 0.5 -1 359.5", "302401 0.76 -1.35 151 y 0.4 -1 0.5"
    path.write_text("".join(row.replace(" ", separator) + "\n" for row in rows))
    flight = hp.open_navigation(path, columns=COLUMNS, week=2316)
    np.testing.assert_allclose(flight.latitude, np.degrees([0.76, 0.76]))
    np.testing.assert_allclose(flight.heading, [359.5, 0.5])
    assert flight.navigation_time.values[0] == np.datetime64("2024-05-29T11:59:42.5")
    with pytest.raises(FormatError, match="header-missing"):
        hp.open_navigation(path, format="csv")


def test_wrong_columns_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "poses.txt"
    path.write_text("302400.5 43.1 -77.6 150 0.5 -1\n")
    with pytest.raises(FormatError, match="line 1 without 8 cells"):
        hp.open_navigation(path, columns=COLUMNS, week=2316)
    with pytest.raises(FormatError, match="column-missing"):
        hp.open_navigation(
            path, columns=["utc", "lat [deg]", "lon [deg]", "alt [m]", "roll [deg]", "pitch [deg]"]
        )
    with pytest.raises(SchemaError, match="option-conflict"):
        hp.open_navigation(path, columns=COLUMNS, format="sbet")
