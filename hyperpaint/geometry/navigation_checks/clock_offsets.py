"""Clock offset between a camera and a navigation record, or an irradiance spectrometer.

The offset of the irradiance spectrometer's clock follows from clouds that both instruments see. Brightness of
lines varies much more with the ground than with the light. But from one line to the next most pixels show
nearly the same ground, so that the median change over columns is the change of the light.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NoReturn

import numpy as np
import xarray as xr

from hyperpaint.base.arrays import Bools, Floats
from hyperpaint.base.attitude_conventions import Convention
from hyperpaint.base.errors import SchemaError, TimeError
from hyperpaint.base.schema import ALONG_TRACK, IRRADIANCE_TIME, IRRADIANCE_WAVELENGTH, require
from hyperpaint.base.units import takes_quantities
from hyperpaint.geometry.georeference.cameras import PinholeCamera
from hyperpaint.geometry.georeference.poses import LOCATION_UNITS
from hyperpaint.light.synchrony import check_irradiance_times

from .hypotheses import Hypothesis
from .motion_fit import amplitude, costs_of, fit_clock
from .picture_motion import picture_of
from .pose_motion import setting_of


@dataclass(frozen=True)
class AttitudeRules:
    """Thresholds for an offset between attitude and picture; set on simulated flights."""

    search_step_s: float = 0.01  #: step of the first search; platforms rotate at a few hertz at most
    #: Largest misfit at the best offset, relative to the misfit of a platform without rotation.
    max_misfit: float = 0.97
    #: Smallest ratio of measured to expected shifts, and of expected to measured shifts, for one motion.
    min_amplitude: float = 0.75
    rival_gain: float = 0.3  #: share of the best offset's gain that a rival offset must lack
    rival_distance_s: float = 0.15  #: distance from the best offset beyond which an offset is a rival


@dataclass(frozen=True)
class LightRules:
    """Thresholds for an offset between irradiance and brightness of lines; set on simulated flights."""

    wavelengths_nm: tuple[float, float] = (500.0, 850.0)  #: as for pictures
    min_change: float = 0.02  #: minimum relative change of the light over the line
    bins_an_interval: float = 2.0  #: time bins per interval of the irradiance record
    min_bins: int = 12
    offset_steps: int = 400
    blocks: int = 12  #: blocks of lines that the jackknife leaves out in turn
    min_log_odds: float = 10.0  #: minimum log odds over constant light
    #: Distance beyond which an offset that fits nearly as well is a rival: standard deviations, and seconds.
    rival_sd: float = 5.0
    rival_distance_s: float = 0.5


ATTITUDE, LIGHT = AttitudeRules(), LightRules()


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
        """Return the estimate as text."""
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
    if (navigation is None) == (irradiance is None):
        raise SchemaError(
            "navigation= and irradiance= are both given or both missing",
            mend="give one of them",
            code="option-conflict",
        )
    if not 0.0 < max_offset_s < np.inf:
        raise SchemaError(
            f"max_offset_s {max_offset_s!r}", expected="a time above 0 [s]", code="value-out-of-range"
        )
    if irradiance is not None:
        return _light_offset(line, irradiance, image, lines, max_offset_s, max_uncertainty_s or 1.0)
    setting = setting_of(
        line, navigation, convention=convention, camera=camera, ground=ground, boresight=boresight,
        lever_arm=lever_arm, image=image, lines=lines, crs=crs,
    )  # fmt: skip
    expected = Hypothesis(setting.declared)
    view = expected.view(setting.view)

    def poses(offset: float) -> Floats:
        return expected.poses(setting.recorded, offset)

    is_steady = np.broadcast_to(setting.is_steady[:, None], setting.observed.shift.shape)
    compared = is_steady & np.isfinite(setting.observed.shift)
    if not compared.any():
        _refuse("no two lines in a row show a motion", "motion-not-seen")
    offsets = np.arange(-max_offset_s, max_offset_s + ATTITUDE.search_step_s / 2, ATTITUDE.search_step_s)
    costs = costs_of(setting.observed, poses, view, compared, offsets)
    if np.isnan(costs).all():
        _refuse("the record has no poses at the times of the lines; look at dates and zones", "pose-missing")
    poses_at_lowest = poses(float(offsets[np.nanargmin(costs)]))
    cost_at_rest = float(
        costs_of(setting.observed, lambda _: _without_rotation(poses_at_lowest), view, compared, np.zeros(1))[
            0
        ]
    )
    misfit = costs / cost_at_rest
    best = int(np.nanargmin(misfit))
    gain = 1.0 - float(misfit[best])
    if not gain > 1.0 - ATTITUDE.max_misfit:
        _refuse(
            f"attitude explains {100 * max(gain, 0):.1f} % of the shifts; the platform hardly rotates",
            "motion-too-small",
        )
    if best in (0, offsets.size - 1):
        _refuse(
            f"the best offset, {offsets[best]:+.2f} s, is at the limit of the search; raise max_offset_s",
            "offset-at-limit",
        )
    is_rival = np.abs(offsets - offsets[best]) > ATTITUDE.rival_distance_s
    rival_gain = 1.0 - float(np.nanmin(np.where(is_rival, misfit, np.inf)))
    if rival_gain > (1.0 - ATTITUDE.rival_gain) * gain:
        rival_offset = float(offsets[np.nanargmin(np.where(is_rival, misfit, np.inf))])
        _refuse(f"{rival_offset:+.2f} s fits nearly as well as {offsets[best]:+.2f} s", "offset-ambiguous")
    poses_at_best = poses(float(offsets[best]))
    ratio = amplitude(
        setting.observed,
        view.motion(poses_at_best).shift,
        view.motion(_without_rotation(poses_at_best)).shift,
        compared,
    )
    if not ATTITUDE.min_amplitude < ratio < 1.0 / ATTITUDE.min_amplitude:
        _refuse(
            f"at the best offset, {offsets[best]:+.2f} s, shifts are {ratio:.2f} of those expected; look "
            "farther, or at signs and units with hyperpaint.geometry.check_conventions",
            "motion-mismatch",
        )
    fitted = fit_clock(setting.observed, poses, view, compared, float(offsets[best]))
    limit = max_uncertainty_s or 0.05
    if not fitted.sd < limit:
        _refuse(
            f"it is {fitted.value:+.3f} +- {fitted.sd:.3f} s, while {limit:g} s is asked for",
            "offset-uncertain",
        )
    evidence = f"attitude explains {100 * gain:.0f} % of the shifts of {int(compared.sum())} parts of rows"
    return ClockOffset(fitted.value, fitted.sd, "attitude", evidence, _curve(offsets, misfit))


def _without_rotation(poses: Floats) -> Floats:
    # Return the poses with every angle replaced by its mean.
    at_rest, has_pose = poses.copy(), np.isfinite(poses[3])
    mean_direction = np.exp(1j * np.radians(poses[3:, has_pose])).mean(axis=1)
    at_rest[3:, has_pose] = np.degrees(np.angle(mean_direction))[:, None]
    return at_rest


def _refuse(reason: str, code: str) -> NoReturn:
    raise TimeError(f"the clocks cannot be compared: {reason}", code=code)


def _curve(offsets: Floats, misfit: Floats) -> xr.DataArray:
    return xr.DataArray(
        misfit,
        dims=("offset",),
        coords={"offset": ("offset", offsets, {"units": "s", "long_name": "Offset of the clock"})},
        attrs={"units": "1", "long_name": "What is left unexplained"},
        name="misfit",
    )


# --- irradiance -----------------------------------------------------------------------------------------


_EPS = 1e-12


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
    is_inside = (wavelength >= LIGHT.wavelengths_nm[0]) & (wavelength <= LIGHT.wavelengths_nm[1])
    channels = np.flatnonzero(is_inside) if is_inside.any() else np.arange(wavelength.size)
    spectra = record["irradiance"].transpose(IRRADIANCE_TIME, IRRADIANCE_WAVELENGTH).values
    level = np.log(np.maximum(np.asarray(spectra[:, channels].mean(axis=1), np.float64), _EPS))
    is_finite = np.isfinite(level)
    samples, level = samples[is_finite], level[is_finite]
    if samples.size < 4:
        _refuse(f"the record has {samples.size} spectra", "record-too-short")
    # the times of lines in order, and the log change of the light from each line to the next
    is_valid = np.isfinite(seconds) & (np.abs(seconds) < 1e9)
    order = np.flatnonzero(is_valid)[np.argsort(seconds[is_valid], kind="stable")]
    seconds, values = seconds[order], picture_of(part, part_image)[order].astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        steps = np.diff(np.log(np.where(values > 0, values, np.nan)), axis=0)
    steps[~np.isfinite(steps).any(axis=1)] = 0.0
    change = np.nanmedian(steps, axis=1)
    width = float(np.median(np.diff(samples))) / LIGHT.bins_an_interval
    edges = np.arange(seconds[0], seconds[-1], max(width, 3.0 * float(np.median(np.diff(seconds)))))
    if edges.size <= LIGHT.min_bins:
        _refuse(
            f"the line lasts {seconds[-1] - seconds[0]:.1f} s, "
            f"expected {LIGHT.min_bins * width:.0f} s for this record",
            "line-too-short",
        )
    observed = np.diff(np.interp(edges, seconds, np.concatenate([[0.0], np.cumsum(change)])))
    offsets = np.linspace(-max_offset_s, max_offset_s, LIGHT.offset_steps + 1)
    expected = np.full((offsets.size, observed.size), np.nan)
    for k, offset in enumerate(offsets):
        stamps = samples + offset
        if edges[0] >= stamps[0] and edges[-1] <= stamps[-1]:
            expected[k] = np.diff(np.interp(edges, stamps, level))
    covered = np.asarray(np.isfinite(expected).all(axis=1))
    if not covered.any():
        _refuse(
            "the irradiance record does not cover the line, whatever the offset; look at dates and zones",
            "record-elsewhere",
        )
    swing = float(np.ptp(np.cumsum(expected[covered], axis=1), axis=1).max())
    if swing < LIGHT.min_change:
        _refuse(
            f"light changes by {100 * swing:.1f} % over the line, at least {100 * LIGHT.min_change:.0f} %",
            "light-constant",
        )
    return _best_offset(offsets, observed, expected, covered, max_uncertainty_s)


def _best_offset(
    offsets: Floats, observed: Floats, expected: Floats, covered: Bools, max_uncertainty_s: float
) -> ClockOffset:
    observed = observed - np.median(observed)
    centred = expected - expected.mean(axis=1, keepdims=True)
    scale = 1.4826 * min(float(np.median(np.abs(observed - m))) for m in centred[covered]) + _EPS
    cost = np.full(expected.shape, np.nan)
    cost[covered] = _clipped_squares(observed - centred[covered], scale)
    misfit, misfit_constant = cost.mean(axis=1), float(_clipped_squares(observed, scale).mean())
    best = int(np.nanargmin(misfit))
    residual = observed - centred[best]
    autocorrelation = float((residual[1:] * residual[:-1]).sum() / max((residual**2).sum(), _EPS))
    count = observed.size * (1.0 - max(autocorrelation, 0.0)) / (1.0 + max(autocorrelation, 0.0))
    odds = 0.5 * count * np.log(misfit / misfit[best])
    gain = 0.5 * count * np.log(misfit_constant / misfit[best])
    if not gain > LIGHT.min_log_odds:
        _refuse(
            f"the brightness of lines does not follow the light (log odds {gain:.1f}, expected "
            f"{LIGHT.min_log_odds:g})",
            "light-mismatch",
        )
    rivals = covered & (odds < 2.0)
    if rivals[0] or rivals[-1] or (rivals[1:-1] & ~(covered[2:] & covered[:-2])).any():
        _refuse(
            f"the best offset, {offsets[best]:+.2f} s, is at the limit of the offsets that the record covers",
            "offset-at-limit",
        )
    offset = _minimum(offsets, misfit)
    blocks = np.array_split(np.arange(observed.size), LIGHT.blocks)
    without = np.array([_minimum(offsets, cost.sum(axis=1) - cost[:, b].sum(axis=1)) for b in blocks])
    jackknife_sd = np.sqrt((LIGHT.blocks - 1) / LIGHT.blocks * ((without - without.mean()) ** 2).sum())
    near_best = offsets[odds < 0.5]  # within one standard deviation, for a parabolic curve
    sd = max(float(jackknife_sd), float(np.ptp(near_best)) / 2.0, float(offsets[1] - offsets[0]) / 2.0)
    distant_rivals = rivals & (
        np.abs(offsets - offsets[best]) > max(LIGHT.rival_sd * sd, LIGHT.rival_distance_s)
    )
    if distant_rivals.any():
        _refuse(
            f"{offsets[distant_rivals][0]:+.2f} s fits nearly as well as {offsets[best]:+.2f} s",
            "offset-ambiguous",
        )
    if sd > max_uncertainty_s:
        _refuse(
            f"it is {offset:+.2f} +- {sd:.2f} s, while {max_uncertainty_s:g} s is asked for",
            "offset-uncertain",
        )
    share = 100.0 * (1.0 - misfit[best] / misfit_constant)
    evidence = f"the light explains {share:.0f} % of the changes of brightness, log odds {gain:.0f}"
    return ClockOffset(offset, sd, "irradiance", evidence, _curve(offsets, np.sqrt(misfit / misfit_constant)))


def _minimum(offsets: Floats, cost: Floats) -> float:
    # Return the minimum of the parabola through the lowest cost and its neighbours.
    best = int(np.nanargmin(cost))
    if not 0 < best < offsets.size - 1 or not np.isfinite(cost[best - 1 : best + 2]).all():
        return float(offsets[best])
    low, middle, high = cost[best - 1 : best + 2]
    fraction = 0.5 * (low - high) / max(float(low + high - 2.0 * middle), _EPS)
    return float(offsets[best] + np.clip(fraction, -1.0, 1.0) * (offsets[1] - offsets[0]))


def _clipped_squares(values: Floats, scale: float) -> Floats:
    # Return squares, limited to those of four standard deviations.
    return np.asarray(np.minimum(values**2, (4.0 * scale) ** 2))
