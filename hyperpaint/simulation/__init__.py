"""A simulator of whole collects with known truth, which shares no code with the processing chain.

Plain numpy in float64 from the sky to the converter, and its own writers of the instruments' files: a chain
that recovers the truth from them has shown something. `atmosphere` makes the light, `paints` the surfaces,
`scenes` the car park, `sensor` the camera, `instruments` the files, `collect` the whole.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .collect import simulate_collect, simulate_line
    from .settings import SimulationSettings

__all__ = ["SimulationSettings", "simulate_collect", "simulate_line"]

_HOMES = {"SimulationSettings": "settings", "simulate_collect": "collect", "simulate_line": "collect"}


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        from importlib import import_module

        return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    msg = f"module {__name__!r} has no attribute {name!r}"
    raise AttributeError(msg)
