"""Clocks of SVC files: stamps of any locale, and UTC by the GPS."""

import datetime as dt

import numpy as np
import pytest
from hypothesis import given, strategies as st
from support.svc_texts import svc_text

from hyperpaint.base.errors import PaintWarning
from hyperpaint.io.spectrometers.svc import open_svc, orders_of, read_gps_time, read_stamp, utc_of

MARCH = dt.datetime(2024, 3, 5, 17, 8, 9)


@pytest.mark.parametrize(
    "text",
    [
        "05.03.2024 17:08:09", "5.3.24 17:08:09", "2024-03-05 17:08:09", "2024-03-05T17:08:09",
        "2024/03/05 5:08:09 PM", "05-Mar-24 17.08.09", "05-m\u00e4r-24 17.08.09", "5-mar-2024 17.08.09",
        "05-03-2024 17:08:09", "2024/3/5 17:08:09.000",
    ],
)  # fmt: skip
def test_stamps_that_leave_no_doubt(text) -> None:
    assert read_stamp(text).read(None) == MARCH


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("7/29/2017 1:54:23 AM", dt.datetime(2017, 7, 29, 1, 54, 23)),
        ("16/10/2024 10:47:58", dt.datetime(2024, 10, 16, 10, 47, 58)),
        ("7/18/10 9:47:09 AM", dt.datetime(2010, 7, 18, 9, 47, 9)),
        ("4/4/2024 12:00:00 AM", dt.datetime(2024, 4, 4)),
        ("4/4/2024 12:00:00 p.m.", dt.datetime(2024, 4, 4, 12)),
        ("11-lug-15 13.08.32", dt.datetime(2015, 7, 11, 13, 8, 32)),
        ("11-juil.-15 13.08.32", dt.datetime(2015, 7, 11, 13, 8, 32)),
        ("11-\u00b2\u00b2\u00b2-15 13.08.32", None),
        ("11 juillet 2015", None),
    ],
)
def test_stamps_with_one_reading(text, expected) -> None:
    stamp = read_stamp(text)
    assert (stamp and stamp.read(None)) == expected


@pytest.mark.parametrize(
    "text",
    [
        "", "now", "32/13/2024 10:00:00", "2024-02-30 10:00:00", "4/4/2024 13:00:00 PM", "4/4/2024 25:00:00",
        "4/4/0 10:00:00", "0000-00-00 00:00:00", "\u0664/\u0664/2024 10:00:00x", "1/2/2024" + " " * 200,
    ],
)  # fmt: skip
def test_what_is_no_stamp(text) -> None:
    assert read_stamp(text) is None


@given(moment=st.datetimes(dt.datetime(1995, 1, 1), dt.datetime(2090, 1, 1)))
def test_every_date_is_read_in_either_order(moment) -> None:
    moment = moment.replace(microsecond=0)
    european = read_stamp(f"{moment:%d/%m/%Y %H:%M:%S}")
    american = read_stamp(f"{moment:%m/%d/%Y %I:%M:%S %p}")
    assert european.read(True) == american.read(False) == moment
    is_ambiguous = moment.day <= 12 and moment.day != moment.month
    assert european.read(None) == american.read(None) == (None if is_ambiguous else moment)


def test_other_files_of_an_instrument_settle_the_order() -> None:
    def orders(*dates):
        return orders_of((name, read_stamp(f"{date} 10:00:00")) for name, date in dates)

    assert orders(("a", "5/6/2024"), ("a", "5/16/2024"), ("b", "5/6/2024")) == {"a": False}
    assert orders(("a", "16/5/2024"), ("b", "5/16/2024")) == {"a": True, "b": False}
    assert orders(("a", "16/5/2024"), ("a", "5/16/2024")) == {}
    assert orders(("a", "16.05.2024")) == {}  # another way to write, which tells nothing about slashes


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("090724.786", dt.timedelta(hours=9, minutes=7, seconds=24, milliseconds=786)),
        ("235960.000", dt.timedelta(days=1)),
        ("90724,5", dt.timedelta(hours=9, minutes=7, seconds=24.5)),
        ("", None),
    ],
)
def test_gps_times(text, expected) -> None:
    assert read_gps_time(text) == expected


@pytest.mark.parametrize("text", ["noon", "2460", "240000", "106000", "100061", "-10000", "1e5", "9" * 500])
def test_what_is_no_gps_time(text) -> None:
    with pytest.raises(ValueError, match="time of day, HHMMSS"):
        read_gps_time(text)


@given(
    moment=st.datetimes(dt.datetime(1995, 1, 2), dt.datetime(2090, 1, 1)),
    zone=st.integers(-48, 56),
    wrong=st.integers(-1800, 1800),
)
def test_gps_time_finds_its_date(moment, zone, wrong) -> None:
    # Anywhere on earth, with a local clock that is up to half an hour wrong
    hours = zone / 4.0
    longitude = max(-180.0, min(180.0, 15.0 * hours))
    local = moment + dt.timedelta(hours=hours, seconds=wrong)
    gps = moment - dt.datetime.combine(moment.date(), dt.time())
    assert (utc_of(local, gps, longitude, None), utc_of(local, gps, float("nan"), hours)) == (moment, moment)
    assert utc_of(local, None, longitude, hours) == local - dt.timedelta(hours=hours)
    assert utc_of(local, None, longitude, None) is None


def test_times_of_several_files(tmp_path) -> None:
    blank = {"gpstime": " , ", "latitude": " , ", "longitude": " , "}
    for name, date in {"a": "5/6/2025", "b": "5/27/2025"}.items():
        (tmp_path / f"{name}.sig").write_text(svc_text(time=f"{date} 9:39:32 AM, {date} 9:42:59 AM", **blank))
    with pytest.warns(PaintWarning, match="a.sig.*date-ambiguous"):
        assert np.isnat(open_svc(tmp_path / "a.sig", utc_offset_h=-5)["time"].values).all()
    found = open_svc(tmp_path, utc_offset_h=-5)["time"].values
    expected = np.array(["2025-05-06T14:42:59", "2025-05-27T14:42:59"], "datetime64[ns]")
    np.testing.assert_array_equal(found, expected)
    found = open_svc(tmp_path, utc_offset_h=-5, dayfirst=True)["time"].values
    assert found[0] == np.datetime64("2025-06-05T14:42:59")
    with pytest.warns(PaintWarning, match=r"a\.sig, b\.sig \[zone-"):
        assert np.isnat(open_svc(tmp_path)["time"].values).all()


def test_gps_wins_over_a_zone_that_contradicts_it(tmp_path) -> None:
    path = tmp_path / "a.sig"
    path.write_text(svc_text())
    with pytest.warns(PaintWarning, match="utc-offset-conflict"):
        found = open_svc(path, utc_offset_h=-7)
    assert found["time"].values[0] == np.datetime64("2025-05-27T07:42:50.357")
    assert open_svc(path, utc_offset_h=2)["time"].values[0] == found["time"].values[0]


@pytest.mark.parametrize("time", [None, "", "long ago, yesterday", "27.05.2025 09:39:32"])
def test_times_that_are_missing(tmp_path, time) -> None:
    path = tmp_path / "a.sig"
    path.write_text(svc_text(time=time))
    with pytest.warns(PaintWarning, match="time-unreadable"):
        found = open_svc(path)
    assert np.isnat(found["reference_time"].values[0])
    # one stamp alone is the target's
    assert np.isnat(found["time"].values[0]) == (time != "27.05.2025 09:39:32")
