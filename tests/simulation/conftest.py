"""Fixtures of the tests of the simulator."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable, Iterator
from typing import Any

import dask
import pytest

from hyperpaint.simulation import rendered_flight


@pytest.fixture(scope="session")
def scheduler_of_lines() -> Iterator[Callable[[int], Any]]:
    # Return the scheduler for lines of a chunk: threads for 1, two processes for 7, else none
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, dashboard_address=":0", silence_logs=logging.CRITICAL
        ) as cluster,
        distributed.Client(cluster, set_as_default=False) as client,
    ):

        def chosen(chunk_lines: int) -> Any:
            if chunk_lines == 7:
                return client.as_current()
            return dask.config.set(scheduler="threads" if chunk_lines == 1 else "synchronous")

        yield chosen


@pytest.fixture(scope="session", autouse=True)
def equal_flights_share_a_car_park() -> Iterator[None]:
    # Make the scene of flights with equal settings once; scenes are not changed by a flight
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rendered_flight, "car_park", functools.lru_cache(8)(rendered_flight.car_park))
        yield
