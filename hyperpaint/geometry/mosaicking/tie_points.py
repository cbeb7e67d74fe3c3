"""Tie points: the same places on the ground in two overlapping lines, found by correlation."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from hyperpaint.base.errors import SchemaError
from hyperpaint.base.facts import documented, takes_quantities
from hyperpaint.base.schema import ALONG_TRACK, BAND, CROSS_TRACK, CUBE, Array, Floats, Progress
from hyperpaint.geometry.georeference.poses import LOCATION_UNITS
from hyperpaint.geometry.orthorectification.mapping import orthorectify

from .strips import is_map, located_lines, named_lines, shared_grid

_CUBE_NAMES = ("counts", "radiance", "reflectance")
_FIELDS = ("glt_line", "glt_sample", "ground_height")


@dataclass(frozen=True)
class Rules:
    """Thresholds of the search, and their origin."""

    #: Cells from the middle of a patch to its edge: large enough for a few objects, small enough that the
    #: camera's errors are one shift in it.
    half_patch: int = 20
    #: Smallest correlation accepted as the same place. Noise of half the contrast leaves 0.8.
    min_correlation: float = 0.8
    #: Largest correlation elsewhere, relative to the best: beyond it the pattern repeats.
    max_rival: float = 0.9
    #: Smallest standard deviation of a patch along its flattest direction, relative to its mean.
    min_texture: float = 0.01
    max_patches: int = 150  #: patches of a pair of lines, those with the most texture
    outlier_sd: float = 4.0  #: standard deviations of shifts from a plane through those of a pair


RULES = Rules()


class _Picture(NamedTuple):
    corner: tuple[int, int]
    image: Floats  #: (row, col); NaN where nothing is shown
    fields: Floats  #: (field, row, col): of `_FIELDS`


@takes_quantities(**LOCATION_UNITS, gsd="m", search_m="m")
@documented()
def find_tie_points(
    lines: Mapping[str, xr.Dataset] | Sequence[xr.Dataset],
    gsd: float | None = None,
    *,
    search_m: float | None = None,
    band: int | None = None,
    rules: Rules = RULES,
    progress: Progress | None = None,
    **location: Any,
) -> xr.Dataset:
    """Find ground points that two overlapping lines show, for `hyperpaint.geometry.solve_boresight` (eager).

    Parameters
    ----------
    lines
        Flight lines by their names, located or to be located with the options of
        `hyperpaint.geometry.locate`.
    gsd
        Edge of a cell in which pictures are compared [m]; by default twice the largest spacing of pixels.
    search_m
        Largest distance on the map between the two positions of a point [m]; by default 16 cells. It should
        be less than half the distance at which the ground repeats itself.
    band
        Number of the band to compare, of counts, else radiance, else reflectance; by default the middle one.
    rules
    progress
    **location

    Returns
    -------
    xarray.Dataset
        ``along_track_pixel`` and ``cross_track_pixel`` (point, side): position in each of the two lines, in
        fractions of a pixel from the centre of the first; ``flightline`` (point, side); ``east``, ``north``
        and ``height`` (point) [m]: ground position by the first line; ``shift`` (point, side): position by
        the second line minus the first, east and north [m]; ``quality`` (point): correlation, at most 1.

    Raises
    ------
    SchemaError
        Fewer than two lines, maps instead of lines, no cube, or no tie points in the overlaps.

    Notes
    -----
    Both lines are resampled bilinearly on one grid with north up. Patches with texture in every direction are
    searched in the other line by normalised cross-correlation, whose peak is refined by a paraboloid.
    Patterns that repeat within the search, and shifts off a plane through all shifts of a pair, are left out.

    Examples
    --------
    >>> from hyperpaint.geometry import locate
    >>> from hyperpaint.simulation import simulate_line
    >>> size = dict(lines=400, bands=2, columns=400, swath=6.0, square=0.64)
    >>> lines = {
    ...     seed: locate(simulate_line(scene="checkerboard", wobble="calm", seed=seed, **size), ground=160.0)
    ...     for seed in (0, 1)}
    >>> ties = find_tie_points(lines, search_m=0.4)
    >>> ties.sizes["point"] > 30, float(abs(ties["shift"]).max()) < 0.01  # [m]
    (True, True)
    """
    lines_by_name = named_lines(lines)
    SchemaError.raise_if(
        len(lines_by_name) < 2 or any(map(is_map, lines_by_name.values())),
        "tie points need two flight lines or more, in the geometry of the camera",
        code="line-number",
    )
    lines_by_name = located_lines(lines_by_name, location)
    gsd = 2.0 * shared_grid(lines_by_name, None, None).grid.gsd if gsd is None else gsd
    shared = shared_grid(lines_by_name, gsd, None)
    pictures = {name: _picture(line, shared.grids[name], gsd, band) for name, line in lines_by_name.items()}
    reach = 16 if search_m is None else max(1, round(search_m / gsd))
    pairs = list(itertools.combinations(lines_by_name, 2))
    rows, names = [], []
    for count, (first, second) in enumerate(pairs, start=1):
        ties = _ties_of(pictures[first], pictures[second], reach, rules)
        rows.append(ties)
        names += [(first, second)] * len(ties)
        if progress is not None:
            progress(count, len(pairs))
    table = np.concatenate(rows)
    SchemaError.raise_if(
        not len(table),
        f"no tie points between {', '.join(lines_by_name)}",
        expected=f"lines that overlap by more than {2 * rules.half_patch * gsd:.3g} m",
        mend="give a larger search_m=, another band= or gsd=",
        code="tie-points-missing",
    )
    east, north = shared.grid.axes.anchor
    row, col, shift_down, shift_right, quality, height = table[:, :6].T
    pixels = table[:, 6:].reshape(-1, 2, 2)
    side = ("point", "side")
    return xr.Dataset(
        {
            "along_track_pixel": (side, pixels[:, :, 0]),
            "cross_track_pixel": (side, pixels[:, :, 1]),
            "flightline": (side, np.array(names)),
            "east": ("point", east + (col + 0.5) * gsd, {"units": "m"}),
            "north": ("point", north - (row + 0.5) * gsd, {"units": "m"}),
            "height": ("point", height, {"units": "m"}),
            "shift": (side, np.stack([shift_right, -shift_down], axis=-1) * gsd, {"units": "m"}),
            "quality": ("point", quality, {"units": "1", "long_name": "Correlation of the two pictures"}),
        },
        attrs={"crs": next(iter(lines_by_name.values()))["east"].attrs.get("crs"), "gsd": gsd},
    )


def _picture(line: xr.Dataset, grid: Any, gsd: float, band: int | None) -> _Picture:
    cubes = [name for name in _CUBE_NAMES if name in line.variables and set(line[name].dims) == set(CUBE)]
    SchemaError.raise_if(
        not cubes or "ground_height" not in line.variables,
        "a line has no counts, radiance or reflectance, or no ground_height",
        mend="locate lines with hyperpaint.geometry.locate before",
        code="variable-missing",
    )
    number = line.sizes[BAND] // 2 if band is None else band
    image = line[cubes[0]].isel({BAND: number}, drop=True).astype(np.float32)
    names = {name for name in line.data_vars if BAND in line[name].dims}
    # without index coordinates the map holds positions in the line, also for a crop
    other = [n for n in line.coords if BAND in line[n].dims or n in (ALONG_TRACK, CROSS_TRACK)]
    orthomap = orthorectify(
        line.drop_vars([*names, *other]).assign(picture=image.drop_vars(other, errors="ignore")),
        gsd,
        grid="north",
        variables=["picture", "ground_height"],
        method="bilinear",
    )[["picture", *_FIELDS]].compute()
    return _Picture(
        grid.first,
        orthomap["picture"].values.astype(np.float64),
        np.stack([orthomap[name].values for name in _FIELDS]),
    )


def _ties_of(first_picture: _Picture, second_picture: _Picture, reach: int, rules: Rules) -> Floats:
    # Return row, col, shift down and right, correlation, height and pixels of ties (tie, 10).
    half = rules.half_patch
    low = np.maximum(first_picture.corner, second_picture.corner)
    high = np.minimum(
        np.add(first_picture.corner, first_picture.image.shape),
        np.add(second_picture.corner, second_picture.image.shape),
    )
    if (high - low <= 2 * half).any():
        return np.empty((0, 10))
    centres = [
        (row, col)
        for row in range(low[0] + half, high[0] - half, half)
        for col in range(low[1] + half, high[1] - half, half)
    ]
    textures = np.array([_texture(_window(first_picture, centre, half)) for centre in centres])
    order = np.argsort(-textures, kind="stable")[: rules.max_patches]
    ties = []
    for centre in (centres[k] for k in order if textures[k] > rules.min_texture):
        shift, quality = _match(
            _window(first_picture, centre, half), _window(second_picture, centre, half + reach), rules
        )
        if quality < rules.min_correlation:
            continue
        pixel_first = _fields_at(first_picture, np.array(centre, float))
        pixel_second = _fields_at(second_picture, np.array(centre) + shift)
        tie = [*centre, *shift, quality, pixel_first[2], *pixel_first[:2], *pixel_second[:2]]
        if np.isfinite(tie).all():
            ties.append(tie)
    table = np.array(ties, np.float64).reshape(-1, 10)
    # leave out ties with shifts off a plane through all shifts of the pair
    is_near = np.ones(len(table), bool)
    if len(table) < 6:
        return table
    terms = np.column_stack([np.ones(len(table)), table[:, :2] - table[:, :2].mean(axis=0, keepdims=True)])
    for _ in range(10):
        plane = np.linalg.lstsq(terms[is_near], table[is_near, 2:4], rcond=None)[0]
        distance = np.linalg.norm(table[:, 2:4] - terms @ plane, axis=1)
        limit = rules.outlier_sd * max(float(np.median(distance[is_near])) / 1.1774, 0.05)
        before, is_near = is_near, distance < limit
        if is_near.sum() < 6 or (is_near == before).all():
            break
    return table[is_near]


def _window(picture: _Picture, place: Sequence[int], half: int) -> Floats:
    # Return the part of the picture around a cell; NaN beyond the picture.
    out = np.full((2 * half + 1,) * 2, np.nan)
    low = [k - half - c for k, c in zip(place, picture.corner, strict=True)]
    begin = [max(k, 0) for k in low]
    end = [min(k + 2 * half + 1, size) for k, size in zip(low, picture.image.shape, strict=True)]
    if begin[0] < end[0] and begin[1] < end[1]:
        covered = tuple(slice(b - k, e - k) for b, e, k in zip(begin, end, low, strict=True))
        out[covered] = picture.image[begin[0] : end[0], begin[1] : end[1]]
    return out


def _texture(patch: Floats) -> float:
    # Return the root of the smaller eigenvalue of the mean product of gradients, relative to the mean.
    if np.isnan(patch).any() or not patch.mean() > 0.0:
        return 0.0
    down, right = np.gradient(patch / patch.mean())
    mixed = float((down * right).mean())
    matrix = np.array([[float((down**2).mean()), mixed], [mixed, float((right**2).mean())]])
    return float(np.sqrt(max(np.linalg.eigvalsh(matrix)[0], 0.0)))


def _match(patch: Floats, window: Floats, rules: Rules) -> tuple[Floats, float]:
    # Return the offset of a patch from the middle of a window (rows, columns), and its correlation.
    from scipy.ndimage import maximum_filter
    from scipy.signal import fftconvolve

    no_match = np.zeros(2), 0.0
    is_shown = np.isfinite(window)
    if is_shown.mean() < 0.25:
        return no_match
    size, mean = patch.size, float(window[is_shown].mean())
    filled = np.where(is_shown, window - mean, 0.0)
    weights = patch - patch.mean()
    box = np.ones(patch.shape)
    sums, squares, counts = (
        fftconvolve(values, box, "valid") for values in (filled, filled**2, is_shown * 1.0)
    )
    spread = np.sqrt(np.maximum(squares - sums**2 / size, 1e-12 * mean**2)) * np.linalg.norm(weights)
    score = fftconvolve(filled, weights[::-1, ::-1], "valid") / spread
    score[counts < size - 0.5] = -1.0  # only complete patches are compared
    peak = np.unravel_index(int(np.argmax(score)), score.shape)
    best, reach = float(score[peak]), score.shape[0] // 2
    if not all(0 < k < n - 1 for k, n in zip(peak, score.shape, strict=True)):
        return no_match
    neighbourhood = score[peak[0] - 1 : peak[0] + 2, peak[1] - 1 : peak[1] + 2]
    # the highest local maximum other than the peak
    rivals = np.where(score == maximum_filter(score, 5), score, -1.0)
    rivals[tuple(peak)] = -1.0
    if neighbourhood.min() <= -1.0 or float(rivals.max()) > rules.max_rival * best:
        return no_match
    # the maximum of the paraboloid through the 3 x 3 values, from the middle one
    y, x = np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0], indexing="ij")
    terms = np.stack([np.ones(9), y.ravel(), x.ravel(), y.ravel() ** 2, x.ravel() ** 2, (x * y).ravel()], 1)
    _, a, b, aa, bb, ab = np.linalg.lstsq(terms, neighbourhood.ravel(), rcond=None)[0]
    summit = np.zeros(2)
    with contextlib.suppress(np.linalg.LinAlgError):
        summit = np.clip(np.linalg.solve(np.array([[2 * aa, ab], [ab, 2 * bb]]), [-a, -b]), -1.0, 1.0)
    return np.array(peak) - reach + summit, best


def _fields_at(picture: _Picture, cell: Array) -> Floats:
    # Interpolate the fields at a fractional row and column; NaN beyond the picture.
    from scipy.ndimage import map_coordinates

    position = (cell - picture.corner)[:, None]
    values = [map_coordinates(values, position, order=1, cval=np.nan)[0] for values in picture.fields]
    return np.array(values)
