"""Pixels of a region: spectra from a lazy cube; centre, spread, members, number of independent pixels."""

from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import dask
import numpy as np
import numpy.typing as npt
import xarray as xr

from hyperpaint.base import (
    ALONG_TRACK,
    BAND,
    CROSS_TRACK,
    CUBE,
    FLAKE_PAINTS,
    Array,
    Floats,
    Progress,
    Quality,
    SchemaError,
)
from hyperpaint.io.store import client_in_force
from hyperpaint.radiometry.slabs import line_chunked
from hyperpaint.radiometry.uncertainty import effective_number
from hyperpaint.regions import Region
from hyperpaint.surroundings.scratch import trim_memory

CENTRES = ("trimmed_mean", "geometric_median", "median")
QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)

CENTRING = SimpleNamespace(
    #: Maximum distance from the centre of values in the trimmed mean, in standard deviations.
    trim_sigmas=3.0,
    #: Standard deviation of a normal distribution over its median absolute deviation.
    sd_over_mad=1.482602218505602,
    max_iterations=100,
    #: Change of reflectance at which the geometric median has converged [1].
    converged_change=1e-7,
)


def summarise(values: Array, centre: str) -> dict[str, Floats]:
    # Return centre and spread of pixels, band by band, by the names of their variables in a library.
    #
    # ``reflectance`` (band,), their centre, NaN without values; ``reflectance_sd`` (band,), their standard
    # deviation, NaN with less than two values; ``reflectance_quantiles`` (quantile, band), their quantiles at
    # `QUANTILES`; float64. Takes ``values`` (pixel, band): reflectance, a value that is not finite is missing
    # in that band only; ``centre``: one of `CENTRES`.
    #
    # The trimmed mean excludes values farther than three standard deviations from the centre: first from the
    # median, with the standard deviation from the median absolute deviation, then repeatedly from the mean of
    # the remaining values, with their standard deviation, until it excludes no more.
    bands = values.shape[1]
    centres, spreads = np.full(bands, np.nan), np.full(bands, np.nan)
    quantiles = np.full((len(QUANTILES), bands), np.nan)
    for band in range(bands):
        column = values[:, band]
        ordered = np.sort(column[np.isfinite(column)].astype(np.float64))
        if ordered.size:
            # linear quantiles; np.quantile takes ten times as long
            position = np.array(QUANTILES) * (ordered.size - 1)
            lower = position.astype(np.intp)
            quantiles[:, band] = ordered[lower] + (position - lower) * (
                ordered[np.minimum(lower + 1, ordered.size - 1)] - ordered[lower]
            )
            centres[band] = _trimmed_mean(ordered) if centre == "trimmed_mean" else _median(ordered)
        if ordered.size > 1:
            spreads[band] = ordered.std(ddof=1)
    if centre == "geometric_median":
        centres = geometric_median(values)
    return {"reflectance": centres, "reflectance_sd": spreads, "reflectance_quantiles": quantiles}


def _median(ordered: Floats) -> float:
    return float(0.5 * (ordered[(ordered.size - 1) // 2] + ordered[ordered.size // 2]))


def _trimmed_mean(ordered: Floats) -> float:
    centre = _median(ordered)
    spread = CENTRING.sd_over_mad * _median(np.sort(np.abs(ordered - centre)))
    retained = ordered
    for _ in range(CENTRING.max_iterations):
        reach = CENTRING.trim_sigmas * spread
        start = int(np.searchsorted(retained, centre - reach, "left"))
        stop = int(np.searchsorted(retained, centre + reach, "right"))
        # of equal values, rounding may exclude all
        if start >= stop or (start == 0 and stop == retained.size):
            break
        retained = retained[start:stop]
        centre, spread = float(retained.mean()), float(retained.std())
    return float(retained.mean())


def geometric_median(values: Array) -> Floats:
    # Return the spectrum (band,) with the smallest sum of distances to all, by Weiszfeld's algorithm.
    #
    # Takes ``values`` (pixel, band): values that are not finite are missing; the distance of a spectrum is
    # the root mean square over its bands with values.
    has_value = np.isfinite(values)
    filled = np.where(has_value, values, 0.0).astype(np.float64)
    count = np.maximum(has_value.sum(axis=1), 1)
    band_has_value = has_value.any(axis=0)
    centre = np.array(
        [np.median(v[k]) if k.any() else 0.0 for v, k in zip(filled.T, has_value.T, strict=True)]
    )
    for _ in range(CENTRING.max_iterations):
        distance = np.sqrt((np.where(has_value, filled - centre, 0.0) ** 2).sum(axis=1) / count)
        # limits the weight of a spectrum at the centre
        weight = 1.0 / np.maximum(distance, CENTRING.converged_change)
        moved = (filled * weight[:, None]).sum(axis=0) / np.where(
            band_has_value, (has_value * weight[:, None]).sum(axis=0), 1.0
        )
        change = np.abs(moved - centre).max(initial=0.0)
        centre = moved
        if change < CENTRING.converged_change:
            break
    return np.where(band_has_value, centre, np.nan)


def chosen_members(along: Array, across: Array, max_members: int, seed: int) -> npt.NDArray[np.intp]:
    """Return a random selection of pixels (member,), in order: the pixels with the smallest hashes.

    The hash depends only on a pixel's position and the seed, so that the selection does not depend on chunks
    or the number of regions. If a pixel is missing, one other pixel replaces it.

    Takes ``along``, ``across`` (pixel,): positions in the line; ``max_members``: number of selected pixels;
    ``seed``: seed of the hash.

    Examples
    --------
    >>> chosen_members(np.zeros(9, int), np.arange(9), max_members=3, seed=0).size
    3
    """
    mixed = _mix(np.full(1, seed & (2**64 - 1), np.uint64))
    hashed = _mix(_mix(along.astype(np.uint64) + mixed) + across.astype(np.uint64))
    return np.sort(np.argsort(hashed, kind="stable")[:max_members])


def _mix(state: npt.NDArray[np.uint64]) -> npt.NDArray[np.uint64]:
    # Splitmix64 of every number (Steele, Lea and Flood, OOPSLA 2014); arithmetic is modulo 2**64
    mixed = state + np.uint64(0x9E3779B97F4A7C15)
    mixed = (mixed ^ (mixed >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.asarray(mixed ^ (mixed >> np.uint64(31)))


#: Minimum number of pixels for each independent pixel, 1 + 2 c, with the correlation c of neighbours along
#: the track that motion causes. During an exposure the camera moves by some 0.7 of a pixel, so that the
#: response of a pixel along the track is a trapezium; over an uncorrelated scene
#: c = (0.7 / 6) / (0.3 + 2 * 0.7 / 3) = 0.15.
SMEAR = 1.3

#: Minimum number of pixels for an estimate of their correlation.
MIN_CORRELATED_PIXELS = 32

#: Maximum size of the grid on which correlation is computed [pixel]; only the first lines of a larger region
#: are used.
MAX_GRID_PIXELS = 2**18


def effective_pixels(values: Array, along: Array, across: Array) -> float:
    r"""Return the number of independent pixels whose mean is as certain as the mean of these pixels.

    Takes ``values`` (pixel, band): reflectance in some bands, NaN where missing; ``along``, ``across``
    (pixel,): positions in the line.

    Notes
    -----
    .. math:: n_{eff} = n^2 \Big/ \sum_{ij} \overline{c_{ij}}

    with :math:`c_{ij}` the autocorrelation of a band's values at the distance of two pixels, summed from the
    centre outwards until it cannot be distinguished from zero (as `hyperpaint.radiometry.mean_uncertainty`),
    averaged over bands, which gives the harmonic mean of the numbers of the bands. Values are first clipped
    at three robust standard deviations from the median, since single outliers hide the correlation of their
    neighbours. The result is at most n / 1.3, see `SMEAR`; for fewer than 32 pixels, too few for an estimate,
    it is n / 1.3.
    """
    count = len(values)
    max_effective = max(1.0, count / SMEAR)
    if count < MIN_CORRELATED_PIXELS:
        return max_effective
    rows, columns = along - along.min(), across - across.min()
    width = int(columns.max()) + 1
    in_grid = rows < max(1, MAX_GRID_PIXELS // width)
    rows, columns, values = rows[in_grid], columns[in_grid], values[in_grid]
    ratios = []
    for band in range(values.shape[1]):
        has_value = np.isfinite(values[:, band])
        if has_value.sum() >= MIN_CORRELATED_PIXELS:
            column = values[has_value, band].astype(np.float64)
            median = np.median(column)
            reach = 3.0 * 1.4826 * np.median(np.abs(column - median))
            plane = np.full((int(rows.max()) + 1, width), np.nan)
            plane[rows[has_value], columns[has_value]] = np.clip(column, median - reach, median + reach)
            ratios.append(has_value.sum() / effective_number(plane))
    return float(np.clip(count / np.mean(ratios), 1.0, max_effective)) if ratios else max_effective


#: Flags that the light of flakes raises.
_OF_FLAKES = Quality.GLINT | Quality.ADJACENCY | Quality.MIXED_EDGE


def words_of(region: Region) -> set[str]:
    # Return the words that name the surface of a region.
    words = {str(region.properties.get(name, "")).strip().lower() for name in ("kind", "material", "finish")}
    return words | {"matt"} if "matte" in words else words


def excluded_of(region: Region, default: int) -> int:
    # Return the flags whose pixels a region excludes: its property ``excluded_flags``, or ``default``.
    #
    # Of paint with flakes pixels in glint, in the light of neighbours and at edges stay: its flakes' light
    # looks like them.
    names = region.properties.get("excluded_flags")
    if names is None:
        return default & ~int(_OF_FLAKES) if words_of(region) & FLAKE_PAINTS else default
    flags = {flag.name.lower(): int(flag) for flag in Quality if flag.name}
    SchemaError.raise_if(
        not isinstance(names, list) or not set(names) <= set(flags),
        f"region {region.name!r}: excluded_flags is {names!r:.80}",
        expected=f"a list of {', '.join(flags)}",
        code="choice-unknown",
    )
    return sum(flags[name] for name in set(names))


# --- spectra of selected pixels of a lazy cube: only blocks with such pixels are computed ------------------


#: Number of blocks computed together.
BLOCKS_AT_ONCE = 16


def gather(
    cubes: Mapping[str, xr.DataArray],
    planes: Mapping[str, xr.DataArray],
    along: Array,
    across: Array,
    bands: slice,
    small: Mapping[str, xr.DataArray],
    progress: Progress | None = None,
) -> tuple[dict[str, Array], dict[str, Array]]:
    # Return the spectra of pixels by cube, and values of other variables, both by name.
    #
    # Spectra are (pixel, band), float32. The other values are those of ``planes`` (pixel,) and ``small``
    # (along_track,), and ``present`` (pixel,): whether a pixel has a value in any band of the first cube,
    # also outside ``bands``.
    #
    # Takes ``cubes``: cubes (along_track, band, cross_track), by name; ``planes``: variables (along_track,
    # cross_track), by name; ``along``, ``across`` (pixel,): positions; ``bands``: slice of the bands;
    # ``small``: variables (along_track), read completely in the same pass; ``progress``: called with the
    # numbers of computed and of all blocks.
    first = next(iter(cubes.values()))
    # a flight line is computed in slabs of lines, a map in its tiles
    sizes = (line_chunked(first) if first.chunks is None else first).variable.chunksizes
    chunks: dict[str, Any] = {dim: sizes[dim] for dim in (ALONG_TRACK, CROSS_TRACK)}
    aligned = [cube.transpose(*CUBE).chunk({**chunks, BAND: -1}) for cube in cubes.values()]
    aligned += [plane.transpose(ALONG_TRACK, CROSS_TRACK).chunk(chunks) for plane in planes.values()]
    blocks = [array.data.to_delayed(optimize_graph=False).ravel() for array in aligned]
    # block of every pixel, and the pixels of every block
    rows, columns = (np.concatenate([[0], np.cumsum(sizes)]) for sizes in chunks.values())
    block_row, block_column = (
        np.searchsorted(edges, positions, side="right") - 1
        for edges, positions in ((rows, along), (columns, across))
    )
    pixel_block = block_row * (len(columns) - 1) + block_column
    order = np.argsort(pixel_block, kind="stable")
    used_blocks, starts = np.unique(pixel_block[order], return_index=True)
    block_pixels = np.split(order, starts[1:]) if used_blocks.size else []
    select = dask.delayed(_selected, pure=False)
    row, column = along - rows[block_row], across - columns[block_column]
    tasks = [
        select([arrays[block] for arrays in blocks], len(cubes), row[pixels], column[pixels], bands)
        for block, pixels in zip(used_blocks, block_pixels, strict=True)
    ]
    lazy = {
        name: dask.delayed(np.concatenate)(list(array.data.to_delayed(optimize_graph=False)))
        for name, array in small.items()
        if array.chunks is not None
    }
    values = {name: array.values for name, array in small.items() if name not in lazy}
    width = len(range(*bands.indices(first.sizes[BAND])))
    spectra = {name: np.empty((along.size, width), np.float32) for name in cubes}
    values |= {name: np.empty(along.size, plane.dtype) for name, plane in planes.items()}
    values["present"] = np.empty(along.size, bool)
    outputs = [*spectra.values(), *(values[name] for name in planes), values["present"]]
    # results are deleted once copied: they would otherwise be in memory twice
    for start in range(0, max(len(tasks), 1), BLOCKS_AT_ONCE):
        batch = tasks[start : start + BLOCKS_AT_ONCE]
        results = _computed([*batch, *([] if start else lazy.values())], progress, start, len(tasks))
        for pixels, arrays in zip(block_pixels[start : start + BLOCKS_AT_ONCE], results, strict=False):
            for output, array in zip(outputs, arrays, strict=True):
                output[pixels] = array
        if not start:
            values |= dict(zip(lazy, results[len(batch) :], strict=True))
        del results
        trim_memory()
    return spectra, values


def _selected(blocks: list[Array], cubes: int, rows: Array, columns: Array, bands: slice) -> list[Array]:
    # Pixels of the cubes (pixel, band) and planes (pixel,) in a block, and whether they have a value (pixel,)
    spectra = [block[rows, bands, columns].astype(np.float32, copy=False) for block in blocks[:cubes]]
    present = np.asarray(np.isfinite(blocks[0]).any(axis=1))[rows, columns]
    return [*spectra, *(block[rows, columns] for block in blocks[cubes:]), present]


def _computed(tasks: list[Any], progress: Progress | None, finished: int, total: int) -> list[Any]:
    # Compute a batch of tasks after ``finished`` ones; a batch may hold more than the ``total`` counts
    if progress is None or not tasks:
        return list(dask.compute(*tasks))
    client = client_in_force()
    if client is not None:
        from distributed import as_completed

        futures = client.compute(tasks)
        for count, _ in enumerate(as_completed(futures), start=1):
            progress(min(finished + count, total), total)
        return list(client.gather(futures))
    from dask.callbacks import Callback

    waiting = {task.key for task in tasks}

    def report(key: Any, *_: Any) -> None:
        if key in waiting:
            waiting.discard(key)
            progress(min(finished + len(tasks) - len(waiting), total), total)

    with Callback(posttask=report):
        return list(dask.compute(*tasks))
