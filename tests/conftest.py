"""Fixtures every test may use."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import dask
import pytest

SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of real sample files beside the project."""
    if not SHARED_DATA.is_dir():
        pytest.skip("no real sample files: the folder ../shared/data is absent")
    return SHARED_DATA


@contextlib.contextmanager
def _no_compute() -> Iterator[None]:
    def refuse(*_args: Any, **_kwargs: Any) -> None:
        msg = "something computed while it should have stayed lazy"
        raise AssertionError(msg)

    with dask.config.set(scheduler=refuse):
        yield


@pytest.fixture
def no_compute() -> Callable[[], contextlib.AbstractContextManager[None]]:
    """Return a context in which any dask compute fails."""
    return _no_compute
