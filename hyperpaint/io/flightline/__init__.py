"""One flight line from the instruments' files: cube, side files, darks, calibration, times.

Paths come in, one lazy dataset with all that calibrates it goes out. Called by `collect` and users.
"""
