from .illumination import (
    Tilt as Tilt,
    match_irradiance as match_irradiance,
)
from .sun import solar_position as solar_position
