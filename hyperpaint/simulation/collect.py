"""A whole simulated collect: the instruments' files, the calibration, and the truth beside them.

Two field spectrometers saw the cars' paints on the ground before the flight. The truth of their files is the
paint's own spectrum: what it reflects near normal, without the mirror image of the sky. Beyond 1000 nm, where
only the SVC sees, the light has no bands.
"""

from __future__ import annotations

import itertools
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from hyperpaint.base.arrays import Progress
from hyperpaint.base.errors import SchemaError, StoreError
from hyperpaint.base.facts import documented
from hyperpaint.base.input_files import head_of, input_path
from hyperpaint.base.schema import CHUNK_LINES

from .atmosphere import spectral_grid
from .camera import convolve_gaussian
from .checkerboard_flight import CheckerboardFlight
from .flight import Flight, Lines, sky_irradiance
from .instruments import (
    ASD_WAVELENGTH,
    SVC_DETECTORS,
    BilWriter,
    svc_wavelengths,
    write_asd,
    write_asd_reflectance,
    write_frame_index,
    write_navigation,
    write_sbet,
    write_settings,
    write_svc,
)
from .painted_regions import REGIONS, PaintedRectangles
from .plan_flight import PlanFlight
from .settings import ORIGIN, PIXEL_ANGLE_RAD, SimulationSettings
from .stores import TruthStore, line_dataset, store_sweep, write_calibration
from .sweep import Sweep, SweepSettings
from .trajectories import CONVENTION

SVC_FOLDER, ASD_FOLDER = "svc", "asd_reflectance"

_STEP = 0.1  # nm
_LEAD, _EACH, _PANEL = 3600, 60, 15  # s from the first paint to the flight, to the next paint, from the panel
_MARGIN = 40.0  # nm beyond the outer channels, more than a line shape reaches


def write_references(flight: Flight, folder: Path) -> None:
    """Write a file of each spectrometer for every paint of the cars, named by paint.

    The folder of the collect receives the folders `SVC_FOLDER` and `ASD_FOLDER`.
    """
    settings = flight.settings
    svc, asd = folder / SVC_FOLDER, folder / ASD_FOLDER
    for directory in (svc, asd):
        directory.mkdir()
    seen = svc_wavelengths()
    grid = spectral_grid(seen.min() - _MARGIN, seen.max() + _MARGIN, _STEP)
    light = sky_irradiance(settings.sky, settings.sun[0], grid).sum(axis=0) / np.pi
    # the white panel first
    spectra = np.concatenate([light[None], light * flight.paint_reflectance(flight.paints, grid)])
    by_svc = np.concatenate(
        [convolve_gaussian(spectra, grid, part.wavelength, part.fwhm) for part in SVC_DETECTORS], axis=1
    )
    by_asd = convolve_gaussian(spectra, grid, ASD_WAVELENGTH, settings.irradiance_fwhm_nm)
    zone, start = round(settings.utc_offset_h * 3600), flight.start // 10**9
    for index, paint in enumerate(flight.paints, 1):
        panel = start - _LEAD + _EACH * index
        target = panel + _PANEL
        write_svc(
            svc / f"{paint}.sig",
            by_svc[0],
            by_svc[index],
            stamps=(panel, target),
            utc_offset=zone,
            position=ORIGIN[:2],
            sun=settings.sun,
        )
        write_asd_reflectance(
            asd / f"{paint}.asd",
            by_asd[index],
            by_asd[0],
            stamp=target,
            utc_offset=zone,
            reference_stamp=panel,
        )


#: Points of the pavement, as a GNSS receiver on a pole would log them.
SURVEY = "survey.csv"

#: Files and folders of a simulated collect.
PARTS = (
    "flight",
    "dark",
    "asd",
    SVC_FOLDER,
    ASD_FOLDER,
    "lab",
    "calibration.zarr",
    "truth.zarr",
    REGIONS,
    SURVEY,
    "collect.toml",
)

#: Opens the ``collect.toml`` of a simulated collect.
MARKER = "# simulated by hyperpaint"

_UNFINISHED = f"{MARKER}: not finished\n"

#: Stands in the headers of simulated cubes for the version of the camera's software, in the comments of a
#: field spectrometer's simulated files, and in the regions for what made them.
CAMERA_SOFTWARE = "hyperpaint simulation"

_BOOT = 1_234_567_891_000  # ns on the instrument's clock at the first line: it knows no date
_NAVIGATION_MARGIN = 2 * 10**9  # ns around the flight
_DARK_LEAD = 60 * 10**9  # ns from the first dark frame to the first line


@documented(overwrite="own overwrite")
def simulate_collect(
    folder: str | Path,
    *,
    lines: int = 512,
    bands: int = 272,
    columns: int = 320,
    seed: int = 0,
    scene: str = "rendered",
    truth: bool = True,
    sweep: Mapping[str, Any] | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
    block_lines: int = CHUNK_LINES,
    **effects: Any,
) -> Path:
    """Simulate a flight over a car park and write it as the instruments would have.

    Written are a Headwall folder (``flight``: cubes, frame index, navigation, settings), a dark cube
    (``dark``), an irradiance series (``asd``), reflectance of the cars' paints as two field spectrometers
    saw it (``svc``, ``asd_reflectance``), ``calibration.zarr``, ``truth.zarr``, ``regions.geojson`` with a
    rectangle of clean pixels of every paint that has a level patch of six by six, and, last of all,
    ``collect.toml``.

    Parameters
    ----------
    folder
        Made where it does not exist.
    lines, bands, columns
        Shape of the cube.
    seed
        The same seed gives the same bytes of every instrument file.
    scene
        "rendered": a car park of triangles whose light is traced, with shadows, glint and mixed pixels.
        "plan": a flat picture in which a pixel sees one level surface, made at once. "checkerboard": level
        squares whose corners are known on the map.
    truth
        Write ``truth.zarr``: radiance and reflectance of every sample, class and masks of every pixel; but
        for a plan also the place that it shows, and where the camera was mounted; of a rendered scene also
        shadow, purity and which car.
    sweep
        Also take the camera into the lab: ``lab/sweep.zarr`` is a monochromator sweep with these effects
        (fields of `hyperpaint.simulation.SweepSettings`, ``{}`` for the defaults), ``lab/sweep_truth.zarr``
        its truth. ``collect.toml`` then names the sweep in place of ``calibration.zarr``.
    overwrite
    progress
    block_lines
        Lines worked on together; bounds the memory, changes no value.
    **effects
        Fields of `hyperpaint.simulation.SimulationSettings`: ``noise``, ``smile_nm``, ``wobble`` ...

    Returns
    -------
    Path of ``collect.toml``.

    Raises
    ------
    SchemaError
        An effect, of the flight or of the sweep, is unknown or out of range; all are listed.
    StoreError
        The folder holds something already, and ``overwrite`` is not set.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = simulate_collect(folder, lines=8, bands=4, columns=6, scene="plan")
    ...     print(*sorted(entry.name for entry in path.parent.iterdir()))
    asd asd_reflectance calibration.zarr collect.toml dark flight regions.geojson survey.csv svc truth.zarr
    """
    place = input_path(folder, "a folder for the collect", StoreError, "simulate to a folder, and copy it")
    settings = SimulationSettings.of(
        {"lines": lines, "bands": bands, "columns": columns, "seed": seed, "scene": scene, **effects}
    )
    if not settings.quantise:
        raise SchemaError(
            "quantise=False, but files hold whole counts",
            mend="use simulate_line for float32 counts in memory",
            code="option-conflict",
        )
    if block_lines < 1:
        raise SchemaError(
            f"block_lines={block_lines}", expected="a whole number above 0", code="value-out-of-range"
        )
    lab = None if sweep is None else Sweep(SweepSettings.of(sweep, settings))
    flight = _flight_of(settings)
    root = _prepare(place, overwrite)
    _write_dark(flight, root / "dark")
    samples = flight.sky_samples()
    for index, (stamp, spectrum) in enumerate(zip(samples.stamp.tolist(), samples.irradiance, strict=True)):
        write_asd(
            root / "asd" / f"sky{index:05d}.asd",
            spectrum,
            stamp=stamp,
            utc_offset=round(settings.utc_offset_h * 3600),
            reference_stamp=int(samples.stamp[0]) - 600,  # taken ten minutes before the flight
        )
    write_references(flight, root)
    write_calibration(flight, root / "calibration.zarr")
    if lab is not None:
        (root / "lab").mkdir()
        store_sweep(lab, root / "lab" / "sweep.zarr", truth=truth)
    _write_flight(flight, root, block_lines, progress, truth)
    # places of the ground under the first, middle and last scan line; heights above the ellipsoid
    pose = flight.pose(np.array([0.0, 0.5, 1.0]) * flight.line_times[-1] / 1e9)
    ground = flight.frame.local(pose["latitude"], pose["longitude"], flight.frame.height)
    ground[:, 2] = 0.0
    rows = "".join(
        f"P{number},{latitude:.9f},{longitude:.9f},{height:.3f}\n"
        for number, latitude, longitude, height in zip(
            itertools.count(1), *flight.frame.geodetic(ground), strict=False
        )
    )
    (root / SURVEY).write_text(f"name,latitude,longitude,ellipsoidal_height_m\n{rows}", encoding="ascii")
    path = root / "collect.toml"
    # a reader that finds this file finds all the others whole
    path.write_text(_collect_text(flight, lab is not None), encoding="utf-8")
    return path


def _flight_of(settings: SimulationSettings) -> Flight:
    if settings.scene == "plan":
        return PlanFlight(settings)
    if settings.scene == "checkerboard":
        return CheckerboardFlight(settings)
    from .rendered_flight import RenderedFlight  # brings the tracer along

    return RenderedFlight(settings)


def _prepare(root: Path, overwrite: bool) -> Path:
    if root.exists() and not root.is_dir():
        raise StoreError(
            f"{root} is a file", mend="name a folder for the simulated collect", code="folder-is-file"
        )
    if root.is_dir() and any(root.iterdir()):
        if not overwrite:
            mend = "name another folder, or replace an earlier collect with {}"
            raise StoreError(
                f"{root} is not empty",
                mend=mend.format("overwrite=True"),
                option=mend.format("--overwrite"),
                code="folder-not-empty",
            )
        # a collect, or parts of one, that no simulation wrote is not replaced
        parts = [part for part in PARTS if (root / part).exists() or (root / part).is_symlink()]
        if parts and head_of(root / "collect.toml", len(MARKER)) != MARKER.encode():
            raise StoreError(
                f"{root} holds {', '.join(parts[:3])}, and no collect.toml that begins {MARKER!r}",
                expected="an earlier simulated collect",
                mend="name another folder; nothing was removed",
                code="folder-foreign",
            )
        (root / "collect.toml").write_text(_UNFINISHED, encoding="utf-8")
        for part in PARTS[:-1]:
            target = root / part
            if target.is_dir() and not target.is_symlink():
                shutil.rmtree(target)
            else:
                target.unlink(missing_ok=True)
    for part in ("flight", "dark", "asd"):
        (root / part).mkdir(parents=True)
    # whose the folder is, also where this run does not come to its end
    (root / "collect.toml").write_text(_UNFINISHED, encoding="utf-8")
    return root


def _instrument_stamps(since_start: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.asarray((since_start + _BOOT) // 1000, dtype=np.int64)


def _frame_stamps(middles: NDArray[np.int64], settings: SimulationSettings) -> NDArray[np.int64]:
    half = round(settings.exposure_time_ms * 1e6 / 2)
    return _instrument_stamps(
        middles
        + {"start": -half, "mid": 0, "end": half}[settings.stamp]
        - round(settings.frame_clock_offset_s * 1e9)
    )


def _comments(flight: Flight) -> dict[str, object]:
    # Headwall writes these fields below the ENVI part of a header.
    settings = flight.settings
    return {
        "AOI width": settings.columns,
        "Array Pixel Pitch (um)": 7.4,
        "AverageDispersion": round(float(flight.imager.spacing.mean()), 6),
        "Exposure (ms)": settings.exposure_time_ms,
        "HSIII_VERSION": CAMERA_SOFTWARE,
        "Lens EFL (mm)": 12,
        "Serial Number": "SIM-0001",
    }


def _write_settings_file(folder: Path, settings: SimulationSettings) -> None:
    write_settings(
        folder / "settings.txt",
        {"Exposure (ms)": settings.exposure_time_ms, "Frame Period (ms)": settings.frame_period_ms},
    )


def _write_dark(flight: Flight, folder: Path) -> None:
    settings = flight.settings
    dark = flight.dark_frames()
    with BilWriter(folder / "raw_0", flight.wavelength, settings.columns, _comments(flight)) as cube:
        cube.append(dark)
    frames = np.arange(len(dark), dtype=np.int64)
    middles = np.rint(frames * settings.frame_period_ms * 1e6).astype(np.int64) - _DARK_LEAD
    write_frame_index(folder / "frameIndex_0.txt", frames, _frame_stamps(middles, settings))
    _write_settings_file(folder, settings)


def _write_flight(
    flight: Flight, root: Path, block_lines: int, progress: Progress | None, with_truth: bool
) -> None:
    settings, folder = flight.settings, root / "flight"
    truth = TruthStore(flight, root / "truth.zarr") if with_truth else None
    painted = PaintedRectangles(flight)
    recorded = settings.recorded
    starts = settings.cube_starts.tolist()
    memory: Lines | None = None
    for first, last in itertools.pairwise(starts):
        frames = first + np.flatnonzero(recorded[first:last])
        name = f"{frames[0]}"
        painted.begin(f"raw_{name}")
        with BilWriter(
            folder / f"raw_{name}", flight.wavelength, settings.columns, _comments(flight)
        ) as cube:
            for begin in range(first, last, block_lines):
                end = min(begin + block_lines, last)
                block = flight.lines(begin, end, into=memory)
                memory = block if memory is None or len(memory.counts) < len(block.counts) else memory
                is_recorded = recorded[begin:end]
                counts = block.counts if is_recorded.all() else block.counts[is_recorded]
                cube.append(flight.detector.convert(counts))
                if truth is not None:
                    truth.write(begin, block, is_recorded)
                painted.add(block, is_recorded)
                if progress is not None:
                    progress(end, settings.lines)
        stamps = _frame_stamps(flight.line_times[frames], settings)
        write_frame_index(folder / f"frameIndex_{name}.txt", frames, stamps)
    painted.write(root / REGIONS, CAMERA_SOFTWARE)
    _write_settings_file(folder, settings)
    since = np.arange(
        -_NAVIGATION_MARGIN,
        int(flight.line_times[-1]) + _NAVIGATION_MARGIN,
        10**9 // settings.navigation_rate,
        dtype=np.int64,
    )
    utc = (flight.start + since).astype("datetime64[ns]")
    pose = flight.pose(since / 1e9)
    write_navigation(folder / "imu_gps.txt", pose, _instrument_stamps(since), utc)
    write_sbet(folder / "trajectory.sbet", pose, utc)


def _collect_text(flight: Flight, with_sweep: bool) -> str:
    settings = flight.settings
    recorded = np.flatnonzero(settings.recorded)
    flightlines = "".join(
        f"""
[[flightlines]]
id = "raw_{name}"
cube = "flight/raw_{name}.hdr"
frame_index = "flight/frameIndex_{name}.txt"
nav = "flight/imu_gps.txt"
"""
        for name in [int(recorded[recorded >= first][0]) for first in settings.cube_starts[:-1]]
    )
    navigation = "\n".join(f'{key} = "{value}"' for key, value in CONVENTION.items())
    half_width = settings.columns / 2 * PIXEL_ANGLE_RAD
    mounting = {"boresight_deg": flight.trajectory.boresight, "lever_arm_m": flight.trajectory.lever_arm}
    geometry = "\n".join(f"{key} = {[float(number) for number in three]}" for key, three in mounting.items())
    uncertainty_s = settings.clock_uncertainty_s
    calibration = 'sweep = "lab/sweep.zarr"' if with_sweep else 'path = "calibration.zarr"'
    clock = "" if uncertainty_s is None else f"clock_uncertainty_s = {float(uncertainty_s)!r}\n"
    return f"""{MARKER}: seed {settings.seed}, truth in truth.zarr

[collect]
name = "simulated car park"

[camera]
bit_depth = {settings.bit_depth}
exposure_time_ms = {float(settings.exposure_time_ms)!r}
frame_period_ms = {float(settings.frame_period_ms)!r}
stamp = "{settings.stamp}"

[calibration]
{calibration}

[dark]
cubes = ["dark/raw_0.hdr"]

[navigation]
{navigation}

[geometry]
ground = {flight.frame.height!r}
fov_deg = {2 * np.degrees(np.arctan(half_width)):.9f}
{geometry}

[irradiance]
files = "asd/*.asd"
quantity = "irradiance"
utc_offset_h = {float(settings.utc_offset_h)!r}
clock_offset_s = {float(settings.clock_offset_s)!r}
{clock}stamp = "{settings.irradiance_stamp}"
fwhm_nm = {float(settings.irradiance_fwhm_nm)!r}
{flightlines}
[[references]]
instrument = "svc"
files = "{SVC_FOLDER}/*.sig"

[[references]]
instrument = "asd"
files = "{ASD_FOLDER}/*.asd"
"""


def simulate_line(
    *,
    lines: int = 64,
    bands: int = 272,
    columns: int = 32,
    seed: int = 0,
    matched: bool = False,
    **effects: Any,
) -> xr.Dataset:
    """Simulate a flight line in memory, with its truth, for tests of single functions.

    Parameters
    ----------
    lines, bands, columns, seed
        As for `simulate_collect`; the scene is the plan unless ``scene="rendered"`` asks for triangles.
    matched
        Add ``matched_irradiance``: what every element would have seen of each irradiance sample, exactly.
    **effects
        Fields of `hyperpaint.simulation.SimulationSettings`. ``quantise=False`` leaves the counts float32.

    Returns
    -------
    A flight line as the store holds one (``counts``, ``dark_counts``, ``radiance_gain``, ``irradiance`` ...),
    with ``true_radiance``, ``true_reflectance``, ``surface`` and ``true_saturated`` beside it.
    ``dark_counts`` is the mean of the dark frames with ``quantise``, else the dark itself.

    Raises
    ------
    SchemaError
        An effect is unknown or out of range; all are listed.

    Examples
    --------
    >>> line = simulate_line(lines=4, bands=5, columns=3, noise=False, quantise=False)
    >>> rate = (line.counts - line.dark_counts) / line.exposure_time
    >>> float(abs(line.radiance_gain * rate / line.true_radiance - 1).max()) < 1e-5
    True
    """
    settings = SimulationSettings.of(
        {"lines": lines, "bands": bands, "columns": columns, "seed": seed, **effects}
    )
    flight = _flight_of(settings)
    return line_dataset(flight, flight.lines(0, settings.lines), matched=matched)
