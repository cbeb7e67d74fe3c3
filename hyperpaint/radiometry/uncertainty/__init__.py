"""How sure counts, reflectance and means over it are.

`photon_transfer` says how noisy the camera is, `propagation` what follows for every reflectance,
`error_sources` which samples share which error, `mean_errors` and `averages` what is left of each in a mean
over pixels; the loops are in `hyperpaint.kernels.radiometry`.
"""

from __future__ import annotations

from .averages import mean_uncertainty
from .photon_transfer import estimate_noise

__all__ = ["estimate_noise", "mean_uncertainty"]
