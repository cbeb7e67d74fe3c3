"""The command line: exit status, messages, and that nothing half-written stays."""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from click.testing import Result
from support.codecs import plain_zarr
from support.commands import hyperpaint
from support.refusals import expect_words

import hyperpaint as hp


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
