"""Declared facts: name, unit, kind, range, default and meaning of a value, and the checks that follow."""

from __future__ import annotations

from collections.abc import Collection
from typing import TypeGuard

import numpy as np

from .errors import PaintError, Problems, SchemaError

MAX_NUMBER = 1e300
"""Magnitude from which a number counts as infinite; products of two smaller ones may still overflow."""


def is_number(value: object) -> TypeGuard[float]:
    """Return whether a value is a finite number; bool, NaN and infinity are not.

    Examples
    --------
    >>> is_number(3), is_number(True), is_number("3"), is_number(float("nan")), is_number(10**400)
    (True, False, False, False, False)
    """
    kinds = int | float | np.integer | np.floating
    # compared, not converted: a whole number may be larger than any float
    return isinstance(value, kinds) and not isinstance(value, bool) and bool(-MAX_NUMBER < value < MAX_NUMBER)


def one_of(
    value: object,
    allowed: Collection[str],
    name: str,
    *,
    problems: Problems | None = None,
    error: type[PaintError] = SchemaError,
) -> bool:
    """Return whether a value is one of the allowed words; otherwise note it in ``problems``, or raise.

    Parameters
    ----------
    value
        The word.
    allowed
        All words that are accepted.
    name
        The argument or key, as the user spells it.
    problems
        Takes the fault; None raises it.
    error
        Class of the error raised.

    Examples
    --------
    >>> one_of("cubic", ("linear", "cubic"), "method")
    True
    >>> one_of("cube", ("linear", "cubic"), "method")
    Traceback (most recent call last):
    hyperpaint.base.errors.SchemaError: method='cube', expected one of linear, cubic [choice-unknown]
    """
    if value in tuple(allowed):
        return True
    found, expected = f"{name}={value!r:.60}", f"one of {', '.join(allowed)}"
    if problems is None:
        raise error(found, expected=expected, code="choice-unknown")
    problems.add(found, expected=expected, code="choice-unknown")
    return False
