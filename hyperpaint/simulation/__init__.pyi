from .atmosphere import BrokenClouds as BrokenClouds
from .collect import (
    SweepSettings as SweepSettings,
    simulate_collect as simulate_collect,
    simulate_line as simulate_line,
    simulate_sweep as simulate_sweep,
    write_sweep as write_sweep,
)
from .rendering.materials import (
    base_albedo as base_albedo,
    flop_index as flop_index,
    gloss_units as gloss_units,
    reflectance_factor as reflectance_factor,
)
from .rendering.measured_brdfs import fit_paint as fit_paint, measured_brdf as measured_brdf
from .rendering.platforms import platform_from_poses as platform_from_poses
from .rendering.relighting import relight as relight, trace as trace
from .settings import SimulationSettings as SimulationSettings
