"""Checks of arguments of the simulator, which add faults to `Problems`, so that all are listed."""

from __future__ import annotations

from typing import Any

import numpy as np

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import Problems


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
