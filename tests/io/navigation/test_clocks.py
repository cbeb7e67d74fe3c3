"""GPS time, leap seconds, corrections, and clocks tied to UTC."""

import datetime
import zoneinfo
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hyperpaint.base.errors import PaintWarning, TimeError
from hyperpaint.io.navigation.clocks import (
    LEAP_SECONDS,
    LEAP_SECONDS_EXPIRY,
    Clock,
    ClockCorrection,
    gps_to_utc,
)


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


def test_the_table_of_leap_seconds_rises_by_one() -> None:
    assert (list(LEAP_SECONDS.values()), list(LEAP_SECONDS)) == (list(range(19)), sorted(LEAP_SECONDS))
    assert all(day[5:] in ("01-01", "07-01") for day in list(LEAP_SECONDS)[1:])


def test_the_table_of_leap_seconds_is_that_of_the_system() -> None:
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
    with pytest.raises(TimeError, match="1980"):
        gps_to_utc(gps_clock("1970-01-01"))


def test_corrections_are_checked() -> None:
    stamp = gps_clock("2024-06-01T12:00:00")
    assert ClockCorrection(37.25).apply(stamp) == gps_clock("2024-06-01T12:00:37.25")
    assert ClockCorrection(-0.5, "gps").apply(stamp) == gps_clock("2024-06-01T11:59:41.5")
    with pytest.raises(TimeError, match="nan"):
        ClockCorrection(float("nan"))
    with pytest.raises(TimeError, match="local"):
        ClockCorrection(0.0, "local")  # type: ignore[arg-type]


def test_a_clock_is_exact_to_the_nanosecond_and_extrapolates_nothing() -> None:
    stamp = np.array([10**15, 10**15 + 3], np.int64)
    utc = np.array([1_600_000_000_123_456_789, 1_600_000_000_123_456_789 + 3000], np.int64)
    made = Clock(stamp, utc, "x").at(np.array([10**15 - 1, 10**15, 10**15 + 1, 10**15 + 3, 10**15 + 4]))
    assert (made.dtype, np.isnat(made).tolist()) == ("datetime64[ns]", [True, False, False, False, True])
    assert (made[1:4].astype(np.int64) - utc[0]).tolist() == [0, 1000, 3000]
