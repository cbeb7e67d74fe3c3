"""Options of commands: from functions, few, alike everywhere; old spellings name the new ones."""

import inspect
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest
import xarray as xr
import zarr
from click.shell_completion import ShellComplete
from support.commands import hyperpaint

import hyperpaint as hp
from hyperpaint.base.facts import PARAMETERS
from hyperpaint.cli.options import Settings, parameters_of
from hyperpaint.cli.program import GROUPS, main
from hyperpaint.io.store import budget, open_group, to_store
from hyperpaint.io.store.writer import WholeRun
from hyperpaint.report.summaries import with_times
from hyperpaint.simulation import simulate_line
from hyperpaint.workflows import pipeline

CONTEXT = click.Context(main)
NAMES = main.list_commands(CONTEXT)


def options_of(name: str) -> list[click.Option]:
    command = main.get_command(CONTEXT, name)
    assert command is not None
    return [option for option in command.params if isinstance(option, click.Option)]


def run(*words: str) -> str:
    # Return the message of a refused call
    return hyperpaint(*words, status=2).stderr


def test_the_number_of_options() -> None:
    assert len(NAMES) == 22
    assert sum(len(options_of(name)) for name in NAMES) <= 200


def test_help_of_the_program_is_one_screen() -> None:
    shown = hyperpaint("--help").stdout
    assert 24 <= len(shown.splitlines()) <= 42
    for group, commands in GROUPS.items():
        assert re.search(rf"^  {group} ", shown, re.MULTILINE)
        for name in commands:
            assert re.search(rf" {name} ", shown)


def test_zarr_has_as_many_threads_as_dask(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    counts = []

    def write_report(*_: object, **__: object) -> None:
        counts.append(zarr.config.get("threading.max_workers"))
        raise hp.errors.StoreError("no report", code="store-empty")

    before = zarr.config.get("threading.max_workers")
    monkeypatch.setattr(budget, "thread_count", lambda: 3)
    monkeypatch.setattr(hp.report, "write_report", write_report)
    hyperpaint("report", tmp_path, "--out", tmp_path / "page.html", status=2)
    assert counts == [3]
    assert zarr.config.get("threading.max_workers") == before


@pytest.mark.parametrize("name", NAMES)
def test_help_of_a_command_teaches(name: str) -> None:
    shown = hyperpaint(name, "--help", terminal_width=100).stdout
    assert len(shown.splitlines()) <= 64
    assert f"  hyperpaint {name}" in shown
    assert all(option.help for option in options_of(name))


def test_choices_and_defaults_are_those_of_the_function() -> None:
    parameters = inspect.signature(pipeline.process).parameters
    for option in options_of("process"):
        name = str(option.name)
        if not option.multiple and name != "out":
            assert parameters[name].default == option.default, name
    (layout,) = (option for option in options_of("process") if option.name == "layout")
    assert isinstance(layout.type, click.Choice)
    assert tuple(layout.type.choices) == ("cube", "explore", "web")


def test_shared_descriptions_are_read_from_their_table() -> None:
    process = parameters_of("workflows.pipeline:process")
    assert process["scheduler"].help.startswith("Address of a dask.distributed scheduler")
    assert process["overwrite"].help == PARAMETERS["group overwrite"]


def test_parameters_are_read_without_an_import() -> None:
    found = parameters_of("workflows.maps:location_of")
    assert found["boresight"].kind == {"nargs": 3, "type": float}
    assert isinstance(found["column_order"].kind["type"], click.Choice)
    assert found["ground"].help == "Height of level ground above the ellipsoid [m]."
    assert found["flightline"].default is ...


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("report x --signatures", "--library"), ("site x --signatures", "--library"),
        ("render x --paints", "--library"), ("view x --group", "--line"), ("report x --lines", "--max-lines"),
        ("validate x --plot", "--picture"), ("calibrate x --report", "--picture"),
        ("simulate x --sky", "--atmosphere"), ("detect x --rate", "--false-alarm-rate"),
        ("simulate x --no-noise", "--set noise=no"), ("simulate x --smile", "--set smile_nm=VALUE"),
        ("orthorectify x --boresight", "--set boresight=VALUE,VALUE,VALUE"),
        ("signatures x --glint", "--set glint=VALUE"),
    ],
)  # fmt: skip
def test_an_old_spelling_names_the_new_one(old: str, new: str) -> None:
    assert f"is now {new} [option-renamed]" in run(*old.split(), "1")


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("smil=1", "did you mean smile_nm=1? [setting-unknown]"), ("noise", "[setting-unknown]"),
        ("cloud=1,2", "[type-wrong]"), ("smile_nm=wide", "[type-wrong]"), ("noise=perhaps", "[type-wrong]"),
    ],
)  # fmt: skip
def test_a_wrong_setting(setting: str, message: str) -> None:
    assert message in run("simulate", "x", "--set", setting)


def test_settings_are_listed() -> None:
    (settings,) = (option for option in options_of("simulate") if isinstance(option, Settings))
    shown = hyperpaint("simulate", "x", "--set", "?", status=0)
    assert all(re.search(rf"^{name} ", shown.stdout, re.MULTILINE) for name in settings.types)


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        (["porcess"], "process"),
        (["demo", "--ot", "x"], "--out"),
        (["demo", "--quite"], "--quiet"),
        (["--quite", "demo"], "--quiet"),
    ],
)
def test_a_misspelt_word_is_suggested(words: list[str], meant: str) -> None:
    assert f"Did you mean {meant!r}?" in run(*words)


def test_a_collect_without_regions_is_told(tmp_path: Path) -> None:
    told = hyperpaint("simulate", tmp_path, "--scene", "plan", "--lines", 8, "--bands", 4, "--columns", 6)
    assert "regions.geojson has no region: no paint has a clean level area of 6 by 6 pixels" in told.stderr


def test_options_of_the_program_stand_anywhere(tmp_path: object) -> None:
    for words in (
        ["--memory-limit", "much", "report", "."],
        ["report", ".", "--quiet", "--memory-limit=much"],
    ):
        assert "much" in run(*words)


def test_words_are_completed() -> None:
    complete = ShellComplete(main, {}, "hyperpaint", "_HYPERPAINT_COMPLETE")
    assert [item.value for item in complete.get_completions([], "sig")] == ["signatures"]
    assert "--false-alarm-rate" in [item.value for item in complete.get_completions(["detect"], "--f")]


# --- Ctrl-C and SIGTERM: one line, a status that says which, and a store that the same command completes ---


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

    assert f"/{written[0]} there already" in hyperpaint(*call, status=0).output
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
    assert hyperpaint("verify", ".", status=130).stderr == "stopped by SIGINT\n"


def test_a_signal_that_nohup_ignores_stays_ignored(monkeypatch: pytest.MonkeyPatch) -> None:
    before = signal.signal(signal.SIGTERM, signal.SIG_IGN)
    try:
        monkeypatch.setattr("hyperpaint.verify", lambda *_: os.kill(os.getpid(), signal.SIGTERM))
        assert hyperpaint("verify", ".").exit_code != 143
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGTERM, before)


# --- What a fresh process imports and compiles, and what it need not ---

HEAVY = ("dask.array", "distributed", "numba", "pint", "scipy")


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("cold") / "lot.zarr"
    to_store(simulate_line(lines=16, bands=20, columns=12, seed=1), place, "flightlines/raw_0")
    return place


def loaded_after(statements: str, modules: tuple[str, ...] = HEAVY) -> list[str]:
    # Return which modules a fresh process has loaded after some statements, besides those of xarray
    before = "import sys, xarray.backends\nbefore = set(sys.modules)"
    loaded = f"print(*(name for name in {modules} if name in set(sys.modules) - before))"
    code = f"{before}\n{statements}\n{loaded}"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=True
    )
    return done.stdout.splitlines()[-1].split()


def test_info_of_a_store_and_a_cube_loads_nothing_heavy(store: Path, tmp_path: Path) -> None:
    np.arange(24, dtype=np.uint16).tofile(tmp_path / "raw_0")
    header = "samples = 4\nlines = 3\nbands = 2\ninterleave = bil\ndata type = 12\nbyte order = 0\n"
    spectral = "wavelength units = nm\nwavelength = {500, 600}\nfwhm = {6, 6}\ndescription = {raw counts}\n"
    (tmp_path / "raw_0.hdr").write_text(f"ENVI\n{header}{spectral};Exposure (ms): 5\n")
    ask = "from hyperpaint.cli.info_command import describe_path"
    describe = (f"print(describe_path({str(path)!r}))" for path in (store, tmp_path / "raw_0.hdr"))
    assert loaded_after("\n".join([ask, *describe])) == []


def test_a_pixel_is_read_and_a_store_is_written_without_distributed(store: Path) -> None:
    read_and_write = (
        "import xarray as xr, hyperpaint\n"
        "from hyperpaint.io.store import open_group, to_store\n"
        f"xr.open_zarr({str(store)!r}, group='flightlines/raw_0').paint.pixels(3, 4)\n"
        f"line = open_group({str(store)!r}, 'flightlines/raw_0').drop_encoding()\n"
        f"to_store(line, {str(store.with_name('copy.zarr'))!r}, 'again')"
    )
    assert "distributed" not in loaded_after(read_and_write)


def test_times_are_those_that_xarray_decodes(store: Path) -> None:
    raw = {"chunks": None, "decode_times": False, "create_default_indexes": False}
    given = open_group(store, "flightlines/raw_0", **raw)
    expected = open_group(store, "flightlines/raw_0")
    decoded = with_times(given)
    assert given["time"].dtype == np.int64
    for name in ("time", "irradiance_time"):
        np.testing.assert_array_equal(decoded[name].values, expected[name].values)
    # of another program, in another unit
    days = xr.Dataset({"t": ("x", np.array([1.0, 2.5]), {"units": "days since 2021-07-20"})})
    np.testing.assert_array_equal(
        with_times(days)["t"].values, np.array(["2021-07-21", "2021-07-22T12"], "M8[ns]")
    )
