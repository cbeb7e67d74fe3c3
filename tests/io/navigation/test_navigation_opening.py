"""Navigation files of every kind: known values, clocks, conventions, and what is refused."""

import datetime
import re
import zoneinfo
from functools import partial, reduce
from operator import xor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, strategies as st
from support.files import write_file
from support.refusals import expect_error, expect_errors, expect_refusals, expect_words

import hyperpaint as hp
from hyperpaint.base.attitude_conventions import Convention
from hyperpaint.base.errors import CollectError, FormatError, PaintWarning, SchemaError, TimeError
from hyperpaint.cli.info_command import describe_path
from hyperpaint.io.flightline.flightline_opening import Timing, line_times, utc_of
from hyperpaint.io.navigation.navigation_records import (
    LEAP_SECONDS,
    LEAP_SECONDS_EXPIRY,
    Clock,
    gps_to_utc,
    read_control_points,
    read_gps_time,
    read_imu_gps,
    to_utc,
)
from hyperpaint.simulation import simulate_collect

# --- Navigation files written here by hand


POSE = ("latitude", "longitude", "altitude", "roll", "pitch", "heading")
GPS_EPOCH = np.datetime64("1980-01-06T00:00:00", "ns")
CSV_HEADER = (
    "time,latitude [degree],longitude [degree],altitude [m],roll [degree],pitch [degree],heading [degree]"
)
CSV_ROWS = (
    "2024-06-01T12:00:00Z,43.1,-77.6,150.5,1,-2,359.5",
    "2024-06-01T12:00:00.25Z,43.2,-77.7,151,2,-1,0.5",
)


def write_sbet(path: Path, seconds: Any, **columns: Any) -> Path:
    # Write 17 columns of float64: time, place [rad, m], velocity, attitude [rad], wander, and the rest
    records = np.zeros((len(seconds), 17), "<f8")
    records[:, 0] = seconds
    places = {"latitude": 1, "longitude": 2, "altitude": 3, "roll": 7, "pitch": 8, "heading": 9, "wander": 10}
    for name, values in columns.items():
        records[:, places[name]] = values
    path.write_bytes(records.tobytes())
    return path


def write_csv(path: Path, *lines: str) -> Path:
    path.write_text("\n".join(lines) + "\n")
    return path


def seconds_since(time: Any, start: Any) -> list[float]:
    return ((time - np.datetime64(start, "ns")) / np.timedelta64(1, "ns") / 1e9).tolist()


# --- SBET --------------------------------------------------------------------------------------------------


def test_sbet_is_radian_with_the_wander_angle_taken_out(tmp_path: Path) -> None:
    path = write_sbet(
        tmp_path / "flight.sbet", [100.0, 100.005], latitude=0.75, longitude=-1.35, altitude=[150.0, 151.0],
        roll=0.1, pitch=[-0.2, np.nan], heading=[3.0, 3.1], wander=-0.02,
    )  # fmt: skip
    flight = hp.open_navigation(path, week=2158)
    assert flight.sizes == {"navigation_time": 2}
    assert all(flight[name].dtype == np.float64 for name in POSE)
    assert flight.navigation_time.dtype == "datetime64[ns]"
    np.testing.assert_allclose(flight.latitude, np.degrees(0.75), rtol=0, atol=1e-12)
    assert flight.heading.values.tolist() == [3.02, 3.12]
    assert (flight.platform_heading.values.tolist(), flight["roll"].attrs["units"]) == ([3.0, 3.1], "radian")
    assert np.isnan(flight.pitch.values[1])
    found = Convention.from_attrs(flight.attrs)
    assert (found, found.stamp_reference, found.column_order) == (Convention(angle_unit="radian"), None, None)
    assert "assumed" not in flight.attrs


def test_seconds_of_the_week_become_utc(tmp_path: Path) -> None:
    path = write_sbet(tmp_path / "flight.sbet", [1.0, 1.005])
    start = GPS_EPOCH + np.timedelta64(2158 * 7, "D")
    flight = hp.open_navigation(path, week=2158)
    assert seconds_since(flight.navigation_time.values, start) == [1.0 - 18, 1.005 - 18]
    expected = {"gps_week": 2158, "gps_week_source": "given", "time_scale": "gps", "leap_seconds": 18}
    assert {key: flight.attrs[key] for key in expected} == expected
    assert flight.attrs["leap_seconds_source"] == "IERS table"
    told = hp.open_navigation(path, week=2158, leap_seconds=17, clock_offset_s=0.5)
    assert seconds_since(told.navigation_time.values, start) == [-15.5, -15.495]
    assert (told.attrs["leap_seconds"], told.attrs["clock_offset_s"]) == (17, 0.5)
    utc = hp.open_navigation(path, week=2158, time_scale="utc")
    assert seconds_since(utc.navigation_time.values, start) == [1.0, 1.005]
    assert "leap_seconds" not in utc.attrs


def test_a_date_gives_the_week_and_is_checked(tmp_path: Path) -> None:
    path = write_sbet(tmp_path / "flight.sbet", [4 * 86_400 + 43_200])
    for date in ("2021-05-20", datetime.date(2021, 5, 20), "2021-05-19", "2021-05-21"):  # dates may be local
        flight = hp.open_navigation(path, date=date)
        assert flight.attrs["gps_week"] == 2158
        assert str(flight.navigation_time.values[0]).startswith("2021-05-20T11:59:42")
    expect_refusals(
        (TimeError, "date-conflict", lambda: hp.open_navigation(path, date="2021-05-17")),
        (TimeError, "gps-week-missing", lambda: hp.open_navigation(path)),
    )


def test_a_record_runs_on_over_the_end_of_the_week(tmp_path: Path) -> None:
    for stamps in ([604_799.5, 0.5], [604_799.5, 604_800.5]):
        flight = hp.open_navigation(write_sbet(tmp_path / "flight.sbet", stamps), week=2158)
        assert seconds_since(flight.navigation_time.values, flight.navigation_time.values[0]) == [0.0, 1.0]


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        ({"week": -1}, "week -1"),
        ({"date": "2021-02-30"}, "date '2021-02-30'"),
        ({"leap_seconds": -1}, "leap_seconds -1"),
        ({"time_scale": "tai"}, "time_scale='tai'"),
        ({"clock_offset_s": float("nan")}, "clock_offset_s nan"),
    ],
)
def test_clocks_that_cannot_be_are_refused(tmp_path: Path, arguments: dict[str, Any], match: str) -> None:
    expect_errors(
        (
            TimeError,
            match,
            lambda: hp.open_navigation(write_sbet(tmp_path / "flight.sbet", [1.0]), **arguments),
        )
    )


def test_numbers_of_a_clock_are_whole(tmp_path: Path) -> None:
    path = write_sbet(tmp_path / "flight.sbet", [1.0])
    times = [hp.open_navigation(path, week=week).navigation_time for week in (2158, 2158.0)]
    assert times[0].identical(times[1])
    for name in ("week", "leap_seconds"):
        expect_errors(
            (SchemaError, f"{name}=1.5.*type-wrong", partial(hp.open_navigation, path, **{name: 1.5}))
        )


def test_times_beyond_the_table_of_leap_seconds_are_told(tmp_path: Path) -> None:
    with pytest.warns(PaintWarning, match="leap seconds"):
        hp.open_navigation(write_sbet(tmp_path / "flight.sbet", [1.0]), week=3000)


@pytest.mark.parametrize(
    ("columns", "match"),
    [
        ({"latitude": 2.0}, "latitude is 114"),
        ({"longitude": 1e308}, "value-out-of-range"),  # in degrees beyond float64, and still no warning
        ({"roll": [0.0, np.inf]}, "roll is inf in record 2"),
        ({"altitude": 1e6}, "altitude is 1.*value-out-of-range"),
        # all problems at once
        ({"seconds": [-1.0, 2.0], "latitude": 3.0, "heading": 50.0}, "(?s)time is -1.*latitude.*heading"),
    ],
)
def test_sbet_with_impossible_values_is_refused(tmp_path: Path, columns: dict[str, Any], match: str) -> None:
    expect_errors(
        (
            FormatError,
            match,
            lambda: hp.open_navigation(
                write_sbet(tmp_path / "flight.sbet", **{"seconds": [1.0, 2.0], **columns}), week=2158
            ),
        )
    )


def test_sbet_of_part_records_or_backward_times_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "part.sbet"
    for size in (0, 1, 135, 137, 271):
        path.write_bytes(bytes(size))
        expect_error(
            FormatError, f"{size} bytes.*file-truncated", lambda: hp.open_navigation(path, week=2158)
        )
    expect_errors(
        (
            TimeError,
            r"record 3.*time-unordered",
            lambda: hp.open_navigation(write_sbet(tmp_path / "flight.sbet", [5.0, 6.0, 5.5]), week=2158),
        )
    )


@given(st.data())
def test_sbet_angles_and_times_come_back(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    count = data.draw(st.integers(1, 20))
    angle = st.floats(-np.pi, np.pi)
    columns = {name: data.draw(st.lists(angle, min_size=count, max_size=count)) for name in POSE[3:]}
    micros = np.sort(
        np.array(
            data.draw(st.lists(st.integers(0, 604_800_000_000), min_size=count, max_size=count, unique=True))
        )
    )
    flight = hp.open_navigation(
        write_sbet(tmp_path_factory.mktemp("sbet") / "flight.sbet", micros / 1e6, **columns),
        week=2158,
        time_scale="utc",
    )
    for name, values in columns.items():
        assert flight[name].values.tolist() == values  # no wrap, no turn
    week = (GPS_EPOCH + np.timedelta64(2158 * 7, "D")).astype(np.int64)
    np.testing.assert_array_equal(flight.navigation_time.values.astype(np.int64) - week, micros * 1000)


# --- Resonon -----------------------------------------------------------------------------------------------


def write_lcf(path: Path, times: list[float], *, columns: int = 9) -> Path:
    path.write_text(
        "\n".join(
            "\t".join(map(repr, row))
            for row in [[time, 0.1, -0.05, 6.28, -77.6, 43.1, 150.0, 0, 0][:columns] for time in times]
        )
        + "\r\n"
    )
    return path


def test_lcf_has_its_right_wing_up(tmp_path: Path) -> None:
    flight = hp.open_navigation(write_lcf(tmp_path / "line.lcf", [1.3e9, 1.3e9 + 0.5]))
    first = flight.isel(navigation_time=0)
    assert [float(first[name]) for name in POSE] == [43.1, -77.6, 150.0, 0.1, -0.05, 6.28]
    found = Convention.from_attrs(flight.attrs)
    assert found == Convention(roll_positive="right_wing_up", angle_unit="radian")
    np.testing.assert_allclose(found.canonical(0.1, 0.0, 0.0)[0], -np.degrees(0.1))
    # 1.3e9 s of GPS time are 2021-03-17T07:06:40, of which 18 are leap seconds
    assert str(flight.navigation_time.values[0]) == "2021-03-17T07:06:22.000000000"
    assert seconds_since(flight.navigation_time.values, flight.navigation_time.values[0]) == [0.0, 0.5]
    assert flight.attrs["leap_seconds"] == 18
    expect_errors(
        (TimeError, "gps-week-conflict", lambda: hp.open_navigation(tmp_path / "line.lcf", week=2158))
    )
    path = write_lcf(tmp_path / "line.lcf", [5.0, 6.0], columns=7)
    expect_errors((TimeError, "gps-week-missing", lambda: hp.open_navigation(path)))
    assert hp.open_navigation(path, week=2158).attrs["gps_week"] == 2158


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("", "no rows"),
        ("1 2 3\n", "line 1 without"),
        ("1e9 0 0 0 0 0 0\n1e9 0 0 x 0 0 0\n", "'heading'.*value-out-of-range"),
        ("1e9 0 0 0 0 0 0\n1e9 0 0 0 0 95 0\n", "'latitude'.* line 2"),
        ("1e9 0 0 90 0 0 0\n", "heading is 90"),
        ("1e9 0 0 0 0 0 0\n5 0 0 0 0 0 0\n1e9 0 0 0 0 0 0\n", "line 2.*time-origin-conflict"),
        ("-5 0 0 0 0 0 0\n", "time is -5 s in line 1.*value-out-of-range"),
        ("1e9 0 0 0 0 0 0\nnan 0 0 0 0 0 0\n", "time is nan s in line 2.*value-out-of-range"),
        ("-1 0 0 0 0 0 0\n5 0 0 0 0 0 0\n1e9 0 0 0 0 0 0\n", "time is -1 s in line 1"),
        ("5 0 0 0 0 0 0\nnoon 0 0 0 0 0 0\n", "'time'.*line 2"),
        ("5 0 0 0 0 0 0\n8e9 0 0 0 0 0 0\n", "'time'.*line 2"),
        ("1e9 0 0 0 0 0 0 \0", "binary"),
    ],
)
def test_lcf_that_is_none_is_refused(tmp_path: Path, text: str, match: str) -> None:
    path = write_file(tmp_path / "line.lcf", text)
    caught = expect_error(FormatError, match, lambda: hp.open_navigation(path, leap_seconds=18))
    assert len(caught.problems) <= 1  # no cell is listed twice


# --- csv ---------------------------------------------------------------------------------------------------


def test_csv_keeps_what_its_comments_declare(tmp_path: Path) -> None:
    path = write_csv(
        tmp_path / "flight.csv",
        *("# from: somewhere", "# roll_positive: right_wing_up", "# column_order: right_to_left"),
        *("# stamp_reference: start", CSV_HEADER, *CSV_ROWS),
    )
    flight = hp.open_navigation(path)
    assert Convention.from_attrs(flight.attrs) == Convention(
        roll_positive="right_wing_up", column_order="right_to_left", stamp_reference="start"
    )
    expect_words(flight.attrs["assumed"], "pitch_positive", without=("roll_positive",))
    assert flight.heading.values.tolist() == [359.5, 0.5]
    assert seconds_since(flight.navigation_time.values, "2024-06-01T12:00:00") == [0.0, 0.25]
    assert flight.attrs["time_scale"] == "utc"


@pytest.mark.parametrize("encoding", ["utf-8", "cp1252", "utf-16"])
@pytest.mark.parametrize("quote", ["", '"'])
def test_csv_as_spreadsheets_write_it(tmp_path: Path, encoding: str, quote: str) -> None:
    rows = [CSV_HEADER.replace("degree", "°"), *CSV_ROWS]
    rows = [";".join(f"{quote}{cell}{quote}" for cell in row.split(",")) for row in rows]
    text = "\n".join(["sep=;", "# height_reference: geoid;;;;;;", *rows, ""])
    (tmp_path / "f.csv").write_bytes(text.encode(encoding))
    flight = hp.open_navigation(tmp_path / "f.csv")
    assert flight.heading.values.tolist() == [359.5, 0.5]
    assert flight.attrs["convention_height_reference"] == "geoid"


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_csv_units_are_converted_but_angles_stay(tmp_path: Path, separator: str) -> None:
    header = [
        "unix_time [ms]",
        "lat_rad",
        "lon (deg)",
        "alt_ft" if separator == ";" else "alt [ft]",
        "roll_rad",
        "pitch (rad)",
        "yaw [rad]",
        "note",
    ]
    flight = hp.open_navigation(
        write_csv(
            tmp_path / "f.csv",
            separator.join(header),
            separator.join(["1717243200250", "0.75", "-77.6", "100", "0.1", "", "-3", "x"]),
        )
    )
    np.testing.assert_allclose(
        [float(flight[name].values[0]) for name in POSE],
        [np.degrees(0.75), -77.6, 30.48, 0.1, np.nan, -3.0],
        rtol=1e-12,
    )
    assert (flight["roll"].attrs["units"], flight.attrs["convention_angle_unit"]) == ("radian", "radian")
    assert str(flight.navigation_time.values[0]) == "2024-06-01T12:00:00.250000000"


@pytest.mark.parametrize(
    ("column", "cell", "expected"),
    [
        ("time", "2024-06-01T14:00:00+02:00", "2024-06-01T12:00:00"),
        ("time", "2024-06-01T07:00:00-05", "2024-06-01T12:00:00"),
        ("date,utc time", "2024-06-01,12:00:00", "2024-06-01T12:00:00"),
        ("gps_week,tow [s]", "2317,561618", "2024-06-08T12:00:00"),
        ("utc", "2024/06/01 12:00:00", "2024-06-01T12:00:00"),
        ("gps_time", "2024-06-01 12:00:18", "2024-06-01T12:00:00"),
        ("gps_time [s]", "1401278418", "2024-06-01T12:00:00"),
        ("time_of_week [s]", "561618", "2024-06-01T12:00:00"),
        ("tow_us", "561618000000", "2024-06-01T12:00:00"),
    ],
)
def test_csv_clocks(tmp_path: Path, column: str, cell: str, expected: str) -> None:
    assert hp.open_navigation(
        write_csv(
            tmp_path / "f.csv",
            *([] if "gps_week" in column else ["# gps_week: 2316"]),
            CSV_HEADER.replace("time", column, 1),
            f"{cell},43,-77,150,0,0,0",
        )
    ).navigation_time.values[0] == np.datetime64(expected, "ns")


@pytest.mark.parametrize(
    ("lines", "match"),
    [
        (["a,b", "1,2"], "header-missing"),
        (
            [CSV_HEADER.replace("roll [degree]", "roll"), CSV_ROWS[0]],
            "'roll'.*units-missing",
        ),
        ([CSV_HEADER.replace("altitude [m]", "altitude [s]"), CSV_ROWS[0]], "'s' are not convertible to 'm'"),
        ([CSV_HEADER.replace("pitch", "roll"), CSV_ROWS[0]], "column-duplicate"),
        ([CSV_HEADER.replace("time", "when"), CSV_ROWS[0]], "column-missing"),
        ([CSV_HEADER, CSV_ROWS[0].replace("Z", "")], "time-unreadable"),
        ([CSV_HEADER, "12.5,43,-77,150,0,0,0"], "time-origin-unknown"),
        ([CSV_HEADER, CSV_ROWS[0], "2024-06-01"], "line 3 without 7 cells"),
        ([CSV_HEADER], "no rows"),
        ([CSV_HEADER, ",43,-77,150,0,0,0"], "time-missing"),
        ([CSV_HEADER, CSV_ROWS[0].replace("43.1", "143.1")], "latitude is 143.1"),
        ([CSV_HEADER, CSV_ROWS[0].replace("43.1", "1_0")], "value-out-of-range"),
        ([CSV_HEADER, CSV_ROWS[0].replace("150", "-9999")], "altitude is -9999.*value-out-of-range"),
        (
            [CSV_HEADER.replace(",", ";"), "2024-06-01T12:00:00Z;43,1;-77,1;150,0;0;0;0"],
            "decimal points.*value-out-of-range",
        ),
        ([CSV_HEADER, CSV_ROWS[0].replace("06-01", "02-30")], "time-unreadable"),
        (["# roll_positive: up", CSV_HEADER, CSV_ROWS[0]], "roll_positive='up'"),
        (["# angle_unit: radian", CSV_HEADER, CSV_ROWS[0]], "'angle_unit' is 'radian'"),
        (["# gps_week: soon", CSV_HEADER, CSV_ROWS[0]], "'gps_week' is 'soon'"),
        (["# declination: west", CSV_HEADER, CSV_ROWS[0]], "'declination' is 'west'"),
        ([CSV_HEADER.replace("time", "unix_time"), "12,43,-77,150,0,0,0"], "units-missing"),
        ([CSV_HEADER.replace("time", "unix_time [s]"), "-12,43,-77,150,0,0,0"], "is negative"),
        # all problems at once
        (
            [
                "# time_scale: tai",
                CSV_HEADER.replace("roll [degree]", "roll").replace("pitch [", "tilt ["),
                CSV_ROWS[0],
            ],
            "(?s)time_scale.*'roll' has no unit.*no column of pitch",
        ),
    ],
)
def test_csv_that_is_none_is_refused(tmp_path: Path, lines: list[str], match: str) -> None:
    expect_errors(
        (FormatError, match, lambda: hp.open_navigation(write_csv(tmp_path / "flight.csv", *lines)))
    )


def test_rows_without_a_time_are_counted(tmp_path: Path) -> None:
    flight = hp.open_navigation(write_csv(tmp_path / "f.csv", CSV_HEADER, ",,,,,,", *CSV_ROWS))
    assert (flight.sizes["navigation_time"], flight.attrs["rows_without_time"]) == (2, 1)


# --- Headwall, AVIRIS, several files -----------------------------------------------------------------------


def write_imu(path: Path, **changes: str) -> Path:
    path.write_text(
        "\n".join(
            [
                "Roll\tPitch\tYaw\tLat\tLon\tAlt\tTimestamp\tGps_UTC_Date&Time",
                *[f"1.5\t-2\t359\t43\t-77\t150\t{500 + i}\t2021/07/23 12:00:0{i}.500" for i in range(3)],
            ]
        )
        + "\n"
    )
    return path


def test_headwall_assumes_what_nobody_publishes(tmp_path: Path) -> None:
    flight = hp.open_navigation(write_imu(tmp_path / "imu_gps.txt"))
    assert flight.heading.values.tolist() == [359.0] * 3
    assert seconds_since(flight.navigation_time.values, "2021-07-23T12:00:00") == [0.5, 1.5, 2.5]
    assert flight.attrs["time_scale"] == "utc"
    assert set(flight.attrs["assumed"].split(", ")) >= {
        "roll_positive",
        "heading_reference",
        "height_reference",
    }
    assert (
        seconds_since(
            hp.open_navigation(tmp_path / "imu_gps.txt", time_scale="gps").navigation_time.values,
            "2021-07-23T12:00:00",
        )[0]
        == 0.5 - 18
    )


def test_headwall_with_the_clock_of_the_computer_alone(tmp_path: Path) -> None:
    path = write_file(
        tmp_path / "imu_gps.txt",
        "Roll\tPitch\tYaw\tLat\tLon\tAlt\tTime\n"
        + "".join([f"1\t2\t3\t43\t-77\t150\t12:00:0{i} 250000\n" for i in range(3)]),
    )
    expect_errors((TimeError, "date-missing", lambda: hp.open_navigation(path)))
    assert seconds_since(
        hp.open_navigation(path, date="2021-07-23", clock_offset_s=18_000.0).navigation_time.values,
        "2021-07-23T17:00:00",
    ) == [0.25, 1.25, 2.25]
    clock = write_file(
        tmp_path / "gps_time.txt", "12:00:00 0\t2021/07/23 16:00:00.5\n12:00:05 0\t2021/07/23 16:00:05.5\n"
    )
    assert seconds_since(
        hp.open_navigation(path, gps_time=clock).navigation_time.values, "2021-07-23T16:00:00"
    ) == [0.75, 1.75, 2.75]


def write_eph(folder: Path, interleave: str = "bip", **header: str) -> Path:
    table = np.array(
        [
            [418_977.0, 31.5, -114.5, 19_871.0, 0.1, 0.2, -14.0],
            [418_977.1, 31.6, -114.6, 19_872.0, 0.3, 0.4, -15.0],
        ]
    )
    path = folder / "ang20170323t202244_eph_att"
    (table if interleave != "bsq" else table.T).astype("<f8").tofile(path)
    keys = {
        "samples": "1", "lines": "2", "bands": "7", "data type": "5", "interleave": interleave,
        "byte order": "0", "band names": "{gpstime, lat, lon, alt, pitch, roll, heading}", **header,
    }  # fmt: skip
    Path(f"{path}.hdr").write_text("ENVI\n" + "".join(f"{key} = {value}\n" for key, value in keys.items()))
    return path


@pytest.mark.parametrize("interleave", ["bip", "bil", "bsq"])
def test_eph_att_is_read_by_its_band_names(tmp_path: Path, interleave: str) -> None:
    flight = hp.open_navigation(write_eph(tmp_path, interleave))
    assert (flight["roll"].values.tolist(), flight.pitch.values.tolist()) == ([0.2, 0.4], [0.1, 0.3])
    assert flight.latitude.values.tolist() == [31.5, 31.6]
    # the name says the week, and agrees with the stamps
    assert flight.attrs["gps_week"] == 1941
    assert "height_reference" in flight.attrs["assumed"]


def test_eph_att_that_is_none_is_refused(tmp_path: Path) -> None:
    caught = expect_error(
        FormatError,
        None,
        lambda: hp.open_navigation(
            write_eph(tmp_path, **{"lines": "200000000", "band names": "{a, b, c, d, e, f, g}"})
        ),
    )
    expect_words(str(caught), "band names", "expected 11200000000")


def test_a_name_that_contradicts_the_stamps_says_no_week(tmp_path: Path) -> None:
    path = write_eph(tmp_path)
    for name in (path, Path(f"{path}.hdr")):
        name.rename(tmp_path / name.name.replace("t202244", "t052244"))
    expect_errors(
        (TimeError, "gps-week-missing", lambda: hp.open_navigation(tmp_path / "ang20170323t052244_eph_att"))
    )


def test_several_files_follow_one_another(tmp_path: Path) -> None:
    first = write_sbet(tmp_path / "a.sbet", [1.0, 2.0], roll=0.1)
    flight = hp.open_navigation([write_sbet(tmp_path / "b.sbet", [3.0], roll=0.2), first], week=2158)
    assert (flight["roll"].values.tolist(), flight.attrs["source"]) == ([0.1, 0.1, 0.2], "a.sbet, b.sbet")
    overlapping = write_sbet(tmp_path / "c.sbet", [1.5])
    expect_refusals(
        (
            TimeError,
            "time-overlap",
            "a.sbet",
            "c.sbet",
            lambda: hp.open_navigation([first, overlapping], week=2158),
        )
    )
    table = write_csv(tmp_path / "a.csv", CSV_HEADER, *CSV_ROWS)
    expect_errors(
        (FormatError, "differ", lambda: hp.open_navigation([table, write_imu(tmp_path / "imu_gps.txt")])),
        (FormatError, "empty-input", lambda: hp.open_navigation([])),
    )
    # every bad file is named
    bad = [tmp_path / "d.sbet", tmp_path / "e.sbet"]
    for path in bad:
        path.write_bytes(bytes(137))
    expect_errors(
        (FormatError, r"(?s)d\.sbet.*e\.sbet", lambda: hp.open_navigation([*bad, overlapping], week=2158))
    )


def test_a_mapping_changes_single_choices(tmp_path: Path) -> None:
    path = write_lcf(tmp_path / "line.lcf", [1.3e9])
    flight = hp.open_navigation(path, convention={"column_order": "right_to_left", "stamp_reference": "end"})
    assert Convention.from_attrs(flight.attrs) == Convention(
        roll_positive="right_wing_up",
        angle_unit="radian",
        column_order="right_to_left",
        stamp_reference="end",
    )
    # a stored record is held to its declarations like a file
    store = hp.to_store(flight, tmp_path / "line.zarr")
    assert hp.open_navigation(store, convention={"declination": 2.0}).attrs["convention_declination"] == 2.0
    for source in (path, store):
        for code, convention in (("units-conflict", Convention()), ("key-unknown", {"colour": "red"})):
            expect_refusals((SchemaError, code, partial(hp.open_navigation, source, convention=convention)))


def test_files_of_no_known_kind_are_refused(tmp_path: Path) -> None:
    path = write_file(tmp_path / "flight.bin", bytes(272))
    expect_errors((FormatError, "format-unknown", lambda: hp.open_navigation(path)))
    assert hp.open_navigation(path, format="sbet", week=0, leap_seconds=0).sizes["navigation_time"] == 2
    expect_error(SchemaError, "format='kml'", lambda: hp.open_navigation(path, format="kml"))
    expect_errors(
        (FormatError, "file-unreadable", lambda: hp.open_navigation(tmp_path / "nothing.sbet", week=1))
    )


def test_info_tells_what_navigation_is(tmp_path: Path) -> None:
    text = describe_path(write_sbet(tmp_path / "flight.sbet", [5.0, 6.0], altitude=150.0))
    expect_words(text, "Applanix SBET", "5 to 6 s of a GPS week: pass week= or date=")
    text = describe_path(write_lcf(tmp_path / "line.lcf", [1.3e9]))
    expect_words(text, "right wing up", "2021-03-17T07:06:40.000")
    text = describe_path(write_csv(tmp_path / "flight.csv", CSV_HEADER, *CSV_ROWS))
    assert "2024-06-01T12:00:00.000 to 2024-06-01T12:00:00.250 UTC" in text
    text = describe_path(write_eph(tmp_path))
    expect_words(text, "AVIRIS-NG eph_att", "GPS week 1941")


# --- logs of NMEA sentences, and tables without a header --------------------------------------------------


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
    np.testing.assert_array_equal(
        flight.navigation_time,
        np.array(["2024-05-31T23:59:59.5", "2024-06-01T00:00:00", "2024-06-01T00:00:00.5"], "M8[ns]"),
    )
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
    np.testing.assert_array_equal(
        flight.navigation_time,
        np.array(["2024-05-31T23:59:59", "2024-06-01T00:00:00", "2024-06-01T00:00:01"], "M8[ns]"),
    )
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
    expect_errors((FormatError, r"sentence.*checksum-wrong", lambda: hp.open_navigation(path, format="nmea")))


ZDA = "GPZDA,115959.00,01,06,2024,00,00"


@pytest.mark.parametrize(
    ("texts", "error", "problem"),
    [
        ((gga("120000.00"),), TimeError, "date-missing"),
        ((ZDA, gga("120000.00", "4399.0000,X,07736.0000,W")), FormatError, "row-unreadable"),
        ((ZDA.replace("2024", "9999"), gga("120000.00")), FormatError, "row-unreadable"),
        ((ZDA.replace("01,06", f"01,{10**20}"), gga("120000.00")), FormatError, "row-unreadable"),
        ((ZDA,), FormatError, "position-missing"),
        ((ZDA, gga("120000.00", "9930.0000,N,07736.0000,W")), FormatError, "latitude is 99.5"),
    ],
)
def test_what_is_no_log_is_refused(
    tmp_path: Path, texts: tuple[str, ...], error: type[Exception], problem: str
) -> None:
    expect_errors(
        (error, problem, lambda: hp.open_navigation(log_of(tmp_path / "log.txt", *texts), format="nmea"))
    )


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
    path = write_file(
        tmp_path / "poses.txt",
        "".join(
            row.replace(" ", separator) + "\n"
            for row in ("302400.5 0.76 -1.35 150 x 0.5 -1 359.5", "302401 0.76 -1.35 151 y 0.4 -1 0.5")
        ),
    )
    flight = hp.open_navigation(path, columns=COLUMNS, week=2316)
    np.testing.assert_allclose(flight.latitude, np.degrees([0.76, 0.76]))
    np.testing.assert_allclose(flight.heading, [359.5, 0.5])
    assert flight.navigation_time.values[0] == np.datetime64("2024-05-29T11:59:42.5")
    expect_errors((FormatError, "header-missing", lambda: hp.open_navigation(path, format="csv")))


def test_wrong_columns_are_refused(tmp_path: Path) -> None:
    path = write_file(tmp_path / "poses.txt", "302400.5 43.1 -77.6 150 0.5 -1\n")
    few = ["utc", "lat [deg]", "lon [deg]", "alt [m]", "roll [deg]", "pitch [deg]"]
    for options, error, match in (
        ({"columns": COLUMNS, "week": 2316}, FormatError, "line 1 without 8 cells"),
        ({"columns": few}, FormatError, "column-missing"),
        ({"columns": COLUMNS, "format": "sbet"}, SchemaError, "option-conflict"),
    ):
        expect_error(error, match, partial(hp.open_navigation, path, **options))


# --- navigation files of others: values known from other programs, signs, and what is refused -------------


@pytest.mark.real_data
def test_the_two_records_of_pdal(shared_data: Path) -> None:
    flight = hp.open_navigation(shared_data / "nav/2-points.sbet", week=1947)
    # radians of PDAL's test; its degrees have a slip in the first latitude, within its tolerance of 1e-4
    expected = {
        "roll": [-2.813407149321339e-02, -2.813856631423094e-02],
        "pitch": [-2.429905393889139e-02, -2.425215669392169e-02],
        "platform_heading": [3.046773230278662, 3.047131105236811],
        "wander_angle": [-2.198414736922658e-02, -2.198416007932108e-02],
        "altitude": [107.7152953296560, 107.7151424357507],
    }
    for name, values in expected.items():
        np.testing.assert_allclose(flight[name], values, rtol=0, atol=1e-12)
    np.testing.assert_allclose(
        np.radians(flight.latitude), [5.680211852972264e-01, 5.680211834722869e-01], atol=1e-12
    )
    np.testing.assert_allclose(flight.longitude, [-116.978180, -116.978180], rtol=0, atol=1e-6)
    np.testing.assert_allclose(np.degrees(flight["roll"][0]), -1.611964, rtol=0, atol=1e-6)
    np.testing.assert_allclose(np.degrees(flight.pitch[0]), -1.392233, rtol=0, atol=1e-6)
    np.testing.assert_allclose(np.degrees(flight.platform_heading[0]), 174.567247, rtol=0, atol=1e-6)
    assert seconds_since(
        flight.navigation_time.values, GPS_EPOCH + np.timedelta64(1947 * 7, "D") - np.timedelta64(18, "s")
    ) == pytest.approx([151631.0028360710, 151631.0078318641], abs=1e-8)


@pytest.mark.real_data
def test_the_sign_of_the_wander_angle(shared_data: Path) -> None:
    # velocities are along the axes of the wander frame (north, west, up): turned by the wander angle they
    # must point where the platform went
    stored = np.fromfile(shared_data / "nav/2-points.sbet", "<f8").reshape(2, 17)
    track = np.degrees(
        np.arctan2(
            (stored[1, 2] - stored[0, 2]) * 6.3843e6 * np.cos(stored[0, 1]),
            (stored[1, 1] - stored[0, 1]) * 6.3540e6,
        )
    )
    velocity = stored[:, 4:6].mean(axis=0)
    in_frame = np.degrees(np.arctan2(-velocity[1], velocity[0]))
    wander = np.degrees(stored[0, 10])
    assert abs(in_frame - wander - track) < 0.5
    assert abs(in_frame + wander - track) > 2.0


@pytest.mark.real_data
def test_a_line_of_aviris(shared_data: Path) -> None:
    flight = hp.open_navigation(shared_data / "nav/ang20170323t202244_eph_att")
    assert flight.sizes["navigation_time"] == 17_540
    # the name says 20:22:44
    assert str(flight.navigation_time.values[0]).startswith("2017-03-23T20:22:39.004")
    assert flight.attrs["gps_week"] == 1941
    steps = np.diff(flight.navigation_time.values) / np.timedelta64(1, "ms")
    assert 92.0 < steps.min() < steps.max() < 101.0
    assert float(flight["roll"].max()) == pytest.approx(11.2, abs=0.05)
    assert -17.6 < float(flight.heading.min()) < float(flight.heading.max()) < -6.6
    # an aircraft that banks turns: with the right wing down, clockwise, by g tan(roll) / speed
    time = (flight.navigation_time.values - flight.navigation_time.values[0]) / np.timedelta64(1, "s")
    smooth = np.ones(51) / 51
    turn = np.convolve(np.gradient(np.unwrap(flight.heading.values, period=360.0), time), smooth, "valid")
    slope = np.polyfit(np.convolve(flight["roll"].values, smooth, "valid"), turn, 1)[0]
    north = np.gradient(flight.latitude.values, time) * 110.9e3
    east = np.gradient(flight.longitude.values, time) * 111.3e3 * np.cos(np.radians(flight.latitude.values))
    assert slope == pytest.approx(9.8 / np.hypot(north, east).mean(), rel=0.1)


@pytest.mark.real_data
def test_a_truncated_sbet_and_attitude_alone_are_refused(shared_data: Path) -> None:
    expect_errors(
        (
            FormatError,
            "file-truncated",
            lambda: hp.open_navigation(shared_data / "nav/badfile.sbet", week=1947),
        )
    )
    caught = expect_error(
        FormatError, None, lambda: hp.open_navigation(shared_data / "gps_imu/px4_attitude_69s.csv")
    )
    assert all(f"no column of {name}" in str(caught) for name in ("latitude", "longitude", "altitude"))


@pytest.mark.real_data
def test_real_attitude_through_every_format(shared_data: Path, tmp_path: Path) -> None:
    table = np.loadtxt(shared_data / "gps_imu/px4_attitude_69s.csv", delimiter=",", skiprows=1)[
        :, [0, 5, 6, 7]
    ]
    seconds, angles = table[:, 0] / 1e6, np.radians(table[:, 1:]).T
    sbet = write_sbet(
        tmp_path / "a.sbet", seconds, latitude=0.75, longitude=-1.35,
        roll=angles[0], pitch=angles[1], heading=angles[2],
    )  # fmt: skip
    csv = write_csv(
        tmp_path / "a.csv",
        "tow [s],lat [rad],lon [rad],alt [m],roll [rad],pitch [rad],yaw [rad]",
        *(
            f"{t!r},0.75,-1.35,0,{r!r},{p!r},{y!r}"
            for t, r, p, y in zip(seconds.tolist(), *angles.tolist(), strict=True)
        ),
    )
    one, other = (hp.open_navigation(path, week=2158) for path in (sbet, csv))
    for name in POSE:
        np.testing.assert_array_equal(one[name], other[name])
    np.testing.assert_array_equal(one.navigation_time, other.navigation_time)
    assert float(np.degrees(one["roll"].min())) == pytest.approx(-22.2, abs=0.05)


# --- what the poses of a flight line mean is kept with them -----------------------------------------------


@pytest.fixture(scope="module")
def collect(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulate_collect(
        tmp_path_factory.mktemp("meaning"), scene="plan", lines=40, bands=4, columns=6, stamp="mid"
    )


def opened(collect: Path, **options: object) -> xr.Dataset:
    flight = collect.parent / "flight"
    return hp.open_flightline(
        flight / "raw_0.hdr",
        frame_index=flight / "frameIndex_0.txt",
        nav=flight / "imu_gps.txt",
        dark="none",
        calibration=collect.parent / "calibration.zarr",
        stamp="mid",
        **options,
    )


def changed(collect: Path, old: str, new: str) -> Path:
    text, count = re.subn(old, new, collect.read_text(), flags=re.MULTILINE)
    assert count == 1
    return write_file(collect.with_name("changed.toml"), text)


def test_what_nobody_declares_is_listed(collect: Path) -> None:
    line = opened(collect)
    assert Convention.from_attrs(line.attrs) == Convention(stamp_reference="mid")
    assert set(line.attrs["navigation_assumed"].split(", ")) == {
        "roll_positive", "pitch_positive", "heading_positive", "heading_reference", "angle_unit",
        "euler_order", "height_reference",
    }  # fmt: skip


def test_what_is_declared_is_kept(collect: Path) -> None:
    declared = {"roll_positive": "right_wing_up", "height_reference": "geoid", "geoid_undulation": -34.2}
    line = opened(collect, convention=declared)
    assert Convention.from_attrs(line.attrs) == Convention(stamp_reference="mid", **declared)
    expect_words(line.attrs["navigation_assumed"], "pitch_positive", without=("roll_positive",))


@pytest.mark.parametrize(
    ("declared", "told"),
    [
        ({"roll": "up"}, "key-unknown"),
        ({"angle_unit": "radian"}, "key-unknown"),
        ({"stamp_reference": "mid"}, "key-unknown"),
        ({"column_order": "backwards"}, "column_order='backwards'"),
    ],
)
def test_what_does_not_exist_is_refused(collect: Path, declared: dict[str, str], told: str) -> None:
    expect_errors((SchemaError, re.escape(told), lambda: opened(collect, convention=declared)))


def test_collect_declares_it(collect: Path) -> None:
    line = hp.open_collect(changed(collect, "^column_order = .*", 'column_order = "right_to_left"'))
    meant = Convention.from_attrs(line["flightlines/raw_0"].attrs)
    assert meant == Convention(stamp_reference="mid", column_order="right_to_left")


def test_mistakes_in_a_collect_are_told(collect: Path) -> None:
    caught = expect_error(
        CollectError,
        None,
        lambda: hp.open_collect(changed(collect, "^roll_positive = .*", 'roll_positive = "up"\nwander = 3')),
    )
    expect_words(str(caught), "[navigation] roll_positive = 'up', expected one of right_wing_down", "wander")


def test_a_line_without_navigation_means_nothing(collect: Path) -> None:
    flight = collect.parent / "flight"
    line = hp.open_flightline(
        flight / "raw_0.hdr", start_time="2024-06-01T12:00:00Z", frame_period=0.007, dark="none",
        calibration=collect.parent / "calibration.zarr",
    )  # fmt: skip
    assert Convention.from_attrs(line.attrs) is None


# --- Navigation records, clocks and leap seconds, and their join to the lines of a cube ---

T0 = np.datetime64("2021-07-23T12:00:00", "ns")
MS = np.timedelta64(1, "ms")
HEADER_A = "Roll\tPitch\tYaw\tLat\tLon\tAlt\tTimestamp\tGps_UTC_Date&Time\tStatus\tHeading"
HEADER_D = (
    "Roll\tPitch\tYaw\tLat\tLon\tAlt\tGPS_UTC\tGps_UTC_Date&Time\tTrack_Angle\tGeoid_Separation"
    "\tSystemTime\tSpeed\tGps_Raw_Date&Time"
)


def date_of(time: np.datetime64, month_name: bool = False) -> str:
    return (
        time.astype("datetime64[us]")
        .item()
        .strftime("%Y/%b/%d %H:%M:%S.%f" if month_name else "%Y/%m/%d %H:%M:%S.%f")
    )


def write_a(
    path: Path,
    rows: list[dict[str, Any]],
    newline: str = "\n",
) -> Path:
    lines = [HEADER_A]
    for row in rows:
        full = {"roll": 1.0, "pitch": -2.0, "yaw": 90.0, "lat": -34.53, "lon": 138.688, "alt": 61.44, **row}
        pose = [str(full[key]) for key in ("roll", "pitch", "yaw", "lat", "lon", "alt")]
        date = full["utc"] if isinstance(full["utc"], str) else date_of(full["utc"])
        lines.append("\t".join([*pose, str(full["stamp"]), date, "4", "90"]))
    path.write_bytes((newline.join(lines) + newline).encode())
    return path


def steady(count: int = 5, step_ms: int = 10, boot_us: int = 500, **extra: Any) -> list[dict[str, Any]]:
    return [
        {"stamp": boot_us + 1000 * step_ms * i, "utc": T0 + i * step_ms * MS, **extra} for i in range(count)
    ]


def write_index(path: Path, stamps: list[Any], first: int = 0, column: str = "Timestamp") -> Path:
    rows = "".join(f"{first + i}\t{stamp}\n" for i, stamp in enumerate(stamps))
    path.write_text(f"Frame#\t{column}\n{rows}")
    return path


# --- imu_gps.txt -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_variant_a(tmp_path: Path, newline: str) -> None:
    nav = read_imu_gps(write_a(tmp_path / "imu_gps.txt", steady(3), newline))
    assert nav.utc.astype("datetime64[ns]").tolist() == [(T0 + i * 10 * MS).astype(int) for i in range(3)]
    assert nav.stamps["timestamp"].tolist() == [500, 10_500, 20_500]
    assert {name: value[0] for name, value in nav.values.items()} == {
        "latitude": -34.53, "longitude": 138.688, "altitude": 61.44,
        "roll": 1.0, "pitch": -2.0, "heading": 90.0,
    }  # fmt: skip
    assert all(value.dtype == np.float64 for value in nav.values.values())


@pytest.mark.parametrize("clock", ["SystemTime", "GPS_UTC"])
def test_variant_d_joins_by_the_clock_that_covers_the_frames(tmp_path: Path, clock: str) -> None:
    rows = []
    for i in range(4):
        covering, other = 1_000_000 + 10_000 * i, "43514.9" if clock == "SystemTime" else 77 + i
        gps, system = (covering, other) if clock == "GPS_UTC" else (other, covering)
        date = date_of(T0 + i * 10 * MS, month_name=True)
        rows.append(f"1\t2\t3\t-34\t138\t60\t{gps}\t{date}\t4\t5\t{system}\t6\t{date}")
    path = write_file(tmp_path / "imu_gps.txt", "\n".join([HEADER_D, *rows]))
    timing = Timing(
        frame_index=write_index(tmp_path / "f.txt", [1_005_000, 1_015_000]), nav=path, stamp="mid"
    )
    made = line_times(Path("raw_0"), 2, timing)
    assert (made.time - T0).tolist() == [5_000_000, 15_000_000]
    assert clock.lower() in made.source


def test_variant_b_takes_utc_from_gps_time(tmp_path: Path) -> None:
    nav = write_file(
        tmp_path / "imu_gps.txt",
        "Roll\tPitch\tYaw\tLat\tLon\tAlt\tTime\n"
        + "".join([f"1\t2\t{10 * i}\t-34\t138\t{60 + i}\t23:59:59 {990_000 + 2000 * i}\n" for i in range(5)]),
    )
    gps_time = write_file(
        tmp_path / "gps_time.txt",
        "PC\tPOS\n23:59:58 0\t2021/07/23 21:59:59.250000\n00:00:01 0\t2021/07/23 22:00:02.250000\n",
    )
    index = write_index(tmp_path / "f.txt", ["23:59:59 991000", "23:59:59 998000"], column="Time")
    made = line_times(Path("raw_0"), 2, Timing(frame_index=index, nav=nav, gps_time=gps_time, stamp="mid"))
    assert (made.time - np.datetime64("2021-07-23T22:00:01.241", "ns")).tolist() == [0, 7_000_000]
    np.testing.assert_allclose(made.pose["altitude"], [60.5, 64.0])
    assert read_gps_time(gps_time).daily


def test_time_of_day_with_a_date_needs_the_offset_of_the_computer(tmp_path: Path) -> None:
    index = write_index(tmp_path / "f.txt", ["23:59:59 990000", "00:00:00 0"], column="Time")
    timing = Timing(frame_index=index, date="2021-07-23", stamp="mid")
    expect_errors((TimeError, "clock_offset_s", lambda: line_times(Path("raw_0"), 2, timing)))
    timing = Timing(frame_index=index, date="2021-07-23", stamp="mid", clock_offset_s=18_000.5)
    assert (
        line_times(Path("raw_0"), 2, timing).time - np.datetime64("2021-07-24T05:00:00.49", "ns")
    ).tolist() == [0, 10_000_000]
    expect_errors(
        (
            TimeError,
            "time-unreadable",
            lambda: line_times(
                Path("raw_0"), 2, Timing(frame_index=index, date="2021-02-30", clock_offset_s=0.0)
            ),
        )
    )


def test_rows_without_altitude_have_no_position(tmp_path: Path) -> None:
    rows = steady(3)
    rows[1]["alt"] = -9999.0
    nav = read_imu_gps(write_a(tmp_path / "imu_gps.txt", rows))
    for name in ("latitude", "longitude", "altitude"):
        assert np.isnan(nav.values[name]).tolist() == [False, True, False]
    assert np.isfinite(nav.values["roll"]).all()


def test_rows_before_alignment_have_no_attitude_and_no_foreign_date(tmp_path: Path) -> None:
    rows = [
        {"stamp": 100, "utc": "1980/01/06 00:00:00.000", "roll": 0.0, "lat": 0.0, "lon": 0.0},
        {"stamp": 200, "utc": "-", "roll": 0.0},
        {"stamp": 300, "utc": T0 - np.timedelta64(18, "s"), "roll": 0.0},
        {"stamp": 400, "utc": T0 - np.timedelta64(100, "us"), "roll": 0.0},
        *steady(3),
        {"stamp": 30_500, "utc": T0 + 30 * MS, "roll": 0.0},
    ]
    nav = read_imu_gps(write_a(tmp_path / "imu_gps.txt", rows))
    assert nav.stamps["timestamp"].tolist() == [400, 500, 10_500, 20_500, 30_500]
    assert np.isnan(nav.values["roll"]).tolist() == [True, False, False, False, False]
    assert nav.values["roll"][-1] == 0.0  # level in flight
    assert nav.values["latitude"][0] == -34.53
    # a record that never aligned
    with pytest.warns(PaintWarning, match="never aligned"):
        nav = read_imu_gps(write_a(tmp_path / "imu_gps.txt", steady(3, roll=0.0)))
    assert np.isnan(nav.values["heading"]).all()


@pytest.mark.parametrize(
    ("change", "error", "match"),
    [
        ({"lat": 95.0}, FormatError, "'lat'.*line 4"),
        ({"roll": "x"}, FormatError, "'roll'.*line 4"),
        ({"yaw": "inf"}, FormatError, "'yaw'"),
        ({"stamp": "soon"}, FormatError, "'timestamp'.*line 4"),
        ({"utc": "yesterday"}, FormatError, "line 4"),
        ({"utc": "2021/02/30 00:00:00.0"}, FormatError, "line 4"),
        ({"utc": "2021/Foo/30 00:00:00.0"}, FormatError, "line 4"),
        ({"stamp": 10_500}, TimeError, "line 4"),
        ({"stamp": 7}, TimeError, "line 4"),
        ({"utc": T0 - MS}, TimeError, "line 4.*time-unordered"),
        ({"utc": T0 + np.timedelta64(18, "s")}, TimeError, "time-unordered"),
        ({}, TimeError, "clock-step"),
    ],
)
def test_damaged_rows_are_named(
    tmp_path: Path, change: dict[str, Any], error: type[Exception], match: str
) -> None:
    rows = steady(5)
    rows[2] = {**rows[2], **change}
    if match == "clock-step":  # a receiver that learns its leap seconds
        rows[3:] = [{**row, "utc": row["utc"] + np.timedelta64(18, "s")} for row in rows[3:]]
    path = write_a(tmp_path / "imu_gps.txt", rows)
    index = write_index(tmp_path / "f.txt", [600, 7600])
    expect_errors((error, match, lambda: line_times(Path("raw_0"), 2, Timing(frame_index=index, nav=path))))


def test_a_slow_receiver_repeats_its_time(tmp_path: Path) -> None:
    rows = [{"stamp": 1000 * i, "utc": T0 + (i // 10) * 10 * MS, "alt": float(i)} for i in range(41)]
    timing = Timing(
        frame_index=write_index(tmp_path / "f.txt", [5000, 22_000]),
        nav=write_a(tmp_path / "imu_gps.txt", rows),
        stamp="mid",
    )
    assert (line_times(Path("raw_0"), 2, timing).time - T0).tolist() == [5_000_000, 22_000_000]


@pytest.mark.parametrize(
    ("content", "match"),
    [
        (b"", ""),
        (bytes(range(256)), "binary"),
        (b"\x00\x01\x02\x03" * 100, "binary"),
        (b"\xaa\x44\x12\x1c" * 50, ""),
        (b"Roll\tPitch\tYaw\n1\t2\t3\n", ""),
        (HEADER_A.encode(), ""),
        (HEADER_A.encode() + b"\n1\t2\n", ""),
    ],
)
def test_what_is_no_navigation_record(tmp_path: Path, content: bytes, match: str) -> None:
    path = write_file(tmp_path / "imu_gps.txt", content)
    expect_errors((FormatError, rf"imu_gps\.txt.*{match}", lambda: read_imu_gps(path)))


# --- lines -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("stamp", "shift_ms"), [("start", 2.5), ("mid", 0.0), ("end", -2.5)])
def test_lines_are_placed_at_mid_exposure(tmp_path: Path, stamp: str, shift_ms: float) -> None:
    timing = Timing(
        frame_index=write_index(tmp_path / "f.txt", [15_500, 22_500]),
        nav=write_a(tmp_path / "imu_gps.txt", steady(5)),
        stamp=stamp,
    )
    made = line_times(Path("raw_0"), 2, timing, 0.005)
    np.testing.assert_array_equal((made.time - T0) / MS, np.array([15.0, 22.0]) + shift_ms)
    assert made.time.dtype == "datetime64[ns]"


def test_place_is_interpolated_and_heading_goes_the_short_way(tmp_path: Path) -> None:
    rows = steady(3)
    for row, yaw, lon, alt in zip(
        rows, (350.0, 10.0, 0.0), (179.9, -179.9, -179.8), (10.0, 20.0, 0.0), strict=True
    ):
        row.update(yaw=yaw, lon=lon, alt=alt)
    made = read_imu_gps(write_a(tmp_path / "imu_gps.txt", rows)).at(
        T0 + np.array([0, 5, 7, 15, 20, 21, -1]) * MS
    )
    np.testing.assert_allclose(made["heading"][:5], [350, 0, 4, 5, 0], atol=1e-9)
    np.testing.assert_allclose(np.abs(made["longitude"][:2]), [179.9, 180.0], atol=1e-9)
    np.testing.assert_allclose(made["longitude"][2:5], [-179.96, -179.85, -179.8], atol=1e-9)
    np.testing.assert_allclose(made["altitude"][:5], [10, 15, 17, 10, 0])
    assert all(np.isnan(value[5:]).all() for value in made.values())


def test_gaps_of_the_navigation_have_no_place_but_time(tmp_path: Path) -> None:
    rows = steady(60)
    del rows[20:40]
    timing = Timing(
        frame_index=write_index(tmp_path / "f.txt", [100_500, 300_500, 500_500]),
        nav=write_a(tmp_path / "imu_gps.txt", rows),
        stamp="mid",
    )
    made = line_times(Path("raw_0"), 3, timing)
    assert not np.isnat(made.time).any()
    assert np.isnan(made.pose["latitude"]).tolist() == [False, True, False]
    wide = Timing(**{**timing.__dict__, "max_gap_s": 0.3})
    assert not np.isnan(line_times(Path("raw_0"), 3, wide).pose["latitude"]).any()


def test_lines_outside_the_record_have_no_time(tmp_path: Path) -> None:
    nav = write_a(tmp_path / "imu_gps.txt", steady(3))
    timing = Timing(frame_index=write_index(tmp_path / "f.txt", [10_500, 20_500, 20_501]), nav=nav)
    with pytest.warns(PaintWarning, match="time-uncovered"):
        made = line_times(Path("raw_0"), 3, timing)
    assert np.isnat(made.time).tolist() == [False, False, True]
    away = Timing(frame_index=write_index(tmp_path / "f.txt", [90_500]), nav=nav)
    expect_errors((TimeError, "time-uncovered", lambda: line_times(Path("raw_0"), 1, away)))


def test_without_navigation_lines_follow_the_frame_period_or_the_stamps(tmp_path: Path) -> None:
    timing = Timing(start_time="2021-07-23T14:00:00+02:00", frame_period=0.007)
    made = line_times(Path("raw_100"), 3, timing, 0.005)
    assert (made.frame.tolist(), ((made.time - T0) / MS).tolist()) == ([100, 101, 102], [-2.5, 4.5, 11.5])
    assert made.pose == {}
    index = write_index(tmp_path / "f.txt", [100, 7100, 21_100])
    made = line_times(Path("raw_0"), 3, Timing(frame_index=index, start_time=T0, stamp="mid"))
    assert ((made.time - T0) / MS).tolist() == [0.0, 7.0, 21.0]


def test_stated_rates_that_the_stamps_contradict_are_told(tmp_path: Path) -> None:
    index = write_index(tmp_path / "f.txt", [0, 7000, 14_000])
    timing = Timing(frame_index=index, start_time=T0, frame_period=0.010)
    with pytest.warns(PaintWarning, match="frame-rate-conflict"):
        line_times(Path("raw_0"), 3, timing, 0.005)
    with pytest.warns(PaintWarning, match="exposure-too-long"):
        line_times(Path("raw_0"), 3, Timing(frame_index=index, start_time=T0), 5.0)


@pytest.mark.parametrize(
    ("timing", "match"),
    [
        (Timing(), "time-missing"),
        (Timing(start_time=T0), "argument-missing"),
        (Timing(start_time="2021-07-23T12:00:00", frame_period=0.007), "no zone"),
        (Timing(start_time="noon", frame_period=0.007), "time-unreadable"),
        (Timing(start_time=T0, frame_period=-0.007), "frame_period"),
        (Timing(start_time=T0, frame_period=0.007, stamp="after"), "stamp"),
    ],
)
def test_times_that_are_missing(timing: Timing, match: str) -> None:
    expect_errors((TimeError, match, lambda: line_times(Path("raw_0"), 3, timing)))


def test_two_sources_of_utc_are_one_too_many_and_files_beside_a_cube_are_named(tmp_path: Path) -> None:
    for timing, match in (
        (
            Timing(
                frame_index=write_index(tmp_path / "frameIndex_7.txt", [600], first=7),
                nav=write_a(tmp_path / "imu.txt", steady(3)),
                start_time=T0,
            ),
            "option-conflict",
        ),
        (Timing(), r"frameIndex_7\.txt.*time-missing"),
    ):
        expect_error(TimeError, match, partial(line_times, tmp_path / "raw_7.hdr", 1, timing))


@pytest.mark.parametrize("unit", ["s", "ms", "us", "ns"])
def test_any_datetime_unit_becomes_nanoseconds(unit: str) -> None:
    made = utc_of(np.datetime64("2021-07-23T12:00:00", unit), "start_time")
    assert (made, made.dtype) == (T0, "datetime64[ns]")


def test_zones_are_needed_of_texts_and_datetimes() -> None:
    assert (
        utc_of(datetime.datetime(2021, 7, 23, 7, tzinfo=datetime.timezone(datetime.timedelta(hours=-5))), "t")
        == T0
    )
    for value in (
        datetime.datetime(2021, 7, 23),
        np.datetime64("NaT", "ns"),
        None,
        5,
        "1960-01-01T00:00:00Z",
    ):
        expect_error(TimeError, None, partial(utc_of, value, "t"))


# --- gPS time, leap seconds, corrections, and clocks tied to UTC ------------------------------------------


def gps_clock(text: str) -> np.ndarray[Any, Any]:
    return np.array([text], "datetime64[ns]").astype(np.int64)


@pytest.mark.parametrize(
    ("gps", "utc"),
    [
        ("1980-01-06T00:00:00", "1980-01-06T00:00:00"),
        ("2016-12-31T23:59:59", "2016-12-31T23:59:42"),
        ("2017-01-01T00:00:17.999", "2017-01-01T00:00:00.999"),  # the leap second itself has no other label
        ("2017-01-01T00:00:18", "2017-01-01T00:00:00"),
        ("2024-06-01T12:00:18", "2024-06-01T12:00:00"),
    ],
)
def test_gps_time_to_utc(gps: str, utc: str) -> None:
    assert gps_to_utc(gps_clock(gps)) == gps_clock(utc)


def test_the_table_of_leap_seconds_rises_by_one_and_is_that_of_the_system() -> None:
    assert (list(LEAP_SECONDS.values()), list(LEAP_SECONDS)) == (list(range(19)), sorted(LEAP_SECONDS))
    assert all(day[5:] in ("01-01", "07-01") for day in list(LEAP_SECONDS)[1:])
    found = [path for folder in zoneinfo.TZPATH if (path := Path(folder, "leap-seconds.list")).is_file()]
    if not found:
        pytest.skip("this system has no leap-seconds.list")
    rows = [line.split()[:2] for line in found[0].read_text().splitlines() if line and line[0].isdigit()]
    epoch = datetime.date(1900, 1, 1)
    official = {str(epoch + datetime.timedelta(int(s) // 86400)): int(tai) - 19 for s, tai in rows}
    ours = {day: offset for day, offset in LEAP_SECONDS.items() if offset}
    assert (ours, max(official)) == ({day: official[day] for day in ours}, max(ours))


def test_beyond_the_table_the_user_is_asked() -> None:
    late = gps_clock(f"{LEAP_SECONDS_EXPIRY}T12:00:00")
    with pytest.warns(PaintWarning, match="gps_leap_seconds"):
        assert gps_to_utc(late) == late - 18 * 10**9
    assert gps_to_utc(late, 19) == late - 19 * 10**9
    expect_errors((TimeError, "1980", lambda: gps_to_utc(gps_clock("1970-01-01"))))


def test_stamps_become_utc() -> None:
    stamp = gps_clock("2024-06-01T12:00:00")
    assert to_utc(stamp, 37.25, "utc") == gps_clock("2024-06-01T12:00:37.25")
    assert to_utc(stamp, -0.5, "gps") == gps_clock("2024-06-01T11:59:41.5")


def test_a_clock_is_exact_to_the_nanosecond_and_extrapolates_nothing() -> None:
    stamp = np.array([10**15, 10**15 + 3], np.int64)
    utc = np.array([1_600_000_000_123_456_789, 1_600_000_000_123_456_789 + 3000], np.int64)
    made = Clock(stamp, utc, "x").at(np.array([10**15 - 1, 10**15, 10**15 + 1, 10**15 + 3, 10**15 + 4]))
    assert (made.dtype, np.isnat(made).tolist()) == ("datetime64[ns]", [True, False, False, False, True])
    assert (made[1:4].astype(np.int64) - utc[0]).tolist() == [0, 1000, 3000]


# --- tables of control points: read, or refused as FormatError and nothing else ---------------------------


TABLE = """# crs: EPSG:32617
Name;Flightline;Line;Sample;Easting [m];Northing [m];Height_m
A;raw_0;10.5;3;500000.25;3700000.5;-20
B;raw_1;11;4;500001;3700001;-19.5
"""


def test_a_table(tmp_path: Path) -> None:
    path = write_file(tmp_path / "points.csv", TABLE)
    points = read_control_points(path)
    assert points.attrs == {"source": "points.csv", "crs": "EPSG:32617"}
    assert points.along_track_pixel.values.tolist() == [10.5, 11.0]
    assert (points.east.values.tolist(), points.height.attrs["units"]) == ([500000.25, 500001.0], "m")
    assert points.flightline.values.tolist() == ["raw_0", "raw_1"]
    assert {points[name].dtype for name in points.data_vars} == {np.dtype(np.float64)}


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "0 points"),
        ("line,sample,east,north,height\n", "0 points"),
        ("line,sample,east,north\n1,2,3,4\n", "'height'"),
        ("line,row,sample,east,north,height\n1,1,2,3,4,5\n", "'along_track'.*column-missing"),
        ("line,sample,east,north,height\n1,2,3,4\n", "line 2 without 5 cells"),
        ("line,sample,east,north,height\n1,2,3,nan,5\n", "line 2.*not-finite"),
        ("line,sample,east,north,height\n1,2,x,4,inf\n", "line 2.*value-out-of-range"),
        ("line (1-based),sample,east,north,height\n1,2,3,4,50\n", "pixel-origin"),
        ("# pixels are 1-based\nline,sample,east,north,height\n1,2,3,4,50\n", "pixel-origin"),
        *(
            (
                f"line,sample,east {unit},north,height\n1,2,3,4,50\n",
                f"'east' in '{unit[1:-1]}'.*units-unknown",
            )
            for unit in ("[s]", "[degree]", "[2 m]", "[yd]", "(in)", "[miles]", "(feet of the grid)")
        ),
        ("line [m],sample,east,north,height\n1,2,3,4,50\n", "'along_track' in 'm'.*units-unknown"),
        *(
            (f"# crs: {crs}\nline,sample,east [{unit}],north,height\n1,2,3,4,50\n", match)
            for crs, unit, match in (
                ("EPSG:4326", "m", "'east'.*units-conflict"),
                ("EPSG:2263", "degree", "'east'.*units-unknown"),
                ("EPSG:0", "ft", "'EPSG:0'.*crs-unknown"),
            )
        ),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, text: str, told: str) -> None:
    path = tmp_path / "points.csv"
    expect_errors((FormatError, "file-unreadable", lambda: read_control_points(path)))
    path.write_text(text)
    expect_errors((FormatError, told, lambda: read_control_points(path)))


@pytest.mark.parametrize(
    ("unit", "metres"),
    [
        ("[ft]", 0.3048),
        ("(feet)", 0.3048),
        ("[km]", 1000.0),
        ("(FT)", 0.3048),
        ("(M)", 1.0),
        ("[KM]", 1e3),
        ("[US survey feet]", 1200 / 3937),
        ("[ftUS]", 1200 / 3937),
        ("(us-ft)", 1200 / 3937),
        ("(UTM 17N)", 1.0),
        ("(grid) [ft]", 0.3048),
        ("(E)", 1.0),
        ("(m above the grid)", 1.0),
        ("(in UTM)", 1.0),
        ("(8/h)", 1.0),
    ],
)
def test_a_unit_in_a_heading_is_converted(tmp_path: Path, unit: str, metres: float) -> None:
    path = write_file(
        tmp_path / "points.csv",
        f"line (0-based);sample [px];east {unit};north_m;height (ft, ellipsoidal)\n1;2;3;4;50\n",
    )
    points = read_control_points(path)
    assert (points.east.item(), points.north.item()) == (pytest.approx(3 * metres, rel=1e-11), 4.0)
    assert points.height.item() == 50 * 0.3048


@pytest.mark.parametrize(
    ("crs", "unit", "east"),
    [
        ("EPSG:2263", "ft", 3.0), ("EPSG:2263", "US survey feet", 3.0), ("EPSG:2263", "m", 3 * 3937 / 1200),
        ("EPSG:2263", "UTM", 3.0), ("EPSG:32617", "ft", 3 * 0.3048), ("EPSG:32617", "m", 3.0),
        ("EPSG:2222", "ft", 3.0), ("EPSG:4326", "degrees", 3.0),
    ],
)  # fmt: skip
def test_east_and_north_come_in_the_unit_of_their_map(
    tmp_path: Path, crs: str, unit: str, east: float
) -> None:
    path = write_file(
        tmp_path / "points.csv",
        f"# crs: {crs}\nline,sample,east [{unit}],north [{unit}],height [ft]\n1,2,3,3,50\n",
    )
    points = read_control_points(path)
    assert points.east.item() == points.north.item() == pytest.approx(east, rel=1e-11)
    assert points.height.item() == 50 * 0.3048
    assert (points.east.attrs["units"] == "m") == (crs == "EPSG:32617" or unit == "UTM")
