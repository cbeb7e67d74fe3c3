"""Navigation files of every kind: known values, clocks, conventions, and what is refused."""

import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from support.navigation_files import (
    CSV_HEADER,
    CSV_ROWS,
    GPS_EPOCH,
    POSE,
    seconds_since,
    write_csv,
    write_sbet,
)
from support.refusals import expect_refusals, refusal

import hyperpaint as hp
from hyperpaint.base.attitude_conventions import Convention
from hyperpaint.base.errors import FormatError, PaintWarning, SchemaError, TimeError
from hyperpaint.cli.info_command import describe_path

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
    assert flight.platform_heading.values.tolist() == [3.0, 3.1]
    assert flight["roll"].attrs["units"] == "radian"
    assert np.isnan(flight.pitch.values[1])
    found = Convention.from_attrs(flight.attrs)
    assert found == Convention(angle_unit="radian")
    assert found.stamp_reference is None
    assert found.column_order is None
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
        ({"week": 2158.0}, "week 2158.0"),
        ({"date": "2021-02-30"}, "date '2021-02-30'"),
        ({"leap_seconds": 1.5}, "leap_seconds 1.5"),
        ({"time_scale": "tai"}, "time_scale='tai'"),
        ({"clock_offset_s": float("nan")}, "clock_offset_s nan"),
    ],
)
def test_clocks_that_cannot_be_are_refused(tmp_path: Path, arguments: dict[str, Any], match: str) -> None:
    with pytest.raises(TimeError, match=match):
        hp.open_navigation(write_sbet(tmp_path / "flight.sbet", [1.0]), **arguments)


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
    ],
)
def test_sbet_with_impossible_values_is_refused(tmp_path: Path, columns: dict[str, Any], match: str) -> None:
    with pytest.raises(FormatError, match=match):
        hp.open_navigation(write_sbet(tmp_path / "flight.sbet", [1.0, 2.0], **columns), week=2158)


def test_sbet_of_part_records_or_backward_times_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "part.sbet"
    for size in (0, 1, 135, 137, 271):
        path.write_bytes(bytes(size))
        with pytest.raises(FormatError, match=f"{size} bytes.*file-truncated"):
            hp.open_navigation(path, week=2158)
    with pytest.raises(TimeError, match=r"record 3.*time-unordered"):
        hp.open_navigation(write_sbet(tmp_path / "flight.sbet", [5.0, 6.0, 5.5]), week=2158)


def test_all_problems_of_an_sbet_are_told_at_once(tmp_path: Path) -> None:
    path = write_sbet(tmp_path / "flight.sbet", [-1.0, 2.0], latitude=3.0, heading=50.0)
    with pytest.raises(FormatError) as caught:
        hp.open_navigation(path, week=2158)
    assert all(word in str(caught.value) for word in ("time is -1", "latitude", "heading"))


@settings(max_examples=40)
@given(st.data())
def test_sbet_angles_and_times_come_back(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    count = data.draw(st.integers(1, 20))
    angle = st.floats(-np.pi, np.pi)
    columns = {name: data.draw(st.lists(angle, min_size=count, max_size=count)) for name in POSE[3:]}
    ticks = data.draw(st.lists(st.integers(0, 604_800_000_000), min_size=count, max_size=count, unique=True))
    micros = np.sort(np.array(ticks))
    path = write_sbet(tmp_path_factory.mktemp("sbet") / "flight.sbet", micros / 1e6, **columns)
    flight = hp.open_navigation(path, week=2158, time_scale="utc")
    for name, values in columns.items():
        assert flight[name].values.tolist() == values  # no wrap, no turn
    week = (GPS_EPOCH + np.timedelta64(2158 * 7, "D")).astype(np.int64)
    np.testing.assert_array_equal(flight.navigation_time.values.astype(np.int64) - week, micros * 1000)


# --- Resonon -----------------------------------------------------------------------------------------------


def write_lcf(path: Path, times: list[float], *, columns: int = 9) -> Path:
    rows = [[time, 0.1, -0.05, 6.28, -77.6, 43.1, 150.0, 0, 0][:columns] for time in times]
    path.write_text("\n".join("\t".join(map(repr, row)) for row in rows) + "\r\n")
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
    with pytest.raises(TimeError, match="gps-week-conflict"):
        hp.open_navigation(tmp_path / "line.lcf", week=2158)
    path = write_lcf(tmp_path / "line.lcf", [5.0, 6.0], columns=7)
    with pytest.raises(TimeError, match="gps-week-missing"):
        hp.open_navigation(path)
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
    path = tmp_path / "line.lcf"
    path.write_text(text)
    with pytest.raises(FormatError, match=match) as caught:
        hp.open_navigation(path, leap_seconds=18)
    assert len(caught.value.problems) <= 1  # no cell is listed twice


# --- csv ---------------------------------------------------------------------------------------------------


def test_csv_keeps_what_its_comments_declare(tmp_path: Path) -> None:
    path = write_csv(
        tmp_path / "flight.csv",
        *("# from: somewhere", "# roll_positive: right_wing_up", "# column_order: right_to_left"),
        *("# stamp_reference: start", CSV_HEADER, *CSV_ROWS),
    )
    flight = hp.open_navigation(path)
    found = Convention.from_attrs(flight.attrs)
    assert found == Convention(
        roll_positive="right_wing_up", column_order="right_to_left", stamp_reference="start"
    )
    assert "pitch_positive" in flight.attrs["assumed"]
    assert "roll_positive" not in flight.attrs["assumed"]
    assert flight.heading.values.tolist() == [359.5, 0.5]
    assert seconds_since(flight.navigation_time.values, "2024-06-01T12:00:00") == [0.0, 0.25]
    assert flight.attrs["time_scale"] == "utc"


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_csv_units_are_converted_but_angles_stay(tmp_path: Path, separator: str) -> None:
    header = [
        "unix_time [ms]",
        "lat_rad",
        "lon (deg)",
        "alt [ft]",
        "roll_rad",
        "pitch (rad)",
        "yaw [rad]",
        "note",
    ]
    row = ["1717243200250", "0.75", "-77.6", "100", "0.1", "", "-3", "x"]
    flight = hp.open_navigation(write_csv(tmp_path / "f.csv", separator.join(header), separator.join(row)))
    values = [float(flight[name].values[0]) for name in POSE]
    np.testing.assert_allclose(values, [np.degrees(0.75), -77.6, 30.48, 0.1, np.nan, -3.0], rtol=1e-12)
    assert (flight["roll"].attrs["units"], flight.attrs["convention_angle_unit"]) == ("radian", "radian")
    assert str(flight.navigation_time.values[0]) == "2024-06-01T12:00:00.250000000"


@pytest.mark.parametrize(
    ("column", "cell", "expected"),
    [
        ("time", "2024-06-01T14:00:00+02:00", "2024-06-01T12:00:00"),
        ("utc", "2024/06/01 12:00:00", "2024-06-01T12:00:00"),
        ("gps_time", "2024-06-01 12:00:18", "2024-06-01T12:00:00"),
        ("gps_time [s]", "1401278418", "2024-06-01T12:00:00"),
        ("time_of_week [s]", "561618", "2024-06-01T12:00:00"),
        ("tow_us", "561618000000", "2024-06-01T12:00:00"),
    ],
)
def test_csv_clocks(tmp_path: Path, column: str, cell: str, expected: str) -> None:
    head = CSV_HEADER.replace("time", column, 1)
    path = write_csv(tmp_path / "f.csv", "# gps_week: 2316", head, f"{cell},43,-77,150,0,0,0")
    assert hp.open_navigation(path).navigation_time.values[0] == np.datetime64(expected, "ns")


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
        ([CSV_HEADER, CSV_ROWS[0].replace("06-01", "02-30")], "time-unreadable"),
        (["# roll_positive: up", CSV_HEADER, CSV_ROWS[0]], "roll_positive='up'"),
        (["# angle_unit: radian", CSV_HEADER, CSV_ROWS[0]], "'angle_unit' is 'radian'"),
        (["# gps_week: soon", CSV_HEADER, CSV_ROWS[0]], "'gps_week' is 'soon'"),
        (["# declination: west", CSV_HEADER, CSV_ROWS[0]], "'declination' is 'west'"),
        ([CSV_HEADER.replace("time", "unix_time"), "12,43,-77,150,0,0,0"], "units-missing"),
        ([CSV_HEADER.replace("time", "unix_time [s]"), "-12,43,-77,150,0,0,0"], "is negative"),
    ],
)
def test_csv_that_is_none_is_refused(tmp_path: Path, lines: list[str], match: str) -> None:
    with pytest.raises(FormatError, match=match):
        hp.open_navigation(write_csv(tmp_path / "flight.csv", *lines))


def test_all_problems_of_a_csv_are_told_at_once(tmp_path: Path) -> None:
    header = CSV_HEADER.replace("roll [degree]", "roll").replace("pitch [degree]", "tilt")
    with pytest.raises(FormatError) as caught:
        hp.open_navigation(write_csv(tmp_path / "f.csv", "# time_scale: tai", header, CSV_ROWS[0]))
    assert all(
        word in str(caught.value) for word in ("time_scale", "'roll' has no unit", "no column of pitch")
    )


def test_rows_without_a_time_are_counted(tmp_path: Path) -> None:
    flight = hp.open_navigation(write_csv(tmp_path / "f.csv", CSV_HEADER, ",,,,,,", *CSV_ROWS))
    assert (flight.sizes["navigation_time"], flight.attrs["rows_without_time"]) == (2, 1)


# --- Headwall, AVIRIS, several files -----------------------------------------------------------------------


def write_imu(path: Path, **changes: str) -> Path:
    header = "Roll\tPitch\tYaw\tLat\tLon\tAlt\tTimestamp\tGps_UTC_Date&Time"
    rows = [f"1.5\t-2\t359\t43\t-77\t150\t{500 + i}\t2021/07/23 12:00:0{i}.500" for i in range(3)]
    path.write_text("\n".join([header, *rows]) + "\n")
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
    gps = hp.open_navigation(tmp_path / "imu_gps.txt", time_scale="gps")
    assert seconds_since(gps.navigation_time.values, "2021-07-23T12:00:00")[0] == 0.5 - 18


def test_headwall_with_the_clock_of_the_computer_alone(tmp_path: Path) -> None:
    path = tmp_path / "imu_gps.txt"
    rows = [f"1\t2\t3\t43\t-77\t150\t12:00:0{i} 250000\n" for i in range(3)]
    path.write_text("Roll\tPitch\tYaw\tLat\tLon\tAlt\tTime\n" + "".join(rows))
    with pytest.raises(TimeError, match="date-missing"):
        hp.open_navigation(path)
    flight = hp.open_navigation(path, date="2021-07-23", clock_offset_s=18_000.0)
    assert seconds_since(flight.navigation_time.values, "2021-07-23T17:00:00") == [0.25, 1.25, 2.25]
    clock = tmp_path / "gps_time.txt"
    clock.write_text("12:00:00 0\t2021/07/23 16:00:00.5\n12:00:05 0\t2021/07/23 16:00:05.5\n")
    tied = hp.open_navigation(path, gps_time=clock)
    assert seconds_since(tied.navigation_time.values, "2021-07-23T16:00:00") == [0.75, 1.75, 2.75]


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
    with pytest.raises(FormatError) as caught:
        hp.open_navigation(
            write_eph(tmp_path, **{"lines": "200000000", "band names": "{a, b, c, d, e, f, g}"})
        )
    assert "band names" in str(caught.value)
    assert "expected 11200000000" in str(caught.value)


def test_a_name_that_contradicts_the_stamps_says_no_week(tmp_path: Path) -> None:
    path = write_eph(tmp_path)
    for name in (path, Path(f"{path}.hdr")):
        name.rename(tmp_path / name.name.replace("t202244", "t052244"))
    with pytest.raises(TimeError, match="gps-week-missing"):
        hp.open_navigation(tmp_path / "ang20170323t052244_eph_att")


def test_several_files_follow_one_another(tmp_path: Path) -> None:
    first = write_sbet(tmp_path / "a.sbet", [1.0, 2.0], roll=0.1)
    flight = hp.open_navigation([write_sbet(tmp_path / "b.sbet", [3.0], roll=0.2), first], week=2158)
    assert (flight["roll"].values.tolist(), flight.attrs["source"]) == ([0.1, 0.1, 0.2], "a.sbet, b.sbet")
    overlapping = write_sbet(tmp_path / "c.sbet", [1.5])
    with refusal(TimeError, "time-overlap", "a.sbet", "c.sbet"):
        hp.open_navigation([first, overlapping], week=2158)
    table = write_csv(tmp_path / "a.csv", CSV_HEADER, *CSV_ROWS)
    with pytest.raises(FormatError, match="differ"):
        hp.open_navigation([table, write_imu(tmp_path / "imu_gps.txt")])
    with pytest.raises(FormatError, match="empty-input"):
        hp.open_navigation([])


def test_every_bad_file_is_named(tmp_path: Path) -> None:
    bad = [tmp_path / "a.sbet", tmp_path / "b.sbet"]
    for path in bad:
        path.write_bytes(bytes(137))
    with pytest.raises(FormatError) as caught:
        hp.open_navigation([*bad, write_sbet(tmp_path / "c.sbet", [1.0])], week=2158)
    assert all(path.name in str(caught.value) for path in bad)


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
            with refusal(SchemaError, code):
                hp.open_navigation(source, convention=convention)


def test_files_of_no_known_kind_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "flight.bin"
    path.write_bytes(bytes(272))
    with pytest.raises(FormatError, match="format-unknown"):
        hp.open_navigation(path)
    assert hp.open_navigation(path, format="sbet", week=0, leap_seconds=0).sizes["navigation_time"] == 2
    with pytest.raises(SchemaError, match="format='kml'"):
        hp.open_navigation(path, format="kml")  # type: ignore[arg-type]
    with pytest.raises(FormatError, match="file-unreadable"):
        hp.open_navigation(tmp_path / "nothing.sbet", week=1)


def test_info_tells_what_navigation_is(tmp_path: Path) -> None:
    text = describe_path(write_sbet(tmp_path / "flight.sbet", [5.0, 6.0], altitude=150.0))
    assert "Applanix SBET" in text
    assert "5 to 6 s of a GPS week: pass week= or date=" in text
    text = describe_path(write_lcf(tmp_path / "line.lcf", [1.3e9]))
    assert "right wing up" in text
    assert "2021-03-17T07:06:40.000" in text
    text = describe_path(write_csv(tmp_path / "flight.csv", CSV_HEADER, *CSV_ROWS))
    assert "2024-06-01T12:00:00.000 to 2024-06-01T12:00:00.250 UTC" in text
    text = describe_path(write_eph(tmp_path))
    assert "AVIRIS-NG eph_att" in text
    assert "GPS week 1941" in text
