"""What a value in a TOML file may be."""

from __future__ import annotations

import datetime
import sys
from collections.abc import Callable
from typing import Any

__all__ = [
    "Check", "flag", "not_negative", "number", "one_of", "positive", "table", "text", "texts", "time",
    "whole",
]  # fmt: skip

Check = Callable[[Any], str | None]
"""Takes a value, and returns None where it is good, else what was expected."""


def text(value: Any) -> str | None:
    """Expect text that is not blank."""
    return None if isinstance(value, str) and value.strip() else "a text"


def number(value: Any) -> str | None:
    """Expect a number; TOML's ``inf`` and ``nan`` are none."""
    # compared, not converted: a whole number may be larger than any float
    good = isinstance(value, (int, float)) and not isinstance(value, bool)
    return None if good and abs(value) <= sys.float_info.max else "a number"


def positive(value: Any) -> str | None:
    """Expect a number above 0."""
    return None if number(value) is None and value > 0 else "a positive number"


def not_negative(value: Any) -> str | None:
    """Expect a number from 0 on."""
    return None if number(value) is None and value >= 0 else "a number from 0 on"


def whole(least: int, most: int) -> Check:
    """Expect a whole number between two, both included."""

    def check(value: Any) -> str | None:
        good = isinstance(value, int) and not isinstance(value, bool) and least <= value <= most
        return None if good else f"a whole number from {least} to {most}"

    return check


def flag(value: Any) -> str | None:
    """Expect true or false."""
    return None if isinstance(value, bool) else "true or false"


def one_of(*allowed: str) -> Check:
    """Expect one of these words."""

    def check(value: Any) -> str | None:
        return (
            None if isinstance(value, str) and value in allowed else f"one of {', '.join(map(repr, allowed))}"
        )

    return check


def texts(value: Any) -> str | None:
    """Expect a text, or a list of some."""
    several = value if isinstance(value, list) and value else [value]
    return None if all(text(one) is None for one in several) else "a text or a list of texts"


def table(value: Any) -> str | None:
    """Expect a table."""
    return None if isinstance(value, dict) else "a table of texts"


def time(value: Any) -> str | None:
    """Expect a date or time, or text that spells one."""
    good = isinstance(value, (str, datetime.date))
    return None if good else "a date or time"
