"""One flight line from the instruments' files: cube, side files, darks, calibration, times."""
