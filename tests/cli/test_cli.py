"""The command line: exit status, messages, and that nothing half-written stays."""

import inspect
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest
import rasterio
import xarray as xr
import zarr
from click.shell_completion import ShellComplete
from click.testing import Result
from support.codecs import plain_zarr
from support.commands import hyperpaint
from support.flown_lines import EAST, MAP, NORTH, fly, located
from support.library_examples import make_library
from support.refusals import expect_error, expect_refusals, expect_words
from support.tiny_collects import tiny_collect

import hyperpaint as hp
from hyperpaint.base.facts import PARAMETERS
from hyperpaint.cli.info_command import describe_path
from hyperpaint.cli.options import Settings, parameters_of
from hyperpaint.cli.program import GROUPS, main
from hyperpaint.io.store import budget, open_group, to_store
from hyperpaint.io.store.writer import WholeRun
from hyperpaint.report import write_report
from hyperpaint.report.summaries import with_times
from hyperpaint.simulation import simulate_line
from hyperpaint.workflows import pipeline


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    # Folder of a small simulated collect
    folder = tmp_path_factory.mktemp("collect")
    hp.simulate_collect(folder, scene="plan", lines=40, bands=20, columns=8, seed=1)
    return folder


@pytest.fixture
def collect(source: Path, tmp_path: Path) -> Path:
    # A copy that a test may spoil; its ``collect.toml``
    shutil.copytree(source, tmp_path / "raw", copy_function=shutil.copy2)
    return tmp_path / "raw" / "collect.toml"


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def refused(result: Result) -> str:
    # Return the one message of a refused call, checked for form; warnings may stand before it
    assert result.exit_code == 2, result.output
    warned, error, message = result.stderr.partition("error: ")
    assert error
    assert all(line.startswith("warning: ") for line in warned.splitlines()), warned
    expect_words(
        message,
        without=("error: ", "Traceback"),
    )
    assert result.stdout == ""
    return message


# --- the program as a whole --------------------------------------------------------------------------------


def test_version_and_help_teach() -> None:
    assert hyperpaint("--version").stdout == f"hyperpaint, version {hp.__version__}\n"
    shown = hyperpaint("--help").stdout
    for command in ("demo", "simulate", "process", "info", "verify"):
        assert re.search(f"^ .* {command} ", shown, re.MULTILINE)
        assert hyperpaint(command, "--help").exit_code == 0
    assert "Exit status: 0 done, 1 the data fail a check, 2 the call or an input is wrong," in shown


def test_help_loads_nothing_heavy() -> None:
    heavy = ("numba", "zarr", "dask", "scipy", "pint", "matplotlib", "distributed")
    loaded = f"', '.join(name for name in {heavy} if name in set(sys.modules) - before)"
    before = "import sys, xarray.backends; before = set(sys.modules)"  # xarray of 2026.2 loads scipy
    code = f"{before}; import hyperpaint.cli.program; sys.exit({loaded} or 0)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr


def test_module_runs_like_the_command(tmp_path: Path) -> None:
    call = [sys.executable, "-m", "hyperpaint", "info", str(tmp_path)]
    done = subprocess.run(call, capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert done.stderr.startswith("error: ")


def test_usage_errors_exit_with_two(tmp_path: Path) -> None:
    assert hyperpaint("process").exit_code == 2
    assert hyperpaint("process", tmp_path / "none.toml", "--out", tmp_path / "s.zarr").exit_code == 2
    assert ((hyperpaint("paint").exit_code, hyperpaint("info", tmp_path / "none").exit_code)) == ((2, 2))


# --- process -----------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_process_then_again(collect: Path, tmp_path: Path) -> None:
    out = tmp_path / "lot.zarr"
    first = hyperpaint("process", collect, "--out", out, status=0)
    assert (
        first.stdout
        == f"{out}: wrote /flightlines/raw_0, /irradiance, /calibration, /references/svc, /references/asd\n"
    )
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    again = hyperpaint("process", collect, "--out", out, status=0)
    assert again.stdout.startswith(f"{out} is already complete")
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == before
    other = hyperpaint("process", collect, "--out", out, "--to", "radiance")
    assert "pass --overwrite to replace it" in refused(other)
    replaced = hyperpaint("process", collect, "--out", out, "--to", "radiance", "--overwrite", status=0)
    assert "already, from the same inputs" in replaced.stdout
    assert "radiance" in xr.open_zarr(out, group="flightlines/raw_0")


def test_warnings_are_one_line_each(collect: Path, tmp_path: Path) -> None:
    edit(collect.parent / "flight" / "settings.txt", "5.0", "4.0")
    done = hyperpaint("process", collect, "--out", tmp_path / "lot.zarr", "--to", "radiance", status=0)
    assert done.stderr.count("\n") == 1
    assert re.match(r"warning: raw_0.hdr: exposure_time 5 ms is used; settings.txt 4 ms", done.stderr)


def _resize(folder: Path, change: int) -> None:
    os.truncate(folder / "flight" / "raw_0", (folder / "flight" / "raw_0").stat().st_size + change)


def _rewrite(folder: Path, change: Callable[[xr.Dataset], xr.Dataset]) -> None:
    path = folder / "calibration.zarr"
    calibration = change(xr.open_zarr(path).load().drop_encoding())
    shutil.rmtree(path)
    plain_zarr(calibration, path)


def _no_exposure(folder: Path) -> None:
    edit(folder / "collect.toml", "exposure_time_ms = 5.0\n", "")
    (folder / "flight" / "settings.txt").unlink()
    for header in (folder / "flight").glob("*.hdr"):
        header.write_text(re.sub(r"(?im)^;.*exposure.*$", "", header.read_text()))


def _light_from_csv(folder: Path, factor: float) -> None:
    shutil.rmtree(folder / "asd")
    nm = np.arange(380, 1021, 1)
    sky = factor * 1.4 * np.exp(-(((nm - 550.0) / 300.0) ** 2))
    # a sun that climbs: records of equal bits are of a spectrometer that had stopped, and refused
    light = {
        second: ",".join(f"{value:.6g}" for value in sky * (1 + 1e-4 * second)) for second in range(18, 28, 2)
    }
    rows = [",".join(["time", *map(str, nm)])]
    rows += [f"2021-07-20T12:09:{second}-05:00,{cells}" for second, cells in light.items()]
    (folder / "sky.csv").write_text("\n".join(rows) + "\n")
    edit(folder / "collect.toml", 'files = "asd/*.asd"', 'files = "sky.csv"\nunits = "W m-2 nm-1"')


def _without_units(calibration: xr.Dataset) -> xr.Dataset:
    return calibration.assign(radiance_gain=calibration["radiance_gain"].drop_attrs())


#: What is done to a collect, and what the one message says of it.
SPOILED: dict[str, tuple[Callable[[Path], object], str]] = {
    "truncated": (lambda folder: _resize(folder, -100), r"raw_0.*bytes"),
    "longer": (lambda folder: _resize(folder, 100), r"raw_0.*bytes"),
    "fewer bands": (
        lambda folder: _rewrite(folder, lambda calibration: calibration.isel(band=slice(0, 19))),
        "20 bands.*19 bands",
    ),
    "no units": (
        lambda folder: _rewrite(folder, _without_units),
        "radiance_gain.*units",
    ),
    "no exposure": (_no_exposure, "exposure"),
    "microwatts": (
        lambda folder: _light_from_csv(folder, 1e6), "uW m-2 nm-1 that are taken for W m-2 nm-1",
    ),
    "negative exposure": (
        lambda folder: edit(folder / "collect.toml", "exposure_time_ms = 5.0", "exposure_time_ms = -5.0"),
        r"exposure_time_ms = -5\.0, expected a number above 0",
    ),
    "dark at another exposure": (
        lambda folder: edit(folder / "collect.toml", "exposure_time_ms = 5.0", "exposure_time_ms = 4.0"),
        "the dark was taken at 5 ms, the line at 4 ms",
    ),
    "clock hours off": (
        lambda folder: edit(folder / "collect.toml", "utc_offset_h = -5.0", "utc_offset_h = 0.0"),
        "utc_offset_h",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", SPOILED)
def test_bad_input_is_one_message_and_leaves_nothing(name: str, collect: Path, tmp_path: Path) -> None:
    spoil, expected = SPOILED[name]
    spoil(collect.parent)
    before = sorted(tmp_path.rglob("*"))
    message = refused(hyperpaint("process", collect, "--out", tmp_path / "lot.zarr"))
    assert re.search(expected, message, re.DOTALL), message
    assert sorted(tmp_path.rglob("*")) == before


def test_all_problems_are_listed_at_once(collect: Path, tmp_path: Path) -> None:
    patterns = ["did you mean 'stamp'"]
    for spoil, pattern in map(SPOILED.get, ("truncated", "no units", "negative exposure")):
        spoil(collect.parent)
        patterns.append(pattern)
    edit(collect, "utc_offset_h = -5.0", "utc_offset_h = 5.0")
    edit(collect, "stamp = ", "stmp = ")
    message = refused(hyperpaint("process", collect, "--out", tmp_path / "lot.zarr"))
    assert [pattern for pattern in patterns if not re.search(pattern, message, re.DOTALL)] == [], message
    assert not (tmp_path / "lot.zarr").exists()


def test_light_from_csv_is_taken_in_the_right_units(collect: Path, tmp_path: Path) -> None:
    _light_from_csv(collect.parent, 1.0)
    hyperpaint("process", collect, "--out", tmp_path / "lot.zarr", status=0)
    line = xr.open_zarr(tmp_path / "lot.zarr", group="flightlines/raw_0")
    assert 0.02 < float(line["reflectance"].load().median()) < 0.9


# --- info and verify ---------------------------------------------------------------------------------------


def test_info_tells_what_files_are(source: Path) -> None:
    told = {
        "flight/raw_0.hdr": r"ENVI cube, bil, uint16.*40 along_track x 20 band x 8 cross_track.*\[count\]",
        "flight/raw_0": r"399\.356 to 1001\.42 nm.*5 ms \(header comments\)",
        "flight/frameIndex_0.txt": "frame index.*40, number 0 to 39, 0 missing",
        "flight/imu_gps.txt": "navigation record.*2021-07-20T17:09:58",
        "flight/settings.txt": "Headwall settings.*5 ms",
        "asd/sky00000.asd": r"ASD spectrum.*irradiance.*350 to 1075 nm.*cosine receptor",
        "calibration.zarr": r"radiance_gain.*20 band x 8 cross_track.*W m-2 sr-1 nm-1 s count-1",
        "collect.toml": r"1 flight line; every file opens.*5 ms.*irradiance.*hyperpaint process",
    }
    for name, pattern in told.items():
        found = hyperpaint("info", source / name, status=0)
        assert re.search(pattern, found.stdout, re.DOTALL), found.stdout


def test_info_of_a_collect_without_light(collect: Path) -> None:
    text = collect.read_text()
    collect.write_text(text[: text.index("[irradiance]")] + text[text.index("[[flightlines]]") :])
    assert "--to radiance" in hyperpaint("info", collect).stdout


def test_info_of_what_it_does_not_know(source: Path, tmp_path: Path) -> None:
    (tmp_path / "poem.txt").write_text("roses are red")
    assert "format-unknown" in refused(hyperpaint("info", tmp_path / "poem.txt"))
    assert "format-unknown" in refused(hyperpaint("info", tmp_path))
    # the folder of a collect is that of a field day
    assert "1 raw cube" in hyperpaint("info", source).stdout


@pytest.mark.slow
def test_info_and_verify_of_a_store(collect: Path, tmp_path: Path) -> None:
    out = tmp_path / "lot.zarr"
    hp.process(collect, out, reflectance="none")
    found = hyperpaint("info", out).stdout
    assert "5 groups" in found
    assert found.count("state: complete") == 5
    assert "NOT COMPLETE" not in found
    one = hyperpaint("info", out / "flightlines" / "raw_0").stdout
    assert re.search(r"counts +40 along_track x 20 band x 8 cross_track, uint16 \[count\]", one)
    assert "whole" in hyperpaint("verify", out, status=0).stdout
    chunk = next((out / "flightlines" / "raw_0" / "counts" / "c").rglob("0"))
    while chunk.is_dir():
        chunk = chunk / "0"
    chunk.unlink()
    assert "the chunk is missing" in hyperpaint("verify", out, status=1).stdout
    assert "not a Zarr store" in refused(hyperpaint("verify", tmp_path / "nothing.zarr"))


@pytest.mark.real_data
def test_info_of_real_files(shared_data: Path) -> None:
    told = {
        "svc_sig/BNL13001_000_moc.sig": r"SVC spectrum.*HR-1024i.*982 channels.*removed @ 970, 1901 nm",
        "asd_binary/soil.asd": r"binary version 8.*white reference.*350 to 2500 nm",
        "asd_ascii/asd-e-irrad-sky.csv": "text export.*irradiance",
        "envi_sli/library_berlin.hdr": r"spectral library: 75 spectra.*75 signature x 177 band",
        "envi_cube/darkReference": r"1 along_track x 978 band x 1600 cross_track, uint16",
    }
    for name, pattern in told.items():
        found = hyperpaint("info", shared_data / name, status=0)
        assert re.search(pattern, found.stdout, re.DOTALL), found.stdout


# --- simulate ----------------------------------------------------------------------------------------------


def test_simulate_passes_its_switches_on(tmp_path: Path) -> None:
    shape = ("--scene", "plan", "--lines", 12, "--bands", 5, "--columns", 6)
    settings = ("srf_shape=slit", "smile_nm=0", "noise=no", "dropped=2", "clock_offset_s=3.5")
    effects = (word for setting in settings for word in ("--set", setting))
    done = hyperpaint("simulate", tmp_path / "sim", *shape, *effects, status=0)
    assert "hyperpaint process" in done.stdout
    truth = xr.open_zarr(tmp_path / "sim" / "truth.zarr")
    assert (
        truth.sizes["along_track"],
        truth.attrs["srf_shape"],
        int(truth["no_data"].sum()),
        float(abs(truth["wavelength_shift"]).max()),
    ) == (12, "slit", 2, 0.0)
    assert "clock_offset_s = 3.5" in (tmp_path / "sim" / "collect.toml").read_text()


def test_simulate_lists_what_is_out_of_range(tmp_path: Path) -> None:
    done = hyperpaint("simulate", tmp_path / "sim", "--set", "exposure_time_ms=-5", "--set", "sun_zenith=120")
    expect_words(refused(done), "exposure_time_ms=-5.0", "sun_zenith=120.0")
    assert not (tmp_path / "sim").exists()


def test_simulate_never_replaces_a_real_collect(collect: Path) -> None:
    shape = ("--lines", 8, "--bands", 4, "--columns", 4)
    collect.write_text(collect.read_text().replace("# simulated by hyperpaint", "# flown on 20 July"))
    before = sorted(collect.parent.rglob("*"))
    assert "raw-data-present" in refused(hyperpaint("simulate", collect.parent, *shape, "--overwrite"))
    assert sorted(collect.parent.rglob("*")) == before


# --- Options of commands: from functions, few, alike everywhere; old spellings name the new ones ---


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
def small_collect(tmp_path_factory: pytest.TempPathFactory) -> Path:
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
    number: signal.Signals, status: int, small_collect: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written: list[str] = []
    write = WholeRun.write

    def stop_at_the_second(run: WholeRun, name: str, dataset: xr.Dataset, **options: Any) -> None:
        if written:
            os.kill(os.getpid(), number)
        write(run, name, dataset, **options)
        written.append(name)

    before = signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)
    call = ["process", str(small_collect), "--out", str(tmp_path / "lot.zarr"), "--quiet"]
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
def small_store(tmp_path_factory: pytest.TempPathFactory) -> Path:
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


def test_info_of_a_store_and_a_cube_loads_nothing_heavy(small_store: Path, tmp_path: Path) -> None:
    np.arange(24, dtype=np.uint16).tofile(tmp_path / "raw_0")
    header = "samples = 4\nlines = 3\nbands = 2\ninterleave = bil\ndata type = 12\nbyte order = 0\n"
    spectral = "wavelength units = nm\nwavelength = {500, 600}\nfwhm = {6, 6}\ndescription = {raw counts}\n"
    (tmp_path / "raw_0.hdr").write_text(f"ENVI\n{header}{spectral};Exposure (ms): 5\n")
    ask = "from hyperpaint.cli.info_command import describe_path"
    describe = (f"print(describe_path({str(path)!r}))" for path in (small_store, tmp_path / "raw_0.hdr"))
    assert loaded_after("\n".join([ask, *describe])) == []


def test_a_pixel_is_read_and_a_store_is_written_without_distributed(small_store: Path) -> None:
    read_and_write = (
        "import xarray as xr, hyperpaint\n"
        "from hyperpaint.io.store import open_group, to_store\n"
        f"xr.open_zarr({str(small_store)!r}, group='flightlines/raw_0').paint.pixels(3, 4)\n"
        f"line = open_group({str(small_store)!r}, 'flightlines/raw_0').drop_encoding()\n"
        f"to_store(line, {str(small_store.with_name('copy.zarr'))!r}, 'again')"
    )
    assert "distributed" not in loaded_after(read_and_write)


def test_times_are_those_that_xarray_decodes(small_store: Path) -> None:
    raw = {"chunks": None, "decode_times": False, "create_default_indexes": False}
    given = open_group(small_store, "flightlines/raw_0", **raw)
    expected = open_group(small_store, "flightlines/raw_0")
    decoded = with_times(given)
    assert given["time"].dtype == np.int64
    for name in ("time", "irradiance_time"):
        np.testing.assert_array_equal(decoded[name].values, expected[name].values)
    # of another program, in another unit
    days = xr.Dataset({"t": ("x", np.array([1.0, 2.5]), {"units": "days since 2021-07-20"})})
    np.testing.assert_array_equal(
        with_times(days)["t"].values, np.array(["2021-07-21", "2021-07-22T12"], "M8[ns]")
    )


# --- What `describe_path` says of files and stores; the command line's own tests cover every kind of file ---


@pytest.fixture
def line() -> xr.Dataset:
    counts = np.ones((40, 3, 2), np.uint16)
    return xr.Dataset(
        {
            "counts": (("along_track", "band", "cross_track"), counts, {"units": "count"}),
            "exposure_time": ((), 0.005, {"units": "s"}),
            "read_noise": ((), np.float32(2.0), {"units": "count"}),
        },
        {"wavelength": ("band", [450.0, 550.0, 650.0], {"units": "nm"})},
        {"exposure_source": "collect.toml"},
    )


def test_groups_say_whether_they_are_complete(tmp_path: Path, line: xr.Dataset) -> None:
    hp.to_store(line, tmp_path / "lot.zarr", "flightlines/raw_0")
    expect_words(
        describe_path(tmp_path / "lot.zarr"),
        "1 group with arrays",
        "state: complete, written 20",
        "counts: 40 along_track x 3 band x 2 cross_track, uint16 [count]",
        "wavelength: 450 to 650 nm",
        "exposure: 5 ms (collect.toml)",
        "also holds: read_noise",
    )
    hp.to_store(line, tmp_path / "damaged.zarr")
    next((tmp_path / "damaged.zarr/counts/c").rglob("*/0/0")).unlink()
    assert "NOT COMPLETE: " in describe_path(tmp_path / "damaged.zarr")
    # a copy without a manifest, and a store of another program
    plain_zarr(line.assign_attrs(hyperpaint_version="0.1"), tmp_path / "copy.zarr")
    plain_zarr(line, tmp_path / "other.zarr")
    unknown = "not in a manifest, so that completeness is unknown; written at an unknown time by another"
    expect_words(describe_path(tmp_path / "copy.zarr"), "not in a manifest", without=("another program",))
    expect_words(describe_path(tmp_path / "other.zarr"), unknown, without=("NOT COMPLETE",))
    expect_refusals(
        (hp.FormatError, "file-not-found", lambda: describe_path(tmp_path / "none")),
        (hp.StoreError, "format-unknown", lambda: describe_path(tmp_path)),
    )


def test_the_simulators_stores(tmp_path: Path) -> None:
    two_lines = hp.simulate_collect(tmp_path / "sim", scene="plan", lines=8, bands=4, columns=4)
    for name in ("calibration.zarr", "truth.zarr"):
        assert "not in a manifest" in describe_path(two_lines.parent / name)
    assert "5 ms (collect.toml)" in describe_path(two_lines)


@pytest.mark.parametrize("name", ["paints.sli", "paints.csv", "paints.zarr"])
def test_a_paint_library(tmp_path: Path, name: str) -> None:
    path = hp.write_library(make_library().isel(band=[0, 1, 4]), tmp_path / name)
    text = describe_path(path)
    expect_words(text, "Grün; Grün", "reflectance", "400 to 800 nm")
    if path.suffix != ".zarr":
        expect_words(text, "5 spectra", "make")


def test_a_folder_of_texts_of_single_spectra() -> None:
    folder = Path(__file__).parents[1] / "io" / "library" / "conformance" / "ecostress"
    assert "3 spectra" in describe_path(folder)


# --- `verify`, `info` and `report` of a store that is not whole: what it lacks, and how to finish it ---


@pytest.fixture
def two_lines(tmp_path: Path) -> Path:
    return tiny_collect(tmp_path / "raw", 2)


def test_an_unfinished_store_says_how_it_is_finished(
    two_lines: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, write = tmp_path / "lot.zarr", WholeRun.write

    def stop(self: WholeRun, group: str, dataset: xr.Dataset, **options: Any) -> None:
        if group.endswith("raw_1"):
            raise KeyboardInterrupt
        write(self, group, dataset, **options)

    monkeypatch.setattr(WholeRun, "write", stop)
    expect_error(KeyboardInterrupt, None, lambda: hp.process(two_lines, out, to="radiance"))
    again = "unfinished: 1 of 2 groups are written, without /flightlines/raw_1; to finish it"
    for command, status in (("verify", 1), ("info", 0)):
        expect_words(hyperpaint(command, out, status=status).output, again, f"--out {out} --to radiance")
    page = write_report(out, tmp_path / "report.html")
    assert page.flightlines == ("flightlines/raw_0",)
    assert again[:40] in page.problems[0]


def test_inputs_are_compared_on_request(two_lines: Path, tmp_path: Path) -> None:
    out = hp.process(two_lines, tmp_path / "lot.zarr", to="radiance")
    assert "all unchanged" in hyperpaint("verify", out, "--inputs", status=0).output
    two_lines.with_name("raw_0").write_bytes(bytes(two_lines.with_name("raw_0").stat().st_size))
    changed = hyperpaint("verify", out, "--collect", two_lines, status=1).output
    assert "/flightlines/raw_0: its inputs have changed" in changed
    hyperpaint("verify", out, status=0)


# --- `info` and `report` of maps, regions and folders, as text and as JSON ----------------------------------


SQUARE = np.array([(EAST, NORTH), (EAST + 1, NORTH), (EAST + 1, NORTH + 1), (EAST, NORTH + 1)])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("maps")
    flown = fly(40, 30, "none", heading=30.0)
    values = np.random.default_rng(0).random((40, 6, 30)).astype(np.float32)
    line = located(flown, reflectance=(("along_track", "band", "cross_track"), values, {"units": "1"}))
    line = line.assign_coords(wavelength=("band", np.linspace(450.0, 700.0, 6), {"units": "nm"}))
    hp.to_store(hp.geometry.orthorectify(line, 0.01), folder / "map.zarr")
    hp.to_store(hp.geometry.orthorectify(line, 0.01, grid="flight"), folder / "turned.zarr")
    hp.write_regions(
        hp.Regions((hp.Region("hood", SQUARE, properties={"make": "x"}),), "map", MAP), folder / "r.geojson"
    )
    return folder


def run_of(*words: object) -> str:
    return hyperpaint(*words, status=0).output


def facts(path: Path) -> dict[str, Any]:
    # Return what `info --json` says; the same as the text does
    document: dict[str, Any] = json.loads(run_of("info", path, "--json"))
    text = run_of("info", path)
    for name, value in document.items():
        for part in value if isinstance(value, list) else [value]:
            assert part in text, name
    return document


def test_info_of_maps(folder: Path) -> None:
    facts(folder / "map.zarr")
    expect_words(
        run_of("info", folder / "map.zarr"), "WGS 84 / UTM zone 17N", "0.01 x 0.01 map units, north up"
    )
    turned = re.search(r"up is ([0-9.]+) degrees from north", run_of("info", folder / "turned.zarr"))
    assert turned is not None
    assert float(turned[1]) == pytest.approx(30.0, abs=0.1)


def test_info_of_a_geotiff(folder: Path, tmp_path: Path) -> None:
    path = hp.io.write_geotiff(hp.open_store(folder / "map.zarr"), tmp_path / "map.tif")
    document = facts(path)
    with rasterio.open(path) as raster:
        assert document["map"] == f"{raster.height} x {raster.width} cells, 6 bands, float32"
        bounds = raster.bounds
    assert (
        document["bounds"]
        == f"x {bounds.left:.10g} to {bounds.right:.10g}, y {bounds.bottom:.10g} to {bounds.top:.10g}"
    )
    assert (document["wavelength"], document["crs"]) == ("450 to 700 nm", "WGS 84 / UTM zone 17N")
    # what only calls itself so, and would have GDAL read another file
    trap = tmp_path / "trap.tif"
    source = f"<SimpleSource><SourceFilename>{path}</SourceFilename></SimpleSource>"
    band = f'<VRTRasterBand dataType="Byte" band="1">{source}</VRTRasterBand>'
    trap.write_text(f'<VRTDataset rasterXSize="9" rasterYSize="9">{band}</VRTDataset>')
    assert "not a TIFF" in hyperpaint("info", trap, status=2).output


def test_info_of_regions(folder: Path) -> None:
    document = facts(folder / "r.geojson")
    assert (document["is"], (document["names"], document["crs"], document["also says"])) == (
        "1 region in coordinates of the map",
        ("hood", MAP, "make"),
    )


def test_info_of_a_field_folder(tmp_path: Path) -> None:
    document = facts(
        hp.simulate_collect(tmp_path / "day", scene="plan", lines=8, bands=8, columns=6, truth=False).parent
    )
    assert document["is"].startswith("folder of a field day: 1 raw cube")
    assert any("frame index" in str(text) for text in document.values())
    empty = tmp_path / "empty"
    empty.mkdir()
    assert "format-unknown" in hyperpaint("info", empty, status=2).output


@pytest.mark.parametrize(
    ("name", "head", "expected"),
    [
        ("a.nc", b"\x89HDF\r\n\x1a\n", "xr.open_dataset"),
        ("a.xlsx", b"PK\x03\x04", "save the sheet as CSV"),
        ("a.pdf", b"%PDF-1.7", "a PDF"),
        ("a.fits", b"SIMPLE  =", "astropy"),
        ("a.mat", b"MATLAB 5.0 MAT-file", "scipy.io.loadmat"),
    ],
)
def test_files_of_other_programs_are_named(tmp_path: Path, name: str, head: bytes, expected: str) -> None:
    (tmp_path / name).write_bytes(head + b"\0" * 40)
    expect_refusals((hp.FormatError, "format-unknown", expected, lambda: describe_path(tmp_path / name)))


def test_a_report_of_a_map(folder: Path, tmp_path: Path) -> None:
    assert "map map.zarr" in run_of("report", folder / "map.zarr", "--out", tmp_path / "map.html", "--quiet")
    page = (tmp_path / "map.html").read_text()
    expect_words(page, "WGS 84 / UTM zone 17N", without=("could not be shown",))
    assert page.count("data:image/png") >= 2  # true colour, and how reflectance is spread


@pytest.mark.parametrize("package", ["pyogrio", "fiona"])
def test_regions_of_a_geopackage(
    folder: Path, tmp_path: Path, package: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip(package)
    import importlib.util

    drawn = hp.read_regions(folder / "r.geojson")
    path = tmp_path / "r.gpkg"
    if package == "pyogrio":
        import pyogrio
        import shapely

        shapes = np.array([shapely.to_wkb(shapely.Polygon(one.polygon)) for one in drawn])
        columns = [np.array(["hood"], object), np.array(["x"], object)]
        pyogrio.raw.write(
            path, shapes, columns, np.array(["name", "make"]), crs=MAP, geometry_type="Polygon", layer="cars"
        )
    else:
        import fiona

        schema = {"geometry": "Polygon", "properties": {"name": "str", "make": "str"}}
        with fiona.open(path, "w", driver="GPKG", crs=MAP, schema=schema, layer="cars") as layer:
            layer.writerecords([one.feature() for one in drawn])
    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: found(name) if name == package else None)
    read = hp.read_regions(path)
    assert read.coordinates == "map"
    np.testing.assert_allclose(np.sort(read[0].polygon, axis=0), np.sort(drawn[0].polygon, axis=0))
    assert (read[0].name, dict(read[0].properties)["make"]) == ("hood", "x")
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    expect_error(hp.errors.MissingExtraError, "extra-missing", lambda: hp.read_regions(path))
    path.write_text("<OGRVRTDataSource/>")
    expect_error(hp.FormatError, r"no gpkg file", lambda: hp.read_regions(path))
