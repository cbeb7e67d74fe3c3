"""Fixtures every test may use, and the rule that real files beside the project are really read."""

from __future__ import annotations

import contextlib
import functools
import logging
import multiprocessing
import os
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import dask
import numpy as np
import pytest
from hypothesis import HealthCheck, settings

from hyperpaint.simulation import flight

# one profile for all property tests: how fast the machine is today fails none of them, and fixtures of a test
# are not changed by its examples; HYPERPAINT_EXAMPLES=250 searches for longer
settings.register_profile(
    "hyperpaint", deadline=None, max_examples=int(os.environ.get("HYPERPAINT_EXAMPLES", "20")),
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)  # fmt: skip
settings.load_profile("hyperpaint")

SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
_REAL: dict[str, int] = {"ran": 0, "without an oracle": 0, "skipped": 0}
_SKIPPED: dict[str, bool] = {}  # of every test that was reported
SKIPPED_RECORD = "hyperpaint/skipped"  # in pytest's cache: tests that the runs so far skipped


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--skipped", action="store_true",
        help="run the tests that earlier runs skipped, for want of packages; without such runs, all",
    )  # fmt: skip


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if skipped := config.option.skipped and set(config.cache.get(SKIPPED_RECORD, [])):
        chosen = [item for item in items if {item.nodeid, item.nodeid.split("::")[0]} & skipped]
        config.hook.pytest_deselected(items=[item for item in items if item not in set(chosen)])
        items[:] = chosen


@pytest.hookimpl(wrapper=True)
def pytest_collect_file() -> Generator[None, list[pytest.Collector], list[pytest.Collector]]:
    """Search files of tests for tests only: the examples are in the package."""
    return [collector for collector in (yield) if type(collector) is pytest.Module]


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of real sample files beside the project."""
    if not SHARED_DATA.is_dir():
        pytest.skip("no real sample files: the folder ../shared/data is absent")
    return SHARED_DATA


@pytest.fixture(scope="session", autouse=True)
def equal_flights_share_scene_and_sky() -> Iterator[None]:
    """Make car parks and skies of simulated flights with equal settings once; no flight changes them."""
    plain = flight.sky_irradiance

    @functools.lru_cache(64)
    def of_bytes(sky: str, sun_zenith: float, grid: bytes) -> Any:
        light = plain(sky, sun_zenith, np.frombuffer(grid))
        light.setflags(write=False)
        return light

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(flight, "car_park", functools.lru_cache(8)(flight.car_park))
        patch.setattr(flight, "sky_irradiance", lambda *key: of_bytes(*key[:2], key[2].tobytes()))
        yield


# processes import the package for seconds, so all tests of a session share two of them


@pytest.fixture(scope="session")
def two_processes() -> Iterator[ProcessPoolExecutor]:
    """Pool of two spawned processes, also for ``dask.config.set(scheduler="processes", pool=...)``."""
    with ProcessPoolExecutor(2, multiprocessing.get_context("spawn")) as pool:
        yield pool


@pytest.fixture(scope="session")
def two_workers() -> Iterator[Any]:
    """Client, not the default one, of a cluster of two processes of one thread each."""
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, dashboard_address=":0", silence_logs=logging.CRITICAL
        ) as cluster,
        distributed.Client(cluster, set_as_default=False) as client,
    ):
        yield client


@pytest.fixture(scope="session")
def scheduler_of_lines(two_workers: Any) -> Callable[[int], Any]:
    """Return the scheduler for lines of a chunk: threads for 1, two processes for 7, else none."""

    def chosen(chunk_lines: int) -> Any:
        if chunk_lines == 7:
            return two_workers.as_current()
        return dask.config.set(scheduler="threads" if chunk_lines == 1 else "synchronous")

    return chosen


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


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Give each worker whole files, which share what they build; one that is idle takes from another."""
    from xdist.scheduler import WorkStealingScheduling

    return WorkStealingScheduling(config, log)


def pytest_collectreport(report: pytest.CollectReport) -> None:
    _SKIPPED[report.nodeid] = report.skipped


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    _SKIPPED[report.nodeid] = _SKIPPED.get(report.nodeid, False) or report.skipped
    if "real_data" not in report.keywords:
        return
    if report.skipped:
        # pytest.importorskip: an optional package to compare with is missing, not the file
        oracle = "could not import" in str(report.longrepr)
        _REAL["without an oracle" if oracle else "skipped"] += 1
    elif report.when == "call":
        _REAL["ran"] += 1


def pytest_terminal_summary(terminalreporter: Any) -> None:
    if SHARED_DATA.is_dir():
        counts = f"{_REAL['ran']} tests read them, {_REAL['skipped']} could not"
        oracles = f"{_REAL['without an oracle']} lacked a package to compare with"
        terminalreporter.write_line(f"real files: {counts}, {oracles}")


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Fail a run that had to read the real files where any test found none that it could use."""
    required = os.environ.get("HYPERPAINT_REQUIRE_REAL_DATA") and not session.config.option.collectonly
    if hasattr(session.config, "workerinput"):  # one of several processes: the one that starts them counts
        return
    if cache := getattr(session.config, "cache", None):  # pytest -p no:cacheprovider has none
        earlier = set(cache.get(SKIPPED_RECORD, [])) - _SKIPPED.keys()
        cache.set(SKIPPED_RECORD, sorted(earlier | {test for test, skipped in _SKIPPED.items() if skipped}))
    if required and session.exitstatus == 0 and (_REAL["skipped"] or not _REAL["ran"]):
        session.exitstatus = pytest.ExitCode.TESTS_FAILED
