"""Ratio of measured to certified panel reflectance, with checks that the region is the declared panel.

The factor of a panel is the mean reflectance of its pixels, from the irradiance record, over its certified
reflectance. Pixels that do not show a sunlit panel are left out. Where pixels are saturated, the
mean is estimated from a normal distribution censored at the limits of the samples, after the panel's pattern
in unsaturated bands has been divided out. A tilted panel gets more or less direct light, by the same share in
all bands, which adds the spectrum of the direct share to its factor. No labels here: arrays of a panel in,
numbers out.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from hyperpaint.base.errors import SchemaError, warn_user
from hyperpaint.base.schema import Array, Bools, Floats, Ints, Times

#: Faults of a panel, in the order of the bits of ``panel_state``.
PANEL_STATES = ("saturated", "partly_other", "uneven", "leaning", "off_level", "refused")
_SATURATED, _PARTLY_OTHER, _UNEVEN, _LEANING, _OFF_LEVEL, REFUSED = (
    1 << bit for bit in range(len(PANEL_STATES))
)


@dataclass(frozen=True)
class PanelRules:
    """Thresholds above which a region is not the declared panel.

    Attributes
    ----------
    outlier_sd
        Robust standard deviations from the median of the pixels, in brightness or colour, above which a pixel
        does not show the panel [1]. None of 1000 normal pixels is beyond 6.
    least_departure
        Departure below which a pixel is always kept [1]: one in twenty such pixels changes the mean by
        a thousandth.
    noticed_share
        Share of saturated pixels, or of pixels that do not show the panel, above which it is reported [1].
    most_saturated
        Share of saturated pixels up to which a band has a mean [1]: above a half, the unsaturated part of the
        distribution does not contain its median.
    least_used
        Minimum share of pixels that show the panel [1]: with fewer, the median may belong to another surface.
    most_error
        Standard error of the mean of the pixels above which they are uneven [1].
    refused_error
        Standard error above which the panel is refused unless its declared uncertainty covers it [1]: half of
        a panel in a shade of 40 % has 0.025.
    least_lean
        Change of the light by a panel's attitude above which it is reported [1].
    lean_significance
        Minimum change in units of its standard error [1].
    lean_misfit
        Residuals of the factor, relative to the spread by the change, up to which attitude
        explains its shape [1].
    least_contrast
        Minimum difference of the direct share between bands for a detectable change by attitude [1].
    gain_u, irradiance_u
        Relative standard uncertainties if the line has none [1]: of a lamp calibration a year old, and
        of a calibrated field spectrometer with a cosine receptor.
    coverage
        Accepted distance of a factor from 1 in standard uncertainties [1].
    most_factor
        Factor of a panel, or its inverse, above which it is refused [1]: the certificate is of another panel
        or unit, or the scale of the line is wrong; stained and aged panels have 0.8 and more.
    off_bands
        Share of bands beyond ``coverage`` above which it is reported [1].
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
    most_factor: float = 2.0
    off_bands: float = 0.1
    repeatability: float = 0.005


RULES = PanelRules()


class PanelContext(NamedTuple):
    # Properties of the line for the judgement of its panels.
    wavelength: Floats  # (band,) [nm]
    good: Bools  # (band,)
    u: Floats  # (band,) relative standard uncertainty of gain and irradiance together [1]
    has_scale: bool  # Whether the gain is absolute


class PanelClosure(NamedTuple):
    # Results of panels, stacked: (panel, band), except ``state`` and ``time`` (panel,).
    scale: Floats  # Expected over measured, by which reflectance is multiplied [1]
    factor: Floats  # Measured over expected [1]
    u: Floats  # Combined standard uncertainty of the factor [1]
    mean_u: Floats  # Relative standard uncertainty of the mean over pixels [1]
    used: Floats  # Share of pixels used [1]
    state: Array
    time: Times
    reasons: tuple[str, ...]  # Reason of the refusal of a panel; empty if not refused

    def at(self, indices: Ints) -> PanelClosure:
        # Return the results of the panels at indices.
        arrays: list[Any] = [*self[:-1]]
        reasons = tuple(self.reasons[k] for k in indices)
        return PanelClosure._make([*(values[indices] for values in arrays), reasons])


def judge_panels(panels: tuple[Mapping[str, Any], ...], context: PanelContext) -> PanelClosure:
    # Return the ratio of measured to expected reflectance of panels.
    #
    # Each has ``observed`` and ``ceiling`` (line, band, column), the reflectance through irradiance and the
    # reflectance from which samples are saturated, or None; ``reflectance`` (band,), ``uncertainty``,
    # ``name``, ``time`` and ``direct_share`` (sky, band), the relative change of its light with direct light
    # under some skies, or None.
    #
    # Warns PaintWarning: A panel shows a fault; one warning a panel.
    rows = []
    for panel in panels:
        notes, *row = _judge(panel, context)
        if notes:
            warn_user(f"{panel['name']}: {'; '.join(notes)}", "panel-doubtful")
        rows.append(row)
    *spectra, states, reasons = zip(*rows, strict=True)
    time = np.array([panel["time"] for panel in panels], "datetime64[ns]")
    return PanelClosure._make([*map(np.array, spectra), np.array(states, np.uint8), time, reasons])


def _judge(panel: Mapping[str, Any], context: PanelContext) -> tuple[Any, ...]:
    # Return the texts of a warning, and the row of a `PanelClosure`, without the time.
    observed = np.asarray(panel["observed"], np.float64)
    expected = np.asarray(panel["reflectance"], np.float64)
    is_valid = np.isfinite(observed)
    if not is_valid.any():
        raise SchemaError(
            f"{panel['name']}'s region contains no valid pixel",
            mend="outline a part that is neither saturated nor in a gap",
            code="panel-empty",
        )
    ceiling = panel["ceiling"]
    if ceiling is None:  # radiance has no saturation limit: use the brightest sample
        brightest = np.where(is_valid, observed, -np.inf).max(axis=(0, 2))
        ceiling = np.broadcast_to(brightest[None, :, None], observed.shape)
    ceiling = np.asarray(ceiling, np.float64)
    is_saturated = ~is_valid & np.isfinite(ceiling)
    notes: list[str] = []
    reasons: list[str] = []
    state = 0
    # pixels that do not show the panel, by brightness and colour in unsaturated bands
    is_unsaturated = ~is_saturated.any(axis=(0, 2)) & is_valid.any(axis=(0, 2))
    is_unsaturated &= context.good & (np.nan_to_num(expected) > 0.0)
    brightness, is_foreign = _brightness_and_outliers(observed, is_unsaturated)
    foreign_share = float(is_foreign.mean())
    if foreign_share >= RULES.noticed_share:
        state |= _PARTLY_OTHER
        notes.append(
            f"{100 * foreign_share:.1f} % of its pixels are shaded or show something else, and are left out"
        )
        if 1.0 - foreign_share < RULES.least_used:
            reasons.append("more than half of its region shows something else")
        # light of outliers spreads to their eight neighbours
        from scipy.ndimage import binary_dilation

        dilated = np.asarray(binary_dilation(is_foreign, np.ones((3, 3), bool)))
        is_foreign = dilated if 1.0 - dilated.mean() >= RULES.least_used else is_foreign
    # mean of the panel's pixels, with saturated samples
    is_on_panel = ~is_foreign[:, None, :]
    number, total, error, saturated_share_of_band = _panel_means(
        observed, ceiling, is_saturated, is_on_panel, brightness if is_unsaturated.sum() >= 3 else None
    )
    is_panel_and_good = is_on_panel & context.good[:, None]
    saturated_share = float(
        (is_saturated & is_panel_and_good).any(axis=1).sum() / max(is_on_panel[:, 0].sum(), 1)
    )
    if saturated_share >= RULES.noticed_share:
        state |= _SATURATED
        is_refused = np.isnan(total) & (saturated_share_of_band > 0)
        refused_text = f", and {is_refused.sum()} bands are refused" if is_refused.any() else ""
        notes.append(
            f"{100 * saturated_share:.0f} % of its pixels are saturated, in "
            f"{(saturated_share_of_band > 0).sum()} bands{refused_text}"
        )
        if is_refused[context.good].all():
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
        agrees_with_irradiance = not context.has_scale or abs(level - 1.0) <= RULES.coverage * np.nanmedian(u)
        if agrees_with_irradiance and abs(change) > max(
            RULES.least_lean, RULES.coverage * panel["uncertainty"]
        ):
            reasons.append(
                f"it is tilted, or in a shadow or reflections: {100 * change:+.1f} % of light by the sun"
            )
    with np.errstate(invalid="ignore"):
        is_deviating = (np.abs(factor - 1.0) > RULES.coverage * u)[context.good & np.isfinite(factor)]
    if context.has_scale and is_deviating.size and is_deviating.mean() >= RULES.off_bands:
        state |= _OFF_LEVEL
        low, median, high = np.nanquantile(factor[context.good], [0.0, 0.5, 1.0])
        notes.append(
            f"it measures {low:.3f} to {high:.3f} (median {median:.3f}) of the reflectance expected from "
            f"irradiance, with a combined standard uncertainty of {np.nanmedian(u):.3f}"
        )
        if not 1.0 / RULES.most_factor <= median <= RULES.most_factor:
            reasons.append(
                f"it measures {median:.3g} times its certificate, which is of another panel or unit"
            )
    state |= REFUSED if reasons else 0
    share_used = 1.0 - (is_foreign[:, None, :] | ~is_valid).mean(axis=(0, 2))
    return notes, scale, factor, u, mean_u, share_used, state, "; ".join(reasons)


def _brightness_and_outliers(observed: Floats, clean: Bools) -> tuple[Floats, Bools]:
    # Return the relative brightness of pixels (line, column), and which pixels do not show the panel,
    # from the `clean` bands, or from all bands if these are few; NaN and false for pixels without such
    # samples.
    cube = np.moveaxis(observed, 1, 2)[..., clean if clean.sum() >= 3 else np.isfinite(observed).any((0, 2))]
    is_valid = np.isfinite(cube)
    spectrum = np.nanmedian(cube.reshape(-1, cube.shape[-1]), axis=0)

    def level(bands: Any) -> Floats:
        weight = np.where(is_valid[..., bands], spectrum[bands], 0.0).sum(axis=-1)
        light = np.where(is_valid[..., bands], cube[..., bands], 0.0).sum(axis=-1)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(light / weight)

    brightness = level(slice(None))
    parts = [part for part in np.array_split(np.arange(spectrum.size), min(4, spectrum.size)) if part.size]
    is_foreign = _is_outlier(brightness)
    for part in parts:
        is_foreign |= _is_outlier(level(part) / brightness)
    return brightness, is_foreign


def _is_outlier(values: Floats) -> Bools:
    finite = values[np.isfinite(values)]
    if finite.size < 3:
        return np.zeros(values.shape, bool)
    median = np.median(finite)
    # with few values the median deviation may be small by chance
    spread = 1.4826 * np.median(np.abs(finite - median)) * (1.0 + 5.0 / finite.size)
    limit = max(RULES.outlier_sd * spread, RULES.least_departure * abs(median))
    return np.asarray(np.nan_to_num(np.abs(values - median)) > limit)


def _panel_means(
    observed: Floats,
    ceiling: Floats,
    saturated: Bools,
    on_panel: Bools,
    brightness: Floats | None,
) -> tuple[Floats, Floats, Floats, Floats]:
    # Return number and sum of a panel's pixels, the error of the mean, and the saturated share (band,).
    # `on_panel` (line, 1, column): whether pixels belong to the panel; `brightness` (line, column): its
    # pattern from unsaturated bands, or None.
    is_valid = np.isfinite(observed) & on_panel
    number = is_valid.sum(axis=(0, 2))
    n_all = number + (saturated & on_panel).sum(axis=(0, 2))
    with np.errstate(invalid="ignore", divide="ignore"):
        saturated_share = np.where(n_all > 0, 1.0 - number / np.maximum(n_all, 1), 0.0)
        total = np.where(is_valid, observed, 0.0).sum(axis=(0, 2))
        mean = total / number
        squares = (np.where(is_valid, observed - mean[None, :, None], 0.0) ** 2).sum(axis=(0, 2))
        error = np.sqrt(squares / np.maximum(number - 1, 1) / number)
    # bands with some saturated samples: mean of a censored normal distribution
    total[saturated_share > RULES.most_saturated] = np.nan
    partly_saturated = np.flatnonzero((saturated_share > 0.0) & (saturated_share <= RULES.most_saturated))
    if not partly_saturated.size:
        return number, total, error, saturated_share
    pattern = np.ones(observed[:, 0].shape)
    if brightness is not None:
        pattern = brightness / float(np.nanmean(brightness[on_panel[:, 0, :]]))
    pixels = on_panel[:, 0, :] & np.isfinite(pattern)
    weight = pattern[pixels][:, None]
    limits = np.moveaxis(np.where(saturated, ceiling, np.nan)[:, partly_saturated], 1, 2)[pixels] / weight
    mean[partly_saturated], spread = _censored_mean(
        np.moveaxis(observed[:, partly_saturated], 1, 2)[pixels] / weight, limits
    )
    total[partly_saturated] = mean[partly_saturated] * number[partly_saturated]
    error[partly_saturated] = spread / np.sqrt(number[partly_saturated])
    return number, total, error, saturated_share


def _censored_mean(values: Floats, limits: Floats) -> tuple[Floats, Floats]:
    # Return mean and standard deviation of normal samples (pixel, band), some of them censored at limits,
    # by expectation and maximisation. Censored samples have NaN in `values` and a number in `limits`,
    # measured ones NaN in `limits`; a sample with NaN in both is missing.
    from scipy.special import log_ndtr

    is_censored = np.isfinite(limits)
    is_present = np.isfinite(values) | is_censored
    measured, number = np.where(np.isfinite(values), values, 0.0), is_present.sum(axis=0)
    mean, spread = np.nanmean(values, axis=0), np.nanstd(values, axis=0)
    min_spread = 1e-6 * np.abs(mean)
    for _ in range(300):
        spread = np.maximum(spread, min_spread)
        z = np.where(is_censored, (limits - mean) / spread, 0.0)
        # phi(z) / Q(z), without underflow
        hazard = np.exp(-0.5 * z**2 - 0.5 * np.log(2.0 * np.pi) - log_ndtr(-z))
        expected = np.where(is_censored, mean + spread * hazard, measured)
        variance = np.where(is_censored, spread**2 * np.maximum(1.0 + z * hazard - hazard**2, 0.0), 0.0)
        previous, mean = mean, np.where(is_present, expected, 0.0).sum(axis=0) / number
        spread = np.sqrt(np.where(is_present, (expected - mean) ** 2 + variance, 0.0).sum(axis=0) / number)
        if (np.abs(mean - previous) <= 1e-7 * np.abs(mean)).all():
            break
    return mean, spread


def _change_by_attitude(
    factor: Floats, direct_share: Floats | None, context: PanelContext
) -> tuple[float, float]:
    """Return the relative change of a panel's light by its attitude, 0 if insignificant, and its level [1].

    .. math:: F = k (1 + a w)

    fitted to medians of neighbouring bands, with :math:`w` the direct share of the sky that fits best.
    """
    best_residual, change, level = np.inf, 0.0, 1.0
    for direct in () if direct_share is None else direct_share:
        is_usable = context.good & np.isfinite(factor) & np.isfinite(direct)
        bands = np.flatnonzero(is_usable)[np.argsort(context.wavelength[is_usable], kind="stable")]
        if bands.size < 5 or np.ptp(direct[bands]) < RULES.least_contrast:
            continue
        groups = np.array_split(bands, min(16, bands.size))
        x, y = (np.array([np.median(spectrum[group]) for group in groups]) for spectrum in (direct, factor))
        # straight line, with the standard deviation of its residuals
        spread = float(x.std())
        slope = float(np.mean((x - x.mean()) * (y - y.mean()))) / spread**2
        intercept = float(y.mean() - slope * x.mean())
        residual = float(np.sqrt(((y - intercept - slope * x) ** 2).sum() / (x.size - 2)))
        if residual < best_residual:
            best_residual, level = residual, intercept
            change = slope / level * float(np.median(x))
            slope_u = residual / (spread * float(np.sqrt(x.size)))
            is_lean = (
                abs(change) >= RULES.least_lean
                and abs(slope) >= RULES.lean_significance * slope_u
                and residual <= RULES.lean_misfit * abs(slope) * spread
            )
            change = change if is_lean else 0.0
    return change, level
