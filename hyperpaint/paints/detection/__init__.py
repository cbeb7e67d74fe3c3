"""Detection of paints in an image: scores, thresholds at a stated false-alarm rate, regions.

Reflectance and a paint library come in, detections go out. For pictures, the accessor and the command line.
"""

from .detecting import detect, detected_regions

__all__ = ["detect", "detected_regions"]
