"""Checks of single settings of the simulator; each notes a problem and goes on, so that all are listed."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, TypeGuard

import numpy as np

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import Problems


def is_number(value: object) -> TypeGuard[float]:
    """Return whether a value is a finite number, and no truth value."""
    kinds = int | float | np.integer | np.floating
    return isinstance(value, kinds) and not isinstance(value, bool) and bool(-1e300 < value < 1e300)


def check_choice(problems: Problems, name: str, value: object, allowed: Collection[str]) -> None:
    """Note a value that is none of the names allowed."""
    if value not in tuple(allowed):
        problems.add(f"{name}={value!r:.60}, expected one of {', '.join(allowed)}")


def check_flag(problems: Problems, name: str, value: object) -> None:
    """Note a value that is not a truth value."""
    if not isinstance(value, bool):
        problems.add(f"{name}={value!r:.60}, expected True or False")


def check_whole(problems: Problems, name: str, value: Any, low: int, high: int | None = None) -> None:
    """Note a value that is no whole number from ``low`` to ``high``."""
    is_whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not is_whole or value < low or (high is not None and value > high):
        most = "on" if high is None else f"to {high}"
        problems.add(f"{name}={value!r:.60}, expected a whole number from {low} {most}")


def check_number(
    problems: Problems, name: str, value: object, low: float, high: float = np.inf, *, above: bool = False
) -> None:
    """Note a value that is no finite number from ``low`` to ``high``; ``above`` leaves ``low`` itself out."""
    if not is_number(value) or not low <= value <= high or (above and value == low):
        least = f"above {low:g}" if above else f"from {low:g}"
        most = "" if high == np.inf else f" to {high:g}"
        problems.add(f"{name}={value!r:.60}, expected a number {least}{most}")


def finite_floats(values: Any, name: str, problems: Problems) -> Floats:
    """Return values as a new float64 array, noting what is no array of finite numbers."""
    try:
        array = np.array(values, dtype=np.float64, order="C")
    except (TypeError, ValueError):
        problems.add(f"{name} is not an array of numbers")
        return np.zeros(0)
    if not np.isfinite(array).all():
        problems.add(f"{name} holds {np.count_nonzero(~np.isfinite(array))} values that are not finite")
    return array


def moment_of(value: Any) -> np.datetime64:
    """Return a time [ns]; NaT for what is none."""
    try:
        return np.datetime64(np.asarray(value, "datetime64[ns]").item(), "ns")
    except (ValueError, TypeError):
        return np.datetime64("NaT", "ns")
