"""A navigation file as its reader leaves it: stamps, poses, and what their numbers mean.

Readers of a format fill a `PoseRecord`; `navigation_opening` turns its stamps into UTC and labels it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from hyperpaint.base.attitude_conventions import Convention
from hyperpaint.base.errors import Problems, TimeError

from .navigation_records import LIMITS

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["POSE", "PoseRecord", "check_poses", "check_seconds", "check_time_order", "numbered"]

POSE = tuple(LIMITS)
"""``latitude longitude altitude roll pitch heading``."""
_ANGLES = ("roll", "pitch", "heading")


@dataclass(frozen=True)
class PoseRecord:
    """One navigation file.

    Attributes
    ----------
    name
        File name, for messages.
    format
        What the file is.
    stamp
        Nanoseconds, (row,).
    counts_from
        ``"1970"``, as the clock shows it; or the start of a GPS ``"week"``.
    values
        `POSE` (row,), float64: latitude and longitude [degree], altitude [m], angles in the unit of the
        convention; NaN where unknown.
    convention
        What the numbers mean, as far as the format or the file says.
    assumed
        Fields of the convention that nothing published states.
    time_scale
        What the stamps count, unless the caller knows better.
    week, leap_seconds
        What the file itself says.
    others
        Further columns (row,) with their attributes.
    attrs
        Anything else that is to be kept.
    """

    name: str
    format: str
    stamp: NDArray[np.int64]
    counts_from: Literal["1970", "week"]
    values: Mapping[str, NDArray[np.float64]] = field(repr=False)
    convention: Convention
    assumed: tuple[str, ...] = ()
    time_scale: Literal["gps", "utc"] = "gps"
    week: int | None = None
    leap_seconds: int | None = None
    others: Mapping[str, tuple[NDArray[Any], Mapping[str, str]]] = field(default_factory=dict, repr=False)
    attrs: Mapping[str, Any] = field(default_factory=dict)


def check_poses(values: Mapping[str, NDArray[np.float64]], unit: str, problems: Problems, row: str) -> None:
    """Note positions and angles that are none, NaN allowed.

    Parameters
    ----------
    values
        `POSE`: latitude and longitude [degree], altitude [m].
    unit
        Of roll, pitch and heading: ``"degree"`` or ``"radian"``.
    problems
        Takes what is wrong.
    row
        What a row of the file is called in messages.
    """
    for name, limit in LIMITS.items():
        # a heading less an angle of wander may pass a full turn
        most = 2.0 * np.pi * 1.25 if name in _ANGLES and unit == "radian" else limit * 1.25
        most = limit if name not in _ANGLES else most
        with np.errstate(invalid="ignore"):
            wrong = np.flatnonzero(~(np.abs(values[name]) <= most) & ~np.isnan(values[name]))
        if wrong.size:
            found = values[name][wrong[0]]
            problems.add(
                f"{name} is {found:g} in {numbered(row, wrong + 1)}, expected at most {most:.4g} either way"
            )


def check_time_order(name: str, stamp: NDArray[np.int64], row: str) -> None:
    """Refuse a record whose time runs backwards.

    Raises
    ------
    TimeError
        It does; the rows are named.
    """
    wrong = np.flatnonzero(np.diff(stamp) < 0) + 2
    if wrong.size:
        raise TimeError(
            f"{name}: time runs backwards in {numbered(row, wrong)}; delete or re-order these rows"
        )


def check_seconds(name: str, seconds: NDArray[np.float64], most: float, problems: Problems, row: str) -> None:
    """Note times that are not finite, negative, or beyond ``most`` seconds."""
    wrong = np.flatnonzero(~((seconds >= 0.0) & (seconds <= most)))
    if wrong.size:
        problems.add(
            f"time is {seconds[wrong[0]]:g} s in {numbered(row, wrong + 1)}, expected 0 to {most:g} s; "
            f"is {name} of this format?"
        )


def numbered(row: str, numbers: Sequence[int] | NDArray[np.int64]) -> str:
    """Return ``"record 7"`` or ``"records 7, 9, 11 ... (40 in all)"`` for a message."""
    shown = ", ".join(str(int(number)) for number in numbers[:5])
    if len(numbers) == 1:
        return f"{row} {shown}"
    return f"{row}s {shown}" + (f" ... ({len(numbers)} in all)" if len(numbers) > 5 else "")
