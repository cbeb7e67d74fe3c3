"""A simulator of whole collects with known truth; of the processing chain it shares the sky and nothing else.

Settings go in; the instruments' own files, or flight lines in memory, come out with their truth. Tests, the
demonstration and `hyperpaint render` call it. Its own physics in float64 from the sky to the converter, and
its own writers: a chain that recovers the truth from them has shown something. `atmosphere` makes the light,
`paint_spectra` the surfaces, `camera` the camera, `trajectories` how it wobbles over the earth, `flight` what
they do line by line: over a flat picture of a car park (`plan_flight`), over one of triangles
(`rendered_flight`, `rendering`) or over squares of known corners (`checkerboard_flight`). `instruments`
writes the files, `stores` truth and sweeps, `painted_regions` where the paints are, `collect` the whole;
`sweep` shines a monochromator into the same camera.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
