"""Shared by every room: errors, facts, units, the one table of variables, dims, quality bits, constants.

Nothing comes in; everything above may use it, and imports its names from here. `jit` and `many_outputs` are
imported by their own names: they load numba and dask.
"""

from . import errors as errors  # `hyperpaint.errors` is it, also where nothing else has been loaded
from .attitude_conventions import *
from .constants import *
from .errors import *
from .errors import warn_if as warn_if, warn_user as warn_user  # not listed by the public module
from .facts import *
from .groups import *
from .input_files import *
from .mirrored_light import *
from .old_names import *
from .progress_reports import *
from .remote_files import *
from .responsivity import *
from .schema import *
