"""Whole jobs from files to files: process, calibrate, extract, validate, map, render, demonstrate.

Paths come in, finished stores go out: the only room where readers, physics and the simulator meet. For the
command line and the top of the package.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
