"""New paints from old: mixtures, shades, and variants drawn from a measured population.

Rooms: `kubelka_munk` (a thick layer and its interface), `coated` (a library's reflectance without and with
its interface), `recipes` (mixtures and shades), `sampling` (variants), `synthetic` (the library of the new
paints).
"""

from __future__ import annotations

from .recipes import mix_paints, shade_paints
from .synthetic_paints import sample_paints

__all__ = ["mix_paints", "sample_paints", "shade_paints"]
