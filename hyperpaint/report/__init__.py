"""One page about a store, and short descriptions of datasets.

A store or a dataset comes in, HTML or text goes out. For the accessor and the command line.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
