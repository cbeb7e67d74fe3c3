"""Several flight lines as one map, and tie points between them for solving the camera's mounting.

Located lines or maps come in. Files: `strips` (lines on one grid, cut into its tiles), `composing` (`mosaic`:
choice of the line at a cell, one factor per line and band, and areas of the lines as GeoJSON), `tie_points`
(places that two lines show).
"""
