"""How sure counts, reflectance and means over it are.

`photon_transfer` says how noisy the camera is, `propagation` what follows for every reflectance and for means
over pixels; the loops are in `hyperpaint.kernels.radiometry`.
"""

from __future__ import annotations

from .photon_transfer import estimate_noise
from .propagation import mean_uncertainty

__all__ = ["estimate_noise", "mean_uncertainty"]
