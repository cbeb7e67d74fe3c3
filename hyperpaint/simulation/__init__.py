"""A simulator of whole collects with known truth, which shares no code with the processing chain.

Its own physics in float64 from the sky to the converter, and its own writers of the instruments' files: a
chain that recovers the truth from them has shown something. `atmosphere` and `skies` make the light, `paints`
the surfaces, `sensor` and `camera` the camera, `trajectories` how it wobbles over the earth of `ellipsoid`,
`flight` what they do line by line: over a flat picture of a car park (`plan_flight`, `scenes`), over one of
triangles (`rendered_flight`, `rendering`) or over squares of known corners (`checkerboard_flight`).
`instruments`, `svc_files` and `references` write the files, `stores` the truth, `painted_regions` where the
paints are, `collect` the whole; `sweep` shines a monochromator into the same camera.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .collect import simulate_collect, simulate_line
    from .settings import SimulationSettings
    from .sweep import simulate_sweep
    from .sweep_settings import SweepSettings
    from .sweep_stores import write_sweep

__all__ = [
    "SimulationSettings",
    "SweepSettings",
    "simulate_collect",
    "simulate_line",
    "simulate_sweep",
    "write_sweep",
]

_HOMES = {
    "SimulationSettings": "settings",
    "SweepSettings": "sweep_settings",
    "simulate_collect": "collect",
    "simulate_line": "collect",
    "simulate_sweep": "sweep",
    "write_sweep": "sweep_stores",
}


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        from importlib import import_module

        return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
