from .boresight import solve_boresight as solve_boresight
from .georeference.cameras import PinholeCamera as PinholeCamera
from .georeference.coverage import footprint as footprint, spacing as spacing
from .georeference.locating import locate as locate
from .georeference.poses import (
    canonical_navigation as canonical_navigation,
    interpolate_pose as interpolate_pose,
)
from .mosaicking.composing import mosaic as mosaic, seamlines as seamlines
from .mosaicking.tie_points import find_tie_points as find_tie_points
from .navigation_checking import (
    check_conventions as check_conventions,
    estimate_clock_offset as estimate_clock_offset,
)
from .orthorectification.grids import MapGrid as MapGrid
from .orthorectification.mapping import map_report as map_report, orthorectify as orthorectify
