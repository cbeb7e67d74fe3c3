"""Uncertainty of counts, of reflectance, and of means over it; `hyperpaint.kernels.radiometry` has the loops.

`estimate_noise` finds the noise of a camera from its own counts, by photon transfer: a count of signal S
above the dark varies by

    var(C) = S / k + sigma_r^2 + 1/12    [count2]

with k electrons a count, sigma_r the read noise and 1/12 for whole counts. Variances against signals, of
repeated frames or of a flight's homogeneous blocks, lie on a straight line whose slope and intercept are
properties of the camera.

Errors of reflectance are random or systematic. Random errors are independent in every sample, and average out
in means over pixels. Systematic errors are shared by a flight, or by the lines of a column, like the noise of
the mean dark and of a calibration: tables, small for any number of lines, name the samples that share each.
"""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, NamedTuple

import dask
import numpy as np
import xarray as xr
from scipy import sparse

from hyperpaint.base import (
    ALONG_TRACK,
    BAND,
    CROSS_TRACK,
    CUBE,
    IRRADIANCE_TIME,
    IRRADIANCE_WAVELENGTH,
    LIBRARY_VARIABLES,
    QUANTISATION_VARIANCE_COUNT2,
    SATURATION_MARGIN_COUNTS,
    SIGNATURE,
    STEP,
    SWEEP_VARIABLES,
    VARIABLES,
    Array,
    Bools,
    Floats,
    Problem,
    Problems,
    SchemaError,
    label,
    rename_to_roles,
    require,
    takes_quantities,
    warn_if,
)
from hyperpaint.kernels.arguments import ErrorTerms
from hyperpaint.light.illumination import (
    COMMON_SHARE,
    INTERPOLATED,
    at_bands,
    line_light,
    matched_noise,
    noise_of_record,
)

from . import slabs
from .darks import dark_weights
from .spectral_axis import NominalAxis, ordered_parts
from .stray_light import (
    ACROSS,
    SHIFT_TIME,
    STRAY,
    STRAY_LIGHT,
    STRAY_SOURCES,
    STRAY_U,
    declared_pedestal,
    pedestal_of,
)

#: Lines of a block, in which a column should show a single surface.
BLOCK_LINES = 8
#: Maximum number of samples read from a flight; more do not improve the estimate.
MAX_SAMPLES = 3_000_000
TRANSFER = SimpleNamespace(
    #: Minimum signal in spreads of a dark count [1], at which the mean of a block is accurate to 3 %.
    min_signal_sd=12.0,
    #: Largest change of brightness by texture [1]; larger changes are edges or glint.
    max_texture=0.15,
    min_variances=200,
    #: Share of the variances that is used; the highest are left out [1].
    used_share=0.999,
    #: Largest excess variation of a block over noise [standard deviations].
    max_block_sd=4.0,
    #: Largest relative uncertainty of electrons per count [1].
    max_relative_u=0.1,
    #: Largest relative departure of variances from the straight line [1].
    max_misfit=0.1,
    #: Relative noise of a record above the rounding of float32 [1].
    min_record_noise=1e-5,
)
_BINS = 24
#: Groups of blocks of the jackknife.
_JACKKNIFE_GROUPS = 16


@dataclass(frozen=True)
class _VariancePoints:
    # Variances with their regressors, the factors of slope and intercept of the photon transfer.
    #: variance, by_signal, by_floor (block, band): mean square, and its regressors: the expected value is
    #: by_signal / k + by_floor x floor; NaN for excluded values
    variance: Floats
    by_signal: Floats
    by_floor: Floats
    freedom: Floats  #: (1 or block, 1): degrees of freedom of a variance


def estimate_noise(dataset: xr.Dataset, *, repeated: bool = False) -> xr.Dataset:
    r"""Electrons per count and read noise, from variances against signals (photon transfer).

    Eager, but reads no more than some three million samples, in blocks of whole lines over the flight.

    Parameters
    ----------
    dataset
        One of

        * frames of a lab sweep: ``counts``, ``counts_variance`` and ``dark_counts`` (step, band,
          cross_track), ``frame_count``;
        * a flight line: ``counts`` (along_track, band, cross_track), ``dark_counts`` (band, cross_track),
          and, if there, ``saturation_count`` and ``radiance_gain``, whose NaN mark bad elements.
    repeated
        The lines are frames of one static scene under constant light; by default they are lines of a flight,
        whose scene and light change.

    Returns
    -------
    Dataset
        ``electrons_per_count`` [electron count-1] and ``read_noise`` [count], scalar float32, for
        ``line.assign(...)``; with standard uncertainties ``electrons_per_count_u`` and ``read_noise_u``, and
        the binned ``transfer_variance`` over ``transfer_signal`` [count2, count] to inspect. Attribute
        ``noise_source`` names the data used. For a flight line with a record of irradiance that has noise
        also ``irradiance_u_random`` (irradiance_wavelength) [1]: departures of single samples from the
        straight line between their neighbours in time, less those of neighbouring channels.

    Raises
    ------
    SchemaError
        Variables are missing or have other dims or units; or signals do not reach far enough apart for a
        slope: the message gives their range.

    Warns
    -----
    PaintWarning
        Variances do not lie on a straight line: the scene is not homogeneous, or the light flickers.

    Notes
    -----
    Texture of a surface is larger than noise: 2 % of 2000 counts are 40, shot noise is 10. Within eight
    lines of one column the deviation of a band from the mean is therefore compared with that of its
    neighbour bands, relative to their signals,

    .. math:: e_b = r_b - \frac{\bar S_b}{2}
              \left(\frac{r_{b-1}}{\bar S_{b-1}} + \frac{r_{b+1}}{\bar S_{b+1}}\right),

    which removes all brightness changes that are smooth over three bands, including those of the light. Its
    variance is still linear in :math:`1/k` and :math:`\sigma_r^2`. The fit excludes bands too dark for their
    signal to be measured, blocks whose brightness changes by more than 15 % (an edge, a glint) or whose bands
    vary more than noise, and the highest one in a thousand of all values, with the resulting bias
    corrected. Uncertainties are from the jackknife over groups of blocks.

    References
    ----------
    .. [1] J. R. Janesick, "Photon Transfer", SPIE Press, 2007.

    Examples
    --------
    >>> from hyperpaint.simulation import simulate_line
    >>> line = simulate_line(lines=64, bands=60, columns=32, electrons_per_count=20.0)
    >>> found = estimate_noise(line)
    >>> abs(float(found.electrons_per_count) - 20.0) < 4 * float(found.electrons_per_count_u)
    True
    """
    if "counts_variance" in dataset.variables:
        names = ["counts", "counts_variance", "dark_counts", "frame_count"]
        names += ["saturation_count"] if "saturation_count" in dataset.variables else []
        arrays = require(dataset, names, "photon transfer of a sweep", SWEEP_VARIABLES)
        dims = (STEP, BAND, CROSS_TRACK)
        counts = arrays["counts"].transpose(*dims)
        signal = (counts - arrays["dark_counts"]).transpose(*dims).values.astype(np.float64)
        variance = arrays["counts_variance"].transpose(*dims).values.astype(np.float64)
        frames = arrays["frame_count"].values.astype(np.float64)
        SchemaError.raise_if(
            (frames < 2).any(),
            f"'frame_count' is {frames.min():g}",
            expected="2 or more frames, for a variance",
            code="frames-too-few",
        )
        if "saturation_count" in arrays:
            # clipping lowers the variance before the mean reaches saturation
            margin = SATURATION_MARGIN_COUNTS + 5.0 * np.sqrt(np.maximum(variance, 0.0))
            variance[counts.values + margin >= np.asarray(arrays["saturation_count"], np.float64)] = np.nan
        bands = signal.shape[1]
        freedom = np.repeat(np.broadcast_to(frames - 1.0, len(signal)), signal.shape[2])[:, None]
        points = _VariancePoints(
            _by_band(variance), _by_band(signal), np.ones((len(freedom), bands)), freedom
        )
        floor = QUANTISATION_VARIANCE_COUNT2
        source = f"{len(signal)} steps of {frames.min():g} frames or more"
    else:
        dataset = rename_to_roles(dataset)
        points, floor, source = _line_points(dataset, repeated)
    # slope and intercept of the photon transfer, their covariance, and the used points
    from scipy.stats import chi2

    is_valid = np.isfinite(points.variance) & np.isfinite(points.by_signal)
    SchemaError.raise_if(
        is_valid.sum() < TRANSFER.min_variances,
        f"noise cannot be estimated from {is_valid.sum()} variances",
        expected=f"{TRANSFER.min_variances} or more",
        code="noise-not-estimable",
    )
    slope, height = _first_guess(points, is_valid, np.broadcast_to(points.freedom, is_valid.shape))
    edge = chi2.ppf(TRANSFER.used_share, points.freedom) / points.freedom
    # mean of the values below the edge relative to the mean of all values
    truncated_mean = chi2.cdf(edge * points.freedom, points.freedom + 2.0) / TRANSFER.used_share
    # neighbouring bands share two thirds of their contrast
    spread = np.sqrt(2.0 * 1.94 / (points.freedom[:, 0] * np.maximum(is_valid.sum(axis=1), 1)))
    is_used = is_valid
    for _ in range(8):
        model = np.maximum(slope * points.by_signal + height * points.by_floor, 1e-6)
        ratio = np.where(is_valid, points.variance / model, np.nan)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # blocks without a value
            block_ratio = np.nanmean(np.minimum(ratio, 2.0 * edge), axis=1)
        is_used = is_valid & (block_ratio < 1.0 + TRANSFER.max_block_sd * spread)[:, None] & (ratio < edge)
        SchemaError.raise_if(
            is_used.sum() < TRANSFER.min_variances,
            "noise cannot be estimated, since no block is homogeneous",
            mend="pass repeated frames, or a lab sweep",
            code="noise-not-estimable",
        )
        previous_slope = slope
        slope, height, covariance = _solve_with_jackknife(
            points, is_used, model * truncated_mean, points.variance / truncated_mean
        )
        if abs(slope - previous_slope) < 1e-4 * abs(slope):
            break
    low, high = np.percentile(points.by_signal[is_used] / points.by_floor[is_used], [1, 99])
    error = np.sqrt(covariance[0, 0])
    SchemaError.raise_if(
        not (slope > 0 and error / max(slope, 1e-300) < TRANSFER.max_relative_u),
        f"electrons per count are uncertain: signals of {low:.0f} to {high:.0f} counts give a slope of "
        f"{slope:.3g} +- {error:.2g} counts of variance a count",
        mend="take a line with dark and bright surfaces, or repeated frames of several levels",
        code="electrons-uncertain",
    )
    estimate = _labelled((slope, height, covariance, is_used), points, floor, source)
    if {"irradiance", IRRADIANCE_TIME} <= set(dataset.variables):
        record = require(dataset, ["irradiance", IRRADIANCE_TIME], "noise of irradiance")
        noise = noise_of_record(record["irradiance"].values, record[IRRADIANCE_TIME].values)
        if noise is not None and noise.max() > TRANSFER.min_record_noise:
            array = xr.DataArray(noise.astype(np.float32), dims=IRRADIANCE_WAVELENGTH)
            estimate["irradiance_u_random"] = label(array, "irradiance_u_random")
    return estimate


# --- gathering variances


def _line_points(dataset: xr.Dataset, repeated: bool) -> tuple[_VariancePoints, float, str]:
    optional = [n for n in ("saturation_count", "radiance_gain", "time") if n in dataset.variables]
    arrays = require(dataset, ["counts", "dark_counts", *optional], "photon transfer of a line")
    counts, dark = arrays["counts"], arrays["dark_counts"]
    if "dark_time" in dark.dims:
        dark = dark.mean("dark_time")
    line_count, bands, columns = counts.shape
    Problems("noise cannot be estimated", SchemaError).raise_if_any(
        (
            line_count < BLOCK_LINES,
            Problem(f"{line_count} lines", expected=f"{BLOCK_LINES} or more", code="lines-too-few"),
        ),
        (
            bands < 3,
            Problem(f"{bands} bands", expected="3 or more, next to each other", code="bands-too-few"),
        ),
    )
    block_count = line_count // BLOCK_LINES
    sampled = min(block_count, max(4, MAX_SAMPLES // (BLOCK_LINES * bands * columns)))
    starts = np.unique(np.linspace(0, block_count - 1, sampled).astype(np.int64)) * BLOCK_LINES
    lines = (starts[:, None] + np.arange(BLOCK_LINES)).ravel()
    blocks = counts.isel({ALONG_TRACK: lines}).values
    has_time = (
        ~np.isnat(arrays["time"].isel({ALONG_TRACK: lines}).values)
        if "time" in arrays
        else np.ones(blocks.shape[:1], bool)
    )
    cube = blocks.astype(np.float32) - dark.values.astype(np.float32)
    if "saturation_count" in arrays:
        limit = np.asarray(arrays["saturation_count"], np.float64) - SATURATION_MARGIN_COUNTS
        cube[blocks >= limit] = np.nan
    if "radiance_gain" in arrays:
        cube[:, ~np.isfinite(arrays["radiance_gain"].values)] = np.nan
    cube[~has_time] = np.nan
    is_integer = np.issubdtype(counts.dtype, np.integer)
    block_cube = cube.reshape(len(starts), BLOCK_LINES, *cube.shape[1:])
    if repeated:
        variance = _by_band(block_cube.var(axis=1, ddof=1, dtype=np.float64))
        signal, freedom = _by_band(block_cube.mean(axis=1, dtype=np.float64)), BLOCK_LINES - 1.0
        points = _VariancePoints(variance, signal, np.ones_like(signal), np.full((1, 1), freedom))
        source = "repeated frames"
    else:
        if "wavelength" in dataset.variables:
            ordered_parts(dataset["wavelength"].values)
        # Variances (block x column, band) of bands relative to their neighbours.
        # `cube` is (block, line, band, column). Bands whose signal is uncertain by noise are left out.
        mean = block_cube.mean(axis=1)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # columns without a value
            total = np.nansum(np.where(np.isfinite(mean)[:, None], block_cube, np.nan), axis=2)
            is_even = (
                np.abs(total / total.mean(axis=1, keepdims=True) - 1.0).max(axis=1) < TRANSFER.max_texture
            )
        mean[~(is_even[:, None] & (mean > 0))] = np.nan
        # spread of a count in the darkest tenth of the samples [count]
        valid, dark_noise = np.isfinite(mean), 0.0
        if valid.any():
            is_darkest = valid & (mean <= np.quantile(mean[valid], 0.1))
            dark_noise = float(np.sqrt(np.median(block_cube.var(axis=1, ddof=1)[is_darkest])))
        mean[mean < TRANSFER.min_signal_sd * dark_noise] = np.nan
        # contrast of a band with its neighbours, relative to their signals
        relative = (block_cube - mean[:, None]) / mean[:, None]
        mean_inside = mean[:, 1:-1]
        contrast = relative[:, :, 1:-1] - 0.5 * (relative[:, :, :-2] + relative[:, :, 2:])
        freedom = block_cube.shape[1] - 1.0
        variance = mean_inside**2 * (contrast**2).sum(axis=1) / np.float32(freedom)
        ratios = [(mean_inside / neighbour).astype(np.float64) for neighbour in (mean[:, :-2], mean[:, 2:])]
        # noise of a much weaker neighbour would exceed noise of the band
        is_similar = np.all([(ratio > 0.5) & (ratio < 2.0) for ratio in ratios], axis=0)
        by_signal = mean_inside * (1.0 + 0.25 * (ratios[0] + ratios[1]))
        values = (
            np.where(is_similar, variance, np.nan),
            by_signal,
            1.0 + 0.25 * (ratios[0] ** 2 + ratios[1] ** 2),
        )
        variances, signals, floors = (_by_band(array).astype(np.float64) for array in values)
        points, source = (
            _VariancePoints(variances, signals, floors, np.full((1, 1), freedom)),
            "blocks of a flight, texture taken out over bands",
        )
    quantisation = QUANTISATION_VARIANCE_COUNT2 if is_integer else 0.0
    return points, quantisation, f"{len(starts)} x {BLOCK_LINES} lines: {source}"


def _by_band(array: Array) -> Array:
    # Return values (block, band, column) as (block x column, band).
    return np.moveaxis(array, 1, 2).reshape(-1, array.shape[1])


# --- fitting the line


def _first_guess(points: _VariancePoints, valid: Bools, freedom: Floats) -> tuple[float, float]:
    from scipy.stats import chi2

    signal = points.by_signal[valid] / points.by_floor[valid]
    variance = (
        points.variance[valid] / points.by_floor[valid] * (freedom[valid] / chi2.median(freedom[valid]))
    )
    edges = np.unique(np.quantile(signal, np.linspace(0, 1, _BINS + 1)))
    bin_of_point = np.clip(np.searchsorted(edges, signal, side="right") - 1, 0, max(len(edges) - 2, 0))
    bins = [bin_of_point == i for i in range(max(len(edges) - 1, 1))]
    x = np.array([np.median(signal[b]) for b in bins if b.any()])
    y = np.array([np.median(variance[b]) for b in bins if b.any()])
    if x.size < 2 or np.ptp(x) <= 0:
        return float(max(y.mean() / max(x.mean(), 1e-6), 1e-6)), 0.0
    slope, height = np.polyfit(x, y, 1, w=1.0 / np.maximum(y, 1e-6))
    return (
        (float(np.median(y / np.maximum(x, 1.0))), 0.0)
        if slope <= 0 or height < 0
        else (float(slope), float(height))
    )


def _solve_with_jackknife(
    points: _VariancePoints, is_used: Bools, model: Floats, variance: Floats
) -> tuple[float, float, Floats]:
    weight = np.where(is_used, 1.0 / model**2, 0.0)
    value = np.where(is_used, variance, 0.0)
    a, b = (np.where(is_used, v, 0.0) for v in (points.by_signal, points.by_floor))
    part = np.arange(len(is_used)) * _JACKKNIFE_GROUPS // len(is_used)

    def sums(product: Floats) -> Floats:
        return np.bincount(part, (weight * product).sum(axis=1), minlength=_JACKKNIFE_GROUPS).astype(
            np.float64
        )

    normal = np.array([[sums(a * a), sums(a * b)], [sums(a * b), sums(b * b)]])
    right = np.array([sums(a * value), sums(b * value)])
    # scale the columns: signals are hundreds, the constant is 1
    scale = np.sqrt(np.maximum(normal.sum(axis=-1).diagonal(), 1e-300))

    def solution(left_out: int | None) -> Floats:
        parts = np.arange(_JACKKNIFE_GROUPS) != (-1 if left_out is None else left_out)
        matrix, vector = normal[..., parts].sum(axis=-1), right[..., parts].sum(axis=-1)
        scaled, *_ = np.linalg.lstsq(matrix / np.outer(scale, scale), vector / scale, rcond=None)
        return np.asarray(scaled / scale)

    slope, height = solution(None).tolist()
    others = np.stack([solution(i) for i in range(_JACKKNIFE_GROUPS)])
    departure = others - others.mean(axis=0)
    return slope, height, (_JACKKNIFE_GROUPS - 1) / _JACKKNIFE_GROUPS * departure.T @ departure


def _labelled(
    transfer: tuple[float, float, Floats, Bools], points: _VariancePoints, quantisation: float, source: str
) -> xr.Dataset:
    slope, height, covariance, is_used = transfer
    # mean signals, variances and fitted variances in bins with equal numbers of points
    a, b, v = (array[is_used] for array in (points.by_signal, points.by_floor, points.variance))
    order = np.argsort(a / b, kind="stable")
    bins = np.array_split(order, min(_BINS, max(1, order.size // 50)))
    signal, variance = (np.array([(values[i] / b[i]).mean() for i in bins]) for values in (a, v))
    misfit = float(np.max(np.abs(variance / np.maximum(slope * signal + height, 1e-9) - 1.0)))
    misfit_sd = np.sqrt(4.0 / (float(points.freedom.mean()) * is_used.sum() / variance.size))
    warn_if(
        misfit > TRANSFER.max_misfit + 4.0 * misfit_sd,
        f"variances depart from a straight line by up to {misfit:.0%}: the scene is not homogeneous "
        "within blocks, or the light flickers; check 'transfer_variance'",
        "transfer-misfit",
    )
    noise = float(np.sqrt(max(height - quantisation, 0.0)))
    # at zero noise, only the variance has an uncertainty
    noise_u = float(np.sqrt(covariance[1, 1])) / (2.0 * noise) if noise > 0 else np.nan
    values = {
        "electrons_per_count": 1.0 / slope,
        "read_noise": noise,
        "electrons_per_count_u": float(np.sqrt(covariance[0, 0])) / slope**2,
        "read_noise_u": float(np.nanmin([noise_u, float(covariance[1, 1]) ** 0.25])),
    }
    estimate = xr.Dataset()
    for name, value in values.items():
        base = name.removesuffix("_u")
        estimate[name] = label(xr.DataArray(np.float32(value)), base)
        if name != base:
            estimate[name].attrs["long_name"] = f"Standard uncertainty of {base}"
    dim, attrs = "transfer_signal", {"units": "count2", "long_name": "Variance of a count"}
    estimate["transfer_variance"] = (dim, variance, attrs)
    attrs = {"units": "count", "long_name": "Counts above the dark"}
    return estimate.assign_coords({dim: (dim, signal, attrs)}).assign_attrs(
        noise_source=f"photon transfer, {source}; {int(is_used.sum())} variances"
    )


NOISE = ("electrons_per_count", "read_noise")
SYSTEMATIC = (
    "dark_counts_u_random",
    "radiance_gain_u_random",
    "reflectance_gain_u_random",
    "irradiance_u_random",
    "radiance_gain_u_systematic",
    "reflectance_gain_u_systematic",
    "irradiance_u_systematic",
    "wavelength_u",
    "dark_counts_u_systematic",
    "linearity_u",
)
OF_WHITE = ("reflectance_gain_u_random", "reflectance_gain_u_systematic")
OF_LIGHT = (
    "radiance_gain_u_random",
    "radiance_gain_u_systematic",
    "irradiance_u_random",
    "irradiance_u_systematic",
    "wavelength_u",
    "linearity_u",
)
#: Attributes of uncertainties, for inputs that are not variables of the line.
WHOLE_COUNTS, MASKED, PANEL_U = "whole_counts", "masked_elements", "panel_u"

UNCERTAINTIES = ("reflectance_u_random", "reflectance_u_systematic")
#: Attribute ``components`` of an uncertainty without any known component, which is zero.
NONE_KNOWN = "none known"
_ABSOLUTE = (
    "electrons_per_count",
    "read_noise",
    "wavelength_u",
    "dark_counts_u_random",
    "dark_counts_u_systematic",
)


def uncertainty_inputs(dataset: xr.Dataset, panel: float | None) -> dict[str, Any]:
    # Return the known noise and systematic errors of a line, by name; ``panel``: uncertainty of a panel [1].
    #
    # Raises `SchemaError, UnitsError`: Variables of the noise are missing, or have other dims or units; all
    # problems are listed.
    with Problems("cannot compute uncertainties of reflectance", SchemaError) as problems:
        problems.add_if(
            "counts" not in dataset.variables,
            "'counts' is missing, and radiance alone has no noise model",
            code="variable-missing",
        )
        for name in NOISE:
            problems.add_if(
                name not in dataset.variables,
                f"{name!r} is missing: {VARIABLES[name].meaning.lower()}",
                mend="take it from a calibration, or line.assign(hp.radiometry.estimate_noise(line))",
                code="variable-missing",
            )
    # a white reference replaces calibration and irradiance, a calibration the white reference
    others = OF_LIGHT if "reflectance_gain" in dataset.variables else OF_WHITE
    names = [name for name in (*NOISE, *SYSTEMATIC) if name in dataset.variables and name not in others]
    arrays = require(dataset, names, "uncertainties of reflectance")
    values = {name: slabs.small(array) for name, array in arrays.items()}
    return values if panel is None else {**values, "panel_u": panel}


def with_uncertainty(result: xr.Dataset, cubes: tuple[Any, ...], uncertain: dict[str, Any]) -> xr.Dataset:
    # Return the dataset with both uncertainties, in obsarray's terms.
    #
    # obsarray distinguishes errors that are independent and errors that are common along a dim. The errors of
    # an element's gain and dark are common to all lines only; treated as common to all samples they are never
    # underestimated. `hyperpaint.radiometry.mean_uncertainty` treats them exactly.
    random = [name for name in NOISE if name in uncertain]
    systematic = [name for name in SYSTEMATIC if name in uncertain]
    of_inputs: dict[str, Any] = {}
    if "masked" in result.variables and result["masked"].chunks is None:
        of_inputs[MASKED] = masked_elements(result)
    if "panel_u" in uncertain:
        replaced = ("radiance_gain_u_systematic", "irradiance_u_systematic")
        systematic = [*(name for name in systematic if name not in replaced), "panel"]
        of_inputs[PANEL_U] = np.asarray(uncertain["panel_u"], np.float64).tolist()
    is_integer = int(np.issubdtype(result["counts"].dtype, np.integer))
    details = ((random, {WHOLE_COUNTS: is_integer}), (systematic, of_inputs))
    for name, cube, (components, extra) in zip(UNCERTAINTIES, cubes, details, strict=True):
        attrs = {
            "pdf_shape": "gaussian",
            "err_corr_1_dim": list(CUBE),
            "err_corr_1_form": name.rpartition("_")[2],
            "err_corr_1_units": [],
            "err_corr_1_params": [],
            "components": ", ".join(components) or NONE_KNOWN,
            **extra,
        }
        result[name] = label(xr.DataArray(cube, dims=CUBE), name, **attrs)
    result["reflectance"].attrs["unc_comps"] = list(UNCERTAINTIES)
    return result


def masked_elements(line: xr.Dataset) -> float:
    # Return the number of elements without light whose mean is as noisy as the pedestals of a line.
    like = line["reflectance"].isel({ALONG_TRACK: 0}, drop=True)
    masked = line["masked"].broadcast_like(like).transpose(BAND, CROSS_TRACK).to_numpy()
    return pedestal_of(masked, np.ones_like(masked), declared_pedestal(line.attrs)).elements


def error_terms(
    uncertain: Mapping[str, Any],
    cube: Mapping[str, Any],
    light: Mapping[str, Any] | None,
    dtype: str,
    bad: Array,
    masked: float = 0.0,
    dark_share: float = 1.0,
) -> ErrorTerms:
    # Return the terms of the uncertainty of every sample; unknown terms are zero, NaN if all are unknown.
    #
    # ``uncertain`` as of `uncertainty_inputs`; ``cube`` and ``light`` are the small variables of the line, by
    # name; ``bad`` (band, column) are elements without a gain; ``masked`` is the number of elements without
    # light whose mean is as noisy as the pedestals of a line, whose noise its samples share;
    # ``dark_share`` is the largest root sum of squares of the weights with which a line's darks are
    # subtracted.
    #
    # Raises `SchemaError`: Values are impossible for uncertainties; all are listed.
    _check_uncertainties(uncertain, bad)

    def of(name: str) -> Floats:
        return element_rows(uncertain.get(name, 0.0), bad.shape)

    is_integer = np.issubdtype(np.dtype(dtype), np.integer)
    floor = of("read_noise") ** 2 + (QUANTISATION_VARIANCE_COUNT2 if is_integer else 0.0)
    element_dark = (dark_share * of("dark_counts_u_random")) ** 2
    dark_variance = of("dark_counts_u_systematic") ** 2 + element_dark
    if masked:
        dark_variance = dark_variance + float(np.nanmean(floor + element_dark)) / masked
    squares = [of(name) ** 2 for name in ("radiance_gain_u_random", "linearity_u", *OF_WHITE)]
    if "panel_u" in uncertain:
        # the panel's uncertainty replaces those of gain and irradiance that all elements share
        squares.append(of("panel_u") ** 2)
    else:
        irradiance_u = np.asarray(uncertain.get("irradiance_u_systematic", 0.0), np.float64)
        if irradiance_u.ndim and light is not None:
            irradiance_u = at_bands(irradiance_u, light["irradiance_wavelength"], cube["wavelength"])[:, None]
        squares += [of("radiance_gain_u_systematic") ** 2, irradiance_u.reshape(-1, 1) ** 2]
    if "irradiance_u_random" in uncertain and light is not None:
        arrays = {**cube, **light, "irradiance_u_random": uncertain["irradiance_u_random"]}
        squares.append(INTERPOLATED * np.diag(matched_noise(arrays)[1])[:, None])
    # without any known source the uncertainty is unknown, not zero
    known = (uncertain.keys() & {*SYSTEMATIC, "panel_u"}) | (cube.keys() & {"stray_light_u"})
    if not known and not dark_variance.any():
        squares.append(np.nan * squares[0])
    offset = np.sqrt(dark_variance)
    wavelength_u = np.broadcast_to(np.asarray(uncertain.get("wavelength_u", 0.0), np.float64), len(bad))
    slope = np.empty((0, 4), np.float32)
    if wavelength_u.any():
        steps = band_steps(np.asarray(cube["wavelength"], np.float64))
        slope = (wavelength_u[:, None] * steps).astype(np.float32)
    elif not offset.any():
        offset = offset[:0]
    terms = (1.0 / of("electrons_per_count"), floor, np.sqrt(sum(squares[1:], squares[0])), offset)
    per_electron, noise, relative, dark = (np.ascontiguousarray(values, np.float32) for values in terms)
    return ErrorTerms(per_electron, noise, relative, dark, slope)


def element_rows(values: Any, shape: tuple[int, ...]) -> Floats:
    # Return a scalar, a value per band, or a value per element as (1 or band, column).
    array = np.asarray(values, np.float64)
    if array.ndim == 1:
        array = array[:, None]
    return np.broadcast_to(array, shape if array.ndim else (1, shape[1]))


def band_steps(wavelength: Floats) -> Floats:
    # Return weights of the differences to the band above and from the band below (band, 4) [nm-1].
    #
    # With two neighbours they give the slope between them, with one neighbour the slope to it. A neighbour
    # across a join of two detectors, where wavelengths decrease, repeat or jump, is ignored.
    step = np.diff(wavelength)
    median_step = np.median(step) if step.size else 1.0
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse_step = np.where((step / median_step > 0.0) & (step / median_step < 3.0), 1.0 / step, 0.0)
    inverse_next, inverse_previous = np.append(inverse_step, 0.0), np.insert(inverse_step, 0, 0.0)
    between = np.zeros_like(wavelength)
    has_both = (inverse_next != 0.0) & (inverse_previous != 0.0)
    between[has_both] = 1.0 / (1.0 / inverse_next[has_both] + 1.0 / inverse_previous[has_both])
    return np.stack(
        [
            np.where(has_both, between, inverse_next),
            inverse_next,
            np.where(has_both, between, inverse_previous),
            inverse_previous,
        ],
        axis=1,
    )


def _check_uncertainties(uncertain: Mapping[str, Any], bad: Array) -> None:
    with Problems("uncertainties cannot be computed", SchemaError) as problems:
        for name, value in uncertain.items():
            array = np.asarray(value, np.float64)
            values = array[~bad] if array.shape == bad.shape else array
            values = values[~np.isnan(values)]
            if values.size == 0:
                problems.add(f"{name!r} contains no value", code="not-finite")
                continue
            is_positive, low, high = name == "electrons_per_count", values.min(), values.max()
            is_impossible = not np.isfinite(values).all() or low < 0 or (is_positive and low == 0)
            problems.add_if(
                is_impossible,
                f"{name!r} is {low:g} to {high:g}",
                expected=f"finite and {'positive' if is_positive else '0 or more'}",
                code="value-out-of-range",
            )
            problems.add_if(
                not is_impossible and name not in _ABSOLUTE and high > 1.0,
                f"{name!r} is {high:g}",
                expected="a fraction of 1, such as 0.02",
                code="value-out-of-range",
            )


# --- sources of errors -------------------------------------------------------------------------------------


class Form(NamedTuple):
    # Samples that share an error, dim by dim, in the terms of FIDUCEO and obsarray.
    along_track: str
    band: str
    cross_track: str

    def __str__(self) -> str:
        return ", ".join(f"{dim} {form}" for dim, form in zip(self._fields, self, strict=True))


#: Sources of error of a sample. Smile and smoothing correlate the random errors of neighbouring bands.
FORMS = {
    "noise": Form("random", "random", "random"),
    "mean dark": Form("systematic", "random", "random"),
    "gain of elements": Form("systematic", "random", "random"),
    "irradiance noise": Form("triangle_relative", "bell_relative", "systematic"),
    "pedestal": Form("random", "systematic", "systematic"),
    "gain": Form("systematic", "systematic", "systematic"),
    "white tile": Form("systematic", "systematic", "systematic"),
    "irradiance": Form("systematic", "systematic", "systematic"),
    "linearity": Form("systematic", "systematic", "systematic"),
    "panel": Form("systematic", "systematic", "systematic"),
    "dark": Form("systematic", "systematic", "systematic"),
    "wavelength": Form("systematic", "systematic", "systematic"),
    "stray light": Form("systematic", "systematic", "systematic"),
}

#: Variables of each source.
COMPONENTS = {
    "noise": NOISE,
    "mean dark": ("dark_counts_u_random",),
    "gain of elements": ("radiance_gain_u_random",),
    "irradiance noise": ("irradiance_u_random",),
    "pedestal": ("masked",),
    "gain": ("radiance_gain_u_systematic",),
    "white tile": ("reflectance_gain_u_systematic",),
    "irradiance": ("irradiance_u_systematic",),
    "linearity": ("linearity_u",),
    "panel": ("panel",),
    "dark": ("dark_counts_u_systematic",),
    "wavelength": ("wavelength_u",),
    "stray light": ("stray_light_u",),
}

MAX_HARMONICS = 20


class LightErrors(NamedTuple):
    # Irradiance of the bands, and its noise.
    #: before, after (line,) int64, weight (line,) float64: samples around every line, and weight of the later
    before: Array
    after: Array
    weight: Floats
    level: Floats  #: (band,) float64: irradiance, mean over the record [W m-2 nm-1]
    covariance: Floats  #: (band, band) float64: covariance of the noise of one sample, relative [1]


@dataclass(frozen=True)
class LineErrors:
    # Standard uncertainties of a line by their sources; (band, column) unless noted.
    per_electron: Floats  #: Counts per electron
    noise_floor: Floats  #: Variance of a count without light [count2]
    is_integer: bool  #: Whether counts are integers
    read_noise: Floats  #: [count]
    dark: Floats  #: Uncertainty of each mean dark [count]
    dark_weights: Floats  #: (line, dark): weight of each dark in a line
    gain_of_elements: Floats  #: Relative [1]
    common: Mapping[str, Floats]  #: Errors that all samples share, relative [1], by source
    dark_offset: Floats  #: Error of the dark that all elements share [count]
    pedestal_variance: float  #: Variance of the pedestal of a line [count2]
    wavelength_u: Floats  #: (band,) [nm]
    wavelength: Floats  #: (band,) [nm]
    light: LightErrors | None  #: None without noise of irradiance and without errors of wavelength
    #: (band, band): uncertainty of the light from a source band, counts per count; None without stray light
    stray_light: Floats | None


def line_errors(line: xr.Dataset) -> LineErrors | None:
    # Return the errors of a line whose reflectance has uncertainties; None where they cannot be separated.
    #
    # Reads the small variables. Errors can be separated if the line still holds the variables that its
    # uncertainties were computed from: reflectance from a store or a map without calibration has only their
    # sum.
    if not {"reflectance", *UNCERTAINTIES} <= set(line.variables):
        return None
    attrs = [line[name].attrs for name in UNCERTAINTIES]
    random, systematic = (str(texts.get("components", "")).split(", ") for texts in attrs)
    components = [name for name in systematic if name in SYSTEMATIC]
    required = [
        *NOISE,
        *components,
        "dark_counts",
        "exposure_time",
        *(["time"] if components and "reflectance_gain" not in line.variables else []),
    ]
    is_known_form = tuple(random) == NOISE and WHOLE_COUNTS in attrs[0]
    if not is_known_form or not set(required) <= set(line.variables):
        return None
    try:
        arrays = require(line, required, "errors of a region")
        values = dict(zip(arrays, dask.compute(*(array.values for array in arrays.values())), strict=True))
        shape = (line.sizes[BAND], line.sizes[CROSS_TRACK])
        stated = line[UNCERTAINTIES[1]].attrs

        def of(name: str) -> Floats:
            return np.broadcast_to(element_rows(values.get(name, 0.0), shape), shape)

        is_integer = bool(line[UNCERTAINTIES[0]].attrs[WHOLE_COUNTS])
        floor = of("read_noise") ** 2 + (QUANTISATION_VARIANCE_COUNT2 if is_integer else 0.0)
        # of the whole line, of which this may be a part
        is_counted = MASKED in stated or "masked" not in line.variables
        masked = stated.get(MASKED, 0) if is_counted else masked_elements(line)
        common = {name: COMPONENTS[name][0] for name in ("gain", "white tile", "linearity")}
        sources = {name: of(variable) for name, variable in common.items() if variable in values}
        if "irradiance_u_systematic" in values:
            channels = line[IRRADIANCE_WAVELENGTH].values
            band_values = at_bands(values["irradiance_u_systematic"], channels, line["wavelength"].values)
            sources["irradiance"] = np.broadcast_to(band_values[:, None], shape)
        if "panel_scale_u" in line.variables:
            sources["panel"] = np.full(shape, float(np.nanmean(line["panel_scale_u"].values)))
        elif PANEL_U in stated:
            sources["panel"] = np.broadcast_to(element_rows(stated[PANEL_U], shape), shape)
        # weights of the darks in every line
        names = ("time", "dark_time", "dark_exposure_time")
        times = {name: line[name].values for name in names if name in line.variables}
        count = line.sizes["dark_time"] if "dark_time" in line["dark_counts"].dims else 1
        exposure = np.broadcast_to(line["exposure_time"].values.astype(np.float64), line.sizes[ALONG_TRACK])
        # a cube with a white reference may lack wavelengths, and has no uncertainty of them then
        wavelength = np.asarray(
            line["wavelength"] if "wavelength" in line.variables else np.full(shape[0], np.nan)
        )
        wavelength_u = np.broadcast_to(np.asarray(values.get("wavelength_u", 0.0), np.float64), shape[:1])
        return LineErrors(
            per_electron=1.0 / of("electrons_per_count"),
            noise_floor=floor,
            is_integer=is_integer,
            read_noise=of("read_noise"),
            dark=of("dark_counts_u_random"),
            dark_weights=dark_weights(times, count, exposure),
            # a line has one of both
            gain_of_elements=of("radiance_gain_u_random") + of("reflectance_gain_u_random"),
            common=sources,
            dark_offset=of("dark_counts_u_systematic"),
            pedestal_variance=float(np.nanmean(floor + of("dark_counts_u_random") ** 2)) / masked
            if masked
            else 0.0,
            wavelength_u=wavelength_u,
            wavelength=wavelength.astype(np.float64),
            light=_light_errors(line) if "irradiance_u_random" in values or wavelength_u.any() else None,
            stray_light=_stray_light_errors(line),
        )
    except (SchemaError, ValueError):
        # bands or record were cut afterwards and do not fit the matrices
        return None


def _stray_light_errors(line: xr.Dataset) -> Floats | None:
    names = [name for name in STRAY_LIGHT if name in line.variables]
    if STRAY_U not in names or not STRAY_SOURCES & set(names):
        return None
    arrays = require(line, [*names, "exposure_time"], "errors of stray light")
    bands = line.sizes[BAND]
    shares = np.zeros((bands, bands))
    if STRAY in arrays:
        shares += arrays[STRAY].values
    if SHIFT_TIME in arrays:
        shares += float(arrays[SHIFT_TIME]) / float(np.mean(arrays["exposure_time"].values))
    if ACROSS in arrays:  # columns beside a column are about as bright
        shares += np.eye(bands) * float(arrays[ACROSS].values.sum(axis=1).mean())
    return np.asarray(float(arrays[STRAY_U]) * shares)


def _light_errors(line: xr.Dataset) -> LightErrors:
    names = ["irradiance", "irradiance_fwhm", IRRADIANCE_TIME, IRRADIANCE_WAVELENGTH, "wavelength", "fwhm"]
    optional = (
        "band_spacing",
        "responsivity_slope",
        "srf_offset",
        "srf",
        "radiance_gain",
        "irradiance_u_random",
    )
    names += [name for name in optional if name in line.variables]
    arrays = {name: array.values for name, array in require(line, names, "noise of light").items()}
    arrays |= {name: line.attrs.get(name, "gaussian") for name in ("srf_shape", "irradiance_srf_shape")}
    spectra = arrays["irradiance"]
    is_finite = np.isfinite(spectra)
    is_complete = is_finite[:, is_finite.mean(axis=0) > COMMON_SHARE].all(axis=1)
    levels = np.where(is_complete, np.where(is_finite, spectra, 0.0).sum(axis=1), np.nan)
    neighbours = line_light(
        line["time"].values, arrays[IRRADIANCE_TIME], levels, np.inf, clock_uncertainty=0.0
    )
    return LightErrors(
        neighbours.before, neighbours.after, np.nan_to_num(neighbours.weight), *matched_noise(arrays)
    )


def rounding_variance(variance: Array) -> Floats:
    # Return the variance that rounding adds to a mean of many counts of one level [count2].
    #
    # ``variance``: of the counts before rounding [count2]. The mean of rounded counts is off by
    # :math:`\sum_k (-1)^k e^{-2 \pi^2 k^2 \sigma^2} \sin(2 \pi k x) / (\pi k)` (Widrow and Kollar,
    # Quantization Noise, 2008). The result is the mean square over all levels x: 1/12 without noise, 0 above
    # half a count of noise.
    squares = (np.arange(1, MAX_HARMONICS + 1) ** 2).reshape(-1, *[1] * np.ndim(variance))
    return np.asarray((np.exp(-4.0 * np.pi**2 * squares * variance) / (2.0 * np.pi**2 * squares)).sum(axis=0))


# --- averages ----------------------------------------------------------------------------------------------


@takes_quantities()
def mean_uncertainty(region: xr.Dataset, dims: Sequence[str] | str | None = None) -> xr.Dataset:
    r"""Mean reflectance over pixels, and its uncertainty.

    Eager: reads the region.

    Parameters
    ----------
    region
        ``reflectance``, ``reflectance_u_random`` and ``reflectance_u_systematic``, as
        ``.paint.reflectance(uncertainty=True)`` adds them, cut to the pixels of interest; NaN in pixels to
        leave out.
    dims
        Dims to average over; by default along_track and cross_track. Their pixels must be next to each other
        in space, in order: the distance of pixels counts.

    Returns
    -------
    Dataset
        On the other dims (mostly band): ``mean`` [1], ``n`` pixels, ``n_eff`` of them independent,
        ``u_random`` and ``u_systematic`` [1], float64 and int64. The attribute ``components`` of both names
        the known components. ``u_systematic`` is NaN where that is "none known", which does not mean that
        there is no such error. Where sources of error can be separated, ``reflectance_errors`` (error_source,
        band) and ``error_correlation`` (lag, band) as well, see `hyperpaint.paints.covariance`.

    Raises
    ------
    SchemaError
        A variable or a dim is missing.

    Notes
    -----
    For a region of a line that still has its calibration, each source of error is propagated by itself. With
    :math:`m` reflectance per count, :math:`x` columns, :math:`l` lines, :math:`s` samples of irradiance, and
    :math:`w_{ls}` their weights,

    .. math:: n^2 u_r^2 = \sum_{lx} u_{r,lx}^2 + \sum_x u_{D,x}^2 \Big(\sum_l m_{lx}\Big)^2
              + \sum_x u_{g,x}^2 \Big(\sum_l \rho_{lx}\Big)^2
              + u_E^2 \sum_s \Big(\sum_{lx} w_{ls} \rho_{lx}\Big)^2

    band by band: noise is independent in every sample, the errors of mean dark and gain are common to an
    element, the noise of irradiance to a sample of it. Several darks enter by their weights; rounding is
    common to a column where noise is less than half a count. :math:`u_s` is the root of the sum of squares of
    the errors that all bands share: gain, irradiance, dark, wavelength, linearity or a panel, and the
    pedestal of each line. Elsewhere

    .. math:: u_r = \sqrt{\overline{u_{r,i}^2} / n_{eff}}, \qquad u_s = \overline{u_{s,i}}, \qquad
              n_{eff} = n^2 \Big/ \sum_{ij} c_{ij}

    with :math:`c_{ij}` the autocorrelation of the pixels at their distance, summed from the centre outwards
    until it is not above zero. A surface's texture counts as correlated noise in it: the region should be
    homogeneous, since a gradient over it leaves few independent pixels. The result is the uncertainty of the
    mean of *these* pixels, not the difference to another part of the surface.

    Examples
    --------
    >>> import xarray as xr
    >>> rng = np.random.default_rng(0)
    >>> pixels = ("along_track", "cross_track")
    >>> region = xr.Dataset({
    ...     "reflectance": (pixels, rng.normal(0.3, 0.01, (20, 30))),
    ...     "reflectance_u_random": (pixels, np.full((20, 30), 0.01)),
    ...     "reflectance_u_systematic": (pixels, np.full((20, 30), 0.006))})
    >>> mean = mean_uncertainty(region)
    >>> print(int(mean.n), f"{float(mean.u_random):.4f} {float(mean.u_systematic):.4f}")
    600 0.0004 0.0060
    """
    mean_dims = [dims] if isinstance(dims, str) else list(dims or (ALONG_TRACK, CROSS_TRACK))
    names = ("reflectance", *UNCERTAINTIES)
    with Problems("a mean with its uncertainty cannot be computed", SchemaError) as problems:
        for name in (name for name in names if name not in region.variables):
            problems.add(
                f"{name!r} is missing",
                mend="add it by .paint.reflectance(uncertainty=True)",
                code="variable-missing",
            )
        for dim in mean_dims:
            problems.add_if(
                dim not in region.dims,
                f"the region has no dim {dim!r}",
                expected=f"some of {', '.join(map(str, region.dims))}",
                code="dim-missing",
            )
    other_dims = [dim for dim in region["reflectance"].dims if dim not in mean_dims]
    cubes = [region[name].transpose(*other_dims, *mean_dims).values.astype(np.float64) for name in names]
    shape = cubes[0].shape[: len(other_dims)]
    value, random, systematic = (cube.reshape(-1, *cube.shape[len(other_dims) :]) for cube in cubes)
    is_valid, pixels = np.isfinite(value), tuple(range(1, value.ndim))
    n = is_valid.sum(axis=pixels)
    divisor = np.where(n > 0, n, np.nan)
    mean, mean_square, mean_systematic = (
        np.where(is_valid, cube, 0.0).sum(axis=pixels) / divisor for cube in (value, random**2, systematic)
    )
    errors = _errors_of(region, mean_dims, cubes)
    # NaN without a known component; arithmetic of xarray may drop the attribute, then all values are zero
    if region[names[2]].attrs.get("components") == NONE_KNOWN or not np.nan_to_num(systematic).any():
        mean_systematic = np.full_like(mean_systematic, np.nan)
    n_effective = np.array([effective_number(plane) for plane in value])
    mean_random = np.sqrt(mean_square / np.where(n > 0, n_effective, np.nan))
    if errors is not None:
        mean_random, mean_systematic = np.where(n > 0, errors.u_random, np.nan), errors.u_systematic
    estimates = {
        "mean": (mean, "Mean reflectance"),
        "n": (n, "Pixels"),
        "n_eff": (n_effective, "Independent pixels"),
        "u_random": (mean_random, "Random uncertainty of the mean"),
        "u_systematic": (mean_systematic, "Systematic uncertainty of the mean"),
    }
    result = xr.Dataset(
        {
            k: (other_dims, v.reshape(shape), {"units": "1", "long_name": text})
            for k, (v, text) in estimates.items()
        },
        {name: c for name, c in region["reflectance"].coords.items() if set(c.dims) <= set(other_dims)},
    )
    if errors is not None:
        result["u_random"].attrs["components"], result["u_systematic"].attrs["components"] = errors.components
        return result.assign(
            {
                name: array.isel({SIGNATURE: 0}, drop=True) if SIGNATURE in array.dims else array
                for name, array in error_variables([errors]).items()
            }
        )
    for name, source in zip(("u_random", "u_systematic"), names[1:], strict=True):
        if "components" in region[source].attrs:
            result[name].attrs["components"] = region[source].attrs["components"]
    return result


def _errors_of(region: xr.Dataset, mean_dims: Sequence[str], cubes: Sequence[Floats]) -> "MeanErrors | None":
    # Return the errors of the mean by source; None where they cannot be separated.
    if set(mean_dims) != {ALONG_TRACK, CROSS_TRACK} or set(region["reflectance"].dims) != set(CUBE):
        return None
    if (line := line_errors(region)) is None:
        return None
    order = [mean_dims.index(dim) for dim in (ALONG_TRACK, CROSS_TRACK)]
    value, random = (cube.transpose(0, *(1 + axis for axis in order)) for cube in cubes[:2])
    along, across = (axis.ravel() for axis in np.indices(value.shape[1:]))
    sums = RegionSums(line, along, across)
    for band in range(len(value)):
        sums.add(band, value[band].ravel(), random[band].ravel())
    return sums.errors()


def effective_number(plane: Floats) -> float:
    # Return the number of independent values equivalent to the values of a grid; NaN is ignored.
    is_valid = np.isfinite(plane)
    n = int(is_valid.sum())
    if n < 3:
        return float(n)
    departure = np.where(is_valid, plane - plane[is_valid].mean(), 0.0)
    if not departure.any():
        return float(n)
    size, axes = [2 * length for length in plane.shape], range(plane.ndim)

    def correlate(values: Floats) -> Floats:
        return np.asarray(np.fft.irfftn(np.abs(np.fft.rfftn(values, size, axes)) ** 2, size, axes))

    # number and product of pairs by their distance in rings
    pairs, products = np.rint(correlate(is_valid.astype(np.float64))), correlate(departure)
    distances = [np.minimum(np.arange(length), length - np.arange(length)) for length in size]
    ring_of_pair = np.maximum.reduce(np.meshgrid(*distances, indexing="ij"))
    count = np.bincount(ring_of_pair.ravel(), pairs.ravel())
    total = np.bincount(ring_of_pair.ravel(), products.ravel()) / (products.flat[0] / n)
    # subtracting the mean adds -1/n to every pair
    correlation = (total + count / n) / np.maximum(count, 1.0)
    # every pair is counted twice
    is_correlated = (correlation > 2.0 / np.sqrt(np.maximum(count / 2.0, 1.0))) & (count > 0)
    is_correlated[0] = True
    reach = int(np.argmin(is_correlated)) if not is_correlated.all() else is_correlated.size
    excess = float((correlation[1:reach] * count[1:reach]).sum()) / n
    return float(np.clip(n / (1.0 + excess), 1.0, n))


# --- propagate the errors of a line to the mean over a region, and their correlation between ---------------


#: Smallest correlation of two bands that is stored [1].
MIN_CORRELATION = 0.01
#: Largest distance of two bands whose correlation is stored [band].
MAX_LAGS = 48


class MeanErrors(NamedTuple):
    # Errors of a mean spectrum.
    sources: tuple[str, ...]  #: Known sources of `FORMS`
    #: (source, band) float64: standard uncertainty by source; signed where all bands share the error
    sizes: Floats
    u_random: Floats  #: (band,) float64: uncertainty by errors that bands do not share
    #: (lag, band) float32: correlation of the random error with the band `lag` bands later; NaN beyond the
    #: last
    correlation: Array

    @property
    def components(self) -> tuple[str, str]:
        # Names of the variables of the random and of the systematic uncertainty.
        names: list[list[str]] = [[], []]
        for source, is_shared in zip(self.sources, self.systematic, strict=True):
            names[int(is_shared)] += COMPONENTS[source]
        return ", ".join(names[0]) or NONE_KNOWN, ", ".join(names[1]) or NONE_KNOWN

    @property
    def systematic(self) -> Array:
        # Whether all bands share the error of a source (source,).
        return np.array([FORMS[name].band == "systematic" for name in self.sources], bool)

    @property
    def u_systematic(self) -> Floats:
        # Uncertainty by errors that all bands share (band,); NaN without known errors.
        return (
            np.full(self.sizes.shape[1], np.nan)
            if not self.systematic.any()
            else np.asarray(np.sqrt((self.sizes[self.systematic] ** 2).sum(axis=0)))
        )


def error_variables(errors: Sequence[MeanErrors | None]) -> dict[str, xr.DataArray]:
    # Return the errors of several means of the same bands as library variables; {} without errors.
    available = [mean for mean in errors if mean is not None]
    if not available:
        return {}
    sources = [name for name in FORMS if any(name in mean.sources for mean in available)]
    bands = available[0].sizes.shape[1]
    sizes = np.full((len(errors), len(sources), bands), np.nan)
    lags = np.zeros((len(errors), max(len(mean.correlation) for mean in available), bands), np.float32)
    for number, mean in enumerate(errors):
        if mean is None:
            lags[number] = np.nan
            continue
        sizes[number] = 0.0
        sizes[number, [sources.index(name) for name in mean.sources]] = mean.sizes
        lags[number, : len(mean.correlation)] = mean.correlation
    values = {
        "error_source": np.array(sources, object),
        "error_form": np.array([str(FORMS[name]) for name in sources], object),
        "reflectance_errors": sizes.astype(np.float32),
        "error_correlation": lags,
        "lag": np.arange(lags.shape[1]),
    }
    specs = {name: LIBRARY_VARIABLES[name] for name in values}
    variables = {
        name: xr.DataArray(values[name], dims=spec.dims, attrs=spec.attrs) for name, spec in specs.items()
    }
    variables["error_correlation"].attrs["bands"] = bands
    return variables


class RegionSums:
    # Sums over a region's pixels, from which the errors of its mean follow.
    def __init__(self, line: LineErrors, along: Array, across: Array) -> None:
        # Start empty; ``along`` and ``across`` (pixel,) are the pixels' lines and columns.
        self._line = line
        self._rows, self._row_of_pixel = np.unique(along, return_inverse=True)
        self._columns, self._column_of_pixel = np.unique(across, return_inverse=True)
        bands, darks = line.dark.shape[0], line.dark_weights.shape[1]
        shape = (bands, self._columns.size)
        self._counts_of_pixels, self._variance_sums, self._value_sums = np.zeros((3, *shape))
        self._per_count_sums = np.zeros((darks, *shape))
        self._pedestal_sums = np.zeros(bands)
        self._sample_of_line: Array = np.zeros((2, 0), np.int64)
        if line.light is not None and line.light.covariance.any():
            neighbours = np.stack([line.light.before[self._rows], line.light.after[self._rows]])
            self._sample_of_line = np.unique(neighbours, return_inverse=True)[1].reshape(neighbours.shape)
        self._light_sums = np.zeros((int(self._sample_of_line.max(initial=-1)) + 1, bands))

    def add(self, band: int, reflectance: Array, u_random: Array) -> None:
        # Add a band of all pixels (pixel,): measured reflectance, and its noise.
        line, column = self._line, self._column_of_pixel
        is_valid = np.isfinite(reflectance) & np.isfinite(u_random)
        value = np.where(is_valid, reflectance, 0.0).astype(np.float64)
        variance = np.where(is_valid, u_random, 0.0).astype(np.float64) ** 2
        per_electron, noise_floor = (
            table[band, self._columns][column] for table in (line.per_electron, line.noise_floor)
        )
        # variance = m^2 (value / (m k) + floor), solved for m, reflectance per count, without cancellation
        shot = np.maximum(value, 0.0) * per_electron
        root = shot + np.sqrt(shot**2 + 4.0 * noise_floor * variance)
        per_count = np.divide(2.0 * variance, root, out=np.zeros_like(root), where=root > 0)

        def of_columns(values: Floats) -> Floats:
            return np.asarray(np.bincount(column, values, self._columns.size), np.float64)

        self._counts_of_pixels[band] = of_columns(is_valid.astype(np.float64))
        self._variance_sums[band] = of_columns(variance)
        self._value_sums[band] = of_columns(value)
        for dark, share in enumerate(line.dark_weights[self._rows].T):
            self._per_count_sums[dark, band] = of_columns(per_count * share[self._row_of_pixel])
        if line.pedestal_variance:
            self._pedestal_sums[band] = (np.bincount(self._row_of_pixel, per_count) ** 2).sum()
        if len(self._light_sums) and line.light is not None:
            sums = np.bincount(self._row_of_pixel, value, self._rows.size)
            weight = line.light.weight[self._rows]
            for sample_numbers, share in zip(self._sample_of_line, (1.0 - weight, weight), strict=True):
                np.add.at(self._light_sums[:, band], sample_numbers, share * sums)

    def errors(self, axis: NominalAxis | None = None, smoothing: Array | None = None) -> MeanErrors:
        # Return the errors of the mean, interpolated to nominal wavelengths and smoothed like its pixels.
        #
        # ``smoothing`` (band, band): matrix that spectra are multiplied by; NaN for bands without a value.
        line, columns = self._line, self._columns
        bands = len(self._counts_of_pixels)
        # The matrix from flattened spectra of columns (band, column) to nominal wavelengths (band,).
        flat_index = np.arange(bands * columns.size).reshape(bands, columns.size)
        band = np.broadcast_to(np.arange(bands)[:, None], flat_index.shape)
        if axis is None:
            averaging = sparse.csr_array(
                (np.ones(flat_index.size), (band.ravel(), flat_index.ravel())), (bands, flat_index.size)
            )
        else:
            weights = np.nan_to_num(axis.weights[:, columns].astype(np.float64))
            tap_bands = axis.first[:, columns, None] + np.arange(weights.shape[2])
            source = flat_index[tap_bands, np.arange(columns.size)[None, :, None]]
            rows = np.broadcast_to(band[..., None], weights.shape)
            averaging = sparse.csr_array(
                (weights.ravel(), (rows.ravel(), source.ravel())), (bands, flat_index.size)
            )
        count = averaging @ self._counts_of_pixels.ravel()
        with np.errstate(invalid="ignore", divide="ignore"):
            share = np.where(count > 0.5, 1.0 / count, np.nan)

        def mean(table: Floats) -> Floats:
            return np.asarray(averaging @ np.nan_to_num(table).ravel()) * share

        def independent(table: Floats) -> Floats:
            square = averaging.multiply(np.nan_to_num(table).ravel()) @ averaging.T
            return np.asarray(square.toarray() * share * share[:, None])

        level, per_count = mean(self._value_sums), self._per_count_sums.sum(axis=0)
        dark = line.dark[:, columns]
        covariances = {"noise": independent(self._variance_sums)}
        dark_variance = (self._per_count_sums**2).sum(axis=0) * dark**2
        if line.is_integer:
            # rounding, in sums over the lines of a column
            read = line.read_noise[:, columns] ** 2
            with np.errstate(invalid="ignore", divide="ignore"):
                counts = np.nan_to_num(np.maximum(self._value_sums, 0.0) / per_count)
            with_shot = rounding_variance(read + counts * line.per_electron[:, columns])
            dark_variance += per_count**2 * (rounding_variance(read) * (dark > 0) + with_shot)
        if dark_variance.any():
            covariances["mean dark"] = independent(dark_variance)
        if line.gain_of_elements.any():
            covariances["gain of elements"] = independent(
                (self._value_sums * line.gain_of_elements[:, columns]) ** 2
            )
        if len(self._light_sums) and line.light is not None:
            with np.errstate(
                invalid="ignore", divide="ignore"
            ):  # part of the mean by every irradiance sample
                samples = np.nan_to_num(self._light_sums / self._value_sums.sum(axis=1) * level)
            covariances["irradiance noise"] = (samples.T @ samples) * line.light.covariance
        shared_errors = {
            name: mean(self._value_sums * relative[:, columns]) for name, relative in line.common.items()
        }
        if line.pedestal_variance:
            shared_errors["pedestal"] = np.sqrt(self._pedestal_sums * line.pedestal_variance) / np.maximum(
                self._counts_of_pixels.sum(axis=1), 1
            )
        if line.dark_offset.any():
            shared_errors["dark"] = mean(per_count * line.dark_offset[:, columns])
        if line.wavelength_u.any() and line.light is not None:
            # change of a mean by an error of the wavelength scale (band,)
            light = line.light.level
            steps = band_steps(line.wavelength)
            with np.errstate(invalid="ignore", divide="ignore"):
                radiance = level * light
                rise = np.append(np.diff(radiance), np.nan) / light
                fall = np.insert(np.diff(radiance), 0, np.nan) / light
            to_above = np.where(np.isfinite(fall), steps[:, 0], steps[:, 1])
            to_below = np.where(np.isfinite(rise), steps[:, 2], steps[:, 3])
            shared_errors["wavelength"] = np.asarray(
                (np.nan_to_num(rise) * to_above + np.nan_to_num(fall) * to_below) * line.wavelength_u
            )
        if line.stray_light is not None:
            counts = np.divide(self._value_sums, per_count, out=np.zeros_like(per_count), where=per_count > 0)
            shared_errors["stray light"] = mean(per_count * (line.stray_light @ counts))
        if smoothing is not None:
            smoothing_matrix = np.nan_to_num(smoothing)
            covariances = {
                name: smoothing_matrix @ np.nan_to_num(square) @ smoothing_matrix.T
                for name, square in covariances.items()
            }
            shared_errors = {
                name: smoothing_matrix @ np.nan_to_num(size) for name, size in shared_errors.items()
            }
        sizes = {name: np.sqrt(np.diagonal(square)) for name, square in covariances.items()} | shared_errors
        names = tuple(name for name in FORMS if name in sizes)
        total = np.sum(list(covariances.values()), axis=0)
        # standard deviations (band,) and correlations (lag, band) up to the last significant lag.
        sd = np.sqrt(np.diagonal(total))
        lags = np.full((min(MAX_LAGS, bands), bands), np.nan, np.float32)
        with np.errstate(invalid="ignore", divide="ignore"):
            for lag in range(len(lags)):
                lags[lag, : bands - lag] = np.diagonal(total, lag) / (sd[: bands - lag] * sd[lag:])
        significant = np.flatnonzero((np.nan_to_num(np.abs(lags)) > MIN_CORRELATION).any(axis=1))
        return MeanErrors(
            names, np.array([sizes[name] for name in names]), *(sd, lags[: significant.max(initial=0) + 1])
        )
