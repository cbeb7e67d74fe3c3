"""Navigation records, clocks and leap seconds, and their join to the lines of a cube."""

import datetime
import zoneinfo
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.refusals import expect_errors

from hyperpaint.base.errors import FormatError, PaintWarning, TimeError
from hyperpaint.io.flightline.timing import Timing, line_times, utc_of
from hyperpaint.io.navigation.clocks import (
    LEAP_SECONDS,
    LEAP_SECONDS_EXPIRY,
    Clock,
    ClockCorrection,
    gps_to_utc,
)
from hyperpaint.io.navigation.control_points import read_control_points
from hyperpaint.io.navigation.navigation_records import read_gps_time, read_imu_gps

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
    assert (nav.utc.astype("datetime64[ns]").tolist(), nav.stamps["timestamp"].tolist()) == (
        [(T0 + i * 10 * MS).astype(int) for i in range(3)],
        [500, 10_500, 20_500],
    )
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
    path = tmp_path / "imu_gps.txt"
    path.write_text("\n".join([HEADER_D, *rows]))
    timing = Timing(
        frame_index=write_index(tmp_path / "f.txt", [1_005_000, 1_015_000]), nav=path, stamp="mid"
    )
    made = line_times(Path("raw_0"), 2, timing)
    assert (made.time - T0).tolist() == [5_000_000, 15_000_000]
    assert clock.lower() in made.source


def test_variant_b_takes_utc_from_gps_time(tmp_path: Path) -> None:
    nav = tmp_path / "imu_gps.txt"
    nav.write_text(
        "Roll\tPitch\tYaw\tLat\tLon\tAlt\tTime\n"
        + "".join([f"1\t2\t{10 * i}\t-34\t138\t{60 + i}\t23:59:59 {990_000 + 2000 * i}\n" for i in range(5)])
    )
    gps_time = tmp_path / "gps_time.txt"
    gps_time.write_text(
        "PC\tPOS\n23:59:58 0\t2021/07/23 21:59:59.250000\n00:00:01 0\t2021/07/23 22:00:02.250000\n"
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
    assert (nav.stamps["timestamp"].tolist(), np.isnan(nav.values["roll"]).tolist()) == (
        [400, 500, 10_500, 20_500, 30_500],
        [True, False, False, False, False],
    )
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
    path = tmp_path / "imu_gps.txt"
    path.write_bytes(content)
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
    assert (made.frame.tolist(), ((made.time - T0) / MS).tolist(), made.pose) == (
        [100, 101, 102],
        [-2.5, 4.5, 11.5],
        {},
    )
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
        with pytest.raises(TimeError, match=match):
            line_times(tmp_path / "raw_7.hdr", 1, timing)


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
        with pytest.raises(TimeError):
            utc_of(value, "t")


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


def test_corrections_are_checked() -> None:
    stamp = gps_clock("2024-06-01T12:00:00")
    assert (ClockCorrection(37.25).apply(stamp), ClockCorrection(-0.5, "gps").apply(stamp)) == (
        gps_clock("2024-06-01T12:00:37.25"),
        gps_clock("2024-06-01T11:59:41.5"),
    )
    expect_errors((TimeError, "nan", lambda: ClockCorrection(float("nan"))))
    with pytest.raises(TimeError, match="local"):
        ClockCorrection(0.0, "local")  # type: ignore[arg-type]


def test_a_clock_is_exact_to_the_nanosecond_and_extrapolates_nothing() -> None:
    stamp = np.array([10**15, 10**15 + 3], np.int64)
    utc = np.array([1_600_000_000_123_456_789, 1_600_000_000_123_456_789 + 3000], np.int64)
    made = Clock(stamp, utc, "x").at(np.array([10**15 - 1, 10**15, 10**15 + 1, 10**15 + 3, 10**15 + 4]))
    assert (made.dtype, np.isnat(made).tolist(), (made[1:4].astype(np.int64) - utc[0]).tolist()) == (
        "datetime64[ns]",
        [True, False, False, False, True],
        [0, 1000, 3000],
    )


# --- tables of control points: read, or refused as FormatError and nothing else ---------------------------


TABLE = """# crs: EPSG:32617
Name;Flightline;Line;Sample;Easting [m];Northing [m];Height_m
A;raw_0;10.5;3;500000.25;3700000.5;-20
B;raw_1;11;4;500001;3700001;-19.5
"""


def test_a_table(tmp_path: Path) -> None:
    path = tmp_path / "points.csv"
    path.write_text(TABLE)
    points = read_control_points(path)
    assert (
        points.attrs,
        points.along_track_pixel.values.tolist(),
        points.east.values.tolist(),
        points.height.attrs["units"],
    ) == ({"source": "points.csv", "crs": "EPSG:32617"}, [10.5, 11.0], [500000.25, 500001.0], "m")
    assert (points.flightline.values.tolist(), {points[name].dtype for name in points.data_vars}) == (
        ["raw_0", "raw_1"],
        {np.dtype(np.float64)},
    )


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
    if "# crs" in text:
        pytest.importorskip("pyproj")
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
    path = tmp_path / "points.csv"
    path.write_text(f"line (0-based);sample [px];east {unit};north_m;height (ft, ellipsoidal)\n1;2;3;4;50\n")
    points = read_control_points(path)
    assert (points.east.item(), points.north.item(), points.height.item()) == (
        pytest.approx(3 * metres, rel=1e-11),
        4.0,
        50 * 0.3048,
    )


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
    pytest.importorskip("pyproj")
    path = tmp_path / "points.csv"
    path.write_text(f"# crs: {crs}\nline,sample,east [{unit}],north [{unit}],height [ft]\n1,2,3,3,50\n")
    points = read_control_points(path)
    assert points.east.item() == points.north.item() == pytest.approx(east, rel=1e-11)
    assert (points.height.item(), points.east.attrs["units"] == "m") == (
        50 * 0.3048,
        crs == "EPSG:32617" or unit == "UTM",
    )
