"""Writing of maps: GeoTIFF, map grids, and metadata for catalogues.

A map (y, x, band) comes in, a file goes out. Called by workflows and users; ENVI writing shares the grids.
"""
