"""One factor per line and band that makes lines agree where they overlap."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial

import dask
import numpy as np

from hyperpaint.base.arrays import Bools, Floats, Ints
from hyperpaint.base.errors import SchemaError

from .strips import Recipe

LEVELLED_BY = ("hits", "quality")  # planes needed besides the spectra


@dataclass(frozen=True)
class Rules:
    """Thresholds of the factors, and their origin."""

    step: int = 2  #: every second row and column is used: neighbouring cells are redundant
    min_cells: int = 20  #: cells of a tile in which two lines must overlap
    #: Standard deviations beyond which a tile counts less: 95 % efficient for normal errors (Huber 1964).
    huber_sd: float = 1.345
    rounds: int = 20


RULES = Rules()


def overlap_factors(
    tiles: Iterable[dict[int, Recipe]], lines: int, bands: int, wavelength: Floats | None = None
) -> tuple[Floats, Bools]:
    """Return factors (line, band) that make lines agree where they overlap (eager, a tile at a time).

    And whether the factor of an overlapping line is interpolated from neighbouring bands (line, band).

    ``tiles`` make `LEVELLED_BY` and spectra of every line of a tile, by its number. Robust least squares on
    the logarithm of the medians of tiles, over unflagged cells. Lines connected by overlaps keep their mean
    logarithm; lines without enough overlap have the factor 1. Two lines do not overlap in a band that is 0
    or less in one of them; a factor of 1 there would be a step in the spectrum, so the logarithm is
    interpolated line by line over ``wavelength`` (band,), or band numbers, and constant beyond the outermost
    bands.

    Raises
    ------
    SchemaError
        No two lines overlap.
    """
    # recipes are bound to the callable: dask would search arguments for tasks
    tasks = [
        dask.delayed(partial(_ratios, tile), pure=False, traverse=False)() for tile in tiles if len(tile) > 1
    ]
    ratios = [ratio for tile in dask.compute(*tasks) for ratio in tile]
    if not ratios:
        raise SchemaError(
            "lines cannot be levelled: no two lines overlap in unflagged cells",
            mend="leave out levelling=",
            code="overlap-missing",
        )
    incidence = np.zeros((len(ratios), lines))
    for row, (first, second, _, _) in enumerate(ratios):
        incidence[row, first], incidence[row, second] = -1.0, 1.0
    weights = np.sqrt(np.stack([cells for _, _, cells, _ in ratios]))
    observed = np.stack([log_ratio for *_, log_ratio in ratios])
    # lines connected by overlaps in any band must be connected in this band too
    parts_of_all = _connected_parts(incidence)
    logs = np.zeros((lines, bands))
    is_tied = np.zeros((lines, bands), bool)
    for band in range(bands):
        is_observed = np.isfinite(observed[:, band])
        if is_observed.any():
            logs[:, band] = _robust_fit(
                incidence[is_observed], observed[is_observed, band], weights[is_observed, band]
            )
            parts = _connected_parts(incidence[is_observed])
            is_tied[:, band] = [np.unique(parts[parts_of_all == number]).size == 1 for number in parts_of_all]
    overlapping: Bools = np.any(incidence != 0.0, axis=0)
    interpolated = overlapping[:, None] & ~is_tied & is_tied.any(axis=1, keepdims=True)
    position = np.arange(bands, dtype=np.float64) if wavelength is None else wavelength
    for line in np.flatnonzero(interpolated.any(axis=1)):
        tied_bands = np.flatnonzero(~interpolated[line])
        tied_bands = tied_bands[np.argsort(position[tied_bands], kind="stable")]
        gap_bands = interpolated[line]
        logs[line, gap_bands] = np.interp(position[gap_bands], position[tied_bands], logs[line, tied_bands])
    return np.exp(logs), interpolated


def _connected_parts(incidence: Floats) -> Ints:
    # Return the lowest line number in the connected part of each line (line,).
    parts = np.arange(incidence.shape[1])
    pairs = np.argsort(-np.abs(incidence), axis=1, kind="stable")[:, :2]
    for _ in range(parts.size):
        before = parts.copy()
        for first, second in np.unique(pairs, axis=0):
            parts[[first, second]] = min(parts[first], parts[second])
        if (parts == before).all():
            break
    return parts


def _ratios(recipes: dict[int, Recipe]) -> list[tuple[int, int, Floats, Floats]]:
    # Return pairs of lines and per band the number of common cells and the median of log(first / second),
    # NaN where there are too few cells.
    logs = {}
    for number, recipe in recipes.items():
        hits, quality, cube = (values[:: RULES.step, :: RULES.step] for values in recipe())
        is_good = ((hits > 0) & (quality == 0))[..., None] & (cube > 0.0)
        logs[number] = np.log(np.where(is_good, cube, np.nan))
    ratios = []
    for first, second in itertools.combinations(logs, 2):
        difference = (logs[first] - logs[second]).reshape(-1, logs[first].shape[2])
        cells = np.isfinite(difference).sum(axis=0)
        is_enough = cells >= RULES.min_cells
        if is_enough.any():
            median = np.full(cells.shape, np.nan)
            median[is_enough] = np.nanmedian(difference[:, is_enough], axis=0)
            ratios.append((first, second, cells.astype(np.float64), median))
    return ratios


def _robust_fit(incidence: Floats, observed: Floats, weights: Floats) -> Floats:
    # Return logarithms of factors (line,), whose mean is 0 over connected lines.
    huber_weights = np.ones_like(observed)
    for _ in range(RULES.rounds):
        scaled = (weights * np.sqrt(huber_weights))[:, None]
        solution = np.linalg.lstsq(scaled * incidence, scaled[:, 0] * observed, rcond=1e-9)[0]
        residuals = np.abs(observed - incidence @ solution)
        limit = RULES.huber_sd * max(1.4826 * float(np.median(residuals)), 1e-6)
        huber_weights = limit / np.maximum(residuals, limit)
    return np.asarray(solution)
