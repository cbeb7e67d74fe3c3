"""Maps written: GeoTIFF and the grids they lie on.

A map (y, x, band) comes in, a file goes out. Called by workflows and users; ENVI writing shares the grids.
"""
