"""Shared by every room: errors, facts, units, the one table of variables, dims, quality bits, constants.

Nothing comes in; everything above may use it.
"""

from . import errors as errors  # `hyperpaint.errors` is it, also where nothing else has been loaded
