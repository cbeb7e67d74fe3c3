"""Ctrl-C and SIGTERM: one line, a status that says which, and a store that the same command completes."""

import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import xarray as xr
from support.commands import hyperpaint

import hyperpaint as hp
from hyperpaint.io.store.writer import WholeRun


@pytest.fixture(scope="module")
def collect(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("collect")
    hp.simulate_collect(folder, scene="plan", lines=40, bands=20, columns=8, seed=1)
    return folder / "collect.toml"


@pytest.fixture(autouse=True)
def _heard() -> Iterator[None]:
    # Hear Ctrl-C also where these tests run in the background of a shell, which ignores it there
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_stopped_process_goes_on_where_it_was(
    number: signal.Signals, status: int, collect: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written: list[str] = []
    write = WholeRun.write

    def stop_at_the_second(run: WholeRun, name: str, dataset: xr.Dataset, **options: Any) -> None:
        if written:
            os.kill(os.getpid(), number)
        write(run, name, dataset, **options)
        written.append(name)

    before = signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)
    call = ["process", str(collect), "--out", str(tmp_path / "lot.zarr"), "--quiet"]
    with monkeypatch.context() as patch:
        patch.setattr(WholeRun, "write", stop_at_the_second)
        stopped = hyperpaint(*call)
    assert stopped.exit_code == status
    assert stopped.stderr.splitlines()[-1].startswith(f"stopped by {number.name}: ")
    assert "Traceback" not in stopped.output
    assert (len(written), (signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT))) == (1, before)

    again = hyperpaint(*call, status=0)
    assert f"/{written[0]} there already" in again.output
    assert hp.verify(tmp_path / "lot.zarr").ok
    assert [path.name for path in tmp_path.iterdir()] == ["lot.zarr"]


def test_the_second_signal_ends_the_process_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[Any] = []

    def stubborn(*_: Any, **__: Any) -> None:
        try:
            os.kill(os.getpid(), signal.SIGINT)
        finally:
            seen.extend([signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)])

    monkeypatch.setattr("hyperpaint.verify", stubborn)
    assert (hyperpaint("verify", ".").exit_code, seen) == (
        130,
        [signal.SIG_DFL, signal.SIG_DFL],
    )


def test_only_what_goes_on_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    def stop(*_: Any) -> None:
        raise KeyboardInterrupt("by somebody else")

    monkeypatch.setattr("hyperpaint.verify", stop)
    stopped = hyperpaint("verify", ".", status=130)
    assert stopped.stderr == "stopped by SIGINT\n"


def test_a_signal_that_nohup_ignores_stays_ignored(monkeypatch: pytest.MonkeyPatch) -> None:
    before = signal.signal(signal.SIGTERM, signal.SIG_IGN)
    try:
        monkeypatch.setattr("hyperpaint.verify", lambda *_: os.kill(os.getpid(), signal.SIGTERM))
        assert hyperpaint("verify", ".").exit_code != 143
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGTERM, before)
