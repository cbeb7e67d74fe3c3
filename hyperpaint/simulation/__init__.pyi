from .collect import (
    simulate_collect as simulate_collect,
    simulate_line as simulate_line,
)
from .rendering.relighting import relight as relight
from .rendering.tracing import trace as trace
from .settings import SimulationSettings as SimulationSettings
from .sweep import SweepSettings as SweepSettings
from .sweep_stores import simulate_sweep as simulate_sweep, write_sweep as write_sweep
