"""What can be wrong with a pixel: the bits of ``quality``."""

from __future__ import annotations

from enum import IntFlag

__all__ = ["Quality"]


class Quality(IntFlag):
    """Bits of ``quality``; a bit set early is still set in every later product."""

    SATURATED = 1
    BELOW_DARK = 2
    BAD_DETECTOR = 4
    IRRADIANCE_GAP = 8
    ILLUMINATION_UNSTABLE = 16
    LOW_SUN = 32
    GLINT = 64
    SHADOW = 128
    ADJACENCY = 256
    MIXED_EDGE = 512
    OFF_SWATH = 1024
    NO_DATA = 2048
    TIMING_SENSITIVE = 4096
