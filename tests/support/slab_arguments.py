"""Arguments of the slab kernel from a plain mapping, what plain numpy makes of them, and its rounding."""

from typing import Any

import numpy as np

from hyperpaint.kernels.arguments import (
    Calibration,
    DetectorModel,
    ErrorTerms,
    FixedFlags,
    SlabOutputs,
    count_limits,
    light_cells,
    rounding,
    without_empty_arrays,
)
from hyperpaint.kernels.radiometry import calibrate_slab, round_row

NO_MODEL = DetectorModel(
    np.empty(0, np.float32),
    np.empty((0, 0), np.float32),
    np.empty((0, 1, 1), np.float32),
    np.float32(0.0),
    np.float32(1.0),
    np.empty((0, 2), np.int64),
    np.empty((0, 4), np.int64),
    np.bool_(False),
    np.bool_(False),
)


NO_DATA = 2048


def problem(
    dtype: Any, *, smile: int = 0, darks: int = 1, own_limit: bool = False, seed: int = 0
) -> dict[str, Any]:
    # Return arguments of a slab that meets every case: saturated, bad, under the dark, without data
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
    # Return reflectance in float64, and quality, one sample after the other
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


def calibrate(
    p: dict[str, Any], out: SlabOutputs, cleared_bits: int = 0, terms: ErrorTerms | None = None
) -> None:
    # Run the kernel as a task does
    own = len(p["dark"]) > 1
    calibration = Calibration(
        p["dark"],
        p["dark_index"] if own else None,
        p["dark_weight"] if own else None,
        p["gain"],
        without_empty_arrays(p.get("detector", NO_MODEL)),
    )
    calibrate_slab(
        p["counts"],
        calibration,
        light_cells(p["light"], p["shift"], p["edges"], p["cells"]),
        count_limits(p["limit"], p["noise_margin"], p["most_negative"], p["whole"]),
        FixedFlags(p["line_flags"], p["column_flags"], p["no_data"]) if out.quality.size else None,
        None if terms is None else without_empty_arrays(terms),
        rounding(cleared_bits),
        out,
    )


def round_values(values: np.ndarray, cleared_bits: int) -> None:
    # Round in place
    round_row(values.ravel(), rounding(cleared_bits))
