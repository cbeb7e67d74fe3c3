"""A dark that is not the dark of the scene's own camera and settings."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from hyperpaint.base.arrays import Floats

from .cube_sample import CubeSample
from .finding import KINDS, Finding

__all__ = ["judge_dark"]


@dataclass(frozen=True)
class DarkRules:
    """From where on a dark is none.

    zero_share
        Elements of exactly zero counts [1]; a detector has a few dead ones, under 1 %.
    """

    zero_share: float = 0.05


RULES = DarkRules()


def judge_dark(name: str, dark: Floats, sample: CubeSample) -> Iterator[Finding]:
    """Judge dark counts (band, cross_track) against a sample of the scene."""
    zeros = float(np.mean(dark == 0.0))
    if zeros > RULES.zero_share and sample.mean[dark == 0.0].max() > 0.0:
        yield Finding(
            KINDS["dark-of-zeros"], name,
            f"{100 * zeros:.3g} % of the dark's elements are exactly 0 in every frame",
            f"at most {100 * RULES.zero_share:g} %",
        )  # fmt: skip
