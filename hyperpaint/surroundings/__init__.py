"""Survey of a scene, with the flags and the corrections of light that follow from it.

A line with reflectance comes in; a `SceneModel`, layers and bits of ``quality``, or corrected reflectance go
out. For regions, paints, pictures and every room above. `detection_rules` holds the thresholds.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
