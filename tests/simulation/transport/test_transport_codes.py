"""Codes of paths, and what becomes of them where slots are few."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from support.transport_scenes import COMPILED, code

from hyperpaint.simulation.transport.path_codes import SKY
from hyperpaint.simulation.transport.paths import PathTable, add_path, with_factor, write_paths


def table(size: int = 4096) -> PathTable:
    return PathTable(np.full(size, -1), np.zeros(size), np.empty(size, np.int64), np.zeros(1, np.int64))


def written(paths: list[tuple[int, float]], slots: int, draw: float = 0.5) -> tuple[np.ndarray, np.ndarray]:
    room = table()
    for number, weight in paths:
        add_path(room, number, weight)
    weights, codes = np.empty((1, slots, 1), np.float32), np.empty((1, slots, 1), np.int64)
    write_paths(room, 1.0, draw, weights, codes, 0, 0)
    return codes[0, :, 0], weights[0, :, 0]


@given(st.lists(st.integers(0, 6), max_size=4), st.integers(3, 14))
@settings(max_examples=100 if COMPILED else 20)
def test_factors_in_any_order_are_one_code(factors: list[int], bits: int) -> None:
    found = set()
    for order in itertools.permutations(factors):
        number = SKY
        for factor in order:
            number = with_factor(number, factor, bits)
        found.add(int(number))
    assert found == {code(0, *factors, digit_bits=bits)}


def test_weights_of_one_code_are_added_and_codes_sorted() -> None:
    rng = np.random.default_rng(0)
    known = rng.integers(0, 2**62, 40)
    paths = [(int(known[k]), float(rng.uniform())) for k in rng.integers(0, 40, 500)]
    codes, weights = written(paths, 48)
    expected = {int(k): sum(w for c, w in paths if c == k) for k in known}
    assert codes[:40].tolist() == sorted(expected)
    np.testing.assert_allclose(weights[:40], [expected[k] for k in sorted(expected)], rtol=1e-6)
    assert (codes[40:] == -1).all()
    assert (weights[40:] == 0).all()


def test_paths_without_weight_leave_no_code() -> None:
    codes, _ = written([(5, 0.0), (6, -1.0), (7, float("nan")), (8, 1.0)], 3)
    assert codes.tolist() == [8, -1, -1]


def test_few_slots_keep_the_heaviest_and_the_total() -> None:
    rng = np.random.default_rng(1)
    true = np.concatenate([[5.0, 3.0, 2.0], rng.uniform(0.01, 0.1, 60)])
    paths = [(100 + i, float(weight)) for i, weight in enumerate(true)]
    draws = (np.arange(400 if COMPILED else 40) + 0.5) / (400 if COMPILED else 40)
    mean = np.zeros(len(true))
    for draw in draws:
        codes, weights = written(paths, 8, float(draw))
        assert (codes[:3] == [100, 101, 102]).all()
        assert (np.diff(codes) > 0).all()
        np.testing.assert_allclose(weights[:3], true[:3], rtol=1e-6)
        assert weights.sum() == pytest.approx(true.sum(), rel=1e-6)
        mean[codes - 100] += weights / len(draws)
    np.testing.assert_allclose(mean, true, rtol=0.1 if COMPILED else 1, atol=0.02)  # unbiased, code by code


@given(st.lists(st.floats(1e-6, 1e3), min_size=1, max_size=40), st.integers(1, 12), st.floats(1e-9, 1 - 1e-9))
@settings(max_examples=200 if COMPILED else 20)
def test_any_pixel_fits_its_slots(weights: list[float], slots: int, draw: float) -> None:
    codes, found = written(list(enumerate(weights)), slots, draw)
    assert (codes >= 0).sum() == min(slots, len(weights))
    assert found.sum() == pytest.approx(sum(weights), rel=1e-5)
    assert (found[codes >= 0] > 0).all()
    kept = codes[codes >= 0]
    assert (np.diff(kept) > 0).all()


def test_a_table_is_used_again() -> None:
    room = table(64)
    for round_ in range(3):
        for i in range(room[3][0]):
            room[0][room[2][i]] = -1
        room[3][0] = 0
        for number in range(20):
            add_path(room, 1000 * round_ + number, 1.0)
        weights, codes = np.empty((1, 4, 1), np.float32), np.empty((1, 4, 1), np.int64)
        write_paths(room, 1.0, 0.3, weights, codes, 0, 0)
        assert (codes >= 1000 * round_).all()
        assert weights.sum() == pytest.approx(20)
