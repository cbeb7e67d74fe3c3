"""hyperpaint: from raw pushbroom counts to calibrated paint spectra, in labelled, unit-checked xarray.

Importing it registers ``Dataset.paint`` and costs what ``import xarray`` costs: the names below are loaded
when they are first used, and kernels are compiled when they first run.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from . import accessor as _accessor  # noqa: F401  (registers .paint)
from .errors import (
    CollectError,
    FormatError,
    IncompleteStoreError,
    MissingExtraError,
    PaintError,
    PaintWarning,
    SchemaError,
    StoreError,
    TimeError,
    UnitsError,
)
from .schema import Quality

if TYPE_CHECKING:
    from .alignment import align_to_irradiance, apply_alignment, oxygen_residual
    from .calibration import calibrate
    from .illumination import Tilt, match_irradiance
    from .io.asd import open_asd
    from .io.flightline import open_flightline
    from .io.irradiance import open_irradiance
    from .io.store import encoding, open_store, to_store, verify
    from .laboratory import open_collect
    from .pipeline import process
    from .plot import quicklook, rgb
    from .plot_calibration import calibration_report
    from .radiometry import Panel, radiance, reflectance
    from .simulation import simulate_collect
    from .smoothing import smooth
    from .sun import solar_position
    from .uncertainty import estimate_noise, mean_uncertainty

__version__ = "0.1.0"

_HOME = {
    "Panel": "radiometry",
    "Tilt": "illumination",
    "align_to_irradiance": "alignment",
    "apply_alignment": "alignment",
    "calibrate": "calibration",
    "calibration_report": "plot_calibration",
    "encoding": "io.store",
    "estimate_noise": "uncertainty",
    "match_irradiance": "illumination",
    "mean_uncertainty": "uncertainty",
    "open_asd": "io.asd",
    "open_collect": "laboratory",
    "open_flightline": "io.flightline",
    "open_irradiance": "io.irradiance",
    "open_store": "io.store",
    "oxygen_residual": "alignment",
    "process": "pipeline",
    "quicklook": "plot",
    "radiance": "radiometry",
    "reflectance": "radiometry",
    "rgb": "plot",
    "simulate_collect": "simulation",
    "smooth": "smoothing",
    "solar_position": "sun",
    "to_store": "io.store",
    "verify": "io.store",
}

__all__ = [
    "CollectError",
    "FormatError",
    "IncompleteStoreError",
    "MissingExtraError",
    "PaintError",
    "PaintWarning",
    "Panel",
    "Quality",
    "SchemaError",
    "StoreError",
    "Tilt",
    "TimeError",
    "UnitsError",
    "__version__",
    "align_to_irradiance",
    "apply_alignment",
    "calibrate",
    "calibration_report",
    "encoding",
    "estimate_noise",
    "match_irradiance",
    "mean_uncertainty",
    "open_asd",
    "open_collect",
    "open_flightline",
    "open_irradiance",
    "open_store",
    "oxygen_residual",
    "process",
    "quicklook",
    "radiance",
    "reflectance",
    "rgb",
    "simulate_collect",
    "smooth",
    "solar_position",
    "to_store",
    "verify",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        msg = f"module {__name__!r} has no attribute {name!r}"
        raise AttributeError(msg)
    value = getattr(importlib.import_module(f".{_HOME[name]}", __name__), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
