"""Refusals of the package, matched by their code and by the words that the test is about."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import pytest

from hyperpaint.base.errors import PaintError

E = TypeVar("E", bound=PaintError)


@contextmanager
def refusal(kind: type[E], code: str, *told: str) -> Iterator[pytest.ExceptionInfo[E]]:
    # Expect an error of one code whose message has these words, such as keys and numbers, in this order
    with pytest.raises(kind) as caught:
        yield caught
    error = caught.value
    assert set(error.codes) == {code}, f"expected the code {code} of: {error}"
    text = str(error).replace(f"[{code}]", "")
    assert re.search(".*".join(map(re.escape, told)), text, re.DOTALL), f"expected {told} in: {text}"


def expect_refusals(*rows: tuple[Any, ...]) -> None:
    # Expect the error of every row: class, code, words of its message, and the call that raises it
    for kind, code, *told, call in rows:
        with refusal(kind, code, *told):
            call()
