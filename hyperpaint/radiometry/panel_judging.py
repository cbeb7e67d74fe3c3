"""Ratio of measured to certified panel reflectance, with checks that the region is the declared panel.

The factor of a panel is the mean of its pixels' reflectance, through the irradiance record, over its known
reflectance. Pixels that do not show a sunlit panel are left out of that mean. Where pixels are saturated, the
mean is the mean of a normal distribution censored at each sample's own limit, after the panel's pattern in
unsaturated bands has been divided out. A tilted panel gets more or less direct light, by the same share in
all bands, which leaves the spectrum of the direct share in its factor. No labels here: arrays of one panel
in, numbers out.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import PaintWarning, SchemaError

#: Faults of a panel, in the order of the bits of ``panel_state``.
PANEL_STATES = ("saturated", "partly_other", "uneven", "leaning", "off_level", "refused")
_SATURATED, _OTHER, _UNEVEN, _LEANING, _OFF_LEVEL, REFUSED = (1 << bit for bit in range(len(PANEL_STATES)))


@dataclass(frozen=True)
class PanelRules:
    """Thresholds above which a region is not the declared panel.

    Attributes
    ----------
    outlier_sd
        Robust standard deviations from the median of the pixels, in brightness or colour, above which a pixel
        shows something else [1]. Of 1000 normal pixels none is beyond 6.
    least_departure
        Departure below which a pixel is kept whatever the spread [1]: one in twenty of them moves the mean by
        a thousandth.
    noticed_share
        Share of pixels that are saturated, or show something else, from which it is reported [1].
    most_saturated
        Share of saturated pixels up to which a band has a mean [1]: beyond a half, the visible part of the
        distribution does not contain its middle.
    least_used
        Share of pixels that must be panel [1]: with fewer, the median may belong to something else.
    most_error
        Standard error of the mean of the pixels above which they are uneven [1].
    refused_error
        The same, above which the panel is refused unless its declared uncertainty covers it [1]: half of a
        panel in a shade of 40 % has 0.025.
    least_lean
        Change of the light by a panel's attitude from which it is reported [1].
    lean_significance
        Least change in units of its standard error [1].
    lean_misfit
        Residuals of the factor, relative to the spread that the change gives it, up to which attitude
        explains its shape [1].
    least_contrast
        Least difference of the direct share between bands at which attitude leaves a shape [1].
    gain_u, irradiance_u
        Relative standard uncertainties where the line states none [1]: of a lamp calibration a year old, and
        of a calibrated field spectrometer with a cosine receptor.
    coverage
        Standard uncertainties that a factor may be from 1 [1].
    off_bands
        Share of bands beyond that, from which it is reported [1].
    repeatability
        Relative standard uncertainty of a panel that is laid out again [1]: half a degree from level changes
        direct light by 0.5 % with the sun at 30 degrees.
    """

    outlier_sd: float = 6.0
    least_departure: float = 0.02
    noticed_share: float = 0.01
    most_saturated: float = 0.5
    least_used: float = 0.5
    most_error: float = 0.01
    refused_error: float = 0.02
    least_lean: float = 0.01
    lean_significance: float = 5.0
    lean_misfit: float = 0.3
    least_contrast: float = 0.08
    gain_u: float = 0.03
    irradiance_u: float = 0.05
    coverage: float = 2.0
    off_bands: float = 0.1
    repeatability: float = 0.005


RULES = PanelRules()


class PanelContext(NamedTuple):
    """Properties of the line that all its panels are judged with."""

    wavelength: Floats  # (band,) [nm]
    good: NDArray[np.bool_]  # (band,)
    u: Floats  # (band,) relative standard uncertainty of gain and irradiance together [1]
    has_scale: bool  # Whether the gain is absolute


class PanelClosure(NamedTuple):
    """Results of several panels, stacked: (panel, band), except ``state`` and ``time`` (panel,)."""

    scale: Floats  # Expected over measured, by which reflectance is multiplied [1]
    factor: Floats  # Measured over expected [1]
    u: Floats  # Combined standard uncertainty of the factor [1]
    mean_u: Floats  # Relative standard uncertainty of the panel's mean alone [1]
    used: Floats  # Share of pixels used [1]
    state: NDArray[np.uint8]
    time: NDArray[np.datetime64]
    reasons: tuple[str, ...]  # Why a panel is refused; empty where it is not

    def at(self, places: NDArray[np.int64]) -> PanelClosure:
        """Return the results of some panels."""
        reasons = tuple(self.reasons[place] for place in places)
        scale, factor, u, mean_u, used = (values[places] for values in self[:5])
        return PanelClosure(scale, factor, u, mean_u, used, self.state[places], self.time[places], reasons)


class _Part(NamedTuple):
    # One panel's row of a `PanelClosure`, with its warnings
    scale: Floats
    factor: Floats
    u: Floats
    mean_u: Floats
    used: Floats
    state: int
    notes: tuple[str, ...]
    reason: str


def judge_panels(panels: tuple[Mapping[str, Any], ...], context: PanelContext) -> PanelClosure:
    """Return the ratio of measured to expected reflectance of panels.

    Each has ``observed`` and ``ceiling`` (line, band, column), the reflectance through irradiance and the
    reflectance from which samples are saturated, or None; ``reflectance`` (band,), ``uncertainty``, ``name``,
    ``time`` and ``direct_share`` (sky, band), the relative change of its light with direct light under some
    skies, or None.

    Warns PaintWarning: A panel shows a fault; one warning a panel.
    """
    parts = []
    for panel in panels:
        part = _judge(panel, context)
        if part.notes:
            warnings.warn(
                PaintWarning(f"{panel['name']}: {'; '.join(part.notes)}", code="panel-doubtful"), stacklevel=2
            )
        parts.append(part)
    return PanelClosure(
        np.array([part.scale for part in parts]),
        np.array([part.factor for part in parts]),
        np.array([part.u for part in parts]),
        np.array([part.mean_u for part in parts]),
        np.array([part.used for part in parts]),
        np.array([part.state for part in parts], np.uint8),
        np.array([panel["time"] for panel in panels], "datetime64[ns]"),
        tuple(part.reason for part in parts),
    )


def _judge(panel: Mapping[str, Any], context: PanelContext) -> _Part:
    observed = np.asarray(panel["observed"], np.float64)
    expected = np.asarray(panel["reflectance"], np.float64)
    valid = np.isfinite(observed)
    if not valid.any():
        raise SchemaError(
            f"{panel['name']}'s region holds no valid pixel",
            mend="outline a part that is neither saturated nor in a gap",
            code="panel-empty",
        )
    ceiling = panel["ceiling"]
    if ceiling is None:  # radiance has no saturation limit: use the brightest sample
        top = np.where(valid, observed, -np.inf).max(axis=(0, 2))
        ceiling = np.broadcast_to(top[None, :, None], observed.shape)
    ceiling = np.asarray(ceiling, np.float64)
    saturated = ~valid & np.isfinite(ceiling)
    notes: list[str] = []
    reasons: list[str] = []
    state = 0
    # pixels that show something else, by brightness and colour in unsaturated bands
    clean = ~saturated.any(axis=(0, 2)) & valid.any(axis=(0, 2))
    clean &= context.good & (np.nan_to_num(expected) > 0.0)
    brightness, foreign = _pixels(observed, clean)
    foreign_share = float(foreign.mean())
    if foreign_share >= RULES.noticed_share:
        state |= _OTHER
        notes.append(
            f"{100 * foreign_share:.1f} % of its pixels are shaded or show something else, and are left out"
        )
        if 1.0 - foreign_share < RULES.least_used:
            reasons.append("more than half of its region shows something else")
        # outliers spill some light over their eight neighbours
        from scipy.ndimage import binary_dilation

        wider = np.asarray(binary_dilation(foreign, np.ones((3, 3), bool)))
        foreign = wider if 1.0 - wider.mean() >= RULES.least_used else foreign
    # mean of the others, with saturated samples
    on_panel = ~foreign[:, None, :]
    number, total, error, full = _means(
        observed, ceiling, saturated, on_panel, brightness if clean.sum() >= 3 else None
    )
    lit = on_panel & context.good[:, None]
    saturated_share = float((saturated & lit).any(axis=1).sum() / max(on_panel[:, 0].sum(), 1))
    if saturated_share >= RULES.noticed_share:
        state |= _SATURATED
        lost = np.isnan(total) & (full > 0)
        loss = f", and {lost.sum()} bands are refused" if lost.any() else ""
        notes.append(
            f"{100 * saturated_share:.0f} % of its pixels are saturated, in {(full > 0).sum()} bands{loss}"
        )
        if lost[context.good].all():
            reasons.append("more than half of its pixels are saturated in every band")
    with np.errstate(invalid="ignore", divide="ignore"):
        scale = expected * number / total
        factor, mean_u = 1.0 / scale, error * number / total
    # uneven pixels
    errors = mean_u[context.good & np.isfinite(mean_u)]
    if errors.size and np.median(errors) > RULES.most_error:
        state |= _UNEVEN
        text = f"its pixels are uneven: their mean has a standard error of {100 * np.median(errors):.1f} %"
        notes.append(text)
        if np.median(errors) > max(RULES.refused_error, RULES.coverage * panel["uncertainty"]):
            reasons.append(f"{text}; part of it may be shaded")
    # a tilt, and a factor far from 1
    u = factor * np.sqrt(context.u**2 + panel["uncertainty"] ** 2 + mean_u**2)
    change, level = _change_by_attitude(factor, panel["direct_share"], context)
    if change:
        state |= _LEANING
        notes.append(
            f"its factor has the spectrum of a tilted panel, {100 * change:+.1f} % of light by the sun"
        )
        closes = not context.has_scale or abs(level - 1.0) <= RULES.coverage * np.nanmedian(u)
        if closes and abs(change) > max(RULES.least_lean, RULES.coverage * panel["uncertainty"]):
            reasons.append(
                f"it is tilted, or in a shadow or reflections: {100 * change:+.1f} % of light by the sun"
            )
    with np.errstate(invalid="ignore"):
        off = (np.abs(factor - 1.0) > RULES.coverage * u)[context.good & np.isfinite(factor)]
    if context.has_scale and off.size and off.mean() >= RULES.off_bands:
        state |= _OFF_LEVEL
        low, middle, high = np.nanquantile(factor[context.good], [0.0, 0.5, 1.0])
        notes.append(
            f"it measures {low:.3f} to {high:.3f} (median {middle:.3f}) of the reflectance expected from "
            f"irradiance, with a combined standard uncertainty of {np.nanmedian(u):.3f}"
        )
    state |= REFUSED if reasons else 0
    used = 1.0 - (foreign[:, None, :] | ~valid).mean(axis=(0, 2))
    return _Part(scale, factor, u, mean_u, used, state, tuple(notes), "; ".join(reasons))


def _pixels(observed: Floats, clean: NDArray[np.bool_]) -> tuple[Floats, NDArray[np.bool_]]:
    # Relative brightness of pixels (line, column), and whether each shows something else.
    # From the `clean` bands, or from all where there are few; NaN and false where a pixel has no such sample.
    cube = np.moveaxis(observed, 1, 2)[..., clean if clean.sum() >= 3 else np.isfinite(observed).any((0, 2))]
    valid = np.isfinite(cube)
    spectrum = np.nanmedian(cube.reshape(-1, cube.shape[-1]), axis=0)

    def level(bands: Any) -> Floats:
        weight = np.where(valid[..., bands], spectrum[bands], 0.0).sum(axis=-1)
        light = np.where(valid[..., bands], cube[..., bands], 0.0).sum(axis=-1)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(light / weight)

    brightness = level(slice(None))
    parts = [part for part in np.array_split(np.arange(spectrum.size), min(4, spectrum.size)) if part.size]
    foreign = _outlying(brightness)
    for part in parts:
        foreign |= _outlying(level(part) / brightness)
    return brightness, foreign


def _outlying(values: Floats) -> NDArray[np.bool_]:
    finite = values[np.isfinite(values)]
    if finite.size < 3:
        return np.zeros(values.shape, bool)
    middle = np.median(finite)
    # the median deviation of few values may be small by chance
    spread = 1.4826 * np.median(np.abs(finite - middle)) * (1.0 + 5.0 / finite.size)
    limit = max(RULES.outlier_sd * spread, RULES.least_departure * abs(middle))
    return np.asarray(np.nan_to_num(np.abs(values - middle)) > limit)


def _means(
    observed: Floats,
    ceiling: Floats,
    saturated: NDArray[np.bool_],
    on_panel: NDArray[np.bool_],
    brightness: Floats | None,
) -> tuple[Floats, Floats, Floats, Floats]:
    # Number and sum of a panel's pixels, the mean's error, and the saturated share (band,).
    # `on_panel` (line, 1, column): whether pixels belong to the panel; `brightness` (line, column): its
    # pattern from unsaturated bands, or None.
    valid = np.isfinite(observed) & on_panel
    number = valid.sum(axis=(0, 2))
    counted = number + (saturated & on_panel).sum(axis=(0, 2))
    with np.errstate(invalid="ignore", divide="ignore"):
        full = np.where(counted > 0, 1.0 - number / np.maximum(counted, 1), 0.0)
        total = np.where(valid, observed, 0.0).sum(axis=(0, 2))
        mean = total / number
        squares = (np.where(valid, observed - mean[None, :, None], 0.0) ** 2).sum(axis=(0, 2))
        error = np.sqrt(squares / np.maximum(number - 1, 1) / number)
    # bands with some saturated samples: mean of a censored normal distribution
    total[full > RULES.most_saturated] = np.nan
    cut = np.flatnonzero((full > 0.0) & (full <= RULES.most_saturated))
    if not cut.size:
        return number, total, error, full
    pattern = np.ones(observed[:, 0].shape)
    if brightness is not None:
        pattern = brightness / float(np.nanmean(brightness[on_panel[:, 0, :]]))
    pixels = on_panel[:, 0, :] & np.isfinite(pattern)
    weight = pattern[pixels][:, None]
    limits = np.moveaxis(np.where(saturated, ceiling, np.nan)[:, cut], 1, 2)[pixels] / weight
    mean[cut], spread = _censored_mean(np.moveaxis(observed[:, cut], 1, 2)[pixels] / weight, limits)
    total[cut] = mean[cut] * number[cut]
    error[cut] = spread / np.sqrt(number[cut])
    return number, total, error, full


def _censored_mean(values: Floats, limits: Floats) -> tuple[Floats, Floats]:
    # Mean and standard deviation of normal samples (pixel, band), some censored at their limits.
    # By expectation and maximisation. Censored samples have NaN in `values` and a number in `limits`, others
    # NaN in `limits`; a sample with NaN in both is missing.
    from scipy.special import log_ndtr

    beyond = np.isfinite(limits)
    present = np.isfinite(values) | beyond
    measured, number = np.where(np.isfinite(values), values, 0.0), present.sum(axis=0)
    mean, spread = np.nanmean(values, axis=0), np.nanstd(values, axis=0)
    least = 1e-6 * np.abs(mean)
    for _ in range(300):
        spread = np.maximum(spread, least)
        z = np.where(beyond, (limits - mean) / spread, 0.0)
        # phi(z) / Q(z), without underflow
        hazard = np.exp(-0.5 * z**2 - 0.5 * np.log(2.0 * np.pi) - log_ndtr(-z))
        guess = np.where(beyond, mean + spread * hazard, measured)
        variance = np.where(beyond, spread**2 * np.maximum(1.0 + z * hazard - hazard**2, 0.0), 0.0)
        before, mean = mean, np.where(present, guess, 0.0).sum(axis=0) / number
        spread = np.sqrt(np.where(present, (guess - mean) ** 2 + variance, 0.0).sum(axis=0) / number)
        if (np.abs(mean - before) <= 1e-7 * np.abs(mean)).all():
            break
    return mean, spread


def _change_by_attitude(
    factor: Floats, direct_share: Floats | None, context: PanelContext
) -> tuple[float, float]:
    """Return the relative change of a panel's light by its attitude, 0 without, and its level [1].

    .. math:: F = k (1 + a w)

    fitted to medians of neighbouring bands, with :math:`w` the direct share of the sky that fits best.
    """
    best = None
    for direct in () if direct_share is None else direct_share:
        usable = context.good & np.isfinite(factor) & np.isfinite(direct)
        places = np.flatnonzero(usable)[np.argsort(context.wavelength[usable], kind="stable")]
        if places.size < 5 or np.ptp(direct[places]) < RULES.least_contrast:
            continue
        groups = np.array_split(places, min(16, places.size))
        design, shape = (
            np.array([np.median(spectrum[group]) for group in groups]) for spectrum in (direct, factor)
        )
        fit = _Line.through(design, shape)
        best = fit if best is None or fit.residual < best.residual else best
    if best is None:
        return 0.0, 1.0
    change = best.slope / best.level * best.middle
    is_lean = (
        abs(change) >= RULES.least_lean
        and abs(best.slope) >= RULES.lean_significance * best.slope_u
        and best.residual <= RULES.lean_misfit * abs(best.slope) * best.spread
    )
    return (change if is_lean else 0.0), best.level


class _Line(NamedTuple):
    level: float
    slope: float
    slope_u: float
    residual: float  # Standard deviation of the residuals
    middle: float  # Median and standard deviation of the places
    spread: float

    @classmethod
    def through(cls, places: Floats, values: Floats) -> _Line:
        spread = float(places.std())
        slope = float(np.mean((places - places.mean()) * (values - values.mean()))) / spread**2
        level = float(values.mean() - slope * places.mean())
        residual = float(np.sqrt(((values - level - slope * places) ** 2).sum() / (places.size - 2)))
        slope_u = residual / (spread * float(np.sqrt(places.size)))
        return cls(level, slope, slope_u, residual, float(np.median(places)), spread)
