"""Estimate the noise of a camera from its own counts: photon transfer.

A count of signal S above the dark varies by

    var(C) = S / k + sigma_r^2 + 1/12    [count2]

with k electrons a count, sigma_r the read noise and 1/12 for whole counts. Variances against signals, of
repeated frames or of a flight's homogeneous blocks, lie on a straight line whose slope and intercept are
properties of the camera.
"""

import warnings
from dataclasses import dataclass

import numpy as np
import xarray as xr

from hyperpaint.base import (
    ALONG_TRACK,
    BAND,
    CROSS_TRACK,
    IRRADIANCE_TIME,
    IRRADIANCE_WAVELENGTH,
    QUANTISATION_VARIANCE_COUNT2,
    SATURATION_MARGIN_COUNTS,
    STEP,
    SWEEP_VARIABLES,
    Array,
    Bools,
    Floats,
    Ints,
    Problem,
    Problems,
    SchemaError,
    label,
    rename_to_roles,
    require,
    warn_user,
)
from hyperpaint.light.illumination import noise_of_record

#: Lines of a block, in which a column should show a single surface.
BLOCK_LINES = 8
#: Maximum number of samples read from a flight; more do not improve the estimate.
MAX_SAMPLES = 3_000_000
#: Minimum signal in spreads of a dark count [1], at which the mean of a block is accurate to 3 %.
MIN_SIGNAL_SD = 12.0
#: Largest change of brightness by texture [1]; larger changes are edges or glint.
MAX_TEXTURE = 0.15
MIN_VARIANCES = 200
_BINS = 24
#: Groups of blocks of the jackknife.
_JACKKNIFE_GROUPS = 16
#: Share of the variances that is used; the highest are left out [1].
USED_SHARE = 0.999
#: Largest excess variation of a block over noise [standard deviations].
MAX_BLOCK_SD = 4.0
#: Largest relative uncertainty of electrons per count [1].
MAX_RELATIVE_U = 0.1
#: Largest relative departure of variances from the straight line [1].
MAX_MISFIT = 0.1
#: Relative noise of a record above the rounding of float32 [1].
MIN_RECORD_NOISE = 1e-5


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
        points, floor, source = _sweep_points(dataset)
    else:
        dataset = rename_to_roles(dataset)
        points, floor, source = _line_points(dataset, repeated)
    estimate = _labelled(_fit_transfer(points), points, floor, source)
    if {"irradiance", IRRADIANCE_TIME} <= set(dataset.variables):
        record = require(dataset, ["irradiance", IRRADIANCE_TIME], "noise of irradiance")
        noise = noise_of_record(record["irradiance"].values, record[IRRADIANCE_TIME].values)
        if noise is not None and noise.max() > MIN_RECORD_NOISE:
            array = xr.DataArray(noise.astype(np.float32), dims=IRRADIANCE_WAVELENGTH)
            estimate["irradiance_u_random"] = label(array, "irradiance_u_random")
    return estimate


# --- gathering variances


def _sweep_points(dataset: xr.Dataset) -> tuple[_VariancePoints, float, str]:
    names = ["counts", "counts_variance", "dark_counts", "frame_count"]
    names += ["saturation_count"] if "saturation_count" in dataset.variables else []
    arrays = require(dataset, names, "photon transfer of a sweep", SWEEP_VARIABLES)
    dims = (STEP, BAND, CROSS_TRACK)
    counts = arrays["counts"].transpose(*dims)
    signal = (counts - arrays["dark_counts"]).transpose(*dims).values.astype(np.float64)
    variance = arrays["counts_variance"].transpose(*dims).values.astype(np.float64)
    frames = arrays["frame_count"].values.astype(np.float64)
    if (frames < 2).any():
        raise SchemaError(
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
    points = _VariancePoints(_by_band(variance), _by_band(signal), np.ones((len(freedom), bands)), freedom)
    return points, QUANTISATION_VARIANCE_COUNT2, f"{len(signal)} steps of {frames.min():g} frames or more"


def _line_points(dataset: xr.Dataset, repeated: bool) -> tuple[_VariancePoints, float, str]:
    names = ["counts", "dark_counts"]
    names += [n for n in ("saturation_count", "radiance_gain", "time") if n in dataset.variables]
    arrays = require(dataset, names, "photon transfer of a line")
    counts, dark = arrays["counts"], arrays["dark_counts"]
    if "dark_time" in dark.dims:
        dark = dark.mean("dark_time")
    starts = _block_starts(counts.shape)
    lines = (starts[:, None] + np.arange(BLOCK_LINES)).ravel()
    blocks = counts.isel({ALONG_TRACK: lines}).values
    has_time = np.ones(blocks.shape[:1], bool)
    if "time" in arrays:
        has_time = ~np.isnat(arrays["time"].isel({ALONG_TRACK: lines}).values)
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
        points, source = _block_points(block_cube), "blocks of a flight, texture taken out over bands"
    quantisation = QUANTISATION_VARIANCE_COUNT2 if is_integer else 0.0
    return points, quantisation, f"{len(starts)} x {BLOCK_LINES} lines: {source}"


def _block_starts(shape: tuple[int, ...]) -> Ints:
    lines, bands, columns = shape
    Problems("noise cannot be estimated", SchemaError).raise_if_any(
        (
            lines < BLOCK_LINES,
            Problem(f"{lines} lines", expected=f"{BLOCK_LINES} or more", code="lines-too-few"),
        ),
        (
            bands < 3,
            Problem(f"{bands} bands", expected="3 or more, next to each other", code="bands-too-few"),
        ),
    )
    blocks = lines // BLOCK_LINES
    sampled = min(blocks, max(4, MAX_SAMPLES // (BLOCK_LINES * bands * columns)))
    return np.unique(np.linspace(0, blocks - 1, sampled).astype(np.int64)) * BLOCK_LINES


def _by_band(array: Array) -> Array:
    # Return values (block, band, column) as (block x column, band).
    return np.moveaxis(array, 1, 2).reshape(-1, array.shape[1])


def _block_points(cube: Array) -> _VariancePoints:
    # Return variances (block x column, band) of bands relative to their neighbours.
    # `cube` is (block, line, band, column). Bands whose signal is uncertain by noise are left out.
    mean = cube.mean(axis=1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # columns without a value
        total = np.nansum(np.where(np.isfinite(mean)[:, None], cube, np.nan), axis=2)
        is_even = np.abs(total / total.mean(axis=1, keepdims=True) - 1.0).max(axis=1) < MAX_TEXTURE
    mean[~(is_even[:, None] & (mean > 0))] = np.nan
    # spread of a count in the darkest tenth of the samples [count]
    valid, dark_noise = np.isfinite(mean), 0.0
    if valid.any():
        is_darkest = valid & (mean <= np.quantile(mean[valid], 0.1))
        dark_noise = float(np.sqrt(np.median(cube.var(axis=1, ddof=1)[is_darkest])))
    mean[mean < MIN_SIGNAL_SD * dark_noise] = np.nan
    # contrast of a band with its neighbours, relative to their signals
    relative = (cube - mean[:, None]) / mean[:, None]
    mean_inside = mean[:, 1:-1]
    contrast = relative[:, :, 1:-1] - 0.5 * (relative[:, :, :-2] + relative[:, :, 2:])
    freedom = cube.shape[1] - 1.0
    variance = mean_inside**2 * (contrast**2).sum(axis=1) / np.float32(freedom)
    ratios = [(mean_inside / neighbour).astype(np.float64) for neighbour in (mean[:, :-2], mean[:, 2:])]
    is_similar = np.ones(mean_inside.shape, bool)
    for ratio in ratios:
        # noise of a much weaker neighbour would exceed noise of the band
        is_similar &= (ratio > 0.5) & (ratio < 2.0)
    by_signal = mean_inside * (1.0 + 0.25 * (ratios[0] + ratios[1]))
    values = (
        np.where(is_similar, variance, np.nan),
        by_signal,
        1.0 + 0.25 * (ratios[0] ** 2 + ratios[1] ** 2),
    )
    variances, signals, floors = (_by_band(array).astype(np.float64) for array in values)
    return _VariancePoints(variances, signals, floors, np.full((1, 1), freedom))


# --- fitting the line


def _fit_transfer(points: _VariancePoints) -> tuple[float, float, Floats, Bools]:
    # Return slope and intercept of the photon transfer, their covariance, and which points are used.
    from scipy.stats import chi2

    is_valid = np.isfinite(points.variance) & np.isfinite(points.by_signal)
    SchemaError.raise_if(
        is_valid.sum() < MIN_VARIANCES,
        f"noise cannot be estimated from {is_valid.sum()} variances",
        expected=f"{MIN_VARIANCES} or more",
        code="noise-not-estimable",
    )
    slope, height = _first_guess(points, is_valid, np.broadcast_to(points.freedom, is_valid.shape))
    edge = chi2.ppf(USED_SHARE, points.freedom) / points.freedom
    # mean of the values below the edge relative to the mean of all values
    truncated_mean = chi2.cdf(edge * points.freedom, points.freedom + 2.0) / USED_SHARE
    # neighbouring bands share two thirds of their contrast
    spread = np.sqrt(2.0 * 1.94 / (points.freedom[:, 0] * np.maximum(is_valid.sum(axis=1), 1)))
    is_used = is_valid
    for _ in range(8):
        model = np.maximum(slope * points.by_signal + height * points.by_floor, 1e-6)
        ratio = np.where(is_valid, points.variance / model, np.nan)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # blocks without a value
            block_ratio = np.nanmean(np.minimum(ratio, 2.0 * edge), axis=1)
        is_used = is_valid & (block_ratio < 1.0 + MAX_BLOCK_SD * spread)[:, None] & (ratio < edge)
        SchemaError.raise_if(
            is_used.sum() < MIN_VARIANCES,
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
        not (slope > 0 and error / max(slope, 1e-300) < MAX_RELATIVE_U),
        f"electrons per count are uncertain: signals of {low:.0f} to {high:.0f} counts give a slope of "
        f"{slope:.3g} +- {error:.2g} counts of variance a count",
        mend="take a line with dark and bright surfaces, or repeated frames of several levels",
        code="electrons-uncertain",
    )
    return slope, height, covariance, is_used


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
    if slope <= 0 or height < 0:
        return float(np.median(y / np.maximum(x, 1.0))), 0.0
    return float(slope), float(height)


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
    expected = np.maximum(slope * signal + height, 1e-9)
    misfit = float(np.max(np.abs(variance / expected - 1.0)))
    misfit_sd = np.sqrt(4.0 / (float(points.freedom.mean()) * is_used.sum() / variance.size))
    if misfit > MAX_MISFIT + 4.0 * misfit_sd:
        warn_user(
            f"variances depart from a straight line by up to {misfit:.0%}: the scene is not homogeneous "
            "within blocks, or the light flickers; check 'transfer_variance'",
            "transfer-misfit",
        )
    noise = float(np.sqrt(max(height - quantisation, 0.0)))
    # at zero noise, only the variance has an uncertainty
    noise_u = float(np.sqrt(covariance[1, 1])) / (2.0 * noise) if noise > 0 else np.nan
    limit = float(covariance[1, 1]) ** 0.25
    values = {
        "electrons_per_count": 1.0 / slope,
        "read_noise": noise,
        "electrons_per_count_u": float(np.sqrt(covariance[0, 0])) / slope**2,
        "read_noise_u": float(np.nanmin([noise_u, limit])),
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
