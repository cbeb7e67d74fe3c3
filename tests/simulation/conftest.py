"""Fixtures of the tests of the simulator."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import dask
import pytest


@pytest.fixture(scope="session")
def scheduler_of_lines(two_workers: Any) -> Callable[[int], Any]:
    # Return the scheduler for lines of a chunk: threads for 1, two processes for 7, else none
    def chosen(chunk_lines: int) -> Any:
        if chunk_lines == 7:
            return two_workers.as_current()
        return dask.config.set(scheduler="threads" if chunk_lines == 1 else "synchronous")

    return chosen
