"""Paint signatures: what a paint reflects, from regions of calibrated flight lines.

Rooms: `sources` (flight lines at nominal wavelengths), `gathering` (pixels out of lazy cubes), `reduction`
(centre, spread, members), `independence` (how many pixels are independent), `viewing` (from where they are
seen), `draft` (one signature), `library` (the dataset), `extraction` (all of it).
"""

from __future__ import annotations

from .extraction import EXCLUDED, extract_signatures

__all__ = ["EXCLUDED", "extract_signatures"]
