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
    from .corrections import correct_light, remove_mirrored_sky
    from .flags import flag
    from .illumination import Tilt, match_irradiance
    from .io.asd import open_asd
    from .io.flightline import open_flightline
    from .io.irradiance import open_irradiance
    from .io.store import encoding, open_store, to_store, verify
    from .laboratory import open_collect
    from .picking import pick_regions
    from .pipeline import process
    from .plot import quicklook, rgb
    from .plot_calibration import calibration_report
    from .plot_flags import flag_overlay
    from .plot_library import library_overview
    from .plot_spectra import spectrum, triptych
    from .proposals import Proposals, propose_regions
    from .radiometry import Panel, radiance, reflectance
    from .regions import Region, Regions, read_regions, write_regions
    from .report import write_report
    from .scene_model import SceneModel, survey
    from .scene_rendering import render_scene
    from .signatures import extract_signatures
    from .simulation import simulate_collect
    from .simulation.rendering.relighting import relight
    from .simulation.rendering.tracing import trace
    from .smoothing import smooth
    from .sun import solar_position
    from .uncertainty import estimate_noise, mean_uncertainty

__version__ = "0.1.0"

_HOME = {
    "Panel": "radiometry",
    "Region": "regions",
    "Regions": "regions",
    "SceneModel": "scene_model",
    "Tilt": "illumination",
    "align_to_irradiance": "alignment",
    "apply_alignment": "alignment",
    "calibrate": "calibration",
    "calibration_report": "plot_calibration",
    "correct_light": "corrections",
    "encoding": "io.store",
    "estimate_noise": "uncertainty",
    "extract_signatures": "signatures",
    "flag_overlay": "plot_flags",
    "library_overview": "plot_library",
    "flag": "flags",
    "match_irradiance": "illumination",
    "mean_uncertainty": "uncertainty",
    "open_asd": "io.asd",
    "open_collect": "laboratory",
    "open_flightline": "io.flightline",
    "open_irradiance": "io.irradiance",
    "open_store": "io.store",
    "oxygen_residual": "alignment",
    "pick_regions": "picking",
    "process": "pipeline",
    "Proposals": "proposals",
    "propose_regions": "proposals",
    "quicklook": "plot",
    "radiance": "radiometry",
    "read_regions": "regions",
    "reflectance": "radiometry",
    "relight": "simulation.rendering.relighting",
    "remove_mirrored_sky": "corrections",
    "render_scene": "scene_rendering",
    "rgb": "plot",
    "simulate_collect": "simulation",
    "smooth": "smoothing",
    "solar_position": "sun",
    "spectrum": "plot_spectra",
    "survey": "scene_model",
    "to_store": "io.store",
    "trace": "simulation.rendering.tracing",
    "triptych": "plot_spectra",
    "verify": "io.store",
    "write_regions": "regions",
    "write_report": "report",
}

__all__ = [
    "CollectError",
    "FormatError",
    "IncompleteStoreError",
    "MissingExtraError",
    "PaintError",
    "PaintWarning",
    "Panel",
    "Proposals",
    "Quality",
    "Region",
    "Regions",
    "SceneModel",
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
    "correct_light",
    "encoding",
    "estimate_noise",
    "extract_signatures",
    "flag",
    "flag_overlay",
    "library_overview",
    "match_irradiance",
    "mean_uncertainty",
    "open_asd",
    "open_collect",
    "open_flightline",
    "open_irradiance",
    "open_store",
    "oxygen_residual",
    "pick_regions",
    "process",
    "propose_regions",
    "quicklook",
    "radiance",
    "read_regions",
    "reflectance",
    "relight",
    "remove_mirrored_sky",
    "render_scene",
    "rgb",
    "simulate_collect",
    "smooth",
    "solar_position",
    "spectrum",
    "survey",
    "to_store",
    "trace",
    "triptych",
    "verify",
    "write_regions",
    "write_report",
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
