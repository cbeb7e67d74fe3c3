"""Fixtures of the tests of the simulator."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from typing import Any

import dask
import pytest

from hyperpaint.simulation import flight


@pytest.fixture(scope="session")
def scheduler_of_lines(two_workers: Any) -> Callable[[int], Any]:
    # Return the scheduler for lines of a chunk: threads for 1, two processes for 7, else none
    def chosen(chunk_lines: int) -> Any:
        if chunk_lines == 7:
            return two_workers.as_current()
        return dask.config.set(scheduler="threads" if chunk_lines == 1 else "synchronous")

    return chosen


@pytest.fixture(scope="session", autouse=True)
def equal_flights_share_a_car_park() -> Iterator[None]:
    # Make the scene of flights with equal settings once; scenes are not changed by a flight
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(flight, "car_park", functools.lru_cache(8)(flight.car_park))
        yield
