"""Names that no door may open: each is refused in words, at once."""

import glob
import os
import signal
import socket
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import xarray as xr
from support.refusals import expect_error, expect_errors, expect_refusals, refusal

import hyperpaint as hp
from hyperpaint.base.errors import FormatError, PaintError
from hyperpaint.base.input_files import head_of, input_path, open_input, read_limited
from hyperpaint.io.files.reading import is_pattern, matching_files


def _navigation(kind: str) -> Callable[[Any], object]:
    return lambda path: hp.open_navigation(path, format=kind, week=2158, date="2021-05-20")


def _flightline(name: str) -> Callable[[Any], object]:
    def read(path: Any) -> object:
        given = {"cube": "raw_0.hdr", "frame_index": None, "nav": None, "dark": None, "calibration": None}
        given |= {name: path}
        return hp.open_flightline(given.pop("cube"), **given)

    return read


def _of(module: str, name: str, **options: Any) -> Callable[[Any], object]:
    def read(path: Any) -> object:
        return getattr(__import__(f"hyperpaint.{module}", fromlist=[name]), name)(path, **options)

    return read


#: Every function that opens what a user names: by name, with the suffix of such files.
DOORS: dict[str, tuple[Callable[[Any], object], str]] = {
    "open_asd": (hp.open_asd, ".asd"),
    "open_asd of text": (hp.open_asd, ".txt"),
    "open_svc": (hp.open_svc, ".sig"),
    "open_irradiance": (hp.open_irradiance, ".csv"),
    "open_irradiance of netCDF": (hp.open_irradiance, ".nc"),
    "open_library": (hp.open_library, ".txt"),
    "open_library of csv": (hp.open_library, ".csv"),
    "open_library of ENVI": (hp.open_library, ".hdr"),
    "open_library of DIRSIG": (hp.open_library, ".ems"),
    "wavelength= of open_library": (lambda path: hp.open_library("x.txt", wavelength=path), ".txt"),
    "references": (_of("io.spectrometers.reference_files", "read_pairs"), ".csv"),
    "open_references": (
        lambda path: _of("io.spectrometers.reference_files", "open_references")([path]), ".sig"
    ),
    "radcal": (_of("io", "read_radcal"), ".txt"),
    "certificate": (_of("io", "read_certificate"), ".csv"),
    "factors of a panel": (_of("io", "read_panel_table"), ".csv"),
    "materials": (_of("io.dirsig", "read_materials"), ".mat"),
    "emissivity": (_of("io.dirsig", "open_emissivity"), ".ems"),
    "uvspec": (_of("io", "read_uvspec", sun_zenith=60.0, units="mW m-2 nm-1"), ".out"),
    "tape7": (_of("io", "read_tape7", sun_zenith=60.0, ground=0.3), ""),
    "6S": (lambda path: hp.io.read_sixs([path], sun_zenith=60.0), ".txt"),
    "sky csv": (_of("io", "read_sky_csv"), ".csv"),
    "rgl": (_of("io", "read_rgl"), ".bsdf"),
    **{f"{kind} navigation": (_navigation(kind), f".{kind}")
       for kind in ("imu_gps", "sbet", "lcf", "eph_att", "csv", "nmea")},
    "open_navigation": (hp.open_navigation, ".txt"),
    "gps_time": (_of("io.navigation.navigation_records", "read_gps_time"), ".txt"),
    "control points": (_of("io", "read_control_points"), ".csv"),
    "frame index": (_of("io.flightline.side_files", "read_frame_index"), ".txt"),
    "settings": (_of("io.flightline.side_files", "read_settings"), ".txt"),
    "cube of a flight line": (_flightline("cube"), ".hdr"),
    "ENVI header": (lambda path: xr.open_dataset(path, engine="envi"), ".hdr"),
    "ENVI data": (lambda path: xr.open_dataset(path, engine="envi"), ".img"),
    "engine asd": (lambda path: xr.open_dataset(path, engine="asd"), ".asd"),
    "engine svc": (lambda path: xr.open_dataset(path, engine="svc"), ".sig"),
    "calibration": (_of("io.flightline.side_files", "open_calibration"), ".nc"),
    "sweep": (_of("io.flightline.side_files", "open_sweep"), ".nc"),
    "open_collect": (hp.open_collect, ".toml"),
    "process": (lambda path: hp.process(path, "never.zarr"), ".toml"),
    "scene": (_of("workflows.rendering", "read_scene_file"), ".toml"),
    "spectra of a scene": (_of("workflows.rendering", "read_spectra"), ".txt"),
    "regions": (hp.read_regions, ".geojson"),
    "regions of a GeoPackage": (hp.read_regions, ".gpkg"),
    "GeoTIFF": (_of("io.maps.map_grids", "read_geotiff_header"), ".tif"),
    "heights": (_of("io.maps.map_grids", "read_heights"), ".tif"),
    **{f"mesh {suffix}": (_of("simulation.rendering.mesh_files", "read_mesh"), suffix)
       for suffix in (".obj", ".glb", ".ply")},
    **{f"info{suffix}": (_of("cli.info_command", "describe_path"), suffix)
       for suffix in (".txt", ".hdr", "")},
    "simulate_collect": (_of("simulation", "simulate_collect", lines=8, scene="plan"), ""),
    "write_sweep": (_of("simulation", "write_sweep", steps=3, bands=4, columns=4), ".zarr"),
    "store": (hp.open_store, ".zarr"),
    "verify a store": (hp.verify, ".zarr"),
}  # fmt: skip


WORDS = {
    "pipe": "pipe", "device": "device", "socket": "socket", "NUL": "NUL", "over-long": "at most 255 bytes",
    "chained": "URL", "URL": "URL",
}  # fmt: skip


@pytest.fixture
def places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str, str], str]]:
    # Return what gives the name of a kind with a suffix, in a folder where short names suffice
    monkeypatch.chdir(tmp_path)
    sockets = []

    def place(kind: str, suffix: str) -> str:
        name = f"bait{suffix}"
        if kind == "pipe":
            os.mkfifo(name)
        elif kind == "device":
            os.symlink("/dev/zero", name)
        elif kind == "socket":
            sockets.append(socket.socket(socket.AF_UNIX))
            sockets[-1].bind(name)
        elif kind == "NUL":
            return f"ba\0it{suffix}"
        elif kind == "over-long":
            return "b" * 300 + suffix
        else:
            return f"{'dask::memory' if kind == 'chained' else 'https'}://127.0.0.1:9/bait{suffix}"
        return name

    yield place
    for each in sockets:
        each.close()


@pytest.fixture
def _impatient() -> Iterator[None]:
    def stop(*_: Any) -> None:
        raise TimeoutError("it waits")

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, 10.0)
    yield
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    signal.signal(signal.SIGALRM, before)


@pytest.mark.usefixtures("_impatient")
@pytest.mark.parametrize("kind", WORDS)
@pytest.mark.parametrize("door", DOORS)
def test_a_door_refuses_what_is_no_plain_file(
    door: str, kind: str, places: Callable[[str, str], str]
) -> None:
    read, suffix = DOORS[door]
    error = expect_error(PaintError, None, lambda: read(places(kind, suffix)))
    assert str(error)
    # stores have words of their own, and URLs are taken for stores
    assert WORDS[kind] in str(error) or "store" in door or kind == "URL"


def test_a_plain_file_is_read(tmp_path: Path) -> None:
    path = tmp_path / "sky.csv"
    path.write_bytes(b"time,550\n")
    assert (input_path(path), read_limited(path, 9, "a series")) == (path, b"time,550\n")
    assert head_of(path, 4) == b"time"
    expect_refusals(
        (
            FormatError,
            "file-too-large",
            "9 bytes",
            "a series of at most 8 bytes",
            lambda: read_limited(path, 8, "a series"),
        ),
        (FormatError, "file-special", "a folder", "a series", lambda: open_input(tmp_path, "a series")),
        (
            FormatError,
            "file-unreadable",
            "No such file",
            lambda: open_input(tmp_path / "other.csv", "a series"),
        ),
    )


def test_a_file_that_turns_into_a_pipe_is_not_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    monkeypatch.setattr("hyperpaint.base.input_files.input_path", lambda path, *_, **__: Path(path))
    with refusal(FormatError, "file-special", "a pipe", "a series"):
        open_input(pipe, "a series")
    assert head_of(pipe, 4) == b""


def test_a_folder_whose_name_reads_like_a_url_is_a_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "field::day1").mkdir()
    (tmp_path / "field::day1" / "sky.txt").write_text("1")
    assert read_limited("field::day1/sky.txt", 10, "a text") == b"1"
    expect_errors(
        (FormatError, "a chained URL", lambda: input_path("other::day1/sky.txt")),
        (FormatError, "file-unreadable", lambda: read_limited("a\ud800b", 10, "a text")),
    )


# --- Patterns find what glob finds, within bounds ----------------------------------------------------------


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("a.asd", "b.asd", "c.txt", "x/a.asd", "x/y/a.asd", "x/y/[1].asd", ".h/a.asd", "x/.h.asd"):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    return tmp_path


@pytest.mark.parametrize(
    "pattern",
    ["*.asd", "?.asd", "[ab].asd", "[!a].asd", "x/*.asd", "*/*.asd", "**/*.asd", "x/**/*.asd", "**/y/*", "*/",
     "**/[[]1].asd", "./*.asd", "x/./*.asd", "nothing/*.asd", "*.nothing", ".h/*", ".*/*.asd", "**/.h.asd"],
)  # fmt: skip
def test_finds_what_glob_finds(pattern: str, folder: Path) -> None:
    expected = sorted({folder / name for name in glob.glob(pattern, root_dir=folder, recursive=True)})
    if pattern == "*/":  # files are not told from folders
        expected = sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    assert matching_files(folder, pattern) == expected


@pytest.mark.parametrize("pattern", ["/*", "../*", "x/../../*", "/**/*.asd", "*\0", "*" * 2000])
def test_refuses_what_leads_out(pattern: str, folder: Path) -> None:
    expect_errors((ValueError, "expected a pattern", lambda: matching_files(folder, pattern)))


def test_links_are_not_walked_without_end(folder: Path) -> None:
    assert list(map(is_pattern, ("a*", "[a]", "?", "raw_0.hdr"))) == [True, True, True, False]
    for name in ("p", "q"):
        (folder / name).symlink_to(".")
    assert folder / "p/a.asd" in matching_files(folder, "*/*.asd")  # a link named by one part is followed
    assert folder / "p/a.asd" not in matching_files(folder, "**/*.asd")
    with pytest.raises(ValueError, match="more than 5000 files"):
        matching_files(folder, "*/" * 30 + "*.asd", most=5000)
