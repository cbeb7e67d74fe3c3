"""Is what a navigation record says of the camera true? Signs, clocks and the camera's mounting, tested."""

from .checking import ConventionCheck, Finding, check_conventions
from .clock_offsets import ClockOffset, estimate_clock_offset
from .mounting import BoresightSolution, solve_boresight

__all__ = [
    "BoresightSolution", "ClockOffset", "ConventionCheck", "Finding", "check_conventions",
    "estimate_clock_offset", "solve_boresight",
]  # fmt: skip
