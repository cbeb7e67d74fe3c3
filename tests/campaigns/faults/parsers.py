"""Mutated inputs: a parser may refuse a file with its own error, within a second and 256 MB, or read it."""

from __future__ import annotations

import contextlib
import importlib
import os
import resource
import shutil
import signal
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hyperpaint.base.errors import (
    CollectError,
    FormatError,
    PaintError,
    PaintWarning,
    SchemaError,
    TimeError,
    UnitsError,
)

from .mutation import mutated
from .outcome import MOST_BYTES, MOST_SECONDS, Outcome, in_parallel
from .seed_files import sentences_mended
from .whole_files import prepare, sixs_text

__all__ = [
    "PARSERS", "Parser", "begin_peak", "campaign", "complaint", "placed", "prepare", "resident", "run_part",
]  # fmt: skip

COUNT = 200_000
SHARED_DATA = Path(__file__).resolve().parents[4] / "shared" / "data"
_PART = 500
_LOT = 25
_MOST_SEED_BYTES = 4 * 2**20
#: A parser that runs longer than this is stopped: it has failed, and the campaign goes on.
_HANGS = 30


@dataclass(frozen=True)
class Parser:
    """What reads a file, the errors that its documentation names, and whole files to start from.

    Attributes
    ----------
    read
        Takes a path.
    errors
        May be raised.
    seeds
        Files in the folder of `prepare`; the mutated one takes the place of a copy, beside its neighbours.
    real
        Files in the folder of real samples, used where that is present; at most `_MOST_SEED_BYTES` each.
    """

    read: Callable[[Path], object]
    errors: tuple[type[PaintError], ...]
    seeds: tuple[str, ...]
    real: tuple[str, ...] = ()
    #: Makes every other damaged file right again in what a reader checks before it looks at anything else.
    mended: Callable[[bytes], bytes] | None = None

    def damaged(self, seed: bytes, name: str, number: int) -> bytes:
        """Return damaged version ``number`` of a seed."""
        data = mutated(seed, name, number)
        return self.mended(data) if self.mended is not None and number % 2 else data

    def files(self, folder: Path) -> list[Path]:
        """Return the seeds as paths, in an order that no machine changes."""
        real = [path for pattern in self.real for path in sorted(SHARED_DATA.glob(pattern))]
        real = [path for path in real if path.stat().st_size <= _MOST_SEED_BYTES]
        return [*(folder / name for name in self.seeds), *real]


def _envi(path: Path) -> None:
    from hyperpaint.io.envi.envi_cubes import open_envi

    opened = open_envi(path)
    for array in opened.data_vars.values():
        array.isel({array.dims[0]: [0, -1]}).load()


def _asd(path: Path) -> None:
    from hyperpaint.io.spectrometers.asd import open_asd

    open_asd(path, None if path.suffix == ".asd" else "reflectance", utc_offset_h=0.0)


def _asd_layout(path: Path) -> None:
    from hyperpaint.io.spectrometers.asd_binary import read_asd

    read_asd(path)


def _asd_text(path: Path) -> None:
    from hyperpaint.io.spectrometers.asd_text import read_asd_text

    read_asd_text(path)


def _svc(path: Path) -> None:
    from hyperpaint.io.spectrometers.svc import open_svc

    open_svc(path)
    open_svc(path, overlap="trim", dayfirst=False, utc_offset_h=0.0)


def _irradiance_csv(path: Path) -> None:
    from hyperpaint.io.spectrometers.irradiance_files import read_irradiance_csv

    read_irradiance_csv(path)


def _irradiance(path: Path) -> None:
    from hyperpaint.io.spectrometers.irradiance import open_irradiance

    open_irradiance(path, utc_offset_h=0.0, fwhm_nm=3.0, max_gap_s=5.0, units="W m-2 nm-1")


def _uvspec(path: Path) -> None:
    from hyperpaint.io.skies.sky_table import read_uvspec

    read_uvspec(path, sun_zenith=60.0, units="mW m-2 nm-1", directions=5)


def _tape7(path: Path) -> None:
    from hyperpaint.io.skies.sky_table import read_tape7

    read_tape7(path, sun_zenith=60.0, ground=0.3)


def _sixs(path: Path) -> None:
    from hyperpaint.io.skies.sky_table import read_sixs

    other = path.with_name("other.txt")
    other.write_text(sixs_text(0.65))
    read_sixs([path, other], sun_zenith=60.0)


def _sky_csv(path: Path) -> None:
    from hyperpaint.io.skies.sky_table import read_sky_csv

    read_sky_csv(path)


def _frame_index(path: Path) -> None:
    from hyperpaint.io.flightline.headwall import read_frame_index

    read_frame_index(path)


def _navigation(path: Path) -> None:
    from hyperpaint.io.navigation.navigation_records import read_imu_gps

    read_imu_gps(path)


def _sbet(path: Path) -> None:
    from hyperpaint.io.navigation.navigation_opening import open_navigation

    open_navigation(path, format="sbet", week=2158)


def _lcf(path: Path) -> None:
    from hyperpaint.io.navigation.navigation_opening import open_navigation

    open_navigation(path, format="lcf", week=2149, leap_seconds=18)


def _eph_att(path: Path) -> None:
    from hyperpaint.io.navigation.navigation_opening import open_navigation

    open_navigation(path, format="eph_att", week=1941, leap_seconds=18)


def _navigation_csv(path: Path) -> None:
    from hyperpaint.io.navigation.navigation_opening import open_navigation

    open_navigation(path, format="csv", leap_seconds=18)


def _settings(path: Path) -> None:
    from hyperpaint.io.flightline.headwall import exposure_seconds, read_settings

    exposure_seconds(read_settings(path), path.name)


def _gps_time(path: Path) -> None:
    from hyperpaint.io.navigation.navigation_records import read_gps_time

    read_gps_time(path)


def _collect(path: Path) -> None:
    from hyperpaint.io.collect.collect_toml import read_collect

    read_collect(path)


def _emissivity(path: Path) -> None:
    from hyperpaint.io.dirsig import open_emissivity

    open_emissivity(path)


def _materials(path: Path) -> None:
    from hyperpaint.io.dirsig import read_materials

    read_materials(path)


def _library(path: Path) -> None:
    from hyperpaint.io.library import open_library

    data = path.with_suffix("") if path.suffix == ".json" else path
    # a spectrum of the USGS has its wavelengths in another file
    usgs = path.name.startswith("splib")
    open_library(data, wavelength=[350.0 + band for band in range(2151)] if usgs else None)


def _reader(module: str, name: str, **options: Any) -> Callable[[Path], object]:
    """Return a reader that is imported when it is first called."""

    def read(path: Path) -> object:
        return getattr(importlib.import_module(f"hyperpaint.{module}"), name)(path, **options)

    return read


def _nmea(path: Path) -> None:
    from hyperpaint.io.navigation.navigation_opening import open_navigation

    open_navigation(path, format="nmea", date="2024-06-01")


def _mesh(path: Path) -> None:
    from hyperpaint.simulation.rendering.materials import Material
    from hyperpaint.simulation.rendering.mesh_files import read_mesh

    read_mesh(path, default=Material("grey", "panel_20", "panel"))


_BINARY = ("asd_binary/*.asd",)
_TEXT = ("asd_ascii/*", "asd_binary/*.txt")

PARSERS: Mapping[str, Parser] = {
    "envi": Parser(
        _envi,
        (FormatError,),
        ("flight/raw_0.hdr", "dark/raw_0.hdr"),
        ("envi_cube/test_image.hdr", "envi_cube/ang*.hdr", "envi_cube/prm*.hdr", "envi_cube/corn*.hdr"),
    ),
    "asd": Parser(_asd_layout, (FormatError,), ("asd/sky00000.asd",), _BINARY),
    "asd-text": Parser(_asd_text, (FormatError,), ("sky.txt",), _TEXT),
    "asd-open": Parser(_asd, (FormatError, TimeError), ("asd/sky00000.asd", "sky.txt"), (*_BINARY, *_TEXT)),
    "svc": Parser(_svc, (FormatError,), ("svc/red.sig",), ("svc_sig/*.sig",)),
    "irradiance-csv": Parser(_irradiance_csv, (FormatError,), ("sky.csv", "zone.csv")),
    "irradiance-open": Parser(
        _irradiance, (FormatError, TimeError, UnitsError), ("sky.csv", "zone.csv", "asd/sky00001.asd")
    ),
    "frame-index": Parser(
        _frame_index,
        (FormatError, TimeError),
        ("flight/frameIndex_0.txt", "frameIndex_time.txt", "frameIndex_seconds.txt"),
    ),
    "imu-gps": Parser(
        _navigation, (FormatError,), ("flight/imu_gps.txt", "imu_gps_month.txt", "imu_gps_time.txt")
    ),
    "sbet": Parser(_sbet, (FormatError, TimeError), ("flight.sbet",), ("nav/2-points.sbet",)),
    "lcf": Parser(_lcf, (FormatError, TimeError), ("flight.lcf",)),
    "eph-att": Parser(_eph_att, (FormatError, TimeError), ("ang20170323t202244_eph_att.hdr",)),
    "nav-csv": Parser(_navigation_csv, (FormatError, TimeError), ("flight.csv", "flight_gps.csv")),
    "settings": Parser(_settings, (FormatError,), ("flight/settings.txt", "settings_comments.txt")),
    "gps-time": Parser(_gps_time, (FormatError, TimeError), ("gps_time.txt",)),
    "collect-toml": Parser(_collect, (CollectError,), ("collect.toml",)),
    "uvspec": Parser(_uvspec, (FormatError, SchemaError), ("uvspec.out",)),
    "tape7": Parser(_tape7, (FormatError, SchemaError), ("tape7",)),
    "sixs": Parser(_sixs, (FormatError, SchemaError), ("sixs.txt",)),
    "sky-csv": Parser(_sky_csv, (FormatError, SchemaError, UnitsError), ("radiances.csv",)),
    "nmea": Parser(
        _nmea, (FormatError, TimeError), ("flight.nmea",), ("gps_imu/*.log",), mended=sentences_mended
    ),
    "control-points": Parser(_reader("io", "read_control_points"), (FormatError,), ("points.csv",)),
    "radcal": Parser(
        _reader("io", "read_radcal"), (FormatError,), ("radcal.txt",), ("lab_calibration/CP_*RADCAL*.TXT",)
    ),
    "certificate": Parser(
        _reader("io", "read_certificate"),
        (FormatError,),
        ("panel.csv", "zenith.txt"),
        ("lab_calibration/*certificate.csv", "spectra_ascii/R90.txt"),
    ),
    "light-table": Parser(
        _reader("simulation.rendering.four_curves", "read_table"),
        (FormatError, SchemaError),
        ("light.csv",),
    ),
    "mesh-obj": Parser(_mesh, (FormatError, SchemaError), ("box.obj",)),
    "mesh-ply": Parser(_mesh, (FormatError, SchemaError), ("box.ply",)),
    "mesh-glb": Parser(_mesh, (FormatError, SchemaError), ("box.glb",)),
    "regions": Parser(_reader("regions", "read_regions"), (FormatError,), ("regions.geojson",)),
    "pairs": Parser(
        _reader("io.spectrometers.reference_files", "read_pairs"), (FormatError,), ("pairs.csv",)
    ),
    "geotiff": Parser(
        _reader("io.maps.geotiff", "read_geotiff_header"), (FormatError,), ("heights.tif", "tiled.tif")
    ),
    "heights": Parser(
        _reader("io.maps.rasters", "read_heights"),
        (FormatError,),
        ("heights.tif", "tiled.tif", "heights.asc"),
    ),
    "scene-toml": Parser(
        _reader("workflows.scene_files", "read_scene_file"), (FormatError,), ("scene.toml",)
    ),
    "dirsig-ems": Parser(_emissivity, (FormatError,), ("paint.ems",), ("dirsig/emissivity/*.ems",)),
    "dirsig-mat": Parser(_materials, (FormatError,), ("paints.mat",), ("dirsig/*.mat",)),
    "library-envi": Parser(_library, (FormatError,), ("library/paints.hdr",), ("envi_sli/*.hdr",)),
    "library-metadata": Parser(
        _library, (FormatError,), ("library/paints.sli.json", "library/paints.csv.json")
    ),
    "library-csv": Parser(_library, (FormatError,), ("library/paints.csv",)),
    "library-text": Parser(
        _library,
        (FormatError,),
        ("library/text/red.spectrum.txt", "table.csv"),
        tuple(
            f"spectra_ascii/{name}" for name in ("*.spectrum.txt", "PVC_*.txt", "R90.txt", "splib07a_*.txt")
        ),
    ),
}


# --- one file ----------------------------------------------------------------------------------------------


def placed(parser: Parser, folder: Path, own: Path) -> list[tuple[Path, bytes]]:
    """Copy the seeds with their neighbours into a worker's own folder; return where, and their bytes."""
    copies = []
    for number, file in enumerate(parser.files(folder)):
        room = own / str(number)
        if file.name == "collect.toml":
            shutil.copytree(file.parent, room)
        else:
            room.mkdir()
            stem = file.name.partition(".")[0]
            beside = file.parent.glob(f"{stem}*") if file.suffix in (".hdr", ".json", ".asc") else [file]
            for neighbour in beside:
                (room / neighbour.name).write_bytes(neighbour.read_bytes())
        copies.append((room / file.name, file.read_bytes()))
    return copies


# --- one worker --------------------------------------------------------------------------------------------


class _Hangs(BaseException):
    """A parser ran for so long that it was stopped."""


def resident(key: str) -> int:
    """Return ``VmRSS`` or its peak ``VmHWM`` [byte]; 0 where the system does not tell."""
    try:
        text = Path("/proc/self/status").read_text()
    except OSError:
        return 0
    return int(text.partition(f"{key}:")[2].split()[0]) * 1024


@contextlib.contextmanager
def _limits() -> Iterator[None]:
    """Let memory grow by little more than is allowed, and stop what hangs."""

    def stop(*_: Any) -> None:
        raise _Hangs

    before, alarm = resource.getrlimit(resource.RLIMIT_AS), signal.signal(signal.SIGALRM, stop)
    if (used := resident("VmSize")) > 0:
        resource.setrlimit(resource.RLIMIT_AS, (used + 2 * MOST_BYTES, before[1]))
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        resource.setrlimit(resource.RLIMIT_AS, before)
        signal.signal(signal.SIGALRM, alarm)


def _measured(read: Callable[[Path], object], path: Path) -> tuple[BaseException | None, float]:
    """Return what left the parser, and its processor time."""
    signal.setitimer(signal.ITIMER_REAL, _HANGS)
    begun = time.process_time()
    raised: BaseException | None = None
    try:
        read(path)
    except (Exception, _Hangs) as error:
        raised = error
    seconds = time.process_time() - begun
    signal.setitimer(signal.ITIMER_REAL, 0)
    return raised, seconds


def begin_peak() -> int:
    """Let the peak of the resident memory begin anew; return the memory at its beginning."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
    return resident("VmRSS")


def _complaint(parser: Parser, raised: BaseException | None, seconds: float, memory: int = 0) -> str:
    """Return what is wrong with how a parser took an input; empty where nothing is."""
    if raised is not None and not (type(raised) in parser.errors and str(raised)):
        return f"{type(raised).__name__}: {raised}"
    if seconds > MOST_SECONDS or memory > MOST_BYTES:
        return f"{seconds:.2f} s, {memory / 2**20:.0f} MB"
    return ""


def complaint(parser: Parser, path: Path) -> str:
    """Read a file and return what is wrong with how the parser took it; empty where nothing is."""
    before = begin_peak()
    raised, seconds = _measured(parser.read, path)
    return _complaint(parser, raised, seconds, resident("VmHWM") - before)


def run_part(name: str, folder: Path, numbers: range) -> Outcome:
    """Mutate, read and judge inputs ``numbers`` of one parser."""
    parser = PARSERS[name]
    made = Outcome(f"parser {name}", seconds=0.0, memory=0)
    memory_disk = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
    with tempfile.TemporaryDirectory(dir=memory_disk) as own, warnings.catch_warnings(), _limits():
        # a warning of numpy's would mean values that nobody meant
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", PaintWarning)
        copies = placed(parser, folder, Path(own))
        parser.read(copies[0][0])  # imports are no part of the first input's time
        # to look at the memory costs more than to read most files: a lot is looked at as one
        for start in range(0, len(numbers), _LOT):
            lot = numbers[start : start + _LOT]
            before = begin_peak()
            for number in lot:
                _judge(parser, copies, name, number, made)
            memory = resident("VmHWM") - before
            if memory > MOST_BYTES:
                made.wrong.append(f"{name} inputs {lot[0]} to {lot[-1]}: {memory / 2**20:.0f} MB")
            made.memory = max(made.memory or 0, memory)
    made.wrong = [text.replace(own, "") for text in made.wrong]
    return made


def _judge(parser: Parser, copies: list[tuple[Path, bytes]], name: str, number: int, made: Outcome) -> None:
    path, seed = copies[number % len(copies)]
    path.write_bytes(parser.damaged(seed, name, number))
    raised, seconds = _measured(parser.read, path)
    made.count += 1
    made.notes["read" if raised is None else "refused"] += 1
    wrong = _complaint(parser, raised, seconds)
    made.wrong += [f"{name} input {number}: {wrong:.200}"] if wrong else []
    made.seconds = max(made.seconds or 0.0, seconds)


def _run(part: tuple[str, Path, range]) -> list[Outcome]:
    return [run_part(*part)]


def campaign(scale: float = 1.0, *, first: int = 0, names: tuple[str, ...] = ()) -> Iterator[Outcome]:
    """Yield the outcome of every part; ``first`` resumes, or continues an earlier campaign."""
    count = max(1, round(COUNT * scale))
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        prepare(folder)
        parts = [
            (name, folder, range(start, min(start + _PART, first + count)))
            for name in (names or PARSERS)
            for start in range(first, first + count, _PART)
        ]
        yield from in_parallel(_run, parts)
