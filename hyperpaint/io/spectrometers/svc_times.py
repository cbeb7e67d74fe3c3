"""Time stamps of SVC files: local clocks in the order of any locale, and UTC by the GPS.

The stamps follow the PC that saved the file: ``7/29/2017 1:54:23 AM``, ``16/10/2024 10:47:58``, ``27.05.2025
09:39:32``, ``11-lug-15 13.08.32``. Between slashes, day and month may stand in either order. GPS gives the
time of day in UTC, without a date.
"""

from __future__ import annotations

import datetime as dt
import math
import re
from collections.abc import Iterable
from dataclasses import dataclass

__all__ = ["LocalStamp", "orders_of", "read_gps_time", "read_stamp", "utc_of"]

_STAMP = re.compile(
    r"(\d{1,4})([/.-])(\d{1,2}|[^\W\d_]{3,9})\.?\2(\d{1,4})"
    r"(?:\s+|T)(\d{1,2})[:.](\d{2})(?:[:.](\d{2}))?(?:[.,]\d{1,9})?"
    r"\s*(?:([AP])\.?\s?M\.?)?",
    re.IGNORECASE,
)
# first letters of the months in English, German, Italian, French, Spanish and Portuguese
_MONTHS = (
    ("jan", "gen", "ene", "jän"),
    ("feb", "fev", "fév"),
    ("mar", "mär", "mrz"),
    ("apr", "avr", "abr"),
    ("may", "mai", "mag"),
    ("jun", "giu", "juin"),
    ("jul", "lug", "juil"),
    ("aug", "ago", "aoû", "aou"),
    ("sep", "set"),
    ("oct", "okt", "ott", "out"),
    ("nov",),
    ("dec", "dez", "dic", "déc"),
)
_GPS_TIME = re.compile(r"(\d{1,2})(\d\d)(\d\d)(?:[.,](\d{1,6})\d{0,3})?", re.ASCII)
_DAY = dt.timedelta(days=1)


@dataclass(frozen=True)
class LocalStamp:
    """A date and time as a local clock showed it, without a zone.

    Attributes
    ----------
    day_first, month_first
        What it means in either order; None where that is no date.
    slashes
        False where the way it is written settles the order: only between slashes do both occur.
    """

    day_first: dt.datetime | None
    month_first: dt.datetime | None
    slashes: bool

    @property
    def order(self) -> bool | None:
        """True for day first, False for month first, None where it may be either."""
        if self.day_first == self.month_first:
            return None
        if self.day_first is None or self.month_first is None:
            return self.month_first is None
        return None if self.slashes else True

    @property
    def ambiguous(self) -> bool:
        """Whether the two orders give two dates, and nothing settles which it is."""
        return self.order is None and self.day_first != self.month_first

    def read(self, dayfirst: bool | None) -> dt.datetime | None:
        """Return the date in an order that is asked for, the only one there is, or None."""
        if self.day_first is None or self.month_first is None:
            return self.day_first or self.month_first
        order = self.order if dayfirst is None else dayfirst
        if order is None:
            return None if self.ambiguous else self.day_first
        return self.day_first if order else self.month_first


def read_stamp(text: str) -> LocalStamp | None:
    """Return what a time stamp means; None where it is none.

    Examples
    --------
    >>> read_stamp("02/08/2024 10:07:36AM").ambiguous
    True
    >>> read_stamp("16/10/2024 10:47:58").read(None), read_stamp("11-lug-15 13.08.32").read(None)
    (datetime.datetime(2024, 10, 16, 10, 47, 58), datetime.datetime(2015, 7, 11, 13, 8, 32))
    """
    match = _STAMP.fullmatch(text.strip()) if len(text) <= 80 else None
    if match is None:
        return None
    first, separator, second, third, hour, minute, seconds, half = match.groups()
    year = first if len(first) == 4 else third
    if len(year) not in (2, 4) or (half is not None and not 1 <= int(hour) <= 12):
        return None
    hours = int(hour) if half is None else int(hour) % 12 + 12 * (half.upper() == "P")
    clock = (hours, int(minute), int(seconds or 0))
    month = _month(second)
    if len(first) == 4 or month is None or not second.isdecimal():
        day = third if len(first) == 4 else first
        only = None if month is None else _date(int(year), month, int(day), clock)
        return None if only is None else LocalStamp(only, only, slashes=False)
    day_first = _date(int(year), month, int(first), clock)
    month_first = _date(int(year), int(first), month, clock)
    if day_first is None and month_first is None:
        return None
    return LocalStamp(day_first, month_first, slashes=separator == "/")


def _month(text: str) -> int | None:
    """Return the number of a month; of a number, that number, which may be a day after all."""
    if text.isdecimal():
        return int(text)
    word = text.lower()
    return next((i for i, starts in enumerate(_MONTHS, 1) if word.startswith(starts)), None)


def _date(year: int, month: int, day: int, clock: tuple[int, int, int]) -> dt.datetime | None:
    try:
        made = dt.datetime(year + 2000 if year < 100 else year, month, day, *clock)
    except ValueError:
        return None
    return made if 1990 <= made.year < 2200 else None


def orders_of(stamps: Iterable[tuple[str, LocalStamp]]) -> dict[str, bool]:
    """Return the order that dates of each instrument are in, where those that leave no doubt agree.

    Parameters
    ----------
    stamps
        Instrument and stamp of every scan.

    Examples
    --------
    >>> dates = ("6/5/2024 9:00:00", "6/30/2024 9:00:00")
    >>> orders_of(("HI: 1152050", read_stamp(text)) for text in dates)
    {'HI: 1152050': False}
    """
    found: dict[str, set[bool]] = {}
    for instrument, stamp in stamps:
        if stamp.slashes and stamp.order is not None:
            found.setdefault(instrument, set()).add(stamp.order)
    return {instrument: next(iter(orders)) for instrument, orders in found.items() if len(orders) == 1}


def read_gps_time(text: str) -> dt.timedelta | None:
    """Return the time of day in UTC, ``HHMMSS.sss``; None where there was no fix.

    Raises
    ------
    ValueError
        It is no time of day.

    Examples
    --------
    >>> read_gps_time("090724.786")
    datetime.timedelta(seconds=32844, microseconds=786000)
    """
    if not text:
        return None
    match = _GPS_TIME.fullmatch(text)
    if match is None or int(match[1]) > 23 or int(match[2]) > 59 or int(match[3]) > 60:
        raise ValueError(f"{text[:20]!r}: expected a time of day, HHMMSS.sss")
    return dt.timedelta(
        hours=int(match[1]),
        minutes=int(match[2]),
        seconds=int(match[3]),
        microseconds=int((match[4] or "0").ljust(6, "0")),
    )


def utc_of(
    local: dt.datetime, gps: dt.timedelta | None, longitude: float, utc_offset_h: float | None
) -> dt.datetime | None:
    """Return UTC of a scan: the GPS' time of day on the date that the local clock puts next to it.

    Parameters
    ----------
    local
        What the local clock showed.
    gps
        Time of day in UTC, which wins over the local clock.
    longitude
        Degrees east, from which the zone is guessed to within hours: enough to find the date.
    utc_offset_h
        Local time minus UTC [h], needed where there is no GPS.

    Examples
    --------
    >>> utc_of(dt.datetime(2024, 2, 8, 20, 30), dt.timedelta(hours=1, minutes=30, seconds=4), -75.0, None)
    datetime.datetime(2024, 2, 9, 1, 30, 4)
    """
    if gps is None:
        return None if utc_offset_h is None else local - dt.timedelta(hours=utc_offset_h)
    if utc_offset_h is None:
        utc_offset_h = longitude / 15.0 if math.isfinite(longitude) else 0.0
    near = local - dt.timedelta(hours=utc_offset_h)
    midnight = near.replace(hour=0, minute=0, second=0, microsecond=0)
    return min((midnight + days * _DAY + gps for days in (-1, 0, 1)), key=lambda utc: abs(utc - near))
