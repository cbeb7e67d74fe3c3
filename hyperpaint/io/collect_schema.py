"""The tables and keys of a ``collect.toml``, and what each value must be."""

from __future__ import annotations

import datetime
import sys
from collections.abc import Callable, Mapping
from typing import Any

__all__ = ["LISTS", "SCHEMA", "Check"]

Check = Callable[[Any], str | None]
"""Takes a value, and returns None where it is good, else what was expected."""


def _text(value: Any) -> str | None:
    return None if isinstance(value, str) and value.strip() else "a text"


def _number(value: Any) -> str | None:
    # compared, not converted: a whole number may be larger than any float
    good = isinstance(value, (int, float)) and not isinstance(value, bool)
    return None if good and abs(value) <= sys.float_info.max else "a number"


def _positive(value: Any) -> str | None:
    return None if _number(value) is None and value > 0 else "a positive number"


def _not_negative(value: Any) -> str | None:
    return None if _number(value) is None and value >= 0 else "a number from 0 on"


def _whole(least: int, most: int) -> Check:
    def check(value: Any) -> str | None:
        good = isinstance(value, int) and not isinstance(value, bool) and least <= value <= most
        return None if good else f"a whole number from {least} to {most}"

    return check


def _flag(value: Any) -> str | None:
    return None if isinstance(value, bool) else "true or false"


def _one_of(*allowed: str) -> Check:
    def check(value: Any) -> str | None:
        return (
            None if isinstance(value, str) and value in allowed else f"one of {', '.join(map(repr, allowed))}"
        )

    return check


def _texts(value: Any) -> str | None:
    several = value if isinstance(value, list) and value else [value]
    return None if all(_text(one) is None for one in several) else "a text or a list of texts"


def _table(value: Any) -> str | None:
    return None if isinstance(value, dict) else "a table of texts"


def _time(value: Any) -> str | None:
    good = isinstance(value, (str, datetime.date))
    return None if good else "a date or time"


_STAMP = _one_of("start", "mid", "end")
SCHEMA: Mapping[str, Mapping[str, Check]] = {
    "collect": {"name": _text, "description": _text},
    "camera": {
        "bit_depth": _whole(1, 16),
        "saturation_count": _positive,
        "exposure_time_ms": _positive,
        "frame_period_ms": _positive,
        "stamp": _STAMP,
        "clock_offset_s": _number,
        "time_scale": _one_of("utc", "gps"),
        "gps_leap_seconds": _whole(-100, 100),
        "fwhm_nm": _positive,
        "radiance_units": _text,
    },
    "calibration": {"path": _text, "sweep": _text},
    "dark": {"cubes": _texts},
    "irradiance": {
        "files": _texts,
        "quantity": _text,
        "utc_offset_h": _number,
        "clock_offset_s": _number,
        "stamp": _STAMP,
        "fwhm_nm": _positive,
        "max_gap_s": _positive,
        "clock_uncertainty_s": _not_negative,
        "units": _text,
        "averaging_s": _number,
        "calibration": _table,
    },
    "flightlines": {
        "id": _text,
        "cube": _text,
        "frame_index": _text,
        "nav": _text,
        "gps_time": _text,
        "date": _time,
        "start_time": _time,
        "exposure_time_ms": _positive,
        "frame_period_ms": _positive,
        "keep_whole_lines": _flag,
    },
    "references": {"instrument": _text, "files": _texts},
}
"""Check of every key of every table."""

LISTS = ("flightlines", "references")
"""Tables that may be there several times."""
