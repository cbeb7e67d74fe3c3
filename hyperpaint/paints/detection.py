"""Detection of paints in an image: scores, thresholds at a stated false-alarm rate, regions.

Reflectance and a paint library come in, detections go out. For pictures, the accessor and the command line.
"""

import functools
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any, NamedTuple

import dask
import dask.array as da
import numpy as np
import xarray as xr
from dask._task_spec import DataNode, Task, TaskRef, convert_legacy_graph
from dask.highlevelgraph import HighLevelGraph
from scipy.linalg import solve_triangular

from hyperpaint.base import (
    ALONG_TRACK,
    BAND,
    CHUNK_LINES,
    CROSS_TRACK,
    CUBE,
    LIBRARY_VARIABLES,
    SIGNATURE,
    Array,
    Bools,
    Floats,
    Ints,
    Problems,
    Quality,
    SchemaError,
    one_of,
    schema,
    takes_quantities,
    warn_if,
)
from hyperpaint.base.many_outputs import split_outputs
from hyperpaint.io.library.spectra_files import warn_of_scale
from hyperpaint.paints.paint_libraries import MIN_BANDS, interpolated, starter_library
from hyperpaint.paints.signatures import EXCLUDED
from hyperpaint.paints.signatures.line_sources import lines_of
from hyperpaint.radiometry import to_nominal
from hyperpaint.regions import pixels_of, region_mask
from hyperpaint.regions.polygons import regions_from
from hyperpaint.surroundings.corrections import has_split, relative_sky, split_of

# --- scores of spectra for paints, and distances from paints: plain arrays, float64 ------------------------

METHODS = ("ace", "matched_filter", "spectral_angle")


class Projection(NamedTuple):
    # Linear transform of spectra before their comparison, z = (x - offset) matrix.
    offset: Floats  #: (band,)
    matrix: Floats  #: (band, band): Whitens spectra, and projects the mirrored sky out.
    targets: Floats  #: (signature, band): Transformed paints.


def projection(
    paints: Floats, sky: Floats | None, mean: Floats | None = None, covariance: Floats | None = None
) -> Projection:
    # Return the projection of a detector.
    #
    # ``paints`` (signature, band): Reflectance. ``sky`` (band,), or None: Spectrum of the mirrored sky, which
    # is projected out; None to keep it. ``mean``, ``covariance`` (band,), (band, band): Statistics of the
    # background; None for the spectral angle, which does not use them.
    offset = np.zeros(paints.shape[1]) if mean is None else mean
    # with covariance = L L', z = L^-1 (x - mean) has unit covariance
    matrix = whitening = np.eye(paints.shape[1])
    if covariance is not None:
        matrix = whitening = solve_triangular(np.linalg.cholesky(covariance), whitening, lower=True).T
    if sky is not None:
        direction = sky @ whitening
        direction /= np.linalg.norm(direction)
        matrix = whitening - np.outer(whitening @ direction, direction)
    return Projection(offset, np.ascontiguousarray(matrix), (paints - offset) @ matrix)


def scores(spectra: Floats, project: Projection, method: str) -> Floats:
    # Return the scores (spectrum, signature) of spectra (spectrum, band), by one of `METHODS`.
    #
    # With z and t the projected spectrum and paint: ACE is (z't)^2 / (z'z t't) with the sign of z't, the
    # matched filter z't / t't, the spectral angle's cosine z't / sqrt(z'z t't); 0 where z is zero.
    z = (spectra - project.offset) @ project.matrix
    product = z @ project.targets.T
    target_square = np.einsum("kb,kb->k", project.targets, project.targets)
    if method == "matched_filter":
        return np.asarray(product / target_square)
    length = np.sqrt(np.einsum("nb,nb->n", z, z)[:, None] * target_square)
    cosine = np.divide(product, length, out=np.zeros_like(product), where=length > 0.0)
    return np.asarray(cosine * np.abs(cosine) if method == "ace" else cosine)


def distances(spectra: Floats, paints: Floats, sky: Floats | None) -> tuple[Array, Array]:
    # Return distance and level of spectra (spectrum, band) for each paint (signature, band).
    #
    # A least-squares fit x = a t + m sky + r of paint t and sky gives the level a and the distance
    # |r| / |a t|, infinite where a is not positive. Both are (spectrum, signature) [1].
    product, square = spectra @ paints.T, np.einsum("nb,nb->n", spectra, spectra)
    paint_square = full_paint_square = np.einsum("kb,kb->k", paints, paints)
    if sky is not None:
        # products of the components orthogonal to the sky
        unit = sky / np.linalg.norm(sky)
        paint_sky, spectrum_sky = paints @ unit, spectra @ unit
        product = product - np.outer(spectrum_sky, paint_sky)
        square, paint_square = square - spectrum_sky**2, paint_square - paint_sky**2
    with np.errstate(invalid="ignore", divide="ignore"):
        level = product / paint_square
        residual = np.sqrt(np.maximum(square[:, None] - product * level, 0.0))
        distance = np.where(level > 0.0, residual / (level * np.sqrt(full_paint_square)), np.inf)
    return distance, level


# --- statistics of the background, and thresholds for a given false-alarm rate -----------------------------


#: Thresholds of detection.
DETECTION = SimpleNamespace(
    # Maximum memory of the sample of pixels for thresholds [byte]: 123,000 pixels of 272 bands.
    sample_bytes=2**27,
    # Minimum level of a pixel of a paint [1], on a body part turned away from a high sun: below, dark glass
    # would be taken for black paint.
    min_level=0.25,
    # Maximum level of a pixel of a paint [1], on a body part turned towards a low sun: beyond, any
    # proportional spectrum would be taken for the paint.
    max_level=2.5,
    # Distance caused by noise alone, at a signal-to-noise ratio of 100 [1].
    min_distance=0.01,
    # Factor of ``unknown_rate`` for the distance limit within which pixels are excluded from the background
    # as possible target pixels [1]: half of a car's pixels lie beyond the limit for detections.
    target_rate_ratio=10.0,
    # Share of these pixels over the false-alarm rate above which a warning is given [1].
    explained_ratio=10.0,
    # Number of parts of the line for the cross-check of thresholds.
    folds=8,
    # Minimum number of sample pixels above a threshold: fewer do not determine a rate.
    min_alarms=5.0,
)


#: Number of sample pixels processed together.
PIXELS_AT_ONCE = 4096


class Background(NamedTuple):
    # Sums over the valid pixels of some blocks of lines, and a sample of these pixels.
    pixels: int  #: Number of valid pixels.
    total: Floats  #: (band,): Sum of spectra.
    products: Floats  #: (band, band): Sum of products of two bands.
    sample: Array  #: (pixel, band), float32: Spectra of the sample.
    block: Ints  #: (pixel,): Number of the block of a sample pixel.


def block_background(cube: Array, mask: Bools, bands: Ints, number: int, size: int) -> Background:
    # Return the background of a block (line, band, column), on some bands, in a mask (line, column).
    #
    # Pixels with values in all these bands are valid. The sample consists of the valid ones of ``size``
    # pixels drawn at random; the seed is the block's number.
    cube = cube[:, bands]
    is_valid = mask & np.isfinite(cube).all(axis=1)
    lines, _, columns = cube.shape
    total, products = np.zeros(bands.size), np.zeros((bands.size, bands.size))
    for line, valid in zip(cube, is_valid, strict=True):
        # zeros instead of a selection: products of equal shape have the same bits in any block
        spectra = np.where(valid, line, 0.0).astype(np.float64)
        total += spectra.sum(axis=1)
        products += spectra @ spectra.T
    drawn = np.sort(np.random.default_rng([number, 20]).permutation(lines * columns)[:size])
    pixel = drawn[is_valid.ravel()[drawn]]
    sample = np.ascontiguousarray(cube[pixel // columns, :, pixel % columns], np.float32)
    return Background(int(is_valid.sum()), total, products, sample, np.full(pixel.size, number, np.int64))


def joined_backgrounds(backgrounds: Sequence[Background]) -> Background:
    # Return the background of several groups of blocks, summed in their order.
    pixels, total, products, *samples = zip(*backgrounds, strict=True)
    # sums from 0.0 on, in order: the same bits in any grouping of blocks
    sums = (functools.reduce(np.add, arrays, np.zeros_like(arrays[0])) for arrays in (total, products))
    return Background(sum(pixels), *sums, *(np.concatenate(arrays) for arrays in samples))


class Detector(NamedTuple):
    # Paints, transform and thresholds for the search of a block.
    method: str
    bands: Ints  #: Indices of the compared bands in the cube.
    paints: Floats  #: (signature, band): Reflectance of the paints.
    sky: Floats | None  #: (band,): Spectrum of the mirrored sky.
    project: Projection
    median_score: Floats  #: (signature,): Median score of the background.
    threshold: Floats  #: (signature,): Score threshold.
    distance_limit: Floats  #: (signature,)
    checked_rate: float  #: Share of alarms in parts of the line under thresholds from the other parts.
    checked_rate_u: float  #: Half of its 95 % interval.
    explained_share: float  #: Share of pixels excluded from the background since a paint explains them.


def _is_near(distance: Array, level: Array, limit: Floats) -> Bools:
    # Whether each paint explains spectra (spectrum, signature)
    return np.asarray((distance <= limit) & ((level >= DETECTION.min_level) & (level <= DETECTION.max_level)))


def make_detector(
    background: Background,
    bands: Ints,
    paints: Floats,
    sky: Floats | None,
    other_paints: Floats,
    *,
    method: str,
    rate: float,
    unknown_rate: float,
    shrinkage: float,
    has_targets: bool,
) -> Detector:
    # Return the detector for a line, from the background of the complete line.
    #
    # Takes ``bands``: indices of the compared bands in the cube; on these bands, ``paints`` (signature,
    # band), ``sky`` (band,) and ``other_paints`` (spectrum, band), spectra of paints that are not searched
    # for; ``rate``: rate of false alarms; ``has_targets``: whether the paints may be among the background
    # pixels; further settings as of `detect`. Raises `SchemaError`: too few pixels. Warns where paints
    # explain many pixels, which are excluded from the background.
    SchemaError.raise_if(
        not background.pixels,
        f"the line has no background pixel without flags and with values in all {bands.size} bands",
        mend="pass exclude= with fewer flags, or set 'good' to False in bands without values",
        option="give --keep with flags",
        code="background-empty",
    )
    SchemaError.raise_if(
        background.pixels <= bands.size,
        f"{background.pixels} valid pixels for the covariance of {bands.size} bands",
        expected="more pixels than bands",
        mend="use a longer line, fewer bands, or exclude= with fewer flags",
        code="background-too-small",
    )
    mean = background.total / background.pixels
    covariance = background.products - background.pixels * np.outer(mean, mean)
    covariance = covariance / (background.pixels - 1)
    shrunk = (1.0 - shrinkage) * covariance + shrinkage * np.diag(np.diag(covariance))
    with SchemaError.instead_of(
        np.linalg.LinAlgError,
        "the covariance of the background is singular: some bands depend linearly on others",
        mend="raise shrinkage=, such as to 0.001, or set 'good' to False in interpolated bands",
        option="give --shrinkage 0.001",
        code="covariance-singular",
    ):
        project = (
            projection(paints, sky) if method == "spectral_angle" else projection(paints, sky, mean, shrunk)
        )
    other_distances = distances(other_paints, paints, sky)
    limit = distance_limits(other_distances, unknown_rate)
    # pixels that a paint explains may show this paint: exclude them from the background
    exclusion_limit = (
        distance_limits(other_distances, min(DETECTION.target_rate_ratio * unknown_rate, 0.5))
        if has_targets and unknown_rate < 1.0
        else np.full(len(paints), -1.0)
    )
    sample = background.sample
    is_background, values = np.ones(len(sample), bool), np.empty((len(sample), len(paints)))
    for start in range(0, len(values), PIXELS_AT_ONCE):
        batch = slice(start, start + PIXELS_AT_ONCE)
        spectra = sample[batch].astype(np.float64)
        is_background[batch] = ~_is_near(*distances(spectra, paints, sky), exclusion_limit).any(axis=1)
        values[batch] = scores(spectra, project, method)
    explained = 1.0 - float(is_background.sum() / max(1, is_background.size))
    warn_if(
        explained > DETECTION.explained_ratio * rate,
        f"{100.0 * explained:.2g} % of the pixels resemble the paints and were excluded from the "
        f"background: false_alarm_rate={rate:g} holds for the other pixels only; if some "
        "of these pixels show other objects, pass background= (--background) with similar pixels "
        "that show no paint of the library",
        "background-resembles-paints",
    )
    values = values[is_background]
    threshold = _score_thresholds(values, rate)
    checked_rate, checked_rate_u = _checked_rate(values, background.block[is_background], rate)
    return Detector(
        method,
        bands,
        paints,
        sky,
        project,
        np.median(values, axis=0),
        threshold,
        limit,
        checked_rate,
        checked_rate_u,
        explained,
    )


def _joint_rank(ranks: Ints, allowed: float) -> int:
    # Maximum rank such that at most `allowed` rows have this rank or a better one for any paint.
    # Ranks (row, signature) begin at 1. The best rank of a row over all paints counts (Westfall and Young's
    # minP), so that the rate holds for all paints together.
    best = np.sort(ranks.min(axis=1))
    count = int(np.floor(allowed + 1e-9))
    # all rows with the rank at the limit are excluded
    return int(best[-1]) if count >= best.size else int(best[count]) - 1


def _ranks(values: Floats) -> Ints:
    # Rank of every value in its column, from 1 for the smallest
    from scipy.stats import rankdata

    return np.asarray(rankdata(values, "ordinal", axis=0), np.int64)


def _score_thresholds(values: Floats, rate: float) -> Floats:
    # Score thresholds (signature,) such that a share `rate` of the background exceeds that of any paint
    allowed, min_alarms = rate * (len(values) + 1), max(DETECTION.min_alarms, values.shape[1] + 1)
    SchemaError.raise_if(
        allowed < min_alarms,
        f"false_alarm_rate={rate:g} of {values.shape[1]} paints from {len(values)} background pixels",
        expected=f"at least {int(np.ceil(min_alarms / rate))} pixels",
        mend="pass a higher rate, search a longer line or search for fewer paints",
        option="give a higher --false-alarm-rate",
        code="false-alarm-rate-too-low",
    )
    return np.asarray(-np.sort(-values, axis=0)[max(_joint_rank(_ranks(-values), allowed), 1) - 1])


def distance_limits(other_distances: tuple[Array, Array], rate: float) -> Floats:
    # Return distance limits (signature,) such that a share ``rate`` of other paints is within any limit.
    #
    # The limit is 0 for a paint with other paints so near that noise covers the difference; such a paint does
    # not count in the rate. Below the distance of the nearest other paint the share is assumed to be
    # proportional to the distance. As paints differ in several dimensions, the true share is smaller.
    distance, level = other_distances
    distance = np.where(level > 0.0, distance, np.inf)
    if rate >= 1.0:
        return np.full(distance.shape[1], np.inf)
    allowed = rate * (len(distance) + 1)
    ordered = np.sort(distance, axis=0)
    separable = ordered[max(int(allowed), 1) - 1] * min(allowed, 1.0) >= DETECTION.min_distance
    limit = np.zeros(distance.shape[1])
    if separable.any():
        ranks = _ranks(distance[:, separable])
        rank, nearest = _joint_rank(ranks, allowed), int((ranks.min(axis=1) == 1).sum())
        limit[separable] = ordered[max(rank, 1) - 1, separable] * (1.0 if rank else allowed / nearest)
    return limit


def _checked_rate(values: Floats, block: Ints, rate: float) -> tuple[float, float]:
    # Share of pixels above thresholds from the other parts of the line, and half of its 95 % interval.
    # The interval is Student's over the parts: pixels are correlated within parts, not between them.
    from scipy.stats import t

    numbers, position = np.unique(block, return_inverse=True)
    folds = min(DETECTION.folds, numbers.size)
    if folds < 2:
        return float("nan"), float("nan")
    fold = position * folds // numbers.size
    shares = []
    for number in range(folds):
        is_tested = fold == number
        try:
            threshold = _score_thresholds(values[~is_tested], rate)
        except SchemaError:
            return float("nan"), float("nan")
        shares.append((values[is_tested] >= threshold).any(axis=1).mean())
    return float(np.mean(shares)), float(t.ppf(0.975, folds - 1) * np.std(shares, ddof=1) / np.sqrt(folds))


BLOCKS = SimpleNamespace(
    max_other_spectra=20_000,
    #: Number of backgrounds that a task joins.
    backgrounds_per_task=16,
)
#: Variables of pixels, in the order of `search_block`.
_LAYERS = ("detection_score", "best_paint", "paint_distance", "paint_level", "detected")
#: Variables of detections to fields of `Detector`.
_DETECTOR_FIELDS = {
    "score_threshold": "threshold",
    "distance_limit": "distance_limit",
    "checked_rate": "checked_rate",
    "checked_rate_u": "checked_rate_u",
    "explained_share": "explained_share",
}


@takes_quantities()
def detect(
    line: xr.Dataset,
    library: xr.Dataset,
    *,
    method: str = "ace",
    false_alarm_rate: float = 1e-3,
    unknown_rate: float | None = None,
    others: xr.Dataset | None = None,
    background: Any = None,
    exclude: Quality | int | None = None,
    sky: Any = "auto",
    shrinkage: float = 0.0,
) -> xr.Dataset:
    r"""Search a flight line for the paints of a library, at a given rate of false alarms.

    Lazy except for the wavelengths. Computing reads the line twice, in blocks of lines: for the background
    and for the search. Results have the same bits for any chunks.

    Parameters
    ----------
    line
        ``reflectance`` (along_track, band, cross_track) [1] and ``wavelength``; ``quality`` where present.
    library
        Paints to search for: ``reflectance`` (signature, band) [1] of the body under its clear coat
        (``specular_component`` excluded), interpolated to the bands of the line.
    method
        "ace", the adaptive coherence (cosine) estimator; "matched_filter"; or "spectral_angle".
    false_alarm_rate
        Share of the background with a score above the threshold of any paint. By default the background
        excludes pixels that a paint explains, whether they show it or not: the rate does not hold for them,
        and ``explained_share`` is their share.
    unknown_rate
        Share of ``others`` that may be accepted as a paint of the library; by default ``false_alarm_rate``; 1
        accepts all.
    others
        A library of paints that may occur and are not searched for; by default the starter library. Paints
        with names in ``library`` are excluded. The rate holds for paints like these: pass the paints of your
        cars. With fewer than ``1 / unknown_rate`` spectra the limits are stricter than necessary.
    background
        Pixels that certainly show no paint of the library, (along_track, cross_track) bool, or regions as of
        `hyperpaint.read_regions`: only these determine covariance and thresholds. By default all pixels that
        no paint explains determine the thresholds. The rate holds for pixels like these: include objects that
        look like the paints.
    exclude
        Flags of pixels that are excluded from the background, and not detected; by default the flags that
        signatures exclude.
    sky
        Spectrum (band,) of the sky that a clear coat mirrors in any amount, projected out of pixels and
        paints; "auto" for the diffuse light from above, where the line declares it; None for no sky.
    shrinkage
        Weight of the diagonal in the covariance, 0 to 1, for lines with few pixels.

    Returns
    -------
    Dataset
        (along_track, cross_track): ``best_paint``, number of the paint, which the attribute
        ``flag_meanings`` names, -1 where a value is missing; its ``detection_score``, ``paint_distance``
        and ``paint_level``; ``detected``. (signature): ``score_threshold``, ``distance_limit``, 0 where a
        paint cannot be distinguished from others at this rate. ``checked_rate`` with ``checked_rate_u``: mean
        share of alarms in an eighth of the line's background under thresholds from the rest, and half of its
        95 % interval. ``explained_share``: share of the valid pixels excluded from the background since a
        paint explains them, whether they show it or not; 0 with ``background=``.

    Raises
    ------
    SchemaError
        Variables, options or bands cannot be used; all are listed. When computed: the background has fewer
        valid pixels than bands, or too few for the rate.

    Warns
    -----
    PaintWarning
        When computed: ``explained_share`` is more than ten times the rate.

    Notes
    -----
    With mean and covariance of the background :math:`\mu, C`, a pixel :math:`x` and a paint :math:`t` less
    :math:`\mu`, products :math:`\langle a, b \rangle = a^T C^{-1} b` and the sky's direction projected out,

    .. math:: s_{ACE} = \pm \frac{\langle t, x \rangle^2}{\langle t, t \rangle \langle x, x \rangle}, \qquad
              s_{MF} = \frac{\langle t, x \rangle}{\langle t, t \rangle}

    [1]_ [2]_ with the sign of the product. The score of the spectral angle is its cosine, without
    :math:`\mu` and :math:`C`. C is computed from all valid pixels, with ``background=`` from those pixels
    alone; its diagonal has the weight ``shrinkage``.

    *Threshold*: the score of the same rank in the background for each paint, chosen such that the share of
    pixels above the threshold of any paint is the rate; from pixels spread over all lines (128 MiB of
    samples). Target pixels that no paint explains stay in the background and raise the threshold: there are
    fewer false alarms than stated, and fewer detections; ``background=`` avoids this.

    *Unknown paints*: :math:`x = a t + m s + r` by least squares with the sky s; a pixel is rejected where
    :math:`|r| / |a t|` is above the paint's ``distance_limit``, or a outside of 0.25 to 2.5. A share
    ``unknown_rate`` of ``others`` lies within the limit of any paint. White, silver and grey paints mostly
    cannot be distinguished at 1e-3 and are then not detected. A metallic paint has another spectrum at
    another angle: search for its signature of a similar geometry.

    References
    ----------
    .. [1] S. Kraut, L. L. Scharf, L. T. McWhorter, "Adaptive subspace detectors", IEEE Trans. Signal Process.
       49, 1-16 (2001).
    .. [2] L. L. Scharf, L. T. McWhorter, "Adaptive matched subspace detectors and adaptive coherence
       estimators", Proc. 30th Asilomar Conf. Signals, Syst., Comput. (1996).

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> from hyperpaint.paints import search_library, starter_library
    >>> nm = np.linspace(405.0, 995.0, 30)
    >>> red = search_library(starter_library(members=0, wavelength=nm), name="Synthetic Signal Red")
    >>> level = np.random.default_rng(1).normal(0.1, 0.01, (64, 30, 64))
    >>> level[20:24, :, 30:36] = red.reflectance.values[0][:, None]
    >>> line = xr.Dataset({"reflectance": (("along_track", "band", "cross_track"), np.float32(level),
    ...                    {"units": "1"})}, {"wavelength": ("band", nm, {"units": "nm"})})
    >>> detections = detect(line, red, false_alarm_rate=1e-2).compute()
    >>> int(detections.detected.sum()), bool(detections.detected[20:24, 30:36].all())
    (24, True)
    """
    line = schema.rename_to_roles(line)
    variables = schema.require(line, ["reflectance", "wavelength"], "a detection")
    rate = false_alarm_rate if unknown_rate is None else unknown_rate
    cube = variables["reflectance"]
    with Problems("this line cannot be searched for paints", SchemaError) as problems:
        problems.add_if(
            set(cube.dims) != set(CUBE) or not cube.size,
            f"reflectance has dims {dict(cube.sizes)}",
            expected="lines, bands and columns",
            code="dims-wrong",
        )
        one_of(method, METHODS, "method", problems=problems)
        for argument, is_valid, expected in (
            (
                f"false_alarm_rate={false_alarm_rate!r}",
                0.0 < false_alarm_rate < 1.0,
                "a share between 0 and 1",
            ),
            (f"unknown_rate={rate!r}", 0.0 < rate <= 1.0, "a share above 0, at most 1"),
            (f"shrinkage={shrinkage!r}", 0.0 <= shrinkage <= 1.0, "0 to 1"),
        ):
            problems.add_if(not is_valid, argument, expected=expected, code="value-out-of-range")
        if "good" in line.variables and line["good"].dims != (BAND,):
            problems.add(f"'good' has dims {line['good'].dims}", expected=f"({BAND!r},)", code="dims-wrong")
    if "wavelength_shift" in line.variables:
        variables["reflectance"] = to_nominal(line)["reflectance"]
    paints, bands, other_paints = _spectra(line, variables["wavelength"].values, library, others)
    # blocks of 32 complete lines
    cube = variables["reflectance"].transpose(*CUBE)
    cube = cube.chunk({ALONG_TRACK: CHUNK_LINES, BAND: -1, CROSS_TRACK: -1}).data
    if "quality" in line.variables:
        bits = schema.require(line, ["quality"], "a detection")["quality"].transpose(ALONG_TRACK, CROSS_TRACK)
        flags = np.uint16(int(EXCLUDED if exclude is None else exclude))
        unflagged = (da.asarray(bits.data).rechunk((CHUNK_LINES, -1)) & flags) == 0
    else:
        unflagged = da.ones((cube.shape[0], cube.shape[2]), chunks=(cube.chunks[0], -1), dtype=bool)
    detector = _lazy_detector(
        line,
        cube,
        unflagged if background is None else unflagged & _background_mask(background, unflagged, line),
        bands,
        paints,
        other_paints,
        {"method": method, "rate": false_alarm_rate, "unknown_rate": rate, "shrinkage": shrinkage}
        | {"has_targets": background is None},
        sky,
    )
    attrs = {"method": method, "false_alarm_rate": false_alarm_rate, "unknown_rate": rate}
    names = [str(name) for name in library[SIGNATURE].values]
    # Detections of a line, lazy, with the attributes of the search
    # A copy of a dask array with other keys that is computed only after a delayed object.
    #
    # With the same keys, all blocks of the first pass would stay in memory until the second pass.
    # `dask.graph_manipulation.bind` does the same, but loses the keys of rechunks.
    graph = convert_legacy_graph(dict(cube.dask))
    keys = {key: ("again-" + key[0], *key[1:]) if isinstance(key, tuple) else f"again-{key}" for key in graph}
    copy, first = {}, TaskRef(detector.key)
    for key, task in graph.items():
        new_key = keys[key]
        if isinstance(task, DataNode):
            copy[new_key] = Task(new_key, _value_after, first, task.value)
        elif isinstance(task, Task) and not task.dependencies:
            copy[new_key] = Task(new_key, _call_after, first, task.func, *task.args, **task.kwargs)
        else:
            copy[new_key] = task.substitute(keys, key=new_key)
    name = f"again-{cube.name}"
    graph = HighLevelGraph.from_collections(name, copy, dependencies=[detector])
    cube = da.Array(graph, name, cube.chunks, meta=cube._meta)
    blocks = da.blockwise(
        search_block,
        "lbx",
        cube,
        "lbx",
        unflagged,
        "lx",
        detector=detector,
        dtype=object,
        concatenate=True,
        meta=np.empty((0, 0, 0), object),
        adjust_chunks={"b": 1},
    )
    layout = {number: ("lx", schema.dtype_of(name)) for number, name in enumerate(_LAYERS)}
    pixel = (ALONG_TRACK, CROSS_TRACK)
    arrays = {
        name: schema.label(xr.DataArray(array, dims=pixel), name)
        for name, array in zip(_LAYERS, split_outputs(blocks, "lbx", layout).values(), strict=True)
    }
    for name, field in _DETECTOR_FIELDS.items():
        dims = schema.VARIABLES[name].dims
        data = da.from_delayed(getattr(detector, field), (len(names),) * len(dims), np.float64)
        arrays[name] = schema.label(xr.DataArray(data, dims=dims), name)
    arrays["best_paint"].attrs |= {
        "flag_values": np.arange(-1, len(names), dtype=np.int16),
        "flag_meanings": " ".join(["none", *(name.replace(" ", "_") for name in names)]),
    }
    arrays["detected"].attrs |= attrs
    coords = {
        name: array for name, array in line.coords.items() if set(array.dims) <= set(pixel) and array.dims
    }
    identity = {"name": line.attrs["name"]} if line.attrs.get("name") else {}
    return xr.Dataset(arrays, {**coords, SIGNATURE: (SIGNATURE, names)}, identity | attrs)


def _spectra(
    line: xr.Dataset, wavelength: Array, library: xr.Dataset, others: xr.Dataset | None
) -> tuple[Floats, Ints, Floats]:
    # Paints (signature, band), indices of the compared bands, and spectra of other paints (spectrum, band)
    nm = np.asarray(wavelength, np.float64)
    paints = _on_bands(library, nm, members=False)
    warn_of_scale(paints, "the reflectance of the library at the bands of the line")
    good = np.isfinite(nm) & schema.good_bands(line)
    bands = np.flatnonzero(good & np.isfinite(paints).all(axis=0) if len(paints) else good & False)
    SchemaError.raise_if(
        bands.size < MIN_BANDS,
        f"the {len(paints)} paints of the library have values in {bands.size} of the line's "
        f"{int(good.sum())} good bands",
        expected=f"at least 1 paint and {MIN_BANDS} common bands",
        mend="use a library that covers the wavelengths of the line and has no gaps",
        code="bands-not-shared",
    )
    if others is None:
        others = starter_library(wavelength=np.unique(nm[bands]))
    names = {str(name) for name in library[SIGNATURE].values}
    others = others.isel({SIGNATURE: [str(name) not in names for name in others[SIGNATURE].values]})
    other_paints = _on_bands(others, nm[bands], members=True)
    other_paints = other_paints[np.isfinite(other_paints).all(axis=1)]
    SchemaError.raise_if(
        not len(other_paints),
        f"no paint of others= has values in all {bands.size} bands that line and library share",
        mend="pass as others= a library that covers these bands, with paints that library= lacks",
        code="other-paints-missing",
    )
    return paints[:, bands], bands, other_paints[:: -(-len(other_paints) // BLOCKS.max_other_spectra)]


def _on_bands(library: xr.Dataset, nm: Floats, *, members: bool) -> Floats:
    # Spectra of a library (spectrum, band), with `members` also its members, at wavelengths `nm`
    names = [
        "reflectance",
        "wavelength",
        *(["member_reflectance"] if "member_reflectance" in library else []),
    ]
    library = schema.with_band_dim(library)
    variables = schema.require(library, names if members else names[:2], "a detection", LIBRARY_VARIABLES)
    wavelength = np.asarray(variables["wavelength"].values, np.float64)
    spectra = [np.asarray(variables["reflectance"].values, np.float64)]
    if members and "member_reflectance" in variables:
        rows = np.asarray(variables["member_reflectance"].values, np.float64).reshape(-1, wavelength.size)
        spectra.append(rows[np.isfinite(rows).any(axis=1)])
    return np.array([interpolated(nm, wavelength, spectrum) for spectrum in np.concatenate(spectra)]).reshape(
        -1, nm.size
    )


def _background_mask(background: Any, unflagged: Any, line: xr.Dataset) -> Any:
    # The argument `background` as a mask with the chunks of `unflagged`
    if not hasattr(background, "dtype") and not isinstance(background, list | tuple):
        background = region_mask(background, line) >= 0
    return da.asarray(schema.pixel_mask(background, line, "background=")).rechunk(unflagged.chunks)


def _lazy_detector(
    line: xr.Dataset,
    cube: Any,
    is_background: Any,
    bands: Ints,
    paints: Floats,
    other_paints: Floats,
    settings: dict[str, Any],
    sky: Any,
) -> Any:
    # Delayed detector: sums over blocks in their order, then thresholds
    blocks, masks = cube.to_delayed().ravel(), is_background.to_delayed().ravel()
    share = min(1.0, DETECTION.sample_bytes / (4.0 * bands.size * max(1, cube.shape[0] * cube.shape[2])))
    size = int(np.ceil(share * CHUNK_LINES * cube.shape[2]))
    background, join = (dask.delayed(task, pure=True) for task in (block_background, joined_backgrounds))
    backgrounds = [
        background(*block_and_mask, bands, number, size)
        for number, block_and_mask in enumerate(zip(blocks, masks, strict=True))
    ]
    while len(backgrounds) > 1:
        starts = range(0, len(backgrounds), BLOCKS.backgrounds_per_task)
        backgrounds = [join(backgrounds[start : start + BLOCKS.backgrounds_per_task]) for start in starts]
    if isinstance(sky, str) and sky == "auto":
        small = [name for name in line.variables if not {ALONG_TRACK, CROSS_TRACK} <= set(line[name].dims)]
        sky = dask.delayed(_mirrored_sky)(line[small], bands)
    elif sky is not None:
        sky = np.asarray(sky, np.float64)
        SchemaError.raise_if(
            sky.shape != (cube.shape[1],),
            f"sky= has shape {sky.shape}",
            expected=f"({cube.shape[1]},), one value a band",
            code="length-mismatch",
        )
        sky = sky[bands]
    return dask.delayed(make_detector, pure=True)(
        backgrounds[0], bands, paints, sky, other_paints, **settings
    )


def _value_after(_: Any, value: Any) -> Any:
    return value


def _call_after(_: Any, function: Any, *args: Any, **options: Any) -> Any:
    return function(*args, **options)


def _mirrored_sky(line: xr.Dataset, bands: Ints) -> Floats | None:
    # Spectrum of the sky mirrored by a level coat, up to a factor (band,); None where undeclared
    if not has_split(line):
        return None
    split = split_of(line, None, None).mean()
    sky = np.asarray((split.fraction * relative_sky(split)).values, np.float64)[bands]
    return sky if np.isfinite(sky).all() and sky.any() else None


def search_block(cube: Array, unflagged: Bools, detector: Detector) -> tuple[Array, ...]:
    # Return the layers of a block (line, band, column), each (line, column), in the order of `_LAYERS`.
    #
    # The best paint of a pixel is the one with the highest score relative to its threshold, of the detected
    # paints if there are any.
    shape = unflagged.shape
    score, distance, level = (np.full(shape, np.nan, np.float32) for _ in range(3))
    best, detected = np.full(shape, -1, np.int16), np.zeros(shape, bool)
    scale = detector.threshold - detector.median_score
    for number, values in enumerate(cube[:, detector.bands]):
        spectra = np.ascontiguousarray(values.T, np.float64)
        is_complete = np.asarray(np.isfinite(spectra).all(axis=1))
        spectra[~is_complete] = 0.0
        paint_scores = scores(spectra, detector.project, detector.method)
        paint_distances, levels = distances(spectra, detector.paints, detector.sky)
        passes: Array = (paint_scores >= detector.threshold) & _is_near(
            paint_distances, levels, detector.distance_limit
        )
        relative_scores = (paint_scores - detector.median_score) / scale
        any_passes = np.max(passes, axis=1, keepdims=True)
        candidates = np.where(passes >= any_passes, relative_scores, -np.inf)
        paint = np.argmax(np.where(is_complete[:, None], candidates, 0.0), axis=1)
        column = np.arange(len(paint))
        for layer, paint_values in ((score, paint_scores), (distance, paint_distances), (level, levels)):
            layer[number] = np.where(is_complete, paint_values[column, paint], np.nan)
        best[number] = np.where(is_complete, paint, -1)
        detected[number] = any_passes[:, 0] & is_complete & unflagged[number]
    return score, best, distance, level, detected


# --- regions, such as cars, with a detected paint ----------------------------------------------------------

#: Variables of `detected_regions`.
_COLUMNS = ("pixels", "detected_share", "signature", "p_value", "placements")


def detected_regions(detections: xr.Dataset, regions: Any) -> xr.Dataset:
    """Return the paint that each region, such as a car, shows, and its significance.

    Eager. Pixels of an object are correlated. The detected share of a region is therefore compared with the
    shares inside copies of its outline, laid side by side on the line outside all regions.

    Parameters
    ----------
    detections
        From `detect`.
    regions
        Regions, or a file of them, see `hyperpaint.read_regions`; pixels of the sensor.

    Returns
    -------
    Dataset
        (region): ``pixels``, their number; ``signature``, the most frequent detected paint, empty without
        detections; ``detected_share``, its share of the pixels [1]; ``p_value``, the probability that an
        outline without paint has as large a share of any paint, from ``placements`` copies of the outline, at
        least 1 / (placements + 1).

    Raises
    ------
    FormatError, SchemaError
        The regions cannot be read, contain no pixel or belong to another flight line, or ``detections`` lacks
        variables.

    Examples
    --------
    >>> import xarray as xr
    >>> from hyperpaint.regions import Region
    >>> shown = np.zeros((24, 24), bool)
    >>> shown[4:8, 4:10] = True  # as `detect` returns it
    >>> pixels = ("along_track", "cross_track")
    >>> detections = xr.Dataset(
    ...     {"detected": (pixels, shown), "best_paint": (pixels, np.zeros((24, 24), np.int16))},
    ...     {"signature": ["red"]})
    >>> car = Region("car", [(3.5, 3.5), (9.5, 3.5), (9.5, 7.5), (3.5, 7.5)])
    >>> cars = detected_regions(detections, [car])
    >>> cars["signature"].item(), cars.detected_share.item(), round(cars.p_value.item(), 2)
    ('red', 1.0, 0.04)
    """
    detections = schema.rename_to_roles(detections)
    variables = schema.require(detections, ["detected", "best_paint"], "detected regions")
    detected, best = variables["detected"].values, variables["best_paint"].values
    region_list = regions_from(regions)
    if region_list.coordinates == "sensor":
        lines_of(detections, region_list)  # raises for regions of other flight lines
    region_pixels = pixels_of(region_list, detections)
    with Problems("these regions cannot be searched", SchemaError) as problems:
        for name, (along, _) in zip(region_list.names, region_pixels, strict=True):
            problems.add_if(
                not along.size, f"region {name!r} contains no pixel of the line", code="region-empty"
            )
    in_region = np.zeros(detected.shape, bool)
    for pixels in region_pixels:
        in_region[pixels] = True
    names = [str(name) for name in detections[SIGNATURE].values]
    detected_paint = np.where(detected, best, -1)
    rows = []
    for along, across in region_pixels:
        counts = _counts(detected_paint[along, across], len(names))
        paint = int(counts.argmax())
        share = counts[paint] / along.size
        # the region is represented by its most frequent paint, and so is every copy
        down, right = along - along.min(), across - across.min()
        height, width = down.max() + 1, right.max() + 1
        # share of the most frequent paint in copies of the outline outside all regions (copy,)
        copy_shares = np.array(
            [
                _counts(detected_paint[down + top, right + left], len(names)).max() / along.size
                for top in range(0, detected_paint.shape[0] - height + 1, height)
                for left in range(0, detected_paint.shape[1] - width + 1, width)
                if not in_region[down + top, right + left].any()
            ],
            np.float64,
        )
        p = (1 + int((copy_shares >= share).sum())) / (1 + copy_shares.size)
        rows.append((along.size, share, names[paint] if counts[paint] else "", p, copy_shares.size))
    columns = dict(zip(_COLUMNS, zip(*rows, strict=True), strict=True))
    return xr.Dataset(
        {
            name: ("region", np.array(values), {} if name == "signature" else {"units": "1"})
            for name, values in columns.items()
        },
        {"region": ("region", list(region_list.names))},
        detections.attrs,
    )


def _counts(detected_paint: Array, paints: int) -> Ints:
    # Number of pixels of each paint (paint,); -1 is no paint
    return np.bincount(detected_paint[detected_paint >= 0], minlength=paints)
