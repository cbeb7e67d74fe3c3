from .georeference import (
    PinholeCamera as PinholeCamera,
    canonical_navigation as canonical_navigation,
    footprint as footprint,
    interpolate_pose as interpolate_pose,
    locate as locate,
    spacing as spacing,
)
from .navigation_checks import (
    check_conventions as check_conventions,
    estimate_clock_offset as estimate_clock_offset,
    solve_boresight as solve_boresight,
)
from .orthorectification import (
    MapGrid as MapGrid,
    map_report as map_report,
    orthorectify as orthorectify,
)
