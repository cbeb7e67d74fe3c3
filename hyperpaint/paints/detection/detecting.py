"""Detection of paints in a flight line: labels, units and the lazy graph."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import dask
import dask.array as da
import numpy as np
import xarray as xr
from dask._task_spec import DataNode, Task, TaskRef, convert_legacy_graph
from dask.highlevelgraph import HighLevelGraph
from scipy.linalg import solve_triangular

from hyperpaint.base import schema
from hyperpaint.base.arrays import Array, Bools, Floats, Ints
from hyperpaint.base.errors import PaintWarning, Problems, SchemaError
from hyperpaint.base.many_outputs import split_outputs
from hyperpaint.base.schema import (
    ALONG_TRACK,
    BAND,
    CHUNK_LINES,
    CROSS_TRACK,
    CUBE,
    LIBRARY_VARIABLES,
    SIGNATURE,
    Quality,
)
from hyperpaint.base.units import takes_quantities
from hyperpaint.paints.paint_search import MIN_BANDS, interpolated
from hyperpaint.paints.signatures import EXCLUDED
from hyperpaint.paints.signatures.line_sources import lines_of
from hyperpaint.paints.starter_paints import starter_library
from hyperpaint.radiometry import to_nominal
from hyperpaint.regions import pixels_of
from hyperpaint.regions.geojson import regions_from
from hyperpaint.surroundings.corrections import sky_above
from hyperpaint.surroundings.light_split import has_split, split_of

# -- Scores of spectra against paints, and distances of spectra from paints: plain arrays, float64.

METHODS = ("ace", "matched_filter", "spectral_angle")


class Projection(NamedTuple):
    """Linear map of spectra in which they are compared: z = (x - offset) matrix."""

    offset: Floats  #: (band,)
    matrix: Floats  #: (band, band): whitens, and takes the mirrored sky away
    targets: Floats  #: (signature, band): the paints, projected


def projection(
    paints: Floats, sky: Floats | None, mean: Floats | None = None, covariance: Floats | None = None
) -> Projection:
    """Return the projection of a detector.

    Parameters
    ----------
    paints : (signature, band)
        Reflectance.
    sky : (band,), or None
        Spectrum of the mirrored sky, which is projected out; None to keep it.
    mean, covariance : (band,), (band, band)
        Statistics of the background; None for the spectral angle, which does not use them.
    """
    bands = paints.shape[1]
    offset = np.zeros(bands) if mean is None else mean
    # covariance = L L', z = L^-1 (x - mean) has unit covariance
    whitening = np.eye(bands)
    if covariance is not None:
        whitening = solve_triangular(np.linalg.cholesky(covariance), whitening, lower=True).T
    matrix = whitening
    if sky is not None:
        direction = sky @ whitening
        direction /= np.linalg.norm(direction)
        matrix = whitening - np.outer(whitening @ direction, direction)
    return Projection(offset, np.ascontiguousarray(matrix), (paints - offset) @ matrix)


def scores(spectra: Floats, project: Projection, method: str) -> Floats:
    """Return the scores (spectrum, signature) of spectra (spectrum, band), by one of `METHODS`.

    With z and t the projected spectrum and paint: ACE is (z't)^2 / (z'z t't) with the sign of z't, the
    matched filter z't / t't, the spectral angle's cosine z't / sqrt(z'z t't); 0 where z is zero.
    """
    z = (spectra - project.offset) @ project.matrix
    product = z @ project.targets.T
    target_square = np.einsum("kb,kb->k", project.targets, project.targets)
    if method == "matched_filter":
        return np.asarray(product / target_square)
    length = np.sqrt(np.einsum("nb,nb->n", z, z)[:, None] * target_square)
    cosine = np.divide(product, length, out=np.zeros_like(product), where=length > 0.0)
    return np.asarray(cosine * np.abs(cosine) if method == "ace" else cosine)


def distances(spectra: Floats, paints: Floats, sky: Floats | None) -> tuple[Array, Array]:
    r"""Return distance and level of spectra (spectrum, band) for each paint (signature, band).

    Least squares fit x = a t + m sky + rest; the level is a, the distance \|rest\| / \|a t\|, infinite where
    a is not positive. Both (spectrum, signature) [1].
    """
    product, square = spectra @ paints.T, np.einsum("nb,nb->n", spectra, spectra)
    paint_square = length = np.einsum("kb,kb->k", paints, paints)
    if sky is not None:
        unit = sky / np.linalg.norm(sky)
        of_sky = paints @ unit
        in_sky = spectra @ unit
        product = product - np.outer(in_sky, of_sky)
        square, paint_square = square - in_sky**2, paint_square - of_sky**2
    with np.errstate(invalid="ignore", divide="ignore"):
        level = product / paint_square
        rest = np.sqrt(np.maximum(square[:, None] - product * level, 0.0))
        distance = np.where(level > 0.0, rest / (level * np.sqrt(length)), np.inf)
    return distance, level


# -- Statistics of the background, and thresholds at a stated false-alarm rate.


@dataclass(frozen=True)
class DetectionRules:
    """Thresholds of detection."""

    #: Maximum memory of the pixels from which thresholds are drawn [byte]: 123,000 pixels of 272 bands.
    sample_bytes: int = 2**27
    #: Lowest and highest level of a pixel of a paint [1]: a body part turned from a high sun, or towards a
    #: low one; beyond, dark glass passes for black, and any proportional spectrum for the paint.
    min_level: float = 0.25
    max_level: float = 2.5
    #: Distance caused by a pixel's noise alone [1], at a signal-to-noise ratio of 100.
    min_distance: float = 0.01
    #: Factor of the rate of other paints at whose distance limit pixels are taken for the paint itself, not
    #: for background: half of a car's pixels lie beyond the limit [1].
    target_rate_ratio: float = 10.0
    #: Share of such pixels over the rate of false alarms above which a warning is given [1].
    explained_ratio: float = 10.0
    #: Parts of the line that check one another's thresholds.
    folds: int = 8
    #: Minimum number of sample pixels above a threshold: fewer determine no rate.
    min_alarms: float = 5.0


DETECTION = DetectionRules()

#: Sample pixels processed together.
PIXELS_AT_ONCE = 4096


class BackgroundPart(NamedTuple):
    """Sums over some blocks of lines, and a sample of their pixels."""

    pixels: int
    total: Floats  #: (band,)
    products: Floats  #: (band, band)
    sample: Array  #: (pixel, band) float32
    block: Ints  #: (pixel,): number of the block that a pixel of the sample is in


def background_part(cube: Array, is_valid: Bools, number: int, size: int) -> BackgroundPart:
    """Return the sums of a block (line, band, column) over its valid pixels (line, column).

    ``size`` pixels are drawn as the sample, seeded by the block's number alone; the valid ones are kept.
    """
    lines, bands, columns = cube.shape
    total, products = np.zeros(bands), np.zeros((bands, bands))
    for line, valid in zip(cube, is_valid, strict=True):
        # zeros add nothing, and every product has the same shape: the same bits
        spectra = np.where(valid, line, 0.0).astype(np.float64)
        total += spectra.sum(axis=1)
        products += spectra @ spectra.T
    drawn = np.sort(np.random.default_rng([number, 20]).permutation(lines * columns)[:size])
    at = drawn[is_valid.ravel()[drawn]]
    sample = np.ascontiguousarray(cube[at // columns, :, at % columns], np.float32)
    return BackgroundPart(int(is_valid.sum()), total, products, sample, np.full(at.size, number, np.int64))


def joined_parts(parts: Sequence[BackgroundPart]) -> BackgroundPart:
    """Return the sums of several parts, in their order."""
    pixels, total, products = 0, np.zeros_like(parts[0].total), np.zeros_like(parts[0].products)
    for part in parts:
        pixels += part.pixels
        total += part.total
        products += part.products
    sample, block = (np.concatenate(arrays) for arrays in zip(*(part[3:] for part in parts), strict=True))
    return BackgroundPart(pixels, total, products, sample, block)


class DetectorSettings(NamedTuple):
    """Settings of a detector."""

    method: str
    rate: float
    unknown_rate: float
    shrinkage: float
    has_targets: bool  #: Whether the paints may be among the pixels it is drawn from


class Detector(NamedTuple):
    """All data needed to search a block."""

    method: str
    bands: Ints  #: Of the cube, those that are compared
    paints: Floats  #: (signature, band)
    sky: Floats | None
    project: Projection
    usual: Floats  #: (signature,): median score of the background
    threshold: Floats  #: (signature,)
    distance_limit: Floats  #: (signature,)
    checked_rate: float  #: Share above the thresholds of pixels that these were not drawn from
    checked_rate_u: float  #: Half of its 95 % interval
    explained_share: float  #: Of pixels that a paint explains, which were left out of the background

    def is_near(self, distance: Array, level: Array) -> Bools:
        """Return the spectra that each paint explains (spectrum, signature)."""
        return _is_near(distance, level, self.distance_limit)


def _is_near(distance: Array, level: Array, limit: Floats) -> Bools:
    in_range = (level >= DETECTION.min_level) & (level <= DETECTION.max_level)
    return np.asarray((distance <= limit) & in_range)


def make_detector(
    part: BackgroundPart,
    bands: Ints,
    paints: Floats,
    sky: Floats | None,
    others: Floats,
    settings: DetectorSettings,
) -> Detector:
    """Return the detector of an image, from the sums over the whole image.

    Takes the compared ``bands`` of the cube, and on these ``paints`` (signature, band), ``sky`` (band,) and
    ``others`` (other, band), spectra of paints that are not looked for. Raises `SchemaError`: too few pixels.
    Warns where many pixels that the paints explain were left out of the background.
    """
    if not part.pixels:
        raise SchemaError(
            f"the line has no background pixel without flags and with values in all {bands.size} bands",
            mend="pass exclude= with fewer flags, or set 'good' to False in bands without values",
            option="give --keep with flags",
            code="background-empty",
        )
    if part.pixels <= bands.size:
        raise SchemaError(
            f"{part.pixels} valid pixels for the covariance of {bands.size} bands",
            expected="more pixels than bands",
            mend="use a longer line, fewer bands, or exclude= with fewer flags",
            code="background-too-small",
        )
    mean = part.total / part.pixels
    covariance = (part.products - part.pixels * np.outer(mean, mean)) / (part.pixels - 1)
    shrunk = (1.0 - settings.shrinkage) * covariance + settings.shrinkage * np.diag(np.diag(covariance))
    try:
        project = (
            projection(paints, sky)
            if settings.method == "spectral_angle"
            else projection(paints, sky, mean, shrunk)
        )
    except np.linalg.LinAlgError as error:
        raise SchemaError(
            "the covariance of the background is singular: some bands depend linearly on others",
            mend="raise shrinkage=, such as to 0.001, or set 'good' to False in interpolated bands",
            option="give --shrinkage 0.001",
            code="covariance-singular",
        ) from error
    of_others = distances(others, paints, sky)
    limit = _distance_limits(of_others, settings.unknown_rate)
    if settings.has_targets and settings.unknown_rate < 1.0:
        # pixels that a paint explains may show it: they are no background
        reach = _distance_limits(of_others, min(DETECTION.target_rate_ratio * settings.unknown_rate, 0.5))
    else:
        reach = np.full(len(paints), -1.0)
    is_background, values = np.ones(len(part.sample), bool), np.empty((len(part.sample), len(paints)))
    for first in range(0, len(values), PIXELS_AT_ONCE):
        here = slice(first, first + PIXELS_AT_ONCE)
        spectra = part.sample[here].astype(np.float64)
        is_background[here] = ~_is_near(*distances(spectra, paints, sky), reach).any(axis=1)
        values[here] = scores(spectra, project, settings.method)
    explained = 1.0 - float(is_background.sum() / max(1, is_background.size))
    if explained > DETECTION.explained_ratio * settings.rate:
        warnings.warn(
            PaintWarning(
                f"{100.0 * explained:.2g} % of the pixels resemble the paints and were left out of the "
                f"background: false_alarm_rate={settings.rate:g} holds for the other pixels only; where "
                "these pixels are not all the paints themselves, pass background= (--background) with "
                "similar pixels that show no paint",
                code="background-resembles-paints",
            ),
            stacklevel=2,
        )
    values = values[is_background]
    threshold = _score_thresholds(values, settings.rate)
    checked, half = _checked_rate(values, part.block[is_background], settings.rate)
    return Detector(
        settings.method,
        bands,
        paints,
        sky,
        project,
        np.median(values, axis=0),
        threshold,
        limit,
        checked,
        half,
        explained,
    )


def _joint_rank(ranks: Ints, allowed: float) -> int:
    # Largest rank that at most `allowed` rows reach for any paint.
    # Ranks (row, signature) begin at 1; the rank of a row is its best for any paint (Westfall and Young's
    # minP), so that the rate holds for all paints together.
    best = np.sort(ranks.min(axis=1))
    count = int(np.floor(allowed + 1e-9))
    if count >= best.size:
        return int(best[-1])
    # all rows of the rank at the limit are left out
    return int(best[count]) - 1


def _ranks(values: Floats) -> Ints:
    order = np.argsort(values, axis=0, kind="stable")
    ranks = np.empty(values.shape, np.int64)
    np.put_along_axis(ranks, order, np.arange(1, len(values) + 1)[:, None], axis=0)
    return ranks


def _score_thresholds(values: Floats, rate: float) -> Floats:
    # Score thresholds that a share `rate` of the background passes for any paint
    allowed = rate * (len(values) + 1)
    if allowed < max(DETECTION.min_alarms, values.shape[1] + 1):
        need = int(np.ceil(max(DETECTION.min_alarms, values.shape[1] + 1) / rate))
        raise SchemaError(
            f"false_alarm_rate={rate:g} of {values.shape[1]} paints from {len(values)} background pixels",
            expected=f"at least {need} pixels",
            mend="pass a higher rate, search a longer line or look for fewer paints",
            option="give a higher --false-alarm-rate",
            code="false-alarm-rate-too-low",
        )
    rank = _joint_rank(_ranks(-values), allowed)
    return np.asarray(-np.sort(-values, axis=0)[max(rank, 1) - 1])


def _distance_limits(others: tuple[Array, Array], rate: float) -> Floats:
    """Return the distance limits within which, for any paint, a share ``rate`` of other paints lies.

    0 for a paint that has others so near that its own pixels cannot be separated from them; it uses up no
    part of the rate. Closer than the nearest other paint the share is taken as proportional to the distance.
    It grows faster where paints differ in more than one dimension, so that fewer lie within than stated.
    """
    distance = np.where(others[1] > 0.0, others[0], np.inf)
    if rate >= 1.0:
        return np.full(distance.shape[1], np.inf)
    allowed = rate * (len(distance) + 1)
    ordered = np.sort(distance, axis=0)
    apart = ordered[max(int(allowed), 1) - 1] * min(allowed, 1.0) >= DETECTION.min_distance
    limit = np.zeros(distance.shape[1])
    if apart.any():
        ranks = _ranks(distance[:, apart])
        rank = _joint_rank(ranks, allowed)
        nearest = int((ranks.min(axis=1) == 1).sum())
        limit[apart] = ordered[rank - 1, apart] if rank else ordered[0, apart] * (allowed / nearest)
    return limit


def _checked_rate(values: Floats, block: Ints, rate: float) -> tuple[float, float]:
    # Share of pixels above thresholds drawn from other parts of the line, and its half interval.
    # The 95 % interval is Student's over the parts: neighbouring pixels are correlated, parts are not.
    from scipy.stats import t

    numbers, part_of = np.unique(block, return_inverse=True)
    folds = min(DETECTION.folds, numbers.size)
    if folds < 2:
        return float("nan"), float("nan")
    fold = part_of * folds // numbers.size
    shares = []
    for number in range(folds):
        is_held_out = fold == number
        try:
            threshold = _score_thresholds(values[~is_held_out], rate)
        except SchemaError:
            return float("nan"), float("nan")
        shares.append((values[is_held_out] >= threshold).any(axis=1).mean())
    half = t.ppf(0.975, folds - 1) * np.std(shares, ddof=1) / np.sqrt(folds)
    return float(np.mean(shares)), float(half)


MAX_OTHER_SPECTRA = 20_000
JOINED_PARTS = 16
_LAYERS = ("detection_score", "best_paint", "paint_distance", "paint_level", "detected")
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
    r"""Look for the paints of a library in a flight line, at a stated rate of false alarms.

    Lazy except for the wavelengths: computing reads the line twice, for the background and for the search,
    some lines at a time. Results have the same bits for any chunks.

    Parameters
    ----------
    line
        ``reflectance`` (along_track, band, cross_track) [1] and ``wavelength``; ``quality`` where present.
    library
        Paints to look for: ``reflectance`` (signature, band) [1] of the body under its clear coat
        (``specular_component`` excluded), interpolated to the bands of the line.
    method
        "ace", the adaptive coherence (cosine) estimator; "matched_filter"; or "spectral_angle".
    false_alarm_rate
        Share of the background in which any paint may score above its threshold. By default pixels that a
        paint explains are left out of the background, whether they show it or not: the rate does not hold for
        them, and ``explained_share`` is their number.
    unknown_rate
        Share of ``others`` that may be taken for a paint of the library; by default ``false_alarm_rate``; 1
        rejects nothing.
    others
        A library of paints that may occur and are not looked for; by default the starter library. Paints
        named in ``library`` are left out. The rate holds for paints like these: pass the paints of your cars.
        With fewer than ``1 / unknown_rate`` spectra the limits are stricter than necessary.
    background
        Pixels that certainly show none of the paints, (along_track, cross_track) bool: covariance and
        thresholds come from these alone. By default thresholds come from all pixels that no paint explains.
        The rate holds for pixels like these: include objects that look like the paints.
    exclude
        Flags of pixels that are left out of the background, and not detected; by default the flags that
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
        95 % interval. ``explained_share``: share of the valid pixels that was left out of the background
        since a paint explains them, whether they show it or not; 0 with ``background=``.

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
    cannot be distinguished at 1e-3: they are not detected, which is no error. A metallic paint at another
    angle has another spectrum: look for its signature of a similar geometry.

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
    problems = Problems("paints cannot be looked for in this line", SchemaError)
    if set(cube.dims) != set(CUBE) or not cube.size:
        problems.add(
            f"reflectance has dims {dict(cube.sizes)}", expected="lines, bands and columns", code="dims-wrong"
        )
    if method not in METHODS:
        problems.add(f"method={method!r}", expected=f"one of {', '.join(METHODS)}", code="choice-unknown")
    for found, is_valid, expected in (
        (f"false_alarm_rate={false_alarm_rate!r}", 0.0 < false_alarm_rate < 1.0, "a share between 0 and 1"),
        (f"unknown_rate={rate!r}", 0.0 < rate <= 1.0, "a share above 0, at most 1"),
        (f"shrinkage={shrinkage!r}", 0.0 <= shrinkage <= 1.0, "0 to 1"),
    ):
        if not is_valid:
            problems.add(found, expected=expected, code="value-out-of-range")
    if "good" in line.variables and line["good"].dims != (BAND,):
        problems.add(f"'good' has dims {line['good'].dims}", expected=f"({BAND!r},)", code="dims-wrong")
    problems.raise_if_any()
    if "wavelength_shift" in line.variables:
        variables["reflectance"] = to_nominal(line)["reflectance"]
    paints, bands, unknown = _spectra(line, variables["wavelength"].values, library, others)
    # blocks of 32 whole lines
    cube = variables["reflectance"].transpose(*CUBE)
    cube = cube.chunk({ALONG_TRACK: CHUNK_LINES, BAND: -1, CROSS_TRACK: -1}).data
    if "quality" in line.variables:
        bits = schema.require(line, ["quality"], "a detection")["quality"].transpose(ALONG_TRACK, CROSS_TRACK)
        flags = np.uint16(int(EXCLUDED if exclude is None else exclude))
        clear = (da.asarray(bits.data).rechunk((CHUNK_LINES, -1)) & flags) == 0
    else:
        clear = da.ones((cube.shape[0], cube.shape[2]), chunks=(cube.chunks[0], -1), dtype=bool)
    detector = _lazy_detector(
        line,
        cube,
        clear if background is None else clear & _mask(background, clear),
        bands,
        paints,
        unknown,
        DetectorSettings(method, false_alarm_rate, rate, shrinkage, background is None),
        sky,
    )
    attrs = {"method": method, "false_alarm_rate": false_alarm_rate, "unknown_rate": rate}
    return _search(line, cube, clear, detector, [str(name) for name in library[SIGNATURE].values], attrs)


def _spectra(
    line: xr.Dataset, wavelength: Array, library: xr.Dataset, others: xr.Dataset | None
) -> tuple[Floats, Ints, Floats]:
    # Paints (signature, band), the bands compared, and spectra of other paints (other, band)
    nm = np.asarray(wavelength, np.float64)
    paints = _on_bands(library, nm, members=False)
    good = np.isfinite(nm)
    if "good" in line.variables:
        good &= line["good"].values.astype(bool)
    bands = np.flatnonzero(good & np.isfinite(paints).all(axis=0) if len(paints) else good & False)
    if bands.size < MIN_BANDS:
        raise SchemaError(
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
    unknown = _on_bands(others, nm[bands], members=True)
    unknown = unknown[np.isfinite(unknown).all(axis=1)]
    if not len(unknown):
        raise SchemaError(
            f"no paint of others= has values in all {bands.size} bands that line and library share",
            mend="pass others= a library that covers these bands, with paints that library= lacks",
            code="other-paints-missing",
        )
    return paints[:, bands], bands, unknown[:: -(-len(unknown) // MAX_OTHER_SPECTRA)]


def _on_bands(library: xr.Dataset, nm: Floats, *, members: bool) -> Floats:
    # Spectra of a library (spectrum, band), and its members if wanted, at wavelengths [nm]
    names = [
        "reflectance",
        "wavelength",
        *(["member_reflectance"] if "member_reflectance" in library else []),
    ]
    variables = schema.require(library, names if members else names[:2], "a detection", LIBRARY_VARIABLES)
    wavelength = np.asarray(variables["wavelength"].values, np.float64)
    spectra = [np.asarray(variables["reflectance"].values, np.float64)]
    if members and "member_reflectance" in variables:
        rows = np.asarray(variables["member_reflectance"].values, np.float64).reshape(-1, wavelength.size)
        spectra.append(rows[np.isfinite(rows).any(axis=1)])
    return np.array([interpolated(nm, wavelength, spectrum) for spectrum in np.concatenate(spectra)]).reshape(
        -1, nm.size
    )


def _mask(background: Any, clear: Any) -> Any:
    if hasattr(background, "dims"):
        mask = schema.rename_to_roles(background.to_dataset(name="background"))["background"]
        if set(mask.dims) != {ALONG_TRACK, CROSS_TRACK}:
            raise SchemaError(
                f"background= has dims {background.dims}", expected="lines and columns", code="dims-wrong"
            )
        background = mask.transpose(ALONG_TRACK, CROSS_TRACK).data
    mask = da.asarray(background)
    if mask.shape != clear.shape or mask.dtype != bool:
        raise SchemaError(
            f"background= is {mask.dtype} of shape {mask.shape}",
            expected=f"bool of shape {clear.shape}",
            code="grid-mismatch",
        )
    return mask.rechunk(clear.chunks)


def _lazy_detector(
    line: xr.Dataset,
    cube: Any,
    clear: Any,
    bands: Ints,
    paints: Floats,
    unknown: Floats,
    settings: DetectorSettings,
    sky: Any,
) -> Any:
    # Delayed detector: sums over blocks in their order, then thresholds
    blocks, masks = cube.to_delayed().ravel(), clear.to_delayed().ravel()
    pixels = max(1, cube.shape[0] * cube.shape[2])
    share = min(1.0, DETECTION.sample_bytes / (4.0 * bands.size * pixels))
    size = int(np.ceil(share * CHUNK_LINES * cube.shape[2]))
    part = dask.delayed(_part_of, pure=True)
    parts = [
        part(*block_and_mask, bands, number, size)
        for number, block_and_mask in enumerate(zip(blocks, masks, strict=True))
    ]
    join = dask.delayed(joined_parts, pure=True)
    while len(parts) > 1:
        parts = [join(parts[at : at + JOINED_PARTS]) for at in range(0, len(parts), JOINED_PARTS)]
    if isinstance(sky, str) and sky == "auto":
        of_light = [name for name in line.variables if not {ALONG_TRACK, CROSS_TRACK} <= set(line[name].dims)]
        sky = dask.delayed(_sky_of)(line[of_light], bands)
    elif sky is not None:
        sky = np.asarray(sky, np.float64)
        if sky.shape != (cube.shape[1],):
            raise SchemaError(
                f"sky= has shape {sky.shape}",
                expected=f"({cube.shape[1]},), one value a band",
                code="length-mismatch",
            )
        sky = sky[bands]
    return dask.delayed(make_detector, pure=True)(parts[0], bands, paints, sky, unknown, settings)


def _after(first: Any, array: Any) -> Any:
    """Return a copy of a dask array under other keys, computed only after a delayed object.

    Blocks shared by two passes would all be held in memory from the first to the second, and read ahead of
    it. `dask.graph_manipulation.bind` does the same, but loses the keys of rechunks.
    """
    graph = convert_legacy_graph(dict(array.dask))
    keys = {key: ("again-" + key[0], *key[1:]) if isinstance(key, tuple) else f"again-{key}" for key in graph}
    copy = {}
    for key, task in graph.items():
        new_key = keys[key]
        if isinstance(task, DataNode):
            copy[new_key] = Task(new_key, _second, TaskRef(first.key), task.value)
        elif isinstance(task, Task) and not task.dependencies:
            copy[new_key] = Task(
                new_key, _call_second, TaskRef(first.key), task.func, *task.args, **task.kwargs
            )
        else:
            copy[new_key] = task.substitute(keys, key=new_key)
    name = f"again-{array.name}"
    graph = HighLevelGraph.from_collections(name, copy, dependencies=[first])
    return da.Array(graph, name, array.chunks, meta=array._meta)


def _second(_: Any, value: Any) -> Any:
    return value


def _call_second(_: Any, function: Any, *args: Any, **options: Any) -> Any:
    return function(*args, **options)


def _part_of(cube: Array, clear: Bools, bands: Ints, number: int, size: int) -> BackgroundPart:
    cube = cube[:, bands]
    return background_part(cube, clear & np.isfinite(cube).all(axis=1), number, size)


def _sky_of(line: xr.Dataset, bands: Ints) -> Floats | None:
    # Sky that a level coat mirrors, up to a factor (band,); None where it is not declared
    if not has_split(line):
        return None
    split = split_of(line, None, None).mean()
    sky = np.asarray((split.fraction * sky_above(split)).values, np.float64)[bands]
    return sky if np.isfinite(sky).all() and sky.any() else None


def _search(
    line: xr.Dataset, cube: Any, clear: Any, detector: Any, names: list[str], attrs: dict[str, Any]
) -> xr.Dataset:

    cube = _after(detector, cube)
    blocks = da.blockwise(
        search_block,
        "lbx",
        cube,
        "lbx",
        clear,
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
    places = {
        name: array for name, array in line.coords.items() if set(array.dims) <= set(pixel) and array.dims
    }
    identity = {"name": line.attrs["name"]} if line.attrs.get("name") else {}
    return xr.Dataset(arrays, {**places, SIGNATURE: (SIGNATURE, names)}, identity | attrs)


def search_block(cube: Array, clear: Bools, detector: Detector) -> tuple[Array, ...]:
    """Return the layers of a block (line, band, column), each (line, column), in the order of `_LAYERS`."""
    shape = clear.shape
    score, distance, level = (np.full(shape, np.nan, np.float32) for _ in range(3))
    best, detected = np.full(shape, -1, np.int16), np.zeros(shape, bool)
    scale = detector.threshold - detector.usual
    for number, values in enumerate(cube[:, detector.bands]):
        spectra = np.ascontiguousarray(values.T, np.float64)
        whole = np.asarray(np.isfinite(spectra).all(axis=1))
        spectra[~whole] = 0.0
        paint_scores = scores(spectra, detector.project, detector.method)
        paint_distances, levels = distances(spectra, detector.paints, detector.sky)
        passes: Array = (paint_scores >= detector.threshold) & detector.is_near(paint_distances, levels)
        standing = (paint_scores - detector.usual) / scale
        some = np.max(passes, axis=1, keepdims=True)
        chosen = np.where(whole[:, None], np.where(passes >= some, standing, -np.inf), 0.0)
        paint = np.argmax(chosen, axis=1)
        place = np.arange(len(paint))
        for layer, of_paints in ((score, paint_scores), (distance, paint_distances), (level, levels)):
            layer[number] = np.where(whole, of_paints[place, paint], np.nan)
        best[number] = np.where(whole, paint, -1)
        detected[number] = some[:, 0] & whole & clear[number]
    return score, best, distance, level, detected


# -- Regions, such as cars, that show a detected paint.

_COLUMNS = ("pixels", "detected_share", "signature", "p_value", "placements")


def detected_regions(detections: xr.Dataset, regions: Any) -> xr.Dataset:
    """Return the paint that each region, such as a car, shows, and its significance.

    Eager. Pixels of one object are correlated and cannot be counted as independent. The detected share is
    therefore compared with the shares inside copies of the region's outline, laid side by side on the rest of
    the line.

    Parameters
    ----------
    detections
        From `detect`.
    regions
        Regions, or a file of them, see `hyperpaint.read_regions`; pixels of the sensor.

    Returns
    -------
    Dataset
        (region): ``pixels`` in it; ``detected_share`` [1] of its most frequent paint, which is ``signature``,
        empty where none is detected; ``p_value``, the probability that an outline without paint has as large
        a share of any paint, from ``placements`` outlines, at least 1 / (placements + 1).

    Raises
    ------
    FormatError, SchemaError
        The regions cannot be read, hold no pixel or are of another flight line, or these are no detections.

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
    places = pixels_of(region_list, detections)
    problems = Problems("these regions cannot be searched", SchemaError)
    for name, (along, _) in zip(region_list.names, places, strict=True):
        if not along.size:
            problems.add(f"region {name!r} holds no pixel of the line", code="region-empty")
    problems.raise_if_any()
    taken = np.zeros(detected.shape, bool)
    for place in places:
        taken[place] = True
    names = [str(name) for name in detections[SIGNATURE].values]
    shown = np.where(detected, best, -1)
    rows = []
    for along, across in places:
        counts = _counts(shown[along, across], len(names))
        paint = int(counts.argmax())
        share = counts[paint] / along.size
        # the paint was chosen by its share: every copy is compared by its best paint
        elsewhere = _shares_elsewhere(shown, len(names), taken, along, across)
        p = (1 + int((elsewhere >= share).sum())) / (1 + elsewhere.size)
        rows.append((along.size, share, names[paint] if counts[paint] else "", p, elsewhere.size))
    columns = dict(zip(_COLUMNS, zip(*rows, strict=True), strict=True))
    return xr.Dataset(
        {
            name: ("region", np.array(values), {} if name == "signature" else {"units": "1"})
            for name, values in columns.items()
        },
        {"region": ("region", list(region_list.names))},
        detections.attrs,
    )


def _counts(shown: Array, paints: int) -> Ints:
    # Number of pixels of each paint (paint,); pixels of -1 show none
    return np.bincount(shown[shown >= 0], minlength=paints)


def _shares_elsewhere(shown: Array, paints: int, taken: Bools, along: Ints, across: Ints) -> Floats:
    # Largest share of a paint in copies of an outline, tiled outside all regions (copy,)
    along, across = along - along.min(), across - across.min()
    high, wide = along.max() + 1, across.max() + 1
    shares = [
        _counts(shown[along + top, across + left], paints).max() / along.size
        for top in range(0, shown.shape[0] - high + 1, high)
        for left in range(0, shown.shape[1] - wide + 1, wide)
        if not taken[along + top, across + left].any()
    ]
    return np.array(shares, np.float64)
