"""Counts that the camera's converter does not give."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from .cube_sample import CubeSample
from .finding import KINDS, Finding

#: Share of the elements [1] that a frame counter or status word takes at the most: a column in 640.
STRAY_SHARE = 2e-3


def judge_range(name: str, sample: CubeSample, bit_depth: int, saturation_count: float) -> Iterator[Finding]:
    """Find counts above the last of a converter; a ``saturation_count`` above it says where that is."""
    last = max(2**bit_depth - 1, int(saturation_count))
    most = int(sample.most.max())
    if most <= last:
        return
    share = float(np.mean(sample.most > last))
    shifted = sample.divisor > 1 and sample.divisor.bit_count() == 1  # by whole bits
    multiple = f", all multiples of {sample.divisor}: left-justified" if shifted else ""
    yield Finding(
        KINDS["stray-counts" if share < STRAY_SHARE else "counts-over-range"], name,
        f"counts up to {most}{multiple}, above {last} in {100 * share:.3g} % of the elements",
        f"at most {last}, of {bit_depth} bits",
    )  # fmt: skip
