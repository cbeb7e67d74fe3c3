"""The loops of flags, against scipy's least squares and plain numpy."""

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.ndimage import distance_transform_cdt, distance_transform_edt
from scipy.optimize import lsq_linear

from hyperpaint.kernels import arguments
from hyperpaint.kernels.segmentation import (
    boundary_distance,
    join_segments,
    nearest_sources,
    squared_depth,
    step_sizes,
)
from hyperpaint.kernels.unmixing import PARTS, average_bands, minimise, unmix_lines

RNG = np.random.default_rng(3)
AROUND = 0.03
"""Mirror image of the sky around the sun that is expected with the sun's."""


Array = npt.NDArray[Any]


def scene(channels: int = 20) -> dict[str, Array]:
    # Return a small block of lines, with one, two and no neighbours, and what is known of it
    body = RNG.integers(0, 3, (2, 6)).astype(np.int32)
    near = np.stack([(body + 1) % 3, np.where(body == 0, -1, (body + 2) % 3)], axis=2).astype(np.int32)
    near[0, :2] = -1
    return {
        "seen": RNG.uniform(0.0, 1.0, (2, 6, channels)).astype(np.float32),
        "body_of": body,
        "bodies": RNG.uniform(0.05, 0.8, (3, channels)),
        "neighbours": near,
        "diffuse": np.linspace(0.4, 0.05, channels),
        "mirrored": np.linspace([0.2, 0.6], [0.03, 0.4], channels).T.copy(),
        "noise": RNG.uniform(0.01, 0.03, channels),
        "expected": RNG.uniform(0, 1, PARTS),
        "spread": RNG.uniform(0.05, 1, PARTS),
        "tilt": RNG.uniform(0.05, 1, 3),
        "most": np.array([0.8, *[np.inf] * (PARTS - 1)]),
    }


def unmix(given: dict[str, Array], evidence: float = 0.0, lean: float = 0.0) -> tuple[Array, ...]:
    shape = given["seen"].shape[:2]
    amount = np.empty((*shape, PARTS), np.float32)
    added = np.empty((*shape, 2), np.float32)
    together, misfit = np.empty((2, *shape), np.float32)
    unmix_lines(
        given["seen"],
        arguments.Bodies(given["body_of"], given["bodies"], given["neighbours"]),
        arguments.LightParts(1 - given["diffuse"], given["diffuse"], *given["mirrored"]),
        arguments.ChannelErrors(given["noise"], 0.005),
        arguments.AmountPrior(given["expected"], given["spread"], given["tilt"], given["most"]),
        evidence,
        arguments.Glinting(lean, AROUND if lean else 0.0),
        arguments.Unmixed(amount, added, together, misfit),
    )
    return amount, added, together, misfit


def parts_of(given: dict[str, Array], place: tuple[int, ...]) -> Array:
    # Return the spectra (channel, part) that a pixel's light is a sum of
    rho, diffuse, bodies = given["bodies"][given["body_of"][place]], given["diffuse"], given["bodies"]
    columns = [rho * (1 - diffuse), rho * diffuse, 1 - diffuse, *given["mirrored"]]
    for other in given["neighbours"][place]:
        if other >= 0:
            columns += [rho * bodies[other], bodies[other]]
    return np.stack(columns, axis=1)


def least(
    given: dict[str, Array], place: tuple[int, ...], lean: float = 0.0, without: tuple[int, ...] = ()
) -> tuple[Array, float]:
    # Return the amounts by scipy, of all parts but some, and their sum of squares
    parts = parts_of(given, place)
    used = parts.shape[1]
    spread = given["spread"][:used].copy()
    spread[0] = given["tilt"][given["body_of"][place]]
    expected = given["expected"][:used].copy()
    expected[0] += min(lean, spread[0])
    expected[4] += AROUND if lean else 0.0
    sigma = given["noise"] * np.abs(given["seen"][place].astype(np.float64)) + 0.005
    rows = np.concatenate([parts / sigma[:, None], np.diag(1 / spread)])
    right = np.concatenate([given["seen"][place] / sigma, expected / spread])
    kept = [part for part in range(used) if part not in without]
    amount = np.zeros(used)
    amount[kept] = lsq_linear(rows[:, kept], right, (0, given["most"][kept]), method="bvls", tol=1e-14).x
    return amount, float(np.sum((rows @ amount - right) ** 2))


@pytest.mark.slow
def test_unmixing_is_the_bounded_least_squares_of_scipy() -> None:
    given = scene()
    amount, added, together, misfit = unmix(given)
    for place in np.ndindex(2, 6):
        true, _ = least(given, place)
        parts = parts_of(given, place)
        used = parts.shape[1]
        np.testing.assert_allclose(amount[place][:used], true, atol=1e-6)
        assert (amount[place][used:] == 0).all()
        light = (parts * true).T[5:].reshape(-1, 2, parts.shape[0]).sum(axis=1)
        np.testing.assert_allclose(added[place][: len(light)], light.max(axis=1), atol=1e-6)
        np.testing.assert_allclose(together[place], light.sum(axis=0).max(initial=0), atol=1e-6)
        sigma = given["noise"] * np.abs(given["seen"][place]) + 0.005
        rest = (given["seen"][place] - parts @ true) / sigma
        np.testing.assert_allclose(misfit[place], np.sqrt(np.mean(rest**2)), rtol=1e-5)


def test_the_minimum_is_exact_where_parts_are_of_one_colour() -> None:
    # 200 sweeps from part to part are thousands away from it here
    given = scene()
    given["bodies"] = np.array([[0.3], [0.5], [0.1]]) * np.linspace(1.0, 1.02, 20)
    given["seen"] = (0.4 * np.linspace(1.0, 1.01, 20) + 0.004 * RNG.normal(size=(2, 6, 20))).astype(
        np.float32
    )
    given["expected"] = np.array([0.5, 0.7, 0, 0, 0, 0, 0, 0, 0])
    given["spread"] = np.array([0.1, 0.3, 10.0, 0.02, 0.03, 0.2, 0.1, 0.2, 0.1])
    amount, *_ = unmix(given)
    for place in np.ndindex(2, 6):
        true, _ = least(given, place)
        np.testing.assert_allclose(amount[place][: true.size], true, atol=2e-6)


@pytest.mark.parametrize("seed", range(5))
def test_active_sets_end_where_no_gradient_points_inside(seed: int) -> None:
    rng = np.random.default_rng(seed)
    for _ in range(200):
        basis = rng.normal(size=(rng.integers(2, 12), PARTS)) * 10.0 ** rng.uniform(-3, 1, PARTS)
        gram = basis.T @ basis + np.diag(10.0 ** rng.uniform(-4, 2, PARTS))
        right, most = rng.normal(size=PARTS) * 5, rng.uniform(0.1, 2, PARTS)
        held = rng.uniform(size=PARTS) < 0.2
        start = rng.choice([0.0, 0.05], PARTS)
        amount = start.copy()
        assert minimise(gram, right, most, held, amount)
        np.testing.assert_array_equal(amount[held], start[held])
        slope = (right - gram @ amount) / np.sqrt(np.diag(gram))
        free = ~held
        assert ((amount >= 0) & (amount <= most))[free].all()
        assert (slope[free & (amount == 0)] < 1e-7).all()
        assert (slope[free & (amount == most)] > -1e-7).all()
        assert (np.abs(slope[free & (amount > 0) & (amount < most)]) < 1e-7).all()


def test_what_the_light_gives_no_evidence_of_is_left_out() -> None:
    given = scene()
    given["expected"] = np.array([1.0, 1, 0, 0, 0, 0, 0, 0, 0])
    given["spread"] = np.array([0.1, 0.3, 10.0, 0.02, 0.03, 0.2, 0.1, 0.2, 0.1])
    given["tilt"][:], given["most"][0] = 0.1, 1.3
    given["neighbours"] = np.where(given["neighbours"] == 2, -1, given["neighbours"])
    light = given["bodies"][given["body_of"]].copy()
    light[0, :3] += 0.1 * (1 - given["diffuse"])
    light[1, :3] += 0.08 * given["bodies"][(given["body_of"][1, :3] + 1) % 3]
    given["neighbours"][1, :3, 0] = (given["body_of"][1, :3] + 1) % 3
    given["seen"] = (light * (1 + 0.002 * RNG.normal(size=light.shape))).astype(np.float32)
    amount, _, together, _ = unmix(given, evidence=9.0, lean=0.05)
    assert (amount[0, :3, 2] > 0.05).all()
    assert (amount[:, 3:, 2] == 0).all()
    assert (together[1, :3] > 0.03).all()
    assert (together[:, 3:] == 0).all()
    for x in range(3):  # by a likelihood ratio, over what scipy finds
        with_, without = (
            least(given, (0, x), lean, out) for lean, out in ((0.05, (5, 6, 7, 8)), (0.0, (2, 5, 6, 7, 8)))
        )
        assert without[1] - with_[1] > 9.0
        np.testing.assert_allclose(amount[0, x][:5], with_[0][:5], atol=1e-5)


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
    join_segments(order, steps[order], 6, 0.3, parent, size, np.zeros(6, np.float32))
    assert [int(parent[i]) for i in range(6)] == [0, 0, 0, 3, 3, 3]


def test_distances_to_boundaries_are_those_of_a_chessboard() -> None:
    body = np.zeros((20, 30), np.int32)
    body[5:12, 8:20] = 1
    distance = np.empty(body.shape, np.uint8)
    boundary_distance(body, np.ones(body.shape, bool), 255, distance)
    for number in (0, 1):
        expected = distance_transform_cdt(body == number, "chessboard")
        np.testing.assert_array_equal(distance[body == number], expected[body == number])


@pytest.mark.parametrize("seed", range(4))
def test_depths_are_those_of_the_distance_transform(seed: int) -> None:
    rng = np.random.default_rng(seed)
    mask = rng.random(rng.integers(1, 60, 2)) < 0.5 + 0.15 * seed
    mask.flat[rng.integers(mask.size)] = False
    depth = np.empty(mask.shape, np.int64)
    squared_depth(mask, depth)
    assert np.array_equal(np.sqrt(depth), distance_transform_edt(mask))


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
