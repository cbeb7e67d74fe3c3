"""Light transport in compiled loops: geometry, surfaces, the recorder of paths, and their sums in bands.

Arrays come in, checked by `path_blocks.check`, and weights of paths or radiance go out; no file, label or
spectrum library is known here. `hyperpaint.simulation.rendering` alone calls it.
"""
