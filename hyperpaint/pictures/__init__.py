"""Figures, plots and the explorer.

Lines, libraries and results come in, matplotlib axes and PNG files go out. For reports, workflows and the
accessor.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
