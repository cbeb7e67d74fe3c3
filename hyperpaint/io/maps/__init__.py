"""Maps written: GeoTIFF and the grids they lie on."""
