"""Dark counts of every line: interpolated in time, fitted to exposure."""

import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np

from hyperpaint.base import Array, Floats, SchemaError, TimeError, warn_user
from hyperpaint.light.illumination import between_stamps

#: Relative difference of exposure times up to which a dark is valid for a line.
SAME_EXPOSURE_SHARE = 0.01
#: Extrapolation beyond the exposures of the darks above which it is reported, and refused [widths of the
#: interval between them]. Darks of a real camera at 20 to 55 ms extrapolate to 0.3 counts rms inside, 0.7 at
#: a width and 1.7 at four; the noise of the means of two darks grows as sqrt(0.5 + 2 (0.5 + widths)^2), to 15
#: times at ten.
TRUSTED_DARK_SPANS, MAX_DARK_SPANS = 1.0, 10.0


def darks_of_lines(
    cube: Mapping[str, Any], exposure: Floats, subject: str = "the line"
) -> tuple[Array, Array, Array]:
    # Return darks (n, band, column), and for every line its earlier dark and the weight of the later.
    #
    # Darks at the line's exposure are interpolated in time. Without such darks, or if lines differ in
    # exposure, bias and rate are fitted to the darks, and every line is interpolated between two fitted
    # darks; the bias is never scaled.
    dark = np.asarray(cube["dark_counts"], np.float32)
    dark = dark[None] if dark.ndim == 2 else dark
    times = cube.get("dark_time")
    dark_exposure_time = cube.get("dark_exposure_time")
    if dark_exposure_time is not None:
        dark_exposure = np.broadcast_to(np.asarray(dark_exposure_time, np.float64), len(dark))
        is_usable = np.abs(dark_exposure[:, None] / exposure - 1.0) <= SAME_EXPOSURE_SHARE
        if not is_usable.all(axis=1).any():
            # Darks in proportion to exposure
            if np.ptp(dark_exposure) <= SAME_EXPOSURE_SHARE * dark_exposure.max():
                exposures_ms = np.unique(exposure.round(9)) * 1e3
                raise SchemaError(
                    f"the dark was taken at {dark_exposure[0] * 1e3:g} ms, {subject} at "
                    f"{', '.join(f'{ms:g}' for ms in exposures_ms[:4])} ms",
                    mend="take a dark at this exposure, or darks at two exposures, for bias and rate",
                    code="dark-exposure-differs",
                )
            # lines beyond the exposures of the darks
            below, above = dark_exposure.min() - exposure.min(), exposure.max() - dark_exposure.max()
            spans = max(below, above) / np.ptp(dark_exposure)
            if spans > TRUSTED_DARK_SPANS * (1.0 + SAME_EXPOSURE_SHARE):
                farthest = exposure.max() if above >= below else exposure.min()
                text = (
                    f"darks at {dark_exposure.min() * 1e3:g} to {dark_exposure.max() * 1e3:g} ms are "
                    f"extrapolated to {farthest * 1e3:g} ms, {spans:.1f} times the interval between them"
                )
                mend, code = "take a dark at the line's exposure", "dark-exposure-differs"
                SchemaError.raise_if(
                    spans > MAX_DARK_SPANS, text, expected=f"at most {MAX_DARK_SPANS:g}", mend=mend, code=code
                )
                warn_user(f"{text}: {mend}", code)
            centred = dark_exposure - dark_exposure.mean()
            rate = np.tensordot(centred, dark, axes=(0, 0)) / (centred @ centred)
            shortest, longest = exposure.min(), exposure.max()
            away = np.array([shortest, longest])[:, None, None] - dark_exposure.mean()
            fitted = (dark.mean(axis=0, dtype=np.float64) + rate * away).astype(np.float32)
            index = np.zeros(exposure.size, np.int64)
            return (
                (fitted[:1], index, np.zeros(exposure.size, np.float32))
                if longest == shortest
                else (fitted, index, ((exposure - shortest) / (longest - shortest)).astype(np.float32))
            )
        dark = dark[is_usable.all(axis=1)]
        times = None if times is None else np.asarray(times)[is_usable.all(axis=1)]
    elif np.ptp(exposure) > SAME_EXPOSURE_SHARE * exposure.max():
        warn_user(
            "lines differ in exposure and 'dark_exposure_time' is missing: one dark is used for all",
            "dark-exposure-missing",
        )
    index, weight = np.zeros(exposure.size, np.int64), np.zeros(exposure.size, np.float32)
    if len(dark) == 1 or times is None or "time" not in cube:
        return dark.mean(axis=0, dtype=np.float64).astype(np.float32)[None], index, weight
    stamps = np.asarray(times).astype("datetime64[ns]")
    TimeError.raise_if(
        np.isnat(stamps).any(),
        f"{np.isnat(stamps).sum()} of {stamps.size} 'dark_time' are missing (NaT)",
        mend="drop these darks",
        code="time-missing",
    )
    order = np.argsort(stamps, kind="stable")
    # beyond their times the first and the last dark are used: a dark drifts slowly
    index, share = between_stamps(stamps[order], cube["time"])
    return dark[order], index, share.astype(np.float32)


def dark_weights(cube: Mapping[str, Any], count: int, exposure: Floats) -> Floats:
    # Return the weight of each of ``count`` darks in every line (line, dark).
    #
    # ``cube`` holds times and exposures of the darks, as of `make_plan`; ``exposure`` (line,) [s].
    if count == 1:
        return np.ones((exposure.size, 1))
    # the subtracted dark is linear in the darks: unit darks give their weights
    darks = {**cube, "dark_counts": np.eye(count, dtype=np.float32)[:, :, None]}
    with warnings.catch_warnings():  # the plan warns
        warnings.simplefilter("ignore")
        unit_darks, index, weight = darks_of_lines(darks, exposure)
    shares = unit_darks[index, :, 0] + weight[:, None] * (
        unit_darks[np.minimum(index + 1, len(unit_darks) - 1), :, 0] - unit_darks[index, :, 0]
    )
    return np.asarray(shares, np.float64)
