"""Paints: their signatures, mixtures, colours, search, and a starter library.

Reflectance and regions come in, paint libraries go out. For validation, pictures and workflows.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
