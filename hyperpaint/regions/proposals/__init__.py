"""Regions proposed by rule: which pixels of which cars, in which order, and why.

A line and its scene model come in; `Proposals`, regions with reasons and what was refused, go out. For the
accessor and workflows. `rules` holds the thresholds.
"""

from __future__ import annotations

from .proposing import Proposals, propose_regions

__all__ = ["Proposals", "propose_regions"]
