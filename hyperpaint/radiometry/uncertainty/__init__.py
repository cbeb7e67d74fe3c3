"""Uncertainty of counts, of reflectance, and of means over it.

`photon_transfer` estimates the camera's noise, `propagation` the uncertainty of every reflectance,
`error_sources` the samples that share each error, `averages` the uncertainty of a mean over
pixels; the loops are in `hyperpaint.kernels.radiometry`.
"""

from .photon_transfer import estimate_noise
from .propagation import mean_uncertainty

__all__ = ["estimate_noise", "mean_uncertainty"]
