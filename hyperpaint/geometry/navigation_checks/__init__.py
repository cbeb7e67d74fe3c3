"""Checks of a navigation record: signs of angles, clocks, mounting of the camera."""

from .checking import ConventionCheck, Finding, check_conventions
from .clock_offsets import ClockOffset, estimate_clock_offset
from .mounting import BoresightSolution, solve_boresight

__all__ = [
    "BoresightSolution", "ClockOffset", "ConventionCheck", "Finding", "check_conventions",
    "estimate_clock_offset", "solve_boresight",
]  # fmt: skip
