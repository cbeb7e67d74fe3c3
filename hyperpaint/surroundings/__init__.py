"""What is known of a scene after one look at all of it; flags are then a matter of single pixels."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
