"""Regions proposed by rule: which pixels of which cars, in which order, and why.

Rooms: `candidates` (pieces of one surface, and what is measured of them), `footprints` (the whole car around
a piece), `roofs` (which part of it is the roof), `levelling` (how bright that is where it is level), `cars`
(all of this, car by car), `surroundings` and `dark_cars` (paint as dark as windows), `judging` (objections,
and how good a region), `pixel_outlines` (polygons of pixels), `proposing` (all of it).
"""

from __future__ import annotations

from .proposing import Proposals, propose_regions

__all__ = ["Proposals", "propose_regions"]
