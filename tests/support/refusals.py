"""Tables of what tests expect: refusals by their code and words, and values beside the values found."""

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import numpy as np
import pytest
import xarray as xr

from hyperpaint.base.errors import PaintError

E = TypeVar("E", bound=PaintError)
F = TypeVar("F", bound=BaseException)
ARRAYS = np.ndarray | xr.DataArray | xr.Variable


@contextmanager
def refusal(kind: type[E], code: str | tuple[str, ...], *told: str) -> Iterator[pytest.ExceptionInfo[E]]:
    # Expect an error of one code, or of a tuple of codes, whose message has these words, such as keys and
    # numbers, in this order
    with pytest.raises(kind) as caught:
        yield caught
    error = caught.value
    codes = error.codes if isinstance(code, tuple) else tuple(sorted(set(error.codes)))
    assert codes == (code if isinstance(code, tuple) else (code,)), f"expected the code {code} of: {error}"
    text = re.sub("|".join(re.escape(f"[{each}]") for each in codes), "", str(error))
    assert re.search(".*".join(map(re.escape, told)), text, re.DOTALL), f"expected {told} in: {text}"


def expect_refusals(*rows: tuple[Any, ...]) -> None:
    # Expect the error of every row: class, code, words of its message, and the call that raises it
    for kind, code, *told, call in rows:
        with refusal(kind, code, *told):
            call()


def expect_words(text: Any, *words: Any, without: tuple[Any, ...] = ()) -> None:
    """Expect all of some words, or keys, in a text or container, and none of those ``without``."""
    absent = [word for word in words if word not in text]
    present = [word for word in without if word in text]
    assert not absent, f"expected {absent} in: {text}"
    assert not present, f"expected no {present} in: {text}"


def expect_error(kind: type[F], match: str | None, call: Callable[[], Any]) -> F:
    """Return the error of a call, of one class, whose message matches a pattern."""
    with pytest.raises(kind, match=match) as caught:
        call()
    return caught.value


def expect_errors(*rows: tuple[Any, str | None, Callable[[], Any]]) -> None:
    """Expect the error of every row: class, pattern of its message, and the call that raises it."""
    for row in rows:
        expect_error(*row)


def expect_equal(*rows: tuple[Any, Any]) -> None:
    """Expect what was found to equal what is expected in every row; arrays in all values, NaN like NaN."""
    for number, (found, expected) in enumerate(rows, start=1):
        if isinstance(found, ARRAYS) or isinstance(expected, ARRAYS):
            np.testing.assert_array_equal(found, expected, err_msg=f"row {number}")
        else:
            assert found == expected, f"row {number}: found {found!r}, expected {expected!r}"
