"""Settings of a simulated collect: every effect is a field, declared with unit, range and default.

The clock of a flight follows the sun of its scene; the ephemeris is independent of `hyperpaint.light`.
"""

import itertools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import Any, Self

import numpy as np

from hyperpaint.base import (
    Array,
    Floats,
    Problems,
    SchemaError,
    Spelling,
    as_argument,
    check_fields,
    declared,
    fact,
    is_number,
)

#: Instants of an exposure that a time stamp can mark.
STAMPS = ("start", "mid", "end")

#: Scenes: a flat picture of a car park, a ray-traced car park of triangles, or level squares with known
#: corners.
SCENES = ("plan", "rendered", "checkerboard")

#: Line shapes of the imager.
SHAPES = ("gaussian", "slit")

#: Motions of a platform around its course.
WOBBLES = ("none", "slow", "calm", "rough")

#: Width of a scene across the track, unless it is a checkerboard.
SWATH_M = 16.0

#: Angle of a pixel: 7.4 um pixels behind a lens of 12 mm [rad].
PIXEL_ANGLE_RAD = 7.4e-6 / 12e-3

#: Maximum number of paths traced for a pixel.
MOST_SAMPLES = 1 << 14

_RANGE = "value-out-of-range"

#: Largest seed of a random generator.
MAX_SEED = 2**63 - 1

#: Paints of the cars: fourteen solid paints, or the paints of a real fleet (`rendering.scene_spectra`).
FLEETS = ("solid", "real")

#: Kinds of light.
SKIES = ("clear", "near_sunset", "overcast")

#: Zenith angle and azimuth of the sun near sunset [degree].
NEAR_SUNSET = (80.0, 292.0)

#: Latitude and longitude [degree] of the ground under the first line, and its height above the ellipsoid [m].
ORIGIN = (43.0845, -77.6749, 160.0)


def finite_floats(values: Any, name: str, problems: Problems) -> Floats:
    # values as a new float64 array, and note entries that are not finite numbers
    try:
        array = np.array(values, dtype=np.float64, order="C")
    except (TypeError, ValueError):
        problems.add(f"{name} is not an array of numbers", code="type-wrong")
        return np.zeros(0)
    problems.add_if(
        not np.isfinite(array).all(),
        f"{name} has {np.count_nonzero(~np.isfinite(array))} values that are not finite",
        code="not-finite",
    )
    return array


def moment_of(value: Any) -> np.datetime64:
    # time [ns]; NaT for a value that is not a time
    try:
        return np.datetime64(np.asarray(value, "datetime64[ns]").item(), "ns")
    except (ValueError, TypeError):
        return np.datetime64("NaT", "ns")


#: Default start of a flight.
DEFAULT_START = np.datetime64("2021-07-20T17:10:00", "ns")

#: Maximum angle between the sun at the default start and the sun of the scene, to use this start [degree].
MAX_DEFAULT_ANGLE_DEG = 3.0

#: Maximum angle between the sun at another time and the sun of the scene, to use this time [degree].
MAX_ANGLE_DEG = 1.0


def sun_at(moment: Array, latitude: float, longitude: float) -> tuple[Floats, Floats]:
    """Return zenith angle and azimuth of the sun [degree] at UTC times, to some hundredths of a degree.

    The low-precision ephemeris of the Astronomical Almanac, without refraction.

    Examples
    --------
    >>> zenith, azimuth = sun_at(np.datetime64("2021-07-20T17:10"), 43.04, -77.7)
    >>> float(zenith.round(1)), float(azimuth.round(-1))
    (22.6, 180.0)
    """
    days = (np.asarray(moment, "datetime64[s]") - np.datetime64("2000-01-01T12:00:00")).astype(float) / 86400
    anomaly = np.radians(357.528 + 0.9856003 * days)
    longitude_deg = 280.460 + 0.9856474 * days + 1.915 * np.sin(anomaly) + 0.020 * np.sin(2 * anomaly)
    ecliptic, tilt = np.radians(longitude_deg), np.radians(23.439 - 4e-7 * days)
    ascension = np.arctan2(np.cos(tilt) * np.sin(ecliptic), np.cos(ecliptic))
    declination = np.arcsin(np.sin(tilt) * np.sin(ecliptic))
    # sidereal rotation: one more turn in a year than days
    hour = np.radians(280.46062 + 360.98564737 * days + longitude) - ascension
    phi = np.radians(latitude)
    height = np.sin(phi) * np.sin(declination) + np.cos(phi) * np.cos(declination) * np.cos(hour)
    north = np.cos(phi) * np.sin(declination) - np.sin(phi) * np.cos(declination) * np.cos(hour)
    east = -np.cos(declination) * np.sin(hour)
    return np.degrees(np.arccos(np.clip(height, -1, 1))), np.degrees(np.arctan2(east, north)) % 360.0


@lru_cache(maxsize=64)  # a year of minutes is computed
def when_sun_stands(zenith: float, azimuth: float, latitude: float, longitude: float) -> np.datetime64:
    """Return the time at which the sun is in a direction [degree], on the default day or in its year.

    The default start is used if its sun is within `MAX_DEFAULT_ANGLE_DEG` of the direction; otherwise the
    time with the nearest direction, first on the default day, then in its year.

    If the sun is never in this direction (in the north, or high in the east), only the zenith angle agrees:
    the brightness fits the clock, the azimuth of the light does not.

    Raises
    ------
    SchemaError
        The sun never has that zenith angle.

    Examples
    --------
    >>> when_sun_stands(25.0, 178.0, 43.0845, -77.6749)
    np.datetime64('2021-07-20T17:10:00.000000000')
    """
    if (
        _angle_between(*sun_at(np.asarray(DEFAULT_START), latitude, longitude), zenith, azimuth)
        <= MAX_DEFAULT_ANGLE_DEG
    ):
        return DEFAULT_START
    minute = np.timedelta64(1, "m")
    # the default day, from noon to noon UTC, for a place in the west
    default_day = DEFAULT_START.astype("datetime64[m]") + np.arange(-12 * 60, 12 * 60) * minute
    year = DEFAULT_START.astype("datetime64[Y]").astype("datetime64[m]") + np.arange(365 * 24 * 60) * minute
    suns = []
    for moments in (default_day, year):
        zeniths, azimuths = sun_at(moments, latitude, longitude)
        angles = _angle_between(zeniths, azimuths, zenith, azimuth)
        nearest = int(np.argmin(angles))
        if angles[nearest] <= MAX_ANGLE_DEG:
            return np.datetime64(moments[nearest], "ns")
        suns.append((moments, zeniths, azimuths))
    for moments, zeniths, azimuths in suns:
        azimuth_differences = np.abs((azimuths - azimuth + 180.0) % 360.0 - 180.0)
        # of morning and afternoon, take the time with the nearer azimuth
        nearest = int(np.argmin(np.abs(zeniths - zenith) + 1e-3 * azimuth_differences))
        if abs(zeniths[nearest] - zenith) <= MAX_ANGLE_DEG:
            return np.datetime64(moments[nearest], "ns")
    min_zenith = sun_at(year, latitude, longitude)[0].min()
    raise SchemaError(
        f"sun_zenith={zenith:g}: at {latitude:.1f} degrees north the sun is always "
        f"{min_zenith:.1f} degrees or more from the zenith",
        mend="pass start_time= for a clock that disagrees with the sun, or another sun_zenith",
        code="sun-unreachable",
    )


def _angle_between(zenith: Floats, azimuth: Floats, other_zenith: float, other_azimuth: float) -> Floats:
    zenith_rad, other_zenith_rad = np.radians(zenith), np.radians(other_zenith)
    turn = np.cos(np.radians(azimuth - other_azimuth))
    cosine = (
        np.cos(zenith_rad) * np.cos(other_zenith_rad) + np.sin(zenith_rad) * np.sin(other_zenith_rad) * turn
    )
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


_MAX_FWHM_PIXELS = 50.0  # maximum width of a point spread
_MAX_TAPS = 101  # maximum rows or columns of a kernel


def _is_kernel(value: Any) -> bool:
    try:
        rows = [list(row) for row in value]
    except TypeError:
        return False
    width = len(rows[0]) if rows else 0
    has_odd_size = len(rows) % 2 == width % 2 == 1 and max(len(rows), width) <= _MAX_TAPS
    is_valid = has_odd_size and all(
        len(row) == width and all(is_number(x) and x >= 0 for x in row) for row in rows
    )
    return is_valid and sum(map(sum, rows)) > 0


@declared
@dataclass(frozen=True, kw_only=True)
class OpticsSettings:
    """Imperfections of a camera's optics and electronics, all off by default.

    Examples
    --------
    >>> OpticsSettings(psf_across_columns=1.5, keystone_columns=0.3).stray_light
    0.0
    """

    psf_across_columns: float = fact(
        0.0,
        "full width at half maximum of a Gaussian blur across the track [columns]; 0 for no blur; the "
        "variance is exact also for widths below a pixel",
        least=0.0,
        most=_MAX_FWHM_PIXELS,
    )
    psf_along_lines: float = fact(
        0.0,
        "full width at half maximum of a Gaussian blur along the track [lines]; 0 for no blur",
        least=0.0,
        most=_MAX_FWHM_PIXELS,
    )
    psf_kernel: Sequence[Sequence[float]] | None = fact(
        None,
        "weights of a blur that replaces the Gaussian blur, one row per line; they are divided by their sum; "
        "a weight right of the middle column moves light to the right, a weight after the middle row to "
        "later lines",
        kind="own",
        accepts=_is_kernel,
        phrase="rows of equally many numbers from 0 on, rows and columns odd and at most "
        f"{_MAX_TAPS}, with a sum above 0",
    )
    keystone_columns: float = fact(
        0.0,
        "displacement of the image of the last band to the right [columns]; the first band is displaced "
        "equally to the left, bands between them in proportion",
        least=-20.0,
        most=20.0,
    )
    stray_light: float = fact(
        0.0,
        "share of the light of a band that is scattered into all bands",
        least=0.0,
        most=0.5,
    )
    pedestal: float = fact(
        0.0,
        "offset of the counts of every frame, in flight and in the lab, that the dark does not contain",
        unit="count",
        least=-1000.0,
        most=30_000.0,
    )
    masked_columns: int = fact(
        0,
        "number of columns at each edge of the detector that receive no light; their gain is NaN, and their "
        "counts minus dark are the pedestal",
        least=0,
        most=10_000,
    )


_ISO_TIME = re.compile(r"[0-9]{4}-[0-9]{2}-[0-9]{2}([T ][0-9]{2}:[0-9]{2}(:[0-9]{2}(\.[0-9]{1,9})?)?)?")


def _is_start_time(value: object) -> bool:
    # times must fit the files of the spectrometer, which count seconds in 32 bits
    return (
        False
        if not isinstance(value, str) or not _ISO_TIME.fullmatch(value)
        else bool(np.datetime64("1980-01-01") <= moment_of(value) < np.datetime64("2038-01-01"))
    )


@declared
@dataclass(frozen=True, kw_only=True)
class SimulationSettings(OpticsSettings):
    """Size and effects of a simulated collect; every effect can be switched off.

    Raises
    ------
    SchemaError
        A value is out of its range; all are listed.

    Examples
    --------
    >>> SimulationSettings(lines=64).shape
    (64, 272, 320)
    >>> SimulationSettings(exposure_time_ms=-5.0, srf_shape="box")
    Traceback (most recent call last):
    hyperpaint.base.errors.SchemaError: the collect cannot be simulated:
      exposure_time_ms=-5.0, expected a number above 0 [value-out-of-range]
      srf_shape='box', expected one of gaussian, slit [choice-unknown]
    """

    lines: int = fact(512, "number of lines of the cube, dropped frames included", least=2, most=10_000_000)
    bands: int = fact(272, "number of bands of the cube", least=2, most=10_000)
    columns: int = fact(320, "number of columns of the cube", least=1, most=100_000)
    seed: int = fact(
        0,
        "seed of the random numbers for the scene, the detector pattern and the noise; the absorption lines "
        "of the light do not depend on it",
        least=0,
        most=MAX_SEED,
        phrase=f"a whole number from 0 to {MAX_SEED}",
    )
    scene: str = fact(
        "plan",
        '"plan": a flat picture in which a pixel is one level Lambert surface, made at once; "rendered": a '
        "car park of triangles, whose light is traced along the wobbling line of sight of the camera, with "
        'shadows, glint, light between neighbours and mixed pixels; "checkerboard": level Lambert squares '
        "along that line of sight, for questions of place",
        choices=SCENES,
    )
    swath: float = fact(
        SWATH_M,
        "width of the scene at the height where the columns cover it; other than 16 for a checkerboard only",
        unit="m",
        least=0.01,
        most=1000.0,
    )
    square: float = fact(0.16, "side of the squares of a checkerboard", unit="m", least=0.01, most=1000.0)
    board_turn: float = fact(
        27.0,
        "turn of a checkerboard on its map, clockwise from north",
        unit="degree",
        least=-360.0,
        most=360.0,
    )
    course: float = fact(
        0.0,
        "direction of flight, clockwise from true north; other than 0 for a checkerboard only",
        unit="degree",
        least=-360.0,
        most=360.0,
    )
    wobble: str = fact(
        "slow",
        'motion of the platform about its course: "slow" is three sines, "calm" has roll and pitch of 0.15 '
        'and heading of 1.1 degrees (1 sigma), "rough" 0.42 and 3.1 degrees; a plan ignores it',
        choices=WOBBLES,
    )
    boresight: tuple[float, float, float] = fact(
        (0.0, 0.0, 0.0),
        "mounting angles of the camera on the platform: roll, pitch and heading",
        unit="degree",
        length=3,
        least=-10.0,
        most=10.0,
    )
    lever_arm: tuple[float, float, float] = fact(
        (0.0, 0.0, 0.0),
        "vector from the reference point of the navigation to the camera: forward, right and down",
        unit="m",
        length=3,
        least=-2.0,
        most=2.0,
    )
    navigation_rate: int = fact(
        100, "number of rows of the navigation files per second, a divisor of 1e9", least=1, most=1000
    )
    samples: int = fact(
        16,
        "number of rays per pixel of a rendered scene; the true values are those of the rendered picture, "
        "for any number of rays",
        least=1,
        most=MOST_SAMPLES,
    )
    sky: str = fact(
        "clear",
        '"clear": the sun at ``sun_zenith`` and ``sun_azimuth``; "near_sunset": a clear sky with the sun 80 '
        'degrees from the zenith, in the west; "overcast": no sun, and the same sky in all directions',
        choices=SKIES,
    )
    fleet: str = fact(
        "real",
        'paints of a rendered scene: "solid", fourteen without flakes; "real", flakes, dust, worn ground',
        choices=FLEETS,
    )
    coat: bool = fact(
        True, "clear coats and flakes of a rendered scene; False leaves Lambert paints of the same spectra"
    )
    neighbours: bool = fact(
        True, "trees, a wall and lamps around a rendered car park; False leaves cars on an open place"
    )
    cubes: int = fact(
        1, "number of cubes of the flight; they share one navigation file", least=1, most=10_000
    )
    start_time: str | None = fact(
        None,
        "UTC at mid exposure of the first line; by default 2021-07-20T17:10:00, or another time at which the "
        "sun stands where the scene is lit from, at 43 degrees north. A zenith angle that the sun never has "
        "there (below 19 degrees) needs a time, except under an overcast sky",
        kind="own",
        accepts=_is_start_time,
        phrase="text like '2021-07-20T17:10:00', in UTC without a zone, from 1980 to 2037",
    )
    exposure_time_ms: float = fact(5.0, "exposure time of a line", unit="ms", least=0, above=True)
    frame_period_ms: float = fact(
        7.0, "time from the start of a line to the start of the next line", unit="ms", least=0, above=True
    )
    stamp: str = fact("end", "instant of the exposure that the time stamp of a frame marks", choices=STAMPS)
    first_wavelength: float = fact(
        399.356,
        "centre wavelength of the first band",
        unit="nm",
        least=380.0,
        most=1050.0,
        key="first_wavelength_nm",
    )
    last_wavelength: float = fact(
        1001.42,
        "centre wavelength of the last band",
        unit="nm",
        least=380.0,
        most=1050.0,
        key="last_wavelength_nm",
    )
    dispersion_bow_nm: float = fact(
        0.0,
        "deviation of the centre wavelength of the middle band from even spacing; zero for the first and "
        "last band",
        unit="nm",
        least=-20.0,
        most=20.0,
    )
    srf_shape: str = fact(
        "gaussian",
        'shape of the spectral response of a band; "slit" is a box ``fwhm_nm`` wide convolved with a box one '
        "band wide",
        choices=SHAPES,
    )
    fwhm_nm: float = fact(
        6.0,
        "full width at half maximum of the spectral response of a band",
        unit="nm",
        least=0,
        above=True,
    )
    fwhm_slope: float = fact(
        0.0, "relative change of ``fwhm_nm`` from the middle band to the last band", least=-0.5, most=0.5
    )
    smile_nm: float = fact(
        0.5,
        "smile: wavelength shift of the outermost columns relative to the centre column",
        unit="nm",
        least=-20.0,
        most=20.0,
    )
    noise: bool = fact(True, "whether the frames of the scene contain shot noise and read noise")
    dark_noise: bool = fact(True, "whether the dark frames contain read noise")
    quantise: bool = fact(True, "whole, clipped counts (uint16); False leaves float32 counts, in memory only")
    bit_depth: int = fact(12, "number of bits of the analogue-digital converter", least=1, most=16)
    electrons_per_count: float = fact(
        20.0, "electrons of the detector per count", unit="electron count-1", least=0, above=True
    )
    read_noise: float = fact(0.5, "standard deviation of the counts of a dark element", unit="count", least=0)
    dark_level: float = fact(110.0, "mean dark at an exposure time of zero", unit="count", least=0)
    dark_pattern: float = fact(
        3.0, "standard deviation of the dark between detector elements", unit="count", least=0
    )
    dark_rate: float = fact(0.0, "mean increase of the dark with exposure time", unit="count s-1", least=0)
    dark_frames: int = fact(64, "number of frames of the dark cube", least=1, most=100_000)
    nonuniformity: float = fact(
        0.02,
        "relative standard deviation of the responsivity between detector elements",
        least=0.0,
        most=0.2,
    )
    column_nonuniformity: float = fact(
        0.0,
        "relative standard deviation of the responsivity between columns, as from a slit of uneven width",
        least=0.0,
        most=0.2,
    )
    bad_elements: int = fact(
        0, "number of detector elements that receive no light; their gain is NaN", least=0, most=2**40
    )
    gain_u: float = fact(
        0.0,
        "relative standard uncertainty that the calibration states for its gain; 0 states none",
        least=0.0,
        most=0.5,
    )
    texture: float = fact(
        0.02,
        "relative standard deviation of the brightness between pixels of a surface, in a plan scene",
        least=0.0,
        most=0.2,
    )
    glint: float = fact(
        0.001,
        "fraction of the car pixels that mirror the sun and saturate, in a plan scene; in a rendered one "
        "clear coats mirror the sun where they face it",
        least=0.0,
        most=1.0,
    )
    sun_zenith: float = fact(
        25.0, "zenith angle of the sun in a clear sky", unit="degree", least=0.0, most=85.0
    )
    sun_azimuth: float = fact(
        178.0, "azimuth of the sun in a clear sky, clockwise from north", unit="degree", least=0.0, most=360.0
    )
    drift_per_minute: float = fact(
        0.001,
        "relative change of the direct light in a minute; diffuse light changes half as much the other way",
        least=-1.0,
        most=1.0,
    )
    cloud: tuple[float, float, float] | None = fact(
        None,
        "cloud as the fraction of direct light that it takes, duration of the ramp [s], its start [s after "
        "the first line]",
        kind="numbers",
        length=3,
    )
    dropped: int | Sequence[int] = fact(
        0,
        "frames that were never recorded: their number, with frames chosen by the seed, or the frame numbers",
        kind="own",
        accepts=lambda value: all(
            isinstance(number, int)
            for number in (value if isinstance(value, list | tuple | range) else [value])
        ),
        phrase="a number of frames or a list of frame numbers",
    )
    irradiance_interval_s: int = fact(
        2,
        "whole seconds between irradiance samples: the spectrometer stamps whole seconds",
        least=1,
        most=3600,
    )
    irradiance_margin_s: float = fact(
        6.0,
        "length of the irradiance record before and after the line",
        unit="s",
        least=0.0,
        most=3600.0,
    )
    irradiance_fwhm_nm: float = fact(
        3.0, "full width at half maximum of the spectrometer", unit="nm", least=0, above=True
    )
    irradiance_noise: float = fact(0.0, "relative noise of each irradiance value, 1 sigma", least=0)
    irradiance_stamp: str = fact(
        "end", "instant of the 0.68 s average that the stamp of a spectrometer marks", choices=STAMPS
    )
    irradiance_gap: tuple[float, float] | None = fact(
        None,
        "times [s after the first line] between which samples are missing",
        kind="numbers",
        length=2,
    )
    frame_clock_offset_s: float = fact(
        0.0,
        "delay of the clock that stamps the camera's frames relative to the clock of the navigation",
        unit="s",
        least=-1.0,
        most=1.0,
    )
    clock_offset_s: float = fact(
        37.25,
        "delay of the spectrometer's clock: UTC = stamp - utc_offset_h + clock_offset_s",
        unit="s",
        least=-86400.0,
        most=86400.0,
    )
    clock_uncertainty_s: float | None = fact(
        None,
        "declared uncertainty of ``clock_offset_s``; None declares none",
        kind="number",
        unit="s",
        least=0,
    )
    utc_offset_h: float = fact(
        -5.0,
        "time zone of the computer that logs the spectrometer: local time minus UTC",
        unit="h",
        least=-14.0,
        most=14.0,
    )

    def __post_init__(self) -> None:
        with Problems("the collect cannot be simulated", SchemaError) as problems:
            self._note_faults(problems, as_argument)

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Self:
        """Return settings from keywords.

        Raises
        ------
        SchemaError
            Keywords are unknown, or values out of range.
        """
        names = {field.name for field in fields(cls)}
        unknown = sorted(set(values) - names)
        SchemaError.raise_if(
            unknown,
            f"unknown settings {', '.join(unknown)}",
            expected=f"some of {', '.join(sorted(names))}",
            code="key-unknown",
        )
        return cls(**values)

    @classmethod
    def note_faults(cls, values: Mapping[str, Any], problems: Problems, spelled: Spelling) -> None:
        """Note the faults of values, by field, without creating settings; other fields take defaults."""
        draft = object.__new__(cls)
        for field in fields(cls):
            object.__setattr__(draft, field.name, values.get(field.name, field.default))
        draft._note_faults(problems, spelled)

    def _note_faults(self, problems: Problems, spelled: Spelling) -> None:
        problem_count = len(problems)
        check_fields(self, problems, spelled)
        # the clock of a flight without a start time is set by the sun
        sun_is_known = self.sky in SKIES and all(is_number(v) and 0 <= v <= 360 for v in self.sun)
        if self.start_time is None and sun_is_known:
            try:
                _ = self.start
            except SchemaError as error:
                problems.extend([error.problem])
        if len(problems) == problem_count:
            # contradictions between values, each of which is in its range
            def spelled_value(name: str) -> str:
                return spelled(name, getattr(self, name))

            minutes = (self.lines * self.frame_period_ms / 1000.0 + 2 * self.irradiance_margin_s) / 60.0
            elements, full = self.bands * self.columns, 2**self.bit_depth - 1
            dark = self.dark_level + self.dark_rate * self.exposure_time + self.pedestal
            blurs = self.psf_across_columns or self.psf_along_lines
            dropped, max_dropped = self.dropped, self.lines - 2 * self.cubes
            frames: set[int] = set() if isinstance(dropped, int) else set(dropped)
            is_beyond = any(not 0 <= frame < self.lines for frame in frames)
            cubes = itertools.starmap(range, itertools.pairwise(self.cube_starts.tolist()))
            is_board, option = self.scene == "checkerboard", "option-conflict"
            for is_fault, name, found, expected, mend, code in [
                (
                    self.exposure_time_ms > self.frame_period_ms,
                    "exposure_time_ms",
                    f" exceeds {spelled_value('frame_period_ms')}",
                    "",
                    "shorten the exposure, or lengthen the period",
                    "exposure-too-long",
                ),
                (
                    abs(self.drift_per_minute) * minutes > 0.9,
                    "drift_per_minute",
                    f" leaves no light after {minutes:.1f} minutes",
                    "",
                    "lower the drift, or take fewer lines",
                    "light-missing",
                ),
                (10**9 % self.navigation_rate, "navigation_rate", "", "a divisor of 1e9", "take 100", _RANGE),
                *(
                    (
                        not is_board and getattr(self, name) != value,
                        name,
                        "",
                        f"{value:g} for all scenes but a checkerboard",
                        "choose the scene checkerboard",
                        option,
                    )
                    for name, value in (("swath", SWATH_M), ("course", 0.0))
                ),
                (
                    self.first_wavelength >= self.last_wavelength,
                    "first_wavelength",
                    "",
                    f"less than {spelled_value('last_wavelength')}",
                    "swap them",
                    "band-order",
                ),
                (
                    self.lines < 2 * self.cubes,
                    "cubes",
                    "",
                    f"at most one for every two of the {self.lines} lines",
                    "take fewer cubes",
                    _RANGE,
                ),
                (
                    self.bad_elements > elements,
                    "bad_elements",
                    "",
                    f"at most the {elements} elements of the camera",
                    "take fewer",
                    _RANGE,
                ),
                (
                    2 * self.masked_columns >= self.columns,
                    "masked_columns",
                    " at both edges",
                    f"fewer than the {self.columns} columns of the camera",
                    "mask fewer columns",
                    _RANGE,
                ),
                (
                    dark >= full,
                    "dark_level",
                    f" with {spelled_value('dark_rate')} and {spelled_value('pedestal')}",
                    f"less than the {full} counts of {self.bit_depth} bits",
                    "lower the dark, or take more bits",
                    "dark-saturated",
                ),
                (
                    self.psf_kernel is not None and blurs,
                    "psf_kernel",
                    " and a Gaussian point spread",
                    "one of them",
                    "keep one",
                    option,
                ),
                (
                    self.cloud is not None and not (0 <= self.cloud[0] <= 1 and self.cloud[1] > 0),
                    "cloud",
                    "",
                    "a fraction from 0 to 1 and a duration above 0 s",
                    "correct them",
                    _RANGE,
                ),
                (
                    isinstance(dropped, int) and not 0 <= dropped <= max_dropped,
                    "dropped",
                    "",
                    f"at most {max_dropped}: a cube keeps its outer frames",
                    "drop fewer",
                    _RANGE,
                ),
                (
                    is_beyond,
                    "dropped",
                    "",
                    f"frames from 0 to {self.lines - 1}",
                    "leave the others out",
                    _RANGE,
                ),
                (
                    frames and not is_beyond and any(map(frames.issuperset, cubes)),
                    "dropped",
                    " leaves a cube empty",
                    "",
                    "keep a frame of every cube",
                    "cube-empty",
                ),
            ]:
                problems.add_if(
                    is_fault, f"{spelled_value(name)}{found}", expected=expected, mend=mend, code=code
                )

    @property
    def shape(self) -> tuple[int, int, int]:
        """Lines, bands, columns."""
        return self.lines, self.bands, self.columns

    @property
    def sun(self) -> tuple[float, float]:
        """Zenith angle and azimuth of the sun, clockwise from north [degree]."""
        return NEAR_SUNSET if self.sky == "near_sunset" else (self.sun_zenith, self.sun_azimuth)

    @property
    def start(self) -> np.datetime64:
        """UTC at mid exposure of the first line [ns]."""
        if self.start_time is not None:
            return moment_of(self.start_time)
        try:
            return when_sun_stands(*self.sun, *ORIGIN[:2])
        except SchemaError:
            # under an overcast sky the position of the sun does not matter
            if self.sky != "overcast":
                raise
            return DEFAULT_START

    @property
    def exposure_time(self) -> float:
        """Exposure [s]."""
        return self.exposure_time_ms / 1000.0

    @property
    def dropped_frames(self) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
        """Numbers of the frames that were never recorded, in order; never the first or last of a cube."""
        if not isinstance(self.dropped, int):
            return np.unique(np.asarray(self.dropped, dtype=np.int64))
        starts = self.cube_starts
        inner = np.setdiff1d(np.arange(self.lines), np.concatenate([starts[:-1], starts[1:] - 1]))
        rng = np.random.default_rng([self.seed, 5])
        return np.sort(rng.choice(inner, self.dropped, replace=False)).astype(np.int64)

    @property
    def recorded(self) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """True for every frame that was recorded, shape (line,)."""
        return ~np.isin(np.arange(self.lines), self.dropped_frames)

    @property
    def cube_starts(self) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
        """First frame of every cube, and one past the last frame of the flight."""
        return np.linspace(0, self.lines, self.cubes + 1).astype(np.int64)


#: Fields of `hyperpaint.simulation.SimulationSettings` that define the camera.
CAMERA_FIELDS = frozenset(
    {
        "bands",
        "columns",
        "seed",
        "first_wavelength",
        "last_wavelength",
        "dispersion_bow_nm",
        "srf_shape",
        "fwhm_nm",
        "fwhm_slope",
        "smile_nm",
        "bit_depth",
        "electrons_per_count",
        "read_noise",
        "dark_level",
        "dark_pattern",
        "dark_rate",
        "nonuniformity",
        "column_nonuniformity",
        "bad_elements",
        *(field.name for field in fields(OpticsSettings)),
    }
)
