"""From counts to radiance and reflectance in one pass, with flags and uncertainty.

A flight line with its calibration and light comes in; the line with lazy cubes goes out. For all rooms
that read reflectance.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
