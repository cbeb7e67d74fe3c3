"""From GPS and attitude to the ground position of every pixel, and to maps.

A flight line with navigation comes in; coordinates and map cubes go out. Conventions and mounting angles are
checked here. For regions and workflows.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
