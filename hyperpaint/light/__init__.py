"""Light on the scene: spectral responses, the sun, and the irradiance of every scan line.

An irradiance record and the bands of a camera come in, the irradiance of each band of each line goes
out. For radiometry and all above it.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
