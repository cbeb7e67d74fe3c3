"""How far the clock of a camera is from that of navigation, or from that of an irradiance spectrometer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import SchemaError, TimeError
from hyperpaint.geometry.georeference import PinholeCamera

from .brightness import light_offset
from .hypotheses import Hypothesis
from .refinement import amplitude, costs_of, fit_clock
from .setting import setting_of

if TYPE_CHECKING:
    import xarray as xr

    from hyperpaint.base.attitude_conventions import Convention

__all__ = ["ClockOffset", "estimate_clock_offset"]


_COARSE = 0.01
"""Step of the first search [s]; platforms turn at some hertz at most."""
_CLEAR = 0.97
"""What is left at the best offset, over what is left where the platform is taken to be at rest."""
_SMALLEST = 0.75
"""What shifts may be of those expected, or these of them, for the two to be the same motion."""
_RIVAL = 0.3
"""Part of that gain that another offset may have."""
_APART = 0.15
"""Distance from which another offset is a rival [s]."""


@dataclass(frozen=True)
class ClockOffset:
    """An estimate of how far two clocks are apart; it is not applied.

    Attributes
    ----------
    offset_s
        From navigation: to be added to the ``time`` of lines to have navigation's, ``clock_offset_s`` of
        `hyperpaint.locate`. From irradiance: to be added to the stamps of the irradiance record to have the
        camera's, ``clock_offset_s`` of a collect's ``[irradiance]`` [s].
    uncertainty_s
        Standard uncertainty [s].
    method
        ``"attitude"`` or ``"irradiance"``.
    evidence
        Why it is believed, in figures.
    curve
        ``misfit`` (offset): what is left unexplained at the offsets tried, over what is left with none of the
        signal at all.
    """

    offset_s: float
    uncertainty_s: float
    method: str
    evidence: str
    curve: xr.DataArray

    def table(self) -> str:
        """Return the estimate as text."""
        return f"{self.method}: {self.offset_s:+.4f} +- {self.uncertainty_s:.4f} s ({self.evidence})"


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
    """Estimate how far the camera's clock is from another; nothing is applied (eager).

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
        How far to look to either side [s].
    max_uncertainty_s
        Uncertainty beyond which nothing is told [s]; by default 0.05 from navigation, 1 from irradiance.
    convention, camera, ground, boresight, lever_arm, crs
        See `hyperpaint.locate`; for navigation alone.
    image, lines
        See `hyperpaint.check_conventions`; for irradiance all lines are looked at by default.

    Returns
    -------
    ClockOffset
        The offset, its uncertainty, the evidence and the curve it is the minimum of.

    Raises
    ------
    TimeError
        It cannot be told: the light is flat, the platform does not move, the picture does not follow, several
        offsets fit alike, or the best is at the end of those tried. The reason is given.
    SchemaError
        Neither or both records; what is needed is missing.
    """
    if (navigation is None) == (irradiance is None):
        raise SchemaError("give navigation= or irradiance=, one of them: they have clocks of their own")
    if not 0.0 < max_offset_s < np.inf:
        raise SchemaError(f"max_offset_s {max_offset_s!r}, expected a time above 0 [s]")
    if irradiance is not None:
        light = light_offset(line, irradiance, image, lines, max_offset_s, max_uncertainty_s or 1.0)
        curve = _curve(light.offsets, light.misfit)
        return ClockOffset(light.offset, light.sd, "irradiance", light.evidence, curve)
    setting = setting_of(
        line,
        navigation,
        convention=convention,
        camera=camera,
        ground=ground,
        boresight=boresight,
        lever_arm=lever_arm,
        image=image,
        lines=lines,
        crs=crs,
    )
    meant = Hypothesis(setting.declared)
    view = meant.view(setting.view)

    def poses(offset: float) -> Floats:
        return meant.poses(setting.recorded, offset)

    steady = np.broadcast_to(setting.steady[:, None], setting.seen.shift.shape)
    used = steady & np.isfinite(setting.seen.shift)
    if not used.any():
        _refuse("no two lines in a row show a motion")
    offsets = np.arange(-max_offset_s, max_offset_s + _COARSE / 2, _COARSE)
    costs = costs_of(setting.seen, poses, view, used, offsets)
    if np.isnan(costs).all():
        _refuse("the record has no poses at the times of the lines; look at dates and zones")
    near = poses(float(offsets[np.nanargmin(costs)]))
    still = float(costs_of(setting.seen, lambda _: _at_rest(near), view, used, np.zeros(1))[0])
    misfit = costs / still
    best = int(np.nanargmin(misfit))
    gain = 1.0 - float(misfit[best])
    if not gain > 1.0 - _CLEAR:
        _refuse(f"attitude explains {100 * max(gain, 0):.1f} % of the shifts; the platform hardly turned")
    if best in (0, offsets.size - 1):
        _refuse(f"the best offset, {offsets[best]:+.2f} s, is the last that was tried; look farther")
    away = np.abs(offsets - offsets[best]) > _APART
    rival = 1.0 - float(np.nanmin(np.where(away, misfit, np.inf)))
    if rival > (1.0 - _RIVAL) * gain:
        other = float(offsets[np.nanargmin(np.where(away, misfit, np.inf))])
        _refuse(f"{other:+.2f} s fits nearly as well as {offsets[best]:+.2f} s")
    there = poses(float(offsets[best]))
    size = amplitude(setting.seen, view.motion(there).shift, view.motion(_at_rest(there)).shift, used)
    if not _SMALLEST < size < 1.0 / _SMALLEST:
        _refuse(
            f"at the best offset, {offsets[best]:+.2f} s, shifts are {size:.2f} of those expected; look "
            "farther, or at signs and units with hyperpaint.check_conventions"
        )
    found = fit_clock(setting.seen, poses, view, used, float(offsets[best]))
    limit = max_uncertainty_s or 0.05
    if not found.sd < limit:
        _refuse(f"it is {found.value:+.3f} +- {found.sd:.3f} s, while {limit:g} s is asked for")
    told = f"attitude explains {100 * gain:.0f} % of the shifts of {int(used.sum())} parts of rows"
    return ClockOffset(found.value, found.sd, "attitude", told, _curve(offsets, misfit))


def _at_rest(poses: Floats) -> Floats:
    """Return poses whose angles are their means."""
    made, known = poses.copy(), np.isfinite(poses[3])
    turned = np.exp(1j * np.radians(poses[3:, known])).mean(axis=1)
    made[3:, known] = np.degrees(np.angle(turned))[:, None]
    return made


def _refuse(reason: str) -> NoReturn:
    raise TimeError(f"the clocks cannot be compared: {reason}")


def _curve(offsets: Floats, misfit: Floats) -> xr.DataArray:
    import xarray as xr

    return xr.DataArray(
        misfit,
        dims=("offset",),
        coords={"offset": ("offset", offsets, {"units": "s", "long_name": "Offset of the clock"})},
        attrs={"units": "1", "long_name": "What is left unexplained"},
        name="misfit",
    )
