"""Light transport in compiled loops: geometry, surfaces, the recorder of paths, and their sums in bands.

Arrays come in, and weights of paths or radiance go out; files, labels and spectrum libraries are not used.
Only `hyperpaint.simulation.rendering` calls it, whose scenes, platforms and settings check their values.
"""
