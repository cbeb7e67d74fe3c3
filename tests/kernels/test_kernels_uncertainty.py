"""Uncertainties of the slab kernel against plain numpy, in every mode; with compilation and without."""

from typing import Any

import numpy as np
import pytest
from support.slab_arguments import calibrate, round_values

from hyperpaint.kernels.arguments import ErrorTerms, SlabOutputs

LINES, BANDS, COLUMNS = 4, 7, 11


def problem(
    *, smile: int = 0, elements: bool = False, slope: bool = True, offset: bool = True, seed: int = 0
) -> dict[str, Any]:
    # Return arguments of a slab with saturated samples, bad elements, signals under the dark, no light
    rng = np.random.default_rng(seed)
    counts = rng.integers(60, 4095, (LINES, BANDS, COLUMNS)).astype(np.uint16)
    counts[:, :, 6] = rng.integers(70, 110, (LINES, BANDS))
    gain = rng.uniform(1e-6, 3e-6, (BANDS, COLUMNS)).astype(np.float32)
    gain[2, 3] = gain[5, :2] = gain[0, 4] = gain[BANDS - 1, 5] = np.nan
    cells, edges = np.zeros((1, 1), np.int64), np.array([[0, COLUMNS]])
    shift, light = np.zeros((1, COLUMNS), np.float32), rng.uniform(0.5, 1.5, (LINES, BANDS, 1, 1))
    if smile:
        rows = BANDS if smile == 2 else 1
        cells = np.stack([rng.permutation(3) for _ in range(rows)])
        edges = np.stack([np.array([0, 4, 4, COLUMNS]) for _ in range(rows)])
        shift = rng.uniform(0, 1, (rows, COLUMNS)).astype(np.float32)
        light = rng.uniform(0.5, 1.5, (LINES, BANDS, 3, 4))
    light[3] = np.nan
    shape = (BANDS, COLUMNS) if elements else (1, COLUMNS)

    def rows_of(low: float, high: float) -> np.ndarray:
        return rng.uniform(low, high, shape).astype(np.float32)

    return {
        "counts": counts,
        "dark": rng.uniform(80, 120, (2, BANDS, COLUMNS)).astype(np.float32),
        "dark_index": np.zeros(LINES, np.int64),
        "dark_weight": rng.uniform(0, 1, LINES).astype(np.float32),
        "gain": gain,
        "light": light.astype(np.float32),
        "shift": shift,
        "edges": edges,
        "cells": cells,
        "limit": np.full((1, 1), 3600, np.uint16),
        "noise_margin": np.full((BANDS, COLUMNS), np.nan, np.float32),
        "whole": np.True_,
        "most_negative": np.uint16(1),
        "no_data": np.uint16(2048),
        "line_flags": np.zeros(LINES, np.uint16),
        "column_flags": np.zeros(COLUMNS, np.uint16),
        "per_electron": rows_of(0.02, 0.2),
        "noise_floor": rows_of(0.1, 2.0),
        "relative": rows_of(0.0, 0.05),
        "offset": rows_of(0.0, 3.0) if offset else np.zeros((0, COLUMNS), np.float32),
        "slope": rng.uniform(0.0, 0.3, (BANDS if slope else 0, 4)).astype(np.float32),
    }


def run(p: dict[str, Any], cleared: int = 0) -> list[np.ndarray]:
    cubes = [np.full(p["counts"].shape, 77, np.float32) for _ in range(3)]
    terms = ErrorTerms(*(p[name] for name in ErrorTerms._fields))
    none = np.empty((0, 0), np.uint16)
    calibrate(p, SlabOutputs(cubes[0], none, *cubes[1:]), cleared, terms)
    return cubes


def oracle(p: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    # Return both uncertainties in float64, one sample after the other
    shape = p["counts"].shape
    lit, signal = np.full(shape, np.nan), np.full(shape, np.nan)
    for line, band, x in np.ndindex(shape):
        w = float(p["dark_weight"][line])
        low, high = p["dark"][:, band, x].astype(float)
        row = band if len(p["shift"]) > 1 else 0
        run_of = next(k for k in range(p["cells"].shape[1]) if x < p["edges"][row, k + 1])
        terms = p["light"][line, band, p["cells"][row, run_of]].astype(float)
        s = float(p["shift"][row, x])
        lit[line, band, x] = terms[0] if terms.size == 1 else 1.0 / np.polyval(terms[::-1], s)
        if p["counts"][line, band, x] < 3600 and not np.isnan(lit[line, band, x]):
            signal[line, band, x] = float(p["counts"][line, band, x]) - (low + w * (high - low))
    gain = p["gain"].astype(float)
    radiance = signal * gain
    k, floor, relative, offset = (
        np.broadcast_to(p[name].astype(float) if len(p[name]) else 0.0, shape[1:])
        for name in ("per_electron", "noise_floor", "relative", "offset")
    )
    random = lit * gain * np.sqrt(np.maximum(signal, 0.0) * k + floor)
    systematic = np.full(shape, np.nan)
    for line, band, x in np.ndindex(shape):
        here = radiance[line, band, x]
        wavelength = 0.0
        if len(p["slope"]):
            up, up_alone, down, down_alone = p["slope"][band].astype(float)
            below = radiance[line, max(band - 1, 0), x]
            above = radiance[line, min(band + 1, BANDS - 1), x]
            if not np.isnan(above):
                wavelength += (above - here) * (up_alone if np.isnan(below) else up)
            if not np.isnan(below):
                wavelength += (here - below) * (down_alone if np.isnan(above) else down)
        dark = gain[band, x] * offset[band, x]
        systematic[line, band, x] = lit[line, band, x] * np.sqrt(
            (here * relative[band, x]) ** 2 + wavelength**2 + dark**2
        )
    return np.where(np.isnan(radiance), np.nan, random), systematic


@pytest.mark.parametrize(
    ("slope", "offset"),
    [(True, True), (False, True), (False, False)],
    ids=["every component", "without wavelengths", "proportional"],
)
@pytest.mark.parametrize("elements", [False, True], ids=["one value", "each element"])
@pytest.mark.parametrize("smile", [0, 1, 2])
def test_against_plain_numpy(smile: int, elements: bool, slope: bool, offset: bool) -> None:
    p = problem(smile=smile, elements=elements, slope=slope, offset=offset)
    before = {name: value.copy() for name, value in p.items()}
    out, random, systematic = run(p)
    for made, expected in zip((random, systematic), oracle(p), strict=True):
        assert np.isnan(expected).any()
        assert np.isfinite(expected).sum() > 100
        # differences of neighbouring bands lose digits
        np.testing.assert_allclose(made, expected, rtol=1e-4)
        np.testing.assert_array_equal(np.isnan(made), np.isnan(out))
        assert (made[np.isfinite(made)] >= 0).all()
    for name, value in p.items():
        np.testing.assert_array_equal(value, before[name], err_msg=name)


@pytest.mark.parametrize("smile", [0, 1])
def test_reflectance_does_not_change_by_a_bit(smile: int) -> None:
    p = problem(smile=smile)
    cube = np.empty((0, 0, 0), np.float32)
    for cleared in (0, 11):
        out = np.full(p["counts"].shape, 77, np.float32)
        outputs = SlabOutputs(out, np.empty((0, 0), np.uint16), cube, cube)
        calibrate(p, outputs, cleared)
        assert out.tobytes() == run(p, cleared)[0].tobytes()


def test_no_bit_depends_on_the_number_of_lines() -> None:
    p = problem(smile=1)
    whole = run(p, 11)
    for line in range(LINES):
        part = dict(p)
        for name in ("counts", "dark_index", "dark_weight", "light", "line_flags"):
            part[name] = p[name][line : line + 1]
        for cube, of_all in zip(run(part, 11), whole, strict=True):
            assert cube.tobytes() == of_all[line : line + 1].tobytes()


def test_rounding_is_the_same_as_afterwards() -> None:
    p = problem()
    plain = run(p)
    for cube, rounded in zip(plain, run(p, 11), strict=True):
        round_values(cube, 11)
        assert cube.tobytes() == rounded.tobytes()


@pytest.mark.parametrize("bands", [1, 2, 3])
def test_few_bands(bands: int) -> None:
    p = problem()
    for name in ("counts", "dark", "light", "slope", "gain", "noise_margin"):
        axis = 0 if name in ("slope", "gain", "noise_margin") else 1
        p[name] = np.ascontiguousarray(np.take(p[name], range(bands), axis))
    _, _, systematic = run(p)
    if bands == 1:
        np.testing.assert_array_equal(np.isnan(systematic), np.isnan(run(p)[1]))
    assert np.isfinite(systematic).any()
