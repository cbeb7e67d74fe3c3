"""Mutated inputs: a parser may refuse a file with its own error, within a second and 256 MB, or read it."""

import contextlib
import importlib
import os
import random
import re
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

from .outcome import (
    MOST_BYTES,
    MOST_SECONDS,
    Outcome,
    begin_peak,
    in_parallel,
    numbers_of,
    parts_of,
    resident,
)
from .seed_files import prepare, sentences_mended, sixs_text

COUNT = 200_000
SHARED_DATA = Path(__file__).resolve().parents[4] / "shared" / "data"
_PART = 500
_LOT = 25
_MOST_SEED_BYTES = 4 * 2**20
#: A parser that runs longer than this is stopped: it has failed, and the campaign goes on.
_HANGS = 30


@dataclass(frozen=True)
class Parser:
    # What reads a file, the errors that its documentation names, and whole files to start from
    # read: Takes a path
    # errors: May be raised
    # seeds: Files in the folder of `prepare`; the mutated one takes the place of a copy, beside its
    # neighbours
    # real: Files in the folder of real samples, used where that is present; at most `_MOST_SEED_BYTES` each
    # mended: Makes every other damaged file right again in what a reader checks before it looks at anything
    # else
    read: Callable[[Path], object]
    errors: tuple[type[PaintError], ...]
    seeds: tuple[str, ...]
    real: tuple[str, ...] = ()
    mended: Callable[[bytes], bytes] | None = None

    def damaged(self, seed: bytes, name: str, number: int) -> bytes:
        # Return damaged version ``number`` of a seed
        data = mutated(seed, name, number)
        return self.mended(data) if self.mended is not None and number % 2 else data

    def files(self, folder: Path) -> list[Path]:
        # Return the seeds as paths, in an order that no machine changes
        real = [path for pattern in self.real for path in sorted(SHARED_DATA.glob(pattern))]
        real = [path for path in real if path.stat().st_size <= _MOST_SEED_BYTES]
        return [*(folder / name for name in self.seeds), *real]


def reader(
    place: str, *calls: dict[str, Any], then: Callable[[Any, Path], object] | None = None
) -> Callable[[Path], object]:
    # Return a reader that is imported when it is first called
    # place: Module below hyperpaint and name, with a colon between
    # *calls: Keyword arguments of each call; one without any where there are none
    # then: Takes what was read, and the path
    module, _, name = place.partition(":")

    def read(path: Path) -> None:
        function = getattr(importlib.import_module(f"hyperpaint.{module}"), name)
        for options in calls or ({},):
            made = function(path, **options)
            if then is not None:
                then(made, path)

    return read


def _ends(opened: Any, _: Path) -> None:
    for array in opened.data_vars.values():
        array.isel({array.dims[0]: [0, -1]}).load()


def _columns(read: Any, _: Path) -> None:
    for quantity in ("reflectance", "irradiance"):
        with contextlib.suppress(FormatError):
            read.column(quantity, "W m-2 nm-1")


def exposure(read: Any, path: Path) -> None:
    from hyperpaint.io.flightline.side_files import exposure_seconds

    exposure_seconds(read, path.name)


def _asd(path: Path) -> None:
    quantity = None if path.suffix == ".asd" else "reflectance"
    reader("io.spectrometers.asd:open_asd", {"quantity": quantity, "utc_offset_h": 0.0})(path)


def _sixs(path: Path) -> None:
    from hyperpaint.io.skies import read_sixs

    other = path.with_name("other.txt")
    other.write_text(sixs_text(0.65))
    read_sixs([path, other], sun_zenith=60.0)


def _library(path: Path) -> None:
    # a spectrum of the USGS has its wavelengths in another file
    wavelength = [350.0 + band for band in range(2151)] if path.name.startswith("splib") else None
    data = path.with_suffix("") if path.suffix == ".json" else path
    reader("io.library:open_library", {"wavelength": wavelength})(data)


def _mesh(path: Path) -> None:
    from hyperpaint.simulation.rendering.materials import Material

    grey = Material("grey", "panel_20", "panel")
    reader("simulation.rendering.mesh_files:read_mesh", {"default": grey})(path)


def _navigation(**options: Any) -> Callable[[Path], object]:
    return reader("io.navigation.navigation_records:open_navigation", options)


_BINARY, _TEXT = ("asd_binary/*.asd",), ("asd_ascii/*", "asd_binary/*.txt")
SKY = {"utc_offset_h": 0.0, "fwhm_nm": 3.0, "max_gap_s": 5.0, "units": "W m-2 nm-1"}
_FORMAT, _TIME = (FormatError,), (FormatError, TimeError)
_SCHEMA = (FormatError, SchemaError)
_SPECTRA, _SKIES, _LINES = "io.spectrometers", "io.skies", "io.flightline.side_files"

#: By name: the reader, its errors, seeds, real files.
PARSERS: Mapping[str, Parser] = {
    name: Parser(*row)
    for name, row in {
        "envi": (
            reader("io.envi.envi_cubes:open_envi", then=_ends),
            _FORMAT,
            ("flight/raw_0.hdr", "dark/raw_0.hdr"),
            ("envi_cube/test_image.hdr", "envi_cube/ang*.hdr", "envi_cube/prm*.hdr", "envi_cube/corn*.hdr"),
        ),
        "asd": (reader(f"{_SPECTRA}.asd:read_asd"), _FORMAT, ("asd/sky00000.asd",), _BINARY),
        "asd-text": (reader(f"{_SPECTRA}.asd:read_asd_text"), _FORMAT, ("sky.txt",), _TEXT),
        "asd-open": (_asd, _TIME, ("asd/sky00000.asd", "sky.txt"), (*_BINARY, *_TEXT)),
        "svc": (
            reader(
                f"{_SPECTRA}.spectrum_texts:open_svc",
                {},
                {"overlap": "trim", "dayfirst": False, "utc_offset_h": 0.0},
            ),
            _FORMAT,
            ("svc/red.sig",),
            ("svc_sig/*.sig",),
        ),
        "irradiance-csv": (
            reader(f"{_SPECTRA}.irradiance:read_irradiance_csv"),
            _FORMAT,
            ("sky.csv", "zone.csv", "logger.csv"),
        ),
        "irradiance-open": (
            reader(f"{_SPECTRA}.irradiance:open_irradiance", SKY),
            (FormatError, TimeError, UnitsError),
            ("sky.csv", "zone.csv", "asd/sky00001.asd", "logger.csv"),
        ),
        "frame-index": (
            reader(f"{_LINES}:read_frame_index"),
            _TIME,
            ("flight/frameIndex_0.txt", "frameIndex_time.txt", "frameIndex_seconds.txt"),
        ),
        "imu-gps": (
            reader("io.navigation.navigation_records:read_imu_gps"),
            _FORMAT,
            ("flight/imu_gps.txt", "imu_gps_month.txt", "imu_gps_time.txt"),
        ),
        "sbet": (_navigation(format="sbet", week=2158), _TIME, ("flight.sbet",), ("nav/2-points.sbet",)),
        "lcf": (_navigation(format="lcf", week=2149, leap_seconds=18), _TIME, ("flight.lcf",)),
        "eph-att": (
            _navigation(format="eph_att", week=1941, leap_seconds=18),
            _TIME,
            ("ang20170323t202244_eph_att.hdr",),
        ),
        "nav-csv": (_navigation(format="csv", leap_seconds=18), _TIME, ("flight.csv", "flight_gps.csv")),
        "settings": (
            reader(f"{_LINES}:read_settings", then=exposure),
            _FORMAT,
            ("flight/settings.txt", "settings_comments.txt"),
        ),
        "gps-time": (reader("io.navigation.navigation_records:read_gps_time"), _TIME, ("gps_time.txt",)),
        "collect-toml": (reader("io.collect.collect_toml:read_collect"), (CollectError,), ("collect.toml",)),
        "uvspec": (
            reader(f"{_SKIES}:read_uvspec", {"sun_zenith": 60.0, "units": "mW m-2 nm-1", "directions": 5}),
            _SCHEMA,
            ("uvspec.out",),
        ),
        "tape7": (reader(f"{_SKIES}:read_tape7", {"sun_zenith": 60.0, "ground": 0.3}), _SCHEMA, ("tape7",)),
        "sixs": (_sixs, _SCHEMA, ("sixs.txt",)),
        "sky-csv": (reader(f"{_SKIES}:read_sky_csv"), (*_SCHEMA, UnitsError), ("radiances.csv", "light.csv")),
        "nmea": (
            _navigation(format="nmea", date="2024-06-01"),
            _TIME,
            ("flight.nmea",),
            ("gps_imu/*.log",),
            sentences_mended,
        ),
        "control-points": (reader("io:read_control_points"), _FORMAT, ("points.csv",)),
        "radcal": (reader("io:read_radcal"), _FORMAT, ("radcal.txt",), ("lab_calibration/CP_*RADCAL*.TXT",)),
        "angular": (reader("io:read_angular_response"), _FORMAT, ("angular.txt",)),
        "spectrum-text": (
            reader(f"{_SPECTRA}.spectrum_texts:read_spectrum_text", then=_columns),
            _FORMAT,
            ("door.sed", "sky.JazIrrad", "li180.txt", "door.ttt", "sky.irr"),
        ),
        "sample-table": (_library, _FORMAT, ("ecosis.csv", "specchio.csv")),
        "certificate": (
            reader("io:read_certificate"),
            _FORMAT,
            ("panel.csv", "zenith.txt", "falling.csv"),
            ("lab_calibration/*certificate.csv", "spectra_ascii/R90.txt"),
        ),
        "mesh-obj": (_mesh, _SCHEMA, ("box.obj",)),
        "mesh-ply": (_mesh, _SCHEMA, ("box.ply",)),
        "mesh-glb": (_mesh, _SCHEMA, ("box.glb",)),
        "rgl": (reader("io:read_rgl"), _FORMAT, ("paint.bsdf",)),
        "regions": (reader("regions:read_regions"), _FORMAT, ("regions.geojson",)),
        "pairs": (reader(f"{_SPECTRA}.reference_files:read_pairs"), _FORMAT, ("pairs.csv",)),
        "geotiff": (reader("io.maps.map_grids:read_geotiff_header"), _FORMAT, ("heights.tif", "tiled.tif")),
        "heights": (
            reader("io.maps.map_grids:read_heights"),
            _FORMAT,
            ("heights.tif", "tiled.tif", "heights.asc"),
        ),
        "scene-toml": (reader("workflows.rendering:read_scene_file"), _FORMAT, ("scene.toml",)),
        "dirsig-ems": (
            reader("io.dirsig:open_emissivity"),
            _FORMAT,
            ("paint.ems",),
            ("dirsig/emissivity/*.ems",),
        ),
        "dirsig-mat": (reader("io.dirsig:read_materials"), _FORMAT, ("paints.mat",), ("dirsig/*.mat",)),
        "library-envi": (_library, _FORMAT, ("library/paints.hdr",), ("envi_sli/*.hdr",)),
        "library-metadata": (_library, _FORMAT, ("library/paints.sli.json", "library/paints.csv.json")),
        "library-csv": (_library, _FORMAT, ("library/paints.csv",)),
        "library-text": (
            _library,
            _FORMAT,
            ("library/text/red.spectrum.txt", "table.csv"),
            tuple(f"spectra_ascii/{n}" for n in ("*.spectrum.txt", "PVC_*.txt", "R90.txt", "splib07a_*.txt")),
        ),
    }.items()
}


# --- one file ----------------------------------------------------------------------------------------------


def placed(parser: Parser, folder: Path, own: Path) -> list[tuple[Path, bytes]]:
    # Copy the seeds with their neighbours into a worker's own folder; return where, and their bytes
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


@contextlib.contextmanager
def limits() -> Iterator[None]:
    # Let memory grow by little more than is allowed, and stop what hangs
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
    # Return what left the parser, and its processor time
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


def _complaint(parser: Parser, raised: BaseException | None, seconds: float, memory: int = 0) -> str:
    # Return what is wrong with how a parser took an input; empty where nothing is
    if raised is not None and not (type(raised) in parser.errors and str(raised)):
        return f"{type(raised).__name__}: {raised}"
    if seconds > MOST_SECONDS or memory > MOST_BYTES:
        return f"{seconds:.2f} s, {memory / 2**20:.0f} MB"
    return ""


def complaint(parser: Parser, path: Path) -> str:
    # Read a file and return what is wrong with how the parser took it; empty where nothing is
    before = begin_peak()
    raised, seconds = _measured(parser.read, path)
    return _complaint(parser, raised, seconds, resident("VmHWM") - before)


def run_part(name: str, folder: Path, numbers: range) -> Outcome:
    # Mutate, read and judge inputs ``numbers`` of one parser
    parser = PARSERS[name]
    made = Outcome(f"parser {name}", seconds=0.0, memory=0)
    memory_disk = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
    with tempfile.TemporaryDirectory(dir=memory_disk) as own, warnings.catch_warnings(), limits():
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


def campaign(scale: float = 1.0, *, first: int = 0) -> Iterator[Outcome]:
    # Yield the outcome of every part; ``first`` resumes, or continues an earlier campaign
    numbers = numbers_of(COUNT, scale, first)
    with tempfile.TemporaryDirectory() as folder:
        prepare(Path(folder))
        parts = [(name, Path(folder), part) for name in PARSERS for part in parts_of(numbers, _PART)]
        yield from in_parallel(_run, parts)


# --- damaged versions of a file, each a function of the file and a number ----------------------------------

_TOKEN = re.compile(rb"[0-9A-Za-z_.+-]+")
_LARGEST = 2 * 2**20

#: What breaks parsers: numbers at the edges of types, what only Python reads as a number, impossible dates,
#: unclosed brackets, other encodings, paths that lead out.
_HOSTILE = (
    *(b"0", b"-1", b"-0", b"1", b"65535", b"65536", b"2147483647", b"2147483648", b"4294967296"),
    *(b"9223372036854775807", b"9223372036854775808", b"-9223372036854775808", b"1000000000000"),
    *(b"nan", b"NaN", b"inf", b"-inf", b"1e400", b"-1e308", b"1e308", b"4.9e-324", b"1e-320", b"0x10"),
    *(b"1_000", b"1,5", b"5.", b".", b"+", b"--1", b"1e", b"9" * 400, b"9" * 5000, b"0." + b"0" * 5000),
    *("\u0663\u0664".encode(), "\u00b2".encode(), "\U0001f4a9".encode(), b"\xff\xfe", b"\xef\xbb\xbf"),
    *(b"\0", b"\r", b"\n", b"\t", b"\x1a", b"\x85", b"\xc2\xa0", b",", b";", b"=", b"#", b'"', b"'"),
    *(b"{", b"}", b"[", b"]", b"{" * 3000, b"[" * 3000, b"}" * 3000, b"{}" * 3000, b"," * 20000),
    *(b"true", b"none", b"null", b"../../../etc/passwd", b"/etc/passwd", b"~", b"/dev/zero", b"**/*", b"/*"),
    *(b"2021-02-30", b"24:61:61", b"0001-01-01T00:00:00+14:00", b"9999-12-31T23:59:59-14:00", b"23:59:60"),
    *(b"2262-04-12", b"1677-09-21", b"1970-01-01T00:00:00Z", b"12:00", b"Feb", b" " * 5000, b"%s%n{0}"),
)  # fmt: skip


def mutated(seed: bytes, name: str, number: int) -> bytes:
    """Return damaged version ``number`` of a file.

    Parameters
    ----------
    seed
        The file.
    name
        What is damaged; two names give two series of damages.
    number
        Any; the same number gives the same bytes.

    Examples
    --------
    >>> mutated(b"lines = 3", "envi", 7) == mutated(b"lines = 3", "envi", 7)
    True
    """
    rng = random.Random(f"{name}:{number}")
    data = bytearray(seed)
    for _ in range(min(8, 1 + int(rng.expovariate(0.8)))):
        rng.choice(_DAMAGES)(data, rng)
        del data[_LARGEST:]
    return bytes(data)


def _span(data: bytearray, rng: random.Random) -> slice:
    start = rng.randrange(len(data) + 1)
    return slice(start, start + int(rng.paretovariate(0.6)))


def _token(data: bytearray, rng: random.Random) -> slice:
    found = _TOKEN.search(data, rng.randrange(len(data) + 1)) or _TOKEN.search(data)
    return slice(0, 0) if found is None else slice(*found.span())


def _line(data: bytearray, rng: random.Random) -> slice:
    place = rng.randrange(len(data) + 1)
    end = data.find(b"\n", place)
    return slice(data.rfind(b"\n", 0, place) + 1, len(data) if end < 0 else end + 1)


def _flip(data: bytearray, rng: random.Random) -> None:
    if data:
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)


def _early_flip(data: bytearray, rng: random.Random) -> None:
    # Damage the first bytes, where binary formats hold their sizes
    if data:
        data[rng.randrange(min(len(data), 600))] = rng.choice((0, 1, 0x7F, 0x80, 0xFF, rng.randrange(256)))


def _burst(data: bytearray, rng: random.Random) -> None:
    span = _span(data, rng)
    data[span] = rng.randbytes(len(data[span]))


def _integer(data: bytearray, rng: random.Random) -> None:
    # Write an integer or a float at the edge of its type over some bytes
    place = rng.randrange(min(len(data), rng.choice((600, 2**31))) + 1)
    value = rng.choice((0, 1, 2**7, 2**15 - 1, 2**15, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1))
    raw = value.to_bytes(8, "little")
    raw = rng.choice((raw[:2], raw[:4], raw, b"\0\0\x80\x7f", b"\0\0\xc0\x7f", b"\0" * 6 + b"\xf0\x7f"))
    data[place : place + len(raw)] = raw


def _truncate(data: bytearray, rng: random.Random) -> None:
    del data[rng.randrange(len(data) + 1) :]


def _append(data: bytearray, rng: random.Random) -> None:
    data += rng.randbytes(int(rng.paretovariate(0.5)) % 5000)


def _delete(data: bytearray, rng: random.Random) -> None:
    del data[_span(data, rng)]


def _repeat(data: bytearray, rng: random.Random) -> None:
    span = rng.choice((_span, _token, _line))(data, rng)
    piece = data[span][:5000]
    data[span.stop : span.stop] = piece * min(rng.choice((1, 2, 30, 3000)), 1 + 200_000 // (len(piece) + 1))


def _zeros(data: bytearray, rng: random.Random) -> None:
    span = _span(data, rng)
    data[span] = bytes(len(data[span]))


def _replace(data: bytearray, rng: random.Random) -> None:
    data[rng.choice((_token, _span))(data, rng)] = rng.choice(_HOSTILE)


def _insert(data: bytearray, rng: random.Random) -> None:
    place = _span(data, rng).start
    data[place:place] = rng.choice(_HOSTILE)


def _exchange(data: bytearray, rng: random.Random) -> None:
    # Put one token, or line, in the place of another
    pick = rng.choice((_token, _line))
    piece = bytes(data[pick(data, rng)])
    data[pick(data, rng)] = piece


def _remove(data: bytearray, rng: random.Random) -> None:
    del data[rng.choice((_token, _line))(data, rng)]


def _scale(data: bytearray, rng: random.Random) -> None:
    # Change a number to another one of its kind
    span = _token(data, rng)
    try:
        value = float(data[span])
    except ValueError:
        return
    made = value * rng.choice((-1.0, 0.1, 10.0, 1e6, 1e-6)) + rng.choice((0.0, 1.0, -1.0))
    data[span] = (b"%d" % int(made)) if value.is_integer() and abs(made) < 1e30 else repr(made).encode()


_DAMAGES: tuple[Callable[[bytearray, random.Random], None], ...] = (
    *(_flip, _early_flip, _burst, _integer, _truncate, _append, _delete, _repeat, _zeros),
    *(_replace, _replace, _replace, _insert, _exchange, _exchange, _remove, _scale, _scale),
)  # fmt: skip
