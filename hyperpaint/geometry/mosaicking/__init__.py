"""Several flight lines as one map, and tie points between them for solving the camera's mounting.

Located lines or maps come in. Files: `strips` (lines on one grid, cut into its tiles), `composing` (`mosaic`:
choice of the line at a cell), `levelling` (one factor per line and band), `seams` (areas of the lines as
GeoJSON), `tie_points` (places that two lines show).
"""

from .composing import mosaic
from .seams import seamlines
from .tie_points import find_tie_points

__all__ = ["find_tie_points", "mosaic", "seamlines"]
