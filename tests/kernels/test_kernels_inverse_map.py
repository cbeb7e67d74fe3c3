"""The inverse map against plain numpy, which asks every cell of every patch."""

import numpy as np
import pytest
from scipy.optimize import fsolve

from hyperpaint.kernels.arguments import InverseTile, LinePositions, MapCells
from hyperpaint.kernels.rays import FIRST, LAST, NADIR, fill_between, invert_lines

UNIT = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 1.0])  # metres to the east are columns, to the north rows


def inverted(east, north, shape, *, rule=NADIR, longest=1e9, first=0, last=None, slab=None, corner=(0, 0)):
    # Run the kernel, in slabs of lines where wanted
    place, nearest = np.full((2, *shape), np.nan), np.full((2, *shape), -1, np.int32)
    rank, hits = np.full(shape, np.inf), np.zeros(shape, np.uint16)
    last = first + len(east) - 1 if last is None else last
    before = np.full((2, east.shape[1]), np.nan)
    for start in range(0, len(east), slab or len(east)):
        e, n = (part[start : start + (slab or len(east))].copy() for part in (east, north))
        cells = MapCells(UNIT, corner, longest, rule)
        out = InverseTile(place, nearest, rank, hits)
        invert_lines(LinePositions(e, n, *before, np.zeros((0, 0), bool)), first + start, last, cells, out)
        before = np.stack([e[-1], n[-1]])
    return place, nearest, hits


def oracle(east, north, shape, rule=NADIR):
    # Return the place of every cell: fsolve on the patch of each convex quadrilateral that holds it
    place, hits = np.full((2, *shape), np.nan), np.zeros(shape, int)
    best = np.full(shape, np.inf)
    for i in range(east.shape[0] - 1):
        for j in range(east.shape[1] - 1):
            c = np.array([[[e[i + k, j + m] for m in (0, 1)] for k in (0, 1)] for e in (east, north)])
            for row in range(shape[0]):
                for col in range(shape[1]):
                    turn = [
                        (b[0] - a[0]) * (row - a[1]) - (b[1] - a[1]) * (col - a[0])
                        for a, b in (
                            (c[:, 0, 0], c[:, 0, 1]), (c[:, 0, 1], c[:, 1, 1]),
                            (c[:, 1, 1], c[:, 1, 0]), (c[:, 1, 0], c[:, 0, 0]),
                        )
                    ]  # fmt: skip
                    if not (min(turn) > 0 or max(turn) < 0):
                        continue

                    def off(vu, c=c, row=row, col=col):
                        v, u = vu
                        weights = np.array([[(1 - v) * (1 - u), (1 - v) * u], [v * (1 - u), v * u]])
                        return (c * weights).sum(axis=(1, 2)) - (col, row)

                    v, u = fsolve(off, (0.5, 0.5), xtol=1e-11)
                    hits[row, col] += 1
                    worth = {NADIR: abs(j + u - (east.shape[1] - 1) / 2), FIRST: i + v, LAST: -i - v}[rule]
                    if worth < best[row, col]:
                        best[row, col] = worth
                        place[:, row, col] = i + v, j + u
    return place, hits


def bent(seed, lines=6, columns=7):
    # Return pixels of a crooked grid, some 2 cells apart
    rng = np.random.default_rng(seed)
    north, east = np.meshgrid(2.0 * np.arange(lines), 2.0 * np.arange(columns), indexing="ij")
    return east + rng.uniform(-0.6, 0.6, east.shape) + 0.13, north + rng.uniform(-0.6, 0.6, east.shape) + 0.17


@pytest.mark.parametrize("rule", [NADIR, FIRST, LAST])
@pytest.mark.parametrize("seed", range(3))
def test_places_are_those_of_the_patches(seed: int, rule: int) -> None:
    east, north = bent(seed)
    north[4:] -= 3.0  # back over itself: some cells are shown twice
    shape = (9, 11)
    place, _, hits = inverted(east, north, shape, rule=rule)
    wanted, covered = oracle(east, north, shape, rule)
    # quadrilaterals that a fold has turned inside out are covered by the kernel alone
    once = (covered == hits) & (covered > 0)
    assert once.mean() > 0.5
    assert (hits >= covered).all()
    np.testing.assert_allclose(place[:, once], wanted[:, once], atol=1e-9)


def test_slabs_tiles_and_numbers_of_lines_make_no_difference() -> None:
    east, north = bent(5, 12, 9)
    whole = inverted(east, north, (24, 18))
    for slab in (1, 2, 4):
        for one, other in zip(whole, inverted(east, north, (24, 18), slab=slab), strict=True):
            np.testing.assert_array_equal(one, other)
    for one, part in zip(whole, inverted(east, north, (4, 6), corner=(3, 5)), strict=True):
        np.testing.assert_array_equal(part, one[..., 3:7, 5:11])
    far, *_ = inverted(east, north, (24, 18), first=1_000_000)
    np.testing.assert_allclose(far[0] - 1_000_000, whole[0][0], atol=1e-9)


def test_every_cell_belongs_to_one_patch() -> None:
    # pixels on centres of cells: all lie on corners of patches
    north, east = np.meshgrid(np.arange(5.0), np.arange(6.0), indexing="ij")
    place, nearest, hits = inverted(east, north, (5, 6))
    assert (hits == 1).all()
    np.testing.assert_array_equal(place, np.stack([north, east]))
    np.testing.assert_array_equal(nearest, np.stack([north, east]))


def test_the_nearest_corner_is_the_nearest_pixel() -> None:
    east, north = bent(7, 8, 8)
    place, nearest, _ = inverted(east, north, (14, 14))
    rows, cols = np.nonzero(np.isfinite(place[0]))
    line, column = np.floor(place[:, rows, cols]).astype(int)
    line, column = np.minimum(line, 6), np.minimum(column, 6)
    away = [
        np.hypot(east[line + i, column + j] - cols, north[line + i, column + j] - rows)
        for i in (0, 1)
        for j in (0, 1)
    ]
    taken = np.hypot(east[tuple(nearest[:, rows, cols])] - cols, north[tuple(nearest[:, rows, cols])] - rows)
    np.testing.assert_allclose(taken, np.min(away, axis=0), atol=1e-12)


def test_what_is_not_known_or_torn_covers_nothing() -> None:
    east, north = bent(1)
    _, _, whole = inverted(east, north, (11, 13))
    east[2, 3] = np.nan
    place, nearest, hits = inverted(east, north, (11, 13))
    assert 0 < (hits == 0).sum() - (whole == 0).sum() <= 30
    assert (np.isnan(place[0]) == (hits == 0)).all()
    assert ((nearest[0] < 0) == (hits == 0)).all()
    torn = north + np.where(np.arange(6) >= 3, 40.0, 0.0)[:, None]
    _, _, hits = inverted(east, torn, (60, 13), longest=10.0)
    assert hits[8:40].sum() == 0
    assert hits[:4].sum() > 0
    assert hits[48:].sum() > 0


def test_a_line_that_folds_back_is_hit_twice_by_the_rule() -> None:
    east = np.broadcast_to(np.arange(4.0) - 0.3, (5, 4)).copy()
    north = np.broadcast_to(np.array([0.0, 2.0, 4.0, 2.0, 0.0])[:, None] + 0.4, (5, 4)).copy()
    first, *_, hits = inverted(east, north, (4, 3), rule=FIRST)
    last, *_ = inverted(east, north, (4, 3), rule=LAST)
    assert (hits[1:] == 2).all()
    np.testing.assert_allclose(first[0, 1], 0.3, atol=1e-12)
    np.testing.assert_allclose(last[0, 1], 3.7, atol=1e-12)


def test_between_the_ends() -> None:
    # a square, and two triangles that meet where its lines cross
    square = np.array([[[1.0, 1.0], [5.0, 1.0], [5.0, 4.0], [1.0, 4.0]]]) - 0.25
    inside = np.zeros((6, 7), bool)
    fill_between(square, UNIT, (0, 0), inside)
    assert inside.sum() == 4 * 3
    assert inside[1:4, 1:5].all()
    crossed = np.array([[[0.0, 0.0], [10.0, 10.0], [10.0, 0.1], [0.0, 9.9]]]) + 0.01
    inside = np.zeros((11, 11), bool)
    fill_between(crossed, UNIT, (0, 0), inside)
    assert inside[5, 2]
    assert inside[5, 8]
    assert not inside[2, 5]
    assert not inside[8, 5]
