"""What every room stands on: errors, units, the one table of variables, dims, quality bits, constants.

Nothing comes in and nothing of the package is imported; everything above may use it.
"""
