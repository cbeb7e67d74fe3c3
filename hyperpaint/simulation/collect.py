"""A simulated collect: files of the instruments, calibration and truth.

Two field spectrometers measured the paints of the cars on the ground before the flight. The truth of their
files is the spectrum of the paint near normal, without mirrored sky. Beyond 1000 nm, where only the SVC
measures, the light has no absorption bands.

A region of a paint is a rectangle of neighbouring pixels that show only the paint of one car, in the sun,
without mirrored sun, and at nearly the same height. A paint gets its largest rectangle over all cars and
flight lines, minus a margin. Lines are processed once and in order, so that memory does not grow with the
flight.
"""

from __future__ import annotations

import itertools
import json
import shutil
from collections.abc import Iterator, Mapping
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
from .flight import CheckerboardFlight, Flight, Lines, PlanFlight, sky_irradiance
from .instruments import (
    ASD_WAVELENGTH,
    CAMERA_SOFTWARE,
    SVC_DETECTORS,
    svc_wavelengths,
    write_asd,
    write_asd_reflectance,
    write_bil_header,
    write_frame_index,
    write_navigation,
    write_sbet,
    write_settings,
    write_svc,
)
from .rendering.platforms import CONVENTION
from .settings import ORIGIN, PIXEL_ANGLE_RAD, SimulationSettings
from .stores import TruthStore, line_dataset, store_sweep, write_calibration
from .sweep import Sweep, SweepSettings

SVC_FOLDER, ASD_FOLDER = "svc", "asd_reflectance"

_STEP_NM = 0.1
_LEAD_S, _PAINT_S, _PANEL_S = 3600, 60, 15  # times from first paint to flight, between paints, panel to paint
_MARGIN_NM = 40.0  # beyond the outer channels, more than the reach of a line shape


#: Name of the file of regions.
REGIONS = "regions.geojson"

#: Maximum height difference of neighbouring pixels over their distance: includes roofs and bonnets, not
#: doors.
_MAX_SLOPE = 0.1
_MIN_SIDE_PIXELS = 6  # minimum length of the shorter side
_MARGIN_DIVISOR = 8  # shorter side over the margin at every edge

#: First and last line, first and last column of a rectangle.
_Box = tuple[int, int, int, int]


class PaintedRectangles:
    """The largest rectangle of every paint, found scan line by scan line.

    Examples
    --------
    >>> import tempfile
    >>> flight = PlanFlight(SimulationSettings(lines=64, bands=2, columns=160, scene="plan"))
    >>> rectangles = PaintedRectangles(flight)
    >>> rectangles.begin("raw_0")
    >>> rectangles.add(flight.lines(0, 64), np.ones(64, bool))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     rectangles.write(Path(folder) / REGIONS, "an example")
    ...     regions = json.loads((Path(folder) / REGIONS).read_text())
    >>> [feature["properties"]["name"] for feature in regions["features"]]
    ['ir_black', 'red', 'green', 'yellow']
    """

    def __init__(self, flight: Flight) -> None:
        self._flight = flight
        self._step = _MAX_SLOPE * flight.ground_sample
        self._rectangles_by_paint: dict[int, tuple[str, _Box]] = {}
        self._areas: dict[int, int] = {}
        self.begin("")

    def begin(self, flightline: str) -> None:
        # start a flight line, since rectangles do not extend over two lines
        columns = self._flight.settings.columns
        self._flightline, self._line = flightline, 0
        self._label = np.full(columns, -1, np.int32)
        self._heights = np.zeros(columns)
        self._run_lengths = np.zeros(columns, np.int64)

    def add(self, lines: Lines, recorded: NDArray[np.bool_]) -> None:
        # add scan lines in order; only ``recorded`` lines (along_track,) are used
        labels = self._flight.clean_paint(lines)
        heights = np.asarray(lines.layers.get("up", np.zeros(labels.shape)), np.float64)
        for label, line_heights in zip(labels[recorded], heights[recorded], strict=True):
            continues = (label == self._label) & (np.abs(line_heights - self._heights) <= self._step)
            self._run_lengths = np.where(label < 0, 0, np.where(continues, self._run_lengths + 1, 1))
            self._label, self._heights = label, line_heights
            # keep rectangles that end at this scan line and are larger than those before
            for run_start, run_stop in self._runs():
                paint = int(label[run_start]) % len(self._flight.paints)
                for height, start, stop in _rectangles(self._run_lengths[run_start:run_stop].tolist()):
                    width = stop - start
                    if min(height, width) >= _MIN_SIDE_PIXELS and height * width > self._areas.get(paint, 0):
                        self._areas[paint] = height * width
                        box = (self._line - height + 1, self._line, run_start + start, run_start + stop - 1)
                        self._rectangles_by_paint[paint] = self._flightline, box
            self._line += 1

    def _runs(self) -> Iterator[tuple[int, int]]:
        # ranges of columns with one label, similar heights, and enough lines for a rectangle
        enough = self._run_lengths >= _MIN_SIDE_PIXELS
        if not enough.any():
            return
        is_joined = enough[1:] & enough[:-1] & (np.diff(self._label) == 0)
        is_joined &= np.abs(np.diff(self._heights)) <= self._step
        edges = np.flatnonzero(np.diff(np.concatenate([[False], is_joined, [False]]).astype(np.int8)))
        for begin, end in edges.reshape(-1, 2).tolist():
            if end + 1 - begin >= _MIN_SIDE_PIXELS:
                yield begin, end + 1

    def write(self, path: Path, generator: str) -> None:
        # write the regions as GeoJSON in coordinates of the sensor, in the order of the paints.
        # ``generator`` marks the file as simulated.
        features = []
        for number, (flightline, (top, bottom, left, right)) in sorted(self._rectangles_by_paint.items()):
            margin = max(1, min(bottom + 1 - top, right + 1 - left) // _MARGIN_DIVISOR)
            top, bottom, left, right = top + margin, bottom - margin, left + margin, right - margin
            ring = [[left, top], [right, top], [right, bottom], [left, bottom], [left, top]]
            paint = self._flight.paints[number]
            feature = {
                "type": "Feature",
                "properties": {
                    "name": paint,
                    "flightline": flightline,
                    "reference": paint,
                    **self._flight.paint_properties(paint),
                },
                "geometry": {"type": "Polygon", "coordinates": [ring]},
            }
            features.append(json.dumps(feature))
        head = '"type": "FeatureCollection",\n"coordinates": "sensor",\n'
        rows = ",\n".join(features)
        path.write_text(
            f'{{\n{head}"generator": {json.dumps(generator)},\n"features": [\n{rows}\n]\n}}\n',
            encoding="utf-8",
        )


def _rectangles(heights: list[int]) -> Iterator[tuple[int, int, int]]:
    """Yield height, first column and end column of all maximal rectangles under a histogram of heights.

    Examples
    --------
    >>> list(_rectangles([2, 3, 1]))
    [(3, 1, 2), (2, 0, 2), (1, 0, 3)]
    """
    rising: list[tuple[int, int]] = []  # stack of increasing heights, with the first column of each
    for column, height in enumerate([*heights, 0]):
        begin = column
        while rising and rising[-1][0] >= height:
            top_height, begin = rising.pop()
            yield top_height, begin, column
        rising.append((height, begin))


def write_references(flight: Flight, folder: Path) -> None:
    # write a file of both spectrometers for every paint of the cars, named after the paint.
    # The files are in the folders `SVC_FOLDER` and `ASD_FOLDER` of the collect.
    settings = flight.settings
    svc, asd = folder / SVC_FOLDER, folder / ASD_FOLDER
    for directory in (svc, asd):
        directory.mkdir()
    nm = svc_wavelengths()
    grid = spectral_grid(nm.min() - _MARGIN_NM, nm.max() + _MARGIN_NM, _STEP_NM)
    light = sky_irradiance(settings.sky, settings.sun[0], grid).sum(axis=0) / np.pi
    # radiance of the white panel, then of the paints
    spectra = np.concatenate([light[None], light * flight.paint_reflectance(flight.paints, grid)])
    svc_spectra = np.concatenate(
        [convolve_gaussian(spectra, grid, detector.wavelength, detector.fwhm) for detector in SVC_DETECTORS],
        axis=1,
    )
    asd_spectra = convolve_gaussian(spectra, grid, ASD_WAVELENGTH, settings.irradiance_fwhm_nm)
    zone, start = round(settings.utc_offset_h * 3600), flight.start // 10**9
    for index, paint in enumerate(flight.paints, 1):
        panel = start - _LEAD_S + _PAINT_S * index
        target = panel + _PANEL_S
        write_svc(
            svc / f"{paint}.sig",
            svc_spectra[0],
            svc_spectra[index],
            stamps=(panel, target),
            utc_offset=zone,
            position=ORIGIN[:2],
            sun=settings.sun,
        )
        write_asd_reflectance(
            asd / f"{paint}.asd",
            asd_spectra[index],
            asd_spectra[0],
            stamp=target,
            utc_offset=zone,
            reference_stamp=panel,
        )


#: File of surveyed points of the pavement, as from a GNSS receiver on a pole.
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

#: First line of the ``collect.toml`` of a simulated collect.
MARKER = "# simulated by hyperpaint"

_UNFINISHED = f"{MARKER}: not finished\n"

_BOOT = 1_234_567_891_000  # instrument's clock at the first line [ns]; it has no date
_NAVIGATION_MARGIN_NS = 2 * 10**9  # navigation before and after the flight
_DARK_LEAD_NS = 60 * 10**9  # time from the first dark frame to the first line


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
    """Simulate a flight over a car park and write it in the formats of the instruments.

    The files are a Headwall folder (``flight``: cubes, frame index, navigation, settings), a dark cube
    (``dark``), an irradiance series (``asd``), reflectance of the cars' paints from two field spectrometers
    (``svc``, ``asd_reflectance``), ``calibration.zarr``, ``truth.zarr``, ``regions.geojson`` with a rectangle
    of pure, sunlit pixels of every paint that has a level area of six by six pixels, and finally
    ``collect.toml``.

    Parameters
    ----------
    folder
        Folder of the collect; created if it does not exist.
    lines, bands, columns
        Shape of the cube.
    seed
        Random seed; the same seed gives the same bytes of every instrument file.
    scene
        "rendered": a ray-traced car park of triangles, with shadows, glint and mixed pixels. "plan": a flat
        picture in which a pixel shows one level surface, computed fast. "checkerboard": level squares with
        known map coordinates of their corners.
    truth
        Write ``truth.zarr``: radiance and reflectance of every sample, class and masks of every pixel; except
        for a plan also the ground position of every pixel, and the mounting of the camera; for a rendered
        scene also shadow, purity and car.
    sweep
        Also write a monochromator sweep of the same camera, ``lab/sweep.zarr``, with these effects (fields of
        `hyperpaint.simulation.SweepSettings`, ``{}`` for the defaults), and its truth,
        ``lab/sweep_truth.zarr``. ``collect.toml`` then names the sweep instead of ``calibration.zarr``.
    overwrite
    progress
    block_lines
        Lines computed together; limits memory and does not change values.
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
        The folder is not empty, and ``overwrite`` is not set.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = simulate_collect(folder, lines=8, bands=4, columns=6, scene="plan")
    ...     print(*sorted(entry.name for entry in path.parent.iterdir()))
    asd asd_reflectance calibration.zarr collect.toml dark flight regions.geojson survey.csv svc truth.zarr
    """
    target = input_path(folder, "a folder for the collect", StoreError, "simulate to a folder, and copy it")
    settings = SimulationSettings.of(
        {"lines": lines, "bands": bands, "columns": columns, "seed": seed, "scene": scene, **effects}
    )
    if not settings.quantise:
        raise SchemaError(
            "quantise=False, but files need whole counts",
            mend="use simulate_line for float32 counts in memory",
            code="option-conflict",
        )
    if block_lines < 1:
        raise SchemaError(
            f"block_lines={block_lines}", expected="a whole number above 0", code="value-out-of-range"
        )
    lab = None if sweep is None else Sweep(SweepSettings.of(sweep, settings))
    flight = flight_of(settings)
    root = _prepare(target, overwrite)
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
    # surveyed points on the ground under the first, middle and last scan line; heights above the ellipsoid
    pose = flight.trajectory.pose(np.array([0.0, 0.5, 1.0]) * flight.line_times[-1] / 1e9)
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
    # written last, so that a reader of this file finds all other files complete
    path.write_text(_collect_text(flight, lab is not None), encoding="utf-8")
    return path


def flight_of(settings: SimulationSettings) -> Flight:
    if settings.scene == "plan":
        return PlanFlight(settings)
    if settings.scene == "checkerboard":
        return CheckerboardFlight(settings)
    from .rendered_flight import RenderedFlight  # imports the tracer

    return RenderedFlight(settings)


def _prepare(root: Path, overwrite: bool) -> Path:
    if root.exists() and not root.is_dir():
        raise StoreError(
            f"{root} is a file", mend="pass a folder for the simulated collect", code="folder-is-file"
        )
    if root.is_dir() and any(root.iterdir()):
        if not overwrite:
            mend = "choose another folder, or replace an earlier collect with {}"
            raise StoreError(
                f"{root} is not empty",
                mend=mend.format("overwrite=True"),
                option=mend.format("--overwrite"),
                code="folder-not-empty",
            )
        # files of a collect that no simulation wrote are not replaced
        entries = [name for name in PARTS if (root / name).exists() or (root / name).is_symlink()]
        if entries and head_of(root / "collect.toml", len(MARKER)) != MARKER.encode():
            raise StoreError(
                f"{root} holds {', '.join(entries[:3])}, and no collect.toml that begins with {MARKER!r}",
                expected="an earlier simulated collect",
                mend="choose another folder; nothing was removed",
                code="folder-foreign",
            )
        (root / "collect.toml").write_text(_UNFINISHED, encoding="utf-8")
        for name in PARTS[:-1]:
            target = root / name
            if target.is_dir() and not target.is_symlink():
                shutil.rmtree(target)
            else:
                target.unlink(missing_ok=True)
    for name in ("flight", "dark", "asd"):
        (root / name).mkdir(parents=True)
    # mark the folder as simulated, also if this run is interrupted
    (root / "collect.toml").write_text(_UNFINISHED, encoding="utf-8")
    return root


def _instrument_stamps(since_start: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.asarray((since_start + _BOOT) // 1000, dtype=np.int64)


def _frame_stamps(mid_times: NDArray[np.int64], settings: SimulationSettings) -> NDArray[np.int64]:
    half_exposure = round(settings.exposure_time_ms * 1e6 / 2)
    return _instrument_stamps(
        mid_times
        + {"start": -half_exposure, "mid": 0, "end": half_exposure}[settings.stamp]
        - round(settings.frame_clock_offset_s * 1e9)
    )


def _write_dark(flight: Flight, folder: Path) -> None:
    settings = flight.settings
    dark = flight.dark_frames()
    dark.astype("<u2").tofile(folder / "raw_0")
    write_bil_header(folder / "raw_0", flight.wavelength, settings, len(dark))
    frames = np.arange(len(dark), dtype=np.int64)
    mid_times = np.rint(frames * settings.frame_period_ms * 1e6).astype(np.int64) - _DARK_LEAD_NS
    write_frame_index(folder / "frameIndex_0.txt", frames, _frame_stamps(mid_times, settings))
    write_settings(folder / "settings.txt", settings)


def _write_flight(
    flight: Flight, root: Path, block_lines: int, progress: Progress | None, with_truth: bool
) -> None:
    settings, folder = flight.settings, root / "flight"
    truth = TruthStore(flight, root / "truth.zarr") if with_truth else None
    painted = PaintedRectangles(flight)
    recorded = settings.recorded
    reusable: Lines | None = None
    for first_frame, end_frame in itertools.pairwise(settings.cube_starts.tolist()):
        frames = first_frame + np.flatnonzero(recorded[first_frame:end_frame])
        name = f"{frames[0]}"
        painted.begin(f"raw_{name}")
        with (folder / f"raw_{name}").open("wb") as cube:
            for begin in range(first_frame, end_frame, block_lines):
                end = min(begin + block_lines, end_frame)
                block = flight.lines(begin, end, into=reusable)
                reusable = block if reusable is None or len(reusable.counts) < len(block.counts) else reusable
                is_recorded = recorded[begin:end]
                counts = block.counts if is_recorded.all() else block.counts[is_recorded]
                cube.write(np.ascontiguousarray(flight.detector.convert(counts), "<u2").data)
                if truth is not None:
                    truth.write(begin, block, is_recorded)
                painted.add(block, is_recorded)
                if progress is not None:
                    progress(end, settings.lines)
        write_bil_header(folder / f"raw_{name}", flight.wavelength, settings, len(frames))
        write_frame_index(
            folder / f"frameIndex_{name}.txt", frames, _frame_stamps(flight.line_times[frames], settings)
        )
    painted.write(root / REGIONS, CAMERA_SOFTWARE)
    write_settings(folder / "settings.txt", settings)
    since = np.arange(
        -_NAVIGATION_MARGIN_NS,
        int(flight.line_times[-1]) + _NAVIGATION_MARGIN_NS,
        10**9 // settings.navigation_rate,
        dtype=np.int64,
    )
    utc = (flight.start + since).astype("datetime64[ns]")
    pose = flight.trajectory.pose(since / 1e9)
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
        As for `simulate_collect`; by default ``scene="plan"``.
    matched
        Add ``matched_irradiance``: irradiance samples weighted by the response of every element.
    **effects
        Fields of `hyperpaint.simulation.SimulationSettings`. ``quantise=False`` gives float32 counts.

    Returns
    -------
    A flight line with the variables of a store (``counts``, ``dark_counts``, ``radiance_gain``,
    ``irradiance`` ...), and ``true_radiance``, ``true_reflectance``, ``surface`` and ``true_saturated``.
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
    flight = flight_of(settings)
    return line_dataset(flight, flight.lines(0, settings.lines), matched=matched)
