"""Paint signatures: reflectance of paints from regions of calibrated flight lines.

Flight lines and regions come in, a paint library with spread and uncertainties goes out. For validation,
report, workflows and the accessor.
"""

from .extraction import EXCLUDED, extract_signatures

__all__ = ["EXCLUDED", "extract_signatures"]
