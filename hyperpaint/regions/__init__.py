"""Regions of a flight line: named polygons, their GeoJSON files, their pixels, and proposals.

Outlines and flight lines come in; positions of pixels and masks go out. For paints and every room above.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
