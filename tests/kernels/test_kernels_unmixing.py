"""The loops of flags, against scipy's least squares and plain numpy."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import distance_transform_cdt
from scipy.optimize import lsq_linear

from hyperpaint.kernels.segmentation import boundary_distance, join_segments, nearest_sources, step_sizes
from hyperpaint.kernels.unmixing import PARTS, average_bands, unmix_lines

RNG = np.random.default_rng(3)


def test_unmixing_is_the_bounded_least_squares_of_scipy() -> None:
    channels, bodies = 20, RNG.uniform(0.05, 0.8, (3, 20))
    diffuse = np.linspace(0.4, 0.05, channels)
    seen = RNG.uniform(0.0, 1.0, (2, 6, channels)).astype(np.float32)
    body = RNG.integers(0, 3, (2, 6)).astype(np.int32)
    near = np.stack([(body + 1) % 3, np.where(body == 0, -1, (body + 2) % 3)], axis=2).astype(np.int32)
    expected, spread = RNG.uniform(0, 1, PARTS), RNG.uniform(0.05, 1, PARTS)
    most = np.full(PARTS, np.inf)
    most[0] = 0.8
    amount = np.empty((2, 6, PARTS), np.float32)
    added = np.empty((2, 6, 2), np.float32)
    together, misfit = np.empty((2, 2, 6), np.float32)
    unmix_lines(
        seen, body, bodies, near, 1 - diffuse, diffuse, 0.02, 0.005, expected, spread, most, amount,
        added, together, misfit,
    )  # fmt: skip
    for place in np.ndindex(2, 6):
        rho, neighbours = bodies[body[place]], near[place]
        columns = [rho * (1 - diffuse), rho * diffuse, 1 - diffuse, diffuse]
        for other in neighbours[neighbours >= 0]:
            columns += [rho * bodies[other], bodies[other]]
        parts = np.stack(columns, axis=1)
        used = parts.shape[1]
        sigma = 0.02 * np.abs(seen[place].astype(np.float64)) + 0.005
        rows = np.concatenate([parts / sigma[:, None], np.diag(1 / spread[:used])])
        right = np.concatenate([seen[place] / sigma, (expected / spread)[:used]])
        true = lsq_linear(rows, right, (0, most[:used]), tol=1e-12).x
        np.testing.assert_allclose(amount[place][:used], true, atol=2e-4)
        assert (amount[place][used:] == 0).all()
        light = (parts * true).T[4:].reshape(-1, 2, channels).sum(axis=1)
        np.testing.assert_allclose(added[place][: len(light)], light.max(axis=1), atol=5e-4)
        np.testing.assert_allclose(together[place], light.sum(axis=0).max(), atol=5e-4)
        rest = (seen[place] - parts @ true) / sigma
        np.testing.assert_allclose(misfit[place], np.sqrt(np.mean(rest**2)), rtol=1e-3)


def test_channels_are_means_of_what_is_known() -> None:
    cube = RNG.uniform(size=(3, 10, 4)).astype(np.float32)
    cube[1, 2, 3] = np.nan
    cube[2, 4:9, 1] = np.nan
    groups = np.array([0, 0, 0, -1, 1, 1, 1, 1, 1, -1])
    out = np.empty((3, 4, 2), np.float32)
    average_bands(cube, groups, out)
    np.testing.assert_allclose(out[..., 0], np.nanmean(cube[:, :3], axis=1), rtol=1e-6)
    assert np.isnan(out[2, 1, 1])
    assert np.isfinite(np.delete(out[..., 1].ravel(), 9)).all()


def test_steps_are_relative_differences() -> None:
    channels = RNG.uniform(0.1, 0.5, (4, 5, 3)).astype(np.float32)
    across, along = np.empty((2, 4, 5), np.float32)
    step_sizes(channels, 0.01, across, along)
    one, other = channels[2, 3].astype(float), channels[3, 3].astype(float)
    expected = np.sqrt(np.mean(((one - other) / ((one + other) / 2 + 0.01)) ** 2))
    np.testing.assert_allclose(along[2, 3], expected, rtol=1e-5)
    assert np.isinf(across[:, -1]).all()
    assert np.isinf(along[-1]).all()


def test_joining_stops_at_a_large_step() -> None:
    # a row of six pixels: gentle steps but for one
    steps = np.full(12, np.inf, np.float32)
    steps[0:10:2] = [0.01, 0.01, 0.5, 0.01, 0.01]
    order = np.argsort(steps, kind="stable")[:5]
    parent, size = np.arange(6, dtype=np.int32), np.ones(6, np.int32)
    join_segments(order, steps, 6, 0.3, parent, size)
    assert [int(parent[i]) for i in range(6)] == [0, 0, 0, 3, 3, 3]


def test_distances_to_boundaries_are_those_of_a_chessboard() -> None:
    body = np.zeros((20, 30), np.int32)
    body[5:12, 8:20] = 1
    distance = np.empty(body.shape, np.uint8)
    boundary_distance(body, np.ones(body.shape, bool), 255, distance)
    for number in (0, 1):
        expected = distance_transform_cdt(body == number, "chessboard")
        np.testing.assert_array_equal(distance[body == number], expected[body == number])


def test_the_nearest_sources_come_first() -> None:
    labels, distances = np.full((12, 12, 3), -1, np.int32), np.full((12, 12, 3), np.inf)
    places = {4: (2, 2), 7: (9, 3), 9: (5, 10)}
    for name, (line, x) in places.items():
        labels[line, x, 0], distances[line, x, 0] = name, 0.0
    nearest_sources(labels, distances, 100.0)

    def octile(line: int, x: int, name: int) -> float:
        dy, dx = abs(line - places[name][0]), abs(x - places[name][1])
        return max(dy, dx) + (np.sqrt(2) - 1) * min(dy, dx)

    for line, x in np.ndindex(12, 12):
        expected = sorted(octile(line, x, name) for name in places)
        np.testing.assert_allclose(distances[line, x], expected)
        np.testing.assert_allclose([octile(line, x, int(name)) for name in labels[line, x]], expected)
