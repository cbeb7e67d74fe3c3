"""Checks of a navigation record against the picture of a flight line: conventions, clocks and heights.

Roll of a line camera shifts its rows sideways. That shift can be measured wherever the ground has texture.
The distance of two rows along the track cannot be measured in this way, but the larger it is, the less alike
the rows are; likeness as a function of distance follows from the rows themselves, across the track. Poses
under each possible convention, and at each clock offset, predict these shifts.

The offset of the irradiance spectrometer's clock follows from clouds that both instruments see. Brightness of
lines varies much more with the ground than with the light. But from one line to the next most pixels show
nearly the same ground, so that the median change over columns is the change of the light.
"""

import contextlib
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from types import SimpleNamespace
from typing import Any, Literal, NamedTuple

import numpy as np
import xarray as xr

from hyperpaint.base import (
    ALONG_TRACK,
    ANGLES,
    BAND,
    CROSS_TRACK,
    IRRADIANCE_TIME,
    IRRADIANCE_WAVELENGTH,
    MID_EXPOSURE_OFFSETS,
    NAVIGATION_TIME,
    WGS84_ECCENTRICITY_SQUARED,
    WGS84_SEMI_MAJOR_AXIS_M,
    Array,
    Bools,
    Convention,
    Floats,
    Floats32,
    MissingExtraError,
    SchemaError,
    TimeError,
    UnitsError,
    conversion_factor,
    documented,
    good_bands,
    require,
    takes_quantities,
)
from hyperpaint.geometry.georeference.locating import (
    LOCATION_UNITS,
    POSE,
    PinholeCamera,
    canonical_values,
    convention_of_line,
    look_angles,
    matrices,
    poses_at,
    quaternions,
)
from hyperpaint.light.illumination import check_irradiance_times

Verdict = Literal["right", "wrong", "undecided"]
Positions = Literal["as declared", "latitude and longitude swapped", "longitude west positive"]
POSITIONS: tuple[Positions, ...] = (
    "as declared", "latitude and longitude swapped", "longitude west positive",
)  # fmt: skip
#: Choices of a convention that are tested, by field.
_CHOICES = {
    "roll_positive": ("right_wing_down", "right_wing_up"),
    "pitch_positive": ("nose_up", "nose_down"),
    "heading_positive": ("clockwise", "counterclockwise"),
    "angle_unit": ("degree", "radian"),
    "euler_order": ("ZYX", "ZXY", "XYZ"),
    "column_order": ("left_to_right", "right_to_left"),
}
_CUBES = ("counts", "radiance", "reflectance")
#: Bands to average: more would not reduce the noise further.
_MAX_BANDS = 12
#: Range of high signal of a silicon camera, outside strong absorption of the atmosphere [nm].
_WAVELENGTHS_NM = (500.0, 850.0)
#: Lines of a check by default, from the middle of the flight line, and minimum number.
MAX_LINES, _MIN_LINES = 4000, 64
#: Minimum downward component of a unit direction for an intersection with the ground.
_MIN_DOWNWARD = 0.05
_FLAT = _EPS = 1e-12


#: Thresholds of the checks; set on simulated flights.
RULES = SimpleNamespace(
    # --- motion of a picture
    # Number of zones, parts of a row with a shift of their own, and their width if there are enough columns.
    min_zones=4,
    max_zones=12,
    zone_columns=64,
    min_columns=12,  # minimum width of a zone
    reach_px=8,  # largest shift between rows in the search
    block_rows=512,  # rows compared at a time
    level_columns=5,  # width of the running mean that is subtracted from rows
    max_steady_intervals=1.5,  # interval of lines above which frames are missing [median intervals]
    # --- conventions
    undulation_m=110.0,  # largest height of the geoid below or above the ellipsoid
    min_parts=500,  # parts of rows that must be comparable
    # Logarithm of the likelihood ratio beyond which a meaning is ruled out: 22,000 to 1.
    log_odds=10.0,
    log_odds_against=6.0,  # prior logarithm of the odds that a declaration is right
    # Ratio of fitted and recorded height above which the record is wrong; leaning structures bias the fit.
    height_ratio=1.4,
    height_factors=tuple(np.geomspace(1 / 4, 4.0, 49).tolist()),
    clock_sd=3.0,  # standard deviations of a fitted offset above which the clock is wrong
    # Range and step of the search for another clock offset, where another convention fits better.
    clock_search_s=1.0,
    clock_step_s=0.02,
    # --- fit of expected to measured motion
    clip_sd=4.0,  # standard deviations at which the cost of a residual is limited
    max_slant=0.3,  # slant of structures on the ground [pixel sideways per pixel forward]
    max_lag_s=0.005,  # allowed clock lag while conventions are compared
    max_lag_lines=64,  # largest distance of lines for correlations of residuals
    time_step_s=0.002,  # step of numerical derivatives in time
    max_tilt_deg=2.0,  # prior error of the boresight's pitch
    turn_step_deg=1.0,  # step of numerical derivatives in pitch
    # Lines of a block, over which structures on the ground have one slant, and minimum number of blocks.
    block_lines=128,
    min_blocks=8,
    # Shift by structures on the ground that can be correlated with the platform's motion [pixel]: on calm
    # simulated flights offsets scatter three times as much as blocks of lines suggest.
    unexplained_px=0.006,
    outlier_sd=2.5,  # standard deviations beyond which a shift is excluded from a clock fit
    smooth_lines=9,  # lines over which motion is averaged
    max_steps=12,
    converged_sd=0.1,  # largest last step, relative to the uncertainty
    max_step_s=0.03,
    # --- offset between attitude and picture
    search_step_s=0.01,  # step of the first search; platforms rotate at a few hertz at most
    # Largest misfit at the best offset, relative to the misfit of a platform without rotation.
    max_misfit=0.97,
    # Smallest ratio of measured to expected shifts, and of expected to measured shifts, for one motion.
    min_amplitude=0.75,
    rival_gain=0.3,  # share of the best offset's gain that a rival offset must lack
    rival_distance_s=0.15,  # distance from the best offset beyond which an offset is a rival
    # --- offset between irradiance and brightness of lines
    min_light_change=0.02,  # minimum relative change of the light over the line
    bins_an_interval=2.0,  # time bins per interval of the irradiance record
    min_bins=12,
    offset_steps=400,
    light_blocks=12,  # blocks of lines that the jackknife leaves out in turn
    min_light_odds=10.0,  # minimum log odds over constant light
    # Distance beyond which an offset that fits nearly as well is a rival: standard deviations, and seconds.
    light_rival_sd=5.0,
    light_rival_s=0.5,
    max_light_lag_s=1.0,  # offset of the irradiance record that `navigation_findings` accepts
)


@dataclass(frozen=True)
class Finding:
    """Result of a check of one declaration.

    Attributes
    ----------
    field
        Field of the `hyperpaint.Convention`; or ``"positions"``, ``"clock"``.
    declared
        Declared value.
    verdict
        ``"right"``, ``"wrong"``, or ``"undecided"``: neither the track nor the picture decides.
    likely
        More likely value; empty where the declaration is right.
    evidence
        Reason, with numbers.
    """

    field: str
    declared: str
    verdict: Verdict
    likely: str
    evidence: str


@dataclass(frozen=True)
class ConventionCheck:
    """Result of a check of a declared convention.

    Attributes
    ----------
    findings
        One finding per declaration.
    suggested
        The declared convention, with wrong fields replaced where a single alternative remains; not applied.
    lines
        First line of the check, and the line after the last.
    """

    findings: tuple[Finding, ...]
    suggested: Convention
    lines: tuple[int, int]

    @property
    def wrong(self) -> tuple[str, ...]:
        # Fields that look wrong.
        return tuple(finding.field for finding in self.findings if finding.verdict == "wrong")

    @property
    def undecided(self) -> tuple[str, ...]:
        # Fields that could not be decided.
        return tuple(finding.field for finding in self.findings if finding.verdict == "undecided")

    def __getitem__(self, field: str) -> Finding:
        # Return the finding on a field.
        return next(finding for finding in self.findings if finding.field == field)

    def table(self) -> str:
        # Return the findings as text.
        rows = [
            ("", "declared", "verdict", "looks like", "evidence"),
            *((f.field, f.declared, f.verdict, f.likely, f.evidence) for f in self.findings),
        ]
        widths = [max(len(row[k]) for row in rows) for k in range(4)]
        return "\n".join(
            "  ".join([*(cell.ljust(n) for cell, n in zip(row, widths, strict=False)), row[4]]).rstrip()
            for row in rows
        )


@takes_quantities(**LOCATION_UNITS)
@documented()
def check_conventions(
    line: xr.Dataset,
    navigation: xr.Dataset | None = None,
    *,
    convention: Convention | None = None,
    camera: PinholeCamera | xr.Dataset | None = None,
    ground: float | None = None,
    boresight: Sequence[float] = (0.0, 0.0, 0.0),
    lever_arm: Sequence[float] = (0.0, 0.0, 0.0),
    image: xr.DataArray | None = None,
    lines: slice | None = None,
    crs: Any = None,
) -> ConventionCheck:
    """Test the declared convention of a navigation record against the track and the picture (eager).

    Roll of the platform shifts the rows of a picture sideways, and pitch makes neighbouring rows more or less
    alike; the convention of positions and angles determines the expected shifts. All combinations of signs,
    units, orders of rotation and of columns, and of latitude and longitude, are compared by how well they
    explain the picture. The data are not changed: wrong and undecided declarations are reported.

    Parameters
    ----------
    line
        Flight line with ``time`` at mid exposure and a cube; its own poses where there is no ``navigation``.
    navigation
        See `hyperpaint.open_navigation`.
    convention
        Declared convention; by default that of the attributes.
    camera, boresight, lever_arm
        See `hyperpaint.geometry.locate`; a boresight of about a degree or less may be omitted; without one
        of several degrees everything is undecided.
    ground
        Height of the ground above the ellipsoid, accurate to some tenths of the flight height [m]; by default
        that of a located line.
    image
        Picture (along_track, cross_track) to be used instead of a mean of bands.
    lines
        Lines to compare; by default 4000 in the middle. They should contain the part with the strongest
        wobble.
    crs

    Returns
    -------
    ConventionCheck
        ``findings``, ``wrong`` and ``undecided`` (names), ``suggested`` and ``table()``.

    Raises
    ------
    SchemaError
        No convention, camera, ground, pose or picture; or too few successive lines with poses and texture.

    Notes
    -----
    A single line cannot decide which north headings count from, since a heading with a constant error
    looks like wind, or like leaning structures on the ground; nor ``"ZYX"`` from ``"ZXY"``, which
    differ by the product of roll and pitch; nor a wrong stamp from a clock offset of the same size. Where the
    platform does not wobble signs cannot be decided.

    Shifts between rows, and expected shifts: `hyperpaint.geometry.navigation_checking`.

    Examples
    --------
    >>> from hyperpaint.simulation import simulate_line
    >>> size = dict(lines=400, bands=2, columns=320, swath=8.0)
    >>> line = simulate_line(scene="checkerboard", wobble="rough", **size)
    >>> mirrored = line.assign(roll=-line["roll"])
    >>> check_conventions(line, ground=160.0).wrong, check_conventions(mirrored, ground=160.0).wrong
    ((), ('roll_positive',))
    """
    setting = _setting(
        line, navigation, convention=convention, camera=camera, ground=ground, boresight=boresight,
        lever_arm=lever_arm, image=image, lines=lines, crs=crs,
    )  # fmt: skip
    findings = _findings(setting)
    source = line if navigation is None else navigation
    labelled, *other_units = {str(source[name].attrs.get("units")) for name in ANGLES}
    is_labelled = not other_units and labelled != "None"
    if is_labelled and conversion_factor(labelled, setting.declared.angle_unit) != 1.0:
        unit = Finding(
            "angle_unit",
            setting.declared.angle_unit,
            "wrong",
            labelled,
            f"the variables have units {labelled!r}",
        )
        findings = [unit if finding.field == "angle_unit" else finding for finding in findings]
    first, stop, _ = setting.lines.indices(line.sizes[ALONG_TRACK])
    # a wrong field is replaced only where one alternative remains
    changes = {
        finding.field: finding.likely
        for finding in findings
        if finding.verdict == "wrong"
        and hasattr(setting.declared, finding.field)
        and " or " not in finding.likely
    }
    return ConventionCheck(tuple(findings), setting.declared.replace(**changes), (first, stop))


def navigation_findings(lines: Mapping[str, xr.Dataset]) -> list[tuple[str, Finding]]:
    # Return declarations and clocks that the picture of a flight line contradicts, with its name (eager).
    #
    # All lines of a flight share the navigation and the spectrometer, so that only the line with the largest
    # range of roll is checked. A check that is impossible or undecided (a short or calm line, no poses, no
    # look angles, constant light) gives no finding. The field ``"irradiance clock"`` is the offset of the
    # irradiance record.
    #
    # ``lines``: opened flight lines with their cubes, by name; their attributes ``ground``, ``boresight`` and
    # ``lever_arm`` are used if present.
    def usefulness(name: str) -> tuple[float, int]:
        rolls = lines[name]["roll"].values if "roll" in lines[name].variables else np.zeros(0)
        rolls = rolls[np.isfinite(rolls)]
        return float(np.ptp(rolls)) if rolls.size else 0.0, lines[name].sizes[ALONG_TRACK]

    name = max(lines, key=usefulness)
    line, zero = lines[name], (0.0, 0.0, 0.0)
    selected = _middle_lines(line)
    findings: list[tuple[str, Finding]] = []
    # pyproj is needed for headings from north of a map
    impossible = SchemaError, TimeError, UnitsError, MissingExtraError
    with contextlib.suppress(*impossible):
        setting = _setting(
            line, None, convention=None, camera=None, ground=line.attrs.get("ground", np.nan), image=None,
            boresight=line.attrs.get("boresight", zero), lever_arm=line.attrs.get("lever_arm", zero),
            lines=selected, crs=None,
        )  # fmt: skip
        findings += [(name, finding) for finding in _findings(setting) if finding.verdict == "wrong"]
    with contextlib.suppress(*impossible):
        offset = estimate_clock_offset(line, irradiance=line, lines=selected)
        if abs(offset.offset_s) > max(RULES.clock_sd * offset.uncertainty_s, RULES.max_light_lag_s):
            findings.append(
                (
                    name,
                    Finding("irradiance clock", "0 s", "wrong", f"{offset.offset_s:+.2f} s", offset.evidence),
                )
            )
    return findings


# --- motion of a picture -----------------------------------------------------------------------------------


def _picture(line: xr.Dataset, image: xr.DataArray | None) -> Floats32:
    # Return a picture (along_track, cross_track) of a line's cube, or the ``image`` given, read once.
    if image is None:
        name = SchemaError.raise_if_none(
            next((name for name in _CUBES if name in line.variables), None),
            f"this line has no picture: {', '.join(_CUBES)}",
            mend="pass image=",
            code="picture-missing",
        )
        image = line[name]
        if BAND in image.dims:
            # the mean of some bands spread over the wavelengths
            bands = np.arange(line.sizes[BAND])
            if "wavelength" in line.variables:
                wavelength = np.asarray(line["wavelength"].values, np.float64)
                is_inside = (wavelength >= _WAVELENGTHS_NM[0]) & (wavelength <= _WAVELENGTHS_NM[1])
                is_inside &= good_bands(line)
                bands = np.flatnonzero(is_inside) if is_inside.any() else bands
            positions = np.linspace(0, bands.size - 1, min(_MAX_BANDS, bands.size))
            bands = bands[np.unique(np.round(positions).astype(np.int64))]
            image = image.isel({BAND: bands}).mean(BAND, dtype=np.float32)
    sizes = {dim: line.sizes[dim] for dim in (ALONG_TRACK, CROSS_TRACK) if dim in line.sizes}
    SchemaError.raise_if(
        set(image.dims) != {ALONG_TRACK, CROSS_TRACK} or any(image.sizes[d] != n for d, n in sizes.items()),
        f"the image is {dict(image.sizes)}",
        expected=f"{sizes}, as the line",
        code="grid-mismatch",
    )
    values: Any = image.transpose(ALONG_TRACK, CROSS_TRACK).values
    return np.asarray(values, np.float32)


class RowMotion(NamedTuple):
    # Motion of a picture from each row to the next.
    #: (row - 1, zone): ground at column x of a row is at x + shift in the row before [pixel]; NaN where
    #: undetermined
    shift: Floats
    #: (row - 1, zone): mean square difference of the two rows after that shift, over the variance of either
    unlikeness: Floats
    structure: Floats  #: (reach + 1,): unlikeness of a row with itself at a lag of 0, 1 ... columns
    centres: Floats  #: (zone,): column in the middle of every zone


def row_motion(picture: Array) -> RowMotion | None:
    # Return the motion of a picture (row, column); None where it is too narrow.
    #
    # The gains of columns are divided out: their fixed pattern would suggest that nothing moves. The best
    # integer shift is refined by the Gauss-Newton method. Both rows are moved by half the shift, so that both
    # are smoothed equally.
    from scipy.ndimage import uniform_filter1d

    (rows, columns), reach = picture.shape, RULES.reach_px
    zones = int(np.clip(columns // RULES.zone_columns, RULES.min_zones, RULES.max_zones))
    width = (columns - 2 * reach) // zones
    if width < RULES.min_columns or rows < 2:
        return None
    starts = reach + width * np.arange(zones)
    # logarithms without the gains of columns
    values = np.asarray(picture, np.float64)
    is_positive = np.isfinite(values) & (values > 0.0)
    floor = np.quantile(values[is_positive], 0.001) if is_positive.any() else 1.0
    levelled = np.log(np.where(is_positive, np.maximum(values, floor), floor))
    levelled -= np.median(levelled, axis=0)
    # without slow changes: a long slanted edge looks like a shift between rows; small structures have edges
    # on every side
    fine = levelled - uniform_filter1d(levelled, RULES.level_columns, axis=1, mode="nearest")
    power = uniform_filter1d(fine**2, 2 * RULES.level_columns + 1, axis=1, mode="nearest")
    fine /= np.sqrt(np.maximum(power, 0.0)) + 0.1 * np.sqrt(power.mean()) + _FLAT
    shift, unlikeness = np.full((rows - 1, zones), np.nan), np.full((rows - 1, zones), np.nan)
    structure, weight = np.zeros(reach + 1), 0.0
    for first in range(0, rows - 1, RULES.block_rows):
        stop = min(first + RULES.block_rows, rows - 1)
        block, next_block = slice(first, stop), slice(first + 1, stop + 1)
        for zone, start in enumerate(starts):
            window = slice(int(start), int(start) + width)
            variance = levelled[next_block, window].var(axis=1) + levelled[block, window].var(axis=1)
            has_contrast = variance > _FLAT
            if not has_contrast.any():
                continue
            variance = variance[has_contrast]
            before, after = (levelled[rows_of][has_contrast] for rows_of in (block, next_block))
            zone_shift = _row_shift(fine[block][has_contrast], fine[next_block][has_contrast], window)
            shift[block, zone][has_contrast] = zone_shift
            # mean square difference after moving both rows by half the shift
            half = np.where(np.isnan(zone_shift), 0.0, zone_shift) / 2
            square = ((_moved(after, window, -half) - _moved(before, window, half)) ** 2).mean(axis=1)
            unlikeness[block, zone][has_contrast] = np.where(np.isnan(zone_shift), np.nan, square) / variance
            # mean square difference of rows with themselves at lags of 0 to the reach (row, lag)
            at_lags = (before[:, window.start + lag : window.stop + lag] for lag in range(reach + 1))
            squares = [((other - before[:, window]) ** 2).mean(axis=1) for other in at_lags]
            own_structure = np.stack(squares, axis=1) / variance[:, None]
            is_valid = np.isfinite(own_structure).all(axis=1)
            structure += own_structure[is_valid].sum(axis=0)
            weight += float(is_valid.sum())
    return RowMotion(shift, unlikeness, structure / weight, starts + (width - 1) / 2) if weight else None


def _row_shift(before: Floats, after: Floats, window: slice) -> Floats:
    # Return the shift (row,), NaN where it is not within the reach.
    reach, target = RULES.reach_px, after[:, window]
    lags = range(-reach, reach + 1)
    costs = np.stack(
        [((target - before[:, window.start + k : window.stop + k]) ** 2).mean(axis=1) for k in lags]
    )
    best = costs.argmin(axis=0)
    interior, row = np.clip(best, 1, 2 * reach - 1), np.arange(best.size)
    low, middle, high = costs[interior - 1, row], costs[interior, row], costs[interior + 1, row]
    curvature = low + high - 2.0 * middle
    fraction = np.where(curvature > 0.0, 0.5 * (low - high) / np.where(curvature > 0.0, curvature, 1.0), 0.0)
    shift = interior - reach + np.clip(fraction, -1.0, 1.0)
    for _ in range(2):
        first, second = _moved(before, window, shift / 2), _moved(after, window, -shift / 2)
        slope = (np.gradient(first, axis=1) + np.gradient(second, axis=1)) / 2
        step = (slope * (second - first)).sum(axis=1) / np.maximum((slope**2).sum(axis=1), _FLAT)
        shift = shift + np.clip(step, -0.5, 0.5)
    return np.where((best == 0) | (best == 2 * reach) | (np.abs(shift) > reach), np.nan, shift)


def _moved(rows: Floats, window: slice, shift: Floats) -> Floats:
    # Interpolate rows at columns + ``shift`` by cubic convolution (Keys, 1981).
    integer = np.floor(shift).astype(np.int64)
    t = (shift - integer)[:, None]
    weights = (
        ((-0.5 * t + 1.0) * t - 0.5) * t,
        (1.5 * t - 2.5) * t * t + 1.0,
        ((-1.5 * t + 2.0) * t + 0.5) * t,
        (0.5 * t - 0.5) * t * t,
    )
    columns = np.arange(window.start, window.stop)[None, :] + integer[:, None]
    last = rows.shape[1] - 1
    taps = (np.take_along_axis(rows, np.clip(columns + k - 1, 0, last), axis=1) for k in range(4))
    return np.asarray(sum(w * tap for w, tap in zip(weights, taps, strict=True)))


# --- motion expected from poses ----------------------------------------------------------------------------


class Motion(NamedTuple):
    # Expected motion from each row to the next; see `RowMotion`.
    shift: Floats  #: (line - 1, zone): sideways [pixel]
    travel: Floats  #: (line - 1, zone): across the row, forward positive [pixel of the row]


@dataclass(frozen=True)
class View:
    # Viewing geometry of a camera in its platform.
    #: (zone,): tangents of the middle of every zone, to the right and forward, columns from left to right
    right: Floats
    forward: Floats
    step: Floats  #: (zone,): change of ``right`` from a column to the next
    boresight: tuple[float, ...]  #: Roll, pitch, heading of the camera in the body [degree]
    lever_arm: tuple[float, ...]  #: Forward, right, down [m]
    ground: float  #: Height of the ground above the ellipsoid [m]

    def motion(self, poses: Floats, *, boresight: tuple[float, ...] | None = None) -> Motion:
        # Return the motion that follows from poses (6, line); NaN without a pose.
        body = matrices(quaternions(*poses[3:]))
        rotation = body @ matrices(quaternions(*(boresight or self.boresight)))
        lever_arm = body @ np.array(self.lever_arm)
        origin = np.stack(local_metres(poses[0], poses[1]), axis=-1) + lever_arm[:, :2]
        height = poses[2] - lever_arm[:, 2] - self.ground
        # where the middle of a zone, and the next column, are seen on the ground (line, zone, 2)
        hits = []
        for columns in (0.0, 1.0):
            u = np.stack([self.forward, self.right + columns * self.step, np.ones_like(self.right)], axis=-1)
            d = np.einsum("nij,zj->nzi", rotation, u)
            with np.errstate(invalid="ignore", divide="ignore"):
                s = np.where(d[..., 2] > _MIN_DOWNWARD, height[:, None] / d[..., 2], np.nan)
            hits.append(origin[:, None] + s[..., None] * d[..., :2])
        travel, pixel_step = np.diff(hits[0], axis=0), hits[1] - hits[0]
        pixel_step = (pixel_step[1:] + pixel_step[:-1]) / 2
        area = (pixel_step**2).sum(axis=-1)
        with np.errstate(invalid="ignore", divide="ignore"):
            sideways = (travel * pixel_step).sum(axis=-1) / area
            forward = (travel[..., 0] * pixel_step[..., 1] - travel[..., 1] * pixel_step[..., 0]) / area
        return Motion(sideways, forward * np.sign(self.step))


def local_metres(latitude: Floats, longitude: Floats) -> tuple[Floats, Floats]:
    # Return metres to the north and to the east of the first located line; valid within a flight line.
    located = np.flatnonzero(np.isfinite(latitude) & np.isfinite(longitude))
    if not located.size:
        return np.full(latitude.shape, np.nan), np.full(latitude.shape, np.nan)
    start = located[0]
    phi = np.radians(latitude[start])
    squared = 1.0 - WGS84_ECCENTRICITY_SQUARED * np.sin(phi) ** 2
    meridian = WGS84_SEMI_MAJOR_AXIS_M * (1.0 - WGS84_ECCENTRICITY_SQUARED) / squared**1.5
    parallel = WGS84_SEMI_MAJOR_AXIS_M / np.sqrt(squared) * np.cos(phi)
    north = np.radians(latitude - latitude[start]) * meridian
    return north, np.radians(longitude - longitude[start]) * parallel


class Hypothesis(NamedTuple):
    # One possible convention of a record.
    convention: Convention  #: Meaning of angles, and order of columns
    positions: Positions = "as declared"  #: Meaning of latitude and longitude

    def fields(self) -> dict[str, str]:
        # Return the tested fields by name.
        return {**{name: getattr(self.convention, name) for name in _CHOICES}, "positions": self.positions}


@dataclass(frozen=True)
class Setting:
    # Inputs of a check of one line.
    declared: Convention  #: Declared convention of the record
    times: Array  #: (row,): times of the record
    columns: dict[str, Floats]  #: Poses as recorded (row,), by the name of the variable
    line_times: Array  #: (line,): mid exposures
    crs: Any  #: Map whose north grid headings count from
    observed: RowMotion  #: Motion of the picture
    view: View  #: Viewing geometry, columns from left to right
    columns_matter: bool  #: Whether the order of columns is tested
    interval: float  #: Time between lines [s]
    exposure: float  #: Exposure time [s]; NaN where unknown
    lines: slice  #: Lines of the check

    def poses(self, hypothesis: Hypothesis, clock_offset_s: float = 0.0) -> Floats:
        # Return canonical poses (6, line) under a hypothesis.
        columns = dict(self.columns)
        if hypothesis.positions == POSITIONS[1]:
            columns |= {"latitude": columns["longitude"], "longitude": columns["latitude"]}
        elif hypothesis.positions == POSITIONS[2]:
            columns["longitude"] = -columns["longitude"]
        values = canonical_values(
            *(columns[name] for name in POSE), convention=hypothesis.convention, crs=self.crs
        )
        return poses_at(self.times, values, self.line_times, clock_offset_s=clock_offset_s)

    def view_of(self, hypothesis: Hypothesis) -> View:
        # Return the look directions of the zones for an order of columns.
        return (
            self.view
            if hypothesis.convention.column_order != "right_to_left"
            else replace(self.view, right=-self.view.right, step=-self.view.step)
        )

    @property
    def is_steady(self) -> Bools:
        # Return the lines after which no frame is missing (line - 1,).
        steps = np.diff(self.line_times.astype(np.int64).astype(np.float64)) / 1e9
        return np.asarray((steps > 0) & (steps < RULES.max_steady_intervals * self.interval))


def _middle_lines(line: xr.Dataset) -> slice:
    first = max((line.sizes[ALONG_TRACK] - MAX_LINES) // 2, 0)
    return slice(first, min(first + MAX_LINES, line.sizes[ALONG_TRACK]))


def _setting(
    line: xr.Dataset,
    navigation: xr.Dataset | None,
    *,
    convention: Convention | None,
    camera: Any,
    ground: float | None,
    boresight: Sequence[float],
    lever_arm: Sequence[float],
    image: xr.DataArray | None,
    lines: slice | None,
    crs: Any,
) -> Setting:
    # Return the inputs of a check (eager: reads a few bands of the lines); SchemaError where one is missing.
    declared = convention_of_line(line, navigation, convention)
    if declared.stamp_reference is None:
        declared = declared.replace(stamp_reference=line.attrs.get("convention_stamp_reference"))
    ground = line.attrs.get("ground") if ground is None else float(ground)
    if not isinstance(ground, int | float):
        raise SchemaError(
            "the height of the ground is missing",
            mend="give ground= [m above the ellipsoid]",
            code="ground-height-missing",
        )
    selected = _middle_lines(line) if lines is None else lines
    part = line.isel({ALONG_TRACK: selected})
    SchemaError.raise_if(
        part.sizes[ALONG_TRACK] < _MIN_LINES,
        f"{part.sizes[ALONG_TRACK]} lines",
        expected=f"at least {_MIN_LINES}",
        code="line-too-short",
    )
    observed = SchemaError.raise_if_none(
        row_motion(_picture(part, None if image is None else image.isel({ALONG_TRACK: selected}))),
        "the picture is too narrow or without contrast",
        expected="at least 64 columns",
        code="picture-narrow",
    )
    tangents = look_angles(line, camera, Convention(column_order="left_to_right"))
    right_tangents, forward_tangents = (np.tan(np.radians(np.asarray(angles))) for angles in tangents)
    look_right, look_forward, step = (
        np.interp(observed.centres, np.arange(right_tangents.size), values)
        for values in (right_tangents, forward_tangents, np.gradient(right_tangents))
    )
    (forward, right, down), (roll, pitch, heading) = (map(float, mount) for mount in (lever_arm, boresight))
    view = View(look_right, look_forward, step, (roll, pitch, heading), (forward, right, down), float(ground))
    # poses as recorded, whatever their units
    source, dim = (part, ALONG_TRACK) if navigation is None else (navigation, NAVIGATION_TIME)
    line_times = require(part, ["time"], "a check of navigation")["time"].values
    names = POSE if navigation is None else (*POSE, NAVIGATION_TIME)
    missing = [name for name in names if name not in source.variables or source[name].dims != (dim,)]
    if missing:
        subject = "this line" if navigation is None else "this navigation record"
        raise SchemaError(
            f"{subject} has no {', '.join(missing)} ({dim})",
            mend="give navigation=hp.open_navigation(...)",
            code="variable-missing",
        )
    times, line_times = (
        stamps.astype("datetime64[ns]")
        for stamps in (line_times if navigation is None else source[NAVIGATION_TIME].values, line_times)
    )
    steps = np.diff(line_times.astype(np.int64)) / 1e9
    return Setting(
        declared, times, {name: np.asarray(source[name].values, np.float64) for name in POSE}, line_times,
        crs, observed, view,
        columns_matter=isinstance(camera, PinholeCamera),  # look angles have signs: their order is known
        interval=float(np.median(steps[steps > 0])),
        exposure=float(np.median(part["exposure_time"].values)) if "exposure_time" in part.variables
        else np.nan,
        lines=selected,
    )  # fmt: skip


# --- conventions -------------------------------------------------------------------------------------------


class Scored(NamedTuple):
    # A hypothesis and its fit.
    hypothesis: Hypothesis  #: Supposed convention
    odds: float  #: Logarithm of its probability relative to the most probable hypothesis, whose odds are 0
    #: Logarithm of the likelihood relative to a platform without rotation, from shifts alone
    over_rest: float


def _scores(setting: Setting) -> tuple[list[Scored], Bools]:
    # Return all conventions, the most probable first, and which parts of the picture are compared. Those from
    # which the ground is not seen are left out.
    #
    # A picture cannot distinguish a scene from its mirror image, in which roll, heading, the order of columns
    # and longitude have opposite signs. The prior odds that a declaration is wrong are therefore 1 to 400.
    # Residuals are assumed normal, with outliers beyond some standard deviations; their number is reduced by
    # the correlation of the best hypothesis' residuals with their neighbours.
    declared, observed = Hypothesis(setting.declared), setting.observed
    plain_hypothesis = Hypothesis(setting.declared.replace(angle_unit="degree", column_order="left_to_right"))
    is_seen = np.isfinite(observed.shift) & np.isfinite(observed.unlikeness) & setting.is_steady[:, None]
    compared: Bools = is_seen & np.isfinite(setting.view.motion(setting.poses(plain_hypothesis)).shift)
    SchemaError.raise_if(
        compared.sum() < RULES.min_parts,
        f"{int(compared.sum())} parts of rows show a motion and have poses",
        expected=f"{RULES.min_parts}",
        mend="check the times of line and record, and the contrast of the line",
        code="motion-not-seen",
    )
    # all possible conventions, the declared one first
    convention = declared.convention
    choices = _CHOICES if setting.columns_matter else {**_CHOICES, "column_order": (convention.column_order,)}
    declared_first: list[Any] = [
        sorted(values, key=lambda value: value != getattr(convention, name))
        for name, values in choices.items()
    ]
    explained: list[tuple[Hypothesis, Floats, Floats]] = []
    poses_by_convention: dict[Any, Floats] = {}
    expected: Motion | None = None
    for positions, *values in itertools.product(POSITIONS, *declared_first):
        meanings: dict[str, Any] = dict(zip(choices, values, strict=True))
        hypothesis = Hypothesis(replace(convention, **meanings), positions)
        # the order of columns, the last choice, does not change poses
        key = (positions, *values[:-1])
        if key not in poses_by_convention:
            poses_by_convention[key] = setting.poses(hypothesis)
        canonical = poses_by_convention[key]
        if not np.isfinite(canonical[0]).any() or np.nanmax(np.abs(canonical[0])) >= 90.0:
            continue
        motion = setting.view_of(hypothesis).motion(canonical)
        if (np.isfinite(motion.shift) | ~compared).all():
            expected = motion
            explained.append((hypothesis, *_residuals(observed, expected, compared, setting.interval)))
    if expected is None:
        return [], compared
    # the same travel over ground, without rotation
    no_rotation = Motion(
        *(
            np.zeros_like(observed.shift) + np.median(part[compared])
            for part in (observed.shift, expected.travel)
        )
    )
    shift_at_rest, _ = _residuals(observed, no_rotation, compared, setting.interval)
    shift_costs = _likelihood_costs([*(shift for _, shift, _ in explained), shift_at_rest], compared)
    costs = shift_costs[:-1] + _likelihood_costs([unlikeness for *_, unlikeness in explained], compared)
    costs += RULES.log_odds_against * np.array([_differences(h, declared) for h, *_ in explained])
    # where poses are missing, such as with an offset clock, a cost may be NaN
    lowest = costs[np.isfinite(costs)].min(initial=np.inf)
    scored = [
        Scored(h, float(lowest - cost), float(shift_costs[-1] - shift_cost))
        for (h, *_), cost, shift_cost in zip(explained, costs, shift_costs, strict=False)
        if np.isfinite(cost)
    ]
    return sorted(scored, key=lambda hypothesis: -hypothesis.odds), compared


def _differences(hypothesis: Hypothesis, declared: Hypothesis) -> int:
    # Return the number of fields in which two hypotheses differ.
    return sum(declared.fields()[name] != value for name, value in hypothesis.fields().items())


def _nearest(scored: list[Scored], declared: Hypothesis) -> Hypothesis:
    # Return, of the hypotheses that fit equally well, the nearest to the declared one.
    plausible = [one.hypothesis for one in scored if one.odds > -RULES.log_odds]
    return min(plausible, key=lambda h: _differences(h, declared))


def _finding(field: str, declared: Any, *rows: tuple[Any, Verdict, str, str]) -> Finding:
    # Return the finding of the first row (condition, verdict, likely, evidence) whose condition holds.
    verdict, likely, evidence = next(row[1:] for row in rows if row[0])
    return Finding(field, str(declared), verdict, "" if verdict == "right" else likely, evidence)


def _findings(setting: Setting) -> list[Finding]:
    convention, declared = setting.declared, Hypothesis(setting.declared)

    def median_altitude(hypothesis: Hypothesis) -> float:
        heights = setting.poses(hypothesis)[2]
        finite = heights[np.isfinite(heights)]
        return float(np.median(finite)) if finite.size else float("nan")

    def at_height(hypothesis: Hypothesis, height: float) -> Setting:
        return replace(setting, view=replace(setting.view, ground=median_altitude(hypothesis) - height))

    def of_north(hypothesis: Hypothesis) -> Finding:
        # the angle between heading and course alone cannot decide the reference of north
        poses, crab = setting.poses(hypothesis), float("nan")
        north, east = local_metres(poses[0], poses[1])
        located, has_heading = np.flatnonzero(np.isfinite(north)), np.isfinite(poses[5])
        if located.size >= 2 and has_heading.any():
            course = np.degrees(np.arctan2(east[located[-1]], north[located[-1]])) % 360.0
            direction = np.exp(1j * np.radians(poses[5][has_heading] - course)).mean()
            crab = float(np.degrees(np.angle(direction)))
        return Finding(
            "heading_reference",
            convention.heading_reference,
            "undecided",
            "",
            f"heading {crab:+.1f} degrees from the course: wind, boresight and declination look alike",
        )

    # signs can be tested at any height: where the recorded one is impossible, or the height of the ground is
    # unknown, take the height of square pixels, as flights are planned
    recorded_height = median_altitude(declared) - setting.view.ground
    if not recorded_height > 0.0 and np.isfinite(median_altitude(declared)):
        north, east = local_metres(*setting.poses(declared)[:2])
        distance = float(np.nanmedian(np.hypot(np.diff(north), np.diff(east))))
        setting = at_height(declared, max(distance / float(np.abs(setting.view.step).mean()), 1.0))
    scored, compared = _scores(setting)
    if not scored or not scored[0].over_rest >= RULES.log_odds:
        evidence = (
            "the picture does not follow the attitude: no wobble, low contrast, a large clock offset, or a "
            "boresight of some degrees that was not passed"
        )
        declarations = {
            **declared.fields(),
            "height_reference": convention.height_reference,
            "stamp_reference": str(convention.stamp_reference),
        }
        undecided = [Finding(name, str(v), "undecided", "", evidence) for name, v in declarations.items()]
        return [*undecided, of_north(declared)]
    best = _nearest(scored, declared)
    nominal_height = median_altitude(best) - setting.view.ground
    # the height above the ground [m] at which travel over ground is consistent with rotations
    #
    # Shifts by rotation do not depend on the height, shifts by travel are proportional to its inverse. Travel
    # shows sideways where the platform drifts, by the wobble of its heading, and along the track by the
    # likeness of rows.
    best_poses, view, factors = (
        setting.poses(best),
        setting.view_of(best),
        np.array(RULES.height_factors),
    )
    tried = nominal_height * factors
    motions = [
        replace(view, ground=view.ground + nominal_height - float(h)).motion(best_poses) for h in tried
    ]
    shifts, unlikeness = zip(
        *(_residuals(setting.observed, m, compared, setting.interval) for m in motions), strict=True
    )
    mid = factors.size // 2
    cost = _likelihood_costs(shifts, compared, mid) + _likelihood_costs(unlikeness, compared, mid)
    lowest = int(cost.argmin())
    plausible = tried[cost < cost[lowest] + 2.0]  # within two standard deviations
    sd = float(plausible[-1] - plausible[0]) / 4.0 if 0 < lowest < tried.size - 1 else np.inf
    step = float(tried[lowest] * np.log(factors[1] / factors[0]))
    at_declared = float(np.interp(nominal_height, tried, cost))
    height, height_sd = float(tried[lowest]), max(sd, step / 2)
    is_height_off = (
        recorded_height > 0.0
        and at_declared - float(cost[lowest]) > RULES.log_odds
        and np.isfinite(height_sd)
        and max(height / recorded_height, recorded_height / height) > RULES.height_ratio
    )
    if is_height_off:
        # from that height no convention may see the ground
        adjusted = at_height(best, height)
        if (at_that_height := _scores(adjusted))[0]:
            setting, (scored, compared) = adjusted, at_that_height
            best = _nearest(scored, declared)
    other = "geoid" if convention.height_reference == "ellipsoid" else "ellipsoid"
    if abs(height - recorded_height) > RULES.undulation_m:
        other = "another ground= or unit of heights"
    evidence = f"{height:.0f} +- {height_sd:.0f} m above ground by the picture"
    heights = f"{evidence}, {recorded_height:.0f} m by the record"
    findings = [
        *_field_findings(setting, scored, compared),
        of_north(best),
        _finding(
            "height_reference", convention.height_reference,
            (np.isnan(recorded_height), "undecided", "", f"{evidence}; the height of the ground is unknown"),
            (
                not recorded_height > 0.0, "wrong", other,
                f"the camera would be {-recorded_height:.0f} m below the ground",
            ),
            (is_height_off, "wrong", other, f"{heights}; or ground= has another reference"),
            (height_sd * 4.0 < recorded_height, "right", "", heights),
            (True, "undecided", "", heights),
        ),
    ]  # fmt: skip
    # the part of the exposure time that stamps mark, by the fitted clock offset
    clock, clock_sd = _fit_clock(setting, best, compared)
    stamp, half_exposure = convention.stamp_reference, setting.exposure / 2
    distances = {
        other: abs(clock - 2.0 * half_exposure * (middle - MID_EXPOSURE_OFFSETS[str(stamp)]))
        for other, middle in MID_EXPOSURE_OFFSETS.items()
        if stamp is not None and np.isfinite(half_exposure)
    }
    likely = min(distances, key=lambda other: distances[other]) if distances else str(stamp)
    is_on_time = not abs(clock) > RULES.clock_sd * clock_sd
    is_precise = np.isfinite(half_exposure) and RULES.clock_sd * clock_sd < half_exposure
    is_offset = likely == stamp or distances.get(likely, 0.0) > max(3.0 * clock_sd, half_exposure / 2)
    evidence = f"clock {1e3 * clock:+.1f} +- {1e3 * clock_sd:.1f} ms"
    last = (
        Finding("clock", "0 s", "wrong", f"{clock:+.4f} s", f"{evidence}; add it as clock_offset_s")
        if stamp is not None and not is_on_time and is_offset
        else _finding(
            "stamp_reference", stamp,
            (stamp is None, "undecided", "", f"{evidence}; not declared"),
            (is_on_time, "right" if is_precise else "undecided", "", evidence),
            (True, "wrong", likely, f"{evidence}; a clock that is off by as much looks the same"),
        )
    )  # fmt: skip
    return [*findings, last]


def _field_findings(setting: Setting, scored: list[Scored], compared: Bools) -> list[Finding]:
    # Return the findings on signs, units, orders and positions.
    declared, best = Hypothesis(setting.declared), scored[0].hypothesis
    fields_and_odds = [(one.hypothesis.fields(), one.odds) for one in scored]
    plausible = [fields for fields, odds in fields_and_odds if odds > -RULES.log_odds]
    clock_reason = ""
    if declared.fields() not in plausible:
        # a clock offset may explain the picture as well as another convention
        offsets = np.arange(
            -RULES.clock_search_s, RULES.clock_search_s + RULES.clock_step_s / 2, RULES.clock_step_s
        )
        own_costs, best_costs = (
            _offset_costs(setting, partial(setting.poses, h), setting.view_of(h), compared, offsets)
            for h in (declared, best)
        )
        if not np.isnan(own_costs).all() and not np.nanmin(own_costs) > np.nanmin(best_costs):
            offset = float(offsets[np.nanargmin(own_costs)])
            if abs(offset) > RULES.clock_step_s:
                clock_reason = (
                    f"a clock offset of {offset:+.2f} s explains the picture as well; see "
                    "hyperpaint.geometry.estimate_clock_offset"
                )
    findings = []
    for name, value in declared.fields().items():
        fitting = [v for v in dict.fromkeys(fields[name] for fields in plausible) if v is not None]
        own_odds, other_odds = (
            [odds for fields, odds in fields_and_odds if (fields[name] == value) is is_own]
            for is_own in (True, False)
        )
        likely = " or ".join(v for v in fitting if v != value)
        against = f"log odds {min(-max(own_odds, default=-9999.0), 9999.0):.0f} against it"
        findings.append(
            _finding(
                name, value,
                (value in (None, "None"), "undecided", likely, "not declared"),
                (clock_reason, "undecided", likely, clock_reason),
                (value not in fitting, "wrong", likely, against),
                (len(fitting) > 1, "undecided", likely, f"{' and '.join(fitting)} fit alike"),
                (not other_odds, "undecided", likely, "not tested"),
                (True, "right", "", f"log odds {min(-max(other_odds, default=-9999.0), 9999.0):.0f} for it"),
            )
        )  # fmt: skip
    return findings


# --- fit of expected to measured motion --------------------------------------------------------------------


def _robust_scale(values: Floats) -> float:
    # Return the standard deviation of values about 0 from the median of their size; NaN is ignored.
    sizes = np.abs(values[np.isfinite(values)])
    return max(1.4826 * float(np.median(sizes)), 1e-9) if sizes.size else float("nan")


def _residuals(
    observed: RowMotion, expected: Motion, compared: Bools, interval: float
) -> tuple[Floats, Floats]:
    # Return the motion of a picture minus expected motion, slant of the ground and lag of the clock: shift
    # [pixel] and unlikeness [1], both (line - 1, zone), where ``compared``; ``interval`` of lines [s].
    #
    # Slanted structures on the ground seem to move sideways as the camera moves forward: in proportion to the
    # travel, and equally in every line where structures are parallel. That part looks like an error of the
    # heading, and is subtracted before hypotheses are compared, as is the effect of a clock lag of some
    # milliseconds.
    shift_per_lag = (
        np.gradient(expected.shift, axis=0) / interval if expected.shift.shape[0] > 1 else 0 * expected.shift
    )
    # shifts without terms of known form and unknown, but bounded, size; robust
    design = np.stack([np.where(compared, term, 0.0) for term in (expected.travel, shift_per_lag)])
    limits = np.array([RULES.max_slant, RULES.max_lag_s])
    values = shift = observed.shift - expected.shift
    for _ in range(3):
        scale = _robust_scale(shift[compared])
        inliers = compared & (np.abs(shift) < RULES.clip_sd * scale)
        a = design[:, inliers]
        sizes = np.linalg.solve(a @ a.T / scale**2 + np.diag(limits**-2.0), a @ values[inliers] / scale**2)
        shift = values - np.tensordot(sizes, design, 1)
    # unlikeness without a constant and a non-negative multiple of the expected one; robust
    expected_unlikeness = np.interp(
        np.abs(expected.travel), np.arange(observed.structure.size), observed.structure
    )
    unlikeness = observed.unlikeness - np.median(observed.unlikeness[compared])
    for _ in range(3):
        inliers = compared & (np.abs(unlikeness) < RULES.clip_sd * _robust_scale(unlikeness[compared]))
        x, y = expected_unlikeness[inliers], observed.unlikeness[inliers]
        slope = ((x - x.mean()) * (y - y.mean())).sum() / max(((x - x.mean()) ** 2).sum(), 1e-30)
        unlikeness = observed.unlikeness - (
            y.mean() + max(float(slope), 0.0) * (expected_unlikeness - x.mean())
        )
    return np.where(compared, shift, np.nan), np.where(compared, unlikeness, np.nan)


def _likelihood_costs(parts: Sequence[Floats], compared: Bools, independent: int | None = None) -> Floats:
    # Return negative logarithms of likelihoods of residuals (line, zone), up to a constant. The number of
    # residuals is reduced by the correlation of those at ``independent``, by default the smallest.
    scales = [_robust_scale(part[compared]) for part in parts]
    smallest = int(np.argmin(scales))
    limited = [np.minimum((part[compared] / scales[smallest]) ** 2, RULES.clip_sd**2) for part in parts]
    costs = np.array([0.5 * squares.sum() for squares in limited])
    return costs / _correlation_factor(parts[smallest if independent is None else independent])


def _correlation_factor(residual: Floats) -> float:
    # Return the ratio of the number of residuals (line, zone) to the number of independent ones: of the
    # variance of means over lines and zones to the variance for independent residuals, from the correlation
    # of zones, and of lines up to `RULES.max_lag_lines` apart.
    scale = _robust_scale(residual)
    values = np.clip(
        np.where(np.isfinite(residual), residual, 0.0), -RULES.clip_sd * scale, RULES.clip_sd * scale
    )
    values = values - values.mean()
    row_means = values.mean(axis=1)
    variance = float((values**2).mean())
    if not variance > 0.0 or row_means.size < 4:
        return 1.0
    row_variance = float((row_means**2).mean())
    zone_factor = max(row_variance * values.shape[1] / variance, 1.0)
    lags = range(1, min(RULES.max_lag_lines, row_means.size // 4))
    sums = [float((row_means[k:] * row_means[:-k]).sum()) / (row_variance * row_means.size) for k in lags]
    total = 1.0
    for first, second in zip(sums[::2], sums[1::2], strict=False):
        if first + second <= 0.0:  # Geyer (1992): sums of pairs are positive, but for noise
            break
        total += 2.0 * (first + second)
    return float(zone_factor * total)


def _fit_clock(
    setting: Setting, hypothesis: Hypothesis, compared: Bools, start: float = 0.0
) -> tuple[float, float]:
    # Return the offset of the clock [s] at which poses and picture move together, and its standard
    # uncertainty; ``start`` is approximate.
    #
    # Gauss-Newton iterations, which also fit the pitch of the boresight, coupled to the rate of heading, and,
    # for every zone and block of lines, the slant of the ground. The uncertainty combines a jackknife
    # over blocks of lines (Efron, 1982), which needs no model of the correlation of neighbouring residuals,
    # with `RULES.unexplained_px`.
    offset, view = start, setting.view_of(hypothesis)
    roll, pitch, heading = view.boresight
    for _ in range(RULES.max_steps):
        poses = setting.poses(hypothesis, offset)
        expected = view.motion(poses)
        shifts = (
            view.motion(setting.poses(hypothesis, offset + sign * RULES.time_step_s)).shift
            for sign in (1.0, -1.0)
        )
        per_offset = np.subtract(*shifts) / (2.0 * RULES.time_step_s)
        tilted = view.motion(poses, boresight=(roll, pitch + RULES.turn_step_deg, heading))
        values = setting.observed.shift - expected.shift
        parts = (per_offset, tilted.shift - expected.shift)
        # the size of the first part, and its uncertainty
        is_valid = (
            compared & np.isfinite(values) & np.isfinite(parts).all(axis=0) & np.isfinite(expected.travel)
        )
        is_valid &= np.abs(values) < RULES.outlier_sd * _robust_scale(values[is_valid])
        # smoothing: noise of attitude has opposite signs in neighbouring lines, motion has not
        smooth = np.stack(
            [_running_mean(np.where(is_valid, part, 0.0)) for part in (*parts, values)], axis=-1
        )
        scale = _robust_scale(smooth[..., -1][is_valid])
        count = max(values.shape[0] // RULES.block_lines, RULES.min_blocks)
        blocks = np.array_split(np.arange(values.shape[0]), count)
        smooth_travel = _running_mean(np.where(is_valid, expected.travel, 0.0))[..., None]
        for b in blocks:
            # zone by zone, without the part proportional to travel
            squares = np.maximum((smooth_travel[b] ** 2).sum(axis=0), 1e-12)
            smooth[b] -= (smooth[b] * smooth_travel[b]).sum(axis=0) / squares * smooth_travel[b]
        design, target = np.ascontiguousarray(smooth[..., :-1]), np.ascontiguousarray(smooth[..., -1])
        matrices_of_blocks = (
            np.stack([np.einsum("nzi,nzj->ij", design[b], design[b]) for b in blocks]) / scale**2
        )
        vectors_of_blocks = (
            np.stack([np.einsum("nzi,nz->i", design[b], target[b]) for b in blocks]) / scale**2
        )
        matrix = matrices_of_blocks.sum(0) + np.diag([1.0, (RULES.turn_step_deg / RULES.max_tilt_deg) ** 2])
        vector = vectors_of_blocks.sum(0)
        step = float(np.linalg.solve(matrix, vector)[0])
        # leave out blocks, and pairs of neighbouring blocks, in turn
        sd = 0.0
        for group in (1, 2):
            starts = np.arange(0, len(blocks), group)
            parts_left_out = (
                np.add.reduceat(a, starts, axis=0) for a in (matrices_of_blocks, vectors_of_blocks)
            )
            estimates = np.array(
                [np.linalg.solve(matrix - a, vector - b)[0] for a, b in zip(*parts_left_out, strict=True)]
            )
            share = (starts.size - 1) / starts.size
            sd = max(sd, float(np.sqrt(share * ((estimates - estimates.mean()) ** 2).sum())))
        rms_shift = float(np.sqrt((design[..., 0][is_valid] ** 2).mean()))
        sd = float(np.hypot(sd, RULES.unexplained_px / max(rms_shift, 1e-12)))
        offset += float(np.clip(step, -RULES.max_step_s, RULES.max_step_s))
        if abs(step) < RULES.converged_sd * sd:
            return offset, sd
    return offset, float("inf")


def _running_mean(values: Floats) -> Floats:
    from scipy.ndimage import uniform_filter1d

    return np.asarray(uniform_filter1d(values, RULES.smooth_lines, axis=0, mode="constant"))


def _offset_costs(
    setting: Setting, poses: Callable[[float], Floats], view: View, compared: Bools, offsets: Floats
) -> Floats:
    # Return the robust standard deviation of shifts (offset,) [pixel] at offsets of the clock [s]; NaN where
    # less than half of the picture has a pose.
    costs = np.full(offsets.size, np.nan)
    for k, offset in enumerate(offsets):
        expected = view.motion(poses(float(offset)))
        residual = np.where(compared, setting.observed.shift - expected.shift, np.nan)
        # subtract the part proportional to travel, which comes from slanted structures
        inliers = np.isfinite(residual) & (np.abs(residual) < RULES.clip_sd * _robust_scale(residual))
        x, y = expected.travel[inliers], residual[inliers]
        slant = np.clip(float((y * x).sum() / max((x**2).sum(), 1e-12)), -RULES.max_slant, RULES.max_slant)
        residual = residual - slant * expected.travel
        if np.isfinite(residual).sum() > 0.5 * compared.sum():
            limit = (RULES.outlier_sd * _robust_scale(residual)) ** 2
            costs[k] = np.sqrt(np.nanmean(np.minimum(residual**2, limit)))
    return costs


# --- clock offsets -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ClockOffset:
    """An estimate of the offset between two clocks; it is not applied.

    Attributes
    ----------
    offset_s
        From navigation: to be added to the ``time`` of lines to have navigation's, ``clock_offset_s`` of
        `hyperpaint.geometry.locate`. From irradiance: to be added to the stamps of the irradiance record to
        have the camera's, ``clock_offset_s`` of a collect's ``[irradiance]`` [s].
    uncertainty_s
        Standard uncertainty [s].
    method
        ``"attitude"`` or ``"irradiance"``.
    evidence
        Reason, with numbers.
    curve
        ``misfit`` (offset): root mean square residual at the tested offsets, relative to that without
        any signal.
    """

    offset_s: float
    uncertainty_s: float
    method: str
    evidence: str
    curve: xr.DataArray

    def table(self) -> str:
        # Return the estimate as text.
        return f"{self.method}: {self.offset_s:+.4f} +- {self.uncertainty_s:.4f} s ({self.evidence})"


@takes_quantities(**LOCATION_UNITS, max_offset_s="s", max_uncertainty_s="s")
def estimate_clock_offset(
    line: xr.Dataset,
    *,
    navigation: xr.Dataset | None = None,
    irradiance: xr.Dataset | None = None,
    max_offset_s: float = 2.0,
    max_uncertainty_s: float | None = None,
    convention: Convention | None = None,
    camera: PinholeCamera | xr.Dataset | None = None,
    ground: float | None = None,
    boresight: Sequence[float] = (0.0, 0.0, 0.0),
    lever_arm: Sequence[float] = (0.0, 0.0, 0.0),
    image: xr.DataArray | None = None,
    lines: slice | None = None,
    crs: Any = None,
) -> ClockOffset:
    """Estimate the offset of the camera's clock from another clock; nothing is applied (eager).

    Parameters
    ----------
    line
        Flight line with ``time`` and a cube.
    navigation
        Record whose attitude is compared with how rows of the picture are shifted.
    irradiance
        Record (irradiance_time, irradiance_wavelength) whose level is compared with the brightness of lines;
        either this or ``navigation``.
    max_offset_s
        Largest tested offset to either side [s].
    max_uncertainty_s
        Uncertainty beyond which an offset is refused [s]; by default 0.05 from navigation, 1 from irradiance.
    convention, camera, ground, boresight, lever_arm, crs
        See `hyperpaint.geometry.locate`; for navigation alone.
    image, lines
        See `hyperpaint.geometry.check_conventions`; for irradiance, all lines are used by default.

    Returns
    -------
    ClockOffset
        The offset, its uncertainty, the evidence, and the curve whose minimum it is.

    Raises
    ------
    TimeError
        The offset is undetermined: the light is constant, the platform does not move, the picture does not
        follow, several offsets fit equally well, or the best is at the limit of the search.
    SchemaError
        Neither or both records; a variable is missing.

    Examples
    --------
    >>> import xarray as xr
    >>> def light(seconds):  # a cloud comes
    ...     return 1.0 - 0.5 / (1.0 + np.exp(-(seconds - 30.0) / 1.5))
    >>> start = np.datetime64("2021-07-20T17:00", "ns")
    >>> def stamps(seconds):
    ...     return start + (1e9 * seconds).astype("timedelta64[ns]")
    >>> flown, logged = 0.1 * np.arange(600), np.arange(-10.0, 70.0)
    >>> ground = 800.0 * (1.0 + 0.03 * np.random.default_rng(0).standard_normal((600, 1, 32)))
    >>> counts = ("along_track", "band", "cross_track"), ground * light(flown)[:, None, None]
    >>> line = xr.Dataset({"counts": counts}, {"time": ("along_track", stamps(flown))})
    >>> dims = ("irradiance_time", "irradiance_wavelength")
    >>> level = np.repeat(light(logged)[:, None], 3, axis=1)
    >>> record = xr.Dataset(
    ...     {"irradiance": (dims, level, {"units": "W m-2 nm-1"})},
    ...     {dims[0]: stamps(logged - 1.3), dims[1]: (dims[1], [500.0, 600.0, 700.0], {"units": "nm"})})
    >>> offset = estimate_clock_offset(line, irradiance=record, max_offset_s=5.0)
    >>> abs(offset.offset_s - 1.3) < 2 * offset.uncertainty_s
    True
    """
    SchemaError.raise_if(
        (navigation is None) == (irradiance is None),
        "navigation= and irradiance= are both given or both missing",
        mend="give one of them",
        code="option-conflict",
    )
    SchemaError.raise_if(
        not 0.0 < max_offset_s < np.inf,
        f"max_offset_s {max_offset_s!r}",
        expected="a time above 0 [s]",
        code="value-out-of-range",
    )
    if irradiance is not None:
        return _light_offset(line, irradiance, image, lines, max_offset_s, max_uncertainty_s or 1.0)
    setting = _setting(
        line, navigation, convention=convention, camera=camera, ground=ground, boresight=boresight,
        lever_arm=lever_arm, image=image, lines=lines, crs=crs,
    )  # fmt: skip
    expected = Hypothesis(setting.declared)
    view, poses = setting.view_of(expected), partial(setting.poses, expected)

    observed = setting.observed.shift
    compared = np.broadcast_to(setting.is_steady[:, None], observed.shape) & np.isfinite(observed)
    _refuse_first((not compared.any(), "no two lines in a row show a motion", "motion-not-seen"))
    offsets = np.arange(-max_offset_s, max_offset_s + RULES.search_step_s / 2, RULES.search_step_s)
    costs = _offset_costs(setting, poses, view, compared, offsets)
    _refuse_first(
        (
            np.isnan(costs).all(),
            "the record has no poses at the times of the lines; look at dates and zones",
            "pose-missing",
        )
    )
    best = int(np.nanargmin(costs))
    poses_at_best = poses(float(offsets[best]))
    # the same poses, every angle replaced by its mean
    resting, has_pose = poses_at_best.copy(), np.isfinite(poses_at_best[3])
    mean_direction = np.exp(1j * np.radians(poses_at_best[3:, has_pose])).mean(axis=1)
    resting[3:, has_pose] = np.degrees(np.angle(mean_direction))[:, None]
    misfit = costs / float(_offset_costs(setting, lambda _: resting, view, compared, np.zeros(1))[0])
    gain = 1.0 - float(misfit[best])
    rivals = np.where(np.abs(offsets - offsets[best]) > RULES.rival_distance_s, misfit, np.inf)
    is_ambiguous = 1.0 - float(np.nanmin(rivals)) > (1.0 - RULES.rival_gain) * gain
    # ratio of measured to expected shifts, both less the shifts of a platform at rest
    expected_shift, rest_shift = (view.motion(each).shift for each in (poses_at_best, resting))
    is_valid = compared & np.isfinite(expected_shift) & np.isfinite(rest_shift)
    residual = observed - expected_shift
    is_valid &= np.abs(residual) < RULES.clip_sd * _robust_scale(residual[is_valid])
    moved, seen = (
        _running_mean(np.where(is_valid, part - rest_shift, 0.0)) for part in (expected_shift, observed)
    )
    moved, seen = moved - moved.mean(axis=0), seen - seen.mean(axis=0)
    ratio = float((moved * seen).sum() / max((moved**2).sum(), _EPS))
    _refuse_first(
        (
            not gain > 1.0 - RULES.max_misfit,
            f"attitude explains {100 * max(gain, 0):.1f} % of the shifts; the platform hardly rotates",
            "motion-too-small",
        ),
        (
            best in (0, offsets.size - 1),
            f"the best offset, {offsets[best]:+.2f} s, is at the limit of the search; raise max_offset_s",
            "offset-at-limit",
        ),
        (
            is_ambiguous,
            f"{offsets[np.nanargmin(rivals)]:+.2f} s fits nearly as well as {offsets[best]:+.2f} s",
            "offset-ambiguous",
        ),
        (
            not RULES.min_amplitude < ratio < 1.0 / RULES.min_amplitude,
            f"at the best offset, {offsets[best]:+.2f} s, shifts are {ratio:.2f} of those expected; look "
            "farther, or at signs and units with hyperpaint.geometry.check_conventions",
            "motion-mismatch",
        ),
    )
    offset, sd = _fit_clock(setting, expected, compared, float(offsets[best]))
    limit = max_uncertainty_s or 0.05
    _refuse_first(
        (
            not sd < limit,
            f"it is {offset:+.3f} +- {sd:.3f} s, while {limit:g} s is asked for",
            "offset-uncertain",
        )
    )
    return ClockOffset(
        offset,
        sd,
        "attitude",
        f"attitude explains {100 * gain:.0f} % of the shifts of {int(compared.sum())} parts of rows",
        _curve(offsets, misfit),
    )


def _refuse_first(*rows: tuple[Any, str, str]) -> None:
    # Raise a `TimeError` for the first row (condition, reason, code) whose condition holds.
    for is_refused, reason, code in rows:
        TimeError.raise_if(is_refused, f"the clocks cannot be compared: {reason}", code=code)


def _curve(offsets: Floats, misfit: Floats) -> xr.DataArray:
    return xr.DataArray(
        misfit,
        dims=("offset",),
        coords={"offset": ("offset", offsets, {"units": "s", "long_name": "Offset of the clock"})},
        attrs={"units": "1", "long_name": "What is left unexplained"},
        name="misfit",
    )


def _light_offset(
    line: xr.Dataset,
    irradiance: xr.Dataset,
    image: xr.DataArray | None,
    lines: slice | None,
    max_offset_s: float,
    max_uncertainty_s: float,
) -> ClockOffset:
    # Return the offset at which irradiance and brightness of lines change together.
    part = line if lines is None else line.isel({ALONG_TRACK: lines})
    part_image = image if image is None or lines is None else image.isel({ALONG_TRACK: lines})
    record = require(irradiance, [IRRADIANCE_TIME, IRRADIANCE_WAVELENGTH, "irradiance"], "a clock's offset")
    ticks = record[IRRADIANCE_TIME].values.astype("datetime64[ns]")
    check_irradiance_times(ticks)
    time = require(part, ["time"], "a clock's offset")["time"].values.astype("datetime64[ns]")
    samples, seconds = ((t - ticks[0]).astype(np.int64) / 1e9 for t in (ticks, time))
    # mean irradiance of every sample, any scale
    wavelength = record[IRRADIANCE_WAVELENGTH].values
    is_inside = (wavelength >= _WAVELENGTHS_NM[0]) & (wavelength <= _WAVELENGTHS_NM[1])
    channels = np.flatnonzero(is_inside) if is_inside.any() else np.arange(wavelength.size)
    spectra = record["irradiance"].transpose(IRRADIANCE_TIME, IRRADIANCE_WAVELENGTH).values
    level = np.log(np.maximum(np.asarray(spectra[:, channels].mean(axis=1), np.float64), _EPS))
    is_finite = np.isfinite(level)
    samples, level = samples[is_finite], level[is_finite]
    _refuse_first((samples.size < 4, f"the record has {samples.size} spectra", "record-too-short"))
    # the times of lines in order, and the log change of the light from each line to the next
    is_valid = np.isfinite(seconds) & (np.abs(seconds) < 1e9)
    elsewhere = "the irradiance record does not cover the line, whatever the offset; look at dates and zones"
    _refuse_first((is_valid.sum() < 2, elsewhere, "record-elsewhere"))
    order = np.flatnonzero(is_valid)[np.argsort(seconds[is_valid], kind="stable")]
    seconds, values = seconds[order], _picture(part, part_image)[order].astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        steps = np.diff(np.log(np.where(values > 0, values, np.nan)), axis=0)
    steps[~np.isfinite(steps).any(axis=1)] = 0.0
    change = np.nanmedian(steps, axis=1)
    width = float(np.median(np.diff(samples))) / RULES.bins_an_interval
    edges = np.arange(seconds[0], seconds[-1], max(width, 3.0 * float(np.median(np.diff(seconds)))))
    _refuse_first(
        (
            edges.size <= RULES.min_bins,
            f"the line lasts {seconds[-1] - seconds[0]:.1f} s, "
            f"expected {RULES.min_bins * width:.0f} s for this record",
            "line-too-short",
        )
    )
    observed = np.diff(np.interp(edges, seconds, np.concatenate([[0.0], np.cumsum(change)])))
    offsets = np.linspace(-max_offset_s, max_offset_s, RULES.offset_steps + 1)
    expected = np.full((offsets.size, observed.size), np.nan)
    for k, offset in enumerate(offsets):
        stamps = samples + offset
        if edges[0] >= stamps[0] and edges[-1] <= stamps[-1]:
            expected[k] = np.diff(np.interp(edges, stamps, level))
    covered = np.asarray(np.isfinite(expected).all(axis=1))
    _refuse_first((not covered.any(), elsewhere, "record-elsewhere"))
    swing = float(np.ptp(np.cumsum(expected[covered], axis=1), axis=1).max())
    least = RULES.min_light_change
    _refuse_first(
        (
            swing < least,
            f"light changes by {100 * swing:.1f} % over the line, at least {100 * least:.0f} %",
            "light-constant",
        )
    )
    # misfit at every offset, with residuals limited to four standard deviations
    observed = observed - np.median(observed)
    centred = expected - expected.mean(axis=1, keepdims=True)
    scale = 1.4826 * min(float(np.median(np.abs(observed - m))) for m in centred[covered]) + _EPS
    limit = (4.0 * scale) ** 2
    cost = np.full(expected.shape, np.nan)
    cost[covered] = np.minimum((observed - centred[covered]) ** 2, limit)
    misfit, misfit_constant = cost.mean(axis=1), float(np.minimum(observed**2, limit).mean())
    best = int(np.nanargmin(misfit))
    residual = observed - centred[best]
    autocorrelation = max(float((residual[1:] * residual[:-1]).sum() / max((residual**2).sum(), _EPS)), 0.0)
    count = observed.size * (1.0 - autocorrelation) / (1.0 + autocorrelation)
    odds = 0.5 * count * np.log(misfit / misfit[best])
    gain = 0.5 * count * np.log(misfit_constant / misfit[best])
    rivals = covered & (odds < 2.0)
    is_at_limit = rivals[0] or rivals[-1] or (rivals[1:-1] & ~(covered[2:] & covered[:-2])).any()
    offset = _minimum(offsets, misfit)
    blocks = np.array_split(np.arange(observed.size), RULES.light_blocks)
    without = np.array([_minimum(offsets, cost.sum(axis=1) - cost[:, b].sum(axis=1)) for b in blocks])
    share = (RULES.light_blocks - 1) / RULES.light_blocks
    jackknife_sd = np.sqrt(share * ((without - without.mean()) ** 2).sum())
    near_best = offsets[odds < 0.5]  # within one standard deviation, for a parabolic curve
    sd = max(float(jackknife_sd), float(np.ptp(near_best)) / 2.0, float(offsets[1] - offsets[0]) / 2.0)
    distance = np.abs(offsets - offsets[best])
    distant_rivals = offsets[rivals & (distance > max(RULES.light_rival_sd * sd, RULES.light_rival_s))]
    _refuse_first(
        (
            not gain > RULES.min_light_odds,
            f"the brightness of lines does not follow the light (log odds {gain:.1f}, expected "
            f"{RULES.min_light_odds:g})",
            "light-mismatch",
        ),
        (
            is_at_limit,
            f"the best offset, {offsets[best]:+.2f} s, is at the limit of the offsets that the record covers",
            "offset-at-limit",
        ),
        (
            distant_rivals.size,
            f"{next(iter(distant_rivals), 0.0):+.2f} s fits nearly as well as {offsets[best]:+.2f} s",
            "offset-ambiguous",
        ),
        (
            sd > max_uncertainty_s,
            f"it is {offset:+.2f} +- {sd:.2f} s, while {max_uncertainty_s:g} s is asked for",
            "offset-uncertain",
        ),
    )
    explained = 100.0 * (1.0 - misfit[best] / misfit_constant)
    return ClockOffset(
        offset,
        sd,
        "irradiance",
        f"the light explains {explained:.0f} % of the changes of brightness, log odds {gain:.0f}",
        _curve(offsets, np.sqrt(misfit / misfit_constant)),
    )


def _minimum(offsets: Floats, cost: Floats) -> float:
    # Return the minimum of the parabola through the lowest cost and its neighbours.
    best = int(np.nanargmin(cost))
    if not 0 < best < offsets.size - 1 or not np.isfinite(cost[best - 1 : best + 2]).all():
        return float(offsets[best])
    low, middle, high = cost[best - 1 : best + 2]
    fraction = 0.5 * (low - high) / max(float(low + high - 2.0 * middle), _EPS)
    return float(offsets[best] + np.clip(fraction, -1.0, 1.0) * (offsets[1] - offsets[0]))
