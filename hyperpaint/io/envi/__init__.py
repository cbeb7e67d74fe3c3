"""ENVI cubes and their headers, read lazily and written."""
