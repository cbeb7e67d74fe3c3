"""Check for counts above the range of the camera's converter."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from .cube_sample import CubeSample
from .finding import KINDS, Finding

#: Largest share of the elements [1] that a frame counter or status word takes: a column in 640.
STRAY_SHARE = 2e-3


def judge_range(name: str, sample: CubeSample, bit_depth: int, saturation_count: float) -> Iterator[Finding]:
    """Find counts above the converter's highest one; a larger ``saturation_count`` replaces it."""
    limit = max(2**bit_depth - 1, int(saturation_count))
    highest = int(sample.highest.max())
    if highest <= limit:
        return
    share = float(np.mean(sample.highest > limit))
    shifted = sample.divisor > 1 and sample.divisor.bit_count() == 1  # by whole bits
    multiple = f", all multiples of {sample.divisor}: left-justified" if shifted else ""
    yield Finding(
        KINDS["stray-counts" if share < STRAY_SHARE else "counts-over-range"],
        name,
        f"counts up to {highest}{multiple}, above {limit} in {100 * share:.3g} % of the elements",
        f"at most {limit}, of {bit_depth} bits",
    )
