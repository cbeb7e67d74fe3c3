"""Keyword arguments that have been renamed."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

from hyperpaint.base.errors import SchemaError

P = ParamSpec("P")
R = TypeVar("R")


def renamed(**names: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Return a decorator that refuses an old keyword argument and names the new one (`SchemaError`).

    Examples
    --------
    >>> @renamed(colour="paint")
    ... def draw(paint):
    ...     return paint
    >>> draw(colour="red")
    Traceback (most recent call last):
    hyperpaint.base.errors.SchemaError: draw(colour=) is now draw(paint=); pass paint= [keyword-renamed]
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        @functools.wraps(function)
        def call(*args: P.args, **keywords: P.kwargs) -> R:
            for old, new in names.items():
                if old in keywords:
                    name = function.__name__
                    raise SchemaError(
                        f"{name}({old}=) is now {name}({new}=)", mend=f"pass {new}=", code="keyword-renamed"
                    )
            return function(*args, **keywords)

        return call

    return decorate
