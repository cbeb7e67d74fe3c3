"""Regions of a flight line: named polygons, their GeoJSON files, the pixels in them, and proposals.

Outlines and flight lines come in; positions of pixels and masks go out. For paints and every room above.
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
