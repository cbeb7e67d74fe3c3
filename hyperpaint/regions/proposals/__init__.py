"""Proposed regions of car paint, ranked, with reasons.

A line and its scene model come in; `Proposals`, regions with reasons and the refused pieces, go out. For the
accessor and workflows. `proposal_rules` holds the thresholds.
"""

from .proposing import Proposals, propose_regions

__all__ = ["Proposals", "propose_regions"]
