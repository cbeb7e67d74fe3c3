"""Names that no door may open: each is refused in words, at once."""

import contextlib
import errno
import glob
import json
import os
import signal
import socket
import struct
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, strategies as st
from support.files import write_file
from support.refusals import expect_error, expect_errors, expect_refusals
from support.tensor_files import rough_brdf, write_tensors

import hyperpaint as hp
from hyperpaint.base.errors import FormatError, PaintError, StoreError
from hyperpaint.base.input_files import head_of, input_path, open_input, read_limited
from hyperpaint.io.files import publishing
from hyperpaint.io.files.publishing import check_place, publish_file, published_files, published_folder
from hyperpaint.io.files.reading import is_pattern, matching_files
from hyperpaint.io.store.writer import staging


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
    path = write_file(tmp_path / "sky.csv", b"time,550\n")
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
    expect_refusals((FormatError, "file-special", "a pipe", "a series", lambda: open_input(pipe, "a series")))
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
    expect_error(
        ValueError, "more than 5000 files", lambda: matching_files(folder, "*/" * 30 + "*.asd", most=5000)
    )


# --- Files and folders appear whole or not at all, and nothing of others is replaced ---


HERE = Path(__file__).parent


def no_foreign(_: Path) -> str:
    return ""


def test_a_file_is_replaced_only_where_asked(tmp_path: Path) -> None:
    path = tmp_path / "new" / "page.html"
    publish_file(path, b"one", overwrite=False)
    expect_errors((StoreError, "file-exists", lambda: publish_file(path, b"two", overwrite=False)))
    assert path.read_bytes() == b"one"
    publish_file(path, b"two", overwrite=True)
    assert path.read_bytes() == b"two"
    assert [found.name for found in path.parent.iterdir()] == ["page.html"]


def test_a_file_that_appears_meanwhile_stays(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"

    def write() -> None:
        with published_files([path], overwrite=False) as (written,):
            written.write_bytes(b"ours")
            path.write_bytes(b"theirs")

    expect_errors((StoreError, "exists", write))
    assert path.read_bytes() == b"theirs"
    assert [found.name for found in tmp_path.iterdir()] == ["table.csv"]


def test_what_fails_leaves_what_was_there(tmp_path: Path) -> None:
    path, folder = tmp_path / "table.csv", tmp_path / "spectra"
    publish_file(path, b"old", overwrite=False)
    folder.mkdir()
    (folder / "old.txt").write_bytes(b"old")

    def write_file() -> None:
        with published_files([path], overwrite=True) as (written,):
            written.write_bytes(b"half")
            raise KeyboardInterrupt

    def write_folder() -> None:
        with published_folder(folder, overwrite=True, foreign=no_foreign) as build:
            (build / "new.txt").write_bytes(b"half")
            raise KeyboardInterrupt

    for write in (write_file, write_folder):
        expect_error(KeyboardInterrupt, None, write)
    assert path.read_bytes() == b"old"
    assert [found.name for found in folder.iterdir()] == ["old.txt"]
    assert sorted(found.name for found in tmp_path.iterdir()) == ["spectra", "table.csv"]


def test_a_missing_file_of_a_product_is_told(tmp_path: Path) -> None:
    targets = [tmp_path / "values.bin", tmp_path / "values.hdr"]
    with (
        pytest.raises(StoreError, match="file-unwritable"),
        published_files(targets, overwrite=False) as (values, _),
    ):
        values.write_bytes(b"values")
    assert list(tmp_path.iterdir()) == []


def test_a_folder_of_others_is_never_replaced(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    folder.mkdir()
    with published_folder(folder, overwrite=False, foreign=no_foreign) as build:  # it is empty
        (build / "a.txt").write_bytes(b"a")
    link = tmp_path / "link"
    link.symlink_to(folder)
    for target, overwrite, foreign, code in (
        (folder, True, lambda _: "a thesis", "folder-occupied"),
        (folder, False, no_foreign, "file-exists"),
        (link, True, no_foreign, "path-not-folder"),
    ):
        with (
            pytest.raises(StoreError, match=code),
            published_folder(target, overwrite=overwrite, foreign=foreign),
        ):
            pytest.fail("entered")
    with published_folder(folder, overwrite=True, foreign=no_foreign) as build:
        (build / "b.txt").write_bytes(b"b")
    assert [found.name for found in folder.iterdir()] == ["b.txt"]


# --- several files -----------------------------------------------------------------------------------------


WHOLE = ["map.geojson", "map.json", "map.tif", "seams"]


def own_places(home: Path) -> list[Path]:
    # Return the places of a map: its item beside it, its seamlines in another folder, the map itself
    return [home / "map.json", home / "seams" / "map.geojson", home / "map.tif"]


def write(home: Path, text: str) -> None:
    with published_files(own_places(home), overwrite=True) as news:
        for new in news:
            new.write_text(text)


def texts(home: Path) -> list[str | None]:
    return [path.read_text() if path.exists() else None for path in own_places(home)]


def names(home: Path) -> list[str]:
    return sorted(path.name for path in home.rglob("*"))


def failing(function: Callable[..., None], step: int) -> Callable[..., None]:
    # Return a function whose call number ``step`` fails, as on a disk that is full for a moment
    left = [step]

    def call(*arguments: Any, **options: Any) -> None:
        left[0] -= 1
        if left[0] == -1:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        function(*arguments, **options)

    return call


@pytest.mark.parametrize("links", [True, False])
@pytest.mark.parametrize(
    ("there", "name", "step"),
    [
        *((there, name, at) for there in (True, False) for name in ("rename", "replace") for at in (0, 1)),
        *((True, "rename", 2), (True, "rename", 3), (False, "rename", 2)),
    ],
)  # fmt: skip
def test_a_failing_rename_brings_the_old_files_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, there: bool, name: str, step: int, links: bool
) -> None:
    if there:
        write(tmp_path, "old")
    before = texts(tmp_path)
    with monkeypatch.context() as patched:
        if not links:
            patched.setattr(publishing.os, "link", failing(lambda *_: None, 0))
        patched.setattr(publishing.os, name, failing(getattr(os, name), step))
        expect_errors((StoreError, "disk-full", lambda: write(tmp_path, "new")))
    assert texts(tmp_path) == before
    assert not [found for found in names(tmp_path) if found.startswith(".partial")]
    write(tmp_path, "new")
    assert (texts(tmp_path), names(tmp_path)) == (["new"] * 3, WHOLE)


def killed(home: Path, call: int) -> bool:
    # Write in a process that ends before a call that changes files; return whether there was such a call
    child = os.fork()
    if not child:
        left = [call]

        def hook(event: str, arguments: tuple[Any, ...]) -> None:
            writes = event == "open" and isinstance(arguments[2], int) and arguments[2] & os.O_CREAT
            if writes or event in ("os.rename", "os.link", "os.mkdir", "os.rmdir", "os.remove"):
                left[0] -= 1
                if not left[0]:
                    os._exit(9)

        sys.addaudithook(hook)
        write(home, "new")
        os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 9


def judge_kills(home: Path) -> list[str]:
    # Kill a writer before each call, and return what is wrong with what is there then
    wrong, call = [], 0
    for there in (True, False):
        for call in range(1, 1000):
            folder = home / f"{there} {call}"
            folder.mkdir()
            if there:
                write(folder, "old")
            old = ["old"] * 3 if there else [None] * 3
            if not killed(folder, call):
                break
            found = texts(folder)
            if found[-1] is not None and found not in (old, ["new"] * 3):
                wrong.append(f"there {there}, call {call}: {found} can be opened")
            if call % 2:
                check_place(own_places(folder)[-1], "the map", example="map.tif", overwrite=True)
                if texts(folder) not in (old, ["new"] * 3) or any(folder.glob(".partial*")):
                    wrong.append(f"there {there}, call {call}: {names(folder)} are there after the check")
            write(folder, "newer")
            if texts(folder) != ["newer"] * 3 or names(folder) != [
                "map.geojson",
                "map.json",
                "map.tif",
                "seams",
            ]:
                wrong.append(f"there {there}, call {call}: {names(folder)} are there after the rerun")
    return [*wrong, f"{call} calls"]


def test_a_kill_at_any_call_leaves_no_mixed_product() -> None:
    # In a process of its own, which has no threads when it forks
    code = (
        f"import json, pathlib, sys; sys.path[:0] = {[str(HERE), str(HERE.parents[1])]!r}\n"
        "import test_input_files; print(json.dumps(test_input_files.judge_kills(pathlib.Path(sys.argv[1]))))"
    )
    memory = Path("/dev/shm")  # hundreds of flushes
    with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as home:
        run = subprocess.run([sys.executable, "-c", code, home], capture_output=True, check=True)
    *wrong, count = json.loads(run.stdout)
    assert wrong == []
    assert int(count.split()[0]) > 30


def planted(home: Path) -> Path:
    # Return a folder like that of a swap that was cut short
    with staging(home / "map.tif") as stage:
        swap = stage.folder / "swap"
        swap.mkdir()
    return swap


@pytest.mark.parametrize(
    "journal", ["{", "[]", "[7]", '[[".", ".."]]', '[[".", "a/b"]]', '[["..", ""]]', "[" * 100_000]
)
def test_a_planted_journal_is_refused(tmp_path: Path, journal: str) -> None:
    write(tmp_path, "old")
    (planted(tmp_path) / "journal").write_text(journal)
    expect_errors((StoreError, "staging-foreign", lambda: write(tmp_path, "new")))
    assert texts(tmp_path) == ["old"] * 3


def test_a_planted_journal_reaches_no_other_folder(tmp_path: Path) -> None:
    write(tmp_path, "old")
    swap = planted(tmp_path)
    (swap / "1").mkdir()
    (swap / "1" / "map.tif").write_text("planted")
    (swap / "0.old").write_text("planted")
    (swap / "journal").write_text(json.dumps([["seams", "map.geojson"], [".", "map.tif"]]))
    check_place(tmp_path / "map.tif", "the map", example="map.tif", overwrite=True)
    assert (texts(tmp_path), names(tmp_path)) == (["old"] * 3, WHOLE)


def test_what_is_no_plain_file_is_never_replaced(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    expect_error(StoreError, "file-not-plain", lambda: publish_file(tmp_path / "pipe", b"", overwrite=True))


# --- Files of the RGL material database, written here after their layout, and what they must not claim ---


def test_tensors_are_read_with_dims_and_units(tmp_path: Path) -> None:
    tensors = rough_brdf(azimuths=3)
    brdf = hp.io.read_rgl(write_tensors(tmp_path / "paint.bsdf", tensors))
    for name in ("ndf", "sigma", "vndf", "luminance", "spectra"):
        np.testing.assert_array_equal(brdf[name], tensors[name])
        assert brdf[name].dtype == np.float32
    assert brdf.spectra.dims == ("light_azimuth", "light_zenith", "wavelength", "sample_v", "sample_u")
    np.testing.assert_allclose(brdf.light_azimuth, [-180.0, 0.0, 180.0], atol=1e-4)
    np.testing.assert_allclose(brdf.wavelength, tensors["wavelengths"])
    units = [brdf[name].attrs["units"] for name in ("light_zenith", "wavelength", "ndf", "spectra")]
    assert units == ["degree", "nm", "sr-1", "1"]
    assert (brdf.attrs["description"], brdf.attrs["jacobian"]) == ("rough paint", 1)


def _changed(
    name: str, change: Callable[[np.ndarray], np.ndarray]
) -> Callable[[dict[str, Any]], dict[str, Any]]:
    return lambda tensors: {**tensors, name: change(tensors[name])}


#: By code: changes of the tensors that it refuses.
WRONG: dict[str, list[Callable[[dict[str, Any]], dict[str, Any]]]] = {
    "tensor-missing": [lambda tensors: {k: v for k, v in tensors.items() if k != "sigma"}],
    "spectra-missing": [lambda tensors: {("rgb" if k == "spectra" else k): v for k, v in tensors.items()}],
    "tensor-type": [_changed("ndf", lambda ndf: ndf.astype("<f8"))],
    "tensor-shape": [
        _changed("ndf", lambda ndf: ndf[0]),
        _changed("ndf", lambda ndf: ndf[:1]),
        _changed("spectra", lambda spectra: spectra[:, :, 1:]),
        _changed("jacobian", lambda flag: np.repeat(flag, 2)),
    ],
    "tensor-empty": [_changed("ndf", lambda ndf: ndf[:0])],
    "tensor-rank": [_changed("ndf", lambda ndf: ndf[(None,) * 7])],
    "tensor-count": [lambda tensors: tensors | {f"n{k}": tensors["jacobian"] for k in range(64)}],
    "not-finite": [_changed("spectra", lambda spectra: np.full_like(spectra, np.nan))],
    "value-out-of-range": [
        _changed("theta_i", lambda angle: angle + np.float32(1.0)),
        _changed("wavelengths", lambda micron: micron / np.float32(1000.0)),
    ],
    "order-wrong": [_changed("theta_i", lambda angle: angle[::-1].copy())],
    "density-wrong": [
        _changed("ndf", lambda ndf: -ndf),
        _changed("vndf", lambda vndf: vndf * (np.arange(5.0, dtype="<f4") > 0)[:, None, None]),
    ],
}


@pytest.mark.parametrize("code", WRONG)
def test_wrong_tensors_are_refused(tmp_path: Path, code: str) -> None:
    for change in WRONG[code]:
        path = write_tensors(tmp_path / "paint.bsdf", change(rough_brdf()))
        expect_refusals((FormatError, code, "paint.bsdf", partial(hp.io.read_rgl, path)))


def test_headers_that_lie_are_refused(tmp_path: Path) -> None:
    data = write_tensors(tmp_path / "paint.bsdf", rough_brdf()).read_bytes()
    place = data.index(b"spectra") + len(b"spectra")  # rank, type, offset and shape of the largest tensor
    path = tmp_path / "wrong.bsdf"
    for code, wrong in {
        "format-unknown": b"X" + data[1:],
        "format-version": data[:12] + b"\x02" + data[13:],
        "header-truncated": data[:30],
        "file-truncated": data[:-1],
        "file-truncated ": data[: place + 11] + struct.pack("<Q", 2**62) + data[place + 19 :],
        "tensor-type": data[: place + 2] + b"\x63" + data[place + 3 :],
        "tensor-repeated": data.replace(b"theta_i", b"version", 1),
    }.items():
        path.write_bytes(wrong)
        expect_refusals((FormatError, code.strip(), lambda: hp.io.read_rgl(path)))


@given(st.data())
def test_no_header_crashes(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    folder = tmp_path_factory.mktemp("rgl")
    original = write_tensors(folder / "paint.bsdf", rough_brdf()).read_bytes()
    changed = bytearray(original[: data.draw(st.integers(30, len(original)))])
    for _ in range(data.draw(st.integers(0, 4))):
        changed[data.draw(st.integers(0, min(len(changed), 500) - 1))] = data.draw(st.integers(0, 255))
    path = write_file(folder / "changed.bsdf", bytes(changed))
    with contextlib.suppress(FormatError):  # any other error fails
        hp.io.read_rgl(path)
