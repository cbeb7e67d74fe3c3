"""From position and attitude of a camera to the ground position of every pixel."""

from .cameras import PinholeCamera
from .coverage import footprint, spacing
from .geodesy import meridian_convergence, utm_zone
from .locating import locate
from .poses import LOCATION_UNITS, canonical_navigation, interpolate_pose

__all__ = [
    "LOCATION_UNITS",
    "PinholeCamera",
    "canonical_navigation",
    "footprint",
    "interpolate_pose",
    "locate",
    "meridian_convergence",
    "spacing",
    "utm_zone",
]
