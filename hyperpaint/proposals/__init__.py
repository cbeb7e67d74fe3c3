"""Regions proposed by rule: which pixels of which cars, in which order, and why.

Rooms: `candidates` (pieces of one surface, and what is measured of them), `surroundings` (windows around
them), `judging` (what a piece is, and how good a region), `cars` (which pieces are of one car, and which of
them is level), `pixel_outlines` (polygons of pixels), `proposing` (all of it).
"""

from __future__ import annotations

from .proposing import Proposals, propose_regions

__all__ = ["Proposals", "propose_regions"]
