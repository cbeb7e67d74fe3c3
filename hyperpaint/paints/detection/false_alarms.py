"""Statistics of the background, and thresholds at a stated false-alarm rate."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hyperpaint.base.arrays import Array, Bools, Floats, Ints
from hyperpaint.base.errors import PaintWarning, SchemaError

from .detectors import Projection, distances, projection, scores


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
        if settings.method == "spectral_angle":
            project = projection(paints, sky)
        else:
            project = projection(paints, sky, mean, shrunk)
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
