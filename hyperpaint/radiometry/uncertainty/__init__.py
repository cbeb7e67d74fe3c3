"""How sure counts, reflectance and means over it are.

Rooms: `photon_transfer` (how noisy the camera is), `propagation` (from what is known of the instrument's
errors to every reflectance; loops in `hyperpaint.kernels.uncertainty`), `averages` (means over pixels).
"""

from __future__ import annotations

from .averages import mean_uncertainty
from .photon_transfer import estimate_noise

__all__ = ["estimate_noise", "mean_uncertainty"]
