"""hyperpaint: from raw pushbroom counts to calibrated paint spectra, in labelled, unit-checked xarray.

Importing it registers ``Dataset.paint``, and takes as long as ``import xarray``: names in ``__init__.pyi``,
here and in every room, are loaded on first use; kernels are compiled on their first run.
"""

from pathlib import Path
from typing import Any

import lazy_loader

from . import accessor as _accessor  # noqa: F401  (registers Dataset.paint)

__version__ = "0.2.0"

_load, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    try:
        return _load(name)
    except AttributeError as error:
        # tools ask every module for private names: no folders are listed for these
        for room in __all__ if not name.startswith("_") else ():
            is_room = room == "errors" or (Path(__file__).parent / room).is_dir()
            if is_room and name in getattr(_load(room), "__all__", ()):
                error.add_note(f"it is hyperpaint.{room}.{name}")
        raise
