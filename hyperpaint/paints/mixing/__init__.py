"""Synthetic paints: mixtures, shades, and variants drawn from a measured population.

A paint library comes in, a library of synthetic paints goes out. For the accessor and workflows.
"""

from .synthetic_paints import mix_paints, sample_paints, shade_paints

__all__ = ["mix_paints", "sample_paints", "shade_paints"]
