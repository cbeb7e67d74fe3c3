"""Targets of known reflectance in the scene, declared and measured.

Ratio of measured to certified panel reflectance, with checks that the region is the declared panel.

The factor of a panel is the mean reflectance of its pixels, from the irradiance record, over its certified
reflectance. Pixels that do not show a sunlit panel are left out. Where pixels are saturated, the
mean is estimated from a normal distribution censored at the limits of the samples, after the panel's pattern
in unsaturated bands has been divided out. A tilted panel gets more or less direct light, by the same share in
all bands, which adds the spectrum of the direct share to its factor. No labels here: arrays of a panel in,
numbers out.
"""

import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, NamedTuple

import dask
import dask.array as da
import numpy as np
import xarray as xr

from hyperpaint.base import (
    ALONG_TRACK,
    BAND,
    CROSS_TRACK,
    PANEL,
    PANEL_SURFACES,
    SATURATION_MARGIN_COUNTS,
    VARIABLES,
    Array,
    ArrayLike,
    Bools,
    Floats,
    Problems,
    SchemaError,
    convert,
    is_plain_file,
    label,
    require,
    takes_quantities,
    warn_if,
    warn_user,
)
from hyperpaint.io.spectrometers.spectrum_csv import PANEL_DIRECTIONS, read_panel_table

from . import slabs
from .slabs import PanelClosure

# --- reflectance factor of white panels by the directions of light and view, over their certificate ---------
#
# Angles and wavelengths come in, factors and their uncertainties go out. For panels of a scene, white tiles
# and the panels of field spectrometers.


LAMBERTIAN, SINTERED_PTFE = PANEL_SURFACES

#: Terms of sintered PTFE: coefficient, order in the azimuth, powers of 1 - cos of both zenith angles.
_TERMS = (
    (1.0717, 0, 0, 0), (-0.4129, 0, 0, 1), (0.1772, 0, 0, 2), (-0.5248, 0, 0, 4),
    (0.5600, 0, 1, 1), (-0.2996, 1, 0, 1), (0.0664, 2, 0, 0),
)  # fmt: skip
#: Largest zenith angles of the terms [degree].
_LIMITS = {"sun_zenith": 75.0, "view_zenith": 45.0}
#: Relative standard uncertainty of a plate, and its part of the distance of the factor from 1 [1]: two plates
#: of different makers and laboratories differ by up to twice this.
_LEAST_U, _SPREAD_U = 0.01, 0.3
#: Smallest certified reflectance of white sintered PTFE [1]; darker plates have other factors.
_LEAST_WHITE = 0.9


class PanelFactor(NamedTuple):
    """Reflectance factor of a panel over its certificate.

    Attributes
    ----------
    factor
        Factor (wavelength,) [1].
    u
        Its relative standard uncertainty (wavelength,) [1], without that of the certificate.
    """

    factor: Floats
    u: Floats


def is_lambertian(surface: Any) -> bool:
    # Whether a panel reflects its certificate in all directions.
    return isinstance(surface, str) and surface == LAMBERTIAN


def check_surface(surface: Any, reflectance: Any = 1.0) -> None:
    # Raise `SchemaError` for a surface that is unknown, or is not that of a panel of ``reflectance`` [1].
    is_table = hasattr(surface, "coords") or (
        isinstance(surface, str | os.PathLike) and is_plain_file(surface)
    )
    SchemaError.raise_if(
        not is_table and surface not in PANEL_SURFACES,
        f"surface={surface!r:.80}",
        expected=f"{', '.join(PANEL_SURFACES)}, or a table of factors, or its file",
        mend="see hyperpaint.io.read_panel_table",
        code="panel-surface-unknown",
    )
    level = float(np.nanmedian(reflectance))
    SchemaError.raise_if(
        not is_table and surface == SINTERED_PTFE and level < _LEAST_WHITE,
        f"a panel of reflectance {level:g} with the surface of white sintered PTFE",
        expected=f"{_LEAST_WHITE:g} and more",
        mend="pass a table of the factors of this grey panel, see hyperpaint.io.read_panel_table",
        code="panel-surface-grey",
    )


@takes_quantities(wavelength="nm", sun_zenith="degree", view_zenith="degree", relative_azimuth="degree")
def panel_factor(
    wavelength: ArrayLike,
    sun_zenith: float,
    view_zenith: float = 0.0,
    relative_azimuth: float = 90.0,
    *,
    surface: Any = SINTERED_PTFE,
    direct_share: ArrayLike = 1.0,
) -> PanelFactor:
    r"""Return the reflectance factor of a level white panel under sun and sky, over its certificate.

    The certificate of a panel holds for light from 8 degrees and the whole hemisphere of views. Seen from one
    direction, a panel reflects more than this under a high sun, and less under a low sun.

    Parameters
    ----------
    wavelength : (wavelength,)
        [nm]
    sun_zenith, view_zenith
        Angles of light and view from the normal [degree].
    relative_azimuth
        Azimuth of the light minus that of the camera, seen from the panel [degree]: 0 with the sun behind the
        camera.
    surface
        ``sintered-ptfe`` (such as Spectralon), white, for light up to 75 degrees and views up to 45 degrees;
        ``lambertian``; or the table of a panel's own factors, or its file, see
        `hyperpaint.io.read_panel_table`.
    direct_share : (wavelength,)
        Direct light over all light on the panel [1]; 1 for a lamp.

    Returns
    -------
    PanelFactor
        ``factor`` and its relative standard uncertainty ``u`` (wavelength,) [1]; NaN outside the wavelengths
        of a table. The uncertainty of a table is part of the panel's own.

    Raises
    ------
    SchemaError
        The surface is unknown, or a direction is outside its range; all are listed.
    FormatError
        The file of a table cannot be read.

    Notes
    -----
    With the share f of direct light

    .. math:: R = f R_{dir}(\theta_s, \theta_v, \phi) + (1 - f)

    By reciprocity, a panel under a uniform sky is seen with its directional-hemispherical reflectance for
    light from the direction of the camera: the certificate. Of sintered PTFE this differs by less than 0.2 %
    up to 45 degrees [1]_. Its :math:`R_{dir}` is a reciprocal polynomial of :math:`u = 1 - \cos\theta` and
    the azimuth with seven terms, normalised to the certificate. It is fitted to the measured expansion of
    [1]_ (one plate, mean of 532, 633 and 1064 nm), and reproduces it with a standard deviation of 0.2 % up to
    75 degrees of light and 30 degrees of view; its 351 nm differ from the mean by 0.5 % (standard deviation).
    Other plates differ more: the model of [2]_ by 2 % at 30, 0.6 % at 45, and 2.4 % at 60 degrees of light,
    seen from the nadir. That is less than twice the uncertainty,

    .. math:: u = f \sqrt{0.01^2 + 0.3^2 (R_{dir} - 1)^2}

    The aureole of a clear sky, which lights the panel as the sun does, counts as part of the uniform sky: R
    changes by some 0.3 %.

    References
    ----------
    .. [1] T. A. Germer, "Full four-dimensional and reciprocal Mueller matrix bidirectional reflectance
       distribution function of sintered polytetrafluoroethylene", Appl. Opt. 56, 9333-9340 (2017).
    .. [2] "A Comprehensive BRF Model for Spectralon and Application to Hyperspectral Field Imagery", IEEE
       Trans. Geosci. Remote Sens. (2024), doi:10.1109/TGRS.2024.3361392, with the correction of 2026 to its
       published code.

    Examples
    --------
    >>> [round(panel_factor([550.0], zenith).factor.item(), 3) for zenith in (30.0, 45.0, 60.0, 75.0)]
    [1.046, 1.017, 0.974, 0.888]
    >>> factor, u = panel_factor([450.0, 850.0], 30.0, direct_share=[0.75, 0.93])
    >>> print(factor.round(3), u.round(3))
    [1.034 1.042] [0.013 0.016]
    """
    check_surface(surface)
    nm = np.atleast_1d(np.asarray(wavelength, np.float64))
    share = np.broadcast_to(np.asarray(direct_share, np.float64), nm.shape)
    if is_lambertian(surface):
        return PanelFactor(np.ones(nm.shape), np.zeros(nm.shape))
    table = None
    if hasattr(surface, "coords"):
        table = surface
    elif surface != SINTERED_PTFE:
        table = read_panel_table(surface)
    # directions inside the range of the surface
    azimuth = abs((relative_azimuth + 180.0) % 360.0 - 180.0)
    angles = {"sun_zenith": sun_zenith, "view_zenith": view_zenith, "relative_azimuth": azimuth}
    with Problems("the factor of a panel is unknown in this direction", SchemaError) as problems:
        for name, angle in angles.items():
            low, high = 0.0, _LIMITS.get(name, 180.0)
            if table is not None:
                known = (
                    convert(table[name], "degree").values if name in table.dims else np.array([0.0, 180.0])
                )
                low, high = float(known.min()), float(known.max())
            problems.add_if(
                not low <= angle <= high,
                f"{name} of {angle:.1f} degrees",
                expected=f"{low:g} to {high:g} degrees",
                mend="pass a table of factors that covers it, see hyperpaint.io.read_panel_table",
                code="panel-direction-outside",
            )
    if table is not None:
        # a dimension of one value has no neighbours
        point = {name: angles[name] for name in PANEL_DIRECTIONS if table.sizes.get(name, 1) > 1}
        values = table.interp(point).squeeze(drop=True)
        directional = (
            np.full(nm.shape, float(values))
            if not values.dims
            else np.interp(nm, convert(values["wavelength"], "nm").values, values.values, np.nan, np.nan)
        )
        return PanelFactor(1.0 + share * (directional - 1.0), np.zeros(nm.shape))
    light, view = 1.0 - np.cos(np.radians([sun_zenith, view_zenith]))
    across = np.sin(np.radians(sun_zenith)) * np.sin(np.radians(view_zenith))
    departure = -1.0 + sum(
        coefficient
        * across**order
        * np.cos(order * np.radians(azimuth))
        * (light**a * view**b + light**b * view**a)
        / 2.0
        for coefficient, order, a, b in _TERMS
    )
    return PanelFactor(1.0 + share * departure, share * float(np.hypot(_LEAST_U, _SPREAD_U * departure)))


#: Faults of a panel, in the order of the bits of ``panel_state``.
PANEL_STATES = ("saturated", "partly_other", "uneven", "leaning", "off_level", "refused")
_SATURATED, _PARTLY_OTHER, _UNEVEN, _LEANING, _OFF_LEVEL, REFUSED = (
    1 << bit for bit in range(len(PANEL_STATES))
)


#: Thresholds above which a region is not the declared panel.
RULES = SimpleNamespace(
    # Robust standard deviations from the median of the pixels, in brightness or colour, above which a pixel
    # does not show the panel [1]. None of 1000 normal pixels is beyond 6.
    outlier_sd=6.0,
    # Departure below which a pixel is always kept [1]: one in twenty such pixels changes the mean by a
    # thousandth.
    least_departure=0.02,
    # Share of saturated pixels, or of pixels that do not show the panel, above which it is reported [1].
    noticed_share=0.01,
    # Share of saturated pixels up to which a band has a mean [1]: above a half, the unsaturated part of the
    # distribution does not contain its median.
    most_saturated=0.5,
    # Minimum share of pixels that show the panel [1]: with fewer, the median may belong to another surface.
    least_used=0.5,
    # Standard error of the mean of the pixels above which they are uneven [1].
    most_error=0.01,
    # Standard error above which the panel is refused unless its declared uncertainty covers it [1]: half of a
    # panel in a shade of 40 % has 0.025.
    refused_error=0.02,
    # Change of the light by a panel's attitude above which it is reported [1].
    least_lean=0.01,
    # Minimum change in units of its standard error [1].
    lean_significance=5.0,
    # Residuals of the factor, relative to the spread by the change, up to which attitude explains its shape
    # [1].
    lean_misfit=0.3,
    # Minimum difference of the direct share between bands for a detectable change by attitude [1].
    least_contrast=0.08,
    # Relative standard uncertainties if the line has none [1]: of a lamp calibration a year old, and of a
    # calibrated field spectrometer with a cosine receptor.
    gain_u=0.03,
    irradiance_u=0.05,
    # Accepted distance of a factor from 1 in standard uncertainties [1].
    coverage=2.0,
    # Factor of a panel, or its inverse, above which it is refused [1]: the certificate is of another panel or
    # unit, or the scale of the line is wrong; stained and aged panels have 0.8 and more.
    most_factor=2.0,
    # Share of bands beyond ``coverage`` above which it is reported [1].
    off_bands=0.1,
    # Relative standard uncertainty of a panel that is laid out again [1]: half a degree from level changes
    # direct light by 0.5 % with the sun at 30 degrees.
    repeatability=0.005,
)


class PanelContext(NamedTuple):
    # Properties of the line for the judgement of its panels.
    wavelength: Floats  # (band,) [nm]
    good: Bools  # (band,)
    u: Floats  # (band,) relative standard uncertainty of gain and irradiance together [1]
    has_scale: bool  # Whether the gain is absolute


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
        warn_if(notes, f"{panel['name']}: {'; '.join(notes.values())}", "panel-doubtful")
        rows.append(row)
    *spectra, states, reasons = zip(*rows, strict=True)
    time = np.array([panel["time"] for panel in panels], "datetime64[ns]")
    return PanelClosure._make([*map(np.array, spectra), np.array(states, np.uint8), time, reasons])


def _judge(panel: Mapping[str, Any], context: PanelContext) -> tuple[Any, ...]:
    # Return the texts of a warning by fault, and the row of a `PanelClosure`, without the time.
    observed = np.asarray(panel["observed"], np.float64)
    expected = np.asarray(panel["reflectance"], np.float64)
    is_valid = np.isfinite(observed)
    SchemaError.raise_if(
        not is_valid.any(),
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
    notes: dict[int, str] = {}
    reasons: list[str] = []
    # pixels that do not show the panel, by brightness and colour in unsaturated bands
    is_unsaturated = ~is_saturated.any(axis=(0, 2)) & is_valid.any(axis=(0, 2))
    is_unsaturated &= context.good & (np.nan_to_num(expected) > 0.0)
    brightness, is_foreign = _brightness_and_outliers(observed, is_unsaturated)
    foreign_share = float(is_foreign.mean())
    if foreign_share >= RULES.noticed_share:
        notes[_PARTLY_OTHER] = (
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
        is_refused = np.isnan(total) & (saturated_share_of_band > 0)
        refused_text = f", and {is_refused.sum()} bands are refused" if is_refused.any() else ""
        notes[_SATURATED] = (
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
        text = f"its pixels are uneven: their mean has a standard error of {100 * np.median(errors):.1f} %"
        notes[_UNEVEN] = text
        if np.median(errors) > max(RULES.refused_error, RULES.coverage * panel["uncertainty"]):
            reasons.append(f"{text}; part of it may be shaded")
    # a tilt, and a factor far from 1
    u = factor * np.sqrt(context.u**2 + panel["uncertainty"] ** 2 + mean_u**2)
    change, level = _change_by_attitude(factor, panel["direct_share"], context)
    if change:
        notes[_LEANING] = (
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
        low, median, high = np.nanquantile(factor[context.good], [0.0, 0.5, 1.0])
        notes[_OFF_LEVEL] = (
            f"it measures {low:.3f} to {high:.3f} (median {median:.3f}) of the reflectance expected from "
            f"irradiance, with a combined standard uncertainty of {np.nanmedian(u):.3f}"
        )
        if not 1.0 / RULES.most_factor <= median <= RULES.most_factor:
            reasons.append(
                f"it measures {median:.3g} times its certificate, which is of another panel or unit"
            )
    state = sum(notes) | (REFUSED if reasons else 0)
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
    shapes = (level(part) / brightness for part in parts)
    return brightness, np.any([_is_outlier(values) for values in (brightness, *shapes)], axis=0)


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
    pattern = (
        np.ones(observed[:, 0].shape)
        if brightness is None
        else brightness / float(np.nanmean(brightness[on_panel[:, 0, :]]))
    )
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
    # Return the relative change of a panel's light by its attitude, 0 if insignificant, and its level [1].
    #
    # F = k (1 + a w)
    #
    # fitted to medians of neighbouring bands, with :math:`w` the direct share of the sky that fits best.
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


# --- judging of panels -------------------------------------------------------------------------------------

#: Variables of the results of panels.
CLOSURE = ("panel_factor", "panel_factor_u", "panel_used", "panel_state", "panel_time")

#: Variables that hold the scale of a line by panels, also in a crop without panels.
_SCALE = ("panel_factor", "panel_state", "panel_weight", "panel_scale_u")

#: Uncertainties of a line that limit how far panel factors may be from 1.
_STATED = ("radiance_gain_u_systematic", "irradiance_u_systematic")


@takes_quantities()
@dataclass(frozen=True)
class Panel:
    """A target of known reflectance in the scene.

    Attributes
    ----------
    along_track, cross_track
        Lines and columns of the panel, by position.
    reflectance
        Certified reflectance factor: a number [1], or a DataArray [1 or percent] with a coordinate
        ``wavelength`` [any unit of length].
    uncertainty
        Relative standard uncertainty of the reflectance [1]. A panel whose measured tilt changes its light by
        more than twice this is refused.
    tilt
        Attitude if the panel is not level, as `hyperpaint.Tilt` or (angle, azimuth) [degree].
    surface
        Surface of the panel, for its reflectance by the directions of light and view: ``lambertian``,
        ``sintered-ptfe``, or a table of its own factors, see `hyperpaint.radiometry.panel_factor`.
    view
        Zenith angle of the camera, seen from the panel, and its azimuth clockwise from north [degree]; for
        surfaces other than ``lambertian``.

    Raises
    ------
    SchemaError
        The reflectance or its uncertainty is out of range, or the surface is unknown.

    Examples
    --------
    >>> panel = Panel(along_track=slice(10, 20), cross_track=slice(4, 9), reflectance=0.5, uncertainty=0.02)
    >>> panel.at([450.0, 850.0])
    array([0.5, 0.5])
    """

    along_track: slice
    cross_track: slice
    reflectance: Any
    uncertainty: float = 0.0
    tilt: Any = None
    surface: Any = LAMBERTIAN
    view: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        SchemaError.raise_if(
            not 0.0 <= self.uncertainty < 1.0,
            f"the panel's uncertainty is {self.uncertainty}",
            expected="a fraction of 1, such as 0.02",
            code="value-out-of-range",
        )
        SchemaError.raise_if(
            not (isinstance(self.along_track, slice) and isinstance(self.cross_track, slice)),
            f"a panel at along_track={self.along_track!r:.40}, cross_track={self.cross_track!r:.40}",
            expected="slices, such as slice(80, 90)",
            code="type-wrong",
        )
        is_labelled = hasattr(self.reflectance, "coords")
        SchemaError.raise_if(
            is_labelled and "wavelength" not in self.reflectance.coords,
            "the panel's reflectance has no coordinate 'wavelength' [nm]",
            code="coordinate-missing",
        )
        SchemaError.raise_if(
            not is_labelled and not (np.ndim(self.reflectance) == 0 and 0 < self.reflectance <= 1.2),
            f"the panel's reflectance is {self.reflectance}",
            expected="0 to 1, or a DataArray",
            code="value-out-of-range",
        )
        check_surface(
            self.surface, convert(self.reflectance, "1", "reflectance") if is_labelled else self.reflectance
        )

    def at(self, wavelength: Any) -> Any:
        """Return the reflectance at wavelengths (band,) [nm]; NaN outside the range of ``reflectance``."""
        if np.ndim(self.reflectance) == 0:
            return np.full(np.shape(wavelength), float(self.reflectance))
        factor = convert(self.reflectance, "1", "reflectance")
        wavelengths = convert(factor["wavelength"].astype(np.float64), "nm").values
        order = np.argsort(wavelengths, kind="stable")
        return np.interp(wavelength, wavelengths[order], factor.values[order], np.nan, np.nan)


def declared_panels(dataset: xr.Dataset) -> tuple[Panel, ...]:
    # Return the panels that a flight line declares (attribute ``panels``), as a ``collect.toml`` names them.
    #
    # Raises SchemaError: The attribute does not declare panels.
    with SchemaError.instead_of(
        (ValueError, TypeError, KeyError),
        "attribute 'panels' cannot be read: $whole",
        code="panels-unreadable",
    ):
        panels = []
        for row in json.loads(str(dataset.attrs.get("panels", "[]"))):
            region = slice(*row["along_track"]), slice(*row["cross_track"])
            # a number, or pairs of wavelength [nm] and reflectance
            reflectance, tilt = row["reflectance"], row["tilt"]
            surface = row.get("surface", LAMBERTIAN)
            if isinstance(reflectance, list):
                wavelengths, values = np.array(reflectance, np.float64).T
                axis = {"wavelength": ("wavelength", wavelengths, {"units": "nm"})}
                reflectance = xr.DataArray(values, axis, ("wavelength",), attrs={"units": "1"})
            panels.append(
                Panel(
                    *region,
                    reflectance,
                    row["uncertainty"],
                    None if tilt is None else tuple(tilt),
                    # a name, or a table of factors
                    surface if isinstance(surface, str) else xr.DataArray.from_dict(surface),
                    tuple(row.get("view", (0.0, 0.0))),
                )
            )
        return tuple(panels)


def declared_scale(dataset: xr.Dataset, *, other_light: bool) -> dict[str, Any] | None:
    # Return the stored scale from the panels that a line declares; None without one.
    #
    # Panels are declared by position in the whole line; their stored scale is valid in any crop, but only
    # with the line's own irradiance record.
    #
    # Warns PaintWarning: A scale is stored, but ``other_light`` replaces its irradiance record.
    if "panels" not in dataset.attrs or not set(_SCALE) <= set(dataset.variables):
        return None
    if other_light:
        warn_user(
            "the scale by panels belongs to the line's own irradiance and is left out; pass panel=",
            "panel-scale-foreign",
        )
        return None
    arrays = require(dataset, list(_SCALE), "the scale by panels")
    return {name.removeprefix("panel_"): slabs.small(array) for name, array in arrays.items()}


def without_panels(dataset: xr.Dataset) -> xr.Dataset:
    # Return a line without the results of panels.
    return dataset.drop_vars([name for name in dataset.variables if str(name).startswith("panel_")])


def several_panels(panel: Panel | Sequence[Panel] | None) -> tuple[Panel, ...]:
    # Return panels as a tuple; empty only for None.
    panels = () if panel is None else (panel,) if isinstance(panel, Panel) else tuple(panel)
    SchemaError.raise_if(
        (panel is not None and not panels) or not all(isinstance(item, Panel) for item in panels),
        f"panel={panel!r:.80}",
        expected="hyperpaint.Panel, or several of them",
        code="type-wrong",
    )
    return panels


def panel_inputs(
    dataset: xr.Dataset, panels: Sequence[Panel], reflectance: Callable[..., xr.Dataset]
) -> dict[str, Any]:
    # Return the inputs of panels for a plan, with their reflectance through the irradiance record.
    #
    # ``reflectance`` is `hyperpaint.radiometry.counts_to_reflectance.reflectance`.
    with Problems("the panel cannot be used", SchemaError) as problems:
        for panel in panels:
            for dim in (ALONG_TRACK, CROSS_TRACK):
                problems.add_if(
                    not len(range(dataset.sizes[dim])[getattr(panel, dim)]),
                    f"{dim}={getattr(panel, dim)} is outside of this line",
                    expected=f"positions below {dataset.sizes[dim]}",
                    code="panel-outside-line",
                )
    names = [name for name in _STATED if name in dataset.variables]
    return {
        "panels": [_inputs_of_panel(dataset, panel, reflectance) for panel in panels],
        "stated": {name: slabs.small(array) for name, array in require(dataset, names, "panels").items()},
        "has_scale": dataset.attrs.get("absolute_scale") != "unknown",
    }


def _inputs_of_panel(
    dataset: xr.Dataset, panel: Panel, reflectance: Callable[..., xr.Dataset]
) -> dict[str, Any]:
    # all columns of its lines: masked elements give the pedestal
    region = dataset.isel({ALONG_TRACK: panel.along_track})
    columns = {CROSS_TRACK: panel.cross_track}
    # the scale of the gain cancels in the factor of the panel
    region = without_panels(region).assign_attrs(absolute_scale="of the panel")
    wavelength = slabs.small(dataset["wavelength"])
    expected = (
        wavelength.map_blocks(panel.at, dtype=np.float64)
        if dataset["wavelength"].chunks is not None
        else panel.at(wavelength)
    )
    lines = range(dataset.sizes[ALONG_TRACK])[panel.along_track]
    inputs = {
        "observed": reflectance(region, tilt=panel.tilt)["reflectance"].isel(columns).data,
        "ceiling": None,
        "reflectance": expected,
        "uncertainty": panel.uncertainty,
        "surface": panel.surface,
        "view": panel.view,
        "lines": (min(lines), max(lines) + 1),
        "name": f"the panel at lines {min(lines)} to {max(lines)}",
    }
    if "counts" in dataset.variables:
        # reflectance of the highest unsaturated counts; masked elements, which receive no light, and elements
        # without a limit keep their counts
        counts = region["counts"]
        limit = np.ceil(region["saturation_count"].astype(np.float64) - SATURATION_MARGIN_COUNTS) - 1.0
        keep_counts = np.isnan(limit)
        if "masked" in region.variables:
            keep_counts = keep_counts | region["masked"]
        highest = xr.where(keep_counts, counts, limit).transpose(*counts.dims).astype(counts.dtype)
        brightest = reflectance(region.assign(counts=highest.assign_attrs(counts.attrs)), tilt=panel.tilt)
        inputs["ceiling"] = brightest["reflectance"].isel(columns).data
    return inputs


def closure_variables(plan: Any, panels: int, bands: int, lines: int) -> dict[str, xr.DataArray]:
    # Return the results of a plan's panels as variables, lazily.
    masks = 1 << np.arange(len(PANEL_STATES), dtype=np.uint8)
    attrs = {"panel_state": {"flag_masks": masks, "flag_meanings": " ".join(PANEL_STATES)}}
    variables = {}
    for name in (*CLOSURE, "panel_weight", "panel_scale_u"):
        spec = VARIABLES[name]
        shape = tuple({PANEL: panels, BAND: bands, ALONG_TRACK: lines}[dim] for dim in spec.dims)
        values = dask.delayed(slabs.panel_result, pure=True)(plan, name.removeprefix("panel_"))
        array = xr.DataArray(da.from_delayed(values, shape, np.dtype(spec.dtype)), dims=spec.dims)
        variables[name] = label(array, name, **attrs.get(name, {}))
    return variables


# --- scale of panels, interpolated in time to all lines -----------------------------------------------------


def usable_panels(closure: PanelClosure) -> Array:
    # Return the indices of panels that are not refused.
    #
    # Raises SchemaError: All are refused. Warns PaintWarning: Some are refused and left out.
    refused = [reason for reason in closure.reasons if reason]
    SchemaError.raise_if(
        len(refused) == len(closure.reasons),
        f"the panel is refused: {'; '.join(dict.fromkeys(refused))}",
        mend="see hyperpaint.radiometry.panel_closure; outline another part of it, give its attitude, "
        "Panel(..., tilt=(angle, azimuth)), its surface, surface='sintered-ptfe', or its uncertainty, "
        "uncertainty=0.05, or leave out panel=",
        option="under [[panels]] of the collect.toml give another part of it (along_track, cross_track), "
        'its attitude, tilt = [angle, azimuth], its surface, surface = "sintered-ptfe", or its '
        "uncertainty, uncertainty = 0.05, or leave it out",
        code="panel-refused",
    )
    warn_if(
        refused,
        f"{len(refused)} of {len(closure.reasons)} panels are refused and left out: {''.join(refused[:1])}",
        "panel-refused",
    )
    return np.flatnonzero([not reason for reason in closure.reasons])


def panel_correction(closure: PanelClosure, time: Array) -> tuple[Floats, Floats, Floats]:
    # Return logarithms of panels' scales (panel, band), weights (line, panel) and uncertainties (line,).
    #
    # The third is the relative standard uncertainty of the level of every line (line,) [1], without the
    # uncertainty of the panels' reflectance. All panels of ``closure`` are used; ``time`` is UTC of the
    # lines, NaT for unknown.
    #
    # Ordinary kriging: the error of the record is modelled as a random walk of variance q per second,
    # observed by panels with errors. Between two panels the weights are linear in time where the panels
    # differ by more than their errors, and equal elsewhere; before the first and after the last panel its
    # scale is constant.
    #
    # q = \frac{\sum_j \left[(\Delta_j \ln F)^2 - u_j^2 - u_{j+1}^2\right]_+}{\sum_j \Delta_j t}

    # variance of the random walk, from the steps between panels
    scale = _filled(np.log(closure.scale))
    error = np.hypot(np.nanmedian(closure.mean_u, axis=1), RULES.repeatability)
    ticks = (closure.time - closure.time[0]) / np.timedelta64(1, "s")
    order = np.argsort(ticks, kind="stable")
    steps = np.nanmedian(np.abs(np.diff(scale[order], axis=0)), axis=1) ** 2
    span = float(np.ptp(ticks))
    excess = np.maximum(steps - error[order][1:] ** 2 - error[order][:-1] ** 2, 0.0)
    walk_variance = float(excess.sum()) / span if span > 0.0 else 0.0
    # kriging system, and its solution for every line
    number = len(ticks)
    system = np.ones((number + 1, number + 1))
    system[:-1, :-1] = -0.5 * walk_variance * np.abs(ticks[:, None] - ticks) + np.diag(error**2)
    system[-1, -1] = 0.0
    has_time = ~np.isnat(time)
    line_seconds = np.where(has_time, time - closure.time[0], np.timedelta64(0, "ns")) / np.timedelta64(
        1, "s"
    )
    right = np.ones((number + 1, line_seconds.size))
    right[:-1] = -0.5 * walk_variance * np.abs(line_seconds - ticks[:, None])
    solution = np.linalg.inv(system) @ right
    variance = -(solution * right).sum(axis=0)
    return scale, np.ascontiguousarray(solution[:-1].T), np.sqrt(np.maximum(variance, 0.0))


def scale_of_factors(factor: Floats, weight: Floats, refused: Array) -> tuple[Floats, Floats | None]:
    # Return the scale of a line from the stored factors of its panels, in the form of a `Plan`.
    #
    # ``factor`` (panel, band), ``weight`` (line, panel), ``refused`` (panel,). One usable panel gives its
    # scale (band,) and None; several give logarithms of their scales (panel, band) and their weights (line,
    # panel).
    scale = 1.0 / np.asarray(factor, np.float64)[~refused]
    weights = np.ascontiguousarray(weight[:, ~refused], np.float64)
    return (scale[0], None) if len(scale) == 1 else (_filled(np.log(scale)), weights)


def _filled(scale: Floats) -> Floats:
    # Return scales (panel, band) with missing bands filled from other panels, at the level of the panel.
    is_valid = np.isfinite(scale)
    if is_valid.all():
        return scale
    number, level = is_valid.sum(axis=0), np.zeros(len(scale))
    # alternate between the common shape of all panels and the levels of panels
    for _ in range(100):
        shape = np.where(is_valid, scale - level[:, None], 0.0).sum(axis=0) / np.where(
            number > 0, number, np.nan
        )
        level = np.nanmedian(scale - shape, axis=1)
    return np.where(is_valid, scale, shape + level[:, None])
