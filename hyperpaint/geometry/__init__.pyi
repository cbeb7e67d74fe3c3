from .georeference.locating import (
    PinholeCamera as PinholeCamera,
    canonical_navigation as canonical_navigation,
    footprint as footprint,
    interpolate_pose as interpolate_pose,
    locate as locate,
    solve_boresight as solve_boresight,
    spacing as spacing,
)
from .mosaicking.composing import find_tie_points as find_tie_points, mosaic as mosaic, seamlines as seamlines
from .navigation_checking import (
    check_conventions as check_conventions,
    estimate_clock_offset as estimate_clock_offset,
)
from .orthorectification.mapping import (
    MapGrid as MapGrid,
    map_report as map_report,
    orthorectify as orthorectify,
)
