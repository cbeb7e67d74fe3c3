"""Agreement of paint signatures with field spectrometers, or other libraries, of the same paints.

A paint library and reference datasets come in; a `Validation` (statistics, common spectra, verdict) goes out.
Called by users, workflows, the command line and reports.
"""

from .validating import Validation, validate

__all__ = ["Validation", "validate"]
