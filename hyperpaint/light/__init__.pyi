from .aircraft_receiver import level_irradiance as level_irradiance
from .diffuse_record import diffuse_from_record as diffuse_from_record
from .illumination import (
    Tilt as Tilt,
    match_irradiance as match_irradiance,
)
from .sky_functions import fit_sky as fit_sky
from .sun import solar_position as solar_position
