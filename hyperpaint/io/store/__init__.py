"""Zarr stores: written completely or not at all, readable with plain `xarray.open_zarr`.

In: datasets and trees of them (`to_store`), or a store's path. Out: a store with a checksum for every chunk,
groups opened lazily and checked as they are read, a report of `verify`. Called by io, workflows and the user.
Other rooms import its names from here.
"""

from .budget import *
from .computing import *
from .manifest import *
from .raw_references import *
from .reader import *
from .writer import *
