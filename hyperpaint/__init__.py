"""hyperpaint: from raw pushbroom counts to calibrated paint spectra, in labelled, unit-checked xarray.

Importing it registers ``Dataset.paint`` and costs what ``import xarray`` costs: the names below are loaded
when they are first used, and kernels are compiled when they first run.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from . import accessor as _accessor  # noqa: F401  (registers .paint)
from .base.errors import (
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
from .base.schema import Quality

if TYPE_CHECKING:
    from .alignment import align_to_irradiance, apply_alignment, oxygen_residual
    from .base.attitude_conventions import Convention
    from .calibration import calibrate
    from .geometry.georeference import (
        PinholeCamera,
        canonical_navigation,
        footprint,
        interpolate_pose,
        locate,
        spacing,
    )
    from .geometry.navigation_checks import check_conventions, estimate_clock_offset, solve_boresight
    from .geometry.orthorectification import MapGrid, map_report, orthorectify
    from .io.dirsig import write_dirsig
    from .io.envi.envi_writing import write_envi
    from .io.flightline.flightline_opening import open_flightline
    from .io.flightline.line_table import write_line_table
    from .io.library import open_library, write_library
    from .io.maps.geotiff import write_geotiff
    from .io.navigation.control_points import read_control_points
    from .io.navigation.navigation_opening import open_navigation
    from .io.spectrometers.asd import open_asd
    from .io.spectrometers.irradiance import open_irradiance
    from .io.spectrometers.panel_certificate import read_certificate
    from .io.spectrometers.svc import open_svc
    from .io.store import encoding, open_store, to_store, verify
    from .light.illumination import Tilt, match_irradiance
    from .light.sun import solar_position
    from .paints.mixing import mix_paints, sample_paints, shade_paints
    from .paints.paint_search import search_library
    from .paints.signatures import extract_signatures
    from .paints.starter_paints import starter_library
    from .pictures.picking import pick_regions
    from .pictures.plot import quicklook, rgb
    from .pictures.plot_adjacency import adjacency_figure
    from .pictures.plot_calibration import calibration_report
    from .pictures.plot_flags import flag_overlay
    from .pictures.plot_library import library_overview
    from .pictures.plot_spectra import spectrum, triptych
    from .pictures.plot_validation import validation_figure
    from .radiometry.counts_to_reflectance import Panel, radiance, reflectance
    from .radiometry.smoothing import smooth
    from .radiometry.uncertainty import estimate_noise, mean_uncertainty
    from .regions import Region, Regions, read_regions, write_regions
    from .regions.proposals import Proposals, propose_regions
    from .report.store_report import write_report
    from .simulation import simulate_collect
    from .simulation.rendering.relighting import relight
    from .simulation.rendering.tracing import trace
    from .surroundings import SceneModel, survey
    from .surroundings.flags import flag
    from .surroundings.sun_and_sky import correct_light, remove_mirrored_sky
    from .validation import Validation, validate
    from .workflows.laboratory import open_collect
    from .workflows.pipeline import process
    from .workflows.rendering import render_scene

__version__ = "0.1.0"

_HOME = {
    "Convention": "base.attitude_conventions",
    "Panel": "radiometry.counts_to_reflectance",
    "PinholeCamera": "geometry.georeference",
    "Region": "regions",
    "Regions": "regions",
    "SceneModel": "surroundings",
    "Tilt": "light.illumination",
    "adjacency_figure": "pictures.plot_adjacency",
    "align_to_irradiance": "alignment",
    "apply_alignment": "alignment",
    "calibrate": "calibration",
    "calibration_report": "pictures.plot_calibration",
    "canonical_navigation": "geometry.georeference",
    "correct_light": "surroundings.sun_and_sky",
    "check_conventions": "geometry.navigation_checks",
    "encoding": "io.store",
    "estimate_clock_offset": "geometry.navigation_checks",
    "estimate_noise": "radiometry.uncertainty",
    "extract_signatures": "paints.signatures",
    "flag_overlay": "pictures.plot_flags",
    "footprint": "geometry.georeference",
    "interpolate_pose": "geometry.georeference",
    "library_overview": "pictures.plot_library",
    "flag": "surroundings.flags",
    "locate": "geometry.georeference",
    "match_irradiance": "light.illumination",
    "mean_uncertainty": "radiometry.uncertainty",
    "mix_paints": "paints.mixing",
    "map_report": "geometry.orthorectification",
    "MapGrid": "geometry.orthorectification",
    "open_asd": "io.spectrometers.asd",
    "open_collect": "workflows.laboratory",
    "open_flightline": "io.flightline.flightline_opening",
    "open_irradiance": "io.spectrometers.irradiance",
    "open_library": "io.library",
    "open_navigation": "io.navigation.navigation_opening",
    "open_store": "io.store",
    "open_svc": "io.spectrometers.svc",
    "orthorectify": "geometry.orthorectification",
    "oxygen_residual": "alignment",
    "pick_regions": "pictures.picking",
    "process": "workflows.pipeline",
    "Proposals": "regions.proposals",
    "propose_regions": "regions.proposals",
    "quicklook": "pictures.plot",
    "radiance": "radiometry.counts_to_reflectance",
    "read_certificate": "io.spectrometers.panel_certificate",
    "read_control_points": "io.navigation.control_points",
    "read_regions": "regions",
    "reflectance": "radiometry.counts_to_reflectance",
    "relight": "simulation.rendering.relighting",
    "remove_mirrored_sky": "surroundings.sun_and_sky",
    "render_scene": "workflows.rendering",
    "rgb": "pictures.plot",
    "sample_paints": "paints.mixing",
    "search_library": "paints.paint_search",
    "shade_paints": "paints.mixing",
    "simulate_collect": "simulation",
    "smooth": "radiometry.smoothing",
    "solar_position": "light.sun",
    "solve_boresight": "geometry.navigation_checks",
    "spacing": "geometry.georeference",
    "spectrum": "pictures.plot_spectra",
    "starter_library": "paints.starter_paints",
    "survey": "surroundings",
    "to_store": "io.store",
    "trace": "simulation.rendering.tracing",
    "triptych": "pictures.plot_spectra",
    "validate": "validation",
    "Validation": "validation",
    "validation_figure": "pictures.plot_validation",
    "verify": "io.store",
    "write_dirsig": "io.dirsig",
    "write_envi": "io.envi.envi_writing",
    "write_geotiff": "io.maps.geotiff",
    "write_library": "io.library",
    "write_line_table": "io.flightline.line_table",
    "write_regions": "regions",
    "write_report": "report.store_report",
}

__all__ = [
    "CollectError",
    "Convention",
    "FormatError",
    "IncompleteStoreError",
    "MapGrid",
    "MissingExtraError",
    "PaintError",
    "PaintWarning",
    "Panel",
    "PinholeCamera",
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
    "Validation",
    "__version__",
    "adjacency_figure",
    "align_to_irradiance",
    "apply_alignment",
    "calibrate",
    "calibration_report",
    "canonical_navigation",
    "check_conventions",
    "correct_light",
    "encoding",
    "estimate_clock_offset",
    "estimate_noise",
    "extract_signatures",
    "flag",
    "flag_overlay",
    "footprint",
    "interpolate_pose",
    "library_overview",
    "locate",
    "map_report",
    "match_irradiance",
    "mean_uncertainty",
    "mix_paints",
    "open_asd",
    "open_collect",
    "open_flightline",
    "open_irradiance",
    "open_library",
    "open_navigation",
    "open_store",
    "open_svc",
    "orthorectify",
    "oxygen_residual",
    "pick_regions",
    "process",
    "propose_regions",
    "quicklook",
    "radiance",
    "read_certificate",
    "read_control_points",
    "read_regions",
    "reflectance",
    "relight",
    "remove_mirrored_sky",
    "render_scene",
    "rgb",
    "sample_paints",
    "search_library",
    "shade_paints",
    "simulate_collect",
    "smooth",
    "solar_position",
    "solve_boresight",
    "spacing",
    "spectrum",
    "starter_library",
    "survey",
    "to_store",
    "trace",
    "triptych",
    "validate",
    "validation_figure",
    "verify",
    "write_dirsig",
    "write_envi",
    "write_geotiff",
    "write_library",
    "write_line_table",
    "write_regions",
    "write_report",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f".{_HOME[name]}", __name__), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
