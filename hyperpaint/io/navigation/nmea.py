"""Navigation as NMEA 0183 sentences in a log, among other text."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterator
from functools import reduce
from operator import xor
from pathlib import Path
from typing import Literal

import numpy as np

from hyperpaint.base.attitude_conventions import Convention
from hyperpaint.base.errors import FormatError, PaintWarning, Problems, TimeError
from hyperpaint.io.files.text_tables import MAX_TABLE_ROWS, read_text

from .clocks import NS_PER_S, refuse_backwards
from .navigation_records import POSE, PoseRecord, check_poses

_MAX_BYTES = 2**28
#: Largest number of positions in a log: five hours at 20 Hz.
_MAX_POSITIONS = 400_000

_SENTENCE = re.compile(r"\$?((?:[A-Z]{2}(?:GGA|RMC|ZDA|HDT|THS)|PASHR),[ -)+-~]{0,120})\*([0-9A-Fa-f]{2})")
_CLOCK = re.compile(r"([0-9]{2})([0-9]{2})([0-9]{2}(?:\.[0-9]{1,9})?)")
_ANGLE = re.compile(r"([0-9]{1,3})([0-9]{2}(?:\.[0-9]{1,12})?)")
_NUMBER = re.compile(r"[+-]?[0-9]{1,9}(?:\.[0-9]{0,12})?")
_DAY_S = 86_400
_HALF_DAY_S = 43_200.0
#: Quality codes of GGA for measured positions, without estimated, manual and simulated ones.
_MEASURED_QUALITIES = (1, 2, 3, 4, 5, 9)
#: Largest share of sentences with a wrong checksum [1].
_MAX_DAMAGED_SHARE = 0.5


def is_nmea(head: bytes) -> bool:
    """Return whether the first bytes of a file contain NMEA sentences with positions."""
    return any("GGA" in match[1][:6] for match in _SENTENCE.finditer(head.decode("latin-1")))


def read_nmea(path: str | Path, midnight: int | None = None) -> PoseRecord:
    """Read a log of NMEA 0183 sentences.

    Each GGA sentence with a fix gives a row: time of day in UTC, position, and height above the ellipsoid,
    which is the sum of its heights above mean sea level and of the geoid. If a sentence lacks the latter, all
    heights are above the geoid. The date comes from RMC or ZDA. Roll, pitch and heading come from PASHR of
    the same time; without it, heading comes from the HDT or THS before or after the GGA sentence. The course
    over ground is not the heading, and is ignored, as are other texts, and sentences with a wrong checksum.

    path: The log.
    midnight: 0 h UTC of the first row's day [ns since 1970-01-01], for a log without dates.
    Returns PoseRecord: Angles [degree], NaN if unknown. The standard does not define the signs of roll and
        pitch, which are assumed.
    Raises FormatError: No position with a fix, too many damaged sentences, or positions and angles out of
    range. Raises TimeError: No date, or time runs backwards. Warns PaintWarning: Damaged sentences; no
    attitude in the whole log.
    """
    path = Path(path)
    text = read_text(path, _MAX_BYTES, MAX_TABLE_ROWS)
    log = _Log(path)
    for fields in _valid_sentences(path, text):
        log.take(fields)
        if len(log.rows) > _MAX_POSITIONS:
            raise FormatError(
                f"{path}: over {_MAX_POSITIONS} positions",
                expected="a log of hours",
                mend="shorten the log to the flight",
                code="file-too-large",
            )
    log.problems.raise_if_any()
    if not log.rows:
        raise FormatError(
            f"{path}: no position with a fix", expected="GGA sentences of NMEA 0183", code="position-missing"
        )
    midnight_ns = log.first_day if log.first_day is not None else midnight
    if midnight_ns is None:
        raise TimeError(
            f"{path.name} contains no date (RMC or ZDA)",
            mend="pass date='YYYY-MM-DD' of its first row",
            code="date-missing",
        )
    stamp = np.rint(np.array(list(log.rows)) * NS_PER_S).astype(np.int64) + midnight_ns
    names = (*POSE, "separation")
    values = {name: np.array([row.get(name, np.nan) for row in log.rows.values()]) for name in names}
    separation = values.pop("separation")
    height: Literal["ellipsoid", "geoid"] = "geoid" if np.isnan(separation).any() else "ellipsoid"
    if height == "ellipsoid":
        values["altitude"] += separation
    check_poses(values, "degree", log.problems, "position")
    log.problems.raise_if_any()
    refuse_backwards(path.name, stamp, row="position")
    if all(np.isnan(values[name]).all() for name in ("roll", "pitch", "heading")):
        text = f"{path.name} contains no roll, pitch or heading (PASHR, HDT or THS)"
        warnings.warn(PaintWarning(text, code="attitude-missing"), stacklevel=3)
    return PoseRecord(
        path.name,
        "NMEA 0183",
        stamp,
        "1970",
        values,
        Convention(height_reference=height),
        assumed=("roll_positive", "pitch_positive", "euler_order"),
        time_scale="utc",
    )


def _valid_sentences(path: Path, text: str) -> Iterator[list[str]]:
    # Yield the fields of each sentence with a correct checksum; warn of others, or refuse the log.
    damaged = total = 0
    for match in _SENTENCE.finditer(text):
        total += 1
        if reduce(xor, match[1].encode("latin-1")) == int(match[2], 16):
            yield match[1].split(",")
        else:
            damaged += 1
    if damaged > _MAX_DAMAGED_SHARE * total:
        raise FormatError(
            f"{path}: {damaged} of {total} sentences have a wrong checksum",
            mend="copy it again",
            code="checksum-wrong",
        )
    if damaged:
        message = f"{path.name}: {damaged} of {total} sentences have a wrong checksum, and are ignored"
        warnings.warn(PaintWarning(message, code="checksum-wrong"), stacklevel=4)


class _Log:
    # Collects the sentences of a log into rows.
    def __init__(self, path: Path) -> None:
        self.rows: dict[float, dict[str, float]] = {}  # poses by seconds from 0 h of the first day
        self.first_day: int | None = None  # 0 h of the first day [ns since 1970-01-01]
        self.problems = Problems(f"{path} cannot be used as a log of NMEA sentences", FormatError)
        self._last_seconds: float | None = None  # of the previous sentence with a time
        self._heading_ahead: float | None = None  # for the next position
        self._is_heading_first = False  # whether the heading precedes its position
        self._readers: dict[str, Callable[[list[str]], None]] = {
            "GGA": self._take_gga,
            "RMC": self._take_rmc,
            "ZDA": self._take_zda,
            "PASHR": self._take_pashr,
            "HDT": self._take_hdt,
            "THS": self._take_ths,
        }
        self._attitudes_ahead: dict[
            float, dict[str, float]
        ] = {}  # attitudes of positions that follow, by seconds

    def take(self, fields: list[str]) -> None:
        kind = fields[0][-3:] if fields[0] != "PASHR" else "PASHR"
        try:
            self._readers[kind](fields)
        except (ValueError, LookupError):
            if len(self.problems) < 5:
                self.problems.add(
                    f"sentence {','.join(fields)[:60]!r} does not follow NMEA 0183", code="row-unreadable"
                )

    def _take_gga(self, fields: list[str]) -> None:
        if int(fields[6] or 0) not in _MEASURED_QUALITIES or not fields[2]:
            return
        seconds = self._record_seconds(fields[1])
        if seconds in self.rows:
            return
        row = self.rows[seconds] = {
            "latitude": _angle(fields[2]) * {"N": 1.0, "S": -1.0}[fields[3]],
            "longitude": _angle(fields[4]) * {"E": 1.0, "W": -1.0}[fields[5]],
            "altitude": _number(fields[9]),
            "separation": _number(fields[11]),
        }
        if self._heading_ahead is not None:
            row["heading"], self._heading_ahead = self._heading_ahead, None
        row.update(self._attitudes_ahead.pop(seconds, {}))
        self._attitudes_ahead.clear()

    def _take_rmc(self, fields: list[str]) -> None:
        if fields[2] == "A":
            day, month, year = (int(fields[9][start : start + 2]) for start in (0, 2, 4))
            self._date(fields[1], f"{2000 + year if year < 80 else 1900 + year}-{month:02}-{day:02}")

    def _take_zda(self, fields: list[str]) -> None:
        if fields[2]:
            self._date(fields[1], f"{int(fields[4]):04}-{int(fields[3]):02}-{int(fields[2]):02}")

    def _take_pashr(self, fields: list[str]) -> None:
        if len(fields) < 6 or not _CLOCK.fullmatch(fields[1]):
            return  # another sentence of the same maker
        seconds = self._record_seconds(fields[1])
        field_numbers = {"heading": 2, "roll": 4, "pitch": 5}
        pose = {name: _number(fields[number]) for name, number in field_numbers.items() if fields[number]}
        if seconds in self.rows:
            self.rows[seconds].update(pose)
        else:
            self._attitudes_ahead[seconds] = pose

    def _take_hdt(self, fields: list[str]) -> None:
        if not fields[1]:
            return
        # without a time: belongs to the next position if the log begins with it, else to the previous one
        self._is_heading_first |= not self.rows
        if self._is_heading_first:
            self._heading_ahead = _number(fields[1])
        else:
            self.rows[next(reversed(self.rows))].setdefault("heading", _number(fields[1]))

    def _take_ths(self, fields: list[str]) -> None:
        if fields[2] == "A":
            self._take_hdt(fields)

    def _record_seconds(self, clock: str) -> float:
        # Return seconds from 0 h of the first row's day.
        match = _CLOCK.fullmatch(clock)
        if match is None:
            raise ValueError(clock)
        seconds_of_day = int(match[1]) * 3600.0 + int(match[2]) * 60.0 + float(match[3])
        if self._last_seconds is None:
            self._last_seconds = seconds_of_day
        # some sentences are late: choose the day that is nearest to the previous sentence
        self._last_seconds += (seconds_of_day - self._last_seconds + _HALF_DAY_S) % _DAY_S - _HALF_DAY_S
        return round(self._last_seconds, 9)

    def _date(self, clock: str, date: str) -> None:
        days = int(self._record_seconds(clock) // _DAY_S)
        first_midnight = int(np.datetime64(date, "ns").astype(np.int64)) - days * _DAY_S * NS_PER_S
        if self.first_day is None:
            self.first_day = first_midnight


def _angle(text: str) -> float:
    # Convert ``dddmm.mmmm`` to degrees.
    match = _ANGLE.fullmatch(text)
    if match is None:
        raise ValueError(text)
    return int(match[1]) + float(match[2]) / 60.0


def _number(text: str) -> float:
    if not text:
        return np.nan
    if not _NUMBER.fullmatch(text):
        raise ValueError(text)
    return float(text)
