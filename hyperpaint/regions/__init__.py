"""Regions of a flight line: named polygons, their files, and the pixels in them.

Rooms: `outlines` (regions as data), `geojson` (their files), `polygons` (points in a polygon, exactly),
`placement` (pixels of a line).
"""

from __future__ import annotations

from .geojson import read_regions, regions_from, write_regions
from .outlines import Region, Regions
from .pixels_in_regions import pixels, pixels_of, region_mask

__all__ = [
    "Region",
    "Regions",
    "pixels",
    "pixels_of",
    "read_regions",
    "region_mask",
    "regions_from",
    "write_regions",
]
