"""One flight line from the instruments' files: cube, side files, darks, calibration, times.

Paths come in; one lazy dataset with all inputs of its calibration goes out. Called by `collect` and users.
"""
