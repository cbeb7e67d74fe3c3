"""Match an irradiance series to every band and column of the camera, and to tilted surfaces.

The spectrometer's samples are matched to the imager's responses (`match_irradiance`), at the wavelength
shifts of its smile, and converted to a tilted surface (`Tilt`). `synchrony` assigns samples to lines.

Assign irradiance samples to the lines that they light, by time.

Irradiance is linear in time between the two samples around a line. Lines outside the record, or in a gap of
it, are flagged: nothing is extrapolated. The data do not contain the offset between the clocks of camera and
spectrometer; `timing_sensitivity` bounds the error that it could cause.
"""

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from hyperpaint.base import (
    IRRADIANCE_TIME,
    IRRADIANCE_WAVELENGTH,
    VARIABLES,
    Array,
    ArrayLike,
    Floats,
    Floats32,
    Ints,
    Problems,
    Quality,
    SchemaError,
    TimeError,
    convert,
    is_number,
    label,
    log_slope,
    one_of,
    responsivity_slope,
    takes_quantities,
    warn_user,
)

from .clear_sky import facing_gain
from .responses import Matching, Responses, matching_operator, misfit_through
from .sun import diffuse_fraction, solar_position

#: Relative change of the 400-1000 nm irradiance between two samples above which the light is unstable.
UNSTABLE_CHANGE = 0.02
LIGHT_FLAGS = SimpleNamespace(
    low_sun_zenith_deg=75.0,
    #: Error of clocks [s] that are not checked: GPS time taken for UTC is 18 s off, TAI 37 s.
    unknown_clock=40.0,
    #: Relative change of irradiance within the clocks' uncertainty above which a line is timing sensitive.
    timing_effect=0.01,
)


@dataclass(frozen=True)
class LineLight:
    # Irradiance samples on either side of each line, with weight, age and flags.
    #: before, after (line,) int64: the samples on either side of the line
    before: Ints
    after: Ints
    weight: Floats  #: (line,) float64: of the later sample; NaN where the line has no light
    age: Floats32  #: (line,) float32: time to the nearest sample [s]
    #: (line,) float32: largest relative error of reflectance by an error of the clocks [1]; see
    #: `timing_sensitivity`
    sensitivity: Floats32
    flags: Array  #: (line,) uint16: bits of `Quality` that hold for the whole line


def line_light(
    time: Array,
    irradiance_time: Array,
    levels: Floats,
    max_gap: float | None = None,
    latitude: Array | None = None,
    longitude: Array | None = None,
    clock_uncertainty: float | None = None,
) -> LineLight:
    # Return the neighbours and weights of every line in an irradiance record.
    #
    # ``time`` (line,) is UTC at mid exposure, in any order, NaT for a line without data; ``irradiance_time``
    # (sample,) is UTC of the samples and must increase. ``levels`` (sample,) or (sample, interval) are the
    # irradiance of each sample, summed over 400-1000 nm or over intervals of it, any scale; NaN, zero or a
    # negative value marks a sample to leave out. ``max_gap`` is the longest interval that is interpolated
    # [s], 2.5 median intervals by default; without the camera's ``latitude`` and ``longitude`` (line,)
    # [degree] the sun's height is not judged; ``clock_uncertainty`` is how far the clocks of camera and
    # spectrometer may disagree [s], `LIGHT_FLAGS.unknown_clock` by default.
    #
    # Raises `TimeError`: Irradiance times do not increase, are missing, or there is no valid sample. Raises
    # `SchemaError`: ``max_gap`` or ``clock_uncertainty`` is out of range.
    #
    # The weight is the quotient of two int64 intervals in nanoseconds, so that no bit of it depends on chunks
    # or on the distance to 1970.
    lines = np.asarray(time).astype("datetime64[ns]")
    samples = np.asarray(irradiance_time).astype("datetime64[ns]")
    check_irradiance_times(samples)
    with Problems("irradiance cannot be assigned to lines", SchemaError) as problems:
        problems.add_if(
            max_gap is not None and not max_gap > 0,
            f"'irradiance_max_gap' is {max_gap} s",
            expected="a positive number",
            code="value-out-of-range",
        )
        problems.add_if(
            clock_uncertainty is not None and not 0 <= clock_uncertainty < 1e6,
            f"'irradiance_clock_uncertainty' is {clock_uncertainty} s",
            expected="0 or more seconds",
            code="value-out-of-range",
        )
    levels = np.reshape(levels, (samples.size, -1))
    valid = np.flatnonzero((np.isfinite(levels) & (levels > 0.0)).all(axis=1))
    TimeError.raise_if(
        valid.size == 0, "the irradiance record holds no valid spectrum", code="irradiance-empty"
    )
    missing = np.isnat(lines)
    stamps, ticks = lines.astype(np.int64), samples[valid].astype(np.int64)
    stamps = np.where(missing, ticks[0], stamps)
    low = np.searchsorted(ticks, stamps, side="right") - 1
    outside = (low < 0) | (stamps > ticks[-1])
    low = np.clip(low, 0, max(ticks.size - 2, 0))
    high = np.minimum(low + 1, ticks.size - 1)
    since, interval = stamps - ticks[low], ticks[high] - ticks[low]
    weight = since / np.maximum(interval, 1)
    age = np.minimum(np.abs(since), np.abs(ticks[high] - stamps)) / 1e9
    if max_gap is None:
        max_gap = 2.5 * float(np.median(np.diff(ticks))) / 1e9 if ticks.size > 1 else 0.0
    gap = ~outside & (interval / 1e9 > max_gap) & (weight > 0.0) & (weight < 1.0)
    level = levels[valid].sum(axis=1)
    change = np.abs(level[high] - level[low]) / np.maximum(np.minimum(level[high], level[low]), 1e-30)
    has_no_light = outside | gap | missing
    max_offset = LIGHT_FLAGS.unknown_clock if clock_uncertainty is None else clock_uncertainty
    sensitivity = timing_sensitivity(stamps, ticks, levels[valid], max_offset)
    sensitivity[has_no_light] = np.nan
    flags = np.zeros(lines.shape, np.uint16)
    flags[outside | gap] |= np.uint16(Quality.IRRADIANCE_GAP)
    flags[~outside & (change > UNSTABLE_CHANGE)] |= np.uint16(Quality.ILLUMINATION_UNSTABLE)
    flags[sensitivity > LIGHT_FLAGS.timing_effect] |= np.uint16(Quality.TIMING_SENSITIVE)
    if latitude is not None and longitude is not None:
        zenith, _ = solar_position(lines, latitude, longitude)
        flags[np.nan_to_num(zenith, nan=0.0) > LIGHT_FLAGS.low_sun_zenith_deg] |= np.uint16(Quality.LOW_SUN)
    flags[missing] = Quality.NO_DATA
    return LineLight(
        valid[low].astype(np.int64),
        valid[high].astype(np.int64),
        np.where(has_no_light, np.nan, weight),
        np.where(missing, np.nan, age).astype(np.float32),
        sensitivity.astype(np.float32),
        flags,
    )


def between_stamps(stamps: Array, times: Any) -> tuple[Ints, Floats]:
    # Return for every time the stamp before it, and the weight of the next stamp: 0 or 1 beyond all stamps.
    #
    # ``stamps`` (stamp,) datetime64 [ns] increase; a single one is before itself.
    ticks, line_time = stamps.astype(np.int64), np.asarray(times).astype("datetime64[ns]")
    line_ns = np.where(np.isnat(line_time), ticks[0], line_time.astype(np.int64))
    index = np.clip(np.searchsorted(ticks, line_ns, side="right") - 1, 0, max(len(ticks) - 2, 0))
    after = np.minimum(index + 1, len(ticks) - 1)
    weight = (line_ns - ticks[index]) / np.maximum(ticks[after] - ticks[index], 1)
    return index.astype(np.int64), np.clip(weight, 0.0, 1.0)


def timing_sensitivity(stamps: Array, ticks: Array, levels: Floats, within: float) -> Floats:
    r"""Return the largest relative error of each line's irradiance that clock errors could cause (line,) [1].

    ``stamps`` (line,) and ``ticks`` (sample,), which increase, are times of lines and samples, int64 [ns];
    ``levels`` (sample, interval) irradiances summed over intervals of wavelength, any scale; ``within`` is
    the largest offset between the clocks [s].

    Notes
    -----
    .. math:: \max_{k, |\delta| \le u} \exp \left| \ln \frac{E_k(t + \delta)}{E_k(t)} \right| - 1

    over the intervals :math:`k`, since a cloud dims the red more than the blue. Limited to the time of the
    record. A cloud's shadow also needs time from the spectrometer to the scene, which acts as a clock error
    does.

    Examples
    --------
    >>> ramp = np.array([[1.0], [1.0], [0.9], [0.9]])  # one sample a second
    >>> seconds = np.arange(4) * 10**9
    >>> timing_sensitivity(np.array([0, 10**9]), seconds, ramp, 0.5).round(4)
    array([0.    , 0.0526])
    """
    if len(ticks) < 2:
        return np.zeros(stamps.shape)
    logs = np.log(np.maximum(levels, 1e-30))
    empty = np.full(levels.shape[1], np.inf)
    offset = round(within * 1e9)
    moments = np.stack([stamps - offset, stamps, stamps + offset])
    after = np.clip(np.searchsorted(ticks, moments, side="right"), 1, ticks.size - 1)
    weight = np.clip((moments - ticks[after - 1]) / (ticks[after] - ticks[after - 1]), 0.0, 1.0)[..., None]
    level = levels[after - 1] + weight * (levels[after] - levels[after - 1])
    at_early, at_stamp, at_late = np.log(np.maximum(level, 1e-30))
    # inside a window, extremes are at samples; many lines share a window
    first, last = (
        np.searchsorted(ticks, stamps - offset),
        np.searchsorted(ticks, stamps + offset, side="right"),
    )
    windows, window_of_line = np.unique(np.stack([first, last]), axis=1, return_inverse=True)
    extremes = np.array(
        [(logs[a:b].min(axis=0), logs[a:b].max(axis=0)) if b > a else (empty, -empty) for a, b in windows.T]
    )
    lowest, highest = np.moveaxis(extremes[window_of_line.ravel()], 1, 0)
    lowest, highest = (
        np.minimum(lowest, np.minimum(at_early, at_late)),
        np.maximum(highest, np.maximum(at_early, at_late)),
    )
    return np.asarray(np.expm1(np.maximum(at_stamp - lowest, highest - at_stamp).max(axis=1)))


def channels_of(record: xr.DataArray) -> Floats:
    # Return the wavelengths of a record's channels [nm]; SchemaError where it has no such coordinate.
    SchemaError.raise_if(
        IRRADIANCE_WAVELENGTH not in record.coords,
        "'irradiance' has no coordinate 'irradiance_wavelength' [nm]",
        code="coordinate-missing",
    )
    channels = record[IRRADIANCE_WAVELENGTH]
    return (convert(channels, "nm") if "units" in channels.attrs else channels).values.astype(np.float64)


def check_irradiance_times(samples: Array) -> None:
    # Raise TimeError unless all stamps are present and increase.
    with Problems("irradiance times cannot be used", TimeError) as problems:
        problems.add_if(
            not samples.size, "irradiance_time has size 0: no sample is selected", code="empty-input"
        )
        problems.add_if(
            np.isnat(samples).any(),
            f"{int(np.isnat(samples).sum())} of {samples.size} stamps are missing (NaT)",
            mend="drop them",
            code="time-missing",
        )
        steps = np.diff(samples.astype(np.int64))
        same, back = np.flatnonzero(steps == 0), np.flatnonzero(steps < 0)
        if same.size:
            problems.add(
                f"{same.size} duplicate stamps, first {samples[same[0]]}",
                mend="keep one spectrum of each",
                code="time-duplicate",
            )
        if back.size:
            problems.add(
                f"stamps run backwards at {samples[back[0] + 1]}",
                mend="sort them with .sortby('irradiance_time')",
                code="time-unordered",
            )


def replace_record(dataset: xr.Dataset, irradiance: Any) -> xr.Dataset:
    # Return the line with another irradiance record, attributes included, in place of its own.
    #
    # Raises `SchemaError`: ``irradiance`` is no Dataset, or lacks 'irradiance'.
    SchemaError.raise_if(
        not isinstance(irradiance, xr.Dataset),
        f"irradiance= is {type(irradiance).__name__}",
        expected=(
            "a Dataset with 'irradiance' and 'irradiance_fwhm', as hyperpaint.open_irradiance returns it"
        ),
        code="type-wrong",
    )
    names = [name for name in irradiance.data_vars if str(name).startswith("irradiance")]
    SchemaError.raise_if(
        "irradiance" not in names,
        f"the Dataset given as irradiance= holds {', '.join(map(str, irradiance.data_vars)) or 'nothing'}",
        expected="'irradiance' and 'irradiance_fwhm'",
        code="variable-missing",
    )
    SchemaError.raise_if(
        IRRADIANCE_TIME not in irradiance["irradiance"].dims,
        f"the Dataset given as irradiance= has irradiance {tuple(map(str, irradiance['irradiance'].dims))}",
        expected=f"({IRRADIANCE_TIME}, {IRRADIANCE_WAVELENGTH})",
        mend="pass it through hyperpaint.open_irradiance(..., fwhm_nm=) first",
        code="dims-wrong",
    )
    old_names = [name for name in dataset.variables if str(name).startswith("irradiance")]
    line_attrs = {
        name: text for name, text in dataset.attrs.items() if not name.startswith(("irradiance", "alignment"))
    }
    record_attrs = {
        name: text for name, text in irradiance.attrs.items() if str(name).startswith("irradiance")
    }
    line = dataset.drop_vars(old_names).merge(irradiance[names], combine_attrs="override")
    line.attrs = {**line_attrs, **record_attrs}
    return line


# --- clocks ------------------------------------------------------------------------------------------------

#: Wavelength at which the shift between camera and record is stated, and interval of its slope [nm].
ALIGNED_AT_NM, ALIGNED_PER_NM = 600.0, 100.0


#: Distance of the wavelength shifts at which operators are computed [nm]; between them E is cubic.
NODE_SPACING = 0.5
MAX_NOISE_GAIN = 3.0
#: Largest zenith angle of the sun for which the sky's directions are modelled [degree]; held beyond.
MAX_SUN_ZENITH_DEG = 89.0


@takes_quantities(angle="degree", azimuth="degree")
@dataclass(frozen=True)
class Tilt:
    """Attitude of a tilted surface, and the sky and ground in its view.

    Attributes
    ----------
    angle
        Angle between the surface's normal and the zenith, 0 to 90 [degree].
    azimuth
        Azimuth of the normal, clockwise from north [degree].
    sky_view_factor
        Part of the sky that the surface sees [1]; by default ``(1 + cos angle) / 2``, as in an open field.
    ground_reflectance
        Reflectance of the ground, which fills the rest of its view [1].
    diffuse_fraction : (band,)
        Diffuse part of the global irradiance [1]; the clear-sky model of `hyperpaint.light.sun` by default.
    sky
        "clear": diffuse light is distributed as under a clear sky (`hyperpaint.light.clear_sky`);
        "uniform": evenly. By default clear with the modelled split, uniform with a given one, which may
        belong to any sky.

    Raises
    ------
    SchemaError
        A value is out of its range; all are listed.

    Examples
    --------
    >>> import numpy as np
    >>> noon = np.array(["2021-06-21T17:00"], "datetime64[ns]")
    >>> facing, turned = Tilt(10.0, 180.0), Tilt(10.0, 0.0)  # to the south, and to the north
    >>> facing.factor(noon, 43.0, -77.0, [550.0]) > 1 > turned.factor(noon, 43.0, -77.0, [550.0])
    array([[ True]])
    """

    angle: float
    azimuth: float
    sky_view_factor: float | None = None
    ground_reflectance: float = 0.2
    diffuse_fraction: Any = None
    sky: str | None = None

    def __post_init__(self) -> None:
        with Problems("the tilt of the surface is out of range", SchemaError) as problems:
            problems.add_if(
                not 0.0 <= self.angle <= 90.0,
                f"angle {self.angle:g}",
                expected="0 to 90 degrees from level",
                code="value-out-of-range",
            )
            problems.add_if(
                not is_number(self.azimuth),
                f"azimuth {self.azimuth}",
                expected="degrees clockwise from north",
                code="value-out-of-range",
            )
            for name in ("sky_view_factor", "ground_reflectance", "diffuse_fraction"):
                value = getattr(self, name)
                problems.add_if(
                    value is not None and not ((np.asarray(value) >= 0) & (np.asarray(value) <= 1)).all(),
                    f"{name} {value}",
                    expected="0 to 1",
                    code="value-out-of-range",
                )
            if self.sky is not None:
                one_of(self.sky, ("clear", "uniform"), "sky", problems=problems)
        if self.sky is None:
            object.__setattr__(self, "sky", "clear" if self.diffuse_fraction is None else "uniform")

    def factor(self, time: Array, latitude: float, longitude: float, wavelength: Floats) -> Floats:
        r"""Return the irradiance on the surface over that on level ground, (time, band) [1].

        Notes
        -----
        .. math:: E_t = E_{dir} \frac{\cos\theta_i}{\cos\theta_s} + V G E_{dif} + (1 - V) \rho_n E

        with :math:`V` the sky view factor, :math:`\rho_n` the ground's reflectance and :math:`G` the gain by
        the side of a clear sky that the surface faces (`hyperpaint.light.clear_sky.facing_gain`), written
        as a departure from 1, so that a level surface gives exactly 1.
        """
        zenith, sun_azimuth = (np.radians(angle) for angle in solar_position(time, latitude, longitude))
        slope = np.radians(self.angle)
        incidence = np.cos(slope) * np.cos(zenith) + np.sin(slope) * np.sin(zenith) * np.cos(
            sun_azimuth - np.radians(self.azimuth)
        )
        sun_cosine = np.cos(zenith)
        # direct light relative to level ground; 1 where the sun is at the horizon
        beam = np.where(sun_cosine > 1e-3, np.clip(incidence, 0.0, None) / np.maximum(sun_cosine, 1e-3), 1.0)
        view = (1.0 + np.cos(slope)) / 2.0 if self.sky_view_factor is None else self.sky_view_factor
        diffuse = (
            np.stack([diffuse_fraction(wavelength, float(np.degrees(z))) for z in zenith])
            if self.diffuse_fraction is None
            else np.broadcast_to(
                np.asarray(self.diffuse_fraction, np.float64), (zenith.size, wavelength.size)
            )
        )
        gain = np.zeros(diffuse.shape)
        if self.sky == "clear" and self.angle > 0.0:
            from_sun = np.degrees(np.radians(self.azimuth) - sun_azimuth)
            for row, sun, azimuth_offset in zip(
                gain, np.minimum(np.degrees(zenith), MAX_SUN_ZENITH_DEG), from_sun, strict=True
            ):
                row[:] = facing_gain(wavelength, float(sun), self.angle, float(azimuth_offset)) - 1.0
        return np.asarray(
            1.0
            + (1.0 - diffuse) * (beam[:, None] - 1.0)
            + (view - 1.0) * (diffuse - self.ground_reflectance)
            + view * gain * diffuse
        )


@dataclass(frozen=True)
class Smile:
    # Wavelength shifts of the columns for the kernels: a cubic in every cell between two shifts.
    nodes: Floats  #: (node,): wavelength shifts [nm]; a single 0 where there is no smile
    shift: Array  #: (1 or band, column) float32: position of a column in its cell, 0 to 1
    #: edges (1 or band, run + 1), cells (1 or band, run): runs of neighbouring columns that share a cell
    edges: Array
    cells: Array

    def cubics(self, series: Floats) -> Floats:
        # Return the coefficients (..., band, cell, 4) of cubics through values (..., node, band).
        #
        # One node gives (..., band, 1, 1), the values themselves. With several nodes it is Lagrange's
        # polynomial through the four nodes around a cell, in powers of the position in the cell.
        if self.nodes.size == 1:
            return np.swapaxes(series, -1, -2)[..., None]
        c_before, c_low, c_high, c_after = (series[..., k : self.nodes.size - 3 + k, :] for k in range(4))
        return np.moveaxis(
            np.stack(
                (
                    c_low,
                    -c_before / 3 - c_low / 2 + c_high - c_after / 6,
                    c_before / 2 - c_low + c_high / 2,
                    -c_before / 6 + c_low / 2 - c_high / 2 + c_after / 6,
                ),
                axis=-1,
            ),
            -3,
            -2,
        )


def smile_cells(wavelength_shift: ArrayLike | None, columns: int) -> Smile:
    # Return the nodes, cells and runs of a smile over a number of columns.
    #
    # ``wavelength_shift`` (cross_track,) or (band, cross_track) is the true minus the nominal wavelength of
    # each column [nm]; None or all zero for no smile.
    #
    # Raises `SchemaError`: The shift is not finite, or beyond 20 nm.
    shift = np.atleast_2d(
        np.asarray([0.0] * columns if wavelength_shift is None else wavelength_shift, np.float64)
    )
    SchemaError.raise_if(
        not (np.isfinite(shift).all() and np.abs(shift).max() <= 20.0),
        "'wavelength_shift' is not finite or too large",
        expected="at most 20 nm",
        mend="check its units",
        code="wavelength-shift-range",
    )
    if not shift.any():
        full_run = np.array([[0, columns]])
        return Smile(np.zeros(1), np.zeros((1, columns), np.float32), full_run, np.zeros((1, 1), np.int64))
    first = int(np.floor(shift.min() / NODE_SPACING))
    last = max(int(np.ceil(shift.max() / NODE_SPACING)), first + 1)
    cell = np.clip(np.floor(shift / NODE_SPACING).astype(np.int64) - first, 0, last - first - 1)
    starts = [np.concatenate(([0], np.flatnonzero(np.diff(row)) + 1)) for row in cell]
    runs = max(start.size for start in starts)
    # pad rows that have fewer runs with empty runs
    edges = np.stack([np.pad(start, (0, runs + 1 - start.size), constant_values=columns) for start in starts])
    cells = np.take_along_axis(cell, np.minimum(edges[:, :-1], columns - 1), axis=1)
    nodes = np.arange(first - 1, last + 2, dtype=np.float64) * NODE_SPACING
    return Smile(nodes, (shift / NODE_SPACING - first - cell).astype(np.float32), edges, cells)


@takes_quantities(wavelength="nm", fwhm="nm", irradiance_fwhm="nm", nodes="nm", srf_offset="nm")
def match_irradiance(
    irradiance: xr.DataArray,
    wavelength: ArrayLike,
    fwhm: ArrayLike,
    *,
    irradiance_fwhm: ArrayLike = 3.0,
    nodes: ArrayLike = (0.0,),
    srf_shape: str = "gaussian",
    irradiance_srf_shape: str = "gaussian",
    responsivity: ArrayLike | None = None,
    srf_offset: ArrayLike | None = None,
    srf: ArrayLike | None = None,
) -> xr.DataArray:
    """Return the irradiance in the imager's own bands.

    Lazy in ``irradiance``; the operator itself is computed at once, from wavelengths and widths alone.

    Parameters
    ----------
    irradiance : (irradiance_time, irradiance_wavelength)
        Downwelling spectral irradiance with its coordinate ``irradiance_wavelength`` [nm].
        [any unit of irradiance]
    wavelength, fwhm : (band,)
        Centres and full widths at half maximum of the imager's bands [nm].
    irradiance_fwhm
        Full width at half maximum of the spectrometer, a number or one for each of its wavelengths [nm].
    nodes
        Wavelength shifts [nm] at which the bands are evaluated, for the imager's smile.
    srf_shape, irradiance_srf_shape
        Line shapes of the imager and of the spectrometer: ``"gaussian"``, ``"slit"`` or ``"tabulated"``
        (imager only).
    responsivity : (band,)
        Relative responsivity of the imager, any scale; its slope over one band weighs the response.
    srf_offset : (srf_offset,), srf : (band, srf_offset)
        Tabulated line shapes of the imager.

    Returns
    -------
    (irradiance_time, node, band), float32
        Irradiance [W m-2 nm-1], with coordinates ``node`` [nm], ``wavelength`` [nm], and of the operator
        ``misfit``, ``noise_gain`` and ``coverage`` (node, band) [1]. NaN where the spectrometer does not
        cover a band.

    Raises
    ------
    SchemaError
        Dims, widths or shapes do not fit; every problem is listed.
    UnitsError
        ``irradiance`` is not an irradiance.

    Warns
    -----
    PaintWarning
        The imager is sharper than the spectrometer allows (noise gain above 3), or bands lie outside its
        range.

    Notes
    -----
    The operator is `hyperpaint.light.responses.matching_operator`. Its rows sum to 1, so that a constant
    irradiance passes unchanged.

    Examples
    --------
    >>> import xarray as xr
    >>> grey = xr.DataArray(
    ...     np.full((1, 101), 1.3, "float32"), dims=("irradiance_time", "irradiance_wavelength"),
    ...     coords={"irradiance_wavelength": np.arange(500.0, 601.0)}, attrs={"units": "W m-2 nm-1"})
    >>> matched = match_irradiance(grey, [540.0, 550.0], [6.0, 6.0])
    >>> print(matched.dims, matched.values.round(4))
    ('irradiance_time', 'node', 'band') [[[1.3 1.3]]]
    """
    dims = VARIABLES["irradiance"].dims
    SchemaError.raise_if(
        set(irradiance.dims) != set(dims),
        f"'irradiance' has dims {irradiance.dims}",
        expected=f"{dims}",
        code="dims-wrong",
    )
    irradiance = convert(irradiance.transpose(*dims), VARIABLES["irradiance"].units, "irradiance")
    channels = channels_of(irradiance)
    slope = None
    if responsivity is not None:
        centres = np.atleast_1d(np.asarray(wavelength, np.float64))
        widths = np.broadcast_to(np.asarray(fwhm, np.float64), centres.shape)
        slope = log_slope(centres, np.asarray(responsivity), 2.0 * widths)
    shifts = np.atleast_1d(np.asarray(nodes, np.float64))
    arrays = {"wavelength": wavelength, "fwhm": fwhm, "srf_offset": srf_offset, "srf": srf}
    imager = imager_of({**arrays, "responsivity_slope": slope}, srf_shape)
    spectrometer = Responses(channels, np.asarray(irradiance_fwhm, np.float64), irradiance_srf_shape)
    matching = matching_operator(spectrometer, imager, tuple(shifts.tolist()))
    _warn_of_bands(matching, channels, imager.wavelength)
    matched = xr.apply_ufunc(
        lambda spectra: _apply(matching, spectra).astype(np.float32),
        irradiance.chunk({IRRADIANCE_WAVELENGTH: -1}) if irradiance.chunks else irradiance,
        input_core_dims=[[IRRADIANCE_WAVELENGTH]],
        output_core_dims=[["node", "band"]],
        dask="parallelized",
        output_dtypes=[np.float32],
        dask_gufunc_kwargs={
            "output_sizes": {"node": matching.misfit.shape[0], "band": matching.misfit.shape[1]}
        },
    )
    quality = {
        name: (("node", "band"), getattr(matching, name)) for name in ("misfit", "noise_gain", "coverage")
    }
    matched = matched.assign_coords(
        node=("node", shifts, {"units": "nm", "long_name": "Wavelength shift"}),
        wavelength=("band", imager.wavelength, VARIABLES["wavelength"].attrs),
        **quality,
    )
    return label(matched, "irradiance")


def _warn_of_bands(matching: Matching, channels: Floats, wavelength: Floats) -> None:
    sharp = np.flatnonzero(np.nanmax(np.nan_to_num(matching.noise_gain), axis=0) > MAX_NOISE_GAIN)
    if sharp.size:
        warn_user(
            f"{sharp.size} bands are sharper than the irradiance spectrometer resolves (noise gain "
            f"above {MAX_NOISE_GAIN:g}, first at {wavelength[sharp[0]]:.1f} nm); their reflectance keeps "
            "structure that is narrower than its width",
            "bands-too-sharp",
        )
    # all weights of a band outside the record are NaN
    outside = np.flatnonzero(np.isnan(matching.weights[..., 0]).any(axis=0))
    if outside.size:
        warn_user(
            f"{outside.size} bands ({wavelength[outside].min():.1f} to {wavelength[outside].max():.1f} "
            f"nm) lie outside the irradiance record ({channels.min():g} to {channels.max():g} nm) and "
            "become NaN",
            "bands-outside-irradiance",
        )


def _apply(matching: Matching, spectra: Array, order: Array | None = None) -> Floats:
    # Return spectra (..., channel) as (..., node, band); NaN where a missing channel has a weight.
    # `order`: indices of the spectra's channels in the order of the weights; None for the same order.
    # most channels of the spectrometer lie outside the camera's range and have no weight
    channels = matching.used
    spectra = np.asarray(spectra[..., channels if order is None else order[channels]], np.float64)
    weights, missing = matching.weights[..., channels], np.isnan(spectra)
    has_gaps = missing.any()
    matched = np.tensordot(
        np.where(missing, 0.0, spectra) if has_gaps else spectra, weights, axes=([-1], [-1])
    )
    if has_gaps:
        is_missing = np.tensordot(missing.astype(np.float64), np.abs(weights) > 1e-6, axes=([-1], [-1])) > 0
        matched = np.where(is_missing, np.nan, matched)
    return np.asarray(matched)


def shift_at(wavelength: Floats, shift: float, slope: float) -> Floats:
    # Return the shift at wavelengths [nm] from the shift at 600 nm and its change over 100 nm.
    return np.asarray(shift + slope * (wavelength - ALIGNED_AT_NM) / ALIGNED_PER_NM)


class RecordDeparture(NamedTuple):
    # Difference of an irradiance record from its declaration, measured by a comparison with the camera.
    shift_nm: float  #: Wavelength of the camera minus wavelength of the record, at `ALIGNED_AT_NM` [nm]
    slope_nm: float  #: Change of the shift over `ALIGNED_PER_NM` [nm]
    width: float  #: Width of the record over the declared one [1]


def imager_of(arrays: Mapping[str, Any], srf_shape: str) -> Responses:
    # Return the imager's responses from a flight line's small variables.
    return Responses(
        arrays["wavelength"],
        arrays["fwhm"],
        srf_shape,
        spacing=arrays.get("band_spacing"),
        slope=responsivity_slope(arrays),
        offset=arrays.get("srf_offset"),
        table=arrays.get("srf"),
    )


def matched_series(
    spectra: Array,
    channels: Floats,
    irradiance_fwhm: Any,
    irradiance_shape: str,
    imager: Responses,
    nodes: Floats,
    departure: RecordDeparture | None = None,
) -> tuple[Floats, Floats]:
    # Return a series (time, channel) as float64 (time, node, band), and the misfit (node, band) [1].
    #
    # The array side of `match_irradiance`. ``departure``: difference of the record from its declaration that
    # a comparison in flight measured and that was not corrected (`departure_of_record`); it enters the
    # misfit.
    order = np.argsort(channels, kind="stable")
    width = np.broadcast_to(np.asarray(irradiance_fwhm, np.float64), channels.shape)[order]
    spectrometer = Responses(channels[order], width, irradiance_shape)
    shifts = tuple(np.asarray(nodes, np.float64).tolist())
    matching = matching_operator(spectrometer, imager, shifts)
    _warn_of_bands(matching, channels[order], imager.wavelength)
    misfit = matching.misfit
    if departure is not None:
        shift = shift_at(channels[order], departure.shift_nm, departure.slope_nm)
        measured = Responses(channels[order] - shift, width * departure.width, irradiance_shape)
        misfit = misfit_through(spectrometer, measured, imager, shifts)
    return _apply(matching, np.asarray(spectra), order), misfit


def departure_of_record(attrs: Mapping[Any, Any]) -> RecordDeparture | None:
    # Return the measured departure of a flight line's record that was not corrected; None without one.
    #
    # `hyperpaint.alignment.align` stores it in attributes.
    names = ("alignment_shift", "alignment_shift_slope", "alignment_width")
    return (
        None
        if attrs.get("alignment_state") != "not applied" or not set(names) <= set(attrs)
        else RecordDeparture(*(float(attrs[name]) for name in names))
    )


# --- noise of the irradiance spectrometer, and its effect on the bands of a camera -------------------------


#: Variance of irradiance interpolated between two samples over that of a sample: mean of (1 - w)^2 + w^2.
INTERPOLATED = 2.0 / 3.0

#: A channel is common if it is present in this share of the samples; samples without it are left out.
COMMON_SHARE = 0.9
#: Minimum and maximum number of triples of successive samples for an estimate of noise.
MIN_TRIPLES, MAX_TRIPLES = 4, 256
NOISE = SimpleNamespace(
    #: Number of spectra whose mean gives the level of a record.
    max_mean_spectra=64,
    window_channels=21,
    #: Longest interval between neighbouring samples [median intervals].
    max_intervals=2.5,
    #: Standard deviation over median absolute deviation of a normal distribution [1].
    sd_per_median_deviation=1.4826,
)


def matched_noise(arrays: Mapping[str, Any]) -> tuple[Floats, Floats]:
    # Return the irradiance of the bands and the noise of one sample of it, from a line's small variables.
    #
    # The first is the mean of the record (band,) [W m-2 nm-1], the second a covariance (band, band) relative
    # to it [1]. Zero without ``irradiance_u_random``.
    record = arrays["irradiance"]
    sample_numbers = np.linspace(0, len(record) - 1, min(len(record), NOISE.max_mean_spectra)).astype(np.intp)
    spectra = np.asarray(record[sample_numbers], np.float64)
    is_finite = np.isfinite(spectra)
    mean = np.where(is_finite, spectra, 0.0).sum(axis=0) / np.maximum(is_finite.sum(axis=0), 1)
    imager = imager_of(arrays, arrays["srf_shape"])
    # matching is linear: match the mean, and the noise of one channel at a time
    noise = mean * np.broadcast_to(np.asarray(arrays.get("irradiance_u_random", 0.0), np.float64), mean.shape)
    channels = np.asarray(arrays["irradiance_wavelength"], np.float64)
    with warnings.catch_warnings(action="ignore"):  # the plan warns
        matched, _ = matched_series(
            np.concatenate([mean[None], np.diag(noise)]),
            channels,
            arrays["irradiance_fwhm"],
            arrays["irradiance_srf_shape"],
            imager,
            np.zeros(1),
        )
    level = matched[0, 0]
    relative = np.nan_to_num(matched[1:, 0] / np.where(level > 0, level, np.nan))
    return level, relative.T @ relative


def at_bands(values: Any, channels: Any, wavelength: Any) -> Floats:
    # Return values of channels, interpolated to the wavelengths of bands (band,).
    channels = np.asarray(channels, np.float64)
    order = np.argsort(channels, kind="stable")
    channel_values = np.broadcast_to(np.asarray(values, np.float64), channels.shape)
    return np.asarray(np.interp(np.asarray(wavelength, np.float64), channels[order], channel_values[order]))


def noise_of_record(spectra: Array, times: Array, *, fewest: int = MIN_TRIPLES) -> Floats | None:
    # Return the relative noise of single irradiance samples (channel,) [1]; None for too few samples.
    #
    # ``spectra`` (sample, channel), any scale; ``times`` (sample,) datetime64. The noise is the departure of
    # a sample from the straight line between its neighbours in time, minus the departure of neighbouring
    # channels, since light changes smoothly over wavelength; median over samples and 21 channels. Noise
    # common to channels is not measured; samples without light or values are left out. ``fewest``: minimum
    # number of triples of successive samples.
    from scipy import ndimage

    seconds = np.asarray(times).astype("datetime64[ns]").astype(np.int64) / 1e9
    steps = np.diff(seconds)
    is_near = steps <= NOISE.max_intervals * np.median(steps) if steps.size else np.zeros(0, bool)
    middle_samples = np.flatnonzero(is_near[:-1] & is_near[1:]) + 1
    if middle_samples.size < fewest:
        return None
    middle_samples = middle_samples[
        np.linspace(0, middle_samples.size - 1, min(middle_samples.size, MAX_TRIPLES)).astype(np.intp)
    ]
    # triples of complete samples, and channels that all triples have
    triples = np.stack([spectra[middle_samples + step] for step in (-1, 0, 1)]).astype(np.float64)
    is_valid = np.isfinite(triples) & (triples > 0)
    is_complete = (is_valid.sum(axis=2) > COMMON_SHARE * is_valid.any(axis=(0, 1)).sum()).all(axis=0)
    if is_complete.sum() < fewest:
        return None
    triples, middle_samples, is_usable = (
        triples[:, is_complete],
        middle_samples[is_complete],
        is_valid[:, is_complete].all(axis=(0, 1)),
    )
    if is_usable.sum() < NOISE.window_channels:
        return None
    # departure from the straight line in time, scaled to one sample, minus departure of neighbouring channels
    before, centre, after = np.log(triples[:, :, is_usable])
    weight = (
        (seconds[middle_samples] - seconds[middle_samples - 1])
        / (seconds[middle_samples + 1] - seconds[middle_samples - 1])
    )[:, None]
    departure = centre - (before + weight * (after - before))
    departure /= np.sqrt(1.0 + weight**2 + (1.0 - weight) ** 2)
    is_neighbour = np.ones((1, NOISE.window_channels), bool)
    is_neighbour[0, NOISE.window_channels // 2] = False
    departure -= ndimage.median_filter(departure, footprint=is_neighbour)
    spread = NOISE.sd_per_median_deviation * np.median(np.abs(departure), axis=0)
    # the median of n neighbours has pi / (2 n) of the variance of a single one
    spread = ndimage.median_filter(spread, NOISE.window_channels) / np.sqrt(
        1.0 + np.pi / (2.0 * is_neighbour.sum())
    )
    channels = np.arange(is_usable.size)
    return np.asarray(np.interp(channels, channels[is_usable], spread))
