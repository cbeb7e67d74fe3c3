"""Wavelengths and widths of the camera in flight, with the daylight as the lamp.

Rooms: `estimation` (all of it in order), `declared` (what the line says of itself), `windows` (where to look,
and what several windows tell together), `lamp` (the light as bands would see it), `least_squares` (shift and
width), `application` (the line with what was found), `oxygen` (a figure a column), `column_means`.
"""

from __future__ import annotations

from .application import apply_alignment
from .estimation import align_to_irradiance
from .oxygen import oxygen_depth, oxygen_residual

__all__ = ["align_to_irradiance", "apply_alignment", "oxygen_depth", "oxygen_residual"]
