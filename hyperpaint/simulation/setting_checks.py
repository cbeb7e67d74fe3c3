"""Checks of arguments of the simulator, which add faults to `Problems`, so that all are listed."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import numpy as np

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import Problems
from hyperpaint.base.facts import Fact, as_argument, one_of


def check_choice(problems: Problems, name: str, value: object, allowed: Collection[str]) -> None:
    one_of(value, allowed, name, problems=problems)


def check_whole(problems: Problems, name: str, value: Any, least: int, most: int | None = None) -> None:
    Fact(doc=name, kind="whole", least=least, most=most).note(problems, as_argument(name, value), value)


def check_number(
    problems: Problems,
    name: str,
    value: object,
    least: float,
    most: float | None = None,
    *,
    above: bool = False,
) -> None:
    """Note a value that is not a number from ``least`` to ``most``; ``above`` excludes ``least``."""
    fact = Fact(doc=name, kind="number", least=least, most=most, above=above)
    fact.note(problems, as_argument(name, value), value)


def finite_floats(values: Any, name: str, problems: Problems) -> Floats:
    """Return values as a new float64 array, and note entries that are not finite numbers."""
    try:
        array = np.array(values, dtype=np.float64, order="C")
    except (TypeError, ValueError):
        problems.add(f"{name} is not an array of numbers", code="type-wrong")
        return np.zeros(0)
    if not np.isfinite(array).all():
        problems.add(
            f"{name} has {np.count_nonzero(~np.isfinite(array))} values that are not finite",
            code="not-finite",
        )
    return array


def moment_of(value: Any) -> np.datetime64:
    """Return a time [ns]; NaT for a value that is not a time."""
    try:
        return np.datetime64(np.asarray(value, "datetime64[ns]").item(), "ns")
    except (ValueError, TypeError):
        return np.datetime64("NaT", "ns")
