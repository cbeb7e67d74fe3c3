"""What a time stamp marks of an exposure."""

from __future__ import annotations

from collections.abc import Mapping

__all__ = ["TO_MIDDLE"]

TO_MIDDLE: Mapping[str, float] = {"start": 0.5, "mid": 0.0, "end": -0.5}
"""From what the stamp marks to mid exposure, in exposures."""
