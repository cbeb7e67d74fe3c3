"""Loops over arrays: numpy and numba only, no labels, no units, no chunks."""
