"""Calibrate a camera from a lab sweep, or derive its gain from other sources.

In: a monochromator sweep (`lab_sweep` checks it), frames of a known source, or the vendor's coefficients.
Out: a dataset with gain, wavelengths, dark and uncertainties. Called by workflows and the command line;
alignment, pictures and reports read its results.
"""

from .anchors import (
    anchor_to_radiance,
    calibration_from_coefficients,
    etendue_from_optics,
    etendue_from_pupil,
    panel_radiance,
)
from .calibration_dataset import calibrate, quantum_efficiency, relative_responsivity
from .detector import dark_at, dark_model, flat_field, linearity

__all__ = [
    "anchor_to_radiance",
    "calibrate",
    "calibration_from_coefficients",
    "dark_at",
    "dark_model",
    "etendue_from_optics",
    "etendue_from_pupil",
    "flat_field",
    "linearity",
    "panel_radiance",
    "quantum_efficiency",
    "relative_responsivity",
]
