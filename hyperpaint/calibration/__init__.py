"""From a lab sweep to a calibration, and every other way to a gain.

Rooms: `lab_sweep` (the sweep at the door), `steps` and `line_fits` (line by line), `elements` (dead ones, and
what the others differ in), `slope_pull`, `wavelength_map`, `placement` (which lines lie where they should),
`edge_lines`, `beam` (light along the slit), `responsivity` (areas to gains), `calibrating` (all of it in
order), `result` (the dataset), `views` (what can be derived), `anchors` (absolute scale by other means),
`detector` (dark, flat field, linearity), `out_of_band` (stray light, second order), `line_samples` (lines
beside their fits).
"""

from __future__ import annotations

from .anchors import (
    anchor_to_radiance,
    calibration_from_coefficients,
    etendue_from_optics,
    etendue_from_pupil,
    panel_radiance,
)
from .calibrating import calibrate
from .detector import dark_at, dark_model, flat_field, linearity
from .out_of_band import correct_stray_light
from .views import quantum_efficiency, relative_responsivity

__all__ = [
    "anchor_to_radiance",
    "calibrate",
    "calibration_from_coefficients",
    "correct_stray_light",
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
