"""What a simulated collect is made of: every effect is one field, with its unit and its default."""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.units import takes_quantities

from .optics import OpticsSettings
from .setting_checks import (
    check_choice,
    check_flag,
    check_number,
    check_whole,
    is_number,
    moment_of,
)
from .sun_clock import USUAL_START, when_sun_stands

STAMPS = ("start", "mid", "end")
"""What a time stamp may mark of an exposure."""

SCENES = ("plan", "rendered", "checkerboard")
"""What can be flown over: a flat picture of a car park, a car park of triangles whose light is traced, or
level squares of known corners."""

SHAPES = ("gaussian", "slit")
"""Line shapes of the imager."""

WOBBLES = ("none", "slow", "calm", "rough")
"""How a platform may move about its course."""

SWATH_M = 16.0
"""Width of a scene across the track, unless it is a checkerboard."""

MOST_SAMPLES = 1 << 14
"""Paths of a pixel that the tracer takes."""

FLEETS = ("solid", "real")
"""What cars are painted with: fourteen solid paints, or what is seen on roads (`rendering.fleet`)."""

SKIES = ("clear", "near_sunset", "overcast")
"""Kinds of light."""

NEAR_SUNSET = (80.0, 292.0)
"""Zenith angle and azimuth of the sun near sunset [degree]."""

ORIGIN = (43.0845, -77.6749, 160.0)
"""Latitude and longitude [degree] of the ground under the first line, and its height [m]."""


@takes_quantities(
    swath="m", square="m", board_turn="degree", course="degree", boresight="degree", lever_arm="m",
    sun_zenith="degree", sun_azimuth="degree", exposure_time_ms="ms", frame_period_ms="ms",
    first_wavelength="nm", last_wavelength="nm", dispersion_bow_nm="nm", fwhm_nm="nm", smile_nm="nm",
    irradiance_fwhm_nm="nm", electrons_per_count="electron count-1", read_noise="count", dark_level="count",
    dark_pattern="count", pedestal="count", irradiance_margin_s="s", frame_clock_offset_s="s",
    clock_offset_s="s", clock_uncertainty_s="s", utc_offset_h="h",
)  # fmt: skip
@dataclass(frozen=True, kw_only=True)
class SimulationSettings(OpticsSettings):
    """Size and effects of a simulated collect; every effect can be switched off.

    Point spread, keystone, stray light and pedestal are the attributes of `OpticsSettings`.

    Attributes
    ----------
    lines, bands, columns
        Shape of the cube, dropped frames included. The scene is ``swath`` wide, however many columns see it.
    seed
        Chooses the scene, the detector's pattern, the noise. The light's spectral lines never change.
    scene
        "plan": a flat picture in which a pixel sees one level Lambert surface, made at once. "rendered": a
        car park of triangles, whose light is traced along the camera's own wobbling line of sight, with
        shadows, glint, light between neighbours and mixed pixels. "checkerboard": level Lambert squares seen
        along that line of sight, for questions of place.
    swath
        Width of what is flown over, from as high as its columns look [m]; other than 16 for a checkerboard.
    square, board_turn
        Side of a checkerboard's squares [m], and how it is turned on its map, clockwise from north [degree].
    course
        Direction of flight, clockwise from true north [degree]; other than 0 for a checkerboard.
    wobble
        How the platform moves about its course: "none", "slow" (three sines), "calm" (roll and pitch 0.15,
        heading 1.1 degrees, 1 sigma) or "rough" (0.42, 3.1 degrees). A plan is not moved by it.
    boresight
        Roll, pitch and heading of the camera in the body [degree].
    lever_arm
        Camera from the point that the navigation is of: forward, right, down [m].
    navigation_rate
        Rows of the navigation files in a second, a divisor of 1e9.
    samples
        Rays a pixel of a rendered scene; what was rendered is the truth, however few they are.
    sky
        "clear": the sun at ``sun_zenith`` and ``sun_azimuth``. "near_sunset": a clear sky with the sun 80
        degrees from the zenith, in the west. "overcast": no sun, and the same sky in
        all directions.
    fleet
        Paints of a rendered scene: "solid", fourteen without flakes; "real", flakes, dust, worn ground.
    coat
        Clear coats and flakes of a rendered scene's paints; False leaves Lambert paints of the same spectra.
    neighbours
        Trees, a wall and lamps around a rendered car park; False leaves cars on an open place.
    cubes
        Number of cubes the flight is cut into; they share one navigation file.
    start_time
        UTC at mid exposure of the first line, ISO 8601 without a zone. By default 2021-07-20T17:10:00, or
        when the sun stands where the scene is lit from, at 43 degrees north, where that is another time. A
        zenith angle that the sun never has there (below 19 degrees) asks for a time, but under an overcast
        sky, which has no sun.
    exposure_time_ms, frame_period_ms
        Exposure, and time from line to line [ms].
    stamp
        What a frame's stamp marks: "start", "mid" or "end" of the exposure.
    first_wavelength, last_wavelength
        Centres of the outer bands [nm].
    dispersion_bow_nm
        How far the centres of the inner bands stand from even spacing, most in the middle [nm].
    srf_shape
        Line shape of the imager: "gaussian" or "slit" (a box ``fwhm_nm`` wide convolved with a box one band
        spacing wide).
    fwhm_nm
        Full width at half maximum of the imager [nm].
    fwhm_slope
        Relative change of that width from the middle to the last band.
    smile_nm
        Wavelength shift at the edge of the swath, zero at the centre column [nm].
    noise
        Shot and read noise in the scene's frames.
    dark_noise
        Read noise in the dark frames.
    quantise
        Whole, clipped counts (uint16); False leaves float32 counts, in memory only.
    bit_depth
        Bits of the converter.
    electrons_per_count, read_noise
        Gain [electron count-1], and spread of a dark count [count].
    dark_level, dark_pattern
        Mean dark at no exposure, and spread of its fixed pattern over the elements [count].
    dark_rate
        Mean growth of the dark with exposure [count s-1].
    dark_frames
        Frames of the dark cube.
    nonuniformity
        Spread of the elements' response about the common responsivity, 1 sigma [1].
    column_nonuniformity
        The same of whole columns: a slit that is not equally wide everywhere [1].
    bad_elements
        Number of elements that see no light; their gain is NaN.
    texture
        Spread of a surface's brightness from pixel to pixel, 1 sigma [1]; of the plan scene.
    glint
        Fraction of the car pixels that mirror the sun and saturate; of the plan scene, since in a rendered
        one clear coats mirror the sun where they face it.
    sun_zenith, sun_azimuth
        Where the sun stands in a clear sky, the azimuth clockwise from north [degree].
    drift_per_minute
        Relative change of the direct light in a minute; the diffuse light changes half as much the other way.
    cloud
        Fraction of the direct light that a cloud takes, duration of the ramp [s], its start [s after the
        first line]; None for none.
    dropped
        Frames that were never recorded: a number of them, chosen by the seed, or their frame numbers.
    irradiance_interval_s
        Whole seconds from one irradiance sample to the next, since the spectrometer stamps whole seconds.
    irradiance_margin_s
        Length of the irradiance record before and after the line [s].
    irradiance_fwhm_nm
        Full width at half maximum of the spectrometer [nm].
    irradiance_noise
        Relative noise of each irradiance value, 1 sigma [1].
    irradiance_stamp
        What a spectrometer's stamp marks: "start", "mid" or "end" of its 0.68 s average.
    irradiance_gap
        Samples between these two times [s after the first line] are missing; None for none.
    frame_clock_offset_s
        Seconds the clock that stamps the camera's frames is behind that of the navigation.
    clock_offset_s
        Seconds the spectrometer's clock is slow: UTC = stamp - utc_offset_h + clock_offset_s.
    clock_uncertainty_s
        What is declared of how well that is known [s]; None declares nothing.
    utc_offset_h
        Zone of the computer that logs the spectrometer [h].

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
      srf_shape='box', expected one of gaussian, slit
      exposure_time_ms=-5.0, expected a number above 0
    """

    lines: int = 512
    bands: int = 272
    columns: int = 320
    seed: int = 0
    scene: str = "plan"
    swath: float = SWATH_M
    square: float = 0.16
    board_turn: float = 27.0
    course: float = 0.0
    wobble: str = "slow"
    boresight: tuple[float, float, float] = (0.0, 0.0, 0.0)
    lever_arm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    navigation_rate: int = 100
    samples: int = 16
    sky: str = "clear"
    fleet: str = "real"
    coat: bool = True
    neighbours: bool = True
    cubes: int = 1
    start_time: str | None = None
    exposure_time_ms: float = 5.0
    frame_period_ms: float = 7.0
    stamp: str = "end"
    first_wavelength: float = 399.356
    last_wavelength: float = 1001.42
    dispersion_bow_nm: float = 0.0
    srf_shape: str = "gaussian"
    fwhm_nm: float = 6.0
    fwhm_slope: float = 0.0
    smile_nm: float = 0.5
    noise: bool = True
    dark_noise: bool = True
    quantise: bool = True
    bit_depth: int = 12
    electrons_per_count: float = 20.0
    read_noise: float = 0.5
    dark_level: float = 110.0
    dark_pattern: float = 3.0
    dark_rate: float = 0.0
    dark_frames: int = 64
    nonuniformity: float = 0.02
    column_nonuniformity: float = 0.0
    bad_elements: int = 0
    texture: float = 0.02
    glint: float = 0.001
    sun_zenith: float = 25.0
    sun_azimuth: float = 178.0
    drift_per_minute: float = 0.001
    cloud: tuple[float, float, float] | None = None
    dropped: int | Sequence[int] = 0
    irradiance_interval_s: int = 2
    irradiance_margin_s: float = 6.0
    irradiance_fwhm_nm: float = 3.0
    irradiance_noise: float = 0.0
    irradiance_stamp: str = "end"
    irradiance_gap: tuple[float, float] | None = None
    frame_clock_offset_s: float = 0.0
    clock_offset_s: float = 37.25
    clock_uncertainty_s: float | None = None
    utc_offset_h: float = -5.0

    def __post_init__(self) -> None:
        problems = Problems("the collect cannot be simulated", SchemaError)
        self._check_choices(problems)
        self._check_numbers(problems)
        self._check_start(problems)
        self.check_optics(problems)
        if not len(problems):
            self._check_together(problems)
        problems.raise_if_any()

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> SimulationSettings:
        """Return settings from keywords.

        Raises
        ------
        SchemaError
            Keywords are unknown, or values out of range.
        """
        names = {field.name for field in fields(cls)}
        unknown = sorted(set(values) - names)
        if unknown:
            raise SchemaError(
                f"unknown settings {', '.join(unknown)}; expected some of {', '.join(sorted(names))}"
            )
        return cls(**values)

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
            # nothing under a closed cloud shows where its sun stands
            if self.sky != "overcast":
                raise
            return USUAL_START

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

    def _check_choices(self, problems: Problems) -> None:
        choices = {
            "scene": SCENES, "sky": SKIES, "wobble": WOBBLES, "srf_shape": SHAPES, "stamp": STAMPS,
            "irradiance_stamp": STAMPS, "fleet": FLEETS,
        }  # fmt: skip
        for name, allowed in choices.items():
            check_choice(problems, name, getattr(self, name), allowed)
        for name in ("coat", "neighbours", "noise", "dark_noise", "quantise"):
            check_flag(problems, name, getattr(self, name))

    def _check_start(self, problems: Problems) -> None:
        """Note a start time that is none, and a sun for which no time can be found."""
        if self.start_time is not None:
            if not _is_start_time(self.start_time):
                problems.add(
                    f"start_time={self.start_time!r}, expected text like '2021-07-20T17:10:00', "
                    "in UTC without a zone, from 1980 to 2037"
                )
        elif self.sky in SKIES and all(is_number(v) and 0 <= v <= 360 for v in self.sun):
            try:
                _ = self.start
            except SchemaError as error:
                problems.add(str(error))

    def _check_numbers(self, problems: Problems) -> None:
        for name, (lowest, highest) in _WHOLE.items():
            check_whole(problems, name, getattr(self, name), lowest, highest)
        for name, (low, high) in _RANGES.items():
            check_number(problems, name, getattr(self, name), low, high, above=name in _POSITIVE)
        for name, length in (("cloud", 3), ("irradiance_gap", 2)):
            value = getattr(self, name)
            if value is not None and not _are_numbers(value, length):
                problems.add(f"{name}={value!r}, expected {length} numbers, or None")
        for name, most in (("boresight", 10), ("lever_arm", 2)):
            value = getattr(self, name)
            if not _are_numbers(value, 3) or max(map(abs, value)) > most:
                problems.add(f"{name}={value!r}, expected 3 numbers from -{most} to {most}")
        uncertainty_s = self.clock_uncertainty_s
        if uncertainty_s is not None and not (is_number(uncertainty_s) and uncertainty_s >= 0):
            problems.add(f"clock_uncertainty_s={uncertainty_s!r}, expected a number from 0 on, or None")
        if not isinstance(self.dropped, int) and not (
            isinstance(self.dropped, list | tuple | range) and all(isinstance(f, int) for f in self.dropped)
        ):
            problems.add(f"dropped={self.dropped!r}, expected a number of frames or a list of frame numbers")

    def _check_together(self, problems: Problems) -> None:
        if self.exposure_time_ms > self.frame_period_ms:
            problems.add(
                f"exposure_time_ms={self.exposure_time_ms} exceeds frame_period_ms={self.frame_period_ms}"
            )
        minutes = (self.lines * self.frame_period_ms / 1000.0 + 2 * self.irradiance_margin_s) / 60.0
        if abs(self.drift_per_minute) * minutes > 0.9:
            problems.add(
                f"drift_per_minute={self.drift_per_minute} leaves no light after {minutes:.1f} minutes"
            )
        if 10**9 % self.navigation_rate:
            problems.add(f"navigation_rate={self.navigation_rate}, expected a divisor of 1e9, such as 100")
        if self.scene != "checkerboard":
            for name, value in (("swath", SWATH_M), ("course", 0.0)):
                if getattr(self, name) != value:
                    problems.add(
                        f"{name}={getattr(self, name)}, expected {value:g} of any scene but a checkerboard"
                    )
        if self.first_wavelength >= self.last_wavelength:
            problems.add(f"first_wavelength={self.first_wavelength} is not below last_wavelength")
        if self.lines < 2 * self.cubes:
            problems.add(f"cubes={self.cubes}, expected at most one for every two of the {self.lines} lines")
        if self.bad_elements > self.bands * self.columns:
            problems.add(f"bad_elements={self.bad_elements}, of {self.bands * self.columns} elements")
        if 2 * self.masked_columns >= self.columns:
            problems.add(f"masked_columns={self.masked_columns} at both edges, of {self.columns} columns")
        dark = self.dark_level + self.dark_rate * self.exposure_time + self.pedestal
        if dark >= 2**self.bit_depth - 1:
            problems.add(
                f"dark_level={self.dark_level}, dark_rate={self.dark_rate} and pedestal={self.pedestal} fill "
                f"the converter of {self.bit_depth} bits"
            )
        if self.cloud is not None and not (0 <= self.cloud[0] <= 1 and self.cloud[1] > 0):
            problems.add(f"cloud={self.cloud}, expected a fraction from 0 to 1 and a duration above 0 s")
        dropped = self.dropped
        if isinstance(dropped, int):
            most = self.lines - 2 * self.cubes
            if not 0 <= dropped <= most:
                problems.add(f"dropped={dropped}, expected at most {most}: a cube keeps its outer frames")
        elif any(not 0 <= frame < self.lines for frame in dropped):
            problems.add(f"dropped frames outside 0 to {self.lines - 1}")
        elif any(
            len(set(range(start, stop)) - set(dropped)) == 0
            for start, stop in itertools.pairwise(self.cube_starts.tolist())
        ):
            problems.add("dropped frames leave a cube empty")


def _are_numbers(value: object, length: int) -> bool:
    return isinstance(value, tuple | list) and len(value) == length and all(map(is_number, value))


def _is_start_time(value: object) -> bool:
    # the spectrometer's files count seconds in 32 bits
    if not isinstance(value, str) or not _ISO_TIME.fullmatch(value):
        return False
    return bool(np.datetime64("1980-01-01") <= moment_of(value) < np.datetime64("2038-01-01"))


_ISO_TIME = re.compile(r"[0-9]{4}-[0-9]{2}-[0-9]{2}([T ][0-9]{2}:[0-9]{2}(:[0-9]{2}(\.[0-9]{1,9})?)?)?")


_WHOLE = {
    "lines": (2, 10_000_000),
    "bands": (2, 10_000),
    "columns": (1, 100_000),
    "seed": (0, 2**63 - 1),
    "samples": (1, MOST_SAMPLES),
    "cubes": (1, 10_000),
    "bit_depth": (1, 16),
    "dark_frames": (1, 100_000),
    "bad_elements": (0, 2**40),
    "irradiance_interval_s": (1, 3600),
    "navigation_rate": (1, 1000),
}

_POSITIVE = ("exposure_time_ms", "frame_period_ms", "fwhm_nm", "electrons_per_count", "irradiance_fwhm_nm")
#: Smallest and largest value of the fields that are numbers.
_RANGES = {
    **dict.fromkeys(_POSITIVE, (0.0, np.inf)),
    **dict.fromkeys(
        ("read_noise", "dark_level", "dark_pattern", "dark_rate", "irradiance_noise"), (0.0, np.inf)
    ),
    **dict.fromkeys(("nonuniformity", "column_nonuniformity", "texture"), (0.0, 0.2)),
    "swath": (0.01, 1000.0), "square": (0.01, 1000.0),
    "course": (-360.0, 360.0), "board_turn": (-360.0, 360.0),
    "frame_clock_offset_s": (-1.0, 1.0), "irradiance_margin_s": (0.0, 3600.0), "glint": (0.0, 1.0),
    "fwhm_slope": (-0.5, 0.5), "dispersion_bow_nm": (-20.0, 20.0), "smile_nm": (-20.0, 20.0),
    "sun_zenith": (0.0, 85.0), "sun_azimuth": (0.0, 360.0), "drift_per_minute": (-1.0, 1.0),
    "first_wavelength": (380.0, 1050.0), "last_wavelength": (380.0, 1050.0),
    "utc_offset_h": (-14.0, 14.0), "clock_offset_s": (-86400.0, 86400.0),
}  # fmt: skip
