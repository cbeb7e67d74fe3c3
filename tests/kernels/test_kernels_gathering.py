"""Gathering against fancy indexing and scipy's interpolation."""

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from hyperpaint.kernels.arguments import Places
from hyperpaint.kernels.rays import gather_bilinear, gather_nearest


def pixels(count: int, lines: int, columns: int, seed: int = 0):
    rng = np.random.default_rng(seed)
    line = np.sort(rng.integers(0, lines, count))
    return line, rng.integers(0, columns, count), rng.permutation(count)


@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_nearest_is_indexing(dtype) -> None:
    slab = (1000 * np.random.default_rng(1).random((5, 7, 40))).astype(dtype)
    line, column, cell = pixels(60, 5, 40)
    out = np.zeros((60, 7), dtype)
    gather_nearest(slab, line, column, cell, np.empty((40, 7), dtype), out)
    wanted = np.empty_like(out)
    wanted[cell] = slab[line, :, column]
    np.testing.assert_array_equal(out, wanted)


@pytest.mark.parametrize(("dtype", "made"), [(np.uint16, np.float32), (np.float64, np.float64)])
def test_bilinear_is_interpolation(dtype, made) -> None:
    rng = np.random.default_rng(2)
    cube = (1000 * rng.random((6, 3, 20))).astype(dtype)
    line, column, cell = pixels(50, 5, 19)
    along, across = rng.random((2, 50)).astype(made)
    out = np.zeros((50, 3), made)
    turned = np.empty((20, 3), made)
    places = Places(line, column, along, across, cell)
    gather_bilinear(cube[:5], cube[5], places, turned, turned.copy(), out)
    for band in range(3):
        points = np.stack([line + along, column + across])
        wanted = map_coordinates(cube[:, band].astype(float), points, order=1)
        np.testing.assert_allclose(out[cell, band], wanted, rtol=2e-5)


def test_what_has_no_weight_is_not_looked_at() -> None:
    cube = np.ones((2, 1, 3), np.float32)
    cube[0, 0, 2] = cube[1] = np.nan
    one = np.zeros(1, np.int64)
    out, turned = np.zeros((1, 1), np.float32), np.empty((3, 1), np.float32)
    for across, wanted in ((0.0, 1.0), (0.5, np.nan)):
        ways = np.zeros(1, np.float32), np.array([across], np.float32)
        gather_bilinear(cube[:1], cube[1], Places(one, one + 1, *ways, one), turned, turned.copy(), out)
        np.testing.assert_array_equal(out, [[wanted]])
