"""The slab kernel against plain numpy, in every mode; with compilation and without."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from support.slab_arguments import grouped, round_values

from hyperpaint.kernels.arguments import ErrorTerms, SlabOutputs
from hyperpaint.kernels.radiometry import calibrate_slab

NO_DATA = 2048


def problem(
    dtype: Any, *, smile: int = 0, darks: int = 1, own_limit: bool = False, seed: int = 0
) -> dict[str, Any]:
    """Return arguments of a slab that meets every case: saturated, bad, under the dark, without data."""
    rng = np.random.default_rng(seed)
    lines, bands, columns = 7, 9, 13
    counts = rng.uniform(60, 4095, (lines, bands, columns)).astype(dtype)
    dark = rng.uniform(80, 120, (darks, bands, columns)).astype(np.float32)
    gain = rng.uniform(1e-6, 3e-6, (bands, columns)).astype(np.float32)
    gain[2, 3] = gain[5, :2] = np.nan
    limit = rng.uniform(2000, 4000, (bands, columns)) if own_limit else np.full((1, 1), 3600.0)
    watched = np.isfinite(gain) & (np.arange(bands) != 4)[:, None]
    if smile:
        rows = bands if smile == 2 else 1
        cells = np.stack([rng.permutation(3) for _ in range(rows)])
        edges = np.stack([np.array([0, 4, 4, columns]) for _ in range(rows)])  # the middle run is empty
        shift = rng.uniform(0, 1, (rows, columns)).astype(np.float32)
        light = rng.uniform(0.5, 1.5, (lines, bands, 3, 4)).astype(np.float32)
    else:
        cells, edges = np.zeros((1, 1), np.int64), np.array([[0, columns]])
        shift = np.zeros((1, columns), np.float32)
        light = rng.uniform(0.5, 1.5, (lines, bands, 1, 1)).astype(np.float32)
    light[6] = np.nan
    line_flags = np.array([0, 8, 0, 0, 32, 0, NO_DATA], np.uint16)
    return {
        "counts": counts,
        "dark": dark,
        "dark_index": rng.integers(0, max(darks - 1, 1), lines),
        "dark_weight": rng.uniform(0, 1, lines).astype(np.float32),
        "gain": gain,
        "light": light,
        "shift": shift,
        "edges": edges,
        "cells": cells,
        "limit": np.ceil(limit).astype(dtype),
        "noise_margin": np.where(watched, 10, np.nan).astype(np.float32),
        "whole": np.bool_(np.issubdtype(dtype, np.integer)),
        "most_negative": np.uint16(1),
        "no_data": np.uint16(NO_DATA),
        "line_flags": line_flags,
        "column_flags": np.where(np.arange(columns) == 5, 4, 0).astype(np.uint16),
    }


def oracle(p: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Return reflectance in float64, and quality, one sample after the other."""
    shape = p["counts"].shape
    made, quality = np.full(shape, np.nan), np.zeros((shape[0], shape[2]), int)
    limit = np.broadcast_to(p["limit"], shape[1:]).astype(float)
    for line in range(shape[0]):
        for x in range(shape[2]):
            negative, bits = 0, 0
            for band in range(shape[1]):
                raw = float(p["counts"][line, band, x])
                i, w = p["dark_index"][line], float(p["dark_weight"][line])
                dark = float(p["dark"][0, band, x])
                if len(p["dark"]) > 1:
                    dark = (1 - w) * float(p["dark"][i, band, x]) + w * float(p["dark"][i + 1, band, x])
                signal = float(p["gain"][band, x]) * (raw - dark)
                row = band if len(p["shift"]) > 1 else 0
                run = next(k for k in range(p["cells"].shape[1]) if x < p["edges"][row, k + 1])
                terms = p["light"][line, band, p["cells"][row, run]].astype(float)
                s = float(p["shift"][row, x])
                lit = terms[0] if terms.size == 1 else np.polyval(terms[::-1], s)
                if raw < limit[band, x]:
                    made[line, band, x] = signal * lit if terms.size == 1 else signal / lit
                elif not np.isnan(p["noise_margin"][band, x]):
                    bits |= 1
                if not np.isnan(p["noise_margin"][band, x]):
                    negative += raw < dark
                    bits |= 2 * bool(raw < dark - p["noise_margin"][band, x])
            bits |= 2 * (negative > p["most_negative"])
            no_data = p["line_flags"][line] & NO_DATA
            quality[line, x] = p["line_flags"][line] | (0 if no_data else bits | p["column_flags"][x])
    return made, quality


def run(p: dict[str, Any], dropped: int = 0, flagging: bool = True) -> tuple[np.ndarray, np.ndarray]:
    shape = p["counts"].shape
    out = np.full(shape, 77, np.float32)
    quality = np.full((shape[0], shape[2]) if flagging else (0, 0), 9999, np.uint16)
    terms = ErrorTerms(*[np.empty((0, 0), np.float32)] * 5)
    cube = np.empty((0, 0, 0), np.float32)
    calibrate_slab(*grouped(p), terms, np.uint32(dropped), SlabOutputs(out, quality, cube, cube))
    return out, quality


@pytest.mark.parametrize("own_limit", [False, True], ids=["one limit", "own limits"])
@pytest.mark.parametrize("darks", [1, 3])
@pytest.mark.parametrize("smile", [0, 1, 2])
@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_against_plain_numpy(dtype: Any, smile: int, darks: int, own_limit: bool) -> None:
    p = problem(dtype, smile=smile, darks=darks, own_limit=own_limit)
    before = {name: value.copy() for name, value in p.items()}
    expected, flags = oracle(p)
    out, quality = run(p)
    assert {1, 2, 4, 8, 32} <= {bit for bit in (1, 2, 4, 8, 32) if (flags & bit).any()}
    np.testing.assert_allclose(out, expected, rtol=3e-6, atol=1e-10)
    np.testing.assert_array_equal(quality, flags)
    for name, value in p.items():
        np.testing.assert_array_equal(value, before[name], err_msg=name)


@pytest.mark.parametrize("smile", [0, 1])
def test_no_bit_depends_on_the_number_of_lines(smile: int) -> None:
    p = problem(np.uint16, smile=smile, darks=3)
    whole, quality = run(p, dropped=11)
    for line in range(7):
        part = dict(p)
        for name in ("counts", "dark_index", "dark_weight", "light", "line_flags"):
            part[name] = p[name][line : line + 1]
        out, flags = run(part, dropped=11)
        assert out.tobytes() == whole[line : line + 1].tobytes()
        np.testing.assert_array_equal(flags[0], quality[line])


def test_without_quality_nothing_else_changes() -> None:
    p = problem(np.uint16)
    np.testing.assert_array_equal(run(p)[0], run(p, flagging=False)[0])


def test_missing_counts_hide_no_saturation() -> None:
    p = problem(np.float32)
    p["counts"][:] = 500.0
    p["counts"][0, 3, 6] = 4090.0
    p["counts"][0, 4:, 6] = np.nan
    p["counts"][1, 0, 7] = np.nan
    p["counts"][1, 3, 7] = 4090.0
    out, quality = run(p)
    np.testing.assert_array_equal(np.argwhere(quality & 1), [[0, 6], [1, 7]])
    assert np.isnan(out[0, 4:, 6]).all()


@pytest.mark.parametrize("keep", [1, 7, 12, 20, 22, 23])
def test_rounding_is_that_of_numcodecs(keep: int) -> None:
    codec = pytest.importorskip("numcodecs").BitRound(keepbits=keep)
    rng = np.random.default_rng(2)
    values = rng.normal(size=(3, 4, 50)).astype(np.float32) * 10.0 ** rng.integers(-30, 30, (3, 4, 50))
    values = values.astype(np.float32)
    values[0, 0, :6] = [0.0, -0.0, np.inf, -np.inf, 1.0, np.float32(1 + 2**-12)]
    expected = np.frombuffer(codec.encode(values.copy()), np.float32).reshape(values.shape)
    made = values.copy()
    if keep < 23:
        round_values(made, 23 - keep)
    np.testing.assert_array_equal(made.view(np.uint32), expected.view(np.uint32))


def test_rounding_leaves_nan_missing() -> None:
    values = np.full((1, 1, 4), np.nan, np.float32)
    round_values(values, 11)
    assert np.isnan(values).all()


def test_rounding_inside_the_slab_is_the_same() -> None:
    p = problem(np.uint16)
    plain = run(p)[0]
    round_values(plain, 11)
    assert plain.tobytes() == run(p, dropped=11)[0].tobytes()
