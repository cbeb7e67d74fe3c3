"""A simulator of whole collects with known truth; it shares only the sky models of `light` with the chain.

Settings go in; instrument files, or flight lines in memory, come out with their truth. Tests, the
demonstration and `hyperpaint render` call it. Physics in float64 and file writers are its own, so that the
chain is tested against independent code. `atmosphere` has the light, `rendering.scene_spectra` the
surfaces, `camera` the camera, `rendering.platforms` its path and attitude. `flight` combines them scan line
by scan line: over a flat picture of a car park, a checkerboard, or a car park of triangles
(`rendered_flight`, `rendering`). `instruments` writes the instrument files, `collect` all files, truth
and monochromator sweeps of the same camera.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
