"""Constants that several rooms share."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, get_args

#: A sample within this distance of the largest count of the converter is saturated (DESIGN.md,
#: `saturated`).
SATURATION_MARGIN_COUNTS = 16

#: Variance that conversion to whole counts adds [count2]: a uniform error of the width of one count.
QUANTISATION_VARIANCE_COUNT2 = 1.0 / 12.0

#: Mantissa bits of the stored reflectance: a relative error of at most 2**-13, 1.2e-4.
KEPT_BITS = 12

WGS84_SEMI_MAJOR_AXIS_M = 6378137.0
#: NIMA TR8350.2, World Geodetic System 1984. The simulator's ellipsoid has its own, to check against.
WGS84_ECCENTRICITY_SQUARED = 6.69437999014e-3

#: Time from the stamp of a frame to its mid exposure [exposure times], by the instant that stamps mark.
MID_EXPOSURE_OFFSETS: Mapping[str, float] = {"start": 0.5, "mid": 0.0, "end": -0.5}

#: Version of the numbers that `process` and `render` store. Raise it with every change after which the same
#: inputs and settings may give other bits (a formula, a constant, a threshold, an order of summation); not
#: for speed, words or layout. `tests/workflows/test_numerics_version.py` holds the checksums of this version.
#: A store of another version is reported, and computed again on request.
NUMERICS_VERSION = 1

#: Size of the output of one task; the allocator requests a larger block from the kernel each time.
MAX_TASK_BYTES = 24_000_000

#: Codec of stored arrays, see `hyperpaint.to_store`.
DEFAULT_CODEC: Literal["compact", "fast"] = "compact"

#: When differences between camera and irradiance record are corrected: see `hyperpaint.alignment.align`.
Alignment = Literal["auto", "never", "always"]
ALIGNMENTS: tuple[Alignment, ...] = get_args(Alignment)

#: Relative standard uncertainty of stray light from which it is not subtracted: it is then less than two
#: standard uncertainties from zero [1].
MAX_STRAY_LIGHT_U = 0.5


def lines_a_task(bytes_a_line: int, max_lines: int = 32) -> int:
    """Return the number of whole lines in a task: at most ``max_lines`` and `MAX_TASK_BYTES`, at least one.

    Examples
    --------
    >>> lines_a_task(640 * 272 * 4), lines_a_task(2_000_000)
    (32, 12)
    """
    return min(max_lines, max(1, MAX_TASK_BYTES // max(bytes_a_line, 1)))
