"""A collect: ``collect.toml`` read, checked, and opened as one tree.

A path comes in; a tree of flight lines, irradiance, calibration and references, and the settings, go out.
Called by workflows and the command line.
"""
