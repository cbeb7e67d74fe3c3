"""Wavelengths and widths of the camera in flight, from lines of the daylight.

A flight line with radiance or counts and its irradiance record comes in; wavelength shifts and widths of
columns, or the line corrected by them, go out; `align` compares camera and record, and corrects significant
differences. Called by users, the accessor, `validation` and `workflows`.
"""

from .comparison import align, align_to_irradiance, apply_alignment, compared, oxygen_depth, oxygen_residual

__all__ = ["align", "align_to_irradiance", "apply_alignment", "compared", "oxygen_depth", "oxygen_residual"]
