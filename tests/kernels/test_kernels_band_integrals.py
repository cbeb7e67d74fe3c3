"""Loops of relighting against numpy, compiled and not."""

import numpy as np
import pytest

from hyperpaint.simulation.transport import mixing
from hyperpaint.simulation.transport.mixing import integrate_bands


@pytest.mark.parametrize("compiled", [True, False])
def test_products_are_sums_over_the_grid(compiled: bool) -> None:
    rng = np.random.default_rng(0)
    grid, bands, nodes, width = 40, 7, 2, 3
    factors, weights = rng.random((4, grid)), rng.random((2, nodes, grid, width))
    first = np.sort(rng.integers(0, bands - width + 1, grid))
    chosen = np.array([[2, 0], [3, -1], [-1, -1], [1, 1]])
    source = np.array([0, 1, 1, -1])
    out = np.full((nodes, len(chosen), bands), np.nan, np.float32)
    run = integrate_bands if compiled else getattr(integrate_bands, "py_func", integrate_bands)
    run(factors, chosen, source, weights, first, out)
    dense = np.zeros((2, nodes, grid, bands))
    for point in range(grid):
        dense[:, :, point, first[point] : first[point] + width] = weights[:, :, point]
    products = [factors[2] * factors[0], factors[3], np.ones(grid), factors[1] ** 2]
    for path, product in enumerate(products):
        expected = np.einsum("g,ngb->nb", product, dense[source[path]]) * (source[path] >= 0)
        np.testing.assert_allclose(out[:, path], expected, rtol=1e-6)


@pytest.mark.parametrize("depth", [0.0, 1e-4, 0.1, 0.149, 0.151, 3.0])
@pytest.mark.parametrize("in_place", [False, True])
def test_air_is_an_exponential(depth: float, in_place: bool) -> None:
    surface = np.random.default_rng(1).random((5, 4, 6)).astype(np.float32)
    given = surface.copy()
    extinction = np.linspace(0.0, 1e-3, 4)[:, None].astype(np.float32)
    path_radiance = np.full((4, 1), 2e-5, np.float32)
    distance = np.full((5, 6), depth / 1e-3, np.float32)
    distance[0, 0] = np.nan
    out = surface if in_place else np.empty_like(surface)
    mixing.through_air(surface, extinction, path_radiance, distance, out)
    metres = np.nan_to_num(distance.astype(np.float64))[:, None]
    expected = given * np.exp(-extinction.astype(np.float64) * metres) + 2e-5 * metres
    np.testing.assert_allclose(out, expected, rtol=4e-7)
    np.testing.assert_array_equal(out[0, :, 0], given[0, :, 0])


def test_the_series_and_the_exponential_meet() -> None:
    plain = getattr(mixing._thin_air, "py_func", mixing._thin_air)
    made = np.empty((1, 3), np.float32)
    take, metres = np.full((1, 3), 1e-3, np.float32), np.array([0.0, 80.0, 149.0], np.float32)
    plain(np.ones((1, 3), np.float32), take, np.zeros((1, 3), np.float32), metres, made)
    np.testing.assert_allclose(made[0], np.exp(-1e-3 * metres), rtol=2e-7)
